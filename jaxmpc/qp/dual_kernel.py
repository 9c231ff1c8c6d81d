"""Systems in the active rows W as kernels for NVIDIA GPUs, a program an instance: the search on the
dual of `active_set.py`, and the derivatives of `newton.linearised`.

As a loop of XLA each step is some twenty launches, and all instances of a group wait for the
largest system. Here an instance takes all its steps within one program and leaves when it is done.
A program holds y, v and the system of W in registers, and gathers through memory of its own. The
system is solved in as many pivots as W has rows.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.qp.active_set import (
    JOINTLY,
    LENGTHS,
    RIDGE,
    DualPoint,
    DualSearch,
    WorkingRows,
    after_step,
    sizes,
    working_set,
)
from jaxmpc.qp.projection import FREE, Bounds
from jaxmpc.qp.triton import LEAST, barrier, call, indices, load, padded_side, store

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
    A: Array, S: Array, bounds: Bounds, limit: Array, cold: DualPoint, state: DualSearch,
    most: int, more: int,
) -> tuple[DualPoint, Array]:  # fmt: skip
    """Return the point at the end of `active_set.dual_search` of one instance, in float64, and
    whether it is optimal. `vmap` for many."""
    rows = min(*A.shape, MOST_ROWS)
    flags = jnp.stack([state.steps, *(v.astype(jnp.int32) for v in (state.open, state.optimal))])
    y, v = state.point.y, state.point.v
    for side in sides(rows):
        last = side >= rows
        search = _kernel(S, bounds, min(side, rows), side, most, more, last)
        y, v, flags = search(limit, cold.v, flags, y, v)
    # A search that began again has other multipliers, all of which count from the cold point.
    again = flags[0] > most
    begin = jax.tree.map(lambda old, new: jnp.where(again, new, old), state.point, cold)
    return begin.moved(A, y - begin.y), flags[2] > 0


def _kernel(
    S: Array, bounds: Bounds, rows: int, side: int, most: int, more: int, last: bool
) -> Any:
    """Return the kernel (limit, v of the cold point, flags, y, v) → (y, v, flags), with systems of
    `rows` rows, in arrays of `side`. An instance with more stays as it is, unless this is the last
    kernel. flags: count of steps, whether to go on, whether the point is optimal."""
    m, dtype = S.shape[-1], S.dtype
    width = padded_side(m)

    def kernel(*refs: Any) -> None:
        limit_ref, cold_ref, flags_in, S_ref, y_in, v_in, *others = refs
        *bound_refs, y_ref, v_ref, flags_ref, order_ref, change_ref, moved_ref = others
        i, k, few = indices(width), indices(side), indices(ROWS)
        # An instance that is done leaves what it shares with the results as it is, unread.
        busy = flags_in[1] > 0
        here, limit = (i < m) & busy, limit_ref[0]
        rows_of = zip(bound_refs, FREE, strict=False)
        own = Bounds.of_rows(load(ref.at[i], here, free) for ref, free in rows_of)

        def step(carry: tuple) -> tuple:
            y, v, taken, _, _, _ = carry
            again = taken == most
            y = jnp.where(again, 0.0, y)
            v = jnp.where(again, load(cold_ref.at[i], here & again), v)
            in_W = working_set(own, y, v, again | (taken >= JOINTLY))
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
            take = lambda ref: load(ref.at[W], inside)
            W_rows = WorkingRows(Bounds.of_rows(map(take, bound_refs)), take(y_ref), take(v_ref))
            diagonal = jnp.where(inside, W_rows.slack + RIDGE, 1.0)
            S_W = lambda: load(S_ref.at[W[:, None], W[None, :]], inside[:, None] & inside[None, :])
            M = S_W() + jnp.where(k[:, None] == k[None, :], diagonal[:, None], 0.0)
            d = solved(M, W_rows.gradient, k, count)

            def searched(_: Any) -> Array:
                """Return the change with the best dual value."""
                S, best, least = S_W(), jnp.zeros_like(d), jnp.asarray(jnp.inf, dtype)
                for t in (*LENGTHS, jnp.min(W_rows.stops(d))):
                    change = W_rows.moved(t * d)
                    image = jnp.sum(S * change[None, :], axis=1)
                    loss = jnp.sum(W_rows.loss(change, image))
                    best, least = jnp.where(loss < least, change, best), jnp.minimum(loss, least)
                return best

            whole = W_rows.moved(d)
            stopped = jnp.max(jnp.where(whole != d, 1, 0)) > 0
            change = jax.lax.cond(stopped, searched, lambda _: whole, jnp.int32(0))
            store(change_ref.at[k], change, inside)
            store(moved_ref.at[jnp.where(inside, W, m + k)], W_rows.y + change, inside)
            barrier()
            new_y = jnp.where(joined, load(moved_ref.at[i], here), y)

            def image(number: Array, v: Array) -> Array:
                j = number * ROWS + few
                some = j < count
                row, change = load(order_ref.at[j], some, 0), load(change_ref.at[j], some)
                part = load(S_ref.at[row[:, None], i[None, :]], some[:, None] & here[None, :])
                return v - jnp.sum(part * change[:, None], axis=0)

            parts = (count + ROWS - 1) // ROWS
            new_v = jax.lax.fori_loop(jnp.int32(0), parts, image, v)
            barrier()
            largest = [jnp.max(part) for part in sizes(own, new_y, new_v)]
            after, go_on, optimal = after_step(
                largest, CONVERGED, limit, taken + 1, wanted <= rows, most, more
            )
            stays = wanted > (m if last else rows)
            y, v = jnp.where(stays, y, new_y), jnp.where(stays, v, new_v)
            taken = jnp.where(stays, taken, after)
            flag = lambda value: value.astype(jnp.int32)
            return y, v, taken, flag(go_on | stays), flag(optimal), flag(stays)

        y, v = load(y_in.at[i], here), load(v_in.at[i], here)
        begin = y, v, flags_in[0], flags_in[1], flags_in[2], jnp.int32(0)
        y, v, *flags, _ = jax.lax.while_loop(lambda s: (s[3] > 0) & (s[5] == 0), step, begin)
        store(y_ref.at[i], y, here)
        store(v_ref.at[i], v, here)
        four = indices(4)
        taken, go_on, optimal = flags
        all_flags = jnp.where(four == 0, taken, jnp.where(four == 1, go_on, optimal))
        store(flags_ref.at[four], all_flags, (four < 3) & busy)

    number = lambda count, kind=dtype: jax.ShapeDtypeStruct((count,), kind)
    shapes = [
        number(m), number(m), number(3, jnp.int32), number(side + width, jnp.int32), number(side),
        number(m + side),
    ]  # fmt: skip
    warps = 1 if width <= 64 and side <= LEAST else 2 if side <= 32 and width <= 128 else 4
    program = call(kernel, shapes, warps, aliases={2: 2, 4: 0, 5: 1})

    def run(limit: Array, cold: Array, flags: Array, y: Array, v: Array) -> tuple:
        return tuple(program(limit[None], cold, flags, S, y, v, *bounds.columns)[:3])

    return run


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
    """Return `newton.damped` (k,) of one instance. W (k,): rows of S, which is shared, filled up
    with their number; slack, b (k,). `vmap` for many."""
    m, rows = len(S), len(W)
    count = jnp.sum(W < m, dtype=jnp.int32)
    y, done = jnp.zeros_like(b), 0
    for side in sides(rows):
        here = jnp.where((count > done) & (count <= side), count, 0)
        solution = _damped(m, min(rows, side), side, damping, steps, b.dtype)
        part = solution(here[None], S, W, slack, b)
        y, done = jnp.where(here > 0, part, y), side
    return y


def _damped(m: int, rows: int, side: int, damping: float, steps: int, dtype: Any) -> Callable:
    """Return the kernel (count (1,), S, W, slack, b) → y (k,) with systems of `rows` rows at most,
    in arrays of `side`; y is zero where the count is."""

    def kernel(count_ref: Any, S_ref: Any, W_ref: Any, slack_ref: Any, b_ref: Any, y_ref: Any):
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
