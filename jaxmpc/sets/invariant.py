"""Invariant sets of x+ = A x + B u + c + w: under u = K x, or control invariant.

The recursions use LPs, hulls and Fourier-Motzkin eliminations in float64. Their results are checked
afterwards, by upper bounds from LP multipliers, valid for any LP error, and by inputs for
the vertices.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal, overload

import jax.numpy as jnp
import numpy as np
import scipy
from scipy.spatial import KDTree

from jaxmpc.arrays import Reals, host_array
from jaxmpc.checks import (
    concrete,
    fail,
    require_finite,
    require_kind,
    require_shape,
    require_symmetric_psd,
)
from jaxmpc.pytrees import pytree
from jaxmpc.qp.linalg import cholesky, eigh, solve_triangular
from jaxmpc.qp.precision import arrays, floating_dtype, matmul
from jaxmpc.sets import geometry
from jaxmpc.sets.convex import Box, Ellipsoid, Polytope
from jaxmpc.sets.geometry import irredundant_rows, unit_rows
from jaxmpc.sets.lp import (
    FLAT,
    ROUNDING,
    Flat,
    Program,
    affine_hull,
    bound,
    extent,
    framed,
    maximise,
    safe_extent,
    scaling,
)
from jaxmpc.systems.riccati import lqr
from jaxmpc.systems.system import LinearSystem, host_matrices

# A row counts as redundant if it is exceeded by no more than this, relative to its bound.
# Rounding alone makes rows that just touch the set exceed their bound by about 1e-16.
_REDUNDANT = 1e-12
# The same for a predecessor's rows, where rounding in 12 dimensions reaches 1e-12.
_ROUNDING = 1e-11
_CUT = 1e-7  # the last step of a recursion that ends cuts off more than this
_MANY = 60  # rows of a target from which ridges are looked for, instead of pairs of rows
_VERTICES = 500  # up to this many vertices, an input is found for each


@overload
def maximal_invariant_set(
    system: LinearSystem,
    K: Reals,
    states: Box | Polytope,
    inputs: Box | Polytope | None,
    *,
    disturbance: Box | Polytope | None = ...,
    max_iterations: int = ...,
    return_index: Literal[False] = ...,
) -> Polytope: ...
@overload
def maximal_invariant_set(
    system: LinearSystem,
    K: Reals,
    states: Box | Polytope,
    inputs: Box | Polytope | None,
    *,
    disturbance: Box | Polytope | None = ...,
    max_iterations: int = ...,
    return_index: Literal[True],
) -> tuple[Polytope, int]: ...
def maximal_invariant_set(
    system: LinearSystem,
    K: Reals,
    states: Box | Polytope,
    inputs: Box | Polytope | None,
    *,
    disturbance: Box | Polytope | None = None,
    max_iterations: int = 500,
    return_index: bool = False,
) -> Polytope | tuple[Polytope, int]:
    """Return O_inf, the states from which u = K x keeps all constraints for ever.

    O_inf = {x : x_k in states and K x_k in inputs for all k >= 0 and all w_k in disturbance},
    x_{k+1} = (A + BK) x_k + w_k.

    Arguments:
        system: n states, m inputs; c must be None or zero.
        K: (m, n), with the sign of u = K x (as `lqr` returns it).
        states: set in R^n with the origin in its interior; it need not be bounded.
        inputs: set in R^m with the origin in its interior, or None.
        disturbance: bounded set in R^n that holds the origin, or None for w = 0.
        max_iterations: how far ahead to look at most.
        return_index: also return the index of determination.

    Returns O_inf with irredundant rows of norm 1, or (O_inf, t*): t* is the least t for
    which constraints kept at k = 0..t are kept for ever.

    With the constraints written as F x <= 1 and W the disturbance, O_t = {x : F_i (A+BK)^j x <=
    b_ij, j = 0..t}, where b_i0 = 1 and b_i,j+1 = b_ij - max {F_i (A+BK)^j w : w in W}; O_inf = O_t
    as soon as max {F_i (A+BK)^(t+1) x : x in O_t} <= b_i,t+1 for every i. The maximum is judged by
    an upper bound made from the LP's multipliers, valid for any LP error, and may exceed the
    right-hand side by 1e-12 of it. NumPy in float64; not traceable.

    Raises ValueError if A + BK is not strictly stable, the origin is not in the interior of
    the constraints, the disturbance leaves no set around the origin, O_inf is unbounded, or
    max_iterations is reached.

    Source: Gilbert & Tan 1991, IEEE TAC 36(9), algorithm 3.2 and theorem 4.1; Kolmanovsky &
    Gilbert 1998, Math. Problems in Engineering 4, section 6, for the disturbance; Neumaier &
    Shcherbina 2004, Math. Programming 99, for the bound.
    """
    closed, F = _closed_loop(system, K, states, inputs)
    n = system.n
    W = disturbance_set(disturbance, n)
    radius = np.abs(np.linalg.eigvals(closed)).max()
    if not radius < 1:
        fail(
            "K",
            f"A + BK has spectral radius {radius:.9g}, which is not below 1",
            "Use a stabilizing K with u = Kx (python-control's K has the other sign)",
        )
    rows, newest, b = F, F, np.ones(len(F))
    reach = np.full(n, np.inf)
    for t in range(max_iterations + 1):
        if not np.isfinite(reach).all():
            reach = safe_extent(rows, np.ones(len(rows)))
        # A row once redundant stays so: if F_i Acl^(t+1) x <= b_(t+1) on O_t, and Acl x + w is
        # in O_t for x in O_(t+1) and w in W, then F_i Acl^(t+2) x <= b_(t+2) on O_(t+1).
        # Only the others are propagated.
        b, candidates = b - supports(W, newest), newest @ closed
        if b.min() <= 0:
            fail(
                "disturbance",
                f"moves the state by {1 - b.min():.6g} of the way from the origin to a limit "
                f"within {t + 1} steps, which leaves no invariant set around the origin",
                "Shrink it, widen the limits, or use a K that rejects it better",
            )
        scaled = candidates / b[:, None]
        program = Program(rows, np.ones(len(rows)))
        values, bounds = np.array([_bound(row, program, reach) for row in scaled]).T
        follow = bounds > 1 + _REDUNDANT
        newest, b = candidates[follow], b[follow]
        if len(newest) == 0 and np.isfinite(reach).all():
            invariant = Polytope(rows, np.ones(len(rows))).reduce()
            return (invariant, t) if return_index else invariant
        if not np.isfinite(reach).all() and values.max() <= 1 + _REDUNDANT:
            fail(
                "states",
                "the invariant set is unbounded: some motion is never constrained",
                "Bound the states on every side",
            )
        rows = np.vstack([rows, scaled[follow]])
    fail(
        "max_iterations",
        f"{max_iterations} steps do not determine the set (spectral radius {radius:.6g})",
        "Raise it, or choose a K that decays faster",
    )


def predecessor(
    system: LinearSystem,
    target: Box | Polytope,
    states: Box | Polytope | None,
    inputs: Box | Polytope | None,
    disturbance: Box | Polytope | None = None,
) -> Polytope:
    """Return the states that some input takes into a target within one step for every w.

    Pre = {x in states : there is u in inputs with A x + B u + c + w in target for all w in
    disturbance}, the one-step controllable set.

    Arguments:
        system: n states, m inputs; A may be singular, c may be anything.
        target: set in R^n with volume.
        states: set in R^n, or None for all of R^n.
        inputs: set in R^m, or None for all of R^m. It may be flat (an input that is off, two that
            are equal).
        disturbance: bounded set in R^n that holds the origin, or None for w = 0. If it leaves
            of the target a flat set only, that is enlarged by 4e-9 of its size.

    Returns irredundant rows of norm 1; rows of a flat set are not reduced. An empty set comes
    as the row 0'x <= -1 (`is_empty()` is True), all of R^n as 0'x <= 1.

    With T = {H y <= h - max Hw} the target shrunk by the disturbance, Pre is the preimage of the
    Minkowski sum T + (-B inputs) under x -> A x + c. The sum is the projection to y of {(y, u) : y
    + B u in T, u in inputs}, so that A need not be inverted. NumPy in float64; not traceable.

    Raises ValueError for wrong shapes, empty arguments, a target from which no input leads to a set
    with volume, or as `Polytope.project` does.

    Source: Kerrigan 2000, thesis, Cambridge, section 2.3.
    """
    step = one_step(system, inputs, disturbance)
    X = [] if states is None else [_polytope("states", states, step.n)]
    return step.back(_polytope("target", target, step.n), *X)


@pytree
@dataclass(frozen=True, eq=False, kw_only=True)
class ControlInvariantSet(Polytope):
    """{H x <= h}, a set that some admissible input never lets the state leave.

    exact: True if it is the maximal one, C_inf, to the tolerances that `reason` gives.
    outer: a set that contains C_inf; the same set if exact.
    iterations: k with C_k = C_{k+1} if exact; else how far the recursion went.
    gap: least s for which `outer` lies in the set enlarged by 1 + s about its centre
        (0 if exact, inf if the set has no interior).
    reason: what was found and how it was checked, in words.
    """

    exact: bool = field(metadata={"static": True})
    outer: Polytope
    iterations: int = field(metadata={"static": True})
    gap: float = field(metadata={"static": True})
    reason: str = field(metadata={"static": True})


def maximal_control_invariant_set(
    system: LinearSystem,
    states: Box | Polytope,
    inputs: Box | Polytope | None,
    *,
    disturbance: Box | Polytope | None = None,
    max_iterations: int = 100,
    tolerance: float = 1e-9,
) -> ControlInvariantSet:
    """Return C_inf, the states from which some inputs keep all constraints for ever.

    C_inf is the largest set C within `states` such that for every x in C there is a u in
    `inputs` with A x + B u + c + w in C for all w in `disturbance`.

    Arguments:
        system: n states, m inputs; A may be singular, c may be anything.
        states: bounded set in R^n with volume.
        inputs: set in R^m, or None for all of R^m.
        disturbance: bounded set in R^n that holds the origin, or None for w = 0.
        max_iterations: largest k of the recursion C_0 = states, C_{k+1} = Pre(C_k) & C_k.
        tolerance: gap below which an inner and an outer set count as one.

    Returns one of three:
    - exact. The recursion ends: no row of Pre(C_k) cuts C_k, by upper bounds made from LP
      multipliers, to 1e-11 of the set's extent along the row, after one that cut it by more
      than 1e-7. The set is C_k.
    - not exact. It need not end: for x+ = 2x + u, |x| <= 5, |u| <= 1 it gives
      |x| <= 1 + 4 / 2^k. Then `outer` is C_k and the set returned, as large as could be found,
      is control invariant by the same bounds. If none was found it is empty.
    - exact and empty (`is_empty()`; the row is 0'x <= -1). Without disturbance C_inf is empty
      exactly if no equilibrium x = A x + B u + c lies within the limits: a compact convex C
      within Pre(C) holds one, by Kakutani's theorem.
    For up to 500 vertices in up to four dimensions, LPs also find an input for each vertex,
    without use of Pre; by convexity that proves invariance a second time. `reason` names the case.

    The inner set. To shrink C and its inputs about an equilibrium leaves the dynamics as they
    are, so a C_k that is almost invariant is often invariant when shrunk by a little more than
    the last cut, as the limits of the inputs stay. If not, O_inf of an LQR about the equilibrium
    is taken; if there is none, C <- Pre(x_e + s (C - x_e)) & C with s < 1 is run until C lies
    within Pre(C), which ends if there is an s-contractive set. Each is then grown by
    C <- Pre(C), which keeps invariance.

    NumPy in float64; not traceable. Raises ValueError for wrong or unbounded arguments.

    Source: Bertsekas 1972, IEEE TAC 17(5), for the recursion; Blanchini 1994, IEEE TAC 39(2),
    for contractive sets; Kerrigan 2000, thesis, Cambridge, sections 2.6 and 3.2.
    """
    if not (isinstance(max_iterations, int) and max_iterations >= 1):
        fail("max_iterations", f"{max_iterations!r} is no positive integer", "Give one")
    if not 0 < tolerance < 1:
        fail("tolerance", f"{tolerance!r} is not between 0 and 1", "Give a relative gap")
    step = one_step(system, inputs, disturbance)
    X = _polytope("states", states, step.n)
    if not framed("states", *unit_rows(X.H, X.h)).bounded:
        fail("states", "is unbounded", "Bound every coordinate")
    whole = safe_extent(*unit_rows(X.H, X.h))
    empty = Polytope(np.zeros((1, step.n)), np.array([-1.0]))

    def result(inner, outer, k, reason, gap=0.0, exact=True):
        return ControlInvariantSet(
            inner.H, inner.h, inner.labels,
            exact=exact, outer=outer, iterations=k, gap=gap, reason=reason,
        )  # fmt: skip

    centre, margin = _equilibrium(step, X)
    if margin < -FLAT:
        short = (
            "" if margin == -np.inf else f" (the best misses them by {-margin:.3g} of their size)"
        )
        return result(
            empty, empty, 0,
            f"empty: no equilibrium x = A x + B u + c lies within the limits{short}",
        )  # fmt: skip
    C, cut, last, outer = X.reduce(), 1.0, np.inf, None
    stop = "max_iterations is reached"
    for k in range(max_iterations + 1):
        try:
            before = step.back(C)
            following = C if before.is_empty() else C.intersect(before)
            if before.is_empty() or following.is_empty():
                against = "" if step.W is None else " against every disturbance"
                return result(
                    empty, empty, k + 1,
                    f"empty: from no state do the limits hold for {k + 1} steps{against}",
                )  # fmt: skip
            cut = largest_cut(before, C, enough=_CUT)
            # Convergence without end makes each cut a fraction of the last; an end makes it 0.
            if cut <= _ROUNDING and last > _CUT:
                text, worst = _vertex_proof(step, C)
                if worst > FLAT:
                    stop = f"C_k = C_k+1 at k = {k}, but for rounding{text}"
                    break
                return result(
                    C, C, k,
                    f"exact: C_{k} = C_{k + 1}; rows of its predecessor cut off at most "
                    f"{max(cut, 0.0):.0e} of its extent (upper bound){text}",
                )  # fmt: skip
            if cut <= tolerance / 10:
                stop = f"C_k converges without end: step {k} cuts off {cut:.0e} of its extent"
                break
            if k < max_iterations:
                width = _width(following, whole)
                if width <= FLAT:
                    outer = following
                    stop = f"C_k converges to a set without volume (margin {width:.0e})"
                    break
                C, last = following.reduce(), cut
        except ValueError as error:
            stop = f"the recursion is given up at step {k} ({error})"
            break
    outer = C if outer is None else outer
    inner, gap = _inside(step, C, X, centre, max(cut, _ROUNDING), max_iterations, tolerance)
    if inner is None:
        found = "no control invariant set with volume was found in it"
        if step.W is None:
            inner = Polytope(
                np.vstack([np.eye(step.n), -np.eye(step.n)]),
                np.r_[centre[: step.n], -centre[: step.n]],
            )
            found += ", so the set returned is an equilibrium alone"
        return result(inner or empty, outer, k, f"outer bound: {stop}; {found}", np.inf, False)
    return result(
        inner, outer, k,
        f"inner and outer set: {stop}; the inner one is invariant, as its predecessor's rows cut "
        f"off nothing (upper bound, to {_ROUNDING:.0e}){_vertex_proof(step, inner)[0]}; enlarged "
        f"about its centre by 1 + {gap:.1e} it holds the outer one",
        gap, False,
    )  # fmt: skip


def invariant_ellipsoid(
    system: LinearSystem,
    K: Reals,
    P: Reals,
    states: Box | Polytope | None,
    inputs: Box | Polytope | None,
    disturbance: Box | Polytope | None = None,
    *,
    return_contraction: bool = False,
) -> Ellipsoid | tuple[Ellipsoid, float]:
    """Return the largest {x : x'P x <= alpha} within the limits; u = K x never lets the state leave
    it.

    Arguments:
        system: n states, m inputs; c must be None or zero.
        K: (m, n), with the sign of u = K x.
        P: (n, n), symmetric positive definite, with (A+BK)'P (A+BK) <= P. That of `lqr` is one.
        states, inputs: sets with the origin in their interior, or None for no limit.
        disturbance: bounded set that holds the origin, or None for w = 0.
        return_contraction: also return gamma2.

    Returns the ellipsoid, or (ellipsoid, gamma2). With rows a_i'x <= b_i of the states and of
    K x in inputs,
        alpha = min_i b_i^2 / (a_i'P^-1 a_i),
        gamma2 = max |P^(1/2) (A+BK) P^(-1/2)|^2, so x+'P x+ <= gamma2 x'P x for w = 0.
    With w, |x+|_P <= gamma |x|_P + |w|_P, |x|_P^2 = x'P x: the ellipsoid is invariant if
    gamma sqrt(alpha) + max |w|_P <= sqrt(alpha), which holds for alpha >= (max |w|_P /
    (1 - gamma))^2. NumPy in float64; not traceable but for the case below.

    Where anything but the disturbance is traced by `jit`, `vmap` or `grad`, P and alpha are JAX
    arrays with derivatives (alpha's is that of the row that decides), and alpha is NaN where an
    error would be raised. A disturbance cannot be given there.

    Raises ValueError if P is no Lyapunov matrix of A + BK (the message has gamma2), if alpha
    is less than the disturbance needs (the message has both), if nothing limits the set, or if
    the origin is not strictly within the limits.

    Source: Boyd, El Ghaoui, Feron & Balakrishnan 1994, Linear Matrix Inequalities, section
    5.2; Rawlings, Mayne & Diehl 2017, Model Predictive Control, section 2.5.5.
    """
    require_kind("system", system, LinearSystem)
    if not concrete(system.A, system.B, system.c, K, P, states, inputs):
        if disturbance is not None:
            fail("disturbance", "given inside a trace", "Compute the ellipsoid outside, or omit it")
        traced = _traced_ellipsoid(system, K, P, states, inputs)
        return traced if return_contraction else traced[0]
    closed, F = _closed_loop(system, K, states, inputs, optional=("states", "inputs"))
    n = system.n
    require_shape("P", P, (n, n), "Give one matrix for the states")
    P = host_array("P", P)
    require_symmetric_psd("P", P, definite=True)
    P = (P + P.T) / 2
    W = disturbance_set(disturbance, n)
    gamma2 = contraction(closed, P)
    if gamma2 > 1 + _REDUNDANT:
        fail(
            "P",
            f"is no Lyapunov matrix of A + BK: x'Px grows by the factor {gamma2:.9g} in a step",
            "Use the P of lqr, or one that solves (A+BK)'P(A+BK) - P = -Q",
        )
    level = float(1 / np.einsum("ij,ij->i", F, np.linalg.solve(P, F.T).T).max())
    if W is not None:
        w_norm, gamma = largest_norm(W, P), np.sqrt(gamma2)
        needed = np.inf if gamma >= 1 else (w_norm / (1 - gamma)) ** 2
        if w_norm > 0 and needed > level:
            fail(
                "disturbance",
                f"needs the level {needed:.9g} = (max |w|_P / (1 - gamma))^2 with max |w|_P = "
                f"{w_norm:.6g} and gamma = {gamma:.6g}; the limits leave {level:.9g}, which is "
                f"{needed - level:.6g} too little",
                "Shrink the disturbance, widen the limits, or use another K and P",
            )
    ellipsoid = Ellipsoid(P, level)
    return (ellipsoid, gamma2) if return_contraction else ellipsoid


def _traced_ellipsoid(
    system: LinearSystem, K: Any, P: Any, states: Box | Polytope | None,
    inputs: Box | Polytope | None,
) -> tuple[Ellipsoid, Any]:  # fmt: skip
    """Compute `invariant_ellipsoid` in JAX, with NaN in place of errors."""
    require_kind("system", system, LinearSystem)
    system.validate()
    n, m = system.n, system.m
    require_shape("K", K, (m, n), "Give u = Kx one row an input, one column a state")
    require_shape("P", P, (n, n), "Give one matrix for the states")
    if states is None and inputs is None:
        fail("states", "the invariant set is unbounded: nothing is constrained", "Add bounds")
    data = arrays((jnp.asarray(system.A), jnp.asarray(system.B), jnp.asarray(K), jnp.asarray(P)))
    dtype = floating_dtype(data)
    A, B, K, P = (part.astype(dtype) for part in data)
    P = (P + P.T) / 2
    L = cholesky(P)  # NaN if P is not definite
    most, inside = jnp.zeros((), dtype), jnp.asarray(True)  # 1/alpha
    for limits, output in ((states, jnp.eye(n, dtype=dtype)), (inputs, K)):
        if limits is None:
            continue
        H, lower, upper = (jnp.asarray(part, dtype) for part in limits.rows())
        reach = jnp.minimum(upper, -lower)
        inside = inside & jnp.all(reach > 0)
        # 1/alpha_i = a_i'P^-1 a_i / b_i^2 = |L^-1 a_i|^2 / b_i^2, 0 where b_i = inf.
        rows = solve_triangular(L, matmul(H, output).T)
        most = jnp.maximum(most, jnp.max(jnp.sum(rows**2, axis=0) / reach**2, initial=0.0))
    # With P = LL', (A+BK)'P(A+BK) <= gamma2 P says |M|^2 <= gamma2 for M' = L^-1 (A+BK)'L.
    M = solve_triangular(L, matmul((A + matmul(B, K)).T, L))
    gamma2 = eigh(matmul(M, M.T))[0][-1]
    rest = jnp.zeros((), dtype) if system.c is None else jnp.max(jnp.abs(jnp.asarray(system.c)))
    sound = (gamma2 <= 1 + 100 * jnp.finfo(dtype).eps) & inside & (most > 0) & (rest == 0)
    return Ellipsoid(P, jnp.where(sound, 1 / most, jnp.nan)), gamma2


def contraction(closed: np.ndarray, P: np.ndarray) -> float:
    """Return gamma2, the least factor with closed'P closed <= gamma2 P."""
    return max(float(scipy.linalg.eigh(closed.T @ P @ closed, P, eigvals_only=True)[-1]), 0.0)


def largest_norm(W: Box | Polytope, P: np.ndarray) -> float:
    """Return max sqrt(w'P w) over W: a convex function is largest at a vertex."""
    vertices = W.vertices()
    return float(np.sqrt(np.einsum("ij,jk,ik->i", vertices, P, vertices).max()))


def disturbance_set(disturbance: Box | Polytope | None, n: int) -> Box | Polytope | None:
    """Return the disturbance; raise ValueError unless it is None or a bounded set that holds 0."""
    if disturbance is None:
        return None
    W = _polytope("disturbance", disturbance, n)
    G, g = unit_rows(W.H, W.h, "disturbance")
    if not np.isfinite(extent(G, g)).all():
        fail("disturbance", "is unbounded", "Bound every coordinate")
    if g.min() < 0:
        fail("disturbance", "does not hold the origin", "Add its centre to the system's c")
    return disturbance


def supports(W: Box | Polytope | None, rows: np.ndarray) -> np.ndarray:
    """Return max {row w : w in W} for each row; 0 if W is None."""
    if W is None or not len(rows):
        return np.zeros(len(rows))
    limits = Polytope(rows, np.zeros(len(rows))).pontryagin_difference(W).h
    return -host_array("disturbance", limits)


@dataclass(frozen=True, eq=False)
class OneStep:
    """x+ = A x + B u + c + w with u in U, w in W.

    U is {u : u = moving v + fixed, v in V}, with V None if nothing bounds v; where V is a
    bounded box, `ends` has its (lower, upper), else it is None.
    """

    A: np.ndarray
    B: np.ndarray
    c: np.ndarray
    V: Polytope | None
    moving: np.ndarray
    fixed: np.ndarray
    W: Box | Polytope | None
    ends: np.ndarray | None

    @property
    def n(self) -> int:
        """Return the number of states."""
        return len(self.A)

    def back(self, target: Polytope, states: Polytope | None = None) -> Polytope:
        """Return the `predecessor` of the target; `states` None stands for all of R^n."""
        n, k = self.n, self.moving.shape[1]
        T = Polytope(target.H, target.h)
        if self.W is not None:
            T = T.pontryagin_difference(self.W)
            if T.is_empty():
                return _tidy(T)
            G, g = unit_rows(T.H, T.h)
            try:
                framed("target", G, g)
            except Flat:  # an elimination needs a set with volume
                reach = safe_extent(*unit_rows(target.H, target.h))
                reach = np.where(np.isfinite(reach), reach, 0.0)
                T = Polytope(G, g + 4 * FLAT * (np.abs(g) + np.abs(G) @ reach))
        # y in T - B u, where the inputs are u = moving v + fixed
        T = T.preimage(np.eye(n), self.B @ self.fixed)
        many = n in (3, 4) and np.asarray(T.h).size > _MANY
        if k and self.ends is not None and many and _bounded(T):
            for b, (lower, upper) in zip((self.B @ self.moving).T, self.ends, strict=True):
                T = _plus_segment(T, -b, lower, upper)
        elif k:
            T = T.preimage(np.hstack([np.eye(n), self.B @ self.moving]))
            if self.V is not None:
                T = T.intersect(self.V.preimage(np.hstack([np.zeros((k, n)), np.eye(k)])))
            T = T.project(range(n))
        before = T.preimage(self.A, self.c)
        H, h = host_array("H", before.H), host_array("h", before.h)
        # Of a singular A, rows of T whose product with it is 0 but for rounding.
        T_H, T_h = np.abs(host_array("H", T.H)), np.abs(host_array("h", T.h))
        H[np.all(np.abs(H) <= 1e-13 * T_H @ np.abs(self.A), axis=1)] = 0.0
        h[~H.any(axis=1) & (np.abs(h) <= ROUNDING * (T_h + T_H @ np.abs(self.c)))] = 0.0
        before = Polytope(H, h)
        return _tidy(before if states is None else states.intersect(before))


def one_step(
    system: LinearSystem, inputs: Box | Polytope | None, disturbance: Box | Polytope | None
) -> OneStep:
    """Return the exact data of x⁺ = A x + B u + c + w, with what equalities fix of the inputs
    (lower = upper, or two opposite rows) taken out."""
    require_kind("system", system, LinearSystem)
    system.validate()
    m = system.m
    inputs = inputs.spread(m) if isinstance(inputs, Box) else inputs
    A, B, c = host_matrices(system)
    V, moving, fixed, ends = None, np.eye(m), np.zeros(m), None
    if isinstance(inputs, Polytope):
        V = _polytope("inputs", inputs, m)
        hull = affine_hull(*unit_rows(V.H, V.h))
        assert hull is not None
        if hull.equal.any():
            moving, fixed = hull.basis, hull.shift
            V = Polytope(hull.G, hull.g) if len(hull.g) else None
    elif inputs is not None:
        _polytope("inputs", inputs, m)
    if isinstance(inputs, Box):
        lower, upper = host_array("inputs", inputs.lower), host_array("inputs", inputs.upper)
        free = upper > lower
        moving, fixed = np.eye(m)[:, free], np.where(free, 0.0, lower)
        V = Box(lower[free], upper[free]).to_polytope() if free.any() else None
        ends = np.column_stack([lower, upper])[free]
        ends = ends if np.isfinite(ends).all() else None
    return OneStep(A, B, c, V, moving, fixed, disturbance_set(disturbance, system.n), ends)


def _bounded(polytope: Polytope) -> bool:
    """Return whether a polytope is bounded."""
    return framed("Polytope", *unit_rows(polytope.H, polytope.h)).bounded


def _plus_segment(T: Polytope, b: np.ndarray, lower: float, upper: float) -> Polytope:
    """Return {y + b v : y in T, lower <= v <= upper}, for a bounded T with volume, n >= 2.

    Its facets are those of T, shifted, and the sums of the segment and a ridge of T where facets
    p and q meet with p'b > 0 > q'b. A ridge has at least n - 1 vertices: of all pairs (p, q),
    those with so many common vertices are combined, far fewer than an elimination would make.
    """
    G, g = unit_rows(T.H, T.h)
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


def _tidy(polytope: Polytope) -> Polytope:
    """Return the same set with irredundant unit rows; 0'x <= -1 if empty, 0'x <= 1 if all of
    R^n."""
    zero = np.zeros((1, polytope.dimension))
    if polytope.is_empty():
        return Polytope(zero, np.array([-1.0]))
    G, g = unit_rows(polytope.H, polytope.h)
    if not len(G):
        return Polytope(zero, np.array([1.0]))
    try:
        return Polytope(*irredundant_rows("Polytope", G, g))
    except Flat:
        return Polytope(G, g)


def _equilibrium(step: OneStep, X: Polytope) -> tuple[np.ndarray, float]:
    """Return ((x_e, v_e), margin) of the equilibrium farthest inside the limits, u_e = moving v_e +
    fixed.

    The margin is the least distance to a limit over that of the middle of `states` (inputs:
    theirs), negative if a limit is exceeded, -inf if there is none at all.
    """
    n = step.n
    M = np.hstack([step.A - np.eye(n), step.B @ step.moving])
    drift = step.c + step.B @ step.fixed
    # In units in which all entries are about 1.
    row, column = scaling(M, np.zeros(n))
    M, drift = row[:, None] * M * column, row * drift
    z0 = -np.linalg.lstsq(M, drift, rcond=None)[0]
    if np.any(np.abs(M @ z0 + drift) > 1e-9 * (np.abs(drift) + np.abs(M) @ np.abs(z0))):
        return column * z0, -np.inf
    z0, free = column * z0, column[:, None] * scipy.linalg.null_space(M)
    rows, limits = [], []
    for part, polytope in ((slice(0, n), X), (slice(n, None), step.V)):
        if polytope is None:
            continue
        G, g = unit_rows(polytope.H, polytope.h)
        depth = g - G @ framed("limits", G, g).centre
        rows.append(np.column_stack([G @ free[part], depth]))
        limits.append(g - G @ z0[part])
    top = maximise(np.eye(free.shape[1] + 1)[-1], *unit_rows(np.vstack(rows), np.hstack(limits)))
    assert top.x is not None  # feasible with a margin low enough, bounded as X is
    return z0 + free @ top.x[:-1], float(top.x[-1])


def _inside(
    step: OneStep, C: Polytope, X: Polytope, centre: np.ndarray, cut: float, rounds: int,
    tolerance: float,
) -> tuple[Polytope | None, float]:  # fmt: skip
    """Return a control invariant set within C_k, as large as `rounds` steps make it, and the
    gap."""
    found = None
    margins = [m for m in 4 * cut * 30.0 ** np.arange(9) if m < 0.5] + [0.5]
    for candidates in (
        _shrunk(step, C, centre, margins),
        _of_regulator(step, X, centre),
        _contractive(step, C, centre, margins),
    ):
        try:
            found = found or next(candidates, None)
        except ValueError:  # too many rows to eliminate, a set too thin for qhull, no such law
            continue
    if found is None:
        return None, np.inf
    inner, before = found
    gap = _gap(C, inner)
    for _ in range(rounds):
        if gap <= tolerance:
            break
        try:
            larger = _tidy(X.intersect(before))
            before, narrower = step.back(larger), _gap(C, larger)
        except ValueError:
            break
        if narrower > 0.999 * gap or largest_cut(before, larger, enough=_ROUNDING) > _ROUNDING:
            break
        inner, gap = larger, narrower
    return inner, gap


def _shrunk(
    step: OneStep, C: Polytope, centre: np.ndarray, margins: list[float]
) -> Iterator[tuple[Polytope, Polytope]]:
    """Yield C_k shrunk about the equilibrium by each margin, with its predecessor, where it is
    invariant."""
    for margin in margins:
        yield from _kept(step, _about(C, centre[: step.n], 1 - margin))


def _contractive(
    step: OneStep, C: Polytope, centre: np.ndarray, margins: list[float]
) -> Iterator[tuple[Polytope, Polytope]]:
    """Yield for each margin the end of C <- Pre(x_e + (1 - margin) (C - x_e)) & C, with its
    predecessor."""
    whole = safe_extent(*unit_rows(C.H, C.h))
    for margin in margins:
        inner = C
        for _ in range(30):
            before = step.back(_about(inner, centre[: step.n], 1 - margin))
            inner = _tidy(inner.intersect(before))
            if inner.is_empty() or _width(inner, whole) <= FLAT:
                break
            found = list(_kept(step, inner))
            if found:
                yield from found
                break


def _of_regulator(
    step: OneStep, X: Polytope, centre: np.ndarray
) -> Iterator[tuple[Polytope, Polytope]]:
    """Yield O_inf of an LQR about the equilibrium (x_e, v_e), with its predecessor."""
    n, k = step.n, step.moving.shape[1]
    system = LinearSystem(step.A, step.B @ step.moving)
    x_e, v_e = centre[:n], centre[n:]
    G, g = unit_rows(X.H, X.h)
    V = None
    if step.V is not None:
        H, h = unit_rows(step.V.H, step.V.h)
        V = Polytope(H, h - H @ v_e)
    input_size = np.ones(k)
    if step.V is not None:
        size = safe_extent(*unit_rows(step.V.H, step.V.h))
        input_size = np.where(np.isfinite(size), size, 1.0)
    law = lqr(system, np.diag(1 / safe_extent(G, g) ** 2), np.diag(1 / input_size**2))
    invariant = maximal_invariant_set(
        system, law.K, Polytope(G, g - G @ x_e), V, disturbance=step.W
    )
    H, h = unit_rows(invariant.H, invariant.h)
    yield from _kept(step, Polytope(H, h + H @ x_e))


def _kept(step: OneStep, C: Polytope) -> Iterator[tuple[Polytope, Polytope]]:
    """Yield (C, Pre(C)) if no row of Pre(C) cuts C."""
    before = step.back(C)
    if not before.is_empty() and largest_cut(before, C, enough=_ROUNDING) <= _ROUNDING:
        yield C, before


def _about(C: Polytope, centre: np.ndarray, factor: float) -> Polytope:
    """Return {centre + factor (x - centre) : x in C}."""
    H, h = unit_rows(C.H, C.h)
    return Polytope(H, factor * h + (1 - factor) * (H @ centre))


def largest_cut(before: Polytope, C: Polytope, enough: float = np.inf) -> float:
    """Return the largest fraction of C's extent, from its centre along a row of `before`, that a
    row of `before` cuts off.

    The number is an upper bound; the search ends at the first fraction above `enough`.
    """
    H, h = unit_rows(before.H, before.h)
    level, worst = H @ framed("Polytope", *unit_rows(C.H, C.h)).centre, -np.inf
    for i, top in _tops(H, C, h):
        worst = max(worst, (top - h[i]) / max(top - level[i], np.finfo(float).tiny))
        if worst > enough:
            break
    return worst


def _gap(outer: Polytope, inner: Polytope) -> float:
    """Return the least s with outer within the inner set enlarged by 1 + s about its centre."""
    H, h = unit_rows(inner.H, inner.h)
    slack = h - H @ framed("Polytope", H, h).centre
    return max(0.0, *((top - h[i]) / slack[i] for i, top in _tops(H, outer)))


def _tops(H: np.ndarray, C: Polytope, h: np.ndarray | None = None) -> Iterator[tuple[int, float]]:
    """Yield (i, upper bound of max H_i x over a bounded C), by LPs in the coordinates of C's
    factors.

    With h, where a row of C next to H_i x <= h_i implies it, that row's bound.
    """
    G, g = unit_rows(C.H, C.h)
    # In coordinates of like size, rows of length 1: x = scale ξ.
    scale = framed("Polytope", G, g).scale
    length = np.linalg.norm(np.vstack([G, H]) * scale, axis=1)
    G, g = G * scale / length[: len(G), None], g / length[: len(G)]
    length = length[len(G) :]
    H, h = H * scale / length[:, None], None if h is None else h / length
    for rows, Z in geometry.factors(np.vstack([G, H]))[0]:
        own = rows < len(G)
        limits, reach, program = g[rows[own]], None, Program(Z[own], g[rows[own]])
        near = KDTree(Z[own]).query(Z[~own])[1][::-1] if own.any() and not own.all() else []
        # What an elimination made comes last, and cuts most.
        for i, row, j in zip(rows[~own][::-1] - len(G), Z[~own][::-1], near, strict=True):
            reach = safe_extent(Z[own], limits) if reach is None else reach
            top = limits[j] + np.abs(row - Z[own][j]) @ reach
            if h is None or top > h[i]:
                top = _bound(row, program, reach)[1]
            yield int(i), float(top * length[i])


def _vertex_proof(step: OneStep, C: Polytope) -> tuple[str, float]:
    """Return by how much the worst vertex of C leaves it under the best input for each, as a text
    and as a number, relative to the set's extent along the row (inputs: theirs)."""
    vertices = C.vertices() if step.n <= 4 else np.zeros((0, step.n))
    if not 0 < len(vertices) <= _VERTICES:
        return "", 0.0
    G, g = unit_rows(C.H, C.h)
    depth = g - G @ framed("Polytope", G, g).centre
    g = g - supports(step.W, G)
    BU = step.B @ step.moving
    k = BU.shape[1]
    rows, worst = np.column_stack([G @ BU, depth]), 0.0
    H, h, room = np.zeros((0, k)), np.zeros(0), np.zeros(0)
    if step.V is not None:
        H, h = unit_rows(step.V.H, step.V.h)
        room = h - H @ framed("inputs", H, h).centre
    for v in vertices:
        drift = step.A @ v + step.c + step.B @ step.fixed
        limits = np.r_[g - G @ drift, h]
        top = maximise(
            np.eye(k + 1)[k],
            *unit_rows(np.vstack([rows, np.column_stack([H, np.zeros(len(H))])]), limits),
        )
        assert top.x is not None  # any u within its limits is feasible, with a slack low enough
        u = top.x[:-1]
        worst = max(worst, float(((G @ (drift + BU @ u) - g) / depth).max()))
        worst = max(worst, float(((H @ u - h) / room).max(initial=0.0)))
    text = f"; each of its {len(vertices)} vertices has an input that keeps it in, to {worst:.0e}"
    return text, worst


def _closed_loop(
    system: LinearSystem,
    K: Reals,
    states: Box | Polytope | None,
    inputs: Box | Polytope | None,
    optional: tuple[str, ...] = ("inputs",),
) -> tuple[np.ndarray, np.ndarray]:
    """Return A + BK, and F of the constraints F x <= 1 on the state, inputs included."""
    require_kind("system", system, LinearSystem)
    system.validate()
    n, m = system.n, system.m
    require_shape("K", K, (m, n), "Give u = Kx one row an input, one column a state")
    K = host_array("K", K)
    require_finite("K", K)
    if system.c is not None and np.any(host_array("c", system.c)):
        fail(
            "system.c",
            "is not zero, so the origin is no equilibrium",
            "Write the system in deviations from its equilibrium",
        )
    parts = []
    constraints = [("states", states, n, np.eye(n)), ("inputs", inputs, m, K)]
    for argument, constraint, dimension, output in constraints:
        if constraint is None and argument in optional:
            continue
        polytope = _polytope(argument, constraint, dimension)
        H, h = host_array(argument, polytope.H), host_array(argument, polytope.h)
        F = H @ output
        # Rows that u = K x keeps identically, as that of two inputs which K makes equal: their
        # terms cancel.
        F[np.all(np.abs(F) <= ROUNDING * np.abs(H) @ np.abs(output), axis=1)] = 0.0
        vacuous = ~F.any(axis=1) & (h >= 0)
        F, h = F[~vacuous], h[~vacuous]
        if not np.all(h > 0):
            fail(
                argument,
                "the origin is not in its interior",
                "Shift the coordinates, or widen the bounds around 0",
            )
        parts.append(F / h[:, None])
    F = np.vstack(parts) if parts else np.zeros((0, n))
    F = F[np.abs(F).max(axis=1, initial=0.0) > 0]
    if len(F) == 0:
        fail("states", "the invariant set is unbounded: nothing is constrained", "Add bounds")
    return host_array("A", system.A) + host_array("B", system.B) @ K, F


def _polytope(argument: str, value: Box | Polytope | None, n: int) -> Polytope:
    """Return a set in R^n as a Polytope; raise ValueError, naming `argument`, for anything else."""
    if not isinstance(value, Box | Polytope):
        fail(argument, f"{type(value).__name__} is no Box or Polytope", "Give one")
    value = value.spread(n) if isinstance(value, Box) else value
    value.validate(argument, n)
    return value.to_polytope() if isinstance(value, Box) else value


def _width(body: Polytope, whole: np.ndarray) -> float:
    """Return the largest margin of the rows of a set, relative to the extents `whole` (n,) of one
    that holds it: 0 for a flat set."""
    G, g = unit_rows(body.H, body.h)
    length = np.abs(G) @ whole
    top = maximise(np.eye(len(whole) + 1)[-1], np.column_stack([G, length]), g)
    return max(top.value, 0.0)


def _bound(row: np.ndarray, program: Program, reach: np.ndarray) -> tuple[float, float]:
    """Return (maximum, upper bound of it) of row x over a set within |x| <= reach."""
    top = program.maximise(row)
    if top.y is None:
        return top.value, top.value
    return top.value, bound(row, top.y, program.G, program.g, reach)
