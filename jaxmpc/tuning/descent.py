"""Gradient descent with safeguards: the loop of all tuners, and the settings that they share.

The optimiser comes from optax. The best iterate is chosen by the loss on a validation set. Steps
that lead to numbers which are not finite are undone and halved. A checkpoint is written after each
step. An interrupt (Ctrl-C) ends the descent early, with all that it has found.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import optax
from tqdm.std import tqdm

from jaxmpc.batches import chosen_devices
from jaxmpc.checks import fail, nearest, number, shown, whole
from jaxmpc.files import fingerprint, read_arrays, remove_partial, write_arrays
from jaxmpc.pytrees import record
from jaxmpc.qp.linalg import float64_arrays

# (loss, numbers to record) and (loss, gradient, numbers to record).
Validate = Callable[[Any], tuple[float, Mapping[str, float]]]
Gradient = Callable[[Any, int], tuple[float, Any, Mapping[str, float]]]


@record
class Settings:
    """Settings of the descent of a tuner.

    updates: number of steps of the optimiser.
    optimizer: from optax; None: Adam, with the step size that suits what is tuned.
    batch: number of samples of each step, drawn again each time; None: all.
    validation: fraction of the samples in the validation set, by which the best step is chosen, or
        the samples of this set themselves.
    seed: of batches and of the validation set.
    checkpoint: file (.npz) that is replaced after every step. Where it exists the run resumes from
        it, with the same result as without interruption; it must be of the same run.
    progress: show a progress bar with the loss of the step and the best on the validation set.
    devices: a number of them, or a sequence of JAX devices, which share the samples of a step;
        None: the default device. A design loss is computed on each of them.
    """

    updates: int = 100
    optimizer: optax.GradientTransformation | None = None
    batch: int | None = None
    validation: Any = 0.25
    seed: int = 0
    checkpoint: str | Path | None = None
    progress: bool = False
    devices: Any = None

    @classmethod
    def of(cls, function: str, given: Mapping[str, Any]) -> "Settings":
        """Return the settings that a function was given; raise TypeError, in its name, for
        others."""
        known = [f.name for f in fields(cls)]  # type: ignore[arg-type]
        for word in given:
            if word not in known:
                near, rate = nearest(word, known), "a learning rate is that of an optimizer"
                raise TypeError(
                    f"{function}: there is no argument {word}. {near}Its settings are "
                    f"{', '.join(known)}; {rate}, optax.adam(0.05)"
                )
        return cls(**given)

    def validate(self) -> None:
        """Raise ValueError for a count or fraction that makes no sense, and for wrong devices."""
        chosen_devices(self.devices)
        whole("updates", self.updates, 0)
        whole("seed", self.seed, 0)
        if self.batch is not None:
            whole("batch", self.batch, 1)
        cure = "Give a fraction in (0, 1), or samples"
        if self.splits:
            number("validation", self.validation, 0, cure)
            if not 0 < float(self.validation) < 1:
                fail("validation", f"{self.validation}", cure)
        if not isinstance(self.optimizer, optax.GradientTransformation | None):
            cure = "Give one of optax, such as optax.adam(0.05)"
            fail("optimizer", f"{shown(self.optimizer)} is no optimizer", cure)

    @property
    def splits(self) -> bool:
        """Return whether `validation` is a fraction of the samples, not samples of its own."""
        return not isinstance(self.validation, tuple) and np.ndim(self.validation) == 0

    def split(self, samples: Any, least: int = 1, shuffle: bool = False) -> tuple[Any, Any]:
        """Divide samples into those for training and those for validation.

        samples: states (B, n), or a pytree (B, …) whose first leaf they are. Where `validation` is
        a fraction the last samples are for validation, at least `least` of them, or random ones
        where `shuffle`; else all are for training. Raises ValueError where none is left.
        """
        first = jax.tree.leaves(samples)[0]
        total = len(first)
        if not self.splits:
            pair = isinstance(self.validation, tuple)
            states = np.asarray(self.validation[0] if pair else self.validation, float)
            if states.ndim != 2 or states.shape[1] != first.shape[1] or not len(states):
                fail("validation", f"shape {states.shape}", f"Give states (B, {first.shape[1]})")
            if isinstance(samples, tuple):
                more = self.validation[1] if pair else {}
                return samples, (states, {name: np.asarray(v) for name, v in more.items()})
            return samples, states
        count = max(least, round(float(self.validation) * total))
        if count >= total:
            cure = "Give more: some to learn from, some for validation"
            fail("x0s", f"{total} states, {count} of them for validation", cure)
        order = np.roll(np.arange(total), count)
        if shuffle:
            order = np.random.default_rng(self.seed).permutation(total)
        part = lambda where: jax.tree.map(lambda v: v[where], samples)
        return part(order[count:]), part(order[:count])

    def decides(self, parameters: Mapping[str, Any], train: Any, test: Any) -> dict[str, Any]:
        """Return what determines a run over these samples of `split`, as JSON data."""
        size, measured = (len(jax.tree.leaves(part)[0]) for part in (train, test))
        return {
            "parameters": {name: p.record() for name, p in parameters.items()},
            "batch": min(self.batch or size, size),
            "train": size,
            "validation": measured,
            "seed": self.seed,
            "data": fingerprint(None, train, test),
        }

    def minibatch(self, total: int, step: int) -> Any:
        """Return which of `total` samples a step sees: a function of its number, so that a run can
        go on."""
        if self.batch is None or self.batch >= total:
            return slice(None)
        return np.random.default_rng([self.seed, step]).choice(total, self.batch, replace=False)


@record
class Descent:
    """The record of T steps from θ_0 to θ_T.

    theta: the θ of least validation loss; best: its number. thetas: all of them, leaves (T+1, …).
    loss, gradient_norm (T,): at θ_t on the batch of the step. accepted (T,): False where loss or
    gradient was not finite; θ_{t+1} is then the last good θ moved by half the step. validation
    (T+1,): loss of each θ on the validation set, NaN where not finite or not measured. numbers
    {name: (T,)}, validation_numbers {name: (T+1,)}: what else was measured. seconds: time taken,
    the interrupted runs that a checkpoint joins included. interrupted: whether an interrupt ended
    it before the last step.
    """

    theta: Any
    best: int
    thetas: Any
    loss: np.ndarray
    gradient_norm: np.ndarray
    accepted: np.ndarray
    validation: np.ndarray
    numbers: dict[str, np.ndarray]
    validation_numbers: dict[str, np.ndarray]
    seconds: float
    interrupted: bool = False

    @property
    def steps(self) -> int:
        """Return the number of steps T."""
        return len(self.loss)

    def measured(self, k: int) -> dict[str, float]:
        """Return loss and numbers of θ_k on the validation set."""
        numbers = {name: float(v[k]) for name, v in self.validation_numbers.items()}
        return {"loss": float(self.validation[k]), **numbers}


@dataclass(eq=False)
class State:
    """The state of the descent: all that the next step depends on, and the record so far.

    good: the last θ with a finite gradient, its gradient and the optimiser's state before it.
    fraction: of the optimiser's step that is taken, 1 until a step fails.
    """

    theta: Any
    good: tuple[Any, Any, Any] | None
    fraction: float = 1.0
    seconds: float = 0.0
    rows: list[dict[str, float]] = field(default_factory=list)
    checks: list[dict[str, float]] = field(default_factory=list)
    thetas: list[Any] = field(default_factory=list)


def descend(
    theta: Any,
    gradient: Gradient,
    validate: Validate,
    optimizer: optax.GradientTransformation,
    settings: Settings,
    decides: Any = None,
    every: int = 1,
    shown: str | None = None,
) -> Descent:
    """Minimise from θ = `theta`, a pytree of NumPy arrays, by `settings.updates` optimiser steps.

    gradient(θ, t): loss, gradient and further numbers on the batch of step t; a function of its
    arguments alone, so that an interrupted run can go on.
    validate(θ): loss and numbers on the validation set. It is called before the first step too:
    the result is the best of T + 1 iterates, never worse than the start.
    optimizer: used where settings.optimizer is None.
    decides: JSON data that determine the run, stored in the checkpoint and compared on resuming.
    every: steps from one validation to the next; the last step is validated as well.
    shown: name of a number of the best validation for the progress bar.

    A KeyboardInterrupt after the first step ends it: the result is that of the steps that are
    done. Before, there is nothing to keep, and it passes.
    Raises ValueError for a checkpoint of another run, and where θ_0 has no finite validation loss.
    """
    settings.validate()
    updates = settings.updates
    optimizer = optimizer if settings.optimizer is None else settings.optimizer
    theta = float64_arrays(theta)
    path = None if settings.checkpoint is None else Path(settings.checkpoint)
    state = State(theta, None, thetas=[theta])
    mark = fingerprint(decides, theta)
    _require_first_order(optimizer, theta)
    # In one program each, not in many small ones.
    optimizer = optax.GradientTransformation(jax.jit(optimizer.init), jax.jit(optimizer.update))
    if path is not None:
        remove_partial(path)
    if path is not None and path.exists():
        state = _load_checkpoint(path, theta, optimizer, mark)
        # Another loss or plant may have the same value at the start.
        last = max(t for t, check in enumerate(state.checks) if check)
        rounding = 1e-6 * abs(state.checks[0]["loss"])  # of sums that may be near 0 by now
        for t in dict.fromkeys((0, _best(state.checks), last)):
            before, now = state.checks[t]["loss"], _checked(validate, state.thetas[t])["loss"]
            if not np.isclose(now, before, rtol=1e-4, atol=rounding, equal_nan=True):
                problem = f"had the validation loss {before:.9g} after {t} steps, now {now:.9g}"
                cure = "Give it the same data, loss, plant and solver, or remove it"
                fail(str(path), problem, cure)
    begun = time.perf_counter()
    with tqdm(total=updates, unit=" steps", disable=not settings.progress) as bar:
        bar.set_postfix_str("compiling")
        if not state.checks:
            state.checks.append(_checked(validate, theta))
            if not np.isfinite(state.checks[0]["loss"]):
                fail("parameters", "have no finite validation loss at the start", "Start elsewhere")
            state.seconds += time.perf_counter() - begun
            _save_checkpoint(path, state, mark, decides)
        try:
            bar.update(len(state.rows))
            while len(state.rows) < updates:
                begun = time.perf_counter()
                _step(state, gradient, optimizer)
                done = len(state.rows)
                measured = done == updates or done % every == 0
                state.checks.append(_checked(validate, state.theta) if measured else {})
                state.thetas.append(state.theta)
                state.seconds += time.perf_counter() - begun
                _save_checkpoint(path, state, mark, decides)
                bar.set_postfix_str(_progress(state, shown))
                bar.update(1)
        except KeyboardInterrupt:
            if len(state.thetas) < 2:
                raise
            # The steps of which all is recorded.
            done = min(len(state.rows), len(state.checks) - 1, len(state.thetas) - 1)
            del state.rows[done:], state.checks[done + 1 :], state.thetas[done + 1 :]
            state.checks[-1] = state.checks[-1] or _checked(validate, state.thetas[-1])
            return replace(_record(state), interrupted=True)
    return _record(state)


def _best(checks: list[dict[str, float]]) -> int:
    """Return the number of the step with the least validation loss, of those that have one."""
    loss = lambda t: np.nan_to_num(checks[t]["loss"], nan=np.inf)
    return min((t for t, check in enumerate(checks) if check), key=loss)


def _progress(state: State, shown: str | None) -> str:
    """Return the loss of the last step, and of the best validation the loss and what is shown."""
    best = state.checks[_best(state.checks)]
    more = "" if shown is None else f", {shown} {best[shown]:.4g}"
    return f"loss {state.rows[-1]['loss']:.4g}, best on validation {best['loss']:.4g}{more}"


def _require_first_order(optimizer: optax.GradientTransformation, theta: Any) -> None:
    """Raise ValueError for an optimiser that needs more than a gradient."""
    zeros = jax.tree.map(np.zeros_like, theta)
    try:
        jax.eval_shape(lambda g: optimizer.update(g, optimizer.init(g), g)[0], zeros)
    except (TypeError, AttributeError) as error:
        fail("optimizer", f"does not take a gradient alone ({error})", "Such as optax.adam(0.05)")


def _step(state: State, gradient: Gradient, optimizer: optax.GradientTransformation) -> None:
    """Take a step; where the gradient is not finite undo the last step and take half of it."""
    loss, slope, numbers = gradient(state.theta, len(state.rows))
    slope = float64_arrays(slope)
    norm = float(np.sqrt(sum(np.sum(v**2) for v in jax.tree.leaves(slope))))
    accepted = bool(np.isfinite(loss) and np.isfinite(norm))
    row = {"loss": float(loss), "gradient_norm": norm, "accepted": accepted}
    state.rows.append({**row, **{name: float(value) for name, value in numbers.items()}})
    with jax.enable_x64(True):  # the optimiser's own numbers, like θ
        if accepted:
            # The optimiser's state before its update here: a step may have to be taken again.
            if state.good is None:
                before = optimizer.init(state.theta)
            else:
                good, previous, before = state.good
                before = optimizer.update(previous, before, good)[1]
            state.good = (state.theta, slope, before)
            state.fraction = min(1.0, 2 * state.fraction)
        elif state.good is None:  # the start fails on this step's data: other data may serve
            return
        else:
            state.fraction /= 2
    state.theta = _after_step(state.good, state.fraction, optimizer)


def _after_step(good: tuple[Any, Any, Any], fraction: float, optimizer: Any) -> Any:
    """Return θ after this fraction of the optimiser's step."""
    theta, slope, before = good
    with jax.enable_x64(True):
        moves, _ = optimizer.update(slope, before, theta)
    return jax.tree.map(lambda v, move: v + fraction * np.asarray(move, np.float64), theta, moves)


def _checked(validate: Validate, theta: Any) -> dict[str, float]:
    """Return loss and numbers on the validation set; a loss that is not finite becomes NaN."""
    loss, numbers = validate(theta)
    loss = float(loss) if np.isfinite(loss) else np.nan
    return {"loss": loss, **{name: float(value) for name, value in numbers.items()}}


def _record(state: State) -> Descent:
    """Return the public record of the descent."""
    column = lambda rows, name: np.array([row.get(name, np.nan) for row in rows])
    names = lambda rows, known: [
        n for n in dict.fromkeys(n for r in rows for n in r) if n not in known
    ]
    known = ("loss", "gradient_norm", "accepted")
    validation = column(state.checks, "loss")
    best = int(np.nanargmin(validation))
    return Descent(
        theta=state.thetas[best],
        best=best,
        thetas=jax.tree.map(lambda *v: np.stack(v), *state.thetas),
        loss=column(state.rows, "loss"),
        gradient_norm=column(state.rows, "gradient_norm"),
        accepted=column(state.rows, "accepted").astype(bool),
        validation=validation,
        numbers={n: column(state.rows, n) for n in names(state.rows, known)},
        validation_numbers={n: column(state.checks, n) for n in names(state.checks, ("loss",))},
        seconds=state.seconds,
    )


def _save_checkpoint(path: Path | None, state: State, mark: str, decides: Any) -> None:
    """Write the checkpoint; nothing where `path` is None."""
    if path is None:
        return
    leaves: dict[str, Any] = {
        f"good_{i}": np.asarray(v) for i, v in enumerate(jax.tree.leaves(state.good))
    }
    for k, theta in enumerate((state.theta, jax.tree.map(lambda *v: np.stack(v), *state.thetas))):
        leaves |= {f"theta_{k}_{i}": v for i, v in enumerate(jax.tree.leaves(theta))}
    plain = {
        "fingerprint": mark,
        "decides": decides,
        "fraction": state.fraction,
        "seconds": state.seconds,
        "rows": state.rows,
        "checks": state.checks,
        "moved": state.good is not None,
    }
    write_arrays(path, plain, **leaves)


def _load_checkpoint(
    path: Path, theta: Any, optimizer: optax.GradientTransformation, mark: str
) -> State:
    """Return the state of an interrupted run; raise ValueError for a file of another run."""
    kept = read_arrays(path)
    if kept is None or "fingerprint" not in (kept[0] or {}):
        fail(str(path), "is no checkpoint", "Choose another file, or remove it")
    plain, arrays = kept
    if plain["fingerprint"] != mark:
        fail(str(path), "holds a run of other settings", "Choose another file, or remove it")

    def restored(like: Any, name: str) -> Any:
        leaves, tree = jax.tree.flatten(like)
        names = [f"{name}_{i}" for i in range(len(leaves))]
        if set(names) != {n for n in arrays if n.startswith(f"{name}_")}:
            fail(str(path), "holds the state of another optimizer", "Give the one it began with")
        return jax.tree.unflatten(tree, [arrays[n] for n in names])

    every, good, count = restored(theta, "theta_1"), None, len(plain["checks"])
    if plain["moved"]:
        with jax.enable_x64(True):
            good = restored((theta, theta, optimizer.init(theta)), "good")
    state = State(
        restored(theta, "theta_0"),
        good,
        thetas=[jax.tree.map(lambda v, t=t: v[t], every) for t in range(count)],
        **{name: plain[name] for name in ("fraction", "seconds", "rows", "checks")},
    )
    if good is not None:  # the step that was taken is the one that this optimiser takes
        again = _after_step(good, state.fraction, optimizer)
        close = lambda a, b: np.allclose(a, b, rtol=1e-6, atol=1e-9)
        if not all(map(close, *map(jax.tree.leaves, (again, state.theta)))):
            fail(str(path), "holds the state of another optimizer", "Give the one it began with")
    return state
