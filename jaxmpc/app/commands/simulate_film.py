"""The video of some of the robots in a simulation."""

import os
import sys
from ctypes.util import find_library
from pathlib import Path

import jax
import numpy as np

from jaxmpc.closed_loop.simulation import Run
from jaxmpc.robots.film import render, save_video
from jaxmpc.robots.robot import Robot

# Seconds between frames.
FRAME = 0.04


def film(robot: Robot, run: Run, reference: np.ndarray, count: int, path: Path) -> bool:
    """Write a video of the first robots with finite states, and of the target, `reference` (n,).

    Returns False, and prints a line on stderr, where nothing can be drawn.
    """
    finite = np.flatnonzero(np.isfinite(run.states).all(axis=(1, 2)))[:count]
    every = max(1, round(FRAME / robot.dt))
    try:
        if not len(finite):
            raise RuntimeError("no video: no robot has finite states")
        with jax.enable_x64(True):
            target = np.asarray(robot.state(reference))[: robot.mujoco.nq]
        frames = render(
            robot,
            run.states[finite],
            inputs=run.inputs[finite],
            target=target,
            every=every,
            numbers=finite.tolist(),
        )
    except RuntimeError as error:
        print(f"jaxmpc: {error}", file=sys.stderr)
        return False
    save_video(path, frames, 1 / (every * robot.dt))
    return True


def choose_renderer() -> None:
    """Let MuJoCo, where it is not imported yet, render through EGL if there is no display."""
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    late = "mujoco" in sys.modules
    if sys.platform == "linux" and not display and not late and find_library("EGL"):
        os.environ.setdefault("MUJOCO_GL", "egl")
