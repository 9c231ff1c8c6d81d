"""A point mass at a site of a robot: the mass, centre and inertia of the body that carries it."""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
from jax import Array

from jaxmpc.qp.linalg import eigh
from jaxmpc.qp.precision import matmul


def with_payload(
    model: Any, varied: Mapping[str, Any], site: int, payload: Any
) -> dict[str, Array]:
    """Return the fields of mjx.Model that a point mass (kg) at a site changes: parallel axes about
    the new centre (Steiner), then principal axes. varied: fields in place of the model's."""
    i, at = int(model.site_bodyid[site]), jnp.asarray(model.site_pos[site])
    of = lambda key: jnp.asarray(varied.get(key, getattr(model, key)))
    mass, centre = of("body_mass")[i], of("body_ipos")[i]
    total = mass + payload
    middle = (mass * centre + payload * at) / total
    w, v = of("body_iquat")[i, 0], of("body_iquat")[i, 1:]
    turn = jnp.eye(3) + 2 * w * _cross(v) + 2 * matmul(_cross(v), _cross(v))
    inertia = matmul(turn * of("body_inertia")[i], turn.T)
    for m, place in ((mass, centre), (payload, at)):
        inertia = inertia + m * matmul(_cross(place - middle).T, _cross(place - middle))
    principal, axes = eigh(inertia)
    axes = axes * jnp.sign(jnp.linalg.det(axes))
    new = {
        "body_mass": total,
        "body_ipos": middle,
        "body_inertia": principal,
        "body_iquat": _quaternion(axes),
    }
    return {key: of(key).at[i].set(value) for key, value in new.items()}


def _cross(a: Array) -> Array:
    """Return the matrix of b → a × b."""
    return jnp.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


def _quaternion(R: Array) -> Array:
    """Return the unit quaternion (w first) of a rotation matrix: the eigenvector of Bar-Itzhack's K
    (2000, J. Guidance 23, eq. 6) with the largest eigenvalue, right for every rotation."""
    x, y, z = R[:, 0], R[:, 1], R[:, 2]
    K = jnp.array([
        [x[0] - y[1] - z[2], y[0] + x[1], z[0] + x[2], y[2] - z[1]],
        [y[0] + x[1], y[1] - x[0] - z[2], z[1] + y[2], z[0] - x[2]],
        [z[0] + x[2], z[1] + y[2], z[2] - x[0] - y[1], x[1] - y[0]],
        [y[2] - z[1], z[0] - x[2], x[1] - y[0], x[0] + y[1] + z[2]],
    ])  # fmt: skip
    q = eigh(K / 3)[1][:, -1]
    return jnp.array([q[3], q[0], q[1], q[2]])
