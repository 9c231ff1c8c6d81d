"""RobotMap: states of a robot with what the linear model predicts and what the robot did.

Each state is labelled twice. The linear model predicts limits kept by a plan that exists, by proof
(`map_feasible_set`), or plans at every time step of the linear closed loop
(`recursive_feasibility`). The robot's own closed loop, nonlinear and simulated in MJX, does what is
predicted or fails. The robot's labels are measured over T time steps, not proved.
"""

from collections.abc import Sequence
from dataclasses import fields
from functools import cached_property
from typing import Any

import numpy as np

from jaxmpc.closed_loop.outcome import with_limits
from jaxmpc.closed_loop.simulation import Run
from jaxmpc.feasible.map import FeasibleSetMap
from jaxmpc.pytrees import record
from jaxmpc.qp.status import Status
from jaxmpc.recursion.report import RecursionReport
from jaxmpc.robots.linear_plant import LinearPlant
from jaxmpc.robots.robot import Robot
from jaxmpc.sets.limits import rows_kept, worst_violation

# What a map can look at, in words.
CLAIMS = {"limits": "all limits kept", "recursion": "a plan at each time step"}
# What becomes of a state: (predicted, held) by outcome.
OUTCOMES = {
    "predicted, kept": (1, 1),
    "predicted, failed": (1, -1),
    "not predicted, failed": (-1, -1),
    "not predicted, kept": (-1, 1),
}


@record
class RobotLoops:
    """What b closed loops of T time steps did.

    worst (b,): the most by which a state (0 … T) or an input exceeds a limit of the robot, in the
    units of that limit; NaN where something is not finite. broken_at (b,): first time step 0 … T
    with a limit not kept or a number that is not finite, −1 for none. lost_at (b,): first time
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

    @classmethod
    def joined(cls, parts: "Sequence[RobotLoops]") -> "RobotLoops":
        """Return the loops of all parts, one after the other."""
        names = [field.name for field in fields(cls)]
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@record
class RobotMap:
    """States of a robot with what the linear model predicts and what became of it.

    Its x0s (B, d) are in the coordinates `axes` of ξ, the other coordinates at `linear.fixed`.

    claim: "limits", linear.label predicts for a state that all limits are kept for T time steps,
    and it holds where the robot keeps them; or "recursion", the linear closed loop predicts a plan
    at each of T time steps, and it holds where the robot has them.
    linear: the map of the linear problem, x_0 within the robot's limits included.
    recursion: the report of the second claim, None for the first; its states are deviations from
    set_point. loops: what the robot did. steps: T, of dt seconds each.
    set_point (n,): about which the model is linear.
    """

    robot: Robot | LinearPlant
    claim: str
    linear: FeasibleSetMap
    recursion: RecursionReport | None
    loops: RobotLoops
    steps: int
    set_point: np.ndarray

    @property
    def x0s(self) -> np.ndarray:
        """Return the mapped coordinates (B, d)."""
        return self.linear.x0s

    @property
    def states(self) -> np.ndarray:
        """Return all coordinates ξ (B, n)."""
        return self.linear.problem.view.states(self.x0s)

    @property
    def axis_names(self) -> tuple[str, ...]:
        """Return the labels of the mapped coordinates with their units."""
        return self.linear.axis_names

    @property
    def seconds(self) -> float:
        """Return the length of the closed loops."""
        return self.steps * self.robot.dt

    @property
    def within_limits(self) -> np.ndarray:
        """Return whether the robot kept all its limits, without margin, at all T+1 time steps, and
        every number was finite, (B,)."""
        return self.loops.broken_at < 0

    @property
    def recursive(self) -> np.ndarray:
        """Return (B,) int8: 1 a plan without fallback at each of T time steps, −1 none at time step
        `loops.lost_at`, 0 undecided because an earlier plan is not SOLVED."""
        lost, unsolved = self.loops.lost_at, self.loops.unsolved_at
        open_ = (unsolved >= 0) & ((lost < 0) | (unsolved < lost))
        return np.select([open_, lost >= 0], [0, -1], 1).astype(np.int8)

    @property
    def predicted(self) -> np.ndarray:
        """Return what the linear model predicts, (B,) int8: 1 what the claim says, −1 the contrary,
        by proof, 0 undecided."""
        report = self.recursion
        if report is None:
            return self.linear.label
        loops = report.loops
        lost = (loops.lost_at > 0) | (loops.label == -1)
        return np.select([loops.lost_at == 0, lost], [1, -1], 0).astype(np.int8)

    @property
    def held(self) -> np.ndarray:
        """Return what the robot did, (B,) int8: 1 what the claim says, −1 not, 0 undecided."""
        if self.claim == "recursion":
            return self.recursive
        return np.where(self.within_limits, 1, -1).astype(np.int8)

    @property
    def broken(self) -> np.ndarray:
        """Return whether the linear model predicted what the robot then failed to do, (B,)."""
        return (self.predicted == 1) & (self.held == -1)

    @property
    def first_loss(self) -> np.ndarray:
        """Return the time step at which the robot failed the claim first, (B,); −1 where it did
        not."""
        found = self.loops.lost_at if self.claim == "recursion" else self.loops.broken_at
        return np.where(self.held == -1, found, -1)

    @property
    def unsure(self) -> np.ndarray:
        """Return whether a failure against the prediction was preceded by a plan that is not
        SOLVED, (B,): the solver may be to blame, not the model."""
        unsolved = self.loops.unsolved_at
        return self.broken & (unsolved >= 0) & (unsolved < self.first_loss)

    @property
    def outcome(self) -> np.ndarray:
        """Return the index into `OUTCOMES`, (B,) int; their number for undecided."""
        same = [(self.predicted == p) & (self.held == h) for p, h in OUTCOMES.values()]
        return np.select(same, range(len(same)), len(same))

    def counts(self) -> dict[str, dict[str, int]]:
        """Return the table prediction × robot: of how many states each kind of prediction held,
        failed, or is open since a plan of the robot was not solved."""
        words = {1: "kept", -1: "failed", 0: "unsolved"}
        predictions = {1: "predicted", -1: "not predicted", 0: "undecided"}
        return {
            name: {
                word: int(np.sum((self.predicted == p) & (self.held == h)))
                for h, word in words.items()
            }
            for p, name in predictions.items()
        }

    def plan_counts(self) -> dict[str, int]:
        """Return how many of all B·T plans had which status; statuses that did not occur are left
        out."""
        totals = self.loops.statuses.sum(axis=0)
        return {s.name: int(k) for s, k in zip(Status, totals, strict=True) if k}

    @cached_property
    def depth(self) -> np.ndarray:
        """Return how deep states lie in the linear feasible set, (B,): 1 at the middle of the
        points proved feasible, 0 on the outer bound, negative outside; NaN where no half-space is
        proved.

        1 − max_i a_i'(x − m) / (b_i − a_i'm) over the proved half-spaces a_i'x ≤ b_i: one minus
        Minkowski's gauge of their intersection about m.
        """
        normals, offsets = self.linear.cuts()
        inside = self.x0s[self.linear.label == 1]
        if not len(offsets) or not len(inside):
            return np.full(len(self.x0s), np.nan)
        middle = inside.mean(axis=0)
        room = offsets - normals @ middle
        with np.errstate(invalid="ignore", divide="ignore"):
            scaled = normals / room[:, None]
            return 1 - np.max((self.x0s - middle) @ scaled.T, axis=1)

    def worst(self) -> int | None:
        """Return the index of the failure against the prediction deepest in the linear feasible
        set; None without any."""
        found = np.flatnonzero(self.broken)
        if not len(found):
            return None
        return int(found[np.argmax(np.nan_to_num(self.depth[found], nan=-np.inf))])

    def summary(self) -> dict[str, Any]:
        """Return the counts of the map and its deepest failure as JSON data."""
        worst, report = self.worst(), self.recursion
        linear: dict[str, Any] = {
            "counts": self.linear.counts(),
            "volume": list(self.linear.volume_bounds()),
        }
        if report is not None:
            claims = {name: str(claim) for name, claim in report.claims.items()}
            linear["recursion"] = claims | {"counts": report.loops.counts()}
        deepest = None
        if worst is not None:
            deepest = {
                "state": self.states[worst].tolist(),
                "step": int(self.first_loss[worst]),
                "beyond": self.loops.worst[worst],
            }
        return {
            "name": self.robot.name,
            "claim": self.claim,
            "counts": self.counts(),
            "broken": int(np.sum(self.broken)),
            "broken_after_an_unsolved_plan": int(np.sum(self.unsure)),
            "deepest_broken": deepest,
            "linear": linear,
            "plans": self.plan_counts(),
            "seconds": self.seconds,
        }

    def __str__(self) -> str:
        """Return the claim, table of counts, statuses and the deepest failure, one a line."""
        span = f"{self.seconds:g} {self.robot.time_unit}"
        what = f"{CLAIMS[self.claim]} for {span}, {self.steps} time steps"
        rows = [("claim", what)]
        for name, row in self.counts().items():
            if sum(row.values()) or name != "undecided":
                cells = "".join(f"{k:>10,} {word}" for word, k in row.items() if k)
                rows.append((name, f"{sum(row.values()):>10,}  {cells}"))
        percent = f"{np.mean(self.broken):.2%}, {np.sum(self.unsure):,} after a plan not SOLVED"
        rows.append(("predicted, failed", f"{np.sum(self.broken):>10,}  {percent}"))
        rows.append(("plans", ", ".join(f"{k:,} {n}" for n, k in self.plan_counts().items())))
        i = self.worst()
        if i is not None:
            pairs = zip(self.axis_names, self.x0s[i], strict=True)
            at = ", ".join(f"{name} = {value:.4g}" for name, value in pairs)
            when = f"fails at time step {self.first_loss[i]}"
            beyond = f"most beyond a limit {self.loops.worst[i]:.3g}"
            rows.append(("deepest of these", f"{at}: {when}, {beyond}"))
        return "\n".join(f"  {name:<17} {value}" for name, value in rows)

    __repr__ = __str__


def _with_last(inputs: np.ndarray) -> np.ndarray:
    """Return what is known of inputs (b, T) by the states (b, T+1) that they leave."""
    return np.pad(inputs, ((0, 0), (0, 1)))


def _first(flags: np.ndarray) -> np.ndarray:
    """Return the index of the first True of each row, −1 for none."""
    return np.where(flags.any(axis=1), np.argmax(flags, axis=1), -1)
