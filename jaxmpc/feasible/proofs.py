"""Proofs that a state is feasible or infeasible, evaluated in float64 and safe against rounding.

Both work on the exact data of the problem (A, B, c and the sets), not on condensed matrices. Where
input rates are limited x stands for (x, u_{k−1}). Soft rows are no constraints and play no part.

*Feasible*: inputs clipped into their limits are rolled out, x_{k+1} = A x_k + B u_k + c, with a
running bound on the rounding error, ε_{k+1} = |A| ε_k + γ(|A||x_k| + |B||u_k| + |c|). Every
row must hold with a margin no less than |H| ε_k plus the rounding of the row's own product.

*Infeasible*: for any multipliers y_k of the rows H x_k + D u_k the costates p_N = H_N'y_N,
p_k = A'p_{k+1} + H'y_k satisfy Σ y_k'(H x_k + D u_k) = p_0'x_0 + Σ (B'p_{k+1} + D'y_k)'u_k +
c'p_{k+1} along every trajectory; with σ the support function of each set this bounds every
feasible x_0,

    p_0'x_0 ≤ Σ_k σ(y_k) + Σ_k [σ_U(−B'p_{k+1} − D'y_k) − c'p_{k+1}].

Inputs that must be equal (a control horizon) share one σ_U of their sum. A terminal ellipsoid
{x'Px ≤ α} adds Pv to p_N and its support √(α v'Pv), for any v.

No property of y is needed, so any iterate gives a valid half-space; a converged one gives a
tight one. (Neumaier & Shcherbina 2004: the input limits absorb the dual residual.)

*Rounding.* The computed p_k is off by at most e_k = |A|'e_{k+1} + γ(|A|'|p_{k+1}| + |H|'|y_k|).
Such an error meets x_k, and is settled there where limits on x_k are near, or else is left to the
steps before, e_k → |A|'e_k, with what it meets of u and c on the way. To settle it, p_k is moved
by s∘e_k, s_i ∈ {−1, 0, 1}, at the price of e_k'reach_k, where |x_k| + s∘x_k ≤ reach_k: a limit
on one side of x_k suffices, since |x| + x ≤ 2 max(x, 0). What arrives at k = 0 gives

    a'θ ≤ b + w'|θ|   for every feasible θ,

which decides about θ whether the feasible set is bounded or not, and takes no figure from a solver
(but for the box round a polytope, a part in 10⁶ outwards). In the same way it becomes a half-space
for the whole set, with (a + s∘w)'θ ≤ b + w'reach_0, as far as limits on x_0, or the extent that
LPs find (`ladder.bounding_box`), doubled, leave θ_i a finite side for each w_i ≠ 0. (Where a set
extends both ways without end along a facet there is none: its normal is no vector of floats.)
"""

import itertools
from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.checks import fail, require_finite, require_shape
from jaxmpc.control.sets import Box, Ellipsoid, Polytope
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.rows import Block, blocks

UNIT_ROUNDOFF = 2.0**-53
# Covers products that underflow; data smaller than this are not told from zero.
TINY = 1e-290


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class View:
    """Which initial states a point θ (d,) of the map stands for.

    x_0 has θ at `axes` and `fixed` elsewhere (slice), or, where `fixed` is None, anything in the
    box [lower, upper] of the other states (projection: feasible if some value is).
    """

    axes: tuple[int, ...] = field(metadata={"static": True})
    others: tuple[int, ...] = field(metadata={"static": True})
    fixed: Any
    lower: Any
    upper: Any

    @property
    def projects(self) -> bool:
        """True when the states that are not mapped are free."""
        return self.fixed is None and bool(self.others)

    def initial_state(self, theta: Array, free: Array) -> Array:
        """x_0 (n,) of a point θ and values `free` of the other states, clipped into their box."""
        n = len(self.axes) + len(self.others)
        x = jnp.zeros(n, theta.dtype) if self.fixed is None else jnp.asarray(self.fixed)
        x = x.at[np.array(self.axes)].set(theta)
        if self.projects:
            x = x.at[np.array(self.others)].set(jnp.clip(free, self.lower, self.upper))
        return x


def make_view(mpc: MPC, axes: Any = None, fixed: Any = None) -> View:
    """Check and complete the choice of states to map; raise ValueError for a wrong one.

    axes: indices or names of the mapped states, None for all. fixed: values (n,) of all states
    (those at `axes` are ignored) for a slice, None for a projection along the others.
    """
    n = mpc.dimension
    names = list(mpc.system.state_names)
    axes = tuple(range(n)) if axes is None else tuple(axes)
    axes = tuple(names.index(i) if isinstance(i, str) and i in names else i for i in axes)
    if not all(isinstance(i, int | np.integer) for i in axes):
        fail("axes", f"{axes}", f"Give state indices or names ({', '.join(names) or 'none set'})")
    axes = tuple(int(i) for i in axes)
    if not axes or len(set(axes)) != len(axes) or not all(0 <= i < n for i in axes):
        fail("axes", f"{axes}", f"Give different state indices from 0 to {n - 1}")
    others = tuple(i for i in range(n) if i not in axes)
    if fixed is not None and others:
        require_shape("fixed", fixed, (n,), "One value for each state; those at axes are ignored")
        require_finite("fixed", np.asarray(fixed, float)[list(others)])
        fixed = np.asarray(fixed, np.float64)
        return View(axes, others, np.where(np.isin(np.arange(n), others), fixed, 0.0), None, None)
    constrained = others and 0 in mpc.state_steps
    sides = bounding_box(mpc.states if constrained else None, mpc.system.n)
    if n > mpc.system.n:  # a previous input is one that could be applied
        limits = bounding_box(mpc.inputs, mpc.system.m)
        sides = (np.append(sides[0], limits[0]), np.append(sides[1], limits[1]))
    lower, upper = sides
    return View(axes, others, None, lower[list(others)], upper[list(others)])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Problem:
    """The hard constraints of an MPC problem as float64 arrays: exact data for proofs.

    lower_k ≤ H x_k + D u_k ≤ upper_k for k < N: H (r, n), D (r, m), lower and upper (N, r), ±inf at
    steps where a row does not hold. lower_N ≤ H_N x_N ≤ upper_N. P, level: terminal ellipsoid
    x'Px ≤ level, None without; back (n, rows) leads from multipliers of its rows L'x to v.
    u_lower, u_upper (m,): a box round the inputs; move_lower, move_upper (moves, m): what limits on
    the states leave of it to each free move. left (N, n): 1 where errors of p_k, k = 1..N, are left
    to the steps before; elsewhere, and there side and reach are 0 too, |x_k| + side∘x_k ≤ reach on
    every feasible trajectory. side_0, reach_0 (d,): the same of every feasible θ, ∞ where nothing
    bounds it. moves: number of the free move that each input is.
    """

    A: Any
    B: Any
    c: Any
    H: Any
    D: Any
    lower: Any
    upper: Any
    H_N: Any
    lower_N: Any
    upper_N: Any
    P: Any
    level: Any
    back: Any
    u_lower: Any
    u_upper: Any
    move_lower: Any
    move_upper: Any
    left: Any
    side: Any
    reach: Any
    side_0: Any
    reach_0: Any
    view: View
    moves: tuple[int, ...] = field(metadata={"static": True})

    @property
    def horizon(self) -> int:
        """N."""
        return len(self.moves)


def hard_part(mpc: MPC) -> MPC:
    """The problem without soft rows and rate weights, which have no part in what is feasible."""
    return replace(mpc, soft=(), input_rate_weight=None)


def dynamics(mpc: MPC) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B, c of x⁺ = Ax + Bu + c, for (x, u_{−1}) where input rates are limited."""
    to64 = lambda v: np.asarray(v, np.float64)
    n, m = mpc.system.n, mpc.system.m
    A, B = to64(mpc.system.A), to64(mpc.system.B)
    c = np.zeros(n) if mpc.system.c is None else to64(mpc.system.c)
    if mpc.rate_limited:
        A = np.block([[A, np.zeros((n, m))], [np.zeros((m, n + m))]])
        B, c = np.concatenate([B, np.eye(m)]), np.concatenate([c, np.zeros(m)])
    return A, B, c


def hard_blocks(mpc: MPC) -> list[Block]:
    """Hard blocks as float64 host arrays; those of rates written as rows of (x, u_{−1}) and u."""
    with jax.enable_x64(True):
        found = blocks(mpc, np.float64)
    to64 = lambda v: np.asarray(v, np.float64)
    n, m, p = mpc.system.n, mpc.system.m, mpc.dimension
    hard = []
    for b in found:
        r = b.size
        H = np.zeros((r, p))
        D = np.zeros((r, m)) if b.D is None else to64(b.D)
        if b.rate:
            H[:, n:] = -D
        elif b.H is not None:
            H[:, :n] = to64(b.H)
        if b.linear is None:
            lower, upper = to64(b.lower), to64(b.upper)
            hard.append(replace(b, H=H, D=D, lower=lower, upper=upper))
    return hard


def absorbed(mpc: MPC, block: Block) -> bool:
    """True for input limits that the clip and the support function look after: those of a box."""
    return block.kind == "input" and isinstance(mpc.inputs, Box)


def problem(mpc: MPC, view: View, extent: np.ndarray, size: np.ndarray | None = None) -> Problem:
    """Collect the exact data.

    extent (2, d): lower and upper bounds of every feasible θ, which no label rests on; (d,): of
    |θ|. size (d,): how large θ typically is (None: as large as extent says), by which is chosen how
    rounding errors are bounded, not whether they are.
    """
    n, m, N, p = mpc.system.n, mpc.system.m, mpc.horizon, mpc.dimension
    A, B, c = dynamics(mpc)
    u_lower, u_upper = bounding_box(mpc.inputs, m)
    H, D, lower, upper = [np.zeros((0, p))], [np.zeros((0, m))], [], []
    H_N, lower_N, upper_N = [np.zeros((0, p))], [np.zeros(0)], [np.zeros(0)]
    for b in hard_blocks(mpc):
        if absorbed(mpc, b) or b.radius is not None:
            continue
        if any(k < N for k in b.steps):
            holds = np.isin(np.arange(N), b.steps)[:, None]
            H, D = [*H, b.H], [*D, b.D]
            lower.append(np.where(holds, b.lower, -np.inf))
            upper.append(np.where(holds, b.upper, np.inf))
        if N in b.steps:
            H_N, lower_N, upper_N = [*H_N, b.H], [*lower_N, b.lower], [*upper_N, b.upper]
    P = level = back = None
    if isinstance(mpc.terminal_set, Ellipsoid):
        P = np.zeros((p, p))
        P[:n, :n] = np.asarray(mpc.terminal_set.P, np.float64)
        P = (P + P.T) / 2
        level = np.asarray(mpc.terminal_set.level, np.float64)
        back = np.zeros((p, n))
        back[:n] = np.linalg.inv(np.linalg.cholesky(P[:n, :n])).T

    boxes = {id(set_): bounding_box(set_, n) for set_ in (mpc.states, mpc.terminal_set)}

    def limits(k: int) -> np.ndarray:
        """Bounds (2, p) of x_k, without those that the inputs have on it."""
        sets = [mpc.states] if k in mpc.state_steps else []
        bound = np.repeat([[-np.inf], [np.inf]], p, axis=1)
        for set_ in [*sets, mpc.terminal_set] if k == N else sets:
            lower, upper = boxes[id(set_)]
            bound[:, :n] = np.maximum(bound[0, :n], lower), np.minimum(bound[1, :n], upper)
        return bound

    axes, others = list(view.axes), list(view.others)
    extent = np.asarray(extent) if np.ndim(extent) == 2 else np.array([-extent, extent])
    first = limits(0)[:, axes]
    side_0, reach_0 = one_sided(np.maximum(extent[0], first[0]), np.minimum(extent[1], first[1]))
    start = np.zeros(p)
    start[axes] = reach_0 if size is None else size
    if view.projects:
        start[others] = one_sided(view.lower, view.upper)[1]
    elif others:
        start[others] = np.abs(view.fixed)[others]
    grown, u_size = np.where(np.isfinite(start), start, 0.0), largest(u_lower, u_upper)
    errors = []
    for k in range(1, N + 1):
        with np.errstate(invalid="ignore"):  # 0·inf below counts as 0
            grown = np.nansum(np.abs(A) * grown, axis=1) + np.abs(c)
            grown = grown + np.nansum(np.abs(B) * u_size, axis=1)
        side, bound = one_sided(*limits(k))
        far = (bound > grown) | np.isinf(bound)
        errors.append((1.0 * far, np.where(far, 0.0, side), np.where(far, 0.0, bound)))
        grown = np.minimum(grown, bound)
    x_size = [largest(*limits(k)[:, :n]) for k in range(N + 1)]
    implied = input_size(A[:n, :n], B[:n], c[:n], x_size)
    steps = [np.equal(mpc.moves, i) for i in range(max(mpc.moves) + 1)]
    implied = np.array([implied[same].min(axis=0) for same in steps])
    every_step = lambda parts: np.concatenate([np.zeros((N, 0)), *parts], axis=1)
    left, sides, reach = np.array(errors).transpose(1, 0, 2)
    return Problem(
        A, B, c, np.concatenate(H), np.concatenate(D), every_step(lower), every_step(upper),
        np.concatenate(H_N), np.concatenate(lower_N), np.concatenate(upper_N), P, level, back,
        u_lower, u_upper, np.maximum(u_lower, -implied), np.minimum(u_upper, implied),
        left, sides, reach, side_0, reach_0, view, mpc.moves,
    )  # fmt: skip


def bounding_box(set_: Box | Polytope | Ellipsoid | None, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Bounds (n,) of each coordinate on a set; a polytope's by LP, a part in 10⁶ outwards."""
    if set_ is None:
        return np.full(n, -np.inf), np.full(n, np.inf)
    if isinstance(set_, Box):
        return np.asarray(set_.lower, np.float64), np.asarray(set_.upper, np.float64)
    if isinstance(set_, Ellipsoid):
        inverse = np.linalg.inv(np.asarray(set_.P, np.float64))
        upper = np.sqrt(np.asarray(set_.level, np.float64) * np.diag(inverse))
        lower = -upper
    else:
        upper = np.array([set_.support(row) for row in np.eye(n)])
        lower = -np.array([set_.support(row) for row in -np.eye(n)])
    size = [np.where(np.isfinite(v), np.abs(v), 0.0) for v in (lower, upper)]
    margin = 1e-6 * (1e-6 + np.maximum(*size))
    return lower - margin, upper + margin


def input_size(A: np.ndarray, B: np.ndarray, c: np.ndarray, size: list[np.ndarray]) -> np.ndarray:
    """Bounds (N, m) of |u_k| from those of |x_k|, k = 0..N: u_k = B⁺(x_{k+1} − A x_k − c).

    ∞ where there is none, and where B has dependent columns.
    """
    M, (n, m) = np.linalg.pinv(B), B.shape
    off = np.abs(M @ B - np.eye(m)) + n * 1e-15 * np.abs(M) @ np.abs(B)
    if off.max() > 1e-8:
        return np.full((len(size) - 1, m), np.inf)
    with np.errstate(invalid="ignore"):  # 0·inf below counts as 0
        terms = [
            after + np.nansum(np.abs(A) * before, axis=1) + np.abs(c)
            for before, after in itertools.pairwise(size)
        ]
        bound = np.nansum(np.abs(M) * np.array(terms)[:, None, :], axis=2)
    # B⁺B is the unit matrix to 1e-8, and sums are rounded.
    return bound + 1e-6 * bound.max(axis=1, keepdims=True)


def one_sided(lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(s, r) with the least r for which |x| + s x ≤ r on lower ≤ x ≤ upper, s in {0, 1, −1}."""
    ways = np.array([largest(lower, upper), 2 * np.maximum(upper, 0), 2 * np.maximum(-lower, 0)])
    best = np.argmin(ways, axis=0)
    return np.array([0.0, 1.0, -1.0])[best], ways.min(axis=0)


def largest(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Bound of |x| on lower ≤ x ≤ upper."""
    return np.maximum(np.abs(lower), np.abs(upper))


def gamma(terms: int) -> float:
    """Relative rounding bound of a sum of `terms` products (Higham 2002, §3.1)."""
    return terms * UNIT_ROUNDOFF / (1 - terms * UNIT_ROUNDOFF)


def row_gamma(H: Array) -> Array:
    """Rounding bound of each product Hx: none where the row only picks ±x_i."""
    exact = (jnp.sum(H != 0, axis=1) <= 1) & jnp.all((H == 0) | (jnp.abs(H) == 1), axis=1)
    return jnp.where(exact, 0.0, gamma(H.shape[1] + 1))


def first_of_block(moves: tuple[int, ...]) -> np.ndarray:
    """For each step the first step that has the same move."""
    return np.searchsorted(np.array(moves), np.array(moves))


def prove_feasible(p: Problem, theta: Array, free: Array, inputs: Array) -> tuple[Array, Array]:
    """Roll out inputs (N, m) from the point θ: (proved, inputs clipped into their limits).

    All arithmetic in float64. Not proved means only that this input sequence is no proof.
    """
    n, m = p.B.shape
    inputs = jnp.clip(inputs, p.u_lower, p.u_upper)[first_of_block(p.moves)]
    x = p.view.initial_state(theta, free)
    A, B, c = jnp.asarray(p.A), jnp.asarray(p.B), jnp.asarray(p.c)
    rows, rows_N = jnp.concatenate([p.H, p.D], axis=1), jnp.asarray(p.H_N)
    # Twice the first-order bound covers the rounding of the bound itself.
    growth = 2 * gamma(n + m + 2)

    def holds(H, lower, upper, x, error):
        value = H @ x
        size = jnp.abs(H) @ error * (1 + 1e-9) + 2 * row_gamma(H) * (jnp.abs(H) @ jnp.abs(x))
        return jnp.all((value + size <= upper) & (value - size >= lower))

    def advance(carry, step):
        (x, error), (u, lower, upper) = carry, step
        here = jnp.concatenate([x, u]), jnp.concatenate([error, jnp.zeros_like(u)])
        inside = holds(rows, lower, upper, *here)
        bound = jnp.abs(A) @ jnp.abs(x) + jnp.abs(B) @ jnp.abs(u) + jnp.abs(c)
        error = jnp.abs(A) @ error * (1 + 1e-9) + growth * bound + TINY
        return (A @ x + B @ u + c, error), inside

    steps = (inputs, jnp.asarray(p.lower), jnp.asarray(p.upper))
    (x, error), inside = jax.lax.scan(advance, (x, jnp.zeros_like(x)), steps)
    proved = jnp.all(inside) & holds(rows_N, p.lower_N, p.upper_N, x, error)
    if p.P is not None:
        # (x + e)'P(x + e) ≤ x'Px + 2|x|'|P|ε + ε'|P|ε for |e| ≤ ε.
        size = jnp.abs(p.P)
        spread = (2 * jnp.abs(x) + error) @ (size @ error) * (1 + 1e-9)
        spread = spread + 2 * gamma(2 * n + 2) * (jnp.abs(x) @ (size @ jnp.abs(x)))
        proved = proved & (x @ (p.P @ x) + spread <= p.level)
    return proved & jnp.all(jnp.isfinite(x)) & jnp.all(jnp.isfinite(inputs)), inputs


def cut(p: Problem, y_states: Array, y_N: Array, y_ball: Array) -> tuple[Array, Array, Array]:
    """What multipliers say: a'θ ≤ b + w'|θ| for every feasible θ; a (d,), b, w (d,) ≥ 0.

    y_states (N, r) and y_N (r_N,): y > 0 on the upper bound, y < 0 on the lower. y_ball: of the
    rows L'x of the terminal ellipsoid P = LL', any length without one. w covers rounding;
    b = inf where nothing can be said. The multipliers are scaled to about one first.
    """
    n, m = p.B.shape
    N, r = p.horizon, p.H.shape[0]
    A, B, c, H, D = (jnp.asarray(v) for v in (p.A, p.B, p.c, p.H, p.D))
    parts = (y_states, y_N, y_ball) if p.P is not None else (y_states, y_N)
    top = sum(jnp.max(jnp.abs(y), initial=0.0) for y in parts)
    scale = jnp.exp2(-jnp.floor(jnp.log2(jnp.where(top > 0, top, 1.0))))
    # Twice what a sum of so many terms can be off by covers the rounding of the bound itself.
    unit = 2 * gamma(N * (r + 2 * m + 6) + 4 * n + p.H_N.shape[0] + 12)

    def support(y, lower, upper):  # Σ u y⁺ − l y⁻, and the same with |u|, |l|
        y = jnp.where(jnp.isposinf(upper), jnp.minimum(y, 0.0), y)
        y = jnp.where(jnp.isneginf(lower), jnp.maximum(y, 0.0), y)
        bound = jnp.where(y > 0, upper, jnp.where(y < 0, lower, 0.0))
        return y, jnp.sum(y * bound), jnp.sum(jnp.abs(y * bound))

    def most(value, moved, lower, upper):  # of v'u in a box, over all |v − value| ≤ unit·moved
        worth = lambda v: v * jnp.where(v > 0, upper, jnp.where(v < 0, lower, 0.0))
        found = jnp.maximum(worth(value + unit * moved), worth(value - unit * moved))
        return jnp.sum(found), jnp.sum(jnp.abs(found))

    y_N, total, size = support(y_N * scale, p.lower_N, p.upper_N)
    # Errors are counted in units: p_k is off by no more than unit·moved.
    p_N, moved = jnp.asarray(p.H_N).T @ y_N, jnp.abs(p.H_N).T @ jnp.abs(y_N)
    if p.P is not None:
        v = jnp.asarray(p.back) @ (y_ball * scale)
        # The rounding of v'Pv is added before the root, that of the root itself with the rest.
        squared = jnp.abs(v) @ (jnp.abs(p.P) @ jnp.abs(v))
        squared = jnp.maximum(v @ (p.P @ v), 0.0) + 2 * gamma(2 * n + 2) * squared
        value = jnp.sqrt(p.level * squared)
        p_N, moved = p_N + p.P @ v, moved + jnp.abs(p.P) @ jnp.abs(v)
        total, size = total + value, size + value

    def back(carry, step):
        p_next, moved, total, size = carry
        y, lower, upper, left, side, reach = step
        y, row_total, row_size = support(y, lower, upper)
        p_next, size = p_next + unit * side * moved, size + reach @ moved
        moved = left * moved + jnp.abs(p_next)
        total = total + row_total - c @ p_next
        size = size + row_size + jnp.abs(c) @ moved
        push = -(B.T @ p_next) - D.T @ y
        pushed = jnp.abs(B).T @ moved + jnp.abs(D).T @ jnp.abs(y)
        moved = jnp.abs(A).T @ moved + jnp.abs(H).T @ jnp.abs(y)
        return (A.T @ p_next + H.T @ y, moved, total, size), (push, pushed)

    errors = map(jnp.asarray, (p.left, p.side, p.reach))
    steps = (y_states * scale, jnp.asarray(p.lower), jnp.asarray(p.upper), *errors)
    start = (p_N, moved, total, size)
    (p_0, moved, total, size), inputs = jax.lax.scan(back, start, steps, reverse=True)
    same = np.equal.outer(np.arange(max(p.moves) + 1), np.array(p.moves)).astype(float)
    push, pushed = inputs if len(same) == N else (same @ v for v in inputs)
    value, value_size = most(push, pushed, p.move_lower, p.move_upper)
    total, size = total + value, size + value_size

    axes, others = np.array(p.view.axes), np.array(p.view.others, int)
    if p.view.projects:  # the other states may take any value in their box
        value, value_size = most(-p_0[others], moved[others], p.view.lower, p.view.upper)
        total, size = total + value, size + value_size
    elif len(others):
        fixed = p.view.fixed[others]
        total, size = total - p_0[others] @ fixed, size + moved[others] @ jnp.abs(fixed)
    a, b, w = p_0[axes], total + unit * size + TINY, unit * moved[axes]
    # 0'θ ≤ b says nothing, unless b < 0: then no θ at all is feasible.
    return a, jnp.where(jnp.isfinite(b) & (jnp.any(a != 0) | (b < 0)), b, jnp.inf), w


def everywhere(p: Problem, a: Array, b: Array, w: Array) -> tuple[Array, Array]:
    """The half-space a'θ ≤ b, valid for every feasible θ, that follows from those (a, b, w) of
    `cut`; b = inf where none does.
    """
    w = w + jnp.where(p.side_0 == 0, 0.0, 2 * UNIT_ROUNDOFF * jnp.abs(a))
    return a + p.side_0 * w, b + jnp.sum(jnp.where(w == 0, 0.0, w * p.reach_0))


def excludes(a: Array, b: Array, w: Array, theta: Array) -> Array:
    """True when θ breaks a'θ ≤ b + w'|θ| by more than the rounding of this test."""
    beyond = jnp.sum(a * theta, axis=-1) - jnp.sum(w * jnp.abs(theta), axis=-1) - b
    size = jnp.sum((jnp.abs(a) + w) * jnp.abs(theta), axis=-1) + jnp.abs(b)
    return beyond > 2 * gamma(2 * theta.shape[-1] + 3) * size
