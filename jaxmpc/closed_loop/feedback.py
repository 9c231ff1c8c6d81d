"""What a closed loop needs of a plant and of a controller; LinearFeedback, the simplest one."""

from typing import Any, NamedTuple, Protocol

import jax.numpy as jnp
from jax import Array

from jaxmpc.arrays import Reals
from jaxmpc.checks import fail, require_finite, require_shape
from jaxmpc.closed_loop.orientations import error_of
from jaxmpc.mpc.controller import zeros_of
from jaxmpc.mpc.plan import Control, limited, require_before
from jaxmpc.mpc.problem import MPC, at_stage
from jaxmpc.pytrees import named_pytree, pytree
from jaxmpc.qp.linalg import floating_dtype, matmul
from jaxmpc.qp.status import Status
from jaxmpc.robots.robot import RobotModel


class Plant(Protocol):
    """A plant: its state one time step later. Written in JAX.

    Where it has them, also `state_size` and `m`, the sizes of state and input; `coordinates(x)` and
    `state(ξ)` between states and the coordinates in which controllers are written; and
    `vary(**numbers)`, the same plant with other parameters.
    """

    def step(self, x: Any, u: Any) -> Array:
        """Return the next state."""
        ...


class Feedback(Protocol):
    """A controller: `jm.Controller`, `RobotController`, `NonlinearController`, `LinearFeedback`, or
    another such object.

    mpc: whose horizon and weights evaluate the loop. dtype: the precision of the inputs.
    state_size: the length of the plant's state. limits: by which the plant's states are evaluated.
    One that follows a motion of its own, as `GaitController` does, also has `motion(t)`, the state
    and input at step t, and may have `distance(x, xi, t)`, how far x is from ξ in the coordinates
    that are weighed then; `begun(before, t)`, what `start` gives for plans that begin at step t;
    and `numbers_at(t)`, the numbers of the robot's model then.
    """

    @property
    def mpc(self) -> MPC: ...
    @property
    def dtype(self) -> Any: ...
    @property
    def state_size(self) -> int: ...
    @property
    def limits(self) -> Any: ...
    def coordinates(self, x: Array) -> Array:
        """Return the coordinates ξ (n,) of a state."""
        ...

    def start(self, x: Array, input_reference: Any = None) -> Control[Any]:
        """Return what stands for the time step before the first."""
        ...

    def __call__(
        self,
        x: Array,
        before: Any = None,
        reference: Any = None,
        *,
        input_reference: Any = None,
        previous_input: Any = None,
    ) -> Control[Any]:
        """Return the input at the state x, its plan, and what to remember."""
        ...


def model_of(controller: Feedback, t: Any = 0) -> Any:
    """Return the model that a controller has of its plant at step t of a loop: a Robot, the model
    of a NonlinearController, a LinearPlant or LinearSystem."""
    numbers_at = getattr(controller, "numbers_at", None)
    if numbers_at is not None:  # other feet stand at other steps
        robot: Any = getattr(controller, "robot", None)
        return RobotModel(robot, numbers_at(t), exact=False)
    own = (getattr(controller, name, None) for name in ("robot", "plant", "model"))
    return next((model for model in own if model is not None), controller.mpc.system)


def one_state(controller: Feedback, x: Reals) -> Array:
    """Return a state as an array of the controller's precision; raise ValueError for other
    shapes."""
    x = jnp.asarray(x, controller.dtype)
    if x.shape != (controller.state_size,):
        fail("x", f"shape {x.shape}", f"Give one state ({controller.state_size},)")
    return x


def first_row(reference: Reals, dtype: Any) -> Array:
    """Return a reference, or the first of its rows, as an array."""
    rows = jnp.asarray(reference, dtype)
    return rows[0] if rows.ndim == 2 else rows


@named_pytree
class NoPlan(NamedTuple):
    """The plan of a law without plans.

    cost: NaN. status: NOT_RUN. slack: none, (N+1, 0).
    """

    cost: Array
    status: Array
    slack: Array


@pytree
class LinearFeedback:
    """The law u = clip(s + K (ξ − r)): linear state feedback inside the input limits of `mpc`.

    mpc: weights, limits and horizon by which runs are evaluated, as for a Controller. K (m, n).
    plant: a Robot, which defines the coordinates ξ and the limits; None: ξ = x. References r (n,)
    and s (m,), or rows of them of which the first counts, as in `Controller`; zero for none.
    Of a state that holds NaN u is NaN, where that of a Controller is finite, and no status tells;
    the law has no memory, so that the next finite state has its u again.
    """

    mpc: MPC
    K: Any
    plant: Any = None

    def validate(self) -> None:
        """Raise ValueError unless K is finite and (m, n)."""
        n, m = self.mpc.system.n, self.mpc.system.m
        require_shape("K", self.K, (m, n), "u = K x, one row an input")
        require_finite("K", self.K)

    @property
    def dtype(self) -> Any:
        """Return the precision of the inputs."""
        return floating_dtype((self.mpc.Q, self.mpc.R, self.K))

    @property
    def state_size(self) -> int:
        """Return the length of the state x."""
        return self.mpc.system.n if self.plant is None else self.plant.state_size

    @property
    def limits(self) -> Any:
        """Return the state limits by which a closed loop is evaluated."""
        states = at_stage(self.mpc.states, 0)
        return states if self.plant is None else self.plant.state_limits

    def coordinates(self, x: Array) -> Array:
        """Return the coordinates ξ (n,) of a state."""
        return x if self.plant is None else self.plant.coordinates(x)

    def start(self, x: Array, input_reference: Any = None) -> Control[NoPlan]:
        """Return what stands for the time step before the first: zeros."""
        return zeros_of(self, x)

    def __call__(
        self,
        x: Reals,
        before: Control[NoPlan] | None = None,
        reference: Reals | None = None,
        *,
        input_reference: Reals | None = None,
        previous_input: Reals | None = None,
    ) -> Control[NoPlan]:
        """Return the input (m,) at the state x, without plan and memory."""
        self.validate()
        require_before(before)
        x = one_state(self, x)
        r, s = (None if v is None else first_row(v, x.dtype) for v in (reference, input_reference))
        error = error_of(self.plant, self.mpc, self.coordinates(x), r)
        u = (0 if s is None else s) + matmul(jnp.asarray(self.K, x.dtype), error)
        u = limited(self.mpc.inputs, u)
        not_run, no_slack = jnp.asarray(Status.NOT_RUN, jnp.int32), jnp.zeros((1, 0), x.dtype)
        return Control(u, NoPlan(jnp.asarray(jnp.nan, x.dtype), not_run, no_slack), None)
