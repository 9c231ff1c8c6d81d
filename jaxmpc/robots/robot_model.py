"""RobotModel: what a controller predicts of a robot, as the model of a `NonlinearMPC`."""

from dataclasses import field
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.pytrees import pytree, static
from jaxmpc.robots.robot import Robot
from jaxmpc.systems.system import LinearSystem


@pytree
class RobotModel:
    """The predictor of a robot (no contacts, no joint limits) in the coordinates ξ.

    numbers: fields of mjx.Model in place of the file's, as in `Robot.vary` (masses, damping), with
    respect to which plans can be differentiated. exact: see `Robot.linearize`; sequential quadratic
    programming needs it.
    """

    robot: Robot
    numbers: dict[str, Any] = field(default_factory=dict)
    exact: bool = static(default=True)

    def step(self, xi: Array, u: Array) -> Array:
        """Return ξ (n,) one control period later."""
        robot = self.robot
        advance = lambda x, _: (robot.predictor.step(x, u, self.numbers), None)
        return robot.coordinates(jax.lax.scan(advance, robot.state(xi), length=robot.substeps)[0])

    def linearize(self, xi: Array, u: Array) -> LinearSystem:
        """Return the affine model about ξ, u."""
        state = self.robot.state(xi)
        return self.robot.linearize(state, u, exact=self.exact, numbers=self.numbers)

    def view(self, xi: Array, u: Array) -> Any:
        """Return mjx.Data at ξ under u: qpos, qvel, act, ctrl, the poses and velocities of bodies,
        geoms and sites, the forces of actuators and springs."""
        robot = self.robot
        x = jnp.asarray(robot.state(xi))
        return robot.predictor.data(x, u, self.numbers)
