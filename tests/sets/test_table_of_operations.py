"""Every operation of docs/reference/sets.md on every kind of set, full, flat, empty, unbounded and
a point, against interval arithmetic in fractions.

Each set is a product of intervals, of which all truths are known: its support is a sum of ends, and
an image, a sum or a translate adds or maps supports. Sets that an operation returns are compared by
their supports in many directions.
"""

import itertools
from fractions import Fraction as F
from math import inf

import numpy as np
import pytest

from jaxmpc import Box, Ellipsoid, Polytope
from jaxmpc.sets import PolytopeUnion, Zonotope, set_difference

# Intervals (lower, upper) of each coordinate.
SHAPES = {
    "full": [(F(-1), F(2)), (F(0), F(1))],
    "flat": [(F(-1), F(2)), (F(1), F(1))],
    "point": [(F(2), F(2)), (F(1), F(1))],
    "empty": [(F(1), F(-1)), (F(0), F(1))],
    "unbounded": [(F(-1), inf), (F(0), F(1))],
    "flat and unbounded": [(-inf, inf), (F(1), F(1))],
}
UNITS = {"1": (1.0, 1.0), "1e-6 and 1e6": (2.0**-20, 2.0**20)}  # exact in floats
OTHER = [(F(-1, 2), F(1, 4)), (F(-1, 4), F(1, 2))]
DIRECTIONS = [d for d in itertools.product((-3, -1, 0, 1, 2), repeat=2) if any(d)]
SHEAR = ((F(1), F(1, 2)), (F(-1, 2), F(2)))
SINGULAR = ((F(1), F(2)), (F(2), F(4)))


def box(intervals, unit):
    lower, upper = (np.array([float(end[k]) for end in intervals]) * unit for k in (0, 1))
    return Box(lower, upper)


def polytope(intervals, unit):
    """Rows of norms that have nothing to do with their units."""
    rows = []
    for i, (low, high) in enumerate(intervals):
        for k, (sign, end) in enumerate(((1, high), (-1, -low))):
            if abs(end) < inf:
                e = np.zeros(len(intervals))
                e[i] = sign * 3.0**k / unit[i]
                rows.append((e, 3.0**k * float(end)))
    H = np.array([row for row, _ in rows]).reshape(len(rows), len(intervals))
    return Polytope(H, np.array([end for _, end in rows]))


def zonotope(intervals, unit):
    return box(intervals, unit).to_zonotope()


KINDS = {"Box": box, "Polytope": polytope, "Zonotope": zonotope}


def is_empty(intervals):
    return any(low > high for low, high in intervals)


def height(intervals, d):
    """max d'x over the product; -inf if it is empty."""
    if is_empty(intervals):
        return -inf
    ends = [
        d_i * (high if d_i > 0 else low)
        for (low, high), d_i in zip(intervals, d, strict=True)
        if d_i
    ]
    return sum(ends, F(0))


def times(M, d):
    """M'd."""
    return [sum(M[i][j] * d[i] for i in range(len(d))) for j in range(len(M[0]))]


def scaled(M, unit_out, unit_in):
    """M between coordinates in units."""
    return np.array([[float(v) for v in row] for row in M]) * np.divide.outer(unit_out, unit_in)


def meet(one, other):
    return [(max(a, c), min(b, d)) for (a, b), (c, d) in zip(one, other, strict=True)]


def less(one, other):
    return [(a - c, b - d) for (a, b), (c, d) in zip(one, other, strict=True)]


# Each: call(set, unit, kind's maker) and the support function of the truth, of the intervals.
SETS = {
    "image": (
        lambda P, u, make: scaled(SHEAR, u, u) @ P,
        lambda I, d: height(I, times(SHEAR, d)),
    ),
    "image under a singular matrix": (
        lambda P, u, make: P.image(scaled(SINGULAR, u, u), np.array([1.0, 0]) * u),
        lambda I, d: height(I, times(SINGULAR, d)) + d[0],
    ),
    "image in more coordinates": (
        lambda P, u, make: (scaled(((1, 0), (0, 1), (1, 1)), (*u, 1.0), u) @ P).project([0, 1]),
        height,
    ),
    "image under zero": (
        lambda P, u, make: np.zeros((2, 2)) @ P,
        lambda I, d: height([(F(0), F(0))] * 2, d) if not is_empty(I) else -inf,
    ),
    "preimage": (
        lambda P, u, make: P @ scaled(((2, 0), (0, 4)), u, u),
        lambda I, d: height(I, [d[0] / F(2), d[1] / F(4)]),
    ),
    "preimage under a singular matrix": (
        lambda P, u, make: P.preimage(scaled(((0, 0), (0, 1)), u, u), np.array([1.0, 0]) * u),
        lambda I, d: height(
            [(-inf, inf) if not is_empty(meet(I[:1], [(1, 1)])) else (1, 0), I[1]], d
        ),
    ),
    "sum": (
        lambda P, u, make: P + make(OTHER, u),
        lambda I, d: height(I, d) + height(OTHER, d),
    ),
    "sum with a box": (
        lambda P, u, make: P + box(OTHER, u),
        lambda I, d: height(I, d) + height(OTHER, d),
    ),
    "sum with a segment": (
        lambda P, u, make: P + Zonotope([0, 0], np.array([[1.0], [2.0]]) * np.reshape(u, (2, 1))),
        lambda I, d: height(I, d) + abs(d[0] + 2 * d[1]),
    ),
    "sum with itself": (lambda P, u, make: P + P, lambda I, d: 2 * height(I, d)),
    "sum with the empty set": (lambda P, u, make: P + Polytope.empty(2), lambda I, d: -inf),
    "sum with points": (
        lambda P, u, make: P.minkowski_sum(np.array([[0, 0], [1.0, 2]]) * u),
        lambda I, d: height(I, d) + max(0, d[0] + 2 * d[1]),
    ),
    "difference": (
        lambda P, u, make: P - box(OTHER, u),
        lambda I, d: height(less(I, OTHER), d) if not is_empty(I) else -inf,
    ),
    "intersection": (
        lambda P, u, make: P & make(OTHER, u),
        lambda I, d: height(meet(I, OTHER), d),
    ),
    "intersection with an empty box": (
        lambda P, u, make: P & Box([1, 0], [0, 1]),
        lambda I, d: -inf,
    ),
    "translate": (
        lambda P, u, make: P + np.array([1.0, 2.0]) * u,
        lambda I, d: height(I, d) + d[0] + 2 * d[1],
    ),
    "translate back": (
        lambda P, u, make: P - np.array([1.0, 2.0]) * u,
        lambda I, d: height(I, d) - d[0] - 2 * d[1],
    ),
    "translate by a left operand": (
        lambda P, u, make: np.array([1.0, 2.0]) * u + P,
        lambda I, d: height(I, d) + d[0] + 2 * d[1],
    ),
    "mirror": (lambda P, u, make: -P, lambda I, d: height(I, [-v for v in d])),
    "scale": (lambda P, u, make: 2 * P, lambda I, d: 2 * height(I, d)),
    "scale by a negative number": (
        lambda P, u, make: P * -2,
        lambda I, d: 2 * height(I, [-v for v in d]),
    ),
    "scale by zero": (
        lambda P, u, make: 0 * P,
        lambda I, d: height([(F(0), F(0))] * 2, d) if not is_empty(I) else -inf,
    ),
    "reduce": (lambda P, u, make: P.to_polytope().reduce(), height),
    "to_polytope": (lambda P, u, make: P.to_polytope(), height),
    "half_spaces": (lambda P, u, make: Polytope(*P.half_spaces()), height),
    "project and back": (
        lambda P, u, make: P.project([1, 0]).project([1, 0]),
        height,
    ),
    "project": (
        lambda P, u, make: P.project([1]).cartesian_product(make([(F(0), F(0))], np.ones(1))),
        lambda I, d: -inf if is_empty(I) else height([I[1], (F(0), F(0))], d),
    ),
    "slice": (
        lambda P, u, make: P.slice({1: float(u[1])}).cartesian_product(
            box([(F(0), F(0))], np.ones(1))
        ),
        lambda I, d: (
            height([meet(I, [(-inf, inf), (1, 1)])[0], (F(0), F(0))], d)
            if not is_empty(meet(I, [(-inf, inf), (1, 1)]))
            else -inf
        ),
    ),
    "cartesian product": (
        lambda P, u, make: P.cartesian_product(make(OTHER, u)).project([0, 3]),
        lambda I, d: height([I[0], OTHER[1]], d) if not is_empty(I) else -inf,
    ),
    "bounding_box": (lambda P, u, make: P.bounding_box(), height),
}


def possible(kind, shape):
    """Whether a kind of set can describe a shape."""
    return kind != "Zonotope" or shape in ("full", "flat", "point")


# Boxes and zonotopes are polytopes to most operations: one shape of them is enough by default.
REPEATED = [("Box", shape) for shape in SHAPES if shape != "unbounded"]
REPEATED += [("Zonotope", shape) for shape in SHAPES if shape != "flat"]

CASES = [
    pytest.param(
        kind,
        shape,
        unit,
        id=f"{kind}, {shape}, units {unit}",
        marks=[pytest.mark.slow] if unit == "1" or (kind, shape) in REPEATED else [],
    )
    for kind, shape, unit in itertools.product(KINDS, SHAPES, UNITS)
    if possible(kind, shape)
]
# The units (e, 1/e) of the images go with the coordinates.
UNIT_OF_RESULT = {"project": (1, None), "slice": (0, None), "cartesian product": (0, 1)}


def directions(name, unit):
    """The rational directions in units."""
    axes = UNIT_OF_RESULT.get(name, (0, 1))
    return np.array(DIRECTIONS, float) / [1.0 if axis is None else unit[axis] for axis in axes]


@pytest.mark.long
@pytest.mark.parametrize(("kind", "shape", "unit"), CASES)
def test_sets_that_operations_return(kind, shape, unit):
    make, intervals, unit = KINDS[kind], SHAPES[shape], np.array(UNITS[unit])
    P = make(intervals, unit)
    for name, (call, truth) in SETS.items():
        found = call(P, unit, make)
        expected = [truth(intervals, d) for d in DIRECTIONS]
        if -inf in expected:
            assert found.is_empty() and found.affine_dimension() == -1, name
            continue
        assert not found.is_empty(), name
        got = found.support(directions(name, unit))
        expected = np.array([float(v) for v in expected])
        np.testing.assert_allclose(got, expected, rtol=1e-9, atol=1e-9, err_msg=name)
        assert found.is_bounded() == np.isfinite(expected).all(), name


@pytest.mark.parametrize(("kind", "shape", "unit"), CASES)
def test_numbers_and_points(kind, shape, unit):
    intervals, unit = SHAPES[shape], np.array(UNITS[unit])
    make = KINDS[kind]
    P = make(intervals, unit)
    widths = [high - low for low, high in intervals]
    empty, bounded = is_empty(intervals), all(abs(w) < inf for w in widths)
    dimension = -1 if empty else sum(w > 0 for w in widths)
    assert P.is_empty() == empty and P.affine_dimension() == dimension
    assert P.is_bounded() == (bounded or empty)
    volume = 0.0 if dimension < 2 else float(np.prod([float(w) for w in widths])) * unit.prod()
    assert P.volume() == pytest.approx(volume, rel=1e-12)
    # Points.
    grid = np.array(list(itertools.product((-2, -1, 0.5, 2, 3), (-0.5, 0, 0.5, 1, 2))))
    inside = np.all(
        [(a <= x) & (x <= b) for x, (a, b) in zip(grid.T, intervals, strict=True)], axis=0
    )
    np.testing.assert_array_equal(P.contains(grid * unit), inside)
    assert [x * unit in P for x in grid] == inside.tolist()
    if empty:
        for what in (P.chebyshev, P.affine_hull, P.full_part, lambda: P.sample(3)):
            with pytest.raises(ValueError, match="empty"):
                what()
        with pytest.raises(ValueError, match="empty"):
            P.closest_point([0, 0])
    else:
        ends = np.array([[float(v) for v in pair] for pair in intervals]).T
        # Distances are of coordinates in one unit only; here of the point that is closest.
        closest = np.clip(grid, *ends) * unit
        for x, y in zip(grid * unit, closest, strict=True):
            alone = np.abs(x - y) > 0
            if alone.sum() <= 1:  # else units decide what is closest
                np.testing.assert_allclose(P.closest_point(x) / unit, y / unit, atol=1e-9)
                assert P.distance(x) == pytest.approx(np.linalg.norm(x - y), rel=1e-9, abs=1e-14)
    # Vertices and samples.
    if bounded or empty:
        corners = set() if empty else set(itertools.product(*intervals))
        V = P.vertices() / unit
        assert V.shape == (len(corners), 2)
        for corner in corners:
            assert np.abs(V - [float(v) for v in corner]).max(axis=1).min() < 1e-11
        if not empty:
            sample = P.sample(50)
            assert sample.shape == (50, 2)
            lower, upper = np.array([[float(v) for v in pair] for pair in intervals]).T
            assert np.all((sample / unit >= lower - 1e-9) & (sample / unit <= upper + 1e-9))
    else:
        for what in (P.vertices, lambda: P.sample(3)):
            with pytest.raises(ValueError, match="unbounded"):
                what()
    # Hulls.
    if not empty:
        E, e = P.affine_hull()
        assert E.shape == (2 - dimension, 2)
        flat = [i for i, w in enumerate(widths) if w == 0]
        np.testing.assert_allclose(E, np.eye(2)[flat] if len(flat) < 2 else E, atol=1e-12)
        if bounded:
            np.testing.assert_allclose(P.vertices() @ E.T, np.tile(e, (len(V), 1)), rtol=1e-9)
        part = P.full_part()
        assert part.dimension == dimension and (part.part is None) == (dimension == 0)
    # Comparisons.
    larger = make([(a - 1, b + 1) for a, b in intervals], unit)
    assert P <= larger and P == make(intervals, unit) and P == P.to_polytope()
    if dimension >= 0 and shape != "flat and unbounded":
        assert not larger <= P and P != larger
    # What is left of a larger set.
    if bounded and not empty:
        left = set_difference(larger, P)
        assert left.volume() == pytest.approx(larger.volume() - volume, rel=1e-9)
    assert set_difference(P, larger).is_empty()


def test_ellipsoids_by_closed_forms():
    """The ball of radius 2 about (1, 1, 0), and what makes other ellipsoids of it."""
    c = np.array([1.0, 1.0, 0.0])
    E = Ellipsoid(np.eye(3), 4.0, c)
    d = np.array([[1.0, 0, 0], [3, 4, 0], [0, 0, -2]])
    np.testing.assert_allclose(E.support(d), d @ c + 2 * np.linalg.norm(d, axis=1), rtol=1e-14)
    assert E.support(d[1]) == pytest.approx(17) and E.volume() == pytest.approx(32 / 3 * np.pi)
    np.testing.assert_array_equal(E.contains([[3, 1, 0], [3.01, 1, 0], [1, 1, 0]]), [1, 0, 1])
    assert c in E and [5, 5, 5] not in E and not E.is_empty() and E.is_bounded()
    assert E.affine_dimension() == 3
    assert E.bounding_box() == Box([-1, -1, -2], [3, 3, 2])
    assert E.chebyshev()[1] == pytest.approx(2) and E.distance([5, 4, 0]) == pytest.approx(3)
    np.testing.assert_allclose(E.closest_point([[5, 4, 0], c]), [[2.6, 2.2, 0], c], atol=1e-13)
    assert E + [1, 0, 0] == Ellipsoid(np.eye(3), 4.0, [2, 1, 0]) == E - [-1, 0, 0]
    assert -E == Ellipsoid(np.eye(3), 4.0, -c) and 2 * E == Ellipsoid(np.eye(3), 16.0, 2 * c)
    M = np.array([[1.0, 0, 0], [0, 2, 0]])
    image = M @ E
    np.testing.assert_allclose(image.support(d[:2, :2]), E.support(d[:2, :2] @ M), rtol=1e-13)
    assert E.project([2, 0]).volume() == pytest.approx(4 * np.pi)
    # A section at x_3 = 1: a disk of radius sqrt(3).
    section = E.slice({2: 1.0})
    assert section.volume() == pytest.approx(3 * np.pi) and section.contains([1 + 3**0.5 - 1e-9, 1])
    assert E @ np.diag([2.0, 2, 2]) == 0.5 * E
    sample = E.sample(4000, seed=3)
    assert E.contains(sample, 1e-12).all()
    # Of a ball, half of the points are within 2^(-1/3) of its radius.
    near = np.linalg.norm(sample - c, axis=1) < 2 * 0.5 ** (1 / 3)
    assert near.mean() == pytest.approx(0.5, abs=4 * 0.5 / 4000**0.5)
    inner, cube = 0.5 * (E - c) + c, Box(c - 1, c + 1)
    assert inner <= E and not E <= inner and cube <= E and not cube <= inner
    assert inner <= Box(c - 1, c + 1) and not E <= cube and E == E
    assert Polytope.from_points(c + 2 * np.eye(3)) <= E
    assert not Polytope.from_points(c + 2.1 * np.eye(3)) <= E
    touching = Ellipsoid(np.eye(3), 1.0, c + [1, 0, 0])
    assert touching <= E and not touching + [1e-6, 0, 0] <= E
    assert Box(-5 * np.ones(3), 5 * np.ones(3)) - E == Box([-4, -4, -3], [2, 2, 3])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda E: E + E, "minkowski_sum: of an Ellipsoid is none of the sets here"),
        (lambda E: Box([-1, -1], [1, 1]) + E, "other: is an Ellipsoid"),
        (lambda E: Zonotope([0, 0], np.eye(2)) + E, "other: is an Ellipsoid"),
        (lambda E: E - E, "pontryagin_difference: from an Ellipsoid"),
        (lambda E: E & E, "intersect: with an Ellipsoid"),
        (lambda E: Box([-1, -1], [1, 1]) & E, "other: Ellipsoid is no Box or Polytope"),
        (lambda E: np.ones((2, 2)) @ E, "M: has a rank below 2, so the image is flat"),
        (lambda E: E @ np.ones((2, 2)), "M: has a rank below 2, so the set is unbounded"),
        (lambda E: np.diag([1.0, 0.0]) @ E, "M: has a rank below 2, so the image is flat"),
        (lambda E: E @ np.diag([1.0, 0.0]), "M: has a rank below 2, so the set is unbounded"),
        (lambda E: E.slice({0: 3.0}), "Ellipsoid: is empty there"),
        (lambda E: E.slice({0: 0.0, 1: 0.0}), "values: fixes every coordinate"),
        (
            lambda E: E.slice({2: 0.0}),
            r"values: \[2\] are not distinct numbers in 0..1. Write it as {axis: v",
        ),
        (lambda E: E.project([2]), "axes: .* are not distinct numbers in 0..1. Name"),
        (lambda E: Ellipsoid(np.diag([1.0, 0]), 1.0).volume(), "P: is not positive definite"),
        (lambda E: E * [1, 2], "factor: .* is not a number"),
        (lambda E: E + "x", "by: "),
        (lambda E: E.is_subset([1]), "other: list is no set"),
        (lambda E: Box([0], [1]).sample(-1), "count: -1"),
        (lambda E: [1, 2, 3] in E, r"x: shape \(3,\) where \(2,\)"),
    ],
)
def test_what_is_refused_says_why(call, message):
    with pytest.raises(ValueError, match=message):
        call(Ellipsoid(np.eye(2), 1.0))


@pytest.mark.parametrize(
    "broken",
    [
        Polytope([[1.0, 0.0]], [np.nan]),
        Polytope([[np.inf, 0.0]], [1.0]),
        Box([0.0, np.nan], [1.0, 1.0]),
        Zonotope([np.nan, 0.0], np.eye(2)),
        Ellipsoid([[1.0, 2.0], [2.0, 1.0]], 1.0),
        Ellipsoid([[1.0, 0.5], [0.0, 1.0]], 1.0),
        Ellipsoid(np.eye(2), -1.0),
    ],
)
def test_what_is_no_set_answers_no_question(broken):
    for question in (broken.contains, broken.support):
        with pytest.raises(ValueError, match=r"\.(H|h|lower|center|P|level): "):
            question([1.0, 0.0])


def test_reduce_is_there_for_every_set():
    box = Box([-1, -1], [1, 1])
    for given in (box, box.to_zonotope(), Ellipsoid(np.eye(2), 1.0)):
        assert given.reduce() is given


def test_sets_compare_with_sets_only_and_have_no_hash():
    square = Box([-1, -1], [1, 1])
    assert square != 3 and square != "square" and square != np.eye(2) and square is not None
    assert square != Box([-1], [1])
    assert square == square.to_polytope() == Zonotope([0, 0], np.eye(2)) == -square
    assert square == square + [1e-12, 0] and square != square + [1e-6, 0]
    with pytest.raises(
        TypeError, match=r"PolytopeUnion\(\(P.to_polytope\(\), Q.to_polytope\(\)\)\)"
    ):
        square | square
    parts = (square.to_polytope(), (square + [3, 0]).to_polytope())  # the cure
    assert PolytopeUnion(parts).volume() == pytest.approx(8)
    with pytest.raises(TypeError, match="unhashable"):
        hash(square)


@pytest.mark.parametrize("seed", [1, 358, 679])
def test_flat_hulls_in_other_units_against_their_points(seed):
    """Hulls of points in planes of any dimension: all truths are maxima over points. (In two of
    these rounding once made rows of 1e-21, and an image lost digits.)"""
    rng = np.random.default_rng(seed)
    for n, r in ((2, 1), (3, 1), (3, 2), (4, 2)):
        unit = 10.0 ** rng.uniform(-6, 6, n)
        make = lambda r, n=n, unit=unit: (
            unit * (rng.normal(size=n) + rng.normal(size=(r + 3, r)) @ rng.normal(size=(r, n)))
        )
        V, W = make(r), make(1)
        P, Q = Polytope.from_points(V), Polytope.from_points(W)
        assert P.affine_dimension() == r and P.reduce() == P
        M = rng.normal(size=(3, 2)) @ rng.normal(size=(2, n)) / unit
        for found, points in (
            (P + Q, (V[:, None] + W).reshape(-1, n)),
            (M @ P, V @ M.T),
            (P.project([n - 1, 0]), V[:, [n - 1, 0]]),
        ):
            size = np.abs(points).max(axis=0)
            d = rng.normal(size=(10, points.shape[1])) / size
            np.testing.assert_allclose(found.support(d), (d @ points.T).max(axis=1), atol=1e-9)


def test_of_an_empty_set_all_that_is_a_set_is_empty():
    """However it is written; so loops of reachability may go on after their set has vanished."""
    box, one = Box([-1, -1], [1, 1]), np.ones(2)
    for empty in (Polytope.empty(2), Box([1, 1], [0, 0]), box & Polytope([[1, 0]], [-3])):
        for found in (
            empty - box, empty + box, box + empty, empty & box, np.eye(2) @ empty,
            empty @ np.eye(2),
            -empty, 2 * empty, empty / 2, empty + one, empty - one, one - empty,
            empty - (box & box), empty - Zonotope([0, 0], np.eye(2)),
        ):  # fmt: skip
            assert found.is_empty() and found.volume() == 0
    X, U = Polytope([[1, 0], [-1, 0], [0, 1], [0, -1]], [2, 1, 3, 0.5]), Box([-0.1], [0.1])
    A, B, Y = np.array([[1, 0.5], [0, 1]]), np.array([[0], [1.0]]), X
    for _ in range(3):
        Y = ((Y - box) + (-B) @ U) @ A & X
    assert Y.is_empty()


def test_sets_are_divided_and_mirrored_at_points():
    P = Polytope([[1, 0], [-1, 0], [0, 1], [0, -1]], [2, 1, 3, 0.5])
    for found, lower, upper in (
        (P / 2, [-0.5, -0.25], [1, 1.5]), ([1, 2] - P, [-1, -1], [2, 2.5]),
        (np.array([1.0, 2]) - P.bounding_box(), [-1, -1], [2, 2.5]), (P / -0.5, [-4, -6], [2, 1]),
    ):  # fmt: skip
        assert found == Box(lower, upper)
