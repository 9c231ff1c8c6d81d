"""Tuning where the loop has no derivative: slopes from samples, closed loops of such plants."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from c_engine import c_steps

import jaxmpc as jm
from jaxmpc.tuning import Parameter, tune_weights
from jaxmpc.tuning.objective import WIDTH, ClosedLoopObjective

A, B = np.array([[1.0, 0.2], [0.0, 1.0]]), np.array([[0.02], [0.2]])
SYSTEM = jm.LinearSystem(A, B, dt=0.2)
MPC = jm.MPC(SYSTEM, np.diag([1.0, 1.0]), np.eye(1), 5, inputs=jm.Box([-1.0], [1.0]))
SOLVER = jm.ADMM(iterations=30, newton_steps=0, eps=1e-3)
LOSS = jm.ClosedLoopLoss([1.0, 0.1], [0.01])
PARAMETERS = {"Q": Parameter(MPC.Q, "diagonal"), "R": Parameter(MPC.R, "positive")}


class Formula(ClosedLoopObjective):
    """A loss of θ in closed form in place of closed loops; loss: θ → number."""

    def total(self, theta, plant, x0s, varied, weights, checkpoint=False):
        losses = jnp.broadcast_to(self.loss(theta), len(x0s))
        zeros = jnp.zeros(len(x0s))
        names = ("unsolved", "infeasible", "fallback", "violation")
        return self.loss(theta), {"losses": losses, "design": 0 * losses[0]} | dict.fromkeys(
            names, zeros
        )


def slope_of(loss):
    slope = Formula(None, {}, None, 1, loss, None, None, None).sampling(None)
    return lambda theta, seed: slope(theta, np.zeros((3, 2)), {}, np.ones(3), seed)


def test_slopes_of_a_quadratic_are_its_gradient(x64):
    rng = np.random.default_rng(0)
    M = rng.normal(size=(3, 3))
    H, goal = M @ M.T, {"a": rng.normal(size=1), "b": rng.normal(size=2)}

    def loss(theta):
        e = jnp.concatenate([theta["a"] - goal["a"], theta["b"] - goal["b"]])
        return e @ H @ e + 2.0

    theta = {"a": np.array([0.3]), "b": np.array([-1.0, 2.0])}
    at = slope_of(loss)
    value, slope, aux = at(theta, [0, 5])
    e = np.concatenate([theta["a"] - goal["a"], theta["b"] - goal["b"]])
    np.testing.assert_allclose(value, e @ H @ e + 2, rtol=1e-12)
    np.testing.assert_allclose(np.concatenate([slope["a"], slope["b"]]), 2 * H @ e, rtol=1e-9)
    np.testing.assert_allclose(aux["losses"], value)
    again, other = at(theta, [0, 5])[1], at(theta, [0, 6])[1]  # the same in a run that goes on
    assert np.array_equal(again["b"], slope["b"]) and not np.array_equal(other["b"], slope["b"])


def test_slopes_of_a_step_are_those_of_its_average_over_a_ball(x64):
    """A jump of height 1 at 0.05 has no derivative; its average over a ball of radius r about θ in
    the plane has the slope of a chord over the area, 2 sqrt(r² − d²)/(π r²), d its distance."""
    jump = lambda theta: jnp.where(theta["a"][0] > 0.05, 1.0, 0.0)
    at = slope_of(jump)
    slopes = [at({"a": np.zeros(2)}, [seed, 0])[1]["a"] for seed in range(500)]
    r = WIDTH * np.sqrt(2)
    wanted = 2 * np.sqrt(r**2 - 0.05**2) / (np.pi * r**2)
    np.testing.assert_allclose(np.mean(slopes, axis=0), [wanted, 0], atol=0.1 * wanted)


def valve(x, u):
    """A plant in NumPy: the input takes three values alone, and dry friction holds what rests."""
    u = np.round(np.asarray(u))
    x = np.asarray(x) @ A.T + u @ B.T
    stuck = (np.abs(x[..., 1:]) < 0.05) & (u == 0)
    return np.where(stuck, np.stack([x[..., 0], 0 * x[..., 1]], -1), x).astype(np.float32)


class Outside:
    def step(self, x, u):
        return jax.pure_callback(valve, jax.typeof(x), x, u, vmap_method="expand_dims")


def weighed(v):
    return replace(MPC, Q=v["Q"], R=v["R"], terminal_cost=v["Q"])


def tuned(x0s, make=weighed, parameters=PARAMETERS, **more):
    settings = {"updates": 12, "optimizer": optax.adam(0.2), **more}
    return tune_weights(make, parameters, Outside(), x0s, LOSS, 25, **settings)


def draw(seed):
    return np.random.default_rng(seed).uniform(-1, 1, (24, 2))


# What is tuned: weights of plans, or gains of a law, which compiles in a moment.
TUNED = {
    "law": dict(
        make=lambda v: jm.closed_loop.LinearFeedback(MPC, v["K"][None]),
        parameters={"K": Parameter([-0.3, -0.3])},
    ),
    "plans": dict(solver=SOLVER),
}  # fmt: skip


@pytest.mark.parametrize("kind", ["law", pytest.param("plans", marks=pytest.mark.slow)])
def test_a_plant_outside_jax_that_rounds_inputs_and_sticks(kind):
    """Derivatives are refused before a compile; samples gain on unseen starts."""
    with pytest.raises(ValueError, match=r'mode: forward, reverse.*JVP.*mode="sampling"'):
        tuned(draw(0), **TUNED[kind])
    found = tuned(draw(0), mode="sampling", **TUNED[kind])
    assert found.settings["mode"] == "sampling" and found.history.accepted.all()

    control = jax.jit(jax.vmap(lambda values, x: found.build(values)(x).u, (None, 0)))

    def mean_loss(values):
        """The loops again, without `simulate`."""
        x, losses = draw(1), []
        for _ in range(25):
            u = np.clip(np.asarray(control(values, x)), -1, 1)
            losses.append(x**2 @ [1.0, 0.1] + 0.01 * u[:, 0] ** 2)
            x = valve(x, u)
        return np.mean(losses)

    assert mean_loss(found.values) < 0.3 * mean_loss(found.initial)


@pytest.mark.slow
def test_a_run_by_samples_that_is_cut_off_goes_on_as_if_it_had_not_been(tmp_path):
    x0s, path = draw(0), tmp_path / "run.npz"
    x0s[3] = np.nan  # a loop that is left out
    tuned(x0s, mode="sampling", solver=SOLVER, updates=3, checkpoint=path)
    again = tuned(x0s, mode="sampling", solver=SOLVER, updates=6, checkpoint=path).history
    whole = tuned(x0s, mode="sampling", solver=SOLVER, updates=6).history
    np.testing.assert_array_equal(again.thetas["Q"], whole.thetas["Q"])
    assert whole.numbers["excluded"].tolist() == [1.0] * 6 and whole.accepted.all()


SLIDER = """<mujoco><option timestep="0.01"/><worldbody>
<geom type="box" size=".05 1 1" pos="-0.15 0 0"/>
<body><joint name="x" type="slide" axis="1 0 0" frictionloss="1.5"/>
<geom type="sphere" size=".1" mass="1"/></body></worldbody>
<actuator><motor joint="x" ctrlrange="-5 5"/></actuator></mujoco>"""


class Engine:
    """MuJoCo's C engine: a slider with dry friction, a wall at its target; 5 steps a sample."""

    def __init__(self):
        mujoco = pytest.importorskip("mujoco")
        self.model = mujoco.MjModel.from_xml_string(SLIDER)

    def steps(self, x, u):
        x, u = np.asarray(x), np.asarray(u)
        pairs = zip(x.reshape(-1, 2), u.reshape(-1, 1), strict=True)
        found = [c_steps(self.model, *pair, 5) for pair in pairs]
        return np.array(found, np.float32).reshape(x.shape)

    def step(self, x, u):
        shape = jax.typeof(x)
        return jax.pure_callback(self.steps, shape, x, u, vmap_method="broadcast_all")


@pytest.mark.slow
def test_contacts_and_friction_of_the_c_engine():
    engine = Engine()
    system = jm.LinearSystem(np.array([[1, 0.05], [0, 1]]), np.array([[0.00125], [0.05]]), dt=0.05)
    mpc = jm.MPC(system, np.eye(2), np.eye(1), 10, inputs=jm.Box([-5.0], [5.0]))
    make = lambda v: replace(mpc, Q=v["Q"], R=v["R"], terminal_cost=10 * v["Q"])
    loss = jm.ClosedLoopLoss([10.0, 0.1], [1e-3])
    starts = lambda seed: np.random.default_rng(seed).uniform([0, -3], [1, 1], (24, 2))
    found = tune_weights(
        make, PARAMETERS, engine, starts(0), loss, 30, mode="sampling", updates=10,
        optimizer=optax.adam(0.3), solver=SOLVER,
    )  # fmt: skip

    def mean_loss(values):
        control, x = jax.jit(jax.vmap(lambda x: found.build(values)(x).u)), starts(1)
        losses, nearest = [], np.inf
        for _ in range(30):
            u = np.asarray(control(x))
            losses.append(x**2 @ [10.0, 0.1] + 1e-3 * u[:, 0] ** 2)
            x = engine.steps(x, u)
            nearest = min(nearest, x[:, 0].min())
        return np.mean(losses), nearest

    (before, _), (after, nearest) = mean_loss(found.initial), mean_loss(found.values)
    assert after < 0.5 * before and nearest < 0  # some came to the wall
