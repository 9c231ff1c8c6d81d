"""Ascent over the regions of the MPC law: to states whose next state leaves a polytope.

The law is piecewise affine in the state. So a convex function of the next state can be raised by
its gradient, and on a region be maximised exactly by a linear program.
"""

import time

import numpy as np

from jaxmpc.explicit.law_at_states import Law
from jaxmpc.feasible.plan_polytope import CenteredPolytope
from jaxmpc.qp.status import Status
from jaxmpc.sets.lp import maximise

# Gradient ascent: distance kept from the half-spaces (on the boundary only one plan is feasible,
# and solvers converge slowly), and step lengths; relative to the size of the set.
INSET = 1e-6
LENGTHS = 0.3 * 0.5 ** np.arange(16)
# Then the search goes from region to region: with how many states at once, in how many rounds, from
# how many neighbours at what distance.
FOLLOWED, ROUNDS, NEIGHBOURS, NEAR = 6, 10, 4, 1e-4


def ascend(law: Law, bound: CenteredPolytope, starts: np.ndarray, deadline: float) -> np.ndarray:
    """Return states (K, p) from which the next state lies farthest outside `bound`, the best first.

    starts (S, p) follow the gradient (A + B ∂u_0/∂x)'a_j of v(x) = max_j (a_j'x⁺(x) − b_j) within
    the half-spaces, in steps of halving length, in coordinates in which the set is about 1 wide;
    a_j and b_j count relative to the facet's distance from the centre. A step is taken if it raises
    v. Then the best go from region to region, each to the maximum of a_j'x⁺ on its region. The
    method is local: that it finds no counterexample does not prove that there is none.
    """
    x = bound.nearest(starts, INSET)
    value, gradient = _value_and_gradient(law, bound, x, deadline)
    for length in LENGTHS:
        if time.monotonic() > deadline:
            break
        trial = bound.nearest(x + length * bound.unit * gradient, INSET)
        better, slope = _value_and_gradient(law, bound, trial, deadline, than=value)
        grown = better > value
        x[grown], value[grown], gradient[grown] = trial[grown], better[grown], slope[grown]
    return _climb_regions(law, bound, x, value, deadline)


def _value_and_gradient(
    law: Law,
    bound: CenteredPolytope,
    x: np.ndarray,
    deadline: float,
    than: np.ndarray | float = -np.inf,
) -> tuple[np.ndarray, np.ndarray]:
    """Return v (S,) at x (S, p), −inf where there is no plan, and its unit gradient in coordinates
    x / bound.unit where v > than, and before the deadline."""
    plans = law.plans(x)
    after = law.following(x, plans.inputs[:, 0])
    beyond = (after @ bound.normals.T - bound.offsets) / bound.depths
    value = np.where(plans.status == Status.SOLVED, beyond.max(axis=1), -np.inf)
    gradient = np.zeros_like(x)
    for i in np.flatnonzero((value > than) & np.isfinite(value)):
        if time.monotonic() > deadline:
            break
        piece = law.piece(x[i], plans.inputs[i])
        if piece is not None:
            slope = bound.unit * (piece.E.T @ bound.normals[np.argmax(beyond[i])])
            gradient[i] = slope / (np.linalg.norm(slope) or 1.0)
    return value, gradient


def _climb_regions(
    law: Law, bound: CenteredPolytope, x: np.ndarray, value: np.ndarray, deadline: float
) -> np.ndarray:
    """Follow the best of x (S, p) to the best vertex of its region, and on from beside it; return
    states (K, p)."""
    random = np.random.default_rng(0)
    order = np.argsort(-value)[:FOLLOWED]
    best, top = x[order], value[order]
    for tried in range(ROUNDS):
        if time.monotonic() > deadline:
            break
        beside = random.standard_normal((NEIGHBOURS, *best.shape)) * NEAR * bound.unit
        around = bound.nearest(np.concatenate([best, *(best + beside)]), INSET)
        peaks, heights = _peaks(law, bound, around, deadline)
        states, values = np.concatenate([best, peaks]), np.append(top, heights)
        chosen: list[int] = []
        for i in np.argsort(-values):
            if all(np.any(np.abs(states[i] - states[j]) > 1e-6 * bound.unit) for j in chosen):
                chosen.append(int(i))
        before, chosen = top.max(initial=-np.inf), chosen[:FOLLOWED]
        best, top = states[chosen], values[chosen]
        if tried > 1 and top.max(initial=-np.inf) <= before + 1e-12:
            break
    return best


def _peaks(
    law: Law, bound: CenteredPolytope, around: np.ndarray, deadline: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the best states (K, p) of the regions of some states (B, p), and how far outside the
    bound their next states lie (K,)."""
    plans = law.plans(around)
    peaks, values = [np.zeros((0, around.shape[1]))], []
    for i in np.flatnonzero(plans.status == Status.SOLVED):
        if time.monotonic() > deadline:
            break
        state, piece = around[i], law.piece(around[i], plans.inputs[i])
        if piece is None:
            continue
        off = bound.normals @ (piece.E @ state + piece.e) - bound.offsets
        facet = int(np.argmax(off / bound.depths))
        up = piece.E.T @ bound.normals[facet]
        R = np.vstack([piece.R, bound.normals])
        peak = maximise(up, R, np.append(piece.r, bound.offsets)).x
        if peak is not None:
            peaks.append(peak[None])
            values.append(float(bound.beyond((piece.E @ peak + piece.e)[None])[0]))
    return np.concatenate(peaks), np.array(values)
