"""A search on the dual: steps of `dual_step.py` until the multipliers are optimal.

A loop of XLA, or on NVIDIA GPUs one kernel (`dual_kernel.py`).
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.pytrees import pytree
from jaxmpc.qp.batched_loops import repeat_while
from jaxmpc.qp.dual_kernel import dual_search_kernel
from jaxmpc.qp.dual_step import (
    JOINTLY,
    Dual,
    DualPoint,
    MostSteps,
    after_step,
    dual_step,
    sizes,
)
from jaxmpc.qp.triton import has_kernels

# Most steps, and most of a second search.
MOST_STEPS, MORE_STEPS = 24, 100
# Distance from the optimum at which the steps end, relative to the largest row.
CONVERGED = 1e-11


@pytree
class DualSearch:
    """Loop state of one instance: its point, the steps taken, whether to go on, and whether its
    multipliers are optimal."""

    point: DualPoint
    steps: Array
    open: Array
    optimal: Array


def dual_search(
    dual: Dual, cold: DualPoint, point: DualPoint, go_on: Array, steps: MostSteps
) -> tuple[DualPoint, Array]:
    """Return the point after steps on the dual, and whether it is optimal.

    Where `steps.first` do not get there, multipliers exceed the limit, or rows that join singly are
    too many for W, it begins once more from `cold`, the point without multipliers, with rows that
    join singly."""
    if has_kernels(len(dual.S)):
        return dual_search_kernel(dual, cold, point, jnp.int32(0), go_on, steps)
    state = DualSearch(point, jnp.int32(0), go_on, jnp.asarray(False))
    end = repeat_while(lambda s: s.open, partial(_search_step, steps), (dual, cold), state)
    return end.point, end.optimal


def single_step(dual: Dual, point: DualPoint) -> DualPoint:
    """Return the point after one step, in which rows join singly."""
    true = jnp.asarray(True)
    if has_kernels(len(dual.S)):
        one = MostSteps(JOINTLY + 1, 0)
        return dual_search_kernel(dual, point, point, jnp.int32(JOINTLY), true, one)[0]
    return dual_step(dual, point, true)[0]


def _search_step(steps: MostSteps, constants: tuple[Dual, DualPoint], s: DualSearch) -> DualSearch:
    dual, cold = constants
    again = s.steps == steps.first
    point = jax.tree.map(lambda old, new: jnp.where(again, new, old), s.point, cold)
    point, fits = dual_step(dual, point, again | (s.steps >= JOINTLY))
    largest = [jnp.max(v, initial=0.0) for v in sizes(dual.bounds, point.y, point.v)]
    after = after_step(largest, CONVERGED, dual.limit, s.steps + 1, fits, steps)
    return DualSearch(point, *after)


def has_dual_steps(balls: tuple[int, ...], A: Array) -> bool:
    """Return whether there can be steps on the dual: there are rows, and no balls."""
    return not balls and len(A) > 0
