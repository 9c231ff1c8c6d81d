"""Robots as environments, and MPC as a policy: against Gymnasium's checker, closed forms, and
closed loops."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.closed_loop import Environment, LinearFeedback, MPCPolicy, randomised

SPREAD = 0.05


pytestmark = pytest.mark.usefixtures("x64_of_module")


@pytest.fixture(scope="module")
def environment():
    robot = jm.load_robot("pendulum", position=0.5, velocity=1.0)
    return Environment.of(
        robot, [0.1], Q=[200.0, 1.0], R=[0.01], spread=SPREAD, length=12, stop_at_limits=True
    )


def rollout(environment, policy, keys, steps):
    """States (T + 1, B, ...) of episodes, all at once."""

    def sample(state, _):
        after = jax.vmap(environment.step)(state, jax.vmap(policy)(state.observation))
        return after, after

    start = jax.vmap(environment.reset)(keys)
    _, rest = jax.lax.scan(sample, start, length=steps)
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, rest)


@pytest.fixture(scope="module")
def linear():
    """An environment of a linear plant."""
    system = jm.LinearSystem(np.array([[1, 0.1], [0, 1]]), np.array([[0.02], [0.2]]), dt=0.1)
    plant = jm.LinearPlant(system, jm.Box([-0.5, -0.2], [0.5, 0.2]), jm.Box([-0.5], [0.5]))
    options = dict(Q=[5.0, 0.2], R=[0.1], spread=0.9, length=12, stop_at_limits=True)
    return Environment.of(plant, [0.1, 0.0], **options)


def test_the_return_is_minus_the_cost_of_the_closed_loop(linear):
    """The policy in the environment is the loop of `simulate`; starts are uniform; an episode ends
    at its length, or where a limit is exceeded."""
    environment, plant = linear, linear.robot
    mpc = jm.MPC(plant.system, environment.Q, environment.R, 2, inputs=plant.input_limits)
    law = LinearFeedback(mpc, [[-3.0, -2.0]], plant)
    run = jax.jit(lambda keys: rollout(environment, environment.policy(law), keys, 12))
    keys = jax.random.split(jax.random.key(0), 200)
    found = jax.tree.map(np.asarray, run(keys))
    relative = found.x[0] / [0.45, 0.18]
    assert np.abs(relative).max() <= 1 + 1e-12 and np.ptp(relative, axis=0).min() > 1.95
    np.testing.assert_allclose(relative.var(0), 1 / 3, rtol=0.15)
    goal = dict(reference=environment.reference, input_reference=environment.input_reference)
    want = jm.simulate_many(law, plant, found.x[0], 12, **goal)
    np.testing.assert_allclose(found.x.swapaxes(0, 1), want.states, atol=1e-12)
    np.testing.assert_allclose(-found.reward[1:].T, want.stage_cost, atol=1e-12)
    np.testing.assert_allclose(found.violation.T, want.violation, atol=1e-12)
    assert np.abs(want.inputs).max() == 0.5
    assert not found.truncated[:12].any() and found.truncated[12].all()
    np.testing.assert_array_equal(found.terminated, found.violation > 1e-6)
    assert 0 < found.terminated.mean() < 1 and found.done[12].all()
    np.testing.assert_array_equal(run(keys).x, found.x)


def test_limits_nan_and_other_plants(linear):
    """Actions are clipped; a state that is not finite ends its episode alone; plants differ."""
    plant, B = linear.robot, np.array([[[0.02], [0.2]]]) * np.array([1.0, 1.0, 2.0])[:, None, None]

    @jax.jit
    @partial(jax.vmap, in_axes=(0, None, 0))
    def after(x, action, B):
        varied = replace(linear, robot=plant.vary(B=B))
        return varied.step(varied.at(x), action)

    x = np.array([[0.3, 0.0], [np.nan, 0.0], [0.499, 0.199]])
    found = jax.tree.map(np.asarray, after(x, np.array([9.0]), B))
    assert list(found.terminated) == [False, True, True]
    at_limit = jax.tree.map(np.asarray, after(x, np.array([0.5]), B))
    np.testing.assert_array_equal(found.x, at_limit.x)
    np.testing.assert_array_equal(found.reward, at_limit.reward)
    wanted = x @ plant.system.A.T + 0.5 * B[..., 0]
    np.testing.assert_allclose(found.x[[0, 2]], wanted[[0, 2]], rtol=1e-12)


@pytest.mark.slow
def test_limits_nan_and_random_plants(environment):
    """Actions are clipped; a state that is not finite ends its episode alone; plants differ."""
    robot = environment.robot
    factors = {k: jnp.asarray(v) for k, v in randomised(robot, 3, mass=(0.5, 2.0)).items()}

    @jax.jit
    def after(x, action, factors):
        def one(x, numbers):
            varied = replace(environment, robot=robot.vary(**numbers))
            return varied.step(varied.at(x), action)

        return jax.vmap(one)(x, factors)

    x = np.array([[0.3, 0.0], [np.nan, 0.0], [0.499, 0.999]])
    found = jax.tree.map(np.asarray, after(x, np.array([9.0]), factors))
    assert list(found.terminated) == [False, True, True]
    at_limit = jax.tree.map(np.asarray, after(x, np.array([5.0]), factors))
    np.testing.assert_array_equal(found.x, at_limit.x)
    np.testing.assert_array_equal(found.reward, at_limit.reward)
    # θ'' = (m g sin θ + u − 0.01 θ')/m of a point mass m on a rod of 1 m, nearly constant.
    mass = np.asarray(factors["body_mass"])[0, 1]
    np.testing.assert_allclose(found.x[0, 1], 0.01 * (9.81 * np.sin(0.3) + 5 / mass), rtol=2e-3)
    assert found.violation[2] > 0.005


@pytest.mark.slow
def test_mpc_policy_is_the_controller_and_has_its_derivatives():
    """On a linear plant: where no limit is near the law of the Riccati recursion, elsewhere within
    the limits; finite differences in ξ and target."""
    system = jm.LinearSystem(np.array([[1, 0.1], [0, 1]]), np.array([[0.0], [0.2]]), dt=0.1)
    plant = jm.LinearPlant(system, jm.Box([-1.5, -2.0], [1.5, 2.0]), jm.Box([-0.4], [0.4]))
    mpc = jm.MPC(system, np.diag([5.0, 0.1]), np.eye(1) / 10, 3, inputs=plant.input_limits)
    controller = jm.Controller(mpc, jm.ADMM(iterations=100, newton_steps=0))
    environment = Environment.of(plant, Q=[5.0, 0.1], R=[0.1])
    policy = environment.policy(controller)
    starts = np.array([[0.05, 0.0], [-0.1, 0.02], [1.4, 1.5]])
    found = jax.jit(jax.vmap(policy))(starts)
    P, (A, B) = np.zeros((2, 2)), (system.A, system.B)
    for _ in range(3):
        K = -np.linalg.solve(mpc.R + B.T @ P @ B, B.T @ P @ A)
        P = mpc.Q + A.T @ P @ (A + B @ K)
    np.testing.assert_allclose(found[:2], starts[:2] @ K.T, atol=1e-6)
    np.testing.assert_allclose(found[2], -0.4, atol=1e-9)

    @jax.jit
    def reward(xi, target):
        state = environment.at(xi)
        action = replace(policy, reference=target)(state.observation)
        return environment.step(state, action).reward

    xi, target = jnp.array(starts[0]), jnp.array([0.02, 0.0])
    slopes = jax.jit(jax.grad(reward, argnums=(0, 1)))(xi, target)
    for i in range(2):
        h = 1e-4 * np.eye(2)[i]
        for slope, moved in (
            (slopes[0], lambda s, h=h: reward(xi + s * h, target)),
            (slopes[1], lambda s, h=h: reward(xi, target + s * h)),
        ):
            np.testing.assert_allclose(slope[i], (moved(1) - moved(-1)) / 2e-4, rtol=1e-4)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.*Box observation space m")
@pytest.mark.filterwarnings("ignore:.*not within the observation space|.*normalize")
@pytest.mark.filterwarnings("ignore:.*We recommend you to use a symmetric")
@pytest.mark.filterwarnings("ignore:.*No render modes was declared")
def test_gymnasium_accepts_it(environment):
    gymnasium = pytest.importorskip("gymnasium")
    from gymnasium.utils.env_checker import check_env

    name = "jaxmpc.closed_loop.gymnasium_env:jaxmpc/Robot-v0"
    options = dict(robot=environment.robot, target=[0.1], Q=[200.0, 1.0], R=[0.01], spread=SPREAD)
    env = gymnasium.make(name, length=12, stop_at_limits=True, **options)
    check_env(env.unwrapped, skip_render_check=True)
    first, info = env.reset(seed=5)
    assert first.dtype == np.float32 and first.shape == (2,) and info["violation"] == 0
    again, _ = env.reset(seed=5)
    other, _ = env.reset()
    np.testing.assert_array_equal(first, again)
    assert np.any(other != first)
    # What the pure functions do; the episode is cut off at its length, or ends at a limit.
    state = environment.at(np.asarray(info["state"]))
    env.reset(seed=5)
    hold = environment.input_reference.astype(np.float32)
    for t in range(12):
        state = jax.jit(Environment.step)(environment, state, hold)
        seen, reward, terminated, truncated, info = env.step(hold)
        np.testing.assert_allclose(seen, state.observation, atol=1e-6)
        np.testing.assert_allclose(reward, state.reward, rtol=1e-9)
        assert not terminated and truncated == (t == 11)
    push = np.float32([5.0])
    env.reset(seed=5)
    for _ in range(40):
        *_, terminated, truncated, info = env.step(push)
        if terminated:
            break
    assert terminated and info["violation"] > 0


@pytest.mark.long
def test_whole_numbers_are_states(environment, linear):
    """A state of integers is that of floats: nothing is rounded to it."""
    for one, x in ((environment, [0, 0]), (linear, np.array([1, 0]))):
        states = [one.step(one.at(np.asarray(x, kind)), [0.3]) for kind in (int, float)]
        for pair in zip(*map(jax.tree.leaves, states), strict=True):
            np.testing.assert_allclose(*pair, atol=1e-7)


@pytest.mark.long
def test_rates_count_from_the_action_before():
    """A policy without memory is told it: its loop is that of the controller, which has one."""
    system = jm.LinearSystem([[1, 0.1], [0, 1]], [[0.005], [0.1]])
    mpc = jm.MPC(system, np.eye(2), 0.1 * np.eye(1), 5, inputs=jm.Box([-1.0], [1.0]),
                 input_rate_limit=[0.2])  # fmt: skip
    controller = jm.Controller(mpc, jm.ADMM(50, newton_steps=0))
    policy = MPCPolicy(controller, reference=np.array([1.0, 0.0]))
    run = jm.simulate(controller, system, np.zeros(2), 4, reference=[1.0, 0.0])
    x, u = np.zeros(2), np.zeros(1)
    act = jax.jit(policy)
    for expected in run.inputs:
        u = act(x, u)
        np.testing.assert_allclose(u, expected, atol=1e-5)
        x = system.step(x, u)
    assert run.inputs[-1, 0] > 0.25  # beyond what one step lets
    with pytest.raises(ValueError, match="previous_input: is None, and the plan depends on it"):
        policy(x)


def test_inputs_may_cost_nothing(environment):
    """Nothing plans by the weights of an environment; those that are given decide nothing else."""
    usual = Environment.of(environment.robot)
    one = Environment.of(environment.robot, R=[0.0])
    np.testing.assert_array_equal(one.R, np.zeros((1, 1)))
    np.testing.assert_array_equal(one.Q, usual.Q)
    np.testing.assert_array_equal(Environment.of(environment.robot, Q=[1.0, 0.0]).R, usual.R)


def test_gymnasium_starts_where_it_is_told_and_names_what_is_wrong(environment):
    pytest.importorskip("gymnasium")
    from jaxmpc.closed_loop.gymnasium_env import RobotEnv

    env = RobotEnv(environment.robot)
    observation, info = env.reset(options={"state": [0.1, -0.2]})
    np.testing.assert_allclose(info["state"], [0.1, -0.2], rtol=1e-6)
    np.testing.assert_allclose(observation, [0.1, -0.2], rtol=1e-6)
    for call, message in (
        (lambda: env.reset(options={"x": 1}), "options: has the names x. Give {.state.: x}"),
        (lambda: env.reset(options={"state": [0.1]}), "x: shape .1,. where .2,. is needed"),
        (lambda: env.reset(options={"state": [np.nan, 0.0]}), "holds NaN"),
        (lambda: env.step("a"), "action: 'a' where real numbers"),
        (lambda: env.step(None), "action: None where real numbers"),
        (lambda: env.step(["a"]), "action: entries of type <U1 where"),
        (lambda: env.step([0.0, 1.0]), "action: shape .2,. where .1,. is needed"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_bad_environments_are_named(environment):
    robot = environment.robot
    state = environment.at(np.zeros(2))
    mpc = jm.MPC(jm.LinearSystem(np.eye(2), np.ones((2, 1))), np.eye(2), np.eye(1), 2)
    policy = environment.policy(LinearFeedback(mpc, [[-1.0, -1.0]], robot))
    for call, message in (
        (
            lambda: Environment.of(None),
            "robot: is a NoneType. Give a jm.robots.Robot or jm.LinearPlant",
        ),
        (lambda: Environment.of(robot, length=0), "length: 0"),
        (lambda: Environment.of(robot, spread=-1.0), "spread: -1.0. Give a fraction"),
        (lambda: Environment.of(robot, Q=[1.0, 1.0, 1.0], R=[1.0]), "Q: shape"),
        (
            lambda: Environment.of(robot, [1.0], Q=[1.0, 1.0], R=[1.0]),
            "target: has theta = 1 rad, limits are",
        ),
        (lambda: Environment.of(robot, Q=[1.0, -5.0], R=[1.0]), "Q: .*not positive semidef"),
        (lambda: Environment.of(robot, Q=[1.0, 5.0], R=[np.nan]), "R: holds NaN"),
        (lambda: Environment.of(robot, stop_at_limits="no"), "stop_at_limits: 'no'. Give True"),
        (lambda: environment.at(np.zeros(3)), r"x: shape \(3,\) where"),
        (lambda: environment.reset(0), "key: 0. Give a JAX key"),
        (
            lambda: environment.reset(jax.random.split(jax.random.key(0), 3)),
            r"key: is an array of keys, shape \(3,\). Give one, or use jax.vmap",
        ),
        (lambda: environment.step(state, np.zeros(2)), r"action: shape \(2,\) where \(1,\)"),
        (
            lambda: replace(environment, reference=np.zeros((13, 2))).step(state, np.zeros(1)),
            r"reference: shape \(13, 2\) where \(2,\).* one target, at rest",
        ),
        (
            lambda: replace(environment, input_reference=np.zeros((12, 1))).step(state, [0.0]),
            r"input_reference: shape \(12, 1\) where \(1,\)",
        ),
        (lambda: policy(np.zeros(3)), r"observation: shape \(3,\) where"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
