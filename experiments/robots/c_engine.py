"""Robots in MJX against MuJoCo's C engine, both in float64:

a step     the largest difference of a physics step (mj_step), of the plant's own states
500        of the whole state after 500 physics steps under random inputs, the C engine alone
cold       the same, the C engine's constraint solver without its warm starts, as in MJX
A, B       linear models against mjd_transitionFD (centred, 1e-6), relative to max |A|

python experiments/robots/c_engine.py
"""

from dataclasses import dataclass

import jax
import mujoco
import numpy as np
import tyro
from jax import Array

import jaxmpc as jm
from jaxmpc.robots.physics import Physics
from jaxmpc.robots.robot import Robot


@dataclass(frozen=True)
class Settings:
    """models: by name or path. states: at which linear models are compared. stretch: width of the
    random positions in joint ranges (above 1 some stops push)."""

    models: tuple[str, ...] = ("joint", "pendulum", "cartpole", "arm2", "arm6", "arm7", "quadrotor")
    states: int = 100
    steps: int = 500
    stretch: float = 1.1
    seed: int = 0


def draw(robot: Robot, count: int, stretch: float, rng: np.random.Generator) -> np.ndarray:
    """Random states (count, nq + nv), joint speeds of 0.5 rad/s."""
    m = robot.mujoco
    q = np.tile(robot.home[: m.nq], (count, 1))
    for kind, i, ends, limited in zip(
        m.jnt_type, m.jnt_qposadr, m.jnt_range, m.jnt_limited, strict=True
    ):
        if kind in (2, 3):
            low, high = ends if limited else (-1.0, 1.0)
            q[:, i] = (low + high) / 2 + stretch * (high - low) / 2 * rng.uniform(-1, 1, count)
            continue
        i += 3 * (kind == 0)
        turn = rng.normal(size=(count, 4))
        q[:, i : i + 4] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    return np.hstack([q, 0.5 * rng.normal(size=(count, m.nv))])


def c_run(robot: Robot, x: np.ndarray, inputs: np.ndarray, warm: bool) -> np.ndarray:
    """States (T, nq + nv) after each input by mj_step."""
    m, found = robot.mujoco, []
    data = mujoco.MjData(m)
    data.qpos, data.qvel = x[: m.nq], x[m.nq :]
    for u in inputs:
        data.ctrl = u
        if not warm:
            data.qacc_warmstart = 0
        mujoco.mj_step(m, data)
        found.append(np.concatenate([data.qpos, data.qvel]))
    return np.array(found)


def mjx_run(physics: Physics, x: Array, inputs: Array) -> Array:
    """States after each input by MJX."""
    return jax.lax.scan(lambda x, u: (physics.step(x, u),) * 2, x, inputs)[1]


def c_transition(robot: Robot, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A, B by mjd_transitionFD."""
    m = robot.mujoco
    data = mujoco.MjData(m)
    data.qpos, data.qvel, data.ctrl = x[: m.nq], x[m.nq :], u
    mujoco.mj_forward(m, data)
    A, B = np.zeros((robot.n, robot.n)), np.zeros((robot.n, robot.m))
    mujoco.mjd_transitionFD(m, data, 1e-6, True, A, B, None, None)
    return A, B


def run(s: Settings) -> None:
    """Compare and print the table."""
    titles = ("a step", f"{s.steps} cold", s.steps, "A", "B", "rest A", "max |A|")
    print(f"{'':12}" + "".join(f"{title:>11}" for title in titles))
    for name in s.models:
        robot, rng = jm.load_robot(name), np.random.default_rng(s.seed)
        physics = jax.jit(robot.plant.step)

        start = draw(robot, 1, 0.5, rng)[0]
        low, high = robot.input_limits.lower, robot.input_limits.upper
        inputs = rng.uniform(low, high, (s.steps, robot.m))
        states = np.asarray(jax.jit(mjx_run, static_argnums=0)(robot.plant, start, inputs))
        cold, warm = (c_run(robot, start, inputs, w)[-1] for w in (False, True))
        own = np.vstack([start, states[:-1]])
        after = np.array([
            c_run(robot, x, u[None], False)[0] for x, u in zip(own, inputs, strict=True)
        ])  # fmt: skip
        one = np.abs(np.array([physics(x, u) for x, u in zip(own, inputs, strict=True)]) - after)

        x = draw(robot, s.states, s.stretch, rng)
        # Home, held: without a rate before and after the derivative of a rotation is easily lost.
        x = np.vstack([x, np.array(robot.home)])
        u = rng.uniform(low, high, (len(x), robot.m))
        u[-1] = robot.equilibrium()[1]
        found = map(np.asarray, jax.jit(jax.vmap(robot.transition))(x, u))
        errors, largest = [], 0.0
        for A, B, x_i, u_i in zip(*found, x, u, strict=True):
            A_c, B_c = c_transition(robot, x_i, u_i)
            scale = np.abs(A_c).max()
            errors.append([np.abs(A - A_c).max() / scale, np.abs(B - B_c).max() / scale])
            largest = max(largest, scale)
        *moving, still = np.array(errors)
        values = (
            one.max(), np.abs(states[-1] - cold).max(), np.abs(states[-1] - warm).max(),
            *np.max(moving, axis=0), still[0], largest,
        )  # fmt: skip
        print(f"{name:12}" + "".join(f"{v:11.1e}" for v in values), flush=True)


if __name__ == "__main__":
    with jax.enable_x64(True):
        run(tyro.cli(Settings, description=__doc__))
