"""MPC of robots: problems from their models and limits, and the controllers that follow them."""

from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.checks import fail
from jaxmpc.control.riccati import lqr
from jaxmpc.control.sets import Box
from jaxmpc.control.system import LinearSystem
from jaxmpc.mpc.problem import MPC, Plan
from jaxmpc.mpc.soften import soften
from jaxmpc.mpc.solve import Controller, limited, shifted_multipliers
from jaxmpc.mpc.stagewise import factor_stages, layout, solve_stagewise
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.precision import arrays, floating_dtype
from jaxmpc.robots.linear import LinearPlant
from jaxmpc.robots.robot import Robot

LINEARIZATIONS = ("set-point", "state", "trajectory")


def robot_mpc(
    robot: Robot | LinearPlant, Q: Any = None, R: Any = None, horizon: int = 20, *,
    target: Any = None, margin: float = 0.02, terminal_cost: Any = "lqr", exact: bool = True,
    **fields: Any,
) -> MPC:  # fmt: skip
    """The MPC of a robot about a set-point, its limits read from the model.

    Arguments:
        Q (n, n) or its diagonal (n,), R (m, m) or (m,): weights in the coordinates ξ. None, with
            the half-widths w of the limits (1 where there are none): 1/w² for the positions and
            0.01/w² for velocities and inputs (Bryson's rule, slow motion and effort forgiven).
        target: configuration (nq,) to linearise about (of a LinearPlant the state), None for
            `robot.home`. It must be one that the actuators can hold.
        margin: share by which state limits are tightened, of the limit's half-width on each
            side: room for what the linear model leaves out. Inputs keep their limits.
        terminal_cost: "lqr", the Riccati solution of the model at the target; or P (n, n), None.
        exact: which model, see `Robot.linearize`.
        fields: of `MPC`, in place of what is chosen here: state limits at k = 1 … N (x_0 is
            measured; no input moves it), no terminal set.

    Track the target with reference = robot.coordinates(x) and input_reference = u of
    `robot.equilibrium(target)`. Raises ValueError as MPC and `equilibrium` do, or where the
    tightened limits leave out the target.
    """
    if not 0 <= margin < 1:
        fail("margin", f"{margin}", "Give a share in [0, 1)")
    if Q is None:
        Q = np.repeat([1.0, 0.01], [robot.n - robot.n // 2, robot.n // 2])
        Q = Q / robot.state_limits.half_widths() ** 2
    R = 0.01 / robot.input_limits.half_widths() ** 2 if R is None else R
    diagonal = lambda W: np.diag(W) if np.ndim(W) == 1 else W
    Q, R = diagonal(Q), diagonal(R)
    x, u = robot.equilibrium(target)
    with jax.enable_x64(True):
        point = np.asarray(robot.coordinates(x))
    states = robot.state_limits.tightened(margin)
    lower, upper = np.asarray(states.lower), np.asarray(states.upper)
    outside = np.maximum(lower - point, point - upper)
    if np.any(outside > 0):
        i = int(np.argmax(outside))
        fail(
            "target", f"has {(robot.state_names or range(len(point)))[i]} = {point[i]:g}, limits "
            f"with margin are [{lower[i]:g}, {upper[i]:g}]", "Choose another target, less margin",
        )  # fmt: skip
    with jax.enable_x64(True):
        system = jax.tree.map(np.asarray, robot.linearize(x, u, exact=exact))
    mpc = MPC(system, Q, R, horizon, states=states, inputs=robot.input_limits)
    mpc.validate()
    mpc = replace(mpc, constrained_steps=tuple(range(1, horizon + 1)))
    if isinstance(terminal_cost, str):
        if terminal_cost != "lqr":
            fail("terminal_cost", f"{terminal_cost!r}", 'Give "lqr", a matrix or None')
        terminal_cost = np.asarray(lqr(system, Q, R).P)
    mpc = replace(mpc, **{"terminal_cost": terminal_cost, **fields})
    mpc.validate()
    return mpc


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class RobotController:
    """MPC of a nonlinear robot by linear models, soft where the limits cannot be kept.

    robot: Robot (its predictor is the model). mpc: the problem, from `robot_mpc`; its `system` is
    used by linearize="set-point" only. linearize: where the models are taken,
      "set-point"   once, as mpc.system says; matrices are factored once for all robots;
      "state"       about the measured state and the last input, anew at each sample;
      "trajectory"  about the last plan, moved up by one sample: a model for each step.
    exact: see `Robot.linearize`.

    State limits and terminal rows are soft with the L1 weight `penalty` (cost per unit): where
    it exceeds the multipliers of the hard problem, plans keep the limits whenever the model can
    (exact penalty), and break them as little as that weight asks where it cannot. Each such plan
    is counted: `Run.fallback`. Input limits are hard.

    `controller(x, carry, reference, input_reference=)` as `Controller`, x (nq + nv,) the state of
    the robot, references in its coordinates (see `robot.trajectory`). `start` gives the first
    carry, and takes the first point of linearisation from input_reference. soft, fixed and scale
    (of rows, from mpc.system) are filled in at construction.
    """

    robot: Any
    mpc: MPC
    solver: ADMM = ADMM(iterations=50, refine=3)  # noqa: RUF009
    linearize: str = field(default="state", metadata={"static": True})
    exact: bool = field(default=False, metadata={"static": True})
    penalty: Any = 1e4
    soft: Any = None
    fixed: Any = None
    scale: Any = None

    def __post_init__(self) -> None:
        if self.soft is not None or not isinstance(self.mpc, MPC):
            return  # JAX rebuilds this object with its parts present
        if self.linearize not in LINEARIZATIONS:
            fail("linearize", f"{self.linearize!r}", f"Give one of {', '.join(LINEARIZATIONS)}")
        if not isinstance(self.robot, Robot | LinearPlant):
            fail("robot", f"is a {type(self.robot).__name__}", "Give a Robot or a LinearPlant")
        self.mpc.validate()
        sizes = (self.mpc.system.n, self.mpc.system.m)
        if sizes != (self.robot.n, self.robot.m):
            needed = f"{(self.robot.n, self.robot.m)}: robot_mpc makes such a problem"
            fail("mpc", f"has {sizes} states and inputs", f"This robot has {needed}")
        soft = soften(self.mpc, self.penalty)
        put = lambda name, value: object.__setattr__(self, name, value)
        if self.linearize == "set-point":
            put("fixed", Controller(soft, self.solver))
        else:
            put("scale", factor_stages(soft, soft.system, self.solver).E)
        put("soft", arrays(soft))
        put("solver", arrays(self.solver))

    @property
    def dtype(self) -> Any:
        """In what the controller computes."""
        return floating_dtype(replace(self.soft, system=None))

    @property
    def state_size(self) -> int:
        """Numbers in the state of the robot."""
        return self.robot.state_size

    @property
    def limits(self) -> Box:
        """The robot's own state limits, without margin."""
        return self.robot.state_limits

    def coordinates(self, x: Array) -> Array:
        """The coordinates ξ of the robot's state."""
        return self.robot.coordinates(x)

    def start(self, x: Array, input_reference: Any = None) -> Plan:
        """A plan that rests at x under the first input of input_reference (zero for none)."""
        shapes = jax.eval_shape(lambda x: self(x, None, input_reference=input_reference)[2], x)
        zeros = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
        states, inputs = self._resting(x, input_reference)
        return replace(zeros, states=states, inputs=inputs)

    def _resting(self, x: Array, input_reference: Any) -> tuple[Array, Array]:
        """States (N+1, n) that stay at x, inputs (N, m) the first of input_reference."""
        xi, N, m = self.coordinates(x), self.soft.horizon, self.robot.m
        u = jnp.zeros(m, xi.dtype) if input_reference is None else jnp.asarray(input_reference)
        u = jnp.broadcast_to(u[0] if u.ndim == 2 else u, (N, m)).astype(xi.dtype)
        return jnp.broadcast_to(xi, (N + 1, len(xi))), u

    def __call__(
        self, x: Any, carry: Plan | None = None, reference: Any = None, *,
        input_reference: Any = None, previous_input: Any = None,
    ) -> tuple[Array, Plan, Plan]:  # fmt: skip
        """First input (m,) from the state x, what to carry on, and the plan in coordinates ξ."""
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
            # One sample later, its last step twice.
            inputs = jnp.concatenate([carry.inputs[1:], carry.inputs[-1:]])
            states = jnp.concatenate([carry.states[1:], carry.states[-1:]])
            y = shifted_multipliers(layout(self.soft), self.soft.horizon, carry.qp.y)
            start = (inputs, y)
        system = self._model(x, states, inputs, carry)
        plan = solve_stagewise(
            self.soft, system, self.coordinates(x), reference, self.solver, start,
            input_reference=input_reference, scale=self.scale,
        )  # fmt: skip
        return limited(self.soft.inputs, plan.inputs[0]), plan, plan

    def _model(self, x: Array, states: Array, inputs: Array, carry: Plan | None) -> LinearSystem:
        """The linear model about x, or about each step of a plan."""
        if self.linearize == "state":
            u = inputs[0] if carry is None else carry.inputs[0]
            return self.robot.linearize(x, limited(self.soft.inputs, u), exact=self.exact)
        states = states.at[0].set(self.coordinates(x))
        at = lambda xi, u: self.robot.linearize(self.robot.state(xi), u, exact=self.exact)
        return jax.vmap(at)(states[:-1], inputs)
