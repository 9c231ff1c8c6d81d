"""Make a robot map: the linear labels and the robot's closed loops, chunk by chunk."""

import math
import time
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from tqdm.std import tqdm

from jaxmpc.arrays import Reals, host_array
from jaxmpc.batches import default_chunk, padded
from jaxmpc.checks import fail, require_shape
from jaxmpc.closed_loop.many import simulate_many
from jaxmpc.closed_loop.robot_controller import RobotController
from jaxmpc.feasible.labels import Labels
from jaxmpc.feasible.map import FeasibleSetMap
from jaxmpc.feasible.pipeline import Scope, label_chunks
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.mpc.problem import MPC
from jaxmpc.pytrees import record
from jaxmpc.recursion.analysis import examine
from jaxmpc.recursion.budget import Budget
from jaxmpc.robot_maps.outcomes import RobotLoops
from jaxmpc.robot_maps.robot_map import RobotMap
from jaxmpc.robot_maps.set_point import deviations, with_initial_limits
from jaxmpc.robots.linear_plant import LinearPlant
from jaxmpc.robots.robot import Robot

CLAIMS = ("limits", "recursion")


def map_robot(
    robot: Robot | LinearPlant, mpc: MPC, x0s: Reals, seconds: float = 2.0, *,
    controller: Any = None, target: Any = None, axes: Any = None, fixed: Reals | None = None,
    claim: str = "limits", chunk: int | None = None, gap: float | None = None,
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
            where the robot keeps all its limits for `seconds`. A plan over N steps implies that
            for the linear model only if the problem is recursively feasible, as with an invariant
            terminal set. "recursion": the promise is a plan at each of T
            samples of the linear closed loop (`recursive_feasibility`, which spends at most
            about search_seconds on claims about all states), kept where the robot has them.
        chunk: loops that run at once (None: 256 on a CPU, 8192 on a GPU). gap: as in
            `map_feasible_set`.

    Both labels apply the robot's limits to x_0 too, which `robot_mpc` does not: a state beyond them
    is neither feasible nor kept. A limit counts as kept up to 1e-6 (float32: 1e-4) in its units.
    Raises ValueError for wrong arguments before anything compiles.
    """
    setting = RobotSetting.of(
        robot, mpc, x0s, seconds, controller=controller, target=target, axes=axes, fixed=fixed,
        claim=claim,
    )  # fmt: skip
    parts = setting.chunks(chunk=chunk)
    labels, loops = [], []
    with tqdm(total=len(setting.points), unit=" loops", disable=not progress) as bar:
        for _, part, looped in parts:
            labels.append(part)
            loops.append(looped)
            bar.update(len(part.label))
    return setting.map(Labels.joined(labels), loops, gap=gap, search_seconds=search_seconds)


@record
class RobotSetting:
    """A checked description of a map, for callers who compute and store it chunk by chunk.

    mpc: the linear problem with the robot's limits on x_0; problem: its feasibility problem.
    reference (n,), input_reference (m,): the set-point. The rest is that of `map_robot`.
    """

    robot: Robot | LinearPlant
    mpc: MPC
    problem: FeasibilityProblem
    controller: Any
    points: np.ndarray
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
        """Check all arguments. Raises ValueError; compiles no loop."""
        if not isinstance(robot, Robot | LinearPlant):
            fail("robot", f"is a {type(robot).__name__}", "Give a Robot or a LinearPlant")
        if claim not in CLAIMS:
            fail("claim", f"{claim!r}", f"Give one of {', '.join(CLAIMS)}")
        mpc.validate()
        if (mpc.system.n, mpc.system.m) != (robot.n, robot.m):
            sizes, needed = (mpc.system.n, mpc.system.m), (robot.n, robot.m)
            fail("mpc", f"has {sizes} states and inputs", f"This robot has {needed}: see robot_mpc")
        if mpc.input_in_state:
            fail("mpc", "limits or weighs input rates", "A state alone decides nothing then")
        number = isinstance(seconds, int | float) and not isinstance(seconds, bool)
        if not number or not 0 < seconds < math.inf:
            fail("seconds", f"{seconds!r}", "Give a positive number")
        x, u = robot.equilibrium(target)
        with jax.enable_x64(True):
            reference = np.asarray(robot.coordinates(np.asarray(x)), np.float64)
            home = np.asarray(robot.coordinates(np.asarray(robot.home)), np.float64)
        limited = with_initial_limits(mpc, robot.state_limits)
        if axes is not None and fixed is None and len(set(axes)) < robot.n:
            fixed = home
        if fixed is not None:
            require_shape("fixed", fixed, (robot.n,), "One value a coordinate")
            fixed = np.asarray(fixed, np.float64)
        problem = FeasibilityProblem.of(limited, axes, fixed)
        d = problem.dimension
        points = host_array("x0s", points)
        if points.ndim != 2 or points.shape[1] != d or not len(points):
            cure = f"Give points (B, {d}), B ≥ 1, one column a mapped coordinate"
            fail("x0s", f"shape {points.shape}", cure)
        if controller is None:
            with jax.enable_x64(True):
                controller = RobotController(robot, mpc, linearize="set-point")
        steps = max(1, round(seconds / robot.dt))
        setting = cls(
            robot, limited, problem, controller, points, fixed, reference, np.asarray(u), steps,
            claim,
        )  # fmt: skip
        if claim == "recursion":
            setting.deviations()
        return setting

    @property
    def axes(self) -> tuple[int, ...]:
        """Return the indices of the d mapped coordinates."""
        return self.problem.view.axes

    @property
    def dtype(self) -> str:
        """Return the precision of the loops: that of the controller's numbers."""
        with jax.enable_x64(True):  # outside it JAX calls float64 numbers float32
            return str(np.dtype(self.controller.dtype))

    def states(self, points: np.ndarray) -> np.ndarray:
        """Return the coordinates ξ (B, n) of points (B, d)."""
        whole = np.zeros(self.robot.n) if self.fixed is None else self.fixed
        xi = np.tile(whole, (len(points), 1))
        xi[:, list(self.axes)] = points
        return xi

    def none(self) -> Labels:
        """Return labels of all points, none of them run."""
        return Labels.empty(len(self.points), self.problem)

    def chunks(
        self, rows: Any = None, *, chunk: int | None = None, devices: Any = None, **settings: Any
    ) -> Iterator[tuple[slice, Labels, RobotLoops]]:
        """Yield promises and loops of points[rows] (all for None) chunk by chunk, in one shape
        throughout.

        devices: as in `map_feasible_set`. settings: iterations, dtype of the linear labels, as
        there. Yields (slice of these rows, Labels, RobotLoops).
        """
        points = self.points if rows is None else self.points[rows]
        size = self.chunk(chunk)
        scope = Scope.of(self.points, -(-len(self.points) // size))
        labelled = label_chunks(
            self.problem, points, chunk=size, scope=scope, devices=devices, **settings
        )
        for here, labels in labelled:
            yield here, labels, self.run(points[here], size, devices)

    def chunk(self, chunk: int | None) -> int:
        """Return how many loops run at once."""
        if chunk is not None and (isinstance(chunk, bool) or chunk < 1):
            fail("chunk", f"{chunk}", "Give a count of at least 1")
        return min(default_chunk() // 32 if chunk is None else int(chunk), len(self.points))

    def run(self, points: np.ndarray, size: int, devices: Any = None) -> RobotLoops:
        """Simulate closed loops from points (b, d), b ≤ size, filled up to `size` of them."""
        with jax.enable_x64(self.dtype == "float64"):
            xi = padded(self.states(points).astype(self.dtype), size)
            run = simulate_many(
                self.controller, self.robot, _states(self.robot, xi), self.steps,
                reference=self.reference.astype(self.dtype),
                input_reference=self.input_reference.astype(self.dtype), devices=devices,
            )  # fmt: skip
            run = jax.tree.map(lambda v: v[: len(points)], run)
            return RobotLoops.of(run, self.robot, self.dtype)

    def map(
        self, labels: Any, loops: list[RobotLoops], *, gap: float | None = None,
        search_seconds: float = 60.0,
    ) -> RobotMap:  # fmt: skip
        """Make the map from its chunks, and examine the recursion of the linear problem."""
        linear = FeasibleSetMap.of(self.problem, self.points, labels)
        whole = RobotLoops(*(
            np.concatenate([getattr(part, name) for part in loops])
            for name in RobotLoops.__dataclass_fields__
        ))  # fmt: skip
        report = None
        if self.claim == "recursion":
            # Plans at T samples: that at the first, and T − 1 after it.
            budget = Budget.of(np.inf)  # of the loops, which are what the map shows
            report = examine(
                self.deviations(), self.states(self.points) - self.reference,
                max(self.steps - 1, 1), False, 0, budget, time.monotonic() + search_seconds,
            )  # fmt: skip
        linear = linear if gap is None else linear.refine(gap)
        return RobotMap(
            self.robot, self.claim, linear, report, whole, self.steps, self.reference
        )  # fmt: skip

    def deviations(self) -> MPC:
        """Return the linear problem about its set-point, whose law regulates to the origin."""
        return deviations(self.mpc, self.reference, self.input_reference)


def _states(robot: Any, xi: np.ndarray) -> np.ndarray:
    """Return the plant states of coordinates (b, n)."""
    return xi if robot.state_size == robot.n else np.asarray(jax.vmap(robot.state)(xi))
