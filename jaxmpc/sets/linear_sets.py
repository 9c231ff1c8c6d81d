"""Sets of linear inequalities in R^n: polytopes, boxes and zonotopes.

`contains` and `support` of boxes, `contains` of polytopes and `support` of zonotopes are JAX
functions; outside of JAX's transformations they answer in float64, whatever JAX's own precision.
Everything that needs an LP (HiGHS) or a convex hull (qhull) runs in NumPy, in float64 and outside
JAX's transformations.

Sets may be empty, flat (without volume) or unbounded. A direction in which a set is thinner than
about 1e-9 of its size is one in which it is flat. Vertices and half-spaces are exact to about 1e-11
of the size of the set.
"""

import itertools
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
import scipy

from jaxmpc.arrays import (
    Reals,
    as_array,
    as_floats,
    dimensions,
    fill,
    host_array,
    store_floats,
)
from jaxmpc.checks import (
    concrete,
    fail,
    generator,
    number,
    require_finite,
    require_names,
    require_real,
    whole,
)
from jaxmpc.pytrees import pytree, record, static
from jaxmpc.sets import generators, geometry, polyhedra
from jaxmpc.sets.fields import (
    AnyArray,
    AnyNumber,
    AnyTruth,
    affine_map,
    chosen_axes,
    numbers,
    one_or_many,
    points,
    product,
    require_dimension,
    require_matching,
    section,
    vector,
)
from jaxmpc.sets.geometry import AffineHull, Empty, Flat, Frame, framed
from jaxmpc.sets.lp import Program, cleaned, extent, scaling
from jaxmpc.sets.operations import BasicSet, ConvexSet, sample_size

_MOST_VERTICES = 100_000  # corners of a box that are listed


class LinearSet(BasicSet):
    """A set of linear inequalities: Box, Polytope or Zonotope."""

    @abstractmethod
    def half_spaces(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (H, h) of the rows H x <= h. NumPy; not traceable."""

    @abstractmethod
    def vertices(self) -> np.ndarray:
        """Return the vertices (k, n), none of an empty set; ValueError if the set is unbounded."""

    def to_polytope(self) -> "Polytope":
        """Return the same set as H x <= h."""
        return Polytope(*self.half_spaces())

    def intersect(self, other: "LinearSet") -> "LinearSet":
        """Return the points in both sets, another being a Box, Polytope or Zonotope: a Polytope
        with the rows of both, not reduced."""
        return self.to_polytope().intersect(other)

    def preimage(self, M: Reals, t: Reals | None = None) -> "Polytope":
        """Return {x : M x + t in the set} = {x : H M x <= h - H t}, row by row, not reduced.

        Arguments:
            M: (n, k), any matrix.
            t: (n,), or None for 0.
        """
        P = self.to_polytope()
        P._require_fields(type(self).__name__)
        H, h = P.half_spaces()
        M, t = affine_map(M, t, (P.dimension, None))
        normals = cleaned(H @ M, np.abs(H) @ np.abs(M))
        offsets = cleaned(h - H @ t, np.abs(h) + np.abs(H) @ np.abs(t))
        return Polytope(normals, offsets, P.labels)

    def slice(self, values: Mapping[int, float]) -> "LinearSet":
        """Return the section with some coordinates fixed, {axis: value, ...}, in the others: {y :
        x in the set, x_axis = value, y the other coordinates}. It may be empty."""
        fixed, at, rest = section(values, self.dimension)
        H, h = self.half_spaces()
        offsets = cleaned(h - H[:, fixed] @ at, np.abs(h) + np.abs(H[:, fixed]) @ np.abs(at))
        return Polytope(H[:, rest], offsets)

    def chebyshev(self) -> tuple[np.ndarray, float]:
        """Return (center, radius) of the largest ball inside, by one LP.

        The radius of a flat set is 0. Raises ValueError if the set is empty, or holds balls
        of every radius.
        """
        kind = type(self).__name__
        center, radius = geometry.largest_ball(kind, *self.to_polytope().unit_rows())
        if radius == np.inf:
            fail(kind, "is unbounded: it holds arbitrarily large balls", "Add rows")
        return center, max(radius, 0.0)

    def full_part(self) -> "FullPart":
        """Return the affine hull of the set and the set in its coordinates, where it has volume.
        Raises ValueError if the set is empty."""
        hull = self.to_polytope()._hull()
        if hull is None:
            fail(type(self).__name__, "is empty: it has no affine hull", "Ask is_empty() first")
        part = Polytope(hull.G, hull.g) if hull.basis.shape[1] else None
        return FullPart(hull.shift, hull.basis, part)

    def affine_hull(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (E, e) of the affine hull {x : E x = e}, independent rows; none of a set with
        volume. Raises ValueError if the set is empty."""
        part = self.full_part()
        _, _, N = generators.span(part.basis) if part.basis.size else (0, 0, np.eye(self.dimension))
        size = np.abs(part.basis).sum(axis=1)
        E = N.T / np.where(size > 0, size, 1.0)
        E = cleaned(E, np.abs(E).max(axis=1, keepdims=True, initial=0.0))
        E = E / np.linalg.norm(E, axis=1)[:, None]
        return E, E @ part.point

    def cartesian_product(self, other: "LinearSet") -> "LinearSet":
        """Return {(x, y) : x in the set, y in other}."""
        (H, h), (H_too, h_too) = self.half_spaces(), as_polytope("other", other).half_spaces()
        return Polytope(scipy.linalg.block_diag(H, H_too), np.concatenate([h, h_too]))

    def pontryagin_difference(self, other: ConvexSet | Reals) -> "LinearSet":
        """Return {x : x + w in the set for all w in other}, as `Polytope` does."""
        return self.to_polytope().pontryagin_difference(other)

    def sample(self, count: int, seed: int = 0) -> np.ndarray:
        """Return points (count, n) that are uniformly distributed over the set, of a flat set over
        its affine hull's part; the same ones for the same seed.

        In up to six dimensions, by a triangulation of the vertices; Boxes in any. ValueError for
        empty and unbounded sets.
        """
        count, part = sample_size(count), self.full_part()
        if part.part is None:
            return np.tile(part.point, (count, 1))
        found = polyhedra.spread(part.part.vertices(), count, generator(seed))
        return part.point + found @ part.basis.T

    def _closest(self, x: np.ndarray) -> np.ndarray:
        return polyhedra.closest(*self.to_polytope().unit_rows(), x)

    def _covers(self, other: BasicSet, tolerance: float) -> bool:
        rows, offsets = self.to_polytope().unit_rows("other")
        return other._keeps(rows, offsets, tolerance)

    def _farthest(self, P: np.ndarray, center: np.ndarray) -> float:
        apart = self.vertices() - center
        return float(np.einsum("ij,jk,ik->i", apart, P, apart).max())


@record
class FullPart:
    """A set {point + basis w : w in part}, in coordinates of its affine hull.

    point (n,), basis (n, k): the affine hull, each w one of the coordinates of x. part: Polytope
    with volume in R^k; None for a point, k = 0.
    """

    point: np.ndarray
    basis: np.ndarray
    part: "Polytope | None"

    @property
    def dimension(self) -> int:
        """Return k, the dimension of the affine hull."""
        return self.basis.shape[1]


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
        self._require_given(H=2, h=1)

    @classmethod
    def from_points(cls, points: Reals) -> "Polytope":
        """Return the convex hull of `points` (k, n), one unit outward normal per facet; opposite
        rows for the equalities where they lie in a plane, a line or a point.

        Raises ValueError if the points are not finite.
        """
        points = host_array("points", points)
        if points.ndim != 2 or not points.size:
            fail("points", f"shape {points.shape} is not (k, n)", "Give one row per point")
        require_finite("points", points)
        return cls(*polyhedra.hull(points))

    @classmethod
    def empty(cls, n: int) -> "Polytope":
        """Return the empty set in R^n, as the row 0'x <= -1."""
        return cls(np.zeros((1, whole("n", n, 1))), np.array([-1.0]))

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
            fail(argument, "is empty: no point satisfies all its rows", geometry.NONE)

    def is_empty(self) -> bool:
        """Return whether no point satisfies all rows: whether an LP finds multipliers y >= 0 with
        G'y = 0 and g'y < 0, by more than rounding (1e-11 of the terms)."""
        try:
            return Program(*self.unit_rows()).empty
        except Empty:
            return True

    def is_bounded(self) -> bool:
        """Return whether the set is bounded, by LPs whose answer is checked; an empty one is."""
        hull = self._hull()
        if hull is None or not hull.basis.shape[1]:
            return True
        return framed("Polytope", hull.G, hull.g).bounded

    def affine_dimension(self) -> int:
        """Return the dimension of the affine hull: 0 for a point, n for a set with volume, -1 for
        the empty set."""
        hull = self._hull()
        return -1 if hull is None else hull.basis.shape[1]

    def contains(self, x: Reals, tolerance: float = 0.0) -> AnyTruth:
        """Return whether H x <= h + tolerance (in the scale of each row), for a point x (n,) or for
        each of many (k, n)."""
        self._require_fields("Polytope")
        x, many = one_or_many("x", x, self.dimension)
        geometry.require_rows(self.H, self.h)
        xp, (H, h, x, tolerance) = numbers(self.H, self.h, x, tolerance)
        value = product(xp, x, H.T) if many else product(xp, H, x)
        return xp.all(value <= h + tolerance, axis=-1)

    def support(self, d: Reals) -> AnyNumber:
        """Return max d'x over the set for one direction d (n,), or each of many (k, n), by an LP
        each; inf if unbounded along d. Raises ValueError if the set is empty."""
        G, g = self.unit_rows()
        given, many = one_or_many("d", d, self.dimension)
        d = host_array("d", given)
        require_finite("d", d)
        program = Program(G, g)
        values = [program.maximise(row).value for row in np.atleast_2d(d)]
        if -np.inf in values:
            fail("Polytope", "is empty: no point satisfies all its rows", geometry.NONE)
        return np.array(values) if many else values[0]

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

    def require_body(self, argument: str = "Polytope") -> "Polytope":
        """Return the set; raise ValueError, naming `argument`, unless it is bounded and has
        volume."""
        if not self.frame(argument).bounded:
            fail(argument, "is unbounded", "Check the rows: this needs a bounded set")
        return self

    def bounding_box(self) -> "Box":
        """Return the smallest box around it, by two LPs a coordinate; infinite bounds where it is
        unbounded, an empty box if it is empty."""
        if self.is_empty():
            return _empty_box(self.dimension)
        return Box(*Program(*self.unit_rows()).bounds())

    def to_polytope(self) -> "Polytope":
        """Return the set itself."""
        return self

    def intersect(self, other: LinearSet) -> "Polytope":
        """Return the points in both sets, another being a Box, Polytope or Zonotope: the rows of
        both, not reduced.

        If one of the two has labels, the unlabelled rows of the other get the label "".
        """
        n = self.dimension
        other = as_polytope("other", other.spread(n) if isinstance(other, LinearSet) else other)
        self._require_fields("Polytope", n)
        other._require_fields("other", n)
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

    def image(self, M: Reals, t: Reals | None = None) -> "Polytope":
        """Return {M x + t : x in the set}, reduced unless M is square and invertible.

        Arguments:
            M: (k, n), any matrix: the image is flat where M has a rank below k.
            t: (k,), or None for 0.

        Row by row where M is square and invertible, with a condition number up to 1e7 in scaled
        rows and columns; else the hull of the images of the vertices, of bounded sets in up to six
        dimensions. Of others y = M x is solved for k entries of x, which leaves the set of all (y,
        rest of x); `project` then eliminates the rest. There, of a matrix whose rank is r < k, r
        rows make a set with volume, and the others are combinations of them. Rank is told to
        1e-9, whatever the units.

        Raises ValueError as `project` does.
        """
        M, t = affine_map(M, t, (None, self.dimension))
        k, n = M.shape
        if polyhedra.well_conditioned(M):
            inverse = np.linalg.inv(M)
            return self.preimage(inverse, -inverse @ t)
        corners = _vertices_of(self) if n <= polyhedra.TRIANGULATED else None
        if corners is not None and len(corners):
            # Where M takes a direction to 0, rounding would be a width.
            first, terms = corners[0], np.abs(corners) @ np.abs(M).T
            moved = cleaned((corners - first) @ M.T, terms + terms[0])
            return Polytope.from_points(moved + (M @ first + t))
        hull = self._hull()
        if hull is None:
            return Polytope.empty(k)
        own, others, C = polyhedra.independent_rows(M)
        if hull.equal.any():
            if not hull.basis.shape[1]:
                point = M @ hull.shift + t
                return Box(point, point).to_polytope()
            # Rounding of zeros would be a direction of its own.
            along = cleaned(M @ hull.basis, np.abs(M) @ np.abs(hull.basis))
            return Polytope(hull.G, hull.g).image(along, M @ hull.shift + t)
        H, h = np.zeros((0, k)), np.zeros(0)
        if len(own):
            inner = self._onto(M[own])
            h = np.asarray(inner.h)
            H = np.zeros((len(h), k))
            H[:, own] = np.asarray(inner.H)
        E = np.zeros((len(others), k))
        E[np.arange(len(others)), others] = 1.0
        E[:, own] = -C
        image = Polytope(np.vstack([E, -E, H]), np.concatenate([np.zeros(2 * len(E)), h]))
        return image.preimage(np.eye(k), -t)

    def _onto(self, M: np.ndarray) -> "Polytope":
        """Return {M x : x in the set}, M of full row rank, of a set with volume."""
        k, n = M.shape
        row, column = scaling(M, np.zeros(k))
        order = scipy.linalg.qr(row[:, None] * M * column, mode="r", pivoting=True)[1]
        # x of (y, x[rest]), its zeros exact: rounding would bound sets where nothing does.
        own, rest = order[:k], order[k:]
        back, inverse = np.zeros((n, n)), np.linalg.inv(M[:, own])
        back[own] = np.hstack([inverse, -inverse @ M[:, rest]])
        back[rest, np.arange(k, n)] = 1.0
        lifted = self.preimage(back)
        return lifted if k == n else lifted.project(range(k))

    def project(self, axes: Sequence[int]) -> "Polytope":
        """Return the set of (x_i for i in axes) over all x in the set, with irredundant unit rows.

        Arguments:
            axes: the coordinates to keep, in the order wanted.

        Exact up to rounding: Fourier-Motzkin elimination of the other coordinates, redundant
        rows removed after each (Ziegler 1995, section 1.2); where that makes too many rows, the
        hull of the projected vertices. The set may be unbounded or flat, and the projection too.

        Raises ValueError if there are too many rows to eliminate, and too many vertices.
        """
        n = self.dimension
        axes = chosen_axes(axes, n)
        try:
            Z, center, scale = self.frame()
        except (Flat, Empty):
            return self.image(np.eye(n)[axes]).reduce()
        others = sorted(set(range(n)) - set(axes))
        try:
            Y = geometry.eliminate(Z, others)[:, np.argsort(np.argsort(axes))] / scale[axes]
        except ValueError as error:
            V = _vertices_of(self) if n <= polyhedra.TRIANGULATED else None
            if V is None:
                raise error
            return Polytope.from_points(V[:, axes])
        about = center[axes]
        offsets = cleaned(1 + Y @ about, 1 + np.abs(Y) @ np.abs(about))
        return Polytope(*geometry.unit_rows(Y, offsets))

    def minkowski_sum(self, other: LinearSet | Reals) -> "Polytope":
        """Return {x + w : x in the set, w in other}, with irredundant unit rows.

        Arguments:
            other: Box, Polytope, Zonotope, or points (k, n), which stand for their convex hull.

        Of bounded sets in up to six dimensions, flat ones too, the hull of sums of vertices. Else
        the projection to x of {(x, w) : x - w in the set, w in other}, by elimination.

        Raises ValueError for an Ellipsoid, or as `project` does.
        """
        n = self.dimension
        _require_summand(self, other)
        if isinstance(other, LinearSet):
            other = other.spread(n)
            other._require_fields("other", n)
            if self.is_empty() or other.is_empty():
                return Polytope.empty(n)
        corners = _corners(other, n)
        if corners is not None and len(corners) == 1:
            return self.translate(corners[0]).reduce()
        low = n <= polyhedra.TRIANGULATED and corners is not None
        vertices = _vertices_of(self) if low else None
        if corners is not None and vertices is not None:
            if not len(vertices):
                return Polytope.empty(n)
            return Polytope(*polyhedra.hull_of_sums(vertices, corners))
        # x = s + D w + shift with s in the set and w in `weights`.
        if isinstance(other, LinearSet):
            D, shift, weights = np.eye(n), np.zeros(n), as_polytope("other", other)
        else:
            D, shift, weights = _combinations(points("other", other, n))
        k = D.shape[1]
        lifted = self.preimage(np.hstack([np.eye(n), -D]), -shift)
        return lifted.intersect(weights.preimage(np.eye(k, n + k, n))).project(range(n))

    def translate(self, by: Reals) -> "Polytope":
        """Return {x + by : x in the set}, by (n,), with the rows and labels of the set."""
        self._require_fields("Polytope")
        return self.preimage(np.eye(self.dimension), -vector("by", by, self.dimension))

    def pontryagin_difference(self, other: ConvexSet | Reals) -> "Polytope":
        """Return {x : x + w in the set for all w in other}: H x <= h - max {H w : w in other}.

        Arguments:
            other: Box, Polytope, Zonotope, Ellipsoid, or points (k, n), which stand for their
                convex hull.

        Row by row, not reduced, and exact (Kolmanovsky & Gilbert 1998, Math. Problems in Eng. 4,
        theorem 2.3). The result may be empty (`is_empty` tells).
        """
        self._require_fields("Polytope")
        H, h = self.half_spaces()
        if isinstance(other, ConvexSet):
            other = other.spread(self.dimension) if isinstance(other, LinearSet) else other
            other.validate("other", self.dimension)
            support: Any = other.support
        else:
            corners = points("other", other, self.dimension)
            support = lambda rows: (rows @ corners.T).max(axis=1)
        try:
            binding = geometry.binding_rows(H, h)
        except Empty:
            return Polytope.empty(self.dimension)
        reach, axes = np.zeros(len(h)), np.eye(self.dimension)
        reach[binding] = support(H[binding])
        # Of supports far smaller than their terms, rounding is that of the terms.
        far = np.maximum(np.abs(support(axes)), np.abs(support(-axes)))
        terms = np.abs(H) @ np.where(np.isfinite(far), far, 0.0)
        return Polytope(H, cleaned(h - reach, np.abs(h) + np.abs(reach) + terms))

    def reduce(self) -> "Polytope":
        """Return the same set with the fewest rows, each of norm 1; of a flat set its equalities as
        pairs of opposite rows, then the rest. An empty set comes as 0'x <= -1.

        Rows that cut off less than about 1e-12 of the set's size (near-duplicates, rows that
        touch a vertex) are dropped; 1e-10 in more than six dimensions.

        Method: about an interior point c the row a'x <= b reads y'(x - c) <= 1 with
        y = a / (b - a'c), and it is irredundant exactly if y is a vertex of the convex hull
        of all the y (polarity; Ziegler 1995, section 2.3). A product of sets is reduced factor by
        factor; factors of more than six dimensions by one LP per row. Of a flat set all this is
        done in coordinates of its affine hull.
        """
        hull = self._hull()
        if hull is None:
            return Polytope.empty(self.dimension)
        (G, g), rows = self.unit_rows(), np.zeros(0, int)
        if hull.basis.shape[1]:
            frame = framed("Polytope", hull.G, hull.g)
            rows = hull.rows[geometry.irredundant(frame.Z)]
        equal = np.flatnonzero(hull.equal)
        equal = equal[polyhedra.independent(G[equal], g[equal])]
        labels: tuple[str, ...] = ()
        if self.labels:
            binding = geometry.binding_rows(*self.half_spaces())
            names = [self.labels[i] for i in binding]
            labels = tuple(names[i] for i in (*equal, *equal, *rows))
        H = np.vstack([G[equal], -G[equal], G[rows]])
        return Polytope(H, np.concatenate([g[equal], -g[equal], g[rows]]), labels)

    def vertices(self) -> np.ndarray:
        """Return the vertices (k, n), none of an empty set; counter-clockwise in 2-D, ascending in
        1-D.

        The vertex dual to the facet {y : v'y = 1} of the hull described in `reduce` is
        c + v. Raises ValueError if the set is unbounded.
        """
        hull = self._hull()
        if hull is None:
            return np.zeros((0, self.dimension))
        if not hull.basis.shape[1]:
            return hull.shift[None]
        frame = framed("Polytope", hull.G, hull.g)
        if not frame.bounded:
            fail("Polytope", "is unbounded: it is no hull of vertices", "Intersect it with a Box")
        return hull.shift + frame.vertices() @ hull.basis.T

    def volume(self) -> float:
        """Return the length, area or volume, of a product of sets factor by factor: 0 if the set
        is flat or empty, inf if it is unbounded with volume."""
        hull = self._hull()
        if hull is None or hull.basis.shape[1] < self.dimension:
            return 0.0
        frame = framed("Polytope", hull.G, hull.g)
        if not frame.bounded:
            return np.inf
        Z = frame.Z[geometry.irredundant(frame.Z)]
        parts, S = geometry.factors(Z)
        if len(parts) == 1:
            return geometry.hull_volume(self.vertices())
        volumes = [Polytope(part, np.ones(len(part))).volume() for _, part in parts]
        return float(np.prod(volumes) * np.prod(frame.scale) / abs(np.linalg.det(S)))

    def _hull(self) -> AffineHull | None:
        """Return the affine hull and the set in its coordinates; None if it is empty."""
        try:
            return polyhedra.full_part(*self.unit_rows())
        except Empty:
            return None

    def _keeps(self, rows: np.ndarray, offsets: np.ndarray, tolerance: float) -> bool:
        program = Program(*self.unit_rows())
        reach = extent(program.G, program.g)
        reach[np.isinf(reach)] = 0.0
        allowed = tolerance * (np.abs(offsets) + np.abs(rows) @ reach)
        return all(
            program.bound(row, program.maximise(row), reach) <= most
            for row, most in zip(rows, offsets + allowed, strict=True)
        )

    def _require_fields(self, argument: str, dimension: int | None = None) -> None:
        require_matching(argument, {"H": self.H, "h": self.h}, 2, dimension)
        cure = 'Write it as ("q <= 1", "q >= -1")'
        require_names(f"{argument}.labels", self.labels, np.shape(as_array(self.h))[0], cure)


@pytree
class Box(LinearSet):
    """{x in R^n : lower <= x <= upper}, elementwise.

    Arguments:
        lower, upper: (n,) arrays, in the units of x; -inf and inf for no bound. A number beside an
            array stands for all its coordinates; two numbers are an interval, n = 1, and in an
            `MPC` the bounds of every coordinate. There, and there alone, (N, n) are the bounds of
            each of N stages.

    lower > upper in a coordinate makes it the empty set. All methods but `contains`, `support`,
    `tightened` and `rows` run in NumPy, not traceable.
    """

    lower: Reals
    upper: Reals

    def __post_init__(self) -> None:
        store_floats(self, "lower", "upper")
        axes = dimensions(self.lower), dimensions(self.upper)
        if axes in ((0, 1), (1, 0), (0, 2), (2, 0)):
            one, other = ("lower", "upper") if axes[0] == 0 else ("upper", "lower")
            fill(self, one, np.shape(as_array(getattr(self, other)))[-1:])
        self._require_given(lower=1, upper=1)

    def spread(self, n: int) -> "Box":
        """Return the box with two numbers as the bounds of each of n coordinates; any other box
        unchanged."""
        if (dimensions(self.lower), dimensions(self.upper)) != (0, 0):
            return self
        box = Box(self.lower, self.upper)
        for name in ("lower", "upper"):
            fill(box, name, (n,))
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
        empty = _misses(lower, upper)
        if empty.any():
            i = int(np.argmax(empty))
            cure = "Give lower <= upper: all lower ends, then all upper ones, -inf or inf for none"
            ends = [f"{v:g}" for v in (lower[i], upper[i])]
            if ends[0] == ends[1]:  # apart by rounding
                ends = [repr(float(v)) for v in (lower[i], upper[i])]
            fail(argument, f"is empty: lower[{i}] = {ends[0]}, upper[{i}] = {ends[1]}", cure)

    def is_empty(self) -> bool:
        """Return whether lower > upper in a coordinate."""
        return bool(_misses(*self._ends()).any())

    def is_bounded(self) -> bool:
        """Return whether all bounds are finite; an empty box is bounded."""
        lower, upper = self._ends()
        return bool(np.isfinite([lower, upper]).all() or _misses(lower, upper).any())

    def affine_dimension(self) -> int:
        """Return how many coordinates have lower < upper; -1 for the empty box."""
        lower, upper = self._ends()
        return -1 if _misses(lower, upper).any() else int((lower < upper).sum())

    def contains(self, x: Reals, tolerance: float = 0.0) -> AnyTruth:
        """Return whether lower - tolerance <= x <= upper + tolerance, for a point x (n,) or for
        each of many (k, n)."""
        self = self.spread(1)
        self._require_fields("Box")
        x, _ = one_or_many("x", x, self.dimension)
        xp, (x, lower, upper, tolerance) = numbers(x, self.lower, self.upper, tolerance)
        if xp is np:
            self._ends()  # refuses NaN
        return xp.all((lower - tolerance <= x) & (x <= upper + tolerance), axis=-1)

    def support(self, d: Reals) -> AnyNumber:
        """Return max d'x over the box for one direction d (n,), or each of many (k, n); inf where
        the box is unbounded along d. ValueError if it is empty and can be read."""
        self = self.spread(1)
        self._require_fields("Box")
        d, many = one_or_many("d", d, self.dimension)
        xp, (along, lower, upper) = numbers(d, self.lower, self.upper)
        if xp is np and _misses(*self._ends()).any():
            self.validate("Box")
        # The maximiser, with 0 where d is 0: there 0 * inf would be NaN.
        best = xp.where(along > 0, upper, xp.where(along < 0, lower, 0))
        return xp.sum(along * best, axis=-1) if many else along @ best

    def tightened(self, fraction: float | jax.Array) -> "Box":
        """Return the box with its two-sided coordinates narrowed on each side by a fraction of
        their half-width. Traceable."""
        _, (lower, upper) = numbers(self.lower, self.upper)
        by = fraction * self._half_ranges()
        return Box(lower + by, upper - by)

    def half_widths(self) -> AnyArray:
        """Return half the distance between the two ends of each coordinate, (n,); 1 where an end
        is infinite or both coincide. It is the unit of weights and tolerances. Traceable."""
        half = self.spread(1)._half_ranges()
        xp, _ = numbers(half)
        return xp.where(half > 0, half, 1.0)

    def _half_ranges(self) -> AnyArray:
        """Return half the distance between the two ends, 0 where one is infinite."""
        xp, (lower, upper) = numbers(self.lower, self.upper)
        # Infinite ends have no derivative, not NaN.
        finite = xp.isfinite(lower) & xp.isfinite(upper)
        low, high = (xp.where(finite, end, 0.0) for end in (lower, upper))
        return (high - low) / 2

    def rows(self) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Return (H, lower, upper) of the two-sided rows lower <= H x <= upper; H is the
        identity."""
        self = self.spread(1)
        lower, upper = as_floats(self.lower), as_floats(self.upper)
        return np.eye(self.dimension, dtype=lower.dtype), lower, upper

    def half_spaces(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (H, h) of the rows H x <= h of finite bounds; 0'x <= -1 if the box is empty."""
        lower, upper = self._ends()
        if _misses(lower, upper).any():
            return Polytope.empty(len(lower)).half_spaces()
        identity = np.eye(len(lower))
        above, below = np.isfinite(upper), np.isfinite(lower)
        rows = np.vstack([identity[above], -identity[below]])
        return rows, np.concatenate([upper[above], -lower[below]])

    def to_zonotope(self) -> "Zonotope":
        """Return a bounded box as a Zonotope, one generator a coordinate of positive width."""
        lower, upper = self._finite_bounds()
        half = (upper - lower) / 2
        return Zonotope(lower + half, np.diag(half)[:, half > 0])

    def bounding_box(self) -> "Box":
        """Return the box itself."""
        return self.spread(1)

    def intersect(self, other: LinearSet) -> LinearSet:
        """Return the points in both sets: a Box with a Box (perhaps empty), else a Polytope."""
        self = self.spread(other.dimension) if isinstance(other, LinearSet) else self
        if not isinstance(other, Box):
            return self.to_polytope().intersect(other)
        other = other.spread(self.dimension)
        lower, upper = self._ends()
        other._require_fields("other", len(lower))
        lower_too, upper_too = other._ends()
        return Box(np.maximum(lower, lower_too), np.minimum(upper, upper_too))

    def minkowski_sum(self, other: LinearSet | Reals) -> LinearSet:
        """Return {x + w : x in the box, w in other}: a Box with a Box or a point (1, n), a Zonotope
        with a Zonotope if the box is bounded, else a Polytope."""
        if isinstance(other, Box):
            other = other.spread(self.dimension)
            other._require_fields("other", self.dimension)
            if self.is_empty() or other.is_empty():
                return _empty_box(self.dimension)
            (lower, upper), (lower_too, upper_too) = self._ends(), other._ends()
            return Box(lower + lower_too, upper + upper_too)
        if isinstance(other, Zonotope) and self.is_bounded() and not self.is_empty():
            other._require_fields("other", self.dimension)
            return other.minkowski_sum(self)
        if not isinstance(other, ConvexSet):
            corners = points("other", other, self.dimension)
            if len(corners) == 1:
                return self.translate(corners[0])
        return self.to_polytope().minkowski_sum(other)

    def pontryagin_difference(self, other: ConvexSet | Reals) -> "Box":
        """Return {x : x + w in the box for all w in other}, perhaps empty; other: any set, or
        points (k, n), which stand for their convex hull."""
        n = self.dimension
        if isinstance(other, ConvexSet):
            other = other.spread(n) if isinstance(other, LinearSet) else other
            other.validate("other", n)
            high, low = other.support(np.eye(n)), -np.asarray(other.support(-np.eye(n)))
        else:
            corners = points("other", other, n)
            high, low = corners.max(axis=0), corners.min(axis=0)
        lower, upper = self._ends()
        # No bound stays none, whatever the other set.
        free_below, free_above = lower == -np.inf, upper == np.inf
        with np.errstate(invalid="ignore"):
            below = np.where(free_below, lower, lower - low)
            above = np.where(free_above, upper, upper - high)
            # Sides that pass each other by the rounding of these differences are one.
            gap, terms = below - above, abs(lower) + abs(low) + abs(upper) + abs(high)
            middle = (below + above) / 2
        one = (gap > 0) & (cleaned(gap, terms) == 0)
        return Box(np.where(one, middle, below), np.where(one, middle, above))

    def image(self, M: Reals, t: Reals | None = None) -> "Zonotope | Polytope":
        """Return {M x + t : x in the box}, M any matrix (k, n): a Zonotope if the box is bounded,
        exact in any dimension, else a Polytope."""
        if self.is_bounded() and not self.is_empty():
            return self.to_zonotope().image(M, t)
        return self.to_polytope().image(M, t)

    def translate(self, by: Reals) -> "Box":
        """Return {x + by : x in the box}, by (n,)."""
        lower, upper = self._ends()
        by = vector("by", by, len(lower))
        return Box(lower + by, upper + by)

    def _times(self, factor: float) -> "Box":
        lower, upper = self._ends()
        if self.is_empty():
            return Box(lower, upper)
        if factor == 0:
            return Box(np.zeros(len(lower)), np.zeros(len(lower)))
        ends = (lower, upper) if factor > 0 else (upper, lower)
        return Box(factor * ends[0], factor * ends[1])

    def project(self, axes: Sequence[int]) -> "Box":
        """Return the box of (x_i for i in axes)."""
        lower, upper = self._ends()
        axes = chosen_axes(axes, len(lower))
        if _misses(lower, upper).any():
            return _empty_box(len(axes))
        return Box(lower[axes], upper[axes])

    def slice(self, values: Mapping[int, float]) -> "Box":
        """Return the section with some coordinates fixed, {axis: value, ...}, in the others; it is
        empty where a value is out of its bounds."""
        lower, upper = self._ends()
        fixed, at, rest = section(values, len(lower))
        # To rounding of each difference by itself: 1e20 may stand for no bound at the other end.
        outside = [
            cleaned(sign * (end - at), abs(at) + np.where(np.isfinite(end), abs(end), 0.0)) > 0
            for sign, end in ((1, lower[fixed]), (-1, upper[fixed]))
        ]
        if np.any(outside) or _misses(lower, upper).any():
            return _empty_box(len(rest))
        return Box(lower[rest], upper[rest])

    def cartesian_product(self, other: LinearSet) -> LinearSet:
        """Return {(x, y) : x in the box, y in other}: a Box with a Box, else a Polytope."""
        if not isinstance(other, Box):
            return self.to_polytope().cartesian_product(other)
        (lower, upper), (lower_too, upper_too) = self._ends(), other._ends()
        return Box(np.append(lower, lower_too), np.append(upper, upper_too))

    def chebyshev(self) -> tuple[np.ndarray, float]:
        """Return (center, radius) of the largest ball inside: that in the middle, where the box is
        bounded. Raises ValueError if it is empty, or holds balls of every radius."""
        lower, upper = self._ends()
        if not self.is_bounded() or self.is_empty():
            return super().chebyshev()
        return (lower + upper) / 2, float((upper - lower).min() / 2)

    def sample(self, count: int, seed: int = 0) -> np.ndarray:
        """Return points (count, n) uniformly distributed over the box; the same ones for the same
        seed. ValueError if it is empty or unbounded."""
        lower, upper = self._finite_bounds()
        random = generator(seed)
        return random.uniform(lower, upper, (sample_size(count), len(lower)))

    def vertices(self) -> np.ndarray:
        """Return the corners (k, n), counter-clockwise in 2-D, 2^n of a box with volume, none of an
        empty one; ValueError if it is unbounded."""
        lower, upper = self._ends()
        if self.is_empty():
            return np.zeros((0, len(lower)))
        lower, upper = self._finite_bounds()
        if 2.0 ** (lower < upper).sum() > _MOST_VERTICES:
            problem = f"has 2^{(lower < upper).sum()} vertices, too many to list"
            fail("Box", problem, "Use support, or lower and upper")
        ends = [np.unique(pair) for pair in zip(lower, upper, strict=True)]
        corners = np.array(list(itertools.product(*ends)))
        return corners[[0, 2, 3, 1]] if corners.shape == (4, 2) else corners

    def volume(self) -> float:
        """Return the length, area or volume: 0 if the box is flat or empty, else inf if it is
        unbounded."""
        lower, upper = self._ends()
        if self.is_empty() or np.any(lower == upper):
            return 0.0
        return float(np.prod(upper - lower))

    def _closest(self, x: np.ndarray) -> np.ndarray:
        return np.clip(x, *self._ends())

    def _require_fields(self, argument: str, dimension: int | None = None) -> None:
        require_matching(argument, {"lower": self.lower, "upper": self.upper}, 1, dimension)

    def bounds(self, argument: str = "Box") -> tuple[np.ndarray, np.ndarray]:
        """Return copies of (lower, upper) in float64. NumPy; not traceable."""
        lower = host_array(f"{argument}.lower", self.lower)
        return lower, host_array(f"{argument}.upper", self.upper)

    def _ends(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (lower, upper) in float64, checked but for emptiness."""
        self = self.spread(1)
        self._require_fields("Box")
        lower, upper = self.bounds()
        if np.isnan([lower, upper]).any():
            self.validate("Box")
        return lower, upper

    def _finite_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        self = self.spread(1)
        self.validate("Box")
        lower, upper = self.bounds()
        if not np.isfinite([lower, upper]).all():
            fail("Box", "is unbounded", "Give finite bounds in every coordinate")
        return lower, upper


def _empty_box(n: int) -> Box:
    """Return an empty set in R^n as a Box."""
    return Box(np.full(n, np.inf), np.full(n, -np.inf))


def _misses(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return in which coordinates no number lies between two bounds."""
    return (lower > upper) | (lower == np.inf) | (upper == -np.inf)


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
        self._require_given(center=1, generators=2)

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
        self.validate("Zonotope")
        d, _ = one_or_many("d", d, self.dimension)
        xp, (along, center, G) = numbers(d, self.center, self.generators)
        return product(xp, along, center) + xp.abs(product(xp, along, G)).sum(axis=-1)

    def contains(self, x: Reals, tolerance: float = 0.0) -> AnyTruth:
        """Return whether a point x (n,), or each of many (k, n), lies within `tolerance` of the
        zonotope in each coordinate.

        By one LP a point. A point counts as inside up to 1e-10 of the half-widths.
        """
        center, G = self._values()
        x, many = one_or_many("x", x, self.dimension)
        values = host_array("x", x)
        number("tolerance", tolerance, 0.0, "Give a distance, or 0")
        near = [generators.holds(center, G, v, tolerance) for v in np.atleast_2d(values)]
        return np.array(near, bool) if many else np.bool(near[0])

    def is_empty(self) -> bool:
        """Return False: it holds its center."""
        self._values()
        return False

    def is_bounded(self) -> bool:
        """Return True."""
        self._values()
        return True

    def affine_dimension(self) -> int:
        """Return the rank of the generators."""
        return generators.span(self._values()[1])[1].shape[1]

    def minkowski_sum(self, other: LinearSet | Reals) -> "Zonotope | Polytope":
        """Return {x + w : x in the set, w in other}: a Zonotope with a Zonotope, a bounded Box or a
        point (1, n); a Polytope with a Polytope or with points (k, n), which stand for their convex
        hull."""
        n = self.dimension
        center, G = self._values()
        if isinstance(other, LinearSet):
            other = other.spread(n)
            other._require_fields("other", n)
        other = _by_generators(other)
        if isinstance(other, Zonotope):
            center_too, G_too = other._values()
            return Zonotope(center + center_too, np.hstack([G, G_too]))
        if not isinstance(other, ConvexSet):
            corners = points("other", other, n)
            if len(corners) == 1:
                return Zonotope(center + corners[0], G)
        _require_summand(self, other)
        return self.to_polytope().minkowski_sum(other)

    def image(self, M: Reals, t: Reals | None = None) -> "Zonotope":
        """Return {M x + t : x in the set}, with any matrix M (k, n); t (k,), or None for 0."""
        center, G = self._values()
        M, t = affine_map(M, t, (None, len(center)))
        return Zonotope(M @ center + t, M @ G)

    def project(self, axes: Sequence[int]) -> "Zonotope":
        """Return the set of (x_i for i in axes) over all x in the set."""
        center, G = self._values()
        axes = chosen_axes(axes, len(center))
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
        d = np.vstack([*parts, N.T])
        # In units in which the set is about 1 wide: elsewhere small entries may be no rounding.
        d = cleaned(d, np.abs(d).max(axis=1, keepdims=True, initial=0.0)) / unit
        d = d / np.linalg.norm(d, axis=1)[:, None]
        middle, half = d @ center, np.abs(d @ G).sum(axis=1)
        half[len(d) - N.shape[1] :] = 0.0
        return np.vstack([d, -d]) + 0.0, np.concatenate([middle + half, half - middle])

    def cartesian_product(self, other: LinearSet) -> LinearSet:
        """Return {(x, y) : x in the set, y in other}: a Zonotope with a Zonotope or a bounded Box,
        else a Polytope."""
        other = _by_generators(other)
        if not isinstance(other, Zonotope):
            return self.to_polytope().cartesian_product(other)
        (center, G), (center_too, G_too) = self._values(), other._values()
        return Zonotope(np.append(center, center_too), scipy.linalg.block_diag(G, G_too))

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

    def _closest(self, x: np.ndarray) -> np.ndarray:
        center, G = self._values()
        if not G.any():
            return center
        size = np.abs(G).max()
        found = scipy.optimize.lsq_linear(G / size, (x - center) / size, (-1, 1), "bvls", tol=1e-15)
        return center + G @ found.x

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


def _by_generators(value: Any) -> Any:
    """Return a bounded Box that is not empty as a Zonotope, anything else as it is."""
    bounded = isinstance(value, Box) and value.is_bounded() and not value.is_empty()
    return value.to_zonotope() if bounded else value


def _require_summand(set_: ConvexSet, other: Any) -> None:
    """Raise for an Ellipsoid in a Minkowski sum with a set of linear inequalities."""
    if isinstance(other, ConvexSet) and not isinstance(other, LinearSet):
        problem = f"is an {type(other).__name__}: its sum with a {type(set_).__name__} is neither"
        fail("other", problem, "Add their supports, or give bounding_box() for an outer set")


def _corners(other: LinearSet | Reals, n: int) -> np.ndarray | None:
    """Return the points of which a set, or points (k, n), is the hull; None where it is unbounded
    or has too many."""
    return _vertices_of(other) if isinstance(other, LinearSet) else points("other", other, n)


def _combinations(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, Polytope]:
    """Return (D, shift, W) with {D w + shift : w in W} = the hull of points (k, n): weights w >= 0
    of all points but the last with a sum <= 1, the last gets the rest."""
    k = len(corners) - 1
    W = Polytope(np.vstack([-np.eye(k), np.ones((1, k))]), np.r_[np.zeros(k), 1.0])
    return (corners[:-1] - corners[-1]).T, corners[-1], W


def _vertices_of(set_: LinearSet) -> np.ndarray | None:
    """Return the vertices of a set; None where it is unbounded or has too many."""
    try:
        return set_.vertices()
    except ValueError:
        return None


def as_polytope(argument: str, value: object, n: int | None = None) -> Polytope:
    """Return a Box, Polytope or Zonotope as a Polytope; with n, checked to be a set in R^n.

    Raises ValueError, naming `argument`, for anything else.
    """
    if not isinstance(value, LinearSet):
        fail(argument, f"{type(value).__name__} is no Box or Polytope", "Give one")
    if n is not None:
        value = value.spread(n)
        value.validate(argument, n)
    return value if isinstance(value, Polytope) else Polytope(*value.half_spaces())
