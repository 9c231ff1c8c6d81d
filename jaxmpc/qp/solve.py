"""solve_qp: loop, polish, honest status and derivative joined."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.checks import fail
from jaxmpc.qp.admm import (
    ADMM,
    Factor,
    factor,
    harmless_matrices,
    iterate,
    read,
    scaled,
    scaled_rows,
)
from jaxmpc.qp.certificate import descent_ray, farkas, recession, sharpen
from jaxmpc.qp.derivative import implicit
from jaxmpc.qp.precision import arrays, floating_dtype, matmul, precisely, rounding
from jaxmpc.qp.problem import QP, QPSolution, residual_terms, residuals
from jaxmpc.qp.projection import Bounds
from jaxmpc.qp.refine import Constants, least_distance, linearised, polish
from jaxmpc.qp.status import Status


def solve_qp(qp: QP, solver: ADMM = ADMM(), warm_start: Any = None) -> QPSolution:  # noqa: B008
    """Minimise ½ z'Pz + q'z subject to l ≤ Az ≤ u by a fixed number of ADMM steps and a polish.

    One instance; `jax.vmap` for many. Where P and A are not batched they are factored once;
    where they are, each instance has its own factor. Soft rows and balls: see `QP`.
    warm_start: a (z, y) pair or an earlier QPSolution. The status comes from residuals in the
    units of `qp` (see `ADMM.eps`), computed in float64 even for float32 data, or from a
    certificate (`certificate.py`). z, y and cost are differentiable with respect to every array
    of `qp`, forward and reverse, for every status (`derivative.py`); an instance with NON_FINITE
    data has derivative zero. Raises ValueError for bad shapes and, where values can be read, bad
    values.
    """
    qp.validate()
    solver.validate(np.shape(qp.A)[0])
    return _solve(as_arrays(qp), *arrays((solver, warm_start)))


@jax.jit
def _solve(qp: QP, solver: ADMM, warm_start: Any) -> QPSolution:
    return marked(*solve_factored(qp, factor(qp.P, qp.A, solver, qp.balls), solver, warm_start))


def as_arrays(qp: QP) -> QP:
    """The same program with all fields in one floating type, the widest among them, and P made
    exactly symmetric."""
    dtype = floating_dtype(qp)
    qp = jax.tree.map(lambda v: jnp.asarray(v, dtype), qp, is_leaf=lambda v: isinstance(v, list))
    return replace(qp, P=(qp.P + qp.P.T) / 2)


def solve_factored(
    qp: QP, factor: Factor, solver: ADMM, warm_start: Any = None
) -> tuple[QPSolution, Array]:
    """`solve_qp` after its factorization: what a controller repeats at each sample.

    Returns the solution and the fault of the data, NOT_RUN for none. Where there is one the
    solution is that of harmless data: `marked` says so, after all that is computed from it, for
    the derivative of a product with NaN is NaN even where nobody looks at it.
    """
    clean, fault = cleaned(qp, factor.fault)
    if solver.differentiate == "implicit":
        constants = jax.lax.stop_gradient((clean, factor, solver, warm_start))
        found = search(*constants)
        z, y = implicit(clean, constants[1], solver.smoothing, found.z, found.y)
    else:
        found = search(clean, factor, solver, warm_start)
        z, y = found.z, found.y
    return replace(found, z=z, y=y, cost=value(clean, z, y)), fault


def search(qp: QP, factor: Factor, solver: ADMM, warm_start: Any) -> QPSolution:
    """Loop, polish, correction, proofs."""
    q, bounds = scaled(factor, qp)
    t = jnp.zeros_like(qp.l)
    if warm_start is not None:
        t = start(factor, qp, bounds, warm_start)
    t, previous = iterate(factor, q, bounds, t, solver.iterations, solver.alpha)
    (w, y), (w_old, y_old) = read(factor, t, q, bounds), read(factor, previous, q, bounds)
    pair = unscaled(qp, factor, w, y)
    proofs, directions = [y - y_old, y], [w - w_old, w]
    if not solver.refine:
        return assess(qp, pair, prove(qp, factor, proofs, directions), solver)
    end = polish(factor.H, q, factor.A, bounds, w, y, solver.refine)
    polished = unscaled(qp, factor, end.w, end.y)
    pair = corrected(qp, factor, *best(qp, polished, pair))
    # Each step waits for the one before: jaxlib 0.10 can hang on two factorizations at once.
    w, _ = jax.lax.optimization_barrier((end.w, pair))
    steps = max(solver.refine // 5, 1)
    _, e = least_distance(factor.A, bounds, w, steps, Constants.of(w.dtype).damping)
    move, _ = jax.lax.optimization_barrier((end.move, e))
    proofs += [end.change, sharpen(factor.A, e)]
    directions += [move, ray(factor, q, bounds, move, steps)]
    proof = prove(qp, factor, proofs, directions)
    # The polish ends at the point of least violation, the best answer where there is none.
    z, y = (jnp.where(proof.infeasible, p, v) for p, v in zip(polished, pair, strict=True))
    return assess(qp, (z, y), proof, solver)


def ray(factor: Factor, q: Array, bounds: Bounds, d: Array, steps: int) -> Array:
    """A direction of unbounded descent, searched from d, if P is singular."""
    rows, cone = recession(q, factor.H, factor.A, bounds)
    length = jnp.linalg.norm(d)
    d = d / jnp.where(length > 0, length, 1.0)
    damping = Constants.of(d.dtype).damping
    seek = lambda d: least_distance(rows, cone, d, 2 * steps, damping)[0]
    return jax.lax.cond(factor.flat, seek, lambda d: d, d)


def cleaned(qp: QP, matrix_fault: Array) -> tuple[QP, Array]:
    """The program with harmless data where its own are not usable, and the fault in them.

    matrix_fault: that of P and A, `Factor.fault`. Bad data must not reach the loop: NaN would pass
    through clip unseen on a CPU.
    """
    finite = (
        jnp.all(jnp.isfinite(qp.q))
        & jnp.all(qp.l <= qp.u)
        & ~jnp.any(jnp.isposinf(qp.l) | jnp.isneginf(qp.u))
    )
    # The rows of a ball have l = u = its centre, and a free centre is no centre.
    ball = jnp.arange(qp.l.shape[0]) >= qp.l.shape[0] - sum(qp.balls)
    finite = finite & jnp.all(~ball | (jnp.isfinite(qp.l) & (qp.l == qp.u)))
    if qp.bounds.linear is not None:  # and balls are hard
        finite = finite & jnp.all(~ball | jnp.isposinf(qp.bounds.linear))
    harmless: dict[str, Any] = {
        "q": 0.0,
        "l": jnp.where(ball, 0.0, -jnp.inf),
        "u": jnp.where(ball, 0.0, jnp.inf),
    }
    if qp.soft_linear is not None:
        finite = finite & jnp.all(qp.soft_linear >= 0)
        harmless["soft_linear"] = jnp.inf
    if qp.soft_quadratic is not None:
        finite = finite & jnp.all((qp.soft_quadratic >= 0) & jnp.isfinite(qp.soft_quadratic))
        harmless["soft_quadratic"] = 0.0
    if qp.radius is not None:
        finite = finite & jnp.all(qp.radius >= 0)
        harmless["radius"] = 1.0
    fault = jnp.where(finite, matrix_fault, jnp.int32(Status.NON_FINITE))
    usable = fault == Status.NOT_RUN
    fields: dict[str, Any] = {
        name: jnp.where(usable, getattr(qp, name), v) for name, v in harmless.items()
    }
    P, A = harmless_matrices(qp.P, qp.A, matrix_fault == Status.NOT_RUN)
    return replace(qp, P=P, A=A, **fields), fault


def start(factor: Factor, qp: QP, bounds: Bounds, warm_start: Any) -> Array:
    """t = s + v of a warm start (z, y), a pair or a solution; what is not finite counts as 0."""
    z, y = (warm_start.z, warm_start.y) if hasattr(warm_start, "z") else warm_start
    for name, value, like in (("z", z, qp.q), ("y", y, qp.l)):
        if jnp.shape(value) != like.shape:
            fail(f"warm_start {name}", f"shape {jnp.shape(value)}", f"Needed: {like.shape}")
    clean = lambda v: jnp.nan_to_num(jnp.asarray(v, qp.q.dtype), posinf=0.0, neginf=0.0)
    rho = factor.rho[0]
    Az, y = scaled_rows(factor, qp, clean(z), clean(y))
    # Soft rows may stay outside their interval: s is what prox leaves of s + v.
    return bounds.project(Az + y / rho, rho) + y / rho


def unscaled(qp: QP, factor: Factor, w: Array, y: Array) -> tuple[Array, Array]:
    """z and an admissible y in the units of `qp`. Soft rows that z cannot move (scale 0) push with
    their penalty, for the gap's sake."""
    zero = factor.E == 0
    y = jnp.where(zero, qp.bounds.push(jnp.zeros_like(y)), factor.E * y)
    return matmul(w, factor.T.T), qp.bounds.admissible(y)


def best(qp: QP, pair: tuple[Array, Array], other: tuple[Array, Array]) -> tuple[Array, Array]:
    """The one of two pairs (z, y) with the smaller residuals; the first where none is finite."""
    better = worst(qp, *other) < worst(qp, *pair)  # False for NaN
    return jnp.where(better, other[0], pair[0]), jnp.where(better, other[1], pair[1])


def corrected(qp: QP, factor: Factor, z: Array, y: Array) -> tuple[Array, Array]:
    """Iterative refinement: (z, y) moved twice by their residuals, which are computed in float64
    from the data as given, with the active rows held fixed; kept only where residuals fall."""
    rho, E = Constants.of(z.dtype).linear, factor.E
    v, y_w = scaled_rows(factor, qp, z, y)
    weights, normals = scaled(factor, qp)[1].curvature(v + y_w / rho, rho)
    solve = linearised(factor.H, factor.A, weights, normals, rho)

    def conditions(qp: QP, factor: Factor, z: Array, y: Array) -> tuple[Array, Array]:
        v, y_w = scaled_rows(factor, qp, z, y)
        dual = matmul(matmul(z, qp.P) + qp.q + matmul(y, qp.A), factor.T)
        return dual, scaled(factor, qp)[1].excess(v + y_w / rho, rho) - y_w / rho

    def move(pair: tuple[Array, Array], _: None) -> tuple[Any, None]:
        z, y = pair
        dw, dy = solve(*precisely(conditions, qp, factor, z, y))
        moved = z + matmul(dw, factor.T.T), qp.bounds.admissible(y + E * dy)
        return best(qp, pair, moved), None

    return jax.lax.scan(move, (z, y), length=2)[0]


def worst(qp: QP, z: Array, y: Array) -> Array:
    """Largest residual, each relative to the size of its terms: what refinement must lower."""
    norm = lambda v: jnp.max(jnp.abs(v), initial=0.0)

    def relative(qp: QP, z: Array, y: Array) -> Array:
        terms = residual_terms(qp, z, y)
        return jnp.max(jnp.stack([norm(value) / (1 + norm(size)) for value, size in terms]))

    return precisely(relative, qp, z, y)


def value(qp: QP, z: Array, y: Array) -> Array:
    """The cost at z, with the derivative of the optimal value: that of the Lagrangian
    ½ z'Pz + q'z + y'Az − g*(y) at (z, y) (envelope theorem). Penalties that are being paid stand
    there as themselves, for at |y| = c the conjugate of an L1 penalty has no derivative."""
    own = 0.5 * jnp.sum(z * matmul(z, qp.P)) + jnp.sum(qp.q * z)
    Az, bounds = matmul(z, qp.A.T), qp.bounds
    cost = bounds.cost(Az)
    if bounds.linear is None:
        lagrangian = own + jnp.sum(y * Az) - bounds.support(y)
    else:
        paid = jnp.isfinite(bounds.linear) & (jnp.abs(y) >= bounds.linear)
        y = jnp.where(paid, 0.0, y)
        penalty = replace(bounds, linear=jnp.where(paid, bounds.linear, jnp.inf)).cost(Az)
        lagrangian = own + penalty + jnp.sum(y * Az) - bounds.support(y)
    fixed = jax.lax.stop_gradient
    return fixed(own + cost) + (lagrangian - fixed(lagrangian))


class Proof(NamedTuple):
    """A Farkas vector and a descent ray, and whether they are proved to be."""

    certificate: Array
    infeasible: Array
    ray: Array
    unbounded: Array


def prove(qp: QP, factor: Factor, proofs: list[Array], directions: list[Array]) -> Proof:
    """What is proved of the program by scaled candidates for a Farkas vector and for a ray."""
    E = factor.E
    # Rows that z cannot move prove emptiness by themselves.
    fixed = jnp.where(E == 0, qp.bounds.violation(jnp.zeros_like(E)), 0.0)
    candidates = jnp.stack([fixed, *(E * y for y in proofs)])
    certificate, infeasible = first(*jax.vmap(lambda y: farkas(qp, y))(candidates))
    candidates = matmul(jnp.stack(directions), factor.T.T)
    ray, unbounded = first(*jax.vmap(lambda d: descent_ray(qp, d))(candidates))
    return Proof(certificate, infeasible, ray, unbounded)


def assess(qp: QP, pair: tuple[Array, Array], proof: Proof, solver: ADMM) -> QPSolution:
    """The pair (z, y) judged in the units of `qp`, in float64."""
    (z, y), dtype = pair, qp.q.dtype
    eps = (1e-6 if dtype == jnp.float64 else 1e-3) if solver.eps is None else solver.eps
    floor = rounding(dtype)

    def measure(qp: QP, z: Array, y: Array, eps: Array) -> tuple[Array, ...]:
        solved = jnp.asarray(True)
        for value, size in residual_terms(qp, z, y):
            solved = solved & jnp.all(jnp.abs(value) <= eps + floor * size)
        return (solved, *residuals(qp, z, y))

    solved, primal, dual, gap = precisely(measure, qp, z, y, jnp.asarray(eps, dtype))
    # Rows that contradict each other by less than eps are both solved and proved empty: say solved.
    infeasible = proof.infeasible & ~solved
    unbounded = proof.unbounded & ~solved & ~infeasible
    status = jnp.select(
        [solved, infeasible, unbounded],
        [Status.SOLVED, Status.PRIMAL_INFEASIBLE, Status.DUAL_INFEASIBLE],
        Status.ITERATION_LIMIT,
    )
    return QPSolution(
        z=z, y=y, cost=jnp.zeros((), dtype), status=status.astype(jnp.int32),
        primal_residual=primal, dual_residual=dual, gap=gap,
        iterations=jnp.asarray(solver.iterations, jnp.int32),
        certificate=jnp.where(infeasible, proof.certificate, 0.0),
        ray=jnp.where(unbounded, proof.ray, 0.0),
    )  # fmt: skip


def first(vectors: Array, proved: Array) -> tuple[Array, Array]:
    """The first vector that is proved, and whether there is one."""
    return vectors[jnp.argmax(proved)], jnp.any(proved)


def marked(solution: QPSolution, fault: Array) -> QPSolution:
    """The solution where the data were usable; NaN and the status `fault` where they were not."""
    nan = lambda v: jnp.where(fault == Status.NOT_RUN, v, jnp.nan)
    s = solution
    return replace(
        s, z=nan(s.z), y=nan(s.y), cost=nan(s.cost), primal_residual=nan(s.primal_residual),
        dual_residual=nan(s.dual_residual), gap=nan(s.gap),
        status=jnp.where(fault == Status.NOT_RUN, s.status, fault),
    )  # fmt: skip
