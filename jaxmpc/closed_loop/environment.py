"""Environment: a robot with a task as functions for reinforcement learning; MPCPolicy: an MPC in
the place of the agent."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import Reals, as_floats
from jaxmpc.checks import fail, number, require_kind, require_shape, require_symmetric_psd, whole
from jaxmpc.closed_loop.feedback import Feedback, LinearFeedback, model_of
from jaxmpc.closed_loop.orientations import error_of
from jaxmpc.closed_loop.robot_controller import weights_of
from jaxmpc.closed_loop.variations import free_motions, start_room
from jaxmpc.mpc.plan import limited
from jaxmpc.pytrees import pytree, static
from jaxmpc.qp.linalg import matmul
from jaxmpc.robots.description import host_coordinates
from jaxmpc.robots.linear_plant import LinearPlant
from jaxmpc.robots.robot import Robot
from jaxmpc.sets.limits import rows_kept, worst_violation


@pytree
class EnvironmentState:
    """The state of an episode: a pytree, with batch axes in front under `jax.vmap`.

    x (nq + nv,): the robot's state. observation (n,): its coordinates ξ. reward: of the step that
    led here, 0 at the start. terminated: a limit was exceeded, or the state is not finite.
    truncated: the episode has its full length. steps: so far. violation: the most by which
    ξ exceeds a state limit, in its unit.
    """

    x: Array
    observation: Array
    reward: Array
    terminated: Array
    truncated: Array
    steps: Array
    violation: Array

    @property
    def done(self) -> Array:
        """Return whether the episode has ended."""
        return self.terminated | self.truncated


@pytree
class Environment:
    """A robot that has to reach a target from random starts; made by `Environment.of`.

        state = environment.reset(key);  state = environment.step(state, action)

    are pure functions for `jax.jit`, `jax.vmap`, `jax.lax.scan` and derivatives, as in Brax. The
    action (m,) is the input, clipped into its limits and held for a control period. The reward of a
    step is −(ξ − r)'Q(ξ − r) − (u − s)'R(u − s) of the state before it, so that the return is
    minus the sum of `Run.stage_cost`.

    robot: a Robot or LinearPlant; `replace(environment, robot=robot.vary(...))` has another plant,
    a batch of them under `jax.vmap`. reference r (n,), input_reference s (m,): the target, at rest.
    Q (n, n), R (m, m). home (n,), below (n,), above (n,): coordinates of starts are uniform in
    [home − below, home + above], projected by motions (n, n) onto those that keep the couplings of
    the file to first order (None: there are none). length: steps of an episode. stop_at_limits:
    whether it ends where a state limit is exceeded. A pytree.
    """

    robot: Any
    reference: Any
    input_reference: Any
    Q: Any
    R: Any
    home: Any
    below: Any
    above: Any
    motions: Any = None
    length: int = static(default=200)
    stop_at_limits: bool = static(default=False)

    @classmethod
    def of(
        cls,
        robot: Robot | LinearPlant,
        target: Reals | None = None,
        *,
        Q: Reals | None = None,
        R: Reals | None = None,
        spread: float = 0.5,
        length: int = 200,
        stop_at_limits: bool = False,
    ) -> "Environment":
        """Return the environment of a robot and a target (nq,), None for its home.

        Q, R: weights, matrices or diagonals, semidefinite; None for those of `robot_mpc`. spread:
        starts are uniform up to this fraction of the way from home to each limit; a coordinate
        without a limit starts within ±spread, in its unit. Raises ValueError for weights that are
        not semidefinite, and as `Robot.equilibrium` does.
        """
        require_kind("robot", robot, Robot, LinearPlant)
        whole("length", length, 1)
        number("spread", spread, 0.0, "Give a fraction of at least 0")
        if not isinstance(stop_at_limits, bool | np.bool_):
            fail("stop_at_limits", f"{stop_at_limits!r}", "Give True or False")
        Q, R = weights_of(robot, Q, R)
        for name, weight, size in (("Q", Q, robot.n), ("R", R, robot.m)):
            require_shape(name, weight, (size, size), "Give a matrix, or its diagonal")
            require_symmetric_psd(name, weight)
        x, u = robot.set_point(target)
        home, below, above = start_room(robot)
        room = (home, spread * below, spread * above)
        reference = host_coordinates(robot, x)
        motions = free_motions(robot)
        return cls(robot, reference, u, Q, R, *room, motions, length, stop_at_limits)

    def reset(self, key: Array) -> EnvironmentState:
        """Return a random start; key: of JAX, such as jax.random.key(0)."""
        kind = getattr(key, "dtype", None)
        if kind is None or not (kind == jnp.uint32 or jnp.issubdtype(kind, jax.dtypes.prng_key)):
            fail("key", f"{key!r}", "Give a JAX key: jax.random.key(0)")
        if key.ndim != (kind == jnp.uint32):
            what = f"is an array of keys, shape {key.shape}"
            fail("key", what, "Give one, or use jax.vmap(environment.reset)(keys)")
        aside = jax.random.uniform(key, (self.robot.n,), minval=-1.0, maxval=1.0)
        room = jnp.where(aside > 0, jnp.asarray(self.above), jnp.asarray(self.below))
        start = room * aside if self.motions is None else matmul(self.motions, room * aside)
        return self.at(self.robot.state((jnp.asarray(self.home) + start).astype(aside.dtype)))

    def at(self, x: Any) -> EnvironmentState:
        """Return the start of an episode at the state x (nq + nv,)."""
        require_shape("x", x, (self.robot.state_size,), "One state; use jax.vmap for many")
        x = jnp.asarray(as_floats(x))
        return self._state(x, jnp.zeros(()), jnp.asarray(0))

    def step(self, state: EnvironmentState, action: Any) -> EnvironmentState:
        """Return the state one control period later, under the action (m,)."""
        robot, dtype = self.robot, state.x.dtype
        require_shape("action", action, (robot.m,), "One number an input; use jax.vmap for many")
        at_rest = "An episode has one target, at rest; use jax.vmap for many"
        require_shape("reference", self.reference, (robot.n,), at_rest)
        require_shape("input_reference", self.input_reference, (robot.m,), at_rest)
        u = limited(robot.input_limits, jnp.asarray(action, dtype))
        xi, target = robot.coordinates(state.x), jnp.asarray(self.reference, dtype)
        error = error_of(robot, robot.state_limits, xi, target)
        effort = u - jnp.asarray(self.input_reference, dtype)
        square = lambda v, W: jnp.sum(v * matmul(jnp.asarray(W, dtype), v))
        reward = -square(error, self.Q) - square(effort, self.R)
        return self._state(robot.step(state.x, u), reward, state.steps + 1)

    def policy(self, controller: Feedback) -> "MPCPolicy":
        """Return a controller of this robot as a policy for the target."""
        return MPCPolicy(controller, self.reference, self.input_reference)

    def _state(self, x: Array, reward: Array, steps: Array) -> EnvironmentState:
        xi = self.robot.coordinates(x)
        limits = jax.tree.map(lambda v: jnp.asarray(v, xi.dtype), self.robot.state_limits)
        violation = worst_violation(limits, xi)
        ended = jnp.isnan(violation)
        if self.stop_at_limits:
            ended = ended | ~jnp.all(rows_kept(limits, xi))
        return EnvironmentState(
            x=x,
            observation=xi,
            reward=reward.astype(xi.dtype),
            terminated=ended,
            truncated=steps >= self.length,
            steps=steps,
            violation=violation,
        )


@pytree
class MPCPolicy:
    """A controller as a policy: `policy(observation) -> action`, a pure function.

    controller: a Controller, RobotController or LinearFeedback. reference, input_reference: the
    target, as a plan takes it, the same at each call. The observation (n,) is the coordinates ξ.
    Each call solves its plan from a cold start; `controller(x, before)` is warm-started. Under
    `jax.jit`, `jax.vmap`, and differentiable in the observation, the references and all that the
    controller is made of. A pytree: `replace(policy, reference=...)` under `jax.vmap` gives each
    robot its own target.
    """

    controller: Feedback
    reference: Any = None
    input_reference: Any = None

    def __call__(self, observation: Any, previous_input: Any = None) -> Array:
        """Return the action (m,) for an observation (n,). previous_input (m,): the action before,
        which problems with limits or weights of input rates need."""
        if hasattr(self.controller, "motion"):
            what = f"is a {type(self.controller).__name__}, whose plans begin where the last ended"
            fail("controller", what, "Call controller(x, before) with what it returned before")
        n = self.controller.mpc.system.n
        planned = not isinstance(self.controller, LinearFeedback)
        if planned and self.controller.mpc.input_in_state and previous_input is None:
            what = "is None, and the plan depends on it: rates of the inputs are limited or cost"
            fail("previous_input", what, "Give the action before, at first what is applied now")
        require_shape("observation", observation, (n,), "The coordinates; use jax.vmap for many")
        xi = jnp.asarray(observation, self.controller.dtype)
        model = model_of(self.controller)
        x = model.state(xi) if hasattr(model, "state") else xi
        aims = {"reference": self.reference, "input_reference": self.input_reference}
        return self.controller(x, **aims, previous_input=previous_input).u
