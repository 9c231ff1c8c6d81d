"""Sets on which labels near the boundary are hard: no interior, odd units, growth, empty by little.

`experiments/hard_sets.py` holds the systems and their exact answers.
"""

import importlib
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import exact
import numpy as np
import problems
import pytest

import jaxmpc as jm
from jaxmpc.feasible import pipeline
from jaxmpc.feasible.candidate_search import compiled_check
from jaxmpc.feasible.condensed_rows import RowPrograms
from jaxmpc.feasible.problem import FeasibilityProblem

sys.path.append(str(Path(__file__).parents[2] / "experiments"))
hard_sets = importlib.import_module("hard_sets")

FAST = ("x_N = 0",)


@pytest.mark.parametrize(
    "name",
    [v if v in FAST else pytest.param(v, marks=pytest.mark.slow) for v in hard_sets.SYSTEMS],
)
@pytest.mark.slow
def test_nothing_wrong_and_nothing_open(name):
    """At relative distances 1e-3 … 1e-8 of the boundary, on both sides."""
    row = hard_sets.run(name, 120)
    assert row["wrong"] == 0 and sum(row["undecided"]) == 0
    assert row["inside"] < row["points"] and (row["inside"] > 0) != name.startswith("empty")


class TestTerminalPoint:
    """x_N = 0: no inputs in floats keep it, but real ones next to them do."""

    mpc = hard_sets.problem(
        *hard_sets.INTEGRATOR, 6, hard_sets.box(4, 4), hard_sets.box(1.0),
        terminal_set=hard_sets.box(0, 0),
    )  # fmt: skip

    @pytest.mark.long
    def test_real_inputs_exist(self):
        """Two inputs, corrected in rationals, bring x_N to 0; every other row holds too."""
        points = np.array([[1.5, -0.7], [-3.0, 1.0], [0.3, 0.2]])
        fmap = jm.map_feasible_set(self.mpc, points)
        assert (fmap.label == 1).all()
        A, B = exact.rational(self.mpc.system.A), exact.rational(self.mpc.system.B)
        for x0, plan in zip(points, fmap.labels.plan, strict=True):
            inputs = [u[0] for u in exact.rational(plan)]
            free = np.argsort(np.abs(plan[:, 0]))[:2]  # far from their limits
            move = lambda u, x0=x0: roll(A, B, exact.rational(x0), u)[-1]
            end = move(inputs)
            columns = []
            for j in free:
                other = list(inputs)
                other[j] += 1
                columns.append([a - b for a, b in zip(move(other), end, strict=True)])
            (a, c), (b, d) = columns
            determinant = a * d - b * c
            inputs[free[0]] -= (d * end[0] - b * end[1]) / determinant
            inputs[free[1]] -= (a * end[1] - c * end[0]) / determinant
            states = roll(A, B, exact.rational(x0), inputs)
            assert states[-1] == [0, 0]
            assert all(abs(v) <= 4 for x in states[:-1] for v in x)
            assert all(abs(u) <= 1 for u in inputs)
            assert max(abs(float(v)) for v in end) < 1e-13

    @pytest.mark.slow
    def test_rays_and_bounds(self):
        polygon = exact.feasible_polygon(self.mpc)
        low, high = jm.map_feasible_set(self.mpc, np.zeros((1, 2))).refine().volume_bounds()
        assert low <= polygon.area <= high and high - low <= 1e-6 * high

    @pytest.mark.slow
    def test_dependent_equalities_prove_nothing(self):
        """A mode that no input reaches has to be zero at the end: only where it is at the start."""
        system = jm.LinearSystem(np.diag([1.0, 0.5]), np.array([[1.0], [0.0]]))
        mpc = replace(self.mpc, system=system, horizon=3)
        fmap = jm.map_feasible_set(mpc, np.array([[0.5, 0.0], [0.5, 1e-3], [3.5, 0.0]]))
        np.testing.assert_array_equal(fmap.label[1:], [-1, -1])
        assert fmap.label[0] >= 0


def roll(A, B, x, inputs):
    """States x_0, …, x_N in rationals, one input."""
    states = [x]
    for u in inputs:
        x = [exact.dot(a, x) + b[0] * u for a, b in zip(A, B, strict=True)]
        states.append(x)
    return states


SLOW = pytest.mark.slow


@pytest.mark.slow
@pytest.mark.parametrize(
    "gap", [pytest.param(1e-3, marks=SLOW), pytest.param(1e-6, marks=SLOW), 1e-9]
)
def test_empty_by_little(gap):
    """x⁺ = x + u, x_0 ≤ 1, |u| ≤ 0.3, N = 5: x_N ≥ 2.5 ± gap is out of reach, or just not."""
    points = np.array([[0.5], [1.0 - 1e-9], [1.0]])
    for sign, label in ((1, -1), (-1, 1)):
        last = jm.Box([2.5 + sign * gap], [9.0])
        mpc = replace(
            problems.scalar(x_max=None), states=jm.Box([-1.0], [1.0]), constrained_stages=(0,),
            terminal_set=last,
        )  # fmt: skip
        assert jm.map_feasible_set(mpc, points).label[2] == label
        if sign > 0:
            assert (jm.map_feasible_set(mpc, points).label == -1).all()


class TestUnits:
    D = np.random.default_rng(0).standard_normal((5, 2))

    def test_length_of_directions(self):
        one, small = (jm.feasible.boundary(problems.lecture(), s * self.D) for s in (1.0, 1e-6))
        np.testing.assert_allclose(small.inner * 1e-6, one.inner, rtol=1e-11)
        np.testing.assert_allclose(small.outer * 1e-6, one.outer, rtol=1e-11)

    @pytest.mark.parametrize("units", [(1e-4, 1e4), pytest.param((1e-6, 1e-6), marks=SLOW)])
    def test_bounds_and_polytope(self, units):
        mpc = hard_sets.in_units(problems.joint(5), np.array(units), np.ones(1))
        area = problems.AREA_JOINT * units[0] * units[1]
        low, high = jm.map_feasible_set(mpc, np.zeros((0, 2))).refine().volume_bounds()
        assert low <= area * (1 + 1e-9) and area * (1 - 1e-9) <= high
        assert high - low <= 1e-6 * high
        assert len(jm.feasible_polytope(mpc).h) == 14


def test_refine_says_what_it_missed():
    fmap = jm.map_feasible_set(problems.joint(5), np.zeros((0, 2)))
    with pytest.warns(UserWarning, match="refine: the bounds of the volume differ by"):
        fmap.refine(rounds=1)


class TestLastPrograms:
    """Linear programs for the points that the other stages leave."""

    @pytest.mark.slow
    def test_labels(self, monkeypatch):
        """Where the other stages decide nothing programs decide all, or as many as may run."""
        mpc = problems.lecture()
        points = 1e-3 + jm.grid([-1.2, -1.2], [1.2, 1.2], (7, 7))
        inside = exact.feasible_polygon(mpc).contains(points)
        run = pipeline._run

        def without_verdict(program, *args):
            found = run(program, *args)
            if program is compiled_check(None):
                return found
            verdict, *w = found if isinstance(found, tuple) else (found,)
            verdict = replace(verdict, label=0 * verdict.label)
            return (verdict, *w) if w else verdict

        monkeypatch.setattr(pipeline, "_run", without_verdict)
        fmap = jm.map_feasible_set(mpc, points)
        np.testing.assert_array_equal(fmap.label, np.where(inside, 1, -1))
        monkeypatch.setattr(pipeline, "MOST_PROGRAMS", 10)
        some = jm.map_feasible_set(mpc, points)
        np.testing.assert_array_equal(some.label[:10], fmap.label[:10])
        assert (some.label[10:] == 0).all()

    def test_multipliers_in_units_of_the_growth(self):
        """Predictions grow by 2^30, late multipliers fall as much; ends of rays are precise."""
        problem = FeasibilityProblem.of(problems.unstable(30))
        assert FeasibilityProblem.of(problems.lecture()).weighted_rows == ()
        (rows,) = problem.weighted_rows
        programs = RowPrograms(rows)
        polygon = exact.feasible_polygon(problems.unstable(30))
        for direction in TestUnits.D:
            t, _, _ = programs.ray(np.zeros(2), direction)
            end = min(
                b / v for a, b in polygon.facets
                if (v := exact.dot(a, exact.rational(direction))) > 0
            )  # fmt: skip
            assert t == pytest.approx(float(Fraction(end)), rel=1e-9)
