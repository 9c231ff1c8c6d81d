"""One step of a controller as a polytope: states, feasible plans, and where their first move leads.

A state θ and a plan z are one vector v = (θ, z); the hard rows of the condensed problem are a
polytope G v ≤ g of such pairs, and the state after the first move is θ⁺ = M v + t. The feasible
set is the shadow of this polytope on θ; "every first move" and "some first move" are linear
programs over it. Host, float64, HiGHS.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import numpy as np

from jaxmpc.checks import fail
from jaxmpc.control.invariant import predecessor
from jaxmpc.control.sets import Box, Ellipsoid, Polytope, maximise, unit_rows
from jaxmpc.feasible.proofs import hard_part
from jaxmpc.mpc.condense import condense, in_float64
from jaxmpc.mpc.problem import MPC

# Bounds of linear programs are trusted to this, relative to the size of the set.
TOLERANCE = 1e-9
# Facets are enumerated up to this dimension, and this many of them.
DIMENSIONS, FACETS = 4, 2000


@dataclass(frozen=True)
class Pairs:
    """The polytope {v = (θ, z): G v ≤ g} of states θ (p,) and plans; G (rows, p + nz), unit rows.

    M (p, p + nz), t (p,): the state after the first move is M v + t. exact: False where a
    constraint is no row (the terminal ellipsoid), so that the polytope holds more than the pairs.
    equal (rows,): the rows of equalities, which leave no margin.
    """

    G: np.ndarray
    g: np.ndarray
    M: np.ndarray
    t: np.ndarray
    exact: bool
    equal: np.ndarray

    @property
    def p(self) -> int:
        """Number of coordinates of θ."""
        return len(self.t)

    @cached_property
    def extent(self) -> np.ndarray:
        """|v_i| ≤ extent_i on the polytope (twice what LPs find, which outweighs their error)."""
        return _extent(self.G, self.g)

    def twice(self) -> "Pairs":
        """The pairs that can go on: (θ, z, z⁺) with (θ, z) and (θ⁺, z⁺) both feasible."""
        p = self.p
        plan = self.G[:, p:]
        first = np.hstack([self.G, np.zeros_like(plan)])
        then = np.hstack([self.G[:, :p] @ self.M, plan])
        g = np.concatenate([self.g, self.g - self.G[:, :p] @ self.t])
        G = np.vstack([first, then])
        size = np.linalg.norm(G, axis=1)
        size[size == 0] = 1.0
        M = np.hstack([self.M, np.zeros((p, plan.shape[1]))])
        return Pairs(
            G / size[:, None], g / size, M, self.t, self.exact, np.tile(self.equal, 2)
        )  # fmt: skip

    def largest(self, normal: np.ndarray) -> tuple[float, float, np.ndarray | None]:
        """max normal'θ⁺ over all pairs: (attained value, upper bound, v).

        The bound holds whatever the LP's error: for any y ≥ 0,
        d'v = y'G v + (d − G'y)'v ≤ y'g + |d − G'y|'extent.
        """
        d = normal @ self.M
        top, shift = maximise(d, self.G, self.g), float(normal @ self.t)
        if top.x is None or top.y is None:
            return top.value, top.value, None
        return top.value + shift, self._bound(d, top.y) + shift, top.x

    def support(self, direction: np.ndarray) -> float:
        """Upper bound of direction'θ over all pairs, in the same way."""
        d = np.append(direction, np.zeros(self.G.shape[1] - self.p))
        top = maximise(d, self.G, self.g)
        return top.value if top.y is None else self._bound(d, top.y)

    def _bound(self, d: np.ndarray, y: np.ndarray) -> float:
        return _bound(d, y, self.G, self.g, self.extent)

    def centre(self) -> np.ndarray | None:
        """The θ of the pair with the largest margin, equalities apart; None without any."""
        size = self.G.shape[1]
        margin = np.where(self.equal, 0.0, 1.0)[:, None]
        wide = np.vstack([np.hstack([self.G, margin]), np.eye(size + 1)[-1:]])
        room = max(1.0, float(np.abs(self.g).max(initial=0.0)))
        top = maximise(np.eye(size + 1)[-1], wide, np.append(self.g, room))
        return None if top.x is None or top.value <= TOLERANCE else top.x[: self.p]

    def ray(self, centre: np.ndarray, direction: np.ndarray) -> tuple[float, np.ndarray, float]:
        """max s with centre + s·direction in the shadow, and a half-space a'θ ≤ b of the shadow.

        (s, a, b). The LP's multipliers y give a = G_θ'y and b = y'g, plus what their error G_z'y
        can add. Raises ValueError where the ray does not end.
        """
        p = self.p
        G = np.column_stack([self.G[:, :p] @ direction, self.G[:, p:]])
        top = maximise(np.eye(G.shape[1])[0], G, self.g - self.G[:, :p] @ centre)
        if top.x is None or top.y is None:
            fail("centre", "the ray does not end inside the set", "Give a bounded problem")
        normal = self.G[:, :p].T @ top.y
        b = self._bound(np.append(normal, np.zeros(G.shape[1] - 1)), top.y)
        length = np.linalg.norm(normal)
        return top.value, normal / length, float(b / length)


def _extent(G: np.ndarray, g: np.ndarray) -> np.ndarray:
    size = G.shape[1]
    ends = [maximise(s * e, G, g).value for e in np.eye(size) for s in (1, -1)]
    return 2 * np.abs(ends).reshape(size, 2).max(axis=1) + 1e-300


def _bound(d: np.ndarray, y: np.ndarray, G: np.ndarray, g: np.ndarray, extent: np.ndarray) -> float:
    left = np.abs(d - G.T @ y)
    off = left > 0
    return float(y @ g + left[off] @ extent[off])


def pairs(mpc: MPC) -> Pairs:
    """All pairs of a state and a plan that keep every hard row of `mpc`; soft rows count for none.

    Where input rates are limited, θ = (x, u_{−1}).
    """
    with jax.enable_x64(True):
        c = jax.tree.map(np.asarray, condense(in_float64(hard_part(mpc))))
    kept = len(c.C) - sum(c.balls)
    C, D, shift = c.C[:kept], c.D[:kept], c.d[:kept]
    lower, upper = c.lower[:kept] - shift, c.upper[:kept] - shift
    up, low = np.isfinite(upper), np.isfinite(lower)
    rows = np.hstack([D, C])
    G = np.vstack([rows[up], -rows[low]])
    g = np.concatenate([upper[up], -lower[low]])
    size = np.linalg.norm(G, axis=1)
    size[size == 0] = 1.0
    p = D.shape[1]
    M = np.vstack([np.hstack([c.Phi[1], c.Gamma[1]]), np.hstack([c.Psi[0], c.Omega[0]])])
    t = np.concatenate([c.phi[1], c.psi[0]])
    equal = np.concatenate([(lower == upper)[up], (lower == upper)[low]])
    return Pairs(G / size[:, None], g / size, M[:p], t[:p], not c.balls, equal)


@dataclass(frozen=True)
class Shadow:
    """The states θ of pairs as a polytope: normals (K, p) of length 1, offsets (K,), vertices.

    The half-spaces are valid; each vertex of their intersection was reached to `TOLERANCE`.
    vertices (0, p): not enumerated, the half-spaces come from `backward`.
    """

    center: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray
    vertices: np.ndarray

    @property
    def size(self) -> float:
        """Largest distance of a facet from the centre, the scale of tolerances."""
        return float(np.max(self.offsets - self.normals @ self.center))

    @cached_property
    def extent(self) -> np.ndarray:
        """|θ_i| ≤ extent_i, as in `Pairs`."""
        return _extent(self.normals, self.offsets)

    def support(self, direction: np.ndarray) -> tuple[float, np.ndarray | None]:
        """Upper bound of max direction'θ, as in `Pairs.largest`, and where it is attained."""
        top = maximise(direction, self.normals, self.offsets)
        if top.y is None:
            return top.value, None
        return _bound(direction, top.y, self.normals, self.offsets, self.extent), top.x

    @property
    def polytope(self) -> Polytope:
        """The same as H x ≤ h."""
        return Polytope(self.normals, self.offsets)

    def excess(self, points: np.ndarray) -> np.ndarray:
        """Largest distance (B,) by which each point (B, p) exceeds a half-space."""
        return np.max(points @ self.normals.T - self.offsets, axis=1)


def shadow(pairs: Pairs, deadline: float = np.inf) -> Shadow | str:
    """All facets and vertices of the states θ of `pairs`, or the reason why there are none.

    Rays at the vertices of an outer polytope add half-spaces, the duals of their LPs, until every
    vertex is reached (beneath-beyond). deadline: of `time.monotonic`, in seconds.
    """
    if pairs.p > DIMENSIONS:
        return f"vertices are not enumerated in {pairs.p} dimensions (up to {DIMENSIONS} they are)"
    center = pairs.centre()
    if center is None:
        return "the feasible set is empty or flat"
    p = pairs.p
    directions = normals = np.concatenate([np.eye(p), -np.eye(p)])
    offsets, reached = np.array([pairs.support(d) for d in normals]), np.zeros((0, p))
    if not np.all(np.isfinite(offsets)):
        return "the feasible set is unbounded"
    while time.monotonic() < deadline and len(offsets) < FACETS:
        missed = []
        for direction in directions:
            s, normal, offset = pairs.ray(center, direction)
            missed.append(s < 1 - TOLERANCE)
            normals, offsets = np.vstack([normals, normal]), np.append(offsets, offset)
        reached = np.vstack([reached, (center + directions)[~np.array(missed)]])
        try:
            outer = Polytope(normals, offsets).reduce()
            vertices = outer.vertices()
        except ValueError as error:
            return f"its facets are too ill-conditioned ({error})"
        normals, offsets = np.asarray(outer.H), np.asarray(outer.h)
        scale = TOLERANCE * np.abs(vertices - center).max()
        near = np.abs(vertices[:, None] - reached).max(axis=2, initial=0.0) <= scale
        directions = vertices[~near.any(axis=1)] - center
        if not len(directions):
            return Shadow(center, normals, offsets, vertices)
    return "its facets are too many to enumerate in the time given"


def backward(mpc: MPC, deadline: float = np.inf) -> tuple[Shadow, Shadow, Shadow] | str:
    """X_{N−1}, X_N and X_{N+1} by X_{k+1} = states ∩ Pre(X_k), or the reason why not.

    Half-spaces without vertices, by elimination (`predecessor`): for problems of many states
    whose limits couple few of them. Only for limits on states and inputs at the usual steps.
    """
    last: Any = mpc.terminal_set
    if not usual(mpc) or not mpc.constrain_initial or mpc.states is None or mpc.horizon < 2:
        return "its facets are enumerated for limits of states and inputs alone"
    if isinstance(last, Ellipsoid):
        return "the terminal set has no facets"
    # Without a terminal set x_0 ∈ X is all that a horizon of 1 asks.
    body, count = (mpc.states, mpc.horizon) if last is None else (last, mpc.horizon + 1)
    found = []
    for k in range(count):
        try:
            body = predecessor(mpc.system, body, mpc.states, mpc.inputs).reduce()
        except ValueError as error:
            return f"its facets are not found ({error})"
        if time.monotonic() > deadline or np.size(body.h) > FACETS // 4:
            return "its facets are too many to enumerate in the time given"
        if k >= count - 3:
            found.append(body)
    if last is None and mpc.horizon == 2:
        found = [mpc.states.to_polytope() if isinstance(mpc.states, Box) else mpc.states, *found]
    none = np.zeros((0, mpc.system.n))
    one, two, three = (
        Shadow(part.chebyshev()[0], *unit_rows(part.H, part.h), none) for part in found[-3:]
    )
    return one, two, three


def usual(mpc: MPC) -> bool:
    """True for limits on states and inputs alone, at the usual steps, inputs free at each step."""
    free = not (mpc.outputs or mpc.rate_limited) and mpc.control_horizon is None
    return free and mpc.constrained_steps is None


def feasible_polytope(mpc: MPC) -> Polytope:
    """The feasible set X_N as a polytope, every facet once: {θ : some plan keeps every hard row}.

    θ is x, or (x, u_{−1}) where input rates are limited. Facets come from the duals of linear
    programs and are valid; each vertex was reached by one, to 1e-9 of the set's size. For a map
    with proofs against rounding, slices, projections or an ellipsoidal terminal set use
    `map_feasible_set(...).refine()`; one step at a time, `predecessor`.

    In more than four dimensions X_N comes from N steps of `predecessor` instead, for limits of
    states and inputs alone; that works while the limits couple few states.

    Raises ValueError where X_N is empty, flat or unbounded, for an ellipsoidal terminal set, and
    where there are too many facets. Host, float64.
    """
    mpc.validate()
    everything = pairs(mpc)
    if not everything.exact:
        fail("terminal_set", "is an Ellipsoid, so X_N has a curved boundary", "Map it and refine()")
    if everything.p <= DIMENSIONS:
        body = shadow(everything)
    else:
        sets = backward(mpc)
        body = sets if isinstance(sets, str) else sets[1]
    if isinstance(body, str):
        fail("mpc", body, "Map it with map_feasible_set, which has no such limit")
    return body.polytope


@dataclass(frozen=True)
class Growth:
    """Feasible sets at several horizons: horizons (H,), volume (H,), facets (H,), and the sets."""

    horizons: np.ndarray
    volume: np.ndarray
    facets: np.ndarray
    sets: tuple[Polytope, ...]


def feasible_growth(mpc: MPC, horizons: Sequence[int]) -> Growth:
    """How X_N grows or shrinks with N: `feasible_polytope` at each of `horizons`.

    Raises ValueError as `feasible_polytope` does, and where steps or blocks of `mpc` fit one
    horizon only.
    """
    sets = tuple(feasible_polytope(replace(mpc, horizon=int(N))) for N in horizons)
    return Growth(
        horizons=np.array(horizons, int),
        volume=np.array([body.volume() for body in sets]),
        facets=np.array([len(np.asarray(body.h)) for body in sets]),
        sets=sets,
    )
