"""Geometry of {G x <= g} in NumPy, in float64: points inside, affine hulls, hulls, redundant rows,
elimination.

About a point c with G c < g the set {G x <= g} reads {Y (x - c) <= 1}, Y = G / (g - G c). The rows
of Y are points of the polar set: a row is irredundant exactly if it is a vertex of the convex
hull of all of them and 0 (Ziegler 1995, section 2.3), and the polar of a projection is a section.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple, NoReturn

import numpy as np
import scipy

from jaxmpc.arrays import Reals, host_array
from jaxmpc.checks import concrete, fail, require_finite
from jaxmpc.sets.lp import (
    FLAT,
    ROUNDING,
    Program,
    cleaned,
    extent,
    largest_margin,
    maximise,
)

_ZERO = 1e-12  # a coefficient that moves a row by less, relative to its distance, counts as 0
# Errors of qhull that say: the points lie in a hyperplane, or are too few.
_FLAT = ("QH6013", "QH6154", "QH6214")
_ORDERS = 8  # of points, in which a hull is tried
_MERGE = "C-1e-12"  # qhull's option: merge facets of the dual that are flat to 1e-12
_HULL_DIMENSIONS = 6  # above, hulls have too many facets and one LP a row is faster
_MOST_ROWS = 100_000  # an elimination step with more candidate rows raises ValueError
_DOUBTFUL = 1e-5  # a smaller margin is looked at again, in other units
ROUNDED = 4 * np.finfo(float).eps  # slacks up to this, of the terms of their row, are rounding


NONE = "Loosen its rows, or ask is_empty() first"  # what to do about a set without a point


class Flat(ValueError):
    """A set without volume, where one with volume is needed."""


class Empty(ValueError):
    """A set without a point, where one with volume is needed."""


class Frame(NamedTuple):
    """{G x <= g} about a point inside, in coordinates of like size: Z ((x - center) / scale) <= 1.

    Z (rows, n): rows with entries of at most 1 in size. center (n,): the point inside. scale (n,):
    the size of the set along each coordinate.
    """

    Z: np.ndarray
    center: np.ndarray
    scale: np.ndarray

    @classmethod
    def about(cls, center: np.ndarray, G: np.ndarray, slack: np.ndarray) -> "Frame":
        """Return the frame about a point inside, which every row keeps with this slack,
        g - G center > 0."""
        Y = G / slack[:, None]
        top = np.abs(Y).max(axis=0, initial=0.0)
        scale = 1 / np.where(top > 0, top, 1.0)
        return cls(Y * scale, center, scale)

    def vertices(self) -> np.ndarray:
        """Return the vertices (k, n) of a bounded set, counter-clockwise in 2-D."""
        if len(self.center) == 1:
            ends = self.scale / np.array([self.Z.min(), self.Z.max()])
            return self.center + ends[:, None]
        hull = dual_hull(self.Z)
        V, size = hull.intersections, np.abs(hull.intersections).max(axis=0)
        sure = self._rounding_of_vertices(hull.dual_facets) / size
        V = V[distinct(V / size, np.maximum(5e-11, sure.max(axis=1)))]
        if len(self.center) == 2:
            V = V[np.argsort(np.arctan2(V[:, 1], V[:, 0]))]
        return self.center + V * self.scale

    def _rounding_of_vertices(self, facets: list[list[int]]) -> np.ndarray:
        """Return how far rounding moves the vertices (k, n), in which these rows meet: an offset
        is 1 + Z (center / scale), and loses some eps of its terms where the set is far from 0."""
        lost = ROUNDED * (np.abs(self.Z) @ np.abs(self.center / self.scale))
        moved = np.zeros((len(facets), len(self.center)))
        many = np.array([len(rows) for rows in facets])
        for count in np.unique(many):
            at = np.array([rows for rows in facets if len(rows) == count])
            inverse = np.abs(np.linalg.pinv(self.Z[at]))
            moved[many == count] = np.einsum("kij,kj->ki", inverse, lost[at])
        return np.minimum(moved, 1e-3)

    @property
    def bounded(self) -> bool:
        """Return whether the set is bounded: no ray r with Z r <= 0, by one LP, its answer
        checked."""
        n = self.Z.shape[1]
        if len(self.Z) <= n or np.linalg.matrix_rank(self.Z) < n:
            return False
        # If there is one then one that reaches -1 in -1 <= Z r <= 0.
        both = np.vstack([self.Z, -self.Z])
        r = maximise(-self.Z.sum(axis=0), both, np.repeat([0.0, 1.0], len(self.Z))).x
        assert r is not None  # 0 is feasible, and Z has rank n
        # Of r, and of rows that were transformed, entries are rounding beside the largest.
        off, size = self.Z @ r, np.abs(self.Z).max(axis=1) * np.abs(r).max()
        return not (np.any(off < -0.5) and np.all(off <= ROUNDING * size))


def framed(argument: str, G: np.ndarray, g: np.ndarray) -> Frame:
    """Return the frame of {G x <= g} about a point inside; ValueError if it is empty or flat.

    The point has the largest common margin of all rows, first in the data's own scale, then in that
    of the slacks found. Where that leaves a doubt, in units in which the bounding box has size 1:
    the set is flat if the margin is below 1e-9 of it, or if a slack is rounding.
    """
    program = Program(G, g)
    center, margin, _ = program.margin()
    if margin <= ROUNDING and program.empty:
        raise Empty(f"{argument}: is empty: no point satisfies all its rows. {NONE}")

    def slack_at(x: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the slacks (rows,), and the least of them relative to the terms of its row."""
        slack, size = g - G @ x, np.abs(g) + np.abs(G) @ np.abs(x)
        return slack, float(np.min(slack / np.where(size > 0, size, 1.0), initial=1.0))

    def flat(margin: float) -> NoReturn:
        raise Flat(
            f"{argument}: is flat (its rows keep a margin of {max(margin, 0.0):.1e} of its size). "
            "Check the rows: this needs a set with volume"
        )

    norms = np.linalg.norm(G, axis=1)
    slack, least = slack_at(center)
    if least <= ROUNDED:  # a scaled row, whose margin is this in its own units
        inside, _ = largest_margin(G, g, norms, 1.0)
        center = center if inside is None else inside
        slack, least = slack_at(center)
        if least <= ROUNDED:
            flat(0.0)
    step, margin, _ = Program(G, slack).margin()
    moved, left = slack_at(center + step)
    depth = moved[norms > 0] / norms[norms > 0]
    # Of rows x <= 1 and -x <= 1e-16 both scales take a point at the second for inside.
    uneven = len(depth) and depth.min() < 1e-9 * depth.max()
    doubtful = uneven or margin <= _DOUBTFUL or left <= ROUNDED
    if left > least or not doubtful:
        center, slack = center + step, moved
    if doubtful:
        low, high = Program(G, slack).bounds()
        half = (high - low) / 2
        if np.any(half <= np.sqrt(np.finfo(float).tiny)):  # whose squares are 0
            flat(0.0)
        unit = np.where(np.isfinite(half), half, Program(G, slack).column)
        # (The margin of `Program` is one of scaled rows, which have units of their own.)
        length = np.linalg.norm(G * unit, axis=1)
        found, _ = largest_margin(G * unit, slack, length, 1.0)
        step = np.zeros(len(unit)) if found is None else unit * found
        inside = slack - G @ step
        margin = float((inside / length).min())
        if margin <= FLAT:
            flat(margin)
        center = center + step
        slack, least = slack_at(center)
        if least <= ROUNDED:
            flat(0.0)
    return Frame.about(center, G, slack)


def implied_equalities(G: np.ndarray, g: np.ndarray, tolerance: float = FLAT) -> np.ndarray:
    """Return which rows of G x <= g (not empty) hold with equality all over the set.

    The rows with a multiplier in max t, G x + t <= g, do if t = 0: y'(g - G x) = 0 for every x.
    They are made equalities, and so on until the rest keeps a margin (facial reduction; Freund,
    Roundy & Todd 1985). A margin counts as 0 below `tolerance`, in scaled rows and columns, if
    `framed` calls the set flat too.
    """
    equal = np.zeros(len(g), bool)
    for _ in range(len(g)):
        _, t, y = Program(G, g, equal).margin()
        if t > tolerance or equal.all():
            return equal
        if not equal.any():
            try:  # a narrow set far from the origin has volume
                framed("", G, g)
                return equal
            except ValueError:
                pass
        if t == -np.inf:
            break
        on = (y > 1e-6 * y.max(initial=0.0)) & ~equal
        if not on.any():
            return equal
        equal = equal | on
    return equal


class AffineHull(NamedTuple):
    """The points x = shift + basis w of an affine space, and a set {G w <= g} in it, with volume.

    equal (all rows,): which rows of the set hold all over it. rows: the others that move with w, of
    which G and g are.
    """

    shift: np.ndarray
    basis: np.ndarray
    equal: np.ndarray
    rows: np.ndarray
    G: np.ndarray
    g: np.ndarray


def affine_hull(
    G: np.ndarray, g: np.ndarray, *, keep: int = 0, tolerance: float = FLAT
) -> AffineHull | None:
    """Return the affine hull of G x <= g (not empty), and the set in its coordinates, with volume.

    keep: so many first coordinates of x are the first of w; None where the equalities tie these to
    each other. The others are affine in them and in the rest of w, which are some of them. Where no
    equality is implied, w = x.
    """
    n = G.shape[1]
    equal = implied_equalities(G, g, tolerance)
    if not equal.any():
        return AffineHull(np.zeros(n), np.eye(n), equal, np.arange(len(g)), G, g)
    program = Program(G, g)
    row, column = program.row, program.column
    E, e = (row[:, None] * G * column)[equal], (row * g)[equal]
    U, size, Vt = np.linalg.svd(E[:, keep:], full_matrices=False)
    rank = int((size > 1e-10 * max(size.max(initial=0.0), 1e-300)).sum())
    U, S, V = U[:, :rank], size[:rank], Vt[:rank].T
    if np.any(np.abs(E[:, :keep] - U @ (U.T @ E[:, :keep])) > FLAT):
        return None
    shift = np.append(np.zeros(keep), V @ ((U.T @ e) / S))
    follow = np.where(np.abs(tied := -V @ ((U.T @ E[:, :keep]) / S[:, None])) > 1e-14, tied, 0.0)
    null, free = plain_null_space(V.T)
    basis = np.block([[np.eye(keep), np.zeros((keep, n - keep - rank))], [follow, null]])
    # Each w is a coordinate of x, in its own units.
    free = np.append(np.arange(keep), keep + free)
    basis, shift = column[:, None] * basis / column[free], column * shift
    rest = np.flatnonzero(~equal)
    H = cleaned(G[rest] @ basis, np.abs(G[rest]) @ np.abs(basis) * 1e3)
    h = cleaned(g[rest] - G[rest] @ shift, np.abs(g[rest]) + np.abs(G[rest]) @ np.abs(shift))
    moved = H.any(axis=1)
    return AffineHull(shift, basis, equal, rest[moved], H[moved], h[moved])


def plain_null_space(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a basis (n, n - r) of {x : rows x = 0}, rows (r, n) independent, whose parameters are
    the entries `free` (n - r,) of x, and these: the r others are found by pivoting."""
    r, n = rows.shape
    if r == 0:
        return np.eye(n), np.arange(n)
    _, R, order = scipy.linalg.qr(rows, mode="economic", pivoting=True)
    tied, free = order[:r], np.sort(order[r:])
    basis = np.zeros((n, n - r))
    basis[free] = np.eye(n - r)
    S = np.linalg.solve(rows[:, tied], rows[:, free])
    basis[tied] = np.where(np.abs(S) <= 1e-14, 0.0, -S)
    return basis, free


def largest_ball(argument: str, G: np.ndarray, g: np.ndarray) -> tuple[np.ndarray, float]:
    """Return (center, radius) of the largest ball in {G x <= g}; ValueError if empty.

    The LP max r subject to G_i x + |G_i| r <= g_i (Boyd & Vandenberghe 2004, section 4.3.1), with r
    of either sign so that it is always feasible: 0, or negative by rounding, where the set is flat.
    inf, and a point of the set, if there are balls of every radius.
    """
    length = np.linalg.norm(G, axis=1)
    if Program(G, g).empty:
        fail(argument, "is empty: no point satisfies all its rows", NONE)
    x, _ = largest_margin(G, g, length)
    if x is None:
        return Program(G, g).margin()[0], np.inf
    return x, float(((g - G @ x) / length).min(initial=np.inf))


def irredundant_rows(argument: str, G: np.ndarray, g: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of a set with volume, which may be unbounded, that the others do not imply;
    ValueError if it is empty or flat."""
    keep = irredundant(framed(argument, G, g).Z)
    return G[keep], g[keep]


def binding_rows(H: np.ndarray, h: np.ndarray, argument: str = "Polytope") -> np.ndarray:
    """Return the indices of the rows of H x <= h that can bind; ValueError for NaN and for empty
    rows."""
    require_rows(H, h, argument)
    zero = ~H.any(axis=1)
    if np.any((h == -np.inf) | (zero & (h < 0))):
        what = "is empty: a row reads 0'x <= h < 0 or has h = -inf"
        raise Empty(f"{argument}: {what}. Loosen that row, or ask is_empty() first")
    return np.flatnonzero(~zero & (h < np.inf))


def require_rows(H: Any, h: Any, argument: str = "Polytope") -> None:
    """Raise ValueError where rows H x <= h that can be read hold NaN, or H infinity."""
    require_finite(f"{argument}.H", H)
    if concrete(h) and np.isnan(h).any():
        fail(f"{argument}.h", "holds NaN", "Use inf for a row that does not bind")


def unit_rows(H: Any, h: Any, argument: str = "Polytope") -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of H x <= h that can bind, scaled to norm 1, in float64."""
    H, h = host_array(f"{argument}.H", H), host_array(f"{argument}.h", h)
    binding = binding_rows(H, h, argument)
    H, h = H[binding], h[binding]
    length = np.linalg.norm(H, axis=1)
    return H / length[:, None], h / length


def row_lengths(M: np.ndarray) -> np.ndarray:
    """Return the norm of each row of M, and 1 for a row of zeros."""
    length = np.linalg.norm(M, axis=1)
    return np.where(length > 0, length, 1.0)


def hull_volume(points: Reals, *, thin: bool = False) -> float:
    """Return the volume of the convex hull of points (k, n): 0 where they lie in a hyperplane.

    thin: the set may be thin along oblique directions, so that qhull calls it flat. Then it is
    computed in coordinates in which the points spread alike, moved by some 1e-11 ("QJ") where qhull
    still fails. NumPy; not traceable.
    """
    points = host_array("points", points)
    if len(points) <= points.shape[1]:
        return 0.0
    if points.shape[1] == 1:
        return float(np.ptp(points))
    center = points.mean(axis=0)
    # qhull works best in coordinates of like size.
    if thin:
        _, scale, axes = np.linalg.svd(points - center, full_matrices=False)
        points, center = (points - center) @ axes.T, np.zeros_like(center)
    else:
        scale = np.ptp(points, axis=0)
    if not scale.all():
        return 0.0
    scaled = (points - center) / scale
    # Clusters confuse qhull; one point of each spans a hull that is no larger.
    scaled = scaled if thin else scaled[distinct(scaled, 5e-12)]
    try:
        hull, _ = convex_hull(scaled)
    except scipy.spatial.QhullError:  # flat
        if not thin:
            return 0.0
        hull = scipy.spatial.ConvexHull(scaled, qhull_options="QJ")
    return float(hull.volume * np.prod(scale))


def convex_hull(points: np.ndarray) -> "tuple[scipy.spatial.ConvexHull, np.ndarray]":
    """Return the hull of points (k, n) of like size in all coordinates, n ≥ 2, and the indices of
    those that it was computed of. QhullError where they lie in a hyperplane.

    Where many points lie on one facet, as ends of rays do, qhull can lose itself among them. It is
    then asked for the vertices alone, facets merged that are flat to 1e-9, in several orders of the
    points, and for their hull. Where that fails too the answer is good to some 1e-9 ("Q12").
    """
    try:
        return scipy.spatial.ConvexHull(points), np.arange(len(points))
    except scipy.spatial.QhullError as error:
        if str(error).startswith(_FLAT):
            raise
    for seed in range(_ORDERS):
        kept = np.random.default_rng(seed).permutation(len(points))
        with suppress(scipy.spatial.QhullError):
            merged = scipy.spatial.ConvexHull(points[kept], qhull_options="C-1e-9")
            kept = np.sort(kept[merged.vertices])
            return scipy.spatial.ConvexHull(points[kept]), kept
    return scipy.spatial.ConvexHull(points, qhull_options="Qt Q12"), np.arange(len(points))


def dual_hull(Y: np.ndarray) -> "scipy.spatial.HalfspaceIntersection":
    """Return the vertices of {Y x <= 1} and the rows that meet in each, by a convex hull of Y
    (qhull).

    A zero row makes facets through 0, whose vertices are at infinity.
    """
    halfspaces = np.column_stack([Y, -np.ones(len(Y))])
    with explained("Polytope"), np.errstate(divide="ignore", invalid="ignore"):
        return scipy.spatial.HalfspaceIntersection(
            halfspaces, np.zeros(Y.shape[1]), qhull_options=_MERGE
        )


@contextmanager
def explained(argument: str) -> Iterator[None]:
    """Turn errors of qhull into a ValueError that names the argument."""
    try:
        yield
    except scipy.spatial.QhullError as error:
        reason = str(error).splitlines()[0]
        fail(argument, f"too ill-conditioned for qhull ({reason})", "Rescale the coordinates")


def distinct(points: np.ndarray, radius: float | np.ndarray) -> np.ndarray:
    """Return the indices of the points (k, n), of those whose balls of this radius, or of these
    (k,), meet only the one with the smallest."""
    radius = np.broadcast_to(radius, len(points))
    order = np.argsort(radius, kind="stable")
    points, radius = points[order], radius[order]
    i, j = scipy.spatial.KDTree(points).query_pairs(2 * radius[-1], output_type="ndarray").T
    meet = np.linalg.norm(points[i] - points[j], axis=1) <= radius[i] + radius[j]
    return np.sort(np.delete(order, np.maximum(i, j)[meet]))


def factors(Y: np.ndarray) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
    """Write {Y x <= 1} as a product of sets, in the finest way its rows allow.

    Returns ([(rows, Z), ...], S): in the coordinates s = S x the rows `rows` read Z t <= 1 with
    t the factor's own entries of s, which no other factor's rows contain. S is square unless
    rank Y < n: then directions along which the set is a cylinder are left out.

    S consists of linearly independent rows of Y. Y = C S, and two rows share a factor if
    they are connected through the nonzeros of C: these are the connected components of the
    matroid of Y's rows (Oxley 2011, proposition 4.1.2 and section 4.2), so no other choice of
    S would split further.
    """
    if len(Y) == 0:
        return [], Y
    scale = np.abs(Y).max(axis=0)
    scaled = Y / np.where(scale > 0, scale, 1.0)
    _, R, pivots = scipy.linalg.qr(scaled.T, mode="economic", pivoting=True)
    diagonal = np.abs(np.diag(R))
    rank = int((diagonal > _ZERO * diagonal[0]).sum())
    S = pivots[:rank]
    C = np.linalg.lstsq(scaled[S].T, scaled.T, rcond=None)[0].T
    C[np.abs(C) <= _ZERO] = 0.0
    row, column = np.nonzero(C)
    size = len(Y) + rank
    links = scipy.sparse.coo_array((np.ones(len(row)), (row, len(Y) + column)), (size, size))
    count, label = scipy.sparse.csgraph.connected_components(links, directed=False)
    rows, columns = label[: len(Y)], label[len(Y) :]
    parts = []
    for part in range(count):
        own = np.flatnonzero(rows == part)
        parts.append((own, C[np.ix_(own, np.flatnonzero(columns == part))]))
    return parts, Y[S]


def irredundant(Y: np.ndarray, known: Sequence[int] | np.ndarray = ()) -> np.ndarray:
    """Return the indices of the rows of Y x <= 1 that the others do not imply, ascending.

    Arguments:
        Y: (rows, n); the set may be unbounded.
        known: indices of rows that are known to be irredundant.

    Of rows that differ by less than about 1e-12, and of those that cut off less than about
    1e-10 of the set's size (1e-12 in few dimensions), only one is kept, or none.

    Factor by factor of the product that the rows make: in up to six dimensions by a hull of
    the polar points, above by LPs.
    """
    length = np.linalg.norm(Y, axis=1)
    directions = np.round(Y / np.where(length > 0, length, 1.0)[:, None], 12) + 0.0
    order = np.argsort(-length, kind="stable")
    _, first = np.unique(directions[order], axis=0, return_index=True)
    candidates = np.sort(order[first])  # of parallel rows the closest
    candidates = candidates[length[candidates] > 0]
    known = np.isin(candidates, np.asarray(known, dtype=int))
    keep = []
    for rows, Z in factors(Y[candidates])[0]:
        if not Z.size:  # rows of rounding errors, which cannot bind
            continue
        Z = Z / np.abs(Z).max(axis=0)
        if Z.shape[1] == 1:
            ends = {int(np.argmax(Z)), int(np.argmin(Z))}
            kept = np.array([i for i in ends if Z[i, 0] == Z.max() > 0 or Z[i, 0] == Z.min() < 0])
        elif Z.shape[1] <= _HULL_DIMENSIONS:
            # The point 0 is a vertex of the hull if the set is unbounded, inside it otherwise.
            hull = dual_hull(np.vstack([Z, np.zeros(Z.shape[1])]))
            kept = np.setdiff1d(np.concatenate(hull.dual_facets), [len(Z)])
        else:
            kept = _by_programs(Z, known[rows])
        keep.append(candidates[rows[kept]])
    return np.sort(np.concatenate(keep)) if keep else np.zeros(0, dtype=int)


def _by_programs(Y: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the indices of the irredundant rows of Y x <= 1, by LPs whose rows are known
    irredundant ones.

    The first row that a ray from an interior point meets is irredundant. So an LP either
    proves a row redundant, or its maximiser lies outside the set and the ray towards it finds
    a new irredundant row: few rows an LP, however many are redundant (Clarkson 1994, "More
    output-sensitive geometric algorithms", FOCS). The multipliers of one proof often prove others
    too. The rays start off the center, at random, so that none meets a corner.
    """
    keep = known.copy()
    random = np.random.default_rng(0)
    n = Y.shape[1]
    start = random.standard_normal(n)
    start *= 0.1 / (np.linalg.norm(start) * np.linalg.norm(Y, axis=1).max())
    slack = 1 - Y @ start
    count = min(len(Y), 3_000_000 // len(Y))
    rays = np.vstack([Y[:count], random.standard_normal((2 * count, n))])
    nearness = rays @ (Y / slack[:, None]).T  # 1 / distance along the ray to the row
    second, first = np.argpartition(nearness, -2, axis=1)[:, -2:].T
    ray = np.arange(len(rays))
    nearest = nearness[ray, first]  # not above 0: the ray meets no row
    keep[first[(nearest > 0) & (nearness[ray, second] < (1 - 1e-9) * nearest)]] = True
    open_rows = ~keep
    while open_rows.any():
        i = int(np.argmax(open_rows))
        # The row itself, loosened, keeps the LP bounded.
        rows = np.vstack([Y[keep], Y[i]])
        best = maximise(Y[i], *unit_rows(rows, np.append(np.ones(len(rows) - 1), 2.0)))
        if best.x is not None and best.y is not None and best.value > 1 + 1e-10:
            hit = int(np.argmax(Y @ (best.x - start) / slack))
            i = i if keep[hit] else hit
            keep[i], open_rows[i] = True, False
            continue
        open_rows[i] = False
        if best.y is None:
            continue
        # The row is S'w with w >= 0 and sum(w) <= 1 for few rows S, and so are others often.
        S = rows[best.y > 1e-9 * best.y.max()]
        W = Y[open_rows] @ np.linalg.pinv(S)
        error = np.abs(W @ S - Y[open_rows]).max(axis=1)
        implied = (W >= 0).all(axis=1) & (W.sum(axis=1) <= 1 + 1e-10) & (error <= _ZERO)
        open_rows[np.flatnonzero(open_rows)[implied]] = False
    return np.flatnonzero(keep)


def eliminate(Y: np.ndarray, axes: Sequence[int]) -> np.ndarray:
    """Return the irredundant rows of the projection of {x : Y x <= 1} along the coordinates `axes`.

    Fourier-Motzkin, one coordinate at a time, that with the fewest new rows first: of rows p
    and q with p_j > 0 > q_j the convex combination with j-th entry 0, and all rows with j-th
    entry 0. The latter stay irredundant: the facet of such a row holds the direction e_j or
    projects onto as many dimensions as a facet needs. Columns of `axes` are dropped.

    An entry that changes its row by less than 1e-12 within the set counts as 0.

    Raises ValueError if a step makes more than 100,000 rows.
    """
    scale = np.abs(Y).max(axis=0, initial=0.0)
    scale[scale == 0] = 1.0
    Y = Y / scale
    Y = Y[irredundant(Y)]
    reach = np.full(Y.shape[1], np.inf)
    reach[list(axes)] = extent(*unit_rows(Y, np.ones(len(Y))), axes)
    left = list(axes)
    while left:
        entries = np.where(np.abs(Y[:, left]) <= _ZERO / reach[left], 0.0, Y[:, left])
        above, below = (entries > 0).sum(axis=0), (entries < 0).sum(axis=0)
        cheapest = int(np.argmin(above * below - above - below))
        if above[cheapest] * below[cheapest] > _MOST_ROWS:
            problem = f"{above[cheapest]} x {below[cheapest]} new rows to eliminate one coordinate"
            fail("axes", problem, "Keep more axes, or project fewer rows")
        j, y = left.pop(cheapest), entries[:, cheapest]
        plus, minus = Y[y > 0][:, None], Y[y < 0][None]
        p, q = y[y > 0][:, None, None], -y[y < 0][None, :, None]
        first, second = plus * (q / (p + q)), minus * (p / (p + q))
        new = first + second
        # What the sum cancels to rounding is 0.
        new[np.abs(new) <= 8 * np.finfo(float).eps * (np.abs(first) + np.abs(second))] = 0.0
        new[..., j] = 0.0
        old = Y[y == 0]
        old[:, j] = 0.0
        Y = np.vstack([old, new.reshape(-1, Y.shape[1])])
        Y = Y[irredundant(Y, np.arange(len(old)))]
    return np.delete(Y * scale, list(axes), axis=1)
