"""Shapes for pictures, motors for joints that have none, and the cures of what MJX refuses."""

import mujoco
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.closed_loop import evaluate_runs
from jaxmpc.closed_loop.simulation import Run
from jaxmpc.robots.film import _links

INERTIA = '<inertia ixx=".02" iyy=".02" izz=".01" ixy="0" ixz="0" iyz="0"/>'
URDF = f"""<robot name="two"><link name="base"/>
<link name="first"><inertial><origin xyz="0 0 .2"/><mass value="1"/>{INERTIA}</inertial>
<visual><origin xyz="0 0 .2"/><geometry><box size=".08 .08 .4"/></geometry></visual>
<collision><geometry><sphere radius="1"/></geometry></collision></link>
<link name="second"><inertial><origin xyz="0 0 .2"/><mass value=".5"/>{INERTIA}</inertial>
<visual><geometry><mesh filename="package://two_description/meshes/second.dae"/></geometry></visual>
<collision><origin xyz="0 0 .2"/><geometry><cylinder radius=".03" length=".4"/></geometry>
</collision></link>
<link name="tip"><visual><geometry><mesh filename="package://two_description/meshes/tip.obj"/>
</geometry></visual></link>
<joint name="a" type="revolute"><parent link="base"/><child link="first"/><axis xyz="0 1 0"/>
<limit effort="30" velocity="3" lower="-2" upper="2"/></joint>
<joint name="b" type="revolute"><parent link="first"/><child link="second"/><axis xyz="0 1 0"/>
<origin xyz="0 0 .4"/><limit effort="15" velocity="3" lower="-2" upper="2"/></joint>
<joint name="c" type="fixed"><parent link="second"/><child link="tip"/>
<origin xyz="0 0 .4"/></joint>
</robot>"""
TETRAHEDRON = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
MJCF = """<mujoco model="bare"><option integrator="{0}"/><compiler angle="radian"/><worldbody>
<body name="first" pos="0 0 1"><joint name="a" axis="0 1 0" actuatorfrcrange="-7 7"/>
<inertial pos="0 0 -.2" mass="1" diaginertia=".02 .02 .01"/>
<body name="second" pos="0 0 -.4"><joint name="b" axis="0 1 0"/>
<inertial pos="0 0 -.2" mass=".5" diaginertia=".01 .01 .01"/>
<body name="third" pos="0 0 -.4"><joint name="c" axis="0 1 0"/>
<inertial pos="0 0 -.1" mass=".1" diaginertia=".01 .01 .01"/></body></body></body></worldbody>
<equality><joint joint1="c" joint2="b"/></equality>{1}</mujoco>"""


def written(folder, text, name="robot.xml"):
    path = folder / name
    path.write_text(text)
    return path


def test_a_urdf_keeps_its_shapes_for_drawing_alone(tmp_path):
    """The box of the first link, not its ball; the cylinder in place of a mesh that MuJoCo cannot
    read; the mesh of the tip only where its file is."""
    folder = tmp_path / "two_description" / "urdf"
    folder.mkdir(parents=True)
    path = written(folder, URDF, "two.urdf")
    box, cylinder, mesh = (
        int(getattr(mujoco.mjtGeom, f"mjGEOM_{kind}")) for kind in ("BOX", "CYLINDER", "MESH")
    )
    robot = jm.load_robot(path)
    assert robot.mujoco.ngeom == 0 and robot.shapes.nq == robot.mujoco.nq
    assert list(robot.shapes.geom_type) == [box, cylinder]
    data = mujoco.MjData(robot.shapes)
    data.qpos[:] = [0.3, 0.5]
    mujoco.mj_kinematics(robot.shapes, data)
    along = lambda angle: np.array([np.sin(angle), 0, np.cos(angle)])
    middles = [0.2 * along(0.3), 0.4 * along(0.3) + 0.2 * along(0.8)]
    np.testing.assert_allclose(data.geom_xpos, middles, atol=1e-12)
    (folder.parent / "meshes").mkdir()
    written(folder.parent / "meshes", TETRAHEDRON, "tip.obj")
    assert list(jm.load_robot(path).shapes.geom_type) == [box, cylinder, mesh]


def test_bodies_without_shapes_are_lines_between_joints(tmp_path):
    model = mujoco.MjModel.from_xml_string(MJCF.format("Euler", ""))
    data = mujoco.MjData(model)
    data.qpos[0] = np.pi / 2  # along −x
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    found = np.array(_links(model, data))
    ends = [[[0, 0, 1], [-0.4, 0, 1]], [[-0.4, 0, 1], [-0.8, 0, 1]], [[-0.8, 0, 1], [-1, 0, 1]]]
    np.testing.assert_allclose(found, ends, atol=1e-9)


def test_joints_get_motors_on_request(tmp_path):
    """Those that follow no other one, with the joint's own limit of force."""
    path = written(tmp_path, MJCF.format("Euler", ""))
    with pytest.raises(ValueError, match=r"no actuators\. Load the file with motors=True"):
        jm.load_robot(path)
    robot = jm.load_robot(path, motors=True)
    assert robot.input_names == ("a torque", "b torque")
    np.testing.assert_array_equal(robot.input_limits.upper, [7, np.inf])
    own = written(
        tmp_path, MJCF.format("Euler", '<actuator><motor joint="a"/></actuator>'), "own.xml"
    )
    with pytest.raises(ValueError, match=r"motors: given, and own.xml has 1 actuators"):
        jm.load_robot(own, motors=True)
    with pytest.raises(ValueError, match="motors: given with a URDF"):
        jm.load_robot(written(tmp_path, URDF, "two.urdf"), motors=True)


def test_the_cure_of_an_implicit_integrator_is_named(tmp_path):
    path = written(tmp_path, MJCF.format("implicit", ""))
    with pytest.raises(ValueError, match='implicit, .*Write integrator="implicitfast"'):
        jm.load_robot(path, motors=True)


def test_a_velocity_without_limit_has_no_band(tmp_path):
    """The robot stands at its target, and still moves by 0.1 rad/s: nobody said what is slow."""
    states = np.zeros((3, 6))
    states[:, 3] = 0.1
    zeros, inputs = np.zeros(2), np.zeros((2, 2))
    run = Run(
        states, inputs, zeros, np.ones(2, int), zeros, np.zeros(3), np.zeros((2, 0)), zeros > 1
    )
    path = written(tmp_path, MJCF.format("Euler", ""))
    free = jm.load_robot(path, motors=True)
    assert evaluate_runs(run, free, np.zeros(6)).success.all()
    limited = jm.load_robot(path, motors=True, velocity=2.0)
    assert not evaluate_runs(run, limited, np.zeros(6)).success.any()
