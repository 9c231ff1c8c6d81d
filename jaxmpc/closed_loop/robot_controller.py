"""RobotController: MPC of a nonlinear robot by linear models, with soft state limits."""

from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.checks import fail
from jaxmpc.control.sets import Box
from jaxmpc.control.system import LinearSystem
from jaxmpc.mpc.controller import Controller
from jaxmpc.mpc.plan import Plan, WarmStart, limited
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.rows import layout
from jaxmpc.mpc.soften import soften
from jaxmpc.mpc.stagewise import factor_stages, solve_stagewise
from jaxmpc.qp.admm import ADMM, DEFAULT
from jaxmpc.qp.precision import arrays, floating_dtype
from jaxmpc.robots.linear import LinearPlant
from jaxmpc.robots.robot import Robot

LINEARIZATIONS = ("set-point", "state", "trajectory")


@dataclass(frozen=True, eq=False, init=False)
class RobotController:
    """MPC of a nonlinear robot by linear models, soft where the limits cannot be kept.

    robot: Robot (its predictor is the model) or LinearPlant.
    mpc: the problem, from `robot_mpc`; its `system` is used by linearize="set-point" only.
    solver: with iterations=None, as by default, there are no ADMM steps but Newton steps from the
      last plan and, where they do not end at the solution, an interior point method
      (`solve_stagewise`); with "set-point" the steps are those of `solve`.
    linearize: where the linear models are taken,
      "set-point"   once, as mpc.system says; matrices are factored once for all robots;
      "state"       about the measured state and the last input, at each sample;
      "trajectory"  about the last plan shifted by one sample, a model for each step.
    exact: see `Robot.linearize`.
    penalty: L1 weight (cost per unit) with which state limits and terminal rows are soft. Where it
      exceeds the multipliers of the hard problem, plans keep the limits whenever the model can
      (exact penalty), and elsewhere trade violations against the cost by that weight. Each such
      plan is counted: `Run.fallback`. Input limits are hard.

    `controller(x, carry, reference, input_reference=)` as `Controller`, x (nq + nv,) the state of
    the robot, references in its coordinates (see `robot.trajectory`). `start` gives the first
    carry, and takes the first point of linearisation from input_reference.

    A pytree. Calling the class prepares the problem, see `prepared`; JAX and `tree_map` rebuild
    the object without that, `dataclasses.replace` prepares it again. Raises ValueError for
    arguments that do not fit together.
    """

    robot: Any
    mpc: MPC
    solver: ADMM
    linearize: str
    exact: bool
    penalty: Any
    soft: Any = field(init=False)
    fixed: Controller | None = field(init=False)
    scale: Any = field(init=False)

    def __init__(
        self, robot: Any, mpc: MPC, solver: ADMM | None = None, linearize: str = "state",
        exact: bool = False, penalty: Any = 1e4,
    ) -> None:  # fmt: skip
        solver = DEFAULT if solver is None else solver
        if solver.iterations is None and linearize != "set-point":
            solver = replace(solver, iterations=0)
        parts = prepared(robot, mpc, solver, linearize, penalty)
        self.__dict__.update(
            robot=robot, mpc=mpc, solver=arrays(solver), linearize=linearize, exact=exact,
            penalty=penalty, **parts,
        )  # fmt: skip

    @property
    def dtype(self) -> Any:
        """Return the precision of the plans."""
        return floating_dtype(replace(self.soft, system=None))

    @property
    def state_size(self) -> int:
        """Return the length of the robot's state, nq + nv."""
        return self.robot.state_size

    @property
    def limits(self) -> Box:
        """Return the robot's own state limits, without margin."""
        return self.robot.state_limits

    def coordinates(self, x: Array) -> Array:
        """Return the coordinates ξ (n,) of the robot's state."""
        return self.robot.coordinates(x)

    def start(self, x: Array, input_reference: Any = None) -> Plan:
        """Return a plan at rest at x under the first input of input_reference, zero for none."""
        shapes = jax.eval_shape(lambda x: self(x, None, input_reference=input_reference)[2], x)
        zeros = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
        states, inputs = self._resting(x, input_reference)
        return replace(zeros, states=states, inputs=inputs)

    def _resting(self, x: Array, input_reference: Any) -> tuple[Array, Array]:
        """Return states (N+1, n) that stay at x and inputs (N, m), the first of input_reference."""
        xi, N, m = self.coordinates(x), self.soft.horizon, self.robot.m
        u = jnp.zeros(m, xi.dtype) if input_reference is None else jnp.asarray(input_reference)
        u = jnp.broadcast_to(u[0] if u.ndim == 2 else u, (N, m)).astype(xi.dtype)
        return jnp.broadcast_to(xi, (N + 1, len(xi))), u

    def __call__(
        self, x: Any, carry: Plan | None = None, reference: Any = None, *,
        input_reference: Any = None, previous_input: Any = None,
    ) -> tuple[Array, Plan, Plan]:  # fmt: skip
        """Return the first input (m,) from the state x, the next carry, and the plan in ξ."""
        x = jnp.asarray(x, self.dtype)
        if np.shape(x) != (self.state_size,):
            fail("x", f"shape {np.shape(x)}", f"Give one state ({self.state_size},)")
        if self.fixed is not None:
            return self.fixed(
                self.coordinates(x), carry, reference, input_reference=input_reference,
                previous_input=previous_input,
            )  # fmt: skip
        if carry is None:
            states, inputs = self._resting(x, input_reference)
            start = None
        else:
            start = WarmStart.shifted(layout(self.soft), carry, carry.inputs[-1])
            states, inputs = start.states, start.inputs
        system = self._model(x, states, inputs, carry)
        plan = solve_stagewise(
            self.soft, system, self.coordinates(x), reference, self.solver, start,
            input_reference=input_reference, scale=self.scale,
        )  # fmt: skip
        return limited(self.soft.inputs, plan.inputs[0]), plan, plan

    def _model(self, x: Array, states: Array, inputs: Array, carry: Plan | None) -> LinearSystem:
        """Return the linear model about x, or one about each step of a plan."""
        if self.linearize == "state":
            u = inputs[0] if carry is None else carry.inputs[0]
            return self.robot.linearize(x, limited(self.soft.inputs, u), exact=self.exact)
        states = states.at[0].set(self.coordinates(x))
        at = lambda xi, u: self.robot.linearize(self.robot.state(xi), u, exact=self.exact)
        return jax.vmap(at)(states[:-1], inputs)


def prepared(
    robot: Any, mpc: MPC, solver: ADMM, linearize: str, penalty: Any
) -> dict[str, Any]:  # fmt: skip
    """Check the arguments of a RobotController and compute what all its samples share.

    Returns soft, the problem with soft state limits; fixed, the Controller of the linear model if
    that model does not change, else None; scale, the row scaling if it does, else None.
    """
    if linearize not in LINEARIZATIONS:
        fail("linearize", f"{linearize!r}", f"Give one of {', '.join(LINEARIZATIONS)}")
    if not isinstance(robot, Robot | LinearPlant):
        fail("robot", f"is a {type(robot).__name__}", "Give a Robot or a LinearPlant")
    mpc.validate()
    sizes = (mpc.system.n, mpc.system.m)
    if sizes != (robot.n, robot.m):
        needed = f"{(robot.n, robot.m)}: robot_mpc makes such a problem"
        fail("mpc", f"has {sizes} states and inputs", f"This robot has {needed}")
    soft = soften(mpc, penalty)
    if linearize == "set-point":
        return {"soft": arrays(soft), "fixed": Controller(soft, solver), "scale": None}
    scale = factor_stages(soft, soft.system, solver).E
    return {"soft": arrays(soft), "fixed": None, "scale": scale}


STATIC = ("linearize", "exact")
LEAVES = ("robot", "mpc", "solver", "penalty", "soft", "fixed", "scale")


def _flatten(controller: RobotController) -> tuple[tuple, tuple]:
    values = controller.__dict__
    return tuple(values[name] for name in LEAVES), tuple(values[name] for name in STATIC)


def _unflatten(static: tuple, leaves: tuple) -> RobotController:
    controller = object.__new__(RobotController)
    controller.__dict__.update(zip((*LEAVES, *STATIC), (*leaves, *static), strict=True))
    return controller


jax.tree_util.register_pytree_node(RobotController, _flatten, _unflatten)
