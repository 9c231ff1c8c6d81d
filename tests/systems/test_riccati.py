"""The linear-quadratic regulator, against closed forms and the Riccati equation."""

import math

import numpy as np
import pytest

from jaxmpc import LinearSystem, lqr

# A robot joint (inertia 0.05, 10 ms) and the double integrator of MPT3's test suite, with
# O_inf of their LQR from an exact rational recursion.
JOINT = LinearSystem(np.array([[1, 0.01], [0, 1]]), np.array([[0], [0.2]]), dt=0.01)


JOINT_LQR = (JOINT, np.diag([50.0, 1.0]), np.array([[0.1]]))


def riccati_residual(system, Q, R, P):
    A, B = np.asarray(system.A, float), np.asarray(system.B, float)
    S = R + B.T @ P @ B
    return A.T @ P @ A - A.T @ P @ B @ np.linalg.solve(S, B.T @ P @ A) + Q - P


def test_lqr_of_the_joint():
    law = lqr(*JOINT_LQR)
    np.testing.assert_allclose(law.K, [[-15.838825731024865, -2.649704251932495]], rtol=1e-12)
    P = [[836.4585534716418, 15.783998400228846], [15.783998400228846, 2.4826921099685366]]
    np.testing.assert_allclose(law.P, P, rtol=1e-12)
    eigenvalues = np.sort(np.linalg.eigvals(JOINT.A + JOINT.B @ law.K))
    np.testing.assert_allclose(eigenvalues, [0.5387347079226628, 0.9313244416908382], rtol=1e-11)


def test_lqr_scalar_closed_form():
    # p = q + a²p - a²b²p²/(r + b²p), a quadratic in p.
    a, b, q, r = 2.0, 0.5, 3.0, 0.7
    s = r * (1 - a**2) - q * b**2
    p = (-s + math.sqrt(s**2 + 4 * b**2 * q * r)) / (2 * b**2)
    law = lqr(LinearSystem([[a]], [[b]]), [[q]], [[r]])
    assert law.P[0, 0] == pytest.approx(p, rel=1e-14)
    assert law.K[0, 0] == pytest.approx(-a * b * p / (r + b**2 * p), rel=1e-14)


@pytest.mark.parametrize("seed", range(5))
def test_lqr_satisfies_the_riccati_equation(seed):
    rng = np.random.default_rng(seed)
    A, B = rng.standard_normal((6, 6)), rng.standard_normal((6, 2))
    Q, R = np.diag(rng.random(6)), np.eye(2)
    law = lqr(LinearSystem(A, B, c=np.ones(6)), Q, R)
    assert np.abs(riccati_residual(LinearSystem(A, B), Q, R, law.P)).max() <= 1e-12 * law.P.max()
    K = -np.linalg.solve(R + B.T @ law.P @ B, B.T @ law.P @ A)
    np.testing.assert_allclose(law.K, K, rtol=1e-12)
    np.testing.assert_array_equal(law.P, law.P.T)
    # x'Px is the cost of the law: sum it up.
    x = x0 = rng.standard_normal(6)
    cost = 0.0
    for _ in range(3000):
        u = law.K @ x
        cost, x = cost + x @ Q @ x + u @ R @ u, A @ x + B @ u
    assert cost == pytest.approx(x0 @ law.P @ x0, rel=1e-10)


TURN = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])


TILT = np.array([[1.0, 0.3, -0.7], [0.2, -1.1, 0.5], [0.9, 0.4, 1.3]])


JORDAN = TILT @ [[1, 1, 0], [0, 1, 0], [0, 0, 0.5]] @ np.linalg.inv(TILT)


@pytest.mark.parametrize(
    ("A", "B", "Q", "R", "message"),
    [
        (JOINT.A, JOINT.B, -np.eye(2), np.eye(1), "Q: is not positive semidefinite"),
        (JOINT.A, JOINT.B, [[1, 1], [0, 1]], np.eye(1), "Q: is triangular, not symmetric"),
        (JOINT.A, JOINT.B, np.eye(3), np.eye(1), "Q: shape"),
        (JOINT.A, JOINT.B, np.eye(2), [[0]], "R: is not positive definite"),
        (JOINT.A, JOINT.B, np.eye(2), np.eye(2), "R: shape"),
        (np.diag([2, 0.5]), [[0], [1]], np.eye(2), np.eye(1), "B: not stab.*eigenvalue 2"),
        (TURN, [[0], [0]], np.eye(2), np.eye(1), r"eigenvalue 0.955336[+-]0.29552j"),
        (JORDAN, TILT @ [[1], [0], [1]], np.eye(3), np.eye(1), "B: not stab.*eigenvalue 1"),
        (np.diag([2, 0.5]), [[1], [1]], np.diag([0, 1]), np.eye(1), "Q: not detect.*value 2"),
        (np.eye(2), np.eye(2), np.diag([0, 1]), np.eye(2), "Q: not detectable.*eigenvalue 1"),
        (np.ones((2, 3)), JOINT.B, np.eye(2), np.eye(1), "A: shape"),
    ],
)
def test_lqr_errors(A, B, Q, R, message):
    with pytest.raises(ValueError, match=message):
        lqr(LinearSystem(A, B), Q, R)


def test_lqr_leaves_decaying_modes_alone():
    law = lqr(LinearSystem(np.diag([0.5, 1.2]), [[0], [1]]), np.diag([0, 1]), np.eye(1))
    assert law.K[0, 0] == 0 and law.P[0, 0] == 0
