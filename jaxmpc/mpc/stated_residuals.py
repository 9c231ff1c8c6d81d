"""The status of a plan as the problem was stated: in states and inputs, from its own data.

The condensed QP is solved in other variables, whose terms can be far larger than what they add up
to: predictions of an unstable plant, limits less what the present state contributes. So what counts
for the status of a plan is computed from A, B, c, the weights and the rows themselves:

    rows       v = H x_k + D u_k beyond its bounds, relative to the larger of |bounds| and |v|;
    dynamics   x_{k+1} − (A x_k + B u_k + c), relative to the largest value of the same state over
               the horizon, and a small share of what it is made of, |A||x_k| + |B||u_k| + |c|: a
               state that rests at 0 has no other size than that;
    inputs     the gradient of the Lagrangian g = Γ'(∂J/∂x + H'y) + Ω'(∂J/∂u + D'y), with the
               sensitivities Γ, Ω of the plan to its variables. In the metric of the Hessian, in
               which the cost is ½|w|² + const, it is how far the plan is from the best one for the
               multipliers y; it is compared with √(2J);
    gap        Σ (penalty + conjugate − y v), how far y is from complementary, relative to J.
"""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.mpc.aim import Aim
from jaxmpc.mpc.condense import Condensed
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.rows import blocks, split
from jaxmpc.mpc.stagewise.stages import apply, apply_transposed, at, dynamics_terms, spread
from jaxmpc.qp.admm import ADMM, Factor
from jaxmpc.qp.linalg import matmul, rounding
from jaxmpc.qp.problem import QPSolution
from jaxmpc.qp.residuals import SHARE, Measured, Terms, worst
from jaxmpc.qp.status import Status

# Roundings of float32 that a plan, computed in float64 and then rounded, may be off.
ROUNDED = 1000


def with_stated_status(
    mpc: MPC,
    c: Condensed,
    factor: Factor,
    solver: ADMM,
    found: QPSolution,
    states: Array,
    inputs: Array,
    aim: Aim,
) -> QPSolution:
    """Return the solution of the condensed QP with the status and the residuals of the plan,
    states (N+1, n) and inputs (N, m).

    In float32 the status is that of the QP, which speaks of the plan before it was rounded; rows
    and dynamics are checked to the precision that is left.
    """
    terms = stated_terms(*jax.lax.stop_gradient((mpc, c, factor, found.y, states, inputs, aim)))
    eps, dtype = jnp.asarray(solver.eps, states.dtype), states.dtype
    if dtype == jnp.float64:
        measured = Measured.of(terms, eps, rounding(dtype))
        found = replace(
            found, primal_residual=measured.primal, dual_residual=measured.dual, gap=measured.gap
        )
        solved = measured.within_tolerance
    else:
        allowed = eps + ROUNDED * jnp.finfo(dtype).eps
        solved = (found.status == Status.SOLVED) & (worst(terms[:1], allowed)[1][0] <= allowed)
    lost = jnp.where(found.status == Status.SOLVED, Status.INACCURATE, found.status)
    return replace(found, status=jnp.where(solved, Status.SOLVED, lost).astype(jnp.int32))


def stated_terms(
    mpc: MPC, c: Condensed, factor: Factor, y: Array, x: Array, u: Array, aim: Aim
) -> Terms:
    """Return the residuals at the top of this file, with their sizes and terms: rows and dynamics
    (rows + N·n,), inputs (variables of the QP,), gap (1,)."""
    N, cast = mpc.horizon, lambda v: jnp.asarray(v, x.dtype)
    e = x if aim.states is None else x - aim.states
    d = u if aim.inputs is None else u - aim.inputs
    weighted = lambda e, d: (
        jnp.concatenate([c.stage[:, None] * matmul(e[:-1], c.Q), matmul(e[-1:], c.P_N)]),
        c.stage[:, None] * matmul(d, c.R),
    )
    gx, gu = weighted(e, d)
    J = jnp.sum(e * gx) + jnp.sum(d * gu)
    # What the tracking errors are differences of.
    cancels = J
    if aim.states is not None or aim.inputs is not None:
        cancels = J + jnp.sum(x * weighted(x, u)[0]) + jnp.sum(u * weighted(x, u)[1])
    before = jnp.zeros_like(u[0]) if aim.previous_input is None else aim.previous_input
    rates = jnp.diff(u, axis=0, prepend=before[None])
    if mpc.input_rate_weight is not None:
        push = matmul(rates, c.W)
        J = J + jnp.sum(rates * push)
        gu = gu + push - jnp.concatenate([push[1:], jnp.zeros_like(push[:1])])
    gx, gu = 2 * gx, 2 * gu

    violations, sizes = [], []
    gap = products = jnp.zeros((), x.dtype)
    for block, y_block in zip(blocks(mpc, x.dtype), split(c.layout, y), strict=True):
        v: Any = 0.0
        of_inputs = rates if block.rate else u
        for M, along, count in ((block.H, x, N + 1), (block.D, of_inputs, N)):
            if M is None:
                continue
            v = v + (at(along, block.steps) if block.box else apply(M, at(along, block.steps)))
            pulled = spread(
                y_block if block.box else apply_transposed(M, y_block), block.steps, count
            )
            if M is block.H:
                gx = gx + pulled
            elif block.rate:
                gu = gu + pulled - jnp.concatenate([pulled[1:], jnp.zeros_like(pulled[:1])])
            else:
                gu = gu + pulled
        bounds, v, y_rows = block.bounds(), v.ravel(), y_block.ravel()
        penalty, support = bounds.cost(v), bounds.support(y_rows)
        J = J + jnp.sum(penalty)
        gap = gap + jnp.sum(penalty + support - y_rows * v)
        products = products + jnp.sum(jnp.abs(y_rows * v)) + jnp.sum(jnp.abs(support))
        violations.append(bounds.violation(v))
        sizes.append(jnp.maximum(bounds.sizes(), jnp.abs(v)))

    moved = [M.reshape(-1, M.shape[-1]) for M in (c.Gamma, c.Omega)]
    g = matmul(jnp.concatenate([gx.ravel(), gu.ravel()]), jnp.concatenate(moved))
    length, rounds = (jnp.sqrt(2 * jnp.maximum(v, 0.0)) for v in (J, cancels))
    rounds = rounds + jnp.max(jnp.abs(y) * factor.row_norms, initial=0.0)

    A, B = cast(mpc.system.A), cast(mpc.system.B)
    drift = jnp.zeros_like(x[0]) if mpc.system.c is None else cast(mpc.system.c)
    defects = x[1:] - (apply(A, x[:-1]) + apply(B, u) + drift)
    terms = dynamics_terms(A, B, drift, x, u)
    most = jnp.max(jnp.abs(x), axis=0) + SHARE * jnp.max(terms, axis=0)
    most = jnp.broadcast_to(most, terms.shape)
    row_size = jnp.concatenate([*sizes, y[:0]])
    per_variable = 1 / jnp.sum(jnp.abs(factor.T), axis=1)
    return [
        (
            jnp.concatenate([*violations, defects.ravel()]),
            jnp.concatenate([row_size + SHARE * length * factor.row_norms, most.ravel()]),
            jnp.concatenate([row_size + rounds * factor.row_norms, terms.ravel()]),
        ),
        (g, length * per_variable, rounds * per_variable),
        (gap[None], 2 * J[None], (cancels + products)[None]),
    ]
