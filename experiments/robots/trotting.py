"""Quadrupeds that trot, and are pushed at the trunk on the way.

    python experiments/robots/trotting.py [--count 16] [--seconds 4] [--push 10] [--turn 0]
        [--film FILE]

Each begins at rest and follows `jm.robots.gait` at `--speed` ahead, turning at the rate `--turn`
(rad/s): two feet stand while the other two swing. The first robot is left alone; each other one is
pushed for 0.1 s after half the time, in a horizontal direction of its own, by an impulse between
nothing and `--push` N s. A robot trots if its trunk stays above 0.15 m and within 45°. Compared
with MuJoCo's C engine: each step of the plant, and the first robot's whole run with the C engine in
the place of the plant.
"""

import argparse
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from standing import FEET, FILE, Rest, film, of_feet, pushes, upright

import jaxmpc as jm
from jaxmpc.closed_loop import GaitController

# Weights of position, orientation, joints, and their velocities; and of torques.
Q = np.repeat([100.0, 200, 400, 200, 100, 20, 1, 0.5, 0.02], [1, 1, 1, 2, 1, 12, 3, 3, 12])
R = np.full(12, 1e-3)


def on_c_engine(controller: GaitController, x: np.ndarray, steps: int) -> np.ndarray:
    """Return the states (T+1, nq + nv) of one robot whose plant is MuJoCo's C engine."""
    robot = controller.robot
    model, data = robot.mujoco, mujoco.MjData(robot.mujoco)
    data.qpos, data.qvel = np.split(x, [model.nq])
    plan, before = jax.jit(lambda c, x, b: c(x, b)), controller.start(jnp.asarray(x))
    states = [x]
    for _ in range(steps):
        before = plan(controller, jnp.asarray(states[-1]), before)
        data.ctrl = np.asarray(before.u)
        for _ in range(robot.substeps):
            mujoco.mj_step(model, data)
        states.append(np.concatenate([data.qpos, data.qvel]))
    return np.array(states)


def motion(states: np.ndarray, first: int, dt: float) -> str:
    """Return how fast the trunk moves and turns from a time step on."""
    part = states[first:]
    seconds = (len(part) - 1) * dt
    way = np.linalg.norm(np.diff(part[:, :2], axis=0), axis=1).sum()
    heading = np.unwrap(2 * np.arctan2(part[:, 6], part[:, 3]))
    return f"{way / seconds:.4f} m/s and {(heading[-1] - heading[0]) / seconds:.4f} rad/s"


def main() -> None:
    """Print how the robots trot."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--count", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--speed", type=float, default=0.5)
    parser.add_argument("--turn", type=float, default=0.0)
    parser.add_argument("--push", type=float, default=10.0)
    parser.add_argument("--film", type=Path)
    given = parser.parse_args()
    began = time.perf_counter()
    robot = jm.load_robot(FILE, control_period=0.01)
    gait = jm.robots.gait(robot, FEET, (given.speed, 0.0), turn=given.turn)
    controller = GaitController(gait, Q, R, horizon=30)
    print(f"gait and controller made in {time.perf_counter() - began:.0f} s", flush=True)
    x, _ = gait.robot.equilibrium()
    rest, rng = Rest(robot, x), np.random.default_rng(0)
    angle = rng.uniform(-np.pi, np.pi, given.count)
    size = rng.uniform(0, given.push, given.count) * (np.arange(given.count) > 0)
    impulses = size[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    steps = round(given.seconds / robot.dt)
    began = time.perf_counter()
    added = pushes(robot, rest, impulses, steps, before=given.seconds / 2)
    run = jm.simulate_many(
        controller, robot, np.tile(x, (given.count, 1)), steps, disturbances=added
    )
    print(f"simulated in {time.perf_counter() - began:.0f} s, compiling included", flush=True)
    well, half = upright(run.states), steps // 2
    print(f"{well.mean():.1%} of {given.count} trot; by impulse, N s: ", end="")
    ends = np.linspace(0, given.push, 6)
    groups = np.clip(np.digitize(size, ends) - 1, 0, 4)
    print(
        "; ".join(
            f"{ends[g]:.3g}- {well[groups == g].mean():.0%} of {np.sum(groups == g)}"
            for g in np.unique(groups)
        )
    )
    print(
        f"plans solved {np.mean(run.status == jm.Status.SOLVED):.4%}, of those that trot ", end=""
    )
    print(f"{np.mean(run.status[well] == jm.Status.SOLVED):.4%}")
    alone = run.states[0]
    tilt = 2 * np.linalg.norm(alone[:, 4:6], axis=1).max()
    aside = np.linalg.norm(alone[:, :2] - gait.reference(steps + 1)[:, :2], axis=1)
    print(f"the one left alone: {motion(alone, half, robot.dt)} in the second half, trunk ", end="")
    print(f"{alone[:, 2].min():.4f} to {alone[:, 2].max():.4f} m high, tilted ", end="")
    print(f"{np.degrees(tilt):.2f}° at most, {aside.max() * 1e3:.1f} mm from its motion")
    chosen = np.flatnonzero(well)[:16]
    normal, share, error = of_feet(robot, jax.tree.map(lambda v: v[chosen], run))
    down = normal > 1
    sliding = np.mean(share[down] > 0.999)
    print(f"feet on the ground {down.mean():.1%} of samples, of which {sliding:.2%} slide; plant ")
    print(f"against the C engine, a control period: {error.max():.2g} m, rad", flush=True)
    states = on_c_engine(controller, x, steps)
    apart = np.abs(states - alone)[:, :3].max()
    print(f"with the C engine as plant: {motion(states, half, robot.dt)}, trunk at most ", end="")
    print(f"{apart:.2g} m from the other's")
    if given.film:
        film(given.film, robot, run, size / max(given.push, 1e-9), well)


if __name__ == "__main__":
    with jax.enable_x64(True):
        main()
