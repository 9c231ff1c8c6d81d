"""The MPC law at given states: plans, next states, and the affine law on the region there.

The optimal plan is piecewise affine in the state. The affine function at a state follows from the
active rows of the plan there, by the optimality conditions, and holds on a polytope, the critical
region.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import scipy

from jaxmpc.arrays import Reals
from jaxmpc.explicit.parametric_program import cost_of_tracking
from jaxmpc.explicit.regions import CriticalRegions
from jaxmpc.mpc.condense import Inequalities, condensed_in_float64
from jaxmpc.mpc.many import solve_many
from jaxmpc.mpc.plan import References
from jaxmpc.mpc.problem import MPC, at_stage
from jaxmpc.pytrees import record
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.status import Status
from jaxmpc.sets.convex_sets import Box
from jaxmpc.sets.geometry import unit_rows
from jaxmpc.systems.system import host_matrices

# Residuals to which plans are solved.
EPS = 1e-8
# Slack, and error of a reconstructed plan, that count as zero; relative to the data.
TOUCHING, MATCHING = 1e-7, 1e-6


@record
class AffinePiece:
    """The closed loop x⁺ = E x + e on the region R x ≤ r where one set of rows is active.

    E (n, n), e (n,): of the next state. R (k, n), r (k,): of the region, unit rows.
    """

    E: np.ndarray
    e: np.ndarray
    R: np.ndarray
    r: np.ndarray


class Law:
    """u_0(x), the first input of the optimal plan, in batches of `chunk` states.

    easy (p,): a state well inside the feasible set, which fills batches up. States may lack the
    previous input where it only has a weight: it is zero then. references: `reference` and
    `input_reference` that plans track, as in `solve`.
    """

    def __init__(self, mpc: MPC, easy: np.ndarray, chunk: int, **references: Reals | None) -> None:
        self.mpc, self.easy, self.chunk = mpc, easy, chunk
        self.references: References = references
        self.A, self.B, self.c = host_matrices(mpc.system)
        c = condensed_in_float64(mpc)
        f: Any = cost_of_tracking(mpc, c, **references)[0]
        self.condensed = c = replace(c, f=f)
        rows, size = Inequalities.of(c).normalised()
        self.C, self.D, self.b = rows.C, rows.D, rows.b
        row = rows.row
        hard = np.full(len(row), np.inf)
        self.rho = hard if c.soft_linear is None else c.soft_linear[row] * size
        self.kappa = 0 * self.b if c.soft_quadratic is None else c.soft_quadratic[row] * size**2

    def filled(self, states: np.ndarray) -> np.ndarray:
        """Return states (B, p), followed by `easy` as often as completes the last batch."""
        easy = np.pad(self.easy, (0, states.shape[1] - len(self.easy)))
        return np.vstack([states, np.tile(easy, (-len(states) % self.chunk, 1))])

    def plans(self, states: np.ndarray) -> "LawPlans":
        """Return the plans from states (B, p), in programs of one shape."""
        found = solve_many(
            self.mpc, self.filled(states), ADMM(eps=EPS), chunk=self.chunk, **self.references
        )
        first = [np.asarray(getattr(found, name))[: len(states)] for name in LawPlans._fields]
        return LawPlans(*first)

    def limited(self, u: np.ndarray) -> np.ndarray:
        """Return inputs (B, m) clipped into a box of limits: an actuator takes no rounding beyond
        them."""
        box = at_stage(self.mpc.inputs, 0)
        if not isinstance(box, Box):
            return u
        return np.clip(u, np.asarray(box.lower), np.asarray(box.upper))

    def following(self, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """Return the states (B, p) after inputs (B, m): A x + B u + c, and u where the state holds
        it."""
        x = states[:, : self.mpc.system.n]
        after = x @ self.A.T + inputs @ self.B.T + self.c
        return np.hstack([after, inputs])[:, : states.shape[1]]

    def piece(self, state: np.ndarray, inputs: np.ndarray) -> AffinePiece | None:
        """Return the affine law at a state (p,) whose optimal inputs (N, m) are given; None if none
        is found.

        With P z + F x + f + C_a'y = 0 and C_a z + D_a x = b_a on the active rows a, plan and
        multipliers are affine in x. Non-negative least squares picks independent active rows.
        Violated soft rows add ½κe² + ρe to the cost, and multipliers of soft rows end at ρ.
        """
        c, p = self.condensed, len(state)
        theta = np.append(state, np.zeros(c.D.shape[1] - p))
        one = np.append(theta, 1.0)
        free = (inputs - c.Psi @ theta - c.psi).ravel()
        z = np.linalg.lstsq(c.Omega.reshape(len(free), -1), free, rcond=None)[0]
        if c.balls and self._touches_ball(theta, z):
            return None
        gap = self.C @ z + self.D @ theta - self.b
        near = np.abs(self.C) @ np.abs(z) + np.abs(self.D) @ np.abs(theta) + np.abs(self.b)
        near = TOUCHING * near
        over, touching = gap > near, np.flatnonzero(np.abs(gap) <= near)
        if np.any(np.isinf(self.rho[over])):  # no plan
            return None
        S = self.kappa[over, None] * self.C[over]
        P = c.P + S.T @ self.C[over]
        # q(x) = Q (x, 1), likewise for the bounds of the active rows.
        Q = np.column_stack([c.F, c.f]) + S.T @ np.column_stack([self.D[over], -self.b[over]])
        Q[:, -1] += self.C[over].T @ self.rho[over]
        force = -(P @ z + Q @ one)
        y = self._multipliers(self.C[touching].T, force, self.rho[touching])
        most = y >= self.rho[touching] * (1 - 1e-9)
        active = touching[(y > 1e-9 * np.abs(force).max(initial=0.0)) & ~most]
        full = touching[most]
        Q[:, -1] += self.C[full].T @ self.rho[full]
        zero = np.zeros((len(active), len(active)))
        KKT = np.block([[P, self.C[active].T], [self.C[active], zero]])
        right = np.vstack([-Q, np.column_stack([-self.D[active], self.b[active]])])
        try:
            law = np.linalg.solve(KKT, right)
        except np.linalg.LinAlgError:
            return None
        Z, Y = law[: len(z)], law[len(z) :]
        size = np.abs(z) + np.abs(Z) @ np.abs(one)
        if np.any(np.abs(Z @ one - z) > MATCHING * np.maximum(size, 1e-3 * size.max())):
            return None
        over[full] = True
        R, r = self._region(Z, Y, active, over, p)
        K = c.Psi[0] + c.Omega[0] @ Z[:, :-1]
        k = c.psi[0] + c.Omega[0] @ Z[:, -1]
        E = np.vstack([self.B @ K[:, :p], K[:, :p]])[:p]
        E[: len(self.A), : len(self.A)] += self.A
        return AffinePiece(E, np.append(self.B @ k + self.c, k)[:p], R, r)

    def _region(
        self, Z: np.ndarray, Y: np.ndarray, active: np.ndarray, over: np.ndarray, p: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return where inactive rows hold, those `over` stay violated or full, and multipliers Y of
        active rows stay in [0, ρ], as unit rows R x ≤ r."""
        slack = np.column_stack([self.D, -self.b]) + self.C @ Z
        slack[over] *= -1
        limited = np.isfinite(self.rho[active])
        above = Y[limited]
        above[:, -1] -= self.rho[active][limited]
        rows = np.vstack([np.delete(slack, active, axis=0), -Y, above])
        # Columns of a previous input that is not among the states meet a zero; rows that are
        # constant to rounding are redundant.
        rows = np.column_stack([rows[:, :p], rows[:, -1]])
        varying = np.linalg.norm(rows[:, :p], axis=1) > 1e-11 * np.abs(rows).max(axis=1, initial=0)
        return unit_rows(rows[varying, :p], -rows[varying, p])

    def _multipliers(self, A: np.ndarray, force: np.ndarray, rho: np.ndarray) -> np.ndarray:
        """Return y with A y = force as nearly as possible and 0 ≤ y ≤ rho."""
        if not A.shape[1]:
            return np.zeros(0)
        if np.any(np.isfinite(rho)):
            return scipy.optimize.lsq_linear(A, force, (0, rho)).x
        try:
            return scipy.optimize.nnls(A, force, maxiter=20 * A.shape[1])[0]
        except RuntimeError:  # no multipliers, which the check of the plan notices
            return np.zeros(A.shape[1])

    def _touches_ball(self, theta: np.ndarray, z: np.ndarray) -> bool:
        """Return whether the plan reaches the boundary of the terminal ellipsoid."""
        c = self.condensed
        last = slice(len(c.C) - sum(c.balls), None)
        centred = c.C[last] @ z + c.D[last] @ theta + c.d[last] - c.lower[last]
        return bool(np.linalg.norm(centred) > (1 - TOUCHING) * float(np.ravel(c.radius)[0]))


class LawPlans(NamedTuple):
    """Plans of a law: inputs (B, N, m), status and residuals (B,), as in `Plan`."""

    inputs: np.ndarray
    status: np.ndarray
    primal_residual: np.ndarray
    dual_residual: np.ndarray


class RegionLaw(Law):
    """The same from critical regions, which compiles nothing for its plans; a state that lies in
    none of them has no plan."""

    def __init__(self, regions: CriticalRegions, easy: np.ndarray, chunk: int) -> None:
        super().__init__(regions.mpc, easy, chunk, **regions.references)
        self.regions = regions

    def plans(self, states: np.ndarray) -> LawPlans:
        """Return the plans from states (B, p), with the largest row violated and the largest entry
        of P z + F x + f + C'y; NaN, ITERATION_LIMIT and inf where no region holds a state."""
        c, where = self.condensed, self.regions.find(states)
        z, y = np.full((len(states), len(c.P)), np.nan), np.zeros((len(states), len(c.C)))
        for i in np.unique(where[where >= 0]):
            region, here = self.regions[i], np.flatnonzero(where == i)
            z[here] = states[here] @ region.Z.T + region.z0
            y[np.ix_(here, region.rows)] = states[here] @ region.L.T + region.l0
        known = where >= 0
        inputs = np.einsum("kmz,bz->bkm", c.Omega, z) + np.einsum("kmp,bp->bkm", c.Psi, states)
        rows = z @ c.C.T + states @ c.D.T + c.d
        violated = np.maximum(rows - c.upper, c.lower - rows).max(axis=1, initial=0.0)
        gradient = z @ c.P.T + states @ c.F.T + c.f + y @ c.C
        return LawPlans(
            inputs + c.psi,
            np.where(known, Status.SOLVED, Status.ITERATION_LIMIT).astype(np.int8),
            np.where(known, violated, np.inf),
            np.where(known, np.abs(gradient).max(axis=1, initial=0.0), np.inf),
        )
