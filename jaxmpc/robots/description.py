"""What is known of a robot: its two models, limits, names and sizes, and its coordinates."""

from dataclasses import field
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import host_array
from jaxmpc.checks import fail, require_finite, require_shape
from jaxmpc.pytrees import record, static
from jaxmpc.qp.precision import floating_dtype
from jaxmpc.robots.configurations import difference, quaternions, retract, unit_orientations
from jaxmpc.robots.mujoco_access import mujoco
from jaxmpc.robots.physics import Physics
from jaxmpc.sets.box import Box


@record
class RobotDescription:
    """The fields of a `Robot`, which says what they mean."""

    state_limits: Box
    input_limits: Box
    home: Any
    plant: Physics = static()
    predictor: Physics = static()
    anchor: tuple[float, ...] = static()
    substeps: int = static()
    dt: float = static()
    name: str = static(default="")
    state_names: tuple[str, ...] = static(default=())
    state_units: tuple[str, ...] = static(default=())
    input_names: tuple[str, ...] = static(default=())
    input_units: tuple[str, ...] = static(default=())
    numbers: dict[str, Any] = field(default_factory=dict)
    notes: tuple[tuple[str, str], ...] = static(default=())
    file: Any = static(default=None)

    @property
    def mujoco(self) -> "mujoco.MjModel":
        """Return the plant as MuJoCo's own model, for rendering and the C engine."""
        return self.plant.model

    def __repr__(self) -> str:
        """Return the name and the sizes, in one line; `report` has the rest."""
        return f"Robot({self.name!r}, n={self.n}, m={self.m}, dt={self.dt:g} s)"

    @property
    def n(self) -> int:
        """Return the number of coordinates ξ, 2 nv + na."""
        return 2 * self.mujoco.nv + self.mujoco.na

    @property
    def m(self) -> int:
        """Return the number of inputs."""
        return self.mujoco.nu

    @property
    def joints(self) -> tuple[int, ...]:
        """Return the mjtJoint of each joint."""
        return self.plant.joints

    @property
    def state_size(self) -> int:
        """Return the length of the state x, nq + nv + na."""
        return self.mujoco.nq + self.mujoco.nv + self.mujoco.na

    def coordinates(self, x: Any) -> Array:
        """Return ξ (n,) of a state x (nq + nv + na,)."""
        x = jnp.asarray(x)
        require_shape("x", x, (self.state_size,), "Give (qpos, qvel, act) of one robot")
        if not quaternions(self.joints):
            return x
        nq = self.mujoco.nq
        anchor = jnp.asarray(self.anchor, x.dtype)
        return jnp.concatenate([difference(self.joints, anchor, x[:nq]), x[nq:]])

    def state(self, coordinates: Any) -> Array:
        """Return x (nq + nv + na,) with the coordinates ξ (n,)."""
        xi = jnp.asarray(coordinates)
        require_shape("coordinates", xi, (self.n,), "Two numbers a dof; use jax.vmap for many")
        if not quaternions(self.joints):
            return xi
        nv = self.mujoco.nv
        anchor = jnp.asarray(self.anchor, xi.dtype)
        return jnp.concatenate([retract(self.joints, anchor, xi[:nv]), xi[nv:]])

    def checked_arrays(self, x: Any, u: Any) -> tuple[Array, Array]:
        """Return a state and an input as arrays of one dtype; raise ValueError for wrong shapes."""
        size = self.state_size
        problem = "Give (qpos, qvel, act) of one robot; use jax.vmap for many"
        if np.shape(x) == (self.n,) != (size,):
            problem = "That is the size of the coordinates: robot.state(ξ) makes a state of them"
        require_shape("x", x, (size,), problem)
        require_shape("u", u, (self.m,), "One number for each actuator")
        dtype = floating_dtype((x, u))
        return jnp.asarray(x, dtype), jnp.asarray(u, dtype)

    def configurations(self, argument: str, q: Any) -> np.ndarray:
        """Return q (..., nq) in float64 with unit quaternions; raise ValueError for wrong ones."""
        q = host_array(argument, q)
        if q.shape[-1:] != (self.mujoco.nq,):
            fail(argument, f"shape {q.shape}", f"Give (..., {self.mujoco.nq}), as in qpos")
        require_finite(argument, q)
        return unit_orientations(argument, self.joints, q)
