"""ADMM with a fixed number of steps: scale, factor once, iterate one matrix product a step.

The program min ½ z'Pz + q'z, l ≤ Az ≤ u is solved in coordinates w, z = T w, in which the
Hessian H = T'PT is the identity (as nearly as P is definite) and the rows of A_w = E A T have
length one. Splitting s = A_w w with penalty R = diag(rho) and over-relaxation alpha gives
(Boyd et al. 2011, §3.4.3; Stellato et al. 2020, eq. 17–20, without the proximal term)

    w  = M⁻¹ (A_w' R (s − v) − q_w),        M = H + A_w' R A_w
    s⁺ = clip(alpha A_w w + (1 − alpha) s + v, l, u)
    v⁺ = v + alpha A_w w + (1 − alpha) s − s⁺

where R v is the multiplier. Both s and v are functions of their sum t = s + v, because
s = clip(t) and v = t − clip(t), so a step needs one vector and, with r = s − v = 2 clip(t) − t,

    t⁺ = t + alpha (A_w M⁻¹ A_w' R r + b − clip(t)),        b = −A_w M⁻¹ q_w.

M, and all that is computed from it, depends on P, A and rho only: a batch that shares these
pays for one factorization and then for one matrix product a step.
"""

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.linalg import cho_solve, solve_triangular

from jaxmpc.checks import concrete, fail
from jaxmpc.qp.problem import matmul

# Least eigenvalue, relative to the mean, below which a Hessian counts as singular.
SINGULAR = 1e-6


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ADMM:
    """Settings of the solver.

    iterations: ADMM steps, always all of them. rho: penalty in the scaled coordinates above;
    a number, one value a row (m,), or a schedule (stages, m) or (stages, 1) whose stages share
    the iterations equally; 1 suits these coordinates whatever the problem's units.
    alpha: over-relaxation in (0, 2).
    refine: Newton steps after the loop (`refine.py`), accepted only where they help.
    eps: tolerance of status SOLVED on primal residual, dual residual and gap, absolute, plus
    the rounding floor 100·machine epsilon·(size of the terms); None: 1e-6 in float64, 1e-3 in
    float32.
    """

    iterations: int = field(default=100, metadata={"static": True})
    rho: Any = 1.0
    alpha: Any = 1.6
    refine: int = field(default=10, metadata={"static": True})
    eps: Any = None

    def validate(self, rows: int) -> None:
        """Raise ValueError for settings that make no iteration."""
        if self.iterations < 0 or self.refine < 0:
            fail("iterations, refine", f"{self.iterations}, {self.refine}", "Give counts ≥ 0")
        shape = np.shape(self.rho)
        if len(shape) > 2 or (shape and shape[-1] not in (1, rows)):
            fail("rho", f"shape {shape}", f"Give (), ({rows},) or (stages, {rows})")
        if concrete(self.rho) and not np.all(np.asarray(self.rho) > 0):
            fail("rho", "holds a value that is not positive", "Penalties are positive")
        if len(shape) == 2 and self.iterations % shape[0]:
            fail("iterations", f"{self.iterations} for {shape[0]} stages", "Use a multiple")
        if concrete(self.alpha) and not 0 < float(np.asarray(self.alpha)) < 2:
            fail("alpha", f"{self.alpha}", "Over-relaxation lies in (0, 2); 1.6 is usual")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Factor:
    """What P, A and rho alone decide; shared by every instance of a batch.

    T (n, n): z = T w. E (m,): row scale, 0 for a zero row. H (n, n), A (m, n): Hessian and
    rows in w. rho (S, m), and a stage each of F = M⁻¹A'R (S, n, m), iteration matrix
    G = A F (S, m, m), and Minv (S, n, n).
    """

    T: Array
    E: Array
    H: Array
    A: Array
    rho: Array
    F: Array
    G: Array
    Minv: Array


def scale(P: Array, A: Array) -> tuple[Array, Array, Array, Array]:
    """Coordinates z = T w and row scale E with T'PT ≈ I and rows of E A T of length one.

    T is the inverse transposed Cholesky factor of P + δI; T'PT stays exact.
    Returns T, E, T'PT, E A T. A zero row keeps scale 0: it constrains nothing in z.
    """
    n = P.shape[0]
    delta = null_curvature(*jax.lax.stop_gradient((P, A)))
    metric = P + delta * jnp.eye(n, dtype=P.dtype)
    L = jnp.linalg.cholesky(metric)
    T = solve_triangular(L, jnp.eye(n, dtype=P.dtype), lower=True).T
    H = matmul(T.T, matmul(P, T))
    rows = matmul(A, T)
    squared = jnp.sum(rows**2, axis=1)
    # A row is zero when it is rounding noise of its own terms, or beside the others (Euler: q₁
    # does not feel u₀).
    eps = jnp.finfo(P.dtype).eps
    own = jnp.sum(matmul(jnp.abs(A), jnp.abs(T)) ** 2, axis=1)
    noise = jnp.maximum((100 * eps) ** 2 * own, eps**2 * jnp.max(squared, initial=0.0))
    zero = squared <= noise
    E = jnp.where(zero, 0.0, 1 / jnp.sqrt(jnp.where(zero, 1.0, squared)))
    return T, E, (H + H.T) / 2, E[:, None] * rows


def null_curvature(P: Array, A: Array) -> Array:
    """The curvature δ that stands in for P where P has none.

    Where P is definite, 1e-6 of its mean. Where it is singular, the scale of its null space
    relative to its range is free, and ADMM is slow when rows feel mostly one of them: δ makes
    both parts of the median row alike, |a_null|²/δ = Σ (a'v)²/λ over P's range; the mean
    curvature if no row has both parts, 1 for P = 0.
    """
    curvature, V = jnp.linalg.eigh(P)
    mean = jnp.trace(P) / P.shape[0]
    null = curvature <= SINGULAR * mean
    singular = jnp.where(mean > 0, mean, 1.0)
    if A.shape[0]:
        parts = matmul(A, V) ** 2
        in_null = jnp.sum(jnp.where(null, parts, 0.0), axis=1)
        in_range = jnp.sum(jnp.where(null, 0.0, parts / jnp.where(null, 1.0, curvature)), axis=1)
        both = (in_null > SINGULAR**2 * jnp.sum(parts, axis=1)) & (in_range > 0)
        ratio = jnp.where(both, in_null / jnp.where(both, in_range, 1.0), jnp.nan)
        singular = jnp.where(jnp.any(both), jnp.nanmedian(ratio), singular)
    # Rounding may have left P slightly indefinite.
    return jnp.where(jnp.any(null), singular, 1e-6 * mean) + jnp.maximum(-2 * curvature[0], 0.0)


def factor(P: Array, A: Array, solver: ADMM) -> Factor:
    """Scale, choose rho and invert; depends on nothing that differs between initial states."""
    T, E, H, A_w = scale(P, A)
    n, m = A_w.shape[1], A_w.shape[0]
    rho = jnp.asarray(solver.rho, P.dtype)
    rho = jnp.broadcast_to(rho, (rho.shape[0] if rho.ndim == 2 else 1, m))
    ridge = 10 * jnp.finfo(P.dtype).eps

    def stage(R: Array) -> tuple[Array, Array]:
        M = H + matmul(A_w.T, R[:, None] * A_w)
        M = M + ridge * (1 + jnp.trace(M) / n) * jnp.eye(n, dtype=P.dtype)
        Minv = cho_solve((jnp.linalg.cholesky(M), True), jnp.eye(n, dtype=P.dtype))
        return matmul(Minv, A_w.T * R), Minv

    stages = [stage(R) for R in rho]
    F = jnp.stack([F for F, _ in stages])
    return Factor(T, E, H, A_w, rho, F, matmul(A_w, F), jnp.stack([Minv for _, Minv in stages]))


def step(t: Array, b: Array, l: Array, u: Array, G: Array, alpha: Any) -> Array:
    """One ADMM step on t = s + v (m,)."""
    s = jnp.clip(t, l, u)
    return t + jnp.asarray(alpha, t.dtype) * (matmul(2 * s - t, G.T) + b - s)


def iterate(
    factor: Factor, q: Array, l: Array, u: Array, t: Array, iterations: int, alpha: Any
) -> tuple[Array, Array]:
    """Run the fixed loop in scaled coordinates, q = T'q (n,), l, u, t (m,); the last two t."""
    stages = factor.rho.shape[0]
    previous = t
    for i in range(stages):
        G, b = factor.G[i], -matmul(matmul(q, factor.Minv[i]), factor.A.T)
        if i > 0:  # the multiplier R v is what carries over, not v
            s = jnp.clip(t, l, u)
            t = s + factor.rho[i - 1] / factor.rho[i] * (t - s)
        advance = lambda t, _=None, G=G, b=b: (step(t, b, l, u, G, alpha), None)
        if iterations:
            previous, _ = jax.lax.scan(advance, t, length=iterations // stages - 1)
            t, _ = advance(previous)
    return t, previous


def read(factor: Factor, t: Array, q: Array, l: Array, u: Array) -> tuple[Array, Array]:
    """Primal w (n,) and multiplier R v (m,), both scaled, that t stands for at the last stage."""
    s = jnp.clip(t, l, u)
    w = matmul(2 * s - t, factor.F[-1].T) - matmul(q, factor.Minv[-1])
    return w, factor.rho[-1] * (t - s)
