"""NonlinearController in loops: against solve_nonlinear and JAX's own loop, plants and models of
users, derivatives, estimates, wrong arguments."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.closed_loop import KalmanFilter, Noise
from jaxmpc.mpc import Task, solve_nonlinear
from jaxmpc.tuning import Parameter, tune_weights

H, STEPS = 0.1, 12
START = np.array([0.0, 0.1, 0.0, 1.0])
GOAL = np.array([2.0, 0.0, 0.0, 0.0])
SOLVED = jm.Status.SOLVED


def car(x, u):
    """Position (2), heading, speed; turn rate by speed, acceleration."""
    rate = jnp.stack([x[3] * jnp.cos(x[2]), x[3] * jnp.sin(x[2]), x[3] * u[0], u[1]])
    return x + H * rate


pytestmark = pytest.mark.usefixtures("x64")


def problem(model=car, obstacle=True, **fields):
    sizes = jm.LinearSystem(np.eye(4), np.zeros((4, 2)), dt=H)
    given = {"Q": [0.1, 0.1, 0, 0], "R": [0.05, 0.05], "horizon": 8, **fields}
    box = jm.Box([-1.0, -2.0], [1.0, 2.0])
    mpc = jm.MPC(sizes, inputs=box, terminal_cost=[20, 20, 1, 1], **given)
    away = Task(lambda at: jnp.hypot(at.x[0] - 0.9, at.x[1] + 0.1), lower=0.4, rho=None)
    return jm.NonlinearMPC(mpc, model, (away,) if obstacle else ())


@pytest.fixture(scope="module")
def run():
    with jax.enable_x64(True):
        controller = jm.NonlinearController(problem())
        return jm.simulate(controller, car, START, STEPS, reference=GOAL)


@pytest.mark.slow
def test_inputs_are_those_of_plans_from_each_state(run):
    """Each plan is a local minimum that solve_nonlinear finds too, from the last one; the plant
    moves by the function itself; the obstacle, a circle about (0.9, −0.1), is not met."""
    assert np.all(run.status == SOLVED) and run.feasible_steps == STEPS
    plan, x = None, START
    for t in range(STEPS):
        np.testing.assert_allclose(run.states[t], x, atol=1e-6)
        plan = solve_nonlinear(problem(), x, GOAL, warm_start=plan)
        assert plan.status == SOLVED
        np.testing.assert_allclose(run.inputs[t], plan.inputs[0], atol=1e-5)
        np.testing.assert_allclose(run.cost[t], plan.cost, rtol=1e-6)
        x = np.asarray(car(jnp.asarray(run.states[t]), run.inputs[t]))
    distance = np.hypot(run.states[:, 0] - 0.9, run.states[:, 1] + 0.1)
    assert 0.4 - 1e-6 < distance.min() < 0.41


@pytest.mark.long
def test_real_time_iterations_are_one_program_a_sample():
    """A loop is what the controller gives sample by sample, of one QP each."""
    model = lambda x, u: jnp.stack([x[0] + H * x[1], x[1] + H * (u[0] - jnp.sin(2 * x[0]))])
    controller, x0 = jm.NonlinearController(cart(model), sqp_steps=1), np.array([0.8, 0.0])
    found = jm.simulate(controller, model, x0, 3)
    control, x = controller.start(jnp.asarray(x0)), jnp.asarray(x0)
    for t in range(3):
        control = jax.jit(type(controller).__call__)(controller, x, control)
        assert control.plan.iterations == 1
        np.testing.assert_allclose(found.inputs[t], control.u, atol=1e-9)
        x = model(x, control.u)
    np.testing.assert_allclose(found.states[-1], x, atol=1e-9)


@pytest.mark.slow
def test_a_loop_of_a_linear_model_is_that_of_a_linear_controller():
    A, B = np.array([[1, H], [0.3, 1]]), np.array([[0.0], [H]])
    system = jm.LinearSystem(A, B, dt=H)
    mpc = jm.MPC(system, [1.0, 0.1], [0.1], 10, inputs=jm.Box(-1, 1), input_rate_limit=0.5)
    sizes = replace(mpc, system=jm.LinearSystem(np.eye(2), np.zeros((2, 1)), dt=H))
    nonlinear = jm.NonlinearController(jm.NonlinearMPC(sizes, lambda x, u: A @ x + B @ u))
    x0, aims = np.array([0.4, 0.2]), {"previous_input": [0.2], "delay": 1}
    runs = [
        jm.simulate(controller, system, x0, 20, **aims)
        for controller in (jm.Controller(mpc), nonlinear)
    ]
    assert np.all(runs[1].status == SOLVED)
    for name in ("states", "inputs", "stage_cost"):
        np.testing.assert_allclose(*(getattr(run, name) for run in runs), atol=1e-5)


@pytest.mark.slow
def test_many_with_references_of_their_own(run):
    controller = jm.NonlinearController(problem())
    goals = np.array([GOAL, GOAL + [0, 0.5, 0, 0]])
    runs = jm.simulate_many(controller, car, [START, START], STEPS, references=goals)
    np.testing.assert_allclose(runs.states[0], run.states, atol=1e-8)
    assert runs.states[1, -1, 1] > runs.states[0, -1, 1] + 0.2


@pytest.mark.slow
def test_targets_of_tasks_stand_behind_the_reference():
    pull = Task(lambda at: at.x[3], weight=5.0, name="speed")
    given = replace(problem(obstacle=False), tasks=(pull,))
    controller = jm.NonlinearController(given)
    for speed in (0.5, 1.5):
        x = jnp.asarray(START)
        plan = controller(x, None, np.append(GOAL, speed)).plan
        other = solve_nonlinear(given, x, GOAL, targets=[[speed]])
        np.testing.assert_allclose(plan.inputs, other.inputs, atol=1e-6)


def test_lists_of_tasks_are_arrays_inside_loops_too():
    task = Task(lambda at: at.x, [5.0, 1.0], [0.1, 0], lower=[-9, -9.0], upper=[9, 9])
    assert all(np.asarray(v).dtype == float for v in (task.target, task.upper))
    jax.eval_shape(lambda traced: traced.validate(2, 5), task)


class Learned(eqx.Module):
    """A model of a cart with a network for what pushes it; its functions are leaves."""

    net: eqx.nn.MLP

    def __init__(self, key):
        self.net = eqx.nn.MLP(3, 1, 4, 1, activation=jnp.tanh, key=key)

    def __call__(self, x, u):
        push = u[0] + self.net(jnp.concatenate([x, u]))[0]
        return jnp.stack([x[0] + H * x[1], x[1] + H * push])


class Stepping(Learned):
    """The same with `step`."""

    def step(self, x, u):
        return self(x, u)


def cart(model, weight=1.0):
    sizes = jm.LinearSystem(np.eye(2), np.zeros((2, 1)), dt=H)
    mpc = jm.MPC(sizes, weight * jnp.eye(2), [0.1], 6, inputs=jm.Box(-2, 2))
    return jm.NonlinearMPC(mpc, model)


@pytest.mark.long
@pytest.mark.parametrize("kind", [Learned, Stepping])
def test_learned_plants_are_data(kind):
    """Loops of plants that differ in their numbers share a program, and are those of each."""
    first, x0 = kind(jax.random.key(0)), np.array([0.5, 0.0])
    second = eqx.tree_at(lambda m: m.net.layers[1].bias, first, replace_fn=lambda b: b + 1)
    system = jm.LinearSystem([[1, H], [0, 1]], [[0], [H]], dt=H)
    controller = jm.Controller(jm.MPC(system, [1.0, 1.0], [0.1], 3))
    for plant in (first, second):
        run = jm.simulate(controller, plant, x0, 3)
        for t in range(3):
            after = plant(run.states[t], run.inputs[t])
            np.testing.assert_allclose(run.states[t + 1], after, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [Learned, Stepping])
def test_learned_models_are_data(kind):
    """Loops under a learned model, and their derivatives in its numbers, as differences have
    them: not those of a model that was taken for a constant."""
    model, x0 = kind(jax.random.key(0)), jnp.array([0.5, 0.0])

    def loss(model):
        controller = jm.NonlinearController(cart(model), jm.ADMM(eps=1e-10))
        run = jm.simulate(controller, lambda x, u: x + H * jnp.stack([x[1], u[0]]), x0, 5)
        return jnp.sum(run.states**2) + jnp.sum(run.inputs**2)

    value = eqx.filter_jit(loss)
    slope = eqx.filter_grad(loss)(model).net.layers[1].bias
    at = lambda by: eqx.tree_at(lambda m: m.net.layers[1].bias, model, replace_fn=lambda b: b + by)
    difference = (value(at(1e-5)) - value(at(-1e-5))) / 2e-5
    assert abs(difference) > 1e-4
    np.testing.assert_allclose(slope[0], difference, rtol=1e-5)


class Exact:
    """A model that is no pytree, with a linear model and a view of its own."""

    def step(self, x, u):
        return jnp.stack([x[0] + H * x[1], x[1] + H * u[0]])

    def linearize(self, x, u):
        return jm.LinearSystem([[1, 0.5 * H], [0, 1]], [[0], [H]])  # not the derivative

    def view(self, x, u):
        return {"place": x[0]}


@pytest.mark.long
def test_linear_models_and_views_of_objects_are_theirs():
    """Of an object that is no pytree both were ignored, without a word."""
    seen = Task(lambda view: view["place"], weight=1.0)
    given = replace(cart(Exact()), tasks=(seen,))
    plan = solve_nonlinear(given, [0.5, 0.0], iterations=1)
    x, u = plan.states, plan.inputs
    np.testing.assert_allclose(x[1:, 0], x[:-1, 0] + 0.5 * H * x[:-1, 1], atol=1e-9)
    assert np.abs(u).max() > 1e-2


@pytest.mark.slow
def test_weights_are_tuned_through_the_loop():
    """A search along the gradient lowers the loss, which is that of `simulate` with the result."""
    plant = lambda x, u: jnp.stack([x[0] + H * x[1], x[1] + H * (u[0] - jnp.sin(x[0]))])
    make = lambda v: jm.NonlinearController(cart(plant, v["w"]), sqp_steps=1)
    loss = lambda run: jnp.sum(run.states**2) + 0.1 * jnp.sum(run.inputs**2)
    x0s = np.array([[0.5, 0.0], [-0.4, 0.3], [0.3, 0.2]])
    found = tune_weights(
        make, {"w": Parameter(0.2, "positive")}, plant, x0s, loss=loss, steps=8, updates=4,
        validation=x0s,
    )  # fmt: skip
    assert found.improved and found.values["w"] > 0.2
    runs = jm.simulate_many(found.result, plant, x0s, 8)
    np.testing.assert_allclose(found.after["loss"], np.mean(jax.vmap(loss)(runs)), rtol=1e-6)


@pytest.mark.slow
def test_real_time_iterations_with_tasks_have_derivatives():
    """Of a task whose target is out of reach also the weights that stand for its curvature move,
    which as constants left gradients off by 1 %."""
    hand = Task(lambda at: jnp.stack([jnp.sin(at.x[0]), jnp.cos(at.x[0])]), name="hand")
    model = lambda x, u: jnp.stack([x[0] + H * x[1], x[1] + H * (u[0] - jnp.sin(x[0]))])
    free = replace(cart(model), mpc=replace(cart(model).mpc, inputs=jm.Box(-20, 20)))

    def loss(theta):
        pulled = replace(hand, weight=theta[0], target=theta[1:3])
        controller = jm.NonlinearController(replace(free, tasks=(pulled,)), sqp_steps=1)
        run = jm.simulate(controller, model, jnp.array([0.3, 0.0]) + theta[3], 3)
        return jnp.sum(run.states**2) + jnp.sum(run.inputs**2)

    theta, value = jnp.array([0.3, 1.5, 0.5, 0.1]), jax.jit(loss)
    expected = [(value(theta + v) - value(theta - v)) / 2e-5 for v in 1e-5 * np.eye(4)]
    assert np.abs(expected).min() > 0.01
    np.testing.assert_allclose(jax.grad(loss)(theta), expected, rtol=1e-6)


@pytest.mark.slow
def test_an_extended_kalman_filter_of_the_model():
    """Two positions of a pendulum-like cart measured with noise: the estimate is nearer to the
    state than what is measured, and the loop comes to rest."""
    model = lambda x, u: jnp.stack([x[0] + H * x[1], x[1] + H * (u[0] - jnp.sin(2 * x[0]))])
    given, noise = cart(model), Noise(process=[0, 1e-3], measurement=[0.05], seed=3)
    observer = KalmanFilter(given, [1e-4, 1e-3], [0.05], C=[[1.0, 0.0]], initial=[0.1, 0.1])
    controller, x0 = jm.NonlinearController(given), np.array([0.8, 0.0])
    run = jm.simulate(controller, model, x0, 60, noise=noise, observer=observer)
    late = np.asarray(run.estimates - run.states[:-1])[20:]
    assert np.sqrt(np.mean(late[:, 0] ** 2)) < 0.03
    # By the filter written down: prediction by the model, its Jacobian moves the covariance.
    mean, P, C = x0, np.diag([0.01, 0.01]), np.array([[1.0, 0.0]])
    W, V = np.diag([1e-8, 1e-6]), np.array([[0.0025]])
    _, measured = noise.prepared(2, 1).draw(60, 2, 1, jnp.float64)
    for t in range(60):
        L = P @ C.T @ np.linalg.inv(C @ P @ C.T + V)
        mean = mean + L @ (run.states[t, :1] + measured[t] - mean[:1])
        P = (np.eye(2) - L @ C) @ P
        np.testing.assert_allclose(run.estimates[t], mean, atol=1e-9)
        A = jax.jacobian(model)(jnp.asarray(mean), run.inputs[t])
        P, mean = A @ P @ A.T + W, np.asarray(model(jnp.asarray(mean), run.inputs[t]))


@pytest.mark.slow
def test_a_bad_reading_spoils_no_later_step(run):
    controller = jm.NonlinearController(problem())
    before = controller.start(jnp.asarray(START))
    before = controller(START, before, GOAL)
    lost = controller(np.full(4, np.nan), before, GOAL)
    assert np.all(np.isfinite(lost.u)) and lost.plan.status == jm.Status.NON_FINITE
    after = controller(run.states[2], lost, GOAL)
    assert after.plan.status == SOLVED
    np.testing.assert_allclose(after.u, run.inputs[2], atol=1e-5)


@pytest.mark.long
@pytest.mark.parametrize(
    ("argument", "make"),
    [
        ("problem: is an MPC", lambda p: jm.NonlinearController(p.mpc)),
        ("sqp_steps: 0", lambda p: jm.NonlinearController(p, sqp_steps=0)),
        ("hessian: 'bfgs'", lambda p: jm.NonlinearController(p, hessian="bfgs")),
        ("solver: is a str", lambda p: jm.NonlinearController(p, "fast")),
        ("mpc: is a NonlinearMPC. Give it to jm.NonlinearController", jm.Controller),
        ("mpc: is a NonlinearMPC. Give it to jm.solve_nonlinear", lambda p: jm.solve(p, START)),
        ("plant: is a NonlinearController", lambda p: loop(p, jm.NonlinearController(p))),
        ("plant: is a type", lambda p: loop(p, jm.LinearSystem)),
        ("plant: has a step that returns shape", lambda p: loop(p, lambda x, u: x[:3])),
        ("forecast: given to a NonlinearController", lambda p: loop(p, car, forecast=np.zeros(4))),
        ("reference: shape", lambda p: jm.NonlinearController(p)(START, None, np.zeros(7))),
        ("numbers: given of a", lambda p: jm.NonlinearController(p)(START, numbers={"m": 1.0})),
    ],
)
def test_wrong_arguments_are_named(argument, make):
    with pytest.raises(ValueError, match=argument.replace(".", r"\.")):
        make(problem())


def loop(given, plant, **more):
    return jm.simulate(jm.NonlinearController(given), plant, START, 3, **more)
