"""Of many points and half-spaces those that matter: extreme points, half-spaces that cut.

Of the points proved feasible only extreme ones matter to the inner bound, of the half-spaces only
those that cut something off the outer one. To drop a point or a half-space makes no bound wrong.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from jaxmpc.pytrees import record
from jaxmpc.sets.convex_sets import Box, Polytope
from jaxmpc.sets.lp import power_of_two

# Points, or half-spaces, from which on they are reduced to those that matter, and the most mapped
# states with which they are.
MANY, REDUCED = 10_000, 4
# Half-spaces that cut nothing off within so many sizes of the grid around it do not matter.
FAR = 100.0


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
