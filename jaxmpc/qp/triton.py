"""What the kernels for NVIDIA GPUs share (Pallas, Triton): calls, masked loads and stores, sizes.

Triton's arrays have powers of two as sizes: `padded_side` and masks stand for others. Without a GPU
Pallas' interpreter runs the kernels, slowly: for tests. Pallas is imported where a kernel is made,
so that machines without GPUs never load it.
"""

from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.qp.jax_transformations import on_gpu

# Least side of a matrix in Triton's products.
LEAST = 16
# float32 products as sums of six products of bfloat16, as exact as float32's own, or of three, with
# errors of 2⁻¹⁶.
Product = jax.lax.DotAlgorithmPreset
EXACT, ROUGH = Product.BF16_BF16_F32_X6, Product.BF16_BF16_F32_X3


class Ref(Protocol):
    """Memory of a kernel: of an argument, of a result, or of its own."""

    @property
    def shape(self) -> tuple[int, ...]:
        """The number of entries along each axis."""

    @property
    def at(self) -> Any:
        """`at[i]`: the place of entry i, to `load` from or to `store` to."""

    def __getitem__(self, i: int) -> Array:
        """Return entry i."""


def call(
    kernel: Callable,
    shapes: Any,
    warps: int = 1,
    grid: tuple[int, ...] = (),
    aliases: dict[int, int] | None = None,
) -> Callable:
    """Return the kernel as a function of arrays, with one program for each place of the grid;
    `vmap` puts another axis in front of it. aliases: arguments whose memory a result takes over."""
    from jax.experimental import pallas
    from jax.experimental.pallas import triton

    options = triton.CompilerParams(num_warps=warps, num_stages=1)
    return pallas.pallas_call(
        kernel,
        out_shape=shapes,
        grid=grid,
        compiler_params=options,
        interpret=not on_gpu(),
        input_output_aliases=aliases or {},
    )


def padded_side(n: int) -> int:
    """Return the least power of two that holds n, at least LEAST."""
    return max(1 << (n - 1).bit_length(), LEAST)


def indices(count: int) -> Array:
    """Return 0, 1, …, count − 1 as int32, whatever JAX's settings are."""
    return jnp.arange(count, dtype=jnp.int32)


def program() -> Array:
    """Return the place of this program in the grid."""
    from jax.experimental import pallas

    return pallas.program_id(0)


def dot(a: Array, b: Array, product: Product) -> Array:
    """Return the product of two matrices; product: EXACT or ROUGH, for float32 on tensor cores."""
    precision = product if on_gpu() and a.dtype == jnp.float32 else None
    return jax.lax.dot_general(
        a, b, (((1,), (0,)), ((), ())), precision=precision, preferred_element_type=a.dtype
    )


def load(place: Any, mask: Array, other: float = 0.0) -> Array:
    """Return what stands at `place`, and `other` where the mask is false."""
    from jax.experimental.pallas import triton

    return triton.load(place, mask=mask, other=other)


def store(place: Any, value: Array, mask: Array) -> None:
    """Store where the mask is true."""
    from jax.experimental.pallas import triton

    triton.store(place, value, mask=mask)


def barrier() -> None:
    """What the program has stored may be loaded from here on."""
    from jax.experimental.pallas import triton

    if on_gpu():
        triton.debug_barrier()


def in_one_program(
    function: Callable, data: list[tuple[Array, float]], lengths: list[int], numbers: int
) -> tuple[list[Array], list[Array]]:
    """Return function(*vectors), a list of vectors and a list of so many numbers, all of one type,
    computed by one program: one launch for a batch, and no intermediate result in memory.

    data: vectors and what they are filled up with, to a power of two; lengths: those of the vectors
    returned. The function consists of operations entry by entry and reductions.
    """
    dtype = data[0][0].dtype

    def in_registers(*refs: Ref) -> None:
        *in_refs, numbers_ref = refs
        in_refs, out_refs = in_refs[: len(data)], in_refs[len(data) :]

        def read(ref: Ref, count: int, fill: float) -> Array:
            i = indices(padded_side(count))
            return load(ref.at[i], i < count, fill)

        given = [read(ref, len(v), fill) for ref, (v, fill) in zip(in_refs, data, strict=True)]
        vectors, found = function(*given)
        for ref, vector, count in zip(out_refs, vectors, lengths, strict=True):
            i = indices(len(vector))
            store(ref.at[i], vector, i < count)
        k, together = indices(padded_side(numbers)), jnp.zeros(padded_side(numbers), dtype)
        for n, number in enumerate(found):
            together = jnp.where(k == n, number.astype(dtype), together)
        store(numbers_ref.at[k], together, k < numbers)

    shapes = [jax.ShapeDtypeStruct((count,), dtype) for count in [*lengths, numbers]]
    *vectors, found = call(in_registers, shapes)(*(vector for vector, _ in data))
    return vectors, list(found)
