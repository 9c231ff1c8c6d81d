"""The cascade that finds candidates for proofs: short ADMM, then least-distance Newton steps.

For the question "feasible or not" the cost is dropped. In an orthonormal basis U of the range
of the (row-normalised) constraint matrix a zero-cost ADMM step is t⁺ = t + α(U U'r − clip(t)):
the alternating projection of Douglas and Rachford between {U w} and the box of the bounds.
Rows multiplied by √rho_i before U is made are the same as penalties rho_i (`StagePenalties`).
Iterates may be float32. Nothing here decides a label: every candidate, a w or a multiplier,
goes to `proofs.py`.
"""

import functools
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.compiled import Compiled
from jaxmpc.feasible import proofs
from jaxmpc.feasible.constraint_rows import ConstraintRows
from jaxmpc.feasible.exact_data import ExactData
from jaxmpc.qp.precision import matmul
from jaxmpc.qp.projection import Bounds
from jaxmpc.qp.refine import least_distance

ALPHA = 1.6
INSET = 1e-10


@dataclass(frozen=True)
class StagePenalties:
    """Penalties of the ADMM stage: weight (R,) of the constraint rows, the root of ADMM's rho, and
    the over-relaxation alpha. No proof depends on them: they decide which points this stage
    decides, and what the next stages start from."""

    weight: np.ndarray
    alpha: float = ALPHA


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Verdict:
    """What was proved of one point, and by what.

    label: 1 feasible, −1 infeasible, 0 undecided. start (n,), inputs (N, m): x_0 and the inputs
    that prove 1. normal (d,), offset: the half-space normal'θ ≤ offset that holds on the whole
    feasible set and excludes the point; ∞ where none is known, and −1 rests on `proofs.cut` at the
    point.
    """

    label: Array
    start: Array
    inputs: Array
    normal: Array
    offset: Array


def inputs_of(p: ExactData, rows: ConstraintRows, theta: Array, w: Array) -> tuple[Array, Array]:
    """Inputs (N, m) and free states that the coordinates w stand for."""
    variables = matmul(jnp.asarray(rows.back), w)
    inputs = matmul(jnp.asarray(rows.Psi), theta) + matmul(jnp.asarray(rows.Omega), variables)
    free = len(p.view.others) if p.view.projects else 0
    return inputs + rows.psi, variables[len(variables) - free :]


def cut_of(p: ExactData, rows: ConstraintRows, y: Array) -> tuple[Array, Array, Array]:
    """The bound (a, b, w) of `proofs.cut` that follows from multipliers y (R,) of the rows."""
    y = jnp.append(y * rows.weight, 0.0)[jnp.asarray(rows.index)]
    staged, last = p.horizon * p.H.shape[0], p.H_N.shape[0]
    y_states, y_N, y_ball = jnp.split(y, [staged, staged + last])
    return proofs.cut(p, y_states.reshape(p.horizon, p.H.shape[0]), y_N, y_ball)


def with_broken_limit(rows: ConstraintRows, theta: Array, y: Array) -> Array:
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


@functools.cache
def admm_stage(iterations: int, dtype: Any) -> Compiled:
    """The compiled ADMM stage: (p, rows, points (B, d), alpha) → verdicts and w (B, k)."""

    @jax.jit
    def stage(
        p: ExactData, rows: ConstraintRows, points: Array, alpha: Array
    ) -> tuple[Verdict, Array]:
        U, alpha = jnp.asarray(rows.U, dtype), jnp.asarray(alpha, dtype)
        shift = matmul(jnp.asarray(rows.D), points.T)  # (R, B): columns are points
        l = (jnp.asarray(rows.lower)[:, None] - shift).astype(dtype)
        u = (jnp.asarray(rows.upper)[:, None] - shift).astype(dtype)

        project = lambda t: jnp.clip(t, l, u)
        if rows.balls:
            radius = jnp.asarray(rows.radius, dtype)
            one = lambda t, l, u: Bounds(l, u, radius=radius, balls=rows.balls).project(t, 1.0)
            project = lambda t: jax.vmap(one, in_axes=1, out_axes=1)(t, l, u)

        def step(t, _=None):
            s = project(t)
            return t + alpha * (matmul(U, matmul(U.T, 2 * s - t)) - s), None

        before, _ = jax.lax.scan(step, project(jnp.zeros_like(l)), length=iterations - 1)
        t, _ = step(before)
        residual = lambda t: t - project(t)
        w = matmul(U.T, project(t) - residual(t))
        change = residual(t) - residual(before)
        verdict = jax.vmap(lambda *a: check_candidates(p, rows, a[0], a[1], [a[2], a[3]]))(
            points, w.T, change.T, residual(t).T
        )
        return verdict, w.T

    return Compiled(stage)


@functools.cache
def newton_stage(steps: int) -> Compiled:
    """The compiled Newton stage: (p, rows, points (B, d), w (B, k)) → verdicts and w."""

    @jax.jit
    def stage(p: ExactData, rows: ConstraintRows, points: Array, w: Array) -> tuple[Verdict, Array]:
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
            return check_candidates(p, rows, theta, w, [e]), w

        return jax.vmap(one)(points, w)

    return Compiled(stage)
