"""Bounded sets of disturbances: how far they push a row, and their largest norm."""

import numpy as np

from jaxmpc.arrays import host_array
from jaxmpc.checks import fail
from jaxmpc.sets.box import Box
from jaxmpc.sets.lp import extent
from jaxmpc.sets.polytope import Polytope, as_polytope


def disturbance_set(disturbance: Box | Polytope | None, n: int) -> Box | Polytope | None:
    """Return the disturbance; raise ValueError unless it is None or a bounded set that holds 0."""
    if disturbance is None:
        return None
    G, g = as_polytope("disturbance", disturbance, n).unit_rows("disturbance")
    if not np.isfinite(extent(G, g)).all():
        fail("disturbance", "is unbounded", "Bound every coordinate")
    if g.min() < 0:
        fail("disturbance", "does not hold the origin", "Add its center to the system's c")
    return disturbance


def supports(W: Box | Polytope | None, rows: np.ndarray) -> np.ndarray:
    """Return max {row w : w in W} for each row; 0 if W is None."""
    if W is None or not len(rows):
        return np.zeros(len(rows))
    limits = Polytope(rows, np.zeros(len(rows))).pontryagin_difference(W).h
    return -host_array("disturbance", limits)


def largest_norm(W: Box | Polytope, P: np.ndarray) -> float:
    """Return max sqrt(w'P w) over W: a convex function is largest at a vertex."""
    vertices = W.vertices()
    return float(np.sqrt(np.einsum("ij,jk,ik->i", vertices, P, vertices).max()))
