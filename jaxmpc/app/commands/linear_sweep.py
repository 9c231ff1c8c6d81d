"""A sweep of a linear problem: `sweep_into` with the files, picture and table of the command."""

import dataclasses
import time
from importlib import import_module
from pathlib import Path
from threading import Thread
from typing import Any

from jaxmpc.app.commands.options import print_table
from jaxmpc.app.config import Config, sweep_points
from jaxmpc.batches import CHUNK
from jaxmpc.checks import fail
from jaxmpc.feasible.stored import StoredMap, sweep_into
from jaxmpc.files import check_results, open_folder, remove_files, versions, write_results
from jaxmpc.store import Store, exists, location


def linear_sweep(
    config: Config,
    output: Path,
    *,
    url: str | None = None,
    resume: bool = False,
    overwrite: bool = False,
    shard: tuple[int, int] | None = None,
    refine: bool = True,
    executor: Any = None,
    devices: int | None = None,
) -> None:
    """Label all states, write map and summary, print the table.

    url: of the store, None for sweep.zarr in the folder output. The others: as in `sweep_into`. A
    shard labels its own blocks, and is done unless it is the last. Raises ValueError before
    anything compiles.
    """
    start, region, path = time.perf_counter(), sweep_points(config), url or output / "sweep.zarr"
    mpc, dimension = config.build_mpc(), len(region.axes)
    if shard is None:
        check_results(location(path), resume, overwrite, exists(location(path)))
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
        plots = Thread(target=import_module, args=("jaxmpc.app.plots.feasible_set",), daemon=True)
        plots.start()

    found = sweep_into(
        path,
        mpc,
        region.along,
        axes=region.axes,
        fixed=region.fixed,
        iterations=config.sweep.iterations,
        dtype=config.sweep.dtype,
        chunk=CHUNK,
        gap=1e-6 if refine and dimension <= 3 else None,
        settings=config.to_dict(),
        shard=shard,
        executor=executor,
        devices=devices,
        resume=resume,
        overwrite=overwrite,
        progress=True,
        begun=lambda: remove_files(output, *old),
        opened=opened,
        concluded=lambda found: conclude(found, config, output, start),
    )
    if found.left:
        print_table([run_row(found), ("left", found.left)], 12)


def run_row(found: StoredMap) -> tuple[str, str]:
    """Return the row of the table on the work of this run."""
    count, seconds = found.timing.count, found.timing.run_seconds
    speed = f", {count / seconds:,.0f} QPs/s" if count else ""
    return "run", f"{seconds:.2f} s for {count:,} QPs{speed}"


def conclude(found: StoredMap, config: Config, output: Path, start: float) -> None:
    """Write the picture of two states and the summary, and print the table."""
    axes = found.problem.view.axes
    files = [str(found.store.path), str(output / "summary.json")]
    if len(axes) == 2:
        from jaxmpc.app.plots.feasible_set import plot_feasible_set
        from jaxmpc.app.plots.style import save

        figure = plot_feasible_set(found.bounds, picture=found.picture()).figure
        save(figure, output / "map.png", config.name)
        files.append(str(output / "map.png"))
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
    units = config.system.state_units
    unit = " " + "·".join(units[i] for i in axes) if units else ""
    total = sum(found.counts.values())
    rows = [
        (name, f"{count:>12,}  {count / total:7.2%}")
        for name, count in found.counts.items()
        if count or name in ("feasible", "infeasible", "undecided")
    ]
    rows += [
        ("compile", f"{found.timing.compile_seconds:.2f} s"),
        run_row(found),
        (f"{what} from", f"{low:.9g}{unit} (inner bound)"),
        (f"{what} to", f"{high:.9g}{unit} (outer bound, gap {high - low:.2g})"),
        ("total", f"{seconds:.2f} s with bounds and files"),
        ("files", " ".join(files)),
    ]
    print_table(rows, 12)
