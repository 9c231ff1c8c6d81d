"""TuningRun: the result of every tuner; what an interrupt leaves of it, its cache, its folder."""

import contextlib
import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import field
from pathlib import Path
from typing import Any

import numpy as np

from jaxmpc.checks import fail
from jaxmpc.files import (
    check_results,
    differences,
    open_folder,
    read_arrays,
    text_within,
    write_arrays,
    write_json,
)
from jaxmpc.mpc.problem import MPC
from jaxmpc.pytrees import record
from jaxmpc.qp.admm import ADMM
from jaxmpc.tuning.descent import Descent, Settings
from jaxmpc.tuning.parameters import Parameters, is_diagonal, trajectory

CHECKPOINT = "checkpoint.npz"
# Where the files of a run that is overwritten wait.
ASIDE = "overwritten"


@record
class TuningRun:
    """The result of a tuner: the values with the least loss on the validation set.

    values, initial: name → array, the best values and those given; equal where no step is better.
    before, after: name → number, measured on the validation set with `initial` and `values`:
        "loss", and the numbers that the tuner documents.
    improved: whether a step is better than what was given.
    settings: the settings of the run, JSON data.
    build: values → the tuned object (controller, MPC, ADMM or penalties).
    history: record of every step (`Descent`); None where the run comes from a cache.
    trace: name → values at every step (T + 1, …); empty where the run comes from a cache.
    start: number of the starting point of which it is the run, 0 for the given values. starts (S,):
        least validation loss from each of several, NaN where it was not finite; None for one.
    """

    values: dict[str, np.ndarray]
    initial: dict[str, np.ndarray]
    before: dict[str, float]
    after: dict[str, float]
    improved: bool
    settings: dict[str, Any]
    build: Callable[[Mapping[str, Any]], Any]
    history: Any = field(default=None, repr=False)
    trace: Mapping[str, np.ndarray] = field(default_factory=dict, repr=False)
    start: int = 0
    starts: np.ndarray | None = None

    @classmethod
    def of_parameters(
        cls,
        parameters: Parameters,
        history: Descent,
        settings: dict[str, Any],
        build: Callable[[Mapping[str, Any]], Any],
    ) -> "TuningRun":
        """Return the run of a descent of `parameters`, whose start is what was given."""
        initial = {name: np.asarray(p.value) for name, p in parameters.items()}
        improved, trace = history.best > 0, trajectory(parameters, history.thetas)
        return cls(
            {name: v[history.best] for name, v in trace.items()} if improved else initial,
            initial,
            history.measured(0),
            history.measured(history.best),
            improved,
            settings,
            build,
            history,
            trace,
        )

    @property
    def unmoved(self) -> list[str]:
        """Return the names whose values are the same at every step: the loss did not depend on
        them. Empty where the run comes from a cache."""
        moves = {
            name: np.ptp(np.asarray(v), axis=0) for name, v in self.trace.items() if len(v) > 1
        }
        return [name for name, move in moves.items() if not np.any(move)]

    def __repr__(self) -> str:
        """Return the loss, the values and the other numbers before and after, one a line."""
        number, best = "{:.6g}".format, ""
        if self.history is not None:
            best = f", best of {self.history.steps} steps at step {self.history.best}"
        if self.starts is not None:
            best += f" from start {self.start} of {len(self.starts)}"
        words = f"{self.improvement:.1%} less" if self.improved else "no step is better"
        loss = number(self.before["loss"]), number(self.after["loss"])
        rows = [("loss", *loss, f"{words}{best}")]
        for name in self.values:
            note = "never moved: not trained, or no derivative" if name in self.unmoved else ""
            rows.append((name, _few(self.initial[name]), _few(self.values[name]), note))
        others = [name for name in self.before if name != "loss"]
        rows += [(k, number(self.before[k]), number(self.after.get(k, np.nan)), "") for k in others]
        lines = ["TuningRun, before and after, measured on the validation set:"]
        for name, first, last, note in rows:
            line = f"  {name:<12} {first} -> {last}"
            lines.append(f"{line}  ({note})" if note else line)
        return "\n".join(lines)

    @property
    def result(self) -> Any:
        """Return the tuned object, with the values found.

        From `tune_weights` a controller, from `tune_feasible_set` an MPC, from `tune_solver`
        an ADMM.
        """
        return self.build(self.values)

    @property
    def mpc(self) -> MPC:
        """Return the MPC problem with the values found."""
        found = self.result
        return found if isinstance(found, MPC) else found.mpc

    @property
    def solver(self) -> ADMM:
        """Return the solver with the values found."""
        found = self.result
        return found if isinstance(found, ADMM) else found.solver

    @property
    def improvement(self) -> float:
        """Return the fraction by which the validation loss fell: 0.2 for 20 %."""
        first, best = self.before["loss"], self.after["loss"]
        return float((first - best) / abs(first)) if first else 0.0

    def record(self) -> dict[str, Any]:
        """Return the run as JSON data: settings, values, and the numbers of every step."""
        listed = lambda tree: {name: np.asarray(v).tolist() for name, v in tree.items()}
        column = lambda v: [float(x) if np.isfinite(x) else None for x in v]
        found = {
            "settings": self.settings,
            "initial": listed(self.initial),
            "values": listed(self.values),
            "improved": self.improved,
            "improvement": self.improvement,
            "before": self.before,
            "after": self.after,
        }
        if self.starts is not None:
            found |= {"start": self.start, "starts": column(self.starts)}
        h = self.history
        if h is None:
            return found
        return found | {
            "best_step": h.best,
            "loss": column(h.loss),
            "gradient_norm": column(h.gradient_norm),
            "accepted": h.accepted.tolist(),
            "validation": column(h.validation),
            "numbers": {name: column(v) for name, v in h.numbers.items()},
            "validation_numbers": {name: column(v) for name, v in h.validation_numbers.items()},
            "values_by_step": listed(self.trace),
            "seconds": h.seconds,
        }


def _few(value: np.ndarray) -> str:
    """Return a value as text of one line: a diagonal matrix by its diagonal, a large one by its
    shape."""
    value = np.asarray(value)
    square = value.ndim == 2 and value.shape[0] == value.shape[1] and value.size > 1
    if square and is_diagonal(value):
        return f"diag{_few(np.diag(value))}"
    if value.size > 16:
        return f"{value.dtype} {value.shape}"
    listed = np.array2string(value, precision=5, separator=", ", max_line_width=10**6)
    return listed.replace("\n", "")


class Interrupted(KeyboardInterrupt):
    """Raised by a tuner that an interrupt (Ctrl-C) ends after its first step.

    run: the `TuningRun` of the steps that were done, with the best of them as its result; of
    `trade_off` the `TradeOff` of the points that were begun. done: what was done, for the message;
    None: the steps of the run. As a KeyboardInterrupt it ends a program that does not catch it.
    """

    def __init__(self, run: Any, done: str | None = None) -> None:
        done = done or f"{run.history.steps} steps"
        super().__init__(f"stopped after {done}; the best of them: .run")
        self.run = run


def finished(run: TuningRun) -> TuningRun:
    """Return the run; raise Interrupted with it where an interrupt ended it."""
    if run.history is not None and run.history.interrupted:
        raise Interrupted(run)
    return run


def cached(
    cache: str | Path | None,
    decides: Mapping[str, Any],
    settings: Settings,
    build: Callable[[Mapping[str, Any]], Any],
    tune: Callable[[], TuningRun],
) -> TuningRun:
    """Return the run kept in the folder `cache`, else the run of `tune`, which is kept there.

    decides["fingerprint"]: names the file; a damaged one counts as absent. build: of the run.
    cache None: nothing is kept. Raises Interrupted, and keeps nothing, where an interrupt ends it.
    """
    if cache is None:
        return finished(tune())
    if settings.optimizer is not None:
        fail("cache", "given beside an optimizer, which has no fingerprint", "Leave one out")
    path = Path(cache) / f"{decides['fingerprint']}.npz"
    kept = read_arrays(path)
    if kept is not None and kept[0]:
        part = lambda key: {
            name.removeprefix(key): v for name, v in kept[1].items() if name.startswith(key)
        }
        return TuningRun(part("values_"), part("initial_"), **kept[0], build=build)
    run = finished(tune())
    trees = (("values", run.values), ("initial", run.initial))
    arrays = {f"{key}_{name}": v for key, tree in trees for name, v in tree.items()}
    plain = {name: getattr(run, name) for name in ("before", "after", "improved", "settings")}
    write_arrays(path, plain, **arrays)
    return run


@contextlib.contextmanager
def run_folder(
    folder: Path, files: tuple[str, ...], options: dict[str, Any], resume: bool, overwrite: bool
) -> Iterator[Path]:
    """Open the folder of a new run, or of one that is resumed, and give the path of its checkpoint.

    files: names in the folder; the first is the record of the run, a JSON file that holds the
    options. options: JSON data of the run.

    All files are removed, and a new record is written. Those of a run that is overwritten are put
    aside, and come back at the end, whatever ends it, unless the new run has a checkpoint. Raises
    ValueError where the folder holds a run with other options, or any run without `resume` or
    `overwrite`.
    """
    record, checkpoint = folder / files[0], folder / CHECKPOINT
    _settle(folder)
    for path in (record, checkpoint):
        check_results(path, resume, overwrite)
    if resume and record.exists():
        try:
            stored = json.loads(text_within(record))["options"]
        except (ValueError, KeyError, TypeError, RecursionError):
            fail(str(record), "holds no run", "Add --overwrite (overwrite=True) to start again")
        if changes := differences(stored, options):
            cure = "Give the same options, or --overwrite (overwrite=True)"
            fail(str(record), "; ".join(changes), cure)
    open_folder(folder)
    if overwrite:
        (folder / ASIDE).mkdir()
    for name in filter(lambda name: (folder / name).exists(), (*files, CHECKPOINT)):
        if overwrite:
            (folder / name).replace(folder / ASIDE / name)
        elif name != CHECKPOINT:  # which a resumed run reads
            (folder / name).unlink()
    write_json(record, {"options": options, "finished": False})
    try:
        yield checkpoint
    finally:
        _settle(folder)


def _settle(folder: Path) -> None:
    """Remove a run that was overwritten where the new one has a checkpoint, else bring it back."""
    aside = folder / ASIDE
    if not aside.is_dir():
        return
    if not (folder / CHECKPOINT).exists():
        for path in aside.iterdir():
            path.replace(folder / path.name)
    shutil.rmtree(aside)
