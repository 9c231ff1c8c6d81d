"""Bounds of what a linear model of accelerations leaves out, by branch and bound.

A cell of states and inputs is taken together with all places where the robot can be when a physics
step of its control period begins: a guess of the accelerations gives these places, and holds if the
accelerations there lie within the guess. Cells are halved until their bounds are within a tolerance
of values that samples have.
"""

from typing import Any

import numpy as np

from jaxmpc.checks import fail
from jaxmpc.robots.acceleration_enclosures import Accelerations, powers
from jaxmpc.robots.intervals import (
    Interval,
    add,
    common,
    dot,
    hull,
    multiply,
    point,
    square,
    subtract,
)
from jaxmpc.robots.taylor_enclosures import Taylor

# Cells whose polynomials are computed at once.
CHUNK = 1024
# By how much the guess of accelerations within a period exceeds those at its start.
SLACK = 0.2


class Search:
    """Branch and bound for δ = a − slope (z − z_s): its bounds, by cells."""

    def __init__(
        self, dynamics: Accelerations, slope: np.ndarray, values: np.ndarray, tolerance: float
    ) -> None:
        self.dynamics, self.slope = dynamics, slope
        self.least, self.most = values.min(axis=0), values.max(axis=0)
        self.slack = tolerance * (self.most - self.least)
        # From the beginning of a period to that of its last physics step.
        robot = dynamics.robot
        self.span = robot.dt * (robot.substeps - 1) / robot.substeps
        n, low, high = robot.n, dynamics.lower - dynamics.z, dynamics.upper - dynamics.z
        A, B, _, _ = powers(dynamics.robot, slope)
        T = np.hstack([(A.lower + A.upper) / 2, (B.lower + B.upper) / 2])
        slack = 1e-9 * (np.abs(T) @ np.maximum(np.abs(low), np.abs(high)) + np.abs(dynamics.z[:n]))
        # The rows of the linear model, and the deviations that the states allow.
        self.next_state = T, low[:n] - slack, high[:n] + slack

    def run(self, most_cells: int) -> tuple[Interval, int]:
        """Return bounds (nv,) of δ wherever the robot is within a period, and the number of
        cells."""
        dynamics = self.dynamics
        lower, upper = dynamics.lower[None], dynamics.upper[None]
        zeros = np.zeros(dynamics.nv)
        # The accelerations (cells, nv) that a cell is taken to have within a period: NaN where
        # there is no guess yet.
        push = Interval(np.nan + zeros[None], np.nan + zeros[None])
        bounds, count = Interval(zeros, zeros), 0
        while len(lower):
            count += len(lower)
            parts = [
                self._evaluated(lower[i : i + CHUNK], upper[i : i + CHUNK], push[i : i + CHUNK])
                for i in range(0, len(lower), CHUNK)
            ]
            of, push, split, positions, again = map(_joined, zip(*parts, strict=True))
            wide = (of.lower < self.least - self.slack) | (of.upper > self.most + self.slack)
            wide = wide.any(axis=1)
            if count + 2 * np.count_nonzero(wide) > most_cells:
                wide = np.zeros(len(lower), bool)
                if np.any(~np.isfinite(of.lower).all(axis=1) & ~again):
                    problem = f"{most_cells} are too few for bounds to be found at all"
                    fail("cells", problem, "Give more, or smaller boxes of states and inputs")
            wide &= ~again
            done = ~wide & ~again
            if done.any():
                self._require_inside(positions[done])
                bounds = hull(bounds, Interval(of.lower[done].min(0), of.upper[done].max(0)))
            halves = _halved(lower[wide], upper[wide], push[wide], split[wide])
            lower, upper = (
                np.vstack([lower[again], halves[0]]),
                np.vstack([upper[again], halves[1]]),
            )
            push = _joined([push[again], halves[2]])
            lower, upper, near = self._narrowed(lower, upper)
            lower, upper, push = lower[near], upper[near], push[near]
        return bounds, count

    def _narrowed(
        self, lower: np.ndarray, upper: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return cells (cells, d) without what the linear model moves out of the states, and which
        of them are not empty. What is cut off lies outside by more than rounding."""
        D = self.dynamics
        low, high = lower - D.z, upper - D.z
        for row, least, most in zip(*self.next_state, strict=True):
            ends = row * low, row * high
            small, large = np.minimum(*ends), np.maximum(*ends)
            for j in np.flatnonzero(row):
                # least ≤ row·z ≤ most leaves this much for the term of z_j.
                top = most - (small.sum(axis=1) - small[:, j])
                bottom = least - (large.sum(axis=1) - large[:, j])
                first, last = (bottom, top) if row[j] > 0 else (top, bottom)
                low[:, j] = np.maximum(low[:, j], first / row[j])
                high[:, j] = np.minimum(high[:, j], last / row[j])
                high_term, low_term = row[j] * high[:, j], row[j] * low[:, j]
                small[:, j], large[:, j] = (
                    np.minimum(high_term, low_term),
                    np.maximum(high_term, low_term),
                )
        empty = (low > high).any(axis=1)
        # A bound that was not moved stays the number it was.
        lower = np.where(low > lower - D.z, low + D.z, lower)
        upper = np.where(high < upper - D.z, high + D.z, upper)
        return lower, upper, ~empty

    def _evaluated(
        self, lower: np.ndarray, upper: np.ndarray, push: Interval
    ) -> tuple[Interval, Interval, np.ndarray, Interval, np.ndarray]:
        """Return bounds (cells, nv) of δ on cells (±inf where there are none), a guess of the
        accelerations there, the coordinate to halve each cell along, the positions within a
        period, and which cells are to be tried again with that guess."""
        D, half = self.dynamics, (upper - lower) / 2
        swept, middle = self._swept(lower, upper, push), (lower + upper) / 2
        found, lost = D.on_cells(swept, middle)
        of, acceleration, score = self._polynomials(found, swept, middle, half)
        # The guess of the accelerations must hold those that follow from it; those of the cell
        # itself make the first one.
        kept = (push.lower <= acceleration.lower) & (acceleration.upper <= push.upper)
        again = ~lost & ~kept.all(axis=1)
        bad = lost | again
        of.lower[bad], of.upper[bad] = -np.inf, np.inf
        room = SLACK * (acceleration.upper - acceleration.lower) + 1e-9
        guess = Interval(acceleration.lower - room, acceleration.upper + room)
        # A guess that outgrows the one before by far leads nowhere: the cell is too large, as is
        # one without bounds. Such cells are halved where they are widest, of the whole box.
        outgrown = (guess.upper - guess.lower > 2 * (push.upper - push.lower)).any(axis=1) & again
        large = lost | outgrown
        guess.lower[large] = guess.upper[large] = np.nan
        relative = half / np.maximum(D.upper - D.lower, np.finfo(float).tiny)
        split = np.where(large, relative.argmax(axis=1), score.argmax(axis=1))
        return of, guess, split, swept[:, : D.nv], again & ~outgrown

    def _swept(self, lower: np.ndarray, upper: np.ndarray, push: Interval) -> Interval:
        """Return where the robot can be when the physics steps of a period begin that begins in a
        cell (cells, d), under accelerations in push: v + [0, span] a, then q + [0, span] v."""
        nv, swept = self.dynamics.nv, Interval(lower.copy(), upper.copy())
        push = push.mapped(np.nan_to_num)
        q, v = slice(0, nv), slice(nv, 2 * nv)
        swept[:, v] = add(swept[:, v], _moved(push, self.span))
        swept[:, q] = add(swept[:, q], _moved(swept[:, v], self.span))
        return swept

    def _polynomials(
        self, found: list[Taylor], swept: Interval, middle: np.ndarray, half: np.ndarray
    ) -> tuple[Interval, Interval, np.ndarray]:
        """Return bounds of δ and of the accelerations (cells, nv) by their polynomials about the
        middles of cells, f(c) + f'(c) s + s'Hs/2, and the scores (cells, d) of coordinates."""
        D, cells = self.dynamics, len(middle)
        d, boxes, centres = D.d, slice(0, cells), slice(cells, None)
        step = subtract(swept, point(middle))
        i, j = np.triu_indices(d)
        products = multiply(step[:, i], step[:, j])
        products[:, i == j] = multiply(point(0.5), square(step))
        offset = subtract(point(middle), point(D.z))
        deltas, accelerations, scores = [], [], np.zeros_like(half)
        for k, a in enumerate(found):
            at, along, bend = a.of[0, centres], a.of[1 : 1 + d, centres], a.of[1 + d :, boxes]
            along = along.mapped(np.transpose)
            curved = dot(bend.mapped(np.transpose), products)
            whole_range = add(add(at, dot(along, step)), curved)
            accelerations.append(common(whole_range, a.of[0, boxes]))
            slope = point(self.slope[k])
            rest = subtract(along, slope)
            start = subtract(at, dot(offset, slope))
            deltas.append(add(add(start, dot(rest, step)), curved))
            scores += self._scores(k, half, rest, along, bend)
        return _stacked(deltas), _stacked(accelerations), scores

    def _scores(
        self, k: int, half: np.ndarray, rest: Interval, along: Interval, bend: Interval
    ) -> np.ndarray:
        """Return how much each coordinate's width (cells, d) adds to the bounds of δ_k, in parts of
        what δ_k has: by second derivatives, and by how far the robot goes within a period."""
        nv, d, span = self.dynamics.nv, self.dynamics.d, self.span
        i, j = np.triu_indices(d)
        size = np.maximum(np.abs(bend.lower), np.abs(bend.upper)).T * half[:, i] * half[:, j]
        score = np.zeros_like(half)
        for a in range(d):
            score[:, a] = size[:, (i == a) | (j == a)].sum(axis=1)
        slope = np.maximum(np.abs(rest.lower), np.abs(rest.upper))
        score[:, nv : 2 * nv] += span * slope[:, :nv] * half[:, nv : 2 * nv]
        rate = np.maximum(np.abs(along.lower), np.abs(along.upper)) * half
        score += span * slope[:, nv + k : nv + k + 1] * rate
        return score / max(self.most[k] - self.least[k], 1e-12)

    def _require_inside(self, positions: Interval) -> None:
        """Raise ValueError unless positions (cells, nv) are within the ranges of the joints."""
        robot = self.dynamics.robot
        model = robot.plant.model
        for k in range(self.dynamics.nv):
            if not robot.plant.rows or not model.jnt_limited[k]:
                continue
            low, high = model.jnt_range[k] + np.array([1, -1]) * model.jnt_margin[k]
            least, most = positions.lower[:, k].min(), positions.upper[:, k].max()
            if least < low or most > high:
                fail(
                    "states",
                    f"{robot.state_names[k]} comes to [{least:.6g}, {most:.6g}] within a period, "
                    f"and the joint stops at [{low:.6g}, {high:.6g}]",
                    "Give narrower states there, for motion within a period too",
                )


def _moved(rate: Interval, span: float) -> Interval:
    """Return [0, span] · rate, span as the sum of its steps, whatever their rounding."""
    zero = np.zeros_like(rate.lower)
    return multiply(Interval(zero, zero + span * (1 + 1e-12)), rate)


def _stacked(columns: list[Interval]) -> Interval:
    """Return columns (cells,) side by side."""
    return Interval(
        np.stack([c.lower for c in columns], axis=1), np.stack([c.upper for c in columns], axis=1)
    )


def _joined(parts: Any) -> Any:
    """Return arrays, or intervals, one after the other."""
    if isinstance(parts[0], Interval):
        return Interval(
            np.concatenate([p.lower for p in parts]), np.concatenate([p.upper for p in parts])
        )
    return np.concatenate(parts)


def _halved(
    lower: np.ndarray, upper: np.ndarray, push: Interval, split: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Interval]:
    """Return the halves of cells along the coordinates `split` (cells,)."""
    rows = np.arange(len(lower))
    middle = (lower[rows, split] + upper[rows, split]) / 2
    first, second = upper.copy(), lower.copy()
    first[rows, split] = second[rows, split] = middle
    return np.vstack([lower, second]), np.vstack([first, upper]), _joined([push, push])
