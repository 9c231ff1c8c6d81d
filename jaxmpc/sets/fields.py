"""Fields of sets: arrays of NumPy, or of JAX and perhaps traced, and checks of their shapes."""

from types import ModuleType
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.arrays import Reals, as_array, host_array
from jaxmpc.checks import (
    concrete,
    entries,
    fail,
    require_finite,
    require_shape,
    whole,
)

# An array, a number, True or False, of JAX or NumPy.
AnyArray: TypeAlias = jax.Array | np.ndarray
AnyNumber: TypeAlias = jax.Array | np.ndarray | np.floating | float
AnyTruth: TypeAlias = jax.Array | np.ndarray | np.bool


def numbers(*values: Any) -> tuple[ModuleType, list[Any]]:
    """Return NumPy and the values in float64, or jax.numpy and its arrays where one is traced."""
    if concrete(*values):
        return np, [host_array("argument", value) for value in values]
    return jnp, [jnp.asarray(value) for value in values]


def product(xp: ModuleType, M: Any, v: Any) -> Any:
    """Return the matrix product M v, by JAX in the precision of the arrays."""
    return M @ v if xp is np else jnp.matmul(M, v, precision="highest")


def one_or_many(argument: str, value: Reals, n: int) -> tuple[Any, bool]:
    """Return an argument as an array of one vector (n,) or of many (k, n), and whether it is
    many."""
    given: Any = as_array(value)
    many = np.ndim(given) == 2
    if not (many and np.shape(given)[1] == n):
        require_shape(argument, given, (n,), "Give one (n,), or many as rows (k, n)")
    return given, many


def require_matching(
    argument: str, fields: dict[str, Reals], ndim: int, dimension: int | None
) -> None:
    """Raise unless the first of two fields is (n,) or (rows, n), and the second matches its
    length."""
    for name, value in fields.items():
        if concrete(as_array(value)):
            host_array(f"{argument}.{name}", as_array(value))
    (first, H), (second, h) = fields.items()
    shape = np.shape(as_array(H))
    if len(shape) != ndim or shape[-1] == 0:
        wanted = "(n,)" if ndim == 1 else "(rows, n)"
        cure = f"Give an array {wanted}"
        if ndim == 2 and len(shape) == 1 and concrete(H):
            cure = f"For one row write [{np.asarray(H).tolist()}]"
        fail(f"{argument}.{first}", f"shape {shape} is not {wanted}", cure)
    require_dimension(argument, shape[-1], dimension)
    require_shape(f"{argument}.{second}", as_array(h), shape[:1], f"Match {first}")


def require_dimension(argument: str, given: int, wanted: int | None) -> None:
    """Raise unless a set has the dimension that is wanted (None: any)."""
    if wanted is not None and given != wanted:
        cure = "Bound every coordinate (inf for no bound)"
        fail(argument, f"has dimension {given} where {wanted} is needed", cure)


def affine_map(
    M: Reals, t: Reals | None, shape: tuple[int | None, int | None]
) -> tuple[np.ndarray, np.ndarray]:
    """Return M and t of x -> M x + t, checked: M has this shape (None: any), t one entry a row of
    M."""
    M = host_array("M", M)
    fits = [size is None or size == given for size, given in zip(shape, M.shape, strict=False)]
    if M.ndim != 2 or 0 in M.shape or not all(fits):
        wanted = ", ".join("k" if size is None else str(size) for size in shape)
        fail("M", f"shape {M.shape} is not ({wanted})", "Give a matrix, one row an entry of Mx")
    require_finite("M", M)
    t = np.zeros(len(M)) if t is None else host_array("t", t)
    require_shape("t", t, (len(M),), "Give one entry a row of M")
    require_finite("t", t)
    return M, t


def vector(argument: str, value: Reals, n: int) -> np.ndarray:
    """Return a point or direction (n,) in float64, checked."""
    found = host_array(argument, value)
    require_shape(argument, found, (n,), "Give one entry a coordinate")
    require_finite(argument, found)
    return found


def points(argument: str, value: Reals, n: int) -> np.ndarray:
    """Return points (k, n) in float64, checked."""
    found = host_array(argument, value)
    if found.ndim != 2 or found.shape[1] != n or not len(found):
        fail(argument, f"shape {found.shape} is not (k, {n})", "Give a set, or points")
    require_finite(argument, found)
    return found


def chosen_axes(
    axes: Any, n: int, argument: str = "axes", cure: str = "Name those to keep"
) -> list[int]:
    """Return the coordinates of an argument, checked."""
    axes = [axes] if isinstance(axes, int | np.integer) else axes
    axes = [whole(argument, axis, 0) for axis in entries(argument, axes, cure)]
    if not axes or len(set(axes)) < len(axes) or not set(axes) <= set(range(n)):
        fail(argument, f"{axes} are not distinct numbers in 0..{n - 1}", cure)
    return axes


def section(values: Any, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (fixed, at, rest) of an argument {axis: value, ...} of `slice`: the fixed coordinates,
    their values, and the coordinates that are left."""
    if not isinstance(values, dict) or not values:
        fail("values", f"{values!r} fixes no coordinate", "Write it as {2: 0.5}")
    fixed = np.array(chosen_axes(list(values), n, "values", "Write it as {axis: value}"))
    rest = np.setdiff1d(np.arange(n), fixed)
    if not rest.size:
        fail("values", "fixes every coordinate", "Ask `contains` whether a point is in the set")
    at = host_array("values", list(values.values()))
    require_shape("values", at, (len(fixed),), "Give one number an axis")
    require_finite("values", at)
    return fixed, at, rest
