"""A sweep of a linear problem: label states chunk by chunk into a store, then map and table."""

import dataclasses
import sys
import time
from functools import partial
from importlib import import_module
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
from tqdm.std import tqdm

from jaxmpc import store
from jaxmpc.app.commands.options import print_table
from jaxmpc.app.config import Config, SweepPoints, sweep_points
from jaxmpc.batches import CHUNK, Timing
from jaxmpc.checks import fail
from jaxmpc.feasible.executors import label_elsewhere
from jaxmpc.feasible.map import mesh
from jaxmpc.feasible.pipeline import Scope, label_parts
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.stored_map import StoredMap
from jaxmpc.files import check_results, open_folder, remove_files, versions, write_results
from jaxmpc.mpc.problem import MPC
from jaxmpc.store import report_damage


@dataclasses.dataclass(frozen=True)
class LinearSweep:
    """A sweep whose options are checked and whose store is open; nothing is compiled yet."""

    config: Config
    mpc: MPC
    problem: FeasibilityProblem
    region: SweepPoints
    output: Path
    store: store.Store

    @classmethod
    def open(
        cls, config: Config, output: Path, resume: bool = False, overwrite: bool = False,
        shard: tuple[int, int] | None = None, url: str | None = None,
    ) -> "LinearSweep":  # fmt: skip
        """Open a new sweep, or one to resume.

        shard: (i, n) to compute the blocks k with k mod n = i, beside other processes. url: of the
        store, None for sweep.zarr in the folder output. Raises ValueError; compiles nothing.
        """
        mpc, region = config.build_mpc(), sweep_points(config)
        path = store.location(url or output / "sweep.zarr")
        if shard is None:
            check_results(path, resume, overwrite, store.exists(path))
        elif overwrite:
            fail("--overwrite", "given beside --shard", "Delete the store before shards start")
        problem = FeasibilityProblem.of(mpc, region.axes, region.fixed)
        open_folder(output)
        # Other shards may have made the store, and one may be writing the results.
        old = () if shard else ("map.png", "summary.json")
        found = store.open_labels(
            path, problem, region.along, config.to_dict(), CHUNK, shard=shard, overwrite=overwrite,
            begun=lambda: remove_files(output, *old),
        )  # fmt: skip
        done = len(found.own) - len(found.pending())
        if shard is not None and (done or found.damaged) and not resume:
            found.close()
            what = f"holds {done:,} blocks of shard {shard[0]}/{shard[1]}"
            fail(str(path), what, "Add --resume to go on with it")
        report_damage(found)
        return cls(config, mpc, problem, region, output, found)

    def run(
        self,
        *,
        refine: bool = True,
        executor: Any = None,
        devices: int | None = None,
    ) -> None:
        """Label all states, write map and summary, print the table; close the store.

        executor: what labels the blocks, as in `map_feasible_set`; this process stores them. A
        shard labels its own, and is done unless it is the last.
        """
        with self.store:
            self._run(refine, executor, devices)

    def _run(self, refine: bool, executor: Any, devices: int | None) -> None:
        start, kept = time.perf_counter(), self.store
        part = ""
        if kept.shard is not None:
            part = f", shard {kept.shard[0]}/{kept.shard[1]}"
            part += f" with {len(kept.own):,} of {len(kept.regions):,} blocks"
        print(f"{self.config.name}: {self.region.total:,} initial states -> {self.output}{part}")
        # The compiler keeps one core busy; meanwhile another can load matplotlib.
        plots = Thread(target=import_module, args=("jaxmpc.app.plots.feasible_set",), daemon=True)
        plots.start()
        timing = self.label(executor, devices)
        speed = f", {timing.count / timing.run_seconds:,.0f} QPs/s" if timing.count else ""
        run = ("run", f"{timing.run_seconds:.2f} s for {timing.count:,} QPs{speed}")
        if why := kept.unfinished():
            print_table([run, ("left", why)], 12)
            return
        found = StoredMap.read(self.problem, kept, self.region.along)
        dimension = len(self.region.axes)
        if refine and dimension <= 3:
            print("closing the bounds by rays; long horizons take a while", file=sys.stderr)
            found, rays = found.refine()
            kept.save_bounds(rays.bound_point, rays.bound_normal, rays.bound_offset)
        files = [str(kept.path), str(self.output / "summary.json")]
        if dimension == 2:
            from jaxmpc.app.plots.feasible_set import plot_feasible_set
            from jaxmpc.app.plots.style import save

            picture = found.picture()
            figure = plot_feasible_set(found.bounds, picture=picture).figure
            save(figure, self.output / "map.png", self.config.name)
            files.append(str(self.output / "map.png"))
        low, high = found.bounds.volume_bounds()
        if low > high * (1 + 1e-9):
            what = f"its inner bound {low:.9g} exceeds its outer bound {high:.9g}"
            fail(str(self.store.path), what, "Look for damage with jaxmpc verify, or overwrite it")
        seconds = time.perf_counter() - start
        summary = {
            "name": self.config.name,
            "counts": found.counts,
            "volume": {"inner": low, "outer": high},
            "this_run": {**dataclasses.asdict(timing), "total_seconds": seconds},
            "config": self.config.to_dict(),
            "versions": versions(),
        }
        write_results(self.output / "summary.json", summary)
        what = {1: "length", 2: "area"}.get(dimension, "volume")
        units = self.config.system.state_units
        unit = " " + "·".join(units[i] for i in self.region.axes) if units else ""
        rows = [
            (name, f"{count:>12,}  {count / self.region.total:7.2%}")
            for name, count in found.counts.items()
            if count or name in ("feasible", "infeasible", "undecided")
        ]
        print_table([
            *rows,
            ("compile", f"{timing.compile_seconds:.2f} s"),
            run,
            (f"{what} from", f"{low:.9g}{unit} (inner bound)"),
            (f"{what} to", f"{high:.9g}{unit} (outer bound, gap {high - low:.2g})"),
            ("total", f"{seconds:.2f} s with bounds and files"),
            ("files", " ".join(files)),
        ], 12)  # fmt: skip

    def label(self, executor: Any = None, devices: int | None = None) -> Timing:
        """Label the blocks that are not done, and commit each."""
        todo, along, settings = self.store.pending(), self.region.along, self.config.sweep
        timing, decided, begun = Timing(), 0, time.perf_counter()
        if not todo:
            return timing
        label = label_parts if executor is None else partial(label_elsewhere, executor)
        found = label(
            self.problem, (mesh(along, self.store.samples(block)) for block in todo),
            Scope.of_grid(along, len(self.store.regions)), self.store.size,
            iterations=settings.iterations, dtype=settings.dtype, devices=devices,
        )  # fmt: skip
        total = sum(len(self.store.samples(block)) for block in todo)
        with tqdm(total=total, unit=" states", unit_scale=True, disable=None) as bar:
            for block, labels in zip(todo, found, strict=True):
                self.store.commit(block, **store.label_rows(labels))
                timing.count += len(labels.label)
                timing.compile_seconds += labels.compile_seconds
                decided += int(np.count_nonzero(labels.label))
                bar.set_postfix_str(f"{decided / timing.count:.2%} decided", refresh=False)
                bar.update(len(labels.label))
        # By the clock: blocks are computed while others are stored.
        timing.run_seconds = time.perf_counter() - begun - timing.compile_seconds
        return timing
