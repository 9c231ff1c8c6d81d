"""Exact boundary of the feasible set along rays: one linear program a ray, both ends proved.

For a ray centre + t d the LP max t over (t, w) gives the boundary point; its dual gives a facet
of the feasible set there. HiGHS solves the LP; what is reported is what `proofs.py` confirms: a
point proved feasible just inside, and a half-space that holds on the whole set.
"""

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax import Array

from jaxmpc.checks import fail
from jaxmpc.feasible import proofs
from jaxmpc.feasible.candidates import (
    Rows,
    Tangents,
    bounding_box,
    cut_of,
    inputs_of,
    rows,
    support,
)
from jaxmpc.feasible.proofs import Problem, View, hard_part, make_view
from jaxmpc.mpc.problem import MPC

# How far a boundary point is pulled towards the centre before it is proved: the least that works.
PULLS = 10.0 ** np.arange(-14, -1)


@dataclass(frozen=True)
class Boundary:
    """Rays from `center` (d,) along `directions` (K, d), and what was proved on each.

    inner (K,): largest t for which centre + t d was proved feasible (NaN: none). outer (K,):
    where the ray leaves all the half-spaces (inf: never). points (K, d): the points at `inner`.
    normals (K, d), offsets (K,): half-spaces a'x ≤ b that hold on the whole feasible set
    (b = inf where the LP gave none).
    """

    center: np.ndarray
    directions: np.ndarray
    inner: np.ndarray
    outer: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray


def boundary(
    mpc: MPC, directions: int | np.ndarray, *, center: np.ndarray | None = None,
    axes: tuple[int, ...] | None = None, fixed: np.ndarray | None = None,
) -> Boundary:  # fmt: skip
    """Exact boundary points and facets of the feasible set of `mpc` along rays.

    directions: a number of rays (equally spaced in 2-D, random in more dimensions) or an array
    (K, d). center: a feasible point (d,); None: the point with the largest margin. axes, fixed:
    a slice or projection as in `map_feasible_set`. Raises ValueError where the feasible set is
    empty or flat, or the centre is not inside it.
    """
    mpc.validate()
    mpc = hard_part(mpc)
    view = make_view(mpc, axes, fixed)
    d = len(view.axes)
    if isinstance(directions, int | np.integer):
        directions = spread(max(int(directions), 0), d)
    directions = np.asarray(directions, np.float64)
    if directions.ndim != 2 or directions.shape[1] != d or not np.all(np.isfinite(directions)):
        fail("directions", f"shape {directions.shape}", f"Give finite rays (K, {d}) or a number")
    if not len(directions) or not np.all(np.any(directions != 0, axis=1)):
        fail("directions", "holds no ray, or a zero row", "Give at least one direction")
    if center is not None and (np.shape(center) != (d,) or not np.all(np.isfinite(center))):
        fail("center", f"{center}", f"Give one finite point ({d},)")
    return Rays(mpc, view, center).shoot(directions)


def spread(count: int, d: int) -> np.ndarray:
    """`count` directions in R^d: equally spaced in 2-D, random with a fixed seed above."""
    if d == 1:
        return np.array([[1.0], [-1.0]])
    if d == 2:
        angle = 2 * np.pi * np.arange(count) / count
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    normal = np.random.default_rng(0).standard_normal((count, d))
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


class Rays:
    """The ray LP of one problem and view, set up once for many rays."""

    def __init__(self, mpc: MPC, view: View, center: np.ndarray | None = None) -> None:
        self.rows = rows(mpc, view)
        self.tangents = Tangents(self.rows)
        self.center, self.w = self._centre(center)
        extent, self.sides = bounding_box(self.rows, np.abs(self.center))
        self.problem = proofs.problem(mpc, view, extent)

    def _centre(self, center: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """θ (the given one, or the best) and w with the largest common margin of all rows."""
        U, D = self.rows.U, self.rows.D
        k, d = U.shape[1], D.shape[1]
        size = np.linalg.norm(np.hstack([U, D]), axis=1)
        pinned = [(None, None)] * d if center is None else [(v, v) for v in np.asarray(center)]
        ends = np.concatenate([self.rows.upper, self.rows.lower])
        largest = max(1.0, np.abs(ends[np.isfinite(ends)]).max(initial=0.0))
        if self.rows.balls:
            size[-sum(self.rows.balls) :] = size[-sum(self.rows.balls) :].max()
        result, _ = self.tangents.solve(
            np.eye(k + d + 1)[-1], np.hstack([U, D, np.zeros((len(U), 1))]), self.rows.lower,
            self.rows.upper, [(None, None)] * k + pinned + [(None, largest)], size,
        )  # fmt: skip
        if result.x is None or result.x[-1] <= 1e-9:
            if center is not None:
                fail("center", f"{center} is not inside the feasible set", "Give None or another")
            fail(
                "mpc", "its feasible set is empty or flat: no initial state keeps a margin",
                "Relax a limit, lengthen the horizon or enlarge the terminal set",
            )  # fmt: skip
        return result.x[k : k + d], result.x[:k]

    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Half-spaces (normals, offsets) of the bounding box, as far as there is one."""
        with jax.enable_x64(True):
            normals, offsets = (
                np.asarray(v) for v in half_spaces(self.problem, self.rows, self.sides)
            )
        valid = np.isfinite(offsets)
        return normals[valid], offsets[valid]

    def shoot(self, directions: np.ndarray) -> Boundary:
        """Solve, pull and prove along every direction (K, d)."""
        solved = [support(self.rows, d, self.center, self.tangents) for d in directions]
        t, w, y = (np.array(part) for part in zip(*solved, strict=True))
        bounded = np.isfinite(t)
        # Shrinking a feasible pair (θ, w) towards the centre's pair gives every row a margin.
        reach = np.where(bounded, t, 0.0)[:, None] * (1 - PULLS)
        theta = self.center + reach[:, :, None] * directions[:, None, :]
        w = self.w + (w - self.w)[:, None, :] * (1 - PULLS)[:, None]
        # Repeated rays fill up to a power of two, so that few shapes compile.
        count = len(directions)
        fill = np.arange(max(32, 1 << (count - 1).bit_length())) % count
        with jax.enable_x64(True):
            feasible, normals, offsets = (
                np.asarray(v)[:count]
                for v in prove(self.problem, self.rows, theta[fill], w[fill], y[fill])
            )
        feasible = feasible & bounded[:, None]
        best, each = np.argmax(feasible, axis=1), np.arange(len(directions))
        found = feasible.any(axis=1)
        return Boundary(
            center=self.center,
            directions=directions,
            inner=np.where(found, reach[each, best], np.nan),
            outer=leaving(self.center, directions, normals, offsets),
            points=np.where(found[:, None], theta[each, best], np.nan),
            normals=normals,
            offsets=offsets,
        )


@jax.jit
def prove(p: Problem, rows: Rows, theta: Any, w: Any, y: Any) -> tuple[Array, ...]:
    """For each ray: which of its pulled points (K, pulls, d) are feasible, and its cut."""

    def feasible(theta: Array, w: Array) -> Array:
        inputs, free = inputs_of(p, rows, theta, w)
        return proofs.prove_feasible(p, theta, free, inputs)[0]

    return jax.vmap(jax.vmap(feasible))(theta, w), *half_spaces(p, rows, y)


def half_spaces(p: Problem, rows: Rows, y: Any) -> tuple[Array, Array]:
    """Those valid on the whole feasible set, normals (K, d) and offsets (K,), from multipliers."""
    return jax.vmap(lambda y: proofs.everywhere(p, *cut_of(p, rows, y)))(y)


def leaving(
    center: np.ndarray, directions: np.ndarray, normals: np.ndarray, offsets: np.ndarray
) -> np.ndarray:
    """Where each ray leaves the intersection of the half-spaces (inf: never)."""
    slope = directions @ normals.T
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (offsets - normals @ center) / slope
    return np.where(slope > 0, t, np.inf).min(axis=1, initial=np.inf)
