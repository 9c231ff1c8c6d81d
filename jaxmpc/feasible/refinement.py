"""Polytopes inside and outside a feasible set that rays bring together, vertex by vertex."""

import time

import numpy as np
from scipy.spatial import KDTree

from jaxmpc.feasible.centered_polytope import power_of_two
from jaxmpc.feasible.rays import Cuts, Rays
from jaxmpc.pytrees import record
from jaxmpc.sets.geometry import hull_volume
from jaxmpc.sets.polytope import Polytope

# The most rays that are sent in one round.
MOST_RAYS = 2000


@record
class Refinement:
    """What rays have proved: points (K, d) feasible, with w (K, k) of the constraint rows, and
    half-spaces normals (F, d) θ ≤ offsets (F,) valid on the whole set, with their cuts. gap: of the
    volumes of hull and intersection, relative to the latter; inf where one of them has none."""

    rays: Rays
    points: np.ndarray
    w: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray
    cuts: Cuts
    gap: float


def refined(
    rays: Rays, tolerance: float, rounds: int, most: int = MOST_RAYS, deadline: float = np.inf
) -> Refinement:
    """Send rays through the vertices of the outer polytope until the volumes differ by no more than
    `tolerance`, `most` of them a round, before `deadline` (of `time.monotonic`)."""
    d = rays.problem.dimension
    box, _ = rays.problem.programs.bounding_box
    unit = power_of_two(np.zeros(d) if box is None else np.ptp(box, axis=0))
    directions = np.concatenate([np.eye(d), -np.eye(d), -np.ones((1, d))])
    points, w = np.zeros((0, d)), np.zeros((0, len(rays.w)))
    normals, offsets, cuts = rays.box()
    sent, gap = of_length_one(directions), np.inf
    for _ in range(rounds):
        if time.monotonic() > deadline:
            break
        found = rays.cast(directions * unit)
        proved = np.isfinite(found.inner)
        points = np.concatenate([points, found.points[proved]])
        w = np.concatenate([w, found.w[proved]])
        valid = np.isfinite(found.offsets)
        normals = np.concatenate([normals, found.normals[valid]])
        offsets = np.concatenate([offsets, found.offsets[valid]])
        more = [
            np.concatenate([old, new[valid]]) for old, new in zip(cuts, found.cuts, strict=True)
        ]
        cuts = more[0], more[1], more[2]
        try:
            outer = Polytope(normals * unit, offsets).reduce()
            low, high = hull_volume(points / unit), outer.volume()
            directions = fresh(outer.vertices() - rays.center / unit, sent)
            sent = np.concatenate([sent, of_length_one(directions)])
        except ValueError:  # unbounded, or too thin for qhull
            break
        gap = (high - low) / high
        # Sets with a curved boundary have no end of vertices.
        if gap <= tolerance or not 0 < len(directions) <= most:
            break
    return Refinement(rays, points, w, normals, offsets, cuts, gap)


def of_length_one(directions: np.ndarray) -> np.ndarray:
    """Return directions (K, d) scaled to length one."""
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def fresh(directions: np.ndarray, sent: np.ndarray) -> np.ndarray:
    """Return the directions, except zeros, along which no ray of `sent` (unit length) has been
    sent."""
    directions = directions[np.any(directions != 0, axis=1)]
    distance = KDTree(sent).query(of_length_one(directions))[0]
    return directions[distance > 1e-9]
