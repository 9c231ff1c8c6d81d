"""Check affine policies, tubes and half-spaces about them without rounding, from what is stored.

Disturbances are w = center + Γ ω, |ω_i| ≤ 1. Under u_k = v_k + U_k ω the states are
x_k = x̄_k + X_k ω with

    x̄_{k+1} = A x̄_k + B v_k + c + E center,   X_{k+1} = A X_k + B U_k + [E Γ at ω_k],

and a row a'x_k + b'u_k is at most a'x̄_k + b'v_k + |a'X_k + b'U_k|₁. *Affine policies* have any U_k
in the columns of the steps before k, *tubes* U_k = K X_k and v_k + K (x̄_k − z_k) in place of v_k
(`StoredPolicies.closed_loop`). Both are convex: where policies keep all rows at some states, their
convex combination does at that of the states.

*Infeasible* (`AffineRows.more`): for multipliers y⁺, y⁻ ≥ 0 of the two sides of the rows and any
|Q_k| ≤ y⁺_k + y⁻_k, entry by entry, every feasible policy keeps

    Σ (y⁺ − y⁻)'(H x̄ + D v) + Σ_k Q_k∘(H_k X_k + D_k U_k) ≤ Σ y⁺'upper − y⁻'lower.

With Π_N = H_N'Q_N, Π_k = A'Π_{k+1} + H_k'Q_k the second sum is Σ_k Π_{k+1}∘[E Γ at ω_k] and
Σ_k (B'Π_{k+1} + D_k'Q_k)∘U_k. What a row of U_k counts up to is at most half the width of the
limits of its input. The first sum is that of `exact.beyond`, but for the drift E center.
"""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np

from jaxmpc.verify.exact import UNIT_ROUNDOFF, integers, inverse_of, ratio
from jaxmpc.verify.stored_policy import directions, fractions, taken_by_section
from jaxmpc.verify.stored_problem import Constraints, bits, nominal


class Dyadic(NamedTuple):
    """values / 2^e, an array of Python integers."""

    values: np.ndarray
    e: int

    @classmethod
    def of(cls, floats: Any) -> "Dyadic":
        """Return an array of floats; ±∞ become 0."""
        e = bits(floats)
        return cls(integers(floats, e), e)

    @classmethod
    def of_fractions(cls, values: np.ndarray) -> "Dyadic":
        """Return an array of Fractions whose denominators are powers of two."""
        e = max((v.denominator.bit_length() - 1 for v in values.ravel()), default=0)
        whole = np.array([int(v * 2**e) for v in values.ravel()], object)
        return cls(whole.reshape(values.shape), e)

    @property
    def T(self) -> "Dyadic":
        """Return the transpose."""
        return Dyadic(self.values.T, self.e)

    def head(self, count: int) -> "Dyadic":
        """Return the first rows, or entries."""
        return Dyadic(self.values[:count], self.e)

    def beside(self, other: "Dyadic", axis: int = 1) -> "Dyadic":
        """Return two matrices side by side, or with axis 0, as vectors may be, one above the
        other."""
        e = max(self.e, other.e)
        return Dyadic(np.concatenate([self.over(e), other.over(e)], axis), e)

    def columns(self, first: int, end: int | None) -> "Dyadic":
        """Return some of the columns."""
        return Dyadic(self.values[:, first:end], self.e)

    def over(self, e: int) -> np.ndarray:
        """Return the integers over a larger power of two."""
        return self.values * (1 << e - self.e)

    def times(self, other: "Dyadic") -> "Dyadic":
        """Return the product of two matrices, or of a matrix and a vector."""
        if not self.values.shape[-1]:
            return Dyadic(np.zeros((len(self.values), *other.values.shape[1:]), object), 0)
        return Dyadic(self.values @ other.values, self.e + other.e)

    def plus(self, other: "Dyadic", sign: int = 1) -> "Dyadic":
        """Return the sum, or the difference."""
        e = max(self.e, other.e)
        return Dyadic(self.over(e) + sign * other.over(e), e)

    def dot(self, other: "Dyadic") -> Fraction:
        """Return the sum of the products of their entries."""
        products = (self.values * other.values).ravel()
        return Fraction(int(sum(products)), 1 << self.e + other.e)


class Multipliers(NamedTuple):
    """Of the upper and lower bounds of the rows of each step (r_k,), ≥ 0, and of the columns that
    they owe to disturbances of the steps before, Q (r_k, k g)."""

    above: list[np.ndarray]
    below: list[np.ndarray]
    Q: list[np.ndarray]

    @property
    def difference(self) -> list[np.ndarray]:
        """Return above − below, rounded."""
        return [a - b for a, b in zip(self.above, self.below, strict=True)]


class AffineRows(NamedTuple):
    """What affine policies add to the rows of a nominal problem p: push E Γ (n, g) and middle
    E center (n,), in Fractions."""

    p: Constraints
    push: np.ndarray
    middle: np.ndarray

    def more(self, y: Multipliers, low: np.ndarray, high: np.ndarray) -> Fraction | None:
        """Return what multipliers add to the right-hand side of the half-space that `exact.beyond`
        gives for their difference; None where limits of inputs, low and high (N, m), that are
        needed are infinite."""
        p, g = self.p, self.push.shape[1]
        push, middle = Dyadic.of_fractions(self.push), Dyadic.of_fractions(self.middle)
        (y_N, Q_N, total), H_N = self._allowed(p.N, y), Dyadic.of(p.H[p.N])
        costate, Pi = H_N.T.times(y_N), H_N.T.times(Q_N)
        for k in range(p.N - 1, -1, -1):
            A, B, H, D = (Dyadic.of(v[k]) for v in (p.A, p.B, p.H, p.D))
            y_k, Q, shared = self._allowed(k, y)
            caused, Pi = Pi.columns(k * g, None), Pi.columns(0, k * g)
            total += shared - costate.dot(middle) - caused.dot(push)
            slope = B.T.times(Pi).plus(D.T.times(Q))
            for i, worst in enumerate(abs(slope.values).max(axis=1, initial=0)):
                if worst and not np.isfinite(high[k, i] - low[k, i]):
                    return None
                if worst:
                    width = Fraction(high[k, i]) - Fraction(low[k, i])
                    total += Fraction(int(worst), 1 << slope.e) * width / 2
            costate = A.T.times(costate).plus(H.T.times(y_k))
            Pi = A.T.times(Pi).plus(H.T.times(Q))
        return total

    def _allowed(self, k: int, y: Multipliers) -> tuple[Dyadic, Dyadic, Fraction]:
        """Return the multipliers y (r,) of the rows of step k as `exact.beyond` takes them, Q as
        large as they allow, and what both sides of a row cost beside their difference."""
        lower, upper = self.p.lower[k], self.p.upper[k]
        bounded = np.isfinite(lower) & np.isfinite(upper)
        value = y.above[k] - y.below[k]
        value = np.where(np.isinf(upper), np.minimum(value, 0.0), value)
        value = np.where(np.isinf(lower), np.maximum(value, 0.0), value)
        both = np.where(bounded, np.minimum(y.above[k], y.below[k]), 0.0)
        y_k, shared, Q = Dyadic.of(value), Dyadic.of(both), Dyadic.of(y.Q[k])
        most = Dyadic(abs(y_k.values), y_k.e).plus(Dyadic(2 * shared.values, shared.e))
        e = max(most.e, Q.e)
        limit = most.over(e)[:, None]
        Q = Dyadic(np.minimum(np.maximum(Q.over(e), -limit), limit), e)
        ends = (Dyadic.of(np.where(bounded, side, 0.0)) for side in (upper, lower))
        return y_k, Q, shared.dot(next(ends)) - shared.dot(next(ends))


class StoredPolicies:
    """The policies that a store holds for all of its states, and which of them are proved."""

    def __init__(self, plain: Mapping[str, Any], p: Constraints, arrays: Mapping[str, Any]) -> None:
        """Prove them all. plain: the stored problem, p: its constraints; arrays: of the store.
        Raises ValueError where their shapes do not fit each other."""
        self.p, self.rows, described = p, Constraints(nominal(plain)), plain["disturbance"]
        self.tube = described["policy"] == "tube"
        center, gamma = directions(described["set"])
        E = fractions(described["E"])
        push, middle = E @ gamma if gamma.size else 0 * E[:, :0], E @ center
        self.states = len(E)
        # Of u_{−1}, which is a part of the state where rates are limited.
        more = self.rows.sizes[0] - self.states
        push = np.vstack([push, np.full((more, push.shape[1]), Fraction(0), object)])
        middle = np.append(middle, [Fraction(0)] * more)
        self.push, self.middle = Dyadic.of_fractions(push), Dyadic.of_fractions(middle)
        self.affine = None
        if not self.tube and push.size:
            self.affine = AffineRows(self.rows, push, middle)
        if self.tube:
            self.gain = Dyadic.of(described["gain"])
            section = described["section"]
            self.section = Dyadic.of(section["center"]), Dyadic.of(section["generators"])
            r = self.rows
            taken = taken_by_section(described, r.A[0], r.B[0], r.H, r.D)
            columns = [np.array(k, object).reshape(-1, 2).T for k in taken]
            self.taken = [[Dyadic.of_fractions(v) for v in pair] for pair in columns]
        self.state, self.plan, self.answer = (
            np.asarray(arrays[f"policy_{name}"], float) for name in ("state", "plan", "answer")
        )
        self.corner = np.asarray(arrays["corner"], np.int64)
        d, count = len(p.axes), len(self.state)
        if self.corner.ndim != 2 or self.corner.shape[1] != d or not count:
            raise ValueError("policies and cones do not fit the axes of the store")
        if self.corner.size and not (0 <= self.corner.min() <= self.corner.max() < count):
            raise ValueError("a cone has a policy that is not stored")
        self.margins = np.array(list(map(self.margin, self.state, self.plan, self.answer)))
        edges = (self.state[self.corner] - self.state[-1]).transpose(0, 2, 1)
        self.inverses = np.linalg.pinv(edges) if len(edges) else edges
        self._exact: dict[int, tuple[np.ndarray, int, Dyadic, int]] = {}

    def start(self, theta: np.ndarray) -> np.ndarray:
        """Return the state (n,) of a point θ (d,) of the slice, or of all states."""
        n = self.rows.sizes[0]
        x = np.zeros(n)
        x[self.rows.others], x[self.rows.axes] = self.rows.low, theta
        return x

    def margin(self, theta: np.ndarray, plan: np.ndarray, answer: np.ndarray) -> float:
        """Return the least margin of all rows under the policy of a point, whatever disturbance;
        −∞ where it is none."""
        if not all(np.isfinite(v).all() for v in (theta, plan, answer)):
            return -np.inf
        x, N, g = self.start(theta), self.rows.N, self.push.values.shape[1]
        begins = np.unique(self.rows.moves, return_index=True)[1]
        if np.any(plan != plan[begins[self.rows.moves]]):
            return -np.inf  # a control horizon holds it
        if self.tube:
            within = 1.0 - float(np.abs(answer).max(initial=0.0))
            return min(within, *self.closed_loop(x, plan, answer))
        answers = answer.reshape(*plan.shape, N, g)
        late = np.triu(np.ones((N, N), bool))
        if np.any(answers.transpose(0, 2, 1, 3)[late]):
            return -np.inf  # it answers to what is not known yet
        return self.closed_loop(x, plan, answers.reshape(*plan.shape, N * g))[0]

    def closed_loop(
        self, x0: np.ndarray, plan: np.ndarray, answer: np.ndarray
    ) -> tuple[float, float]:
        """Return the least margin of all rows along the closed loop from x0 (n,), whatever
        disturbance, and that of the tightened ones along the nominal trajectory of a tube, else ∞.
        answer: M (N, m, N g), or ζ."""
        p, g = self.rows, self.push.values.shape[1]
        x, X = Dyadic.of(x0), Dyadic(np.zeros((len(x0), 0), object), 0)
        z, least, nominal_least = x, np.inf, np.inf
        if self.tube:
            center, G = self.section
            off = center.plus(G.times(Dyadic.of(answer)))
            if len(x0) > self.states:  # the first rate is that of the input that is applied
                off = off.beside(self.gain.times(off), 0)
            z = x.plus(off, -1)
        for k in range(p.N + 1):
            H = Dyadic.of(p.H[k])
            value, reach, planned = H.times(x), H.times(X), H.times(z)
            if k < p.N:
                A, B, D, v = (Dyadic.of(w) for w in (p.A[k], p.B[k], p.D[k], plan[k]))
                if self.tube:
                    off = x.plus(z, -1).head(self.states)
                    u, U = v.plus(self.gain.times(off)), self.gain.times(X.head(self.states))
                    z = A.times(z).plus(B.times(v)).plus(Dyadic.of(p.c[k]))
                else:
                    u, U = v, Dyadic.of(answer[k][:, : k * g])
                value, reach = value.plus(D.times(u)), reach.plus(D.times(U))
                planned = planned.plus(D.times(v))
                x = A.times(x).plus(B.times(u)).plus(Dyadic.of(p.c[k])).plus(self.middle)
                X = A.times(X).plus(B.times(U)).beside(self.push)
            # Of rows without disturbances before them the sum of no columns is 0.
            moved = Dyadic(np.array([sum(row) for row in abs(reach.values)], object), reach.e)
            least = min(least, self._room(k, value, (moved, moved)))
            if self.tube:
                if k == 0:  # u_{−1} itself is limited
                    still = (p.H[0][:, : self.states] == 0).all(axis=1) & ~p.D[0].any(axis=1)
                    e = max(value.e, planned.e)
                    planned = Dyadic(np.where(still, value.over(e), planned.over(e)), e)
                nominal_least = min(nominal_least, self._room(k, planned, self.taken[k]))
        return least, nominal_least

    def _room(self, k: int, value: Dyadic, taken: Sequence[Dyadic]) -> float:
        """Return the least room that values of the rows of step k leave to their lower and upper
        bounds, of which something is taken."""
        least = np.inf
        for bound, sign, less in zip(
            (self.rows.lower[k], self.rows.upper[k]), (-1, 1), taken, strict=True
        ):
            room = Dyadic.of(bound).plus(value, -1)
            room = Dyadic(sign * room.values, room.e).plus(less, -1)
            each = room.values[np.isfinite(bound)]
            least = min(least, *(ratio(int(v), 1 << room.e) for v in each), np.inf)
        return least

    def combine(
        self, points: np.ndarray, cone: np.ndarray, plans: np.ndarray, drawn: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the least margins (b,) of the policies of these points (b, d) in their cones, −∞
        where a point is no convex combination of the states of its cone, or one of their policies
        is not proved; which combinations are proved exactly, those that are drawn and those near
        rounding; and whether the plans (b, N, m) are those of the combinations, but for
        rounding."""
        center, corner, inverse = self.state[-1], self.corner[cone], self.inverses[cone]
        edges = (self.state[corner] - center).transpose(0, 2, 1)
        x = points - center
        share = np.einsum("bij,bj->bi", inverse, x)
        # share is off by no more than inverse times the residual, but for what inverse is off.
        size = np.abs(points) + np.abs(center)
        reach = np.abs(self.state[corner]).transpose(0, 2, 1) + np.abs(center)[:, None]
        size = size + np.einsum("bij,bj->bi", reach, np.abs(share))
        residual = np.abs(x - np.einsum("bij,bj->bi", edges, share))
        residual = residual + 4 * (x.shape[1] + 4) * UNIT_ROUNDOFF * size
        off = 2 * np.einsum("bij,bj->bi", np.abs(inverse), residual).max(axis=1, keepdims=True)
        near = np.abs(np.eye(x.shape[1]) - inverse @ edges).sum(axis=2).max(axis=1) < 0.25
        inside = near & (share >= off).all(axis=1) & ((share + off).sum(axis=1) <= 1 - 1e-15)
        exactly = drawn | ~inside
        for i in np.flatnonzero(exactly):
            inside[i] = self._holds(int(cone[i]), points[i])
        margin = np.minimum(self.margins[corner].min(axis=1), self.margins[-1])
        shift = (self.plan[corner] - self.plan[-1]).transpose(0, 2, 3, 1)
        expected = self.plan[-1] + np.einsum("bkmi,bi->bkm", shift, share)
        # Rounding of sums, in the units of each input; of the corners' inputs, that may cancel.
        scale = np.abs(self.plan[corner]).max(axis=(1, 2)) + np.abs(self.plan[-1]).max(axis=0)
        same = np.all(np.abs(plans - expected) <= 1e-9 * scale[:, None], axis=(1, 2))
        return np.where(inside, margin, -np.inf), exactly, same

    def _holds(self, cone: int, point: np.ndarray) -> bool:
        """Return whether a point is a convex combination of the states of a cone and the centre, by
        rational arithmetic."""
        if cone not in self._exact:
            center = Dyadic.of(self.state[-1])
            edges = Dyadic.of(self.state[self.corner[cone]].T)
            edges = edges.plus(Dyadic(center.values[:, None], center.e), -1)
            found = inverse_of(edges.values)
            if found is None:
                return False
            self._exact[cone] = *found, Dyadic(center.values, center.e), edges.e
        K, d, center, e = self._exact[cone]
        x = Dyadic.of(point).plus(center, -1)
        # edges / 2^e times λ is x / 2^(x.e), and edges times K is d.
        share, one = (K @ x.values) * (1 << e), d << x.e
        share, one = (share, one) if one > 0 else (-share, -one)
        return bool((share >= 0).all() and share.sum() <= one)
