"""Ellipsoids, against closed forms."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmpc.sets.convex_sets import Ellipsoid

INF = np.inf


def test_ellipsoid_against_closed_forms_and_sampling():
    rng = np.random.default_rng(0)
    axes = Ellipsoid(np.diag([0.25, 4.0]), 9.0)  # half-axes 6 and 1.5
    axes.validate("terminal_set", 2)
    assert axes.dimension == 2 and axes.volume() == pytest.approx(9 * math.pi, rel=1e-14)
    for n, unit in ((1, 2.0), (2, math.pi), (3, 4 / 3 * math.pi), (4, math.pi**2 / 2)):
        assert Ellipsoid(np.eye(n), 1.0).volume() == pytest.approx(unit, rel=1e-14)
    root = rng.standard_normal((3, 3))
    P = root @ root.T + 0.1 * np.eye(3)
    ellipsoid = Ellipsoid(P, 2.0)
    box = ellipsoid.bounding_box()
    points = rng.uniform(box.lower, box.upper, (400_000, 3))
    inside = np.einsum("ki,ij,kj->k", points, P, points) <= 2
    assert inside.mean() * box.volume() == pytest.approx(ellipsoid.volume(), rel=0.02)
    # x = sqrt(2) L'^-1 w over the unit sphere: the boundary.
    sphere = rng.standard_normal((200_000, 3))
    sphere /= np.linalg.norm(sphere, axis=1)[:, None]
    boundary = math.sqrt(2) * np.linalg.solve(np.linalg.cholesky(P).T, sphere.T).T
    d = rng.standard_normal(3)
    with jax.enable_x64(True):
        support = float(ellipsoid.support(d))
    assert (boundary @ d).max() == pytest.approx(support, rel=1e-3)
    assert (boundary @ d).max() <= support
    np.testing.assert_allclose(box.upper, np.abs(boundary).max(axis=0), rtol=1e-3)
    contains = jax.vmap(ellipsoid.contains)
    assert contains(0.999 * boundary[:9]).all() and not contains(1.001 * boundary[:9]).any()
    assert ellipsoid.contains(boundary[0] * 1.001, tolerance=0.01)


def test_ellipse_boundary():
    P, level = np.array([[3.0, 1.0], [1.0, 2.0]]), 5.0
    points = Ellipsoid(P, level).boundary(1000)
    np.testing.assert_allclose(np.einsum("ki,ij,kj->k", points, P, points), level, rtol=1e-13)
    x, y = points.T
    area = (x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2  # > 0: counter-clockwise
    assert area == pytest.approx(Ellipsoid(P, level).volume(), rel=1e-5)
    with pytest.raises(ValueError, match="Ellipsoid: has dimension 3"):
        Ellipsoid(np.eye(3), 1.0).boundary()


@pytest.mark.parametrize(
    ("ellipsoid", "message"),
    [
        (Ellipsoid(jnp.ones((2, 3)), 1.0), r"X_f.P: shape \(2, 3\) is not \(n, n\)"),
        (Ellipsoid([[1, 2], [0.5, 1]], 1.0), "X_f.P: is not symmetric"),
        (Ellipsoid([[1, 2], [0, 1]], 1.0), "X_f.P: is triangular, not symmetric"),
        (Ellipsoid([[1, 2], [2, 1]], 1.0), "X_f.P: is not positive definite"),
        (Ellipsoid([[1, np.nan], [np.nan, 1]], 1.0), "X_f.P: holds NaN"),
        (Ellipsoid(np.eye(2), 0.0), "X_f.level: 0 is not a positive"),
        (Ellipsoid(np.eye(2), INF), "X_f.level: inf is not"),
        (Ellipsoid(np.eye(2), [1.0]), r"X_f.level: shape \(1,\)"),
        (Ellipsoid(np.eye(3), 1.0), "X_f: has dimension 3 where 2"),
    ],
)
def test_ellipsoid_errors(ellipsoid, message):
    with pytest.raises(ValueError, match=message):
        ellipsoid.validate("X_f", 2)


def test_support_of_a_traced_matrix_that_is_not_symmetric():
    """x'Px knows the symmetric part of P alone: the largest d'x over points on the boundary."""
    P, d = np.array([[1.0, 0.8], [0.0, 0.5]]), np.array([1.0, 0.3])
    angles = np.linspace(0, 2 * np.pi, 100_000)
    points = np.array([np.cos(angles), np.sin(angles)])
    points = points / np.sqrt(np.sum(points * (P @ points), axis=0))
    found = jax.jit(lambda P: Ellipsoid(P, 1.0).support(d))(P)
    assert found == pytest.approx((d @ points).max(), rel=1e-5)
