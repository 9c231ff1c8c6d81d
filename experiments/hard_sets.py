"""Labels within 1e-3 … 1e-8 of the boundary of hard feasible sets, against exact answers.

    python experiments/hard_sets.py                    # 2,000 points of each system
    python experiments/hard_sets.py --points 240 --only "x_N = 0" "N = 60"

Points lie on random rays from a point inside, at t (1 ± δ) where t is the end of the ray. On which
side they are is known from rational arithmetic that shares nothing with the library: polygons by
exact elimination in the plane (`tests/exact.py`); in more dimensions a bracket of t, from below
by a plan whose roll-out keeps all rows in rationals, from above by multipliers whose bound is
evaluated in rationals (the plan and the multipliers come from HiGHS on the sparse problem); the
quadratic program of a terminal ellipsoid by all its active sets. The table has a row a system:
points, wrong labels, how many are undecided at each δ, and seconds (with compiling).
"""

import itertools
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction as Q
from pathlib import Path

import numpy as np
import tyro
from scipy.optimize import linprog

import jaxmpc as jm

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
import exact  # noqa: E402

DISTANCES = 10.0 ** -np.arange(3, 9)
# A ray's end is known to this, relative.
BRACKET = 2e-10


@dataclass(frozen=True)
class Settings:
    """points: of each system, about. only: names of systems, all by default. output: the table as
    JSON."""

    points: int = 2000
    only: tuple[str, ...] = ()
    output: Path | None = None


@dataclass(frozen=True)
class Case:
    """A problem and its answer: truth(points) → which are inside; ends(center, directions) → where
    rays end; truth None: shorter rays end inside. scale (d,): of the rays."""

    mpc: jm.MPC
    center: np.ndarray
    ends: Callable[[np.ndarray, np.ndarray], np.ndarray]
    truth: Callable[[np.ndarray], np.ndarray] | None = None
    scale: np.ndarray | None = None


def box(*limits: float) -> jm.Box:
    """{x: |x_i| ≤ limits_i}."""
    return jm.Box(-np.array(limits, float), np.array(limits, float))


def problem(A, B, horizon: int, states=None, inputs=None, c=None, **settings) -> jm.MPC:
    """An MPC problem whose weights play no part."""
    A, B = np.array(A, float), np.array(B, float)
    system = jm.LinearSystem(A, B, c=c)
    n, m = B.shape
    return jm.MPC(system, np.eye(n), np.eye(m), horizon, states, inputs, **settings)


def in_units(mpc: jm.MPC, x: np.ndarray, u: np.ndarray) -> jm.MPC:
    """The same problem in other units: x and u times these powers of two, boxes alike."""
    A, B = np.asarray(mpc.system.A), np.asarray(mpc.system.B)
    scaled = lambda set_, s: None if set_ is None else jm.Box(set_.lower * s, set_.upper * s)
    return replace(
        mpc, system=jm.LinearSystem(x[:, None] * A / x, x[:, None] * B / u),
        states=scaled(mpc.states, x), inputs=scaled(mpc.inputs, u),
        terminal_set=scaled(mpc.terminal_set, x),
    )  # fmt: skip


# ---------------------------------------------------------------------------------------------
# Answers


def planar(mpc: jm.MPC, polygon: exact.Polygon, center=None, scale=None) -> Case:
    """A case whose set is a polygon."""
    a = np.array([[float(v) for v in a] for a, _ in polygon.facets])
    b = np.array([float(b) for _, b in polygon.facets])
    if center is None:
        center = np.mean([[float(v) for v in p] for p in polygon.vertices], axis=0)

    def ends(center, directions):
        slope = directions @ a.T
        with np.errstate(divide="ignore"):
            t = np.where(slope > 0, (b - a @ center) / slope, np.inf).min(axis=1)
        return t

    if scale is None:
        corners = np.array([[float(v) for v in p] for p in polygon.vertices])
        scale = np.minimum(np.ptp(corners, axis=0) / 2, 10.0)
    return Case(mpc, np.asarray(center, float), ends, lambda x: contains(polygon, x), scale)


def contains(polygon: exact.Polygon, points: np.ndarray) -> np.ndarray:
    """Exact membership of points (B, 2), each in rationals."""
    inside = np.ones(len(points), bool)
    x = [exact.rational(p) for p in points]
    for a, b in polygon.facets:
        near = np.flatnonzero(inside)
        inside[near] = [exact.dot(a, x[i]) <= b for i in near]
    return inside


def elimination(mpc: jm.MPC, **settings) -> Case:
    """A planar case by elimination of the inputs."""
    return planar(mpc, exact.feasible_polygon_by_elimination(mpc), **settings)


def recursion(mpc: jm.MPC, **settings) -> Case:
    """A planar case by the backward recursion, where the terminal set may be a point."""
    return planar(mpc, exact.feasible_polygon(mpc), **settings)


def without_rates(mpc: jm.MPC) -> jm.MPC:
    """The same problem with the previous input as states and the rates as outputs."""
    if not mpc.rate_limited:
        return mpc
    A, B = np.asarray(mpc.system.A), np.asarray(mpc.system.B)
    n, m = B.shape
    free = np.full(m, np.inf)
    wide = lambda set_: set_ and jm.Box(np.append(set_.lower, -free), np.append(set_.upper, free))
    limit = np.broadcast_to(np.asarray(mpc.input_rate_limit, float), (m,))
    rates = jm.Outputs(np.hstack([np.zeros((m, n)), -np.eye(m)]), -limit, limit, np.eye(m),
                       stages=tuple(range(mpc.horizon)))  # fmt: skip
    system = jm.LinearSystem(
        np.block([[A, np.zeros((n, m))], [np.zeros((m, n + m))]]), np.vstack([B, np.eye(m)])
    )
    return jm.MPC(system, np.eye(n + m), np.eye(m), mpc.horizon, wide(mpc.states), mpc.inputs,
                  terminal_set=wide(mpc.terminal_set), outputs=(rates,))  # fmt: skip


def bracketed(mpc: jm.MPC, center: np.ndarray) -> Case:
    """A case in more dimensions: ends of rays by HiGHS on the sparse problem, held between a plan
    and a bound that are checked in rationals."""
    plain = without_rates(mpc)
    A, B = np.asarray(plain.system.A), np.asarray(plain.system.B)
    (n, m), N = B.shape, plain.horizon
    unit = np.eye(1 + (N + 1) * n + N * m)
    x, u = (
        unit[1 : 1 + (N + 1) * n].reshape(N + 1, n, -1),
        unit[1 + (N + 1) * n :].reshape(N, m, -1),
    )
    rows, bounds, owner = [], [], []
    every = [exact.stage_rows(plain, k) for k in range(N + 1)]
    for k, stage in enumerate(every):
        for i, (hx, hu, lower, upper) in enumerate(stage):
            row = np.array(hx, float) @ x[k] + (np.array(hu, float) @ u[k] if k < N else 0)
            for sign, limit in ((1, upper), (-1, lower)):
                if limit is not None:
                    rows.append(sign * row)
                    bounds.append(sign * float(limit))
                    owner.append((k, i, sign))
    dynamics = np.concatenate([x[k + 1] - A @ x[k] - B @ u[k] for k in range(N)])
    tight = dict(primal_feasibility_tolerance=1e-10, dual_feasibility_tolerance=1e-10)
    A_, B_ = exact.rational(A), exact.rational(B)
    lows, highs = (exact.rational(v) for v in (plain.inputs.lower, plain.inputs.upper))

    def solve(cost, equal, right, keep=0.0):
        wide = np.array(rows)
        wide[:, 0] += keep
        free = [(None, None)] * unit.shape[0]
        return linprog(-cost, wide, bounds, equal, right, free, options=tight)

    def bound(y) -> tuple[list, Q]:
        """a'x_0 ≤ b for every feasible x_0, in rationals, from multipliers of the rows."""
        multipliers = [[Q(0)] * len(stage) for stage in every]
        total = Q(0)
        for value, (k, i, sign) in zip(y, owner, strict=True):
            value = max(Q(float(value)), Q(0))
            multipliers[k][i] += sign * value
            total += value * sign * every[k][i][3 if sign > 0 else 2]
        p = [Q(0)] * n
        for k in reversed(range(N + 1)):
            if k < N:
                slope = [exact.dot([row[j] for row in B_], p) for j in range(m)]
                p = [exact.dot([row[j] for row in A_], p) for j in range(n)]
            for value, (hx, hu, _, _) in zip(multipliers[k], every[k], strict=True):
                p = [a + value * h for a, h in zip(p, hx, strict=True)]
                if k < N:
                    slope = [a + value * h for a, h in zip(slope, hu, strict=True)]
            if k < N:  # whatever is left is absorbed by the input box
                total += sum(
                    max(-s * lo, -s * hi) for s, lo, hi in zip(slope, lows, highs, strict=True)
                )
        return p, total

    zero = np.zeros(len(dynamics))
    margin = solve(unit[0], np.vstack([dynamics, x[0]]), np.append(zero, center), 1.0)
    inside = margin.x[-N * m :].reshape(N, m)

    def ends(_, directions):
        found = []
        for d in directions:
            start = x[0] - d[:, None] * unit[0]
            result = solve(unit[0], np.vstack([dynamics, start]), np.append(zero, center))
            t, plan = result.x[0], result.x[-N * m :].reshape(N, m)
            s = BRACKET / 2
            low, kept = (
                t * (1 - s),
                np.clip((1 - s) * plan + s * inside, plain.inputs.lower, plain.inputs.upper),
            )
            if not exact.keeps_all_rows(plain, center + low * d, kept):
                found.append(np.inf)
                continue
            a, b = bound(-result.ineqlin.marginals)
            high = (b - exact.dot(a, exact.rational(center))) / exact.dot(a, exact.rational(d))
            found.append(t if high <= Q(t) * (1 + Q(s)) else np.inf)
        return np.array(found)

    return Case(mpc, center, ends)


def ellipsoid(mpc: jm.MPC) -> Case:
    """A terminal ellipsoid and a box of inputs alone: min |x_N|²_P over the box by all active
    sets, in rationals."""
    A, B = exact.rational(mpc.system.A), exact.rational(mpc.system.B)
    P, level = exact.rational(mpc.terminal_set.P), Q(float(mpc.terminal_set.level))
    N, top = mpc.horizon, Q(float(mpc.inputs.upper[0]))
    times = lambda M, v: [exact.dot(row, v) for row in M]
    columns = [[row[0] for row in B]]
    for _ in range(N - 1):
        columns.append(times(A, columns[-1]))
    columns = columns[::-1]  # x_N = A^N x_0 + Σ columns_k u_k
    form = lambda v, w: exact.dot(v, times(P, w))

    def least(x) -> Q:
        free = exact.rational(x)
        for _ in range(N):
            free = times(A, free)
        best = None
        for signs in itertools.product((-1, 0, 1), repeat=N):
            u = [top * s for s in signs]
            loose = [i for i, s in enumerate(signs) if s == 0]
            start = [f + exact.dot([c[j] for c in columns], u) for j, f in enumerate(free)]
            H = [[form(columns[i], columns[j]) for j in loose] for i in loose]
            g = [-form(columns[i], start) for i in loose]
            z = solved(H, g)
            if z is None or any(abs(v) > top for v in z):
                continue
            for i, v in zip(loose, z, strict=True):
                u[i] = v
            end = [f + exact.dot([c[j] for c in columns], u) for j, f in enumerate(free)]
            value = form(end, end)
            best = value if best is None else min(best, value)
        return best

    def ends(center, directions):
        found = []
        for d in directions:
            low, high = 0.0, 1.0
            while least(center + high * d) <= level:
                high *= 2
            for _ in range(45):
                middle = (low + high) / 2
                inside = least(center + middle * d) <= level
                low, high = (middle, high) if inside else (low, middle)
            found.append(low)
        return np.array(found)

    truth = lambda points: np.array([least(x) <= level for x in points])
    return Case(mpc, np.zeros(mpc.system.n), ends, truth)


def solved(H: list, g: list) -> list | None:
    """H⁻¹ g in rationals, None where H is singular."""
    rows = [[*row, value] for row, value in zip(H, g, strict=True)]
    for i in range(len(rows)):
        j = next((j for j in range(i, len(rows)) if rows[j][i] != 0), None)
        if j is None:
            return None
        rows[i], rows[j] = rows[j], rows[i]
        rows[i] = [v / rows[i][i] for v in rows[i]]
        for k in range(len(rows)):
            if k != i:
                rows[k] = [v - rows[k][i] * w for v, w in zip(rows[k], rows[i], strict=True)]
    return [row[-1] for row in rows]


# ---------------------------------------------------------------------------------------------
# Systems

INTEGRATOR = ([[1.0, 1.0], [0.0, 1.0]], [[0.5], [1.0]])
UNSTABLE = ([[1.6, 0.3], [0.0, 1.2]], [[0.4], [1.0]])


def chain(n: int) -> jm.MPC:
    """n coupled stages; only the last is driven."""
    A = 0.9 * np.eye(n) + 0.25 * np.diag(np.ones(n - 1), 1) + 0.1 * np.diag(np.ones(n - 1), -1)
    B = np.zeros((n, 1))
    B[-1] = 0.5
    return problem(A, B, 8, box(*np.ones(n)), box(1.0), terminal_set=box(*(0.8 * np.ones(n))))


def joint(horizon=10) -> jm.MPC:
    """The lesson's joint."""
    return problem([[1, 0.01], [0, 1]], [[0], [0.2]], horizon, box(1.5, 2.0), box(2.0),
                   terminal_set=box(0.3, 0.5))  # fmt: skip


def spiral() -> Case:
    c, s = 1.15 * np.cos(0.6), 1.15 * np.sin(0.6)
    return elimination(problem([[c, s], [-s, c]], [[0.2], [1.0]], 12, box(4, 4), box(1.0)))


def oscillator() -> Case:
    outputs = jm.Outputs(np.array([[1.0, 0.5]]), [-0.6], [0.8], D=np.array([[0.7]]))
    A = [[np.cos(0.4), np.sin(0.4)], [-np.sin(0.4), np.cos(0.4)]]
    return elimination(problem(A, [[0.1], [0.4]], 8, box(2, 2), box(1.0), outputs=outputs))


def non_minimum_phase() -> Case:
    outputs = jm.Outputs(np.array([[-1.0, 1.5]]), [-0.5], [1.0])
    mpc = problem([[1.1, 0.4], [0.0, 0.8]], [[0.0], [0.5]], 30, box(3, 3), box(1.0),
                  input_rate_limit=np.array([0.05]))  # fmt: skip
    plain = replace(mpc, outputs=outputs)
    wide = jm.Outputs(np.array([[-1.0, 1.5, 0.0]]), [-0.5], [1.0])
    same = without_rates(mpc)
    same = replace(same, outputs=(*same.outputs, wide))
    return replace(bracketed(same, np.array([0.05, 0.05, 0.0])), mpc=plain)


def terminal_ellipsoid() -> Case:
    P = np.array([[2.0, 0.3], [0.3, 1.0]])
    return ellipsoid(problem([[1.2, 0.4], [0.1, 0.9]], [[0.1], [0.8]], 3, None, box(1.0),
                             terminal_set=jm.Ellipsoid(P, 0.5)))  # fmt: skip


def equality_and_tiny() -> Case:
    last = jm.Box([0.0, -1e-7], [0.0, 1e-7])
    return recursion(problem(*INTEGRATOR, 6, box(4, 4), box(1.0), terminal_set=last))


def origin() -> Case:
    return recursion(problem(*INTEGRATOR, 6, box(4, 4), box(1.0), terminal_set=box(0, 0)))


def set_point() -> Case:
    last = jm.Box([0.7, 0.1], [0.7, 0.1])
    return recursion(problem([[0.9, 0.4], [-0.3, 1.1]], [[0.15], [0.8]], 9, box(2, 2), box(1.0),
                             terminal_set=last))  # fmt: skip


def polytope_inputs() -> Case:
    angle = np.arange(5) * 2 * np.pi / 5
    H = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    inputs = jm.Polytope(H, np.array([0.5, 0.4, 0.6, 0.5, 0.7]))
    return elimination(
        problem([[1.2, 0.3], [-0.4, 1.1]], [[0.5, 0.2], [0.0, 0.9]], 4, box(2, 2), inputs)
    )


def away_from_zero() -> Case:
    states = jm.Box([2.0, -1.0], [5.0, 1.0])
    return elimination(
        problem(*INTEGRATOR, 8, states, jm.Box([0.3], [1.0]), c=np.array([-0.2, -0.6]))
    )


def decades() -> Case:
    mpc = in_units(joint(), np.array([2.0**-13, 2.0**13]), np.array([1.0]))
    return elimination(mpc, scale=np.array([1.5, 2.0]) * [2.0**-13, 2.0**13])


def micro() -> Case:
    mpc = in_units(joint(), np.full(2, 2.0**-20), np.full(1, 2.0**-20))
    return elimination(mpc)


def long_horizon() -> Case:
    return recursion(problem(*UNSTABLE, 60, box(5, 5), box(1.0)))


def tiny_set() -> Case:
    return elimination(problem(*UNSTABLE, 8, box(1e-6, 1e-6), box(1.0)))


def singular() -> Case:
    return elimination(problem([[1.0, 2.0], [0.5, 1.0]], [[0.5], [-0.3]], 6, box(2, 1), box(0.5)))


def index_set() -> Case:
    return elimination(problem([[1.1, 0.5], [-0.3, 1.0]], [[0.1], [0.7]], 7, box(2, 1), box(0.5),
                               constrained_stages=(2, 5, 7)))  # fmt: skip


def one_sided() -> Case:
    states, inputs = jm.Box([-1e9, -1e9], [1.0, 1e9]), box(0.25)
    return elimination(problem(*INTEGRATOR, 5, states, inputs), center=[0.0, 0.0], scale=[1.0, 1.0])


def one_sided_outputs() -> Case:
    outputs = jm.Outputs(np.array([[1.0, 0.4]]), [-1e9], [1.0], D=np.array([[0.3]]), stages=(1, 3))
    states = jm.Box([-np.inf, -1.0], [1e9, np.inf])
    return elimination(problem([[1.0, 0.3], [-0.2, 1.1]], [[0.2], [0.6]], 5, states, box(1.0),
                               outputs=outputs), center=[0.0, 0.0], scale=[1.0, 1.0])  # fmt: skip


def unbounded_inputs() -> Case:
    return elimination(problem([[1.2, 0.5], [-0.3, 1.4]], [[0.3], [0.8]], 5, box(1, 2), None))


def uncontrollable() -> Case:
    return elimination(problem([[1.3, 0.4], [0.0, 0.9]], [[1.0], [0.0]], 10, box(3, 2), box(1.0),
                               terminal_set=box(1.0, 0.5)))  # fmt: skip


def chain_5() -> Case:
    return bracketed(chain(5), np.zeros(5))


def chain_6() -> Case:
    return bracketed(chain(6), np.zeros(6))


def empty() -> Case:
    """Only x_0 is limited; from (1, 1) full input leads to x_N = 25 and no farther."""
    mpc = problem(*INTEGRATOR, 6, box(1, 1), box(1.0), constrained_stages=(0,),
                  terminal_set=jm.Box([25 + 1e-9, -np.inf], [np.inf, np.inf]))  # fmt: skip
    corner, none = np.ones(2), lambda points: np.zeros(len(points), bool)
    return Case(mpc, corner, lambda c, rays: np.full(len(rays), 1e-3), none)


SYSTEMS = {
    "unstable spiral": spiral,
    "oscillator with D": oscillator,
    "non-minimum phase, rates": non_minimum_phase,
    "terminal ellipsoid": terminal_ellipsoid,
    "x_N = 0": origin,
    "x_N = a set point": set_point,
    "equality, tiny box": equality_and_tiny,
    "polytope of inputs": polytope_inputs,
    "0 outside the limits": away_from_zero,
    "units over 8 decades": decades,
    "the joint times 1e-6": micro,
    "N = 60, unstable": long_horizon,
    "set of size 1e-6": tiny_set,
    "chain of 5": chain_5,
    "chain of 6": chain_6,
    "singular A": singular,
    "index set": index_set,
    "one-sided, 1e9": one_sided,
    "one-sided outputs": one_sided_outputs,
    "unbounded inputs": unbounded_inputs,
    "uncontrollable mode": uncontrollable,
    "empty by 1e-9 of 25": empty,
}


def points_near(case: Case, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points (B, d), which of them are inside, and their relative distances."""
    per_ray = 2 * len(DISTANCES)
    rng = np.random.default_rng(0)
    d = len(case.center)
    rays = rng.standard_normal((max(count // per_ray, 1), d))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    if case.scale is not None:
        rays = rays * case.scale
    t = case.ends(case.center, rays)
    rays, t = rays[t < 1e5], t[t < 1e5]
    shift = np.concatenate([DISTANCES, -DISTANCES])
    points = case.center + rays[:, None] * (t[:, None] * (1 + shift))[:, :, None]
    points, distance = points.reshape(-1, d), np.tile(np.abs(shift), len(t))
    inside = np.tile(shift < 0, len(t)) if case.truth is None else case.truth(points)
    return points, inside, distance


def run(name: str, count: int) -> dict:
    """Return the row of a system."""
    case = SYSTEMS[name]()
    points, inside, distance = points_near(case, count)
    started = time.perf_counter()
    label = jm.map_feasible_set(case.mpc, points).label
    seconds = time.perf_counter() - started
    open_ = [int(np.sum((label == 0) & (distance == delta))) for delta in DISTANCES]
    sides = [int(np.sum((label == 0) & inside)), int(np.sum((label == 0) & ~inside))]
    return {
        "system": name, "points": len(points), "inside": int(inside.sum()),
        "wrong": int(np.sum((label != 0) & (label != np.where(inside, 1, -1)))),
        "undecided": open_, "undecided inside, outside": sides, "seconds": round(seconds, 1),
    }  # fmt: skip


def main(settings: Settings) -> None:
    """Print the table."""
    head = "".join(f"{delta:>7.0e}" for delta in DISTANCES)
    print(f"{'system':26}{'points':>7}{'wrong':>6}{head}{'s':>8}   undecided in, out")
    rows = []
    for name in settings.only or SYSTEMS:
        row = run(name, settings.points)
        rows.append(row)
        cells = "".join(f"{k:7d}" for k in row["undecided"])
        print(f"{name:26}{row['points']:7d}{row['wrong']:6d}{cells}{row['seconds']:8.1f}"
              f"   {row['undecided inside, outside']}", flush=True)  # fmt: skip
        if settings.output is not None:
            settings.output.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main(tyro.cli(Settings))
