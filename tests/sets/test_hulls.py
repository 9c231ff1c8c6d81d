"""Hulls of many points on few facets, at which qhull loses itself: products of two polygons, whose
volume is the product of two areas."""

import numpy as np
import pytest

import jaxmpc as jm
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


@pytest.mark.parametrize("far", [10.0, 100.0, 1e3, 1e4])
@pytest.mark.long
@pytest.mark.first(2)
def test_flat_images_far_out_keep_their_dimensions(far):
    """The same output in two units beside another one, of polygons far from the origin: a plane
    through 0, of which hulls know the slopes to rounding times the distance alone."""
    rng = np.random.default_rng(0)
    for _ in range(30):
        corners = rng.normal(size=(6, 2)) + far * rng.normal(size=2)
        M = rng.normal(size=(2, 2))
        M = 10.0 ** rng.integers(-6, 7, (3, 1)) * M[[0, 0, 1]]
        V = corners @ M.T
        flat, shadow = jm.Polytope.from_points(V), jm.Polytope.from_points(V[:, [0, 2]])
        assert flat.affine_dimension() == 2
        assert len(flat.vertices()) == len(shadow.vertices())
        np.testing.assert_allclose(flat.support(np.eye(3)), V.max(axis=0), rtol=1e-12)
        assert flat.project([0, 2]).volume() == pytest.approx(shadow.volume(), rel=1e-5)
        segment = jm.Polytope.from_points(V[:1] * np.array([[1.0], [1 + 1 / far]]))
        assert segment.affine_dimension() == 1 and len(segment.vertices()) == 2


def test_boxes_and_polytopes_of_the_same_sums_are_the_same():
    """({x} + Q) − Q is {x}, and a section at a bound that is a sum is there, to rounding."""
    rng = np.random.default_rng(1)
    for _ in range(200):
        x, sides = rng.normal(size=2), np.sort(rng.normal(size=(2, 2)), axis=0)
        point, Q = jm.Box(x, x), jm.Box(*sides)
        left = (point + Q) - Q
        assert not left.is_empty()
        np.testing.assert_allclose(left.lower, x, rtol=0, atol=1e-14)
    assert not (jm.Box([0.1], [0.3]) - jm.Box([0.0], [0.2])).is_empty()
    assert (jm.Box([0.1], [0.3]) - jm.Box([0.0], [0.2 + 1e-12])).is_empty()
    for kind in (jm.Box, lambda *sides: jm.Box(*sides).to_polytope()):
        assert not kind([0, 0.3], [1, 0.3]).slice({1: 0.1 + 0.2}).is_empty()
        assert kind([0, 0.3], [1, 0.3]).slice({1: 0.3 + 1e-9}).is_empty()
        # A far bound on the other side excuses nothing.
        for ends, at in (([-1e9, 0.0], 1e-6), ([-1e12, 1e-3], 1.5e-3), ([0.0, 1e16], -20.0)):
            assert kind([ends[0], 0], [ends[1], 1]).slice({0: at}).is_empty()
