"""Configurations and their tangent space, joint by joint, as MuJoCo defines them.

A configuration q (nq,) has four numbers for an orientation (unit quaternion, w first), a small
motion dq (nv,) three: a rotation vector in the frame of the body. For hinge and slide joints
both are the same number. `retract` is mj_integratePos over unit time, `difference` its inverse,
mj_differentiatePos; both are smooth where the rotation is zero, and differentiable there.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.checks import fail
from jaxmpc.robots.mujoco_access import BALL, FREE

# Below this angle² the series of sin and cos are exact in float64.
SMALL_ANGLE = 1e-8


class Block(NamedTuple):
    """Numbers of a configuration: where they are in q (nq,) and in motions (nv,), and whether they
    are an orientation, four of the one and three of the other."""

    place: slice
    motion: slice
    turns: bool


def blocks(joints: Sequence[int]) -> list[Block]:
    """Return the blocks of a configuration, in order. joints: mjtJoint numbers."""
    found, i, j = list[Block](), 0, 0
    for joint in joints:
        shift = {FREE: 3, BALL: 0}.get(joint, 1)
        if shift:
            found.append(Block(slice(i, i + shift), slice(j, j + shift), False))
            i, j = i + shift, j + shift
        if joint in (FREE, BALL):
            found.append(Block(slice(i, i + 4), slice(j, j + 3), True))
            i, j = i + 4, j + 3
    return found


def rotations(joints: Sequence[int]) -> list[slice]:
    """Return where the rotation vectors of orientations are in motions (nv,)."""
    return [motion for _, motion, turns in blocks(joints) if turns]


def nearest_turns(joints: Sequence[int], dq: Array, near: Array) -> Array:
    """Return the motions dq (nv + …,) with rotation vectors v + 2πk v/|v| of the same orientations:
    those nearest to `near`, or, where these are longer than 3π/2, the shortest ones, for `retract`
    is singular at 2π."""
    for motion in rotations(joints):
        v = dq[motion]
        square = jnp.sum(v**2)
        length = jnp.sqrt(jnp.where(square > 0, square, 1.0))
        along = jnp.stack([jnp.dot(v / length, near[motion]), jnp.zeros_like(length)])
        longer = 2 * np.pi * jnp.round((along - length) / (2 * np.pi))
        longer = jnp.where(jnp.abs(length + longer[0]) <= 1.5 * np.pi, longer[0], longer[1])
        dq = dq.at[motion].set(jnp.where(square > 0, 1 + longer / length, 1.0) * v)
    return dq


def unit_orientations(argument: str, joints: Sequence[int], q: np.ndarray) -> np.ndarray:
    """Return the configurations q (..., nq) with quaternions of length 1; raise ValueError, naming
    the argument, where one is far from that."""
    q = np.array(q, float)
    for place, _, turns in blocks(joints):
        if turns:
            size = np.linalg.norm(q[..., place], axis=-1, keepdims=True)
            if not np.all((size > 0.5) & (size < 2)):
                worst = q.reshape(-1, q.shape[-1])[np.argmax(np.abs(size - 1)), place]
                problem = f"quaternion {worst} of length {np.linalg.norm(worst):g}"
                fail(argument, problem, "Give unit length, w first")
            q[..., place] /= size
    return q


def retract(joints: Sequence[int], q: Array, dq: Array) -> Array:
    """Return q ⊕ dq (nq,): the configuration q (nq,) moved by dq (nv,)."""
    if not quaternions(joints):
        return q + dq
    parts = [
        product(q[place], _exponential(dq[motion])) if turns else q[place] + dq[motion]
        for place, motion, turns in blocks(joints)
    ]
    return jnp.concatenate(parts)


def difference(joints: Sequence[int], start: Array, end: Array) -> Array:
    """Return end ⊖ start (nv,): the motion dq with start ⊕ dq = end, rotations of at most π."""
    if not quaternions(joints):
        return end - start
    parts = [
        _logarithm(product(_inverse(start[place]), end[place]))
        if turns
        else end[place] - start[place]
        for place, _, turns in blocks(joints)
    ]
    return jnp.concatenate(parts)


def rates(joints: Sequence[int], q: Array, dq: Array) -> Array:
    """Return the motion (nv,) in the tangent space at q (nq,), with quaternions of length 1, that
    changes the numbers of q by dq (nq,). Linear in dq."""
    if not quaternions(joints):
        return dq
    parts = [
        2 * product(_inverse(q[place]), dq[place])[1:] if turns else dq[place]
        for place, _, turns in blocks(joints)
    ]
    return jnp.concatenate(parts)


def quaternions(joints: Sequence[int]) -> bool:
    """Return whether an orientation is among the joints, so that nq and nv differ."""
    return any(joint in (FREE, BALL) for joint in joints)


def normalised(joints: Sequence[int], q: Array) -> Array:
    """Return q (nq,) with quaternions of length 1."""
    for place, _, turns in blocks(joints):
        q = q.at[place].set(q[place] / jnp.linalg.norm(q[place])) if turns else q
    return q


def _inverse(q: Array) -> Array:
    """Return the inverse of a unit quaternion."""
    return q * jnp.array([1.0, -1.0, -1.0, -1.0], q.dtype)


def product(a: Array, b: Array) -> Array:
    """Return the Hamilton product a b of two quaternions."""
    vector = a[0] * b[1:] + b[0] * a[1:] + jnp.cross(a[1:], b[1:])
    return jnp.concatenate([(a[0] * b[0] - jnp.dot(a[1:], b[1:]))[None], vector])


def _exponential(w: Array) -> Array:
    """Return the quaternion of the rotation by |w| about w: (cos |w|/2, w sin(|w|/2)/|w|)."""
    squared = jnp.dot(w, w)
    small = squared < SMALL_ANGLE
    angle = jnp.sqrt(jnp.where(small, 1.0, squared))  # no sqrt at 0: its derivative is infinite
    real = jnp.where(small, 1 - squared / 8, jnp.cos(angle / 2))
    ratio = jnp.where(small, 0.5 - squared / 48, jnp.sin(angle / 2) / angle)
    return jnp.concatenate([real[None], ratio * w])


def _logarithm(q: Array) -> Array:
    """Return the rotation vector of a unit quaternion, the shorter way: 2 atan2(|v|, w) v/|v|."""
    q = jnp.where(q[0] < 0, -q, q)
    v = q[1:]
    squared = jnp.dot(v, v)
    small = squared < SMALL_ANGLE
    size = jnp.sqrt(jnp.where(small, 1.0, squared))
    # With w = √(1 − |v|²): 2 asin|v|/|v| = 2 + |v|²/3 + …
    return jnp.where(small, 2 + squared / 3, 2 * jnp.arctan2(size, q[0]) / size) * v
