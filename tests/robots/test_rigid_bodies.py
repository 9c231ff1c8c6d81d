"""Rigid bodies by whole arrays against MuJoCo's C engine and against forward differentiation."""

import copy
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_engine import c_steps, c_transition

import jaxmpc as jm
from jaxmpc.robots import rigid_bodies
from jaxmpc.robots.configurations import retract
from jaxmpc.robots.physics import Physics

# Several joints on one body, anchors off the centre, a body without joints, a branch, a ball joint
# behind a hinge, a free body that carries a hinge.
TREE = """
<mujoco>
  <option timestep="0.002"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body pos="0 0 1" euler="10 20 30">
      <joint type="slide" axis="1 1 0"/>
      <joint name="first" axis="0 1 0" pos=".1 0 .2" armature=".1" damping=".2"/>
      <joint axis="1 0 0" pos="0 .1 0" stiffness="3" springref="20"/>
      <geom size=".1" pos=".3 0 .1" mass="1"/>
      <geom size=".05" pos=".1 .2 .1" mass="2"/>
      <site name="arm" pos=".2 .1 0" euler="20 0 10"/>
      <body pos=".2 0 0" euler="40 0 0">
        <geom size=".07" pos="0 .2 .1" mass="1.5"/>
        <body pos="0 0 .3" BODY>
          <joint name="ball" type="ball" pos=".1 0 0" damping=".1" armature=".02"/>
          <geom type="box" size=".1 .2 .3" mass="1" pos=".1 .2 0"/>
          <site name="hand" pos=".1 .2 .3" quat="1 2 3 4"/>
        </body>
      </body>
      <body name="branch" pos="0 .2 0">
        <joint name="second" axis="0 0 1" pos=".1 .1 .1"/>
        <geom name="paddle" type="box" size=".1 .2 .3" mass="1" pos=".1 .2 0"/>
        <site name="side" pos=".1 -.2 .1"/>
      </body>
    </body>
    <body name="flying" pos="1 2 3">
      <freejoint/>
      <geom name="hull" type="box" size=".3 .2 .1" mass="3" pos=".1 0 0"/>
      <site name="nose" pos=".3 .1 0"/>
      <body pos=".3 .2 0">
        <joint name="third" axis="1 2 3" ref="20"/>
        <geom type="capsule" size=".1 .2" mass="1" pos=".1 .2 0"/>
      </body>
    </body>
    <geom name="wall" type="plane" size="9 9 .1" pos="0 0 -50"/>
    <site name="post" pos=".1 .5 .5"/>
  </worldbody>
  EXTRA
  <actuator><motor joint="first"/><motor joint="ball" gear="1 2 3"/> DRIVE</actuator>
</mujoco>"""

TENDONS = """<tendon>
  <fixed stiffness="5" damping=".4" range="-.1 .1" limited="LIMITED">
    <joint joint="first" coef="1"/><joint joint="third" coef="-2"/></fixed>
  <spatial armature=".7" stiffness="30" damping=".3">
    <site site="post"/><site site="hand"/></spatial>
  <spatial name="rope"><site site="arm"/><site site="side"/><site site="nose"/></spatial>
</tendon>"""

LINE = """<tendon>
  <spatial name="line" armature=".7" stiffness="30" damping="3">
    <site site="post"/><site site="hand"/></spatial>
</tendon>"""

# What is put into TREE: text after the bodies, actuators, attributes of the body with the ball,
# attributes of <option>; low: the flying box is on the wall; still: at rest, as MJX leaves out how
# Jacobians of connect and weld change.
CASES = {
    "plain": {},
    "implicit": {
        "drive": '<position joint="second" kp="20" kv="3"/>',
        "option": 'integrator="implicitfast"',
    },
    "RK4": {"option": 'integrator="RK4" density="20"'},
    "no damping, no gravity": {
        "extra": '<option><flag eulerdamp="disable" gravity="disable"/></option>',
    },
    "no actuation": {"extra": '<option><flag actuation="disable"/></option>'},
    "tendons": {
        "extra": TENDONS.replace("LIMITED", "false"), "drive": '<motor tendon="rope" gear="2"/>',
    },
    "implicit tendon": {
        "extra": LINE, "option": 'integrator="implicitfast"',
        "drive": '<general tendon="line" gainprm="2" biastype="affine" biasprm="0 -1 -2"/>',
    },
    "limited tendon": {"extra": TENDONS.replace("LIMITED", "true")},
    "weightless": {"body": 'gravcomp=".8"'},
    "in a fluid": {"option": 'density="300" viscosity=".5" wind="1 2 0"'},
    "site": {
        "body": 'gravcomp=".8"',
        "drive": '<general site="hand" gear="1 2 3 .1 .2 .3"/>'
        '<general site="nose" refsite="arm" gear="1 0 0 0 .5 0"/>',
    },
    "weld": {
        "extra": '<equality><weld body1="branch" body2="flying"/></equality>', "still": True,
    },
    "connect": {
        "still": True,
        "extra": '<equality><connect body1="branch" body2="flying" anchor=".1 .2 0"/></equality>',
    },
    "joints": {
        "extra": '<equality><joint joint1="first" joint2="third" polycoef="0 1 .5"/></equality>',
    },
    "contact": {
        "extra": '<contact><pair geom1="hull" geom2="wall"/></contact>', "low": True,
        "option": 'cone="elliptic"',
    },
    "activation": {
        "drive": '<general joint="third" dyntype="filterexact" dynprm=".1" gainprm="3"/>'
        '<general site="nose" dyntype="integrator" gear="0 0 1 0 0 0"/>',
    },
}  # fmt: skip


def model_of(case):
    options = CASES[case]
    text = TREE.replace("EXTRA", options.get("extra", "")).replace(
        "DRIVE", options.get("drive", "")
    )
    text = text.replace("BODY", options.get("body", ""))
    text = text.replace('timestep="0.002"', 'timestep="0.002" ' + options.get("option", ""))
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.tolerance, model.opt.iterations = 0, 100
    model.opt.ls_tolerance, model.opt.ls_iterations = 1e-6, 50
    return model


def state_of(model, rng, low=False, still=False):
    q = model.qpos0.copy()
    mujoco.mj_integratePos(model, q, 0.3 * rng.normal(size=model.nv), 1.0)
    if low:  # the flying box on the wall
        free = model.jnt_qposadr[model.body("flying").jntadr[0]]
        q[free + 2] = -49.9
    v, act = 0.5 * (not still) * rng.normal(size=model.nv), rng.normal(size=model.na)
    return np.concatenate([q, v, act]), rng.normal(size=model.nu)


@pytest.mark.parametrize("name", ["arm2", "tree"])
@pytest.mark.slow
def test_poses_inertia_and_forces_are_the_c_engines(name):
    model = model_of("plain") if name == "tree" else jm.load_robot(name).mujoco
    tree, rng, data = rigid_bodies.Tree.of(model), np.random.default_rng(0), mujoco.MjData(model)
    numbers = {key: np.array(getattr(model, key))[..., None] for key in rigid_bodies.FIELDS}
    numbers["gravity"] = np.array(model.opt.gravity)[:, None]
    x = np.array([state_of(model, rng)[0] for _ in range(3)]).T
    q, v = np.split(x, [model.nq])
    a = rng.normal(size=v.shape)
    with jax.enable_x64(True):
        found = jax.jit(lambda q: rigid_bodies.bodies(tree, numbers, q))(q)
        M, bias, fields = jax.jit(lambda q, v: rigid_bodies.dynamics(tree, numbers, q, v))(q, v)
        needed = jax.jit(lambda *of: rigid_bodies.inverse_dynamics(tree, numbers, *of))(q, v, a)
        slopes = jax.jit(lambda *of: rigid_bodies.slopes(tree, numbers, *of))(q, v, a)
        joints = tuple(int(joint) for joint in model.jnt_type)

        def moved(d, q, v, a):
            start = retract(joints, q, d)[:, None]
            return rigid_bodies.inverse_dynamics(tree, numbers, start, v[:, None], a[:, None])[:, 0]

        jacobians = jax.jit(jax.vmap(jax.jacfwd(moved, argnums=(0, 2, 3)), in_axes=(None, 1, 1, 1)))
        wanted = jacobians(jnp.zeros(model.nv), q, v, a)
    for by_rule, by_jax in zip(slopes, wanted, strict=True):
        np.testing.assert_allclose(np.moveaxis(by_rule, -1, 0), by_jax, atol=1e-9)
    for i in range(q.shape[1]):
        data.qpos, data.qvel = q[:, i], v[:, i]
        mujoco.mj_forward(model, data)
        for key, value in fields.items():
            key = key.removeprefix("_impl.")  # fields of MJX's own
            given = value[..., i].reshape(getattr(data, key).shape)
            np.testing.assert_allclose(given, getattr(data, key), atol=1e-10, err_msg=key)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        np.testing.assert_allclose(found.S[..., i], data.cdof, atol=1e-10)
        np.testing.assert_allclose(M[..., i], full, atol=1e-10)
        np.testing.assert_allclose(slopes[2][..., i], full, atol=1e-10)
        np.testing.assert_allclose(bias[:, i], data.qfrc_bias, atol=1e-9)
        np.testing.assert_allclose(needed[:, i], full @ a[:, i] + data.qfrc_bias, atol=1e-9)


QUICK = ("implicit", "tendons", "contact")


@pytest.mark.parametrize(
    "case", [c if c in QUICK else pytest.param(c, marks=pytest.mark.slow) for c in CASES]
)
@pytest.mark.first(1)
def test_a_step_is_the_c_engines(case):
    model, rng = model_of(case), np.random.default_rng(1)
    x, u = state_of(model, rng, CASES[case].get("low", False), CASES[case].get("still", False))
    after = c_steps(model, x, u, 1)
    plain = c_steps(model_of("plain"), x[: model.nq + model.nv], u[:2], 1)
    # The case is no other name for "plain".
    assert (case == "plain") != (np.abs(after[: len(plain)] - plain).max() > 1e-6)
    with jax.enable_x64(True):
        found = jax.jit(Physics(model).step)(x, u)
    np.testing.assert_allclose(found, after, rtol=0, atol=1e-8 * (1 + np.abs(after).max()))


@pytest.mark.slow
def test_every_number_that_varies_counts():
    """Fields of mjx.Model as arguments, one other in each row, against a file with that number."""
    model, rng = model_of("site"), np.random.default_rng(2)
    x, u = state_of(model, rng)
    names = ("dof_damping", "jnt_stiffness", "actuator_gear", "body_gravcomp", *rigid_bodies.FIELDS)
    numbers = {name: np.array(getattr(model, name)) for name in names}
    rows = {name: np.tile(value, (len(names), 1, 1)[: value.ndim + 1]) for name, value in
            numbers.items()}  # fmt: skip
    wanted = []
    for i, (name, value) in enumerate(numbers.items()):
        changed = value * (1 + 0.1 * rng.uniform(size=value.shape))
        if name.endswith(("quat", "axis")):
            changed = changed / np.linalg.norm(changed, axis=-1, keepdims=True)
        other, rows[name][i] = copy.copy(model), changed
        getattr(other, name)[:] = changed
        wanted.append(c_steps(other, x, u, 1))
        matters = np.abs(wanted[-1] - c_steps(model, x, u, 1)).max() > 1e-7
        assert matters == (not name.startswith("geom")), name
    with jax.enable_x64(True):
        found = jax.jit(jax.vmap(partial(Physics(model).step, x, u)))(rows)
    for name, ours, theirs in zip(names, found, wanted, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-8, err_msg=name)


@pytest.mark.parametrize(
    "integrator, tendon",
    [("Euler", 'armature=".3"'), ("implicitfast", 'armature=".2" damping="3"')],
)
def test_tendons_that_couple_branches(x64, integrator, tendon):
    """A gripper: MuJoCo adds to M where it has entries, none of two fingers."""
    finger = """<body pos="0 {0}.1 0"><joint name="{1}" type="slide" axis="0 {0}1 0"/>
        <geom size=".02" mass="{2}" contype="0" conaffinity="0"/></body>"""
    model = mujoco.MjModel.from_xml_string(f"""<mujoco>
        <option timestep="0.005" integrator="{integrator}"/><worldbody>
        {finger.format("", "left", 0.1)}{finger.format("-", "right", 0.2)}</worldbody>
        <tendon><fixed name="split" {tendon}><joint joint="left" coef=".5"/>
        <joint joint="right" coef=".5"/></fixed></tendon>
        <actuator><general tendon="split" gainprm="100" biastype="affine" biasprm="0 -100 -10"
        ctrlrange="0 1"/></actuator></mujoco>""")
    robot = jm.load_robot(model)
    x, u = np.array([0.02, -0.01, 0.3, -0.1]), np.array([0.4])
    np.testing.assert_allclose(robot.plant.step(x, u), c_steps(model, x, u, 1), atol=1e-14)
    for found, wanted in zip(robot.transition(x, u), c_transition(robot, x, u), strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-7)
