"""By how much limits are violated, and how much of that counts as rounding.

The functions work on NumPy arrays, and on JAX arrays, traced or not.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.sets.box import Box
from jaxmpc.sets.polytope import Polytope

# A limit counts as kept where it is exceeded by at most this, in its unit; relative to the bound
# where that is above 1, since float32 holds 150 N m only to 1e-5.
TOLERANCE = {"float64": 1e-6, "float32": 1e-4}

Limits = Box | Polytope | tuple[Any, Any, Any] | None


def row_violations(limits: Limits, x: Any) -> Any:
    """Return by how much points violate each row of some limits, in the unit of the row.

    limits: a Box or Polytope, rows (H, lower, upper) of lower ≤ H x ≤ upper, or None for none.
    x: points (..., n). Returns (..., rows): 0 where a row is kept, NaN where x is not finite. A Box
    has one row a coordinate.
    """
    value, lower, upper = _row_values(limits, x)
    xp = _namespace(value)
    return xp.maximum(xp.maximum(value - upper, lower - value), 0.0)


def worst_violation(limits: Limits, x: Any) -> Any:
    """Return the largest violation of each point, (...,): 0 where all rows are kept, NaN where x is
    not finite."""
    found = row_violations(limits, x)
    xp = _namespace(found)
    # A maximum need not propagate NaN (XLA on CPUs).
    return xp.where(
        xp.any(xp.isnan(found), axis=-1), xp.nan, xp.max(found, axis=-1, initial=0.0)
    )  # fmt: skip


def kept(limits: Limits, x: Any, dtype: Any = None) -> Any:
    """Return whether each point keeps each row to within `TOLERANCE`, (..., rows); False where x is
    not finite.

    dtype: the precision in which x was computed, if other than that of x.
    """
    value, lower, upper = _row_values(limits, x)
    xp = _namespace(value)
    relative = TOLERANCE[str(np.dtype(value.dtype if dtype is None else dtype))]
    room = lambda end: relative * xp.maximum(1.0, xp.where(xp.isfinite(end), xp.abs(end), 0.0))
    return (value - upper <= room(upper)) & (lower - value <= room(lower))


def _row_values(limits: Limits, x: Any) -> tuple[Any, Any, Any]:
    """Return H x (..., rows) and its bounds; NaN where x is not finite."""
    xp = _namespace(x, limits)
    x = xp.asarray(x)
    x = xp.where(xp.isfinite(x), x, xp.nan)
    if limits is None:
        return x[..., :0], xp.zeros(0, x.dtype), xp.zeros(0, x.dtype)
    if isinstance(limits, Box):
        return x, xp.asarray(limits.lower), xp.asarray(limits.upper)
    H, lower, upper = limits.rows() if isinstance(limits, Polytope) else limits
    H = xp.asarray(H).T
    value = x @ H if xp is np else jnp.matmul(x, H, precision="highest")
    return value, xp.asarray(lower), xp.asarray(upper)


def _namespace(*values: Any) -> Any:
    """Return jax.numpy where one of the arrays is JAX's, else numpy."""
    return jnp if any(isinstance(v, jax.Array) for v in jax.tree.leaves(values)) else np
