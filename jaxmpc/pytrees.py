"""Classes of arrays: frozen dataclasses that print in a few lines, and pytrees of JAX made of them,
which stored programs (`jax.export`) know by name."""

import ast
import dataclasses
import functools
import inspect
import textwrap
from collections.abc import Callable, Iterable
from typing import Any, NoReturn, TypeVar, dataclass_transform

import jax
import numpy as np
from jax import export

from jaxmpc.checks import fail, nearest, shown

T = TypeVar("T", bound=type)
# Entries of an array that is printed as numbers, and characters of a field, at most.
FEW, SHORT = 6, 60
# Stands for a space at which no line ends.
UNBROKEN = "\N{NO-BREAK SPACE}"


def static(*, default: Any = dataclasses.MISSING) -> Any:
    """Return a field of a pytree that is a constant of programs: part of its structure, no leaf."""
    return dataclasses.field(default=default, metadata={"static": True})


@dataclass_transform(eq_default=False, frozen_default=True, field_specifiers=(dataclasses.field,))
def record(cls: T) -> T:
    """Make a frozen dataclass of a class, which compares by identity, and prints as `short_text`
    says unless it has a way of its own."""
    dataclasses.dataclass(cls, frozen=True, eq=False, repr=False)
    cls.__init__ = _naming_arguments(cls.__init__)  # type: ignore[misc]
    if cls.__repr__ is object.__repr__:
        cls.__repr__ = short_text  # type: ignore[method-assign, assignment]
    if not hasattr(cls, "__getattr__"):
        cls.__getattr__ = _absent  # type: ignore[attr-defined]
    if cls.__getstate__ is object.__getstate__:
        cls.__getstate__ = _given  # type: ignore[method-assign, assignment]
    return cls


def _given(instance: Any) -> dict[str, Any]:
    """Return what copies and pickles of a record hold: its fields. What it keeps beside them, such
    as compiled programs and their locks, is made again from these when it is next used."""
    return {f.name: getattr(instance, f.name) for f in dataclasses.fields(instance)}


# Names that other libraries give to attributes.
ATTRIBUTES = {
    "x": "states",
    "u": "inputs",
    "y": "multipliers",
    "N": "horizon",
    "objective": "cost",
    "V": "vertices",
    "A": "H",
    "b": "h",
    "feasible": "label",
    "labels": "label",
}


def _absent(instance: Any, name: str) -> NoReturn:
    """Raise AttributeError with what another library's name of an attribute is called here."""
    cls = type(instance)
    if hasattr(cls, name):  # a property, which raised: once more, for its own error
        object.__getattribute__(instance, name)
    own, meant = [f.name for f in dataclasses.fields(cls)], ATTRIBUTES.get(name)
    hint = f". Did you mean {meant}?" if meant in own or hasattr(cls, meant or "_") else ""
    text = f"{cls.__name__!r} object has no attribute {name!r}{hint}"
    raise AttributeError(text, name=name, obj=instance)


def _naming_arguments(make: Callable[..., None]) -> Callable[..., None]:
    """Return a constructor that says of a wrong call which arguments there are."""
    known = [p for p in inspect.signature(make).parameters.values() if p.name != "self"]

    @functools.wraps(make)
    def __init__(self: Any, *values: Any, **named: Any) -> None:
        try:
            make(self, *values, **named)
        except TypeError:
            _require_arguments(type(self).__name__, known, len(values), named)
            raise

    return __init__


# Names that the literature, other libraries and the files of `jaxmpc` give to arguments.
ELSEWHERE = {
    **{word: "terminal_cost" for word in ("P", "Qf", "QN", "terminal_weight")},
    **{"A": "H", "b": "h"},  # of a polytope
    **{word: "horizon" for word in ("N", "T", "steps")},
    **{word: "states" for word in ("x_min", "x_max", "X", "state_limits")},
    **{word: "inputs" for word in ("u_min", "u_max", "U", "input_limits")},
    **{word: "iterations" for word in ("max_iter", "maxiter", "iters")},
    **{word: "eps" for word in ("tol", "eps_abs", "eps_rel")},
}


def _require_arguments(
    name: str, known: list[inspect.Parameter], values: int, named: Iterable[str]
) -> None:
    """Raise TypeError where a class is called with an argument that it does not have, or without
    one that it needs. values: how many arguments have no name."""
    names = [p.name for p in known]
    takes = f"{name} takes {', '.join(names)}"
    for word in named:
        if word not in names:
            meant = ELSEWHERE.get(word)
            near = f"Did you mean {meant}? " if meant in names else nearest(word, names)
            raise TypeError(f"{name}: there is no argument {word}. {near}{takes}") from None
    needed = [p.name for p in known[values:] if p.default is p.empty and p.name not in named]
    if needed:
        missing = f"{name}: {', '.join(needed)} {'is' if len(needed) == 1 else 'are'} missing"
        raise TypeError(f"{missing}. {takes}") from None


@dataclass_transform(eq_default=False, frozen_default=True, field_specifiers=(static,))
def pytree(cls: T) -> T:
    """Make a `record` of a class, and a pytree whose leaves are its fields but `static` ones.

    Its name in stored programs is "jaxmpc." and that of the class, wherever that is defined: no two
    have the same.
    """
    jax.tree_util.register_dataclass(record(cls))
    return _stored(cls)


@dataclass_transform(
    eq_default=False, frozen_default=True, field_specifiers=(static, dataclasses.field)
)
def prepared_pytree(cls: T) -> T:
    """`pytree` for a class that computes in its constructor: JAX rebuilds it from its fields
    without that, `dataclasses.replace` with it."""
    fields = dataclasses.fields(record(cls))
    constants = tuple(f.name for f in fields if f.metadata.get("static"))
    data = tuple(f.name for f in fields if not f.metadata.get("static"))

    def values(instance: Any, names: tuple[str, ...]) -> tuple:
        return tuple(getattr(instance, name) for name in names)

    def flatten(instance: Any) -> tuple[tuple, tuple]:
        return values(instance, data), values(instance, constants)

    def with_keys(instance: Any) -> tuple[tuple, tuple]:
        keys = map(jax.tree_util.GetAttrKey, data)
        return tuple(zip(keys, values(instance, data), strict=True)), values(instance, constants)

    def unflatten(rest: tuple, leaves: Iterable[Any]) -> Any:
        instance: Any = object.__new__(cls)
        vars(instance).update(zip((*data, *constants), (*leaves, *rest), strict=True))
        return instance

    jax.tree_util.register_pytree_with_keys(cls, with_keys, unflatten, flatten)
    return _stored(cls)


def static_pytree(cls: T) -> T:
    """Register a dataclass without arrays: a constant of programs."""
    jax.tree_util.register_static(cls)

    def values(instance: Any) -> tuple:
        return tuple(getattr(instance, f.name) for f in dataclasses.fields(cls))

    return _stored(cls, values, lambda values: cls(*values))


def named_pytree(cls: T) -> T:
    """Give a NamedTuple, which is a pytree, its name in stored programs."""
    cls.__repr__ = short_text  # type: ignore[method-assign, assignment]
    export.register_namedtuple_serialization(cls, serialized_name=f"jaxmpc.{cls.__name__}")
    return cls


def _stored(
    cls: T,
    values: Callable[[Any], Any] = lambda constants: constants,
    rebuilt: Callable[[Any], Any] = lambda constants: constants,
) -> T:
    """Register the name and what is static of a class, as the text of a Python literal."""

    def write(constants: Any) -> bytes:
        return repr(_literal(cls.__name__, values(constants))).encode()

    def read(text: bytes) -> Any:
        return rebuilt(ast.literal_eval(text.decode()))

    export.register_pytree_node_serialization(
        cls,
        serialized_name=f"jaxmpc.{cls.__name__}",
        serialize_auxdata=write,
        deserialize_auxdata=read,
    )
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


def short_text(instance: Any, **texts: str) -> str:
    """Return a dataclass or NamedTuple as a few lines of text: of large or traced arrays type and
    shape, and no fields that have their defaults. texts: of some fields, in place of theirs; these
    come first."""
    is_record = dataclasses.is_dataclass(instance)
    names = [f.name for f in dataclasses.fields(instance)] if is_record else instance._fields
    order = list(texts)
    names = sorted(names, key=lambda name: order.index(name) if name in texts else len(order))
    parts = [
        f"{name}={texts.get(name) or short_value(getattr(instance, name))}".replace(" ", UNBROKEN)
        for name in names
        if not (is_record and _has_default(instance, name))
    ]
    text = f"{type(instance).__name__}({', '.join(parts)})"
    lines = textwrap.wrap(text, 100, subsequent_indent="    ", break_on_hyphens=False)
    return "\n".join(lines).replace(UNBROKEN, " ")


def _has_default(instance: Any, name: str) -> bool:
    value, default = getattr(instance, name), instance.__dataclass_fields__[name].default
    plain = isinstance(value, bool | int | float | str | tuple)
    return value is default or (plain and type(value) is type(default) and value == default)


def short_value(value: Any) -> str:
    """Return what stands in a field as text of one line."""
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        traced = isinstance(value, jax.core.Tracer)
        if traced or not 0 < value.size <= FEW or not _is_here(value):
            return f"{'traced ' * traced}{value.dtype} {value.shape}"
        return np.array2string(np.asarray(value), precision=4, separator=", ").replace("\n", "")
    if isinstance(value, tuple) and not hasattr(value, "_fields"):
        return f"({', '.join(map(short_value, value))}{',' * (len(value) == 1)})"
    if dataclasses.is_dataclass(value) or hasattr(value, "_fields"):
        text = " ".join(repr(value).split())
        return text if len(text) <= SHORT else f"{type(value).__name__}(…)"
    return shown(value)


def _is_here(array: Any) -> bool:
    """Return whether an array can be read: no random key, not donated, and all of it of this
    process."""
    if not isinstance(array, jax.Array):
        return True
    is_key = jax.dtypes.issubdtype(array.dtype, jax.dtypes.prng_key)
    return not is_key and array.is_fully_addressable and not array.is_deleted()
