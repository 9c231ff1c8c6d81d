"""Feasible-set maps against sets that are known exactly: closed forms, polygons, a product."""

from fractions import Fraction

import exact
import numpy as np
import problems
import pytest

import jaxmpc as jm
from jaxmpc.qp.status import Status


def assert_right(fmap, inside, tie, allow=1e-9):
    """No label is wrong, ties included, and none is open farther than `allow` from the boundary."""
    np.testing.assert_array_equal(fmap.label[fmap.label != 0] == 1, inside[fmap.label != 0])
    assert np.all(tie[fmap.label == 0] <= allow)


# (settings, radius): |x_0| ≤ radius, by hand.
N, X, U = 4, 1.0, 0.3
SCALAR = {
    "k = 1..N": (dict(terminal=X, constrain_initial=False), X + U),
    "k = 0..N": (dict(terminal=X), X),
    "k = N": (dict(x_max=None, terminal=X), X + N * U),
    "k = 0..N-1": (dict(), X),
    "k = 1..N-1": (dict(constrain_initial=False), X + U),
    "x_N = 0": (dict(terminal=0.0), X),
    "|x_N| ≤ 1/4": (dict(terminal=0.25), X),
    "x_N = 0, weak input": (dict(terminal=0.0, u_max=0.1), N * 0.1),
    "x_N = 0, states free": (dict(terminal=0.0, x_max=None), N * U),
    "strong input": (dict(terminal=X, u_max=2.0, constrain_initial=False), X + 2),
    "unstable": (dict(a=2.0, x_max=5.0, u_max=1.0, terminal=5.0), 1 + 4 * 2.0**-N),
    "unstable, N = 20": (dict(a=2.0, x_max=5.0, u_max=1.0, terminal=5.0, horizon=20),
                         1 + 4 * 2.0**-20),
    "flip": (dict(a=-2.0, x_max=5.0, u_max=1.0, terminal=5.0), 1 + 4 * 2.0**-N),
}  # fmt: skip


@pytest.mark.parametrize("name", SCALAR)
@pytest.mark.first(1)
def test_scalar_closed_forms(name):
    settings, radius = SCALAR[name]
    steps = 10.0 ** -np.arange(1, 9)
    radii = np.concatenate([radius * (1 + steps), radius * (1 - steps)])
    points = np.concatenate([radii, -radii, np.linspace(-2 * radius, 2 * radius, 51)])[:, None]
    mpc = problems.scalar(**{"horizon": N, **settings})
    fmap = jm.map_feasible_set(mpc, points, chunk=64)
    inside, tie = np.abs(points[:, 0]) <= radius, np.abs(np.abs(points[:, 0]) - radius)
    assert_right(fmap, inside, tie)
    assert fmap.outer().support(np.ones(1)) == pytest.approx(radius, rel=1e-12)


FAST = ("joint, terminal O_inf",)


@pytest.fixture(
    scope="module",
    params=[
        name if name in FAST else pytest.param(name, marks=pytest.mark.slow)
        for name in problems.PLANAR
    ],
)
def planar(request):
    """(mpc, exact polygon, refined map of a grid that reaches outside)."""
    mpc = problems.PLANAR[request.param]()
    polygon = exact.feasible_polygon(mpc)
    corners = np.array([[float(v) for v in p] for p in polygon.vertices])
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = 0.15 * (high - low)
    points = jm.grid(low - margin, high + margin, (24, 24))
    # Points near the vertices, and the vertices themselves: ties up to rounding.
    middle = corners.mean(axis=0)
    near = [middle + (corners - middle) * (1 + s) for s in (1e-3, -1e-3, 1e-6, -1e-6, 0.0)]
    points = np.concatenate([points, *near])
    return mpc, polygon, jm.map_feasible_set(mpc, points, chunk=64).refine(1e-7)


def test_published_areas():
    """The exact checker itself, against areas known in closed form."""
    area = lambda mpc: float(exact.feasible_polygon(mpc).area)
    assert area(problems.double_integrator()) == problems.C_INF_DOUBLE_INTEGRATOR
    assert exact.feasible_polygon(problems.double_integrator()).area == Fraction(1375, 24)
    for u_max, value in problems.AREA_LECTURE.items():
        assert area(problems.lecture(u_max)) == pytest.approx(value, rel=1e-14)
    assert area(problems.joint()) == pytest.approx(problems.AREA_JOINT, rel=1e-14)
    assert area(problems.joint_o_inf()) == pytest.approx(problems.AREA_JOINT_O_INF, rel=1e-12)


@pytest.mark.long
def test_labels(planar):
    _, polygon, fmap = planar
    assert_right(fmap, polygon.contains(fmap.x0s), polygon.distance(fmap.x0s))
    assert fmap.counts()["feasible"] > 50 and fmap.counts()["infeasible"] > 50


@pytest.mark.long
def test_plans_in_rationals(planar):
    mpc, _, fmap = planar
    found = np.flatnonzero(fmap.label == 1)
    assert np.isnan(fmap.labels.plan[fmap.label != 1]).all()
    chosen = np.random.default_rng(0).choice(found, 25, replace=False)
    near = np.flatnonzero((fmap.label == 1) & (np.arange(len(fmap.label)) >= 576))
    for i in np.concatenate([chosen, near]):
        assert exact.keeps_all_rows(mpc, fmap.x0s[i], fmap.labels.plan[i])


def test_cuts_in_rationals(planar):
    _, polygon, fmap = planar
    assert np.isnan(fmap.labels.cut_offset[fmap.label != -1]).all()
    for i in np.flatnonzero(fmap.label == -1):
        a, b = fmap.labels.cut_normal[i], Fraction(float(fmap.labels.cut_offset[i]))
        assert polygon.support(a) <= b
        assert exact.dot(exact.rational(a), exact.rational(fmap.x0s[i])) > b


def test_what_refine_adds_in_rationals(planar):
    _, polygon, fmap = planar
    assert polygon.contains(fmap.bound_point).all()
    for a, b in zip(fmap.bound_normal, fmap.bound_offset, strict=True):
        assert polygon.support(a) <= Fraction(float(b))


def test_volume_and_polytopes(planar):
    _, polygon, fmap = planar
    low, high = fmap.volume_bounds()
    assert low <= polygon.area <= high
    assert high - low <= 1e-6 * high
    outer, inner = fmap.outer(), fmap.inner()
    assert len(outer.vertices()) == len(polygon.vertices)
    hull = exact.hull(
        [tuple(exact.rational(p)) for p in [*fmap.x0s[fmap.label == 1], *fmap.bound_point]]
    )
    assert low <= hull.area
    size = max(abs(float(v)) for p in polygon.vertices for v in p)
    for a in np.random.default_rng(1).standard_normal((20, 2)):
        assert hull.support(a) <= polygon.support(a)
        # Points within 1e-10 of the set's size are one vertex of a polytope.
        exactly, allowed = float(polygon.support(a)), 1e-10 * size * np.abs(a).sum()
        assert (inner.vertices() @ a).max() <= exactly + allowed
        assert (outer.vertices() @ a).max() >= exactly - allowed


def test_boundary(planar):
    mpc, polygon, _ = planar
    found = jm.feasible.boundary(mpc, 40)
    assert polygon.contains(found.points).all()
    # A roll-out of a plant that doubles at each step needs a thousand times the margin.
    growth = np.linalg.norm(np.linalg.matrix_power(mpc.system.A, mpc.horizon), 2)
    np.testing.assert_array_less(found.outer - found.inner, 1e-9 if growth < 100 else 1e-8)
    exactly = exits(polygon, found.center, found.directions)
    assert np.all(found.inner <= exactly * (1 + 1e-13))
    assert np.all(found.outer >= exactly * (1 - 1e-13))
    for a, b in zip(found.normals, found.offsets, strict=True):
        support = polygon.support(a)
        assert support <= Fraction(float(b))
        assert float(Fraction(float(b)) - support) <= 1e-9 * np.linalg.norm(a)


def exits(polygon, center, directions):
    """Where the rays leave the polygon."""
    a, b = polygon.rows()
    with np.errstate(divide="ignore"):
        t = (b - a @ center) / (directions @ a.T)
    return np.where(directions @ a.T > 0, t, np.inf).min(axis=1)


def near_boundary(polygon, count):
    """Points within 1e-2 .. 1e-6 (relative, along rays from the origin) on both sides."""
    rng = np.random.default_rng(7)
    angle = rng.uniform(0, 2 * np.pi, count)
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    shift = rng.choice([-1, 1], count) * 10 ** -rng.choice([2.0, 3, 4, 5, 6], count)
    return directions * (exits(polygon, np.zeros(2), directions) * (1 + shift))[:, None], shift < 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "count", [1000, pytest.param(12000, marks=pytest.mark.slow)], ids=["1,000", "12,000"]
)
@pytest.mark.parametrize("name", ["joint", "joint, terminal O_inf"])
@pytest.mark.first(1)
def test_nothing_wrong_and_nothing_open_near_the_boundary(name, count):
    mpc = problems.PLANAR[name]()
    polygon = exact.feasible_polygon(mpc)
    points, inside = near_boundary(polygon, count)
    fmap = jm.map_feasible_set(mpc, points, chunk=1024)
    np.testing.assert_array_equal(fmap.label, np.where(inside, 1, -1))
    np.testing.assert_array_equal(polygon.contains(points), inside)
    chosen = np.random.default_rng(0).choice(count, 30, replace=False)
    for i in chosen[fmap.label[chosen] == 1]:
        assert exact.keeps_all_rows(mpc, points[i], fmap.labels.plan[i])
    cuts = np.flatnonzero(fmap.label == -1)
    for i in np.random.default_rng(1).choice(cuts, 200, replace=False):
        assert polygon.support(fmap.labels.cut_normal[i]) <= Fraction(
            float(fmap.labels.cut_offset[i])
        )


@pytest.fixture(scope="module")
def blocks():
    """Exact sets of the two joints that the 4-D problem hides."""
    return [exact.feasible_polygon(problems.product_block(i)) for i in (0, 1)]


@pytest.fixture(scope="module")
def product_map(blocks):
    """Map of 600 points near the boundary of the 4-D set."""
    points, _ = near_product(blocks, 600)
    return jm.map_feasible_set(problems.hidden_product(), points, chunk=1024)


def in_product(blocks, points):
    v = points @ problems.T_INVERSE.T
    return blocks[0].contains(v[:, :2]) & blocks[1].contains(v[:, 2:])


def corners(blocks):
    """All vertices (280, 4) of the feasible set."""
    lists = [np.array([[float(c) for c in p] for p in b.vertices]) for b in blocks]
    both = np.array([np.concatenate([p, q]) for p in lists[0] for q in lists[1]])
    return both @ np.linalg.inv(problems.T_INVERSE).T


def product_facets(blocks):
    """a (34, 4), b (34,)."""
    parts = []
    for i, block in enumerate(blocks):
        a, b = block.rows()
        parts.append((a @ problems.T_INVERSE[2 * i : 2 * i + 2], b))
    return tuple(np.concatenate(p) for p in zip(*parts, strict=True))


def near_product(blocks, count):
    """Points at relative distances 1e-1 .. 1e-5 on both sides along rays."""
    rng = np.random.default_rng(3)
    directions = rng.standard_normal((count, 4))
    a, b = product_facets(blocks)
    reach = 1 / (directions @ a.T / b).max(axis=1)
    shift = rng.choice([-1, 1], count) * 10 ** rng.uniform(-5, -1, count)
    return directions * (reach * (1 + shift))[:, None], shift < 0


class TestHiddenProduct:
    """Two joints behind a change of coordinates with determinant 1: x = T (joint 1, joint 2)."""

    def test_the_facts(self, blocks):
        assert len(corners(blocks)) == 280 and len(product_facets(blocks)[1]) == 34
        assert float(blocks[0].area * blocks[1].area) == pytest.approx(problems.VOLUME_PRODUCT)

    @pytest.mark.slow
    def test_labels(self, blocks, product_map):
        points, inside = near_product(blocks, 600)
        np.testing.assert_array_equal(product_map.label, np.where(inside, 1, -1))
        np.testing.assert_array_equal(in_product(blocks, points), inside)

    @pytest.mark.slow
    def test_proofs(self, blocks, product_map):
        mpc = problems.hidden_product()
        for i in np.flatnonzero(product_map.label == 1)[:15]:
            assert exact.keeps_all_rows(mpc, product_map.x0s[i], product_map.labels.plan[i])
        out = product_map.label == -1
        a, b = product_map.labels.cut_normal[out], product_map.labels.cut_offset[out]
        support = (a @ corners(blocks).T).max(axis=1)
        # The float data is a product only up to its own rounding.
        assert np.all(support <= b + 1e-12 * np.linalg.norm(a, axis=1))

    @pytest.mark.slow
    def test_volume(self, blocks, product_map):
        refined = product_map.refine(1e-6)
        low, high = refined.volume_bounds()
        assert low <= problems.VOLUME_PRODUCT * (1 + 1e-12)
        assert high >= problems.VOLUME_PRODUCT * (1 - 1e-12)
        assert high - low <= 1e-6 * high
        assert len(refined.outer().h) == 34

    @pytest.mark.slow
    def test_boundary(self, blocks):
        found = jm.feasible.boundary(problems.hidden_product(), 24)
        a, b = product_facets(blocks)
        exactly = 1 / (found.directions @ a.T / (b - a @ found.center)).max(axis=1)
        assert np.all(found.inner <= exactly + 1e-12) and np.all(found.outer >= exactly - 1e-12)
        np.testing.assert_array_less(found.outer - found.inner, 1e-9)

    @pytest.mark.long
    @pytest.mark.parametrize("axes", [(0, 3), (3, 2), (0, 1, 2)])
    @pytest.mark.first(1)
    def test_slice(self, blocks, axes):
        fixed = np.array([0.2, -0.1, 0.15, 0.4])
        rng = np.random.default_rng(2)
        theta = rng.uniform(-3, 3, (300, len(axes)))
        whole = np.tile(fixed, (300, 1))
        whole[:, axes] = theta
        fmap = jm.map_feasible_set(
            problems.hidden_product(), theta, axes=axes, fixed=fixed, chunk=64
        )
        np.testing.assert_array_equal(fmap.label, np.where(in_product(blocks, whole), 1, -1))
        for i in np.flatnonzero(fmap.label == 1)[:5]:
            assert exact.keeps_all_rows(problems.hidden_product(), whole[i], fmap.labels.plan[i])

    @pytest.mark.slow
    @pytest.mark.parametrize("axes", [(0, 3), (1, 2)])
    def test_projection(self, blocks, axes):
        """Exact projection: the hull of the projected vertices."""
        shadow = exact.hull([tuple(exact.rational(p)) for p in corners(blocks)[:, list(axes)]])
        rng = np.random.default_rng(4)
        points = rng.uniform(-6, 6, (300, 2))
        fmap = jm.map_feasible_set(problems.hidden_product(), points, axes=axes)
        assert_right(fmap, shadow.contains(points), shadow.distance(points))
        refined = fmap.refine(1e-6)
        low, high = refined.volume_bounds()
        assert low <= float(shadow.area) * (1 + 1e-12) and high >= float(shadow.area) * (1 - 1e-12)
        assert high - low <= 1e-6 * high


def test_terminal_section_of_a_slice():
    """Slices cut the terminal set too: the polygon of the first joint for joint 2 at rest."""
    fmap = jm.map_feasible_set(
        problems.hidden_product(), np.zeros((1, 2)), axes=(0, 3), fixed=np.zeros(4)
    )
    section = fmap.terminal_section()
    assert section.contains(np.zeros(2)) and not section.contains(np.array([2.0, 0.0]))
    assert fmap.status[0] == Status.SOLVED


@pytest.mark.slow
def test_unstable_long_horizon():
    """Predictions grow by 2^30 and rounding with them: labels stay right, and none is open."""
    mpc = problems.unstable(30)
    polygon = exact.feasible_polygon(mpc)
    points, inside = near_boundary(polygon, 400)
    fmap = jm.map_feasible_set(mpc, points, chunk=512)
    assert_right(fmap, inside, polygon.distance(points), allow=0)
    for i in np.flatnonzero(fmap.label == 1)[:10]:
        assert exact.keeps_all_rows(mpc, points[i], fmap.labels.plan[i])
    for i in np.flatnonzero(fmap.label == -1):
        assert polygon.support(fmap.labels.cut_normal[i]) <= Fraction(
            float(fmap.labels.cut_offset[i])
        )
