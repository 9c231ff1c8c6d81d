"""States, feasible decisions and next states as one polytope, and its projection on the states.

A state θ and the decision variables z of the condensed problem are one vector v = (θ, z); the hard
rows are a polytope G v ≤ g of such pairs, and the state after the first input is θ⁺ = M v + t. The
feasible set is the projection of this polytope on θ; "every first input" and "some first input" are
linear programs over it, solved by HiGHS in float64.
"""

import time
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from jaxmpc.checks import fail
from jaxmpc.mpc.condense import Inequalities
from jaxmpc.pytrees import record
from jaxmpc.sets.convex_sets import Polytope
from jaxmpc.sets.geometry import Empty, Flat, affine_hull, framed, row_lengths
from jaxmpc.sets.lp import FLAT, Program, bound, extent, maximise, power_of_two

# Reasons why a set has no facets: it has no volume.
IS_EMPTY, IS_FLAT = "the feasible set is empty", "the feasible set is flat: it has no volume"
# Bounds of linear programs are trusted to this, relative to the size of the set.
TOLERANCE = 1e-9
# Facets are enumerated up to this dimension, and this many of them.
DIMENSIONS, FACETS = 4, 2000


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
        program = Program(self.normals, self.offsets)
        top = program.maximise(direction)
        return program.bound(direction, top, self.extent), top.x

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
                y, _ = scipy.optimize.nnls(E, target, maxiter=20 * E.shape[1])
            except RuntimeError:  # stays outside, where there is no plan
                continue
            r = E @ y - target
            if r[-1] < -1e-12:
                answer[i] -= unit * (scale * r[:-1] / r[-1])
        return answer


@record
class PlanPolytope:
    """The polytope {v = (θ, z): G v ≤ g} of states θ (p,) and decisions z that keep all rows.

    G (rows, p + nz) has rows of length 1. M (p, p + nz), t (p,): the state after the first input is
    M v + t. exact: False where a constraint is no row (the terminal ellipsoid) and the polytope is
    too large for that. flat: whether equalities tie the coordinates of θ to each other, so that the
    feasible set has no volume.

    Equalities that rows imply, as two opposite rows do, are taken out: z stands for the coordinates
    in which the polytope has volume.
    """

    G: np.ndarray
    g: np.ndarray
    M: np.ndarray
    t: np.ndarray
    exact: bool
    flat: bool = False

    @classmethod
    def of(cls, c: Any) -> "PlanPolytope":
        """Return the polytope of a `Condensed` problem whose arrays are NumPy's.

        Where input rates are limited, θ = (x, u_{−1}).
        """
        rows, _ = Inequalities.of(c).normalised()
        p = c.D.shape[1]
        M = np.vstack([np.hstack([c.Phi[1], c.Gamma[1]]), np.hstack([c.Psi[0], c.Omega[0]])])
        t = np.concatenate([c.phi[1], c.psi[0]])
        return cls(np.hstack([rows.D, rows.C]), rows.b, M[:p], t[:p], not c.balls).reduced()

    def reduced(self, tolerance: float = FLAT) -> "PlanPolytope":
        """Return the polytope in coordinates (θ, w) in which it has volume, v = shift + basis (θ,
        w). Rows that leave less room than `tolerance` are equalities."""
        if self.program.empty:
            return self
        hull = affine_hull(self.G, self.g, keep=self.p, tolerance=tolerance)
        if hull is None:
            return replace(self, flat=True)
        if not hull.equal.any():
            return self
        size = row_lengths(hull.G)
        M, t = self.M @ hull.basis, self.t + self.M @ hull.shift
        return PlanPolytope(hull.G / size[:, None], hull.g / size, M, t, self.exact)

    def in_units(self, unit: np.ndarray) -> "PlanPolytope":
        """Return the polytope of v / unit, unit (p + nz,) > 0."""
        G, state = self.G * unit, unit[: self.p]
        size = row_lengths(G)
        M, t = self.M * unit / state[:, None], self.t / state
        return replace(self, G=G / size[:, None], g=self.g / size, M=M, t=t)

    @property
    def p(self) -> int:
        """Return the number of coordinates of θ."""
        return len(self.t)

    @cached_property
    def program(self) -> Program:
        """Return the linear programs over the polytope."""
        return Program(self.G, self.g)

    @cached_property
    def extent(self) -> np.ndarray:
        """Return bounds |v_i| ≤ extent_i on the polytope."""
        return extent(self.G, self.g)

    def followed(self) -> "PlanPolytope":
        """Return the polytope of (θ, z, z⁺) with (θ, z) and (θ⁺, z⁺) both in this one: the
        decisions after which another one is feasible."""
        p = self.p
        state, plan = self.G[:, :p], self.G[:, p:]
        G = np.block([[self.G, np.zeros_like(plan)], [state @ self.M, plan]])
        g = np.concatenate([self.g, self.g - state @ self.t])
        size = row_lengths(G)
        M = np.hstack([self.M, np.zeros((p, plan.shape[1]))])
        return PlanPolytope(G / size[:, None], g / size, M, self.t, self.exact).reduced()

    def largest_next(self, normal: np.ndarray) -> tuple[float, float, np.ndarray | None]:
        """Return max normal'θ⁺ over the polytope as (attained value, upper bound, v).

        The bound holds for any LP error, by weak duality.
        """
        d, shift = normal @ self.M, float(normal @ self.t)
        top = self.program.maximise(d)
        return top.value + shift, self.program.bound(d, top, self.extent) + shift, top.x

    def support(self, direction: np.ndarray) -> tuple[float, np.ndarray | None]:
        """Return an upper bound of direction'θ over the polytope, as in `largest_next`, and where
        it is attained, (p,)."""
        d = np.append(direction, np.zeros(self.G.shape[1] - self.p))
        top = self.program.maximise(d)
        at = None if top.x is None else top.x[: self.p]
        return self.program.bound(d, top, self.extent), at

    def center(self) -> np.ndarray:
        """Return the θ of a point well inside. Raises ValueError where there is none, because the
        feasible set is empty or flat."""
        if self.flat:
            fail("mpc", "its feasible set is flat: equalities tie the states", "Relax one of them")
        return framed("mpc: its feasible set", self.G, self.g).center[: self.p]

    def ray(self, center: np.ndarray, direction: np.ndarray) -> tuple[float, np.ndarray, float]:
        """Return max s with center + s·direction in the projection, and a half-space a'θ ≤ b of it,
        as (s, a, b).

        The LP's multipliers y give a = G_θ'y and b = y'g, plus what their error G_z'y
        can add. Raises ValueError where the ray does not end.
        """
        p = self.p
        G = np.column_stack([self.G[:, :p] @ direction, self.G[:, p:]])
        top = maximise(np.eye(G.shape[1])[0], G, self.g - self.G[:, :p] @ center)
        if top.x is None or top.y is None:
            fail("centre", "the ray does not end inside the set", "Give a bounded problem")
        normal = self.G[:, :p].T @ top.y
        along = np.append(normal, np.zeros(G.shape[1] - 1))
        b = bound(along, top.y, self.G, self.g, self.extent)
        length = np.linalg.norm(normal)
        return top.value, normal / length, float(b / length)


def projected(plans: PlanPolytope, deadline: float = np.inf) -> CenteredPolytope | str:
    """Return the projection of a plan polytope on θ, all facets and vertices, or the reason why
    not.

    Rays at the vertices of an outer polytope add half-spaces, the duals of their LPs, until every
    vertex is reached (beneath-beyond), in coordinates in which the polytope is about 1 wide.
    deadline: of `time.monotonic`, in seconds.
    """
    if plans.p > DIMENSIONS:
        return f"vertices are not enumerated in {plans.p} dimensions (up to {DIMENSIONS} they are)"
    if plans.flat:
        return IS_FLAT
    try:
        center = plans.center()
    except Empty:
        return IS_EMPTY
    except Flat:
        thinner = plans.reduced(10 * FLAT)
        return IS_FLAT if thinner is plans else projected(thinner, deadline)
    except ValueError as error:
        return f"its facets are too ill-conditioned ({error})"
    extent = plans.extent
    if not np.all(np.isfinite(extent[: plans.p])):
        return "the feasible set is unbounded"
    unit = power_of_two(extent)
    plans, state = plans.in_units(unit), unit[: plans.p]
    p = plans.p
    directions = normals = np.concatenate([np.eye(p), -np.eye(p)])
    bounds, attained = zip(*(plans.support(d) for d in normals), strict=True)
    # The first centre may lie on a facet where decisions have little room, and rays from there
    # would be parallel to it; the mean of points on all sides of the set does not.
    center = np.mean([center / state, *(x for x in attained if x is not None)], axis=0)
    offsets, reached = np.array(bounds), np.zeros((0, p))
    many = "its facets are too many to enumerate in the time given"
    missed, ends = np.zeros((0, p)), []
    while len(offsets) < FACETS:
        last, short = missed, []
        for direction in directions:
            if time.monotonic() > deadline:
                return many
            s, normal, offset = plans.ray(center, direction)
            short.append(s < 1 - TOLERANCE)
            ends.append(center + s * direction)
            normals, offsets = np.vstack([normals, normal]), np.append(offsets, offset)
        reached = np.vstack([reached, (center + directions)[~np.array(short)]])
        center = np.mean(ends, axis=0)
        try:
            outer = Polytope(normals, offsets).require_body().reduce()
            vertices = outer.vertices()
        except ValueError as error:
            return f"its facets are too ill-conditioned ({error})"
        normals, offsets = np.asarray(outer.H), np.asarray(outer.h)
        scale = TOLERANCE * np.abs(vertices - center).max()
        near = lambda points, scale=scale, of=vertices: (
            np.abs(of[:, None] - points).max(axis=2, initial=0.0) <= scale
        ).any(axis=1)
        missed = vertices[~near(reached)]
        if not len(missed):
            size = np.linalg.norm(normals / state, axis=1)
            normals, offsets = normals / state / size[:, None], offsets / size
            return CenteredPolytope(center * state, normals, offsets, vertices * state)
        if near(last)[~near(reached)].all():  # rays at these vertices gave no half-space between
            return f"its vertices are not reached to {TOLERANCE:g} of its size"
        directions = missed - center
    return many
