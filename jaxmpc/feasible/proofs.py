"""Proofs that a state is feasible or infeasible, evaluated in float64 and safe against rounding.

Both use the exact data of the problem (A, B, c and the sets), not condensed matrices. Where input
rates are limited x stands for (x, u_{k−1}). Soft rows are not constraints and are left out.

*Feasible*: inputs clipped into their limits are rolled out, x_{k+1} = A x_k + B u_k + c, with a
running bound on the rounding error, ε_{k+1} = |A| ε_k + γ(|A||x_k| + |B||u_k| + |c|). Every
row must hold with a margin no less than |H| ε_k plus the rounding of the row's own product.

*Equalities* (a terminal point, say) leave no margin, and inputs in floats hardly ever keep them
exactly. There the proof is that real inputs exist within rounding of the floats: the floats miss
the rows by r, |r| at most r̄ by the roll-out; real changes of no more than `Equalities.most`·r̄ take
r away exactly; and with inputs off by that much every other row still holds. The floats themselves
keep the equalities to r̄ only. Not proved are rows that no input moves or that depend on each
other, as where a mode that inputs cannot reach has to be zero at last.

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
Such an error multiplies x_k. It is bounded at once where limits on x_k are tight, or else passed to
the step before, e_k → |A|'e_k, together with its products with u and c. To bound it, p_k is moved
by s∘e_k, s_i ∈ {−1, 0, 1}, which adds e_k'reach_k, where |x_k| + s∘x_k ≤ reach_k: a limit on one
side of x_k suffices, since |x| + x ≤ 2 max(x, 0). The error that is left at k = 0 gives

    a'θ ≤ b + w'|θ|   for every feasible θ,

which decides about θ whether the feasible set is bounded or not, and uses no number of a solver
(except the box around a polytope, enlarged by a part in 10⁶). It becomes a half-space valid for the
whole set, (a + s∘w)'θ ≤ b + w'reach_0, if limits on x_0, or twice the extent that LPs find
(`RowPrograms.bounding_box`), bound θ_i on one side for each w_i ≠ 0. (Where a set is unbounded in
both directions along a facet there is none: the facet's normal is no vector of floats.)
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.feasible.hard_constraints import ExactData
from jaxmpc.pytrees import pytree
from jaxmpc.qp.linalg import by_step, namespace

UNIT_ROUNDOFF = 2.0**-53
# Covers products that underflow; data smaller than this count as zero.
UNDERFLOWS = 1e-290


@pytree
class Verdict:
    """What was proved of one point, and the proof.

    label: 1 feasible, −1 infeasible, 0 undecided. start (n,), plan (N, m): x_0 and the inputs
    that prove 1. cut_normal (d,), cut_offset: the half-space cut_normal'θ ≤ cut_offset that holds
    on the whole feasible set and excludes the point; ∞ where none is known; then `cut` at the point
    proves −1.
    """

    label: Array
    start: Array
    plan: Array
    cut_normal: Array
    cut_offset: Array


class Cut(NamedTuple):
    """a'θ ≤ b + w'|θ| for every feasible θ: a (d,), b, w (d,) ≥ 0, which covers rounding; in JAX,
    or in NumPy."""

    a: Any
    b: Any
    w: Any


def gamma(terms: int) -> float:
    """Return the relative rounding bound of a sum of `terms` products (Higham 2002, §3.1)."""
    return terms * UNIT_ROUNDOFF / (1 - terms * UNIT_ROUNDOFF)


def row_gamma(H: Array) -> Array:
    """Return the rounding bound of each product Hx: zero where the row only picks ±x_i."""
    exact = (jnp.sum(H != 0, axis=1) <= 1) & jnp.all((H == 0) | (jnp.abs(H) == 1), axis=1)
    return jnp.where(exact, 0.0, gamma(H.shape[1] + 1))


def first_of_block(moves: tuple[int, ...]) -> np.ndarray:
    """Return for each step the first step that has the same move."""
    return np.searchsorted(np.array(moves), np.array(moves))


def prove_feasible(p: ExactData, theta: Array, free: Array, inputs: Array) -> tuple[Array, Array]:
    """Roll out inputs (N, m) from the point θ; return (proved, inputs clipped into their limits).

    All arithmetic in float64. Not proved means only that this input sequence is no proof. Where
    equalities tie the inputs to the states, inputs within rounding of these are proved to exist.
    """
    inputs = within_limits(p, inputs)
    x = p.view.initial_state(theta, free)
    if p.equalities is None:
        slack, _, _ = roll_out(p, x, inputs, jnp.zeros_like(inputs))
        return slack >= 0, inputs
    e = p.equalities
    _, residual, _ = roll_out(p, x, inputs, jnp.zeros_like(inputs))
    inputs = within_limits(p, inputs - jnp.asarray(e.inverse) @ residual)
    _, _, off = roll_out(p, x, inputs, jnp.zeros_like(inputs))
    moved = jnp.asarray(e.most) * jnp.max(off / e.rows)
    within = (p.u_upper - inputs >= moved) & (inputs - p.u_lower >= moved)
    slack, _, _ = roll_out(p, x, inputs, moved)
    return (slack >= 0) & jnp.all(within), inputs


def within_limits(p: ExactData, inputs: Any) -> Any:
    """Return inputs (..., N, m) clipped into their limits, those of one move equal to its first;
    arrays of NumPy as such."""
    xp = namespace(inputs)
    return xp.clip(inputs, p.u_lower, p.u_upper)[..., first_of_block(p.moves), :]


def roll_out(p: ExactData, x: Array, inputs: Array, moved: Array) -> tuple[Array, Array, Array]:
    """Roll out inputs (N, m) from x (n,), each of which may be off by moved (N, m).

    Returns the least slack of all rows but the q of `Equalities`, less what rounding and `moved`
    may do to it: all hold where it is ≥ 0, and it is −∞ or NaN where the numbers overflow. Then how
    far the q are off, and a bound of that.
    """
    n, m = p.sizes
    each, at = by_step(*((jnp.asarray(v), axes) for v, axes in p.stepwise))
    rows_N = jnp.asarray(p.H_N)
    e = p.equalities
    solved = np.zeros(np.shape(p.lower), bool) if e is None else e.at
    solved_N = np.zeros(np.shape(p.lower_N), bool) if e is None else e.at_N

    def holds(H, lower, upper, solved, x, error):
        value = H @ x
        size = jnp.abs(H) @ error * (1 + 1e-9) + 2 * row_gamma(H) * (jnp.abs(H) @ jnp.abs(x))
        # Added to the value, a small size could be lost, and with it a violation.
        slack = jnp.minimum(upper - value, value - lower) - size
        return jnp.min(jnp.where(solved, jnp.inf, slack), initial=jnp.inf), value - upper, size

    def advance(carry, step):
        (x, error), (own, u, u_error, lower, upper, solved) = carry, step
        A, B, c, H, D = at(own)
        here = jnp.concatenate([x, u]), jnp.concatenate([error, u_error])
        found = holds(jnp.concatenate([H, D], axis=1), lower, upper, solved, *here)
        # Twice the first-order bound covers the rounding of the bound itself. A state that stays as
        # it is, or takes the value of another one or of an input, is not rounded: one whose terms
        # are zero but for one of an entry ±1.
        M, v = jnp.concatenate([A, B], axis=1), here[0]
        moving = (v != 0).astype(v.dtype)
        scaled = jnp.where((M == 0) | (jnp.abs(M) == 1), 0.0, 1.0) @ moving
        copied = (c == 0) & (scaled == 0) & ((M != 0).astype(v.dtype) @ moving <= 1)
        growth = jnp.where(copied, 0.0, 2 * gamma(n + m + 2))
        tiny = jnp.where(copied, 0.0, UNDERFLOWS)
        bound = jnp.abs(A) @ jnp.abs(x) + jnp.abs(B) @ jnp.abs(u) + jnp.abs(c)
        error = jnp.abs(A) @ error + jnp.abs(B) @ u_error
        error = error * (1 + 1e-9) + growth * bound + tiny
        return (A @ x + B @ u + c, error), found[0] if e is None else found

    steps = (each, inputs, moved, *map(jnp.asarray, (p.lower, p.upper, solved)))
    (x, error), found = jax.lax.scan(advance, (x, jnp.zeros_like(x)), steps)
    last, off_N, size_N = holds(rows_N, p.lower_N, p.upper_N, solved_N, x, error)
    slack = jnp.minimum(jnp.min(found if e is None else found[0]), last)
    if p.P is not None:
        # (x + e)'P(x + e) ≤ x'Px + 2|x|'|P|ε + ε'|P|ε for |e| ≤ ε.
        scale = jnp.abs(p.P)
        rounding = (2 * jnp.abs(x) + error) @ (scale @ error) * (1 + 1e-9)
        rounding = rounding + 2 * gamma(2 * n + 2) * (jnp.abs(x) @ (scale @ jnp.abs(x)))
        slack = jnp.minimum(slack, (p.level - x @ (p.P @ x)) - rounding)
    finite = jnp.all(jnp.isfinite(x)) & jnp.all(jnp.isfinite(inputs))
    slack = jnp.where(finite, slack, -jnp.inf)
    if e is None:
        return slack, jnp.zeros(0), jnp.zeros(0)
    _, off, size = found
    count = np.shape(e.rows)[0]
    where = jnp.flatnonzero(jnp.append(jnp.ravel(solved), solved_N), size=count)
    off, size = (jnp.append(jnp.ravel(v), v_N)[where] for v, v_N in ((off, off_N), (size, size_N)))
    return slack, off, jnp.abs(off) * (1 + 1e-9) + size


def cut(p: ExactData, y_states: Array, y_N: Array, y_ball: Array) -> Cut:
    """Return the half-space proof: what multipliers imply of every feasible θ.

    y_states (N, r) and y_N (r_N,): y > 0 on the upper bound, y < 0 on the lower. y_ball: of the
    rows L'x of the terminal ellipsoid P = LL', any length without one. b = inf where nothing can
    be said. The multipliers are scaled to about one first.
    """
    (n, m), (N, r) = p.sizes, p.lower.shape
    each, at = by_step(*((jnp.asarray(v), axes) for v, axes in p.stepwise))
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

    y_N, total, size = support(y_N * scale, p.widest.lower_N, p.widest.upper_N)
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
        own, y, lower, upper, left, side, reach = step
        A, B, c, H, D = at(own)
        y, row_total, row_size = support(y, lower, upper)
        p_next, size = p_next + unit * side * moved, size + reach @ moved
        moved = left * moved + jnp.abs(p_next)
        total = total + row_total - c @ p_next
        size = size + row_size + jnp.abs(c) @ moved
        slope = -(B.T @ p_next) - D.T @ y
        slope_size = jnp.abs(B).T @ moved + jnp.abs(D).T @ jnp.abs(y)
        moved = jnp.abs(A).T @ moved + jnp.abs(H).T @ jnp.abs(y)
        return (A.T @ p_next + H.T @ y, moved, total, size), (slope, slope_size)

    errors = map(jnp.asarray, (p.left, p.side, p.reach))
    sides = jnp.asarray(p.widest.lower), jnp.asarray(p.widest.upper)
    steps = (each, y_states * scale, *sides, *errors)
    start = (p_N, moved, total, size)
    (p_0, moved, total, size), inputs = jax.lax.scan(back, start, steps, reverse=True)
    same = np.equal.outer(np.arange(max(p.moves) + 1), np.array(p.moves)).astype(float)
    slope, slope_size = inputs if len(same) == N else (same @ v for v in inputs)
    value, value_size = most(slope, slope_size, p.move_lower, p.move_upper)
    total, size = total + value, size + value_size

    axes, others = np.array(p.view.axes), np.array(p.view.others, int)
    if p.view.projects:  # the other states may take any value in their box
        value, value_size = most(-p_0[others], moved[others], p.view.lower, p.view.upper)
        total, size = total + value, size + value_size
    elif len(others):
        fixed = p.view.fixed[others]
        total, size = total - p_0[others] @ fixed, size + moved[others] @ jnp.abs(fixed)
    a, b, w = p_0[axes], total + unit * size + UNDERFLOWS, unit * moved[axes]
    # 0'θ ≤ b excludes nothing, unless b < 0: then no θ at all is feasible.
    return Cut(a, jnp.where(jnp.isfinite(b) & (jnp.any(a != 0) | (b < 0)), b, jnp.inf), w)


def everywhere(p: ExactData, a: Array, b: Array, w: Array) -> tuple[Array, Array]:
    """Return the half-space a'θ ≤ b, valid for every feasible θ, that follows from the (a, b, w) of
    `cut`; b = inf where none does.
    """
    w = w + jnp.where(p.side_0 == 0, 0.0, 2 * UNIT_ROUNDOFF * jnp.abs(a))
    return a + p.side_0 * w, b + jnp.sum(jnp.where(w == 0, 0.0, w * p.reach_0))


def excludes(a: Array, b: Array, w: Array, theta: Array) -> Array:
    """Return whether θ violates a'θ ≤ b + w'|θ| by more than the rounding of this test."""
    beyond = jnp.sum(a * theta, axis=-1) - jnp.sum(w * jnp.abs(theta), axis=-1) - b
    size = jnp.sum((jnp.abs(a) + w) * jnp.abs(theta), axis=-1) + jnp.abs(b)
    return beyond > 2 * gamma(2 * theta.shape[-1] + 3) * size


def offset_at(normal: Array, offset: Array, theta: Array) -> Array:
    """Return the offset of a half-space that excludes θ (d,) by itself, ∞ of another one."""
    return jnp.where(excludes(normal, offset, jnp.zeros_like(normal), theta), offset, jnp.inf)
