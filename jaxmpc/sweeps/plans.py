"""Optimal plans from many states: the adaptive driver round the fixed-count solver.

`jax.vmap(solve)` gives every state the same number of steps. Here a short ADMM run, in float32
if wished, and one Newton step serve all; the states whose residuals are not small enough are
gathered, and Newton goes on with these until they are solved or proved infeasible.
"""

import functools
import time
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.checks import fail
from jaxmpc.compiled import Compiled, default_chunk, gather_size, padded, require_step_type
from jaxmpc.mpc.condense import in_float64
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.solve import Controller
from jaxmpc.qp.admm import ADMM, Factor, iterate, read, scaled
from jaxmpc.qp.problem import QP, QPSolution
from jaxmpc.qp.refine import polish
from jaxmpc.qp.solve import assess, cleaned, marked, prove, solve_factored, unscaled
from jaxmpc.qp.status import Status

NEWTON_STEPS = 4
NEWTON_ROUNDS = 8
LAST_STEPS, FEW = 60, 32


@dataclass(frozen=True)
class Plans:
    """Plans from B states as host arrays: inputs (B, N, m), cost (B,) without ½, status (B,),
    residuals (B,) of each condensed QP, and the seconds spent compiling and running.
    """

    inputs: np.ndarray
    cost: np.ndarray
    status: np.ndarray
    primal_residual: np.ndarray
    dual_residual: np.ndarray
    gap: np.ndarray
    compile_seconds: float
    run_seconds: float


def solve_many(
    mpc: MPC, x0s: Any, solver: ADMM = ADMM(), *, dtype: Any = "float32", chunk: int | None = None  # noqa: B008
) -> Plans:  # fmt: skip
    """Solve the MPC problem from each state x0s (B, n) to residuals of solver.eps in float64.

    Where input rates are limited or weighted x0s may be (B, n + m), with the previous inputs in the
    last columns; (B, n) takes them as zero. The plans track the origin.

    dtype: type of the ADMM iterates; polish, residuals and status are float64 whatever it is.
    `solver.refine` is not used: Newton steps go where they are needed. A state with NaN gets
    status NON_FINITE. Raises ValueError for wrong shapes and ill-posed problems.
    """
    mpc.validate()
    x0s = np.asarray(x0s, np.float64)
    if x0s.ndim != 2 or x0s.shape[1] not in (mpc.system.n, mpc.dimension):
        fail("x0s", f"shape {x0s.shape}", f"Give states (B, {mpc.system.n})")
    x0s = np.pad(x0s, ((0, 0), (0, mpc.dimension - x0s.shape[1])))
    require_step_type(dtype)
    chunk = default_chunk() if chunk is None else chunk
    if chunk < 1:
        fail("chunk", f"{chunk}", "Give a count of at least 1")
    with jax.enable_x64(True):
        begun = time.perf_counter()
        controller = Controller(in_float64(mpc), solver)
        before = Compiled.seconds
        size = min(chunk, max(len(x0s), 1))
        parts = [
            one_chunk(controller, first_rung(np.dtype(dtype)), x0s[i : i + size], size)
            for i in range(0, len(x0s), size)
        ]
        compiled = Compiled.seconds - before
        spent = time.perf_counter() - begun - compiled
    if not parts:
        parts = [(np.zeros((0, mpc.horizon, mpc.system.m)), *(np.zeros(0),) * 5)]
    inputs, cost, status, primal, dual, gap = map(np.concatenate, zip(*parts, strict=True))
    return Plans(inputs, cost, status, primal, dual, gap, compiled, spent)


def one_chunk(
    controller: Controller, first: Compiled, x: np.ndarray, size: int
) -> tuple[np.ndarray, ...]:
    """All rungs on one chunk of states."""
    keep, gathered = len(x), gather_size(size)
    answer = [np.array(v[:keep]) for v in first(controller, padded(x, size))]
    for _ in range(NEWTON_ROUNDS):
        left = np.flatnonzero(answer[2] == Status.ITERATION_LIMIT)
        for i in range(0, len(left), gathered):
            batch = left[i : i + gathered]
            w, y = answer[-2][batch], answer[-1][batch]
            better = newton_rung(controller, *(padded(v, gathered) for v in (x[batch], w, y)))
            for old, new in zip(answer, better, strict=True):
                old[batch] = new[: len(batch)]
    left = np.flatnonzero(answer[2] == Status.ITERATION_LIMIT)
    few = min(gathered, FEW)
    for i in range(0, len(left), few):
        batch = left[i : i + few]
        better = last_rung(controller, padded(x[batch], few))
        for old, new in zip(answer, better, strict=False):
            old[batch] = new[: len(batch)]
    return tuple(answer[:-2])


@functools.cache
def first_rung(dtype: Any) -> Compiled:
    """Compiled: ADMM in `dtype` and one Newton step in float64, for all states."""

    @jax.jit
    def rung(controller: Controller, x: Array) -> tuple[Array, ...]:
        solver, f = controller.solver, controller.factor
        assert f is not None
        cast = lambda tree: jax.tree.map(lambda v: v.astype(dtype), tree)
        short = cast(f)

        def one(x0: Array) -> tuple[Array, ...]:
            qp, finite = program(controller, x0)
            q, bounds = cast(scaled(f, qp))
            t = jnp.zeros_like(bounds.l)
            t, before = iterate(short, q, bounds, t, solver.iterations, solver.alpha)
            (w, y), (_, y_old) = read(short, t, q, bounds), read(short, before, q, bounds)
            w, y, change = (v.astype(x0.dtype) for v in (w, y, y - y_old))
            return finish(controller, f, x0, qp, finite, w, y, [change], 1)

        return jax.vmap(one)(x)

    return Compiled(rung)


@Compiled
@jax.jit
def newton_rung(controller: Controller, x: Array, w: Array, y: Array) -> tuple[Array, ...]:
    """Compiled: more Newton steps in float64 from (w, y), for gathered states."""
    f = controller.factor
    assert f is not None

    def one(x0: Array, w: Array, y: Array) -> tuple[Array, ...]:
        qp, finite = program(controller, x0)
        return finish(controller, f, x0, qp, finite, w, y, [], NEWTON_STEPS)

    return jax.vmap(one)(x, w, y)


@Compiled
@jax.jit
def last_rung(controller: Controller, x: Array) -> tuple[Array, ...]:
    """Compiled: the whole solver with many refinement steps, for the few states still open."""
    f = controller.factor
    assert f is not None
    solver = replace(controller.solver, refine=LAST_STEPS)

    def one(x0: Array) -> tuple[Array, ...]:
        qp, _ = program(controller, x0)
        return results(controller, x0, marked(*solve_factored(qp, f, solver)))

    return jax.vmap(one)(x)


def program(controller: Controller, x0: Array) -> tuple[QP, Array]:
    """The QP at x0, made harmless where x0 is not finite, and the fault in it."""
    assert controller.condensed is not None and controller.factor is not None
    return cleaned(controller.condensed.qp(x0), controller.factor.fault)


def finish(
    controller: Controller, f: Factor, x0: Array, qp: QP, fault: Array, w: Array, y: Array,
    proofs: list[Array], steps: int,
) -> tuple[Array, ...]:  # fmt: skip
    """Polish, judge, and lay out: inputs, cost, status, three residuals, and (w, y) to go on."""
    q, bounds = scaled(f, qp)
    end = polish(f.H, q, f.A, bounds, w, y, steps)
    proof = prove(qp, f, [*proofs, end.change], [end.move])
    pair = unscaled(qp, f, end.w, end.y)
    s: QPSolution = marked(assess(qp, pair, proof, controller.solver), fault)
    return *results(controller, x0, s), end.w, end.y


def results(controller: Controller, x0: Array, s: QPSolution) -> tuple[Array, ...]:
    """What `Plans` holds of a solution."""
    c = controller.condensed
    assert c is not None
    states, inputs = c.trajectory(x0, s.z)
    previous = x0[c.Q.shape[0] :] if controller.mpc.remembers else None
    cost = controller.cost(states, inputs, previous_input=previous)
    return inputs, cost, s.status, s.primal_residual, s.dual_residual, s.gap
