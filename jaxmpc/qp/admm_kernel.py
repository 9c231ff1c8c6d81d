"""The steps of ADMM for a batch that shares its matrices, one kernel on NVIDIA GPUs.

As a loop of XLA every step reads and writes t, l, u and b of all instances in memory, in several
launches. Here a program takes a tile of instances through all steps: their vectors stay in
registers, the matrices in shared memory.

The rows are divided into pieces of powers of two, the sizes that Triton takes.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.qp import triton
from jaxmpc.qp.admm import Factor
from jaxmpc.qp.loops import LARGE
from jaxmpc.qp.precision import matmul
from jaxmpc.qp.projection import FREE, Bounds
from jaxmpc.qp.triton import (
    EXACT,
    LEAST,
    ROUGH,
    call,
    has_kernels,
    indices,
    load,
    padded_side,
    program,
    store,
)

# Warps of a program.
WARPS = 4
# Bytes of a number of the matrices, as its parts in bfloat16 (`triton.dot`), and most of all these
# in shared memory: the largest that was tried on an H100, which has 227 KB.
BYTES, MOST_BYTES = {ROUGH: 4, EXACT: 6}, 153_600


def pieces(count: int) -> list[tuple[int, int]]:
    """Return (first, size) of the pieces of `count` entries: at most two powers of two, LEAST at
    least, with the smallest sum that holds them all."""
    whole = padded_side(count)
    small = padded_side(max(count - whole // 2, 1))
    if whole == LEAST or small == whole // 2:
        return [(0, whole)]
    return [(0, whole // 2), (whole // 2, small)]


def total(parts: list[tuple[int, int]]) -> int:
    """Return the sum of the sizes of pieces."""
    return sum(size for _, size in parts)


def row_pieces(rows: int, balls: tuple[int, ...]) -> list[tuple[int, int]]:
    """Return the pieces of the rows: one where there are balls, whose rows belong together."""
    return [(0, padded_side(rows))] if balls else pieces(rows)


def suits(factor: Factor, balls: tuple[int, ...], dtype: Any, product: Any) -> bool:
    """Return whether there is a kernel for iterates of this type and matrices of this size."""
    m, n = factor.A.shape[-2:]
    if not has_kernels(m) or dtype != jnp.float32:
        return False
    rows, inner = total(row_pieces(m, balls)), total(pieces(n))
    numbers = rows * (min(rows, 2 * inner) + (rows if balls else 0))
    return numbers * BYTES[product] <= MOST_BYTES


def iterate_batch(
    factor: Factor, alpha: Array, q: Array, bounds: Bounds, t: Array, iterations: int,
    product: Any = EXACT,
) -> tuple[Array, Array]:  # fmt: skip
    """Return `iterate` of a batch: q (B, n), t (B, m) and bounds with B in front of all leaves.
    product: how float32 is multiplied, EXACT, or ROUGH where Newton steps follow."""
    (B, m), dtype, stages = t.shape, t.dtype, len(factor.rho)
    if not iterations:
        return t, t
    balls = bounds.balls
    columns = row_pieces(m, balls)
    inner = pieces(factor.A.shape[1])
    low_rank = 2 * total(inner) < total(columns)
    # More instances a program where there are programs enough for all of the GPU's processors.
    T = 64 if total(columns) <= 64 and B >= LARGE else LEAST
    dot = functools.partial(triton.dot, product=product)

    offsets = [-matmul(matmul(q, Minv), factor.A.T) for Minv in factor.Minv]
    turned = lambda M: jnp.swapaxes(M, -1, -2)
    if low_rank:
        matrices = [turned(factor.F), factor.A.T]
    else:
        matrices = [turned(matmul(factor.A, factor.F) if factor.G is None else factor.G)]
    vectors = [jnp.stack(offsets, axis=1), t, *bounds.columns]
    if balls:
        free = m - sum(balls)
        member = np.repeat(np.arange(len(balls) + 1), [free, *balls])
        same = (member[:, None] == member) & (member > 0)
        radius = jnp.repeat(bounds.radius, np.asarray(balls), axis=-1, total_repeat_length=m - free)
        vectors.append(jnp.pad(radius, ((0, 0), (free, 0)), constant_values=jnp.inf))
        matrices.append(jnp.asarray(same, dtype))

    def kernel(*refs: Any) -> None:
        alpha_ref, rho_ref, *rest = refs
        *rest, out_ref, previous_ref = rest
        matrix_refs, vector_refs = rest[: len(matrices)], rest[len(matrices) :]
        row = program() * T + indices(T)
        places = [first + indices(size) for first, size in columns]
        ranks = [first + indices(size) for first, size in inner]

        def matrix(ref: Any, i: Array, j: Array, stage: int | None) -> Array:
            at = (i[:, None], j[None, :])
            rows, cols = ref.shape[-2:]
            where = ref.at[at] if stage is None else ref.at[(stage, *at)]
            return load(where, (i[:, None] < rows) & (j[None, :] < cols))

        def vector(ref: Any, i: Array, *stage: int, other: float = 0.0) -> Array:
            at = (row[:, None], *stage, i[None, :])
            return load(ref.at[at], (row[:, None] < B) & (i[None, :] < m), other)

        def times(parts: list[Array], blocks: list[list[Array]]) -> list[Array]:
            return [
                sum((dot(r, M) for r, M in zip(parts[1:], column[1:], strict=True)),
                    dot(parts[0], column[0]))
                for column in blocks
            ]  # fmt: skip

        def all_blocks(ref: Any, rows: list, cols: list, stage: int | None) -> list[list[Array]]:
            return [[matrix(ref, i, j, stage) for i in rows] for j in cols]

        b_ref, t_ref, *bound_refs = vector_refs
        if balls:
            *bound_refs, radius_ref = bound_refs
            radius = vector(radius_ref, places[0], other=jnp.inf)
            same = matrix(matrix_refs[-1], places[0], places[0], None)
        tiles = [
            Bounds.of_rows(
                vector(ref, i, other=free) for ref, free in zip(bound_refs, FREE, strict=False)
            )
            for i in places
        ]

        def project(t: list[Array], rho: list[Array]) -> list[Array]:
            if not balls:
                return [b.project(v, r) for b, v, r in zip(tiles, t, rho, strict=True)]
            [b], [v], [r] = tiles, t, rho
            s, in_ball = v - jnp.clip(v, b.l, b.u), radius < jnp.inf
            squared = jnp.where(in_ball, s * s, 0.0)
            length = jnp.sqrt(dot(squared, same))
            outside = length > radius
            factor = jnp.where(outside, radius / jnp.where(outside, length, 1.0), 1.0)
            return [v - jnp.where(in_ball, s * (1 - factor), b.prox_residual(v, r))]

        alpha = alpha_ref[0]
        t = [vector(t_ref, i) for i in places]
        previous, before = t, None
        for stage in range(stages):
            rho = [load(rho_ref.at[stage, i], i < m, 1.0)[None, :] for i in places]
            if before is not None:  # the multiplier R v is what carries over, not v
                s = project(t, before)
                t = [s + b / r * (t - s) for s, t, b, r in zip(s, t, before, rho, strict=True)]
            before = rho
            b = [vector(b_ref, i, stage) for i in places]
            if low_rank:
                down = all_blocks(matrix_refs[0], places, ranks, stage)
                factors = [down, all_blocks(matrix_refs[1], ranks, places, None)]
            else:
                factors = [all_blocks(matrix_refs[0], places, places, stage)]

            def step(_: Any, carry: Any, rho: Any = rho, b: Any = b, factors: Any = factors) -> Any:
                t, _ = carry
                s = project(t, rho)
                r = [2 * s - t for s, t in zip(s, t, strict=True)]
                image = functools.reduce(times, factors, r)
                new = [t + alpha * (i + b - s) for t, i, b, s in zip(t, image, b, s, strict=True)]
                return new, t

            count = jnp.int32(iterations // stages)
            t, previous = jax.lax.fori_loop(jnp.int32(0), count, step, (t, previous))
        for ref, value in ((out_ref, t), (previous_ref, previous)):
            for i, v in zip(places, value, strict=True):
                inside = (row[:, None] < B) & (i[None, :] < m)
                store(ref.at[row[:, None], i[None, :]], v, inside)

    shapes = [jax.ShapeDtypeStruct((B, m), dtype)] * 2
    run = call(kernel, shapes, WARPS, (-(-B // T),))
    return tuple(run(jnp.reshape(alpha, 1).astype(dtype), factor.rho, *matrices, *vectors))
