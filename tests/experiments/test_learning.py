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


references, imitation, policy = script("references"), script("imitation"), script("policy")
closed_loops = script("closed_loops")
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
def test_imitation_learns_all_tasks():
    s = imitation.Settings(steps=15, batch=32, newton_steps=0, bits=(64,), rivals=())
    for found in imitation.run(s).values():
        losses = found["jaxmpc, float64"].losses
        assert losses[-1] < 0.7 * losses[0]


def test_cart_and_pole_keep_their_energy():
    """Without a force, over a second of steps; with one the energy grows by force × way."""
    M, m, l, g = 1.0, 0.1, 0.8, 9.81

    def energy(x):
        _, angle, speed, spin = x
        pole = speed**2 - 2 * speed * l * spin * np.cos(angle) + (l * spin) ** 2
        return M * speed**2 / 2 + m * pole / 2 + m * g * l * np.cos(angle)

    with jax.enable_x64(True):
        for force in (0.0, 3.0):
            x = start = np.array([0.1, 2.0, 0.3, -0.5])
            for _ in range(20):
                x = np.asarray(policy.moved(jnp.asarray(x), jnp.array([force])))
            work = force * (x[0] - start[0])
            assert abs(energy(x) - energy(start) - work) < 1e-4


def test_advantages_are_sums_of_errors():
    """Each is Σ (γλ)^k of the errors that follow in its episode."""
    s, random = policy.Settings(), np.random.default_rng(0)
    reward, value, next_value = random.normal(size=(3, 12))
    done = np.isin(np.arange(12), (4, 9))
    steps = policy.Steps(*[jnp.zeros(12)] * 3, *map(jnp.asarray, (reward, value, next_value, done)))
    found = policy.advantages(s, steps)
    for k in range(12):
        end = next((i for i in (4, 9) if i >= k), 11)
        errors = (reward + s.discount * next_value - value)[k : end + 1]
        want = np.sum(errors * (s.discount * s.trace) ** np.arange(len(errors)))
        assert found[k] == pytest.approx(want, abs=1e-5)


@pytest.mark.slow
def test_policies_learn():
    """In 25 updates the network alone is above 6, of 20; the untuned MPC leaves the track."""
    s = policy.Settings(policies=("mlp",), updates=25, environments=64, judged=16, seeds=(0,))
    (curve,) = policy.run(s)["mlp"]
    assert curve.returns[0] < 2 and curve.returns[-1] > 5
    short = policy.Settings(policies=("mpc",), updates=1, every=1, environments=8, judged=8)
    for curve in policy.run(short)["mpc"]:
        assert np.all(np.isfinite(curve.returns)) and curve.early[0] == 1


@pytest.mark.slow
def test_pendulum_is_identified():
    pendulum = script("pendulum")
    s = pendulum.Settings(steps=60, batch=8, judged=16, tasks=("dynamics",))
    losses = pendulum.run(s)["dynamics"]
    assert losses[-1] < 0.02 * losses[0]


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_network_with_room_is_proved():
    """With room for errors every cell; the filter's interval holds what leads into C."""
    with jax.enable_x64(True):
        approximate = script("approximate")
        s = approximate.Settings(plans=2000, updates=4000, judged=2000, loops=20, timed=5)
        task, network, proof = approximate.learn(s, 0.1)
        assert proof.kept == pytest.approx(1, abs=1e-12) and proof.broken == 0
        H, h = np.asarray(task.body.H), np.asarray(task.body.h)
        A, B = np.asarray(task.system.A), np.asarray(task.system.B)
        tried = np.linspace(-1, 1, 2001)
        for x in task.body.sample(50, 3):
            inside = np.all(H @ (A @ x[:, None] + B * tried) <= h[:, None], axis=0)
            low, high = (float(v[0]) for v in approximate.input_range(task, jnp.asarray(x)))
            assert np.all(inside == ((tried >= low - 1e-9) & (tried <= high + 1e-9)))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["wheels", "swing-up"])
def test_published_closed_loops(name):
    """Exact derivatives through plans made about the last ones, and steps as published gain."""
    with jax.enable_x64(True):
        loop = closed_loops.TASKS[name]()
        value = jax.jit(jax.value_and_grad(lambda v: loop.loss(*loop.run(v)[:2])))
        theta, losses, _ = closed_loops.tuned(
            loop, value, "theirs", closed_loops.Settings(updates=4)
        )
        # Of the pendulum: where the loop is not as sensitive as with the first weights, and over
        # steps beside which the rounding of its plans is small.
        assert closed_loops.differences(value, theta, 1e-4) < 2e-4
        assert jax.jit(loop.run)(theta)[2].all()
    assert min(losses) < 0.5 * losses[0]
