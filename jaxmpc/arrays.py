"""Numbers in arguments of public functions: their type, and arrays made of them."""

from collections.abc import Sequence
from fractions import Fraction
from numbers import Real
from types import ModuleType
from typing import TYPE_CHECKING, Any, NewType, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxmpc.checks import concrete, require_real, require_untraced

if TYPE_CHECKING:
    # A number, an array of JAX or NumPy, or lists of these: not a text.
    # (One Sequence: with two a type checker finds none for rows like [[1, 0.1], [0, 1]].)
    Reals: TypeAlias = ArrayLike | Sequence[ArrayLike | Sequence[ArrayLike]]
else:
    # One word where `help` shows a signature, in place of three lines for each argument.
    Reals = NewType("Reals", object)


def host_array(argument: str, value: Any, *, copy: bool = True) -> np.ndarray:
    """Return `value` as a float64 NumPy array; raise ValueError if it cannot be read as real
    numbers. copy: False gives the array itself where it is one of these.

    All NumPy code (LPs, qhull, Riccati) calls it, so it computes in float64 in either mode of JAX.
    """
    require_untraced(argument, value)
    value = of_known_type(value)
    require_real(argument, value)
    return np.asarray(value).astype(np.float64, copy=copy)


def fractions_of(values: Any) -> np.ndarray:
    """Return an array of Fractions, each exactly the float it comes from."""
    return np.asarray(np.frompyfunc(Fraction, 1, 1)(np.asarray(values, np.float64)), object)


def dimensions(value: Any) -> int | None:
    """Return the number of axes of an array, number or nested lists; None for anything else, such
    as the placeholders by which JAX rebuilds an object."""
    if hasattr(value, "ndim"):
        return value.ndim
    if not isinstance(value, Real | list | tuple):
        return None
    try:
        return np.ndim(as_array(value))
    except (TypeError, ValueError):
        return None


def of_known_type(value: Any) -> Any:
    """Return arrays that JAX does not read as NumPy arrays of a type that it has, anything else as
    it is: those of other libraries (tables of pandas, tensors, SciPy's sparse matrices), and NumPy
    numbers of the other byte order, as in files of other machines, or longer than eight bytes, as
    float64."""
    if _of_another_library(value):
        value = value.toarray() if hasattr(value, "toarray") else np.asarray(value)
    if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in "iuf":
        if not value.dtype.isnative or value.dtype.itemsize > 8:
            return value.astype(np.float64)
    return value


def _of_another_library(value: Any) -> bool:
    """Return whether a value is an array of neither NumPy nor JAX that can be read as one."""
    if isinstance(value, np.ndarray | np.generic | jax.Array) or hasattr(value, "__jax_array__"):
        return False
    return hasattr(value, "__array__") or hasattr(value, "toarray")


def numpy_array(value: Any) -> np.ndarray:
    """Return numbers as an array of NumPy of a type that JAX has."""
    array: np.ndarray = of_known_type(np.asarray(of_known_type(value)))
    return array


def store_floats(instance: Any, *names: str) -> None:
    """Make arrays of floats of the named fields of a frozen dataclass where they are lists, arrays
    of other libraries or NumPy arrays of whole numbers: one leaf each, which can be differentiated
    and stacked.

    All else stays as it is: numbers, JAX's arrays, the placeholders by which JAX rebuilds an
    object, and what is no array of numbers, which `validate` refuses. Raises ValueError for rows of
    different lengths and for masked arrays that hide entries."""
    for name in names:
        value = getattr(instance, name)
        if isinstance(value, list | tuple | np.ma.MaskedArray):
            if dimensions(value) is None or isinstance(value, np.ma.MaskedArray):
                require_real(name, value)
            value = _array(value)
        value = of_known_type(value)
        if isinstance(value, np.ndarray) and value.dtype.kind in "iu":
            value = value.astype(float)
        floats = isinstance(value, np.ndarray | np.floating) and value.dtype.kind == "f"
        if floats or isinstance(value, jax.Array):
            object.__setattr__(instance, name, value)


def as_weight(value: Any, size: int, steps: int | None = None) -> Any:
    """Return a weight as a matrix where it has one meaning: a number for size 1, and a vector
    (size,), which is a diagonal; of size 1 also a number for each of some steps, (steps,), which
    is (steps, 1, 1). Anything else unchanged."""
    shape = np.shape(as_array(value)) if dimensions(value) in (0, 1) else None
    if size == 1 and shape not in (None, (), (1,)) and shape == (steps,):
        array = _array(value)
        return array.reshape(-1, 1, 1) if array.dtype.kind in "fV" else value
    if (shape == () and size == 1) or shape == (size,):
        array = _array(value)
        if array.dtype.kind in "iufV":
            array = array.astype(float) if array.dtype.kind in "iu" else array
            return (jnp if isinstance(array, jax.Array) else np).diag(array.reshape(size))
    return value


def fill(instance: Any, name: str, shape: tuple[int, ...]) -> None:
    """Make an array of floats of this shape of a number in a field of a frozen dataclass."""
    value = getattr(instance, name)
    full = jnp.broadcast_to if isinstance(value, jax.Array) else np.broadcast_to
    object.__setattr__(instance, name, full(value, shape))
    store_floats(instance, name)


def as_column(value: Reals) -> jax.Array | np.ndarray:
    """Return a vector (n,) as a matrix (n, 1)."""
    return _array(value)[:, None]


def _array(value: Reals) -> jax.Array | np.ndarray:
    """Return an array of JAX as it is, lists of traced numbers as one, all else as NumPy's."""
    value = as_array(value)
    return value if isinstance(value, jax.Array) else numpy_array(value)


def as_array(value: Any) -> Any:
    """Return `value`, made an array if it is nested lists of traced numbers (lists under `jit`)."""
    return value if concrete(value) else jnp.asarray(value)


def module_of(*values: Any) -> ModuleType:
    """Return NumPy where none of the values is being traced, else `jax.numpy`."""
    return np if concrete(*values) else jnp


def as_floats(value: Any) -> Any:
    """Return `value` as an array that keeps its floating dtype; traced values stay traced. Whole
    numbers become floating ones, for what is computed in their type would be truncated."""
    value = as_array(value)
    value = value if isinstance(value, jax.Array) else np.asarray(value)
    return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(float)


def all_finite(tree: Any) -> jax.Array:
    """Return whether all numbers of a tree are finite. Works inside jit, vmap and grad."""
    tests = [jnp.all(jnp.isfinite(jnp.asarray(v))) for v in jax.tree.leaves(tree)]
    return jnp.all(jnp.stack(tests))
