"""The command `jaxmpc sweep`: arguments to calls, no mathematics."""

import contextlib
import dataclasses
import json
import os
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import tyro
import zarr
from tqdm.std import tqdm

from jaxmpc import config as configs
from jaxmpc.checks import fail
from jaxmpc.commands.options import End, Horizon, Terminal, open_folder, option, report_error
from jaxmpc.commands.robot_map import RobotJob, refused
from jaxmpc.compiled import CHUNK
from jaxmpc.mpc.problem import MPC
from jaxmpc.plots import plot_feasible_set
from jaxmpc.sweeps import store
from jaxmpc.sweeps.feasible_set import FeasibleSetMap, Labels, label_chunks
from jaxmpc.sweeps.ladder import RungPenalties
from jaxmpc.tuning.sweep_penalties import tune_sweep_penalties


@dataclasses.dataclass(frozen=True)
class Sweep:
    """From which initial states can this controller keep all its limits? A map, with proofs.

    What it does
      Lays a grid over the initial states of a constrained linear MPC and decides each one:
        feasible    a plan was found and rolled out within all limits
        infeasible  a certificate proves that there is no plan
        undecided   neither
      Then bounds the set of feasible states by polytopes, from inside and from outside.
      Without a file the problem is one robot joint: x = (q, dq), torque u, 20 steps of 0.01 s.
      An option given here wins over the file.

    How to start
      $ jaxmpc sweep
      $ jaxmpc sweep --config pendulum.toml --terminal invariant --grid 512 512 --output maps/a

    How to read the output, all in the folder of --output
      map.png       Blue feasible, grey infeasible, yellow undecided. The true boundary lies
                    between the dashed line (inner) and the solid one (outer). Two axes only.
      summary.json  Counts, bounds of the area, seconds, configuration, versions.
      sweep.zarr    Each state with its label (1 feasible, -1 infeasible, 0 undecided), its plan,
                    and the half-space cut_normal'x <= cut_offset that no feasible state leaves.
                    start holds the x_0 of the plan; bound_* the points and facets of the bounds.
                    Opens with xarray.open_zarr(path, consolidated=False).
      Ctrl-C        Stops after the chunk in hand; --resume goes on from there.
      Exit code     0 done, 2 error (one line on stderr says which), 130 stopped by Ctrl-C.

    With --robot NAME or FILE: the promise and the robot
      Such as jaxmpc sweep --robot pendulum --terminal invariant --seconds 2
      The MPC of a robot (joint, pendulum, cartpole, arm2, arm6, arm7, quadrotor, or an MJCF or
      URDF file), linear about its home, weights from its limits. The grid is a slice: the first
      joint's position and velocity unless --axes says otherwise, the rest at home unless --fixed.
      Each state is labelled as above, by the linear model, and by the closed loop of the
      nonlinear robot in MJX: are all its limits kept for --seconds? Costs about 0.3 ms a state
      and sample on one CPU core.
      robot_map.png  Blue: promise kept. Red: promise broken (feasible by the linear model, the
                     robot leaves its limits). Grey: infeasible, and the robot fails. Green:
                     infeasible, yet the robot keeps its limits. Circle: the broken promise
                     deepest in the linear feasible set.
                     Without an invariant terminal set a plan promises its horizon only.
      summary.json   Counts, plans by status, deepest broken promise, configuration.
      robot_map.npz  points, states, promised, held (1 yes, -1 no, 0 undecided), kept, recursive,
                     feasible, depth, worst (most beyond a limit), broken_at, lost_at, unsolved_at.
      chunks/        What --resume goes on from: a killed run loses one chunk of 256 states.

    What the TOML file holds (n states, m inputs; dt in seconds, other units are yours)
      name = "joint"
      [system]  A, B, dt; optional c, state_names, state_units, input_names, input_units,
                continuous = true (A, B, c of dx/dt, the input held over dt)
      [limits]  u_min, u_max, and x_min, x_max (inf allowed) or H_x, h_x (H_x x <= h_x)
      [cost]    Q, R, P = "lqr" | "Q" | "none" | matrix; a flat list is a diagonal; optional rho,
                the L1 weight of soft limits, a number or "exact" (jaxmpc info; sets stay hard)
      [mpc]     horizon; optional terminal, constrain_initial = false (no limits at k = 0),
                control_horizon (free moves, the last one is held)
      and what jaxmpc tune writes, see its help: [limits] margin, [mpc] H_f, h_f or P_f, level_f,
      [solver]
      [sweep]   all optional: grid, lower, upper, axes, fixed, projection, iterations, dtype
    """

    config: Annotated[Path | None, option("FILE", "the built-in joint")] = None
    """TOML file with the problem and the sweep."""
    robot: Annotated[str | None, option("NAME|FILE", "none: a linear system")] = None
    """Map a robot instead, linear promise against nonlinear closed loop."""
    seconds: Annotated[float | None, option("S", "with --robot: 2")] = None
    """Length of the robot's closed loops."""
    output: Annotated[Path, option("DIR", "jaxmpc-sweep")] = Path("jaxmpc-sweep")
    """Folder for sweep.zarr, map.png and summary.json; made where absent."""
    horizon: Horizon = None
    """Prediction horizon, in steps of dt."""
    terminal: Terminal = None
    """Set for the last state: none, largest set or ellipsoid that the LQR keeps within limits,
    state limits."""
    grid: Annotated[tuple[int, ...] | None, option("K [K ...]", "from the file, else 256 256")] = (
        None
    )
    """Points along each mapped axis, ends included."""
    lower: End = None
    """Lower end of each mapped axis, in the units of the state."""
    upper: End = None
    """Upper end of each mapped axis, in the units of the state."""
    axes: Annotated[tuple[str, ...] | None, option("AXIS [AXIS ...]", "first two states")] = None
    """States to map, by name or index from 0."""
    fixed: Annotated[tuple[float, ...] | None, option("X [X ...]", "from the file")] = None
    """With more states than axes: values of the other states, in their order (a slice)."""
    projection: Annotated[
        bool, tyro.conf.FlagCreatePairsOff, option(None, "from the file, else off")
    ] = False
    """With more states than axes: feasible for some value of the other states."""
    iterations: Annotated[int | None, option("K", "from the file, else 50")] = None
    """Solver steps of the first pass over all states; what is left open gets more."""
    dtype: Annotated[
        Literal["float32", "float64"] | None,
        option("{float32,float64}", "from the file, else float32"),
    ] = None
    """Precision of the solver's steps. Proofs are in float64 always."""
    learn_penalties: Annotated[bool, tyro.conf.FlagCreatePairsOff, option(None, "off")] = False
    """Learn penalties of the first pass for this problem (kept in ~/.cache/jaxmpc/penalties), so
    that it leaves fewer states open. Learning costs about what a million states cost, and saves up
    to a quarter of that: for problems that are swept again and again."""
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff, option(None, "off")] = False
    """Go on with the sweep in --output."""
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff, option(None, "off")] = False
    """Delete the sweep in --output and start again."""
    refine: Annotated[bool, option(None, "on")] = True
    """Move inner and outer bound together to a relative gap of 1e-6 (up to three axes)."""

    def overrides(self) -> dict[str, Any]:
        """The keys of [mpc] and [sweep] that the command line sets."""
        keys = "horizon terminal grid lower upper axes fixed iterations dtype".split()
        given = {key: getattr(self, key) for key in keys if getattr(self, key) is not None}
        return {**given, **({"projection": True} if self.projection else {})}

    def robot_job(self) -> RobotJob:
        """The map of --robot. Raises ValueError for options that do not go with it."""
        assert self.robot is not None
        given = {"config": self.config, "projection": self.projection}
        refused(given, self.robot, "Give a problem or a robot; a robot's map is a slice")
        refused({"learn-penalties": self.learn_penalties}, self.robot, "They are for linear maps")
        settings = {"iterations": self.iterations, "dtype": self.dtype}
        return RobotJob(
            self.robot, self.output, "limits", seconds=self.seconds, horizon=self.horizon,
            terminal=self.terminal, axes=self.axes, values=self.fixed, grid=self.grid,
            lower=self.lower, upper=self.upper, refine=self.refine, resume=self.resume,
            overwrite=self.overwrite,
            settings=tuple((key, value) for key, value in settings.items() if value is not None),
        )  # fmt: skip


class Job(NamedTuple):
    """A sweep that is checked and open, before anything compiles."""

    config: configs.Config
    mpc: MPC
    region: configs.SweepPoints
    group: zarr.Group


@dataclasses.dataclass
class Tally:
    """What this run did, its share of a sweep that may have been resumed."""

    states: int = 0
    compile_seconds: float = 0.0
    run_seconds: float = 0.0
    stopped: bool = False


def prepare(command: Sweep) -> Job:
    """Read, check and open everything a sweep needs. Raises ValueError, compiles nothing."""
    overrides = command.overrides()
    if command.config is None:
        config = configs.Config.default(overrides)
    else:
        config = configs.load(command.config, overrides)
    mpc, region = config.build()
    if command.resume and command.overwrite:
        fail("--overwrite", "given beside --resume", "Choose one")
    open_folder(command.output)
    path = command.output / "sweep.zarr"
    if path.exists() and command.overwrite:
        store.remove(path)
    elif path.exists() and not command.resume:
        fail(str(path), "exists", "Add --resume to go on with it or --overwrite to start again")
    shape = (mpc.system.n, mpc.horizon, mpc.system.m)
    group = store.open_sweep(path, region.points, shape, config.to_dict(), CHUNK)
    for name in ("map.png", "summary.json"):  # of an earlier run
        (command.output / name).unlink(missing_ok=True)
    return Job(config, mpc, region, group)


def sweep(command: Sweep, resume: str) -> int:
    """Label all states chunk by chunk, then write the picture, the summary and the table.

    resume: the command line that goes on where this one stops."""
    start = time.perf_counter()
    try:
        if command.robot is not None:
            command.robot_job().run()
            return 0
        refused({"seconds": command.seconds}, None, "It is how long a robot's loops last")
        job = prepare(command)
    except ValueError as error:
        return report_error(error)
    print(f"{job.config.name}: {len(job.region.points):,} initial states -> {command.output}")
    try:
        penalties = _penalties(job) if command.learn_penalties else None
    except ValueError as error:
        return report_error(error)
    tally = _label(job, penalties)
    fmap = _read_map(command.output / "sweep.zarr", job)
    if tally.stopped:
        print(_table(fmap, tally, [("chunks left", len(store.pending(job.group)))]))
        print(f"stopped; what is done is kept. Go on with:\n  {resume}")
        return 130
    dimension = len(job.region.axes)
    if command.refine and dimension <= 3:
        print("closing the bounds by rays; long horizons take a while", file=sys.stderr)
        fmap = fmap.refine()
        store.save_bounds(job.group, fmap.extra_points, fmap.extra_normals, fmap.extra_offsets)
    files = ["sweep.zarr", "summary.json"]
    if dimension == 2:
        figure = plot_feasible_set(fmap).get_figure(root=True)
        assert figure is not None
        figure.savefig(command.output / "map.png", dpi=150, bbox_inches="tight", pad_inches=0.15)
        files.append("map.png")
    low, high = fmap.volume_bounds()
    seconds = time.perf_counter() - start
    summary = {
        "name": job.config.name,
        "counts": fmap.counts(),
        "volume": {"inner": low, "outer": high if np.isfinite(high) else None},
        "this_run": {**dataclasses.asdict(tally), "total_seconds": seconds},
        "config": job.config.to_dict(),
        "versions": job.group.attrs["versions"],
    }
    (command.output / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    what = {1: "length", 2: "area"}.get(dimension, "volume")
    unit = _unit(job)
    rows = [
        (f"{what} from", f"{low:.9g}{unit} (inner bound)"),
        (f"{what} to", f"{high:.9g}{unit} (outer bound, gap {high - low:.2g})"),
        ("total", f"{seconds:.2f} s with set-up, bounds and files"),
        ("files", " ".join(str(command.output / name) for name in files)),
    ]
    print(_table(fmap, tally, rows))
    return 0


def cache_folder() -> Path:
    """Where learned penalties are kept: the user's cache (XDG base directories)."""
    home = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(home) if Path(home).is_absolute() else Path.home() / ".cache") / "jaxmpc/penalties"


def _penalties(job: Job) -> RungPenalties | None:
    """Learned for the problem in hand, or from the cache. Raises ValueError for too few states."""
    if not store.pending(job.group):
        return None
    start, region, settings = time.perf_counter(), job.region, job.config.sweep
    try:
        found = tune_sweep_penalties(
            job.mpc, region.points, axes=region.axes, fixed=region.fixed, chunk=CHUNK,
            iterations=settings.iterations, dtype=settings.dtype, cache=cache_folder(),
        )  # fmt: skip
    except OSError as error:
        fail(str(cache_folder()), f"{error.strerror}", "Set XDG_CACHE_HOME to a folder of yours")
    first, best = found.before["decided"], found.after["decided"]
    verdict = f"{first:.2%} -> {best:.2%} decided by the first pass"
    if not found.improved:
        verdict = f"nothing better found, {best:.2%} decided by the first pass"
    print(f"penalties: {verdict}, {time.perf_counter() - start:.1f} s", file=sys.stderr)
    return found.result if found.improved else None


def _label(job: Job, penalties: RungPenalties | None) -> Tally:
    """Label the chunks not yet done and commit each; Ctrl-C ends it after the chunk in hand."""
    todo = store.pending(job.group)
    rows = [np.arange(len(job.region.points))[store.chunk_rows(job.group, k)] for k in todo]
    tally, decided = Tally(), 0
    if not todo:
        return tally
    chunks = label_chunks(
        job.mpc,
        job.region.points[np.concatenate(rows)],
        axes=job.region.axes,
        fixed=job.region.fixed,
        iterations=job.config.sweep.iterations,
        dtype=job.config.sweep.dtype,
        chunk=CHUNK,
        penalties=penalties,
    )
    total = sum(map(len, rows))
    with (
        _stop_on_interrupt(tally),
        tqdm(total=total, unit=" states", unit_scale=True, disable=None) as bar,
    ):
        for index, (_, labels) in zip(todo, chunks, strict=True):
            store.commit(
                job.group,
                index,
                label=labels.label,
                status=labels.status,
                start=labels.starts,
                plan=labels.plans,
                cut_normal=labels.cut_normals,
                cut_offset=labels.cut_offsets,
            )
            tally.states += len(labels.label)
            tally.compile_seconds += labels.compile_seconds
            tally.run_seconds += labels.run_seconds
            decided += int(np.count_nonzero(labels.label))
            bar.set_postfix_str(f"{decided / tally.states:.2%} decided", refresh=False)
            bar.update(len(labels.label))
            if tally.stopped:
                break
    return tally


@contextlib.contextmanager
def _stop_on_interrupt(tally: Tally) -> Iterator[None]:
    """First Ctrl-C: ask for a stop after the chunk in hand. Second: stop now."""

    def handle(signum: int, frame: Any) -> None:
        if tally.stopped:
            raise KeyboardInterrupt
        tally.stopped = True
        print("\nstopping after this chunk (Ctrl-C again: now)", file=sys.stderr)

    previous = signal.signal(signal.SIGINT, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


def _read_map(path: Path, job: Job) -> FeasibleSetMap:
    """The map as far as it is in the store."""
    data = store.read(path).load()
    labels = Labels(
        label=data["label"].values,
        status=data["status"].values,
        starts=data["start"].values,
        plans=data["plan"].values,
        cut_normals=data["cut_normal"].values,
        cut_offsets=data["cut_offset"].values,
    )
    region = job.region
    return FeasibleSetMap.of(job.mpc, region.points, region.axes, region.fixed, labels)


def _table(fmap: FeasibleSetMap, tally: Tally, more: Sequence[tuple[str, Any]]) -> str:
    rows = [
        (name, f"{count:>12,}  {count / len(fmap.points):7.2%}")
        for name, count in fmap.counts().items()
        if count or name in ("feasible", "infeasible", "undecided")
    ]
    rows.append(("compile", f"{tally.compile_seconds:.2f} s"))
    speed = f", {tally.states / tally.run_seconds:,.0f} QPs/s" if tally.run_seconds else ""
    rows.append(("run", f"{tally.run_seconds:.2f} s for {tally.states:,} QPs{speed}"))
    return "\n".join(f"  {name:<12} {value}" for name, value in [*rows, *more])


def _unit(job: Job) -> str:
    """Unit of a volume over the mapped axes, such as " rad·rad/s"."""
    units = job.config.system.state_units
    return " " + "·".join(units[i] for i in job.region.axes) if units else ""
