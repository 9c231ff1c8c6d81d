"""The command `jaxmpc simulate`."""

import dataclasses
import importlib
import os
import sys
from ctypes.util import find_library
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxmpc.app import config as configs
from jaxmpc.app.commands.compile_notice import Compiling
from jaxmpc.app.commands.simulate_problem import LinearLoops, simulate_problem
from jaxmpc.app.options.shared import (
    arguments,
    given_options,
    print_table,
    require_lengths,
)
from jaxmpc.app.options.simulate import SimulateOptions
from jaxmpc.batches import chosen_devices
from jaxmpc.checks import fail, require_disk, require_memory, require_package
from jaxmpc.closed_loop.feedback import LinearFeedback
from jaxmpc.closed_loop.outcome import summarise_runs
from jaxmpc.closed_loop.robot_controller import RobotController, robot_mpc, robot_references
from jaxmpc.closed_loop.simulation import Run
from jaxmpc.closed_loop.stored_runs import simulate_into
from jaxmpc.closed_loop.variations import draw_robots
from jaxmpc.files import as_json, check_results, open_folder, remove_files, write_json
from jaxmpc.mpc.condense import condensed_bytes
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.jax_transformations import default_platform
from jaxmpc.robots.film import render, save_video
from jaxmpc.robots.load import load_robot, model_hash
from jaxmpc.robots.robot import Robot
from jaxmpc.systems.riccati import lqr

FILES = ("summary.json", "runs.png", "robots.gif")
# Options that go with a problem file.
LINEAR = "config count seconds spread seed horizon disturbance output overwrite".split()
# Defaults of options that --config can give too.
USUAL = {"seconds": 2.0, "horizon": 20, "margin": 0.02, "linearize": "state", "rho": 1e4}
# Seconds between frames of the video.
FRAME = 0.04


class Simulate(SimulateOptions):
    """The command: its options, and `run`."""

    def run(self) -> None:
        """Simulate all robots, write the files, print the table.

        Raises ValueError for options and files that make no sense.
        """
        if self.config is not None and configs.holds_system(self.config):
            self.of_problem()
            return
        if self.disturbance is not None:
            cure = "Give --config FILE with the sections [system] and [disturbance]"
            fail("--disturbance", "given for a robot", cure)
        chosen_devices(self.devices, "--devices")
        command = self.settled()
        path = self.output / "runs.zarr"
        check_results(path, self.resume, self.overwrite)
        robot = command.robot_of_file()
        command.require_sizes(robot)
        file = {} if self.config is None else configs.load_robot_config(self.config).weights(robot)
        target = None if self.target is None else np.array(self.target)
        reference, input_reference = robot_references(robot, target)
        seconds: Any = command.seconds
        steps = max(1, round(seconds / robot.dt))
        each = 256 if default_platform() == "cpu" else 4096
        chunk = self.chunk or (self.devices or 1) * each
        open_folder(self.output)
        with Compiling(f"closed loops of {robot.name}", programs=1):
            mpc = command.problem(robot, target, file)
            starts, factors = draw_robots(robot, **arguments(self, draw_robots, leave=("robot",)))
            length = f"{seconds:g} {robot.time_unit}"
            print(f"{robot.name}: {self.count:,} robots for {length} -> {self.output}")
            with jax.enable_x64(self.dtype == "float64"):
                runs = simulate_into(
                    path,
                    command.controller(robot, mpc),
                    robot,
                    starts,
                    steps,
                    reference=reference,
                    input_reference=input_reference,
                    factors=factors,
                    settings=command.settings(robot, mpc),
                    chunk=chunk,
                    progress=True,
                    begun=lambda: remove_files(self.output, *FILES),
                    **arguments(self, simulate_into, leave=("robot", "chunk")),
                )
        summary = summarise_runs(runs, robot, reference, input_reference, tolerance=self.tolerance)
        write_json(self.output / "summary.json", summary.data)
        files = ["runs.zarr", *self.draw(runs.run, robot, reference, input_reference)]
        rows = [*summary.rows(), ("files", " ".join(str(self.output / name) for name in files))]
        print_table(rows, 13)

    def of_problem(self) -> None:
        """Simulate a problem file. Raises ValueError for options that are for robots."""
        for field in dataclasses.fields(self):
            if field.name not in LINEAR and getattr(self, field.name) != field.default:
                name = f"--{field.name.replace('_', '-')}"
                fail(name, "given beside a problem file", "It is for robots: leave it out")
        config = configs.load(self.config, given_options(self, "horizon"), "simulate")
        given = self.count, self.seconds, self.spread, self.seed, self.disturbance
        simulate_problem(LinearLoops(config, *given), self.output, self.overwrite)

    def draw(
        self, run: Run, robot: Robot, reference: np.ndarray, input_reference: np.ndarray
    ) -> list[str]:
        """Write picture and video, and return the names of the files beside the runs."""
        from jaxmpc.app.plots.closed_loops import plot_runs
        from jaxmpc.app.plots.style import save

        figure = plot_runs(run, robot, reference=reference, input_reference=input_reference)
        save(figure, self.output / "runs.png")
        video = self.output / "robots.gif"
        filmed = self.video and film(robot, run, reference, self.video, video)
        return [*FILES[:2], *(["robots.gif"] if filmed else [])]

    def robot_of_file(self) -> Robot:
        """Return the robot; raise ValueError where options do not fit it."""
        if self.video:
            choose_renderer()
        require_package("mujoco", "robots")
        try:
            importlib.import_module("mujoco")
        except (AttributeError, ImportError, RuntimeError) as error:
            problem = f"mujoco does not start with {os.environ.get('MUJOCO_GL')!r} ({error})"
            fail("MUJOCO_GL", problem, "Unset it, or install the OpenGL library that it names")
        robot = load_robot(self.robot)
        lengths = {"target": robot.mujoco.nq, "state_weights": robot.n, "input_weights": robot.m}
        require_lengths(self, robot.name, **lengths)
        return robot

    def require_sizes(self, robot: Robot) -> None:
        """Raise ValueError where the runs, or the condensed problem, do not fit into memory."""
        seconds: Any = self.seconds
        samples, n, m = seconds / robot.dt, robot.n, robot.m
        each = np.dtype(self.dtype).itemsize * (robot.state_size + m + 3) + 2
        needed, folder, horizon = self.count * samples * each, self.output, self.horizon
        require_memory("--count, --seconds", needed, "Simulate fewer robots, or for less time")
        # Trajectories hardly compress; the files are seldom a quarter of the arrays.
        require_disk(f"--output {folder}", needed / 4, folder, "Simulate less, or use another disk")
        assert horizon is not None
        require_memory("--horizon", condensed_bytes(horizon, n, m, None, n + m), "Give fewer steps")

    def problem(self, robot: Robot, target: np.ndarray | None, file: dict[str, Any]) -> MPC:
        """Return the problem: weights of options before those of the file."""
        given = file | {"horizon": self.horizon, "margin": self.margin, "target": target}
        for name, diagonal in (("Q", self.state_weights), ("R", self.input_weights)):
            if diagonal is not None:
                given[name] = np.array(diagonal)
        return robot_mpc(robot, **given)

    def controller(self, robot: Robot, mpc: MPC) -> RobotController | LinearFeedback:
        """Return the controller of --linearize."""
        if self.linearize == "lqr":
            return LinearFeedback(mpc, lqr(mpc.system, mpc.Q, mpc.R).K, robot)
        solver = ADMM(iterations=self.iterations, newton_steps=self.newton_steps)
        assert self.linearize is not None and self.rho is not None
        return RobotController(robot, mpc, solver, linearize=self.linearize, rho=self.rho)

    def settings(self, robot: Robot, mpc: MPC) -> dict[str, Any]:
        """Return the options that determine the results, as JSON data."""
        irrelevant = "output video tolerance resume overwrite chunk devices disturbance".split()
        options = {k: v for k, v in dataclasses.asdict(self).items() if k not in irrelevant}
        options |= {"state_weights": np.diag(mpc.Q), "input_weights": np.diag(mpc.R)}
        if self.config is None:
            del options["config"]
        else:  # what is in the file, not where it lies
            options |= {"config": "tuned", "Q": mpc.Q, "R": mpc.R, "P": mpc.terminal_cost}
        # The model itself, not where its file lies.
        return as_json(options | {"robot": robot.name, "model": model_hash(robot)})

    def settled(self) -> "Simulate":
        """Return the command with the values of --config or `USUAL` for options not given."""
        found: dict[str, Any] = dict(USUAL)
        if self.config is not None:
            file = configs.load_robot_config(self.config)
            robot = {name: getattr(file.robot, name) for name in ("horizon", "margin", "linearize")}
            found |= robot | {"rho": file.cost.rho}
        missing = {key: value for key, value in found.items() if getattr(self, key) is None}
        return dataclasses.replace(self, **missing)


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
