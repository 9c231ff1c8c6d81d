"""Maximal control invariant sets: the states from which some inputs keep all limits for ever.

The recursion uses LPs, hulls and Fourier-Motzkin eliminations in float64. Its results are checked
afterwards, by upper bounds from LP multipliers, valid for any LP error, and by inputs for the
vertices.
"""

from collections.abc import Iterator
from dataclasses import KW_ONLY

import numpy as np
import scipy
from scipy.spatial import KDTree

from jaxmpc.checks import fail
from jaxmpc.pytrees import pytree, static
from jaxmpc.sets.box import Box
from jaxmpc.sets.disturbance import supports
from jaxmpc.sets.geometry import factors, unit_rows
from jaxmpc.sets.invariant import maximal_invariant_set
from jaxmpc.sets.lp import FLAT, Program, framed, maximise, safe_extent, scaling
from jaxmpc.sets.one_step import OneStep, one_step, tidy
from jaxmpc.sets.polytope import Polytope, as_polytope
from jaxmpc.systems.riccati import lqr
from jaxmpc.systems.system import LinearSystem


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
    X = as_polytope("states", states, step.n)
    if not framed("states", *unit_rows(X.H, X.h)).bounded:
        fail("states", "is unbounded", "Bound every coordinate")
    whole = safe_extent(*unit_rows(X.H, X.h))
    empty = Polytope(np.zeros((1, step.n)), np.array([-1.0]))

    def result(inner, outer, k, reason, gap=0.0, exact=True):
        return ControlInvariantSet(
            inner.H, inner.h, inner.labels,
            exact=exact, outer=outer, iterations=k, gap=gap, reason=reason,
        )  # fmt: skip

    center, margin = _equilibrium(step, X)
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
    inner, gap = _inside(step, C, X, center, max(cut, _ROUNDING), max_iterations, tolerance)
    if inner is None:
        found = "no control invariant set with volume was found in it"
        if step.W is None:
            inner = Polytope(
                np.vstack([np.eye(step.n), -np.eye(step.n)]),
                np.r_[center[: step.n], -center[: step.n]],
            )
            found += ", so the set returned is an equilibrium alone"
        return result(inner or empty, outer, k, f"outer bound: {stop}; {found}", np.inf, False)
    return result(
        inner, outer, k,
        f"inner and outer set: {stop}; the inner one is invariant, as its predecessor's rows cut "
        f"off nothing (upper bound, to {_ROUNDING:.0e}){_vertex_proof(step, inner)[0]}; enlarged "
        f"about its center by 1 + {gap:.1e} it holds the outer one",
        gap, False,
    )  # fmt: skip


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
        depth = g - G @ framed("limits", G, g).center
        rows.append(np.column_stack([G @ free[part], depth]))
        limits.append(g - G @ z0[part])
    top = maximise(np.eye(free.shape[1] + 1)[-1], *unit_rows(np.vstack(rows), np.hstack(limits)))
    assert top.x is not None  # feasible with a margin low enough, bounded as X is
    return z0 + free @ top.x[:-1], float(top.x[-1])


def _inside(
    step: OneStep, C: Polytope, X: Polytope, center: np.ndarray, cut: float, rounds: int,
    tolerance: float,
) -> tuple[Polytope | None, float]:  # fmt: skip
    """Return a control invariant set within C_k, as large as `rounds` steps make it, and the
    gap."""
    found = None
    margins = [m for m in 4 * cut * 30.0 ** np.arange(9) if m < 0.5] + [0.5]
    for candidates in (
        _shrunk(step, C, center, margins),
        _of_regulator(step, X, center),
        _contractive(step, C, center, margins),
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
            larger = tidy(X.intersect(before))
            before, narrower = step.back(larger), _gap(C, larger)
        except ValueError:
            break
        if narrower > 0.999 * gap or largest_cut(before, larger, enough=_ROUNDING) > _ROUNDING:
            break
        inner, gap = larger, narrower
    return inner, gap


def _shrunk(
    step: OneStep, C: Polytope, center: np.ndarray, margins: list[float]
) -> Iterator[tuple[Polytope, Polytope]]:
    """Yield C_k shrunk about the equilibrium by each margin, with its predecessor, where it is
    invariant."""
    for margin in margins:
        yield from _kept(step, _about(C, center[: step.n], 1 - margin))


def _contractive(
    step: OneStep, C: Polytope, center: np.ndarray, margins: list[float]
) -> Iterator[tuple[Polytope, Polytope]]:
    """Yield for each margin the end of C <- Pre(x_e + (1 - margin) (C - x_e)) & C, with its
    predecessor."""
    whole = safe_extent(*unit_rows(C.H, C.h))
    for margin in margins:
        inner = C
        for _ in range(30):
            before = step.back(_about(inner, center[: step.n], 1 - margin))
            inner = tidy(inner.intersect(before))
            if inner.is_empty() or _width(inner, whole) <= FLAT:
                break
            found = list(_kept(step, inner))
            if found:
                yield from found
                break


def _of_regulator(
    step: OneStep, X: Polytope, center: np.ndarray
) -> Iterator[tuple[Polytope, Polytope]]:
    """Yield O_inf of an LQR about the equilibrium (x_e, v_e), with its predecessor."""
    n, k = step.n, step.moving.shape[1]
    system = LinearSystem(step.A, step.B @ step.moving)
    x_e, v_e = center[:n], center[n:]
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


def _about(C: Polytope, center: np.ndarray, factor: float) -> Polytope:
    """Return {center + factor (x - center) : x in C}."""
    H, h = unit_rows(C.H, C.h)
    return Polytope(H, factor * h + (1 - factor) * (H @ center))


def largest_cut(before: Polytope, C: Polytope, enough: float = np.inf) -> float:
    """Return the largest fraction of C's extent, from its center along a row of `before`, that a
    row of `before` cuts off.

    The number is an upper bound; the search ends at the first fraction above `enough`.
    """
    H, h = unit_rows(before.H, before.h)
    level, worst = H @ framed("Polytope", *unit_rows(C.H, C.h)).center, -np.inf
    for i, top in _tops(H, C, h):
        worst = max(worst, (top - h[i]) / max(top - level[i], np.finfo(float).tiny))
        if worst > enough:
            break
    return worst


def _gap(outer: Polytope, inner: Polytope) -> float:
    """Return the least s with outer within the inner set enlarged by 1 + s about its center."""
    H, h = unit_rows(inner.H, inner.h)
    slack = h - H @ framed("Polytope", H, h).center
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
    for rows, Z in factors(np.vstack([G, H]))[0]:
        own = rows < len(G)
        limits, reach, program = g[rows[own]], None, Program(Z[own], g[rows[own]])
        near = KDTree(Z[own]).query(Z[~own])[1][::-1] if own.any() and not own.all() else []
        # What an elimination made comes last, and cuts most.
        for i, row, j in zip(rows[~own][::-1] - len(G), Z[~own][::-1], near, strict=True):
            reach = safe_extent(Z[own], limits) if reach is None else reach
            top = limits[j] + np.abs(row - Z[own][j]) @ reach
            if h is None or top > h[i]:
                top = program.bound(row, program.maximise(row), reach)
            yield int(i), float(top * length[i])


def _vertex_proof(step: OneStep, C: Polytope) -> tuple[str, float]:
    """Return by how much the worst vertex of C leaves it under the best input for each, as a text
    and as a number, relative to the set's extent along the row (inputs: theirs)."""
    vertices = C.vertices() if step.n <= 4 else np.zeros((0, step.n))
    if not 0 < len(vertices) <= _VERTICES:
        return "", 0.0
    G, g = unit_rows(C.H, C.h)
    depth = g - G @ framed("Polytope", G, g).center
    g = g - supports(step.W, G)
    BU = step.B @ step.moving
    k = BU.shape[1]
    rows, worst = np.column_stack([G @ BU, depth]), 0.0
    H, h, room = np.zeros((0, k)), np.zeros(0), np.zeros(0)
    if step.V is not None:
        H, h = unit_rows(step.V.H, step.V.h)
        room = h - H @ framed("inputs", H, h).center
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


def _width(body: Polytope, whole: np.ndarray) -> float:
    """Return the largest margin of the rows of a set, relative to the extents `whole` (n,) of one
    that holds it: 0 for a flat set."""
    G, g = unit_rows(body.H, body.h)
    length = np.abs(G) @ whole
    top = maximise(np.eye(len(whole) + 1)[-1], np.column_stack([G, length]), g)
    return max(top.value, 0.0)


_VERTICES = 500  # up to this many vertices, an input is found for each


_CUT = 1e-7  # the last step of a recursion that ends cuts off more than this


# The same for a predecessor's rows, where rounding in 12 dimensions reaches 1e-12.
_ROUNDING = 1e-11
