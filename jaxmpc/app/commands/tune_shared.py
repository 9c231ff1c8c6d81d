"""What the commands `tune weights` and `tune solver` share."""

from collections.abc import Callable, Iterable

import jax
import numpy as np
import optax

from jaxmpc.checks import fail
from jaxmpc.tuning.result import Interrupted, TuningRun

TUNED = "tuned.toml"


def optimizer_of(name: str, rate: float) -> optax.GradientTransformation:
    """Return the optimizer of optax with this name; raise ValueError unless there is one that takes
    a learning rate and needs no more than a gradient."""
    make = None if name.startswith("_") else getattr(optax, name, None)
    try:
        assert make is not None
        made = make(learning_rate=rate)
        assert isinstance(made, optax.GradientTransformation)
        jax.eval_shape(lambda v: made.update(v, made.init(v), v)[0], np.zeros(1))
    except Exception:  # any error of a function that is no such optimizer
        cure = "Give one that takes a learning rate: adam, adamw, sgd, rmsprop, lion, ..."
        fail("--optimizer", f"{name!r} is no optimizer of optax that serves here", cure)
    return made


def best_of_steps(tune: Callable[[], TuningRun]) -> TuningRun:
    """Return the run of `tune`, or that of the finished steps where Ctrl-C ends it."""
    try:
        return tune()
    except Interrupted as stop:
        print("\nstopped; writing the best of the steps that were done")
        return stop.run


def two_columns(columns: Iterable[str], more: str = "") -> str:
    """Return a row of a table that has two columns of numbers."""
    first, second = columns
    return f"{first:>12} {second:>12}  {more}".rstrip()
