"""solve_qp: loop, polish and honest status joined."""

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
from jax import Array

from jaxmpc.checks import fail
from jaxmpc.qp.admm import ADMM, Factor, factor, iterate
from jaxmpc.qp.certificate import descent_ray, farkas
from jaxmpc.qp.problem import QP, QPSolution, admissible, floating_dtype, matmul, residual_sizes
from jaxmpc.qp.refine import polish
from jaxmpc.qp.status import Status


def solve_qp(qp: QP, solver: ADMM = ADMM(), warm_start: Any = None) -> QPSolution:  # noqa: B008
    """Minimise ½ z'Pz + q'z subject to l ≤ Az ≤ u by a fixed number of ADMM steps and a polish.

    One instance; `jax.vmap` for many. Where P and A are not batched they are factored once.
    warm_start: a (z, y) pair or an earlier QPSolution. The status comes from residuals in the
    units of `qp` (see `ADMM.eps`) or from a certificate (`certificate.py`). Differentiable by
    unrolling. Raises ValueError for bad shapes and, where values can be read, bad values.
    """
    qp.validate()
    solver.validate(jnp.shape(qp.A)[0])
    qp = as_arrays(qp)
    return solve_factored(qp, factor(qp.P, qp.A, solver), solver, warm_start)


def as_arrays(qp: QP) -> QP:
    """The same program with all fields in one floating type: the widest among them."""
    dtype = floating_dtype(qp)
    return QP(*(jnp.asarray(v, dtype) for v in (qp.P, qp.q, qp.A, qp.l, qp.u)))


def solve_factored(qp: QP, factor: Factor, solver: ADMM, warm_start: Any = None) -> QPSolution:
    """`solve_qp` after its factorization: what a controller repeats at each sample."""
    dtype = qp.q.dtype
    finite = (
        jnp.all(jnp.isfinite(qp.q))
        & jnp.all(jnp.isfinite(qp.A))
        & jnp.all(jnp.isfinite(qp.P))
        & jnp.all(qp.l <= qp.u)
        & ~jnp.any(jnp.isposinf(qp.l) | jnp.isneginf(qp.u))
    )
    # Bad data must not reach the loop: NaN would pass through clip unseen on a CPU.
    q = jnp.where(finite, jnp.nan_to_num(qp.q), 0.0)
    l = jnp.where(finite, qp.l, -jnp.inf)
    u = jnp.where(finite, qp.u, jnp.inf)

    # To scaled coordinates. A zero row (scale 0) is free there; its bounds are checked below.
    E, zero = factor.E, factor.E == 0
    l_w = jnp.where(zero, -jnp.inf, E * jnp.where(zero, 0.0, l))
    u_w = jnp.where(zero, jnp.inf, E * jnp.where(zero, 0.0, u))
    q_w = matmul(q, factor.T)
    rho = factor.rho[0]
    if warm_start is None:
        t = jnp.zeros_like(l_w)
    else:
        z, y = start_pair(warm_start, qp)
        v = jnp.where(zero, 0.0, y / jnp.where(zero, 1.0, E)) / rho
        t = jnp.clip(E * matmul(qp.A, z), l_w, u_w) + v

    t, previous = iterate(factor, q_w, l_w, u_w, t, solver.iterations, solver.alpha)
    rho, F, Minv = factor.rho[-1], factor.F[-1], factor.Minv[-1]
    split = lambda t: (jnp.clip(t, l_w, u_w), t - jnp.clip(t, l_w, u_w))
    primal = lambda s, v: matmul(F, s - v) - matmul(Minv, q_w)
    (s, v), (s_old, v_old) = split(t), split(previous)
    w, y_w = primal(s, v), rho * v
    dw, dy = w - primal(s_old, v_old), E * rho * (v - v_old)

    z, y = matmul(factor.T, w), admissible(E * y_w, l, u)
    if solver.refine:
        w, y_w = polish(factor.H, q_w, factor.A, l_w, u_w, w, y_w, solver.refine)
        z_new, y_new = matmul(factor.T, w), admissible(E * y_w, l, u)
        better = worst(qp, z_new, y_new) < worst(qp, z, y)  # False for NaN
        z, y = jnp.where(better, z_new, z), jnp.where(better, y_new, y)

    eps = (1e-6 if dtype == jnp.float64 else 1e-3) if solver.eps is None else solver.eps
    floor = 100 * jnp.finfo(dtype).eps
    clean = replace(qp, q=q, l=l, u=u)
    primal_r, dual_r, gap, *sizes = residual_sizes(clean, z, y)
    solved = (
        (primal_r <= eps + floor * sizes[0])
        & (dual_r <= eps + floor * sizes[1])
        & (gap <= eps + floor * sizes[2])
    )
    # Three candidates for a proof: the last change of y, y itself, and rows that z cannot move.
    fixed = jnp.where(zero, -jnp.clip(jnp.zeros(()), l, u), 0.0)
    candidates = [farkas(clean, c) for c in (dy, E * rho * v, fixed)]
    certificate, infeasible = candidates[0]
    for other, proved in candidates[1:]:
        certificate = jnp.where(infeasible, certificate, other)
        infeasible = infeasible | proved
    ray, unbounded = descent_ray(clean, matmul(factor.T, dw), jnp.sqrt(jnp.finfo(dtype).eps))

    # Rows that contradict each other by less than eps are both solved and proved empty: say solved.
    infeasible = infeasible & ~solved
    unbounded = unbounded & ~solved & ~infeasible
    status = jnp.select(
        [~finite, solved, infeasible, unbounded],
        [Status.NON_FINITE, Status.SOLVED, Status.PRIMAL_INFEASIBLE, Status.DUAL_INFEASIBLE],
        Status.ITERATION_LIMIT,
    )
    nan = lambda v: jnp.where(finite, v, jnp.nan)
    return QPSolution(
        z=nan(z), y=nan(y), status=status.astype(jnp.int32), primal_residual=nan(primal_r),
        dual_residual=nan(dual_r), gap=nan(gap),
        iterations=jnp.asarray(solver.iterations, jnp.int32),
        certificate=jnp.where(finite & infeasible, certificate, 0.0),
        ray=jnp.where(unbounded, ray, 0.0),
    )  # fmt: skip


def worst(qp: QP, z: Array, y: Array) -> Array:
    """Largest of the residuals, each relative to the size of its terms: what refinement must lower."""
    primal, dual, gap, *sizes = residual_sizes(qp, z, y)
    return jnp.maximum(
        primal / (1 + sizes[0]), jnp.maximum(dual / (1 + sizes[1]), gap / (1 + sizes[2]))
    )


def start_pair(warm_start: Any, qp: QP) -> tuple[Array, Array]:
    """(z, y) of a pair or of a solution, checked; a start that is not finite counts as zero."""
    z, y = (warm_start.z, warm_start.y) if hasattr(warm_start, "z") else warm_start
    for name, value, like in (("z", z, qp.q), ("y", y, qp.l)):
        if jnp.shape(value) != like.shape:
            fail(f"warm_start {name}", f"shape {jnp.shape(value)}", f"Needed: {like.shape}")
    clean = lambda v: jnp.nan_to_num(jnp.asarray(v, qp.q.dtype), posinf=0.0, neginf=0.0)
    return clean(z), clean(y)
