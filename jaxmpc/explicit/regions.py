"""Explicit solutions: critical regions of parametric QPs and MPC problems, law and value."""

import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from jaxmpc.arrays import Reals, host_array
from jaxmpc.checks import fail, number, require_kind, whole
from jaxmpc.explicit.active_sets import (
    DEPENDENT,
    REACH,
    Cell,
    FreeParameters,
    LeastDistanceForm,
    cell,
    far_vertices,
    least_distance_form,
)
from jaxmpc.explicit.parametric_program import ParametricQP
from jaxmpc.mpc.problem import MPC
from jaxmpc.pytrees import record
from jaxmpc.sets.convex_sets import Box, Polytope
from jaxmpc.sets.geometry import hull_volume, unit_rows
from jaxmpc.sets.lp import ROUNDING, maximise_nonnegative, scaling

# Residual of the optimality conditions at a vertex, relative to the size of the terms, up to which
# a region counts as one of the program as given.
OPTIMAL = 1e-6
# The fraction of the volume, and the distance of a facet in coordinates where X_N just fits into
# [−1, 1]^n, up to which the regions must fill X_N.
FILL = 1e-9
# How far beyond a facet the region behind it is looked for, relative to the facet's region.
BEYOND_FACETS = (1e-2, 1e-4, 1e-6)
# Rounds of the search from what is missing, and random points of X_N from which each starts again.
REPAIRS, RESTARTS = 20, 50
DIMENSIONS = 6
# An unbounded set is looked at through windows, up to so many, until one holds all vertices with so
# much room on each side.
WINDOWS, ROOM = 8, 8.0


@record
class Region:
    """One critical region and its affine law, in the p parameters θ, such as the state.

    On the region the optimum is z = Z θ + z0, its multipliers are y = L θ + l0 for the cost without
    ½ (y ≥ 0 at an upper bound, y ≤ 0 at a lower one, any sign where both are equal; the last rows
    are those of equalities that the rows imply, if there are any), the law is K θ + k: the first
    input of an MPC, a prestabilising gain included. The cost is ½ θ'V θ + v'θ + v0.

    rows (a,): active rows of `Condensed.C`, or of `ParametricQP.G`.
    Z (nz, p), z0 (nz,): of the optimum. L (a, p), l0 (a,): of the multipliers.
    K (m, p), k (m,): of the law. V (p, p), v (p,), v0: of the cost.
    also_active: rows that are active all over the region and depend on `rows`.
    polytope: irredundant unit rows in θ, and where equalities tie the parameters to each other
    these as two rows each. vertices (k, p): of what lies in the window. volume: in the free
    parameters; inf where the region reaches beyond the window.
    """

    rows: np.ndarray
    also_active: np.ndarray
    Z: np.ndarray
    z0: np.ndarray
    L: np.ndarray
    l0: np.ndarray
    K: np.ndarray
    k: np.ndarray
    V: np.ndarray
    v: np.ndarray
    v0: float
    polytope: Polytope
    vertices: np.ndarray
    volume: float


@record
class CriticalRegions:
    """Critical regions of a parametric QP: the polytopes on which its optimum is affine.

    Of an MPC problem the parameters are x0, or (x, u_{−1}) where input rates matter, and X_N holds
    those with u_{−1} in the input limits. Else X_N is the set of parameters with a feasible z.

    problem: whose they are. regions: all of them, if complete.
    complete: the regions fill X_N, i.e. the volumes sum to that of the hull of all vertices, and
    no support LP over the rows as given finds a point of X_N beyond a facet of that hull (both to
    1e-9 of its size); and at the vertices of each, hence all over it, the law meets the optimality
    conditions of the program as given, to 1e-6 of their terms. Where X_N is unbounded all this was
    checked in the window. window (2, d): lower and upper bounds of the free parameters, which
    hold the vertices of all regions in the inner eighth; None where X_N is bounded. If regions
    reach beyond it, they do as their rows say.
    free (d,): the indices of the free parameters; where equalities tie the others to these, volumes
    are in these. volume: the sum. reason: what was checked, or what stopped the search.
    references: `reference` and `input_reference`, where plans of an MPC track these.
    """

    problem: MPC | ParametricQP
    regions: tuple[Region, ...]
    complete: bool
    volume: float
    reason: str
    seconds: float
    free: tuple[int, ...]
    window: np.ndarray | None
    references: dict[str, Any]

    @classmethod
    def of(
        cls, problem: MPC | ParametricQP, search: "RegionSearch", **references: Any
    ) -> "CriticalRegions":
        """Return what a search has found, in the coordinates of θ, and whether it fills X_N."""
        complete, reason = search.fill()
        p = search.p
        found = [region(p, c) for c in search.found]
        worst = max((residual(p, r) for r in found), default=0.0)
        reason += f"; optimality conditions of the program as given hold to {worst:.0e}"
        if not worst <= OPTIMAL:
            complete = False
            reason += ", which is no law: the program is too ill-conditioned"
        regions = tuple(in_all_parameters(p.given.parameters, r) for r in found)
        total = float(sum(r.volume for r in regions))
        seconds = time.perf_counter() - search.begun
        window = None
        if p.window.open:
            window = np.array([p.window.lower, p.window.upper])
            complete = complete and search.seen <= 1 / ROOM
            reason += f"; its vertices lie in {search.seen:.1e} of a window onto the unbounded set"
        free = tuple(p.given.parameters.free.tolist())
        given = {name: value for name, value in references.items() if value is not None}
        return cls(problem, regions, complete, total, reason, seconds, free, window, given)

    @property
    def mpc(self) -> MPC:
        """Return the MPC problem; ValueError where the regions are of a ParametricQP."""
        if not isinstance(self.problem, MPC):
            fail("regions", "are those of a ParametricQP", "Give the regions of an MPC problem")
        return self.problem

    def __len__(self) -> int:
        return len(self.regions)

    def __getitem__(self, i: int) -> Region:
        return self.regions[i]

    def __repr__(self) -> str:
        """Return how many regions there are, and what was checked."""
        what = "fill X_N" if self.complete else "do not fill X_N"
        return (
            f"CriticalRegions: {len(self)} regions {what}, volume {self.volume:.6g}; {self.reason}"
        )

    @property
    def tied(self) -> bool:
        """Return whether equalities tie parameters to each other: regions have no volume then."""
        return len(self.free) < self.problem.dimension

    def find(self, x0s: Reals, tolerance: float = 1e-9) -> np.ndarray:
        """Return the index of the region that holds θ (p,), −1 where none does, or (B,) of each θ
        of x0s (B, p).

        tolerance: how far outside all regions a θ may lie, relative to the width of X_N across
        the facet that it exceeds.
        """
        number("tolerance", tolerance, -np.inf, "Give one number")
        x, shape = self._states(x0s)
        H, h, starts = self.facets
        answer = np.full(len(x), -1)
        finite = np.flatnonzero(np.all(np.isfinite(x), axis=1))
        if not len(h):  # one region that is all of R^p
            answer[finite] = 0
            return answer.reshape(shape)
        for i in range(0, len(finite), 256):
            chunk = finite[i : i + 256]
            beyond = np.maximum.reduceat((x[chunk] @ H.T - h) / self._widths, starts, axis=1)
            near = beyond.min(axis=1) <= tolerance
            answer[chunk] = np.where(near, beyond.argmin(axis=1), -1)
        return answer.reshape(shape)

    def plan(self, x0s: Reals) -> np.ndarray:
        """Return optimal z (nz,) at parameters θ (p,), or (B, nz) at x0s (B, p); NaN where no
        region holds them."""
        return self._evaluate(x0s, lambda r, x: x @ r.Z.T + r.z0, len(self.regions[0].z0))

    def law(self, x0s: Reals) -> np.ndarray:
        """Return the law (m,) at parameters θ (p,), or (B, m) at x0s (B, p): first inputs u_0 of an
        MPC; NaN where no region holds them."""
        return self._evaluate(x0s, lambda r, x: x @ r.K.T + r.k, len(self.regions[0].k))

    def value(self, x0s: Reals) -> np.ndarray:
        """Return the least cost at parameters θ (p,), or (B,) at x0s (B, p), NaN where no region
        holds them: a piecewise quadratic function."""
        return self._evaluate(x0s, lambda r, x: (x @ r.V / 2 * x).sum(axis=1) + x @ r.v + r.v0)

    def _evaluate(
        self, x0s: Reals, function: Callable[[Region, np.ndarray], np.ndarray], *size: int
    ) -> np.ndarray:
        """Return function(r, x) (k, *size) of each θ, r the region that holds θ (k, p); NaN where
        none does."""
        x, shape = self._states(x0s)
        where = self.find(x)
        values = np.full((len(x), *size), np.nan)
        for i in np.unique(where[where >= 0]):
            values[where == i] = function(self.regions[i], x[where == i])
        return values.reshape((*shape, *size))

    def _states(self, x0s: Reals) -> tuple[np.ndarray, tuple[int, ...]]:
        """Return parameters as rows (B, p), and the shape of one number for each: () or (B,)."""
        x, p = host_array("x0s", x0s, copy=False), self.problem.dimension
        if x.ndim not in (1, 2) or x.shape[-1] != p:
            fail("x0s", f"shape {x.shape}", f"Give one state ({p},) or states (B, {p})")
        return np.atleast_2d(x), x.shape[:-1]

    @cached_property
    def facets(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the rows H x ≤ h of all regions, region after region, and where each begins."""
        H = [np.asarray(region.polytope.H) for region in self.regions]
        h = np.concatenate([np.asarray(region.polytope.h) for region in self.regions])
        return np.vstack(H), h, np.cumsum([0] + [len(part) for part in H[:-1]])

    @cached_property
    def _widths(self) -> np.ndarray:
        """Return the width of X_N across each facet; across a fixed parameter its size."""
        points = np.concatenate([region.vertices for region in self.regions])
        normals = np.abs(self.facets[0])
        width, size = normals @ np.ptp(points, axis=0), normals @ np.abs(points).max(axis=0)
        return np.where(width > ROUNDING * size, width, np.where(size > 0, size, 1.0))


def critical_regions(
    problem: MPC | ParametricQP,
    within: Box | Polytope | None = None,
    *,
    reference: Reals | None = None,
    input_reference: Reals | None = None,
    max_regions: int = 5000,
    seconds: float = np.inf,
) -> CriticalRegions:
    """Return all critical regions of positive volume of a multi-parametric QP.

    problem: a `ParametricQP`, or an MPC problem, whose parameters are the state x, or (x, u_{−1})
    with u_{−1} within `mpc.inputs` where input rates matter, as for `feasible_polytope`;
    `parametric_qp` makes references parameters. within: the set of parameters that matter, None
    for all. Equalities that rows imply, as two opposite ones do, are taken out first; where they
    tie parameters to each other, regions are those of the parameters that are left free. The set
    may be unbounded. reference, input_reference: what the plans of an MPC track, as in `solve`;
    None for zero.

    max_regions: the most regions to look for. seconds: after which the search stops (some linear
    programs and the hull of all vertices are finished; in five and six dimensions that may take
    long). The search crosses every facet of every region: a row that becomes active joins the
    active set, a multiplier that vanishes leaves it, and where the new row depends on the others
    each of those that the dual ratio test may drop is tried; what this leaves open is found by
    solving the QP just behind the facet. `complete` does not rest on the search having ended but
    on the volumes (see `CriticalRegions`). NumPy in float64; not traceable.

    Raises ValueError for ill-posed problems, soft rows or an ellipsoidal terminal set (their
    laws are not piecewise affine in this form), where P leaves the optimum open, and where X_N is
    empty or flat.

    Sources: Bemporad, Morari, Dua & Pistikopoulos 2002, Automatica 38; Tøndel, Johansen &
    Bemporad 2003, Automatica 39 (crossing facets by active sets); Lawson & Hanson 1974, ch. 23
    (least distance by NNLS).
    """
    number("seconds", seconds, 0, "Give a time limit in seconds")
    deadline = time.monotonic() + seconds
    require_kind("problem", problem, MPC, ParametricQP)
    problem.validate()
    references: dict[str, Any] = {"reference": reference, "input_reference": input_reference}
    for name, value in references.items():
        if value is not None and isinstance(problem, ParametricQP):
            fail(name, "given with a ParametricQP", "Give the MPC problem, or let q hold it")
    if isinstance(problem, MPC) and problem.soft:
        fail("mpc.soft", "has rows, and slacks make another QP", "Make the rows hard first")
    reach = REACH
    for _ in range(WINDOWS):
        form = least_distance_form(problem, within, reach, **references)
        search = explore(form, max_regions, deadline)
        seen = search.seen
        if seen <= 1 / ROOM or search.full:
            break
        reach *= max(4.0, 2 * ROOM * seen)
    return CriticalRegions.of(problem, search, **references)


# --- The search, across facets ----------------------------------------------------------


class RegionSearch:
    """Breadth-first search across facets, from random points again until X_N is full. cells: active
    set → region, None for no volume."""

    def __init__(self, p: LeastDistanceForm, max_regions: int, deadline: float = np.inf) -> None:
        self.p, self.max_regions, self.deadline = p, max_regions, deadline
        self.begun = time.perf_counter()
        self.random = np.random.default_rng(0)
        self.cells: dict[tuple[int, ...], Cell | None] = {}
        self.found: list[Cell] = []
        self.queue: deque[Cell] = deque()

    @property
    def full(self) -> bool:
        """Return True once there are `max_regions`, or the deadline."""
        return len(self.found) >= self.max_regions or self.late

    @property
    def seen(self) -> float:
        """Return how far the vertices of all regions lie from the point inside, relative to the
        window; 0 for a bounded set."""
        p, found = self.p, [0.0]
        for c in self.found if p.window.open else ():
            vertices = c.vertices
            if any(np.all(p.row[rows] == -2) for rows in c.behind):
                vertices = far_vertices(p, c.law.active)
            found.append(p.window.fraction(p.center + vertices * p.size))
        return max(found)

    @property
    def late(self) -> bool:
        """Return True once the deadline, of `time.monotonic`, is over."""
        return time.monotonic() > self.deadline

    def visit(self, active: tuple[int, ...] | None) -> Cell | None:
        """Return the region of an active set, and queue it when it is new."""
        if active is None:
            return None
        active = tuple(sorted(active))
        if active not in self.cells:
            new = cell(self.p, active)
            self.cells[active] = new
            if new is not None:
                self.found.append(new)
                self.queue.append(new)
        return self.cells[active]

    def cross_all(self) -> None:
        """Cross every facet of every queued region."""
        while self.queue and not self.full:
            here = self.queue.popleft()
            for i in range(len(here.h)):
                if not self.full:
                    self.cross(here, i)

    def cross(self, here: Cell, i: int) -> None:
        """Visit the regions behind facet i."""
        candidates: list[tuple[int, ...]] = []
        for row in here.behind[i].tolist():
            beyond = exchange(self.p, here.law.active, row)
            if beyond is None:  # the facet bounds X_N
                return
            candidates += beyond
        reached = [self.visit(active) for active in candidates]
        middle = here.middles[i]
        if any(c is not None and c.touches(middle) for c in reached):
            return
        # Several rows vanish on the facet at once: look just behind it.
        for step in BEYOND_FACETS:
            behind = self.visit(self.p.active(middle + step * here.radius * here.H[i]))
            if behind is not None and behind.touches(middle):
                return

    def restart(self) -> None:
        """Search on from random points of X_N, those in no region yet: on chords between points
        where rays from the interior point leave it."""
        n = len(self.p.center)
        for _ in range(RESTARTS):
            if self.full:
                return
            ends = [self.p.leave(d) for d in self.random.standard_normal((2, n))]
            if ends[0] is None or ends[1] is None:
                continue
            chord = ends[0] + self.random.random() * (ends[1] - ends[0])
            point = self.p.interior + self.random.random() * (chord - self.p.interior)
            if not any(np.all(c.H @ point <= c.h) for c in self.found):
                self.visit(self.p.active(point))
                self.cross_all()

    def fill(self) -> tuple[bool, str]:
        """Check that the regions fill X_N, and search on from what is missing; return (complete,
        reason)."""
        random, stale = self.random, 0
        why = ""
        for _ in range(REPAIRS):
            if self.late:
                return False, f"stopped by the time limit, after {len(self.found)} regions"
            if self.full:
                return False, f"stopped at the limit of {self.max_regions} regions"
            points = np.concatenate([c.vertices for c in self.found])
            try:
                volumes = sum(hull_volume(c.vertices, thin=True) for c in self.found)
                whole = hull_volume(points, thin=True)
                hull = Polytope.from_points(points).require_body()
            except ValueError as error:
                return False, f"the hull of all regions is not found ({error})"
            tops = [self.p.support(a) for a in np.asarray(hull.H) if not self.late]
            if self.late:
                continue
            beyond = np.array([value for value, _ in tops]) - np.asarray(hull.h)
            gap = 1 - volumes / whole
            why = (
                f"the volumes of the regions sum to that of their hull (relative gap {gap:.0e}); "
                f"X_N reaches beyond its {len(beyond)} facets by {max(beyond.max(), 0):.0e}, "
                "relative to its size, by one linear program each over all rows as given"
            )
            if beyond.max() <= FILL and abs(gap) <= FILL:
                return True, why
            before = len(self.found)
            for (_, corner), far in zip(tops, beyond, strict=True):
                if corner is not None and far > FILL:
                    inside = self.p.interior + (corner - self.p.interior) * (1 - 1e-6)
                    self.visit(self.p.active(inside))
            for c in list(self.found):
                if self.full:
                    break
                for middle, normal in zip(c.middles, c.H, strict=True):
                    corner = c.vertices[random.integers(len(c.vertices))]
                    # Anywhere on the facet, which is convex, and a little behind it.
                    to = corner - normal * (normal @ (corner - middle))
                    point = middle + 0.9 * random.random() * (to - middle)
                    self.visit(self.p.active(point + 1e-6 * c.radius * normal))
            self.cross_all()
            self.restart()
            stale = 0 if len(self.found) > before else stale + 1
            if stale == 2:
                break
        return False, why.replace("the volumes of", "a part was not found: the volumes of")


def explore(p: LeastDistanceForm, max_regions: int, deadline: float = np.inf) -> RegionSearch:
    """Run the search from an interior point across all facets, until the deadline of
    `time.monotonic`, and return it."""
    max_regions = whole("max_regions", max_regions, 1)
    if len(p.center) > DIMENSIONS:
        what = f"has {len(p.center)} parameters, too many for vertices"
        cure = f"Regions serve up to {DIMENSIONS}; exact_penalty(method='samples') serves more"
        fail("mpc", what, cure)
    search = RegionSearch(p, max_regions, deadline)
    search.visit(p.active(p.interior))
    search.cross_all()
    for _ in range(REPAIRS):
        if search.found or search.late:
            break
        search.restart()
    if not search.found:
        fail("mpc", "no critical region was found: too ill-conditioned", "Scale states and inputs")
    return search


def exchange(
    p: LeastDistanceForm, active: tuple[int, ...], row: int
) -> list[tuple[int, ...]] | None:
    """Return the active sets behind a facet on which `row` vanishes; None where nothing is feasible
    there.

    A multiplier that vanishes: its row leaves. A row that becomes active joins; if it depends on
    the active ones, M_row = Σ α_j M_j, its multiplier t changes theirs to λ_j − t α_j, and one
    with α_j > 0 leaves. Without such a j, M_row + Σ|α_j| M_j = 0 is a Farkas certificate.
    """
    rows = [j for j in active if j != row]
    if len(rows) < len(active):
        return [tuple(rows)]
    if p.zero_row[row]:
        return None
    Q, R = np.linalg.qr(p.M[rows].T)
    along = Q.T @ p.M[row]
    if np.linalg.norm(p.M[row] - Q @ along) > DEPENDENT:
        return [(*active, row)]
    alpha = np.linalg.solve(R, along)
    leaving = np.flatnonzero(alpha > 1e-9 * np.abs(alpha).max(initial=0.0))
    if not len(leaving):
        return None
    return [(*(k for k in active if k != rows[j]), row) for j in leaving]


# --- From cells to regions, with their law in x -----------------------------------------


def region(p: LeastDistanceForm, c: Cell) -> Region:
    """Return a cell in the free parameters x, with the laws of z, the multipliers and the value."""
    n, rows, given = len(p.center), list(c.law.active), p.given
    L, l0 = p.in_states(c.law.multipliers)
    Y, y0 = p.in_states(c.law.y)
    W = np.linalg.solve(p.factor.T, Y - p.shift[:, :n])
    w0 = np.linalg.solve(p.factor.T, y0 - p.shift[:, n])
    S, N = p.hull.basis[n:, :n], p.hull.basis[n:, n:]
    Z, z0 = S + N @ W, p.hull.shift[n:] + N @ w0
    sign = p.side[rows] / p.length[rows]
    L, l0 = sign[:, None] * L, sign * l0
    # The sides of the window are no facets.
    own = [i for i, behind in enumerate(c.behind) if np.any(p.row[behind] != -2)]
    H, h = c.H[own] / p.size, c.h[own] + c.H[own] / p.size @ p.center
    vertices = p.center + c.vertices * p.size
    active = p.row[rows]
    if p.hull.equal.any():
        tied, both = of_equalities(p, active, np.column_stack([L, l0]), Z, z0, vertices)
        active = np.append(active, tied)
        L, l0 = np.vstack([L, both[:, :-1]]), np.append(l0, both[:, -1])
    PZ, alone = given.P @ Z, given.alone
    ends = len(own) < len(c.h)
    return Region(
        rows=active,
        also_active=p.row[list(c.law.also_active)],
        Z=Z,
        z0=z0,
        L=L,
        l0=l0,
        K=given.output.direct + given.output.gain @ Z,
        k=given.output.gain @ z0 + given.output.constant,
        V=Z.T @ PZ + Z.T @ given.F + given.F.T @ Z + alone.Y,
        v=PZ.T @ z0 + Z.T @ given.f + given.F.T @ z0 + alone.y,
        v0=float(z0 @ (given.P @ z0 / 2 + given.f) + alone.c),
        polytope=Polytope(*unit_rows(H, h)),
        vertices=vertices,
        volume=np.inf if ends else hull_volume(c.vertices, thin=True) * float(np.prod(p.size)),
    )


def in_all_parameters(free: FreeParameters, r: Region) -> Region:
    """Return a region of the free parameters x as one of all parameters θ."""
    if not free.tied:
        return r
    p, index = len(free.shift), free.free
    V, v = np.zeros((p, p)), np.zeros(p)
    V[np.ix_(index, index)], v[index] = r.V, r.v
    rows = np.vstack([free.widened(np.asarray(r.polytope.H)), free.rows, -free.rows])
    return replace(
        r,
        Z=free.widened(r.Z),
        L=free.widened(r.L),
        K=free.widened(r.K),
        V=V,
        v=v,
        polytope=Polytope(
            *unit_rows(rows, np.concatenate([r.polytope.h, free.offsets, -free.offsets]))
        ),
        vertices=free.shift + r.vertices @ free.basis.T,
    )


def of_equalities(
    p: LeastDistanceForm,
    active: np.ndarray,
    L: np.ndarray,
    Z: np.ndarray,
    z0: np.ndarray,
    vertices: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the condensed rows of the implied equalities and their multipliers, affine in (x, 1).

    They balance what is left of the gradient, E'y = −(P z + F x + f + C_a'y_a). One-sided rows that
    imply equalities have E'ν = 0 for some ν > 0: so much of ν is added that y ≥ 0 on the region.
    """
    given = p.given
    usable = np.flatnonzero(p.hull.equal & (given.row >= 0))
    left = given.P @ np.column_stack([Z, z0]) + np.column_stack([given.F, given.f])
    left = -(left + given.coefficients[active].T @ L)
    row, column = scaling(given.C[usable], np.zeros(len(usable)))
    E = row[:, None] * given.C[usable] * column
    y = np.linalg.lstsq(E.T, column[:, None] * left, rcond=1e-10)[0]
    # ν = 1 + μ with μ ≥ 0 as small as possible
    more = maximise_nonnegative(-np.ones(len(E)), E.T, -E.sum(axis=0))
    if more is not None:
        lowest = (y @ np.column_stack([vertices, np.ones(len(vertices))]).T).min(axis=1)
        y[:, -1] += max(np.max(-lowest / (1 + more)), 0.0) * (1 + more)
    y *= row[:, None] * given.side[usable][:, None]
    rows = np.unique(given.row[usable])
    return rows, np.array([y[given.row[usable] == i].sum(axis=0) for i in rows])


def residual(p: LeastDistanceForm, r: Region) -> float:
    """Return the largest residual of the optimality conditions of the program as given at the
    vertices of a region, each relative to the size of its terms.

    All four conditions are affine in x under the region's law, so that its vertices stand for it.
    """
    x, given = r.vertices, p.given
    z, y = x @ r.Z.T + r.z0, x @ r.L.T + r.l0
    # In columns of like size, with entries that are rounding beside those of their row left out.
    # An optimum may be zero: it is the difference of terms as large as the unconstrained one, and
    # where this is zero too, rounding is relative to the limits.
    one = np.column_stack([x, np.ones(len(x))])
    free = np.abs(np.linalg.solve(p.factor.T, p.shift @ one.T))
    basis = np.abs(p.hull.basis[x.shape[1] :, x.shape[1] :])
    reach: np.ndarray = basis @ free
    size_z = np.abs(z).max(axis=0) + reach.max(axis=1, initial=0.0)
    limits = given.program.column[x.shape[1] :]
    size_z = np.where(size_z > ROUNDING * limits, size_z, limits)
    terms = np.abs(given.C) @ size_z + np.abs(given.D) @ np.abs(x).max(axis=0) + np.abs(given.b)
    terms = np.where(terms > 0, terms, 1.0)
    gap = (z @ given.C.T + x @ given.D.T - given.b) / terms
    primal = gap.max(initial=0.0)
    coefficients = given.coefficients
    total = np.zeros((len(x), len(coefficients)))
    np.add.at(total.T, r.rows, y.T)
    gradient = z @ given.P.T + x @ given.F.T + given.f + total @ coefficients
    parts = size_z @ np.abs(given.P) + np.abs(x).max(axis=0) @ np.abs(given.F).T + np.abs(given.f)
    parts = parts + np.abs(total).max(axis=0) @ np.abs(coefficients)
    parts = np.where(parts > 0, parts, 1.0)
    dual = (np.abs(gradient) / parts).max(initial=0.0)
    # y > 0 only on an upper bound that is met, y < 0 only on a lower one: or so small that the
    # gradient does without.
    share = (np.abs(coefficients) / parts).max(axis=1, initial=0.0)
    wrong = [0.0]
    for side in (1.0, -1.0):
        mine = (given.side == side) & (given.row >= 0)
        met = np.zeros(len(coefficients), bool)
        met[given.row[mine]] = np.abs(gap[:, mine]).max(axis=0) <= OPTIMAL
        pushed = np.maximum(side * total, 0.0) * share
        wrong.append(float(np.max(pushed[:, ~met], initial=0.0)))
    return float(max(primal, dual, *wrong))
