"""Maps of grids in a store: `sweep_into` labels a grid block by block, `StoredMap` is what it says.

A grid has one dimension an axis, with its coordinates. Of each sample the store holds label,
status, start (state), plan (time, input), cut_normal (coordinate) and cut_offset: see `Labels`; and
after refinement bound_point (ray, coordinate), bound_normal (facet, coordinate) and bound_offset
(facet): see `FeasibleSetMap`.

Under affine policies and tubes a sample has cone and answer too (`policy_hull.PolicyVerdict`). The
policy of a sample in a cone is the convex combination, by its place, of proved ones: policy_state
(policy, coordinate), policy_plan (policy, time, input) and policy_answer (policy, …), that of the
centre last, and those of the cone by corner (cones, vertex).
"""

import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import QhullError

from jaxmpc.arrays import Reals
from jaxmpc.batches import CHUNK, Part, Timing, default_chunk, work_off
from jaxmpc.checks import counted, entries, fail, require_kind, require_real
from jaxmpc.feasible.hard_constraints import Axes
from jaxmpc.feasible.map import BOUNDS, EXECUTOR, MEANINGS, FeasibleSetMap, excluded, warn_of_gap
from jaxmpc.feasible.pipeline import (
    MOST_PROGRAMS,
    PROOFS,
    Labels,
    OnDemand,
    Scope,
    labelled_parts,
)
from jaxmpc.feasible.policy_hull import POLICY_PROOFS, policy_hull, policy_labels
from jaxmpc.feasible.policy_problem import PolicyProblem, problem_of
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.rays import Rays
from jaxmpc.files import check_results
from jaxmpc.grids import mesh
from jaxmpc.mpc.problem import MPC
from jaxmpc.pytrees import record
from jaxmpc.qp.status import Status
from jaxmpc.sets.convex_sets import Box, Polytope
from jaxmpc.sets.geometry import convex_hull
from jaxmpc.sets.lp import power_of_two
from jaxmpc.store import (
    BlockWriter,
    Constant,
    Field,
    Store,
    exists,
    location,
    report_damage,
)

# Lines of a picture along each axis, at most.
LINES = 1024
# Dimensions and files of a store that no mapped state may be called.
TAKEN = {"checksum", "block", "state", "input", "time", "coordinate", "sample", "zarr.json"}
TAKEN |= {"cause", "cones", "corner", "direction", "generator", "policy", "vertex"}
TAKEN |= {"policy_state", "policy_plan", "policy_answer"}
# Bytes of the name of a dimension, at most; file systems have 255 for a name.
MOST_NAME = 100
# Points proved feasible, or half-spaces, from which on they are reduced to those that matter to the
# bounds, and the most mapped states with which they are. To drop others makes no bound wrong.
MANY_ROWS, MOST_REDUCED = 10_000, 4
# Half-spaces that cut nothing off within so many sizes of the grid around it do not matter.
FAR_SIZES = 100.0


class Picture(NamedTuple):
    """What a picture of a map shows.

    points (b, 2): where evenly spaced lines of the grid cross. label (b,): theirs. counts: of all
    points of the grid.
    """

    points: np.ndarray
    label: np.ndarray
    counts: dict[str, int]


@record
class StoredMap:
    """A stored map of a grid.

    store, along: where it lies, and the coordinates along each axis. bounds: a map without points
    whose bound points and half-spaces bound the feasible set. counts: as of
    `FeasibleSetMap.counts`. undecided: blocks with undecided points. image: labels on every
    step-th line of two axes, None for other maps. timing: the work of this process. left: why the
    map is not whole, in words, "" where it is; then bounds and counts are not read.
    """

    problem: FeasibilityProblem
    store: Store
    along: tuple[np.ndarray, ...]
    bounds: FeasibleSetMap
    counts: dict[str, int]
    undecided: list[int]
    image: np.ndarray | None
    timing: Timing
    left: str = ""

    def __repr__(self) -> str:
        size = " × ".join(str(len(line)) for line in self.along)
        counts = ", ".join(f"{n:,} {name}" for name, n in self.counts.items() if n)
        return f"StoredMap of {size} states at {self.store.path}: {self.left or counts}"

    @classmethod
    def unread(
        cls,
        problem: FeasibilityProblem,
        store: Store,
        along: Sequence[np.ndarray],
        timing: Timing | None = None,
        left: str = "",
    ) -> "StoredMap":
        """Return the map of a store of which nothing has been read."""
        along, none = tuple(along), np.zeros((0, len(along)))
        nothing = FeasibleSetMap.of(problem, none, Labels.empty(0, problem))
        lines = [len(line[:: step(line)]) for line in along]
        image = np.zeros(lines, np.int8) if len(along) == 2 else None
        return cls(problem, store, along, nothing, {}, [], image, timing or Timing(), left)

    @classmethod
    def read(
        cls, problem: FeasibilityProblem, store: Store, along: Sequence[np.ndarray]
    ) -> "StoredMap":
        """Read all labels of an open store, and the proofs that matter, block by block: memory does
        not grow with the grid up to `MOST_REDUCED` mapped states."""
        found = cls.unread(problem, store, along)
        points = found.bounds.bound_point
        cuts = HalfSpaces.none(np.array([[line[0], line[-1]] for line in along]).T)
        for block in range(len(store.regions)):
            labels = found._labels(block)
            found._count(block, labels)
            if np.any(labels.status == Status.ITERATION_LIMIT):
                found.undecided.append(block)
            ends = line_ends(labels.label == 1, store.regions[block][-1])
            if len(ends):
                points = np.concatenate([points, mesh(along, store.samples(block)[ends])])
                points = extreme(points) if len(points) > MANY_ROWS else points
            if np.any(labels.label == -1):
                cuts = cuts.add(store.read("cut_normal", block), store.read("cut_offset", block))
        return found._with_bounds(points, cuts.normals, cuts.offsets)

    def refine(self, gap: float = 1e-6) -> "StoredMap":
        """Return the map with the bounds that rays add, and write these into the store; see
        `FeasibleSetMap.refine`. Undecided points that they exclude count as infeasible."""
        none = np.zeros((0, self.problem.dimension))
        empty = FeasibleSetMap.of(self.problem, none, Labels.empty(0, self.problem))
        alone, left = empty.refined(gap)
        normals, offsets = alone.bound_normal, alone.bound_offset
        if self.undecided and len(offsets) and not isinstance(self.problem, PolicyProblem):
            exact = Rays.of(self.problem).exact
            for block in self.undecided:
                before = self._labels(block)
                points = mesh(self.along, self.store.samples(block))
                self._count(block, before, -1)
                self._count(block, excluded(before, exact, points, normals, offsets))
        about = {name: {"long_name": meaning} for name, meaning in MEANINGS.items()}
        self.store.save(
            {name: Constant(getattr(alone, name), BOUNDS[name], about[name]) for name in BOUNDS}
        )
        old = self.bounds
        joined = self._with_bounds(
            np.concatenate([old.bound_point, alone.bound_point]),
            np.concatenate([old.bound_normal, normals]),
            np.concatenate([old.bound_offset, offsets]),
        )
        if left > gap:
            low, high = joined.bounds.volume_bounds()
            if gap * high < high - low < np.inf:
                warn_of_gap((high - low) / high, gap)
        return joined

    def _with_bounds(
        self, points: np.ndarray, normals: np.ndarray, offsets: np.ndarray
    ) -> "StoredMap":
        bounds = replace(
            self.bounds, bound_point=points, bound_normal=normals, bound_offset=offsets
        )
        return replace(self, bounds=bounds)

    def _labels(self, block: int) -> Labels:
        """Return the labels of a block, without proofs."""
        label, status = self.store.read("label", block), self.store.read("status", block)
        return replace(self.bounds.labels, label=label, status=status)

    def _count(self, block: int, labels: Labels, sign: int = 1) -> None:
        """Add the labels of a block to the counts, or take them away, and draw the picture."""
        for name, count in labels.counts().items():
            self.counts[name] = self.counts.get(name, 0) + sign * count
        if self.image is not None:
            region = self.store.regions[block]
            whole = labels.label.reshape([part.stop - part.start for part in region])
            place, lines = [], []
            for part, line in zip(region, self.along, strict=True):
                at = np.r_[part]
                lines.append(at[at % step(line) == 0] - part.start)
                place.append(at[at % step(line) == 0] // step(line))
            self.image[np.ix_(*place)] = whole[np.ix_(*lines)]

    def picture(self) -> Picture:
        """Return the picture of a map of two states."""
        assert self.image is not None
        lines = [line[:: step(line)] for line in self.along]
        return Picture(mesh(lines), self.image.ravel(), self.counts)


def step(line: np.ndarray) -> int:
    """Return how far apart lines of the picture are."""
    return -(-len(line) // LINES)


def sweep_into(
    path: str | Path,
    mpc: MPC | FeasibilityProblem,
    along: Sequence[np.ndarray],
    *,
    axes: Axes = None,
    fixed: Reals | None = None,
    iterations: int = 50,
    dtype: str = "float32",
    chunk: int | None = None,
    gap: float | None = 1e-6,
    settings: Mapping[str, Any] | None = None,
    shard: tuple[int, int] | None = None,
    executor: Any = None,
    devices: Any = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: bool = False,
    begun: Callable[[], None] = lambda: None,
    opened: Callable[[Store], None] = lambda store: None,
    concluded: Callable[[StoredMap], None] = lambda found: None,
) -> StoredMap:
    """Label all points of a grid into a store, block by block, each written as soon as it is done.

    path: a folder or URL (`jaxmpc.store`), which xarray.open_zarr reads. mpc, axes, fixed,
    iterations, dtype, executor, devices: as in `map_feasible_set`. along: the coordinates of the
    grid along each of the d mapped states. chunk: points of a block at most, which is written
    at once while the next is labelled: a killed run loses that one and those being written
    (`store.BlockWriter`). None: as in the store to go on with; in a new one up to 131,072, see
    `store.writing.default_block`. Programs take parts of `default_chunk` points at most. gap: of
    `StoredMap.refine` at the end, None to skip it.

    settings: JSON data that determine the labels: a store with others is refused; None: iterations
    and dtype. shard: (i, n) to label the blocks k with k mod n = i, beside other processes; the
    last of them concludes, for all others `left` of the result says what is missing. resume: go on
    with the sweep at `path`. overwrite: put a new one in its place, once its first block is done.
    Without either there must be none. progress: show a bar, where stderr is a terminal. begun: is
    called when these labels lie at `path`, hence when overwritten ones are gone; opened: with the
    store before anything is compiled; concluded: with the whole map while no other process can
    conclude.

    Raises ValueError for wrong arguments, and as `jaxmpc.store.Store` does.
    """
    path = location(path)
    if shard is None:
        check_results(path, resume, overwrite, exists(path))
    elif overwrite:
        what = "given beside shard (--overwrite, --shard)"
        fail("overwrite", what, "Delete the store before shards start")
    problem = mpc if isinstance(mpc, FeasibilityProblem) else sweep_problem(mpc, axes, fixed)
    along = _lines(along, problem.dimension)
    if executor is not None and isinstance(problem, PolicyProblem):
        fail("executor", EXECUTOR, "Leave it out")
    settings = {"iterations": iterations, "dtype": dtype} if settings is None else settings
    require_kind("settings", settings, Mapping)
    how: dict[str, Any] = {"shard": shard, "overwrite": overwrite, "begun": begun}
    with open_labels(path, problem, along, settings, chunk, **how) as store:
        pending = store.pending()
        done = len(store.own) - len(pending)
        if shard is not None and (done or store.damaged) and not resume:
            what = f"holds {done:,} blocks of shard {shard[0]}/{shard[1]}"
            fail(str(path), what, "Add --resume (resume=True) to go on with it")
        report_damage(store)
        opened(store)
        parts = [store.parts(block, default_chunk()) for block in range(len(store.regions))]
        places = [(block, part) for block in pending for part in parts[block]]
        count, size = sum(map(len, parts)), store.part_size(default_chunk())
        points = lambda place: mesh(along, np.r_[place[1]])
        if isinstance(problem, PolicyProblem):
            found = _parts_of_policies(problem, places, points, count, size, devices)
        else:
            scope = Scope.of_grid(along, count)
            how = {"iterations": iterations, "dtype": dtype, "devices": devices}
            found = labelled_parts(problem, places, points, scope, size, executor=executor, **how)
        total = sum(part.stop - part.start for _, part in places)
        show = None if progress else False
        with BlockWriter(store) as writer:

            def put(part: Part[Labels]) -> str:
                block, rows = part.place
                writer.put(block, rows, **part.result.arrays())
                return f"{np.mean(part.result.label != 0):.2%} of the last part decided"

            timing = work_off(found, put, total, unit="states", progress=show)
        if left := store.unfinished():
            return StoredMap.unread(problem, store, along, timing, left)
        whole = replace(StoredMap.read(problem, store, along), timing=timing)
        if gap is not None:
            if progress:
                print("closing the bounds by rays; long horizons take a while", file=sys.stderr)
            whole = whole.refine(gap)
        concluded(whole)
        return whole


def _lines(along: Any, d: int) -> list[np.ndarray]:
    """Return the coordinates of a grid along each of d axes, checked."""
    cure = f"Give {counted(d, 'array')} of coordinates, one a mapped state"
    lines = entries("along", along, cure)
    for line in lines:
        require_real("along", line)
    shapes = [np.shape(line) for line in lines]
    if len(shapes) != d or any(len(shape) != 1 or 0 in shape for shape in shapes):
        fail("along", f"has arrays of shapes {shapes}", cure)
    return [np.asarray(line) for line in lines]


def sweep_problem(mpc: MPC, axes: Axes = None, fixed: Reals | None = None) -> FeasibilityProblem:
    """Return the feasibility problem of `mpc`, with all found that its labels rest on. Raises
    ValueError for what `sweep_into` cannot label; nothing is written."""
    problem = problem_of(mpc, axes, fixed)
    if isinstance(problem, PolicyProblem):
        policy_hull(problem)
    else:
        problem.blocks  # noqa: B018 - is computed once, or refused
    return problem


def _parts_of_policies(
    problem: PolicyProblem,
    places: Sequence[Any],
    points: Callable[[Any], np.ndarray],
    count: int,
    size: int,
    devices: Any,
) -> Iterator[Part[Labels]]:
    """Label the points at each of the places, of which there are `count` in the whole grid, and
    yield the parts in order."""
    for place in places:
        most = -(-MOST_PROGRAMS // count)
        labels = policy_labels(problem, points(place), size, devices, most)
        yield Part(place, len(labels.label), labels, labels.compile_seconds)


def open_labels(
    path: str | Path,
    problem: FeasibilityProblem,
    along: Sequence[np.ndarray],
    config: Mapping[str, Any],
    chunk: int | None,
    fields: Mapping[str, Field] | None = None,
    **how: Any,
) -> Store:
    """Open the store of the labels of a grid; how: to open it, see `Store`.

    along: the coordinates of the grid along each mapped state. fields: variables beside the labels.
    """
    mpc, system = problem.mpc, problem.mpc.system
    all_fields = label_fields(mpc.dimension, mpc.horizon, system.m, problem.dimension)
    constants: dict[str, Constant] = {}
    if isinstance(problem, PolicyProblem):
        more, constants = policy_format(problem)
        all_fields |= more
    all_fields |= dict(fields or {})
    names = [_name_and_unit(name) for name in problem.axis_names]
    dimensions = dimension_names([name for name, _ in names], all_fields)
    axes = {
        dimension: Constant(values, (dimension,), {"long_name": name, "units": unit or "1"})
        for dimension, values, (name, unit) in zip(dimensions, along, names, strict=True)
    }
    texts = {"coordinate": problem.axis_names, "state": mpc.labels, "input": system.input_labels}
    constants |= {
        name: Constant(np.array(list(values), str), (name,)) for name, values in texts.items()
    }
    about_time = {"long_name": "time of the input", "units": system.time_unit if system.dt else "1"}
    times = (system.dt or 1.0) * np.arange(mpc.horizon)
    constants["time"] = Constant(times, ("time",), about_time)
    attributes = {"problem": problem.plain()}
    return Store(
        path,
        axes,
        all_fields,
        config,
        chunk,
        part=CHUNK,
        constants=constants,
        attributes=attributes,
        **how,
    )


def label_fields(n: int, horizon: int, m: int, d: int) -> dict[str, Field]:
    """Return the variables that hold `Labels` of d mapped states and plans (horizon, m) from states
    of size n."""

    def flags(long_name: str, meanings: Mapping[str, int]) -> Field:
        values = {"flag_values": [*meanings.values()], "flag_meanings": " ".join(meanings)}
        return Field((), "int8", 0, (), {"long_name": long_name, **values})

    def numbers(long_name: str, shape: tuple[int, ...], *dimensions: str) -> Field:
        return Field(shape, "float64", np.nan, dimensions, {"long_name": long_name})

    status = {s.name.lower(): int(s) for s in Status}
    half_space = "a half-space a'x <= b that no feasible state leaves and this one does"
    at_point = "offset b of the half-space a'x <= b; inf: proved at this state alone"
    return {
        "label": flags("label", {"infeasible": -1, "undecided": 0, "feasible": 1}),
        "status": flags("status of the problem at this state", status),
        "start": numbers("initial state of the plan that proves feasible", (n,), "state"),
        "plan": numbers("inputs that prove feasible", (horizon, m), "time", "input"),
        "cut_normal": numbers(f"normal a of {half_space}", (d,), "coordinate"),
        "cut_offset": numbers(at_point, ()),
    }


def policy_format(problem: PolicyProblem) -> tuple[dict[str, Field], dict[str, Constant]]:
    """Return the further variables of labels under policies, of each state and of all together."""
    hull, shape = policy_hull(problem), problem.answer_shape
    theta, plan, answer = hull.triples
    axes = ("generator",) if len(shape) == 1 else ("time", "input", "cause", "direction")
    rest = "the offset of a tube" if len(shape) == 1 else "the feedback of a policy"
    about = {"long_name": "cone in which the policy is a combination; -1: it is one of its own"}
    own = {"long_name": f"{rest} that is no combination"}
    fields = {
        "cone": Field((), "int32", -1, (), about),
        "answer": Field(shape, "float64", np.nan, axes, own),
    }
    proved = {"long_name": "state with a proved policy, the centre last"}
    constants = {
        "policy_state": Constant(theta, ("policy", "coordinate"), proved),
        "policy_plan": Constant(plan, ("policy", "time", "input"), {"long_name": "its plan"}),
        "policy_answer": Constant(answer, ("policy", *axes), {"long_name": rest}),
        "corner": Constant(
            hull.corners.astype(np.int32), ("cones", "vertex"), {"long_name": "policies of a cone"}
        ),
    }
    return fields, constants


def stored_labels(store: Store) -> Labels:
    """Return the labels in a store; proofs are read when they are used."""
    names = [name for name in (*PROOFS, *POLICY_PROOFS) if name in store.fields]
    proofs = {name: OnDemand(partial(store.read, name)) for name in names}
    return Labels(store.read("label"), store.read("status"), proofs)


def dimension_names(names: Sequence[str], taken: Mapping[str, Any]) -> list[str]:
    """Return names of dimensions for mapped states: their own, without characters that a path
    cannot hold; x0, x1, ... where these are not distinct, or too long for a path, or have a meaning
    in a store. Some file systems do not tell capital letters from others."""
    found = [re.sub(r"[^\w.\- ]", "_", name).strip(". ") for name in names]
    known, bare = {*taken, *BOUNDS, *TAKEN}, [name.casefold() for name in found]
    if (
        len(set(bare)) < len(found)
        or not all(found)
        or known & {*found, *bare}
        or any(len(name.encode()) > MOST_NAME for name in found)
        or any(name.startswith("__") or name.endswith(".partial") for name in found)
    ):
        return [f"x{i}" for i in range(len(found))]
    return found


def _name_and_unit(label: str) -> tuple[str, str]:
    """Split a label such as "q [rad]" into its name and its unit."""
    found = re.fullmatch(r"(.*?) \[(.*)\]", label)
    return (found[1], found[2]) if found else (label, "")


def line_ends(flags: np.ndarray, last: slice) -> np.ndarray:
    """Return the indices of samples of a block where flags (samples,) is set first and last along
    each line of its last axis: on the line no other is extreme."""
    lines = flags.reshape(-1, last.stop - last.start)
    some = np.flatnonzero(lines.any(axis=1))
    lines = lines[some]
    size = last.stop - last.start
    first, final = np.argmax(lines, axis=1), size - 1 - np.argmax(lines[:, ::-1], axis=1)
    return np.unique(np.concatenate([some * size + first, some * size + final]))


def extreme(points: np.ndarray) -> np.ndarray:
    """Return those of the points (K, d) that span their hull; all where that is flat, and above
    `MOST_REDUCED` dimensions."""
    size, d = np.ptp(points, axis=0), points.shape[1]
    if d == 1:
        return points[[np.argmin(points), np.argmax(points)]]
    if d > MOST_REDUCED or not size.all():
        return points
    try:
        hull, kept = convex_hull((points - points.mean(axis=0)) / size)
        return points[np.sort(kept[hull.vertices])]
    except QhullError:
        return points


@record
class HalfSpaces:
    """Half-spaces normals (K, d) x ≤ offsets (K,) of which those that do not matter are dropped.

    around (2, d): ends of a box, far around the grid, within which they matter. vertices: of their
    intersection with it when it was computed last; a half-space that holds at all of them cuts
    nothing off. None where it was not computed, or is empty or flat.
    """

    normals: np.ndarray
    offsets: np.ndarray
    around: np.ndarray
    vertices: np.ndarray | None = None

    @classmethod
    def none(cls, ends: np.ndarray) -> "HalfSpaces":
        """Return no half-spaces. ends (2, d): of the grid."""
        far = FAR_SIZES * np.ptp(ends, axis=0)
        return cls(np.zeros((0, len(far))), np.zeros(0), ends + np.array([-far, far]))

    def add(self, normals: np.ndarray, offsets: np.ndarray) -> "HalfSpaces":
        """Return these half-spaces and others (those with finite offsets), without those that do
        not matter."""
        scale = np.max(np.abs(normals), axis=1)
        known = np.isfinite(offsets) & (scale > 0) & np.isfinite(scale)
        # Neighbours on a grid often have the same.
        known[1:] &= np.any(np.diff(normals, axis=0) != 0, axis=1) | (np.diff(offsets) != 0)
        normals, offsets, scale = normals[known], offsets[known], scale[known]
        if self.vertices is not None:
            values = np.max(self.vertices @ (normals / scale[:, None]).T, axis=0)
            reach = np.abs(normals / scale[:, None]) @ np.abs(self.vertices).max(axis=0)
            cut = values > offsets / scale + 1e-12 * reach
            normals, offsets, scale = normals[cut], offsets[cut], scale[cut]
        # Of those that are equal but for rounding the tightest.
        order = np.argsort(offsets / scale, kind="stable")
        like = np.round(np.column_stack([normals, offsets])[order] / scale[order, None], 9)
        first = np.sort(order[np.unique(like, axis=0, return_index=True)[1]])
        found = replace(
            self,
            normals=np.concatenate([self.normals, normals[first]]),
            offsets=np.concatenate([self.offsets, offsets[first]]),
        )
        return found.reduced() if len(found.offsets) > MANY_ROWS else found

    def reduced(self) -> "HalfSpaces":
        """Return those that bound the intersection; the first ones where it is empty or flat."""
        if self.normals.shape[1] > MOST_REDUCED:
            return self
        unit = power_of_two(np.ptp(self.around, axis=0))
        names = tuple(map(str, range(len(self.offsets))))
        box = Box(*(self.around / unit)).to_polytope()
        try:
            body = Polytope(self.normals * unit, self.offsets, names).intersect(box)
            body = body.require_body().reduce()
            index, vertices = [int(name) for name in body.labels if name], body.vertices() * unit
        except ValueError:
            index, vertices = list(range(min(len(names), MANY_ROWS))), None
        return replace(
            self, normals=self.normals[index], offsets=self.offsets[index], vertices=vertices
        )
