"""The cascade that labels points, part by part: ADMM on all, Newton on those undecided, and a
linear program or three for each of the last, up to `MOST_PROGRAMS` points of all parts together.

The labels and proofs of a part depend on its own points, on the shape of a part and on the `Scope`
of all points, not on which other parts a process has labelled: any split among processes gives the
same bits.
"""

import functools
import itertools
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.batches import (
    Compiled,
    chosen_devices,
    count,
    default_chunk,
    divisible,
    gather_size,
    padded,
    placement,
    require_partitioner,
)
from jaxmpc.checks import fail, require_step_type
from jaxmpc.feasible.candidates import (
    ALPHA,
    StagePenalties,
    compiled_admm,
    compiled_check,
    compiled_newton,
)
from jaxmpc.feasible.constraint_rows import ConstraintRows, weighted
from jaxmpc.feasible.hull import compiled_labels, compiled_plans, cones_for
from jaxmpc.feasible.labels import Labels, OnDemand
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.proofs import Verdict
from jaxmpc.feasible.row_programs import RowPrograms
from jaxmpc.pytrees import record
from jaxmpc.qp.precision import matmul

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


def label_chunks(
    problem: FeasibilityProblem, points: Any, *, chunk: int | None = None,
    scope: Scope | None = None, label: Callable[..., Iterator[Labels]] | None = None,
    **settings: Any,
) -> Iterator[tuple[slice, Labels]]:  # fmt: skip
    """Label points chunk by chunk; yield (slice of the points, Labels). See `map_feasible_set`.

    scope: None for that of these points. label: what labels the chunks, None for `label_parts`;
    settings: further ones of it.
    """
    d = problem.dimension
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != d:
        fail("x0s", f"shape {points.shape}", f"Give points (B, {d}), one column a mapped state")
    if chunk is None:
        chunk = count(chosen_devices(settings.get("devices"))) * default_chunk()
    if chunk < 1:
        fail("chunk", f"{chunk}", "Give a count of at least 1")
    chunk = min(chunk, max(len(points), 1))
    slices = [slice(i, min(i + chunk, len(points))) for i in range(0, len(points), chunk)]
    scope = Scope.of(points, len(slices)) if scope is None else scope
    parts = (points[here] for here in slices)
    found = (label or label_parts)(problem, parts, scope, chunk, **settings)
    yield from zip(slices, found, strict=True)


def label_parts(
    problem: FeasibilityProblem, parts: Iterable[np.ndarray], scope: Scope, chunk: int, *,
    iterations: int = 50, dtype: Any = "float32", penalties: StagePenalties | None = None,
    devices: Any = None,
) -> Iterator[Labels]:  # fmt: skip
    """Label parts, each an array of up to `chunk` points (b, d), in compiled programs for `chunk`;
    yield their Labels in order. The next part is taken before the labels of one are yielded."""
    if iterations < 1:
        fail("iterations", f"{iterations}", "Give a count of at least 1")
    require_step_type(dtype)
    devices = chosen_devices(devices)
    require_partitioner(devices)
    quick, back, alpha = _penalised(problem.rows, penalties)
    exact = problem.exact(scope.largest, scope.typical)
    margins = problem.row_margins(exact, scope.typical)
    programs = min(MOST_PROGRAMS, MOST_ENTRIES // max(problem.rows.U.size, 1))
    share = -(-programs // max(scope.parts, 1))
    whole = divisible(chunk, devices)  # the chunk as the devices share it
    batch = count(devices) * (each := gather_size(whole // count(devices)))
    all_ = np.ones(batch, bool)
    short, long = (
        compiled_admm(iterations, np.dtype(dtype), devices),
        compiled_admm(LONGER * iterations, np.dtype(np.float64), devices),
    )
    newton, check = compiled_newton(each, devices), compiled_check(devices)
    with jax.enable_x64(True):
        exact, rows, quick = jax.device_put((exact, problem.rows, quick), placement(devices))

    begun, compiled = time.perf_counter(), Compiled.seconds
    cones = cones_for(problem, scope.parts * chunk)
    if cones is not None:
        with jax.enable_x64(True):
            cones = jax.device_put(cones, placement(devices))

    def started(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, Any]:
        """Return a part, which of it is usable, and the first stage, which the device still works
        on: labels from cones, or verdicts and the last w from ADMM."""
        x = padded(points, whole)
        ok = np.all(np.isfinite(x), axis=1)
        x = np.where(ok[:, None], x, 0.0)
        if cones is not None:
            return x, ok, _run(compiled_labels(devices), cones, x)
        return x, ok, _run(short, exact, quick, x, alpha)

    def planned(x: np.ndarray) -> Verdict:
        """Return the verdicts of the cones on points, with their proofs."""
        with jax.enable_x64(True):
            return _run(compiled_plans(devices), exact, cones, x)

    def decided(verdict: Verdict, ok: np.ndarray) -> Labels:
        """Return the labels of a verdict; ok: which points are usable."""
        return Labels.proved(verdict.label, lambda: verdict, ok)

    def by_newton(
        x: np.ndarray, ok: np.ndarray, found: tuple[Verdict, Any], back: np.ndarray | None
    ) -> Labels:
        """Return the labels after Newton from the w of an ADMM stage, if it left a point open."""
        verdict, w = found
        labels = decided(verdict, ok)
        if np.any((labels.label == 0) & ok):
            w = w if back is None else matmul(w.astype(np.float64), jnp.asarray(back.T))
            labels = decided(_run(newton, exact, rows, x, ok, verdict, w), ok)
        return labels

    def by_admm(
        stage: Compiled, basis: Any, relaxation: Any, to_rows: np.ndarray | None
    ) -> Callable[[np.ndarray], Labels]:
        """Return the stage of ADMM and Newton, a function of points."""
        return lambda x: by_newton(x, all_, _run(stage, exact, basis, x, relaxation), to_rows)

    def finished(x: np.ndarray, ok: np.ndarray, found: Any) -> Labels:
        """Return the labels of a part, by all stages."""
        if cones is None:
            labels, again = by_newton(x, ok, found, back), []
        else:
            labels = Labels.proved(found, OnDemand(lambda: planned(x)).get, ok)
            again = [lambda x: decided(planned(x), all_), by_admm(short, quick, alpha, back)]
        # Points still undecided get a longer ADMM run without weights, and Newton once more.
        for stage in (*again, by_admm(long, rows, np.float64(ALPHA), None)):
            left = np.flatnonzero((labels.label == 0) & ok)
            for i in range(0, len(left), batch):
                where = left[i : i + batch]
                more = stage(padded(x[where], batch)).first(len(where))
                labels = labels.changed(where, more.label, more.status, more.proofs)
        last = np.flatnonzero((labels.label == 0) & ok)[:share]
        for some_rows, program in last_programs(problem, margins) if len(last) else ():
            last = last[labels.label[last] == 0]
            for i in range(0, len(last), batch):
                where = last[i : i + batch]
                solved = [program(theta) for theta in x[where]]
                candidates = [padded(np.array(v), batch) for v in zip(*solved, strict=True)]
                verdict = _run(check, exact, some_rows, padded(x[where], batch), *candidates)
                more = decided(verdict, all_).first(len(where))
                labels = labels.changed(where, more.label, more.status, more.proofs)
        return labels

    waiting = None
    for points in itertools.chain(parts, [None]):
        with jax.enable_x64(True):
            ahead = None if points is None else (len(points), started(points))
            if waiting is None:
                waiting = ahead
                continue
            size, now = waiting
            labels = finished(*now).first(size)
            if scope.parts * sum(v.nbytes for v in jax.tree.leaves(now[2])) > ON_DEVICE:
                labels.fetch()
        compile_seconds = Compiled.seconds - compiled
        run_seconds = time.perf_counter() - begun - compile_seconds
        yield replace(labels, compile_seconds=compile_seconds, run_seconds=run_seconds)
        begun, compiled, waiting = time.perf_counter(), Compiled.seconds, ahead


def last_programs(
    problem: FeasibilityProblem, margins: np.ndarray
) -> Iterator[tuple[ConstraintRows, Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]]]:
    """Yield linear programs for the last undecided points θ, as the rows and θ → (w, multipliers).

    First the ray from the centre through θ: inside, θ lies between the centre and the ray's end,
    and so do their plans; outside, the end's multipliers are few. Where the plant is unstable the
    ray again, for multipliers in the units of its growth. Then the largest margin at θ. Tangents to
    a ball that the programs keep are those of this part's points.
    """
    found = RowPrograms(problem.rows)
    try:
        center, w_center = found.centre()
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
    yield problem.rows, lambda theta: found.margin(theta, margins)


def _run(program: Compiled, *args: Any) -> Any:
    """Run the program and leave its result on the device."""
    return program.run(*args)


def _penalised(
    rows: ConstraintRows, penalties: StagePenalties | None
) -> tuple[ConstraintRows, np.ndarray | None, np.float64]:
    """Return the rows of the ADMM stage, the matrix that leads back from their w (None where it is
    the same), and alpha."""
    if penalties is None:
        return rows, None, np.float64(ALPHA)
    shape, right = np.shape(penalties.weight), rows.lower.shape
    if shape != right:
        fail("penalties", f"weights {shape}", f"Learn them for this map: {right}")
    if not (np.all(np.isfinite(penalties.weight)) and np.all(penalties.weight > 0)):
        fail("penalties", "hold a weight that is not positive", "Learn them again")
    if not 0 < penalties.alpha < 2:
        fail("penalties", f"alpha {penalties.alpha}", "Over-relaxation lies in (0, 2)")
    return *weighted(rows, penalties.weight), np.float64(penalties.alpha)
