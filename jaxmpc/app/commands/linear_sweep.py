"""A sweep of a linear problem: label states chunk by chunk into a store, then map and table."""

import dataclasses
import os
import sys
import time
from importlib import import_module
from pathlib import Path
from threading import Thread

import numpy as np
from tqdm.std import tqdm

from jaxmpc.app.commands.options import (
    Timing,
    check_results,
    open_folder,
    print_table,
    report_damage,
)
from jaxmpc.app.config import Config, SweepPoints, sweep_points
from jaxmpc.checks import fail
from jaxmpc.compiled import CHUNK
from jaxmpc.feasible import store
from jaxmpc.feasible.candidates import StagePenalties
from jaxmpc.feasible.cascade import label_chunks
from jaxmpc.feasible.map import FeasibleSetMap
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.mpc.problem import MPC
from jaxmpc.runs import versions, write_json
from jaxmpc.tuning.sweep_penalties import tune_sweep_penalties


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
    def open(cls, config: Config, output: Path, resume: bool, overwrite: bool) -> "LinearSweep":
        """Open a new sweep, or one to resume. Raises ValueError; compiles nothing."""
        mpc, region = config.build_mpc(), sweep_points(config)
        path = output / "sweep.zarr"
        check_results(path, resume, overwrite)
        open_folder(output, "map.png", "summary.json")
        if path.exists() and overwrite:
            store.remove(path)
        problem = FeasibilityProblem.of(mpc, region.axes, region.fixed)
        found = store.open_labels(path, problem, region.along, config.to_dict(), CHUNK)
        report_damage(found)
        return cls(config, mpc, problem, region, output, found)

    def run(self, *, refine: bool, learn_penalties: bool, devices: int | None = None) -> None:
        """Label all states, write map and summary, print the table."""
        with self.store:
            self._run(refine, learn_penalties, devices)

    def _run(self, refine: bool, learn_penalties: bool, devices: int | None) -> None:
        start = time.perf_counter()
        print(f"{self.config.name}: {len(self.region.points):,} initial states -> {self.output}")
        # The compiler keeps one core busy; meanwhile another can load matplotlib.
        plots = Thread(target=import_module, args=("jaxmpc.app.plots.feasible_set",), daemon=True)
        plots.start()
        timing = self.label(self.penalties(devices) if learn_penalties else None, devices)
        fmap = self.map()
        dimension = len(self.region.axes)
        if refine and dimension <= 3:
            print("closing the bounds by rays; long horizons take a while", file=sys.stderr)
            fmap = fmap.refine()
            self.store.save_bounds(fmap.extra_points, fmap.extra_normals, fmap.extra_offsets)
        files = ["sweep.zarr", "summary.json"]
        if dimension == 2:
            from jaxmpc.app.plots.feasible_set import plot_feasible_set
            from jaxmpc.app.plots.style import save

            save(plot_feasible_set(fmap), self.output / "map.png")
            files.append("map.png")
        low, high = fmap.volume_bounds()
        if low > high * (1 + 1e-9):
            what = f"its inner bound {low:.9g} exceeds its outer bound {high:.9g}"
            fail(str(self.store.path), what, "Look for damage with jaxmpc verify, or overwrite it")
        seconds = time.perf_counter() - start
        summary = {
            "name": self.config.name,
            "counts": fmap.counts(),
            "volume": {"inner": low, "outer": high},
            "this_run": {**dataclasses.asdict(timing), "total_seconds": seconds},
            "config": self.config.to_dict(),
            "versions": versions(),
        }
        write_json(self.output / "summary.json", summary)
        what = {1: "length", 2: "area"}.get(dimension, "volume")
        units = self.config.system.state_units
        unit = " " + "·".join(units[i] for i in self.region.axes) if units else ""
        rows = [
            (name, f"{count:>12,}  {count / len(fmap.points):7.2%}")
            for name, count in fmap.counts().items()
            if count or name in ("feasible", "infeasible", "undecided")
        ]
        speed = f", {timing.count / timing.run_seconds:,.0f} QPs/s" if timing.count else ""
        print_table([
            *rows,
            ("compile", f"{timing.compile_seconds:.2f} s"),
            ("run", f"{timing.run_seconds:.2f} s for {timing.count:,} QPs{speed}"),
            (f"{what} from", f"{low:.9g}{unit} (inner bound)"),
            (f"{what} to", f"{high:.9g}{unit} (outer bound, gap {high - low:.2g})"),
            ("total", f"{seconds:.2f} s with bounds and files"),
            ("files", " ".join(str(self.output / name) for name in files)),
        ], 12)  # fmt: skip

    def penalties(self, devices: int | None = None) -> StagePenalties | None:
        """Return penalties learned for the problem, or cached from an earlier run.

        Raises ValueError for too few states, and where the cache folder cannot be written.
        """
        if not self.store.pending():
            return None
        start, region, settings = time.perf_counter(), self.region, self.config.sweep
        cache = cache_folder()
        try:
            found = tune_sweep_penalties(
                self.mpc, region.points, axes=region.axes, fixed=region.fixed, chunk=CHUNK,
                iterations=settings.iterations, dtype=settings.dtype, cache=cache,
                devices=devices,
            )  # fmt: skip
        except OSError as error:
            fail(str(cache), f"{error.strerror}", "Set XDG_CACHE_HOME to a folder of yours")
        first, best = found.before["decided"], found.after["decided"]
        verdict = f"{first:.2%} -> {best:.2%} decided by the first pass"
        if not found.improved:
            verdict = f"nothing better found, {best:.2%} decided by the first pass"
        print(f"penalties: {verdict}, {time.perf_counter() - start:.1f} s", file=sys.stderr)
        return found.result if found.improved else None

    def label(self, penalties: StagePenalties | None, devices: int | None = None) -> Timing:
        """Label the chunks that are not done, and commit each."""
        todo, index = self.store.batches()
        timing, decided = Timing(), 0
        if not todo:
            return timing
        region, settings = self.region, self.config.sweep
        chunks = label_chunks(
            self.problem, region.points[index.ravel()], chunk=index.shape[1],
            iterations=settings.iterations, dtype=settings.dtype, penalties=penalties,
            devices=devices,
        )  # fmt: skip
        total = sum(rows.stop - rows.start for _, rows in todo)
        with tqdm(total=total, unit=" states", unit_scale=True, disable=None) as bar:
            for (block, here), (_, labels) in zip(todo, chunks, strict=True):
                labels = labels.first(here.stop - here.start)
                self.store.commit(block, **store.label_rows(labels))
                timing.count += len(labels.label)
                timing.compile_seconds += labels.compile_seconds
                timing.run_seconds += labels.run_seconds
                decided += int(np.count_nonzero(labels.label))
                bar.set_postfix_str(f"{decided / timing.count:.2%} decided", refresh=False)
                bar.update(len(labels.label))
        return timing

    def map(self) -> FeasibleSetMap:
        """Return the map that the store holds."""
        return FeasibleSetMap.of(self.problem, self.region.points, self.store.labels())


def cache_folder() -> Path:
    """Return the folder of learned penalties, in the user's cache (XDG base directories)."""
    home = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(home) if Path(home).is_absolute() else Path.home() / ".cache") / "jaxmpc/penalties"
