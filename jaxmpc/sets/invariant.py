"""Invariant sets of x+ = A x + B u + w under u = K x, and terminal sets by name."""

from dataclasses import KW_ONLY

import jax.numpy as jnp
import numpy as np
import scipy

from jaxmpc.arrays import Reals, host_array
from jaxmpc.checks import (
    concrete,
    fail,
    require_finite,
    require_kind,
    require_shape,
    require_symmetric_psd,
    whole,
)
from jaxmpc.pytrees import pytree, static
from jaxmpc.qp.linalg import arrays, cholesky, eigh, floating_dtype, matmul, solve_triangular
from jaxmpc.sets.convex_sets import Box, ConvexSet, Ellipsoid, Polytope, as_polytope
from jaxmpc.sets.disturbances import disturbance_set, largest_norm, supports
from jaxmpc.sets.lp import ROUNDING, Program, extent
from jaxmpc.systems.riccati import LQR, require_stable
from jaxmpc.systems.system import LinearSystem

# A row counts as redundant if it is exceeded by no more than this, relative to its bound.
# Rounding alone makes rows that just touch the set exceed their bound by about 1e-16.
_REDUNDANT = 1e-12
# The bounds of O_inf are less than those one step earlier by this, relative, beside what w takes:
# more than the rounding of its rows, which would make most sets leave themselves by it.
_DRAWN_IN = 1e-14
# Names of terminal sets.
# Those of a law: within the limits under it.
OF_A_LAW = ("invariant", "ellipsoid")
TERMINAL_SETS = ("none", "box", *OF_A_LAW)


@pytree
class InvariantSet(Polytope):
    """{H x <= h}, the largest set that u = K x never lets the state leave.

    index: of determination, the least t for which constraints kept at k = 0..t are kept for ever.
    """

    _: KW_ONLY
    index: int = static()


@pytree
class InvariantEllipsoid(Ellipsoid):
    """{x'P x <= level}, which u = K x never lets the state leave.

    contraction: gamma2, with x+'P x+ <= gamma2 x'P x without disturbance.
    """

    _: KW_ONLY
    contraction: Reals


def maximal_invariant_set(
    system: LinearSystem,
    K: Reals,
    states: Box | Polytope,
    inputs: Box | Polytope | None,
    *,
    disturbance: ConvexSet | None = None,
    disturbance_matrix: Reals | None = None,
    max_iterations: int = 500,
) -> InvariantSet:
    """Return O_inf, the states from which u = K x keeps all constraints for ever.

    O_inf = {x : x_k in states and K x_k in inputs for all k >= 0 and all w_k in disturbance},
    x_{k+1} = (A + BK) x_k + E w_k.

    Arguments:
        system: n states, m inputs; c must be None or zero.
        K: (m, n), with the sign of u = K x (as `lqr` returns it).
        states: set in R^n with the origin in its interior; it need not be bounded.
        inputs: set in R^m with the origin in its interior, or None.
        disturbance: bounded set W in R^p that holds the origin, or None for w = 0.
        disturbance_matrix: E (n, p), None for the identity.
        max_iterations: how far ahead to look at most.

    Returns O_inf with irredundant rows of norm 1, and its index of determination.

    With the constraints written as F x <= 1 and W for E W, O_t = {x : F_i (A+BK)^j x <=
    b_ij, j = 0..t}, where b_i0 = 1 and b_i,j+1 = b_ij - max {F_i (A+BK)^j w : w in W}; O_inf = O_t
    as soon as max {F_i (A+BK)^(t+1) x : x in O_t} <= b_i,t+1 for every i. An upper bound of the
    maximum is checked, made from the LP's multipliers and valid for any LP error; it may exceed the
    right-hand side by 1e-12 of it. Each b_i,j+1 is drawn in by a further 1e-14 of b_ij, so that
    rounded rows are kept in rational arithmetic too, which `verify_terminal` checks. NumPy in
    float64; not traceable.

    Raises ValueError if A + BK is not strictly stable, the origin is not in the interior of
    the constraints, the disturbance leaves no set around the origin, O_inf is unbounded, or
    max_iterations is reached.

    Source: Gilbert & Tan 1991, IEEE TAC 36(9), algorithm 3.2 and theorem 4.1; Kolmanovsky &
    Gilbert 1998, Math. Problems in Engineering 4, section 6, for the disturbance; Neumaier &
    Shcherbina 2004, Math. Programming 99, for the bound.
    """
    require_kind("system", system, LinearSystem)
    if states is None:
        as_polytope("states", states)
    closed, F = _closed_loop(system, K, states, inputs)
    n = system.n
    W = disturbance_set(disturbance, n, disturbance_matrix)
    radius = require_stable("K", closed)
    rows, newest, b = F, F, np.ones(len(F))
    reach = np.full(n, np.inf)
    for t in range(whole("max_iterations", max_iterations, 1) + 1):
        bounded = np.isfinite(reach).all()
        if not bounded:
            reach = extent(rows, np.ones(len(rows)))
            bounded = np.isfinite(reach).all()
        # A row once redundant stays so: if F_i Acl^(t+1) x <= b_(t+1) on O_t, and Acl x + w is
        # in O_t for x in O_(t+1) and w in W, then F_i Acl^(t+2) x <= b_(t+2) on O_(t+1).
        # Only the others are propagated.
        b, candidates = (1 - _DRAWN_IN) * b - supports(W, newest), newest @ closed
        if b.min() <= 0:
            fail(
                "disturbance",
                f"moves the state by {1 - b.min():.6g} of the way from the origin to a limit "
                f"within {t + 1} steps, which leaves no invariant set around the origin",
                "Shrink it, widen the limits, or use a K that rejects it better",
            )
        scaled = candidates / b[:, None]
        program = Program(rows, np.ones(len(rows)))
        tops = [program.maximise(row) for row in scaled]
        bounds = [program.bound(*pair, reach) for pair in zip(scaled, tops, strict=True)]
        follow = np.array(bounds) > 1 + _REDUNDANT
        newest, b = candidates[follow], b[follow]
        if bounded and len(newest) == 0:
            found = Polytope(rows, np.ones(len(rows))).reduce()
            return InvariantSet(found.H, found.h, index=t)
        if not bounded and max(top.value for top in tops) <= 1 + _REDUNDANT:
            cure = "Bound the states on every side"
            fail("states", "the invariant set is unbounded: some motion is never constrained", cure)
        rows = np.vstack([rows, scaled[follow]])
    problem = f"{max_iterations} steps do not determine the set (spectral radius {radius:.6g})"
    fail("max_iterations", problem, "Raise it, or choose a K that decays faster")


def invariant_ellipsoid(
    system: LinearSystem,
    K: Reals,
    P: Reals,
    states: Box | Polytope | None,
    inputs: Box | Polytope | None,
    disturbance: Box | Polytope | None = None,
) -> InvariantEllipsoid:
    """Return the largest {x : x'P x <= alpha} within the limits; u = K x never lets the state leave
    it.

    Arguments:
        system: n states, m inputs; c must be None or zero.
        K: (m, n), with the sign of u = K x.
        P: (n, n), symmetric positive definite, with (A+BK)'P (A+BK) <= P. That of `lqr` is one.
        states, inputs: sets with the origin in their interior, or None for no limit.
        disturbance: bounded set that holds the origin, or None for w = 0.

    Returns the ellipsoid, and its contraction gamma2. With rows a_i'x <= b_i of the states and of
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
        return _traced_ellipsoid(system, K, P, states, inputs)
    closed, F = _closed_loop(system, K, states, inputs)
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
    return InvariantEllipsoid(P, level, contraction=gamma2)


def named_terminal_set(
    name: str,
    system: LinearSystem,
    law: LQR | None,
    states: Box | Polytope | None,
    inputs: Box | Polytope | None,
    disturbance: ConvexSet | None = None,
    disturbance_matrix: Reals | None = None,
) -> Box | Polytope | Ellipsoid | None:
    """Return the terminal set of this name for x⁺ = A x + B u within the limits.

    "none": None. "box": the state limits. "invariant": the maximal invariant set of `law`, for all
    disturbances where there are some. "ellipsoid": the largest level set of its cost inside the
    limits. Only the last two need the law.

    Raises ValueError for another name, for the last two without any limit, and as
    `maximal_invariant_set` and `invariant_ellipsoid` do.
    """
    if not isinstance(name, str) or name not in TERMINAL_SETS:
        fail("terminal", f"{name!r}", f"Give a set, or one of {', '.join(TERMINAL_SETS)}")
    if name == "none":
        return None
    if name == "box":
        return states
    if states is None and inputs is None:
        fail("terminal", f"{name!r} without limits", "Give states or inputs, or 'none'")
    require_kind("law", law, LQR)
    assert law is not None
    if name == "ellipsoid":
        return invariant_ellipsoid(system, law.K, law.P, states, inputs)
    free = Box(np.full(system.n, -np.inf), np.full(system.n, np.inf))
    return maximal_invariant_set(
        system,
        law.K,
        free if states is None else states,
        inputs,
        disturbance=disturbance,
        disturbance_matrix=disturbance_matrix,
    )


def _traced_ellipsoid(
    system: LinearSystem,
    K: Reals,
    P: Reals,
    states: Box | Polytope | None,
    inputs: Box | Polytope | None,
) -> InvariantEllipsoid:
    """Compute `invariant_ellipsoid` in JAX, with NaN in place of errors."""
    system.validate()
    n, m = system.n, system.m
    require_shape("K", K, (m, n), "Give u = Kx one row an input, one column a state")
    require_shape("P", P, (n, n), "Give one matrix for the states")
    if states is None and inputs is None:
        fail("states", "the invariant set is unbounded: nothing is constrained", "Add bounds")
    data = arrays((jnp.asarray(system.A), jnp.asarray(system.B), jnp.asarray(K), jnp.asarray(P)))
    dtype = floating_dtype(data)
    A, B, gain, cost = (part.astype(dtype) for part in data)
    cost = (cost + cost.T) / 2
    L = cholesky(cost)  # NaN if P is not definite
    most, inside = jnp.zeros((), dtype), jnp.asarray(True)  # 1/alpha
    for limits, output in ((states, jnp.eye(n, dtype=dtype)), (inputs, gain)):
        if limits is None:
            continue
        H, lower, upper = (jnp.asarray(part, dtype) for part in limits.rows())
        reach = jnp.minimum(upper, -lower)
        inside = inside & jnp.all(reach > 0)
        # 1/alpha_i = a_i'P^-1 a_i / b_i^2 = |L^-1 a_i|^2 / b_i^2, 0 where b_i = inf.
        rows = solve_triangular(L, matmul(H, output).T)
        most = jnp.maximum(most, jnp.max(jnp.sum(rows**2, axis=0) / reach**2, initial=0.0))
    # With P = L L', (A+BK)'P(A+BK) <= gamma2 P says |M|^2 <= gamma2 for M' = L^-1 (A+BK)'L.
    M = solve_triangular(L, matmul((A + matmul(B, gain)).T, L))
    gamma2 = eigh(matmul(M, M.T))[0][-1]
    drift = jnp.zeros((), dtype) if system.c is None else jnp.max(jnp.abs(jnp.asarray(system.c)))
    sound = (gamma2 <= 1 + 100 * jnp.finfo(dtype).eps) & inside & (most > 0) & (drift == 0)
    return InvariantEllipsoid(cost, jnp.where(sound, 1 / most, jnp.nan), contraction=gamma2)


def contraction(closed: np.ndarray, P: np.ndarray) -> float:
    """Return gamma2, the least factor with closed'P closed <= gamma2 P."""
    return max(float(scipy.linalg.eigh(closed.T @ P @ closed, P, eigvals_only=True)[-1]), 0.0)


def require_no_drift(system: LinearSystem) -> None:
    """Raise ValueError for a system whose c is not zero."""
    most = np.abs(host_array("c", 0 if system.c is None else system.c)).max()
    if most > 0:
        what = f"is not zero (an entry is {most:.3g}), so the origin is no equilibrium"
        cure = "Write the system in deviations from its equilibrium; leave out a c that is rounding"
        fail("system.c", what, cure)


def _closed_loop(
    system: LinearSystem, K: Reals, states: Box | Polytope | None, inputs: Box | Polytope | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return A + BK, and F of the constraints F x <= 1 on the state, inputs included."""
    system.validate()
    n, m = system.n, system.m
    require_shape("K", K, (m, n), "Give u = Kx one row an input, one column a state")
    K = host_array("K", K)
    require_finite("K", K)
    require_no_drift(system)
    parts = [np.zeros((0, n))]
    for argument, limits, output in (("states", states, np.eye(n)), ("inputs", inputs, K)):
        if limits is None:
            continue
        H, h = as_polytope(argument, limits, len(output)).half_spaces()
        F = H @ output
        # Rows that u = K x keeps identically, as that of two inputs which K makes equal: their
        # terms cancel.
        F[np.all(np.abs(F) <= ROUNDING * np.abs(H) @ np.abs(output), axis=1)] = 0.0
        vacuous = ~F.any(axis=1) & (h >= 0)
        F, h = F[~vacuous], h[~vacuous]
        if not np.all(h > 0):
            cure = "Count x and u from an equilibrium inside (docs: Around an operating point)"
            fail(argument, "the origin is not in its interior", cure)
        parts.append(F / h[:, None])
    F = np.vstack(parts)
    F = F[np.abs(F).max(axis=1, initial=0.0) > 0]
    if len(F) == 0:
        fail("states", "the invariant set is unbounded: nothing is constrained", "Add bounds")
    return host_array("A", system.A) + host_array("B", system.B) @ K, F
