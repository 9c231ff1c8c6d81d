"""Functions of mjx.Data for the tasks of a robot: positions, orientations, distances, energy.

Each maker returns a function of mjx.Data for `jaxmpc.mpc.Task`; any other function of mjx.Data
written in JAX will do as well, `lambda data: data.qfrc_actuator` for the torques.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.spatial.transform import Rotation

from jaxmpc.checks import fail, number, require_finite, require_kind, require_shape, shown
from jaxmpc.qp.linalg import matmul
from jaxmpc.robots.mujoco_access import names, number_of
from jaxmpc.robots.physics import NO_GRAVITY
from jaxmpc.robots.robot import Robot

__all__ = ["distance", "energy", "orientation", "position"]

# mjtGeom.
SPHERE, CAPSULE = 2, 3
KINDS = ("site", "body", "geom")


def position(robot: Robot, name: str, kind: str = "site") -> Callable[[Any], Array]:
    """Return the function that gives the position (3,) in m, in the world, of a site, a body or
    the centre of a geom.

    name: its name in the file. kind: "site", "body" or "geom". Raises ValueError for a name that
    the model does not have.
    """
    i, field = _number(robot, kind, name), "xpos" if kind == "body" else f"{kind}_xpos"
    return lambda data: getattr(data, field)[i]


def orientation(
    robot: Robot, name: str, target: Any = (1, 0, 0, 0), kind: str = "site"
) -> Callable[[Any], Array]:
    """Return the function that gives the rotation vector (3,) in rad, in the world, that turns the
    target orientation, a quaternion (w first), into that of a site, body or geom.

    name: of the site, body or geom. target: a quaternion (w, x, y, z). kind: "site", "body" or
    "geom".

    Its length is the angle between both, at most π, where it jumps: either of two axes is right.
    """
    i, field = _number(robot, kind, name), "xmat" if kind == "body" else f"{kind}_xmat"
    require_shape("target", target, (4,), "Give a quaternion (w, x, y, z)")
    require_finite("target", target)
    if not np.any(target):
        fail("target", "is (0, 0, 0, 0), which is no orientation", "Give a quaternion (w, x, y, z)")
    wanted = Rotation.from_quat(np.roll(np.asarray(target, float), -1)).as_matrix()

    def turned(data: Any) -> Array:
        R = getattr(data, field)[i].reshape(3, 3)
        R = matmul(R, jnp.asarray(wanted.T, R.dtype))
        axis = jnp.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
        # |axis| = sin φ, trace = 1 + 2 cos φ. φ/sin φ → 1 + sin²φ/6 for small angles.
        square, cosine = jnp.sum(axis**2), (jnp.trace(R) - 1) / 2
        obtuse, small = cosine < 0, square < 1e-8
        sine = jnp.sqrt(jnp.where(small | obtuse, 1.0, square))
        near = jnp.where(small, 1 + square / 6, jnp.arctan2(sine, cosine) / sine) * axis
        # About π the axis n is that of (R + R')/2 − cos φ 1 = (1 − cos φ) n n', by its longest row.
        outer = jnp.where(obtuse, (R + R.T) / 2 - cosine * jnp.eye(3, dtype=R.dtype), 1.0)
        row = outer[jnp.argmax(jnp.diagonal(outer))]
        n = row / jnp.sqrt(jnp.sum(row**2))
        n = jnp.where(jnp.dot(n, axis) < 0, -n, n)
        far = jnp.arctan2(jnp.dot(n, axis), jnp.where(obtuse, cosine, 1.0)) * n
        return jnp.where(obtuse, far, near)

    return turned


def distance(robot: Robot, first: str, second: Any) -> Callable[[Any], Array]:
    """Return the function that gives the distance (m) between the surfaces of two geoms, negative
    where they overlap.

    first: name of a geom; second: another, or (centre (3,), radius) of a ball that stands still in
    the world. Geoms are spheres or capsules: enclose others in one. Raises ValueError for others.
    """
    segments = [_segment(robot, first)]
    if isinstance(second, str):
        segments.append(_segment(robot, second))
        radius = 0.0
    else:
        if not isinstance(second, tuple | list) or len(second) != 2:
            fail("second", shown(second), "Give the name of a geom, or (centre, radius)")
        require_shape("second[0]", second[0], (3,), "Give the centre of the ball")
        require_finite("second[0]", second[0])
        number("second[1]", second[1], 0.0, "Give a radius of at least 0")
        centre, radius = np.asarray(second[0], float), float(second[1])
        point = lambda data: jnp.asarray(centre, data.qpos.dtype)
        segments.append(lambda data: (point(data), jnp.zeros(3, data.qpos.dtype), 0.0, 0.0))

    def between(data: Any) -> Array:
        first, second = (segment(data) for segment in segments)
        gap = _between_segments(first, second)
        length = jnp.sqrt(jnp.maximum(jnp.sum(gap**2), 1e-30))
        return length - first[-1] - second[-1] - radius

    return between


def energy(robot: Robot) -> Callable[[Any], Array]:
    """Return the function that gives the kinetic energy and that of the weight (J), zero at rest at
    the height of the world's origin; without springs. Its masses are those of the model that is
    planned with, `numbers` and a payload included."""
    require_kind("robot", robot, Robot)
    model = robot.predictor.mjx
    gravity = np.asarray(model.opt.gravity) * (not model.opt.disableflags & NO_GRAVITY)
    root = np.asarray(model.body_rootid)

    def total(data: Any) -> Array:
        # Inertias about the centre of each body's tree: m·arm, mass m.
        arms, mass = data._impl.cinert[:, 6:9], data._impl.cinert[:, 9:]
        first_moment = jnp.sum(mass * data.subtree_com[root] + arms, axis=0)
        kinetic = jnp.dot(data.qvel, matmul(data._impl.M, data.qvel)) / 2
        return kinetic - jnp.dot(first_moment, jnp.asarray(gravity, data.qpos.dtype))

    return total


def _number(robot: Robot, kind: str, name: str) -> int:
    """Return the number of a site, body or geom."""
    if kind not in KINDS:
        fail("kind", f"{kind!r}", f"Give one of {', '.join(KINDS)}")
    i = number_of(robot.mujoco, kind, name)
    if i < 0:
        listed = ", ".join(filter(None, names(robot.mujoco, kind))) or "none with a name"
        fail("name", f"no {kind} {name!r} in {robot.name}", f"It has: {listed}")
    return i


# The middle of a line, its direction (of length one), half of its length and the radius around it.
Segment = tuple[Array, Array, float, float]


def _segment(robot: Robot, name: str) -> Callable[[Any], Segment]:
    """Return a geom's middle line and its radius, as a function of mjx.Data."""
    model, i = robot.predictor.model, _number(robot, "geom", name)
    kind, (radius, half, _) = int(model.geom_type[i]), model.geom_size[i]
    if kind not in (SPHERE, CAPSULE):
        fail("name", f"geom {name!r} is neither a sphere nor a capsule", "Enclose it in one")
    half = float(half) if kind == CAPSULE else 0.0
    return lambda data: (
        data.geom_xpos[i],
        data.geom_xmat[i].reshape(3, 3)[:, 2],
        half,
        float(radius),
    )


def _between_segments(first: Segment, second: Segment) -> Array:
    """Return the vector (3,) between the nearest points of two segments (Ericson 2005, Real-Time
    Collision Detection, §5.1.9): those at the lengths s and t along them."""
    (a, u, along_u, _), (b, v, along_v, _) = first, second
    w, s, t = a - b, jnp.zeros((), a.dtype), jnp.zeros((), a.dtype)
    if along_u and along_v:
        # With (u·v)(v·w) − u·w = n·(v×w) and 1 − (u·v)² = n·n few digits cancel where they are
        # nearly parallel. Where they are parallel the middle serves; the clamps do the rest.
        n = jnp.cross(u, v)
        squared_sine = jnp.dot(n, n)
        parallel = squared_sine < jnp.finfo(n.dtype).eps ** 1.5
        s = jnp.dot(n, jnp.cross(v, w)) / jnp.where(parallel, 1.0, squared_sine)
        s = jnp.clip(jnp.where(parallel, 0.0, s), -along_u, along_u)
    if along_v:
        t = jnp.clip(jnp.dot(v, w + s * u), -along_v, along_v)
    if along_u:
        s = jnp.clip(jnp.dot(u, t * v - w), -along_u, along_u)
    return w + s * u - t * v
