"""The recursions along the horizon, each one kernel a batch on NVIDIA GPUs.

As a scan every stage is a launch of its own, or several: 5 to 200 µs each whatever the batch. Here
one warp runs all stages of one problem with the running vector or matrix in its registers. On CPUs
the matrices of a batch stand side by side (the batch in the last axis, which XLA vectorises: 40 µs
for 14 states, 7 inputs and 20 stages, 67 as a batched scan). Everywhere else, and for derivatives,
the scans serve.

Long horizons are divided into √N pieces of √N stages on a GPU (`_in_pieces`). In a piece
y_k = l_k + Φ_k s with the recurrence l from zero, the products Φ of its matrices and its start s:
all pieces have their l and Φ at once, and their starts follow one from the other, by a recurrence
of √N stages. (Blelloch's scan of 1990 over partial products has log N steps of larger products.)
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.qp.jax_transformations import on_gpu, with_derivative_of
from jaxmpc.qp.kernel import EXACT, barrier, call, dot, indices, load, padded_side, store
from jaxmpc.qp.linalg import WAITS, batched, inverse_root_side_by_side, matmul, solve

# Numbers along a side that a warp's registers hold.
MOST = 32
# Stages from which on a horizon is divided into pieces on a GPU.
LONG = 128


class Gains(NamedTuple):
    """What a Riccati recursion leaves: closed A + BK (N, n, n), K (N, m, n), inverse G⁻¹ (N, m, m),
    G = R + B'SB."""

    closed: Array
    K: Array
    inverse: Array


def recurrence(M: Array, w: Array, start: Array, *, adjoint: bool = False) -> Array:
    """y (N, n): y_k = M_k y_{k−1} + w_k for k = 0, 1, … from y_{−1} = start; or, adjoint,
    y_k = M_k' y_{k+1} + w_k for k = N−1, N−2, … from y_N = start.

    M (N, n, n), or (n, n) the same at all stages; w (N, n); start (n,).
    """
    scan = partial(_scan, adjoint=adjoint)
    kernel = _recurrence_kernel if len(w) < LONG else _in_pieces
    return _or_kernel(scan, partial(kernel, adjoint=adjoint), M, w, start)


def tracking(
    gains: Gains, A: Array, B: Array, gx: Array, gu: Array, unroll: int = 1
) -> tuple[Array, Array]:
    """x (N+1, n), u (N, m) of least Σ ½ quadratic − g_x·x − g_u·u from x_0 = 0 under
    x⁺ = A x + B u, the quadratic that of the gains: with q = g_u − B'p⁺

        p = A'p⁺ − K'q − g_x,  d = G⁻¹q  backward,    u = K x + d  forward.

    gx (N+1, n), gu (N, m); A (n, n) and B (n, m), or one a stage.
    """
    scan = partial(_tracking_by, partial(_scan, unroll=unroll))
    kernel = _tracking_kernel if len(gu) < LONG else partial(_tracking_by, _in_pieces)
    return _or_kernel(scan, kernel, *gains, A, B, gx, gu)


def riccati_recursion(Q: Array, R: Array, cross: Any, A: Array, B: Array) -> Gains:
    """Gains of the stage costs ½ x'Q_k x + ½ u'R_k u + u'M_k x under x⁺ = A x + B u.

    Q (N+1, n, n), R (N, m, m), cross M (N, m, n) or None; A (n, n) and B (n, m), or one a stage.
    """
    if cross is not None:
        return _riccati_scan(Q, R, A, B, cross)
    return _or_kernel(_riccati_scan, _riccati_kernel, Q, R, A, B, lanes=_riccati_lanes)


def covariances(closed: Array, noise: Array) -> Array:
    """Σ (N, n, n) after each stage: Σ⁺ = C Σ C' + W from Σ = 0 with C, W (N, n, n) of the stage."""
    N, n, _ = closed.shape
    moved = lambda C, S: matmul(C, matmul(S, jnp.swapaxes(C, -1, -2)))

    def stage(carry: tuple, at: tuple) -> tuple[tuple, tuple]:
        (S, product), (C, W) = carry, at
        after = moved(C, S) + W, matmul(C, product)
        return after, after

    def piece(C: Array, W: Array) -> tuple[Array, Array]:
        return jax.lax.scan(stage, (jnp.zeros_like(W[0]), jnp.eye(n, dtype=W.dtype)), (C, W))[1]

    if not on_gpu() or N < LONG:
        return piece(closed, noise)[0]
    # Pieces side by side, then their starts one from the other, as in `_in_pieces`.
    local, products = jax.vmap(piece)(_pieces(closed), _pieces(noise))
    advance = lambda S, end: (moved(end[1], S) + end[0], S)
    starts = jax.lax.scan(advance, jnp.zeros_like(noise[0]), (local[:, -1], products[:, -1]))[1]
    return (local + moved(products, starts[:, None])).reshape(-1, n, n)[:N]


def _or_kernel(scan: Callable, kernel: Callable, *args: Array, lanes: Any = None) -> Any:
    """The kernel where it runs, or on CPUs `lanes`, the scan of a batch in the last axis; both with
    the derivative of the scan."""
    longest = max(size for v in args for size in v.shape[-1:])
    if longest > MOST:
        return scan(*args)
    if not on_gpu():
        if lanes is None or WAITS:  # the fusions of those versions of XLA compute products again
            return scan(*args)
        kernel = batched(lambda *args: scan(*args), lanes, MOST)
    return with_derivative_of(scan, kernel)(*args)


def _scan(M: Array, w: Array, start: Array, *, adjoint: bool, unroll: int = 1) -> Array:
    def stage(y: Array, at: tuple) -> tuple[Array, Array]:
        own, w = at
        own = M if own is None else own
        y = matmul(y, own if adjoint else own.T) + w
        return y, y

    xs = (None if M.ndim == 2 else M, w)
    return jax.lax.scan(stage, start, xs, reverse=adjoint, unroll=unroll)[1]


def _tracking_by(
    recurrence: Callable,
    closed: Array,
    K: Array,
    inverse: Array,
    A: Array,
    B: Array,
    gx: Array,
    gu: Array,
) -> tuple[Array, Array]:
    apply = lambda M, v: jnp.einsum("...ij,...j->...i", M, v, precision="highest")
    turned = lambda M, v: apply(jnp.swapaxes(M, -1, -2), v)
    h = gx[:-1] + turned(K, gu)
    p = recurrence(closed, -h, -gx[-1], adjoint=True)
    p = jnp.concatenate([p[1:], -gx[-1:]])  # of the stage after
    d = apply(inverse, gu - turned(B, p))
    start = jnp.zeros_like(gx[0])
    x = recurrence(closed, apply(B, d), start, adjoint=False)
    x = jnp.concatenate([start[None], x])
    return x, apply(K, x[:-1]) + d


def _riccati_scan(Q: Array, R: Array, A: Array, B: Array, cross: Any = None) -> Gains:
    n, identity = Q.shape[-1], jnp.eye(R.shape[-1], dtype=Q.dtype)
    fixed = (A if A.ndim == 2 else None, B if B.ndim == 2 else None)

    def stage(S: Array, stage: tuple) -> tuple[Array, Gains]:
        Q, R, M, *own = stage
        A, B = (v if f is None else f for v, f in zip(own, fixed, strict=True))
        BtS = matmul(B.T, S)
        Y = matmul(BtS, A) + (0.0 if M is None else M)
        solved = solve(R + matmul(BtS, B), jnp.concatenate([Y, identity], axis=1))
        K, inverse = -solved[:, :n], solved[:, n:]
        closed = A + matmul(B, K)
        # Joseph's form of Q + A'SA + Y'K: no difference of large terms, S stays semidefinite.
        S = Q + matmul(closed.T, matmul(S, closed)) + matmul(K.T, matmul(R, K))
        if M is not None:
            S = S + matmul(K.T, M) + matmul(M.T, K)
        return (S + S.T) / 2, Gains(closed, K, inverse)

    own = (v if f is None else None for v, f in zip((A, B), fixed, strict=True))
    return jax.lax.scan(stage, Q[-1], (Q[:-1], R, cross, *own), reverse=True)[1]


def _riccati_lanes(Q: Array, R: Array, A: Array, B: Array) -> Gains:
    """The recursion for problems side by side: all arrays with the batch as last axis."""
    fixed = (A if A.ndim == 3 else None, B if B.ndim == 3 else None)
    # Each product is an array of its own: XLA would compute it again for each of its uses.
    keep = jax.lax.optimization_barrier
    times = lambda X, Y: keep(sum(X[:, k, None] * Y[k] for k in range(len(Y))))
    turned = lambda X, Y: keep(sum(X[k][:, None] * Y[k] for k in range(len(Y))))

    def stage(S: Array, stage: tuple) -> tuple[Array, Gains]:
        Q, R, *own = stage
        A, B = (v if f is None else f for v, f in zip(own, fixed, strict=True))
        BtS = turned(B, S)
        W = inverse_root_side_by_side(R + times(BtS, B))
        inverse = turned(W, W)
        K = -times(inverse, times(BtS, A))
        closed = A + times(B, K)
        S = Q + turned(closed, times(S, closed)) + turned(K, times(R, K))
        return keep((S + S.swapaxes(0, 1)) / 2), Gains(closed, K, inverse)

    own = (v if f is None else None for v, f in zip((A, B), fixed, strict=True))
    return jax.lax.scan(stage, Q[-1], (Q[:-1], R, *own), reverse=True)[1]


def _recurrence_kernel(M: Array, w: Array, start: Array, *, adjoint: bool) -> Array:
    N, n = w.shape

    def recurrence_stages(M_ref: Any, w_ref: Any, start_ref: Any, out_ref: Any) -> None:
        i = indices(padded_side(n))
        here = i < n
        shared = _matrix(M_ref, None, n, n) if M.ndim == 2 else None

        def stage(step: Array, y: Array) -> Array:
            k = N - 1 - step if adjoint else step
            own = _matrix(M_ref, k, n, n) if shared is None else shared
            product = own * (y[:, None] if adjoint else y[None, :])
            y = jnp.sum(product, axis=0 if adjoint else 1) + load(w_ref.at[k, i], here)
            store(out_ref.at[k, i], y, here)
            return y

        jax.lax.fori_loop(jnp.int32(0), jnp.int32(N), stage, load(start_ref.at[i], here))

    return call(recurrence_stages, jax.ShapeDtypeStruct((N, n), w.dtype))(M, w, start)


def _in_pieces(M: Array, w: Array, start: Array, *, adjoint: bool) -> Array:
    """The recurrence by pieces that run side by side."""
    N, n = w.shape
    own = None if M.ndim == 2 else 0
    # What is added stands where the recurrence ends, after all its stages.
    M, w = (M if own is None else _pieces(M, at_front=adjoint)), _pieces(w, at_front=adjoint)
    length = w.shape[1]
    run = partial(_recurrence_kernel, adjoint=adjoint)
    local = jax.vmap(run, in_axes=(own, 0, None))(M, w, jnp.zeros_like(start))
    columns = jax.vmap(run, in_axes=(None, None, 0), out_axes=2)
    product = lambda M: columns(M, jnp.zeros_like(w[0]), jnp.eye(n, dtype=w.dtype))
    products = product(M) if own is None else jax.vmap(product)(M)
    products = jnp.broadcast_to(products, (len(w), length, n, n))
    last = 0 if adjoint else -1
    turned = jnp.swapaxes(products[:, last], 1, 2) if adjoint else products[:, last]
    ends = run(turned, local[:, last], start)
    starts = [ends[1:], start[None]] if adjoint else [start[None], ends[:-1]]
    moved = jnp.einsum("pkij,pj->pki", products, jnp.concatenate(starts), precision="highest")
    y = (local + moved).reshape(-1, n)
    return y[-N:] if adjoint else y[:N]


def _pieces(v: Array, *, at_front: bool = False) -> Array:
    """Return v (N, …) in pieces of √N stages, filled up with zeros at the end or the front."""
    length = math.isqrt(len(v) - 1) + 1
    missing = -len(v) % length
    stages = (missing, 0) if at_front else (0, missing)
    return jnp.pad(v, [stages, *[(0, 0)] * (v.ndim - 1)]).reshape(-1, length, *v.shape[1:])


def _tracking_kernel(
    closed: Array, K: Array, inverse: Array, A: Array, B: Array, gx: Array, gu: Array
) -> tuple[Array, Array]:
    # K and G⁻¹ are half of what `closed` is to read, and reading is what takes the time.
    (N, m), n = gu.shape, gx.shape[-1]

    def tracking_stages(*refs: Any) -> None:
        K_ref, inverse_ref, A_ref, B_ref, gx_ref, gu_ref, x_ref, u_ref = refs
        side = padded_side(max(n, m))
        i = indices(side)
        state, moved = i < n, i < m
        matrix = lambda ref, k, rows, columns: _matrix(ref, k, rows, columns, side)
        once = lambda ref, v, columns: matrix(ref, None, n, columns) if v.ndim == 2 else None
        A_0, B_0 = once(A_ref, A, n), once(B_ref, B, m)
        own = lambda k: (
            matrix(A_ref, k, n, n) if A_0 is None else A_0,
            matrix(B_ref, k, n, m) if B_0 is None else B_0,
        )
        apply = lambda M, v: jnp.sum(M * v[None, :], axis=1)
        turned = lambda M, v: jnp.sum(M * v[:, None], axis=0)

        def backward(step: Array, p: Array) -> Array:
            k = N - 1 - step
            A_k, B_k = own(k)
            q = load(gu_ref.at[k, i], moved) - turned(B_k, p)
            store(u_ref.at[k, i], apply(matrix(inverse_ref, k, m, m), q), moved)
            return turned(A_k, p) - turned(matrix(K_ref, k, m, n), q) - load(gx_ref.at[k, i], state)

        def forward(k: Array, x: Array) -> Array:
            A_k, B_k = own(k)
            store(x_ref.at[k, i], x, state)
            u = apply(matrix(K_ref, k, m, n), x) + load(u_ref.at[k, i], moved)
            store(u_ref.at[k, i], u, moved)
            return apply(A_k, x) + apply(B_k, u)

        zero, end = jnp.int32(0), jnp.int32(N)
        jax.lax.fori_loop(zero, end, backward, -load(gx_ref.at[N, i], state))
        barrier()
        x = jax.lax.fori_loop(zero, end, forward, jnp.zeros(side, gx.dtype))
        store(x_ref.at[N, i], x, state)

    out = [jax.ShapeDtypeStruct(v.shape, v.dtype) for v in (gx, gu)]
    x, u = call(tracking_stages, out)(K, inverse, A, B, gx, gu)
    return x, u


def _riccati_kernel(Q: Array, R: Array, A: Array, B: Array) -> Gains:
    N, n, m, dtype = len(R), Q.shape[-1], R.shape[-1], Q.dtype
    side = padded_side(max(n, m))
    times = partial(dot, product=EXACT)

    def riccati_stages(*refs: Any) -> None:
        Q_ref, R_ref, A_ref, B_ref, closed_ref, K_ref, inverse_ref = refs
        i = indices(side)
        row, column = i[:, None], i[None, :]
        matrix = lambda ref, k, rows, columns: _matrix(ref, k, rows, columns, side)

        def stage(step: Array, S: Array) -> Array:
            k = N - 1 - step
            at = lambda ref, given: k if given.ndim == 3 else None
            A_k, B_k = matrix(A_ref, at(A_ref, A), n, n), matrix(B_ref, at(B_ref, B), n, m)
            R_k = matrix(R_ref, k, m, m)
            BtS = times(B_k.T, S)
            # Gauss-Jordan in place: R + B'SB is definite, no pivoting.
            G = R_k + times(BtS, B_k)
            for j in range(m):
                along = jnp.sum(jnp.where(row == j, G, 0.0), axis=0)
                down = jnp.sum(jnp.where(column == j, G, 0.0), axis=1)
                pivot = 1 / jnp.sum(jnp.where(i == j, along, 0.0))
                pivot_row = jnp.where(column == j, pivot, along[None, :] * pivot)
                less = G - down[:, None] * (along * pivot)[None, :]
                others = jnp.where(column == j, -down[:, None] * pivot, less)
                G = jnp.where(row == j, pivot_row, others)
            K = -times(G, times(BtS, A_k))
            closed = A_k + times(B_k, K)
            found = (closed_ref, closed, n, n), (K_ref, K, m, n), (inverse_ref, G, m, m)
            for ref, v, rows, columns in found:
                inside = (row < rows) & (column < columns)
                store(ref.at[k, row, column], v, inside)
            S = (
                matrix(Q_ref, k, n, n)
                + times(closed.T, times(S, closed))
                + times(K.T, times(R_k, K))
            )
            return (S + S.T) / 2

        jax.lax.fori_loop(jnp.int32(0), jnp.int32(N), stage, matrix(Q_ref, N, n, n))

    shapes = [(N, n, n), (N, m, n), (N, m, m)]
    out = [jax.ShapeDtypeStruct(shape, dtype) for shape in shapes]
    return Gains(*call(riccati_stages, out)(Q, R, A, B))


def _matrix(ref: Any, k: Any, rows: int, columns: int, side: int | None = None) -> Array:
    """The matrix (rows, columns) at stage k (None: the only one), filled up with zeros."""
    side = padded_side(max(rows, columns)) if side is None else side
    i = indices(side)
    row, column = i[:, None], i[None, :]
    place = ref.at[row, column] if k is None else ref.at[k, row, column]
    return load(place, (row < rows) & (column < columns))
