"""The search on the dual of `active_set.py` as one kernel for NVIDIA GPUs, a thread an instance.

As a loop of XLA each step is some twenty launches, and all instances of a group wait for the
largest system. Here a program takes TILE instances through all their steps. What concerns all rows
is done in pieces of CHUNK rows by all threads together. The system of W is factored by Cholesky's
method, each thread its own, in blocks of SIDE rows that fit into its registers; the factor, of as
many blocks as the largest W of the tile needs, lies in memory where neighbouring threads read
neighbouring numbers. There are no more programs than run at a time: each takes several tiles, one
after the other, with the same scratch memory.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_batching import custom_vmap

from jaxmpc.qp.active_set import (
    JOINTLY,
    LENGTHS,
    NOISE,
    RIDGE,
    WorkingRows,
    continues,
    joins,
    sizes,
    violation,
)
from jaxmpc.qp.batches import LARGE, broadcast, repeat_while
from jaxmpc.qp.projection import Bounds
from jaxmpc.qp.triton import barrier, call, indices, load, program, store

# Instances of a tile, one a thread; rows of a piece; rows of a block; programs at most.
TILE, CHUNK, SIDE, PROGRAMS = 32, 16, 8, 1056


def dual_search_on_gpu(
    S: Array, bounds: Bounds, limit: Array, y: Array, v: Array, steps: Array, go_on: Array,
    rows: int, most: int,
) -> Array:  # fmt: skip
    """Return the multipliers (m,) at the end of `active_set.dual_search` of one instance, from y
    with the rows v (m,), after so many steps before. `vmap` makes one call of the kernel; for many
    instances one for the first step, after which most are done, and others for those left."""
    constants, state = (S, bounds, limit), (y, v, steps, go_on)
    search = partial(_search, rows, most, most)
    single = custom_vmap(search)

    @single.def_vmap
    def _(size: int, in_batched: Any, constants: Any, state: Any) -> Any:
        axes = jax.tree.map(lambda b: 0 if b else None, tuple(in_batched))
        if size < LARGE:
            state = jax.vmap(search, in_axes=axes)(constants, state)
        else:
            state = jax.vmap(partial(_search, rows, most, 1), in_axes=axes)(constants, state)
            rest = lambda constants, state: repeat_while(lambda s: s[3], search, constants, state)
            state = jax.vmap(rest, in_axes=(axes[0], 0))(constants, state)
        return state, jax.tree.map(lambda _: True, state)

    return single(constants, state)[0]


def _search(rows: int, most: int, now: int, constants: Any, state: Any) -> Any:
    """Return (y, v, steps, go_on) of one instance after `now` steps more; `vmap` for many."""
    kernel = partial(dual_search_kernel, rows=rows, most=most, now=now)
    front = partial(jax.tree.map, lambda v: v[None])

    def alone(constants: Any, state: Any) -> Any:
        (S, *others), state = constants, front(state)
        return jax.tree.map(lambda v: v[0], kernel(S, *front(others), *state))

    one = custom_vmap(alone)

    @one.def_vmap
    def _(size: int, in_batched: Any, constants: Any, state: Any) -> Any:
        (S, *others), (_, *batched) = constants, in_batched[0]
        others, state = broadcast(size, (batched, in_batched[1]), (others, state))
        state = kernel(S, *others, *state)
        return state, jax.tree.map(lambda _: True, state)

    return one(constants, state)


def dual_search_kernel(
    S: Array, bounds: Bounds, limit: Array, y: Array, v: Array, steps: Array, go_on: Array,
    *, rows: int, most: int, now: int,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Return y, v, steps and go_on after `active_set.dual_search` of a batch from y, v (B, m),
    steps, go_on (B,), in float64, `now` steps at most; S (m, m) or (B, m, m), leaves of
    bounds (B, m), limit (B,). rows: that W may hold; most: steps in all."""
    (B, m), dtype = y.shape, y.dtype
    go_on = go_on.astype(jnp.int32)
    if B % TILE:
        fill = lambda v: jnp.pad(v, ((0, -B % TILE), *[(0, 0)] * (v.ndim - 1)))
        *own, S_all = jax.tree.map(fill, (bounds, limit, y, v, steps, go_on, S))
        S = S_all if S.ndim == 3 else S
        found = dual_search_kernel(S, *own, rows=rows, most=most, now=now)
        return tuple(part[:B] for part in found)
    blocks_most = -(-rows // SIDE)
    K, tiles = blocks_most * SIDE, B // TILE
    programs, pieces = min(tiles, PROGRAMS), -(-m // CHUNK)
    own_S, soft = S.ndim == 3, bounds.linear is not None
    bound_leaves = [bounds.l, bounds.u] + ([bounds.linear, bounds.quadratic] if soft else [])
    others = [-jnp.inf, jnp.inf, jnp.inf, 0.0]
    candidates = len(LENGTHS) + 1

    def kernel(*refs: Any) -> None:
        S_ref, limit_ref, _, _, _, _, *bound_refs = refs[: 6 + len(bound_leaves)]
        y_ref, v_ref, steps_ref, go_ref, order_ref, L_ref, x_ref, c_ref = refs[-8:]
        me = program()
        slot = me * TILE + indices(TILE)
        every, eight, columns = slot >= 0, range(SIDE), indices(CHUNK)

        def take_tile(number: Array, _: Any) -> Any:
            instance = (me + number * programs) * TILE + indices(TILE)
            limit = load(limit_ref.at[instance], every)
            start = load(steps_ref.at[instance], every, 0), load(go_ref.at[instance], every, 0)
            taken, open_, _ = jax.lax.while_loop(
                lambda s: (jnp.max(s[1]) > 0) & (s[2] < now), partial(step, instance, limit),
                (*start, jnp.int32(0)),
            )  # fmt: skip
            store(steps_ref.at[instance], taken, every)
            store(go_ref.at[instance], open_, every)
            return _

        def step(instance: Array, limit: Array, carry: tuple) -> tuple:
            taken, open_, number = carry
            is_open, singly = open_ > 0, taken + 1 > JOINTLY

            def piece(number: Array) -> tuple:
                """Places, mask, bounds, y and v of CHUNK rows of all instances."""
                i = number * CHUNK + columns
                at, here = (instance[:, None], i[None, :]), is_open[:, None] & (i[None, :] < m)
                b = [load(r.at[at], here, o) for r, o in zip(bound_refs, others, strict=False)]
                return at, here, Bounds(*b), load(y_ref.at[at], here), load(v_ref.at[at], here)

            def measure(number: Array, carry: tuple) -> tuple:
                largest, new = carry
                _, _, bounds, y, v = piece(number)
                outside = jnp.where(y == 0, jnp.abs(violation(bounds, v)), 0.0)
                return (
                    jnp.maximum(largest, jnp.max(jnp.abs(v), axis=1)),
                    jnp.maximum(new, jnp.max(outside, axis=1)),
                )

            none = jnp.zeros(TILE, dtype)
            largest, new = for_each(pieces, measure, (none, none))
            noise, least = NOISE * (1 + largest), jnp.where(singly, new, 0.0)

            def select(number: Array, found: Array) -> Array:
                _, here, bounds, y, v = piece(number)
                in_W = here & joins(bounds, y, v, noise[:, None], least[:, None])
                ones = in_W.astype(jnp.int32)
                rank = found[:, None] + jnp.cumsum(ones, axis=1, dtype=jnp.int32) - 1
                joined = in_W & (rank < rows)
                # (Pallas' interpreter wants places of their own for what is masked, too.)
                place = jnp.where(joined, rank, K + columns[None, :])
                row = jnp.where(joined, (number * CHUNK + columns)[None, :], 0)
                store(order_ref.at[place, slot[:, None]], row, joined)
                return found + jnp.sum(ones, axis=1, dtype=jnp.int32)

            found = for_each(pieces, select, jnp.zeros(TILE, jnp.int32))
            barrier()
            count = jnp.minimum(found, rows)
            blocks = (jnp.max(count) + SIDE - 1) // SIDE

            def place(block: Array, a: int) -> tuple:
                """Row of W, its index in all rows, and in which instances there is such a one."""
                p = block * SIDE + a
                return p, load(order_ref.at[p, slot], p < count, 0), p < count

            def working_rows(row: Array, inside: Array) -> WorkingRows:
                at = (instance, row)
                b = Bounds(*(load(r.at[at], inside) for r in bound_refs))
                return WorkingRows(b, load(y_ref.at[at], inside), load(v_ref.at[at], inside))

            def entry(i: tuple, j: tuple) -> Array:
                at = (instance, i[1], j[1]) if own_S else (i[1], j[1])
                return load(S_ref.at[at], i[2] & j[2])

            scratch = lambda ref, *at: load(ref.at[(*at, slot)], every)
            keep = lambda ref, value, *at: store(ref.at[(*at, slot)], value, every)

            def factor(J: Array, _: Any) -> Any:
                own = [place(J, a) for a in eight]
                D, r = {}, []
                for a in eight:
                    W_row = working_rows(*own[a][1:])
                    r.append(jnp.where(own[a][2], W_row.gradient, 0.0))
                    for b in range(a + 1):
                        D[a, b] = entry(own[a], own[b])
                    D[a, a] = D[a, a] + jnp.where(own[a][2], W_row.slack + RIDGE, 1.0)

                def subtract(p: Array, carry: tuple) -> tuple:
                    D, r = carry
                    x, L = scratch(x_ref, p), [scratch(L_ref, own[a][0], p) for a in eight]
                    D = {(a, b): value - L[a] * L[b] for (a, b), value in D.items()}
                    return D, [value - l * x for value, l in zip(r, L, strict=True)]

                D, r = for_each(J * SIDE, subtract, (D, r))
                inverse = []
                for b in eight:
                    for c in range(b):
                        for a in range(b, SIDE):
                            D[a, b] = D[a, b] - D[a, c] * D[b, c]
                    inverse.append(1 / jnp.sqrt(D[b, b]))
                    for a in range(b + 1, SIDE):
                        D[a, b] = D[a, b] * inverse[b]
                for a in eight:
                    for b in range(a):
                        r[a] = r[a] - D[a, b] * r[b]
                        keep(L_ref, D[a, b], own[a][0], own[b][0])
                    r[a] = r[a] * inverse[a]
                    keep(L_ref, inverse[a], own[a][0], own[a][0])
                    keep(x_ref, r[a], own[a][0])

                def below(I: Array, _: Any) -> Any:
                    its = [place(I, a) for a in eight]
                    X = {(a, b): entry(its[a], own[b]) for a in eight for b in eight}

                    def subtract(p: Array, X: dict) -> dict:
                        left = [scratch(L_ref, its[a][0], p) for a in eight]
                        right = [scratch(L_ref, own[b][0], p) for b in eight]
                        return {(a, b): v - left[a] * right[b] for (a, b), v in X.items()}

                    X = for_each(J * SIDE, subtract, X)
                    for b in eight:
                        for c in range(b):
                            for a in eight:
                                X[a, b] = X[a, b] - X[a, c] * D[b, c]
                        for a in eight:
                            X[a, b] = X[a, b] * inverse[b]
                            keep(L_ref, X[a, b], its[a][0], own[b][0])
                    return _

                return jax.lax.fori_loop(J + 1, blocks, below, _)

            for_each(blocks, factor, jnp.int32(0))

            def back(number: Array, carry: tuple) -> tuple:
                """Solve for the multipliers of a block, from the last to the first."""
                first, stopped = carry
                J = blocks - 1 - number
                own = [place(J, a) for a in eight]
                d = [scratch(x_ref, own[a][0]) for a in eight]

                def subtract(p: Array, d: list) -> list:
                    known = scratch(x_ref, p)
                    return [v - scratch(L_ref, p, own[a][0]) * known for a, v in enumerate(d)]

                d = jax.lax.fori_loop((J + 1) * SIDE, blocks * SIDE, subtract, d)
                for a in reversed(eight):
                    for b in range(a + 1, SIDE):
                        d[a] = d[a] - scratch(L_ref, own[b][0], own[a][0]) * d[b]
                    d[a] = d[a] * scratch(L_ref, own[a][0], own[a][0])
                    keep(x_ref, d[a], own[a][0])
                    W_row = working_rows(*own[a][1:])
                    moved = jnp.where(own[a][2], W_row.moved(d[a]), 0.0)
                    first = jnp.where(own[a][2], jnp.minimum(first, W_row.stops(d[a])), first)
                    stopped = stopped | (own[a][2] & (moved != d[a])).astype(jnp.int32)
                    keep(c_ref, moved, 0, own[a][0])
                return first, stopped

            begin = jnp.ones(TILE, dtype), jnp.zeros(TILE, jnp.int32)
            first, stopped = for_each(blocks, back, begin)

            def search(_: Any) -> Any:
                """Put the change of y with the best dual value in the place of the whole step."""
                lengths = [jnp.full(TILE, t, dtype) for t in LENGTHS] + [first]

                def linear(p: Array, loss: list) -> list:
                    row, inside = load(order_ref.at[p, slot], p < count, 0), p < count
                    W_row, d = working_rows(row, inside), scratch(x_ref, p)
                    changes = [jnp.where(inside, W_row.moved(t * d), 0.0) for t in lengths]
                    for n, change in enumerate(changes):
                        keep(c_ref, change, n, p)
                    part = [W_row.loss(change, 0.0) for change in changes]
                    return [
                        loss + jnp.where(inside, own, 0.0)
                        for loss, own in zip(loss, part, strict=True)
                    ]

                losses = for_each(blocks * SIDE, linear, [none] * candidates)

                def quadratic(p: Array, loss: list) -> list:
                    """½ (L'c)_p², row p of L' for all changes c; the ridge makes no difference."""

                    def row(q: Array, sums: list) -> list:
                        value = scratch(L_ref, q, p)
                        value = jnp.where(q == p, 1 / value, value)
                        return [s + value * scratch(c_ref, n, q) for n, s in enumerate(sums)]

                    sums = jax.lax.fori_loop(p, blocks * SIDE, row, [none] * candidates)
                    return [loss + 0.5 * s * s for loss, s in zip(loss, sums, strict=True)]

                losses = for_each(blocks * SIDE, quadratic, losses)
                least = losses[0]
                for loss in losses[1:]:
                    least = jnp.minimum(least, loss)

                def choose(p: Array, _: Any) -> Any:
                    best = scratch(c_ref, candidates - 1, p)
                    for n in reversed(range(candidates - 1)):
                        best = jnp.where(losses[n] <= least, scratch(c_ref, n, p), best)
                    keep(c_ref, best, 0, p)
                    return _

                return for_each(blocks * SIDE, choose, _)

            jax.lax.cond(jnp.max(stopped) > 0, search, lambda _: _, jnp.int32(0))

            def move(p: Array, _: Any) -> Any:
                row, inside = load(order_ref.at[p, slot], p < count, 0), p < count
                at = (instance, row)
                y = load(y_ref.at[at], inside) + scratch(c_ref, 0, p)
                store(y_ref.at[at], y, inside)
                return _

            for_each(blocks * SIDE, move, jnp.int32(0))
            barrier()

            def update(number: Array, carry: tuple) -> tuple:
                error, largest_v, largest_y = carry
                at, here, bounds, y, v = piece(number)

                def image(p: Array, v: Array) -> Array:
                    row = load(order_ref.at[p, slot], p < count, 0)
                    change = jnp.where(p < count, scratch(c_ref, 0, p), 0.0)
                    place = (row[:, None], at[1])
                    place = (at[0], *place) if own_S else place
                    return v - load(S_ref.at[place], here) * change[:, None]

                v = for_each(jnp.max(count), image, v)
                store(v_ref.at[at], v, here)
                found = sizes(bounds, y, v)
                return tuple(
                    jnp.maximum(old, jnp.max(new, axis=1))
                    for old, new in zip((error, largest_v, largest_y), found, strict=True)
                )

            found_sizes = for_each(pieces, update, (none, none, none))
            taken = jnp.where(is_open, taken + 1, taken)
            go_on = continues(*found_sizes, limit, taken, most, found <= rows)
            return taken, jnp.where(go_on, open_, 0), number + 1

        for_each((tiles - me + programs - 1) // programs, take_tile, jnp.int32(0))

    like = lambda v: jax.ShapeDtypeStruct(v.shape, v.dtype)
    memory = lambda *shape, kind=dtype: jax.ShapeDtypeStruct((*shape, programs * TILE), kind)
    shapes = [
        *map(like, (y, v, steps, go_on)), memory(K + CHUNK, kind=jnp.int32), memory(K, K),
        memory(K), memory(candidates, K),
    ]  # fmt: skip
    run = call(kernel, shapes, grid=(programs,), aliases={2: 0, 3: 1, 4: 2, 5: 3})
    y, v, steps, go_on, *_ = run(S, limit, y, v, steps, go_on, *bound_leaves)
    return y, v, steps, go_on > 0


def for_each(count: Any, body: Any, start: Any) -> Any:
    """Return the carry after body(i, carry) for i = 0, 1, …, count − 1."""
    return jax.lax.fori_loop(jnp.int32(0), jnp.int32(count), body, start)
