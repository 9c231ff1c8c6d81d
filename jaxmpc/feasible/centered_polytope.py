"""A polytope with a point inside: distances from it, bounds by weak duality, nearest points."""

from functools import cached_property

import numpy as np
from scipy.optimize import nnls

from jaxmpc.pytrees import record
from jaxmpc.sets.lp import Program, bound, extent
from jaxmpc.sets.polytope import Polytope


@record
class CenteredPolytope:
    """{θ : normals θ ≤ offsets} about a point `center` (p,) inside.

    normals (K, p) of length 1, offsets (K,). vertices (k, p): each was reached to `TOLERANCE` by a
    feasible state; (0, p) where none were enumerated.
    """

    center: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray
    vertices: np.ndarray

    @property
    def depths(self) -> np.ndarray:
        """Return the distance (K,) of each facet from the centre, the scale of its tolerances."""
        return self.offsets - self.normals @ self.center

    @cached_property
    def unit(self) -> np.ndarray:
        """Return units (p,) of θ in which the polytope is about 1 wide, powers of two."""
        low, high = Program(self.normals, self.depths).bounds()
        return power_of_two((high - low) / 2)

    @cached_property
    def extent(self) -> np.ndarray:
        """Return bounds |θ_i| ≤ extent_i on the polytope, (p,)."""
        return extent(self.normals, self.offsets)

    def support(self, direction: np.ndarray) -> tuple[float, np.ndarray | None]:
        """Return an upper bound of max direction'θ, by weak duality, and where it is attained."""
        top = Program(self.normals, self.offsets).maximise(direction)
        if top.y is None:
            return top.value, None
        return bound(direction, top.y, self.normals, self.offsets, self.extent), top.x

    @property
    def polytope(self) -> Polytope:
        """Return the same set as H x ≤ h."""
        return Polytope(self.normals, self.offsets)

    def beyond(self, points: np.ndarray) -> np.ndarray:
        """Return how far outside points (B, p) are, negative inside: the largest distance from a
        facet relative to that facet's from the centre, (B,). It does not depend on units."""
        return np.max((points @ self.normals.T - self.offsets) / self.depths, axis=1)

    def nearest(self, points: np.ndarray, inset: float = 0.0) -> np.ndarray:
        """Return the point nearest to each of `points` (B, p), in coordinates in which the polytope
        is about 1 wide, that keeps all half-spaces by `inset`, relative to their depths.

        Least distance by non-negative least squares (Lawson & Hanson 1974, ch. 23).
        """
        answer, unit = np.array(points, float), self.unit
        normals = self.normals * unit
        length = np.linalg.norm(normals, axis=1)
        normals = normals / length[:, None]
        room = (self.offsets - inset * self.depths - answer @ self.normals.T) / length
        target = np.append(np.zeros(answer.shape[1]), 1.0)
        for i in np.flatnonzero(room.min(axis=1) < 0):
            scale = -room[i].min()
            E = -np.vstack([normals.T, room[i] / scale])
            try:
                y, _ = nnls(E, target, maxiter=20 * E.shape[1])
            except RuntimeError:  # stays outside, where there is no plan
                continue
            r = E @ y - target
            if r[-1] < -1e-12:
                answer[i] -= unit * (scale * r[:-1] / r[-1])
        return answer


def power_of_two(sizes: np.ndarray) -> np.ndarray:
    """Return the powers of two next below sizes, 1 for those that are zero or infinite: units that
    change no digit."""
    usable = np.isfinite(sizes) & (sizes > 1e-200) & (sizes < 1e200)
    return 2.0 ** np.floor(np.log2(np.where(usable, sizes, 1.0)))
