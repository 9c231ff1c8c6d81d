"""Random initial states, and random deviations of the plants from the model."""

import jax
import numpy as np

from jaxmpc.closed_loop.environment import start_room
from jaxmpc.closed_loop.variations import draw_factors, plant_numbers
from jaxmpc.robots.robot import Robot

__all__ = ["draw_robots", "plant_numbers"]


def draw_robots(
    robot: Robot, count: int, seed: int, *, spread: float, mass: float = 0.0,
    damping: float = 0.0, payload: float = 0.0,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:  # fmt: skip
    """Draw starts (count, nq + nv) and the factors by which each plant differs from the model.

    spread: largest fraction of the way from home to the limits. mass, damping: factors are from
    1 − this to 1 + this; payload: masses in kg are from 0 to this. The dictionary has those that
    are not zero: "mass" (count, bodies), "damping" (count, nv), "payload" (count,).
    """
    starts = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0,)))
    home, below, above = start_room(robot)
    aside = spread * starts.uniform(-1, 1, (count, robot.n))
    with jax.enable_x64(True):
        x0s = np.asarray(jax.vmap(robot.state)(home + np.where(aside > 0, above, below) * aside))
    ranges = {"mass": (1 - mass, 1 + mass), "damping": (1 - damping, 1 + damping)}
    ranges = {name: range_ for name, range_ in ranges.items() if range_[1] > 1}
    if payload:
        ranges["payload"] = (0, payload)
    return x0s, draw_factors(robot, count, seed, ranges)
