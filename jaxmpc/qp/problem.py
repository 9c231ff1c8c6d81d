"""The quadratic program, its solution, and the residuals that say how good a solution is."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.checks import concrete, fail, require_finite, require_shape, require_symmetric_psd

# float32 products on NVIDIA cards drop to 10 bits (TF32) unless told otherwise.
PRECISION = jax.lax.Precision.HIGHEST


def matmul(a: Array, b: Array) -> Array:
    """Matrix product at full precision of the data's type.

    Vectors stand on the left, x'M: under `vmap` with M unbatched that is one product of the
    batch (B, n)·(n, m) without a transposition.
    """
    return jnp.matmul(a, b, precision=PRECISION)


def arrays(tree: Any) -> Any:
    """Leaves as JAX arrays of the present precision, before they enter `jit`.

    (`jit` mixes up host arrays that it has seen under the other setting of 64-bit mode.)
    """
    cast = lambda v: jnp.asarray(v, jax.dtypes.canonicalize_dtype(jnp.result_type(v)))
    return jax.tree.map(cast, tree)


def floating_dtype(tree: Any) -> Any:
    """The widest floating type among the leaves; JAX's default float where there is none."""
    types = [leaf.dtype for leaf in jax.tree.leaves(arrays(tree))]
    floats = [dtype for dtype in types if jnp.issubdtype(dtype, jnp.floating)]
    return jnp.result_type(*floats) if floats else jnp.result_type(float)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class QP:
    """Quadratic program: minimise ½ z'Pz + q'z subject to l ≤ Az ≤ u.

    P (n, n) symmetric positive semidefinite, q (n,), A (m, n), l and u (m,). Entries of l may
    be -inf and of u +inf; l = u is an equality. For a batch that shares matrices keep P and
    A unbatched: `jax.vmap(solve_qp, in_axes=(QP(P=None, q=0, A=None, l=0, u=0),))`.
    """

    P: Any
    q: Any
    A: Any
    l: Any
    u: Any

    @classmethod
    def from_qpsolvers(
        cls, P: Any, q: Any, G: Any = None, h: Any = None, A: Any = None, b: Any = None,
        lb: Any = None, ub: Any = None,
    ) -> "QP":  # fmt: skip
        """The same program from qpsolvers' form: Gz ≤ h, Az = b, lb ≤ z ≤ ub (None: absent).

        Rows come in that order: inequalities, equalities, bounds. Sparse matrices are made dense.
        """
        dense = lambda M: np.asarray(M.toarray() if hasattr(M, "toarray") else M, dtype=float)
        P, q = dense(P), np.asarray(q, dtype=float).ravel()
        n = q.size
        rows: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        if G is not None:
            upper = np.asarray(h, dtype=float).ravel()
            rows.append((dense(G).reshape(-1, n), np.full(upper.size, -np.inf), upper))
        if A is not None:
            value = np.asarray(b, dtype=float).ravel()
            rows.append((dense(A).reshape(-1, n), value, value))
        if lb is not None or ub is not None:
            lower = np.full(n, -np.inf) if lb is None else np.asarray(lb, dtype=float).ravel()
            upper = np.full(n, np.inf) if ub is None else np.asarray(ub, dtype=float).ravel()
            rows.append((np.eye(n), lower, upper))
        rows = rows or [(np.zeros((0, n)), np.zeros(0), np.zeros(0))]
        matrix, low, high = (np.concatenate(part) for part in zip(*rows, strict=True))
        return cls(P=P, q=q, A=matrix, l=low, u=high)

    def validate(self) -> None:
        """Raise ValueError for wrong shapes, NaN, asymmetric or indefinite P, or l > u."""
        if np.ndim(self.q) != 1:
            fail("q", f"shape {np.shape(self.q)} is not (n,)", "Give one vector; vmap for many")
        n = np.shape(self.q)[0]
        require_shape("P", self.P, (n, n), "P is square with a row for each entry of q")
        if np.ndim(self.A) != 2 or np.shape(self.A)[1] != n:
            fail("A", f"shape {np.shape(self.A)} is not (m, {n})", "One column for each entry of q")
        m = np.shape(self.A)[0]
        require_shape("l", self.l, (m,), "One bound for each row of A (-inf where there is none)")
        require_shape("u", self.u, (m,), "One bound for each row of A (+inf where there is none)")
        require_symmetric_psd("P", self.P)
        require_finite("q", self.q)
        require_finite("A", self.A)
        if concrete(self.l, self.u):
            l, u = np.asarray(self.l), np.asarray(self.u)
            bad = np.flatnonzero(~(l <= u))
            if bad.size:
                i = bad[0]
                fail("l, u", f"row {i} has l = {l[i]} and u = {u[i]}", "Each row needs l ≤ u")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class QPSolution:
    """A primal-dual pair and what is known about it.

    z (n,) primal. y (m,) multipliers: Pz + q + A'y = 0, y > 0 pushes against the upper bound,
    y < 0 against the lower. Residuals are in the problem's own units (see `residuals`).
    certificate (m,): for PRIMAL_INFEASIBLE the Farkas vector, else zeros. ray (n,): for
    DUAL_INFEASIBLE a direction of unbounded descent, else zeros. iterations: ADMM steps run.
    """

    z: Array
    y: Array
    status: Array
    primal_residual: Array
    dual_residual: Array
    gap: Array
    iterations: Array
    certificate: Array
    ray: Array


def bound_product(y: Array, l: Array, u: Array) -> Array:
    """Support of the box: max y'v over l ≤ v ≤ u = Σ u y⁺ − l y⁻, with 0·inf = 0."""
    upper = jnp.where(y > 0, u, 0.0)
    lower = jnp.where(y < 0, l, 0.0)
    return jnp.sum(jnp.where(y > 0, y * upper, 0.0) + jnp.where(y < 0, y * lower, 0.0))


def admissible(y: Array, l: Array, u: Array) -> Array:
    """The nearest multiplier of finite support: no push against a bound that is not there."""
    y = jnp.where(jnp.isposinf(u), jnp.minimum(y, 0.0), y)
    return jnp.where(jnp.isneginf(l), jnp.maximum(y, 0.0), y)


def residuals(qp: QP, z: Array, y: Array) -> tuple[Array, Array, Array]:
    """Primal residual, dual residual and duality gap of (z, y), infinity norms, own units.

    primal = max |Az − clip(Az, l, u)|, dual = max |Pz + q + A'y|,
    gap = |z'Pz + q'z + Σ u y⁺ − l y⁻|; a y with the wrong sign at an infinite bound gives an
    infinite gap.
    """
    primal, dual, gap = (value for value, _ in residual_terms(qp, z, y))
    norm = lambda v: jnp.max(jnp.abs(v), initial=0.0)
    return norm(primal), norm(dual), jnp.abs(gap)


def residual_terms(qp: QP, z: Array, y: Array) -> list[tuple[Array, Array]]:
    """Residual vectors of rows (m,), variables (n,) and the gap, each with the size, entry by
    entry, of the terms that it is a difference of: rounding is a share of that.
    """
    Az, Pz, Aty = matmul(z, qp.A.T), matmul(z, qp.P), matmul(y, qp.A)
    support = bound_product(y, qp.l, qp.u)
    quadratic, linear = jnp.sum(z * Pz), jnp.sum(z * qp.q)
    size_z, size_y = jnp.abs(z), jnp.abs(y)
    return [
        (Az - jnp.clip(Az, qp.l, qp.u), matmul(size_z, jnp.abs(qp.A).T)),
        (
            Pz + qp.q + Aty,
            matmul(size_z, jnp.abs(qp.P)) + jnp.abs(qp.q) + matmul(size_y, jnp.abs(qp.A)),
        ),
        (
            quadratic + linear + support,
            jnp.abs(quadratic) + jnp.sum(size_z * jnp.abs(qp.q)) + jnp.abs(support),
        ),
    ]
