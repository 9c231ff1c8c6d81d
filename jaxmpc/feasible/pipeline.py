"""Labels of points, each with its proof, and the pipeline of stages that makes them, part by part.

A point goes through the stages in this order until it is decided:

    hull                   in the hull of proved points, or beyond a half-space; then the roll-out
                           of its plan. Only where so many points are worth the rays (`hull_for`)
    ADMM, Newton           `iterations` steps, then Newton steps on what they leave undecided
    longer ADMM, Newton    the same with `LONGER` times as many steps, in float64
    linear programs        up to three for each of the last `MOST_PROGRAMS` points of all parts

The first of them takes a whole part on the device (`Pipeline.begin`), the others batches of what is
left (`Pipeline.stages`, `by_programs`).

The labels and proofs of a part depend on its own points, on the shape of a part and on the `Scope`
of all points, not on which other parts a process has labelled, nor on who labels it: any split
among processes gives the same bits. So parts may be labelled here (`label_parts`) or by an executor
(`label_elsewhere`), anything with the interface of `concurrent.futures`: `submit(function,
*arguments)` returns a future, whose `result()` waits.
"""

import functools
import itertools
import math
import pickle
import time
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.batches import (
    CHUNK,
    Compiled,
    Devices,
    Part,
    chosen_devices,
    cores,
    count,
    divisible,
    gather_size,
    joined,
    over_devices,
    padded,
    placement,
    side_by_side,
    to_host,
)
from jaxmpc.checks import fail, require_step_type
from jaxmpc.feasible.candidate_search import compiled_admm, compiled_check, compiled_newton
from jaxmpc.feasible.condensed_rows import ConstraintRows, RowPrograms, outward
from jaxmpc.feasible.hull_labels import Hull, compiled_verdicts, hull_for
from jaxmpc.feasible.hull_labels import label as label_by
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.proofs import Verdict
from jaxmpc.pytrees import record
from jaxmpc.qp.status import Status

# The arrays of `Labels` that may still be on the device, and the label that each of them proves.
PROOFS = {"start": 1, "plan": 1, "cut_normal": -1, "cut_offset": -1}
# Steps of the longer ADMM run, relative to the first, on points that Newton leaves undecided.
LONGER = 20
# Points that get linear programs, the first of each part in order: so many in all parts, each with
# an equal share, and no more than these entries of their matrices in total. 10,000 entries take
# some tens of milliseconds.
MOST_PROGRAMS, MOST_ENTRIES = 2000, 2 * 10**7
# Points that a hull leaves undecided which go on at once: they are few.
FEW_LEFT = 4096
# Proofs of up to so many bytes in total stay on the device until they are used.
ON_DEVICE = 2**31
# Points that a program takes at least: compiling takes far longer than what is computed in vain.
LEAST_POINTS = 64
# Number of points from which their typical size is taken.
SIZE_SAMPLE = 4096
# Parts that are submitted and not yet joined, at most: enough for some hundred workers.
IN_FLIGHT = 256
# How often a part is submitted again whose worker died.
RETRIES = 3

T = TypeVar("T")


class OnDemand(Generic[T]):
    """Something, mostly an array, that is fetched once, when it is first used."""

    def __init__(self, fetch: Callable[[], T]) -> None:
        self._fetch: Callable[[], T] | None = fetch
        self._value: T | None = None

    def get(self) -> T:
        """Return it, and fetch it the first time."""
        if self._fetch is not None:
            self._value, self._fetch = self._fetch(), None
        assert self._value is not None
        return self._value

    def __getstate__(self) -> dict[str, Any]:
        """Return what copies and pickles hold: the thing itself, not how to fetch it."""
        return {"_fetch": None, "_value": self.get()}


@record
class Labels:
    """Labels of b points and their proofs: a `Verdict` of each point, and its status.

    label (b,) int8: 1 proved feasible, −1 proved infeasible, 0 undecided. status (b,) int8:
    `Status` (NOT_RUN, NON_FINITE, or SOLVED / PRIMAL_INFEASIBLE / ITERATION_LIMIT for the three
    labels). compile_seconds, run_seconds: time spent compiling and running.

    proofs: the arrays `start`, `plan`, `cut_normal`, `cut_offset`, which may still be on the
    device, or not be made yet: each is fetched when it is first used.
    """

    label: np.ndarray
    status: np.ndarray
    proofs: Mapping[str, OnDemand[np.ndarray]]
    compile_seconds: float = 0.0
    run_seconds: float = 0.0

    def __repr__(self) -> str:
        counts = ", ".join(f"{n:,} {name}" for name, n in self.counts().items() if n)
        return f"Labels of {len(self.label):,} points: {counts or 'none'}"

    @property
    def start(self) -> np.ndarray:
        """Return x_0 (b, n) of the points proved feasible, NaN elsewhere."""
        return self.proofs["start"].get()

    @property
    def plan(self) -> np.ndarray:
        """Return inputs (b, N, m) that prove points feasible, NaN elsewhere. Where equalities tie
        inputs to states the inputs that prove it are real numbers within rounding of these."""
        return self.proofs["plan"].get()

    @property
    def cut_normal(self) -> np.ndarray:
        """Return the normals a (b, d) of half-spaces a'x ≤ b, valid on the whole feasible set, that
        prove points infeasible, NaN elsewhere."""
        return self.proofs["cut_normal"].get()

    @property
    def cut_offset(self) -> np.ndarray:
        """Return the offsets (b,) of these half-spaces.

        ∞ means that −1 is proved at the point but that no such half-space is known: on sets that
        are unbounded in both directions, or very long, along a facet, the rounding of its normal
        outweighs the distance of the point.
        """
        return self.proofs["cut_offset"].get()

    def counts(self) -> dict[str, int]:
        """Return how many points are feasible, infeasible, undecided, not finite, not run."""
        return {
            "feasible": int(np.sum(self.label == 1)),
            "infeasible": int(np.sum(self.label == -1)),
            "undecided": int(np.sum(self.status == Status.ITERATION_LIMIT)),
            "not finite": int(np.sum(self.status == Status.NON_FINITE)),
            "not run": int(np.sum(self.status == Status.NOT_RUN)),
        }

    @classmethod
    def proved(
        cls,
        label: np.ndarray,
        status: np.ndarray,
        verdict: Callable[[], Any],
        more: Mapping[str, int] | None = None,
    ) -> "Labels":
        """Return labels with the proofs in a `Verdict` on a device, which is asked for when one of
        them is used; NaN, or −1, where they prove nothing. more: fields of it beside those of
        `PROOFS`, and the label that each proves."""

        def proof(name: str, of: int) -> OnDemand[np.ndarray]:
            def fetch() -> np.ndarray:
                value = to_host(getattr(verdict(), name))
                return _put(value, label != of, np.nan if value.dtype.kind == "f" else -1)

            return OnDemand(fetch)

        named = PROOFS | dict(more or {})
        return cls(label, status, {name: proof(name, of) for name, of in named.items()})

    @classmethod
    def empty(cls, count: int, problem: FeasibilityProblem) -> "Labels":
        """Return labels of `count` points that have not been run."""
        mpc = problem.mpc
        shapes: dict[str, tuple[int, ...]] = {
            "start": (mpc.dimension,),
            "plan": (mpc.horizon, mpc.system.m),
            "cut_normal": (problem.dimension,),
            "cut_offset": (),
        }
        proofs = {
            name: OnDemand(functools.partial(np.full, (count, *shape), np.nan))
            for name, shape in shapes.items()
        }
        return cls(np.zeros(count, np.int8), np.full(count, Status.NOT_RUN, np.int8), proofs)

    @classmethod
    def joined(cls, parts: Sequence["Labels"]) -> "Labels":
        """Return the labels of several batches of points, one after the other."""

        def several(name: str) -> OnDemand[np.ndarray]:
            def fetch() -> np.ndarray:
                return joined(side_by_side(lambda part: part.proofs[name].get(), parts, cores()))

            return OnDemand(fetch)

        label, status = joined([(part.label, part.status) for part in parts])
        return cls(
            label,
            status,
            {name: several(name) for name in PROOFS},
            sum(part.compile_seconds for part in parts),
            sum(part.run_seconds for part in parts),
        )

    def rows(self, index: np.ndarray | slice) -> "Labels":
        """Return the labels of the points at these indices, with their proofs."""

        def some(proof: OnDemand[np.ndarray]) -> OnDemand[np.ndarray]:
            return OnDemand(lambda: proof.get()[index])

        proofs = {name: some(proof) for name, proof in self.proofs.items()}
        return replace(self, label=self.label[index], status=self.status[index], proofs=proofs)

    def changed(
        self,
        where: np.ndarray,
        label: np.ndarray | int,
        status: np.ndarray | int,
        proofs: Mapping[str, OnDemand[np.ndarray]],
    ) -> "Labels":
        """Return these labels with others at indices `where` (k,), and with these rows of their
        proofs."""

        def merged(name: str, rows: OnDemand[np.ndarray]) -> OnDemand[np.ndarray]:
            return OnDemand(lambda: _put(self.proofs[name].get(), where, rows.get()))

        return replace(
            self,
            label=_put(self.label, where, label),
            status=_put(self.status, where, status),
            proofs={**self.proofs, **{name: merged(name, rows) for name, rows in proofs.items()}},
        )

    @property
    def undecided(self) -> np.ndarray:
        """Return the indices of the points that are undecided so far."""
        return np.flatnonzero(self.status == Status.ITERATION_LIMIT)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return label, status and all proofs by their names."""
        proofs = {name: proof.get() for name, proof in self.proofs.items()}
        return {"label": self.label, "status": self.status, **proofs}

    def fetch(self) -> None:
        """Copy all proofs from the device."""
        for proof in self.proofs.values():
            proof.get()


def _put(array: np.ndarray, where: np.ndarray, rows: np.ndarray | float) -> np.ndarray:
    """Return a copy of the array with `rows` at indices `where`."""
    copy = array.copy()
    copy[where] = rows
    return copy


@record
class Scope:
    """What the labels of a part take from all points together.

    largest, typical (d,): the largest and the median |θ|. parts: their number, which share the
    linear programs. points: number of all points that are labelled of the problem, in this call and
    before.
    """

    largest: np.ndarray
    typical: np.ndarray
    parts: int
    points: int

    @classmethod
    def of(cls, points: np.ndarray, parts: int, before: int = 0, *, extent: bool = True) -> "Scope":
        """Return the scope of points (B, d), of which some may not be finite.

        before: points that have been labelled of the same problem. extent: False leaves `largest`
        at zero, for problems whose bounding box is known (`FeasibilityProblem.exact`).
        """
        largest = extent_of(points) if extent else np.zeros(points.shape[1])
        sample = points[:: max(1, len(points) // SIZE_SAMPLE)]
        sample = np.abs(sample[np.all(np.isfinite(sample), axis=1)])
        size = np.median(sample, axis=0) if len(sample) else np.zeros(points.shape[1])
        return cls(largest, size, parts, before + len(points))

    @classmethod
    def of_grid(cls, lines: Sequence[np.ndarray], parts: int) -> "Scope":
        """Return the scope of the grid with these d coordinates."""
        sizes = [np.abs(line) for line in lines]
        largest, typical = (np.array([f(v) for v in sizes]) for f in (np.max, np.median))
        return cls(largest, typical, parts, math.prod(map(len, lines)))


def extent_of(points: np.ndarray) -> np.ndarray:
    """Return the largest |θ| (d,) of those points (B, d) that are finite."""
    # Column by column: reductions along rows of few entries are slow.
    usable = functools.reduce(np.logical_and, map(np.isfinite, points.T))
    return np.array([np.max(np.abs(v), where=usable, initial=0.0) for v in points.T])


class BegunPart(NamedTuple):
    """A part and, on the device, as programs take it: points x (whole, d), zeros where they are not
    `usable`, of which the first are the part's; found: what the first stage has left there, of the
    hull labels and status, which say what is usable."""

    points: np.ndarray
    x: Array
    usable: Array | None
    found: Any


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
        self.problem = problem
        exact = problem.exact(scope.largest, scope.typical)
        self.margins = problem.row_margins(exact, scope.typical)
        programs = min(MOST_PROGRAMS, MOST_ENTRIES // max(problem.rows.U.size, 1))
        self.share = -(-programs // max(scope.parts, 1))
        # A power of two where it is small, so that maps of some points more compile nothing; and
        # as the devices share it.
        few = max(LEAST_POINTS, 1 << (chunk - 1).bit_length())
        self.whole = divisible(few if chunk < CHUNK else chunk, self.devices)
        each = gather_size(self.whole // count(self.devices))
        hull = hull_for(problem, scope.points)
        if hull is not None:
            each = min(each, FEW_LEFT)
        self.batch = count(self.devices) * each
        self.short = compiled_admm(iterations, np.dtype(dtype), self.devices)
        self.long = compiled_admm(LONGER * iterations, np.dtype(np.float64), self.devices)
        self.newton = compiled_newton(each, self.devices)
        self.prepare, self.outcome = compiled_ends(self.devices)
        data = exact, problem.rows, hull
        with jax.enable_x64(True):
            self.exact, self.rows, self.hull = jax.device_put(data, placement(self.devices))

    @property
    def stages(self) -> list[Callable[[np.ndarray], Labels]]:
        """Return the stages after the first one in their order, points (batch, d) → labels, but for
        the linear programs that come last."""
        short, long = (functools.partial(self.by_admm, v) for v in (self.short, self.long))
        return [long] if self.hull is None else [self.by_hull, short, long]

    def begin(self, points: np.ndarray) -> BegunPart:
        """Start the first stage of points (b, d), b ≤ chunk, on the device, and return at once."""
        full = points if len(points) == self.whole else padded(points, self.whole)
        if self.hull is not None:
            x, found = _run(compiled_hull(self.devices), self.hull, full)
            return BegunPart(points, x, None, found)
        x, usable = self.prepare.run(full)
        return BegunPart(points, x, usable, _run(self.short, self.exact, self.rows, x))

    def finish(self, part: BegunPart) -> Labels:
        """Return the labels of a part, by all stages."""
        points, x, usable, found = part
        if self.hull is None:
            labels = self.by_newton(x, usable, found)
        else:
            verdict = OnDemand(functools.partial(self.hull_verdict, x))
            label, status = to_host(found)
            labels = Labels.proved(label, status, verdict.get)
        labels = labels.rows(slice(len(points)))
        left = labels.undecided
        for stage in self.stages:
            for where in self.batches(left):
                more = stage(padded(points[where], self.batch)).rows(slice(len(where)))
                labels = labels.changed(where, more.label, more.status, more.proofs)
            left = left[labels.label[left] == 0]
        left = left[: self.share]
        return self.by_programs(labels, points, left) if len(left) else labels

    def batches(self, index: np.ndarray) -> Iterator[np.ndarray]:
        """Yield indices in batches of one size at most."""
        for first in range(0, len(index), self.batch):
            yield index[first : first + self.batch]

    def hull_verdict(self, x: Any) -> Verdict:
        """Return the verdicts of the hull on points, with their proofs."""
        with jax.enable_x64(True):
            return _run(compiled_verdicts(self.devices), self.exact, self.hull, x)

    def by_hull(self, points: np.ndarray) -> Labels:
        """Return the labels of points by roll-outs of the plans that the hull gives them."""
        return self.decided(self.hull_verdict(points))

    def by_admm(self, admm: Compiled, points: np.ndarray) -> Labels:
        """Return the labels of points by steps of ADMM and of Newton."""
        found = _run(admm, self.exact, self.rows, points)
        return self.by_newton(points, np.ones(len(points), bool), found)

    def by_newton(self, x: Any, usable: Any, found: tuple[Verdict, Any]) -> Labels:
        """Return the labels after Newton steps from the w of an ADMM stage, if it left any usable
        point undecided."""
        verdict, w = found
        labels = self.decided(verdict, usable)
        if len(labels.undecided):
            verdict = _run(self.newton, self.exact, self.rows, x, usable, verdict, w)
            labels = self.decided(verdict, usable)
        return labels

    def by_programs(self, labels: Labels, points: np.ndarray, last: np.ndarray) -> Labels:
        """Return the labels where linear programs have looked for proofs of points[last]."""
        check = compiled_check(self.devices)
        for rows, program in last_programs(self.problem, self.margins):
            last = last[labels.label[last] == 0]
            for where in self.batches(last):
                solved = [_candidate(program, rows, theta) for theta in points[where]]
                candidates = [padded(np.array(v), self.batch) for v in zip(*solved, strict=True)]
                x = padded(points[where], self.batch)
                more = self.decided(_run(check, self.exact, rows, x, *candidates))
                more = more.rows(slice(len(where)))
                labels = labels.changed(where, more.label, more.status, more.proofs)
        return labels

    def decided(self, verdict: Verdict, usable: Any = None) -> Labels:
        """Return the labels of a verdict on the device, for which this waits; usable: which points
        are, None for all."""
        usable = np.ones(len(verdict.label), bool) if usable is None else usable
        label, status = self.outcome(verdict.label, usable)
        return Labels.proved(label, status, lambda: verdict)


@functools.cache
def compiled_ends(devices: Devices) -> tuple[Compiled, Compiled]:
    """Return the compiled `without_nan` and `outcome` of a batch."""
    prepare = over_devices(jax.vmap(without_nan), devices, (True,))
    return prepare, over_devices(jax.vmap(outcome), devices, (True, True))


@functools.cache
def compiled_hull(devices: Devices) -> Compiled:
    """Return the compiled first stage by a hull: (hull, points (B, d)) → points, zeros where they
    are not finite, and their labels and status."""

    def stage(hull: Hull, theta: Array) -> tuple[Array, tuple[Array, Array]]:
        x, usable = without_nan(theta)
        return x, outcome(label_by(hull, x), usable)

    return over_devices(jax.vmap(stage, (None, 0)), devices, (False, True))


def _run(program: Compiled, *args: Any) -> Any:
    """Run the program and leave its result on the device."""
    return program.run(*args)


def pipeline_for(
    problem: FeasibilityProblem, scope: Scope, chunk: int, **settings: Any
) -> Pipeline:
    """Return the pipeline of a problem: the last one of it, with all that lies on the devices,
    where that was for the same scope and settings."""
    devices = chosen_devices(settings.get("devices"))
    others = tuple(repr(settings.get(name)) for name in ("iterations", "dtype"))
    place = devices or tuple(jax.device_put(0).devices())  # the default device
    numbers = scope.largest.tobytes(), scope.typical.tobytes(), scope.parts, chunk
    key = *numbers, others, place, hull_for(problem, scope.points) is not None
    if problem.memory.get("pipeline", (None,))[0] != key:
        problem.memory["pipeline"] = key, Pipeline(problem, scope, chunk, **settings)
    return problem.memory["pipeline"][1]


def without_nan(theta: Array) -> tuple[Array, Array]:
    """Return θ (d,), zeros where it is not finite, and whether it is."""
    usable = jnp.all(jnp.isfinite(theta))
    return jnp.where(usable, theta, 0.0), usable


def outcome(label: Array, usable: Array) -> tuple[Array, Array]:
    """Return the label of a point and its status; usable: whether it is finite."""
    status = jnp.where(label == 1, Status.SOLVED, Status.PRIMAL_INFEASIBLE)
    status = jnp.where(label == 0, Status.ITERATION_LIMIT, status)
    status = jnp.where(usable, status, Status.NON_FINITE)
    return jnp.where(usable, label, 0).astype(jnp.int8), status.astype(jnp.int8)


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
    pipeline = pipeline_for(problem, scope, chunk, **settings)
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
    ray again, for multipliers in the units of its growth. Then the largest margin at θ, and where
    inputs have limits on one side the same beside a small gain of `outward`. Tangents to a ball
    that the programs keep are those of this part's points.
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
    along = outward(problem.rows, problem.mpc.inputs) / margins.max()
    if along.any():
        yield problem.rows, functools.partial(found.margin, size=margins, along=along)


def _candidate(
    program: LinearProgram, rows: ConstraintRows, theta: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return w and multipliers that a program finds for the point θ, zeros where it has no answer
    that can be checked."""
    try:
        return program(theta)
    except ValueError:
        return np.zeros(rows.U.shape[1]), np.zeros(len(rows.U))


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
