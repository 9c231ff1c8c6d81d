"""Maps of a robot: what the linear model promises of a state, and what the robot then does.

Each state is labelled twice. The promise is the linear model's: a plan that keeps all limits
exists, by proof (`map_feasible_set`), or one exists at every sample of the linear closed loop
(`recursive_feasibility`). The robot's own closed loop, nonlinear and simulated in MJX, keeps the
promise or breaks it. The robot's labels are measured over T samples, not proved.
"""

from functools import cached_property

import numpy as np

from jaxmpc.feasible.map import FeasibleSetMap
from jaxmpc.pytrees import record
from jaxmpc.qp.status import Status
from jaxmpc.recursion.report import RecursionReport
from jaxmpc.robot_maps.outcomes import RobotLoops
from jaxmpc.robots.linear_plant import LinearPlant
from jaxmpc.robots.robot import Robot

# What becomes of a state: (promised, held) by outcome.
OUTCOMES = {
    "promise kept": (1, 1),
    "promise broken": (1, -1),
    "not promised, failed": (-1, -1),
    "not promised, kept": (-1, 1),
}


@record
class RobotMap:
    """States of a robot with the linear promise and what became of it.

    x0s (B, d) in the coordinates `axes` of ξ, the other coordinates at `linear.fixed`.
    linear: the map of the linear problem, x_0 within the robot's limits included. claim: "limits",
    a state promises what linear.label says, and holds where all limits are kept for T samples; or
    "recursion", a state promises to have a plan at each of T samples of the linear closed loop
    (recursion: the report; its states are deviations from set_point (n,)), and holds where the
    robot has. loops: what the robot did in `steps` T samples of dt seconds.
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
    def seconds(self) -> float:
        """Return the length of the closed loops."""
        return self.steps * self.robot.dt

    @property
    def kept(self) -> np.ndarray:
        """Return whether the robot kept all its limits, without margin, at all T+1 samples, and
        every number was finite, (B,)."""
        return self.loops.broken_at < 0

    @property
    def recursive(self) -> np.ndarray:
        """Return (B,) int8: 1 a plan without fallback at each of T samples, −1 none at sample
        `loops.lost_at`, 0 undecided because an earlier plan is not SOLVED."""
        lost, unsolved = self.loops.lost_at, self.loops.unsolved_at
        open_ = (unsolved >= 0) & ((lost < 0) | (unsolved < lost))
        return np.select([open_, lost >= 0], [0, -1], 1).astype(np.int8)

    @property
    def promised(self) -> np.ndarray:
        """Return the promise of the linear model, (B,) int8: 1 promised, −1 proved that it cannot
        be, 0 undecided."""
        report = self.recursion
        if report is None:
            return self.linear.label
        kept, lost = report.lost_at == 0, (report.lost_at > 0) | (report.label == -1)
        return np.select([kept, lost], [1, -1], 0).astype(np.int8)

    @property
    def held(self) -> np.ndarray:
        """Return what the robot did, (B,) int8: 1 what the claim says, −1 not, 0 undecided."""
        if self.claim == "recursion":
            return self.recursive
        return np.where(self.kept, 1, -1).astype(np.int8)

    @property
    def broken(self) -> np.ndarray:
        """Return whether the promise was made and the robot broke it, (B,)."""
        return (self.promised == 1) & (self.held == -1)

    @property
    def first_loss(self) -> np.ndarray:
        """Return the sample at which the robot failed the claim first, (B,); −1 where it did
        not."""
        found = self.loops.lost_at if self.claim == "recursion" else self.loops.broken_at
        return np.where(self.held == -1, found, -1)

    @property
    def unsure(self) -> np.ndarray:
        """Return whether a broken promise was preceded by a plan that is not SOLVED, (B,): the
        solver may be to blame, not the model."""
        unsolved = self.loops.unsolved_at
        return self.broken & (unsolved >= 0) & (unsolved < self.first_loss)

    @property
    def outcome(self) -> np.ndarray:
        """Return the index into `OUTCOMES`, (B,) int; their number for undecided."""
        same = [(self.promised == p) & (self.held == h) for p, h in OUTCOMES.values()]
        return np.select(same, range(len(same)), len(same))

    @property
    def axis_names(self) -> tuple[str, ...]:
        """Return the labels of the mapped coordinates with their units."""
        return self.linear.axis_names

    def counts(self) -> dict[str, dict[str, int]]:
        """Return the table promise × robot: of how many states each kind of promise held, failed,
        or is open since a plan of the robot was not solved."""
        words = {1: "kept", -1: "failed", 0: "unsolved"}
        promises = {1: "promised", -1: "not promised", 0: "undecided"}
        return {
            name: {
                word: int(np.sum((self.promised == p) & (self.held == h)))
                for h, word in words.items()
            }
            for p, name in promises.items()
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
        """Return the index of the broken promise deepest in the linear feasible set; None without
        any."""
        found = np.flatnonzero(self.broken)
        if not len(found):
            return None
        return int(found[np.argmax(np.nan_to_num(self.depth[found], nan=-np.inf))])

    def __str__(self) -> str:
        """Return the claim, table of counts, statuses and worst broken promise, one a line."""
        what = {
            "limits": "all limits kept", "recursion": "a plan at each sample"
        }[self.claim]  # fmt: skip
        rows = [("claim", f"{what} for {self.seconds:g} s, {self.steps} samples")]
        for name, row in self.counts().items():
            if sum(row.values()) or name != "undecided":
                cells = "".join(f"{k:>10,} {word}" for word, k in row.items() if k)
                rows.append((name, f"{sum(row.values()):>10,}  {cells}"))
        percent = f"{np.mean(self.broken):.2%}, {np.sum(self.unsure):,} after a plan not SOLVED"
        rows.append(("broken promises", f"{np.sum(self.broken):>10,}  {percent}"))
        rows.append(("plans", ", ".join(f"{k:,} {n}" for n, k in self.plan_counts().items())))
        i = self.worst()
        if i is not None:
            at = ", ".join(
                f"{name} = {value:.4g}"
                for name, value in zip(self.axis_names, self.x0s[i], strict=True)
            )
            rows.append((
                "deepest broken", f"{at}: fails at sample {self.first_loss[i]}, "
                f"most beyond a limit {self.loops.worst[i]:.3g}",
            ))  # fmt: skip
        return "\n".join(f"  {name:<16} {value}" for name, value in rows)
