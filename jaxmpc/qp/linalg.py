"""Linear algebra whatever JAX's settings are: products at full precision, float64 evaluation, and
factorizations and solves of small dense matrices, in batches that cannot wait for each other.

`jax.vmap` of `jnp.linalg.cholesky` and its like becomes one LAPACK call for a whole batch. On CPUs
jaxlib 0.10.0 to 0.11.0 (the newest for Python 3.11) spreads that call over the thread pool and
waits for its parts on a thread of the same pool: two such calls at once, in one program or in
two, can wait for each other for ever. A call with little work is not spread (Eigen's cost model, as
of 2·10⁵ cycles). The functions here are the only ones of the package that factor under `vmap`. A
batch on a CPU is

* for few rows eliminated in plain XLA operations, LANES matrices side by side: 1.5 to 10 times as
  fast as LAPACK. Roots gain up to 12 rows, solves up to 6, by measurement on both jaxlibs;
* above, on those jaxlibs, LAPACK calls for some matrices each, a fraction of the work that is
  spread (TOGETHER), and one call for all where that is safe. SciPy's OpenBLAS works
  these off; it gets parts of each matrix so small that it uses one thread.

On other devices JAX's batched routines serve. Nested `vmap`s are one batch. All functions here have
derivatives of any order, forward and reverse (`eigh`: where no eigenvalue is repeated). A matrix
that is not positive definite gives NaN.
"""

import re
from collections.abc import Callable, Sequence
from functools import partial
from importlib.metadata import version
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import DTypeLike

from jaxmpc.qp.jax_transformations import batched_by, broadcast, own_modes, varying

T = TypeVar("T")
A = TypeVar("A", Array, np.ndarray)

# float32 products on NVIDIA cards drop to 10 bits (TF32) unless told otherwise.
PRECISION = jax.lax.Precision.HIGHEST
JAXLIB = tuple(int(part) for part in re.findall(r"\d+", version("jaxlib"))[:3])
# Versions whose batched LAPACK calls can wait for each other.
WAITS = (0, 10, 0) <= JAXLIB < (0, 11, 1)
LANES = 64
# Multiplications in a LAPACK call that is not spread: twice as many did not hang, 4 times did.
TOGETHER = 100_000
# Entries of right-hand sides from which on OpenBLAS divides a triangular solve between threads, and
# most rows that it factors in one. Threads wait for each other: on two busy cores 8 ms a call in
# place of 10 to 40 µs.
THREADED, ALONE = 1024, 112


def namespace(tree: Any) -> Any:
    """Return NumPy where all leaves of the tree are its arrays or numbers, else `jax.numpy`.

    What is computed once a problem is written for both: JAX compiles a program where something is
    traced, and from plain Python NumPy is done before a compiler had begun.
    """
    own = np.ndarray | np.generic | float | int
    return np if all(isinstance(leaf, own) for leaf in jax.tree.leaves(tree)) else jnp


def matmul(a: Array, b: Array) -> Array:
    """Matrix product at full precision of the data's type; of NumPy's arrays one of these.

    Vectors stand on the left, x'M: under `vmap` with M unbatched that is one product of the
    batch (B, n)·(n, m) without a transposition.
    """
    if namespace((a, b)) is np:
        return np.matmul(a, b)
    return jnp.matmul(a, b, precision=PRECISION)


def apply(M: Array, v: Array) -> Array:
    """Return M_k v_k, or M v_k, for all steps: M (N, a, b) or (a, b), v (N, b)."""
    return matmul(v, M.T) if M.ndim == 2 else matmul(M, v[..., None])[..., 0]


def apply_transposed(M: Array, v: Array) -> Array:
    """Return M_k'v_k, or M'v_k, for all steps."""
    return matmul(v, M) if M.ndim == 2 else matmul(v[..., None, :], M)[..., 0, :]


def by_step(
    *data: tuple[Array, int],
) -> tuple[tuple[Any, ...], Callable[[Sequence[Any]], tuple[Any, ...]]]:
    """Return what a scan over the steps reads of arrays, None of one that is the same at all steps,
    and the function that returns all of them at the step of which it is given that part.

    data: each array, and the number of axes that it has at one step.
    """
    each = tuple(v if v.ndim > axes else None for v, axes in data)

    def at(part: Sequence[Any]) -> tuple[Any, ...]:
        return tuple(v if own is None else own for (v, _), own in zip(data, part, strict=True))

    return each, at


def arrays(tree: T) -> T:
    """Leaves as JAX arrays of the present precision, before they enter `jit`.

    (`jit` mixes up host arrays that it has seen under the other setting of 64-bit mode.)
    """
    cast = lambda v: jnp.asarray(v, jax.dtypes.canonicalize_dtype(jnp.result_type(v)))
    return jax.tree.map(cast, tree)


def host_arrays(tree: T) -> T:
    """`arrays`, of NumPy: in the types that JAX gives them in the present precision."""
    cast = lambda v: np.asarray(v, jax.dtypes.canonicalize_dtype(jnp.result_type(v)))
    return jax.tree.map(cast, tree)


def float64_arrays(tree: T) -> T:
    """Leaves as arrays of NumPy in float64."""
    return jax.tree.map(lambda v: np.asarray(v, np.float64), tree)


def on_device(tree: T) -> T:
    """Return arrays of NumPy as arrays of JAX whose memory is their own. (`jnp.array` compiles a
    program for each shape, in JAX 0.12.)"""
    return jax.device_put(jax.tree.map(np.array, tree))


def floating_dtype(tree: Any) -> jnp.dtype:
    """The widest floating type among the leaves, at least float32: no factorization exists in half
    precision. JAX's default float where there is none."""
    of = lambda leaf: jax.dtypes.canonicalize_dtype(jnp.result_type(leaf))
    types = [of(leaf) for leaf in jax.tree.leaves(tree)]
    floats = [dtype for dtype in types if jnp.issubdtype(dtype, jnp.floating)]
    if not floats:
        return jnp.result_type(float)
    return jnp.dtype(jnp.float64 if jnp.dtype(jnp.float64) in floats else jnp.float32)


def cast(tree: T, dtype: DTypeLike) -> T:
    """Return the tree with floating leaves of this type."""
    floating = lambda v: jnp.issubdtype(v.dtype, jnp.floating)
    return jax.tree.map(lambda v: v.astype(dtype) if floating(v) else v, tree)


def symmetric(M: A) -> A:
    """Return the symmetric part of a matrix, which is all that a quadratic form knows of it."""
    return (M + M.swapaxes(-1, -2)) / 2


def in_float64(function: Callable[..., T]) -> Callable[..., T]:
    """The function of float32 arrays, computed in float64, its floating results in float32.

    For residuals, which are small differences of large terms. Works whether or not 64-bit mode
    is on, under any order of `jit` and `vmap`; not differentiable. A plain `jax.enable_x64` would
    hold while the function is traced but not when `vmap` later rewrites the trace: hence a
    batching rule of our own, which turns the mode on again.
    """

    def evaluate(*arguments: Any) -> Any:
        return cast(function(*cast(arguments, jnp.float64)), jnp.float32)

    return _with_x64(evaluate)


def precisely(function: Callable[..., T], *arguments: Any) -> T:
    """Return function(*arguments), evaluated in float64 also where the data are float32.

    Not differentiable where they are (`in_float64`): the derivative is zero.
    """
    if floating_dtype(arguments) == jnp.float64:
        return function(*arguments)
    return in_float64(function)(*jax.lax.stop_gradient(arguments))


def rounding(dtype: DTypeLike) -> float:
    """Return the relative size of what counts as rounding in a residual of data of this type."""
    return (100 if jnp.finfo(dtype).eps < 1e-10 else 4) * float(jnp.finfo(dtype).eps)


def _with_x64(function: Callable) -> Callable:
    def wrapped(*arguments: Any) -> Any:
        with jax.enable_x64(True):
            return function(*arguments)

    def rule(size: int, in_batched: tuple, *arguments: Any) -> Any:
        axes = jax.tree.map(lambda b: 0 if b else None, in_batched)
        return _with_x64(jax.vmap(function, in_axes=axes))(*arguments)

    return batched_by(rule, wrapped)


def infinity_norm(v: Array) -> Array:
    """Return the largest |v_i|, 0 of an empty v."""
    return jnp.max(jnp.abs(v), initial=0.0)


def batched(
    one: Callable,
    plain: Callable | None = None,
    small: int = 0,
    columns: bool = False,
    together: int = TOGETHER,
    cpu: Callable | None = None,
) -> Callable:
    """Return the function `one` of square matrices (…, n, n) and other arrays, whose `vmap` follows
    the rules above.

    one: the answer for one instance, by LAPACK. plain: the same in plain operations for instances
    side by side, all arguments and results with the batch as last axis, used up to `small` rows.
    columns: the second argument is right-hand sides (n, k), the batch of which needs one
    factorization where it shares the matrix. together: multiplications in a call, 0 for one matrix
    a call. cpu: what takes the place of `one` in batches on CPUs.
    """
    each_on_cpu = one if cpu is None else cpu

    def on_cpu(*args: Array) -> Any:
        batch, n = args[0].shape[0], args[0].shape[-1]
        if plain is not None and n <= small:
            return _side_by_side(plain, args)
        if not WAITS:
            return jax.vmap(each_on_cpu)(*args)
        if not isinstance(batch, int):  # a symbolic size, of `jax.export`
            return lax.map(lambda each: each_on_cpu(*each), args)
        size = together // (n * n * max(n, args[-1].shape[-1]))
        return lax.map(lambda each: each_on_cpu(*each), args, batch_size=min(max(size, 1), batch))

    def each(*args: Array) -> Any:
        return lax.platform_dependent(*args, cpu=on_cpu, default=jax.vmap(one))

    def rule_of_many(size: int, in_batched: tuple, *args: Array) -> Any:
        args = broadcast(size, in_batched, args)
        out = many(*(v.reshape(-1, *v.shape[2:]) for v in args))
        return jax.tree.map(lambda v: v.reshape(size, -1, *v.shape[1:]), out)

    def rule(size: int, in_batched: tuple, *args: Array) -> Any:
        if columns and not in_batched[0]:
            M, B = args
            out = single(M, jnp.moveaxis(B, 0, -1).reshape(len(M), -1))
            return jnp.moveaxis(out.reshape(*B.shape[1:], size), -1, 0)
        return many(*broadcast(size, in_batched, args))

    many, single = batched_by(rule_of_many, each), batched_by(rule, one)
    return single


def _side_by_side(plain: Callable, args: tuple[Array, ...]) -> Any:
    """`plain` on groups of LANES, whose data stay within the cache."""
    count = args[0].shape[0]
    if not isinstance(count, int):  # a symbolic size, of `jax.export`
        out = plain(*(jnp.moveaxis(v, 0, -1) for v in args))
        return jax.tree.map(lambda v: jnp.moveaxis(v, -1, 0), out)
    lanes = min(LANES, max(count, 1))
    missing = -count % lanes

    def grouped(v: Array) -> Array:
        v = jnp.concatenate([v, jnp.broadcast_to(v[:1], (missing, *v.shape[1:]))]) if missing else v
        return jnp.moveaxis(v.reshape(-1, lanes, *v.shape[1:]), 1, -1)

    out = lax.map(lambda group: plain(*group), tuple(grouped(v) for v in args))
    flat = lambda v: jnp.moveaxis(v, -1, 1).reshape(-1, *v.shape[1:-1])[:count]
    return jax.tree.map(flat, out)


def _eliminated(M: Array) -> tuple[Array, Array]:
    """Gaussian elimination of M = [K, B] (n, n + k, lanes) without pivoting, K = L D L'.

    Returns [D L', L⁻¹B], L with unit diagonal, and D (n, lanes), NaN in all of a lane where a
    pivot is not positive.
    """
    n = M.shape[0]
    row = jnp.arange(n)[:, None]

    def column(j: Array, M: Array) -> Array:
        pivot = lax.dynamic_index_in_dim(M, j, 0, keepdims=False)
        down = lax.dynamic_index_in_dim(M, j, 1, keepdims=False)
        ratios = jnp.where(row > j, down / lax.dynamic_index_in_dim(down, j, 0), 0.0)
        # Unless they are materialised, XLA computes them again for each entry of M.
        ratios, pivot = lax.optimization_barrier((ratios, pivot))
        return M - ratios[:, None] * pivot

    M = lax.fori_loop(0, n, column, M)
    D = jnp.stack([M[i, i] for i in range(n)])
    return M, jnp.where(jnp.all(D > 0, axis=0), D, jnp.nan)


def _substituted(U: Array, D: Array, B: Array) -> Array:
    """U⁻¹B by columns from the last, U (n, n, lanes) upper triangular with diagonal D."""
    n = U.shape[0]
    row = jnp.arange(n)[:, None, None]

    def column(i: Array, X: Array) -> Array:
        j = n - 1 - i
        x = lax.dynamic_index_in_dim(X, j, 0) / lax.dynamic_index_in_dim(D, j, 0)[:, None]
        u = lax.dynamic_index_in_dim(U, j, 1)
        u, x = lax.optimization_barrier((u, x))
        return jnp.where(row < j, X - u * x, jnp.where(row == j, x, X))

    return lax.fori_loop(0, n, column, varying(B, (U, B)))


def _solve_plain(K: Array, B: Array) -> Array:
    """By the inverse root W, K⁻¹ = W'W, and a step of iterative refinement."""
    W = inverse_root_side_by_side(K)
    product = lambda M, X: jnp.sum(M[:, :, None] * X[None], axis=1)
    rough = lambda X: product(W.swapaxes(0, 1), product(W, X))
    X = rough(B)
    return X + rough(B - product(K, X))


_cholesky_lapack = partial(lax.linalg.cholesky, symmetrize_input=False)
_triangular_lapack = partial(lax.linalg.triangular_solve, left_side=True, lower=True)
_transposed_lapack = partial(_triangular_lapack, transpose_a=True)


def _cholesky_in_blocks(K: Array) -> Array:
    """By halves, until one thread of OpenBLAS factors them."""
    n = len(K)
    if n <= ALONE:
        return _cholesky_lapack(K)
    h = n // 2
    L = _cholesky_in_blocks(K[:h, :h])
    X = _triangular_in_parts(L, K[h:, :h].T).T
    rest = _cholesky_in_blocks(K[h:, h:] - matmul(X, X.T))
    return jnp.block([[L, jnp.zeros((h, n - h), K.dtype)], [X, rest]])


def _in_parts(solve: Callable, L: Array, B: Array) -> Array:
    """Return solve(L, B) by calls with as many columns as one thread of OpenBLAS solves for."""
    n, k = B.shape
    width = max((THREADED - 1) // max(n, 1), 1)
    count = -(-k // width)
    if count <= 1:
        return solve(L, B)
    parts = jnp.pad(B, ((0, 0), (0, count * width - k))).reshape(n, count, width)
    X = solve(jnp.broadcast_to(L, (count, n, n)), jnp.moveaxis(parts, 1, 0))
    return jnp.moveaxis(X, 0, 1).reshape(n, -1)[:, :k]


_triangular_in_parts = partial(_in_parts, _triangular_lapack)


def _solve_lapack(K: Array, B: Array) -> Array:
    L = _cholesky_lapack(K)
    return _transposed_lapack(L, _triangular_lapack(L, B))


def _solve_in_blocks(K: Array, B: Array) -> Array:
    L = _cholesky_in_blocks(K)
    return _in_parts(_transposed_lapack, L, _triangular_in_parts(L, B))


def _cholesky_plain(K: Array) -> Array:
    M, D = _eliminated(K)
    upper = jnp.arange(K.shape[0])[:, None] <= jnp.arange(K.shape[0])
    return jnp.where(upper[..., None], M / jnp.sqrt(D)[:, None], 0.0).swapaxes(0, 1)


def inverse_root_side_by_side(K: Array) -> Array:
    """Return the `inverse_root` of each matrix of K (n, n, lanes); NaN where there is none."""
    n = K.shape[0]
    identity = jnp.broadcast_to(jnp.eye(n, dtype=K.dtype)[..., None], K.shape)
    M, D = _eliminated(jnp.concatenate([K, identity], axis=1))
    return M[:, n:] / jnp.sqrt(D)[:, None]


def _inverse_root_lapack(K: Array) -> Array:
    return _triangular_lapack(_cholesky_lapack(K), jnp.eye(len(K), dtype=K.dtype))


def _inverse_root_in_blocks(K: Array) -> Array:
    return _triangular_in_parts(_cholesky_in_blocks(K), jnp.eye(len(K), dtype=K.dtype))


def _triangular_plain(L: Array, B: Array) -> Array:
    flipped = L[::-1, ::-1]
    D = jnp.stack([flipped[i, i] for i in range(L.shape[0])])
    return _substituted(flipped, D, B[::-1])[::-1]


_solve = batched(_solve_lapack, _solve_plain, small=6, columns=True, cpu=_solve_in_blocks)
_cholesky = batched(_cholesky_lapack, _cholesky_plain, small=12, cpu=_cholesky_in_blocks)
_inverse_root = batched(
    _inverse_root_lapack, inverse_root_side_by_side, small=12, cpu=_inverse_root_in_blocks
)
_triangular = batched(
    _triangular_lapack, _triangular_plain, small=6, columns=True, cpu=_triangular_in_parts
)
_general = batched(jnp.linalg.solve, columns=True)
_eigh = batched(lambda K: tuple(jnp.linalg.eigh(K)), together=0)


def solve(K: Array, B: Array) -> Array:
    """Return K⁻¹B for K (n, n) symmetric positive definite and B (n,) or (n, k)."""
    fixed = lax.stop_gradient(K)
    return lax.custom_linear_solve(
        lambda X: matmul(K, X), B, lambda _, B: _columns(_solve, fixed, B), symmetric=True
    )


def solve_general(M: Array, B: Array) -> Array:
    """Return M⁻¹B for M (n, n) nonsingular and B (n,) or (n, k)."""
    fixed = lax.stop_gradient(M)
    forward = lambda _, B: _columns(_general, fixed, B)
    backward = lambda _, B: _columns(_general, fixed.T, B)
    return lax.custom_linear_solve(lambda X: matmul(M, X), B, forward, backward)


def solve_triangular(L: Array, B: Array) -> Array:
    """Return L⁻¹B for L (n, n), of which the lower triangle is read, and B (n,) or (n, k)."""
    L = jnp.tril(L)
    fixed = lax.stop_gradient(L)
    turned = lambda _, B: _columns(_triangular, fixed.T[::-1, ::-1], B[::-1])[::-1]
    return lax.custom_linear_solve(
        lambda X: matmul(L, X), B, lambda _, B: _columns(_triangular, fixed, B), turned
    )


def _columns(function: Callable, M: Array, B: Array) -> Array:
    return function(M, B) if B.ndim == 2 else function(M, B[:, None])[:, 0]


@jax.custom_jvp
def cholesky(K: Array) -> Array:
    """Return the lower triangular L with L L' = K, symmetric positive definite (n, n)."""
    return _cholesky(K)


@cholesky.defjvp
@own_modes
def _(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    # L⁻¹ dK L⁻' = S + S' with S = L⁻¹ dL lower triangular (Murray 2016, arXiv:1602.07527, eq. 8).
    L = cholesky(*primals)
    half = solve_triangular(L, tangents[0])
    return L, matmul(L, _lower_half(solve_triangular(L, half.T).T))


@jax.custom_jvp
def inverse_root(K: Array) -> Array:
    """Return the lower triangular W with W K W' = I, for K symmetric positive definite (n, n).

    W is the inverse of the Cholesky factor: K⁻¹ = W'W.
    """
    return _inverse_root(K)


@inverse_root.defjvp
@own_modes
def _(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    W = inverse_root(*primals)
    return W, -matmul(_lower_half(matmul(W, matmul(tangents[0], W.T))), W)


def definite_solver(K: Array) -> Callable[[Array], Array]:
    """Return the function v (n,) → K⁻¹v for K (n, n) symmetric positive definite, factored once.

    By products with the inverse root, which batches take in one; a step of iterative refinement
    makes up for what an explicit inverse loses on ill-conditioned K (Higham 2002, §12.1).
    """
    W = inverse_root(K)
    rough = lambda v: matmul(matmul(v, W.T), W)

    def solved(v: Array) -> Array:
        x = rough(v)
        return x + rough(v - matmul(x, K))

    return solved


def _lower_half(S: Array) -> Array:
    """The lower triangle of S with half of its diagonal."""
    return jnp.tril(S) - 0.5 * jnp.diag(jnp.diag(S))


@jax.custom_jvp
def eigh(K: Array) -> tuple[Array, Array]:
    """Return the eigenvalues (n,), rising, and eigenvectors as columns (n, n) of a symmetric K."""
    return _eigh(K)


@eigh.defjvp
@own_modes
def _(primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    w, V = eigh(*primals)
    moved = matmul(V.T, matmul(tangents[0], V))
    gaps = w[None, :] - w[:, None] + jnp.eye(len(w), dtype=w.dtype)
    turned = moved * (1 - jnp.eye(len(w), dtype=w.dtype)) / gaps
    return (w, V), (jnp.diag(moved), matmul(V, turned))


@jax.custom_jvp
def symmetric_root(K: Array) -> Array:
    """Return S = S' ⪰ 0 with S S = K (n, n) ⪰ 0. A continuous function of K, also where K is
    singular or its eigenvalues meet, unlike Cholesky factors and eigenvectors."""
    w, V = eigh(K)
    return matmul(V * jnp.sqrt(jnp.maximum(w, 0)), V.T)


@symmetric_root.defjvp
@own_modes
def _(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    # dS S + S dS = dK, in the eigenvectors of K; infinite within its null space, 0 here.
    w, V = eigh(*primals)
    roots = jnp.sqrt(jnp.maximum(w, 0))
    sums = roots[None, :] + roots[:, None]
    moved = matmul(V.T, matmul(tangents[0], V))
    moved = jnp.where(sums > 0, moved / jnp.where(sums > 0, sums, 1.0), 0.0)
    return matmul(V * roots, V.T), matmul(V, matmul(moved, V.T))


def _cholesky_in_place(K: Array, **_: Any) -> Array:
    return cholesky(K)


def _triangular_in_place(
    M: Array,
    B: Array,
    *,
    left_side: bool,
    lower: bool,
    transpose_a: bool,
    unit_diagonal: bool,
    **_: Any,
) -> Array:
    """The operation of `jax.lax.linalg.triangular_solve` for one real matrix."""
    if not left_side:  # X M = B is M'X' = B'
        B, transpose_a = B.T, not transpose_a
    M = jnp.tril(M) if lower else jnp.triu(M)
    if unit_diagonal:
        M = M - jnp.diag(jnp.diag(M)) + jnp.eye(len(M), dtype=M.dtype)
    if transpose_a:
        M, lower = M.T, not lower
    X = solve_triangular(M, B) if lower else solve_triangular(M[::-1, ::-1], B[::-1])[::-1]
    return X if left_side else X.T


def stand_ins() -> dict[Any, Callable]:
    """Return what replaces JAX's own operations in functions of other libraries
    (`robots/jaxpr_rewriting.py`), by primitive: nothing where batches of them are safe."""
    if not WAITS:
        return {}
    return {
        lax.linalg.cholesky_p: _cholesky_in_place,
        lax.linalg.triangular_solve_p: _triangular_in_place,
    }
