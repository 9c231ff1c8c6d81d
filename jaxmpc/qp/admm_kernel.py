"""The steps of ADMM for a batch that shares its matrices, one kernel on NVIDIA GPUs.

As a loop of XLA every step reads and writes t, l, u and b of all instances in memory, in several
launches. Here a program takes a tile of instances through all steps: their vectors stay in
registers, the matrices in shared memory.

The rows are divided into pieces of powers of two, the sizes that Triton takes.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from jaxmpc.pytrees import record
from jaxmpc.qp.admm import Factor
from jaxmpc.qp.jax_transformations import LARGE_BATCH
from jaxmpc.qp.kernel import (
    EXACT,
    LEAST_SIDE,
    ROUGH,
    Product,
    Ref,
    call,
    dot,
    indices,
    load,
    padded_side,
    program,
    store,
)
from jaxmpc.qp.linalg import matmul
from jaxmpc.qp.problem import FREE, Bounds

# Warps of a program.
WARPS = 4
# Bytes of a number of the matrices, as its parts in bfloat16 (`kernel.dot`), and most of all these
# in shared memory: the largest that was tried on an H100, which has 227 KB.
BYTES, MOST_BYTES = {ROUGH: 4, EXACT: 6}, 153_600


def pieces(count: int) -> list[tuple[int, int]]:
    """Return (first, size) of the pieces of `count` entries: at most two powers of two, at least
    LEAST_SIDE, with the smallest sum that holds them all."""
    whole = padded_side(count)
    small = padded_side(max(count - whole // 2, 1))
    if whole == LEAST_SIDE or small == whole // 2:
        return [(0, whole)]
    return [(0, whole // 2), (whole // 2, small)]


def total(parts: list[tuple[int, int]]) -> int:
    """Return the sum of the sizes of pieces."""
    return sum(size for _, size in parts)


def row_pieces(rows: int, balls: tuple[int, ...]) -> list[tuple[int, int]]:
    """Return the pieces of the rows: one where there are balls, whose rows belong together."""
    return [(0, padded_side(rows))] if balls else pieces(rows)


def suits(factor: Factor, balls: tuple[int, ...], dtype: DTypeLike, product: Product) -> bool:
    """Return whether there is a kernel for iterates of this type and matrices of this size."""
    m, n = factor.A.shape[-2:]
    if dtype != jnp.float32:
        return False
    rows, inner = total(row_pieces(m, balls)), total(pieces(n))
    numbers = rows * (min(rows, 2 * inner) + (rows if balls else 0))
    return numbers * BYTES[product] <= MOST_BYTES


def iterate_batch(
    made: Factor,
    alpha: Array,
    q: Array,
    bounds: Bounds,
    t: Array,
    iterations: int,
    product: Product = EXACT,
) -> tuple[Array, Array]:
    """Return `iterate` of a batch: q (B, n), t (B, m) and bounds with B in front of all leaves.
    product: how float32 is multiplied, EXACT, or ROUGH where Newton steps follow."""
    (B, m), dtype, stages, balls = t.shape, t.dtype, len(made.rho), bounds.balls
    if not iterations:
        return t, t
    columns, inner = row_pieces(m, balls), pieces(made.A.shape[1])
    low_rank = 2 * total(inner) < total(columns)
    # More instances a program where there are programs enough for all of the GPU's processors.
    T = 64 if total(columns) <= 64 and B >= LARGE_BATCH else LEAST_SIDE
    times = functools.partial(dot, product=product)

    offsets = [-matmul(matmul(q, Minv), made.A.T) for Minv in made.Minv]
    if low_rank:
        matrices = [_turned(made.F), made.A.T]
    else:
        matrices = [_turned(matmul(made.A, made.F) if made.G is None else made.G)]
    vectors = [jnp.stack(offsets, axis=1), t, *bounds.columns]
    if balls:
        free = m - sum(balls)
        member = np.repeat(np.arange(len(balls) + 1), [free, *balls])
        same = (member[:, None] == member) & (member > 0)
        radius = jnp.repeat(bounds.radius, np.asarray(balls), axis=-1, total_repeat_length=m - free)
        vectors.append(jnp.pad(radius, ((0, 0), (free, 0)), constant_values=jnp.inf))
        matrices.append(jnp.asarray(same, dtype))

    def admm_steps(*refs: Ref) -> None:
        alpha_ref, rho_ref, *rest, out_ref, previous_ref = refs
        matrix_refs, (b_ref, t_ref, *bound_refs) = rest[: len(matrices)], rest[len(matrices) :]
        tile = Tile(program() * T + indices(T), B, m)
        places = [first + indices(size) for first, size in columns]
        ranks = [first + indices(size) for first, size in inner]
        within = TileBounds.read(
            tile, places, bound_refs, matrix_refs[-1] if balls else None, times
        )
        alpha = alpha_ref[0]
        t = [tile.load(t_ref, i) for i in places]
        previous, before = t, None
        for stage in range(stages):
            rho = [load(rho_ref.at[stage, i], i < m, 1.0)[None, :] for i in places]
            if before is not None:  # the multiplier ρv is what carries over, not v
                s = within.project(t, before)
                t = [s + b / r * (t - s) for s, t, b, r in zip(s, t, before, rho, strict=True)]
            before = rho
            b = [tile.load(b_ref, i, stage) for i in places]
            if low_rank:
                down = _blocks(matrix_refs[0], places, ranks, stage)
                parts = [down, _blocks(matrix_refs[1], ranks, places, None)]
            else:
                parts = [_blocks(matrix_refs[0], places, places, stage)]
            step = functools.partial(_step, within, parts, alpha, rho, b)
            count = jnp.int32(iterations // stages)
            t, previous = jax.lax.fori_loop(jnp.int32(0), count, step, (t, previous))
        for ref, value in ((out_ref, t), (previous_ref, previous)):
            for i, v in zip(places, value, strict=True):
                tile.store(ref, i, v)

    shapes = [jax.ShapeDtypeStruct((B, m), dtype)] * 2
    run = call(admm_steps, shapes, WARPS, -(-B // T))
    return tuple(run(jnp.reshape(alpha, 1).astype(dtype), made.rho, *matrices, *vectors))


# A vector of each instance of a tile, (T, size) a piece.
Parts = list[Array]
# Pieces of a matrix: a list for each piece of columns, of a block for each piece of rows.
Blocks = list[list[Array]]


@record
class Tile:
    """The instances of one program: places (T,) in a batch of `batch` with `rows` rows each."""

    places: Array
    batch: int
    rows: int

    def load(self, ref: Ref, i: Array, *stage: int, other: float = 0.0) -> Array:
        """Return the entries i of the vectors of a stage."""
        at = (self.places[:, None], *stage, i[None, :])
        return load(ref.at[at], self._inside(i), other)

    def store(self, ref: Ref, i: Array, value: Array) -> None:
        """Store the entries i of the vectors."""
        inside = self._inside(i)
        store(ref.at[self.places[:, None], i[None, :]], value, inside)

    def _inside(self, i: Array) -> Array:
        return (self.places[:, None] < self.batch) & (i[None, :] < self.rows)


@record
class TileBounds:
    """The bounds of the instances of a tile, piece by piece; with balls, of which there is one
    piece, the radius of the ball of each row, and which rows are of the same."""

    pieces: list[Bounds]
    dot: Callable[[Array, Array], Array]
    balls: tuple[Array, Array] | None

    @classmethod
    def read(
        cls, tile: Tile, places: list[Array], refs: list[Ref], same: Ref | None, dot: Callable
    ) -> "TileBounds":
        """Return them as they are in memory: l, u, weights of soft rows, and radius."""
        balls = None
        if same is not None:
            *refs, radius_ref = refs
            radius = tile.load(radius_ref, places[0], other=jnp.inf)
            balls = radius, _block(same, places[0], places[0], None)
        columns = list(zip(refs, FREE, strict=False))
        at = lambda i: Bounds.of_rows(tile.load(ref, i, other=free) for ref, free in columns)
        return cls([at(i) for i in places], dot, balls)

    def project(self, t: Parts, rho: Parts) -> Parts:
        """Return prox(t) of g/rho."""
        if self.balls is None:
            return [b.project(v, r) for b, v, r in zip(self.pieces, t, rho, strict=True)]
        (radius, same), [b], [v], [r] = self.balls, self.pieces, t, rho
        s, in_ball = b.outside(v), radius < jnp.inf
        squared = jnp.where(in_ball, s * s, 0.0)
        length = jnp.sqrt(self.dot(squared, same))
        outside = length > radius
        shrinking = jnp.where(outside, radius / jnp.where(outside, length, 1.0), 1.0)
        return [v - jnp.where(in_ball, s * (1 - shrinking), b.prox_residual(v, r))]

    def times(self, parts: Parts, blocks: Blocks) -> Parts:
        """Return the product of vectors and a matrix."""
        products = [list(map(self.dot, parts, column)) for column in blocks]
        return [sum(rest, first) for first, *rest in products]


def _step(
    within: TileBounds,
    matrices: list[Blocks],
    alpha: Array,
    rho: Parts,
    b: Parts,
    _: Array,
    carry: tuple[Parts, Parts],
) -> tuple[Parts, Parts]:
    """Return t after a step of ADMM, and before it. matrices: G, or A and F whose product it is."""
    t, _previous = carry
    s = within.project(t, rho)
    r = [2 * s - t for s, t in zip(s, t, strict=True)]
    Gr = functools.reduce(within.times, matrices, r)
    new = [t + alpha * (g + b - s) for t, g, b, s in zip(t, Gr, b, s, strict=True)]
    return new, t


def _turned(M: Array) -> Array:
    return jnp.swapaxes(M, -1, -2)


def _block(ref: Ref, i: Array, j: Array, stage: int | None) -> Array:
    """Return the rows i and columns j of a matrix, of a stage where there are several."""
    at = (i[:, None], j[None, :])
    rows, columns = ref.shape[-2:]
    where = ref.at[at] if stage is None else ref.at[(stage, *at)]
    return load(where, (i[:, None] < rows) & (j[None, :] < columns))


def _blocks(ref: Ref, rows: list[Array], columns: list[Array], stage: int | None) -> Blocks:
    return [[_block(ref, i, j, stage) for i in rows] for j in columns]
