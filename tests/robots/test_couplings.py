"""Couplings of a file (equalities) in the model of the plan, beside MuJoCo's C engine."""

import jax
import mujoco
import numpy as np
import pytest
from c_engine import c_transition

import jaxmpc as jm
from jaxmpc.closed_loop.variations import draw_robots
from jaxmpc.robots.couplings import Couplings
from jaxmpc.robots.equilibria import rest_at

LINK = '<geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass=".5"/>'
MODEL = """<mujoco><default><geom contype="0" conaffinity="0"/></default><worldbody>
<body name="a" pos="0 0 1"><joint name="j" axis="0 1 0" damping=".5" range="-90 90"/>{link}
<body name="b" pos=".3 0 0"><joint name="k" axis="0 1 0" damping=".5" range="-90 90"/>{link}</body>
</body><body name="c" pos="0 .2 1"><joint name="l" axis="0 1 0" damping=".5" range="-90 90"/>{link}
</body></worldbody><tendon><fixed name="t"><joint joint="k" coef="1"/><joint joint="l" coef="-.5"/>
</fixed></tendon><equality>{equality}</equality><actuator><motor joint="j" ctrlrange="-9 9"/>
<motor joint="k" ctrlrange="-9 9"/></actuator></mujoco>"""
COUPLINGS = {
    "joint": '<joint joint1="l" joint2="j" polycoef="0 .5 .3 0 0"/>',
    "tendon": '<tendon tendon1="t"/>',
    "connect": '<connect body1="a" body2="c" anchor=".2 0 0"/>',
    "weld": '<weld body1="a" body2="c"/>',
}


def slow(kind):
    return pytest.param(kind, marks=pytest.mark.slow)


def coupled(kind):
    text = MODEL.format(link=LINK, equality=COUPLINGS[kind])
    return jm.load_robot(mujoco.MjModel.from_xml_string(text))


def test_a_set_point_lies_inside_the_limits_though_couplings_yield():
    """The third link is at the end of its range at home, and its weight pulls it beyond: a stop
    that pushes there would be no rest."""
    text = MODEL.format(link=LINK, equality=COUPLINGS["joint"])
    text = text.replace('name="l" axis="0 1 0" damping=".5" range="-90 90"',
                        'name="l" axis="0 1 0" damping=".5" range="-90 0"')  # fmt: skip
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(text))
    with pytest.warns(UserWarning, match="couplings yield .* would carry l beyond the limits"):
        x, u = robot.set_point()
    assert -0.05 < x[0] < 0 and -0.01 < x[2] <= 0
    data = mujoco.MjData(robot.file)
    data.qpos[:], data.ctrl[:] = x[:3], u
    mujoco.mj_forward(robot.file, data)
    assert data.nefc == 1 and np.abs(data.qacc).max() < 1e-6  # the coupling alone: no stop


def test_couplings_that_contradict_one_another_are_named():
    """l = j / 2 and l = 1 + j / 2: half of the difference is left wherever one looks."""
    pair = [f'<joint joint1="l" joint2="j" name="{c}" polycoef="{c} .5 0 0 0"/>' for c in (0, 1)]
    text = MODEL.format(link=LINK, equality="".join(pair))
    couplings = Couplings(mujoco.MjModel.from_xml_string(text))
    assert "equality 1 is off by 1" in couplings.unmet(np.zeros(3))
    assert "is off by 0.5" in couplings.unmet(couplings.met(np.zeros(3)))
    with pytest.raises(ValueError, match="cannot be met near .* is off by 0.5"):
        couplings.kept(np.zeros((1, 6)))


# (MJX has no force for the turning of connect and weld, which loading says.)
@pytest.mark.filterwarnings("ignore:.*pushes otherwise")
@pytest.mark.parametrize("kind", ["joint", *(slow(k) for k in ("tendon", "connect", "weld"))])
def test_a_set_point_rests_in_the_c_engine(kind):
    """Home, held for two seconds by inputs that carry what the coupled third link weighs."""
    robot = coupled(kind)
    x, u = robot.set_point()
    data = mujoco.MjData(robot.file)
    data.qpos[:], data.ctrl[:] = x[:3], u
    mujoco.mj_forward(robot.file, data)
    assert np.abs(data.qacc).max() < 1e-4
    for _ in range(1000):
        mujoco.mj_step(robot.file, data)
    assert np.abs(data.qpos - x[:3]).max() < 1e-3
    weight = -0.15 * 0.5 * 9.81
    if kind == "weld":  # two links turn as one
        np.testing.assert_allclose(u[0], 2 * weight + 0.45 / 0.15 * weight, rtol=0.02)


@pytest.mark.filterwarnings("ignore:.*pushes otherwise")
@pytest.mark.parametrize("kind", [slow("joint"), slow("tendon"), slow("connect")])
def test_linear_models_have_the_couplings(kind):
    """A and B of a physics step are the C engine's, away from rest, but for the A of connect, which
    lacks the force that MJX lacks (loading says so). The plan's model moves the coupled joint with
    the one that is driven."""
    robot = coupled(kind)
    q = Couplings(robot.predictor.model).met([0.3, -0.2, 0.1])
    x, u = np.concatenate([q, [0.5, -0.3, 0.2]]), np.array([1.0, -0.5])
    with jax.enable_x64(True):
        found = robot.transition(x, u)
        model = robot.linearize(x, u)
    pairs = list(zip(found, c_transition(robot, x, u), strict=True))
    for part, wanted in pairs[1:] if kind == "connect" else pairs:
        np.testing.assert_allclose(part, wanted, atol=1e-6 * (1 + np.abs(wanted).max()))
    if kind != "tendon":  # whose spring yields within a period
        driven, follower = model.B[3, 0], model.B[5, 0]
        slope = 0.5 + 2 * 0.3 * q[0] if kind == "joint" else 1.0
        np.testing.assert_allclose(follower / driven, slope, rtol=0.1)


@pytest.mark.slow
def test_random_starts_meet_the_couplings():
    robot = coupled("joint")
    states, _ = draw_robots(robot, 20, spread=0.5)
    q, v = states[:, :3], states[:, 3:]
    np.testing.assert_allclose(q[:, 2], 0.5 * q[:, 0] + 0.3 * q[:, 0] ** 2, atol=1e-9)
    np.testing.assert_allclose(v[:, 2], (0.5 + 0.6 * q[:, 0]) * v[:, 0], atol=1e-9)
    environment = jm.closed_loop.Environment.of(robot)
    starts = jax.vmap(environment.reset)(jax.random.split(jax.random.key(0), 20)).x
    np.testing.assert_allclose(starts[:, 5], 0.5 * starts[:, 3], atol=1e-5)


@pytest.mark.long
def test_the_default_model_off_the_couplings_is_that_of_a_period():
    """Where they are off, as in closed loops, their forces differ from one physics step to the
    next: one step's model taken several times had a radius of 2.8 in place of 1.03."""
    robot = coupled("joint")
    x, u = np.array([0.3, -0.2, 0.18, 0.5, -0.3, 0.5]), np.array([1.0, -0.5])
    with jax.enable_x64(True):
        model = robot.linearize(x, u)
        after = np.asarray(robot.step(x, u))
        h, eye = 1e-6, np.eye(6)
        slopes = [(robot.step(x + h * e, u) - robot.step(x - h * e, u)) / (2 * h) for e in eye]
    A, B, c = map(np.asarray, (model.A, model.B, model.c))
    np.testing.assert_allclose(A @ x + B @ u + c, after, atol=1e-9)
    np.testing.assert_allclose(A, np.stack(slopes, 1), atol=1e-3 * np.abs(A).max())


def test_where_it_rests_is_a_target():
    robot = coupled("joint")
    x, u = robot.equilibrium([0.3, -0.2, 0.5 * 0.3 + 0.3 * 0.3**2])
    again = robot.equilibrium(x[:3])
    np.testing.assert_allclose(again[0], x, atol=1e-3)
    np.testing.assert_allclose(again[1], u, atol=1e-2)


def test_a_target_off_the_couplings_is_refused_and_its_cure_helps():
    robot = coupled("joint")
    with pytest.raises(ValueError, match="q: .* violates couplings .* off by 0.2") as refusal:
        robot.equilibrium([0.0, 0.0, 0.2])
    cure = np.fromstring(str(refusal.value).split("[")[-1].strip("]. "), sep=" ")
    x, _ = robot.equilibrium(Couplings(robot.predictor.model).met(cure))
    np.testing.assert_allclose(x[:3], cure, atol=1e-2)


LIMB = """<link name="{0}"><inertial><mass value=".1"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4"
ixy="0" ixz="0" iyz="0"/></inertial></link>"""
FINGER = """<joint name="{0}" type="prismatic"><parent link="p"/><child link="{1}"/>
<axis xyz="0 1 0"/><limit lower="0" upper=".04" effort="20" velocity=".2"/>{2}</joint>"""


@pytest.mark.slow
def test_a_mimic_joint_of_a_urdf_gets_no_motor(tmp_path):
    parts = [LIMB.format(name) for name in "pab"]
    parts += [FINGER.format("l", "a", ""), FINGER.format("r", "b", '<mimic joint="l"/>')]
    path = tmp_path / "gripper.urdf"
    path.write_text(f'<robot name="g">{"".join(parts)}</robot>')
    robot = jm.load_robot(path)
    assert robot.input_names == ("l torque",)
    states, _ = draw_robots(robot, 8)
    np.testing.assert_allclose(states[:, 0], states[:, 1], atol=1e-12)
    model = robot.linearize(robot.home, np.zeros(1))
    np.testing.assert_allclose(model.B[3, 0], model.B[2, 0], rtol=0.15)


@pytest.mark.parametrize("other, kind", [("nobody", "prismatic"), ("m", "prismatic"),
                                         ("l", "fixed")])  # fmt: skip
def test_what_mimics_nothing_that_moves_is_refused(tmp_path, other, kind):
    """MuJoCo would leave that finger free, with a line on stderr."""
    parts = [LIMB.format(name) for name in "pab"]
    parts += [FINGER.format("l", "a", "").replace("prismatic", kind)]
    parts += [FINGER.format("m", "b", f'<mimic joint="{other}"/>')]
    path = tmp_path / "gripper.urdf"
    path.write_text(f'<robot name="g">{"".join(parts)}</robot>')
    with pytest.raises(ValueError, match=f"joint m mimics {other}, which is no other joint that"):
        jm.load_robot(path)


def test_a_rest_that_soft_couplings_do_not_reach_stays_where_it_was_asked_for():
    soft = COUPLINGS["joint"].replace("/>", ' solref=".5 1" solimp=".1 .2 .1"/>')
    text = MODEL.format(link=LINK, equality=soft)
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(text))
    np.testing.assert_array_equal(rest_at(robot, np.zeros(3)).q, 0)
    with pytest.raises(ValueError, match=r"q: \[0. 0. 0.\]: no input balances the forces"):
        robot.equilibrium()


def test_couplings_that_are_off_couple_nothing():
    text = MODEL.format(link=LINK, equality=COUPLINGS["joint"].replace("/>", ' active="false"/>'))
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(text))
    states = np.random.default_rng(0).normal(size=(4, 6))
    np.testing.assert_array_equal(Couplings(robot.predictor.model).kept(states), states)
