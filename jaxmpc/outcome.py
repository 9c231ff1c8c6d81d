"""What closed loops came to: limits kept, target reached, when and at what cost."""

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from jaxmpc.checks import fail, require_finite, require_shape
from jaxmpc.closed_loop import Run
from jaxmpc.control.sets import Box
from jaxmpc.control.system import host_array
from jaxmpc.qp.status import Status

# A limit counts as kept where it is exceeded by at most this, in its unit; of the limit's size,
# where that is above 1 (float32 holds 150 N m only to 1e-5).
KEPT = 1e-6


@dataclass(frozen=True)
class Outcome:
    """B closed loops of T samples judged from their states and inputs, in float64 on the host.

    coordinates (B, T+1, n): the states as limits mean them. state_excess (B, T+1, n),
    input_excess (B, T, m): by how much each lies beyond its limits, in its unit; 0 inside; NaN
    where the run is not finite. band (n,): how near the target counts as there. Then (B,) each:
      kept       all limits of states and inputs at all samples, to 1e-6 (of the limit, if above 1)
      reached    the last state is within the band of the target, in every coordinate
      settling   time (s) from which on every coordinate stays within the band; inf: never
      cost       sum of the stage costs
      promised   every plan was SOLVED and kept its limits along its horizon (no fallback)
    """

    coordinates: np.ndarray
    state_excess: np.ndarray
    input_excess: np.ndarray
    band: np.ndarray
    kept: np.ndarray
    reached: np.ndarray
    settling: np.ndarray
    cost: np.ndarray
    promised: np.ndarray

    @property
    def success(self) -> np.ndarray:
        """Limits kept and target reached (B,)."""
        return self.kept & self.reached


def judge(run: Run, plant: Any, reference: Any, *, tolerance: float = 0.02) -> Outcome:
    """The outcome of closed loops that were to rest at `reference`.

    run: of `simulate` or `simulate_many`, with or without a batch axis. plant: the Robot or
    LinearPlant whose limits count, without margin. reference (n,): the set-point, in coordinates.
    tolerance: the band, as a share of each coordinate's `Box.half_widths`. Raises ValueError for
    other shapes.
    """
    run = batch_of(run)
    require_shape("reference", reference, (plant.n,), "The set-point, in coordinates")
    require_finite("reference", reference)
    if not tolerance > 0:
        fail("tolerance", f"{tolerance}", "Give a positive share")
    xi, inputs = coordinates(plant, run.states), np.asarray(run.inputs, float)
    band = tolerance * plant.state_limits.half_widths()
    excesses, kept = [], np.ones(len(xi), bool)
    for value, limits in ((xi, plant.state_limits), (inputs, plant.input_limits)):
        excess, within = beyond(value, limits)
        excesses.append(excess)
        kept &= within.all(axis=(1, 2))
    inside = (np.abs(xi - host_array("reference", reference)) <= band).all(axis=2)
    # Samples before the last run of samples inside: T + 1 less the length of that run.
    before = inside.shape[1] - np.cumprod(inside[:, ::-1], axis=1).sum(axis=1)
    status, fallback = np.asarray(run.status), np.asarray(run.fallback)
    return Outcome(
        coordinates=xi, state_excess=excesses[0], input_excess=excesses[1], band=band, kept=kept,
        reached=inside[:, -1], settling=np.where(inside[:, -1], before * plant.dt, np.inf),
        cost=np.asarray(run.stage_cost, float).sum(axis=1),
        promised=((status == Status.SOLVED) & ~fallback).all(axis=1),
    )  # fmt: skip


def coordinates(plant: Any, states: Any) -> np.ndarray:
    """Coordinates (..., n) of plant states (..., nq + nv), in float64."""
    states = np.asarray(states, float)
    if plant.n == plant.state_size:  # no orientation: the same numbers
        return states
    with jax.enable_x64(True):
        flat = jax.vmap(plant.coordinates)(states.reshape(-1, states.shape[-1]))
    return np.asarray(flat).reshape(*states.shape[:-1], plant.n)


def batch_of(run: Run) -> Run:
    """The run on the host, with a batch axis."""
    run = jax.tree.map(np.asarray, run)
    return run if run.states.ndim == 3 else jax.tree.map(lambda v: v[None], run)


def beyond(value: np.ndarray, limits: Box) -> tuple[np.ndarray, np.ndarray]:
    """By how much values (..., k) lie beyond limits of size k, and whether `KEPT` allows that."""
    lower, upper = np.asarray(limits.lower, float), np.asarray(limits.upper, float)
    above, below = value - upper, lower - value
    size = lambda end: KEPT * np.maximum(1.0, np.abs(np.where(np.isfinite(end), end, 0.0)))
    within = (above <= size(upper)) & (below <= size(lower))  # False for NaN
    return np.maximum(np.maximum(above, below), 0.0), within
