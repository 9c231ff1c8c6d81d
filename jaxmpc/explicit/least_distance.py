"""The MPC problem as a least-distance problem in scaled coordinates, in NumPy in float64.

With the Cholesky factor P = ℓℓ' of the condensed cost, y = ℓ'z + ℓ⁻¹(F x + f) is the distance
from the unconstrained plan, and the QP at x is a least-distance problem:

    min ½|y|²  subject to  M y ≤ v + V x          (rows of M of length 1).

Where the rows A hold with equality, y = −M_A'λ and M_A M_A'λ = −(v_A + V_A x): plan and
multipliers are affine in x on the polytope where λ ≥ 0 and all other rows hold, the critical
region of A. Seen as a problem with v + δε for a fixed ε > 0 and δ → 0+, every active set has
independent rows; so regions where rows are dependent (duplicates, apexes of a limit) are divided
without overlap, and rows that vanish identically are decided by their first order in δ.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import linprog, nnls

from jaxmpc.checks import fail
from jaxmpc.control.geometry import HIGHS
from jaxmpc.control.sets import Box, Polytope, unit_half_spaces, unit_rows
from jaxmpc.mpc.condense import Condensed
from jaxmpc.mpc.inequalities import Inequalities, condensed_in_float64
from jaxmpc.mpc.problem import MPC

# In coordinates where X_N just fits into [−1, 1]^n: the smallest ball of a region.
SMALLEST = 1e-9
# Rows of length 1 closer to the span of others than this count as dependent on them.
DEPENDENT = 1e-7
STOPPED = "HiGHS stopped early on its linear programs", "Scale states and inputs to like size"


@dataclass(frozen=True, eq=False)
class LeastDistanceForm:
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
        """Return max d'ξ over X_N, and where it is attained; NaN and None where HiGHS stops."""
        return maximum(d, np.hstack([self.U, -self.V]), self.v)

    def leave(self, direction: np.ndarray) -> np.ndarray | None:
        """Return where the ray from the interior point along `direction` leaves X_N; None if not
        found."""
        t = maximum(
            np.ones(1), np.column_stack([self.U, -self.V @ direction]),
            self.v + self.V @ self.interior,
        )[1]  # fmt: skip
        return None if t is None else self.interior + t * direction

    def margin(self, xi: np.ndarray) -> float:
        """Return an upper bound of the greatest t ≤ 1 with M y + t ≤ v + V ξ: ξ is outside X_N if t
        < 0."""
        rows = np.column_stack([self.U, np.ones(len(self.v))])
        rows = np.vstack([rows, np.eye(rows.shape[1])[-1]])
        return maximum(np.ones(1), rows, np.append(self.v + self.V @ xi, 1.0))[0]

    def solve_active(self, active: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray] | None:
        """Return λ (a, n + 2) and y (nz, n + 2), affine in ξ, constant and δ; None for dependent
        rows."""
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
        """Return the slack (r, n + 2) of all rows under y, and the size (r,) of its terms, for
        rounding.

        Not from the multipliers: these are large, and cancel, where rows are nearly dependent.
        """
        data = np.column_stack([self.V, self.v, self.epsilon])
        slack, terms = data - self.M @ y, np.abs(data) + np.abs(self.M) @ np.abs(y)
        slack[list(active)] = 0.0
        return slack, terms[:, :-1].sum(axis=1)

    def solution(self, xi: np.ndarray) -> "PointSolution | None":
        """Return the solution at ξ; None where there is none, or none that keeps all rows to
        1e-8."""
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
            solved = self.solve_active(active)
            if solved is None:
                continue
            multipliers, y = (part[:, :-1] @ np.append(xi, 1.0) for part in solved)
            terms = 1 + np.abs(b) + np.abs(self.M) @ np.abs(y)
            slack = b - self.M @ y
            least = -1e-8 * np.abs(multipliers).max(initial=0.0)
            if np.all(slack[moving] >= -1e-8 * terms[moving]) and np.all(multipliers >= least):
                touching = moving[slack[moving] <= 1e-10 * terms[moving]]
                return PointSolution(
                    active, np.union1d(touching, active).astype(int), multipliers, y
                )
        return None

    def basis(self, found: "PointSolution | None") -> tuple[int, ...] | None:
        """Return the active set of the perturbed problem at the ξ of a solution; None for None."""
        if found is None or len(found.touching) == len(found.active):
            return None if found is None else found.active
        # The limit of the perturbed multipliers minimises ε'λ.
        on = found.touching
        A, b = self.balance(on, -found.y)
        best = linprog(self.epsilon[on], A_eq=A, b_eq=b, method="highs-ds")
        if best.x is None:
            return found.active
        return tuple(on[best.x > 1e-12 * best.x.max(initial=0.0)].tolist())

    def balance(self, rows: np.ndarray, total: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return Σ λ_i M_i = total over `rows`, which hold `total` in their span, as independent
        equations in λ."""
        span, size, _ = np.linalg.svd(self.M[rows].T, full_matrices=False)
        span = span[:, size > 1e-10 * size.max(initial=0.0)]
        return span.T @ self.M[rows].T, span.T @ total

    def active(self, xi: np.ndarray) -> tuple[int, ...] | None:
        """Return the active set of the perturbed problem at ξ; None where there is no solution."""
        return self.basis(self.solution(xi))


class PointSolution(NamedTuple):
    """At one ξ: an independent active set, all active rows, the multipliers of the former, y."""

    active: tuple[int, ...]
    touching: np.ndarray
    multipliers: np.ndarray
    y: np.ndarray


def least_distance_form(mpc: MPC, within: Box | Polytope | None = None) -> LeastDistanceForm:
    """Return the least-distance form with all rows of `mpc` hard, on X_N or on X_N ∩ within."""
    c = condensed_in_float64(mpc)
    if c.balls:
        fail("terminal_set", "is an ellipsoid: its law is not affine", "Give a Polytope")
    n = mpc.dimension
    try:
        factor = np.linalg.cholesky(c.P)
    except np.linalg.LinAlgError:
        fail("R", "leaves the condensed cost singular in float64", "Put a larger weight on inputs")
    G, D, v, row, side = Inequalities.of(c)
    V = -D
    H, h = unit_half_spaces("within", within, n)
    if mpc.input_in_state and mpc.inputs is not None:  # a previous input is one that was applied
        H_u, h_u = unit_half_spaces("inputs", mpc.inputs, mpc.system.m)
        H, h = np.vstack([H, np.pad(H_u, ((0, 0), (mpc.system.n, 0)))]), np.append(h, h_u)
    G, V, v = np.vstack([G, np.zeros((len(h), G.shape[1]))]), np.vstack([V, -H]), np.append(v, h)
    row, side = np.append(row, np.full(len(h), -1)), np.append(side, np.ones(len(h)))

    # Rows ℓ⁻ᵀ of length 1; those that are zero (k = 0, forward Euler) bound x alone.
    M = np.linalg.solve(factor, G.T).T
    length = np.linalg.norm(M, axis=1)
    still = length <= 1e-13 * np.max(length, initial=0.0)
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
    return LeastDistanceForm(
        c, factor, shift, M, U, V, v, length, row, side, still, epsilon, center, size, ball[:n],
    )  # fmt: skip


def maximum(d: np.ndarray, G: np.ndarray, g: np.ndarray) -> tuple[float, np.ndarray | None]:
    """Return max d'(last coordinates of w) over G w ≤ g, and those coordinates.

    ±inf and None where there is none, NaN and None where HiGHS stops for another reason.

    Where the active rows carry d to rounding, the value is that of their multipliers: an upper
    bound by weak duality, and free of HiGHS' tolerances.
    """
    G, g = unit_rows(G, g)
    size = np.median(np.abs(g)) or 1.0  # those tolerances are absolute
    cost = np.append(np.zeros(G.shape[1] - len(d)), d)
    for method in ("highs-ds", "highs-ipm"):
        result = linprog(
            -cost, A_ub=G, b_ub=g / size, bounds=(None, None), method=method, options=HIGHS
        )
        if result.status in (2, 3):
            return (-np.inf if result.status == 2 else np.inf), None
        if result.status == 0:
            active = result.ineqlin.marginals < -1e-9
            y = np.linalg.lstsq(G[active].T, cost, rcond=None)[0]
            exact = np.all(y >= 0) and np.abs(G[active].T @ y - cost).max() <= 1e-13 * (1 + y.sum())
            value = g[active] @ y if exact else -result.fun * size
            return float(value), result.x[-len(d) :] * size
    return np.nan, None
