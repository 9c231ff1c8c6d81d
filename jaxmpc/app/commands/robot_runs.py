"""Closed loops of many robots, simulated chunk by chunk into a store."""

import dataclasses
import importlib
import os
import time
import warnings
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from tqdm.std import tqdm

from jaxmpc import store
from jaxmpc.app.commands.compiling import Compiling
from jaxmpc.app.commands.film import choose_renderer
from jaxmpc.app.commands.options import Timing
from jaxmpc.app.commands.robot_samples import draw_robots, plant_numbers
from jaxmpc.app.config import load_robot_config
from jaxmpc.batches import Compiled, first_rows, padded
from jaxmpc.checks import fail, require_disk, require_memory, require_package
from jaxmpc.closed_loop.linear_feedback import LinearFeedback
from jaxmpc.closed_loop.many import simulate_many
from jaxmpc.closed_loop.robot_controller import RobotController
from jaxmpc.closed_loop.robot_problem import robot_mpc
from jaxmpc.closed_loop.run import Run
from jaxmpc.files import check_results, open_folder, remove_files
from jaxmpc.mpc.condense import condensed_bytes
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.status import Status
from jaxmpc.robots.load import load_robot, model_hash
from jaxmpc.robots.robot import Robot
from jaxmpc.store import report_damage
from jaxmpc.systems.riccati import lqr

if TYPE_CHECKING:
    from jaxmpc.app.commands.simulate import Simulate


@dataclasses.dataclass(frozen=True)
class RobotRuns:
    """Runs whose options are checked and whose store is open; no loop is compiled yet.

    command: the options, all with values. reference (n,), input_reference (m,): the target,
    at rest. steps: samples of a run. starts (B, nq + nv). variations: factors of each plant, as
    `draw_robots` returns them. kept: the store. compiling: the wait for the compiler.
    """

    command: "Simulate"
    robot: Robot
    controller: Any
    reference: np.ndarray
    input_reference: np.ndarray
    steps: int
    starts: np.ndarray
    variations: dict[str, np.ndarray]
    kept: store.Store
    compiling: Compiling

    @classmethod
    def open(cls, command: "Simulate") -> "RobotRuns":
        """Open new runs, or some to resume. Raises ValueError; compiles no loop."""
        path = command.output / "runs.zarr"
        check_results(path, command.resume, command.overwrite)
        if command.video:
            choose_renderer()
        require_package("mujoco", "robots")
        try:
            importlib.import_module("mujoco")
        except (AttributeError, ImportError, RuntimeError) as error:
            problem = f"mujoco does not start with {os.environ.get('MUJOCO_GL')!r} ({error})"
            fail("MUJOCO_GL", problem, "Unset it, or install the OpenGL library that it names")
        robot = load_robot(command.robot)
        sizes = (
            ("--target", command.target, robot.mujoco.nq),
            ("--state-weights", command.state_weights, robot.n),
            ("--input-weights", command.input_weights, robot.m),
        )
        for name, given, size in sizes:
            if given is not None and len(given) != size:
                fail(name, f"has {len(given)} numbers", f"{robot.name} needs {size}")
        require_sizes(command, robot)
        steps = max(1, round(command.seconds / robot.dt))
        each = 256 if jax.default_backend() == "cpu" else 4096
        chunk = command.chunk or (command.devices or 1) * each
        target = None if command.target is None else np.array(command.target)
        file: dict[str, Any] = {}
        if command.config is not None:
            file = load_robot_config(command.config).weights(robot)
        options = {"Q": command.state_weights, "R": command.input_weights}
        file |= {key: np.array(value) for key, value in options.items() if value is not None}
        more = {"terminal_cost": file["terminal_cost"]} if "terminal_cost" in file else {}
        horizon: Any = command.horizon
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # robot_mpc says the same
            x, input_reference = robot.set_point(target)
        # The steps from here on compile programs.
        programs = {name: getattr(command, name) for name in PROGRAM}
        programs |= {"steps": steps, "chunk": min(chunk, command.count)}
        compiling = Compiling.announce(robot, "loops", programs)
        mpc = robot_mpc(
            robot, file.get("Q"), file.get("R"), horizon, target=target,
            margin=command.margin or 0.0, **more,
        )  # fmt: skip
        controller: Any
        with jax.enable_x64(command.dtype == "float64"):
            if command.linearize == "lqr":
                controller = LinearFeedback(mpc, lqr(mpc.system, mpc.Q, mpc.R).K, robot)
            else:
                solver = ADMM(iterations=command.iterations, newton_steps=command.newton_steps)
                controller = RobotController(
                    robot, mpc, solver, linearize=str(command.linearize), rho=command.rho
                )
        with jax.enable_x64(True):
            reference = np.asarray(robot.coordinates(x))
        starts, variations = draw_robots(
            robot, command.count, command.seed, spread=command.spread, mass=command.mass,
            damping=command.damping, payload=command.payload,
        )  # fmt: skip
        if variations:
            robot.vary(**{key: value[0] for key, value in plant_numbers(robot, variations).items()})
        open_folder(command.output)
        old = "summary.json", "runs.png", "robots.gif"
        sample = store.Constant(np.arange(len(starts)), ("sample",), {"long_name": "robot"})
        points = store.Constant(starts, ("sample", "state"), {"long_name": "initial state"})
        kept = store.Store(
            path, {"sample": sample}, _run_fields(command, robot, steps),
            _decisive(command, robot, mpc), chunk, constants={"points": points},
            overwrite=command.overwrite, begun=lambda: remove_files(command.output, *old),
        )  # fmt: skip
        report_damage(kept)
        return cls(
            command, robot, controller, reference, input_reference, steps, starts, variations, kept,
            compiling,
        )  # fmt: skip

    def simulate(self) -> Timing:
        """Run the chunks that are not done, and commit each."""
        todo, timing = self.kept.pending(), Timing()
        slices = [self.kept.rows(k) for k in todo]
        size = self.kept.rows(0).stop
        total = sum(rows.stop - rows.start for rows in slices)
        with tqdm(total=total, unit=" robots", disable=None) as bar:
            for index, rows in zip(todo, slices, strict=True):
                factors = {key: value[rows] for key, value in self.variations.items()}
                numbers = plant_numbers(self.robot, factors)
                begun, compiled = time.perf_counter(), Compiled.seconds
                precision = jax.enable_x64(self.command.dtype == "float64")
                with precision, self.compiling.followed(programs=1):
                    run = simulate_many(
                        self.controller, self.robot, padded(self.starts[rows], size), self.steps,
                        reference=self.reference, input_reference=self.input_reference,
                        variations={key: padded(value, size) for key, value in numbers.items()},
                        devices=self.command.devices,
                    )  # fmt: skip
                self.compiling.over()
                compiling = Compiled.seconds - compiled
                count = rows.stop - rows.start
                timing.compile_seconds += compiling
                timing.run_seconds += time.perf_counter() - begun - compiling
                timing.count += count
                run = first_rows(run, count)
                results = {name: getattr(run, name) for name in STORED}
                self.kept.commit(index, **results, **factors)
                bar.update(count)
        return timing

    def load(self) -> Run:
        """Return the runs in the store, as NumPy arrays."""
        data: dict[str, Any] = {name: self.kept.read(name) for name in STORED}
        # x_0 is measured and no limit binds it, so that there is no soft row at k = 0.
        return Run(**data | {"slack": np.zeros((*data["status"].shape, 0))})


def require_sizes(command: "Simulate", robot: Robot) -> None:
    """Raise ValueError where the runs, or the condensed problem, do not fit into memory."""
    samples, n, m = command.seconds / robot.dt, robot.n, robot.m
    each = np.dtype(command.dtype).itemsize * (robot.state_size + m + 3) + 2
    needed = command.count * samples * each
    require_memory("--count, --seconds", needed, "Simulate fewer robots, or for less time")
    # Trajectories hardly compress; the files are seldom a quarter of the arrays.
    folder = command.output
    require_disk(f"--output {folder}", needed / 4, folder, "Simulate less, or use another disk")
    horizon: Any = command.horizon
    require_memory("--horizon", condensed_bytes(horizon, n, m, None, n + m), "Give fewer steps")


# Options that change the compiled programs.
PROGRAM = ("horizon", "linearize", "iterations", "newton_steps", "dtype", "devices")
# The fields of `Run` that the store keeps: no robot here has an observer.
STORED = tuple(
    field.name for field in dataclasses.fields(Run) if field.name not in ("slack", "estimates")
)


def _run_fields(command: "Simulate", robot: Robot, steps: int) -> dict[str, store.Field]:
    """Return the fields that the store has of each robot."""
    number = lambda shape, *axes: store.Field(shape, command.dtype, np.nan, axes)
    found = {
        "states": number((steps + 1, robot.state_size), "sample_time", "state"),
        "inputs": number((steps, robot.m), "time", "input"),
        "cost": number((steps,), "time"),
        "status": store.Field((steps,), "int8", int(Status.NOT_RUN), ("time",)),
        "stage_cost": number((steps,), "time"),
        "violation": number((steps + 1,), "sample_time"),
        "fallback": store.Field((steps,), "bool", False, ("time",)),
    }
    sizes = {"mass": (robot.mujoco.nbody,), "damping": (robot.mujoco.nv,), "payload": ()}
    for name in ("mass", "damping", "payload"):
        if getattr(command, name):
            axes = (f"{name}_of",) * len(sizes[name])
            found[name] = store.Field(sizes[name], "float64", np.nan, axes)
    return found


def _decisive(command: "Simulate", robot: Robot, mpc: MPC) -> dict[str, Any]:
    """Return the options that determine the results, as JSON data."""
    irrelevant = ("output", "video", "tolerance", "resume", "overwrite", "chunk", "devices")
    options = {k: v for k, v in dataclasses.asdict(command).items() if k not in irrelevant}
    weights = {
        "state_weights": np.diag(mpc.Q).tolist(),
        "input_weights": np.diag(mpc.R).tolist(),
    }
    if command.config is None:
        del options["config"]
    else:  # what is in the file, not where it lies
        weights |= {
            name: np.asarray(value, float).tolist()
            for name, value in (("Q", mpc.Q), ("R", mpc.R), ("P", mpc.terminal_cost))
        }
        options["config"] = "tuned"
    options |= {**weights, "model": model_hash(robot)}
    return options
