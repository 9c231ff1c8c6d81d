"""What is known of a pair (z, y): its residuals, proofs of infeasibility, and its status by them.

Residuals come in parts, those of rows (m,), of variables (n,) and the gap (1,): `residual_terms`
for a QP, `mpc.controller` for the plan of an MPC problem, `stage_residuals` in
`mpc.stagewise.stages` for a problem stage by stage. With each entry come two numbers in its own
unit, so that neither the units of rows and variables nor that of the cost change what is said of a
pair:

    size    what the entry is compared with: the sums that it is a difference of;
    terms   the absolute terms of these sums, which can be far larger: rounding is a share of them.

A pair is solved where every entry is at most ε·size + floor·terms, with the floor at a few machine
epsilons. Sums can all vanish: of a row z_j ≥ 0 at z_j = 0, nothing is left but rounding. So a small
share of what is typical of the whole program is added to both (`TypicalSizes`).

Proofs. A vector y proves l ≤ Az ≤ u empty when A'y = 0 and Σ u y⁺ − l y⁻ < 0 (Farkas); a ball adds
radius·|y_b| to the sum, soft rows never take part. Iterates never satisfy A'y = 0 exactly.
Where a row bounds a single variable on both sides its multiplier can be chosen to absorb what is
left of A'y, exactly up to one rounding (Neumaier & Shcherbina 2004, safe bounds; here with the
box rows in the role of the correction). The bound is valid for any y; convergence makes it tight.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import reduce
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.pytrees import pytree
from jaxmpc.qp.jax_transformations import tree_where
from jaxmpc.qp.linalg import infinity_norm, matmul, precisely, rounding, solve
from jaxmpc.qp.problem import QP, Bounds, QPSolution, finite
from jaxmpc.qp.status import Status

# Multiple of the rounding floor below which steps on ill-conditioned programs gain nothing.
STALLED = 10
# Part of the tolerance below which one more step ends a search.
NEAR = 1e-4
# Share of what is typical of the whole program in the size of an entry.
SHARE = 1e-3
# Parts of the residuals: values, sizes and terms, as above.
Terms = Sequence[tuple[Array, Array, Array]]
# Tolerance of a ray's products, in multiples of `rounding`: rays are solutions of linear systems.
RAY = 25
# Share, in the sizes of a gradient and a gap that vanish, of what they are made of: times eps it is
# about rounding.
CANCELS = float(np.sqrt(np.finfo(np.float64).eps))
# Least size: products of two numbers below it are zero.
LEAST_SIZE = float(np.sqrt(np.finfo(np.float64).tiny))
# Entries of a Farkas vector or a ray, relative to the largest, that count as zero.
INSIGNIFICANT = 1e-13
# Rows that correct a certificate, and their entries: see `correcting_rows`.
Correcting = tuple[Array, Array]


class Products(NamedTuple):
    """Az, Pz and A'y, and the same of absolute values, |A||z|, |P||z| and |A|'|y|."""

    Az: Array
    Pz: Array
    Aty: Array
    size_Az: Array
    size_Pz: Array
    size_Aty: Array

    @classmethod
    def of(cls, qp: QP, z: Array, y: Array) -> "Products":
        """Return the products of a pair z (n,), y (m,)."""
        multiply = lambda z, y, P, A: (matmul(z, A.T), matmul(z, P), matmul(y, A))
        sizes = multiply(*map(jnp.abs, (z, y, qp.P, qp.A)))
        return cls(*multiply(z, y, qp.P, qp.A), *sizes)


@pytree
class TypicalSizes:
    """What is typical of the whole program, for rows (m,) and variables (n,): sizes, of which
    entries have a share, and terms; and the least size of the gap.

    In ADMM's coordinates z = T w, in which the Hessian is the identity, the solution is
    w = −q_w − A_w'y: its length is a size, that of q_w one of terms. A row a of scale E = 1/|T'a|
    grows by 1/E along a unit of length, and a gradient of size 1/Σ_k |T_jk| in every z_j is at most
    one of w.
    """

    rows: Array | float = 0.0
    variables: Array | float = 0.0
    gap: Array | float = 0.0
    row_terms: Array | float = 0.0
    variable_terms: Array | float = 0.0


def residual_terms(qp: QP, z: Array, y: Array, typical: TypicalSizes | None = None) -> Terms:
    """Return the residuals of rows (m,), variables (n,) and the gap (1,) of a pair: Az less its
    projection on hard constraints, Pz + q + A'y, and z'Pz + q'z + g(Az) + g*(y) with the penalties
    g of soft rows and the conjugate g* (`Bounds.support`). y is admissible: no multiplier against a
    bound that is not there."""
    products = Products.of(qp, z, y)
    return terms_of(qp.q, qp.bounds, qp.row_sizes, z, y, products, typical or TypicalSizes())


def row_sizes(Az: Array | float, known: Array | None, typical: TypicalSizes) -> Array:
    """Return what violations of rows are compared with (m,): what is known of a row
    (`QP.row_sizes`), and where that is nothing its value and what is typical."""
    sizes = jnp.abs(Az) + SHARE * typical.rows
    return sizes if known is None else jnp.where(known > 0, known, sizes)


def terms_of(
    q: Array,
    bounds: Bounds,
    known: Array | None,
    z: Array,
    y: Array,
    products: Products,
    typical: TypicalSizes,
) -> Terms:
    """Return `residual_terms` from the products with the matrices. known: `QP.row_sizes`."""
    Az, Pz, Aty, *sizes = products
    penalty, support = bounds.cost(Az), bounds.support(y)
    curved, along = jnp.sum(z * Pz), jnp.sum(z * q)
    paid, conjugate = jnp.sum(penalty), jnp.sum(support)
    # A penalty is a multiple of a violation, which is a difference of the terms of its row.
    terms = jnp.sum(jnp.abs(z) * (jnp.abs(Pz) + jnp.abs(q)))
    terms = terms + jnp.sum(bounds.slope(Az) * sizes[0] + penalty + jnp.abs(support))
    of_rows = row_sizes(Az, known, typical)
    # Where bounds hold the solution at zero, or it has no curvature, all sums of the gap vanish.
    vanishing = jnp.sum(jnp.abs(y) * of_rows) + jnp.sum(jnp.abs(z) * sizes[1])
    least = typical.gap + CANCELS * vanishing
    return [
        (bounds.violation(Az), of_rows, sizes[0] + typical.row_terms),
        (
            Pz + q + Aty,
            abs(Pz) + abs(q) + abs(Aty) + SHARE * typical.variables + CANCELS * sizes[1],
            sizes[1] + abs(q) + sizes[2] + typical.variable_terms,
        ),
        (
            (curved + along + paid + conjugate)[None],
            (abs(curved) + abs(along) + paid + abs(conjugate) + least)[None],
            terms[None],
        ),
    ]


def worst(terms: Terms, floor: float | Array) -> tuple[list[Array], list[Array]]:
    """Return of each part the largest residual, each less floor·terms, relative to its size, and
    the largest relative to size and terms; 0/0 is 0, and inf where one is not finite.

    Where all is zero at the solution, inputs, rows and multipliers, iterates come to it without
    end: sizes are no less than `LEAST_SIZE`."""
    above, relative = [], []
    for values, sizes, own in terms:
        # A maximum need not propagate NaN (XLA on CPUs).
        sound = finite(values) & finite(sizes) & finite(own)
        error = jnp.where(sound, jnp.abs(values), jnp.inf)
        least = LEAST_SIZE if error.dtype == jnp.float64 else jnp.finfo(error.dtype).tiny
        size = jnp.where(sound, jnp.maximum(sizes, least), 1.0)
        total = jnp.where(sound, size + own, 1.0)
        above.append(jnp.max((error - floor * total) / size, initial=0.0))
        relative.append(jnp.max(error / total, initial=0.0))
    return above, relative


@pytree
class Measured:
    """Primal residual, dual residual and gap of a pair, in the units of the problem, and whether
    each entry is at most eps·size + floor·terms."""

    primal: Array
    dual: Array
    gap: Array
    within_tolerance: Array

    @classmethod
    def of(cls, terms: Terms, eps: Array, floor: float) -> "Measured":
        """Return the residuals with these terms, measured."""
        return cls.from_ratios(terms, eps, worst(terms, floor)[0])

    @classmethod
    def from_ratios(cls, terms: Terms, eps: Array, above: list[Array]) -> "Measured":
        """Return them where the first three of `worst` are known."""
        primal, dual, gap = (infinity_norm(values) for values, *_ in terms)
        return cls(primal, dual, gap, reduce(jnp.maximum, above[:3]) <= eps)


@pytree
class Pair:
    """Primal z and dual y in the units of the problem, what was measured of them, the largest of
    their residuals, each less its rounding and relative to its size, whether all are small, and
    whether there is no more to gain."""

    z: Array
    y: Array
    measured: Measured
    error: Array
    near: Array
    finished: Array

    @classmethod
    def none(cls, z: Array, y: Array) -> "Pair":
        """Return a placeholder with infinite error, of the shapes of z and y."""
        false = jnp.asarray(False)
        infinite = jnp.asarray(jnp.inf, z.dtype)
        measured = Measured(infinite, infinite, infinite, false)
        return cls(jnp.zeros_like(z), jnp.zeros_like(y), measured, infinite, false, false)

    @classmethod
    def of(
        cls, z: Array, y: Array, terms: Terms, eps: Array, floor: float, others: Terms = ()
    ) -> "Pair":
        """Return the pair with what `check_terms` says of its terms."""
        return cls(z, y, *check_terms(terms, eps, floor, others))

    def or_better(self, other: "Pair") -> "Pair":
        """Return the other pair where that is finished or its residuals are smaller; one that is
        near only for another that is. A pair that was near before is finished after one step
        more."""
        smaller = (other.error < self.error) & (other.near | ~self.near)
        take = ~self.finished & (other.finished | smaller)
        best = tree_where(take, other, self)
        return replace(best, finished=best.finished | self.near)


def check_terms(
    terms: Terms, eps: Array, floor: float, others: Terms = ()
) -> tuple[Measured, Array, Array, Array]:
    """Return `measured`, `error`, `near` and `finished` of the pair with these terms; eps and floor
    as in `Measured`.

    near: all residuals are below a small part of their tolerance (NEAR), or below a tenth and a
    small multiple of their rounding. finished: below a tenth of that part. others: terms that count
    for these alone."""
    ratios, relatives = worst([*terms, *others], floor)
    above, relative = reduce(jnp.maximum, ratios), reduce(jnp.maximum, relatives)
    at_rounding = (relative <= STALLED * floor) & (above <= 0.1 * eps)
    near = (above <= NEAR * eps) | at_rounding
    measured = Measured.from_ratios(terms, eps, ratios)
    return measured, above, near, above <= 0.1 * NEAR * eps


@pytree
class Proof:
    """A Farkas vector and a descent ray, and whether they are proved to be. beyond: the rows
    contradict each other also where each is widened by its tolerance."""

    certificate: Array
    infeasible: Array
    beyond: Array
    ray: Array
    unbounded: Array

    @classmethod
    def none(cls, z: Array, y: Array) -> "Proof":
        """Return that nothing is proved of a program with variables like z and rows like y."""
        false = jnp.asarray(False)
        return cls(jnp.zeros_like(y), false, false, jnp.zeros_like(z), false)

    def joined(self, other: "Proof") -> "Proof":
        """Return what either proves; of Farkas vectors the first one beyond the tolerance."""
        old, new = self, other
        first = old.beyond | (old.infeasible & ~new.beyond)
        certificate = jnp.where(first, old.certificate, new.certificate)
        infeasible, beyond = old.infeasible | new.infeasible, old.beyond | new.beyond
        ray = jnp.where(old.unbounded, old.ray, new.ray)
        return Proof(certificate, infeasible, beyond, ray, old.unbounded | new.unbounded)


def prove(
    qp: QP,
    T: Array,
    E: Array,
    correcting: Correcting,
    tolerances: Array,
    y: Array,
    d: Array,
    *,
    balance: bool = False,
) -> Proof:
    """Return what is proved of the program by candidates for a Farkas vector y and a ray d, both in
    ADMM's coordinates (`admm.scale`). correcting: `correcting_rows(qp)`. tolerances (m,): by how
    much rows may be violated. balance: try the vector `balanced`."""
    ray, unbounded = descent_ray(qp, significant(matmul(d, T.T)))
    if not y.shape[0]:
        return replace(Proof.none(ray, y), ray=ray, unbounded=unbounded)
    # Rows that z cannot move prove emptiness by themselves.
    fixed = jnp.where(E == 0, qp.bounds.violation(jnp.zeros_like(E)), 0.0)
    y = significant(y)
    y = balanced(qp, E * y) if balance else E * y
    candidate = jnp.where(jnp.any(fixed != 0), fixed, y)
    return Proof(*farkas(qp, candidate, correcting, tolerances), ray, unbounded)


def correcting_rows(qp: QP) -> Correcting:
    """Return for each variable a row that bounds it alone, (n,), and the entry of A there, 0 where
    there is none: the rows that correct a certificate. The choice rests on A and on which rows are
    soft, so a batch shares it."""
    m, n = qp.A.shape
    if not m:
        return jnp.zeros(n, jnp.int32), jnp.zeros(n, qp.A.dtype)
    single = (jnp.sum(qp.A != 0, axis=1) == 1) & (np.arange(m, dtype=np.int32) < m - sum(qp.balls))
    if qp.bounds.linear is not None:
        single = single & jnp.isinf(qp.bounds.linear)
    entries = jnp.where(single[:, None], jnp.abs(qp.A), 0.0)
    rows, column = np.arange(m, dtype=np.int32)[:, None], np.arange(n, dtype=np.int32)
    largest = entries == jnp.max(entries, axis=0)
    row = jnp.min(jnp.where(largest, rows, np.int32(m - 1)), axis=0)
    return row, jnp.where(entries[row, column] > 0, qp.A[row, column], 0.0)


def farkas(
    qp: QP, y: Array, correcting: Correcting, tolerances: Array | float = 0.0
) -> tuple[Array, Array, Array]:
    """Make a certificate of the candidate y: return (y, proved, beyond).

    y is scaled to length one, set to zero against infinite bounds, and corrected on rows
    that bound one variable (`correcting_rows`). `proved` is True when Σ u y⁺ − l y⁻ is below zero
    by more than the rounding of the sum and of A'y (over the box of the bounded variables, and
    `QP.extent`); a variable with neither must have (A'y)_j at rounding level. A zero y proves
    nothing.
    `beyond`: proved also of the program whose rows are widened by `tolerances` (m,), which adds
    Σ tolerance·|y| to the sum.
    """
    eps = jnp.finfo(y.dtype).eps
    m, n = qp.A.shape
    bounds, (row, pivot) = qp.bounds.hard(), correcting
    y = bounds.admissible(to_length_one(y))
    bound = jnp.maximum(jnp.abs(bounds.l), jnp.abs(bounds.u))[row]
    has_row = (pivot != 0) & jnp.isfinite(bound)
    pivot = jnp.where(has_row, pivot, 1.0)
    y = y.at[row].add(jnp.where(has_row, -matmul(y, qp.A) / pivot, 0.0))

    left = jnp.abs(matmul(y, qp.A))
    gamma = 2 * (m + n + 2) * eps
    noise = gamma * matmul(jnp.abs(y), jnp.abs(qp.A))
    support = bounds.support(y)
    # What the correction leaves of A'y meets at most |z| ≤ bound / |pivot|.
    other = jnp.where(left <= noise, 0.0, jnp.inf)
    other = other if qp.extent is None else jnp.minimum(other, qp.extent)
    z_max = jnp.where(has_row, bound / jnp.abs(pivot), other)
    leak = jnp.where(z_max > 0, (2 * left + noise) * z_max, 0.0)
    bound = jnp.sum(jnp.concatenate([support + gamma * jnp.abs(support), leak]))
    proved, beyond = bound < 0, bound + jnp.sum(tolerances * jnp.abs(y)) < 0
    return jnp.where(proved, y, 0.0), proved, beyond


def significant(v: Array) -> Array:
    """Return v without the entries that are rounding of the largest: those of a multiplier push
    variables that nothing else pushes, those of a ray move rows that nothing else moves."""
    return jnp.where(jnp.abs(v) > INSIGNIFICANT * infinity_norm(v), v, 0.0)


def balanced(qp: QP, y: Array) -> Array:
    """Return the candidate y for a Farkas vector with what is left of A'y made up for by its own
    rows: y − D A K⁻¹A'y with D = diag(y²) and K = A'DA, the least change relative to y that does
    so. A variable without bounds allows no more to be left than rounding."""
    y = to_length_one(qp.bounds.hard().admissible(y))
    size = jnp.sqrt(jnp.sum((y[:, None] * qp.A) ** 2, axis=0))
    A = qp.A / jnp.where(size > 0, size, 1.0)
    K = matmul(A.T * y**2, A)
    K = K + 10 * jnp.finfo(y.dtype).eps * jnp.eye(len(K), dtype=y.dtype)
    return y - y**2 * matmul(solve(K, matmul(y, A)), A.T)


def to_length_one(v: Array) -> Array:
    """Return v divided by its infinity norm; 0 stays 0."""
    length = infinity_norm(v)
    return v / jnp.where(length > 0, length, 1.0)


def recession(P: Array, q: Array, bounds: Bounds) -> tuple[Array, Array, Bounds]:
    """Return H (n, n), g (n,) and bounds on A d for which ½ d'Hd + g'd + ½ dist²(A d, bounds) has
    its least value −½ at rays of descent d: it is ½|Pd|² + ½(q'd/|q| + 1)² − ½ and the distance to
    the cone of directions that no bound stops. Soft rows count as hard.
    """
    along = q / jnp.maximum(jnp.linalg.norm(q), jnp.finfo(q.dtype).tiny)
    l = jnp.where(jnp.isneginf(bounds.l), -jnp.inf, 0.0)
    u = jnp.where(jnp.isposinf(bounds.u), jnp.inf, 0.0)
    radius = None if bounds.radius is None else jnp.zeros_like(bounds.radius)
    cone = replace(bounds, l=l, u=u, linear=None, quadratic=None, radius=radius)
    return matmul(P, P) + along[:, None] * along, along, cone


def descent_ray(qp: QP, d: Array) -> tuple[Array, Array]:
    """Make a ray of unbounded descent of the direction d: return (d, found).

    Pd = 0, q'd < 0, and A d ≤ 0 where u is finite, ≥ 0 where l is finite, each product to within
    the rounding of its own terms, (|P||d|)_i, |q|'|d| and (|A||d|)_i. Units of
    rows and variables play no part; a curvature that is rounding in this sense cannot be told from
    none. d is scaled to length one. A zero direction proves nothing.
    """
    tolerance = RAY * rounding(d.dtype)
    d = to_length_one(d)
    size = jnp.abs(d)
    Ad, noise = matmul(d, qp.A.T), tolerance * matmul(size, jnp.abs(qp.A).T)
    flat = jnp.abs(matmul(d, qp.P)) <= tolerance * matmul(size, jnp.abs(qp.P))
    stays = (jnp.isposinf(qp.u) | (Ad <= noise)) & (jnp.isneginf(qp.l) | (Ad >= -noise))
    falls = jnp.sum(qp.q * d + tolerance * jnp.abs(qp.q) * size) < 0
    proved = jnp.all(jnp.concatenate([flat, stays])) & falls
    return jnp.where(proved, d, 0.0), proved


def assess(
    terms: Callable[..., Terms], data: tuple, z: Array, y: Array, proof: Proof, eps: Array
) -> QPSolution:
    """Return the solution (z, y) with the status that its residuals, terms(*data, z, y) in float64,
    and the proofs give it; without its cost and count of iterations."""
    dtype, floor = z.dtype, rounding(z.dtype)
    measure = lambda data, z, y, eps: Measured.of(terms(*data, z, y), eps, floor)
    return with_status(precisely(measure, data, z, y, jnp.asarray(eps, dtype)), z, y, proof)


def with_status(measured: Measured, z: Array, y: Array, proof: Proof) -> QPSolution:
    """Return the solution (z, y) with the status that its residuals and the proofs give it; without
    its cost and count of iterations."""
    solved = measured.within_tolerance
    # Rows that contradict each other by less than eps are both solved and proved empty: say solved.
    infeasible = proof.infeasible & ~solved
    unbounded = proof.unbounded & ~solved & ~infeasible
    status = jnp.select(
        [solved, infeasible, unbounded],
        [Status.SOLVED, Status.PRIMAL_INFEASIBLE, Status.DUAL_INFEASIBLE],
        Status.ITERATION_LIMIT,
    )
    cost, status = jnp.zeros((), z.dtype), status.astype(jnp.int32)
    primal, dual, gap, _ = vars(measured).values()
    certificate = jnp.where(infeasible, proof.certificate, 0.0)
    ray = jnp.where(unbounded, proof.ray, 0.0)
    none = jnp.int32(0)
    return QPSolution(z, y, cost, status, primal, dual, gap, none, certificate, ray)


def with_fault(solution: QPSolution, fault: Array) -> QPSolution:
    """Return the solution where the data were usable; NaN and the status `fault` where not."""
    usable = fault == Status.NOT_RUN
    names = ("z", "y", "cost", "primal_residual", "dual_residual", "gap")
    found = {name: jnp.where(usable, getattr(solution, name), jnp.nan) for name in names}
    return replace(solution, **found, status=jnp.where(usable, solution.status, fault))
