"""Hulls of many points on few facets, at which qhull loses itself: products of two polygons, whose
volume is the product of two areas."""

import numpy as np
import pytest

from jaxmpc.feasible.hull_labels import hull_facets
from jaxmpc.sets.geometry import hull_volume

SHEAR = np.array([[1.0, 0, 0, 0], [1, 1, 0, 0], [0, 2, 1, 0], [1, 0, -1, 1]])  # of volume 1


def area(polygon):
    x, y = polygon.T
    return abs(np.sum(np.roll(x, 1) * y - x * np.roll(y, 1))) / 2


def points_on_a_product(seed, each):
    """The vertices of the product of two polygons and `each` points on every facet, off by some
    rounding, and the volume."""
    rng = np.random.default_rng(seed)
    k = rng.integers(9, 16)
    angles = np.sort(rng.uniform(0, 2 * np.pi, k))
    P = np.column_stack([np.cos(angles), np.sin(angles)])
    Q = P * [1, 0.7]
    points = [np.r_[p, q] for p in P for q in Q]
    for i in range(k):
        for facet_of_first in (True, False):
            edge, other = (P, Q) if facet_of_first else (Q, P)
            for _ in range(each):
                share = rng.uniform()
                on, inside = share * edge[i - 1] + (1 - share) * edge[i], rng.dirichlet(np.ones(k))
                parts = (on, inside @ other) if facet_of_first else (inside @ other, on)
                points.append(np.concatenate(parts))
    moved = np.array(points) @ SHEAR.T
    return moved * (1 + 3e-14 * rng.normal(size=moved.shape)), area(P) * area(Q)


@pytest.mark.parametrize("each", [1, 6, 15])
def test_volumes_of_hulls_with_many_points_on_a_facet(each):
    """qhull calls some of them wide or topologically wrong; they are not flat."""
    for seed in range(60):
        points, volume = points_on_a_product(seed, each)
        assert hull_volume(points) == pytest.approx(volume, rel=1e-10), seed
        scaled = (points - points.mean(axis=0)) / np.ptp(points, axis=0)
        assert hull_facets(scaled).max() < len(points)


def test_points_in_a_hyperplane_have_no_volume():
    rng = np.random.default_rng(0)
    flat = rng.normal(size=(30, 3)) @ rng.normal(size=(3, 4))
    assert hull_volume(flat) == 0
    assert hull_volume(np.ones((9, 3))) == 0
