"""Recursive feasibility: every claim against exact polygons, closed forms or known answers."""

import dataclasses
import re
import time
from dataclasses import replace
from fractions import Fraction

import exact
import numpy as np
import problems
import pytest
from scipy.optimize import linprog

import jaxmpc as jm
from jaxmpc.explicit.law_at_states import RegionLaw
from jaxmpc.explicit.regions import critical_regions
from jaxmpc.feasible.pipeline import Labels
from jaxmpc.feasible.plan_polytope import projected
from jaxmpc.feasible.polytope_growth import backward
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.recursion import (
    analysis,
    recursive_feasibility,
    smallest_horizon,
)
from jaxmpc.recursion import (
    counterexamples as search,
)
from jaxmpc.recursion.counterexamples import SampledLoops, closed_loops
from jaxmpc.recursion.proofs import _by_theorem, settle_claims
from jaxmpc.recursion.time_budget import Budget


def settled(mpc):
    """The claims as theorems and linear programs settle them."""
    return settle_claims(mpc, FeasibilityProblem.of(mpc))


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.first(2)
def test_inputs_with_limits_through_zero_and_rates(seed):
    """Supports of X_N along coordinates are often zero there, or what rounding leaves of that; they
    are those of linear programs over (x, u_{-1}, u_0, u_1), and the weak claim is settled."""
    rng = np.random.default_rng(seed)
    A, one = rng.normal(size=(2, 2)), np.eye(2)
    A, H = A / np.abs(np.linalg.eigvals(A)).max(), np.vstack([rng.normal(size=(2, 2)), one, -one])
    B, h, rate = rng.normal(size=(2, 2)), np.array([0, 0, 1.5, 1.5, 1.2, 1.0]), [0.2, 1.4]
    mpc = jm.MPC(
        jm.LinearSystem(A, B, dt=1.0), one, one, 2, states=problems.symmetric(1.0, 1.0),
        inputs=jm.Polytope(H, h), input_rate_limit=rate, constrained_stages=(0,),
        terminal_set=problems.symmetric(1.0, 1.0),
    )  # fmt: skip
    claims, none = settled(mpc), 0 * one
    moves = [[none, -one, one, none], [none, none, -one, one]]
    rows = np.block([[one, none, none, none], *moves, [A @ A, none, A @ B, B]])
    ends = np.concatenate([np.ones(2), rate, rate, np.ones(2)])
    G = np.vstack([rows, -rows, np.hstack([np.zeros((18, 2)), np.kron(np.eye(3), H)])])
    g = np.concatenate([ends, ends, h, h, h])
    for d in [*np.eye(4), *-np.eye(4), *rng.normal(size=(4, 4))]:
        top = linprog(-np.append(d, np.zeros(4)), G, g, bounds=[(None, None)] * 8)
        assert claims.feasible_set.support(d)[0] == pytest.approx(-top.fun, rel=1e-7, abs=1e-7)
    assert claims.weak.holds is not None, claims.weak.reason


def has_plan(A, B, point, u_limit, rate) -> bool:
    """Whether (x, u_{-1}) has two inputs within limits and rates, |x_0|, |x_1| <= 1, by an LP."""
    (n, m), x = np.shape(B), point[: len(B)]
    one, none = np.eye(m), np.zeros((m, m))
    rows = np.block([[B, np.zeros((n, m))], [one, none], [-one, one]])
    middle = np.concatenate([-A @ x, point[n:], np.zeros(m)])
    width = np.concatenate([np.ones(n), np.full(2 * m, rate)])
    found = linprog(
        np.zeros(2 * m), np.vstack([rows, -rows]), np.append(middle + width, width - middle),
        bounds=[(-u_limit, u_limit)] * (2 * m),
    )  # fmt: skip
    return bool(np.abs(x).max() <= 1) and found.status == 0


def holds(found) -> tuple:
    return found.strong.holds, found.law.holds, found.weak.holds


def check_counterexample(mpc, c) -> None:
    """In rationals: the state has a plan, and the half-space of X_N excludes the next state."""
    body = exact.feasible_polygon(mpc)
    assert body.contains(c.state[None])[0]
    assert exact.keeps_all_rows(mpc, c.state, c.feasible_inputs)
    assert not body.contains(c.next_state[None])[0]
    assert body.support(c.normal) <= Fraction(float(c.offset))
    assert exact.dot(exact.rational(c.normal), exact.rational(c.next_state)) > Fraction(c.offset)
    depth = (c.normal @ c.next_state - c.offset) / np.linalg.norm(c.normal)
    assert c.distance == pytest.approx(depth, rel=1e-12)
    A, B = mpc.system.A, mpc.system.B
    drift = 0 if mpc.system.c is None else mpc.system.c
    np.testing.assert_allclose(c.next_state, A @ c.state + B @ c.inputs[0] + drift, atol=1e-14)
    check_optimal(mpc, c)


def check_optimal(mpc, c) -> None:
    """The plan costs no more than the best that another solver finds."""
    assert c.primal_residual < 1e-7 and c.dual_residual < 1e-7
    u0 = problems.least_distance(mpc, c.state)[0]
    np.testing.assert_allclose(c.inputs[0], u0, atol=1e-6)


class TestProofs:
    """Claims that linear programs settle; nothing here is sampled."""

    @pytest.mark.parametrize(
        ("problem", "expected", "volume", "lost"),
        [
            pytest.param(
                lambda: problems.lecture(0.25, 1),
                (False, False, False),
                3.19,
                0.4225,
                marks=pytest.mark.slow,
            ),
            pytest.param(
                lambda: problems.lecture(0.25, 2),
                (False, False, False),
                2.7675,
                0.16,
                marks=pytest.mark.slow,
            ),
            (lambda: problems.lecture(0.25, 3), (False, False, False), 2.6075, 0.02),
            pytest.param(
                lambda: problems.lecture(0.25, 4),
                (True, True, True),
                2.5875,
                0.0,
                marks=pytest.mark.slow,
            ),
            (lambda: problems.lecture(0.3, 3), (False, None, True), 2.8108, 0.0),
            pytest.param(
                lambda: problems.lecture(0.3, 4),
                (True, True, True),
                2.8108,
                0.0,
                marks=pytest.mark.slow,
            ),
            pytest.param(
                lambda: problems.joint(4),
                (False, False, False),
                11.9136,
                0.0016,
                marks=pytest.mark.slow,
            ),
            pytest.param(
                lambda: problems.joint(5), (False, None, True), 11.912, 0.0, marks=pytest.mark.slow
            ),
            (lambda: problems.joint(6), (True, True, True), 11.912, 0.0),
        ],
    )
    def test_known_cases(self, problem, expected, volume, lost):
        mpc = problem()
        found = settled(mpc)
        assert holds(found) == expected
        assert found.volume == pytest.approx(volume, rel=1e-9)
        assert found.lost == pytest.approx(lost, abs=1e-9)
        body = exact.feasible_polygon(mpc)
        assert len(found.feasible_set.offsets) == len(body.facets)
        ends = [float(body.support(normal)) for normal in found.feasible_set.normals]
        np.testing.assert_allclose(found.feasible_set.offsets, ends, atol=1e-9)

    def test_limited_rates_name_a_cure_that_helps(self):
        """Facets in five dimensions: with rates as inputs they are found, the same as without."""
        n, m, u = 3, 2, 0.4
        A, B = np.eye(n) + 0.8 * np.eye(n, k=1), np.eye(n)[:, :m]
        x, rate = jm.Box(-np.ones(n), np.ones(n)), jm.Box(-0.3 * np.ones(m), 0.3 * np.ones(m))
        limits = {"states": x, "inputs": jm.Box(-u * np.ones(m), u * np.ones(m))}
        mpc = jm.MPC(
            jm.LinearSystem(A, B), np.ones(n), np.ones(m), 2, **limits,
            input_rate_limit=0.3 * np.ones(m),
        )  # fmt: skip
        with pytest.raises(ValueError, match=r"Make u_\{k-1\} a state.*recursive-feasibility.md"):
            jm.feasible_polytope(mpc)
        assert "Make u_{k-1} a state" in settled(mpc).strong.reason
        A = np.block([[A, B], [np.zeros((m, n)), np.eye(m)]])
        system = jm.LinearSystem(A, np.vstack([B, np.eye(m)]))
        box = jm.Box(*(s * np.append(np.ones(n), u * np.ones(m)) for s in (-1, 1)))
        within = jm.Box(*(s * np.append(np.full(n, np.inf), u * np.ones(m)) for s in (-1, 1)))
        moved = jm.MPC(
            system, np.ones(n + m), np.ones(m), 2, states=box, inputs=rate, terminal_set=within
        )
        body = jm.feasible_polytope(moved)
        points = np.random.default_rng(0).uniform(-1, 1, (40, n + m)) * [1, 1, 1, u, u]
        planned = [has_plan(A[:n, :n], B, point, u, 0.3) for point in points]
        assert body.contains(points).tolist() == planned and 5 < sum(planned) < 35

    def test_reasons_name_the_proof_and_the_counterexample(self):
        reason = settled(problems.joint(6)).strong.reason
        assert "X_5 = X_6" in reason and "14 facets" in reason
        found = settled(problems.lecture(0.25, 3))
        body = exact.feasible_polygon(problems.lecture(0.25, 4))
        assert "every feasible first input leaves X_N" in found.weak.reason
        assert not body.contains(found.weak.state[None])[0]  # it is not in X_4
        assert "beyond a facet of X_N" in found.strong.reason
        assert str(found.strong).startswith("refuted: from x = (")

    def test_theorem_1(self):
        found = settled(problems.joint_o_inf(6))
        assert holds(found) == (True, True, True)
        assert found.strong.reason.startswith("Theorem 1: the terminal set is within the limits")
        # Where the shifted plan need not be a plan, the theorem says nothing.
        for change in ({"input_rate_limit": 0.1}, {"control_horizon": 2}):
            blocked = _by_theorem(replace(problems.joint_o_inf(6), **change))
            assert blocked.holds is None and "does not cover" in blocked.reason
        short = replace(problems.scalar(0.5, 1, 1.0, 0.1), terminal_set=None)
        assert _by_theorem(short).holds is None  # its first input may leave the limits
        assert _by_theorem(replace(short, horizon=2)).holds is True

    def test_no_limit_on_the_state(self):
        free = replace(problems.lecture(), states=None, terminal_set=None)
        assert holds(settled(free)) == (True, True, True)

    def test_unbounded_set_stays_open(self):
        mpc = problems.scalar(2.0, horizon=3, x_max=None, terminal=1.0)
        found = settled(replace(mpc, inputs=None))
        assert found.feasible_set is None and "unbounded" in found.why
        assert found.strong.holds is True or found.weak.holds is None

    def test_scalar_in_closed_form(self):
        """x⁺ = 2x + u, |x| ≤ 5, |u| ≤ 1: X_N is |x| ≤ 1 + 4·2⁻ᴺ, X_{N+1} half as far from 1."""
        found = settled(problems.scalar(2.0, 3, 5.0, 1.0, terminal=5.0))
        assert found.volume == pytest.approx(2 * (1 + 4 / 8), rel=1e-12)
        assert found.lost == pytest.approx(4 / 8, rel=1e-9)
        assert holds(found) == (False, False, False)

    @pytest.mark.parametrize("end", ["states", pytest.param(None, marks=pytest.mark.slow)])
    def test_half_spaces_by_recursion_are_those_by_rays(self, end):
        mpc = problems.lecture(0.25, 3)
        mpc = mpc if end else replace(mpc, terminal_set=None)
        body = projected(FeasibilityProblem.of(mpc).plan_polytope)
        before, same, after = backward(mpc)
        order = lambda s: np.unique(np.round(np.column_stack([s.normals, s.offsets]), 9), axis=0)
        np.testing.assert_allclose(order(body), order(same), atol=1e-8)
        for part, N in ((before, 2), (after, 4)):
            exact_body = exact.feasible_polygon(replace(mpc, horizon=N))
            ends = [float(exact_body.support(normal)) for normal in part.normals]
            np.testing.assert_allclose(part.offsets, ends, atol=1e-9)

    @pytest.mark.parametrize("unit", [1.0, 1e-5])
    def test_no_state_can_go_on(self, unit):
        """x⁺ = x + u, 0 ≤ x ≤ 1.5, 1 ≤ u ≤ 2: X_1 = [0, 0.5], and every x⁺ ≥ 1."""
        limits = jm.Box([0.0], [1.5 * unit])
        mpc = jm.MPC(
            jm.LinearSystem([[1.0]], [[1.0]]), np.eye(1), np.eye(1), 1,
            states=limits, inputs=jm.Box([unit], [2 * unit]), terminal_set=limits,
        )  # fmt: skip
        found = jm.recursive_feasibility(mpc, np.array([[0.2 * unit]]), steps=1, search=False)
        assert found.weak.holds is False and found.strong.holds is False
        assert found.volume == pytest.approx(0.5 * unit)
        assert found.lost_by_any == pytest.approx(0.5 * unit)

    @pytest.mark.slow
    def test_weak_where_sets_do_not_nest(self):
        """The first input must be that of a feasible plan: X_N against Pre(X_N ∩ X_{N−1})."""
        mpc = problems.drifting()
        body = exact.feasible_polygon(mpc)
        shorter = exact.feasible_polygon(replace(mpc, horizon=mpc.horizon - 1))
        facets = [*body.facets, *shorter.facets]
        both = jm.Polytope(*(np.array([f[i] for f in facets], float) for i in (0, 1)))
        later = exact.feasible_polygon(replace(mpc, horizon=1, terminal_set=both))
        for normal, offset in body.facets:
            later = later.clip(normal, offset)
        found = settled(mpc)
        assert found.lost == pytest.approx(float(body.area - later.area), abs=1e-9)
        assert found.lost > 0.007 and found.weak.holds is False

    @pytest.mark.slow
    def test_twelve_states(self):
        """Six joints side by side: 12 states, millions of vertices, 84 facets."""
        one, k = problems.joint(6), 6
        A, B = np.kron(np.eye(k), one.system.A), np.kron(np.eye(k), one.system.B)
        limit = problems.symmetric(*([1.5, 2.0] * k))
        mpc = jm.MPC(
            system=jm.LinearSystem(A, B), Q=np.eye(2 * k), R=np.eye(k), horizon=6, states=limit,
            inputs=problems.symmetric(*([2.0] * k)), terminal_set=limit,
        )  # fmt: skip
        assert holds(settled(mpc)) == (True, True, True)
        assert holds(settled(replace(mpc, horizon=5))) == (False, None, True)
        assert holds(settled(replace(mpc, horizon=4))) == (False, False, False)


def test_the_law_loses_what_any_input_loses():
    """To all digits: rounding of a row is no room that is kept."""
    mpc = jm.MPC(
        jm.LinearSystem([[1.0, 0.1], [0.0, 1.0]], [0.005, 0.1]), [10.0, 1.0], 0.1, 4,
        states=jm.Box([-2.0, -1.0], [2.0, 1.0]), inputs=jm.Box(-1.0, 1.0),
    )  # fmt: skip
    report = recursive_feasibility(mpc, steps=1, search=False)
    assert report.lost_by_any == pytest.approx(0.04225, abs=1e-12)
    assert report.lost_by_law == pytest.approx(0.04225, abs=1e-12)


class TestReport:
    @pytest.mark.slow
    def test_lecture_loses_and_keeps(self):
        mpc = problems.lecture(0.25, 3)
        states = np.array([[-1.0, 1.0], [-0.999, 0.999], [0.0, 0.0], [1.0, 1.0], [np.nan, 0.0]])
        report = recursive_feasibility(mpc, states, steps=4)
        assert holds(report) == (False, False, False)
        c = report.counterexample
        assert c.found == "regions"
        assert c.distance == pytest.approx(0.0474341649, abs=1e-9)
        np.testing.assert_allclose(np.abs(c.state), [0.95, 1.0], atol=1e-9)
        assert c.state[0] * c.state[1] < 0
        check_counterexample(mpc, c)
        assert report.lost_by_law == pytest.approx(0.02, abs=1e-9)
        assert report.lost_by_any == pytest.approx(0.02, abs=1e-9)
        np.testing.assert_array_equal(report.loops.label, [1, 1, 1, -1, 0])
        np.testing.assert_array_equal(report.loops.lost_at, [1, 1, 0, -1, -1])
        np.testing.assert_allclose(report.loops.inputs[1], [-0.25], atol=1e-8)
        assert np.isnan(report.loops.next_states[3]).all()
        assert report.loops.counts()["lost after one step"] == 2
        text = str(report)
        assert "refuted" in text and "0.0474342" in text and "lost, any input" in text
        data = report.to_xarray()
        assert data["lost_at"].shape == (5,) and data.attrs["steps"] == 4

    def test_lecture_with_more_input_is_proved_by_regions(self):
        """And nothing is sampled."""
        report = recursive_feasibility(problems.lecture(0.3, 3))
        assert holds(report) == (False, True, True)
        assert "13 critical regions fill X_N" in report.law.reason
        assert report.counterexample is None and report.lost_by_law == 0.0
        assert report.loops.x0s.shape == (0, 2) and report.loops.counts()["feasible"] == 0
        assert "none: its law is proved" in str(report)

    @pytest.mark.slow
    def test_samples_that_are_asked_for_are_kept_where_the_law_is_proved(self):
        cells = jm.grid([-63 / 64] * 2, [63 / 64] * 2, (64, 64))
        report = recursive_feasibility(problems.lecture(0.3, 3), cells, steps=3)
        counts = report.loops.counts()
        assert counts["kept"] == counts["feasible"] > 2000
        # The middles of the grid's cells measure the area.
        assert counts["feasible"] * (2 / 64) ** 2 == pytest.approx(2.8108, rel=0.02)
        without = recursive_feasibility(
            problems.lecture(0.3, 3), steps=1, max_regions=0, search=False
        )
        assert without.law.holds is None and "no counterexample" in without.law.reason

    @pytest.mark.parametrize("search", [True, False])
    @pytest.mark.parametrize(
        ("problem", "distance", "lost"),
        [
            (lambda: problems.lecture(0.25, 1), 0.546401, 0.785245),
            (lambda: problems.double_integrator(3), 0.737865, 4.083333),
        ],
    )
    @pytest.mark.slow
    def test_worst_is_a_vertex_of_a_region(self, monkeypatch, problem, distance, lost, search):
        """A search can end elsewhere (in 12 s at 0.527 on the first). Nor are samples needed."""
        monkeypatch.setattr(analysis, "LABELS", 1e9)  # no time for samples
        mpc = problem()
        report = recursive_feasibility(mpc, search=search)
        assert holds(report) == (False, False, False) and len(report.loops.x0s) == 0
        assert "no time was left" in str(report)
        c = report.counterexample
        check_counterexample(mpc, c)
        assert c.found == "regions" and c.distance == pytest.approx(distance, abs=1e-6)
        assert report.lost_by_law == pytest.approx(lost, abs=1e-6)
        if not search:
            return
        # No vertex of X_N and no state between leads farther, by another solver.
        H, h = exact.feasible_polygon(mpc).rows()
        size = np.linalg.norm(H, axis=1)
        corners = np.asarray(report.feasible_set.vertices())
        weights = np.random.default_rng(0).dirichlet(np.full(len(corners), 0.3), 150)
        step = lambda x: mpc.system.A @ x + mpc.system.B @ problems.least_distance(mpc, x)[0]
        beyond = [
            ((H @ step(x) - h) / size).max()
            for x in [*corners * (1 - 1e-9), *weights @ corners * (1 - 1e-9)]
        ]
        assert c.distance - 0.1 * c.distance < max(beyond) < c.distance + 1e-6

    def test_some_regions_already_refute(self, monkeypatch):
        """What is lost is not known then, nor how far outside the worst state leads."""
        monkeypatch.setattr(analysis, "LABELS", 1e9)  # no time for samples, nor for a search
        report = recursive_feasibility(problems.lecture(0.25, 3), max_regions=5)
        assert report.law.holds is False and np.isnan(report.lost_by_law)
        assert 0.01 < report.counterexample.distance <= 0.0474341650
        check_counterexample(report.mpc, report.counterexample)

    def test_time_bounds_the_whole_call(self, capsys):
        """What compiles is left out, the rest stops; what is open and what is undecided is said."""
        mpc, states = problems.joint(20), np.array([[0.0, 0.0], [1.0, 1.0]])
        report = recursive_feasibility(mpc, states, seconds=0.01, progress=True)
        assert holds(report) == (None, None, None) and report.counterexample is None
        np.testing.assert_array_equal(report.loops.label, [0, 0])
        np.testing.assert_array_equal(report.loops.lost_at, [-1, -1])
        assert "time" in report.law.reason and report.seconds < 20
        assert re.search(r"- feasible +0\n *- without a label +2\n", str(report))
        assert report.needed >= 32 and f"seconds needed       {report.needed} or more" in str(
            report
        )
        assert "theorem and linear programs" in capsys.readouterr().err
        found = smallest_horizon(mpc, 50, seconds=0.01, progress=True)
        assert len(found.reasons) <= 1
        assert "horizon 1\n" in capsys.readouterr().err

    def test_seconds_that_suffice(self):
        """A call that took 10 of 1,000 s and needs 32 more has them with 42; one of whose limit two
        thirds were spent, by stages that may take their share again, with three times as many."""
        now = time.monotonic()
        assert Budget(now - 10, now + 990, False).sufficient(32) == 43  # rounded up
        assert Budget(now - 20, now + 10, False).sufficient(32) in (96, 97)
        assert Budget(now - 40, now - 10, False).sufficient(32) == 128

    def test_closed_loops_stop_in_time(self):
        mpc, over = problems.lecture(), Budget(0.0, -np.inf, False)
        law = RegionLaw(critical_regions(mpc), np.zeros(2), 64)
        states, problem = np.zeros((3, 2)), FeasibilityProblem.of(mpc)
        labels = replace(Labels.empty(3, problem), label=np.array([1, 1, -1]))
        loops = closed_loops(law, problem, states, labels, 5, over)
        np.testing.assert_array_equal(loops.lost_at, [-2, -2, -1])
        np.testing.assert_array_equal(loops.undecided_at, [1, 1, 0])
        assert loops.late_at == 1
        assert loops.why_undecided() == "2: the time was over before step 1; give more seconds"

    def test_undecided_loops_say_why(self):
        """Those that the time ended, and those that a plan or a label left open before."""
        problem = FeasibilityProblem.of(problems.lecture())
        loops = SampledLoops.undecided(problem, np.zeros((5, 2)), 5)
        at = {"lost_at": np.array([-2, -2, -2, 0, -1]), "undecided_at": np.array([3, 1, 3, 0, 0])}
        open_ones = "1: no plan was SOLVED, or the next state has no proof"
        late = "2: the time was over before step 3; give more seconds"
        assert replace(loops, **at, late_at=3).why_undecided() == f"{late}; {open_ones}"
        assert replace(loops, **at).why_undecided() == f"3{open_ones[1:]}"
        assert loops.why_undecided() == ""

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"x0s": np.zeros(2)}, r"x0s: shape \(2,\)"),
            ({"x0s": np.zeros((3, 4))}, r"x0s: shape \(3, 4\)"),
            ({"x0s": np.zeros((0, 2))}, "x0s: shape"),
            ({"steps": 0}, "steps: 0"),
            ({"steps": 2.5}, "steps: 2.5"),
            ({"max_regions": -1}, "max_regions: -1"),
            ({"seconds": 0.0}, "seconds: 0.0"),
        ],
    )
    def test_bad_arguments(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            recursive_feasibility(problems.lecture(), **arguments)
        with pytest.raises(ValueError, match="max_horizon: 0"):
            smallest_horizon(problems.lecture(), 0)

    def test_empty_and_unbounded_sets_ask_for_states(self):
        empty = replace(problems.lecture(), terminal_set=jm.Box([5.0, 5.0], [6.0, 6.0]))
        with pytest.raises(ValueError, match="x0s: None, and the feasible set is empty"):
            recursive_feasibility(empty)
        with pytest.raises(ValueError, match="Q: "):
            recursive_feasibility(replace(problems.lecture(), Q=-np.eye(2)))


@pytest.mark.slow
class TestSlow:
    def test_needle_is_found_by_search(self):
        """Uniform samples hit the needle of the joint, 0.0134 % of X_4, once in 7,400."""
        mpc = problems.joint(4)
        report = recursive_feasibility(mpc, max_regions=0)
        c = report.counterexample
        assert holds(report) == (False, False, False) and c.found == "search"
        assert c.distance == pytest.approx(0.0039968, abs=1e-6)
        np.testing.assert_allclose(np.abs(c.state), [1.444, 2.0], atol=1e-5)
        np.testing.assert_allclose(np.abs(c.next_state), [1.464, 1.6], atol=1e-5)
        assert report.lost_by_any == pytest.approx(0.0016, abs=1e-9)
        check_counterexample(mpc, c)

    def test_needle_is_found_without_the_seeds_of_linear_programs(self, monkeypatch):
        real = analysis.settle_claims
        bare = lambda *a: replace(real(*a), seeds=np.zeros((0, 2)))
        monkeypatch.setattr(analysis, "settle_claims", bare)
        c = recursive_feasibility(problems.joint(4), max_regions=0).counterexample
        assert c.distance == pytest.approx(0.0039968, abs=1e-6)

    @pytest.mark.parametrize(
        ("N", "distance", "lost"), [(1, 0.546401, 0.785245), (2, 0.178885, 0.182572)]
    )
    def test_short_horizons(self, N, distance, lost):
        mpc = problems.lecture(0.25, N)
        report = recursive_feasibility(mpc)
        assert report.counterexample.distance == pytest.approx(distance, abs=1e-5)
        assert report.lost_by_law == pytest.approx(lost, abs=1e-6)
        fraction = report.loops.counts()["lost after one step"] / report.loops.counts()["feasible"]
        assert fraction == pytest.approx(lost / report.volume, abs=0.01)
        check_counterexample(mpc, report.counterexample)

    def test_gradient_alone_and_regions_alone_find_the_worst(self, monkeypatch):
        """From one sample and the starts on the boundary; the worst state is no vertex of X_1."""
        mpc, one = problems.lecture(0.25, 1), np.zeros((1, 2))
        found = lambda: (
            recursive_feasibility(mpc, one, steps=1, max_regions=0).counterexample.distance
        )
        climb_regions, value = search._climb_regions, search._value_and_gradient
        monkeypatch.setattr(search, "_climb_regions", lambda _, b, x, v, d: x[np.argsort(-v)[:6]])
        assert found() == pytest.approx(0.546401, abs=1e-4)
        still = lambda *a, **k: (value(*a, **k)[0], np.zeros_like(a[2]))
        monkeypatch.setattr(search, "_value_and_gradient", still)
        assert found() < 0.546
        monkeypatch.setattr(search, "_climb_regions", climb_regions)
        assert found() == pytest.approx(0.546401, abs=1e-5)

    def test_joint_of_five_steps(self):
        report = recursive_feasibility(problems.joint(5), steps=30)
        assert holds(report) == (False, True, True)
        assert report.loops.counts()["kept"] == report.loops.counts()["feasible"]

    def test_oblique_limits_and_drift(self):
        mpc = problems.drifting()
        report = recursive_feasibility(mpc)
        assert holds(report) == (False, False, False)
        check_counterexample(mpc, report.counterexample)
        # The regions know the worst vertex, which search alone finds too.
        report = recursive_feasibility(mpc, max_regions=0)
        worst = -np.inf
        for region in critical_regions(mpc).regions:
            E = mpc.system.A + mpc.system.B @ region.K
            after = region.vertices @ E.T + mpc.system.B @ region.k + mpc.system.c
            H, h = report.feasible_set.H, report.feasible_set.h
            worst = max(worst, (after @ np.asarray(H).T - np.asarray(h)).max())
        assert report.counterexample.distance == pytest.approx(worst, abs=1e-6)

    def test_every_state_of_the_unstable_scalar_is_lost_when_it_must_be(self):
        """|x| = 1 + e grows to 1 + 2ᵏ e, and leaves X_N beyond 1 + 4·2⁻ᴺ."""
        N = 5
        e = np.array([1e-3, 0.01, 0.03, 0.06, 0.07, 0.12])
        states = np.concatenate([1 + e, -1 - e, [0.0, 0.999, 1.2]])[:, None]
        mpc = problems.scalar(2.0, N, 5.0, 1.0, terminal=5.0)
        report = recursive_feasibility(mpc, states, steps=12)
        step = np.ceil(np.log2(4 * 2.0**-N / e) + 1e-9).astype(int)
        expected = np.concatenate([step, step, [0, 0, -1]])
        np.testing.assert_array_equal(report.loops.lost_at, expected)
        assert report.volume == pytest.approx(2 * (1 + 4 * 2.0**-N))
        assert report.counterexample.distance == pytest.approx(4 * 2.0**-N, abs=1e-6)

    def test_smallest_horizon(self):
        found = smallest_horizon(problems.joint(), 8)
        assert (found.horizon, found.strong) == (5, 6)
        assert [found.reasons[N].holds for N in range(1, 7)] == [False] * 4 + [True] * 2
        assert "61 critical regions" in found.reasons[5].reason
        found = smallest_horizon(problems.lecture(0.25), 2)
        assert (found.horizon, found.strong) == (None, None)
        assert str(found) == "none up to 2 is proved"

    @pytest.mark.parametrize("regions", [2000, pytest.param(0, marks=pytest.mark.long)])
    def test_the_law_of_a_reference(self, regions):
        """It is that of the problem written in deviations, and loses more than the origin's."""
        system = jm.LinearSystem([[1.0, 1], [0, 1]], [[0.5], [1]])
        box, r = jm.Box([-5, -5], [5, 5]), np.array([4.8, 0])
        mpc = jm.MPC(system, [1.0, 1], 1.0, 2, box, jm.Box(-1, 1))
        about = replace(mpc, states=jm.Box(box.lower - r, box.upper - r))
        random = np.random.default_rng(0)
        x0s = random.uniform(-5, 5, (200, 2))
        how = {"max_regions": regions, "search": False, "steps": 3}
        found = recursive_feasibility(mpc, x0s, reference=r, **how)
        moved = recursive_feasibility(about, x0s - r, **how)
        np.testing.assert_array_equal(found.loops.lost_at, moved.loops.lost_at)
        np.testing.assert_allclose(found.loops.inputs, moved.loops.inputs, atol=1e-6)
        assert np.nanmax(np.abs(found.loops.inputs)) > 0.9
        assert holds(found) == holds(moved)
        if regions:
            assert found.lost_by_law == pytest.approx(moved.lost_by_law, rel=1e-9)
            assert found.lost_by_law > found.lost_by_any + 0.1
            assert smallest_horizon(mpc, 3, reference=r).horizon is None
        with pytest.raises(ValueError, match="reference: shape"):
            recursive_feasibility(mpc, reference=[1.0])

    def test_previous_input_is_part_of_the_state(self):
        mpc = replace(problems.lecture(), input_rate_limit=0.2)
        report = recursive_feasibility(mpc, steps=3)
        c = report.counterexample
        assert report.loops.x0s.shape[1] == 3 and holds(report) == (False, False, False)
        assert abs(c.next_state[2] - c.state[2]) <= 0.2 + 1e-9
        assert c.next_state[2] == c.inputs[0, 0]

    def test_limits_from_the_first_step_on(self):
        report = recursive_feasibility(replace(problems.lecture(), constrain_initial=False))
        assert holds(report) == (False, False, False)
        check_counterexample(report.mpc, report.counterexample)

    def test_six_states(self):
        one, k = problems.joint(4), 3
        A, B = np.kron(np.eye(k), one.system.A), np.kron(np.eye(k), one.system.B)
        limit = problems.symmetric(*([1.5, 2.0] * k))
        mpc = jm.MPC(
            system=jm.LinearSystem(A, B), Q=np.eye(2 * k), R=np.eye(k), horizon=4, states=limit,
            inputs=problems.symmetric(*([2.0] * k)), terminal_set=limit,
        )  # fmt: skip
        report = recursive_feasibility(mpc, steps=3)
        assert holds(report) == (False, False, False)
        assert report.counterexample.distance == pytest.approx(0.0039968, abs=1e-5)
        assert dataclasses.asdict(report)["feasible_set"] is not None


def test_what_a_law_loses_that_leads_onto_facets():
    """Half of the optimal next states lie on a facet, where rounding is no loss. Against the law in
    closed form (N = 1: the least input that reaches the set) at 400,000 states."""
    A = np.array([[1.18780659, 0.05406567], [-0.64109519, 0.52707389]])
    B = np.array([-0.06265925, 1.91244472])
    X, U = jm.Box([-0.987, -0.7845], [0.6506, 0.5095]), jm.Box(-0.934, 0.9236)
    mpc = jm.MPC(jm.LinearSystem(A, B), [1, 1], 0.1, 1, states=X, inputs=U, terminal_set=X)
    report = jm.recursive_feasibility(mpc, seconds=20, search=False)

    def ends(free):
        sides = [(end - free) / B for end in X.bounds()]
        low, high = np.minimum(*sides).max(axis=1), np.maximum(*sides).min(axis=1)
        return np.maximum(low, U.lower), np.minimum(high, U.upper)

    points = np.random.default_rng(0).uniform(*X.bounds(), (400_000, 2))
    low, high = ends(points @ A.T)
    kept = low <= high
    after = points @ A.T + np.clip(0, low, high)[:, None] * B
    low, high = ends(np.clip(after[kept], *X.bounds()) @ A.T)
    share = np.mean(low > high + 1e-9)
    assert share == pytest.approx(0.1301, abs=0.002)
    assert report.lost_by_law / report.volume == pytest.approx(share, abs=0.002)
