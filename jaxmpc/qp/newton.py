"""Semismooth Newton: a polish to machine precision, and least-distance feasibility.

Both minimise one convex, piecewise quadratic function, the augmented Lagrangian with the
splitting variable minimised out (Rockafellar 1976; Hermans, Themelis, Patrinos 2019)

    φ(w) = ½ w'Hw + q'w + min_p g(p) + ½ρ|A w + y/ρ − p|²

with g of `projection.py`. Its gradient, with the prox residual e of v = A w + y/ρ, is
Hw + q + ρ A'e, its generalised Hessian H + ρ A'DA with D the derivative of e. With H = q = y = 0
and ρ = 1 the minimum is the distance to feasibility: there e = 0 (a feasible w), or A'e = 0 with
e ≠ 0, which is a Farkas vector: e'A w is 0 for all w but at least g*(e) fails by |e|².
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike

from jaxmpc.pytrees import pytree
from jaxmpc.qp.jax_modes import varying
from jaxmpc.qp.linalg import solve
from jaxmpc.qp.precision import matmul
from jaxmpc.qp.projection import Bounds

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
    def of(cls, dtype: DTypeLike) -> "Constants":
        """Return those of float64, or of float32."""
        double = jnp.finfo(dtype).eps < 1e-10
        return cls((1e3, 1e8), 1e-8, 1e-10, 1e6) if double else cls((1e3, 1e4), 1e-4, 1e-5, 1e3)


def gram(A: Array, weights: Array, normals: list[Array]) -> Array:
    """Return A'(diag(weights) + Σ h h')A for weights (m,) and normals h (m,)."""
    K = matmul(A.T * weights, A)
    for h in normals:
        a = matmul(h, A)
        K = K + a[:, None] * a[None, :]
    return K


def ridged(K: Array, scale: float | Array = 0.0) -> Array:
    """Return K plus a ridge at rounding level, for the null space of K."""
    n = K.shape[0]
    ridge = 10 * jnp.finfo(K.dtype).eps * (jnp.trace(K) / n + scale)
    return K + ridge * jnp.eye(n, dtype=K.dtype)


class Augmented(NamedTuple):
    """φ with a proximal term, φ + ½σ d'(I − H)d for steps d: it acts where the cost has no
    curvature (H = I elsewhere in ADMM's coordinates) and bounds the iterates of linear programs.

    y (m,), H (n, n), q (n,), bounds, rho and sigma as above.
    """

    y: Array
    H: Array
    q: Array
    bounds: Bounds
    rho: Array | float
    sigma: Array | float

    @classmethod
    def distance(cls, bounds: Bounds, w: Array, damping: float | Array) -> "Augmented":
        """Return half the squared distance of the rows from hard bounds, as a function of w (n,).
        damping: weight of the proximal term; a little keeps w where it is where rows only touch."""
        n, one = w.shape[0], jnp.ones((), w.dtype)
        H, q = jnp.zeros((n, n), w.dtype), jnp.zeros_like(w)
        return cls(jnp.zeros_like(bounds.l), H, q, bounds, one, damping * one)


class NewtonStep(NamedTuple):
    """Result of one step: w (n,), its prox residual (m,), the gradient of φ (n,), and whether φ was
    minimised."""

    w: Array
    excess: Array
    gradient: Array
    minimised: Array


def newton_step(w: Array, phi: Augmented, A: Array) -> NewtonStep:
    """Take one step on φ from w (n,) with exact line search; A (m, n).

    φ is quadratic where no row changes its piece, so a full step that leaves all pieces as they
    were has reached the minimum.
    """
    y, H, q, bounds, rho, sigma = phi
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

    Bracket = tuple[Array, Array, Array]

    def bracket(carry: Bracket, _: None) -> tuple[Bracket, None]:
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
    return NewtonStep(w_new, e_new, matmul(w_new, H) + q + rho * matmul(e_new, A), minimised)


def least_distance(
    A: Array, bounds: Bounds, w: Array, steps: int, damping: float = 0.0
) -> tuple[Array, Array]:
    """Minimise ½ dist²(A w, set) from w (n,); return w and e = A w − its projection.

    e = 0: w satisfies the rows. A'e = 0 with e ≠ 0: no w does, and e is the Farkas vector.
    damping: as in `Augmented.distance`.
    """
    bounds = bounds.hard()
    phi = Augmented.distance(bounds, w, damping)

    def body(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        step = newton_step(carry[0], phi, A)
        return (step.w, step.excess), None

    begin = varying((w, phi.y), (w, A, bounds))
    return jax.lax.scan(body, begin, length=steps)[0]


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
    none_y, none_w = jnp.zeros_like(y), jnp.zeros_like(w)
    first = (Constants.of(w.dtype).rho[0], 1.0, jnp.inf)
    rho, sigma, before = (jnp.asarray(v, w.dtype) for v in first)
    tolerance = 0.1 * (largest(q) + largest(y))
    return MultiplierState(w, y, none_y, none_w, rho, sigma, before, tolerance)


def multipliers_step(
    H: Array, q: Array, A: Array, bounds: Bounds, state: MultiplierState
) -> MultiplierState:
    """Take one Newton step of the proximal method of multipliers."""
    phi = Augmented(state.y, H, q, bounds, state.rho, state.sigma)
    return multipliers_update(q, state, newton_step(state.w, phi, A))


def multipliers_update(q: Array, state: MultiplierState, step: NewtonStep) -> MultiplierState:
    """Return the state after a Newton step on φ.

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
        w=step.w,
        y=new,
        change=jnp.where(done, new - s.y, s.change),
        move=step.w - s.w,
        rho=rho,
        sigma=jnp.maximum(jnp.where(done, s.sigma / 100, s.sigma), least),
        before=jnp.where(done, violation, s.before),
        tolerance=jnp.where(done, s.tolerance / 10, s.tolerance),
    )
