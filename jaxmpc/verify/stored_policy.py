"""The policy of a stored robust problem, and the rows that it leaves, in rational arithmetic.

The plant is x⁺ = A x + B u + c + E w, w ∈ W, the policy u_k = v_k + K e_k with e_0 = 0 and
e_{k+1} = (A + BK) e_k + E w_k. A row a'x_k + d'u_{k−1} + b'u_k moves by t_i'E w_{k−1−i} for each
earlier disturbance, with t_0 = a + K'b, t_1 = (A + BK)'t_0 + K'd and t_{i+1} = (A + BK)'t_i; the
largest sum of these is what its bounds lose. Floats are rational numbers: no rounding, until each
bound is rounded once, inwards for plans and outwards for half-spaces.
"""

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

import numpy as np

# Rows of each step.
Steps = list[np.ndarray]


def fits(described: Any, n: int, m: int) -> bool:
    """Return whether a stored policy fits a problem of n coordinates (x, and u_{−1} where rates are
    limited) and m inputs."""
    rows, p = np.shape(described["E"])
    set_, right = described["set"], rows in (n, n - m) and p > 0
    right = right and np.shape(described["gain"]) == (m, rows)
    if "points" in set_:
        return right and np.ndim(set_["points"]) == 2 and np.shape(set_["points"])[1] == p
    if "generators" in set_:
        same = np.shape(set_["center"]) == (p,)
        return right and same and np.shape(set_["generators"])[0] == p
    return right and np.shape(set_["lower"]) == np.shape(set_["upper"]) == (p,)


def fractions(values: Any) -> np.ndarray:
    """Return an array of Fractions, each exactly the float it comes from."""
    return np.asarray(np.frompyfunc(Fraction, 1, 1)(np.asarray(values, np.float64)), object)


def largest(set_: Mapping[str, Any], g: np.ndarray) -> Fraction:
    """Return max g'w over a stored set, g (p,) of Fractions."""
    if "points" in set_:
        return max(fractions(set_["points"]) @ g)
    if "generators" in set_:
        along = abs(g @ fractions(set_["generators"]))
        return fractions(set_["center"]) @ g + along.sum()
    ends = fractions(set_["lower"]) * g, fractions(set_["upper"]) * g
    return np.maximum(*ends).sum()


def tightened(
    described: Mapping[str, Any],
    A: np.ndarray,
    B: np.ndarray,
    H: Steps,
    D: Steps,
    lower: Steps,
    upper: Steps,
) -> tuple[tuple[Steps, Steps], tuple[Steps, Steps]]:
    """Return (lower, upper) of the rows of each step k = 0..N, rounded inwards, and the same
    rounded outwards. A, B: of the stored problem, whose state ends with u_{−1} where rates are
    limited."""
    E, K = fractions(described["E"]), fractions(described["gain"])
    n = len(E)
    closed = fractions(A[:n, :n]) + fractions(B[:n]) @ K
    sums: dict[tuple[float, ...], list[tuple[Fraction, Fraction]]] = {}
    inner: tuple[Steps, Steps] = [], []
    outer: tuple[Steps, Steps] = [], []
    for k, (H_k, D_k, *sides) in enumerate(zip(H, D, lower, upper, strict=True)):
        rows = [(*h, *d) for h, d in zip(H_k.tolist(), D_k.tolist(), strict=True)]
        taken = [_taken(described["set"], row, k, n, E, K, closed, sums) for row in rows]
        for j, (side, sign) in enumerate(zip(sides, (1, -1), strict=True)):
            each = [
                (value, value) if not np.isfinite(value) else _rounded(value, sign * moved[j])
                for value, moved in zip(side.tolist(), taken, strict=True)
            ]
            ends = np.reshape(each, (-1, 2))
            inner[j].append(ends[:, 1 - j])
            outer[j].append(ends[:, j])
    return inner, outer


def _taken(
    set_: Mapping[str, Any],
    row: tuple[float, ...],
    k: int,
    n: int,
    E: np.ndarray,
    K: np.ndarray,
    closed: np.ndarray,
    sums: dict[tuple[float, ...], list[tuple[Fraction, Fraction]]],
) -> tuple[Fraction, Fraction]:
    """Return what the disturbances before step k take from the lower and the upper bound of a row
    (H, D); sums keeps those of each row for the steps so far."""
    m = len(K)
    values = fractions(row)
    a, before, b = values[:n], values[n : len(row) - m], values[len(row) - m :]
    found = sums.setdefault(row, [(Fraction(0), Fraction(0))])
    if len(found) <= k:
        t = a + b @ K
        for i in range(k):
            if i == 1:
                t = t @ closed + (before @ K if len(before) else 0)
            elif i > 1:
                t = t @ closed
            if len(found) <= i + 1:
                low, high = found[i]
                g = t @ E
                found.append((low + largest(set_, -g), high + largest(set_, g)))
    return found[k]


def _rounded(value: float, moved: Fraction) -> tuple[float, float]:
    """Return the floats next below and next above value + moved, both the sum where it is one."""
    exact = Fraction(value) + moved
    near = float(exact)
    low = near if Fraction(near) <= exact else float(np.nextafter(near, -np.inf))
    high = near if Fraction(near) >= exact else float(np.nextafter(near, np.inf))
    return low, high
