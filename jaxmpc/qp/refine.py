"""Semismooth Newton: a polish to machine precision, and least-distance feasibility.

Both minimise one convex, piecewise quadratic function, the augmented Lagrangian with the
splitting variable minimised out (Rockafellar 1976; Hermans, Themelis, Patrinos 2019)

    φ(w) = ½ w'Hw + q'w + ½ ρ dist²(A w + y/ρ, [l, u]),

whose gradient with e = A w + y/ρ − clip(A w + y/ρ, l, u) is Hw + q + ρ A'e and whose
generalised Hessian is H + ρ A_a'A_a over the rows with e ≠ 0. With H = q = y = 0 and ρ = 1 the
minimum is the distance to feasibility: there e = 0 (a feasible w), or A'e = 0 with e ≠ 0, which
is a Farkas vector: e'A w is 0 for all w but at least Σ u e⁺ − l e⁻ fails by |e|².
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.linalg import cho_solve

from jaxmpc.qp.problem import matmul

# Line search: one full step, one long one (the kinks of φ are often crossed), four short ones.
STEP_LENGTHS = (1.0, 1.9, 0.5, 0.25, 0.1, 0.03)
# Largest table of row outer products that is kept: above it A_a'A_a is formed for each instance.
TABLE_ENTRIES = 4_000_000


def gram(A: Array) -> Callable[[Array], Array]:
    """The function mask (m,) → Σ mask_i a_i a_i', as one product with a shared table if it fits.

    In a batch that shares A the table turns B small products into one (B, m)·(m, n²).
    """
    m, n = A.shape
    if m * n * n > TABLE_ENTRIES:
        return lambda mask: matmul(A.T * mask, A)
    table = (A[:, :, None] * A[:, None, :]).reshape(m, n * n)
    return lambda mask: matmul(mask, table).reshape(n, n)


def newton_step(
    w: Array, y: Array, H: Array, q: Array, A: Array, l: Array, u: Array,
    rho: float, products: Callable[[Array], Array],
) -> tuple[Array, Array, Array]:  # fmt: skip
    """One damped Newton step on φ. Returns the new w, its e, and whether φ was minimised.

    φ is quadratic where the set of rows with e ≠ 0 stands still, so a full step that leaves
    this set as it was has reached the minimum.
    """
    n = w.shape[0]
    s = matmul(w, A.T) + y / rho
    e = s - jnp.clip(s, l, u)
    active = (e != 0).astype(w.dtype)
    gradient = matmul(w, H) + q + rho * matmul(e, A)
    K = H + rho * products(active)
    # Keeps K definite where active rows and curvature leave a direction free.
    ridge = 10 * jnp.finfo(w.dtype).eps * (jnp.trace(K) / n + rho)
    d = -cho_solve((jnp.linalg.cholesky(K + ridge * jnp.eye(n, dtype=w.dtype)), True), gradient)

    # φ along w + t d costs no product with A: three scalars and A d.
    Ad = matmul(d, A.T)
    slope, curvature = jnp.sum(d * (matmul(w, H) + q)), jnp.sum(d * matmul(d, H))

    def excess(t: Array | float) -> Array:
        return s + t * Ad - jnp.clip(s + t * Ad, l, u)

    def value(t: float) -> Array:
        return t * slope + 0.5 * t * t * curvature + 0.5 * rho * jnp.sum(excess(t) ** 2)

    # Where the full step keeps the set it is the minimum, whatever rounding makes of the values.
    minimised = jnp.all(jnp.sign(excess(1.0)) == jnp.sign(e))
    best = jnp.argmin(jnp.stack([value(t) for t in STEP_LENGTHS]))
    t = jnp.where(minimised, 1.0, jnp.asarray(STEP_LENGTHS, w.dtype)[best])
    return w + t * d, excess(t), minimised


def least_distance(A: Array, l: Array, u: Array, w: Array, steps: int) -> tuple[Array, Array]:
    """Minimise ½ dist²(A w, [l, u]) from w; returns w and e = A w − clip(A w, l, u).

    e = 0: w satisfies the rows. A'e = 0 with e ≠ 0: no w does, and e is the Farkas vector.
    """
    products = gram(A)
    H, q = jnp.zeros((w.shape[0], w.shape[0]), w.dtype), jnp.zeros_like(w)
    y = jnp.zeros_like(l)

    def body(carry, _):
        w, e, _ = newton_step(carry[0], y, H, q, A, l, u, 1.0, products)
        return (w, e), None

    (w, e), _ = jax.lax.scan(body, (w, y), length=steps)
    return w, e


def polish(
    H: Array, q: Array, A: Array, l: Array, u: Array, w: Array, y: Array, steps: int
) -> tuple[Array, Array, Array]:
    """Method of multipliers on (w, y) from ADMM's answer: a Newton step each time, and the
    multiplier update y = ρ e each time φ is minimised; linear convergence with factor ~1/ρ.

    Returns w, y and the last change of y, which on an infeasible program tends to a Farkas
    vector.
    """
    products = gram(A)
    rho = 1e4 if w.dtype == jnp.float64 else 1e2

    def body(carry, _):
        w, y, change = carry
        w, e, minimised = newton_step(w, y, H, q, A, l, u, rho, products)
        change = jnp.where(minimised, rho * e - y, change)
        return (w, jnp.where(minimised, rho * e, y), change), None

    (w, y, change), _ = jax.lax.scan(body, (w, y, jnp.zeros_like(y)), length=steps)
    return w, y, change
