"""From ADMM's pair to the exact one: Newton steps, each pair judged by its own residuals.

Steps on the dual in the active rows (`active_set.py`) solve most programs; what rounding leaves of
them is corrected; the method of multipliers (`newton.py`) takes the rest, and proves that there is
no solution where there is none.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxmpc.pytrees import pytree
from jaxmpc.qp.active_set import (
    DIVERGED,
    MORE_STEPS,
    MOST_STEPS,
    DualPoint,
    dual_search,
    has_dual_steps,
    single_step,
)
from jaxmpc.qp.admm import Factor, natural, scaled, scaled_multipliers, unscaled
from jaxmpc.qp.certificate import Proof, correcting_rows, farkas, prove, recession, to_length_one
from jaxmpc.qp.loops import repeat_while
from jaxmpc.qp.modes import varying
from jaxmpc.qp.newton import (
    Constants,
    MultiplierState,
    largest,
    multipliers_start,
    multipliers_update,
    newton_step,
)
from jaxmpc.qp.precision import matmul, rounding
from jaxmpc.qp.problem import QP
from jaxmpc.qp.projection import FREE, Bounds
from jaxmpc.qp.residuals import (
    SHARE,
    Measured,
    Natural,
    Pair,
    Products,
    judgment,
    row_sizes,
    terms_of,
)
from jaxmpc.qp.triton import has_kernels, in_one_program, indices


@pytree
class Program:
    """A program in its own units and, as `q` (n,) and `bounds`, in ADMM's coordinates, which are
    measured in `unit`; eps: the tolerance."""

    qp: QP
    factor: Factor
    q: Array
    bounds: Bounds
    unit: Array
    eps: Array

    @classmethod
    def of(cls, qp: QP, factor: Factor, eps: Array) -> "Program":
        """Return the program with clean data."""
        return cls(qp, factor, *scaled(factor, qp), eps)

    def natural(self, w: Array, y: Array) -> Natural:
        """Return what is natural for the program at w, y."""
        return natural(self.factor, self.unit, self.q, self.bounds, w, y)


def unrounded(p: Program) -> Program:
    """The program whose ADMM coordinates are made anew, in float64, from that in its own units:
    what rounding to float32 leaves between the two is more than the last Newton steps gain."""
    qp, f = p.qp, p.factor
    A = f.E[:, None] * matmul(qp.A, f.T)
    f = replace(f, H=matmul(f.T.T, matmul(qp.P, f.T)), A=A, S=matmul(A, A.T))
    return Program(qp, f, *scaled(f, qp, p.unit), p.eps)


def judged(p: Program, w: Array, y: Array) -> tuple[Pair, Array, Array]:
    """The pair of scaled w and y, the scaled gradient T'(Pz + q + A'y) (n,) of the Lagrangian, and
    the tolerances of rows (m,)."""
    qp, f, sizes = p.qp, p.factor, p.natural(w, y)
    z, y = unscaled(qp, f, p.unit, w, y)
    products = Products.of(qp, z, y)
    judge = judge_in_one_program if has_kernels(len(y)) and not qp.balls else judge_pair
    vectors = qp.q, qp.bounds, qp.row_sizes, z, y, products
    judgment, gradient = judge(p.eps, vectors, sizes, f.E, p.unit, p.bounds)
    tolerances = p.eps * row_sizes(products.Az, qp.row_sizes, sizes)
    return Pair(z, y, *judgment), matmul(gradient, f.T) / p.unit, tolerances


def judge_pair(
    eps: Any, vectors: tuple, sizes: Natural, E: Array, unit: Array, scaled: Bounds
) -> tuple[tuple[Measured, Array, Array, Array], Array]:
    """Return the last four fields of a pair, and the gradient of its Lagrangian. vectors: those of
    `terms_of`. scaled: the bounds in ADMM's coordinates, of row scale E and measured in `unit`."""
    q, bounds, known, z, y, products = vectors
    terms = terms_of(q, bounds, known, z, y, products, sizes)
    floor = rounding(y.dtype)
    # For soft rows the gap is quadratic in the error of z; the prox residual is linear.
    v, push = E * products.Az / unit, scaled_multipliers(E, y) / unit
    size = jnp.abs(v) + jnp.abs(push)
    prox = scaled.prox_residual(v + push, 1.0) - push, SHARE + size, size
    values, _, own = terms[1]
    # Entries at rounding level count as zero.
    gradient = jnp.where(jnp.abs(values) > floor * own, values, 0.0)
    return judgment(terms, eps, floor, [prox]), gradient


def judge_in_one_program(
    eps: Array, vectors: tuple, sizes: Natural, E: Array, unit: Array, scaled: Bounds
) -> tuple[tuple[Measured, Array, Array, Array], Array]:
    """`judge_pair` as a kernel for NVIDIA GPUs. Rows and variables that fill up the vectors are
    free, and zero."""
    q, bounds, known, z, y, products = vectors
    given, tree = jax.tree.flatten((vectors, replace(sizes, gap=None), E, scaled))
    free = FREE[: len(bounds.columns)]
    fills = jax.tree.leaves((
        (0.0, free, None if known is None else 0.0, 0.0, 0.0, (0.0,) * len(products)),
        (0.0,) * 4, 0.0, free,
    ))  # fmt: skip

    def judge(three: Array, *given: Array) -> tuple[list[Array], list[Array]]:
        i = indices(len(three))
        eps, gap, unit = (jnp.sum(jnp.where(i == n, three, 0.0)) for n in range(3))
        vectors, natural, E, scaled = jax.tree.unflatten(tree, given)
        found, gradient = judge_pair(eps, vectors, replace(natural, gap=gap), E, unit, scaled)
        return [gradient], jax.tree.leaves(found)

    data = [(jnp.stack([eps, sizes.gap, unit]), 0.0), *zip(given, fills, strict=True)]
    [gradient], numbers = in_one_program(judge, data, [len(z)], 7)
    primal, dual, gap, small, error, near, solved = numbers
    return (Measured(primal, dual, gap, small > 0), error, near > 0, solved > 0), gradient


@pytree
class Refinement:
    """Loop state of one instance: the point of the method of multipliers; its program, whose bounds
    may have been widened; q (n,) corrected by what rounding leaves of the gradient; the best pair
    so far; Newton steps taken, and those since the best pair became better; what is proved; w (n,)
    of the search for a proof; what is done (`PRIMAL`, `DISTANCE`, `RAY`), the steps left for it,
    whether the bounds have been widened, and whether to go on."""

    point: MultiplierState
    bounds: Bounds
    q: Array
    best: Pair
    steps: Array
    idle: Array
    proof: Proof
    w: Array
    doing: Array
    left: Array
    widened: Array
    open: Array


PRIMAL, DISTANCE, RAY = 0, 1, 2
# Steps without gain after which a pair within the tolerance is not made better any more.
IDLE = 40


def improve(
    refine: int, fixed: bool, whole: bool, p: Program, begin: MultiplierState
) -> tuple[Pair, Proof, Array, Array]:
    """Return the best pair (z, y) and what is proved, after `refine` Newton steps at most, in
    float64, whether there is nothing left to try, and whether the last half of many steps have
    not made the pair better.

    Steps on the dual in the active rows solve most programs (`active_set.py`). The method of
    multipliers (`newton.py`) takes the others: P singular, balls, degenerate or infeasible rows.
    """
    qp, factor, false = p.qp, p.factor, jnp.asarray(False)
    best, go_on = Pair.none(p.q, p.bounds.l), ~false
    correcting = correcting_rows(qp)
    if has_dual_steps(qp.balls, qp.A) and not fixed:
        # The dual of an infeasible program has no maximum: steps towards it would be wasted.
        allowed = p.eps * row_sizes(0.0, qp.row_sizes, p.natural(begin.w, begin.y))
        _, _, empty = farkas(qp, factor.E * begin.change, correcting, allowed)
        best, y = by_the_dual(p, begin.y, ~factor.flat & ~empty, refine)
        go_on = ~best.solved
        # MultiplierState that grow without bound are nearly a Farkas vector.
        begin = replace(begin, change=jnp.where(largest(y) > most_multiplier(p), y, begin.change))
        begin = least_violation(begin, empty)
    if not whole:
        return best, Proof.none(p.q, p.bounds.l), best.solved, false
    constants, none = (p, matmul(factor.H, factor.H), correcting), jnp.int32(0)
    s = Refinement(
        begin, p.bounds, p.q, best, none, none, Proof.none(p.q, p.bounds.l), begin.w,
        jnp.int32(PRIMAL), jnp.int32(refine), false, go_on,
    )  # fmt: skip
    if fixed:
        length = refine + 4 * proof_steps(refine)
        s = varying(s, (s, constants))
        s = lax.scan(partial(still_open, refine, constants), s, length=length)[0]
    else:
        step = partial(by_multipliers, refine)
        s = repeat_while(lambda s: s.open, step, constants, s, steps="long")
        if has_dual_steps(qp.balls, qp.A):
            s = replace(s, best=from_multipliers(p, s))
    return s.best, s.proof, ~false, s.idle > max(refine // 2, 50)


@pytree
class Correction:
    """Loop state of one instance whose dual steps leave residuals: its point, the gradient of its
    Lagrangian in w (n,), the best pair so far, the corrections made, and whether to go on."""

    point: DualPoint
    gradient: Array
    best: Pair
    steps: Array
    open: Array


def by_the_dual(p: Program, y: Array, go_on: Array, most: int) -> tuple[Pair, Array]:
    """Return the best pair of a search on the dual from y (m,) in ADMM's coordinates, `most` steps
    and corrections at most, and the last multipliers. The pair is `solved` where its residuals are
    small enough to end with it."""
    f, first, limit = p.factor, min(most, MOST_STEPS), most_multiplier(p)
    cold, point = DualPoint.cold(f.A, p.q), DualPoint.of(f.A, p.q, p.bounds, y)
    more = min(most - first, MORE_STEPS)
    point, optimal = dual_search(f.A, f.S, p.bounds, limit, cold, point, go_on, first, more)
    best, gradient, _ = judged(p, point.w, point.y)
    best = replace(best, solved=best.solved | best.near)
    start = Correction(point, gradient, best, jnp.int32(0), optimal & ~best.solved)
    end = repeat_while(lambda s: s.open, partial(correction, first), p, start, steps="long")
    return end.best, end.point.y


def most_multiplier(p: Program) -> Array:
    """Return the size of scaled multipliers from which on the dual seems unbounded: rows contradict
    each other. Systems in the active rows have a ridge, beside which rows that are more nearly
    dependent, and hold multipliers of more than this, cannot be told apart."""
    return DIVERGED * (1 + largest(p.q))


def from_multipliers(p: Program, s: Refinement) -> Pair:
    """Return the best pair after corrections from where the method of multipliers ends.

    Its penalty multiplies the rounding of rows, so that it stops short of rounding. Where the
    Hessian H in ADMM's coordinates is singular a correction is a step of the proximal point method:
    with I − H as the proximal term the Hessian is I, and the minimiser without rows is
    w − (Hw + q + A'y)."""
    f, point = p.factor, s.point
    gradient = matmul(point.w, f.H) + s.q + matmul(point.y, f.A)
    begin = DualPoint(point.y, point.w, matmul(point.w, f.A.T))
    go_on = ~s.best.solved & ~s.proof.beyond & ~s.proof.unbounded & jnp.isfinite(s.best.error)
    start = Correction(begin, gradient, s.best, jnp.int32(0), go_on)
    step = partial(correction, MOST_STEPS)
    program = replace(p, bounds=s.bounds)
    return repeat_while(lambda s: s.open, step, program, start, steps="long").best


def correction(most: int, p: Program, s: Correction) -> Correction:
    """One more step on the dual, from a point that makes up for the gradient of the Lagrangian: it
    is zero there in exact arithmetic; where P is ill-conditioned it is rounding of T'PT (defect
    correction)."""
    f, steps, limit = p.factor, s.steps + 1, most_multiplier(p)
    point = s.point.shifted(f.A, -s.gradient)
    point = single_step(f.A, f.S, p.bounds, limit, point)
    pair, gradient, _ = judged(p, point.w, point.y)
    best = s.best.or_better(pair)
    go_on = ~best.solved & (largest(point.y) <= limit) & (steps < most)
    return Correction(point, gradient, best, steps, go_on)


def proof_steps(refine: int) -> int:
    """Return the Newton steps towards a Farkas vector; twice as many towards a ray."""
    return max(min(refine // 5, 30), 1)


def by_multipliers(refine: int, constants: tuple, s: Refinement) -> Refinement:
    """Take one Newton step: of the method of multipliers, `refine` times at most; then of least
    distance to the rows, whose residual becomes a Farkas vector; then, if P is singular, of
    `recession`, whose minimiser becomes a ray.

    Rows that contradict each other by less than their tolerances have a solution all the same:
    where that is found, steps of least distance come at once, the bounds are widened by what is
    left of the violation, which is the least, and the method of multipliers begins once more.
    """
    p, squared, correcting = constants
    f, few, dtype = p.factor, proof_steps(refine), s.w.dtype
    primal, distance = s.doing == PRIMAL, s.doing == DISTANCE
    pick = lambda first, second, third: jax.tree.map(
        lambda a, b, c: jnp.where(primal, a, jnp.where(distance, b, c)), first, second, third
    )
    hard, (H_ray, q_ray, cone) = p.bounds.hard(), recession(squared, p.q, p.bounds)
    bounds = s.bounds
    if bounds.linear is not None:
        rigid: dict[str, Any] = {
            "linear": jnp.full_like(bounds.linear, jnp.inf),
            "quadratic": jnp.zeros_like(bounds.quadratic),
        }
        hard, cone = replace(hard, **rigid), replace(cone, **rigid)
    damping, none = Constants.of(dtype).damping, jnp.zeros_like(s.point.y)
    at, y, H, q, bounds, rho, sigma = pick(
        (s.point.w, s.point.y, f.H, s.q, bounds, s.point.rho, s.point.sigma),
        (s.w, none, 0 * f.H, 0 * s.q, hard, 1.0, damping),
        (s.w, none, H_ray, q_ray, cone, 1.0, damping),
    )
    step = newton_step(at, y, H, q, bounds, rho, sigma, f.A)
    keep = lambda new, old: jax.tree.map(lambda a, b: jnp.where(primal, a, b), new, old)
    stiff = s.point.rho >= Constants.of(dtype).rho[1]
    point = keep(multipliers_update(s.q, s.point, step), s.point)
    pair, gradient, tolerances = judged(p, point.w, point.y)
    # What rounding of T'PT hides of the gradient counts as a part of q (defect correction).
    q = s.q + gradient - (matmul(point.w, f.H) + s.q + matmul(point.y, f.A))
    ray = jnp.where(distance, point.move, step.w)
    push = jnp.where(primal, point.change, step.excess)
    proof = s.proof.joined(prove(p.qp, f.T, f.E, correcting, tolerances, push, ray))
    # Where there is no answer, the best is the point of least violation, at which this ends.
    best = keep(s.best.or_better(pair), s.best)
    idle = jnp.where(best.error < 0.5 * s.best.error, 0, s.idle + 1)
    take = proof.beyond & ~best.solved
    best = jax.tree.map(lambda a, b: jnp.where(take, a, b), pair, best)

    steps, left = s.steps + primal, s.left - 1
    narrow = proof.infeasible & ~proof.beyond & ~s.widened
    ended = best.solved | (best.measured.small & (idle >= IDLE))
    ended = ended | proof.unbounded | (proof.beyond & ((stiff & step.minimised) | ~primal))
    to_distance = primal & ((left <= 0) | narrow)
    rested = distance & ((left <= 0) | (narrow & step.minimised))
    widen = rested & narrow & (steps < refine)
    to_ray = rested & ~widen & f.flat
    ended = ended | (rested & ~widen & ~f.flat) | ((s.doing == RAY) & (left <= 0))
    doing = jnp.where(to_distance, DISTANCE, jnp.where(to_ray, RAY, s.doing))
    left = jnp.where(to_distance, few, jnp.where(to_ray, 2 * few, left))
    w = jnp.where(to_distance, point.w, jnp.where(to_ray, to_length_one(point.move), step.w))

    point = least_violation(point, proof.beyond & ~stiff)
    fresh = multipliers_start(p.q, step.w, none)
    wider = s.bounds.widened(step.excess * widen)
    anew = lambda new, old: jax.tree.map(lambda a, b: jnp.where(widen, a, b), new, old)
    return Refinement(
        anew(fresh, point), wider, anew(p.q, q), best, steps, idle, proof, w,
        jnp.where(widen, PRIMAL, doing), jnp.where(widen, refine - steps, left),
        s.widened | widen, ~ended,
    )  # fmt: skip


def least_violation(point: MultiplierState, infeasible: Array) -> MultiplierState:
    """`point`, or where the program is infeasible the start of a search for the least violation of
    the rows: the last penalty at once, and no multipliers."""
    top = Constants.of(point.w.dtype).rho[1]
    return replace(
        point, rho=jnp.where(infeasible, top, point.rho), y=jnp.where(infeasible, 0.0, point.y)
    )


def still_open(refine: int, constants: tuple, s: Refinement, _: None) -> tuple[Refinement, None]:
    """Body of a scan: `by_multipliers`, no change once the instance is finished."""
    new = by_multipliers(refine, constants, s)
    return jax.tree.map(lambda a, b: jnp.where(s.open, a, b), new, s), None
