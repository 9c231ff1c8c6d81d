"""Closed loops of the MPC law from many samples, until the problem is proved infeasible."""

import numpy as np
from tqdm.std import tqdm

from jaxmpc.explicit.law import Law
from jaxmpc.feasible.map import FeasibleSetMap, map_points
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.pytrees import record
from jaxmpc.qp.status import Status
from jaxmpc.recursion.proofs import CLEAR
from jaxmpc.recursion.report import NOT_FEASIBLE, UNDECIDED
from jaxmpc.recursion.time_budget import Budget


@record
class LawLoops:
    """Closed loops from B samples; fields as in `RecursionReport`."""

    inputs: np.ndarray
    next_states: np.ndarray
    lost_at: np.ndarray
    undecided_at: np.ndarray


def map_states(law: Law, problem: FeasibilityProblem, states: np.ndarray) -> FeasibleSetMap:
    """Return the labels of states (B, p or more columns), in programs of the law's shape."""
    p, count = problem.dimension, len(states)
    fmap = map_points(problem, law.filled(states[:, :p]), chunk=law.chunk)
    return FeasibleSetMap.of(problem, fmap.x0s[:count], fmap.labels.first(count))


def closed_loops(
    law: Law, problem: FeasibilityProblem, x0s: np.ndarray, label: np.ndarray, steps: int,
    budget: Budget,
) -> LawLoops:  # fmt: skip
    """Run the closed loop from every feasible sample until it is lost, undecided or over.

    The samples that are left when the time is over are undecided.
    """
    count, p = x0s.shape
    lost_at = np.where(label == 1, 0, NOT_FEASIBLE)
    undecided_at = np.zeros(count, int)
    first = np.full((count, law.mpc.system.m), np.nan)
    after = np.full((count, p), np.nan)
    center = x0s[label == 1].mean(axis=0) if np.any(label == 1) else np.zeros(p)
    # The previous input travels along where the plan depends on it.
    states = np.pad(x0s, ((0, 0), (0, law.mpc.dimension - p)))
    for k in tqdm(range(1, steps + 1), unit=" steps", leave=False, disable=not budget.bar):
        alive = np.flatnonzero(lost_at == 0)
        if not len(alive):
            break
        if not budget.affords(0):
            lost_at[alive], undecided_at[alive] = UNDECIDED, k
            break
        plans = law.plans(states[alive])
        u = law.limited(plans.inputs[:, 0])
        x = law.following(states[alive], u)
        if k == 1:
            first[alive], after[alive] = u, x[:, :p]
        x[:, :p] = center + (1 - CLEAR) * (x[:, :p] - center)
        verdict = map_states(law, problem, x).label
        solved = plans.status == Status.SOLVED
        open_ = ~solved | (verdict == 0)
        lost_at[alive[solved & (verdict == -1)]] = k
        lost_at[alive[open_]], undecided_at[alive[open_]] = UNDECIDED, k
        states[alive] = x
    return LawLoops(first, after, lost_at, undecided_at)
