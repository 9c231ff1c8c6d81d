"""Exact boundary of the feasible set along rays: one linear program a ray, both ends proved.

For a ray centre + t d the LP max t over (t, w) gives the boundary point; its dual gives a facet
of the feasible set there. HiGHS solves the LP; `proofs.py` then proves a point just inside
feasible, and a half-space valid on the whole set. Rays through the vertices of the intersection of
all half-spaces bring it and the hull of the points together (`close_gap`).
"""

import time
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np
from jax import Array
from scipy.spatial import KDTree

from jaxmpc.feasible import proofs
from jaxmpc.feasible.candidate_search import cut_of, inputs_of
from jaxmpc.feasible.condensed_rows import ConstraintRows
from jaxmpc.feasible.hard_constraints import ExactData
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.proofs import Cut
from jaxmpc.pytrees import record
from jaxmpc.qp.jax_transformations import own_modes
from jaxmpc.sets.geometry import Frame, hull_volume
from jaxmpc.sets.lp import power_of_two

# How far a boundary point is moved towards the centre before it is proved: the least that works.
BACKOFFS = 10.0 ** np.arange(-14, -1)
# The most rays that are sent in one round of `close_gap`.
MOST_RAYS = 2000


class ProvedBounds(NamedTuple):
    """Points (K, d) proved feasible, with w (K, k) of the constraint rows, and half-spaces
    normals (F, d) θ ≤ offsets (F,) valid on the whole set, with the cuts they follow from."""

    points: np.ndarray
    w: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray
    cuts: Cut

    @classmethod
    def of(
        cls, points: np.ndarray, w: np.ndarray, found: "Boundary | ProvedRays"
    ) -> "ProvedBounds":
        """Return points with their w, and of the half-spaces found those that exist."""
        valid = np.isfinite(found.offsets)
        cuts = Cut(*(part[valid] for part in found.cuts))
        return cls(points, w, found.normals[valid], found.offsets[valid], cuts)

    def joined(self, more: "ProvedBounds") -> "ProvedBounds":
        """Return these points and half-spaces and more."""
        return jax.tree.map(lambda *parts: np.concatenate(parts), self, more)


@record
class Boundary:
    """Rays from a point of the feasible set, and what was proved on each.

    center (d,): where they begin. directions (K, d): where they go.
    inner (K,): largest t for which centre + t d was proved feasible (NaN: none). outer (K,):
    where the ray leaves all the half-spaces (inf: never). points (K, d): the points at `inner`.
    w (K, k): with which the constraint rows hold there.
    normals (K, d), offsets (K,): half-spaces a'x ≤ b that hold on the whole feasible set
    (b = inf where the LP gave none). cuts: the `proofs.Cut` they follow from.
    """

    center: np.ndarray
    directions: np.ndarray
    inner: np.ndarray
    outer: np.ndarray
    points: np.ndarray
    w: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray
    cuts: Cut

    def __repr__(self) -> str:
        inside, bounded = np.isfinite(self.inner).sum(), np.isfinite(self.outer).sum()
        return (
            f"Boundary along {len(self.directions)} rays from {np.round(self.center, 6).tolist()}: "
            f"{inside} points proved feasible, {bounded} rays bounded"
        )

    @property
    def _proved(self) -> ProvedBounds:
        """Return the points and half-spaces of those rays that have them."""
        inside = np.isfinite(self.inner)
        return ProvedBounds.of(self.points[inside], self.w[inside], self)


def ray_directions(count: int, d: int) -> np.ndarray:
    """Return `count` directions in R^d: equally spaced in 2-D, random with a fixed seed above."""
    if d == 1:
        return np.array([[1.0], [-1.0]])
    if d == 2:
        angle = 2 * np.pi * np.arange(count) / count
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return of_length_one(np.random.default_rng(0).standard_normal((count, d)))


@record
class Rays:
    """Rays from one centre of the feasible set, for any number of directions.

    center (d,) with w: a feasible pair with a margin. exact: the data for proofs.
    """

    problem: FeasibilityProblem
    center: np.ndarray
    w: np.ndarray
    exact: ExactData

    @classmethod
    def of(cls, problem: FeasibilityProblem, center: np.ndarray | None = None) -> "Rays":
        """Return rays from the given centre, or from the point with the largest margin.

        Raises ValueError where the feasible set is empty or flat, or the centre not inside it.
        """
        center, w = problem.programs.center(center)
        return cls(problem, center, w, problem.exact(np.abs(center)))

    def box(self) -> ProvedBounds:
        """Return the half-spaces of the bounding box, those that exist."""
        _, sides = self.problem.programs.bounding_box
        # No rays go with these multipliers; the program is that of `cast`, so that one compiles.
        still = np.zeros((len(sides), len(BACKOFFS), 1))
        found = self.prove(still + self.center, still + self.w, sides)
        return ProvedBounds.of(self.center[None][:0], self.w[None][:0], found)

    def cast(self, directions: np.ndarray) -> Boundary:
        """Return the boundary points along every direction (K, d), moved inwards and proved."""
        solved = [self.problem.programs.ray(self.center, d) for d in directions]
        t, w, y = (np.array(part) for part in zip(*solved, strict=True))
        bounded = np.isfinite(t)
        # Shrinking a feasible pair (θ, w) towards the centre's pair gives every row a margin.
        reach = np.where(bounded, t, 0.0)[:, None] * (1 - BACKOFFS)
        theta = self.center + reach[:, :, None] * directions[:, None, :]
        w = self.w + (w - self.w)[:, None, :] * (1 - BACKOFFS)[:, None]
        found = self.prove(theta, w, y)
        feasible = found.feasible & bounded[:, None]
        best, each = np.argmax(feasible, axis=1), np.arange(len(directions))
        proved = feasible.any(axis=1)
        return Boundary(
            center=self.center,
            directions=directions,
            inner=np.where(proved, reach[each, best], np.nan),
            outer=leaving(self.center, directions, found.normals, found.offsets),
            points=np.where(proved[:, None], theta[each, best], np.nan),
            w=np.where(proved[:, None], w[each, best], np.nan),
            normals=found.normals,
            offsets=found.offsets,
            cuts=found.cuts,
        )

    def prove(self, theta: np.ndarray, w: np.ndarray, y: np.ndarray) -> "ProvedRays":
        """Return `prove_rays` of (K, backoffs, …) points and (K, R) multipliers."""
        count, fill = len(y), filled(len(y))
        points = theta[fill], w[fill], y[fill]
        # Arrays of NumPy go along faster than many small ones are put on a device one by one.
        with jax.enable_x64(True), jax.default_device(processor()):
            found = prove_rays(self.exact, self.problem.rows, *points)
        return jax.tree.map(lambda v: np.asarray(v)[:count], found)


def processor() -> jax.Device:
    """Return the device that proves what few rays find, one after the other: a CPU where JAX has
    one, which on a GPU would mean waiting for many small kernels."""
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:  # JAX_PLATFORMS leaves it out
        return jax.local_devices()[0]


def filled(count: int) -> np.ndarray:
    """Return 0, …, count − 1, and these again up to a power of two: few shapes compile."""
    return np.arange(max(32, 1 << (count - 1).bit_length())) % count


class ProvedRays(NamedTuple):
    """Which points (K, backoffs) of rays are proved feasible, and the half-spaces
    normals (K, d) θ ≤ offsets (K,) that hold on the whole feasible set, with their cuts."""

    feasible: Any
    normals: Any
    offsets: Any
    cuts: Cut


@jax.jit
@own_modes
def prove_rays(p: ExactData, rows: ConstraintRows, theta: Array, w: Array, y: Array) -> ProvedRays:
    """Prove points θ (K, backoffs, d) with w (K, backoffs, k), and half-spaces from multipliers y
    (K, R)."""

    def feasible(theta: Array, w: Array) -> Array:
        inputs, free = inputs_of(p, rows, theta, w)
        return proofs.prove_feasible(p, theta, free, inputs)[0]

    cuts = jax.vmap(lambda y: cut_of(p, rows, y))(y)
    normals, offsets = jax.vmap(lambda *cut: proofs.everywhere(p, *cut))(*cuts)
    return ProvedRays(jax.vmap(jax.vmap(feasible))(theta, w), normals, offsets, cuts)


def leaving(
    center: np.ndarray, directions: np.ndarray, normals: np.ndarray, offsets: np.ndarray
) -> np.ndarray:
    """Return t (K,) at which each ray leaves the intersection of the half-spaces; inf for never."""
    slope = directions @ normals.T
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (offsets - normals @ center) / slope
    return np.where(slope > 0, t, np.inf).min(axis=1, initial=np.inf)


class Casting(Protocol):
    """What sends rays: `Rays`, or those under affine policies."""

    @property
    def problem(self) -> FeasibilityProblem:
        """Return the problem."""

    @property
    def center(self) -> np.ndarray:
        """Return where the rays begin."""

    def box(self) -> ProvedBounds:
        """Return the half-spaces of the bounding box."""

    def cast(self, directions: np.ndarray) -> Boundary:
        """Return the proved ends of rays along directions (K, d)."""


def close_gap(
    rays: Casting, gap: float, rounds: int, most: int = MOST_RAYS, deadline: float = np.inf
) -> tuple[ProvedBounds, float]:
    """Send rays through the vertices of the outer polytope until the volumes differ by no more than
    `gap`, `most` of them a round, before `deadline` (of `time.monotonic`).

    Returns what they have proved, and the gap of the volumes of hull and intersection, relative to
    the latter; inf where one of them has none.
    """
    d = rays.problem.dimension
    box, _ = rays.problem.programs.bounding_box
    unit = power_of_two(np.zeros(d) if box is None else np.ptp(box, axis=0))
    directions = np.concatenate([np.eye(d), -np.eye(d), -np.ones((1, d))])
    proved, sent, left = rays.box(), of_length_one(directions), np.inf
    bounded, center = len(proved.offsets) == 2 * d, rays.center / unit
    for _ in range(rounds):
        if time.monotonic() > deadline:
            break
        proved = proved.joined(rays.cast(directions * unit)._proved)
        slack = proved.offsets - proved.normals @ rays.center
        if not len(slack) or slack.min() <= 0:  # thinner than rounding
            break
        outer = Frame.about(center, proved.normals * unit, slack)
        if not bounded and not outer.bounded:
            break
        try:
            vertices = outer.vertices()
            low, high = hull_volume(proved.points / unit), hull_volume(vertices)
        except ValueError:  # too thin for qhull
            break
        directions = fresh(vertices - center, sent)
        sent = np.concatenate([sent, of_length_one(directions)])
        left = (high - low) / high
        # Sets with a curved boundary have no end of vertices.
        if left <= gap or not 0 < len(directions) <= most:
            break
    return proved, left


def closed_bounds(
    problem: FeasibilityProblem, gap: float, rounds: int, most: int = MOST_RAYS, **how: float
) -> tuple[Rays, ProvedBounds, float]:
    """Return rays, what they have proved and the gap that is left, as in `close_gap`; those of an
    earlier call where that left no more than `gap`.

    Raises ValueError where the feasible set is empty or flat.
    """
    known = problem.memory.get("bounds")
    if known is None or known[-1] > gap:
        rays = Rays.of(problem)
        known = rays, *close_gap(rays, gap, rounds, most, **how)
        problem.memory["bounds"] = known
    return known


def of_length_one(directions: np.ndarray) -> np.ndarray:
    """Return directions (K, d) scaled to length one."""
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def fresh(directions: np.ndarray, sent: np.ndarray) -> np.ndarray:
    """Return the directions, except zeros, along which no ray of `sent` (unit length) has been
    sent."""
    directions = directions[np.any(directions != 0, axis=1)]
    distance = KDTree(sent).query(of_length_one(directions))[0]
    return directions[distance > 1e-9]
