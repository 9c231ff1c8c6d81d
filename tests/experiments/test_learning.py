"""The learning examples: gradients and plans against other ways to them, and that they learn."""

import importlib.util
import sys
from pathlib import Path

import cvxpy as cp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

FOLDER = Path(__file__).parents[2] / "experiments" / "learning"


def script(name):
    """A script of the folder as a module."""
    spec = importlib.util.spec_from_file_location(f"learning_{name}", FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look themselves up there
    spec.loader.exec_module(module)
    return module


references, imitation = script("references"), script("imitation")
SMALL = references.Settings(tasks=4, samples=10, hidden=4, horizon=3, updates=20, pairs=2, rate=0.1)


@pytest.mark.slow
def test_gradient_through_network_and_loops():
    with jax.enable_x64(True):
        controller, tasks = references.law(SMALL), references.draw(SMALL, 0)
        theta, unravel = ravel_pytree(jax.tree.map(jnp.asarray, references.first(SMALL)))
        aside = jnp.asarray(np.random.default_rng(0).normal(size=theta.size))
        theta = theta + 0.1 * aside  # no layer is zero

        @jax.jit
        def loss(theta):
            run = references.loops(controller, unravel(theta), tasks, SMALL.samples)
            return references.loss_of(run, tasks)

        slope = jax.jit(jax.grad(loss))(theta)
        want = (loss(theta + 1e-5 * aside) - loss(theta - 1e-5 * aside)) / 2e-5
        np.testing.assert_allclose(slope @ aside, want, rtol=1e-4)


@pytest.mark.slow
def test_learning_lowers_the_loss():
    table = references.run(SMALL)
    assert table.keys() == {"none", "gradient", "evolution", "random"}
    assert table["gradient"]["loss, known"] < 0.98 * table["none"]["loss, known"]
    # Random search begins with no correction and keeps what is better.
    assert table["random"]["loss, known"] <= table["none"]["loss, known"] * (1 + 1e-5)


@pytest.mark.slow
def test_plans_of_the_expert():
    """The lesson is what Clarabel finds, for the cost as it is written in the script."""
    s = imitation.Settings(steps=1, batch=4, limit=0.5)
    random = np.random.default_rng(1)
    expert = imitation.draw(random)
    (batch,) = imitation.lesson(s, expert, random)
    assert (np.abs(batch.inputs) > 0.5 - 1e-6).any()
    for x, states, inputs in zip(*batch, strict=True):
        X, U = cp.Variable((5, 3)), cp.Variable((5, 3))
        rows = [X[0] == x, cp.abs(U) <= 0.5]
        rows += [X[k + 1] == expert.A @ X[k] + expert.B @ U[k] for k in range(4)]
        tau = cp.hstack([X, U])
        cost = cp.sum_squares(tau) / 2 - cp.sum(tau @ expert.r)
        cp.Problem(cp.Minimize(cost), rows).solve(cp.CLARABEL)
        np.testing.assert_allclose(states, X.value, atol=1e-5)
        np.testing.assert_allclose(inputs, U.value, atol=1e-5)


@pytest.mark.slow
def test_imitation_learns_both_tasks():
    s = imitation.Settings(steps=15, batch=32, newton_steps=0, bits=(64,), rivals=())
    for found in imitation.run(s).values():
        losses = found["jaxmpc, float64"].losses
        assert losses[-1] < 0.7 * losses[0]
