"""solve: one plan from one state; solve_many: from many, in chunks that fit into memory."""

import functools
import threading
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jax import Array

from jaxmpc.checks import fail, require_kind, require_memory, whole
from jaxmpc.compiled import (
    Compiled,
    default_chunk,
    first_rows,
    joined,
    padded,
    require_step_type,
    side_by_side,
    workers,
)
from jaxmpc.control.system import LinearSystem, host_array
from jaxmpc.devices import Devices, chosen_devices, count, divisible, over_devices, placement
from jaxmpc.mpc.condense import in_float64
from jaxmpc.mpc.controller import Controller, plan_arguments
from jaxmpc.mpc.plan import Plan, WarmStart
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.admm import ADMM, DEFAULT


def solve(
    mpc: MPC, x0: Any, reference: Any = None, solver: ADMM = DEFAULT, warm_start: Any = None, *,
    input_reference: Any = None, previous_input: Any = None,
) -> Plan:  # fmt: skip
    """Solve one MPC problem from the state x0 (n,).

    reference: state to track, (n,) or (N+1, n), in place of the origin: the cost becomes
    Σ (x_k − r_k)'Q(x_k − r_k) + …; constraints, the terminal set too, stay where they are.
    input_reference: input to track, (m,) or (N, m), such as that of `equilibrium`; None for zero.
    previous_input: u_{−1} (m,) where the problem limits or weighs input rates; None for zero.
    warm_start: an earlier Plan or a WarmStart.

    `jax.vmap(solve, in_axes=(None, 0))(mpc, x0s)` solves for many states and factors
    once. Raises ValueError for an ill-posed problem or wrong shapes, before any compile; what
    depends on values inside a batch is answered by `plan.status`.
    """
    require_kind("mpc", mpc, MPC)
    require_kind("system", mpc.system, LinearSystem)
    mpc.system.validate()
    whole("horizon", mpc.horizon, 1)
    plan_arguments(mpc, x0, reference, input_reference, previous_input)
    if warm_start is not None and not isinstance(warm_start, Plan | WarmStart):
        what = f"is a {type(warm_start).__name__}"
        fail("warm_start", what, "Give a Plan or a jm.mpc.WarmStart")
    return Controller(mpc, solver).plan(x0, reference, warm_start, input_reference, previous_input)


def solve_many(
    mpc: MPC, x0s: Any, solver: ADMM = DEFAULT, *, dtype: Any = "float32",
    chunk: int | None = None, devices: Any = None,
) -> Plan:  # fmt: skip
    """Solve the MPC problem from each state x0s (B, n); the Plan holds host arrays, B in front.

    Where input rates are limited or weighted x0s may be (B, n + m), with the previous inputs in the
    last columns; (B, n) takes them as zero. The plans track the origin.

    dtype: type of the ADMM iterates; Newton steps, residuals, status and the answer are float64
    whatever it is, and whether or not 64-bit mode is on. chunk: states that a compiled program
    takes at once; None: by device. devices: a number of them, or a sequence of JAX devices, which
    share the states of a chunk; None: the default device. A state with NaN gets status NON_FINITE.
    Raises ValueError for wrong shapes and ill-posed problems.
    """
    require_kind("mpc", mpc, MPC)
    require_kind("solver", solver, ADMM)
    mpc.validate()
    x0s = host_array("x0s", x0s)
    if x0s.ndim != 2 or x0s.shape[1] not in (mpc.system.n, mpc.dimension):
        fail("x0s", f"shape {x0s.shape}", f"Give states (B, {mpc.system.n})")
    x0s = np.pad(x0s, ((0, 0), (0, mpc.dimension - x0s.shape[1])))
    require_step_type(dtype)
    devices = chosen_devices(devices)
    # Of several devices two chunks at once: one is computed while the other goes to the host.
    together, shares = (workers(), workers()) if devices is None else (2, 1)
    # One begins after the other, in the same order on all of them.
    beginning = nullcontext() if devices is None else threading.Lock()
    if chunk is None:
        chunk = min(count(devices) * default_chunk(), -(-len(x0s) // shares))
    else:
        whole("chunk", chunk, 1)
    each = 8 * (mpc.horizon + 1) * (mpc.system.n + mpc.system.m)
    require_memory("x0s", len(x0s) * each, "Solve some of them at a time")
    size = divisible(max(min(chunk, len(x0s)), 1), devices)
    with jax.enable_x64(True):
        controller = Controller(in_float64(mpc), replace(solver, dtype=np.dtype(dtype).name))
        controller = jax.device_put(controller, placement(devices))
        first = padded(x0s[:size], size) if len(x0s) else x0s
        compiled = _plans(devices)
        program = compiled.program(controller, first)

    def part(start: int) -> Plan:
        here = x0s[start : start + size]
        with jax.enable_x64(True), beginning:
            x = padded(here, size) if len(here) else here
            plans = program(*compiled.placed((controller, x)))
        return first_rows(jax.device_get(plans), len(here))

    return joined(side_by_side(part, range(0, max(len(x0s), 1), size), together))


@functools.cache
def _plans(devices: Devices) -> Compiled:
    return over_devices(_plans_from, devices, (False, True))


def _plans_from(controller: Controller, x0s: Array) -> Plan:
    n = controller.mpc.system.n

    def one(x: Array) -> Plan:
        return controller.plan(
            x[:n], previous_input=x[n:] if controller.mpc.input_in_state else None
        )

    return jax.vmap(one)(x0s)
