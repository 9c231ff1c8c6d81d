"""Sets {G x <= g} that may be flat, and hulls of points that may lie in a plane, in NumPy in
float64: what `geometry` does with sets that have volume, carried over to these."""

import numpy as np
import scipy

from jaxmpc.checks import fail
from jaxmpc.sets.geometry import (
    AffineHull,
    Empty,
    Flat,
    affine_hull,
    convex_hull,
    distinct,
    explained,
    framed,
    unit_rows,
)
from jaxmpc.sets.lp import FLAT, ROUNDING, cleaned, scaling

# Samples are drawn from a triangulation in up to so many dimensions.
TRIANGULATED = 6
_FEW_SUMS = 1000  # so many sums of points are all handed to qhull
# Vertices of a hull of sums, by dimension: it may have 100 times as many facets.
_MOST_VERTICES = {5: 4000, 6: 1000}


def full_part(G: np.ndarray, g: np.ndarray, argument: str = "Polytope") -> AffineHull | None:
    """Return the affine hull x = shift + basis w of {G x <= g}, and the set in its coordinates,
    where it has volume (basis (n, k); k = 0 for a point); None if the set is empty.

    A set counts as flat in a direction where it is thinner than about 1e-9 of its size.
    """
    n = G.shape[1]
    none = np.zeros(len(g), bool)
    whole = AffineHull(np.zeros(n), np.eye(n), none, np.arange(len(g)), G, g)
    for _ in range(n + 1):
        if not whole.basis.shape[1]:
            return whole
        try:
            framed(argument, whole.G, whole.g)
            return whole
        except Empty:
            return None
        except Flat:
            pass
        part = _equalities(argument, whole)
        equal = whole.equal.copy()
        equal[whole.rows[part.equal]] = True
        whole = AffineHull(
            whole.shift + whole.basis @ part.shift,
            whole.basis @ part.basis,
            equal,
            whole.rows[part.rows],
            part.G,
            part.g,
        )
    return whole


def _equalities(argument: str, whole: AffineHull) -> AffineHull:
    """Return the affine hull of a flat set, by rows that hold all over it."""
    for tolerance in (FLAT, 10 * FLAT, 100 * FLAT):
        part = affine_hull(whole.G, whole.g, tolerance=tolerance)
        if part is not None and part.equal.any():
            return part
    fail(argument, "is flat in a direction that its rows do not show", "Rescale its rows")


def independent(G: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Return the indices of independent ones of rows G x = g, as many as there are, in scaled
    columns."""
    if not len(g):
        return np.zeros(0, int)
    row, column = scaling(G, g)
    scaled = row[:, None] * G * column
    _, R, order = scipy.linalg.qr(scaled.T, mode="economic", pivoting=True)
    size = np.abs(np.diag(R))
    return np.sort(order[: int((size > FLAT * size[0]).sum())])


def hull(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (H, h) of the convex hull of points (k, n), one unit row a facet; opposite rows for
    the equalities where the points lie in a plane."""
    n = points.shape[1]
    center = points.mean(axis=0)
    size = np.abs(points - center).max(axis=0)
    # Rounding of the center is no width.
    size = np.where(size > 8 * np.finfo(float).eps * np.abs(points).max(axis=0), size, 0.0)
    scale = np.where(size > 0, size, 1.0)
    scaled = np.where(size > 0, (points - center) / scale, 0.0)
    _, widths, Vt = np.linalg.svd(np.linalg.qr(scaled, mode="r"))
    rank = int((widths > FLAT * max(widths.max(initial=0.0), 1e-300)).sum())
    rank = min(rank, len(points) - 1)  # rounding of the center may make it more
    if rank == n:
        normals, offsets = _full_hull(scaled)
        return _unscaled(normals, offsets, scale, center)
    # In coordinates of the plane: some of the scaled ones, on which the others depend.
    basis, free = Vt[:rank].T, np.zeros(0, int)
    if rank:
        free = np.sort(scipy.linalg.qr(basis.T, mode="r", pivoting=True)[1][:rank])
    tied = np.setdiff1d(np.arange(n), free)
    C = basis[tied] @ np.linalg.pinv(basis[free]) if rank else np.zeros((n, 0))
    C = np.where(np.abs(C) <= 1e-13, 0.0, C)
    C, through_zero = _through_zero(points / scale, free, tied, C)
    E = np.zeros((len(tied), n))
    E[np.arange(len(tied)), tied] = 1.0
    E[:, free] = -C
    normals, offsets = np.zeros((0, n)), np.zeros(0)
    if rank:
        inner, offsets = _full_hull(scaled[:, free])
        normals = np.zeros((len(inner), n))
        normals[:, free] = inner
    H = np.vstack([E, -E, normals])
    H, h = _unscaled(H, np.concatenate([np.zeros(2 * len(E)), offsets]), scale, center)
    h[: 2 * len(E)][np.tile(through_zero, 2)] = 0.0
    return H, h


def _through_zero(
    points: np.ndarray, free: np.ndarray, tied: np.ndarray, C: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return C with x_tied = C x_free for coordinates of which this holds to rounding, and which.

    Of points D times as far off as they are wide, a plane is known to rounding times D in slope,
    and where it meets the axes to D²: a side that should be 0 is not rounding of its own terms."""
    x, y = points[:, free], points[:, tied]
    slope = np.linalg.lstsq(x, y, rcond=None)[0].T if len(free) else np.zeros(C.shape)
    rounding = 8 * np.finfo(float).eps
    seen = np.abs(slope) * np.abs(x).max(axis=0) > rounding * np.abs(y).max(axis=0)[:, None]
    slope = np.where(seen, slope, 0.0)
    terms = np.abs(y) + np.abs(x) @ np.abs(slope).T
    found = np.all(np.abs(y - x @ slope.T) <= rounding * terms, axis=0)
    return np.where(found[:, None], slope, C), found


def hull_of_sums(V: np.ndarray, W: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (H, h) of the convex hull of all sums of a row of V (k, n) and one of W (m, n).

    Few sums are vertices of it, and where a row of H is exceeded, by supports of both, one more is
    found: the hull of those that are farthest along some directions grows until no row is.
    Raises ValueError where there are too many vertices for a hull.
    """
    n = V.shape[1]
    if len(V) * len(W) <= _FEW_SUMS:
        return hull((V[:, None] + W).reshape(-1, n))
    size = np.ptp(V, axis=0) + np.ptp(W, axis=0)
    directions = np.random.default_rng(0).standard_normal((60 * n, n))
    directions = np.vstack([np.eye(n), -np.eye(n), directions]) / np.where(size > 0, size, 1.0)
    pairs, H, h = np.zeros((0, 2), int), np.zeros((0, n)), np.zeros(0)
    most = _MOST_VERTICES.get(n, 20_000)
    while True:
        farthest = [np.argmax(directions @ points.T, axis=1) for points in (V, W)]
        known = len(pairs)
        pairs = np.unique(np.vstack([pairs, np.transpose(farthest)]), axis=0)
        if len(pairs) > most:
            problem = f"of the sum has more than {most} vertices in {n} dimensions"
            fail("hull", problem, "Sum Zonotopes, or add supports")
        if len(pairs) == known:
            break
        H, h = hull(V[pairs[:, 0]] + W[pairs[:, 1]])
        reach = (H @ V.T).max(axis=1) + (H @ W.T).max(axis=1)
        terms = np.abs(h) + np.abs(H) @ size
        directions = H[reach - h > ROUNDING * terms]
        if not len(directions):
            break
    return H, h


def _full_hull(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the facets of points that span their space, about 1 wide."""
    if points.shape[1] == 1:
        return np.array([[1.0], [-1.0]]), np.array([points.max(), -points.min()])
    # qhull's facets are simplices: a facet with more corners comes several times.
    with explained("points"):
        facets = convex_hull(points)[0].equations
    facets = facets[distinct(facets, 5e-11)]
    # (Rounding in place of a zero would be a limit where there is none.)
    return cleaned(facets[:, :-1], 1.0), -facets[:, -1]


def _unscaled(
    normals: np.ndarray, offsets: np.ndarray, scale: np.ndarray, center: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    normals = normals / scale
    size = np.abs(offsets) + np.abs(normals) @ (np.abs(center) + scale)
    return unit_rows(normals, cleaned(offsets + normals @ center, size))


def well_conditioned(M: np.ndarray) -> bool:
    """Return whether a matrix is square and has an inverse that is exact to about 1e-9, whatever
    the units of its rows and columns."""
    if M.shape[0] != M.shape[1] or not (M.any(axis=0).all() and M.any(axis=1).all()):
        return False
    row, column = scaling(M, np.zeros(len(M)))
    return bool(np.linalg.cond(row[:, None] * M * column) <= 1e7)


def independent_rows(M: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (own, others, C): rows M[own] that are independent, and M[others] = C M[own]. Units of
    rows and columns do not matter; what is below 1e-9 of the rest counts as zero."""
    row, column = scaling(M, np.zeros(len(M)))
    scaled = row[:, None] * M * column
    values = np.linalg.svd(scaled, compute_uv=False)
    rank = int((values > FLAT * max(values.max(initial=0.0), 1e-300)).sum())
    order = scipy.linalg.qr(scaled.T, mode="r", pivoting=True)[1]
    own = np.sort(order[:rank])
    others = np.setdiff1d(np.arange(len(M)), own)
    C = np.linalg.lstsq(scaled[own].T, scaled[others].T, rcond=None)[0].T
    C = np.where(np.abs(C) <= 1e-13, 0.0, C)
    return own, others, C * row[own] / row[others][:, None]


def closest(G: np.ndarray, g: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the point of {G y <= g}, not empty, closest to x: least |u| with -G u >= G x - g, by
    nonnegative least squares (Lawson & Hanson 1974, chapter 23), then exactly on its rows."""
    beyond = G @ x - g
    if not np.any(beyond > 0):
        return x.copy()
    # In units of the violation, in which u is about 1 long.
    length = np.linalg.norm(G, axis=1)
    unit = float((beyond / length).max())
    A = np.vstack([-(G / length[:, None]).T, beyond / length / unit])
    z, _ = scipy.optimize.nnls(A, np.eye(len(A))[-1], maxiter=100 * len(g))
    r = A @ z - np.eye(len(A))[-1]
    u = -unit * r[:-1] / r[-1]
    on = z > 1e-10 * z.max(initial=0.0)
    exact = np.linalg.lstsq(G[on], -beyond[on], rcond=None)[0]
    room = ROUNDING * (np.abs(g) + np.abs(G) @ (np.abs(x) + np.abs(u)))
    push = np.linalg.lstsq(G[on].T, -exact, rcond=None)[0]
    if np.all(G @ exact <= -beyond + room) and np.all(push >= -1e-9 * np.abs(push).max(initial=0)):
        u = exact
    return x + u


def triangulation(vertices: np.ndarray) -> np.ndarray:
    """Return simplices (K, k+1, k) that make up the hull of vertices (V, k), which span R^k."""
    if vertices.shape[1] == 1:
        return np.array([[[vertices.min()], [vertices.max()]]])
    scaled = (vertices - vertices.mean(axis=0)) / np.ptp(vertices, axis=0)
    try:
        return vertices[scipy.spatial.Delaunay(scaled).simplices]
    except scipy.spatial.QhullError:
        return vertices[scipy.spatial.Delaunay(scaled, qhull_options="QJ").simplices]


def simplex_volumes(simplices: np.ndarray) -> np.ndarray:
    """Return the volumes (K,) of simplices (K, k+1, k), times k!."""
    return np.abs(np.linalg.det(simplices[:, 1:] - simplices[:, :1]))


def spread(vertices: np.ndarray, count: int, random: np.random.Generator) -> np.ndarray:
    """Return points (count, k) uniformly distributed over the hull of vertices that span R^k: a
    simplex of a triangulation by its volume, then a point in it."""
    k = vertices.shape[1]
    if k == 1:
        return random.uniform(vertices.min(), vertices.max(), (count, 1))
    if k > TRIANGULATED:
        problem = f"has dimension {k}, and samples are drawn in up to {TRIANGULATED}"
        fail("sample", problem, "Draw from bounding_box() and keep what the set contains")
    center, scale = vertices.mean(axis=0), np.ptp(vertices, axis=0)
    simplices = (triangulation(vertices) - center) / scale
    size = simplex_volumes(simplices)
    which = random.choice(len(size), count, p=size / size.sum())
    weights = random.dirichlet(np.ones(k + 1), count)
    return center + scale * np.einsum("ij,ijk->ik", weights, simplices[which])
