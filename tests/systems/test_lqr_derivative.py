"""`lqr` inside a trace: its value, and its derivative with respect to A, B, Q and R."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy

import jaxmpc as jm
from jaxmpc.systems.riccati import cost_of_law

RNG = np.random.default_rng(0)
N, M = 4, 2
A = RNG.normal(size=(N, N)) * 0.9
B = RNG.normal(size=(N, M))
Q, R = np.diag(RNG.uniform(0.1, 3.0, N)), np.array([[0.5, 0.1], [0.1, 0.3]])
DATA = (A, B, Q, R)


def law(A, B, Q, R):
    return jm.lqr(jm.LinearSystem(A, B), Q, R)


@pytest.fixture(scope="module")
def derivative():
    """P, K and their Jacobians with respect to A, B, Q, R at DATA, in reverse mode."""
    function = lambda *data: (law(*data).P, law(*data).K)
    with jax.enable_x64(True):
        both = lambda *data: (function(*data), jax.jacrev(function, (0, 1, 2, 3))(*data))
        return jax.tree.map(np.asarray, jax.jit(both)(*DATA))


@pytest.mark.long
def test_value_in_a_trace(derivative):
    (P, K), _ = derivative
    assert P.dtype == np.float64
    np.testing.assert_allclose(P, law(*DATA).P, rtol=1e-12)
    np.testing.assert_allclose(K, law(*DATA).K, rtol=1e-11)


@pytest.mark.slow
def test_both_modes_agree(derivative):
    with jax.enable_x64(True):
        forth = jax.jit(jax.jacfwd(lambda *d: (law(*d).P, law(*d).K), (0, 1, 2, 3)))(*DATA)
    back = derivative[1]
    for one, other in zip(jax.tree.leaves(back), jax.tree.leaves(forth), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("which", range(4), ids="ABQR")
def test_derivative_by_finite_differences_of_scipy(derivative, which):
    """Along five random directions, symmetric ones of Q and R."""
    (P, _), back = derivative
    for _ in range(5):
        V = RNG.normal(size=DATA[which].shape)
        V = V + V.T if which > 1 else V
        ends = []
        for step in (1e-6, -1e-6):
            data = list(DATA)
            data[which] = data[which] + step * V
            ends.append((scipy.linalg.solve_discrete_are(*data), law(*data).K))
        for part, jacobian in enumerate(back):
            moved = (ends[0][part] - ends[1][part]) / 2e-6
            found = np.tensordot(jacobian[which], V, 2)
            np.testing.assert_allclose(found, moved, rtol=1e-6, atol=1e-7 * np.abs(P).max())


def test_derivative_by_scipys_lyapunov_equation(derivative):
    """dP for all four at once, as an independent solver of the implicit equation has it."""
    (P, K), back = derivative
    dA, dB, dQ, dR = (RNG.normal(size=part.shape) for part in DATA)
    dQ, dR = dQ + dQ.T, dR + dR.T
    closed = A + B @ K
    F = closed.T @ P @ (dA + dB @ K)
    expected = scipy.linalg.solve_discrete_lyapunov(closed.T, dQ + K.T @ dR @ K + F + F.T)
    moves = zip(back[0], (dA, dB, dQ, dR), strict=True)
    found = sum(np.tensordot(jacobian, move, 2) for jacobian, move in moves)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


@pytest.mark.long
def test_batch_with_members_that_cannot_be_stabilised():
    """B = 0 on an unstable mode, or Q = 0 on a mode of size one: NaN, and no neighbour minds."""
    As = np.array([np.diag([1.2, 0.5]), np.diag([1.2, 0.5]), np.diag([1.0, 0.5])])
    Bs = np.array([[[1.0], [1.0]], [[0.0], [1.0]], [[1.0], [1.0]]])
    Qs = np.array([np.eye(2), np.eye(2), np.diag([0.0, 1.0])])
    one = jax.vmap(jax.value_and_grad(lambda *data: law(*data, jnp.eye(1)).P.sum(), (0, 1, 2)))
    with jax.enable_x64(True):
        value, gradients = jax.jit(one)(As, Bs, Qs)
    expected = law(As[0], Bs[0], Qs[0], np.eye(1)).P.sum()
    np.testing.assert_allclose(value, [expected, np.nan, np.nan], rtol=1e-12)
    for gradient in gradients:
        finite = np.isfinite(gradient).reshape(3, -1)
        np.testing.assert_array_equal(finite.all(axis=1), [True, False, False])
        np.testing.assert_array_equal(finite.any(axis=1), [True, False, False])


def test_slow_closed_loop_in_float32():
    """Computed in float64 and rounded, the regulator of a stiff sampled joint keeps its digits."""
    joint = jm.LinearSystem(np.array([[1, 1e-3], [0, 1]]), np.array([[0.0], [0.02]]))
    weights = np.diag([1e-3, 0.0]), np.eye(1)
    exact = jm.lqr(joint, *weights).P
    found = jax.jit(lambda Q: jm.lqr(joint, Q, weights[1]).P)(jnp.asarray(weights[0], jnp.float32))
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, exact, rtol=1e-5)


def test_terminal_cost_follows_the_weights_in_a_trace():
    """The make_mpc that `tune_weights` is given; shapes are checked there, values are not."""
    from dataclasses import replace

    mpc = jm.MPC(jm.LinearSystem(A, B), Q, R, horizon=3)
    make_mpc = lambda v: replace(
        mpc, Q=v["Q"], R=v["R"], terminal_cost=jm.lqr(mpc.system, v["Q"], v["R"]).P
    )
    weights = {"Q": Q, "R": R}
    with jax.enable_x64(True):
        made = jax.jit(make_mpc)(weights)
    np.testing.assert_allclose(made.terminal_cost, law(*DATA).P, rtol=1e-12)
    with pytest.raises(ValueError, match="Q: shape"):
        jax.jit(make_mpc)({"Q": np.eye(3), "R": R})


@pytest.mark.long
def test_invariant_ellipsoid_follows_the_weights_of_its_law():
    """Level and contraction in a trace as on the host, the level's derivative by differences."""
    joint = jm.LinearSystem(np.array([[1, 0.01], [0, 1]]), np.array([[0.0], [0.2]]))
    states = jm.Box(np.array([-1.5, -np.inf]), np.array([1.5, 2.0]))
    inputs = jm.Polytope(np.array([[1.0], [-2.0]]), np.array([2.0, 5.0]))

    def terminal(Q):
        found = jm.lqr(joint, Q, np.array([[0.1]]))
        return jm.sets.invariant_ellipsoid(joint, found.K, found.P, states, inputs)

    def level(Q):
        ellipsoid = terminal(Q)
        return ellipsoid.level, (ellipsoid.P, ellipsoid.contraction)

    weights = np.diag([50.0, 1.0])
    with jax.enable_x64(True):
        (value, rest), gradient = jax.jit(jax.value_and_grad(level, has_aux=True))(weights)
    ellipsoid = terminal(weights)
    np.testing.assert_allclose(value, ellipsoid.level, rtol=1e-12)
    np.testing.assert_allclose(rest[0], ellipsoid.P, rtol=1e-12)
    np.testing.assert_allclose(rest[1], ellipsoid.contraction, rtol=1e-12)
    for V in (np.diag([1.0, 0.0]), np.diag([0.0, 1.0]), np.array([[0.0, 1.0], [1.0, 0.0]])):
        ends = [terminal(weights + step * V).level for step in (1e-5, -1e-5)]
        np.testing.assert_allclose(
            np.sum(np.asarray(gradient) * V), (ends[0] - ends[1]) / 2e-5, rtol=1e-6
        )


def test_ellipsoids_that_are_not_invariant_have_no_level():
    """P that is no Lyapunov matrix, or limits that do not hold the origin: NaN in a trace."""
    system, limits = jm.LinearSystem([[0.5]], [[1.0]]), jm.Box([-1.0], [2.0])
    level = lambda k, p, low: (
        jm.sets.invariant_ellipsoid(system, [[k]], [[p]], jm.Box([low], [2.0]), limits).level
    )
    with jax.enable_x64(True):
        found = jax.jit(jax.vmap(level))(
            np.array([-0.5, 0.6, -0.5, -0.5]), np.array([2.0, 2.0, -2.0, 2.0]),
            np.array([-1.0, -1.0, -1.0, 0.1]),
        )  # fmt: skip
    np.testing.assert_allclose(found, [2.0, np.nan, np.nan, np.nan])
    with pytest.raises(ValueError, match="disturbance: given inside a trace"):
        jax.jit(lambda p: jm.sets.invariant_ellipsoid(system, [[-0.5]], p, limits, None, limits).P)(
            np.eye(1)
        )


def test_cost_of_a_law():
    """By summing the series; of the LQR's law it is P; traced as on the host, NaN if unstable."""
    K = law(*DATA).K * 0.95
    P = cost_of_law(jm.LinearSystem(A, B), K, Q, R)
    x, total = np.array([1.0, -0.5, 0.3, 2.0]), 0.0
    expected = x @ P @ x
    for _ in range(2000):
        total, x = total + x @ Q @ x + (K @ x) @ R @ (K @ x), (A + B @ K) @ x
    np.testing.assert_allclose(total, expected, rtol=1e-12)
    own = law(*DATA)
    np.testing.assert_allclose(cost_of_law(jm.LinearSystem(A, B), own.K, Q, R), own.P, rtol=1e-10)
    with jax.enable_x64(True):
        traced = jax.jit(jax.vmap(lambda K: cost_of_law(jm.LinearSystem(A, B), K, Q, R)))(
            np.array([K, -3 * K])
        )
    np.testing.assert_allclose(traced[0], P, rtol=1e-11)
    assert np.isnan(traced[1]).all()
    with pytest.raises(ValueError, match="K: A \\+ BK has spectral radius"):
        cost_of_law(jm.LinearSystem(A, B), -3 * K, Q, R)


def test_second_derivatives_in_all_modes():
    """Reverse over another mode was an error of JAX."""
    A, B = np.array([[1.1, 0.1], [0.0, 1.2]]), np.array([[0.0], [1.0]])
    gain = lambda t: jnp.sum(jm.lqr(jm.LinearSystem(A * (1 + t), B), jnp.eye(2), jnp.eye(1)).K ** 2)
    with jax.enable_x64(True):
        slope = jax.jit(jax.grad(gain))
        expected = (float(slope(1e-4)) - float(slope(-1e-4))) / 2e-4
        for one, other in itertools.product((jax.jacrev, jax.jacfwd), repeat=2):
            found = float(jax.jit(one(other(gain)))(0.0))
            np.testing.assert_allclose(found, expected, rtol=1e-5)
