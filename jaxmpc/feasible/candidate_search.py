"""Stages that find candidates for proofs, plans or multipliers: ADMM, least-distance Newton; and
the check of those that linear programs find.

For the question "feasible or not" the cost is dropped. In an orthonormal basis U of the range
of the (row-normalised) constraint matrix a zero-cost ADMM step is t⁺ = t + α(U U'r − clip(t)):
the alternating projection of Douglas and Rachford between {U w} and the box of the bounds.
Iterates may be float32. No label is decided here: every candidate, a w or a multiplier, is checked
by `proofs.py`.
"""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from jaxmpc.batches import Compiled, Devices, over_devices
from jaxmpc.feasible import proofs
from jaxmpc.feasible.condensed_rows import ConstraintRows
from jaxmpc.feasible.hard_constraints import ExactData
from jaxmpc.feasible.proofs import Verdict
from jaxmpc.qp.linalg import matmul
from jaxmpc.qp.newton import least_distance
from jaxmpc.qp.problem import Bounds

# Over-relaxation of ADMM.
ALPHA = 1.6
INSET = 1e-10
# Newton steps between two attempts at a proof, and number of attempts; decided points drop out.
NEWTON_STEPS = 8
NEWTON_ROUNDS = 8


def inputs_of(p: ExactData, rows: ConstraintRows, theta: Array, w: Array) -> tuple[Array, Array]:
    """Return the inputs (N, m) and free states that the coordinates w stand for."""
    variables = matmul(jnp.asarray(rows.back), w)
    inputs = matmul(jnp.asarray(rows.Psi), theta) + matmul(jnp.asarray(rows.Omega), variables)
    free = len(p.view.others) if p.view.projects else 0
    return inputs + rows.psi, variables[len(variables) - free :]


def cut_of(p: ExactData, rows: ConstraintRows, y: Array) -> proofs.Cut:
    """Return the `proofs.cut` that follows from multipliers y (R,) of the rows."""
    y = jnp.append(y * rows.weight, 0.0)[jnp.asarray(rows.index)]
    staged, last = p.lower.size, p.H_N.shape[0]
    y_states, y_N, y_ball = jnp.split(y, [staged, staged + last])
    return proofs.cut(p, y_states.reshape(p.lower.shape), y_N, y_ball)


def with_violated_limit(rows: ConstraintRows, theta: Array, y: Array) -> Array:
    """Return the multipliers y (R,), or that of a single row: the one that θ violates most,
    relative to its terms, among the zero rows. It is a proof for any inputs, limited
    or not.
    """
    if not len(rows.zero_rows):
        return y
    zero, D = jnp.asarray(rows.zero_rows), jnp.asarray(rows.D)[rows.zero_rows]
    value = D @ theta
    violation = value - jnp.clip(value, rows.lower[zero], rows.upper[zero])
    # A violation within rounding is none: then the other rows may prove more.
    size = jnp.sum(jnp.abs(D * theta), axis=1) + jnp.abs(violation)
    relative = jnp.where(violation == 0, 0.0, jnp.abs(violation) / jnp.where(size > 0, size, 1.0))
    worst = jnp.argmax(relative)
    alone = jnp.where(np.arange(len(y)) == zero[worst], jnp.sign(violation[worst]), 0.0)
    return jnp.where(relative[worst] > 1e-13, alone, y)


def check_candidates(
    p: ExactData, rows: ConstraintRows, theta: Array, w: Array, multipliers: list[Array]
) -> Verdict:
    """Try to prove the point θ feasible by w, and infeasible by each of the multipliers (R,)."""
    theta, w = theta.astype(jnp.float64), w.astype(jnp.float64)
    inputs, free = inputs_of(p, rows, theta, w)
    feasible, inputs = proofs.prove_feasible(p, theta, free, inputs)
    zero = jnp.zeros_like(theta)
    normal, offset, slope = zero, jnp.asarray(jnp.inf, jnp.float64), zero
    infeasible = jnp.asarray(False)
    *others, last = (y.astype(jnp.float64) for y in multipliers)
    for y in (*others, with_violated_limit(rows, theta, last)):
        cut = cut_of(p, rows, y)
        here = proofs.excludes(*cut, theta) & ~infeasible
        normal, offset, slope = (
            jnp.where(here, new, old) for new, old in zip(cut, (normal, offset, slope), strict=True)
        )
        infeasible = infeasible | here
    normal, offset = proofs.everywhere(p, normal, offset, slope)
    offset = proofs.offset_at(normal, offset, theta)
    label = jnp.where(feasible, 1, jnp.where(infeasible, -1, 0)).astype(jnp.int8)
    return Verdict(label, p.view.initial_state(theta, free), inputs, normal, offset)


def feasibility_steps(
    project: Callable[[Array], Array],
    onto: Callable[[Array], Array],
    t: Array,
    iterations: int,
    alpha: float = ALPHA,
) -> tuple[Array, Array]:
    """Take zero-cost ADMM steps t⁺ = t + α (P (2s − t) − s), s = project(t).

    project: onto the bounds. onto: v → P v, the orthogonal projection onto the range of the rows.
    Returns the last t and the one before.
    """
    relaxation = jnp.asarray(alpha, t.dtype)

    def step(t: Array, _: None = None) -> tuple[Array, None]:
        s = project(t)
        return t + relaxation * (onto(2 * s - t) - s), None

    before, _ = jax.lax.scan(step, t, length=iterations - 1)
    return step(before)[0], before


def admm_stage(
    p: ExactData,
    rows: ConstraintRows,
    points: Array,
    iterations: int,
    dtype: DTypeLike,
    alpha: float = ALPHA,
) -> tuple[Verdict, Array]:
    """Return verdicts on points (B, d) after ADMM steps in `dtype`, and the last w (B, k)."""
    U = jnp.asarray(rows.U, dtype)
    shift = matmul(jnp.asarray(rows.D), points.T)  # (R, B): columns are points
    l = (jnp.asarray(rows.lower)[:, None] - shift).astype(dtype)
    u = (jnp.asarray(rows.upper)[:, None] - shift).astype(dtype)
    radius = jnp.asarray(rows.radius, dtype) if rows.balls else None

    def project_one(t: Array, l: Array, u: Array) -> Array:
        return Bounds(l, u, radius=radius, balls=rows.balls).project(t, 1.0)

    def project(t: Array) -> Array:
        if not rows.balls:
            return jnp.clip(t, l, u)
        return jax.vmap(project_one, in_axes=1, out_axes=1)(t, l, u)

    def onto(v: Array) -> Array:
        return matmul(U, matmul(U.T, v))

    def check(theta: Array, w: Array, change: Array, y: Array) -> Verdict:
        return check_candidates(p, rows, theta, w, [change, y])

    t, before = feasibility_steps(project, onto, project(jnp.zeros_like(l)), iterations, alpha)
    residual, earlier = t - project(t), before - project(before)
    w = matmul(U.T, project(t) - residual).T
    return jax.vmap(check)(points, w, (residual - earlier).T, residual.T), w


def newton_stage(
    p: ExactData, rows: ConstraintRows, points: Array, w: Array, steps: int
) -> tuple[Verdict, Array]:
    """Return verdicts on points (B, d) after Newton steps from w (B, k) in float64, and the last
    w."""
    U = jnp.asarray(rows.U)

    def one(theta: Array, w: Array) -> tuple[Verdict, Array]:
        bounds = rows.bounds(theta)
        l, u = bounds.l, bounds.u
        # The nearest feasible w lies on a face, where a roll-out has no margin for its rounding:
        # aim a little inside. Half-spaces are checked on the true bounds all the same.
        size = rows.size + jnp.fmin(jnp.abs(l), jnp.abs(u))
        inset = jnp.minimum(INSET * size, (u - l) / 4)
        inner = replace(bounds, l=l + inset, u=u - inset)
        if rows.balls:
            inner = replace(inner, radius=bounds.radius * (1 - INSET))
        w, e = least_distance(U, inner, w.astype(jnp.float64), steps)
        return check_candidates(p, rows, theta, w, [e]), w

    return jax.vmap(one)(points, w)


class Rounds(NamedTuple):
    """Verdicts on points, the last w (B, k), and how many rounds of Newton steps each had (B,)."""

    verdict: Verdict
    w: Array
    rounds: Array


def newton_rounds(
    p: ExactData,
    rows: ConstraintRows,
    points: Array,
    usable: Array,
    verdict: Verdict,
    w: Array,
    batch: int,
) -> Verdict:
    """Return verdicts on usable points (B, d) after rounds of Newton steps from w (B, k).

    Those that are undecided are gathered in batches of `batch` until none is undecided or each has
    had NEWTON_ROUNDS rounds; those with the fewest rounds come first.
    """

    def waiting(now: Rounds) -> Array:
        return usable & (now.verdict.label == 0) & (now.rounds < NEWTON_ROUNDS)

    def newton(now: Rounds) -> Rounds:
        open_ = waiting(now)
        least = jnp.min(jnp.where(open_, now.rounds, NEWTON_ROUNDS))
        (index,) = jnp.nonzero(open_ & (now.rounds == least), size=batch, fill_value=len(points))

        def take(v: Array) -> Array:
            return v.at[index].get(mode="clip")

        def put(old: Array, new: Array) -> Array:
            return old.at[index].set(new, mode="drop")

        found, better = newton_stage(p, rows, take(points), take(now.w), NEWTON_STEPS)
        verdict = jax.tree.map(put, now.verdict, found)
        return Rounds(verdict, put(now.w, better), now.rounds.at[index].add(1, mode="drop"))

    start = Rounds(verdict, w.astype(jnp.float64), jnp.zeros(len(points), int))
    return jax.lax.while_loop(lambda now: jnp.any(waiting(now)), newton, start).verdict


@functools.cache
def compiled_admm(iterations: int, dtype: DTypeLike, devices: Devices) -> Compiled:
    """Return the compiled ADMM stage: (p, rows, points (B, d)) → verdicts and w (B, k)."""
    stage = functools.partial(admm_stage, iterations=iterations, dtype=dtype)
    return over_devices(stage, devices, (False, False, True))


@functools.cache
def compiled_check(devices: Devices) -> Compiled:
    """Return the compiled proofs: (p, rows, points (B, d), w (B, k), multipliers (B, R)) →
    verdicts."""

    def run(p: ExactData, rows: ConstraintRows, points: Array, w: Array, y: Array) -> Verdict:
        return jax.vmap(lambda theta, w, y: check_candidates(p, rows, theta, w, [y]))(points, w, y)

    return over_devices(run, devices, (False, False, True, True, True))


@functools.cache
def compiled_newton(batch: int, devices: Devices) -> Compiled:
    """Return the compiled `newton_rounds`: (p, rows, points (B, d), usable (B,), verdicts, w (B,
    k)) → verdicts; batch: on each device."""
    rounds = functools.partial(newton_rounds, batch=batch)
    return over_devices(rounds, devices, (False, False, True, True, True, True))
