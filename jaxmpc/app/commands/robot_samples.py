"""Random initial states, and random deviations of the plants from the model."""

import jax
import numpy as np

from jaxmpc.robots.robot import Robot


def draw_robots(
    robot: Robot, count: int, seed: int, *, spread: float, mass: float = 0.0,
    damping: float = 0.0, payload: float = 0.0,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:  # fmt: skip
    """Draw starts (count, nq + nv) and the factors by which each plant differs from the model.

    spread: largest fraction of the way from home to the limits. mass, damping: factors are from
    1 − this to 1 + this; payload: masses in kg are from 0 to this. The dictionary has those that
    are not zero: "mass" (count, bodies), "damping" (count, nv), "payload" (count,).
    """
    starts, masses, dampings, loads = np.random.default_rng(seed).spawn(4)
    with jax.enable_x64(True):
        home = np.asarray(robot.coordinates(np.asarray(robot.home)))
        lower, upper = (
            np.where(np.isfinite(end), np.abs(end - home), 1.0)
            for end in (np.asarray(robot.state_limits.lower), robot.state_limits.upper)
        )
        aside = spread * starts.uniform(-1, 1, (count, robot.n))
        xi = home + np.where(aside > 0, upper, lower) * aside
        x0s = np.asarray(jax.vmap(robot.state)(xi))
    found = {}
    for name, most, random, size in (
        ("mass", mass, masses, robot.mujoco.nbody),
        ("damping", damping, dampings, robot.mujoco.nv),
    ):
        if most:
            found[name] = random.uniform(1 - most, 1 + most, (count, size))
    if payload:
        found["payload"] = loads.uniform(0, payload, count)
    return x0s, found


def plant_numbers(robot: Robot, variations: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the arguments of `Robot.vary` for these factors."""
    model, found = robot.mujoco, {}
    if "mass" in variations:
        factor = variations["mass"]
        found = {
            "body_mass": factor * model.body_mass,
            "body_inertia": factor[..., None] * model.body_inertia,
        }
    if "damping" in variations:
        found["dof_damping"] = variations["damping"] * model.dof_damping
    if "payload" in variations:
        found["payload"] = variations["payload"]
    return found
