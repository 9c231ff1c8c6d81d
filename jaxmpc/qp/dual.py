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
of Goldfarb and Idnani (1983). The few instances whose W is large go on by themselves, with systems
as large as W can be (random programs with 50 to 119 of 120 inputs at their limits take 8 steps in
which all violated rows join, 20 if they do so twice only).
Where H is not the identity (P singular) or there are balls, nothing is done here.

The search is a loop of XLA, or on NVIDIA GPUs one kernel (end of this file), made of the same
functions. What rounding leaves of its solution is corrected (`solve_dual`).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.pytrees import pytree
from jaxmpc.qp.admm import ScaledProgram
from jaxmpc.qp.jax_transformations import has_kernels, repeat_while, tree_where, true_places
from jaxmpc.qp.kernel import (
    LEAST_SIDE,
    Ref,
    barrier,
    call,
    gather,
    indices,
    load,
    padded_side,
    store,
)
from jaxmpc.qp.linalg import infinity_norm, matmul, solve
from jaxmpc.qp.problem import FREE, Bounds, sign
from jaxmpc.qp.residuals import Pair

# Most rows in W.
MOST_ROWS = 48
# Of few steps: rows in the first, for a system of half as many rows takes a quarter of the time and
# most instances need no larger one, and how many there are at most.
FIRST_ROWS, FEW_STEPS = 24, 10
# Steps in which all violated rows join W.
JOINTLY = 2
# Step lengths that are tried, beside the largest that stops no row.
LENGTHS = (1.0, 0.5, 0.25, 0.0625)
# Ridge on S_WW, whose diagonal is 1, for linearly dependent rows: they share their multiplier.
RIDGE = 1e-11
# Violations relative to the largest row that count as rounding.
NOISE = 1e-13
# Difference of losses, relative to these, that counts as none.
TIE = 1e-13
# Distance from the optimum at which the steps end that is rounding of the largest multiplier.
DISTANCE_ROUNDING = 1e-15
# Most steps, and most of a second search.
MOST_STEPS, MORE_STEPS = 24, 100
# Distance from the optimum at which the steps end, relative to the largest row.
CONVERGED = 1e-11
# Of the kernels: rows of W, one after the other, each of which takes the instances that did not fit
# into the last.
SIDES = (16, 32)
# Most rows in W there, and rows of S that are read at once.
KERNEL_ROWS, ROWS = 64, 8
# Where the steps end there, closer than elsewhere: one more costs less than a correction, which is
# a loop of launches (with 1e-11 4 % of the joint's plans need one, with this 0.01 %).
KERNEL_CONVERGED = 2e-13


@pytree
class Dual:
    """What the steps need of a program in ADMM's coordinates: rows A (m, n), S = A A' (m, m), its
    bounds, and the `limit`, the size of multipliers from which on the dual seems unbounded."""

    A: Array
    S: Array
    bounds: Bounds
    limit: Array

    @classmethod
    def of(cls, p: ScaledProgram) -> "Dual":
        """Return the dual of a program. It seems unbounded, because rows contradict each other,
        from multipliers on that are so large: systems in the active rows have a ridge, beside which
        rows that are more nearly dependent, and hold larger ones, cannot be told apart."""
        limit = 1 / RIDGE * (1 + infinity_norm(p.q))
        return cls(p.factor.A, p.factor.S, p.bounds, limit)


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
    return min(*A.shape, KERNEL_ROWS if has_kernels(len(A)) else MOST_ROWS)


def dual_step(dual: Dual, point: DualPoint, singly: Array, most: int) -> tuple[DualPoint, Array]:
    """Take a step from `point`. singly: of the rows without multiplier that are violated only the
    one that is so most joins W. Where W would have more than `most`, it has the first of them.

    Returns the new point, and whether W had all its rows.
    """
    bounds, y, v = dual.bounds, point.y, point.v
    in_W = working_set(bounds, y, v, singly)
    W = true_places(in_W, most)
    inside = W < len(y)
    y_W, v_W, *rest = jnp.stack([y, v, *bounds.columns]).at[:, W].get(mode="fill", fill_value=0.0)
    rows = WorkingRows(Bounds.of_rows(rest), y_W, v_W)
    S_W = dual.S.at[W[:, None], W[None, :]].get(mode="fill", fill_value=0.0)
    d = solve(S_W + jnp.diag(jnp.where(inside, rows.soft_diagonal + RIDGE, 1.0)), rows.gradient)
    t = jnp.append(jnp.asarray(LENGTHS, y.dtype), jnp.min(rows.stops(d), initial=1.0))
    moved = jax.vmap(lambda t: rows.moved(t * d))(t)
    loss = jnp.sum(jax.vmap(rows.loss)(moved, matmul(moved, S_W)), axis=1)
    # (An argmin in a float64 program cannot be lowered where 64-bit mode is off.)
    least = jnp.min(loss)
    best = (loss <= least + TIE * jnp.abs(least)).astype(y.dtype)
    change = jnp.zeros_like(y).at[W].add(matmul(best / jnp.sum(best), moved), mode="drop")
    return point.moved(dual.A, change), jnp.sum(in_W) <= most


def working_set(bounds: Bounds, y: Array, v: Array, singly: Array) -> Array:
    """Return which rows are in W (m,): those with a multiplier, and those that are violated by more
    than rounding, where they join singly only the one that is so most."""
    outside, noise = bounds.outside(v), NOISE * (1 + infinity_norm(v))
    new = jnp.where(y == 0, jnp.abs(outside), 0.0)
    # Less rounding: a compiler may compute `outside` again, with other rounding, where it is used.
    least = jnp.where(singly, jnp.max(new, initial=0.0) - noise, 0.0)
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
        outside = self.bounds.outside(self.v)
        return jnp.where(self.y != 0, sign(self.y), sign(outside))

    def beyond(self, y: Array) -> Array:
        """Return by how much |y| exceeds the weight of an L1 penalty."""
        return jnp.maximum(jnp.abs(y) - self.bounds.linear, 0.0)

    @property
    def compliance(self) -> Array:
        """1/k of soft rows, 0 of others."""
        stiff = self.bounds.quadratic
        return jnp.where(stiff > 0, 1 / jnp.where(stiff > 0, stiff, 1.0), 0.0)

    @property
    def soft_diagonal(self) -> Array:
        """Γ: what soft rows that pay more than their L1 weight add to the diagonal of S."""
        if self.bounds.linear is None:
            return jnp.zeros_like(self.y)
        return jnp.where(jnp.abs(self.y) >= self.bounds.linear, self.compliance, 0.0)

    @property
    def excess(self) -> Array:
        """v less the bound that is active."""
        return self.v - jnp.where(self.sign > 0, self.bounds.u, self.bounds.l)

    @property
    def gradient(self) -> Array:
        """Right-hand side of the Newton step."""
        if self.bounds.linear is None:
            return self.excess
        return self.excess - self.soft_diagonal * self.sign * self.beyond(self.y)

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
            limit = jnp.where(self.bounds.quadratic > 0, jnp.inf, self.bounds.linear)
            low = jnp.maximum(change, -limit - self.y)
            change = jnp.where(self.y + change > limit, limit - self.y, low)
        return change

    def loss(self, change: Array, S_change: Array) -> Array:
        """Return the loss of dual value, ½ δ'S δ − δ'(v − b) and the change of what soft rows add
        to g*, as terms (k,) of a sum, for a change δ of y and S_WW δ."""
        loss = change * (0.5 * S_change - self.excess)
        if self.bounds.linear is not None:
            loss = loss + self._soft_loss(self.y + change) - self._soft_loss(self.y)
        return loss

    def _soft_loss(self, y: Array) -> Array:
        return 0.5 * self.compliance * self.beyond(y) ** 2


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
    optimal = error <= converged * (1 + largest_v) + DISTANCE_ROUNDING * largest_y
    # (Without "not": Triton's dialect lacks it for booleans.)
    lost = jnp.where(largest_y <= limit, jnp.where(fits, False, taken > JOINTLY), True)
    first = taken <= steps.first
    ended = optimal | jnp.where(first, False, lost)
    taken = jnp.where(first & lost, steps.first, taken)
    return taken, jnp.where(ended, False, taken < steps.first + steps.more), optimal


@pytree
class DualSearch:
    """Loop state of one instance: its point, the steps taken, whether to go on, and whether its
    multipliers are optimal."""

    point: DualPoint
    steps: Array
    open: Array
    optimal: Array


def dual_search(
    dual: Dual, cold: DualPoint, point: DualPoint, go_on: Array, steps: MostSteps
) -> tuple[DualPoint, Array]:
    """Return the point after steps on the dual, and whether it is optimal.

    Where `steps.first` do not get there, multipliers exceed the limit, or rows that join singly are
    too many for W, it begins once more from `cold`, the point without multipliers, with rows that
    join singly."""
    none, constants, every = jnp.int32(0), (dual, cold), min(*dual.A.shape)
    most = most_rows(dual.A)
    if has_kernels(len(dual.S)):
        point, optimal = dual_search_kernel(dual, cold, point, go_on, steps)
    else:
        state = DualSearch(point, none, go_on, jnp.asarray(False))
        step = partial(_search_step, steps, most)
        end = repeat_while(lambda s: s.open, step, constants, state)
        point, optimal = end.point, end.optimal
    if most == every:
        return point, optimal
    # Those with more rows in W have been left as they were.
    in_W = working_set(dual.bounds, point.y, point.v, jnp.asarray(False))
    large = (jnp.sum(in_W) > most) & (infinity_norm(point.y) <= dual.limit)
    state = DualSearch(point, none, go_on & ~optimal & large, optimal)
    step = partial(_search_step, steps, every)
    end = repeat_while(lambda s: s.open, step, constants, state, steps="long")
    return end.point, end.optimal


def few_steps(measured: bool, p: ScaledProgram, y: Array) -> Pair:
    """Return the pair after a few steps on the dual from y (m,), without a kernel: within its
    tolerances where it is optimal, and its residuals are far below them. measured: False leaves
    these out."""
    f, dual, steps, most = p.factor, Dual.of(p), MostSteps(FEW_STEPS, 0), most_rows(p.factor.A)
    constants = dual, DualPoint.cold(f.A, p.q)
    none, false, point = jnp.int32(0), jnp.asarray(False), DualPoint.of(f.A, p.q, p.bounds, y)
    begin, few = DualSearch(point, none, ~f.flat, false), min(most, FIRST_ROWS)
    fits = jnp.sum(working_set(dual.bounds, point.y, point.v, false)) <= few
    first = _search_step(steps, few, constants, begin)
    begin = tree_where(fits & begin.open, first, begin)
    end = repeat_while(lambda s: s.open, partial(_search_step, steps, most), constants, begin)
    if measured:
        pair = p.measure(end.point.w, end.point.y)[0]
        done = end.optimal & pair.near
    else:
        z, y = p.unscaled(end.point.w, end.point.y)
        pair, done = replace(Pair.none(z, y), z=z, y=y), end.optimal
    return replace(pair, measured=replace(pair.measured, within_tolerance=done))


def single_step(dual: Dual, point: DualPoint) -> DualPoint:
    """Return the point after one step, in which rows join singly.

    (Not by the kernel, which tells the change of the multipliers by their difference. Where limits
    are far below q the change may be less than the rounding of the multipliers.)"""
    return dual_step(dual, point, jnp.asarray(True), most_rows(dual.A))[0]


def _search_step(
    steps: MostSteps, most: int, constants: tuple[Dual, DualPoint], s: DualSearch
) -> DualSearch:
    """Return the state after a step with `most` rows in W. Where W has more, and could have, the
    point stays and the search ends. In systems of all sizes rows join jointly for longer."""
    dual, cold = constants
    every = min(*dual.A.shape)
    jointly = JOINTLY if most <= MOST_ROWS else steps.first
    again = s.steps == steps.first
    point = tree_where(again, cold, s.point)
    point, fits = dual_step(dual, point, again | (s.steps >= jointly), most)
    largest = [jnp.max(v, initial=0.0) for v in sizes(dual.bounds, point.y, point.v)]
    after = after_step(largest, CONVERGED, dual.limit, s.steps + 1, fits, steps)
    new = DualSearch(point, *after)
    if most == every:
        return new
    return tree_where(fits, new, replace(s, open=jnp.asarray(False)))


def has_dual_steps(balls: tuple[int, ...], A: Array) -> bool:
    """Return whether there can be steps on the dual: there are rows, and no balls."""
    return not balls and len(A) > 0


@pytree
class Correction:
    """Loop state of one instance whose steps leave residuals: its point, the gradient of its
    Lagrangian in w (n,), the best pair so far, the corrections made, and whether to go on."""

    point: DualPoint
    gradient: Array
    best: Pair
    steps: Array
    open: Array


def solve_dual(p: ScaledProgram, y: Array, go_on: Array, most: int) -> tuple[Pair, Array]:
    """Return the best pair of a search on the dual from y (m,) in ADMM's coordinates, `most` steps
    and corrections at most, and the last multipliers. The pair is `solved` where its residuals are
    small enough to end with it."""
    f, dual, first = p.factor, Dual.of(p), min(most, MOST_STEPS)
    cold, point = DualPoint.cold(f.A, p.q), DualPoint.of(f.A, p.q, p.bounds, y)
    steps = MostSteps(first, min(most - first, MORE_STEPS))
    point, optimal = dual_search(dual, cold, point, go_on, steps)
    best, gradient, _ = p.measure(point.w, point.y)
    best = replace(best, finished=best.finished | best.near)
    start = Correction(point, gradient, best, jnp.int32(0), optimal & ~best.finished)
    end = corrected(first, p, start)
    return end.best, end.point.y


def corrected(most: int, p: ScaledProgram, start: Correction) -> Correction:
    """Return the state after `most` corrections at most."""
    return repeat_while(lambda s: s.open, partial(_correct, most), p, start, steps="long")


def _correct(most: int, p: ScaledProgram, s: Correction) -> Correction:
    """One more step on the dual, from a point that makes up for the gradient of the Lagrangian: it
    is zero there in exact arithmetic; where P is ill-conditioned it is rounding of T'PT (defect
    correction)."""
    dual, steps = Dual.of(p), s.steps + 1
    point = single_step(dual, s.point.shifted(dual.A, -s.gradient))
    pair, gradient, _ = p.measure(point.w, point.y)
    best = s.best.or_better(pair)
    go_on = ~best.finished & (infinity_norm(point.y) <= dual.limit) & (steps < most)
    return Correction(point, gradient, best, steps, go_on)


def sides(rows: int) -> list[int]:
    """Return the sides of the arrays of kernels that together take W of up to so many rows."""
    last = padded_side(rows)
    return [*(side for side in SIDES if side < last), last]


def dual_search_kernel(
    dual: Dual, cold: DualPoint, point: DualPoint, go_on: Array, steps: MostSteps
) -> tuple[DualPoint, Array]:
    """Return `dual_search` of one instance, in float64, by a kernel for NVIDIA GPUs. `vmap` for
    many: one program an instance.

    As a loop of XLA each step is some twenty launches, and all instances of a group wait for the
    largest system. Here an instance takes all its steps within one program and leaves when it is
    done. A program keeps y, v and the system of W in registers, and gathers through memory of its
    own. The system is solved in as many pivots as W has rows.
    """
    rows = min(*dual.A.shape, KERNEL_ROWS)
    flags = jnp.stack([jnp.int32(0), go_on.astype(jnp.int32), jnp.int32(0)])
    y, v = point.y, point.v
    for side in sides(rows):
        last = side >= rows == min(*dual.A.shape)
        search = _search(dual, min(side, rows), side, steps, last=last)
        y, v, flags = search(dual.limit, cold.v, flags, y, v)
    # A search that began again has other multipliers, all of which count from the cold point.
    again = flags[0] > steps.first
    begin = tree_where(again, cold, point)
    return begin.moved(dual.A, y - begin.y), flags[2] > 0


class SearchState(NamedTuple):
    """What a program of the search keeps: y and v (m,), the count of steps, and whether to go on,
    whether the point is optimal, and whether W has too many rows for this kernel, as 0 or 1."""

    y: Array
    v: Array
    taken: Array
    open: Array
    optimal: Array
    stays: Array


def _search(dual: Dual, rows: int, side: int, steps: MostSteps, *, last: bool) -> Callable:
    """Return the kernel (limit, v of the cold point, flags, y, v) → (y, v, flags), with systems of
    `rows` rows, in arrays of `side`. An instance with more stays as it is, unless this is the last
    kernel. flags: count of steps, whether to go on, whether the point is optimal."""
    S, bounds = dual.S, dual.bounds
    m, dtype = S.shape[-1], S.dtype
    width = padded_side(m)

    def dual_steps(*refs: Ref) -> None:
        limit_ref, cold_ref, flags_in, S_ref, y_in, v_in, *others = refs
        *bound_refs, y_ref, v_ref, flags_ref, order_ref, change_ref, moved_ref = others
        i, k, few = indices(width), indices(side), indices(ROWS)
        # An instance that is done reads no more than what it returns.
        here, limit = (i < m) & (flags_in[1] > 0), limit_ref[0]
        rows_of = zip(bound_refs, FREE, strict=False)
        own = Bounds.of_rows(load(ref.at[i], here, free) for ref, free in rows_of)

        def step(s: SearchState) -> SearchState:
            again = s.taken == steps.first
            y = jnp.where(again, 0.0, s.y)
            v = jnp.where(again, load(cold_ref.at[i], here & again), s.v)
            in_W = working_set(own, y, v, again | (s.taken >= JOINTLY))
            ones = in_W.astype(jnp.int32)
            wanted = jnp.sum(ones, dtype=jnp.int32)
            count = jnp.minimum(wanted, rows)
            rank = jnp.cumsum(ones, dtype=jnp.int32) - 1
            joined = in_W & (rank < rows)
            store(order_ref.at[rank], i, joined)
            store(y_ref.at[i], y, here)
            store(v_ref.at[i], v, here)
            barrier()
            inside = k < count
            W = load(order_ref.at[k], inside, 0)
            *bounds_W, y_W, v_W = (load(ref.at[W], inside) for ref in (*bound_refs, y_ref, v_ref))
            W_rows = WorkingRows(Bounds.of_rows(bounds_W), y_W, v_W)
            change = _best_change(W_rows, S_ref, W, k, count, inside)
            store(change_ref.at[k], change, inside)
            store(moved_ref.at[W], W_rows.y + change, inside)
            barrier()
            new_y = jnp.where(joined, load(moved_ref.at[i], here), y)

            def less(number: Array, v: Array) -> Array:
                """Return the rows v less those of S in a part of W times their change."""
                j = number * ROWS + few
                some = j < count
                row, change = load(order_ref.at[j], some, 0), load(change_ref.at[j], some)
                part = load(S_ref.at[row[:, None], i[None, :]], some[:, None] & here[None, :])
                return v - jnp.sum(part * change[:, None], axis=0)

            parts = (count + ROWS - 1) // ROWS
            new_v = jax.lax.fori_loop(jnp.int32(0), parts, less, v)
            barrier()
            largest = [jnp.max(part) for part in sizes(own, new_y, new_v)]
            after, go_on, optimal = after_step(
                largest, KERNEL_CONVERGED, limit, s.taken + 1, wanted <= rows, steps
            )
            stays = wanted > (m if last else rows)
            y, v = jnp.where(stays, y, new_y), jnp.where(stays, v, new_v)
            taken = jnp.where(stays, s.taken, after)
            flags = (flag.astype(jnp.int32) for flag in (go_on | stays, optimal, stays))
            return SearchState(y, v, taken, *flags)

        y, v = load(y_in.at[i], i < m), load(v_in.at[i], i < m)
        begin = SearchState(y, v, flags_in[0], flags_in[1], flags_in[2], jnp.int32(0))
        end = jax.lax.while_loop(lambda s: (s.open > 0) & (s.stays == 0), step, begin)
        store(y_ref.at[i], end.y, i < m)
        store(v_ref.at[i], end.v, i < m)
        four = indices(4)
        flags = jnp.where(four == 0, end.taken, jnp.where(four == 1, end.open, end.optimal))
        store(flags_ref.at[four], flags, four < 3)

    vectors = [(m, dtype), (m, dtype), (3, jnp.int32)]
    scratch = [(side, jnp.int32), (side, dtype), (m, dtype)]
    shapes = [jax.ShapeDtypeStruct((count,), kind) for count, kind in vectors + scratch]
    warps = 1 if width <= 64 and side <= LEAST_SIDE else 2 if side <= 32 and width <= 128 else 4
    program = call(dual_steps, shapes, warps)

    def run(limit: Array, cold: Array, flags: Array, y: Array, v: Array) -> tuple[Array, ...]:
        return tuple(program(limit[None], cold, flags, S, y, v, *bounds.columns)[:3])

    return run


def _best_change(
    rows: WorkingRows, S_ref: Ref, W: Array, k: Array, count: Array, inside: Array
) -> Array:
    """Return the change of the multipliers in W (k,) with the best dual value: a Newton step, or
    where it would stop rows the best of several lengths. k: 0, 1, …; inside: k < count, which of
    them are in W."""
    diagonal = jnp.where(inside, rows.soft_diagonal + RIDGE, 1.0)

    def S_W() -> Array:
        return gather(S_ref, W, W, inside[:, None] & inside[None, :])

    M = S_W() + jnp.where(k[:, None] == k[None, :], diagonal[:, None], 0.0)
    d = solved(M, rows.gradient, k, count)

    def searched(_: Array) -> Array:
        S, best, least = S_W(), jnp.zeros_like(d), jnp.asarray(jnp.inf, d.dtype)
        for t in (*LENGTHS, jnp.min(rows.stops(d))):
            change = rows.moved(t * d)
            S_change = jnp.sum(S * change[:, None], axis=0)
            loss = jnp.sum(rows.loss(change, S_change))
            best, least = jnp.where(loss < least, change, best), jnp.minimum(loss, least)
        return best

    whole = rows.moved(d)
    stopped = jnp.max(jnp.where(whole != d, 1, 0)) > 0
    return jax.lax.cond(stopped, searched, lambda _: whole, jnp.int32(0))


def solved(M: Array, b: Array, k: Array, count: Array) -> Array:
    """Return M⁻¹b for M (k, k) symmetric positive definite, the identity beyond the first `count`
    rows. k: 0, 1, …

    By the sweep operator (Goodnight 1979, The American Statistician 33), which keeps M symmetric,
    so that a pivot j needs one row: with c that row, but c_j = p − 1 for the pivot p, the swept
    matrix is M − c c'/p, and the right-hand side b − c b_j/p; only the diagonal of rows that have
    been pivots is another, and nothing reads it.
    """
    row = k[:, None]

    def sweep(j: Array, carry: tuple) -> tuple:
        M, b = carry
        c = jnp.sum(jnp.where(row == j, M, 0.0), axis=0)
        at_j = lambda v: jnp.sum(jnp.where(k == j, v, 0.0))
        pivot = at_j(c)
        c, inverse = jnp.where(k == j, pivot - 1, c), 1 / pivot
        return M - c[:, None] * (c * inverse)[None, :], b - c * (at_j(b) * inverse)

    return jax.lax.fori_loop(jnp.int32(0), count, sweep, (M, b))[1]


def inverted(M: Array, k: Array, count: Array) -> Array:
    """Return M⁻¹ for M (k, k) symmetric positive definite, the identity beyond the first `count`
    rows, by the sweeps of `solved`, which leave −M⁻¹ where the pivot itself becomes −1/p."""
    row = k[:, None]

    def sweep(j: Array, M: Array) -> Array:
        c = jnp.sum(jnp.where(row == j, M, 0.0), axis=0)
        pivot = jnp.sum(jnp.where(k == j, c, 0.0))
        c, inverse = jnp.where(k == j, pivot - 1, c), 1 / pivot
        swept = M - c[:, None] * (c * inverse)[None, :]
        return jnp.where((row == j) & (k[None, :] == j), -inverse, swept)

    return -jax.lax.fori_loop(jnp.int32(0), count, sweep, M)
