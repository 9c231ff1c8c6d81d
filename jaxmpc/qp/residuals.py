"""Residuals of a primal-dual pair, each relative to the size of its own entry, and the status.

Residuals come in parts, those of rows (m,), of variables (n,) and the gap (1,): `residual_terms`
for a QP, `mpc.stated_residuals` for the plan of an MPC problem, `stage_residuals` in
`mpc.stagewise.stages` for a problem stage by stage. With each entry come two numbers in its own
unit, so that neither the units of rows and variables nor that of the cost change what is said of a
pair:

    size    what the entry is compared with: the sums that it is a difference of;
    terms   the absolute terms of these sums, which can be far larger: rounding is a share of them.

A pair is solved where every entry is at most ε·size + floor·terms, with the floor at a few machine
epsilons. Sums can all vanish: of a row z_j ≥ 0 at z_j = 0, nothing is left but rounding. So a small
share of what is natural for the whole program is added to both (`Natural`).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.pytrees import pytree
from jaxmpc.qp.certificate import Proof
from jaxmpc.qp.precision import matmul, precisely, rounding
from jaxmpc.qp.problem import QP, QPSolution
from jaxmpc.qp.projection import Bounds, finite
from jaxmpc.qp.status import Status

# Multiple of the rounding floor below which steps on ill-conditioned programs gain nothing.
STALLED = 10
# Part of the tolerance below which one more step ends a search.
NEAR = 1e-4
# Share of what is natural for the whole program in the size of an entry.
SHARE = 1e-3
# Parts of the residuals: values, sizes and terms, as above.
Terms = Sequence[tuple[Array, Array, Array]]


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
class Natural:
    """What is natural for the whole program, for rows (m,), variables (n,) and the gap: sizes, and
    the terms of rows and variables.

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


def residual_terms(qp: QP, z: Array, y: Array, natural: Natural | None = None) -> Terms:
    """Return the residuals of rows (m,), variables (n,) and the gap (1,) of a pair."""
    products = Products.of(qp, z, y)
    return terms_of(qp.q, qp.bounds, qp.row_sizes, z, y, products, natural or Natural())


def row_sizes(Az: Array | float, known: Array | None, natural: Natural) -> Array:
    """Return what violations of rows are compared with (m,): what is known of a row
    (`QP.row_sizes`), and where that is nothing its value and what is natural."""
    sizes = jnp.abs(Az) + SHARE * natural.rows
    return sizes if known is None else jnp.where(known > 0, known, sizes)


def terms_of(
    q: Array,
    bounds: Bounds,
    known: Array | None,
    z: Array,
    y: Array,
    products: Products,
    natural: Natural,
) -> Terms:
    """Return `residual_terms` from the products with the matrices. known: `QP.row_sizes`."""
    Az, Pz, Aty, *sizes = products
    size = jnp.abs
    penalty, support = bounds.cost(Az), bounds.support(y)
    curved, along = jnp.sum(z * Pz), jnp.sum(z * q)
    paid, conjugate = jnp.sum(penalty), jnp.sum(support)
    # A penalty is a multiple of a violation, which is a difference of the terms of its row.
    terms = jnp.sum(jnp.abs(z) * (jnp.abs(Pz) + jnp.abs(q)))
    terms = terms + jnp.sum(bounds.slope(Az) * sizes[0] + penalty + jnp.abs(support))
    return [
        (
            bounds.violation(Az),
            row_sizes(Az, known, natural),
            sizes[0] + natural.row_terms,
        ),
        (
            Pz + q + Aty,
            size(Pz) + size(q) + size(Aty) + SHARE * natural.variables,
            sizes[1] + size(q) + sizes[2] + natural.variable_terms,
        ),
        (
            (curved + along + paid + conjugate)[None],
            (size(curved) + size(along) + paid + size(conjugate) + SHARE * natural.gap)[None],
            terms[None],
        ),
    ]


def residuals(qp: QP, z: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return primal residual, dual residual and duality gap of (z, y), infinity norms, own units.

    primal = max |Az − its projection| over hard constraints, dual = max |Pz + q + A'y|,
    gap = |z'Pz + q'z + g(Az) + g*(y)| with the penalties g of soft rows and the conjugate
    g*(y) = Σ u y⁺ − l y⁻ + … (`Bounds.support`). A multiplier that is not admissible (a push
    against an absent bound) must be made so before.
    """
    primal, dual, gap = (_largest(jnp.abs(values)) for values, *_ in residual_terms(qp, z, y))
    return primal, dual, gap


def joined(terms: Terms) -> tuple[Array, Array, Array]:
    """Return all residuals as one vector (m + n + 1,), their sizes as another, and the terms."""
    values, sizes, terms = zip(*terms, strict=True)
    return jnp.concatenate(values), jnp.concatenate(sizes), jnp.concatenate(terms)


def worst(terms: Terms, floor: float | Array) -> tuple[list[Array], list[Array]]:
    """Return of each part the largest residual, each less floor·terms, relative to its size, and
    the largest relative to size and terms; 0/0 is 0, and inf where one is not finite."""
    above, relative = [], []
    for values, sizes, own in terms:
        # A maximum need not propagate NaN (XLA on CPUs).
        sound = finite(values) & finite(sizes) & finite(own)
        error = jnp.where(sound, jnp.abs(values), jnp.inf)
        least = jnp.finfo(error.dtype).tiny
        size = jnp.where(sound, jnp.maximum(sizes, least), 1.0)
        total = jnp.where(sound, size + own, 1.0)
        above.append(_largest((error - floor * total) / size))
        relative.append(_largest(error / total))
    return above, relative


def _largest(v: Array) -> Array:
    return jnp.max(v, initial=0.0)


def largest_of(numbers: list[Array]) -> Array:
    """Return the largest of some scalars."""
    found = numbers[0]
    for number in numbers[1:]:
        found = jnp.maximum(found, number)
    return found


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
        primal, dual, gap = (_largest(jnp.abs(values)) for values, *_ in terms)
        return cls(primal, dual, gap, largest_of(above[:3]) <= eps)


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
        best = jax.tree.map(lambda old, new: jnp.where(take, new, old), self, other)
        return replace(best, finished=best.finished | self.near)


class PairCheck(NamedTuple):
    """What residuals say of a pair: its fields of these names."""

    measured: Measured
    error: Array
    near: Array
    finished: Array


def check_terms(terms: Terms, eps: Array, floor: float, others: Terms = ()) -> PairCheck:
    """Return what the terms say of a pair; eps and floor as in `Measured`.

    near: all residuals are below a small part of their tolerance (NEAR), or below a tenth and a
    small multiple of their rounding. finished: below a tenth of that part. others: terms that count
    for these alone."""
    ratios, relatives = worst([*terms, *others], floor)
    above, relative = largest_of(ratios), largest_of(relatives)
    at_rounding = (relative <= STALLED * floor) & (above <= 0.1 * eps)
    near = (above <= NEAR * eps) | at_rounding
    measured = Measured.from_ratios(terms, eps, ratios)
    return PairCheck(measured, above, near, above <= 0.1 * NEAR * eps)


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
