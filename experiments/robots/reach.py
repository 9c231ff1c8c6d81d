"""A Franka FER ("Panda", arm7) follows a figure of eight with its flange, past a ball in its way.

The tasks of the MPC are functions of MJX's data: the flange's position and orientation, and the
distances of four of the arm's capsules to the ball, which lies on the path and must not be touched.
Joint ranges, velocity limits and torques are those that the maker publishes. One quadratic program
a sample of 10 ms (real-time iteration). Printed: error of the flange where the ball is far from its
path, distances, the worst violation of any limit, the largest torques, solved plans. Written:
reach.gif (looked at) and reach.png.

    MUJOCO_GL=egl python experiments/robots/reach.py --out out
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import matplotlib.image
import mujoco
import numpy as np
import tyro

import jaxmpc as jm
from jaxmpc.mpc import Task
from jaxmpc.robots import render, save_video, tasks
from jaxmpc.robots.robot import Robot

# On the figure's upper right, in the way of the flange and, beside it, of the wrist.
BALL = np.array([0.31, 0.18, 0.71])
CAPSULES = ("forearm", "wrist", "hand", "flange")


@dataclass(frozen=True)
class Settings:
    """seconds: of motion; period: of the figure (s); size: of it (m), to each side and up; radius:
    of the ball (m); clear: distance to be kept (m). horizon: in samples of 10 ms. ball: whether
    there is one."""

    seconds: float = 6.0
    period: float = 3.0
    size: tuple[float, float] = (0.25, 0.12)
    radius: float = 0.06
    clear: float = 0.02
    horizon: int = 25
    out: Path = Path("out")


def with_ball(s: Settings) -> mujoco.MjModel:
    """Return the arm's model with a ball to look at."""
    path = Path(jm.robots.__file__).parent / "models" / "arm7.xml"
    spec = mujoco.MjSpec.from_file(str(path))
    spec.worldbody.add_geom(
        name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[s.radius, 0, 0], pos=BALL,
        contype=0, conaffinity=0, rgba=[0.85, 0.2, 0.2, 1],
    )  # fmt: skip
    return spec.compile()


def figure(s: Settings, middle: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return positions (T, 3) on the figure of eight about `middle`, from rest."""
    phase = 2 * np.pi * np.where(t < 1, t**2 / 2, t - 0.5) / s.period
    side, up = s.size
    return middle + np.stack([0 * t, side * np.sin(phase), up * np.sin(2 * phase)], axis=1)


def controller(s: Settings, robot: Robot) -> jm.RobotController:
    """Return the MPC with its tasks."""
    torque = np.asarray(robot.input_limits.upper)
    mpc = jm.robot_mpc(robot, np.repeat([0.05, 0.02], 7), 0.02 / torque**2, s.horizon,
                       terminal_cost=np.repeat([0.05, 1.0], 7))  # fmt: skip
    x, _ = robot.set_point()
    flange = tasks.position(robot, "tool")
    data = mujoco.MjData(robot.mujoco)
    data.qpos[:] = x[:7]
    mujoco.mj_forward(robot.mujoco, data)
    upright = np.zeros(4)
    mujoco.mju_mat2Quat(upright, data.site_xmat[0])
    goals = (
        Task(flange, weight=1e3, name="flange", unit="m"),
        Task(tasks.orientation(robot, "tool", upright), weight=30.0, name="turn", unit="rad"),
    )
    distances = [tasks.distance(robot, name, (BALL, s.radius)) for name in CAPSULES]
    apart = lambda data: jax.numpy.stack([each(data) for each in distances])
    away = Task(apart, lower=s.clear, rho=1e4, name="distance", unit="m")
    return jm.RobotController(robot, mpc, linearize="trajectory", tasks=(*goals, away))


def seen(robot: Robot, function: Any, states: np.ndarray) -> np.ndarray:
    """Return what a function of MJX's data gives along states (T, 14), by MuJoCo's C engine."""
    data, found = mujoco.MjData(robot.mujoco), []
    for x in states:
        data.qpos[:], data.qvel[:] = x[:7], x[7:]
        mujoco.mj_forward(robot.mujoco, data)
        found.append(np.asarray(function(data)))
    return np.array(found)


def run(s: Settings) -> None:
    """Drive the arm and print what it did."""
    robot = jm.load_robot(with_ball(s))
    law = controller(s, robot)
    x0, u0 = robot.set_point()
    steps = round(s.seconds / robot.dt)
    t = robot.dt * np.arange(steps + s.horizon)
    place = lambda data: data.site_xpos[0].copy()
    middle = seen(robot, place, x0[None])[0]
    path = figure(s, middle, t)
    # Coordinates, then targets of the tasks: flange, turn, distances (no cost: any number).
    reference = np.hstack([np.tile(x0, (len(t), 1)), path, np.zeros((len(t), 3 + len(CAPSULES)))])
    started = time.perf_counter()
    many = lambda: jm.simulate_many(
        law, robot, x0[None], steps, reference=reference, input_reference=u0
    )
    r = many()
    compiled = time.perf_counter() - started
    started = time.perf_counter()
    r = many()
    seconds = time.perf_counter() - started
    states = r.states[0, :steps]
    at = seen(robot, place, states)
    gap = np.linalg.norm(at - path[:steps], axis=1)
    with jax.enable_x64(True):
        apart = seen(robot, lambda d: np.array([f(d) for f in measured(robot, s)]), states)
    free = np.linalg.norm(path[:steps] - BALL, axis=1) > s.radius + 0.15
    torque = np.abs(r.inputs[0]) / np.asarray(robot.input_limits.upper)
    speed = np.abs(states[:, 7:]) / np.asarray(robot.state_limits.upper)[7:]
    error, touched = 1e3 * gap, 1e3 * (np.linalg.norm(path[:steps] - BALL, axis=1) - s.radius)
    fast = np.linalg.norm(np.diff(at, axis=0), axis=1).max() / robot.dt
    for name, text in (
        ("flange", f"{error[free].mean():.1f} mm off in the mean where the ball is far, "
                   f"{error[free].max():.1f} mm at most; {error.max():.0f} mm to pass the ball"),
        ("its speed", f"{fast:.2f} m/s"),
        ("distance", f"{1e3 * apart.min():.2f} mm from the ball at least, {1e3 * s.clear:g} asked "
                     f"for; that of the path: {touched.min():.0f} mm"),
        ("limits", f"worst violation {r.violation.max():.1e}; torque {torque.max():.1%}, speed "
                   f"{speed.max():.1%} of what is published"),
        ("plans", f"{np.mean(r.status == jm.Status.SOLVED):.2%} solved, "
                  f"{np.mean(r.fallback):.2%} with slack"),
        ("time", f"{seconds / steps * 1e3:.1f} ms a sample of 10 ms, compile "
                 f"{compiled - seconds:.0f} s"),
    ):  # fmt: skip
        print(f"{name:14}{text}")
    s.out.mkdir(parents=True, exist_ok=True)
    frames = render(robot, r.states[0], inputs=r.inputs[0], every=8, width=480, height=400)
    save_video(s.out / "reach.gif", frames, fps=12.5)
    matplotlib.image.imsave(s.out / "reach.png", np.hstack(frames[:: len(frames) // 4][:4]))


def measured(robot: Robot, s: Settings) -> list:
    """Return the distances of the capsules to the ball."""
    return [tasks.distance(robot, name, (BALL, s.radius)) for name in CAPSULES]


if __name__ == "__main__":
    with jax.enable_x64(True):
        run(tyro.cli(Settings, description=__doc__))
