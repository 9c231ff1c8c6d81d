"""Float64 evaluation and products at full precision, whatever JAX's settings are."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_batching import custom_vmap
from jax.typing import DTypeLike

from jaxmpc.qp.jax_modes import own_modes

T = TypeVar("T")
A = TypeVar("A", Array, np.ndarray)

# float32 products on NVIDIA cards drop to 10 bits (TF32) unless told otherwise.
PRECISION = jax.lax.Precision.HIGHEST


def matmul(a: Array, b: Array) -> Array:
    """Matrix product at full precision of the data's type.

    Vectors stand on the left, x'M: under `vmap` with M unbatched that is one product of the
    batch (B, n)·(n, m) without a transposition.
    """
    return jnp.matmul(a, b, precision=PRECISION)


def arrays(tree: T) -> T:
    """Leaves as JAX arrays of the present precision, before they enter `jit`.

    (`jit` mixes up host arrays that it has seen under the other setting of 64-bit mode.)
    """
    cast = lambda v: jnp.asarray(v, jax.dtypes.canonicalize_dtype(jnp.result_type(v)))
    return jax.tree.map(cast, tree)


def floating_dtype(tree: Any) -> jnp.dtype:
    """The widest floating type among the leaves, at least float32: no factorization exists in half
    precision. JAX's default float where there is none."""
    types = [leaf.dtype for leaf in jax.tree.leaves(arrays(tree))]
    floats = [dtype for dtype in types if jnp.issubdtype(dtype, jnp.floating)]
    if not floats:
        return jnp.result_type(float)
    return jnp.dtype(jnp.float64 if jnp.dtype(jnp.float64) in floats else jnp.float32)


def symmetric(M: A) -> A:
    """Return the symmetric part of a matrix, which is all that a quadratic form knows of it."""
    return (M + M.swapaxes(-1, -2)) / 2


def in_float64(function: Callable[..., T]) -> Callable[..., T]:
    """The function of float32 arrays, computed in float64, its floating results in float32.

    For residuals, which are small differences of large terms. Works whether or not 64-bit mode
    is on, under any order of `jit` and `vmap`; not differentiable. A plain `jax.enable_x64` would
    hold while the function is traced but not when `vmap` later rewrites the trace: hence a
    batching rule of our own, which turns the mode on again.
    """

    def convert(tree: Any, dtype: DTypeLike) -> Any:
        floats = lambda v: jnp.issubdtype(v.dtype, jnp.floating)
        return jax.tree.map(lambda v: v.astype(dtype) if floats(v) else v, tree)

    def evaluate(*arguments: Any) -> Any:
        return convert(function(*convert(arguments, jnp.float64)), jnp.float32)

    return _with_x64(evaluate)


def precisely(function: Callable[..., T], *arguments: Any) -> T:
    """Return function(*arguments), evaluated in float64 also where the data are float32.

    Not differentiable where they are (`in_float64`): the derivative is zero.
    """
    if floating_dtype(arguments) == jnp.float64:
        return function(*arguments)
    return in_float64(function)(*jax.lax.stop_gradient(arguments))


def rounding(dtype: DTypeLike) -> float:
    """Return the relative size of what counts as rounding in a residual of data of this type."""
    return (100 if jnp.finfo(dtype).eps < 1e-10 else 4) * float(jnp.finfo(dtype).eps)


def _with_x64(function: Callable) -> Callable:
    @custom_vmap
    def wrapped(*arguments: Any) -> Any:
        with jax.enable_x64(True):
            return function(*arguments)

    @wrapped.def_vmap
    @own_modes
    def batched(axis_size: int, in_batched: Any, *arguments: Any) -> Any:
        axes = jax.tree.map(lambda b: 0 if b else None, tuple(in_batched))
        out = _with_x64(jax.vmap(function, in_axes=axes))(*arguments)
        return out, jax.tree.map(lambda _: True, out)

    return wrapped
