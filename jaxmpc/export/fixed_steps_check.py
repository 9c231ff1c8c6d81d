"""Closed loops under the law that is written as C code, beside plans that are solved to the end."""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.arrays import Reals, host_array
from jaxmpc.checks import number, require_finite, require_kind, require_shape, whole
from jaxmpc.mpc.controller import Controller
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.linalg import matmul
from jaxmpc.qp.status import Status

LOOPS = 20


@dataclass(frozen=True)
class ClosedLoopCheck:
    """What `check_fixed_steps` found along closed loops.

    plans: how many. solvable: how many of them are solved by ADMM and Newton steps. reached:
    how many of these the fixed number of steps solves to the tolerance. input_error: the largest
    difference between the inputs of the two where both are solved; input_error_any: where the
    precise plan is. Both are 0 where there is no such plan.
    """

    plans: int
    solvable: int
    reached: int
    input_error: float
    input_error_any: float


def check_fixed_steps(
    mpc: MPC,
    solver: ADMM,
    lower: Reals,
    upper: Reals,
    plans: int = 1000,
    tolerance: float = 1e-6,
    seed: int = 0,
) -> ClosedLoopCheck:
    """Run `Controller(mpc, solver)` with newton_steps=0 from random states of the box [lower,
    upper] (n,), and at each state solve the plan precisely too.

    20 closed loops begin at states that have a plan; `plans` is rounded up to a multiple of 20.

    Raises ValueError for an invalid problem, bounds of another shape than (n,) and bad counts.
    """
    require_kind("mpc", mpc, MPC)
    require_kind("solver", solver, ADMM)
    whole("plans", plans, 1)
    number("tolerance", tolerance, 0, "Give a positive number")
    for argument, bound in (("lower", lower), ("upper", upper)):
        require_shape(argument, bound, (mpc.system.n,), "Give a number for each state")
        require_finite(argument, bound)
    with jax.enable_x64(True):
        lower, upper = host_array("lower", lower), host_array("upper", upper)
        fixed = Controller(mpc, replace(solver, newton_steps=0, eps=tolerance))
        precise = Controller(mpc, ADMM())
        starts = np.random.default_rng(seed).uniform(lower, upper, (50 * LOOPS, len(lower)))
        status = jax.jit(jax.vmap(lambda x: precise(x).plan.status))(starts)
        starts = starts[np.argsort(np.asarray(status) != Status.SOLVED, kind="stable")[:LOOPS]]
        A, B = (jnp.asarray(host_array("system", v)) for v in (mpc.system.A, mpc.system.B))
        drift = 0.0 if mpc.system.c is None else jnp.asarray(host_array("system.c", mpc.system.c))

        def step(state: Any, _: Any) -> Any:
            x, before, best_before = state
            control, best = fixed(x, before), precise(x, best_before)
            after = matmul(A, x) + matmul(B, control.u) + drift
            error = jnp.max(jnp.abs(control.u - best.u))
            # The previous input of the next time step is what was applied.
            carried = after, control, best._replace(u=control.u)
            return carried, (control.plan.status, best.plan.status, error)

        def loop(x: Any) -> Any:
            start = x, fixed.start(x), precise.start(x)
            return jax.lax.scan(step, start, length=-(-plans // LOOPS))[1]

        status, best, error = (np.asarray(v) for v in jax.jit(jax.vmap(loop))(starts))
    solvable = best == Status.SOLVED
    both = solvable & (status == Status.SOLVED)
    return ClosedLoopCheck(
        plans=best.size,
        solvable=int(solvable.sum()),
        reached=int(both.sum()),
        input_error=float(error[both].max(initial=0.0)),
        input_error_any=float(error[solvable].max(initial=0.0)),
    )
