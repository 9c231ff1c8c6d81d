"""Kernels for NVIDIA GPUs (Pallas, Triton): what they share, and small definite systems.

`solve` takes one program for each system, which holds the matrix in its registers. JAX's batched
routines take several launches a system size, and 10 to 50 times as long for up to 64 rows.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

# Lengths of a side: powers of two, as Triton asks, and 16 at least for its products. A warp's
# registers hold a matrix of WARP_SIDE, four warps' one of the last.
SIDES = (16, 32, 64)
WARP_SIDE = 32


def solve(K: Array, b: Array, *, interpret: bool = False) -> Array:
    """Return K⁻¹b (n,) for K (n, n) symmetric positive definite, n ≤ 64; NaN where it is not.

    Gaussian elimination, which needs no pivoting for such K, of [K, b] and substitution.
    `jax.vmap` for many, a program each.
    """
    n = b.shape[0]

    def kernel(K_ref: Any, b_ref: Any, x_ref: Any) -> None:
        side = side_of(n)
        i = jnp.arange(side, dtype=jnp.int32)
        row, column = i[:, None], i[None, :]

        def eliminated(j: Array, carry: tuple) -> tuple:
            M, b, least = carry
            along = jnp.sum(jnp.where(row == j, M, 0.0), axis=0)
            down = jnp.sum(jnp.where(column == j, M, 0.0), axis=1)
            pivot = jnp.sum(jnp.where(i == j, along, 0.0))
            factors = jnp.where(i > j, down / pivot, 0.0)
            b = b - factors * jnp.sum(jnp.where(i == j, b, 0.0))
            return M - factors[:, None] * along[None, :], b, jnp.minimum(least, pivot)

        def substituted(step: Array, carry: tuple) -> tuple:
            M, b = carry
            j = n - 1 - step
            down = jnp.sum(jnp.where(column == j, M, 0.0), axis=1)
            x = jnp.sum(jnp.where(i == j, b, 0.0)) / jnp.sum(jnp.where(i == j, down, 0.0))
            return M, jnp.where(i == j, x, jnp.where(i < j, b - down * x, b))

        zero, end = jnp.int32(0), jnp.int32(n)
        start = matrix(K_ref, None, n, n, side), load(b_ref.at[i], i < n)
        infinite = jnp.full((), jnp.inf, K.dtype)
        M, b, least = jax.lax.fori_loop(zero, end, eliminated, (*start, infinite))
        _, x = jax.lax.fori_loop(zero, end, substituted, (M, b))
        store(x_ref.at[i], jnp.where(least > 0, x, jnp.nan), i < n)

    warps = 1 if n <= WARP_SIDE else 4
    return call(kernel, jax.ShapeDtypeStruct(b.shape, b.dtype), interpret, warps)(K, b)


def call(kernel: Callable, shapes: Any, interpret: bool, warps: int = 1) -> Callable:
    """Return the kernel as a function of arrays: one program, of so many warps, for each instance;
    `vmap` makes the grid. interpret: run it by Pallas' interpreter, on any device."""
    from jax.experimental import pallas
    from jax.experimental.pallas import triton

    options = triton.CompilerParams(num_warps=warps, num_stages=1)
    return pallas.pallas_call(
        kernel, out_shape=shapes, compiler_params=options, interpret=interpret
    )


def side_of(n: int) -> int:
    """Return the least power of two that Triton takes and that holds n."""
    return next(side for side in SIDES if n <= side)


def matrix(ref: Any, k: Any, rows: int, columns: int, side: int | None = None) -> Array:
    """Return the matrix (rows, columns) at stage k (None: the only one), filled up with zeros."""
    side = side_of(max(rows, columns)) if side is None else side
    i = jnp.arange(side, dtype=jnp.int32)
    row, column = i[:, None], i[None, :]
    place = ref.at[row, column] if k is None else ref.at[k, row, column]
    return load(place, (row < rows) & (column < columns))


def load(place: Any, mask: Array) -> Array:
    """Return what lies at `place` of a reference, 0 where the mask is false."""
    from jax.experimental.pallas import triton

    return triton.load(place, mask=mask, other=0.0)


def store(place: Any, value: Array, mask: Array) -> None:
    """Write `value` to `place` of a reference where the mask is true."""
    from jax.experimental.pallas import triton

    triton.store(place, value, mask=mask)


def barrier() -> None:
    """Let the program load from here on what it has stored before."""
    from jax.experimental.pallas import triton

    triton.debug_barrier()
