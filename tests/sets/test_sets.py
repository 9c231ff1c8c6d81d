"""Images, projections, sums and differences of sets, ellipsoids and limits.

The answers are closed forms, polygons computed by hand, products whose factors are known, and
support functions taken from LPs over the sets' definitions.
"""

import itertools
import math

import jax
import numpy as np
import pytest
import scipy
from scipy.optimize import linprog

import jaxmpc.sets.geometry as geometry
from jaxmpc import LinearSystem
from jaxmpc.sets.box import Box
from jaxmpc.sets.ellipsoid import Ellipsoid
from jaxmpc.sets.geometry import factors, irredundant
from jaxmpc.sets.limits import joint_limits, output_limits
from jaxmpc.sets.polytope import Polytope

INF = np.inf
TRIANGLE = Polytope([[-1, 0], [0, -1], [1, 1]], [0, 0, 1], ("x >= 0", "y >= 0", "x + y <= 1"))
SQUARE = Polytope([[1, 0], [-1, 0], [0, 1], [0, -1]], [1, 1, 1, 1])


def same(left, right, tolerance=1e-9):
    return left.is_subset(right, tolerance) and right.is_subset(left, tolerance)


def random_polytope(rng, n, rows=12):
    """Bounded, with 0 inside: random rows and a box."""
    H = np.vstack([rng.standard_normal((rows, n)), np.eye(n), -np.eye(n)])
    return Polytope(H, np.r_[rng.uniform(0.5, 1.5, rows), np.full(2 * n, 2.0)])


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


# --- Affine maps ------------------------------------------------------------------------


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


def test_preimage_keeps_rows_and_works_unbounded():
    half = Polytope([[1, 0], [0, 1]], [2, INF], ("a", "b"))
    pulled = half.preimage([[1, 1, 0], [0, 0, 1]], [0.5, 7])
    np.testing.assert_array_equal(pulled.H, [[1, 1, 0], [0, 0, 1]])
    np.testing.assert_array_equal(pulled.h, [1.5, INF])
    assert pulled.labels == ("a", "b") and pulled.support([1, 1, 0]) == 1.5
    assert Polytope([[1, 0]], [-1]).preimage([[0.0], [1.0]]).is_empty()


# --- Projection -------------------------------------------------------------------------


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


# --- Redundant rows ---------------------------------------------------------------------


def test_factors_find_a_hidden_product():
    rng = np.random.default_rng(0)
    T, inverse = unimodular(rng, 7)
    blocks = [rng.standard_normal((rows, n)) for rows, n in ((6, 2), (9, 3), (2, 1), (2, 1))]
    Y = scipy.linalg.block_diag(*blocks) @ inverse
    parts, S = factors(Y)
    assert sorted((len(rows), Z.shape[1]) for rows, Z in parts) == [(2, 1), (2, 1), (6, 2), (9, 3)]
    points = rng.standard_normal((50, 7))
    for rows, Z in parts:  # Z t is Y x, for t some entries of S x
        start = np.linalg.lstsq(Z, (points @ Y[rows].T).T, rcond=None)
        np.testing.assert_allclose(Z @ start[0], (points @ Y[rows].T).T, atol=1e-10)
    assert S.shape == (7, 7)
    bridge = np.vstack([Y, rng.standard_normal(7)])  # one row that contains all coordinates
    assert len(factors(bridge)[0]) == 1
    assert factors(np.eye(3)[:2])[1].shape == (2, 3)


@pytest.mark.parametrize("n", [2, 3, 5, 6])
def test_hulls_and_programs_find_the_same_rows(n, monkeypatch):
    rng = np.random.default_rng(n)
    Y = rng.standard_normal((60, n)) * rng.uniform(0.3, 1, (60, 1))
    Y = np.vstack([Y, 0.5 * Y[:10], Y[:10], 0.5 * (Y[10:20] + Y[20:30])])  # all redundant
    hull = irredundant(Y)
    monkeypatch.setattr(geometry, "_HULL_DIMENSIONS", 1)
    programs = irredundant(Y)
    np.testing.assert_array_equal(hull, programs)
    np.testing.assert_array_equal(irredundant(Y, known=hull), programs)
    assert hull.max() < 60
    unbounded = Y[Y[:, 0] > 0]
    needed = []  # by definition: over the set of the others its maximum exceeds 1
    for i, row in enumerate(unbounded):
        others = [j for j, other in enumerate(unbounded) if j < i or not np.allclose(other, row)]
        ones = np.ones(len(others))
        top = linprog(-row, A_ub=unbounded[others], b_ub=ones, bounds=(None, None))
        if top.status == 3 or -top.fun > 1 + 1e-9:
            needed.append(i)
    np.testing.assert_array_equal(irredundant(unbounded), needed)
    monkeypatch.undo()
    np.testing.assert_array_equal(irredundant(unbounded), needed)


def test_reduce_in_twelve_dimensions():
    rng = np.random.default_rng(0)
    # 100 rows on a sphere, all irredundant, and 300 inside their polar hull.
    Y = rng.standard_normal((100, 12))
    Y /= np.linalg.norm(Y, axis=1)[:, None]
    weights = rng.dirichlet(np.ones(4), 300)
    inside = np.einsum("ij,ijk->ik", weights, Y[rng.integers(0, 100, (300, 4))]) * 0.999
    order = rng.permutation(400)
    rows = np.vstack([Y, inside])[order]
    reduced = Polytope(rows, np.ones(400), tuple(map(str, order))).reduce()
    assert sorted(map(int, reduced.labels)) == list(range(100))


def test_labels_follow_their_rows():
    twice = TRIANGLE.intersect(Box([0.25, -INF], [INF, INF])).intersect(TRIANGLE)
    assert twice.labels == TRIANGLE.labels + ("",) + TRIANGLE.labels
    assert set(twice.reduce().labels) == {"", "y >= 0", "x + y <= 1"}
    assert Polytope([[0, 0], [1, 0], [0, 1], [-1, -1]], [1, 1, 1, 1], tuple("abcd")).reduce(
    ).labels == ("b", "c", "d")  # fmt: skip
    assert jax.tree.map(lambda leaf: 2 * leaf, TRIANGLE).labels == TRIANGLE.labels
    for labels, message in [(("a",), "labels: 1 entries for 3"), (["a"] * 3, "labels: .* tuple")]:
        with pytest.raises(ValueError, match=message):
            Polytope(TRIANGLE.H, TRIANGLE.h, labels).validate("states")


# --- Sums and differences ---------------------------------------------------------------


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
        (lambda: SQUARE.image([[1, 2], [2, 4]]), "M: has rank below 2, so the image is flat"),
        (lambda: SQUARE.image(np.ones((3, 2))), "M: has rank below 3"),
        (lambda: SQUARE.image([1, 2]), r"M: shape \(2,\) is not \(k, 2\)"),
        (lambda: SQUARE.preimage(np.eye(3)), r"M: shape \(3, 3\) is not \(2, k\)"),
        (lambda: SQUARE.preimage(np.eye(2), [1]), r"t: shape \(1,\) where \(2,\)"),
        (lambda: SQUARE.preimage([[1, 0], [0, np.nan]]), "M: holds NaN"),
        (lambda: SQUARE.project([0, 0]), r"axes: \[0, 0\] are not distinct numbers in 0..1"),
        (lambda: SQUARE.project([]), "axes: "),
        (lambda: SQUARE.project([2]), "axes: "),
        (lambda: Polytope([[1, 0], [-1, 0]], [0, 0]).project([0]), "Polytope: is flat, and so"),
        (lambda: Polytope([[1, 0], [-1, 0]], [0, -1]).project([1]), "Polytope: is empty"),
        (lambda: SQUARE.minkowski_sum([1, 2]), r"other: shape \(2,\) is not \(k, 2\)"),
        (lambda: SQUARE.minkowski_sum(Box([0], [1])), "other: has dimension 1 where 2"),
        (lambda: SQUARE.minkowski_sum(Box([1, 0], [0, 1])), "other: is empty"),
        (lambda: SQUARE.pontryagin_difference([[1.0]]), "other: shape"),
        (lambda: SQUARE.pontryagin_difference(Box([1, 0], [0, 1])), "other: is empty"),
        (lambda: SQUARE.is_subset([1]), "other: list is no Box or Polytope"),
        (lambda: SQUARE.scale(0), "factor: 0 is not a positive"),
        (lambda: Box([0], [1]).intersect(Box([0, 0], [1, 1])), "other: has dimension 2 where 1"),
    ],
)
def test_set_operations_errors(call, message):
    with pytest.raises(ValueError, match=message):
        call()


# --- Ellipsoids -------------------------------------------------------------------------


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
        (Ellipsoid(np.ones((2, 3)), 1.0), r"X_f.P: shape \(2, 3\) is not \(n, n\)"),
        (Ellipsoid([[1, 2], [0, 1]], 1.0), "X_f.P: is not symmetric"),
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


# --- Limits -----------------------------------------------------------------------------


def test_joint_limits_are_problem_5():
    q_min, q_max, dq = np.array([-1.5, -2.0]), np.array([1.5, 0.5]), np.array([2.0, 3.0])
    limits = joint_limits((q_min, q_max), (-dq, dq), torque=2)
    S_q, S_dq = np.hstack([np.eye(2), np.zeros((2, 2))]), np.hstack([np.zeros((2, 2)), np.eye(2)])
    np.testing.assert_array_equal(limits.states.H, np.vstack([S_q, -S_q, S_dq, -S_dq]))
    np.testing.assert_array_equal(limits.states.h, np.concatenate([q_max, -q_min, dq, dq]))
    assert limits.states.labels == (
        "q1 <= 1.5 rad", "q2 <= 0.5 rad", "q1 >= -1.5 rad", "q2 >= -2 rad",
        "dq1 <= 2 rad/s", "dq2 <= 3 rad/s", "dq1 >= -2 rad/s", "dq2 >= -3 rad/s",
    )  # fmt: skip
    np.testing.assert_array_equal((limits.inputs.lower, limits.inputs.upper), ([-2, -2], [2, 2]))
    system = LinearSystem(np.eye(4), np.ones((4, 2)), **limits.names)
    system.validate()
    assert system.state_labels == ("q1 [rad]", "q2 [rad]", "dq1 [rad/s]", "dq2 [rad/s]")
    assert system.input_labels == ("tau1 [N m]", "tau2 [N m]")
    only = joint_limits(position=(-INF, 1), names=("lift",), units=("m", "m/s", "N"))
    assert only.states.labels == ("lift <= 1 m",) and only.inputs.support([1.0]) == INF
    assert only.state_names == ("lift", "lift velocity") and only.input_units == ("N",)
    assert joint_limits(velocity=1).states.labels == ("dq1 <= 1 rad/s", "dq1 >= -1 rad/s")
    mixed = joint_limits(1, names=("a", "b"), units=(("rad", "m"), ("rad/s", "m/s"), ("N m", "N")))
    assert mixed.states.labels[:2] == ("a <= 1 rad", "b <= 1 m")
    assert joint_limits().states.H.shape == (0, 2)


def test_output_limits_are_rows_of_C():
    C = np.array([[1.0, 2.0], [0.0, -1.0]])
    limits = output_limits(C, [-1, -INF], [3, 4], ("y", "z"), ("m", ""))
    np.testing.assert_array_equal(limits.H, [[1, 2], [0, -1], [-1, -2]])
    np.testing.assert_array_equal(limits.h, [3, 4, 1])
    assert limits.labels == ("y <= 3 m", "z <= 4", "y >= -1 m")
    assert output_limits(C, None, 1).labels == ("y1 <= 1", "y2 <= 1")
    assert output_limits(C, None, None).H.shape == (0, 2)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: joint_limits([1, 2, 3]), "position: .* is not a pair"),
        (lambda: joint_limits((1, -1)), r"position: is empty: lower\[0\] = 1"),
        (lambda: joint_limits(-1), "position: is empty"),
        (lambda: joint_limits(torque=(1, -1)), "torque: is empty"),
        (lambda: joint_limits(velocity=np.nan), "velocity.lower: holds NaN"),
        (lambda: joint_limits(([-1, -1], [1, 1]), ([-1] * 3, 1)), "position: 2 entries for 3"),
        (lambda: joint_limits(([-1, -1], 1), names=("q",)), "position: 2 entries for 1"),
        (lambda: joint_limits(1, units="rad"), "units: "),
        (lambda: joint_limits(1, units=(("rad", "m"), "", "")), "units: .* does not fit 1"),
        (lambda: output_limits([1, 2], 0, 1), r"C: shape \(2,\) is not \(p, n\)"),
        (lambda: output_limits([[1, 2]], [0, 0], 1), r"limits.lower: shape \(2,\) is not \(1,\)"),
        (lambda: output_limits([[1, 2]], 0, 1, "y"), "names: 'y' is not one string an output"),
        (lambda: output_limits([[np.inf, 2]], 0, 1), "C: holds NaN"),
    ],
)
def test_limits_errors(call, message):
    with pytest.raises(ValueError, match=message):
        call()
