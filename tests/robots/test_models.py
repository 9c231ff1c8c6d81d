"""The robots' model files against their sources: tables and equations written here once more."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

import jaxmpc

FOLDER = Path(jaxmpc.__file__).parent / "robots" / "models"
G, PI, INF = 9.81, np.pi, np.inf

# name: (joints, actuators, lowest position, highest, highest speed, lowest input, highest input)
FER_HIGH = [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]
FER_LOW = [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]
FER_SPEED, FER_TORQUE = [2.175] * 4 + [2.61] * 3, np.array([87.0] * 4 + [12.0] * 3)
UR_HIGH = np.array([360, 360, 180, 360, 360, 360]) * PI / 180
UR_TORQUE = np.array([150.0] * 3 + [28.0] * 3)
UR_JOINTS = ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]
ROTORS = ["front_right", "back_right", "back_left", "front_left"]
FULL_THRUST = np.polyval([2.130295e-11, 1.032633e-6, 5.484560e-4], 65535)
TABLE = {
    "joint": (["q"], ["tau"], [-1.5], [1.5], [2], [-2], [2]),
    "pendulum": (["theta"], ["torque"], [-1.5708], [1.5708], [8], [-5], [5]),
    "cartpole": (["cart", "pole"], ["force"], [-2.4, -1], [2.4, 1], [5, 8], [-10], [10]),
    "arm2": (["shoulder", "elbow"], ["shoulder_torque", "elbow_torque"],
             [-3.1416, -2.6], [3.1416, 2.6], [4, 6], [-25, -5], [25, 5]),
    "arm6": (UR_JOINTS, [f"{name}_torque" for name in UR_JOINTS],
             -UR_HIGH, UR_HIGH, [PI] * 6, -UR_TORQUE, UR_TORQUE),
    "arm7": ([f"joint{i}" for i in range(1, 8)], [f"joint{i}_torque" for i in range(1, 8)],
             FER_LOW, FER_HIGH, FER_SPEED, -FER_TORQUE, FER_TORQUE),
    "quadrotor": (["free"], [f"thrust_{name}" for name in ROTORS],
                  [-INF], [INF], [2, 2, 2, 6, 6, 6], [0] * 4, [FULL_THRUST] * 4),
}  # fmt: skip

# Craig's (modified) table of the FER, flange last: a, d, alpha of T = Rx(alpha) Tx(a) Rz(q) Tz(d).
FER_A = [0, 0, 0, 0.0825, -0.0825, 0, 0.088, 0]
FER_D = [0.333, 0, 0.316, 0, 0.384, 0, 0, 0.107]
FER_ALPHA = np.array([0, -1, 1, 1, -1, 1, 1, 0]) * PI / 2
FER_MASS = [4.970684, 0.646926, 3.228604, 3.587895, 1.225946, 1.666555, 0.735522, 0]
FER_COM = [
    [3.875e-3, 2.081e-3, -4.762e-2], [-3.141e-3, -2.872e-2, 3.495e-3],
    [2.7518e-2, 3.9252e-2, -6.6502e-2], [-5.317e-2, 1.04419e-1, 2.7454e-2],
    [-1.1953e-2, 4.1065e-2, -3.8437e-2], [6.0149e-2, -1.4117e-2, -1.0517e-2],
    [1.0517e-2, -4.252e-3, 6.1597e-2], [0, 0, 0],
]  # fmt: skip
FER_INERTIA = [  # xx, yy, zz, xy, xz, yz
    [7.0337e-1, 7.0661e-1, 9.1170e-3, -1.3900e-4, 6.7720e-3, 1.9169e-2],
    [7.9620e-3, 2.8110e-2, 2.5995e-2, -3.9250e-3, 1.0254e-2, 7.0400e-4],
    [3.7242e-2, 3.6155e-2, 1.0830e-2, -4.7610e-3, -1.1396e-2, -1.2805e-2],
    [2.5853e-2, 1.9552e-2, 2.8323e-2, 7.7960e-3, -1.3320e-3, 8.6410e-3],
    [3.5549e-2, 2.9474e-2, 8.6270e-3, -2.1170e-3, -4.0370e-3, 2.2900e-4],
    [1.9640e-3, 4.3540e-3, 5.4330e-3, 1.0900e-4, -1.1580e-3, 3.4100e-4],
    [1.2516e-2, 1.0027e-2, 4.8150e-3, -4.2800e-4, -1.1960e-3, -7.4100e-4],
]
# The UR5e's table, T = Rz(q) Tz(d) Tx(a) Rx(alpha); centres of mass and inertias in its frames.
UR_A = [0, -0.425, -0.3922, 0, 0, 0]
UR_D = [0.1625, 0, 0, 0.1333, 0.0997, 0.0996]
UR_ALPHA = np.array([1, 0, 0, 1, -1, 0]) * PI / 2
UR_MASS = [3.761, 8.058, 2.846, 1.37, 1.3, 0.365]
UR_COM = [
    [0, -0.02561, 0.00193], [0.2125, 0, 0.11336], [0.15, 0, 0.0265],
    [0, -0.0018, 0.01634], [0, 0.0018, 0.01634], [0, 0, -0.001159],
]  # fmt: skip
UR_INERTIA = [
    [0.00700210, 0.00648091, 0.00657286, 0.00000073, -0.00001053, 0.00049994],
    [0.01505885, 0.33388086, 0.33247207, -0.00005400, 0.00000563, -0.00000181],
    [0.00399632, 0.07879254, 0.07848510, -0.00001365, 0.00137272, -0.00000660],
    [0.00165491, 0.00135962, 0.00126279, -0.00000282, -0.00000438, 0.00010157],
    [0.00135617, 0.00127827, 0.00096614, -0.00000274, 0.00000444, -0.00005048],
    [0.00018694, 0.00018908, 0.00025756, 0.00000006, -0.00000017, -0.00000092],
]
MASS = {
    "joint": 1,
    "pendulum": 1,
    "cartpole": 1.1,
    "arm2": 3,
    "arm6": sum(UR_MASS),
    "arm7": sum(FER_MASS),
    "quadrotor": 0.028,
}


def load(name):
    model = mujoco.MjModel.from_xml_path(str(FOLDER / f"{name}.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    mujoco.mj_forward(model, data)
    return model, data


def turn_x(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]])


def turn_z(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def move(x, z):
    frame = np.eye(4)
    frame[0, 3], frame[2, 3] = x, z
    return frame


def fer_frames(q):
    frames, frame = [], np.eye(4)
    for a, d, alpha, angle in zip(FER_A, FER_D, FER_ALPHA, [*q, 0], strict=True):
        frame = frame @ turn_x(alpha) @ move(a, 0) @ turn_z(angle) @ move(0, d)
        frames.append(frame)
    return frames


def ur_frames(q):
    frames, frame = [], np.eye(4)
    for a, d, alpha, angle in zip(UR_A, UR_D, UR_ALPHA, q, strict=True):
        frame = frame @ turn_z(angle) @ move(a, d) @ turn_x(alpha)
        frames.append(frame)
    return frames


ARMS = {
    "arm6": (ur_frames, UR_MASS, UR_COM, UR_INERTIA),
    "arm7": (fer_frames, FER_MASS, FER_COM, FER_INERTIA),
}


def tensor(inertia):
    xx, yy, zz, xy, xz, yz = inertia
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def test_every_file_is_tested():
    assert {path.stem for path in FOLDER.glob("*.xml")} == set(TABLE)


@pytest.mark.parametrize("name", TABLE)
def test_elements_and_limits(name):
    joints, actuators, low, high, speed, weakest, strongest = TABLE[name]
    model, data = load(name)
    assert [model.joint(i).name for i in range(model.njnt)] == joints
    assert [model.actuator(i).name for i in range(model.nu)] == actuators
    assert model.camera("view").bodyid == 0
    sites = [model.site(i).name for i in range(model.nsite)]
    assert ("tool" in sites) == (name in ("joint", "arm2", "arm6", "arm7"))
    limited = model.jnt_limited.astype(bool)
    np.testing.assert_allclose(np.where(limited, model.jnt_range[:, 0], -INF), low, rtol=1e-12)
    np.testing.assert_allclose(np.where(limited, model.jnt_range[:, 1], INF), high, rtol=1e-12)
    assert np.all(model.actuator_ctrllimited)
    np.testing.assert_allclose(model.actuator_ctrlrange[:, 0], weakest)
    # The quadrotor's 0.1597 N is the thrust curve at full command, to the digits of the file.
    np.testing.assert_allclose(model.actuator_ctrlrange[:, 1], strongest, rtol=1e-4)
    np.testing.assert_allclose(model.numeric("velocity_limit").data, speed)
    assert len(speed) == model.nv
    steps = model.numeric("control_period").data[0] / model.opt.timestep
    assert abs(steps - round(steps)) < 1e-9 and round(steps) >= 1
    np.testing.assert_allclose(model.body_mass.sum(), MASS[name], rtol=1e-9)


@pytest.mark.parametrize("name", TABLE)
def test_common_choices(name):
    model, data = load(name)
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert (model.opt.iterations, model.opt.ls_iterations) == (4, 8)
    assert (model.vis.global_.offwidth, model.vis.global_.offheight) == (1280, 720)
    # Nothing collides, no joint rubs, no body floats: the only constraints are joint limits.
    assert not np.any(model.geom_contype) and not np.any(model.geom_conaffinity)
    assert not np.any(model.dof_frictionloss) and not np.any(model.body_gravcomp)
    assert data.ncon == 0 and data.nefc == 0
    assert model.na == 0


@pytest.mark.parametrize("name", TABLE)
def test_home_can_be_held(name):
    """At home: nothing moves, every joint 5 % of its range from the ends, half the input left."""
    model, data = load(name)
    limited = model.jnt_limited.astype(bool)
    low, high = model.jnt_range[limited].T
    q = data.qpos[model.jnt_qposadr[limited]]
    assert np.all(q - low > 0.05 * (high - low)) and np.all(high - q > 0.05 * (high - low))
    moment = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(
        moment, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind
    )
    u, *_ = np.linalg.lstsq(moment.T, data.qfrc_bias - data.qfrc_passive, rcond=None)
    weakest, strongest = model.actuator_ctrlrange.T
    half = 0.25 * (strongest - weakest)
    assert np.all(np.abs(u - (weakest + strongest) / 2) < half)
    data.ctrl[:] = u
    before = data.qpos.copy()
    for _ in range(10):
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(data.qpos, before, atol=1e-12)
    np.testing.assert_allclose(data.qvel, 0, atol=1e-11)


def test_joint_is_the_lessons():
    """The file's map in closed form, and the lesson's A, B in the coordinates (q - T dq, dq)."""
    model, data = load("joint")
    T, J = 0.01, 0.05
    A, B = np.array([[1, T], [0, 1]]), np.array([T * T / J, T / J])
    lesson, shift = np.array([0, T / J]), np.array([[1, -T], [0, 1]])
    assert model.numeric("control_period").data[0] == model.opt.timestep == T
    rng = np.random.default_rng(0)
    for _ in range(100):
        x, u = rng.uniform(-1, 1, 2) * [1.4, 2], rng.uniform(-2, 2)
        data.qpos[0], data.qvel[0], data.ctrl[0] = *x, u
        mujoco.mj_step(model, data)
        after = np.array([data.qpos[0], data.qvel[0]])
        np.testing.assert_allclose(after, A @ x + B * u, rtol=0, atol=1e-14)
        np.testing.assert_allclose(shift @ after, A @ (shift @ x) + lesson * u, rtol=0, atol=1e-14)


def test_joint_with_shorter_steps():
    """n steps of T/n: the position moves by (n + 1)/(2n) T²/J u, never by the lesson's 0."""
    T, J = 0.01, 0.05
    for n in (2, 5, 10):
        model, data = load("joint")
        model.opt.timestep, data.ctrl[0] = T / n, 1.5
        for _ in range(n):
            mujoco.mj_step(model, data)
        np.testing.assert_allclose(data.qpos[0], (n + 1) / (2 * n) * T * T / J * 1.5, atol=1e-15)
        np.testing.assert_allclose(data.qvel[0], T / J * 1.5, atol=1e-14)


def test_pendulum_equation():
    model, data = load("pendulum")
    for theta, speed, u in [(0.3, -1.0, 2.0), (-1.2, 4.0, -5.0), (0.0, 0.0, 1.0)]:
        data.qpos[0], data.qvel[0], data.ctrl[0] = theta, speed, u
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.qacc[0], G * np.sin(theta) - 0.01 * speed + u, atol=1e-7)
    assert abs(np.arcsin(5 / G) - 0.535) < 5e-4


def test_cartpole_equations():
    """The two accelerations as Barto, Sutton and Anderson print them, without friction."""
    model, data = load("cartpole")
    m, total, half = 0.1, 1.1, 0.5
    for theta, speed, force in [(0.4, -1.5, 7.0), (-0.9, 3.0, -10.0), (0.1, 0.0, 0.0)]:
        data.qpos[:], data.qvel[:], data.ctrl[0] = [0.3, theta], [0.7, speed], force
        mujoco.mj_forward(model, data)
        sin, cos = np.sin(theta), np.cos(theta)
        push = (force + m * half * speed**2 * sin) / total
        pole = (G * sin - cos * push) / (half * (4 / 3 - m * cos**2 / total))
        cart = push - m * half * pole * cos / total
        np.testing.assert_allclose(data.qacc, [cart, pole], rtol=1e-9)


def test_arm2_equations():
    """Mass matrix, velocity terms, gravity and tool of the textbook's arm, in closed form."""
    model, data = load("arm2")
    l, c, m1, m2 = 0.5, 0.25, 2.0, 1.0
    I1, I2, armature = m1 * l**2 / 12, m2 * l**2 / 12, 0.01
    rng = np.random.default_rng(1)
    for _ in range(5):
        q, v = rng.uniform(-2, 2, 2), rng.uniform(-3, 3, 2)
        data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, [3.0, -2.0]
        mujoco.mj_forward(model, data)
        M22 = m2 * c**2 + I2
        M12 = M22 + m2 * l * c * np.cos(q[1])
        M11 = m1 * c**2 + I1 + m2 * (l**2 + 2 * l * c * np.cos(q[1])) + M22
        M = np.array([[M11 + armature, M12], [M12, M22 + armature]])
        h = -m2 * l * c * np.sin(q[1])
        velocity = [h * v[1] * (2 * v[0] + v[1]), -h * v[0] ** 2]
        outer = m2 * c * G * np.cos(q[0] + q[1])
        gravity = [(m1 * c + m2 * l) * G * np.cos(q[0]) + outer, outer]
        acceleration = np.linalg.solve(M, data.ctrl - velocity - gravity - 0.1 * v)
        np.testing.assert_allclose(data.qacc, acceleration, rtol=1e-9)
        reach, rise = l * np.cos(q[0]) + l * np.cos(q.sum()), l * np.sin(q[0]) + l * np.sin(q.sum())
        np.testing.assert_allclose(data.site("tool").xpos, [reach, 0, 1.2 + rise], atol=1e-12)


@pytest.mark.parametrize("name", ARMS)
def test_arm_kinematics_and_inertials(name):
    """Tool pose, centres of mass and inertias at random poses from the published tables."""
    frames, masses, centres, inertias = ARMS[name]
    model, data = load(name)
    rng = np.random.default_rng(2)
    for _ in range(5):
        q = rng.uniform(*model.jnt_range.T)
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        poses = frames(q)
        np.testing.assert_allclose(data.site("tool").xpos, poses[-1][:3, 3], atol=1e-12)
        np.testing.assert_allclose(
            data.site("tool").xmat.reshape(3, 3), poses[-1][:3, :3], atol=1e-12
        )
        for body in range(model.nv):
            pose, axes = poses[body], data.ximat[body + 1].reshape(3, 3)
            assert model.body_mass[body + 1] == masses[body]
            np.testing.assert_allclose(
                data.xipos[body + 1], (pose @ [*centres[body], 1])[:3], atol=1e-12
            )
            np.testing.assert_allclose(
                axes @ np.diag(model.body_inertia[body + 1]) @ axes.T,
                pose[:3, :3] @ tensor(inertias[body]) @ pose[:3, :3].T,
                atol=1e-12,
            )


@pytest.mark.parametrize("name", ARMS)
def test_arm_gravity(name):
    """Holding torque at home: the gradient of the tables' potential energy."""
    frames, masses, centres, _ = ARMS[name]
    _, data = load(name)

    def energy(q):
        heights = [(F @ [*c, 1])[2] for F, c in zip(frames(q), centres, strict=True)]
        return G * np.dot(masses, heights)

    e = 1e-5 * np.eye(data.qpos.size)
    torque = [(energy(data.qpos + d) - energy(data.qpos - d)) / 2e-5 for d in e]
    np.testing.assert_allclose(data.qfrc_bias, torque, atol=1e-7)


def test_quadrotor():
    """Hover at m g/4, the firmware's mixing of thrusts into torques, the published inertia."""
    model, data = load("quadrotor")
    assert (model.nq, model.nv) == (7, 6)
    data.ctrl[:] = 0.028 * G / 4
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qacc, 0, atol=1e-10)
    np.testing.assert_allclose(model.key("home").ctrl, 0.028 * G / 4, rtol=1e-12)
    arm, drag = 0.046 / np.sqrt(2), 0.005964552
    mixing = np.array(
        [[0] * 4, [0] * 4, [1] * 4,
         arm * np.array([-1, -1, 1, 1]),  # roll: the left motors, 3 and 4, lift the left side
         arm * np.array([-1, 1, 1, -1]),  # pitch: the back motors, 2 and 3, push the nose down
         drag * np.array([-1, 1, -1, 1])]
    )  # fmt: skip
    for motor in range(4):
        data.ctrl[:] = 0.1 * np.eye(4)[motor]
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(data.qfrc_actuator, 0.1 * mixing[:, motor], atol=1e-14)
    axes = data.ximat[1].reshape(3, 3)
    inertia = [16.571710, 16.655602, 29.261652, 0.830806, 0.718277, 1.800197]
    np.testing.assert_allclose(
        axes @ np.diag(model.body_inertia[1]) @ axes.T, 1e-6 * tensor(inertia), atol=1e-16
    )


@pytest.mark.parametrize("name", TABLE)
def test_mjx_takes_it(name):
    from mujoco import mjx

    model, _ = load(name)
    on_device = mjx.put_model(model)
    assert (on_device.nq, on_device.nv, on_device.nu) == (model.nq, model.nv, model.nu)
