"""The pipeline of stages that labels points, part by part. A point goes through them in this order
until it is decided:

    hull                   in the hull of proved points, or beyond a half-space; then the roll-out
                           of its plan. Only where so many points are worth the rays (`hull_for`)
    ADMM, Newton           `iterations` steps, then Newton steps on what they leave undecided
    longer ADMM, Newton    the same with `LONGER` times as many steps, in float64
    linear programs        up to three for each of the last `MOST_PROGRAMS` points of all parts

The first of them takes a whole part on the device (`Pipeline.begin`), the others batches of what is
left (`Pipeline.stages`, `by_programs`).

The labels and proofs of a part depend on its own points, on the shape of a part and on the `Scope`
of all points, not on which other parts a process has labelled: any split among processes gives the
same bits.
"""

import functools
import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxmpc.batches import (
    Compiled,
    chosen_devices,
    count,
    divisible,
    gather_size,
    padded,
    placement,
)
from jaxmpc.checks import fail, require_step_type
from jaxmpc.feasible.candidate_search import compiled_admm, compiled_check, compiled_newton
from jaxmpc.feasible.hull_labels import compiled_labels, compiled_verdicts, hull_for
from jaxmpc.feasible.labels import Labels, OnDemand
from jaxmpc.feasible.orthonormal_rows import ConstraintRows
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.proofs import Verdict
from jaxmpc.feasible.row_lps import RowPrograms
from jaxmpc.pytrees import record

# Steps of the longer ADMM run, relative to the first, on points that Newton leaves undecided.
LONGER = 20
# Points that get linear programs, the first of each part in order: so many in all parts, each with
# an equal share, and no more than these entries of their matrices in total. 10,000 entries take
# some tens of milliseconds.
MOST_PROGRAMS, MOST_ENTRIES = 2000, 2 * 10**7
# Proofs of up to so many bytes in total stay on the device until they are used.
ON_DEVICE = 2**31
# Number of points from which their typical size is taken.
SAMPLE = 4096


@record
class Scope:
    """What the labels of a part take from all points together.

    largest, typical (d,): the largest and the median |θ|. parts: their number, which share the
    linear programs.
    """

    largest: np.ndarray
    typical: np.ndarray
    parts: int

    @classmethod
    def of(cls, points: np.ndarray, parts: int) -> "Scope":
        """Return the scope of points (B, d), of which some may not be finite."""
        # Column by column: reductions along rows of few entries are slow.
        usable = functools.reduce(np.logical_and, map(np.isfinite, points.T))
        extent = np.array([np.max(np.abs(v), where=usable, initial=0.0) for v in points.T])
        sample = points[:: max(1, len(points) // SAMPLE)]
        sample = np.abs(sample[np.all(np.isfinite(sample), axis=1)])
        size = np.median(sample, axis=0) if len(sample) else np.zeros(points.shape[1])
        return cls(extent, size, parts)

    @classmethod
    def of_grid(cls, lines: Sequence[np.ndarray], parts: int) -> "Scope":
        """Return the scope of the grid with these d coordinates."""
        sizes = [np.abs(line) for line in lines]
        largest, typical = (np.array([f(v) for v in sizes]) for f in (np.max, np.median))
        return cls(largest, typical, parts)


class BegunPart(NamedTuple):
    """A part as programs take it: points (whole, d), zeros where they are not usable, of which the
    first `size` are the part's; found: what the first stage has left on the device."""

    points: np.ndarray
    usable: np.ndarray
    size: int
    found: Any


class Stage(NamedTuple):
    """A stage for points that are undecided: its name, and points (batch, d) → labels."""

    name: str
    label: Callable[[np.ndarray], Labels]


class Pipeline:
    """The stages for parts of up to `chunk` points of one problem, compiled for these sizes.

    Of a part that a stage leaves undecided points are gathered in batches of one size.
    """

    def __init__(
        self,
        problem: FeasibilityProblem,
        scope: Scope,
        chunk: int,
        iterations: int = 50,
        dtype: Any = "float32",
        devices: Any = None,
    ) -> None:
        """Check the settings, choose the programs, and put the data of the problem on the devices.

        Sends the rays of the hull if it is worth them. Raises ValueError for wrong settings.
        """
        if iterations < 1:
            fail("iterations", f"{iterations}", "Give a count of at least 1")
        require_step_type(dtype)
        self.devices = chosen_devices(devices)
        self.problem, self.scope = problem, scope
        exact = problem.exact(scope.largest, scope.typical)
        self.margins = problem.row_margins(exact, scope.typical)
        programs = min(MOST_PROGRAMS, MOST_ENTRIES // max(problem.rows.U.size, 1))
        self.share = -(-programs // max(scope.parts, 1))
        self.whole = divisible(chunk, self.devices)  # the chunk as the devices share it
        each = gather_size(self.whole // count(self.devices))
        self.batch = count(self.devices) * each
        self.short = compiled_admm(iterations, np.dtype(dtype), self.devices)
        self.long = compiled_admm(LONGER * iterations, np.dtype(np.float64), self.devices)
        self.newton = compiled_newton(each, self.devices)
        data = exact, problem.rows, hull_for(problem, scope.parts * chunk)
        with jax.enable_x64(True):
            self.exact, self.rows, self.hull = jax.device_put(data, placement(self.devices))

    @property
    def stages(self) -> list[Stage]:
        """Return the stages after the first one in their order, but for the linear programs that
        come last."""
        longer = Stage("longer ADMM, Newton", functools.partial(self.by_admm, self.long))
        if self.hull is None:
            return [longer]
        return [
            Stage("roll-out of the hull's plans", self.by_hull),
            Stage("ADMM, Newton", functools.partial(self.by_admm, self.short)),
            longer,
        ]

    def begin(self, points: np.ndarray) -> BegunPart:
        """Start the first stage of points (b, d), b ≤ chunk, on the device, and return at once."""
        x = padded(points, self.whole)
        usable = np.all(np.isfinite(x), axis=1)
        x = np.where(usable[:, None], x, 0.0)
        if self.hull is not None:
            found = _run(compiled_labels(self.devices), self.hull, x)
        else:
            found = _run(self.short, self.exact, self.rows, x)
        return BegunPart(x, usable, len(points), found)

    def finish(self, part: BegunPart) -> Labels:
        """Return the labels of a part, by all stages."""
        if self.hull is None:
            labels = self.by_newton(part.points, part.usable, part.found)
        else:
            verdict = OnDemand(functools.partial(self.hull_verdict, part.points))
            labels = Labels.proved(part.found, verdict.get, part.usable)
        for stage in self.stages:
            left = np.flatnonzero((labels.label == 0) & part.usable)
            for where in self.batches(left):
                more = stage.label(padded(part.points[where], self.batch)).first(len(where))
                labels = labels.changed(where, more.label, more.status, more.proofs)
        left = np.flatnonzero((labels.label == 0) & part.usable)[: self.share]
        labels = self.by_programs(labels, part.points, left) if len(left) else labels
        return labels.first(part.size)

    def batches(self, index: np.ndarray) -> Iterator[np.ndarray]:
        """Yield indices in batches of one size at most."""
        for first in range(0, len(index), self.batch):
            yield index[first : first + self.batch]

    def hull_verdict(self, points: np.ndarray) -> Verdict:
        """Return the verdicts of the hull on points, with their proofs."""
        with jax.enable_x64(True):
            return _run(compiled_verdicts(self.devices), self.exact, self.hull, points)

    def by_hull(self, points: np.ndarray) -> Labels:
        """Return the labels of points by roll-outs of the plans that the hull gives them."""
        return decided(self.hull_verdict(points))

    def by_admm(self, admm: Compiled, points: np.ndarray) -> Labels:
        """Return the labels of points by steps of ADMM and of Newton."""
        found = _run(admm, self.exact, self.rows, points)
        return self.by_newton(points, np.ones(len(points), bool), found)

    def by_newton(
        self, points: np.ndarray, usable: np.ndarray, found: tuple[Verdict, Any]
    ) -> Labels:
        """Return the labels after Newton steps from the w of an ADMM stage, if it left any usable
        point undecided."""
        verdict, w = found
        labels = decided(verdict, usable)
        if np.any((labels.label == 0) & usable):
            verdict = _run(self.newton, self.exact, self.rows, points, usable, verdict, w)
            labels = decided(verdict, usable)
        return labels

    def by_programs(self, labels: Labels, points: np.ndarray, last: np.ndarray) -> Labels:
        """Return the labels where linear programs have looked for proofs of points[last]."""
        check = compiled_check(self.devices)
        for rows, program in last_programs(self.problem, self.margins):
            last = last[labels.label[last] == 0]
            for where in self.batches(last):
                solved = [program(theta) for theta in points[where]]
                candidates = [padded(np.array(v), self.batch) for v in zip(*solved, strict=True)]
                x = padded(points[where], self.batch)
                more = decided(_run(check, self.exact, rows, x, *candidates)).first(len(where))
                labels = labels.changed(where, more.label, more.status, more.proofs)
        return labels


def decided(verdict: Verdict, usable: np.ndarray | None = None) -> Labels:
    """Return the labels of a verdict; usable: which points are, None for all."""
    usable = np.ones(len(verdict.label), bool) if usable is None else usable
    return Labels.proved(verdict.label, lambda: verdict, usable)


def label_parts(
    problem: FeasibilityProblem,
    parts: Iterable[np.ndarray],
    scope: Scope,
    chunk: int,
    **settings: Any,
) -> Iterator[Labels]:
    """Label parts, each an array of up to `chunk` points (b, d), in compiled programs for `chunk`;
    yield their Labels in order. The next part is taken before the labels of one are yielded.

    settings: iterations, dtype, devices, see `map_feasible_set`.
    """
    begun, compiled = time.perf_counter(), Compiled.seconds
    pipeline = Pipeline(problem, scope, chunk, **settings)
    waiting = None
    for points in itertools.chain(parts, [None]):
        with jax.enable_x64(True):
            ahead = None if points is None else pipeline.begin(points)
            if waiting is None:
                waiting = ahead
                continue
            labels = pipeline.finish(waiting)
            size = sum(v.nbytes for v in jax.tree.leaves(waiting.found))
            if scope.parts * size > ON_DEVICE:
                labels.fetch()
        compile_seconds = Compiled.seconds - compiled
        run_seconds = time.perf_counter() - begun - compile_seconds
        yield replace(labels, compile_seconds=compile_seconds, run_seconds=run_seconds)
        begun, compiled, waiting = time.perf_counter(), Compiled.seconds, ahead


# θ (d,) → candidates for proofs: w (k,) and multipliers (R,).
LinearProgram = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def last_programs(
    problem: FeasibilityProblem, margins: np.ndarray
) -> Iterator[tuple[ConstraintRows, LinearProgram]]:
    """Yield linear programs for the last undecided points, with the rows of their candidates.

    First the ray from the centre through θ: inside, θ lies between the centre and the ray's end,
    and so do their plans; outside, the end's multipliers are few. Where the plant is unstable the
    ray again, for multipliers in the units of its growth. Then the largest margin at θ. Tangents to
    a ball that the programs keep are those of this part's points.
    """
    found = RowPrograms(problem.rows)
    try:
        center, w_center = found.center()
    except ValueError:  # flat or empty: no rays
        center = None

    if center is not None:

        def end(programs: RowPrograms, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            return programs.ray(center, theta - center)[1:]

        def between(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            t, w, y = found.ray(center, theta - center)
            return (w_center + (w - w_center) / t if 1 <= t < np.inf else w), y

        yield problem.rows, between
        for rows in problem.weighted_rows:
            yield rows, functools.partial(end, RowPrograms(rows))
    yield problem.rows, functools.partial(found.margin, size=margins)


def _run(program: Compiled, *args: Any) -> Any:
    """Run the program and leave its result on the device."""
    return program.run(*args)
