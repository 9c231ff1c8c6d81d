"""Minimal robust invariant sets: published numbers, and invariance by supports alone."""

import itertools

import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.sets import minimal_robust_invariant_set
from jaxmpc.sets.disturbances import supports, with_vertices
from jaxmpc.sets.minimal_invariant import sum_of_disturbances

RAKOVIC = jm.LinearSystem([[-0.17, -0.03], [-1.17, -0.03]], np.zeros((2, 1)))
DOUBLE = jm.LinearSystem([[1.0, 1.0], [0.0, 1.0]], [0.5, 1.0])
THREE = jm.LinearSystem([[1, 0.2, -1], [0, 1, -0.2], [0, 0, 0.6]], [0, 0, 0.6])
OFF = np.zeros((1, 2))


def test_what_is_no_set_of_disturbances_is_named():
    system = jm.LinearSystem([[1, 1], [0, 1]], [0.5, 1.0])
    K = jm.lqr(system, np.eye(2), [[0.1]]).K
    small = minimal_robust_invariant_set(system, K, jm.Box([-0.1, -0.1], [0.1, 0.1]))
    for W, message in (
        (jm.Box([-np.inf] * 2, [np.inf] * 2), "disturbance: is unbounded. Bound every"),
        (small, "disturbance: is a MinimalInvariantSet. Give a Box, a Polytope or a Zonotope"),
    ):
        with pytest.raises(ValueError, match=message):
            minimal_robust_invariant_set(system, K, W)
        with pytest.raises(ValueError, match=message):
            jm.MPC(system, np.eye(2), [[0.1]], 2, disturbance=W).validate()


def test_numbers_of_rakovic_2005():
    found = minimal_robust_invariant_set(RAKOVIC, OFF, jm.Box(-1.0, 1.0), 2e-5)
    assert found.steps == 10
    np.testing.assert_allclose(found.alpha, 1.91907e-5, atol=5e-11)
    assert 0 <= found.alpha - float(found.exact_alpha) < 2e-12
    half = np.array([
        (1.29, 2.56), (1.29, 0.56), (0.95, -1.78), (0.938, -1.852), (0.9022, -2.0158),
        (0.898, -2.032), (0.77, -2.5), (0.71, -2.56),
    ])  # fmt: skip
    four = sum_of_disturbances(RAKOVIC.A, np.eye(2), jm.Box([-1, -1], [1, 1]), 4).vertices()
    expected = np.concatenate([half, -half])
    assert len(four) == 16
    distance = np.abs(four[:, None] - expected).max(axis=2)
    assert distance.min(axis=0).max() < 1e-12 and distance.min(axis=1).max() < 1e-12


def cases():
    triangle = jm.Polytope([[1, 1], [-1, 1], [0, -1]], [0.1, 0.1, 0.1])
    skewed = jm.sets.Zonotope([0.01, 0], [[0.1, 0.05], [0, 0.1]])
    lqr = lambda system, R: jm.lqr(system, np.eye(system.n), R).K
    return {
        "volume": (RAKOVIC, OFF, jm.Box(-1.0, 1.0), None),
        "polytope": (DOUBLE, lqr(DOUBLE, 0.01), triangle, None),
        "zonotope": (DOUBLE, lqr(DOUBLE, 1.0), skewed, None),
        "flat": (DOUBLE, lqr(DOUBLE, 1.0), jm.Box(-0.1, 0.2), [0.5, 1.0]),
        "origin on its boundary": (DOUBLE, lqr(DOUBLE, 1.0), jm.Box([0.0, 0.0], [0.1, 0.1]), None),
        "three states": (THREE, lqr(THREE, 0.1), jm.Box(-5.0, 5.0), None),
        "none": (DOUBLE, lqr(DOUBLE, 1.0), jm.Box(0.0, 0.0), None),
    }  # fmt: skip


@pytest.mark.parametrize("name", cases())
def test_it_is_invariant_and_close(name):
    """h_F(A_K'd) + h_W(E'd) ≤ h_F(d) for many d, and along coordinates F is as close as asked."""
    system, K, W, E = cases()[name]
    found = minimal_robust_invariant_set(system, K, W, 1e-3, disturbance_matrix=E)
    n = system.n
    d = np.concatenate([np.eye(n), -np.eye(n), np.random.default_rng(0).normal(size=(200, n))])
    E = np.eye(n) if E is None else np.reshape(E, (n, -1))
    closed = np.asarray(system.A) + np.asarray(system.B) @ np.asarray(K)
    W = with_vertices(W.spread(E.shape[1]) if isinstance(W, jm.Box) else W)
    pushed = found.supports(d @ closed) + supports(W, d @ E)
    own = found.supports(d)
    assert np.all(pushed <= own + 1e-11 * np.abs(own).max())
    least, along = np.zeros(len(d)), d
    for _ in range(3000):
        least, along = least + supports(W, along @ E), along @ closed
    assert np.all(least <= own + 1e-12)
    assert np.all(own[: 2 * n] <= (1 + 1e-3) * least[: 2 * n] + 2e-3 * np.abs(least).max())
    moved = least[: 2 * n] > 0
    assert np.all(own[: 2 * n][moved] <= (1 + found.excess) * least[: 2 * n][moved] * (1 + 1e-6))
    assert found.excess <= 1e-3 or name == "none"


def test_loops_that_others_did_not_end():
    """Mayne, Seron & Raković 2005 and HiroIshida/robust-tube-mpc #14: volumes of sums."""
    K = np.asarray(jm.lqr(DOUBLE, [1.0, 1.0], 0.01).K)
    closed = np.asarray(DOUBLE.A) + np.asarray(DOUBLE.B) @ K
    found = sum_of_disturbances(closed, np.eye(2), jm.Box([-0.1] * 2, [0.1] * 2), 8)
    np.testing.assert_allclose(found.volume(), 0.161310373, rtol=1e-8)
    closed = np.asarray(THREE.A) + np.asarray(THREE.B) @ np.asarray(
        jm.lqr(THREE, [1, 1, 0.1], 0.1).K
    )
    G = np.hstack([5 * np.linalg.matrix_power(closed, i) for i in range(20)])
    exact = 8 * sum(
        abs(np.linalg.det(G[:, c])) for c in map(list, itertools.combinations(range(60), 3))
    )
    found = sum_of_disturbances(closed, np.eye(3), jm.Box([-5.0] * 3, [5.0] * 3), 20)
    np.testing.assert_allclose(found.volume(), exact, rtol=1e-9)


def test_slow_loops_and_bad_arguments():
    slow = jm.LinearSystem.from_continuous([[0.0, 1], [0, 0]], [[0.0], [1]], 0.01)
    K = jm.lqr(slow, [1.0, 1.0], 100.0).K
    with pytest.raises(ValueError, match="K: A .* some .* steps are needed"):
        minimal_robust_invariant_set(slow, K, jm.Box(-0.1, 0.1), max_steps=50)
    with pytest.raises(ValueError, match="spectral radius 1, which is not below 1"):
        minimal_robust_invariant_set(DOUBLE, OFF, jm.Box(-0.1, 0.1))
    with pytest.raises(ValueError, match="disturbance: does not hold the origin"):
        minimal_robust_invariant_set(RAKOVIC, OFF, jm.Box(0.1, 0.2))
    with pytest.raises(ValueError, match="eps: 2"):
        minimal_robust_invariant_set(RAKOVIC, OFF, jm.Box(-0.1, 0.1), 2.0)
    with pytest.raises(ValueError, match="disturbance_matrix: shape"):
        minimal_robust_invariant_set(
            RAKOVIC, OFF, jm.Box(-0.1, 0.1), disturbance_matrix=np.ones((3, 1))
        )


def test_maximal_sets_take_the_matrix_of_disturbances():
    """E W as a polytope of its own gives the same sets."""
    E, W = np.array([[0.5, 0.1], [1.0, 0.0]]), jm.Box([-0.1, -0.2], [0.1, 0.2])
    EW = W.to_zonotope().image(E).to_polytope()
    X, U, K = jm.Box([-5.0, -2.0], [5.0, 2.0]), jm.Box(-1.0, 1.0), jm.lqr(DOUBLE, np.eye(2), 0.1).K
    one = jm.maximal_invariant_set(DOUBLE, K, X, U, disturbance=W, disturbance_matrix=E)
    two = jm.maximal_invariant_set(DOUBLE, K, X, U, disturbance=EW)
    np.testing.assert_allclose(one.volume(), two.volume(), rtol=1e-9)
    find = jm.sets.maximal_control_invariant_set
    one = find(DOUBLE, X, U, disturbance=W, disturbance_matrix=E)
    two = find(DOUBLE, X, U, disturbance=EW)
    assert one.exact
    np.testing.assert_allclose(one.volume(), two.volume(), rtol=1e-9)
    last = jm.maximal_invariant_set(DOUBLE, K, X, U, disturbance=W, disturbance_matrix=E)
    report = jm.sets.verify_terminal(DOUBLE, np.eye(2), 0.1, None, last, X, U, K, W, E)
    assert report["invariance under K"].holds and report.exact_factor is not None


FLAT = {
    # x2 is moved by nothing; x3 only where x1 and x2 differ, which disturbances do not make.
    "exogenous": ([[0.5, 0.2], [0.0, 0.9]], [1.0, 0.0]),
    "cancelling": ([[0.5, 0, 0], [0, 0.5, 0], [0.3, -0.3, 0.4]], [1.0, 1.0, 0.0]),
}


@pytest.mark.parametrize("name", FLAT)
@pytest.mark.parametrize("unit", [1e3, 1.0, 1e-3, 1e-6])
def test_units_of_what_disturbances_do_not_move(name, unit):
    """Decide nothing: the set has no extent there but for what makes it invariant."""
    A, e = (np.array(v) for v in FLAT[name])
    n = len(A)
    scale = np.append(np.ones(n - 1), unit)
    system = jm.LinearSystem(A * scale[:, None] / scale, np.zeros((n, 1)))
    found = minimal_robust_invariant_set(
        system, np.zeros((1, n)), jm.Box(-1.0, 1.0), disturbance_matrix=e * scale
    )
    assert found.excess <= 1e-3
    last = found.bounding_box().upper[-1] / unit
    assert last == 0 if name == "exogenous" else 0 < last < 5e-3
    normals = np.vstack([np.eye(n), -np.eye(n), np.random.default_rng(0).normal(size=(50, n))])
    normals = normals / scale
    after = found.supports(normals @ np.asarray(system.A)) + np.abs(normals @ (e * scale))
    assert np.all(after <= found.supports(normals) * (1 + 1e-9) + 1e-12)
    assert found.exact_alpha is not None and found.exact_alpha <= found.alpha
