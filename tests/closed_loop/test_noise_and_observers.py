"""Noise, Kalman filters, delays and references of each loop, against linear theory."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import scipy
from c_engine import c_steps

import jaxmpc as jm
from jaxmpc.closed_loop import Disturbance, KalmanFilter, LinearFeedback, Noise
from jaxmpc.closed_loop.estimation import Belief, _drawn
from jaxmpc.closed_loop.nonlinear_controller import held_references
from jaxmpc.robots import RobotModel

T, J = 0.1, 0.5
SYSTEM = jm.LinearSystem(
    np.array([[1, T], [0, 1]]), np.array([[T * T / J], [T / J]]), np.array([0.01, -0.02]), dt=T
)
Q, R = np.diag([5.0, 0.2]), np.array([[0.1]])
MPC = jm.MPC(SYSTEM, Q, R, 3)
K = np.asarray(jm.lqr(SYSTEM, Q, R).K)
LAW = LinearFeedback(MPC, K)
PLANT = jm.LinearPlant(SYSTEM, jm.Box([-9.0, -9.0], [9.0, 9.0]), jm.Box([-9.0], [9.0]))
# Correlated process noise.
W, V = np.array([[4e-4, 3e-4], [3e-4, 1e-3]]), np.array([[9e-4]])
NOISE = Noise(W.tolist(), V.tolist(), seed=3)
FILTER = KalmanFilter(SYSTEM, W.tolist(), [0.03], C=[[1.0, 0.0]])
STEPS, LOOPS = 60, 4000


pytestmark = pytest.mark.usefixtures("x64_of_module")


def test_noise_is_continuous_in_its_covariance():
    """Where eigenvalues meet, and where some are zero, its draws do not jump; the derivative in a
    covariance of equal standard deviations is that in these."""
    drawn = lambda W: _drawn(jax.random.key(0), jnp.asarray(W), (5, 2), float)
    at = drawn(np.diag([1e-2, 2e-2]))
    for small in (1e-9, -1e-9):
        np.testing.assert_allclose(drawn([[1e-2, small], [small, 2e-2]]), at, atol=1e-6)
    np.testing.assert_allclose(drawn(1e-2 * np.eye(2)), drawn([0.1, 0.1]), atol=1e-12)
    # dw = d(s²) w / (2 s²)
    slope = jax.jacrev(lambda s: drawn(s * jnp.eye(2)))(1e-2)
    np.testing.assert_allclose(slope, drawn([0.1, 0.1]) / 2e-2, rtol=1e-9)
    direction, step = np.array([[1.0, 0.3], [0.3, 0.5]]), 1e-7
    for covariance in (1e-2 * np.eye(2), np.diag([1e-2, 2e-2]), W):
        slope = jax.jvp(drawn, (jnp.asarray(covariance),), (jnp.asarray(direction),))[1]
        above, below = (drawn(covariance + sign * step * direction) for sign in (1, -1))
        np.testing.assert_allclose(slope, (above - below) / (2 * step), rtol=1e-6, atol=1e-6)
    flat = jax.jacrev(lambda s: drawn(jnp.diag(jnp.array([s, 0.0]))))(1e-2)
    assert np.isfinite(flat).all()


ACTIVATED = """<mujoco><worldbody><body><joint name="j" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 .4 0 0" size=".02" mass="1"/></body></worldbody>
<actuator><general joint="j" dyntype="filter" dynprm=".05"/></actuator></mujoco>"""


def test_outputs_of_a_robot_are_its_positions():
    """Also where activations follow its velocities."""
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(ACTIVATED))
    observer = KalmanFilter(robot, 1e-4, 1e-3, initial=0.05).prepared()
    np.testing.assert_array_equal(observer.outputs(np.arange(1.0, 4.0)), [1.0])


@pytest.fixture(scope="module")
def gaussian():
    """Runs of the linear plant under LQR and Kalman filter, from the origin."""
    return jm.simulate_many(LAW, SYSTEM, np.zeros((LOOPS, 2)), STEPS, noise=NOISE, observer=FILTER)


@pytest.mark.long
def test_covariances_of_lqg_solve_the_lyapunov_equations(gaussian):
    """State and estimation error, jointly: z = (x, x − x̂_t|t−1) is a linear system under white
    noise, whose stationary covariance solves a Lyapunov equation. P of the filter by scipy."""
    A, B, C = SYSTEM.A, SYSTEM.B, np.array([[1.0, 0.0]])
    P = scipy.linalg.solve_discrete_are(A.T, C.T, W, V)
    L = P @ C.T @ np.linalg.inv(C @ P @ C.T + V)
    np.testing.assert_allclose(FILTER.prepared().gain, L, rtol=1e-9)
    # u = K x̂_t|t = K (x − e_t|t), e_t|t = (I − LC) e − L v, e⁺ = A e_t|t + w.
    kept, zero, I = np.eye(2) - L @ C, np.zeros((2, 2)), np.eye(2)
    loop = np.block([[A + B @ K, -B @ K @ kept], [zero, A @ kept]])
    noise = np.block([[I, B @ K @ L], [I, -A @ L]])
    Z = scipy.linalg.solve_discrete_lyapunov(loop, noise @ scipy.linalg.block_diag(W, V) @ noise.T)
    np.testing.assert_allclose(Z[2:, 2:], P, rtol=1e-9)  # what the filter says of itself
    x, filtered = gaussian.states[:, :-1], gaussian.estimates
    # Stationary from some 30 samples on (0.01 of the start is left); offsets c apart, by means.
    states, errors = x[:, 40:], (x - filtered)[:, 40:]
    samples = np.concatenate([states - states.mean((0, 1)), errors - errors.mean((0, 1))], axis=2)
    found = np.einsum("bti,btj->ij", samples, samples) / np.prod(samples.shape[:2])
    tt = kept @ P  # covariance of the filtered error
    size = np.sqrt(np.outer(np.diag(Z)[:2], np.diag(Z)[:2]))
    # 4000 independent loops: the error of a variance is √(2/4000) = 2 % of it or less.
    np.testing.assert_allclose(found[:2, :2], Z[:2, :2], atol=0.07 * size.max(), rtol=0.07)
    np.testing.assert_allclose(found[2:, 2:], tt, atol=0.05 * np.abs(tt).max())
    # The estimate is orthogonal to its error: E x̂ e' = 0, so E x e' = E e e'.
    np.testing.assert_allclose(found[:2, 2:], tt, atol=0.07 * np.abs(tt).max())
    # Offsets: the mean of the error is 0, for the filter knows c.
    np.testing.assert_allclose(errors.mean((0, 1)), 0, atol=4e-4)
    np.testing.assert_allclose(gaussian.inputs, filtered @ K.T, atol=1e-12)


@pytest.mark.long
def test_noise_has_its_covariances_and_seeds(gaussian):
    """What drives the plant is white with covariance W; loops keep theirs whatever the chunks."""
    x, u = gaussian.states, gaussian.inputs
    w = x[:, 1:] - x[:, :-1] @ SYSTEM.A.T - u @ SYSTEM.B.T - SYSTEM.c
    flat = w.reshape(-1, 2)
    np.testing.assert_allclose(np.cov(flat.T), W, atol=0.02 * W.max())
    np.testing.assert_allclose(
        np.einsum("bti,btj->ij", w[:, 1:], w[:, :-1]) / len(flat), 0, atol=2e-5
    )
    few = dict(noise=NOISE, observer=FILTER)
    part = jm.simulate_many(LAW, SYSTEM, np.zeros((5, 2)), STEPS, chunk=2, **few)
    np.testing.assert_allclose(part.states, x[:5], atol=1e-12)
    key = jax.random.fold_in(jax.random.key(3), 4)
    alone = jm.simulate(
        LAW, SYSTEM, np.zeros(2), STEPS, observer=FILTER, noise=Noise(W, V, key)
    )  # fmt: skip
    np.testing.assert_allclose(alone.states, x[4], atol=1e-12)
    other = jm.simulate_many(
        LAW, SYSTEM, np.zeros((5, 2)), STEPS, chunk=2, observer=FILTER, noise=Noise(W, V, 4)
    )
    assert np.abs(other.states[:, 1:] - part.states[:, 1:]).max() > 0.01


def test_estimates_converge_without_noise():
    """From a wrong first estimate as A(I − LC) says; then nothing is left."""
    off = np.array([0.4, -0.7])
    observer = KalmanFilter(SYSTEM, W, V, start=off)
    run = jm.simulate(LAW, SYSTEM, np.array([1.0, 0.0]), STEPS, observer=observer)
    L, C = observer.prepared().gain, np.array([[1.0, 0.0]])
    error = np.array([1.0, 0.0]) - off
    for t in range(STEPS):
        error = error - L @ (C @ error)
        np.testing.assert_allclose(run.states[t] - run.estimates[t], error, atol=1e-10)
        error = SYSTEM.A @ error
    assert np.abs(error).max() < 1e-4
    # Separation: a known start is estimated exactly, and the loop is that of the full state.
    known = jm.simulate(LAW, SYSTEM, np.array([1.0, 0.0]), STEPS, observer=FILTER)
    plain = jm.simulate(LAW, SYSTEM, np.array([1.0, 0.0]), STEPS)
    np.testing.assert_allclose(known.states, plain.states, atol=1e-12)
    assert plain.estimates is None and known.estimates.shape == (STEPS, 2)


@pytest.mark.long
def test_units_of_states_and_outputs_decide_nothing():
    """Units up to 2^40 apart: the same gain of the steady state, or the same error."""
    hidden = np.array([[1.0, 0, 0]])
    for seed in range(20):
        rng = np.random.default_rng(seed)
        A, C = 0.6 * rng.normal(size=(3, 3)), rng.normal(size=(2, 3))
        process, measured = rng.uniform(0.1, 1, 3), rng.uniform(0.1, 1, 2)
        if seed % 4 == 0:
            A = np.eye(3) + 0.1 * np.eye(3, k=1)
        x, y = 2.0 ** rng.integers(-20, 21, 3), 2.0 ** rng.integers(-20, 21, 2)
        system = jm.LinearSystem(A, np.ones((3, 1)))
        scaled = jm.LinearSystem(x[:, None] * A / x, np.ones((3, 1)))
        plain = KalmanFilter(system, process, measured, C).prepared().gain
        found = KalmanFilter(scaled, x * process, y * measured, y[:, None] * C / x).prepared().gain
        np.testing.assert_allclose(found / x[:, None] * y, plain, rtol=1e-8, atol=1e-10)
        if seed % 4 == 0:
            for M, noise, argument in ((A.T, process, "C"), (A, [1.0, 0, 0], "process")):
                for k in (np.ones(3), x):
                    system = jm.LinearSystem(k[:, None] * M / k, np.ones((3, 1)))
                    observer = KalmanFilter(system, k * noise, measured[:1], hidden / k)
                    with pytest.raises(ValueError, match=f"observer.{argument}: no (out|noise)"):
                        observer.prepared()


@pytest.mark.long
def test_time_varying_filter_is_the_textbook_recursion():
    """Covariances and estimates of the extended filter, on a linear plant, by NumPy."""
    P = np.diag([0.2, 0.5])
    observer = KalmanFilter(PLANT, W, V, initial=np.sqrt(np.diag(P)), start=[0.1, 0.0])
    feedback = LinearFeedback(MPC, K, PLANT)
    run = jm.simulate(feedback, PLANT, np.array([0.5, 0.0]), 30, noise=NOISE, observer=observer)
    run = jax.tree.map(np.asarray, run)
    xi, C, y = np.array([0.1, 0.0]), np.array([[1.0, 0.0]]), None
    v = np.asarray(NOISE.prepared(2, 1).draw(30, 2, 1, jnp.float64)[1])
    for t in range(30):
        y = C @ run.states[t] + v[t]
        L = P @ C.T / (C @ P @ C.T + V)
        xi, P = xi + L @ (y - C @ xi), P - L @ C @ P
        np.testing.assert_allclose(run.estimates[t], xi, atol=1e-10)
        xi = SYSTEM.A @ xi + SYSTEM.B @ run.inputs[t] + SYSTEM.c
        P = SYSTEM.A @ P @ SYSTEM.A.T + W


@pytest.mark.parametrize("compensate", [True, False])
def test_delay_is_the_augmented_state(compensate):
    """z = (x, u of the sample before): z⁺ known in closed form with prediction and without."""
    x0, u0 = np.array([0.4, -0.1]), np.array([0.3])
    run = jm.simulate(
        LAW, SYSTEM, x0, 40, delay=1, compensate=compensate, previous_input=u0
    )  # fmt: skip
    A, B, c = SYSTEM.A, SYSTEM.B, SYSTEM.c
    x, u = x0, u0
    for t in range(40):
        np.testing.assert_allclose(run.states[t], x, atol=1e-12)
        np.testing.assert_allclose(run.inputs[t], u, atol=1e-12)
        after = A @ x + B @ u + c
        x, u = after, K @ (after if compensate else x)
    loop = np.block([[A, B], [K @ A, K @ B]] if compensate else [[A, B], [K, np.zeros((1, 1))]])
    assert np.abs(np.linalg.eigvals(loop)).max() < 1
    if compensate:  # of the loop without delay, and a pole at 0
        poles = np.sort_complex(np.append(np.linalg.eigvals(A + B @ K), 0))
        np.testing.assert_allclose(np.sort_complex(np.linalg.eigvals(loop)), poles, atol=1e-9)


@pytest.mark.parametrize("kind", ["law", pytest.param("plans", marks=pytest.mark.slow)])
def test_delayed_loops_with_filter_and_moving_references(kind):
    """Under perfect prediction the delayed loop is the one without delay, a sample later, also for
    references over time and through an observer."""
    controller = LAW
    if kind == "plans":
        controller = jm.Controller(MPC, jm.ADMM(iterations=200, newton_steps=0))
    x0, u0 = np.array([0.4, -0.1]), np.array([0.3])
    r = np.stack([np.sin(np.arange(20 + 3) / 5), np.zeros(23)], axis=1)
    s = 0.1 * np.cos(np.arange(20 + 2))[:, None]
    late = jm.simulate(
        controller, SYSTEM, x0, 20, reference=r, input_reference=s, delay=1, previous_input=u0,
        observer=FILTER,
    )  # fmt: skip
    r, s = (np.concatenate([v[1:], v[-1:]]) for v in (r, s))
    want = jm.simulate(
        controller, SYSTEM, late.states[1], 20, reference=r, input_reference=s, observer=FILTER
    )
    np.testing.assert_allclose(late.states[1:], want.states[:-1], atol=1e-8)
    np.testing.assert_allclose(late.inputs[1:], want.inputs[:-1], atol=1e-7)
    np.testing.assert_allclose(late.stage_cost[1:], want.stage_cost[:-1], atol=1e-7)
    np.testing.assert_allclose(late.cost, want.cost, atol=1e-7)


@pytest.mark.long
def test_a_delay_is_predicted_by_the_first_of_systems_that_differ():
    """Three times the same one: the loop is that of the system."""
    A, B = 0.9 * np.eye(2), [[0.1], [1.0]]
    runs = []
    for system in (jm.LinearSystem(A, B), jm.LinearSystem(np.stack([A] * 3), B)):
        controller = jm.Controller(jm.MPC(system, np.eye(2), [[1.0]], 3, inputs=jm.Box(-1, 1)))
        runs.append(jm.simulate(controller, jm.LinearSystem(A, B), [1.0, 0.0], 3, delay=1))
    np.testing.assert_allclose(runs[1].states, runs[0].states, atol=1e-6)


@pytest.mark.slow
@pytest.mark.long
def test_the_input_before_a_delayed_loop_is_the_first_reference():
    """Plans begin with the second row; what acts until then is the first."""
    mpc = jm.MPC(SYSTEM, np.eye(2), np.eye(1), 3)
    controller = jm.RobotController(PLANT, mpc, linearize="trajectory")
    s = np.linspace(0.1, 0.8, 8)[:, None]
    for compensate in (True, False):
        run = jm.simulate(
            controller, PLANT, np.zeros(2), 4, input_reference=s[:6], delay=1, compensate=compensate
        )
        np.testing.assert_allclose(run.inputs[0], s[0])


def test_a_robots_own_model_predicts_its_delay():
    """Inside its limits the predictor is the plant: the delayed loop of a robot far from where its
    law was made is the one without delay, a sample later. Without prediction it is another."""
    robot = jm.load_robot("pendulum")
    mpc = jm.MPC(SYSTEM, Q, R, 2, inputs=robot.input_limits)
    law = LinearFeedback(mpc, [[-40.0, -10.0]], robot)
    late = jm.simulate(law, robot, np.array([0.6, -2.0]), 8, delay=1, previous_input=np.ones(1))
    want = jm.simulate(law, robot, late.states[1], 8)
    np.testing.assert_allclose(late.states[1:], want.states[:-1], atol=1e-9)
    naive = jm.simulate(
        law, robot, np.array([0.6, -2.0]), 8, delay=1, previous_input=np.ones(1), compensate=False
    )
    assert np.abs(naive.states - late.states).max() > 1e-3


@pytest.mark.long
def test_references_of_each_loop():
    """What each gives alone, in both shapes; also where B = T + N, so that shapes coincide."""
    steps = 4
    B = steps + MPC.horizon
    rng = np.random.default_rng(0)
    x0s, still = rng.normal(size=(B, 2)), rng.normal(size=(B, 2))
    moving, inputs = rng.normal(size=(B, steps + 3, 2)), rng.normal(size=(B, steps + 2, 1))
    many = lambda **given: jm.simulate_many(LAW, SYSTEM, x0s, steps, chunk=3, **given)
    each, shared, over_time = (
        many(references=still), many(reference=still),
        many(references=moving, input_references=inputs),
    )  # fmt: skip
    for i in range(B):
        for run, given in (
            (each, dict(reference=still[i])), (shared, dict(reference=still)),
            (over_time, dict(reference=moving[i], input_reference=inputs[i])),
        ):  # fmt: skip
            want = jm.simulate(LAW, SYSTEM, x0s[i], steps, **given)
            np.testing.assert_allclose(run.states[i], want.states, atol=1e-12)


@pytest.mark.slow
def test_derivatives_through_noise_filter_and_delay():
    """Of the cost in the gain of the law and the standard deviations: finite differences."""
    keys = jax.random.split(jax.random.key(0), 3)

    def cost(theta):
        law = LinearFeedback(MPC, theta[:2][None])

        def one(key):
            noise = Noise(theta[2], theta[3], key)
            observer = KalmanFilter(SYSTEM, theta[2], theta[3])
            return jm.simulate(
                law, SYSTEM, jnp.array([0.5, 0.0]), 15, noise=noise, observer=observer, delay=1
            ).stage_cost.sum()

        return jax.vmap(one)(keys).sum()

    theta = jnp.array([*K[0], 0.02, 0.05])
    slope = jax.jit(jax.grad(cost))(theta)
    value = jax.jit(cost)
    step = 1e-6 * np.eye(4)
    want = [(value(theta + h) - value(theta - h)) / 2e-6 for h in step]
    np.testing.assert_allclose(slope, want, rtol=1e-5)


LOADED = """<mujoco><worldbody><body><joint name="j" axis="0 1 0" damping=".2"/>
<geom type="capsule" fromto="0 0 0 .4 0 0" size=".02" mass="1"/><site name="tool" pos=".4 0 0"/>
</body></worldbody><actuator><motor joint="j" ctrlrange="-9 9" gear="2"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def loaded():
    return jm.load_robot(mujoco.MjModel.from_xml_string(LOADED), control_period=0.02)


def followed(robot, kinds, seed=0, **numbers):
    """Return what a filter that measures everything estimates of a plant with other numbers, under
    random inputs, in its last step."""
    loads = tuple(Disturbance(kind, 1e-6, M, initial=0.5) for kind, M in kinds)
    observer = KalmanFilter(robot, 1e-7, 1e-6, C=np.eye(2), initial=1e-3, disturbance=loads)
    observer, plant = observer.prepared(), robot.vary(**numbers)
    random = np.random.default_rng(seed)

    @jax.jit
    def step(x, belief, u):
        belief = observer.corrected(belief, robot.coordinates(x))
        return plant.step(x, u), observer.predicted(belief, u), belief.mean

    x, belief = np.array([0.3, 0.0]), observer.first(np.array([0.3, 0.0]))
    for _ in range(60):
        x, belief, mean = step(x, belief, random.uniform(-2, 2, 1))
    return observer.split(np.asarray(mean))[1]


@pytest.mark.slow
def test_numbers_of_a_robot_are_estimated(loaded):
    """A payload, the damping of a joint and the strength of a motor, each alone and together."""
    gear = np.eye(6, 1)
    truth = {"payload": 0.7, "dof_damping": [0.5], "actuator_gear": [[2.6, 0, 0, 0, 0, 0]]}
    changes = {"payload": 0.7, "dof_damping": 0.3, "actuator_gear": 0.6}
    matrices = {"actuator_gear": gear}
    for kind, value in truth.items():
        found = followed(loaded, [(kind, matrices.get(kind))], **{kind: value})
        np.testing.assert_allclose(found, changes[kind], rtol=1e-3)
    both = ("payload", "dof_damping")
    found = followed(loaded, [(kind, None) for kind in both], **{k: truth[k] for k in both})
    np.testing.assert_allclose(found, [changes[k] for k in both], rtol=1e-3)


@pytest.mark.long
def test_numbers_that_cannot_be_negative_are_held_at_zero(loaded):
    """An estimate below 0, as noise gives one of no payload, is no error; and it comes back."""
    load = Disturbance("payload", 1e-3, initial=0.5)
    observer = KalmanFilter(loaded, 1e-6, 1e-5, initial=1e-3, disturbance=load).prepared()
    belief = Belief(jnp.array([0.3, 0.0, -1.0]), jnp.diag(jnp.array([1e-6, 1e-6, 0.25])))
    assert observer.numbers(belief.mean[2:]) == {"payload": 0.0}
    plant, u, x = loaded.vary(payload=0.4), jnp.ones(1), jnp.array([0.3, 0.0])
    predicted = observer.predicted(belief, u)  # outside jit, where numbers are checked
    np.testing.assert_allclose(predicted.mean[:2], loaded.step(x, u), atol=1e-12)
    step = jax.jit(lambda b, x: observer.corrected(observer.predicted(b, u), x[:1]))
    for _ in range(40):
        x = plant.step(x, u)
        belief = step(belief, x)
    np.testing.assert_allclose(belief.mean[2], 0.4, rtol=0.02)


def test_one_output_tells_several_numbers(loaded):
    loads = tuple(Disturbance(kind, 1e-3, initial=0.5) for kind in ("payload", "dof_damping"))
    KalmanFilter(loaded, 1e-6, 1e-5, C=[[1, 0]], initial=1e-3, disturbance=loads).prepared()
    with pytest.raises(ValueError, match="1 outputs are measured|1 output"):
        KalmanFilter(
            loaded, 1e-6, 1e-5, C=[[1, 0]], initial=1e-3,
            disturbance=(Disturbance("state", 1e-3, initial=0.5), *loads),
        ).prepared()  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("inputs", r"disturbance\[0\].kind: 'inputs'. Did you mean input. Give one of input"),
        (None, r"disturbance\[0\].kind: None"),
        ("body_massx", "Did you mean body_mass"),
        ("dof_frictionloss", "dof_frictionloss', of which the model has nothing"),
    ],
)
def test_kinds_of_a_robots_filter_are_named(loaded, kind, message):
    load = Disturbance(kind, 1e-3, initial=0.5)
    with pytest.raises(ValueError, match=message):
        KalmanFilter(loaded, 1e-6, 1e-5, initial=1e-3, disturbance=load).prepared()


@pytest.mark.long
def test_numbers_are_held_through_activations(loaded):
    """The activation at rest changes with the load too; one linear model takes no numbers."""
    slow = LOADED.replace("<motor", '<general dyntype="filter" dynprm=".05" gainprm="1"')
    for text in (slow, LOADED):
        robot = jm.load_robot(mujoco.MjModel.from_xml_string(text), control_period=0.02)
        x, u = robot.set_point([1.0])
        file, told = (RobotModel(robot, numbers) for numbers in ({}, {"payload": 0.7}))
        r, s = held_references(file, told, robot.coordinates(x), u, np.float64)
        at = np.asarray(robot.state(r))
        after = robot.vary(payload=0.7).step(at, s)
        np.testing.assert_allclose(after, at, atol=1e-6)
        assert abs(s[0] - u[0]) > 0.1
    fixed = jm.RobotController(
        loaded, jm.robot_mpc(loaded, horizon=3, target=[1.0]), linearize="set-point"
    )
    for numbers, message in (
        ({"payload": 0.7}, "numbers: given with"),
        ([1.0], "numbers: is a list"),
    ):
        with pytest.raises(ValueError, match=message):
            fixed(np.array([1.0, 0.0]), numbers=numbers)


HEAVY_LIGHT = """<mujoco><worldbody><body><joint name="a" axis="0 1 0" damping="5"/>
<geom type="capsule" fromto="0 0 0 .5 0 0" size=".05" mass="30"/><site name="tool" pos=".5 0 0"/>
<body pos=".5 0 0"><joint name="b" axis="0 1 0" damping=".01"/>
<geom type="capsule" fromto="0 0 0 .1 0 0" size=".01" mass=".05"/></body></body></worldbody>
<actuator><motor joint="a" ctrlrange="-900 900"/><motor joint="b" ctrlrange="-2 2"/></actuator>
</mujoco>"""


def test_loads_are_held_by_motors_of_any_size():
    """The torque of a link of 30 kg beside one of 50 g, in float32: J'mg by MuJoCo's C engine."""
    model = mujoco.MjModel.from_xml_string(HEAVY_LIGHT)
    robot = jm.load_robot(model, control_period=0.01)
    q = np.array([0.3, -0.2])
    x, u = robot.set_point(q)
    file, told = (RobotModel(robot, numbers, exact=False) for numbers in ({}, {"payload": 5.0}))
    xi = np.asarray(robot.coordinates(x), np.float32)
    held = held_references(file, told, xi, np.float32(u), np.float32)[1] - u
    data, J = mujoco.MjData(model), np.zeros((3, 2))
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_jacSite(model, data, J, None, model.site("tool").id)
    np.testing.assert_allclose(held, J.T @ [0, 0, 5 * 9.81], rtol=1e-3, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("linearize", ["state", "trajectory", None])
def test_plans_know_the_estimated_payload(loaded, linearize):
    """The rod hangs where its reference is, and is held there: with a load that nobody knows below
    it, with an estimated one where a controller that knows the load brings it."""
    target = [1.0]
    mpc = jm.robot_mpc(loaded, horizon=5, target=target)
    x, torque = loaded.set_point(target)
    aims = {"reference": loaded.coordinates(x), "input_reference": torque}
    if linearize is None:
        problem = jm.mpc.NonlinearMPC(mpc, RobotModel(loaded, {"dof_damping": [0.2]}))
        controller = jm.NonlinearController(problem, sqp_steps=3, hessian="gauss-newton")
    else:
        controller = jm.RobotController(loaded, mpc, linearize=linearize)
    known, plant = {"payload": 0.7}, loaded.vary(payload=0.7)
    load = Disturbance("payload", 1e-4, initial=0.5)
    errors = []
    for disturbance in ((), load):
        observer = KalmanFilter(
            loaded, 1e-6, 1e-5, C=np.eye(2), initial=1e-3, disturbance=disturbance
        )
        run = jm.simulate(controller, plant, [0.8, 0.0], 150, observer=observer, **aims)
        errors.append(abs(run.states[-1, 0] - 1.0))
    np.testing.assert_allclose(run.disturbances[-1], 0.7, rtol=1e-3)
    assert errors[1] < 1e-3 < 0.02 * errors[0]
    # At the reference the input is what holds the rod with its load there.
    control = controller(np.array([1.0, 0.0]), None, numbers=known, **aims)
    x = np.asarray(plant.step(np.array([1.0, 0.0]), control.u))
    np.testing.assert_allclose(x, [1.0, 0.0], atol=2e-3)


@pytest.mark.slow
def test_the_covariance_of_numbers_is_that_of_the_linear_model(loaded):
    """By differences of the prediction, about numbers that are not the file's."""
    model = RobotModel(loaded, numbers={"payload": 0.2})
    problem = jm.mpc.NonlinearMPC(jm.robot_mpc(loaded, horizon=2), model)
    load = Disturbance("payload", 0.01, [[2.0]], initial=0.3)
    observer = KalmanFilter(problem, 0.0, 1e-3, initial=0.1, disturbance=load).prepared()
    mean, u = jnp.array([0.3, -0.4, 0.15]), jnp.array([0.7])
    P = jnp.diag(jnp.array([0.02, 0.01, 0.09]))
    after = lambda mean: observer.predicted(Belief(mean, P), u).mean
    step = 1e-6
    F = np.stack(
        [(after(mean + step * e) - after(mean - step * e)) / (2 * step) for e in np.eye(3)]
    )
    found = observer.predicted(Belief(mean, P), u).covariance
    np.testing.assert_allclose(found, F.T @ P @ F + np.diag([0, 0, 1e-4]), atol=1e-9)
    heavier = RobotModel(loaded, numbers={"payload": 0.2 + 2 * 0.15})
    np.testing.assert_allclose(after(mean)[:2], heavier.step(mean[:2], u), atol=1e-12)


def test_not_finite_stays_in_its_row(gaussian):
    """Also in the derivative with respect to the starts."""
    x0s = np.zeros((3, 2))
    x0s[1] = np.nan
    run = jm.simulate_many(LAW, SYSTEM, x0s, STEPS, chunk=2, noise=NOISE, observer=FILTER)
    assert np.isnan(run.states[1]).all() and np.isnan(run.estimates[1]).all()
    np.testing.assert_allclose(run.states[[0, 2]], gaussian.states[[0, 2]], atol=1e-12)

    @jax.jit
    @jax.grad
    def slope(x0s):
        one = lambda x: jm.simulate(LAW, SYSTEM, x, 5, noise=NOISE, observer=FILTER).stage_cost
        return jax.vmap(one)(x0s)[jnp.array([0, 2])].sum()

    found, clean = slope(jnp.asarray(x0s)), slope(jnp.zeros((3, 2)))
    np.testing.assert_allclose(found[jnp.array([0, 2])], clean[jnp.array([0, 2])])


@pytest.mark.parametrize("initial", [None, 0.3])
def test_outputs_that_are_not_finite_correct_nothing(initial):
    """One bad reading: the estimate is the prediction, and the loop goes on."""
    observer = KalmanFilter(SYSTEM, W.tolist(), [0.03], C=[[1.0, 0.0]], initial=initial)
    bad = np.zeros((6, 1))
    bad[2] = np.inf
    run = lambda **more: jm.simulate(
        jm.Controller(MPC), SYSTEM, [0.3, 0.1], 6, observer=observer, **more
    )
    found = run(output_disturbance=bad)
    assert np.all(found.status == jm.Status.SOLVED)
    x, u = found.estimates[1], found.inputs[1]
    np.testing.assert_allclose(found.estimates[2], SYSTEM.step(x, u), atol=1e-12)
    belief = observer.prepared().first(np.array([3, 2]))  # whole numbers too
    assert initial is None or np.all(np.diag(belief.covariance) > 0)
    np.testing.assert_allclose(observer.outputs([3, 2]), [3.0])
    slope = jax.grad(lambda x: jnp.sum(observer.prepared().corrected(
        observer.prepared().first(x), jnp.array([jnp.nan])).mean))  # fmt: skip
    np.testing.assert_allclose(slope(jnp.array([0.3, 0.1])), 1.0)


@pytest.mark.slow
def test_orientations_stay_rotations():
    """Noise on a quadrotor lives in the coordinates: quaternions of length 1, the noise in ξ."""
    robot = jm.load_robot("quadrotor")
    x, u = robot.equilibrium()
    mpc = jm.robot_mpc(robot, horizon=5)
    law = LinearFeedback(mpc, np.asarray(jm.lqr(mpc.system, mpc.Q, mpc.R).K), robot)
    goal = dict(reference=np.asarray(robot.coordinates(x)), input_reference=u)
    sizes = np.repeat([1e-4, 1e-4, 1e-3, 5e-3], 3)
    noise = Noise(sizes, np.repeat([1e-4, 2e-4], 3), seed=1)
    start = np.asarray(robot.coordinates(x)) + 0.2
    observer = KalmanFilter(robot, sizes, np.repeat([1e-4, 2e-4], 3), initial=0.2, start=start)
    run = jm.simulate(law, robot, x, 10, noise=noise, observer=observer, **goal)
    for states in (run.states, run.estimates):
        np.testing.assert_allclose(np.linalg.norm(states[:, 3:7], axis=1), 1, atol=1e-12)
    w, _ = noise.prepared(12, 6).draw(10, 12, 6, jnp.float64)
    xi = jax.jit(jax.vmap(robot.coordinates))
    before = zip(np.asarray(run.states[:-1]), np.asarray(run.inputs), strict=True)
    after = xi(np.array([c_steps(robot.mujoco, x, u, robot.substeps) for x, u in before]))
    np.testing.assert_allclose(xi(run.states[1:]) - after, w, atol=1e-10)
    # First estimates 0.2 off, of which nothing was measured but positions.
    off = np.abs(xi(run.states[:-1]) - xi(run.estimates))
    assert off[0, 6:].min() > 0.1 and off[-1].max() < 0.05


def test_bad_noise_and_observers_are_named():
    odd = jm.LinearSystem(np.eye(3) / 2, np.ones((3, 1)))
    unstable = jm.LinearSystem(np.diag([1.2, 1.1]), np.ones((2, 1)))
    run = lambda **given: jm.simulate(LAW, SYSTEM, np.zeros(2), 4, **given)
    many = lambda **given: jm.simulate_many(LAW, SYSTEM, np.zeros((5, 2)), 4, **given)
    robot = jm.load_robot("pendulum", control_period=T)
    for call, message in (
        (lambda: run(noise=Noise([1.0, 1.0, 1.0])), r"noise.process: shape \(3,\). Give standard"),
        (lambda: run(noise=Noise(measurement=-1.0)), "noise.measurement: has a negative"),
        (lambda: run(noise=Noise(np.array([[1.0, 2.0], [2.0, 1.0]]))), "noise.process: is not pos"),
        (lambda: run(noise=Noise(np.nan)), "noise.process: holds NaN"),
        (lambda: run(noise=Noise(1.0, seed=0.5)), "noise.seed: 0.5. Give a whole number"),
        (lambda: run(noise=Noise(1.0, seed=2**32)), "noise.seed: 4294967296. Give a whole number"),
        (lambda: run(noise=Noise(1.0, [1.0, 1.0]), observer=FILTER), "noise.measurement: shape"),
        (lambda: run(noise=0.1), "noise: is a float. Give a closed_loop.Noise"),
        (lambda: run(observer=SYSTEM), "observer: is a LinearSystem. Give a closed_loop.Kal"),
        (lambda: run(observer=KalmanFilter(odd, 1.0, 1.0)), "observer.C: is None with 3 states"),
        (
            lambda: run(observer=KalmanFilter(odd, 1.0, 1.0, C=np.eye(3))),
            "observer.model: has 3 states, the controller's model 2",
        ),
        (lambda: run(observer=KalmanFilter(SYSTEM, 1.0, 0.0)), "observer.measurement: has a comb"),
        (lambda: run(observer=KalmanFilter(SYSTEM, None, 1.0)), "observer.process: is None"),
        (lambda: run(observer=KalmanFilter(SYSTEM, 1.0, 1.0, C=np.eye(3))), "observer.C: shape"),
        (lambda: run(observer=KalmanFilter(SYSTEM, 1.0, 1.0, start=[0.0])), "observer.start: sha"),
        (
            lambda: run(observer=KalmanFilter(SYSTEM, 1.0, 1.0, start=[np.nan, 0.0])),
            "observer.start: holds NaN",
        ),
        (
            lambda: run(observer=KalmanFilter(SYSTEM, 1.0, 1.0, C=[[1.0], [1.0, 2.0]])),
            "observer.C: .* is not an array",
        ),
        (
            lambda: run(observer=KalmanFilter(SYSTEM, 1.0, 1.0, C=[[0.0, 1.0]])),
            "observer.C: no output shows the mode with eigenvalue 1",
        ),
        (
            lambda: run(observer=KalmanFilter(unstable, [1.0, 0.0], 1.0, C=np.eye(2))),
            "observer.process: no noise moves the mode with eigenvalue 1.1. Give it some, or init",
        ),
        (
            lambda: run(observer=KalmanFilter(replace(SYSTEM, dt=0.2), 1.0, 1.0)),
            "observer.model: has a sampling period of 0.2 s, the controller's model 0.1. Give both",
        ),
        (
            lambda: run(observer=KalmanFilter(robot, 1.0, 1.0)),
            "observer.initial: is None for a Robot",
        ),
        (
            lambda: run(observer=KalmanFilter(
                SYSTEM, 1.0, 1.0, C=[[1.0, 0.0]], disturbance=Disturbance("input", 0.1, [[0.0]])
            )),
            "matrix: has a column of zeros",
        ),
        (lambda: run(delay=2), "delay: 2. Give 0 or 1"),
        (lambda: run(delay=0.5), "delay: 0.5. Give a whole"),
        (
            lambda: many(references=np.zeros((4, 2))),
            r"references: shape \(4, 2\). Give \(5, 2\) or \(5, 7, 2\), one for each loop; ref",
        ),
        (lambda: many(input_references=np.zeros((5, 7, 1))), r"input_references: shape \(5, 7, 1"),
        (
            lambda: many(references=np.zeros((5, 2)), reference=np.zeros(2)),
            "references: given beside reference. Give one for all loops, or one for each",
        ),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            call()


@pytest.mark.long
def test_a_law_gives_nan_of_nan_and_forgets_it():
    """A Controller's u stays finite; a law says what it has, and each state has its own."""
    bad = np.array([0.1, np.nan])
    states = np.stack([np.array([0.01, 0.0]), bad])
    inputs = jax.vmap(lambda x: LAW(x).u)(states)
    np.testing.assert_array_equal(np.isnan(inputs[:, 0]), [False, True])
    np.testing.assert_array_equal(LAW(states[0], LAW(bad)).u, inputs[0])
