"""solve_many: plans from many states, in chunks of one shape, on all cores, with transfer between
states.

Transfer reuses active sets: affine laws of the multipliers of some states are tried on others.
In ADMM's coordinates (H = I; `qp/admm.py`) a solution with active rows W has multipliers
S_WW y_W = v_W − b_W, where v = −A q are the rows of the unconstrained minimiser and b the active
bounds. Both are affine in the parameter θ of the problem, and so is y_W = L (θ, 1): the law of the
critical region (Bemporad et al. 2002, Automatica 38). States that lie in the same region as a
solved one get their exact solution from its law. Nothing is assumed: every plan is accepted by its
own residuals, and what is not solved so goes to the solver.

The nearest solved state is found by cells: quantiles of the states divide each coordinate, one
state of each cell is solved, and each state follows the nearest of its own cell and of those beside
it. That needs few coordinates.
"""

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
    host_copies,
    joined,
    over_devices,
    padded,
    placement,
    program_size,
    side_by_side,
    workers,
)
from jaxmpc.checks import fail, require_kind, require_memory, require_step_type, whole
from jaxmpc.mpc.condense import in_float64
from jaxmpc.mpc.controller import Controller, plan_of_solution
from jaxmpc.mpc.plan import Aim, Multipliers, Plan, checked_aim, flat_multipliers
from jaxmpc.mpc.problem import MPC
from jaxmpc.pytrees import pytree
from jaxmpc.qp.admm import ADMM, DEFAULT, scaled_multipliers
from jaxmpc.qp.dual import RIDGE, has_dual_steps, most_rows
from jaxmpc.qp.jax_transformations import default_platform, map_blocks, on_host, true_places
from jaxmpc.qp.linalg import matmul, solve
from jaxmpc.qp.residuals import NEAR
from jaxmpc.qp.solve import from_multipliers
from jaxmpc.qp.status import Status

# States from which on transfer is tried: below, compiling its programs costs more than it saves.
MANY_STATES = 32_768
# Of chunks so many or more, one is tried before all others; where fewer than this fraction of those
# that can be solved are by following, solving takes less time.
TRIAL_CHUNKS, LEAST_FOLLOWED = 16, 0.3
# Coordinates of a state up to which its neighbours are near enough.
MOST_COORDINATES = 4
# One state in so many is solved first.
STATES_A_CELL = 128
# States among which those are chosen, for each of them, and states that the quantiles are of.
CHOICE, QUANTILE_STATES = 4, 4096
# Multipliers relative to the largest that count as zero.
INACTIVE = 1e-9


@on_host
def solve_many(
    mpc: MPC | Controller,
    x0s: Reals,
    solver: ADMM = DEFAULT,
    *,
    reference: Reals | None = None,
    input_reference: Reals | None = None,
    dtype: DTypeLike | None = None,
    chunk: int | None = None,
    transfer: bool = True,
    to_host: bool = True,
    devices: int | Sequence[jax.Device] | None = None,
) -> Plan:
    """Solve the MPC problem from each state x0s (B, n); the Plan holds host arrays, B in front,
    some of which cannot be written into.

    Where input rates are limited or weighted x0s may be (B, n + m), with the previous inputs in the
    last columns; (B, n) takes them as zero. reference, input_reference: what all plans track, as in
    `solve`, None for zero; for one each take `jax.vmap` of `jm.solve`.

    mpc: the problem, or a Controller of it in float64, already condensed and factored, whose own
    solver counts. dtype: type of the ADMM iterates; None: that of `solver`, by default float32
    before Newton steps and float64 without any. Newton steps, residuals, status and the answer are
    float64 whatever it is, and whether or not 64-bit mode is on. chunk: states that a compiled
    program takes at once; None: by device. transfer: on a CPU, of very many states with few
    coordinates solve some, and let the others follow these (top of this file). The status of each
    plan comes from its own residuals all the same: this changes the time, and which of several
    plans within the tolerances is found.
    to_host: False leaves the plans on the device, without transfer. devices: a number of them, or a
    sequence of JAX devices, which share the states of a chunk; None: the default device. Plans that
    are left on several lie there in equal parts, in order, where the number of devices divides B;
    else each device has all of them. A state with NaN gets status
    NON_FINITE. Raises ValueError for wrong shapes and ill-posed problems.
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
    if dtype is not None:
        require_step_type(dtype)
        solver = replace(solver, dtype=np.dtype(dtype).name)
    chosen = chosen_devices(devices)
    if chunk is not None:
        whole("chunk", chunk, 1)
    n, p = problem.system.n, problem.dimension
    if not (isinstance(x0s, Array) and x0s.dtype == np.float64):
        x0s = host_array("x0s", x0s, copy=False)
    if x0s.ndim != 2 or x0s.shape[1] not in (n, p):
        fail("x0s", f"shape {x0s.shape}", f"Give states (B, {n})")
    each = 8 * (problem.horizon + 1) * (n + problem.system.m)
    require_memory("x0s", len(x0s) * each, "Solve some of them at a time")
    with jax.enable_x64(True):
        aim = checked_aim(problem, np.zeros(n), reference, input_reference)
        aim = jax.tree.map(partial(np.asarray, dtype=np.float64), aim).along(problem)
        if not isinstance(mpc, Controller):
            mpc = Controller(in_float64(mpc), solver)
        if x0s.shape[1] < p:
            x0s = np.pad(np.asarray(x0s), ((0, 0), (0, p - n)))
        if not len(x0s):
            shapes = jax.eval_shape(jax.vmap(mpc.plan), np.zeros((1, n)))
            empty = lambda s: (np if to_host else jnp).zeros((0, *s.shape[1:]), s.dtype)
            return jax.tree.map(empty, shapes)
        return Batch(mpc, aim, x0s, chunk, to_host, chosen).solve(transfer)


class Batch:
    """Plans from the states x (B, p), which lie in NumPy or on the device.

    aim: what they track. chunk: states that a program takes at once; devices share them. answer:
    the plans so far, B in front, in NumPy (to_host) or on the device.
    """

    def __init__(
        self,
        controller: Controller,
        aim: Aim,
        x: Any,
        chunk: int | None,
        to_host: bool,
        devices: Devices,
    ) -> None:
        self.x, self.to_host, self.devices = x, to_host, devices
        self.given = jax.device_put((controller, aim), placement(devices))
        on_cpu = default_platform() == "cpu"
        # Elsewhere than on a CPU two chunks at once: one is computed while the other is copied.
        self.together = workers() if on_cpu and devices is None else 2
        self._begins: Any = nullcontext() if on_cpu else threading.Lock()
        shares = workers() if devices is None and chunk is None else 1
        most = chunk or count(devices) * default_chunk(numbers_held(controller))
        size = -(-len(x) // shares)
        # (Cutting plans that lie on several devices would move them between these.)
        size = program_size(size) if to_host or devices is None else size
        self.chunk = divisible(min(most, size), devices)
        self._stores = threading.Lock()
        self.answer: Plan | None = None

    def solve(self, transfer: bool) -> Plan:
        """Return the plans from all states; transfer: as in `solve_many`."""
        B = len(self.x)
        left = np.arange(B)
        # (On GPUs the solver's kernels take less time than the laws and the host's indices would.)
        here = transfer and self.to_host and default_platform() == "cpu"
        if here and B >= MANY_STATES and transferable(self.given[0]):
            left = self._transfer()
        self._run(_plans(self.devices), self.given, left)
        assert self.answer is not None
        return self.answer

    def _transfer(self) -> np.ndarray:
        """Solve from some states, and from those that follow them; return the indices of those that
        are left."""
        index, cells = choose(self.x)
        self._run(_plans(self.devices), self.given, index)
        solved = jax.tree.map(lambda v: v[padded(index, len(cells.states))], self.answer)
        laws = laws_of(*self.given, solved.multipliers, solved.status)
        arguments = (*self.given, laws, cells)
        left = np.delete(np.arange(len(self.x)), index)
        if len(left) >= TRIAL_CHUNKS * self.chunk:
            few = np.random.default_rng(0).choice(left, self.chunk, replace=False)
            self._run(_follow(self.devices), arguments, few)
            solvable = 1 - np.mean(self._unsolved(index))
            if 1 - np.mean(self._unsolved(few)) < LEAST_FOLLOWED * solvable:
                return left
        # All states, for those that are next to each other are copied faster.
        every = np.arange(len(self.x))
        self._run(_follow(self.devices), arguments, every)
        return every[self._unsolved(every)]

    def _unsolved(self, index: np.ndarray) -> np.ndarray:
        """Return which of these states (k,) have no plan yet."""
        assert self.answer is not None
        return np.asarray(self.answer.status)[index] != Status.SOLVED

    def _run(self, program: Compiled, arguments: tuple, index: np.ndarray) -> None:
        """Put the plans of program(*arguments, states) from the states at `index` (k,) into
        `answer`."""
        size = self.chunk
        pieces = [index[i : i + size] for i in range(0, len(index), size)]

        def parts(where: np.ndarray) -> list[Plan]:
            with self._begins:
                found = program.parts(*arguments, self._states(where, size))
            return host_copies(found)

        def put(where: np.ndarray) -> None:
            self._put(where, parts(where))

        if not self.to_host:
            self.answer = self._left_there(program, arguments)
        elif self.answer is None and len(index) == len(self.x) <= size and self.devices is None:
            self.answer = first_rows(parts(index)[0], len(index))
        else:
            side_by_side(put, pieces, self.together)

    def _states(self, where: np.ndarray, size: int) -> Any:
        """Return the states at these indices (k,), k ≤ size, filled up."""
        if isinstance(self.x, np.ndarray):
            return padded(self.x[places(where)], size)
        return self.x if len(where) == len(self.x) == size else _rows(self.x, padded(where, size))

    def _put(self, where: np.ndarray, plans: list[Plan]) -> None:
        """Copy plans, in parts from each device, to these places of the answer on the host."""
        with self._stores:
            if self.answer is None:
                empty = lambda v: np.empty((len(self.x), *v.shape[1:]), v.dtype)
                self.answer = jax.tree.map(empty, plans[0])
        if isinstance(there := places(where), slice):
            joined(plans, jax.tree.map(lambda v: v[there], self.answer))
            return
        found = plans[0] if len(plans) == 1 else joined(plans)
        for all_, rows in zip(*map(jax.tree.leaves, (self.answer, found)), strict=True):
            all_[there] = rows[: len(where)]

    def _left_there(self, program: Compiled, arguments: tuple) -> Plan:
        """Return the plans from all states, which lie on the devices: each has its part of the
        states, in order, and takes `chunk` over their number at once."""
        each = self.chunk // count(self.devices)
        whole = max(divisible(len(self.x), self.devices), self.chunk)
        x = self._states(np.arange(len(self.x)), whole)
        # The caller's array may change once this has returned.
        x = jax.block_until_ready(jax.device_put(x, placement(self.devices, True), may_alias=False))
        share = whole // count(self.devices)
        if share == each:
            return first_rows(program.run(*arguments, x), len(self.x))
        piece = _piece(self.devices, each)
        found = [program.run(*arguments, piece.run(i, x)) for i in range(0, share, each)]
        structure = jax.tree.structure(found[0])
        arrays = list(map(list, zip(*map(jax.tree.leaves, found), strict=True)))
        found.clear()
        for i in range(len(arrays)):  # an array of the pieces is given up as soon as it is copied
            arrays[i] = _one_after_other(self.devices, share).run(arrays[i])
        return first_rows(jax.tree.unflatten(structure, arrays), len(self.x))


def numbers_held(controller: Controller) -> int:
    """Return about how many numbers a program holds of each plan: vectors of rows and inputs."""
    return 16 * sum(controller.condensed.C.shape)


def places(where: np.ndarray) -> np.ndarray | slice:
    """Return ascending indices (k,), as a slice where they are next to each other."""
    first, last = int(where[0]), int(where[-1])
    return slice(first, last + 1) if last - first == len(where) - 1 else where


@jax.jit
def _rows(x: Array, where: Array) -> Array:
    return x[where]


@functools.cache
def _piece(devices: Devices, size: int) -> Compiled:
    """Return the program: (first, x) → so many rows of each device's part of x, from there on; the
    last ones where fewer are left."""
    rows = lambda first, x: jax.lax.dynamic_slice_in_dim(x, first, size)
    return over_devices(rows, devices, (False, True))


@functools.cache
def _one_after_other(devices: Devices, total: int) -> Compiled:
    """Return the program: results of such pieces → those of each device's part, so many rows."""

    def join(pieces: list[Array]) -> Array:
        *others, last = pieces
        left = total - sum(map(len, others))
        return jnp.concatenate([*others, last[len(last) - left :]])

    return over_devices(join, devices, (True,))


@functools.cache
def _plans(devices: Devices) -> Compiled:
    """Return the program (controller, aim, x (B, p)) → plans."""

    def plan(controller: Controller, aim: Aim, x: Array) -> Plan:
        aim = from_coordinates(controller.mpc, aim, x)
        return controller.plan(aim.x0, aim.states, None, aim.inputs, aim.previous_input)

    return over_devices(jax.vmap(plan, (None, None, 0)), devices, (False, False, True))


def from_coordinates(mpc: MPC, aim: Aim, theta: Array) -> Aim:
    """Return the aim of a plan from θ (p,)."""
    x0, previous = jnp.split(theta, [mpc.system.n])
    return aim._replace(x0=x0, previous_input=previous if mpc.input_in_state else None)


@functools.cache
def _follow(devices: Devices) -> Compiled:
    """Return the program (controller, aim, laws, cells, x (B, p)) → plans of `follow`."""

    def run(controller: Controller, aim: Aim, laws: Laws, cells: Cells, x: Array) -> Plan:
        return map_blocks(jax.vmap(partial(follow, controller, aim, laws, cells)), x)

    return over_devices(run, devices, (False, False, False, False, True))


@pytree
class Laws:
    """The laws of S solved states: y[rows] = slope (θ, 1), rows (S, K), filled up with the number
    of rows, slope (S, K, p + 1); NaN where a state has none. sign (S, K): of these multipliers."""

    rows: Array
    sign: Array
    slope: Array

    def evaluate(self, i: Array, theta: Array, count: int) -> Array:
        """Return the multipliers (count,) that law i gives θ (p,), those of the wrong sign as 0."""
        y = jnp.sum(self.slope[i] * jnp.append(theta, 1.0), axis=1)
        y = jnp.where(self.sign[i] * y < 0, 0.0, y)
        return jnp.zeros(count, y.dtype).at[self.rows[i]].add(y, mode="drop")


@pytree
class Cells:
    """Cells of R^p: edges (g − 1, p) divide each coordinate in g. lower, width (g, p): of the
    intervals, in which distances are measured. law (g^p,): index of the state of each cell that is
    solved, −1 for none; states (S, p): all of these."""

    edges: Array
    lower: Array
    width: Array
    law: Array
    states: Array

    def nearest(self, x: Array) -> Array:
        """Return the index of the solved state nearest to x (p,), of those in its cell and the
        cells beside it; −1 where there is none."""
        g, p = self.lower.shape
        axis = np.arange(p)
        k = jnp.sum(x > self.edges, axis=0)
        lower, width = self.lower[k, axis], self.width[k, axis]
        side = jnp.where(x > lower + 0.5 * width, 1, -1)
        steps = np.concatenate([np.zeros((1, p), int), np.eye(p, dtype=int), np.ones((1, p), int)])
        beside = jnp.clip(k + steps * side, 0, g - 1)
        law = self.law[jnp.sum(beside * g ** axis[::-1], axis=1)]
        distance = jnp.sum(((self.states[law] - x) / width) ** 2, axis=1)
        return law[jnp.argmin(jnp.where(law < 0, jnp.inf, distance))]


def transferable(controller: Controller) -> bool:
    """Return whether states may follow solved ones: the problem has hard rows alone, curvature in
    all directions, and few coordinates."""
    c, f = controller.condensed, controller.factor
    if not has_dual_steps(c.balls, c.C) or c.soft_linear is not None:
        return False
    return controller.mpc.dimension <= MOST_COORDINATES and not bool(f.flat)


def choose(x: Any) -> tuple[np.ndarray, Cells]:
    """Return the indices of some of the states x (B, p), one a cell, and the cells.

    The number of cells follows from a power of two, so that few programs are compiled.
    """
    B, p = x.shape
    count = 2 ** int(np.log2(max(B // STATES_A_CELL, 1)))
    g = int(count ** (1 / p) + 1e-9)
    # At random: equal distances would be in step with the lines of a grid.
    index = np.sort(np.random.default_rng(0).integers(0, B, CHOICE * count))
    some = np.asarray(x[index])
    finite = np.all(np.isfinite(some), axis=1)
    index, some = index[finite], some[finite]
    if not len(some):
        index, some = np.zeros(1, int), np.zeros((1, p))
    few = np.random.default_rng(1).integers(0, len(some), QUANTILE_STATES)
    ordered = np.sort(some[few], axis=0)
    ends = ordered[np.linspace(0, len(ordered) - 1, g + 1).astype(int)]
    edges, width = ends[1:-1], np.diff(ends, axis=0)
    k = [np.searchsorted(edges[:, j], some[:, j]) for j in range(p)]
    cell = np.ravel_multi_index(k, (g,) * p)
    first = np.full(g**p, -1)
    first[cell[::-1]] = np.arange(len(some))[::-1]
    chosen = np.flatnonzero(first >= 0)
    law = np.full(g**p, -1, np.int32)
    law[chosen] = np.arange(len(chosen))
    states = padded(some[first[chosen]], g**p)
    width = np.where(width > 0, width, 1.0)
    cells = Cells(*map(jnp.asarray, (edges, ends[:-1], width, law, states)))
    return index[first[chosen]], cells


@jax.jit
def laws_of(controller: Controller, aim: Aim, multipliers: Multipliers, status: Array) -> Laws:
    """Return the laws of plans with these multipliers and this status, S in front."""
    c, f = controller.condensed, controller.factor
    constant = c.qp(jnp.zeros(c.F.shape[1]), aim.states, aim.inputs).q
    m, most = len(f.E), most_rows(c.C)
    finite = lambda bound: jnp.where(jnp.isfinite(bound), bound, 0.0)
    # v − b of the upper and of the lower bound, in (θ, 1).
    linear = f.E[:, None] * c.D - matmul(f.A, matmul(f.T.T, c.F))
    shift = f.E * c.d - matmul(matmul(constant, f.T), f.A.T)
    beyond = lambda bound: jnp.column_stack([linear, shift - f.E * finite(bound)])
    upper, lower = beyond(c.upper), beyond(c.lower)

    def law(multipliers: Array, solved: Array) -> Laws:
        y = scaled_multipliers(f.E, multipliers)
        active = jnp.abs(y) > INACTIVE * jnp.max(jnp.abs(y), initial=0.0)
        rows = true_places(active, most)
        take = lambda v: v.at[rows].get(mode="fill", fill_value=0.0)
        sign = jnp.sign(take(y))
        right = jnp.where(sign[:, None] > 0, take(upper), take(lower))
        S = f.S.at[rows[:, None], rows[None, :]].get(mode="fill", fill_value=0.0)
        S = S + jnp.diag(jnp.where(rows < m, 0.0, 1.0))
        definite = S + RIDGE * jnp.eye(len(rows))
        columns = jax.vmap(lambda column: solve(definite, column), in_axes=1, out_axes=1)
        slope = columns(right)
        # The ridge moves rows by RIDGE·y, more than the tolerance of what is solved allows.
        slope = slope + columns(right - matmul(S, slope))
        known = solved & (jnp.sum(active) <= most)
        return Laws(rows, sign, jnp.where(known, slope, jnp.nan))

    flat = jax.vmap(lambda m: flat_multipliers(c.layout, m))(multipliers)
    return jax.vmap(law)(flat, status == Status.SOLVED)


def follow(controller: Controller, aim: Aim, laws: Laws, cells: Cells, theta: Array) -> Plan:
    """Return the plan from θ (p,) by the law of a solved state nearby: SOLVED where its residuals
    are as small as those at which the solver ends, or ITERATION_LIMIT, also where there is no law.
    """
    c, f = controller.condensed, controller.factor
    i = cells.nearest(theta)
    y = jnp.where(i < 0, jnp.nan, laws.evaluate(i, theta, len(f.E)))
    found, fault = from_multipliers(c.qp(theta, aim.states, aim.inputs), f, y)
    aim = from_coordinates(controller.mpc, aim, theta)
    return plan_of_solution(controller, theta, aim, found, fault, share=NEAR)
