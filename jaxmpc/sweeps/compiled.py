"""What the drivers of batches share: compile once a shape, timed apart; pad to few shapes."""

import time
from typing import Any

import jax
import numpy as np

from jaxmpc.checks import fail

# Points a compiled program takes at once on a CPU: a step's data stay within the cache.
CHUNK = 8192


def default_chunk() -> int:
    """Points a compiled program takes at once on the present device."""
    return CHUNK if jax.default_backend() == "cpu" else 32 * CHUNK


def gather_size(chunk: int) -> int:
    """Size of the batches in which undecided points of a chunk go on: one, so that few compile."""
    return max(chunk // 16, 64)


class Compiled:
    """A jitted function, compiled ahead once for each shape; `seconds` spent on that so far."""

    def __init__(self, function: Any) -> None:
        self.function, self.seconds = function, 0.0
        self.programs: dict[tuple[tuple[int, ...], ...], Any] = {}

    def __call__(self, *args: Any) -> Any:
        key = tuple(np.shape(leaf) for leaf in jax.tree.leaves(args))
        if key not in self.programs:
            start = time.perf_counter()
            self.programs[key] = self.function.lower(*args).compile()
            self.seconds += time.perf_counter() - start
        return jax.tree.map(np.asarray, self.programs[key](*args))


def padded(x: np.ndarray, size: int) -> np.ndarray:
    """The first row repeated up to `size` rows."""
    return np.concatenate([x, np.broadcast_to(x[:1], (size - len(x), *x.shape[1:]))])


def first_rows(tree: Any, count: int) -> Any:
    """The leaves without what `padded` added."""
    return jax.tree.map(lambda v: v[:count], tree)


def require_step_type(dtype: Any) -> None:
    """Raise unless iterates of this type are offered."""
    if np.dtype(dtype) not in (np.float32, np.float64):
        fail("dtype", f"{np.dtype(dtype)}", "Iterate in 'float32' or 'float64'")
