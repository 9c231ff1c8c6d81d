"""Invariant sets of the closed loop x+ = (A + BK) x."""

from typing import Literal, overload

import numpy as np
from jax.typing import ArrayLike

from jaxmpc.checks import fail, require_finite, require_shape
from jaxmpc.control.sets import Box, Polytope, maximise, unit_rows
from jaxmpc.control.system import LinearSystem, host_array

# A row counts as redundant if it is exceeded by no more than this, relative to its bound.
# Rounding alone makes rows that exactly touch the set stand out by about 1e-16.
_REDUNDANT = 1e-12


@overload
def maximal_invariant_set(
    system: LinearSystem,
    K: ArrayLike,
    states: Box | Polytope,
    inputs: Box | Polytope | None,
    *,
    max_iterations: int = ...,
    return_index: Literal[False] = ...,
) -> Polytope: ...
@overload
def maximal_invariant_set(
    system: LinearSystem,
    K: ArrayLike,
    states: Box | Polytope,
    inputs: Box | Polytope | None,
    *,
    max_iterations: int = ...,
    return_index: Literal[True],
) -> tuple[Polytope, int]: ...
def maximal_invariant_set(
    system: LinearSystem,
    K: ArrayLike,
    states: Box | Polytope,
    inputs: Box | Polytope | None,
    *,
    max_iterations: int = 500,
    return_index: bool = False,
) -> Polytope | tuple[Polytope, int]:
    """O_inf, the states from which u = K x keeps all constraints for ever.

    O_inf = {x : x_k in states and K x_k in inputs for all k >= 0}, x_k = (A + BK)^k x.

    Arguments:
        system: n states, m inputs; c must be None or zero.
        K: (m, n), with the sign of u = K x (as `lqr` returns it).
        states: set in R^n with the origin in its interior; it need not be bounded.
        inputs: set in R^m with the origin in its interior, or None.
        max_iterations: how far ahead to look at most.
        return_index: also return the index of determination.

    Returns O_inf with irredundant rows of norm 1, or (O_inf, t*): t* is the least t for
    which constraints kept at k = 0..t are kept for ever.

    With the constraints written as F x <= 1 and O_t = {x : F (A+BK)^j x <= 1, j = 0..t},
    O_inf = O_t as soon as max {F_i (A+BK)^(t+1) x : x in O_t} <= 1 for every i. The maximum
    is judged by an upper bound made from the LP's multipliers, valid whatever the LP's
    error, and may exceed 1 by 1e-12. Host, float64.

    Raises ValueError if A + BK is not strictly stable, the origin is not in the interior of
    the constraints, O_inf is unbounded, or max_iterations is reached.

    Source: Gilbert & Tan 1991, IEEE TAC 36(9), algorithm 3.2 and theorem 4.1; Neumaier &
    Shcherbina 2004, Math. Programming 99, for the bound.
    """
    closed, F = _closed_loop(system, K, states, inputs)
    n = system.n
    radius = np.abs(np.linalg.eigvals(closed)).max()
    if not radius < 1:
        fail(
            "K",
            f"A + BK has spectral radius {radius:.9g}, which is not below 1",
            "Use a stabilizing K with u = Kx (python-control's K has the other sign)",
        )
    rows, newest = F, F
    extent = np.full(n, np.inf)
    for t in range(max_iterations + 1):
        if not np.isfinite(extent).all():
            extent = _extent(rows, n)
        # A row once redundant stays so: if F_i Acl^(t+1) x <= 1 on O_t, and Acl maps O_(t+1)
        # into O_t, then F_i Acl^(t+2) x <= 1 on O_(t+1). Only the others are followed.
        candidates = newest @ closed
        values, bounds = np.array([_bound(row, rows, extent) for row in candidates]).T
        newest = candidates[bounds > 1 + _REDUNDANT]
        if len(newest) == 0 and np.isfinite(extent).all():
            invariant = Polytope(rows, np.ones(len(rows))).reduce()
            return (invariant, t) if return_index else invariant
        if not np.isfinite(extent).all() and values.max() <= 1 + _REDUNDANT:
            fail(
                "states",
                "the invariant set is unbounded: some motion is never constrained",
                "Bound the states on every side",
            )
        rows = np.vstack([rows, newest])
    fail(
        "max_iterations",
        f"{max_iterations} steps do not determine the set (spectral radius {radius:.6g})",
        "Raise it, or choose a K that decays faster",
    )


def _closed_loop(
    system: LinearSystem, K: ArrayLike, states: Box | Polytope, inputs: Box | Polytope | None
) -> tuple[np.ndarray, np.ndarray]:
    """A + BK, and F of the constraints F x <= 1 on the state, inputs included."""
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
        if constraint is None and argument == "inputs":
            continue
        if not isinstance(constraint, Box | Polytope):
            fail(argument, f"{type(constraint).__name__} is no Box or Polytope", "Give one")
        constraint.validate(argument, dimension)
        polytope = constraint.to_polytope() if isinstance(constraint, Box) else constraint
        H, h = host_array(argument, polytope.H), host_array(argument, polytope.h)
        if not np.all(h > 0):
            fail(
                argument,
                "the origin is not in its interior",
                "Shift the coordinates, or widen the bounds around 0",
            )
        parts.append(H @ output / h[:, None])
    F = np.vstack(parts)
    F = F[np.abs(F).max(axis=1, initial=0.0) > 0]
    if len(F) == 0:
        fail("states", "the invariant set is unbounded: nothing is constrained", "Add bounds")
    return host_array("A", system.A) + host_array("B", system.B) @ K, F


def _extent(rows: np.ndarray, n: int) -> np.ndarray:
    """Bounds on |x_i| over rows x <= 1, with a margin for the LP's error; inf if unbounded."""
    G, g = unit_rows(rows, np.ones(len(rows)))
    reach = [max(maximise(e, G, g).value, maximise(-e, G, g).value) for e in np.eye(n)]
    return np.array(reach) * (1 + 1e-6)


def _bound(row: np.ndarray, rows: np.ndarray, extent: np.ndarray) -> tuple[float, float]:
    """(maximum, upper bound of it) of row x over rows x <= 1.

    For any y >= 0,  row x = y'(rows x) + (row - rows'y)'x <= 1'y + |row - rows'y|'extent.
    """
    G, g = unit_rows(rows, np.ones(len(rows)))
    top = maximise(row, G, g)
    if top.y is None:
        return top.value, top.value
    y = top.y * g  # of rows x <= 1, whose norms are 1 / g
    error = np.abs(row - rows.T @ y)
    off = error > 0
    return top.value, float(y.sum() + error[off] @ extent[off])
