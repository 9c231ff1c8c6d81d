"""The learning example: its gradient against finite differences, and that each method learns."""

import importlib.util
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

FILE = Path(__file__).parents[2] / "experiments" / "learning" / "references.py"
spec = importlib.util.spec_from_file_location("learning_references", FILE)
references = importlib.util.module_from_spec(spec)
sys.modules["learning_references"] = references  # dataclasses look themselves up there
spec.loader.exec_module(references)

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
