"""The problem as a store has it: JSON data, checked, and its hard constraints as arrays."""

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np

from jaxmpc.checks import fail
from jaxmpc.verify.stored_policy import (
    answer_shape,
    first_rates,
    fits,
    tightened,
    tightened_by_section,
)


def label_shapes(attributes: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    """Return the shapes, a sample, of the variables that hold labels of the problem in these
    attributes, none without a problem. Raises ValueError unless its parts fit one another."""
    problem = attributes.get("problem")
    if not isinstance(problem, dict):
        return {}
    try:
        (n, m), N, d = np.shape(problem["B"])[-2:], problem["horizon"], len(problem["axes"])
        moves, others, ball = problem["moves"], problem["others"]["index"], problem["ellipsoid"]
        fine = (
            type(N) is int
            and np.shape(problem["A"]) in ((n, n), (N, n, n))
            and np.shape(problem["B"]) in ((n, m), (N, n, m))
            and np.shape(problem["c"]) in ((n,), (N, n))
            and len(moves) == N > 0
            and all(type(move) is int and 0 <= move < N for move in moves)
            and sorted([*problem["axes"], *others]) == list(range(n))
            and all(
                _fits(b["H"], b, n)
                and _fits(b["D"], b, m)
                and np.shape(b["lower"]) == np.shape(b["upper"])
                and all(type(k) is int and 0 <= k <= N for k in b["steps"])
                and len(set(b["steps"])) == len(b["steps"])
                for b in problem["rows"]
            )
            and (ball is None or len(np.shape(ball["P"])) == 2)
            and ("disturbance" not in problem or fits(problem["disturbance"], n, m))
        )
    except (LookupError, TypeError, ValueError):
        fine = False
    if not fine:
        what = "its matrices, horizon, rows and axes do not fit each other"
        fail("problem", what, "Overwrite the store")
    shapes: dict[str, tuple[int, ...]] = {"label": (), "status": (), "cut_offset": ()}
    if by_policies(problem):
        shapes |= {"cone": (), "answer": answer_shape(problem["disturbance"], N, m)}
    return {**shapes, "plan": (N, m), "start": (n,), "cut_normal": (d,)}


def by_policies(problem: Mapping[str, Any]) -> bool:
    """Return whether labels of a stored problem rest on affine policies or tubes."""
    return problem.get("disturbance", {}).get("policy") in ("affine", "tube")


def nominal(problem: Mapping[str, Any]) -> dict[str, Any]:
    """Return the stored problem without its disturbances: its rows as they are given."""
    return {name: value for name, value in problem.items() if name != "disturbance"}


def _fits(M: Any, rows: Mapping[str, Any], size: int) -> bool:
    """Return whether a matrix of stored rows has one for each of their bounds, and this many
    columns; it may differ from step to step."""
    count, steps = np.shape(rows["lower"])[-1], len(rows["steps"])
    return np.shape(M) in ((count, size), (0,), (steps, count, size))


class Constraints:
    """The hard constraints as float64 arrays: of each step k = 0..N the rows H[k], D[k], lower[k],
    upper[k], D[N] being zero, and of each step k < N the motion A[k], B[k], c[k]. widest: lower and
    upper of a robust problem rounded outwards, where lower and upper are rounded inwards; else the
    same. plain: the attribute `problem` of the store, JSON data that `FeasibilityProblem.plain`
    describes.

    Of a tube they are those of (z, ζ), whose first step is z_0 = θ − center − G ζ: ζ are states
    that are not mapped, N is larger by one, and the first input, which moves nothing, equals the
    second. Under affine policies rows are as given: `exact_policies.py` has the rest.
    """

    def __init__(self, plain: Mapping[str, Any]) -> None:
        """Stack the rows of each step."""
        self.N, self.moves = plain["horizon"], np.array(plain["moves"])
        self.A, self.B, self.c = (
            _by_step(np.array(plain[name], float), axes, self.N)
            for name, axes in (("A", 2), ("B", 2), ("c", 1))
        )
        self.sizes = n, m = self.B[0].shape
        number = lambda v, none: none if v is None else v
        bound = lambda values, none: np.array(
            [
                [number(w, none) for w in v] if isinstance(v, list) else number(v, none)
                for v in values
            ],
            float,
        )
        rows: list[list[tuple[Any, ...]]] = [[] for _ in range(self.N + 1)]
        for b in plain["rows"]:
            count = len(b["steps"])
            H, D = (
                _by_step(M if M.ndim == 3 else M.reshape(-1, size), 2, count)
                for M, size in ((np.array(b["H"], float), n), (np.array(b["D"], float), m))
            )
            sides = bound(b["lower"], -np.inf), bound(b["upper"], np.inf)
            lower, upper = (_by_step(side, 1, count) for side in sides)
            for k, H_k, D_k, *ends in zip(b["steps"], H, D, lower, upper, strict=True):
                rows[k].append((H_k, D_k if k < self.N else 0 * D_k, *ends))
        none = np.zeros((0, n)), np.zeros((0, m)), np.zeros(0), np.zeros(0)
        stacked = [[np.concatenate(v) for v in zip(none, *at, strict=True)] for at in rows]
        self.H, self.D, self.lower, self.upper = (list(v) for v in zip(*stacked, strict=True))
        self.widest = self.lower, self.upper
        described = plain.get("disturbance", {"policy": ""})
        as_given = self.H, self.D, self.lower, self.upper
        tighten = {"tightened": tightened, "tube": tightened_by_section}.get(described["policy"])
        if tighten is not None:
            both = tighten(described, self.A[0], self.B[0], *as_given)
            (self.lower, self.upper), self.widest = both
        ball = plain["ellipsoid"]
        self.P = None if ball is None else np.zeros((n, n))
        if ball is not None:
            given = np.array(ball["P"], float)
            self.P[: len(given), : len(given)] = given  # type: ignore[index]
            self.level = float(np.asarray(ball["level"]))
        others = plain["others"]
        self.axes, self.others = np.array(plain["axes"], int), np.array(others["index"], int)
        if "value" in others:
            self.low = self.high = np.array(others["value"], float)
        else:
            self.low = bound(others.get("lower", []), -np.inf)
            self.high = bound(others.get("upper", []), np.inf)
        if described["policy"] == "tube":
            self._begin_anywhere(described)

    def _begin_anywhere(self, described: Mapping[str, Any]) -> None:
        """Put the step z_0 = θ − center − G ζ before all others."""
        section = described["section"]
        center, G = (np.asarray(section[name], float) for name in ("center", "generators"))
        (n, m), g, states = self.sizes, G.shape[1], len(center)
        center = np.append(center, np.zeros(n - states))
        wider = lambda M: np.pad(M, [(0, g)] * M.ndim)
        A, B, c = wider(self.A[0]), np.pad(self.B[0], [(0, g), (0, 0)]), wider(self.c[0])
        start = np.zeros((n + g, n + g))
        start[:n, :n], start[:states, n:] = np.eye(n), -G
        self.A, self.B, self.c = [start, *[A] * self.N], [0 * B, *[B] * self.N], [c] * self.N
        self.c = [-np.append(center, np.zeros(g)), *self.c]
        self.H = [np.zeros((0, n + g)), *(np.pad(H, [(0, 0), (0, g)]) for H in self.H)]
        self.D = [np.zeros((0, m)), *self.D]
        lower, upper = self.widest
        if n > states:
            start[n:, n:] = np.eye(g)
            sides = (self.lower[0], self.upper[0]), (lower[0], upper[0])
            rows = self.H[1][:, :n], self.D[1]
            self.H[1][:, n:], inner, outer = first_rates(described, *rows, *sides)
            self.lower, self.upper = [inner[0], *self.lower[1:]], [inner[1], *self.upper[1:]]
            lower, upper = [outer[0], *lower[1:]], [outer[1], *upper[1:]]
        first = [np.zeros(0)]
        self.lower, self.upper = first + self.lower, first + self.upper
        self.widest = first + lower, first + upper
        self.N, self.moves = self.N + 1, np.append(self.moves[:1], self.moves)
        self.sizes = n + g, m
        self.others = np.append(self.others, n + np.arange(g))
        self.low, self.high = np.append(self.low, -np.ones(g)), np.append(self.high, np.ones(g))

    @cached_property
    def equalities(self) -> tuple[list[tuple[int, int]], np.ndarray]:
        """The rows (k, i) with lower = upper that inputs move, and changes (q, N, m) of the inputs
        that change the values of one of these q rows each by about one: the pseudoinverse of the
        matrix by which the moves act on them."""
        n, m = self.sizes
        moves = int(self.moves.max()) + 1
        states, rows, where = np.zeros((moves * m, n)), [], []
        for k in range(self.N + 1):
            u = np.zeros((moves * m, m))
            if k < self.N:
                at = int(self.moves[k]) * m
                u[at : at + m] = np.eye(m)
            values = states @ self.H[k].T + u @ self.D[k].T
            for i in np.flatnonzero((self.lower[k] == self.upper[k]) & np.any(values, axis=0)):
                where.append((k, int(i)))
                rows.append(values[:, i])
            if k < self.N:
                states = states @ self.A[k].T + u @ self.B[k].T
        X = np.linalg.pinv(np.reshape(rows, (-1, moves * m)))
        return where, X.T.reshape(-1, moves, m)[:, self.moves]

    def input_box(self) -> tuple[np.ndarray, np.ndarray]:
        """Return lower and upper bounds (moves, m) of the inputs by the rows that each bound one
        u_i alone, ±∞ where there are none."""
        size = int(self.moves.max()) + 1, self.sizes[1]
        low, high = np.full(size, -np.inf), np.full(size, np.inf)
        for k in range(self.N):
            D = self.D[k]
            alone = (self.H[k] == 0).all(axis=1) & (np.sum(D != 0, axis=1) == 1)
            for row in np.flatnonzero(alone & (np.abs(D).sum(axis=1) == 1)):
                i = int(np.flatnonzero(D[row])[0])
                ends = self.widest[0][k][row], self.widest[1][k][row]
                lower, upper = ends if D[row, i] > 0 else (-ends[1], -ends[0])
                at = self.moves[k], i
                low[at], high[at] = max(low[at], lower), min(high[at], upper)
        return low, high

    def exponent(self, *more: np.ndarray) -> int:
        """Return e such that all data, and these arrays, are integers over 2ᵉ."""
        parts = [*self.A, *self.B, *self.c, self.low, self.high]
        parts += [*self.H, *self.D, *self.lower, *self.upper, *more]
        parts += [*self.widest[0], *self.widest[1]]
        if self.P is not None:
            parts += [self.P, np.array(self.level)]
        return max(0, *(bits(v) for v in parts))


def _by_step(values: np.ndarray, axes: int, steps: int) -> list[np.ndarray]:
    """Return the value at each step of an array that has so many axes at one step, the same array
    where it does not differ."""
    return list(values) if values.ndim > axes else [values] * steps


def bits(values: Any) -> int:
    """Return the least e ≥ 0 for which values·2ᵉ are whole; what is not finite does not count."""
    values = np.asarray(values, float).ravel()
    values = values[np.isfinite(values) & (values != 0)]
    if not len(values):
        return 0
    mantissa, power = np.frexp(values)
    whole = (mantissa * 2.0**53).astype(np.int64)
    zeros = np.log2((whole & -whole).astype(float)).astype(int)
    return int(max(0, np.max(53 - power - zeros)))
