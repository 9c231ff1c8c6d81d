"""Programs with more active rows than the first systems of the search on the dual take."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.qp import dual
from jaxmpc.qp.admm import factorise
from jaxmpc.qp.solve import solve_factored

N, ROWS, FIRST = 24, 36, 12


def constructed(rng, P, A, active):
    """Return q, l, u of a program whose solution z has so many active rows: Pz + q + A'y = 0."""
    z, value = (v := rng.standard_normal(N)), A @ v
    y = np.zeros(ROWS)
    y[rng.permutation(ROWS)[:active]] = rng.uniform(0.5, 2, active) * rng.choice([-1, 1], active)
    room = rng.uniform(0.1, 1, (2, ROWS))
    l, u = np.where(y < 0, value, value - room[0]), np.where(y > 0, value, value + room[1])
    return z, -P @ z - A.T @ y, l, u


@pytest.mark.long
@pytest.mark.parametrize("kernels", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_they_are_solved_by_steps_on_the_dual(kernels, monkeypatch):
    """Without the method of multipliers, each of whose steps has a system of all variables; also as
    on a GPU, where programs with few active rows are done by a kernel."""
    monkeypatch.setattr(dual, "MOST_ROWS", FIRST)
    monkeypatch.setattr(dual, "KERNEL_ROWS", FIRST)
    monkeypatch.setattr(dual, "has_kernels", lambda rows: kernels)
    rng = np.random.default_rng(0)
    M = rng.standard_normal((N, N))
    P, A = M @ M.T / N + 0.1 * np.eye(N), np.vstack([np.eye(N), rng.standard_normal((ROWS - N, N))])
    active = rng.permutation(np.arange(32) % (N - 1))
    z, *data = (np.stack(v) for v in zip(*(constructed(rng, P, A, k) for k in active), strict=True))
    with jax.enable_x64(True):
        solver = jm.ADMM()
        made = factorise(jnp.asarray(P), jnp.asarray(A), solver)
        solve = lambda q, l, u: solve_factored(jm.QP(P, q, A, l, u), made, solver, whole=False)[0]
        found = jax.jit(jax.vmap(solve))(*map(jnp.asarray, data))
    assert np.all(found.status == jm.Status.SOLVED), active[found.status != jm.Status.SOLVED]
    np.testing.assert_allclose(found.z, z, rtol=0, atol=1e-8)
