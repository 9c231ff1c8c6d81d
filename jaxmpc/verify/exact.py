"""Check plans and half-spaces in exact arithmetic, without the code that made them.

Every float is a whole number times a power of two, and so are sums and products of floats. With all
data of a problem written as integers over one 2ᵉ, a state after k steps is integers over
2^((k+1)e): no rounding, no tolerance. What is checked is the problem as it is stored
(`stored_problem.Constraints`): x⁺ = Ax + Bu + c, rows lower ≤ Hx + Du ≤ upper, and a terminal
ellipsoid x'Px ≤ level. Of a robust problem the rows are tightened in rational arithmetic first
(`stored_policy.py`).

*Feasible* (`roll_out_exactly`): the plan, rolled out from the state, keeps every row. Equalities
are missed by rounding; there the plan counts that keeps them and differs by as little.

*Infeasible* (`beyond`): for any multipliers y_k of the rows, with the costates p_N = H_N'y_N,
p_k = A'p_{k+1} + H_k'y_k, every trajectory satisfies

    p_0'x_0 ≤ Σ_k σ(y_k) + Σ_{k<N} [ max over u of (−B'p_{k+1} − D_k'y_k)'u − c'p_{k+1} ],

σ(y) = upper'y⁺ − lower'y⁻: multiply the rows by y and insert the dynamics (weak duality). A
terminal ellipsoid adds Pv to p_N and √(level·v'Pv) to the right, for any v (Cauchy-Schwarz). A
state beyond that half-space starts no trajectory, wherever the multipliers came from.
"""

import math
from collections.abc import Iterator
from fractions import Fraction

import numpy as np

from jaxmpc.arrays import Reals
from jaxmpc.verify.stored_problem import Constraints

UNIT_ROUNDOFF = 2.0**-53
# Change of the inputs, relative to the largest, up to which it counts as rounding.
INPUT_ROUNDING = 1e-9


def integers(values: Reals, e: int) -> np.ndarray:
    """Return values·2ᵉ as an array of Python integers; ±∞ become 0."""
    values = np.asarray(values, float)
    mantissa, power = np.frexp(np.where(np.isfinite(values), values, 0.0))
    whole = (mantissa * 2.0**53).astype(np.int64)
    shift = (power + e - 53).astype(int)
    found = [
        int(w) << s if s >= 0 else int(w) >> -s  # what is shifted out is zero
        for w, s in zip(whole.ravel().tolist(), shift.ravel().tolist(), strict=True)
    ]
    return np.array(found, object).reshape(values.shape)


def roll_out_exactly(p: Constraints, starts: np.ndarray, plans: np.ndarray) -> np.ndarray:
    """Return the least margin (b,) of all rows along plans (b, N, m) from states (b, n), computed
    without rounding: negative where a plan breaks a limit.

    Where rows are equalities, which no plan of floats keeps exactly, the margin is that of the
    plan with the rational change of its inputs that makes up for what it misses of them, less than
    INPUT_ROUNDING of the largest input; a larger change counts as a broken limit.
    """
    rows, X = p.equalities
    e = p.exponent(starts, plans, X)
    x, u, one = integers(starts, e), integers(plans, e), 1
    least = np.full(len(starts), np.inf)
    if rows:
        change = integers(X, e)
        missed = _at(p, e, rows, x, u, one, p.upper)
        G = -_at(p, e, rows, np.zeros((len(X), p.sizes[0]), object), change, 0, None).T
        inverse = inverse_of(G)
        if inverse is not None:
            K, one = inverse  # the inverse of G is K / one
            moved = np.tensordot(missed @ K.T, change, axes=1)
            u, x = u * one + moved, x * one
            size = np.array([max(map(abs, v.ravel())) / (one << e) for v in moved])
            much = size > INPUT_ROUNDING * (1 + np.abs(plans).max(axis=(1, 2)))
            least = np.where(much, -size, least)
    for k, value, x_k in _values(p, e, x, u, one):
        end = x_k
        scale = one << (k + 2) * e
        for bound, sign in ((p.upper[k], 1), (p.lower[k], -1)):
            there = np.isfinite(bound)
            room = sign * (integers(bound, e) * (one << (k + 1) * e) - value)[:, there]
            if room.shape[1]:
                least = np.minimum(least, [min(row) / scale for row in room])
    if p.P is not None:
        square = np.sum((end @ integers(p.P, e)) * end, axis=1)  # over 2^((2N+3)e)
        power = (2 * p.N + 3) * e
        room = integers(p.level, e) * (one**2 << power - e) - square
        least = np.minimum(least, [v / (one**2 << power) for v in room])
    return least


def _values(
    p: Constraints, e: int, x: np.ndarray, u: np.ndarray, one: int
) -> Iterator[tuple[int, np.ndarray, np.ndarray]]:
    """Yield k, the values (b, rows) of its rows, over 2^((k+2)e), and x_k, over 2^((k+1)e), along
    inputs u (b, N, m) over 2ᵉ from x (b, n). All are multiplied by the integer `one`."""
    motion = _motion(p, e)
    for k in range(p.N + 1):
        later = 1 << k * e
        value = x @ integers(p.H[k], e).T
        if k < p.N:
            value = value + (u[:, k] @ integers(p.D[k], e).T) * later
        yield k, value, x
        if k < p.N:
            A, B, c = motion[k]
            x = x @ A.T + (u[:, k] @ B.T) * later + c * (one * (later << e))


def _motion(p: Constraints, e: int) -> list[tuple[np.ndarray, ...]]:
    """Return A, B and c of each step as integers over 2ᵉ."""
    found: list[tuple[np.ndarray, ...]] = []
    for k, here in enumerate(zip(p.A, p.B, p.c, strict=True)):
        before = found[-1] if k else ()
        same = k and here[0] is p.A[k - 1] and here[1] is p.B[k - 1] and here[2] is p.c[k - 1]
        found.append(before if same else tuple(integers(v, e) for v in here))
    return found


def _at(
    p: Constraints,
    e: int,
    rows: list[tuple[int, int]],
    x: np.ndarray,
    u: np.ndarray,
    one: int,
    bounds: list[np.ndarray] | None,
) -> np.ndarray:
    """Return bounds (None: 0) less the values (b, q) of rows (k, i), over 2^((N+2)e)."""
    found = []
    for k, value, _ in _values(p, e, x, u, one):
        for i in (i for at, i in rows if at == k):
            bound = 0 if bounds is None else int(integers(bounds[k][i], e)) * (one << (k + 1) * e)
            found.append((bound - value[:, i]) * (1 << (p.N - k) * e))
    return np.stack(found, axis=1)


def inverse_of(G: np.ndarray) -> tuple[np.ndarray, int] | None:
    """Return integers K (q, q) and d with G K = d I; None for a singular matrix G of integers."""
    q = len(G)
    rows = [
        [*(Fraction(int(v)) for v in row), *(Fraction(i == j) for j in range(q))]
        for i, row in enumerate(G)
    ]
    for i in range(q):
        pivot = next((j for j in range(i, q) if rows[j][i]), None)
        if pivot is None:
            return None
        rows[i], rows[pivot] = rows[pivot], rows[i]
        rows[i] = [v / rows[i][i] for v in rows[i]]
        for j in range(q):
            if j != i and rows[j][i]:
                rows[j] = [v - rows[j][i] * w for v, w in zip(rows[j], rows[i], strict=True)]
    inverse = [row[q:] for row in rows]
    d = math.lcm(*(v.denominator for row in inverse for v in row))
    return np.array([[int(v * d) for v in row] for row in inverse], object).reshape(q, q), d


def roll_out_in_floats(p: Constraints, starts: np.ndarray, plans: np.ndarray) -> np.ndarray:
    """Return the same in float64, less a bound on its rounding: at least so much room is left."""
    n, m = p.sizes
    gamma = 4 * (n + m + 2) * UNIT_ROUNDOFF
    x, error, least = starts, np.zeros_like(starts), np.full(len(starts), np.inf)
    for k in range(p.N + 1):
        u = plans[:, k] if k < p.N else 0 * plans[:, 0]
        value = x @ p.H[k].T + u @ p.D[k].T
        size = np.abs(x) @ np.abs(p.H[k]).T + np.abs(u) @ np.abs(p.D[k]).T
        off = error @ np.abs(p.H[k]).T + gamma * (size + np.abs(value))
        room = np.minimum(p.upper[k] - value, value - p.lower[k]) - off
        least = np.minimum(least, room.min(axis=1, initial=np.inf))
        if k < p.N:
            A, B, c = p.A[k], p.B[k], p.c[k]
            size = np.abs(x) @ np.abs(A).T + np.abs(u) @ np.abs(B).T + np.abs(c)
            error = 1.01 * error @ np.abs(A).T + gamma * size
            x = x @ A.T + u @ B.T + c
    if p.P is not None:
        whole = np.abs(x) + error
        square = np.einsum("bi,ij,bj->b", x, p.P, x)
        off = np.einsum("bi,ij,bj->b", whole, np.abs(p.P), error * 2 + gamma * n * whole)
        least = np.minimum(least, p.level - square - off - gamma * p.level)
    return least


def beyond(
    p: Constraints,
    y: list[np.ndarray],
    points: np.ndarray,
    box: tuple[np.ndarray, ...],
    more: Fraction = Fraction(0),
) -> np.ndarray:
    """Return by how much points (b, d) violate the half-space that multipliers imply, relative to
    the largest entry of its normal; −∞ where it implies none. Computed without rounding.

    y: of the rows of each step, y > 0 on the upper bound and y < 0 on the lower; then, of a
    terminal ellipsoid, the vector v of v'Px ≤ √(level·v'Pv). box: lower and upper bounds (moves, m)
    of the inputs and of the states that are not mapped, ±∞ where there are none. more: what the
    right-hand side of the half-space has beside the terms at the top of this file.
    """
    n, (low, high, others_low, others_high) = p.sizes[0], box
    e = p.exponent(points, *box, *y)
    motion = _motion(p, e)
    # Sums are over 2^top. The costate p_k is over 2^((N−k+2)e): each step multiplies by A.
    top = (p.N + 4) * e
    total = math.ceil(more * (1 << top))
    lowers, uppers = p.widest
    costate, slopes = np.zeros(n, object), np.zeros(low.shape, object)
    for k in range(p.N, -1, -1):
        weight = np.where(np.isinf(uppers[k]), np.minimum(y[k], 0.0), y[k])
        weight = np.where(np.isinf(lowers[k]), np.maximum(weight, 0.0), weight)
        w = integers(weight, e)
        bound = np.where(weight > 0, uppers[k], np.where(weight < 0, lowers[k], 0.0))
        total += int(w @ integers(bound, e)) << top - 2 * e
        if k < p.N:
            A, B, c = motion[k]
            total -= int(costate @ c) << top - (p.N - k + 2) * e
            slopes[p.moves[k]] -= (costate @ B) * (1 << top - e - (p.N - k + 2) * e)
            slopes[p.moves[k]] -= (w @ integers(p.D[k], e)) * (1 << top - 3 * e)
            costate = costate @ A
        elif p.P is not None:
            v, P = integers(y[-1], e), integers(p.P, e)
            # level·v'Pv is over 2^(4e), its root over 2^(2e), rounded up.
            square = int(v @ P @ v) * int(integers(p.level, e))
            root = math.isqrt(max(square, 0))
            total += root + (root * root < square) << top - 2 * e
            costate = costate + v @ P
        costate = costate + (w @ integers(p.H[k], e)) * (1 << (p.N - k) * e)
    costate = costate * (1 << e)  # now over 2^(top − e), as the slopes are
    for normal, lower, upper in (
        *zip(slopes.ravel(), low.ravel(), high.ravel(), strict=True),
        *zip(-costate[p.others], others_low, others_high, strict=True),
    ):
        worth = upper if normal > 0 else lower
        if normal and not np.isfinite(worth):
            return np.full(len(points), -np.inf)
        total += int(normal) * int(integers(worth, e)) if normal else 0
    normal = costate[p.axes]
    largest = max(abs(int(v)) for v in normal)
    if not largest:  # 0'θ ≤ b excludes every θ if b < 0
        return np.full(len(points), np.inf if total < 0 else -np.inf)
    left = integers(points, e) @ normal - total
    return np.array([ratio(int(v), largest << e) for v in left])


def ratio(over: int, under: int) -> float:
    """Return over / under, not rounded to zero."""
    return over / under or math.copysign(5e-324, over) * (over != 0)
