"""Limits on one side, and none: every point is decided, against sets known exactly.

A bound of 1e9, 1e12 or 1e20 stands for none as well as infinity does, and must change no label.
"""

from dataclasses import replace
from fractions import Fraction

import exact
import jax
import numpy as np
import problems
import pytest
from jax import enable_x64
from scipy.optimize import linprog

import jaxmpc as jm
from jaxmpc.feasible import proofs
from jaxmpc.feasible.hard_constraints import exact_data, hard_blocks, make_view
from jaxmpc.feasible.map import FeasibleSetMap
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.recursion.proofs import settle_claims

NONE = (1e20, np.inf, 1e9, 1e12)


def slow(*values):
    """Parameters of tests that are not run by default."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


def ceiling(none=np.inf, horizon=5, **settings) -> jm.MPC:
    """x⁺ = x + u, x ≤ 1, |u| ≤ 1: the feasible set is x_0 ≤ 1."""
    return jm.MPC(
        jm.LinearSystem(np.eye(1), np.eye(1)), np.eye(1), np.eye(1), horizon,
        states=jm.Box([-none], [1.0]), inputs=problems.symmetric(1.0), **settings,
    )  # fmt: skip


OUTSIDE = np.array([100.0, 1.5, 1 + 1e-6, 1 + 1e-9])
INSIDE = np.array([1.0, 1 - 1e-9, 0.0, -50.0, -1e6])


@pytest.mark.parametrize("none", NONE)
@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.slow
def test_scalar(none, sign):
    """x ≤ 1, or −x ≤ 1 as a mirror: labels, and half-spaces that hold and exclude, exactly."""
    mpc = ceiling(none)
    if sign < 0:
        mpc = replace(mpc, states=jm.Box([-1.0], [none]))
    x = sign * np.concatenate([OUTSIDE, INSIDE])
    fmap = jm.map_feasible_set(mpc, x[:, None])
    np.testing.assert_array_equal(fmap.label, [-1] * 4 + [1] * 5)
    for i in range(4):
        a, b = fmap.labels.cut_normal[i], Fraction(fmap.labels.cut_offset[i])
        assert sign * a[0] > 0 and sign * Fraction(a[0]) <= b < Fraction(a[0]) * Fraction(x[i])
    for i in range(4, 9):
        assert exact.keeps_all_rows(mpc, x[i : i + 1], fmap.labels.plan[i])
    assert fmap.volume_bounds() == (pytest.approx(1 + 1e6), np.inf)
    with pytest.raises(ValueError, match="unbounded"):
        fmap.outer()


@pytest.mark.parametrize(
    ("settings", "edge"),
    [
        (dict(constrain_initial=False), 2.0),
        (dict(constrained_stages=(3,)), 4.0),
        (dict(terminal_set=jm.Box([-np.inf], [-7.0])), -2.0),
        (dict(terminal_set=jm.Polytope(np.array([[-2.0]]), np.array([1.0]))), -5.5),
        (dict(terminal_set=jm.Box([3.0], [np.inf])), None),
    ],
    ids=["k = 1..N", "k = 3", "x_N ≤ −7", "−2 x_N ≤ 1", "empty"],
)
@pytest.mark.slow
def test_scalar_steps_and_terminal_sets(settings, edge):
    """Where the limit is not on x_0, or at the other end; by hand. x_N ≥ −1/2 needs x_0 ≥ −5.5."""
    x = np.array([-9.0, 0.5, 1.7, 3.0, 100.0])
    inside = np.zeros(len(x), bool)
    if edge is not None:
        x = np.append(x, edge + np.array([1e-3, 1e-6, 1e-9, -1e-9, -1e-6, -1e-3]))
        lower = edge == -5.5
        inside = (x >= edge) & (x <= 1) if lower else x <= edge
    fmap = jm.map_feasible_set(ceiling(**settings), x[:, None])
    np.testing.assert_array_equal(fmap.label, np.where(inside, 1, -1))


KINDS = {
    "marginal": ([[1.0, 0.3], [0.0, 1.0]], [[0.045], [0.3]]),
    "rotating": ([[0.6, -0.8], [0.8, 0.6]], [[0.5], [0.2]]),
    "unstable": ([[1.3, 0.4], [-0.2, 1.6]], [[-0.7], [0.9]]),
    "coupled": ([[1.0, 0.1], [0.2, 1.05]], [[0.4], [-1.1]]),
}


def planar(kind, none, missing, **settings) -> jm.MPC:
    """|x_i| ≤ 1 but for the sides in `missing`, such as "-0" for no lower limit of x_0, N = 4."""
    lower, upper = -np.ones(2), np.ones(2)
    for side in missing:
        (lower if side[0] == "-" else upper)[int(side[1])] = -none if side[0] == "-" else none
    A, B = map(np.array, KINDS[kind])
    c = settings.pop("c", None)
    states = settings.pop("states", jm.Box(lower, upper))
    inputs = settings.pop("inputs", problems.symmetric(1.0))
    return jm.MPC(
        jm.LinearSystem(A, B, c=c), np.eye(2), np.eye(1), 4, states=states, inputs=inputs,
        **settings,
    )  # fmt: skip


def near(polygon, center, count) -> np.ndarray:
    """Points on rays from `center`, on both sides of the boundary by 1e-3, 1e-6, 1e-9 of it."""
    angle = np.random.default_rng(0).uniform(0, 2 * np.pi, count)
    rays = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    a, b = polygon.rows()
    slope = rays @ a.T
    with np.errstate(divide="ignore"):
        t = np.where(slope > 0, (b - a @ center) / slope, np.inf).min(axis=1)
    rays, t = rays[t < 1e3], t[t < 1e3]
    shift = np.array([1e-3, -1e-3, 1e-6, -1e-6, 1e-9, -1e-9])
    return (center + rays * (t * (1 + shift[:, None]))[:, :, None]).reshape(-1, 2)


def check(mpc, allow=0, whole=True) -> FeasibleSetMap:
    """Labels, plans and half-spaces in rationals, within 1e6, where the oracle ends.

    allow: how many labels may be open. whole: every −1 has a half-space for the whole set.
    """
    polygon = exact.feasible_polygon_by_elimination(mpc)
    random = np.random.default_rng(1).uniform(-3, 3, (80, 2))
    inside = random[polygon.contains(random)]
    points = np.concatenate([random, 1e3 * random[:9], near(polygon, inside.mean(axis=0), 16)])
    fmap = jm.map_feasible_set(mpc, points, chunk=64)
    truth = polygon.contains(points)
    decided = fmap.label != 0
    np.testing.assert_array_equal(fmap.label[decided], np.where(truth, 1, -1)[decided])
    assert np.sum(~decided) <= allow and 10 < truth.sum() < len(truth) - 10
    for i in np.flatnonzero(fmap.label == 1)[::6]:
        assert exact.keeps_all_rows(mpc, points[i], fmap.labels.plan[i])
    out = np.flatnonzero(fmap.label == -1)
    known = out[np.isfinite(fmap.labels.cut_offset[out])]
    assert len(fmap.cuts()[1]) == len(known) and (not whole or len(known) == len(out))
    for i in known:
        a, b = fmap.labels.cut_normal[i], Fraction(fmap.labels.cut_offset[i])
        assert polygon.support(a) <= b < exact.dot(exact.rational(a), exact.rational(points[i]))
    return fmap


@pytest.mark.long
@pytest.mark.parametrize("none", [np.inf, *slow(*NONE[1:])])
@pytest.mark.parametrize("missing", ["-0", "-0 -1", *slow("-0 +1", "-0 +0", "-0 +0 -1")])
@pytest.mark.parametrize("kind", ["unstable", *slow("marginal", "rotating", "coupled")])
@pytest.mark.first(1)
def test_boxes(kind, missing, none):
    check(planar(kind, none, missing.split()), whole=missing != "-0 +0 -1")


def test_rows_that_inputs_move_are_none_of_zeros():
    """Whatever the other bound of a row is: beside 1e12 its entries, 0.045, are no rounding."""
    zero = [
        FeasibilityProblem.of(planar("marginal", none, ("-0",))).rows.zero_rows
        for none in (np.inf, 1e12)
    ]
    np.testing.assert_array_equal(*zero)


@pytest.mark.parametrize("none", [1e9, *slow(np.inf, 1e12, 1e20)])
@pytest.mark.parametrize(
    "settings",
    [
        dict(c=np.array([0.1, -0.05])),
        dict(inputs=jm.Box([-np.inf], [1.0])),
        *slow(dict(inputs=jm.Box([0.0], [np.inf]))),
    ],
    ids=["affine", "u ≤ 1", "u ≥ 0"],
)
def test_dynamics_and_inputs(settings, none):
    """Where neither states nor inputs are limited on both sides, rounding may outweigh a proof."""
    check(planar("coupled", none, ("-0", "-1"), **settings), allow=10 * ("inputs" in settings))


@pytest.mark.parametrize("none", [1e20, *slow(*NONE[:3])])
@pytest.mark.slow
def test_terminal_set(none):
    check(planar("coupled", none, ("-0", "-1"), terminal_set=jm.Box([-0.5, -none], [none, none])))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["marginal", *slow("unstable")])
def test_one_row(kind):
    """0.3 x_1 + x_2 ≤ 1: a wedge without end, whose facets have normals that are no floats."""
    row = jm.Polytope(np.array([[0.3, 1.0]]), np.ones(1))
    fmap = check(planar(kind, np.inf, (), states=row), whole=False)
    assert np.all(np.isin(fmap.status, [jm.Status.SOLVED, jm.Status.PRIMAL_INFEASIBLE]))
    assert fmap.refine().volume_bounds()[1] == np.inf
    with pytest.raises(ValueError, match="outer|unbounded"):
        fmap.outer()


@pytest.mark.parametrize("inputs", [None, *slow(jm.Box([-1.0], [np.inf]), jm.Box([-1.0], [1e20]))])
@pytest.mark.slow
def test_inputs_are_bounded_by_the_states_they_lead_to(inputs):
    """u_k = B⁺(x_{k+1} − A x_k − c): limits of the states on both sides do for those of u."""
    check(planar("coupled", 1.0, (), inputs=inputs))


class TestRowsThatNoInputMoves:
    """They are half-spaces on x_0, whatever the inputs may do."""

    @pytest.mark.slow
    def test_initial_limits(self):
        """x ≤ 1 and no limit on u at all: x_0 ≤ 1."""
        mpc = replace(ceiling(), inputs=None)
        fmap = jm.map_feasible_set(mpc, np.concatenate([OUTSIDE, INSIDE])[:, None])
        np.testing.assert_array_equal(fmap.label, [-1] * 4 + [1] * 5)
        edges = fmap.labels.cut_offset[:4] / fmap.labels.cut_normal[:4, 0]
        assert np.all((edges >= 1) & (edges < 1 + 1e-11))

    @pytest.mark.slow
    def test_euler(self):
        """q_1 = q_0 + 0.5 v_0 does not feel u_0; 3 q + 4 v ≤ 5 at k = 0 neither."""
        system = jm.LinearSystem(np.array([[1.0, 0.5], [0.0, 1.0]]), np.array([[0.0], [1.0]]))
        mpc = jm.MPC(
            system, np.eye(2), np.eye(1), 1, states=jm.Polytope(np.array([[3.0, 4.0]]), [5.0]),
            terminal_set=jm.Box([-np.inf, -np.inf], [1.0, np.inf]),
        )  # fmt: skip
        e = 1e-9
        points = np.array([[1, 0.5 + e], [1 + e, 0.5], [-40, 31.25 + e], [1, 0.5 - e], [1, -30]])
        points = np.concatenate([points, [[0.5, 1 + e], [0.5, 1 - e], [3.0, -2.0], [2.9, -4.0]]])
        inside = (points @ [3, 4] <= 5) & (points @ [1, 0.5] <= 1)
        fmap = jm.map_feasible_set(mpc, points)
        np.testing.assert_array_equal(fmap.label, np.where(inside, 1, -1))


@pytest.mark.slow
def test_multipliers_say_what_holds_on_an_unbounded_set():
    """a'θ ≤ b + w'|θ| for random multipliers at far feasible points, in rationals, whatever the
    extent that is given."""
    mpc = planar("unstable", np.inf, ("-0", "-1"), c=np.array([0.1, -0.05]))
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (3000, 2)) * 10.0 ** rng.integers(0, 12, (3000, 1))
    feasible = points[jm.map_feasible_set(mpc, points).label == 1]
    far = feasible[np.argsort(-np.abs(feasible).max(axis=1))][::40]
    assert len(far) > 10 and np.abs(far).max() > 1e10
    with enable_x64(True):
        y, y_N = rng.standard_normal((100, 4, 2)), np.zeros((100, 0))
        for extent in (np.full(2, 1e-3), np.full(2, np.inf)):
            problem = exact_data(mpc, make_view(mpc), hard_blocks(mpc), extent)
            say = jax.vmap(lambda y, y_N, p=problem: proofs.cut(p, y, y_N, np.zeros(0)))
            a, b, w = map(np.asarray, say(y, y_N))
            known = np.flatnonzero(np.isfinite(b))
            assert len(known) > 90 and (w >= 0).all()
            for i in known:
                normal, slope = exact.rational(a[i]), exact.rational(w[i])
                for x in far[:: 1 + i % 3]:
                    most = Fraction(b[i]) + exact.dot(slope, exact.rational(np.abs(x)))
                    assert exact.dot(normal, exact.rational(x)) <= most


class TestOtherQuestions:
    """Rays, refinement, recursion and plans of such problems."""

    @pytest.mark.parametrize("none", [np.inf, *slow(1e9)])
    def test_boundary(self, none):
        mpc = planar("coupled", none, ("-0", "-1"))
        polygon = exact.feasible_polygon_by_elimination(mpc)
        found = jm.feasible.boundary(mpc, 16, center=np.zeros(2))
        ends = np.isfinite(found.inner) & (found.inner < 1e3)
        assert 4 < ends.sum() < 16
        assert np.all(found.outer[ends] - found.inner[ends] <= 1e-9)
        assert polygon.contains(found.points[ends]).all()
        for a, b in zip(found.normals, found.offsets, strict=True):
            assert b == np.inf or polygon.support(a) <= Fraction(float(b))

    @pytest.mark.slow
    def test_refine(self):
        """x ≥ −1e9 bounds a length, x ≥ −∞ none."""
        low, high = jm.map_feasible_set(ceiling(1e9), [[0.0]]).refine().volume_bounds()
        assert low <= 1e9 + 1 <= high and high - low < 1.0
        fmap = jm.map_feasible_set(ceiling(), [[0.0], [1 + 1e-3]]).refine()
        assert fmap.volume_bounds()[1] == np.inf
        normals, offsets = fmap.cuts()
        assert np.all((normals > 0) & (offsets >= normals[:, 0]))

    @pytest.mark.slow
    def test_solve_many(self):
        plans = jm.solve_many(ceiling(), np.array([[100.0], [1.5], [0.5], [-1e6]]))
        solved, infeasible = jm.Status.SOLVED, jm.Status.PRIMAL_INFEASIBLE
        np.testing.assert_array_equal(plans.status, [infeasible, infeasible, solved, solved])

    # A car that brakes too weakly for a wall.
    car = jm.MPC(
        jm.LinearSystem(np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])),
        np.eye(2), np.eye(1), 3, states=jm.Box([-np.inf, -np.inf], [1.0, np.inf]),
        inputs=problems.symmetric(0.25),
    )  # fmt: skip

    def test_claims_about_recursion_stay_open(self):
        problem = FeasibilityProblem.of(self.car)
        claims = settle_claims(self.car, problem)
        assert claims.strong.holds is claims.law.holds is claims.weak.holds is None
        assert "bounded sets" in claims.strong.reason and "unbounded" in claims.law.reason

    @pytest.mark.slow
    def test_recursion(self):
        """Samples are lost by proof, though no half-space of the whole set shows it."""
        x0s = np.random.default_rng(0).uniform([-4, -1], [1.2, 2], (60, 2))
        report = jm.recursive_feasibility(self.car, x0s, steps=1, search=False)
        assert report.loops.counts()["lost after one step"] > 0 and report.law.holds is None
        assert "unbounded" in str(report.law) and "lost after one step" in str(report.law)


def margin(mpc, pinned) -> float:
    """The largest distance that all rows can keep, by one LP in states and inputs.

    pinned: values of coordinates of (x_0, u_{−1}). u_{−1} is one that the input limits allow.
    """
    n, m = np.shape(mpc.system.B)
    N, count = mpc.horizon, (mpc.horizon + 1) * n + (mpc.horizon + 1) * m + 1
    unit = np.eye(count)
    x = unit[: (N + 1) * n].reshape(N + 1, n, count)
    u = unit[(N + 1) * n : -1].reshape(N + 1, m, count)  # u_{−1} comes first
    A, B = np.asarray(mpc.system.A), np.asarray(mpc.system.B)
    equal = [x[k + 1] - A @ x[k] - B @ u[k + 1] for k in range(N)]
    right = [np.zeros(n) if mpc.system.c is None else mpc.system.c] * N
    equal += [u[k + 1] - u[k] for k in range(1, N) if mpc.moves[k] == mpc.moves[k - 1]]
    right += [np.zeros(m)] * (len(equal) - N)
    start = np.concatenate([x[0], u[0]])
    equal.append(start[list(pinned)])
    right.append(np.array(list(pinned.values())))
    limits = [(mpc.states, x[k]) for k in mpc.state_stages]
    limits += [(mpc.inputs, u[k + 1]) for k in range(N)] + [(mpc.terminal_set, x[N])]
    if mpc.rate_limited:
        rate = problems.symmetric(*mpc.input_rate_limit)
        limits += [(rate, u[k + 1] - u[k]) for k in range(N)]
        limits += [(mpc.inputs, u[0])]
    rows, bounds = [], []
    for box, value in limits:
        if box is not None:
            for v, lower, upper in zip(value, box.lower, box.upper, strict=True):
                for side, bound in ((v, upper), (-v, -lower)):
                    if bound < 1e8:
                        rows.append(side + unit[-1])
                        bounds.append(bound)
    found = linprog(
        -unit[-1], np.array(rows), np.array(bounds), np.concatenate(equal), np.concatenate(right),
        [(None, None)] * (count - 1) + [(None, 10.0)],
    )  # fmt: skip
    return -np.inf if found.x is None else found.x[-1]


@pytest.mark.parametrize("none", [1e12, *slow(np.inf, 1e9, 1e20)])
@pytest.mark.parametrize(
    ("view", "settings"),
    [
        ("projection", dict(control_horizon=2)),
        pytest.param("whole", dict(input_rate_limit=np.array([0.2])), marks=pytest.mark.slow),
        pytest.param("slice", dict(input_rate_limit=np.array([0.2])), marks=pytest.mark.slow),
        pytest.param("projection", dict(input_rate_limit=np.array([0.2])), marks=pytest.mark.slow),
        pytest.param("whole", dict(control_horizon=2), marks=pytest.mark.slow),
        pytest.param("slice", dict(terminal_set=True), marks=pytest.mark.slow),
    ],
    ids=lambda v: v if isinstance(v, str) else " ".join(v),
)
@pytest.mark.slow
def test_views_rates_and_blocks(view, settings, none):
    """Three states, five of their six limits, against one LP a point."""
    if "terminal_set" in settings:
        settings = dict(terminal_set=jm.Box([-none, -0.5, -none], [0.4, none, none]))
    mpc = jm.MPC(
        jm.LinearSystem(
            np.array([[1.0, 0.2, 0.0], [-0.3, 1.1, 0.1], [0.2, 0.0, 0.9]]),
            np.array([[0.1], [0.5], [-0.4]]), c=np.array([0.02, -0.05, 0.01]),
        ),
        np.eye(3), np.eye(1), 5, states=jm.Box([-none, -1.0, -1.2], [0.8, 1.0, 1.1]),
        inputs=jm.Box([-0.5], [0.7]), **settings,
    )  # fmt: skip
    rng, fixed, axes = np.random.default_rng(2), None, (2, 0)
    if view == "whole":
        axes = tuple(range(4 if mpc.rate_limited else 3))
    elif view == "slice":
        fixed = np.array([0.0, 0.3, 0.0, 0.1][: 4 if mpc.rate_limited else 3])
    rest = {} if fixed is None else {i: v for i, v in enumerate(fixed) if i not in axes}
    points = rng.uniform(-1.5, 1.5, (90, len(axes))) * rng.choice([0.5, 1.0, 4.0], (90, 1))
    truth = np.array([margin(mpc, {**dict(zip(axes, x, strict=True)), **rest}) for x in points])
    fmap = jm.map_feasible_set(mpc, points, axes=axes, fixed=fixed)
    sure = np.abs(truth) > 1e-7
    np.testing.assert_array_equal(fmap.label[sure], np.where(truth[sure] > 0, 1, -1))
    assert 10 < np.sum(truth > 0) < 80 and sure.sum() > 80
    normals, offsets = fmap.cuts()
    assert np.all(points[fmap.label == 1] @ normals.T <= offsets)
    for i in np.flatnonzero(fmap.label == 1)[::5]:
        assert exact.keeps_all_rows(mpc, fmap.labels.start[i], fmap.labels.plan[i])
