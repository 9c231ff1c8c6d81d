"""What `jaxmpc tune weights` writes and prints: files, figures and the table."""

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxmpc.app import config as configs
from jaxmpc.app.commands.options import print_table
from jaxmpc.app.commands.tune_shared import TUNED, two_columns
from jaxmpc.app.commands.weight_problem import WeightProblem
from jaxmpc.app.plots.style import save
from jaxmpc.app.plots.tuning import plot_before_after, plot_maps, plot_tuning
from jaxmpc.feasible.map import map_feasible_set
from jaxmpc.files import versions, write_json
from jaxmpc.grids import grid
from jaxmpc.robots.linear_plant import LinearPlant
from jaxmpc.tuning.result import TuningRun
from jaxmpc.tuning.run_folders import CHECKPOINT
from jaxmpc.tuning.tasks import WeightTask

# Entries of a weight that the table shows.
SHOWN = 24
# Numbers of the table: name in `WeightTask.counts`, name in the table, what they are fractions of.
COUNTS = (
    ("violated", "violated", "of {loops} loops violate a limit"),
    ("unsolved", "unsolved", "of {plans:,} plans each"),
    ("infeasible", "infeasible", "of all plans: unsolved, and proved infeasible"),
    ("fallback", "fallback", "of all plans: solved, with slack in soft limits"),
    ("at_target", "at target", "of {loops} loops at the end"),
)


@dataclasses.dataclass(frozen=True, eq=False)
class WeightResults:
    """A run of `tune_weights` that is written to a folder.

    tune: what is tuned. options: of the record. tolerance: what counts as at the target.
    """

    folder: Path
    problem: WeightProblem
    run: TuningRun
    tune: tuple[str, ...]
    options: dict[str, Any]
    tolerance: float

    def save(self, seconds: dict[str, float], begun: float) -> None:
        """Write tuned.toml, simulate again with it, write the other files, print the table."""
        problem, run, h = self.problem, self.run, self.run.history
        task = problem.task
        (self.folder / TUNED).write_text(problem.write(run.values))
        before = task.simulate(lambda: run.build(run.initial))
        after = task.simulate(lambda: problem.load(self.folder / TUNED))
        counts = [task.counts(loops, self.tolerance) for loops in (before, after)]
        document = {
            "name": task.name,
            "options": self.options,
            "finished": not h.interrupted,
            "result": {
                "improved": h.best > 0,
                "best_step": h.best,
                "rejected": int(np.sum(~h.accepted)),
                "validation": [float(h.validation[0]), float(h.validation[h.best])],
                "before": counts[0],
                "after": counts[1],
            },
            "this_run": seconds,
            "states_without_plan": problem.without_plan,
            **run.record(),
            "versions": versions(),
        }
        write_json(self.folder / "tuning.json", document)
        first, last = h.validation[0], h.validation[h.best]
        change = f"no step better than the start, validation loss {first:.4g}"
        if h.best:
            change = f"validation loss {first:.6g} to {last:.6g} ({-100 * run.improvement:+.2f} %)"
        trace = labelled(task, run.trace)
        title = f"{task.name}: {', '.join(self.tune)} tuned, {change}"
        save(plot_tuning(h, trace, title), self.folder / "tuning.png")
        loops = f"{min(6, task.validation)} of {task.validation} validation loops"
        figure = plot_before_after(
            before,
            after,
            task.plant,
            reference=task.reference,
            input_reference=task.input_reference,
            title=f"{task.name}: {change}\n{loops}, the same starts before and after",
        )
        save(figure, self.folder / "before_after.png")
        files = [TUNED, "tuning.json", "tuning.png", "before_after.png", CHECKPOINT]
        if problem.config is not None and "tightening" in self.tune and task.plant.n == 2:
            self.save_maps()
            files.insert(4, "maps.png")
        seconds = {**seconds, "total": time.perf_counter() - begun}
        self.print(trace, counts, seconds, files)

    def save_maps(self) -> None:
        """Draw the feasible sets before and after tuning."""
        config = configs.load(self.folder / TUNED, None, "tune")
        points = grid(*config.state_range(), (64, 64))
        mpcs = self.problem.task.mpc, config.build_mpc()
        figure = plot_maps(*(map_feasible_set(mpc, points).refine() for mpc in mpcs))
        save(figure, self.folder / "maps.png", config.name)

    def print(
        self,
        trace: Mapping[str, Mapping[str, np.ndarray]],
        counts: list[dict[str, float]],
        seconds: Mapping[str, float],
        files: list[str],
    ) -> None:
        """Print the result as a table."""
        run, h = self.run, self.run.history
        entries = [
            (f"{group} {name}".strip(), values[0], values[h.best])
            for group, parts in trace.items()
            for name, values in parts.items()
        ]
        first, last = h.validation[0], h.validation[h.best]
        change = f"{-100 * run.improvement:+.2f} %" if h.best else "no change"
        rows = [
            ("", two_columns(("before", "after"))),
            ("loss", two_columns((f"{first:.6g}", f"{last:.6g}"), change)),
        ]
        for key, name, of in COUNTS:
            shares = (f"{100 * numbers[key]:.2f} %" for numbers in counts)
            rows.append((name, two_columns(shares, of.format(**counts[0]))))
        for name, a, b in entries[:SHOWN]:
            ratio = f"x {b / a:.3g}" if a else ""
            rows.append((name, two_columns((f"{a:.5g}", f"{b:.5g}"), ratio)))
        if len(entries) > SHOWN:
            rows.append(("...", f"{len(entries) - SHOWN} more in {TUNED}"))
        if any(p.domain == "definite" for p in self.problem.task.parameters.values()):
            rows.append(("", f"of full matrices the diagonal; all of it in {TUNED}"))
        if not h.best:
            what = f"none of {h.steps} steps is better on the validation loops"
            rows.append(("result", f"{what}: {TUNED} is the start"))
        if self.problem.without_plan:
            what = "initial states drawn have no plan within the limits: replaced"
            rows.append(("starts", f"{self.problem.without_plan:,} {what}"))
        rejected = np.sum(~h.accepted)
        rows += [
            ("steps", f"best is {h.best} of {h.steps}; {rejected} rejected as not finite"),
            ("mode", run.settings["mode"]),
            ("compile", f"{seconds['compile']:.1f} s"),
            ("run", f"{seconds['run']:.1f} s"),
            ("total", f"{seconds['total']:.1f} s with set-up, checks and files"),
            ("files", " ".join(str(self.folder / name) for name in files)),
        ]
        print_table(rows, max(13, *(len(name) for name, _, _ in entries[:SHOWN])))


def labelled(
    task: WeightTask, traces: Mapping[str, np.ndarray]
) -> dict[str, dict[str, np.ndarray]]:
    """Return the weights by step: group → entry → (T+1,); of matrices their diagonal."""
    plant = task.plant
    if isinstance(plant, LinearPlant):
        states = list(plant.system.state_names) or [f"x{i + 1}" for i in range(plant.n)]
        inputs = list(plant.system.input_names) or [f"u{i + 1}" for i in range(plant.m)]
    else:
        states, inputs, half = list(plant.state_names), list(plant.input_names), plant.n // 2
        if states[:half] == states[half:]:
            states = [*states[:half], *(f"{name} velocity" for name in states[half:])]
    found: dict[str, dict[str, np.ndarray]] = {}
    for group, values in traces.items():
        trace = np.asarray(values, float)
        names = [] if trace.ndim == 1 else inputs if group == "R" else states
        found[group] = {name: trace[:, i, i] for i, name in enumerate(names)} or {"": trace}
    return found
