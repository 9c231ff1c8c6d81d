"""Kernels for NVIDIA GPUs, written with JAX's operations and with loads and stores.

A kernel is a function of `Ref`s, the memory of its arguments and results. Programs run it side by
side, one for each instance of a batch and each place of a grid. It is traced once, to a jaxpr in
which loads and stores are primitives, and lowered for the machine that runs it:

* for a GPU `triton_source` writes the jaxpr as a function of Triton, which jax-triton compiles, or,
  where that is not installed, Pallas' Triton backend, which JAX calls deprecated, takes it;
* elsewhere, for tests, one program runs after the other, slowly, on arrays that stand for memory.

Triton's arrays have powers of two as sizes: `padded_side` and masks stand for others.
"""

import math
import threading
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.extend.core import Literal, Primitive
from jax.interpreters import batching, mlir

from jaxmpc.pytrees import record
from jaxmpc.qp.jax_transformations import called_jaxpr, has_jax_triton, on_gpu
from jaxmpc.qp.triton_source import triton_function, triton_source

# Least side of a matrix in Triton's products.
LEAST_SIDE = 16
# float32 products as sums of six products of bfloat16, as exact as float32's own, or of three, with
# errors of 2⁻¹⁶.
Product = lax.DotAlgorithmPreset
EXACT, ROUGH = Product.BF16_BF16_F32_X6, Product.BF16_BF16_F32_X3

load_p, store_p = Primitive("load"), Primitive("store")
barrier_p, program_p = Primitive("barrier"), Primitive("program")
kernel_p = Primitive("gpu_kernel")
kernel_p.multiple_results = True


@record
class Ref:
    """Memory of a kernel: of its argument or result `number`, of so many entries along each axis,
    or of its own."""

    number: int
    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def at(self) -> "Places":
        """`at[i]`: the place of entry i, to `load` from or to `store` to."""
        return Places(self)

    def __getitem__(self, i: int) -> Array:
        """Return entry i."""
        return load(self.at[i])


class Place(NamedTuple):
    """Entries of the memory of a kernel, by their number in the order of rows."""

    ref: Ref
    offset: Array


@record
class Places:
    """All places of a `Ref`."""

    ref: Ref

    def __getitem__(self, index: Any) -> Place:
        """Return the places of an index, or of a tuple of them that are broadcast."""
        index = index if isinstance(index, tuple) else (index,)
        shape = self.ref.shape
        strides = (math.prod(shape[k + 1 :]) for k in range(len(shape)))
        steps = (i if s == 1 else i * s for i, s in zip(index, strides, strict=True))
        return Place(self.ref, jnp.asarray(sum(steps), jnp.int32))


@record
class Kernel:
    """A traced kernel.

    jaxpr: of no argument and no result. inputs, outputs: the memory of each. own: places of its own
    grid.
    """

    name: str
    jaxpr: Any
    inputs: list[Ref]
    outputs: list[Ref]
    own: int
    warps: int


class _Trace(threading.local):
    """Results of stores and barriers of the kernel that this thread traces: JAX forgets equations
    that nobody holds the result of."""

    held: list[Array] | None = None


_trace = _Trace()


def call(kernel: Callable, shapes: Any, warps: int = 1, grid: int = 1) -> Callable:
    """Return the kernel as a function of arrays, with one program for each place of the grid.
    `vmap` makes it one of a batch of them.

    shapes: those of the results.
    """
    out, tree = jax.tree.flatten(shapes)

    def run(*args: Array) -> Any:
        types = [*args, *out]
        refs = [Ref(k, v.shape, np.dtype(v.dtype)) for k, v in enumerate(types)]
        _trace.held = []
        try:
            jaxpr = jax.make_jaxpr(lambda: kernel(*refs))()
        finally:
            _trace.held = None
        inputs, outputs = refs[: len(args)], refs[len(args) :]
        traced = Kernel(kernel.__name__, jaxpr, inputs, outputs, grid, warps)
        batched = ((),) * len(args)
        return jax.tree.unflatten(
            tree, kernel_p.bind(*args, kernel=traced, batched=batched, batch=())
        )

    return run


def padded_side(n: int, least: int = LEAST_SIDE) -> int:
    """Return the least power of two that holds n, at least `least`."""
    return max(1 << (n - 1).bit_length(), least)


def indices(count: int) -> Array:
    """Return 0, 1, …, count − 1 as int32, whatever JAX's settings are."""
    return jnp.arange(count, dtype=jnp.int32)


def program() -> Array:
    """Return the place of this program in the grid."""
    return program_p.bind()


def dot(a: Array, b: Array, product: Product) -> Array:
    """Return the product of two matrices; product: EXACT or ROUGH, for float32 on tensor cores."""
    if min(*a.shape, *b.shape) < LEAST_SIDE:
        return jnp.sum(a.T[:, :, None] * b[:, None, :], axis=0)
    return lax.dot_general(
        a, b, (((1,), (0,)), ((), ())), precision=product, preferred_element_type=a.dtype
    )


def load(place: Place, mask: Array | bool = True, other: float = 0.0) -> Array:
    """Return what stands at `place`, and `other` where the mask is false."""
    offset, mask = jnp.broadcast_arrays(place.offset, mask)
    return load_p.bind(offset, mask, ref=place.ref, other=other)


def gather(ref: Ref, rows: Array, columns: Array, mask: Array) -> Array:
    """Return ref[rows, columns], a matrix, and zeros where the mask is false.

    Loaded as a vector: of a matrix whose neighbours do not stand side by side Triton 3.6 gives each
    thread a part of a row, where sums down the columns, of which the sweeps of `dual` consist, take
    twice the registers and shuffles."""
    place, count = ref.at[rows[:, None], columns[None, :]], len(rows) * len(columns)
    vector = load(Place(ref, jnp.reshape(place.offset, count)), jnp.reshape(mask, count))
    return jnp.reshape(vector, (len(rows), len(columns)))


def store(place: Place, value: Array, mask: Array | bool = True) -> None:
    """Store where the mask is true."""
    offset, value, mask = jnp.broadcast_arrays(place.offset, value, mask)
    _hold(store_p.bind(offset, value.astype(place.ref.dtype), mask, ref=place.ref))


def barrier() -> None:
    """What the program has stored may be loaded from here on."""
    _hold(barrier_p.bind())


def _hold(result: Array) -> None:
    assert _trace.held is not None, "loads and stores stand in a kernel"
    _trace.held.append(result)


def in_one_program(
    function: Callable,
    numbers: list[Any],
    data: list[tuple[Array, float]],
    lengths: list[int],
    count: int,
) -> tuple[list[Array], list[Array]]:
    """Return function(*numbers, *vectors), a list of vectors and a list of `count` numbers, all of
    one type, computed by one program: one launch for a batch, and no intermediate result in memory.

    data: vectors and what they are filled up with, to a power of two; lengths: those of the vectors
    returned. The function consists of operations entry by entry and reductions.
    """
    dtype = data[0][0].dtype

    def in_registers(*refs: Ref) -> None:
        given_ref, *in_refs, found_ref = refs
        in_refs, out_refs = in_refs[: len(data)], in_refs[len(data) :]

        def read(ref: Ref, length: int, fill: float) -> Array:
            i = indices(padded_side(length))
            return load(ref.at[i], i < length, fill)

        vectors = [read(ref, len(v), fill) for ref, (v, fill) in zip(in_refs, data, strict=True)]
        vectors, found = function(*map(given_ref.__getitem__, range(len(numbers))), *vectors)
        for ref, vector, length in zip(out_refs, vectors, lengths, strict=True):
            i = indices(len(vector))
            store(ref.at[i], vector, i < length)
        k, together = indices(padded_side(count)), jnp.zeros(padded_side(count), dtype)
        for n, number in enumerate(found):
            together = jnp.where(k == n, number.astype(dtype), together)
        store(found_ref.at[k], together, k < count)

    shapes = [jax.ShapeDtypeStruct((length,), dtype) for length in [*lengths, count]]
    given = jnp.stack(numbers).astype(dtype)
    *vectors, found = call(in_registers, shapes)(given, *(vector for vector, _ in data))
    return vectors, list(found)


@load_p.def_abstract_eval
def _(offset: Any, mask: Any, *, ref: Ref, other: float) -> Any:
    return jax.core.ShapedArray(offset.shape, ref.dtype)


@store_p.def_abstract_eval
def _(offset: Any, value: Any, mask: Any, *, ref: Ref) -> Any:
    return jax.core.ShapedArray((), np.dtype(np.int32))


@barrier_p.def_abstract_eval
@program_p.def_abstract_eval
def _() -> Any:
    return jax.core.ShapedArray((), np.dtype(np.int32))


@kernel_p.def_abstract_eval
def _(*args: Any, kernel: Kernel, batched: tuple, batch: tuple[int, ...]) -> list:
    return [jax.core.ShapedArray((*batch, *ref.shape), ref.dtype) for ref in kernel.outputs]


@kernel_p.def_impl
def _(*args: Any, **params: Any) -> list[Array]:
    return jax.jit(partial(kernel_p.bind, **params))(*args)


def _batched_kernel(
    args: tuple, axes: tuple, *, kernel: Kernel, batched: tuple, batch: tuple
) -> Any:
    """Return the kernel of one more batch, whose axis is in front. batched: for each argument which
    axes of the batch it has."""
    size = next(v.shape[axis] for v, axis in zip(args, axes, strict=True) if axis is not None)
    given, flags = list(args), []
    for k, axis in enumerate(axes):
        has = axis is not None
        if has:
            given[k] = jnp.moveaxis(given[k], axis, 0)
        flags.append((has, *batched[k]))
    out = kernel_p.bind(*given, kernel=kernel, batched=tuple(flags), batch=(size, *batch))
    return out, [0] * len(out)


batching.primitive_batchers[kernel_p] = _batched_kernel


def _lowered_by_triton(*args: Array, kernel: Kernel, batched: tuple, batch: tuple) -> list[Array]:
    programs = math.prod(batch) * kernel.own
    shapes = [jax.ShapeDtypeStruct((*batch, *ref.shape), ref.dtype) for ref in kernel.outputs]
    if not programs:
        return [lax.full(v.shape, 0, v.dtype) for v in shapes]
    if not has_jax_triton():
        return _each(partial(_by_pallas, kernel), batched, batch)(*args)
    import jax_triton

    # Newer versions have other names for the types of the results and for options of the compiler,
    # which from Triton 3.10 on contracts no products and sums where it is not told to.
    names, fused = jax_triton.triton_call.__kwdefaults__, {"enable_fp_fusion": True}
    with jax.enable_x64(True):  # what is lowered outside 64-bit mode may have been traced in it
        return jax_triton.triton_call(
            *args,
            kernel=triton_function(triton_source(kernel, batched, batch)),
            grid=(programs,),
            name=kernel.name,
            num_warps=kernel.warps,
            num_stages=1,
            **{"out_type" if "out_type" in names else "out_shape": shapes},
            **({"backend_options": fused} if "backend_options" in names else fused),
        )


def _lowered_in_turn(*args: Array, kernel: Kernel, batched: tuple, batch: tuple) -> list[Array]:
    return _each(partial(_in_turn, kernel), batched, batch)(*args)


mlir.register_lowering(kernel_p, mlir.lower_fun(_lowered_in_turn, multiple_results=True))
mlir.register_lowering(
    kernel_p, mlir.lower_fun(_lowered_by_triton, multiple_results=True), platform="cuda"
)


def _each(one: Callable, batched: tuple, batch: tuple[int, ...]) -> Callable:
    """Return the function of one instance as that of a batch."""
    for k in reversed(range(len(batch))):
        one = jax.vmap(one, in_axes=[0 if flags[k] else None for flags in batched])
    return one


class _Memory(NamedTuple):
    """Memory of a program, at its place in the grid, as arrays in the order of rows."""

    place: Array
    arrays: tuple[Array, ...]

    def load(self, number: int, offset: Array, mask: Array, other: float) -> Array:
        """Return what stands at the offsets, and `other` where the mask is false."""
        found = self.arrays[number].at[offset].get(mode="clip")
        return jnp.where(mask, found, jnp.asarray(other, found.dtype))

    def stored(self, number: int, offset: Array, value: Array, mask: Array) -> "_Memory":
        """Return the memory with the value where the mask is true."""
        before, *after = self.arrays[number:]
        changed = before.at[jnp.where(mask, offset, len(before))].set(value, mode="drop")
        return self._replace(arrays=(*self.arrays[:number], changed, *after))

    def barrier(self) -> None:
        """Do nothing: one operation follows the other."""


def _in_turn(kernel: Kernel, *args: Array) -> list[Array]:
    """Return the results of one instance, by its programs in turn."""
    arrays = [v.reshape(-1) for v in args]
    for ref in kernel.outputs:
        unset = np.nan if ref.dtype.kind == "f" else np.iinfo(ref.dtype).min
        arrays.append(jnp.full(math.prod(ref.shape), unset, ref.dtype))

    def advance(place: Array, arrays: tuple[Array, ...]) -> tuple[Array, ...]:
        return _evaluate(kernel.jaxpr, [], _Memory(place, arrays))[0].arrays

    arrays = lax.fori_loop(jnp.int32(0), jnp.int32(kernel.own), advance, tuple(arrays))
    found = zip(arrays[len(args) :], kernel.outputs, strict=True)
    return [v.reshape(ref.shape) for v, ref in found]


def _by_pallas(kernel: Kernel, *args: Array) -> list[Array]:
    """Return the results of one instance by the Triton backend of Pallas."""
    from jax.experimental import pallas
    from jax.experimental.pallas import triton

    @jax.tree_util.register_static
    @record
    class PallasMemory:
        """Memory that is changed in place."""

        place: Array
        refs: tuple

        def load(self, number: int, offset: Array, mask: Array, other: float) -> Array:
            return triton.load(self.refs[number].at[offset], mask=mask, other=other)

        def stored(self, number: int, offset: Array, value: Array, mask: Array) -> "PallasMemory":
            triton.store(self.refs[number].at[offset], value, mask=mask)
            return self

        def barrier(self) -> None:
            triton.debug_barrier()

    def run(*refs: Any) -> None:
        place = pallas.program_id(0) if kernel.own > 1 else jnp.int32(0)
        _evaluate(kernel.jaxpr, [], PallasMemory(place, refs))

    sizes = [jax.ShapeDtypeStruct((math.prod(ref.shape),), ref.dtype) for ref in kernel.outputs]
    found = pallas.pallas_call(
        run,
        out_shape=sizes,
        grid=(kernel.own,) if kernel.own > 1 else (),
        name=kernel.name,
        compiler_params=triton.CompilerParams(num_warps=kernel.warps, num_stages=1),
    )(*(v.reshape(-1) for v in args))
    return [v.reshape(ref.shape) for v, ref in zip(found, kernel.outputs, strict=True)]


def _evaluate(closed: Any, args: list, memory: Any) -> tuple[Any, list]:
    """Return the memory after a jaxpr with loads and stores, and its results."""
    with jax.enable_x64(True):  # what is lowered outside 64-bit mode may have been traced in it
        return _evaluated(closed, args, memory)


def _evaluated(closed: Any, args: list, memory: Any) -> tuple[Any, list]:
    jaxpr: Any = closed.jaxpr
    values = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*closed.consts, *args], strict=True))

    def value(v: Any) -> Any:
        kind: Any = v.aval
        return np.asarray(v.val, kind.dtype) if isinstance(v, Literal) else values[v]

    for eqn in jaxpr.eqns:
        memory, found = _equation(eqn, [value(v) for v in eqn.invars], memory)
        values |= zip(eqn.outvars, found, strict=True)
    return memory, [value(v) for v in jaxpr.outvars]


def _equation(eqn: Any, given: list, memory: Any) -> tuple[Any, list]:
    params, name, none = eqn.params, eqn.primitive.name, jnp.int32(0)
    if eqn.primitive is load_p:
        return memory, [memory.load(params["ref"].number, *given, params["other"])]
    if eqn.primitive is store_p:
        return memory.stored(params["ref"].number, *given), [none]
    if eqn.primitive is barrier_p:
        memory.barrier()
        return memory, [none]
    if eqn.primitive is program_p:
        return memory, [memory.place]
    if name == "while":
        enter, body = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
        go_on = lambda s: _evaluated(params["cond_jaxpr"], [*given[:enter], *s[1]], s[0])[1][0]
        step = lambda s: _evaluated(params["body_jaxpr"], [*given[enter:body], *s[1]], s[0])
        return lax.while_loop(go_on, step, (memory, given[body:]))
    if name == "cond":
        branches = [partial(_evaluated, branch) for branch in params["branches"]]
        return lax.switch(given[0], branches, given[1:], memory)
    inner = called_jaxpr(eqn)
    if inner is not None:
        return _evaluated(inner, given, memory)
    if name == "dot_general" and (eqn.outvars[0].aval.dtype != jnp.float32 or not on_gpu()):
        params = params | {"precision": None}
    return memory, [eqn.primitive.bind(*given, **params)]
