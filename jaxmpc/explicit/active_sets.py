"""A parametric QP as a least-distance problem in scaled coordinates, in NumPy in float64.

With the Cholesky factor P = ℓℓ' of the cost, y = ℓ'z + ℓ⁻¹(F x + f) is the distance from the
unconstrained optimum, and the QP at the parameters x is a least-distance problem:

    min ½|y|²  subject to  M y ≤ v + V x          (rows of M of length 1).

Where the rows A hold with equality, y = −M_A'λ and M_A M_A'λ = −(v_A + V_A x): optimum and
multipliers are affine in x on the polytope where λ ≥ 0 and all other rows hold, the critical
region of A. Equalities that rows imply (two opposite rows, a terminal point) are taken out
first: z is affine in x and in coordinates w that they leave free, and w takes the place of z above.
Where they tie the parameters to each other, some of these are free and the others affine in them
(`FreeParameters`). Where the set of parameters is unbounded, the search looks at it through a
window, a box about a point inside (`Window`).
Seen as a problem with v + δε for a fixed ε > 0 and δ → 0+, every active set has
independent rows; so regions where rows are dependent (duplicates, apexes of a limit) are divided
without overlap, and rows that vanish identically are decided by their first order in δ.
"""

import contextlib
from typing import NamedTuple

import numpy as np
import scipy

from jaxmpc.arrays import Reals
from jaxmpc.checks import fail
from jaxmpc.explicit.parametric_program import (
    Output,
    ParametricQP,
    Quadratic,
    cost_of_tracking,
    in_numpy,
)
from jaxmpc.mpc.condense import Inequalities, condensed_in_float64
from jaxmpc.mpc.problem import MPC, RELAX, at_stage
from jaxmpc.pytrees import record
from jaxmpc.sets.convex_sets import Box, Polytope, unit_half_spaces
from jaxmpc.sets.geometry import (
    AffineHull,
    affine_hull,
    distinct,
    dual_hull,
    framed,
    implied_equalities,
    plain_null_space,
)
from jaxmpc.sets.lp import (
    FLAT,
    ROUNDING,
    Program,
    cleaned,
    largest_margin,
    maximise,
    maximise_nonnegative,
    scaling,
)

# Curvature of the cost, relative to its terms, up to which it counts as none.
SINGULAR = 1e-12
# In coordinates where X_N just fits into [−1, 1]^n: the smallest ball of a region.
SMALLEST = 1e-9
# Rows of length 1 closer to the span of others than this count as dependent on them.
DEPENDENT = 1e-7
# Relative rounding of a law: below it a coefficient is zero.
ZERO = 1e-11
# Size of the window onto an unbounded set, relative to that of the rows' data.
REACH = 64.0
# How far outside the window vertices are looked for, relative to its size.
FAR_OUTSIDE = 1e5


@record
class LeastDistanceForm:
    """min ½|y|² s.t. M y ≤ v + V ξ, one-sided rows; x = center + size·ξ with X_N in [−1, 1]^n.

    x are the free parameters, and X_N the set of those with a feasible z, as far as the window
    shows it. length (r,): multipliers of the rows as given are those of M divided by it. row (r,):
    their number in `given`. side (r,): 1 upper, −1 lower. zero_row (r,): M_i = 0, a half-space on ξ
    alone. typical (r,): size of v + V ξ, for tolerances. epsilon (r,): direction of the
    perturbation. factor: ℓ. U: orthonormal columns that span those of M.
    shift (nz, n + 1): ℓ⁻¹(F, f). interior (n,): ξ with a margin.
    given: the program as it is stated, before any row is scaled or left out, in the free
    parameters. hull: the affine hull of its points (x, z).
    """

    given: "GivenProgram"
    hull: AffineHull
    window: "Window"
    factor: np.ndarray
    shift: np.ndarray
    M: np.ndarray
    U: np.ndarray
    V: np.ndarray
    v: np.ndarray
    typical: np.ndarray
    length: np.ndarray
    row: np.ndarray
    side: np.ndarray
    zero_row: np.ndarray
    epsilon: np.ndarray
    center: np.ndarray
    size: np.ndarray
    interior: np.ndarray

    def support(self, d: np.ndarray) -> tuple[float, np.ndarray | None]:
        """Return max d'ξ over X_N by the program as given, and where it is attained."""
        value, x = self.given.support(d / self.size)
        return value - d / self.size @ self.center, None if x is None else self.scaled(x)

    def scaled(self, x: np.ndarray) -> np.ndarray:
        """Return the ξ of a state x."""
        return (x - self.center) / self.size

    def in_states(self, affine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return gain (r, n) and offset (r,) in x of what is affine in ξ, constant last."""
        gain = affine[:, :-1] / self.size
        return gain, affine[:, -1] - gain @ self.center

    def leave(self, direction: np.ndarray) -> np.ndarray | None:
        """Return where the ray from the interior point along `direction` leaves X_N; None if not
        found."""
        rows = np.column_stack([self.U, -self.V @ direction])
        found = maximise(np.eye(rows.shape[1])[-1], rows, self.v + self.V @ self.interior).x
        return None if found is None else self.interior + found[-1] * direction

    def margin(self, xi: np.ndarray) -> float:
        """Return the greatest t ≤ 1 with M y + t·typical ≤ v + V ξ: ξ is outside X_N if t < 0."""
        return largest_margin(self.U, self.v + self.V @ xi, self.typical, 1.0)[1]

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

        Not from the multipliers: these are large, and cancel, where rows are nearly dependent. The
        entries of y are rounded relative to its length, not each to its own.
        """
        data = np.column_stack([self.V, self.v, self.epsilon])
        length = np.linalg.norm(self.M, axis=1)[:, None] * np.linalg.norm(y, axis=0)
        slack, terms = data - self.M @ y, np.abs(data) + length
        slack[list(active)] = 0.0
        return slack, terms[:, :-1].sum(axis=1)

    def solution(self, xi: np.ndarray) -> "PointSolution | None":
        """Return the solution at ξ; None where there is none, or none that keeps all rows to
        1e-8."""
        b = self.v + self.V @ xi
        if np.any(b[self.zero_row] < -1e-9):
            return None
        moving = np.flatnonzero(~self.zero_row)
        for allowance in (0.0, 1e-9 * self.typical[moving]):  # the boundary of X_N may need one
            active: tuple[int, ...] = ()
            worst = -b[moving].min(initial=0.0)
            if worst > 0:
                # |y| ≥ worst, which therefore serves as the unit of length.
                E = -np.vstack([self.M[moving].T, (b[moving] + allowance) / worst])
                try:
                    u, _ = scipy.optimize.nnls(E, np.eye(len(E))[-1], maxiter=20 * E.shape[1])
                except RuntimeError:
                    continue
                active = tuple(moving[np.flatnonzero(u)].tolist())
            solved = self.solve_active(active)
            if solved is None:
                continue
            multipliers, y = (part[:, :-1] @ np.append(xi, 1.0) for part in solved)
            terms = self.typical + np.abs(b) + np.abs(self.M) @ np.abs(y)
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
        best = maximise_nonnegative(-self.epsilon[on], A, b)
        if best is None:
            return found.active
        return tuple(on[best > 1e-12 * best.max(initial=0.0)].tolist())

    def balance(self, rows: np.ndarray, total: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return Σ λ_i M_i = total over `rows`, which hold `total` in their span, as independent
        equations in λ.

        Rows have length 1 and the span is orthonormal, which bounds what is rounding. It must be
        zero: λ_i = −1e-33 would have no λ ≥ 0."""
        span, size, _ = np.linalg.svd(self.M[rows].T, full_matrices=False)
        span = span[:, size > 1e-10 * size.max(initial=0.0)]
        A, b = span.T @ self.M[rows].T, span.T @ total
        return cleaned(A, 1.0), cleaned(b, float(np.linalg.norm(total)))

    def active(self, xi: np.ndarray) -> tuple[int, ...] | None:
        """Return the active set of the perturbed problem at ξ; None where there is no solution."""
        return self.basis(self.solution(xi))


class PointSolution(NamedTuple):
    """At one ξ: an independent active set, all active rows, the multipliers of the former, y."""

    active: tuple[int, ...]
    touching: np.ndarray
    multipliers: np.ndarray
    y: np.ndarray


class FreeParameters(NamedTuple):
    """The parameters θ = shift + basis x (p,), x = θ[free] (d,), on rows (k, p) θ = offsets (k,)
    that the program implies; x = θ without any."""

    shift: np.ndarray
    basis: np.ndarray
    free: np.ndarray
    rows: np.ndarray
    offsets: np.ndarray

    @classmethod
    def all(cls, p: int) -> "FreeParameters":
        """Return p parameters that are free."""
        none = np.zeros((0, p)), np.zeros(0)
        return cls(np.zeros(p), np.eye(p), np.arange(p), *none)

    @property
    def tied(self) -> bool:
        """Return whether equalities tie parameters to each other."""
        return len(self.offsets) > 0

    def widened(self, gain: np.ndarray) -> np.ndarray:
        """Return what is gain (r, d) in x as a gain (r, p) in θ."""
        wide = np.zeros((len(gain), len(self.shift)))
        wide[:, self.free] = gain
        return wide


class GivenProgram(NamedTuple):
    """min ½ z'Pz + (F x + f)'z over the rows C z + D x ≤ b as they are given, with those of the set
    of parameters.

    row (r,) and side (r,): of the problem's own rows, R of them with these `coefficients` (R, nz),
    which may have two sides, as in `Inequalities`; −1 for rows of the set of parameters, −2 for
    those of a window. alone: what the cost has in x alone. output: of the law. parameters: what x
    are.
    """

    P: np.ndarray
    F: np.ndarray
    f: np.ndarray
    C: np.ndarray
    D: np.ndarray
    b: np.ndarray
    row: np.ndarray
    side: np.ndarray
    coefficients: np.ndarray
    alone: Quadratic
    output: Output
    parameters: FreeParameters
    program: Program

    @classmethod
    def of(
        cls,
        problem: MPC | ParametricQP,
        within: Box | Polytope | None,
        reference: Reals | None = None,
        input_reference: Reals | None = None,
    ) -> "GivenProgram":
        """Return the program of a problem, all rows hard, on X_N or on X_N ∩ within; of an MPC
        whose plans track these references."""
        p, (H, h) = problem.dimension, unit_half_spaces("within", within, problem.dimension)
        if isinstance(problem, ParametricQP):
            q = in_numpy(problem)
            C, D, b = q.G, -q.S, q.h
            row, side, coefficients = np.arange(len(b)), np.ones(len(b)), C
            P, F, f, alone, output = q.P, q.F, q.q, q.alone, q.output
        else:
            c = condensed_in_float64(problem)
            if c.balls:
                fail("terminal_set", "is an ellipsoid: its law is not affine", "Give a Polytope")
            C, D, b, row, side = Inequalities.of(c)
            coefficients, P, F = (np.asarray(part) for part in (c.C, c.P, c.F))
            f, alone = cost_of_tracking(problem, c, reference, input_reference)
            output = Output(*(np.asarray(part[0]) for part in (c.Omega, c.Psi, c.psi)))
            if problem.input_in_state and problem.inputs is not None:  # one that was applied
                applied = at_stage(problem.inputs, 0)
                H_u, h_u = unit_half_spaces("inputs", applied, problem.system.m)
                H_u = np.pad(H_u, ((0, 0), (problem.system.n, 0)))
                H, h = np.vstack([H, H_u]), np.append(h, h_u)
        C, D = np.vstack([C, np.zeros((len(h), C.shape[1]))]), np.vstack([D, H])
        b, side = np.append(b, h), np.append(side, np.ones(len(h)))
        row = np.append(row, np.full(len(h), -1))
        able = np.isfinite(b)
        C, D, b, row, side = C[able], D[able], b[able], row[able], side[able]
        program = Program(np.hstack([D, C]), b)
        free = FreeParameters.all(p)
        return cls(P, F, f, C, D, b, row, side, coefficients, alone, output, free, program)

    def within(self, window: "Window") -> "GivenProgram":
        """Return the program with the rows of a window."""
        H, h = window.rows()
        if not len(h):
            return self
        C, D = np.vstack([self.C, np.zeros((len(h), self.C.shape[1]))]), np.vstack([self.D, H])
        b = np.append(self.b, h)
        return self._replace(
            C=C,
            D=D,
            b=b,
            row=np.append(self.row, np.full(len(h), -2)),
            side=np.append(self.side, np.ones(len(h))),
            program=Program(np.hstack([D, C]), b),
        )

    def in_free_parameters(self, equal: np.ndarray) -> "GivenProgram":
        """Return the program in parameters that the rows `equal`, which hold with equality, leave
        free.

        With E_z z + E_x x = e and E_z = U Σ V', the rows (1 − U U')(E_x x − e) = 0 tie parameters.
        """
        n = self.D.shape[1]
        row, column = scaling(self.program.G, self.b)
        E = (row[:, None] * self.program.G * column)[equal]
        U, size, _ = np.linalg.svd(E[:, n:], full_matrices=False)
        U = U[:, size > 1e-10 * max(size.max(initial=0.0), 1e-300)]
        both = np.column_stack([E[:, :n], (row * self.b)[equal]])
        both = both - U @ (U.T @ both)
        _, size, Vt = np.linalg.svd(both[:, :n], full_matrices=False)
        rank = int((size > FLAT).sum())
        if not rank:
            return self
        if rank == n:
            only = column[:n] * np.linalg.lstsq(both[:, :n], both[:, n], rcond=FLAT)[0]
            at = np.array2string(only, precision=6, suppress_small=True)
            what = f"its rows leave one value of the parameters, {at}"
            fail("problem", what, "Solve the QP there")
        rows = np.where(np.abs(Vt[:rank]) <= 1e-14, 0.0, Vt[:rank])
        offsets = rows @ np.linalg.lstsq(both[:, :n], both[:, n], rcond=FLAT)[0]
        # What is rounding here would be the only limit of rows through the origin.
        offsets = np.where(np.abs(offsets) <= 1e-14, 0.0, offsets)
        basis, free = plain_null_space(rows)
        shift = column[:n] * np.linalg.lstsq(rows, offsets, rcond=None)[0]
        basis = column[:n, None] * basis / column[free]
        shift = shift - basis @ shift[free]  # so that x = θ[free]
        D, (gain, direct, constant) = self.D @ basis, self.output
        D = cleaned(D, np.abs(self.D) @ np.abs(basis) * 1e3)
        moved = self.D @ shift
        b = cleaned(self.b - moved, np.abs(self.b) + np.abs(self.D) @ np.abs(shift))
        on = np.any(D != 0, axis=1) | np.any(self.C != 0, axis=1)  # the others tie parameters
        return self._replace(
            F=self.F @ basis,
            f=self.f + self.F @ shift,
            C=self.C[on],
            D=D[on],
            b=b[on],
            row=self.row[on],
            side=self.side[on],
            alone=self.alone.along(shift, basis),
            output=Output(gain, direct @ basis, constant + direct @ shift),
            parameters=FreeParameters(shift, basis, free, rows / column[:n], offsets),
            program=Program(np.hstack([D, self.C])[on], b[on]),
        )

    def support(self, d: np.ndarray) -> tuple[float, np.ndarray | None]:
        """Return max d'x over X_N, and where it is attained (None: nowhere)."""
        found = self.program.maximise(np.append(d, np.zeros(self.C.shape[1])))
        return found.value, None if found.x is None else found.x[: len(d)]


class Window(NamedTuple):
    """lower ≤ x ≤ upper (n,): what is looked at of a set, its bounds where it has some.

    inside (n,): a point of the set. cut (2, n): where lower and upper are no bounds of the set.
    """

    lower: np.ndarray
    upper: np.ndarray
    inside: np.ndarray
    cut: np.ndarray

    @classmethod
    def of(cls, program: Program, unit: np.ndarray, reach: float) -> "Window":
        """Return the window onto a program, whose first variables x have these typical sizes (n,):
        `reach` times these about a point inside, in directions in which x is unbounded, and the
        bounds of what is seen then."""
        n = len(unit)
        low, high = program.bounds(range(n))
        cut = ~np.isfinite([low, high])
        if not cut.any():
            return cls(low, high, (low + high) / 2, cut)
        inside = program.margin()[0][:n]
        size = reach * np.maximum(unit, np.abs(inside))
        edge = cls(np.where(cut[0], inside - size, low), np.where(cut[1], inside + size, high),
                   inside, cut)  # fmt: skip
        H, h = edge.rows()
        G = np.vstack([program.G, np.pad(H, ((0, 0), (0, program.G.shape[1] - n)))])
        low, high = Program(G, np.append(program.g, h)).bounds(range(n))
        return cls(low, high, inside, cut)

    @property
    def open(self) -> bool:
        """Return whether the set reaches beyond the window."""
        return bool(self.cut.any())

    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the half-spaces H x ≤ h by which the window cuts off what lies beyond it."""
        unit, on = np.eye(len(self.lower)), np.append(self.cut[1], self.cut[0])
        return np.vstack([unit, -unit])[on], np.append(self.upper, -self.lower)[on]

    def fraction(self, points: np.ndarray) -> float:
        """Return how far points (k, n) lie from the point inside towards where the window cuts, at
        most, relative to its size."""
        up = ((points - self.inside) / (self.upper - self.inside))[:, self.cut[1]]
        down = ((points - self.inside) / (self.lower - self.inside))[:, self.cut[0]]
        return float(max(up.max(initial=0.0), down.max(initial=0.0)))


def least_distance_form(
    problem: MPC | ParametricQP,
    within: Box | Polytope | None = None,
    reach: float = REACH,
    **references: Reals | None,
) -> LeastDistanceForm:
    """Return the least-distance form of a problem, all rows hard, on X_N or on X_N ∩ within.

    reach: size of the window, where this is unbounded, relative to the size of the rows' data.
    references: `reference` and `input_reference` that the plans of an MPC track, as in `solve`.
    """
    given = GivenProgram.of(problem, within, **references)
    mpc = isinstance(problem, MPC)
    name = "mpc" if mpc else "problem"
    relax = RELAX if mpc else "Relax a limit or enlarge within"
    if given.program.empty:
        fail(name, "its feasible set is empty", relax)
    flat = "its feasible set is flat: no initial state keeps a margin"
    equal = implied_equalities(given.program.G, given.b)
    if equal.any():
        given = given.in_free_parameters(equal)
    n = given.D.shape[1]
    hull = affine_hull(given.program.G, given.b, keep=n)
    if hull is None:
        fail(name, f"{flat}, as equalities tie the states to each other", "Relax one of them")
    # z = shift + S x + N w
    N, S, shift_z = hull.basis[n:, n:], hull.basis[n:, :n], hull.shift[n:]
    factor = _factor_of_cost(problem, given.P, N)
    G, V, v = hull.G[:, n:], -hull.G[:, :n], hull.g
    row, side = given.row[hull.rows], given.side[hull.rows]

    # Rows ℓ⁻ᵀ of length 1; those that are zero (k = 0, forward Euler) bound x alone. A row is zero
    # if its entries are rounding beside its other terms, in columns of like size.
    unit = scaling(hull.G, hull.g)[1]
    others = np.linalg.norm(V * unit[:n], axis=1) + np.abs(v)
    zero_row = np.linalg.norm(G * unit[n:], axis=1) <= ROUNDING / 100 * others
    M = np.linalg.solve(factor, G.T).T
    M[zero_row] = 0.0
    length = np.where(zero_row, 1.0, np.linalg.norm(M, axis=1))
    M, V, v = M / length[:, None], V / length[:, None], v / length
    shift = np.linalg.solve(
        factor,
        N.T @ (np.column_stack([given.F, given.f]) + given.P @ np.column_stack([S, shift_z])),
    )
    # A row that the unconstrained optimum meets for all x (such as one that says that a derivative
    # of the cost is zero) leaves rounding here, which must not make facets.
    data = np.column_stack([V, v])
    data = cleaned(data + M @ shift, 10 * (np.abs(data) + np.abs(M) @ np.abs(shift)))
    V, v = data[:, :n], data[:, n]

    window = Window.of(Program(np.hstack([-V, M]), v), scaling(V, v)[1], reach)
    if window.open:
        H, h = window.rows()
        k = len(h)
        given = given.within(window)
        M, V = np.vstack([M, np.zeros((k, M.shape[1]))]), np.vstack([V, -H])
        v, length, side = (
            np.append(v, h),
            np.append(length, np.ones(k)),
            np.append(side, np.ones(k)),
        )
        row, zero_row = np.append(row, np.full(k, -2)), np.append(zero_row, np.full(k, True))
        hull = hull._replace(equal=np.append(hull.equal, np.full(k, False)))
    low, high = window.lower, window.upper
    center, size = (high + low) / 2, (high - low) / 2
    if np.any(size <= ROUNDING * np.abs(center)):
        fail(name, flat, relax)
    V, v = V * size, v + V @ center
    # Rows on ξ alone get length 1; the others are as long as y, in units of cost, is.
    reach = np.linalg.norm(V, axis=1)
    unit = np.where(zero_row, np.maximum(reach, 1e-300), 1.0)
    V, v, length = V / unit[:, None], v / unit, length * unit
    typical = np.where(
        zero_row, 1.0, np.median((reach + np.abs(v))[~zero_row]) if any(~zero_row) else 1.0
    )
    # An orthonormal basis of the columns of M keeps tiny coefficients out of the LPs; what is
    # rounding in it would decide how they are scaled. (M has dependent columns where rows leave
    # some of z alone.)
    U, singular, _ = np.linalg.svd(M, full_matrices=False)
    U = cleaned(U[:, singular > 1e-12 * singular.max(initial=0.0)], 1.0)
    ball = framed(f"{name}: its feasible set", np.hstack([U, -V]), v).center
    # Multiples of the golden ratio spread evenly and have no small integer relations.
    epsilon = 1 + np.modf(np.arange(1, len(v) + 1) * (np.sqrt(5) - 1) / 2)[0]
    return LeastDistanceForm(
        given=given,
        hull=hull,
        window=window,
        factor=factor,
        shift=shift,
        M=M,
        U=U,
        V=V,
        v=v,
        typical=typical,
        length=length,
        row=row,
        side=side,
        zero_row=zero_row,
        epsilon=epsilon,
        center=center,
        size=size,
        interior=ball[-n:],
    )


def _factor_of_cost(problem: MPC | ParametricQP, P: np.ndarray, N: np.ndarray) -> np.ndarray:
    """Return the Cholesky factor of N'PN. Raises ValueError, naming a weight, where it is singular
    in float64: rounding decides whether a singular matrix has one."""
    curvature, terms = N.T @ P @ N, np.diag(np.abs(N).T @ np.abs(P) @ np.abs(N))
    unit = 1 / np.sqrt(np.where(terms > 0, terms, 1.0))
    least = np.linalg.eigvalsh(unit[:, None] * curvature * unit).min(initial=1.0)
    if least <= SINGULAR:
        if isinstance(problem, MPC):
            problem.require_unique_inputs()  # names the weight that is missing
            what = "leaves the condensed cost singular in float64"
            fail("R", what, "Put a larger weight on inputs")
        what = "is singular in float64 where rows leave z free: the optimum is not unique"
        fail("P", what, "Add a small multiple of the unit matrix")
    return np.linalg.cholesky(curvature)


# --- The affine law of an active set, and its region ------------------------------------


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


def active_piece(
    p: LeastDistanceForm, active: tuple[int, ...], far: float = 1.0
) -> ActivePiece | None:
    """Return the affine law of an active set; None where its rows are dependent or it holds
    nowhere. Rows that [−far, far]^n does not reach are left out."""
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
    which = np.flatnonzero(~constant & (b <= 2 * far * np.sqrt(n) * size))
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


def far_vertices(p: LeastDistanceForm, active: tuple[int, ...]) -> np.ndarray:
    """Return the vertices (k, n) of the region of an active set, without the window, that lie
    within `FAR_OUTSIDE` times its size."""
    piece = active_piece(p, active, FAR_OUTSIDE)
    assert piece is not None
    own = p.row[piece.which] != -2
    body = interior(piece.H[own], piece.h[own], FAR_OUTSIDE)
    vertices = np.zeros((0, len(p.center))) if body is None else body[0]
    return vertices[np.abs(vertices).max(axis=1, initial=0.0) < FAR_OUTSIDE / 10]


def interior(H: np.ndarray, h: np.ndarray, far: float = 2.0) -> tuple[np.ndarray, float] | None:
    """Return the vertices (k, n) and inner radius of H ξ ≤ h (unit rows) in [−far, far]^n; None if
    it is flat."""
    n = H.shape[1]
    H, h = np.vstack([H, np.eye(n), -np.eye(n)]), np.append(h, np.full(2 * n, far))
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
            with contextlib.suppress(np.linalg.LinAlgError):
                points[i] = np.linalg.solve(H[meeting], h[meeting])
    points = points[np.all(np.isfinite(points), axis=1)]
    return points[distinct(points, 5e-8 * radius)], radius


def capped_ball(H: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the center and radius of the largest ball in H ξ ≤ h (unit rows), at most 1; −1 for
    none."""
    center, _ = largest_margin(H, h, np.ones(len(h)), 1.0)
    assert center is not None  # a ball of negative radius fits
    return center, min(float((h - H @ center).min()), 1.0)
