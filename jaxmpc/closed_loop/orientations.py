"""Rotation vectors of robots in closed loops: those nearest to what a plan tracks.

The coordinates of an orientation are a rotation vector v from home, |v| ≤ π; v + 2πk v/|v| is the
same orientation for every whole number k. Beyond half a turn from home v jumps to the other side:
from there a plan to a target at +3 rad would turn the longer way, and where noise moves a robot
across it every plan would begin anew. Plans therefore begin at the vector nearest to the target's,
and those of references that change are taken on from row to row, as far as three quarters of a turn
from home. Where limits are on a rotation vector, it stays as it is: the shorter way may lead
through what they exclude.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import as_array, dimensions
from jaxmpc.checks import concrete
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.rows import given_blocks
from jaxmpc.robots.configurations import nearest_turns, quaternions, rotations
from jaxmpc.robots.robot import Robot, RobotModel
from jaxmpc.sets.convex_sets import Box, Polytope


def rotating_joints(plant: Any) -> tuple[int, ...]:
    """Return the mjtJoint of each joint of a robot, or of a model of one, whose coordinates hold
    rotation vectors; none for all others."""
    robot = plant.robot if isinstance(plant, RobotModel) else plant
    return robot.joints if isinstance(robot, Robot) and quaternions(robot.joints) else ()


def aligned(plant: Any, limits: Any, xi: Array, reference: Any) -> tuple[Array, Any]:
    """Return ξ (n,) and the reference (n + …,), or rows of it, with the rotation vectors from which
    a plan takes the shorter way. limits: an MPC, Box or Polytope; None for none. References of
    other shapes are left to the checks of those who take them."""
    joints, size = rotating_joints(plant), len(xi)
    if not joints or not _aligns(reference, size):
        return xi, reference
    fixed, reference = _limited(joints, limits, size), jnp.asarray(reference, xi.dtype)

    def nearest(row: Array, near: Array) -> Array:
        return jnp.where(fixed, row, nearest_turns(joints, row, near))

    if reference.ndim == 1:
        aim = nearest(reference[:size], reference[:size])  # not longer than 3π/2
        return nearest(xi, aim), reference.at[:size].set(aim)

    def follow(near: Array, row: Array) -> tuple[Array, Array]:
        return (nearest(row, near),) * 2

    # From the middle to both ends, for vectors are at most 3π/2 long.
    rows, middle = reference[:, :size], len(reference) // 2
    later = jax.lax.scan(follow, rows[middle], rows[middle:])[1]
    earlier = jax.lax.scan(follow, rows[middle], rows[:middle], reverse=True)[1]
    rows = jnp.concatenate([earlier, later])
    return nearest(xi, rows[0]), jnp.concatenate([rows, reference[:, size:]], axis=1)


def error_of(plant: Any, limits: Any, xi: Array, reference: Array | None) -> Array:
    """Return ξ − reference (n,), rotations the shorter way; reference None for zero."""
    if reference is None:
        return xi
    if np.ndim(reference) == 1:
        xi, reference = aligned(plant, limits, xi, reference[: len(xi)])
    return xi - reference


def host_errors(plant: Any, xi: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return ξ − reference (..., n) for ξ (..., n), as `error_of`, in float64 NumPy arrays."""
    if not rotating_joints(plant):
        return xi - reference
    with jax.enable_x64(True):
        error = jax.vmap(lambda row: error_of(plant, None, row, jnp.asarray(reference)))
        return np.asarray(error(xi.reshape(-1, xi.shape[-1]))).reshape(xi.shape)


def _aligns(reference: Any, size: int) -> bool:
    """Return whether a reference is numbers of the shape (n + …,), or rows of them."""
    shape = np.shape(as_array(reference)) if dimensions(reference) in (1, 2) else (0,)
    if shape[-1] < size or 0 in shape:
        return False
    return not concrete(reference) or np.asarray(reference).dtype.kind in "biuf"


def _limited(joints: tuple[int, ...], limits: Any, n: int) -> Array:
    """Return which coordinates (n,) belong to rotation vectors that limits are on."""
    found = jnp.zeros(n, bool)
    if isinstance(limits, MPC):
        for block in given_blocks(limits, jnp.result_type(float)):
            if block.H is not None:
                bounded = jnp.isfinite(block.lower) | jnp.isfinite(block.upper)
                rows = jnp.any(bounded.reshape(-1, block.size), axis=0)
                H = jnp.any(jnp.asarray(block.H).reshape(-1, block.size, n) != 0, axis=0)
                found = found | jnp.any(rows[:, None] & H, axis=0)
    elif isinstance(limits, Box):
        finite = (jnp.isfinite(jnp.asarray(end)) for end in (limits.lower, limits.upper))
        found = jnp.broadcast_to(next(finite) | next(finite), (n,))
    elif isinstance(limits, Polytope):
        found = jnp.any(jnp.asarray(limits.H) != 0, axis=0)
    for motion in rotations(joints):
        found = found.at[motion].set(jnp.any(found[motion]))
    return found
