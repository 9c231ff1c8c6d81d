"""The nominal problem that a robust one stands for: the same rows, their bounds tightened.

The plant is x⁺ = A x + B u + c + E w, w ∈ W. Under the policy u_k = v_k + K e_k with e_0 = 0 and
e_{k+1} = A_K e_k + E w_k, A_K = A + BK, the state is x_k = z_k + e_k with the plan z, v of the
nominal plant. A row a'x_k + b'u_k ≤ h holds for all disturbances if and only if

    a'z_k + b'v_k ≤ h − σ_k,   σ_k = Σ_{j<k} h_W(E'(A_K')^j (a + K'b)),

h_W the support function of W (Chisci, Rossiter & Zappa 2001, Automatica 37). For a row b'(u_k −
u_{k−1}) the vectors are K'b and then (A_K' − I)(A_K')^{j−1} K'b. Nothing but right-hand sides
changes. This file is the only one that changes them; `rows.blocks` is the only one that asks it.
"""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from jaxmpc.arrays import host_array
from jaxmpc.checks import concrete, fail
from jaxmpc.mpc.problem import MPC, dynamics_of
from jaxmpc.qp.jax_transformations import varying
from jaxmpc.qp.linalg import matmul, namespace
from jaxmpc.sets.disturbances import (
    disturbance_columns,
    largest_entries,
    support_error,
    with_vertices,
    worst,
)
from jaxmpc.systems.riccati import lqr
from jaxmpc.systems.system import host_matrices

UNIT_ROUNDOFF = 2.0**-53


def feedback_gain(mpc: MPC) -> Any:
    """Return the gain K (m, n) of the policy: the one given, or that of the LQR of Q and R."""
    if mpc.gain is not None:
        return mpc.gain
    try:
        return lqr(mpc.system, mpc.Q, mpc.R).K
    except ValueError as error:
        cure = "Give a gain K (m, n) of u = v + K e with A + BK stable"
        fail("gain", f"is None, and Q and R have no LQR ({error})", cure)


def with_gain(mpc: MPC) -> MPC:
    """Return the problem with its gain filled in, and where rows are tightened a Polytope of
    disturbances as its vertices: what programs of JAX can take as an argument. A nominal problem
    is returned as it is, and one of affine policies, which have no gain."""
    if mpc.disturbance is None or mpc.policy == "affine":
        return mpc
    mpc = replace(mpc, gain=feedback_gain(mpc))
    if mpc.policy == "tightened":
        mpc = replace(mpc, disturbance=with_vertices(mpc.disturbance))
    return mpc


def without_disturbance(mpc: MPC) -> MPC:
    """Return the problem of the nominal plant, its rows as they are given."""
    return replace(mpc, disturbance=None, disturbance_matrix=None, gain=None, policy="tightened")


def require_tightened(mpc: MPC, what: str) -> None:
    """Raise ValueError for a robust problem of another policy than "tightened"."""
    if mpc.disturbance is not None and mpc.policy != "tightened":
        cure = 'Give policy="tightened"; solve, Controller and maps of feasible sets take all'
        fail("policy", f"{mpc.policy!r}: {what} knows no such policy", cure)


def margins(mpc: MPC, found: Sequence[Any], dtype: DTypeLike) -> list[tuple[Array, Array]]:
    """Return for each block of rows (steps, r) what σ takes from its lower and from its upper
    bounds. Works inside jit, vmap and grad; of NumPy's arrays in NumPy."""
    K = feedback_gain(mpc)
    xp = namespace((mpc, K, [(b.H, b.D) for b in found]))
    A, B, _ = dynamics_of(mpc.system, dtype)
    K = xp.asarray(K, dtype)
    n, N = mpc.system.n, mpc.horizon
    E = xp.eye(n, dtype=dtype)
    if mpc.disturbance_matrix is not None:
        E = xp.asarray(mpc.disturbance_matrix, dtype)
    closed, W = A + matmul(B, K), with_vertices(mpc.disturbance)
    parts = [xp.zeros((0, n), dtype)]
    for b in found:
        states = xp.zeros((b.size, n), dtype) if b.H is None else b.H
        parts.append(states if b.D is None else states + matmul(b.D, K))
    rate = np.concatenate([np.zeros(0, bool), *(np.full(b.size, b.rate) for b in found)])

    def step(G: Array, j: Any) -> tuple[Array, tuple[Array, Array]]:
        along = matmul(G, E)
        later = matmul(G, closed) - xp.where(((j == 0) & rate)[:, None], G, xp.zeros_like(G))
        return later, (worst(W, -along), worst(W, along))

    G = xp.concatenate(parts)
    if xp is np:
        taken = []
        for j in range(N):
            G, pair = step(G, j)
            taken.append(pair)
        each: Any = [np.array(v) for v in zip(*taken, strict=True)]
    else:
        _, each = jax.lax.scan(step, varying(G, (closed, E, W)), jnp.arange(N))
    sums = [xp.cumsum(xp.pad(v, ((1, 0), (0, 0))), axis=0) for v in each]
    ends = itertools.pairwise(np.cumsum([0, *(b.size for b in found)]))
    places = [(np.array(b.steps, int), slice(*ij)) for b, ij in zip(found, ends, strict=True)]
    return [(sums[0][steps, part], sums[1][steps, part]) for steps, part in places]


def tightened(mpc: MPC, found: Sequence[Any], dtype: DTypeLike) -> list[Any]:
    """Return the blocks of rows with bounds (steps, r), tightened by `margins`."""
    require_tightened(mpc, "a plan of one sequence of inputs")
    if any(b.radius is not None for b in found):
        fail("terminal_set", "is an Ellipsoid, which has no rows to tighten", "Give a Polytope")
    return [
        replace(b, lower=b.lower + low, upper=b.upper - high)
        for b, (low, high) in zip(found, margins(mpc, found, dtype), strict=True)
    ]


def margin_errors(mpc: MPC, found: Sequence[Any]) -> list[np.ndarray]:
    """Return for each block of rows (steps, r) by how much `margins` in float64 may be off, either
    way: their rounding, and that of the vertices of a Polytope. NumPy; not traceable."""
    n, N = mpc.system.n, mpc.horizon
    A, B, _ = host_matrices(mpc.system)
    K, E = host_array("gain", feedback_gain(mpc)), disturbance_columns(mpc.disturbance_matrix, n)
    W = mpc.disturbance
    terms, relative = support_error(W)
    reach = np.abs(E) @ largest_entries(W, E.shape[1])
    # Twice the first-order bounds cover what they leave out.
    unit = 2 * UNIT_ROUNDOFF * (n + sum(B.shape) + E.shape[1] + terms + N + 8)
    closed = A + B @ K
    off_closed = unit * (np.abs(A) + np.abs(B) @ np.abs(K))
    errors = []
    for b in found:
        H = np.zeros((b.size, n)) if b.H is None else np.asarray(b.H, float)
        D = np.zeros((b.size, B.shape[1])) if b.D is None else np.asarray(b.D, float)
        G, off = H + D @ K, unit * (np.abs(H) + np.abs(D) @ np.abs(K))
        sums = np.zeros((N + 1, b.size))
        for j in range(N):
            sums[j + 1] = sums[j] + (off + (2 * unit + relative) * np.abs(G)) @ reach
            size = np.abs(G)
            later = off @ np.abs(closed) + size @ off_closed + unit * size @ np.abs(closed)
            if b.rate and j == 0:
                later, G = later + off + unit * size, G @ closed - G
            else:
                G = G @ closed
            off = later
        errors.append(sums[np.array(b.steps, int)])
    return errors


def with_bounds(mpc: MPC, found: Sequence[Any], *, widest: bool) -> list[Any]:
    """Return the blocks with bounds (steps, r) of NumPy in float64 that are no wider than the exact
    ones, or, where `widest`, no narrower. Bounds that no disturbance moves are as they are given.

    found: the blocks with their bounds as given, in float64. NumPy; not traceable.
    """
    with jax.enable_x64(True):
        sizes = [[np.asarray(v) for v in pair] for pair in margins(mpc, found, np.float64)]
    errors, sign, placed = margin_errors(mpc, found), -1.0 if widest else 1.0, []
    for b, (low, high), error in zip(found, sizes, errors, strict=True):
        low, high = (np.where(error > 0, v + sign * error, v) for v in (low, high))
        lower, upper = np.asarray(b.lower) + low, np.asarray(b.upper) - high
        # Of this sum itself; of an infinite side it would be the largest number.
        low, high = (np.isfinite(side) & (error > 0) for side in (lower, upper))
        lower = np.where(low, np.nextafter(lower, sign * np.inf), lower)
        upper = np.where(high, np.nextafter(upper, -sign * np.inf), upper)
        placed.append(replace(b, lower=lower, upper=upper))
    return placed


def require_room(mpc: MPC, found: Sequence[Any]) -> None:
    """Raise ValueError where the disturbance leaves nothing between the two bounds of a row.

    found: the blocks with their tightened bounds, concrete.
    """
    if mpc.disturbance is None or not concrete([(b.lower, b.upper) for b in found]):
        return
    for b in found:
        room = np.asarray(b.upper, float) - np.asarray(b.lower, float)
        short = np.argwhere(np.broadcast_to(~(room >= 0), (len(b.steps), b.size)))
        if len(short):
            k, i = short[0]
            unit = f" {b.units[i]}" if b.units[i] else ""
            row = b.names[i] if b.names[i].startswith(b.kind) else f"{b.kind} {b.names[i]}"
            what = (
                f"takes more than there is of {row}: at k = {b.steps[k]} the "
                f"limits cross by {-room[k, i]:.3g}{unit}"
            )
            cure = "Shrink it, shorten the horizon, or give a gain that rejects it better"
            if b.linear is not None:
                cure += "; or make it two soft rows, one with each side"
            fail("disturbance", what, cure)
