"""The policy of a stored robust problem, and the rows that it leaves, in rational arithmetic.

The plant is x⁺ = A x + B u + c + E w, w ∈ W. Floats are rational numbers: no rounding, until each
bound is rounded once, inwards for plans and outwards for half-spaces.

*Tightened*: u_k = v_k + K e_k with e_0 = 0 and e_{k+1} = (A + BK) e_k + E w_k. A row
a'x_k + d'u_{k−1} + b'u_k moves by t_i'E w_{k−1−i} for each earlier disturbance, with t_0 = a + K'b,
t_1 = (A + BK)'t_0 + K'd and t_{i+1} = (A + BK)'t_i; the largest sum of these is what its bounds
lose.

*Tubes*: u_k = v_k + K (x_k − z_k), x_0 − z_0 in a section S = center + {G ζ : |ζ_i| ≤ 1}. The rows
of z and v lose max {(a + K'b)'s : s ∈ S} at every step. With d, from the second step on, x_k − z_k
is (A + BK) s + E w with x_{k−1} − z_{k−1} = s; the first rate, K (x_0 − z_0) included, loses none.
"""

from collections.abc import Iterator, Mapping
from fractions import Fraction
from typing import Any

import numpy as np

# Rows of each step.
Steps = list[np.ndarray]


def fits(described: Any, n: int, m: int) -> bool:
    """Return whether a stored policy fits a problem of n coordinates (x, and u_{−1} where rates are
    limited) and m inputs."""
    rows, p = np.shape(described["E"])
    right = rows in (n, n - m) and p > 0 and _is_set(described["set"], p)
    if described["policy"] == "tube":
        section = described["section"]
        right = right and "generators" in section and _is_set(section, rows)
    affine = described["policy"] == "affine"
    return right and (affine or np.shape(described["gain"]) == (m, rows))


def _is_set(described: Any, p: int) -> bool:
    """Return whether this describes a set in R^p."""
    if "points" in described:
        return np.ndim(described["points"]) == 2 and np.shape(described["points"])[1] == p
    if "generators" in described:
        rows, _ = np.shape(described["generators"])
        return rows == p and np.shape(described["center"]) == (p,)
    return np.shape(described["lower"]) == np.shape(described["upper"]) == (p,)


def answer_shape(described: Mapping[str, Any], N: int, m: int) -> tuple[int, ...]:
    """Return the shape of what a policy has beside its plan: M (N, m, N, g) of an affine one, ζ
    (g,) of a tube."""
    if described["policy"] == "tube":
        return np.shape(described["section"]["generators"])[1:]
    return N, m, N, directions(described["set"])[1].shape[1]


def directions(set_: Mapping[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return center (p,) and Γ (p, g), in Fractions, of w = center + Γ ω with |ω_i| ≤ 1; a box has
    a direction for each coordinate in which it is not flat."""
    if "generators" in set_:
        return fractions(set_["center"]), fractions(set_["generators"])
    lower, upper = fractions(set_["lower"]), fractions(set_["upper"])
    half = (upper - lower) / 2
    return (lower + upper) / 2, np.diag(half)[:, half > 0] + Fraction(0)


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
    E, K, closed = _closed_loop(described, A, B)
    n = len(E)
    sums: dict[tuple[float, ...], list[tuple[Fraction, Fraction]]] = {}
    taken = [
        [_taken(described["set"], (*h, *d), k, n, E, K, closed, sums) for h, d in rows]
        for k, rows in enumerate(_each_row(H, D))
    ]
    return _both_ways(lower, upper, taken)


def _closed_loop(
    described: Mapping[str, Any], A: np.ndarray, B: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return E, K and A + B K of the states of the system, in Fractions."""
    E, K = fractions(described["E"]), fractions(described["gain"])
    n = len(E)
    return E, K, fractions(A[:n, :n]) + fractions(B[:n]) @ K


def tightened_by_section(
    described: Mapping[str, Any],
    A: np.ndarray,
    B: np.ndarray,
    H: Steps,
    D: Steps,
    lower: Steps,
    upper: Steps,
) -> tuple[tuple[Steps, Steps], tuple[Steps, Steps]]:
    """Return the same bounds of the rows of the nominal trajectory of a tube."""
    return _both_ways(lower, upper, taken_by_section(described, A, B, H, D))


def taken_by_section(
    described: Mapping[str, Any], A: np.ndarray, B: np.ndarray, H: Steps, D: Steps
) -> list[list[tuple[Fraction, Fraction]]]:
    """Return what a tube takes from the lower and the upper bound of each row of each step."""
    section, (E, K, closed) = described["section"], _closed_loop(described, A, B)
    n = len(E)
    nothing: dict[str, list[float]] = {"lower": [0.0] * E.shape[1], "upper": [0.0] * E.shape[1]}
    taken = []
    for k, rows in enumerate(_each_row(H, D)):
        here = []
        for h, d in rows:
            along, before, W = fractions(h[:n]) + fractions(d) @ K, fractions(h[n:]), nothing
            if any(before) and k == 0:
                here.append((Fraction(0), Fraction(0)))
                continue
            push = along @ E
            if any(before):
                along, W = along @ closed + before @ K, described["set"]
            low, high = (largest(section, g) + largest(W, w) for g, w in
                         ((-along, -push), (along, push)))  # fmt: skip
            here.append((low, high))
        taken.append(here)
    return taken


def first_rates(
    described: Mapping[str, Any],
    H: np.ndarray,
    D: np.ndarray,
    inner: tuple[np.ndarray, np.ndarray],
    outer: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """Return what K (x_0 − z_0) adds to the rows of rates at the first step, in terms of ζ (r, g),
    rounded, and the two pairs of bounds less the rest of it, rounded inwards and outwards."""
    K, E = fractions(described["gain"]), np.shape(described["E"])
    center, G = (fractions(described["section"][name]) for name in ("center", "generators"))
    rates: Any = H[:, E[0] :].any(axis=1) & D.any(axis=1)
    along = np.where(rates[:, None], fractions(D), np.array(Fraction(0), object)) @ K
    exact, middle = along @ G, along @ center
    near = exact.astype(float)
    off = abs(exact - fractions(near)).sum(axis=1) if exact.size else 0 * middle
    sides = []
    for i, ((lower, upper), sign) in enumerate(((inner, 1), (outer, -1))):
        taken = list(zip(sign * off - middle, sign * off + middle, strict=True))
        sides.append([side[0] for side in _both_ways([lower], [upper], [taken])[i]])
    return near, *sides


def _each_row(H: Steps, D: Steps) -> Iterator[list[tuple[list[float], list[float]]]]:
    """Yield the rows (h, d) of each step."""
    for H_k, D_k in zip(H, D, strict=True):
        yield list(zip(H_k.tolist(), D_k.tolist(), strict=True))


def _both_ways(
    lower: Steps, upper: Steps, taken: list[list[tuple[Fraction, Fraction]]]
) -> tuple[tuple[Steps, Steps], tuple[Steps, Steps]]:
    """Return the bounds less what is taken from each, rounded inwards and rounded outwards."""
    inner: tuple[Steps, Steps] = [], []
    outer: tuple[Steps, Steps] = [], []
    for *sides, here in zip(lower, upper, taken, strict=True):
        for j, (side, sign) in enumerate(zip(sides, (1, -1), strict=True)):
            each = [
                (value, value) if not np.isfinite(value) else _rounded(value, sign * moved[j])
                for value, moved in zip(side.tolist(), here, strict=True)
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
