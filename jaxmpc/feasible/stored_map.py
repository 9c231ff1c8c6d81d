"""What a stored map says, read block by block: counts, proved bounds, a picture.

Of the points proved feasible only extreme ones matter to the inner bound, of the half-spaces only
those that cut something off the outer one; the others are dropped as they are read. Up to
`REDUCED` mapped states, memory does not grow with the grid. To drop a point or a half-space makes
no bound wrong.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from jaxmpc.feasible.centered_polytope import power_of_two
from jaxmpc.feasible.labels import Labels
from jaxmpc.feasible.map import FeasibleSetMap, excluded, mesh
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.rays import Rays
from jaxmpc.pytrees import record
from jaxmpc.qp.status import Status
from jaxmpc.sets.box import Box
from jaxmpc.sets.polytope import Polytope

# Points, or half-spaces, from which on they are reduced to those that matter, and the most mapped
# states with which they are.
MANY, REDUCED = 10_000, 4
# Half-spaces that cut nothing off within so many sizes of the grid around it do not matter.
FAR = 100.0
# Lines of a picture along each axis, at most.
LINES = 1024


class Picture(NamedTuple):
    """Labels (b,) on points (b, 2), evenly spaced lines of a grid, and the counts on all of it."""

    points: np.ndarray
    label: np.ndarray
    counts: dict[str, int]


@record
class StoredMap:
    """A stored map of a grid.

    kept: the store; along: coordinates along each axis. bounds: a map without points whose
    extra points and half-spaces bound the feasible set. counts: as of `FeasibleSetMap.counts`.
    undecided: blocks with undecided points. image: labels on every step-th line of two axes, None
    for other maps.
    """

    problem: FeasibilityProblem
    kept: Any
    along: tuple[np.ndarray, ...]
    bounds: FeasibleSetMap
    counts: dict[str, int]
    undecided: list[int]
    image: np.ndarray | None

    @classmethod
    def read(
        cls, problem: FeasibilityProblem, kept: Any, along: Sequence[np.ndarray]
    ) -> "StoredMap":
        """Read all labels of an open store, and the proofs that matter."""
        along = tuple(along)
        nothing = FeasibleSetMap.of(
            problem, np.zeros((0, problem.dimension)), Labels.empty(0, problem)
        )
        points = nothing.bound_point
        cuts = HalfSpaces.none(np.array([[line[0], line[-1]] for line in along]).T)
        lines = [len(line[:: step(line)]) for line in along]
        image = np.zeros(lines, np.int8) if len(along) == 2 else None
        found = cls(problem, kept, along, nothing, {}, [], image)
        for block in range(len(kept.regions)):
            label, status = kept.read("label", block), kept.read("status", block)
            found._count(block, replace(nothing.labels, label=label, status=status))
            if np.any(status == Status.ITERATION_LIMIT):
                found.undecided.append(block)
            ends = line_ends(label == 1, kept.regions[block][-1])
            if len(ends):
                points = np.concatenate([points, mesh(along, kept.samples(block)[ends])])
                points = extreme(points) if len(points) > MANY else points
            if np.any(label == -1):
                cuts = cuts.add(kept.read("cut_normal", block), kept.read("cut_offset", block))
        bounds = replace(
            nothing, bound_point=points, bound_normal=cuts.normals, bound_offset=cuts.offsets
        )
        return replace(found, bounds=bounds)

    def refine(self) -> tuple["StoredMap", FeasibleSetMap]:
        """Return the map with the bounds that rays add, and these alone; see
        `FeasibleSetMap.refine`. Undecided points that they exclude count as infeasible."""
        none = np.zeros((0, self.problem.dimension))
        alone = FeasibleSetMap.of(self.problem, none, Labels.empty(0, self.problem)).refine()
        normals, offsets = alone.bound_normal, alone.bound_offset
        bounds = replace(
            self.bounds,
            bound_point=np.concatenate([self.bounds.bound_point, alone.bound_point]),
            bound_normal=np.concatenate([self.bounds.bound_normal, normals]),
            bound_offset=np.concatenate([self.bounds.bound_offset, offsets]),
        )
        for block in self.undecided if len(offsets) else ():
            label, status = self.kept.read("label", block), self.kept.read("status", block)
            before = replace(Labels.empty(0, self.problem), label=label, status=status)
            points = mesh(self.along, self.kept.samples(block))
            labels = excluded(before, Rays.of(self.problem), points, normals, offsets)
            self._count(block, before, -1)
            self._count(block, labels)
        return replace(self, bounds=bounds), alone

    def _count(self, block: int, labels: Labels, sign: int = 1) -> None:
        """Add the labels of a block to the counts, or take them away, and draw the picture."""
        for name, count in labels.counts().items():
            self.counts[name] = self.counts.get(name, 0) + sign * count
        if self.image is not None:
            region = self.kept.regions[block]
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
    `REDUCED` dimensions."""
    size, d = np.ptp(points, axis=0), points.shape[1]
    if d == 1:
        return points[[np.argmin(points), np.argmax(points)]]
    if d > REDUCED or not size.all():
        return points
    try:
        return points[np.sort(ConvexHull((points - points.mean(axis=0)) / size).vertices)]
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
        far = FAR * np.ptp(ends, axis=0)
        return cls(np.zeros((0, len(far))), np.zeros(0), ends + np.array([-far, far]))

    def add(self, normals: np.ndarray, offsets: np.ndarray) -> "HalfSpaces":
        """Return these half-spaces and others (those with finite offsets), without those that do
        not matter."""
        scale = np.max(np.abs(normals), axis=1)
        known = np.isfinite(offsets) & (scale > 0) & np.isfinite(scale)
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
        return found.reduced() if len(found.offsets) > MANY else found

    def reduced(self) -> "HalfSpaces":
        """Return those that bound the intersection; the first ones where it is empty or flat."""
        if self.normals.shape[1] > REDUCED:
            return self
        unit = power_of_two(np.ptp(self.around, axis=0))
        names = tuple(map(str, range(len(self.offsets))))
        box = Box(*(self.around / unit)).to_polytope()
        try:
            body = Polytope(self.normals * unit, self.offsets, names).intersect(box).reduce()
            index, vertices = [int(name) for name in body.labels if name], body.vertices() * unit
        except ValueError:
            index, vertices = list(range(min(len(names), MANY))), None
        return replace(
            self, normals=self.normals[index], offsets=self.offsets[index], vertices=vertices
        )
