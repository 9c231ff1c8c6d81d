"""The outcome of closed loops: limits kept, target reached, settling time, cost."""

import jax
import numpy as np
from jax import Array

from jaxmpc.arrays import Reals, host_array
from jaxmpc.checks import fail, require_finite, require_shape
from jaxmpc.closed_loop.run_record import Run
from jaxmpc.pytrees import record
from jaxmpc.qp.status import Status
from jaxmpc.robots.linear_plant import LinearPlant
from jaxmpc.robots.robot import Robot
from jaxmpc.sets.box import Box
from jaxmpc.sets.violations import kept, row_violations


@record
class Outcome:
    """What B closed loops of T time steps achieved, from their states and inputs, in float64.

    coordinates (B, T+1, n): the states in the coordinates of the limits. state_excess
    (B, T+1, n), input_excess (B, T, m): by how much each limit is violated, in its unit; 0 inside,
    NaN where the run is not finite. band (n,): largest distance that counts as at the target.
    The other fields have one entry for each loop, (B,):
      kept          all limits of states and inputs hold at all times (to `violations.TOLERANCE`)
      reached       the last state is within the band of the target, in every coordinate
      settling      time in s from which on every coordinate stays within the band; inf: never
      cost          sum of the stage costs
      plans_valid   every plan was SOLVED and kept its limits along its horizon (no fallback)
    """

    coordinates: np.ndarray
    state_excess: np.ndarray
    input_excess: np.ndarray
    band: np.ndarray
    kept: np.ndarray
    reached: np.ndarray
    settling: np.ndarray
    cost: np.ndarray
    plans_valid: np.ndarray

    @property
    def success(self) -> np.ndarray:
        """Return whether limits were kept and the target was reached, (B,)."""
        return self.kept & self.reached


def evaluate_runs(
    run: Run, plant: Robot | LinearPlant, reference: Reals, *, tolerance: float = 0.02
) -> Outcome:
    """Evaluate closed loops whose target is rest at `reference`.

    run: from `simulate` or `simulate_many`, with or without a batch axis. plant: the Robot or
    LinearPlant whose limits count, without margin. reference (n,): the set-point, in coordinates.
    tolerance: the band, as a fraction of each coordinate's `Box.half_widths`. Raises ValueError
    for other shapes.
    """
    run = run.on_host()
    require_shape("reference", reference, (plant.n,), "The set-point, in coordinates")
    require_finite("reference", reference)
    if not tolerance > 0:
        fail("tolerance", f"{tolerance}", "Give a positive fraction")
    limits = with_limits(plant, run)
    xi, band = limits[0][1], tolerance * plant.state_limits.half_widths()
    inside = (np.abs(xi - host_array("reference", reference)) <= band).all(axis=2)
    # Time steps before the last stretch inside: T + 1 less its length.
    before = inside.shape[1] - np.cumprod(inside[:, ::-1], axis=1).sum(axis=1)
    state_excess, input_excess = (row_violations(*pair) for pair in limits)
    solved = np.asarray(run.status) == Status.SOLVED
    return Outcome(
        coordinates=xi,
        state_excess=state_excess,
        input_excess=input_excess,
        band=band,
        kept=np.all([kept(*pair).all(axis=(1, 2)) for pair in limits], axis=0),
        reached=inside[:, -1],
        settling=np.where(inside[:, -1], before * plant.dt, np.inf),
        cost=np.asarray(run.stage_cost, float).sum(axis=1),
        plans_valid=(solved & ~np.asarray(run.fallback)).all(axis=1),
    )


def with_limits(plant: Robot | LinearPlant, run: Run) -> list[tuple[Box, np.ndarray]]:
    """Return (limits, values) of the states, as coordinates, and of the inputs of a run, in
    float64 NumPy arrays."""
    return [
        (Box(*plant.state_limits.bounds()), coordinates(plant, run.states)),
        (Box(*plant.input_limits.bounds()), np.asarray(run.inputs, float)),
    ]


def coordinates(plant: Robot | LinearPlant, states: Array | np.ndarray) -> np.ndarray:
    """Return the coordinates (..., n) of plant states (..., nq + nv), in float64."""
    states = np.asarray(states, float)
    if plant.n == plant.state_size:  # no orientation: the same numbers
        return states
    with jax.enable_x64(True):
        flat = jax.vmap(plant.coordinates)(states.reshape(-1, states.shape[-1]))
    return np.asarray(flat).reshape(*states.shape[:-1], plant.n)
