"""Rotations beyond half a turn from home: plans take the shorter way, filters do not jump."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import jaxmpc as jm
from jaxmpc.closed_loop import Environment, KalmanFilter, LinearFeedback, NonlinearController
from jaxmpc.closed_loop.orientations import aligned
from jaxmpc.closed_loop.outcome import evaluate_runs
from jaxmpc.mpc import NonlinearMPC
from jaxmpc.robots.configurations import nearest_turns
from jaxmpc.robots.robot import RobotModel

# A body that turns about its centre, with a motor about each of its axes.
SATELLITE = """
<mujoco><option gravity="0 0 0" timestep="0.05"/><worldbody><body><joint name="ball" type="ball"/>
<geom type="box" size="0.1 0.15 0.2" mass="5"/></body></worldbody><actuator>
<motor name="x" joint="ball" gear="1 0 0" ctrlrange="-1 1"/>
<motor name="y" joint="ball" gear="0 1 0" ctrlrange="-1 1"/>
<motor name="z" joint="ball" gear="0 0 1" ctrlrange="-1 1"/></actuator></mujoco>"""
KINDS = "state", "trajectory", "set-point", "nonlinear"
AXIS = np.array([0.48, -0.6, 0.64])


@pytest.fixture(scope="module")
def satellite():
    return jm.load_robot(mujoco.MjModel.from_xml_string(SATELLITE), control_period=0.05)


def turned(angle, rate=0.0):
    """The state turned by an angle about the axis, at a rate."""
    half = angle / 2
    return np.concatenate([[np.cos(half)], np.sin(half) * AXIS, rate * AXIS])


def angles(states, angle):
    """The angles between orientations and that turned by `angle`, by SciPy."""
    aim = Rotation.from_quat(turned(angle)[[1, 2, 3, 0]])
    return (Rotation.from_quat(np.asarray(states)[:, [1, 2, 3, 0]]) * aim.inv()).magnitude()


def test_nearest_turns_are_the_same_orientation():
    rng = np.random.default_rng(0)
    joints = (mujoco.mjtJoint.mjJNT_BALL, mujoco.mjtJoint.mjJNT_HINGE)
    nearest = jax.jit(lambda v, near: nearest_turns(joints, v, near))
    for _ in range(300):
        v, near = rng.normal(size=(2, 4)) * rng.choice([0.5, 1.5, 3.0], (2, 1))
        found, length = np.asarray(nearest(v, near)), np.linalg.norm(v[:3])
        same = v[:3] * (1 + 2 * np.pi * np.arange(-3, 4)[:, None] / length)
        best = same[np.argmin(np.linalg.norm(same - near[:3], axis=1))]
        shortest = same[np.argmin(np.linalg.norm(same, axis=1))]
        best = best if np.linalg.norm(best) <= 1.5 * np.pi else shortest
        np.testing.assert_allclose(found, [*best, v[3]], rtol=1e-5, atol=1e-5)
    zero = jnp.zeros(4)
    assert np.isfinite(jax.jacfwd(lambda v: nearest(v, zero + 2))(zero)).all()


def controllers(robot):
    """Controllers of every kind whose plans begin at a rotation vector."""
    mpc = jm.robot_mpc(robot, [4.0, 4, 4, 1, 1, 1], [0.1, 0.1, 0.1], 15)
    for linearize in ("state", "trajectory"):
        yield linearize, jm.RobotController(robot, mpc, linearize=linearize), robot
    far = jm.robot_mpc(robot, [4.0, 4, 4, 1, 1, 1], [0.1, 0.1, 0.1], 15, target=turned(3.0)[:4])
    yield "set-point", jm.RobotController(robot, far, linearize="set-point"), robot
    yield "law", LinearFeedback(far, jm.lqr(far.system, far.Q, far.R).K, robot), robot
    yield "nonlinear", NonlinearController(NonlinearMPC(mpc, RobotModel(robot))), None


@pytest.mark.parametrize(
    "kind",
    [
        "law",
        *(pytest.param(kind, marks=pytest.mark.long) for kind in KINDS[:3]),
        pytest.param("nonlinear", marks=pytest.mark.slow),
    ],
)
def test_loops_take_the_shorter_way(satellite, kind):
    """From −3 to 3 rad it is 0.28 rad the shorter way, and 6 the longer."""
    robot = satellite
    _, controller, plant = next(each for each in controllers(robot) if each[0] == kind)
    aim = np.asarray(robot.coordinates(turned(3.0)))
    start = turned(-3.0)
    if plant is None:
        plant, start = controller.model, np.asarray(robot.coordinates(start))
    run = jm.simulate(controller, plant, start, 60, reference=aim, input_reference=np.zeros(3))
    states = run.states if plant is robot else jax.vmap(robot.state)(run.states)
    off = angles(states, 3.0)
    assert off[0] == pytest.approx(2 * np.pi - 6, abs=1e-5)
    assert off.max() < off[0] + 0.01 and off[-1] < 0.01
    assert np.asarray(run.stage_cost)[0] < 1  # 144 for 6 rad
    if plant is robot:
        assert evaluate_runs(run, robot, aim).reached.all()


@pytest.mark.long
def test_rewards_are_stage_costs_beyond_half_a_turn(satellite):
    robot = satellite
    controller = next(controllers(robot))[1]
    q = turned(3.0)[:4]
    environment = Environment.of(robot, q, Q=np.asarray(controller.mpc.Q), R=controller.mpc.R)
    aim = np.asarray(robot.coordinates(turned(3.0)))
    run = jm.simulate(
        controller, robot, turned(-3.0), 5, reference=aim, input_reference=np.zeros(3)
    )
    state = environment.at(turned(-3.0))
    step = jax.jit(Environment.step)
    for u, cost in zip(run.inputs, run.stage_cost, strict=True):
        state = step(environment, state, u)
        assert float(state.reward) == pytest.approx(-float(cost), rel=1e-4)
    loss = jm.tuning.ClosedLoopLoss(controller.mpc.Q, 0.0 * np.eye(3), reference=aim, plant=robot)
    tracked = [
        float(c - u @ controller.mpc.R @ u) for c, u in zip(run.stage_cost, run.inputs, strict=True)
    ]
    assert float(loss(run)) == pytest.approx(np.mean(tracked), rel=1e-4)


@pytest.mark.long
def test_references_that_turn_on_are_followed(satellite):
    """A reference of one turn in 4 s, given by vectors of at most half a turn."""
    robot = satellite
    controller = next(controllers(robot))[1]
    rate, times = 2 * np.pi / 4, 0.05 * np.arange(95)
    aims = [np.asarray(robot.coordinates(turned(rate * t, rate))) for t in times]
    run = jm.simulate(controller, robot, turned(0.0, rate), 80, reference=np.array(aims))
    off = [angles(x[None], rate * t)[0] for x, t in zip(run.states, times, strict=False)]
    assert max(off) < 0.02


def test_limited_rotations_do_not_turn_through_what_is_excluded(satellite):
    robot = satellite
    mpc = jm.robot_mpc(robot, horizon=5)
    limits = jm.Box(np.r_[-3.1, -3.1, -3.1, [-np.inf] * 3], np.r_[3.1, 3.1, 3.1, [np.inf] * 3])
    xi, aim = (jnp.asarray([0, 0, angle, 0, 0, 0.0]) for angle in (-3.0, 3.0))
    for limited in (replace(mpc, states=limits), limits, jm.Polytope(np.eye(6)[2:3], [3.1])):
        np.testing.assert_array_equal(aligned(robot, limited, xi, aim)[0], xi)
    np.testing.assert_allclose(aligned(robot, mpc, xi, aim)[0][2], 2 * np.pi - 3, rtol=1e-6)


@pytest.mark.parametrize("reference", [np.zeros(2), np.zeros((5, 5)), 1.0, ["a"] * 6])
@pytest.mark.parametrize("kind", ["state", "nonlinear"])
def test_wrong_references_are_named(satellite, kind, reference):
    _, controller, plant = next(each for each in controllers(satellite) if each[0] == kind)
    x = turned(0.1) if plant is satellite else np.zeros(6)
    with pytest.raises(ValueError, match="reference: "):
        controller(x, None, reference)


def test_references_of_most_of_a_turn_are_taken_on_from_their_middle(satellite):
    """From half a turn on by 2.8 rad: 3π/2 either way holds them."""
    given = [satellite.coordinates(turned(np.pi - 0.1 + 0.2 * k)) for k in range(15)]
    rows = aligned(satellite, None, jnp.zeros(6), jnp.asarray(given))[1]
    steps = np.linalg.norm(np.diff(rows[:, :3], axis=0), axis=1)
    np.testing.assert_allclose(steps, 0.2, rtol=1e-4)
    for row, k in zip(rows, range(15), strict=True):
        assert angles(satellite.state(row)[None], np.pi - 0.1 + 0.2 * k)[0] < 1e-5


def test_references_of_many_turns_are_orientations_too(satellite):
    xi = satellite.coordinates(turned(0.1))
    for angle in (4 * np.pi + 0.3, -6 * np.pi - 2.0):
        near, aim = aligned(satellite, None, xi, np.append(angle * AXIS, [0, 0, 0]))
        assert np.linalg.norm(near - aim) < np.pi + 1e-4
        assert angles(satellite.state(aim)[None], angle)[0] < 1e-5
    rows = np.array([np.append((18.0 + 0.1 * k) * AXIS, [0, 0, 0]) for k in range(8)])
    aims = aligned(satellite, None, xi, rows)[1]
    np.testing.assert_allclose(np.linalg.norm(np.diff(aims[:, :3], axis=0), axis=1), 0.1, rtol=1e-3)


@pytest.mark.long
def test_missing_and_repeated_readings_of_orientations(satellite):
    C = np.eye(6)[[0, 1, 2, 0, 1, 2]]
    observer = KalmanFilter(satellite, 1e-3, 1e-2, C=C, initial=0.05).prepared()
    belief = observer.first(satellite.coordinates(turned(3.1)))
    y = np.tile(satellite.coordinates(turned(-3.1))[:3], 2)
    after = satellite.state(observer.corrected(belief, jnp.asarray(y)).mean)
    assert angles(after[None], 3.1)[0] < 2 * np.pi - 6.2 + 1e-4
    nothing = jnp.full(6, jnp.nan)
    slope = jax.jacrev(lambda y: observer.corrected(belief, y).mean)(nothing)
    np.testing.assert_array_equal(slope, 0)


@pytest.mark.long
@pytest.mark.parametrize("rows", [[0, 1, 2], [2, 0, 1, 5]])
def test_estimates_do_not_jump_at_half_a_turn(satellite, rows):
    """Measured and estimated vectors lie on two sides of half a turn at many of these steps."""
    robot, C = satellite, None if rows == [0, 1, 2] else np.eye(6)[rows]
    with jax.enable_x64(True):
        observer = KalmanFilter(robot, 1e-4, 1e-2, C=C, initial=0.02).prepared()
        steps = jax.jit(robot.step), jax.jit(observer.corrected), jax.jit(observer.predicted)
        rng, u, x = np.random.default_rng(0), np.zeros(3), turned(np.pi - 0.05, 0.03)
        belief, off = observer.first(robot.coordinates(x)), []
        for _ in range(80):
            y = np.asarray(robot.coordinates(x))[rows] + rng.normal(0, 1e-2, len(rows))
            belief = steps[1](belief, y)
            here = np.asarray(robot.state(belief.mean))
            off.append(angles(here[None], 2 * np.arccos(x[0]))[0] if x[0] > 0 else 0.0)
            off.append(np.linalg.norm(here[4:] - x[4:]))
            x, belief = np.asarray(steps[0](x, u)), steps[2](belief, u)
        spread = np.sqrt(np.diag(belief.covariance))
    assert max(off) < 0.05 and spread.max() < 0.02
