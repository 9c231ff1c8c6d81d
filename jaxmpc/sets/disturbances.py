"""Sets of disturbances: checks of them, and the worst that they do along rows.

A disturbance w lies in a bounded set W that holds the origin: a Box, a Polytope, a zonotope, or any
set whose `support` is a function of JAX. What it does to a row g'w ≤ … is the support function
h_W(g) = max {g'w : w ∈ W}.
"""

from typing import Any

import jax
import numpy as np
from jax import Array

from jaxmpc.arrays import Reals, as_array, as_column, dimensions, host_array, store_floats
from jaxmpc.checks import concrete, fail, require_finite, require_kind, require_shape
from jaxmpc.pytrees import pytree
from jaxmpc.qp.linalg import matmul, namespace
from jaxmpc.sets.convex_sets import (
    AnyNumber,
    Box,
    ConvexSet,
    Polytope,
    Zonotope,
    as_polytope,
    numbers,
    product,
)
from jaxmpc.sets.lp import extent

# Vertices of a Polytope are exact to this, relative to its size.
VERTICES = 1e-9


@pytree
class Vertices(ConvexSet):
    """The convex hull of points (k, n): the form of a Polytope whose support is one product."""

    points: Reals

    def __post_init__(self) -> None:
        store_floats(self, "points")

    @property
    def dimension(self) -> int:
        """Return n, the number of coordinates."""
        return np.shape(as_array(self.points))[-1]

    def validate(self, argument: str, dimension: int | None = None) -> None:
        """Raise ValueError, naming `argument`, for wrong shapes or points that are not finite."""
        self._require_fields(argument, dimension)
        require_finite(f"{argument}.points", self.points)

    def support(self, d: Reals) -> AnyNumber:
        """Return max d'x over the points, for one direction d (n,) or for each of many (k, n)."""
        xp, (along, points) = numbers(d, self.points)
        return xp.max(product(xp, along, points.T), axis=-1)

    def vertices(self) -> np.ndarray:
        """Return the points. NumPy; not traceable."""
        return host_array("disturbance", self.points)

    def _require_fields(self, argument: str, dimension: int | None = None) -> None:
        shape = np.shape(as_array(self.points))
        if len(shape) != 2 or not all(shape) or dimension not in (None, shape[1]):
            wanted = dimension or "n"
            fail(f"{argument}.points", f"shape {shape}", f"Give points (k, {wanted})")


@pytree
class Image(ConvexSet):
    """{E w : w in W}: E (n, p), and W the set `of` the p disturbances."""

    E: Reals
    of: Any

    @property
    def dimension(self) -> int:
        """Return n, the number of coordinates."""
        return np.shape(as_array(self.E))[0]

    def validate(self, argument: str, dimension: int | None = None) -> None:
        """Raise ValueError, naming `argument`, unless E has `dimension` rows and fits the set."""
        self._require_fields(argument, dimension)
        self.of.validate(argument, np.shape(as_array(self.E))[1])

    def support(self, d: Reals) -> AnyNumber:
        """Return max d'E w over W, for one direction d (n,) or for each of many (k, n)."""
        xp, (along, E) = numbers(d, self.E)
        return self.of.support(product(xp, along, E))

    def vertices(self) -> np.ndarray:
        """Return points (k, n) whose hull it is. NumPy; not traceable."""
        return self.of.vertices() @ host_array("disturbance_matrix", self.E).T

    def _require_fields(self, argument: str, dimension: int | None = None) -> None:
        shape = np.shape(as_array(self.E))
        if len(shape) != 2 or not all(shape) or dimension not in (None, shape[0]):
            fail("disturbance_matrix", f"shape {shape}", f"Give ({dimension or 'n'}, p)")


def is_centred(W: Box | Zonotope) -> bool:
    """Return whether a set of disturbances is known to be symmetric about zero."""
    if not concrete(W):
        return False
    if isinstance(W, Box):
        return bool(np.all(np.asarray(W.lower) == -np.asarray(W.upper)))
    return not np.any(np.asarray(W.center))


def require_disturbance(argument: str, W: Any, dimension: int) -> None:
    """Raise ValueError, naming `argument`, unless W is a bounded set in R^dimension that holds the
    origin. Of a set that is traced by JAX the kind and the shapes are checked."""
    cure = "Give a Box, a Polytope or a Zonotope of w, or None"
    require_kind(argument, W, Box, Polytope, Zonotope, Vertices, Image, cure=cure)
    if concrete(W) and any(np.isnan(values).any() for values in jax.tree.leaves(W)):
        fail(argument, "holds NaN", "Give a bounded set")
    same_for_all = isinstance(W, Box) and not dimensions(W.lower)
    if W.dimension != dimension and not same_for_all:
        what = f"has dimension {W.dimension} where {dimension} is needed"
        fail(argument, what, "Give one w for each state, or x+ = ... + E w as disturbance_matrix=E")
    W.validate(argument, dimension)
    if not concrete(W):
        if isinstance(W, Polytope):
            cure = "Give a Box or a Zonotope, or make the problem outside of the trace"
            fail(argument, "is a Polytope inside a trace", cure)
        return
    if isinstance(W, Box | Polytope):
        G, g = as_polytope(argument, W, dimension).unit_rows(argument)
        bounded, held = np.isfinite(extent(G, g)).all(), np.all(g >= 0)
    else:
        identity = np.eye(dimension)
        ends = np.array([W.support(d) for d in np.concatenate([identity, -identity])])
        inside = getattr(W, "contains", None)
        bounded = np.isfinite(ends).all()
        held = ends.min() >= 0
        if bounded and inside is not None:
            held = inside(np.zeros(dimension), 1e-12 * np.abs(ends).max())
    if not bounded:
        fail(argument, "is unbounded", "Bound every coordinate")
    if not held:
        cure = "Move it by -w for a w in it, and c of x(k+1) = A x(k) + B u(k) + c by w, or by E w"
        fail(argument, "does not hold the origin", cure)


def disturbance_set(W: Any, n: int, E: Reals | None = None) -> ConvexSet | None:
    """Return the set E W in R^n of what disturbances w in W add to the state; None for None.

    E (n, p), None for the identity. Raises ValueError unless W is a bounded set that holds 0.
    """
    if W is None:
        if E is not None:
            fail("disturbance_matrix", "given without a disturbance", "Give disturbance too")
        return None
    if E is None:
        require_disturbance("disturbance", W, n)
        return W
    E = disturbance_columns(E, n)
    require_disturbance("disturbance", W, E.shape[1])
    return Image(E, W.spread(E.shape[1]) if isinstance(W, Box) else W)


def supports(W: Any, rows: np.ndarray) -> np.ndarray:
    """Return max {row w : w in W} for each row; 0 if W is None. NumPy; not traceable."""
    if W is None or not len(rows):
        return np.zeros(len(rows))
    W = W.spread(rows.shape[1]) if isinstance(W, Box) else W
    return host_array("disturbance", W.support(rows))


def largest_norm(W: Any, P: np.ndarray, shift: np.ndarray | None = None) -> float:
    """Return max sqrt(v'P v) over v = w + shift, w in W: a convex function is largest at a vertex.
    NumPy; not traceable."""
    vertices = W.vertices() + (0.0 if shift is None else shift)
    return float(np.sqrt(np.einsum("ij,jk,ik->i", vertices, P, vertices).max()))


def with_vertices(W: Any) -> Any:
    """Return a Polytope as its `Vertices`, so that its support can be traced; other sets as they
    are."""
    return Vertices(W.vertices()) if isinstance(W, Polytope) else W


def worst(W: Any, rows: Array) -> Array:
    """Return h_W(g) of each row g of `rows` (r, n). Works inside jit, vmap and grad; of NumPy's
    arrays in NumPy."""
    W = with_vertices(W)
    xp = namespace((W, rows))
    W = jax.tree.map(lambda v: xp.asarray(v, rows.dtype), W)
    if isinstance(W, Vertices):
        points: Any = W.points
        return xp.max(matmul(rows, points.T), axis=1)
    if xp is np:
        return xp.array([W.support(row) for row in rows], rows.dtype)
    return jax.vmap(W.support)(rows)


def largest_entries(W: Any, dimension: int) -> np.ndarray:
    """Return the largest |w_i| (dimension,) over W. NumPy; not traceable."""
    W, identity = with_vertices(W), np.eye(dimension)
    ends = [[W.support(d), W.support(-d)] for d in identity]
    return np.abs(host_array("disturbance", ends)).max(axis=1)


def support_error(W: Any) -> tuple[int, float]:
    """Return how many terms a support of W is a sum of, and by how much of |g|'(largest |w|) it may
    be off beside the rounding of that sum."""
    generators = getattr(W, "generators", None)
    if generators is not None:
        return sum(np.shape(as_array(generators))), 0.0
    return W.dimension, 0.0 if isinstance(W, Box) else VERTICES


def disturbance_columns(E: Reals | None, n: int) -> np.ndarray:
    """Return E (n, p) of x⁺ = … + E w in NumPy, the identity for None; a vector is one column."""
    if E is None:
        return np.eye(n)
    E = host_array("disturbance_matrix", as_column(E) if np.ndim(as_array(E)) == 1 else E)
    require_shape("disturbance_matrix", E, (n, *E.shape[-1:]), "One row a state")
    require_finite("disturbance_matrix", E)
    return E
