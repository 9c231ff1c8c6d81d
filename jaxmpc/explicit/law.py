"""The MPC law seen from its states: plans, next states, the affine pieces, and ascent over them.

The optimal plan is piecewise affine in the state. Its piece at a state is found from the active
rows of the plan there, as implicit differentiation of the optimality conditions does, and holds
on a polytope, the critical region. So a convex function of the next state can be raised by its
gradient, and within a piece be maximised exactly by a linear program.
"""

import time
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from scipy.optimize import lsq_linear, nnls

from jaxmpc.control.sets import Box, maximise, unit_rows
from jaxmpc.mpc.condense import condense, in_float64
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.status import Status
from jaxmpc.sweeps.plans import Plans, solve_many

# Residuals to which plans are solved.
EPS = 1e-8
# Slack, and error of a reconstructed plan, that count as zero; relative to the data.
TOUCHING, MATCHING = 1e-7, 1e-6
# Gradient ascent: how far inside the half-spaces it stays (on the boundary, where a single plan is
# left, solvers crawl), and step lengths; relative to the size of the set.
INSET = 1e-6
LENGTHS = 0.3 * 0.5 ** np.arange(16)
# At the end regions are climbed: how many at once, in how many rounds, from how many neighbours
# at what distance.
KEPT, ROUNDS, NEIGHBOURS, NEAR = 6, 10, 4, 1e-4


@dataclass(frozen=True)
class Bound:
    """Half-spaces normals·x ≤ offsets (unit rows) that hold on the feasible set, and its centre.

    size: largest distance of a half-space from the centre, the scale of lengths.
    """

    center: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray

    @property
    def size(self) -> float:
        """Scale of lengths."""
        return float(np.max(self.offsets - self.normals @ self.center))

    def excess(self, points: np.ndarray) -> np.ndarray:
        """Largest distance (B,) by which points (B, p) exceed a half-space."""
        return np.max(points @ self.normals.T - self.offsets, axis=1)

    def nearest(self, points: np.ndarray, inset: float = 0.0) -> np.ndarray:
        """The point nearest to each of `points` (B, p) that keeps all half-spaces by `inset`.

        Least distance by non-negative least squares (Lawson & Hanson 1974, ch. 23).
        """
        answer = np.array(points, float)
        room = self.offsets - inset - answer @ self.normals.T
        target = np.append(np.zeros(answer.shape[1]), 1.0)
        for i in np.flatnonzero(room.min(axis=1) < 0):
            scale = -room[i].min()
            E = -np.vstack([self.normals.T, room[i] / scale])
            try:
                y, _ = nnls(E, target, maxiter=20 * E.shape[1])
            except RuntimeError:  # stays outside, where there is no plan
                continue
            r = E @ y - target
            if r[-1] < -1e-12:
                answer[i] -= scale * r[:-1] / r[-1]
        return answer


@dataclass(frozen=True)
class Piece:
    """x⁺ = E x + e on the region R x ≤ r (unit rows) where one set of rows is active."""

    E: np.ndarray
    e: np.ndarray
    R: np.ndarray
    r: np.ndarray


class Law:
    """u_0(x), the first input of the optimal plan, in batches of `chunk` states.

    easy (p,): a state well inside the feasible set, which fills batches up. States may lack the
    previous input where it only has a weight: it is zero then.
    """

    def __init__(self, mpc: MPC, easy: np.ndarray, chunk: int) -> None:
        self.mpc, self.easy, self.chunk = mpc, easy, chunk
        system = mpc.system
        self.A, self.B = np.asarray(system.A, np.float64), np.asarray(system.B, np.float64)
        self.c = np.zeros(system.n) if system.c is None else np.asarray(system.c, np.float64)
        with jax.enable_x64(True):
            self.condensed = c = jax.tree.map(np.asarray, condense(in_float64(mpc)))
        kept = len(c.C) - sum(c.balls)
        up, low = (np.flatnonzero(np.isfinite(v[:kept])) for v in (c.upper, c.lower))
        row, side = np.append(up, low), np.repeat([1.0, -1.0], [len(up), len(low)])
        C, D = side[:, None] * c.C[row], side[:, None] * c.D[row]
        b = side * (np.where(side > 0, c.upper[row], c.lower[row]) - c.d[row])
        size = np.linalg.norm(np.hstack([C, D]), axis=1)
        size[size == 0] = 1.0
        self.C, self.D, self.b = C / size[:, None], D / size[:, None], b / size
        hard = np.full(len(row), np.inf)
        self.rho = hard if c.soft_linear is None else c.soft_linear[row] * size
        self.kappa = 0 * self.b if c.soft_quadratic is None else c.soft_quadratic[row] * size**2

    def filled(self, states: np.ndarray) -> np.ndarray:
        """States (B, p), and `easy` as often as completes the last batch."""
        easy = np.pad(self.easy, (0, states.shape[1] - len(self.easy)))
        return np.vstack([states, np.tile(easy, (-len(states) % self.chunk, 1))])

    def plans(self, states: np.ndarray) -> Plans:
        """Plans from states (B, p), in programs of one shape."""
        found = solve_many(self.mpc, self.filled(states), ADMM(eps=EPS), chunk=self.chunk)
        kept: dict[str, Any] = {
            name: v[: len(states)] for name, v in vars(found).items() if isinstance(v, np.ndarray)
        }
        return replace(found, **kept)

    def limited(self, u: np.ndarray) -> np.ndarray:
        """Inputs (B, m) inside a box of limits: an actuator takes no rounding beyond them."""
        box = self.mpc.inputs
        return np.clip(u, box.lower, box.upper) if isinstance(box, Box) else u

    def following(self, states: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """The states (B, p) after inputs (B, m): A x + B u + c, and u where it is remembered."""
        x = states[:, : self.mpc.system.n]
        after = x @ self.A.T + inputs @ self.B.T + self.c
        return np.hstack([after, inputs])[:, : states.shape[1]]

    def piece(self, state: np.ndarray, inputs: np.ndarray) -> Piece | None:
        """The piece at a state (p,) whose optimal inputs (N, m) are given; None if none is found.

        With P z + F x + f + C_a'y = 0 and C_a z + D_a x = b_a on the active rows a, plan and
        multipliers are affine in x. Non-negative least squares picks independent active rows.
        Violated soft rows add ½κe² + ρe to the cost, and multipliers of soft rows end at ρ.
        """
        c, p = self.condensed, len(state)
        theta = np.append(state, np.zeros(c.D.shape[1] - p))
        moves = (inputs - c.Psi @ theta - c.psi).ravel()
        z = np.linalg.lstsq(c.Omega.reshape(len(moves), -1), moves, rcond=None)[0]
        if c.balls and self._touches_ball(theta, z):
            return None
        excess = self.C @ z + self.D @ theta - self.b
        near = TOUCHING * (1 + np.abs(self.b))
        over, touching = excess > near, np.flatnonzero(np.abs(excess) <= near)
        if np.any(np.isinf(self.rho[over])):  # no plan
            return None
        S = self.kappa[over, None] * self.C[over]
        P = c.P + S.T @ self.C[over]
        # q(x) = Q (x, 1), likewise for the bounds of the active rows.
        Q = np.column_stack([c.F, c.f])
        Q += S.T @ np.column_stack([self.D[over], -self.b[over]])
        Q[:, -1] += self.C[over].T @ self.rho[over]
        one = np.append(theta, 1.0)
        force = -(P @ z + Q @ one)
        y = self._multipliers(self.C[touching].T, force, self.rho[touching])
        scale = 1 + np.abs(force).max(initial=0.0)
        most = y >= self.rho[touching] * (1 - 1e-9)
        active, full = touching[(y > 1e-9 * scale) & ~most], touching[most]
        Q[:, -1] += self.C[full].T @ self.rho[full]
        zero = np.zeros((len(active), len(active)))
        KKT = np.block([[P, self.C[active].T], [self.C[active], zero]])
        right = np.vstack([-Q, np.column_stack([-self.D[active], self.b[active]])])
        try:
            law = np.linalg.solve(KKT, right)
        except np.linalg.LinAlgError:
            return None
        Z, Y = law[: len(z)], law[len(z) :]
        if np.abs(Z @ one - z).max() > MATCHING * (1 + np.abs(z).max()):
            return None
        # Region: inactive rows hold, violated ones stay so, multipliers stay in [0, ρ].
        slack = np.column_stack([self.D, -self.b]) + self.C @ Z
        slack[over | np.isin(np.arange(len(slack)), full)] *= -1
        limited = np.isfinite(self.rho[active])
        above = Y[limited] - np.outer(self.rho[active][limited], np.append(0 * theta, 1.0))
        rows = np.vstack([np.delete(slack, active, axis=0), -Y, above])
        # Columns of a previous input that is not among the states meet a zero; rows that are
        # constant to rounding say nothing.
        rows = np.column_stack([rows[:, :p], rows[:, -1]])
        moving = np.linalg.norm(rows[:, :p], axis=1) > 1e-11 * np.abs(rows).max(axis=1, initial=0.0)
        R, r = rows[moving, :p], -rows[moving, p]
        K = c.Psi[0] + c.Omega[0] @ Z[:, :-1]
        k = c.psi[0] + c.Omega[0] @ Z[:, -1]
        E = np.vstack([self.B @ K[:, :p], K[:, :p]])[:p]
        E[: len(self.A), : len(self.A)] += self.A
        return Piece(E, np.append(self.B @ k + self.c, k)[:p], *unit_rows(R, r))

    def _multipliers(self, A: np.ndarray, force: np.ndarray, rho: np.ndarray) -> np.ndarray:
        """y with A y = force as nearly as can be, 0 ≤ y ≤ rho."""
        if not A.shape[1]:
            return np.zeros(0)
        if np.any(np.isfinite(rho)):
            return lsq_linear(A, force, (0, rho)).x
        try:
            return nnls(A, force, maxiter=20 * A.shape[1])[0]
        except RuntimeError:  # no multipliers, which the check of the plan notices
            return np.zeros(A.shape[1])

    def _touches_ball(self, theta: np.ndarray, z: np.ndarray) -> bool:
        c = self.condensed
        last = slice(len(c.C) - sum(c.balls), None)
        centred = c.C[last] @ z + c.D[last] @ theta + c.d[last] - c.lower[last]
        return bool(np.linalg.norm(centred) > (1 - TOUCHING) * float(np.ravel(c.radius)[0]))


def ascend(law: Law, bound: Bound, starts: np.ndarray, deadline: float) -> np.ndarray:
    """States (K, p) where the next state exceeds a half-space most, the best first.

    starts (S, p) follow the gradient (A + B ∂u_0/∂x)'a_j of v(x) = max_j (a_j'x⁺(x) − b_j) within
    the half-spaces, in steps of halving length of which those are taken that raise v. Then the
    best are led from region to region, each to the maximum of a_j'x⁺ on its region. A local
    method: what it finds is real, what it does not find is not proved absent.
    """
    inset = INSET * bound.size
    x = bound.nearest(starts, inset)
    value, gradient = _value(law, bound, x)
    for length in LENGTHS:
        if time.monotonic() > deadline:
            break
        trial = bound.nearest(x + length * bound.size * gradient, inset)
        better, slope = _value(law, bound, trial, than=value)
        grown = better > value
        x[grown], value[grown], gradient[grown] = trial[grown], better[grown], slope[grown]
    return _climb(law, bound, x, value, deadline)


def _value(
    law: Law, bound: Bound, x: np.ndarray, than: Any = -np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """v (S,) at x (S, p), −inf where there is no plan; its unit gradient where v > than."""
    plans = law.plans(x)
    after = law.following(x, plans.inputs[:, 0])
    beyond = after @ bound.normals.T - bound.offsets
    value = np.where(plans.status == Status.SOLVED, beyond.max(axis=1), -np.inf)
    gradient = np.zeros_like(x)
    for i in np.flatnonzero((value > than) & np.isfinite(value)):
        piece = law.piece(x[i], plans.inputs[i])
        if piece is not None:
            slope = piece.E.T @ bound.normals[np.argmax(beyond[i])]
            gradient[i] = slope / max(np.linalg.norm(slope), 1e-12)
    return value, gradient


def _climb(law: Law, bound: Bound, x: np.ndarray, value: np.ndarray, deadline: float) -> np.ndarray:
    """From the best of x (S, p): to the best vertex of the region there, and on from beside it."""
    random = np.random.default_rng(0)
    inset = INSET * bound.size
    order = np.argsort(-value)[:KEPT]
    best, top = x[order], value[order]
    for tried in range(ROUNDS):
        if time.monotonic() > deadline:
            break
        beside = random.standard_normal((NEIGHBOURS, *best.shape)) * NEAR * bound.size
        around = bound.nearest(np.concatenate([best, *(best + beside)]), inset)
        plans = law.plans(around)
        found = []
        for i in np.flatnonzero(plans.status == Status.SOLVED):
            state, piece = around[i], law.piece(around[i], plans.inputs[i])
            if piece is None:
                continue
            facet = int(np.argmax(bound.normals @ (piece.E @ state + piece.e) - bound.offsets))
            up = piece.E.T @ bound.normals[facet]
            R = np.vstack([piece.R, bound.normals])
            peak = maximise(up, R, np.append(piece.r, bound.offsets)).x
            if peak is not None:
                found.append((float(bound.excess((piece.E @ peak + piece.e)[None])[0]), peak))
        values = np.append(top, [v for v, _ in found])
        states = np.concatenate([best, *(peak[None] for _, peak in found)])
        kept: list[int] = []
        for i in np.argsort(-values):
            if all(np.abs(states[i] - states[j]).max() > 1e-6 * bound.size for j in kept):
                kept.append(int(i))
        before, kept = top.max(initial=-np.inf), kept[:KEPT]
        best, top = states[kept], values[kept]
        if tried > 1 and top.max(initial=-np.inf) <= before + 1e-12 * bound.size:
            break
    return best
