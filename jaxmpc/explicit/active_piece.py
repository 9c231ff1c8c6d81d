"""The affine law of one active set and the polytope on which it holds, in scaled coordinates."""

import numpy as np

from jaxmpc.explicit.least_distance import SMALLEST, LeastDistanceForm
from jaxmpc.pytrees import record
from jaxmpc.sets.geometry import distinct, dual_hull
from jaxmpc.sets.lp import largest_margin

# Relative rounding of a law: below it a coefficient is zero.
ZERO = 1e-11


@record
class ActivePiece:
    """The affine law of an active set: λ (a, p + 1) and y (nz, p + 1), constant last, on H ξ ≤ h.

    H has unit rows; which: their rows in the program. also_active: see `Region`.
    """

    active: tuple[int, ...]
    also_active: tuple[int, ...]
    multipliers: np.ndarray
    y: np.ndarray
    H: np.ndarray
    h: np.ndarray
    which: np.ndarray


def active_piece(p: LeastDistanceForm, active: tuple[int, ...]) -> ActivePiece | None:
    """Return the affine law of an active set; None where its rows are dependent or it holds
    nowhere."""
    solved = p.solve_active(active)
    if solved is None:
        return None
    multipliers, y = solved
    slack, terms = p.slack(active, y)
    rows, n = list(active), len(p.center)
    # Both λ ≥ 0 and slack ≥ 0 read a'ξ + b + cδ ≥ 0, in row i of the program.
    slack[rows] = multipliers
    terms[rows] = np.abs(multipliers[:, :-1]).sum(axis=1).max(initial=0.0)
    a, b, c = slack[:, :n], slack[:, n], slack[:, n + 1]
    # What is rounding beside the terms of its row is zero.
    a = np.where(np.abs(a) <= 1e-3 * ZERO * terms[:, None], 0.0, a)
    size = np.linalg.norm(a, axis=1)
    constant = size <= ZERO * terms
    zero = constant & (np.abs(b) <= 10 * ZERO * terms)
    if np.any(constant & ~zero & (b < 0)) or np.any(zero & (c < 0)):
        return None
    # Rows at a distance that [−1, 1]^n does not reach cannot cut.
    which = np.flatnonzero(~constant & (b <= 2 * np.sqrt(n) * size))
    H, h = -a[which] / size[which, None], b[which] / size[which]
    h = np.where(np.abs(b[which]) <= 1e-3 * ZERO * terms[which], 0.0, h)
    zero[rows] = False
    also_active = tuple(np.flatnonzero(zero & ~p.zero_row).tolist())
    return ActivePiece(active, also_active, multipliers[:, :-1], y[:, :-1], H, h, which)


@record
class Cell:
    """A region in the coordinates ξ. H ξ ≤ h: its facets, one row each; behind: for each the rows
    of the program that vanish on it; middles: a point inside each. vertices (k, p); radius of the
    largest ball.
    """

    law: ActivePiece
    H: np.ndarray
    h: np.ndarray
    behind: tuple[np.ndarray, ...]
    middles: np.ndarray
    vertices: np.ndarray
    radius: float

    def touches(self, xi: np.ndarray) -> bool:
        """Return whether ξ lies in the region, up to 1e-9."""
        return bool(np.all(self.H @ xi <= self.h + 1e-9))


def cell(p: LeastDistanceForm, active: tuple[int, ...]) -> Cell | None:
    """Return the region of an active set; None where its rows are dependent or it has no volume."""
    found = active_piece(p, active)
    body = None if found is None else interior(found.H, found.h)
    if found is None or body is None:
        return None
    H, h, n, (vertices, radius) = found.H, found.h, len(p.center), body
    # A facet is a row that is tight at vertices that span it; rows with the same vertices share it.
    tight = h - vertices @ H.T <= 1e-6 * radius  # (k, rows)
    facets: dict[bytes, list[int]] = {}
    for j in np.flatnonzero(tight.sum(axis=0) >= n):
        facets.setdefault(tight[:, j].tobytes(), []).append(int(j))
    spanning = []
    for group in facets.values():
        corners = vertices[tight[:, group[0]]]
        size = np.linalg.svd(corners - corners.mean(axis=0), compute_uv=False)
        if n == 1 or size[n - 2] > 1e-6 * radius:
            spanning.append((group, corners.mean(axis=0)))
    first = [group[0] for group, _ in spanning]
    return Cell(
        law=found,
        H=H[first],
        h=h[first],
        behind=tuple(found.which[group] for group, _ in spanning),
        middles=np.array([middle for _, middle in spanning]),
        vertices=vertices,
        radius=radius,
    )


def interior(H: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Return the vertices (k, n) and inner radius of H ξ ≤ h (unit rows) in [−2, 2]^n; None if it
    is flat."""
    n = H.shape[1]
    H, h = np.vstack([H, np.eye(n), -np.eye(n)]), np.append(h, np.full(2 * n, 2.0))
    if n == 1:
        high, low = h[H[:, 0] > 0].min(), -h[H[:, 0] < 0].min()
        return (np.array([[low], [high]]), (high - low) / 2) if high - low > SMALLEST else None
    middle, radius = capped_ball(H, h)
    if radius <= SMALLEST:
        return None
    gap = h - H @ middle
    dual = H / gap[:, None]
    scale = 1 / np.abs(dual).max(axis=0)
    try:
        hull = dual_hull(dual * scale)
    except ValueError:  # too ill-conditioned
        return None
    # Where exactly n rows meet, their crossing is more accurate than qhull's.
    points = middle + hull.intersections * scale
    for i, meeting in enumerate(hull.dual_facets):
        if len(meeting) == n:
            points[i] = np.linalg.solve(H[meeting], h[meeting])
    return points[distinct(points, 1e-7 * radius)], radius


def capped_ball(H: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the center and radius of the largest ball in H ξ ≤ h (unit rows), at most 1; −1 for
    none."""
    center, _ = largest_margin(H, h, np.ones(len(h)), 1.0)
    assert center is not None  # a ball of negative radius fits
    return center, min(float((h - H @ center).min()), 1.0)
