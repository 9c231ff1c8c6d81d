"""Convex sets in R^n: boxes, polytopes, zonotopes, and ellipsoids about the origin.

`contains`, `Box.support` and `Ellipsoid.support` are JAX functions of one point (map them with
`jax.vmap`); outside of JAX's transformations they answer in float64, whatever JAX's own precision.
Everything that needs an LP (HiGHS) or a convex hull (qhull) runs in NumPy, in float64 and outside
JAX's transformations, and raises ValueError for sets that are empty, flat or unbounded where those
make no sense.
"""

import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from types import ModuleType
from typing import Any, Self, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from scipy.spatial import ConvexHull

from jaxmpc.arrays import Reals, as_array, dimensions, host_array, store_floats
from jaxmpc.checks import (
    concrete,
    fail,
    number,
    require_finite,
    require_printable,
    require_real,
    require_shape,
    require_symmetric_psd,
)
from jaxmpc.pytrees import pytree, static
from jaxmpc.qp.linalg import solve
from jaxmpc.sets import generators, geometry
from jaxmpc.sets.geometry import Flat, Frame, affine_hull, framed
from jaxmpc.sets.lp import FLAT, ROUNDING, Program, cleaned, extent, maximise, scaling

# An array, a number, True or False, of JAX or NumPy.
AnyArray: TypeAlias = jax.Array | np.ndarray
AnyNumber: TypeAlias = jax.Array | np.floating | float
AnyTruth: TypeAlias = jax.Array | np.ndarray | np.bool


class ConvexSet(ABC):
    """A convex set in R^n: Box, Polytope, Zonotope or Ellipsoid."""

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
    """A set of linear inequalities: Box, Polytope or Zonotope."""

    def spread(self, n: int) -> Self:
        """Return the set, a Box of two numbers as the box with these bounds of n coordinates."""
        return self

    @abstractmethod
    def half_spaces(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (H, h) of the rows H x <= h. NumPy; not traceable."""

    @abstractmethod
    def vertices(self) -> np.ndarray:
        """Return the vertices (k, n); ValueError if the set is unbounded."""


@pytree
class Box(LinearSet):
    """{x in R^n : lower <= x <= upper}, elementwise.

    Arguments:
        lower, upper: (n,) arrays, in the units of x; -inf and inf for no bound. A number beside an
            array stands for all its coordinates; two numbers are an interval, n = 1, and in an
            `MPC` the bounds of every coordinate.

    All methods but `contains`, `support`, `tightened` and `rows` run in NumPy, not traceable.
    """

    lower: Reals
    upper: Reals

    def __post_init__(self) -> None:
        store_floats(self, "lower", "upper")
        axes = dimensions(self.lower), dimensions(self.upper)
        if axes in ((0, 1), (1, 0)):
            one, other = ("lower", "upper") if axes[0] == 0 else ("upper", "lower")
            self._fill(one, np.shape(as_array(getattr(self, other))))

    def _fill(self, name: str, shape: tuple[int, ...]) -> None:
        value = getattr(self, name)
        full = jnp.broadcast_to if isinstance(value, jax.Array) else np.broadcast_to
        object.__setattr__(self, name, full(value, shape))
        store_floats(self, name)

    def spread(self, n: int) -> "Box":
        """Return the box with two numbers as the bounds of each of n coordinates; any other box
        unchanged."""
        if (dimensions(self.lower), dimensions(self.upper)) != (0, 0):
            return self
        box = Box(self.lower, self.upper)
        for name in ("lower", "upper"):
            box._fill(name, (n,))
        return box

    @property
    def dimension(self) -> int:
        """Return n, the number of coordinates."""
        return (np.shape(as_array(self.lower)) or (1,))[-1]

    def validate(self, argument: str, dimension: int | None = None) -> None:
        """Raise ValueError, naming `argument`, for wrong shapes, NaN or an empty box."""
        self = self.spread(1)
        self._require_fields(argument, dimension)
        if not concrete((self.lower, self.upper)):
            return
        lower, upper = self.bounds(argument)
        for name, value in (("lower", lower), ("upper", upper)):
            if np.isnan(value).any():
                fail(f"{argument}.{name}", "holds NaN", "Use -inf or inf for no bound")
        empty = (lower > upper) | (lower == np.inf) | (upper == -np.inf)
        if empty.any():
            i = int(np.argmax(empty))
            cure = "Give lower <= upper, with -inf below or inf above for no bound"
            fail(argument, f"is empty: lower[{i}] = {lower[i]:g}, upper[{i}] = {upper[i]:g}", cure)

    def contains(self, x: Reals, tolerance: float = 0.0) -> AnyTruth:
        """Return whether lower - tolerance <= x <= upper + tolerance, x of shape (n,)."""
        self = self.spread(1)
        self._require_vector("x", x, "point")
        xp, (x, lower, upper, tolerance) = numbers(x, self.lower, self.upper, tolerance)
        return xp.all((lower - tolerance <= x) & (x <= upper + tolerance))

    def support(self, d: Reals) -> AnyNumber:
        """Return max d'x over the box, d of shape (n,); inf where the box is unbounded along d."""
        self = self.spread(1)
        self._require_vector("d", d, "direction")
        xp, (along, lower, upper) = numbers(d, self.lower, self.upper)
        # The maximiser, with 0 where d is 0: there 0 * inf would be NaN.
        return along @ xp.where(along > 0, upper, xp.where(along < 0, lower, 0))

    def tightened(self, fraction: float | jax.Array) -> "Box":
        """Return the box with its two-sided coordinates narrowed on each side by a fraction of
        their half-width. Works inside jit, vmap and grad with respect to `fraction`."""
        lower, upper = np.asarray(self.lower, float), np.asarray(self.upper, float)
        half = np.where(np.isfinite(upper - lower), upper - lower, 0.0) / 2
        return Box(lower + fraction * half, upper - fraction * half)

    def half_widths(self) -> np.ndarray:
        """Return half the distance between the two ends of each coordinate, (n,); 1 where an end
        is infinite or both coincide. It is the unit of weights and tolerances."""
        lower, upper = self.spread(1).bounds()
        width = (upper - lower) / 2
        return np.where(np.isfinite(width) & (width > 0), width, 1.0)

    def rows(self) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Return (H, lower, upper) of the two-sided rows lower <= H x <= upper; H is the
        identity."""
        self = self.spread(1)
        lower, upper = as_floats(self.lower), as_floats(self.upper)
        return np.eye(self.dimension, dtype=lower.dtype), lower, upper

    def half_spaces(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (H, h) of the rows H x <= h of finite bounds."""
        lower, upper = self._checked_bounds()
        identity = np.eye(len(lower))
        above, below = np.isfinite(upper), np.isfinite(lower)
        rows = np.vstack([identity[above], -identity[below]])
        return rows, np.concatenate([upper[above], -lower[below]])

    def to_polytope(self) -> "Polytope":
        """Return the same set as H x <= h, with infinite bounds dropped."""
        return Polytope(*self.half_spaces())

    def intersect(self, other: LinearSet) -> "Box | Polytope":
        """Return the points in both sets: a Box with a Box (perhaps empty), else a Polytope."""
        if not isinstance(other, Box):
            return self.to_polytope().intersect(other)
        lower, upper = self._checked_bounds()
        other.validate("other", len(lower))
        lower_too, upper_too = other.bounds("other")
        return Box(np.maximum(lower, lower_too), np.minimum(upper, upper_too))

    def vertices(self) -> np.ndarray:
        """Return the corners (2^n, n), counter-clockwise in 2-D; ValueError if unbounded."""
        lower, upper = self._finite_bounds()
        corners = np.array(list(itertools.product(*zip(lower, upper, strict=True))))
        return corners[[0, 2, 3, 1]] if len(lower) == 2 else corners

    def volume(self) -> float:
        """Return the length, area or volume; ValueError if unbounded."""
        lower, upper = self._finite_bounds()
        return float(np.prod(upper - lower))

    def _require_fields(self, argument: str, dimension: int | None = None) -> None:
        require_matching(argument, {"lower": self.lower, "upper": self.upper}, 1, dimension)

    def bounds(self, argument: str = "Box") -> tuple[np.ndarray, np.ndarray]:
        """Return copies of (lower, upper) in float64. NumPy; not traceable."""
        lower = host_array(f"{argument}.lower", self.lower)
        return lower, host_array(f"{argument}.upper", self.upper)

    def _checked_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        self = self.spread(1)
        self.validate("Box")
        return self.bounds()

    def _finite_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        lower, upper = self._checked_bounds()
        if not np.isfinite([lower, upper]).all():
            fail("Box", "is unbounded", "Give finite bounds in every coordinate")
        return lower, upper


@pytree
class Ellipsoid(ConvexSet):
    """{x in R^n : x'P x <= level}, centered at the origin.

    Arguments:
        P: (n, n), symmetric positive definite.
        level: a number > 0.
    """

    P: Reals
    level: Reals

    def __post_init__(self) -> None:
        store_floats(self, "P", "level")

    @property
    def dimension(self) -> int:
        """Return n, the number of coordinates."""
        return np.shape(as_array(self.P))[-1]

    def validate(self, argument: str, dimension: int | None = None) -> None:
        """Raise ValueError, naming `argument`, for wrong shapes, P not positive definite,
        or level <= 0."""
        self._require_fields(argument, dimension)
        if not concrete((self.P, self.level)):
            return
        require_symmetric_psd(f"{argument}.P", self.P, definite=True)
        level = host_array(f"{argument}.level", self.level)
        if not (np.isfinite(level) and level > 0):
            fail(f"{argument}.level", f"{level:g} is not a positive number", "Give x'Px's maximum")

    def contains(self, x: Reals, tolerance: float = 0.0) -> AnyTruth:
        """Return whether x'P x <= level + tolerance, x of shape (n,)."""
        self._require_vector("x", x, "point")
        xp, (P, level, x, tolerance) = numbers(self.P, self.level, x, tolerance)
        return product(xp, x, product(xp, P, x)) <= level + tolerance

    def support(self, d: Reals) -> AnyNumber:
        """Return max d'x over the ellipsoid = sqrt(level d'P^-1 d), d of shape (n,)."""
        self._require_vector("d", d, "direction")
        xp, (along, P, level) = numbers(d, self.P, self.level)
        solved = np.linalg.solve(P, along) if xp is np else solve(P, along)
        return xp.sqrt(level * (along @ solved))

    def volume(self) -> float:
        """Return the volume pi^(n/2) / Gamma(n/2 + 1) level^(n/2) / sqrt(det P). In NumPy."""
        P, level = self._values()
        half = len(P) / 2
        logarithm = half * np.log(np.pi * level) - math.lgamma(half + 1)
        return float(np.exp(logarithm - np.linalg.slogdet(P)[1] / 2))

    def bounding_box(self) -> Box:
        """Return the smallest box around it: |x_i| <= sqrt(level (P^-1)_ii). In NumPy."""
        P, level = self._values()
        reach = np.sqrt(level * np.diag(np.linalg.inv(P)))
        return Box(-reach, reach)

    def boundary(self, count: int = 200) -> np.ndarray:
        """Return points (count, 2) of an ellipse, counter-clockwise, for plots. In NumPy."""
        P, level = self._values()
        if len(P) != 2:
            fail("Ellipsoid", f"has dimension {len(P)}", "Only an ellipse can be drawn")
        angles = np.arange(count) * 2 * np.pi / count
        # P = L L' and x = L'^-1 w give x'Px = |w|^2.
        circle = math.sqrt(level) * np.array([np.cos(angles), np.sin(angles)])
        return np.linalg.solve(np.linalg.cholesky(P).T, circle).T

    def _values(self) -> tuple[np.ndarray, float]:
        self.validate("Ellipsoid")
        P = host_array("Ellipsoid.P", self.P)
        return (P + P.T) / 2, float(host_array("Ellipsoid.level", self.level))

    def _require_fields(self, argument: str, dimension: int | None = None) -> None:
        shape = np.shape(as_array(self.P))
        if len(shape) != 2 or shape[0] != shape[1] or not shape[0]:
            fail(f"{argument}.P", f"shape {shape} is not (n, n)", "Give a square matrix")
        require_dimension(argument, shape[0], dimension)
        require_shape(f"{argument}.level", as_array(self.level), (), "Give one number")


@pytree
class Polytope(LinearSet):
    """{x in R^n : H x <= h}.

    Arguments:
        H: (rows, n) outward normals, of any length.
        h: (rows,) offsets; inf for a row that does not bind.
        labels: names of the rows, such as "q1 <= 1.5 rad"; empty for none. A row that comes
            out of `intersect`, `reduce` or `preimage` keeps the label it went in with.

    All methods but `contains` and `rows` run in NumPy in float64, and are not traceable.
    """

    H: Reals
    h: Reals
    labels: tuple[str, ...] = static(default=())

    def __post_init__(self) -> None:
        store_floats(self, "H", "h")

    @classmethod
    def from_points(cls, points: Reals) -> "Polytope":
        """Return the convex hull of `points` (k, n), one unit outward normal per facet.

        Raises ValueError if the points are not finite or lie in a hyperplane.
        """
        points = host_array("points", points)
        if points.ndim != 2 or not points.size:
            fail("points", f"shape {points.shape} is not (k, n)", "Give one row per point")
        require_finite("points", points)
        center = points.mean(axis=0)
        scale = np.abs(points - center).max(axis=0)
        scaled = (points - center) / np.where(scale > 0, scale, 1.0)
        if np.linalg.matrix_rank(scaled, rtol=FLAT) < points.shape[1]:
            fail("points", "lie in a hyperplane", "Give points that span a set with volume")
        if points.shape[1] == 1:
            return cls(np.array([[1.0], [-1.0]]), np.array([points.max(), -points.min()]))
        # qhull's facets are simplices: a facet with more corners comes several times.
        with geometry.explained("points"):
            facets = ConvexHull(scaled).equations
        facets = facets[geometry.distinct(facets, 1e-10)]
        normals, offsets = facets[:, :-1] / scale, -facets[:, -1]
        size = np.abs(offsets) + np.abs(normals) @ np.abs(center)
        return cls(*geometry.unit_rows(normals, cleaned(offsets + normals @ center, size)))

    @property
    def dimension(self) -> int:
        """Return n, the number of coordinates."""
        return np.shape(as_array(self.H))[-1]

    def validate(self, argument: str, dimension: int | None = None) -> None:
        """Raise ValueError, naming `argument`, for wrong shapes, NaN or an empty set.

        The set is empty if a checked Farkas vector says so (`is_empty`).
        """
        self._require_fields(argument, dimension)
        if concrete((self.H, self.h)) and Program(*self.unit_rows(argument)).empty:
            fail(argument, "is empty: no point satisfies all its rows", "Loosen its rows")

    def is_empty(self) -> bool:
        """Return whether no point satisfies all rows: whether an LP finds multipliers y >= 0 with
        G'y = 0 and g'y < 0, by more than rounding (1e-11 of the terms)."""
        H, h = self.half_spaces()
        if np.any((h == -np.inf) | (~H.any(axis=1) & (h < 0))):
            return True
        return Program(*geometry.unit_rows(H, h)).empty

    def contains(self, x: Reals, tolerance: float = 0.0) -> AnyTruth:
        """Return whether H x <= h + tolerance (in the scale of each row), x of shape (n,)."""
        self._require_vector("x", x, "point")
        xp, (H, h, x, tolerance) = numbers(self.H, self.h, x, tolerance)
        return xp.all(product(xp, H, x) <= h + tolerance)

    def support(self, d: Reals) -> float:
        """Return max d'x over the set, by one LP; inf if unbounded along d. Raises ValueError if
        the set is empty."""
        G, g = self.unit_rows()
        d = host_array("d", d)
        require_shape("d", d, (self.dimension,), "Give one direction")
        require_finite("d", d)
        value = maximise(d, G, g).value
        if value == -np.inf:
            fail("Polytope", "is empty: no point satisfies all its rows", "Loosen its rows")
        return value

    def rows(self) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Return (H, lower, upper) of the two-sided rows lower <= H x <= upper; lower is -inf."""
        H, h = as_floats(self.H), as_floats(self.h)
        return H, np.full(np.shape(h), -np.inf, dtype=h.dtype), h

    def half_spaces(self) -> tuple[np.ndarray, np.ndarray]:
        """Return copies of (H, h) in float64."""
        return host_array("Polytope.H", self.H), host_array("Polytope.h", self.h)

    def unit_rows(self, argument: str = "Polytope") -> tuple[np.ndarray, np.ndarray]:
        """Return the rows that can bind, scaled to norm 1."""
        self._require_fields(argument)
        return geometry.unit_rows(self.H, self.h, argument)

    def frame(self, argument: str = "Polytope") -> Frame:
        """Return a point inside, and the set about it in units in which it is about 1 wide; raise
        ValueError, naming `argument`, if it is empty or flat."""
        return framed(argument, *self.unit_rows(argument))

    def chebyshev(self) -> tuple[np.ndarray, float]:
        """Return (center, radius) of the largest ball inside, by one LP.

        The radius of a flat set is 0. Raises ValueError if the set is empty, or holds balls
        of every radius.
        """
        center, radius = geometry.largest_ball("Polytope", *self.unit_rows())
        if radius == np.inf:
            fail("Polytope", "is unbounded: it holds arbitrarily large balls", "Add rows")
        return center, max(radius, 0.0)

    def intersect(self, other: LinearSet) -> "Polytope":
        """Return the points in both sets, another being a Box or Polytope: the rows of both, not
        reduced.

        If one of the two has labels, the unlabelled rows of the other get the label "".
        """
        other = as_polytope("other", other)
        self._require_fields("Polytope", self.dimension)
        other._require_fields("other", self.dimension)
        (H, h), (H_too, h_too) = self.half_spaces(), other.half_spaces()
        labels: tuple[str, ...] = ()
        if self.labels or other.labels:
            labels = (self.labels or ("",) * len(h)) + (other.labels or ("",) * len(h_too))
        return Polytope(np.vstack([H, H_too]), np.concatenate([h, h_too]), labels)

    def scale(self, factor: float) -> "Polytope":
        """Return {factor x : x in the set}, factor > 0."""
        self._require_fields("Polytope")
        require_real("factor", factor)
        if not (np.ndim(factor) == 0 and np.isfinite(factor) and factor > 0):
            fail("factor", f"{factor!r} is not a positive number", "Give a finite factor > 0")
        H, h = self.half_spaces()
        return Polytope(H, h * float(factor))

    def preimage(self, M: Reals, t: Reals | None = None) -> "Polytope":
        """Return {x : M x + t in the set} = {x : H M x <= h - H t}, row by row, not reduced.

        Arguments:
            M: (n, k), any matrix.
            t: (n,), or None for 0.
        """
        self._require_fields("Polytope")
        H, h = self.half_spaces()
        M, t = _affine(M, t, (self.dimension, None))
        normals = cleaned(H @ M, np.abs(H) @ np.abs(M))
        offsets = cleaned(h - H @ t, np.abs(h) + np.abs(H) @ np.abs(t))
        return Polytope(normals, offsets, self.labels)

    def image(self, M: Reals, t: Reals | None = None) -> "Polytope":
        """Return {M x + t : x in the set}, reduced unless M is square.

        Arguments:
            M: (k, n) of rank k.
            t: (k,), or None for 0.

        With k < n, y = M x is solved for k entries of x, which leaves the set of all (y, rest
        of x); `project` then eliminates the rest.

        Raises ValueError if rank M < k (the image is flat), or as `project` does.
        """
        M, t = _affine(M, t, (None, self.dimension))
        k, n = M.shape
        scaled = _scaled(M)
        if np.linalg.matrix_rank(scaled, rtol=FLAT) < k:
            fail("M", f"has rank below {k}, so the image is flat", "Map to fewer coordinates")
        order = scipy.linalg.qr(scaled, mode="r", pivoting=True)[1]
        # z = (y - t, x[order[k:]]) = T x
        T = np.vstack([M, np.eye(n)[order[k:]]])
        lifted = self.preimage(np.linalg.inv(T))
        image = lifted if k == n else lifted.project(range(k))
        return image.preimage(np.eye(k), -t)

    def project(self, axes: Sequence[int]) -> "Polytope":
        """Return the set of (x_i for i in axes) over all x in the set, with irredundant unit rows.

        Arguments:
            axes: the coordinates to keep, in the order wanted.

        Exact up to rounding: Fourier-Motzkin elimination of the other coordinates, redundant
        rows removed after each (Ziegler 1995, section 1.2). The set may be unbounded, and flat if
        its projection is not: then coordinates are eliminated by its equalities first.

        Raises ValueError if the projection is empty or flat, or there are too many rows to
        eliminate.
        """
        n = self.dimension
        axes = _axes(axes, n)
        try:
            Z, center, scale = self.frame()
        except Flat:
            return self._project_flat(axes)
        others = sorted(set(range(n)) - set(axes))
        Y = geometry.eliminate(Z, others)[:, np.argsort(np.argsort(axes))] / scale[axes]
        about = center[axes]
        offsets = cleaned(1 + Y @ about, 1 + np.abs(Y) @ np.abs(about))
        return Polytope(*geometry.unit_rows(Y, offsets))

    def _project_flat(self, axes: list[int]) -> "Polytope":
        """Return the projection of a flat set, in coordinates of its affine hull."""
        hull = affine_hull(*self.unit_rows())
        assert hull is not None
        onto = hull.basis[axes]
        full = onto.shape[1] >= len(axes) == np.linalg.matrix_rank(_scaled(onto), rtol=FLAT)
        if not (hull.equal.any() and full):
            cure = "Check the rows: this needs a result with volume"
            fail("Polytope", "is flat, and so is its projection", cure)
        image = Polytope(hull.G, hull.g).image(onto, hull.shift[axes])
        return Polytope(*geometry.irredundant_rows("Polytope", *image.unit_rows()))

    def minkowski_sum(self, other: LinearSet | Reals) -> "Polytope":
        """Return {x + w : x in the set, w in other}, with irredundant unit rows.

        Arguments:
            other: Box, Polytope, or points (k, n), which stand for their convex hull.

        Bounded sets in up to three dimensions: the hull of all sums of vertices. Else the
        projection to x of {(x, w) : x - w in the set, w in other}.

        Raises ValueError if a set is empty, or the sum flat.
        """
        n = self.dimension
        if isinstance(other, LinearSet):
            other.validate("other", n)
            points = _vertices_of(other) if n <= 3 else None
        else:
            points = _points(other, n)
        vertices = _vertices_of(self) if n <= 3 and points is not None else None
        if points is not None and vertices is not None:
            return Polytope.from_points((vertices[:, None] + points).reshape(-1, n))
        # x = s + D w + shift with s in the set and w in `weights`.
        if isinstance(other, LinearSet):
            D, shift, weights = np.eye(n), np.zeros(n), as_polytope("other", other)
        else:
            D, shift, weights = _combinations(_points(other, n))
        k = D.shape[1]
        lifted = self.preimage(np.hstack([np.eye(n), -D]), -shift)
        if k:  # a single point has no weights
            lifted = lifted.intersect(weights.preimage(np.eye(k, n + k, n)))
        return lifted.project(range(n))

    def pontryagin_difference(self, other: ConvexSet | Reals) -> "Polytope":
        """Return {x : x + w in the set for all w in other}: H x <= h - max {H w : w in other}.

        Arguments:
            other: Box, Polytope, Ellipsoid, or points (k, n), which stand for their convex hull.

        Row by row, not reduced, and exact (Kolmanovsky & Gilbert 1998, Math. Problems in Eng. 4,
        theorem 2.3). The result may be empty (`is_empty` tells).
        """
        self._require_fields("Polytope")
        H, h = self.half_spaces()
        binding = geometry.binding_rows(H, h)
        reach = np.zeros(len(h))
        if isinstance(other, ConvexSet):
            other.validate("other", self.dimension)
            reach[binding] = [other.support(row) for row in H[binding]]
        else:
            reach[binding] = (H[binding] @ _points(other, self.dimension).T).max(axis=1)
        return Polytope(H, cleaned(h - reach, np.abs(h) + np.abs(reach)))

    def is_subset(self, other: LinearSet, tolerance: float = 1e-9) -> bool:
        """Return whether no point of the set violates a row of `other`, a Box or Polytope, by more
        than `tolerance`, relative to the row's own terms.

        A row a'x <= b may be exceeded by tolerance (|b| + sum_i |a_i| max |x_i|), whatever its
        units and those of x; the maxima are over the set, infinite ones left out. What counts is
        an upper bound of its maximum made from an LP's multipliers (`lp.bound`), valid for any LP
        error but along coordinates in which the set is unbounded. An empty set is a subset of
        every set.
        """
        if self.is_empty():
            return True
        other = as_polytope("other", other)
        other._require_fields("other", self.dimension)
        rows, offsets = other.unit_rows("other")
        program = Program(*self.unit_rows())
        reach = extent(program.G, program.g)
        reach[np.isinf(reach)] = 0.0
        allowed = max(tolerance, ROUNDING) * (np.abs(offsets) + np.abs(rows) @ reach)
        return all(
            program.bound(row, program.maximise(row), reach) <= most
            for row, most in zip(rows, offsets + allowed, strict=True)
        )

    def reduce(self) -> "Polytope":
        """Return the same set with the fewest rows, each of norm 1.

        Rows that cut off less than about 1e-12 of the set's size (near-duplicates, rows that
        touch a vertex) are dropped; 1e-10 in more than six dimensions. Raises ValueError if
        the set is empty, flat or unbounded.

        Method: about an interior point c the row a'x <= b reads y'(x - c) <= 1 with
        y = a / (b - a'c), and it is irredundant exactly if y is a vertex of the convex hull
        of all the y (polarity; Ziegler 1995, section 2.3). A product of sets is reduced factor by
        factor; factors of more than six dimensions by one LP per row.
        """
        G, g = self.unit_rows()
        rows = geometry.irredundant(self._bounded_frame().Z)
        labels: tuple[str, ...] = ()
        if self.labels:
            binding = geometry.binding_rows(*self.half_spaces())
            labels = tuple(self.labels[i] for i in binding[rows])
        return Polytope(G[rows], g[rows], labels)

    def vertices(self) -> np.ndarray:
        """Return the vertices (k, n); counter-clockwise in 2-D, ascending in 1-D.

        The vertex dual to the facet {y : v'y = 1} of the hull described in `reduce` is
        c + v. Raises ValueError if the set is empty, flat or unbounded.
        """
        Z, center, scale = self.reduce()._bounded_frame()
        if self.dimension == 1:
            return np.sort(center + scale / Z, axis=0)
        V = geometry.dual_hull(Z).intersections
        V = V[geometry.distinct(V / np.abs(V).max(axis=0), 1e-10)]
        if self.dimension == 2:
            V = V[np.argsort(np.arctan2(V[:, 1], V[:, 0]))]
        return center + V * scale

    def volume(self) -> float:
        """Return the length, area or volume, of a product of sets factor by factor.

        Raises ValueError if the set is empty, flat or unbounded.
        """
        Z, _, scale = self.reduce()._bounded_frame()
        parts, S = geometry.factors(Z)
        if len(parts) == 1:
            return geometry.hull_volume(self.vertices())
        volumes = [Polytope(part, np.ones(len(part))).volume() for _, part in parts]
        return float(np.prod(volumes) * np.prod(scale) / abs(np.linalg.det(S)))

    def _require_fields(self, argument: str, dimension: int | None = None) -> None:
        require_matching(argument, {"H": self.H, "h": self.h}, 2, dimension)
        require_labels(f"{argument}.labels", self.labels, np.shape(as_array(self.h))[0])

    def _bounded_frame(self) -> Frame:
        frame = self.frame()
        if not frame.bounded:
            fail("Polytope", "is unbounded", "Check the rows: this needs a bounded set")
        return frame


@pytree
class Zonotope(LinearSet):
    """{center + generators w : |w_i| <= 1}, the sum of a point and m segments in R^n.

    Arguments:
        center: (n,), in the units of x.
        generators: (n, m), one column each; m = 0 makes it the point `center`. It may be flat.

    Sums, images and supports are exact in any dimension, with m or fewer operations a number.
    Vertices, half-spaces and volume need subsets of the generators: few dimensions or few
    generators. All methods but `support` run in NumPy, not traceable.
    """

    center: Reals
    generators: Reals

    def __post_init__(self) -> None:
        store_floats(self, "center", "generators")

    @classmethod
    def from_box(cls, box: Box) -> "Zonotope":
        """Return a bounded box as a zonotope, one generator a coordinate of positive width."""
        lower, upper = box._finite_bounds()
        half = (upper - lower) / 2
        return cls(lower + half, np.diag(half)[:, half > 0])

    @property
    def dimension(self) -> int:
        """Return n, the number of coordinates."""
        return np.shape(as_array(self.center))[-1]

    def validate(self, argument: str, dimension: int | None = None) -> None:
        """Raise ValueError, naming `argument`, for wrong shapes, NaN or infinity."""
        self._require_fields(argument, dimension)
        require_finite(f"{argument}.center", self.center)
        require_finite(f"{argument}.generators", self.generators)

    def support(self, d: Reals) -> AnyNumber:
        """Return max d'x over the zonotope = d'center + |generators'd|_1, for one direction d (n,)
        or for each of many (k, n)."""
        self._require_fields("Zonotope")
        d = as_array(d)
        if np.ndim(d) != 2 or np.shape(d)[1] != self.dimension:
            require_shape("d", d, (self.dimension,), "Give one direction, or one a row")
        xp, (along, center, G) = numbers(d, self.center, self.generators)
        return product(xp, along, center) + xp.abs(product(xp, along, G)).sum(axis=-1)

    def contains(self, x: Reals, tolerance: float = 0.0) -> AnyTruth:
        """Return whether a point x (n,), or each of many (k, n), lies within `tolerance` of the
        zonotope in each coordinate.

        By one LP a point. A point counts as inside up to 1e-10 of the half-widths.
        """
        center, G = self._values()
        points = host_array("x", x)
        if points.ndim != 2 or points.shape[1] != self.dimension:
            require_shape("x", points, (self.dimension,), "Give one point, or one a row")
        number("tolerance", tolerance, 0.0, "Give a distance, or 0")
        inside = np.array(
            [generators.holds(center, G, point, tolerance) for point in np.atleast_2d(points)], bool
        )
        return inside if points.ndim == 2 else np.bool(inside.item())

    def minkowski_sum(self, other: "LinearSet | Reals") -> "Zonotope | Polytope":
        """Return {x + w : x in the set, w in other}: a Zonotope with a Zonotope, a bounded Box or a
        point (1, n); a Polytope with a Polytope or with points (k, n), which stand for their convex
        hull."""
        if isinstance(other, Box):
            other.validate("other", self.dimension)
            other = Zonotope.from_box(other) if np.isfinite(other.bounds()).all() else other
        if isinstance(other, Zonotope):
            other.validate("other", self.dimension)
            (center, G), (center_too, G_too) = self._values(), other._values()
            return Zonotope(center + center_too, np.hstack([G, G_too]))
        if not isinstance(other, LinearSet):
            points = _points(other, self.dimension)
            if len(points) == 1:
                center, G = self._values()
                return Zonotope(center + points[0], G)
        return self.to_polytope().minkowski_sum(other)

    def image(self, M: Reals, t: Reals | None = None) -> "Zonotope":
        """Return {M x + t : x in the set}, with any matrix M (k, n); t (k,), or None for 0."""
        center, G = self._values()
        M, t = _affine(M, t, (None, len(center)))
        return Zonotope(M @ center + t, M @ G)

    def project(self, axes: Sequence[int]) -> "Zonotope":
        """Return the set of (x_i for i in axes) over all x in the set."""
        center, G = self._values()
        axes = _axes(axes, len(center))
        return Zonotope(center[axes], G[axes])

    def bounding_box(self) -> Box:
        """Return the smallest box around it."""
        center, G = self._values()
        half = generators.reach(G)
        return Box(center - half, center + half)

    def half_spaces(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (H, h) of its facets H x <= h, unit rows; opposite rows for the equalities of a
        flat set.

        The offsets are supports, exact to rounding. Raises ValueError where there are more than
        300,000 sets of n - 1 generators.
        """
        center, G = self._values()
        unit, U, N = generators.span(G)
        parts = [np.zeros((0, len(center)))]
        if U.shape[1]:
            S = generators.merged(U.T @ (G / unit[:, None]))
            parts.append(generators.facet_normals(S) @ U.T)
        d = np.vstack([*parts, N.T]) / unit
        d = cleaned(d, np.abs(d).max(axis=1, keepdims=True, initial=0.0))
        d = d / np.linalg.norm(d, axis=1)[:, None]
        middle, half = d @ center, np.abs(d @ G).sum(axis=1)
        half[len(d) - N.shape[1] :] = 0.0
        return np.vstack([d, -d]) + 0.0, np.concatenate([middle + half, half - middle])

    def to_polytope(self) -> "Polytope":
        """Return the same set as H x <= h, as `half_spaces` does."""
        return Polytope(*self.half_spaces())

    def vertices(self) -> np.ndarray:
        """Return the vertices (k, n), counter-clockwise in 2-D; those of a flat set too.

        Each is the center and all generators with their signs. Raises ValueError as `half_spaces`
        does.
        """
        center, G = self._values()
        G = generators.merged(G)
        unit, U, _ = generators.span(G)
        return center + generators.vertex_signs(U.T @ (G / unit[:, None])) @ G.T

    def volume(self) -> float:
        """Return the length, area or volume, 2^n sum |det| over all sets of n generators; 0 if
        flat. Raises ValueError where there are more than 5,000,000 of them."""
        return generators.volume(self._values()[1])

    def _values(self) -> tuple[np.ndarray, np.ndarray]:
        self.validate("Zonotope")
        center = host_array("Zonotope.center", self.center)
        return center, host_array("Zonotope.generators", self.generators)

    def _require_fields(self, argument: str, dimension: int | None = None) -> None:
        center, G = np.shape(as_array(self.center)), np.shape(as_array(self.generators))
        if len(center) != 1 or not center[0]:
            fail(f"{argument}.center", f"shape {center} is not (n,)", "Give a list or array")
        if len(G) != 2 or G[0] != center[0]:
            wanted = f"({center[0]}, m)"
            fail(f"{argument}.generators", f"shape {G} is not {wanted}", "Give one a column")
        require_dimension(argument, center[0], dimension)


def _affine(
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


def _scaled(M: np.ndarray) -> np.ndarray:
    """Return M in scaled rows and columns: units must not decide its rank."""
    row, column = scaling(M, np.zeros(len(M)))
    return row[:, None] * M * column


def _axes(axes: Sequence[int], n: int) -> list[int]:
    """Return the coordinates of an argument `axes`, checked."""
    axes = list(axes)
    if not axes or len(set(axes)) < len(axes) or not set(axes) <= set(range(n)):
        fail("axes", f"{axes} are not distinct numbers in 0..{n - 1}", "Name those to keep")
    return axes


def _points(points: Reals, n: int) -> np.ndarray:
    """Return the points of an argument `other` (k, n), checked."""
    values = host_array("other", points)
    if values.ndim != 2 or values.shape[1] != n or not len(values):
        fail("other", f"shape {values.shape} is not (k, {n})", "Give a set, or points")
    require_finite("other", values)
    return values


def _combinations(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, Polytope]:
    """Return (D, shift, W) with {D w + shift : w in W} = the hull of points (k, n): weights w >= 0
    of all points but the last with a sum <= 1, the last gets the rest."""
    k = len(points) - 1
    W = Polytope(np.vstack([-np.eye(k), np.ones((1, k))]), np.r_[np.zeros(k), 1.0])
    return (points[:-1] - points[-1]).T, points[-1], W


def _vertices_of(set_: LinearSet) -> np.ndarray | None:
    """Return the vertices of a set; None where it is unbounded or flat."""
    try:
        return set_.vertices()
    except ValueError:
        return None


# --- Functions of any set: Box, Polytope, Ellipsoid, or None for all of R^n -------------


def as_polytope(argument: str, value: object, n: int | None = None) -> Polytope:
    """Return a Box or Polytope as a Polytope; with n, checked to be a set in R^n.

    Raises ValueError, naming `argument`, for anything else.
    """
    if not isinstance(value, LinearSet):
        fail(argument, f"{type(value).__name__} is no Box or Polytope", "Give one")
    if n is not None:
        value = value.spread(n)
        value.validate(argument, n)
    return value if isinstance(value, Polytope) else Polytope(*value.half_spaces())


def translated(set_: Any, by: np.ndarray) -> Any:
    """Return the set {x + by : x in set_}; None for None. NumPy; not traceable.

    Raises ValueError for an Ellipsoid, whose center is the origin, unless by = 0.
    """
    if isinstance(set_, Box):
        return Box(np.asarray(set_.lower) + by, np.asarray(set_.upper) + by)
    if isinstance(set_, Polytope):
        return replace(set_, h=np.asarray(set_.h) + np.asarray(set_.H) @ by)
    if isinstance(set_, Ellipsoid) and by.any():
        fail("terminal_set", "is an Ellipsoid about the origin", "Use a Polytope")
    return set_


def unit_half_spaces(argument: str, set_: Any, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows (H, h) of a Box or Polytope in R^n, scaled to norm 1; no rows for None."""
    if set_ is None:
        return np.zeros((0, n)), np.zeros(0)
    if not isinstance(set_, LinearSet):
        fail(argument, f"{type(set_).__name__} is no convex set", "Give a Box or Polytope")
    return as_polytope(argument, set_, n).unit_rows(argument)


def set_bounds(set_: Box | Polytope | Ellipsoid | None, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper bounds (n,) of each coordinate on a set; ±inf for None.

    The bounds of a Box are exact; those of a Polytope, found by linear programs, and of an
    Ellipsoid are moved outwards by a part in 10⁶.
    """
    if set_ is None:
        return np.full(n, -np.inf), np.full(n, np.inf)
    if isinstance(set_, Box):
        return np.asarray(set_.lower, np.float64), np.asarray(set_.upper, np.float64)
    if isinstance(set_, Ellipsoid):
        least = np.zeros(n)
        lower, upper = set_.bounding_box().bounds()
    else:
        program = Program(*set_.unit_rows())
        lower, upper = program.bounds()
        least = 1e-6 * program.column
    size = [np.where(np.isfinite(v), np.abs(v), 0.0) for v in (lower, upper)]
    # Where the bounds are about 0, of the size that the rows' data are for.
    margin = 1e-6 * (least + np.maximum(*size))
    return lower - margin, upper + margin


# --- Fields and numbers, of NumPy or traced by JAX -------------------------------------


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


def require_labels(argument: str, labels: object, rows: int) -> None:
    """Raise unless `labels` is a tuple of strings, one a row or none."""
    if not isinstance(labels, tuple) or not all(isinstance(label, str) for label in labels):
        fail(argument, f"{labels!r} is not a tuple of strings", 'Write it as ("q <= 1", "q >= -1")')
    if len(labels) not in (0, rows):
        fail(argument, f"{len(labels)} entries for {rows} rows", "Label all rows or none")
    require_printable(argument, *labels)
