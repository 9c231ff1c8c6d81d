"""Linear programs over {x : G x <= g}, in NumPy in float64 (HiGHS): the one place that solves them.

Rows and columns are scaled first, so that no answer depends on the units of a row or a coordinate.
HiGHS' word is taken for an optimum alone, whose multipliers bound it whatever HiGHS' error
(`bound`). That a set is empty or unbounded is said only with a vector that shows it, checked here:

    empty      y >= 0 with G'y = 0 and g'y < 0             (Farkas),
    unbounded  a ray r with G r <= 0 and d'r > 0.

A number counts as zero if it is within the rounding of the terms that it is the sum of.
"""

import threading
from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import highspy
import numpy as np

from jaxmpc.checks import fail

# Entries of scaled rows that are smaller count as zeros: in HiGHS below 1e-9 unless told otherwise,
# and this is the least that it takes.
SMALL_ENTRY = 1e-12
# Options of HiGHS: tolerances in rows and columns that are scaled to about 1. Its presolve calls
# some unbounded programs infeasible and needs scaling of its own, so it is off.
HIGHS = {
    "output_flag": False,
    "presolve": "off",
    "primal_feasibility_tolerance": 1e-10,
    "dual_feasibility_tolerance": 1e-10,
    "small_matrix_value": SMALL_ENTRY,
}
METHODS = "simplex", "ipm"
# By how much an answer of HiGHS may violate scaled rows, well above its tolerance.
MOST_VIOLATION = 1e-7
# A set is flat if its rows keep no larger common margin, relative to its own size.
FLAT = 1e-9
# A sum within this of the sum of its terms' sizes is rounding: well above 2^-53, since the data are
# results of long computations.
ROUNDING = 1e-11
# What is left of G'y in a Farkas vector is charged for points so many times as far as typical ones.
FARTHEST = 1e3
# Sides of rows that are smaller are zeros.
UNDERFLOW = 1e-250
_SWEEPS = 40  # of the least squares of `scaling`; fewer where they end before
# Entries that scaling makes so small, and so much smaller beside the largest of their row than they
# are as given, are doubtful: their column may have a unit that is rounding. Smaller ones than the
# last of these are rounding themselves.
_DOUBTFUL, _SHRUNK, _ENTRY = 2.0**-24, 2.0**-16, 2.0**-40
# So are the units in which a row lets points go farther: to HiGHS 1e20 is no limit.
_BEYOND = 2.0**50
# Sides that are given as large mean no limit.
_NO_LIMIT = 1e15
# A unit fits where points of the set lie within so many units, and not all far below.
_FIT = 8.0
_ROUNDS, _FACTOR = 8, 2.0**20  # of enlarging units, each by so much where there is no end


class Optimum(NamedTuple):
    """A program's maximum (inf: unbounded, -inf: empty, each shown by a checked vector), where it
    is attained (n,), and the multipliers (rows,); None where there is no optimum."""

    value: float
    x: np.ndarray | None = None
    y: np.ndarray | None = None


class Program:
    """Programs over {x : G x <= g}, with equality in the rows of the mask `equal` (None: none).
    along (n,): a direction that is to be maximised, None for any.

    row (rows,), column (n,): powers of two with row_i G_ij column_j and row_i g_i of about 1. They
    come from the data alone, and follow a change of units of any row or coordinate; but where a
    side that is small beside others, such as 5.6e-17 in place of 0, would make the unit of its
    coordinate so small that entries of other rows vanish, the extent of the set decides.
    """

    def __init__(
        self,
        G: np.ndarray,
        g: np.ndarray,
        equal: np.ndarray | None = None,
        along: np.ndarray | None = None,
    ) -> None:
        self.G, self.g = np.asarray(G, np.float64), np.asarray(g, np.float64)
        self.equal = np.zeros(len(self.g), bool) if equal is None else equal
        row, column = scaling(self.G, self.g)
        self._scale(column, row)
        self._fitted, self.along = np.zeros(len(column), bool), along
        self._fit_units(None)
        if along is not None:
            self._fit_units(along)

    def _scale(self, column: np.ndarray, row: np.ndarray | None = None) -> None:
        """Take these units of the coordinates, and of the rows; None: their largest entries."""
        if row is None:
            row = 1 / power_of_two(np.abs(self.G * column).max(axis=1, initial=0.0))
        self.row, self.column = row, column
        self.M, self.b = row[:, None] * self.G * column, row * self.g
        for name in ("_model", "violation", "farkas"):
            self.__dict__.pop(name, None)

    def _vanished(self, d: np.ndarray | None) -> np.ndarray:
        """Return which entries of the rows (rows, n), or of d (1, n), may have vanished, or belong
        to sides beyond all limits, by a unit that is far too small."""
        given = self.G if d is None else d[None]
        size, whole = np.abs(given), self.row[:, None] if d is None else 1.0
        scaled = whole * size * self.column
        relative = lambda v: v / np.maximum(v.max(axis=1, keepdims=True, initial=0.0), 1e-300)
        size, scaled = relative(size), relative(scaled)
        found = (scaled < np.minimum(_DOUBTFUL, _SHRUNK * size)) & (size > _ENTRY)
        if d is None:
            beyond = (self.b > _BEYOND) & (self.g < _NO_LIMIT)
            found |= beyond[:, None] & (scaled > _ENTRY)
        return found

    def _fit_units(self, d: np.ndarray | None) -> None:
        """Let units of doubtful coordinates, of the rows or of d, grow until no point of the set
        lies far beyond them, or no entry is doubtful where the set has no end. If some do not fit
        then, and those as given do, with entries of like size, these are taken; and the first ones,
        unless fewer entries vanish than by these."""
        doubtful = lambda: self._vanished(d).any(axis=0) & ~self._fitted
        columns = doubtful()
        if not columns.any():
            return
        first, lost = (self.column, self.row), self._vanished(d).sum()
        for _ in range(_ROUNDS):
            far = self._extent(columns)
            self._fitted |= columns & (far <= _FIT)
            grown = np.where(far > _FIT, np.where(np.isfinite(far), far, _FACTOR), 1.0)
            self._scale(self.column * power_of_two(grown))
            columns = doubtful() | (columns & (far > _FIT) & np.isfinite(far))
            if not columns.any():
                break
        grown_units = self.column, self.row
        if not self._fits():
            self._scale(np.ones_like(self.column))
            size = np.abs(self.M)
            alike = np.all((size > _DOUBTFUL) | (size < _ENTRY))
            if not (alike and self._fits()):
                self._scale(*grown_units)
        if self._vanished(d).sum() >= lost:
            self._scale(*first)
        self._fitted |= columns

    def _fits(self) -> bool:
        """Return whether the set lies neither far beyond the units nor far below."""
        far = self._extent(np.ones(len(self.column), bool))
        far = far[np.isfinite(far) & (far > 0)]
        return bool(np.all((far < 1e6) & (far > 1e-6)))

    def _extent(self, columns: np.ndarray) -> np.ndarray:
        """Return how far points of the set lie from 0 along these coordinates (n,), in units; inf
        where HiGHS finds no end, 0 for other coordinates."""
        far = np.zeros(len(self.column))
        for j in np.flatnonzero(columns):
            for side in (1.0, -1.0):
                found, _ = self._model.maximise(side * np.eye(len(far))[j])
                far[j] = max(far[j], np.inf if found is None else abs(found[0][j]))
        return far

    def maximise(self, d: np.ndarray) -> Optimum:
        """Maximise d'x: the simplex, then the interior point, then the dual program.

        The multipliers y obey G'y = d and g'y = value up to rounding, and y >= 0 but for
        equalities. Raises ValueError where HiGHS finds neither an optimum nor a vector that shows
        that there is none.
        """
        d = np.asarray(d, np.float64)
        best = self._maximise(d)
        if self.along is None and best.y is not None and self._loses(d, best.y):
            other = Program(self.G, self.g, self.equal, d)
            if np.any(other.column != self.column):
                return other.maximise(d)
        return best

    def _loses(self, d: np.ndarray, y: np.ndarray) -> bool:
        """Return whether multipliers say nothing of an entry of d that may have vanished."""
        left = np.abs(self.G.T @ y - d) > 1e-6 * (np.abs(self.G.T) @ np.abs(y) + np.abs(d))
        return bool(left.any() and np.any(left & self._vanished(d)))

    def _maximise(self, d: np.ndarray) -> Optimum:
        """Return what `maximise` does, in the units that there are."""
        cost = d * self.column
        length = np.abs(cost).max(initial=0.0) or 1.0
        cost = cost / length
        checked = False
        for method in (*METHODS, "dual", "none"):
            found, claim = None, True
            if method == "dual":
                found = self._by_dual(cost)
            elif method != "none":
                found, claim = self._answer(cost, method)
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

    def _answer(
        self, cost: np.ndarray, method: str
    ) -> tuple[tuple[np.ndarray, np.ndarray] | None, bool]:
        """Return what `Model.maximise` does. From the basis of another last column HiGHS may end at
        a point outside the rows: then once more without a basis, and None if that is outside too.
        """
        claim = True
        for _ in range(2):
            found, claim = self._model.maximise(cost, method)
            if found is None or self._within(found[0]):
                return found, claim
            self._model.forget()
        return None, claim

    def _within(self, x: np.ndarray) -> bool:
        """Return whether x keeps the scaled rows to MOST_VIOLATION, of their terms where these are
        above 1: bounds of 1e20 that mean none have others."""
        terms = np.maximum(np.abs(self.M) @ np.abs(x), np.abs(self.b))
        return bool(np.all(self._excess(x) <= MOST_VIOLATION * (1 + terms)))

    def _excess(self, x: np.ndarray) -> np.ndarray:
        """Return by how much x violates each of the scaled rows."""
        excess = self.M @ x - self.b
        return np.where(self.equal, np.abs(excess), excess)

    def change_last_column(self, values: np.ndarray) -> None:
        """Put other values (rows,) in place of the last column of G. The next program begins at the
        basis in which the last one ended."""
        scaled = self.row * values
        self.column[-1] = 1 / power_of_two(np.abs(scaled).max(initial=0.0))
        self.G[:, -1], self.M[:, -1] = values, scaled * self.column[-1]
        if self._vanished(None).any():
            # By the scale of a row whose only entry was rounding, and is no more there.
            self.__init__(self.G, self.g, self.equal)  # type: ignore[misc]
            return
        self._model.change_last_column(self.M[:, -1])
        for name in ("violation", "farkas"):
            self.__dict__.pop(name, None)

    @cached_property
    def _model(self) -> "Model":
        return Model(self.M, self.b, self.equal)

    def bound(self, d: np.ndarray, best: Optimum, extent: np.ndarray) -> float:
        """Return an upper bound of d'x over the set within |x| <= extent, from the multipliers of
        an optimum found for d; the optimum's value, which is infinite, where it has none."""
        return best.value if best.y is None else bound(d, best.y, self.G, self.g, extent)

    def _by_dual(self, cost: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """Solve min b'y with M'y = cost, y >= 0 but for equalities: its multipliers are x."""
        free = np.eye(len(self.b))[~self.equal]
        rows = np.vstack([self.M.T, -free])
        limits = np.append(cost, np.zeros(len(free)))
        found, _ = Model(rows, limits, np.arange(len(rows)) < len(cost)).maximise(-self.b)
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
        off, off_before = (np.abs(self.M.T @ v - cost).max() for v in (better, y))
        if np.all((better >= 0) | self.equal) and off <= off_before:
            y = better
        nearer = x + np.linalg.lstsq(self.M[on], self.b[on] - self.M[on] @ x, rcond=None)[0]
        worst, before = ((self.M @ v - self.b).max(initial=0.0) for v in (nearer, x))
        return (nearer if worst <= max(before, 1e-14) else x), y

    @cached_property
    def violation(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Return (x, y, t) of the least t with M x <= b + t, t >= -1, in scaled coordinates: y are
        the multipliers, with a sum of 1 if t > -1."""
        M = np.vstack([self.M, -self.M[self.equal], np.zeros((1, self.M.shape[1]))])
        b = np.concatenate([self.b, -self.b[self.equal], [1.0]])
        M = np.column_stack([M, -np.ones(len(M))])
        model = Model(M, b, np.zeros(len(b), bool))
        for method in METHODS:
            found, _ = model.maximise(-np.eye(M.shape[1])[-1], method)
            if found is not None:
                x, y, count = found[0][:-1], found[1].copy(), len(self.b)
                y[:count][self.equal] -= y[count:-1]
                return x, y[:count], float(self._excess(x).max(initial=-1.0))
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
            far = FARTHEST * (1 + np.abs(x))
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
        model = Model(box, limits, equal)
        # Rows of about 1 that let a point go 1e12 times as far as it typically does are no limits;
        # HiGHS takes their entries for zeros.
        M = np.where(np.abs(self.M) < SMALL_ENTRY, 0.0, self.M)
        for method in METHODS:
            found, _ = model.maximise(cost, method)
            if found is None:
                continue
            r = np.where(np.abs(found[0]) < 1e-12, 0.0, found[0])
            off, size = M @ r, np.abs(M) @ np.abs(r)
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

    def bounds(self, axes: Sequence[int] | None = None) -> tuple[np.ndarray, np.ndarray]:
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
        for method, part in (("simplex", free), ("simplex", free | True), ("ipm", free)):
            found, _ = Model(M[part], b[part], equal[part]).maximise(np.eye(M.shape[1])[-1], method)
            if found is not None:
                x, y = found[0][:-1], found[1][: len(self.b)]
                slack = np.append((self.b - self.M @ x)[~self.equal], found[0][-1])
                return x * self.column, float(slack.min()), y
        return np.zeros(self.G.shape[1]), -np.inf, np.zeros(len(self.g))


class Model:
    """Programs max cost'x over M x <= b, with equality where `equal`, in HiGHS. The data must be
    scaled. Each program begins at the basis in which the last one ended."""

    def __init__(self, M: np.ndarray, b: np.ndarray, equal: np.ndarray) -> None:
        rows, n = M.shape
        program = highspy.HighsLp()
        program.num_col_, program.num_row_ = n, rows
        program.sense_ = highspy.ObjSense.kMaximize
        program.col_cost_ = np.zeros(n)
        program.col_lower_, program.col_upper_ = np.full(n, -np.inf), np.full(n, np.inf)
        program.row_lower_, program.row_upper_ = np.where(equal, b, -np.inf), b
        matrix, (columns, places) = program.a_matrix_, np.nonzero(M.T)
        matrix.format_ = highspy.MatrixFormat.kColwise
        matrix.start_ = np.searchsorted(columns, np.arange(n + 1))
        matrix.index_, matrix.value_ = places, M[places, columns]
        self.size, self.equal, self._alone = (rows, n), equal, threading.Lock()
        # (Its subclass `Highs` prints a banner when it is made.)
        self.highs = highspy._Highs()  # type: ignore[attr-defined]
        # On ill-conditioned data HiGHS may cycle: its steps are limited.
        steps = 1000 + 20 * (rows + n)
        limits = {"simplex_iteration_limit": steps, "ipm_iteration_limit": steps}
        for name, value in {**HIGHS, **limits}.items():
            self.highs.setOptionValue(name, value)
        if self.highs.passModel(program) == highspy.HighsStatus.kError:
            fail("LP", "holds entries that are not finite", "Give finite rows")

    def change_last_column(self, values: np.ndarray) -> None:
        """Put other values (rows,) in place of the last column of M."""
        rows, n = self.size
        with self._alone:
            for i in range(rows):
                self.highs.changeCoeff(i, n - 1, values[i])

    def forget(self) -> None:
        """Begin the next program anew, without a basis."""
        with self._alone:
            self.highs.clearSolver()

    def maximise(
        self, cost: np.ndarray, method: str = "simplex"
    ) -> tuple[tuple[np.ndarray, np.ndarray] | None, bool]:
        """Return (x, y) of max cost'x, or None where HiGHS does not call it optimal; and whether it
        claims that there is no optimum. method: simplex, or ipm, the interior point."""
        rows, n = self.size
        with self._alone:
            self.highs.changeColsCost(n, np.arange(n, dtype=np.int32), cost)
            self.highs.setOptionValue("solver", method)
            self.highs.run()
            status, solution = self.highs.getModelStatus(), self.highs.getSolution()
            x, y = np.array(solution.col_value), np.array(solution.row_dual)
        if status != highspy.HighsModelStatus.kOptimal:
            return None, status in NO_OPTIMUM
        return (x, np.where(self.equal, y, np.maximum(y, 0.0))), False


# What HiGHS says where it finds that there is no optimum.
NO_OPTIMUM = (
    highspy.HighsModelStatus.kInfeasible,
    highspy.HighsModelStatus.kUnbounded,
    highspy.HighsModelStatus.kUnboundedOrInfeasible,
)


def scaling(G: np.ndarray, g: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return powers of two (row, column) with row_i G_ij column_j and row_i g_i of about 1.

    column_j is how far along x_j the rows that it dominates let a point go, |g_i| / |G_ij|, in the
    median, or the farther of its own two bounds where that is a thousand times less. A row is
    dominated by the entries within a factor of 16 of its largest in scaled columns. So entries of G
    that are rounding have no influence (`_rounding_entries`), nor have distances 1e12 times smaller
    or larger than most, which are rounding or no limits. This starts from the least squares fit of
    the logarithms of [G, g] (Curtis & Reid 1972, J. Inst. Maths Applics 10). Rows follow: their
    largest entry is about 1. A change of units of rows and columns changes the answer by the same
    factors.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        # What is added against underflow, as to bounds of proofs, is no distance.
        every, distance = np.log2(np.abs(G)), np.log2(np.where(np.abs(g) > UNDERFLOW, np.abs(g), 0))
        reach = np.where(np.isfinite(every), distance[:, None] - every, np.inf)
        reach[~np.isfinite(distance)] = np.inf
        L = np.where(_rounding_entries(every, distance, reach), -np.inf, every)
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
    alone = np.isfinite(L) & (np.isfinite(L).sum(axis=1) == 1)[:, None] & np.isfinite(reach)
    bound = np.where(alone, reach, -np.inf).max(axis=0, initial=-np.inf)
    bound = np.where(np.isfinite(bound), bound, np.inf)
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
        column = np.where(column > bound + 10, bound, column)
    column = np.round(column)
    top = (every + column).max(axis=1, initial=-np.inf)
    top = np.where(np.isfinite(top), top, np.where(np.isfinite(distance), distance, 0.0))
    return np.exp2(-np.round(top)), np.exp2(column)


def _rounding_entries(L: np.ndarray, distance: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Return which entries of G are rounding; L and distance are the logarithms of [G, g].

    They are 1e10 times smaller than the largest of their row where each x_j is in units of how far
    along it the nearest row lets a point go. Then either the entry or the distance of that row is
    rounding: that which is smaller beside the largest entry of its row. In many rows such entries
    would pass for another unit of their column. So would one (cos(π/2) = 6e-17 in a rotation)
    beside the largest of its row, where a row with offset 0 ties the two coordinates in a ratio
    1e13 (2^43) times larger, and its own entry is 1e4 (2^14) times farther from being rounding.
    """
    nearest, top = reach.min(axis=0, initial=np.inf), L.max(axis=1, initial=-np.inf)
    known = np.isfinite(nearest)
    if not known.any():
        return np.zeros(L.shape, bool)
    beside, largest, tied = L - top[:, None], L.argmax(axis=1), ~np.isfinite(distance)
    tiny = np.isfinite(reach) & (beside < -27) & tied.any()
    for k in np.unique(largest[tiny.any(axis=1)]):
        ties, of = tied & np.isfinite(L[:, k]), largest == k
        ratio, own = L[ties] - L[ties, k, None], beside[ties, k, None]
        tiny[of] &= beside[of] < np.minimum(ratio - 43, own - 14).max(axis=0, initial=-np.inf)
    if tiny.any():
        without = np.where(tiny, np.inf, reach)
        return tiny | _rounding_entries(np.where(tiny, -np.inf, L), distance, without)
    scaled = np.where(known, L + nearest, -np.inf)
    small = scaled - scaled.max(axis=1, keepdims=True) < -33
    return known & small & (beside < (distance - top)[reach.argmin(axis=0)])


def maximise(d: np.ndarray, G: np.ndarray, g: np.ndarray) -> Optimum:
    """Maximise d'x over G x <= g, as `Program.maximise` does."""
    return Program(G, g).maximise(d)


def maximise_nonnegative(d: np.ndarray, A: np.ndarray, b: np.ndarray) -> np.ndarray | None:
    """Return x of max d'x over A x = b, x >= 0; None where there is no optimum."""
    rows, limits = np.vstack([A, -np.eye(len(d))]), np.append(b, np.zeros(len(d)))
    return Program(rows, limits, np.arange(len(rows)) < len(b)).maximise(d).x


def largest_margin(
    G: np.ndarray, g: np.ndarray, weight: np.ndarray, most: float = np.inf
) -> tuple[np.ndarray | None, float]:
    """Return x and the largest t <= most with G x + t weight <= g; as t inf or -inf with no x where
    there is none."""
    margin = np.eye(G.shape[1] + 1)[-1]
    rows = np.column_stack([G, weight])
    if most < np.inf:
        rows, g = np.vstack([rows, margin]), np.append(g, most)
    top = maximise(margin, rows, g)
    return None if top.x is None else top.x[:-1], top.value


def cleaned(value: np.ndarray, size: np.ndarray | float) -> np.ndarray:
    """Return sums with 0 in place of those that are rounding beside their terms, of this size."""
    return np.where(np.abs(value) < 16 * np.finfo(float).eps * size, 0.0, value)


def bound(d: np.ndarray, y: np.ndarray, G: np.ndarray, g: np.ndarray, extent: np.ndarray) -> float:
    """Return an upper bound of d'x over G x <= g, |x| <= extent, from any multipliers y >= 0:

        d'x = y'G x + (d - G'y)'x <= y'g + |d - G'y|'extent,

    valid for any error of a program (Neumaier & Shcherbina 2004, Math. Programming 99)."""
    left = np.abs(d - G.T @ y)
    off = left > 0
    return float(y @ g + left[off] @ extent[off])


def extent(G: np.ndarray, g: np.ndarray, axes: Sequence[int] | None = None) -> np.ndarray:
    """Return bounds of |x_i| over G x <= g for each i of `axes` (None: all), by two programs each,
    larger by a part in 10^6, which outweighs their error; inf where the set is unbounded."""
    return np.max(np.abs(Program(G, g).bounds(axes)), axis=0) * (1 + 1e-6)


def power_of_two(sizes: np.ndarray | float) -> np.ndarray:
    """Return the powers of two next below sizes, 1 for those that are zero or infinite: units that
    change no digit."""
    usable = np.isfinite(sizes) & (sizes > 1e-200) & (sizes < 1e200)
    return 2.0 ** np.floor(np.log2(np.where(usable, sizes, 1.0)))
