"""Counterexamples to the MPC law: a state with a plan whose next state has none, both proved."""

from dataclasses import replace

import numpy as np

from jaxmpc.explicit.law_at_states import Law
from jaxmpc.feasible.plan_polytope import CenteredPolytope
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.proofs import first_of_block
from jaxmpc.feasible.rays import BACKOFFS, Rays, ray_directions
from jaxmpc.qp.status import Status
from jaxmpc.recursion.claims import CLEAR, Counterexample
from jaxmpc.recursion.proofs import Claims
from jaxmpc.recursion.sampled_loops import SampledLoops

STARTS = 96


def outer_bound(claims: Claims) -> tuple[CenteredPolytope | None, np.ndarray]:
    """Return half-spaces of X_N and starts (S, p) near its boundary; None and no starts if there
    are none."""
    body, p = claims.feasible_set, claims.problem.dimension
    random = np.random.default_rng(0)
    if body is not None and len(body.vertices):
        # Vertices, middles of facets, and random points of facets: convex combinations.
        parts = [body.vertices]
        tight = body.offsets - body.vertices @ body.normals.T <= 1e-7 * body.depths
        corners = [body.vertices[column] for column in tight.T]
        parts += [part.mean(axis=0, keepdims=True) for part in corners]
        while sum(map(len, parts)) < STARTS:
            parts += [random.dirichlet(np.ones(len(part)), 1) @ part for part in corners]
        return body, np.concatenate(parts)
    try:
        directions = np.concatenate([ray_directions(STARTS, p), np.eye(p), -np.eye(p)])
        rays = Rays.of(claims.problem).cast(directions)
    except ValueError:  # empty or flat
        return None, np.zeros((0, p))
    valid = np.isfinite(rays.offsets) & np.any(rays.normals != 0, axis=1)
    found = np.all(np.isfinite(rays.points), axis=1)
    if body is not None and found.any():
        return replace(body, center=rays.center), rays.points[found]
    if not valid.any() or not found.any():
        return None, np.zeros((0, p))
    length = np.linalg.norm(rays.normals[valid], axis=1)
    half = np.column_stack([rays.normals[valid] / length[:, None], rays.offsets[valid] / length])
    # The same where they agree to 9 digits, in units of like size.
    like = half / (half[:, p:] - half[:, :p] @ rays.center[:, None])
    like = like / np.abs(like).max(axis=0)
    half = half[np.unique(np.round(like, 9), axis=0, return_index=True)[1]]
    none = np.zeros((0, p))
    return CenteredPolytope(rays.center, half[:, :p], half[:, p], none), rays.points[found]


def farthest_first(bound: CenteredPolytope, after: np.ndarray) -> np.ndarray:
    """Return the indices of next states, the farthest outside first, NaN last."""
    return np.argsort(-np.nan_to_num(bound.beyond(after), nan=-np.inf))


def worst_samples(bound: CenteredPolytope, loops: SampledLoops) -> np.ndarray:
    """Return up to three of the samples (B, p) lost after one step, farthest outside."""
    lost = np.flatnonzero(loops.lost_at == 1)
    return loops.x0s[lost[farthest_first(bound, loops.next_states[lost])[:3]]]


def certified(
    law: Law,
    problem: FeasibilityProblem,
    bound: CenteredPolytope | None,
    candidates: np.ndarray,
    found: list[str],
) -> Counterexample | None:
    """Return the candidate (K, p) whose next state is farthest outside, with both ends proved; or
    None.

    Each candidate is moved towards the centre by the least amount that lets a plan be proved.
    """
    if bound is None or not len(candidates):
        return None
    rays = Rays.of(problem, bound.center)
    states, feasible, proved = _proved_plans(rays, candidates)
    plans = law.plans(states)
    inputs = plans.inputs.copy()
    inputs[:, 0] = law.limited(inputs[:, 0])
    after = law.following(states, inputs[:, 0])
    good = proved & (plans.status == Status.SOLVED)
    outside = np.where(good, bound.beyond(after), -np.inf)
    for best in np.argsort(-outside)[: len(candidates)]:
        if not outside[best] > CLEAR:
            break
        normal, offset = _deepest(rays, bound, after[best])
        distance = float((normal @ after[best] - offset) / np.linalg.norm(normal))
        if normal @ after[best] - offset > CLEAR * (offset - normal @ bound.center):
            return Counterexample(
                state=states[best],
                inputs=inputs[best],
                next_state=after[best],
                normal=normal,
                offset=offset,
                distance=distance,
                feasible_inputs=feasible[best],
                primal_residual=float(plans.primal_residual[best]),
                dual_residual=float(plans.dual_residual[best]),
                found=found[best // len(BACKOFFS)],
            )
    return None


def _proved_plans(rays: Rays, candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return states (K·S, p) that lead from each candidate (K, p) towards the centre by S small
    steps, inputs (K·S, N, m), and whether they are proved to keep all rows from there.

    State and plan lie between those of the centre and those of where the ray through the candidate
    leaves X_N, or the candidate's own where it never does.
    """
    states, plans, multipliers = [], [], []
    for direction in candidates - rays.center:
        t, w, y = rays.problem.programs.ray(rays.center, direction)
        if not np.isfinite(t):
            try:
                t, w = 1.0, rays.problem.programs.center(rays.center + direction)[1]
            except ValueError:  # no margin there
                t, w = 0.0, rays.w
        reach = (min(t, 1.0) * (1 - BACKOFFS))[:, None]
        states.append(rays.center + reach * direction)
        plans.append(rays.w + reach / max(t, 1e-300) * (w - rays.w))
        multipliers.append(y)
    theta, w = np.array(states), np.array(plans)
    proved = rays.prove(theta, w, np.array(multipliers)).feasible.ravel()
    theta, rows, exact = np.concatenate(states), rays.problem.rows, rays.exact
    inputs = np.einsum("kmz,bz->bkm", rows.Omega, np.concatenate(plans) @ rows.back.T)
    inputs += np.einsum("kmp,bp->bkm", rows.Psi, theta) + rows.psi
    # As the proof takes them.
    inputs = np.clip(inputs, exact.u_lower, exact.u_upper)[:, first_of_block(exact.moves)]
    return theta, inputs, proved


def _deepest(rays: Rays, bound: CenteredPolytope, x: np.ndarray) -> tuple[np.ndarray, float]:
    """Return, of the half-spaces proved by rays that end on the side of x, the one that x violates
    most."""
    facet = int(np.argmax((bound.normals @ x - bound.offsets) / bound.depths))
    depth = bound.normals[facet] @ x - bound.offsets[facet]
    across = bound.normals[facet] * bound.unit**2  # perpendicular in units of like size
    towards = x - depth / (bound.normals[facet] @ across) * across
    cast = rays.cast(np.array([x, bound.nearest(x[None])[0], towards]) - rays.center)
    with np.errstate(invalid="ignore", divide="ignore"):
        depths = (cast.normals @ x - cast.offsets) / (cast.offsets - cast.normals @ rays.center)
    best = int(np.argmax(np.nan_to_num(depths, nan=-np.inf)))
    return cast.normals[best], float(cast.offsets[best])
