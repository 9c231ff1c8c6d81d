"""Closed loops of the MPC law from many states, until the problem is proved infeasible."""

import numpy as np
from tqdm.std import tqdm

from jaxmpc.explicit.law_at_states import Law
from jaxmpc.feasible.labels import Labels
from jaxmpc.feasible.map import FeasibleSetMap, map_points
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.pytrees import record
from jaxmpc.qp.status import Status
from jaxmpc.recursion.claims import CLEAR
from jaxmpc.recursion.time_budget import Budget

# `lost_at` of states that are infeasible from the start, and of those that were not decided.
NOT_FEASIBLE, UNDECIDED = -1, -2


@record
class SampledLoops:
    """Closed loops of `steps` steps from B states x0s (B, p); B = 0 where there are none.

    labels: the labels of x0s with their proofs. inputs (B, m), next_states (B, p): the optimal
    first input and where it leads (NaN where label ≠ 1). lost_at (B,): first step k ≥ 1 of the
    closed loop at which the problem is proved infeasible; 0: feasible at all steps; −1: not proved
    feasible at the start; −2: undecided, from step undecided_at (B,) on (0 elsewhere).
    """

    x0s: np.ndarray
    labels: Labels
    inputs: np.ndarray
    next_states: np.ndarray
    lost_at: np.ndarray
    undecided_at: np.ndarray
    steps: int

    @classmethod
    def undecided(cls, problem: FeasibilityProblem, x0s: np.ndarray, steps: int) -> "SampledLoops":
        """Return loops from states (B, p) that there was no time to label."""
        return cls._begun(problem, x0s, Labels.empty(len(x0s), problem), steps)

    @classmethod
    def _begun(
        cls, problem: FeasibilityProblem, x0s: np.ndarray, labels: Labels, steps: int
    ) -> "SampledLoops":
        """Return loops from labelled states before the first step."""
        return cls(
            x0s=x0s,
            labels=labels,
            inputs=np.full((len(x0s), problem.mpc.system.m), np.nan),
            next_states=np.full_like(x0s, np.nan),
            lost_at=np.where(labels.label == 1, 0, NOT_FEASIBLE),
            undecided_at=np.zeros(len(x0s), int),
            steps=steps,
        )

    @property
    def label(self) -> np.ndarray:
        """Return the labels (B,): 1 proved feasible, −1 proved infeasible, 0 undecided."""
        return self.labels.label

    def counts(self) -> dict[str, int]:
        """Return how many states are feasible, and how many of these are lost at once, lost later,
        kept, undecided."""
        lost = self.lost_at
        return {
            "feasible": int(np.sum(self.label == 1)),
            "lost after one step": int(np.sum(lost == 1)),
            "lost later": int(np.sum(lost > 1)),
            "kept": int(np.sum(lost == 0)),
            "undecided": int(np.sum(lost == UNDECIDED)),
        }


def labelled(law: Law, problem: FeasibilityProblem, states: np.ndarray) -> Labels:
    """Return the labels of states (B, p or more columns), in programs of the law's shape."""
    padded = law.filled(states[:, : problem.dimension])
    fmap: FeasibleSetMap = map_points(problem, padded, chunk=law.chunk)
    return fmap.labels.first(len(states))


def closed_loops(
    law: Law,
    problem: FeasibilityProblem,
    x0s: np.ndarray,
    labels: Labels,
    steps: int,
    budget: Budget,
) -> SampledLoops:
    """Run the closed loop from every feasible state until it is lost, undecided or over.

    The states that are left when the time is over are undecided.
    """
    loops, p = SampledLoops._begun(problem, x0s, labels, steps), x0s.shape[1]
    lost_at, undecided_at = loops.lost_at, loops.undecided_at
    feasible = labels.label == 1
    center = x0s[feasible].mean(axis=0) if np.any(feasible) else np.zeros(p)
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
            loops.inputs[alive], loops.next_states[alive] = u, x[:, :p]
        x[:, :p] = center + (1 - CLEAR) * (x[:, :p] - center)
        label = labelled(law, problem, x).label
        solved = plans.status == Status.SOLVED
        undecided = alive[~solved | (label == 0)]
        lost_at[alive[solved & (label == -1)]] = k
        lost_at[undecided], undecided_at[undecided] = UNDECIDED, k
        states[alive] = x
    return loops
