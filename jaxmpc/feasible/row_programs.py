"""Linear programs over constraint rows: ends of rays, the bounding box and the centre (HiGHS)."""

from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import linprog

from jaxmpc.checks import fail
from jaxmpc.control.geometry import HIGHS
from jaxmpc.feasible.constraint_rows import ConstraintRows


class RowPrograms:
    """Linear programs over the rows of a feasibility problem, which may end in a ball.

    The ball |v| ≤ radius is the intersection of its tangent half-spaces n'v ≤ radius, which are
    added until they suffice. They are kept for the next program (Kelley 1960).
    """

    def __init__(self, rows: ConstraintRows) -> None:
        self.rows, k = rows, sum(rows.balls)
        self.normals = np.concatenate([np.eye(k), -np.eye(k)])

    def solve_lp(
        self, cost: np.ndarray, U: np.ndarray, lower: np.ndarray, upper: np.ndarray,
        bounds: list[Any], margin: np.ndarray | None = None,
    ) -> tuple[Any, np.ndarray]:  # fmt: skip
        """Maximise cost'x over lower ≤ U x ≤ upper and the ball; return HiGHS' result and
        multipliers (R,).

        margin (R,): the last variable times this is kept from every bound.
        """
        balls, R = sum(self.rows.balls), len(lower)
        flat = slice(0, R - balls)
        size = np.zeros(R) if margin is None else margin
        up, low = U[flat].copy(), -U[flat]
        up[:, -1] += size[flat]
        low[:, -1] += size[flat]
        high, has_low = np.isfinite(upper[flat]), np.isfinite(lower[flat])
        A = np.concatenate([up[high], low[has_low]])
        b = np.concatenate([upper[flat][high], -lower[flat][has_low]])
        radius = float(self.rows.radius[0]) if balls else 0.0
        for _ in range(200):
            planes = self.normals @ U[R - balls :]
            planes[:, -1] += size[-1] if balls else 0.0
            reach = radius + self.normals @ lower[R - balls :]
            result = linprog(
                -cost, A_ub=np.concatenate([A, planes]), b_ub=np.append(b, reach), bounds=bounds,
                options=HIGHS,
            )  # fmt: skip
            if result.x is None or not balls:
                break
            v = U[R - balls :] @ result.x - lower[R - balls :]
            kept = radius - size[-1] * result.x[-1]
            length = np.linalg.norm(v)
            if length <= kept + 10 * HIGHS["primal_feasibility_tolerance"] * radius:
                break
            self.normals = np.concatenate([self.normals, v[None] / length])
        y = np.zeros(R)
        if result.x is not None:
            found, first, second = -result.ineqlin.marginals, high.sum(), len(A)
            y[flat][high] += found[:first]
            y[flat][has_low] -= found[first:second]
            y[R - balls :] = found[second : second + len(planes)] @ self.normals[: len(planes)]
        return result, y

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
        result, y = self.solve_lp(cost, U, self.rows.lower - shift, self.rows.upper - shift, bounds)
        if result.x is None:
            return -np.inf if result.status == 2 else np.inf, np.zeros(k), y
        return float(-result.fun), result.x[:k], y

    @cached_property
    def bounding_box(self) -> tuple[np.ndarray | None, np.ndarray]:
        """Return bounds (2, d) of every feasible θ, lower and upper, None where the set is found
        empty; and the multipliers (2d, R) of the upper and then the lower sides.

        Each side is moved out by the larger of the coordinate's two finite ends, which outweighs
        the tolerances of the linear programs.
        """
        d = self.rows.D.shape[1]
        directions = np.concatenate([np.eye(d), -np.eye(d)])
        ends, _, y = zip(*(self.support(row) for row in directions), strict=True)
        if -np.inf in ends:
            return None, np.array(y)
        ends = np.reshape(ends, (2, d))
        margin = np.where(np.isfinite(ends), np.abs(ends), 0.0).max(axis=0) + 1e-300
        return np.array([-ends[1] - margin, ends[0] + margin]), np.array(y)

    def centre(self, given: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return θ (the one given, or the best) and w with the largest common margin of all rows.

        Raises ValueError where the set is empty or flat, or does not hold the given θ inside.
        """
        rows = self.rows
        k, d = rows.U.shape[1], rows.D.shape[1]
        size = np.linalg.norm(np.hstack([rows.U, rows.D]), axis=1)
        pinned = [(None, None)] * d if given is None else [(v, v) for v in np.asarray(given)]
        ends = np.concatenate([rows.upper, rows.lower])
        largest = max(1.0, np.abs(ends[np.isfinite(ends)]).max(initial=0.0))
        if rows.balls:
            size[-sum(rows.balls) :] = size[-sum(rows.balls) :].max()
        result, _ = self.solve_lp(
            np.eye(k + d + 1)[-1], np.hstack([rows.U, rows.D, np.zeros((len(rows.U), 1))]),
            rows.lower, rows.upper, [(None, None)] * k + pinned + [(None, largest)], size,
        )  # fmt: skip
        if result.x is None or result.x[-1] <= 1e-9:
            if given is not None:
                fail("center", f"{given} is not inside the feasible set", "Give None or another")
            fail(
                "mpc", "its feasible set is empty or flat: no initial state keeps a margin",
                "Relax a limit, lengthen the horizon or enlarge the terminal set",
            )  # fmt: skip
        return result.x[k : k + d], result.x[:k]
