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

The steps see nothing but the `Dual` and a `DualPoint`: the loop of `dual_search.py` and the kernel
of `dual_kernel.py` are made of them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.pytrees import pytree
from jaxmpc.qp.batched_loops import true_places
from jaxmpc.qp.linalg import solve
from jaxmpc.qp.precision import matmul
from jaxmpc.qp.projection import Bounds, sign

# Most rows in W.
MOST_ROWS = 48
# Steps in which all violated rows join W.
JOINTLY = 2
# Step lengths that are tried, beside the largest that stops no row.
LENGTHS = (1.0, 0.5, 0.25, 0.0625)
# Ridge on S_WW, whose diagonal is 1, for linearly dependent rows: they share their multiplier.
RIDGE = 1e-11
# Violations relative to the largest row that count as rounding.
NOISE = 1e-13
# Distance from the optimum at which the steps end that is rounding of the largest multiplier.
ROUNDING = 1e-15


@pytree
class Dual:
    """What the steps need of a program in ADMM's coordinates: rows A (m, n), S = A A' (m, m), its
    bounds, and the size of multipliers from which on the dual seems unbounded."""

    A: Array
    S: Array
    bounds: Bounds
    limit: Array


class MostSteps(NamedTuple):
    """Steps of a search on the dual at most, and of a second one where that does not get there."""

    first: int
    more: int


@pytree
class DualPoint:
    """Multipliers y (m,) with w = −q − A'y (n,) and the rows v = A w (m,)."""

    y: Array
    w: Array
    v: Array

    @classmethod
    def of(cls, A: Array, q: Array, bounds: Bounds, y: Array) -> "DualPoint":
        """Return the point of multipliers y (m,), made admissible."""
        y = bounds.admissible(y)
        w = -q - matmul(y, A)
        return cls(y, w, matmul(w, A.T))

    @classmethod
    def cold(cls, A: Array, q: Array) -> "DualPoint":
        """Return the point without multipliers."""
        return cls(jnp.zeros(len(A), q.dtype), -q, -matmul(q, A.T))

    def moved(self, A: Array, change: Array) -> "DualPoint":
        """Return the point y + change. (−q − A'y would cancel where |w| is far below |q|; the
        change of w is as exact as that of y.)"""
        return self.shifted(A, -matmul(change, A), self.y + change)

    def shifted(self, A: Array, change: Array, y: Array | None = None) -> "DualPoint":
        """Return the point with w + change, and with other multipliers where given."""
        w = self.w + change
        return DualPoint(self.y if y is None else y, w, matmul(w, A.T))


def most_rows(A: Array) -> int:
    """Return the number of rows that W may hold: no more than n are independent."""
    return min(*A.shape, MOST_ROWS)


def dual_step(dual: Dual, point: DualPoint, singly: Array) -> tuple[DualPoint, Array]:
    """Take a step from `point`. singly: of the rows without multiplier that are violated only the
    one that is so most joins W. Where W would have more than `most_rows`, it has the first of them.

    Returns the new point, and whether W held all its rows.
    """
    bounds, y, v, most = dual.bounds, point.y, point.v, most_rows(dual.A)
    in_W = working_set(bounds, y, v, singly)
    W = true_places(in_W, most)
    inside = W < len(y)
    y_W, v_W, *rest = jnp.stack([y, v, *bounds.columns]).at[:, W].get(mode="fill", fill_value=0.0)
    rows = WorkingRows(Bounds.of_rows(rest), y_W, v_W)
    S_W = dual.S.at[W[:, None], W[None, :]].get(mode="fill", fill_value=0.0)
    d = solve(S_W + jnp.diag(jnp.where(inside, rows.slack + RIDGE, 1.0)), rows.gradient)
    t = jnp.append(jnp.asarray(LENGTHS, y.dtype), jnp.min(rows.stops(d), initial=1.0))
    moved = jax.vmap(lambda t: rows.moved(t * d))(t)
    loss = jnp.sum(jax.vmap(rows.loss)(moved, matmul(moved, S_W)), axis=1)
    # (An argmin in a float64 program cannot be lowered where 64-bit mode is off.)
    best = (loss <= jnp.min(loss)).astype(y.dtype)
    change = jnp.zeros_like(y).at[W].add(matmul(best / jnp.sum(best), moved), mode="drop")
    return point.moved(dual.A, change), jnp.sum(in_W) <= most


def working_set(bounds: Bounds, y: Array, v: Array, singly: Array) -> Array:
    """Return which rows are in W (m,)."""
    new = jnp.where(y == 0, jnp.abs(violation(bounds, v)), 0.0)
    least = jnp.where(singly, jnp.max(new, initial=0.0), 0.0)
    return joins(bounds, y, v, NOISE * (1 + jnp.max(jnp.abs(v), initial=0.0)), least)


def violation(bounds: Bounds, v: Array) -> Array:
    """Return by how much each row is outside its interval, with its sign."""
    return v - jnp.clip(v, bounds.l, bounds.u)


def joins(bounds: Bounds, y: Array, v: Array, noise: Array, least: Array) -> Array:
    """Return which rows have a multiplier or are violated, by more than `noise` and `least` at
    least."""
    outside = violation(bounds, v)
    in_W = (y != 0) | ((jnp.abs(outside) > noise) & (jnp.abs(outside) >= least))
    if bounds.linear is not None:
        # An L1 penalty that is paid in full stays so while its row is outside.
        paid = (jnp.abs(y) >= bounds.linear) & (bounds.quadratic == 0)
        in_W = jnp.where(paid & (jnp.abs(outside) > noise) & (y * outside > 0), False, in_W)
    return in_W


class WorkingRows(NamedTuple):
    """The rows of W: their bounds, multipliers y and values v, (k,) each."""

    bounds: Bounds
    y: Array
    v: Array

    @property
    def sign(self) -> Array:
        """That of the multiplier, or of the violation where there is none yet."""
        outside = violation(self.bounds, self.v)
        return jnp.where(self.y != 0, sign(self.y), sign(outside))

    def beyond(self, y: Array) -> Array:
        """Return by how much |y| exceeds the weight of an L1 penalty."""
        return jnp.maximum(jnp.abs(y) - self.bounds.linear, 0.0)

    @property
    def give(self) -> Array:
        """1/k of soft rows, 0 of others."""
        stiff = self.bounds.quadratic
        return jnp.where(stiff > 0, 1 / jnp.where(stiff > 0, stiff, 1.0), 0.0)

    @property
    def slack(self) -> Array:
        """Γ: what soft rows that pay more than their L1 weight add to the diagonal of S."""
        if self.bounds.linear is None:
            return jnp.zeros_like(self.y)
        return jnp.where(jnp.abs(self.y) >= self.bounds.linear, self.give, 0.0)

    @property
    def excess(self) -> Array:
        """v less the bound that is active."""
        return self.v - jnp.where(self.sign > 0, self.bounds.u, self.bounds.l)

    @property
    def gradient(self) -> Array:
        """Right-hand side of the Newton step."""
        if self.bounds.linear is None:
            return self.excess
        return self.excess - self.slack * self.sign * self.beyond(self.y)

    def stops(self, d: Array) -> Array:
        """Return the largest step lengths up to 1 along d that take no multiplier past zero."""
        sign, unequal = self.sign, self.bounds.l != self.bounds.u
        stops = unequal & (sign * d < 0) & (sign * self.y > 0)
        return jnp.where(stops, -self.y / jnp.where(stops, d, 1.0), 1.0)

    def moved(self, change: Array) -> Array:
        """Return the change of y (k,) that is admissible: rows that would turn stop at zero, those
        of an L1 penalty at its weight."""
        equal = self.bounds.l == self.bounds.u
        change = jnp.where(equal | (self.sign * (self.y + change) > 0), change, -self.y)
        if self.bounds.linear is not None:
            top = jnp.where(self.bounds.quadratic > 0, jnp.inf, self.bounds.linear)
            low = jnp.maximum(change, -top - self.y)
            change = jnp.where(self.y + change > top, top - self.y, low)
        return change

    def loss(self, change: Array, image: Array) -> Array:
        """Return the loss of dual value, ½ δ'S δ − δ'(v − b) and the change of what soft rows add
        to g*, as terms (k,) of a sum, for a change δ of y and its image S_WW δ."""
        loss = change * (0.5 * image - self.excess)
        if self.bounds.linear is not None:
            loss = loss + self._soft_loss(self.y + change) - self._soft_loss(self.y)
        return loss

    def _soft_loss(self, y: Array) -> Array:
        return 0.5 * self.give * self.beyond(y) ** 2


def sizes(bounds: Bounds, y: Array, v: Array) -> tuple[Array, Array, Array]:
    """Return by how much v misses prox(v + y), at which it is optimal, |v| and |y|, row by row."""
    return jnp.abs(bounds.prox_residual(v + y, 1.0) - y), jnp.abs(v), jnp.abs(y)


def after_step(
    largest: Sequence[Array],
    converged: float,
    limit: Array,
    taken: Array,
    fits: Array,
    steps: MostSteps,
) -> tuple[Array, Array, Array]:
    """Return the count of steps, whether to go on, and whether the point is optimal, after a step,
    the number `taken`, to a point with these largest `sizes`.

    converged: distance from the optimum, relative to the largest row, at which the steps end.
    limit: that of the `Dual`. fits: whether all rows were in W. The count is `steps.first` where
    the search begins once more."""
    error, largest_v, largest_y = largest
    optimal = error <= converged * (1 + largest_v) + ROUNDING * largest_y
    # (Without "not": Triton's dialect lacks it for booleans.)
    lost = jnp.where(largest_y <= limit, jnp.where(fits, False, taken > JOINTLY), True)
    first = taken <= steps.first
    ended = optimal | jnp.where(first, False, lost)
    taken = jnp.where(first & lost, steps.first, taken)
    return taken, jnp.where(ended, False, taken < steps.first + steps.more), optimal
