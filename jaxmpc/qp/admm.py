"""ADMM with a fixed number of steps: scale, factorise once, iterate one matrix product a step.

The program min ½ z'Pz + q'z + g(Az), g from `problem.py`, is solved in coordinates w, z = T w,
in which the Hessian H = T'PT is the identity (as nearly as P is definite) and the rows of
A_w = E A T have length one. Splitting s = A_w w with penalties ρ (m,), which multiply row by row,
and over-relaxation α gives, with the scaled dual variable v (Boyd et al. 2011, §3.1.1 and §3.4.3;
Stellato et al. 2020, eq. 17–20, without the proximal term)

    w  = M⁻¹ (A_w' ρ(s − v) − q_w),        M = H + A_w' diag(ρ) A_w
    s⁺ = prox(α A_w w + (1 − α) s + v)
    v⁺ = v + α A_w w + (1 − α) s − s⁺

The multiplier is ρv. Both s and v are functions of their sum t = s + v, because s = prox(t) and
v = t − prox(t), so a step needs one vector and, with the reflection r = s − v = 2 prox(t) − t,

    t⁺ = t + α (G r + b − prox(t)),        G = A_w M⁻¹ A_w' diag(ρ),        b = −A_w M⁻¹ q_w.

M, and all that is computed from it, depends on P, A and rho only: a batch that shares these
pays for one factorization and then for one matrix product a step. prox is the projection onto
[l, u] where all rows are hard.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from jaxmpc.checks import MOST_COUNT, concrete, fail, number, require_real, whole
from jaxmpc.pytrees import pytree, static
from jaxmpc.qp.jax_transformations import has_kernels, tree_where, varying
from jaxmpc.qp.kernel import in_one_program
from jaxmpc.qp.linalg import cholesky, infinity_norm, inverse_root, matmul, precisely, rounding
from jaxmpc.qp.problem import FREE, QP, Bounds
from jaxmpc.qp.residuals import (
    CANCELS,
    SHARE,
    Measured,
    Pair,
    Products,
    TypicalSizes,
    check_terms,
    row_sizes,
    terms_of,
)
from jaxmpc.qp.status import Status

# Eigenvalue, relative to the mean, below which a direction counts as without curvature, by the
# size of a number in bytes.
SINGULAR = {8: 1e-10, 4: 1e-6}
# Beside which eigenvalue, relative to the mean, range and null space are told apart.
SPLIT = 1e-6
# ADMM steps, and those from a warm start, from which Newton steps mostly could begin at once.
ADMM_STEPS, WARM_STEPS = 50, 10
# Rounds of equilibration; half as many decades of an entry's size are left after each.
EQUILIBRATIONS = 10
# Ridge of ADMM's system, relative, where P is singular.
FLAT_RIDGE = 1e-8
# Rounds that take the units of rows and columns out of a matrix before.
CENTRINGS = 30


@pytree
class ADMM:
    """Settings of the solver.

    iterations: ADMM steps, always all of them; None: 50, but where Newton steps follow 10 from a
    warm start and 20 in `solve_stagewise`. One instance from plain Python that has a warm start
    and that Newton steps solve without them takes none.
    rho: penalty of the scaled rows (each of length 1 in the metric of the Hessian); None:
    √(min(1, n/m)), m counting the rows that z moves; or a number, one value a row (m,), or a
    schedule (stages, m) or (stages, 1) whose stages have equally many iterations.
    alpha: over-relaxation in (0, 2).
    newton_steps: at most so many after the loop, 0 for none (`dual.py`, `newton.py`). None:
    1,000, of which badly scaled linear programs need most, 150 where every instance takes them all,
    and 72 in `solve_stagewise`. An instance leaves when its residuals are small enough, also in a
    batch. fixed: every instance takes all `newton_steps`, of the method of multipliers: constant
    time; so do unrolled derivatives. dtype: floating type of ADMM's iterates, "float32" or
    "float64"; None: float32 before Newton steps, that of the data without any. Newton steps are
    float64 whatever it is, except unrolled ones.
    eps: tolerance of status SOLVED, relative: each entry of the primal and of the dual residual,
    and the gap, is at most eps times the size of its terms, Σ_j |A_ij z_j| for row i and
    Σ_j |P_ij z_j| + |q_i| + Σ_j |A_ji y_j| for variable i, or a thousandth of eps times what is
    typical of the whole program (`residuals.TypicalSizes`). So neither the units of rows and
    variables nor that of the cost play a part. A few machine epsilons of the type in which the pair
    is computed are added: 100 in float64, 4 in float32.
    differentiate: "implicit", derivatives of the solution itself (`derivative.py`), zero with
    respect to rho, alpha and the warm start; or "unrolled", derivatives of the steps as they
    were taken. smoothing: 0, or μ > 0 to round off the kinks of the implicit derivative as an
    interior-point method stopped at slack·multiplier = μ (scaled coordinates) would.
    """

    iterations: int | None = static(default=None)
    rho: Any = None
    alpha: float | Array = 1.9
    newton_steps: int | None = static(default=None)
    eps: float | Array = 1e-6
    differentiate: str = static(default="implicit")
    smoothing: float | Array = 0.0
    fixed: bool = static(default=False)
    dtype: str | None = static(default=None)

    def __eq__(self, other: object) -> bool:
        """Return whether all settings are the same numbers; traced ones only where identical."""
        if not isinstance(other, ADMM):
            return NotImplemented
        pairs = ((v, getattr(other, name)) for name, v in vars(self).items())
        return all(a is b or (concrete(a, b) and np.array_equal(a, b)) for a, b in pairs)

    def __hash__(self) -> int:
        """Return a number that equal settings share."""
        return hash(
            (self.iterations, self.newton_steps, self.differentiate, self.fixed, self.dtype)
        )

    def validate(self, rows: int | None = None) -> None:
        """Raise ValueError for settings that make no iteration of a program with so many rows
        (None: not known yet)."""
        for name in ("iterations", "newton_steps"):
            count = getattr(self, name)
            if count is not None and whole(name, count, 0) > MOST_COUNT:
                fail(name, f"{count}", f"Give at most {MOST_COUNT}")
        if self.rho is not None:
            require_real("rho", self.rho)
        shape: tuple[int, ...] = () if self.rho is None else np.shape(self.rho)
        if len(shape) > 2 or (shape and rows is not None and shape[-1] not in (1, rows)):
            fail("rho", f"shape {shape}", f"Give (), ({rows},) or (stages, {rows})")
        if self.rho is not None and concrete(self.rho) and not np.all(np.asarray(self.rho) > 0):
            fail("rho", "holds a value that is not positive", "Penalties are positive")
        if len(shape) == 2 and self.admm_steps() % shape[0]:
            fail("iterations", f"{self.admm_steps()} for {shape[0]} stages", "Use a multiple")
        number("alpha", self.alpha, 0, "Over-relaxation lies in (0, 2); 1.6 is usual")
        if concrete(self.alpha) and not 0 < float(np.asarray(self.alpha)) < 2:
            fail("alpha", f"{self.alpha}", "Over-relaxation lies in (0, 2); 1.6 is usual")
        number("eps", self.eps, 0, "Tolerances are at least 0")
        if self.dtype not in (None, "float32", "float64"):
            fail("dtype", f"{self.dtype!r}", 'Give "float32", "float64" or None')
        if self.differentiate not in ("implicit", "unrolled"):
            fail("differentiate", f"{self.differentiate!r}", 'Give "implicit" or "unrolled"')
        number("smoothing", self.smoothing, 0, "Give 0 (none) or a positive number")

    def admm_steps(self, few: int = ADMM_STEPS) -> int:
        """Return how many ADMM steps there are. few: so many serve where Newton steps follow."""
        if self.iterations is not None:
            return self.iterations
        followed = self.most_newton_steps() > 0 and self.differentiate != "unrolled"
        return few if followed and np.ndim(self.rho) < 2 else ADMM_STEPS

    def most_newton_steps(self, default: int = 1000) -> int:
        """Return how many Newton steps there are at most: `newton_steps`, or where that is None
        `default`, and 150 at most where every instance takes them all."""
        if self.newton_steps is not None:
            return self.newton_steps
        return min(default, 150) if self.fixed or self.differentiate == "unrolled" else default


DEFAULT = ADMM()


@pytree
class Factor:
    """What P, A and rho alone decide; shared by every instance of a batch.

    T (n, n): z = T w. E (m,): row scale, 0 for a zero row. row_norms (m,): the lengths |T'a| of
    the rows a of A, 1/E, and 0 or what is known of it for a zero row. H (n, n), A (m, n): Hessian
    and rows in w. flat: whether P is singular. rho (S, m) for S stages of a schedule, and for each
    F = M⁻¹A'diag(ρ) (S, n, m) and Minv = M⁻¹ (S, n, n); G = A F (S, m, m), or None where two thin
    products cost less. S = A A' (m, m). fault: NOT_RUN where P and A are usable, else the status
    that says why not; the rest is then that of min ½|z|² without rows.
    """

    T: Array
    E: Array
    row_norms: Array
    H: Array
    A: Array
    flat: Array
    rho: Array
    F: Array
    G: Array | None
    Minv: Array
    S: Array
    fault: Array


def scale(
    P: Array, A: Array, balls: tuple[int, ...] = (), curvature: Array | None = None
) -> tuple[Array, Array, Array, Array, Array]:
    """Coordinates z = T w and row scale E with T'PT ≈ I and rows of E A T of length one.

    Variables first get units of their own (`units`); then T is the inverse transposed Cholesky
    factor of P + δI. curvature (n,): added to P's diagonal for T, for variables
    without a cost of which more is known than P and A say; None: of none.
    Returns T, E, H = T'PT (see `hessian`), E A T and whether P is singular. A zero row keeps scale
    0: it constrains nothing in z. The rows of a ball share one scale, so that it stays one.
    """
    n, dtype = P.shape[0], P.dtype
    metric = P if curvature is None else P + jnp.diag(curvature)
    unit = jax.lax.stop_gradient(units(jnp.diag(metric), A))
    P_1, A_1 = unit[:, None] * metric * unit, A * unit
    delta, flat = null_curvature(*jax.lax.stop_gradient((P_1, A_1)))
    flat = flat if curvature is None else flat | jnp.any(curvature > 0)
    T = unit[:, None] * inverse_root(P_1 + delta * jnp.eye(n, dtype=dtype)).T
    H = hessian(P, T, dtype)
    rows = matmul(A, T)
    squared = jnp.sum(rows**2, axis=1)
    # A row is zero when it is rounding noise of its own terms. Other rows have other units.
    own = jnp.sum(matmul(jnp.abs(A), jnp.abs(T)) ** 2, axis=1)
    noise = (100 * jnp.finfo(dtype).eps) ** 2 * own
    last = A.shape[0]
    for count in reversed(balls):
        block, last = slice(last - count, last), last - count
        squared = squared.at[block].set(jnp.mean(squared[block]))
        noise = noise.at[block].set(jnp.mean(noise[block]))
    zero = squared <= noise
    E = jnp.where(zero, 0.0, 1 / jnp.sqrt(jnp.where(zero, 1.0, squared)))
    return T, E, (H + H.T) / 2, E[:, None] * rows, flat


def hessian(P: Array, T: Array, dtype: DTypeLike) -> Array:
    """Return H = T'PT (n, n) for P (n, n) that has been rounded to a type, with a share ν of the
    identity in it that makes up for this: (1 − ν)T'PT + νI.

    Rounded, a singular P has curvature of either sign in its null space, where T magnifies it.
    Errors of ε|P_ij| in the entries of P, of independent signs, make one in H whose norm is at
    most ν = ε(Σ_ij |T_i|²P_ij²|T_j|²)^½ in the root mean square, T_i the rows of T. In directions
    in which T'PT is the identity nothing changes.
    """
    H = matmul(T.T, matmul(P, T))
    length = jnp.linalg.norm(jax.lax.stop_gradient(T), axis=1)
    noise = jnp.linalg.norm(jax.lax.stop_gradient(P) * length * length[:, None])
    share = jnp.minimum(float(jnp.finfo(dtype).eps) * noise, 1.0)
    return H + share * (jnp.eye(len(H), dtype=H.dtype) - H)


def units(curvature: Array, A: Array) -> Array:
    """Return the units (n,) of the variables: 1/√curvature, P's diagonal (n,), and where that is
    zero those in which the columns of A have entries alike.

    These come from Ruiz's equilibration (2001, RAL-TR-2001-034): rows and columns of A are divided
    by the roots of their largest entries, again and again. Where that ends depends on where it
    begins: with rows and columns in which the logarithms of all entries have the mean 0 (Curtis and
    Reid 1972, J. Inst. Maths Applics 10), so that the units of A play no part.
    """
    A, curved = jnp.abs(A), curvature > 0
    root = lambda v: jnp.sqrt(jnp.where(v > 0, v, 1.0))

    def advance(_: Array, scales: tuple[Array, Array]) -> tuple[Array, Array]:
        d, e = scales
        M = e[:, None] * A * d
        rows, columns = (jnp.max(M, axis=axis, initial=0.0) for axis in (1, 0))
        return jnp.where(curved, d, d / root(columns)), e / root(rows)

    there = A > 0
    logarithms = jnp.log(jnp.where(there, A, 1.0))

    def centre(scales: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        d, e = scales
        mean = lambda M, axis: (
            jnp.sum(jnp.where(there, M, 0.0), axis) / jnp.maximum(jnp.sum(there, axis), 1)
        )
        e = -mean(logarithms + d, 1)
        return (jnp.where(curved, d, -mean(logarithms + e[:, None], 0)), e), None

    begin = -0.5 * jnp.log(jnp.where(curved, curvature, 1.0)), jnp.zeros(A.shape[0], A.dtype)
    begin = varying(begin, (curvature, A))
    begin = jax.tree.map(jnp.exp, jax.lax.scan(centre, begin, length=CENTRINGS)[0])
    return jax.lax.fori_loop(0, EQUILIBRATIONS, advance, begin)[0]


def null_curvature(P: Array, A: Array) -> tuple[Array, Array]:
    """The curvature δ that stands in for P where P has none, and whether there is such a part.

    Where P is definite, δ is rounding. Where it is singular, the scale of its
    null space relative to its range is free, and ADMM is slow when rows lie mostly in one of them:
    δ makes both parts of the median row alike, |a_null|²/δ = Σ (a'v)²/λ over P's range; 1 if
    no row has both parts. With x = (P + εI)⁻¹a the null part is εx, and the part in the range is
    r = Px, of which what is rounding of its terms counts as none; Σ (a'v)²/λ = r'(P + εI)⁻¹r.
    """
    n, identity = P.shape[0], jnp.eye(P.shape[0], dtype=P.dtype)
    mean = jnp.trace(P) / n
    least = 4 * n * float(jnp.finfo(P.dtype).eps)
    fraction = lambda least_fraction: jnp.where(mean > 0, max(least_fraction, least) * mean, 1.0)
    # Σ ε/(λ + ε) counts the directions without curvature.
    epsilon = fraction(SINGULAR[P.dtype.itemsize])
    singular = epsilon * jnp.sum(inverse_root(P + epsilon * identity) ** 2) > 0.5
    # With so small an ε the parts below would be lost in rounding.
    epsilon = fraction(SPLIT)
    root = inverse_root(P + epsilon * identity)
    delta = jnp.ones((), P.dtype)
    if A.shape[0]:
        x = matmul(matmul(A, root.T), root)
        r, noise = matmul(x, P), rounding(P.dtype) * matmul(jnp.abs(x), jnp.abs(P))
        r = jnp.where(jnp.abs(r) > noise, r, 0.0)
        in_null = epsilon**2 * jnp.sum(x**2, axis=1)
        in_range = jnp.sum(matmul(r, root.T) ** 2, axis=1)
        both = (in_null > 1e-8 * jnp.sum(A**2, axis=1)) & (in_range > 0)
        ratio = jnp.where(both, in_null / jnp.where(both, in_range, 1.0), jnp.nan)
        delta = jnp.where(jnp.any(both), jnp.nanmedian(ratio), delta)
    # With less the sum would not be definite to rounding.
    return jnp.maximum(jnp.where(singular, delta, 0.0), least * mean), singular


def factorise(
    P: Array,
    A: Array,
    solver: ADMM,
    balls: tuple[int, ...] = (),
    curvature: Array | None = None,
) -> Factor:
    """Return the `Factor` of P (n, n) and A (m, n) at the penalties of `solver`; curvature (n,) as
    in `scale`."""
    fault = matrix_fault(P, A)
    P, A = harmless_matrices(P, A, fault == Status.NOT_RUN)
    T, E, H, A_w, flat = scale(P, A, balls, curvature)
    n, m = A_w.shape[1], A_w.shape[0]
    rho = default_rho(E, n) if solver.rho is None else jnp.asarray(solver.rho, P.dtype)
    rho = jnp.broadcast_to(rho, (rho.shape[0] if rho.ndim == 2 else 1, m))
    # Where P is singular there may be directions that no row stops either. There M is the ridge, by
    # which the rounding of float32 iterates is divided.
    least = 40 * n * float(jnp.finfo(P.dtype).eps)
    ridge = jnp.where(flat, max(FLAT_RIDGE, least), least).astype(P.dtype)

    def inverse(rho: Array) -> Array:
        M = H + matmul(A_w.T, rho[:, None] * A_w)
        M = M + ridge * (1 + jnp.trace(M) / n) * jnp.eye(n, dtype=P.dtype)
        W = inverse_root(M)
        return matmul(W.T, W)

    Minv = jnp.stack([inverse(each) for each in rho])
    F = jnp.stack([matmul(M, A_w.T * each) for M, each in zip(Minv, rho, strict=True)])
    G = None if 2 * n < m else matmul(A_w, F)
    row_norms = jnp.where(E > 0, 1 / jnp.where(E > 0, E, 1.0), 0.0)
    made = Factor(T, E, row_norms, H, A_w, flat, rho, F, G, Minv, matmul(A_w, A_w.T), fault)
    # Finite data can still overflow, or be too near singular for their precision.
    parts = jax.tree.leaves((T, E, H, A_w, F, G, Minv))
    sound = jnp.all(jnp.stack([jnp.all(jnp.isfinite(v)) for v in parts]))
    none = jax.tree.map(jnp.zeros_like, made)
    one, failed = jnp.eye(n, dtype=P.dtype), jnp.int32(Status.ITERATION_LIMIT)
    ones = jnp.broadcast_to(one, Minv.shape)
    harmless = replace(none, T=one, H=one, Minv=ones, rho=rho, fault=failed)
    return tree_where(sound, made, harmless)


def default_rho(E: Array, n: int) -> Array:
    """Return √(n / rows), at most 1, for n variables and the rows of scale E (m,) that move.

    That is 1/√(mean eigenvalue of A_w A_w') over its range. For rows that are all active
    1/√(largest · least) is best (Ghadimi et al. 2015, IEEE TAC 60, theorem 4); which rows are
    active is not known, and they are few.
    """
    return jnp.sqrt(n / jnp.maximum(jnp.sum(E > 0), n)).astype(E.dtype)


def matrix_fault(P: Array, A: Array) -> Array:
    """Return the status of an unusable P or A: NON_FINITE, NON_CONVEX, or NOT_RUN for none."""
    finite = jnp.all(jnp.isfinite(P)) & jnp.all(jnp.isfinite(A))
    definite = convex(jnp.where(finite, P, 0.0))
    fault = jnp.where(definite, Status.NOT_RUN, Status.NON_CONVEX)
    return jnp.where(finite, fault, Status.NON_FINITE).astype(jnp.int32)


def harmless_matrices(P: Array, A: Array, usable: Array) -> tuple[Array, Array]:
    """Return P and A where they are usable, else the identity and zeros."""
    identity = jnp.eye(P.shape[0], dtype=P.dtype)
    return jnp.where(usable, P, identity), jnp.where(usable, A, 0.0)


def convex(P: Array) -> Array:
    """Return whether P (n, n) is positive semidefinite but for rounding.

    A direction d counts as rounding where d'Pd ≥ −ε|d|'|P||d|, ε as for residuals: tested, since
    |d|'|P||d| ≤ Σ_i d_i² Σ_j |P_ij|, by a Cholesky factorization of P + ε diag(Σ_j |P_ij|), with
    rows and columns scaled and in float64. A variable's units play no part.
    """
    floor = max(rounding(P.dtype), 4 * P.shape[0] * float(jnp.finfo(jnp.float64).eps))

    def factored(P: Array) -> Array:
        size = jnp.sum(jnp.abs(P), axis=1)
        unit = 1 / jnp.sqrt(jnp.where(size > 0, size, 1.0))
        scaled = unit[:, None] * P * unit
        return jnp.all(jnp.isfinite(cholesky(scaled + floor * jnp.eye(P.shape[0], dtype=P.dtype))))

    return precisely(factored, jax.lax.stop_gradient(P))


def scaled_multipliers(E: Array, y: Array) -> Array:
    """Multipliers of the rows E·v from those of v; 0 where E is 0."""
    return jnp.where(E > 0, y / jnp.where(E > 0, E, 1.0), 0.0)


@pytree
class ScaledProgram:
    """A program in its own units and, as `q` (n,) and `bounds`, in ADMM's coordinates, which are
    measured in `unit`; eps: the tolerance. A zero row (scale 0) is free there; `prove` and
    `residual_terms` look after it."""

    qp: QP
    factor: Factor
    q: Array
    bounds: Bounds
    unit: Array
    eps: Array

    @classmethod
    def of(
        cls, qp: QP, factor: Factor, eps: Any = 0.0, unit: Array | None = None
    ) -> "ScaledProgram":
        """Return the program with clean data.

        unit: None for one of each instance, the power of two next to the largest of |q| and of the
        distances of 0 from the bounds: the solution, which is homogeneous in these, is of size 1 or
        so, however large the cost and the limits of a problem are."""
        q, bounds = matmul(qp.q, factor.T), qp.bounds.scaled(factor.E)
        if unit is None:
            far = jnp.clip(jnp.zeros_like(bounds.l), bounds.l, bounds.u)
            size = jnp.maximum(*map(infinity_norm, jax.lax.stop_gradient((q, far))))
            exponent = jnp.where((size > 0) & jnp.isfinite(size), jnp.frexp(size)[1], 0)
            unit = jnp.ldexp(jnp.ones((), q.dtype), exponent)
        return cls(qp, factor, q / unit, bounds.divided(unit), unit, eps)

    def unrounded(self) -> "ScaledProgram":
        """Return the program whose ADMM coordinates are made anew, in float64, from that in its own
        units: what rounding to float32 leaves between the two is more than the last Newton steps
        gain."""
        qp, f = self.qp, self.factor
        A, H = f.E[:, None] * matmul(qp.A, f.T), hessian(qp.P, f.T, jnp.float32)
        f = replace(f, H=H, A=A, S=matmul(A, A.T))
        return ScaledProgram.of(qp, f, self.eps, self.unit)

    def scaled_rows(self, z: Array, y: Array) -> tuple[Array, Array]:
        """Return Az and y in ADMM's coordinates; 0 in a zero row."""
        E = self.factor.E
        return E * matmul(z, self.qp.A.T) / self.unit, scaled_multipliers(E, y) / self.unit

    def unscaled(self, w: Array, y: Array) -> tuple[Array, Array]:
        """Return z and an admissible y in the program's own units. A soft row that z cannot move
        (scale 0) gets its penalty's gradient as multiplier, so that the duality gap closes."""
        f, bounds = self.factor, self.qp.bounds
        penalty = bounds.penalty_gradient(jnp.zeros_like(y))
        y = jnp.where(f.E == 0, penalty, self.unit * f.E * y)
        return self.unit * matmul(w, f.T.T), bounds.admissible(y)

    def typical_sizes(self, w: Array, y: Array) -> TypicalSizes:
        """Return the sizes that are typical of the program at w, y in ADMM's coordinates.

        Rows are compared with |w| and the nearest of the bounds that are not 0, or with |q|, the
        minimiser without rows, if that is nearer. Where P is singular a gradient is no length:
        gradients are compared with q and y there, and |q| does not count."""
        f, unit = self.factor, self.unit
        norm_w, norm_q, norm_y = map(infinity_norm, (w, self.q, y))
        gradient = jnp.maximum(norm_q, norm_y)
        ends = jnp.stack([jnp.abs(self.bounds.l), jnp.abs(self.bounds.u)])
        nearest = jnp.min(jnp.where(ends > 0, ends, jnp.inf), initial=jnp.inf)
        nearest = jnp.where(f.flat, nearest, jnp.minimum(nearest, norm_q))
        nearest = jnp.where(jnp.isfinite(nearest), nearest, 1.0)
        primal = unit * (norm_w + nearest)
        dual = unit * jnp.where(f.flat, gradient, norm_w)
        terms = unit * jnp.where(f.flat, norm_w, norm_w + gradient)
        per_variable = 1 / jnp.sum(jnp.abs(f.T), axis=1)
        return TypicalSizes(
            rows=primal * f.row_norms,
            variables=dual * per_variable,
            gap=SHARE * primal * dual + CANCELS * unit**2 * nearest * gradient,
            row_terms=terms * f.row_norms,
            variable_terms=unit * gradient * per_variable,
        )

    def measure(self, w: Array, y: Array) -> tuple[Pair, Array, Array]:
        """Return the pair (z, y) of scaled w (n,) and y (m,), the scaled gradient
        T'(Pz + q + A'y) (n,) of its Lagrangian, and the tolerances of rows (m,)."""
        qp, f, sizes = self.qp, self.factor, self.typical_sizes(w, y)
        z, y = self.unscaled(w, y)
        products = Products.of(qp, z, y)
        measure = measure_pair_in_kernel if has_kernels(len(y)) and not qp.balls else measure_pair
        vectors = qp.q, qp.bounds, qp.row_sizes, z, y, products
        found, gradient = measure(self.eps, vectors, sizes, f.E, self.unit, self.bounds)
        tolerances = self.eps * row_sizes(products.Az, qp.row_sizes, sizes)
        return Pair(z, y, *found), matmul(gradient, f.T) / self.unit, tolerances


# What residuals are computed from: the arguments of `residuals.terms_of` but the typical sizes.
Vectors = tuple[Array, Bounds, Array | None, Array, Array, Products]
# What `residuals.check_terms` returns.
Checked = tuple[Measured, Array, Array, Array]


def measure_pair(
    eps: Array, vectors: Vectors, sizes: TypicalSizes, E: Array, unit: Array, scaled: Bounds
) -> tuple[Checked, Array]:
    """Return what is said of a pair, and the gradient of its Lagrangian. scaled: the bounds in
    ADMM's coordinates, of row scale E and measured in `unit`."""
    *_, y, products = vectors
    terms = terms_of(*vectors, sizes)
    floor = rounding(y.dtype)
    # For soft rows the gap is quadratic in the error of z; the prox residual is linear.
    v, y_w = E * products.Az / unit, scaled_multipliers(E, y) / unit
    size = jnp.abs(v) + jnp.abs(y_w)
    prox = scaled.prox_residual(v + y_w, 1.0) - y_w, SHARE + size, size
    values, _, own = terms[1]
    # Entries at rounding level count as zero.
    gradient = jnp.where(jnp.abs(values) > floor * own, values, 0.0)
    return check_terms(terms, eps, floor, [prox]), gradient


def measure_pair_in_kernel(
    eps: Array, vectors: Vectors, sizes: TypicalSizes, E: Array, unit: Array, scaled: Bounds
) -> tuple[Checked, Array]:
    """`measure_pair` as a kernel for NVIDIA GPUs. Rows and variables that fill up the vectors are
    free, and zero."""
    given, tree = jax.tree.flatten((vectors, replace(sizes, gap=None), E, scaled))  # type: ignore[arg-type]
    _, bounds, known, z, _, products = vectors
    free, none = FREE[: len(bounds.columns)], (0.0,) * len(products)
    zero = None if known is None else 0.0
    fills = jax.tree.leaves(((0.0, free, zero, 0.0, 0.0, none), (0.0,) * 4, 0.0, free))

    def measure(
        eps: Array, gap: Array, unit: Array, *given: Array
    ) -> tuple[list[Array], list[Array]]:
        vectors, sizes, E, scaled = jax.tree.unflatten(tree, given)
        found, gradient = measure_pair(eps, vectors, replace(sizes, gap=gap), E, unit, scaled)
        return [gradient], jax.tree.leaves(found)

    data = list(zip(given, fills, strict=True))
    [gradient], numbers = in_one_program(measure, [eps, sizes.gap, unit], data, [len(z)], 7)
    primal, dual, gap, within, error, near, finished = numbers
    measured = Measured(primal, dual, gap, within > 0)
    return (measured, error, near > 0, finished > 0), gradient


class Splitting(NamedTuple):
    """What a step of ADMM needs at penalties rho (m,), in scaled rows: the product r → G r, and the
    offset b (m,), the rows of the minimiser for r = 0."""

    rho: Array
    product: Callable[[Array], Array]
    offset: Array

    def step(self, t: Array, bounds: Bounds, alpha: Array | float) -> Array:
        """One ADMM step on t = s + v (m,)."""
        s = bounds.project(t, self.rho)
        return t + jnp.asarray(alpha, t.dtype) * (self.product(2 * s - t) + self.offset - s)


def splittings(factor: Factor, q: Array) -> list[Splitting]:
    """Return the splitting at each stage of the schedule of penalties; q = T'q (n,)."""

    def product(stage: int, r: Array) -> Array:
        if factor.G is None:
            return matmul(matmul(r, factor.F[stage].T), factor.A.T)
        return matmul(r, factor.G[stage].T)

    offsets = [-matmul(matmul(q, Minv), factor.A.T) for Minv in factor.Minv]
    stages = enumerate(zip(factor.rho, offsets, strict=True))
    return [Splitting(rho, partial(product, stage), offset) for stage, (rho, offset) in stages]


def iterate(
    schedule: Sequence[Splitting], bounds: Bounds, t: Array, iterations: int, alpha: Array | float
) -> tuple[Array, Array]:
    """Run the fixed loop from t (m,), equally many steps with each splitting; the last two t."""
    previous, before = t, None
    for splitting in schedule:
        if before is not None:  # the multiplier ρv is what carries over, not v
            s = bounds.project(t, before)
            t = s + before / splitting.rho * (t - s)
        before = splitting.rho
        advance = lambda t, splitting=splitting: splitting.step(t, bounds, alpha)
        if iterations:
            previous = repeat(advance, t, iterations // len(schedule) - 1)
            t = advance(previous)
    return t, previous


def nearer(splitting: Splitting, bounds: Bounds, t: Array) -> Array:
    """Return t (m,), or 0 where the first step from there is not longer than that from t.

    A step is nonexpansive, so that what it moves t by never grows on the way. A warm start from the
    plan of another state, far off, or with numbers that are no plan at all, is dropped this way."""
    moved = lambda t: jnp.sum((splitting.step(t, bounds, 1.0) - t) ** 2)
    zero = jnp.zeros_like(t)
    of_t, of_zero = jax.vmap(moved)(jax.lax.stop_gradient(jnp.stack([t, zero])))
    return jnp.where(of_t < of_zero, t, zero)


def start(bounds: Bounds, rho: Array, rows: Array, y: Array) -> Array:
    """t = s + v of a warm start: rows A w (m,) and multipliers y (m,), both scaled."""
    # Soft rows may stay outside their interval: s is what prox leaves of s + v.
    return bounds.project(rows + y / rho, rho) + y / rho


def repeat(advance: Callable[[Array], Array], t: Array, count: int) -> Array:
    """`count` steps. Backward through them, only the starts of √count blocks are kept in memory;
    the steps of a block are computed again."""
    inner = max(math.isqrt(count), 1)
    if not count:
        return t
    block = lambda t, length: jax.lax.scan(lambda t, _: (advance(t), None), t, length=length)[0]
    outer = jax.checkpoint(lambda t: block(t, inner), prevent_cse=False)
    t, _ = jax.lax.scan(lambda t, _: (outer(t), None), t, length=count // inner)
    return block(t, count % inner) if count % inner else t


def read(factor: Factor, t: Array, q: Array, bounds: Bounds) -> tuple[Array, Array]:
    """Return primal w (n,) and multiplier ρv (m,), both scaled, of t with the last penalty."""
    s = bounds.project(t, factor.rho[-1])
    w = matmul(2 * s - t, factor.F[-1].T) - matmul(q, factor.Minv[-1])
    return w, factor.rho[-1] * (t - s)
