"""Counterexamples to the MPC law: a state with a plan whose next state has none, both proved."""

from dataclasses import replace

import numpy as np

from jaxmpc.explicit.law import Law
from jaxmpc.feasible.centered_polytope import CenteredPolytope
from jaxmpc.feasible.map import FeasibleSetMap
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.rays import Rays, ray_directions
from jaxmpc.qp.status import Status
from jaxmpc.recursion.claims import CLEAR, Claims
from jaxmpc.recursion.loops import LawLoops, map_states
from jaxmpc.recursion.report import Counterexample

STARTS = 96
# How far a counterexample is moved towards the centre, tried in turn, until its plan is proved.
BACKOFFS = 10.0 ** np.arange(-8, -3)


def outer_bound(claims: Claims) -> tuple[CenteredPolytope | None, np.ndarray]:
    """Return half-spaces of X_N and starts (S, p) near its boundary; None and no starts if there
    are none."""
    body, p = claims.feasible_set, claims.problem.dimension
    random = np.random.default_rng(0)
    if body is not None and len(body.vertices):
        # Vertices, middles of facets, and random points of facets: convex combinations.
        parts = [body.vertices]
        tight = body.offsets - body.vertices @ body.normals.T <= 1e-7 * body.size
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
    half = half[np.unique(np.round(half, 9), axis=0, return_index=True)[1]]
    none = np.zeros((0, p))
    return CenteredPolytope(rays.center, half[:, :p], half[:, p], none), rays.points[found]


def farthest_first(bound: CenteredPolytope, after: np.ndarray) -> np.ndarray:
    """Return the indices of next states, the farthest outside first, NaN last."""
    return np.argsort(-np.nan_to_num(bound.signed_distance(after), nan=-np.inf))


def worst_samples(bound: CenteredPolytope, x0s: np.ndarray, loops: LawLoops) -> np.ndarray:
    """Return up to three of the samples (B, p) lost after one step, farthest outside."""
    lost = np.flatnonzero(loops.lost_at == 1)
    return x0s[lost[farthest_first(bound, loops.next_states[lost])[:3]]]


def certified(
    law: Law,
    problem: FeasibilityProblem,
    bound: CenteredPolytope | None,
    candidates: np.ndarray,
    found: list[str],
) -> Counterexample | None:  # fmt: skip
    """Return the candidate (K, p) whose next state is farthest outside, with both ends proved; or
    None.

    Each candidate is moved towards the centre by the least amount that lets its plan be proved.
    """
    if bound is None or not len(candidates):
        return None
    moved = bound.center + (1 - BACKOFFS)[:, None, None] * (candidates - bound.center)
    states = moved.reshape(-1, candidates.shape[1])
    plans = law.plans(states)
    inputs = plans.inputs.copy()
    inputs[:, 0] = law.limited(inputs[:, 0])
    after = law.following(states, inputs[:, 0])
    fmap = map_states(law, problem, np.concatenate([states, after]))
    here, there = np.split(fmap.label, 2)
    good = (here == 1) & (there == -1) & (plans.status == Status.SOLVED)
    outside = np.where(good, bound.signed_distance(after), -np.inf)
    if not np.any(outside > CLEAR * bound.size):
        return None
    best = int(np.argmax(outside))
    normal, offset = _deepest(problem, bound, fmap, after[best])
    distance = float((normal @ after[best] - offset) / np.linalg.norm(normal))
    return Counterexample(
        states[best], inputs[best], after[best], normal, offset, distance,
        fmap.labels.plans[best], float(plans.primal_residual[best]),
        float(plans.dual_residual[best]), found[best % len(candidates)],
    )  # fmt: skip


def _deepest(
    problem: FeasibilityProblem, bound: CenteredPolytope, fmap: FeasibleSetMap, x: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return, of the half-spaces proved by labels and by rays that end on the side of x, the one
    that x violates most."""
    normals, offsets = fmap.cuts()
    facet = int(np.argmax(bound.normals @ x - bound.offsets))
    depth = bound.normals[facet] @ x - bound.offsets[facet]
    towards = np.array([x, bound.nearest(x[None])[0], x - depth * bound.normals[facet]])
    rays = Rays.of(problem, bound.center).cast(towards - bound.center)
    valid = np.isfinite(rays.offsets)
    normals = np.concatenate([normals, rays.normals[valid]])
    offsets = np.concatenate([offsets, rays.offsets[valid]])
    depth = (normals @ x - offsets) / np.linalg.norm(normals, axis=1)
    best = int(np.nanargmax(depth))
    return normals[best], float(offsets[best])
