"""MPC of robots: robot_mpc makes the problem from a model and its limits, RobotController solves it
by linear models."""

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import field, replace
from typing import Any, Literal

import jax
import numpy as np
from jax import Array

from jaxmpc.arrays import Reals, as_array, as_weight, module_of
from jaxmpc.checks import fail, number, require_kind, whole
from jaxmpc.closed_loop.feedback import one_state
from jaxmpc.closed_loop.nonlinear_controller import (
    at_rest,
    given_numbers,
    held_references,
    last_input,
    reference_sizes,
    resting_start,
    sqp_control,
)
from jaxmpc.closed_loop.orientations import aligned, rotating_joints
from jaxmpc.mpc.controller import Controller
from jaxmpc.mpc.plan import Control, Plan, anchored, applied, limited, require_before
from jaxmpc.mpc.problem import MPC, Outputs, Soft, as_tuple, soften
from jaxmpc.mpc.rows import layout
from jaxmpc.mpc.stagewise.nonlinear import NonlinearMPC, Task
from jaxmpc.mpc.stagewise.solve import factor_stages, solve_stagewise
from jaxmpc.pytrees import prepared_pytree, static
from jaxmpc.qp.admm import ADMM, DEFAULT
from jaxmpc.qp.linalg import arrays, floating_dtype, matmul
from jaxmpc.robots.contacts import friction_cones, stands
from jaxmpc.robots.description import host_coordinates
from jaxmpc.robots.equilibria import settled
from jaxmpc.robots.force_limits import (
    ForceLimits,
    StoppingLimits,
    force_limits,
    stopping_limits,
)
from jaxmpc.robots.linear_plant import LinearPlant
from jaxmpc.robots.robot import Robot, RobotModel
from jaxmpc.sets.convex_sets import Box
from jaxmpc.systems.riccati import UNREACHED, least_reached, lqr
from jaxmpc.systems.system import LinearSystem, host_matrices
from jaxmpc.systems.units import natural_units


def robot_mpc(
    robot: Robot | LinearPlant,
    Q: Reals | None = None,
    R: Reals | None = None,
    horizon: int = 20,
    *,
    target: Reals | None = None,
    margin: float = 0.02,
    terminal_cost: Reals | str | None = "lqr",
    exact: bool = True,
    **fields: Any,
) -> MPC:
    """Return the MPC of a robot about a set-point, with the limits of its model.

    Arguments:
        Q (n, n) or its diagonal (n,), R (m, m) or (m,): weights in the coordinates ξ. None, with
            the half-widths w of the limits (1 where there are none): 1/w² for the positions and
            0.01/w² for velocities and inputs (Bryson's rule, slow motion and effort forgiven).
        target: configuration (nq,) to linearise about (of a LinearPlant the state), one that the
            actuators can hold. None for `robot.set_point()`: home where they can, else the nearest
            configuration that they can hold, else home, where the model then predicts a fall.
        margin: fraction by which state limits are tightened, of the limit's half-width on each
            side, to allow for errors of the linear model. Less where the target lies in between: a
            warning names the coordinates. Input limits are not tightened.
        terminal_cost: "lqr", the Riccati solution of the model at the target, of the coordinates
            that inputs move where they do not move all (a warning names the others), and none
            where the set-point does not rest: no cost to go is finite there; or P (n, n), None.
        exact: which model, see `Robot.linearize`.
        fields: of `MPC`, in place of the defaults here: state limits at k = 1 … N (no input moves
            x_0), no terminal set. `outputs` join the limits of forces that the file has beside
            those of inputs (`forcerange` of servos, `actuatorfrcrange`), and at k = 0 and N that
            these can stop the joints inside their limits.

    Track the target with reference = robot.coordinates(x) and input_reference = u of
    `robot.equilibrium(target)`, or of `robot.set_point()`. Raises ValueError as MPC and
    `equilibrium` do, or where the limits leave out the target.
    """
    if not callable(getattr(robot, "linearize", None)):
        fail("robot", f"is a {type(robot).__name__}", "Give a Robot or a LinearPlant")
    whole("horizon", horizon, 1)
    number("margin", margin, 0.0, "Give a fraction in [0, 1)")
    if not margin < 1:
        fail("margin", f"{margin}", "Give a fraction in [0, 1)")
    Q, R = weights_of(robot, Q, R)
    rests = True
    if target is None and isinstance(robot, Robot):
        rest, texts = settled(robot)
        x, u, rests = rest.x, rest.u, rest.held
        for text in texts:
            warnings.warn(text, stacklevel=2)
    else:
        x, u = robot.set_point(target)
    names = robot.state_names or tuple(f"coordinate {i}" for i in range(robot.n))
    states = _around(robot.state_limits, margin, host_coordinates(robot, x), names)
    # Inside jit too the robot is known, be the weights traced.
    with jax.enable_x64(True), jax.ensure_compile_time_eval():
        system = jax.tree.map(np.asarray, robot.linearize(x, u, exact=exact))
    mpc = MPC(system, Q, R, horizon, states=states, inputs=robot.input_limits)
    mpc.validate()
    if isinstance(terminal_cost, str):
        if terminal_cost != "lqr":
            fail("terminal_cost", f"{terminal_cost!r}", 'Give "lqr", a matrix or None')
        named = () if stands(robot) else names  # feet that stand are not moved, as they shall
        try:
            terminal_cost = lqr_cost(system, Q, R, named) if rests else None
        except ValueError as error:
            cure = "Or give terminal_cost=None, or a matrix"
            fail("terminal_cost", f"'lqr', and the set-point has none ({error})", cure)
    usual = {"constrained_stages": tuple(range(1, horizon + 1)), "terminal_cost": terminal_cost}
    mpc = replace(mpc, **{**usual, **fields})
    if isinstance(robot, Robot):
        with jax.ensure_compile_time_eval():
            added = tuple(_limits_of_forces(robot, x, u, states, horizon))
        mpc = replace(mpc, outputs=(*as_tuple("outputs", mpc.outputs, Outputs), *added))
    mpc.validate()
    return mpc


def _limits_of_forces(
    robot: Robot, x: np.ndarray, u: np.ndarray, states: Box, horizon: int
) -> Iterator[Outputs]:
    """Yield the friction cones of feet that stand, the limits of forces at all stages, and at the
    first and the last what they need to stop: no input moves x_0, but a plan from where nothing
    stops the robot says so."""
    cones = friction_cones(robot, x, u)
    if cones is not None:
        yield replace(cones, stages=tuple(range(horizon)))
    forces = force_limits(robot, x, u)
    if forces is None:
        return
    yield replace(forces, stages=tuple(range(horizon)))
    stopping = stopping_limits(robot, x[: robot.mujoco.nq], states)
    if stopping is not None:
        yield replace(stopping, stages=(0, horizon))


def with_margin(robot: Robot | LinearPlant, mpc: MPC, x: np.ndarray, margin: Any) -> MPC:
    """Return the problem of a robot that rests at x with its state limits tightened by another
    fraction, which may be traced, and with rows that stop its joints within these."""
    states = robot.state_limits.tightened(margin)

    def within(rows: Outputs) -> Outputs:
        if not isinstance(robot, Robot) or not isinstance(rows, StoppingLimits):
            return rows
        found = stopping_limits(robot, x[: robot.mujoco.nq], states)
        return rows if found is None else replace(found, stages=rows.stages)

    outputs = tuple(map(within, as_tuple("outputs", mpc.outputs, Outputs)))
    return replace(mpc, states=states, outputs=outputs)


def weights_of(robot: Robot | LinearPlant, Q: Reals | None, R: Reals | None) -> tuple[Reals, Reals]:
    """Return the weights as matrices, for None those of Bryson's rule with the robot's limits."""
    positions = robot.mujoco.nv if isinstance(robot, Robot) else robot.n - robot.n // 2
    return bryson_weights(robot.state_limits, robot.input_limits, positions, Q, R)


def bryson_weights(
    states: Box, inputs: Box, positions: int, Q: Reals | None, R: Reals | None
) -> tuple[Reals, Reals]:
    """Return the weights as matrices, for None those of Bryson's rule: with half-widths w of limits
    1/w² for positions, the first coordinates, and 0.01/w² for the others and inputs."""
    n, m = states.dimension, inputs.dimension
    if Q is None:
        Q = np.repeat([1.0, 0.01], [positions, n - positions]) / states.half_widths() ** 2
    if R is None:
        R = 0.01 / inputs.half_widths() ** 2
    return as_weight(Q, n), as_weight(R, m)


def _around(limits: Box, margin: float, point: np.ndarray, names: tuple[str, ...]) -> Box:
    """Return the limits tightened by the margin, by less where that would leave out the point
    (n,)."""
    lower, upper = limits.bounds()
    outside = np.maximum(lower - point, point - upper) - 1e-9 * limits.half_widths()
    if np.any(outside > 0):
        i = int(np.argmax(outside))
        problem = f"has {names[i]} = {point[i]:g}, limits are [{lower[i]:g}, {upper[i]:g}]"
        fail("target", problem, "Choose another target")
    lower, upper = limits.tightened(margin).bounds()
    low, high = np.minimum(lower, point), np.maximum(upper, point)
    less = np.flatnonzero((low < lower) | (high > upper))
    if len(less):
        warnings.warn(
            f"margin: {_listed(less, names)}: the target lies at the limit or less than the margin "
            "from it; the limit is tightened only up to the target",
            stacklevel=3,
        )
    return Box(low, high)


def lqr_cost(system: LinearSystem, Q: Reals, R: Reals, names: tuple[str, ...] = ()) -> Reals:
    """Return P of the LQR; where inputs do not move all modes that last, P = T P_r T' with P_r of
    the LQR on the subspace that they reach, T (n, r) an orthonormal basis of it.

    The reached part T'x follows T'AT and T'B, driven by the rest as by a disturbance, which P
    leaves out: no input changes that rest. names: of the states, for a warning where there is such
    a rest; none is given without them. Q and R may be traced.
    """
    A, B, _ = host_matrices(system)
    if least_reached(A, B)[0] > UNREACHED:
        return lqr(system, Q, R).P
    units = natural_units(A, B)
    A, B = units.system(A, B)
    T = reached_subspace(A, B)
    if names:
        unmoved = np.flatnonzero(np.linalg.norm(T, axis=1) < 0.999)
        warnings.warn(
            f"terminal_cost: inputs do not move all of {_listed(unmoved, names)} (no equilibrium "
            "there is stabilizable); it is the LQR's of what they move",
            stacklevel=3,
        )
    q, r = units.weights(as_array(Q), as_array(R))
    inside: Any = T
    P: Any = lqr(LinearSystem(T.T @ A @ T, T.T @ B), matmul(inside.T, matmul(q, inside)), r).P
    return units.cost_matrix(matmul(inside, matmul(P, inside.T)))


def reached_subspace(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis T (n, r) of what inputs reach, the span of B, AB, A²B, ...

    F = A − I reaches the same, and moves each direction by as much as one time step does.
    Directions that it moves by less than 1e-9 of |F| count as not reached.
    """
    F = A - np.eye(len(A))
    F = F / max(np.linalg.norm(F, 2), np.finfo(np.float64).tiny)
    T, new = np.zeros((len(A), 0)), B / np.linalg.norm(B, 2)
    while new.shape[1] and T.shape[1] < len(A):
        for _ in range(2):  # once more removes what rounding left
            new = new - T @ (T.T @ new)
        directions, sizes, _ = np.linalg.svd(new, full_matrices=False)
        new = directions[:, sizes > 1e-9]
        T, new = np.hstack([T, new]), F @ new
    return T


def _listed(which: np.ndarray, names: tuple[str, ...], most: int = 6) -> str:
    """Return the first names, and how many more there are."""
    found = [names[i] for i in which]
    return ", ".join(found[:most]) + (f" and {len(found) - most} more" if found[most:] else "")


def robot_references(
    robot: Robot | LinearPlant, target: Reals | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return reference (n,) and input_reference (m,) with which a robot rests at the target, as in
    `robot_mpc`, which warns where it cannot."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        state, inputs = robot.set_point(target)
    return host_coordinates(robot, state), np.asarray(inputs)


LINEARIZATIONS = ("set-point", "state", "trajectory")


@prepared_pytree
class RobotController:
    """MPC of a nonlinear robot by linear models, soft where the limits cannot be kept.

    robot: Robot (its predictor is the model) or LinearPlant.
    mpc: the problem, from `robot_mpc`; its `system` is used by linearize="set-point" only.
    solver: with iterations=None, as by default, there are no ADMM steps but Newton steps from the
      last plan and, where they do not end at the solution, an interior point method
      (`solve_stagewise`); with "set-point" the steps are those of `solve`.
    linearize: where the linear models are taken,
      "set-point"   once, as mpc.system says; matrices are factored once for all robots;
      "state"       about the measured state and the last input, at each time step;
      "trajectory"  about the last plan shifted by one time step, a model for each: the real-time
                    iteration of sequential quadratic programming.
    exact: see `Robot.linearize`; always with sqp_steps > 1.
    tasks: `jaxmpc.mpc.Task`s, costs and limits on functions of mjx.Data, such as the position of
      the gripper; with "trajectory" only. Their targets are the columns of `reference` after the
      first n, or those of the tasks where the reference has just n.
    sqp_steps: quadratic programs a time step at most. With "trajectory" more than one solve the
      nonlinear problem (`solve_nonlinear`), and the status is that of the nonlinear problem.
    hessian: as in `solve_nonlinear`, with sqp_steps > 1. "exact" needs fewer quadratic programs
      and, for its second derivatives of the robot, minutes to compile.
    rho: L1 weight (cost per unit) with which state limits and terminal rows are soft. Where it
      exceeds the multipliers of the hard problem, plans keep the limits whenever the model can
      (exact penalty), and elsewhere trade violations against the cost by that weight. Each such
      plan is counted: `Run.fallback`. Input limits are hard. Limits of forces (`robot_mpc`) weigh
      100 times as much a unit of the input, for the plant keeps them against any plan.

    `controller(x, before, reference, input_reference=)` as `Controller`, x (nq + nv,) the state of
    the robot, references in its coordinates (see `robot.trajectory`). `start` gives the first
    `before`, and takes the first point of linearisation and the previous input, of which rates are
    measured, from input_reference.

    A pytree. Calling the class prepares the problem; JAX and `tree_map` rebuild
    the object without that, `dataclasses.replace` prepares it again. Raises ValueError for
    arguments that do not fit together.
    """

    robot: Any
    mpc: MPC
    solver: ADMM
    linearize: str = static()
    exact: bool = static()
    rho: Any
    tasks: tuple[Task, ...]
    sqp_steps: int = static()
    hessian: Literal["exact", "gauss-newton"] = static()
    soft: Any = field(init=False)
    fixed: Controller | None = field(init=False)
    scale: Any = field(init=False)

    def __init__(
        self,
        robot: Robot | LinearPlant,
        mpc: MPC,
        solver: ADMM | None = None,
        linearize: str = "state",
        exact: bool = False,
        rho: Reals = 1e4,
        tasks: tuple[Task, ...] = (),
        sqp_steps: int = 1,
        hessian: Literal["exact", "gauss-newton"] = "gauss-newton",
    ) -> None:
        require_kind("tasks", tasks, tuple, list, cure="Give a tuple of jm.mpc.Task: (task,)")
        solver = DEFAULT if solver is None else solver
        if solver.iterations is None and linearize != "set-point":
            solver = replace(solver, iterations=0)
        vars(self).update(robot=robot, mpc=mpc, linearize=linearize, rho=rho, tasks=tuple(tasks))
        vars(self).update(exact=exact or sqp_steps > 1, sqp_steps=sqp_steps, hessian=hessian)
        vars(self).update(_prepared(self, solver), solver=arrays(solver))

    def __repr__(self) -> str:
        """Return in one line what it controls and how: the robot, the horizon, where the linear
        model is taken, and the solver's steps."""
        if self.fixed is not None:
            model = "one linear model, at the set-point"
        else:
            where = "the state" if self.linearize == "state" else "the predicted trajectory"
            model = f"a linear model at {where} at each sample"
        tasks = f", {len(self.tasks)} tasks" if self.tasks else ""
        sqp = f", at most {self.sqp_steps} SQP steps" if self.sqp_steps > 1 else ""
        name = getattr(self.robot, "name", type(self.robot).__name__)
        horizon = f"horizon {self.mpc.horizon}, soft state limits"
        return f"RobotController({name}, {horizon}, {model}{tasks}{sqp})"

    @property
    def dtype(self) -> Any:
        """Return the precision of the plans."""
        return floating_dtype(replace(self.soft, system=None))

    @property
    def state_size(self) -> int:
        """Return the length of the robot's state, nq + nv."""
        return self.robot.state_size

    @property
    def takes_forecasts(self) -> bool:
        """Return whether plans take what is known ahead of disturbances."""
        return self.fixed is not None

    @property
    def takes_numbers(self) -> bool:
        """Return whether plans take numbers of the robot's model."""
        return self.fixed is None and isinstance(self.robot, Robot)

    @property
    def limits(self) -> Box:
        """Return the robot's own state limits, without margin."""
        return self.robot.state_limits

    def coordinates(self, x: Array) -> Array:
        """Return the coordinates ξ (n,) of the robot's state."""
        return self.robot.coordinates(x)

    def start(self, x: Array, input_reference: Any = None) -> Control[Plan]:
        """Return what stands for the time step before the first: at rest at x under the first input
        of input_reference, zero for none."""
        return resting_start(self, x, input_reference)

    def __call__(
        self,
        x: Reals,
        before: Control[Plan] | None = None,
        reference: Reals | None = None,
        *,
        input_reference: Reals | None = None,
        previous_input: Reals | None = None,
        forecast: Reals | None = None,
        numbers: Mapping[str, Any] | None = None,
    ) -> Control[Plan]:
        """Return the input (m,) at the state x, its plan, in ξ, and what to remember.

        forecast: as in `solve`, in ξ, with linearize="set-point" only.
        numbers: of the robot's model, as in `Robot.vary`, in place of the file's, not with
            "set-point": an estimated payload, for one. Where both references are given, what
            holds the (first row of the) reference under them is added to input_reference, and to
            the activations of the reference.
        """
        x = one_state(self, x)
        require_before(before)
        known: dict[str, Any] = {
            "input_reference": input_reference,
            "previous_input": previous_input,
        }
        xi, reference = aligned(self.robot, self.mpc, self.coordinates(x), reference)
        where = f"with linearize={self.linearize!r} of a {type(self.robot).__name__}"
        told = given_numbers(self, numbers, where, 'linearize="state" or "trajectory" and a Robot')
        if self.fixed is not None:
            return self.fixed(xi, before, reference, **known, forecast=forecast)
        if forecast is not None:
            what = f"given with linearize={self.linearize!r}"
            fail("forecast", what, 'Give linearize="set-point", or leave it out')
        problem = self.problem
        if told:
            file, loaded = (
                RobotModel(self.robot, dict(part or {}), exact=False) for part in ({}, numbers)
            )
            reference, known["input_reference"] = held_references(
                file, loaded, reference, input_reference, self.dtype
            )
            problem = replace(problem, model=replace(loaded, exact=self.exact))
        if self.linearize == "trajectory":
            search = {"iterations": self.sqp_steps, "hessian": self.hessian, "scale": self.scale}
            return sqp_control(problem, self.solver, xi, before, reference, **known, **search)
        memory = None if before is None else before.memory
        last = last_input(self.soft, before, previous_input)
        rows = layout(self.soft)
        start = None if memory is None else memory.shifted(rows, memory.inputs[-1])
        if start is not None and rotating_joints(self.robot):
            start = anchored(start, xi)
        inputs = at_rest(self.soft, xi, input_reference)[1] if memory is None else memory.inputs
        about = limited(self.soft.inputs, inputs[0])
        known |= {"previous_input": last, "scale": self.scale}
        mpc = replace(self.soft, system=problem.model.linearize(xi, about))
        plan = solve_stagewise(mpc, xi, reference, self.solver, start, **known)
        return applied(self.soft, rows, plan, memory, last)

    @property
    def problem(self) -> NonlinearMPC:
        """Return the nonlinear problem of "trajectory"."""
        return NonlinearMPC(self.soft, as_model(self.robot, self.exact), self.tasks)

    @property
    def reference_sizes(self) -> tuple[int, ...]:
        """Return how many columns `reference` may have: n, or those and the tasks' targets."""
        return reference_sizes(self.problem) if self.tasks else (self.mpc.system.n,)


def as_model(robot: Any, exact: bool = True) -> Any:
    """Return a Robot or LinearPlant as the model of a `NonlinearMPC`."""
    return RobotModel(robot, exact=exact) if isinstance(robot, Robot) else robot


# How much more than a violated limit of a state a violated limit of a force costs.
FORCES = 100


def softened_limits(mpc: MPC, rho: Reals) -> MPC:
    """Return the problem with soft state limits, outputs and terminal rows, and limits of forces
    that weigh more."""
    outputs = as_tuple("outputs", mpc.outputs, Outputs)
    others = tuple(rows for rows in outputs if not isinstance(rows, ForceLimits))
    soft = soften(replace(mpc, outputs=others), rho)
    heavy, xp = [], module_of(rho)
    for rows in outputs:
        if isinstance(rows, ForceLimits):
            of_inputs, of_states = (
                np.abs(np.asarray(part)).max(axis=1) for part in (rows.D, rows.C)
            )
            size = np.where(of_inputs > 0, of_inputs, of_states)
            names = rows.stages, rows.names, rows.units
            weight = FORCES * xp.max(rho) / size
            heavy.append(Soft(rows.C, rows.lower, rows.upper, weight, 0.0, rows.D, *names))
    return replace(soft, soft=(*as_tuple("soft", soft.soft, Soft), *heavy))


def _prepared(given: RobotController, solver: ADMM) -> dict[str, Any]:
    """Check the arguments of a controller and compute what all its time steps share.

    Returns soft, the problem with soft state limits; fixed, the Controller of the linear model if
    that model does not change, else None; scale, the row scaling if it does, else None.
    """
    robot, mpc, linearize = given.robot, given.mpc, given.linearize
    if linearize not in LINEARIZATIONS:
        fail("linearize", f"{linearize!r}", f"Give one of {', '.join(LINEARIZATIONS)}")
    require_kind("robot", robot, Robot, LinearPlant, cure="Give a Robot or a LinearPlant")
    mpc.validate()
    sizes = (mpc.system.n, mpc.system.m)
    if sizes != (robot.n, robot.m):
        needed = f"{(robot.n, robot.m)}: robot_mpc makes such a problem"
        fail("mpc", f"has {sizes} states and inputs", f"This robot has {needed}")
    if mpc.system.dt is not None and not np.isclose(mpc.system.dt, robot.dt, rtol=1e-9, atol=0):
        cure = f"Give robot_mpc a robot loaded with control_period={mpc.system.dt:g}, or this one"
        fail("mpc", f"has dt = {mpc.system.dt:g}, the robot a period of {robot.dt:g}", cure)
    whole("sqp_steps", given.sqp_steps, 1)
    if given.hessian not in ("exact", "gauss-newton"):
        fail("hessian", f"{given.hessian!r}", 'Give "exact" or "gauss-newton"')
    if given.hessian == "exact" and given.sqp_steps == 1:
        fail("hessian", "'exact' with one quadratic program a sample", "Give sqp_steps=10")
    for name, there in (("tasks", len(given.tasks) > 0), ("sqp_steps", given.sqp_steps > 1)):
        if there and linearize != "trajectory":
            fail(name, f"given with linearize={linearize!r}", 'Give linearize="trajectory"')
    if mpc.disturbance is not None and linearize != "set-point":
        what = "given, and its rows are tightened for one linear model"
        fail("mpc.disturbance", what, 'Give linearize="set-point", or leave it out')
    if stands(robot) and linearize != "set-point":
        what = f"{linearize!r} of a robot whose feet stand, whose friction cones are of one model"
        fail("linearize", what, 'Give linearize="set-point"')
    soft = softened_limits(mpc, given.rho)
    if linearize == "set-point":
        return {"soft": arrays(soft), "fixed": Controller(soft, solver), "scale": None}
    if linearize == "trajectory":
        NonlinearMPC(soft, as_model(robot), given.tasks).validate()
    # Rows of tasks differ from state to state.
    scale = None if given.tasks else factor_stages(soft, solver).E
    return {"soft": arrays(soft), "fixed": None, "scale": scale}
