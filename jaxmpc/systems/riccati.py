"""The infinite-horizon linear-quadratic regulator in discrete time."""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax import Array

from jaxmpc.arrays import Reals, as_weight, host_array
from jaxmpc.checks import concrete, fail, require_kind, require_shape, require_symmetric_psd
from jaxmpc.pytrees import pytree
from jaxmpc.qp.jax_transformations import kept_whole, own_modes, varying
from jaxmpc.qp.linalg import arrays, floating_dtype, in_float64, matmul, solve, solve_general
from jaxmpc.systems.system import LinearSystem
from jaxmpc.systems.units import natural_units

NO_LQR = (
    "Put a positive weight on every direction, or do without the LQR "
    '(P = "Q", terminal = "none" in files)'
)

# Modes closer than this to unreachable (least singular value, relative) count as such.
UNREACHED = 1e-10
# Doublings at most: 2^40 steps of a loop with spectral radius 1 - 1e-10 leave 1e-48.
_DOUBLINGS = 40
# Relative residual of the Riccati equation, or step of Newton's method, above which P is none.
_RESIDUAL = 1e-6
# Steps of Newton's method at most; from a stabilizing gain a few will do. Traced they are so many.
_NEWTON, _TRACED_NEWTON = 20, 3


@pytree
class LQR:
    """The optimal law u = K x and its cost x'P x.

    K: (m, n), with the sign of u = K x; python-control and MATLAB return -K.
    P: (n, n), symmetric: the least cost from x is x'P x (no 1/2).
    """

    K: Reals
    P: Reals


def lqr(system: LinearSystem, Q: Reals, R: Reals) -> LQR:
    """Minimise sum over k >= 0 of x_k'Q x_k + u_k'R u_k subject to x+ = A x + B u.

    P solves the discrete algebraic Riccati equation
        P = Q + A'PA - A'PB (R + B'PB)^-1 B'PA,
    and the optimal law is u = K x with K = -(R + B'PB)^-1 B'PA. python-control (`dlqr`)
    and MATLAB write u = -K x: their K has the other sign.

    Arguments:
        system: its c is not used: with an equilibrium x = A x + B u + c, the law holds for
            the deviations from it.
        Q: (n, n), symmetric positive semidefinite; or its diagonal (n,), or a number for n = 1.
        R: (m, m), symmetric positive definite; or its diagonal (m,), or a number for m = 1.

    Computed by NumPy in float64. Raises ValueError if Q or R is not as above, or if a mode that
    does not decay by itself cannot be moved by u (not stabilizable) or costs nothing (not
    detectable). The message names its coordinates and its eigenvalue.

    Under `jit`, `vmap` and `grad`, where any of A, B, Q, R is traced, K and P are JAX arrays in
    the dtype of the data (computed in float64 nevertheless), differentiable in both modes and
    any number of times with respect to all four. Data without a stabilizing solution give NaN
    there. With K held at its optimum (which moves P to second order only) a change of data
    moves P by the solution of the Lyapunov equation
        dP = Acl'dP Acl + dQ + K'dR K + F + F',    F = Acl'P (dA + dB K),    Acl = A + BK.

    Source: Anderson & Moore 1990, Optimal Control: Linear Quadratic Methods, chapter 2;
    Arnold & Laub 1984, Proc. IEEE 72(12), for the solver in NumPy; Chu, Fan, Lin & Wang 2004,
    Int. J. Control 77(8), for the doubling algorithm in a trace; Kao & Hennequin 2020,
    arXiv:2011.11430, for the derivative.
    """
    require_kind("system", system, LinearSystem)
    system = replace(system, c=None)
    system.validate()
    n, m = system.n, system.m
    Q, R = as_weight(Q, n), as_weight(R, m)
    require_shape("Q", Q, (n, n), "Give one weight matrix for the states")
    require_shape("R", R, (m, m), "Give one weight matrix for the inputs")
    if not concrete(system.A, system.B, Q, R):
        require_symmetric_psd("Q", Q)
        require_symmetric_psd("R", R, definite=True, cure=NO_LQR)
        return _traced(system.A, system.B, Q, R)
    A, B = host_array("A", system.A), host_array("B", system.B)
    q, r = host_array("Q", Q), host_array("R", R)
    require_symmetric_psd("Q", q)
    require_symmetric_psd("R", r, definite=True, cure=NO_LQR)
    units, moved = natural_units(A, B, q, r), _rank_tests(*natural_units(A, B).system(A, B))
    A, B = units.system(A, B)
    q, r = units.weights(q / 2 + q.T / 2, r / 2 + r.T / 2)
    weights, axes = np.linalg.eigh(q)
    output = np.sqrt(np.maximum(weights, 0.0))[:, None] * axes.T  # q = output'output
    seen = _rank_tests(A.T, output.T)
    (control, _), (cost, _) = _least(moved), _least(seen)
    unmoved = f"does not move {_described(moved, system.state_names)}"
    unseen = f"puts no weight on {_described(seen, system.state_names)}"
    if control <= UNREACHED:
        fail("B", f"not stabilizable: {unmoved}", "Actuate that")
    if cost <= UNREACHED:
        fail("Q", f"not detectable: {unseen}", "Give it some")
    # SciPy's matrices hold Q and R beside A: beyond 1 they hide its digits.
    scale = 2.0 ** np.round(np.log2(max(np.abs(q).max(), np.abs(r).max())))
    q, r = q / scale, r / scale
    try:
        with np.errstate(all="ignore"):
            P = scipy.linalg.solve_discrete_are(A, B, q, r)
        P = _refine(A, B, q, r, _newton(A, B, q, r, P))
        K = _gain(A, B, r, P)
        radius = spectral_radius(A + B @ K)
    except (np.linalg.LinAlgError, ValueError):
        radius = np.inf
    if not radius < 1:  # too close to the threshold for the test above: name the likelier cause
        rest = "so the Riccati equation was not solved"
        if min(control, cost) > 1e-6:
            ratio = f"Q is {np.abs(q).max() / np.abs(r).max():.1e} of R in natural units, {rest}"
            fail("Q, R", f"are too far apart for float64: {ratio}", "Give weights nearer together")
        if control <= cost:
            fail("B", f"hardly {unmoved}, {rest}", "Actuate that")
        fail("Q", f"hardly {unseen}, {rest}", "Give it some")
    return LQR(K=units.gain(K), P=units.cost_matrix(scale * P))


def spectral_radius(M: np.ndarray) -> float:
    """Return the largest modulus of an eigenvalue of M (n, n), or of matrices (..., n, n)."""
    return float(np.abs(np.linalg.eigvals(M)).max())


def require_stable(argument: str, closed: np.ndarray) -> float:
    """Return the spectral radius of A + BK (n, n); ValueError, which names the gain K, where it is
    not below 1."""
    radius = spectral_radius(closed)
    if not radius < 1:
        cure = "Use a stabilizing K with u = Kx (python-control's K has the other sign)"
        what = f"A + BK has spectral radius {radius:.9g}, which is not below 1"
        fail(argument, what, cure)
    return radius


def cost_of_law(system: LinearSystem, K: Reals, Q: Reals, R: Reals) -> Array | np.ndarray:
    """Return P with x'P x = sum over k >= 0 of x_k'Q x_k + u_k'R u_k under u = K x.

    P = (A+BK)'P(A+BK) + Q + K'RK: as terminal cost it falls by the stage cost along u = K x, which
    is what stability requires (Rawlings, Mayne & Diehl 2017, assumption 2.14) of any K; in a
    terminal set where K keeps the limits it need not be the LQR's. Computed in NumPy in float64,
    or traced as `lqr` is (NaN where A + BK is not stable). Raises ValueError for wrong shapes, and
    outside traces if the spectral radius of A + BK is not below 1.
    """
    system.validate()
    n, m = system.n, system.m
    for name, value, shape in (("K", K, (m, n)), ("Q", Q, (n, n)), ("R", R, (m, m))):
        require_shape(name, value, shape, "u = Kx, and one weight for each pair")
    data = (system.A, system.B, K, Q, R)
    if concrete(*data):
        a, b, k, q, r = (host_array("system, K, Q, R", part) for part in data)
        closed = a + b @ k
        units = natural_units(a, b, q, r)
        closed, _ = units.system(closed, b)
        require_stable("K", closed)
        cost, _ = units.weights(q + k.T @ r @ k, r)
        P = scipy.linalg.solve_discrete_lyapunov(closed.T, cost)
        return units.cost_matrix((P + P.T) / 2)
    dtype = floating_dtype(tuple(jnp.asarray(part) for part in data))
    A, B, gain, W, V = (jnp.asarray(part, dtype) for part in data)
    units = natural_units(A, B, W, V)
    loop, _ = units.system(A + matmul(B, gain), B)
    stage, _ = units.weights(W + matmul(gain.T, matmul(V, gain)), V)
    cost = _solve_lyapunov(loop, stage)
    _, left = _power_sum(jax.lax.stop_gradient(loop), jnp.zeros_like(W))
    return jnp.where(left < 1e-3, units.cost_matrix((cost + cost.T) / 2), jnp.nan)


def _gain(A: np.ndarray, B: np.ndarray, R: np.ndarray, P: np.ndarray) -> np.ndarray:
    """Return K = -(R + B'PB)^-1 B'PA in NumPy."""
    return -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)


def _newton(
    A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray, P: np.ndarray
) -> np.ndarray:
    """Take steps of Newton's method from P while each is less than half as long as the one before:
    the cost of the gain of P (Kleinman 1968, IEEE TAC 13). LinAlgError where they do not end."""
    P, before = (P + P.T) / 2, np.inf
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", scipy.linalg.LinAlgWarning)
        for _ in range(_NEWTON):
            K = _gain(A, B, R, P)
            closed = A + B @ K
            if not spectral_radius(closed) < 1:
                break
            newer = scipy.linalg.solve_discrete_lyapunov(closed.T, Q + K.T @ R @ K)
            step = np.abs(newer - P).max()
            if not step < before / 2:
                break
            P, before = (newer + newer.T) / 2, step
    if not before <= _RESIDUAL * np.abs(P).max():
        raise np.linalg.LinAlgError("Newton's method does not converge")
    return P


def _refine(
    A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray, P: np.ndarray
) -> np.ndarray:
    """Take up to two steps of the Riccati recursion, each kept only if the residual shrinks.

    With K the gain of P and Acl = A + BK, the right-hand side of the Riccati equation is
    Acl'P Acl + Q + K'RK, a sum of semidefinite terms: no digits cancel. The residual it
    leaves contracts like the square of the closed loop.
    """

    def recursion(P: np.ndarray) -> np.ndarray:
        K = _gain(A, B, R, P)
        P = (A + B @ K).T @ P @ (A + B @ K) + Q + K.T @ R @ K
        return (P + P.T) / 2

    P = (P + P.T) / 2
    newer = recursion(P)
    for _ in range(2):
        newest = recursion(newer)
        if not np.abs(newest - newer).max() < np.abs(newer - P).max():
            break
        P, newer = newer, newest
    return P


@own_modes
def _traced(*data: Reals) -> LQR:
    """Return K and P for traced A, B, Q, R."""
    values = tuple(jnp.asarray(v) for v in data)  # lists of traced numbers
    dtype = floating_dtype(values)
    A, B, Q, R = (v.astype(dtype) for v in arrays(values))
    units = natural_units(A, B, Q, R)
    A, B = units.system(A, B)
    Q, R = units.weights((Q + Q.T) / 2, (R + R.T) / 2)
    P = _solution(A, B, Q, R)
    return LQR(K=units.gain(_traced_gain(A, B, R, P)), P=units.cost_matrix(P))


def _traced_gain(A: Array, B: Array, R: Array, P: Array) -> Array:
    """Return K = -(R + B'PB)^-1 B'PA in JAX."""
    BtP = matmul(B.T, P)
    return -solve(R + matmul(BtP, B), matmul(BtP, A))


@jax.custom_jvp
def _solution(A: Array, B: Array, Q: Array, R: Array) -> Array:
    """Return P of the Riccati equation, NaN where no stabilizing one is found."""
    double = A.dtype == jnp.float64
    return (_doubling if double else in_float64(_doubling))(A, B, Q, R)


@_solution.defjvp
@own_modes
def _solution_jvp(data: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Array, Array]:
    A, B, Q, R = data
    dA, dB, dQ, dR = tangents
    P = kept_whole(_solution)(A, B, Q, R)
    K = _traced_gain(A, B, R, P)
    closed = A + matmul(B, K)
    F = matmul(matmul(closed.T, P), dA + matmul(dB, K))
    dP = _solve_lyapunov(closed, dQ + matmul(K.T, matmul(dR, K)) + F + F.T)
    return P, dP * jnp.where(jnp.isfinite(P), 1.0, jnp.nan)  # no number without a solution


def _doubling(A: Array, B: Array, Q: Array, R: Array) -> Array:
    """Solve the Riccati equation by the structure-preserving doubling algorithm.

    Step k holds the data (A_k, G_k, H_k) of 2^k steps of the Hamiltonian recursion at once, with
    G_0 = B R^-1 B' and H_0 = Q: H_k is the cost of 2^k steps with no cost at their end, A_k goes
    to 0 and H_k to P, both quadratically. Steps of Newton's method make up for what R is given.
    """

    def double(carry: tuple[Array, ...]) -> tuple[Array, ...]:
        k, A, G, H, _ = carry
        W = jnp.eye(A.shape[0], dtype=A.dtype) + matmul(G, H)
        WA, WG = jnp.split(solve_general(W, jnp.concatenate([A, G], axis=1)), 2, axis=1)
        grown = matmul(A.T, matmul(H, WA))
        G, H_next = G + matmul(A, matmul(WG, A.T)), H + grown
        return k + 1, matmul(A, WA), (G + G.T) / 2, (H_next + H_next.T) / 2, H

    def unfinished(carry: tuple[Array, ...]) -> Array:
        k, *_, H, before = carry
        return (k < _DOUBLINGS) & (_size(H - before) > jnp.finfo(H.dtype).eps * _size(H))

    # Where R is far below B'QB, its inverse is not for computing with, so R has a least part.
    least = jnp.sqrt(jnp.finfo(Q.dtype).eps) * _size(B) ** 2 * _size(Q)
    held = R + least * jnp.eye(R.shape[0], dtype=R.dtype)
    G = matmul(B, solve(held, B.T))
    start: tuple[Array, ...] = (jnp.asarray(0), A, G, Q, jnp.full_like(Q, jnp.inf))
    P = jax.lax.while_loop(unfinished, double, varying(start, start))[3]

    def cost(K: Array) -> tuple[Array, Array]:
        closed = A + matmul(B, K)
        P, left = _power_sum(closed, Q + matmul(K.T, matmul(R, K)))
        return (P + P.T) / 2, left

    newton = lambda _, K: _traced_gain(A, B, R, cost(K)[0])  # as in `_newton`
    K = jax.lax.fori_loop(0, _TRACED_NEWTON, newton, _traced_gain(A, B, held, P))
    before, _ = cost(K)
    P, left = cost(_traced_gain(A, B, R, before))
    good = (_size(P - before) <= _RESIDUAL * _size(P)) & (left < 1e-3)
    return jnp.where(good, P, jnp.nan)


def _size(M: Array) -> Array:
    return jnp.max(jnp.abs(M))


def _power_sum(M: Array, S: Array) -> tuple[Array, Array]:
    """Return the sum over k of (M')^k S M^k, by doubling, and the size of the power of M that is
    left."""

    def double(carry: tuple[Array, ...]) -> tuple[Array, ...]:
        k, M, X = carry
        return k + 1, matmul(M, M), X + matmul(M.T, matmul(X, M))

    def unfinished(carry: tuple[Array, ...]) -> Array:  # below eps one more term changes nothing
        return (carry[0] < _DOUBLINGS) & (_size(carry[1]) > jnp.finfo(M.dtype).eps)

    start: tuple[Array, ...] = (jnp.asarray(0), M, S)
    _, M, X = jax.lax.while_loop(unfinished, double, varying(start, start))
    return X, _size(M)


def _solve_lyapunov(M: Array, S: Array) -> Array:
    """Return the solution X of X = M'X M + S, for M with spectral radius below 1."""

    def residual(X: Array) -> Array:
        return X - matmul(M.T, matmul(X, M))

    return jax.lax.custom_linear_solve(
        residual,
        S,
        solve=lambda _, S: _power_sum(M, S)[0],
        transpose_solve=lambda _, S: _power_sum(M.T, S)[0],
    )


class _RankTest(NamedTuple):
    """The left singular vectors and values of [A - s I, B] at an eigenvalue s, B scaled to norm 1
    and the values by max(1, |A|)."""

    eigenvalue: complex
    vectors: np.ndarray
    values: np.ndarray


def least_reached(A: np.ndarray, B: np.ndarray) -> tuple[float, str]:
    """Return how far the modes that do not decay are from uncontrollable, and the worst eigenvalue;
    (inf, "none") if all decay.

    Popov-Belevitch-Hautus: all are reached if [A - s I, B] has full row rank at every
    eigenvalue |s| >= 1. The distance is its least singular value, in `natural_units`.
    """
    return _least(_rank_tests(*natural_units(A, B).system(A, B)))


def _rank_tests(A: np.ndarray, B: np.ndarray) -> list[_RankTest]:
    """Return a test for each eigenvalue |s| >= 1."""
    B = B / max(np.linalg.norm(B, 2), np.finfo(np.float64).tiny)
    # A k-fold eigenvalue is computed as a ring of radius eps^(1/k); its mean is accurate.
    computed = np.linalg.eigvals(A)
    means = [computed[np.abs(computed - s) < 1e-4].mean() for s in computed]
    size, tests = max(1.0, np.linalg.norm(A, 2)), []
    for s in np.unique(np.concatenate([computed, means])):
        if abs(s) >= 1 - 1e-12:
            vectors, values, _ = np.linalg.svd(np.hstack([A - s * np.eye(len(A)), B]))
            tests.append(_RankTest(complex(s), vectors, values / size))
    return tests


def _least(tests: list[_RankTest]) -> tuple[float, str]:
    if not tests:
        return np.inf, "none"
    s, _, values = min(tests, key=lambda test: test.values[-1])
    text = f"{s.real:.6g}" if s.imag == 0 else f"{s.real:.6g}{s.imag:+.6g}j"
    return float(values[-1]), text


def _described(tests: list[_RankTest], names: Sequence[str], most: int = 6) -> str:
    """Return the unreached modes in words: the coordinates in which a left null vector of a test,
    or of the test that comes nearest to one, has more than a tenth of its largest entry."""
    least, mode = _least(tests)
    unreached = [test.vectors[:, test.values <= max(UNREACHED, least)] for test in tests]
    entries = np.abs(np.hstack(unreached)) if tests else np.zeros((0, 1))
    large = np.any(entries > 0.1 * entries.max(axis=0, initial=0.0), axis=1)
    found = [names[i] if names else f"coordinate {i}" for i in np.flatnonzero(large).tolist()]
    more = f" and {len(found) - most} more" if len(found) > most else ""
    return f"{', '.join(found[:most]) or 'a mode'}{more} (eigenvalue {mode})"
