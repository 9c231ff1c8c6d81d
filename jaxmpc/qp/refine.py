"""From ADMM's pair to the exact one: Newton steps, each pair judged by its own residuals.

Steps on the dual in the active rows (`active_set.py`) solve most programs; what rounding leaves of
them is corrected; the method of multipliers (`newton.py`) takes the rest, and proves that there is
no solution where there is none.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxmpc.qp.active_set import (
    DIVERGED,
    MORE_STEPS,
    MOST_STEPS,
    DualPoint,
    dual_search,
    has_dual_steps,
    single_step,
)
from jaxmpc.qp.admm import Factor, scaled, scaled_multipliers, unscaled
from jaxmpc.qp.batches import repeat_while
from jaxmpc.qp.certificate import Proof, correcting_rows, farkas, prove, recession, to_length_one
from jaxmpc.qp.modes import varying
from jaxmpc.qp.newton import (
    Constants,
    Multipliers,
    largest,
    multipliers_update,
    newton_step,
)
from jaxmpc.qp.precision import matmul, rounding
from jaxmpc.qp.problem import QP
from jaxmpc.qp.projection import FREE, Bounds
from jaxmpc.qp.residuals import Measured, Pair, Products, judgment, terms_of
from jaxmpc.qp.triton import has_kernels, in_one_program, indices


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Program:
    """A program in its own units and, as `q` (n,) and `bounds`, in ADMM's coordinates; eps: the
    tolerances (2,); far: bound on |w|, beyond which steps are rejected (the program looks
    unbounded)."""

    qp: QP
    factor: Factor
    q: Array
    bounds: Bounds
    eps: Array
    far: float = field(metadata={"static": True})


def unrounded(p: Program) -> Program:
    """The program whose ADMM coordinates are made anew, in float64, from that in its own units:
    what rounding to float32 leaves between the two is more than the last Newton steps gain."""
    qp, f = p.qp, p.factor
    A = f.E[:, None] * matmul(qp.A, f.T)
    f = replace(f, H=matmul(f.T.T, matmul(qp.P, f.T)), A=A, S=matmul(A, A.T))
    q, bounds = scaled(f, qp)
    return replace(p, factor=f, q=q, bounds=bounds)


def judged(p: Program, w: Array, y: Array) -> tuple[Pair, Array]:
    """The pair of scaled w and y, and the gradient T'(Pz + q + A'y) (n,) of the Lagrangian."""
    qp, f = p.qp, p.factor
    z, y = unscaled(qp, f, w, y)
    products = Products.of(qp, z, y)
    judge = judge_in_one_program if has_kernels(len(y)) and not qp.balls else judge_pair
    judgment, gradient = judge(p.eps, qp.q, qp.bounds, z, y, products, f.E, p.bounds)
    return Pair(z, y, *judgment), matmul(gradient, f.T)


def judge_pair(
    eps: Any, q: Array, bounds: Bounds, z: Array, y: Array, products: Products, E: Array,
    scaled: Bounds,
) -> tuple[tuple[Measured, Array, Array, Array], Array]:  # fmt: skip
    """Return the last four fields of the pair (z, y), and the gradient of its Lagrangian."""
    terms, floor = terms_of(q, bounds, z, y, products), rounding(z.dtype)
    # For soft rows the gap is quadratic in the error of z; the prox residual is linear.
    v, push = E * products.Az, scaled_multipliers(E, y)
    prox = scaled.prox_residual(v + push, 1.0) - push, jnp.abs(v) + jnp.abs(push)
    values, sizes = terms[1]
    # Entries at rounding level count as zero.
    gradient = jnp.where(jnp.abs(values) > floor * sizes, values, 0.0)
    return judgment(terms, eps, floor, [prox]), gradient


def judge_in_one_program(
    eps: Array, q: Array, bounds: Bounds, z: Array, y: Array, products: Products, E: Array,
    scaled: Bounds,
) -> tuple[tuple[Measured, Array, Array, Array], Array]:  # fmt: skip
    """`judge_pair` as a kernel for NVIDIA GPUs. Rows and variables that fill up the vectors are
    free, and zero."""
    vectors, tree = jax.tree.flatten((q, bounds, z, y, products, E, scaled))
    free = FREE[: len(bounds.columns)]
    fills = jax.tree.leaves((0.0, free, 0.0, 0.0, (0.0,) * len(products), 0.0, free))

    def judge(eps: Array, *vectors: Array) -> tuple[list[Array], list[Array]]:
        i = indices(len(eps))
        two = [jnp.sum(jnp.where(i == n, eps, 0.0)) for n in range(2)]
        found, gradient = judge_pair(two, *jax.tree.unflatten(tree, vectors))
        return [gradient], jax.tree.leaves(found)

    data = [(eps, 0.0), *zip(vectors, fills, strict=True)]
    [gradient], numbers = in_one_program(judge, data, [len(z)], 7)
    primal, dual, gap, small, error, near, solved = numbers
    return (Measured(primal, dual, gap, small > 0), error, near > 0, solved > 0), gradient


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Search:
    """Loop state of one instance: the point of the method of multipliers; q (n,) corrected by what
    rounding leaves of the gradient; the best pair so far; Newton steps taken; what is proved;
    w (n,) of the search for a proof, and whether to go on."""

    point: Multipliers
    q: Array
    best: Pair
    steps: Array
    proof: Proof
    w: Array
    open: Array


def improve(
    refine: int, fixed: bool, whole: bool, p: Program, begin: Multipliers
) -> tuple[Pair, Proof, Array]:
    """Return the best pair (z, y) and what is proved, after `refine` Newton steps at most, in
    float64, and whether there is nothing left to try.

    Steps on the dual in the active rows solve most programs (`active_set.py`). The method of
    multipliers (`newton.py`) takes the others: P singular, balls, degenerate or infeasible rows.
    """
    qp, factor = p.qp, p.factor
    best, go_on = Pair.none(p.q, p.bounds.l), jnp.asarray(True)
    correcting = correcting_rows(qp)
    if has_dual_steps(qp.balls, qp.A) and not fixed:
        # The dual of an infeasible program has no maximum: steps towards it would be wasted.
        _, empty = farkas(qp, factor.E * begin.change, correcting)
        best, y = by_the_dual(p, begin.y, ~factor.flat & ~empty, refine)
        go_on = ~best.solved
        # Multipliers that grow without bound are nearly a Farkas vector.
        begin = replace(begin, change=jnp.where(largest(y) > most_multiplier(p), y, begin.change))
        begin = least_violation(begin, empty)
    if not whole:
        return best, Proof.none(p.q, p.bounds.l), best.solved
    constants = (p, matmul(factor.H, factor.H), correcting)
    s = Search(begin, p.q, best, jnp.int32(0), Proof.none(p.q, p.bounds.l), begin.w, go_on)
    if fixed:
        length = refine + 3 * proof_steps(refine)
        s = varying(s, (s, constants))
        s = lax.scan(partial(still_open, refine, constants), s, length=length)[0]
    else:
        step = partial(by_multipliers, refine)
        s = repeat_while(lambda s: s.open, step, constants, s, steps="long")
    return s.best, s.proof, jnp.asarray(True)


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
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
    best, gradient = judged(p, point.w, point.y)
    best = replace(best, solved=best.solved | best.near)
    start = Correction(point, gradient, best, jnp.int32(0), optimal & ~best.solved)
    end = repeat_while(lambda s: s.open, partial(correction, first), p, start, steps="long")
    return end.best, end.point.y


def most_multiplier(p: Program) -> Array:
    """Return the size of scaled multipliers from which on the dual seems unbounded: rows contradict
    each other."""
    return DIVERGED * (1 + largest(p.q))


def correction(most: int, p: Program, s: Correction) -> Correction:
    """One more step on the dual, from a point that makes up for the gradient of the Lagrangian: it
    is zero there in exact arithmetic; where P is ill-conditioned it is rounding of T'PT (defect
    correction)."""
    f, steps, limit = p.factor, s.steps + 1, most_multiplier(p)
    point = s.point.shifted(f.A, -s.gradient)
    point = single_step(f.A, f.S, p.bounds, limit, point)
    pair, gradient = judged(p, point.w, point.y)
    best = s.best.or_better(pair)
    go_on = ~best.solved & (largest(point.y) <= limit) & (steps < most)
    return Correction(point, gradient, best, steps, go_on)


def proof_steps(refine: int) -> int:
    """Return the Newton steps towards a Farkas vector; twice as many towards a ray."""
    return max(min(refine // 5, 30), 1)


def by_multipliers(refine: int, constants: tuple, s: Search) -> Search:
    """Take one Newton step, by the count of steps: of the method of multipliers, `refine` times;
    then of least distance to the rows, whose residual becomes a Farkas vector; then, if P is
    singular, of `recession`, whose minimiser becomes a ray."""
    p, squared, correcting = constants
    f, few, dtype = p.factor, proof_steps(refine), s.w.dtype
    primal, distance = s.steps < refine, s.steps < refine + few
    pick = lambda first, second, third: jax.tree.map(
        lambda a, b, c: jnp.where(primal, a, jnp.where(distance, b, c)), first, second, third
    )
    w = jnp.where(s.steps == refine, s.point.w, s.w)
    w = jnp.where(s.steps == refine + few, to_length_one(s.point.move), w)
    hard, (H_ray, q_ray, cone) = p.bounds.hard(), recession(squared, p.q, p.bounds)
    if p.bounds.linear is not None:
        rigid: dict[str, Any] = {
            "linear": jnp.full_like(p.bounds.linear, jnp.inf),
            "quadratic": jnp.zeros_like(p.bounds.quadratic),
        }
        hard, cone = replace(hard, **rigid), replace(cone, **rigid)
    damping, none = Constants.of(dtype).damping, jnp.zeros_like(s.point.y)
    at, y, H, q, bounds, rho, sigma = pick(
        (s.point.w, s.point.y, f.H, s.q, p.bounds, s.point.rho, s.point.sigma),
        (w, none, 0 * f.H, 0 * s.q, hard, 1.0, damping),
        (w, none, H_ray, q_ray, cone, 1.0, damping),
    )
    step = newton_step(at, y, H, q, bounds, rho, sigma, f.A)
    keep = lambda new, old: jax.tree.map(lambda a, b: jnp.where(primal, a, b), new, old)
    stiff = s.point.rho >= Constants.of(dtype).rho[1]
    point = keep(multipliers_update(s.q, s.point, step, p.far), s.point)
    pair, gradient = judged(p, point.w, point.y)
    # What rounding of T'PT hides of the gradient counts as a part of q (defect correction).
    q = s.q + gradient - (matmul(point.w, f.H) + s.q + matmul(point.y, f.A))
    ray = jnp.where(distance, point.move, step.w)
    push = jnp.where(primal, point.change, step.excess)
    proof = s.proof.joined(prove(p.qp, f.T, f.E, correcting, push, ray))
    # Where there is no answer, the best is the point of least violation, at which this ends.
    best = keep(s.best.or_better(pair), s.best)
    take = proof.infeasible & ~best.solved
    best = jax.tree.map(lambda a, b: jnp.where(take, a, b), pair, best)

    steps = s.steps + 1
    there = (stiff & step.minimised) | ~primal
    ended = best.solved | proof.unbounded | (proof.infeasible & there)
    point = least_violation(point, proof.infeasible & ~stiff)
    ended = ended | (steps >= refine + jnp.where(f.flat, 3 * few, few))
    return Search(point, q, best, steps, proof, step.w, ~ended)


def least_violation(point: Multipliers, infeasible: Array) -> Multipliers:
    """`point`, or where the program is infeasible the start of a search for the least violation of
    the rows: the last penalty at once, and no multipliers."""
    top = Constants.of(point.w.dtype).rho[1]
    return replace(
        point, rho=jnp.where(infeasible, top, point.rho), y=jnp.where(infeasible, 0.0, point.y)
    )


def still_open(refine: int, constants: tuple, s: Search, _: None) -> tuple[Search, None]:
    """Body of a scan: `by_multipliers`, no change once the instance is finished."""
    new = by_multipliers(refine, constants, s)
    return jax.tree.map(lambda a, b: jnp.where(s.open, a, b), new, s), None
