"""Programs that run as they were written, whatever JAX's modes are where they are called.

A user may forbid implicit promotion of ranks or types, call from inside `jax.shard_map`, whose
default is to check over which mesh axes each value varies, or from under a mesh with explicit axes,
where every array has its sharding as a part of its type. None of these is a property of the problem
solved. `own_modes` sets them aside for the time a program is traced. What JAX traces later, rules
of batching and of derivatives, has the decorator too.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
from jax.sharding import AxisType, PartitionSpec, auto_axes, get_abstract_mesh

T = TypeVar("T")
F = TypeVar("F", bound=Callable[..., Any])


def own_modes(function: F) -> F:
    """Return the function with JAX's usual promotions, with arguments and results that all vary
    over the same axes of a `shard_map`, and without explicit axes: sharded along a batch, as
    `jax.vmap` has it, or not at all."""

    @functools.wraps(function)
    def run(*args: Any, **kwargs: Any) -> Any:
        with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
            if AxisType.Explicit in get_abstract_mesh().axis_types:
                return _without_explicit_axes(functools.partial(function, **kwargs), args)
            return varying(function(*varying(args, args), **kwargs), args)

    return run  # type: ignore[return-value]


def _without_explicit_axes(function: Callable[..., Any], args: tuple) -> Any:
    leaves, tree = jax.tree.flatten(args)
    places = [i for i, v in enumerate(leaves) if isinstance(v, jax.Array)]  # not what is static

    def call(*arrays: Any) -> Any:
        given = dict(zip(places, arrays, strict=True))
        full = [given.get(i, v) for i, v in enumerate(leaves)]
        return function(*jax.tree.unflatten(tree, full))

    return auto_axes(call, out_sharding=PartitionSpec())(*(leaves[i] for i in places))


def varying(tree: T, like: Any) -> T:
    """Return the tree, varying over those axes of a `shard_map` over which `like` does.

    What a loop carries must do so from the start; constants such as zeros do not.
    """
    axes = frozenset[str]().union(*map(_axes, jax.tree.leaves(like)))
    if not axes:
        return tree

    def cast(v: Any) -> Any:
        missing = tuple(axes - _axes(v)) if isinstance(v, jax.Array) else ()
        return jax.lax.pcast(v, missing, to="varying") if missing else v

    return jax.tree.map(cast, tree)


def _axes(v: Any) -> frozenset[str]:
    """Return the axes over which a value varies."""
    if not isinstance(v, jax.core.Tracer):
        return frozenset()
    kind = jax.typeof(v)
    return kind.mat.varying if hasattr(kind, "mat") else getattr(kind, "vma", frozenset())
