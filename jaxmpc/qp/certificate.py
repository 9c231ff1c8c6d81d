"""Proofs of infeasibility for one QP, made safe against rounding.

A vector y proves l ≤ Az ≤ u empty when A'y = 0 and Σ u y⁺ − l y⁻ < 0 (Farkas); a ball adds
radius·|y_b| to the sum, soft rows never take part. Iterates never satisfy A'y = 0 exactly.
Where a row bounds a single variable on both sides its multiplier can be chosen to absorb what is
left of A'y, exactly up to one rounding (Neumaier & Shcherbina 2004, safe bounds; here with the
box rows in the role of the correction). The bound is valid for any y; convergence makes it tight.
"""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.pytrees import pytree
from jaxmpc.qp.precision import matmul, rounding
from jaxmpc.qp.problem import QP
from jaxmpc.qp.projection import Bounds

# Tolerance of a ray's products, in multiples of `rounding`: rays are solutions of linear systems.
RAY = 25
# Rows that correct a certificate, and their entries: see `correcting_rows`.
Correcting = tuple[Array, Array]


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
    qp: QP, T: Array, E: Array, correcting: Correcting, tolerances: Array, y: Array, d: Array
) -> Proof:
    """Return what is proved of the program by candidates for a Farkas vector y and a ray d, both in
    ADMM's coordinates (`admm.scale`). correcting: `correcting_rows(qp)`. tolerances (m,): by how
    much rows may be violated."""
    ray, unbounded = descent_ray(qp, matmul(d, T.T))
    if not y.shape[0]:
        return replace(Proof.none(ray, y), ray=ray, unbounded=unbounded)
    # Rows that z cannot move prove emptiness by themselves.
    fixed = jnp.where(E == 0, qp.bounds.violation(jnp.zeros_like(E)), 0.0)
    candidate = jnp.where(jnp.any(fixed != 0), fixed, E * y)
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
    by more than the rounding of the sum and of A'y (over the box of the bounded variables); a
    variable without such a row must have (A'y)_j at rounding level. A zero y proves nothing.
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
    reach = jnp.where(has_row, bound / jnp.abs(pivot), jnp.where(left <= noise, 0.0, jnp.inf))
    leak = jnp.where(reach > 0, (2 * left + noise) * reach, 0.0)
    bound = jnp.sum(jnp.concatenate([support + gamma * jnp.abs(support), leak]))
    proved, beyond = bound < 0, bound + jnp.sum(tolerances * jnp.abs(y)) < 0
    return jnp.where(proved, y, 0.0), proved, beyond


def to_length_one(v: Array) -> Array:
    """Return v divided by its infinity norm; 0 stays 0."""
    length = jnp.max(jnp.abs(v), initial=0.0)
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
