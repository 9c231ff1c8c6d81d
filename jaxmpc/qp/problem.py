"""The quadratic program and its solution."""

from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.checks import (
    concrete,
    fail,
    require_finite,
    require_real,
    require_shape,
    require_symmetric_psd,
)
from jaxmpc.pytrees import named_pytree, pytree, static
from jaxmpc.qp.projection import Bounds
from jaxmpc.qp.status import WithStatus


@pytree
class QP:
    """Quadratic program: minimise ½ z'Pz + q'z subject to l ≤ Az ≤ u.

    P (n, n) symmetric positive semidefinite, q (n,), A (m, n), l and u (m,). P and A may be
    SciPy's sparse matrices, which are made dense. Entries of l may
    be -inf and of u +inf; l = u is an equality. For a batch that shares matrices keep P and
    A unbatched: `jax.vmap(solve_qp, in_axes=(QP(P=None, q=0, A=None, l=0, u=0),))`.

    Soft rows: where soft_linear (m,) is finite, row i may be violated by d ≥ 0 at the cost
    soft_linear_i d + ½ soft_quadratic_i d² (an L1 penalty is exact where it exceeds the row's
    multiplier); inf: a hard row. None: all rows are hard, or with soft_quadratic alone those
    with weight 0 are. No variables are added.

    Balls: the last sum(balls) rows form blocks of balls[i] rows each, and block i asks
    |A_b z − l_b| ≤ radius_i, with l_b = u_b its centre. An ellipsoid {x: (x − c)'M(x − c) ≤ r²}
    is a ball in the rows L'x, M = LL'.

    row_sizes (m,) ≥ 0: what tolerances of rows are relative to, in place of their terms A_ij z_j; 0
    or None: to these. Where l and u are differences, such as limits less what the present state
    contributes, the sizes of the limits belong here.
    """

    P: Any
    q: Any
    A: Any
    l: Any
    u: Any
    soft_linear: Any = None
    soft_quadratic: Any = None
    radius: Any = None
    row_sizes: Any = None
    balls: tuple[int, ...] = static(default=())

    @property
    def bounds(self) -> Bounds:
        """What the program asks of Az."""
        linear, quadratic = self.soft_linear, self.soft_quadratic
        if linear is None and quadratic is not None:
            linear = jnp.where(quadratic > 0, 0.0, jnp.inf)
        if linear is not None and quadratic is None:
            quadratic = jnp.zeros_like(linear)
        return Bounds(self.l, self.u, linear, quadratic, self.radius, self.balls)

    @classmethod
    def from_qpsolvers(
        cls,
        P: Any,
        q: Any,
        G: Any = None,
        h: Any = None,
        A: Any = None,
        b: Any = None,
        lb: Any = None,
        ub: Any = None,
    ) -> "QP":
        """The same program from qpsolvers' form: Gz ≤ h, Az = b, lb ≤ z ≤ ub (None: absent).

        Rows come in that order: inequalities, equalities, bounds; `QPSolution.duals` splits their
        multipliers again.
        """
        for name, value in (("P", P), ("q", q), *(() if G is None else (("G", G), ("h", h)))):
            require_real(name, dense(value))
        host = lambda v: np.asarray(dense(v), dtype=float)
        P, q = host(P), host(q).ravel()
        n = q.size
        free, rows = np.full(n, np.inf), [(np.zeros((0, n)), np.zeros(0), np.zeros(0))]
        if G is not None:
            upper = host(h).ravel()
            rows.append((host(G).reshape(-1, n), np.full(upper.size, -np.inf), upper))
        if A is not None:
            value = host(b).ravel()
            rows.append((host(A).reshape(-1, n), value, value))
        if lb is not None or ub is not None:
            lower = -free if lb is None else host(lb).ravel()
            rows.append((np.eye(n), lower, free if ub is None else host(ub).ravel()))
        matrix, low, high = (np.concatenate(part) for part in zip(*rows, strict=True))
        return cls(P=P, q=q, A=matrix, l=low, u=high)

    def dense(self) -> "QP":
        """Return the program with sparse matrices made dense."""
        return replace(self, P=dense(self.P), A=dense(self.A))

    def validate(self) -> None:
        """Raise ValueError for wrong shapes, NaN, asymmetric or indefinite P, or l > u."""
        for name in ("P", "q", "A", "l", "u"):
            require_real(name, getattr(self, name))
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
        for name in ("soft_linear", "soft_quadratic"):
            weight = getattr(self, name)
            if weight is None:
                continue
            require_shape(name, weight, (m,), "One weight for each row of A")
            if concrete(weight) and not np.all(np.asarray(weight) >= 0):
                fail(name, "holds a negative weight or NaN", "Penalties are ≥ 0; inf is a hard row")
        if self.soft_quadratic is not None:
            require_finite("soft_quadratic", self.soft_quadratic)
        if self.row_sizes is not None:
            require_shape("row_sizes", self.row_sizes, (m,), "One size for each row of A")
            require_finite("row_sizes", self.row_sizes)
            if concrete(self.row_sizes) and np.any(np.asarray(self.row_sizes) < 0):
                fail("row_sizes", "holds a negative size", "Sizes are ≥ 0")
        self._validate_balls(m)

    def _validate_balls(self, m: int) -> None:
        sizes = self.balls
        if not isinstance(sizes, tuple):
            fail("balls", f"{sizes!r}", "Give a tuple with the number of rows of each")
        if (self.radius is None) != (not sizes):
            fail("balls, radius", f"{sizes}, {self.radius}", "Give both, or neither")
        if not sizes:
            return
        rows = sum(sizes)
        if not all(isinstance(k, int) and k > 0 for k in sizes) or rows > m:
            fail("balls", f"{sizes} with {m} rows", "Give counts ≥ 1 of the last rows of A")
        require_shape("radius", self.radius, (len(sizes),), "One radius for each ball")
        if concrete(self.radius) and not np.all(np.asarray(self.radius) >= 0):
            fail("radius", f"{self.radius}", "Radii are ≥ 0")
        if concrete(self.l, self.u):
            l, u = np.asarray(self.l)[m - rows :], np.asarray(self.u)[m - rows :]
            if not np.array_equal(l, u):
                fail("l, u", "differ in the rows of a ball", "There l = u is the centre")
        for name, hard in (("soft_linear", np.inf), ("soft_quadratic", 0.0)):
            weight = getattr(self, name)
            if weight is None or not concrete(weight):
                continue
            if np.any(np.asarray(weight)[m - rows :] != hard):
                fail(name, "softens the rows of a ball", f"Balls are hard: give {hard} there")


def dense(M: Any) -> Any:
    """Return a matrix of SciPy's sparse kinds as a dense array, any other as it is."""
    return M.toarray() if hasattr(M, "toarray") else M


@named_pytree
class Duals(NamedTuple):
    """Multipliers in qpsolvers' form, Px + q + G'z + A'y + z_box = 0: z ≥ 0 of Gx ≤ h, y of
    Ax = b, z_box (n,) of lb ≤ x ≤ ub, ≥ 0 at the upper bound and ≤ 0 at the lower."""

    z: Array
    y: Array
    z_box: Array


@pytree
class QPSolution(WithStatus):
    """A primal-dual pair and what is known about it.

    z (n,) primal. y (m,) multipliers: Pz + q + A'y = 0, y > 0 where the upper bound is active,
    y < 0 where the lower is. cost: ½ z'Pz + q'z plus the penalties of soft rows; its derivative is
    that of the optimal value. Residuals are in the problem's own units (see `residuals`).
    certificate (m,): for PRIMAL_INFEASIBLE the Farkas vector, else zeros. ray (n,): for
    DUAL_INFEASIBLE a direction of unbounded descent, else zeros. iterations: ADMM steps run.
    `solved` and `sentence` say what the status means.
    """

    z: Array
    y: Array
    cost: Array
    status: Array
    primal_residual: Array
    dual_residual: Array
    gap: Array
    iterations: Array
    certificate: Array
    ray: Array

    def duals(self, inequalities: int, equalities: int) -> Duals:
        """Return the multipliers of a program of `QP.from_qpsolvers` with so many rows G and A."""
        parts = jnp.split(self.y, [inequalities, inequalities + equalities])
        box = parts[2] if parts[2].size else jnp.zeros_like(self.z)
        return Duals(parts[0], parts[1], box)
