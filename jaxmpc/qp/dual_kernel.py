"""Systems in the active rows W as kernels for NVIDIA GPUs, a program an instance: the search on the
dual (`dual_search.py`), and the derivatives of `kkt_system.linearised`.

As a loop of XLA each step is some twenty launches, and all instances of a group wait for the
largest system. Here an instance takes all its steps within one program and leaves when it is done.
A program holds y, v and the system of W in registers, and gathers through memory of its own. The
system is solved in as many pivots as W has rows.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.qp.dual_step import (
    JOINTLY,
    LENGTHS,
    RIDGE,
    Dual,
    DualPoint,
    MostSteps,
    WorkingRows,
    after_step,
    sizes,
    working_set,
)
from jaxmpc.qp.projection import FREE, Bounds
from jaxmpc.qp.triton import LEAST, Ref, barrier, call, indices, load, padded_side, store

# Rows of W, one kernel after the other: each takes the instances that did not fit into the last.
SIDES = (16, 32)
# Most rows in W, and rows of S that are read at once.
MOST_ROWS, ROWS = 64, 8
# Where the steps end, closer than elsewhere: one more here costs less than a correction, which is
# a loop of launches (with 1e-11 4 % of the joint's plans need one, with this 0.01 %).
CONVERGED = 2e-13


def sides(rows: int) -> list[int]:
    """Return the sides of the arrays of kernels that together take W of up to so many rows."""
    last = padded_side(rows)
    return [*(side for side in SIDES if side < last), last]


def dual_search_kernel(
    dual: Dual, cold: DualPoint, point: DualPoint, taken: Array, go_on: Array, steps: MostSteps
) -> tuple[DualPoint, Array]:
    """Return `dual_search` of one instance, in float64, that has `taken` steps already. `vmap` for
    many."""
    rows = min(*dual.A.shape, MOST_ROWS)
    flags = jnp.stack([taken, go_on.astype(jnp.int32), jnp.int32(0)])
    y, v = point.y, point.v
    for side in sides(rows):
        search = _search(dual, min(side, rows), side, steps, last=side >= rows)
        y, v, flags = search(dual.limit, cold.v, flags, y, v)
    # A search that began again has other multipliers, all of which count from the cold point.
    again = flags[0] > steps.first
    begin = jax.tree.map(lambda old, new: jnp.where(again, new, old), point, cold)
    return begin.moved(dual.A, y - begin.y), flags[2] > 0


class SearchState(NamedTuple):
    """What a program of the search holds: y and v (m,), the count of steps, and whether to go on,
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

    def kernel(*refs: Ref) -> None:
        limit_ref, cold_ref, flags_in, S_ref, y_in, v_in, *others = refs
        *bound_refs, y_ref, v_ref, flags_ref, order_ref, change_ref, moved_ref = others
        i, k, few = indices(width), indices(side), indices(ROWS)
        # An instance that is done leaves what it shares with the results as it is, unread.
        busy = flags_in[1] > 0
        here, limit = (i < m) & busy, limit_ref[0]
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
            # (Pallas' interpreter wants places of their own for what is masked, too.)
            store(order_ref.at[jnp.where(joined, rank, side + i)], i, joined)
            store(y_ref.at[i], y, here)
            store(v_ref.at[i], v, here)
            barrier()
            inside = k < count
            W = load(order_ref.at[k], inside, 0)
            *bounds_W, y_W, v_W = (load(ref.at[W], inside) for ref in (*bound_refs, y_ref, v_ref))
            W_rows = WorkingRows(Bounds.of_rows(bounds_W), y_W, v_W)
            change = _best_change(W_rows, S_ref, W, k, count, inside)
            store(change_ref.at[k], change, inside)
            store(moved_ref.at[jnp.where(inside, W, m + k)], W_rows.y + change, inside)
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
                largest, CONVERGED, limit, s.taken + 1, wanted <= rows, steps
            )
            stays = wanted > (m if last else rows)
            y, v = jnp.where(stays, y, new_y), jnp.where(stays, v, new_v)
            taken = jnp.where(stays, s.taken, after)
            flags = (flag.astype(jnp.int32) for flag in (go_on | stays, optimal, stays))
            return SearchState(y, v, taken, *flags)

        y, v = load(y_in.at[i], here), load(v_in.at[i], here)
        begin = SearchState(y, v, flags_in[0], flags_in[1], flags_in[2], jnp.int32(0))
        end = jax.lax.while_loop(lambda s: (s.open > 0) & (s.stays == 0), step, begin)
        store(y_ref.at[i], end.y, here)
        store(v_ref.at[i], end.v, here)
        four = indices(4)
        flags = jnp.where(four == 0, end.taken, jnp.where(four == 1, end.open, end.optimal))
        store(flags_ref.at[four], flags, (four < 3) & busy)

    vectors = [(m, dtype), (m, dtype), (3, jnp.int32)]
    scratch = [(side + width, jnp.int32), (side, dtype), (m + side, dtype)]
    shapes = [jax.ShapeDtypeStruct((count,), kind) for count, kind in vectors + scratch]
    warps = 1 if width <= 64 and side <= LEAST else 2 if side <= 32 and width <= 128 else 4
    program = call(kernel, shapes, warps, aliases={2: 2, 4: 0, 5: 1})

    def run(limit: Array, cold: Array, flags: Array, y: Array, v: Array) -> tuple[Array, ...]:
        return tuple(program(limit[None], cold, flags, S, y, v, *bounds.columns)[:3])

    return run


def _best_change(
    rows: WorkingRows, S_ref: Ref, W: Array, k: Array, count: Array, inside: Array
) -> Array:
    """Return the change of the multipliers in W (k,) with the best dual value: a Newton step, or
    where it would stop rows the best of several lengths. k: 0, 1, …; inside: k < count, which of
    them are in W."""
    diagonal = jnp.where(inside, rows.slack + RIDGE, 1.0)

    def S_W() -> Array:
        return load(S_ref.at[W[:, None], W[None, :]], inside[:, None] & inside[None, :])

    M = S_W() + jnp.where(k[:, None] == k[None, :], diagonal[:, None], 0.0)
    d = solved(M, rows.gradient, k, count)

    def searched(_: Array) -> Array:
        S, best, least = S_W(), jnp.zeros_like(d), jnp.asarray(jnp.inf, d.dtype)
        for t in (*LENGTHS, jnp.min(rows.stops(d))):
            change = rows.moved(t * d)
            image = jnp.sum(S * change[None, :], axis=1)
            loss = jnp.sum(rows.loss(change, image))
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


def damped_kernel(S: Array, W: Array, slack: Array, b: Array, damping: float, steps: int) -> Array:
    """Return `kkt_system.damped` (k,) of one instance. W (k,): rows of S, which is shared, filled
    up with their number; slack, b (k,). `vmap` for many."""
    m, rows = len(S), len(W)
    count = jnp.sum(W < m, dtype=jnp.int32)
    y, done = jnp.zeros_like(b), 0
    for side in sides(rows):
        here = jnp.where((count > done) & (count <= side), count, 0)
        solution = _damped(m, min(rows, side), side, damping, steps, b.dtype)
        part = solution(here[None], S, W, slack, b)
        y, done = jnp.where(here > 0, part, y), side
    return y


def _damped(m: int, rows: int, side: int, damping: float, steps: int, dtype: jnp.dtype) -> Callable:
    """Return the kernel (count (1,), S, W, slack, b) → y (k,) with systems of `rows` rows at most,
    in arrays of `side`; y is zero where the count is."""

    def kernel(
        count_ref: Ref, S_ref: Ref, W_ref: Ref, slack_ref: Ref, b_ref: Ref, y_ref: Ref
    ) -> None:
        k, count = indices(side), count_ref[0]
        inside = k < count
        W = load(W_ref.at[k], inside, 0)
        slack, b = load(slack_ref.at[k], inside), load(b_ref.at[k], inside)
        same, square = k[:, None] == k[None, :], inside[:, None] & inside[None, :]

        def M(added: float) -> Array:
            diagonal = jnp.where(inside, slack + added, 1.0)
            whole = load(S_ref.at[W[:, None], W[None, :]], square)
            return whole + jnp.where(same, diagonal[:, None], 0.0)

        inverse = inverted(M(damping), k, count)
        y = jnp.zeros_like(b)
        for _ in range(steps):
            left = b - jnp.sum(M(0.0) * y[None, :], axis=1)
            y = y + jnp.sum(inverse * left[None, :], axis=1)
        store(y_ref.at[k], jnp.where(inside, y, 0.0), k < rows)

    warps = 1 if side <= LEAST else 4 if side <= 32 else 8
    program = call(kernel, jax.ShapeDtypeStruct((rows,), dtype), warps)

    def run(count: Array, S: Array, W: Array, slack: Array, b: Array) -> Array:
        y = program(count, S, W[:rows], slack[:rows], b[:rows])
        return jnp.pad(y, (0, len(b) - rows))

    return run


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
