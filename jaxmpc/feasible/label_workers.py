"""Labels of the parts of a batch of points, for the loop of `batches.work_off`: made here, or by
workers elsewhere.

An executor is anything with the interface of `concurrent.futures`: `submit(function, *arguments)`
returns a future, whose `result()` waits. A part is labelled from what is sent with it alone, by
`label_parts`, so that no label depends on who made it.
"""

import functools
import itertools
import pickle
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, TypeVar

import numpy as np

from jaxmpc.batches import Part
from jaxmpc.checks import fail
from jaxmpc.feasible.labels import Labels
from jaxmpc.feasible.pipeline import Scope, label_parts
from jaxmpc.feasible.problem import FeasibilityProblem

# Parts that are submitted and not yet joined, at most: enough for some hundred workers.
IN_FLIGHT = 256
# How often a part is submitted again whose worker died.
RETRIES = 3

T = TypeVar("T")


def labelled_parts(
    problem: FeasibilityProblem,
    places: Sequence[T],
    points: Callable[[T], np.ndarray],
    scope: Scope,
    size: int,
    *,
    executor: Any = None,
    **settings: Any,
) -> Iterator[Part[Labels]]:
    """Label the points (b, d), b ≤ size, at each of the places, and yield the parts in order.

    executor: None to label here. settings: those of `label_parts`.
    """
    label = label_parts if executor is None else functools.partial(label_elsewhere, executor)
    found = label(problem, map(points, places), scope, size, **settings) if places else ()
    for place, labels in zip(places, found, strict=True):
        yield Part(place, len(labels.label), labels, labels.compile_seconds)


def label_elsewhere(
    executor: Any,
    problem: FeasibilityProblem,
    parts: Iterable[np.ndarray],
    scope: Scope,
    chunk: int,
    **settings: Any,
) -> Iterator[Labels]:
    """Label parts by an executor; arguments and labels are those of `label_parts`.

    A part whose future fails because its worker died is submitted again, `RETRIES` times at most,
    with a warning. Raises what `label_parts` raises, and the executor's error after the last try.
    """
    if not callable(getattr(executor, "submit", None)):
        what = f"is a {type(executor).__name__} without submit(function, *arguments)"
        fail("executor", what, "Give a concurrent.futures.Executor or the like")
    described = pickle.dumps(
        (FeasibilityProblem(problem.mpc, problem.view), scope, chunk, settings)
    )

    def submit(points: np.ndarray) -> Any:
        return executor.submit(label_part, described, points)

    parts, waiting = iter(parts), deque[tuple[Any, np.ndarray]]()
    try:
        while True:
            missing = IN_FLIGHT - len(waiting)
            waiting.extend((submit(v), v) for v in itertools.islice(parts, missing))
            if not waiting:
                return
            future, points = waiting.popleft()
            for left in reversed(range(RETRIES + 1)):
                try:
                    found = future.result()
                    break
                except Exception as error:  # the executor's: those of the labels are returned
                    if not left:
                        raise
                    what = f"no labels of {len(points):,} points came back"
                    again = f"({type(error).__name__}); they are submitted again"
                    warnings.warn(f"executor: {what} {again}", stacklevel=2)
                    future = submit(points)
            if isinstance(found, Exception):
                raise found
            yield found
    finally:
        for future, _ in waiting:
            getattr(future, "cancel", int)()


def label_part(described: bytes, points: np.ndarray) -> Labels | Exception:
    """Return the labels of one part, all in host memory, or the error that they end in."""
    try:
        problem, scope, chunk, settings = _read(described)
        (labels,) = label_parts(problem, [points], scope, chunk, **settings)
        labels.fetch()
        return labels
    except Exception as error:
        return error


@functools.lru_cache(maxsize=4)
def _read(described: bytes) -> Any:
    """Return what was pickled; a worker keeps it with all that the problem has computed."""
    return pickle.loads(described)
