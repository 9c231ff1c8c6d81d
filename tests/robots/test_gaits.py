"""Gaits: motions against MuJoCo's kinematics, their linear models against those of the feet that
stand, the periodic LQR against lifted Riccati equations, and a quadruped that trots in MuJoCo."""

import itertools
import re
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import scipy
from scipy.spatial.transform import Rotation

import jaxmpc as jm
from jaxmpc.closed_loop import GaitController, KalmanFilter
from jaxmpc.closed_loop.gait_controller import _require_free_trunk, periodic_cost_to_go
from jaxmpc.robots.contacts import STANDING
from jaxmpc.robots.gaits import TrunkPath, _paths, _phases
from jaxmpc.robots.robot import RobotModel

QUADRUPED = Path(__file__).parents[2] / "experiments" / "robots" / "quadruped.xml"
FEET = ("FL", "FR", "RL", "RR")
SPEED = 0.5


@pytest.fixture(scope="module")
def robot():
    """The quadruped at 100 Hz."""
    return jm.load_robot(QUADRUPED, control_period=0.01)


@pytest.fixture(scope="module")
def gait(robot):
    """Its trot."""
    return jm.robots.gait(robot, FEET, (SPEED, 0.0))


def places(model, q):
    """Where the feet are, by MuJoCo's C engine."""
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    return np.array([data.geom(name).xpos for name in FEET])


def random_gait(rng, period, same=False):
    """What the periodic LQR reads of a gait: random linear models, unstable ones."""
    A = rng.normal(size=(period, 3, 3))
    A *= 1.1 / np.abs(np.linalg.eigvals(A)).max()
    B = rng.normal(size=(period, 3, 2))
    if same:
        A, B = (np.broadcast_to(v[0], v.shape) for v in (A, B))
    return SimpleNamespace(period=period, system=SimpleNamespace(A=A, B=B))


def test_periodic_lqr_of_one_model_is_the_lqr():
    rng = np.random.default_rng(0)
    gait, Q, R = random_gait(rng, 4, same=True), np.diag([1.0, 2.0, 0.0]), np.eye(2)
    found = periodic_cost_to_go(gait, Q, R)
    expected = scipy.linalg.solve_discrete_are(gait.system.A[0], gait.system.B[0], Q, R)
    np.testing.assert_allclose(found, np.broadcast_to(expected, found.shape), rtol=1e-8)


def test_periodic_lqr_is_that_of_the_lifted_system():
    """Over a whole period at once: x⁺ = A x + B U with the costs of all states on the way."""
    rng = np.random.default_rng(1)
    gait, Q, R = random_gait(rng, 3), np.diag([1.0, 0.5, 2.0]), np.diag([0.3, 1.0])
    for first in range(3):
        to_x, to_u = np.eye(3), np.zeros((3, 6))
        of_x, of_u, cross = np.zeros((3, 3)), np.kron(np.eye(3), R), np.zeros((3, 6))
        for step in range(3):
            A, B = (v[(first + step) % 3] for v in (gait.system.A, gait.system.B))
            of_x, of_u = of_x + to_x.T @ Q @ to_x, of_u + to_u.T @ Q @ to_u
            cross = cross + to_x.T @ Q @ to_u
            to_x, to_u = A @ to_x, A @ to_u
            to_u[:, 2 * step : 2 * step + 2] += B
        expected = scipy.linalg.solve_discrete_are(to_x, to_u, of_x, of_u, s=cross)
        found = periodic_cost_to_go(gait, Q, R)[first]
        np.testing.assert_allclose(found, expected, rtol=1e-7)


def test_periodic_lqr_of_a_slow_loop_is_found():
    """A heavy R leaves an integrator so slow that hundreds of periods count: P² = R for Q, R ≫ 1.

    The scalar equation P = q + P r / (r + P) has the root P = (q + √(q² + 4 q r)) / 2.
    """
    gait = SimpleNamespace(
        period=2, system=SimpleNamespace(A=np.ones((2, 1, 1)), B=np.ones((2, 1, 1)))
    )
    q, r = 1.0, 1e6
    found = periodic_cost_to_go(gait, np.array([[q]]), np.array([[r]]))
    expected = (q + np.sqrt(q * q + 4 * q * r)) / 2
    np.testing.assert_allclose(found, np.full((2, 1, 1), expected), rtol=1e-9)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"Q": np.ones(2)}, r"Q: shape \(2,\) where \(3, 3\)"),
        ({"R": 1.0}, r"R: shape \(\) where \(2, 2\)"),
        ({"solver": 3}, "solver: is an int"),
        ({"rho": -1.0}, "rho: -1.0"),
    ],
)
def test_weights_and_solvers_that_do_not_fit_are_named(given, text):
    """Before the LQR is looked for."""
    gait = random_gait(np.random.default_rng(2), 3, same=True)
    stand_in = jm.robots.Gait(
        SimpleNamespace(n=3, m=2), None, None, np.zeros((3, 3)), None, gait.system, None
    )
    with pytest.raises(ValueError, match=text):
        GaitController(stand_in, **{"Q": np.ones(3), "R": np.ones(2), **given})


def test_feet_that_carry_nothing_are_named(robot):
    """Two of four feet; and the same feet give the same model, whose programs are found again."""
    with pytest.raises(ValueError, match="feet: FL, FR do not carry quadruped at home. Name all"):
        jm.robots.gait(robot, ("FL", "FR"))
    assert robot.standing(FEET).predictor is robot.standing(FEET).predictor


def test_gaits_without_an_lqr_are_refused():
    gait = random_gait(np.random.default_rng(2), 3, same=True)
    gait.system.B = 0 * gait.system.B
    with pytest.raises(ValueError, match=r"gait: has no periodic LQR.*duty"):
        periodic_cost_to_go(gait, np.eye(3), np.eye(2))


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"duty": 1.0}, r"duty: 1.0.*\(0, 1\)"),
        ({"velocity": (0.5,)}, r"velocity: shape \(1,\)"),
        ({"velocity": (np.nan, 0.0)}, "velocity: "),
        ({"period": 0.02}, "period: 0.02 s is 2 control periods"),
        ({"period": -1.0}, "period: "),
        ({"lift": 0.0}, "lift: "),
        ({"offsets": (0.0, 0.5)}, r"offsets: shape \(2,\)"),
        ({"velocity": (4.0, 0.0)}, r"velocity: .*(stays|limits).*smaller velocity"),
        ({"lift": 0.5}, r"lift: .*(stays|limits).*lift"),
        ({"duty": 0.98}, "duty: 0.98: FL stands at 44 of 44 control periods. Let it .* swing at 3"),
        ({"duty": 0.95, "period": 0.2}, "duty: 0.95: FL stands at 19 of 20"),
        ({"duty": 0.05, "offsets": (0.05, 0.55, 0.55, 0.05), "period": 0.1}, "FL stands at 0 of"),
        ({"feet": ("FL", "nose")}, "feet: "),
    ],
)
def test_what_is_no_gait_is_named(robot, given, text):
    """Before anything is compiled."""
    with pytest.raises(ValueError, match=text):
        jm.robots.gait(**{"robot": robot, "feet": FEET, **given})


def test_feet_stand_from_the_period_in_which_they_begin():
    """However their offsets were computed: beside exact fractions."""
    for count, feet in itertools.product((5, 24, 40, 45, 60), (2, 3, 4, 5, 6)):
        given = [np.linspace(0, 1, feet, endpoint=False), np.arange(feet) / feet]
        given += [np.arange(feet) * (1 / feet), np.cumsum(np.full(feet, 1 / feet)) - 1 / feet]
        for starts, step in itertools.product(given, (1, -1)):
            found = _phases(count, starts[::step])
            for (k, i), phase in np.ndenumerate(found):
                start = Fraction(range(feet)[::step][i], feet)
                assert abs(Fraction(phase) - (Fraction(k, count) - start) % 1) < 2e-9


def test_a_step_under_two_feet_is_refused(robot):
    """References have each foot step on ground as high as where it began."""
    home, data = robot.home[: robot.mujoco.nq].copy(), mujoco.MjData(robot.mujoco)
    home[3:5] = np.cos(0.03), np.sin(0.03)  # the left side of the trunk is higher
    data.qpos[:] = home
    mujoco.mj_kinematics(robot.mujoco, data)
    left, right = (data.geom(foot).xpos[2] for foot in ("FL", "FR"))
    assert left > right + 0.01
    home[2] += 0.022 - right
    half = (left - right) / 2
    step = f'<geom type="box" size=".4 .2 {half}" pos="0 .25 {half}" conaffinity="1"/><body'
    model = mujoco.MjModel.from_xml_string(QUADRUPED.read_text().replace("<body", step, 1))
    stepped = jm.load_robot(model, home=home)
    with pytest.raises(ValueError, match=r"stands at the heights .* on flat ground"):
        jm.robots.gait(stepped, FEET)


def test_grounds_that_are_not_level_are_refused():
    """The trunk moves along x and y, and feet rise along z."""
    text = QUADRUPED.read_text()
    text = text.replace("<option ", '<option gravity="0 -9.81 0" ')
    text = text.replace(
        'type="plane"', 'type="plane" quat=".7071067811865476 -.7071067811865476 0 0"'
    )
    text = text.replace(
        'qpos="0 0 .283 1 0 0 0', 'qpos="0 .283 0 .7071067811865476 -.7071067811865476 0 0'
    )
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(text))
    with pytest.raises(ValueError, match=r"normal \[0.0, 1.0, 0.0\]. Turn the world"):
        jm.robots.gait(robot, FEET)


@pytest.mark.parametrize("force", ['gravity="1 0 -9.76"', 'wind="0 2 0"'])
def test_what_pushes_aside_repeats_itself_for_no_heading(force):
    """A motion that turns is not the same again when its heading is another."""
    text = QUADRUPED.read_text().replace('integrator="implicitfast"', f'integrator="Euler" {force}')
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(text))
    name = force.partition("=")[0]
    with pytest.raises(ValueError, match=f"turn: is 0.8 rad/s, and the file's {name} acts along"):
        jm.robots.gait(robot, FEET, (0.3, 0.0), turn=0.8)


def test_limits_of_the_caller_are_those_of_joints():
    joints = jm.load_robot(QUADRUPED).home[7:19]
    free = np.full(6, np.inf)
    limits = np.append(-free, joints - 0.05), np.append(free, joints + 0.05)
    robot = jm.load_robot(QUADRUPED, control_period=0.01, position=limits)
    with pytest.raises(ValueError, match="velocity: joint .* would pass its limits"):
        jm.robots.gait(robot, FEET)


def test_motions_keep_the_velocity_limits():
    robot = jm.load_robot(QUADRUPED, control_period=0.01, velocity=1.0)
    with pytest.raises(ValueError, match=r"velocity: .* velocity would be \d.*, its limits are"):
        jm.robots.gait(robot, FEET, (0.5, 0.0))


@pytest.mark.slow
def test_servos_keep_their_force_limits():
    """`forcerange` is a row of the plans; at the first stage the input is within it."""
    servo = r'<position name="\1" joint="\1" kp="200" kv="1" ctrlrange="-4 4" forcerange="-30 30"/>'
    text = re.sub(r'<motor name="(\w+)"[^>]*>', servo, QUADRUPED.read_text())
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(text), control_period=0.01)
    motion = jm.robots.gait(robot, FEET)
    Q = np.repeat([100.0, 200, 400, 200, 100, 20, 1, 0.5, 0.02], [1, 1, 1, 2, 1, 12, 3, 3, 12])
    controller = GaitController(motion, Q, np.ones(12), horizon=8)
    x = np.array(motion.robot.state(motion.states[0]))
    x[robot.mujoco.nq + 1] += 0.6  # pushed
    control = jax.jit(lambda c, x, b: c(x, b))(controller, x, controller.start(x))
    q, v = x[7:19], x[robot.mujoco.nq + 6 :]
    force = 200 * (np.asarray(control.u) - q) - v
    rows = [name for soft in controller.problem(0).soft for name in soft.names]
    assert sum(name.startswith("force of actuator") for name in rows) == 12
    assert control.plan.solved and np.abs(force).max() <= 30 + 1e-6 + control.plan.slack[0].max()


def test_fixed_bases_have_no_gait():
    with pytest.raises(ValueError, match="feet|robot"):
        jm.robots.gait(jm.load_robot("arm2"), ("foot",))


@pytest.mark.slow
def test_inputs_may_act_a_sample_later(robot, gait):
    """The model of the feet that stand then predicts the state, and plans begin a phase later: the
    delay costs nothing, and `stage_cost` is measured from the motion."""
    Q = np.repeat([100.0, 200, 400, 200, 100, 20, 1, 0.5, 0.02], [1, 1, 1, 2, 1, 12, 3, 3, 12])
    controller = GaitController(gait, Q, np.full(12, 1e-3), horizon=10)
    x, _ = gait.robot.equilibrium()
    runs = [jm.simulate(controller, robot, x, steps=60, delay=delay) for delay in (0, 1)]
    for run in runs:
        assert np.all(run.status == jm.Status.SOLVED)
        xi = np.array([robot.coordinates(one) for one in np.asarray(run.states[:-1])])
        away, effort = xi - gait.reference(60), run.inputs - gait.inputs
        cost = (away**2 * Q).sum(axis=1) + 1e-3 * (effort**2).sum(axis=1)
        np.testing.assert_allclose(run.stage_cost, cost, rtol=1e-3, atol=1e-3)
    assert np.mean(runs[1].stage_cost) < 1.2 * np.mean(runs[0].stage_cost)


@pytest.mark.slow
def test_observers_know_which_feet_stand(gait):
    """A filter predicts by the feet of the control period, as the gait's own linear model does."""
    observer = KalmanFilter(gait.robot, 1e-3, 1e-3, C=np.eye(36), initial=1e-2).prepared()
    xi, u = gait.states[5], gait.inputs
    numbers = {STANDING: gait.standing[5]}
    assert 0 < gait.standing[5].sum() < 4
    with jax.enable_x64(True):
        belief = observer.first(xi)
        told, all_feet = (
            np.asarray(observer.predicted(belief, u, None, given).mean) for given in (numbers, {})
        )
        A, B, c = (np.asarray(v)[5] for v in (gait.system.A, gait.system.B, gait.system.c))
        # (The model's coordinates go on with the trunk.)
        after = np.asarray(gait.in_the_world(jnp.asarray(A @ xi + B @ u + c), 1))
    np.testing.assert_allclose(told, after, atol=1e-5)
    assert np.abs(all_feet - told).max() > 0.1


@pytest.mark.slow
def test_feet_that_stand_stay_where_they_are(robot, gait):
    """And the others rise, to the lift; two stand at a time, or all."""
    model, dt, P = robot.mujoco, robot.dt, gait.period
    with jax.enable_x64(True):
        x = np.array([robot.state(xi) for xi in np.asarray(gait.reference(2 * P))])
    feet = np.array([places(model, row[: model.nq]) for row in x])
    standing = np.tile(gait.standing, (2, 1))
    assert set(gait.standing.sum(axis=1)) == {2, 4}
    assert np.all(gait.standing[:, [0, 1]] == gait.standing[:, [3, 2]])  # diagonal ones together
    stay = standing[:-1] & standing[1:]
    moved = np.abs(np.diff(feet, axis=0))[stay]
    assert moved.max() < 1e-8
    ground = feet[standing][:, 2].mean()
    np.testing.assert_allclose(feet[standing][:, 2], ground, atol=1e-8)
    np.testing.assert_allclose(feet[:, :, 2].max(axis=0) - ground, 0.06, atol=2e-3)
    np.testing.assert_allclose(x[P:, 0] - x[:P, 0], SPEED * dt * P, rtol=1e-12)
    # Velocities are those of the positions, to the second order of the control period.
    for now, after in zip(x[:-1], x[1:], strict=True):
        difference = np.zeros(model.nv)
        mujoco.mj_differentiatePos(model, difference, dt, now[: model.nq], after[: model.nq])
        mean = (now[model.nq :] + after[model.nq :]) / 2
        assert np.abs(difference - mean).max() < 0.7


@pytest.mark.slow
def test_linear_models_are_those_of_the_feet_that_stand(robot, gait):
    """Of two feet, by a robot that has no others."""
    phase = int(np.flatnonzero(gait.standing.sum(axis=1) == 2)[3])
    feet = [name for name, stands in zip(FEET, gait.standing[phase], strict=True) if stands]
    two = robot.standing(feet)
    with jax.enable_x64(True):
        x = robot.state(gait.states[phase])
        expected = two.linearize(x, gait.inputs, exact=True)
        forces = np.asarray(two.predictor.contact_forces(x, gait.inputs))
    A, B, c = (np.asarray(getattr(gait.system, name)[phase]) for name in ("A", "B", "c"))
    np.testing.assert_allclose(A, expected.A, atol=1e-9)
    np.testing.assert_allclose(B, expected.B, atol=1e-9)
    way = np.eye(robot.n)[0] * SPEED * robot.dt  # coordinates are relative to the trunk's path
    np.testing.assert_allclose(c, np.asarray(expected.c) - way, atol=1e-9)
    C, D, upper = (np.asarray(v[phase]) for v in gait.cones)
    rows = np.repeat(gait.standing[phase], 5)
    assert np.all(np.isinf(upper[~rows])) and not C[~rows].any() and not D[~rows].any()
    violation = (C @ gait.states[phase] + D @ gait.inputs - upper)[rows]
    np.testing.assert_allclose(violation, two.predictor.feet.cones() @ forces, atol=1e-8)


@pytest.mark.slow
def test_a_quadruped_trots_in_mujoco(robot, gait):
    """One second with the C engine as plant: at its speed, upright, all plans solved; and the same
    run by `simulate` in MJX."""
    Q = np.repeat([100.0, 200, 400, 200, 100, 20, 1, 0.5, 0.02], [1, 1, 1, 2, 1, 12, 3, 3, 12])
    steps = 120
    with jax.enable_x64(True):
        controller = GaitController(gait, Q, np.full(12, 1e-3), horizon=30)
        model, data = robot.mujoco, mujoco.MjData(robot.mujoco)
        x0, _ = gait.robot.equilibrium()
        data.qpos[:] = x0[: model.nq]
        plan, before, states = jax.jit(lambda c, x, b: c(x, b)), controller.start(x0), [x0]
        for _ in range(steps):
            before = plan(controller, states[-1], before)
            assert before.plan.status == jm.Status.SOLVED
            data.ctrl = np.asarray(before.u)
            for _ in range(robot.substeps):
                mujoco.mj_step(model, data)
            states.append(np.concatenate([data.qpos, data.qvel]))
        run = jm.simulate(controller, robot, x0, steps)
    states = np.array(states)
    assert abs((states[-1, 0] - states[-45, 0]) / 0.44 - SPEED) < 0.05
    assert np.ptp(states[:, 2]) < 0.01 and np.abs(states[:, 4:6]).max() < 0.02
    assert np.abs(states[:, 1]).max() < 0.02
    np.testing.assert_allclose(run.states, states, atol=1e-6)


def turned(x, nq, angle, shift=(0.0, 0.0)):
    """The state of a robot with a free base turned about z through the origin, then shifted."""
    turn = Rotation.from_euler("z", angle)
    place, speed = (turn.apply(part) for part in (x[:3], x[nq : nq + 3]))
    w, *v = x[3:7]
    *v, w = (turn * Rotation.from_quat([*v, w])).as_quat()
    return np.concatenate([place + [*shift, 0], [w, *v], x[7:nq], speed, x[nq + 3 :]])


@pytest.mark.parametrize(("velocity", "turn"), [((0.4, -0.2), 0.7), ((0.5, 0.1), 0.0)])
def test_paths_are_those_of_the_velocity(velocity, turn):
    """By small steps along it; moved back, a place is where it was."""
    path, home = TrunkPath(np.array(velocity), np.array(turn), np.array([0.3, -0.1])), [0.3, -0.1]
    p, count, seconds = np.array(home), 20_000, 3.0
    for k in range(count):
        angle = turn * (k + 0.5) * seconds / count
        p = p + seconds / count * Rotation.from_euler("z", angle).apply([*velocity, 0])[:2]
    with jax.enable_x64(True):
        np.testing.assert_allclose(path.places(np.array(home), jnp.asarray(seconds)), p, atol=1e-8)
        other = np.array([[0.5, 0.2], [-1.0, 2.0]])
        there = path.places(other, jnp.asarray(seconds))
        arm = Rotation.from_euler("z", turn * seconds).apply([0.2, 0.3, 0])[:2]
        np.testing.assert_allclose(there[0], p + arm, atol=1e-8)
        np.testing.assert_allclose(path.places(there, jnp.asarray(-seconds)), other, atol=1e-12)


@pytest.mark.parametrize("turn", [0.0, 1.5])
def test_feet_under_the_trunk_stand_still_in_the_world(turn):
    """Where they step to is where they stand next."""
    path = TrunkPath(np.array([0.5, 0.1]), np.array(turn), np.zeros(2))
    count, dt, duty = 40, 0.01, 0.6
    starts = np.array([0.0, 0.5])
    phases = (np.arange(3 * count)[:, None] / count - starts) % 1.0
    standing = phases < duty - 1e-9
    seen = _paths(path, np.array([[0.2, 0.1], [-0.2, -0.1]]), phases, duty, count * dt * duty)
    with jax.enable_x64(True):
        world = np.array([path.places(p, jnp.asarray(k * dt)) for k, p in enumerate(seen)])
    moved = np.abs(np.diff(world, axis=0)).max(axis=2)
    assert moved[standing[1:] & standing[:-1]].max() < 1e-12
    assert moved[~standing[1:] & ~standing[:-1]].max() > 0.01


def test_turning_trunks_have_no_limits_in_the_world():
    robot = jm.load_robot(QUADRUPED, control_period=0.01)
    limits = np.full((2, robot.n), [[-np.inf], [np.inf]])
    limits[:, 18] = -1.0, 1.0
    limited = np.isfinite(limits).any(axis=0)
    gait = SimpleNamespace(robot=robot, path=TrunkPath(np.zeros(2), np.array(0.5), np.zeros(2)))
    with pytest.raises(ValueError, match=r"gait: turns, and quadruped has limits of .*velocity"):
        _require_free_trunk(gait, limited)
    _require_free_trunk(SimpleNamespace(robot=robot, path=gait.path._replace(turn=0.0)), limited)


@pytest.fixture(scope="module")
def turning(robot):
    """A trot along a circle."""
    return jm.robots.gait(robot, FEET, (0.4, 0.1), turn=0.8)


@pytest.mark.slow
def test_a_turning_motion_is_one_of_the_robot(robot, turning):
    """Feet that stand stay; positions change by the velocities; the trunk's heading passes π."""
    model, dt, count = robot.mujoco, robot.dt, 500
    with jax.enable_x64(True):
        x = np.array([robot.state(xi) for xi in turning.reference(count)])
    feet = np.array([places(model, row[: model.nq]) for row in x])
    standing = turning.standing[np.arange(count) % turning.period]
    stay = standing[:-1] & standing[1:]
    assert np.abs(np.diff(feet, axis=0))[stay].max() < 1e-8
    heading = np.unwrap(2 * np.arctan2(x[:, 6], x[:, 3]))
    np.testing.assert_allclose(heading, 0.8 * dt * np.arange(count), atol=1e-9)
    assert heading[-1] > np.pi
    found = np.zeros(model.nv)
    for k in (3, 200, 450):  # of the trunk; joints stop and start
        now, after = x[k], x[k + 1]
        mujoco.mj_differentiatePos(model, found, dt, now[: model.nq], after[: model.nq])
        mean = (now[model.nq :] + after[model.nq :]) / 2
        np.testing.assert_allclose(found[:6], mean[:6], atol=1e-5)


@pytest.mark.slow
def test_models_of_a_turning_gait_by_differences(robot, turning):
    """From the coordinates of one control period to those of the next."""
    k, nq, rng = 7, robot.mujoco.nq, np.random.default_rng(0)
    path, home = turning.path, np.append(turning.path.home, 0)
    with jax.enable_x64(True):
        shift = np.asarray(path.places(path.home, jnp.asarray(robot.dt))) - path.home
        model = RobotModel(turning.robot, {STANDING: turning.standing[k].astype(float)})

        def after(xi, u):
            x = np.array(robot.state(model.step(xi, u)))
            x[:3] -= home + [*shift, 0]  # the trunk's path begins at home
            x = turned(x, nq, -path.turn * robot.dt)
            x[:3] += home
            return np.asarray(robot.coordinates(x))

        xi, u, h = np.asarray(turning.states[k]), np.asarray(turning.inputs), 1e-6
        A, B, c = (np.asarray(v)[k] for v in (turning.system.A, turning.system.B, turning.system.c))
        np.testing.assert_allclose(A @ xi + B @ u + c, after(xi, u), atol=1e-12)
        for _ in range(3):
            d, e = rng.normal(size=robot.n), rng.normal(size=robot.m)
            found = (after(xi + h * d, u + h * e) - after(xi - h * d, u - h * e)) / (2 * h)
            np.testing.assert_allclose(A @ d + B @ e, found, atol=2e-6 * np.abs(found).max())


@pytest.mark.slow
def test_a_quadruped_trots_along_a_circle(robot, turning):
    """In MuJoCo's C engine, and plans know no heading: those of the whole world turned and moved
    with the path are the same, a period later."""
    Q = np.repeat([100.0, 200, 400, 200, 100, 20, 1, 0.5, 0.02], [1, 1, 1, 2, 1, 12, 3, 3, 12])
    nq, P, steps = robot.mujoco.nq, turning.period, 150
    with jax.enable_x64(True):
        controller = GaitController(turning, Q, np.full(12, 1e-3), horizon=30)
        plan = jax.jit(lambda c, x, b: c(x, b))
        x0, _ = turning.robot.equilibrium()
        data = mujoco.MjData(robot.mujoco)
        data.qpos[:] = x0[:nq]
        before, states, costs = controller.start(x0), [x0], []
        for k in range(steps):
            before = plan(controller, states[-1], before)
            assert before.plan.status == jm.Status.SOLVED
            data.ctrl = np.asarray(before.u)
            costs.append(controller.distance(states[-1], turning.reference(1, k)[0], k))
            for _ in range(robot.substeps):
                mujoco.mj_step(robot.mujoco, data)
            states.append(np.concatenate([data.qpos, data.qvel]))
        states = np.array(states)
        heading = np.unwrap(2 * np.arctan2(states[:, 6], states[:, 3]))
        assert abs((heading[-1] - heading[-45]) / 0.44 - 0.8) < 0.05
        away = np.abs(states[-1, :2] - turning.reference(steps + 1)[-1, :2])
        assert away.max() < 0.03 and np.abs(np.array(costs)[100:, :3]).max() < 0.03
        # Ten periods later the heading has passed half a turn.
        x = np.asarray(turning.robot.state(turning.states[5])) + np.r_[0.01, np.zeros(36)]
        one = plan(controller, x, controller.begun(controller.start(x), 5))
        later = 5 + 10 * P
        seconds = 10 * P * robot.dt
        moved = turning.path.state(jnp.asarray(x), nq, jnp.asarray(seconds))
        other = plan(controller, moved, controller.begun(controller.start(x), later))
        np.testing.assert_allclose(other.plan.inputs, one.plan.inputs, atol=1e-6)
        end = turning.path.state(robot.state(one.plan.states[-1]), nq, jnp.asarray(seconds))
        np.testing.assert_allclose(other.plan.states[-1], robot.coordinates(end), atol=1e-8)


@pytest.mark.slow
def test_limits_of_the_place_are_those_of_the_world(robot, gait):
    """A straight path, whose coordinates are relative to where it has come."""
    lower, upper = (np.array(side) for side in gait.robot.state_limits.bounds())
    upper[0] = 0.1
    motion = replace(gait, robot=replace(gait.robot, state_limits=jm.Box(lower, upper)))
    Q = np.repeat([100.0, 200, 400, 200, 100, 20, 1, 0.5, 0.02], [1, 1, 1, 2, 1, 12, 3, 3, 12])
    with jax.enable_x64(True):
        controller = GaitController(motion, Q, np.full(12, 1e-3), horizon=8, rho=1e6, margin=0.0)
        x = np.array(motion.robot.state(motion.reference(1, 19)[0]))  # 9.5 cm on
        control = jax.jit(lambda c, x, b: c(x, b))(
            controller, x, controller.begun(controller.start(x), 19)
        )
        names = [name for rows in controller.problem(19).soft for name in rows.names]
    assert control.plan.solved
    assert motion.reference(9, 19)[-1, 0] > 0.13
    excess = np.asarray(control.plan.states)[1:, 0] - 0.1
    slack = np.asarray(control.plan.slack)[1:, names.index(robot.state_names[0])]
    np.testing.assert_allclose(np.maximum(excess, 0), slack, atol=1e-6)
    assert excess.max() < 0.02


@pytest.mark.slow
def test_references_are_constants_of_programs(turning):
    """At a step that is known, inside `jit` too; times of any type of whole numbers."""
    with jax.enable_x64(True):
        expected = turning.reference(3, 70)
        found = jax.jit(lambda: jnp.asarray(turning.reference(3, 70)))()
        np.testing.assert_allclose(found, expected, atol=1e-12)
        x = turning.robot.state(expected[0])
        for time in (70, np.uint8(70), jnp.uint32(70)):
            relative = turning.relative(x, time)
            np.testing.assert_allclose(relative, turning.states[70 % turning.period], atol=1e-9)
