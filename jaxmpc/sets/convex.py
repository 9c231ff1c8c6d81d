"""Convex sets: boxes, polytopes and ellipsoids.

`contains`, `Box.support` and `Ellipsoid.support` are JAX functions of one point (map them with
`jax.vmap`); outside of JAX's transformations they answer in float64, whatever JAX's own precision.
Everything that needs an LP (HiGHS) or a convex hull (qhull) runs in NumPy, in float64
and outside JAX's transformations, and raises ValueError for sets that are empty, flat or unbounded
where those make no sense.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from scipy.spatial import ConvexHull

from jaxmpc.arrays import Reals, as_array, dimensions, host_array, store_floats
from jaxmpc.checks import (
    concrete,
    fail,
    require_finite,
    require_printable,
    require_real,
    require_shape,
    require_symmetric_psd,
)
from jaxmpc.pytrees import pytree
from jaxmpc.qp.linalg import solve
from jaxmpc.sets.geometry import (
    binding_rows,
    distinct,
    dual_hull,
    eliminate,
    explained,
    factors,
    hull_volume,
    irredundant_rows,
    largest_ball,
    unit_rows,
)
from jaxmpc.sets.geometry import irredundant as _irredundant
from jaxmpc.sets.lp import (
    FLAT,
    ROUNDING,
    Flat,
    Frame,
    Optimum,
    Program,
    affine_hull,
    bound,
    cleaned,
    framed,
    maximise,
    safe_extent,
    scaling,
)

# An array of JAX or NumPy.
Rows: TypeAlias = jax.Array | np.ndarray

__all__ = ["Box", "Ellipsoid", "Optimum", "Polytope", "hull_volume", "maximise", "unit_rows"]


@pytree
@dataclass(frozen=True, eq=False)
class Box:
    """{x in R^n : lower <= x <= upper}, elementwise.

    Arguments:
        lower, upper: (n,) arrays, in the units of x; -inf and inf for no bound. A number beside an
            array stands for all its coordinates; two numbers are an interval, n = 1, and in an
            `MPC` the bounds of every coordinate.
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
        _require_shapes(argument, self, ("lower", "upper"), 1, dimension)
        if not concrete((self.lower, self.upper)):
            return
        lower = host_array(f"{argument}.lower", self.lower)
        upper = host_array(f"{argument}.upper", self.upper)
        for name, value in (("lower", lower), ("upper", upper)):
            if np.isnan(value).any():
                fail(f"{argument}.{name}", "holds NaN", "Use -inf or inf for no bound")
        empty = (lower > upper) | (lower == np.inf) | (upper == -np.inf)
        if empty.any():
            i = int(np.argmax(empty))
            fail(
                argument,
                f"is empty: lower[{i}] = {lower[i]:g}, upper[{i}] = {upper[i]:g}",
                "Give lower <= upper, with -inf below or inf above for no bound",
            )

    def contains(self, x: Reals, tolerance: float = 0.0) -> Any:
        """Return whether lower - tolerance <= x <= upper + tolerance, x of shape (n,)."""
        self = self.spread(1)
        _require_shapes("Box", self, ("lower", "upper"), 1)
        require_shape("x", x, (self.dimension,), "Give one point; use jax.vmap for many")
        xp, (x, lower, upper, tolerance) = _numbers(x, self.lower, self.upper, tolerance)
        return xp.all((lower - tolerance <= x) & (x <= upper + tolerance))

    def support(self, d: Reals) -> Any:
        """Return max d'x over the box, d of shape (n,); inf where the box is unbounded along d."""
        self = self.spread(1)
        _require_shapes("Box", self, ("lower", "upper"), 1)
        require_shape("d", d, (self.dimension,), "Give one direction; use jax.vmap for many")
        xp, (along, lower, upper) = _numbers(d, self.lower, self.upper)
        # The maximiser, with 0 where d is 0: there 0 * inf would be NaN.
        return along @ xp.where(along > 0, upper, xp.where(along < 0, lower, 0))

    def tightened(self, fraction: Any) -> "Box":
        """Return the box with its two-sided coordinates narrowed on each side by a fraction of
        their half-width. Works inside jit, vmap and grad with respect to `fraction`."""
        lower, upper = np.asarray(self.lower, float), np.asarray(self.upper, float)
        half = np.where(np.isfinite(upper - lower), upper - lower, 0.0) / 2
        return Box(lower + fraction * half, upper - fraction * half)

    def half_widths(self) -> np.ndarray:
        """Return half the distance between the two ends of each coordinate, (n,); 1 where an end
        is infinite or both coincide. It is the unit of weights and tolerances. NumPy; not
        traceable."""
        self = self.spread(1)
        width = (host_array("upper", self.upper) - host_array("lower", self.lower)) / 2
        return np.where(np.isfinite(width) & (width > 0), width, 1.0)

    def rows(self) -> tuple[Rows, Rows, Rows]:
        """Return (H, lower, upper) of the two-sided rows lower <= H x <= upper; H is the
        identity."""
        self = self.spread(1)
        lower, upper = _as_floats(self.lower), _as_floats(self.upper)
        return np.eye(self.dimension, dtype=lower.dtype), lower, upper

    def to_polytope(self) -> "Polytope":
        """Return the same set as H x <= h, with infinite bounds dropped. NumPy; not traceable."""
        lower, upper = self._bounds()
        identity = np.eye(len(lower))
        above, below = np.isfinite(upper), np.isfinite(lower)
        return Polytope(
            np.vstack([identity[above], -identity[below]]),
            np.concatenate([upper[above], -lower[below]]),
        )

    def intersect(self, other: "Box | Polytope") -> "Box | Polytope":
        """Return the points in both sets: a Box with a Box (perhaps empty), else a Polytope. NumPy;
        not traceable."""
        if not isinstance(other, Box):
            return self.to_polytope().intersect(other)
        lower, upper = self._bounds()
        other.validate("other", len(lower))
        return Box(
            np.maximum(lower, host_array("other.lower", other.lower)),
            np.minimum(upper, host_array("other.upper", other.upper)),
        )

    def vertices(self) -> np.ndarray:
        """Return the corners (2^n, n); counter-clockwise in 2-D. NumPy; not traceable. Raises
        ValueError if unbounded."""
        lower, upper = self._finite_bounds()
        corners = np.array(list(itertools.product(*zip(lower, upper, strict=True))))
        return corners[[0, 2, 3, 1]] if len(lower) == 2 else corners

    def volume(self) -> float:
        """Return the length, area or volume. NumPy; not traceable. Raises ValueError if
        unbounded."""
        lower, upper = self._finite_bounds()
        return float(np.prod(upper - lower))

    def _bounds(self) -> tuple[np.ndarray, np.ndarray]:
        self = self.spread(1)
        self.validate("Box")
        return host_array("Box.lower", self.lower), host_array("Box.upper", self.upper)

    def _finite_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        lower, upper = self._bounds()
        if not np.isfinite([lower, upper]).all():
            fail("Box", "is unbounded", "Give finite bounds in every coordinate")
        return lower, upper


@pytree
@dataclass(frozen=True, eq=False)
class Polytope:
    """{x in R^n : H x <= h}.

    Arguments:
        H: (rows, n) outward normals, of any length.
        h: (rows,) offsets; inf for a row that does not bind.
        labels: names of the rows, such as "q1 <= 1.5 rad"; empty for none. A row that comes
            out of `intersect`, `reduce` or `preimage` keeps the label it went in with.
    """

    H: Reals
    h: Reals
    labels: tuple[str, ...] = field(default=(), metadata={"static": True})

    def __post_init__(self) -> None:
        store_floats(self, "H", "h")

    @classmethod
    def from_points(cls, points: Reals) -> "Polytope":
        """Return the convex hull of `points` (k, n), one unit outward normal per facet. NumPy; not
        traceable.

        Raises ValueError if the points are not finite or lie in a hyperplane.
        """
        points = host_array("points", points)
        if points.ndim != 2 or not points.size:
            fail("points", f"shape {points.shape} is not (k, n)", "Give one row per point")
        require_finite("points", points)
        centre = points.mean(axis=0)
        scale = np.abs(points - centre).max(axis=0)
        scaled = (points - centre) / np.where(scale > 0, scale, 1.0)
        if np.linalg.matrix_rank(scaled, rtol=FLAT) < points.shape[1]:
            fail("points", "lie in a hyperplane", "Give points that span a set with volume")
        if points.shape[1] == 1:
            return cls(np.array([[1.0], [-1.0]]), np.array([points.max(), -points.min()]))
        # qhull's facets are simplices: a facet with more corners comes several times.
        with explained("points"):
            facets = ConvexHull(scaled).equations
        facets = facets[distinct(facets, 1e-10)]
        normals, offsets = facets[:, :-1] / scale, -facets[:, -1]
        size = np.abs(offsets) + np.abs(normals) @ np.abs(centre)
        return cls(*unit_rows(normals, cleaned(offsets + normals @ centre, size)))

    @property
    def dimension(self) -> int:
        """Return n, the number of coordinates."""
        return np.shape(as_array(self.H))[-1]

    def validate(self, argument: str, dimension: int | None = None) -> None:
        """Raise ValueError, naming `argument`, for wrong shapes, NaN or an empty set.

        The set is empty if a checked Farkas vector says so (`is_empty`).
        """
        self._require_fields(argument, dimension)
        if concrete((self.H, self.h)) and Program(*unit_rows(self.H, self.h, argument)).empty:
            fail(argument, "is empty: no point satisfies all its rows", "Loosen its rows")

    def is_empty(self) -> bool:
        """Return whether no point satisfies all rows: whether an LP finds multipliers y >= 0 with
        G'y = 0 and g'y < 0, by more than rounding (1e-11 of the terms). NumPy; not traceable."""
        H, h = host_array("H", self.H), host_array("h", self.h)
        if np.any((h == -np.inf) | (~H.any(axis=1) & (h < 0))):
            return True
        return Program(*unit_rows(H, h)).empty

    def contains(self, x: Reals, tolerance: float = 0.0) -> Any:
        """Return whether H x <= h + tolerance (in the scale of each row), x of shape (n,)."""
        _require_shapes("Polytope", self, ("H", "h"), 2)
        require_shape("x", x, (self.dimension,), "Give one point; use jax.vmap for many")
        xp, (H, h, x, tolerance) = _numbers(self.H, self.h, x, tolerance)
        return xp.all(_product(xp, H, x) <= h + tolerance)

    def support(self, d: Reals) -> float:
        """Return max d'x over the set, by one LP; inf if unbounded along d. NumPy; not traceable.
        Raises ValueError if the set is empty."""
        G, g = self._rows()
        d = host_array("d", d)
        require_shape("d", d, (self.dimension,), "Give one direction")
        require_finite("d", d)
        value = maximise(d, G, g).value
        if value == -np.inf:
            fail("Polytope", "is empty: no point satisfies all its rows", "Loosen its rows")
        return value

    def rows(self) -> tuple[Rows, Rows, Rows]:
        """Return (H, lower, upper) of the two-sided rows lower <= H x <= upper; lower is -inf."""
        H, h = _as_floats(self.H), _as_floats(self.h)
        return H, np.full(np.shape(h), -np.inf, dtype=h.dtype), h

    def chebyshev(self) -> tuple[np.ndarray, float]:
        """Return (centre, radius) of the largest ball inside, by one LP. NumPy; not traceable.

        The radius of a flat set is 0. Raises ValueError if the set is empty, or holds balls
        of every radius.
        """
        centre, radius = largest_ball("Polytope", *self._rows())
        if radius == np.inf:
            fail("Polytope", "is unbounded: it holds arbitrarily large balls", "Add rows")
        return centre, max(radius, 0.0)

    def intersect(self, other: "Box | Polytope") -> "Polytope":
        """Return the points in both sets: the rows of both, not reduced. NumPy; not traceable.

        If one of the two has labels, the unlabelled rows of the other get the label "".
        """
        parts = (self, _as_polytope("other", other))
        for argument, part in zip(("Polytope", "other"), parts, strict=True):
            part._require_fields(argument, self.dimension)
        H = [host_array("H", part.H) for part in parts]
        h = [host_array("h", part.h) for part in parts]
        labels = [part.labels or ("",) * len(b) for part, b in zip(parts, h, strict=True)]
        named = any(part.labels for part in parts)
        return Polytope(np.vstack(H), np.concatenate(h), labels[0] + labels[1] if named else ())

    def scale(self, factor: float) -> "Polytope":
        """Return {factor x : x in the set}, factor > 0. NumPy; not traceable."""
        self._require_fields("Polytope")
        require_real("factor", factor)
        if not (np.ndim(factor) == 0 and np.isfinite(factor) and factor > 0):
            fail("factor", f"{factor!r} is not a positive number", "Give a finite factor > 0")
        return Polytope(host_array("H", self.H), host_array("h", self.h) * float(factor))

    def preimage(self, M: Reals, t: Reals | None = None) -> "Polytope":
        """Return {x : M x + t in the set} = {x : H M x <= h - H t}, row by row, not reduced. NumPy;
        not traceable.

        Arguments:
            M: (n, k), any matrix.
            t: (n,), or None for 0.
        """
        self._require_fields("Polytope")
        H, h = host_array("Polytope.H", self.H), host_array("Polytope.h", self.h)
        M, t = _affine(M, t, (self.dimension, None))
        return Polytope(
            cleaned(H @ M, np.abs(H) @ np.abs(M)),
            cleaned(h - H @ t, np.abs(h) + np.abs(H) @ np.abs(t)), self.labels,
        )  # fmt: skip

    def image(self, M: Reals, t: Reals | None = None) -> "Polytope":
        """Return {M x + t : x in the set}, reduced unless M is square. NumPy; not traceable.

        Arguments:
            M: (k, n) of rank k.
            t: (k,), or None for 0.

        With k < n, y = M x is solved for k entries of x, which leaves the set of all (y, rest
        of x); `project` then eliminates the rest.

        Raises ValueError if rank M < k (the image is flat), or as `project` does.
        """
        M, t = _affine(M, t, (None, self.dimension))
        k, n = M.shape
        # Units of x and y must not decide the rank.
        row, column = scaling(M, np.zeros(k))
        scaled = row[:, None] * M * column
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
        NumPy; not traceable.

        Arguments:
            axes: the coordinates to keep, in the order wanted.

        Exact up to rounding: Fourier-Motzkin elimination of the other coordinates, redundant
        rows removed after each (Ziegler 1995, section 1.2). The set may be unbounded, and flat if
        its projection is not: then coordinates are eliminated by its equalities first.

        Raises ValueError if the projection is empty or flat, or there are too many rows to
        eliminate.
        """
        axes, n = list(axes), self.dimension
        wrong = not axes or len(set(axes)) < len(axes) or not set(axes) <= set(range(n))
        if wrong:
            fail("axes", f"{axes} are not distinct numbers in 0..{n - 1}", "Name those to keep")
        G, g = self._rows()
        try:
            Z, centre, scale = framed("Polytope", G, g)
        except Flat:
            return self._project_flat(G, g, axes)
        Z = eliminate(Z, sorted(set(range(n)) - set(axes)))[:, np.argsort(np.argsort(axes))]
        Y, about = Z / scale[axes], centre[axes]
        return Polytope(*unit_rows(Y, cleaned(1 + Y @ about, 1 + np.abs(Y) @ np.abs(about))))

    @staticmethod
    def _project_flat(G: np.ndarray, g: np.ndarray, axes: list[int]) -> "Polytope":
        """Return the projection of a flat set, in coordinates of its affine hull."""
        hull = affine_hull(G, g)
        assert hull is not None
        onto = hull.basis[axes]
        row, column = scaling(onto, np.zeros(len(axes)))
        if not hull.equal.any() or not (
            onto.shape[1] >= len(axes)
            and np.linalg.matrix_rank(row[:, None] * onto * column, rtol=FLAT) == len(axes)
        ):
            cure = "Check the rows: this needs a result with volume"
            fail("Polytope", "is flat, and so is its projection", cure)
        image = Polytope(hull.G, hull.g).image(onto, hull.shift[axes])
        return Polytope(*irredundant_rows("Polytope", *image._rows()))

    def minkowski_sum(self, other: "Box | Polytope | Reals") -> "Polytope":
        """Return {x + w : x in the set, w in other}, with irredundant unit rows. NumPy; not
        traceable.

        Arguments:
            other: Box, Polytope, or points (k, n), which stand for their convex hull.

        Bounded sets in up to three dimensions: the hull of all sums of vertices. Else the
        projection to x of {(x, w) : x - w in the set, w in other}.

        Raises ValueError if a set is empty, or the sum flat.
        """
        n = self.dimension
        points: np.ndarray | None
        if not isinstance(other, Box | Polytope):
            points = host_array("other", other)
            if points.ndim != 2 or points.shape[1] != n or not len(points):
                fail("other", f"shape {points.shape} is not (k, {n})", "Give a set, or points")
            require_finite("other", points)
        else:
            other.validate("other", n)
            points = _vertices_of(other) if n <= 3 else None
        vertices = _vertices_of(self) if n <= 3 and points is not None else None
        if points is not None and vertices is not None:
            return Polytope.from_points((vertices[:, None] + points).reshape(-1, n))
        # x = s + shift + D w with s in the set and w in `weights`, a set with volume.
        weights, D, shift = _generated(other, points)
        lifted = self.preimage(np.hstack([np.eye(n), -D]), -shift)
        if weights is not None:
            k = D.shape[1]
            lifted = lifted.intersect(weights.preimage(np.eye(k, n + k, n)))
        return lifted.project(range(n))

    def pontryagin_difference(self, other: "Box | Polytope | Ellipsoid | Reals") -> "Polytope":
        """Return {x : x + w in the set for all w in other}: H x <= h - max {H w : w in other}.
        NumPy; not traceable.

        Arguments:
            other: Box, Polytope, Ellipsoid, or points (k, n), which stand for their convex hull.

        Row by row, not reduced, and exact (Kolmanovsky & Gilbert 1998, Math. Problems in Eng. 4,
        theorem 2.3). The result may be empty (`is_empty` tells).
        """
        self._require_fields("Polytope")
        H, h = host_array("Polytope.H", self.H), host_array("Polytope.h", self.h)
        binding = binding_rows(H, h)
        reach = np.zeros(len(h))
        reach[binding] = _supports(other, H[binding])
        return Polytope(H, cleaned(h - reach, np.abs(h) + np.abs(reach)))

    def is_subset(self, other: "Box | Polytope", tolerance: float = 1e-9) -> bool:
        """Return whether no point of the set violates a row of `other` by more than `tolerance`,
        relative to the row's own terms. NumPy; not traceable.

        A row a'x <= b may be exceeded by tolerance (|b| + sum_i |a_i| max |x_i|), whatever its
        units and those of x; the maxima are over the set, infinite ones left out. It is judged by
        an upper bound of its maximum made from an LP's multipliers (`lp.bound`), valid for any LP
        error but along coordinates in which the set is unbounded. An empty set is a subset of
        every set.
        """
        if self.is_empty():
            return True
        other = _as_polytope("other", other)
        other._require_fields("other", self.dimension)
        rows, offsets = unit_rows(other.H, other.h, "other")
        G, g = self._rows()
        reach = safe_extent(G, g)
        reach[np.isinf(reach)] = 0.0
        allowed = max(tolerance, ROUNDING) * (np.abs(offsets) + np.abs(rows) @ reach)
        program = Program(G, g)
        for row, most in zip(rows, offsets + allowed, strict=True):
            y = program.maximise(row).y
            if y is None or bound(row, y, G, g, reach) > most:
                return False
        return True

    def reduce(self) -> "Polytope":
        """Return the same set with the fewest rows, each of norm 1. NumPy; not traceable.

        Rows that cut off less than about 1e-12 of the set's size (near-duplicates, rows that
        touch a vertex) are dropped; 1e-10 in more than six dimensions. Raises ValueError if
        the set is empty, flat or unbounded.

        Method: about an interior point c the row a'x <= b reads y'(x - c) <= 1 with
        y = a / (b - a'c), and it is irredundant exactly if y is a vertex of the convex hull
        of all the y (polarity; Ziegler 1995, section 2.3). A product of sets is reduced factor by
        factor; factors of more than six dimensions by one LP per row.
        """
        G, g = self._rows()
        keep = _irredundant(self._dual(G, g).Z)
        labels: tuple[str, ...] = ()
        if self.labels:
            binding = binding_rows(host_array("H", self.H), host_array("h", self.h))
            labels = tuple(self.labels[i] for i in binding[keep])
        return Polytope(G[keep], g[keep], labels)

    def vertices(self) -> np.ndarray:
        """Return the vertices (k, n); counter-clockwise in 2-D, ascending in 1-D. NumPy; not
        traceable.

        The vertex dual to the facet {y : v'y = 1} of the hull described in `reduce` is
        c + v. Raises ValueError if the set is empty, flat or unbounded.
        """
        Z, centre, scale = self._dual(*self.reduce()._rows())
        if self.dimension == 1:
            return np.sort(centre + scale / Z, axis=0)
        V = dual_hull(Z).intersections
        V = V[distinct(V / np.abs(V).max(axis=0), 1e-10)]
        if self.dimension == 2:
            V = V[np.argsort(np.arctan2(V[:, 1], V[:, 0]))]
        return centre + V * scale

    def volume(self) -> float:
        """Return the length, area or volume, of a product of sets factor by factor. NumPy; not
        traceable.

        Raises ValueError if the set is empty, flat or unbounded.
        """
        Z, _, scale = self._dual(*self.reduce()._rows())
        parts, S = factors(Z)
        if len(parts) == 1:
            return hull_volume(self.vertices())
        volumes = [Polytope(part, np.ones(len(part))).volume() for _, part in parts]
        return float(np.prod(volumes) * np.prod(scale) / abs(np.linalg.det(S)))

    def _require_fields(self, argument: str, dimension: int | None = None) -> None:
        _require_shapes(argument, self, ("H", "h"), 2, dimension)
        require_labels(f"{argument}.labels", self.labels, np.shape(as_array(self.h))[0])

    def _rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows that can bind, scaled to norm 1."""
        self._require_fields("Polytope")
        return unit_rows(self.H, self.h)

    @staticmethod
    def _dual(G: np.ndarray, g: np.ndarray) -> Frame:
        """Return the frame of a bounded set with volume; raise ValueError for any other."""
        frame = framed("Polytope", G, g)
        if not frame.bounded:
            fail("Polytope", "is unbounded", "Check the rows: this needs a bounded set")
        return frame


@pytree
@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """{x in R^n : x'P x <= level}, centred at the origin.

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

    def contains(self, x: Reals, tolerance: float = 0.0) -> Any:
        """Return whether x'P x <= level + tolerance, x of shape (n,)."""
        self._require_fields("Ellipsoid")
        require_shape("x", x, (self.dimension,), "Give one point; use jax.vmap for many")
        xp, (P, level, x, tolerance) = _numbers(self.P, self.level, x, tolerance)
        return _product(xp, x, _product(xp, P, x)) <= level + tolerance

    def support(self, d: Reals) -> Any:
        """Return max d'x over the ellipsoid = sqrt(level d'P^-1 d), d of shape (n,)."""
        self._require_fields("Ellipsoid")
        require_shape("d", d, (self.dimension,), "Give one direction; use jax.vmap for many")
        xp, (along, P, level) = _numbers(d, self.P, self.level)
        solved = np.linalg.solve(P, along) if xp is np else solve(P, along)
        return xp.sqrt(level * (along @ solved))

    def volume(self) -> float:
        """Return the length, area or volume: pi^(n/2) / Gamma(n/2 + 1) level^(n/2) / sqrt(det P).
        NumPy; not traceable."""
        P, level = self._values()
        half = len(P) / 2
        logarithm = half * np.log(np.pi * level) - math.lgamma(half + 1)
        return float(np.exp(logarithm - np.linalg.slogdet(P)[1] / 2))

    def bounding_box(self) -> Box:
        """Return the smallest box around it: |x_i| <= sqrt(level (P^-1)_ii). NumPy; not
        traceable."""
        P, level = self._values()
        reach = np.sqrt(level * np.diag(np.linalg.inv(P)))
        return Box(-reach, reach)

    def boundary(self, count: int = 200) -> np.ndarray:
        """Return points (count, 2) of an ellipse, counter-clockwise, for plots. NumPy, 2-D only;
        not traceable."""
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
        _require_dimension(argument, shape[0], dimension)
        require_shape(f"{argument}.level", as_array(self.level), (), "Give one number")


def translated(set_: Any, by: np.ndarray) -> Any:
    """Return the set {x + by : x in set_}; None for None. NumPy; not traceable.

    Raises ValueError for an Ellipsoid, whose centre is the origin, unless by = 0.
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
    if not isinstance(set_, Box | Polytope):
        fail(argument, f"{type(set_).__name__} is no convex set", "Give a Box or Polytope")
    set_ = set_.spread(n) if isinstance(set_, Box) else set_
    set_.validate(argument, n)
    polytope = _as_polytope(argument, set_)
    return unit_rows(polytope.H, polytope.h, argument)


def require_labels(argument: str, labels: Any, rows: int) -> None:
    """Raise unless `labels` is a tuple of strings, one a row or none."""
    if not isinstance(labels, tuple) or not all(isinstance(label, str) for label in labels):
        fail(argument, f"{labels!r} is not a tuple of strings", 'Write it as ("q <= 1", "q >= -1")')
    if len(labels) not in (0, rows):
        fail(argument, f"{len(labels)} entries for {rows} rows", "Label all rows or none")
    require_printable(argument, *labels)


def _as_polytope(argument: str, value: Any) -> Polytope:
    """Return a Box or Polytope as a Polytope; raise ValueError, naming `argument`, otherwise."""
    if not isinstance(value, Box | Polytope):
        fail(argument, f"{type(value).__name__} is no Box or Polytope", "Give one")
    return value.to_polytope() if isinstance(value, Box) else value


def _vertices_of(set_: Box | Polytope) -> np.ndarray | None:
    """Return the vertices of a set; None where it is unbounded or flat."""
    try:
        return set_.vertices()
    except ValueError:
        return None


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


def _generated(
    other: "Box | Polytope | Reals", points: np.ndarray | None
) -> tuple[Polytope | None, np.ndarray, np.ndarray]:
    """Return (W, D, shift) with {D w + shift : w in W} = other, W with volume; None: other =
    {shift}."""
    if isinstance(other, Box):
        lower, upper = host_array("lower", other.lower), host_array("upper", other.upper)
        wide = upper > lower
        weights = Box(lower[wide], upper[wide]).to_polytope() if wide.any() else None
        return weights, np.eye(len(lower))[:, wide], np.where(wide, 0.0, lower)
    if isinstance(other, Polytope):
        return other, np.eye(other.dimension), np.zeros(other.dimension)
    assert points is not None
    # Weights >= 0 of all points but the last, with a sum <= 1; the last gets the rest.
    k = len(points) - 1
    weights = Polytope(np.vstack([-np.eye(k), np.ones((1, k))]), np.r_[np.zeros(k), 1.0])
    return weights if k else None, (points[:-1] - points[-1]).T, points[-1]


def _supports(other: Any, H: np.ndarray) -> np.ndarray:
    """Return max H_i w over w in other for each row of H; inf if unbounded."""
    n = H.shape[1]
    if isinstance(other, Box | Polytope | Ellipsoid):
        other.validate("other", n)
    if isinstance(other, Box):
        lower, upper = host_array("lower", other.lower), host_array("upper", other.upper)
        # 0 where a row does not contain the coordinate: 0 * inf would be NaN.
        ends = np.where(H > 0, upper, np.where(H < 0, lower, 0.0))
        return (H * ends).sum(axis=1)
    if isinstance(other, Polytope):
        return np.array([other.support(row) for row in H])
    if isinstance(other, Ellipsoid):
        P, level = other._values()
        return np.sqrt(level * (H * np.linalg.solve(P, H.T).T).sum(axis=1))
    points = host_array("other", other)
    if points.ndim != 2 or points.shape[1] != n or not len(points):
        fail("other", f"shape {points.shape} is not (k, {n})", "Give a set, or points")
    require_finite("other", points)
    return (H @ points.T).max(axis=1)


def _numbers(*values: Any) -> tuple[Any, list[Any]]:
    """Return NumPy and the values in float64, or jax.numpy and its arrays where one is traced."""
    if concrete(*values):
        return np, [host_array("argument", value) for value in values]
    return jnp, [jnp.asarray(value) for value in values]


def _product(xp: Any, M: Any, v: Any) -> Any:
    """Return M v, by JAX in the precision of the arrays."""
    return M @ v if xp is np else jnp.matmul(M, v, precision="highest")


def _as_floats(value: Any) -> Any:
    """Return `value` as an array that keeps its floating dtype; traced values stay traced."""
    value = as_array(value)
    value = value if isinstance(value, jax.Array) else np.asarray(value)
    return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(float)


def _require_shapes(
    argument: str,
    instance: Box | Polytope,
    names: tuple[str, str],
    ndim: int,
    dimension: int | None = None,
) -> None:
    """Raise unless the first field is (n,) or (rows, n), and the second matches its length."""
    first, second = (as_array(getattr(instance, name)) for name in names)
    for name, value in zip(names, (first, second), strict=True):
        if concrete(value):
            host_array(f"{argument}.{name}", value)
    shape = np.shape(first)
    if len(shape) != ndim or shape[-1] == 0:
        wanted = "(n,)" if ndim == 1 else "(rows, n)"
        fail(f"{argument}.{names[0]}", f"shape {shape} is not {wanted}", "Give a list or array")
    _require_dimension(argument, shape[-1], dimension)
    require_shape(f"{argument}.{names[1]}", second, shape[:1], f"Match {names[0]}")


def _require_dimension(argument: str, given: int, wanted: int | None) -> None:
    if wanted is not None and given != wanted:
        fail(
            argument,
            f"has dimension {given} where {wanted} is needed",
            "Bound every coordinate (inf for no bound)",
        )
