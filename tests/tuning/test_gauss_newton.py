"""Gauss-Newton steps: closed forms, and an expert's weights found from its trajectories."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.tuning import Parameter, tune_weights
from jaxmpc.tuning.objective import DAMPING, LARGEST, damped_steps

SYSTEM = jm.LinearSystem(np.array([[1.0, 0.2], [0.0, 1.0]]), np.array([[0.02], [0.2]]), dt=0.2)
MPC = jm.MPC(SYSTEM, np.eye(2), np.eye(1), 5, inputs=jm.Box([-1.0], [1.0]))
SOLVER = jm.ADMM(iterations=80, newton_steps=0, eps=1e-3)
HIDDEN = {"q": np.array([4.0, 0.5]), "r": np.array([0.2])}
STARTS = np.random.default_rng(0).uniform(-2, 2, (16, 2))


def make(v):
    Q = jnp.diag(jnp.asarray(v["q"]))
    return replace(MPC, Q=Q, R=jnp.diag(jnp.asarray(v["r"])), terminal_cost=Q)


def test_damped_steps_solve_their_equations():
    """With the absolute eigenvalues of the curvature; no number moves by more than LARGEST."""
    rng = np.random.default_rng(0)
    M, gradient = rng.normal(size=(3, 3)), rng.normal(size=3)
    for C, positive in ((M @ M.T, M @ M.T), (np.diag([2.0, -1.0, 1.0]), np.diag([2.0, 1.0, 1.0]))):
        scale, short = np.trace(positive) / 3, 0
        for mu, step in zip(DAMPING, damped_steps(gradient, C), strict=True):
            whole = np.linalg.solve(positive + mu * scale * np.eye(3), -gradient)
            most = np.abs(whole).max()
            short += most > LARGEST
            np.testing.assert_allclose(step, whole * min(1, LARGEST / most), rtol=1e-9)
        assert short < len(DAMPING)
    # Without curvature: along the gradient, its length that of 1/μ.
    steps = damped_steps(gradient, np.zeros((3, 3)))
    unit = gradient / np.linalg.norm(gradient)
    np.testing.assert_allclose(steps[DAMPING >= 1], -unit / DAMPING[DAMPING >= 1, None])
    np.testing.assert_allclose(np.abs(steps).max(axis=1)[0], LARGEST)


@pytest.mark.slow
def test_hidden_weights_are_found_in_a_few_steps():
    """From the trajectories of an expert, inputs at their limits among them: 16 digits of the loss
    where a step of Adam gains a few per cent; weights are determined up to a common factor."""
    with jax.enable_x64(True):
        expert = jm.simulate_many(jm.Controller(make(HIDDEN), SOLVER), SYSTEM, STARTS, 10)
        assert np.mean(np.abs(expert.inputs) > 1 - 1e-6) > 0.1

        def loss(run):
            same = jnp.argmin(jnp.sum((STARTS - run.states[0]) ** 2, axis=1))
            return jnp.mean((run.states - jnp.asarray(expert.states)[same]) ** 2)

        wrong = {"q": HIDDEN["q"] * [0.2, 6.0], "r": HIDDEN["r"] * 4.0}
        parameters = {name: Parameter(v, "positive") for name, v in wrong.items()}
        options = {"steps": 10, "solver": SOLVER, "mode": "gauss-newton"}
        found = tune_weights(make, parameters, SYSTEM, STARTS, loss, updates=7, **options)
    assert found.settings["mode"] == "gauss-newton"
    assert found.after["loss"] < 1e-16 * found.before["loss"]
    assert np.all(np.diff(found.history.loss[:5]) < 0)
    q, r = found.values["q"], found.values["r"]
    wanted = np.append(HIDDEN["q"], HIDDEN["r"]) / HIDDEN["q"][0]
    np.testing.assert_allclose(np.append(q, r) / q[0], wanted, rtol=1e-6)


@pytest.mark.slow
def test_a_loss_with_kinks_falls_as_far_as_with_adam():
    """Weights of violations, which have no curvature; no step lifts the loss of training."""
    limits = jm.Box([-2.0, -0.5], [2.0, 0.5])
    loss = jm.ClosedLoopLoss([1.0, 0.1], [0.01], limits=limits, violation=3.0)
    parameters = {name: Parameter(10 * v, "positive") for name, v in HIDDEN.items()}
    with jax.enable_x64(True):
        newton, adam = (
            tune_weights(
                make, parameters, SYSTEM, STARTS, loss, 15, solver=SOLVER, mode=mode, updates=count
            )
            for mode, count in (("gauss-newton", 8), ("forward", 60))
        )
    assert newton.history.accepted.all() and np.all(np.diff(newton.history.loss) <= 0)
    assert newton.history.loss[-1] < adam.history.loss[-1] * 1.01
