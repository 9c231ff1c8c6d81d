"""Numbers of a robot's model that vary: each acts as in MuJoCo's C engine, or is refused."""

import copy

import jax
import mujoco
import numpy as np
import pytest
from c_engine import c_steps

import jaxmpc as jm
from jaxmpc.closed_loop import LinearFeedback, randomised
from jaxmpc.closed_loop.simulation import require_variations
from jaxmpc.robots import RobotModel, tasks
from jaxmpc.robots.parameters import FIELDS

pytestmark = pytest.mark.usefixtures("x64")


# One of each: joints, stops with margins, springs, friction, tendons, actuators, an equality, a
# contact; solved to the end.
PARTS = """<mujoco><option timestep=".002" gravity="0 0 -9" tolerance="0" iterations="50"/>
<default><geom contype="0" conaffinity="0"/></default>
<worldbody>
<geom type="plane" size="3 3 .1" friction=".8 .01 .001" contype="1" solref=".03 .8" solmix=".3"/>
<site name="fixed" pos="0 .1 1.4"/>
<body pos="0 1 .098"><freejoint/>
 <inertial pos=".01 .02 .01" mass="1" fullinertia=".004 .005 .006 .0001 .0002 .0003"/>
 <geom size=".1" friction=".7 .01 .001" conaffinity="1" pos=".001 0 0"/></body>
<body pos="0 0 1" gravcomp=".5">
 <joint name="a" axis="0 1 0" range="-20 25" margin=".05" stiffness="3" springref="10" damping=".4"
  armature=".02" frictionloss=".2" actuatorfrcrange="-2 2"/>
 <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass=".8"/>
 <site name="moved" pos=".1 .02 .02" euler="10 20 30"/>
 <body pos=".3 0 0">
  <joint name="b" type="slide" axis="1 0 0" range="-.1 .1" damping="1" armature=".1" stiffness="5"
   frictionloss="8"/>
  <geom type="box" size=".05 .02 .03" mass=".4"/> <site name="tool" pos=".05 .01 .02"/>
  <body pos=".1 0 0" quat=".9 .1 .2 .3">
   <joint type="ball" stiffness=".3" damping=".05" range="0 60" armature=".01" pos="0.01 0 0"/>
   <geom type="ellipsoid" size=".02 .03 .05" mass=".3" pos="0 0 .02"/>
   <body pos="0 0 .1"><joint name="d" axis="1 0 0" frictionloss=".01" damping=".01"/>
    <geom type="box" size=".02 .01 .03" mass=".1"/></body></body></body></body>
<body pos="1 0 1"><joint name="e" axis="0 1 0" damping=".1" actuatorfrcrange="-.5 .5"/>
 <geom type="capsule" fromto="0 0 0 .2 0 0" size=".03" mass=".5"/></body>
</worldbody>
<tendon>
<fixed name="t" range="-.1 .1" margin=".02" stiffness="4" damping=".3" frictionloss="30"
 springlength="-.02 .02" armature=".01" actuatorfrcrange="-.1 .1">
 <joint joint="a" coef=".4"/><joint joint="b" coef="1"/></fixed>
<spatial range="0 .45" stiffness="6" damping=".2" springlength=".2">
 <site site="fixed"/><site site="moved"/></spatial>
</tendon>
<equality><joint joint1="e" joint2="d" polycoef=".01 .8 .1 0 0"/></equality>
<actuator><motor joint="a" gear="3" forcerange="-.5 .5" ctrlrange="-2 2"/>
<position joint="b" kp="30" kv="2" forcerange="-4 4"/>
<general tendon="t" dyntype="filter" dynprm=".1" gainprm="2" forcerange="-.3 .3" actlimited="true"
 actrange="-.1 .1"/>
<motor joint="e" gear="2"/> <motor site="moved" gear="0 .2 .3 0 .1 0"/></actuator></mujoco>"""


def starts(model, rng):
    """States beyond the stops and inside them, the last one so slow that dry friction holds, and
    inputs beyond the limits of forces."""
    first, count = model.jnt_qposadr, 5
    x = np.zeros((count, model.nq + model.nv + model.na))
    for row in x:
        q = model.qpos0.copy()
        mujoco.mj_integratePos(model, q, 0.15 * rng.normal(size=model.nv), 1.0)
        row[: model.nq] = q
    x[:, 2] = 0.098
    x[:, first[1]] = 0.40, -0.33, 0.42, 0.10, 0.02
    x[:, first[2]] = 0.09, 0.11, -0.12, 0.0, 0.01
    x[:, model.nq :] = 0.4 * rng.normal(size=(count, model.nv + model.na))
    u = 3 * rng.normal(size=(count, model.nu)) * [0.4, 0.2, 1, 0.5, 0.3]
    x[-1, model.nq : model.nq + model.nv] = 1e-3
    u[-1] = 0
    return x, u


@pytest.mark.long
def test_numbers_act_as_in_c():
    rng = np.random.default_rng(0)
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(PARTS), control_period=0.002)
    engine = copy.deepcopy(robot.file)
    engine.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    # By these the C engine passes over numbers that the compiler found to be zero.
    for name in ("body_sameframe", "geom_sameframe", "site_sameframe"):
        getattr(engine, name)[:] = 0
    engine.body_simple[:] = engine.dof_simplenum[:] = 0
    engine.geom_rbound[engine.geom_rbound > 0] = 1e3
    x, u = starts(engine, rng)
    step = jax.jit(jax.vmap(lambda x, u, numbers: robot.vary(**numbers).step(x, u), (0, 0, None)))
    by_c = lambda model: np.array([c_steps(model, *row, 1) for row in zip(x, u, strict=True)])
    of_file, before = {name: np.array(getattr(engine, name)) for name in FIELDS}, by_c(engine)
    np.testing.assert_allclose(step(x, u, of_file), before, rtol=0, atol=1e-11)
    idle = []
    for name, value in of_file.items():
        other = value * rng.uniform(0.8, 1.25, value.shape)
        if "solimp" in name:  # within 0 and 1, in order
            other = value * rng.uniform(0.8, 1, (*value.shape[:-1], 1))
        elif name not in ("dof_frictionloss", "tendon_frictionloss", "eq_data"):
            other += 0.02 * rng.uniform(size=other.shape)
        if "quat" in name or "axis" in name:
            other /= np.linalg.norm(other, axis=-1, keepdims=True)
        changed = copy.deepcopy(engine)
        getattr(changed, name)[:] = other
        after = by_c(changed)
        np.testing.assert_allclose(
            step(x, u, {**of_file, name: other}), after, rtol=0, atol=1e-11, err_msg=name
        )
        if np.abs(after - before).max() < 1e-9:
            idle.append(name)
    assert not idle


MOTOR = """<mujoco><worldbody><body><joint name="j" axis="0 1 0" actuatorfrcrange="-1 1"/>
{}<geom size=".1" mass="1" pos="0 0 .2"/><site name="tool"/></body>
<body pos="1 0 0"><joint name="free" axis="1 0 0"/><geom size=".1" mass="1"/></body></worldbody>
<actuator><motor joint="j" gear="2"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def motor():
    return jm.load_robot(mujoco.MjModel.from_xml_string(MOTOR.format("")))


@pytest.mark.long
def test_a_stronger_motor_keeps_the_limit_of_its_joint(motor):
    """The file's limit of the joint is one of inputs, u ≤ 0.5; with twice the gear it binds at
    0.25."""
    assert motor.input_limits.upper == 0.5
    stronger = copy.deepcopy(motor.file)
    stronger.actuator_gear[0, 0] = 4
    x, u = np.array([0.3, 0, 0.1, 0]), np.array([0.5])
    expected = c_steps(stronger, x, u, motor.substeps)
    found = motor.vary(actuator_gear=stronger.actuator_gear).step(x, u)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    drawn = randomised(motor, 3, gear=(1.5, 2.0))
    found = jax.vmap(lambda numbers: motor.vary(**numbers).step(x, u))(drawn)
    for gear, row in zip(drawn["actuator_gear"], found, strict=True):
        stronger.actuator_gear[:] = gear
        np.testing.assert_allclose(row, c_steps(stronger, x, u, motor.substeps), atol=1e-12)


@pytest.mark.parametrize("name", [pytest.param("arm2", marks=pytest.mark.slow), "sphere"])
def test_derivative_by_a_payload(name, motor):
    """Also where the body or the loaded body is as a ball, whose principal axes have no
    derivative."""
    robot = jm.load_robot("arm2") if name == "arm2" else motor
    x, u = 0.3 + 0.1 * np.arange(robot.state_size), np.full(robot.m, 0.2)
    step = jax.jit(lambda load: robot.vary(payload=load).step(x, u))
    for load in (0.0, 0.7):
        slope = (step(load + 1e-5) - step(load - 1e-5 * (load > 0))) / (1e-5 * (1 + (load > 0)))
        np.testing.assert_allclose(jax.jacfwd(step)(load), slope, rtol=2e-4, atol=1e-8)
    if name == "sphere":
        return
    np.testing.assert_allclose(jax.jacrev(step)(load), slope, rtol=2e-4, atol=1e-8)
    model = lambda load: RobotModel(robot, {"payload": load}).step(x, u)
    found = (model(0.7 + 1e-6) - model(0.7 - 1e-6)) / 2e-6
    np.testing.assert_allclose(jax.jacfwd(model)(0.7), found, rtol=1e-5, atol=1e-7)


def test_energy_and_inertias_are_those_of_the_model_that_varies():
    """Against a file with the point mass and the other masses."""
    robot = jm.load_robot("arm2")
    spec = mujoco.MjSpec.from_file(jm.__path__[0] + "/robots/models/arm2.xml")
    site = spec.site("tool")
    point = site.parent.add_body(pos=site.pos)
    point.explicitinertial, point.mass = True, 0.7
    point.ipos, point.inertia = [0.0, 0.0, 0.0], [1e-12] * 3
    for joint in spec.joints:
        joint.armature = 0.3
    loaded = spec.compile()
    loaded.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    data = mujoco.MjData(loaded)
    xi = np.array([0.4, -0.7, 1.0, 2.0])
    data.qpos[:], data.qvel[:] = np.split(xi, 2)
    mujoco.mj_forward(loaded, data)
    M = np.zeros((2, 2))
    mujoco.mj_fullM(loaded, data, M)
    numbers = {"payload": 0.7, "dof_armature": np.full(2, 0.3)}
    found = RobotModel(robot, numbers).view(xi, np.zeros(2))
    np.testing.assert_allclose(tasks.energy(robot)(found), data.energy.sum(), atol=1e-9)
    np.testing.assert_allclose(found._impl.M, M, atol=1e-9)
    np.testing.assert_allclose(found.subtree_com, data.subtree_com[:-1], atol=1e-9)
    # The point is a body of its own there.
    inertia = data.cinert[:-1].copy()
    inertia[-1] += data.cinert[-1]
    np.testing.assert_allclose(found._impl.cinert, inertia, atol=1e-9)


def test_directions_have_length_one(motor):
    """As MuJoCo's compiler makes them."""
    x, u = np.array([0.3, 0, 0.1, 0]), np.array([0.3])
    tilted = np.array([[0.0, 2.0, 0.2], [3.0, 0.0, 0.0]])
    engine = mujoco.MjModel.from_xml_string(MOTOR.format("").replace("0 1 0", "0 2 .2"))
    engine.dof_invweight0[:] = motor.file.dof_invweight0
    found = motor.vary(jnt_axis=tilted).step(x, u)
    np.testing.assert_allclose(found, c_steps(engine, x, u, motor.substeps), atol=1e-10)
    with pytest.raises(ValueError, match="jnt_axis: holds a direction of length zero"):
        motor.vary(jnt_axis=np.zeros((2, 3)))


def test_variations_of_a_robot_that_was_varied(motor):
    """Factors are of its own numbers, not of those of its file."""
    heavy = motor.vary(body_mass=3 * motor.file.body_mass, body_inertia=3 * motor.file.body_inertia)
    same = randomised(heavy, 2, mass=(1.0, 1.0))
    for name, value in same.items():
        np.testing.assert_array_equal(value[1], heavy.numbers[name])


@pytest.mark.slow
def test_lists_are_arrays(motor):
    """Of a plant that varies, of a model's numbers, and of many loops."""
    damping, x, u = [0.3, 0.2], np.array([0.1, 0.2, 0.3, 0.4]), np.ones(1)
    step = lambda values: motor.vary(dof_damping=values).step(x, u)
    np.testing.assert_array_equal(step(damping), step(np.array(damping)))
    linear = lambda values: motor.linearize(x, u, numbers={"dof_damping": values}).A
    np.testing.assert_array_equal(linear(damping), linear(np.array(damping)))
    controller = LinearFeedback(
        jm.robot_mpc(motor, horizon=1, terminal_cost=None), np.zeros((1, 4)), motor
    )
    many = lambda of: jm.simulate_many(
        controller, motor, np.stack([x, x]), 2, variations={"dof_damping": of([damping] * 2)}
    )
    np.testing.assert_array_equal(many(list).states, many(np.array).states)


def test_what_does_nothing_is_refused(motor):
    model = RobotModel(motor, {"dof_dampingpoly": np.ones((2, 2))})
    many = {"body_mass": np.ones((3, 3)) * [[1.0], [1.0], [-1.0]]}
    for call, message in (
        (
            lambda: motor.vary(actuator_ctrlrange=np.ones((1, 2))),
            "actuator_ctrlrange: is no",
        ),
        (lambda: motor.vary(bodymass=1.0), "bodymass: is no number.*Did you mean body_mass"),
        (lambda: motor.vary(body_mass=[0.0, -1.0, 1.0]), "body_mass: holds -1. Give numbers of at"),
        (lambda: motor.vary(payload=-0.1), "payload: holds -0.1"),
        (
            lambda: motor.vary(body_inertia=motor.plant.mjx.body_inertia + np.array([1.0, 0, 0])),
            "body_inertia: holds .* exceeds the sum",
        ),
        (lambda: model.step(np.zeros(4), np.zeros(1)), "dof_dampingpoly: is no number"),
        (lambda: model.linearize(np.zeros(4), np.zeros(1)), "dof_dampingpoly: is no number"),
        (lambda: motor.linearize(np.zeros(4), np.zeros(1), numbers={"a": 1}), "a: is no number"),
        (
            lambda: motor.linearize(
                np.zeros(4), np.zeros(1), numbers={"geom_size": np.ones((2, 3))}
            ),
            "geom_size: varies in plants alone",
        ),
        (lambda: require_variations(motor, many, 3), "body_mass: holds -1"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


@pytest.mark.slow
def test_forces_that_the_file_leaves_out(motor):
    """Dry friction and compensated gravity of a file without, also beside a joint that has some,
    and where friction varies to zero."""
    sticky = '<joint name="sticky" axis="1 0 0" frictionloss=".5"/>'
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(MOTOR.format(sticky)))
    drawn = randomised(robot, 2, friction=(0.5, 2.0), **{"sticky friction": (0.2, 0.3)})
    cases = [
        (motor, {"dof_frictionloss": np.array([[0.3, 0.2], [0.0, 9.0]])}),
        (motor, {"body_gravcomp": np.array([[0.0, 0.7, 0.2], [0.0, 0.0, 0.0]])}),
        (robot, drawn),
    ]
    for robot, numbers in cases:
        x, u = np.linspace(0.3, 0.5, robot.state_size), np.array([0.3])
        found = jax.vmap(lambda own, robot=robot, at=(x, u): robot.vary(**own).step(*at))(numbers)
        for i, row in enumerate(found):
            engine = copy.deepcopy(robot.file)
            for name, value in numbers.items():
                getattr(engine, name)[:] = value[i]
            if "body_gravcomp" in numbers:
                engine.flg_gravcomp = True
            np.testing.assert_allclose(row, c_steps(engine, x, u, robot.substeps), atol=1e-6)
    view = RobotModel(motor, {"body_gravcomp": np.array([0.0, 1.0, 1.0])}).view(x[:4], u)
    assert np.abs(view.qfrc_passive).max() > 0.1
