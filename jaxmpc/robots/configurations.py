"""Configurations and their tangent space, joint by joint, as MuJoCo defines them.

A configuration q (nq,) has four numbers for an orientation (unit quaternion, w first), a small
motion dq (nv,) three: a rotation vector in the frame of the body. For hinge and slide joints
both are the same number. `retract` is mj_integratePos over unit time, `difference` its inverse,
mj_differentiatePos; both are smooth where the rotation is zero, and differentiable there.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.checks import fail
from jaxmpc.robots.engine import BALL, FREE

# Below this angle² the series of sin and cos are exact in float64.
SMALL = 1e-8


def unit_orientations(argument: str, joints: Sequence[int], q: np.ndarray) -> np.ndarray:
    """Return the configurations q (..., nq) with quaternions of length 1; raise ValueError, naming
    the argument, where one is far from that. joints: mjtJoint numbers."""
    i, q = 0, np.array(q, float)
    for joint in joints:
        i += 3 if joint == FREE else 0
        if joint in (FREE, BALL):
            size = np.linalg.norm(q[..., i : i + 4], axis=-1, keepdims=True)
            if not np.all((size > 0.5) & (size < 2)):
                worst = q.reshape(-1, q.shape[-1])[np.argmax(np.abs(size - 1)), i : i + 4]
                problem = f"quaternion {worst} of length {np.linalg.norm(worst):g}"
                fail(argument, problem, "Give unit length, w first")
            q[..., i : i + 4] /= size
        i += 4 if joint in (FREE, BALL) else 1
    return q


def retract(joints: tuple[int, ...], q: Array, dq: Array) -> Array:
    """Return q ⊕ dq (nq,): the configuration q (nq,) moved by dq (nv,). joints: mjtJoint
    numbers."""
    if not quaternions(joints):
        return q + dq
    parts, i, j = [], 0, 0
    for joint in joints:
        if joint == FREE:
            parts.append(q[i : i + 3] + dq[j : j + 3])
            i, j = i + 3, j + 3
        if joint in (FREE, BALL):
            parts.append(_product(q[i : i + 4], _exponential(dq[j : j + 3])))
            i, j = i + 4, j + 3
        else:
            parts.append(q[i : i + 1] + dq[j : j + 1])
            i, j = i + 1, j + 1
    return jnp.concatenate(parts)


def difference(joints: tuple[int, ...], start: Array, end: Array) -> Array:
    """Return end ⊖ start (nv,): the motion dq with start ⊕ dq = end, rotations of at most π."""
    if not quaternions(joints):
        return end - start
    parts, i = [], 0
    for joint in joints:
        if joint == FREE:
            parts.append(end[i : i + 3] - start[i : i + 3])
            i += 3
        if joint in (FREE, BALL):
            inverse = start[i : i + 4] * jnp.array([1.0, -1.0, -1.0, -1.0], start.dtype)
            parts.append(_logarithm(_product(inverse, end[i : i + 4])))
            i += 4
        else:
            parts.append(end[i : i + 1] - start[i : i + 1])
            i += 1
    return jnp.concatenate(parts)


def rates(joints: tuple[int, ...], q: Array, dq: Array) -> Array:
    """Return the motion (nv,) in the tangent space at q (nq,), with quaternions of length 1, that
    changes the numbers of q by dq (nq,). Linear in dq."""
    if not quaternions(joints):
        return dq
    parts, i = [], 0
    for joint in joints:
        size = 1 if joint not in (FREE, BALL) else 3 if joint == FREE else 0
        parts.append(dq[i : i + size])
        i += size
        if joint in (FREE, BALL):
            inverse = q[i : i + 4] * jnp.array([1.0, -1.0, -1.0, -1.0], q.dtype)
            parts.append(2 * _product(inverse, dq[i : i + 4])[1:])
            i += 4
    return jnp.concatenate(parts)


def quaternions(joints: tuple[int, ...]) -> bool:
    """Return whether an orientation is among the joints, so that nq and nv differ."""
    return any(joint in (FREE, BALL) for joint in joints)


def normalised(joints: tuple[int, ...], q: Array) -> Array:
    """Return q (nq,) with quaternions of length 1."""
    i = 0
    for joint in joints:
        i += 3 if joint == FREE else 0
        if joint in (FREE, BALL):
            q = q.at[i : i + 4].set(q[i : i + 4] / jnp.linalg.norm(q[i : i + 4]))
        i += 4 if joint in (FREE, BALL) else 1
    return q


def _product(a: Array, b: Array) -> Array:
    """Return the Hamilton product a b of two quaternions."""
    vector = a[0] * b[1:] + b[0] * a[1:] + jnp.cross(a[1:], b[1:])
    return jnp.concatenate([(a[0] * b[0] - jnp.dot(a[1:], b[1:]))[None], vector])


def _exponential(w: Array) -> Array:
    """Return the quaternion of the rotation by |w| about w: (cos |w|/2, w sin(|w|/2)/|w|)."""
    squared = jnp.dot(w, w)
    small = squared < SMALL
    angle = jnp.sqrt(jnp.where(small, 1.0, squared))  # no sqrt at 0: its derivative is infinite
    real = jnp.where(small, 1 - squared / 8, jnp.cos(angle / 2))
    ratio = jnp.where(small, 0.5 - squared / 48, jnp.sin(angle / 2) / angle)
    return jnp.concatenate([real[None], ratio * w])


def _logarithm(q: Array) -> Array:
    """Return the rotation vector of a unit quaternion, the shorter way: 2 atan2(|v|, w) v/|v|."""
    q = jnp.where(q[0] < 0, -q, q)
    v = q[1:]
    squared = jnp.dot(v, v)
    small = squared < SMALL
    size = jnp.sqrt(jnp.where(small, 1.0, squared))
    # With w = √(1 − |v|²): 2 asin|v|/|v| = 2 + |v|²/3 + …
    return jnp.where(small, 2 + squared / 3, 2 * jnp.arctan2(size, q[0]) / size) * v
