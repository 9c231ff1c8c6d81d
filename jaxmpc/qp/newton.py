"""Semismooth Newton: a polish to machine precision, and least-distance feasibility.

Both minimise one convex, piecewise quadratic function, the augmented Lagrangian with the
splitting variable minimised out (Rockafellar 1976; Hermans, Themelis, Patrinos 2019)

    φ(w) = ½ w'Hw + q'w + min_p g(p) + ½ρ|A w + y/ρ − p|²

with g of `projection.py`. Its gradient, with the prox residual e of v = A w + y/ρ, is
Hw + q + ρ A'e, its generalised Hessian H + ρ A'DA with D the derivative of e. With H = q = y = 0
and ρ = 1 the minimum is the distance to feasibility: there e = 0 (a feasible w), or A'e = 0 with
e ≠ 0, which is a Farkas vector: e'A w is 0 for all w but at least g*(e) fails by |e|².
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.pytrees import pytree
from jaxmpc.qp.dual_kernel import MOST_ROWS, damped_kernel
from jaxmpc.qp.linalg import definite_solver, solve
from jaxmpc.qp.loops import in_blocks, repeat_while, true_places
from jaxmpc.qp.modes import varying
from jaxmpc.qp.precision import matmul
from jaxmpc.qp.projection import Bounds
from jaxmpc.qp.triton import on_gpu

# For derivatives: rows of the reduced system at most, where there is no kernel, steps of the method
# of multipliers, and instances whose matrices of the size of H are held at once.
REDUCED_ROWS, STEPS, DENSE_BLOCK = 48, 8, 512
# Steps of the line search, a scalar Newton method. Penalties put almost vertical pieces into the
# derivative, which only bisection finds.
LINE_STEPS, LINE_STEPS_SOFT = 6, 24


class Constants(NamedTuple):
    """What the precision decides. rho: first and last penalty of the method of multipliers.
    sigma: last proximal weight. damping: proximal weight of least distance, little but far above
    rounding. linear: penalty of the linearised optimality conditions."""

    rho: tuple[float, float]
    sigma: float
    damping: float
    linear: float

    @classmethod
    def of(cls, dtype: Any) -> "Constants":
        double = jnp.finfo(dtype).eps < 1e-10
        return cls((1e3, 1e8), 1e-8, 1e-10, 1e6) if double else cls((1e3, 1e4), 1e-4, 1e-5, 1e3)


def gram(A: Array, weights: Array, normals: list[Array]) -> Array:
    """Return A'(diag(weights) + Σ h h')A for weights (m,) and normals h (m,)."""
    K = matmul(A.T * weights, A)
    for h in normals:
        a = matmul(h, A)
        K = K + a[:, None] * a[None, :]
    return K


def ridged(K: Array, scale: Any = 0.0) -> Array:
    """Return K plus a ridge at rounding level, for the null space of K."""
    n = K.shape[0]
    ridge = 10 * jnp.finfo(K.dtype).eps * (jnp.trace(K) / n + scale)
    return K + ridge * jnp.eye(n, dtype=K.dtype)


class Newton(NamedTuple):
    """Result of one step: w (n,), its prox residual (m,), the gradient of φ (n,), and whether φ was
    minimised."""

    w: Array
    excess: Array
    gradient: Array
    minimised: Array


def newton_step(
    w: Array, y: Array, H: Array, q: Array, bounds: Bounds, rho: Array, sigma: Array, A: Array
) -> Newton:
    """One step on φ + ½σ d'(I − H)d with exact line search.

    The proximal term acts where the cost has no curvature (H = I elsewhere in ADMM's
    coordinates) and keeps the iterates of linear programs bounded. φ is quadratic where no row
    changes its piece, so a full step that leaves all pieces as they were has reached the minimum.
    """
    v = matmul(w, A.T) + y / rho
    e = bounds.prox_residual(v, rho)
    gradient = matmul(w, H) + q + rho * matmul(e, A)
    weights, normals = bounds.curvature(v, rho)
    smooth = H + sigma * (jnp.eye(w.shape[0], dtype=w.dtype) - H)
    d = -solve(ridged(smooth + rho * gram(A, weights, normals), rho), gradient)

    # φ along w + t d costs no product with A: two scalars and A d.
    Ad, Hd = matmul(d, A.T), matmul(d, smooth)
    slope, bend = jnp.sum(d * jnp.stack([matmul(w, H) + q, Hd]), axis=1)
    minimised = jnp.all(bounds.active_set(v + Ad, rho) == bounds.active_set(v, rho))

    def bracket(carry: tuple[Array, Array, Array], _: None) -> tuple[Any, None]:
        """Newton on the derivative of φ, which grows with t, between what it has bracketed."""
        t, low, high = carry
        at = v + t * Ad
        derivative = slope + t * bend + rho * jnp.sum(bounds.prox_residual(at, rho) * Ad)
        D, hs = bounds.curvature(at, rho)
        second = bend + rho * (jnp.sum(D * Ad**2) + sum(jnp.sum(h * Ad) ** 2 for h in hs))
        low, high = jnp.where(derivative < 0, t, low), jnp.where(derivative < 0, high, t)
        move = t - derivative / jnp.maximum(second, jnp.finfo(w.dtype).tiny)
        middle = jnp.where(jnp.isinf(high), 4 * t, (low + high) / 2)
        inside = (move > low) & (move < high) & (move < 10 * t)
        return (jnp.where(inside, move, middle), low, high), None

    one = jnp.ones((), w.dtype)
    count = LINE_STEPS if bounds.linear is None else LINE_STEPS_SOFT
    begin = varying((one, 0 * one, jnp.inf * one), (slope, v))
    (t, low, high), _ = jax.lax.scan(bracket, begin, length=count)
    # Without an upper bracket the lower end is used.
    t = jnp.where(minimised, 1.0, jnp.where(jnp.isinf(high), low, t))
    w_new, e_new = w + t * d, bounds.prox_residual(v + t * Ad, rho)
    if not bounds.balls:
        # The prox residual is linear where the active set does not change. Adding the change keeps
        # the rounding of a small e small; ρ will multiply it.
        e_new = jnp.where(minimised, e + weights * Ad, e_new)
    return Newton(w_new, e_new, matmul(w_new, H) + q + rho * matmul(e_new, A), minimised)


def least_distance(
    A: Array, bounds: Bounds, w: Array, steps: int, damping: float = 0.0
) -> tuple[Array, Array]:
    """Minimise ½ dist²(A w, set) from w; returns w and e = A w − its projection.

    e = 0: w satisfies the rows. A'e = 0 with e ≠ 0: no w does, and e is the Farkas vector.
    damping: weight of a proximal term; a little keeps w still where rows only touch.
    """
    bounds = bounds.hard()
    H, q = jnp.zeros((w.shape[0], w.shape[0]), w.dtype), jnp.zeros_like(w)
    y, one = jnp.zeros_like(bounds.l), jnp.ones((), w.dtype)
    sigma = damping * one

    def body(carry: tuple[Array, Array], _: None) -> tuple[Any, None]:
        step = newton_step(carry[0], y, H, q, bounds, one, sigma, A)
        return (step.w, step.excess), None

    (w, e), _ = jax.lax.scan(body, varying((w, y), (w, A, bounds)), length=steps)
    return w, e


@pytree
class MultiplierState:
    """State of the proximal method of multipliers: w (n,), y (m,); `change`: the last change of y,
    on an infeasible program nearly a Farkas vector; `move`: the last change of w, on an unbounded
    one nearly a ray; the penalties rho and sigma, the violation before and the tolerance for φ."""

    w: Array
    y: Array
    change: Array
    move: Array
    rho: Array
    sigma: Array
    before: Array
    tolerance: Array


def largest(v: Array) -> Array:
    """Return the infinity norm of v."""
    return jnp.max(jnp.abs(v), initial=0.0)


def norms(*vectors: Array) -> Array:
    """Return the infinity norms of vectors of one length, in one reduction."""
    return jnp.max(jnp.abs(jnp.stack(vectors)), axis=1, initial=0.0)


def multipliers_start(q: Array, w: Array, y: Array) -> MultiplierState:
    """Return the state of the method of multipliers at (w, y)."""
    scalar = lambda v: jnp.asarray(v, w.dtype)
    return MultiplierState(
        w, y, jnp.zeros_like(y), jnp.zeros_like(w), scalar(Constants.of(w.dtype).rho[0]),
        scalar(1.0), scalar(jnp.inf), 0.1 * (largest(q) + largest(y)),
    )  # fmt: skip


def multipliers_step(
    H: Array, q: Array, A: Array, bounds: Bounds, state: MultiplierState
) -> MultiplierState:
    """One Newton step of the proximal method of multipliers."""
    s = state
    step = newton_step(s.w, s.y, H, q, bounds, s.rho, s.sigma, A)
    return multipliers_update(q, s, step)


def multipliers_update(q: Array, state: MultiplierState, step: Newton) -> MultiplierState:
    """The state after a Newton step on φ.

    Whenever φ is minimised the multipliers become ρ e; ρ grows tenfold if the violation has not
    fallen tenfold, and σ falls a hundredfold. "Minimised" is exact (`newton_step`), or the
    gradient is below a tolerance that falls tenfold each time: where many rows only touch, the
    pieces never come to rest.
    """
    constants, s = Constants.of(state.w.dtype), state
    gradient, linear, w = norms(step.gradient, q, step.w)
    # The rounding of rows A w, which are as large as w, is multiplied by ρ.
    eps = jnp.finfo(s.w.dtype).eps
    noise = 10 * eps * (linear + w + s.rho * largest(step.excess)) + eps * s.rho * w
    done = step.minimised | (gradient <= jnp.maximum(s.tolerance, noise))
    new = jnp.where(done, s.rho * step.excess, s.y)
    violation = largest(new - s.y) / s.rho
    grow = done & (violation > 0.1 * s.before)
    rho = jnp.where(grow, jnp.minimum(10 * s.rho, constants.rho[1]), s.rho)
    # A Newton step has a ridge of 10 ε ρ, which must be little beside σ.
    least = jnp.maximum(constants.sigma, 40 * eps * rho)
    return MultiplierState(
        step.w, new, jnp.where(done, new - s.y, s.change), step.w - s.w,
        rho, jnp.maximum(jnp.where(done, s.sigma / 100, s.sigma), least),
        jnp.where(done, violation, s.before), jnp.where(done, s.tolerance / 10, s.tolerance),
    )  # fmt: skip


def linearised(
    H: Array, A: Array, weights: Array, normals: list[Array], rho: float, flat: Array
) -> Callable[[Array, Array], tuple[Array, Array]]:
    """Solver of the optimality conditions with the pieces of g held fixed.

    The conditions Hw + q + A'y = 0 and e(Aw + y/ρ) = y/ρ, moved by a (n,) and c (m,), move
    their solution by

        H dw + A'dy = −a,        dy/ρ = D (A dw + dy/ρ) + c,        D = diag(weights) + Σ h h'.

    The function returned maps (a, c) to (dw, dy); it is linear. D is singular or not: eliminating
    dy by the method of multipliers needs only the definite K = H + ρ A'DA (with a ridge), and
    eight steps leave an error (1 + ρ s²)⁻⁸ for active rows with least singular value s. Where
    active rows contradict each other, dw tends to their least-squares solution and dy stays
    bounded by 8ρ times the contradiction.

    flat: whether H is not nearly the identity. Without normals the rows R with D = 0 have dy = ρc,
    and the others, W, make the system symmetric, Λ = (1/D − 1)/ρ:

        H dw + A_W'dy_W = −a − A_R'dy_R,        A_W dw − Λ dy_W = −c_W/D.
    """
    D = lambda v: weights * v + sum(h * jnp.sum(h * v) for h in normals)
    if normals:
        inverse = definite_solver(dense_system(H, A, weights, normals, rho))
        return partial(swept, H, A, D, rho, inverse)
    n, active = A.shape[1], weights > jnp.finfo(A.dtype).eps ** 2
    slack = (1 / jnp.where(active, weights, 1.0) - 1) / rho
    only = lambda y: jnp.where(active, y, 0.0)

    def product(wy: Array) -> Array:
        w, y = wy[:n], wy[n:]
        rows = jnp.where(active, matmul(w, A.T) - slack * y, y)
        return jnp.concatenate([matmul(w, H) + matmul(only(y), A), rows])

    constants, own = jax.lax.stop_gradient(((H, A, flat), (weights, active, slack)))

    def approach(_: Any, b: Array) -> Array:
        return jnp.concatenate(approximate(rho, constants, own, (b[:n], b[n:])))

    def solver(a: Array, c: Array) -> tuple[Array, Array]:
        rest = jnp.where(active, 0.0, rho * c)
        b = [-a - matmul(rest, A), only(-c / jnp.where(active, weights, 1.0))]
        # In one vector: a part without tangents could not be transposed.
        moved = jax.lax.custom_linear_solve(product, jnp.concatenate(b), approach, symmetric=True)
        return moved[:n], moved[n:] + rest

    return solver


def dense_system(H: Array, A: Array, weights: Array, normals: list[Array], rho: float) -> Array:
    """Return K = H + ρ A'DA (n, n) of `linearised`, with a ridge."""
    return ridged(H + rho * gram(A, weights, normals), rho)


def swept(
    H: Array, A: Array, D: Callable, rho: float, inverse: Callable, a: Array, c: Array
) -> tuple[Array, Array]:
    """Return (dw, dy) of `linearised` by eight steps of the method of multipliers; inverse: K⁻¹."""

    def sweep(carry: tuple[Array, Array], _: None) -> tuple[Any, None]:
        dw, dy = carry
        rows = D(matmul(dw, A.T) + dy / rho) + c - dy / rho
        gradient = a + matmul(dw, H) + matmul(dy, A)
        step = -inverse(gradient + rho * matmul(rows, A))
        return (dw + step, dy + rho * (D(matmul(step, A.T)) + rows)), None

    return jax.lax.scan(sweep, (jnp.zeros_like(a), jnp.zeros_like(c)), length=STEPS)[0]


def approximate(
    rho: float, constants: tuple, own: tuple, b: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Return (dw, dy) of the symmetric system in `linearised` with right-hand sides b; not
    differentiable. constants: H, A, flat; own: weights, active, Λ.

    Where H is nearly the identity and few rows are active, the eight steps are taken in these rows
    (`damped`), four of them on what the first four leave of the system, in which H is what it is.
    The other instances of a batch take them with systems of the size of H.
    """
    (H, A, flat), (weights, active, slack) = constants, own
    if min(A.shape) <= REDUCED_ROWS and not on_gpu():
        return in_blocks(partial(dense_steps, rho), (H, A), (weights, b))
    most = MOST_ROWS if on_gpu() else REDUCED_ROWS
    W, S = true_places(active, most), matmul(A, A.T)
    take = lambda v: v.at[W].get(mode="fill", fill_value=0.0)

    def half(b: tuple[Array, Array]) -> tuple[Array, Array]:
        right = take(matmul(b[0], A.T) - b[1])
        y = damped(S, W, take(slack), right, 1 / rho, STEPS // 2)
        dy = jnp.zeros_like(b[1]).at[W].add(y, mode="drop")
        return b[0] - matmul(dy, A), dy

    dw, dy = half(b)
    rows = jnp.where(active, matmul(dw, A.T) - slack * dy, b[1])
    more_w, more_y = half((b[0] - matmul(dw, H) - matmul(dy, A), b[1] - rows))
    reduced = dw + more_w, jnp.where(active, dy + more_y, b[1])

    def by_blocks(constants: tuple, state: tuple) -> tuple:
        weights, b, _, is_open = state
        found = in_blocks(partial(dense_steps, rho), constants, (weights, b), large=DENSE_BLOCK)
        # What stayed the same XLA would take for constant, and factor before the loop, for nothing.
        none = jax.tree.map(jnp.zeros_like, (weights, b))
        return *none, found, ~is_open

    many = (jnp.sum(active) > most) | flat
    state = weights, b, reduced, many
    return repeat_while(lambda s: s[3], by_blocks, (H, A), state, steps="long")[2]


def dense_steps(rho: float, constants: tuple, data: tuple) -> tuple[Array, Array]:
    """Return `approximate` of one instance with any number of active rows, by systems of the size
    of H. constants: H, A; data: weights, and b, which has no entries in inactive rows."""
    (H, A), (weights, (a, c)) = constants, data
    inverse = definite_solver(dense_system(H, A, weights, [], rho))
    return swept(H, A, lambda v: weights * v, rho, inverse, -a, -weights * c)


def damped(S: Array, W: Array, slack: Array, b: Array, damping: float, steps: int) -> Array:
    """Return y (k,) after so many steps y += (M + damping·I)⁻¹(b − M y) from 0, M = S_WW +
    diag(slack) positive semidefinite: b's solution, or where M is singular and b contradicts it,
    least-squares with a bounded part in the null space. W (k,): rows of S, filled up with their
    number; slack, b (k,)."""
    if on_gpu():
        return damped_kernel(S, W, slack, b, damping, steps)
    M = S.at[W[:, None], W[None, :]].get(mode="fill", fill_value=0.0) + jnp.diag(slack)
    inverse = definite_solver(M + damping * jnp.eye(len(W), dtype=b.dtype))
    y = jnp.zeros_like(b)
    for _ in range(steps):
        y = y + inverse(b - matmul(y, M))
    return y
