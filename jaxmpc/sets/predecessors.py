"""The states that some input of x+ = A x + B u + c + w takes into a set, for every w in a set."""

import numpy as np

from jaxmpc.arrays import Reals
from jaxmpc.checks import require_kind
from jaxmpc.pytrees import record
from jaxmpc.sets.convex_sets import Box, ConvexSet, Polytope, as_polytope
from jaxmpc.sets.disturbances import disturbance_set
from jaxmpc.sets.geometry import Flat, affine_hull, irredundant_rows
from jaxmpc.sets.lp import FLAT, ROUNDING, extent
from jaxmpc.systems.system import LinearSystem, host_matrices

_MANY = 60  # rows of a target from which ridges are looked for, instead of pairs of rows


def predecessor(
    system: LinearSystem,
    target: Box | Polytope,
    states: Box | Polytope | None,
    inputs: Box | Polytope | None,
    disturbance: ConvexSet | None = None,
    disturbance_matrix: Reals | None = None,
) -> Polytope:
    """Return the states that some input takes into a target within one step for every w.

    Pre = {x in states : there is u in inputs with A x + B u + c + E w in target for all w in
    disturbance}, the one-step controllable set.

    Arguments:
        system: n states, m inputs; A may be singular, c may be anything.
        target: set in R^n with volume.
        states: set in R^n, or None for all of R^n.
        inputs: set in R^m, or None for all of R^m. It may be flat (an input that is off, two that
            are equal).
        disturbance: bounded set in R^p that holds the origin, or None for w = 0. If it leaves
            of the target a flat set only, that is enlarged by 4e-9 of its size.
        disturbance_matrix: E (n, p), None for the identity.

    Returns irredundant rows of norm 1; rows of a flat set are not reduced. An empty set comes
    as the row 0'x <= -1 (`is_empty()` is True), all of R^n as 0'x <= 1.

    With T = {H y <= h - max Hw} the target shrunk by the disturbance, Pre is the preimage of the
    Minkowski sum T + (-B inputs) under x -> A x + c. The sum is the projection to y of {(y, u) : y
    + B u in T, u in inputs}, so that A need not be inverted. NumPy in float64; not traceable.

    Raises ValueError for wrong shapes, empty arguments, a target from which no input leads to a set
    with volume, or as `Polytope.project` does.

    Source: Kerrigan 2000, thesis, Cambridge, section 2.3.
    """
    step = one_step(system, inputs, disturbance, disturbance_matrix)
    X = None if states is None else as_polytope("states", states, step.n)
    return step.back(as_polytope("target", target, step.n), X)


@record
class OneStep:
    """x+ = A x + B u + c + w with u in U, w in W (None: w = 0), which is E W of a given E.

    U is {u : u = basis v + shift, v in V}, with V None if nothing bounds v; where V is a
    bounded box, `ends` has (lower, upper) of each v, else it is None.
    """

    A: np.ndarray
    B: np.ndarray
    c: np.ndarray
    V: Polytope | None
    basis: np.ndarray
    shift: np.ndarray
    W: ConvexSet | None
    ends: np.ndarray | None

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
        # y in T - B u, where the inputs are u = basis v + shift
        T, BU = T.preimage(np.eye(n), self.B @ self.shift), self.B @ self.basis
        many = n in (3, 4) and np.asarray(T.h).size > _MANY
        if k and self.ends is not None and many and T.frame().bounded:
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
    system: LinearSystem,
    inputs: Box | Polytope | None,
    disturbance: ConvexSet | None,
    disturbance_matrix: Reals | None = None,
) -> OneStep:
    """Return the data of x⁺ = A x + B u + c + E w, checked, with what equalities fix of the inputs
    (lower = upper, or two opposite rows) taken out."""
    require_kind("system", system, LinearSystem)
    system.validate()
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
    return OneStep(*host_matrices(system), V, basis, shift, W, ends)


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
    zero = np.zeros((1, polytope.dimension))
    if polytope.is_empty():
        return Polytope(zero, np.array([-1.0]))
    G, g = polytope.unit_rows()
    if not len(G):
        return Polytope(zero, np.array([1.0]))
    try:
        return Polytope(*irredundant_rows("Polytope", G, g))
    except Flat:
        return Polytope(G, g)
