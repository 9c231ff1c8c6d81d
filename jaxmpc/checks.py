"""Input checks, made where users call and before anything compiles.

Inside `jit`, `vmap` or `grad` an array has a shape but no value: there shapes are
checked and values are not (a batch answers bad values with a status instead).
"""

from typing import Any, NoReturn

import jax
import jax.numpy as jnp
import numpy as np


def fail(argument: str, problem: str, cure: str) -> NoReturn:
    """Raise the one kind of error users see: which argument, what is wrong, what to do."""
    raise ValueError(f"{argument}: {problem}. {cure}")


def concrete(*values: Any) -> bool:
    """True when every value can be read, i.e. none is being traced."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def whole(argument: str, value: Any, least: int) -> int:
    """The value as an int; raise unless it is a whole number of at least `least`."""
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
