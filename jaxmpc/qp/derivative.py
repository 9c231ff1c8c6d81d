"""Derivatives of the solution map (P, q, A, l, u, …) → (z, y), by the implicit function theorem.

At a solution the conditions Pz + q + A'y = 0 and e(Az + y/ρ) = y/ρ hold for every ρ > 0, with the
prox residual e(v) = v − prox(v) (`problem.py`). With the formula of e in each row, the active set,
fixed they are smooth, and a change of the data moves (z, y) by one linear system, which
`linearised` solves in ADMM's coordinates. JAX transposes that for reverse mode and differentiates
it again for higher orders.

Which element of the generalised derivative is taken, and what it means where none exists:

* A hard row counts as active where it has a multiplier. One that only touches, y = 0, counts as
  inactive. An equality is always active; its multiplier's sign says which of l, u it follows (each
  by half where y = 0).
* A soft row with a multiplier below the L1 weight c, 0 < |y| < c, is at its limit, whatever the
  rounding of Az, which is large beside y/ρ where y is small (in float32 above all).
* Smoothing μ > 0 replaces the 0 or 1 of "active" by k/(ρ + k), k = Σ μ/s² over both sides, with
  the slacks s = (τ + √(τ² + 4μ))/2, τ = slack − multiplier, of the central path (Chen, Harker,
  Kanzow, Smale): the stiffness of a log barrier. (z, y) stay those of the exact solution;
  equalities, soft rows and balls are not smoothed.
* Where active rows depend on each other, the least-squares answer (see `linearised`).
* A row that is violated and has a multiplier of the same sign (the program is infeasible, or not
  yet solved) counts as a soft row with the quadratic weight k = y/violation. For an infeasible
  program the method of multipliers ends at the point that violates the rows least, with a large
  k: the derivative is that of the closest feasible program (Bambade et al. 2024, QPLayer), up to
  about 1/k. Violations are measured in rows of length |a_i'T|, T T' = P⁻¹, which are held fixed:
  derivatives in P and A leave out that what counts as closest changes with them.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.qp.admm import Factor, ScaledProgram
from jaxmpc.qp.dual import KERNEL_ROWS, inverted, sides
from jaxmpc.qp.jax_transformations import Undo, in_blocks, on_gpu, repeat_while, true_places
from jaxmpc.qp.kernel import LEAST_SIDE, Ref, call, gather, indices, load, store
from jaxmpc.qp.linalg import definite_solver, matmul, precisely
from jaxmpc.qp.newton import Constants, gram, ridged
from jaxmpc.qp.problem import QP, Bounds

# Rows of the reduced system at most, where there is no kernel, steps of the method of multipliers,
# and instances whose matrices of the size of H are in memory at once.
REDUCED_ROWS, SWEEPS, DENSE_BLOCK = 48, 8, 512


def dense_conditions(
    qp: QP, constants: tuple[Factor, Any], z: Array, y: Array
) -> tuple[Callable[[QP], tuple[Array, Array]], Undo]:
    """The `conditions_of` that `implicit` takes for a program and (factor, smoothing)."""
    factor, smoothing = constants
    T, E = factor.T, factor.E
    A = E[:, None] * matmul(qp.A, T)
    H = matmul(T.T, matmul(qp.P, T))
    rho = Constants.of(z.dtype).linear
    p = ScaledProgram.of(qp, factor)
    bounds, unit = p.bounds, p.unit
    v, y_w = p.scaled_rows(z, y)
    # μ is a product of a slack and a multiplier, each of which is measured in the unit.
    upper, lower, others = activity(bounds, v, y_w, smoothing / unit**2, rho)
    rounding = off_limit(bounds, v, y_w)

    def conditions(qp: QP) -> tuple[Array, Array]:
        bounds = qp.bounds.scaled(E).divided(unit)
        v = E * matmul(z, qp.A.T) / unit
        sides = upper * (v - bounds.u) + lower * (v - bounds.l)
        rows = jnp.where(others, bounds.prox_residual(v - rounding + y_w / rho, rho), sides)
        return matmul(matmul(z, qp.P) + qp.q + matmul(y, qp.A), T) / unit, rows

    weights, normals = bounds.curvature(v - rounding + y_w / rho, rho)
    weights = jnp.where(others, weights, upper + lower)
    inverse = linearised(H, A, weights, normals, rho, factor.flat)

    def undo(moved: tuple[Array, Array]) -> tuple[Array, Array]:
        dw, dy = inverse(*moved)
        return unit * matmul(dw, T.T), unit * E * dy

    return conditions, undo


def above_rounding(y: Array) -> Array:
    """Return which multipliers (m,) are above the level of rounding."""
    return jnp.abs(y) > jnp.finfo(y.dtype).eps ** 0.75 * (1 + jnp.max(jnp.abs(y), initial=0.0))


def off_limit(bounds: Bounds, v: Array, y: Array) -> Array:
    """Return the rounding of v (m,): its distance from the limit at which a soft row is that pays
    no penalty, 0 < |y| < c; 0 in other rows."""
    if bounds.linear is None:
        return jnp.zeros_like(v)
    precision, limit = jnp.finfo(v.dtype).eps, jnp.where(y > 0, bounds.u, bounds.l)
    unpaid = above_rounding(y) & (jnp.abs(y) < (1 - precision**0.75) * bounds.linear)
    near = jnp.abs(v - limit) <= 0.1 * jnp.sqrt(precision) * (1 + jnp.abs(v))
    here = unpaid & near & jnp.isfinite(bounds.linear)
    return jax.lax.stop_gradient(jnp.where(here, v - limit, 0.0))


class Activity(NamedTuple):
    """How far each hard row counts as active: weights in [0, 1] of its upper and its lower bound;
    and which rows are others (soft ones, balls), whose prox residual stands as it is."""

    upper: Array
    lower: Array
    others: Array


def activity(bounds: Bounds, v: Array, y: Array, smoothing: float | Array, rho: float) -> Activity:
    """Return how far rows count as active, with the choices made at the top of this file."""
    precision = jnp.finfo(v.dtype).eps
    others = jnp.arange(v.shape[0]) >= v.shape[0] - sum(bounds.balls)
    if bounds.linear is not None:
        others = others | jnp.isfinite(bounds.linear)

    has_multiplier = above_rounding(y)
    out = jax.lax.stop_gradient(bounds.violation(v))
    spring = (y * out > 0) & (jnp.abs(out) > 0.1 * jnp.sqrt(precision) * (1 + jnp.abs(v)))
    k = jax.lax.stop_gradient(jnp.where(spring, y / jnp.where(spring, out, 1.0), 0.0))
    active = jnp.where(spring, k / (rho + k), 1.0)
    upper = jnp.where(has_multiplier & (y > 0), active, 0.0)
    lower = jnp.where(has_multiplier & (y < 0), active, 0.0)
    equal = bounds.l == bounds.u
    upper, lower = (jnp.where(equal & ~has_multiplier, 0.5, side) for side in (upper, lower))

    smoothing = jnp.asarray(smoothing, v.dtype)
    mu = jnp.where(smoothing > 0, smoothing, 1.0)

    def stiffness(slack: Array, multiplier: Array) -> Array:
        finite = jnp.isfinite(slack)
        tau = jnp.where(finite, slack - multiplier, 1.0)
        s = (jnp.abs(tau) + jnp.sqrt(tau**2 + 4 * mu)) / 2
        s = jnp.where(tau > 0, s, mu / s)  # the product of both roots is μ
        return jnp.where(finite, mu / s**2, 0.0)

    above = stiffness(bounds.u - v, jnp.maximum(y, 0.0))
    below = stiffness(v - bounds.l, jnp.maximum(-y, 0.0))
    rounded = (smoothing > 0) & ~equal & ~spring
    total = rho + above + below
    upper = jnp.where(others, 0.0, jnp.where(rounded, above / total, upper))
    lower = jnp.where(others, 0.0, jnp.where(rounded, below / total, lower))
    return Activity(upper, lower, others)


def linearised(
    H: Array, A: Array, weights: Array, normals: list[Array], rho: float, flat: Array
) -> Callable[[Array, Array], tuple[Array, Array]]:
    """Solver of the optimality conditions with the pieces of g fixed.

    The conditions Hw + q + A'y = 0 and e(Aw + y/ρ) = y/ρ, moved by a (n,) and c (m,), move
    their solution by

        H dw + A'dy = −a,        dy/ρ = D (A dw + dy/ρ) + c,        D = diag(weights) + Σ h h'.

    The function returned maps (a, c) to (dw, dy); it is linear. D is singular or not: eliminating
    dy by the method of multipliers needs only the definite K = H + ρ A'DA (with a ridge), and
    eight steps leave an error (1 + ρ s²)⁻⁸ for active rows with least singular value s. Where
    active rows contradict each other, dw tends to their least-squares solution and dy stays
    bounded by 8ρ times the contradiction.

    The rows R with D = 0 have dy = ρc; the others, W, make the system symmetric, Λ = (D⁻¹ − I)/ρ:

        H dw + A_W'dy_W = −a − A_R'dy_R,        A_W dw − Λ dy_W = −D⁻¹c_W.

    Of hard and soft rows Λ is diagonal; in the rows of a ball, with D = δI + h h' and |h|² = 1 − δ,
    it is (δ⁻¹ − 1)/ρ I − g g' with g = h/√(δρ), |multiplier|/radius across the normal and 0 along
    it. flat: whether H is not nearly the identity.

    The steps are taken in float64 also where the data are float32, whose ρ leaves half of an active
    set with s = 0.01 undone.
    """
    n, active = A.shape[1], weights > jnp.finfo(A.dtype).eps ** 2
    D = jnp.where(active, weights, 1.0)
    Lambda, turns = (1 / D - 1) / rho, [h / jnp.sqrt(D * rho) for h in normals]
    only = lambda y: jnp.where(active, y, 0.0)

    def product(wy: Array) -> Array:
        w, y = wy[:n], wy[n:]
        rows = jnp.where(active, matmul(w, A.T) - times(Lambda, turns, y, -1), y)
        return jnp.concatenate([matmul(w, H) + matmul(only(y), A), rows])

    constants, own = jax.lax.stop_gradient(((H, A, flat), (active, Lambda, turns)))

    def approach(_: Callable, b: Array) -> Array:
        return jnp.concatenate(precisely(approximate, constants, own, (b[:n], b[n:])))

    def solver(a: Array, c: Array) -> tuple[Array, Array]:
        rest = jnp.where(active, 0.0, rho * c)
        b = [-a - matmul(rest, A), only(-c - rho * times(Lambda, turns, c, -1))]
        # In one vector: a part without tangents could not be transposed.
        moved = jax.lax.custom_linear_solve(product, jnp.concatenate(b), approach, symmetric=True)
        return moved[:n], moved[n:] + rest

    return solver


def times(weights: Array, normals: list[Array], y: Array, sign: int = 1) -> Array:
    """Return (diag(weights) + sign Σ h h') y."""
    return weights * y + sign * sum(h * jnp.sum(h * y) for h in normals)


def approximate(constants: tuple, own: tuple, b: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return (dw, dy) of the symmetric system in `linearised` with right-hand sides b; not
    differentiable. constants: H, A, flat; own: active, Λ as its diagonal and the g of balls.

    Where H is nearly the identity and few rows are active, the eight steps are taken in these rows
    (`damped`), four of them on what the first four leave of the system, in which H is what it is.
    The other instances of a batch take them with systems of the size of H.
    """
    (H, A, flat), (active, Lambda, turns) = constants, own
    if turns or min(A.shape) <= (0 if on_gpu() else REDUCED_ROWS):
        return in_blocks(dense_steps, (H, A), (own, b), large=DENSE_BLOCK)
    most = KERNEL_ROWS if on_gpu() else REDUCED_ROWS
    W, S = true_places(active, most), matmul(A, A.T)
    take = lambda v: v.at[W].get(mode="fill", fill_value=0.0)

    def half(b: tuple[Array, Array]) -> tuple[Array, Array]:
        right = take(matmul(b[0], A.T) - b[1])
        y = damped(S, W, take(Lambda), right, 1 / Constants.of(H.dtype).linear, SWEEPS // 2)
        dy = jnp.zeros_like(b[1]).at[W].add(y, mode="drop")
        return b[0] - matmul(dy, A), dy

    dw, dy = half(b)
    rows = jnp.where(active, matmul(dw, A.T) - Lambda * dy, b[1])
    more_w, more_y = half((b[0] - matmul(dw, H) - matmul(dy, A), b[1] - rows))
    reduced = dw + more_w, jnp.where(active, dy + more_y, b[1])

    def by_blocks(constants: tuple, state: tuple) -> tuple:
        own, b, _, is_open = state
        found = in_blocks(dense_steps, constants, (own, b), large=DENSE_BLOCK)
        # What stayed the same XLA would take for constant, and factor before the loop, for nothing.
        none = jax.tree.map(jnp.zeros_like, (own, b))
        return *none, found, ~is_open

    many = (jnp.sum(active) > most) | flat
    state = own, b, reduced, many
    return repeat_while(lambda s: s[3], by_blocks, (H, A), state, steps="long")[2]


def dense_steps(constants: tuple, data: tuple) -> tuple[Array, Array]:
    """Return `approximate` of one instance with any number of active rows, by eight steps of the
    method of multipliers, whose D is that of `linearised` at its own ρ. constants: H, A."""
    (H, A), ((active, Lambda, turns), (a, c)) = constants, data
    rho = Constants.of(H.dtype).linear
    weights = jnp.where(active, 1 / (1 + rho * Lambda), 0.0)
    normals = [jnp.sqrt(rho * weights) * g for g in turns]
    inverse = definite_solver(ridged(H + rho * gram(A, weights, normals), rho))

    def sweep(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        dw, dy = carry
        left = matmul(dw, A.T) - times(Lambda, turns, dy, -1) - c
        rows = times(weights, normals, left)
        step = inverse(a - matmul(dw, H) - matmul(dy + rho * rows, A))
        return (dw + step, dy + rho * (times(weights, normals, matmul(step, A.T)) + rows)), None

    return jax.lax.scan(sweep, (jnp.zeros_like(a), jnp.zeros_like(c)), length=SWEEPS)[0]


def damped(S: Array, W: Array, Lambda: Array, b: Array, damping: float, steps: int) -> Array:
    """Return y (k,) after so many steps y += (M + damping·I)⁻¹(b − M y) from 0, M = S_WW +
    diag(Lambda) positive semidefinite: b's solution, or where M is singular and b contradicts it,
    least-squares with a bounded part in the null space. W (k,): rows of S, filled up with their
    number; Lambda, b (k,)."""
    if on_gpu():
        return damped_kernel(S, W, Lambda, b, damping, steps)
    M = S.at[W[:, None], W[None, :]].get(mode="fill", fill_value=0.0) + jnp.diag(Lambda)
    inverse = definite_solver(M + damping * jnp.eye(len(W), dtype=b.dtype))
    y = jnp.zeros_like(b)
    for _ in range(steps):
        y = y + inverse(b - matmul(y, M))
    return y


def damped_kernel(S: Array, W: Array, Lambda: Array, b: Array, damping: float, steps: int) -> Array:
    """Return `damped` of one instance by kernels as that of `dual_search_kernel`: one program an
    instance. `vmap` for many, which share S."""
    m, rows = len(S), len(W)
    count = jnp.sum(W < m, dtype=jnp.int32)
    y, done = jnp.zeros_like(b), 0
    for side in sides(rows):
        here = jnp.where((count > done) & (count <= side), count, 0)
        solution = _damped(min(rows, side), side, damping, steps, b.dtype)
        part = solution(here[None], S, W, Lambda, b)
        y, done = jnp.where(here > 0, part, y), side
    return y


def _damped(rows: int, side: int, damping: float, steps: int, dtype: jnp.dtype) -> Callable:
    """Return the kernel (count (1,), S, W, Lambda, b) → y (k,) with systems of `rows` rows at most,
    in arrays of `side`; y is zero where the count is."""

    def damped_steps(
        count_ref: Ref, S_ref: Ref, W_ref: Ref, Lambda_ref: Ref, b_ref: Ref, y_ref: Ref
    ) -> None:
        k, count = indices(side), count_ref[0]

        def solution(none: Array) -> Array:
            inside = k < count
            W = load(W_ref.at[k], inside, 0)
            Lambda, b = load(Lambda_ref.at[k], inside), load(b_ref.at[k], inside)
            same, square = k[:, None] == k[None, :], inside[:, None] & inside[None, :]

            def M(added: float) -> Array:
                diagonal = jnp.where(inside, Lambda + added, 1.0)
                return gather(S_ref, W, W, square) + jnp.where(same, diagonal[:, None], 0.0)

            inverse = inverted(M(damping), k, count)
            found = jnp.zeros_like(b)
            for _ in range(steps):
                left = b - jnp.sum(M(0.0) * found[:, None], axis=0)
                found = found + jnp.sum(inverse * left[:, None], axis=0)
            return jnp.where(inside, found, 0.0)

        # Most instances belong to another kernel, and wait for nothing in this one.
        y = jax.lax.cond(count > 0, solution, lambda _: jnp.zeros(side, dtype), jnp.int32(0))
        store(y_ref.at[k], y, k < rows)

    warps = 1 if side <= LEAST_SIDE else 4 if side <= 32 else 8
    program = call(damped_steps, jax.ShapeDtypeStruct((rows,), dtype), warps)

    def run(count: Array, S: Array, W: Array, Lambda: Array, b: Array) -> Array:
        y = program(count, S, W[:rows], Lambda[:rows], b[:rows])
        return jnp.pad(y, (0, len(b) - rows))

    return run
