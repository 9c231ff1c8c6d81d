"""Input checks of public functions, made before anything compiles.

Inside `jit`, `vmap` or `grad` an array has a shape but no value: shapes are checked there, values
are not (a solver reports bad values of a batch by its status).
"""

from typing import Any, NoReturn

import jax
import jax.numpy as jnp
import numpy as np


def fail(argument: str, problem: str, cure: str) -> NoReturn:
    """Raise a ValueError that names the argument, what is wrong, and what to do."""
    raise ValueError(f"{argument}: {problem}. {cure}")


def concrete(*values: Any) -> bool:
    """Return True when no value is being traced, so that all can be read."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def whole(argument: str, value: Any, least: int) -> int:
    """Return the value as an int; raise unless it is a whole number of at least `least`."""
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least:
        fail(argument, f"{value!r}", f"Give a whole number of at least {least}")
    return int(value)


def require_shape(argument: str, value: Any, shape: tuple[int, ...], cure: str) -> None:
    """Raise unless `value` has exactly this shape."""
    given = np.shape(value if concrete(value) else jnp.asarray(value))  # lists of traced numbers
    if given != shape:
        fail(argument, f"shape {given} where {shape} is needed", cure)


def require_finite(argument: str, value: Any) -> None:
    """Raise if a readable `value` holds NaN or infinity."""
    if concrete(value) and not np.all(np.isfinite(value)):
        fail(argument, "holds NaN or infinity", "Give finite numbers")


def require_symmetric_psd(argument: str, value: Any, *, definite: bool = False) -> None:
    """Raise unless a readable square `value` is symmetric and positive (semi)definite."""
    require_finite(argument, value)
    if not concrete(value):
        return
    matrix = np.asarray(value, dtype=np.float64)
    scale = max(np.abs(matrix).max(initial=0.0), np.finfo(np.float64).tiny)
    if np.abs(matrix - matrix.T).max(initial=0.0) > 1e-6 * scale:
        fail(argument, "is not symmetric", f"Use ({argument} + {argument}.T) / 2")
    least = np.linalg.eigvalsh((matrix + matrix.T) / 2)[0]
    if definite and least <= 0:
        fail(
            argument,
            f"is not positive definite (least eigenvalue {least:.3g})",
            "Put a positive weight on every direction",
        )
    if least < -1e-7 * scale:
        fail(
            argument,
            f"is not positive semidefinite (least eigenvalue {least:.3g})",
            "A negative weight makes the problem non-convex: check signs",
        )
