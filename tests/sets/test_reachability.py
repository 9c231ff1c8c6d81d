"""Reachable sets and differences of sets, against closed forms, supports and counted points."""

from fractions import Fraction

import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc import Box, LinearSystem, Polytope
from jaxmpc.sets import (
    PolytopeUnion,
    Zonotope,
    maximal_control_invariant_set,
    predecessor,
    reachable_sets,
    set_difference,
)

DOUBLE = LinearSystem([[1, 0.1], [0, 1]], [0.005, 0.1])
SQUARE, U = Box([-0.5, -0.5], [0.5, 0.5]), Box([-1], [1])


def area_by_fractions(steps):
    """Of the sets that DOUBLE reaches from SQUARE: a sum of segments, in rational arithmetic."""
    A = [[Fraction(1), Fraction(1, 10)], [Fraction(0), Fraction(1)]]
    G = [[Fraction(1, 2), Fraction(0)], [Fraction(0), Fraction(1, 2)]]
    apply = lambda g: [A[0][0] * g[0] + A[0][1] * g[1], A[1][0] * g[0] + A[1][1] * g[1]]
    for _ in range(steps):
        G = [apply(g) for g in G] + [[Fraction(1, 200), Fraction(1, 10)]]
    pairs = ((g, h) for i, g in enumerate(G) for h in G[:i])
    return 4 * sum(abs(g[0] * h[1] - g[1] * h[0]) for g, h in pairs)


@pytest.mark.parametrize("kind", [Box, Polytope])
def test_forward_areas_are_exact(kind):
    first = SQUARE if kind is Box else SQUARE.to_polytope()
    found = reachable_sets(DOUBLE, first, U, steps=5)
    assert found[0] is first and len(found) == 6
    for k, reached in enumerate(found):
        assert reached.volume() == pytest.approx(float(area_by_fractions(k)), rel=1e-13)
    assert isinstance(found[5], Zonotope if kind is Box else Polytope)
    assert area_by_fractions(5) == Fraction(233, 100)


def test_forward_in_twelve_states_by_supports():
    rng = np.random.default_rng(0)
    A, B, c = rng.normal(size=(12, 12)) / 4, rng.normal(size=(12, 3)), rng.normal(size=12)
    X0, W = Box(-np.ones(12), 2 * np.ones(12)), Zonotope(np.zeros(12), rng.normal(size=(12, 1)))
    inputs = Box([-1, 0, -1], [1, 1, 2])
    last = reachable_sets(LinearSystem(A, B, c), X0, inputs, W, steps=4)[-1]
    d = rng.normal(size=(20, 12))
    expected, back = np.zeros(20), d
    for _ in range(4):
        expected += inputs.support(back @ B) + W.support(back) + back @ c
        back = back @ A
    np.testing.assert_allclose(last.support(d), expected + X0.support(back), rtol=1e-12)


def test_limits_no_input_and_free_input():
    still = reachable_sets(DOUBLE, SQUARE, Box([0], [0]), steps=2)[-1]
    assert still == SQUARE.image(np.linalg.matrix_power(DOUBLE.A, 2))
    limits = Box([-0.5, -0.4], [0.5, 0.4])
    kept = reachable_sets(DOUBLE, SQUARE, U, steps=2, states=limits)
    assert kept[1] == (DOUBLE.A @ SQUARE + np.reshape(DOUBLE.B, (2, 1)) @ U) & limits
    free = reachable_sets(DOUBLE, Box([0, 0], [0, 0]), None, steps=2)
    assert free[1].affine_dimension() == 1 and not free[1].is_bounded()
    assert free[2].affine_dimension() == 2  # controllable in two steps
    away = reachable_sets(DOUBLE, SQUARE, U, steps=2, states=Box([5, 5], [6, 6]))
    assert [s.is_empty() for s in away] == [False, True, True]


def test_backward_sets_are_repeated_predecessors_and_grow_to_the_largest():
    limits = Box([-5, -5], [5, 5])
    system = LinearSystem([[1, 1], [0, 1]], [0.5, 1])
    largest = maximal_control_invariant_set(system, limits, U)
    target = Box([0, 0], [0, 0])  # an equilibrium: stabilisable sets, nested
    found = reachable_sets(system, target, U, None, 8, "backward", states=limits)
    assert found[1].affine_dimension() == 1 and found[2].affine_dimension() == 2
    assert found[3] == predecessor(system, found[2], limits, U)
    for smaller, larger in zip(found[:-1], found[1:], strict=True):
        assert smaller <= larger <= largest
    # x_0 of which |u| <= 1 reaches 0 in two steps: the sum of two segments.
    A = np.array(system.A)
    steps = [np.linalg.solve(np.linalg.matrix_power(A, k), [0.5, 1]) for k in (1, 2)]
    assert found[2] == Zonotope([0, 0], np.transpose(steps))


def test_set_differences_have_exact_volume():
    hole, corner = Box([-0.1, -0.1], [0.1, 0.1]), Box([0, 0], [0.3, 0.3])
    left = set_difference(SQUARE, hole, corner)
    assert left.volume() == pytest.approx(1 - 0.04 - 0.09 + 0.01, abs=1e-14)
    points = left.sample(400, seed=1)
    assert left.contains(points).all()
    assert not hole.contains(points, -1e-9).any() and not corner.contains(points, -1e-9).any()
    right = points[:, 0] > 0.3
    assert right.mean() == pytest.approx(0.2 / left.volume(), abs=4 * 0.43 / 20)
    assert set_difference(SQUARE, SQUARE).is_empty() and set_difference(hole, SQUARE).pieces == ()
    (same,) = set_difference(hole, Box([5, 5], [6, 6])).pieces
    assert same == hole
    cut = set_difference(SQUARE, Polytope([[1, 0]], [0]))  # half a plane
    assert cut.volume() == pytest.approx(0.5) and len(cut.pieces) == 1
    both = PolytopeUnion((SQUARE.to_polytope(), Box([0, 0], [1, 1]).to_polytope()))
    assert both.volume() == pytest.approx(1.75, abs=1e-14)
    np.testing.assert_array_equal(both.contains([[0.9, 0.9], [-0.1, 0.9]]), [True, False])


def test_what_a_step_adds_to_the_feasible_set():
    """vol X_5 - vol X_4 of nested feasible sets, X_5 \\ X_4 without a point of X_4."""
    system = LinearSystem([[1, 1], [0, 1]], [0.5, 1])
    limits = Box([-5, -5], [5, 5])
    found = reachable_sets(system, Box([0, 0], [0, 0]), U, None, 5, "backward", states=limits)
    new = set_difference(found[5], found[4])
    assert new.volume() == pytest.approx(found[5].volume() - found[4].volume(), rel=1e-12)
    assert not found[4].contains(new.sample(200), -1e-9).any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"direction": "back"}, 'direction: \'back\'. Give "forward" or "backward"'),
        ({"steps": -1}, "steps: -1"),
        ({"X0": None}, "X0: is None"),
        ({"X0": Box([1, 0], [0, 1])}, "X0: is empty"),
        ({"X0": jm.Ellipsoid(np.eye(2), 1.0)}, "X0: Ellipsoid is no Box"),
        ({"inputs": Box([0, 0], [1, 1])}, "inputs: has dimension 2 where 1"),
        ({"states": Box([0], [1])}, "states: has dimension 1 where 2"),
    ],
)
def test_errors(change, message):
    with pytest.raises(ValueError, match=message):
        reachable_sets(**{"system": DOUBLE, "X0": SQUARE, "inputs": U, "steps": 1} | change)
