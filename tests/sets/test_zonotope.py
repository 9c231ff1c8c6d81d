"""Zonotopes, against closed forms, published vertices, and hulls of all sums of signs."""

import itertools

import jax
import numpy as np
import pytest
from polytopes import assert_same_points

from jaxmpc import Box, Polytope
from jaxmpc.sets import Zonotope


def all_signs(zonotope):
    """center + sum of ± generators, all 2^m of them."""
    m = np.shape(zonotope.generators)[1]
    signs = np.array(list(itertools.product((-1, 1), repeat=m)), float).reshape(2**m, m)
    return zonotope.center + signs @ zonotope.generators.T


def test_the_vertices_of_rakovic_2005():
    """F_4 of example 1 in Raković, Kerrigan, Kouramas & Mayne 2005: 16 vertices, exact decimals."""
    closed = np.array([[-0.17, -0.03], [-1.17, -0.03]])
    total = Box([-1, -1], [1, 1]).to_zonotope()
    power = np.eye(2)
    for _ in range(3):
        power = closed @ power
        total = total.minkowski_sum(Zonotope(np.zeros(2), power))
    half = [
        (1.29, 2.56), (1.29, 0.56), (0.95, -1.78), (0.938, -1.852), (0.9022, -2.0158),
        (0.898, -2.032), (0.77, -2.5), (0.71, -2.56),
    ]  # fmt: skip
    V = total.vertices()
    assert_same_points(V, np.vstack([half, np.negative(half)]), atol=1e-12)
    edges = np.roll(V, -1, axis=0) - V
    assert np.all(np.linalg.det(np.stack([edges, np.roll(edges, -1, axis=0)], axis=-1)) > 0)
    shoelace = np.linalg.det(np.stack([V, np.roll(V, -1, axis=0)], axis=-1)).sum() / 2
    assert total.volume() == pytest.approx(shoelace, rel=1e-14)


@pytest.mark.parametrize(("n", "m"), [(1, 3), (2, 6), (3, 6), (3, 9), (4, 7), (5, 7)])
def test_against_the_hull_of_all_signs(n, m):
    rng = np.random.default_rng(10 * n + m)
    units = 10.0 ** rng.integers(-6, 7, n)  # of coordinates
    G = units[:, None] * rng.integers(-2, 3, (n, m))
    zonotope = Zonotope(units * rng.standard_normal(n), G)
    points = all_signs(zonotope)
    hull = Polytope.from_points(points)
    assert zonotope.volume() == pytest.approx(hull.volume(), rel=1e-9)
    assert_same_points(zonotope.vertices() / units, hull.vertices() / units, atol=1e-9)
    H, h = zonotope.half_spaces()
    assert len(h) == len(hull.h)
    np.testing.assert_allclose((points @ H.T).max(axis=0), h, rtol=1e-12, atol=1e-13 * units.max())
    d = rng.standard_normal((50, n)) / units
    np.testing.assert_allclose(zonotope.support(d), (points @ d.T).max(axis=0), rtol=1e-12)
    far = np.linspace(0.1, 1.3, 40)[:, None] * np.abs(G).sum(axis=1)
    near = zonotope.center + far * rng.uniform(-1, 1, (40, n))
    inside = np.all(near @ H.T <= h, axis=1)
    np.testing.assert_array_equal(zonotope.contains(near), inside)
    assert inside.any() and (n == 1 or not inside.all())


def test_sums_images_and_projections():
    rng = np.random.default_rng(0)
    Z = Zonotope(rng.standard_normal(3), rng.standard_normal((3, 4)))
    W, M, t = Box([-1, 0, 0.5], [2, 3, 0.5]), rng.standard_normal((5, 3)), np.arange(5.0)
    d3, d5 = rng.standard_normal((20, 3)), rng.standard_normal((20, 5))
    np.testing.assert_allclose(Z.image(M, t).support(d5), Z.support(d5 @ M) + d5 @ t, rtol=1e-12)
    total = Z.minkowski_sum(W)
    assert isinstance(total, Zonotope)
    by_box = [W.support(d) for d in d3]
    np.testing.assert_allclose(total.support(d3), Z.support(d3) + by_box, rtol=1e-12)
    moved = Z.minkowski_sum([[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(moved.support(d3), Z.support(d3) + d3 @ [1, 2, 3], rtol=1e-12)
    shadow = Z.project([2, 0])
    np.testing.assert_allclose(shadow.support(d3[:, [2, 0]]), Z.support(d3 * [1, 0, 1]), rtol=1e-12)
    box = Z.bounding_box()
    np.testing.assert_allclose(box.upper, Z.support(np.eye(3)), rtol=1e-14)
    wide = W.to_zonotope().minkowski_sum(Polytope.from_points(np.eye(4, 3)))
    assert isinstance(wide, Polytope) and wide.support([1, 1, 1]) == pytest.approx(6.5)


def test_flat_ones_and_points():
    segment = Zonotope([1, 2, 0], [[1], [1], [0]])
    assert_same_points(segment.vertices(), [[0, 1, 0], [2, 3, 0]])
    assert segment.volume() == 0 and segment.contains([1.5, 2.5, 0])
    assert not segment.contains([[1.5, 2.5, 1e-9], [1.5, 2.6, 0], [2.1, 3.1, 0]]).any()
    assert segment.contains([1.5, 2.5, 1e-9], tolerance=1e-8)
    assert segment.to_polytope().support([1, 0, 0]) == pytest.approx(2)
    point = Zonotope([1, 2], np.zeros((2, 0)))
    assert_same_points(point.vertices(), [[1, 2]])
    assert point.volume() == 0 and point.contains([1, 2]) and not point.contains([1, 2.1])
    assert Box([0, 1], [0, 2]).to_zonotope().generators.shape == (2, 1)


def test_a_tube_of_twelve_states_and_jax():
    rng = np.random.default_rng(0)
    A = rng.standard_normal((12, 12))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    tube = Zonotope(np.zeros(12), np.hstack([np.linalg.matrix_power(A, i) for i in range(30)]))
    for what in ("vertices", "half_spaces", "volume"):
        with pytest.raises(ValueError, match="of 360 generators are too many.*Use support"):
            getattr(tube, what)()
    d = rng.standard_normal(12)
    farthest = tube.generators @ np.sign(d @ tube.generators)
    assert tube.contains(0.999 * farthest) and not tube.contains(1.001 * farthest)
    with jax.enable_x64(True):
        slope = jax.grad(lambda s: Zonotope(tube.center, s * tube.generators).support(d))(1.0)
        assert float(jax.jit(Zonotope.support)(tube, d)) == pytest.approx(tube.support(d))
    assert slope == pytest.approx(tube.support(d), rel=1e-12)


def test_many_generators_need_no_square_of_their_number():
    # A full V of their singular value decomposition would have 10¹² entries.
    G = np.full((2, 1_000_000), 1e-6)
    segment = Zonotope([0.0, 0.0], G)
    assert segment.affine_dimension() == 1
    assert Polytope(*segment.half_spaces()) == Polytope.from_points([[-1, -1], [1, 1]])


@pytest.mark.parametrize(
    ("center", "generators", "message"),
    [
        ([[0.0]], [[1.0]], r"W.center: shape \(1, 1\) is not \(n,\)"),
        ([0.0, 0.0], [1.0, 1.0], r"W.generators: shape \(2,\) is not \(2, m\)"),
        ([0.0, 0.0], [[1.0, 1.0]], r"Zonotope.generators: shape \(1, 2\) is not \(2, m\)"),
        ([0.0, np.nan], np.eye(2), "W.center: holds NaN"),
        ([0.0, 0.0], [[np.inf], [1]], "W.generators: holds NaN or infinity"),
        ([0.0], [[1.0]], "W: has dimension 1 where 2 is needed"),
    ],
)
def test_errors(center, generators, message):
    with pytest.raises(ValueError, match=message):
        Zonotope(center, generators).validate("W", 2)


def test_samples_of_flat_zonotopes_lie_in_them():
    """Also where a coordinate has no width at all, and the centre is no round number."""
    for generators in ([[0.0], [0.0]], [[1.0], [0.0]], [[1.0], [0.3]]):
        flat = Zonotope([1 / 3, 20 / 7], generators)
        assert np.all(flat.contains(flat.sample(50)))
    assert not Zonotope([1.0, 2.0], [[1.0], [0.0]]).contains([1.0, 2 + 1e-12])
