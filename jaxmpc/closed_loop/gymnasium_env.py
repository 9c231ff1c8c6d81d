"""RobotEnv: a robot as an environment of Gymnasium (`pip install -e '.[gymnasium]'`).

import gymnasium
env = gymnasium.make("jaxmpc.closed_loop.gymnasium_env:jaxmpc/Robot-v0", robot="pendulum")
"""

from typing import Any

import gymnasium
import jax
import numpy as np

from jaxmpc.checks import fail, require_finite, require_real
from jaxmpc.closed_loop.environment import Environment, EnvironmentState
from jaxmpc.robots.linear_plant import LinearPlant
from jaxmpc.robots.load import load_robot
from jaxmpc.robots.robot import Robot

_reset, _step = jax.jit(Environment.reset), jax.jit(Environment.step)


class RobotEnv(gymnasium.Env):
    """A robot that has to reach a target, as a Gymnasium environment.

    robot: a Robot, or what `load_robot` takes. target, options: of `Environment.of`. Actions (m,)
    are the inputs within their limits, observations (n,) the coordinates ξ, both float32; rewards
    minus the stage cost. An episode is truncated after `length` steps, and ends before where a
    limit is exceeded if `stop_at_limits`. info: "violation", the most by which a state limit is
    exceeded, and "state" x (nq + nv,). `reset(options={"state": x})` starts at x. For many robots
    at once use `Environment` under `jax.vmap`. Raises ValueError as `Environment.of` does, or for
    inputs without limits.
    """

    metadata = {"render_modes": []}

    def __init__(self, robot: Any = "pendulum", target: Any = None, **options: Any) -> None:
        robot = robot if isinstance(robot, Robot | LinearPlant) else load_robot(robot)
        self.environment = Environment.of(robot, target, **options)
        lower, upper = (
            np.broadcast_to(end.astype(np.float32), (robot.m,))
            for end in robot.input_limits.bounds()
        )
        if not np.all(np.isfinite([lower, upper])):
            fail("robot", "has inputs without limits", "Give torque limits, see load_robot")
        self.action_space = gymnasium.spaces.Box(lower, upper, dtype=np.float32)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (robot.n,), np.float32)
        self._state: EnvironmentState | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Return the observation of a random start, or of options["state"], and info."""
        super().reset(seed=seed)
        key = jax.random.key(int(self.np_random.integers(2**31)))
        if options and set(options) != {"state"}:
            fail("options", f"has the names {', '.join(options)}", 'Give {"state": x}, or none')
        if options:
            require_finite('options["state"]', options["state"])
            self._state = self.environment.at(np.asarray(options["state"]))
        else:
            self._state = _reset(self.environment, key)
        return self._seen()

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Return observation, reward, terminated, truncated and info after an action."""
        if self._state is None:
            fail("step", "before the first reset", "Call reset()")
        require_real("action", action)
        self._state = state = _step(self.environment, self._state, np.asarray(action))
        observation, info = self._seen()
        ended = bool(state.terminated), bool(state.truncated)
        return observation, float(state.reward), *ended, info

    def _seen(self) -> tuple[np.ndarray, dict[str, Any]]:
        assert self._state is not None
        info = {"violation": float(self._state.violation), "state": np.asarray(self._state.x)}
        return np.asarray(self._state.observation, np.float32), info


gymnasium.register("jaxmpc/Robot-v0", entry_point=RobotEnv)
