"""Settings: the keyword arguments that all tuners share, and how they divide their samples."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
import optax

from jaxmpc.batches import chosen_devices
from jaxmpc.checks import fail, whole
from jaxmpc.pytrees import record


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

    def validate(self) -> None:
        """Raise ValueError for a count or fraction that makes no sense, and for wrong devices."""
        chosen_devices(self.devices)
        whole("updates", self.updates, 0)
        whole("seed", self.seed, 0)
        if self.batch is not None:
            whole("batch", self.batch, 1)
        if self.splits and not 0 < float(self.validation) < 1:
            fail("validation", f"{self.validation}", "Give a fraction in (0, 1), or samples")

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

    def minibatch(self, total: int, step: int) -> Any:
        """Return which of `total` samples a step sees: a function of its number, so that a run can
        go on."""
        if self.batch is None or self.batch >= total:
            return slice(None)
        return np.random.default_rng([self.seed, step]).choice(total, self.batch, replace=False)
