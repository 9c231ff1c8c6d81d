"""A linear model of a nonlinear robot and a set that holds everything it leaves out, by proof.

In deviations ζ = (q − q_s, v) and ν = u − u_s from a set-point, a physics step of length h is

    v⁺ = v + h a(ζ, ν),   q⁺ = q + h v⁺,   a = K ζ + L ν + δ(ζ, ν),

K, L a linear model of the accelerations and δ what it leaves out. So a control period of s steps is
ζ⁺ = A₁ˢ ζ + Σ_j A₁^j B₁ ν + Σ_j A₁^(s−1−j) E δ_j, E = (h² 1; h 1), exactly: bounds of δ where the
robot can be within the period bound what a linear model leaves out of the period.

Bounds of δ come from its polynomials of Taylor, whose second derivatives are enclosed over cells
(`taylor_enclosures.py`). Cells are halved until the bounds are within a tolerance of values that δ
has (branch and bound).
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import host_array
from jaxmpc.checks import fail, require_kind, whole
from jaxmpc.pytrees import record
from jaxmpc.robots.description import host_coordinates
from jaxmpc.robots.intervals import (
    Interval,
    add,
    common,
    guarded,
    hull,
    matrix_product,
    multiply,
    point,
    square,
    subtract,
    total,
)
from jaxmpc.robots.mujoco_access import single_joints
from jaxmpc.robots.physics import RK4
from jaxmpc.robots.robot import Robot
from jaxmpc.robots.taylor_enclosures import Taylor, TaylorProgram, variables
from jaxmpc.sets.convex_sets import Box
from jaxmpc.sets.lp import Program
from jaxmpc.systems.system import LinearSystem

MODELS = ("fitted", "tangent")
# States and inputs at which accelerations are computed: to fit a model, and to judge bounds.
SAMPLES = 4000
# Cells whose polynomials are computed at once.
CHUNK = 1024
# By how much the guess of accelerations within a period exceeds those at its start.
SLACK = 0.2


@record
class LinearEnclosure:
    """A linear model of a robot, and a set that holds what it leaves out.

    For all states in `states` and inputs in `inputs` from which x⁺ of the model lies in `states`,
    the robot's own next state is A x + B u + c + w with a w in `disturbance`.

    system: LinearSystem in coordinates ξ with the robot's names and period. disturbance: Box W
    (n,) that holds 0. states (n,), inputs (m,): Boxes. x (n,), u (m,): the set-point, where the
    model is exact. left_out: Box of the accelerations (nv,) that the linear model lacks. found:
    Box of those that samples lack, which no bound can be less than. cells: how many boxes the
    bounds are proved on.
    """

    system: LinearSystem
    disturbance: Box
    states: Box
    inputs: Box
    x: np.ndarray
    u: np.ndarray
    left_out: Box
    found: Box
    cells: int


def linear_enclosure(
    robot: Robot,
    states: Box | None = None,
    inputs: Box | None = None,
    *,
    target: Any = None,
    model: str = "fitted",
    tolerance: float = 0.02,
    cells: int = 20_000,
) -> LinearEnclosure:
    """Return a linear model of a robot and a box of disturbances that holds what it leaves out.

    A robust MPC of them makes claims about the nonlinear robot: `jaxmpc.closed_loop.enclosed_mpc`.

    Arguments:
        states: Box (n,) of the states to which the claim is limited, the limits of the MPC; None
            for `robot.state_limits`. Every coordinate bounded, positions inside joints' ranges: at
            their ends the plant has springs that no linear model knows.
        inputs: Box (m,), None for `robot.input_limits`.
        target: configuration (nq,) of the set-point, as for `robot.equilibrium`; None: home.
        model: "fitted", the model with the least error of each acceleration on samples of the
            boxes that is exact at the set-point; "tangent", the derivative at the set-point, as
            `robot.linearize` has it (disturbances are two to four times as large).
        tolerance: the bounds end within this fraction of the width of the accelerations found on
            samples, if there are cells enough.
        cells: boxes to compute bounds on, at most; with fewer the bounds hold too and are wider.

    The bounds hold in exact arithmetic for the numbers of the model: those of rounding within the
    plant's program (1e-16 of its numbers in float64, 1e-7 in float32) are not in them. Computed
    outside JAX in float64, rounded outward; not traceable.

    Raises ValueError for robots that are more than a tree of hinges and slides with motors and
    dampers (contacts, couplings, dry friction, tendons, force limits, quaternions, activations,
    integrator RK4), for unbounded boxes or such without the set-point, and where the robot can
    reach the end of a joint's range within a period.
    """
    require_kind("robot", robot, Robot)
    _require_smooth(robot)
    if model not in MODELS:
        fail("model", f"{model!r}", f"Give one of {', '.join(MODELS)}")
    if not 0 < tolerance < 1:
        fail("tolerance", f"{tolerance}", "Give a fraction, as 0.02")
    whole("cells", cells, 1)
    state, u = robot.equilibrium(target)
    x = host_coordinates(robot, state)
    z = np.concatenate([x, u])
    lower, upper = _bounds(robot, states, inputs, z)
    dynamics = _Accelerations(robot, z, lower, upper)
    slope = dynamics.tangent()
    samples, values = dynamics.samples(slope)
    dynamics.require_quadratic(samples[:20], values[:20])
    if model == "fitted":
        slope = _fitted(samples - z, values, slope, dynamics.bent())
    search = _Search(dynamics, slope, values - (samples - z) @ slope.T, tolerance)
    with guarded():
        left_out, count = search.run(cells)
    system, disturbance = _period(robot, x, u, slope, left_out, lower, upper)
    n = robot.n
    return LinearEnclosure(
        system=system,
        disturbance=disturbance,
        states=Box(lower[:n], upper[:n]),
        inputs=Box(lower[n:], upper[n:]),
        x=x,
        u=np.asarray(u),
        left_out=Box(left_out.lower, left_out.upper),
        found=Box(search.least, search.most),
        cells=count,
    )


def _require_smooth(robot: Robot) -> None:
    """Raise ValueError for a robot whose plant is more than smooth rigid bodies with ends of the
    joints' ranges."""
    model = robot.plant.model
    cure = "Take a tree of hinges and slides with motors and dampers, without contacts"
    refused = {
        "ball or free joints": not np.all(single_joints(model)),
        "activation states": model.na,
        "the integrator RK4": model.opt.integrator == RK4,
        "dry friction": np.any(model.dof_frictionloss),
        "couplings": robot.predictor.rows,
        "tendons": model.ntendon,
        "limits of forces": np.any(model.actuator_forcelimited) or np.any(model.jnt_actfrclimited),
        "forces of a fluid": model.opt.density or model.opt.viscosity,
        "numbers that vary": robot.numbers,
    }
    for what, there in refused.items():
        if there:
            fail("robot", f"has {what}, whose bounds are not known", cure)
    if robot.plant.rows and robot.plant.constraints != np.count_nonzero(model.jnt_limited):
        fail("robot", "has contacts, whose bounds are not known", cure)


def _bounds(
    robot: Robot, states: Box | None, inputs: Box | None, z: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper bounds (n + m,) of states and inputs."""
    ends = []
    given = {"states": (states, robot.state_limits, robot.state_names, robot.n)}
    given["inputs"] = (inputs, robot.input_limits, robot.input_names, robot.m)
    start = 0
    for argument, (box, own, names, size) in given.items():
        box = own if box is None else box
        require_kind(argument, box, Box)
        box.validate(argument, size)
        low, high = (host_array(argument, v) for v in box.spread(size).bounds(argument))
        at = z[start : start + size]
        for i, name in enumerate(names):
            if not np.isfinite(low[i]) or not np.isfinite(high[i]):
                cure = f"Give {argument} that are bounded in every coordinate"
                fail(argument, f"{name} has no bounds", cure)
            if not low[i] <= at[i] <= high[i]:
                problem = f"{name} in [{low[i]:g}, {high[i]:g}] leaves out the set-point {at[i]:g}"
                fail(argument, problem, "Give a box around the set-point")
        ends.append((low, high))
        start += size
    return tuple(np.concatenate(parts) for parts in zip(*ends, strict=True))  # type: ignore[return-value]


class _Accelerations:
    """The accelerations a (nv,) as functions of z = (q, v, u) on cells of a box."""

    def __init__(self, robot: Robot, z: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> None:
        self.robot, self.z, self.lower, self.upper = robot, z, lower, upper
        self.nv, self.d = robot.mujoco.nv, len(z)
        self.ends = [0, self.nv, 2 * self.nv, self.d]
        self.program = TaylorProgram(self._coefficients, (self.nv,))

    def _balance(self, q: Array, v: Array, u: Array) -> tuple[Array, Array]:
        return self.robot.predictor.balance(jnp.concatenate([q, v]), u)

    def _coefficients(self, q: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Return M and the coefficients of the force f = f_0 + F_v v + F_u u + v'F_vv v / 2: rigid
        bodies, dampers and motors have no other, so that only q remains to be cut into cells."""
        rest = jnp.zeros(self.nv), jnp.zeros(self.robot.m)

        def force(v: Array, u: Array) -> tuple[Array, tuple[Array, Array]]:
            M, f = self._balance(q, v, u)
            return f, (M, f)

        (F_v, F_u), (M, f) = jax.jacfwd(force, (0, 1), has_aux=True)(*rest)
        F_vv = jax.jacfwd(jax.jacfwd(lambda v: force(v, rest[1])[0]))(rest[0])
        return M, f, F_v, F_u, F_vv

    def require_quadratic(self, points: np.ndarray, values: np.ndarray) -> None:
        """Raise ValueError unless these are the accelerations (points, nv) by the coefficients too:
        others belong to actuators whose gain depends on the speed, and the like."""
        found, _ = self.on_cells(point(points), points)
        by_coefficients = np.stack([a.of.upper[0, : len(points)] for a in found], axis=1)
        if np.abs(by_coefficients - values).max() > 1e-9 * (1 + np.abs(values).max()):
            problem = "has forces that are not quadratic in speeds and affine in inputs"
            fail("robot", problem, "Take motors and linear dampers")

    def samples(self, slope: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points (SAMPLES, d) of the box, half of their coordinates at an end, and the
        accelerations (SAMPLES, nv) there. Points that leave `states` within a period of the model
        with these slopes are moved toward the set-point until they do not."""
        rng = np.random.default_rng(0)
        part = rng.uniform(size=(SAMPLES, self.d))
        part = np.where(rng.uniform(size=part.shape) < 0.5, np.round(part), part)
        points = self.lower + part * (self.upper - self.lower)
        n = self.robot.n
        A, B, *_ = _powers(self.robot, slope)
        room = np.array([self.lower[:n], self.upper[:n]]) - self.z[:n]
        moved = (points - self.z) @ np.hstack([A.upper, B.upper]).T
        with np.errstate(divide="ignore", invalid="ignore"):
            over = np.maximum(moved / room[1], moved / room[0])
        over = np.nanmax(np.where(moved == 0, 0.0, over), axis=1)
        points = self.z + (points - self.z) / np.maximum(over, 1.0)[:, None]
        solved = lambda z: jnp.linalg.solve(*self._balance(*jnp.split(z, self.ends[1:-1])))
        with jax.enable_x64(True):
            values = np.asarray(jax.jit(jax.vmap(solved))(points))
        return points, values

    def tangent(self) -> np.ndarray:
        """Return ∂a/∂z (nv, d) at the set-point."""
        found, _ = self.on_cells(point(self.z[None]), self.z[None])
        k = 1 + np.arange(self.d)
        return np.array([(a.of.lower[k, 0] + a.of.upper[k, 0]) / 2 for a in found])

    def bent(self) -> np.ndarray:
        """Return in which coordinates (nv, d) each acceleration has second derivatives."""
        points = np.random.default_rng(1).uniform(self.lower, self.upper, (20, self.d))
        found, _ = self.on_cells(point(points), points)
        i, j = np.triu_indices(self.d)
        half = (self.upper - self.lower) / 2
        bent = []
        for a in found:
            size = np.abs(a.of.upper[1 + self.d :]).max(axis=1) * half[i] * half[j]
            most = [size[(i == k) | (j == k)].max() for k in range(self.d)]
            bent.append(np.array(most) > 1e-9 * np.abs(a.of.upper[0]).max())
        return np.array(bent)

    def on_cells(self, box: Interval, points: np.ndarray) -> tuple[list[Taylor], np.ndarray]:
        """Return the nv accelerations with derivatives in all of z on cells (cells, d) and at
        points in them, and which cells (cells,) are so large that the mass matrix is not seen to
        be regular: nothing is known there."""
        nv, m, boxes = self.nv, self.robot.m, len(points)
        q = slice(0, nv)
        M, *force = self.program(box[:, q], points[:, q])
        M = [[_entry(M, (i, j)) for j in range(nv)] for i in range(nv)]
        # The coefficients of 1, v, u and v v, of each equation.
        f, F_v, F_u, F_vv = force
        right = [
            [
                _entry(f, i),
                *(_entry(F_v, (i, j)) for j in range(nv)),
                *(_entry(F_u, (i, j)) for j in range(m)),
                *(_entry(F_vv, (i, j, k)) for j in range(nv) for k in range(j, nv)),
            ]
            for i in range(nv)
        ]
        lost = np.zeros(boxes, bool)
        everything = [*sum(M, []), *sum(right, [])]
        like = next((v for v in everything if isinstance(v, Taylor)), None)
        z = variables(box, points, range(self.d))
        like = like or _entry(z, 0)
        with guarded():
            for k in range(nv):  # elimination, down and up: pivots of a mass matrix are positive
                inverse, bad = _inverted(M[k][k], like)
                lost |= bad
                M[k] = [_times(entry, inverse) for entry in M[k]]
                right[k] = [_times(entry, inverse) for entry in right[k]]
                for i in range(nv):
                    if i != k:
                        factor = M[i][k]
                        M[i] = [_less(a, factor, b) for a, b in zip(M[i], M[k], strict=True)]
                        pairs = zip(right[i], right[k], strict=True)
                        right[i] = [_less(a, factor, b) for a, b in pairs]
            v = [_entry(z, nv + j) for j in range(nv)]
            u = [_entry(z, 2 * nv + j) for j in range(m)]
            squares = [
                v[j] * v[k] * (0.5 if j == k else 1.0) for j in range(nv) for k in range(j, nv)
            ]
            found = []
            for constant, *row in right:
                a = _entry(z, 0) * 0.0 + _on(constant, z)
                for coefficient, term in zip(row, [*v, *u, *squares], strict=True):
                    if isinstance(coefficient, Taylor) or coefficient != 0:
                        a = a + term * _on(coefficient, z)
                found.append(a.on(tuple(range(self.d))))
        return found, lost


def _on(coefficient: Any, z: Taylor) -> Any:
    """Return a coefficient, a function of q or a constant, as a function of z."""
    return coefficient.on_steps(z) if isinstance(coefficient, Taylor) else coefficient


def _times(entry: Any, factor: Taylor) -> Any:
    """Return entry · factor, nothing where the entry is the constant 0."""
    if isinstance(entry, Taylor):
        return entry * factor
    return factor * entry if entry != 0 else entry


def _less(entry: Any, factor: Any, other: Any) -> Any:
    """Return entry − factor · other, whichever of them are constants."""
    if any(not isinstance(v, Taylor) and v == 0 for v in (factor, other)):
        return entry
    product = factor * other if isinstance(factor, Taylor) else other * factor
    if isinstance(entry, Taylor) or not isinstance(product, Taylor):
        return entry - product
    return -product + entry


def _entry(of: Any, index: Any) -> Any:
    """Return one entry of an array of functions, or of constants."""
    if not isinstance(of, Taylor):
        return np.asarray(of)[index]
    where = index if isinstance(index, tuple) else (index,)
    return of.mapped(lambda ends: ends[(slice(None), slice(None), *where)])


def _inverted(pivot: Any, like: Taylor) -> tuple[Taylor, np.ndarray]:
    """Return one over a pivot, and the cells where that is not known, 1 in its place."""
    if not isinstance(pivot, Taylor):
        pivot = like.mapped(np.zeros_like) + pivot
    bad = pivot.of.lower[0] <= 0
    if bad.any():
        ends = (pivot.of.lower.copy(), pivot.of.upper.copy())
        for end in ends:
            end[:, bad] = 0.0
            end[0, bad] = 1.0
        pivot = Taylor(pivot.variables, Interval(*ends), pivot.steps)
    return pivot.inverted(), bad[: pivot.boxes]


def _fitted(
    points: np.ndarray, values: np.ndarray, tangent: np.ndarray, bent: np.ndarray
) -> np.ndarray:
    """Return the slopes (nv, d) with the least largest error |value − slope · point| for each
    acceleration, by linear programs; those of the tangent in coordinates (nv, d) that are not
    bent."""
    slopes = tangent.copy()
    for row, column, free in zip(slopes, values.T, bent, strict=True):
        if not free.any():
            continue
        rest = column - points @ row
        P, scale = points[:, free], np.abs(rest).max() or 1.0
        size = np.abs(P).max(axis=0)
        ones = np.ones((len(P), 1))
        rows = np.block([[P / size, -ones], [-P / size, -ones]])
        goal = np.append(np.zeros(P.shape[1]), -1.0)
        best = Program(rows, np.concatenate([rest, -rest]) / scale).maximise(goal)
        row[free] += best.x[:-1] * scale / size  # type: ignore[index]
    return slopes


class _Search:
    """Branch and bound for δ = a − slope (z − z_s): its bounds, by cells."""

    def __init__(
        self, dynamics: _Accelerations, slope: np.ndarray, values: np.ndarray, tolerance: float
    ) -> None:
        self.dynamics, self.slope = dynamics, slope
        self.least, self.most = values.min(axis=0), values.max(axis=0)
        self.slack = tolerance * (self.most - self.least)
        self.dt = dynamics.robot.dt
        n, low, high = dynamics.robot.n, dynamics.lower - dynamics.z, dynamics.upper - dynamics.z
        A, B, _, _ = _powers(dynamics.robot, slope)
        T = np.hstack([(A.lower + A.upper) / 2, (B.lower + B.upper) / 2])
        slack = 1e-9 * (np.abs(T) @ np.maximum(np.abs(low), np.abs(high)) + np.abs(dynamics.z[:n]))
        # The rows of the linear model, and the deviations that the states allow.
        self.next_state = T, low[:n] - slack, high[:n] + slack

    def run(self, most_cells: int) -> tuple[Interval, int]:
        """Return bounds (nv,) of δ wherever the robot is within a period, and the number of
        cells."""
        dynamics = self.dynamics
        lower, upper = dynamics.lower[None], dynamics.upper[None]
        # The accelerations (cells, nv) that a cell is taken to have within a period.
        push = self._start(lower, upper)
        zeros = np.zeros(dynamics.nv)
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

    def _start(self, lower: np.ndarray, upper: np.ndarray) -> Interval:
        """Return a guess of the accelerations within a period."""
        reach = np.maximum(np.abs(lower - self.dynamics.z), np.abs(upper - self.dynamics.z))
        most = reach @ np.abs(self.slope).T + np.maximum(np.abs(self.least), np.abs(self.most))
        return Interval(-2 * most, 2 * most)

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
        D, nv, d, dt = self.dynamics, self.dynamics.nv, self.dynamics.d, self.dt
        q, v = slice(0, nv), slice(nv, 2 * nv)
        # Where the robot is within a period: v + [0, dt] a, then q + [0, dt] v.
        swept = Interval(lower.copy(), upper.copy())
        swept[:, v] = add(swept[:, v], _moved(push, dt))
        swept[:, q] = add(swept[:, q], _moved(swept[:, v], dt))
        middle = (lower + upper) / 2
        found, lost = D.on_cells(swept, middle)
        boxes = slice(0, len(lower))
        centres = slice(len(lower), None)
        step = subtract(swept, point(middle))  # z − middle
        i, j = np.triu_indices(d)
        products = multiply(step[:, i], step[:, j])
        same = i == j
        products[:, same] = multiply(point(0.5), square(step))
        offset = subtract(point(middle), point(D.z))
        deltas, accelerations, scores = [], [], []
        half = (upper - lower) / 2
        for k, a in enumerate(found):
            at, along, bend = a.of[0, centres], a.of[1 : 1 + d, centres], a.of[1 + d :, boxes]
            along = along.mapped(np.transpose)
            curved = _dot(bend.mapped(np.transpose), products)
            whole_range = add(add(at, _dot(along, step)), curved)
            accelerations.append(common(whole_range, a.of[0, boxes]))
            slope = point(self.slope[k])
            rest = subtract(along, slope)
            start = subtract(at, _dot(offset, slope))
            deltas.append(add(add(start, _dot(rest, step)), curved))
            scores.append(self._scores(k, half, rest, along, bend))
        of, acceleration = _stacked(deltas), _stacked(accelerations)
        # The guess of the accelerations must hold those that follow from it.
        kept = (push.lower <= acceleration.lower) & (acceleration.upper <= push.upper)
        again = ~lost & ~kept.all(axis=1)
        bad = lost | again
        of.lower[bad], of.upper[bad] = -np.inf, np.inf
        # Cells without bounds are halved where they are widest, of the whole box.
        relative = half / np.maximum(D.upper - D.lower, np.finfo(float).tiny)
        score = np.sum(scores, axis=0)
        split = np.where(lost, relative.argmax(axis=1), score.argmax(axis=1))
        width = SLACK * (acceleration.upper - acceleration.lower) + 1e-9
        guess = Interval(acceleration.lower - width, acceleration.upper + width)
        guess = Interval(
            np.where(lost[:, None], push.lower, guess.lower),
            np.where(lost[:, None], push.upper, guess.upper),
        )
        # A guess that outgrows the one before by far leads nowhere: the cell is too large.
        outgrown = (guess.upper - guess.lower > 4 * (push.upper - push.lower)).any(axis=1) & again
        guess = Interval(
            np.where(outgrown[:, None], push.lower, guess.lower),
            np.where(outgrown[:, None], push.upper, guess.upper),
        )
        split = np.where(outgrown, relative.argmax(axis=1), split)
        return of, guess, split, swept[:, q], again & ~outgrown

    def _scores(
        self, k: int, half: np.ndarray, rest: Interval, along: Interval, bend: Interval
    ) -> np.ndarray:
        """Return how much each coordinate's width (cells, d) adds to the bounds of δ_k, in parts of
        what δ_k has: by second derivatives, and by how far the robot goes within a period."""
        nv, d, dt = self.dynamics.nv, self.dynamics.d, self.dt
        i, j = np.triu_indices(d)
        size = np.maximum(np.abs(bend.lower), np.abs(bend.upper)).T * half[:, i] * half[:, j]
        score = np.zeros_like(half)
        for a in range(d):
            score[:, a] = size[:, (i == a) | (j == a)].sum(axis=1)
        slope = np.maximum(np.abs(rest.lower), np.abs(rest.upper))
        score[:, nv : 2 * nv] += dt * slope[:, :nv] * half[:, nv : 2 * nv]
        rate = np.maximum(np.abs(along.lower), np.abs(along.upper)) * half
        score += dt * slope[:, nv + k : nv + k + 1] * rate
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


def _moved(rate: Interval, dt: float) -> Interval:
    """Return [0, dt] · rate, dt as the sum of its steps, whatever their rounding."""
    zero = np.zeros_like(rate.lower)
    return multiply(Interval(zero, zero + dt * (1 + 1e-12)), rate)


def _dot(a: Interval, b: Interval) -> Interval:
    """Return Σ_i a_i b_i over the last axis."""
    return total(multiply(a, b), -1)


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


def _powers(robot: Robot, slope: np.ndarray) -> tuple[Interval, Interval, list[Interval], Interval]:
    """Return enclosures of A (n, n) and B (n, m) of the period in deviations, the matrices
    A₁^j E (n, nv), and A₁ itself, for accelerations with these slopes (nv, d)."""
    nv, n = robot.mujoco.nv, robot.n
    h = point(float(robot.plant.model.opt.timestep))
    identity = np.eye(nv)
    E = Interval(np.zeros((n, nv)), np.zeros((n, nv)))
    E[:nv] = multiply(square(h), point(identity))
    E[nv:] = multiply(h, point(identity))
    one = matrix_product(E, point(slope))
    A1, B1 = one[:, :n], one[:, n:]
    free = Interval(np.eye(n), np.eye(n))
    free[:nv, nv:] = multiply(h, point(identity))
    A1 = add(A1, free)
    A, B, ways = point(np.eye(n)), point(np.zeros(B1.lower.shape)), []
    for _ in range(robot.substeps):
        ways.append(matrix_product(A, E))
        B = add(B, matrix_product(A, B1))
        A = matrix_product(A1, A)
    return A, B, ways, A1


def _period(
    robot: Robot,
    x: np.ndarray,
    u: np.ndarray,
    slope: np.ndarray,
    left_out: Interval,
    lower: np.ndarray,
    upper: np.ndarray,
) -> tuple[LinearSystem, Box]:
    """Return the model of a control period, and the box of what it leaves out, rounding of its
    own numbers included."""
    n = robot.n
    with guarded():
        A, B, ways, _ = _powers(robot, slope)
        A_n, B_n = (A.lower + A.upper) / 2, (B.lower + B.upper) / 2
        c = x - A_n @ x - B_n @ u
        zeta = subtract(Interval(lower, upper), point(np.concatenate([x, u])))
        total_error = add(
            _dot(subtract(A, point(A_n)), zeta[:n]), _dot(subtract(B, point(B_n)), zeta[n:])
        )
        at_rest = add(_dot(point(A_n), point(x)), _dot(point(B_n), point(np.asarray(u))))
        shift = subtract(point(x), add(at_rest, point(c)))
        total_error = add(total_error, shift)
        for way in ways:
            total_error = add(total_error, _dot(way, left_out))
    zero = np.zeros(n)
    box = hull(total_error, Interval(zero, zero))
    names = {"state_names": robot.state_names, "state_units": robot.state_units}
    names |= {"input_names": robot.input_names, "input_units": robot.input_units}
    return LinearSystem(A_n, B_n, c, robot.dt, **names), Box(box.lower, box.upper)
