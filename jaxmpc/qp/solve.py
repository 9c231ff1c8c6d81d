"""solve_qp: loop, polish, honest status and derivative joined."""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxmpc.checks import fail
from jaxmpc.qp.active_set import DualPoint, dual_point, dual_step
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
from jaxmpc.qp.batches import in_blocks, repeat_while
from jaxmpc.qp.certificate import descent_ray, farkas, recession
from jaxmpc.qp.derivative import implicit
from jaxmpc.qp.newton import (
    Constants,
    Multipliers,
    gram,
    largest,
    multipliers_start,
    multipliers_step,
    multipliers_update,
    newton_step,
)
from jaxmpc.qp.precision import arrays, floating_dtype, matmul, precisely, rounding
from jaxmpc.qp.problem import QP, QPSolution, residual_terms, residuals
from jaxmpc.qp.projection import Bounds
from jaxmpc.qp.status import Status

# Bounds of this size mean none, as in OSQP, MOSEK and the MPS format.
INFINITE = 1e20


def solve_qp(qp: QP, solver: ADMM = ADMM(), warm_start: Any = None) -> QPSolution:  # noqa: B008
    """Minimise ½ z'Pz + q'z subject to l ≤ Az ≤ u by a fixed number of ADMM steps and a polish.

    One instance; `jax.vmap` for many. Where P and A are not batched they are factored once;
    where they are, each instance has its own factor. Soft rows and balls: see `QP`. Bounds of 1e20
    and above are infinite.
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
    """The same program with all fields in one floating type, the widest among them, P made exactly
    symmetric, and bounds of 1e20 and above as infinity."""
    dtype = floating_dtype(qp)
    qp = jax.tree.map(lambda v: jnp.asarray(v, dtype), qp, is_leaf=lambda v: isinstance(v, list))
    return replace(
        qp, P=(qp.P + qp.P.T) / 2, l=jnp.where(qp.l <= -INFINITE, -jnp.inf, qp.l),
        u=jnp.where(qp.u >= INFINITE, jnp.inf, qp.u),
    )  # fmt: skip


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
    """Loop, Newton steps, proofs."""
    q, bounds = scaled(factor, qp)
    t = jnp.zeros_like(qp.l)
    if warm_start is not None:
        t = start(factor, qp, bounds, warm_start)
    unrolled = solver.differentiate == "unrolled"
    rough = "float32" if solver.refine and not unrolled else qp.q.dtype
    dtype = rough if solver.dtype is None else jnp.dtype(solver.dtype)
    cast = lambda tree, dtype=dtype: jax.tree.map(
        lambda v: v.astype(dtype) if jnp.issubdtype(v.dtype, jnp.floating) else v, tree
    )
    run = partial(loop, solver.iterations)
    arguments = cast(((factor, jnp.asarray(solver.alpha)), (q, bounds, t)))
    (w, y), (w_old, y_old) = cast(
        run(*arguments) if unrolled else in_blocks(run, *arguments), qp.q.dtype
    )
    eps = jnp.asarray(tolerance(solver, qp.q.dtype), qp.q.dtype)
    p = Program(qp, factor, q, bounds, eps, Constants.of(qp.q.dtype).far)
    begin = replace(multipliers_start(q, w, y), change=y - y_old, move=w - w_old)
    if unrolled:
        advance = lambda s, _: (multipliers_step(factor.H, q, factor.A, bounds, s), None)
        end = lax.scan(advance, begin, length=solver.refine)[0]
        pair = better(p, (end.w, end.y), (w, y)) if solver.refine else unscaled(qp, factor, w, y)
        return assess(qp, pair, prove(qp, factor, end.change, end.move), solver)
    if not solver.refine:
        pair = unscaled(qp, factor, w, y)
        return assess(qp, pair, prove(qp, factor, begin.change, begin.move), solver)
    pair, proof = precisely(partial(improve, solver.refine, solver.fixed), p, begin)
    return assess(qp, pair, proof, solver)


def loop(iterations: int, constants: tuple, data: tuple) -> list[tuple[Array, Array]]:
    """Scaled w (n,) and y (m,) after `iterations` steps of ADMM from t (m,), and one step before.
    constants: the factor and alpha; data: q, bounds, t."""
    (factor, alpha), (q, bounds, t) = constants, data
    ends = iterate(factor, q, bounds, t, iterations, alpha)
    return [read(factor, t, q, bounds) for t in ends]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Program:
    """A program in its own units and, as `q` (n,) and `bounds`, in ADMM's coordinates; eps: the
    residuals that are asked for; far: |w| at which the data's precision takes a ray's end for a
    solution."""

    qp: QP
    factor: Factor
    q: Array
    bounds: Bounds
    eps: Array
    far: float = field(metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pair:
    """z (n,) and y (m,) in the units of the program, the largest of its residuals, each relative
    to the size of its terms, whether all are small, and whether there is no more to gain."""

    z: Array
    y: Array
    error: Array
    near: Array
    solved: Array

    @classmethod
    def of(cls, p: Program, w: Array, y: Array) -> "Pair":
        """The pair of scaled w and y. near: below a thousandth of eps; solved: a millionth."""
        return cls.and_gradient(p, w, y)[0]

    @classmethod
    def and_gradient(cls, p: Program, w: Array, y: Array) -> "tuple[Pair, Array]":
        """The pair, and the gradient T'(Pz + q + A'y) (n,) of the Lagrangian at it."""
        z, y = unscaled(p.qp, p.factor, w, y)
        error, floor = jnp.zeros((), z.dtype), rounding(z.dtype)
        near = solved = jnp.isfinite(error)
        terms = residual_terms(p.qp, z, y)
        # The gap of soft rows is of second order in the error of z; this residual is of first.
        v, push = scaled_rows(p.factor, p.qp, z, y)
        prox = p.bounds.excess(v + push, 1.0) - push
        for value, size in [*terms, (prox, jnp.abs(v) + jnp.abs(push))]:
            near = near & jnp.all(jnp.abs(value) <= 1e-3 * p.eps + floor * size)
            solved = solved & jnp.all(jnp.abs(value) <= 1e-6 * p.eps + floor * size)
            error = jnp.maximum(error, largest(value) / (1 + largest(size)))
        # A maximum need not propagate NaN (XLA on CPUs).
        finite = jnp.all(jnp.isfinite(z)) & jnp.all(jnp.isfinite(y))
        pair = cls(z, y, jnp.where(finite, error, jnp.inf), near & finite, solved & finite)
        return pair, matmul(terms[1][0], p.factor.T)

    def or_better(self, other: "Pair") -> "Pair":
        """The other pair where that is solved or its residuals are smaller. What was near before
        counts as solved: one step more is rounding."""
        take = ~self.solved & (other.solved | (other.error < self.error))
        best = jax.tree.map(lambda old, new: jnp.where(take, new, old), self, other)
        return replace(best, solved=best.solved | self.near)


def better(p: Program, pair: tuple[Array, Array], other: tuple[Array, Array]) -> tuple:
    """The one of two scaled pairs (w, y) with the smaller residuals, in the program's units."""
    first, second = (Pair.of(*lax.stop_gradient((p, *both))) for both in (pair, other))
    take = second.error < first.error
    pair, other = unscaled(p.qp, p.factor, *pair), unscaled(p.qp, p.factor, *other)
    return tuple(jnp.where(take, b, a) for a, b in zip(pair, other, strict=True))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Search:
    """One instance on its way: the point of the method of multipliers; q (n,) corrected by what
    rounding leaves of the gradient; the best pair so far; Newton steps taken; what is proved;
    w (n,) of the search for a proof, and whether to go on."""

    point: Multipliers
    q: Array
    best: Pair
    steps: Array
    proof: "Proof"
    w: Array
    open: Array


# Steps on the dual before the method of multipliers takes over, and those after which rows join
# one at a time.
DUAL_STEPS, JOINTLY = 24, 2


def improve(
    refine: int, fixed: bool, p: Program, begin: Multipliers
) -> tuple[tuple[Array, Array], "Proof"]:
    """The pair (z, y) and what is proved, after `refine` Newton steps at most; in float64.

    Steps on the dual in the rows that push solve most programs (`active_set.py`). The method of
    multipliers (`newton.py`) takes the others: P singular, balls, degenerate or infeasible rows.
    """
    qp, factor = p.qp, p.factor
    proof = prove(qp, factor, begin.change, begin.move)
    best = Pair.of(p, begin.w, begin.y)
    go_on = ~proof.unbounded & ~best.solved
    if not qp.balls and qp.A.shape[0] and not fixed:
        usable = go_on & ~factor.flat & ~proof.infeasible
        dual = dual_point(factor.A, p.q, p.bounds, begin.y)
        state = DualSearch(dual, p.q, best, jnp.int32(0), usable)
        most = min(DUAL_STEPS, refine)
        state = repeat_while(lambda s: s.open, partial(on_the_dual, most), p, state)
        best, go_on = state.best, go_on & ~state.best.solved
    s = Search(begin, p.q, best, jnp.int32(0), proof, begin.w, go_on)
    if fixed:
        length = refine + 3 * proof_steps(refine)
        s = lax.scan(lambda s, _: (by_multipliers(refine, p, s), None), s, length=length)[0]
    else:
        s = repeat_while(lambda s: s.open, partial(by_multipliers, refine), p, s)
    # The method of multipliers ends at the point of least violation, the best answer where there
    # is none.
    end = unscaled(qp, factor, s.point.w, s.point.y)
    infeasible = s.proof.infeasible & ~s.best.solved
    z, y = (jnp.where(infeasible, a, b) for a, b in zip(end, (s.best.z, s.best.y), strict=True))
    return (z, y), s.proof


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DualSearch:
    """One instance among the dual steps, with q (n,) corrected as in `Search`."""

    dual: DualPoint
    q: Array
    best: Pair
    steps: Array
    open: Array


def on_the_dual(most: int, p: Program, s: DualSearch) -> DualSearch:
    """One step of `active_set.py`, and whether it solved the program."""
    A, steps = p.factor.A, s.steps + 1
    dual = dual_step(A, p.factor.S, s.q, p.bounds, s.dual, steps > JOINTLY)
    pair, gradient = Pair.and_gradient(p, dual.w, dual.y)
    best = s.best.or_better(pair)
    # In exact arithmetic the gradient is zero here. Where P is ill-conditioned it is rounding of
    # T'PT, which the next step takes for a part of q (defect correction).
    q = s.q + gradient
    dual = replace(dual, w=dual.w - gradient, v=dual.v - matmul(gradient, A.T))
    return DualSearch(dual, q, best, steps, ~best.solved & (steps < most))


def proof_steps(refine: int) -> int:
    """Return the Newton steps towards a Farkas vector; twice as many towards a ray."""
    return max(refine // 5, 1)


def by_multipliers(refine: int, p: Program, s: Search) -> Search:
    """One Newton step: of the method of multipliers; after `refine` of these of least distance to
    the rows, whose excess becomes a Farkas vector; then, if P is singular, to those of a ray."""
    f, few, (n, dtype) = p.factor, proof_steps(refine), (s.w.shape[0], s.w.dtype)
    primal, distance = s.steps < refine, s.steps < refine + few
    pick = lambda one, other: jnp.where(primal, one, other)
    rows, bounds = stacked(p, primal, distance)
    w = jnp.where(s.steps == refine, s.point.w, s.w)
    length = jnp.linalg.norm(s.point.move)
    along = s.point.move / jnp.where(length > 0, length, 1.0)
    w = jnp.where(s.steps == refine + few, along, w)
    step = newton_step(
        pick(s.point.w, w), jnp.append(jnp.zeros(n + 1, dtype), pick(s.point.y, 0.0)),
        pick(f.H, 0.0), pick(s.q, 0.0), rows, bounds, pick(s.point.rho, 1.0),
        pick(s.point.sigma, Constants.of(dtype).damping), gram(rows),
    )  # fmt: skip
    step = step._replace(excess=step.excess[n + 1 :])
    point = jax.tree.map(pick, multipliers_update(s.q, s.point, step, p.far), s.point)
    pair, gradient = Pair.and_gradient(p, point.w, point.y)
    best = jax.tree.map(pick, s.best.or_better(pair), s.best)
    # What rounding of T'PT hides of the gradient counts as a part of q (defect correction).
    q = s.q + gradient - (matmul(point.w, f.H) + s.q + matmul(point.y, f.A))
    ray = jnp.where(distance, point.move, step.w)
    proof = s.proof.joined(prove(p.qp, f, pick(point.change, step.excess), ray))

    steps = s.steps + 1
    # A proof of infeasibility ends the search for one; the point of least violation goes on.
    settled = largest(point.move) <= 1e-9 * (1 + largest(point.w))
    settled = settled & (point.rho >= Constants.of(dtype).rho[1])
    last = refine + jnp.where(f.flat, 3 * few, few)
    ended = best.solved | proof.unbounded | (steps >= last)
    ended = ended | (proof.infeasible & (settled | (steps >= refine)))
    found = Search(point, q, best, steps, proof, step.w, ~ended)
    return jax.tree.map(lambda old, new: jnp.where(s.open, new, old), s, found)


def stacked(p: Program, primal: Array, distance: Array) -> tuple[Array, Bounds]:
    """The rows of a ray above those of the program, and what is asked of them: the bounds of the
    program, these without soft rows, or the cone of a ray."""
    n, given, hard = p.q.shape[0], p.bounds, p.bounds.hard()
    rows, cone = recession(p.q, p.factor.H, p.factor.A, given)
    free = jnp.full(n + 1, jnp.inf, p.q.dtype)
    side = lambda all_rows, hard_rows, free, cone: jnp.where(
        distance, jnp.append(free, jnp.where(primal, all_rows, hard_rows)), cone
    )
    bounds = replace(
        given, l=side(given.l, hard.l, -free, cone.l), u=side(given.u, hard.u, free, cone.u)
    )
    if given.linear is not None:
        bounds = replace(
            bounds, linear=jnp.append(free, given.linear),
            quadratic=jnp.append(0.0 * p.q, jnp.append(0.0, given.quadratic)),
        )  # fmt: skip
    if given.balls:
        bounds = replace(bounds, radius=jnp.where(distance, given.radius, 0.0))
    return rows, bounds


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


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Proof:
    """A Farkas vector and a descent ray, and whether they are proved to be."""

    certificate: Array
    infeasible: Array
    ray: Array
    unbounded: Array

    def joined(self, other: "Proof") -> "Proof":
        """What either proves."""
        old, new = self, other
        return Proof(
            jnp.where(old.infeasible, old.certificate, new.certificate),
            old.infeasible | new.infeasible,
            jnp.where(old.unbounded, old.ray, new.ray), old.unbounded | new.unbounded,
        )  # fmt: skip


def prove(qp: QP, factor: Factor, y: Array, d: Array) -> Proof:
    """What is proved of the program by scaled candidates for a Farkas vector y and for a ray d."""
    E = factor.E
    # Rows that z cannot move prove emptiness by themselves.
    fixed = jnp.where(E == 0, qp.bounds.violation(jnp.zeros_like(E)), 0.0)
    certificate, infeasible = farkas(qp, jnp.where(jnp.any(fixed != 0), fixed, E * y))
    ray, unbounded = descent_ray(qp, matmul(d, factor.T.T))
    return Proof(certificate, infeasible, ray, unbounded)


def tolerance(solver: ADMM, dtype: Any) -> Any:
    """Return the residuals that `solver` asks for."""
    return (1e-6 if dtype == jnp.float64 else 1e-3) if solver.eps is None else solver.eps


def within(qp: QP, z: Array, y: Array, eps: Any, floor: float) -> Array:
    """Whether each residual of (z, y) is at most eps + floor·(size of its terms)."""
    return jnp.all(jnp.stack([
        jnp.all(jnp.abs(value) <= eps + floor * size) for value, size in residual_terms(qp, z, y)
    ]))  # fmt: skip


def assess(qp: QP, pair: tuple[Array, Array], proof: Proof, solver: ADMM) -> QPSolution:
    """The pair (z, y) judged in the units of `qp`, in float64."""
    (z, y), dtype = pair, qp.q.dtype
    floor = rounding(dtype)

    def measure(qp: QP, z: Array, y: Array, eps: Array) -> tuple[Array, ...]:
        return (within(qp, z, y, eps, floor), *residuals(qp, z, y))

    eps = jnp.asarray(tolerance(solver, dtype), dtype)
    solved, primal, dual, gap = precisely(measure, qp, z, y, eps)
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


def marked(solution: QPSolution, fault: Array) -> QPSolution:
    """The solution where the data were usable; NaN and the status `fault` where they were not."""
    nan = lambda v: jnp.where(fault == Status.NOT_RUN, v, jnp.nan)
    s = solution
    return replace(
        s, z=nan(s.z), y=nan(s.y), cost=nan(s.cost), primal_residual=nan(s.primal_residual),
        dual_residual=nan(s.dual_residual), gap=nan(s.gap),
        status=jnp.where(fault == Status.NOT_RUN, s.status, fault),
    )  # fmt: skip
