"""Units of states, inputs and cost in which the numbers of a problem are about 1.

Tests of rank, of residuals and of convergence compare entries of one matrix with each other. In
these units none of those in which a user writes the problem decides them. All are powers of two,
so that changing to them and back rounds nothing.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.qp.linalg import namespace, solve

# Entries this many times smaller than 1 in the units found so far are rounding in place of zeros.
_ROUNDING = 2.0**-40
# So often the fit is repeated without them.
_AGAIN = 2
# Beside equations of weight 1: decides what no entry does.
_RIDGE = 1e-5
# Units are between 2^-_FARTHEST and its inverse.
_FARTHEST = 100


class Units(NamedTuple):
    """x = states·x', u = inputs·u' and V = cost·V', with states (n,), inputs (m,), cost ()."""

    states: Any
    inputs: Any
    cost: Any

    def system(self, A: Any, B: Any) -> tuple[Any, Any]:
        """Return A and B of x'+ = A x' + B u'."""
        return A * self.states / self.states[:, None], B * self.inputs / self.states[:, None]

    def weights(self, Q: Any, R: Any) -> tuple[Any, Any]:
        """Return Q and R of the cost V'."""
        x, u = self.states, self.inputs
        return Q * x * (x / self.cost)[:, None], R * u * (u / self.cost)[:, None]

    def gain(self, K: Any) -> Any:
        """Return K of u = K x, given that of u' = K x'."""
        return K * self.inputs[:, None] / self.states

    def cost_matrix(self, P: Any) -> Any:
        """Return P of V = x'P x, given that of V'."""
        return P / self.states * (self.cost / self.states)[:, None]


def natural_units(A: Any, B: Any, Q: Any = None, R: Any = None) -> Units:
    """Return units in which A (n, n), B (n, m) and the diagonals of Q and R, if given, are about 1.

    The least squares fit of the logarithms of all entries but zeros (Curtis & Reid 1972, J. Inst.
    Maths Applics 10) and those that are rounding. In NumPy, or traced: then constants to
    derivatives.
    """
    xp = namespace((A, B, Q, R))
    if xp is jnp:
        A, B, Q, R = jax.lax.stop_gradient((A, B, Q, R))
    (n, m), dtype = B.shape, A.dtype
    diagonals = (xp.zeros(k) if W is None else xp.diagonal(W) for W, k in ((Q, n), (R, m)))
    sizes = [xp.abs(M) for M in (A * (1 - np.eye(n)), B, *diagonals)]
    logs = [xp.log2(xp.where(size > 0, size, 1)) for size in sizes]
    every = Units(xp.ones(n, dtype), xp.ones(m, dtype), xp.ones((), dtype))
    tiny = xp.finfo(dtype).tiny

    def fit(least: Any, units: Units) -> Units:
        x, u, v = units
        scaled = *units.system(*sizes[:2]), sizes[2] * x * (x / v), sizes[3] * u * (u / v)
        a, b, q, r = weights = [(size > least).astype(dtype) for size in scaled]
        la, lb, lq, lr = (w * log for w, log in zip(weights, logs, strict=True))
        # Normal equations of log2|A_ij| + x_j − x_i = 0, log2|B_ij| + u_j − x_i = 0,
        # log2 Q_ii + 2 x_i − v = 0 and log2 R_jj + 2 u_j − v = 0.
        xx = xp.diag(a.sum(0) + a.sum(1) + b.sum(1) + 4 * q) - a - a.T
        uu = xp.diag(b.sum(0) + 4 * r)
        xv, uv = -2 * q[:, None], -2 * r[:, None]
        vv = (q.sum() + r.sum())[None, None]
        rows = [xx, -b, xv], [-b.T, uu, uv], [xv.T, uv.T, vv]
        G = xp.concatenate([xp.concatenate(row, axis=1) for row in rows], axis=0)
        by_x, by_u = la.sum(1) - la.sum(0) + lb.sum(1) - 2 * lq, -lb.sum(0) - 2 * lr
        g = xp.concatenate([by_x, by_u, (lq.sum() + lr.sum())[None]])
        G = G + _RIDGE * xp.eye(n + m + 1, dtype=dtype)
        z = (np.linalg.solve if xp is np else solve)(G, g[:, None])[:, 0]
        z = xp.ldexp(xp.ones_like(z), xp.clip(xp.round(z), -_FARTHEST, _FARTHEST).astype(int))
        return Units(z[:n], z[n:-1], z[-1])

    units = fit(tiny, every)
    if xp is np:
        for _ in range(_AGAIN):
            units = fit(_ROUNDING, units)
        return units
    return jax.lax.fori_loop(0, _AGAIN, lambda _, units: fit(_ROUNDING, units), units)


def less_identity(A: np.ndarray) -> np.ndarray:
    """Return A − I; a diagonal of A that differs from 1 by rounding counts as 1."""
    moves = A - np.eye(len(A))
    return np.where(np.abs(moves) <= 4 * np.finfo(float).eps * np.eye(len(A)), 0.0, moves)


def balanced(M: np.ndarray, sweeps: int = 10) -> tuple[np.ndarray, np.ndarray]:
    """Return powers of two (row, column) with which the largest entry of each row and column of
    row_i M_ij column_j is about 1.

    Each sweep divides rows and columns by the roots of their largest entries (Ruiz 2001, report
    RAL-TR-2001-034). Rows and columns of zeros keep the unit 1.
    """
    row, column = np.ones(M.shape[0]), np.ones(M.shape[1])
    for _ in range(sweeps):
        size = np.abs(row[:, None] * M * column)
        ends = size.max(axis=1, initial=0.0), size.max(axis=0, initial=0.0)
        each = [2.0 ** -np.round(np.log2(np.where(end > 0, end, 1.0)) / 2) for end in ends]
        row, column = row * each[0], column * each[1]
    return row, column
