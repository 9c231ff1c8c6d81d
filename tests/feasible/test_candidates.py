"""The stages that find candidates for proofs, each on its own, beside a formulation in NumPy.

The oracle knows the problem from `ExactData` alone: it rolls out, and rows are affine in the first
state and the inputs. What labels are true is known from exact polygons.
"""

import functools
from dataclasses import replace

import exact
import jax
import numpy as np
import problems
import pytest

import jaxmpc as jm
from jaxmpc.feasible.candidate_search import (
    INSET,
    admm_stage,
    check_candidates,
    compiled_newton,
    cut_of,
    feasibility_steps,
    inputs_of,
    newton_stage,
    with_violated_limit,
)
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.proofs import Verdict

GAIN = np.array([[-0.4, -0.1], [0.1, -0.5]])
ROUND = replace(problems.lecture(), terminal_set=jm.Ellipsoid(np.diag([1.0, 4.0]), 0.5))
MADE = {
    "lecture": (problems.lecture(), None, None),
    "ball": (ROUND, None, None),
    "drifting": (replace(problems.drifting(), prestabilise=GAIN), None, None),
    "projection": (problems.lecture(), (1,), None),
    "slice": (replace(problems.drifting(), prestabilise=GAIN), (1,), np.array([0.2, 0.0])),
}
NAMES = pytest.mark.parametrize("name", MADE)


pytestmark = pytest.mark.usefixtures("x64")


@functools.cache
def made(name):
    """The rows, the exact data, and the bounds of its rows, stage by stage."""
    problem = FeasibilityProblem.of(*MADE[name])
    d = problem.dimension
    p, rows = problem.exact(np.full(d, 2.0), np.ones(d)), problem.rows
    ball = np.zeros(sum(rows.balls))
    bounds = [
        np.concatenate([np.ravel(stages), last, ball])
        for stages, last in ((p.lower, p.lower_N), (p.upper, p.upper_N))
    ]
    return problem, p, rows, *bounds


def values(p, x, inputs):
    """H x_k + D u_k step by step, H_N x_N, and L'x_N of a terminal ellipsoid P = LL'."""
    found = []
    for u in inputs:
        found.append(p.H @ x + p.D @ u)
        x = p.A @ x + p.B @ u + p.c
    ball = [] if p.P is None else np.linalg.cholesky(p.P).T @ x
    return np.concatenate([*found, p.H_N @ x, ball])


def half_space(p, lower, upper, y):
    """a'θ ≤ b that multipliers y of all rows of `values` imply, with θ and the other states."""
    n, m = p.B.shape
    zero = np.zeros(n), np.zeros((p.horizon, m))
    constant = values(p, *zero)
    state = np.array([values(p, x, zero[1]) - constant for x in np.eye(n)])
    units = np.eye(p.horizon * m).reshape(-1, p.horizon, m)
    inputs = np.array([values(p, zero[0], u) - constant for u in units]).reshape(p.horizon, m, -1)
    y = np.where(np.isinf(upper), np.minimum(y, 0), y)
    y = np.where(np.isinf(lower), np.maximum(y, 0), y)
    ball = 0 if p.P is None else n
    ends = np.where(y > 0, upper, np.where(y < 0, lower, 0.0))
    b = y[: len(y) - ball] @ ends[: len(y) - ball] - constant @ y
    if ball:
        b += np.sqrt(p.level) * np.linalg.norm(y[-ball:])
    slope = np.zeros(p.move_lower.shape)
    for k, move in enumerate(p.moves):
        slope[move] -= inputs[k] @ y
    b += np.sum(np.maximum(slope * p.move_lower, slope * p.move_upper))
    a, others = state @ y, list(p.view.others)
    if p.view.projects:
        b += np.sum(np.maximum(-a[others] * p.view.lower, -a[others] * p.view.upper))
    elif others:
        b -= a[others] @ p.view.fixed[others]
    return a[list(p.view.axes)], b


def random_points(name, count, seed=0):
    _, _, rows, *_ = made(name)
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.2, 1.2, (count, rows.D.shape[1])), rng.normal(
        size=(count, rows.U.shape[1])
    )


@NAMES
def test_coordinates_stand_for_inputs(name):
    """What w leaves of each bound in the rows is what the inputs leave of it in a roll-out."""
    _, p, rows, lower, upper = made(name)
    for theta, w in zip(*random_points(name, 3), strict=True):
        inputs, free = map(np.asarray, INPUTS(p, rows, theta, w))
        assert free.shape == (len(p.view.others) if p.view.projects else 0,)
        x = np.zeros(len(p.A)) if not p.view.others or p.view.projects else p.view.fixed.copy()
        x[list(p.view.axes)] = theta
        if p.view.projects:
            x[list(p.view.others)] = free
        value, coordinate = values(p, x, inputs), rows.U @ w + rows.D @ theta
        kept = rows.index < len(rows.U)
        assert np.all(kept | (np.isinf(lower) & np.isinf(upper)))
        i = rows.index[kept]
        for exactly, bound in ((lower, rows.lower), (upper, rows.upper)):
            np.testing.assert_allclose(
                (bound[i] - coordinate[i]) / rows.weight[i], (exactly - value)[kept], atol=1e-12
            )


@NAMES
def test_multipliers_imply_a_half_space(name):
    _, p, rows, lower, upper = made(name)
    rng, cut = np.random.default_rng(1), jax.jit(cut_of)
    for _ in range(4):
        y = rng.normal(size=len(rows.U))
        a, b, w = map(np.asarray, cut(p, rows, y))
        expected_a, expected_b = half_space(
            p, lower, upper, np.append(y * rows.weight, 0.0)[rows.index]
        )
        scale = np.linalg.norm(a) / np.linalg.norm(expected_a)
        np.testing.assert_allclose(a, scale * expected_a, rtol=1e-10, atol=1e-12)
        assert b == pytest.approx(scale * expected_b, rel=1e-10, abs=1e-12)
        assert np.all(w >= 0) and np.all(w < 1e-11)


class TestViolatedLimit:
    """|θ_i| ≤ 1 at k = 0, which no input moves."""

    def found(self, theta, rows=None):
        rows = made("lecture")[2] if rows is None else rows
        y = np.linspace(1, 2, len(rows.U))
        return np.asarray(VIOLATED(rows, np.array(theta), y)), y, rows

    @pytest.mark.parametrize(
        ("theta", "axis", "sign"),
        [([1.5, -1.4], 0, 1), ([-1.5, 1.4], 0, -1), ([1.1, -1.4], 1, -1), ([0.0, 1 + 1e-9], 1, 1),
         ([-1 - 1e-9, 0.5], 0, -1)],
    )  # fmt: skip
    def test_the_most_violated_alone(self, theta, axis, sign):
        got, _, rows = self.found(theta)
        (i,) = np.flatnonzero(got)
        assert i in rows.zero_rows and got[i] == sign
        np.testing.assert_allclose(np.abs(rows.D[i]), np.eye(2)[axis])

    @pytest.mark.parametrize("theta", [[0.3, -0.9], [1.0, -1.0], [1 + 2e-16, 0.0]])
    def test_none_is_violated_but_by_rounding(self, theta):
        got, y, _ = self.found(theta)
        np.testing.assert_array_equal(got, y)

    def test_no_such_rows(self):
        rows = replace(made("lecture")[2], zero_rows=np.zeros(0, int))
        got, y, _ = self.found([5.0, 5.0], rows)
        np.testing.assert_array_equal(got, y)


@functools.cache
def polygon():
    return exact.feasible_polygon(problems.lecture())


def true_candidates(theta):
    """A plan and multipliers of linear programs at θ."""
    problem, _, rows, *_ = made("lecture")
    return problem.programs.margin(np.asarray(theta, float), np.ones(len(rows.U)))


def require_proof(theta, verdict, i=()):
    """The verdict proves what it says: a plan that keeps all rows, or a half-space."""
    label = int(verdict.label[i])
    if label == 1:
        assert exact.keeps_all_rows(problems.lecture(), theta, np.asarray(verdict.plan[i]))
        np.testing.assert_array_equal(verdict.start[i], theta)
    if label == -1:
        normal, offset = np.asarray(verdict.cut_normal[i]), float(verdict.cut_offset[i])
        assert polygon().support(normal) <= offset < np.sum(normal * theta)
    return label


VIOLATED = jax.jit(with_violated_limit)
INPUTS = jax.jit(inputs_of)
CHECK = jax.jit(lambda p, rows, theta, w, a, b: check_candidates(p, rows, theta, w, [a, b]))


class TestCheck:
    """Labels rest on whichever candidate proves one."""

    def test_each_candidate(self):
        _, p, rows, *_ = made("lecture")
        check = functools.partial(CHECK, p, rows)
        inside, outside = np.array([0.2, -0.1]), np.array([0.9, 0.5])
        w, _ = true_candidates(inside)
        _, y = true_candidates(outside)
        none, bad = np.zeros_like(y), -y
        wrong = np.full_like(w, np.nan)
        assert require_proof(inside, check(inside, w, none, none)) == 1
        assert require_proof(inside, check(inside, w, y, y)) == 1
        assert require_proof(inside, check(inside, wrong, y, y)) == 0
        for pair in ((y, none), (none, y), (y, y), (bad, y), (y, bad)):
            assert require_proof(outside, check(outside, wrong, *pair)) == -1
        assert require_proof(outside, check(outside, wrong, bad, none)) == 0
        # A limit at k = 0 is a proof whatever the multipliers are.
        beyond = np.array([0.0, 1.1])
        found = check(beyond, wrong, none, none)
        assert require_proof(beyond, found) == -1
        np.testing.assert_allclose(found.cut_normal / found.cut_offset, [0, 1], atol=1e-9)
        # The first that proves it is kept.
        first, second = (check(np.array([1.1, 1.2]), wrong, m, none) for m in (y, none))
        assert np.all(np.abs(first.cut_normal) > 0) and second.cut_normal[0] == 0

    def test_nothing_is_said_of_what_is_not_proved(self):
        _, p, rows, *_ = made("lecture")
        w, y = np.full(rows.U.shape[1], np.nan), np.full(len(rows.U), np.nan)
        found = CHECK(p, rows, np.zeros(2), w, y, y)
        assert found.label == 0 and found.cut_offset == np.inf and found.label.dtype == np.int8


def project(rows, theta, v):
    """The nearest point of the bounds that θ leaves."""
    shift, balls = rows.D @ theta, sum(rows.balls)
    p = np.clip(v, rows.lower - shift, rows.upper - shift)
    if balls:
        centre = (rows.lower - shift)[-balls:]
        off = v[-balls:] - centre
        p[-balls:] = centre + off * min(1.0, rows.radius[0] / max(np.linalg.norm(off), 1e-300))
    return p


def douglas_rachford(rows, theta, alpha, iterations):
    """The last two t of t⁺ = t + α (P (2s − t) − s), s the projection of t, from that of 0."""
    ts = [project(rows, theta, np.zeros(len(rows.U)))]
    for _ in range(iterations):
        t, s = ts[-1], project(rows, theta, ts[-1])
        ts.append(t + alpha * (rows.U @ (rows.U.T @ (2 * s - t)) - s))
    return ts[-1], ts[-2]


def test_feasibility_steps():
    """The last iterate and the one before, of between the unit box and the line z₁ + z₂ = 3."""
    onto = lambda v: v - (v.sum(axis=0) - 3) / 2
    box = lambda v: np.clip(v, -1, 1)
    ts = [np.array([4.0, -3.0])]
    for _ in range(5):
        s = box(ts[-1])
        ts.append(ts[-1] + 1.3 * (onto(2 * s - ts[-1]) - s))
    for iterations in (1, 2, 5):
        last, before = feasibility_steps(
            lambda v: jax.numpy.clip(v, -1, 1), onto, jax.numpy.asarray(ts[0]), iterations, 1.3
        )
        np.testing.assert_allclose(last, ts[iterations], rtol=1e-12)
        np.testing.assert_allclose(before, ts[iterations - 1], rtol=1e-12)


@pytest.mark.parametrize("name", ["ball", "lecture"])
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.first(1)
def test_admm(name, dtype):
    """w as a loop finds it, and the labels that w, the last residual and its change prove."""
    _, p, rows, lower, upper = made(name)
    alpha, iterations = 1.3, 3
    thetas = np.concatenate([random_points(name, 60)[0], [[0.0, 0.97], [0.0, -0.97]]])
    stage = jax.jit(lambda p, rows, x: admm_stage(p, rows, x, iterations, dtype, alpha))
    verdict, w = jax.tree.map(np.asarray, stage(p, rows, thetas))
    assert w.dtype == dtype
    provers = set()
    for i, theta in enumerate(thetas):
        t, before = douglas_rachford(rows, theta, alpha, iterations)
        residual = lambda t, theta=theta: t - project(rows, theta, t)
        # The coordinates of the mirror image of t.
        expected = rows.U.T @ (t - 2 * residual(t))
        np.testing.assert_allclose(w[i], expected, atol=1e-12 if dtype == np.float64 else 1e-5)
        if dtype == np.float32 or np.any(np.abs(theta) > 1):
            continue
        inputs, free = INPUTS(p, rows, theta, expected)
        inputs = np.clip(inputs, p.u_lower, p.u_upper)
        value = values(p, theta, inputs)
        linear = len(value) - sum(rows.balls)
        room = np.minimum(value - lower, upper - value)[:linear].min()
        if rows.balls:
            room = min(room, np.sqrt(p.level) - np.linalg.norm(value[linear:]))
        beyond, normals = [], []
        for y in (residual(t) - residual(before), residual(t)):
            a, b = half_space(p, lower, upper, np.append(y * rows.weight, 0.0)[rows.index])
            size = max(np.linalg.norm(a), 1e-300)
            beyond.append((a @ theta - b) / size)
            normals.append(a / size)
        if min(np.abs([room, *beyond])) < 1e-9:
            continue
        assert verdict.label[i] == (1 if room > 0 else -1 if max(beyond) > 0 else 0)
        if verdict.label[i] == -1:
            normal = verdict.cut_normal[i] / np.linalg.norm(verdict.cut_normal[i])
            np.testing.assert_allclose(normal, normals[int(beyond[0] < 0)], atol=1e-9)
            provers.add(beyond[0] > 0)
    assert {-1, 0, 1} == set(verdict.label)
    assert dtype == np.float32 or len(provers) == 2


@pytest.mark.parametrize("name", ["ball", "lecture"])
@pytest.mark.first(1)
def test_newton_aims_a_little_inside(name):
    """From afar w lands on faces of the bounds, moved in by INSET of their size; or by a quarter
    of what lies between two bounds."""
    _, p, rows, *_ = made(name)
    thetas, far = random_points(name, 40, seed=3)
    thetas *= 0.4
    thin = replace(rows, lower=rows.lower.copy(), upper=rows.upper.copy())
    row = np.flatnonzero(np.linalg.norm(rows.U, axis=1) > 0)[0]
    width = 1e-12
    middle = 0.5 * (rows.lower + rows.upper)[row]
    thin.lower[row], thin.upper[row] = middle - width / 2, middle + width / 2
    stage = jax.jit(lambda p, rows, x, w: newton_stage(p, rows, x, w, 12))
    _, w = stage(p, rows, thetas, 5 * far)
    insets = []
    for theta, one in zip(thetas, np.asarray(w), strict=True):
        value, bounds = rows.U @ one + rows.D @ theta, (rows.lower, rows.upper)
        linear = slice(0, len(value) - sum(rows.balls))
        shift = rows.D @ theta
        size = rows.size + np.fmin(*(np.abs(b - shift) for b in bounds))
        moved = (np.linalg.norm(rows.U, axis=1) > 0)[linear]
        slack = np.minimum(value - bounds[0], bounds[1] - value)[linear][moved]
        inset = INSET * size[linear][moved]
        if rows.balls:
            length = np.linalg.norm(value[linear.stop :] - rows.lower[linear.stop :])
            slack = np.append(slack, rows.radius[0] - length)
            inset = np.append(inset, INSET * rows.radius[0])
        if slack.min() > -1e-7:  # feasible
            insets.append((slack / inset).min())
    assert len(insets) > 20
    np.testing.assert_allclose(insets, 1.0, atol=1e-3)
    assert width < INSET * rows.size
    _, w = stage(p, thin, 0 * thetas, far)
    off = np.asarray(w) @ thin.U[row] - middle
    np.testing.assert_array_less(np.abs(off), width * 0.26)


class TestNewtonRounds:
    """Those undecided are gathered in batches until each is decided or has had its rounds."""

    def run(self, points, usable, label, batch):
        _, p, rows, *_ = made("lecture")
        count, k = len(points), rows.U.shape[1]
        mark = lambda *shape: np.full((count, *shape), 7.0)
        start = Verdict(label, mark(2), mark(p.horizon, 1), mark(2), mark())
        args = (p, rows, points, usable, start, np.zeros((count, k), np.float32))
        return jax.tree.map(np.asarray, compiled_newton(batch, None)(*args))

    @pytest.mark.parametrize("batch", [4, 64])
    @pytest.mark.first(1)
    def test_all_that_are_open_are_decided(self, batch):
        points = random_points("lecture", 23, seed=5)[0]
        inside = polygon().contains(points)
        label = np.zeros(23, np.int8)
        label[[3, 9]], label[[4, 22]] = 1, -1
        usable = ~np.isin(np.arange(23), [0, 5, 22])
        found = self.run(points, usable, label, batch)
        waited = usable & (label == 0)
        np.testing.assert_array_equal(found.label[waited], np.where(inside, 1, -1)[waited])
        for i in np.flatnonzero(waited):
            require_proof(points[i], found, i)
        np.testing.assert_array_equal(found.label[~waited], label[~waited])
        for part in jax.tree.leaves(replace(found, label=np.full(23, 7.0))):
            assert np.all(part[~waited] == 7)

    def test_none_waits_forever(self):
        """A point on the boundary may stay undecided; others come first, and all end."""
        vertex = np.array(polygon().vertices[0], float)
        points = np.concatenate([np.tile(vertex, (21, 1)), [[0.1, 0.1], [0.9, 0.9]]])
        found = self.run(points, np.ones(23, bool), np.zeros(23, np.int8), 4)
        np.testing.assert_array_equal(found.label[-2:], [1, -1])
