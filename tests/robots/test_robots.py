"""Robots against MuJoCo's C engine: steps, linear models, equilibria, limits, bad input."""

import re

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_engine import c_affine, c_state, c_steps, c_transition, data_at

import jaxmpc as jm
from jaxmpc.robots import jaxpr_rewriting
from jaxmpc.robots.configurations import difference, retract

SLOW = ["quadrotor"] + [
    pytest.param(name, marks=pytest.mark.slow)
    for name in ("joint", "pendulum", "cartpole", "arm6", "arm7", "mixed")
]

# A body that flies, carries a ball joint and a hinge with limits and friction, and three motors.
MIXED = """
<mujoco>
  <option timestep="0.002" integrator="Euler"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body pos="0 0 1">
      <freejoint name="base"/>
      <inertial pos=".01 .02 0" mass="2" diaginertia=".02 .03 .04"/>
      <body pos=".3 0 0">
        <joint name="ball" type="ball" damping=".1" range="0 60"/>
        <inertial pos=".1 0 .02" mass="1" diaginertia=".002 .01 .01"/>
        <body pos=".3 0 0">
          <joint name="hinge" axis="0 1 0" range="-60 60" damping=".05" frictionloss=".3"/>
          <inertial pos=".1 0 0" mass=".5" diaginertia=".001 .004 .004"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="hinge" ctrlrange="-2 2"/>
    <motor joint="ball" gear="1 .5 .2" ctrlrange="-1 1"/>
    <motor joint="base" gear="0 0 1 .1 0 .2" ctrlrange="-40 40"/>
  </actuator>
</mujoco>"""

URDF = """
<robot name="two">
  <link name="base"/>
  <link name="upper">
    <inertial><origin xyz=".25 0 0"/><mass value="2"/>
      <inertia ixx="1e-3" iyy=".05" izz=".05" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="package://nowhere/upper.stl"/></geometry></visual>
    <collision><geometry><mesh filename="package://nowhere/upper.stl"/></geometry></collision>
  </link>
  <link name="lower">
    <inertial><origin xyz=".25 0 0"/><mass value="1"/>
      <inertia ixx="1e-3" iyy=".02" izz=".02" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="first" type="revolute"><parent link="base"/><child link="upper"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="2" effort="30" velocity="3"/></joint>
  <joint name="second" type="continuous"><parent link="upper"/><child link="lower"/>
    <origin xyz=".5 0 0"/><axis xyz="0 1 0"/><limit effort="5" velocity="4"/></joint>
</robot>"""


pytestmark = pytest.mark.usefixtures("x64_of_module")


def draw(robot, count, seed=0, stretch=1.0, speed=1.0):
    """Random states, `stretch` times the joint ranges wide, and inputs inside their limits."""
    m, rng = robot.mujoco, np.random.default_rng(seed)
    q = np.tile(robot.home[: m.nq], (count, 1))
    for kind, i, (low, high), limited in zip(
        m.jnt_type, m.jnt_qposadr, m.jnt_range, m.jnt_limited, strict=True
    ):
        if kind in (2, 3):
            low, high = (low, high) if limited else (-1, 1)
            middle, half = (low + high) / 2, stretch * (high - low) / 2
            q[:, i] = rng.uniform(middle - half, middle + half, count)
            continue
        if kind == 0:
            q[:, i : i + 3] = rng.normal(size=(count, 3))
            i += 3
        turn = rng.normal(size=(count, 4))
        q[:, i : i + 4] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
    v = speed * rng.normal(size=(count, m.nv))
    u = rng.uniform(robot.input_limits.lower, robot.input_limits.upper, (count, m.nu))
    return np.hstack([q, v]), u


def assert_transition(robot, x, u, tolerance=1e-6):
    transition = jax.jit(jax.vmap(robot.transition))
    found = transition(x, u)
    for A, B, x_i, u_i in zip(*map(np.asarray, found), x, u, strict=True):
        A_c, B_c = c_transition(robot, x_i, u_i)
        np.testing.assert_allclose(A, A_c, rtol=0, atol=tolerance * np.abs(A_c).max())
        np.testing.assert_allclose(B, B_c, rtol=0, atol=tolerance * np.abs(A_c).max())
        assert np.abs(B).max() > 0
    return transition


@pytest.fixture(scope="module")
def mixed():
    return jm.load_robot(mujoco.MjModel.from_xml_string(MIXED), control_period=0.01)


@pytest.fixture(scope="module")
def arm2():
    return jm.load_robot("arm2")


@pytest.fixture(scope="module")
def quadrotor():
    return jm.load_robot("quadrotor")


@pytest.fixture(scope="module")
def pendulum():
    return jm.load_robot("pendulum")


# --- linear models ---------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", ["joint", "cartpole", "arm2", "arm6", "arm7"])
def test_transition_equals_the_c_engines_at_100_states(name):
    """Joints up to 1.2 times their range wide, so that stops push at some of the states."""
    robot = jm.load_robot(name)
    assert_transition(robot, *draw(robot, 100, stretch=1.2))


@pytest.mark.slow
def test_transition_of_the_pendulum_and_its_inputs(pendulum):
    """100 states, some in the stops. Inputs at their bound and beyond are not clamped: B stays."""
    x, u = draw(pendulum, 100, stretch=1.2)
    transition = assert_transition(pendulum, x, u)
    B = [transition(np.tile(x[:1], (100, 1)), np.full((100, 1), v))[1] for v in (0.0, 5.0, 9.0)]
    np.testing.assert_allclose(B[1], B[0], rtol=1e-12)
    np.testing.assert_allclose(B[2], B[0], rtol=1e-12)


@pytest.mark.slow
def test_transition_with_free_ball_and_hinge_joint(mixed):
    """A flying base, limits of ball and hinge beyond their range, dry friction: 100 states."""
    x, u = draw(mixed, 100, stretch=1.5)
    x[0, 11] = 1.3  # beyond 60° = 1.047
    active = []
    for x_i, u_i in zip(x, u, strict=True):
        data = data_at(mixed.mujoco, x_i, u_i)
        mujoco.mj_forward(mixed.mujoco, data)
        active.append(data.nefc)
    assert max(active) >= 3  # dry friction, both stops
    assert_transition(mixed, x, u)


def far_from_home(robot, sizes):
    """States of the quadrotor turned by these angles (rad) from home, and inputs."""
    x, u = draw(robot, len(sizes), seed=1)
    turns = np.random.default_rng(2).normal(size=(len(sizes), 3))
    turns *= np.array(sizes)[:, None] / np.linalg.norm(turns, axis=1, keepdims=True)
    xi = np.hstack([x[:, :3], turns, x[:, 7:]])
    return np.array([c_state(robot, xi_i) for xi_i in xi]), u


def assert_linear(found, wanted):
    for a, b in zip((found.A, found.B, found.c), wanted, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-7 * max(1e-2, np.abs(b).max()))


@pytest.mark.slow
def test_linear_model_of_the_quadrotor_in_the_chart(quadrotor):
    """Turned by 0.5, 1 and 2 rad from home: A, B, c of the whole period by the C engine, and the
    plant's transition at 100 random orientations."""
    x, u = far_from_home(quadrotor, [0.5, 1.0, 2.0])
    # Hovering, no rate before and after: a derivative that MJX's own quaternions lose (they call a
    # rate below 1e-8 zero).
    x[0, 10:], u[0] = 0.0, quadrotor.equilibrium()[1]
    found = jax.jit(jax.vmap(lambda x, u: quadrotor.linearize(x, u, exact=True)))(x, u)
    for i in range(3):
        wanted = c_affine(quadrotor, x[i], u[i], quadrotor.substeps)
        assert_linear(jax.tree.map(lambda v, i=i: v[i], found), wanted)
    x, u = draw(quadrotor, 100)
    x[:3, 10:], u[:3] = np.array([[0.0], [1e-12], [1e-7]]), quadrotor.equilibrium()[1]
    assert_transition(quadrotor, x, u)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["arm2", "quadrotor"])
def test_frozen_linear_model_is_powers_of_one_step(name):
    """exact=False, and on the way exact=True of the arm, against the C engine."""
    robot = jm.load_robot(name)
    x, u = draw(robot, 3, seed=1) if name == "arm2" else far_from_home(robot, [0.5, 1.0, 2.0])
    both = lambda x, u: [robot.linearize(x, u, exact=exact) for exact in (True, False)]
    exact, powers = jax.tree.map(np.asarray, jax.jit(jax.vmap(both))(x, u))
    for i in range(3):
        at = lambda tree, i=i: jax.tree.map(lambda v: v[i], tree)
        assert_linear(at(exact), c_affine(robot, x[i], u[i], robot.substeps))
        A_1, B_1, c_1 = A, B, c = c_affine(robot, x[i], u[i], 1)
        for _ in range(robot.substeps - 1):
            A, B, c = A_1 @ A, A_1 @ B + B_1, A_1 @ c + c_1
        assert_linear(at(powers), (A, B, c))


@pytest.mark.slow
def test_the_lessons_joint_is_exact():
    """[[1, T], [0, 1]], [[T²/J], [T/J]], a step of the plant to 1e-10."""
    joint = jm.load_robot("joint")
    A, B = np.array([[1, 0.01], [0, 1]]), np.array([[0.002], [0.2]])
    x, u = draw(joint, 20, stretch=0.95)
    both = jax.jit(jax.vmap(lambda x, u: (joint.step(x, u), joint.linearize(x, u))))
    after, system = both(x, u)
    for i in range(20):
        np.testing.assert_allclose(system.A[i], A, atol=1e-12)
        np.testing.assert_allclose(system.B[i], B, atol=1e-12)
        np.testing.assert_allclose(system.c[i], 0, atol=1e-12)
    np.testing.assert_allclose(after, x @ A.T + u @ B.T, rtol=0, atol=1e-10)


# --- steps -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SLOW)
def test_steps_equal_the_c_engines(name, request):
    """100 control periods under random inputs, from states near the stops; the C engine runs by
    itself, but for the warm starts of its constraint solver (they change 1e-7)."""
    robot = request.getfixturevalue("mixed") if name == "mixed" else jm.load_robot(name)
    start, _ = draw(robot, 1, seed=3, stretch=0.9, speed=0.3)
    u = np.random.default_rng(4).uniform(
        robot.input_limits.lower, robot.input_limits.upper, (100, robot.m)
    )
    run = jax.jit(lambda x, u: jax.lax.scan(lambda x, u: (robot.step(x, u),) * 2, x, u)[1])
    states, m = np.asarray(run(start[0], u)), robot.mujoco
    assert np.all(np.isfinite(states))
    data, size = data_at(m, start[0], u[0]), 1 + np.abs(states).max()
    for u_t, x_t in zip(u, states, strict=True):
        data.ctrl = u_t
        for _ in range(robot.substeps):
            data.qacc_warmstart = 0
            mujoco.mj_step(m, data)
        error = np.abs(np.concatenate([data.qpos, data.qvel]) - x_t)
        assert error.max() <= 1e-9 * size
    if name == "quadrotor":
        np.testing.assert_allclose(np.linalg.norm(states[:, 3:7], axis=1), 1, atol=1e-12)


# --- configurations --------------------------------------------------------------------------


@pytest.mark.slow
def test_retract_and_difference_are_mujocos(mixed):
    """mj_integratePos and mj_differentiatePos, for large, tiny and no rotations; derivatives."""
    m, joints, rng = mixed.mujoco, mixed.joints, np.random.default_rng(0)
    x, _ = draw(mixed, 12)
    go = jax.jit(lambda q, d: retract(joints, q, d))
    back = jax.jit(lambda q, p: difference(joints, q, p))
    for i, q in enumerate(x[:, : m.nq]):
        d = rng.normal(size=m.nv) * [1.0, 1e-3, 1e-4, 1e-5, 1e-8, 0.0][i % 6]
        moved, found = q.copy(), np.zeros(m.nv)
        mujoco.mj_integratePos(m, moved, d, 1.0)
        np.testing.assert_allclose(go(q, d), moved, rtol=0, atol=1e-14)
        mujoco.mj_differentiatePos(m, found, 1.0, q, moved)
        # The C engine loses digits below 1e-8; the motion that was put in is known.
        np.testing.assert_allclose(back(q, moved), d, rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(back(q, moved), found, rtol=0, atol=1e-12)
        moved[3:11] *= -1  # q and −q are one orientation
        np.testing.assert_allclose(back(q, moved), d, rtol=1e-9, atol=1e-15)
    q, zero = x[0, : m.nq], np.zeros(m.nv)
    for mode in (jax.jacfwd, jax.jacrev):
        identity = mode(lambda d: difference(joints, q, retract(joints, q, d)))(zero)
        np.testing.assert_allclose(identity, np.eye(m.nv), atol=1e-12)
    assert np.all(np.isfinite(jax.hessian(lambda d: jnp.sum(retract(joints, q, d)))(zero)))
    # Derivatives on both sides of the switch to the series, at 1e-4 rad.
    for size in (0.99e-4, 1.01e-4):
        d = np.zeros(m.nv)
        d[3:6] = size * np.array([0.6, 0.0, 0.8])
        eye = jax.jacfwd(lambda d: difference(joints, q, retract(joints, q, d)))(d)
        np.testing.assert_allclose(eye, np.eye(m.nv), atol=1e-10)


def test_coordinates_and_state_are_inverse(quadrotor, arm2):
    x, _ = draw(quadrotor, 10)
    back = jax.jit(jax.vmap(lambda x: quadrotor.state(quadrotor.coordinates(x))))(x)
    same = np.sign(np.sum(np.asarray(back)[:, 3:7] * x[:, 3:7], axis=1, keepdims=True))
    x[:, 3:7] *= same  # q and −q are one orientation
    np.testing.assert_allclose(back, x, atol=1e-13)
    np.testing.assert_allclose(quadrotor.coordinates(quadrotor.home)[3:6], 0, atol=1e-15)
    np.testing.assert_array_equal(arm2.coordinates(arm2.home), arm2.home)
    assert (quadrotor.n, quadrotor.m, quadrotor.state_size) == (12, 4, 13)
    assert quadrotor.state_names[3] == "free rotation x" and quadrotor.state_units[3] == "rad"


@pytest.mark.slow
def test_equilibrium_stays_put(mixed):
    """Of every model: forces balance by mj_forward, and 1 s of the C engine moves nothing."""
    for name in ("joint", "pendulum", "cartpole", "arm2", "arm6", "arm7", "quadrotor"):
        robot = jm.load_robot(name)
        m = robot.mujoco
        x, u = robot.equilibrium()
        data = data_at(m, x, u)
        mujoco.mj_forward(m, data)
        # Motors of the pendulum and the quadrotor are small: accelerations, not forces.
        np.testing.assert_allclose(data.qacc, 0, atol=1e-9)
        if name not in ("pendulum", "cartpole"):  # those fall, by rounding
            np.testing.assert_allclose(c_steps(m, x, u, 200), x, atol=1e-9)
    with pytest.raises(ValueError, match="no input balances the forces"):
        mixed.equilibrium()


def test_inverse_dynamics_gives_the_acceleration(arm2):
    """Against mj_forward of the predictor, for many at once."""
    x, u = draw(arm2, 6)
    q, v = x[:, :2], x[:, 2:]
    a = np.random.default_rng(5).normal(size=(6, 2))
    found = arm2.inverse_dynamics(q, v, a)
    for i in range(6):
        data = data_at(arm2.predictor.model, x[i], found[i])
        mujoco.mj_forward(arm2.predictor.model, data)
        np.testing.assert_allclose(data.qacc, a[i], atol=1e-9)
    assert arm2.inverse_dynamics(q.reshape(2, 3, 2), v.reshape(2, 3, 2), a.reshape(2, 3, 2)).shape
    servo = jm.load_robot(mujoco.MjModel.from_xml_string("""
        <mujoco><worldbody><body><joint name="a" axis="0 1 0"/>
        <geom size=".1" pos=".5 0 0" mass="1"/></body></worldbody>
        <actuator><position joint="a" kp="100" kv="3"/></actuator></mujoco>"""))  # fmt: skip
    x, u = servo.equilibrium([0.3])
    # kp (u − q) = gravity's torque; MuJoCo's y axis turns x downward: −m g l cos q.
    np.testing.assert_allclose(100 * (u - 0.3), -9.81 * 0.5 * np.cos(0.3), rtol=1e-9)


@pytest.mark.parametrize("name", ["arm2", "arm7"])
def test_trajectory_followed_open_loop(name):
    """A slow motion: its inputs alone keep the C engine's predictor on it for a second, though
    errors grow by e^(4 t) with the arm up."""
    robot = jm.load_robot(name)
    t = robot.dt * np.arange(301)
    shape = 0.2 * np.sin(np.pi * t / 3)[:, None] ** 2 * np.linspace(1, -1, robot.m)
    states, inputs = robot.trajectory(robot.home[: robot.m] + shape)
    assert states.shape == (301, robot.n) and inputs.shape == (301, robot.m)
    x = states[0]
    for k in range(100):
        assert np.abs(x - states[k])[: robot.m].max() < 0.01
        x = c_steps(robot.predictor.model, x, inputs[k], robot.substeps)
    assert np.abs(shape[99]).max() > 0.14


# --- variations ------------------------------------------------------------------------------


@pytest.mark.slow
def test_varied_robots_are_other_models():
    """Masses, damping and a payload under vmap, 100 control periods into the stops and back under
    random inputs, against files edited and compiled by MuJoCo."""
    arm2 = jm.load_robot("arm2", control_period=0.005)
    x, _ = draw(arm2, 4, seed=6, stretch=0.9, speed=0.3)
    inputs = np.random.default_rng(4).uniform(-1, 1, (100, 2)) * arm2.input_limits.upper
    payloads, dampings = np.array([0.0, 0.3, 1.0, 4.0]), np.array([0.1, 0.2, 0.5, 1.0])
    masses = np.asarray(arm2.mujoco.body_mass) * np.array([[1.0], [1.1], [0.8], [1.5]])

    def run(x, mass, damping, load):
        robot = arm2.vary(body_mass=mass, dof_damping=jnp.full(2, damping), payload=load)
        return jax.lax.scan(lambda x, u: (robot.step(x, u),) * 2, x, inputs)[1]

    found = np.asarray(jax.jit(jax.vmap(run))(x, masses, dampings, payloads))
    stops = 0
    for i, (mass, damping, load) in enumerate(zip(masses, dampings, payloads, strict=True)):
        spec = mujoco.MjSpec.from_file(jm.__path__[0] + "/robots/models/arm2.xml")
        for body, value in zip(spec.bodies[1:], mass[1:], strict=True):
            body.mass = value
        for joint in spec.joints:
            joint.damping = [damping, 0, 0]
        if load:
            weld(spec, load)
        edited, after = spec.compile(), x[i]
        # The inverse weights, which scale the softness of stops, are documented to stay.
        edited.dof_invweight0 = arm2.mujoco.dof_invweight0
        for u_t, x_t in zip(inputs, found[i], strict=True):
            stops += np.any(np.abs(after[:2]) > arm2.state_limits.upper[:2])
            after = c_steps(edited, after, u_t, arm2.substeps)
            np.testing.assert_allclose(x_t, after, rtol=0, atol=1e-8)
        assert np.abs(after - found[0][-1]).max() > 1e-2 or not i
    assert stops > 10


def weld(spec, mass):
    """A point mass at the site "tool"."""
    site = spec.site("tool")
    point = site.parent.add_body(pos=site.pos)
    point.explicitinertial, point.mass = True, mass
    point.ipos, point.inertia = [0.0, 0.0, 0.0], [1e-12] * 3


@pytest.mark.slow
def test_payload_on_an_arm_in_space():
    """The flange's inertia has products and is turned: principal axes by our own code."""
    arm7 = jm.load_robot("arm7")
    x, u = draw(arm7, 3, seed=7, stretch=0.9)
    loads = np.array([0.2, 1.0, 3.0])
    found = jax.jit(jax.vmap(lambda x, u, load: arm7.vary(payload=load).step(x, u)))(x, u, loads)
    for i, load in enumerate(loads):
        spec = mujoco.MjSpec.from_file(jm.__path__[0] + "/robots/models/arm7.xml")
        weld(spec, load)
        after = c_steps(spec.compile(), x[i], u[i], arm7.substeps)
        np.testing.assert_allclose(found[i], after, rtol=0, atol=1e-9)


SPHERE = """<mujoco><option jacobian="sparse"/><worldbody><geom type="plane" size="3 3 .1"/>
<body pos="0 0 .099"><freejoint/>{}<geom type="sphere" size=".1" mass="1"/></body>
<body pos="1 0 1"><joint name="1" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 .4 0 0" size=".02"/></body>
</worldbody><actuator><motor joint="1"/></actuator></mujoco>"""


@pytest.mark.long
def test_numbers_may_fill_what_is_zero_in_a_sparse_file():
    """A sphere in contact whose centre of mass is moved: its inertia is no longer diagonal."""
    mass = '<inertial pos=".03 0 .03" mass="1" diaginertia=".004 .004 .004"/>'
    plain, moved = (mujoco.MjModel.from_xml_string(SPHERE.format(part)) for part in ("", mass))
    for name in ("body_invweight0", "dof_invweight0"):  # `vary` keeps those of the file
        getattr(moved, name)[:] = getattr(plain, name)
    robot = jm.load_robot(plain)
    x = np.concatenate([robot.home[:8], [1, 0, -0.1, 0, 0.5, 0.3, 0.2]])
    places = np.array(plain.body_ipos)
    places[1] = 0.03, 0, 0.03
    with jax.enable_x64(True):
        found = robot.vary(body_ipos=places).step(x, np.zeros(1))
    after = c_steps(moved, x, np.zeros(1), robot.substeps)
    np.testing.assert_allclose(found, after, rtol=0, atol=1e-12)


# --- derivatives -----------------------------------------------------------------------------


@pytest.mark.slow
def test_reverse_mode_through_an_active_stop():
    """A control period in the stop: reverse mode = finite differences through the C engine, in x,
    u and the mass."""
    assert_gradient(["reverse"])


@pytest.mark.slow
def test_forward_mode_through_an_active_stop():
    assert_gradient(["forward", "both"])


def assert_gradient(modes):
    pendulum = jm.load_robot("pendulum", control_period=0.005)
    x, u = np.array([1.6, 0.5]), np.array([2.0])
    mass = np.asarray(pendulum.mujoco.body_mass, float)
    weights = np.array([1.0, 0.3])
    end = lambda x, u, mass: weights @ pendulum.vary(body_mass=mass).step(x, u)

    def c_end(x, u, mass):
        model = mujoco.MjModel.from_xml_path(jm.__path__[0] + "/robots/models/pendulum.xml")
        model.body_mass = mass  # the inverse weights stay those of the file, as in `vary`
        return weights @ c_steps(model, x, u, pendulum.substeps)

    assert c_steps(pendulum.mujoco, x, u, pendulum.substeps)[0] > 1.5708  # pushed all the time
    at, names = [x, u, mass], (0, 1, 2)
    derivative = {
        "reverse": jax.grad(end, names), "forward": jax.jacfwd(end, names),
        "both": jax.jacfwd(lambda *at: jax.grad(end, names)(*at)),
    }  # fmt: skip
    for mode in modes:
        found = jax.jit(derivative[mode])(*at)
        if mode == "both":  # second derivatives
            assert np.all(np.isfinite(found[0])) and np.abs(found[0]).max() > 0
            continue
        for i, g in enumerate(found):
            for j in range(len(at[i])):
                d = 1e-6 * (np.arange(len(at[i])) == j)
                up, down = (c_end(*at[:i], at[i] + s * d, *at[i + 1 :]) for s in (1, -1))
                np.testing.assert_allclose(g[j], (up - down) / 2e-6, rtol=1e-6, atol=1e-8)
        assert np.abs(found[2][1]) > 1e-4


WRAPS = {
    "jit": jax.jit,
    "forward mode": lambda f: jax.jit(jax.vmap(jax.jacfwd(f), in_axes=(0, None))),
    "values": lambda f: f,
    "vmap": lambda f: jax.vmap(f, in_axes=(0, None)),
}


@pytest.mark.cpu
@pytest.mark.parametrize("wrap", WRAPS)
@pytest.mark.first(2)
def test_in_pieces_changes_nothing(monkeypatch, wrap):
    """As on the old jaxlibs: values, vmap, jit, forward mode, conditionals, constants."""
    monkeypatch.setattr(jaxpr_rewriting, "JAXLIB", (0, 10, 2))
    table = np.arange(5.0)

    def function(x, tree):
        y = jax.lax.cond(x[0] > 0, lambda v: jnp.sin(v), lambda v: 2 * v, x)
        for i in range(9):
            y = y * jnp.cos(x + i) + tree["a"] @ y + table[:3]
        body = lambda c: (c[0] + 1, c[1] * 1.1)
        return {"y": jax.lax.while_loop(lambda c: c[0] < 4, body, (0, y))[1], "same": x}

    pieces = jaxpr_rewriting.in_pieces(function, size=4)
    x, tree = np.array([0.3, -0.2, 0.7]), {"a": np.eye(3) * 0.1}
    text = str(jax.make_jaxpr(pieces)(x, tree))
    assert text.count("optimization_barrier") > 5
    batch = np.stack([x, -x, 2 * x])
    args = (x if wrap in ("values", "jit") else batch), tree
    found = (jax.tree.leaves(WRAPS[wrap](f)(*args)) for f in (pieces, function))
    for a, b in zip(*found, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-15)


@pytest.mark.slow
def test_physics_in_pieces(monkeypatch, pendulum):
    monkeypatch.setattr(jaxpr_rewriting, "JAXLIB", (0, 10, 2))
    x, u = np.array([1.6, 0.4]), np.array([1.0])
    after = jax.jit(pendulum.plant.step)(x, u)
    np.testing.assert_allclose(after, c_steps(pendulum.mujoco, x, u, 1), atol=1e-12)


# --- files and bad input ---------------------------------------------------------------------


def single(option="", joint="", actuator='<motor joint="a"/>', extra="", world=""):
    """A ball on one hinge."""
    return (
        f'<mujoco><option timestep="0.01" {option}/>{extra}<worldbody>{world}<body><joint name="a" '
        f'{joint}/><geom size=".1" pos=".3 0 0"/></body></worldbody><actuator>{actuator}'
        "</actuator></mujoco>"
    )


def load(text, tmp_path=None, suffix=".xml", **options):
    if tmp_path is None:
        return jm.load_robot(mujoco.MjModel.from_xml_string(text), **options)
    path = tmp_path / f"robot{suffix}"
    path.write_text(text)
    return jm.load_robot(path, **options)


def test_urdf_gets_motors_and_limits_and_no_meshes(tmp_path):
    robot = load(URDF, tmp_path, ".urdf")
    np.testing.assert_array_equal(robot.input_limits.upper, [30, 5])
    np.testing.assert_array_equal(robot.input_limits.lower, [-30, -5])
    np.testing.assert_array_equal(robot.state_limits.lower, [-1, -np.inf, -3, -4])
    np.testing.assert_array_equal(robot.state_limits.upper, [2, np.inf, 3, 4])
    assert robot.input_names == ("first torque", "second torque") and robot.input_units == (
        "N m",
        "N m",
    )
    # Gravity at rest, both rods along x: by hand, about y.
    _, u = robot.equilibrium([0.0, 0.0])
    np.testing.assert_allclose(u, [-9.81 * (2 * 0.25 + 0.75), -9.81 * 0.25], rtol=1e-9)
    narrow = load(URDF, tmp_path, ".urdf", velocity=1, torque=(-2, 3), position=([-1, -2], 2))
    np.testing.assert_array_equal(narrow.state_limits.lower, [-1, -2, -1, -1])
    np.testing.assert_array_equal(narrow.input_limits.upper, [3, 3])


def test_limits_are_the_narrowest_of_the_file():
    """Gear −2: force 10 u in [−6, 7] and joint torque in [−4, 4] leave |u| ≤ 2."""
    motor = '<motor joint="a" gear="-2" ctrlrange="-10 10" forcerange="-6 7"/>'
    robot = load(single(joint='actuatorfrcrange="-4 4"', actuator=motor))
    np.testing.assert_array_equal(robot.input_limits.lower, [-2])
    np.testing.assert_array_equal(robot.input_limits.upper, [2])
    assert not robot.mujoco.actuator_forcelimited[0] and not robot.mujoco.jnt_actfrclimited[0]
    given = load(single(joint='range="-90 90"'), home=[0.5], timestep=0.002, control_period=0.02)
    np.testing.assert_array_equal(given.home, [0.5, 0])
    assert given.substeps == 10 and given.dt == 0.02
    np.testing.assert_allclose(given.state_limits.upper, [np.pi / 2, np.inf])


@pytest.mark.slow
def test_contacts_act_in_the_plant_only():
    """A box falls onto a plane: the plant rests on it, the linear model falls on, as documented."""
    robot = load("""
        <mujoco><option timestep="0.002"/>
        <worldbody><geom type="plane" size="2 2 .1"/>
        <body pos="0 0 .1"><joint type="slide" axis="0 0 1"/>
        <geom type="box" size=".1 .1 .1" mass="1"/></body></worldbody>
        <actuator><motor joint="lift" ctrlrange="-20 20"/></actuator>
        </mujoco>""".replace('axis="0 0 1"', 'name="lift" axis="0 0 1"'))  # fmt: skip
    x, u = np.zeros(2), np.zeros(1)
    after = np.asarray(jax.jit(robot.step)(x, u))
    predicted = robot.linearize(x, u, exact=True).step(x, u)
    np.testing.assert_allclose(predicted[1], -9.81 * robot.dt, rtol=1e-9)
    assert np.abs(after[1]) < 0.3 * 9.81 * robot.dt
    np.testing.assert_allclose(after, c_steps(robot.mujoco, x, u, robot.substeps), atol=1e-6)


BAD_FILES = {
    "broken": ("<mujoco><worldbody>", {}, r"model: .*robot.xml cannot be read: .*Mend the file"),
    "no actuators": (
        single(actuator=""), {}, r"model: robot has no actuators\. Load .*motors=True",
    ),
    "no joints": (
        '<mujoco><worldbody><geom size="1"/></worldbody></mujoco>', {}, "model: .* has no joints",
    ),
    "activation": (
        single('integrator="RK4"', actuator='<general joint="a" dyntype="integrator"/>'), {},
        "model: .* 1 activation states and the integrator RK4. Use another integrator",
    ),
    "integrator": (
        single('integrator="implicit"'), {}, "the integrator implicit, which MJX lacks.*fast",
    ),
    "forces": (
        single(actuator='<motor joint="a" ctrlrange="1 2" forcerange="-.5 .5"/>'), {},
        "torque: is empty: .*Give lower <= upper",
    ),
    "velocity numbers": (
        single(extra='<custom><numeric name="velocity_limit" data="1 2"/></custom>'), {},
        "velocity_limit: 2 numbers in the file, 1 dofs. Give one a dof",
    ),
    "position": (single(), {"position": (1, -1)}, r"position: is empty: lower\[0\] = 1"),
    "velocity": (single(), {"velocity": -2}, r"velocity: -2 is negative. Give v"),
    "torque": (single(), {"torque": ([3], [2])}, r"torque: is empty: lower\[0\] = 3"),
    "sizes": (single(), {"torque": ([1, 2], 3)}, "torque: 2 entries where 1 are needed"),
    "NaN": (single(), {"velocity": np.nan}, "velocity.*NaN"),
    "period": (
        single(), {"control_period": 0.015},
        r"control_period: 0.015 s is no multiple of the physics step 0.01 s\. Give whole",
    ),
    "short period": (single(), {"control_period": 0.001}, "control_period: .*no multiple"),
    "no period": (single(), {"control_period": 0}, "control_period: 0 is not a positive number"),
    "timestep": (single(), {"timestep": -1.0}, "timestep: -1.0 is not a positive number"),
    "home": (single(), {"home": [1, 2]}, r"home: shape \(2,\)"),
}  # fmt: skip


def test_the_switch_for_energy_is_turned_off():
    """It changes no motion, and MJX does not know it: the model steps as MuJoCo's own."""
    xml = """<mujoco><option timestep="0.01"><flag energy="enable"/></option><worldbody><body>
    <joint name="hinge" axis="0 1 0"/><geom size="0.1" mass="1" pos="0 0 0.5"/></body></worldbody>
    <actuator><motor joint="hinge"/></actuator></mujoco>"""
    given = mujoco.MjModel.from_xml_string(xml)
    robot = jm.load_robot(given)
    assert given.opt.enableflags  # the caller's own model stays as it is
    data = mujoco.MjData(given)
    data.qpos[0], data.ctrl[0] = 0.3, 0.7
    mujoco.mj_step(given, data)
    x = robot.step(np.array([0.3, 0.0]), np.array([0.7]))
    np.testing.assert_allclose(x, [data.qpos[0], data.qvel[0]], atol=1e-6)


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_files_are_named(case, tmp_path):
    text, options, message = BAD_FILES[case]
    with pytest.raises(ValueError, match=re.compile(message, re.DOTALL)):
        load(text, tmp_path, **options)


def test_bad_urdf_and_names(tmp_path):
    for text in ("<robot><link", URDF.replace('"3"', '"fast"')):
        with pytest.raises(ValueError, match="model: .* cannot be read: .*Mend the file"):
            load(text, tmp_path, ".urdf")
    for name in ("arm9", "nowhere.xml", tmp_path):
        with pytest.raises(ValueError, match="model: .* is no file. Give a path, or one of joint"):
            jm.load_robot(name)
    with pytest.raises(ValueError, match="model: is an int. Give a name, a path"):
        jm.load_robot(3)


def test_wrong_sizes_are_named(quadrotor, pendulum, arm2):
    tangent = "x: shape .12,. where .13,. is needed. That is the size of the coordinates: robot"
    zero = np.zeros
    for call, message in (
        (lambda: quadrotor.step(zero(12), zero(4)), tangent),
        (lambda: quadrotor.linearize(zero(12), zero(4)), tangent),
        (lambda: quadrotor.transition(zero(12), zero(4)), tangent),
        (lambda: quadrotor.step(zero(11), zero(4)), "x: shape .11,. .* use jax.vmap for many"),
        (lambda: quadrotor.step(zero(13), zero(3)), "u: shape .3,. where .4,. is needed"),
        (lambda: pendulum.equilibrium([1.0, 2.0]), "q: shape .2,.. Give"),
        (lambda: pendulum.equilibrium([np.nan]), "q: holds NaN"),
        (lambda: pendulum.inverse_dynamics([0.0], [0.0, 0], [0.0]), "velocity: shape .2,."),
        (lambda: pendulum.trajectory(zero((2, 1))), "positions: .*K ≥ 3"),
        (
            lambda: pendulum.vary(body_masses=[1.0]),
            "body_masses: is no number that varies. Did you mean body_mass",
        ),
        (lambda: pendulum.vary(body_mass=[1.0]), "body_mass: shape .1,. where .2,. is needed"),
        (lambda: pendulum.vary(body_mass=[1.0, np.nan]), "body_mass: holds NaN"),
        (
            lambda: pendulum.vary(payload=1.0),
            "payload: the robot has no site named tool. Add <site",
        ),
        (lambda: arm2.vary(payload=[1.0, 2.0]), "payload: shape .2,."),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_what_cannot_be_held_is_named(pendulum):
    with pytest.raises(ValueError, match=r"q: .*0\.5.*no input balances .* missing at pole\."):
        jm.load_robot("cartpole").equilibrium([0.0, 0.5])
    with pytest.raises(ValueError, match=r"q: needs torque = .*-8\.25.*limits are \[-5, 5\]"):
        pendulum.equilibrium([1.0])
    with pytest.raises(ValueError, match="needs torque"):
        pendulum.equilibrium([[0.0], [1.0]])


# Of implicitfast from MuJoCo 3.11 on: docs/limits.md.
@pytest.mark.filterwarnings("ignore:robot robot moves otherwise than its file says. joint free")
@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
@pytest.mark.slow
def test_a_hovering_body_feels_its_rates(integrator):
    """At rest d(rotation)/d(rate) is one physics step, not 0: MJX's own integration of quaternions
    has the derivative 0 there, and hover would not be stabilizable."""
    model = jm.load_robot("quadrotor").mujoco
    names = {"Euler": 0, "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST}
    model.opt.integrator = names[integrator]
    robot = jm.load_robot(model)
    with jax.enable_x64(True):
        x, u = map(jnp.asarray, robot.equilibrium())
        rates = jnp.zeros(13).at[10:].set(jnp.array([1.0, -2.0, 0.5]))
        step = lambda x: robot.plant.step(x, u)
        moved = jax.jit(lambda x, d: jax.jvp(step, (x,), (d,))[1])(x, rates)
        h = robot.mujoco.opt.timestep
        np.testing.assert_allclose(moved[3:7], [0, *(h / 2 * rates[10:])], rtol=1e-3, atol=1e-12)


SWING = """<mujoco><worldbody><body gravcomp="1"><joint name="a" axis="0 1 0" range="-60 60"{}/>
<geom size=".1" pos="0 0 -.3"/></body></worldbody>
<actuator><motor name="m" joint="a" ctrlrange="-3 3"/></actuator></mujoco>"""


def test_arguments_that_go_beyond_the_file_are_told(tmp_path):
    file = tmp_path / "swing.xml"
    file.write_text(SWING.format(""))
    assert "beyond" not in str(jm.load_robot(file, torque=2, position=0.5).report())
    with pytest.warns(UserWarning, match=r"wider limits .*: a \(there \[-1.0472, .*\), m \(there"):
        robot = jm.load_robot(file, torque=10, position=(-0.5, 1.5))
    assert "argument, beyond the file's [-3, 3]" in str(robot.report())
    with pytest.warns(UserWarning, match=r"by arguments: m \(there \[-3, 3\]\)\. The plant"):
        jm.load_robot(file, torque=([-1], [4]))


def test_a_stop_that_takes_a_rest_away_is_named_with_its_margin(tmp_path):
    """MuJoCo takes margins in radians, also where angles are in degrees."""
    file = tmp_path / "swing.xml"
    file.write_text(SWING.format(' margin="1"'))
    with pytest.raises(
        ValueError, match=r"\(joint a at 0.8, \[-1.05, 1.05\] less its margin of 1\)"
    ):
        jm.load_robot(file).equilibrium([0.8])


def test_units_of_inputs(tmp_path):
    """Servos of gear 1 take the position or velocity of their joint, in radians also where angles
    are in degrees."""
    file = tmp_path / "units.xml"
    kinds = {
        '<motor joint="a"/>': "N m", '<motor joint="s"/>': "N", '<motor joint="a" gear="2"/>': "",
        '<position joint="a" kp="9"/>': "rad", '<position joint="s" kp="9" kv="1"/>': "m",
        '<velocity joint="a" kv="3"/>': "rad/s", '<position joint="a" kp="9" gear="2"/>': "",
    }  # fmt: skip
    file.write_text(
        '<mujoco><worldbody><body gravcomp="1"><joint name="a" axis="0 1 0"/>'
        '<joint name="s" type="slide"/><geom size=".1"/></body></worldbody>'
        f"<actuator>{''.join(kinds)}</actuator></mujoco>"
    )
    assert jm.load_robot(file).input_units == tuple(kinds.values())
