"""The GPU kernels of the stage recursions, run without one, and batches side by side on CPUs,
against the scans."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.mpc import solve_nonlinear
from jaxmpc.mpc.stagewise import recursion_kernels as kernels


def batch(rng, N, n, m, staged):
    """Two random problems: Q, R, A, B, gx, gu."""
    square = lambda *shape: (
        lambda W: jnp.asarray(W @ W.swapaxes(-1, -2) + np.eye(shape[-1]), jnp.float32)
    )(rng.normal(size=(2, *shape)))
    stages = (N,) if staged else ()
    random = lambda *shape: jnp.asarray(0.4 * rng.normal(size=(2, *shape)), jnp.float32)
    return (
        square(N + 1, n, n), square(N, m, m), random(*stages, n, n), random(*stages, n, m),
        random(N + 1, n), random(N, m),
    )  # fmt: skip


def close(found, expected):
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-5 * float(jnp.max(jnp.abs(b))))


@pytest.mark.parametrize("staged", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_kernels_equal_the_scans(staged):
    """N, n and m that are no powers of two, under vmap, as all programs of a batch run."""
    rng = np.random.default_rng(3)
    Q, R, A, B, gx, gu = batch(rng, 3, 5, 2, staged)
    both = lambda scan, kernel, *args, **options: (
        jax.jit(jax.vmap(lambda *a: kernel(*a, **options)))(*args),
        jax.jit(jax.vmap(lambda *a: scan(*a, **options)))(*args),
    )
    found, gains = both(kernels._riccati_scan, kernels._riccati_kernel, Q, R, A, B)
    close(found, gains)
    scan = functools.partial(kernels._tracking_by, kernels._scan)
    close(*both(scan, kernels._tracking_kernel, gains, A, B, gx, gu))
    for adjoint in (False, True):
        scan = lambda *a, adjoint: kernels._scan(*a, adjoint=adjoint, unroll=1)
        close(*both(scan, kernels._recurrence_kernel, A, gx[:, 1:], gx[:, 0], adjoint=adjoint))


# N = 5 has a last piece that is not full, N = 9 full ones. The first four have each pair of values,
# the first two each value.
@pytest.mark.first(2)
@pytest.mark.parametrize(
    ("N", "staged", "adjoint"),
    [(5, False, True), (9, True, False), (9, False, False), (5, True, True),
     (5, False, False), (5, True, False), (9, False, True), (9, True, True)],
)  # fmt: skip
def test_recurrences_in_pieces_are_the_scan(N, staged, adjoint):
    """Of a batch whose matrices are shared or each problem's own."""
    with jax.enable_x64(True):
        rng = np.random.default_rng(N)
        M = rng.normal(size=(2, N, 3, 3) if staged else (2, 3, 3))
        w, start = rng.normal(size=(2, N, 3)), rng.normal(size=(2, 3))
        for shared in (False, True):
            given = (M[0], w, start) if shared else (M, w, start)
            axes = (None if shared else 0, 0, 0)
            both = lambda *given: [
                run(*given, adjoint=adjoint)
                for run in (kernels._recurrence_in_pieces, kernels._scan)
            ]
            found, expected = jax.jit(jax.vmap(both, axes))(*given)
            np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-13)


def test_covariances_in_pieces_are_those_of_all_stages(monkeypatch):
    """They are E[x x'] of x⁺ = C x + e with e of covariance W, summed from each e on its own."""
    with jax.enable_x64(True):
        rng = np.random.default_rng(7)
        C, root = 0.7 * rng.normal(size=(7, 3, 3)), rng.normal(size=(7, 3, 3))
        expected, moved = [], []
        for k in range(7):
            moved = [C[k] @ R for R in moved] + [root[k]]
            expected.append(sum(R @ R.T for R in moved))
        given = jnp.asarray(C), jnp.asarray(root @ root.swapaxes(1, 2))
        for on_gpu, long in ((False, 2), (True, 2), (True, 8)):
            monkeypatch.setattr(kernels, "on_gpu", lambda on_gpu=on_gpu: on_gpu)
            monkeypatch.setattr(kernels, "LONG_HORIZON", long)
            np.testing.assert_allclose(kernels.covariances(*given), expected, rtol=1e-12)


@pytest.mark.first(1)
@pytest.mark.parametrize("kind", ["staged", "one input matrix", "late cost", "units"])
def test_riccati_recursions_in_pieces_are_the_scan(kind):
    """Of a plant that is unstable: with weights that a stage may lack, with a cost of the last
    state alone, and in units that are 10^10 apart."""
    with jax.enable_x64(True):
        rng, N, n, m = np.random.default_rng(4), 11, 4, 2
        A = rng.normal(size=(n, n))
        A *= 1.2 / np.abs(np.linalg.eigvals(A)).max()
        B, W = rng.normal(size=(n, m)), rng.normal(size=(N + 1, n, 2))
        Q, R = W @ W.swapaxes(1, 2), np.eye(m) * 10 ** rng.uniform(-3, 3, (N, 1, 1))
        if kind == "late cost":
            Q[:-1] = 0.0
            Q[-1] += np.eye(n)
        if kind == "units":
            unit = 10 ** np.array([-5.0, 5.0, 0.0, 2.0])
            A, B, Q = unit[:, None] * A / unit, unit[:, None] * B, Q / unit / unit[:, None]
        if kind == "staged":
            A, B = A + 0.1 * rng.normal(size=(N, n, n)), B + 0.1 * rng.normal(size=(N, n, m))
        batch = [np.stack([v, 2 * v]) for v in (Q, R)]
        both = lambda *given: [
            run(*given) for run in (kernels._riccati_in_pieces, kernels._riccati_scan)
        ]
        found, expected = jax.jit(jax.vmap(both, (0, 0, None, None)))(*batch, A, B)
        for a, b in zip(found[:3], expected[:3], strict=True):
            size = jnp.max(jnp.abs(b), axis=2, keepdims=True)
            np.testing.assert_allclose(a / size, b / size, atol=1e-10)


@pytest.mark.slow  # on GPUs; what it is made of is compared above
def test_long_horizons_are_divided(monkeypatch):
    """Tracking by gains with products of their pieces, and its derivatives, are the scan's."""
    with jax.enable_x64(True):
        Q, R, A, B, gx, gu = (
            jnp.asarray(v[0], jnp.float64) for v in batch(np.random.default_rng(6), 5, 3, 2, False)
        )

        def tracked():
            def inputs(Q, gx):
                gains = kernels.riccati_recursion(Q, R, None, A, B)
                u = kernels.tracking(gains, A, B, gx, gu)[1]
                return jnp.sum(u**2), (u, gains.products)

            run = jax.jit(jax.value_and_grad(inputs, argnums=(0, 1), has_aux=True))
            (_, (u, products)), slopes = run(Q, gx)
            return (u, *slopes), products

        expected, none = tracked()
        monkeypatch.setattr(kernels, "on_gpu", lambda: True)
        monkeypatch.setattr(kernels, "LONG_HORIZON", 4)
        found, products = tracked()
        assert none is None and products.shape == (2, 3, 3)
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12)


@pytest.mark.long
@pytest.mark.first(1)
@pytest.mark.parametrize("staged", [False, True])
def test_a_batch_side_by_side_is_the_scan(staged):
    """On CPUs: values, and the derivative of the scans, of nested batches too."""
    with jax.enable_x64(True):
        problems = batch(np.random.default_rng(2), 3, 5, 2, staged)[:4]
        Q, R, A, B = (jnp.asarray(v, jnp.float64) for v in problems)
        last = lambda v: jnp.moveaxis(v, 0, -1)
        first = lambda v: jnp.moveaxis(v, -1, 0)
        scan = jax.jit(jax.vmap(lambda *v: kernels._riccati_scan(*v)))
        own = jax.jit(lambda *v: jax.tree.map(first, kernels._riccati_lanes(*map(last, v))))
        chosen = lambda Q, R, A, B: kernels.riccati_recursion(Q, R, None, A, B)
        nested = jax.jit(jax.vmap(jax.vmap(chosen, (0, 0, None, 0)), (None, None, 0, None)))
        expected = jax.jit(jax.vmap(lambda A: scan(Q, R, jnp.stack([A, A]), B)))(A)
        for found, wanted in (
            (own(Q, R, A, B), scan(Q, R, A, B)), (nested(Q, R, A, B), expected)
        ):  # fmt: skip
            for a, b in zip(*map(jax.tree.leaves, (found, wanted)), strict=True):
                np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)
        slope = lambda of: jax.jit(jax.grad(lambda A: jnp.sum(of(Q, R, A, B).K ** 3)))(A)
        np.testing.assert_allclose(slope(jax.vmap(chosen)), slope(scan), rtol=1e-10)


@pytest.mark.slow
def test_tracking_is_the_minimiser():
    """Gradient of Σ ½ x'Qx + ½ u'Ru − g·(x, u) along its own x, u: zero (float64, by autodiff)."""
    with jax.enable_x64(True):
        rng = np.random.default_rng(0)
        Q, R, A, B, gx, gu = (
            jnp.asarray(v[0], jnp.float64) for v in batch(rng, 4, 3, 2, True)
        )  # fmt: skip
        gains = kernels.riccati_recursion(Q, R, None, A, B)
        x, u = kernels.tracking(gains, A, B, gx, gu)

        def value(u):
            states = [jnp.zeros(3)]
            for k in range(4):
                states.append(A[k] @ states[-1] + B[k] @ u[k])
            s = jnp.stack(states)
            quadratic = jnp.einsum("ki,kij,kj", s, Q, s) + jnp.einsum("ki,kij,kj", u, R, u)
            return quadratic / 2 - jnp.sum(gx * s) - jnp.sum(gu * u), s

        gradient, states = jax.grad(value, has_aux=True)(u)
        np.testing.assert_allclose(states, x, atol=1e-12)
        np.testing.assert_allclose(gradient, 0, atol=1e-11)


def test_a_kernel_is_chosen_on_gpus_only(monkeypatch):
    """And only for sides that a warp holds; its derivative is the scan's."""
    calls = []

    def kernel(v):
        calls.append(v.shape)
        return v**2

    scan = lambda v: v**2
    monkeypatch.setattr(kernels, "on_gpu", lambda: False)
    assert kernels._or_kernel(scan, kernel, jnp.ones(3)).shape == (3,) and not calls
    monkeypatch.setattr(kernels, "on_gpu", lambda: True)
    kernels._or_kernel(scan, kernel, jnp.ones(33))
    assert not calls
    one = jnp.array([3.0])
    assert jax.grad(lambda v: kernels._or_kernel(scan, kernel, v)[0])(one) == 6
    assert calls == [] or set(calls) == {(1,)}
    assert kernels._or_kernel(scan, kernel, one) == 9 and calls


def test_nonlinear_plans_are_differentiated_backward_through_kernels(monkeypatch):
    """A kernel has no transpose: what is linear in tangents is a derivative of itself. Traced."""
    monkeypatch.setattr(kernels, "on_gpu", lambda: True)
    mpc = jm.MPC(jm.LinearSystem(np.eye(2), np.ones((2, 1))), [1.0, 1.0], [1.0], 3)
    model = lambda x, u: jnp.stack([x[0] + 0.1 * x[1], x[1] + 0.1 * u[0] + 0.1 * jnp.sin(x[0])])
    cost = lambda x: solve_nonlinear(jm.NonlinearMPC(mpc, model), x).cost
    with jax.enable_x64(True):
        text = str(jax.make_jaxpr(jax.grad(cost))(jnp.array([0.5, 0.2])))
    assert "gpu_kernel" in text


def test_derivatives_under_vmap_and_jit(monkeypatch):
    """Where the kernels run, a batched loop has the derivative of the scans, in both modes."""
    rng = np.random.default_rng(1)
    _, _, A, _, gx, _ = batch(rng, 3, 4, 2, False)

    def loop(A, gx):
        def sample(x, w):
            states = kernels.recurrence(A, jnp.stack([w, w]), x)
            return jnp.concatenate([x[None], states])[2], None

        return jnp.sum(jax.lax.scan(sample, gx[0], gx[1:])[0] ** 2)

    total = lambda A, gx: jnp.sum(jax.vmap(loop)(A, gx))
    by = lambda mode: jax.jit(mode(lambda A, gx: total(A, gx)))(A, gx)
    scans = by(jax.grad)
    monkeypatch.setattr(kernels, "on_gpu", lambda: True)
    close(by(jax.grad), scans)
    close(by(jax.jacfwd), scans)
