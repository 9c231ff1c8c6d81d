"""Polytopes of tests of sets, and how their points are compared."""

import numpy as np

from jaxmpc.sets.convex_sets import Polytope


def sorted_rows(points):
    points = np.round(np.asarray(points, dtype=float), 9) + 0.0
    return points[np.lexsort(points.T)]


def assert_same_points(left, right, atol=1e-9):
    assert np.shape(left) == np.shape(right)
    np.testing.assert_allclose(sorted_rows(left), sorted_rows(right), atol=atol)


def cube(n, half=1.0):
    return Polytope(np.vstack([np.eye(n), -np.eye(n)]), np.full(2 * n, half))


def interval(polytope):
    """(lower, upper) of a set on the line."""
    return -polytope.support(np.array([-1.0])), polytope.support(np.array([1.0]))


def unimodular(rng, n):
    """An integer matrix with determinant 1 and its inverse, exactly."""
    T = np.eye(n)
    for _ in range(3 * n):
        i, j = rng.choice(n, 2, replace=False)
        step = np.eye(n)
        step[i, j] = rng.choice([-1, 1])
        T = step @ T if np.abs(step @ T).max() <= 3 else T
    inverse = np.round(np.linalg.inv(T))
    np.testing.assert_array_equal(T @ inverse, np.eye(n))
    return T, inverse
