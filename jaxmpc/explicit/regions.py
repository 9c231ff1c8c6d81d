"""The explicit solution of an MPC problem: its critical regions, and the law on them."""

import time
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from jaxmpc.checks import fail
from jaxmpc.control.sets import Box, Polytope, unit_rows
from jaxmpc.explicit.cells import Cell, volume
from jaxmpc.explicit.least_distance import LeastDistanceForm, least_distance_form
from jaxmpc.explicit.search import RegionSearch, explore
from jaxmpc.mpc.problem import MPC


@dataclass(frozen=True, eq=False)
class Region:
    """One critical region and its affine law.

    rows (a,): active rows of `Condensed.C`. On the region the optimal decision is z = Z x + z0
    (nz,), its multipliers y = L x + l0 (a,) for the cost without ½ (y ≥ 0 at an upper bound,
    y ≤ 0 at a lower one), the first input u_0 = K x + k (m,), a prestabilising gain included.
    also_active: rows that are active all over the region and depend on `rows`.
    polytope: irredundant unit rows in the p = mpc.dimension coordinates of the state;
    vertices (k, p); volume.
    """

    rows: np.ndarray
    also_active: np.ndarray
    Z: np.ndarray
    z0: np.ndarray
    L: np.ndarray
    l0: np.ndarray
    K: np.ndarray
    k: np.ndarray
    polytope: Polytope
    vertices: np.ndarray
    volume: float


@dataclass(frozen=True, eq=False)
class CriticalRegions:
    """Critical regions of an MPC problem: the polytopes on which its plan is affine in x0.

    complete: the regions fill X_N, i.e. the volumes sum to that of the hull of all vertices, and
    no support LP finds a point of X_N beyond a facet of that hull (both to 1e-9 of its size).
    volume: their sum. reason: what was checked, or what stopped the search.
    """

    mpc: MPC
    regions: tuple[Region, ...]
    complete: bool
    volume: float
    reason: str
    seconds: float

    @classmethod
    def of(cls, mpc: MPC, search: RegionSearch) -> "CriticalRegions":
        """Return what a search has found, in the coordinates of x, and whether it fills X_N."""
        complete, reason = search.fill()
        regions = tuple(region(search.p, c) for c in search.found)
        total = float(sum(r.volume for r in regions))
        seconds = time.perf_counter() - search.begun
        return cls(mpc, regions, complete, total, reason, seconds)

    def __len__(self) -> int:
        return len(self.regions)

    def __getitem__(self, i: int) -> Region:
        return self.regions[i]

    def vertices(self, i: int) -> np.ndarray:
        """Return (k, p) vertices of region i."""
        return self.regions[i].vertices

    def find(self, x: Any, tolerance: float = 1e-9) -> np.ndarray:
        """Return the index (B,) of the region that holds each state x (B, p), −1 where none does.

        tolerance: how far outside all regions a state may lie, relative to the size of X_N.
        """
        x = self._states(x)
        H, h, starts, size = self._stacked
        answer = np.full(len(x), -1)
        finite = np.flatnonzero(np.all(np.isfinite(x), axis=1))
        for i in range(0, len(finite), 256):
            chunk = finite[i : i + 256]
            beyond = np.maximum.reduceat(x[chunk] @ H.T - h, starts, axis=1)
            near = beyond.min(axis=1) <= tolerance * size
            answer[chunk] = np.where(near, beyond.argmin(axis=1), -1)
        return answer

    def plan(self, x: Any) -> np.ndarray:
        """Return optimal decisions z (B, nz) at states x (B, p); NaN where no region holds a
        state."""
        return self._evaluate(x, "Z", "z0")

    def law(self, x: Any) -> np.ndarray:
        """Return first inputs u_0 (B, m) at states x (B, p); NaN where no region holds a state."""
        return self._evaluate(x, "K", "k")

    def _evaluate(self, x: Any, gain: str, offset: str) -> np.ndarray:
        x = self._states(x)
        where = self.find(x)
        values = np.full((len(x), len(getattr(self.regions[0], offset))), np.nan)
        for i in np.unique(where[where >= 0]):
            region, here = self.regions[i], where == i
            values[here] = x[here] @ getattr(region, gain).T + getattr(region, offset)
        return values

    def _states(self, x: Any) -> np.ndarray:
        x, p = np.asarray(x, np.float64), self.mpc.dimension
        if x.ndim != 2 or x.shape[1] != p:
            fail("x", f"shape {x.shape}", f"Give states (B, {p})")
        return x

    @cached_property
    def _stacked(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        H = [np.asarray(region.polytope.H) for region in self.regions]
        h = np.concatenate([np.asarray(region.polytope.h) for region in self.regions])
        starts = np.cumsum([0] + [len(part) for part in H[:-1]])
        points = np.concatenate([region.vertices for region in self.regions])
        return np.vstack(H), h, starts, float(np.ptp(points, axis=0).max())


def critical_regions(
    mpc: MPC, *, limit: int = 5000, within: Box | Polytope | None = None, seconds: float = np.inf
) -> CriticalRegions:
    """Return all critical regions of positive volume of the MPC problem (multiparametric QP).

    limit: the most regions to look for. within: the set of initial states, needed where the
    feasible set X_N is unbounded. seconds: after which the search stops (some linear programs and
    the hull of all vertices are finished; in five and six dimensions that may take long). The
    search crosses every facet of every region: a row that becomes active joins the active set, a
    multiplier that vanishes leaves it, and where the new row depends on the others each of those
    that the dual ratio test may drop is tried; what this leaves open is found by solving the QP
    just behind the facet. `complete` does not rest on the search having ended but on the volumes
    (see `CriticalRegions`). NumPy in float64; not traceable.

    Raises ValueError for ill-posed problems, soft rows or an ellipsoidal terminal set (their
    laws are not piecewise affine in this form), and where X_N is empty, flat or unbounded.

    Sources: Bemporad, Morari, Dua & Pistikopoulos 2002, Automatica 38; Tøndel, Johansen &
    Bemporad 2003, Automatica 39 (crossing facets by active sets); Lawson & Hanson 1974, ch. 23
    (least distance by NNLS).
    """
    deadline = time.monotonic() + seconds
    mpc.validate()
    if mpc.soft:
        fail("mpc.soft", "has rows, and slacks make another QP", "Make the rows hard first")
    return CriticalRegions.of(mpc, explore(least_distance_form(mpc, within), limit, deadline))


def region(p: LeastDistanceForm, c: Cell) -> Region:
    """Return a cell in the coordinates of x, with the law of z, the multipliers and the first
    input."""
    rows = list(c.law.active)
    on_x = (
        lambda by_xi: (  # affine in ξ, constant last → affine in x
            by_xi[:, :-1] / p.size,
            by_xi[:, -1] - by_xi[:, :-1] / p.size @ p.center,
        )
    )
    (L, l0), (Y, y0), n = on_x(c.law.multipliers), on_x(c.law.y), len(p.center)
    Z = np.linalg.solve(p.factor.T, Y - p.shift[:, :n])
    z0 = np.linalg.solve(p.factor.T, y0 - p.shift[:, n])
    sign = p.side[rows] / p.length[rows]
    H, h = c.H / p.size, c.h + c.H / p.size @ p.center
    vertices = p.center + c.vertices * p.size
    condensed = p.condensed
    return Region(
        rows=p.row[rows], also_active=p.row[list(c.law.also_active)],
        Z=Z, z0=z0, L=sign[:, None] * L, l0=sign * l0,
        K=np.asarray(condensed.Psi[0] + condensed.Omega[0] @ Z),
        k=np.asarray(condensed.Omega[0] @ z0 + condensed.psi[0]),
        polytope=Polytope(*unit_rows(H, h)), vertices=vertices,
        volume=volume(c.vertices) * float(np.prod(p.size)),
    )  # fmt: skip
