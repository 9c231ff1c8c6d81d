"""What convex sets share: methods, checks of their fields, and arithmetic in NumPy or JAX.

`contains`, `Box.support` and `Ellipsoid.support` are JAX functions of one point (map them with
`jax.vmap`); outside of JAX's transformations they answer in float64, whatever JAX's own precision.
Everything that needs an LP (HiGHS) or a convex hull (qhull) runs in NumPy, in float64 and outside
JAX's transformations, and raises ValueError for sets that are empty, flat or unbounded where those
make no sense.
"""

from abc import ABC, abstractmethod
from types import ModuleType
from typing import Any, Self, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.arrays import Reals, as_array, host_array
from jaxmpc.checks import concrete, fail, require_shape

# An array, a number, True or False, of JAX or NumPy.
AnyArray: TypeAlias = jax.Array | np.ndarray
AnyNumber: TypeAlias = jax.Array | np.floating | float
AnyTruth: TypeAlias = jax.Array | np.bool


class ConvexSet(ABC):
    """A convex set in R^n: Box, Polytope or Ellipsoid."""

    @property
    @abstractmethod
    def dimension(self) -> int:
        """Return n, the number of coordinates."""

    @abstractmethod
    def validate(self, argument: str, dimension: int | None = None) -> None:
        """Raise ValueError, naming `argument`, for fields that describe no set in R^dimension."""

    @abstractmethod
    def support(self, d: Reals) -> AnyNumber:
        """Return max d'x over the set, d (n,); inf where it is unbounded along d."""

    @abstractmethod
    def _require_fields(self, argument: str, dimension: int | None = None) -> None:
        """Raise ValueError, naming `argument`, for fields of wrong shapes."""

    def _require_vector(self, name: str, value: Reals, what: str) -> None:
        """Raise ValueError for fields of wrong shapes, or a point or direction that is not (n,)."""
        self._require_fields(type(self).__name__)
        require_shape(name, value, (self.dimension,), f"Give one {what}; use jax.vmap for many")


class LinearSet(ConvexSet):
    """A set of linear inequalities: Box or Polytope."""

    def spread(self, n: int) -> Self:
        """Return the set, a Box of two numbers as the box with these bounds of n coordinates."""
        return self

    @abstractmethod
    def half_spaces(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (H, h) of the rows H x <= h. NumPy; not traceable."""

    @abstractmethod
    def vertices(self) -> np.ndarray:
        """Return the vertices (k, n); ValueError if the set is unbounded."""


def numbers(*values: Any) -> tuple[ModuleType, list[Any]]:
    """Return NumPy and the values in float64, or jax.numpy and its arrays where one is traced."""
    if concrete(*values):
        return np, [host_array("argument", value) for value in values]
    return jnp, [jnp.asarray(value) for value in values]


def product(xp: ModuleType, M: Any, v: Any) -> Any:
    """Return the matrix product M v, by JAX in the precision of the arrays."""
    return M @ v if xp is np else jnp.matmul(M, v, precision="highest")


def as_floats(value: Reals) -> AnyArray:
    """Return `value` as an array that keeps its floating dtype; traced values stay traced."""
    value = as_array(value)
    value = value if isinstance(value, jax.Array) else np.asarray(value)
    return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(float)


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
        fail(f"{argument}.{first}", f"shape {shape} is not {wanted}", "Give a list or array")
    require_dimension(argument, shape[-1], dimension)
    require_shape(f"{argument}.{second}", as_array(h), shape[:1], f"Match {first}")


def require_dimension(argument: str, given: int, wanted: int | None) -> None:
    """Raise unless a set has the dimension that is wanted (None: any)."""
    if wanted is not None and given != wanted:
        cure = "Bound every coordinate (inf for no bound)"
        fail(argument, f"has dimension {given} where {wanted} is needed", cure)
