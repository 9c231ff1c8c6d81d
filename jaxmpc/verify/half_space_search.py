"""Half-spaces that exclude states, found anew by linear programs over all trajectories (HiGHS).

Multipliers that prove a state infeasible come from them, in the direction of the stored half-space
or, failing that, of least violation at the state. They need not be accurate: `exact.beyond`
evaluates what they imply exactly. One half-space serves all states that it excludes.
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.optimize import linprog
from tqdm.std import tqdm

from jaxmpc.verify.exact import beyond
from jaxmpc.verify.exact_policies import AffineRows, Multipliers
from jaxmpc.verify.stored_problem import Constraints

# Tangents to a terminal ellipsoid that a linear program gets at most.
TANGENTS = 30
TOLERANCES = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}


def exclude(
    p: Constraints,
    points: np.ndarray,
    normals: np.ndarray,
    bar: tqdm | None = None,
    affine: AffineRows | None = None,
) -> np.ndarray:
    """Return by how much points (b, d) lie beyond half-spaces that no feasible state leaves, found
    anew in the directions normals (b, d) or else by least violation; see `exact.beyond`. affine:
    what affine policies do about disturbances, None without."""
    best, left = np.full(len(points), -np.inf), np.ones(len(points), bool)
    if not len(points):
        return best
    programs = Programs(p) if affine is None else AffinePrograms(p, affine)
    box = programs.boxes()
    while left.any():
        first = int(np.flatnonzero(left)[0])
        for y in programs.multipliers(points[first], normals[first]):
            best[left] = np.maximum(best[left], programs.beyond(y, points[left], box))
            if best[first] > 0:
                break
        done = left & (best > 0)
        done[first] = True  # nothing more to try
        left &= ~done
        if bar is not None:
            bar.update(int(done.sum()))
    return best


class Programs:
    """Linear programs over all trajectories, v = (x_0, …, x_N, moves)."""

    def __init__(self, p: Constraints) -> None:
        """Assemble the equations of motion and the rows."""
        self.p, (n, m) = p, p.sizes
        self.states, self.count = n * (p.N + 1), n * (p.N + 1) + m * (int(p.moves.max()) + 1)
        motion = sp.lil_matrix((n * p.N, self.count))
        parts, bounds, self.place = [], [], []
        for k in range(p.N + 1):
            x = slice(k * n, (k + 1) * n)
            block = sp.lil_matrix((len(p.H[k]), self.count))
            block[:, x] = p.H[k]
            if k < p.N:
                u = slice(self.states + p.moves[k] * m, self.states + (p.moves[k] + 1) * m)
                block[:, u] = p.D[k]
                motion[k * n : (k + 1) * n, x] = -p.A[k]
                motion[k * n : (k + 1) * n, (k + 1) * n : (k + 2) * n] = np.eye(n)
                motion[k * n : (k + 1) * n, u] = -p.B[k]
            for bound, sign in ((p.widest[1][k], 1.0), (p.widest[0][k], -1.0)):
                there = np.flatnonzero(np.isfinite(bound))
                parts.append(sign * block.tocsr()[there])
                bounds.append(sign * bound[there])
                self.place += [(k, int(i), sign) for i in there]
        self.motion, self.drift = motion.tocsr(), np.concatenate(p.c)
        self.rows, self.bounds = sp.vstack(parts).tocsr(), np.concatenate(bounds)
        # How much each row may be violated, in units of the least violation that is looked for.
        self.elastic = np.ones(len(self.bounds))
        self.tangents: list[np.ndarray] = []
        if p.P is not None:  # its box
            there = np.flatnonzero(np.diag(p.P))
            inverse = np.linalg.inv(p.P[np.ix_(there, there)])
            box = np.zeros((len(there), n))
            box[:, there] = inverse
            self.tangents = [*box, *-box]

    def solve(self, cost: np.ndarray, theta: np.ndarray | None = None) -> Any:
        """Return the least cost'v over all trajectories; with theta (d,) the least violation t of
        the rows over those from there instead."""
        p, n = self.p, self.p.sizes[0]
        elastic = theta is not None
        variables = [(None, None)] * self.count
        for i, lower, upper in zip(p.others, p.low, p.high, strict=True):
            variables[i] = (max(lower, -1e300), min(upper, 1e300))
        for i, value in zip(p.axes, [] if theta is None else theta, strict=False):
            variables[i] = (value, value)
        if elastic:
            cost, variables = np.append(np.zeros(self.count), 1.0), [*variables, (None, None)]
        for _ in range(TANGENTS):
            rows, bounds = self.rows, self.bounds
            if self.tangents:
                v = np.array(self.tangents) @ p.P
                extra = sp.lil_matrix((len(v), self.count))
                extra[:, self.states - n : self.states] = v
                values = np.sqrt(p.level * np.sum(v * np.array(self.tangents), axis=1))
                rows, bounds = sp.vstack([rows, extra]), np.append(bounds, values)
            motion = self.motion
            if elastic:
                grown = np.append(self.elastic, np.ones(rows.shape[0] - len(self.elastic)))
                rows = sp.hstack([rows, -grown[:, None]])
                motion = sp.hstack([motion, np.zeros((motion.shape[0], 1))])
            equations = {"A_eq": motion, "b_eq": self.drift, "bounds": variables}
            how = {"method": "highs-ds", "options": TOLERANCES}
            found = linprog(cost, rows, bounds, **equations, **how)
            if found.status != 0 or p.P is None:
                return found
            last = found.x[self.states - n : self.states]
            if last @ p.P @ last <= p.level * (1 + 1e-9):
                return found
            self.tangents.append(last)
        return found

    def multipliers(self, theta: np.ndarray, normal: np.ndarray) -> Iterator[Any]:
        """Yield multipliers of the rows: of the largest normal'θ, then of the least violation from
        theta."""
        p = self.p
        for direct in (True, False):
            if direct and not (np.all(np.isfinite(normal)) and np.any(normal)):
                continue
            cost = np.zeros(self.count)
            cost[p.axes] = -normal / np.abs(normal).max() if direct else 0.0
            found = self.solve(cost, None if direct else theta)
            if found.status != 0:
                continue
            values = -found.ineqlin.marginals
            values[np.abs(values) < 1e-13 * np.abs(values).max(initial=0.0)] = 0.0
            yield self.of_rows(values)

    def of_rows(self, values: np.ndarray) -> Any:
        """Return multipliers of the rows of each step, for `beyond`, from those of the program."""
        p = self.p
        y = [np.zeros(len(rows)) for rows in p.lower]
        for (k, i, sign), value in zip(self.place, values, strict=False):
            y[k][i] += sign * value
        if p.P is not None:
            weights = values[len(self.place) :]
            y.append(weights @ np.array(self.tangents[: len(weights)]))
        return y

    def beyond(self, y: Any, points: np.ndarray, box: tuple[np.ndarray, ...]) -> np.ndarray:
        """Return `exact.beyond` of the half-space that these multipliers imply."""
        return beyond(self.p, y, points, box)

    def boxes(self) -> tuple[np.ndarray, ...]:
        """Return lower and upper bounds (moves, m) of the inputs and of the states that are not
        mapped: the limits on each alone, and where there are none those of linear programs over all
        trajectories, enlarged by a part in 10⁶ of their size; ±∞ where there are none."""
        p, (low, high) = self.p, self.p.input_box()
        found = low.ravel(), high.ravel(), p.low.copy(), p.high.copy()
        place = np.arange(self.states, self.count), p.others
        for (lower, upper), entries in zip((found[:2], found[2:]), place, strict=True):
            for j in np.flatnonzero(~(np.isfinite(lower) & np.isfinite(upper))):
                ends = []
                for sign in (1.0, -1.0):
                    cost = np.zeros(self.count)
                    cost[entries[j]] = sign
                    best = self.solve(cost)
                    ends.append(sign * best.fun if best.status == 0 else -sign * np.inf)
                room = 1e-6 * np.max(np.abs(ends), initial=0.0, where=np.isfinite(ends))
                lower[j], upper[j] = max(lower[j], ends[0] - room), min(upper[j], ends[1] + room)
        return found[0].reshape(low.shape), found[1].reshape(low.shape), found[2], found[3]


class AffinePrograms(Programs):
    """The same over trajectories and affine policies: with X_k (n, k g) and M_k (m, k g), what x_k
    and u_k owe to the ω of the steps before k, and T_k ≥ |H_k X_k + D_k M_k|."""

    def __init__(self, p: Constraints, affine: AffineRows) -> None:
        """Assemble the equations of motion and the rows."""
        super().__init__(p)
        self.affine, (n, m), g = affine, p.sizes, affine.push.shape[1]
        push, middle = (np.asarray(v, float) for v in (affine.push, affine.middle))
        self.drift = self.drift + np.tile(middle, p.N)
        # Columns of X_k, M_k and T_k begin at these places, matrices column by column.
        place, size = np.zeros((3, p.N + 1), int), self.count
        for k in range(1, p.N + 1):
            for j, rows in enumerate((n, m if k < p.N else 0, len(p.H[k]))):
                place[j, k], size = size, size + k * g * rows
        x, u, t = place
        motion, rows = _Entries(), _Entries()
        drift, height = list[np.ndarray](), 0
        for k in range(p.N):
            if k:
                one = sp.identity(k * g)
                motion.put(height, x[k + 1], sp.identity(n * k * g))
                motion.put(height, x[k], -sp.kron(one, p.A[k]))
                motion.put(height, u[k], -sp.kron(one, p.B[k]))
            motion.put(height + n * k * g, x[k + 1] + n * k * g, sp.identity(n * g))
            drift += [np.zeros(n * k * g), push.T.ravel()]
            height += n * (k + 1) * g
        self.t_rows, low = [(0, 0)], 0
        for k in range(1, p.N + 1):
            one, count = sp.identity(k * g), k * g * len(p.H[k])
            for sign in (1.0, -1.0):
                rows.put(low, x[k], sign * sp.kron(one, p.H[k]))
                if k < p.N:
                    rows.put(low, u[k], sign * sp.kron(one, p.D[k]))
                rows.put(low, t[k], -sp.identity(count))
                self.t_rows.append((low, low + count))
                low += count
        ends = _Entries()
        for r, (k, i, _) in enumerate(self.place):
            for column in range(k * g):
                ends.put(r, t[k] + column * len(p.H[k]) + i, np.ones((1, 1)))
        count = len(self.bounds)
        self.rows.resize(count, size)
        self.motion.resize(self.motion.shape[0], size)
        own = self.rows + ends.matrix(count, size)
        self.rows = sp.vstack([own, rows.matrix(low, size)]).tocsr()
        self.motion = sp.vstack([self.motion, motion.matrix(height, size)]).tocsr()
        self.drift = np.concatenate([self.drift, *drift])
        self.bounds = np.append(self.bounds, np.zeros(low))
        self.elastic, self.count = np.append(self.elastic, np.zeros(low)), size

    def of_rows(self, values: np.ndarray) -> Multipliers:
        """Return multipliers of both sides of the rows, and of what they owe to disturbances."""
        p, g = self.p, self.affine.push.shape[1]
        above, below = ([np.zeros(len(H)) for H in p.H] for _ in range(2))
        for (k, i, sign), value in zip(self.place, values, strict=False):
            (above if sign > 0 else below)[k][i] = max(value, 0.0)
        parts, Q = np.maximum(values[len(self.place) :], 0.0), [np.zeros((len(p.H[0]), 0))]
        for k in range(1, p.N + 1):
            plus, minus = (parts[slice(*self.t_rows[2 * k - 1 + i])] for i in range(2))
            Q.append((plus - minus).reshape(k * g, len(p.H[k])).T)
        return Multipliers(above, below, Q)

    def beyond(self, y: Any, points: np.ndarray, box: tuple[np.ndarray, ...]) -> np.ndarray:
        """Return `exact.beyond` of the half-space that these multipliers imply."""
        more = self.affine.more(y, *(ends[self.p.moves] for ends in box[:2]))
        if more is None:
            return np.full(len(points), -np.inf)
        return beyond(self.p, y.difference, points, box, more)

    def boxes(self) -> tuple[np.ndarray, ...]:
        """Return lower and upper bounds (moves, m) of the inputs and of the states that are not
        mapped: the limits on each alone, ±∞ where there are none."""
        return *self.p.input_box(), self.p.low, self.p.high


class _Entries:
    """Entries of a sparse matrix, put there block by block."""

    def __init__(self) -> None:
        self.parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def put(self, row: int, column: int, block: Any) -> None:
        """Put a block with its first entry at this row and column."""
        found = sp.coo_matrix(block)
        self.parts.append((row + found.row, column + found.col, found.data))

    def matrix(self, height: int, width: int) -> Any:
        """Return the matrix."""
        none = np.zeros(0, int), np.zeros(0, int), np.zeros(0)
        row, column, data = (np.concatenate(v) for v in zip(none, *self.parts, strict=True))
        return sp.coo_matrix((data, (row, column)), (height, width)).tocsr()
