"""What every convex set in R^n offers, and the operators by which it is written.

`A @ P` is the image, `P @ A` the preimage, `P + Q` the Minkowski sum, `P - Q` the Pontryagin
difference, `P & Q` the intersection, `P <= Q` and `P == Q` compare sets to 1e-9 of their size,
`x in P` asks for one point; `P + x`, `x - P`, `2 * P` and `P / 2` move, mirror and scale.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np

from jaxmpc.arrays import Reals, host_array
from jaxmpc.checks import fail, require_real, shown, whole
from jaxmpc.sets import drawing
from jaxmpc.sets.fields import AnyNumber, AnyTruth, chosen_axes, one_or_many, vector
from jaxmpc.sets.lp import ROUNDING


class ConvexSet(ABC):
    """A convex set in R^n that is known by its support function."""

    @property
    @abstractmethod
    def dimension(self) -> int:
        """Return n, the number of coordinates."""

    @abstractmethod
    def validate(self, argument: str, dimension: int | None = None) -> None:
        """Raise ValueError, naming `argument`, for fields that describe no set in R^dimension, or
        an empty one."""

    @abstractmethod
    def support(self, d: Reals) -> AnyNumber:
        """Return max d'x over the set for one direction d (n,), or each of many (k, n); inf where
        it is unbounded along d."""

    @abstractmethod
    def _require_fields(self, argument: str, dimension: int | None = None) -> None:
        """Raise ValueError, naming `argument`, for fields of wrong shapes."""

    def _require_given(self, **axes: int) -> None:
        """Raise ValueError for fields of wrong shapes where a user gave them: as numbers or arrays
        of NumPy, with the axes of one set. What JAX rebuilds holds its arrays, or placeholders."""
        values = [(getattr(self, name), count) for name, count in axes.items()]
        plain = (np.ndarray, float, int)
        if all(isinstance(v, plain) and np.ndim(v) == count for v, count in values):
            self._require_fields(type(self).__name__)


class BasicSet(ConvexSet):
    """A convex set that can be written with operators: Box, Polytope, Zonotope or Ellipsoid."""

    # NumPy's arrays leave `A @ P` and `x + P` to the set.
    __array_ufunc__ = None

    @abstractmethod
    def is_empty(self) -> bool:
        """Return whether the set has no point."""

    @abstractmethod
    def is_bounded(self) -> bool:
        """Return whether the set is bounded; an empty one is."""

    @abstractmethod
    def affine_dimension(self) -> int:
        """Return the dimension of the affine hull: 0 for a point, n for a set with volume, -1 for
        the empty set."""

    @abstractmethod
    def contains(self, x: Reals, tolerance: float = 0.0) -> AnyTruth:
        """Return whether the set holds a point x (n,), or each of many (k, n)."""

    @abstractmethod
    def volume(self) -> float:
        """Return the length, area or volume in R^n: 0 if flat or empty, inf if it is infinite."""

    @abstractmethod
    def bounding_box(self) -> Any:
        """Return the smallest Box around the set."""

    @abstractmethod
    def minkowski_sum(self, other: Any) -> Any:
        """Return {x + w : x in the set, w in other}."""

    @abstractmethod
    def pontryagin_difference(self, other: Any) -> Any:
        """Return {x : x + w in the set for all w in other}."""

    @abstractmethod
    def intersect(self, other: Any) -> Any:
        """Return the points in both sets."""

    @abstractmethod
    def image(self, M: Reals, t: Reals | None = None) -> Any:
        """Return {M x + t : x in the set}."""

    @abstractmethod
    def preimage(self, M: Reals, t: Reals | None = None) -> Any:
        """Return {x : M x + t in the set}."""

    @abstractmethod
    def slice(self, values: Mapping[int, float]) -> Any:
        """Return the section with some coordinates fixed, {axis: value, ...}, in the others."""

    @abstractmethod
    def chebyshev(self) -> tuple[np.ndarray, float]:
        """Return (center, radius) of the largest ball inside."""

    @abstractmethod
    def sample(self, count: int, seed: int = 0) -> np.ndarray:
        """Return points (count, n) that are uniformly distributed over the set."""

    @abstractmethod
    def _closest(self, x: np.ndarray) -> np.ndarray:
        """Return the point of the set, which is not empty, that is closest to x (n,)."""

    @abstractmethod
    def _covers(self, other: Any, tolerance: float) -> bool:
        """Return whether the set holds another, both not empty: `other.is_subset(self)`."""

    def _keeps(self, rows: np.ndarray, offsets: np.ndarray, tolerance: float) -> bool:
        """Return whether all points keep unit rows x <= offsets, to a fraction of their terms over
        the set."""
        reach = np.max(np.abs(self.bounding_box().bounds()), axis=0)
        terms = np.abs(offsets) + np.abs(rows) @ np.where(np.isinf(reach), 0.0, reach)
        return bool(np.all(self.support(rows) <= offsets + tolerance * terms))

    @abstractmethod
    def _farthest(self, P: np.ndarray, center: np.ndarray) -> float:
        """Return max (x - center)'P (x - center) over the set."""

    def project(self, axes: Sequence[int]) -> Any:
        """Return the set of (x_i for i in axes) over all x in the set."""
        return self.image(np.eye(self.dimension)[chosen_axes(axes, self.dimension)])

    def closest_point(self, x: Reals) -> np.ndarray:
        """Return the point of the set that is closest to x (n,), in the Euclidean norm, or one for
        each of many (k, n). ValueError if the set is empty."""
        name = type(self).__name__
        self._require_fields(name)
        given, many = one_or_many("x", x, self.dimension)
        if self.is_empty():
            fail(name, "is empty: it has no closest point", "Ask is_empty() first")
        values = host_array("x", given)
        if not np.isfinite(values).all():
            fail("x", "holds NaN or infinity", "Give finite numbers")
        if not many:
            return self._closest(values)
        return np.array([self._closest(v) for v in values]).reshape(values.shape)

    def distance(self, x: Reals) -> Any:
        """Return the Euclidean distance of x (n,), or of each of many (k, n), to the set; 0
        inside. ValueError if the set is empty."""
        found = np.linalg.norm(host_array("x", x) - self.closest_point(x), axis=-1)
        return found if found.ndim else float(found)

    def spread(self, n: int) -> Self:
        """Return the set, a Box of two numbers as the box with these bounds of n coordinates."""
        return self

    def is_subset(self, other: "BasicSet", tolerance: float = 1e-9) -> bool:
        """Return whether no point of the set violates a limit of another set by more than
        `tolerance`, relative to the limit's own terms.

        A row a'x <= b of the other may be exceeded by tolerance (|b| + sum_i |a_i| max |x_i|),
        whatever its units and those of x; the maxima are over the set, infinite ones left out. The
        level of an Ellipsoid may be exceeded by that fraction. An empty set is a subset of every
        set. Of a Polytope's rows an upper bound counts, made from an LP's multipliers (`lp.bound`)
        and valid for any LP error but along coordinates in which the set is unbounded.
        """
        if not isinstance(other, BasicSet):
            fail("other", f"{type(other).__name__} is no set", "Give a Box, Polytope, Zonotope, …")
        self, other = self.spread(other.dimension), other.spread(self.dimension)
        self._require_fields(type(self).__name__)
        other._require_fields("other", self.dimension)
        if self.is_empty():
            return True
        if other.is_empty():
            return False
        return other._covers(self, max(tolerance, ROUNDING))

    def reduce(self) -> Any:
        """Return the set without the rows that never bind: itself, where it is not given by
        rows."""
        return self

    def translate(self, by: Reals) -> Any:
        """Return {x + by : x in the set}, by (n,)."""
        by = vector("by", by, self.dimension)
        return self.image(np.eye(len(by)), by)

    def _times(self, factor: float) -> Any:
        """Return {factor x : x in the set}."""
        return self.image(factor * np.eye(self.dimension))

    def plot(self, ax: Any = None, **style: Any) -> Any:
        """Draw a set of two or three dimensions, and return the axes; ax, style: as in
        `jm.sets.plot`, which draws several."""
        return drawing.plot(self, ax=ax, **style)

    def __contains__(self, x: Any) -> bool:
        return bool(self.contains(vector("x", x, self.dimension)))

    def __matmul__(self, M: Any) -> Any:
        return self.preimage(M)

    def __rmatmul__(self, M: Any) -> Any:
        return self.image(M)

    def __add__(self, other: Any) -> Any:
        if isinstance(other, BasicSet):
            return self.minkowski_sum(other)
        return self.translate(other)

    __radd__ = __add__

    def __sub__(self, other: Any) -> Any:
        if isinstance(other, BasicSet):
            return self.pontryagin_difference(other)
        return self.translate(-vector("by", other, self.dimension))

    def __rsub__(self, other: Any) -> Any:
        return (-self).translate(other)

    def __truediv__(self, divisor: Any) -> Any:
        require_real("divisor", divisor)
        if np.ndim(divisor) or not np.isfinite(divisor) or divisor == 0:
            fail("divisor", f"{shown(divisor)} divides no set", "Give a finite number, not 0")
        return self._times(1 / float(divisor))

    def __and__(self, other: Any) -> Any:
        return self.intersect(other)

    def __or__(self, other: Any) -> Any:
        cure = "Write jm.sets.PolytopeUnion((P.to_polytope(), Q.to_polytope()))"
        raise TypeError(f"P | Q is no convex set. {cure}")

    def __neg__(self) -> Any:
        return self._times(-1.0)

    def __mul__(self, factor: Any) -> Any:
        if isinstance(factor, BasicSet):
            cure = "P.cartesian_product(Q) is that of two sets; P * 2.0 is a larger one"
            fail("factor", f"is a {type(factor).__name__}", cure)
        require_real("factor", factor)
        if np.ndim(factor) or not np.isfinite(factor):
            cure = "Give a finite one; A @ P is the image under A"
            fail("factor", f"{shown(factor)} is not a number", cure)
        return self._times(float(factor))

    __rmul__ = __mul__

    def __le__(self, other: Any) -> bool:
        return self.is_subset(other) if isinstance(other, BasicSet) else NotImplemented

    def __ge__(self, other: Any) -> bool:
        return other.is_subset(self) if isinstance(other, BasicSet) else NotImplemented

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, BasicSet):
            return NotImplemented
        if self is other:
            return True
        same = self.dimension == other.dimension
        return same and self.is_subset(other) and other.is_subset(self)

    # To be equal is a matter of a tolerance, which no hash can respect.
    __hash__ = None  # type: ignore[assignment]


def sample_size(count: int) -> int:
    """Return how many points a sample has, checked."""
    return whole("count", count, 0)
