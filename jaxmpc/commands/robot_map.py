"""`--robot` of the commands sweep and recursion: a robot's map, kept chunk by chunk."""

import hashlib
import json
import os
import shutil
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
from tqdm.std import tqdm

from jaxmpc.checks import fail
from jaxmpc.closed_loop.robot_mpc import robot_mpc
from jaxmpc.commands.options import model_hash, open_folder, versions, write_json
from jaxmpc.control.invariant import maximal_invariant_set
from jaxmpc.control.riccati import lqr
from jaxmpc.control.sets import Polytope
from jaxmpc.mpc.problem import MPC
from jaxmpc.robot_plots import plot_robot_map
from jaxmpc.robots.load import load_robot
from jaxmpc.robots.robot import Robot
from jaxmpc.sweeps.feasible_set import ARRAYS, grid, joined
from jaxmpc.sweeps.robots import Loops, RobotMap, RobotSetting, deviations

# Points along each of two axes, and in all along another number of them.
SIDE, POINTS = 32, 1024
FILES = ("robot_map.npz", "robot_map.png", "summary.json")
CHUNKS = "chunks"


@dataclass(frozen=True)
class RobotJob:
    """What to map, as the command line says it; None where it says nothing.

    axes: names or indices of coordinates; values: of the other coordinates, in their order.
    search_seconds: see `map_robot`. settings: iterations, dtype of the linear labels.
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
    settings: tuple[tuple[str, Any], ...] = ()

    def run(self) -> None:
        """Make the map, write the files, print the table. Raises ValueError before it compiles."""
        begun = time.perf_counter()
        setting, config = self.prepare()
        count = len(setting.points)
        print(f"{setting.robot.name}: {count:,} states, {setting.steps} samples -> {self.output}")
        rmap = self.made(setting, config)
        files = self.save(setting, rmap, config)
        print(rmap)
        if rmap.recursion is not None:
            print(f"linear model, in deviations from the set-point\n{rmap.recursion}")
        print(f"  {'total':<16} {time.perf_counter() - begun:.2f} s with set-up and files")
        print(f"  {'files':<16} {' '.join(str(self.output / name) for name in files)}")

    def prepare(self) -> tuple[RobotSetting, dict[str, Any]]:
        """The checked map and what says which it is; the folder made."""
        if self.resume and self.overwrite:
            fail("--overwrite", "given beside --resume", "Choose one")
        robot = load_robot(self.robot)
        axes = self._axes(robot)
        points = self._points(robot, axes)
        others = [i for i in range(robot.n) if i not in axes]
        if self.values is not None and len(self.values) != len(others):
            what = f"has {len(self.values)} entries where {len(others)} are needed"
            fail("--fixed", what, "One for each coordinate that is not on an axis")
        for name in ("horizon", "steps", "seconds"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                fail(f"--{name}", f"{value}", "Give a positive number")
        if self.terminal == "ellipsoid":
            fail("--terminal", "ellipsoid: a robot's limits are soft rows", "Give invariant or box")
        # From here on things compile.
        fixed = _home(robot)
        fixed[others] = fixed[others] if self.values is None else self.values
        mpc = default_mpc(robot, self.horizon or 20, self.terminal)
        seconds = 2.0 if self.seconds is None else self.seconds
        setting = RobotSetting.of(
            robot, mpc, points, seconds if self.steps is None else self.steps * robot.dt,
            axes=axes, fixed=fixed, claim=self.claim,
        )  # fmt: skip
        config = {
            "robot": self.robot,
            "claim": self.claim,
            "samples": setting.steps,
            "horizon": mpc.horizon,
            "terminal": self.terminal or "none",
            "axes": [robot.state_names[i] for i in setting.axes],
            "fixed": {robot.state_names[i]: float(fixed[i]) for i in others},
            "points": len(setting.points),
            "lower": setting.points.min(axis=0).tolist(),
            "upper": setting.points.max(axis=0).tolist(),
            "chunk": setting.chunk(None),
            "Q": np.diag(mpc.Q).tolist(),
            "R": np.diag(mpc.R).tolist(),
            "model": _fingerprint(robot, setting.points),
            **dict(self.settings),
        }
        open_folder(self.output)
        self._open_chunks(config)
        for name in FILES:  # of an earlier run
            (self.output / name).unlink(missing_ok=True)
        return setting, config

    def _axes(self, robot: Robot) -> tuple[int, ...]:
        names = list(robot.state_names)
        # The first joint, its position and velocity.
        given = self.axes or (names[0], names[robot.n // 2])
        known = f"Coordinates are {', '.join(names)}, or 0 to {robot.n - 1}"
        axes = []
        for axis in given:
            i = names.index(axis) if axis in names else int(axis) if axis.isdecimal() else -1
            if not 0 <= i < robot.n:
                fail("--axes", f"no coordinate {axis!r}", known)
            axes.append(i)
        if len(set(axes)) != len(axes):
            fail("--axes", f"{list(given)} repeats a coordinate", known)
        return tuple(axes)

    def _points(self, robot: Robot, axes: tuple[int, ...]) -> np.ndarray:
        d = len(axes)
        shape = tuple(self.grid or ((SIDE, SIDE) if d == 2 else (int(POINTS ** (1 / d)),) * d))
        limits = (np.asarray(v)[list(axes)] for v in vars(robot.state_limits).values())
        low, high = limits
        room = 0.03 * np.where(np.isfinite(high - low), high - low, 0.0)
        lower = low - room if self.lower is None else np.asarray(self.lower)
        upper = high + room if self.upper is None else np.asarray(self.upper)
        for name, value in (("--grid", shape), ("--lower", lower), ("--upper", upper)):
            if len(value) != d:
                fail(name, f"has {len(value)} entries where {d} are needed", "One for each axis")
        if not np.all(np.isfinite([lower, upper])) or np.any(lower >= upper):
            ends = f"from {lower.tolist()} to {upper.tolist()}"
            fail("--lower", f"no range to map: {ends}", "Give --lower below --upper, finite")
        return grid(lower, upper, shape)

    def _open_chunks(self, config: dict[str, Any]) -> None:
        """The folder of the chunks, empty or of the same map."""
        folder, said = self.output / CHUNKS, self.output / CHUNKS / "config.json"
        if folder.exists() and not said.exists():
            fail(str(folder), "holds no map", "Choose another output folder")
        if folder.exists() and self.overwrite:
            shutil.rmtree(folder)
        elif folder.exists() and not self.resume:
            fail(
                str(folder), "exists", "Add --resume to go on with it or --overwrite to start again"
            )
        folder.mkdir(exist_ok=True)
        if not said.exists():
            write_json(said, config)
        there = json.loads(said.read_text())
        if there != json.loads(json.dumps(config)):
            keys = [key for key in {**there, **config} if there.get(key) != config.get(key)]
            fail(str(folder), f"holds another map ({', '.join(keys)} differ)", "Or --overwrite")

    def made(self, setting: RobotSetting, config: dict[str, Any]) -> RobotMap:
        """The map; chunks that are on disk are read, the others made and written."""
        size, count = config["chunk"], len(setting.points)
        slices = [slice(i, min(i + size, count)) for i in range(0, count, size)]
        path = lambda k: self.output / CHUNKS / f"{k:05}.npz"
        todo = [k for k in range(len(slices)) if not path(k).exists()]
        with tqdm(total=sum(_length(slices[k]) for k in todo), unit=" loops", disable=None) as bar:
            for k, labels, loops in self._chunks(setting, slices, todo):
                arrays = {name: getattr(labels, name) for name in ARRAYS}
                arrays |= {f.name: getattr(loops, f.name) for f in fields(Loops)}
                _save(path(k), arrays)
                bar.update(_length(slices[k]))
        labels, parts = setting.none(), []
        for k, here in enumerate(slices):
            with np.load(path(k)) as stored:
                part = {name: stored[name] for name in stored.files}
            parts.append(Loops(**{f.name: part[f.name] for f in fields(Loops)}))
            labels = joined(labels, here, replace(labels, **{name: part[name] for name in ARRAYS}))
        refine = 1e-6 if self.refine and len(setting.axes) <= 3 else None
        return setting.map(labels, parts, refine=refine, search_seconds=self.search_seconds)

    def _chunks(
        self, setting: RobotSetting, slices: list[slice], todo: list[int]
    ) -> Iterator[tuple[int, Any, Loops]]:
        """The chunks that are left, with their numbers."""
        if not todo:
            return
        rows = np.concatenate([np.arange(slices[k].start, slices[k].stop) for k in todo])
        # Whole chunks but for the last of all, so the chunks of the rest are those of the whole.
        made = setting.chunks(rows, chunk=slices[0].stop, **dict(self.settings))
        for k, (_, labels, loops) in zip(todo, made, strict=True):
            yield k, labels, loops

    def save(self, setting: RobotSetting, rmap: RobotMap, config: dict[str, Any]) -> list[str]:
        """Write the files; their names."""
        loops = {f.name: getattr(rmap.loops, f.name) for f in fields(Loops)}
        _save(self.output / "robot_map.npz", {
            "points": rmap.points, "states": setting.states(rmap.points),
            "promised": rmap.promised, "held": rmap.held, "kept": rmap.kept,
            "recursive": rmap.recursive, "feasible": rmap.linear.label,
            "depth": rmap.depth, **loops,
        })  # fmt: skip
        low, high = rmap.linear.volume_bounds()
        worst = rmap.worst()
        summary: dict[str, Any] = {
            "name": rmap.robot.name,
            "claim": rmap.claim,
            "counts": rmap.counts(),
            "broken": int(np.sum(rmap.broken)),
            "broken_after_an_unsolved_plan": int(np.sum(rmap.unsure)),
            "deepest_broken": None if worst is None else {
                "state": setting.states(rmap.points)[worst].tolist(),
                "sample": int(rmap.first_loss[worst]),
                "beyond": _number(rmap.loops.worst[worst]),
            },
            "linear": {"counts": rmap.linear.counts(), "volume": [low, _number(high)]},
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
        write_json(self.output / "summary.json", summary)
        if rmap.points.shape[1] != 2:
            return ["summary.json", "robot_map.npz"]
        figure = plot_robot_map(rmap).get_figure(root=True)
        assert figure is not None
        path = self.output / "robot_map.png"
        figure.savefig(path, dpi=150, bbox_inches="tight", pad_inches=0.15)
        return ["summary.json", "robot_map.npz", "robot_map.png"]


def default_mpc(robot: Robot, horizon: int, terminal: str | None = None) -> MPC:
    """The MPC of `robot_mpc` with a terminal set: None or "none"; "box", the state limits of the
    problem; "invariant", the largest set that the LQR keeps within all limits."""
    mpc = robot_mpc(robot, horizon=horizon)
    if terminal in (None, "none"):
        return mpc
    if terminal == "box":
        return replace(mpc, terminal_set=mpc.states)
    x, (_, u) = _home(robot), robot.equilibrium()
    about = deviations(mpc, x, u)
    law = lqr(about.system, mpc.Q, mpc.R)
    # At the set-point c is rounding.
    system = replace(about.system, c=None)
    assert about.states is not None
    found = maximal_invariant_set(system, law.K, about.states, about.inputs)
    H, h = np.asarray(found.H), np.asarray(found.h)
    return replace(mpc, terminal_set=Polytope(H, h + H @ x))


def refused(given: dict[str, Any], robot: str | None, needs: str) -> None:
    """Raise where an option is given that does not go with (or without) --robot."""
    for name, value in given.items():
        if value not in (None, False):
            problem = f"given beside --robot {robot}" if robot else "given without --robot"
            fail(f"--{name}", problem, needs)


def _home(robot: Robot) -> np.ndarray:
    """Coordinates of `robot.home`."""
    with jax.enable_x64(True):
        return np.array(robot.coordinates(np.asarray(robot.home)), np.float64)


def _fingerprint(robot: Robot, points: np.ndarray) -> str:
    """Of the compiled model, its home and control period, and of all points."""
    parts = (np.asarray(robot.home), np.array([robot.dt]), points)
    text = model_hash(robot).encode() + b"".join(v.tobytes() for v in parts)
    return hashlib.sha256(text).hexdigest()[:16]


def _length(rows: slice) -> int:
    return rows.stop - rows.start


def _number(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None


def _save(path: Path, arrays: dict[str, Any]) -> None:
    """Write an .npz that is there as a whole or not at all."""
    partial = path.with_name(f".{path.name}.partial.npz")
    np.savez_compressed(partial, **arrays)
    os.replace(partial, path)
