"""Labels by the polytopes that rays have found: the price of a few products a point.

The hull of proved points v is divided into cones from the centre c of the rays, one for each of its
facets. In a cone a point θ and its inputs are the same combination of the centre's and of those of
the facet's vertices: with λ = M (θ − c), M = [v_1 − c, …, v_d − c]⁻¹, the inputs are
u_c + Σ λ_i (u_i − u_c), affine in θ. The gauge Σ λ_i tells the cone of a point, in which it is
largest, and whether the point lies in the hull, where it is at most 1.

*Labels.* A point of the hull is feasible, for the plans of the vertices keep all limits and so does
their combination: λ ≥ 0 and Σ λ_i ≤ 1 prove it, each by more than the rounding of λ. A point that a
half-space excludes is infeasible (`proofs.excludes`). Nothing is rolled out (`label`).

*Plans* are made when they are asked for (`verdict`). They are these inputs in floats, rolled out
like all candidates. That roll-out succeeds where a point has been labelled so: rows are linear and
the bounds of their rounding are sublinear, so the slack of a row net of rounding, s, is concave in
θ, at least (1 − Σ λ_i) s_c + Σ λ_i s_i. Where the vertices' own s_i, evaluated for inputs that may
be off by the rounding of this combination, are not below −δ s_c, Σ λ_i ≤ 1 − δ suffices.

What is not labelled so, within rounding of the boundary or between the polytopes, gets its plan
rolled out at once, and is else left to the other stages.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.spatial import QhullError

from jaxmpc.batches import Compiled, Devices, over_devices
from jaxmpc.feasible import proofs
from jaxmpc.feasible.condensed_rows import ConstraintRows
from jaxmpc.feasible.hard_constraints import ExactData
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.rays import closed_bounds, filled, processor
from jaxmpc.pytrees import pytree
from jaxmpc.qp.jax_transformations import default_platform, own_modes
from jaxmpc.sets.geometry import convex_hull

# Coordinates up to which the polytopes have few facets.
MOST_COORDINATES = 4
# Rays: gap of the volumes at which they stop, and with which the hull is of use; rounds, and the
# most rays in one.
GAP, USEFUL, ROUNDS, MOST_RAYS = 1e-9, 0.05, 8, 200
# Points of two coordinates that take longer by the other stages than the rays do, on a CPU and
# elsewhere; each further coordinate takes four times as many. (One joint, N = 20, H100: 131,072
# points 42 ms by the other stages, 88 by rays; 262,144 66 and 90; 1,048,576 136 and 136.)
MANY_POINTS, MANY_POINTS_ELSEWHERE = 2**14, 2**19


@pytree
class Hull:
    """Cones about center (d,): M (F, d, d) and gauge (F, d) of each, the least λ_i and the largest
    gauge (F,) of points that are labelled; inputs and, in a projection, free states value + slope_i
    (θ − center), value (v,), slope (F, v, d). Half-spaces normals (K, d) θ ≤ offsets (K,) that hold
    on the whole feasible set, and the cuts that they follow from. gap: the fraction of their volume
    that the hull lacks."""

    # Arrays of NumPy, or on a device.
    center: Any
    M: Any
    gauge: Any
    least: Any
    most: Any
    value: Any
    slope: Any
    normals: Any
    offsets: Any
    cuts: proofs.Cut
    gap: Any

    @classmethod
    def of(cls, problem: FeasibilityProblem) -> "Hull | None":
        """Return the hull of a problem, or None where rays bring no polytopes together: in more
        than `MOST_COORDINATES`, or where the set is flat, unbounded or has many vertices."""
        d, rows = problem.dimension, problem.rows
        if d > MOST_COORDINATES:
            return None
        try:
            rays, proved, gap = closed_bounds(problem, GAP, ROUNDS, MOST_RAYS)
        except ValueError:
            return None
        if not gap <= USEFUL:
            return None
        center, points = rays.center, proved.points
        unit = np.ptp(points, axis=0)
        try:
            facets = hull_facets((points - center) / unit)
        except QhullError:
            return None
        theta, w = np.vstack([points, center]), np.vstack([proved.w, rays.w])
        facets = facets[np.linalg.cond(edges_of(theta, facets) / unit[:, None]) < 1e8]
        M = np.linalg.inv(edges_of(theta, facets))
        free = len(problem.view.others) if problem.view.projects else 0
        value = vertex_values(rays.exact, rows, theta, w, free)
        least, most = label_limits(rays.exact, theta, value, facets, M)
        gauge, slope = M.sum(axis=1), edges_of(value, facets) @ M
        _, _, normals, offsets, cuts = proved
        return cls(center, M, gauge, least, most, value[-1], slope, normals, offsets, cuts, gap)


def edges_of(values: np.ndarray, facets: np.ndarray) -> np.ndarray:
    """Return the differences (F, v, d) of the values (K + 1, v) at each facet's vertices, a column
    each, from those of the centre, the last ones."""
    return (values[:-1] - values[-1])[facets].transpose(0, 2, 1)


def rounding_of_cones(edges: np.ndarray, M: np.ndarray) -> np.ndarray:
    """Return by how much λ = M (θ − c) may be off in each cone (F,), with its edges E (F, d, d) and
    γ of `proofs.gamma`: four times ‖I − M E‖ + O(γ) ‖|M||E|‖, which bounds it in the hull."""
    d = M.shape[1]
    norm = lambda matrices: np.abs(matrices).sum(axis=2).max(axis=1)
    size = norm(np.abs(M) @ np.abs(edges))
    return 4 * (norm(np.eye(d) - M @ edges) + 4 * proofs.gamma(d + 3) * size)


def label_limits(
    p: ExactData, points: np.ndarray, values: np.ndarray, facets: np.ndarray, M: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the least λ_i and the largest gauge (F,) with which points of each cone are labelled
    (top of this file); a gauge of −∞ for none: with free states, equalities or a terminal
    ellipsoid, whose plans are rolled out.

    points (K + 1, d), the centre last, with inputs values (K + 1, v). Where λ is off by
    `rounding_of_cones`, inputs are by d max|u_i − u_c| times that, in `roll_out` as `moved`.
    """
    d, N, (_, m) = points.shape[1], p.horizon, p.sizes
    off = rounding_of_cones(edges_of(points, facets), M)
    none = np.full(len(off), -np.inf)
    if values.shape[1] != N * m or p.equalities is not None or p.P is not None:
        return off, none
    rounding = 4 * proofs.UNIT_ROUNDOFF * np.abs(values).max()
    moved = 2 * d * np.abs(edges_of(values, facets)).max(axis=(1, 2)) * off + rounding
    # One bound for all cones but those so thin that it would be the others' loss.
    usable = (off < 1e-3) & (moved <= 1e4 * (np.median(moved) + rounding))
    most = np.max(moved, where=usable, initial=0.0)

    some = filled(len(points))
    with jax.enable_x64(True), jax.default_device(processor()):
        found = np.asarray(_slack(p, points[some], values[some], most))
    unmoved, slack = found[:, : len(points)]
    at_center = slack[-1]
    proved = usable & np.all(unmoved[facets] >= 0, axis=1) & (at_center > 0)
    with np.errstate(invalid="ignore", divide="ignore"):
        lost = np.max(np.maximum(-slack[facets], 0.0), axis=1) / at_center
    return off, np.where(proved, 1 - 2 * lost - d * off, none)


@jax.jit
@own_modes
def _slack(p: ExactData, points: Array, values: Array, moved: Array) -> Array:
    """Return the slack of `roll_out` (2, K) from the points with these inputs: as they are, and
    where each may be off by `moved`."""
    N, (_, m) = p.horizon, p.sizes
    none = jnp.zeros(0)

    def one(theta: Array, inputs: Array, moved: Any) -> Array:
        x, inputs = p.view.initial_state(theta, none), inputs.reshape(N, m)
        return proofs.roll_out(p, x, inputs, jnp.broadcast_to(moved, inputs.shape))[0]

    each = jax.vmap(one, in_axes=(0, 0, None))
    return jnp.stack([each(points, values, 0.0), each(points, values, moved)])


def hull_facets(points: np.ndarray) -> np.ndarray:
    """Return the indices (F, d) of the vertices of each facet of the hull of points (K, d)."""
    if points.shape[1] == 1:
        return np.array([[np.argmin(points)], [np.argmax(points)]])
    hull, kept = convex_hull(points)
    return kept[hull.simplices]


def vertex_values(
    p: ExactData, rows: ConstraintRows, theta: np.ndarray, w: np.ndarray, free: int
) -> np.ndarray:
    """Return the inputs (K, N·m), within their limits, and the `free` states that w (K, k) stand
    for at θ (K, d), side by side. All are arrays of NumPy."""
    variables = w @ rows.back.T
    inputs = np.tensordot(theta, rows.Psi, (1, 2)) + np.tensordot(variables, rows.Omega, (1, 2))
    inputs = proofs.within_limits(p, inputs + rows.psi)
    return np.hstack([inputs.reshape(len(w), -1), variables[:, variables.shape[1] - free :]])


def hull_for(problem: FeasibilityProblem, points: float) -> Hull | None:
    """Return the hull of a problem if so many points are worth the rays, or if they were made for
    it before; None else, and where it has none."""
    many = MANY_POINTS if default_platform() == "cpu" else MANY_POINTS_ELSEWHERE
    least = many * 4.0 ** (problem.dimension - 2)
    if "hull" not in problem.memory and points >= least:
        problem.memory["hull"] = Hull.of(problem)
    return problem.memory.get("hull")


@functools.cache
def compiled_verdicts(devices: Devices) -> Compiled:
    """Return the compiled plans: (p, hull, points (B, d)) → verdicts."""
    each = jax.vmap(verdict, in_axes=(None, None, 0))
    return over_devices(each, devices, (False, False, True))


def label(hull: Hull, theta: Array) -> Array:
    """Return the label of θ (d,), 0 where it is left to others: nothing is rolled out."""
    return label_in(hull, theta, *nearest_cone(hull, theta))


def label_in(hull: Hull, theta: Array, cone: Array, facet: Array) -> Array:
    """Return the label that this cone and this half-space give θ (d,)."""
    share = jnp.sum(hull.M[cone] * (theta - hull.center), axis=1)
    inside = jnp.all(share >= hull.least[cone]) & (jnp.sum(share) <= hull.most[cone])
    a, b, w = (v[facet] for v in hull.cuts)
    outside = proofs.excludes(a, b, w, theta)
    return jnp.where(inside, 1, jnp.where(outside, -1, 0)).astype(jnp.int8)


def verdict(p: ExactData, hull: Hull, theta: Array) -> proofs.Verdict:
    """Return the verdict on θ (d,), with its proof."""
    N, (_, m) = p.horizon, p.sizes
    cone, facet = nearest_cone(hull, theta)
    value = hull.value + jnp.sum(hull.slope[cone] * (theta - hull.center), axis=1)
    inputs, free = value[: N * m].reshape(N, m), value[N * m :]
    feasible, inputs = proofs.prove_feasible(p, theta, free, inputs)
    # The cut at the point rests on no linear program; a half-space may (`proofs.everywhere`).
    a, b, w = (v[facet] for v in hull.cuts)
    infeasible = proofs.excludes(a, b, w, theta)
    label = jnp.where(feasible, 1, jnp.where(infeasible, -1, 0)).astype(jnp.int8)
    normal = hull.normals[facet]
    offset = proofs.offset_at(normal, hull.offsets[facet], theta)
    return proofs.Verdict(label, p.view.initial_state(theta, free), inputs, normal, offset)


def nearest_cone(hull: Hull, theta: Array) -> tuple[Array, Array]:
    """Return the indices of the cone of θ (d,), and of the half-space that it exceeds most."""
    cone = index_of_largest(hull.gauge, jnp.zeros(len(hull.gauge)), theta - hull.center)
    return cone, exceeded_most(hull, theta)


def exceeded_most(hull: Hull, theta: Array) -> Array:
    """Return the index of the half-space that θ (d,) exceeds most."""
    length = jnp.linalg.norm(hull.normals, axis=1)
    return index_of_largest(hull.normals / length[:, None], hull.offsets / length, theta)


def index_of_largest(rows: Array, offsets: Array, x: Array) -> Array:
    """Return the index of the largest rows·x − offsets, rows (K, d), x (d,).

    Row by row: so a batch is one loop over its points in each, which CPUs take in vectors. (A
    product and an argmax take twice as long.)
    """

    def better(best: tuple[Array, Array], row: tuple) -> tuple[Any, None]:
        value, index = best
        normal, offset, i = row
        here = sum(normal[j] * x[j] for j in range(x.shape[0])) - offset
        return (jnp.maximum(value, here), jnp.where(here > value, i, index)), None

    count = jnp.arange(len(rows), dtype=jnp.int32)
    begin = jnp.asarray(-jnp.inf, x.dtype), jnp.int32(0)
    return jax.lax.scan(better, begin, (rows, offsets, count))[0][1]
