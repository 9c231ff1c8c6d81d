"""By how much limits are violated, and how much of that counts as rounding.

The functions work on NumPy arrays, and on JAX arrays, traced or not.
"""

from types import ModuleType
from typing import Any, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from jaxmpc.arrays import Reals
from jaxmpc.sets.box import Box
from jaxmpc.sets.convex_set import product
from jaxmpc.sets.polytope import Polytope

# A limit counts as kept where it is exceeded by at most this, in its unit; relative to the bound
# where that is above 1, since float32 holds 150 N m only to 1e-5.
TOLERANCE = {"float64": 1e-6, "float32": 1e-4}

# A set, rows (H, lower, upper) of lower ≤ H x ≤ upper, or None for none.
Limits: TypeAlias = Box | Polytope | tuple[Reals, Reals, Reals] | None
Values = TypeVar("Values", jax.Array, np.ndarray)


def row_violations(limits: Limits, x: Values) -> Values:
    """Return by how much points x (..., n) violate each row of some limits, in the unit of the
    row: (..., rows), 0 where a row is kept, NaN where x is not finite. A Box has one row a
    coordinate."""
    xp, value, lower, upper = _row_values(limits, x)
    return xp.maximum(xp.maximum(value - upper, lower - value), 0.0)


def worst_violation(limits: Limits, x: Values) -> Values:
    """Return the largest violation of each point, (...,): 0 where all rows are kept, NaN where x is
    not finite."""
    found = row_violations(limits, x)
    xp = _namespace(found)
    worst = xp.max(found, axis=-1, initial=0.0)
    # A maximum need not propagate NaN (XLA on CPUs).
    return xp.where(xp.any(xp.isnan(found), axis=-1), xp.nan, worst)


def kept(limits: Limits, x: Values, dtype: DTypeLike | None = None) -> Values:
    """Return whether each point keeps each row to within `TOLERANCE`, (..., rows); False where x is
    not finite.

    dtype: the precision in which x was computed, if other than that of x.
    """
    xp, value, lower, upper = _row_values(limits, x)
    relative = TOLERANCE[str(np.dtype(value.dtype if dtype is None else dtype))]

    def room(end: Values) -> Values:
        return relative * xp.maximum(1.0, xp.where(xp.isfinite(end), xp.abs(end), 0.0))

    return (value - upper <= room(upper)) & (lower - value <= room(lower))


def _row_values(limits: Limits, x: Values) -> tuple[ModuleType, Values, Values, Values]:
    """Return NumPy or jax.numpy, H x (..., rows), NaN where x is not finite, and its bounds."""
    xp = _namespace(x, limits)
    x = xp.asarray(x)
    x = xp.where(xp.isfinite(x), x, xp.nan)
    if limits is None:
        return xp, x[..., :0], xp.zeros(0, x.dtype), xp.zeros(0, x.dtype)
    if isinstance(limits, Box):
        return xp, x, xp.asarray(limits.lower), xp.asarray(limits.upper)
    H, lower, upper = limits.rows() if isinstance(limits, Polytope) else limits
    H = xp.asarray(H).T
    return xp, product(xp, x, H), xp.asarray(lower), xp.asarray(upper)


def _namespace(*values: Any) -> ModuleType:
    """Return jax.numpy where one of the arrays is JAX's, else numpy."""
    return jnp if any(isinstance(v, jax.Array) for v in jax.tree.leaves(values)) else np
