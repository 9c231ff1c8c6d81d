"""The infinite-horizon linear-quadratic regulator in discrete time."""

from dataclasses import dataclass

import jax
import numpy as np
import scipy
from jax.typing import ArrayLike

from jaxmpc.checks import fail, require_shape, require_symmetric_psd
from jaxmpc.control.system import LinearSystem, host_array

# Modes closer than this to unreachable (least singular value, relative) count as such.
_UNREACHED = 1e-10


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class LQR:
    """The optimal law u = K x and its cost x'P x.

    K: (m, n), with the sign of u = K x; python-control and MATLAB return -K.
    P: (n, n), symmetric: the least cost from x is x'P x (no 1/2).
    """

    K: ArrayLike
    P: ArrayLike


def lqr(system: LinearSystem, Q: ArrayLike, R: ArrayLike) -> LQR:
    """Minimise sum over k >= 0 of x_k'Q x_k + u_k'R u_k subject to x+ = A x + B u.

    P solves the discrete algebraic Riccati equation
        P = Q + A'PA - A'PB (R + B'PB)^-1 B'PA,
    and the optimal law is u = K x with K = -(R + B'PB)^-1 B'PA. python-control (`dlqr`)
    and MATLAB write u = -K x: their K has the other sign.

    Arguments:
        system: its c is not used: with an equilibrium x = A x + B u + c, the law holds for
            the deviations from it.
        Q: (n, n), symmetric positive semidefinite.
        R: (m, m), symmetric positive definite.

    Host, float64. Raises ValueError if Q or R is not as above, or if a mode that does not
    decay by itself cannot be moved by u (not stabilizable) or costs nothing (not
    detectable). The message names its eigenvalue.

    Source: Anderson & Moore 1990, Optimal Control: Linear Quadratic Methods, chapter 2;
    Arnold & Laub 1984, Proc. IEEE 72(12), for the solver.
    """
    system.validate()
    n, m = system.n, system.m
    require_shape("Q", Q, (n, n), "Give one weight matrix for the states")
    require_shape("R", R, (m, m), "Give one weight matrix for the inputs")
    A, B = host_array("A", system.A), host_array("B", system.B)
    Q, R = host_array("Q", Q), host_array("R", R)
    require_symmetric_psd("Q", Q)
    require_symmetric_psd("R", R, definite=True)
    Q, R = (Q + Q.T) / 2, (R + R.T) / 2
    weights, axes = np.linalg.eigh(Q)
    output = np.sqrt(np.maximum(weights, 0.0))[:, None] * axes.T  # Q = output'output
    control, control_mode = least_reached(A, B)
    cost, cost_mode = least_reached(A.T, output.T)
    unmoved = ("B", f"does not move the mode with eigenvalue {control_mode}", "Actuate it")
    unseen = ("Q", f"puts no weight on the mode with eigenvalue {cost_mode}", "Give it some")
    if control <= _UNREACHED:
        fail(unmoved[0], f"not stabilizable: {unmoved[1]}", unmoved[2])
    if cost <= _UNREACHED:
        fail(unseen[0], f"not detectable: {unseen[1]}", unseen[2])
    try:
        P = _refine(A, B, Q, R, scipy.linalg.solve_discrete_are(A, B, Q, R))
        K = _gain(A, B, R, P)
        radius = np.abs(np.linalg.eigvals(A + B @ K)).max()
    except (np.linalg.LinAlgError, ValueError):
        radius = np.inf
    if not radius < 1:  # too near the edge for the test above: name the likelier cause
        argument, problem, cure = unmoved if control <= cost else unseen
        fail(argument, f"hardly {problem}, so the Riccati equation was not solved", cure)
    return LQR(K=K, P=P)


def _gain(A: np.ndarray, B: np.ndarray, R: np.ndarray, P: np.ndarray) -> np.ndarray:
    return -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)


def _refine(
    A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray, P: np.ndarray
) -> np.ndarray:
    """Up to two steps of the Riccati recursion, each kept only if the residual shrinks.

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


def least_reached(A: np.ndarray, B: np.ndarray) -> tuple[float, str]:
    """How far the modes that do not decay are from unreachable, and the worst eigenvalue.

    Popov-Belevitch-Hautus: all are reached if [A - s I, B] has full row rank at every
    eigenvalue |s| >= 1. The distance is its least singular value, B scaled to norm 1.
    """
    B = B / max(np.linalg.norm(B, 2), np.finfo(np.float64).tiny)
    # A k-fold eigenvalue is computed as a ring of radius eps^(1/k); its mean is accurate.
    computed = np.linalg.eigvals(A)
    means = [computed[np.abs(computed - s) < 1e-4].mean() for s in computed]
    worst, mode = np.inf, "none"
    for s in np.concatenate([computed, means]):
        if abs(s) < 1 - 1e-12:
            continue
        test = np.hstack([A - s * np.eye(len(A)), B])
        least = np.linalg.svd(test, compute_uv=False)[-1] / max(1.0, np.linalg.norm(A, 2))
        if least < worst:
            worst = float(least)
            mode = f"{s.real:.6g}" if s.imag == 0 else f"{s.real:.6g}{s.imag:+.6g}j"
    return worst, mode
