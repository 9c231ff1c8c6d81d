"""From ADMM's pair to the exact one: Newton steps, each pair measured by its own residuals.

Steps on the dual in the active rows solve most programs; what rounding leaves of them is corrected
(`defect_correction.py`); the method of multipliers (`newton.py`) takes the rest, and proves that
there is no solution where there is none.
"""

from dataclasses import replace
from enum import IntEnum
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxmpc.pytrees import pytree
from jaxmpc.qp.batched_loops import repeat_while
from jaxmpc.qp.certificate import Proof, correcting_rows, farkas, prove, recession, to_length_one
from jaxmpc.qp.defect_correction import Correction, corrected, solve_dual
from jaxmpc.qp.dual_search import MOST_STEPS, has_dual_steps
from jaxmpc.qp.dual_step import DualPoint
from jaxmpc.qp.jax_modes import varying
from jaxmpc.qp.newton import (
    Augmented,
    Constants,
    MultiplierState,
    NewtonStep,
    largest,
    multipliers_start,
    multipliers_update,
    newton_step,
)
from jaxmpc.qp.precision import matmul
from jaxmpc.qp.projection import Bounds
from jaxmpc.qp.residuals import Pair, row_sizes
from jaxmpc.qp.scaled_program import ScaledProgram

T = TypeVar("T")

# Steps without gain after which a pair within the tolerance is not made better any more.
IDLE = 40


class Phase(IntEnum):
    """What Newton steps minimise: the augmented Lagrangian of the method of multipliers; the
    distance from the rows, whose residual becomes a Farkas vector; or `recession`, whose minimiser
    becomes a ray."""

    MULTIPLIERS, DISTANCE, RAY = range(3)


@pytree
class Refinement:
    """Loop state of one instance: the point of the method of multipliers; its program, whose bounds
    may have been widened; q (n,) corrected by what rounding leaves of the gradient; the best pair
    so far; Newton steps of the method, and steps since the best pair became better; what is proved;
    w (n,) of the search for a proof; the `Phase`, the steps left for it, whether the bounds have
    been widened, and whether to go on."""

    point: MultiplierState
    bounds: Bounds
    q: Array
    best: Pair
    steps: Array
    idle: Array
    proof: Proof
    w: Array
    phase: Array
    left: Array
    widened: Array
    open: Array


class RefinementData(NamedTuple):
    """What the steps need: the program, H² (n, n), and `certificate.correcting_rows`."""

    program: ScaledProgram
    squared: Array
    correcting: tuple[Array, Array]


class Improved(NamedTuple):
    """The best pair and what is proved, whether there is nothing left to try, and whether the last
    half of many steps have not made the pair better."""

    pair: Pair
    proof: Proof
    ended: Array
    idle: Array


def improve(
    most: int, fixed: bool, whole: bool, p: ScaledProgram, begin: MultiplierState
) -> Improved:
    """Improve the point of ADMM by `most` Newton steps at most, in float64. fixed: every instance
    takes them all. whole: with the method of multipliers.

    Steps on the dual in the active rows solve most programs (`dual_step.py`). The method of
    multipliers (`newton.py`) takes the others: P singular, balls, degenerate or infeasible rows.
    """
    qp, f, false = p.qp, p.factor, jnp.asarray(False)
    best, go_on = Pair.none(p.q, p.bounds.l), ~false
    correcting = correcting_rows(qp)
    if has_dual_steps(qp.balls, qp.A) and not fixed:
        # The dual of an infeasible program has no maximum: steps towards it would be wasted.
        allowed = p.eps * row_sizes(0.0, qp.row_sizes, p.natural(begin.w, begin.y))
        _, _, empty = farkas(qp, f.E * begin.change, correcting, allowed)
        best, y = solve_dual(p, begin.y, ~f.flat & ~empty, most)
        go_on = ~best.finished
        # Multipliers that grow without bound are nearly a Farkas vector.
        begin = replace(begin, change=jnp.where(largest(y) > p.dual.limit, y, begin.change))
        begin = least_violation(begin, empty)
    if not whole:
        return Improved(best, Proof.none(p.q, p.bounds.l), best.finished, false)
    given, none = RefinementData(p, matmul(f.H, f.H), correcting), jnp.int32(0)
    s = Refinement(
        point=begin,
        bounds=p.bounds,
        q=p.q,
        best=best,
        steps=none,
        idle=none,
        proof=Proof.none(p.q, p.bounds.l),
        w=begin.w,
        phase=jnp.int32(Phase.MULTIPLIERS),
        left=jnp.int32(most),
        widened=false,
        open=go_on,
    )
    if fixed:
        length = most + 4 * proof_steps(most)
        s = varying(s, (s, given))
        s = lax.scan(partial(_advance_if_open, most, given), s, length=length)[0]
    else:
        s = repeat_while(lambda s: s.open, partial(advance, most), given, s, steps="long")
        if has_dual_steps(qp.balls, qp.A):
            s = replace(s, best=corrected_end(p, s))
    return Improved(s.best, s.proof, ~false, s.idle > max(most // 2, 50))


def corrected_end(p: ScaledProgram, s: Refinement) -> Pair:
    """Return the best pair after corrections from where the method of multipliers ends.

    Its penalty multiplies the rounding of rows, so that it stops short of rounding. Where the
    Hessian H in ADMM's coordinates is singular a correction is a step of the proximal point method:
    with I − H as the proximal term the Hessian is I, and the minimiser without rows is
    w − (Hw + q + A'y)."""
    f, point = p.factor, s.point
    gradient = matmul(point.w, f.H) + s.q + matmul(point.y, f.A)
    begin = DualPoint(point.y, point.w, matmul(point.w, f.A.T))
    go_on = ~s.best.finished & ~s.proof.beyond & ~s.proof.unbounded & jnp.isfinite(s.best.error)
    start = Correction(begin, gradient, s.best, jnp.int32(0), go_on)
    return corrected(MOST_STEPS, replace(p, bounds=s.bounds), start).best


def proof_steps(most: int) -> int:
    """Return the Newton steps towards a Farkas vector; twice as many towards a ray."""
    return max(min(most // 5, 30), 1)


def advance(most: int, given: RefinementData, s: Refinement) -> Refinement:
    """Take one Newton step of the present phase, measure its pair and look for a proof: at first of
    the method of multipliers, `most` times at most; see `next_phase`."""
    p, f = given.program, given.program.factor
    primal, distance = s.phase == Phase.MULTIPLIERS, s.phase == Phase.DISTANCE
    at, phi = _minimised(given, s, primal, distance)
    step = newton_step(at, phi, f.A)
    stiff = s.point.rho >= Constants.of(s.w.dtype).rho[1]
    point = _where(primal, multipliers_update(s.q, s.point, step), s.point)
    pair, gradient, tolerances = p.measure(point.w, point.y)
    # What rounding of T'PT hides of the gradient counts as a part of q (defect correction).
    q = s.q + gradient - (matmul(point.w, f.H) + s.q + matmul(point.y, f.A))
    ray = jnp.where(distance, point.move, step.w)
    push = jnp.where(primal, point.change, step.excess)
    found = prove(p.qp, f.T, f.E, given.correcting, tolerances, push, ray)
    proof = s.proof.joined(found)
    # Where there is no answer, the best is the point of least violation, at which this ends.
    best = _where(primal, s.best.or_better(pair), s.best)
    idle = jnp.where(best.error < 0.5 * s.best.error, 0, s.idle + 1)
    best = _where(proof.beyond & ~best.finished, pair, best)
    steps, left = s.steps + primal, s.left - 1
    new = replace(s, point=point, q=q, best=best, steps=steps, idle=idle, proof=proof, left=left)
    return next_phase(most, p, new, step, stiff, primal, distance)


def _minimised(
    given: RefinementData, s: Refinement, primal: Array, distance: Array
) -> tuple[Array, Augmented]:
    """Return where the step of the present phase begins, and what it minimises."""
    p, H = given.program, given.program.factor.H
    hard, (H_ray, q_ray, cone) = p.bounds.hard(), recession(given.squared, p.q, p.bounds)
    if s.bounds.linear is not None:  # of one structure, so that one of them can be taken
        linear = jnp.full_like(s.bounds.linear, jnp.inf)
        quadratic = jnp.zeros_like(s.bounds.quadratic)
        hard = replace(hard, linear=linear, quadratic=quadratic)
        cone = replace(cone, linear=linear, quadratic=quadratic)
    damping, y, q = Constants.of(s.w.dtype).damping, jnp.zeros_like(s.point.y), s.q
    multipliers = Augmented(s.point.y, H, q, s.bounds, s.point.rho, s.point.sigma)
    to_rows = Augmented(y, 0 * H, 0 * q, hard, 1.0, damping)
    to_ray = Augmented(y, H_ray, q_ray, cone, 1.0, damping)
    return jax.tree.map(
        lambda a, b, c: jnp.where(primal, a, jnp.where(distance, b, c)),
        (s.point.w, multipliers),
        (s.w, to_rows),
        (s.w, to_ray),
    )


def next_phase(
    most: int,
    p: ScaledProgram,
    s: Refinement,
    step: NewtonStep,
    stiff: Array,
    primal: Array,
    distance: Array,
) -> Refinement:
    """Return the state in the phase that follows a step. stiff: whether that had the last penalty.

    After the method of multipliers come steps of least distance; then, if P is singular, of
    `recession`. Rows that contradict each other by less than their tolerances have a solution all
    the same: where that is found, steps of least distance come at once, the bounds are widened by
    what is left of the violation, which is the least, and the method of multipliers begins anew.
    """
    proof, point, flat, few = s.proof, s.point, p.factor.flat, proof_steps(most)
    over = s.left <= 0
    narrow = proof.infeasible & ~proof.beyond & ~s.widened
    ended = s.best.finished | (s.best.measured.within_tolerance & (s.idle >= IDLE))
    ended = ended | proof.unbounded | (proof.beyond & ((stiff & step.minimised) | ~primal))
    to_distance = primal & (over | narrow)
    rested = distance & (over | (narrow & step.minimised))
    widen = rested & narrow & (s.steps < most)
    to_ray = rested & ~widen & flat
    ended = ended | (rested & ~widen & ~flat) | ((s.phase == Phase.RAY) & over)
    phase = jnp.where(to_distance, Phase.DISTANCE, jnp.where(to_ray, Phase.RAY, s.phase))
    left = jnp.where(to_distance, few, jnp.where(to_ray, 2 * few, s.left))
    w = jnp.where(to_distance, point.w, jnp.where(to_ray, to_length_one(point.move), step.w))

    point = least_violation(point, proof.beyond & ~stiff)
    anew = multipliers_start(p.q, step.w, jnp.zeros_like(point.y))
    return replace(
        s,
        bounds=s.bounds.widened(step.excess * widen),
        point=_where(widen, anew, point),
        q=_where(widen, p.q, s.q),
        w=w,
        phase=jnp.where(widen, Phase.MULTIPLIERS, phase),
        left=jnp.where(widen, most - s.steps, left),
        widened=s.widened | widen,
        open=~ended,
    )


def _where(condition: Array, new: T, old: T) -> T:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def least_violation(point: MultiplierState, infeasible: Array) -> MultiplierState:
    """Return `point`, or where the program is infeasible the start of a search for the least
    violation of the rows: the last penalty at once, and no multipliers."""
    top = Constants.of(point.w.dtype).rho[1]
    return replace(
        point, rho=jnp.where(infeasible, top, point.rho), y=jnp.where(infeasible, 0.0, point.y)
    )


def _advance_if_open(
    most: int, given: RefinementData, s: Refinement, _: None
) -> tuple[Refinement, None]:
    """Body of a scan: `advance`, no change once the instance is finished."""
    return _where(s.open, advance(most, given, s), s), None
