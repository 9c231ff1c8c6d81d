"""Convex sets in R^n, and functions of any of them or of None, which stands for all of R^n.

Boxes, polytopes and zonotopes are in `linear_sets`, since each turns into the others; ellipsoids in
`ellipsoid`; what they have in common, and their operators, in `operations`.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from jaxmpc.checks import fail
from jaxmpc.sets.ellipsoid import Ellipsoid
from jaxmpc.sets.fields import AnyArray, AnyNumber, AnyTruth, numbers, product
from jaxmpc.sets.linear_sets import Box, FullPart, LinearSet, Polytope, Zonotope, as_polytope
from jaxmpc.sets.lp import Program
from jaxmpc.sets.operations import BasicSet, ConvexSet

__all__ = [
    "AnyArray",
    "AnyNumber",
    "AnyTruth",
    "BasicSet",
    "Box",
    "ConvexSet",
    "Ellipsoid",
    "FullPart",
    "LinearSet",
    "Polytope",
    "Zonotope",
    "as_polytope",
    "numbers",
    "product",
    "set_bounds",
    "translated",
    "unit_half_spaces",
]


def translated(set_: Any, by: np.ndarray) -> Any:
    """Return the set {x + by : x in set_}; None for None. NumPy; not traceable.

    Raises ValueError for an Ellipsoid, whose center is the origin, unless by = 0.
    """
    if isinstance(set_, Box):
        return Box(np.asarray(set_.lower) + by, np.asarray(set_.upper) + by)
    if isinstance(set_, Polytope):
        return replace(set_, h=np.asarray(set_.h) + np.asarray(set_.H) @ by)
    if isinstance(set_, Ellipsoid) and by.any():
        fail("terminal_set", "is an Ellipsoid about the origin", "Use a Polytope")
    return set_


def unit_half_spaces(argument: str, set_: Any, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows (H, h) of a Box or Polytope in R^n, scaled to norm 1; no rows for None."""
    if set_ is None:
        return np.zeros((0, n)), np.zeros(0)
    if not isinstance(set_, LinearSet):
        fail(argument, f"{type(set_).__name__} is no convex set", "Give a Box or Polytope")
    return as_polytope(argument, set_, n).unit_rows(argument)


def set_bounds(set_: BasicSet | None, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper bounds (n,) of each coordinate on a set; ±inf for None.

    The bounds of a Box are exact; those of a Polytope, found by linear programs, and of others
    are moved outwards by a part in 10⁶.
    """
    if set_ is None:
        return np.full(n, -np.inf), np.full(n, np.inf)
    if isinstance(set_, Box):
        return np.asarray(set_.lower, np.float64), np.asarray(set_.upper, np.float64)
    if not isinstance(set_, Polytope):
        least = np.zeros(n)
        lower, upper = set_.bounding_box().bounds()
    else:
        program = Program(*set_.unit_rows())
        lower, upper = program.bounds()
        least = 1e-6 * program.column
    size = [np.where(np.isfinite(v), np.abs(v), 0.0) for v in (lower, upper)]
    # Where the bounds are about 0, of the size that the rows' data are for.
    margin = 1e-6 * (least + np.maximum(*size))
    return lower - margin, upper + margin
