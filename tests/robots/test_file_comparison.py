"""Models of one feature each, beside MuJoCo's C engine: simulated right, named, or refused."""

import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_engine import c_transition

import jaxmpc as jm
from jaxmpc.robots.jaxpr_rewriting import rewritten
from jaxmpc.robots.mjx_gaps import _moved_by
from jaxmpc.robots.physics import TAMED

ARM = """
<mujoco>{top}<option timestep=".002" {option}>{flag}</option><worldbody>{world}
<body name="a" pos="0 0 1" {body}><joint name="j" axis="0 1 0" {joint}/>
<geom name="g" type="capsule" fromto="0 0 0 .3 0 0" size=".02" mass="1" {geom}/>
<body name="b" pos=".3 0 0"><{second}/>
<geom type="capsule" fromto="0 0 0 .2 .02 0" size=".02" mass=".5" contype="0" conaffinity="0"/>
<site name="s" pos=".2 0 .02"/></body></body><site name="w" pos=".1 .02 .7"/>
<geom name="c" type="{round}" size=".03 .1" euler="90 0 0" pos=".25 0 .8" contype="0"
conaffinity="0"/><site name="side" pos=".25 0 .7"/></worldbody>
<tendon>{tendon}</tendon><equality>{equality}</equality><contact>{contact}</contact>
<actuator>{actuator}</actuator></mujoco>"""
PLAIN = {
    "joint": 'damping=".1"', "second": 'joint name="k" axis="0 1 0" damping=".1"',
    "actuator": '<motor name="m" joint="j" ctrlrange="-5 5"/>', "round": "sphere",
}  # fmt: skip
MOTOR = '<motor name="m" joint="j" ctrlrange="-5 5" {}/>'
GENERAL = '<general name="m" joint="j" ctrlrange="-2 2" gainprm="3" {}/>'
FIXED = '<fixed name="t" {}><joint joint="j" coef="1"/><joint joint="k" coef="-.5"/></fixed>'
ROPE = '<spatial name="t" {}><site site="w"/><site site="s"/></spatial>'
ROUND = '<spatial name="t" {}><site site="w"/><geom geom="c" {}/><site site="s"/></spatial>'
FLUID = {"option": 'density="1000" viscosity=".5"'}
FLOOR = '<geom name="floor" type="plane" size="3 3 .1" pos="0 0 .99" {}/>'
BALL = 'joint name="k" type="ball" damping=".02" {}'
IN_GROUP = MOTOR.format('group="2"') + '<motor joint="k" group="1" ctrlrange="-3 3"/>'


FREE = (
    '<body name="o" pos="0 0 3"><freejoint name="f"/><inertial pos=".1 0 0" mass="1" '
    'diaginertia=".01 .02 .025"/></body>'
)


def on_tendon(tendon, actuator='<motor name="m" tendon="t" ctrlrange="-5 5" {}/>', more=""):
    return {"tendon": tendon, "actuator": actuator.format(more)}


# What the plant has right: parts of the file, by the feature in them.
RIGHT = {
    "plain": {},
    "damping": {"joint": 'damping=".5"'},
    "stiffness": {"joint": 'stiffness="3" springref="20"'},
    "springdamper": {"joint": 'springdamper=".1 1"'},
    "armature": {"joint": 'damping=".1" armature=".05"'},
    "frictionloss": {"joint": 'damping=".1" frictionloss=".2"'},
    "frictionloss impedance": {
        "joint": 'damping=".1" frictionloss=".2" solreffriction=".05 .8" solimpfriction=".7 .8 .01"'
    },
    "range": {"joint": 'damping=".1" range="-2 2"'},
    "range margin": {"joint": 'damping=".1" range="-30 .5" margin=".05"'},
    "range impedance": {"joint": 'damping=".1" range="-30 .5" solreflimit=".1 .5" margin=".2"'},
    "ref": {"joint": 'damping=".1" ref="30"'},
    "actuatorfrcrange": {"joint": 'damping=".1" actuatorfrcrange="-2 2"'},
    "actuatorfrcrange of two": {
        "joint": 'damping=".1" actuatorfrcrange="-2 2"',
        "actuator": MOTOR.format("") + '<motor joint="j" ctrlrange="-3 3"/>',
    },
    "actuatorgravcomp": {"joint": 'actuatorgravcomp="true"', "body": 'gravcomp="1"'},
    "actuatorgravcomp with actuatorfrcrange": {
        "joint": 'damping=".1" actuatorgravcomp="true" actuatorfrcrange="-3 3"',
        "body": 'gravcomp="1"',
    },
    "gravcomp": {"body": 'gravcomp=".7"'},
    "slide": {"second": 'joint name="k" type="slide" axis="1 0 1" damping="2"'},
    "ball": {"second": BALL.format("")},
    "ball stiffness": {"second": BALL.format('stiffness=".2"')},
    "ball range": {"second": BALL.format('range="0 20" margin=".3"')},
    "free": {"world": FREE},
    "gravity": {"option": 'gravity="1 2 -3"'},
    "density": {"option": 'density="1000"'},
    "viscosity": {"option": 'viscosity=".8"'},
    "wind": {"option": 'density="100" wind="1 2 3"'},
    "integrator implicitfast": {"option": 'integrator="implicitfast"'},
    "integrator RK4": {"option": 'integrator="RK4"'},
    "cone elliptic": {"option": 'cone="elliptic"'},
    "impratio": {"option": 'impratio="5"'},
    "flag gravity": {"flag": '<flag gravity="disable"/>'},
    "flag spring": {"joint": 'damping=".5" stiffness="3"', "flag": '<flag spring="disable"/>'},
    "flag damper": {"joint": 'damping=".5" stiffness="3"', "flag": '<flag damper="disable"/>'},
    "flags spring and damper": {
        "joint": 'damping=".5" stiffness="3"', "body": 'gravcomp="1"',
        "flag": '<flag spring="disable" damper="disable"/>',
    },
    "flag spring beside gravcomp": {"body": 'gravcomp="1"', "flag": '<flag spring="disable"/>'},
    "flag damper of tendons": {
        **on_tendon(ROPE.format('stiffness="9" damping="2"')), "flag": '<flag damper="disable"/>'
    },
    "flag eulerdamp": {"joint": 'damping=".5"', "flag": '<flag eulerdamp="disable"/>'},
    "flag limit": {"joint": 'range="-1 1"', "flag": '<flag limit="disable"/>'},
    "flag frictionloss": {
        "joint": 'frictionloss=".4"', "flag": '<flag frictionloss="disable"/>'
    },
    "flag constraint": {"joint": 'range="-1 1"', "flag": '<flag constraint="disable"/>'},
    "flag refsafe": {"joint": 'range="-2 2" solreflimit=".0035 2"',
                     "flag": '<flag refsafe="disable"/>'},
    "flag clampctrl": {"flag": '<flag clampctrl="disable"/>'},
    "flag energy": {"flag": '<flag energy="enable"/>'},
    "flag fwdinv": {"flag": '<flag fwdinv="enable"/>'},
    "solver PGS": {"option": 'solver="PGS"', "joint": 'frictionloss=".2"'},
    "solver CG": {"option": 'solver="CG"', "joint": 'frictionloss=".2"'},
    "actuatorgroupdisable": {"option": 'actuatorgroupdisable="2"', "actuator": IN_GROUP},
    "group off with an activation": {
        "option": 'actuatorgroupdisable="2"',
        "actuator": MOTOR.format("") + GENERAL.format('dyntype="filter" dynprm=".1" group="2"'
                                                      ).replace('"m"', '"off"'),
    },
    "actuatorfrcrange of a motor and a tendon": {
        "joint": 'damping=".1" actuatorfrcrange="-1 1"', "tendon": FIXED.format(""),
        "actuator": MOTOR.format("") + '<motor tendon="t" ctrlrange="-3 3"/>',
    },
    "actuatorfrcrange of a motor and a site": {
        "joint": 'damping=".1" actuatorfrcrange="-1 1"',
        "actuator": MOTOR.format("") + '<motor site="s" gear="0 0 9 0 0 0" ctrlrange="-3 3"/>',
    },
    "filter forcerange": {
        "actuator": GENERAL.format('dyntype="filter" dynprm=".05" forcerange="-1 1"')
    },
    "integrator actuatorfrcrange": {
        "joint": 'damping=".1" actuatorfrcrange="-1 1"',
        "actuator": GENERAL.format('dyntype="integrator"'),
    },
    "contact sensor": {
        "world": FLOOR.format(""),
        "actuator": MOTOR.format("") + "</actuator><sensor><contact subtree1='world' data='force'/>"
        "</sensor><actuator>",
    },
    "motor gear": {"actuator": MOTOR.format('gear="3"')},
    "motor forcerange": {"actuator": MOTOR.format('forcerange="-2 1"')},
    "position": {"actuator": '<position joint="j" kp="30" kv="2" ctrlrange="-2 2"/>'},
    "position forcerange": {
        "actuator": '<position joint="j" kp="30" kv="2" ctrlrange="-2 2" forcerange="-1 1"/>'
    },
    "position timeconst": {
        "actuator": '<position joint="j" kp="30" ctrlrange="-2 2" timeconst=".1"/>'
    },
    "velocity": {"actuator": '<velocity joint="j" kv="2" ctrlrange="-2 2"/>'},
    "intvelocity": {"actuator": '<intvelocity joint="j" kp="9" ctrlrange="-2 2" actrange="-2 2"/>'},
    "damper": {"actuator": '<damper joint="j" kv="2" ctrlrange="0 2"/>'},
    "cylinder": {"actuator": '<cylinder joint="j" timeconst=".1" area="2" ctrlrange="-2 2"/>'},
    "muscle": {"actuator": '<muscle joint="j" lengthrange="-1 1" ctrlrange="0 1" force="9"/>'},
    "gainprm": {
        "actuator": '<general joint="j" gaintype="affine" gainprm="3 .5 .2" ctrlrange="-2 2"/>'
    },
    "biasprm": {"actuator": GENERAL.format('biastype="affine" biasprm="1 -3 -.2"')},
    "integrator": {"actuator": GENERAL.format('dyntype="integrator"')},
    "filter": {"actuator": GENERAL.format('dyntype="filter" dynprm=".05"')},
    "filterexact": {"actuator": GENERAL.format('dyntype="filterexact" dynprm=".05"')},
    "actrange": {"actuator": GENERAL.format('dyntype="integrator" actrange="-.01 .01"')},
    "jointinparent": {
        "second": BALL.format(""),
        "actuator": '<motor jointinparent="k" gear="1 .5 .2" ctrlrange="-.5 .5"/>',
    },
    "site": {"actuator": '<motor site="s" gear="1 0 2 0 .1 0" ctrlrange="-3 3"/>'},
    "refsite": {"actuator": '<position site="s" refsite="w" kp="9" gear="1 0 1 0 0 0"/>'},
    "fixed tendon": on_tendon(FIXED.format("")),
    "tendon stiffness": on_tendon(FIXED.format('stiffness="5" springlength=".1"')),
    "tendon dead band": on_tendon(ROPE.format('stiffness="50" springlength=".1 .3"')),
    "tendon damping": on_tendon(ROPE.format('damping="2"')),
    "tendon frictionloss": on_tendon(FIXED.format('frictionloss=".3"')),
    "tendon range alone": on_tendon(FIXED.format('range="-1 1"')),
    "tendon range": on_tendon(FIXED.format('range="-1 1" margin=".2"')),
    "tendon armature": on_tendon(ROPE.format('armature=".5"')),
    "tendon actuatorfrcrange": on_tendon(ROPE.format('actuatorfrcrange="-2 2"')),
    "tendon motor gear": on_tendon(ROPE.format(""), more='gear="2"'),
    "tendon round a sphere": on_tendon(ROUND.format("", "")),
    "tendon round a cylinder": {**on_tendon(ROUND.format("", 'sidesite="side"')),
                                "round": "cylinder"},
    "pulley": on_tendon(
        '<spatial name="t"><site site="w"/><site site="s"/><pulley divisor="2"/>'
        '<site site="side"/><site site="s"/></spatial>'
    ),
    "mocap": {"world": '<body mocap="true" pos="0 0 3"><geom size=".1"/></body>'},
    "contact": {"world": FLOOR.format(""), "option": 'cone="elliptic"'},
    "contact gap": {"world": FLOOR.format('gap=".01"'), "option": 'cone="elliptic"'},
    "flag contact": {"world": FLOOR.format('adhesion="9"'), "flag": '<flag contact="disable"/>'},
    "surfacevel of what cannot touch": {
        "world": '<geom type="plane" size="1 1 1" contype="0" conaffinity="0" '
        'surfacevel="1 0 0 0 0 0"/>'
    },
    "fluidshape without a fluid": {"geom": 'fluidshape="ellipsoid"'},
    "springs and powers switched off": {
        "joint": 'stiffness="3 1" damping=".1"', "flag": '<flag spring="disable"/>'
    },
}  # fmt: skip

# Couplings, which plant and linear models have.
COUPLED = {
    "joints": '<joint joint1="k" joint2="j" polycoef=".1 .5 .2 0 0"/>',
    "joint alone": '<joint joint1="k" polycoef=".1 0 0 0 0" solref=".05 1"/>',
    "tendon": '<tendon tendon1="t" polycoef=".1 1 0 0 0" solref=".1 1"/>',
}

# What MJX drops: parts of the file, and words of the report.
NAMED = {
    "damping=.1 .5 .2": ({"joint": 'damping=".1 .5 .2"'}, "damping (higher powers) of joint j"),
    "stiffness=1 2": ({"joint": 'stiffness="1 2"'}, "stiffness (higher powers) of joint j"),
    "tendon damping=1 1": (
        on_tendon(ROPE.format('damping="1 5"')), "damping (higher powers) of tendon t"
    ),
    "tendon stiffness=1 1": (
        on_tendon(ROPE.format('stiffness="9 20"')), "stiffness (higher powers) of tendon t"
    ),
    "armature": ({"actuator": MOTOR.format('gear="3" armature=".05"')}, "armature of actuator m"),
    "actuator damping": ({"actuator": MOTOR.format('damping=".5"')}, "damping of actuator m"),
    "actuator damping=.1 1": (
        {"actuator": MOTOR.format('damping=".1 1"')}, "damping (higher powers) of actuator m"
    ),
    "delay": ({"actuator": MOTOR.format('nsample="10" delay=".02"')}, "delay of actuator m"),
    "tendon actuator armature": (
        on_tendon(ROPE.format(""), more='armature=".3"'), "armature of actuator m"
    ),
    "actearly": (
        {"actuator": GENERAL.format('dyntype="filterexact" dynprm=".05" actearly="true"')},
        "actearly of actuator m",
    ),
    "actearly integrator": (
        {"actuator": GENERAL.format('dyntype="integrator" actearly="true"')},
        "actearly of actuator m",
    ),
    "fluidshape": ({**FLUID, "geom": 'fluidshape="ellipsoid"'}, "fluidshape of geom g"),
    "fluidcoef": (
        {**FLUID, "geom": 'fluidshape="ellipsoid" fluidcoef="1 2 3 1 1"'}, "fluidshape of geom g"
    ),
    "adhesion": (
        {"world": FLOOR.format('adhesion="9"'), "option": 'cone="elliptic"'},
        "adhesion of geom floor",
    ),
    "adhesion of the arm": (
        {"world": FLOOR.format(""), "geom": 'adhesion="9"', "option": 'cone="elliptic"'},
        "adhesion of geom g",
    ),
    "surfacevel": (
        {"world": FLOOR.format('surfacevel="1 0 0 0 0 0"'), "option": 'cone="elliptic"'},
        "surfacevel of geom floor",
    ),
    "connect": (
        {"equality": '<connect name="e" body1="b" anchor=".2 0 0" solref=".1 1"/>'},
        "equality e pushes otherwise",
    ),
    "weld": (
        {"equality": '<weld name="e" body1="b" solref=".1 1" torquescale=".5"/>'},
        "equality e pushes otherwise",
    ),
    "flag sleep": ({"flag": '<flag sleep="enable"/>'}, "sleep of bodies at rest"),
    "noslip": (
        {"world": FLOOR.format(""), "option": 'cone="elliptic" noslip_iterations="5"'},
        "noslip iterations",
    ),
    "solver that stops early": (
        {"world": FLOOR.format(""), "option": 'iterations="1" ls_iterations="2"'},
        "newton solver (iterations=1) leaves before it has converged",
    ),
    "flag actuation": (
        {"flag": '<flag actuation="disable"/>'},
        "the forces of its actuators, which the file switches off",
    ),
    "implicitfast of a free body": (
        {"world": FREE, "option": 'integrator="implicitfast"'}, "joint f accelerates"
    ),
}  # fmt: skip

# Named wherever shapes may touch, bodies rest or inputs do nothing, also without a difference.
UNSEEN = ("noslip", "flag sleep", "flag actuation")

# What is refused at load.
REFUSED = {
    "plugin": ({"top": '<extension><plugin plugin="mujoco.pid"/></extension>',
                "actuator": '<plugin name="m" joint="j" plugin="mujoco.pid" ctrlrange="-2 2">'
                '<config key="kp" value="20"/></plugin>'},
               "has actuator m, of a plugin, which MJX lacks"),
    "orientation": ({"second": BALL.format(""),
                     "actuator": '<orientation name="m" joint="k" kp="2" kv=".1"/>'},
                    "has actuator m, with several inputs, which MJX lacks"),
    "integrator implicit": ({"option": 'integrator="implicit"'}, "has the integrator implicit,"),
    "integrator discrete": ({"option": 'integrator="discrete"'}, "has the integrator discrete,"),
    "slidercrank": ({"actuator": '<motor cranksite="s" slidersite="w" cranklength=".5"/>'},
                    "has actuator of id 0, of the type slidercrank, which MJX lacks"),
    "flag override": ({"flag": '<flag override="enable"/>'}, "has the flag override, which MJX"),
    "dyntype user": ({"actuator": GENERAL.format('dyntype="user"')}, "has actuator m, of the type"),
    "adhesion actuator": ({"actuator": '<adhesion name="g" body="b" ctrlrange="0 1"/>',
                           "world": FLOOR.format("")}, "has actuator g, of adhesion, which MJX"),
    "flex": ({"world": '<flexcomp type="grid" count="3 3 1" spacing=".1 .1 .1" name="f" mass="1" '
              'dim="2" radius=".01"/>'}, "has flex f, deformable, which MJX lacks"),
    "a fluid in implicitfast": ({"option": 'integrator="implicitfast" density="9"'},
                                "MJX does not .* drag. Write integrator=.Euler"),
}  # fmt: skip


def written(parts):
    names = ("top", "option", "flag", "world", "body", "joint", "geom", "second", "round",
             "tendon", "equality", "contact", "actuator")  # fmt: skip
    text = ARM.format_map({name: "" for name in names} | PLAIN | parts)
    return mujoco.MjModel.from_xml_string(text)


def loaded(parts):
    """A model, its robot, and what was said as it was loaded."""
    model = written(parts)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        robot = jm.load_robot(model)
    return model, robot, [str(warning.message) for warning in said]


def gap(model, robot):
    """How far the plant is from the C engine after motions of 0.05 s, relative to the largest
    number there: from two random states and one that rests on what is below."""
    rng, worst = np.random.default_rng(7), 0.0
    data, nq, nv = mujoco.MjData(model), model.nq, model.nv
    lower = np.maximum(np.asarray(robot.input_limits.lower), -2)
    upper = np.minimum(np.asarray(robot.input_limits.upper), 2)
    with jax.enable_x64(True):
        for speed in (0.0, 1.0, 2.0):
            mujoco.mj_resetData(model, data)
            data.qpos[:], data.qvel[:] = robot.home[:nq], speed * rng.normal(size=nv)
            data.act[:] = robot.home[nq + nv :]
            state = lambda: np.concatenate([data.qpos, data.qvel, data.act])
            x, size = state(), 1.0
            for _ in range(5):
                data.ctrl[:] = u = rng.uniform(lower, upper)
                for _ in range(robot.substeps):
                    mujoco.mj_step(model, data)
                x = np.asarray(robot.step(x, u))
                worst = max(worst, np.abs(x - state()).max() / max(size, np.abs(state()).max()))
    return worst


QUICK = ()  # what is named comes through the same comparison
QUICK_NAMED = ("armature",)


def quick_first(names, quick):
    return [pytest.param(name, marks=() if name in quick else pytest.mark.slow) for name in names]


@pytest.mark.compared
@pytest.mark.parametrize("name", quick_first(RIGHT, QUICK))
def test_what_is_simulated_right_is_not_named(name):
    model, robot, said = loaded(RIGHT[name])
    assert not said and robot.report().left_out == ()
    assert gap(model, robot) < 1e-7


@pytest.mark.slow
@pytest.mark.parametrize("name", COUPLED)
def test_couplings_are_simulated_right(name):
    parts = {"equality": COUPLED[name], "tendon": FIXED.format("")}
    model, robot, said = loaded(parts)
    assert not said
    assert robot.report().left_out == () and gap(model, robot) < 1e-7


@pytest.mark.long
@pytest.mark.compared
@pytest.mark.parametrize("name", quick_first(NAMED, QUICK_NAMED))
def test_what_mjx_drops_is_named(name):
    parts, words = NAMED[name]
    model, robot, said = loaded(parts)
    report = robot.report()
    assert len(said) == 1 and words in said[0], said
    assert any(words in text for text in report.left_out), report.left_out
    assert name in UNSEEN or gap(model, robot) > 1e-8


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_loaded_is_refused(name):
    parts, words = REFUSED[name]
    with pytest.raises(ValueError, match=f"model: {words}"):
        jm.load_robot(written(parts))


TOUCHING = """
<mujoco><option timestep=".002"/><worldbody>
<geom name="c" type="cylinder" size=".03 .1" euler="90 0 0" contype="0" conaffinity="0"/>
<site name="w" pos=".03 0 0"/><body><joint name="j" axis="0 1 0" damping=".1"/>
<geom size=".02" pos=".1 0 .2" mass="1" contype="0" conaffinity="0"/><site name="s" pos=".03 0 .2"/>
</body></worldbody><tendon><spatial name="t" stiffness="50"><site site="w"/><geom geom="c"/>
<site site="s"/></spatial></tendon>
<actuator><motor tendon="t" ctrlrange="-9 9"/></actuator></mujoco>"""


def test_roots_and_angles_have_derivatives_at_the_ends():
    """Zero there, inside those of calculus: 1/(2 √x) and −1/√(1 − x²)."""
    for function, end, slope in ((jnp.sqrt, 0.0, 1.0), (jnp.arccos, 1.0, -1.1547005383792515)):
        tame = jax.grad(rewritten(function, TAMED))
        assert tame(end) == 0 and function(end) == rewritten(function, TAMED)(end)
        np.testing.assert_allclose(tame(0.5 if end else 0.25), slope, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("q", [0.0, 0.3])
def test_a_tendon_that_only_touches_has_derivatives(q):
    """At q = 0 the arc has no length: its derivative by the angle's cosine is infinite. Aside of it
    A and B are the C engine's."""
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(TOUCHING), home=[0.3])
    x, u = np.array([q, 0.5]), np.array([1.0])
    with jax.enable_x64(True):
        found = robot.transition(x, u)
    assert all(np.all(np.isfinite(part)) for part in found)
    if q:
        for part, wanted in zip(found, c_transition(robot, x, u), strict=True):
            np.testing.assert_allclose(part, wanted, atol=1e-6)


FALLING = """<mujoco><option cone="elliptic"/><worldbody><geom type="plane" size="1 1 .1"
condim="{0}"/><body pos="0 0 .1" euler="20 10 0"><freejoint name="f"/><geom size=".1 .04"
type="capsule" mass="1" condim="{1}" friction="{2}"/></body><body pos=".1 0 .35"><freejoint/>
<geom size=".1" mass="1" condim="{1}"/></body></worldbody>
<actuator><motor joint="f" gear="1 0 0 0 0 0" ctrlrange="-1 1"/></actuator></mujoco>"""


@pytest.mark.parametrize(
    "given, words",
    [
        pytest.param((1, 1, 1), "all contacts", marks=pytest.mark.slow),
        ((3, 1, 1), "friction of 1e-5"),
        pytest.param((3, 1, 2), "pyramidal ones", marks=pytest.mark.slow),
    ],
)
@pytest.mark.slow
def test_contacts_without_friction_beside_elliptic_cones(given, words):
    """The same motion as in the C engine, but where no model of MJX has it, which is said."""
    model = mujoco.MjModel.from_xml_string(FALLING.format(*given))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        robot = jm.load_robot(model)
    told = " ".join(str(warning.message) for warning in said)
    assert (words in told) == (words == "pyramidal ones"), told
    assert words in repr(robot.report().cleared) + repr(robot.report().left_out)


SHAPED = """<mujoco><compiler meshdir="parts"/><asset><mesh name="m" file="link.stl"/>
<mesh file="wall.obj"/><texture name="t" type="2d" file="skin.png"/><material name="k" texture="t"/>
</asset><worldbody><geom type="mesh" mesh="wall"/><body name="arm" pos="0 0 1">{0}
<joint name="j" axis="0 1 0"/><geom type="mesh" mesh="m" material="k"/></body></worldbody>
<actuator><motor joint="j" ctrlrange="-5 5"/></actuator></mujoco>"""


def test_shapes_of_missing_meshes_are_left_out(tmp_path):
    """A body that has its own inertia needs no shape; one that has none is refused."""
    path = tmp_path / "shaped.xml"
    path.write_text(SHAPED.format('<inertial pos=".1 0 0" mass="1" diaginertia=".01 .01 .01"/>'))
    with pytest.warns(UserWarning, match="1 shape of the mesh parts/link.stl, which is missing"):
        robot = jm.load_robot(path)
    left_out = robot.report().left_out
    assert len(left_out) == 3 and "texture skin.png" in left_out[2]
    assert robot.mujoco.body_mass[1] == 1 and robot.mujoco.ngeom == 0
    path.write_text(SHAPED.format(""))
    with pytest.raises(ValueError, match="link.stl is missing, whose shape gives body arm its ma"):
        jm.load_robot(path)


def test_what_a_missing_file_leaves(tmp_path):
    """Skins and textures leave nothing; what refers to a shape, or weighs what it does, is
    refused with the name of the file."""
    path = tmp_path / "shaped.xml"
    whole = SHAPED.format('<inertial pos=".1 0 0" mass="1" diaginertia=".01 .01 .01"/>')
    sky = '<texture type="skybox" fileup="sky.png"/><texture name="t"'
    skin = '</worldbody><deformable><skin file="skin.skn"/></deformable>'
    path.write_text(whole.replace('<texture name="t"', sky).replace("</worldbody>", skin))
    with pytest.warns(UserWarning, match="texture sky.png.* skin parts/skin.skn, which is missing"):
        jm.load_robot(path)
    sensor = '<sensor><framepos objtype="geom" objname="g"/></sensor></mujoco>'
    path.write_text(whole.replace("mesh='m'", "").replace('mesh="m" mat', 'name="g" mesh="m" mat')
                    .replace("</mujoco>", sensor))  # fmt: skip
    with pytest.raises(ValueError, match="mesh parts/link.stl, which is missing; .* name 'g'"):
        jm.load_robot(path)
    path.write_text(whole.replace("<compiler", '<compiler inertiafromgeom="true"'))
    with pytest.raises(ValueError, match="link.stl is missing, whose shape gives body arm its ma"):
        jm.load_robot(path)


def test_a_compiled_model_in_a_file(tmp_path):
    model = written({})
    mujoco.mj_saveModel(model, str(tmp_path / "arm.mjb"), None)
    robot = jm.load_robot(tmp_path / "arm.mjb")
    np.testing.assert_array_equal(robot.mujoco.body_mass, model.body_mass)


def test_the_actuator_whose_activation_differs_is_named():
    """Of actuators without activations beside it none is meant."""
    parts = {"actuator": GENERAL.format('dyntype="filter" dynprm=".1"') + '<motor joint="k"/>'}
    assert _moved_by(written(parts), 2) == "actuator m activates"


SERVO = '<position joint="j" kp="30" kv="2" ctrlrange="-2 2" forcerange="{0} {1}"/>'


def test_rest_is_tried_on_the_file():
    """1 kg at 0.15 m and half at 0.3 m and more need 3.5 N m of the shoulder."""
    held = '<motor joint="k" ctrlrange="-9 9"/>'
    weak = written({"actuator": SERVO.format(-1, 1) + held})
    robot = jm.load_robot(weak)
    for ask in (robot.set_point, robot.equilibrium, lambda: robot.set_point(robot.home[:2])):
        with pytest.raises(
            ValueError, match="no rest: in MuJoCo joint . accelerates by .*forcerange"
        ):
            ask()
    robot = jm.load_robot(written({"actuator": SERVO.format(-9, 9) + held}))
    x, u = robot.set_point()
    data = mujoco.MjData(robot.file)
    data.qpos[:], data.ctrl[:] = x[:2], u
    mujoco.mj_forward(robot.file, data)
    np.testing.assert_allclose(data.qacc, 0, atol=1e-9)


def test_home_off_the_couplings():
    """The second joint is half a radian from where the coupling wants it: it is taken there."""
    parts = {"equality": '<joint name="e" joint1="k" polycoef=".5 0 0 0 0"/>',
             "actuator": PLAIN["actuator"] + '<motor joint="k" ctrlrange="-9 9"/>'}  # fmt: skip
    _, robot, said = loaded(parts)
    assert not said
    with pytest.raises(
        ValueError,
        match="q: .* violates couplings .equalities. of the file: equality e is off by 0.5",
    ):
        robot.equilibrium(robot.home[:2])
    x, _ = robot.set_point()
    assert abs(x[1] - 0.5) < 0.05
    np.testing.assert_allclose(robot.equilibrium()[0], x, atol=1e-9)


def test_versions_are_compared(monkeypatch):
    found = {"mujoco": "4.0.0", "mujoco-mjx": "3.17.0"}
    monkeypatch.setattr("jaxmpc.robots.load.version", found.get)
    cure = "mujoco 4.0.0 beside mujoco-mjx 3.17.0: .*'mujoco==3.17..' 'mujoco-mjx==3.17..'"
    with pytest.warns(UserWarning, match=cure):
        jm.load_robot("joint")
    monkeypatch.setattr("jaxmpc.robots.load.version", lambda name: "3.18.1")
    jm.load_robot("joint")


@pytest.mark.compared
def test_equal_models_are_compared_once(monkeypatch):
    calls = []
    monkeypatch.setattr("jaxmpc.robots.mjx_gaps._known", {})
    monkeypatch.setattr("jaxmpc.robots.mjx_gaps._unlike", lambda *args: (calls.append(1), ())[1])
    jm.load_robot("pendulum")
    jm.load_robot("pendulum", position=1.0)
    assert len(calls) == 1
    jm.load_robot("pendulum", timestep=0.0005, control_period=0.01)
    assert len(calls) == 2


def test_feet_that_only_touch():
    """At home rounding decides which feet touch, one of six in MuJoCo here: no difference."""
    legs = "".join(
        f"""
        <body euler="0 0 {60 * i + 30}" pos="0 0 .03"><joint name="n{i}" axis="0 1 0"/>
        <geom type="sphere" size=".02" pos=".3 0 -.15" mass=".1"/></body>"""
        for i in range(6)
    )
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco><worldbody><geom type="plane" size="5 5 .1"/>
        <body pos="1.5 -.7 .14" euler="0 0 40"><freejoint/>
        <geom type="cylinder" size=".1 .02" mass="1"/>{legs}</body></worldbody>
        <actuator><motor joint="n0" ctrlrange="-1 1"/></actuator></mujoco>""")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        jm.load_robot(model)
