"""solve: one plan from one state; solve_many: from many, in chunks that fit into memory."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jax import Array

from jaxmpc.arrays import Reals, host_array
from jaxmpc.batches import chosen_devices, first_rows
from jaxmpc.checks import fail, require_kind, require_memory, require_step_type, whole
from jaxmpc.mpc.condense import in_float64
from jaxmpc.mpc.controller import Controller, plan_arguments
from jaxmpc.mpc.many import Batch
from jaxmpc.mpc.plan import Plan, WarmStart
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.admm import ADMM, DEFAULT
from jaxmpc.systems.system import LinearSystem


def solve(
    mpc: MPC, x0: Reals, reference: Reals | None = None, solver: ADMM = DEFAULT,
    warm_start: Any = None, *, input_reference: Reals | None = None,
    previous_input: Reals | None = None,
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
    mpc: MPC | Controller, x0s: Reals, solver: ADMM = DEFAULT, *, dtype: Any = "float32",
    chunk: int | None = None, transfer: bool = True, to_host: bool = True,
    devices: Any = None,
) -> Plan:  # fmt: skip
    """Solve the MPC problem from each state x0s (B, n); the Plan holds host arrays, B in front.

    Where input rates are limited or weighted x0s may be (B, n + m), with the previous inputs in the
    last columns; (B, n) takes them as zero. The plans track the origin.

    mpc: the problem, or a Controller of it in float64, already condensed and factored, whose own
    solver counts. dtype: type of the ADMM iterates; Newton steps, residuals, status and the answer
    are float64 whatever it is, and whether or not 64-bit mode is on. chunk: states that a compiled
    program takes at once; None: by device. transfer: on a CPU, of very many states with few
    coordinates solve some, and let the others follow these (`transfer.py`). Each plan is judged by
    its own residuals all the same: this changes the time, and which of several plans within the
    tolerances is found.
    to_host: False leaves the plans on the device. devices: a number of them, or a sequence of JAX
    devices, which share the states of a chunk; None: the default device. A state with NaN gets
    status NON_FINITE. Raises ValueError for wrong shapes and ill-posed problems.
    """
    if isinstance(mpc, Controller):
        controller, problem = mpc, mpc.mpc
        if controller.dtype != np.float64:
            fail("mpc", f"a controller in {controller.dtype}", "Make it with jax.enable_x64(True)")
    else:
        require_kind("mpc", mpc, MPC)
        mpc.validate()
        controller, problem = None, mpc
    require_kind("solver", solver, ADMM)
    require_step_type(dtype)
    chosen = chosen_devices(devices)
    if chunk is not None:
        whole("chunk", chunk, 1)
    n, p = problem.system.n, problem.dimension
    if not (isinstance(x0s, Array) and x0s.dtype == np.float64):
        x0s = host_array("x0s", x0s)
    if x0s.ndim != 2 or x0s.shape[1] not in (n, p):
        fail("x0s", f"shape {x0s.shape}", f"Give states (B, {n})")
    each = 8 * (problem.horizon + 1) * (n + problem.system.m)
    require_memory("x0s", len(x0s) * each, "Solve some of them at a time")
    with jax.enable_x64(True):
        if controller is None:
            controller = Controller(
                in_float64(problem), replace(solver, dtype=np.dtype(dtype).name)
            )
        if x0s.shape[1] < p:
            x0s = np.pad(np.asarray(x0s), ((0, 0), (0, p - n)))
        some = x0s if len(x0s) else np.zeros((1, p))  # and none of the plans from these
        plans = Batch(controller, some, chunk, to_host, chosen).solve(transfer)
    return plans if len(x0s) else first_rows(plans, 0)
