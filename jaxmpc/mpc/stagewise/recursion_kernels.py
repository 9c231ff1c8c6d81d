"""The recursions along the horizon, each one kernel a batch on NVIDIA GPUs.

As a scan every stage is a launch of its own, or several: 5 to 200 µs each whatever the batch. Here
one warp runs all stages of one problem with the running vector or matrix in its registers. On CPUs
the matrices of a batch stand side by side (the batch in the last axis, which XLA vectorises: 40 µs
for 14 states, 7 inputs and 20 stages, 67 as a batched scan). Everywhere else, and for derivatives,
the scans serve.

Long horizons are divided on a GPU into √N pieces of √N stages, programs side by side. In a piece a
recurrence from the start y ends at e + Φy, where e is its end from zero and Φ the product of its
matrices. So the starts follow one from the other, by a recurrence over √N pieces, and each piece is
run from its own (`_recurrence_in_pieces`); with one thing more this is true of the Riccati
recursion (`_riccati_in_pieces`). (Blelloch's scan of 1990 over partial products has log N steps of
larger products.)
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.qp.jax_transformations import on_gpu, varying, with_derivative_of
from jaxmpc.qp.kernel import EXACT, barrier, call, dot, indices, load, padded_side, program, store
from jaxmpc.qp.linalg import WAITS, batched, by_step, inverse_root_side_by_side, matmul, solve

# Numbers along a side that a warp's registers hold.
MOST_SIDE = 32
# Stages from which on a horizon is divided into pieces on a GPU.
LONG_HORIZON = 128


class Gains(NamedTuple):
    """What a Riccati recursion leaves: closed A + BK (N, n, n), K (N, m, n), inverse G⁻¹ (N, m, m),
    G = R + B'SB; and of a long horizon on a GPU the products (pieces, n, n) of A + BK over each."""

    closed: Array
    K: Array
    inverse: Array
    products: Array | None = None


def recurrence(M: Array, w: Array, start: Array, *, adjoint: bool = False) -> Array:
    """y (N, n): y_k = M_k y_{k−1} + w_k for k = 0, 1, … from y_{−1} = start; or, adjoint,
    y_k = M_k' y_{k+1} + w_k for k = N−1, N−2, … from y_N = start.

    M (N, n, n), or (n, n) the same at all stages; w (N, n); start (n,).
    """
    kernel = _recurrence_kernel if len(w) < LONG_HORIZON else _recurrence_in_pieces
    scan, kernel = (partial(run, adjoint=adjoint) for run in (_scan, kernel))
    return _or_kernel(scan, kernel, M, w, start)


def tracking(
    gains: Gains, A: Array, B: Array, gx: Array, gu: Array, unroll: int = 1
) -> tuple[Array, Array]:
    """x (N+1, n), u (N, m) of least Σ ½ quadratic − g_x·x − g_u·u from x_0 = 0 under
    x⁺ = A x + B u, the quadratic that of the gains: with q = g_u − B'p⁺

        p = A'p⁺ − K'q − g_x,  d = G⁻¹q  backward,    u = K x + d  forward.

    gx (N+1, n), gu (N, m); A (n, n) and B (n, m), or one a stage.
    """
    scan = partial(_tracking_by, partial(_scan, unroll=unroll))
    in_pieces = partial(_recurrence_in_pieces, products=gains.products)
    kernel = _tracking_kernel if len(gu) < LONG_HORIZON else partial(_tracking_by, in_pieces)
    return _or_kernel(scan, kernel, gains, A, B, gx, gu)


def riccati_recursion(Q: Array, R: Array, cross: Any, A: Array, B: Array) -> Gains:
    """Gains of the stage costs ½ x'Q_k x + ½ u'R_k u + u'M_k x under x⁺ = A x + B u.

    Q (N+1, n, n), R (N, m, m), cross M (N, m, n) or None; A (n, n) and B (n, m), or one a stage.
    """
    if cross is not None:
        gains = _riccati_scan(Q, R, A, B, cross)
    else:
        kernel = _riccati_kernel if len(R) < LONG_HORIZON else _riccati_in_pieces
        gains = _or_kernel(_riccati_scan, kernel, Q, R, A, B, lanes=_riccati_lanes)
    if not on_gpu() or len(R) < LONG_HORIZON or A.shape[-1] > MOST_SIDE:
        return gains
    return gains._replace(products=_products(jax.lax.stop_gradient(gains.closed), len(R)))


def covariances(closed: Array, noise: Array) -> Array:
    """Σ (N, n, n) after each stage: Σ⁺ = C Σ C' + W from Σ = 0 with C, W (N, n, n) of the stage."""
    kernel = _recurrence_kernel if len(noise) < LONG_HORIZON else _recurrence_in_pieces
    return _or_kernel(_scan, kernel, closed, noise, jnp.zeros_like(noise[0]))


def _or_kernel(scan: Callable, kernel: Callable, *args: Any, lanes: Any = None) -> Any:
    """The kernel where it runs, or on CPUs `lanes`, the scan of a batch in the last axis; both with
    the derivative of the scan."""
    longest = max(size for v in jax.tree.leaves(args) for size in v.shape[-1:])
    if longest > MOST_SIDE:
        return scan(*args)
    if not on_gpu():
        if lanes is None or WAITS:  # the fusions of those versions of XLA compute products again
            return scan(*args)
        kernel = batched(lambda *args: scan(*args), lanes, MOST_SIDE)
    return with_derivative_of(scan, kernel)(*args)


def _scan(M: Array, w: Array, start: Array, *, adjoint: bool = False, unroll: int = 1) -> Array:
    """The recurrence of vectors; or of matrices w (N, n, n), y_k = M_k y_{k−1} M_k' + w_k."""

    def stage(y: Array, at: tuple) -> tuple[Array, Array]:
        own, w = at
        own = M if own is None else own
        moved = matmul(y, own if adjoint else own.T)
        y = (moved if y.ndim == 1 else matmul(own, moved)) + w
        return y, y

    xs = (None if M.ndim == 2 else M, w)
    start = varying(start, (M, w))
    return jax.lax.scan(stage, start, xs, reverse=adjoint, unroll=unroll)[1]


def _tracking_by(
    recurrence: Callable, gains: Gains, A: Array, B: Array, gx: Array, gu: Array
) -> tuple[Array, Array]:
    closed, K, inverse, _ = gains
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
    own, at = by_step((A, 2), (B, 2))

    def stage(S: Array, stage: tuple) -> tuple[Array, Gains]:
        Q, R, M, *own = stage
        A, B = at(own)
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

    return jax.lax.scan(stage, Q[-1], (Q[:-1], R, cross, *own), reverse=True)[1]


def _riccati_lanes(Q: Array, R: Array, A: Array, B: Array) -> Gains:
    """The recursion for problems side by side: all arrays with the batch as last axis."""
    own, at = by_step((A, 3), (B, 3))
    # Each product is an array of its own: XLA would compute it again for each of its uses.
    keep = jax.lax.optimization_barrier
    times = lambda X, Y: keep(sum(X[:, k, None] * Y[k] for k in range(len(Y))))
    turned = lambda X, Y: keep(sum(X[k][:, None] * Y[k] for k in range(len(Y))))

    def stage(S: Array, stage: tuple) -> tuple[Array, Gains]:
        Q, R, *own = stage
        A, B = at(own)
        BtS = turned(B, S)
        W = inverse_root_side_by_side(R + times(BtS, B))
        inverse = turned(W, W)
        K = -times(inverse, times(BtS, A))
        closed = A + times(B, K)
        S = Q + turned(closed, times(S, closed)) + turned(K, times(R, K))
        return keep((S + S.swapaxes(0, 1)) / 2), Gains(closed, K, inverse)

    return jax.lax.scan(stage, Q[-1], (Q[:-1], R, *own), reverse=True)[1]


def _recurrence_in_pieces(
    M: Array, w: Array, start: Array, products: Array | None = None, *, adjoint: bool = False
) -> Array:
    """The recurrence by pieces that run side by side. products: those of `_products`."""
    if products is None:
        products = _products(M, len(w))
    pieces = partial(_recurrence_kernel, adjoint=adjoint, pieces=len(products))
    return pieces(M, w, start, (products, pieces(M, w, jnp.zeros_like(start), ends=True)))


def _recurrence_kernel(
    M: Array,
    w: Array,
    start: Array,
    before: tuple[Array, Array] | tuple[()] = (),
    *,
    adjoint: bool = False,
    pieces: int = 1,
    ends: bool = False,
) -> Array:
    """The recurrence, a program a piece. before: the products and ends of the pieces, with which
    each finds its start. ends: return those of all pieces from the same start."""
    (N, *own), n = w.shape, w.shape[-1]

    def recurrence_stages(*refs: Any) -> None:
        M_ref, w_ref, start_ref, *before_refs, out_ref = refs
        i = indices(_side(n))
        entry: tuple = (i,)
        here = i < n
        if len(own) == 2:
            entry, here = (i[:, None], i[None, :]), here[:, None] & here[None, :]
        shared = _matrix(M_ref, None, n, n) if M.ndim == 2 else None

        def moved(M: Array, y: Array) -> Array:
            if y.ndim == 1:
                return jnp.sum(
                    M * (y[:, None] if adjoint else y[None, :]), axis=0 if adjoint else 1
                )
            return dot(M, dot(y, M.T, EXACT), EXACT)

        def of_piece(step: Array, y: Array) -> Array:
            products_ref, ends_ref = before_refs
            k = pieces - 1 - step if adjoint else step
            end = load(ends_ref.at[(k, *entry)], here)
            return moved(_matrix(products_ref, k, n, n), y) + end

        def stage(step: Array, y: Array) -> Array:
            k = first + (stages - 1 - step if adjoint else step)
            matrix = _matrix(M_ref, k, n, n) if shared is None else shared
            y = moved(matrix, y) + load(w_ref.at[(k, *entry)], here)
            if not ends:
                store(out_ref.at[(k, *entry)], y, here)
            return y

        zero, place = jnp.int32(0), program()
        first, stages = _stages_of(place, pieces, N)
        y = load(start_ref.at[entry], here)
        if before:
            y = jax.lax.fori_loop(zero, pieces - 1 - place if adjoint else place, of_piece, y)
        y = jax.lax.fori_loop(zero, stages, stage, y)
        if ends:
            store(out_ref.at[(place, *entry)], y, here)

    out = jax.ShapeDtypeStruct((pieces if ends else N, *own), w.dtype)
    return call(recurrence_stages, out, grid=pieces)(M, w, start, *before)


def _products(M: Array, N: int) -> Array:
    """The product of the matrices M (N, n, n), or (n, n), of each of √N pieces, the last first."""
    n, pieces = M.shape[-1], _count(N)

    def products_of_pieces(M_ref: Any, out_ref: Any) -> None:
        i = indices(_side(n))
        row, column = i[:, None], i[None, :]
        shared = _matrix(M_ref, None, n, n) if M.ndim == 2 else None
        first, stages = _stages_of(program(), pieces, N)

        def stage(step: Array, product: Array) -> Array:
            own = _matrix(M_ref, first + step, n, n) if shared is None else shared
            return dot(own, product, EXACT)

        start = jnp.where((row == column) & (row < n), 1.0, 0.0).astype(M.dtype)
        product = jax.lax.fori_loop(jnp.int32(0), stages, stage, start)
        store(out_ref.at[program(), row, column], product, (row < n) & (column < n))

    out = jax.ShapeDtypeStruct((pieces, n, n), M.dtype)
    return call(products_of_pieces, out, grid=pieces)(M)


def _count(N: int) -> int:
    """How many pieces N stages have."""
    return -(-N // (math.isqrt(N - 1) + 1))


def _stages_of(piece: Array, pieces: int, N: int) -> tuple[Array, Array]:
    """The first stage of a piece, and how many it has: the last one may have less."""
    length = -(-N // pieces)
    first = piece * length
    return first, jnp.minimum(N - first, length)


def _tracking_kernel(gains: Gains, A: Array, B: Array, gx: Array, gu: Array) -> tuple[Array, Array]:
    # K and G⁻¹ are half of what `closed` is to read, and reading is what takes the time.
    (N, m), n = gu.shape, gx.shape[-1]

    def tracking_stages(*refs: Any) -> None:
        K_ref, inverse_ref, A_ref, B_ref, gx_ref, gu_ref, x_ref, u_ref = refs
        side = _side(max(n, m))
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
    x, u = call(tracking_stages, out)(gains.K, gains.inverse, A, B, gx, gu)
    return x, u


def _riccati_kernel(Q: Array, R: Array, A: Array, B: Array, ends: Array | None = None) -> Gains:
    """The recursion, a program a piece. ends (pieces, n, n): S at the end of each, None: of one
    piece that ends with Q_N."""
    N, n, m, dtype = len(R), Q.shape[-1], R.shape[-1], Q.dtype
    pieces = 1 if ends is None else len(ends)

    def riccati_stages(*refs: Any) -> None:
        *given, closed_ref, K_ref, inverse_ref = refs
        stage_at = _riccati_stages(given[:4], (Q, R, A, B))
        i = indices(_side(max(n, m)))
        row, column = i[:, None], i[None, :]
        first, stages = _stages_of(program(), pieces, N)

        def stage(step: Array, S: Array) -> Array:
            k = first + stages - 1 - step
            S, (closed, K, G, _), _ = stage_at(k, S)
            found = (closed_ref, closed, n, n), (K_ref, K, m, n), (inverse_ref, G, m, m)
            for ref, v, rows, columns in found:
                inside = (row < rows) & (column < columns)
                store(ref.at[k, row, column], v, inside)
            return S

        end, k = (given[0], N) if ends is None else (given[4], program())
        jax.lax.fori_loop(jnp.int32(0), stages, stage, _matrix(end, k, n, n, len(i)))

    shapes = [(N, n, n), (N, m, n), (N, m, m)]
    out = [jax.ShapeDtypeStruct(shape, dtype) for shape in shapes]
    given = (Q, R, A, B) if ends is None else (Q, R, A, B, ends)
    return Gains(*call(riccati_stages, out, grid=pieces)(*given))


def _riccati_in_pieces(Q: Array, R: Array, A: Array, B: Array) -> Gains:
    """The recursion by pieces that run side by side.

    A piece whose end costs ½ x'E x has, as functions of the multiplier λ of its end, the gains of
    this cost and u = Kx − G⁻¹B'Φ⁺'λ, hence x_end = Φx − Dλ. An end that costs S ⪰ E has
    λ = (S − E) x_end, and so, with S − E = LL',

        S_start = J + Φ'L (I + L'DL)⁻¹ L'Φ.

    E is what the state at the end costs by itself: S ⪰ E, and all sums are of semidefinite terms.
    (Särkkä & García-Fernández 2023, IEEE TAC 68(3), have E = 0, and R⁻¹ in place of G⁻¹.)
    """
    return _riccati_kernel(Q, R, A, B, _riccati_ends(Q, *_riccati_pieces(Q, R, A, B)))


def _riccati_pieces(Q: Array, R: Array, A: Array, B: Array) -> tuple[Array, Array, Array]:
    """J, Φ and D (pieces, n, n) of each of √N pieces."""
    N, n, m = len(R), Q.shape[-1], R.shape[-1]
    pieces = _count(N)

    def riccati_pieces(*refs: Any) -> None:
        *given, J_ref, move_ref, spread_ref = refs
        stage_at = _riccati_stages(given, (Q, R, A, B))
        i = indices(_side(max(n, m)))
        row, column = i[:, None], i[None, :]
        times = partial(dot, product=EXACT)
        first, stages = _stages_of(program(), pieces, N)

        def stage(step: Array, carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            S, move, spread = carry
            S, (closed, _, G, _), B_k = stage_at(first + stages - 1 - step, S)
            moved = times(move, B_k)
            return S, times(move, closed), spread + times(moved, times(G, moved.T))

        identity = jnp.where((row == column) & (row < n), 1.0, 0.0).astype(Q.dtype)
        end = _matrix(given[0], first + stages, n, n, len(i))
        start = end, identity, jnp.zeros_like(identity)
        found = jax.lax.fori_loop(jnp.int32(0), stages, stage, start)
        for ref, v in zip((J_ref, move_ref, spread_ref), found, strict=True):
            store(ref.at[program(), row, column], v, (row < n) & (column < n))

    out = [jax.ShapeDtypeStruct((pieces, n, n), Q.dtype)] * 3
    return call(riccati_pieces, out, grid=pieces)(Q, R, A, B)


def _riccati_ends(Q: Array, J: Array, move: Array, spread: Array) -> Array:
    """S (pieces, n, n) at the end of each piece, from that of the last on."""
    pieces, n, _ = J.shape
    N = len(Q) - 1
    # Above the rounding of S in its own units, so that S − E has a Cholesky factor.
    rounding = 8 * n * float(jnp.finfo(J.dtype).eps)

    def riccati_ends(*refs: Any) -> None:
        Q_ref, J_ref, move_ref, spread_ref, out_ref = refs
        i = indices(_side(n))
        row, column = i[:, None], i[None, :]
        diagonal = row == column
        times = partial(dot, product=EXACT)

        def piece(step: Array, S: Array) -> Array:
            k = pieces - 1 - step
            store(out_ref.at[k, row, column], S, (row < n) & (column < n))
            J, move, spread = (_matrix(ref, k, n, n) for ref in (J_ref, move_ref, spread_ref))
            first, stages = _stages_of(k, pieces, N)
            own = _matrix(Q_ref, first + stages, n, n)
            left, L = S - own + jnp.where(diagonal, rounding * S, 0.0), jnp.zeros_like(S)
            for j in range(n):
                along = jnp.sum(jnp.where(column == j, left, 0.0), axis=1)
                pivot = jnp.sum(jnp.where(i == j, along, 0.0))
                along = along / jnp.sqrt(jnp.where(pivot > 0, pivot, jnp.inf))
                along = jnp.where(i >= j, along, 0.0)
                L = jnp.where(column == j, along[:, None], L)
                left = left - along[:, None] * along[None, :]
            W = jnp.where(diagonal, 1.0, 0.0) + times(L.T, times(spread, L))
            reached = times(L.T, move)
            S = J + times(reached.T, times(_inverse(W, n), reached))
            return (S + S.T) / 2

        jax.lax.fori_loop(jnp.int32(0), jnp.int32(pieces), piece, _matrix(Q_ref, N, n, n))

    out = jax.ShapeDtypeStruct(J.shape, J.dtype)
    return call(riccati_ends, out)(Q, J, move, spread)


def _riccati_stages(refs: Any, arrays: tuple[Array, ...]) -> Callable:
    """Return the function of a stage k and S⁺ that gives S, the gains, and B."""
    n, m = arrays[0].shape[-1], arrays[1].shape[-1]
    side = _side(max(n, m))
    times = partial(dot, product=EXACT)
    sides = (n, n), (m, m), (n, n), (n, m)

    def stage(k: Array, S: Array) -> tuple[Array, Gains, Array]:
        Q, R, A, B = (
            _matrix(ref, k if v.ndim == 3 else None, *shape, side)
            for ref, v, shape in zip(refs, arrays, sides, strict=True)
        )
        BtS = times(B.T, S)
        G = _inverse(R + times(BtS, B), m)
        K = -times(G, times(BtS, A))
        closed = A + times(B, K)
        S = Q + times(closed.T, times(S, closed)) + times(K.T, times(R, K))
        return (S + S.T) / 2, Gains(closed, K, G), B

    return stage


def _inverse(G: Array, m: int) -> Array:
    """The inverse of a definite matrix of m rows in a kernel, by Gauss-Jordan without pivoting."""
    i = indices(len(G))
    row, column = i[:, None], i[None, :]
    for j in range(m):
        along = jnp.sum(jnp.where(row == j, G, 0.0), axis=0)
        down = jnp.sum(jnp.where(column == j, G, 0.0), axis=1)
        pivot = 1 / jnp.sum(jnp.where(i == j, along, 0.0))
        pivot_row = jnp.where(column == j, pivot, along[None, :] * pivot)
        less = G - down[:, None] * (along * pivot)[None, :]
        others = jnp.where(column == j, -down[:, None] * pivot, less)
        G = jnp.where(row == j, pivot_row, others)
    return G


def _side(n: int) -> int:
    """The side of matrices of n rows in a kernel."""
    return padded_side(n, least=8)


def _matrix(ref: Any, k: Any, rows: int, columns: int, side: int | None = None) -> Array:
    """The matrix (rows, columns) at stage k (None: the only one), filled up with zeros."""
    side = _side(max(rows, columns)) if side is None else side
    i = indices(side)
    row, column = i[:, None], i[None, :]
    place = ref.at[row, column] if k is None else ref.at[k, row, column]
    return load(place, (row < rows) & (column < columns))
