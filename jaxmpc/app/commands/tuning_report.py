"""Output of `jaxmpc tune weights`: files, figures and the table."""

import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from jaxmpc.app import config as configs
from jaxmpc.app.commands.tuning import CHECKPOINT, TUNED
from jaxmpc.app.commands.tuning_task import TuningTask
from jaxmpc.app.plots.style import save
from jaxmpc.app.plots.tuning import plot_before_after, plot_maps, plot_tuning
from jaxmpc.feasible.map import map_feasible_set
from jaxmpc.files import versions, write_json
from jaxmpc.grids import grid
from jaxmpc.tuning.result import TuningRun

# Entries of a weight that the table shows.
SHOWN = 24


def save_results(
    command: Any, task: TuningTask, run: TuningRun, seconds: dict[str, float], begun: float
) -> str:  # fmt: skip
    """Simulate again with the written tuned.toml, write the other files, and return the table."""
    h, test = run.history, task.x0s[~task.train]
    before, after = (
        task.simulated(controller)
        for controller in (
            lambda: run.build(run.initial), lambda: task.load(command.output / TUNED)
        )
    )  # fmt: skip
    counts = [task.counted(loops, command.tolerance) for loops in (before, after)]
    trace = labelled(task, run.trace)
    rejected = int(np.sum(~h.accepted))
    result = {
        "improved": h.best > 0, "best_step": h.best, "rejected": rejected,
        "validation": [float(h.validation[0]), float(h.validation[h.best])],
        "before": counts[0], "after": counts[1],
    }  # fmt: skip
    document = {
        "name": task.name, "options": command.options(task), "finished": not h.interrupted,
        "result": result, "this_run": seconds, "states_without_plan": task.dropped,
        **run.record(), "versions": versions(),
    }  # fmt: skip
    write_json(command.output / "tuning.json", document)
    change = (
        f"validation loss {h.validation[0]:.6g} to {h.validation[h.best]:.6g} "
        f"({-100 * run.improvement:+.2f} %)"
        if h.best
        else f"no step better than the start, validation loss {h.validation[0]:.4g}"
    )
    title = f"{task.name}: {', '.join(command.tune)} tuned, {change}"
    figure = plot_tuning(h, trace, title)
    save(figure, command.output / "tuning.png")
    shown = min(6, len(test))
    title = f"{change}\n{shown} of {len(test)} validation loops, the same starts before and after"
    figure = plot_before_after(
        before, after, task.plant, reference=task.reference,
        input_reference=task.input_reference, title=f"{task.name}: {title}",
    )  # fmt: skip
    save(figure, command.output / "before_after.png")
    files = [TUNED, "tuning.json", "tuning.png", "before_after.png", CHECKPOINT]
    if task.config is not None and "tightening" in command.tune and task.plant.n == 2:
        save(maps(command, task), command.output / "maps.png", task.name)
        files.insert(4, "maps.png")
    seconds = {**seconds, "total": time.perf_counter() - begun}
    return report_text(command, task, run, result, trace, seconds, files)


def maps(command: Any, task: TuningTask) -> Any:
    """Return a figure of the feasible sets before and after tuning."""
    config = configs.load(command.output / TUNED, None, "tune")
    low, high = config.state_range()
    points = grid(low, high, (64, 64))
    found = [map_feasible_set(m, points).refine() for m in (task.mpc, config.build_mpc())]
    return plot_maps(*found)


def report_text(
    command: Any, task: TuningTask, run: TuningRun, result: dict[str, Any],
    trace: dict[str, dict[str, np.ndarray]], seconds: dict[str, float], files: list[str],
) -> str:  # fmt: skip
    """Return the result as a table of text."""
    h, (first, last) = run.history, result["validation"]
    before, after = result["before"], result["after"]
    entries = [
        (f"{group} {name}".strip(), values[0], values[h.best])
        for group, parts in trace.items()
        for name, values in parts.items()
    ]
    wide = max(13, *(len(name) for name, _, _ in entries[:SHOWN]))
    row = lambda name, a, b, more="": f"  {name:<{wide}} {a:>12} {b:>12}  {more}".rstrip()
    percent = lambda v: f"{100 * v:.2f} %"
    change = f"{-100 * run.improvement:+.2f} %" if result["improved"] else "no change"
    lines = [row("", "before", "after"), row("loss", f"{first:.6g}", f"{last:.6g}", change)]
    loops = before["loops"]
    for key, name, more in (
        ("violated", "violated", f"of {loops} loops violate a limit"),
        ("unsolved", "unsolved", f"of {before['plans']:,} plans each"),
        ("infeasible", "infeasible", "of all plans: unsolved, and proved infeasible"),
        ("fallback", "fallback", "of all plans: solved, with slack in soft limits"),
        ("at_target", "at target", f"of {loops} loops at the end"),
    ):
        lines.append(row(name, percent(before[key]), percent(after[key]), more))
    for name, a, b in entries[:SHOWN]:
        ratio = f"x {b / a:.3g}" if a else ""
        lines.append(row(name, f"{a:.5g}", f"{b:.5g}", ratio))
    if len(entries) > SHOWN:
        lines.append(f"  {'...':<{wide}} {len(entries) - SHOWN} more in {TUNED}")
    if any(p.domain == "definite" for p in task.parameters.values()):
        lines.append(f"  {'':<{wide}} of full matrices the diagonal; all of it in {TUNED}")
    if not result["improved"]:
        words = f"none of {h.steps} steps is better on the validation loops: {TUNED} is the start"
        lines.append(f"  {'result':<{wide}} {words}")
    if task.dropped:
        words = f"{task.dropped:,} initial states drawn have no plan within the limits: replaced"
        lines.append(f"  {'starts':<{wide}} {words}")
    what = f"best is {h.best} of {h.steps}; {result['rejected']} rejected as not finite"
    lines += [
        f"  {'steps':<{wide}} {what}",
        f"  {'mode':<{wide}} {run.settings['mode']}",
        f"  {'compile':<{wide}} {seconds['compile']:.1f} s",
        f"  {'run':<{wide}} {seconds['run']:.1f} s",
        f"  {'total':<{wide}} {seconds['total']:.1f} s with set-up, checks and files",
        f"  {'files':<{wide}} {' '.join(str(command.output / name) for name in files)}",
    ]
    return "\n".join(lines)


def labelled(task: TuningTask, traces: Mapping[str, Any]) -> dict[str, dict[str, np.ndarray]]:
    """Return the weights by step: group → entry → (T+1,); of matrices their diagonal."""
    if task.config is None:
        states, inputs = list(task.plant.state_names), list(task.plant.input_names)
        half = len(states) // 2
        if states[:half] == states[half:]:
            states = [*states[:half], *(f"{name} velocity" for name in states[half:])]
    else:
        system = task.plant.system
        states = list(system.state_names) or [f"x{i + 1}" for i in range(system.n)]
        inputs = list(system.input_names) or [f"u{i + 1}" for i in range(system.m)]
    found: dict[str, dict[str, np.ndarray]] = {}
    for group, trace in traces.items():
        trace = np.asarray(trace, float)
        if trace.ndim == 1:
            found[group] = {"": trace}
        else:
            names = inputs if group == "R" else states
            found[group] = {name: trace[:, i, i] for i, name in enumerate(names)}
    return found
