"""The states that some input of x+ = A x + B u + c + w takes into a set, for every w in a set."""

from collections.abc import Sequence

import numpy as np

from jaxmpc.arrays import Reals
from jaxmpc.checks import fail, require_kind
from jaxmpc.pytrees import record
from jaxmpc.sets.convex_sets import Box, ConvexSet, LinearSet, Polytope, as_polytope
from jaxmpc.sets.disturbances import disturbance_set
from jaxmpc.sets.geometry import Flat, affine_hull, irredundant_rows
from jaxmpc.sets.lp import FLAT, ROUNDING, extent
from jaxmpc.systems.system import LinearSystem, host_matrices

_MANY = 60  # rows of a target from which ridges are looked for, instead of pairs of rows


def predecessor(
    system: LinearSystem | Sequence[LinearSystem],
    target: LinearSet,
    states: LinearSet | None,
    inputs: LinearSet | None,
    disturbance: ConvexSet | None = None,
    disturbance_matrix: Reals | None = None,
) -> Polytope:
    """Return the states that some input takes into a target within one step for every w.

    Pre = {x in states : there is u in inputs with A x + B u + c + E w in target for all w in
    disturbance}, the one-step controllable set.

    Arguments:
        system: n states, m inputs; A may be singular, c may be anything. A sequence of systems: the
            vertices of a hull, in which (A, B, c) may be anywhere; the input suits all of them.
        target: set in R^n; it may be flat, a segment or a point.
        states: set in R^n, or None for all of R^n.
        inputs: set in R^m, or None for all of R^m. It may be flat (an input that is off, two that
            are equal).
        disturbance: bounded set in R^p that holds the origin, or None for w = 0. If it leaves
            of the target a flat set only, that is enlarged by 4e-9 of its size.
        disturbance_matrix: E (n, p), None for the identity.

    Returns irredundant rows of norm 1, of a flat set with its equalities as opposite rows. An empty
    set comes as the row 0'x <= -1 (`is_empty()` is True), all of R^n as 0'x <= 1.

    With T = {H y <= h - max Hw} the target shrunk by the disturbance, Pre is the preimage of the
    Minkowski sum T + (-B inputs) under x -> A x + c. The sum is the projection to y of {(y, u) : y
    + B u in T, u in inputs}, so that A need not be inverted. NumPy in float64; not traceable.

    Raises ValueError for wrong shapes, empty arguments, or as `Polytope.project` does.

    Source: Kerrigan 2000, thesis, Cambridge, section 2.3.
    """
    step = one_step(system, inputs, disturbance, disturbance_matrix)
    X = None if states is None else as_polytope("states", states, step.n)
    return step.back(as_polytope("target", target, step.n), X)


@record
class OneStep:
    """x+ = A x + B u + c + w with u in U, w in W (None: w = 0), which is E W of a given E.

    U is {u : u = basis v + shift, v in V}, with V None if nothing bounds v; where V is a
    bounded box, `ends` has (lower, upper) of each v, else it is None. others: further A, B, c, for
    all of which at once an input has to do.
    """

    A: np.ndarray
    B: np.ndarray
    c: np.ndarray
    V: Polytope | None
    basis: np.ndarray
    shift: np.ndarray
    W: ConvexSet | None
    ends: np.ndarray | None
    others: tuple[tuple[np.ndarray, np.ndarray, np.ndarray], ...] = ()

    @property
    def n(self) -> int:
        """Return the number of states."""
        return len(self.A)

    def back(self, target: Polytope, states: Polytope | None = None) -> Polytope:
        """Return the `predecessor` of the target; `states` None stands for all of R^n."""
        n, k = self.n, self.basis.shape[1]
        T = Polytope(target.H, target.h) if self.W is None else self._shrunk(target, self.W)
        if self.W is not None and T.is_empty():
            return tidy(T)
        if self.others:
            return self._back_of_all(T, states)
        # y in T - B u, where the inputs are u = basis v + shift
        T, BU = T.preimage(np.eye(n), self.B @ self.shift), self.B @ self.basis
        many = k and self.ends is not None and n in (3, 4) and np.asarray(T.h).size > _MANY
        if many and _is_body(T):
            assert self.ends is not None
            for b, (lower, upper) in zip(BU.T, self.ends, strict=True):
                T = _plus_segment(T, -b, lower, upper)
        elif k:
            T = T.preimage(np.hstack([np.eye(n), BU]))
            if self.V is not None:
                T = T.intersect(self.V.preimage(np.hstack([np.zeros((k, n)), np.eye(k)])))
            T = T.project(range(n))
        H, h = T.preimage(self.A, self.c).half_spaces()
        # Of a singular A, rows of T whose product with it is 0 but for rounding.
        T_H, T_h = np.abs(T.half_spaces()[0]), np.abs(T.half_spaces()[1])
        H[np.all(np.abs(H) <= 1e-13 * T_H @ np.abs(self.A), axis=1)] = 0.0
        h[~H.any(axis=1) & (np.abs(h) <= ROUNDING * (T_h + T_H @ np.abs(self.c)))] = 0.0
        before = Polytope(H, h)
        return tidy(before if states is None else states.intersect(before))

    @property
    def plants(self) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Return (A, B, c) of each system, in terms of v: A x + B v + c."""
        every = (self.A, self.B, self.c), *self.others
        return [(A, B @ self.basis, c + B @ self.shift) for A, B, c in every]

    def _back_of_all(self, T: Polytope, states: Polytope | None) -> Polytope:
        """Return {x in states: one v leads to T by each of the systems}: v is eliminated."""
        n, k = self.n, self.basis.shape[1]
        H, h = T.unit_rows()
        G = np.vstack([np.hstack([H @ A, H @ B]) for A, B, _ in self.plants])
        both = Polytope(G, np.concatenate([h - H @ c for _, _, c in self.plants]))
        if self.V is not None:
            both = both.intersect(self.V.preimage(np.hstack([np.zeros((k, n)), np.eye(k)])))
        if states is not None:
            both = both.intersect(states.preimage(np.eye(n, n + k)))
        if both.is_empty():
            return Polytope.empty(n)
        return tidy(both.project(range(n)) if k else Polytope(*both.half_spaces()))

    @staticmethod
    def _shrunk(target: Polytope, W: ConvexSet) -> Polytope:
        """Return the target less W, with volume unless empty: an elimination needs it."""
        T = Polytope(target.H, target.h).pontryagin_difference(W)
        try:
            if not T.is_empty():
                T.frame()
        except Flat:
            reach = extent(*target.unit_rows())
            reach = np.where(np.isfinite(reach), reach, 0.0)
            G, g = T.unit_rows()
            T = Polytope(G, g + 4 * FLAT * (np.abs(g) + np.abs(G) @ reach))
        return T


def one_step(
    system: LinearSystem | Sequence[LinearSystem],
    inputs: LinearSet | None,
    disturbance: ConvexSet | None,
    disturbance_matrix: Reals | None = None,
) -> OneStep:
    """Return the data of x⁺ = A x + B u + c + E w, checked, with what equalities fix of the inputs
    (lower = upper, or two opposite rows) taken out."""
    every = tuple(system) if isinstance(system, Sequence) else (system,)
    if not every:
        fail("system", "holds no system", "Give one, or the vertices of a hull")
    for one in every:
        require_kind("system", one, LinearSystem)
        one.validate()
        if (one.n, one.m) != (every[0].n, every[0].m):
            what = (
                f"holds systems of {(one.n, one.m)} and {(every[0].n, every[0].m)} states, inputs"
            )
            fail("system", what, "Give vertices of one hull")
    system, *others = every
    m = system.m
    V, basis, shift, ends = None, np.eye(m), np.zeros(m), None
    if inputs is not None:
        hull = affine_hull(*as_polytope("inputs", inputs, m).unit_rows("inputs"))
        assert hull is not None
        basis, shift = hull.basis, hull.shift
        V = Polytope(hull.G, hull.g) if len(hull.g) else None
    if isinstance(inputs, Box):
        # Each v is one of the inputs.
        bounds = np.column_stack([*inputs.spread(m).bounds()])[basis.argmax(axis=0)]
        ends = bounds if np.isfinite(bounds).all() else None
    W = disturbance_set(disturbance, system.n, disturbance_matrix)
    rest = tuple(host_matrices(other) for other in others)
    return OneStep(*host_matrices(system), V, basis, shift, W, ends, rest)


def _is_body(T: Polytope) -> bool:
    """Return whether a set, which is not empty, is bounded and has volume."""
    try:
        return T.frame().bounded
    except Flat:
        return False


def _plus_segment(T: Polytope, b: np.ndarray, lower: float, upper: float) -> Polytope:
    """Return {y + b v : y in T, lower <= v <= upper}, for a bounded T with volume, n >= 2.

    Its facets are those of T, shifted, and the sums of the segment and a ridge of T where facets
    p and q meet with p'b > 0 > q'b. A ridge has at least n - 1 vertices: of all pairs (p, q),
    those with so many common vertices are combined, far fewer than an elimination would make.
    """
    G, g = T.unit_rows()
    slope, n = G @ b, G.shape[1]
    slope[np.abs(slope) <= 1e-13 * np.abs(G) @ np.abs(b)] = 0.0
    V = T.vertices()
    touches = (np.abs(V @ G.T - g) <= 1e-7 * np.ptp(V @ G.T, axis=0)).T.astype(float)
    up, down = np.flatnonzero(slope > 0), np.flatnonzero(slope < 0)
    p, q = np.nonzero(touches[up] @ touches[down].T >= n - 1)
    p, q = up[p], down[q]
    weight = -slope[q] / (slope[p] - slope[q])
    H = weight[:, None] * G[p] + (1 - weight)[:, None] * G[q]
    h = weight * g[p] + (1 - weight) * g[q]
    new = np.any(np.abs(H) > 1e-12 * (weight[:, None] * np.abs(G[p]) + np.abs(G[q])), axis=1)
    shifted = g + np.maximum(slope * lower, slope * upper)
    return Polytope(np.vstack([G, H[new]]), np.r_[shifted, h[new]]).reduce()


def tidy(polytope: Polytope) -> Polytope:
    """Return the same set with irredundant unit rows; 0'x <= -1 if empty, 0'x <= 1 if all of
    R^n."""
    if polytope.is_empty():
        return Polytope.empty(polytope.dimension)
    G, g = polytope.unit_rows()
    if not len(G):
        return Polytope(np.zeros((1, polytope.dimension)), np.array([1.0]))
    try:
        return Polytope(*irredundant_rows("Polytope", G, g))
    except Flat:
        return Polytope(G, g).reduce()
