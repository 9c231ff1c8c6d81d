"""Public classes of arrays as pytrees of JAX, which stored programs (`jax.export`) know by name."""

import ast
import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import jax
import numpy as np
from jax import export

from jaxmpc.checks import fail, shown

T = TypeVar("T", bound=type)


def pytree(cls: T) -> T:
    """Register a dataclass whose fields are data, or static where their metadata say so.

    Its name in stored programs is "jaxmpc." and that of the class, wherever that is defined.
    """
    jax.tree_util.register_dataclass(cls)
    return _stored(cls)


def prepared_pytree(cls: type) -> None:
    """Register a dataclass that computes in its constructor: JAX rebuilds it from its fields
    without that, `dataclasses.replace` with it."""
    fields = dataclasses.fields(cls)
    static = tuple(f.name for f in fields if f.metadata.get("static"))
    data = tuple(f.name for f in fields if not f.metadata.get("static"))

    def flatten(instance: Any) -> tuple[tuple, tuple]:
        return tuple(getattr(instance, k) for k in data), tuple(
            getattr(instance, k) for k in static
        )

    def with_keys(instance: Any) -> tuple[tuple, tuple]:
        leaves, rest = flatten(instance)
        keys = map(jax.tree_util.GetAttrKey, data)
        return tuple(zip(keys, leaves, strict=True)), rest

    def unflatten(rest: tuple, leaves: Iterable[Any]) -> Any:
        instance: Any = object.__new__(cls)
        vars(instance).update(zip((*data, *static), (*leaves, *rest), strict=True))
        return instance

    jax.tree_util.register_pytree_with_keys(cls, with_keys, unflatten, flatten)
    _stored(cls)


def static_pytree(cls: T) -> T:
    """Register a dataclass without arrays: a constant of programs."""
    jax.tree_util.register_static(cls)
    values = lambda instance: tuple(getattr(instance, f.name) for f in dataclasses.fields(cls))
    return _stored(cls, values, lambda values: cls(*values))


def named_pytree(cls: T) -> T:
    """Give a NamedTuple, which is a pytree, its name in stored programs."""
    export.register_namedtuple_serialization(cls, serialized_name=f"jaxmpc.{cls.__name__}")
    return cls


def _stored(
    cls: T, values: Callable[[Any], Any] = lambda aux: aux,
    rebuilt: Callable[[Any], Any] = lambda values: values,
) -> T:  # fmt: skip
    """Register the name and what is static of a class, as the text of a Python literal."""

    def write(aux: Any) -> bytes:
        return repr(_literal(cls.__name__, values(aux))).encode()

    read = lambda text: rebuilt(ast.literal_eval(text.decode()))
    export.register_pytree_node_serialization(
        cls, serialized_name=f"jaxmpc.{cls.__name__}", serialize_auxdata=write,
        deserialize_auxdata=read,
    )  # fmt: skip
    return cls


def _literal(name: str, value: Any) -> Any:
    """Return a value without NumPy's types; ValueError for what no literal stands for."""
    if isinstance(value, tuple):
        return tuple(_literal(name, part) for part in value)
    value = value.item() if isinstance(value, np.generic) else value
    if value is not None and not isinstance(value, bool | int | float | str):
        cure = "Close the program over it, instead of passing it as an argument or a result"
        fail(name, f"holds {shown(value)}, which cannot be stored", cure)
    return value
