"""Linear programs over constraint rows: margins, ends of rays, the bounding box, the centre
(HiGHS)."""

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linprog

from jaxmpc.checks import fail
from jaxmpc.control.geometry import HIGHS
from jaxmpc.feasible.constraint_rows import ConstraintRows

# Tangents of a ball are added to a program up to so often.
TANGENTS = 200
# The least margin of a centre, relative to the size of the bounds.
LEAST_MARGIN = 1e-9


class Solved(NamedTuple):
    """The end of a linear program: its maximum (inf: unbounded, −inf: empty), where it is attained
    (None: nowhere), and the multipliers (R,) of the rows."""

    value: float
    x: np.ndarray | None
    y: np.ndarray


class RowPrograms:
    """Linear programs over the rows of a feasibility problem, which may end in a ball.

    The ball |v| ≤ radius is the intersection of its tangent half-spaces n'v ≤ radius, which are
    added until they suffice. They are kept for the next program (Kelley 1960).
    """

    def __init__(self, rows: ConstraintRows) -> None:
        self.rows, k = rows, sum(rows.balls)
        self.normals = np.concatenate([np.eye(k), -np.eye(k)])
        self.size = float(rows.size)
        equal = (rows.lower == rows.upper) & (np.linalg.norm(rows.U, axis=1) > 0)
        independent = np.linalg.matrix_rank(rows.U[equal], rtol=1e-6) == equal.sum()
        # Equalities that the variables can keep, whatever θ is: they leave no margin.
        self.kept = equal & independent

    def solve_lp(
        self, cost: np.ndarray, U: np.ndarray, lower: np.ndarray, upper: np.ndarray,
        bounds: list[Any], margin: np.ndarray | None = None,
    ) -> Solved:  # fmt: skip
        """Maximise cost'x over lower ≤ U x ≤ upper and the ball.

        margin (R,): the last variable times this is kept from every bound. HiGHS' tolerances are
        absolute: it solves for x in units in which columns and bounds are about 1.
        """
        balls, R = sum(self.rows.balls), len(lower)
        flat, reduced = slice(0, R - balls), np.zeros(R) if margin is None else margin
        top = np.max(np.abs(U), axis=0, initial=0.0)
        top[-1] = max(top[-1], np.max(reduced, initial=0.0))
        unit = self.size / np.where(top > 0, top, 1.0)
        U, reduced = U * (unit / self.size), reduced * (unit[-1] / self.size)
        lower, upper = lower / self.size, upper / self.size
        bounds = [
            tuple(None if v is None else v / one for v in pair)
            for pair, one in zip(bounds, unit, strict=True)
        ]
        cost, length = cost * unit, np.linalg.norm(cost * unit) or 1.0

        up, low = U[flat].copy(), -U[flat]
        up[:, -1] += reduced[flat]
        low[:, -1] += reduced[flat]
        high, has_low = np.isfinite(upper[flat]), np.isfinite(lower[flat])
        A = np.concatenate([up[high], low[has_low]])
        b = np.concatenate([upper[flat][high], -lower[flat][has_low]])
        radius = float(self.rows.radius[0]) / self.size if balls else 0.0
        for _ in range(TANGENTS):
            planes = self.normals @ U[R - balls :]
            planes[:, -1] += reduced[-1] if balls else 0.0
            reach = radius + self.normals @ lower[R - balls :]
            result = linprog(
                -cost / length, A_ub=np.concatenate([A, planes]), b_ub=np.append(b, reach),
                bounds=bounds, options=HIGHS,
            )  # fmt: skip
            if result.x is None or not balls:
                break
            v = U[R - balls :] @ result.x - lower[R - balls :]
            kept = radius - reduced[-1] * result.x[-1]
            norm = np.linalg.norm(v)
            if norm <= kept + 10 * HIGHS["primal_feasibility_tolerance"] * radius:
                break
            self.normals = np.concatenate([self.normals, v[None] / norm])
        y = np.zeros(R)
        if result.x is None:
            return Solved(-np.inf if result.status == 2 else np.inf, None, y)
        found, first, second = -result.ineqlin.marginals, high.sum(), len(A)
        y[flat][high] += found[:first]
        y[flat][has_low] -= found[first:second]
        y[R - balls :] = found[second : second + len(planes)] @ self.normals[: len(planes)]
        return Solved(float(cost @ result.x), result.x * unit, y * (length / self.size))

    def support(self, direction: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Return max direction'θ over the feasible set: the optimum (inf: unbounded, −inf: empty),
        w, and the multipliers of the rows."""
        k = self.rows.U.shape[1]
        U = np.hstack([self.rows.U, self.rows.D])
        return self._maximum(np.append(np.zeros(k), direction), U, np.zeros(len(U)), None)

    def ray(
        self, center: np.ndarray, direction: np.ndarray
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """Return max t ≥ 0 with center + t·direction in the feasible set; results as in
        `support`."""
        rows, k = self.rows, self.rows.U.shape[1]
        U = np.hstack([rows.U, (rows.D @ direction)[:, None]])
        return self._maximum(np.append(np.zeros(k), 1.0), U, rows.D @ center, 0)

    def _maximum(
        self, cost: np.ndarray, U: np.ndarray, shift: np.ndarray, low: float | None
    ) -> tuple[float, np.ndarray, np.ndarray]:
        k = self.rows.U.shape[1]
        bounds = [(None, None)] * k + [(low, None)] * (U.shape[1] - k)
        value, x, y = self.solve_lp(
            cost, U, self.rows.lower - shift, self.rows.upper - shift, bounds
        )
        return value, np.zeros(k) if x is None else x[:k], y

    def margin(self, theta: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return w and the multipliers of the largest s with which all rows at the point θ (d,)
        keep s·size, size (R,) ≥ 0, from their bounds: s < 0 where θ is not feasible.

        Equalities keep no margin, unless nothing feasible is found.
        """
        rows, k = self.rows, self.rows.U.shape[1]
        shift = rows.D @ theta
        U, cost = np.hstack([rows.U, np.zeros((len(rows.U), 1))]), np.append(np.zeros(k), 1.0)
        bounds = [(None, None)] * k + [(None, float(self.size / size.max()))]
        for kept in [np.where(self.kept, 0.0, size), size][: 1 + np.any(self.kept)]:
            found = self.solve_lp(cost, U, rows.lower - shift, rows.upper - shift, bounds, kept)
            if found.x is not None:
                return found.x[:k], found.y
        return np.zeros(k), np.zeros(len(rows.U))

    @cached_property
    def bounding_box(self) -> tuple[np.ndarray | None, np.ndarray]:
        """Return bounds (2, d) of every feasible θ, lower and upper, None where the set is found
        empty; and the multipliers (2d, R) of the upper and then the lower sides.

        Each side is moved out by the larger of the coordinate's two finite ends, which outweighs
        the tolerances of the linear programs.
        """
        d, programs = self.rows.D.shape[1], RowPrograms(self.rows)
        directions = np.concatenate([np.eye(d), -np.eye(d)])
        # Programs of their own, so that no tangent comes from an earlier question.
        ends, _, y = zip(*(programs.support(row) for row in directions), strict=True)
        if -np.inf in ends:
            return None, np.array(y)
        ends = np.reshape(ends, (2, d))
        margin = np.where(np.isfinite(ends), np.abs(ends), 0.0).max(axis=0) + 1e-300
        return np.array([-ends[1] - margin, ends[0] + margin]), np.array(y)

    def centre(self, given: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return θ (the one given, or the best) and w with the largest common margin of all rows,
        but for equalities that the variables can keep.

        Raises ValueError where the set is empty or flat, or does not hold the given θ inside.
        """
        rows = self.rows
        k, d = rows.U.shape[1], rows.D.shape[1]
        size = np.where(self.kept, 0.0, np.linalg.norm(np.hstack([rows.U, rows.D]), axis=1))
        pinned = [(None, None)] * d if given is None else [(v, v) for v in np.asarray(given)]
        ends = np.concatenate([rows.upper, rows.lower])
        largest = max(self.size, np.abs(ends[np.isfinite(ends)]).max(initial=0.0))
        if rows.balls:
            size[-sum(rows.balls) :] = size[-sum(rows.balls) :].max()
        found = self.solve_lp(
            np.eye(k + d + 1)[-1], np.hstack([rows.U, rows.D, np.zeros((len(rows.U), 1))]),
            rows.lower, rows.upper, [(None, None)] * k + pinned + [(None, largest)], size,
        )  # fmt: skip
        if found.x is None or found.x[-1] <= LEAST_MARGIN * self.size:
            if given is not None:
                fail("center", f"{given} is not inside the feasible set", "Give None or another")
            fail(
                "mpc", "its feasible set is empty or flat: no initial state keeps a margin",
                "Relax a limit, lengthen the horizon or enlarge the terminal set",
            )  # fmt: skip
        return found.x[k : k + d], found.x[:k]
