"""The explicit solution of an MPC problem: its critical regions, on the host in float64.

With the Cholesky factor P = ℓℓ' of the condensed cost, y = ℓ'z + ℓ⁻¹(F x + f) is the distance
from the unconstrained plan, and the QP at x is a least-distance problem:

    min ½|y|²  subject to  M y ≤ v + V x          (rows of M of length 1).

Where the rows A hold with equality, y = −M_A'λ and M_A M_A'λ = −(v_A + V_A x): plan and
multipliers are affine in x on the polytope where λ ≥ 0 and all other rows hold, the critical
region of A. Seen as a problem with v + δε for a fixed ε > 0 and δ → 0+, every active set has
independent rows; so regions where rows are dependent (duplicates, apexes of a limit) are divided
without overlap, and rows that vanish identically are decided by their first order in δ.
"""

import time
from collections import deque
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.optimize import linprog, nnls
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from jaxmpc.checks import fail
from jaxmpc.control.geometry import distinct
from jaxmpc.control.sets import Box, Polytope, unit_rows
from jaxmpc.mpc.condense import Condensed, condense, in_float64
from jaxmpc.mpc.problem import MPC

# In coordinates where X_N just fits into [−1, 1]^n: the smallest ball of a region, and the
# share of the volume and the distance of a facet up to which the regions must fill X_N.
SMALLEST = 1e-9
FILL = 1e-9
# Rows of length 1 closer to the span of others than this count as dependent on them.
DEPENDENT = 1e-7
# Relative rounding of a law: below it a coefficient is zero.
ZERO = 1e-11
# How far beyond a facet the region behind it is looked for, as a share of the facet's region.
STEPS = (1e-2, 1e-4, 1e-6)
REPAIRS = 20
DIMENSIONS = 6
STOPPED = "HiGHS stopped early on its linear programs", "Scale states and inputs to like size"
LP = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}


@dataclass(frozen=True, eq=False)
class Region:
    """One critical region and its affine law.

    rows (a,): active rows of `Condensed.C`. On the region the optimal decision is z = Z x + z0
    (nz,), its multipliers y = L x + l0 (a,) for the cost without ½ (y ≥ 0 at an upper bound,
    y ≤ 0 at a lower one), the first input u_0 = K x + k (m,), a prestabilising gain included.
    also_active: rows that are active all over the region and depend on `rows`.
    polytope: irredundant unit rows in the p = mpc.dimension coordinates of the state;
    vertices (k, p); volume.
    """

    rows: np.ndarray
    also_active: np.ndarray
    Z: np.ndarray
    z0: np.ndarray
    L: np.ndarray
    l0: np.ndarray
    K: np.ndarray
    k: np.ndarray
    polytope: Polytope
    vertices: np.ndarray
    volume: float


@dataclass(frozen=True, eq=False)
class CriticalRegions:
    """Critical regions of an MPC problem: the polytopes on which its plan is affine in x0.

    complete: the regions fill X_N, i.e. the volumes sum to that of the hull of all vertices, and
    no support LP finds a point of X_N beyond a facet of that hull (both to 1e-9 of its size).
    volume: their sum. reason: what was checked, or what stopped the search.
    """

    mpc: MPC
    regions: tuple[Region, ...]
    complete: bool
    volume: float
    reason: str
    seconds: float

    def __len__(self) -> int:
        return len(self.regions)

    def __getitem__(self, i: int) -> Region:
        return self.regions[i]

    def vertices(self, i: int) -> np.ndarray:
        """(k, p) vertices of region i."""
        return self.regions[i].vertices

    def find(self, x: Any, tolerance: float = 1e-9) -> np.ndarray:
        """(B,) index of the region that holds each state x (B, p), −1 where none does.

        tolerance: how far outside all regions a state may lie, relative to the size of X_N.
        """
        x = self._states(x)
        H, h, starts, size = self._stacked
        answer = np.full(len(x), -1)
        finite = np.flatnonzero(np.all(np.isfinite(x), axis=1))
        for i in range(0, len(finite), 256):
            chunk = finite[i : i + 256]
            excess = np.maximum.reduceat(x[chunk] @ H.T - h, starts, axis=1)
            near = excess.min(axis=1) <= tolerance * size
            answer[chunk] = np.where(near, excess.argmin(axis=1), -1)
        return answer

    def plan(self, x: Any) -> np.ndarray:
        """Optimal decisions z (B, nz) at states x (B, p); NaN where no region holds a state."""
        return self._evaluate(x, "Z", "z0")

    def law(self, x: Any) -> np.ndarray:
        """First inputs u_0 (B, m) at states x (B, p); NaN where no region holds a state."""
        return self._evaluate(x, "K", "k")

    def _evaluate(self, x: Any, gain: str, offset: str) -> np.ndarray:
        x = self._states(x)
        where = self.find(x)
        values = np.full((len(x), len(getattr(self.regions[0], offset))), np.nan)
        for i in np.unique(where[where >= 0]):
            region, here = self.regions[i], where == i
            values[here] = x[here] @ getattr(region, gain).T + getattr(region, offset)
        return values

    def _states(self, x: Any) -> np.ndarray:
        x, p = np.asarray(x, np.float64), self.mpc.dimension
        if x.ndim != 2 or x.shape[1] != p:
            fail("x", f"shape {x.shape}", f"Give states (B, {p})")
        return x

    @cached_property
    def _stacked(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        H = [np.asarray(region.polytope.H) for region in self.regions]
        h = np.concatenate([np.asarray(region.polytope.h) for region in self.regions])
        starts = np.cumsum([0] + [len(part) for part in H[:-1]])
        points = np.concatenate([region.vertices for region in self.regions])
        return np.vstack(H), h, starts, float(np.ptp(points, axis=0).max())


def critical_regions(
    mpc: MPC, *, limit: int = 5000, within: Box | Polytope | None = None
) -> CriticalRegions:
    """All critical regions of positive volume of the MPC problem (multiparametric QP).

    limit: the most regions to look for. within: initial states to look at, needed where the
    feasible set X_N is unbounded. The search crosses every facet of every region: a row that
    becomes active joins the active set, a multiplier that vanishes leaves it, and where the new
    row depends on the others each of those that the dual ratio test may drop is tried; what this
    leaves open is found by solving the QP just behind the facet. `complete` does not rest on the
    search having ended but on the volumes (see `CriticalRegions`). Host, float64.

    Raises ValueError for ill-posed problems, soft rows or an ellipsoidal terminal set (their
    laws are not piecewise affine in this form), and where X_N is empty, flat or unbounded.

    Sources: Bemporad, Morari, Dua & Pistikopoulos 2002, Automatica 38; Tøndel, Johansen &
    Bemporad 2003, Automatica 39 (crossing facets by active sets); Lawson & Hanson 1974, ch. 23
    (least distance by NNLS).
    """
    mpc.validate()
    if mpc.soft:
        fail("mpc.soft", "has rows, and slacks make another QP", "Make the rows hard first")
    return explore(program(mpc, within), limit).report(mpc)


@dataclass(frozen=True, eq=False)
class Program:
    """min ½|y|² s.t. M y ≤ v + V ξ, one-sided rows; x = center + size·ξ with X_N in [−1, 1]^n.

    length (r,): multipliers of the rows as given are those of M divided by it. row (r,): index
    into `condensed`. side (r,): 1 upper, −1 lower. still (r,): M_i = 0, a half-space on ξ alone.
    epsilon (r,): direction of the perturbation. factor: ℓ.
    U: orthonormal columns that span those of M.
    shift (N·m, n + 1): ℓ⁻¹(F, f). interior (n,): ξ with a margin.
    """

    condensed: Condensed
    factor: np.ndarray
    shift: np.ndarray
    M: np.ndarray
    U: np.ndarray
    V: np.ndarray
    v: np.ndarray
    length: np.ndarray
    row: np.ndarray
    side: np.ndarray
    still: np.ndarray
    epsilon: np.ndarray
    center: np.ndarray
    size: np.ndarray
    interior: np.ndarray

    def support(self, d: np.ndarray) -> tuple[float, np.ndarray | None]:
        """max d'ξ over X_N, and where; NaN and None where HiGHS stops."""
        return maximum(d, np.hstack([self.U, -self.V]), self.v)

    def leave(self, direction: np.ndarray) -> np.ndarray | None:
        """Where the ray from the interior point along `direction` leaves X_N; None: not found."""
        t = maximum(
            np.ones(1), np.column_stack([self.U, -self.V @ direction]),
            self.v + self.V @ self.interior,
        )[1]  # fmt: skip
        return None if t is None else self.interior + t * direction

    def margin(self, xi: np.ndarray) -> float:
        """Upper bound of the greatest t ≤ 1 with M y + t ≤ v + V ξ: ξ is outside X_N if t < 0."""
        rows = np.column_stack([self.U, np.ones(len(self.v))])
        rows = np.vstack([rows, np.eye(rows.shape[1])[-1]])
        return maximum(np.ones(1), rows, np.append(self.v + self.V @ xi, 1.0))[0]

    def solve(self, active: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray] | None:
        """λ (a, n + 2) and y (nz, n + 2) on ξ, constant and by δ; None for dependent rows."""
        rows = list(active)
        right = np.column_stack([self.V[rows], self.v[rows], self.epsilon[rows]])
        if not rows:
            return right, np.zeros((self.M.shape[1], right.shape[1]))
        Q, R = np.linalg.qr(self.M[rows].T)
        if len(rows) > len(R) or np.abs(np.diag(R)).min() < DEPENDENT:
            return None
        along = np.linalg.solve(R.T, right)
        return -np.linalg.solve(R, along), Q @ along

    def slack(self, active: tuple[int, ...], y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(r, n + 2): slack of all rows under y; (r,) size of its terms, for rounding.

        Not from the multipliers: these are large, and cancel, where rows are nearly dependent.
        """
        data = np.column_stack([self.V, self.v, self.epsilon])
        slack, terms = data - self.M @ y, np.abs(data) + np.abs(self.M) @ np.abs(y)
        slack[list(active)] = 0.0
        return slack, terms[:, :-1].sum(axis=1)

    def solution(self, xi: np.ndarray) -> "Solution | None":
        """The solution at ξ; None where there is none, or none that keeps all rows to 1e-8."""
        b = self.v + self.V @ xi
        if np.any(b[self.still] < -1e-9):
            return None
        moving = np.flatnonzero(~self.still)
        for allowance in (0.0, 1e-9):  # points on the boundary of X_N may need one
            active: tuple[int, ...] = ()
            worst = -b[moving].min(initial=0.0)
            if worst > 0:
                # |y| ≥ worst, which therefore serves as the unit of length.
                E = -np.vstack([self.M[moving].T, (b[moving] + allowance) / worst])
                try:
                    u, _ = nnls(E, np.eye(len(E))[-1], maxiter=20 * E.shape[1])
                except RuntimeError:
                    continue
                active = tuple(moving[np.flatnonzero(u)].tolist())
            solved = self.solve(active)
            if solved is None:
                continue
            multipliers, y = (part[:, :-1] @ np.append(xi, 1.0) for part in solved)
            terms = 1 + np.abs(b) + np.abs(self.M) @ np.abs(y)
            slack = b - self.M @ y
            least = -1e-8 * np.abs(multipliers).max(initial=0.0)
            if np.all(slack[moving] >= -1e-8 * terms[moving]) and np.all(multipliers >= least):
                touching = moving[slack[moving] <= 1e-10 * terms[moving]]
                return Solution(active, np.union1d(touching, active).astype(int), multipliers, y)
        return None

    def basis(self, found: "Solution | None") -> tuple[int, ...] | None:
        """Active set of the perturbed problem at the ξ of a solution; None for none."""
        if found is None or len(found.touching) == len(found.active):
            return None if found is None else found.active
        # The limit of the perturbed multipliers minimises ε'λ.
        on = found.touching
        A, b = self.balance(on, -found.y)
        best = linprog(self.epsilon[on], A_eq=A, b_eq=b, method="highs-ds")
        if best.x is None:
            return found.active
        return tuple(on[best.x > 1e-12 * best.x.max(initial=0.0)].tolist())

    def balance(self, rows: np.ndarray, push: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Σ λ_i M_i = push over `rows`, which hold it in their span, as independent equations."""
        span, size, _ = np.linalg.svd(self.M[rows].T, full_matrices=False)
        span = span[:, size > 1e-10 * size.max(initial=0.0)]
        return span.T @ self.M[rows].T, span.T @ push

    def active(self, xi: np.ndarray) -> tuple[int, ...] | None:
        """Active set of the perturbed problem at ξ; None where there is no solution."""
        return self.basis(self.solution(xi))


class Solution(NamedTuple):
    """At one ξ: an independent active set, all active rows, the multipliers of the former, y."""

    active: tuple[int, ...]
    touching: np.ndarray
    multipliers: np.ndarray
    y: np.ndarray


def program(mpc: MPC, within: Box | Polytope | None = None) -> Program:
    """The least-distance form with all rows of `mpc` hard, on X_N or on X_N ∩ within."""
    with jax.enable_x64(True):
        c: Condensed = jax.tree.map(np.asarray, condense(in_float64(mpc)))
    if c.balls:
        fail("terminal_set", "is an ellipsoid: its law is not affine", "Give a Polytope")
    n = mpc.dimension
    try:
        factor = np.linalg.cholesky(c.P)
    except np.linalg.LinAlgError:
        fail("R", "leaves the condensed cost singular in float64", "Put a larger weight on inputs")
    upper, lower = np.flatnonzero(np.isfinite(c.upper)), np.flatnonzero(np.isfinite(c.lower))
    row, side = np.append(upper, lower), np.repeat([1.0, -1.0], [len(upper), len(lower)])
    G, V = side[:, None] * c.C[row], -side[:, None] * c.D[row]
    v = side * (np.where(side > 0, c.upper[row], c.lower[row]) - c.d[row])
    H, h = half_spaces(within, n)
    if mpc.remembers and mpc.inputs is not None:  # a previous input is one that was applied
        H_u, h_u = half_spaces(mpc.inputs, mpc.system.m)
        H, h = np.vstack([H, np.pad(H_u, ((0, 0), (mpc.system.n, 0)))]), np.append(h, h_u)
    G, V, v = np.vstack([G, np.zeros((len(h), G.shape[1]))]), np.vstack([V, -H]), np.append(v, h)
    row, side = np.append(row, np.full(len(h), -1)), np.append(side, np.ones(len(h)))

    # Rows ℓ⁻ᵀ of length 1; those that are zero (k = 0, forward Euler) bound x alone.
    M = np.linalg.solve(factor, G.T).T
    length = np.linalg.norm(M, axis=1)
    still = length <= 1e-13 * length.max(initial=0.0)
    M[still], length[still] = 0.0, np.linalg.norm(V[still], axis=1)
    empty = still & (length == 0)
    if np.any(v[empty] < 0):
        fail("mpc", "a limit that no state or input can move is violated", "Relax that limit")
    M, V, v, length, row, side, still = (
        part[~empty] for part in (M, V, v, length, row, side, still)
    )
    M, V, v = M / length[:, None], V / length[:, None], v / length
    shift = np.linalg.solve(factor, np.column_stack([c.F, c.f]))
    V, v = V + M @ shift[:, :n], v + M @ shift[:, n]

    # An orthonormal basis of the columns of M keeps tiny coefficients out of the LPs.
    U = np.linalg.svd(M, full_matrices=False)[0]
    unit = 1 / np.maximum(np.abs(V).max(axis=0), 1e-300)
    ends = [maximum(d, np.hstack([U, -V * unit]), v)[0] for d in (*np.eye(n), *-np.eye(n))]
    high, low = np.array(ends[:n]) * unit, -np.array(ends[n:]) * unit
    if np.isnan(ends).any():
        fail("mpc", *STOPPED)
    if -np.inf in ends:
        fail("mpc", "its feasible set is empty", "Relax a limit or lengthen the horizon")
    free = ~np.isfinite(high - low)
    if free.any():
        i = int(np.argmax(free))
        fail("mpc", f"its feasible set is unbounded along coordinate {i}", "Give within=jm.Box(…)")
    center, size = (high + low) / 2, (high - low) / 2
    flat = "its feasible set is flat: no initial state keeps a margin"
    if np.any(size <= SMALLEST * (unit + np.abs(center))):
        fail("mpc", flat, "Relax a limit or lengthen the horizon")
    V, v = V * size, v + V @ center
    rows = np.hstack([U, -V])
    gaps = np.linalg.norm(rows, axis=1)
    margin = np.column_stack([np.vstack([rows, np.zeros(rows.shape[1])]), np.append(gaps, 1.0)])
    radius, ball = maximum(np.eye(n + 1)[n], margin, np.append(v, 1.0))
    if ball is None or radius <= SMALLEST:
        fail("mpc", flat, "Relax a limit or lengthen the horizon")
    # Multiples of the golden ratio spread evenly and have no small integer relations.
    epsilon = 1 + np.modf(np.arange(1, len(v) + 1) * (np.sqrt(5) - 1) / 2)[0]
    return Program(
        c, factor, shift, M, U, V, v, length, row, side, still, epsilon, center, size, ball[:n],
    )  # fmt: skip


def maximum(d: np.ndarray, G: np.ndarray, g: np.ndarray) -> tuple[float, np.ndarray | None]:
    """max d'(last coordinates of w) over G w ≤ g, and those coordinates.

    ±inf and None where there is none, NaN and None where HiGHS stops for another reason.

    Where the rows that push carry d to rounding, the value is that of their multipliers: an upper
    bound by weak duality, and free of HiGHS' tolerances.
    """
    G, g = unit_rows(G, g)
    size = np.median(np.abs(g)) or 1.0  # those tolerances are absolute
    cost = np.append(np.zeros(G.shape[1] - len(d)), d)
    for method in ("highs-ds", "highs-ipm"):
        result = linprog(
            -cost, A_ub=G, b_ub=g / size, bounds=(None, None), method=method, options=LP
        )
        if result.status in (2, 3):
            return (-np.inf if result.status == 2 else np.inf), None
        if result.status == 0:
            push = result.ineqlin.marginals < -1e-9
            y = np.linalg.lstsq(G[push].T, cost, rcond=None)[0]
            exact = np.all(y >= 0) and np.abs(G[push].T @ y - cost).max() <= 1e-13 * (1 + y.sum())
            value = g[push] @ y if exact else -result.fun * size
            return float(value), result.x[-len(d) :] * size
    return np.nan, None


def half_spaces(set_: Box | Polytope | None, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit rows (H, h) of a set of initial states; none for None."""
    if set_ is None:
        return np.zeros((0, n)), np.zeros(0)
    if not isinstance(set_, Box | Polytope):
        fail("within", f"is a {type(set_).__name__}", "Give a Box or Polytope of states")
    set_.validate("within", n)
    body = set_.to_polytope() if isinstance(set_, Box) else set_
    return unit_rows(body.H, body.h, "within")


@dataclass(frozen=True, eq=False)
class ActivePiece:
    """λ (a, p + 1) and y (nz, p + 1) of an active set, affine in ξ with the constant last, where
    H ξ ≤ h (unit rows; `which`: their rows in the program). also_active: see `Region`.
    """

    active: tuple[int, ...]
    also_active: tuple[int, ...]
    multipliers: np.ndarray
    y: np.ndarray
    H: np.ndarray
    h: np.ndarray
    which: np.ndarray


def active_piece(p: Program, active: tuple[int, ...]) -> ActivePiece | None:
    """The law of an active set; None where its rows are dependent or it holds nowhere."""
    solved = p.solve(active)
    if solved is None:
        return None
    multipliers, y = solved
    slack, terms = p.slack(active, y)
    rows, n = list(active), len(p.center)
    # Both λ ≥ 0 and slack ≥ 0 read a'ξ + b + cδ ≥ 0, in row i of the program.
    slack[rows] = multipliers
    terms[rows] = np.abs(multipliers[:, :-1]).sum(axis=1).max(initial=0.0)
    a, b, c = slack[:, :n], slack[:, n], slack[:, n + 1]
    size = np.linalg.norm(a, axis=1)
    constant = size <= ZERO * terms
    zero = constant & (np.abs(b) <= 10 * ZERO * terms)
    if np.any(constant & ~zero & (b < 0)) or np.any(zero & (c < 0)):
        return None
    # Rows at a distance that [−1, 1]^n does not reach cannot cut.
    which = np.flatnonzero(~constant & (b <= 2 * np.sqrt(n) * size))
    H, h = -a[which] / size[which, None], b[which] / size[which]
    zero[rows] = False
    also_active = tuple(np.flatnonzero(zero & ~p.still).tolist())
    return ActivePiece(active, also_active, multipliers[:, :-1], y[:, :-1], H, h, which)


@dataclass(frozen=True, eq=False)
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


def cell(p: Program, active: tuple[int, ...]) -> Cell | None:
    """The region of an active set; None where its rows are dependent or it has no volume."""
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
        spread = np.linalg.svd(corners - corners.mean(axis=0), compute_uv=False)
        if n == 1 or spread[n - 2] > 1e-6 * radius:
            spanning.append((group, corners.mean(axis=0)))
    first = [group[0] for group, _ in spanning]
    return Cell(
        found, H[first], h[first], tuple(found.which[group] for group, _ in spanning),
        np.array([middle for _, middle in spanning]), vertices, radius,
    )  # fmt: skip


def interior(H: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Vertices (k, n) and inner radius of H ξ ≤ h (unit rows) in [−2, 2]^n; None if it is flat."""
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
        hull = HalfspaceIntersection(
            np.column_stack([dual * scale, -np.ones(len(h))]), np.zeros(n), qhull_options="C-1e-12"
        )
    except QhullError:
        return None
    # Where exactly n rows meet, their crossing is more accurate than qhull's.
    points = middle + hull.intersections * scale
    for i, meeting in enumerate(hull.dual_facets):
        if len(meeting) == n:
            points[i] = np.linalg.solve(H[meeting], h[meeting])
    return points[distinct(points, 1e-7 * radius)], radius


def capped_ball(H: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre and radius of the largest ball in H ξ ≤ h (unit rows), at most 1; −1 for none."""
    n = H.shape[1]
    ball = linprog(
        -np.eye(n + 1)[n], A_ub=np.column_stack([H, np.ones(len(h))]), b_ub=h,
        bounds=[(None, None)] * n + [(None, 1.0)], method="highs-ds", options=LP,
    )  # fmt: skip
    return (np.zeros(n), -1.0) if ball.x is None else (ball.x[:n], float(ball.x[-1]))


def volume(points: np.ndarray) -> float:
    """Volume of the hull of points (k, n), in coordinates in which they spread alike.

    Regions are thin along oblique directions, which qhull takes for flat; where it still fails,
    it moves the points by some 1e-11 ("QJ").
    """
    if points.shape[1] == 1:
        return float(np.ptp(points))
    _, spread, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    if len(points) <= points.shape[1] or spread[-1] == 0:
        return 0.0
    alike = (points - points.mean(axis=0)) @ axes.T / spread
    try:
        hull = ConvexHull(alike)
    except QhullError:
        hull = ConvexHull(alike, qhull_options="QJ")
    return float(hull.volume * np.prod(spread))


class Search:
    """Breadth-first search across facets. cells: active set → region, None for no volume."""

    def __init__(self, p: Program, limit: int) -> None:
        self.p, self.limit, self.begun = p, limit, time.perf_counter()
        self.cells: dict[tuple[int, ...], Cell | None] = {}
        self.found: list[Cell] = []
        self.queue: deque[Cell] = deque()

    @property
    def full(self) -> bool:
        """True once the limit is reached."""
        return len(self.found) >= self.limit

    def visit(self, active: tuple[int, ...] | None) -> Cell | None:
        """The region of an active set, queued when it is new."""
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

    def spread(self) -> None:
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
        touches = lambda c: c is not None and np.all(c.H @ middle <= c.h + 1e-9)
        if any(touches(c) for c in reached):
            return
        # Several rows vanish on the facet at once: look just behind it.
        for step in STEPS:
            behind = self.visit(self.p.active(middle + step * here.radius * here.H[i]))
            if touches(behind):
                return

    def fill(self) -> tuple[bool, str]:
        """Check that the regions fill X_N, and search on from what is missing; (complete, why)."""
        random = np.random.default_rng(0)
        why = ""
        for _ in range(REPAIRS):
            if self.full:
                return False, f"stopped at the limit of {self.limit} regions"
            points = np.concatenate([c.vertices for c in self.found])
            volumes, whole = sum(volume(c.vertices) for c in self.found), volume(points)
            hull = Polytope.from_points(points)
            tops = [self.p.support(a) for a in np.asarray(hull.H)]
            beyond = np.array([value for value, _ in tops]) - np.asarray(hull.h)
            gap = 1 - volumes / whole
            why = (
                f"the volumes of the regions sum to that of their hull (relative gap {gap:.0e}); "
                f"X_N reaches beyond its {len(beyond)} facets by {max(beyond.max(), 0):.0e}, "
                "relative to its size, by one linear program each"
            )
            if beyond.max() <= FILL and abs(gap) <= FILL:
                return True, why
            before = len(self.found)
            for (_, corner), far in zip(tops, beyond, strict=True):
                if corner is not None and far > FILL:
                    inside = self.p.interior + (corner - self.p.interior) * (1 - 1e-6)
                    self.visit(self.p.active(inside))
            for c in list(self.found):
                for middle, normal in zip(c.middles, c.H, strict=True):
                    corner = c.vertices[random.integers(len(c.vertices))]
                    # Anywhere on the facet, which is convex, and a little behind it.
                    to = corner - normal * (normal @ (corner - middle))
                    point = middle + 0.9 * random.random() * (to - middle)
                    self.visit(self.p.active(point + 1e-6 * c.radius * normal))
            self.spread()
            if len(self.found) == before:
                break
        return False, why.replace("the volumes of", "a part was not found: the volumes of")

    def report(self, mpc: MPC) -> CriticalRegions:
        """The regions in the coordinates of x, and whether they fill X_N."""
        complete, reason = self.fill()
        regions = tuple(region(self.p, c) for c in self.found)
        total = float(sum(r.volume for r in regions))
        seconds = time.perf_counter() - self.begun
        return CriticalRegions(mpc, regions, complete, total, reason, seconds)


def explore(p: Program, limit: Any) -> Search:
    """The search, ended: from an interior point across all facets."""
    if not isinstance(limit, int | np.integer) or isinstance(limit, bool) or limit < 1:
        fail("limit", f"{limit!r}", "Give a whole number of regions, at least 1")
    if len(p.center) > DIMENSIONS:
        fail(
            "mpc", f"its states have {len(p.center)} coordinates, too many for vertices",
            f"Regions serve up to {DIMENSIONS}; exact_penalty(method='samples') serves more",
        )  # fmt: skip
    search = Search(p, int(limit))
    search.visit(p.active(p.interior))
    search.spread()
    if not search.found:
        fail("mpc", "no critical region was found: too ill-conditioned", "Scale states and inputs")
    return search


def exchange(p: Program, active: tuple[int, ...], row: int) -> list[tuple[int, ...]] | None:
    """Active sets behind a facet on which `row` vanishes; None where nothing is feasible there.

    A multiplier that vanishes: its row leaves. A row that becomes active joins; if it depends on
    the active ones, M_row = Σ α_j M_j, its multiplier t changes theirs to λ_j − t α_j, and one
    with α_j > 0 leaves. Without such a j, M_row + Σ|α_j| M_j = 0 is a Farkas certificate.
    """
    rows = [j for j in active if j != row]
    if len(rows) < len(active):
        return [tuple(rows)]
    if p.still[row]:
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


def region(p: Program, c: Cell) -> Region:
    """A cell in the coordinates of x, with the law of z, the multipliers and the first input."""
    rows = list(c.law.active)
    on_x = (
        lambda by_xi: (  # affine in ξ, constant last → affine in x
            by_xi[:, :-1] / p.size,
            by_xi[:, -1] - by_xi[:, :-1] / p.size @ p.center,
        )
    )
    (L, l0), (Y, y0), n = on_x(c.law.multipliers), on_x(c.law.y), len(p.center)
    Z = np.linalg.solve(p.factor.T, Y - p.shift[:, :n])
    z0 = np.linalg.solve(p.factor.T, y0 - p.shift[:, n])
    sign = p.side[rows] / p.length[rows]
    H, h = c.H / p.size, c.h + c.H / p.size @ p.center
    vertices = p.center + c.vertices * p.size
    condensed = p.condensed
    return Region(
        rows=p.row[rows], also_active=p.row[list(c.law.also_active)],
        Z=Z, z0=z0, L=sign[:, None] * L, l0=sign * l0,
        K=np.asarray(condensed.Psi[0] + condensed.Omega[0] @ Z),
        k=np.asarray(condensed.Omega[0] @ z0 + condensed.psi[0]),
        polytope=Polytope(*unit_rows(H, h)), vertices=vertices,
        volume=volume(c.vertices) * float(np.prod(p.size)),
    )  # fmt: skip
