"""The command `jaxmpc sweep`."""

import dataclasses
import math
import os
import time
from importlib import import_module
from pathlib import Path
from threading import Thread
from typing import Any

from jaxmpc.app import config as configs
from jaxmpc.app.options.shared import (
    arguments,
    at_least,
    chosen_shard,
    given_options,
    print_table,
    refuse,
)
from jaxmpc.app.options.sweep import SweepOptions
from jaxmpc.batches import chosen_devices
from jaxmpc.checks import fail, require_disk
from jaxmpc.feasible.stored import StoredMap, sweep_into, sweep_problem
from jaxmpc.files import check_results, open_folder, remove_files, versions, write_results
from jaxmpc.robot_maps.stored_sweep import sweep_robot
from jaxmpc.store import Store, exists, location

# By how much the files of a sweep are smaller than its arrays, at most: the joint's 13 times.
COMPRESSION = 20


class Sweep(SweepOptions):
    """The command: its options, and `run`."""

    def run(self) -> None:
        """Label all states, write the files, print the table.

        Raises ValueError for options and files that make no sense.
        """
        if self.robot is not None:
            self.map_robot(self.robot)
            return
        refuse({"seconds": self.seconds}, None, "It is how long a robot's loops last")
        chosen_devices(self.devices, "--devices")
        keys = "horizon terminal grid lower upper axes fixed iterations dtype".split()
        overrides = given_options(self, *keys) | ({"projection": True} if self.projection else {})
        config = configs.load(self.config, overrides)
        needed = math.prod(configs.grid_shape(config)) * configs.state_bytes(config) / COMPRESSION
        if self.store is None:
            where, cure = f"--output {self.output}", "Map fewer points, or use another disk"
            require_disk(where, needed, self.output, cure)
        shard = None if self.shard is None else chosen_shard(self.shard, os.environ)
        linear_sweep(
            config,
            self.output,
            url=self.store,
            resume=self.resume,
            overwrite=self.overwrite,
            shard=shard,
            refine=self.refine,
            devices=self.devices,
        )

    def map_robot(self, robot: str) -> None:
        """Make the map of --robot. Raises ValueError for options that do not go with it."""
        given = {"config": self.config, "projection": self.projection}
        refuse(given, robot, "Give a problem or a robot; a robot's map is a slice")
        refuse({"shard": self.shard, "store": self.store}, robot, "They are for linear maps")
        chosen_devices(self.devices, "--devices")
        at_least(1).check("--horizon", self.horizon)
        given = arguments(self, sweep_robot, leave=("robot",))
        given |= given_options(self, "iterations", "dtype")
        map_robot_into(robot, self.output, self.refine, **given)


def linear_sweep(
    config: configs.Config,
    output: Path,
    *,
    url: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    shard: tuple[int, int] | None = None,
    refine: bool = True,
    **work: Any,
) -> None:
    """Label all states, write map and summary, print the table.

    url: of the store, None for sweep.zarr in the folder output. work (chunk, executor, devices) and
    the others: as in `sweep_into`. A shard labels its own blocks, and is done unless it is the
    last.
    Raises ValueError before anything compiles.
    """
    start, path = time.perf_counter(), url or output / "sweep.zarr"
    region = configs.sweep_points(config)
    if shard is None:
        check_results(location(path), resume, overwrite, exists(location(path)))
    problem = sweep_problem(config.build_mpc(), region.axes, region.fixed)
    open_folder(output)
    # Other shards may have made the store, and one may be writing the results.
    old = () if shard else ("map.png", "summary.json")

    def opened(store: Store) -> None:
        part = ""
        if shard is not None:
            part = f", shard {shard[0]}/{shard[1]}"
            part += f" with {len(store.own):,} of {len(store.regions):,} blocks"
        print(f"{config.name}: {region.total:,} initial states -> {output}{part}")
        # The compiler keeps one core busy; meanwhile another can load matplotlib.
        plots = Thread(target=import_module, args=("jaxmpc.app.plots.maps",), daemon=True)
        plots.start()

    found = sweep_into(
        path,
        problem,
        region.along,
        iterations=config.sweep.iterations,
        dtype=config.sweep.dtype,
        gap=1e-6 if refine and len(region.axes) <= 3 else None,
        settings=config.to_dict(),
        shard=shard,
        resume=resume,
        overwrite=overwrite,
        progress=True,
        begun=lambda: remove_files(output, *old),
        opened=opened,
        concluded=lambda found: conclude(found, config, output, start),
        **work,
    )
    if found.left:
        print_table([run_row(found), ("left", found.left)], 12)


def run_row(found: StoredMap) -> tuple[str, str]:
    """Return the row of the table on the work of this run."""
    count, seconds = found.timing.count, found.timing.run_seconds
    speed = f", {count / seconds:,.0f} QPs/s" if count else ""
    return "run", f"{seconds:.2f} s for {count:,} QPs{speed}"


def conclude(found: StoredMap, config: configs.Config, output: Path, start: float) -> None:
    """Write the picture of two or three states and the summary, and print the table."""
    axes = found.problem.view.axes
    picture = f"none: map.png shows two or three axes, and this map has {len(axes)}"
    files = [str(found.store.path), str(output / "summary.json")]
    if len(axes) in (2, 3):
        from jaxmpc.app.plots.maps import plot_body, plot_feasible_set
        from jaxmpc.app.plots.style import save

        figure: Any = None
        try:
            if len(axes) == 3:
                figure = plot_body(found.bounds)
            else:
                figure = plot_feasible_set(found.bounds, picture=found.picture()).figure
            files += save(figure, output / "map.png", config.name)
        except ValueError as error:
            picture = f"none: {error}"
    low, high = found.bounds.volume_bounds()
    if low > high * (1 + 1e-9):
        what = f"its inner bound {low:.9g} exceeds its outer bound {high:.9g}"
        fail(str(found.store.path), what, "Look for damage with jaxmpc verify, or overwrite it")
    seconds = time.perf_counter() - start
    summary = {
        "name": config.name,
        "counts": found.counts,
        "volume": {"inner": low, "outer": high},
        "this_run": {**dataclasses.asdict(found.timing), "total_seconds": seconds},
        "config": config.to_dict(),
        "versions": versions(),
    }
    write_results(output / "summary.json", summary)
    what = {1: "length", 2: "area"}.get(len(axes), "volume")
    unit = found.bounds.mpc.volume_unit(axes)
    total, gap = sum(found.counts.values()), 1 - low / high if high > low else 0.0
    rows = [
        (name, f"{count:>12,}  {count / total:7.2%}")
        for name, count in found.counts.items()
        if count or name in ("feasible", "infeasible", "undecided")
    ]
    rows += [
        ("compile", f"{found.timing.compile_seconds:.2f} s"),
        run_row(found),
        (f"{what} from", f"{low:.9g}{unit} (inner bound)"),
        (f"{what} to", f"{high:.9g}{unit} (outer bound, gap {gap:.1g} of it)"),
        ("total", f"{seconds:.2f} s with bounds and files"),
        ("files", " ".join(files)),
    ]
    if str(output / "map.png") not in files:
        rows.append(("picture", picture))
    print_table(rows, 12)


def map_robot_into(robot: str, output: Path, refine: bool = True, **options: Any) -> None:
    """Run `sweep_robot`, draw and print its map. Raises ValueError as it does, before anything
    compiles."""
    begun = time.perf_counter()
    rmap = sweep_robot(robot, output, gap=1e-6 if refine else None, progress=True, **options)
    files = ["summary.json", "robot_map.npz"]
    if rmap.x0s.shape[1] == 2:
        from jaxmpc.app.plots.maps import plot_robot_map
        from jaxmpc.app.plots.style import save

        save(plot_robot_map(rmap).figure, output / "robot_map.png")
        files.append("robot_map.png")
    print(rmap)
    if rmap.recursion is not None:
        print(f"linear model, in deviations from the set-point\n{rmap.recursion}")
    total = f"{time.perf_counter() - begun:.2f} s with set-up and files"
    print_table([("total", total), ("files", " ".join(str(output / name) for name in files))], 17)
