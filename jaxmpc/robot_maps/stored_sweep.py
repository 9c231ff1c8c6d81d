"""Sweep a grid of states of a robot into a folder, block by block, to be resumed.

robot_map.zarr   what is known of each state; what --resume goes on from
robot_map.npz    the same as arrays, and what follows from it
summary.json     counts and the configuration
"""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from jaxmpc.arrays import Reals, host_array
from jaxmpc.batches import Part, work_off
from jaxmpc.checks import fail, positive, whole
from jaxmpc.feasible.pipeline import Labels
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.stored import open_labels, stored_labels
from jaxmpc.files import (
    check_results,
    open_folder,
    remove_files,
    versions,
    write_arrays,
    write_results,
)
from jaxmpc.grids import axis_indices, grid_ends, mesh
from jaxmpc.qp.status import Status
from jaxmpc.recursion.time_budget import Budget
from jaxmpc.robot_maps.mapping import RobotSetting, mpc_with_terminal
from jaxmpc.robot_maps.robot_map import RobotLoops, RobotMap
from jaxmpc.robots.description import host_coordinates
from jaxmpc.robots.load import load_robot, model_hash
from jaxmpc.robots.robot import Robot
from jaxmpc.store import BlockWriter, Field, Store, report_damage

# Points along each of two axes; total number of points for another number of axes.
SIDE, POINTS = 32, 1024
FILES = "summary.json", "robot_map.npz", "robot_map.png"
# What the store has of each closed loop, beside the labels.
LOOPS = {
    name: Field((), "int64", -1, (), {"long_name": text})
    for name, text in (
        ("broken_at", "time step at which the robot leaves its limits; -1: never"),
        ("lost_at", "time step at which a plan is not within the limits; -1: never"),
        ("unsolved_at", "time step at which a plan is not solved; -1: never"),
    )
}
LOOPS["worst"] = Field((), "float64", np.nan, (), {"long_name": "most beyond a limit"})
LOOPS["statuses"] = Field(
    (len(Status),), "int64", 0, ("kind",), {"long_name": "number of plans by status"}
)


def sweep_robot(
    robot: str,
    folder: Path | str,
    *,
    claim: str = "limits",
    seconds: float = 2.0,
    steps: int | None = None,
    horizon: int = 20,
    terminal: str = "none",
    axes: Sequence[str | int] | None = None,
    fixed: Reals | None = None,
    grid: Sequence[int] | None = None,
    lower: Sequence[float] | None = None,
    upper: Sequence[float] | None = None,
    gap: float | None = 1e-6,
    search_seconds: float = 60.0,
    resume: bool = False,
    overwrite: bool = False,
    devices: int | None = None,
    progress: bool = False,
    **settings: Any,
) -> RobotMap:
    """Map a robot over a grid of states (`map_robot`), and keep each block in a folder when done.

    Arguments:
        robot: as in `load_robot`. folder: is made where absent.
        claim, search_seconds: as in `map_robot`; gap: likewise, for up to three axes.
        seconds: length of the closed loops; or steps: their number of time steps.
        horizon, terminal: of the MPC of `robot_mpc`; "none", "box" or "invariant" about home.
        axes: coordinates by name or index; None: position and velocity of the first joint. fixed:
            values of the other coordinates, in their order; None: those of home.
        grid: points along each axis, ends included. lower, upper: its ends; None: the limits, 3 %
            wider on each side.
        resume: go on with the map in the folder. overwrite: replace it, once there are results.
        devices: as in `map_feasible_set`. progress: say on stderr what is done.
        settings: iterations and dtype of the linear labels, as in `map_feasible_set`.

    Raises ValueError for wrong arguments before anything compiles, where there is a map and neither
    resume nor overwrite, and for another map than the one to resume.
    """
    budget = Budget.of(np.inf, progress)
    folder = Path(folder)
    path = folder / "robot_map.zarr"
    check_results(path, resume, overwrite)
    plant = load_robot(robot)
    names, n = plant.state_names, plant.n
    mapped = axis_indices("axes", "coordinate", axes or (names[0], names[n // 2]), names, n)
    along = _grid_lines(plant, mapped, grid, lower, upper)
    points = mesh(along)
    whole("horizon", horizon, 1)
    if terminal == "ellipsoid":
        fail("terminal", "ellipsoid: a robot's limits are soft rows", "Give invariant or box")
    if steps is None:
        positive("seconds", seconds)
        steps = max(1, round(float(seconds) / plant.dt))
    config = {
        "robot": robot,
        "claim": claim,
        "steps": whole("steps", steps, 1),
        "horizon": horizon,
        "terminal": terminal,
        "axes": [names[i] for i in mapped],
        "fixed": _fixed_coordinates(plant, mapped, fixed),
        "lower": [float(line[0]) for line in along],
        "upper": [float(line[-1]) for line in along],
        "model": model_hash(plant),
        "home": np.asarray(plant.home).tolist(),
        "period": plant.dt,
        **settings,
    }
    setting = _setting(plant, config, points)
    config |= {"Q": np.diag(setting.mpc.Q).tolist(), "R": np.diag(setting.mpc.R).tolist()}
    open_folder(folder)
    blocks = open_labels(
        path,
        setting.problem,
        along,
        config,
        setting.chunk(),
        LOOPS,
        overwrite=overwrite,
        begun=partial(remove_files, folder, *FILES),
    )
    report_damage(blocks)
    with blocks:
        count = f"{len(setting.x0s):,} states, {steps} time steps"
        budget.say(f"{plant.name}: {count} -> {folder}")
        _label(setting, blocks, budget, devices, settings)
        if claim == "recursion":
            budget.say("linear model: closed loops and a search for counterexamples, which compile")
        loops = RobotLoops(**{field.name: blocks.read(field.name) for field in fields(RobotLoops)})
        gap = gap if len(mapped) <= 3 else None
        found = setting.map(stored_labels(blocks), loops, gap, search_seconds)
    _save(folder, setting, found, config)
    return found


def problem_again(config: Mapping[str, Any], x0s: np.ndarray) -> FeasibilityProblem:
    """Build the problem of a map of points (B, d) from its stored configuration alone. Raises
    ValueError, KeyError or TypeError for one that makes none."""
    return _setting(load_robot(config["robot"]), config, x0s).problem


def _setting(robot: Robot, config: Mapping[str, Any], x0s: np.ndarray) -> RobotSetting:
    """Return what a configuration describes, for points (B, d)."""
    names, fixed = robot.state_names, host_coordinates(robot, robot.home).copy()
    for name, value in config["fixed"].items():
        fixed[names.index(name)] = value
    return RobotSetting.of(
        robot,
        mpc_with_terminal(robot, config["horizon"], config["terminal"]),
        x0s,
        config["steps"] * robot.dt,
        axes=tuple(names.index(name) for name in config["axes"]),
        fixed=fixed,
        claim=config["claim"],
    )


def _fixed_coordinates(
    robot: Robot, axes: tuple[int, ...], fixed: Reals | None
) -> dict[str, float]:
    """Return the values of the coordinates that are not on an axis by name; None: those of home."""
    others = [i for i in range(robot.n) if i not in axes]
    home = host_coordinates(robot, robot.home)
    values = home[others] if fixed is None else host_array("fixed", fixed)
    if values.shape != (len(others),):
        what = f"has {values.size} entries where {len(others)} are needed"
        fail("fixed", what, "One for each coordinate that is not on an axis")
    return {robot.state_names[i]: float(v) for i, v in zip(others, values, strict=True)}


def _grid_lines(
    robot: Robot,
    axes: tuple[int, ...],
    grid: Sequence[int] | None,
    lower: Sequence[float] | None,
    upper: Sequence[float] | None,
) -> list[np.ndarray]:
    """Return the coordinates of the grid along each axis. Raises ValueError for arguments of other
    sizes."""
    d = len(axes)
    shape = tuple(grid or ((SIDE, SIDE) if d == 2 else (int(POINTS ** (1 / d)),) * d))
    for name, value in (("grid", shape), ("lower", lower), ("upper", upper)):
        size = d if value is None else len(value)
        if size != d:
            fail(name, f"has {size} entries where {d} are needed", "One for each axis")
    shape = tuple(whole("grid", side, 1) for side in shape)
    box = robot.state_limits
    low, high = grid_ends(
        "", lower, upper, lambda: tuple(np.asarray(v)[list(axes)] for v in (box.lower, box.upper))
    )
    return [np.linspace(*line) for line in zip(low, high, shape, strict=True)]


def _label(
    setting: RobotSetting,
    blocks: Store,
    budget: Budget,
    devices: int | None,
    settings: dict[str, Any],
) -> None:
    """Label the blocks that are not done, and commit each."""
    pending = blocks.pending()
    if not pending:
        return
    budget.say("compiling labels and closed loops")

    def points(block: int) -> np.ndarray:
        return setting.x0s[blocks.rows(block)]

    found = setting.parts(pending, points, blocks.size, devices, **settings)
    total = sum(len(blocks.samples(block)) for block in pending)
    progress = None if budget.progress else False
    with BlockWriter(blocks) as writer:

        def put(part: Part[tuple[Labels, RobotLoops]]) -> None:
            (labels, loops), block = part.result, part.place
            writer.put(block, blocks.rows(block), **labels.arrays(), **vars(loops))

        timing = work_off(found, put, total, unit="loops", progress=progress)
    budget.say(f"{timing.count:,} loops; {timing.compile_seconds:.0f} s of that was compiling")


def _save(folder: Path, setting: RobotSetting, found: RobotMap, config: dict[str, Any]) -> None:
    """Write robot_map.npz and summary.json."""
    names = "x0s states predicted held within_limits recursive depth".split()
    arrays = {name: getattr(found, name) for name in names} | vars(found.loops)
    write_arrays(folder / "robot_map.npz", feasible=found.linear.label, **arrays)
    run = {"precision": setting.dtype, "config": config, "versions": versions()}
    write_results(folder / "summary.json", found.summary() | run)
