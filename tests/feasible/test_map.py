"""Maps, proofs and boundaries: bad points, shapes, empty sets, repeatability, compile counts."""

import warnings
from dataclasses import replace
from fractions import Fraction

import exact
import jax
import numpy as np
import problems
import pytest
from jax import enable_x64

import jaxmpc as jm
from jaxmpc.feasible import candidate_search
from jaxmpc.qp.status import Status


@pytest.fixture(scope="module")
def polygon():
    return exact.feasible_polygon(problems.lecture())


@pytest.fixture(scope="module")
def points():
    """As many as fill a program of the smallest size."""
    return jm.grid([-1.2, -1.2], [1.2, 1.2], (8, 8))


@pytest.fixture(scope="module")
def fmap(points):
    return jm.map_feasible_set(problems.lecture(), points)


EMPTY = replace(problems.lecture(), terminal_set=jm.Box(np.array([5.0, 5.0]), np.array([6.0, 6.0])))


class TestGrid:
    def test_ends_and_order(self):
        expected = [[0, 5], [0, 6], [0, 7], [1, 5], [1, 6], [1, 7]]
        np.testing.assert_array_equal(jm.grid([0, 5], [1, 7], (2, 3)), expected)

    def test_one_dimension(self):
        np.testing.assert_array_equal(jm.grid(0, 1, 3), [[0], [0.5], [1]])

    @pytest.mark.parametrize(
        "arguments",
        [([0, 0], [1], (2, 2)), ([0], [1], (2, 2)), ([1], [0], 2), ([0], [1], 0),
         ([0], [np.inf], 2), ([np.nan], [1], 2)],
    )  # fmt: skip
    def test_errors(self, arguments):
        with pytest.raises(ValueError, match="grid"):
            jm.grid(*arguments)


class TestBadPoints:
    def test_not_finite(self, points, fmap):
        """NaN and infinity get their own status; every other label stays."""
        spoiled = points.copy()
        spoiled[3, 0], spoiled[60, 1], spoiled[61] = np.nan, np.inf, -np.inf
        got = jm.map_feasible_set(problems.lecture(), spoiled)
        bad = np.isin(np.arange(len(points)), [3, 60, 61])
        assert np.all(got.status[bad] == Status.NON_FINITE) and np.all(got.label[bad] == 0)
        assert np.isnan(got.labels.plan[bad]).all() and np.isnan(got.labels.cut_offset[bad]).all()
        np.testing.assert_array_equal(got.label[~bad], fmap.label[~bad])
        np.testing.assert_array_equal(got.labels.plan[~bad], fmap.labels.plan[~bad])
        assert got.counts()["not finite"] == 3

    def test_all_bad(self):
        got = jm.map_feasible_set(problems.lecture(), np.full((3, 2), np.nan))
        assert got.counts()["not finite"] == 3

    @pytest.mark.parametrize("huge", [1e12, 1e30])
    def test_far_away(self, points, fmap, huge):
        far = points.copy()
        far[0], far[5] = huge, [-huge, huge]
        got = jm.map_feasible_set(problems.lecture(), far)
        assert np.all(got.label[[0, 5]] == -1)
        rest = ~np.isin(np.arange(len(points)), [0, 5])
        np.testing.assert_array_equal(got.label[rest], fmap.label[rest])

    def test_largest_numbers(self, points, fmap):
        """1e300 may stay undecided, but warns of nothing and moves nobody."""
        far = points.copy()
        far[0] = [1e300, -1e300]
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            got = jm.map_feasible_set(problems.lecture(), far)
        assert got.label[0] <= 0
        np.testing.assert_array_equal(got.label[1:], fmap.label[1:])

    @pytest.mark.parametrize("name", ["k = 1..N", "k = N"])
    @pytest.mark.first(1)
    def test_far_away_where_nothing_limits_the_initial_state(self, name):
        """One huge point must not cost its neighbours their proofs."""
        settings = dict(terminal=1.0, constrain_initial=False)
        radius = 1.3
        if name == "k = N":
            settings, radius = dict(terminal=1.0, x_max=None), 2.2
        points = radius * np.array([[1 + 1e-2], [1 + 1e-6], [1 - 1e-6], [-1 - 1e-6], [1e12]])
        got = jm.map_feasible_set(problems.scalar(horizon=4, **settings), points)
        np.testing.assert_array_equal(got.label, [-1, -1, 1, -1, -1])

    @pytest.mark.slow
    def test_cuts_hold_beyond_the_map(self):
        """A cut is valid on the whole set, mapped or not."""
        mpc = replace(problems.lecture(), constrain_initial=False)
        polygon = exact.feasible_polygon(mpc)
        got = jm.map_feasible_set(mpc, np.array([[0.0, 0.8], [0.1, -0.9], [1.4, 0.3], [0.9, 0.9]]))
        for i in np.flatnonzero(got.label == -1):
            b = Fraction(float(got.labels.cut_offset[i]))
            assert polygon.support(got.labels.cut_normal[i]) <= b

    @pytest.mark.parametrize("shape", [(2,), (3, 3), (3, 1), (2, 2, 2)])
    def test_wrong_shape(self, shape):
        with pytest.raises(ValueError, match="x0s"):
            jm.map_feasible_set(problems.lecture(), np.zeros(shape))

    def test_no_points(self):
        got = jm.map_feasible_set(problems.lecture(), np.zeros((0, 2)))
        assert got.label.shape == (0,)
        assert got.volume_bounds() == (0.0, np.inf)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (dict(iterations=0), "iterations"), (dict(chunk=0), "chunk"),
        (dict(dtype="int32"), "dtype"), (dict(dtype="float16"), "dtype"),
        (dict(axes=(0, 2)), "axes"), (dict(axes=(0, 0)), "axes"),
        (dict(axes=()), "axes"), (dict(axes=(-1, 0)), "axes"),
        (dict(axes=(0,), fixed=np.zeros(3)), "fixed"),
        (dict(axes=(0,), fixed=np.array([0.0, np.nan])), "fixed"),
    ],
)  # fmt: skip
def test_bad_settings_raise(settings, words):
    with pytest.raises(ValueError, match=words):
        jm.map_feasible_set(problems.lecture(), np.zeros((1, 2)), **settings)


class TestEmptySet:
    def test_labels(self, points):
        got = jm.map_feasible_set(EMPTY, points)
        assert np.all(got.label == -1)
        low, high = got.volume_bounds()
        assert low == 0
        with pytest.raises(ValueError):
            got.inner()
        refined = got.refine()
        assert refined.volume_bounds()[0] == 0

    def test_volume_is_zero(self, points):
        """The half-spaces prove the set empty, so its volume is known."""
        assert jm.map_feasible_set(EMPTY, points).volume_bounds() == (0.0, 0.0)

    def test_boundary(self):
        with pytest.raises(ValueError, match="empty"):
            jm.feasible.boundary(EMPTY, 4)


class TestIndependenceOf:
    """What must not change a label."""

    def test_chunks(self, points, fmap):
        for chunk in (40, 90):
            got = jm.map_feasible_set(problems.lecture(), points, chunk=chunk)
            np.testing.assert_array_equal(got.label, fmap.label)
            np.testing.assert_array_equal(got.status, fmap.status)

    def test_run(self, points, fmap):
        again = jm.map_feasible_set(problems.lecture(), points)
        for name in ("label", "status", "plan", "cut_normal", "cut_offset"):
            np.testing.assert_array_equal(getattr(again.labels, name), getattr(fmap.labels, name))

    def test_order(self, points, fmap):
        order = np.random.default_rng(0).permutation(len(points))
        got = jm.map_feasible_set(problems.lecture(), points[order])
        np.testing.assert_array_equal(got.label, fmap.label[order])

    @pytest.mark.parametrize(
        "dtype, iterations",
        [
            ("float32", 1),
            ("float64", 300),
            ("float32", 300),
            ("float64", 1),
        ],
    )
    @pytest.mark.slow
    def test_iterates(self, points, fmap, polygon, iterations, dtype):
        got = jm.map_feasible_set(problems.lecture(), points, iterations=iterations, dtype=dtype)
        np.testing.assert_array_equal(got.label, fmap.label)
        np.testing.assert_array_equal(got.label == 1, polygon.contains(points))

    def test_mode(self, points, fmap):
        with enable_x64(True):
            got = jm.map_feasible_set(problems.lecture(), points)
        np.testing.assert_array_equal(got.label, fmap.label)
        assert not jax.config.jax_enable_x64

    @pytest.mark.slow
    def test_prestabilising(self):
        mpc = problems.unstable(8)
        polygon = exact.feasible_polygon(mpc)
        points = jm.grid([-2, -5], [2, 5], (15, 15))
        for choice in (False, None, np.array([[-1.5, -0.8]])):
            got = jm.map_feasible_set(replace(mpc, prestabilise=choice), points)
            np.testing.assert_array_equal(got.label, np.where(polygon.contains(points), 1, -1))

    def test_cost(self, points, fmap):
        other = replace(problems.lecture(), Q=np.zeros((2, 2)), R=1e-3 * np.eye(1))
        np.testing.assert_array_equal(jm.map_feasible_set(other, points).label, fmap.label)


@pytest.mark.slow
def test_compiles_once_for_all_chunks():
    """One program of each stage, whatever the number of chunks."""
    stages = (
        candidate_search.compiled_admm(7, np.dtype(np.float32), None),
        candidate_search.compiled_newton(64, None),
    )
    before = [len(stage.programs) for stage in stages]
    points = np.random.default_rng(0).uniform(-1.2, 1.2, (333, 2))
    got = jm.map_feasible_set(problems.lecture(), points, chunk=50, iterations=7)
    assert np.all(got.label != 0)
    more = [len(stage.programs) - k for stage, k in zip(stages, before, strict=True)]
    assert more[0] == 1 and more[1] <= 1


@pytest.mark.slow
def test_proofs_are_copied_when_asked_for(points, fmap):
    """And are the same rows whichever stage of the pipeline found them."""
    labels = jm.map_feasible_set(problems.lecture(), points, iterations=1, chunk=64).labels
    np.testing.assert_array_equal(labels.label, fmap.label)
    inside, outside = labels.label == 1, labels.label == -1
    np.testing.assert_array_equal(np.isfinite(labels.plan).all(axis=(1, 2)), inside)
    np.testing.assert_array_equal(labels.start[inside], points[inside])
    np.testing.assert_array_equal(np.isfinite(labels.cut_normal).all(axis=1), outside)
    beyond = np.sum(labels.cut_normal * points, axis=1) - labels.cut_offset
    assert np.all(beyond[outside] > 0)
    assert np.array_equal(labels.rows(slice(5)).plan, labels.plan[:5], equal_nan=True)


class TestMapObject:
    def test_names_and_counts(self, fmap):
        assert fmap.axis_names == ("x1", "x2")
        counts = fmap.counts()
        assert sum(counts.values()) == len(fmap.label)

    def test_refine_from_nothing(self, polygon):
        got = jm.map_feasible_set(problems.lecture(), np.zeros((0, 2)), gap=1e-8)
        low, high = got.volume_bounds()
        assert low <= polygon.area <= high and high - low <= 1e-7 * high

    def test_inner_within_outer(self, fmap, polygon):
        outer = fmap.outer()
        for vertex in fmap.inner().vertices():
            assert outer.contains(vertex, 1e-6)
        assert fmap.volume_bounds()[0] <= polygon.area <= fmap.volume_bounds()[1]

    def test_to_xarray(self, fmap):
        data = fmap.to_xarray()
        np.testing.assert_array_equal(data["label"], fmap.label)
        assert data["plan"].dims == ("sample", "time", "input")
        assert list(data["state"].values) == list(fmap.axis_names)

    @pytest.mark.slow
    def test_terminal_section(self, fmap):
        section = fmap.terminal_section()
        assert section.volume() == pytest.approx(4.0)
        nothing = jm.map_feasible_set(replace(problems.lecture(), terminal_set=None), [[0.0, 0.0]])
        assert nothing.terminal_section() is None


@pytest.mark.slow
@pytest.mark.parametrize("width", [0.1, 0.01])
def test_refine_bounds_thin_tilted_sets(width):
    c, s = np.cos(0.7), np.sin(0.7)
    H = np.array([[c, s], [-s, c], [-c, -s], [s, -c]])
    mpc = jm.MPC(
        jm.LinearSystem(np.eye(2) / 2, np.eye(2)), np.eye(2), np.eye(2), 2,
        states=jm.Polytope(H, np.array([0.5, width / 2, 0.5, width / 2])),
        inputs=problems.symmetric(1.0, 1.0),
    )  # fmt: skip
    low, high = jm.map_feasible_set(mpc, np.zeros((1, 2))).refine().volume_bounds()
    assert low <= width * (1 + 1e-12) and width * (1 - 1e-12) <= high
    assert high - low <= 1e-6 * width


@pytest.mark.slow
def test_slice_through_a_broken_limit_is_infeasible_everywhere():
    mpc = problems.hidden_product(3)
    box = replace(mpc, states=problems.symmetric(1.5, 2.0, 1.0, 1.5))
    points = jm.grid([-1, -1], [1, 1], (3, 3))
    fmap = jm.map_feasible_set(box, points, axes=(0, 1), fixed=np.array([0, 0, 5.0, 0]))
    assert (fmap.label == -1).all()
    assert fmap.volume_bounds()[0] == 0


@pytest.mark.slow
def test_projection_keeps_the_state_it_starts_from():
    mpc = problems.hidden_product(3)
    fmap = jm.map_feasible_set(mpc, jm.grid([-1, -1], [1, 1], (5, 5)), axes=(0, 3))
    feasible = fmap.label == 1
    starts = fmap.labels.start
    assert feasible.any()
    np.testing.assert_array_equal(starts[feasible][:, [0, 3]], fmap.x0s[feasible])
    H, h = np.asarray(mpc.states.H, float), np.asarray(mpc.states.h, float)
    assert (starts[feasible] @ H.T <= h).all()
    assert np.isnan(starts[~feasible]).all()


@pytest.mark.slow
def test_undecided_points_are_labelled_by_the_facets_of_refine():
    mpc = problems.joint(6)
    fmap = jm.map_feasible_set(mpc, np.array([[1.49, 1.9], [0.0, 0.0]]))
    label, status = fmap.labels.label.copy(), fmap.labels.status.copy()
    label[0], status[0] = 0, jm.Status.ITERATION_LIMIT
    forgot = replace(fmap, labels=replace(fmap.labels, label=label, status=status))
    again = forgot.refine()
    assert again.label.tolist() == [-1, 1]
    assert again.labels.cut_normal[0] @ fmap.x0s[0] > again.labels.cut_offset[0]


def test_second_call_compiles_nothing():
    mpc, points = problems.lecture(), np.zeros((7, 2))
    jm.map_feasible_set(mpc, points)
    assert jm.map_feasible_set(mpc, points).labels.compile_seconds == 0
