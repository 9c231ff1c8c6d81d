"""Make a robot map: the linear labels and the robot's closed loops, part by part.

Below that the linear problem itself: limits on x_0, terminal sets, deviations from a set-point.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import jax
import numpy as np

from jaxmpc.arrays import Reals, host_array
from jaxmpc.batches import Compiled, Part, default_chunk, first_rows, padded, slices, work_off
from jaxmpc.checks import fail, number, positive, require_kind, require_shape, whole
from jaxmpc.closed_loop.robot_controller import RobotController, robot_mpc, robot_references
from jaxmpc.closed_loop.simulation import simulate_many
from jaxmpc.feasible.map import FeasibleSetMap
from jaxmpc.feasible.pipeline import Labels, Scope, labelled_parts
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.mpc.problem import MPC, Outputs, Soft, as_tuple, within_outputs
from jaxmpc.pytrees import record
from jaxmpc.recursion.analysis import examine
from jaxmpc.recursion.time_budget import Budget
from jaxmpc.robot_maps.robot_map import CLAIMS, RobotLoops, RobotMap
from jaxmpc.robots.description import host_coordinates
from jaxmpc.robots.linear_plant import LinearPlant
from jaxmpc.robots.robot import Robot
from jaxmpc.sets.convex_sets import Box, translated
from jaxmpc.sets.invariant import named_terminal_set
from jaxmpc.systems.riccati import lqr
from jaxmpc.systems.system import host_matrices

T = TypeVar("T")


def map_robot(
    robot: Robot | LinearPlant,
    mpc: MPC,
    x0s: Reals,
    seconds: float = 2.0,
    *,
    controller: RobotController | None = None,
    target: Reals | None = None,
    axes: Sequence[int] | None = None,
    fixed: Reals | None = None,
    claim: str = "limits",
    chunk: int | None = None,
    gap: float | None = None,
    search_seconds: float = 60.0,
    progress: bool = False,
) -> RobotMap:
    """Label each state twice: what the linear model of `mpc` predicts, and what the robot does.

    Arguments:
        mpc: hard limits, linear about the set-point, from `robot_mpc`.
        target: as given to `robot_mpc`; None: `robot.set_point()`, home or what it is moved to.
        x0s: points (B, d) in coordinates ξ. axes: indices of the d mapped coordinates, None for
            all; fixed (n,): values of the others, None for those of `robot.home`.
        seconds: length T·dt of the closed loops, in which home (or target) is held as reference.
        controller: None for a RobotController at the set-point, in float64. Another one decides
            the precision of the loops, by its dtype.
        claim: "limits": the linear model has a plan over the horizon (`map_feasible_set`), and the
            robot keeps all its limits for `seconds`. A plan over N steps implies that for the
            linear model only if the problem is recursively feasible, as with an invariant terminal
            set. "recursion": the linear closed loop has a plan at each of T time steps
            (`recursive_feasibility`, which spends at most about search_seconds on claims about all
            states), and so has the robot.
        search_seconds: seconds for claims about all states, with claim="recursion".
        chunk: loops that run at once (None: 256 on a CPU, 8192 on a GPU). gap: as in
            `map_feasible_set`.

    Both labels apply the robot's limits to x_0 too, which `robot_mpc` does not: a state beyond them
    is neither feasible nor within limits. A limit counts as kept up to 1e-6 (float32: 1e-4) in its
    units. Raises ValueError for wrong arguments before anything compiles.
    """
    given: dict[str, Any] = {
        "controller": controller,
        "target": target,
        "axes": axes,
        "fixed": fixed,
    }
    setting = RobotSetting.of(robot, mpc, x0s, seconds, claim=claim, **given)
    number("search_seconds", search_seconds, 0.0, "Give at least 0")
    found: list[tuple[Labels, RobotLoops]] = []
    total, size = len(setting.x0s), setting.chunk(chunk)
    parts = setting.parts(slices(total, size), setting.x0s.__getitem__, size)
    work_off(parts, lambda part: found.append(part.result), total, unit="loops", progress=progress)
    labels, loops = zip(*found, strict=True)
    return setting.map(Labels.joined(labels), RobotLoops.joined(loops), gap, search_seconds)


@record
class RobotSetting:
    """A checked description of a map, for callers who compute and store it part by part.

    mpc: the linear problem with the robot's limits on x_0; problem: its feasibility problem.
    reference (n,), input_reference (m,): the set-point. The rest is that of `map_robot`.
    """

    robot: Robot | LinearPlant
    mpc: MPC
    problem: FeasibilityProblem
    controller: RobotController
    x0s: np.ndarray
    reference: np.ndarray
    input_reference: np.ndarray
    steps: int
    claim: str

    @classmethod
    def of(
        cls,
        robot: Robot | LinearPlant,
        mpc: MPC,
        x0s: Reals,
        seconds: float,
        *,
        controller: RobotController | None = None,
        target: Reals | None = None,
        axes: Sequence[int] | None = None,
        fixed: Reals | None = None,
        claim: str = "limits",
    ) -> "RobotSetting":
        """Check the arguments of `map_robot`. Raises ValueError; compiles no loop."""
        require_kind("robot", robot, Robot, LinearPlant, cure="Give a Robot or a LinearPlant")
        if claim not in CLAIMS:
            fail("claim", f"{claim!r}", f"Give one of {', '.join(CLAIMS)}")
        require_kind("mpc", mpc, MPC, cure="Give a jm.MPC, such as of robot_mpc")
        mpc.validate()
        mpc.require_constant("the loops of a robot have the same problem at every time step")
        if (mpc.system.n, mpc.system.m) != (robot.n, robot.m):
            sizes, needed = (mpc.system.n, mpc.system.m), (robot.n, robot.m)
            fail("mpc", f"has {sizes} states and inputs", f"This robot has {needed}: see robot_mpc")
        if mpc.input_in_state:
            fail("mpc", "limits or weighs input rates", "A state alone decides nothing then")
        positive("seconds", seconds)
        if claim == "recursion" and as_tuple("soft", mpc.soft, Soft):
            cure = 'Leave them out, or give claim="limits"'
            fail("mpc.soft", "has rows, and plans that break them are plans too", cure)
        reference, inputs = robot_references(robot, target)
        limited = with_initial_limits(mpc, robot.state_limits)
        if axes is not None and fixed is None:
            fixed = host_coordinates(robot, robot.home)
        if fixed is not None:
            require_shape("fixed", fixed, (robot.n,), "One value a coordinate")
        problem = FeasibilityProblem.of(limited, axes, fixed)
        d = problem.dimension
        x0s = host_array("x0s", x0s)
        if x0s.ndim != 2 or x0s.shape[1] != d or not len(x0s):
            cure = f"Give points (B, {d}), B ≥ 1, one column a mapped coordinate"
            fail("x0s", f"shape {x0s.shape}", cure)
        if controller is None:
            with jax.enable_x64(True):
                controller = RobotController(robot, mpc, linearize="set-point")
        require_kind("controller", controller, RobotController)
        sizes, needed = (controller.mpc.system.n, controller.mpc.system.m), (robot.n, robot.m)
        if sizes != needed:
            what = f"plans with {sizes} states and inputs"
            fail("controller", what, f"This robot has {needed}: give one of its own")
        setting = cls(
            robot=robot,
            mpc=limited,
            problem=problem,
            controller=controller,
            x0s=x0s,
            reference=reference,
            input_reference=inputs,
            steps=max(1, round(float(seconds) / robot.dt)),
            claim=claim,
        )
        if claim == "recursion":
            setting.deviations()
        return setting

    @property
    def dtype(self) -> str:
        """Return the precision of the loops: that of the controller's numbers."""
        with jax.enable_x64(True):  # outside it JAX calls float64 numbers float32
            return str(np.dtype(self.controller.dtype))

    def chunk(self, chunk: int | None = None) -> int:
        """Return how many loops run at once."""
        chunk = default_chunk() // 32 if chunk is None else whole("chunk", chunk, 1)
        return min(chunk, len(self.x0s))

    def parts(
        self,
        places: Sequence[T],
        points: Callable[[T], np.ndarray],
        size: int,
        devices: Any = None,
        **settings: Any,
    ) -> Iterator[Part[tuple[Labels, RobotLoops]]]:
        """Yield labels and loops of the points (b, d), b ≤ size, at each of the places.

        devices: as in `map_feasible_set`. settings: iterations, dtype of the linear labels, as
        there.
        """
        scope = Scope.of(self.x0s, -(-len(self.x0s) // size))
        settings["devices"] = devices
        for part in labelled_parts(self.problem, places, points, scope, size, **settings):
            compiled = Compiled.seconds
            loops = self.run(points(part.place), size, devices)
            seconds = part.compile_seconds + Compiled.seconds - compiled
            yield Part(part.place, part.size, (part.result, loops), seconds)

    def run(self, x0s: np.ndarray, size: int, devices: Any = None) -> RobotLoops:
        """Simulate closed loops from points (b, d), b ≤ size, filled up to `size` of them."""
        with jax.enable_x64(self.dtype == "float64"):
            xi = padded(self.problem.view.states(x0s).astype(self.dtype), size)
            start = xi
            if self.robot.state_size != self.robot.n:
                start = np.asarray(jax.vmap(self.robot.state)(xi))
            run = simulate_many(
                self.controller,
                self.robot,
                start,
                self.steps,
                reference=self.reference.astype(self.dtype),
                input_reference=self.input_reference.astype(self.dtype),
                devices=devices,
            )
            return RobotLoops.of(first_rows(run, len(x0s)), self.robot, self.dtype)

    def map(
        self, labels: Labels, loops: RobotLoops, gap: float | None, search_seconds: float
    ) -> RobotMap:
        """Return the map with these labels and loops, its bounds refined unless gap is None, and
        examine the recursion of the linear problem where the claim is that."""
        linear = FeasibleSetMap.of(self.problem, self.x0s, labels)
        report = None
        if self.claim == "recursion":
            # Plans at T time steps: that at the first, and T − 1 after it.
            states = self.problem.view.states(self.x0s) - self.reference
            end = time.monotonic() + search_seconds
            budget, steps = Budget.of(np.inf), max(self.steps - 1, 1)
            report = examine(self.deviations(), states, steps, False, 0, budget, end, {})
        linear = linear if gap is None else linear.refine(gap)
        return RobotMap(self.robot, self.claim, linear, report, loops, self.steps, self.reference)

    def deviations(self) -> MPC:
        """Return the linear problem about its set-point, whose law regulates to the origin."""
        return deviations(self.mpc, self.reference, self.input_reference)


def mpc_with_terminal(robot: Robot, horizon: int, terminal: str) -> MPC:
    """Return `robot_mpc(robot)` with the terminal set "none", "box" or "invariant" about home."""
    mpc = robot_mpc(robot, horizon=horizon)
    if terminal != "invariant":
        found = named_terminal_set(terminal, mpc.system, None, mpc.states, None)
        return replace(mpc, terminal_set=found)
    x, u = robot_references(robot)
    about = deviations(mpc, x, u)
    # At the set-point c is rounding.
    system = replace(about.system, c=None)
    regulator = lqr(system, mpc.Q, mpc.R)
    kept = within_outputs(about, regulator.K)
    found = named_terminal_set(terminal, system, regulator, kept, about.inputs)
    return replace(mpc, terminal_set=translated(found, x))


def with_initial_limits(mpc: MPC, limits: Box) -> MPC:
    """Return `mpc` with `limits` on x_0 as well, where its own state limits do not imply them at
    k = 0."""
    lower, upper = np.asarray(limits.lower, float), np.asarray(limits.upper, float)
    bounded = np.isfinite(lower) | np.isfinite(upper)
    own = mpc.states if 0 in mpc.state_stages else None
    if not bounded.any() or (own is not None and own.spread(len(lower)).is_subset(limits)):
        return mpc
    system = mpc.system
    names, units = (
        tuple(str(text) for text in np.asarray(texts)[bounded]) if texts else ()
        for texts in (system.state_names, system.state_units)
    )
    C = np.eye(len(bounded))[bounded]
    rows = Outputs(C, lower[bounded], upper[bounded], stages=(0,), names=names, units=units)
    return replace(mpc, outputs=(*as_tuple("outputs", mpc.outputs, Outputs), rows))


def deviations(mpc: MPC, x: Reals, u: Reals) -> MPC:
    """Return the same problem in z = ξ − x, v = u − u_ref, so that tracking (x, u_ref) becomes
    regulation.

    z⁺ = A z + B v + (A x + B u_ref + c − x); a set H ξ ≤ h is H z ≤ h − H x. Raises ValueError
    for an Ellipsoid as terminal set away from x = 0.
    """
    x, u = np.asarray(x, float), np.asarray(u, float)
    if not x.any() and not u.any():
        return mpc
    A, B, c = host_matrices(mpc.system)
    return replace(
        mpc,
        system=replace(mpc.system, c=A @ x + B @ u + c - x),
        states=translated(mpc.states, -x),
        inputs=translated(mpc.inputs, -u),
        terminal_set=translated(mpc.terminal_set, -x),
        outputs=tuple(_moved(each, x, u) for each in as_tuple("outputs", mpc.outputs, Outputs)),
    )


def _moved(rows: Outputs, x: np.ndarray, u: np.ndarray) -> Outputs:
    """Return limits of outputs as limits of their deviations from those at x (n,), u (m,)."""
    at = np.asarray(rows.C) @ x
    if rows.D is not None:
        at = at + np.asarray(rows.D) @ u
    lower, upper = (np.asarray(side) - at for side in rows.sides)
    return replace(rows, lower=lower, upper=upper)
