"""Where plans and closed loops begin and what they track: the arguments, checked in one place."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import Reals, as_array, host_array
from jaxmpc.checks import fail
from jaxmpc.mpc.problem import MPC


class Aim(NamedTuple):
    """Where one plan begins and what it tracks.

    x0 (n,). states and inputs: references (n,) or (N+1, n), and (m,) or (N, m); None for zero.
    previous_input u_{−1} (m,), None for zero. Of nonlinear problems and their expansions: targets
    of the tasks, (N+1, p) each, and slopes (N+1, n) and (N, m), the terms Σ slope_k·x_k +
    Σ slope_k·u_k of the cost, None for none.
    """

    x0: Any
    states: Any = None
    inputs: Any = None
    previous_input: Any = None
    targets: tuple[Array, ...] = ()
    slopes: tuple[Array, Array] | None = None


def checked_aim(
    mpc: MPC,
    x0: Reals,
    reference: Reals | None = None,
    input_reference: Reals | None = None,
    previous_input: Reals | None = None,
    *,
    steps: int = 1,
    state_size: int | None = None,
    widths: Sequence[int] | None = None,
) -> Aim:
    """Return the arguments of a plan, or of a closed loop of `steps` plans, as arrays.

    A number will do for one state or input. state_size: length of x0, and widths: numbers of
    columns that a reference may have, where these are not n. Raises ValueError that names argument,
    shape and cure.
    """
    shapes = reference_shapes(mpc, steps, widths)
    size = mpc.system.n if state_size is None else state_size

    def checked(name: str, value: Reals | None, shapes: Sequence[tuple[int, ...]]) -> Any:
        return None if value is None else checked_array(name, value, shapes)

    return Aim(
        checked_array("x0", x0, [(size,)]),
        checked("reference", reference, shapes["reference"]),
        checked("input_reference", input_reference, shapes["input_reference"]),
        checked("previous_input", previous_input, [(mpc.system.m,)]),
    )


def reference_shapes(
    mpc: MPC, steps: int = 1, widths: Sequence[int] | None = None
) -> dict[str, list[tuple[int, ...]]]:
    """Return the shapes that references of `steps` plans in a row may have; see `checked_aim`."""
    N, m = mpc.horizon, mpc.system.m
    states: list[tuple[int, ...]] = []
    for k in widths or (mpc.system.n,):
        states += [(k,), (N + steps, k)]
    return {"reference": states, "input_reference": [(m,), (N + steps - 1, m)]}


def checked_array(name: str, value: Any, shapes: Sequence[tuple[int, ...]]) -> Any:
    """Return a value as an array of real numbers; ValueError unless it has one of the shapes. A
    number will do for (1,)."""
    value = _real_array(name, value)
    if np.shape(value) == () and (1,) in shapes:
        value = value.reshape(1)
    if np.shape(value) not in shapes:
        cure = f"Give {' or '.join(map(str, shapes))}; use jax.vmap for many"
        fail(name, f"shape {np.shape(value)}", cure)
    return value


def _real_array(name: str, value: Any) -> Any:
    if isinstance(value, np.ndarray) and value.dtype.kind in "iuf":  # the usual case, and fast
        return value
    value = as_array(value)
    if not isinstance(value, jax.Array):
        return host_array(name, value)
    if jnp.issubdtype(value.dtype, jnp.complexfloating):
        fail(name, f"entries of type {value.dtype} where real numbers are needed", "Use .real")
    return value
