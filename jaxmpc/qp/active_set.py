"""Projected Newton steps on the dual, in the rows with a multiplier or a violation.

In ADMM's coordinates (H = I, rows of length one) the dual of min ½|w|² + q'w + g(A w) is

    max over y of −½ y'S y + v₀'y − g*(y),        S = A A',  v₀ = −A q,  w = −q − A'y,

piecewise quadratic, with a kink of g* at y_i = 0 and the row's value v = A w as part of its
gradient. Let W hold the rows with y_i ≠ 0 and those that are violated. A Newton step in W alone,

    (S_WW + Γ) d = v_W − b_W − Γ (y_W − sign·c),

with b the bound of each row that is active and Γ = 1/k for soft rows beyond it, needs one small
symmetric system of static size. y + t d, with rows that would change sign stopped at zero
(Bertsekas 1982, "Projected Newton methods for optimization problems with simple constraints"), is
tried for several t, among them the largest that stops no row; the one with the best dual value is
taken. So the dual value rises at each step; where the guess of W was right one step is exact. All
violated rows join W at first; where that does not end soon, one at a time, as in the dual method
of Goldfarb and Idnani (1983).
Where H is not the identity (P singular) or there are balls, nothing is done here.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.qp.batches import true_places
from jaxmpc.qp.linalg import solve
from jaxmpc.qp.precision import matmul
from jaxmpc.qp.projection import Bounds

# Most rows in W. In large batches on GPUs, where factorizations take most of the time, instances
# with few rows are worked off first.
MOST_ROWS, FEW_ROWS = 48, 16
# Step lengths that are tried, beside the largest that stops no row.
LENGTHS = (1.0, 0.5, 0.25, 0.0625)
# Ridge on S_WW, whose diagonal is 1, for linearly dependent rows: they share their multiplier.
RIDGE = 1e-11


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DualPoint:
    """Multipliers y (m,) with w = −q − A'y (n,)."""

    y: Array
    w: Array


def dual_point(A: Array, q: Array, bounds: Bounds, y: Array) -> DualPoint:
    """Return the point of multipliers y (m,), made admissible."""
    y = bounds.admissible(y)
    return DualPoint(y, -q - matmul(y, A))


def dual_step(
    A: Array, S: Array, bounds: Bounds, point: DualPoint, singly: Array, most: int
) -> tuple[DualPoint, Array]:
    """Take a step from `point`; A (m, n), S = A A'. singly: of the rows without multiplier that are
    violated only the one that is so most joins W. most: rows that W may hold; the first so many
    where there are more.

    Returns the new point, and whether W held all its rows.
    """
    y, v, soft = point.y, matmul(point.w, A.T), bounds.linear is not None
    noise = 1e-13 * (1 + jnp.max(jnp.abs(v), initial=0.0))
    outside = v - jnp.clip(v, bounds.l, bounds.u)
    outside = jnp.where(jnp.abs(outside) > noise, outside, 0.0)
    new = jnp.where(y == 0, jnp.abs(outside), 0.0)
    joins = (new > 0) & (new >= jnp.where(singly, jnp.max(new, initial=0.0), 0.0))
    sign = jnp.where(y != 0, jnp.sign(y), jnp.sign(outside))
    in_W = (y != 0) | joins
    columns = [y, sign, v - jnp.where(sign > 0, bounds.u, bounds.l), bounds.l == bounds.u]
    if soft:
        beyond = jnp.abs(y) >= bounds.linear
        # An L1 penalty that is paid in full stays so while its row is outside.
        in_W = in_W & ~(beyond & (bounds.quadratic == 0) & (sign * outside > 0))
        columns += [bounds.linear, bounds.quadratic, beyond]
    W = true_places(in_W, most)
    inside = W < len(y)
    table = jnp.stack([column.astype(y.dtype) for column in columns])
    y_W, sign_W, value, equal, *weights = table.at[:, W].get(mode="fill", fill_value=0.0)
    S_W = S.at[W[:, None], W[None, :]].get(mode="fill", fill_value=0.0)

    gradient, slack, added = value, jnp.zeros_like(y_W), lambda y: jnp.zeros_like(y)
    if soft:
        cap, stiff, beyond = weights
        capped, elastic = jnp.isfinite(cap), stiff > 0
        give = jnp.where(elastic, 1 / jnp.where(elastic, stiff, 1.0), 0.0)
        over = lambda y: jnp.maximum(jnp.abs(y) - jnp.where(capped, cap, jnp.inf), 0.0)
        slack = jnp.where(beyond > 0, give, 0.0)
        gradient = value - slack * sign_W * over(y_W)
        added = lambda y: 0.5 * give * over(y) ** 2
    d = solve(S_W + jnp.diag(jnp.where(inside, slack + RIDGE, 1.0)), gradient)

    stops = (equal == 0) & (sign_W * d < 0) & (sign_W * y_W > 0)
    first = jnp.min(jnp.where(stops, -y_W / jnp.where(stops, d, 1.0), 1.0), initial=1.0)
    t = jnp.append(jnp.asarray(LENGTHS, y.dtype), first)[:, None]
    moved = t * d
    moved = jnp.where((equal > 0) | (sign_W * (y_W + moved) > 0), moved, -y_W)
    if soft:
        top = jnp.where(elastic, jnp.inf, cap)
        moved = jnp.where(y_W + moved > top, top - y_W, jnp.maximum(moved, -top - y_W))
    # The loss of dual value: ½ δ'S δ − δ'(v − b) and the change of what soft rows add to g*.
    loss = moved * (0.5 * matmul(moved, S_W) - value) + added(y_W + moved) - added(y_W)
    loss = jnp.sum(loss, axis=1)
    # (An argmin in a float64 program cannot be lowered where 64-bit mode is off.)
    best = (loss <= jnp.min(loss)).astype(y.dtype)
    change = jnp.zeros_like(y).at[W].add(matmul(best / jnp.sum(best), moved), mode="drop")
    # −q − A'y would cancel where |w| is far below |q|; the change of w is as exact as that of y.
    moved_to = DualPoint(y + change, point.w - matmul(change, A))
    return moved_to, jnp.sum(in_W) <= most
