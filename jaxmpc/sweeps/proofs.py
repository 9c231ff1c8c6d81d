"""Proofs that a state is feasible or infeasible, evaluated in float64 and safe against rounding.

Both work on the exact data of the problem (A, B, c and the sets), not on condensed matrices.

*Feasible*: inputs clipped into their limits are rolled out, x_{k+1} = A x_k + B u_k + c, with a
running bound on the rounding error, ε_{k+1} = |A| ε_k + γ(|A||x_k| + |B||u_k| + |c|). Every
row must hold with a margin no less than |H| ε_k plus the rounding of the row's own product.

*Infeasible*: for any multipliers y_k of the rows H_k x_k the costates p_N = H_N'y_N,
p_k = A'p_{k+1} + H_k'y_k satisfy Σ y_k'H_k x_k = p_0'x_0 + Σ (B'p_{k+1})'u_k + c'p_{k+1} along
every trajectory; with σ the support function of each set this bounds every feasible x_0,

    p_0'x_0 ≤ Σ_k σ(y_k) + Σ_k [σ_U(−B'p_{k+1}) − c'p_{k+1}].

No property of y is needed, so any iterate gives a valid half-space; a converged one gives a
tight one. (Neumaier & Shcherbina 2004: the input limits absorb the dual residual.) Rounding
moves p_k by at most γ(|A|'|p_{k+1}| + |H_k|'|y_k|), which meets |x_k| ≤ reach_k. Where the
limits leave x_0 unbounded, reach_0 is twice the extent that LPs find (`ladder.extent`); this is
the one figure that is taken from a solver, and it only scales the rounding bound.
"""

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.checks import fail, require_finite, require_shape
from jaxmpc.control.sets import Box, Polytope
from jaxmpc.mpc.problem import MPC

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
    n = mpc.system.n
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
    lower, upper = bounding_box(mpc.states if mpc.constrain_initial and others else None, n)
    return View(axes, others, None, lower[list(others)], upper[list(others)])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Problem:
    """The constraints of an MPC problem as float64 arrays: exact data for proofs.

    H, lower, upper: state rows (r rows) that hold at k = first_step..N−1; the same with
    suffix _N at k = N. u_lower, u_upper (m,). reach (N+1, n): |x_k| ≤ reach_k on every feasible
    trajectory.
    """

    A: Any
    B: Any
    c: Any
    H: Any
    lower: Any
    upper: Any
    H_N: Any
    lower_N: Any
    upper_N: Any
    u_lower: Any
    u_upper: Any
    reach: Any
    view: View
    horizon: int = field(metadata={"static": True})
    first_step: int = field(metadata={"static": True})


def problem(mpc: MPC, view: View, extent: np.ndarray) -> Problem:
    """Collect the exact data. extent (d,): |θ| ≤ extent for every feasible θ."""
    to64 = lambda v: np.asarray(v, np.float64)
    n, m, N = mpc.system.n, mpc.system.m, mpc.horizon
    A, B = to64(mpc.system.A), to64(mpc.system.B)
    c = np.zeros(n) if mpc.system.c is None else to64(mpc.system.c)
    rows = lambda set_: (
        tuple(to64(v) for v in set_.rows())
        if set_ is not None
        else (np.zeros((0, n)), np.zeros(0), np.zeros(0))
    )
    H, lower, upper = rows(mpc.states)
    H_N, lower_N, upper_N = rows(mpc.terminal_set)
    u_lower = np.full(m, -np.inf) if mpc.inputs is None else to64(mpc.inputs.lower)
    u_upper = np.full(m, np.inf) if mpc.inputs is None else to64(mpc.inputs.upper)

    first = 0 if mpc.constrain_initial else 1
    start = np.full(n, np.inf)
    start[list(view.axes)] = extent
    if view.projects:
        start[list(view.others)] = np.maximum(np.abs(view.lower), np.abs(view.upper))
    elif view.others:
        start[list(view.others)] = np.abs(view.fixed)[list(view.others)]
    size, size_N = (
        np.abs(bounding_box(set_, n)).max(axis=0) for set_ in (mpc.states, mpc.terminal_set)
    )
    u_size = np.maximum(np.abs(u_lower), np.abs(u_upper))
    reach = [np.minimum(start, size) if first == 0 else start]
    for k in range(1, N + 1):
        with np.errstate(invalid="ignore"):  # 0·inf below counts as 0
            moved = np.nansum(np.abs(A) * reach[-1], axis=1) + np.abs(c)
            moved = moved + np.nansum(np.abs(B) * u_size, axis=1)
        # One part in 10⁹ outweighs the rounding of this recursion.
        moved = moved * (1 + 1e-9)
        reach.append(np.minimum(moved, size if k < N else size_N))
    return Problem(
        A, B, c, H, lower, upper, H_N, lower_N, upper_N, u_lower, u_upper, np.array(reach),
        view, N, first,
    )  # fmt: skip


def bounding_box(set_: Box | Polytope | None, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Bounds (n,) of each coordinate on a set; a polytope's by LP, a part in 10⁶ outwards."""
    if set_ is None:
        return np.full(n, -np.inf), np.full(n, np.inf)
    if isinstance(set_, Box):
        return np.asarray(set_.lower, np.float64), np.asarray(set_.upper, np.float64)
    upper = np.array([set_.support(row) for row in np.eye(n)])
    lower = -np.array([set_.support(row) for row in -np.eye(n)])
    margin = 1e-6 * (1e-6 + np.maximum(np.abs(lower), np.abs(upper)))
    return lower - margin, upper + margin


def gamma(terms: int) -> float:
    """Relative rounding bound of a sum of `terms` products (Higham 2002, §3.1)."""
    return terms * UNIT_ROUNDOFF / (1 - terms * UNIT_ROUNDOFF)


def row_gamma(H: Array) -> Array:
    """Rounding bound of each product Hx: none where the row only picks ±x_i."""
    exact = (jnp.sum(H != 0, axis=1) <= 1) & jnp.all((H == 0) | (jnp.abs(H) == 1), axis=1)
    return jnp.where(exact, 0.0, gamma(H.shape[1] + 1))


def prove_feasible(p: Problem, theta: Array, free: Array, inputs: Array) -> tuple[Array, Array]:
    """Roll out inputs (N, m) from the point θ: (proved, inputs clipped into their limits).

    All arithmetic in float64. Not proved means only that this input sequence is no proof.
    """
    n, m = p.B.shape
    inputs = jnp.clip(inputs, p.u_lower, p.u_upper)
    x = p.view.initial_state(theta, free)
    A, B, c = jnp.asarray(p.A), jnp.asarray(p.B), jnp.asarray(p.c)
    # Twice the first-order bound covers the rounding of the bound itself.
    growth = 2 * gamma(n + m + 2)

    def holds(H, lower, upper, x, error):
        value = jnp.asarray(H) @ x
        size = jnp.abs(H) @ error * (1 + 1e-9) + 2 * row_gamma(H) * (jnp.abs(H) @ jnp.abs(x))
        return jnp.all((value + size <= upper) & (value - size >= lower))

    def advance(carry, u):
        x, error = carry
        inside = holds(p.H, p.lower, p.upper, x, error)
        bound = jnp.abs(A) @ jnp.abs(x) + jnp.abs(B) @ jnp.abs(u) + jnp.abs(c)
        error = jnp.abs(A) @ error * (1 + 1e-9) + growth * bound + TINY
        return (A @ x + B @ u + c, error), inside

    (x, error), inside = jax.lax.scan(advance, (x, jnp.zeros_like(x)), inputs)
    proved = jnp.all(inside[p.first_step :]) & holds(p.H_N, p.lower_N, p.upper_N, x, error)
    return proved & jnp.all(jnp.isfinite(x)) & jnp.all(jnp.isfinite(inputs)), inputs


def cut(p: Problem, y_states: Array, y_N: Array) -> tuple[Array, Array, Array]:
    """The half-space a'θ ≤ b, valid for every feasible θ, that multipliers give.

    y_states (N − first_step, r) and y_N (r_N,): y > 0 on the upper bound, y < 0 on the lower.
    Returns a (d,), b and the part of b that covers rounding; b = inf where nothing can be said.
    The multipliers are scaled to about one first; any multipliers give a valid half-space.
    """
    n, m = p.B.shape
    N, r = p.horizon, p.H.shape[0]
    A, B, c, H = (jnp.asarray(v) for v in (p.A, p.B, p.c, p.H))
    largest = jnp.max(jnp.abs(y_states), initial=0.0) + jnp.max(jnp.abs(y_N), initial=0.0)
    scale = jnp.exp2(-jnp.floor(jnp.log2(jnp.where(largest > 0, largest, 1.0))))
    y_states = jnp.concatenate([jnp.zeros((p.first_step, r)), y_states * scale])

    def support(y, lower, upper):  # Σ u y⁺ − l y⁻, and the same with |u|, |l|
        y = jnp.where(jnp.isposinf(upper), jnp.minimum(y, 0.0), y)
        y = jnp.where(jnp.isneginf(lower), jnp.maximum(y, 0.0), y)
        bound = jnp.where(y > 0, upper, jnp.where(y < 0, lower, 0.0))
        return y, jnp.sum(y * bound), jnp.sum(jnp.abs(y * bound))

    def times(weight, size):  # 0·inf = 0
        return jnp.sum(jnp.where(weight == 0, 0.0, weight * size))

    y_N, total, size = support(y_N * scale, p.lower_N, p.upper_N)
    moved = jnp.abs(p.H_N).T @ jnp.abs(y_N)
    size = size + times(moved, p.reach[N])

    def back(carry, step):
        p_next, total, size = carry
        y, reach = step
        push = -(B.T @ p_next)
        y, row_total, row_size = support(y, p.lower, p.upper)
        u = jnp.where(push > 0, p.u_upper, jnp.where(push < 0, p.u_lower, 0.0))
        u_size = jnp.maximum(jnp.abs(p.u_lower), jnp.abs(p.u_upper))
        moved = jnp.abs(A).T @ jnp.abs(p_next) + jnp.abs(H).T @ jnp.abs(y)
        total = total + row_total + jnp.sum(push * u) - c @ p_next
        size = size + row_size + times(moved, reach) + jnp.abs(c) @ jnp.abs(p_next)
        size = size + times(jnp.abs(B).T @ jnp.abs(p_next), u_size)
        return (A.T @ p_next + H.T @ y, total, size), None

    start = (jnp.asarray(p.H_N).T @ y_N, total, size)
    (p_0, total, size), _ = jax.lax.scan(
        back, start, (y_states, jnp.asarray(p.reach[:N])), reverse=True
    )
    axes, others = np.array(p.view.axes), np.array(p.view.others, int)
    a, rest = p_0[axes], p_0[others]
    if p.view.projects:  # the other states may take any value in their box
        value = jnp.where(rest < 0, p.view.upper, jnp.where(rest > 0, p.view.lower, 0.0))
    else:
        value = jnp.zeros(len(others)) if p.view.fixed is None else p.view.fixed[others]
    total = total - jnp.sum(rest * value)
    size = size + times(jnp.abs(rest), jnp.abs(value))
    terms = N * (r + m + 3) + 2 * n + p.H_N.shape[0] + 8
    rounding = 2 * gamma(terms) * size + TINY
    b = total + rounding
    # 0'θ ≤ b says nothing, unless b < 0: then no θ at all is feasible.
    return a, jnp.where(jnp.isfinite(b) & (jnp.any(a != 0) | (b < 0)), b, jnp.inf), rounding


def excludes(p: Problem, a: Array, b: Array, rounding: Array, theta: Array) -> Array:
    """True when the half-space of `cut` excludes θ by more than all rounding.

    b covers trajectories within `reach`. One from a θ outside it, λ times as far, is within
    λ·reach, because the recursion of `reach` grows no faster than its start.
    """
    slack = 2 * gamma(theta.shape[-1] + 2) * (jnp.sum(jnp.abs(a * theta), axis=-1) + jnp.abs(b))
    start = p.reach[0][np.array(p.view.axes)]
    far = jnp.max(jnp.where(start > 0, jnp.abs(theta) / jnp.where(start > 0, start, 1.0), 1.0))
    return jnp.sum(a * theta, axis=-1) - b > slack + 2 * jnp.maximum(far, 1.0) * rounding
