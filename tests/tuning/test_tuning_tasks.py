"""Learning tasks from Python: what the command tunes, with the same functions."""

import json
import warnings
from dataclasses import replace

import jax
import mujoco
import numpy as np
import problems
import pytest

import jaxmpc as jm
from jaxmpc.closed_loop.simulation import Run
from jaxmpc.tuning.parameters import Parameter
from jaxmpc.tuning.result import CHECKPOINT, run_folder
from jaxmpc.tuning.tasks import TIGHTEST, initial_range, robot_task, weight_loss

SYSTEM = replace(problems.double_integrator(4).system, dt=1.0)
MPC = replace(problems.double_integrator(4), system=SYSTEM, terminal_cost=np.eye(2))
X0S = np.random.default_rng(0).uniform(-0.5, 0.5, (6, 2))


def test_parameters_say_what_is_tuned():
    found = jm.tuning.weight_parameters(
        MPC, ("Q", "P", "rho", "tightening"), weights="full", rho=3.0, margin=0.1, limits=MPC.states
    )
    assert list(found) == ["Q", "P", "rho", "tightening"]
    assert (found["Q"].domain, found["rho"].value) == ("definite", 3.0)
    assert found["tightening"].upper == TIGHTEST
    with pytest.raises(ValueError, match="tune rho: the problem has no soft limits"):
        jm.tuning.weight_parameters(MPC, ("rho",))
    with pytest.raises(ValueError, match="tune tightening, margin"):
        jm.tuning.weight_parameters(MPC, ("tightening",))


def test_the_problem_follows_the_values():
    """P as given, as Q, as the Riccati solution, or tuned; limits tightened; soft where rho is."""
    Q = np.diag([3.0, 2.0])

    def made(values, **settings):
        task = jm.tuning.linear_task(MPC, {}, X0S, **settings)
        return task.make(values)

    np.testing.assert_array_equal(made({"Q": Q}).terminal_cost, MPC.terminal_cost)
    np.testing.assert_array_equal(made({"Q": Q}, terminal_weight="Q").terminal_cost, Q)
    expected = jm.lqr(MPC.system, Q, MPC.R).P
    np.testing.assert_allclose(made({"Q": Q}, terminal_weight="lqr").terminal_cost, expected)
    P = 7 * np.eye(2)
    np.testing.assert_array_equal(made({"Q": Q, "P": P}, terminal_weight="lqr").terminal_cost, P)
    tight = made({"tightening": 0.2})
    np.testing.assert_allclose(tight.states.upper, 0.8 * np.asarray(MPC.states.upper))
    assert made({}).soft is None or not made({}).soft
    assert made({}, rho=5.0).soft


def test_loss_has_weights_of_its_own():
    loss = weight_loss(MPC.Q, MPC.R, MPC.states, tracking=[1.0, 2.0], tolerance=0.1)
    np.testing.assert_array_equal(loss.Q, np.diag([1.0, 2.0]))
    np.testing.assert_array_equal(loss.R, MPC.R)
    np.testing.assert_allclose(loss.band, 0.1 * MPC.states.half_widths())


def test_initial_states_lie_in_the_range():
    limits = np.array([-1.0, -np.inf]), np.array([3.0, np.inf])
    with pytest.raises(ValueError, match="lower, upper: the state limits do not bound"):
        initial_range(limits)
    low, high = initial_range((limits[0][:1], limits[1][:1]))
    assert low == -1 and high == 3
    with pytest.raises(ValueError, match="lower: has 2 numbers"):
        initial_range((limits[0][:1], limits[1][:1]), lower=(0.0, 1.0))


def test_a_folder_is_opened_resumed_and_given_back(tmp_path):
    options, files = {"seed": 1}, ("run.json", "picture.png")
    with run_folder(tmp_path, files, options, False, False) as checkpoint:
        assert checkpoint == tmp_path / CHECKPOINT
        checkpoint.write_bytes(b"1")
    assert json.loads((tmp_path / "run.json").read_text())["options"] == options
    with pytest.raises(ValueError, match="exists"), run_folder(tmp_path, files, {}, False, False):
        pass
    with pytest.raises(ValueError, match="seed: 1 there, 2 here"):
        with run_folder(tmp_path, files, {"seed": 2}, True, False):
            pass
    (tmp_path / "picture.png").write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt):
        with run_folder(tmp_path, files, options, False, True):
            assert not (tmp_path / "picture.png").exists()
            raise KeyboardInterrupt  # before the first checkpoint
    assert (tmp_path / "picture.png").read_bytes() == b"old"
    with run_folder(tmp_path, files, options, False, True) as checkpoint:
        checkpoint.write_bytes(b"2")
    assert {path.name for path in tmp_path.iterdir()} == {"run.json", CHECKPOINT}


@pytest.mark.slow
def test_a_task_is_tuned_simulated_and_counted():
    parameters = jm.tuning.weight_parameters(MPC)
    task = jm.tuning.linear_task(MPC, parameters, X0S, steps=3, validation=0.34)
    run = task.tune(updates=1, mode="forward")
    assert run.settings["validation"] == task.validation == 2
    counts = task.counts(task.simulate(lambda: run.mpc), 0.02)
    assert counts["loops"] == 2 and counts["plans"] == 6 and counts["violated"] == 0


def test_terms_of_a_loss_add_up_and_warn_of_nothing():
    """The mean of each over float64 loops, from outside of float64 mode, in the order of TERMS."""
    limits = jm.Box([-1.0, -1.0], [1.0, 1.0])
    system = jm.LinearSystem([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]], dt=0.1)
    mpc = jm.MPC(system, np.eye(2), 0.1, 3, limits, jm.Box(-1, 1))
    task = jm.tuning.linear_task(
        mpc, jm.tuning.weight_parameters(mpc), np.eye(2), settling=2.0, steps=2
    )
    states = np.array([[[2.0, 0.0], [0.0, 0.0], [0.0, 0.0]], [[0.0, 0.0]] * 3])
    none = np.zeros((2, 2))
    run = Run(states, np.ones((2, 2, 1)), *([none] * 6))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        terms = task.terms(run)
    assert list(terms) == ["tracking", "effort", "violation", "settling"]
    np.testing.assert_allclose(list(terms.values()), [1.0, 0.1, 10 * 0.25, 0.0], atol=1e-3)


SERVOS = """<mujoco><option timestep=".005" integrator="implicitfast"/><worldbody>
<body><joint name="a" axis="0 1 0" range="-1 1" damping=".1" armature=".05"/>
<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass="1"/></body></worldbody>
<actuator><position joint="a" kp="60" kv="3" ctrlrange="-1 1" forcerange="-8 8"/></actuator>
</mujoco>"""
# A lift too weak for its load, and one beside an object that no input moves.
WEAK = """<mujoco><worldbody><body><joint name="a" type="slide" axis="0 0 1" range="-1 1"/>
<geom size=".1" mass="1"/></body></worldbody>
<actuator><motor joint="a" ctrlrange="-5 5"/></actuator></mujoco>"""
BESIDE = WEAK.replace(
    "<worldbody>",
    """<option gravity="0 0 0"/><worldbody><body pos="0 1 0">
<joint name="object" type="slide" damping=".5"/><geom size=".1" mass="1"/></body>""",
)


@pytest.mark.long
@pytest.mark.parametrize("text", [SERVOS, WEAK, BESIDE])
def test_the_tuned_robot_has_the_problem_of_its_file(text):
    """Of `robot_mpc` with the tuned weights and margin: terminal cost and rows that stop joints."""
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(text), velocity=2.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the set-points
        mpc = jm.robot_mpc(robot, horizon=4)
        parameters = {"Q": Parameter(mpc.Q, "diagonal"), "tightening": Parameter(0.02)}
        task = robot_task(robot, mpc, parameters, np.tile(robot.home, (4, 1)))
        Q = mpc.Q * np.linspace(1, 3, robot.n)
        expected = jm.robot_mpc(robot, Q, mpc.R, horizon=4, margin=0.3)
        found = task.make({"Q": Q, "tightening": 0.3}).mpc
        with jax.enable_x64(True):
            traced = jax.jit(lambda Q, t: task.make({"Q": Q, "tightening": t}).mpc)(Q, 0.3)
    for made in (found, traced):
        assert (made.terminal_cost is None) == (expected.terminal_cost is None) == (text == WEAK)
        for one, other in zip(jax.tree.leaves(made), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)
    if text == SERVOS:
        loose = jm.robot_mpc(robot, Q, mpc.R, horizon=4)
        assert np.abs(found.outputs[1].upper - loose.outputs[1].upper).max() > 1e-3
