"""A search on the dual, and corrections of what rounding leaves of its solution."""

from dataclasses import replace
from functools import partial

import jax.numpy as jnp
from jax import Array

from jaxmpc.pytrees import pytree
from jaxmpc.qp.batched_loops import repeat_while
from jaxmpc.qp.dual_search import MORE_STEPS, MOST_STEPS, dual_search, single_step
from jaxmpc.qp.dual_step import DualPoint, MostSteps
from jaxmpc.qp.newton import largest
from jaxmpc.qp.residuals import Pair
from jaxmpc.qp.scaled_program import ScaledProgram


@pytree
class Correction:
    """Loop state of one instance whose steps leave residuals: its point, the gradient of its
    Lagrangian in w (n,), the best pair so far, the corrections made, and whether to go on."""

    point: DualPoint
    gradient: Array
    best: Pair
    steps: Array
    open: Array


def solve_dual(p: ScaledProgram, y: Array, go_on: Array, most: int) -> tuple[Pair, Array]:
    """Return the best pair of a search on the dual from y (m,) in ADMM's coordinates, `most` steps
    and corrections at most, and the last multipliers. The pair is `solved` where its residuals are
    small enough to end with it."""
    f, dual, first = p.factor, p.dual, min(most, MOST_STEPS)
    cold, point = DualPoint.cold(f.A, p.q), DualPoint.of(f.A, p.q, p.bounds, y)
    steps = MostSteps(first, min(most - first, MORE_STEPS))
    point, optimal = dual_search(dual, cold, point, go_on, steps)
    best, gradient, _ = p.measure(point.w, point.y)
    best = replace(best, finished=best.finished | best.near)
    start = Correction(point, gradient, best, jnp.int32(0), optimal & ~best.finished)
    end = corrected(first, p, start)
    return end.best, end.point.y


def corrected(most: int, p: ScaledProgram, start: Correction) -> Correction:
    """Return the state after `most` corrections at most."""
    return repeat_while(lambda s: s.open, partial(_correct, most), p, start, steps="long")


def _correct(most: int, p: ScaledProgram, s: Correction) -> Correction:
    """One more step on the dual, from a point that makes up for the gradient of the Lagrangian: it
    is zero there in exact arithmetic; where P is ill-conditioned it is rounding of T'PT (defect
    correction)."""
    dual, steps = p.dual, s.steps + 1
    point = single_step(dual, s.point.shifted(dual.A, -s.gradient))
    pair, gradient, _ = p.measure(point.w, point.y)
    best = s.best.or_better(pair)
    go_on = ~best.finished & (largest(point.y) <= dual.limit) & (steps < most)
    return Correction(point, gradient, best, steps, go_on)
