"""Maps of a real robot: what the linear model promises of a state, and what the robot then does.

Each state is labelled twice. The promise is the linear model's: a plan that keeps all limits
exists, by proof (`map_feasible_set`), or one exists at every sample of the linear closed loop
(`recursive_feasibility`). The robot's own closed loop, nonlinear, in MJX, keeps the promise or
breaks it. Nothing here is proved of the robot: its labels are measured, over T samples.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import numpy as np
from tqdm.std import tqdm

from jaxmpc.checks import fail, require_shape
from jaxmpc.closed_loop.outcome import coordinates
from jaxmpc.closed_loop.robot_controller import RobotController
from jaxmpc.closed_loop.run import Run
from jaxmpc.closed_loop.simulate_many import simulate_many
from jaxmpc.compiled import default_chunk, padded
from jaxmpc.control.sets import Box, Ellipsoid, Polytope
from jaxmpc.control.system import LinearSystem
from jaxmpc.mpc.problem import MPC, Outputs, as_tuple
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.status import Status
from jaxmpc.robots.linear import LinearPlant
from jaxmpc.robots.robot import Robot
from jaxmpc.sweeps.feasible_set import FeasibleSetMap, Labels, joined, label_chunks
from jaxmpc.sweeps.proofs import hard_part, make_view
from jaxmpc.sweeps.recursion import RecursionReport, recursive_feasibility

# Excess, in the units of the limit, up to which a limit counts as kept: rounding of the plans.
TOLERANCE = {"float64": 1e-6, "float32": 1e-4}
CLAIMS = ("limits", "recursion")
# Of the default controller: plans in float64 are SOLVED but for about one in a hundred.
SOLVER = ADMM(iterations=100, refine=10)
# What becomes of a state: (promised, held) by outcome.
OUTCOMES = {
    "promise kept": (1, 1),
    "promise broken": (1, -1),
    "not promised, failed": (-1, -1),
    "not promised, kept": (-1, 1),
}


@dataclass(frozen=True)
class Loops:
    """What b closed loops of T samples did.

    worst (b,): the most by which a state (T+1 samples) or an input exceeds a limit of the robot, in
    the units of that limit; NaN where something is not finite. broken_at (b,): first sample 0 … T
    with an excess above the tolerance or a number that is not finite, −1 for none. lost_at (b,):
    first sample 0 … T−1 at which the state is beyond its limits or its plan, SOLVED, breaks soft
    rows (`Run.fallback`): there the hard problem has no plan whose multipliers stay below the
    controller's penalty. −1: none. unsolved_at (b,): first
    sample whose plan is not SOLVED, −1 for none. statuses (b, S): how many plans had each `Status`,
    in the order of the enumeration.
    """

    worst: np.ndarray
    broken_at: np.ndarray
    lost_at: np.ndarray
    unsolved_at: np.ndarray
    statuses: np.ndarray

    @classmethod
    def of(cls, run: Run, robot: Any, tolerance: float) -> "Loops":
        """From closed loops with the batch in front, judged by the robot's own limits."""
        states = np.asarray(run.states)
        excess = np.maximum(
            _excess(coordinates(robot, states), robot.state_limits),
            # An input belongs to the sample that it leaves.
            np.pad(_excess(np.asarray(run.inputs), robot.input_limits), ((0, 0), (0, 1))),
        )
        beyond = ~(excess <= tolerance)  # NaN too
        status = np.asarray(run.status)
        solved = status == Status.SOLVED
        lost = beyond[:, :-1] | (solved & np.asarray(run.fallback))
        return cls(
            excess.max(axis=1), _first(beyond), _first(lost), _first(~solved),
            np.stack([np.sum(status == s, axis=1) for s in Status], axis=1),
        )  # fmt: skip


@dataclass(frozen=True)
class RobotMap:
    """States of a robot with the linear promise and what became of it.

    points (B, d) in the coordinates `axes` of ξ, the other coordinates at `linear.fixed`.
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
    loops: Loops
    steps: int
    set_point: np.ndarray

    @property
    def points(self) -> np.ndarray:
        """(B, d) the mapped coordinates."""
        return self.linear.points

    @property
    def seconds(self) -> float:
        """Length of the closed loops."""
        return self.steps * self.robot.dt

    @property
    def kept(self) -> np.ndarray:
        """(B,) whether the robot kept all its limits, without margin, at all T+1 samples, and
        every number was finite."""
        return self.loops.broken_at < 0

    @property
    def recursive(self) -> np.ndarray:
        """(B,) int8: 1 a plan without fallback at each of T samples, −1 none at sample
        `loops.lost_at`, 0 undecided: an earlier plan is not SOLVED."""
        lost, unsolved = self.loops.lost_at, self.loops.unsolved_at
        open_ = (unsolved >= 0) & ((lost < 0) | (unsolved < lost))
        return np.select([open_, lost >= 0], [0, -1], 1).astype(np.int8)

    @property
    def promised(self) -> np.ndarray:
        """(B,) int8, of the linear model: 1 promised, −1 proved that it cannot be, 0 undecided."""
        report = self.recursion
        if report is None:
            return self.linear.label
        kept, lost = report.lost_at == 0, (report.lost_at > 0) | (report.label == -1)
        return np.select([kept, lost], [1, -1], 0).astype(np.int8)

    @property
    def held(self) -> np.ndarray:
        """(B,) int8, of the robot: 1 it did what the claim says, −1 it did not, 0 undecided."""
        if self.claim == "recursion":
            return self.recursive
        return np.where(self.kept, 1, -1).astype(np.int8)

    @property
    def broken(self) -> np.ndarray:
        """(B,) whether the promise was made and the robot broke it."""
        return (self.promised == 1) & (self.held == -1)

    @property
    def first_loss(self) -> np.ndarray:
        """(B,) sample at which the robot failed the claim first, −1 where it did not."""
        found = self.loops.lost_at if self.claim == "recursion" else self.loops.broken_at
        return np.where(self.held == -1, found, -1)

    @property
    def unsure(self) -> np.ndarray:
        """(B,) whether a broken promise was preceded by a plan that is not SOLVED: the solver may
        be to blame, not the model."""
        unsolved = self.loops.unsolved_at
        return self.broken & (unsolved >= 0) & (unsolved < self.first_loss)

    @property
    def outcome(self) -> np.ndarray:
        """(B,) int: index into `OUTCOMES`, their number for undecided."""
        same = [(self.promised == p) & (self.held == h) for p, h in OUTCOMES.values()]
        return np.select(same, range(len(same)), len(same))

    @property
    def names(self) -> tuple[str, ...]:
        """Labels of the mapped coordinates with their units."""
        return self.linear.names

    def counts(self) -> dict[str, dict[str, int]]:
        """Table promise × robot: how many states of each kind of promise held, failed, or are
        undecided."""
        words = {1: "kept", -1: "failed", 0: "undecided"}
        promises = {1: "promised", -1: "not promised", 0: "undecided"}
        return {
            name: {
                word: int(np.sum((self.promised == p) & (self.held == h)))
                for h, word in words.items()
            }
            for p, name in promises.items()
        }

    def plan_counts(self) -> dict[str, int]:
        """How many of all B·T plans had which status; statuses that did not occur are left out."""
        totals = self.loops.statuses.sum(axis=0)
        return {s.name: int(k) for s, k in zip(Status, totals, strict=True) if k}

    @cached_property
    def depth(self) -> np.ndarray:
        """(B,) how deep in the linear feasible set: 1 at the middle of the points proved feasible,
        0 on the outer bound, negative beyond; NaN where no half-space is proved.

        1 − max_i a_i'(x − m) / (b_i − a_i'm) over the proved half-spaces a_i'x ≤ b_i: one minus
        Minkowski's gauge of their intersection about m.
        """
        normals, offsets = self.linear.cuts()
        inside = self.points[self.linear.label == 1]
        if not len(offsets) or not len(inside):
            return np.full(len(self.points), np.nan)
        middle = inside.mean(axis=0)
        room = offsets - normals @ middle
        with np.errstate(invalid="ignore", divide="ignore"):
            share = normals / room[:, None]
            return 1 - np.max((self.points - middle) @ share.T, axis=1)

    def worst(self) -> int | None:
        """Index of the broken promise deepest in the linear feasible set; None without any."""
        found = np.flatnonzero(self.broken)
        if not len(found):
            return None
        return int(found[np.argmax(np.nan_to_num(self.depth[found], nan=-np.inf))])

    def __str__(self) -> str:
        """Claim, table of counts, statuses and worst broken promise, one a line."""
        what = {
            "limits": "all limits kept", "recursion": "a plan at each sample"
        }[self.claim]  # fmt: skip
        rows = [("claim", f"{what} for {self.seconds:g} s, {self.steps} samples")]
        for name, row in self.counts().items():
            if sum(row.values()) or name != "undecided":
                cells = "".join(f"{k:>10,} {word}" for word, k in row.items() if k)
                rows.append((name, f"{sum(row.values()):>10,}  {cells}"))
        share = f"{np.mean(self.broken):.2%}, {np.sum(self.unsure):,} after a plan not SOLVED"
        rows.append(("broken promises", f"{np.sum(self.broken):>10,}  {share}"))
        rows.append(("plans", ", ".join(f"{k:,} {n}" for n, k in self.plan_counts().items())))
        i = self.worst()
        if i is not None:
            at = ", ".join(
                f"{name} = {value:.4g}"
                for name, value in zip(self.names, self.points[i], strict=True)
            )
            rows.append((
                "deepest broken", f"{at}: fails at sample {self.first_loss[i]}, "
                f"most beyond a limit {self.loops.worst[i]:.3g}",
            ))  # fmt: skip
        return "\n".join(f"  {name:<16} {value}" for name, value in rows)


def map_robot(
    robot: Robot | LinearPlant, mpc: MPC, x0s: Any, seconds: float = 2.0, *,
    controller: Any = None, target: Any = None, axes: Any = None, fixed: Any = None,
    claim: str = "limits", chunk: int | None = None, refine: float | None = None,
    search_seconds: float = 60.0, progress: bool = False,
) -> RobotMap:  # fmt: skip
    """Label each state twice: what the linear model of `mpc` promises, and what the robot does.

    Arguments:
        mpc: hard limits, linear about the set-point, from `robot_mpc` (target: as given there).
        x0s: points (B, d) in coordinates ξ. axes: indices of the d mapped coordinates, None for
            all; fixed (n,): values of the others, None for those of `robot.home`.
        seconds: length T·dt of the closed loops, in which home (or target) is held as reference.
        controller: None for a RobotController at the set-point, in float64. Another one decides
            the precision of the loops, by its dtype.
        claim: "limits": the promise is a plan over the horizon (`map_feasible_set`), which is kept
            where the robot keeps all its limits for `seconds`. A plan over N steps need not
            promise as much: on the linear model it does if the problem is recursively feasible,
            as with an invariant terminal set. "recursion": the promise is a plan at each of T
            samples of the linear closed loop (`recursive_feasibility`, which spends at most
            about search_seconds on claims about all states), kept where the robot has them.
        chunk: loops that run at once (None: 256 on a CPU, 8192 on a GPU). refine: as in
            `map_feasible_set`.

    Both labels hold x_0 against the robot's limits, which `robot_mpc` leaves out: a state beyond
    them is neither feasible nor kept. A limit counts as kept up to 1e-6 (float32: 1e-4) in its
    units. Raises ValueError for wrong arguments before anything compiles.
    """
    setting = RobotSetting.of(
        robot, mpc, x0s, seconds, controller=controller, target=target, axes=axes, fixed=fixed,
        claim=claim,
    )  # fmt: skip
    parts = setting.chunks(chunk=chunk)
    labels, loops = None, []
    with tqdm(total=len(setting.points), unit=" loops", disable=not progress) as bar:
        for here, part, looped in parts:
            labels = setting.none() if labels is None else labels
            labels = joined(labels, here, part)
            loops.append(looped)
            bar.update(len(part.label))
    return setting.map(labels, loops, refine=refine, search_seconds=search_seconds)


@dataclass(frozen=True)
class RobotSetting:
    """A map that is checked and not yet made, for those who keep it chunk by chunk.

    mpc: the linear problem with the robot's limits on x_0. reference (n,), input_reference (m,):
    the set-point. The rest is that of `map_robot`.
    """

    robot: Robot | LinearPlant
    mpc: MPC
    controller: Any
    points: np.ndarray
    axes: tuple[int, ...]
    fixed: np.ndarray | None
    reference: np.ndarray
    input_reference: np.ndarray
    steps: int
    claim: str

    @classmethod
    def of(
        cls, robot: Any, mpc: MPC, points: Any, seconds: float, *, controller: Any = None,
        target: Any = None, axes: Any = None, fixed: Any = None, claim: str = "limits",
    ) -> "RobotSetting":  # fmt: skip
        """Check everything. Raises ValueError, compiles no loop."""
        if not isinstance(robot, Robot | LinearPlant):
            fail("robot", f"is a {type(robot).__name__}", "Give a Robot or a LinearPlant")
        if claim not in CLAIMS:
            fail("claim", f"{claim!r}", f"Give one of {', '.join(CLAIMS)}")
        mpc.validate()
        if (mpc.system.n, mpc.system.m) != (robot.n, robot.m):
            sizes, needed = (mpc.system.n, mpc.system.m), (robot.n, robot.m)
            fail("mpc", f"has {sizes} states and inputs", f"This robot has {needed}: see robot_mpc")
        if mpc.remembers:
            fail("mpc", "limits or weighs input rates", "A state alone decides nothing then")
        number = isinstance(seconds, int | float) and not isinstance(seconds, bool)
        if not number or not 0 < seconds < math.inf:
            fail("seconds", f"{seconds!r}", "Give a positive number")
        x, u = robot.equilibrium(target)
        with jax.enable_x64(True):
            reference = np.asarray(robot.coordinates(np.asarray(x)), np.float64)
            home = np.asarray(robot.coordinates(np.asarray(robot.home)), np.float64)
        problem = with_initial_limits(mpc, robot.state_limits)
        if axes is not None and fixed is None and len(set(axes)) < robot.n:
            fixed = home
        if fixed is not None:
            require_shape("fixed", fixed, (robot.n,), "One value a coordinate")
            fixed = np.asarray(fixed, np.float64)
        view = make_view(hard_part(problem), axes, fixed)
        points = np.asarray(points, np.float64)
        if points.ndim != 2 or points.shape[1] != len(view.axes) or not len(points):
            cure = f"Give points (B, {len(view.axes)}), B ≥ 1, one column a mapped coordinate"
            fail("x0s", f"shape {points.shape}", cure)
        if controller is None:
            with jax.enable_x64(True):
                controller = RobotController(robot, mpc, SOLVER, linearize="set-point")
        steps = max(1, round(seconds / robot.dt))
        setting = cls(
            robot, problem, controller, points, view.axes, fixed, reference, np.asarray(u),
            steps, claim,
        )  # fmt: skip
        if claim == "recursion":
            setting.deviations()
        return setting

    @property
    def dtype(self) -> str:
        """Precision of the loops: that of the controller's numbers."""
        with jax.enable_x64(True):  # outside it JAX calls float64 numbers float32
            return str(np.dtype(self.controller.dtype))

    def states(self, points: np.ndarray) -> np.ndarray:
        """Coordinates ξ (B, n) of points (B, d)."""
        whole = np.zeros(self.robot.n) if self.fixed is None else self.fixed
        xi = np.tile(whole, (len(points), 1))
        xi[:, list(self.axes)] = points
        return xi

    def none(self) -> Labels:
        """Labels of all points, none of them run."""
        return Labels.empty(len(self.points), self.mpc, len(self.axes))

    def chunks(
        self, rows: Any = None, *, chunk: int | None = None, **settings: Any
    ) -> Iterator[tuple[slice, Labels, Loops]]:
        """Promises and loops of points[rows] (all for None) chunk by chunk, one shape throughout.

        settings: iterations, dtype of the linear labels, as in `map_feasible_set`. Yields (slice of
        these rows, Labels, Loops).
        """
        points = self.points if rows is None else self.points[rows]
        size = self.chunk(chunk)
        labelled = label_chunks(
            self.mpc, points, axes=self.axes, fixed=self.fixed, chunk=size, **settings
        )
        for here, labels in labelled:
            yield here, labels, self.run(points[here], size)

    def chunk(self, chunk: int | None) -> int:
        """How many loops run at once."""
        if chunk is not None and (isinstance(chunk, bool) or chunk < 1):
            fail("chunk", f"{chunk}", "Give a count of at least 1")
        return min(default_chunk() // 32 if chunk is None else int(chunk), len(self.points))

    def run(self, points: np.ndarray, size: int) -> Loops:
        """Closed loops from points (b, d), b ≤ size, filled up to `size` of them."""
        with jax.enable_x64(self.dtype == "float64"):
            xi = padded(self.states(points).astype(self.dtype), size)
            run = simulate_many(
                self.controller, self.robot, _states(self.robot, xi), self.steps,
                reference=self.reference.astype(self.dtype),
                input_reference=self.input_reference.astype(self.dtype),
            )  # fmt: skip
            run = jax.tree.map(lambda v: v[: len(points)], run)
            return Loops.of(run, self.robot, TOLERANCE[self.dtype])

    def map(
        self, labels: Any, loops: list[Loops], *, refine: float | None = None,
        search_seconds: float = 60.0,
    ) -> RobotMap:  # fmt: skip
        """The map from its chunks; the linear recursion is examined here."""
        linear = FeasibleSetMap.of(self.mpc, self.points, self.axes, self.fixed, labels)
        whole = Loops(*(
            np.concatenate([getattr(part, name) for part in loops])
            for name in Loops.__dataclass_fields__
        ))  # fmt: skip
        report = None
        if self.claim == "recursion":
            # Plans at T samples: that at the first, and T − 1 after it.
            report = recursive_feasibility(
                self.deviations(), self.states(self.points) - self.reference,
                steps=max(self.steps - 1, 1), search=False, regions=0, seconds=search_seconds,
            )  # fmt: skip
        linear = linear if refine is None else linear.refine(refine)
        return RobotMap(
            self.robot, self.claim, linear, report, whole, self.steps, self.reference
        )  # fmt: skip

    def deviations(self) -> MPC:
        """The linear problem about its set-point, whose law regulates to the origin."""
        return deviations(self.mpc, self.reference, self.input_reference)


def with_initial_limits(mpc: MPC, limits: Box) -> MPC:
    """`mpc` with `limits` on x_0 as well, where its own state limits do not hold at k = 0."""
    lower, upper = np.asarray(limits.lower, float), np.asarray(limits.upper, float)
    bounded = np.isfinite(lower) | np.isfinite(upper)
    if not bounded.any() or (mpc.states is not None and 0 in mpc.state_steps):
        return mpc
    pick = lambda names: tuple(str(v) for v in np.asarray(names)[bounded]) if names else ()
    rows = Outputs(
        np.eye(len(bounded))[bounded], lower[bounded], upper[bounded], steps=(0,),
        names=pick(mpc.system.state_names), units=pick(mpc.system.state_units),
    )  # fmt: skip
    return replace(mpc, outputs=(*as_tuple("outputs", mpc.outputs, Outputs), rows))


def deviations(mpc: MPC, x: Any, u: Any) -> MPC:
    """The same problem in z = ξ − x, v = u − u_ref, so that tracking (x, u_ref) becomes regulation.

    z⁺ = A z + B v + (A x + B u_ref + c − x); a set H ξ ≤ h is H z ≤ h − H x. Raises ValueError
    for an Ellipsoid as terminal set away from x = 0.
    """
    x, u = np.asarray(x, float), np.asarray(u, float)
    if not x.any() and not u.any():
        return mpc

    def moved(set_: Any, by: np.ndarray) -> Any:
        if isinstance(set_, Box):
            return Box(np.asarray(set_.lower) - by, np.asarray(set_.upper) - by)
        if isinstance(set_, Polytope):
            return replace(set_, h=np.asarray(set_.h) - np.asarray(set_.H) @ by)
        if isinstance(set_, Ellipsoid) and by.any():
            fail("terminal_set", "is an Ellipsoid about the origin", "Use a Polytope")
        return set_

    system: LinearSystem = mpc.system
    A, B = np.asarray(system.A, float), np.asarray(system.B, float)
    c = np.zeros(system.n) if system.c is None else np.asarray(system.c, float)
    rows = []
    for each in as_tuple("outputs", mpc.outputs, Outputs):
        D = np.zeros((len(each.lower), system.m)) if each.D is None else np.asarray(each.D)
        by = np.asarray(each.C) @ x + D @ u
        rows.append(replace(each, lower=np.asarray(each.lower) - by, upper=each.upper - by))
    return replace(
        mpc, system=replace(system, c=A @ x + B @ u + c - x), states=moved(mpc.states, x),
        inputs=moved(mpc.inputs, u), terminal_set=moved(mpc.terminal_set, x), outputs=tuple(rows),
    )  # fmt: skip


def _states(robot: Any, xi: np.ndarray) -> np.ndarray:
    """Plant states of coordinates (b, n)."""
    return xi if robot.state_size == robot.n else np.asarray(jax.vmap(robot.state)(xi))


def _excess(values: np.ndarray, limits: Box) -> np.ndarray:
    """The most by which values (..., k) exceed a Box in k numbers, at least 0; NaN stays."""
    lower, upper = np.asarray(limits.lower, float), np.asarray(limits.upper, float)
    values = np.where(np.isinf(values), np.nan, values)
    return np.maximum(np.max(np.maximum(values - upper, lower - values), axis=-1), 0.0)


def _first(flags: np.ndarray) -> np.ndarray:
    """Index of the first True of each row, −1 for none."""
    return np.where(flags.any(axis=1), np.argmax(flags, axis=1), -1)
