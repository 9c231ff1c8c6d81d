"""Labels under affine policies, by the hull of policies that rays have found.

The rows are convex in (θ, v, M) together, so a convex combination of proved triples is a proved
triple. Rays from the centre end in triples and half-spaces, each proved in rational arithmetic
(`policy_problem.py`); `close_gap` sends more until hull and half-spaces meet. The hull is divided
into cones as in `hull_labels.py`: with λ ≥ 0, Σ λ ≤ 1 a point is feasible, and its policy is the
same combination of those of the centre and of its facet's vertices. Beyond a half-space it is
infeasible. The few points between get a ray of their own.
"""

import contextlib
import functools
import math
import time
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.spatial import QhullError

from jaxmpc.arrays import Reals, host_array
from jaxmpc.batches import (
    Compiled,
    Devices,
    chosen_devices,
    default_chunk,
    divisible,
    each_part,
    first_rows,
    joined,
    over_devices,
    padded,
    to_host,
)
from jaxmpc.checks import fail, require_finite
from jaxmpc.feasible import proofs
from jaxmpc.feasible.hull_labels import (
    GAP,
    MOST_COORDINATES,
    MOST_RAYS,
    ROUNDS,
    Hull,
    edges_of,
    exceeded_most,
    hull_facets,
    label_in,
    rounding_of_cones,
)
from jaxmpc.feasible.pipeline import (
    MOST_PROGRAMS,
    Labels,
    OnDemand,
    compiled_ends,
)
from jaxmpc.feasible.policy_problem import (
    PolicyProblem,
    directions,
    problem_of,
    rounded,
)
from jaxmpc.feasible.proofs import Cut
from jaxmpc.feasible.rays import BACKOFFS, Boundary, ProvedBounds, close_gap, leaving
from jaxmpc.mpc.problem import MPC
from jaxmpc.pytrees import record
from jaxmpc.qp.status import Status

# By label: 0, 1, −1.
STATUSES = np.array([Status.ITERATION_LIMIT, Status.SOLVED, Status.PRIMAL_INFEASIBLE], np.int8)


# What labels under policies have beside the proofs of others, and the label that each proves.
POLICY_PROOFS = {"cone": 1, "answer": 1}


class PolicyVerdict(NamedTuple):
    """A `proofs.Verdict` on each of b points, whose plans are those of policies.

    cone (b,): the cone of the hull in which the policy is a combination of those at its vertices;
    −1 where it is one of its own, with answer (b, …) beside the plan (`answer_shape`), else NaN.
    """

    label: np.ndarray
    start: np.ndarray
    plan: np.ndarray
    cut_normal: np.ndarray
    cut_offset: np.ndarray
    cone: np.ndarray
    answer: np.ndarray


@record
class PolicyRays:
    """Rays from one centre of the feasible set under affine policies, as `rays.Rays`.

    center (d,), with w: a proved triple, (v, M) flattened side by side.
    """

    problem: PolicyProblem
    center: np.ndarray
    w: np.ndarray

    @classmethod
    def of(cls, problem: PolicyProblem, center: np.ndarray | None = None) -> "PolicyRays":
        """Return rays from the given centre, or from a point with a margin.

        Raises ValueError where the feasible set is empty or flat, or the centre not inside it.
        """
        given = center is not None
        center, x = problem.programs.center(center)
        rays = cls(problem, center if given else rounded(center), np.zeros(0))
        rays = replace(rays, w=rays.flat(x))
        if not rays.proved(rays.center, rays.w):
            fail("mpc", "its feasible set is flat: no centre is proved", "Relax a limit")
        return rays

    @property
    def reach(self) -> np.ndarray:
        """Return bounds (d,) of |θ| on the feasible set, ∞ where there are none."""
        box = self.problem.programs.bounding_box[0]
        return np.full(len(self.center), np.inf) if box is None else np.abs(box).max(axis=0)

    def flat(self, x: np.ndarray) -> np.ndarray:
        """Return (v, M) of a point of the lifted rows as one vector."""
        v, M = self.problem.lifted.policy(x, self.problem.causal)
        return np.append(v, M)

    def proved(self, theta: np.ndarray, w: np.ndarray) -> bool:
        """Return whether the triple (θ, v, M) is proved."""
        v, M = self.parts(w)
        return self.problem.exact_rows.proves(theta, v, M)

    def parts(self, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return v (…, V) and M (…, N m, N g) of flattened policies."""
        size, shape = self.problem.plan_size, self.problem.causal.shape
        return w[..., :size], w[..., size:].reshape(*w.shape[:-1], *shape)

    def box(self) -> ProvedBounds:
        """Return the half-spaces of the bounding box, those that exist."""
        none = np.zeros((0, len(self.center))), np.zeros((0, len(self.w)))
        _, sides = self.problem.programs.bounding_box
        return ProvedBounds.of(*none, self._boundary(np.zeros((0, len(self.center))), [], sides))

    def cast(self, directions: np.ndarray) -> Boundary:
        """Return the boundary points along every direction (K, d), moved inwards and proved."""
        found, multipliers = [], []
        for direction in directions:
            t, x, y = self.problem.programs.ray(self.center, direction)
            found.append(self._end(direction, t, self.flat(x)) if np.isfinite(t) else None)
            multipliers.append(y)
        return self._boundary(directions, found, np.array(multipliers))

    def _end(self, direction: np.ndarray, t: float, w: np.ndarray) -> tuple | None:
        """Return (t, θ, w) of the last triple of a ray that is proved."""
        for back in BACKOFFS:
            theta = rounded(self.center + t * (1 - back) * direction)
            policy = rounded(self.w + (1 - back) * (w - self.w))
            if self.proved(theta, policy):
                return t * (1 - back), theta, policy
        return None

    def _boundary(self, directions: np.ndarray, found: list, multipliers: np.ndarray) -> Boundary:
        problem, d = self.problem, len(self.center)
        width = problem.causal.shape[1]
        each = [problem.lifted.multipliers(y, width) for y in multipliers]
        cuts = [problem.exact_rows.cut(*parts, problem.causal) for parts in each]
        cut = Cut(*(np.array(v) for v in zip(*cuts, strict=True)))
        with np.errstate(invalid="ignore"):
            extra = np.where(cut.w == 0, 0.0, cut.w * self.reach).sum(axis=1)
        offsets = np.nextafter(cut.b + extra * (1 + 1e-12), np.inf)
        none = np.nan, np.full(d, np.nan), np.full(len(self.w), np.nan)
        ends = [none if end is None else end for end in found]
        inner, points, w = (np.array(v) for v in zip(*ends, strict=True)) if ends else none
        return Boundary(
            center=self.center,
            directions=directions,
            inner=np.atleast_1d(inner),
            outer=leaving(self.center, directions, cut.a, offsets),
            points=points,
            w=w,
            normals=cut.a,
            offsets=offsets,
            cuts=cut,
        )


@record
class PolicyHull:
    """The cones of proved triples, as a `Hull` with policies for its values, and its rays.

    corners (F, d): indices of the triples of each cone beside the centre, among those of `bounds`.
    gap: of the volumes of the hull and of the half-spaces, relative to the latter.
    """

    rays: PolicyRays
    hull: Hull
    bounds: ProvedBounds
    corners: np.ndarray
    gap: float

    @classmethod
    def of(cls, problem: PolicyProblem, gap: float = GAP, deadline: float = np.inf) -> "PolicyHull":
        """Return the hull of a problem.

        Raises ValueError where its feasible set is empty, flat or unbounded, and in more than
        `MOST_COORDINATES`."""
        d = problem.dimension
        if d > MOST_COORDINATES:
            cure = 'Give axes and fixed for a slice, or policy="tightened"'
            fail(
                "mpc",
                f"has {d} states; hulls of affine policies have up to {MOST_COORDINATES}",
                cure,
            )
        rays = PolicyRays.of(problem)
        bounds, left = close_gap(rays, gap, ROUNDS, MOST_RAYS, deadline)
        facets = None
        if len(bounds.points) > d and len(bounds.offsets):  # else too few rays end, or half-spaces
            unit = np.ptp(bounds.points, axis=0)
            with contextlib.suppress(QhullError, ValueError), np.errstate(all="ignore"):
                facets = hull_facets((bounds.points - rays.center) / unit)
        if facets is None:
            cure = "Bound the states, or use policy='tightened'"
            fail("mpc", "its feasible set is flat or unbounded: no hull of policies", cure)
        theta, w = np.vstack([bounds.points, rays.center]), np.vstack([bounds.w, rays.w])
        facets = facets[np.linalg.cond(edges_of(theta, facets) / unit[:, None]) < 1e8]
        M = np.linalg.inv(edges_of(theta, facets))
        off = rounding_of_cones(edges_of(theta, facets), M)  # real λ are all it takes
        gauge, slope = M.sum(axis=1), edges_of(w, facets) @ M
        _, _, normals, offsets, cuts = bounds
        least = off, 1 - d * off
        hull = Hull(rays.center, M, gauge, *least, w[-1], slope, normals, offsets, cuts, left)
        return cls(rays, hull, bounds, facets, left)

    @property
    def triples(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the proved states (K + 1, d), their plans (K + 1, N, m) and what else their
        policies have (K + 1, …); those of the centre last."""
        theta = np.vstack([self.bounds.points, self.rays.center])
        return theta, *self.split(np.vstack([self.bounds.w, self.rays.w]))

    def split(self, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return plans (K, N, m) and the rest (K, …) of flattened policies (K, v)."""
        problem = self.rays.problem
        plans, shape = problem.inputs(w), problem.answer_shape
        return plans, w[:, w.shape[1] - math.prod(shape) :].reshape(len(w), *shape)

    def policies(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return v (B, V) and M (B, N m, N g) of feasible points (B, d), for ω as in
        `policy_problem.py`: combined, or by a ray where no cone holds the point. NaN where there is
        none."""
        with jax.enable_x64(True):
            w, label, *_ = compiled_proofs(None).run(self.hull, points)
        w, left = np.array(w), np.flatnonzero(np.asarray(label) != 1)
        if len(left):
            w[left] = self.by_rays(points[left])[1]
        return self.rays.parts(w)

    def by_rays(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, Boundary]:
        """Return which points (K, d) a ray from the centre through each proves feasible, their
        policies (K, v), NaN for others, and the ends of the rays."""
        rays, directions = self.rays, points - self.rays.center
        still = ~np.any(directions != 0, axis=1)
        ends = rays.cast(np.where(still[:, None], 1.0, directions))
        reach = np.where(ends.inner >= 1, ends.inner, np.nan)
        plans = rays.w + np.where(still, 0.0, 1 / reach)[:, None] * (ends.w - rays.w)
        proved = [
            not np.isnan(plan).any() and rays.proved(point, plan)
            for point, plan in zip(points, plans, strict=True)
        ]
        return np.array(proved), np.where(np.array(proved)[:, None], plans, np.nan), ends


def label(hull: Hull, theta: Array) -> tuple[Array, Array, Array]:
    """Return the label of θ (d,), 0 where it is left to a ray, its cone, and its half-space."""
    cone, facet = holding_cone(hull, theta), exceeded_most(hull, theta)
    return label_in(hull, theta, cone, facet), cone, facet


def holding_cone(hull: Hull, theta: Array) -> Array:
    """Return the index of the cone in which the least λ_i of θ is largest: of facets in one plane,
    of which there are many where rays end on one face, that which holds θ. One cone after the
    other, as in `hull_labels.index_of_largest`."""
    x = theta - hull.center

    def better(best: tuple[Array, Array], cone: tuple) -> tuple[Any, None]:
        value, index = best
        M, i = cone
        rows = [sum(M[r, j] * x[j] for j in range(x.shape[0])) for r in range(x.shape[0])]
        here = functools.reduce(jnp.minimum, rows)
        return (jnp.maximum(value, here), jnp.where(here > value, i, index)), None

    count = jnp.arange(len(hull.M), dtype=jnp.int32)
    begin = jnp.asarray(-jnp.inf, theta.dtype), jnp.int32(0)
    return jax.lax.scan(better, begin, (hull.M, count))[0][1]


@functools.cache
def compiled_policy_labels(devices: Devices) -> Compiled:
    """Return the compiled labels: (hull, points (B, d)) → labels (B,)."""
    one = lambda hull, theta: label(hull, theta)[0]
    return over_devices(jax.vmap(one, in_axes=(None, 0)), devices, (False, True))


def policy_hull(problem: PolicyProblem) -> PolicyHull:
    """Return the hull of a problem, made once."""
    if "hull" not in problem.memory:
        problem.memory["hull"] = PolicyHull.of(problem)
    return problem.memory["hull"]


class AffinePolicies(NamedTuple):
    """u_k = plan_k + Σ_{j<k} feedback_kj w_j for each of B states: plan (B, N, m), feedback
    (B, N, m, N, p), zero for j ≥ k; NaN for states that have none."""

    plan: np.ndarray
    feedback: np.ndarray


def affine_policies(mpc: MPC | PolicyProblem, x0s: Reals) -> AffinePolicies:
    """Return an affine policy of each state that keeps all limits under every disturbance.

    mpc: a problem with policy="affine", or the `problem` of its map, whose rays are sent already.
    x0s: states (B, n), or points of a slice. The policies are combinations of those at the ends of
    rays, which are proved in rational arithmetic; numbers here are rounded. They hold for what was
    asked, and minimise no cost. Raises ValueError as `map_feasible_set` does.
    """
    problem = mpc if isinstance(mpc, PolicyProblem) else problem_of(mpc)
    if not isinstance(problem, PolicyProblem) or problem.mpc.policy != "affine":
        fail("mpc", "has no affine policy", 'Give MPC(disturbance=..., policy="affine")')
    points = host_array("x0s", x0s)
    if points.ndim != 2 or not len(points) or points.shape[1] != problem.dimension:
        fail("x0s", f"shape {points.shape}", f"Give points (B, {problem.dimension}), B ≥ 1")
    require_finite("x0s", points)
    v, M = policy_hull(problem).policies(points)
    center, gamma = (np.asarray(part, float) for part in directions(problem.mpc))
    (B, _), N, m, p = v.shape, problem.mpc.horizon, problem.mpc.system.m, len(center)
    answers = M.reshape(B, N, m, N, gamma.shape[1]) @ np.linalg.pinv(gamma)
    plan = problem.inputs(v) - np.einsum("bimjp,p->bim", answers, center)
    return AffinePolicies(plan, answers.reshape(B, N, m, N, p))


def policy_labels(
    problem: PolicyProblem,
    points: np.ndarray,
    chunk: int | None = None,
    devices: Any = None,
    most: int = MOST_PROGRAMS,
) -> Labels:
    """Return the labels of points (B, d), not finite ones too, with their proofs: a
    `PolicyVerdict`. most: points that get a ray of their own. Raises ValueError as `PolicyHull.of`
    does."""
    found = policy_hull(problem)
    begun, compiled = time.perf_counter(), Compiled.seconds
    chosen = chosen_devices(devices)
    size = divisible(min(chunk or default_chunk(64), max(len(points), 1)), chosen)
    prepare, ends = compiled_ends(chosen)

    def labelled(part: np.ndarray) -> Any:
        x, usable = prepare.run(part)
        return to_host(ends.run(compiled_policy_labels(chosen).run(found.hull, x), usable))

    none = np.zeros(0, np.int8), np.zeros(0, np.int8)
    with jax.enable_x64(True):
        label, status = joined([none, *(p.result for p in each_part(labelled, points, size))])
    verdict = OnDemand(functools.partial(_verdicts, found, points, label, chosen))
    labels = Labels.proved(label, status, verdict.get, POLICY_PROOFS)
    left = labels.undecided[:most]
    if len(left):
        labels = _by_rays(found, labels, points, left)
    compile_seconds = Compiled.seconds - compiled
    run_seconds = time.perf_counter() - begun - compile_seconds
    return replace(labels, compile_seconds=compile_seconds, run_seconds=run_seconds)


def _verdicts(
    found: PolicyHull, x: np.ndarray, label: np.ndarray, devices: Devices
) -> PolicyVerdict:
    """Return the verdicts on points (B, d) by the hull; nothing for others."""
    x = np.where(np.isfinite(x).all(axis=1)[:, None], x, 0.0)
    whole = padded(x, divisible(len(x), devices))
    with jax.enable_x64(True):
        proofs = to_host(compiled_proofs(devices).run(found.hull, whole))
    w, _, cone, normal, offset = first_rows(proofs, len(x))
    problem = found.rays.problem
    plan, _ = found.split(w)
    none = np.broadcast_to(np.nan, (len(x), *problem.answer_shape))
    return PolicyVerdict(label, problem.view.states(x), plan, normal, offset, cone, none)


@functools.cache
def compiled_proofs(devices: Devices) -> Compiled:
    """Return the compiled proofs: (hull, points (B, d)) → values, labels, cones, normals and
    offsets."""

    def one(hull: Hull, theta: Array) -> tuple[Array, ...]:
        found, cone, facet = label(hull, theta)
        value = hull.value + jnp.sum(hull.slope[cone] * (theta - hull.center), axis=1)
        normal = hull.normals[facet]
        offset = proofs.offset_at(normal, hull.offsets[facet], theta)
        return value, found, cone, normal, offset

    return over_devices(jax.vmap(one, in_axes=(None, 0)), devices, (False, True))


def _by_rays(found: PolicyHull, labels: Labels, x: np.ndarray, left: np.ndarray) -> Labels:
    """Return the labels where a ray from the centre through each point that is left decides."""
    points, problem = x[left], found.rays.problem
    inside, policies, ends = found.by_rays(points)
    a, b, w = (np.asarray(v) for v in ends.cuts)
    with jax.enable_x64(True):
        outside = np.asarray(proofs.excludes(*map(jnp.asarray, (a, b, w, points))))
    label = np.where(inside, 1, np.where(outside, -1, 0)).astype(np.int8)
    plan, answer = found.split(policies)
    offset = np.where(np.sum(a * points, axis=1) > ends.offsets, ends.offsets, np.inf)
    own = np.full(len(points), -1, np.int32)
    start = problem.view.states(points)
    verdict = PolicyVerdict(label, start, plan, a, offset, own, answer)
    more = Labels.proved(label, STATUSES[label], lambda: verdict, POLICY_PROOFS)
    return labels.changed(left, more.label, more.status, more.proofs)
