"""By how much limits are violated: Box, Polytope and rows, NumPy and JAX, NaN and infinity."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.sets.limits import TOLERANCE, row_violations, rows_kept, worst_violation

INF = np.inf
BOX = jm.Box(np.array([-1.0, -INF]), np.array([2.0, 3.0]))
POINTS = np.array([[0.0, 0.0], [-1.5, 3.25], [2.0, 3.0], [np.nan, 0.0], [0.0, -INF]])
EXPECTED = np.array([[0, 0], [0.5, 0.25], [0, 0], [np.nan, 0], [0, np.nan]])


@pytest.mark.parametrize("array", [np.asarray, jnp.asarray])
def test_box(array):
    found = row_violations(BOX, array(POINTS))
    assert isinstance(found, jax.Array) == (array is jnp.asarray)
    np.testing.assert_array_equal(found, EXPECTED)
    np.testing.assert_array_equal(worst_violation(BOX, array(POINTS)), [0, 0.5, 0, np.nan, np.nan])
    np.testing.assert_array_equal(rows_kept(BOX, array(POINTS)), EXPECTED == 0)


@pytest.mark.parametrize("array", [np.asarray, jnp.asarray])
def test_polytope_and_rows(array):
    """The same limits in three ways: their largest violation is the same."""
    body, rows = BOX.to_polytope(), BOX.rows()
    for limits in (body, rows):
        np.testing.assert_array_equal(
            worst_violation(limits, array(POINTS)), worst_violation(BOX, array(POINTS))
        )
        np.testing.assert_array_equal(
            rows_kept(limits, array(POINTS)).all(axis=-1), [True, False, True, False, False]
        )
    slanted = jm.Polytope(np.array([[3.0, 4.0]]), np.array([5.0]))
    assert row_violations(slanted, array([1.0, 1.0])) == 2.0


def test_no_limits():
    assert row_violations(None, POINTS).shape == (5, 0)
    np.testing.assert_array_equal(worst_violation(None, np.zeros((2, 3))), [0, 0])
    assert rows_kept(None, np.zeros((2, 3))).all()


@pytest.mark.parametrize("unit", [1e-9, 1e-3, 1.0, 1e6])
def test_what_is_kept_does_not_depend_on_the_unit(unit):
    """A limit on both sides, and one on one side."""
    at = TOLERANCE["float64"]
    points = unit * np.array([[0.5 + 0.4 * at], [0.5 + 0.6 * at], [-0.5 - 0.4 * at], [-1.0]])
    for lower, kept in ((-0.5, [True, False, True, False]), (-np.inf, [True, False, True, True])):
        limits = jm.Box([lower * unit], [0.5 * unit])
        np.testing.assert_array_equal(rows_kept(limits, points)[:, 0], kept)


def test_rounding_of_a_bound_and_of_a_row_breaks_no_limit():
    """0.1 + 0.2 − 0.3 is 5.6e-17; 10 − 9.9999 is 1e-4 in float32 to its rounding."""
    assert rows_kept(jm.Box([0.1 + 0.2 - 0.3], [INF]), np.zeros((1, 1))).all()
    limits = (np.array([[1.0, -1.0]]), np.array([-INF]), np.array([1e-4]))
    near = np.array([[10.0, 9.9999]], np.float32)
    assert float(near[0, 0]) - float(near[0, 1]) > 1e-4 * (1 + TOLERANCE["float32"])
    assert rows_kept(limits, near).all() and not rows_kept(limits, near + [1e-4, 0]).all()


def test_tolerance_of_a_row_with_unequal_bounds():
    limits = jm.Box(np.array([-0.5]), np.array([150.0]))
    at = TOLERANCE["float64"]
    points = np.array([[150 * (1 + 0.9 * at)], [150 * (1 + 1.1 * at)], [-0.5 - 0.9 * at], [-0.51]])
    np.testing.assert_array_equal(rows_kept(limits, points)[:, 0], [True, False, True, False])
    assert rows_kept(limits, points, np.float32)[:, 0].tolist() == [True, True, True, False]


def test_traced_limits():
    """Limits may be traced where points are not, and derivatives pass."""
    worst = lambda end: worst_violation(jm.Box([-1.0], [end]), np.array([3.0]))
    assert jax.jit(jax.grad(worst))(2.0) == -1.0
