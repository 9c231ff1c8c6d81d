"""The interior point method stage by stage where its steps used to become short."""

import jax
import numpy as np

import jaxmpc as jm


def test_plans_from_far_outside_soft_limits_are_solved():
    """States up to 2.5 times beyond soft limits of a small weight, of which most plans once ended
    at the limit of steps; the plans are those of the condensed problem."""
    rng, k, count = np.random.default_rng(0), 2, 8
    W, G = rng.normal(size=(2, k, k))
    inverse = np.linalg.inv(np.eye(k) + W @ W.T / k)
    A = np.block([[np.zeros((k, k)), np.eye(k)], [-inverse @ (G + G.T) / 2, -0.5 * inverse]])
    system = jm.LinearSystem.from_continuous(A, np.vstack([np.zeros((k, k)), inverse]), 0.05)
    limit = np.repeat([1.0, 0.8], k)
    mpc = jm.MPC(
        system, np.repeat([10.0, 1.0], k), 0.1 * np.ones(k), 20, states=jm.Box(-limit, limit),
        inputs=jm.Box(-3 * np.ones(k), 3 * np.ones(k)), prestabilise=False,
    )  # fmt: skip
    soft = jm.soften(mpc, 10.0)
    x0s = rng.uniform(-2.5, 2.5, (count, 2 * k)) * limit
    with jax.enable_x64(True):
        solver = jm.ADMM(iterations=0)
        plan = jax.jit(jax.vmap(lambda x: jm.mpc.solve_stagewise(soft, x, solver=solver)))(x0s)
    assert np.all(plan.status == jm.Status.SOLVED)
    expected = jm.solve_many(soft, x0s)
    np.testing.assert_allclose(plan.cost, expected.cost, rtol=1e-6)
    np.testing.assert_allclose(plan.inputs, expected.inputs, atol=2e-5)
