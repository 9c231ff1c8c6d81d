"""solve_qp: loop, polish and honest status joined."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.checks import fail
from jaxmpc.qp.admm import ADMM, Factor, factor, iterate, read
from jaxmpc.qp.certificate import descent_ray, farkas
from jaxmpc.qp.problem import (
    QP,
    QPSolution,
    admissible,
    arrays,
    floating_dtype,
    matmul,
    residual_terms,
    residuals,
)
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
    solver.validate(np.shape(qp.A)[0])
    return _solve(as_arrays(qp), *arrays((solver, warm_start)))


@jax.jit
def _solve(qp: QP, solver: ADMM, warm_start: Any) -> QPSolution:
    return solve_factored(qp, factor(qp.P, qp.A, solver), solver, warm_start)


def as_arrays(qp: QP) -> QP:
    """The same program with all fields in one floating type: the widest among them."""
    dtype = floating_dtype(qp)
    return QP(*(jnp.asarray(v, dtype) for v in (qp.P, qp.q, qp.A, qp.l, qp.u)))


def solve_factored(qp: QP, factor: Factor, solver: ADMM, warm_start: Any = None) -> QPSolution:
    """`solve_qp` after its factorization: what a controller repeats at each sample."""
    clean, finite = cleaned(qp)
    q, l, u = scaled(factor, clean)
    t = jnp.zeros_like(l) if warm_start is None else start(factor, clean, l, u, warm_start)
    t, previous = iterate(factor, q, l, u, t, solver.iterations, solver.alpha)
    (w, y), (w_old, y_old) = read(factor, t, q, l, u), read(factor, previous, q, l, u)
    pairs, proofs = [(w, y)], [y - y_old, y]
    if solver.refine:
        w_new, y_new, change = polish(factor.H, q, factor.A, l, u, w, y, solver.refine)
        pairs, proofs = [(w_new, y_new), *pairs], [*proofs, change]
    solution = assess(clean, factor, pairs, proofs, [w - w_old, w], solver)
    return marked(solution, finite)


def cleaned(qp: QP) -> tuple[QP, Array]:
    """The program with harmless data where its own are not usable, and whether they were.

    Bad data must not reach the loop: NaN would pass through clip unseen on a CPU.
    """
    finite = (
        jnp.all(jnp.isfinite(qp.q))
        & jnp.all(jnp.isfinite(qp.A))
        & jnp.all(jnp.isfinite(qp.P))
        & jnp.all(qp.l <= qp.u)
        & ~jnp.any(jnp.isposinf(qp.l) | jnp.isneginf(qp.u))
    )
    return replace(
        qp, q=jnp.where(finite, qp.q, 0.0), l=jnp.where(finite, qp.l, -jnp.inf),
        u=jnp.where(finite, qp.u, jnp.inf),
    ), finite  # fmt: skip


def scaled(factor: Factor, qp: QP) -> tuple[Array, Array, Array]:
    """q, l, u in ADMM's coordinates. A zero row (scale 0) is free there; `assess` checks it."""
    E, zero = factor.E, factor.E == 0

    def bound(v: Array, free: float) -> Array:
        # E·inf would give NaN gradients with respect to P and A, which E depends on.
        keep = jnp.isfinite(v) & ~zero
        return jnp.where(zero, free, jnp.where(keep, E * jnp.where(keep, v, 0.0), v))

    return matmul(qp.q, factor.T), bound(qp.l, -jnp.inf), bound(qp.u, jnp.inf)


def start(factor: Factor, qp: QP, l: Array, u: Array, warm_start: Any) -> Array:
    """t = s + v of a warm start (z, y), a pair or a solution; what is not finite counts as 0."""
    z, y = (warm_start.z, warm_start.y) if hasattr(warm_start, "z") else warm_start
    for name, value, like in (("z", z, qp.q), ("y", y, qp.l)):
        if jnp.shape(value) != like.shape:
            fail(f"warm_start {name}", f"shape {jnp.shape(value)}", f"Needed: {like.shape}")
    clean = lambda v: jnp.nan_to_num(jnp.asarray(v, qp.q.dtype), posinf=0.0, neginf=0.0)
    E = factor.E
    v = jnp.where(E == 0, 0.0, clean(y) / jnp.where(E == 0, 1.0, E)) / factor.rho[0]
    return jnp.clip(E * matmul(clean(z), qp.A.T), l, u) + v


def assess(
    qp: QP, factor: Factor, pairs: list[tuple[Array, Array]], proofs: list[Array],
    directions: list[Array], solver: ADMM,
) -> QPSolution:  # fmt: skip
    """The best of the scaled pairs (w, y), judged in the units of `qp`.

    proofs: scaled candidates for a Farkas vector. directions: scaled candidates for a ray.
    """
    dtype, E = qp.q.dtype, factor.E
    unscaled = [(matmul(w, factor.T.T), admissible(E * y, qp.l, qp.u)) for w, y in pairs]
    z, y = unscaled[0]
    for z_other, y_other in unscaled[1:]:
        better = worst(qp, z, y) < worst(qp, z_other, y_other)  # False for NaN
        z, y = jnp.where(better, z, z_other), jnp.where(better, y, y_other)

    eps = (1e-6 if dtype == jnp.float64 else 1e-3) if solver.eps is None else solver.eps
    eps, floor = jnp.asarray(eps, dtype), 100 * jnp.finfo(dtype).eps
    solved = jnp.asarray(True)
    for value, size in residual_terms(qp, z, y):
        solved = solved & jnp.all(jnp.abs(value) <= eps + floor * size)
    primal, dual, gap = residuals(qp, z, y)
    # Rows that z cannot move prove emptiness by themselves.
    fixed = jnp.where(E == 0, -jnp.clip(jnp.zeros(()), qp.l, qp.u), 0.0)
    certificate, infeasible = farkas(qp, fixed)
    for candidate in proofs:
        other, proved = farkas(qp, E * candidate)
        certificate = jnp.where(infeasible, certificate, other)
        infeasible = infeasible | proved
    ray, unbounded = jnp.zeros_like(z), jnp.asarray(False)
    for direction in directions:
        tolerance = jnp.sqrt(jnp.finfo(dtype).eps)
        other, proved = descent_ray(qp, matmul(direction, factor.T.T), tolerance)
        ray, unbounded = jnp.where(unbounded, ray, other), unbounded | proved

    # Rows that contradict each other by less than eps are both solved and proved empty: say solved.
    infeasible = infeasible & ~solved
    unbounded = unbounded & ~solved & ~infeasible
    status = jnp.select(
        [solved, infeasible, unbounded],
        [Status.SOLVED, Status.PRIMAL_INFEASIBLE, Status.DUAL_INFEASIBLE],
        Status.ITERATION_LIMIT,
    )
    return QPSolution(
        z=z, y=y, status=status.astype(jnp.int32), primal_residual=primal, dual_residual=dual,
        gap=gap, iterations=jnp.asarray(solver.iterations, jnp.int32),
        certificate=jnp.where(infeasible, certificate, 0.0), ray=jnp.where(unbounded, ray, 0.0),
    )  # fmt: skip


def marked(solution: QPSolution, finite: Array) -> QPSolution:
    """The solution where the data were usable; NaN and NON_FINITE where they were not."""
    nan = lambda v: jnp.where(finite, v, jnp.nan)
    s = solution
    return replace(
        s, z=nan(s.z), y=nan(s.y), primal_residual=nan(s.primal_residual),
        dual_residual=nan(s.dual_residual), gap=nan(s.gap),
        status=jnp.where(finite, s.status, jnp.int32(Status.NON_FINITE)),
    )  # fmt: skip


def worst(qp: QP, z: Array, y: Array) -> Array:
    """Largest residual, each relative to the size of its terms: what refinement must lower."""
    norm = lambda v: jnp.max(jnp.abs(v), initial=0.0)
    relative = [norm(value) / (1 + norm(size)) for value, size in residual_terms(qp, z, y)]
    return jnp.max(jnp.stack(relative))
