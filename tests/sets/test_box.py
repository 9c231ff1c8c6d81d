"""Boxes: membership, supports, errors, under JAX's transformations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from polytopes import cube

from jaxmpc import Box, LinearSystem
from jaxmpc.sets.control_invariant import (
    maximal_control_invariant_set,
)

INF = np.inf


def test_box():
    box = Box([-1, -2], [3, INF])
    box.validate("states", 2)
    assert box.dimension == 2
    points = np.array([[0, 0], [3, 1e9], [3.1, 0], [0, -2.1], [np.nan, 0]])
    np.testing.assert_array_equal(jax.vmap(box.contains)(points), [1, 1, 0, 0, 0])
    assert box.contains(np.array([3.05, 0]), tolerance=0.1)
    assert box.support([1, -1]) == 5 and box.support([-2, 0]) == 2
    assert box.support([0, 1]) == INF and box.support([1, 0]) == 3
    np.testing.assert_array_equal(jax.grad(box.support)(jnp.array([1.0, 0.0])), [3, 0])
    H, lower, upper = box.rows()
    np.testing.assert_array_equal(H, np.eye(2))
    np.testing.assert_array_equal(lower, [-1, -2])
    np.testing.assert_array_equal(upper, [3, INF])
    polytope = box.to_polytope()
    np.testing.assert_array_equal(polytope.H, [[1, 0], [-1, 0], [0, -1]])
    np.testing.assert_array_equal(polytope.h, [3, 1, 2])
    finite = Box([-1, 0], [1, 3])
    np.testing.assert_array_equal(finite.vertices(), [[-1, 0], [1, 0], [1, 3], [-1, 3]])
    assert finite.volume() == 6
    assert Box(np.zeros(4), np.ones(4)).vertices().shape == (16, 4)


def test_sets_pass_under_jit_and_grad():
    inside = jax.jit(lambda s, x: s.contains(x))
    assert inside(Box([0.0], [1.0]), jnp.array([0.5]))
    assert not inside(cube(2), jnp.array([0.5, 1.5]))
    jax.jit(lambda s: s.validate("s", 2) or s.rows())(cube(2))
    boxes = Box(np.zeros((3, 2)), np.arange(6.0).reshape(3, 2))
    np.testing.assert_array_equal(jax.vmap(lambda b: b.support(jnp.ones(2)))(boxes), [1, 5, 9])
    with jax.enable_x64(True):
        assert Box([0.0], [1.0]).contains(np.array([1 + 1e-12])) == jnp.array(False)


@pytest.mark.parametrize(
    ("box", "message"),
    [
        (Box([0, 0], [1, -1]), r"states: is empty: lower\[1\] = 0, upper\[1\] = -1"),
        (Box([0.1 + 0.2, 0], [0.3, 1]), r"lower\[0\] = 0.30000000000000004, upper\[0\] = 0.3\."),
        (Box([INF, 0], [INF, 1]), "states: is empty"),
        (Box([-1, np.nan], [1, 1]), "states.lower: holds NaN"),
        (Box(jnp.array([-1.0, 0]), jnp.ones(1)), "states.upper: shape"),
        (Box(-1, 1), "states: has dimension 1 where 2"),
        (Box([-1], [1]), "states: has dimension 1 where 2"),
        (Box(None, [1]), "states.lower: None"),
    ],
)
def test_box_errors(box, message):
    with pytest.raises(ValueError, match=message):
        box.validate("states", 2)


def test_box_errors_in_use():
    assert Box([0], [INF]).volume() == INF
    with pytest.raises(ValueError, match="Box: is unbounded"):
        Box([0], [INF]).vertices()
    with pytest.raises(ValueError, match="x: shape"):
        Box(-1, 1).contains([0.0, 0.0])
    with pytest.raises(ValueError, match=r"x: shape \(3, 2\)"):
        Box([0, 0, 0], [1, 1, 1]).contains(np.zeros((3, 2)))
    with pytest.raises(ValueError, match="d: shape"):
        Box([0, 0], [1, 1]).support([1.0])
    with pytest.raises(ValueError, match="traced"):
        jax.jit(lambda b: b.volume())(Box([0.0], [1.0]))


@pytest.mark.slow
def test_numbers_are_the_limits_of_every_coordinate():
    system = LinearSystem([[1, 0.1], [0, 1]], [0, 0.1])
    given = maximal_control_invariant_set(system, Box(-1, 1), Box(-0.5, 0.5))
    full = maximal_control_invariant_set(system, Box([-1, -1], [1, 1]), Box([-0.5], [0.5]))
    np.testing.assert_array_equal(given.H, full.H)
    np.testing.assert_array_equal(given.h, full.h)


def test_comparisons_of_boxes_of_two_numbers():
    """Such a box has any dimension where it is asked about a set, and one by itself."""
    assert Box(-1, 1) == Box(-1.0, 1.0) and Box(-1, 1) != Box(-1, 2) and Box(-1, 1) in [Box(-1, 1)]
    assert Box(-1, 1) <= Box([-2, -1], [1, 1]) and not Box(-1, 1) <= Box([-2, 0], [1, 1])
    assert Box(-1, 1) >= Box([-1, 0], [1, 0])
