"""The linear-quadratic regulator, against closed forms and the Riccati equation."""

import math
from fractions import Fraction

import jax
import numpy as np
import pytest
from plants import JOINT, JOINT_LQR

from jaxmpc import LinearSystem, lqr
from jaxmpc.systems.riccati import cost_of_law, least_reached
from jaxmpc.systems.units import natural_units


def riccati_residual(system, Q, R, P):
    A, B = np.asarray(system.A, float), np.asarray(system.B, float)
    S = R + B.T @ P @ B
    return A.T @ P @ A - A.T @ P @ B @ np.linalg.solve(S, B.T @ P @ A) + Q - P


def test_rounding_of_derivatives_moves_no_unit():
    """An arm that feels no gravity: its A has entries of 1e-35 where there is nothing, by which
    the states alone act on each other. Inputs move all of it."""
    noise = 1e-35 * np.random.default_rng(0).normal(size=(4, 4))
    A = np.block([[np.eye(2), 0.01 * np.eye(2)], [np.zeros((2, 2)), np.eye(2)]]) + noise
    B = np.array([[2e-4, -6e-4], [-6e-4, 8e-2], [4e-2, -0.1], [-0.1, 13.0]])
    units = natural_units(A, B)
    np.testing.assert_array_equal(units.states, natural_units(A - noise, B).states)
    assert least_reached(A, B)[0] > 1e-3


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


@pytest.mark.long
@pytest.mark.parametrize("kind", ["random", "chain", "unmoved", "unseen"])
def test_units_decide_nothing(kind):
    """States, inputs and cost in units up to 2^40 apart: the same law, or the same error; the
    Kalman filter is the same of the dual system."""
    refused = 0
    traced = jax.jit(lambda *data: lqr(LinearSystem(*data[:2]), *data[2:]))
    cost = jax.jit(lambda *data: cost_of_law(LinearSystem(*data[:2]), *data[2:]))
    for seed in range(20):
        rng = np.random.default_rng(seed)
        n, m = 4, 2
        A, B = rng.normal(size=(n, n)) * rng.choice([0.4, 0.7]), rng.normal(size=(n, m))
        Q, R = np.diag(rng.uniform(0.1, 1, n)), np.diag(rng.uniform(0.1, 1, m))
        if kind == "chain":  # with entries of rounding in place of zeros
            A, B = np.eye(n) + 0.1 * np.eye(n, k=1), np.zeros((n, m))
            A, B[-1], Q = A + 1e-17 * rng.normal(size=A.shape), 0.1, np.diag([1.0, 0, 0, 0])
        if kind == "unmoved":
            A[-1], B[-1] = [0, 0, 0, rng.choice([0.5, 1.2])], 0
        if kind == "unseen":
            A[:-1, -1], A[-1, -1], Q[-1, -1] = 0, rng.choice([0.5, 1.2]), 0
        x, u = 2.0 ** rng.integers(-20, 21, n), 2.0 ** rng.integers(-20, 21, m)
        v = 2.0 ** rng.integers(-60, 61)
        other = (
            *(x[:, None] * A / x, x[:, None] * B / u),
            *(v * Q / x / x[:, None], v * R / u / u[:, None]),
        )
        try:
            law = lqr(LinearSystem(A, B), Q, R)
        except ValueError as error:
            refused += 1
            argument = str(error).split()[0]
            with pytest.raises(ValueError, match=f"^{argument} not (stabiliz|detect)able"):
                lqr(LinearSystem(*other[:2]), *other[2:])
            with jax.enable_x64(True):
                assert not np.any(np.isfinite(traced(*other).P))
            continue
        with jax.enable_x64(True):
            for found in (lqr(LinearSystem(*other[:2]), *other[2:]), traced(*other)):
                K, P = (np.asarray(v, float) for v in (found.K, found.P))
                np.testing.assert_allclose(u[:, None] ** -1 * K * x, law.K, rtol=1e-7, atol=1e-9)
                np.testing.assert_allclose(x[:, None] * P * x / v, law.P, rtol=1e-7, atol=1e-9)
            for call in (lambda A, B, *data: cost_of_law(LinearSystem(A, B), *data), cost):
                P = np.asarray(call(*other[:2], K, *other[2:]))
                np.testing.assert_allclose(x[:, None] * P * x / v, law.P, rtol=1e-7, atol=1e-9)
    assert (0 < refused < 20) == (kind in ("unmoved", "unseen"))


@pytest.mark.parametrize("inputs", [1, 2])
def test_traced_weights_far_apart(inputs):
    """The inverse of R, which the doubling begins with, is not used where B'QB is far above R."""
    A, B = np.diag([1.2, 0.9, 0.5]) + np.eye(3, k=1), np.ones((3, 1)) + 0.5 * np.eye(3, inputs)
    traced = jax.jit(lambda Q, R: lqr(LinearSystem(A, B), Q, R))
    for size in 10.0 ** np.arange(-14, 15, 4):
        Q, R = size * np.eye(3), np.diag([1.0, 3, 0.1][:inputs])
        law = lqr(LinearSystem(A, B), Q, R)
        with jax.enable_x64(True):
            found = traced(Q, R)
        np.testing.assert_allclose(found.P, law.P, rtol=0, atol=1e-9 * np.abs(law.P).max())
        np.testing.assert_allclose(found.K, law.K, rtol=0, atol=max(1e-9, 1e-15 * size))


@pytest.mark.parametrize("weak", [1e-7, 1e-12, 1e-17])
def test_weak_couplings_do_not_decide_units(weak):
    """Twelve states, three of which each input moves; everything acts weakly on everything."""
    rng = np.random.default_rng(0)
    chain = np.eye(3) + 0.1 * np.eye(3, k=1) + np.diag([0.0, 0.02, 0.05])
    A, B = np.kron(np.eye(4), chain), np.kron(np.eye(4), [[0.0], [0.0], [0.1]])
    plain = lqr(LinearSystem(A, B), np.eye(12), np.eye(4))
    A, B = A + weak * rng.normal(size=A.shape), B + weak * rng.normal(size=B.shape)
    found = lqr(LinearSystem(A, B), np.eye(12), np.eye(4))
    np.testing.assert_allclose(found.K, plain.K, rtol=0, atol=1e3 * weak + 1e-9)


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


def newton_step(A, B, Q, R, K):
    """The gain after a step of Newton's method from K, in rational numbers: its error is the square
    of that of K."""
    A, B, Q, R, K = (np.vectorize(lambda v: Fraction(float(v)))(M) for M in (A, B, Q, R, K))
    closed, n = A + B @ K, len(A)
    # P − closed'P closed = Q + K'R K, entry by entry, by elimination.
    rows = np.eye(n * n, dtype=int) - np.kron(closed.T, closed.T)
    rows = np.column_stack([rows, (Q + K.T @ R @ K).ravel()])
    for i in range(n * n):
        pivot = i + int(np.argmax(rows[i:, i] != 0))
        rows[[i, pivot]] = rows[[pivot, i]]
        rows[i] = rows[i] / rows[i, i]
        for k in set(range(n * n)) - {i}:
            rows[k] = rows[k] - rows[k, i] * rows[i]
    P = rows[:, -1].reshape(n, n)
    return (-(B.T @ P @ A) / (R + B.T @ P @ B)[0, 0]).astype(float)


@pytest.mark.parametrize("r", [1e-14, 1e-6, 1.0, 1e8, 1e10, 1e11, 1e12, 1e13, 1e14, 1e16])
def test_gains_of_weights_in_small_units(r):
    """An input in µN has R of 1e12 times that in N: K depends on Q/R alone."""
    A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.0], [0.1]])
    K = lqr(LinearSystem(A, B), np.eye(2), r).K
    np.testing.assert_allclose(K[0], newton_step(A, B, np.eye(2), [[r]], K)[0], rtol=1e-8)


def test_weights_of_any_size_are_no_matter_of_the_plant():
    system = LinearSystem([[1.0, 0.1], [0.0, 1.0]], [0.0, 0.1])
    K = lqr(system, np.eye(2), 0.1).K
    for c in (1e-280, 1e280):
        np.testing.assert_allclose(lqr(system, c * np.eye(2), 0.1 * c).K, K, rtol=1e-9)
    with pytest.raises(ValueError, match="^Q"):
        lqr(system, [1e-300, 1.0], 0.1)
