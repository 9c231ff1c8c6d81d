"""Units of states, inputs and cost in which the numbers of a problem are about 1.

Tests of rank, of residuals and of convergence compare entries of one matrix with each other. In
these units none of those in which a user writes the problem decides them. All are powers of two,
so that changing to them and back rounds nothing.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.qp.jax_transformations import varying
from jaxmpc.qp.linalg import namespace

# Entries this much smaller than others of their row and of their column are rounding: couplings
# of 1e-16 one way and 1 the other way are of 1e-8 both ways.
_ROUNDING = 2.0**-25
_SWEEPS = 40
# Parts of a sum that leave it as it is, and time steps within which inputs move states.
_LOST, _STEPS = 2.0**-52, 10
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
    """Return units in which A (n, n), B (n, m) and the diagonals of Q and R are balanced.

    Of each state the largest entry by which it acts on other states and on the cost is made equal
    to the largest by which it is acted on; inputs and the cost have a largest entry of 1 (Osborne
    1960, J. ACM 7(4), in the maximum norm). Small entries have no influence. In NumPy, or traced:
    then constants to derivatives.
    """
    xp = namespace((A, B, Q, R))
    if xp is jnp:
        A, B, Q, R = jax.lax.stop_gradient((A, B, Q, R))
    (n, m), dtype = B.shape, A.dtype
    others, B, itself = xp.abs(A) * (1 - np.eye(n)), xp.abs(B), xp.abs(xp.diagonal(A))
    others = xp.where(_lost(xp, others, B), 0, others)
    roots = [
        xp.zeros(k, dtype) if W is None else xp.sqrt(xp.abs(xp.diagonal(W)))
        for W, k in ((Q, n), (R, m))
    ]

    def logs_of(*parts: Any) -> tuple[Any, Any]:
        """Return log2 of the largest entries of rows, and where there are any but zeros."""
        most = xp.max(xp.concatenate(parts, axis=1), axis=1, initial=0.0)
        return xp.log2(xp.where(most > 0, most, 1)), most > 0

    def sweep(parts: Any, logs: Any) -> Any:
        A, B = parts
        x, u, v = logs
        A, B = A * xp.exp2(x) / xp.exp2(x)[:, None], B * xp.exp2(u) / xp.exp2(x)[:, None]
        costs = [root * xp.exp2(w - v) for root, w in zip(roots, (x, u), strict=True)]
        given, moved = logs_of(A, B)
        gives, acts = logs_of(A.T, costs[0][:, None])
        # Half of the way, for others move too; where one of the two is nothing the other becomes 1.
        x = x + (given - gives) / xp.where(moved & acts, 4, 2)
        u = u - logs_of(B.T, costs[1][:, None])[0]
        v = v + logs_of(xp.concatenate(costs)[None])[0][0]
        return tuple(xp.clip(w, -_FARTHEST, _FARTHEST) for w in (x, u, v))

    def settled(parts: Any, logs: Any) -> Any:
        if xp is np:
            for _ in range(_SWEEPS):
                logs = sweep(parts, logs)
            return logs
        logs = varying(logs, (A, B, Q, R))
        return jax.lax.fori_loop(0, _SWEEPS, lambda _, logs: sweep(parts, logs), logs)

    logs = settled((others, B), (xp.zeros(n, dtype), xp.zeros(m, dtype), xp.zeros((), dtype)))
    x, u, _ = (xp.exp2(w) for w in logs)
    a, b = others * x / x[:, None], B * u / x[:, None]
    rows = xp.maximum(xp.max(xp.concatenate([a, b], axis=1), axis=1, initial=0.0), itself)
    acts = xp.maximum(a.max(axis=0), itself)
    kept = others * (a > _ROUNDING * xp.minimum(rows[:, None], acts))
    x, u, v = settled((kept, B * (b > _ROUNDING * rows[:, None])), logs)
    whole = lambda w: xp.ldexp(xp.ones_like(w), xp.round(w).astype(int))
    return Units(whole(x), whole(u), whole(2 * v))


def _lost(xp: Any, A: Any, B: Any) -> Any:
    """Return which entries (n, n) are lost to rounding, whatever the units: by which no input moves
    a state by a part of what it moves it by otherwise. A, B are of absolute values."""
    moved = B
    for _ in range(min(len(A), _STEPS)):
        moved = xp.maximum(moved, A @ moved)
    reached = (moved > 0).any(axis=1)
    through = A[:, :, None] * moved[None]
    return reached[:, None] & reached & (through <= _LOST * moved[:, None]).all(axis=2)


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
