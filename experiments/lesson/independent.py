"""A second way to everything: QPs of MPC problems built entry by entry, and solved by others.

Nothing here uses jaxmpc. Matrices come from explicit loops over powers of A; the solvers are
OSQP (operator splitting, in C) and an active-set method on SciPy's non-negative least squares.
The problem: min Σ_{k<N} (x_k−r)'Q(x_k−r) + u_k'R u_k + (x_N−r)'P(x_N−r) with x⁺ = Ax + Bu.
"""

from typing import NamedTuple

import numpy as np
import scipy


class Condensed(NamedTuple):
    """min ½z'Hz + f'z + constant subject to l ≤ Gz ≤ u in the inputs z = (u_0, …, u_{N−1})."""

    H: np.ndarray
    f: np.ndarray
    G: np.ndarray
    l: np.ndarray
    u: np.ndarray
    constant: float

    def cost(self, z: np.ndarray) -> float:
        """J of the inputs z."""
        return float(0.5 * z @ self.H @ z + self.f @ z + self.constant)

    def one_sided(self) -> tuple[np.ndarray, np.ndarray]:
        """(G, h) of the same rows written G z ≤ h, the form of solvers such as ojAlgo."""
        G, h = np.vstack([self.G, -self.G]), np.concatenate([self.u, -self.l])
        return G[np.isfinite(h)], h[np.isfinite(h)]


def condense(
    A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray, P: np.ndarray, N: int,
    x0: np.ndarray, x_max: np.ndarray, u_max: np.ndarray, reference: np.ndarray,
    constrained: range,
) -> Condensed:  # fmt: skip
    """States eliminated: x_k = A^k x0 + Σ_{j<k} A^(k−1−j) B u_j, with |x_k| ≤ x_max for k in
    `constrained` and |u_k| ≤ u_max. Rows: inputs step by step, then states step by step."""
    n, m = B.shape
    free = [np.linalg.matrix_power(A, k) @ x0 for k in range(N + 1)]
    forced = np.zeros((N + 1, n, N * m))
    for k in range(N + 1):
        for j in range(k):
            forced[k, :, j * m : (j + 1) * m] = np.linalg.matrix_power(A, k - 1 - j) @ B
    H, f, constant = np.kron(np.eye(N), 2 * R), np.zeros(N * m), 0.0
    for k in range(N + 1):
        W, error = (P if k == N else Q), free[k] - reference
        H += 2 * forced[k].T @ W @ forced[k]
        f += 2 * forced[k].T @ W @ error
        constant += error @ W @ error
    G, l, u = [np.eye(N * m)], [-np.tile(u_max, N)], [np.tile(u_max, N)]
    for k in constrained:
        G.append(forced[k])
        l.append(-x_max - free[k])
        u.append(x_max - free[k])
    return Condensed(H, f, np.vstack(G), np.concatenate(l), np.concatenate(u), float(constant))


class Stacked(NamedTuple):
    """min ½z'Hz + f'z subject to Gz ≤ h, Ez = b (the lesson's section 2), z = (u_0, …, u_{N−1},
    x_0, …, x_N). Rows of G: for each step u ≤ u_max and −u ≤ u_max, then the same for x."""

    H: np.ndarray
    f: np.ndarray
    G: np.ndarray
    h: np.ndarray
    E: np.ndarray
    b: np.ndarray


def stack(
    A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray, P: np.ndarray, N: int,
    x0: np.ndarray, x_max: np.ndarray, u_max: np.ndarray, constrained: range,
) -> Stacked:  # fmt: skip
    """Inputs and states as variables, the dynamics as equalities: E z = b says x_0 = x0 and
    x_{k+1} − A x_k − B u_k = 0. Regulation to the origin."""
    n, m = B.shape
    at_u = lambda k: slice(k * m, (k + 1) * m)
    at_x = lambda k: slice(N * m + k * n, N * m + (k + 1) * n)
    size = N * m + (N + 1) * n
    H, E, b = np.zeros((size, size)), np.zeros(((N + 1) * n, size)), np.zeros((N + 1) * n)
    b[:n], E[:n, at_x(0)] = x0, np.eye(n)
    for k in range(N):
        H[at_u(k), at_u(k)], H[at_x(k), at_x(k)] = 2 * R, 2 * Q
        rows = slice((k + 1) * n, (k + 2) * n)
        E[rows, at_x(k + 1)], E[rows, at_x(k)], E[rows, at_u(k)] = np.eye(n), -A, -B
    H[at_x(N), at_x(N)] = 2 * P
    G, h = [], []
    for place, limit in [(at_u(k), u_max) for k in range(N)] + [
        (at_x(k), x_max) for k in constrained
    ]:
        for sign in (1.0, -1.0):
            row = np.zeros((len(limit), size))
            row[:, place] = sign * np.eye(len(limit))
            G.append(row)
            h.append(limit)
    return Stacked(H, np.zeros(size), np.vstack(G), np.concatenate(h), E, b)


def active_set(H: np.ndarray, f: np.ndarray, G: np.ndarray, h: np.ndarray) -> np.ndarray:
    """argmin ½z'Hz + f'z subject to Gz ≤ h, H ≻ 0, to about machine precision.

    With H = LL' and v = L'z + L⁻¹f this is min |v| subject to Mv ≥ d, M = −G L⁻ᵀ and
    d = −h − G H⁻¹f; Lawson & Hanson 1974, chapter 23: v = −r/r_last with r the residual of the
    non-negative least squares problem min |[M'; d'] y − (0, …, 0, 1)|, y ≥ 0. Infeasible iff
    r = 0. Rows without z (the limits on x_0) are only checked, to 1e-9: a rounding of 1e-16
    makes them infeasible. Raises ValueError if the program is.
    """
    constant = ~G.any(axis=1)
    if np.any(h[constant] < -1e-9):
        raise ValueError("QP infeasible: a row without variables is violated")
    G, h = G[~constant], h[~constant]
    L = np.linalg.cholesky(H)
    shift = scipy.linalg.solve_triangular(L, f, lower=True)
    M = -scipy.linalg.solve_triangular(L, G.T, lower=True).T
    d = -h + M @ shift
    target = np.append(np.zeros(len(f)), 1.0)
    E = np.vstack([M.T, d])
    y, _ = scipy.optimize.nnls(E, target, maxiter=100 * len(h))
    r = E @ y - target
    if np.linalg.norm(r) < 1e-9:
        raise ValueError("QP infeasible")
    return scipy.linalg.solve_triangular(L, -r[:-1] / r[-1] - shift, lower=True, trans="T")


def osqp(qp: Condensed, tolerance: float = 1e-11) -> np.ndarray:
    """argmin by OSQP 1.x at a tight tolerance."""
    import osqp

    solver = osqp.OSQP()
    solver.setup(
        P=scipy.sparse.csc_matrix(np.triu(qp.H)), q=qp.f,
        A=scipy.sparse.csc_matrix(qp.G), l=qp.l, u=qp.u,
        eps_abs=tolerance, eps_rel=tolerance, max_iter=200_000, verbose=False,
    )  # fmt: skip
    result = solver.solve(raise_error=False)
    if result.info.status_val != 1:
        raise ValueError(f"OSQP: {result.info.status}")
    return np.asarray(result.x)
