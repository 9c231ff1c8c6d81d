"""Linear programs over {x : G x <= g}, in NumPy in float64 (HiGHS): the one place that solves them.

Rows and columns are scaled first, so that no answer depends on the units of a row or a coordinate.
HiGHS' word is taken for an optimum alone, whose multipliers bound it whatever HiGHS' error
(`bound`). That a set is empty or unbounded is said only with a vector that shows it, checked here:

    empty      y >= 0 with G'y = 0 and g'y < 0             (Farkas),
    unbounded  a ray r with G r <= 0 and d'r > 0.

A number counts as zero if it is within the rounding of the terms that it is the sum of.
"""

from functools import cached_property
from typing import Any, NamedTuple, NoReturn

import numpy as np
import scipy
from scipy.optimize import linprog

from jaxmpc.checks import fail

# Tolerances of HiGHS, in rows and columns that are scaled to about 1. Its presolve calls some
# unbounded programs infeasible and needs scaling of its own, so it is off.
HIGHS = {
    "primal_feasibility_tolerance": 1e-10,
    "dual_feasibility_tolerance": 1e-10,
    "presolve": False,
}
# A set is flat if its rows keep no larger common margin, relative to its own size.
FLAT = 1e-9
# A sum within this of the sum of its terms' sizes is rounding: well above 2^-53, since the data are
# results of long computations.
ROUNDING = 1e-11
# What is left of G'y in a Farkas vector is charged for points so many times as far as typical ones.
FAR = 1e3
_DOUBTFUL = 1e-5  # a smaller margin is looked at again, in other units
_SWEEPS = 40  # of the least squares of `scaling`; fewer where they end before


class Optimum(NamedTuple):
    """A program's maximum (inf: unbounded, -inf: empty, each shown by a checked vector), where it
    is attained (n,), and the multipliers (rows,); None where there is no optimum."""

    value: float
    x: np.ndarray | None = None
    y: np.ndarray | None = None


class Program:
    """Programs over {x : G x <= g}, with equality in the rows of the mask `equal` (None: none).

    row (rows,), column (n,): powers of two with row_i G_ij column_j and row_i g_i of about 1. They
    come from the data alone, and follow a change of units of any row or coordinate.
    """

    def __init__(self, G: np.ndarray, g: np.ndarray, equal: np.ndarray | None = None) -> None:
        self.G, self.g = np.asarray(G, np.float64), np.asarray(g, np.float64)
        self.equal = np.zeros(len(self.g), bool) if equal is None else equal
        self.row, self.column = scaling(self.G, self.g)
        self.M, self.b = self.row[:, None] * self.G * self.column, self.row * self.g

    def maximise(self, d: np.ndarray) -> Optimum:
        """Maximise d'x: the dual simplex, then the interior point, then the dual program.

        The multipliers y obey G'y = d and g'y = value up to rounding, and y >= 0 but for
        equalities. Raises ValueError where HiGHS finds neither an optimum nor a vector that shows
        that there is none.
        """
        d = np.asarray(d, np.float64)
        cost = d * self.column
        length = np.abs(cost).max(initial=0.0) or 1.0
        cost = cost / length
        checked = False
        for method in ("highs-ds", "highs-ipm", "dual", "none"):
            found, claim = None, True
            if method == "dual":
                found = self._by_dual(cost)
            elif method != "none":
                found, claim = solve(cost, self.M, self.b, self.equal, method)
            if found is not None:
                x, y = self._exact(cost, *found)
                left = np.abs(self.M.T @ y - cost).max(initial=0.0)
                exact = left <= 1e-13 * (1 + np.abs(y).sum())
                value = self.b @ y if exact else cost @ x
                y_given = y * self.row * length
                return Optimum(float(value * length), x * self.column, y_given)
            # Where HiGHS claims that there is no optimum, and at last.
            if claim and not checked:
                checked = True
                if self.farkas is not None:
                    return Optimum(-np.inf)
                if self._ray(cost) is not None:
                    return Optimum(np.inf)
        fail("LP", "HiGHS finds no answer that can be checked", "Scale the rows to like size")

    def bound(self, d: np.ndarray, best: Optimum, extent: np.ndarray) -> float:
        """Return an upper bound of d'x over the set within |x| <= extent, from the multipliers of
        an optimum found for d; the optimum's value, which is infinite, where it has none."""
        return best.value if best.y is None else bound(d, best.y, self.G, self.g, extent)

    def _by_dual(self, cost: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Solve min b'y with M'y = cost, y >= 0 but for equalities: its multipliers are x."""
        free = np.eye(len(self.b))[~self.equal]
        rows = np.vstack([self.M.T, -free])
        limits = np.append(cost, np.zeros(len(free)))
        found, _ = solve(-self.b, rows, limits, np.arange(len(rows)) < len(cost), "highs-ds")
        if found is None:
            return None
        y, x = found
        return -x[: len(cost)], np.where(self.equal, y, np.maximum(y, 0.0))

    def _exact(
        self, cost: np.ndarray, x: np.ndarray, y: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the optimum without HiGHS' tolerances: x on the rows with multipliers, and the
        multipliers with M'y = cost, each by least squares, where that is no worse."""
        on = np.abs(y) > 1e-10 * np.abs(y).max(initial=0.0)
        if not on.any():
            return x, np.zeros_like(y)
        better = np.zeros_like(y)
        better[on] = np.linalg.lstsq(self.M[on].T, cost, rcond=None)[0]
        off = lambda v: np.abs(self.M.T @ v - cost).max()
        if np.all((better >= 0) | self.equal) and off(better) <= off(y):
            y = better
        nearer = x + np.linalg.lstsq(self.M[on], self.b[on] - self.M[on] @ x, rcond=None)[0]
        worst = lambda v: (self.M @ v - self.b).max(initial=0.0)
        return (nearer if worst(nearer) <= max(worst(x), 1e-14) else x), y

    @cached_property
    def violation(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Return (x, y, t) of the least t with M x <= b + t, t >= -1, in scaled coordinates: y are
        the multipliers, with a sum of 1 if t > -1."""
        M = np.vstack([self.M, -self.M[self.equal], np.zeros((1, self.M.shape[1]))])
        b = np.concatenate([self.b, -self.b[self.equal], [1.0]])
        M = np.column_stack([M, -np.ones(len(M))])
        for method in ("highs-ds", "highs-ipm"):
            found, _ = solve(-np.eye(M.shape[1])[-1], M, b, np.zeros(len(b), bool), method)
            if found is not None:
                x, y, count = found[0][:-1], found[1].copy(), len(self.b)
                y[:count][self.equal] -= y[count:-1]
                slack = self.M @ x - self.b
                worst = np.where(self.equal, np.abs(slack), slack).max(initial=-1.0)
                return x, y[:count], float(worst)
        fail("LP", "HiGHS finds no point of least violation", "Scale the rows to like size")

    @cached_property
    def farkas(self) -> np.ndarray | None:
        """Return multipliers (rows,) that show that the set is empty; None where none do."""
        x, y, t = self.violation
        if t <= ROUNDING:
            return None
        on = np.abs(y) > 1e-10 * np.abs(y).max()
        part = np.append(self.M[on].T, np.sign(y[on])[None], axis=0)
        better = np.zeros_like(y)
        better[on] = np.linalg.lstsq(part, np.eye(len(part))[-1], rcond=None)[0]
        for v in (better, y):
            if np.any((v < 0) & ~self.equal):
                continue
            # |x| of about 1 is typical in scaled coordinates; the point found may lie farther out.
            far = FAR * (1 + np.abs(x))
            size = np.abs(v) @ (np.abs(self.b) + np.abs(self.M) @ (1 + np.abs(x)))
            if -self.b @ v > np.abs(self.M.T @ v) @ far + ROUNDING * size:
                return v * self.row
        return None

    def _ray(self, cost: np.ndarray) -> np.ndarray | None:
        """Return a ray r with M r <= 0 and cost'r > 0, None where none is found. The set must have
        a point."""
        n = self.M.shape[1]
        box = np.vstack([self.M, np.eye(n), -np.eye(n)])
        limits = np.append(np.zeros(len(self.b)), np.ones(2 * n))
        equal = np.append(self.equal, np.zeros(2 * n, bool))
        for method in ("highs-ds", "highs-ipm"):
            found, _ = solve(cost, box, limits, equal, method)
            if found is None:
                continue
            r = np.where(np.abs(found[0]) < 1e-12, 0.0, found[0])
            off, size = self.M @ r, np.abs(self.M) @ np.abs(r)
            off = np.where(self.equal, np.abs(off), off)
            if cost @ r > FLAT * np.abs(cost) @ np.abs(r) and np.all(off <= ROUNDING * size):
                return r * self.column
        return None

    @property
    def empty(self) -> bool:
        """Return whether the set is shown to be empty."""
        if not np.any(self.equal | (self.b < 0)):
            return False
        return self.farkas is not None

    def bounds(self, axes: Any = None) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and the largest x_i over the set for each i of `axes` (None: all);
        infinite where the set is unbounded, (inf, -inf) where it is empty."""
        directions = np.eye(self.G.shape[1])[slice(None) if axes is None else list(axes)]
        high = np.array([self.maximise(e).value for e in directions])
        low = np.array([-self.maximise(-e).value for e in directions])
        return low, high

    def margin(self) -> tuple[np.ndarray, float, np.ndarray]:
        """Return (x, t, y) of the largest t with M x + t <= b in scaled rows; y (rows,) are its
        multipliers, in scaled rows, and sum up to 1. Where there is no largest t: one with t = 1
        and y = 0. Where equalities cannot hold: t = -inf."""
        ball = np.append(np.where(self.equal, 0.0, 1.0), 1.0)[:, None]
        M = np.hstack([np.vstack([self.M, np.zeros((1, self.M.shape[1]))]), ball])
        b, equal = np.append(self.b, 1.0), np.append(self.equal, False)
        free = np.arange(len(b)) < len(self.b)
        for method, part in (("highs-ds", free), ("highs-ds", free | True), ("highs-ipm", free)):
            found, _ = solve(np.eye(M.shape[1])[-1], M[part], b[part], equal[part], method)
            if found is not None:
                x, y = found[0][:-1], found[1][: len(self.b)]
                slack = np.append((self.b - self.M @ x)[~self.equal], found[0][-1])
                return x * self.column, float(slack.min()), y
        return np.zeros(self.G.shape[1]), -np.inf, np.zeros(len(self.g))


def solve(
    cost: np.ndarray, M: np.ndarray, b: np.ndarray, equal: np.ndarray, method: str
) -> tuple[tuple[np.ndarray, np.ndarray] | None, bool]:
    """Return (x, y) of max cost'x over M x <= b, with equality where `equal`, or None where HiGHS
    does not call it optimal; and whether it claims that there is no optimum. The data must be
    scaled. On ill-conditioned data HiGHS may cycle: its steps are limited."""
    some = equal.any()
    result = linprog(
        -cost,
        A_ub=M[~equal] if some else M,
        b_ub=b[~equal] if some else b,
        A_eq=M[equal] if some else None,
        b_eq=b[equal] if some else None,
        bounds=(None, None),
        method=method,
        options={**HIGHS, "maxiter": 1000 + 20 * sum(M.shape)},
    )
    if result.status != 0:
        return None, result.status in (2, 3)
    y = np.zeros(len(b))
    y[~equal] = np.maximum(-result.ineqlin.marginals, 0.0)
    if some:
        y[equal] = -result.eqlin.marginals
    return (result.x, y), False


def scaling(G: np.ndarray, g: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return powers of two (row, column) with row_i G_ij column_j and row_i g_i of about 1.

    column_j is how far along x_j the rows that it dominates let a point go, |g_i| / |G_ij|, in the
    median. A row is dominated by the entries within a factor of 16 of its largest in scaled
    columns. So entries of G that are rounding have no influence, nor have distances 1e12 times
    smaller or larger than most, which are rounding or no limits. This starts from the least squares
    fit of the logarithms of [G, g] (Curtis & Reid 1972, J. Inst. Maths Applics 10). Rows follow:
    their largest entry is about 1. A change of units of rows and columns changes the answer by the
    same factors.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        L, distance = np.log2(np.abs(G)), np.log2(np.abs(g))
        reach = np.where(np.isfinite(L), distance[:, None] - L, np.inf)
    reach[~np.isfinite(distance)] = np.inf
    both = np.column_stack([L, distance])
    there = np.isfinite(both)
    both = np.where(there, both, 0.0)
    each_row, each_column = np.maximum(there.sum(axis=1), 1), np.maximum(there.sum(axis=0), 1)
    fit = np.zeros(both.shape[1])
    for _ in range(_SWEEPS):
        before, row = fit, -(both.sum(axis=1) + there @ fit) / each_row
        fit = -(both.sum(axis=0) + row @ there) / each_column
        fit = fit - fit[-1]
        if np.abs(fit - before).max() < 0.1:
            break
    column = fit[:-1]
    for _ in range(3):
        T = L + column
        top = T.max(axis=1, initial=-np.inf)
        usable = np.isfinite(distance) & np.isfinite(top)
        if not usable.any():
            break
        off = np.where(usable, distance - np.where(usable, top, 0.0), np.inf)
        usable &= np.abs(off - np.median(off[usable])) <= 40
        ruled = usable[:, None] & (T >= np.where(usable, top, np.inf)[:, None] - 4)
        count = ruled.sum(axis=0)
        middle = np.sort(np.where(ruled, reach, np.inf), axis=0)[np.maximum(count - 1, 0) // 2]
        column = np.where(count > 0, np.diagonal(middle), column)
    column = np.round(column)
    T = L + column
    top = T.max(axis=1, initial=-np.inf)
    top = np.where(np.isfinite(top), top, np.where(np.isfinite(distance), distance, 0.0))
    return np.exp2(-np.round(top)), np.exp2(column)


def maximise(d: np.ndarray, G: np.ndarray, g: np.ndarray) -> Optimum:
    """Maximise d'x over G x <= g, as `Program.maximise` does."""
    return Program(G, g).maximise(d)


def cleaned(value: np.ndarray, size: Any) -> np.ndarray:
    """Return sums with 0 in place of those that are rounding beside their terms, of this size."""
    return np.where(np.abs(value) < 16 * np.finfo(float).eps * size, 0.0, value)


def bound(d: np.ndarray, y: np.ndarray, G: np.ndarray, g: np.ndarray, extent: np.ndarray) -> float:
    """Return an upper bound of d'x over G x <= g, |x| <= extent, from any multipliers y >= 0:

        d'x = y'G x + (d - G'y)'x <= y'g + |d - G'y|'extent,

    valid for any error of a program (Neumaier & Shcherbina 2004, Math. Programming 99)."""
    left = np.abs(d - G.T @ y)
    off = left > 0
    return float(y @ g + left[off] @ extent[off])


def extent(G: np.ndarray, g: np.ndarray, axes: Any = None) -> np.ndarray:
    """Return max |x_i| over G x <= g for each i of `axes` (None: all), by two programs each; inf
    where the set is unbounded."""
    return np.max(np.abs(Program(G, g).bounds(axes)), axis=0)


def safe_extent(G: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Return bounds of |x_i| over G x <= g that outweigh the error of the programs that find them:
    larger by a part in 10^6."""
    return extent(G, g) * (1 + 1e-6)


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
