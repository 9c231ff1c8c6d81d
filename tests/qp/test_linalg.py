"""Factorizations and solves in batches: values, derivatives, and no LAPACK call for a batch."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmpc.qp import linalg

FUNCTIONS = {  # ours, and NumPy's answer
    "solve": (linalg.solve, lambda K, B: np.linalg.solve(K, B)),
    "solve_general": (linalg.solve_general, lambda K, B: np.linalg.solve(K, B)),
    "solve_triangular": (linalg.solve_triangular, lambda K, B: np.linalg.solve(np.tril(K), B)),
    "cholesky": (lambda K, B: linalg.cholesky(K), lambda K, B: np.linalg.cholesky(K)),
    "inverse_root": (
        lambda K, B: linalg.inverse_root(K), lambda K, B: np.linalg.inv(np.linalg.cholesky(K)),
    ),
    "eigh": (
        lambda K, B: (lambda w, V: (V * w) @ V.T)(*linalg.eigh(K)), lambda K, B: K,
    ),
}  # fmt: skip
# What jax differentiates by itself, for the derivatives.
PEERS = {
    "solve": jnp.linalg.solve,
    "solve_general": jnp.linalg.solve,
    "solve_triangular": lambda K, B: jax.scipy.linalg.solve_triangular(K, B, lower=True),
    "cholesky": lambda K, B: jnp.linalg.cholesky(K),
    "inverse_root": lambda K, B: jnp.linalg.inv(jnp.linalg.cholesky(K)),
    "eigh": lambda K, B: (lambda w, V: (V * w) @ V.T)(*jnp.linalg.eigh(K)),
}


def matrices(count, n, seed=0, k=3):
    """Well-conditioned definite matrices (count, n, n) and right-hand sides (count, n, k)."""
    rng = np.random.default_rng(seed)
    M = rng.normal(size=(count, n, n))
    return M @ M.swapaxes(1, 2) / n + np.eye(n), rng.normal(size=(count, n, k))


@pytest.mark.parametrize("n", [1, 3, 6, 12, 13])
@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.first(4)
def test_values(name, n):
    """One, a batch that is no multiple of the group, nested batches, and a shared matrix."""
    function, expected = FUNCTIONS[name]
    with jax.enable_x64(True):
        K, B = matrices(linalg.LANES + 6, n)
        truth = np.stack([expected(*pair) for pair in zip(K, B, strict=True)])
        close = lambda found, of: np.testing.assert_allclose(found, of, rtol=1e-9, atol=1e-11)

        @jax.jit
        def every_way(K, B):
            nested = jax.vmap(jax.vmap(function))(K.reshape(10, 7, n, n), B.reshape(10, 7, n, 3))
            shared = jax.vmap(function, in_axes=(None, 0))(K[0], B)
            return function(K[0], B[0]), jax.vmap(function)(K, B), nested, shared

        one, batch, nested, shared = every_way(K, B)
        close(one, truth[0])
        close(batch, truth)
        close(nested.reshape(truth.shape), truth)
        close(shared, np.stack([expected(K[0], b) for b in B]))


@pytest.mark.parametrize("n", [3, pytest.param(13, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.first(2)
def test_derivatives(name, n):
    """Reverse, forward, and forward over reverse, under vmap: those of JAX's own routines."""
    with jax.enable_x64(True):
        K, B = matrices(3, n, seed=1)

        def total(function):
            return lambda K, B: jnp.sum(jnp.sin(function((K + K.T) / 2, B)))

        ours, theirs = total(FUNCTIONS[name][0]), total(PEERS[name])
        derivatives = (
            lambda f: jax.grad(f, argnums=(0, 1)),
            lambda f: jax.jacfwd(f, argnums=(0, 1)),
            lambda f: lambda K, B: jax.jvp(lambda K: jax.grad(f)(K, B), (K,), (jnp.cos(K),))[1],
        )

        @jax.jit
        def both(K, B):
            return [[jax.vmap(d(f))(K, B) for d in derivatives] for f in (ours, theirs)]

        found, expected = both(K, B)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-7, atol=1e-8 * (1 + np.abs(b).max()))


@pytest.mark.parametrize("n", [3, 13])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_an_empty_batch(name, n):
    function, shape = FUNCTIONS[name][0], (0, n, n)
    found = jax.vmap(function)(np.zeros(shape), np.zeros(shape))
    assert found.shape == shape


@pytest.mark.parametrize("n", [3, 13])
def test_an_indefinite_matrix_is_nan_alone(n):
    K, B = matrices(4, n)
    K[1, 0, 0] = -1.0
    for name in ("solve", "cholesky", "inverse_root"):
        found = jax.vmap(FUNCTIONS[name][0])(jnp.asarray(K), jnp.asarray(B))
        bad = [bool(jnp.any(jnp.isnan(part))) for part in found]
        assert bad == [False, True, False, False]


@pytest.mark.cpu
@pytest.mark.parametrize("n", [40, 130])
def test_openblas_gets_parts_that_one_thread_works_off(n):
    """Its threads wait for each other. Values, and NaN where a matrix is indefinite alone."""
    K, B = matrices(4, n, k=n)
    K[1, -1, -1] = -1.0
    names = "solve_triangular", "cholesky", "inverse_root", "solve"
    with jax.enable_x64(True):
        every = jax.jit(jax.vmap(lambda K, B: [FUNCTIONS[name][0](K, B) for name in names]))
        program = every.lower(K, B).compile()
        found = program(K, B)
    for name, values in zip(names, found, strict=True):
        for i in (0, 2, 3):
            expected = FUNCTIONS[name][1](K[i], B[i])
            np.testing.assert_allclose(values[i], expected, rtol=1e-8, atol=1e-10)
        assert name == "solve_triangular" or np.isnan(values[1]).any()
    call = r"f64\[(?:\d+,)*(\d+),(\d+)\][^\n]*custom_call_target=\"lapack_d(potrf|trsm)_ffi"
    calls = re.findall(call, program.as_text())
    assert {name for *_, name in calls} == {"potrf", "trsm"}
    for rows, columns, name in calls:
        rows, columns = int(rows), int(columns)
        if name == "potrf":
            assert rows <= linalg.ALONE
        else:
            assert rows * columns < linalg.THREADED
