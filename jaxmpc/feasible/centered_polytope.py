"""A polytope with a point inside: distances from it, bounds by weak duality, nearest points."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import nnls

from jaxmpc.control.sets import Polytope, maximise


@dataclass(frozen=True, eq=False)
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
    def size(self) -> float:
        """Return the largest distance of a facet from the centre, the scale of tolerances."""
        return float(np.max(self.offsets - self.normals @ self.center))

    @cached_property
    def extent(self) -> np.ndarray:
        """Return bounds |θ_i| ≤ extent_i on the polytope, (p,)."""
        return coordinate_extent(self.normals, self.offsets)

    def support(self, direction: np.ndarray) -> tuple[float, np.ndarray | None]:
        """Return an upper bound of max direction'θ, by weak duality, and where it is attained."""
        top = maximise(direction, self.normals, self.offsets)
        if top.y is None:
            return top.value, None
        return weak_duality_bound(direction, top.y, self.normals, self.offsets, self.extent), top.x

    @property
    def polytope(self) -> Polytope:
        """Return the same set as H x ≤ h."""
        return Polytope(self.normals, self.offsets)

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Return max_j (normal_j'θ − offset_j), (B,), at points (B, p): how far outside they are,
        negative inside."""
        return np.max(points @ self.normals.T - self.offsets, axis=1)

    def nearest(self, points: np.ndarray, inset: float = 0.0) -> np.ndarray:
        """Return the point nearest to each of `points` (B, p) that keeps all half-spaces by
        `inset`.

        Least distance by non-negative least squares (Lawson & Hanson 1974, ch. 23).
        """
        answer = np.array(points, float)
        room = self.offsets - inset - answer @ self.normals.T
        target = np.append(np.zeros(answer.shape[1]), 1.0)
        for i in np.flatnonzero(room.min(axis=1) < 0):
            scale = -room[i].min()
            E = -np.vstack([self.normals.T, room[i] / scale])
            try:
                y, _ = nnls(E, target, maxiter=20 * E.shape[1])
            except RuntimeError:  # stays outside, where there is no plan
                continue
            r = E @ y - target
            if r[-1] < -1e-12:
                answer[i] -= scale * r[:-1] / r[-1]
        return answer


def coordinate_extent(G: np.ndarray, g: np.ndarray) -> np.ndarray:
    """Return bounds |v_i| ≤ extent_i on G v ≤ g: twice what linear programs find, which outweighs
    their error."""
    size = G.shape[1]
    ends = [maximise(s * e, G, g).value for e in np.eye(size) for s in (1, -1)]
    return 2 * np.abs(ends).reshape(size, 2).max(axis=1) + 1e-300


def weak_duality_bound(
    d: np.ndarray, y: np.ndarray, G: np.ndarray, g: np.ndarray, extent: np.ndarray
) -> float:
    """Return an upper bound of d'v over G v ≤ g, |v| ≤ extent, from any multipliers y ≥ 0: d'v =
    y'G v + (d − G'y)'v ≤ y'g + |d − G'y|'extent."""
    left = np.abs(d - G.T @ y)
    off = left > 0
    return float(y @ g + left[off] @ extent[off])


def power_of_two(sizes: np.ndarray) -> np.ndarray:
    """Return the powers of two next below sizes, 1 for those that are zero or infinite: units that
    change no digit."""
    usable = np.isfinite(sizes) & (sizes > 1e-200) & (sizes < 1e200)
    return 2.0 ** np.floor(np.log2(np.where(usable, sizes, 1.0)))
