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
from jaxmpc.verify.stored_problem import Constraints

# Tangents to a terminal ellipsoid that a linear program gets at most.
TANGENTS = 30
TOLERANCES = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}


def exclude(
    p: Constraints, points: np.ndarray, normals: np.ndarray, bar: tqdm | None = None
) -> np.ndarray:
    """Return by how much points (b, d) lie beyond half-spaces that no feasible state leaves, found
    anew in the directions normals (b, d) or else by least violation; see `exact.beyond`."""
    best, left = np.full(len(points), -np.inf), np.ones(len(points), bool)
    if not len(points):
        return best
    programs = Programs(p)
    box = programs.boxes()
    while left.any():
        first = int(np.flatnonzero(left)[0])
        for y in programs.multipliers(points[first], normals[first]):
            best[left] = np.maximum(best[left], beyond(p, y, points[left], box))
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
                rows = sp.hstack([rows, -np.ones((rows.shape[0], 1))])
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

    def multipliers(self, theta: np.ndarray, normal: np.ndarray) -> Iterator[list[np.ndarray]]:
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
            y = [np.zeros(len(rows)) for rows in p.lower]
            for (k, i, sign), value in zip(self.place, values, strict=False):
                y[k][i] += sign * value
            if p.P is not None:
                weights = values[len(self.place) :]
                y.append(weights @ np.array(self.tangents[: len(weights)]))
            yield y

    def boxes(self) -> tuple[np.ndarray, ...]:
        """Return lower and upper bounds (moves, m) of the inputs and of the states that are not
        mapped: the limits on each alone, and where there are none those of linear programs over all
        trajectories, enlarged by a part in 10⁶ of their size; ±∞ where there are none."""
        p = self.p
        size = int(p.moves.max()) + 1, p.sizes[1]
        low, high = np.full(size, -np.inf), np.full(size, np.inf)
        for move, i, least, most in p.input_rows():
            low[move, i], high[move, i] = max(low[move, i], least), min(high[move, i], most)
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
        return found[0].reshape(size), found[1].reshape(size), found[2], found[3]
