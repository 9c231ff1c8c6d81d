"""All constraints of an MPC problem as blocks of rows, in the order of the condensed QP.

A block asks lower ≤ H x_k + D v_k ≤ upper at some steps k, with v_k = u_k or, for rates,
v_k = u_k − u_{k−1}. The order is inputs, states, outputs, rates, soft rows, terminal set; within
a block step by step. The condensed QP, the problem stage by stage, the proofs and the names of
multipliers are all made from this one list.

Along the horizon x are the states (N+1, n), u the inputs (N, m).
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from jaxmpc.checks import require_kind
from jaxmpc.mpc.problem import MPC, Outputs, Soft, output_stages, soft_stages
from jaxmpc.mpc.tightening import tightened
from jaxmpc.pytrees import pytree, record, static
from jaxmpc.qp.linalg import apply, apply_transposed, cholesky, matmul, namespace
from jaxmpc.qp.problem import Bounds
from jaxmpc.sets.convex_sets import Box, Ellipsoid, Polytope
from jaxmpc.systems.system import numbered

# (kind, steps, rows a step) of each block of rows.
Layout = tuple[tuple[str, tuple[int, ...], int], ...]


def consecutive(steps: tuple[int, ...]) -> bool:
    """Return whether the steps are k, k + 1, …"""
    return bool(steps) and steps == tuple(range(steps[0], steps[0] + len(steps)))


def at(v: Array, steps: tuple[int, ...]) -> Array:
    """Return v_k at the steps, zero at the one after the last of v."""
    if max(steps, default=0) == len(v):
        v = jnp.pad(v, ((0, 1), *[(0, 0)] * (v.ndim - 1)))
    if consecutive(steps):
        return v[steps[0] : steps[0] + len(steps)]
    return v[np.array(steps, int)]


def spread(part: Array, steps: tuple[int, ...], length: int) -> Array:
    """Return the array of so many steps that is `part` at the steps and zero elsewhere; a part at
    the step after the last is left out."""
    if max(steps, default=0) == length:
        return spread(part, steps, length + 1)[:-1]
    if consecutive(steps):
        ends = (steps[0], length - steps[0] - len(steps))
        return jnp.pad(part, (ends, *[(0, 0)] * (part.ndim - 1)))
    return jnp.zeros((length, *part.shape[1:]), part.dtype).at[np.array(steps, int)].add(part)


@pytree
class Rows:
    """The rows H x_k + D v_k at `steps`: H (r, n) and D (r, m), or one a step, None for zero. At
    step N, which has no input, D does not count. box: the one of them that is there is the
    identity."""

    kind: str = static()
    H: Any
    D: Any
    steps: tuple[int, ...] = static()
    box: bool = static()

    @property
    def size(self) -> int:
        """Rows at each step."""
        return (self.H if self.D is None else self.D).shape[-2]

    def values(self, x: Array, v: Array) -> Array:
        """Return H x_k + D v_k (steps, r)."""
        value: Any = 0.0
        for M, along in ((self.H, x), (self.D, v)):
            if M is not None:
                here = at(along, self.steps)
                value = value + (here if self.box else apply(M, here))
        return value

    def pull(self, weights: Array, gx: Array, gv: Array) -> tuple[Array, Array]:
        """Return gx, gv with Σ weights·(gradient of the row) added, weights (steps, r): the
        transpose of `values`."""

        def pulled(M: Array, length: int) -> Array:
            part = weights if self.box else apply_transposed(M, weights)
            return spread(part, self.steps, length)

        if self.H is not None:
            gx = gx + pulled(self.H, len(gx))
        if self.D is not None:
            gv = gv + pulled(self.D, len(gv))
        return gx, gv


@record
class Block(Rows):
    """lower ≤ H x_k + D v_k ≤ upper, lower and upper (r,), or (steps, r) where they differ from
    step to step.

    names, units: of the rows. rate: v_k is Δu_k. linear, quadratic (r,), or (steps, r): weights c
    and k of the penalty c e + ½ k e² of a violation e where the rows are soft (k is twice
    `Soft.quadratic`), None where they are hard. radius: the rows are those of a ball |H x| ≤
    radius.
    """

    lower: Any
    upper: Any
    names: tuple[str, ...]
    units: tuple[str, ...]
    rate: bool = False
    linear: Any = None
    quadratic: Any = None
    radius: Any = None

    def bounds(self) -> Bounds:
        """What is asked of the rows of all steps (steps·r,), without what follows from x_0."""

        def tiled(v: Any) -> Any:
            if v is None or np.ndim(v) == 2:
                return None if v is None else v.ravel()
            return namespace(v).tile(v, len(self.steps))

        l, u, linear, quadratic = map(tiled, (self.lower, self.upper, self.linear, self.quadratic))
        if self.radius is None:
            return Bounds(l, u, linear, quadratic)
        return Bounds(l, u, linear, quadratic, self.radius[None], (self.size,))

    def at_steps(self, side: np.ndarray, length: int, free: float) -> np.ndarray:
        """Return one of the two bounds (length, r), `free` at steps where the rows do not hold, of
        a block of NumPy."""
        found = np.full((length, self.size), free)
        found[np.array(self.steps, int)] = side
        return found


@dataclass(frozen=True)
class Row:
    """What one row of the condensed QP stands for.

    kind: "input", "state", "output", "rate", "soft" or "terminal". stage: its k. name, unit: of the
    quantity that is bounded. index: of the row within its stage. soft: whether it may be violated.
    """

    kind: str
    stage: int
    name: str
    unit: str
    index: int
    soft: bool


def blocks(mpc: MPC, dtype: DTypeLike) -> list[Block]:
    """Return the blocks of a problem, arrays in `dtype`; of a robust one those of the nominal
    problem it stands for (`tightening.py`). Works inside jit, vmap and grad; of a problem of
    NumPy's arrays its blocks are such."""
    found = given_blocks(mpc, dtype)
    return found if mpc.disturbance is None else tightened(mpc, found, dtype)


def given_blocks(mpc: MPC, dtype: DTypeLike) -> list[Block]:
    """Return the blocks of a problem with their bounds as they are given."""
    system, N, n, m = mpc.system, mpc.horizon, mpc.system.n, mpc.system.m
    found: list[Block] = []
    xp, dtype = namespace(mpc), jax.dtypes.canonicalize_dtype(dtype)
    state_names = system.state_names or numbered("x", n)
    input_names = system.input_names or numbered("u", m)
    of_states = state_names, system.state_units
    of_inputs = input_names, system.input_units

    def cast(v: Any) -> Array:
        return xp.asarray(v, dtype)

    def add(
        kind: str,
        H: Any,
        D: Any,
        sides: tuple,
        stages: Iterable[int],
        texts: tuple,
        box: bool = False,
        **more: Any,
    ) -> None:
        stages = tuple(stages)
        if not stages:
            return
        H, D = (None if M is None else cast(M) for M in (H, D))
        r = (H if D is None else D).shape[-2]
        names, units = texts
        names = tuple(names) or tuple(f"{kind} row {i + 1}" for i in range(r))
        units = tuple(units) or ("",) * r
        lower, upper = map(cast, sides)
        found.append(Block(kind, H, D, stages, box, lower, upper, names, units, **more))

    def add_set(kind: str, limits: Box | Polytope, stages: Iterable[int], texts: tuple) -> None:
        M, *sides = limits.rows()
        H, D = (None, M) if kind == "input" else (M, None)
        texts = (limits.labels, ()) if isinstance(limits, Polytope) else texts
        add(kind, H, D, tuple(sides), stages, texts, box=isinstance(limits, Box))

    if mpc.inputs is not None:
        add_set("input", mpc.inputs, range(N), of_inputs)
    if mpc.states is not None:
        add_set("state", mpc.states, mpc.state_stages, of_states)
    for rows in (mpc.outputs,) if isinstance(mpc.outputs, Outputs) else mpc.outputs:
        stages = output_stages(mpc, rows)
        add("output", rows.C, rows.D, rows.sides, stages, (rows.names, rows.units))
    if mpc.rate_limited:
        limit: Any = mpc.input_rate_limit
        if not isinstance(limit, Box):
            limit = cast(limit)
            limit = xp.broadcast_to(limit, (m,)) if limit.ndim < 2 else limit
            limit = Box(-limit, limit)
        names = tuple(f"rate of {name}" for name in input_names)
        texts = names, tuple(f"{unit}/step" for unit in system.input_units)
        D, *sides = limit.rows()
        add("rate", None, D, tuple(sides), range(N), texts, rate=True, box=True)
    for soft in (mpc.soft,) if isinstance(mpc.soft, Soft) else mpc.soft:
        stages, p = soft_stages(mpc, soft), cast(soft.C).shape[-2:-1]
        linear, quadratic = cast(soft.rho), 2 * cast(soft.quadratic)
        linear, quadratic = (
            v if v.ndim == 2 else xp.broadcast_to(v, p) for v in (linear, quadratic)
        )
        texts = soft.names, soft.units
        more: dict[str, Any] = {"linear": linear, "quadratic": quadratic}
        add("soft", soft.C, soft.D, soft.sides, stages, texts, **more)
    last = mpc.terminal_set
    if isinstance(last, Ellipsoid):  # x'Px = |L'x|²
        P = cast(last.P)
        L, zero = _root((P + P.T) / 2), np.zeros(n)
        texts = ("terminal ellipsoid",) * n, ()
        add("terminal", L.T, None, (zero, zero), (N,), texts, radius=xp.sqrt(cast(last.level)))
    elif last is not None:
        add_set("terminal", last, (N,), of_states)
    return found


def _root(P: Any) -> Any:
    """Return the lower triangular L with L L' = P, NaN where there is none."""
    if namespace(P) is not np:
        return cholesky(P)
    try:
        return np.linalg.cholesky(P)
    except np.linalg.LinAlgError:
        return np.full_like(P, np.nan)


def bounds_of(found: list[Block], dtype: DTypeLike) -> Bounds:
    """Return what is asked of the rows of all blocks, one after the other."""
    return joined_bounds([block.bounds() for block in found], dtype)


def joined_bounds(each: list[Bounds], dtype: DTypeLike) -> Bounds:
    """Return the bounds of rows one after the other; those of balls are the last."""
    xp = namespace(each)
    joined = lambda parts: xp.concatenate([xp.zeros(0, dtype), *parts])
    bounds = Bounds(joined(b.l for b in each), joined(b.u for b in each))
    if any(b.linear is not None for b in each):
        hard = [(xp.full_like(b.l, np.inf), xp.zeros_like(b.l)) for b in each]
        weights = [
            none if b.linear is None else (b.linear, b.quadratic)
            for b, none in zip(each, hard, strict=True)
        ]
        linear, quadratic = map(joined, zip(*weights, strict=True))
        bounds = replace(bounds, linear=linear, quadratic=quadratic)
    balls = [b for b in each if b.balls]
    if balls:
        radius = xp.concatenate([b.radius for b in balls])
        bounds = replace(bounds, radius=radius, balls=tuple(b.balls[0] for b in balls))
    return bounds


def row_table(mpc: MPC) -> tuple[Row, ...]:
    """Return one entry for each row of the condensed QP, in its order."""
    require_kind("mpc", mpc, MPC)
    mpc.validate()
    return tuple(
        Row(b.kind, k, b.names[i], b.units[i], i, b.linear is not None)
        for b in given_blocks(mpc, float)
        for k in b.steps
        for i in range(b.size)
    )


def stacked(
    block: Block, states: tuple[Array, ...], inputs: tuple[Array, ...]
) -> tuple[Array, Array, Array]:
    """Return (C, D, d) of a block: its rows are C z + D θ + d.

    states (Γ, Φ, φ): x_k = Γ_k z + Φ_k θ + φ_k. inputs: the same for v_k. What an input adds to a
    row counts as zero where it is rounding beside what it adds to the same row at other times: a
    row that no input moves (with explicit Euler the position at k = 1) is one of zeros.
    """
    steps, r, m = np.array(block.steps, int), block.size, inputs[0].shape[1]
    xp = namespace((states, inputs, block.H, block.D))
    fixed = jax.lax.stop_gradient if xp is jnp else lambda tree: tree

    def added(x: Any, v: Any, H: Any, D: Any) -> Array:
        part: Any = 0.0
        if H is not None:
            part = part + _each(H, x[steps])
        if D is not None:
            part = part + _each(D, v[steps])
        return part.reshape((len(steps), r, *x.shape[2:]))

    parts = [added(x, v, block.H, block.D) for x, v in zip(states, inputs, strict=True)]
    given = fixed((states[0], inputs[0], block.H, block.D))
    terms = added(*jax.tree.map(xp.abs, given))
    moves = terms.shape[-1] // m
    most = xp.max(terms.reshape(len(steps), r, moves, m), axis=(0, 2), initial=0.0)
    noise = 8 * xp.finfo(terms.dtype).eps * xp.tile(most, moves)
    none = fixed(xp.where(xp.abs(parts[0]) <= noise, parts[0], 0.0))
    C, D, d = (v.reshape(-1, *v.shape[2:]) for v in (parts[0] - none, *parts[1:]))
    return C, D, d


def _each(H: Array, M: Array) -> Array:
    """Return H M_k, or H v_k for vectors, for every step."""
    return matmul(H, M) if M.ndim == 3 else apply(H, M)


def row_values(found: Iterable[Block], x: Array, u: Array, before: Array) -> Array:
    """Return the rows (rows,) of states x (N+1, n) and inputs u (N, m), after the input `before`
    (m,)."""
    rates = jnp.diff(u, axis=0, prepend=before[None])
    values = [b.values(x, rates if b.rate else u).ravel() for b in found]
    return jnp.concatenate([*values, x[0, :0]])


def layout(mpc: MPC) -> Layout:
    """Return (kind, steps, rows a step) of each block of rows."""
    return layout_of(given_blocks(mpc, float))


def layout_of(found: Iterable[Rows]) -> Layout:
    """Return (kind, steps, rows a step) of each."""
    return tuple((b.kind, b.steps, b.size) for b in found)


def row_count(layout: Layout) -> int:
    """Return the number of all rows."""
    return sum(len(steps) * size for _, steps, size in layout)


def split(layout: Layout, y: Array) -> list[Array]:
    """Return y (rows,) as one array (steps, rows a step) for each block."""
    ends = np.cumsum([len(steps) * size for _, steps, size in layout], dtype=int)
    shapes = [(len(steps), size) for _, steps, size in layout]
    parts = jnp.split(y, ends)[: len(shapes)]
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


def dynamics_terms(A: Array, B: Array, c: Array, x: Array, u: Array) -> Array:
    """Return |A||x_k| + |B||u_k| + |c| (N, n), what x_{k+1} is made of."""
    return apply(jnp.abs(A), jnp.abs(x[:-1])) + apply(jnp.abs(B), jnp.abs(u)) + jnp.abs(c)
