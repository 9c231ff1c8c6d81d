"""Exact penalties: from which weight on slacks the soft problem keeps limits that can be kept."""

import time
from typing import Any, NamedTuple

import numpy as np

from jaxmpc.arrays import Reals, host_array
from jaxmpc.checks import fail, generator, number, require_finite, require_kind, whole
from jaxmpc.explicit.active_sets import (
    SMALLEST,
    ActivePiece,
    LeastDistanceForm,
    active_piece,
    capped_ball,
    least_distance_form,
)
from jaxmpc.explicit.regions import CriticalRegions, exchange, explore
from jaxmpc.mpc.problem import MPC, Soft, as_tuple
from jaxmpc.mpc.rows import Row, row_table
from jaxmpc.pytrees import record
from jaxmpc.qp.status import Status
from jaxmpc.sets.convex_sets import Box, Polytope
from jaxmpc.sets.lp import Program, maximise

# "auto" enumerates regions up to this dimension of the state.
ENUMERATED = 4
# The sampled search: where samples lie on a ray to the boundary of X_N, from how many regions it
# starts, after how many regions without improvement it ends, and how many rays look for the facets
# of a region.
FRACTIONS = (0.5, 0.9, 0.99, 1 - 1e-4, 1 - 1e-7)
STARTS = 32
PATIENCE = 20
RAYS = 64
# Relative rounding of rho_bar up to which a weight is called equal to it.
RHO_ROUNDING = 1e-9
# Row kinds that `soften` makes soft.
SOFTENED = ("state", "output", "terminal")


@record
class ExactPenalty:
    """The least ρ for which the penalty ρ·Σ slack is exact (see `exact_penalty`).

    rho_bar: sup over X_N of the threshold, in cost per unit of the rows as given. at (p,): the
    state where it is approached. row: the soft row that needs it (None where rho_bar is 0).
    label: that row with bound, step and unit. method: "regions" or "samples".
    exact: False where rho_bar is a lower bound. advised: a weight with a margin. thresholds (B,),
    status (B,): at the given states, NaN and PRIMAL_INFEASIBLE or NON_FINITE where there is none.
    sufficient: whether the given weight ρ is exact on all of X_N; None where that is not known, or
    none was given. regions: the critical regions, where they were enumerated. evaluated: number of
    active sets.
    """

    rho_bar: float
    at: np.ndarray
    row: Row | None
    label: str
    method: str
    exact: bool
    advised: float
    thresholds: np.ndarray
    status: np.ndarray
    sufficient: bool | None
    regions: CriticalRegions | None
    evaluated: int

    def __str__(self) -> str:
        """Return `sentence`."""
        return self.sentence

    @property
    def sentence(self) -> str:
        """Return the result and its basis as sentences."""
        value, at = f"{self.rho_bar:.6g}", np.array2string(self.at, precision=6)
        if self.exact:
            found = f"rho_bar = {value} over the feasible set, by {self.evaluated} critical regions"
        else:
            found = f"rho_bar >= {value}: a lower bound, from {self.evaluated} active sets"
            if self.regions is not None and not self.regions.complete:
                found += f" ({self.regions.reason})"
        where = f", reached at x0 = {at} by {self.label}" if self.row else ""
        answer = {
            True: "The weight given is exact.",
            False: "The weight given is too small: limits are violated that can be kept.",
            None: "",
        }[self.sufficient]
        advice = f"Use rho = {self.advised:.6g}" + (
            "." if self.exact else ", which is not guaranteed: watch the slacks."
        )
        return " ".join(part for part in (f"{found}{where}.", answer, advice) if part)


def exact_penalty(
    mpc: MPC,
    x0s: Reals | None = None,
    *,
    reference: Reals | None = None,
    input_reference: Reals | None = None,
    method: str = "auto",
    rho: float | None = None,
    max_regions: int = 2000,
    within: Box | Polytope | None = None,
    samples: int = 200,
    seed: int = 0,
    seconds: float = np.inf,
) -> ExactPenalty:
    """Return the exact-penalty threshold of an MPC problem with an L1 penalty on slacks.

    The soft problem min J + ρ·Σε, C z + D x ≤ bound + ε, ε ≥ 0 has the hard problem's plan at a
    state x of its feasible set X_N if and only if ρ ≥ rho_bar(x) = min over the multipliers λ of
    x of max_i λ_i, i over the soft rows. That holds for J without ½ and rows as given (a row scaled
    by s has λ/s); a quadratic slack term does not change it. rho_bar = sup over X_N.

    The soft rows are those of `mpc.soft`, or if there are none all state, output and terminal rows.
    Rows that no input moves (k = 0) are constants and do not count; inputs and rates stay hard.

    x0s (B, p) or None: states at which to give the threshold as well; p = mpc.dimension.
    reference, input_reference: what the plans track, as in `solve`, None for zero: rho_bar is that
    of these, and may be far larger than that of the origin.
    method: "regions", "samples" or "auto"; see below.
    rho: a weight to check; None: those of `mpc.soft`, if any.
    max_regions: critical regions to enumerate at most.
    within: the set of initial states, needed where X_N is unbounded.
    samples: rays to the boundary of X_N, for the method of this name.
    seconds: after which the search stops, and rho_bar is a lower bound.

    The method "regions" uses that λ is affine on each critical region and its maximum is at a
    vertex; it is exact when the regions are complete. "samples" gives a lower bound, from rays to
    the boundary of X_N and a search across facets from the best regions found (on a region λ is
    maximised by LPs); it can miss the greatest. "auto" takes regions up to four states, and samples
    as well where there are too many of them. Where active rows are dependent the multipliers are
    not unique, and an LP finds those with the least maximum.

    Raises ValueError for ill-posed problems, wrong arguments, an ellipsoidal terminal set, no soft
    row, and where X_N is empty, flat or unbounded. NumPy in float64; not traceable.

    Sources: Fletcher 1987, Practical Methods of Optimization, section 14.3; Kerrigan &
    Maciejowski 2000, Proc. UKACC Control; Hovd & Stoican 2014, Comput. Chem. Eng. 70.
    """
    number("seconds", seconds, 0, "Give a time limit in seconds")
    deadline = time.monotonic() + seconds
    if method not in ("auto", "regions", "samples"):
        fail("method", f"{method!r}", 'Give "auto", "regions" or "samples"')
    samples = whole("samples", samples, 1)
    if rho is not None:
        number("rho", rho, 0, "Give one finite weight of at least 0, or None")
        require_finite("rho", rho)
    require_kind("mpc", mpc, MPC)
    mpc.validate()
    x0s = np.zeros((0, mpc.dimension)) if x0s is None else host_array("x0s", x0s)
    if x0s.ndim != 2 or x0s.shape[1] != mpc.dimension:
        fail("x0s", f"shape {x0s.shape}", f"Give states (B, {mpc.dimension})")

    references: dict[str, Any] = {"reference": reference, "input_reference": input_reference}
    p, table = least_distance_form(mpc, within, **references), row_table(mpc)
    if p.given.parameters.tied:
        what = "its feasible set is flat, as equalities tie the states to each other"
        fail("mpc", what, "Relax one of them")
    if p.window.open:
        i = int(np.argmax(p.window.cut.any(axis=0)))
        fail("mpc", f"its feasible set is unbounded along coordinate {i}", "Give within=jm.Box(…)")
    weigh = Thresholds(p, softened(p, table))
    search = PenaltySearch(p, weigh, generator(seed), deadline)
    regions: CriticalRegions | None = None
    if method == "regions" or (method == "auto" and len(p.center) <= ENUMERATED):
        explored = explore(p, max_regions, deadline)
        regions = CriticalRegions.of(mpc, explored, **references)
        for c in explored.found:
            search.found[c.law.active] = weigh.over(c.law, c.vertices)
    exact = regions is not None and regions.complete
    if method == "samples" or (method == "auto" and not exact):
        search.run(samples)
    worsts = [worst for worst in search.found.values() if worst is not None]
    worst = max(worsts, key=lambda w: w.value, default=Worst(0.0, p.interior, -1))

    value = worst.value
    row = table[p.row[worst.row]] if value > 0 else None
    thresholds, status = weigh.at(x0s)
    return ExactPenalty(
        rho_bar=value,
        at=p.center + p.size * worst.xi,
        row=row,
        label="" if row is None else row_in_words(row, p.side[worst.row]),
        method="regions" if exact or method == "regions" else "samples",
        exact=exact,
        # At rho_bar = 0 every positive weight is exact.
        advised=(1.1 if exact else 2.0) * value if value > 0 else 1.0,
        thresholds=thresholds,
        status=status,
        sufficient=is_sufficient(mpc, value, exact, rho),
        regions=regions,
        evaluated=len(worsts),
    )


def softened(p: LeastDistanceForm, table: tuple[Row, ...]) -> np.ndarray:
    """Return which rows (r,) of the program are soft rows that inputs can move."""
    any_soft = any(row.soft for row in table)
    soft = np.array([row.soft if any_soft else row.kind in SOFTENED for row in table], bool)
    tied = p.given.row[p.hull.equal]
    if len(soft) and np.any((tied >= 0) & soft[tied]):
        what = "has soft rows that imply an equality, which any weight lets plans violate"
        fail("mpc", what, "Keep those rows hard, or give them some width")
    mine = (p.row >= 0) & soft[np.maximum(p.row, 0)] if len(soft) else np.zeros(len(p.row), bool)
    if not mine.any():
        fail("mpc", "has no limit on states or outputs to soften", "Give states, or soft rows")
    return mine & ~p.zero_row


def is_sufficient(mpc: MPC, value: float, exact: bool, rho: float | None) -> bool | None:
    """Return whether the weight rho (None: those of the soft rows) is exact; None where unknown."""
    soft = as_tuple("soft", mpc.soft, Soft)
    given = [np.ravel(np.asarray(s.rho, float)) for s in soft] if rho is None else [np.array([rho])]
    if not given:
        return None
    weights = np.concatenate(given)
    # Rows may have weights of their own: the least decides for, the greatest against.
    if exact and weights.min() >= value * (1 - RHO_ROUNDING):
        return True
    return False if weights.max() < value * (1 - RHO_ROUNDING) else None


def row_in_words(row: Row, side: float) -> str:
    """Return the row as text: "upper bound of dq at k = 3 [rad/s]"."""
    bound = "upper" if side > 0 else "lower"
    spoken = any(sign in row.name for sign in "<>≤≥")
    text = row.name if spoken else f"{bound} bound of {row.name}"
    return f"{text} at k = {row.stage}" + (f" [{row.unit}]" if row.unit else "")


class Worst(NamedTuple):
    """The largest threshold of a region, the ξ where it is approached and the program's row."""

    value: float
    xi: np.ndarray
    row: int


class Thresholds:
    """Least maximal multipliers of the soft rows of a program."""

    def __init__(self, p: LeastDistanceForm, soft: np.ndarray) -> None:
        self.p, self.soft = p, soft

    def least(
        self, rows: np.ndarray, active: tuple[int, ...], multipliers: np.ndarray
    ) -> tuple[float, int]:
        """Return min t over λ ≥ 0 on `rows` with the same Σ λ_i M_i as those on `active` and λ_i ≤
        t over soft rows (NaN: there are none), and a soft row that attains it.
        """
        total = self.p.M[list(active)].T @ np.maximum(multipliers, 0.0)
        mine, size = self.soft[rows], np.abs(total).max(initial=0.0)
        if not mine.any() or size == 0:
            return 0.0, -1
        # In units of that sum, and per row of M; t counts in the rows as given.
        per_row = 1 / self.p.length[rows]
        unit = per_row[mine].max()
        count = len(rows)
        A, b = self.p.balance(rows, total / size)
        least = np.column_stack([np.diag(per_row / unit)[mine], -np.ones(mine.sum())])
        G = np.vstack([np.column_stack([A, np.zeros(len(b))]), least, -np.eye(count + 1)])
        g = np.append(b, np.zeros(len(G) - len(b)))
        top = Program(G, g, np.arange(len(G)) < len(b)).maximise(-np.eye(count + 1)[count])
        if top.x is None:
            return np.nan, -1
        each = np.where(mine, top.x[:count] * per_row, 0.0)
        return float(-top.value * unit * size), int(rows[np.argmax(each)])

    def over(self, found: ActivePiece, points: np.ndarray) -> Worst:
        """Return the largest threshold at points ξ (k, p) of a region, as limits from its inside.

        Inside a region the multipliers of `active` are the only ones, unless other rows are active
        all over it; the threshold is convex there, hence greatest at vertices.
        """
        rows = np.array((*found.active, *found.also_active), int)
        affine = np.column_stack([points, np.ones(len(points))])
        if found.also_active and self.soft[rows].any():
            each = [self.least(rows, found.active, found.multipliers @ at) for at in affine]
            if np.isnan([value for value, _ in each]).any():
                fail("mpc", "no multipliers are found at a vertex", "Scale states and inputs")
            best = int(np.argmax([value for value, _ in each]))
            return Worst(each[best][0], points[best], each[best][1])
        mine = [i for i, row in enumerate(found.active) if self.soft[row]]
        if not mine or found.also_active:
            return Worst(0.0, points[0], -1)
        values = affine @ found.multipliers[mine].T / self.p.length[rows[mine]]
        best, which = np.unravel_index(values.argmax(), values.shape)
        return Worst(max(float(values[best, which]), 0.0), points[best], int(rows[mine[which]]))

    def maximal(self, found: ActivePiece) -> Worst | None:
        """Return the largest threshold of a whole region, each multiplier maximised by an LP; None
        if it is flat.

        Where rows are dependent the LPs maximise multipliers that need not be the least: what they
        lead to is a threshold of the region, but perhaps not the greatest.
        """
        middle, radius = capped_ball(found.H, found.h)
        if radius <= SMALLEST:
            return None
        points = [middle]
        for i, row in enumerate(found.active):
            gain = found.multipliers[i, :-1]
            if self.soft[row] and gain.any():
                corner = maximise(gain, found.H, found.h).x
                points += [] if corner is None else [corner]
        return self.over(found, np.array(points))

    def at(self, x0s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the thresholds (B,) and statuses (B,) at states x0s (B, p)."""
        values, status = np.full(len(x0s), np.nan), np.full(len(x0s), Status.NON_FINITE, np.int8)
        for i in np.flatnonzero(np.all(np.isfinite(x0s), axis=1)):
            xi = (x0s[i] - self.p.center) / self.p.size
            found = self.p.solution(xi)
            if found is not None:
                values[i], _ = self.least(found.touching, found.active, found.multipliers)
                status[i] = Status.ITERATION_LIMIT if np.isnan(values[i]) else Status.SOLVED
            else:
                empty = self.p.margin(xi) < -1e-9
                status[i] = Status.PRIMAL_INFEASIBLE if empty else Status.ITERATION_LIMIT
        return values, status


class PenaltySearch:
    """Search for the region with the largest threshold, by samples and from region to region.

    found: the largest threshold of each active set that was looked at, None without a region.
    """

    def __init__(
        self, p: LeastDistanceForm, weigh: Thresholds, random: np.random.Generator, deadline: float
    ) -> None:
        self.p, self.weigh, self.random, self.deadline = p, weigh, random, deadline
        self.found: dict[tuple[int, ...], Worst | None] = {}

    @property
    def late(self) -> bool:
        """Return True once the deadline, of `time.monotonic`, is over."""
        return time.monotonic() > self.deadline

    def run(self, samples: int) -> None:
        """Look at the regions that samples meet, and climb from the best of them."""
        seen = self._sampled(samples)
        self.visit(self.p.active(self.p.interior))
        for active in sorted(seen, key=seen.__getitem__, reverse=True)[:STARTS]:
            self.visit(active)
        self._climb()

    def visit(self, active: tuple[int, ...] | None) -> None:
        """Find the largest threshold of an active set that is new."""
        if active is not None and active not in self.found:
            here = active_piece(self.p, active)
            self.found[active] = None if here is None else self.weigh.maximal(here)

    def _sampled(self, samples: int) -> dict[tuple[int, ...], float]:
        """Return the active sets met on rays to the boundary of X_N, with their largest loads.

        The rays are at random, and towards points between corners of X_N, where regions are
        smallest.
        """
        p, random, n, half = self.p, self.random, len(self.p.center), samples // 2
        seen: dict[tuple[int, ...], float] = {}
        tops = [p.support(d)[1] for d in random.standard_normal((max(half, 1), n))]
        corners = np.array([xi for xi in tops if xi is not None]).reshape(-1, n)
        weights = random.dirichlet(np.full(max(len(corners), 1), 1 / max(len(corners), 1)), half)
        between = weights @ corners - p.interior if len(corners) else np.zeros((0, n))
        for direction in [*random.standard_normal((samples - half, n)), *between]:
            if self.late:
                break
            end = p.leave(direction)
            for fraction in FRACTIONS if end is not None else ():
                solution = p.solution(p.interior + fraction * (end - p.interior))
                if solution is not None:
                    rows = list(solution.active)
                    loads = (solution.multipliers / p.length[rows])[self.weigh.soft[rows]]
                    active = p.basis(solution) or ()
                    seen[active] = max(seen.get(active, 0.0), loads.max(initial=0.0))
        return seen

    def _climb(self) -> None:
        """Go on from the best region not yet left, across its facets, until PATIENCE regions in
        turn have led to nothing better, or until the deadline."""
        left: set[tuple[int, ...]] = set()
        best, stale = -1.0, 0
        while stale < PATIENCE:
            waiting = {a: w for a, w in self.found.items() if w is not None and a not in left}
            if not waiting or self.late:
                return
            here = max(waiting, key=lambda active: waiting[active].value)
            worst = waiting[here]
            stale = 0 if worst.value > best * (1 + RHO_ROUNDING) else stale + 1
            best = max(best, worst.value)
            left.add(here)
            for row in self._facets(here, worst):
                for active in exchange(self.p, here, row) or []:
                    self.visit(tuple(sorted(active)))

    def _facets(self, active: tuple[int, ...], worst: Worst) -> list[int]:
        """Return rows of facets of a region, those that random rays inside it hit: from its middle,
        and from near the corner where the multiplier is largest."""
        piece = active_piece(self.p, active)
        assert piece is not None
        middle, _ = capped_ball(piece.H, piece.h)
        facets: set[int] = set()
        for start in (middle, middle + 0.95 * (worst.xi - middle)):
            slope = piece.H @ self.random.standard_normal((len(start), RAYS))
            gap = (piece.h - piece.H @ start)[:, None]
            with np.errstate(divide="ignore"):
                facets.update(np.where(slope > 0, gap / slope, np.inf).argmin(axis=0).tolist())
        return sorted(piece.which[list(facets)].tolist())
