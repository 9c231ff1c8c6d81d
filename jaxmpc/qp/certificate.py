"""Proofs of infeasibility for one QP, made safe against rounding.

A vector y proves l ≤ Az ≤ u empty when A'y = 0 and Σ u y⁺ − l y⁻ < 0 (Farkas); a ball adds
radius·|y_b| to the sum, soft rows never take part. Iterates never satisfy A'y = 0 exactly.
Where a row bounds a single variable on both sides its multiplier can be chosen to absorb what is
left of A'y, exactly up to one rounding (Neumaier & Shcherbina 2004, safe bounds; here with the
box rows in the role of the correction). Convergence of y then buys tightness, not validity.
"""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.qp.precision import matmul, rounding
from jaxmpc.qp.problem import QP
from jaxmpc.qp.projection import Bounds

# Rounding of a ray's products beside that of residuals: rays are solutions of linear systems.
RAY = 25


def farkas(qp: QP, y: Array) -> tuple[Array, Array]:
    """The candidate y made into a certificate: returns (y, proved).

    y is scaled to length one, freed of pushes against infinite bounds, and corrected on rows
    that bound one variable. `proved` is True when Σ u y⁺ − l y⁻ is below zero by more than the
    rounding of the sum and of A'y (over the box of the bounded variables); a variable without
    such a row must have (A'y)_j at rounding level. A zero y proves nothing.
    """
    eps = jnp.finfo(y.dtype).eps
    m, n = qp.A.shape
    if m == 0:
        return y, jnp.asarray(False)
    bounds = qp.bounds.hard()
    l, u = bounds.l, bounds.u
    length = jnp.max(jnp.abs(y), initial=0.0)
    y = bounds.admissible(jnp.where(length > 0, y / jnp.where(length > 0, length, 1.0), 0.0))

    # Row i(j) bounds variable j alone. The choice rests on A only, so a batch shares it.
    single = (jnp.sum(qp.A != 0, axis=1) == 1) & (np.arange(m, dtype=np.int32) < m - sum(qp.balls))
    if qp.bounds.linear is not None:
        single = single & jnp.isinf(qp.bounds.linear)
    entries = jnp.where(single[:, None], jnp.abs(qp.A), 0.0)
    largest = (entries == jnp.max(entries, axis=0)).astype(jnp.int32)
    rows = np.arange(m, dtype=np.int32)[:, None]
    row = jnp.min(jnp.where(largest > 0, rows, np.int32(m - 1)), axis=0)
    pivot = jnp.where(
        entries[row, np.arange(n, dtype=np.int32)] > 0, qp.A[row, np.arange(n, dtype=np.int32)], 1.0
    )
    bounded = jnp.isfinite(l) & jnp.isfinite(u)
    has_row = (entries[row, np.arange(n, dtype=np.int32)] > 0) & bounded[row]
    y = y.at[row].add(jnp.where(has_row, -matmul(y, qp.A) / pivot, 0.0))

    left = jnp.abs(matmul(y, qp.A))
    terms = matmul(jnp.abs(y), jnp.abs(qp.A))
    gamma = 2 * (m + n + 2) * eps
    absorbed = has_row | (left <= gamma * terms)
    bound = jnp.where(bounded, jnp.maximum(jnp.abs(l), jnp.abs(u)), 0.0)
    reach = jnp.where(has_row, bound[row] / jnp.abs(pivot), 0.0)
    absolute = replace(bounds, l=-jnp.abs(l), u=jnp.abs(u))
    size = absolute.support(y)
    # What the correction leaves of A'y meets at most |z| ≤ reach.
    leak = jnp.sum((2 * left + gamma * terms) * reach)
    safe = bounds.support(y) + gamma * size + leak
    proved = jnp.all(absorbed) & (safe < 0) & jnp.any(y != 0)
    return jnp.where(proved, y, 0.0), proved


def recession(q: Array, H: Array, A: Array, bounds: Bounds) -> tuple[Array, Bounds]:
    """Rows that a ray of descent d satisfies: Hd = 0, q'd = −|q|, A d in the cone of directions
    that no bound stops. Soft rows count as hard."""
    l = jnp.where(jnp.isneginf(bounds.l), -jnp.inf, 0.0)
    u = jnp.where(jnp.isposinf(bounds.u), jnp.inf, 0.0)
    length = jnp.linalg.norm(q)
    along = q / jnp.where(length > 0, length, 1.0)
    down = -jnp.ones(1, q.dtype)
    still = jnp.zeros_like(q)
    cone = Bounds(jnp.concatenate([still, down, l]), jnp.concatenate([still, down, u]))
    return jnp.concatenate([H, along[None], A]), cone


def descent_ray(qp: QP, d: Array) -> tuple[Array, Array]:
    """The candidate direction d made into a ray of unbounded descent: returns (d, found).

    Pd = 0, q'd < 0, and A d ≤ 0 where u is finite, ≥ 0 where l is finite, each product to within
    the rounding of its own terms, (|P||d|)_i, |q|'|d| and (|A||d|)_i. Units of
    rows and variables play no part; a curvature that is rounding in this sense cannot be told from
    none. d is scaled to length one. A zero direction proves nothing.
    """
    tolerance = RAY * rounding(d.dtype)
    length = jnp.max(jnp.abs(d), initial=0.0)
    d = jnp.where(length > 0, d / jnp.where(length > 0, length, 1.0), 0.0)
    size = jnp.abs(d)
    Ad, noise = matmul(d, qp.A.T), tolerance * matmul(size, jnp.abs(qp.A).T)
    flat = jnp.all(jnp.abs(matmul(d, qp.P)) <= tolerance * matmul(size, jnp.abs(qp.P)))
    stays = jnp.all(jnp.isposinf(qp.u) | (Ad <= noise))
    stays = stays & jnp.all(jnp.isneginf(qp.l) | (Ad >= -noise))
    proved = flat & stays & (jnp.sum(qp.q * d) < -tolerance * jnp.sum(jnp.abs(qp.q) * size))
    return jnp.where(proved, d, 0.0), proved
