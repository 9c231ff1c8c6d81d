"""Equilibria of a linear system: the steady state and input that a reference requires, and the
nearest ones within the limits of a problem, again and again under other loads."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax import Array

from jaxmpc.arrays import Reals, host_array
from jaxmpc.checks import fail, require_finite, require_kind, require_shape
from jaxmpc.mpc.problem import HARD, MPC, weights_of
from jaxmpc.mpc.rows import Block, blocks, joined_bounds
from jaxmpc.pytrees import named_pytree, pytree, static
from jaxmpc.qp.admm import ADMM, Factor, factorise
from jaxmpc.qp.jax_transformations import compiled_lightly, own_modes
from jaxmpc.qp.linalg import arrays, floating_dtype, inverse_root, matmul
from jaxmpc.qp.problem import QP, Bounds
from jaxmpc.qp.residuals import with_fault
from jaxmpc.qp.solve import solve_factored
from jaxmpc.sets.convex_sets import Box
from jaxmpc.sets.lp import scaling
from jaxmpc.systems.system import LinearSystem, host_matrices, numbered
from jaxmpc.systems.units import balanced, less_identity

# Singular values of balanced matrices, relative to the largest, that count as zero.
SINGULAR = 1e-10
# Weight of effort beside distances of outputs, where these leave inputs free, in units in which the
# row that outputs move most beside effort sees both alike (`_price`). Outputs are off by its square
# (`SteadyStates.nearest`). Rows of less than LEAST_SHARE of that do not count for it.
EFFORT = 1e-6
LEAST_SHARE = 1e-3
# Weight of x'Qx beside u'Ru in effort: it decides where no input tells, as of positions at rest.
STATES = 1e-8
# Errors of targets are errors of the loop, which settles there.
TIGHT = ADMM(eps=1e-10)


def equilibrium(
    system: LinearSystem,
    target: Reals,
    *,
    C: Reals | None = None,
    states: Box | None = None,
    inputs: Box | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return (x, u) with x = A x + B u + c and C x = target: what to track and the input that holds
    it.

    target (p,): of the outputs C x, C (p, n); without C of all states. Of several equilibria it is
    the one of least norm, if that keeps the limits. states, inputs: Box limits to stay in, or None.
    Give x and u to `solve` as reference and input_reference, so that the cost vanishes there.

    Raises ValueError where no equilibrium meets the target, within the limits if there are any: the
    message says how far the closest one stays from it. NumPy in float64; not traceable; the
    residual of each row is below 1e-9 times the size of its terms, in any units.
    """
    require_kind("system", system, LinearSystem)
    system.validate()
    n, m = system.n, system.m
    C = np.eye(n) if C is None else host_array("C", C)
    if C.ndim != 2 or C.shape[1] != n:
        fail("C", f"shape {C.shape}", f"Give (p, {n}), one column a state")
    require_finite("C", C)
    require_shape("target", target, (len(C),), "One value for each row of C")
    target = host_array("target", target)
    require_finite("target", target)
    A, B, c = host_matrices(system)
    M = np.vstack([np.hstack([-less_identity(A), -B]), np.hstack([C, np.zeros((len(C), m))])])
    value = np.concatenate([c, target])
    low, high = np.full(n + m, -np.inf), np.full(n + m, np.inf)
    for set_, part, name, size in (
        (states, slice(0, n), "states", n),
        (inputs, slice(n, n + m), "inputs", m),
    ):
        if set_ is not None:
            require_kind(name, set_, Box, cure="Give a Box, or None")
            set_.validate(name, size)
            low[part], high[part] = np.asarray(set_.lower, float), np.asarray(set_.upper, float)
    # In units in which all numbers are about 1: none of the user's decide what is an equilibrium.
    # An entry far below the others, rounding of 0 as in a computed target, may be no unit.
    small = np.abs(value) < 1e-14 * np.abs(value).max(initial=0.0)
    for sides in (value, np.where(small, 0.0, value)) if np.any(value[small]) else (value,):
        found, error, held = _least_error(M, value, sides, low, high)
        if held:
            return found[:n], found[n:]
    closest, drift = C @ found[:n], np.abs(error[:n]).max()
    away = f"the closest has outputs {closest} and drifts by {drift:.3g} a step"
    what = f"{target} is held by no equilibrium ({away})"
    fail("target", what, "Choose another target or widen the limits")


def _least_error(
    M: np.ndarray, value: np.ndarray, sides: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return z within its bounds with the least error M z − value, of least effort, that error, and
    whether it is rounding. sides: of the rows, from which the units follow."""
    every = np.vstack([M, np.eye(len(low)), np.eye(len(low))])
    row, column = scaling(every, np.concatenate([sides, low, high]))
    row = row[: len(M)]
    rows, scaled = row[:, None] * M * column, row * value
    z, _, rank, _ = np.linalg.lstsq(rows, scaled, rcond=1e-12)
    free = column[:, None] * np.linalg.svd(rows)[2][rank:].T
    found = column * z
    found = found - free @ np.linalg.lstsq(free, found, rcond=None)[0]
    if not np.all((low <= found) & (found <= high)):
        open_, found = low < high, low.copy()
        if np.any(open_):
            # bvls: an active-set method, exact up to rounding.
            scaled = scaled - rows[:, ~open_] @ (low / column)[~open_]
            ends = (low / column)[open_], (high / column)[open_]
            z = scipy.optimize.lsq_linear(rows[:, open_], scaled, ends, method="bvls", tol=1e-15).x
            found[open_] = np.clip(column[open_] * z, low[open_], high[open_])
    for _ in range(2):  # where units are far apart, rounding of large entries moves small ones
        inside = (low < found) & (found < high)
        left = row * (value - M @ found)
        moved = column[inside] * np.linalg.lstsq(rows[:, inside], left, rcond=1e-12)[0]
        found[inside] = np.clip(found[inside] + moved, low[inside], high[inside])
    error = M @ found - value
    size = np.abs(M) @ np.abs(found) + np.abs(value)
    # Sums of zeros are off by rounding of the largest numbers.
    rounding = 1e-14 * np.max(np.append(np.abs(found) / column, np.abs(row * value))) / row
    return found, error, bool(np.all(np.abs(error) <= rounding + 1e-9 * size))


@named_pytree
class SteadyState(NamedTuple):
    """A state x (n,) that the input u (m,) holds, and the status of the search for it."""

    x: Array
    u: Array
    status: Array


@pytree
class SteadyStates:
    """The steady states x = A x + B u + c + load of an MPC problem within its limits, for any load.

    All solutions of [I − A, −B] (x, u) = c + load are (x, u) = held (c + load) + free w, w (m,): of
    the problem for a target of the outputs C x only w is left. With the singular values σ of the
    outputs of `free`, in units, w is turned and scaled so that the first `count` entries of
    v = σ V'w move outputs; the others, if any, move none. What they move has as its effort, u'Ru
    + STATES·x'Qx, the sum of their squares, apart from that of the first ones, and they come as
    close as the limits let them to those of least effort.

    held (n + m, n), free (n + m, m), outputs (q, n), rows: H (r, n + m), bounds. unit (q,).
    seen (m, q): from errors of outputs to v. at_ease (m, n + m): from held (c + load) to the v of
    least effort. price (m,): weights of distances in v (`_price`). count: of the entries of v that
    outputs see.
    """

    held: Any
    free: Any
    c: Any
    outputs: Any
    unit: Any
    seen: Any
    at_ease: Any
    H: Any
    bounds: Bounds
    price: Any
    factor: Factor
    solver: ADMM
    count: int = static()

    @classmethod
    def of(
        cls, mpc: MPC, system: LinearSystem, outputs: np.ndarray, unit: np.ndarray
    ) -> "SteadyStates":
        """Return the steady states of a problem for outputs (q, n), whose errors are measured in
        these units (q,). system: its model, with values that can be read; limits may be traced.
        Raises ValueError where the inputs do not hold every load."""
        mpc.require_constant("a steady state has one for all", *HARD, "soft")
        A, B, c = host_matrices(system)
        n, m = B.shape
        M = np.hstack([-less_identity(A), -B])
        row, column = balanced(M)
        left, values, right = np.linalg.svd(row[:, None] * M * column)
        if values[-1] <= SINGULAR * values[0]:
            names = system.state_names or numbered("x", n)
            entry = np.abs(left[:, -1])
            which = [name for name, v in zip(names, entry, strict=True) if v > 0.1 * entry.max()]
            what = f"no input holds a load on {', '.join(which)}, which integrates it"
            fail("mpc.system", what, "Actuate it, or leave it out of the model")
        held = column[:, None] * (right[:n].T / values) @ left.T * row
        free = column[:, None] * right[n:].T
        U, sigma, V = np.linalg.svd(outputs / unit[:, None] @ free[:n])
        count = int(np.sum(sigma > 1e-8 * max(sigma.max(initial=0.0), np.finfo(float).tiny)))
        dtype = floating_dtype(mpc)
        turned = free @ V.T * np.append(1 / sigma[:count], np.ones(m - count))
        ordered, at_ease = _by_effort(mpc, turned, count)
        seen = np.zeros((m, len(unit)))
        seen[:count] = U.T[:count]
        rows = [_at_rest(b) for b in blocks(mpc, dtype) if b.steps and not b.rate]
        bounds = joined_bounds([b.bounds() for b in rows], dtype)
        parts = [jnp.zeros((0, n + m), dtype)]
        for b in rows:
            sides = ((b.H, n), (b.D, m))
            columns = [jnp.zeros((b.size, size), dtype) if M is None else M for M, size in sides]
            parts.append(jnp.concatenate(columns, axis=1))
        H = jnp.concatenate(parts)
        given = arrays((held, ordered, c, outputs, unit, seen, at_ease, H, bounds))
        priced = _factor(given[1], given[7], TIGHT, count=count, balls=bounds.balls)
        return cls(*given, *priced, arrays(TIGHT), count)

    def nearest(self, target: Array, load: Array) -> SteadyState:
        """Return the steady state under a load (n,) whose outputs are nearest to the target (q,).

        Of several, the one of least effort: the second of two proximal steps, each from the answer
        before, so that effort moves outputs by EFFORT² only.
        """
        return _nearest(self, target, load)


def _at_rest(block: Block) -> Block:
    """Return the rows of a block, hard, at one step, with the bounds that hold at all of them."""
    lower, upper = block.lower, block.upper
    if np.ndim(lower) == 2:
        lower, upper = jnp.max(lower, axis=0), jnp.min(upper, axis=0)
    hard = replace(block, lower=lower, upper=upper, linear=None, quadratic=None)
    return replace(hard, steps=block.steps[:1])


def _by_effort(mpc: MPC, free: np.ndarray, count: int) -> tuple[Array, Array]:
    """Return the directions `free` (n + m, m), with those behind the first `count` turned and
    scaled so that effort is a sum of squares along them, and to which the first ones are
    perpendicular in effort; and `SteadyStates.at_ease`."""
    dtype, n = floating_dtype(mpc), mpc.system.n
    Q, R, *_ = weights_of(mpc, dtype)
    Q, R = (jnp.mean(M, axis=0) if M.ndim == 3 else jnp.asarray(M) for M in (Q, R))
    given = jnp.asarray(free, dtype)
    moved, unseen = given[:, :count], given[:, count:]
    weighed = jnp.concatenate([STATES * matmul(Q, unseen[:n]), matmul(R, unseen[n:])])
    W = matmul(unseen.T, weighed)
    size = jnp.sum(jnp.diag(W))
    least = jnp.where(size > 0, 1e-12 * size, 1.0)  # of directions without a cost
    root = inverse_root(W + least * jnp.eye(len(W), dtype=dtype)) if len(W) else W
    unseen, effort = matmul(unseen, root.T), matmul(root, weighed.T)
    moved = moved - matmul(unseen, matmul(effort, moved))
    at_ease = -jnp.concatenate([jnp.zeros((count, len(free)), dtype), effort])
    return jnp.concatenate([moved, unseen], axis=1), at_ease


@compiled_lightly(0, static_argnames=("count", "balls"))
@own_modes
def _factor(
    free: Array, H: Array, solver: ADMM, *, count: int, balls: tuple[int, ...]
) -> tuple[Array, Factor]:
    price = _price(H, free, count)
    return price, factorise(2 * jnp.diag(price), matmul(H, free.astype(H.dtype)), solver, balls)


def _price(H: Array, free: Array, count: int) -> Array:
    """Return the weights (m,) of the distances in v: 1 where outputs see them, else ε.

    Where a row of limits asks f of effort, outputs d away from their target and the row moved by
    h_s along outputs and by h_f along effort, both of length one, the least of d² + ε f² has
    d = ε (h_s/h_f) f: it is small where ε is beside the least of (h_f/h_s)². Units of rows, outputs
    and effort play no part in that.
    """
    m = free.shape[1]
    moved, size = matmul(H, free), matmul(jnp.abs(H), jnp.abs(free))
    moved = jnp.where(jnp.abs(moved) > SINGULAR * size, moved, 0.0)
    along, across = (jnp.linalg.norm(part, axis=1) for part in (moved[:, :count], moved[:, count:]))
    both = (along > 0) & (across > 0)
    share = jnp.where(both, across / jnp.where(both, along, 1.0), jnp.nan)
    most = jnp.nanmax(share, initial=0.0)
    least = jnp.where(both & (share > LEAST_SHARE * most), share, jnp.inf)
    least = jnp.min(least, initial=jnp.inf)
    price = EFFORT * jnp.where(jnp.isfinite(least), least, 1.0) ** 2
    return jnp.where(np.arange(m) < count, 1.0, price).astype(free.dtype)


@compiled_lightly(1)
@own_modes
def _nearest(p: SteadyStates, target: Array, load: Array) -> SteadyState:
    dtype = target.dtype
    p = jax.tree.map(lambda v: v.astype(dtype) if v.dtype.kind == "f" else v, p)
    n, m = p.outputs.shape[1], p.free.shape[1]
    base = matmul(p.held, p.c + load)
    aim = matmul(p.seen, (target - matmul(p.outputs, base[:n])) / p.unit) + matmul(p.at_ease, base)
    H, shift, limits = matmul(p.H, p.free), matmul(p.H, base), p.bounds
    lower, upper = limits.l - shift, limits.u - shift
    rest = limits.radius, limits.sizes(), limits.balls
    v = aim
    for _ in range(1 if p.count == m else 2):
        v = jnp.where(np.arange(m) < p.count, aim, v)
        qp = QP(2 * jnp.diag(p.price), -2 * p.price * v, H, lower, upper, None, None, *rest)
        found = with_fault(*solve_factored(qp, p.factor, p.solver))
        v = found.z
    z = base + matmul(p.free, v)
    return SteadyState(z[:n], z[n:], found.status)
