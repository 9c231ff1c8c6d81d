"""`--robot` of the commands sweep and recursion: a robot's map, stored chunk by chunk."""

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from tqdm.std import tqdm

from jaxmpc import store
from jaxmpc.app.commands.compiling import Compiling
from jaxmpc.app.commands.options import check_positive
from jaxmpc.app.config.states import axis_indices, grid_ends
from jaxmpc.batches import first_rows
from jaxmpc.checks import fail
from jaxmpc.closed_loop.robot_problem import robot_mpc
from jaxmpc.feasible.map import grid
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.files import (
    check_results,
    open_folder,
    remove_files,
    versions,
    write_arrays,
    write_results,
)
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.status import Status
from jaxmpc.robot_maps.outcomes import RobotLoops
from jaxmpc.robot_maps.robot_map import RobotMap
from jaxmpc.robot_maps.set_point import deviations
from jaxmpc.robot_maps.setting import RobotSetting
from jaxmpc.robots.load import load_robot, model_hash
from jaxmpc.robots.robot import Robot
from jaxmpc.sets.any_set import translated
from jaxmpc.sets.terminal_sets import named_terminal_set
from jaxmpc.store import report_damage
from jaxmpc.systems.riccati import lqr

# Points along each of two axes; total number of points for another number of axes.
SIDE, POINTS = 32, 1024
# What the store has of each closed loop, beside the labels.
LOOPS = {
    name: store.Field((), "int64", -1, (), {"long_name": text})
    for name, text in (
        ("broken_at", "sample at which the robot leaves its limits; -1: never"),
        ("lost_at", "sample at which a plan is not within the limits; -1: never"),
        ("unsolved_at", "sample at which a plan is not solved; -1: never"),
    )
} | {
    "worst": store.Field((), "float64", np.nan, (), {"long_name": "most beyond a limit"}),
    "statuses": store.Field((len(Status),), "int64", 0, ("kind",), {
        "long_name": "number of plans by status"}),
}  # fmt: skip


@dataclass(frozen=True)
class RobotMapCommand:
    """What to map, from the command line; None for options that are not given.

    claim: as in `map_robot`, and so is search_seconds. axes: names or indices of coordinates;
    values: of the other coordinates, in their order. settings: iterations and dtype of the linear
    labels.
    """

    robot: str
    output: Path
    claim: str
    steps: int | None = None
    seconds: float | None = None
    horizon: int | None = None
    terminal: str | None = None
    axes: Sequence[str] | None = None
    values: Sequence[float] | None = None
    grid: Sequence[int] | None = None
    lower: Sequence[float] | None = None
    upper: Sequence[float] | None = None
    refine: bool = True
    search_seconds: float = 60.0
    resume: bool = False
    overwrite: bool = False
    devices: int | None = None
    settings: dict[str, Any] = field(default_factory=dict)

    def run(self) -> None:
        """Make the map, write the files, print the table. Raises ValueError before it compiles."""
        begun = time.perf_counter()
        with Compiling() as wait:
            setting, config, kept = self.prepare(wait)
            with kept:
                self._run(setting, config, kept, wait, begun)

    def _run(
        self, setting: RobotSetting, config: dict[str, Any], kept: store.Store,
        wait: Compiling, begun: float,
    ) -> None:  # fmt: skip
        count = len(setting.points)
        print(
            f"{setting.robot.name}: {count:,} states, {setting.steps} samples -> {self.output}",
            flush=True,
        )
        self.label(setting, kept, wait)
        if self.claim == "recursion":
            what = "linear model: closed loops and a search for counterexamples"
            most = f"up to {self.search_seconds:g} s and compiling"
            print(f"{what}, {most}", file=sys.stderr, flush=True)
        rmap = self.map(setting, kept)
        files = self.save(setting, rmap, config)
        print(rmap)
        if rmap.recursion is not None:
            print(f"linear model, in deviations from the set-point\n{rmap.recursion}")
        print(f"  {'total':<16} {time.perf_counter() - begun:.2f} s with set-up and files")
        print(f"  {'files':<16} {' '.join(str(self.output / name) for name in files)}")

    def prepare(self, wait: Compiling) -> tuple[RobotSetting, dict[str, Any], store.Store]:
        """Return the checked setting, its configuration (JSON data) and the opened store."""
        path = self.output / "robot_map.zarr"
        check_results(path, self.resume, self.overwrite)
        robot = load_robot(self.robot)
        names = robot.state_names
        # By default the first joint, its position and velocity.
        given = self.axes or (names[0], names[robot.n // 2])
        axes = axis_indices("--axes", "coordinate", given, names, robot.n)
        along = self._along(robot, axes)
        points = grid([v[0] for v in along], [v[-1] for v in along], [len(v) for v in along])
        others = [i for i in range(robot.n) if i not in axes]
        if self.values is not None and len(self.values) != len(others):
            what = f"has {len(self.values)} entries where {len(others)} are needed"
            fail("--fixed", what, "One for each coordinate that is not on an axis")
        check_positive(self, "horizon", "steps", "seconds")
        if self.terminal == "ellipsoid":
            fail("--terminal", "ellipsoid: a robot's limits are soft rows", "Give invariant or box")
        seconds = 2.0 if self.seconds is None else self.seconds
        if self.steps is not None:
            seconds = self.steps * robot.dt
        # The steps from here on compile programs.
        wait.begin(f"closed loops of {robot.name}")
        fixed = _home_coordinates(robot)
        fixed[others] = fixed[others] if self.values is None else self.values
        mpc = default_mpc(robot, self.horizon or 20, self.terminal or "none")
        setting = RobotSetting.of(
            robot, mpc, points, seconds, axes=axes, fixed=fixed, claim=self.claim
        )
        config = {
            "robot": self.robot,
            "claim": self.claim,
            "samples": setting.steps,
            "horizon": mpc.horizon,
            "terminal": self.terminal or "none",
            "axes": [robot.state_names[i] for i in setting.axes],
            "fixed": {robot.state_names[i]: float(fixed[i]) for i in others},
            "lower": setting.points.min(axis=0).tolist(),
            "upper": setting.points.max(axis=0).tolist(),
            "Q": np.diag(mpc.Q).tolist(),
            "R": np.diag(mpc.R).tolist(),
            "model": model_hash(robot),
            "home": np.asarray(robot.home).tolist(),
            "period": robot.dt,
            **self.settings,
        }
        open_folder(self.output)
        old = "robot_map.npz", "robot_map.png", "summary.json"
        kept = store.open_labels(
            path, setting.problem, along, config, setting.chunk(None), LOOPS,
            overwrite=self.overwrite, begun=lambda: remove_files(self.output, *old),
        )  # fmt: skip
        report_damage(kept)
        return setting, config, kept

    def _along(self, robot: Robot, axes: tuple[int, ...]) -> list[np.ndarray]:
        """Return the coordinates of the grid along each axis. Raises ValueError for options of
        other sizes."""
        d = len(axes)
        shape = tuple(self.grid or ((SIDE, SIDE) if d == 2 else (int(POINTS ** (1 / d)),) * d))
        for name, value in (("grid", shape), ("lower", self.lower), ("upper", self.upper)):
            if value is not None and len(value) != d:
                what = f"has {len(value)} entries where {d} are needed"
                fail(f"--{name}", what, "One for each axis")
        box = robot.state_limits
        limits = lambda: tuple(np.asarray(end)[list(axes)] for end in (box.lower, box.upper))
        ends = grid_ends("--", self.lower, self.upper, limits)
        return [np.linspace(*line) for line in zip(*ends, shape, strict=True)]

    def label(self, setting: RobotSetting, kept: store.Store, wait: Compiling) -> None:
        """Label the blocks that are not done, and commit each; the first one compiles."""
        todo, index = kept.batches()
        if not todo:
            return
        total = sum(here.stop - here.start for _, here in todo)
        chunks = setting.chunks(
            index.ravel(), chunk=index.shape[1], devices=self.devices, **self.settings
        )
        with tqdm(total=total, unit=" loops", disable=None) as bar:
            for (block, here), (_, labels, loops) in zip(todo, chunks, strict=True):
                wait.end()
                count = here.stop - here.start
                looped = first_rows(vars(loops), count)
                kept.commit(block, **store.label_rows(labels.first(count)), **looped)
                bar.update(count)

    def map(self, setting: RobotSetting, kept: store.Store) -> RobotMap:
        """Return the map that the store holds."""
        loops = RobotLoops(**{f.name: kept.read(f.name) for f in fields(RobotLoops)})
        gap = 1e-6 if self.refine and len(setting.axes) <= 3 else None
        return setting.map(kept.labels(), [loops], gap=gap, search_seconds=self.search_seconds)

    def save(self, setting: RobotSetting, rmap: RobotMap, config: dict[str, Any]) -> list[str]:
        """Write the files and return their names."""
        loops = vars(rmap.loops)
        arrays = {
            "points": rmap.x0s, "states": setting.states(rmap.x0s),
            "promised": rmap.promised, "held": rmap.held, "kept": rmap.kept,
            "recursive": rmap.recursive, "feasible": rmap.linear.label,
            "depth": rmap.depth, **loops,
        }  # fmt: skip
        write_arrays(self.output / "robot_map.npz", **arrays)
        low, high = rmap.linear.volume_bounds()
        worst = rmap.worst()
        summary: dict[str, Any] = {
            "name": rmap.robot.name,
            "claim": rmap.claim,
            "counts": rmap.counts(),
            "broken": int(np.sum(rmap.broken)),
            "broken_after_an_unsolved_plan": int(np.sum(rmap.unsure)),
            "deepest_broken": None if worst is None else {
                "state": setting.states(rmap.x0s)[worst].tolist(),
                "sample": int(rmap.first_loss[worst]),
                "beyond": rmap.loops.worst[worst],
            },
            "linear": {"counts": rmap.linear.counts(), "volume": [low, high]},
            "plans": rmap.plan_counts(),
            "seconds": rmap.seconds,
            "precision": setting.dtype,
            "config": config,
            "versions": versions(),
        }  # fmt: skip
        if rmap.recursion is not None:
            report = rmap.recursion
            summary["linear"]["recursion"] = {
                name: str(getattr(report, name)) for name in ("strong", "law", "weak")
            } | {"counts": report.counts()}
        write_results(self.output / "summary.json", summary)
        if rmap.x0s.shape[1] != 2:
            return ["summary.json", "robot_map.npz"]
        from jaxmpc.app.plots.robot_map import plot_robot_map
        from jaxmpc.app.plots.style import save

        save(plot_robot_map(rmap).figure, self.output / "robot_map.png")
        return ["summary.json", "robot_map.npz", "robot_map.png"]


def problem_again(config: Mapping[str, Any], points: np.ndarray) -> FeasibilityProblem:
    """Build the problem of a map of points (B, d) from its stored configuration alone. Raises
    ValueError, KeyError or TypeError for one that makes none."""
    robot = load_robot(config["robot"])
    names, fixed = robot.state_names, _home_coordinates(robot)
    for name, value in config["fixed"].items():
        fixed[names.index(name)] = value
    axes = tuple(names.index(name) for name in config["axes"])
    mpc = default_mpc(robot, config["horizon"], config["terminal"])
    seconds = config["samples"] * robot.dt
    return RobotSetting.of(
        robot, mpc, points, seconds, axes=axes, fixed=fixed, claim=config["claim"]
    ).problem


def default_mpc(robot: Robot, horizon: int, terminal: str = "none") -> MPC:
    """Return the MPC of `robot_mpc` with the terminal set "none", "box" or "invariant"."""
    mpc = robot_mpc(robot, horizon=horizon)
    if terminal != "invariant":
        return replace(
            mpc, terminal_set=named_terminal_set(terminal, mpc.system, None, mpc.states, None)
        )
    x, (_, u) = _home_coordinates(robot), robot.equilibrium()
    about = deviations(mpc, x, u)
    # At the set-point c is rounding.
    system = replace(about.system, c=None)
    regulator = lqr(system, mpc.Q, mpc.R)
    found = named_terminal_set(terminal, system, regulator, about.states, about.inputs)
    return replace(mpc, terminal_set=translated(found, x))


def _home_coordinates(robot: Robot) -> np.ndarray:
    """Return the coordinates of `robot.home`."""
    with jax.enable_x64(True):
        return np.array(robot.coordinates(np.asarray(robot.home)), np.float64)
