"""Maximal control invariant sets, against exact recursions."""

from dataclasses import replace
from fractions import Fraction

import exact
import jax
import numpy as np
import problems
import pytest
from plants import DOUBLE, JOINT, UNSTABLE
from polytopes import interval
from problems import symmetric

from jaxmpc import Box, LinearSystem, Polytope
from jaxmpc.sets.control_invariant import (
    ControlInvariantSet,
    largest_cut,
    maximal_control_invariant_set,
)
from jaxmpc.sets.predecessors import one_step

INF = np.inf


LECTURE = LinearSystem([[1, 1], [0, 1]], [[0.4], [1]])


@pytest.mark.parametrize(
    ("system", "states", "inputs", "area", "vertices", "index"),
    [
        (DOUBLE, symmetric(5, 5), 1, Fraction(1375, 24), 14, 6),
        (JOINT, symmetric(1.5, 2), 2, Fraction(1489, 125), 14, 5),
        (LECTURE, symmetric(1, 1), 0.25, Fraction(207, 80), 10, 4),
        (LECTURE, symmetric(1, 1), 0.3, Fraction(7027, 2500), 10, 3),
    ],
)
@pytest.mark.first(1)
def test_known_control_invariant_sets(system, states, inputs, area, vertices, index):
    found = maximal_control_invariant_set(system, states, symmetric(inputs))
    assert found.exact and found.iterations == index and found.gap == 0
    assert f"C_{index} = C_{index + 1}" in found.reason
    assert found.volume() == pytest.approx(float(area), abs=1e-12)
    assert len(found.vertices()) == len(found.h) == vertices
    np.testing.assert_array_equal(found.outer.h, found.h)
    shorter = maximal_control_invariant_set(
        system, states, symmetric(inputs), max_iterations=index - 1
    )
    assert not shorter.exact and "max_iterations" in shorter.reason
    assert shorter.volume() < float(area) < shorter.outer.volume()


def test_affine_dynamics_and_two_inputs_against_rationals():
    mpc = problems.drifting()
    found = maximal_control_invariant_set(mpc.system, mpc.states, mpc.inputs, max_iterations=4)
    # Complex eigenvalues outside the unit circle: each C_k has new facets, without end.
    assert not found.exact and found.iterations == 4
    body = exact.feasible_polygon(replace(mpc, terminal_set=mpc.states, horizon=4))
    assert found.outer.volume() == pytest.approx(float(body.area), rel=1e-13)
    assert len(found.outer.h) == len(body.vertices)
    later = exact.feasible_polygon(replace(mpc, terminal_set=mpc.states, horizon=12))
    assert later.contains(found.vertices() * (1 - 1e-12)).all()
    assert 0.5 * float(later.area) < found.volume() <= float(later.area)


@pytest.mark.slow
def test_recursion_without_end_gives_a_pair():
    found = maximal_control_invariant_set(UNSTABLE, symmetric(5), symmetric(1))
    assert not found.exact and found.gap < 1e-9 and "without end" in found.reason
    inner, outer = interval(found), interval(found.outer)
    assert -1 - 1e-12 <= inner[0] < -1 + 1e-9 and 1 - 1e-9 < inner[1] <= 1 + 1e-12
    assert -1 - 1e-9 < outer[0] <= -1 and 1 <= outer[1] < 1 + 1e-9
    early = maximal_control_invariant_set(UNSTABLE, symmetric(5), symmetric(1), max_iterations=3)
    assert early.iterations == 3 and interval(early.outer)[1] == pytest.approx(1 + 4 / 8)
    assert 0.9 < interval(early)[1] <= 1 and early.gap == pytest.approx(
        1.5 / interval(early)[1] - 1, rel=1e-9
    )
    # Its unstable mode x1 + 2/3 x2 doubles, with |u| 11/12 against it; x2 stays by itself.
    mpc = problems.unstable()
    found = maximal_control_invariant_set(mpc.system, mpc.states, mpc.inputs)
    assert not found.exact and found.gap < 1e-8
    assert found.volume() <= 55 / 3 <= found.outer.volume()
    assert found.volume() == pytest.approx(55 / 3, rel=1e-8)


@pytest.mark.slow
def test_robust_control_invariant_sets():
    w = symmetric(0.1)
    found = maximal_control_invariant_set(UNSTABLE, symmetric(5), symmetric(1), disturbance=w)
    assert not found.exact and interval(found)[1] == pytest.approx(0.9, abs=1e-9)
    # x+ = x + u + w keeps any interval that w leaves room in, if u is the stronger one.
    integrator = LinearSystem([[1.0]], [[1.0]])
    found = maximal_control_invariant_set(integrator, symmetric(1), symmetric(0.3), disturbance=w)
    assert found.exact and found.iterations == 0 and interval(found) == (-1, 1)
    found = maximal_control_invariant_set(integrator, symmetric(1), symmetric(0.1), disturbance=w)
    assert found.exact
    found = maximal_control_invariant_set(integrator, symmetric(1), symmetric(0.05), disturbance=w)
    assert found.exact and found.is_empty() and "against every disturbance" in found.reason
    # In the plane: the worst disturbance at every step, the input by one LP on the set's rows.
    w = Box([-0.02, -0.05], [0.03, 0.05]).to_polytope()
    states, inputs = symmetric(5, 5), symmetric(1)
    found = maximal_control_invariant_set(DOUBLE, states, inputs, disturbance=w)
    assert found.exact and found.volume() < 1375 / 24
    A, B = np.array(DOUBLE.A, float), np.array(DOUBLE.B, float)[:, 0]
    for x in found.vertices():
        # B u + A x + W within {H x <= h}: an interval of u
        left = found.h - (found.H @ w.vertices().T).max(axis=1) - found.H @ (A @ x)
        slope = found.H @ B
        top = min(1, (left[slope > 1e-12] / slope[slope > 1e-12]).min())
        bottom = max(-1, (left[slope < -1e-12] / slope[slope < -1e-12]).max())
        assert bottom <= top + 1e-9


@pytest.mark.long
def test_empty_and_flat_sets_are_reported():
    far = LinearSystem([[1.0]], [[1.0]], c=[2.0])
    found = maximal_control_invariant_set(far, symmetric(5), symmetric(1))
    assert found.exact and found.is_empty() and found.outer.is_empty()
    assert (
        found.reason.startswith("empty: no equilibrium") and "misses them by 1 of" in found.reason
    )
    nowhere = LinearSystem(np.eye(2), [[1], [0]], c=[0, 0.1])
    found = maximal_control_invariant_set(nowhere, symmetric(5, 5), None)
    assert found.is_empty() and "no equilibrium" in found.reason
    found = maximal_control_invariant_set(
        UNSTABLE, symmetric(5), symmetric(1), disturbance=symmetric(1.1)
    )
    assert found.is_empty() and "against every disturbance" in found.reason
    alone = maximal_control_invariant_set(UNSTABLE, symmetric(5), Box([0], [0]))
    assert not alone.exact and alone.gap == INF and "an equilibrium alone" in alone.reason
    assert interval(alone) == pytest.approx((0, 0), abs=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"states": None}, "states: NoneType is no Box"),
        ({"states": Box([-1, -INF], [1, 1])}, "states: is unbounded"),
        ({"states": Box([-1, 0], [1, 0])}, "states: is flat"),
        ({"inputs": symmetric(1, 1)}, "inputs: has dimension 2"),
        ({"disturbance": Box([0.1, 0], [0.2, 1])}, "disturbance: does not hold the origin"),
        ({"disturbance": Box([-1, -INF], [0.2, 1])}, "disturbance: is unbounded"),
        ({"max_iterations": 0}, "max_iterations: 0. Give a whole number"),
        ({"tolerance": 0.0}, "tolerance: 0.0 is not between"),
    ],
)
def test_control_invariant_set_errors(changes, message):
    arguments = {"states": symmetric(1, 1), "inputs": symmetric(1)} | changes
    with pytest.raises(ValueError, match=message):
        maximal_control_invariant_set(DOUBLE, **arguments)


BLOCKS = [(0.2, (1.5, 2.0)), (0.1, (1.0, 1.5)), (0.25, (1.2, 1.8))]


def hidden(blocks):
    """Joints behind a unimodular change of coordinates of states and of inputs."""
    n = 2 * blocks
    T = (np.eye(n) - np.eye(n, k=-1) - np.eye(n, k=-3)) @ (np.eye(n) + np.eye(n, k=2))
    T_inverse = np.round(np.linalg.inv(T))
    V = np.eye(blocks) - np.eye(blocks, k=1)
    A, B, limits = np.kron(np.eye(blocks), JOINT.A), np.zeros((n, blocks)), []
    for i in range(blocks):
        gain, limit = BLOCKS[i % 3]
        B[2 * i + 1, i] = gain
        limits += limit
    system = LinearSystem(T @ A @ T_inverse, T @ B @ V)
    states = Polytope(np.vstack([T_inverse, -T_inverse]), np.tile(limits, 2))
    return system, states, Polytope(np.vstack([V, -V]), np.full(2 * blocks, 2.0)), T


@pytest.mark.parametrize(
    "blocks", [pytest.param(2, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow), 6]
)
@pytest.mark.slow
def test_hidden_products(blocks):
    system, states, inputs, T = hidden(blocks)
    assert abs(np.linalg.det(T)) == pytest.approx(1)
    parts = [
        maximal_control_invariant_set(
            LinearSystem(JOINT.A, [[0], [gain]]), symmetric(*limit), symmetric(2)
        )
        for gain, limit in BLOCKS[:blocks]
    ]
    parts = parts * (1 if blocks < 6 else 2)
    found = maximal_control_invariant_set(system, states, inputs)
    assert found.exact and found.iterations == max(part.iterations for part in parts)
    assert len(found.h) == sum(len(part.h) for part in parts)
    volume = np.prod([part.volume() for part in parts])
    assert found.volume() == pytest.approx(volume, rel=1e-10)
    for direction in np.random.default_rng(0).standard_normal((10, 2 * blocks)):
        own = (T.T @ direction).reshape(-1, 2)
        expected = sum(part.support(d) for part, d in zip(parts, own, strict=True))
        assert found.support(direction) == pytest.approx(expected, rel=1e-10)


def test_checks_of_invariance_can_fail():
    step = one_step(DOUBLE, symmetric(1), None)
    box = symmetric(5, 5).to_polytope()
    # from (5, 5) the least sum of coordinates after a step is 9: x1 + x2 <= 6, 4/10 of 10 off
    assert largest_cut(step.back(box), box) == pytest.approx(0.4, abs=1e-12)
    assert largest_cut(step.back(box), box, enough=0.01) > 0.01


def test_control_invariant_sets_pass_through_jax():
    found = maximal_control_invariant_set(JOINT, symmetric(1.5, 2), symmetric(2))
    leaves, tree = jax.tree.flatten(found)
    again = jax.tree.unflatten(tree, leaves)
    assert isinstance(again, ControlInvariantSet) and again.exact and again.reason == found.reason
    assert bool(found.contains(np.zeros(2))) and not bool(found.contains(np.array([1.5, 2.0])))


def test_an_equilibrium_with_coordinates_at_zero():
    """x+ = (x_2 - 0.2, 0) rests at (-0.2, 0), which was said not to be there: its second equation
    is 0 but for rounding. Two steps keep all that one keeps."""
    plant = LinearSystem([[0.0, 1.0], [0.0, 0.0]], np.zeros((2, 1)), c=[-0.2, 0.0])
    limits = Box([-1.0, -1.8], [1.3, 1.6])
    found = maximal_control_invariant_set(plant, limits, Box([-1.0], [1.0]))
    assert found.exact and not found.is_empty()
    axes = np.vstack([np.eye(2), -np.eye(2)])
    np.testing.assert_allclose(found.support(axes), [1.3, 1.5, 1.0, 0.8], atol=1e-9)
