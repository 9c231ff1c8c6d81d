"""How good an answer to a QP is: residuals in float64, proofs of infeasibility without rounding."""

from fractions import Fraction
from typing import Any

import numpy as np

import jaxmpc as jm


def residual_terms(qp: jm.QP, z: Any, y: Any) -> list[tuple[np.ndarray, np.ndarray]]:
    """Primal residual, dual residual and gap, entry by entry, each with the sum of the absolute
    terms that it is a difference of. A push against a bound that is not there counts as no push:
    the dual residual then shows what it was worth."""
    z, y = np.asarray(z, np.float64), np.asarray(y, np.float64)
    y = np.where(((y > 0) & np.isposinf(qp.u)) | ((y < 0) & np.isneginf(qp.l)), 0.0, y)
    Az = qp.A @ z
    met = np.clip(Az, qp.l, qp.u)
    support = np.where(y > 0, qp.u, np.where(y < 0, qp.l, 0.0)) * y
    size_z, size_y = np.abs(z), np.abs(y)
    linear = np.abs(qp.P) @ size_z + np.abs(qp.q)
    return [
        (Az - met, np.abs(qp.A) @ size_z + np.abs(met)),
        (qp.P @ z + qp.q + y @ qp.A, linear + size_y @ np.abs(qp.A)),
        (
            np.array([z @ qp.P @ z + qp.q @ z + support.sum()]),
            np.array([size_z @ linear + np.abs(support).sum()]),
        ),
    ]


def residuals(qp: jm.QP, z: Any, y: Any) -> np.ndarray:
    """Largest entry of primal residual, dual residual and gap."""
    return np.array([np.abs(value).max(initial=0.0) for value, _ in residual_terms(qp, z, y)])


def product(a: np.ndarray, B: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """a'B and |a|'|B| as Fractions, without rounding."""
    a, B = a[a != 0], B[a != 0]
    rational = np.vectorize(lambda v: Fraction(float(v)), otypes=[object])
    if not a.size:
        zero = rational(np.zeros(B.shape[1:]))
        return zero, zero
    a, B = rational(a), rational(B)
    return a @ B, abs(a) @ abs(B)


def proves_empty(qp: jm.QP, y: np.ndarray, tolerance: float) -> bool:
    """A'y = 0 and support Σ u y⁺ − l y⁻ < 0, so that 0 = y'Az ≤ support fails for every z. Where a
    row of its own keeps |z_j| ≤ reach_j, (A'y)_j may differ from 0 if reach_j |(A'y)_j| is paid."""
    bound = np.where(y > 0, qp.u, np.where(y < 0, qp.l, 0.0))
    if not (np.any(y) and np.all(np.isfinite(y)) and np.all(np.isfinite(bound))):
        return False
    tolerance, (left, size) = Fraction(tolerance), product(y, qp.A)
    support, support_size = product(y, bound)
    own = (np.count_nonzero(qp.A, axis=1) == 1) & np.isfinite(qp.l) & np.isfinite(qp.u)
    for j, (value, terms) in enumerate(zip(left, size, strict=True)):
        rows = np.flatnonzero(own & (qp.A[:, j] != 0))
        if rows.size:
            limits = [max(abs(Fraction(qp.l[i])), abs(Fraction(qp.u[i]))) for i in rows]
            reach = min(b / abs(Fraction(qp.A[i, j])) for b, i in zip(limits, rows, strict=True))
            support += reach * abs(value)
        elif abs(value) > tolerance * terms:
            return False
    return bool(support < -tolerance * support_size)


def proves_unbounded(qp: jm.QP, d: np.ndarray, tolerance: float) -> bool:
    """Pd = 0, A d ≤ 0 where u is finite and ≥ 0 where l is, q'd < 0."""
    if not (np.any(d) and np.all(np.isfinite(d))):
        return False
    tolerance, (curved, curved_size) = Fraction(tolerance), product(d, qp.P)
    moved, moved_size = product(d, qp.A.T)
    slope, slope_size = product(d, qp.q)
    stays = (np.isposinf(qp.u) | (moved <= tolerance * moved_size)) & (
        np.isneginf(qp.l) | (moved >= -tolerance * moved_size)
    )
    flat = np.all(abs(curved) <= tolerance * curved_size)
    return bool(flat and np.all(stays) and slope < -tolerance * slope_size)
