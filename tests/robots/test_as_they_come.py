"""Models with the defects that models from elsewhere have, written here in a few lines each."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_engine import c_steps, c_transition, data_at
from mujoco.mjx._src import collision_driver

import jaxmpc as jm

GRIPPER = """
<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody>
<body><joint name="finger" type="slide" axis="1 0 0" range="0 0.04"/>
<geom size=".01" mass="0.1"/></body>
<body pos="1 0 0"><joint name="block" type="slide" axis="1 0 0" range="-1 1"/>
<geom size=".01" mass="2" contype="0" conaffinity="0"/></body>
</worldbody><actuator><motor joint="finger" ctrlrange="-1 1"/></actuator>
<keyframe><key name="home" qpos="0.04 0"/></keyframe></mujoco>"""


def load(text, **options):
    return jm.load_robot(mujoco.MjModel.from_xml_string(text), **options)


# --- set-points ------------------------------------------------------------------------------


@pytest.mark.slow
def test_home_at_a_limit_and_an_object_that_nothing_moves():
    """The margin goes at that limit alone; the terminal cost is the LQR's of the finger alone."""
    robot = load(GRIPPER)
    with pytest.warns(UserWarning) as said:
        mpc = jm.robot_mpc(robot, horizon=3, margin=0.1)
    texts = [str(warning.message) for warning in said]
    assert len(texts) == 2
    assert "margin: finger: the target lies at the limit" in texts[0]
    assert "inputs do not move all of block, block velocity" in texts[1]
    np.testing.assert_allclose(mpc.states.lower[:2], [0.002, -0.9])
    np.testing.assert_allclose(mpc.states.upper[:2], [0.04, 0.9])
    finger = jm.LinearSystem(mpc.system.A[::2, ::2], mpc.system.B[::2])
    alone = jm.lqr(finger, mpc.Q[::2, ::2], mpc.R).P
    np.testing.assert_allclose(mpc.terminal_cost[::2, ::2], alone, rtol=1e-9)
    np.testing.assert_array_equal(mpc.terminal_cost[1::2], 0)
    with pytest.raises(ValueError, match="target: has finger = 0.05, limits are"):
        jm.robot_mpc(robot, target=[0.05, 0])


def test_home_beyond_a_limit_is_moved():
    robot = load(GRIPPER.replace("0.04 0", "0.06 0"))
    with pytest.warns(UserWarning, match="home lies beyond the limits of finger, and is moved"):
        x, u = robot.set_point()
    np.testing.assert_array_equal(x, [0.04, 0, 0, 0])
    np.testing.assert_array_equal(u, [0])


def test_the_nearest_configuration_that_can_be_held():
    """A pendulum with m g l = 9.81 N m and a motor of 5: sin θ = 5/9.81. A pole in the air falls
    to the nearest balance, the upright one; the cart stays."""
    x, u = jm.load_robot("pendulum").equilibrium(near=[1.0])
    np.testing.assert_allclose(x, [np.arcsin(5 / 9.81), 0], atol=1e-6)
    np.testing.assert_allclose(u, [-5], atol=1e-6)
    x, u = jm.load_robot("cartpole").equilibrium(near=[0.3, 0.5])
    np.testing.assert_allclose(x, [0.3, 0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(u, [0], atol=1e-6)
    # Beyond the stops at ±π/2 gravity is stationary: no small motion needs less torque.
    x, u = jm.load_robot("pendulum").equilibrium(near=[-4.0])
    np.testing.assert_allclose(x, [-np.arcsin(5 / 9.81), 0], atol=1e-6)
    hung = jm.load_robot("quadrotor")  # upside down, where rotors push it into the ground
    x, u = hung.equilibrium(near=[0.0, 0, 1, 0, 1, 0, 0])
    data = data_at(hung.mujoco, x, u)
    mujoco.mj_forward(hung.mujoco, data)
    np.testing.assert_allclose(data.qacc, 0, atol=1e-5)
    arm = jm.load_robot("arm2", torque=([-3.0, -1.0], [3.0, 1.0]))
    x, u = arm.equilibrium(near=arm.home[:2])
    assert np.all(np.abs(u) <= [3, 1]) and np.abs(x - arm.home).max() > 0.1
    data = data_at(arm.mujoco, x, u)
    mujoco.mj_forward(arm.mujoco, data)
    np.testing.assert_allclose(data.qacc, 0, atol=1e-5)
    with pytest.raises(ValueError, match="near: is given beside q. Give one"):
        arm.equilibrium([0.0, 0.0], near=[0.0, 0.0])
    with pytest.raises(ValueError, match=r"near: shape \(3,\) where \(2,\)"):
        arm.equilibrium(near=[0.0] * 3)


ARM = """
<mujoco><compiler angle="radian"/><worldbody>
<body><joint name="first" axis="0 1 0" range="-2 2"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="{mass}" contype="0" conaffinity="0"/>
<body pos=".3 0 0"><joint name="second" axis="0 1 0" range="-2 2"/>
<geom type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="{mass}" contype="0" conaffinity="0"/>
</body></body></worldbody><actuator><motor joint="first" gear="{gear}" ctrlrange="-{u} {u}"/>
{second}</actuator></mujoco>"""


@pytest.mark.parametrize("mass", [1.0, 2.0**-20, 2.0**-34])
def test_no_unit_of_forces_decides_what_rests(mass):
    """Arms of kilograms, of milligrams and lighter, in inputs of N m or of their own size."""
    for gear in (mass, 1.0):
        u = 10 * mass / gear
        second = f'<motor joint="second" gear="{gear}" ctrlrange="-{u} {u}"/>'
        arms = [
            load(ARM.format(mass=mass, gear=gear, u=u * share, second=text))
            for share, text in ((1, second), (1, ""), (0.2, second))
        ]
        q, weight = np.array([0.5, 0.4]), 9.81 * mass
        needed = weight * 0.15 * np.cos(0.9)
        held = [weight * 0.45 * np.cos(0.5) + needed, needed]
        x, found = arms[0].equilibrium(q)
        np.testing.assert_allclose(x[:2], q)
        np.testing.assert_allclose(found * gear, [-v for v in held], rtol=1e-9)
        text = f"no input balances the forces; {needed:.3g} are missing at second"
        text = text.replace("+", r"\+")
        with pytest.raises(ValueError, match=f"^q: .*{text}"):
            arms[1].equilibrium(q)
        with pytest.raises(ValueError, match=f"^target: .*{text}"):
            arms[1].set_point(q)
        with pytest.raises(ValueError, match=f"^target: .*{text}"):
            jm.robot_mpc(arms[1], target=q)
        with pytest.raises(ValueError, match="^target: needs u1 = "):
            arms[2].set_point(q)
        x, found = arms[2].equilibrium(near=q)
        data = data_at(arms[2].mujoco, x, found)
        mujoco.mj_forward(arms[2].mujoco, data)
        np.testing.assert_allclose(data.qacc, 0, atol=1e-4)
        nothing = np.zeros(2)
        np.testing.assert_allclose(
            arms[0].inverse_dynamics(q, nothing, nothing) * gear, [-v for v in held], rtol=1e-9
        )
        with pytest.raises(ValueError, match="no input balances the forces"):
            arms[1].inverse_dynamics(q, nothing, nothing)


LIFT = """
<mujoco><compiler angle="radian"/><option gravity="0 0 {g}"/><worldbody>
<body><joint name="slide" type="slide" axis="0 0 1"/><geom type="sphere" size="{r}" mass="{two}"/>
<body><joint name="turn" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 {reach} 0 0" size="{r}" mass="{one}"/></body>
</body></worldbody><actuator>
<motor joint="slide" ctrlrange="-{a} {a}"/><motor joint="slide" ctrlrange="-{b} {b}"/>
<motor joint="turn" ctrlrange="-{c} {c}"/><motor joint="turn" ctrlrange="-{d} {d}"/>
</actuator></mujoco>"""


def test_no_unit_of_length_or_mass_decides_how_inputs_share_a_load():
    """A lift and a hinge with two motors each: N beside N m."""

    def shares(length, mass):
        force, torque = mass * length, mass * length**2
        text = LIFT.format(
            g=-9.81 * length, r=0.02 * length, reach=0.4 * length, one=mass, two=2 * mass,
            a=100 * force, b=50 * force, c=1.5 * torque, d=40 * torque,
        )  # fmt: skip
        _, u = load(text).equilibrium(np.zeros(2))
        return u / np.array([force, force, torque, torque])

    expected = shares(1.0, 1.0)
    np.testing.assert_allclose(expected[:2].sum(), 3 * 9.81, rtol=1e-12)
    np.testing.assert_allclose(expected[2:].sum(), -0.2 * 9.81, rtol=1e-12)
    assert abs(expected[2]) < abs(expected[3])  # the weak motor takes less
    for length, mass in ((64.0, 1.0), (1 / 64, 1024.0), (1000.0, 1e-3)):
        np.testing.assert_allclose(shares(length, mass), expected, rtol=1e-9)


WALKER = """
<mujoco><worldbody><geom type="plane" size="2 2 .1"/>
<body pos="0 0 .3"><freejoint name="root"/><geom size=".1" mass="3"/>
<body pos=".2 0 0"><joint name="leg" axis="0 1 0" range="-60 60"/>
<geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".5"/></body></body>
</worldbody><actuator><motor joint="leg" ctrlrange="-5 5"/></actuator></mujoco>"""


@pytest.mark.slow
def test_what_only_the_ground_can_hold_is_named():
    robot = load(WALKER)
    weight = "34.3 are missing at root z"
    with pytest.raises(ValueError, match=f"near: no configuration that can be held .*{weight}"):
        robot.equilibrium(near=robot.home[:8])
    with pytest.warns(UserWarning, match=f"no input holds home or .*{weight}.*does not rest"):
        x, u = robot.set_point()
    np.testing.assert_array_equal(x, robot.home)
    np.testing.assert_allclose(u, 0, atol=1e-9)


@pytest.mark.slow
def test_no_terminal_cost_where_nothing_rests():
    """The model predicts the fall: g in the velocity of the root, as in the air."""
    with pytest.warns(UserWarning, match="does not rest"):
        mpc = jm.robot_mpc(load(WALKER), horizon=3)
    assert mpc.terminal_cost is None
    np.testing.assert_allclose(np.asarray(mpc.system.c)[9], -9.81 * mpc.system.dt, rtol=1e-6)


def test_lqr_names_coordinates():
    A, B = np.eye(4) + 0.1 * np.eye(4, k=2), np.array([[0.0], [0], [1], [0]])
    names = ("arm", "ball", "arm velocity", "ball velocity")
    system = jm.LinearSystem(A, B, dt=0.1, state_names=names)
    message = r"B: not stabilizable: does not move ball velocity \(eigenvalue 1\)"
    with pytest.raises(ValueError, match=message):
        jm.lqr(system, np.ones(4), 1.0)
    with pytest.raises(ValueError, match="does not move coordinate 3 .eigenvalue 1"):
        jm.lqr(jm.LinearSystem(A, B), np.ones(4), 1.0)
    B = np.vstack([np.zeros((2, 2)), np.eye(2)])
    with pytest.raises(ValueError, match="Q: not detectable: puts no weight on ball .eigenvalue"):
        jm.lqr(jm.LinearSystem(A, B, state_names=names), [1.0, 0, 1, 0], np.ones(2))


# --- what MJX lacks --------------------------------------------------------------------------

DROPPED = """
<mujoco><option noslip_iterations="3" solver="PGS"><flag energy="enable"/></option><worldbody>
<geom name="floor" type="plane" size="2 2 .1"/>
<body pos="0 0 .2"><joint name="lift" type="slide" axis="0 0 1"/>
<geom name="can" type="cylinder" size=".1 .1"/><geom name="ball" size=".1" pos=".5 0 0"/></body>
<body pos="0 0 .45"><freejoint/><geom name="box" type="box" size=".1 .1 .1"/></body>
<body pos="3 0 .2"><freejoint/><geom name="ghost" size=".1" contype="2" conaffinity="0"/></body>
</worldbody><actuator><motor joint="lift"/></actuator>
<sensor><e_potential/><jointpos joint="lift"/></sensor></mujoco>"""


def touching(model):
    return {
        frozenset(mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, g) for g in pair[:2])
        for pair in collision_driver.geom_pairs(model)
    }


@pytest.mark.slow
def test_contacts_that_mjx_lacks_are_left_out_alone():
    given = mujoco.MjModel.from_xml_string(DROPPED)
    with pytest.warns(UserWarning, match="without 3 noslip .*box with cylinder .1 pairs"):
        robot = jm.load_robot(given)
    assert given.opt.noslip_iterations == 3  # the caller's own model stays as it is
    assert touching(given) - touching(robot.mujoco) == {frozenset(("can", "box"))}
    assert touching(robot.mujoco) < touching(given)
    # MuJoCo's C engine agrees: the box falls through the can, the can stands on the floor.
    data = mujoco.MjData(robot.mujoco)
    data.qpos[0], data.qpos[3] = -0.11, 0.25
    mujoco.mj_forward(robot.mujoco, data)
    floor, can, box = (data.geom(name).id for name in ("floor", "can", "box"))
    pairs = {tuple(sorted(pair)) for pair in data.contact.geom.tolist()}
    assert (floor, can) in pairs and (can, box) not in pairs
    report = robot.report()
    assert report.left_out[:3] == (
        "3 noslip iterations of dry contacts", "contacts of box with cylinder (1 pairs)",
        "contacts of geom floor with geom box, of which MJX finds other points or directions",
    )  # fmt: skip
    assert report.cleared == (
        "switch energy", "1 sensors of types unknown to MJX",
        "solver PGS, Newton in its place (same problem)",
    )  # fmt: skip
    pair = '<contact><pair geom1="can" geom2="box"/></contact></mujoco>'
    with pytest.raises(ValueError, match="model: has a <pair> of contacts of box with cylinder"):
        load(DROPPED.replace("</mujoco>", pair))


def test_a_file_without_contacts_loses_none():
    text = DROPPED.replace('noslip_iterations="3"', "").replace("<flag", '<flag contact="disable"')
    report = load(text).report()
    assert report.left_out == ()
    assert "contacts of box with cylinder (1 pairs), switched off in the file" in report.cleared


# --- activation states -----------------------------------------------------------------------

ACTIVE = """
<mujoco><option timestep="0.01"/><worldbody><body>
<joint name="a" axis="0 1 0" damping=".1"/><geom size=".1" pos=".3 0 0" mass="1"/>
<body pos=".3 0 0"><joint name="b" axis="0 1 0" damping=".1"/>
<geom size=".1" pos=".3 0 0" mass="1"/></body></body></worldbody><actuator>
<general name="lag" joint="a" dyntype="filterexact" dynprm=".05" gainprm="20"
 ctrlrange="-1 1"/><motor name="direct" joint="b" ctrlrange="-9 9"/>
<general name="hold" joint="b" dyntype="integrator" gainprm="3" actlimited="true"
 actrange="-2 2"/></actuator></mujoco>"""


@pytest.mark.slow
def test_activation_states_are_mujocos():
    """A filter and an integrator behind the velocities: a step and its derivatives by the C engine,
    rest that stays, names and limits."""
    robot = load(ACTIVE)
    assert (robot.n, robot.m, robot.state_size) == (6, 3, 6)
    assert robot.state_names[4:] == ("lag activation", "hold activation")
    np.testing.assert_array_equal(robot.state_limits.upper[4:], [np.inf, 2])
    assert robot.report().limits[5][2:] == (-2, 2, "file, actrange")
    x, u = robot.equilibrium()
    np.testing.assert_allclose(u[0], -9.81 * 0.9 / 20)  # 0.3 m and 0.6 m, a kilogram each
    np.testing.assert_allclose([x[4], u[2]], [u[0], 0])
    np.testing.assert_allclose(c_steps(robot.mujoco, x, u, 100), x, atol=1e-9)
    x, u = np.array([0.3, -0.2, 1.0, 0.5, 0.4, -1.99]), np.array([0.7, 2.0, -3.0])
    with jax.enable_x64(True):
        after, A, B = map(np.asarray, (robot.step(x, u), *robot.transition(x, u)))
        assert robot.substeps == 1
    np.testing.assert_allclose(after, c_steps(robot.mujoco, x, u, 1), atol=1e-12)
    A_c, B_c = c_transition(robot, x, u)
    np.testing.assert_allclose(A, A_c, atol=1e-6)
    np.testing.assert_allclose(B, B_c, atol=1e-6)
    assert after[5] == -2  # clamped
    with pytest.raises(ValueError, match="robot: has activation states between"):
        robot.inverse_dynamics([0.0, 0], [0.0, 0], [0.0, 0])


# --- URDF ------------------------------------------------------------------------------------

URDF = """
<robot name="r"><link name="frame"/><joint name="f" type="fixed"><parent link="frame"/>
<child link="base"/></joint>
<link name="base"><inertial><mass value="4"/>
<inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><geometry><mesh filename="package://nowhere/base.dae"/></geometry></visual></link>
<joint name="hip" type="revolute"><parent link="base"/><child link="leg"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="20" velocity="5"/></joint>
<link name="leg"><inertial><mass value="1"/>
<inertia ixx=".01" iyy=".02" izz=".06" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="toe" type="revolute"><parent link="leg"/><child link="tip"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="2" velocity="5"/></joint>
<link name="tip"/></robot>"""


@pytest.fixture(scope="module")
def urdf(tmp_path_factory):
    path = tmp_path_factory.mktemp("models") / "r.urdf"
    path.write_text(URDF)
    return path


def test_inertias_are_mended_on_request(urdf):
    """(1, 2, 6)/100 is no body: the nearest moments with a + b = c are (2, 3, 5)/100."""
    with pytest.raises(ValueError, match="model: .*inertia.*load it with mend_inertias=True") as e:
        jm.load_robot(urdf)
    assert str(e.value).count("Mend the file") == 1
    robot = jm.load_robot(urdf, mend_inertias=True)
    m = robot.mujoco
    np.testing.assert_allclose(np.sort(m.body("leg").inertia), [0.02, 0.03, 0.05], rtol=1e-6)
    np.testing.assert_allclose(m.body("tip").mass, 5e-4)
    assert robot.report().mended == (
        "leg: principal moments (0.01, 0.02, 0.06) to (0.02, 0.03, 0.05)",
        "tip: no mass to a ball of 0.0005 kg",
    )
    assert m.nv == 2 and "welded" in robot.report().read[-1]
    with pytest.raises(ValueError, match="mend_inertias: is for URDF files"):
        jm.load_robot("arm2", mend_inertias=True)


def test_floating_base_frees_the_root(urdf, tmp_path):
    """Its mass counts then; without motors at the base."""
    robot = jm.load_robot(urdf, mend_inertias=True, floating_base=True)
    m = robot.mujoco
    assert (m.nv, m.nu) == (8, 2) and m.jnt_type[0] == 0
    np.testing.assert_allclose(m.body_mass.sum(), 5.0005)
    assert not any("welded" in text for text in robot.report().read)
    mounted = tmp_path / "mounted.urdf"
    mounted.write_text(URDF.replace('"frame"', '"world"'))
    with pytest.raises(ValueError, match="floating_base: the root link of the file is the world"):
        jm.load_robot(mounted, mend_inertias=True, floating_base=True)
    with pytest.raises(ValueError, match="floating_base: is for URDF files"):
        jm.load_robot("arm2", floating_base=True)


# --- reports ---------------------------------------------------------------------------------

CHAIN = """
<mujoco><worldbody><body name="x"><joint name="a" axis="0 1 0" frictionloss=".1"/>
<geom size=".1" pos=".3 0 0"/></body><body name="y" pos="0 1 0"><joint name="b" axis="0 1 0"
range="-90 90"/><geom size=".1" pos=".3 0 0"/><site name="s"/></body><site name="t"/></worldbody>
<tendon><spatial name="rope" range="0 2"><site site="s"/><site site="t"/></spatial></tendon>
<equality><joint joint1="a" joint2="b"/><connect body1="x" body2="y" anchor=".3 0 0"
active="false"/></equality><actuator><position joint="a" kp="10" forcerange="-2 2"
ctrlrange="-1 1"/></actuator></mujoco>"""


@pytest.mark.slow
def test_report_names_what_the_predictor_ignores():
    robot = load(CHAIN, velocity=3.0)
    report = robot.report()
    assert report.predictor_ignores == (
        "1 pairs of shapes in contact", "1 joints with dry friction",
        "1 stops of joints, whose ranges are limits of the MPC",
        "1 stops of tendons, no limits of the MPC",
        "1 limits of forces, which are rows of the MPC",
    )  # fmt: skip
    assert [source for *_, source in report.limits] == [
        "none", "file, range", "argument", "argument", "file, ctrlrange",
    ]  # fmt: skip
    text = str(report)
    for part in ("robot robot", "home: file, qpos0", "2 hinge", "joints with dry friction"):
        assert part in text
    flags = '<option><flag equality="disable" limit="disable" contact="disable"/></option>'
    quiet = load(CHAIN.replace("<mujoco>", f"<mujoco>{flags}")).report()
    assert len(quiet.predictor_ignores) == 2


# --- rows of a batch -------------------------------------------------------------------------


@pytest.mark.slow
def test_bad_rows_and_heavy_loads_stay_alone():
    """NaN and infinity spoil no other row of a step; 200 kg in the hand of a 3 kg arm, at its
    stops, stay finite."""
    arm = jm.load_robot("arm2")
    step = jax.jit(jax.vmap(lambda x, u, load: arm.vary(payload=load).step(x, u)))
    x = np.tile(arm.home, (5, 1)) + 0.1 * np.random.default_rng(0).normal(size=(5, 4))
    x[3, 0] = 3.15  # beyond a stop
    u, loads = np.ones((5, 2)), np.array([0.0, 1.0, 200.0, 200.0, 1.0])
    good = np.asarray(step(x, u, loads))
    bad = x.copy()
    bad[1], bad[4, 2] = np.nan, np.inf
    found = np.asarray(step(bad, u, loads))
    np.testing.assert_array_equal(found[[0, 2, 3]], good[[0, 2, 3]])
    assert not np.any(np.isfinite(found[1])) and not np.all(np.isfinite(found[4]))
    for _ in range(50):
        good = np.asarray(step(jnp.asarray(good), u, loads))
    assert np.all(np.isfinite(good)) and np.abs(good).max() < 100
