"""Maximal control invariant sets: the states from which some inputs keep all limits for ever.

The recursion uses LPs, hulls and Fourier-Motzkin eliminations in float64. Its results are checked
afterwards, by upper bounds from LP multipliers, valid for any LP error, and by inputs for the
vertices.
"""

from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY
from typing import NamedTuple

import numpy as np
import scipy

from jaxmpc.arrays import Reals
from jaxmpc.checks import fail, number, whole
from jaxmpc.pytrees import pytree, static
from jaxmpc.sets.convex_sets import Box, ConvexSet, Polytope, as_polytope
from jaxmpc.sets.disturbances import supports
from jaxmpc.sets.geometry import factors
from jaxmpc.sets.invariant import maximal_invariant_set
from jaxmpc.sets.lp import FLAT, ROUNDING, Program, extent, largest_margin, scaling
from jaxmpc.sets.predecessors import OneStep, one_step, tidy
from jaxmpc.systems.riccati import lqr
from jaxmpc.systems.system import LinearSystem

_CUT = 1e-7  # the last step of a recursion that ends cuts off more than this
_VERTICES = 500  # up to this many vertices, an input is found for each


@pytree
class ControlInvariantSet(Polytope):
    """{H x <= h}, a set that some admissible input never lets the state leave.

    exact: True if it is the maximal one, C_inf, to the tolerances that `reason` gives.
    outer: a set that contains C_inf; the same set if exact.
    iterations: k with C_k = C_{k+1} if exact; else how far the recursion went.
    gap: least s for which `outer` lies in the set enlarged by 1 + s about its center
        (0 if exact, inf if the set has no interior).
    reason: what was found and how it was checked, in words.
    """

    _: KW_ONLY
    exact: bool = static()
    outer: Polytope
    iterations: int = static()
    gap: float = static()
    reason: str = static()


def maximal_control_invariant_set(
    system: LinearSystem | Sequence[LinearSystem],
    states: Box | Polytope,
    inputs: Box | Polytope | None,
    *,
    disturbance: ConvexSet | None = None,
    disturbance_matrix: Reals | None = None,
    max_iterations: int = 100,
    tolerance: float = 1e-9,
) -> ControlInvariantSet:
    """Return C_inf, the states from which some inputs keep all constraints for ever.

    C_inf is the largest set C within `states` such that for every x in C there is a u in
    `inputs` with A x + B u + c + E w in C for all w in `disturbance`.

    Arguments:
        system, inputs, disturbance, disturbance_matrix: as in `predecessor`; of several systems the
            one of each step is unknown to the input.
        states: bounded set in R^n with volume.
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
    whole("max_iterations", max_iterations, 1)
    number("tolerance", tolerance, 0, "Give a relative gap")
    if not 0 < tolerance < 1:
        fail("tolerance", f"{tolerance!r} is not between 0 and 1", "Give a relative gap")
    step = one_step(system, inputs, disturbance, disturbance_matrix)
    X = as_polytope("states", states, step.n)
    if not X.frame("states").bounded:
        fail("states", "is unbounded", "Bound every coordinate")
    center, margin = _equilibrium(step, X)
    if margin < -FLAT:
        short = f" (the best misses them by {-margin:.3g} of their size)"
        why = "empty: no equilibrium x = A x + B u + c lies within the limits"
        why = why if margin == -np.inf else why + short
        end = _End(Polytope.empty(step.n), 0, why, exact=True)
    else:
        end = _recursion(step, X, max_iterations, tolerance)
    inner, gap, reason = end.C, 0.0, end.why
    if not end.exact:
        found = _inside(step, end, X, center, max_iterations, tolerance)
        inner, gap, reason = _described(step, end, center, *found)
    return ControlInvariantSet(
        inner.H,
        inner.h,
        inner.labels,
        exact=end.exact,
        outer=end.C if end.flat is None else end.flat,
        iterations=end.k,
        gap=gap,
        reason=reason,
    )


class _End(NamedTuple):
    """How the recursion ended: with C_k, for a reason in words.

    exact: whether C_k is C_inf. cut: what the last step cut off of it. flat: the set without volume
    to which C_k converges, if that is the reason.
    """

    C: Polytope
    k: int
    why: str
    exact: bool = False
    cut: float = 0.0
    flat: Polytope | None = None


def _recursion(step: OneStep, X: Polytope, max_iterations: int, tolerance: float) -> _End:
    """Run C_0 = X, C_{k+1} = Pre(C_k) & C_k to its end."""
    whole = extent(*X.unit_rows())
    C, cut, last, k = X.reduce(), 1.0, np.inf, 0
    try:
        for k in range(max_iterations + 1):
            before = step.back(C)
            following = C if before.is_empty() else C.intersect(before)
            if before.is_empty() or following.is_empty():
                against = "" if step.W is None else " against every disturbance"
                why = f"empty: from no state do the limits hold for {k + 1} steps{against}"
                return _End(Polytope.empty(step.n), k + 1, why, exact=True)
            cut = largest_cut(before, C, enough=_CUT)
            # Convergence without end makes each cut a fraction of the last; an end makes it 0.
            if cut <= ROUNDING and last > _CUT:
                proof = _vertex_proof(step, C)
                if proof.worst > FLAT:
                    why = f"C_k = C_k+1 at k = {k}, but for rounding{proof.text}"
                    return _End(C, k, why, cut=cut)
                why = (
                    f"exact: C_{k} = C_{k + 1}; rows of its predecessor cut off at most "
                    f"{max(cut, 0.0):.0e} of its extent (upper bound){proof.text}"
                )
                return _End(C, k, why, exact=True)
            if cut <= tolerance / 10:
                why = f"C_k converges without end: step {k} cuts off {cut:.0e} of its extent"
                return _End(C, k, why, cut=cut)
            if k < max_iterations:
                width = _width(following, whole)
                if width <= FLAT:
                    why = (
                        f"C_{k + 1} is thinner than {FLAT:.0e} of the limits (margin {width:.0e}): "
                        "the limit has no volume, or wants tighter limits of the states"
                    )
                    return _End(C, k, why, cut=cut, flat=following)
                C, last = following.require_body().reduce(), cut
    except ValueError as error:
        return _End(C, k, f"the recursion is given up at step {k} ({error})", cut=cut)
    return _End(C, k, "max_iterations is reached", cut=cut)


def _described(
    step: OneStep, end: _End, center: np.ndarray, inner: Polytope | None, gap: float
) -> tuple[Polytope, float, str]:
    """Return the set to give, its gap, and the reason, where the recursion has no end."""
    if inner is not None:
        reason = (
            f"inner and outer set: {end.why}; the inner one is invariant, as its predecessor's "
            f"rows cut off nothing (upper bound, to {ROUNDING:.0e})"
            f"{_vertex_proof(step, inner).text}; enlarged about its center by 1 + {gap:.1e} it "
            "holds the outer one"
        )
        return inner, gap, reason
    reason = f"outer bound: {end.why}; no control invariant set with volume was found in it"
    if step.W is not None:
        return Polytope.empty(step.n), gap, reason
    x = center[: step.n]
    return Box(x, x).to_polytope(), gap, f"{reason}, so the set returned is an equilibrium alone"


def _equilibrium(step: OneStep, X: Polytope) -> tuple[np.ndarray, float]:
    """Return ((x_e, v_e), margin) of the equilibrium farthest inside the limits, u_e = moving v_e +
    fixed.

    The margin is the least distance to a limit over that of the middle of `states` (inputs:
    theirs), negative if a limit is exceeded, -inf if there is none at all.
    """
    n = step.n
    M = np.hstack([step.A - np.eye(n), step.B @ step.basis])
    drift = step.c + step.B @ step.shift
    # In units in which all entries are about 1.
    row, column = scaling(M, np.zeros(n))
    M, drift = row[:, None] * M * column, row * drift
    z0 = -np.linalg.lstsq(M, drift, rcond=None)[0]
    terms = np.abs(drift) + np.abs(M) @ np.abs(z0)
    # (Sums of zeros are off by rounding of the largest numbers.)
    if np.any(np.abs(M @ z0 + drift) > 1e-9 * terms + 1e-14 * terms.max()):
        return column * z0, -np.inf
    z0, free = column * z0, column[:, None] * scipy.linalg.null_space(M)
    rows, limits, depths = [], [], []
    for part, polytope in ((slice(0, n), X), (slice(n, None), step.V)):
        if polytope is None:
            continue
        G, g = polytope.unit_rows()
        rows.append(G @ free[part])
        limits.append(g - G @ z0[part])
        depths.append(g - G @ polytope.frame("limits").center)
    z, margin = largest_margin(np.vstack(rows), np.hstack(limits), np.hstack(depths))
    assert z is not None  # feasible with a margin low enough, bounded as X is
    return z0 + free @ z, margin


class _Invariant(NamedTuple):
    """A control invariant set and its predecessor."""

    C: Polytope
    before: Polytope


def _inside(
    step: OneStep, end: _End, X: Polytope, center: np.ndarray, rounds: int, tolerance: float
) -> tuple[Polytope | None, float]:
    """Return a control invariant set within C_k, as large as `rounds` steps make it, and the
    gap."""
    cut, x_e = max(end.cut, ROUNDING), center[: step.n]
    margins = [m for m in 4 * cut * 30.0 ** np.arange(9) if m < 0.5] + [0.5]
    found = None
    for candidates in (
        # C_k shrunk about the equilibrium.
        (_if_invariant(step, _resized(end.C, x_e, 1 - margin)) for margin in margins),
        _of_regulator(step, X, center),
        _contractive(step, end.C, x_e, margins),
    ):
        try:
            found = found or next(filter(None, candidates), None)
        except ValueError:  # too many rows to eliminate, a set too thin for qhull, no such law
            continue
    if found is None:
        return None, np.inf
    gap = _gap(end.C, found.C)
    for _ in range(rounds):
        if gap <= tolerance:
            break
        try:
            larger = _if_invariant(step, tidy(X.intersect(found.before)))
            narrower = np.inf if larger is None else _gap(end.C, larger.C)
        except ValueError:
            break
        if larger is None or narrower > 0.999 * gap:
            break
        found, gap = larger, narrower
    return found.C, gap


def _contractive(
    step: OneStep, C: Polytope, x_e: np.ndarray, margins: list[float]
) -> Iterator[_Invariant | None]:
    """Yield for each margin the sets C <- Pre(x_e + (1 - margin) (C - x_e)) & C, where they are
    invariant."""
    whole = extent(*C.unit_rows())
    for margin in margins:
        inner = C
        for _ in range(30):
            inner = tidy(inner.intersect(step.back(_resized(inner, x_e, 1 - margin))))
            if inner.is_empty() or _width(inner, whole) <= FLAT:
                break
            yield _if_invariant(step, inner)


def _of_regulator(step: OneStep, X: Polytope, center: np.ndarray) -> Iterator[_Invariant | None]:
    """Yield O_inf of an LQR about the equilibrium (x_e, v_e), where it is invariant."""
    n, k = step.n, step.basis.shape[1]
    system = LinearSystem(step.A, step.B @ step.basis)
    x_e, v_e = center[:n], center[n:]
    V, input_size = None, np.ones(k)
    if step.V is not None:
        V = step.V.preimage(np.eye(k), v_e)
        size = extent(*step.V.unit_rows())
        input_size = np.where(np.isfinite(size), size, 1.0)
    state_size = extent(*X.unit_rows())
    law = lqr(system, np.diag(1 / state_size**2), np.diag(1 / input_size**2))
    about = X.preimage(np.eye(n), x_e)
    found = maximal_invariant_set(system, law.K, about, V, disturbance=step.W)
    yield _if_invariant(step, Polytope(found.H, found.h).preimage(np.eye(n), -x_e))


def _if_invariant(step: OneStep, C: Polytope) -> _Invariant | None:
    """Return C and Pre(C) if no row of Pre(C) cuts C."""
    before = step.back(C)
    if before.is_empty() or largest_cut(before, C, enough=ROUNDING) > ROUNDING:
        return None
    return _Invariant(C, before)


def _resized(C: Polytope, center: np.ndarray, factor: float) -> Polytope:
    """Return {center + factor (x - center) : x in C}."""
    H, h = C.unit_rows()
    return Polytope(H, factor * h + (1 - factor) * (H @ center))


def largest_cut(before: Polytope, C: Polytope, enough: float = np.inf) -> float:
    """Return the largest fraction of C's extent, from its center along a row of `before`, that a
    row of `before` cuts off.

    The number is an upper bound; the search ends at the first fraction above `enough`.
    """
    H, h = before.unit_rows()
    level, worst = H @ C.frame().center, -np.inf
    for i, top in _tops(H, C, h):
        worst = max(worst, (top - h[i]) / max(top - level[i], np.finfo(float).tiny))
        if worst > enough:
            break
    return worst


def _gap(outer: Polytope, inner: Polytope) -> float:
    """Return the least s with outer within the inner set enlarged by 1 + s about its center."""
    H, h = inner.unit_rows()
    slack = h - H @ inner.frame().center
    return max(0.0, *((top - h[i]) / slack[i] for i, top in _tops(H, outer)))


def _tops(H: np.ndarray, C: Polytope, h: np.ndarray | None = None) -> Iterator[tuple[int, float]]:
    """Yield (i, upper bound of max H_i x over a bounded C), by LPs in the coordinates of C's
    factors.

    With h, where a row of C next to H_i x <= h_i implies it, that row's bound.
    """
    G, g = C.unit_rows()
    # In coordinates of like size, rows of length 1: x = scale ξ.
    scale = C.frame().scale
    length = np.linalg.norm(np.vstack([G, H]) * scale, axis=1)
    G, g = G * scale / length[: len(G), None], g / length[: len(G)]
    length = length[len(G) :]
    H, h = H * scale / length[:, None], None if h is None else h / length
    for rows, Z in factors(np.vstack([G, H]))[0]:
        own = rows < len(G)
        limits, reach, program = g[rows[own]], None, Program(Z[own], g[rows[own]])
        near = (
            scipy.spatial.KDTree(Z[own]).query(Z[~own])[1][::-1]
            if own.any() and not own.all()
            else []
        )
        # What an elimination made comes last, and cuts most.
        for i, row, j in zip(rows[~own][::-1] - len(G), Z[~own][::-1], near, strict=True):
            reach = extent(Z[own], limits) if reach is None else reach
            top = limits[j] + np.abs(row - Z[own][j]) @ reach
            if h is None or top > h[i]:
                top = program.bound(row, program.maximise(row), reach)
            yield int(i), float(top * length[i])


class _VertexProof(NamedTuple):
    """By how much the worst vertex leaves its set under the best input for each, relative to the
    set's extent along the row (inputs: theirs); and a text of it, empty where it is not found."""

    worst: float
    text: str


def _vertex_proof(step: OneStep, C: Polytope) -> _VertexProof:
    """Find the best input for each vertex of C, if they are few."""
    vertices = C.vertices() if step.n <= 4 else np.zeros((0, step.n))
    if not 0 < len(vertices) <= _VERTICES:
        return _VertexProof(0.0, "")
    G, g = C.unit_rows()
    depth = g - G @ C.frame().center
    g = g - supports(step.W, G)
    k = step.basis.shape[1]
    H, h, room = np.zeros((0, k)), np.zeros(0), np.zeros(0)
    if step.V is not None:
        H, h = step.V.unit_rows()
        room = h - H @ step.V.frame("inputs").center
    rows = np.vstack([*(G @ B for _, B, _ in step.plants), H])
    depths, worst = np.append(np.tile(depth, len(step.plants)), np.zeros(len(H))), 0.0
    for v in vertices:
        drifts = [A @ v + c for A, _, c in step.plants]
        limits = np.concatenate([*(g - G @ drift for drift in drifts), h])
        u, _ = largest_margin(rows, limits, depths)
        assert u is not None  # any u within its limits is feasible, with a slack low enough
        for drift, (_, B, _) in zip(drifts, step.plants, strict=True):
            worst = max(worst, float(((G @ (drift + B @ u) - g) / depth).max()))
        worst = max(worst, float(((H @ u - h) / room).max(initial=0.0)))
    count = len(vertices)
    text = f"; each of its {count} vertices has an input that keeps it in, to {worst:.0e}"
    return _VertexProof(worst, text)


def _width(body: Polytope, whole: np.ndarray) -> float:
    """Return the largest margin of the rows of a set, relative to the extents `whole` (n,) of one
    that holds it: 0 for a flat set."""
    G, g = body.unit_rows()
    return max(largest_margin(G, g, np.abs(G) @ whole)[1], 0.0)
