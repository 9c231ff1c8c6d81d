"""Models and plants that users write, as arguments of compiled programs."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FunctionType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.checks import fail
from jaxmpc.pytrees import pytree, short_value, static, static_pytree


class Number:
    """Stands in a `ConstantPart` where the model has an array."""


@static_pytree
@dataclass(frozen=True, eq=False)
class ConstantPart:
    """A model with `Number` in place of its arrays: a constant of programs. Two are equal where
    they have the same structure, and functions and other objects in it are the same."""

    given: Any

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, ConstantPart):
            return False
        mine, theirs = jax.tree.leaves(self.given), jax.tree.leaves(other.given)
        tree: Any = jax.tree.structure(self.given)
        return tree == jax.tree.structure(other.given) and all(map(_same, mine, theirs))

    def __hash__(self) -> int:
        leaves, tree = jax.tree.flatten(self.given)
        return hash((tree, *(v if isinstance(v, int | str) else id(v) for v in leaves)))


def as_array_of_numbers(found: Any) -> Any:
    """Return what a user's function gives, of a list or tuple of numbers an array. ValueError for
    a list of parts of unequal shapes."""
    if not isinstance(found, list | tuple):
        return found
    try:
        return jnp.asarray(found)
    except (TypeError, ValueError):
        shapes = [getattr(part, "shape", type(part).__name__) for part in found]
        what = f"gives a {type(found).__name__} of parts {shapes}"
        return fail("a model, plant or task", what, "Join them: jnp.concatenate, or jnp.hstack")


@contextmanager
def written_in_jax(what: str) -> Iterator[None]:
    """Turn errors about types of a user's function, while it is traced, into a ValueError."""
    try:
        yield
    except TypeError as error:
        text = (str(error).splitlines() or [""])[0]
        if isinstance(error, jax.errors.JAXTypeError):
            cure = "Use jax.numpy in place of numpy, and jnp.where or jax.lax.cond in place of if"
            fail(what, f"is not written in JAX ({text})", cure)
        cure = "A model or plant is a function of a state (n,) and inputs (m,), in this order"
        fail(what, f"raises a TypeError ({text})", f"{cure}; a task is one of what `view` gives")


def _same(a: Any, b: Any) -> bool:
    return a is b or (type(a) is type(b) and isinstance(a, int | str) and a == b)


@pytree
class GivenModel:
    """A function (x, u) -> x⁺, or an object with such a `step`, as an argument of programs.

    Of a pytree, such as an equinox module, arrays and floating-point numbers are data, with respect
    to which there are derivatives; its functions and whole numbers are constants, as any other
    object is. Other attributes are those of the object.
    """

    numbers: tuple
    constant: ConstantPart

    @property
    def given(self) -> Any:
        """The function or object."""
        leaves, tree = jax.tree.flatten(self.constant.given)
        numbers = iter(self.numbers)
        return jax.tree.unflatten(
            tree, [next(numbers) if leaf is Number else leaf for leaf in leaves]
        )

    def step(self, x: Array, u: Array) -> Array:
        """Return x⁺."""
        given = self.given
        return as_array_of_numbers(getattr(given, "step", given)(x, u))

    def __call__(self, *values: Any) -> Any:
        """Return what the function gives."""
        return as_array_of_numbers(self.given(*values))

    def __repr__(self) -> str:
        return short_value(self.given)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name in ("numbers", "constant"):
            raise AttributeError(name)
        return getattr(self.given, name)


@pytree
class ClosedFunction:
    """A function, or the model that is one, with the traced arrays that it closed over as data."""

    numbers: tuple
    function: Any = static()

    def __call__(self, *values: Any) -> Any:
        """Return what the function gives."""
        return as_array_of_numbers(self.function(*values, *self.numbers))

    step = __call__


def may_close_over(model: Any) -> bool:
    """Return whether this is what `as_argument` made of a function."""
    return isinstance(model, GivenModel) and isinstance(model.constant.given, FunctionType)


def closed(model: Any, *examples: Any) -> Any:
    """Return what `as_argument` made of a function, with the traced arrays that the function closes
    over as data. Loops and rules of derivatives take such arrays as arguments alone.

    examples: of its arguments, arrays or their types."""
    if not may_close_over(model):
        return model
    function, numbers = jax.closure_convert(model.constant.given, *examples)
    return ClosedFunction(tuple(numbers), function) if numbers else model


def is_model(model: Any) -> bool:
    """Return whether this is a function, or an object with `step`; no class of such objects."""
    return callable(getattr(model, "step", model)) and not isinstance(model, type)


def as_argument(model: Any) -> Any:
    """Return a model or plant as an argument of a program: itself where it is a pytree of arrays
    with a method `step`."""
    leaves, tree = jax.tree.flatten(model)
    plain = not any(callable(v) or isinstance(v, str) for v in leaves)
    if plain and hasattr(model, "step") and not jax.tree_util.all_leaves([model]):
        return model
    is_number = [isinstance(v, jax.Array | np.ndarray | np.inexact | float) for v in leaves]
    numbers = tuple(v for v, has in zip(leaves, is_number, strict=True) if has)
    rest = [Number if has else v for v, has in zip(leaves, is_number, strict=True)]
    return GivenModel(numbers, ConstantPart(jax.tree.unflatten(tree, rest)))
