"""Sentences of docs/limits.md that can be tested, each beside what it says."""

import re
from pathlib import Path

import jax
import numpy as np
import pytest
import scipy.sparse

import jaxmpc as jm
from jaxmpc.workflow.offline_checks import theorems

TEXT = " ".join((Path(__file__).resolve().parents[1] / "docs" / "limits.md").read_text().split())
DOUBLE = jm.LinearSystem([[1.0, 1.0], [0.0, 1.0]], [0.5, 1.0])


def problem(**changes):
    given = dict(system=DOUBLE, horizon=3, states=jm.Box([-5, -5], [5, 5]), inputs=jm.Box(-1, 1))
    given |= changes
    return jm.MPC(given.pop("system"), [1.0, 1.0], 1.0, **given)


def says(sentence):
    """The page says what the test is about."""
    assert " ".join(sentence.split()) in TEXT, sentence


def test_critical_regions_go_up_to_six_states():
    says("`critical_regions` go up to six states")
    chain = jm.LinearSystem(0.9 * np.eye(7), np.ones((7, 1)))
    box = jm.Box(-np.ones(7), np.ones(7))
    mpc = jm.MPC(chain, np.ones(7), 1.0, horizon=1, states=box, inputs=jm.Box(-1, 1))
    with pytest.raises(ValueError, match="7"):
        jm.explicit.critical_regions(mpc)


def test_an_ellipsoidal_terminal_set_stays_hard():
    says("An ellipsoidal terminal set stays hard: it cannot be softened, and has no exact penalty.")
    mpc = problem(terminal_set=jm.Ellipsoid(np.eye(2), 1.0))
    with pytest.raises(ValueError, match="terminal_set"):
        jm.soften(mpc, 10.0)
    with pytest.raises(ValueError, match="terminal_set"):
        jm.explicit.exact_penalty(mpc)


def test_matrices_are_dense():
    says("P and A are dense.")
    made = jm.QP(scipy.sparse.eye_array(2), [1, 1], np.eye(2), [0, 0], [1, 1]).dense().P
    assert type(made) is np.ndarray and np.array_equal(made, np.eye(2))


W = jm.Box([-0.1, -0.1], [0.1, 0.1])
STEPS = jm.LinearSystem(np.stack([DOUBLE.A] * 3), np.stack([DOUBLE.B] * 3))
REFUSED = {
    "where a problem has outputs that depend on inputs, rates or blocked moves": [
        lambda: theorems(problem(input_rate_limit=0.5)),
        lambda: theorems(problem(control_horizon=2)),
        lambda: theorems(problem(outputs=jm.Outputs([[1.0, 0.0]], upper=4.0, D=[[1.0]]))),
    ],
    "Explicit laws and `OffsetFreeController` are those of `policy=": [
        lambda: jm.explicit.critical_regions(problem(disturbance=W, policy="affine")),
        lambda: jm.explicit.critical_regions(problem(disturbance=W, policy="tube")),
    ],
    "`solve_stagewise` takes no tubes, and of affine policies Boxes and Zonotopes": [
        lambda: jm.mpc.solve_stagewise(problem(disturbance=W, policy="tube"), [0, 0]),
        lambda: jm.mpc.solve_stagewise(
            problem(disturbance=jm.sets.Zonotope([0, 0], [[1, 0, 1], [0, 1, 1]]), policy="affine"),
            [0, 0],
        ),
    ],
    "Tubes take no control horizon": [
        lambda: jm.solve(problem(disturbance=W, policy="tube", control_horizon=2), [0, 0]),
    ],
    "Terminal sets are polytopes": [
        lambda: problem(disturbance=W, terminal_set=jm.Ellipsoid(np.eye(2), 1.0)).validate(),
    ],
    "steady states, observers and disturbances refuse it": [
        lambda: jm.recursive_feasibility(problem(system=STEPS)),
        lambda: jm.workflow.offline_report(problem(system=STEPS)),
        lambda: problem(system=STEPS, disturbance=W).validate(),
    ],
}


@pytest.mark.parametrize("sentence", REFUSED, ids=lambda sentence: sentence[:40])
def test_what_is_not_taken_is_refused(sentence):
    """By an error that names the argument."""
    says(sentence)
    for call in REFUSED[sentence]:
        with pytest.raises(ValueError, match=r"^[\w.]+: "):
            call()


def test_an_invariant_set_has_no_derivative():
    says("A terminal set of `maximal_invariant_set` has no derivative")
    law = jm.lqr(DOUBLE, [1.0, 1.0], 1.0)
    limits = problem()

    def volume(K):
        return jm.maximal_invariant_set(DOUBLE, K, limits.states, limits.inputs).h.sum()

    with pytest.raises((ValueError, TypeError, jax.errors.JAXTypeError)):
        jax.grad(volume)(law.K)


def test_offset_free_control_has_one_linear_model():
    says('a RobotController with `linearize="set-point"`')
    plant = jm.LinearPlant(
        jm.LinearSystem(DOUBLE.A, DOUBLE.B, dt=0.1), jm.Box([-5.0, -5], [5.0, 5]), jm.Box(-1, 1)
    )
    controller = jm.RobotController(plant, jm.robot_mpc(plant, horizon=3), linearize="state")
    observer = jm.closed_loop.KalmanFilter(
        plant, 0.1, 0.1, C=[[1.0, 0]], disturbance=jm.closed_loop.Disturbance("input", 0.1)
    )
    with pytest.raises(ValueError, match="set-point"):
        jm.closed_loop.OffsetFreeController(controller, observer)


def test_jax_has_an_upper_bound():
    says("have an upper bound of `jax`")
    project = (Path(__file__).resolve().parents[1] / "pyproject.toml").read_text()
    assert re.search(r'"jax>=[\d.]+,<[\d.]+"', project)


@pytest.mark.slow
def test_a_terminal_point():
    """The feasible set of x_N = 0 is the image of the box of inputs: a zonotope, by hand."""
    says("2 of 441 points on a grid, which lie on the boundary, stay undecided")
    mpc = problem(horizon=10, states=None, terminal_set=jm.Box([0.0, 0], [0.0, 0]))
    points = jm.grid([-10, -5], [10, 5], (21, 21))
    label = np.asarray(jm.map_feasible_set(mpc, points).label)
    A, B = np.asarray(DOUBLE.A), np.asarray(DOUBLE.B)
    back = np.linalg.inv(A)
    G = np.hstack([np.linalg.matrix_power(back, k + 1) @ B for k in range(10)])
    # Beyond a facet of {G w : |w| <= 1}, whose normals are those of its generators.
    normals = np.stack([-G[1], G[0]], axis=1)
    beyond = (np.abs(points @ normals.T) - np.abs(normals @ G).sum(axis=1)).max(axis=1)
    assert np.all(label[beyond > 1e-6] == -1) and np.all(label[beyond < -1e-6] == 1)
    assert np.all(np.abs(beyond[label == 0]) <= 1e-6)


@pytest.mark.slow
def test_without_bounds_some_points_stay_undecided():
    says("Without either some points stay undecided")
    free = problem(states=jm.Box([-1.0, -np.inf], [1.0, np.inf]), inputs=None)
    label = np.asarray(jm.map_feasible_set(free, jm.grid([-2, -9], [2, 9], (9, 9))).label)
    assert np.all(label[np.abs(jm.grid([-2, -9], [2, 9], (9, 9))[:, 0]) > 1] <= 0)


@pytest.mark.slow
def test_stagewise_proves_no_infeasibility():
    says("`solve_stagewise` proves no infeasibility")
    plan = jm.mpc.solve_stagewise(problem(), np.array([4.9, 4.9]))
    assert plan.status == jm.Status.ITERATION_LIMIT
    assert jm.solve(problem(), np.array([4.9, 4.9])).status == jm.Status.PRIMAL_INFEASIBLE
