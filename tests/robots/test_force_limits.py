"""Limits of forces of servos, joints and tendons as rows of the MPC, beside MuJoCo's C engine."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.robots.force_limits import ForceLimits, force_limits, stopping_limits

SERVO = """<mujoco><option gravity="0 0 0" integrator="implicitfast"/><worldbody><body>
<joint name="j" axis="0 0 1"/><geom type="capsule" fromto="0 0 0 1 0 0" size=".02" mass="3"/></body>
</worldbody><actuator><position joint="j" kp="200" kv="20" ctrlrange="-1.2 1.2" forcerange="-3 3"/>
</actuator></mujoco>"""

# Two links; a servo with a gear, two motors and a damper on one joint, a servo at a fixed tendon.
SEVERAL = """<mujoco><worldbody><body><joint name="a" axis="0 1 0" actuatorfrcrange="-5 4"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1"/><body pos=".3 0 0">
<joint name="b" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .2 0 0" size=".02" mass=".5"/>
</body></body></worldbody><tendon><fixed name="t" actuatorfrcrange="-2 2.5"><joint joint="a"
coef="1"/><joint joint="b" coef="-.5"/></fixed></tendon><actuator><position name="p" joint="b"
kp="30" kv="2" gear="3" forcerange="-6 7"/><motor joint="a" ctrlrange="-9 9"/><damper joint="a"
kv="1.5" ctrlrange="0 2"/><velocity tendon="t" kv="4" ctrlrange="-1 1"/></actuator></mujoco>"""


def loaded(text, **given):
    return jm.load_robot(mujoco.MjModel.from_xml_string(text), **given)


def forces_in_c(model, x, u):
    """Forces of actuators, joints and tendons of a model without limits, by the C engine."""
    model = mujoco.MjModel.from_xml_string(model)
    model.actuator_forcelimited[:] = model.jnt_actfrclimited[:] = model.tendon_actfrclimited[:] = 0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = np.split(x, 2)
    data.ctrl[:] = u
    mujoco.mj_forward(model, data)
    return data.actuator_force.copy(), data.qfrc_actuator.copy()


def test_rows_are_the_forces_of_the_c_engine():
    """Affine in x and u at a linearisation point, and far from it where the force is affine."""
    robot, rng = loaded(SEVERAL), np.random.default_rng(0)
    x0, u0 = 0.3 * rng.normal(size=4), np.zeros(4)
    rows = force_limits(robot, x0, u0)
    assert rows.names == (
        "force of actuator p",
        "force of actuators of joint a",
        "force of actuators of tendon t",
    )
    about = []
    for x, u in [(x0, u0), *((rng.normal(size=4), rng.normal(size=4)) for _ in range(5))]:
        of_actuators, of_joints = forces_in_c(SEVERAL, x, u)
        value = rows.C @ x + rows.D @ u
        wanted = np.array([of_actuators[0], of_joints[0], of_actuators[3]])
        room = np.array([rows.upper - value, value - rows.lower])
        ends = np.array([[7, 4, 2.5], [6, 5, 2]])
        about.append(np.abs(room - (ends + [[-1], [1]] * wanted)).max(axis=0))
    # (The damper's force is u times a speed: its joint's is affine at u = 0 alone.)
    np.testing.assert_allclose(about[0], 0, atol=1e-8)
    np.testing.assert_allclose(np.array(about)[:, [0, 2]], 0, atol=1e-8)
    assert max(found[1] for found in about) > 0.1


@pytest.mark.long
def test_a_robot_without_such_limits_has_no_rows():
    robot = jm.load_robot("joint")
    assert force_limits(robot, robot.home, np.zeros(1)) is None
    assert jm.robot_mpc(robot, horizon=3).outputs == ()


@pytest.mark.parametrize("integrator", ["implicitfast", "Euler"])
@pytest.mark.parametrize("u", [-1.2, 0.52])
@pytest.mark.slow
def test_a_servo_at_the_limit_of_its_force_moves_as_in_c(integrator, u):
    """MuJoCo's implicit integrators take the slope of a saturated servo as zero."""
    model = mujoco.MjModel.from_xml_string(SERVO.replace("implicitfast", integrator))
    robot, data = jm.load_robot(model), mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.ctrl[:] = 0.5, 0.1, u
    mujoco.mj_step(model, data)
    with jax.enable_x64(True):
        x = robot.plant.bare_step(jnp.array([0.5, 0.1]), jnp.array([u]))
    np.testing.assert_allclose(x, [*data.qpos, *data.qvel], rtol=1e-12)


def test_rows_of_stopping_hold_the_parabola():
    """1 kg m², 3 N m: v² ≤ 2 · 3 (1 − q). The rows are up to 6 % inside of it in v."""
    robot = loaded(SERVO, position=1.0)
    rows = stopping_limits(robot, np.zeros(1), robot.state_limits)
    inertia = np.zeros(1)
    data = mujoco.MjData(robot.mujoco)
    mujoco.mj_forward(robot.mujoco, data)
    mujoco.mj_mulM(robot.mujoco, data, inertia, np.ones(1))
    for room in np.geomspace(2 / 64, 2, 30):
        v = np.sqrt(2 * 3 / inertia[0] * room)
        for sign in (1, -1):
            inside = rows.C @ [sign * (1 - room), sign * 0.94 * v]
            outside = rows.C @ [sign * (1 - room), sign * 1.0001 * v]
            assert np.all(inside <= rows.upper) and not np.all(outside <= rows.upper)


def test_stopping_knows_the_limits_of_tendons():
    """A motor at a fixed tendon of ±3 stops as a servo with that force range does."""
    motor = '<motor tendon="t" ctrlrange="-50 50"/>'
    tendon = '<tendon><fixed name="t" actuatorfrcrange="-3 3"><joint joint="j" coef="1"/></fixed>'
    text = SERVO.replace("</worldbody>", f"</worldbody>{tendon}</tendon>")
    text = text.replace(SERVO[SERVO.index("<position") : SERVO.index("</actuator>")], motor)
    found, wanted = (
        stopping_limits(robot, np.zeros(1), robot.state_limits)
        for robot in (loaded(text, position=1.0), loaded(SERVO, position=1.0))
    )
    np.testing.assert_allclose(found.C, wanted.C, rtol=1e-12)
    np.testing.assert_allclose(found.upper, wanted.upper, rtol=1e-12)


@pytest.mark.slow
def test_plans_of_a_servo_promise_what_the_plant_keeps():
    """The plant needs v²/2a to stop. Where plans of 0.2 s say that they keep all limits it does,
    from all states from which that is possible, and others do not say so."""
    robot = loaded(SERVO, position=1.0)
    mpc = jm.robot_mpc(robot)
    force, _ = mpc.outputs
    assert isinstance(force, ForceLimits) and force.D.tolist() == [[200.0]]
    x0s = np.random.default_rng(1).uniform([-0.9, -3], [0.9, 3], (64, 2))
    run = jm.simulate_many(jm.RobotController(robot, mpc), robot, x0s, 60)
    kept = np.abs(run.states[:, :, 0]).max(axis=1) < 1
    promised = (run.status[:, 0] == jm.Status.SOLVED) & ~run.fallback[:, 0]
    # 3 N m accelerate the capsule by 2.959 rad/s².
    possible = np.sign(x0s[:, 1]) * x0s[:, 0] + x0s[:, 1] ** 2 / (2 * 2.959) < 1
    assert np.all(kept[possible]) and not np.any(promised & ~kept)
    assert np.mean(promised[possible]) > 0.9 and 0.2 < np.mean(~possible) < 0.5
