"""Random robots: what is drawn, from which ranges, and that no draw depends on another."""

import mujoco
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.closed_loop import randomised
from jaxmpc.closed_loop.variations import plant_numbers, start_room

ALL = dict(
    mass=(0.9, 1.1), damping=(0.8, 1.2), armature=(0.5, 2.0), gear=(0.7, 1.0), payload=(0.0, 1.0)
)


@pytest.fixture(scope="module")
def arm():
    return jm.load_robot("arm7")


def test_first_robots_do_not_depend_on_how_many_there_are(arm):
    """Nor on what else varies; the seed decides."""
    few, many = (randomised(arm, count, seed=7, **ALL) for count in (10, 100))
    assert few.keys() == many.keys()
    for name, value in few.items():
        np.testing.assert_array_equal(value, many[name][:10])
    masses = randomised(arm, 10, seed=7, mass=ALL["mass"])
    assert masses.keys() == {"body_mass", "body_inertia"}
    np.testing.assert_array_equal(masses["body_mass"], few["body_mass"])
    other = randomised(arm, 10, seed=8, **ALL)
    assert all(np.any(other[name] != few[name]) for name in few)


@pytest.mark.long
def test_numbers_are_uniform_in_their_ranges(arm):
    model, count = arm.mujoco, 2000
    found = randomised(arm, count, **ALL)
    factors = {
        "mass": found["body_mass"][:, 1:] / model.body_mass[1:],
        "damping": found["dof_damping"] / model.dof_damping,
        "armature": found["dof_armature"] / model.dof_armature,
        "gear": found["actuator_gear"][:, :, 0] / model.actuator_gear[:, 0],
        "payload": found["payload"][:, None],
    }
    for name, drawn in factors.items():
        least, most = ALL[name]
        assert drawn.min() >= least - 1e-12 and drawn.max() <= most + 1e-12
        # Independent: mean and variance of a uniform distribution, no correlation.
        np.testing.assert_allclose(drawn.mean(0), (least + most) / 2, atol=0.03 * (most - least))
        np.testing.assert_allclose(drawn.var(0) * 12, (most - least) ** 2, rtol=0.1)
        off = np.corrcoef(drawn.T) - np.eye(drawn.shape[1]) if drawn.shape[1] > 1 else 0
        assert np.abs(off).max() < 0.1
    inertia = found["body_inertia"][:, 1:] / model.body_inertia[1:]
    np.testing.assert_allclose(inertia, np.repeat(factors["mass"][..., None], 3, axis=2))
    # The robots take them.
    arm.vary(**{name: value[0] for name, value in found.items()})


def test_one_body_or_joint_by_name(arm):
    """It goes before the range for all; the others are as without it, or the file's."""
    base = arm.mujoco.body_mass
    alone = randomised(arm, 5, **{"link7 mass": (2.0, 3.0)})["body_mass"]
    np.testing.assert_array_equal(alone[:, :7], np.tile(base[:7], (5, 1)))
    assert (alone[:, 7] >= 2 * base[7]).all() and len(set(alone[:, 7])) == 5
    both = randomised(arm, 5, **{"link7 mass": (2.0, 3.0), "mass": (0.9, 1.1)})["body_mass"]
    np.testing.assert_array_equal(both[:, 7], alone[:, 7])
    rest = randomised(arm, 5, mass=(0.9, 1.1))["body_mass"]
    np.testing.assert_array_equal(both[:, :7], rest[:, :7])
    joint = randomised(arm, 5, **{"joint3 damping": (0.5, 0.5)})["dof_damping"]
    want = np.where(np.arange(7) == 2, 0.5, 1.0) * arm.mujoco.dof_damping
    np.testing.assert_array_equal(joint, np.tile(want, (5, 1)))


def test_bad_ranges_are_named(arm):
    for given, message in (
        ({"masses": (1, 2)}, "masses: is no quantity that varies. Did you mean mass"),
        ({"link7 payload": (0, 1)}, "link7 payload: is no quantity"),
        ({"link9 mass": (1, 2)}, "link9 mass: arm7 has no body named 'link9'. Did you mean link"),
        ({"mass": (1.1, 0.9)}, r"mass: \(1.1, 0.9\). Give 0 < least ≤ most"),
        ({"mass": (0, 1)}, r"mass: \(0, 1\). Give 0 < least"),
        ({"payload": (-1, 1)}, r"payload: \(-1, 1\). Give 0 ≤ least"),
        ({"payload": (0, np.inf)}, r"payload: \(0, inf\)"),
        ({"mass": 1.1}, r"mass: shape \(\) where \(2,\) is needed. Give \(least, most\)"),
        ({"friction": (1, 2)}, "friction: is a factor of dof_frictionloss, which is 0 in arm7"),
        ({"seed": -1}, "seed: -1"),
    ):
        with pytest.raises(ValueError, match=message):
            randomised(arm, 3, **given)
    with pytest.raises(ValueError, match="count: 0"):
        randomised(arm, 0, mass=(0.9, 1.1))
    with pytest.raises(ValueError, match="robot: is a LinearSystem. Give a jm.robots.Robot"):
        randomised(jm.LinearSystem([[1.0]], [[1.0]]), 3, mass=(0.9, 1.1))


def test_matrices_of_other_shapes_are_named():
    """A row where a matrix is needed would be another plant."""
    system = jm.LinearSystem([[1.0, 0.1], [0, 1]], [[0.0], [0.1]], dt=0.1)
    plant = jm.LinearPlant(system, jm.Box(-1.0, 1.0), jm.Box(-1.0, 1.0))
    for name, value in (("A", [1.0, 2.0]), ("A", 1.0), ("B", np.ones((1, 2))), ("c", 0.5)):
        with pytest.raises(ValueError, match=rf"{name}: shape .* where .* is needed"):
            plant.vary(**{name: np.asarray(value)})
    mpc = jm.MPC(system, np.eye(2), np.eye(1), 2)
    law = jm.closed_loop.LinearFeedback(mpc, [[-1.0, -1.0]])
    with pytest.raises(ValueError, match=r"A: shape \(2,\) where"):
        jm.simulate_many(law, plant, np.ones((3, 2)), 2, variations={"A": np.ones((3, 2))})


def test_factors_of_other_shapes_are_named(arm):
    with pytest.raises(ValueError, match=r"factors\['mass'\]: shape \(4,\). Give \(B, "):
        plant_numbers(arm, {"mass": np.ones(4)})


HELD_OUT = """<mujoco><worldbody><body><joint name="j" axis="0 1 0" range="-86 86" damping=".1"/>
<geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass="1"/></body></worldbody>
<actuator><motor joint="j" ctrlrange="-5 5"/></actuator>
<keyframe><key name="home" qpos="0.9"/></keyframe></mujoco>"""


def test_starts_lie_within_the_limits_where_home_does_not():
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(HELD_OUT), position=0.5, velocity=2.0)
    home, below, above = start_room(robot)
    limit = np.array([0.5, 2.0])
    np.testing.assert_allclose([home - below, home + above], [-limit, limit], atol=1e-12)
