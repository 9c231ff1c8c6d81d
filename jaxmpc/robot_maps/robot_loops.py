"""What the closed loops of a robot did: limits kept or exceeded, plans found or not."""

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from jaxmpc.closed_loop.outcome import with_limits
from jaxmpc.closed_loop.simulation import Run
from jaxmpc.pytrees import record
from jaxmpc.qp.status import Status
from jaxmpc.robots.linear_plant import LinearPlant
from jaxmpc.robots.robot import Robot
from jaxmpc.sets.limits import rows_kept, worst_violation


@record
class RobotLoops:
    """What b closed loops of T time steps did.

    worst (b,): the most by which a state (0 … T) or an input exceeds a limit of the robot, in the
    units of that limit; NaN where something is not finite. broken_at (b,): first time step 0 … T
    with a limit not `kept` or a number that is not finite, −1 for none. lost_at (b,): first time
    step 0 … T−1 at which the state is beyond its limits or its plan, SOLVED, violates soft rows
    (`Run.fallback`): there the hard problem has no plan whose multipliers stay below the
    controller's rho. −1: none. unsolved_at (b,): first time step whose plan is not SOLVED, −1 for
    none. statuses (b, S): how many plans had each `Status`, in the order of the enumeration.
    """

    worst: np.ndarray
    broken_at: np.ndarray
    lost_at: np.ndarray
    unsolved_at: np.ndarray
    statuses: np.ndarray

    @classmethod
    def of(cls, run: Run, robot: Robot | LinearPlant, dtype: Any) -> "RobotLoops":
        """Evaluate closed loops (batch axis in front), run in `dtype`, by the robot's own
        limits."""
        states, inputs = with_limits(robot, run)
        worst = np.maximum(worst_violation(*states), _with_last(worst_violation(*inputs)))
        state_kept, input_kept = (
            np.all(rows_kept(*pair, dtype), axis=-1) for pair in (states, inputs)
        )
        beyond = ~state_kept | _with_last(np.logical_not(input_kept))
        status = np.asarray(run.status)
        solved = status == Status.SOLVED
        return cls(
            worst=worst.max(axis=1),
            broken_at=_first(beyond),
            lost_at=_first(beyond[:, :-1] | (solved & np.asarray(run.fallback))),
            unsolved_at=_first(~solved),
            statuses=np.stack([np.sum(status == s, axis=1) for s in Status], axis=1),
        )

    def first(self, count: int) -> "RobotLoops":
        """Return the first so many loops."""
        return RobotLoops(*(values[:count] for values in vars(self).values()))

    @classmethod
    def joined(cls, parts: "Sequence[RobotLoops]") -> "RobotLoops":
        """Return the loops of all parts, one after the other."""
        names = [field.name for field in fields(cls)]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _with_last(inputs: np.ndarray) -> np.ndarray:
    """Return what is known of inputs (b, T) by the states (b, T+1) that they leave."""
    return np.pad(inputs, ((0, 0), (0, 1)))


def _first(flags: np.ndarray) -> np.ndarray:
    """Return the index of the first True of each row, −1 for none."""
    return np.where(flags.any(axis=1), np.argmax(flags, axis=1), -1)
