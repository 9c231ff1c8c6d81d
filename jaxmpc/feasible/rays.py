"""Exact boundary of the feasible set along rays: one linear program a ray, both ends proved.

For a ray centre + t d the LP max t over (t, w) gives the boundary point; its dual gives a facet
of the feasible set there. HiGHS solves the LP; `proofs.py` then proves a point just inside
feasible, and a half-space valid on the whole set.
"""

from typing import Any

import jax
import numpy as np
from jax import Array

from jaxmpc.arrays import host_array
from jaxmpc.checks import fail
from jaxmpc.feasible import proofs
from jaxmpc.feasible.candidates import cut_of, inputs_of
from jaxmpc.feasible.constraint_rows import ConstraintRows
from jaxmpc.feasible.exact_data import ExactData
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.mpc.problem import MPC
from jaxmpc.pytrees import record
from jaxmpc.qp.modes import own_modes

# How far a boundary point is moved towards the centre before it is proved: the least that works.
BACKOFFS = 10.0 ** np.arange(-14, -1)


# a (K, d), b (K,), w (K, d): a'θ ≤ b + w'|θ| for every feasible θ.
Cuts = tuple[np.ndarray, np.ndarray, np.ndarray]


@record
class Boundary:
    """Rays from `center` (d,) along `directions` (K, d), and what was proved on each.

    inner (K,): largest t for which centre + t d was proved feasible (NaN: none). outer (K,):
    where the ray leaves all the half-spaces (inf: never). points (K, d): the points at `inner`,
    w (K, k): with which the constraint rows hold there.
    normals (K, d), offsets (K,): half-spaces a'x ≤ b that hold on the whole feasible set
    (b = inf where the LP gave none), and cuts, the bounds (a, b, w) of `proofs.cut` they follow
    from.
    """

    center: np.ndarray
    directions: np.ndarray
    inner: np.ndarray
    outer: np.ndarray
    points: np.ndarray
    w: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray
    cuts: Cuts


def boundary(
    mpc: MPC, directions: int | np.ndarray, *, center: np.ndarray | None = None,
    axes: tuple[int, ...] | None = None, fixed: np.ndarray | None = None,
) -> Boundary:  # fmt: skip
    """Compute exact boundary points and facets of the feasible set of `mpc` along rays.

    directions: a number of rays (equally spaced in 2-D, random in more dimensions) or an array
    (K, d). center: a feasible point (d,); None: the point with the largest margin. axes, fixed: a
    slice or projection as in `map_feasible_set`, whose feasible set this is. Raises ValueError
    where it is empty or flat, or the centre is not inside it.
    """
    problem = FeasibilityProblem.of(mpc, axes, fixed)
    d = problem.dimension
    if isinstance(directions, int | np.integer):
        directions = ray_directions(max(int(directions), 0), d)
    directions = host_array("directions", directions)
    if directions.ndim != 2 or directions.shape[1] != d or not np.all(np.isfinite(directions)):
        fail("directions", f"shape {directions.shape}", f"Give finite rays (K, {d}) or a number")
    if not len(directions) or not np.all(np.any(directions != 0, axis=1)):
        fail("directions", "holds no ray, or a zero row", "Give at least one direction")
    if center is not None and (np.shape(center) != (d,) or not np.all(np.isfinite(center))):
        fail("center", f"{center}", f"Give one finite point ({d},)")
    return Rays.of(problem, center).cast(directions)


def ray_directions(count: int, d: int) -> np.ndarray:
    """Return `count` directions in R^d: equally spaced in 2-D, random with a fixed seed above."""
    if d == 1:
        return np.array([[1.0], [-1.0]])
    if d == 2:
        angle = 2 * np.pi * np.arange(count) / count
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    normal = np.random.default_rng(0).standard_normal((count, d))
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


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
        center, w = problem.programs.centre(center)
        return cls(problem, center, w, problem.exact(np.abs(center)))

    def box(self) -> tuple[np.ndarray, np.ndarray, Cuts]:
        """Return the half-spaces (normals, offsets) of the bounding box, those that exist, and
        their cuts."""
        _, sides = self.problem.programs.bounding_box
        # No rays go with these multipliers; the program is that of `cast`, so that one compiles.
        still = np.zeros((len(sides), len(BACKOFFS), 1))
        _, normals, offsets, *cuts = self.proved(still + self.center, still + self.w, sides)
        valid = np.isfinite(offsets)
        a, b, w = (v[valid] for v in cuts)
        return normals[valid], offsets[valid], (a, b, w)

    def cast(self, directions: np.ndarray) -> Boundary:
        """Return the boundary points along every direction (K, d), moved inwards and proved."""
        solved = [self.problem.programs.ray(self.center, d) for d in directions]
        t, w, y = (np.array(part) for part in zip(*solved, strict=True))
        bounded = np.isfinite(t)
        # Shrinking a feasible pair (θ, w) towards the centre's pair gives every row a margin.
        reach = np.where(bounded, t, 0.0)[:, None] * (1 - BACKOFFS)
        theta = self.center + reach[:, :, None] * directions[:, None, :]
        w = self.w + (w - self.w)[:, None, :] * (1 - BACKOFFS)[:, None]
        feasible, normals, offsets, *cuts = self.proved(theta, w, y)
        feasible = feasible & bounded[:, None]
        best, each = np.argmax(feasible, axis=1), np.arange(len(directions))
        found = feasible.any(axis=1)
        return Boundary(
            center=self.center,
            directions=directions,
            inner=np.where(found, reach[each, best], np.nan),
            outer=leaving(self.center, directions, normals, offsets),
            points=np.where(found[:, None], theta[each, best], np.nan),
            w=np.where(found[:, None], w[each, best], np.nan),
            normals=normals,
            offsets=offsets,
            cuts=(cuts[0], cuts[1], cuts[2]),
        )

    def proved(self, theta: np.ndarray, w: np.ndarray, y: np.ndarray) -> list[np.ndarray]:
        """Return `prove_rays` of (K, backoffs, …) points and (K, R) multipliers."""
        count, fill = len(y), filled(len(y))
        with jax.enable_x64(True):
            found = prove_rays(self.exact, self.problem.rows, theta[fill], w[fill], y[fill])
        return [np.asarray(v)[:count] for v in found]


def filled(count: int) -> np.ndarray:
    """Return 0, …, count − 1, and these again up to a power of two: few shapes compile."""
    return np.arange(max(32, 1 << (count - 1).bit_length())) % count


@jax.jit
@own_modes
def prove_rays(p: ExactData, rows: ConstraintRows, theta: Any, w: Any, y: Any) -> tuple[Array, ...]:
    """Return which points (K, backoffs, d) of the rays are proved feasible, and the normals (K, d)
    and offsets (K,) of half-spaces that hold on the whole feasible set, from multipliers (K, R),
    with the bounds of `proofs.cut` they follow from."""

    def feasible(theta: Array, w: Array) -> Array:
        inputs, free = inputs_of(p, rows, theta, w)
        return proofs.prove_feasible(p, theta, free, inputs)[0]

    cuts = jax.vmap(lambda y: cut_of(p, rows, y))(y)
    half_spaces = jax.vmap(lambda *cut: proofs.everywhere(p, *cut))(*cuts)
    return jax.vmap(jax.vmap(feasible))(theta, w), *half_spaces, *cuts


def leaving(
    center: np.ndarray, directions: np.ndarray, normals: np.ndarray, offsets: np.ndarray
) -> np.ndarray:
    """Return t (K,) at which each ray leaves the intersection of the half-spaces; inf for never."""
    slope = directions @ normals.T
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (offsets - normals @ center) / slope
    return np.where(slope > 0, t, np.inf).min(axis=1, initial=np.inf)
