"""solve_many: plans from many states, in chunks of one shape, on all cores, with transfer between
states."""

import functools
import threading
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from jaxmpc.arrays import Reals, host_array
from jaxmpc.batches import (
    Compiled,
    Devices,
    chosen_devices,
    count,
    default_chunk,
    divisible,
    first_rows,
    over_devices,
    padded,
    placement,
    side_by_side,
    workers,
)
from jaxmpc.checks import fail, require_kind, require_memory, require_step_type, whole
from jaxmpc.mpc.active_set_reuse import Cells, Laws, choose, follow, laws_of, transferable
from jaxmpc.mpc.condense import in_float64
from jaxmpc.mpc.controller import Controller
from jaxmpc.mpc.plan import Plan
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.admm import ADMM, DEFAULT
from jaxmpc.qp.dual import MORE_STEPS, MOST_STEPS
from jaxmpc.qp.status import Status

# States from which on transfer is tried: below, compiling its programs costs more than it saves.
MANY = 32_768
# States that a program takes at once where they are few, or follow others.
BLOCK = 2048
# Of chunks so many or more, one is tried before all others; where fewer than this fraction of those
# that can be solved are by following, solving takes less time.
TRIAL, LEAST = 16, 0.3
# Steps on the dual from the law of a neighbour.
FOLLOW_STEPS = MOST_STEPS + MORE_STEPS


class Batch:
    """Plans from the states x (B, p), which lie in NumPy or on the device.

    chunk, block: states that a program takes at once, of many and of few; devices share them.
    answer: the plans so far, B in front, in NumPy (to_host) or on the device.
    """

    def __init__(
        self, controller: Controller, x: Any, chunk: int | None, to_host: bool, devices: Devices
    ) -> None:
        self.x, self.to_host, self.devices = x, to_host, devices
        self.controller = jax.device_put(controller, placement(devices))
        # Of several devices two chunks at once: one is computed while the other goes to the host.
        self.together = workers() if devices is None else 2
        shares = workers() if devices is None else 1
        most = min(count(devices) * default_chunk(), -(-len(x) // shares))
        self.chunk = divisible(max(min(chunk or most, len(x)), 1), devices)
        self.block = divisible(min(self.chunk, count(devices) * BLOCK), devices)
        # On several devices one program begins after the other, in the same order on all of them.
        self._begins: Any = nullcontext() if devices is None else threading.Lock()
        self._stores = threading.Lock()
        self.answer: Plan | None = None

    def solve(self, transfer: bool) -> Plan:
        """Return the plans from all states; transfer: as in `solve_many`."""
        B = len(self.x)
        left = np.arange(B)
        # (On GPUs the solver's kernels take less time than the laws and the host's indices would.)
        on_cpu = jax.default_backend() == "cpu"
        if transfer and on_cpu and B >= MANY and transferable(self.controller):
            self.chunk = self.block  # larger arrays a CPU's allocator would give back each time
            left = self._transfer()
        self._run(_plans(self.devices), (self.controller,), left)
        assert self.answer is not None
        return self.answer

    def _transfer(self) -> np.ndarray:
        """Solve from some states, and from those that follow them; return the indices of those that
        are left."""
        index, cells = choose(self.x)
        self._run(_plans(self.devices), (self.controller,), index)
        solved = jax.tree.map(lambda v: v[padded(index, len(cells.states))], self.answer)
        laws = _laws(self.controller, solved.multipliers, solved.status)
        arguments = (self.controller, laws, cells)
        left = np.delete(np.arange(len(self.x)), index)
        if len(left) >= TRIAL * self.chunk:
            few = np.random.default_rng(0).choice(left, self.chunk, replace=False)
            self._run(_follow(self.devices, 0), arguments, few)
            solvable = 1 - np.mean(self._unsolved(index))
            if 1 - np.mean(self._unsolved(few)) < LEAST * solvable:
                return left
        # The first time all states, for those that are next to each other are copied faster.
        left = np.arange(len(self.x))
        for steps in (0, FOLLOW_STEPS):
            self._run(_follow(self.devices, steps), arguments, left)
            left = left[self._unsolved(left)]
        return left

    def _unsolved(self, index: np.ndarray) -> np.ndarray:
        """Return which of these states (k,) have no plan yet."""
        assert self.answer is not None
        return np.asarray(self.answer.status)[index] != Status.SOLVED

    def _run(self, program: Compiled, arguments: tuple, index: np.ndarray) -> None:
        """Put the plans of program(*arguments, states) from the states at `index` (k,) into
        `answer`."""
        size = self.chunk if len(index) >= self.chunk else self.block

        def part(where: np.ndarray) -> None:
            with jax.enable_x64(True):
                if isinstance(self.x, np.ndarray):
                    x = padded(self.x[places(where)], size)
                else:
                    x = _rows(self.x, padded(where, size))
                with self._begins:
                    plans = program.run(*arguments, x)
                self._put(where, size, plans)

        pieces = [index[i : i + size] for i in range(0, len(index), size)]
        side_by_side(part, pieces, self.together)

    def _put(self, where: np.ndarray, size: int, plans: Plan) -> None:
        B, plans = len(self.x), jax.device_get(plans) if self.to_host else plans
        with self._stores:
            if self.answer is None:
                zeros = np.zeros if self.to_host else jnp.zeros
                self.answer = jax.tree.map(lambda v: zeros((B, *v.shape[1:]), v.dtype), plans)
            if not self.to_host:
                self.answer = _put(self.answer, padded(where, size), plans)
                return
        for all_, rows in zip(*map(jax.tree.leaves, (self.answer, plans)), strict=True):
            all_[places(where)] = rows[: len(where)]


def places(where: np.ndarray) -> np.ndarray | slice:
    """Return ascending indices (k,), as a slice where they are next to each other."""
    first, last = int(where[0]), int(where[-1])
    return slice(first, last + 1) if last - first == len(where) - 1 else where


@jax.jit
def _rows(x: Array, where: Array) -> Array:
    return x[where]


@partial(jax.jit, donate_argnums=0)
def _put(answer: Plan, where: Array, plans: Plan) -> Plan:
    return jax.tree.map(lambda v, rows: v.at[where].set(rows), answer, plans)


@functools.cache
def _plans(devices: Devices) -> Compiled:
    """Return the program (controller, x (B, p)) → plans."""

    def plan(controller: Controller, x: Array) -> Plan:
        n = controller.mpc.system.n
        previous = x[n:] if controller.mpc.input_in_state else None
        return controller.plan(x[:n], previous_input=previous)

    return over_devices(jax.vmap(plan, (None, 0)), devices, (False, True))


@functools.cache
def _follow(devices: Devices, steps: int) -> Compiled:
    """Return the program (controller, laws, cells, x (B, p)) → plans of `follow`."""

    def run(controller: Controller, laws: Laws, cells: Cells, x: Array) -> Plan:
        return jax.vmap(partial(follow, controller, laws, cells, steps))(x)

    return over_devices(run, devices, (False, False, False, True))


_laws = jax.jit(laws_of)


def solve_many(
    mpc: MPC | Controller,
    x0s: Reals,
    solver: ADMM = DEFAULT,
    *,
    dtype: DTypeLike = "float32",
    chunk: int | None = None,
    transfer: bool = True,
    to_host: bool = True,
    devices: int | Sequence[jax.Device] | None = None,
) -> Plan:
    """Solve the MPC problem from each state x0s (B, n); the Plan holds host arrays, B in front.

    Where input rates are limited or weighted x0s may be (B, n + m), with the previous inputs in the
    last columns; (B, n) takes them as zero. The plans track the origin.

    mpc: the problem, or a Controller of it in float64, already condensed and factored, whose own
    solver counts. dtype: type of the ADMM iterates; Newton steps, residuals, status and the answer
    are float64 whatever it is, and whether or not 64-bit mode is on. chunk: states that a compiled
    program takes at once; None: by device. transfer: on a CPU, of very many states with few
    coordinates solve some, and let the others follow these (`active_set_reuse.py`). The status of
    each plan comes from its own residuals all the same: this changes the time, and which of several
    plans within the tolerances is found.
    to_host: False leaves the plans on the device. devices: a number of them, or a sequence of JAX
    devices, which share the states of a chunk; None: the default device. A state with NaN gets
    status NON_FINITE. Raises ValueError for wrong shapes and ill-posed problems.
    """
    if isinstance(mpc, Controller):
        problem = mpc.mpc
        if mpc.dtype != np.float64:
            fail("mpc", f"a controller in {mpc.dtype}", "Make it with jax.enable_x64(True)")
    else:
        require_kind("mpc", mpc, MPC)
        mpc.validate()
        problem = mpc
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
        if not isinstance(mpc, Controller):
            mpc = Controller(in_float64(mpc), replace(solver, dtype=np.dtype(dtype).name))
        if x0s.shape[1] < p:
            x0s = np.pad(np.asarray(x0s), ((0, 0), (0, p - n)))
        some = x0s if len(x0s) else np.zeros((1, p))  # and none of the plans from these
        plans = Batch(mpc, some, chunk, to_host, chosen).solve(transfer)
    return plans if len(x0s) else first_rows(plans, 0)
