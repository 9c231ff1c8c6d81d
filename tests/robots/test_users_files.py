"""What users give: URDFs under other names, quaternions, a slide that leaves the usual view."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.robots.film import _camera, _ends
from jaxmpc.robots.load import _warn_of_meshes

URDF = """<?xml version="1.0"?>
<!-- <mujoco> in a comment -->
<robot name="swing"><link name="base"/>
<link name="rod"><inertial><origin xyz="0 0 .5"/><mass value="1"/>
<inertia ixx=".1" iyy=".1" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="5" velocity="2"/></joint></robot>"""


PLATE = """<link name="plate"><inertial><mass value=".1"/></inertial></link>
<joint name="mount" type="fixed"><parent link="rod"/><child link="plate"/></joint></robot>"""


def test_a_urdf_of_any_name(tmp_path):
    """With attributes of other programs whose prefix the file does not declare."""
    path = Path(tmp_path / "swing_urdf.xml")
    path.write_text(URDF.replace("<limit ", '<limit drake:acceleration="2" '))
    robot = jm.load_robot(path)
    np.testing.assert_array_equal(robot.input_limits.upper, [5])
    path.write_text(URDF.replace("</robot>", PLATE))  # a point mass without an inertia
    robot = jm.load_robot(path, floating_base=True, mend_inertias=True)
    assert robot.n == 14
    np.testing.assert_allclose(robot.mujoco.body_mass.sum(), 1.1, rtol=1e-3)


def test_what_is_wrong_in_a_urdf_is_named(tmp_path):
    """Without lines, which are not those of the file."""
    path = Path(tmp_path / "comma.urdf")
    path.write_text(URDF.replace('xyz="0 0 .5"', 'xyz="0, 0 .5"'))
    with pytest.raises(ValueError, match="bad format in attribute 'xyz' Element 'origin'. Mend"):
        jm.load_robot(path)


def test_a_planar_joint_has_its_limits_along_both_axes(tmp_path):
    """MuJoCo makes joints of other names of it, and limits the first one alone."""
    path = Path(tmp_path / "sled.urdf")
    path.write_text(URDF.replace("revolute", "planar"))
    robot = jm.load_robot(path)
    np.testing.assert_array_equal(robot.input_limits.upper, [5, 5, np.inf])
    np.testing.assert_array_equal(robot.state_limits.upper[:3], [1, 1, np.inf])
    velocities = dict(zip(robot.state_names[3:], robot.state_limits.upper[3:], strict=True))
    assert velocities == {
        "hinge_TX velocity": 2, "hinge_TY velocity": 2, "hinge_RZ velocity": np.inf
    }  # fmt: skip


def test_a_continuous_joint_turns_without_end(tmp_path):
    """Also where its <limit> has a range, which MuJoCo would make stops of."""
    path = Path(tmp_path / "wheel.urdf")
    path.write_text(URDF.replace("revolute", "continuous").replace('lower="-1"', 'lower="3"'))
    robot = jm.load_robot(path)
    assert not robot.mujoco.jnt_limited[0] and robot.input_limits.upper == [5]
    np.testing.assert_array_equal(robot.state_limits.upper, [np.inf, 2])


def test_bodies_moved_by_hand_stand_where_the_key_for_home_has_them():
    """A tray under a ball: without it the ball would fall, elsewhere it would lie lower."""
    file = """<mujoco><worldbody><body name="tray" mocap="true" pos="0 0 -1">
    <geom type="box" size=".5 .5 .01"/></body><body pos="0 0 .3"><joint name="j" type="slide"
    axis="0 0 1"/><geom size=".1" mass="1"/></body></worldbody>
    <actuator><motor joint="j"/></actuator><keyframe><key name="other" qpos="0"/>
    <key name="home" qpos="-.1" mpos=".1 0 .095" mquat="0 0 0 1"/></keyframe></mujoco>"""
    model = mujoco.MjModel.from_xml_string(file)
    robot, data = jm.load_robot(model), mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 1)
    x = robot.home
    for _ in range(3):
        mujoco.mj_step(model, data, robot.substeps)
        x = robot.step(x, np.zeros(1))
    np.testing.assert_allclose(x, [data.qpos[0], data.qvel[0]], atol=1e-5)
    assert data.qvel[0] > 1e-3  # the tray pushes it up


@pytest.mark.parametrize("encoding", ["utf-16", "iso-8859-1", "utf-8-sig"])
def test_a_urdf_in_the_encoding_that_it_declares(tmp_path, encoding):
    path = Path(tmp_path / "swing.urdf")
    declared = URDF.replace('"1.0"?>', f'"1.0" encoding="{encoding.removesuffix("-sig")}"?>')
    path.write_bytes(declared.replace("in a comment", "größer").encode(encoding))
    np.testing.assert_array_equal(jm.load_robot(path).input_limits.upper, [5])


@pytest.mark.parametrize(
    "given, words",
    [
        ('lower="1" upper="-1"', "joint hinge has the range .1, -1."),
        ('lower="1" upper="1"', "joint hinge has the range .1, 1."),
        ('velocity="-2"', "joint hinge has the effort 5, the velocity -2"),
        ('velocity="2 m"', "a limit of joint hinge is no number: .*'2 m'"),
    ],
)
def test_limits_of_a_urdf_that_no_motion_keeps_are_refused(tmp_path, given, words):
    """MuJoCo drops an empty range, and the joint would have none."""
    path = Path(tmp_path / "swing.urdf")
    names = {part.split("=")[0]: part for part in re.findall(r'\w+="[^"]*"', given)}
    limit = {"lower": 'lower="-1"', "upper": 'upper="1"', "velocity": 'velocity="2"'} | names
    text = f'<limit effort="5" {" ".join(limit.values())}/>'
    path.write_text(re.sub(r"<limit [^>]*>", text, URDF))
    with pytest.raises(ValueError, match=f"model: .*{words}. Mend the file"):
        jm.load_robot(path)


@pytest.mark.long
def test_contacts_are_left_out_on_request(tmp_path):
    """What is left falls freely; and where many meshes could touch, a warning names that."""
    body = """<body pos="0 0 {}"><joint type="slide" range="-9 9"/><geom type="mesh" mesh="m"/>
    </body>"""
    text = f"""<mujoco><option cone="elliptic" integrator="RK4"/><asset>
    <mesh name="m" vertex="0 0 0  .1 0 0  0 .1 0  0 0 .1"/></asset>
    <worldbody>{"".join(body.format(i) for i in range(4))}<site name="s"/></worldbody>
    <actuator><motor site="s"/></actuator></mujoco>"""
    path = Path(tmp_path / "four.xml")
    path.write_text(text)
    robot = jm.load_robot(path, contacts=False)
    assert robot.report().left_out == ("all contacts",)
    x, u = robot.home, np.zeros(1)
    after = robot.step(x, u)
    np.testing.assert_allclose(after[4:], -9.81 * robot.dt, rtol=1e-5)
    # A fall that this integrator has exactly.
    np.testing.assert_allclose(after[:4] - x[:4], -9.81 * robot.dt**2 / 2, rtol=1e-3)
    with pytest.warns(UserWarning, match="four has 6 pairs of meshes .* load it with contacts=Fal"):
        _warn_of_meshes("four", mujoco.MjModel.from_xml_path(str(path)))


@pytest.mark.parametrize("size", [0, 0.1, 3])
def test_quaternions_have_unit_length(size):
    robot = jm.load_robot("quadrotor")
    q = np.array([0, 0, 1, size, 0, 0, 0.0])
    with pytest.raises(ValueError, match="q: quaternion .* Give unit length, w first"):
        robot.equilibrium(q)
    with pytest.raises(ValueError, match="quaternion"):
        jm.robot_mpc(robot, target=q)


def test_the_camera_sees_all_poses():
    """Every moving shape lies in the cone of view about the camera's axis."""
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody>
        <body><joint type="slide" axis="1 0 0"/><geom size=".1" mass="1"/>
        <body pos="0 0 .5"><joint axis="0 1 0"/><geom type="capsule" size=".02"
        fromto="0 0 0 .6 0 .3" mass="1"/></body></body></worldbody></mujoco>""")
    poses = np.array([[-5.0, 0], [0, 1], [9, -2]])
    camera, data = _camera(model, _ends(model, poses), 0.5), mujoco.MjData(model)
    a, e = np.deg2rad([camera.azimuth, camera.elevation])
    ahead = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    eye = camera.lookat - camera.distance * ahead
    narrow = np.arctan(0.5 * np.tan(np.deg2rad(model.vis.global_.fovy) / 2))
    for pose in poses:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        way = data.geom_xpos - eye
        angle = np.arccos(way @ ahead / np.linalg.norm(way, axis=1))
        size = np.arcsin(model.geom_rbound / np.linalg.norm(way, axis=1))
        assert np.all(angle + size <= narrow + 1e-9)
