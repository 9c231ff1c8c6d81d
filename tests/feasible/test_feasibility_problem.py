"""The feasibility problem: nothing is made before it is asked for, and everything once."""

from dataclasses import replace

import numpy as np
import problems
import pytest

import jaxmpc as jm
from jaxmpc.feasible import problem
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.mpc.condense import Inequalities, condensed_in_float64
from jaxmpc.mpc.problem import soften


def test_everything_is_made_once(monkeypatch):
    calls = []
    counted = lambda mpc: calls.append(mpc) or condensed_in_float64(mpc)
    monkeypatch.setattr(problem, "condensed_in_float64", counted)
    made = FeasibilityProblem.of(problems.lecture())
    assert not calls and set(vars(made)) == {"mpc", "view"}
    made.exact(np.ones(2))
    assert made.rows is made.rows and made.plan_polytope is made.plan_polytope
    assert len(calls) == 1


def test_soft_rows_and_rate_weights_play_no_part():
    mpc = problems.lecture()
    hard = replace(mpc, states=None, terminal_set=None)
    weighed = replace(soften(mpc, 1.0), input_rate_weight=np.eye(1))
    found, expected = (FeasibilityProblem.of(m).plan_polytope for m in (weighed, hard))
    np.testing.assert_array_equal(found.G, expected.G)
    assert FeasibilityProblem.of(weighed).dimension == 2 < weighed.dimension


def test_slice_and_projection():
    mpc = problems.lecture()
    assert FeasibilityProblem.of(mpc, (1,), [0.5, 0.0]).view.fixed[0] == 0.5
    assert FeasibilityProblem.of(mpc, (1,)).view.projects
    with pytest.raises(ValueError, match="axes"):
        FeasibilityProblem.of(mpc, (2,))


def test_inequalities_are_the_rows():
    """C z + D x <= b exactly where lower <= C z + D x + d <= upper; the ball is left out."""
    mpc = replace(problems.lecture(), terminal_set=jm.Ellipsoid(np.eye(2), 1.0))
    c, random = condensed_in_float64(mpc), np.random.default_rng(0)
    rows, length = Inequalities.of(c).normalised()
    linear = len(c.C) - sum(c.balls)
    np.testing.assert_allclose(np.linalg.norm(np.hstack([rows.C, rows.D]), axis=1), 1.0)
    for x, z in zip(random.normal(size=(99, 2)), random.normal(size=(99, c.C.shape[1])),
                    strict=True):  # fmt: skip
        value = (c.C @ z + c.D @ x + c.d)[:linear]
        room = np.minimum(c.upper[:linear] - value, value - c.lower[:linear]).min()
        slack = ((rows.b - rows.C @ z - rows.D @ x) * length).min()
        assert slack == pytest.approx(room, abs=1e-12)


def test_polytopes_that_are_boxes():
    """Limits of single coordinates in rows of powers of two, each once or more often."""
    H = np.array([[1.0, 0], [-2, 0], [0, -0.5], [0.25, 0]])
    box = problem.as_box(jm.Polytope(H, np.array([1.0, 3.0, 0.1, 0.1])))
    np.testing.assert_array_equal(box.lower, [-1.5, -0.2])
    np.testing.assert_array_equal(box.upper, [0.4, np.inf])
    for rows, h in ((3 * H, np.ones(4)), (H + 0.1, np.ones(4)), (H, np.array([-1.0, 1, 1, 1]))):
        body = jm.Polytope(rows, h)
        assert problem.as_box(body) is body
