"""The ladder that labels points: short ADMM on all, least-distance Newton on what is left.

For the question "feasible or not" the cost is dropped. In an orthonormal basis U of the range
of the (row-normalised) constraint matrix a zero-cost ADMM step is t⁺ = t + α(U U'r − clip(t)):
the alternating projection of Douglas and Rachford between {U w} and the box of the bounds.
Rows multiplied by √rho_i before U is made are the same as penalties rho_i (`RungPenalties`).
Iterates may be float32. Nothing here decides a label: every candidate, a w or a multiplier,
goes to `proofs.py`.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.optimize import linprog

from jaxmpc.compiled import Compiled
from jaxmpc.mpc.condense import condense, in_float64
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.precision import matmul
from jaxmpc.qp.projection import Bounds
from jaxmpc.qp.refine import least_distance
from jaxmpc.sweeps import proofs
from jaxmpc.sweeps.proofs import Problem, View

ALPHA = 1.6
HIGHS = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
INSET = 1e-10


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rows:
    """Rows of the condensed constraints: lower ≤ (U w)_i + D_i θ ≤ upper, i = 1..R.

    U (R, k) is an orthonormal basis of what the decision variables (inputs, prestabilised or
    not, and in a projection the free states) can do to the normalised rows; back (nz, k) leads
    from w to the variables. A row that nothing moves (k = 0; Euler's q₁ does not feel u₀) has
    U = 0: a half-space on θ alone. weight (R,) brings multipliers to the units of the problem's
    rows, and index says where the multiplier of each row of `proofs.Problem` (step by step, then
    terminal rows, then those of the terminal ellipsoid) stands among the R (R where there is
    none). The last `balls` rows are those of the ellipsoid: |v − lower| ≤ radius. Psi, Omega, psi:
    inputs from θ and the variables. still: the rows that nothing moves, but for those of a ball.
    """

    U: Any
    back: Any
    D: Any
    lower: Any
    upper: Any
    weight: Any
    index: Any
    Psi: Any
    Omega: Any
    psi: Any
    still: Any
    radius: Any
    balls: tuple[int, ...] = field(metadata={"static": True})

    def bounds(self, theta: Array) -> Bounds:
        """What θ leaves for U w."""
        shift = matmul(jnp.asarray(self.D), theta)
        return Bounds(self.lower - shift, self.upper - shift, radius=self.radius, balls=self.balls)


def rows(mpc: MPC, view: View) -> Rows:
    """Condense, restrict to the view and normalise; all on the host in float64."""
    with jax.enable_x64(True):
        c = jax.tree.map(np.asarray, condense(in_float64(proofs.hard_part(mpc))))
    axes, others = list(view.axes), list(view.others)
    C, D, lower, upper = c.C, c.D[:, axes], c.lower - c.d, c.upper - c.d
    Psi, Omega, psi = c.Psi[:, :, axes], c.Omega, c.psi
    extra = 0
    if view.projects:  # rows of the free states' box come first
        extra = len(others)
        C = np.block([[np.zeros((extra, C.shape[1])), np.eye(extra)], [C, c.D[:, others]]])
        D = np.concatenate([np.zeros((extra, len(axes))), D])
        lower, upper = np.append(view.lower, lower), np.append(view.upper, upper)
        Omega = np.concatenate([Omega, c.Psi[:, :, others]], axis=2)
    elif others:
        rest = np.asarray(view.fixed)[others]
        lower, upper = lower - c.D[:, others] @ rest, upper - c.D[:, others] @ rest
        psi = psi + c.Psi[:, :, others] @ rest

    norm = np.linalg.norm(C, axis=1)
    still = norm <= 1e-13 * norm.max(initial=0.0)
    keep = np.flatnonzero(np.isfinite(lower) | np.isfinite(upper))
    size = np.where(still, np.linalg.norm(D, axis=1), norm)
    first = len(size) - sum(c.balls)
    if c.balls:  # one scale for all rows of the ball
        moved = norm[first:].max() > 0
        size[first:] = norm[first:].max() if moved else np.linalg.norm(D[first:], axis=1).max()
    size, still = size[keep], still[keep]
    weight = 1 / np.where(size > 0, size, 1.0)
    scaled = np.where(still[:, None], 0.0, weight[:, None] * C[keep])
    U, singular, Vt = np.linalg.svd(scaled, full_matrices=False)
    rank = int(np.sum(singular > 1e-12 * singular.max(initial=0.0)))
    U, back = np.where(still[:, None], 0.0, U[:, :rank]), Vt[:rank].T / singular[:rank]

    place = np.full(len(lower), len(keep))
    place[keep] = np.arange(len(keep))
    return Rows(
        U, back, weight[:, None] * D[keep], weight * lower[keep], weight * upper[keep], weight,
        multiplier_index(mpc, c.layout, place[extra:], len(keep)), Psi, Omega, psi,
        np.flatnonzero(still[: len(keep) - sum(c.balls)]),
        weight[-1:] * c.radius if c.balls else None, c.balls,
    )  # fmt: skip


@dataclass(frozen=True)
class RungPenalties:
    """Of the first rung: weight (R,) of the rows of `Rows`, the root of ADMM's rho, and its
    over-relaxation. No proof depends on them: they decide which points the rung decides, and what
    the next rungs start from."""

    weight: np.ndarray
    alpha: float = ALPHA


def weighted(rows: Rows, weight: np.ndarray) -> tuple[Rows, np.ndarray]:
    """The rows multiplied by weights > 0 (R,), alike in a ball, and M (k, k): w = M w', the old
    coordinates from the new."""
    U, singular, Vt = np.linalg.svd(weight[:, None] * rows.U, full_matrices=False)
    M = Vt.T / singular
    return replace(
        rows, U=U, back=rows.back @ M, D=weight[:, None] * rows.D, lower=weight * rows.lower,
        upper=weight * rows.upper, weight=weight * rows.weight,
        radius=None if rows.radius is None else weight[-1:] * rows.radius,
    ), M  # fmt: skip


def multiplier_index(mpc: MPC, layout: tuple[Any, ...], place: np.ndarray, none: int) -> np.ndarray:
    """`Rows.index`. place: where each row of the condensed QP stands among those that are kept."""
    N, offset, hard = mpc.horizon, 0, proofs.hard_blocks(proofs.hard_part(mpc))
    columns, last, ball = [], [np.zeros(0, int)], np.zeros(0, int)
    for block, (_, steps, size) in zip(hard, layout, strict=True):
        table = np.full((N + 1, size), none)
        table[list(steps)] = place[offset : offset + len(steps) * size].reshape(-1, size)
        offset += len(steps) * size
        if proofs.absorbed(mpc, block):
            continue
        if block.radius is not None:
            ball = table[N]
            continue
        if any(k < N for k in steps):
            columns.append(table[:N])
        if N in steps:
            last.append(table[N])
    by_step = np.concatenate([np.zeros((N, 0), int), *columns], axis=1)
    return np.concatenate([by_step.ravel(), *last, ball])


class Tangents:
    """A linear program over rows, one of which may be a ball: tangent planes until they suffice.

    The ball |v| ≤ radius is the intersection of its tangent half-spaces n'v ≤ radius. Those found
    for one program serve the next (Kelley 1960).
    """

    def __init__(self, rows: Rows) -> None:
        self.rows, k = rows, sum(rows.balls)
        self.normals = np.concatenate([np.eye(k), -np.eye(k)])

    def solve(
        self, cost: np.ndarray, U: np.ndarray, lower: np.ndarray, upper: np.ndarray,
        bounds: list[Any], margin: np.ndarray | None = None,
    ) -> tuple[Any, np.ndarray]:  # fmt: skip
        """max cost'x over lower ≤ U x ≤ upper and the ball: HiGHS' result, multipliers (R,).

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
            push, first, second = -result.ineqlin.marginals, high.sum(), len(A)
            y[flat][high] += push[:first]
            y[flat][has_low] -= push[first:second]
            y[R - balls :] = push[second : second + len(planes)] @ self.normals[: len(planes)]
        return result, y


def support(
    rows: Rows, direction: np.ndarray, center: np.ndarray | None = None, tangents: Any = None
) -> tuple[float, np.ndarray, np.ndarray]:
    """Without a centre max direction'θ over the set; with one max t ≥ 0 on center + t·direction.

    Returns the optimum (inf: unbounded, −inf: empty), w, and the multipliers of the rows (HiGHS).
    """
    R, k = rows.U.shape
    if center is None:
        U, shift = np.hstack([rows.U, rows.D]), np.zeros(R)
        cost, low = np.append(np.zeros(k), direction), None
    else:
        U, shift = np.hstack([rows.U, (rows.D @ direction)[:, None]]), rows.D @ center
        cost, low = np.append(np.zeros(k), 1.0), 0
    bounds = [(None, None)] * k + [(low, None)] * (U.shape[1] - k)
    program = Tangents(rows) if tangents is None else tangents
    result, y = program.solve(cost, U, rows.lower - shift, rows.upper - shift, bounds)
    if result.x is None:
        return -np.inf if result.status == 2 else np.inf, np.zeros(k), y
    return float(-result.fun), result.x[:k], y


def bounding_box(rows: Rows, otherwise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounds (2, d) of every feasible θ, lower and upper, and the multipliers (2d, R) of the sides.

    Each side is moved out by the larger of the coordinate's two finite ends, which outweighs the
    tolerances of the LPs that find them; where these find the set empty, |θ| ≤ `otherwise`: the
    region that is looked at.
    """
    d = rows.D.shape[1]
    ends, _, y = zip(*(support(rows, s * e) for s in (1.0, -1.0) for e in np.eye(d)), strict=True)
    if -np.inf in ends:
        return np.array([-otherwise, otherwise]), np.array(y)
    ends = np.reshape(ends, (2, d))
    margin = np.where(np.isfinite(ends), np.abs(ends), 0.0).max(axis=0) + 1e-300
    return np.array([-ends[1] - margin, ends[0] + margin]), np.array(y)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Verdict:
    """What was proved of one point: label 1, −1 or 0, and x_0 with inputs, or the half-space
    normal'θ ≤ offset that holds on the whole feasible set and excludes it (∞: none is known, and
    −1 rests on `proofs.cut` at the point)."""

    label: Array
    start: Array
    inputs: Array
    normal: Array
    offset: Array


def inputs_of(p: Problem, rows: Rows, theta: Array, w: Array) -> tuple[Array, Array]:
    """Inputs (N, m) and free states that the coordinates w stand for."""
    variables = matmul(jnp.asarray(rows.back), w)
    inputs = matmul(jnp.asarray(rows.Psi), theta) + matmul(jnp.asarray(rows.Omega), variables)
    free = len(p.view.others) if p.view.projects else 0
    return inputs + rows.psi, variables[len(variables) - free :]


def cut_of(p: Problem, rows: Rows, y: Array) -> tuple[Array, Array, Array]:
    """What multipliers y (R,) of the rows say of every feasible θ: (a, b, w) of `proofs.cut`."""
    y = jnp.append(y * rows.weight, 0.0)[jnp.asarray(rows.index)]
    staged, last = p.horizon * p.H.shape[0], p.H_N.shape[0]
    y_states, y_N, y_ball = jnp.split(y, [staged, staged + last])
    return proofs.cut(p, y_states.reshape(p.horizon, p.H.shape[0]), y_N, y_ball)


def with_broken_limit(rows: Rows, theta: Array, y: Array) -> Array:
    """The multipliers y (R,), or that of one row alone: the one that θ breaks most among the rows
    that nothing moves. It is a proof whatever the inputs, limited or not.
    """
    if not len(rows.still):
        return y
    still, D = jnp.asarray(rows.still), jnp.asarray(rows.D)[rows.still]
    value = D @ theta
    broken = value - jnp.clip(value, rows.lower[still], rows.upper[still])
    worst = jnp.argmax(jnp.abs(broken))
    # Broken by no more than rounding is not broken: then the other rows tell more.
    rounding = 1e-13 * jnp.sum(jnp.abs(D[worst] * theta))
    alone = jnp.where(np.arange(len(y)) == still[worst], jnp.sign(broken[worst]), 0.0)
    return jnp.where(jnp.abs(broken[worst]) > rounding, alone, y)


def judge(p: Problem, rows: Rows, theta: Array, w: Array, candidates: list[Array]) -> Verdict:
    """Try to prove the point θ feasible by w, and infeasible by each candidate multiplier."""
    theta, w = theta.astype(jnp.float64), w.astype(jnp.float64)
    inputs, free = inputs_of(p, rows, theta, w)
    feasible, inputs = proofs.prove_feasible(p, theta, free, inputs)
    zero = jnp.zeros_like(theta)
    normal, offset, slope = zero, jnp.asarray(jnp.inf, jnp.float64), zero
    infeasible = jnp.asarray(False)
    *others, last = (y.astype(jnp.float64) for y in candidates)
    for y in (*others, with_broken_limit(rows, theta, last)):
        cut = cut_of(p, rows, y)
        here = proofs.excludes(*cut, theta) & ~infeasible
        normal, offset, slope = (
            jnp.where(here, new, old) for new, old in zip(cut, (normal, offset, slope), strict=True)
        )
        infeasible = infeasible | here
    normal, offset = proofs.everywhere(p, normal, offset, slope)
    offset = jnp.where(proofs.excludes(normal, offset, zero, theta), offset, jnp.inf)
    label = jnp.where(feasible, 1, jnp.where(infeasible, -1, 0)).astype(jnp.int8)
    return Verdict(label, p.view.initial_state(theta, free), inputs, normal, offset)


def feasibility_steps(
    project: Callable[[Array], Array], onto: Callable[[Array], Array], t: Array, alpha: Any,
    iterations: int,
) -> tuple[Array, Array]:  # fmt: skip
    """Take zero-cost ADMM steps t⁺ = t + α (P (2s − t) − s), s = project(t).

    project: onto the bounds. onto: v → P v, the orthogonal projection onto the range of the rows.
    Returns the last t and the one before.
    """

    def step(t: Array, _: None = None) -> tuple[Array, None]:
        s = project(t)
        return t + alpha * (onto(2 * s - t) - s), None

    before, _ = jax.lax.scan(step, t, length=iterations - 1)
    return step(before)[0], before


@functools.cache
def admm_rung(iterations: int, dtype: Any) -> Compiled:
    """The compiled first rung: (p, rows, points (B, d), alpha) → verdicts and w (B, k)."""

    @jax.jit
    def rung(p: Problem, rows: Rows, points: Array, alpha: Array) -> tuple[Verdict, Array]:
        U, alpha = jnp.asarray(rows.U, dtype), jnp.asarray(alpha, dtype)
        shift = matmul(jnp.asarray(rows.D), points.T)  # (R, B): columns are points
        l = (jnp.asarray(rows.lower)[:, None] - shift).astype(dtype)
        u = (jnp.asarray(rows.upper)[:, None] - shift).astype(dtype)

        project = lambda t: jnp.clip(t, l, u)
        if rows.balls:
            radius = jnp.asarray(rows.radius, dtype)
            one = lambda t, l, u: Bounds(l, u, radius=radius, balls=rows.balls).project(t, 1.0)
            project = lambda t: jax.vmap(one, in_axes=1, out_axes=1)(t, l, u)

        onto = lambda v: matmul(U, matmul(U.T, v))
        t, before = feasibility_steps(project, onto, project(jnp.zeros_like(l)), alpha, iterations)
        excess = lambda t: t - project(t)
        w = matmul(U.T, project(t) - excess(t))
        change = excess(t) - excess(before)
        verdict = jax.vmap(lambda *a: judge(p, rows, a[0], a[1], [a[2], a[3]]))(
            points, w.T, change.T, excess(t).T
        )
        return verdict, w.T

    return Compiled(rung)


@functools.cache
def newton_rung(steps: int) -> Compiled:
    """The compiled second rung: (p, rows, points (B, d), w (B, k)) → verdicts and w."""

    @jax.jit
    def rung(p: Problem, rows: Rows, points: Array, w: Array) -> tuple[Verdict, Array]:
        U = jnp.asarray(rows.U)

        def one(theta: Array, w: Array) -> tuple[Verdict, Array]:
            bounds = rows.bounds(theta)
            l, u = bounds.l, bounds.u
            # The nearest feasible w lies on a face, where a roll-out has no margin for its
            # rounding: aim a little inside. Cuts are judged on the true bounds all the same.
            inset = jnp.minimum(INSET * (1 + jnp.fmin(jnp.abs(l), jnp.abs(u))), (u - l) / 4)
            inner = replace(bounds, l=l + inset, u=u - inset)
            if rows.balls:
                inner = replace(inner, radius=bounds.radius * (1 - INSET))
            w, e = least_distance(U, inner, w.astype(jnp.float64), steps)
            return judge(p, rows, theta, w, [e]), w

        return jax.vmap(one)(points, w)

    return Compiled(rung)
