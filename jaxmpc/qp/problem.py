"""The quadratic program, the projection onto its constraints, and its solution.

What a QP asks of v = Az, intervals, hard or soft, and balls, is one convex function g(v), a sum
over rows and balls:

    hard row   0 if l ≤ v ≤ u, else ∞
    soft row   c d + ½ k d²,  d = dist(v, [l, u])        (L1 weight c, quadratic weight k)
    ball       0 if |v_b − centre| ≤ radius, else ∞       (v_b: the rows of the ball)

ADMM and the Newton method need of it only the proximal map p = argmin_p g(p) + ½ρ|p − v|²,
here through the prox residual e = v − p, which is in closed form: zero inside; the whole distance s
to the set for a hard row or a ball; for a soft row s as long as ρ s ≤ c, and beyond that s − d with
d = (ρ s − c)/(ρ + k). ρ e is a subgradient of g at p: the multiplier.
"""

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import of_known_type
from jaxmpc.checks import (
    concrete,
    fail,
    require_finite,
    require_real,
    require_shape,
    require_symmetric_psd,
)
from jaxmpc.pytrees import named_pytree, pytree, static
from jaxmpc.qp.linalg import matmul
from jaxmpc.qp.status import WithStatus

# What leaves a row free: l, u, linear and quadratic.
FREE = (-math.inf, math.inf, math.inf, 0.0)


# In a kernel `jnp.sign` and `jnp.isfinite` compute in the default type, which is another one where
# 64-bit mode is off (JAX 0.12).
def sign(v: Array) -> Array:
    """Return the sign of v, 0 where it is NaN."""
    return (v > 0).astype(v.dtype) - (v < 0).astype(v.dtype)


def finite(v: Array) -> Array:
    """Return where v is finite."""
    return jnp.abs(v) < jnp.inf


@pytree
class Bounds:
    """The function g above. l, u (m,): intervals; in the rows of a ball l = u is its centre.

    linear, quadratic (m,): weights c and k of soft rows, c = inf for a hard row; None: all are
    hard. balls: number of rows of each ball; these are the last rows. radius (len(balls),).
    """

    l: Any
    u: Any
    linear: Any = None
    quadratic: Any = None
    radius: Any = None
    balls: tuple[int, ...] = static(default=())

    @classmethod
    def of_rows(cls, columns: Iterable[Any]) -> "Bounds":
        """Return the bounds of rows from l, u and, where there are soft ones, linear and quadratic:
        without balls."""
        return cls(**dict(zip(("l", "u", "linear", "quadratic"), columns, strict=False)))

    @property
    def columns(self) -> list[Array]:
        """l, u and, where there are soft rows, linear and quadratic."""
        soft = [] if self.linear is None else [self.linear, self.quadratic]
        return [self.l, self.u, *soft]

    def blocks(self) -> list[tuple[slice, Array]]:
        """Return the rows and the radius of each ball."""
        first = self.l.shape[0] - sum(self.balls)
        ends = [first + sum(self.balls[: i + 1]) for i in range(len(self.balls))]
        sizes = zip(self.balls, ends, strict=True)
        return [(slice(end - k, end), self.radius[i]) for i, (k, end) in enumerate(sizes)]

    def outside(self, v: Array) -> Array:
        """Return by how much each row of v (m,) is outside its interval, with its sign."""
        return v - jnp.clip(v, self.l, self.u)

    def prox_residual(self, v: Array, rho: Array | float) -> Array:
        """Return e = v − prox(v) (m,) with penalty rho, a number or (m,)."""
        s = self.outside(v)
        if self.linear is not None:
            # v less how far prox(v) stays outside; that difference is lost where v is far.
            beyond = self._stays_outside(s, rho)
            whole = rho + self.quadratic
            paid = jnp.where(beyond, self.linear, 0.0) / whole
            paid = paid + self.quadratic / whole * jnp.abs(s)
            s = jnp.where(beyond, sign(s) * paid, s)
        for rows, radius in self.blocks():
            s = s.at[rows].multiply(1 - self._shrinking(s[rows], radius))
        return s

    def project(self, v: Array, rho: Array | float) -> Array:
        """Return prox(v) (m,) of g/rho."""
        plain = self.linear is None and not self.balls
        return jnp.clip(v, self.l, self.u) if plain else v - self.prox_residual(v, rho)

    def cost(self, p: Array) -> Array:
        """Return the penalty of each soft row at p; 0 for hard rows and balls (`violation`)."""
        if self.linear is None:
            return jnp.zeros_like(p)
        soft = finite(self.linear)
        d = jnp.where(soft, jnp.abs(self.outside(p)), 0.0)
        return d * (jnp.where(soft, self.linear, 0.0) + 0.5 * self.quadratic * d)

    def sizes(self) -> Array:
        """Return what a violation of each row is compared with (m,): the larger of its finite ends,
        in a ball the radius."""
        sizes = [jnp.where(finite(v), jnp.abs(v), 0.0) for v in (self.l, self.u)]
        found = jnp.maximum(*sizes)
        for rows, radius in self.blocks():
            found = found.at[rows].set(radius)
        return found

    def slope(self, v: Array) -> Array:
        """Return by how much the penalty of each row at v (m,) grows with its violation: c + k d
        of soft rows that are violated, 0 of all others."""
        return jnp.abs(self.penalty_gradient(v))

    def penalty_gradient(self, v: Array) -> Array:
        """Return the gradient of the penalties at v (m,): the multiplier of soft rows that are
        violated, 0 in all others."""
        if self.linear is None:
            return jnp.zeros_like(v)
        s = self.outside(v)
        soft = finite(self.linear)
        slope = jnp.where(soft, self.linear, 0.0) + self.quadratic * jnp.abs(s)
        return jnp.where(soft, sign(s) * slope, 0.0)

    def unmoved(self, scale: Array, v: Array) -> Array:
        """Return the multipliers at v (m,) of soft rows that no variable moves (scale 0): what
        their penalty grows by with them, and no optimality condition asks for; 0 in others."""
        return jnp.where(scale == 0, self.penalty_gradient(v), 0.0)

    def following(self, y: Array, scale: Array, v: Array) -> Array:
        """Return y (m,) with the derivatives of the multipliers of rows that nothing moves."""
        if self.linear is None:
            return y
        paid = self.unmoved(scale, v)
        return y + (paid - jax.lax.stop_gradient(paid))

    def violation(self, v: Array) -> Array:
        """Return v minus its projection where a constraint is hard; 0 in soft rows."""
        return self.hard().prox_residual(v, 1.0)

    def curvature(self, v: Array, rho: Array | float) -> tuple[Array, list[Array]]:
        """Return the derivative of the prox residual at v (an element of its generalised Jacobian):
        diag(weights) plus h h' for each h of the list, both (m,)."""
        s = self.outside(v)
        weights = (s != 0).astype(v.dtype)
        if self.linear is not None:
            beyond = self._stays_outside(s, rho)
            weights = jnp.where(beyond, self.quadratic / (rho + self.quadratic), weights)
        normals = []
        for rows, radius in self.blocks():
            # Tangential to the ball the prox residual turns, along its normal it grows.
            shrink, length = self._shrinking(s[rows], radius), self._length(s[rows])
            outside = (length > radius).astype(v.dtype)
            weights = weights.at[rows].set(outside * (1 - shrink))
            root = jnp.where(
                length > radius, jnp.sqrt(jnp.where(length > radius, shrink, 1.0)), 0.0
            )
            normal = root * s[rows] / jnp.where(length > 0, length, 1.0)
            normals.append(jnp.zeros_like(v).at[rows].set(normal))
        return weights, normals

    def active_set(self, v: Array, rho: Array | float) -> Array:
        """Return which formula of the prox residual holds in each row: 0 inside, ±1 outside, ±2
        outside and past the L1 weight; for a ball 0 inside and 1 outside."""
        s = self.outside(v)
        if self.linear is None and not self.balls:
            return sign(s)
        count = jnp.ones_like(s)
        if self.linear is not None:
            count = count + self._stays_outside(s, rho)
        piece = sign(s) * count
        for rows, radius in self.blocks():
            piece = piece.at[rows].set((self._length(s[rows]) > radius).astype(v.dtype))
        return piece

    def support(self, y: Array) -> Array:
        """The conjugate g*(y) = max over v of y'v − g(v), as terms (m,) of a sum; inf where y is
        not admissible.

        u y⁺ − l y⁻, with 0·inf = 0, plus (|y| − c)²/2k for a soft row with |y| > c; in the first
        row of a ball also radius·|y_b|.
        """
        value = y * jnp.where(y > 0, self.u, jnp.where(y < 0, self.l, 0.0))
        if self.linear is not None:
            over = jnp.maximum(jnp.abs(y) - self.linear, 0.0)
            k = jnp.where(self.quadratic > 0, self.quadratic, 1.0)
            infinite = (over > 0) & (self.quadratic == 0)
            value = value + jnp.where(infinite, jnp.inf, over**2 / (2 * k))
        for rows, radius in self.blocks():
            length = self._length(y[rows])
            most = jnp.where(length > 0, length * jnp.where(length > 0, radius, 0.0), 0.0)
            value = value.at[rows.start].add(most)
        return value

    def admissible(self, y: Array) -> Array:
        """Return the nearest y of finite conjugate: zero against a bound that is not there, and at
        most the weight of an L1 penalty."""
        y = jnp.where(jnp.isposinf(self.u), jnp.minimum(y, 0.0), y)
        y = jnp.where(jnp.isneginf(self.l), jnp.maximum(y, 0.0), y)
        if self.linear is not None:
            limit = jnp.where(self.quadratic > 0, jnp.inf, self.linear)
            y = jnp.clip(y, -limit, limit)
        return y

    def hard(self) -> "Bounds":
        """Return the hard constraints alone: soft rows become free."""
        if self.linear is None:
            return self
        soft = finite(self.linear)
        l, u = jnp.where(soft, -jnp.inf, self.l), jnp.where(soft, jnp.inf, self.u)
        return replace(self, l=l, u=u, linear=None, quadratic=None)

    def scaled(self, E: Array) -> "Bounds":
        """What is asked of E·v, E (m,) ≥ 0, when this is asked of v: distances grow by E, so
        penalties on them shrink. A row with E = 0 is free."""
        zero = E == 0

        def bound(v: Array, free: float) -> Array:
            # E·inf would give NaN gradients with respect to what E depends on.
            keep = finite(v) & ~zero
            return jnp.where(zero, free, jnp.where(keep, E * jnp.where(keep, v, 0.0), v))

        new = replace(self, l=bound(self.l, -jnp.inf), u=bound(self.u, jnp.inf))
        E = jnp.where(zero, 1.0, E)
        if self.linear is not None:
            soft = finite(self.linear)
            linear = jnp.where(soft, jnp.where(soft, self.linear, 0.0) / E, jnp.inf)
            new = replace(new, linear=linear, quadratic=self.quadratic / E**2)
        for i, (rows, radius) in enumerate(self.blocks()):
            center = jnp.where(zero[rows], 0.0, E[rows] * self.l[rows])
            radius = jnp.where(zero[rows][0], jnp.inf, E[rows][0] * radius)
            l, u = new.l.at[rows].set(center), new.u.at[rows].set(center)
            new = replace(new, l=l, u=u, radius=new.radius.at[i].set(radius))
        return new

    def divided(self, unit: Array) -> "Bounds":
        """Return what is asked of v/unit when this is asked of v, where the whole program is
        measured in `unit`: multipliers, and with them L1 weights, are divided as v is."""
        parts = {name: getattr(self, name) for name in ("l", "u", "linear", "radius")}
        return replace(self, **{name: v / unit for name, v in parts.items() if v is not None})

    def widened(self, e: Array) -> "Bounds":
        """Return the bounds that a v with the prox residual e (m,) of hard rows meets."""
        blocks = self.blocks()
        radius = self.radius
        for i, (rows, _) in enumerate(blocks):
            radius = radius.at[i].add(self._length(e[rows]))
            e = e.at[rows].set(0.0)
        l, u = self.l + jnp.minimum(e, 0.0), self.u + jnp.maximum(e, 0.0)
        return replace(self, l=l, u=u, radius=radius)

    def _stays_outside(self, s: Array, rho: Array | float) -> Array:
        """Return which rows (m,) are soft and violated by prox(v); s: signed distance of v."""
        soft = finite(self.linear)
        return soft & (jnp.abs(s) > jnp.where(soft, self.linear, 0.0) / rho)

    def _length(self, v: Array) -> Array:
        """Return |v|, with derivative 0 at v = 0."""
        squared = jnp.sum(v**2)
        return jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1.0)), 0.0)

    def _shrinking(self, s: Array, radius: Array) -> Array:
        """Return by what s is multiplied to project it onto the ball: radius/|s| outside, or 1."""
        length = self._length(s)
        outside = length > radius
        return jnp.where(outside, radius / jnp.where(outside, length, 1.0), 1.0)


@pytree
class QP:
    """Quadratic program: minimise ½ z'Pz + q'z subject to l ≤ Az ≤ u.

    Arguments:
        P: (n, n), symmetric positive semidefinite; it may be a sparse matrix of SciPy, which is
            made dense.
        q: (n,).
        A: (m, n); as P it may be sparse.
        l, u: (m,), −inf and inf where there is no bound; l = u is an equality.
        soft_linear: (m,), weights of violations, inf for a hard row; see below.
        soft_quadratic: (m,), weights of squared violations; see below.
        radius: (len(balls),), of each ball; see below.
        row_sizes: (m,) ≥ 0, what tolerances of rows are relative to, in place of their terms
            A_ij z_j; 0 or None: to these. Where l and u are differences, such as limits less what
            the present state contributes, the sizes of the limits belong here.
        balls: number of rows of each ball; see below.
        extent: (n,) ≥ 0, |z_i| ≤ extent_i for every z that keeps the rows, where that is known
            beforehand, inf where it is not. Proofs that there is no such z use it: by that the
            rounding of A'y is multiplied. None: only rows that bound one variable alone tell.

    For a batch that shares matrices keep P and A unbatched:
    `jax.vmap(solve_qp, in_axes=(QP(P=None, q=0, A=None, l=0, u=0),))`.

    Soft rows: where soft_linear (m,) is finite, row i may be violated by d ≥ 0 at the cost
    soft_linear_i d + ½ soft_quadratic_i d² (an L1 penalty is exact where it exceeds the row's
    multiplier); inf: a hard row. None: all rows are hard, or with soft_quadratic alone those
    with weight 0 are. No variables are added.

    Balls: the last sum(balls) rows form blocks of balls[i] rows each, and block i asks
    |A_b z − l_b| ≤ radius_i, with l_b = u_b its centre. An ellipsoid {x: (x − c)'M(x − c) ≤ r²}
    is a ball in the rows L'x, M = LL'.
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
    extent: Any = None

    @property
    def bounds(self) -> Bounds:
        """What the program asks of Az."""
        linear, quadratic = self.soft_linear, self.soft_quadratic
        if linear is None and quadratic is not None:
            linear = jnp.where(quadratic > 0, 0.0, jnp.inf)
        if linear is not None and quadratic is None:
            quadratic = jnp.zeros_like(linear)
        return Bounds(self.l, self.u, linear, quadratic, self.radius, self.balls)

    def about(self, z: Array) -> "QP":
        """Return the program in the change from z (n,), whose cost leaves out that of z."""
        Az = matmul(z, self.A.T)
        extent = None if self.extent is None else self.extent + jnp.abs(z)
        q = self.q + matmul(z, self.P)
        return replace(self, q=q, l=self.l - Az, u=self.u - Az, extent=extent)

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
            require_real(name, of_known_type(value))
        host = lambda v: np.asarray(of_known_type(v), dtype=float)
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
        """Return the program with sparse matrices made dense, in types that JAX has."""
        return jax.tree.map(of_known_type, self)

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
        if self.extent is not None:
            require_shape("extent", self.extent, (n,), "One size for each entry of q")
            if concrete(self.extent) and not np.all(np.asarray(self.extent) >= 0):
                fail("extent", "holds a negative size or NaN", "Sizes are ≥ 0; inf is not known")
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


@named_pytree
class Duals(NamedTuple):
    """Multipliers in qpsolvers' form, Px + q + G'z + A'y + z_box = 0.

    z: of Gx ≤ h, z ≥ 0. y: of Ax = b. z_box (n,): of lb ≤ x ≤ ub, ≥ 0 at the upper bound and ≤ 0 at
    the lower."""

    z: Array
    y: Array
    z_box: Array


@pytree
class QPSolution(WithStatus):
    """A primal-dual pair and what is known about it.

    z (n,): the primal solution. y (m,): multipliers, Pz + q + A'y = 0, y > 0 where the upper bound
    is active, y < 0 where the lower is. cost: ½ z'Pz + q'z plus the penalties of soft rows; its
    derivative is that of the optimal value.
    primal_residual: infinity norm of Az less its projection on the hard constraints, in the
    problem's own units. dual_residual: that of Pz + q + A'y. gap: z'Pz + q'z + g(Az) + g*(y).
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
