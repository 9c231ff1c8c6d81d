"""Convex sets: boxes and polytopes.

`contains` and `Box.support` are JAX functions of one point (map them with `jax.vmap`).
Everything that needs an LP (HiGHS) or a convex hull (qhull) runs on the host, in float64,
and raises ValueError for sets that are empty, flat or unbounded where those make no sense.
"""

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection, KDTree, QhullError

from jaxmpc.checks import concrete, fail, require_finite, require_shape
from jaxmpc.control.system import as_array, host_array

# A set is called empty or flat if no ball of this radius fits, relative to the median
# distance of its hyperplanes from the origin; well above HiGHS' own tolerance of 1e-10.
_FLAT = 1e-9
_MERGE = "C-1e-12"  # qhull's option: merge facets of the dual that are flat to 1e-12
_HULL_DIMENSIONS = 6  # above, a hull has too many facets and one LP per row is faster


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Box:
    """{x in R^n : lower <= x <= upper}, elementwise.

    Arguments:
        lower, upper: (n,) arrays, in the units of x; -inf and inf for no bound.
    """

    lower: ArrayLike
    upper: ArrayLike

    @property
    def dimension(self) -> int:
        """n, the number of coordinates."""
        return np.shape(as_array(self.lower))[-1]

    def validate(self, argument: str, dimension: int | None = None) -> None:
        """Raise ValueError, naming `argument`, for wrong shapes, NaN or an empty box."""
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

    def contains(self, x: ArrayLike, tolerance: float = 0.0) -> jax.Array:
        """True if lower - tolerance <= x <= upper + tolerance, x of shape (n,)."""
        _require_shapes("Box", self, ("lower", "upper"), 1)
        require_shape("x", x, (self.dimension,), "Give one point; use jax.vmap for many")
        x, lower, upper = jnp.asarray(x), jnp.asarray(self.lower), jnp.asarray(self.upper)
        return jnp.all((lower - tolerance <= x) & (x <= upper + tolerance))

    def support(self, d: ArrayLike) -> jax.Array:
        """max d'x over the box, d of shape (n,); inf where the box is unbounded along d."""
        _require_shapes("Box", self, ("lower", "upper"), 1)
        require_shape("d", d, (self.dimension,), "Give one direction; use jax.vmap for many")
        d, lower, upper = jnp.asarray(d), jnp.asarray(self.lower), jnp.asarray(self.upper)
        # The maximiser, with 0 where d is 0: there 0 * inf would be NaN.
        return d @ jnp.where(d > 0, upper, jnp.where(d < 0, lower, 0))

    def rows(self) -> tuple[ArrayLike, ArrayLike, ArrayLike]:
        """(H, lower, upper) of the two-sided rows lower <= H x <= upper; H is the identity."""
        lower, upper = _as_floats(self.lower), _as_floats(self.upper)
        return np.eye(self.dimension, dtype=lower.dtype), lower, upper

    def to_polytope(self) -> "Polytope":
        """The same set as H x <= h, infinite bounds dropped. Host."""
        lower, upper = self._bounds()
        identity = np.eye(len(lower))
        above, below = np.isfinite(upper), np.isfinite(lower)
        return Polytope(
            np.vstack([identity[above], -identity[below]]),
            np.concatenate([upper[above], -lower[below]]),
        )

    def vertices(self) -> np.ndarray:
        """(2^n, n) corners; counter-clockwise in 2-D. Host; ValueError if unbounded."""
        lower, upper = self._finite_bounds()
        corners = np.array(list(itertools.product(*zip(lower, upper, strict=True))))
        return corners[[0, 2, 3, 1]] if len(lower) == 2 else corners

    def volume(self) -> float:
        """Length, area or volume. Host; ValueError if unbounded."""
        lower, upper = self._finite_bounds()
        return float(np.prod(upper - lower))

    def _bounds(self) -> tuple[np.ndarray, np.ndarray]:
        self.validate("Box")
        return host_array("Box.lower", self.lower), host_array("Box.upper", self.upper)

    def _finite_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        lower, upper = self._bounds()
        if not np.isfinite([lower, upper]).all():
            fail("Box", "is unbounded", "Give finite bounds in every coordinate")
        return lower, upper


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Polytope:
    """{x in R^n : H x <= h}.

    Arguments:
        H: (rows, n) outward normals, of any length.
        h: (rows,) offsets; inf for a row that does not bind.
    """

    H: ArrayLike
    h: ArrayLike

    @classmethod
    def from_points(cls, points: ArrayLike) -> "Polytope":
        """The convex hull of `points` (k, n), one unit outward normal per facet. Host.

        Raises ValueError if the points are not finite or lie in a hyperplane.
        """
        points = host_array("points", points)
        if points.ndim != 2 or not points.size:
            fail("points", f"shape {points.shape} is not (k, n)", "Give one row per point")
        require_finite("points", points)
        centre = points.mean(axis=0)
        scale = np.abs(points - centre).max(axis=0)
        scaled = (points - centre) / np.where(scale > 0, scale, 1.0)
        if np.linalg.matrix_rank(scaled, rtol=_FLAT) < points.shape[1]:
            fail("points", "lie in a hyperplane", "Give points that span a set with volume")
        if points.shape[1] == 1:
            return cls(np.array([[1.0], [-1.0]]), np.array([points.max(), -points.min()]))
        # qhull's facets are simplices: a facet with more corners comes several times.
        with _explained("points"):
            facets = ConvexHull(scaled).equations
        facets = facets[_distinct(facets, 1e-10)]
        normals, offsets = facets[:, :-1] / scale, -facets[:, -1]
        return cls(*unit_rows(normals, offsets + normals @ centre))

    @property
    def dimension(self) -> int:
        """n, the number of coordinates."""
        return np.shape(as_array(self.H))[-1]

    def validate(self, argument: str, dimension: int | None = None) -> None:
        """Raise ValueError, naming `argument`, for wrong shapes, NaN or an empty set.

        Emptiness is decided by one LP, with a relative tolerance of 1e-9.
        """
        _require_shapes(argument, self, ("H", "h"), 2, dimension)
        if concrete((self.H, self.h)):
            _largest_ball(argument, *unit_rows(self.H, self.h, argument))

    def is_empty(self) -> bool:
        """True if no point satisfies all rows, by one LP (relative tolerance 1e-10). Host."""
        H, h = host_array("H", self.H), host_array("h", self.h)
        if np.any((h == -np.inf) | (~H.any(axis=1) & (h < 0))):
            return True
        return maximise(np.zeros(self.dimension), *unit_rows(H, h)).value == -np.inf

    def contains(self, x: ArrayLike, tolerance: float = 0.0) -> jax.Array:
        """True if H x <= h + tolerance (in the scale of each row), x of shape (n,)."""
        _require_shapes("Polytope", self, ("H", "h"), 2)
        require_shape("x", x, (self.dimension,), "Give one point; use jax.vmap for many")
        H, h, x = jnp.asarray(self.H), jnp.asarray(self.h), jnp.asarray(x)
        return jnp.all(jnp.matmul(H, x, precision="highest") <= h + tolerance)

    def support(self, d: ArrayLike) -> float:
        """max d'x over the set by one LP; inf if unbounded along d, error if empty. Host."""
        G, g = self._rows()
        d = host_array("d", d)
        require_shape("d", d, (self.dimension,), "Give one direction")
        require_finite("d", d)
        value = maximise(d, G, g).value
        if value == -np.inf:
            fail("Polytope", "is empty: no point satisfies all its rows", "Loosen its rows")
        return value

    def rows(self) -> tuple[ArrayLike, ArrayLike, ArrayLike]:
        """(H, lower, upper) of the two-sided rows lower <= H x <= upper; lower is -inf."""
        H, h = _as_floats(self.H), _as_floats(self.h)
        return H, np.full(np.shape(h), -np.inf, dtype=h.dtype), h

    def chebyshev(self) -> tuple[np.ndarray, float]:
        """(centre, radius) of the largest ball inside, by one LP. Host.

        The radius of a flat set is 0. Raises ValueError if the set is empty, or holds balls
        of every radius.
        """
        centre, radius, _ = _largest_ball("Polytope", *self._rows())
        if radius == np.inf:
            fail("Polytope", "is unbounded: it holds arbitrarily large balls", "Add rows")
        return centre, max(radius, 0.0)

    def intersect(self, other: "Box | Polytope") -> "Polytope":
        """The points in both sets: the rows of both, not reduced. Host."""
        if not isinstance(other, Box | Polytope):
            fail("other", f"{type(other).__name__} is no Box or Polytope", "Give one")
        other = other.to_polytope() if isinstance(other, Box) else other
        for argument, part in (("Polytope", self), ("other", other)):
            _require_shapes(argument, part, ("H", "h"), 2, self.dimension)
        H = [host_array("H", part.H) for part in (self, other)]
        h = [host_array("h", part.h) for part in (self, other)]
        return Polytope(np.vstack(H), np.concatenate(h))

    def reduce(self) -> "Polytope":
        """The same set with the fewest rows, each of norm 1. Host.

        Rows that cut off less than about 1e-12 of the set's size (near-duplicates, rows
        that touch a vertex) are dropped. Raises ValueError if the set is empty, flat or
        unbounded.

        Method: about an interior point c the row a'x <= b reads y'(x - c) <= 1 with
        y = a / (b - a'c), and it is irredundant exactly if y is a vertex of the convex hull
        of all the y (polarity; Ziegler 1995, section 2.3). In more than six dimensions:
        one LP per row.
        """
        G, g = self._rows()
        Y, _, scale = self._dual(G, g)
        if self.dimension == 1:
            keep = np.array([np.argmax(Y[:, 0]), np.argmin(Y[:, 0])])
        elif self.dimension <= _HULL_DIMENSIONS:
            keep = np.unique(np.concatenate(_dual_hull(Y * scale).dual_facets))
        else:
            keep = _irredundant(Y * scale)
        return Polytope(G[keep], g[keep])

    def vertices(self) -> np.ndarray:
        """(k, n) vertices; counter-clockwise in 2-D, ascending in 1-D. Host.

        The vertex dual to the facet {y : v'y = 1} of the hull described in `reduce` is
        c + v. Raises ValueError if the set is empty, flat or unbounded.
        """
        Y, centre, scale = self._dual(*self.reduce()._rows())
        if self.dimension == 1:
            return np.sort(centre + 1 / Y, axis=0)
        V = _dual_hull(Y * scale).intersections
        V = V[_distinct(V / np.abs(V).max(axis=0), 1e-10)]
        if self.dimension == 2:
            V = V[np.argsort(np.arctan2(V[:, 1], V[:, 0]))]
        return centre + V * scale

    def volume(self) -> float:
        """Length, area or volume. Host; ValueError if empty, flat or unbounded."""
        return hull_volume(self.vertices())

    def _rows(self) -> tuple[np.ndarray, np.ndarray]:
        _require_shapes("Polytope", self, ("H", "h"), 2)
        return unit_rows(self.H, self.h)

    @staticmethod
    def _dual(G: np.ndarray, g: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Y, centre, scale: G x <= g is Y (x - centre) <= 1, and Y * scale has entries <= 1."""
        cure = "Check the rows: this needs a bounded set with volume"
        centre, radius, size = _largest_ball("Polytope", G, g)
        if not _positively_spanning(G):
            fail("Polytope", "is unbounded", cure)
        if radius <= _FLAT * size:
            fail("Polytope", f"is flat (largest ball of radius {radius:.1e})", cure)
        Y = G / (g - G @ centre)[:, None]
        return Y, centre, 1 / np.abs(Y).max(axis=0)


def hull_volume(points: ArrayLike) -> float:
    """Volume of the convex hull of points (k, n): 0 where they lie in a hyperplane. Host."""
    points = host_array("points", points)
    if len(points) <= points.shape[1]:
        return 0.0
    # qhull works best in coordinates of like size.
    scale = np.ptp(points, axis=0)
    if not scale.all():
        return 0.0
    if len(scale) == 1:
        return float(scale[0])
    scaled = (points - points.mean(axis=0)) / scale
    # Clusters confuse qhull; one point of each spans a hull that is no larger.
    try:
        hull = ConvexHull(scaled[_distinct(scaled, 1e-11)])
    except QhullError:  # flat
        return 0.0
    return float(hull.volume * np.prod(scale))


class Optimum(NamedTuple):
    """An LP's maximum, where it is attained (n,), and the multipliers (rows,)."""

    value: float
    x: np.ndarray | None = None
    y: np.ndarray | None = None


def maximise(d: np.ndarray, G: np.ndarray, g: np.ndarray) -> Optimum:
    """max d'x over G x <= g: value inf (x and y None) if unbounded, -inf if empty.

    The multipliers y >= 0 obey G'y = d and g'y = value up to rounding. Rows of G should
    have norms of about 1. Dual simplex (HiGHS): a vertex, in float64, on the host.
    """
    # HiGHS' tolerances are absolute, hence the scaling of g and d.
    size, length = _typical(g), np.linalg.norm(d) or 1.0
    result = linprog(
        -d / length,
        A_ub=G,
        b_ub=g / size,
        bounds=(None, None),
        method="highs-ds",
        options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
    )
    if result.status == 0:
        x = result.x * size
        return Optimum(float(d @ x), x, np.maximum(-result.ineqlin.marginals, 0.0) * length)
    if result.status not in (2, 3):
        fail("LP", f"HiGHS stopped: {result.message}", "Scale the rows to like size")
    return Optimum(-np.inf if result.status == 2 else np.inf)


def _typical(g: np.ndarray) -> float:
    """The median distance of the hyperplanes from the origin, 1 if all pass through it."""
    distances = np.abs(g)
    # Below that they are zeros with rounding.
    distances = distances[distances > 1e-13 * distances.max(initial=0.0)]
    return float(np.median(distances)) if distances.size else 1.0


def _largest_ball(argument: str, G: np.ndarray, g: np.ndarray) -> tuple[np.ndarray, float, float]:
    """(centre, radius, typical size) of {G x <= g} with unit rows; ValueError if empty.

    The LP max r subject to G x + r <= g (Boyd & Vandenberghe 2004, section 4.3.1), with r
    of either sign so that it is always feasible. Radius inf if it is unbounded.
    """
    size, n = _typical(g), G.shape[1]
    top = maximise(np.eye(n + 1)[n], np.column_stack([G, np.ones(len(g))]), g)
    if top.x is None:
        return np.zeros(n), np.inf, size
    centre = top.x[:n]
    radius = float((g - G @ centre).min())
    if radius < -_FLAT * size:
        fail(argument, "is empty: no point satisfies all its rows", "Loosen its rows")
    return centre, radius, size


def _positively_spanning(G: np.ndarray) -> bool:
    """True if {G x <= g} is bounded: G'y = 0 for some y > 0 and rank G = n (Stiemke)."""
    if len(G) <= G.shape[1] or np.linalg.matrix_rank(G) < G.shape[1]:
        return False
    zero = np.zeros(G.shape[1])
    return linprog(np.zeros(len(G)), A_eq=G.T, b_eq=zero, bounds=(1, None)).status == 0


def unit_rows(H: Any, h: Any, argument: str = "Polytope") -> tuple[np.ndarray, np.ndarray]:
    """The rows of H x <= h that can bind, scaled to norm 1, in float64."""
    H, h = host_array(f"{argument}.H", H), host_array(f"{argument}.h", h)
    require_finite(f"{argument}.H", H)
    if np.isnan(h).any():
        fail(f"{argument}.h", "holds NaN", "Use inf for a row that does not bind")
    length = np.linalg.norm(H, axis=1)
    if np.any((h == -np.inf) | ((length == 0) & (h < 0))):
        fail(argument, "is empty: a row reads 0'x <= h < 0 or has h = -inf", "Remove that row")
    binding = (length > 0) & (h < np.inf)
    length = length[binding]
    return H[binding] / length[:, None], h[binding] / length


def _dual_hull(Y: np.ndarray) -> HalfspaceIntersection:
    """Vertices of {Y x <= 1}, and the rows that meet in each: a convex hull of Y (qhull)."""
    halfspaces = np.column_stack([Y, -np.ones(len(Y))])
    with _explained("Polytope"):
        return HalfspaceIntersection(halfspaces, np.zeros(Y.shape[1]), qhull_options=_MERGE)


@contextmanager
def _explained(argument: str) -> Iterator[None]:
    """qhull's errors as ours."""
    try:
        yield
    except QhullError as error:
        reason = str(error).splitlines()[0]
        fail(argument, f"too ill-conditioned for qhull ({reason})", "Rescale the coordinates")


def _irredundant(Y: np.ndarray) -> np.ndarray:
    """Indices of the rows of Y x <= 1 that the others do not imply, by one LP per row."""
    keep = np.arange(len(Y))
    for i in range(len(Y)):
        others = keep[keep != i]
        # The row itself, loosened, keeps the LP bounded.
        loosened = np.append(np.ones(len(others)), 2.0)
        top = maximise(Y[i], *unit_rows(np.vstack([Y[others], Y[i]]), loosened))
        keep = others if top.value <= 1 + 1e-10 else keep
    return keep


def _distinct(points: np.ndarray, tolerance: float) -> np.ndarray:
    """Indices of the points, one of each cluster closer than `tolerance`."""
    close = KDTree(points).query_pairs(tolerance, output_type="ndarray")
    return np.setdiff1d(np.arange(len(points)), close.max(axis=1, initial=-1))


def _as_floats(value: Any) -> Any:
    """`value` as an array that keeps its floating dtype; traced values stay traced."""
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
    if dimension is not None and shape[-1] != dimension:
        fail(
            argument,
            f"has dimension {shape[-1]} where {dimension} is needed",
            "Bound every coordinate (inf for no bound)",
        )
    require_shape(f"{argument}.{names[1]}", second, shape[:1], f"Match {names[0]}")
