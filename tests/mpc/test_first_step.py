"""The controller that keeps a robust control invariant set by its first step alone."""

import itertools

import numpy as np
import pytest
from jax import enable_x64

import jaxmpc as jm
from jaxmpc.feasible import feasible_polytope
from jaxmpc.mpc import first_step_in
from jaxmpc.sets import maximal_control_invariant_set, predecessor

A, B = np.array([[1, 0.15], [0.1, 1]]), np.array([[0.1], [1.1]])
X, U, W = jm.Box([-8.0, -8.0], [8.0, 8.0]), jm.Box([-4.0], [4.0]), jm.Box([-0.1, -0.1], [0.1, 0.1])
VERTICES = [
    jm.LinearSystem(A + s * 0.05 * np.diag([1.0, 0.0]), B + t * np.array([[0.0], [0.1]]))
    for s, t in itertools.product((-1, 1), repeat=2)
]
NOMINAL = jm.MPC(jm.LinearSystem(A, B), np.eye(2), np.eye(1), 3, X, U)


def test_predecessors_of_a_hull_by_brute_force():
    """A state has one input for all vertices of plant and disturbance, or none of many inputs."""
    target = jm.Polytope.from_points([[3, 1], [-1, 3], [-3, -2], [2, -3.0]])
    found = predecessor(VERTICES, target, X, U, W)
    H, h = target.half_spaces()
    inputs = np.linspace(-4, 4, 4001)
    for x in np.random.default_rng(0).uniform(-6, 6, (60, 2)):
        after = np.array([p.A @ x for p in VERTICES])[:, None] + np.array(
            [np.outer(inputs, p.B[:, 0]) for p in VERTICES]
        )
        every = (after[:, :, None] + W.vertices()).transpose(1, 0, 2, 3).reshape(4001, -1, 2)
        worst = np.max(every @ H.T - h, axis=(1, 2)).min()
        margin = float(np.max(np.asarray(found.H) @ x - np.asarray(found.h)))
        assert (worst <= 0) == (margin <= 0) or abs(margin) < 2e-3
    one = predecessor([VERTICES[0]], target, X, U, W)
    two = predecessor(VERTICES[0], target, X, U, W)
    assert one.is_subset(two) and two.is_subset(one)


def test_its_feasible_set_is_the_set():
    """All of C, and nothing else, has a plan."""
    C = maximal_control_invariant_set(VERTICES, X, U, disturbance=W)
    assert C.exact and "vertices has an input" in C.reason
    nominal = maximal_control_invariant_set(VERTICES[0], X, U, disturbance=W)
    assert jm.Polytope(C.H, C.h).is_subset(jm.Polytope(nominal.H, nominal.h))
    mpc = first_step_in(NOMINAL, C, systems=VERTICES, disturbance=W)
    found = feasible_polytope(mpc)
    assert found.is_subset(jm.Polytope(C.H, C.h), 1e-8) and C.is_subset(found, 1e-8)


def test_a_disturbance_through_a_matrix_is_its_image():
    """One w moves both states: the rows are those of the segment E W, and of no other set."""
    E, C = np.array([[0.1], [-0.2]]), jm.Box([-1.0, -1.0], [1.0, 1.0])
    through = first_step_in(NOMINAL, C, disturbance=jm.Box([-1.0], [1.0]), disturbance_matrix=E)
    image = first_step_in(NOMINAL, C, disturbance=jm.sets.Zonotope(np.zeros(2), E))
    for one, other in zip(through.outputs, image.outputs, strict=True):
        np.testing.assert_allclose(one.upper, other.upper, rtol=1e-14)
        np.testing.assert_allclose(one.C, other.C)
    np.testing.assert_allclose(np.sort(through.outputs[-1].upper), [0.8, 0.8, 0.9, 0.9])


@pytest.mark.slow
def test_closed_loops_stay_for_every_plant_and_disturbance():
    C = maximal_control_invariant_set(VERTICES, X, U, disturbance=W)
    mpc = first_step_in(NOMINAL, C, systems=VERTICES, disturbance=W)
    rng, H, h = np.random.default_rng(0), np.asarray(C.H), np.asarray(C.h)
    x = C.vertices()[:8]
    with enable_x64():
        controller = jm.Controller(mpc)
    for _ in range(4):
        plans = jm.solve_many(controller, x)
        assert np.all(plans.status == jm.Status.SOLVED)
        u = plans.inputs[:, 0]
        plant = [VERTICES[i] for i in rng.integers(4, size=len(x))]
        x = np.array([p.A @ y + p.B @ v for p, y, v in zip(plant, x, u, strict=True)])
        x = x + W.vertices()[rng.integers(4, size=len(x))]
        assert np.max(x @ H.T - h) <= 1e-6


def test_refusals():
    C = jm.Box([-1.0, -1.0], [1.0, 1.0])
    with pytest.raises(ValueError, match="may be out of reach"):
        first_step_in(
            jm.MPC(jm.LinearSystem(A, B), np.eye(2), np.eye(1), 3, X, U, terminal_set=C), C
        )
    with pytest.raises(ValueError, match=r"mpc\.disturbance: given beside"):
        first_step_in(
            jm.MPC(jm.LinearSystem(A, B), np.eye(2), np.eye(1), 3, X, U, disturbance=W), C
        )
    with pytest.raises(ValueError, match="systems: holds one of 1 states"):
        first_step_in(NOMINAL, C, systems=[jm.LinearSystem([[1.0]], [[1.0]])])
    with pytest.raises(ValueError, match="Give vertices of one hull"):
        predecessor([VERTICES[0], jm.LinearSystem([[1.0]], [[1.0]])], C, X, U)
    with pytest.raises(ValueError, match="holds no system"):
        predecessor([], C, X, U)
