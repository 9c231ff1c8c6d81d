"""What the closed loops of a robot did: limits kept or exceeded, plans found or not."""

from typing import Any

import numpy as np

from jaxmpc.closed_loop.outcome import with_limits
from jaxmpc.closed_loop.run import Run
from jaxmpc.pytrees import record
from jaxmpc.qp.status import Status
from jaxmpc.sets.violations import kept, worst_violation


@record
class RobotLoops:
    """What b closed loops of T samples did.

    worst (b,): the most by which a state (T+1 samples) or an input exceeds a limit of the robot, in
    the units of that limit; NaN where something is not finite. broken_at (b,): first sample 0 … T
    with a limit not `kept` or a number that is not finite, −1 for none. lost_at (b,):
    first sample 0 … T−1 at which the state is beyond its limits or its plan, SOLVED, violates soft
    rows (`Run.fallback`): there the hard problem has no plan whose multipliers stay below the
    controller's penalty. −1: none. unsolved_at (b,): first sample whose plan is not SOLVED, −1 for
    none. statuses (b, S): how many plans had each `Status`,
    in the order of the enumeration.
    """

    worst: np.ndarray
    broken_at: np.ndarray
    lost_at: np.ndarray
    unsolved_at: np.ndarray
    statuses: np.ndarray

    @classmethod
    def of(cls, run: Run, robot: Any, dtype: Any) -> "RobotLoops":
        """Evaluate closed loops (batch axis in front), run in `dtype`, by the robot's own
        limits."""
        states, inputs = with_limits(robot, run)
        # An input belongs to the sample that it leaves.
        last = lambda v: np.pad(v, ((0, 0), (0, 1)))
        worst = np.maximum(worst_violation(*states), last(worst_violation(*inputs)))
        within = [kept(*pair, dtype).all(axis=-1) for pair in (states, inputs)]
        beyond = ~within[0] | last(~within[1])
        status = np.asarray(run.status)
        solved = status == Status.SOLVED
        lost = beyond[:, :-1] | (solved & np.asarray(run.fallback))
        return cls(
            worst.max(axis=1), _first(beyond), _first(lost), _first(~solved),
            np.stack([np.sum(status == s, axis=1) for s in Status], axis=1),
        )  # fmt: skip


def _first(flags: np.ndarray) -> np.ndarray:
    """Return the index of the first True of each row, −1 for none."""
    return np.where(flags.any(axis=1), np.argmax(flags, axis=1), -1)
