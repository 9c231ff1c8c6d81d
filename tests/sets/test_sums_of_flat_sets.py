"""(S + W) - W = S of hulls of points, flat ones too, in any units (Schneider 2014, lemma 3.1.11).

The points have whole numbers, so that rounding of normals, sums and supports stands where exact
values are 0.
"""

import numpy as np
import pytest

from jaxmpc.sets import Polytope


def whole_points(rng, n, most):
    """At most so many points (k, n) of whole numbers in a random subspace."""
    rank = int(rng.integers(n + 1))
    if rank == 0:
        return np.zeros((1, n))
    weights = rng.integers(-4, 5, (int(rng.integers(1, most)), rank))
    return weights @ rng.integers(-3, 4, (rank, n))


def require_support(found, points, units):
    """The set has the supports of these points, to 1e-8 of the largest of them."""
    n = points.shape[1]
    D = np.vstack([np.eye(n), -np.eye(n), np.random.default_rng(0).normal(size=(6, n))]) / units
    error = np.abs(found.support(D) - (points @ D.T).max(axis=0))
    assert error.max() <= 1e-8 * (1 + np.abs(points / units).max())


@pytest.mark.parametrize("seed", range(40))
def test_what_is_added_can_be_subtracted(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 5))
    units = 10.0 ** rng.integers(-6, 7, n) if seed % 2 else np.ones(n)
    S, W = (whole_points(rng, n, most) * units for most in (8, 7))
    summand = Polytope.from_points(W)
    both = Polytope.from_points(S).minkowski_sum(summand)
    require_support(both, (S[:, None] + W).reshape(-1, n), units)
    require_support(both.pontryagin_difference(summand), S, units)


# They came as empty, as unbounded, or smaller than they are.
FLAT = {
    "a point": (np.zeros((1, 4)), [[-4, 7, -4, 2], [2, 5, -9, -2], [6, 2, -4, 12],
                                   [15, -1, -7, 11], [3, 13, -17, 3]]),
    "a segment": ([[14, -14, -14], [20, -20, -20], [-3, 3, 3]],
                  [[1, 5, 3], [4, -12, 12], [-2, 0, -6], [-3, 15, -9], [2, -14, 6]]),
    "segments": ([[0, 1, 3], [0, -1, -3]], [[-7, 8, 0], [4, -4, 2]]),
}  # fmt: skip


@pytest.mark.parametrize("name", FLAT)
def test_flat_sets_whose_normals_have_zeros(name):
    S, W = (np.asarray(points, float) for points in FLAT[name])
    summand = Polytope.from_points(W)
    found = Polytope.from_points(S).minkowski_sum(summand).pontryagin_difference(summand)
    require_support(found, S, np.ones(S.shape[1]))


@pytest.mark.parametrize("seed", range(10))
def test_an_image_of_a_segment_is_a_segment(seed):
    """The second row of M is orthogonal to it: rounding of that coordinate is no width."""
    rng = np.random.default_rng(seed)
    along = rng.integers(1, 4, 4).astype(float)
    segment = np.outer([-3.0, 5.0], along) * 0.1 + 0.7
    M = np.vstack([rng.integers(1, 4, 4), [along[1], -along[0], 0.0, 0.0]])
    t = rng.integers(-3, 4, 2) * 0.1
    found = Polytope.from_points(segment).image(M, t)
    require_support(found, segment @ M.T + t, np.ones(2))
    assert found.affine_dimension() == 1
