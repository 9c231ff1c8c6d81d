"""The inside of {G x <= g}: a point in its middle, or where it is flat its affine hull."""

from typing import NamedTuple, NoReturn

import numpy as np
import scipy

from jaxmpc.checks import fail
from jaxmpc.sets.lp import FLAT, ROUNDING, Program, cleaned, maximise, scaling

_DOUBTFUL = 1e-5  # a smaller margin is looked at again, in other units


class Flat(ValueError):
    """A set without volume, where one with volume is needed."""


class Frame(NamedTuple):
    """{G x <= g} about a point inside, in coordinates of like size: Z ((x - center) / scale) <= 1.

    The entries of Z (rows, n) are at most 1 in size.
    """

    Z: np.ndarray
    center: np.ndarray
    scale: np.ndarray

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
        off, size = self.Z @ r, np.abs(self.Z) @ np.abs(r)
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
        fail(argument, "is empty: no point satisfies all its rows", "Loosen its rows")

    def slack_at(x: np.ndarray) -> np.ndarray:
        slack, size = g - G @ x, np.abs(g) + np.abs(G) @ np.abs(x)
        if np.any(slack <= 4 * np.finfo(float).eps * size):
            flat(0.0)
        return slack

    def flat(margin: float) -> NoReturn:
        raise Flat(
            f"{argument}: is flat (its rows keep a margin of {max(margin, 0.0):.1e} of its size). "
            "Check the rows: this needs a set with volume"
        )

    slack = slack_at(center)
    step, margin, _ = Program(G, slack).margin()
    center = center + step
    slack = slack_at(center)
    if margin <= _DOUBTFUL:
        low, high = Program(G, slack).bounds()
        half = (high - low) / 2
        if np.any(half <= 0):
            flat(0.0)
        unit = np.where(np.isfinite(half), half, Program(G, slack).column)
        length = np.linalg.norm(G * unit, axis=1)
        step, margin, _ = Program(G * unit / length[:, None], slack / length).margin()
        inside = slack - G @ (unit * step)
        margin = float((inside / length).min())
        if margin <= FLAT:
            flat(margin)
        center = center + unit * step
        slack = slack_at(center)
    Y = G / slack[:, None]
    top = np.abs(Y).max(axis=0, initial=0.0)
    scale = 1 / np.where(top > 0, top, 1.0)
    return Frame(Y * scale, center, scale)


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
    row, column = scaling(G, g)
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
