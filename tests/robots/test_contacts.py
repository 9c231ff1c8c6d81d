"""Feet that stand: the model of the plan against balances written down with MuJoCo's C engine,
statics against a linear program, and what is refused."""

import copy
import importlib.util
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import mujoco
import numpy as np
import pytest
from scipy.optimize import linprog

import jaxmpc as jm
from jaxmpc.robots.contacts import friction_cones
from jaxmpc.robots.description import host_coordinates

QUADRUPED = Path(__file__).parents[2] / "experiments" / "robots" / "quadruped.xml"
FEET = ("FL", "FR", "RL", "RR")

# A trunk on one leg, whose foot is below its centre of mass.
HOPPER = """<mujoco><option timestep=".002" integrator="implicitfast"/><default>
<geom contype="0" conaffinity="0"/><joint armature=".01" damping=".2"/></default><worldbody>
<geom name="floor" type="plane" size="1 1 .1" conaffinity="1" friction=".7 .1 .1"/>
<body pos="0 0 {height}"><freejoint name="base"/>
<geom name="trunk" type="box" size=".1 .08 .05" mass="5" pos="{shift} 0 0"/>
<body name="hip"><joint name="abduction" axis="1 0 0"/><geom type="sphere" size=".03" mass=".3"/>
<body><joint name="hip" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".5"/>
<body pos="0 0 -.3"><joint name="knee" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".015" mass=".2"/>
<geom name="foot" type="sphere" size=".03" pos="0 0 -.3" mass=".05" contype="1"/>
</body></body></body></body></worldbody><actuator><motor joint="abduction" ctrlrange="-30 30"/>
<motor joint="hip" ctrlrange="-30 30"/><motor joint="knee" ctrlrange="-30 30"/></actuator>
<keyframe><key qpos="0 0 {height} 1 0 0 0 0 {bend} {back}"/></keyframe></mujoco>"""
BEND = 0.6


def hopper():
    """The hopper at home, its foot below the centre of mass and 0.1 mm in the ground."""
    height, shift = 0.6 * np.cos(BEND) + 0.0299, 0.7 * 0.15 * np.sin(BEND) / 5
    text = HOPPER.format(height=height, shift=shift, bend=BEND, back=-2 * BEND)
    return jm.load_robot(mujoco.MjModel.from_xml_string(text))


@pytest.fixture(scope="module")
def quadruped():
    """The quadruped, of which nothing stands yet."""
    return jm.load_robot(QUADRUPED)


@pytest.fixture(scope="module")
def standing():
    """The hopper on its foot."""
    return hopper().standing(["foot"], friction=0.5)


@pytest.mark.slow
def test_contact_forces_of_numbers_that_vary(standing):
    """Compensated gravity, which the file leaves out, takes the load off the foot."""
    x, u = standing.equilibrium()
    with jax.enable_x64(True):
        forces = lambda share, u: standing.predictor.contact_forces(
            x, u, {"body_gravcomp": np.full(standing.mujoco.nbody, share)}
        )
        weight = 9.81 * standing.mujoco.body_mass.sum()
        np.testing.assert_allclose(forces(0.0, u)[0], weight, rtol=1e-6)
        np.testing.assert_allclose(forces(1.0, 0 * u), 0, atol=1e-9)
        with pytest.raises(ValueError, match="body_masss: is no number that varies"):
            standing.predictor.contact_forces(x, u, {"body_masss": np.ones(3)})


def balance(robot, x, u, directions=None):
    """Accelerations and contact forces of feet at rest by M a = τ + J'λ, J a + J̇ v = −β J v.

    All of it from MuJoCo's C engine; J̇ by differences, damping implicit as in its integrator.
    """
    model = robot.predictor.model
    directions = robot.predictor.feet.frames[0] if directions is None else directions
    data, h = mujoco.MjData(model), model.opt.timestep
    q, v = x[: model.nq], x[model.nq :]

    def jacobian(q):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        rows = np.zeros((3, model.nv))
        point = data.geom("foot").xpos - [0, 0, 0.03]
        mujoco.mj_jac(model, data, rows, None, point, model.geom("foot").bodyid[0])
        return directions @ rows

    moved = []
    for sign in (1, -1):
        place = q.copy()
        mujoco.mj_integratePos(model, place, v, sign * 1e-5)
        moved.append(jacobian(place))
    drift = (moved[0] - moved[1]) @ v / 2e-5
    J = jacobian(q)
    data.qvel[:], data.ctrl[:] = v, u
    mujoco.mj_forward(model, data)
    M = np.zeros((model.nv, model.nv))
    for i, unit in enumerate(np.eye(model.nv)):
        mujoco.mj_mulM(model, data, M[i], unit)
    M += h * np.diag(model.dof_damping)
    force = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator
    rate = 2 / (0.95 * 0.02)  # of MuJoCo's default contact: solref 0.02, solimp up to 0.95
    K = np.block([[M, -J.T], [J, np.zeros((len(J), len(J)))]])
    return np.split(np.linalg.solve(K, np.append(force, -drift - rate * (J @ v))), [model.nv])


def period(robot, x, u):
    """The state one control period later, by `balance` and semi-implicit Euler."""
    model = robot.predictor.model
    q, v = np.split(x.copy(), [model.nq])
    for _ in range(robot.substeps):
        v = v + model.opt.timestep * balance(robot, np.append(q, v), u)[0]
        mujoco.mj_integratePos(model, q, v, model.opt.timestep)
    return np.append(q, v)


@pytest.mark.slow
def test_rest_on_a_foot(standing):
    """The foot carries the weight, and the linear model rests there."""
    x, u = standing.equilibrium()
    weight = 9.81 * standing.mujoco.body_mass.sum()
    a, forces = balance(standing, x, u)
    np.testing.assert_allclose(forces, [weight, 0, 0], atol=1e-8)
    np.testing.assert_allclose(a, 0, atol=1e-8)
    with jax.enable_x64(True):
        found = jax.jit(standing.predictor.contact_forces)(x, u)
        after = standing.linearize(x, u, exact=True).step(host_coordinates(standing, x), u)
    np.testing.assert_allclose(found, forces, atol=1e-9)
    np.testing.assert_allclose(after, host_coordinates(standing, x), atol=1e-12)


def rescaled(model, length, mass):
    """The same robot with its feet in other units of length and mass."""
    model, torque = copy.deepcopy(model), mass * length**2
    for name in ("body_pos", "body_ipos", "geom_pos", "geom_size", "jnt_pos", "site_pos"):
        getattr(model, name)[:] *= length
    for name in ("dof_armature", "dof_damping", "actuator_ctrlrange", "body_inertia"):
        getattr(model, name)[:] *= torque
    for q in (model.qpos0, *model.key_qpos):
        q[:3] *= length
    model.opt.gravity[:] *= length
    model.body_mass[:] *= mass
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def test_units_do_not_decide_how_feet_share_the_weight(quadruped):
    feet = [quadruped.mujoco.geom(i).name for i in np.flatnonzero(quadruped.mujoco.geom_contype)]
    assert len(feet) == 4
    _, expected = quadruped.standing(feet, friction=0.5).equilibrium()
    for length, mass in ((64.0, 1.0), (1 / 32, 1024.0), (8.0, 1 / 4096)):
        robot = jm.load_robot(rescaled(quadruped.mujoco, length, mass))
        _, u = robot.standing(feet, friction=0.5).equilibrium()
        np.testing.assert_allclose(u / (mass * length**2), expected, atol=1e-8)


@pytest.mark.slow
def test_linear_model_against_the_c_engine(standing):
    """A and B of a period are the slopes of the balance of forces, cones of its forces."""
    x, u = standing.equilibrium()
    xi, step = host_coordinates(standing, x), 1e-5
    with jax.enable_x64(True):
        model = standing.linearize(x, u, exact=True)
        state = jax.jit(standing.state)
        moved = lambda d: np.asarray(state(xi + d[: len(xi)]))
        slopes, of_forces = [], []
        for d in step * np.eye(standing.n + standing.m):
            ends = [(moved(s * d), u + s * d[len(xi) :]) for s in (1, -1)]
            after, before = (host_coordinates(standing, period(standing, *end)) for end in ends)
            slopes.append((after - before) / (2 * step))
            pushed, pulled = (balance(standing, *end)[1] for end in ends)
            of_forces.append((pushed - pulled) / (2 * step))
    wanted = np.array(slopes).T
    np.testing.assert_allclose(model.A, wanted[:, : len(xi)], atol=1e-6)
    np.testing.assert_allclose(model.B, wanted[:, len(xi) :], atol=1e-6)
    cones, by = friction_cones(standing, x, u), np.array(of_forces).T
    faces = np.array([*([-0.5, a, b] for a in (1, -1) for b in (1, -1)), [-1, 0, 0]])
    np.testing.assert_allclose(cones.C, faces @ by[:, : len(xi)], atol=1e-3)
    np.testing.assert_allclose(cones.D, faces @ by[:, len(xi) :], atol=1e-5)
    slack = cones.upper - cones.C @ xi - cones.D @ u
    weight = 9.81 * standing.mujoco.body_mass.sum()
    np.testing.assert_allclose(slack, weight * np.array([0.5, 0.5, 0.5, 0.5, 1]), rtol=1e-9)


def test_problems_of_robots_with_orientations_take_traced_weights(standing):
    """As in a loss of the weights: the robot is known."""
    wanted, weights = jm.robot_mpc(standing, horizon=3), []
    jax.make_jaxpr(lambda R: (weights.append(jm.robot_mpc(standing, R=R, horizon=3)), R)[1])(
        np.asarray(wanted.R, np.float32)
    )
    np.testing.assert_array_equal(weights[0].states.upper, wanted.states.upper)
    np.testing.assert_array_equal(weights[0].outputs[0].C, wanted.outputs[0].C)


def test_statics_of_four_feet(quadruped):
    """Torques of rest need what a linear program finds: normal forces alone, of the weight."""
    robot = quadruped.standing(FEET)
    feet, model = robot.predictor.feet, robot.predictor.model
    np.testing.assert_allclose(feet.friction, 0.8)  # 80 % of the file's 1
    np.testing.assert_allclose(feet.frames[:, 0], [[0, 0, 1]] * 4, atol=1e-12)
    x, u = robot.equilibrium()
    data = mujoco.MjData(model)
    data.qpos[:] = x[: model.nq]
    mujoco.mj_forward(model, data)
    J = feet.jacobian(model, data)
    actuation = np.zeros((model.nv, model.nu))
    actuation[6:] = np.eye(model.nu)
    left = data.qfrc_bias - actuation @ u  # what contacts have to give
    normal, sideways = J[::3].T, np.concatenate([J[1::3], J[2::3]]).T
    parts = np.hstack([normal, sideways, -sideways])
    cost = np.repeat([0.0, 1.0], [4, 16])
    found = linprog(cost, A_eq=parts, b_eq=left, bounds=(0, None))
    assert found.status == 0 and found.x[4:].sum() < 0.1  # N: hardly any friction is needed
    np.testing.assert_allclose(found.x[:4].sum(), 9.81 * model.body_mass.sum(), rtol=1e-9)


def test_weak_motors_hold_no_robot(quadruped):
    """With motors of 1 N m neither a linear program finds forces of rest, nor the library."""
    robot = quadruped.standing(FEET)
    weak = replace(robot, input_limits=jm.Box(np.full(12, -1.0), np.ones(12)))
    model, data = robot.predictor.model, mujoco.MjData(robot.predictor.model)
    data.qpos[:] = robot.home[: model.nq]
    mujoco.mj_forward(model, data)
    J = robot.predictor.feet.jacobian(model, data)
    sideways = np.concatenate([J[1::3], J[2::3]]).T
    parts = np.hstack([J[::3].T, sideways, -sideways, np.eye(model.nv, model.nu, -6)])
    bounds = [(0, None)] * 20 + [(-1, 1)] * model.nu
    found = linprog(np.zeros(32), A_eq=parts, b_eq=data.qfrc_bias, bounds=bounds)
    assert found.status == 2
    with pytest.raises(ValueError, match="no input balances the forces.*feet with more friction"):
        weak.equilibrium()
    with pytest.raises(ValueError, match="near: is given for a robot that stands"):
        weak.equilibrium(near=robot.home[: model.nq])
    with pytest.raises(ValueError, match="cannot stand at home"):
        weak.set_point()


def test_friction_is_that_of_the_contact():
    """None of condim 1, of a pair with two tangents the smaller; touching is relative to a foot."""
    text = QUADRUPED.read_text()
    without = text.replace('condim="3"', "").replace("<geom contype", '<geom condim="1" contype')
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(without))
    with pytest.raises(ValueError, match="FL touches the ground without friction .condim 1."):
        robot.standing(FEET)
    np.testing.assert_array_equal(robot.standing(FEET, friction=0).predictor.feet.friction, 0)
    pairs = "".join(
        f'<pair geom1="floor" geom2="{foot}" condim="3" friction="1 .1 .02 .01 .01"/>'
        for foot in FEET
    )
    text = text.replace("<actuator>", f"<contact>{pairs}</contact><actuator>", 1)
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(text))
    np.testing.assert_allclose(robot.standing(FEET).predictor.feet.friction, 0.08)


def test_what_cannot_stand_is_named(quadruped):
    """Geoms that are no feet, feet in the air, models that are not stepped."""
    for feet, message in (
        (["toe"], "feet: no geom is named 'toe'. Name one of the geoms: floor, FL, FR, RL, RR"),
        (["floor"], "feet: geom floor is no sphere"),
        (["FL", "FL"], "has a name twice"),
        ("FL", "Give the names of geoms"),
        ([], "Give the names of geoms"),
    ):
        with pytest.raises(ValueError, match=message):
            quadruped.standing(feet)
    with pytest.raises(ValueError, match="friction: -1"):
        quadruped.standing(FEET, friction=-1)
    for raised, message in (
        (0.02, "FL is 0.9.* of its radius from the ground at home"),
        (0.5, "FL is far"),
    ):
        home = quadruped.home + raised * np.eye(quadruped.state_size)[2]
        with pytest.raises(ValueError, match=message):
            replace(quadruped, home=home).standing(FEET)
    blind = copy.deepcopy(quadruped.mujoco)
    blind.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    with pytest.raises(ValueError, match="robot: has no contacts, .* contacts=True"):
        replace(quadruped, plant=SimpleNamespace(model=blind)).standing(FEET)
    model = copy.deepcopy(quadruped.predictor.model)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    with pytest.raises(ValueError, match="RK4"):
        replace(quadruped, predictor=SimpleNamespace(model=model)).standing(FEET)
    robot = quadruped.standing(FEET)
    assert "feet that stand in linear models: FL, FR, RL, RR" in str(robot.report())


def test_feet_rest_on_the_ground_alone(quadruped, standing):
    """In the air and inside the ground forces of contact balance the weight as well."""
    home, up = standing.home[: standing.mujoco.nq], np.eye(standing.mujoco.nq)[2]
    for raised, where in (
        (0.5, "far from"),
        (0.02, "0.66.* of its radius above"),
        (-0.02, "0.66.* of its radius inside"),
    ):
        with pytest.raises(ValueError, match=rf"(?s)q: .*: foot is {where} the ground"):
            standing.equilibrium(home + raised * up)
    x, _ = standing.equilibrium(home + 1e-4 * up)
    np.testing.assert_allclose(x[2], home[2] + 1e-4)
    turned = quadruped.standing(FEET).home[: quadruped.mujoco.nq].copy()
    turned[7] += 0.5  # one leg in the air
    with pytest.raises(ValueError, match="(?s)target: .*: FL is .* the ground"):
        jm.robot_mpc(quadruped.standing(FEET), horizon=3, target=turned)


def in_plane(joints, direction):
    """The file of the hopper whose trunk moves by these joints, its leg about this direction."""
    height = 0.6 * np.cos(BEND) + 0.0299
    text = HOPPER.format(height=height, shift=0, bend=BEND, back=-2 * BEND)
    text = text.replace('<freejoint name="base"/>', joints)
    text = text.replace('<joint name="abduction" axis="1 0 0"/>', "")
    text = text.replace('<motor joint="abduction" ctrlrange="-30 30"/>', "")
    for joint in ("hip", "knee"):
        text = text.replace(f'name="{joint}" axis="0 1 0"', f'name="{joint}" axis="{direction}"')
    count = joints.count("<joint")
    return re.sub('<key qpos="[^"]*"', f'<key qpos="{"0 " * count}{BEND} {-2 * BEND}"', text)


PLANE = """<joint name="x" type="slide" axis="{0}"/><joint name="z" type="slide" axis="0 0 1"/>
<joint name="turn" axis="{1}"/>"""


@pytest.mark.parametrize("forward", [(1.0, 0.0), (0.6, 0.8)])
def test_a_robot_in_a_plane_stands(forward):
    """Its balance is written down without the direction across."""
    x, y = forward
    text = in_plane(PLANE.format(f"{x} {y} 0", f"{-y} {x} 0"), f"{-y} {x} 0")
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(text)).standing(["foot"], friction=0.5)
    feet, model = robot.predictor.feet, robot.predictor.model
    np.testing.assert_allclose(np.abs(feet.frames[0] @ [-y, x, 0]), [0, 0, 1], atol=1e-12)
    at, v, u = robot.home[: model.nq], np.array([0.1, 0.0, 0.2, 0.3, -0.4]), np.array([1.0, 6.0])
    found = balance(robot, np.append(at, v), u, np.array([[0, 0, 1.0], [x, y, 0]]))[1]
    with jax.enable_x64(True):
        forces = np.asarray(robot.predictor.contact_forces(np.append(at, v), u))
    tangent = float(feet.frames[0, 1] @ [x, y, 0])
    np.testing.assert_allclose(forces, [found[0], tangent * found[1], 0], atol=1e-6)


def test_what_falls_without_feet_names_them(quadruped):
    """The quadruped in a plane, of which nobody said that it stands."""
    text = QUADRUPED.read_text()
    joints = PLANE.format("1 0 0", "0 1 0")
    assert "<freejoint" in text
    text = re.sub(r"<freejoint[^>]*>", joints, text)
    text = re.sub(r"<key [^>]*>", "", text)
    home = np.append([0.0, 0.0, 0.0], quadruped.home[7:19])
    spec = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(spec)
    data.qpos[:] = home
    mujoco.mj_forward(spec, data)
    home[1] = -min(data.geom(foot).xpos[2] - spec.geom(foot).size[0] for foot in FEET)
    with pytest.raises(ValueError, match=r"robot.standing\(\('FL', 'FR', 'RL', 'RR'\)\)"):
        jm.load_robot(spec, home=home).equilibrium()


def test_feet_that_nothing_moves_off_the_ground_are_named():
    """The hopper on a slide along x alone, with a stiff leg."""
    text = in_plane('<joint name="x" type="slide" axis="1 0 0"/>', "0 1 0")
    text = re.sub(r'<joint name="(hip|knee)"[^>]*>', "", text)
    text = re.sub(r"(?s)<actuator>.*</keyframe>", "", text)
    text = text.replace("</worldbody>", '</worldbody><actuator><motor joint="x"/></actuator>')
    height = f"{0.6 * np.cos(BEND) + 0.0299}"
    assert height in text
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(text.replace(height, "0.6299")))
    cure = "joints that move a foot in a plane at least"
    with pytest.raises(ValueError, match=rf"no joint moves foot along .*, where .*{cure}"):
        robot.standing(["foot"])


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_pushed_quadrupeds_stand():
    """Two quadrupeds, pushed by 60 % of what the pendulum bounds, stand on their friction cones."""
    spec = importlib.util.spec_from_file_location("standing", QUADRUPED.with_name("standing.py"))
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    with jax.enable_x64(True):
        robot = module.quadruped(0.01)
        x, u = robot.equilibrium()
        rest, directions = module.Rest(robot, x), np.array([[0.0, 1], [1, 0]])
        # The polygon of the feet: 0.19 m and 0.127 m from the centre of mass, but for its offset.
        reach = rest.survivable(directions)[:, None] / rest.survivable(-directions)[:, None]
        np.testing.assert_allclose(reach, 1, atol=0.15)
        added = module.pushes(
            robot, rest, 0.6 * rest.survivable(directions)[:, None] * directions, 80
        )
        goal = {"reference": robot.coordinates(x), "input_reference": u}
        law = module.standing_mpc(robot)
        with pytest.raises(ValueError, match="linearize: 'state' of a robot whose feet stand"):
            jm.RobotController(robot, law.mpc)
        run = jm.simulate_many(law, robot, np.tile(x, (2, 1)), 80, disturbances=added, **goal)
    assert np.all(run.status == jm.Status.SOLVED) and not run.fallback.any()
    assert module.stood(run.states).all()
    assert np.abs(run.states[:, :, :2]).max() > 0.02  # they were pushed indeed
    normal, share, error = module.of_feet(robot, run)
    assert error.max() < 1e-12
    late = slice(60, None)
    np.testing.assert_allclose(normal[:, late].sum(axis=2), 9.81 * rest.mass, rtol=0.1)
    assert share[:, late][normal[:, late] > 1].max() < 0.9


def test_feet_without_friction_push_and_do_not_pull():
    """At any friction the rows say so: λ_n ≥ 0 follows from |λ_1| + |λ_2| ≤ μ λ_n unless μ = 0."""
    for friction in (0.0, 1e-6, 0.5):
        feet = hopper().standing(["foot"], friction=friction).predictor.feet
        faces = feet.cones()
        assert len(faces) == len(feet.cone_names)
        assert np.max(faces @ [-40.0, 0, 0]) >= 40
        assert np.max(faces @ [40.0, 0, 0]) <= 0


@pytest.mark.parametrize("strength", [100, 1])
def test_a_rest_on_feet_keeps_the_force_limits_of_servos(strength):
    """Of 5 N m that the knees need. (MuJoCo's C engine says what the servos give.)"""
    servo = rf'<position name="\1" joint="\1" kp="100" forcerange="-{strength} {strength}"/>'
    text = re.sub(r'<motor name="(\w+)"[^>]*>', servo, QUADRUPED.read_text())
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(text)).standing(FEET)
    if strength == 1:
        with pytest.raises(ValueError, match="limits of actuators' forces .forcerange"):
            robot.equilibrium()
        return
    x, u = robot.equilibrium()
    data = mujoco.MjData(robot.mujoco)
    data.qpos[:], data.ctrl[:] = x[: robot.mujoco.nq], u
    mujoco.mj_forward(robot.mujoco, data)
    assert 1 < np.abs(data.actuator_force).max() < strength


def test_what_does_not_act_on_a_standing_robot_takes_no_rest_away():
    """Dry friction, and a shape that touches the ground without a load: in MuJoCo it stands."""
    text = QUADRUPED.read_text().replace("<joint damping", '<joint frictionloss=".2" damping')
    ball = '<geom name="belly" type="sphere" size=".05" pos="0 0 -.233" contype="1"/>'
    at = text.index("<freejoint")
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(text[:at] + ball + text[at:]))
    x, u = robot.standing(FEET).equilibrium()
    data = mujoco.MjData(robot.mujoco)
    data.qpos[:], data.ctrl[:] = x[: robot.mujoco.nq], u
    mujoco.mj_step(robot.mujoco, data, 500)
    assert np.abs(data.qpos[7:] - x[7 : robot.mujoco.nq]).max() < 5e-3


def test_feet_deep_in_the_ground_are_named():
    text = QUADRUPED.read_text().replace('qpos="0 0 .283', 'qpos="0 0 .272')
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(text))
    with pytest.warns(UserWarning, match=r"geom FL is 0.5\d* of its radius inside the ground"):
        robot.standing(FEET, friction=0.51)
