"""The minimal robust invariant set of x⁺ = A_K x + E w, from outside and as close as is asked.

The minimal set F∞ = ⊕_{i≥0} A_K^i E W is what disturbances alone can reach from the origin. Where
A_K^s E W ⊆ α E W with α < 1, F = (1 − α)⁻¹ ⊕_{i<s} A_K^i E W is invariant and

    F∞ ⊆ F ⊆ (1 − α)⁻¹ F∞        (Raković, Kerrigan, Kouramas & Mayne 2005, IEEE TAC 50).

There is no such α where E W is flat or has the origin on its boundary. Then the same is done for
E W ⊕ D with a small box D = {|x| ≤ spread}: F is invariant for it, hence for E W. D is flat along
the coordinates that neither E W nor the rest of D moves.
"""

from fractions import Fraction
from typing import Any

import numpy as np

from jaxmpc.arrays import Reals, as_array, fractions_of, host_array
from jaxmpc.checks import fail, number, require_finite, require_kind, require_shape, whole
from jaxmpc.pytrees import pytree, static
from jaxmpc.sets.convex_sets import AnyNumber, Box, ConvexSet, Polytope, Zonotope
from jaxmpc.sets.disturbances import (
    disturbance_columns,
    require_disturbance,
    supports,
    with_vertices,
)
from jaxmpc.sets.fields import one_or_many
from jaxmpc.sets.invariant import require_no_drift
from jaxmpc.systems.riccati import require_stable
from jaxmpc.systems.system import LinearSystem, host_matrices

# What rounding may add to α, and to a generator of F relative to its size.
_ROUNDING = 1e-12
# Steps² n³, the work of Fractions that grow, up to which α is computed once more, exactly.
_EXACT = 500_000
_HALVINGS = 40  # of the box D, at most


@pytree
class MinimalInvariantSet(ConvexSet):
    """F = (1 − alpha)⁻¹ ⊕_{i<steps} closed^i (E W ⊕ {|x| ≤ spread}), which holds the minimal robust
    invariant set and is robust invariant itself.

    closed (n, n): A + BK. E (n, p), disturbance: W. spread (n,): zero where E W has volume around
    the origin, and along coordinates that nothing moves. alpha: with closed^steps (E W ⊕ …) ⊆ alpha
    (E W ⊕ …). normals (k, n): the directions in which that was compared; they show it, for along
    coordinates that nothing moves both sets are the origin. excess: along a coordinate, up or down,
    F reaches at most 1 + excess times as far as the minimal set, where that reaches anywhere.
    exact_alpha: an upper bound of the least such alpha in rational arithmetic, with W a Box; else
    None.

    All methods run in NumPy, not traceable.
    """

    closed: Reals
    E: Reals
    disturbance: Any
    spread: Reals
    alpha: float = static()
    steps: int = static()
    excess: float = static()
    normals: Reals
    exact_alpha: Fraction | None = static(default=None)

    @property
    def dimension(self) -> int:
        """Return n, the number of coordinates."""
        return np.shape(as_array(self.closed))[0]

    def validate(self, argument: str, dimension: int | None = None) -> None:
        """Raise ValueError, naming `argument`, for another number of coordinates."""
        self._require_fields(argument, dimension)

    def support(self, d: Reals) -> AnyNumber:
        """Return max d'x over the set, for one direction d (n,) or for each of many (k, n)."""
        given, many = one_or_many("d", d, self.dimension)
        values = self.supports(np.atleast_2d(host_array("d", given)))
        return values if many else float(values[0])

    def supports(self, rows: np.ndarray) -> np.ndarray:
        """Return max g'x over the set for each row g (k, n)."""
        total = sum_of_supports(
            self.closed, self.E, self.disturbance, self.spread, self.steps, rows
        )
        return total / (1 - self.alpha)

    def to_zonotope(self) -> Zonotope:
        """Return the same set by its generators. Raises ValueError unless W is a Box or a
        Zonotope."""
        found = sum_of_disturbances(self.closed, self.E, self.disturbance, self.steps, self.spread)
        scale = (1 + _ROUNDING) / (1 - self.alpha)
        return Zonotope(np.asarray(found.center) * scale, np.asarray(found.generators) * scale)

    def vertices(self) -> np.ndarray:
        """Return the vertices (k, n). Raises ValueError as `to_zonotope` and
        `Zonotope.vertices` do."""
        return self.to_zonotope().vertices()

    def bounding_box(self) -> Box:
        """Return the smallest box around it."""
        identity = np.eye(self.dimension)
        return Box(-self.supports(-identity), self.supports(identity))

    def _require_fields(self, argument: str, dimension: int | None = None) -> None:
        if dimension not in (None, self.dimension):
            fail(argument, f"is a set in R^{self.dimension}", f"Give one in R^{dimension}")


def minimal_robust_invariant_set(
    system: LinearSystem,
    K: Reals,
    disturbance: ConvexSet,
    eps: float = 1e-3,
    *,
    disturbance_matrix: Reals | None = None,
    max_steps: int = 2000,
) -> MinimalInvariantSet:
    """Return a robust invariant set of x+ = (A + BK) x + E w, w in W, close to the least one.

    Arguments:
        system: n states, m inputs; c must be None or zero.
        K: (m, n), with the sign of u = K x.
        disturbance: W, a bounded Box, Polytope or Zonotope that holds the origin. With a Box or a
            Zonotope the result has generators in any dimension; with a Polytope its supports.
        eps: how much larger than the least one it may be, relative to that.
        disturbance_matrix: E (n, p), None for the identity.
        max_steps: of the sum, at most.

    NumPy in float64; not traceable. Raises ValueError if A + BK is not strictly stable, or decays
    so slowly that max_steps do not suffice: the message has the number of steps it needs.

    Source: Raković, Kerrigan, Kouramas & Mayne 2005, IEEE TAC 50(3), theorems 1 and 2.
    """
    require_kind("system", system, LinearSystem)
    system.validate()
    require_no_drift(system)
    A, B, _ = host_matrices(system)
    n, m = B.shape
    require_shape("K", K, (m, n), "Give u = Kx one row an input, one column a state")
    require_finite("K", K)
    if disturbance is None:
        fail("disturbance", "is None", "Give a Box, a Polytope or a Zonotope of w")
    E = disturbance_columns(disturbance_matrix, n)
    W = disturbance.spread(E.shape[1]) if isinstance(disturbance, Box) else disturbance
    require_disturbance("disturbance", W, E.shape[1])
    number("eps", eps, 0.0, "Give a relative excess, such as 1e-3")
    if not 0 < eps < 1:
        fail("eps", f"{eps}", "Give a relative excess between 0 and 1, such as 1e-3")
    max_steps = whole("max_steps", max_steps, 1)
    closed = A + B @ host_array("K", K)
    radius = require_stable("K", closed)

    normals, spread = _normals(E, W), np.zeros(n)
    W = with_vertices(W)
    if normals is not None:
        alpha, steps = _contraction(closed, E, W, spread, normals, eps, max_steps, radius)
        return _found(closed, E, W, spread, normals, alpha, steps, 1 / (1 - alpha) - 1)
    # Extents of the minimal set, from below, and a box of some of that which does not add much.
    identity = np.vstack([np.eye(n), -np.eye(n)])
    count = min(max_steps, max(n, _steps(radius, eps)))
    extent = sum_of_supports(closed, E, W, spread, count, identity)
    reach = np.maximum(extent[:n], extent[n:])
    if not reach.any():  # W = {0}
        return _found(closed, E, W, spread, np.eye(n), 0.0, 1, 0.0)
    size = _spread_with(closed, E, W, reach, count)
    normals = np.eye(n)[size > 0]
    alpha, steps, excess = 0.0, 0, np.inf
    for halvings in range(_HALVINGS):
        spread = eps / 4 * 0.5**halvings * size
        alpha, steps = _contraction(closed, E, W, spread, normals, eps / 3, max_steps, radius)
        whole_ = sum_of_supports(closed, E, W, spread, steps, identity)
        moved = extent > 0
        excess = float((whole_[moved] / extent[moved]).max() / (1 - alpha) - 1)
        if excess <= eps:
            break
    return _found(closed, E, W, spread, normals, alpha, steps, excess)


def _spread_with(
    closed: np.ndarray, E: np.ndarray, W: Any, size: np.ndarray, steps: int
) -> np.ndarray:
    """Return how far E W with a box of these sides (n,) moves each coordinate that neither does
    alone, beside `size` where that is not 0: in the unit of each, and 0 where nothing moves it."""
    identity = np.vstack([np.eye(len(size)), -np.eye(len(size))])
    while True:
        ends = sum_of_supports(closed, E, W, size, steps, identity)
        further = np.where(size > 0, size, np.maximum(*np.split(ends, 2)))
        if np.array_equal(further > 0, size > 0):
            return size
        size = further


def sum_of_disturbances(
    closed: Reals, E: Reals, W: Any, steps: int, spread: Reals | None = None
) -> Zonotope:
    """Return ⊕_{i<steps} closed^i (E W ⊕ {|x| ≤ spread}), what so many disturbances can add up to,
    of a Box or Zonotope W. Raises ValueError for other sets."""
    W = W.to_zonotope() if isinstance(W, Box) else W
    if not isinstance(W, Zonotope):
        what = "is no Box or Zonotope, whose sums alone have generators"
        fail("disturbance", what, "Give a Box or a Zonotope, such as its bounding_box()")
    closed, E = np.asarray(closed, float), np.asarray(E, float)
    one = np.asarray(W.image(E).generators)
    if spread is not None:
        sides = np.asarray(spread, float)
        one = np.hstack([one, np.diag(sides)[:, sides > 0]])
    center, term = E @ np.asarray(W.center, float), one
    middle, parts = np.zeros(len(closed)), [np.zeros((len(closed), 0))]
    for _ in range(steps):
        middle = middle + center
        parts.append(term)
        center, term = closed @ center, closed @ term
    return Zonotope(middle, np.hstack(parts))


def sum_of_supports(
    closed: Reals, E: Reals, W: Any, spread: Reals, steps: int, rows: np.ndarray
) -> np.ndarray:
    """Return the supports of `sum_of_disturbances` along rows (k, n), of any W."""
    closed, E, spread = (np.asarray(v, float) for v in (closed, E, spread))
    total, along = np.zeros(len(rows)), np.asarray(rows, float)
    for _ in range(steps):
        total = total + _reach(E, W, spread, along)
        along = along @ closed
    return total


def _reach(E: np.ndarray, W: Any, spread: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the supports of E W ⊕ {|x| ≤ spread} along rows (k, n)."""
    return supports(W, rows @ E) + np.abs(rows) @ spread


def _normals(E: np.ndarray, W: Any) -> np.ndarray | None:
    """Return the facet normals (k, n) of E W, None where it is flat, has the origin on its
    boundary, or has facets that are not found."""
    n = len(E)
    if isinstance(W, Box) and np.array_equal(E, np.eye(n)):
        normals = np.vstack([np.eye(n), -np.eye(n)])
        return normals if np.all(supports(W, normals) > 0) else None
    W = W.to_zonotope() if isinstance(W, Box) else W
    try:
        body = W.image(E)
        if isinstance(body, Zonotope):
            body = body.to_polytope()
        if not isinstance(body, Polytope):
            return None
        H, h = body.unit_rows()
        deep = h > 1e-9 * np.abs(h).max()
        return H if body.frame().bounded and deep.all() else None
    except ValueError:
        return None


def _contraction(
    closed: np.ndarray,
    E: np.ndarray,
    W: Any,
    spread: np.ndarray,
    normals: np.ndarray,
    eps: float,
    max_steps: int,
    radius: float,
) -> tuple[float, int]:
    """Return the first (alpha, s) with (1 − alpha)⁻¹ ≤ 1 + eps and closed^s (E W ⊕ D) ⊆
    alpha (E W ⊕ D), by supports along the normals; along coordinates those of D ⊆ E W ⊕ D."""
    own = np.abs(normals) @ spread if spread.any() else _reach(E, W, spread, normals)
    along, alpha = normals, np.inf
    for steps in range(1, max_steps + 1):
        along = along @ closed
        ends = _reach(E, W, spread, along)
        if spread.any():
            ends = np.maximum(ends, _reach(E, W, spread, -along))
        alpha = float((ends / own).max()) + _ROUNDING
        if alpha <= eps / (1 + eps):
            return alpha, steps
    needed = max(_steps(radius, eps), max_steps)
    what = f"has spectral radius {radius:.9g}, so that some {needed:,} steps are needed"
    cure = "Use a K that decays faster, a longer sampling period, a larger eps"
    fail("K", f"A + BK {what}", f"{cure}, or max_steps (now {max_steps:,})")


def _steps(radius: float, eps: float) -> int:
    """Return about how many steps it takes until radius^s is far below eps."""
    if radius < 1e-12:
        return 1
    return int(np.ceil(min(np.log(eps / 100) / np.log(radius), 1e9)))


def _found(
    closed: np.ndarray,
    E: np.ndarray,
    W: Any,
    spread: np.ndarray,
    normals: np.ndarray,
    alpha: float,
    steps: int,
    excess: float,
) -> MinimalInvariantSet:
    """Return the set, with its α in rational arithmetic where that is little work."""
    exact, moved = None, np.any(normals, axis=0)
    count = int(moved.sum())
    plain = isinstance(W, Box) and np.array_equal(
        np.abs(normals[:count]), np.eye(len(closed))[moved]
    )
    if plain and alpha > 0 and steps**2 * count**3 <= _EXACT:
        part = closed[np.ix_(moved, moved)], E[moved]
        exact = _exact_alpha(*part, W, spread[moved], steps)
    return MinimalInvariantSet(closed, E, W, spread, alpha, steps, excess, normals, exact)


def _exact_alpha(
    closed: np.ndarray, E: np.ndarray, W: Box, spread: np.ndarray, steps: int
) -> Fraction:
    """Return the least α that supports along coordinates show, without rounding."""
    A, M = fractions_of(closed), fractions_of(np.eye(len(closed)))
    E, D, lower, upper = (fractions_of(v) for v in (E, spread, W.lower, W.upper))
    for _ in range(steps):
        M = M @ A
    worst = Fraction(0)
    for rows, own in ((M, fractions_of(np.eye(len(M)))), (-M, -fractions_of(np.eye(len(M))))):
        ends = [np.maximum(v @ E * lower, v @ E * upper).sum(axis=1) for v in (rows, own)]
        moved = ends[0] + abs(rows) @ D
        worst = max(worst, *(moved / (D if spread.any() else ends[1])))
    return worst
