"""Polytopes: vertices, rows, volumes, affine maps, projections, sums and differences.

The answers are closed forms, polygons computed by hand, products whose factors are known, and
support functions taken from LPs over the sets' definitions.
"""

import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from polytopes import assert_same_points, cube, unimodular
from scipy.optimize import linprog

from jaxmpc import Box, Polytope
from jaxmpc.sets import set_difference
from jaxmpc.sets.convex_sets import Ellipsoid
from jaxmpc.sets.geometry import irredundant as _irredundant

INF = np.inf


# The maximal control-invariant set of DOUBLE, exact; half of it, the rest is its mirror image.
C_INF_HALF = [
    [-5, -1], [-9 / 2, -3 / 2], [-7 / 2, -2], [-2, -5 / 2], [0, -3], [5 / 2, -7 / 2], [5, -47 / 12],
]  # fmt: skip


C_INF = np.array(C_INF_HALF + [[-x, -y] for x, y in C_INF_HALF])


def test_polytope_basics():
    triangle = Polytope([[-1, 0], [0, -2], [1, 1], [1, 0]], [0, 0, 1, INF])
    triangle.validate("terminal_set", 2)
    assert triangle.dimension == 2
    points = np.array([[0.2, 0.2], [0.6, 0.6], [-0.1, 0.2], [np.nan, 0]])
    np.testing.assert_array_equal(jax.vmap(triangle.contains)(points), [1, 0, 0, 0])
    assert triangle.contains([0.6, 0.6], tolerance=0.21)
    np.testing.assert_allclose(triangle.vertices(), [[0, 0], [1, 0], [0, 1]], atol=1e-14)
    assert triangle.volume() == pytest.approx(0.5, abs=1e-14)
    centre, radius = triangle.chebyshev()
    assert radius == pytest.approx(1 / (2 + math.sqrt(2)), abs=1e-14)
    np.testing.assert_allclose(centre, [radius, radius], atol=1e-14)
    assert triangle.support([1, 3]) == pytest.approx(3, abs=1e-14)
    assert Polytope([[1, 0]], [1]).support([0, 1]) == INF
    assert Polytope([[1, 0]], [1]).support([2, 0]) == pytest.approx(2)
    everything = Box([-INF, -INF], [INF, INF]).to_polytope()
    everything.validate("states", 2)
    assert everything.support([0, 1]) == INF and everything.contains([1e9, 0])
    H, lower, upper = triangle.rows()
    assert np.all(lower == -INF) and H.shape == (4, 2)
    np.testing.assert_array_equal(upper, triangle.h)


def test_polytope_of_exact_vertices():
    polytope = Polytope.from_points(np.vstack([C_INF, [[0, 0], [1, 1]]]))
    assert polytope.H.shape == (14, 2)
    np.testing.assert_allclose(np.linalg.norm(polytope.H, axis=1), 1, atol=1e-15)
    assert polytope.volume() == pytest.approx(1375 / 24, rel=1e-13)
    vertices = polytope.vertices()
    start = int(np.argmin(np.linalg.norm(vertices - C_INF[0], axis=1)))
    np.testing.assert_allclose(np.roll(vertices, -start, axis=0), C_INF, atol=1e-12)
    for d in np.random.default_rng(0).standard_normal((5, 2)):
        assert polytope.support(d) == pytest.approx((C_INF @ d).max(), abs=1e-12)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_round_trips(n):
    rng = np.random.default_rng(n)
    simplex = np.vstack([np.zeros(n), np.eye(n)])
    assert Polytope.from_points(simplex).volume() == pytest.approx(1 / math.factorial(n))
    corners = np.array(list(itertools.product([-1.0, 1.0], repeat=n)))
    box, cross = Polytope.from_points(corners), Polytope(corners, np.ones(2**n))
    assert box.H.shape == (2 * n, n)
    assert_same_points(box.vertices(), corners)
    assert box.volume() == pytest.approx(2**n, rel=1e-13)
    assert_same_points(cross.vertices(), np.vstack([np.eye(n), -np.eye(n)]))
    assert cross.volume() == pytest.approx(2**n / math.factorial(n), rel=1e-13)
    points = rng.standard_normal((30, n))
    hull = Polytope.from_points(points)
    assert (points @ hull.H.T - hull.h).max() <= 1e-12
    vertices = hull.vertices()
    again = Polytope.from_points(vertices)
    assert_same_points(np.c_[again.H, again.h], np.c_[hull.H, hull.h])
    # An affine image: vertices move along, the volume scales by the determinant.
    T, shift = rng.standard_normal((n, n)) + 3 * np.eye(n), rng.standard_normal(n)
    H = hull.H @ np.linalg.inv(T)
    image = Polytope(H, hull.h + H @ shift)
    assert_same_points(image.vertices(), vertices @ T.T + shift)
    assert image.volume() == pytest.approx(hull.volume() * abs(np.linalg.det(T)), rel=1e-11)


def test_the_hull_of_many_points_needs_no_square_of_their_number():
    # A full U of their singular value decomposition would have 10¹² entries.
    angle = np.linspace(0, 2 * np.pi, 1_000_000)
    points = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points[::10] = [1, 1]
    corners = Polytope.from_points(np.append(np.round(points), [[2, 0]], axis=0))
    square = Polytope.from_points([[1, 1], [1, -1], [-1, 1], [-1, -1], [2, 0]])
    assert corners == square


def test_scales_and_units_do_not_matter():
    lower, upper = np.array([-1e-4, -2e3, 1000.0]), np.array([2e-4, 3e3, 1001.0])
    box = Box(lower, upper)
    polytope = box.to_polytope()
    assert polytope.volume() == pytest.approx(1.5, rel=1e-11)
    scale = upper - lower
    assert_same_points((polytope.vertices() - lower) / scale, (box.vertices() - lower) / scale)
    touching = Polytope([[1, 0], [-1, 0], [0, 1], [0, -1], [-1, -1]], [1, 1e-17, 1e3, 1e-17, 0])
    assert touching.volume() == pytest.approx(1e3, rel=1e-12)
    tiny = cube(2, 1e-8)
    assert tiny.volume() == pytest.approx(4e-16, rel=1e-12)
    assert tiny.support([1, 1]) == pytest.approx(2e-8, rel=1e-12)


def test_intersect():
    square = cube(2)
    shifted = square.intersect(Box([0, -INF], [5, 0.5]))
    assert shifted.H.shape == (7, 2)
    assert shifted.volume() == pytest.approx(1.5, abs=1e-14)
    assert shifted.reduce().H.shape == (4, 2)
    diamond = Polytope(np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]]), 1.5 * np.ones(4))
    assert square.intersect(diamond).volume() == pytest.approx(4 - 4 * 0.125, abs=1e-13)
    interval = Box(-0.5, 0.5)  # of each coordinate
    for whole in (square, Box([-1, -1], [1, 1])):
        for both in (whole & interval, interval & whole):
            assert both.volume() == pytest.approx(1, abs=1e-14)
    assert set_difference(square, interval).volume() == pytest.approx(3, abs=1e-13)
    assert (square - interval).volume() == pytest.approx(1, abs=1e-14)
    with pytest.raises(ValueError, match="other: has dimension 3 where 2"):
        square.intersect(cube(3))
    with pytest.raises(ValueError, match="other: list"):
        square.intersect([1, 2])


def test_reduce_thirty_thousand_tangents_of_a_circle():
    rng = np.random.default_rng(0)
    angles = rng.uniform(0, 2 * np.pi, 30_000)
    H = np.column_stack([np.cos(angles), np.sin(angles)])
    gaps = np.diff(np.sort(angles), append=angles.min() + 2 * np.pi)
    area = np.tan(gaps / 2).sum()  # each gap adds two triangles of height 1
    reduced = Polytope(3 * H, 3 * np.ones(len(H))).reduce()
    assert 29_900 <= len(reduced.H) <= 30_000  # neighbours closer than 1e-6 rad merge
    np.testing.assert_allclose(np.linalg.norm(reduced.H, axis=1), 1, atol=1e-14)
    vertices = reduced.vertices()
    x, y = vertices.T
    assert (x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2 == pytest.approx(area, abs=1e-10)
    assert (H[::30] @ vertices.T).max() <= 1 + 1e-11


def test_reduce_near_duplicates():
    rng = np.random.default_rng(1)
    angles = np.arange(5000) * 2 * np.pi / 5000
    H = np.column_stack([np.cos(angles), np.sin(angles)])
    copies = [H + 1e-14 * rng.standard_normal(H.shape) for _ in range(3)]
    reduced = Polytope(np.vstack(copies), np.ones(3 * len(H))).reduce()
    assert len(reduced.H) == 5000
    assert reduced.volume() == pytest.approx(5000 * np.tan(np.pi / 5000), abs=1e-12)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 6, 7])
def test_reduce_drops_copies_and_rows_that_touch(n):
    rng = np.random.default_rng(n)
    touching = rng.standard_normal((20, n))  # rows a'x <= |a|_1 touch the cube in a corner
    outside = rng.standard_normal((20, n))
    H = np.vstack([touching, 5 * np.eye(n), -np.eye(n), outside, np.zeros((1, n)), np.eye(n)])
    h = np.abs(H).sum(axis=1) + np.r_[np.zeros(20 + 2 * n), np.ones(21), 1e-14 * np.ones(n)]
    reduced = Polytope(H, h).reduce()
    assert_same_points(np.c_[reduced.H, reduced.h], np.c_[cube(n).H, cube(n).h])


@pytest.mark.parametrize("n", [2, 3, 5])
def test_duality_and_linear_programs_agree(n):
    H = np.random.default_rng(n).standard_normal((40, n))
    np.testing.assert_array_equal(
        Polytope(H, np.ones(40)).reduce().H.shape[0], len(_irredundant(H))
    )


@pytest.mark.parametrize(
    ("polytope", "message"),
    [
        (Polytope([[1, 0], [-1, 0]], [0, -1]), "terminal_set: is empty"),
        (Polytope([[0, 0]], [-1]), "terminal_set: is empty"),
        (Polytope([[1, 0]], [-INF]), "terminal_set: is empty"),
        (Polytope([[1, np.nan]], [1]), "terminal_set.H: holds"),
        (Polytope([[1, 0]], [np.nan]), "terminal_set.h: holds NaN"),
        (Polytope(jnp.eye(2)[:1], jnp.ones(2)), "terminal_set.h: shape"),
        (Polytope([1, 0], [1]), "terminal_set.H: shape"),
        (Polytope([[1, 0, 0]], [1]), "terminal_set: has dimension 3 where 2"),
    ],
)
def test_polytope_errors(polytope, message):
    with pytest.raises(ValueError, match=message):
        polytope.validate("terminal_set", 2)


@pytest.mark.parametrize(
    ("H", "h", "dimension", "bounded"),
    [
        ([[1, 0], [-1, 0], [0, 1], [0, -1]], [1, -1, 1, 1], 1, True),
        ([[1, 0], [-1, 0], [0, 1], [0, -1]], [1, -2, 1, 1], -1, True),
        ([[1, 0], [-1, 0]], [1, 1], 2, False),
        ([[1, 0], [-1, 0], [0, 1]], [1, 1, 1], 2, False),
        ([[1, 0]], [1], 2, False),
        ([[1]], [1], 1, False),
        ([[1], [-1]], [1, -1], 0, True),
        ([[1], [-1]], [1, -1.1], -1, True),
        (np.vstack([np.eye(8), -np.eye(8)[1:]]), np.ones(15), 8, False),
    ],
)
def test_polytope_degenerate(H, h, dimension, bounded):
    polytope = Polytope(H, h)
    n = polytope.dimension
    assert polytope.affine_dimension() == dimension
    assert polytope.is_bounded() == bounded and polytope.is_empty() == (dimension < 0)
    assert polytope.volume() == (0 if dimension < n else INF)
    reduced = polytope.reduce()
    assert reduced == polytope and reduced.is_empty() == polytope.is_empty()
    if bounded:
        count = max(dimension + 1, 0)  # each is a simplex
        assert polytope.vertices().shape == (count, n)
    else:
        with pytest.raises(ValueError, match="Polytope: is unbounded"):
            polytope.vertices()
    with pytest.raises(ValueError, match="set: is"):
        polytope.require_body("set")


def test_polytope_errors_in_use():
    empty, flat = Polytope([[1], [-1]], [0, -1]), Polytope([[1], [-1]], [1, -1])
    flat.validate("set")
    assert flat.chebyshev()[1] == pytest.approx(0, abs=1e-12)
    for call in (empty.chebyshev, lambda: empty.support([1.0])):
        with pytest.raises(ValueError, match="Polytope: is empty"):
            call()
    with pytest.raises(ValueError, match="arbitrarily large"):
        Polytope([[1, 0]], [1]).chebyshev()
    with pytest.raises(ValueError, match="x: shape"):
        cube(2).contains(np.zeros(3))
    with pytest.raises(ValueError, match="d: holds NaN"):
        cube(2).support([np.nan, 0])
    with pytest.raises(ValueError, match="Polytope.h: shape"):
        Polytope(np.eye(2), [1]).reduce()
    for points, message in [
        ([1, 2], "points: shape"),
        ([[np.nan], [1]], "points: holds NaN"),
    ]:
        with pytest.raises(ValueError, match=message):
            Polytope.from_points(points)


TRIANGLE = Polytope([[-1, 0], [0, -1], [1, 1]], [0, 0, 1], ("x >= 0", "y >= 0", "x + y <= 1"))


SQUARE = Polytope([[1, 0], [-1, 0], [0, 1], [0, -1]], [1, 1, 1, 1])


def same(left, right, tolerance=1e-9):
    return left.is_subset(right, tolerance) and right.is_subset(left, tolerance)


def random_polytope(rng, n, rows=12):
    """Bounded, with 0 inside: random rows and a box."""
    H = np.vstack([rng.standard_normal((rows, n)), np.eye(n), -np.eye(n)])
    return Polytope(H, np.r_[rng.uniform(0.5, 1.5, rows), np.full(2 * n, 2.0)])


def test_image_of_polygons_by_hand():
    sheared = TRIANGLE.image([[2, 1], [0, 1]], [1, -1])  # corners (0,0), (1,0), (0,1) move
    np.testing.assert_allclose(sheared.vertices(), [[1, -1], [3, -1], [2, 0]], atol=1e-14)
    assert sheared.labels == TRIANGLE.labels
    line = TRIANGLE.image([[2.0, -1.0]], [3.0])
    np.testing.assert_allclose(line.vertices(), [[2], [5]], atol=1e-14)
    tiny = TRIANGLE.image(np.diag([1e-3, 1e4]))  # units do not make it flat
    assert tiny.volume() == pytest.approx(5, rel=1e-12)


@pytest.mark.parametrize(("n", "k"), [(2, 1), (3, 2), (4, 2), (5, 3), (3, 3)])
def test_image_and_preimage_against_support_functions(n, k):
    rng = np.random.default_rng(10 * n + k)
    polytope, M, t = (
        random_polytope(rng, n),
        rng.standard_normal((k, n)),
        0.2 * rng.standard_normal(k),
    )
    image = polytope.image(M, t)
    for d in rng.standard_normal((20, k)):  # max d'(Mx + t)
        assert image.support(d) == pytest.approx(polytope.support(M.T @ d) + d @ t, abs=1e-9)
    target = random_polytope(rng, k)
    pulled = target.preimage(M, t)
    points = rng.standard_normal((2000, n))
    inside = (points @ M.T + t) @ target.H.T <= target.h
    np.testing.assert_array_equal(points @ pulled.H.T <= pulled.h, inside)
    assert 0 < inside.all(axis=1).sum() < 2000


@pytest.mark.parametrize("n", [2, 4])
def test_images_of_planes_along_their_normals_are_points(n):
    """Rounding is no direction: {x : a'x = 1} under a is {1}, and under two rows a line."""
    for a in np.random.default_rng(0).integers(-3, 4, (20, n)).astype(float):
        if a.any():
            plane = Polytope(np.vstack([a, -a]), [1.0, -1.0])
            image = plane.image(a[None])
            np.testing.assert_allclose(image.support([[1.0], [-1.0]]), [1, -1])
            assert image.affine_dimension() == 0
            twice = plane.image(np.vstack([a, 0.3 * a]))
            np.testing.assert_allclose(twice.support([[1.0, 0], [0, -1]]), [1, -0.3], atol=1e-9)


def test_preimage_keeps_rows_and_works_unbounded():
    half = Polytope([[1, 0], [0, 1]], [2, INF], ("a", "b"))
    pulled = half.preimage([[1, 1, 0], [0, 0, 1]], [0.5, 7])
    np.testing.assert_array_equal(pulled.H, [[1, 1, 0], [0, 0, 1]])
    np.testing.assert_array_equal(pulled.h, [1.5, INF])
    assert pulled.labels == ("a", "b") and pulled.support([1, 1, 0]) == 1.5
    assert Polytope([[1, 0]], [-1]).preimage([[0.0], [1.0]]).is_empty()


def test_projection_by_hand():
    cross = Polytope(np.array(list(itertools.product([-1, 1], repeat=3))), np.ones(8))
    diamond = cross.project([2, 0])
    corners = [[0, -1], [1, 0], [0, 1], [-1, 0]]
    np.testing.assert_allclose(sorted(diamond.vertices().tolist()), sorted(corners), atol=1e-14)
    # {0 <= x, x <= y, y <= 3 + z, z in [0, 1]}, in the order asked for
    wedge = Polytope([[-1, 0, 0], [1, -1, 0], [0, 1, -1], [0, 0, 1], [0, 0, -1]], [0, 0, 3, 1, 0])
    shadow = wedge.project([1, 0])
    np.testing.assert_allclose(shadow.vertices(), [[0, 0], [4, 0], [4, 4]], atol=1e-12)
    assert len(shadow.h) == 3
    np.testing.assert_allclose(wedge.project([2]).vertices(), [[0], [1]], atol=1e-14)
    same_set = wedge.project([2, 1, 0])
    assert same(same_set.project([2, 1, 0]), wedge)


def test_projection_of_unbounded_sets():
    # x <= u, u <= 1: x <= 1. And u free above: x is free.
    ray = Polytope([[1, -1], [0, 1]], [0, 1]).project([0])
    np.testing.assert_allclose(np.c_[ray.H, ray.h], [[1, 1]], atol=1e-14)
    assert Polytope([[1, -1]], [0]).project([0]).H.shape == (0, 1)
    strip = Polytope([[1, 0, 1], [-1, 0, 1], [0, 0, -1]], [1, 1, 0]).project([0, 1])
    assert len(strip.h) == 2 and strip.support([1, 0]) == 1 and strip.support([0, 1]) == INF


@pytest.mark.parametrize(("n", "keep"), [(3, 2), (4, 2), (4, 3), (5, 3), (6, 4)])
def test_projection_supports_are_those_of_the_lifted_set(n, keep):
    rng = np.random.default_rng(n)
    polytope = random_polytope(rng, n, rows=8)
    axes = [int(i) for i in rng.permutation(n)[:keep]]
    shadow = polytope.project(axes)
    for d in rng.standard_normal((30, keep)):
        lifted = np.zeros(n)
        lifted[axes] = d
        assert shadow.support(d) == pytest.approx(polytope.support(lifted), rel=1e-9)
    # No row can go: without it the set is larger.
    for i in range(len(shadow.h)):
        others = np.arange(len(shadow.h)) != i
        assert Polytope(shadow.H[others], shadow.h[others]).support(shadow.H[i]) > shadow.h[i]


def box_support(box, d):
    """max d'x over a box with infinite sides, for each of the rows d."""
    with np.errstate(invalid="ignore"):
        ends = np.where(d > 0, d * box.upper, d * box.lower)
    return np.where(d == 0, 0.0, ends).sum(axis=1)


@pytest.mark.parametrize("count", [8, pytest.param(40, marks=pytest.mark.slow)])
def test_images_and_sums_of_unbounded_sets_have_the_supports_of_their_parts(count):
    """What rounding leaves in rows and rays must not bound a set that nothing else bounds."""
    rng = np.random.default_rng(0)

    def unbounded(n):
        lower, upper = -rng.uniform(0.1, 2, n), rng.uniform(0.1, 2, n)
        free = rng.uniform(size=(2, n))
        return Box(np.where(free[0] < 0.5, -np.inf, lower), np.where(free[1] < 0.3, np.inf, upper))

    for k in range(count):
        box, M, d = unbounded(3), rng.normal(size=(2, 3)), rng.normal(size=(6, 2))
        size = 10.0 ** rng.uniform(-2, 2, 3)
        M[1] = M[0] if k % 2 else M[1]  # of half of them the image is flat
        image = Box(box.lower * size, box.upper * size).image(M / size)
        np.testing.assert_allclose(image.support(d), box_support(box, d @ M), rtol=1e-9, atol=1e-9)
        R, box = rng.normal(size=(2, 2)), unbounded(2)
        low, high = np.sort(rng.normal(size=(2, 2)), axis=0)
        flat = Box(low, np.where([True, False], high, low))
        total = box_support(box, d @ np.linalg.inv(R)) + box_support(flat, d)  # of {x : R x in box}
        found = box.preimage(R).minkowski_sum(flat).support(d)
        np.testing.assert_allclose(found, total, rtol=1e-9, atol=1e-9)


def test_closest_points_in_units_that_differ():
    """They keep all rows; no point of the set is nearer, by a linear program."""
    rng = np.random.default_rng(391)
    for _ in range(50):
        size = 10.0 ** rng.uniform(-3, 3, 2)
        G, inside, x = rng.normal(size=(6, 2)) / size, 10 * rng.normal(size=2) * size, 3 * size
        g = G @ inside + rng.choice([0.0, 0.3, 1.0], 6)
        y = Polytope(G, g).closest_point(x)
        terms = np.abs(G) @ np.abs(y) + np.abs(g)
        assert np.all(G @ y <= g + 1e-10 * terms)
        away = (x - y) * size / np.abs((x - y) * size).max()
        most = linprog(-away, G * size, g, bounds=[(None, None)] * 2)
        assert -most.fun <= away @ (y / size) + 1e-7 * (1 + np.abs(y / size).max())


def controllable_joints(joints, hide, coupled=False):
    """{(x, u) : x and x+ in the box, |u| <= 2} for joints with inertia 0.05, 0.1, ...

    x = T z with z the joints' own positions and velocities. Returns it, T^-1 and the factors'
    own predecessor sets, by hand: {|q| <= 1.5, |q + 0.01 dq| <= 1.5, |dq| <= 2}.
    """
    n = 2 * joints
    T, inverse = unimodular(np.random.default_rng(joints), n) if hide else (np.eye(n), np.eye(n))
    A = T @ np.kron(np.eye(joints), [[1, 0.01], [0, 1]]) @ inverse
    B = T @ np.kron(np.diag(0.01 / (0.05 * np.arange(1, joints + 1))), [[0], [1]])
    box = Polytope(np.vstack([inverse, -inverse]), np.tile([1.5, 2.0], 2 * joints))
    selector = np.eye(n + joints)
    lifted = box.preimage(np.hstack([A, B])).intersect(box.preimage(selector[:n]))
    torques = Box(np.full(joints, -2.0), np.full(joints, 2.0)).to_polytope()
    lifted = lifted.intersect(torques.preimage(selector[n:]))
    block = np.array([[1, 0], [1, 0.01], [0, 1]])
    H = np.kron(np.eye(joints), np.vstack([block, -block])) @ inverse
    return lifted, Polytope(H, np.tile([1.5, 1.5, 2.0], 2 * joints))


@pytest.mark.parametrize("joints", [1, 2, 6])
def test_projection_of_a_hidden_product_is_the_product(joints):
    lifted, expected = controllable_joints(joints, hide=True)
    shadow = lifted.project(range(2 * joints))
    # |q + 0.01 dq| <= 1.5 cuts two corners off each rectangle, so six rows a joint.
    assert shadow.H.shape == (6 * joints, 2 * joints)
    assert same(shadow, expected, 1e-11)
    # Each corner cut off is a triangle with legs 0.02 and 2; det T = 1.
    assert shadow.volume() == pytest.approx((12 - 0.04) ** joints, rel=1e-10)


@pytest.mark.slow
def test_projection_in_twelve_dimensions_without_product_structure():
    lifted, expected = controllable_joints(6, hide=True)
    row = expected.H[::6].sum(axis=0)  # q_1 + ... + q_6
    coupled = lifted.intersect(Polytope([np.r_[row, np.zeros(6)]], [3]))
    shadow = coupled.project(range(12))
    assert len(shadow.h) == 37
    assert same(shadow, expected.intersect(Polytope([row], [3])), 1e-9)


def test_unbounded_is_not_called_empty():
    # 0 is in the set; HiGHS' presolve calls this LP infeasible.
    H = [
        [0, 0.407, -0.407, 0.814, -0.081], [1, -0.005, 0.01, 0.01, 0],
        [-0.998, 0.04, -0.04, 0, -0.001], [0.998, 0.02, -0.04, 0.04, 0.003],
        [0.999, 0.02, 0.02, -0.02, 0.001], [1, 0, -0.003, 0.007, 0],
    ]  # fmt: skip
    polytope = Polytope(H, [0, 0.15, 0.3, 0.499, 0.1, 0.033])
    d = np.array([-1.381, -0.07, 0.04, 0.028, -0.022])
    ray = linprog(-d, A_ub=H, b_ub=np.zeros(6), bounds=(-1, 1))  # a direction that never leaves
    assert -ray.fun > 0.01 and (np.array(H) @ ray.x).max() <= 1e-12
    assert polytope.support(d) == INF and not polytope.is_empty()


def test_labels_follow_their_rows():
    twice = TRIANGLE.intersect(Box([0.25, -INF], [INF, INF])).intersect(TRIANGLE)
    assert twice.labels == TRIANGLE.labels + ("",) + TRIANGLE.labels
    assert set(twice.reduce().labels) == {"", "y >= 0", "x + y <= 1"}
    assert Polytope([[0, 0], [1, 0], [0, 1], [-1, -1]], [1, 1, 1, 1], tuple("abcd")).reduce(
    ).labels == ("b", "c", "d")  # fmt: skip
    assert jax.tree.map(lambda leaf: 2 * leaf, TRIANGLE).labels == TRIANGLE.labels
    for labels, message in [(("a",), "labels: 1 entries where 3"), (["a"] * 3, "labels: .* tuple")]:
        with pytest.raises(ValueError, match=message):
            Polytope(TRIANGLE.H, TRIANGLE.h, labels).validate("states")


def test_minkowski_sums_by_hand():
    # A triangle and the square [-1, 1]^2: area 1/2 + 4 + mixed area (2 + 1 + ... ) = 8.5.
    total = TRIANGLE.minkowski_sum(Box([-1, -1], [1, 1]))
    corners = [[-1, -1], [2, -1], [2, 1], [1, 2], [-1, 2]]
    np.testing.assert_allclose(total.vertices(), corners, atol=1e-14)
    assert total.volume() == pytest.approx(8.5, abs=1e-13)
    segment = SQUARE.minkowski_sum([[0.0, 0.0], [1.0, 1.0]])
    assert len(segment.h) == 6 and segment.volume() == pytest.approx(8, abs=1e-13)
    flat = SQUARE.minkowski_sum(Box([2, -1], [2, 1]))  # a vertical segment at x = 2
    np.testing.assert_allclose(flat.vertices(), [[1, -2], [3, -2], [3, 2], [1, 2]], atol=1e-13)
    point = SQUARE.minkowski_sum([[3.0, 4.0]])
    assert point.support([1, 0]) == pytest.approx(4) and point.volume() == pytest.approx(4)
    cube = Box(-np.ones(4), np.ones(4)).to_polytope()
    for shifted in (np.arange(4.0)[None], Box(np.arange(4), np.arange(4))):
        moved = cube.minkowski_sum(shifted)
        np.testing.assert_allclose([moved.support(d) for d in np.eye(4)], [1, 2, 3, 4])
    longer = cube.minkowski_sum(Box([0, 0, 1, 0], [0, 2, 1, 0]))  # flat in three coordinates
    np.testing.assert_allclose([longer.support(d) for d in np.eye(4)], [1, 3, 2, 1])
    assert len(longer.h) == 8
    half_plane = Polytope([[1, 0]], [1]).minkowski_sum(TRIANGLE)
    assert half_plane.H.shape == (1, 2) and half_plane.support([1, 0]) == pytest.approx(2)
    assert SQUARE.minkowski_sum(Box([0, -INF], [0, 0.5])).support([0, 1]) == pytest.approx(1.5)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_sums_add_supports_and_differences_undo_them(n):
    rng = np.random.default_rng(n)
    P = random_polytope(rng, n, rows=3)
    box = Box(rng.uniform(-1, 0, n), rng.uniform(0, 1, n))
    points = rng.standard_normal((3, n))
    simplex = Polytope(np.vstack([-np.eye(n), np.ones((1, n))]), np.r_[np.zeros(n), 1.0])
    supports = [
        (box, lambda d: np.maximum(d * box.lower, d * box.upper).sum()),
        (points, lambda d: (points @ d).max()),
        (simplex, lambda d: max(d.max(), 0.0)),
    ]
    for Q, support in supports:
        total = P.minkowski_sum(Q)
        for d in rng.standard_normal((20, n)):
            assert total.support(d) == pytest.approx(P.support(d) + support(d), abs=1e-9)
        assert same(total.pontryagin_difference(Q), P)  # (P + Q) - Q = P for convex P
    # In the other order the sum lies within: (P - Q) + Q is a subset of P.
    small = box.to_polytope().scale(0.1)
    assert P.pontryagin_difference(small).minkowski_sum(small).is_subset(P)


def test_pontryagin_difference_by_its_definition():
    rng = np.random.default_rng(3)
    P, Q = random_polytope(rng, 3), random_polytope(rng, 3).scale(0.2)
    difference = P.pontryagin_difference(Q)
    V, W = difference.vertices(), Q.vertices()
    assert ((V[:, None] + W).reshape(-1, 3) @ P.H.T - P.h).max() <= 1e-10
    outside = 1.001 * V  # 0 is inside, so each of these leaves P for some w
    worst = (outside @ P.H.T)[:, None] + W @ P.H.T - P.h
    assert worst.max(axis=(1, 2)).min() > 0
    assert same(P.pontryagin_difference(W), difference)
    inner = SQUARE.pontryagin_difference(Ellipsoid([[4.0, 0], [0, 1]], 0.25))
    np.testing.assert_allclose(inner.h, [0.75, 0.75, 0.5, 0.5], atol=1e-15)
    open_ended = Polytope([[1, 0], [0, 1]], [1, INF]).pontryagin_difference(Box([0, -9], [0.5, 9]))
    np.testing.assert_array_equal(open_ended.h, [0.5, INF])
    assert SQUARE.pontryagin_difference(Box([-2, 0], [2, 0])).is_empty()
    assert SQUARE.pontryagin_difference(Box([0, 0], [INF, 0])).is_empty()


def test_subsets_scales_and_box_intersections():
    assert TRIANGLE.is_subset(SQUARE) and not SQUARE.is_subset(TRIANGLE)
    assert SQUARE.is_subset(Box([-1, -1], [1, 1])) and SQUARE.is_subset(SQUARE)
    wider = SQUARE.scale(1 + 1e-6)
    assert not wider.is_subset(SQUARE) and wider.is_subset(SQUARE, 2e-6)
    assert SQUARE.is_subset(Polytope([[1e9, 0]], [1e9 + 1]), 0.0)
    assert Polytope([[1, 0], [-1, 0]], [0, -1]).is_subset(TRIANGLE)  # empty
    half = Polytope([[1, 0]], [1])
    assert half.is_subset(Polytope([[2, 0]], [2])) and not half.is_subset(SQUARE)
    assert half.is_subset(Box([-INF, -INF], [INF, INF]))
    assert TRIANGLE.scale(3).volume() == pytest.approx(4.5, abs=1e-13)
    corner = Box([-1, -INF], [1, 2]).intersect(Box([0, 0], [5, 5]))
    np.testing.assert_array_equal((corner.lower, corner.upper), ([0, 0], [1, 2]))
    assert Box([0.5, 0], [1, 1]).intersect(TRIANGLE).volume() == pytest.approx(0.125, abs=1e-14)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: SQUARE.image([1, 2]), r"M: shape \(2,\) is not \(k, 2\)"),
        (lambda: SQUARE.preimage(np.eye(3)), r"M: shape \(3, 3\) is not \(2, k\)"),
        (lambda: SQUARE.preimage(np.eye(2), [1]), r"t: shape \(1,\) where \(2,\)"),
        (lambda: SQUARE.preimage([[1, 0], [0, np.nan]]), "M: holds NaN"),
        (lambda: SQUARE.project([0, 0]), r"axes: \[0, 0\] are not distinct numbers in 0..1"),
        (lambda: SQUARE.project([]), "axes: "),
        (lambda: SQUARE.project([2]), "axes: "),
        (lambda: SQUARE.minkowski_sum([1, 2]), r"other: shape \(2,\) is not \(k, 2\)"),
        (lambda: SQUARE.minkowski_sum(Box([0], [1])), "other: has dimension 1 where 2"),
        (lambda: SQUARE.minkowski_sum(Ellipsoid(np.eye(2), 1.0)), "other: is an Ellipsoid"),
        (lambda: SQUARE.pontryagin_difference([[1.0]]), "other: shape"),
        (lambda: SQUARE.pontryagin_difference(Box([1, 0], [0, 1])), "other: is empty"),
        (lambda: SQUARE.is_subset([1]), "other: list is no set"),
        (lambda: SQUARE.scale(0), "factor: 0 is not a positive"),
        (lambda: Box([0], [1]).intersect(Box([0, 0], [1, 1])), "other: has dimension 2 where 1"),
    ],
)
def test_set_operations_errors(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize(("n", "rows"), [(4, 16), (5, 6)])
def test_sums_of_many_vertices_by_few(n, rows):
    """P + P = 2 P, whose 10,000 sums of vertices lie on its faces; and supports of P + Q add."""
    rng = np.random.default_rng(n)
    P = random_polytope(rng, n, rows=rows)
    assert len(P.vertices()) ** 2 > 1000
    doubled = P + P
    assert len(doubled.h) == len(P.reduce().h) and same(doubled, P.scale(2))
    Q = Polytope.from_points(rng.standard_normal((n + 6, n)))
    d = rng.standard_normal((20, n))
    np.testing.assert_allclose((P + Q).support(d), P.support(d) + Q.support(d), rtol=1e-9)


@pytest.mark.parametrize("least", [1e-10, 1e-13, 1e-30, 1e-290])
def test_volume_of_a_box_that_begins_next_to_zero(least):
    """[−1, 1]² × [−least, 1]: beside 1 the point inside must not lie within `least` of a side."""
    H = np.vstack([np.eye(3), -np.eye(3)])
    assert Polytope(H, np.append(np.ones(5), least)).volume() == pytest.approx(4.0, rel=1e-9)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("far", [1e3, 1e6, 1e8])
def test_a_set_far_from_the_origin_has_its_vertices_once(far):
    """Offsets lose what rounding takes from the distance, so that the facets of a vertex part."""
    rng = np.random.default_rng(0)
    for n in (2, 3, 3, 4, 4):
        points, units = rng.normal(size=(20, n)), 10.0 ** rng.uniform(-4, 4, n)
        center = far * rng.normal(size=n)
        expected = points[scipy.spatial.ConvexHull(points).vertices]
        moved = Polytope.from_points(points * units).translate(center * units)
        found = moved.vertices() / units - center
        assert len(found) == len(expected)
        assert np.all(scipy.spatial.distance.cdist(found, expected).min(axis=0) < 1e-11 * far)


def test_a_set_of_a_size_whose_square_vanishes_is_flat():
    """What is left of a point after rounding: it was divided by lengths that are 0."""
    with pytest.raises(ValueError, match="is flat"):
        Polytope(SQUARE.H, 1e-291 * np.ones(4)).frame("set")
