"""Labels by the polytopes that rays have found: the price of a few products a point.

The hull of proved points v is divided into cones from the centre c of the rays, one for each of its
facets. In a cone a point θ and its inputs are the same combination of the centre's and of those of
the facet's vertices: with λ = M (θ − c), M = [v_1 − c, …, v_d − c]⁻¹, the inputs are
u_c + Σ λ_i (u_i − u_c), affine in θ. The gauge Σ λ_i tells the cone of a point, in which it is
largest, and whether the point lies in the hull, where it is at most 1. These inputs are rolled out,
and half-spaces are compared, like all candidates (`proofs.py`): what is not proved so, within
rounding of the boundary or between the polytopes, is left to the other stages.
"""

import functools
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.spatial import ConvexHull, QhullError

from jaxmpc.compiled import Compiled
from jaxmpc.devices import Devices, over_devices
from jaxmpc.feasible import proofs
from jaxmpc.feasible.candidates import Verdict
from jaxmpc.feasible.constraint_rows import ConstraintRows
from jaxmpc.feasible.exact_data import ExactData
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.rays import Rays
from jaxmpc.feasible.refinement import refined
from jaxmpc.qp.precision import matmul

# Coordinates up to which the polytopes have few facets.
MOST_COORDINATES = 4
# Rays: gap of the volumes at which they stop, and with which the cones are of use; rounds, and the
# most rays in one.
GAP, USEFUL, ROUNDS, MOST_RAYS = 1e-9, 0.05, 8, 200
# Points of two coordinates that take longer by the other stages, on a CPU, than the rays do; each
# further coordinate takes four times as many.
MANY = 2**18


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Cones:
    """Cones about center (d,): gauge (F, d) of each; inputs and, in a projection, free states
    value + slope_i (θ − center), value (v,), slope (F, v, d). Half-spaces normals (K, d) θ ≤
    offsets (K,) that hold on the whole feasible set, and the cuts that they follow from."""

    center: Any
    gauge: Any
    value: Any
    slope: Any
    normals: Any
    offsets: Any
    cuts: Any

    @classmethod
    def of(cls, problem: FeasibilityProblem) -> "Cones | None":
        """Return the cones of a problem, or None where rays bring no polytopes together: in more
        than `MOST_COORDINATES`, or where the set is flat, unbounded or has many vertices."""
        d, rows = problem.dimension, problem.rows
        if d > MOST_COORDINATES:
            return None
        try:
            found = refined(Rays.of(problem), GAP, ROUNDS, MOST_RAYS)
        except ValueError:
            return None
        if not found.gap <= USEFUL:
            return None
        center, points = found.rays.center, found.points
        unit = np.ptp(points, axis=0)
        try:
            facets = hull_facets((points - center) / unit)
        except QhullError:
            return None
        edges = (points - center)[facets].transpose(0, 2, 1)  # (F, d, d), a column a vertex
        regular = np.linalg.cond(edges / unit[:, None]) < 1e8
        facets, edges = facets[regular], edges[regular]
        M = np.linalg.inv(edges)
        free = len(problem.view.others) if problem.view.projects else 0
        value = values(rows, center, found.rays.w, free)
        each = np.array([values(rows, *pair, free) for pair in zip(points, found.w, strict=True)])
        slope = (each - value)[facets].transpose(0, 2, 1) @ M
        return cls(center, M.sum(axis=1), value, slope, found.normals, found.offsets, found.cuts)


def hull_facets(points: np.ndarray) -> np.ndarray:
    """Return the indices (F, d) of the vertices of each facet of the hull of points (K, d)."""
    if points.shape[1] == 1:
        return np.array([[np.argmin(points)], [np.argmax(points)]])
    return ConvexHull(points).simplices


def values(rows: ConstraintRows, theta: np.ndarray, w: np.ndarray, free: int) -> np.ndarray:
    """Return the inputs (N·m,) and the `free` states that w (k,) stands for at θ (d,), one after
    the other."""
    variables = rows.back @ w
    inputs = rows.Psi @ theta + rows.Omega @ variables + rows.psi
    return np.append(inputs.ravel(), variables[len(variables) - free :])


# The cones of problems that have been asked for, for as long as the problems live.
_made: WeakKeyDictionary[FeasibilityProblem, Cones | None] = WeakKeyDictionary()


def cones_for(problem: FeasibilityProblem, points: int) -> Cones | None:
    """Return the cones of a problem if so many points are worth the rays, or if they were made for
    it before; None else, and where it has none."""
    least = MANY * 4.0 ** (problem.dimension - 2) * (1 if jax.default_backend() == "cpu" else 8)
    if problem not in _made and points >= least:
        _made[problem] = Cones.of(problem)
    return _made.get(problem)


@functools.cache
def compiled_cones(devices: Devices) -> Compiled:
    """Return the compiled stage: (p, cones, points (B, d)) → verdicts."""
    return over_devices(cone_stage, devices, (False, False, True))


def cone_stage(p: ExactData, cones: Cones, points: Array) -> Verdict:
    """Return verdicts on points (B, d)."""
    N, (_, m) = p.horizon, p.B.shape
    length = jnp.linalg.norm(cones.normals, axis=1)

    def one(theta: Array) -> Verdict:
        r = theta - cones.center
        cone = jnp.argmax(matmul(r, cones.gauge.T))
        value = cones.value + jnp.sum(cones.slope[cone] * r, axis=1)
        inputs, free = value[: N * m].reshape(N, m), value[N * m :]
        feasible, inputs = proofs.prove_feasible(p, theta, free, inputs)
        facet = jnp.argmax((matmul(theta, cones.normals.T) - cones.offsets) / length)
        # The cut at the point rests on no linear program; a half-space may (`proofs.everywhere`).
        a, b, w = (v[facet] for v in cones.cuts)
        infeasible = proofs.excludes(a, b, w, theta)
        normal, offset = cones.normals[facet], cones.offsets[facet]
        everywhere = proofs.excludes(normal, offset, jnp.zeros_like(normal), theta)
        offset = jnp.where(everywhere, offset, jnp.inf)
        label = jnp.where(feasible, 1, jnp.where(infeasible, -1, 0)).astype(jnp.int8)
        return Verdict(label, p.view.initial_state(theta, free), inputs, normal, offset)

    return jax.vmap(one)(points)
