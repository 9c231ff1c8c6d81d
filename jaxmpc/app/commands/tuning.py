"""Helpers of `jaxmpc tune weights` and `tune solver`: optimizer, initial states, folder."""

import contextlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import optax

from jaxmpc.app import config as configs
from jaxmpc.app.commands.options import given_options
from jaxmpc.checks import fail
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.files import check_results, differences, open_folder, text_within, write_json
from jaxmpc.mpc.inequalities import Inequalities
from jaxmpc.mpc.problem import MPC
from jaxmpc.sets.lp import Program
from jaxmpc.sets.polytope import Polytope

CHECKPOINT = "checkpoint.npz"
# Where the files of a run that is overwritten wait.
ASIDE = "overwritten"
TUNED = "tuned.toml"
# The most random states that are drawn for each state wanted.
TRIES = 10


def optimizer_of(name: str, rate: float, tried: Any = None) -> optax.GradientTransformation:
    """Return the optimizer of optax with this name; raise ValueError where there is none."""
    cure = "Give one that takes a learning rate: adam, adamw, sgd, rmsprop, lion, ..."
    make = None if name.startswith("_") else getattr(optax, name, None)
    try:
        assert make is not None
        made = make(learning_rate=rate)
        assert isinstance(made, optax.GradientTransformation)
        if tried is not None:
            jax.eval_shape(lambda v: made.update(v, made.init(v), v)[0], tried)
    except Exception:  # any error of a function that is no such optimizer
        fail("--optimizer", f"{name!r} is no optimizer of optax that serves here", cure)
    return made


def check_validation(command: Any) -> None:
    """Raise ValueError unless --validation lies in (0, 1)."""
    if not 0 < command.validation < 1:
        fail("--validation", f"{command.validation}", "Give a fraction above 0 and below 1")


def problem_file(command: Any) -> configs.Config:
    """Return the problem of --config, or the built-in joint, with --horizon and --terminal."""
    return configs.load(command.config, given_options(command, "horizon", "terminal"), "tune")


def start_range(
    config: configs.Config, lower: Any, upper: Any, fraction: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of the initial states: as given, else this fraction of the state limits."""
    low, high = config.state_range()
    n = len(low)
    for name, given in (("--lower", lower), ("--upper", upper)):
        if given is not None and len(given) != n:
            fail(name, f"has {len(given)} numbers", f"The problem has {n} states")
    middle, half = (high + low) / 2, (high - low) / 2
    bounded = np.isfinite(half)
    middle, half = np.where(bounded, middle, np.nan), np.where(bounded, half, np.nan)
    low = middle - fraction * half if lower is None else np.array(lower)
    high = middle + fraction * half if upper is None else np.array(upper)
    if not np.all(np.isfinite([low, high])):
        fail("--lower, --upper", "the state limits do not bound all states", "Give both ends")
    if np.any(low >= high):
        fail("--lower", f"{low.tolist()} not below upper {high.tolist()}", "Lower must be below")
    return low, high


def feasible_states(
    mpc: MPC, limits: Any, lower: np.ndarray, upper: np.ndarray, count: int, seed: int
) -> tuple[np.ndarray, int]:
    """Return uniform states (count, n) within limits that have a plan, and how many had none.

    Linear programs decide whether a state has a plan, without compiling: all hard rows are linear
    but those of an ellipsoidal terminal set, which are left out.
    """
    rows = Inequalities.of(FeasibilityProblem.of(mpc).condensed)
    random, dropped = np.random.default_rng(seed), 0
    found: list[np.ndarray] = []
    for _ in range(TRIES * count):
        x = random.uniform(lower, upper)
        if isinstance(limits, Polytope) and np.any(np.asarray(limits.H) @ x > np.asarray(limits.h)):
            continue
        b = rows.b - rows.D @ np.pad(x, (0, rows.D.shape[1] - len(x)))
        if len(b) and Program(rows.C, b).empty:
            dropped += 1
            continue
        found.append(x)
        if len(found) == count:
            return np.array(found), dropped
    cure = "Draw from a smaller region: --spread, --lower, --upper"
    fail("initial states", f"{len(found)} of {TRIES * count} drawn have a plan", cure)


@contextlib.contextmanager
def overwriting(folder: Path) -> Iterator[None]:
    """Keep a run that is overwritten until the new one has a checkpoint, whatever ends it."""
    try:
        yield
    finally:
        settle(folder)


def settle(folder: Path) -> None:
    """Remove a run that was overwritten where the new one has a checkpoint, else bring it back."""
    aside = folder / ASIDE
    if not aside.is_dir():
        return
    if not (folder / CHECKPOINT).exists():
        for path in aside.iterdir():
            path.replace(folder / path.name)
    shutil.rmtree(aside)


def open_run(
    folder: Path, files: tuple[str, ...], options: dict[str, Any], resume: bool, overwrite: bool
) -> None:
    """Open the folder of a new run, or of one that is resumed with the same options.

    files[0] is the record of the run, a JSON file that holds the options. All files are removed,
    those of a run that is overwritten put aside (`overwriting`), and a new record is written.
    Raises ValueError where the folder holds a run with other options, or any run without `resume`
    or `overwrite`.
    """
    record = folder / files[0]
    settle(folder)
    for path in (record, folder / CHECKPOINT):
        check_results(path, resume, overwrite)
    if resume and record.exists():
        try:
            stored = json.loads(text_within(record))["options"]
        except (ValueError, KeyError, TypeError, RecursionError):
            fail(str(record), "holds no run", "Add --overwrite to start again")
        if changes := differences(stored, options):
            fail(str(record), "; ".join(changes), "Give the same options, or --overwrite")
    open_folder(folder)
    if overwrite:
        (folder / ASIDE).mkdir()
    for name in filter(lambda name: (folder / name).exists(), (*files, CHECKPOINT)):
        if overwrite:
            (folder / name).replace(folder / ASIDE / name)
        elif name != CHECKPOINT:  # which a resumed run reads
            (folder / name).unlink()
    write_json(record, {"options": options, "finished": False})
