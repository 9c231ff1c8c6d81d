"""Bounds of each coordinate over a set, in NumPy in float64."""

import numpy as np

from jaxmpc.sets.convex import Box, Ellipsoid, Polytope, unit_rows
from jaxmpc.sets.lp import Program


def set_bounds(set_: Box | Polytope | Ellipsoid | None, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper bounds (n,) of each coordinate on a set; ±inf for None.

    The bounds of a Box are exact; those of a Polytope, found by linear programs, and of an
    Ellipsoid are moved outwards by a part in 10⁶.
    """
    if set_ is None:
        return np.full(n, -np.inf), np.full(n, np.inf)
    if isinstance(set_, Box):
        return np.asarray(set_.lower, np.float64), np.asarray(set_.upper, np.float64)
    if isinstance(set_, Ellipsoid):
        least = np.zeros(n)
        inverse = np.linalg.inv(np.asarray(set_.P, np.float64))
        upper = np.sqrt(np.asarray(set_.level, np.float64) * np.diag(inverse))
        lower = -upper
    else:
        program = Program(*unit_rows(set_.H, set_.h))
        lower, upper = program.bounds()
        least = 1e-6 * program.column
    size = [np.where(np.isfinite(v), np.abs(v), 0.0) for v in (lower, upper)]
    # Where the bounds are about 0, of the size that the rows' data are for.
    margin = 1e-6 * (least + np.maximum(*size))
    return lower - margin, upper + margin
