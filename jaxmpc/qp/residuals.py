"""Residuals of a primal-dual pair, judged against the rounding of their own terms.

Residuals are one vector, [rows (m), variables (n), gap (1)], and with it, entry by entry, the sum
of the absolute terms that each is a difference of: `residual_terms` for a QP,
`mpc.stagewise.stage_residuals` for a problem stage by stage. Status and stopping are computed from
these.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.qp.certificate import Proof
from jaxmpc.qp.precision import matmul, precisely, rounding
from jaxmpc.qp.problem import QP, QPSolution
from jaxmpc.qp.status import Status

# Multiple of the rounding floor below which steps on ill-conditioned programs gain nothing.
STALLED = 10
# A residual vector and the sizes of its terms.
Terms = tuple[Array, Array]


def residual_terms(qp: QP, z: Array, y: Array) -> Terms:
    """Return the residuals of rows (m,), variables (n,) and the gap as one vector (m + n + 1,), and
    the sizes, entry by entry, of the terms that they are differences of: rounding is a share of
    these.
    """
    Az, Pz, Aty = matmul(z, qp.A.T), matmul(z, qp.P), matmul(y, qp.A)
    bounds, size_z, size_y = qp.bounds, jnp.abs(z), jnp.abs(y)
    penalty, support = bounds.cost(Az), bounds.support(y)
    # Summed together: each sum is a kernel of its own.
    gap, size = jnp.sum(jnp.stack([
        jnp.concatenate([z * (Pz + qp.q), penalty + support]),
        jnp.concatenate([size_z * (jnp.abs(Pz) + jnp.abs(qp.q)), penalty + jnp.abs(support)]),
    ]), axis=1)  # fmt: skip
    dual_size = matmul(size_z, jnp.abs(qp.P)) + jnp.abs(qp.q) + matmul(size_y, jnp.abs(qp.A))
    values = [bounds.violation(Az), Pz + qp.q + Aty, gap[None]]
    sizes = [matmul(size_z, jnp.abs(qp.A).T), dual_size, size[None]]
    return jnp.concatenate(values), jnp.concatenate(sizes)


def residuals(qp: QP, z: Array, y: Array) -> tuple[Array, Array, Array]:
    """Return primal residual, dual residual and duality gap of (z, y), infinity norms, own units.

    primal = max |Az − its projection| over hard constraints, dual = max |Pz + q + A'y|,
    gap = |z'Pz + q'z + g(Az) + g*(y)| with the penalties g of soft rows and the conjugate
    g*(y) = Σ u y⁺ − l y⁻ + … (`Bounds.support`). A multiplier that is not admissible (a push
    against an absent bound) must be made so before.
    """
    return largest_of_each(residual_terms(qp, z, y)[0], len(y))


def largest_of_each(values: Array, rows: int) -> tuple[Array, Array, Array]:
    """Return the infinity norms of primal and dual residual and the gap, of `residual_terms`."""
    size = jnp.abs(values)
    norm = lambda v: jnp.max(v, initial=0.0)
    return norm(size[:rows]), norm(size[rows:-1]), size[-1]


def small(terms: Terms, eps: Any, floor: float) -> Array:
    """Return whether each residual is at most its tolerance: eps (2,) holds the absolute one and
    that relative to the size of the terms, to which floor is added."""
    values, sizes = terms
    return jnp.all(jnp.abs(values) <= eps[0] + (eps[1] + floor) * sizes)


def worst(terms: Terms, floor: Any) -> tuple[Array, Array]:
    """Return the largest of the residuals, each less floor·(size of its terms), and the largest
    relative to 1 + that size; inf where one is NaN."""
    values, sizes = terms
    # A maximum need not propagate NaN (XLA on CPUs).
    error = jnp.where(jnp.isfinite(values), jnp.abs(values), jnp.inf)
    sizes = jnp.where(jnp.isfinite(sizes), sizes, 0.0)
    absolute, relative = jnp.max(jnp.stack([error - floor * sizes, error / (1 + sizes)]), axis=1)
    return absolute, relative


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pair:
    """Primal z and dual y in the units of the problem, the largest of its residuals, each relative
    to the size of its terms, whether all are small, and whether there is no more to gain."""

    z: Array
    y: Array
    error: Array
    near: Array
    solved: Array

    @classmethod
    def none(cls, z: Array, y: Array) -> "Pair":
        """Return a placeholder with infinite error, of the shapes of z and y."""
        false = jnp.asarray(False)
        infinite = jnp.asarray(jnp.inf, z.dtype)
        return cls(jnp.zeros_like(z), jnp.zeros_like(y), infinite, false, false)

    @classmethod
    def of(cls, z: Array, y: Array, terms: Terms, eps: Array, floor: float) -> "Pair":
        """Return the pair judged; eps (2,) and floor as in `small`. near: all residuals are below
        a thousandth of their tolerance, or below a tenth and a small multiple of their rounding;
        solved: below a millionth of the absolute one."""
        above, relative = worst(terms, floor + 1e-3 * eps[1])
        at_rounding = (relative <= STALLED * floor) & (above <= 0.1 * eps[0])
        near = (above <= 1e-3 * eps[0]) | at_rounding
        return cls(z, y, relative, near, above <= 1e-6 * eps[0])

    def or_better(self, other: "Pair") -> "Pair":
        """Return the other pair where that is solved or its residuals are smaller; one that is
        near only for another that is. A pair that was near before is solved after one step
        more."""
        smaller = (other.error < self.error) & (other.near | ~self.near)
        take = ~self.solved & (other.solved | smaller)
        best = jax.tree.map(lambda old, new: jnp.where(take, new, old), self, other)
        return replace(best, solved=best.solved | self.near)


def assess(
    terms: Callable[..., Terms], data: tuple, z: Array, y: Array, proof: Proof, eps: Any
) -> QPSolution:
    """Return the solution (z, y) with the status that its residuals, terms(*data, z, y) in float64,
    and the proofs give it; without its cost and count of iterations."""
    dtype, floor = z.dtype, rounding(z.dtype)

    def measure(data: tuple, z: Array, y: Array, eps: Array) -> tuple[Array, ...]:
        found = terms(*data, z, y)
        return (small(found, eps, floor), *largest_of_each(found[0], len(y)))

    solved, primal, dual, gap = precisely(measure, data, z, y, jnp.asarray(eps, dtype))
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
        primal_residual=primal, dual_residual=dual, gap=gap, iterations=jnp.int32(0),
        certificate=jnp.where(infeasible, proof.certificate, 0.0),
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
