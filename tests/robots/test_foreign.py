"""Models that nobody here wrote against MuJoCo's C engine; `pip install -e '.[models]'` brings
them, `experiments/robots/foreign.py` lists them."""

import sys
import warnings
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest
from c_engine import c_steps, c_transition, data_at

import jaxmpc as jm

sys.path.append(str(Path(__file__).parents[2] / "experiments" / "robots"))
import foreign  # noqa: E402

SHORT = (
    "gym/inverted_double_pendulum", "gym/ant", "gym/humanoid", "gym/pusher", "gr/hand/reach",
    "gr/fetch/pick_and_place", "gr/adroit_hand/adroit_door", "urdf/panda", "urdf/baxter",
    "urdf/anymal_b",
)  # fmt: skip
STEPPED = (
    "gym/inverted_pendulum", "gym/reacher", "gym/swimmer", "gym/hopper", "gym/half_cheetah",
    "gym/ant", "suite/ball_in_cup", "suite/finger", "suite/fish", "suite/hopper", "suite/quadruped",
    "urdf/panda", "urdf/go2_free",
)  # fmt: skip


def loaded(name):
    """A robot, its set-point and the warnings; the test is skipped where a package is missing."""
    try:
        model, options = foreign.catalogue()[name]()
    except ImportError as error:
        pytest.skip(f"{error}: pip install -e '.[models]'")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        robot = jm.load_robot(model, **options)
        x, u = robot.set_point()
    return robot, x, u, " ".join(str(warning.message) for warning in said)


@pytest.mark.parametrize("name", SHORT)
@pytest.mark.first(1)
def test_set_points_balance_or_say_so(name):
    robot, x, u, said = loaded(name)
    data = data_at(robot.predictor.model, x, u)
    mujoco.mj_forward(robot.predictor.model, data)
    missing, forces = np.abs(data.qfrc_smooth).max(), np.abs(data.qfrc_bias).max()
    assert (missing > 1e-6 * (1 + forces)) == ("does not rest" in said)
    for values, box in ((u, robot.input_limits), (robot.coordinates(x), robot.state_limits)):
        assert np.all((np.asarray(box.lower) - 1e-6 <= values) & (values <= box.upper + 1e-6))
    assert robot.name in str(robot.report())


@pytest.mark.slow
@pytest.mark.parametrize("name", STEPPED)
def test_steps_and_their_derivatives_are_the_c_engines(name):
    """In the air (the set-point, moved a little, off the stops of joints, where derivatives have
    two sides) and after half a second of falling, in contact where the model has any; steps in both
    precisions, derivatives in float64."""
    robot, x, u, _ = loaded(name)
    model, rng = robot.mujoco, np.random.default_rng(0)
    u = u + 0.01 * rng.normal(size=robot.m)
    fallen = c_steps(model, x, u, round(0.5 / model.opt.timestep))
    x[model.nq : model.nq + model.nv] = 0.1 * rng.normal(size=model.nv)
    stops = np.flatnonzero(model.jnt_limited)
    at, ends = model.jnt_qposadr[stops], model.jnt_range[stops].T
    x[at] = np.clip(x[at], ends[0] + 1e-3, ends[1] - 1e-3)
    with jax.enable_x64(True):
        step, transition = jax.jit(robot.plant.step), robot.transition
        for state in (x, fallen):
            after = c_steps(model, state, u, 1)
            size = 1 + np.abs(after).max()
            np.testing.assert_allclose(step(state, u), after, rtol=0, atol=1e-6 * size)
            found, wanted = transition(state, u), c_transition(robot, state, u)
            size = np.abs(wanted[0]).max()
            for a, b in zip(found, wanted, strict=True):
                np.testing.assert_allclose(a, b, rtol=0, atol=1e-4 * size)
    step = jax.jit(robot.plant.step)
    for state in (x, fallen):
        after = c_steps(model, state, u, 1)
        narrow = step(np.float32(state), np.float32(u))
        np.testing.assert_allclose(narrow, after, rtol=0, atol=1e-3 * (1 + np.abs(after).max()))
