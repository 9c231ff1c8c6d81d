"""Independent checks in exact rational arithmetic. Nothing here uses the library's algorithms.

A float64 is a rational number, so the feasible set of a planar problem with the very data that
the library is given can be found without any rounding, by the backward recursion
S_k = X_k ∩ A⁻¹(S_{k+1} − c ⊕ −B U) on polygons.
"""

from dataclasses import dataclass
from fractions import Fraction as Q

import numpy as np

import jaxmpc as jm
from jaxmpc.sets.convex_sets import Ellipsoid


def rational(array) -> list:
    """Nested lists of Fractions, each exactly the float it comes from."""
    array = np.asarray(array, np.float64)
    return [rational(row) for row in array] if array.ndim else Q(float(array))


def dot(a, b) -> Q:
    """Exact a'b."""
    return sum((x * y for x, y in zip(a, b, strict=True)), Q(0))


def two_sided(set_) -> list:
    """Rows (h, lower, upper) of a set as Fractions; None for an infinite bound."""
    if set_ is None:
        return []
    if isinstance(set_, jm.Box):
        H, lower, upper = np.eye(len(set_.lower)), set_.lower, set_.upper
    else:
        H, lower, upper = set_.H, np.full(len(set_.h), -np.inf), set_.h
    limit = lambda v: Q(float(v)) if np.isfinite(v) else None
    return [(rational(h), limit(lo), limit(hi)) for h, lo, hi in zip(H, lower, upper, strict=True)]


def holds(rows, x) -> bool:
    """True if x keeps every row, exactly."""
    values = [(dot(h, x), lo, hi) for h, lo, hi in rows]
    return all((lo is None or lo <= v) and (hi is None or v <= hi) for v, lo, hi in values)


def steps_of(mpc, rows=None) -> tuple:
    """The k at which the state limits hold, or those of an `Outputs`."""
    N = mpc.horizon
    steps = mpc.constrained_stages
    if steps is None:
        steps = range(N) if mpc.constrain_initial else range(1, N)
    if rows is None:
        return tuple(steps)
    if rows.stages is not None:
        return tuple(rows.stages)
    return tuple(k for k in steps if k < N or rows.D is None)


def stage_rows(mpc, k) -> list:
    """Hard rows on (x_k, u_k), or on x_N, as (h_x, h_u, lower, upper) in Fractions. No rates."""
    n, m = np.shape(mpc.system.B)
    still, free = [Q(0)] * m, [Q(0)] * n
    found = []
    if k < mpc.horizon:
        found += [(free, h, lo, hi) for h, lo, hi in two_sided(mpc.inputs)]
    if k in steps_of(mpc):
        found += [(h, still, lo, hi) for h, lo, hi in two_sided(mpc.states)]
    if k == mpc.horizon and not isinstance(mpc.terminal_set, Ellipsoid):
        found += [(h, still, lo, hi) for h, lo, hi in two_sided(mpc.terminal_set)]
    every = mpc.outputs if isinstance(mpc.outputs, tuple | list) else (mpc.outputs,)
    for rows in every:
        if k in steps_of(mpc, rows):
            D = np.zeros((len(rows.C), m)) if rows.D is None else rows.D
            limit = lambda v: Q(float(v)) if np.isfinite(v) else None
            bounds = zip(map(limit, rows.lower), map(limit, rows.upper), strict=True)
            both = zip(rational(rows.C), rational(D), bounds, strict=True)
            found += [(h, d, lo, hi) for h, d, (lo, hi) in both]
    return found


def keeps_all_rows(mpc, x0, plan) -> bool:
    """True if the inputs (N, m) keep every hard constraint from x0, exactly.

    x0 is (x, u_{−1}) where input rates are limited.
    """
    A, B = rational(mpc.system.A), rational(mpc.system.B)
    c = [Q(0)] * len(A) if mpc.system.c is None else rational(mpc.system.c)
    x, before = rational(x0)[: len(A)], rational(x0)[len(A) :]
    limit = mpc.input_rate_limit
    if limit is not None and not isinstance(limit, jm.Box):
        limit = np.broadcast_to(np.asarray(limit, float), np.shape(B[0]))
        limit = jm.Box(-limit, limit)
    inputs = rational(plan)
    moves = range(mpc.horizon)
    if isinstance(mpc.control_horizon, int):
        moves = [min(k, mpc.control_horizon - 1) for k in moves]
    elif mpc.control_horizon is not None:
        moves = [i for i, length in enumerate(mpc.control_horizon) for _ in range(length)]
    for k, u in enumerate(inputs):
        if k and moves[k] == moves[k - 1] and u != inputs[k - 1]:
            return False
        if not holds([(hx + hu, lo, hi) for hx, hu, lo, hi in stage_rows(mpc, k)], x + u):
            return False
        if limit is not None:
            if not holds(two_sided(limit), [a - b for a, b in zip(u, before, strict=True)]):
                return False
            before = u
        x = [dot(a, x) + dot(b, u) + drift for a, b, drift in zip(A, B, c, strict=True)]
    if not holds([(hx, lo, hi) for hx, _, lo, hi in stage_rows(mpc, mpc.horizon)], x):
        return False
    if isinstance(mpc.terminal_set, Ellipsoid):
        level = Q(float(mpc.terminal_set.level))
        return dot(x, [dot(row, x) for row in rational(mpc.terminal_set.P)]) <= level
    return True


def proves_empty(A, l, u, y) -> bool:
    """True if y proves {z: l ≤ Az ≤ u} empty, exactly: Σ u y⁺ − l y⁻ < min (A'y)'z over the box
    that rows of a single entry put around z; a variable without such a box must have (A'y)_j = 0.
    """
    y, rows = rational(y), rational(A)
    support = Q(0)
    for value, lo, hi in zip(y, l, u, strict=True):
        bound = hi if value > 0 else lo
        if value != 0 and not np.isfinite(bound):
            return False
        support += value * Q(float(bound)) if value != 0 else 0
    least = Q(0)
    for j in range(len(rows[0])):
        left = dot([row[j] for row in rows], y)
        if left == 0:
            continue
        values = []
        for row, lo, hi in zip(rows, l, u, strict=True):
            entries = [i for i, v in enumerate(row) if v != 0]
            if entries == [j] and np.isfinite(lo) and np.isfinite(hi):
                values.append(sorted([Q(float(lo)) / row[j], Q(float(hi)) / row[j]]))
        if not values:
            return False
        # Any one of the boxes is valid; the best one proves most.
        least += max(min(left * lo, left * hi) for lo, hi in values)
    return support < least


@dataclass(frozen=True)
class Polygon:
    """A convex polygon: vertices counter-clockwise, pairs of Fractions."""

    vertices: tuple

    @property
    def area(self) -> Q:
        """Exact area (shoelace formula)."""
        v = self.vertices
        return sum(p[0] * q[1] - p[1] * q[0] for p, q in zip(v, v[1:] + v[:1], strict=True)) / 2

    @property
    def facets(self) -> list:
        """[(a, b)] with a'x ≤ b on the polygon."""
        v = self.vertices
        normals = [(q[1] - p[1], p[0] - q[0]) for p, q in zip(v, v[1:] + v[:1], strict=True)]
        return [(a, dot(a, p)) for a, p in zip(normals, v, strict=True)]

    def rows(self) -> tuple:
        """(a, b) of the facets, (k, 2) and (k,), rounded to floats."""
        a, b = zip(*self.facets, strict=True)
        return np.array(a, float), np.array(b, float)

    def support(self, a) -> Q:
        """Exact maximum of a'x."""
        a = rational(a)
        return max(dot(a, v) for v in self.vertices)

    def contains(self, points) -> np.ndarray:
        """Exact membership of float points (B, 2). Floats decide where they are sure to."""
        points = np.asarray(points, float)
        inside = np.ones(len(points), bool)
        for a, b in self.facets:
            scale = max(abs(a[0]), abs(a[1]))
            a, b = (a[0] / scale, a[1] / scale), b / scale
            value = points @ np.array([float(a[0]), float(a[1])]) - float(b)
            sure = np.abs(value) > 1e-13 * (1 + np.abs(points).sum(axis=1) + abs(float(b)))
            inside &= np.where(sure, value < 0, True)
            for i in np.flatnonzero(~sure & inside):
                inside[i] = dot(a, rational(points[i])) <= b
        return inside

    def distance(self, points) -> np.ndarray:
        """Least facet slack |b − a'x|/|a| of each point, as floats: how near to a tie it is."""
        slack = [
            (float(b) - points @ np.array([float(a[0]), float(a[1])]))
            / np.hypot(float(a[0]), float(a[1]))
            for a, b in self.facets
        ]
        return np.abs(np.min(slack, axis=0))

    def clip(self, a, b) -> "Polygon":
        """The part with a'x ≤ b (Sutherland & Hodgman)."""
        v, kept = self.vertices, []
        for p, q in zip(v, v[1:] + v[:1], strict=True):
            s, t = dot(a, p) - b, dot(a, q) - b
            if s <= 0:
                kept.append(p)
            if (s < 0 < t) or (t < 0 < s):
                w = s / (s - t)
                kept.append((p[0] + w * (q[0] - p[0]), p[1] + w * (q[1] - p[1])))
        return hull(kept)

    def within(self, rows) -> "Polygon":
        """The part that keeps two-sided rows."""
        body = self
        for h, lower, upper in rows:
            body = body if upper is None else body.clip(h, upper)
            body = body if lower is None else body.clip([-v for v in h], -lower)
        return body


def hull(points) -> Polygon:
    """Exact convex hull without collinear points (Andrew's monotone chain)."""
    points = sorted(set(points))

    def chain(points):
        out = []
        for p in points:
            while len(out) > 1 and (
                (out[-1][0] - out[-2][0]) * (p[1] - out[-2][1])
                <= (out[-1][1] - out[-2][1]) * (p[0] - out[-2][0])
            ):
                out.pop()
            out.append(p)
        return out[:-1]

    return Polygon(tuple(chain(points) + chain(points[::-1])) if len(points) > 2 else tuple(points))


def feasible_polygon(mpc) -> Polygon:
    """Exact feasible set of a planar problem with bounded sets and inputs, invertible A."""
    (a, b), (c, d) = rational(mpc.system.A)
    drift = [Q(0)] * 2 if mpc.system.c is None else rational(mpc.system.c)
    determinant = a * d - b * c
    back = lambda p: (
        (d * (p[0] - drift[0]) - b * (p[1] - drift[1])) / determinant,
        (a * (p[1] - drift[1]) - c * (p[0] - drift[0])) / determinant,
    )
    far = Q(10) ** 6
    plane = Polygon(((-far, -far), (far, -far), (far, far), (-far, far)))
    states = two_sided(mpc.states)
    body = plane.within(two_sided(mpc.terminal_set)) if mpc.terminal_set is not None else None
    for k in reversed(range(mpc.horizon)):
        if body is not None:
            points = body.vertices
            for column, (_, lo, hi) in zip(
                zip(*rational(mpc.system.B), strict=True), two_sided(mpc.inputs), strict=True
            ):
                points = hull(
                    [(p[0] - column[0] * u, p[1] - column[1] * u) for p in points for u in (lo, hi)]
                ).vertices
            body = hull([back(p) for p in points])
        if k > 0 or mpc.constrain_initial:
            body = (plane if body is None else body).within(states)
    return body


def eliminate(rows) -> list:
    """Rows (h, b), h'v ≤ b, of the projection that drops the last entry of v (Fourier, Motzkin)."""
    up, down = ([r for r in rows if sign * r[0][-1] > 0] for sign in (1, -1))
    left = [(h[:-1], b) for h, b in rows if h[-1] == 0]
    for h, b in up:
        for g, c in down:
            s, t = -g[-1], h[-1]
            pair = zip(h[:-1], g[:-1], strict=True)
            left.append(([s * p + t * q for p, q in pair], s * b + t * c))
    return left


def feasible_polygon_by_elimination(mpc) -> Polygon:
    """Exact feasible set of a planar problem by S_k = {x: ∃u: rows of stage k, Ax + Bu + c ∈ S}.

    Any polyhedral sets of states and inputs, outputs with D, any index set; no rates, no blocks.
    """
    A, B = rational(mpc.system.A), rational(mpc.system.B)
    c = [Q(0)] * 2 if mpc.system.c is None else rational(mpc.system.c)
    far = Q(10) ** 6
    body = None
    for k in reversed(range(mpc.horizon + 1)):
        rows = []
        for hx, hu, lower, upper in stage_rows(mpc, k):
            rows += [] if upper is None else [(hx + hu, upper)]
            rows += [] if lower is None else [([-v for v in hx + hu], -lower)]
        if body is not None:
            for a, b in body.facets:
                columns = list(zip(*A, strict=True)) + list(zip(*B, strict=True))
                rows.append(([dot(a, column) for column in columns], b - dot(a, c)))
        for _ in B[0]:
            rows = eliminate(rows)
        body = Polygon(((-far, -far), (far, -far), (far, far), (-far, far)))
        for h, b in rows:
            scale = max(map(abs, h))
            if scale == 0:  # what is left of rows on u alone: 0 ≤ b
                assert b >= 0
                continue
            h, b = [v / scale for v in h], b / scale
            reach = max(float(h[0]) * float(v[0]) + float(h[1]) * float(v[1]) for v in
                        body.vertices)  # fmt: skip
            if reach > float(b) - 1e-6 * (1 + abs(float(b))):  # else it surely cuts nothing off
                body = body.clip(h, b)
    return body
