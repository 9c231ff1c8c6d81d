"""Rays to the boundary: centres, slices, wrong arguments, rays without end."""

from dataclasses import replace

import exact
import numpy as np
import problems
import pytest

import jaxmpc as jm
from jaxmpc.feasible.candidate_search import inputs_of
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.rays import Rays


@pytest.fixture(scope="module")
def polygon():
    return exact.feasible_polygon(problems.lecture())


class TestBoundaryArguments:
    def test_center_and_slice(self, polygon):
        found = jm.feasible.boundary(problems.lecture(), np.array([[1.0, 0.0], [0.0, 2.0]]),
                            center=np.array([0.1, 0.2]))  # fmt: skip
        np.testing.assert_array_equal(found.center, [0.1, 0.2])
        assert polygon.contains(found.points).all()
        # x₁ + x₂/… facets by hand: the ray along x₁ ends where x₁ + x₂ = 1.1, at x₁ = 0.9.
        assert found.inner[0] == pytest.approx(0.8, abs=1e-9)

    @pytest.mark.parametrize(
        ("arguments", "words"),
        [
            (dict(directions=np.zeros((1, 2))), "directions"),
            (dict(directions=np.ones((1, 3))), "directions"),
            (dict(directions=np.array([[np.nan, 1.0]])), "directions"),
            (dict(directions=4, center=np.zeros(3)), "center"),
            (dict(directions=4, center=np.array([5.0, 5.0])), "center"),
            (dict(directions=4, center=np.array([np.nan, 0.0])), "center"),
            (dict(directions=0), "directions"),
            (dict(directions=-1), "directions"),
        ],
    )
    def test_errors(self, arguments, words):
        with pytest.raises(ValueError, match=words):
            jm.feasible.boundary(problems.lecture(), **arguments)

    def test_unbounded_ray(self):
        """No limit on x₁: the ray along it never ends, the other does."""
        mpc = replace(
            problems.lecture(), states=jm.Box(np.array([-np.inf, -1.0]), np.array([np.inf, 1.0])),
            terminal_set=None,
        )  # fmt: skip
        found = jm.feasible.boundary(mpc, np.array([[1.0, 0.0], [0.0, 1.0]]), center=np.zeros(2))
        assert found.outer[0] == np.inf
        assert found.inner[1] == pytest.approx(1.0, abs=1e-9)


@pytest.mark.long
def test_centre_keeps_a_margin_in_the_terminal_ellipsoid():
    """The bounds of a ball's rows, both its centre, are no equality that leaves no margin: of pairs
    without one not every end is proved. Ends against 2 (ball ⊕ box) by hand."""
    mpc = jm.MPC(
        system=jm.LinearSystem(np.eye(2) / 2, np.eye(2)), Q=np.eye(2), R=np.eye(2), horizon=1,
        inputs=jm.Box(np.full(2, -0.1), np.full(2, 0.1)), terminal_set=jm.Ellipsoid(np.eye(2), 1.0),
    )  # fmt: skip
    rays = Rays.of(FeasibilityProblem.of(mpc))
    inputs, _ = inputs_of(rays.exact, rays.problem.rows, rays.center, rays.w)
    assert np.linalg.norm(rays.center / 2 + np.asarray(inputs[0])) < 0.99
    found = jm.feasible.boundary(mpc, 12)
    beyond_box = np.maximum(np.abs(found.points) / 2 - 0.1, 0.0)
    np.testing.assert_allclose(np.linalg.norm(beyond_box, axis=1), 1.0, atol=1e-8)


def test_slice_at_a_previous_input_on_its_limit():
    """The row of u₋₁ alone has no margin then. Where rates do not bind, ends are those without."""
    mpc = replace(problems.lecture(), inputs=jm.Box([0.0], [1.0]))
    limited = replace(mpc, input_rate_limit=5.0)
    center, directions = (
        Rays.of(FeasibilityProblem.of(mpc)).center,
        np.vstack([np.eye(2), -np.eye(2)]),
    )
    views = (mpc, None, None), (limited, (0, 1), [0.0, 0.0, 0.0])
    ends = [Rays.of(FeasibilityProblem.of(*v), center).cast(directions).inner for v in views]
    np.testing.assert_allclose(*ends, rtol=1e-9)
