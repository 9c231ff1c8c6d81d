"""Residuals of a primal-dual pair, judged against the rounding of their own terms.

Residuals come in parts, those of rows (m,), of variables (n,) and the gap (1,), and with each,
entry by entry, the sum of the absolute terms that it is a difference of: `residual_terms` for a QP,
`mpc.stagewise.stage_residuals` for a problem stage by stage. Status and stopping are computed from
these.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.qp.certificate import Proof
from jaxmpc.qp.precision import matmul, precisely, rounding
from jaxmpc.qp.problem import QP, QPSolution
from jaxmpc.qp.projection import Bounds
from jaxmpc.qp.status import Status

# Multiple of the rounding floor below which steps on ill-conditioned programs gain nothing.
STALLED = 10
# Parts of the residuals, each with the sizes of its terms.
Terms = Sequence[tuple[Array, Array]]


class Products(NamedTuple):
    """Az, Pz and A'y, and the same of absolute values, |A||z|, |P||z| and |A|'|y|."""

    Az: Array
    Pz: Array
    Aty: Array
    size_Az: Array
    size_Pz: Array
    size_Aty: Array

    @classmethod
    def of(cls, qp: QP, z: Array, y: Array, sizes: bool = True) -> "Products":
        """Return the products of a pair z (n,), y (m,); sizes: False counts those of the absolute
        values as 0."""
        multiply = lambda z, y, P, A: (matmul(z, A.T), matmul(z, P), matmul(y, A))
        products = multiply(z, y, qp.P, qp.A)
        if not sizes:
            return cls(*products, *map(jnp.zeros_like, products))
        return cls(*products, *multiply(*map(jnp.abs, (z, y, qp.P, qp.A))))


def residual_terms(qp: QP, z: Array, y: Array, sizes: bool = True) -> Terms:
    """Return the residuals of rows (m,), variables (n,) and the gap (1,), each with the sizes,
    entry by entry, of the terms that they are differences of: rounding is a share of these. sizes:
    False underestimates them, at half the cost."""
    return terms_of(qp.q, qp.bounds, z, y, Products.of(qp, z, y, sizes))


def terms_of(q: Array, bounds: Bounds, z: Array, y: Array, products: Products) -> Terms:
    """Return `residual_terms` from the products with the matrices."""
    Az, Pz, Aty, *sizes = products
    penalty, support = bounds.cost(Az), bounds.support(y)
    gap = jnp.sum(z * (Pz + q)) + jnp.sum(penalty + support)
    # A penalty is a multiple of a violation, which is a difference of the terms of its row.
    size = jnp.sum(jnp.abs(z) * (jnp.abs(Pz) + jnp.abs(q)))
    size = size + jnp.sum(bounds.slope(Az) * sizes[0] + penalty + jnp.abs(support))
    return [
        (bounds.violation(Az), sizes[0]),
        (Pz + q + Aty, sizes[1] + jnp.abs(q) + sizes[2]),
        (gap[None], size[None]),
    ]


def residuals(qp: QP, z: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return primal residual, dual residual and duality gap of (z, y), infinity norms, own units.

    primal = max |Az − its projection| over hard constraints, dual = max |Pz + q + A'y|,
    gap = |z'Pz + q'z + g(Az) + g*(y)| with the penalties g of soft rows and the conjugate
    g*(y) = Σ u y⁺ − l y⁻ + … (`Bounds.support`). A multiplier that is not admissible (a push
    against an absent bound) must be made so before.
    """
    primal, dual, gap = (_largest(jnp.abs(values)) for values, _ in residual_terms(qp, z, y))
    return primal, dual, gap


def joined(terms: Terms) -> tuple[Array, Array]:
    """Return all residuals as one vector (m + n + 1,), and their sizes as another."""
    values, sizes = zip(*terms, strict=True)
    return jnp.concatenate(values), jnp.concatenate(sizes)


def worst(terms: Terms, floor: Any) -> tuple[Array, Array]:
    """Return the largest of the residuals, each less floor·(size of its terms), and the largest
    relative to 1 + that size; inf where one is NaN."""
    absolute, relative = [], []
    for values, sizes in terms:
        # A maximum need not propagate NaN (XLA on CPUs).
        error = jnp.where(jnp.isfinite(values), jnp.abs(values), jnp.inf)
        sizes = jnp.where(jnp.isfinite(sizes), sizes, 0.0)
        absolute.append(_largest(error - floor * sizes))
        relative.append(_largest(error / (1 + sizes)))
    return _largest_of(absolute), _largest_of(relative)


def _largest(v: Array) -> Array:
    return jnp.max(v, initial=0.0)


def _largest_of(numbers: list[Array]) -> Array:
    found = numbers[0]
    for number in numbers[1:]:
        found = jnp.maximum(found, number)
    return found


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Measured:
    """Primal residual, dual residual and gap of a pair, and whether each entry is at most its
    tolerance: eps (2,) holds the absolute one and that relative to the size of the terms, to which
    `floor` is added."""

    primal: Array
    dual: Array
    gap: Array
    small: Array

    @classmethod
    def of(cls, terms: Terms, eps: Any, floor: float) -> "Measured":
        """Return the residuals with these terms, measured."""
        primal, dual, gap = (_largest(jnp.abs(values)) for values, _ in terms)
        above, _ = worst(terms, eps[1] + floor)
        return cls(primal, dual, gap, above <= eps[0])


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Pair:
    """Primal z and dual y in the units of the problem, what was measured of them, the largest of
    their residuals, each relative to the size of its terms, whether all are small, and whether
    there is no more to gain."""

    z: Array
    y: Array
    measured: Measured
    error: Array
    near: Array
    solved: Array

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
        """Return the pair judged; eps (2,) and floor as in `Measured`. near: all residuals are
        below a thousandth of their tolerance, or below a tenth and a small multiple of their
        rounding; solved: below a millionth of the absolute one. others: terms that count for these
        alone."""
        return cls(z, y, *judgment(terms, eps, floor, others))

    def or_better(self, other: "Pair") -> "Pair":
        """Return the other pair where that is solved or its residuals are smaller; one that is
        near only for another that is. A pair that was near before is solved after one step
        more."""
        smaller = (other.error < self.error) & (other.near | ~self.near)
        take = ~self.solved & (other.solved | smaller)
        best = jax.tree.map(lambda old, new: jnp.where(take, new, old), self, other)
        return replace(best, solved=best.solved | self.near)


def judgment(
    terms: Terms, eps: Any, floor: float, others: Terms = ()
) -> tuple[Measured, Array, Array, Array]:
    """Return what `Pair.of` says of the terms: the last four fields of the pair."""
    above, relative = worst([*terms, *others], floor + 1e-3 * eps[1])
    at_rounding = (relative <= STALLED * floor) & (above <= 0.1 * eps[0])
    near = (above <= 1e-3 * eps[0]) | at_rounding
    return Measured.of(terms, eps, floor), relative, near, above <= 1e-6 * eps[0]


def assess(
    terms: Callable[..., Terms], data: tuple, z: Array, y: Array, proof: Proof, eps: Any
) -> QPSolution:
    """Return the solution (z, y) with the status that its residuals, terms(*data, z, y) in float64,
    and the proofs give it; without its cost and count of iterations."""
    dtype, floor = z.dtype, rounding(z.dtype)
    measure = lambda data, z, y, eps: Measured.of(terms(*data, z, y), eps, floor)
    return concluded(precisely(measure, data, z, y, jnp.asarray(eps, dtype)), z, y, proof)


def concluded(measured: Measured, z: Array, y: Array, proof: Proof) -> QPSolution:
    """Return the solution (z, y) with the status that its residuals and the proofs give it; without
    its cost and count of iterations."""
    solved, dtype = measured.small, z.dtype
    # Rows that contradict each other by less than eps are both solved and proved empty: say solved.
    infeasible = proof.infeasible & ~solved
    unbounded = proof.unbounded & ~solved & ~infeasible
    status = jnp.select(
        [solved, infeasible, unbounded],
        [Status.SOLVED, Status.PRIMAL_INFEASIBLE, Status.DUAL_INFEASIBLE],
        Status.ITERATION_LIMIT,
    )
    return QPSolution(
        z=z, y=y, cost=jnp.zeros((), dtype), status=status.astype(jnp.int32),
        primal_residual=measured.primal, dual_residual=measured.dual, gap=measured.gap,
        iterations=jnp.int32(0), certificate=jnp.where(infeasible, proof.certificate, 0.0),
        ray=jnp.where(unbounded, proof.ray, 0.0),
    )  # fmt: skip


def marked(solution: QPSolution, fault: Array) -> QPSolution:
    """Return the solution where the data were usable; NaN and the status `fault` where not."""
    nan = lambda v: jnp.where(fault == Status.NOT_RUN, v, jnp.nan)
    s = solution
    return replace(
        s, z=nan(s.z), y=nan(s.y), cost=nan(s.cost), primal_residual=nan(s.primal_residual),
        dual_residual=nan(s.dual_residual), gap=nan(s.gap),
        status=jnp.where(fault == Status.NOT_RUN, s.status, fault),
    )  # fmt: skip
