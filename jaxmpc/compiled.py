"""What the drivers of batches share: compile once a shape, timed apart; pad to few shapes."""

import os
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, ClassVar

import jax
import numpy as np

from jaxmpc.checks import fail

# Points a compiled program takes at once on a CPU: a step's data stay within the cache.
CHUNK = 8192


def default_chunk() -> int:
    """Points a compiled program takes at once on the present device."""
    return CHUNK if jax.default_backend() == "cpu" else 32 * CHUNK


def cores() -> int:
    """Return the number of cores that this process may use."""
    # Linux knows which.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def workers() -> int:
    """Return how many chunks to run side by side: one a core of a CPU, whose programs use little
    more than one, for most of their steps are too small to be divided; one on other devices."""
    return cores() if jax.default_backend() == "cpu" else 1


def side_by_side(
    call: Callable[[Any], Any], items: Iterable[Any], count: int | None = None
) -> list[Any]:
    """Return [call(item) for item in items], `count` at once, by default as many as `workers`.

    `call` runs in threads of its own, which see none of the caller's JAX contexts.
    """
    items, count = list(items), workers() if count is None else count
    if min(count, len(items)) < 2:
        return [call(item) for item in items]
    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(call, items))


def gather_size(chunk: int) -> int:
    """Size of the batches in which undecided points of a chunk go on: one, so that few compile."""
    return max(chunk // 16, 64)


class Compiled:
    """A jitted function, compiled ahead once for each shape. `Compiled.seconds`: spent on that
    in this process so far. `Compiled.listeners`: called after each program.
    """

    seconds = 0.0
    listeners: ClassVar[list[Callable[[], None]]] = []
    everyone: ClassVar["weakref.WeakSet[Compiled]"] = weakref.WeakSet()

    def __init__(self, function: Any, places: Any = None) -> None:
        self.function = function
        self.places = places
        self.programs: dict[Any, Any] = {}
        self._compiles = threading.Lock()
        self.everyone.add(self)

    def __call__(self, *args: Any) -> Any:
        return jax.device_get(self.run(*args))

    def run(self, *args: Any) -> Any:
        """The result, left on the device."""
        args = self.placed(args)
        return self.program(*args)(*args)

    def placed(self, args: tuple) -> tuple:
        """The arguments where `places`, one sharding of each, says; None leaves it to JAX, which
        refuses to divide host arrays among devices under `jax.distributed`."""
        return args if self.places is None else jax.device_put(args, self.places)

    def program(self, *args: Any) -> Any:
        """The program for arguments of these shapes."""
        args = self.placed(args)
        leaves, tree = jax.tree.flatten(args)
        key = tree, tuple(jax.typeof(leaf) for leaf in leaves)
        with self._compiles:  # threads that need the same program wait for one of them
            if key not in self.programs:
                start = time.perf_counter()
                self.programs[key] = self.function.lower(*args).compile()
                Compiled.seconds += time.perf_counter() - start
                for listener in Compiled.listeners:
                    listener()
        return self.programs[key]


def clear_programs() -> None:
    """Free all programs of this process, those of JAX's own caches too. What is called again
    compiles again."""
    for each in list(Compiled.everyone):
        with each._compiles:
            each.programs.clear()
    jax.clear_caches()


def padded(x: np.ndarray, size: int) -> np.ndarray:
    """The first row repeated up to `size` rows."""
    return np.concatenate([x, np.broadcast_to(x[:1], (size - len(x), *x.shape[1:]))])


def first_rows(tree: Any, count: int) -> Any:
    """The leaves without what `padded` added."""
    return jax.tree.map(lambda v: v[:count], tree)


def joined(parts: Sequence[Any]) -> Any:
    """The host arrays of pytrees one after the other, copied by as many threads as there are cores:
    a single one is slower than a fast device."""
    ends = np.cumsum([len(jax.tree.leaves(part)[0]) for part in parts])
    whole = jax.tree.map(lambda v: np.empty((ends[-1], *v.shape[1:]), v.dtype), parts[0])

    def put(end: int, part: Any) -> None:
        for out, v in zip(jax.tree.leaves(whole), jax.tree.leaves(part), strict=True):
            out[end - len(v) : end] = v

    side_by_side(lambda pair: put(*pair), zip(ends, parts, strict=True), cores())
    return whole


def require_step_type(dtype: Any) -> None:
    """Raise unless iterates of this type are offered."""
    try:
        known = np.dtype(dtype) in (np.float32, np.float64)
    except TypeError:
        known = False
    if not known:
        fail("dtype", f"{dtype!r}", "Iterate in 'float32' or 'float64'")
