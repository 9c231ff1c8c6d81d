"""Closed loops against rollouts by hand, closed forms, and the theory of the value function."""

import re
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import jaxmpc as jm
from jaxmpc.closed_loop.simulation import Run, lyapunov_decrease, simulate
from jaxmpc.mpc.problem import Soft

# Compiles quickly.
CHEAP = jm.ADMM(iterations=400, newton_steps=0)
ONE_STEP = problems.scalar(a=2.0, horizon=1, x_max=5.0, u_max=1.0)


@pytest.mark.slow
def test_one_step_horizon_by_hand():
    """N = 1 without terminal cost: u = 0 is optimal, V(x) = x², and x doubles at each step."""
    with jax.enable_x64(True):
        run = simulate(jm.Controller(ONE_STEP), ONE_STEP.system, np.array([0.5]), 5)
    # 0.5, 1, 2, 4, 8: the plan at 8 > 5 is infeasible, and so is the next.
    np.testing.assert_allclose(run.inputs[:4], 0.0, atol=1e-9)
    np.testing.assert_allclose(run.states[:5, 0], [0.5, 1, 2, 4, 8], atol=1e-8)
    np.testing.assert_allclose(run.cost[:4], [0.25, 1, 4, 16], atol=1e-8)
    np.testing.assert_allclose(run.stage_cost[:4], run.cost[:4], atol=1e-8)
    np.testing.assert_allclose(run.violation[:5], [0, 0, 0, 0, 3], atol=1e-8)
    assert list(run.status) == [jm.Status.SOLVED] * 4 + [jm.Status.PRIMAL_INFEASIBLE]
    assert run.feasible_steps == 4
    # 4x² − x² + x² > 0: without a terminal cost the value is no Lyapunov function.
    np.testing.assert_allclose(lyapunov_decrease(run)[:3], [1.0, 4.0, 16.0], atol=1e-8)


def test_feasible_steps_end_at_the_first_failure():
    """A plan that is solved again later does not count; batches have their axes in front."""
    empty = np.zeros((3, 3))
    status = np.array([[1, 3, 1], [1, 1, 1], [12, 1, 1]])
    run = Run(empty, empty, empty, status, empty, empty, empty, empty)
    np.testing.assert_array_equal(run.feasible_steps, [1, 3, 0])


@pytest.mark.slow
def test_feasibility_lost_on_the_way():
    """The lecture's double integrator: (−1, 1) has a plan, its next state (−0.1, 0.75) has none."""
    mpc = problems.lecture()
    with jax.enable_x64(True):
        run = simulate(jm.Controller(mpc), mpc.system, np.array([-1.0, 1.0]), 3)
    np.testing.assert_allclose(run.states[1], [-0.1, 0.75], atol=1e-7)
    assert list(run.status)[:2] == [jm.Status.SOLVED, jm.Status.PRIMAL_INFEASIBLE]
    assert run.feasible_steps == 1


@pytest.mark.slow
def test_lyapunov_decrease_with_terminal_ingredients():
    """Terminal set O_inf and the cost of the DARE: V falls by at least the stage cost, from every
    feasible start; starts outside and NaN are told apart."""
    mpc = problems.joint_o_inf()
    inside = [[0.41, -0.92], [0.32, 0.92], [0.13, 1.74], [0.69, -1.3], [-0.6, -0.3], [0.0, 0.0]]
    starts = np.array([*inside, [-1.0, 1.9], [np.nan, 0.0]])
    with jax.enable_x64(True):
        controller = jm.Controller(mpc)
        run = jax.vmap(lambda x: simulate(controller, mpc.system, x, 30))(starts)
        # The same rollout by hand, from the inputs.
        x = starts.copy()
        for t in range(30):
            x = x @ mpc.system.A.T + np.asarray(run.inputs)[:, t] @ mpc.system.B.T
            np.testing.assert_allclose(run.states[:6, t + 1], x[:6], atol=1e-12)
        decrease = lyapunov_decrease(run)[:6]
        assert list(run.feasible_steps) == [30] * 6 + [0, 0]
    assert list(run.status[6:, 0]) == [jm.Status.PRIMAL_INFEASIBLE, jm.Status.NON_FINITE]
    assert np.all(np.asarray(decrease) <= 1e-9)
    assert np.all(np.asarray(run.violation[:6]) <= 1e-9) and np.isnan(run.violation[7]).all()


@dataclass
class Doubling:
    """A plant that JAX does not know: x⁺ = 2x + u + 1."""

    calls: list = field(default_factory=list)
    __hash__ = object.__hash__

    def step(self, x, u):
        self.calls.append(x)
        return 2 * x + u + 1


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Cubic:
    """A nonlinear plant whose coefficient is an argument of the program."""

    a: jax.Array

    def step(self, x, u):
        return x + u + self.a * x**3


@pytest.mark.slow
def test_plants_disturbance_and_references():
    """Any object with `step`; disturbances added; a reference that moves is seen N steps ahead."""
    mpc = problems.scalar(horizon=2, x_max=50.0, u_max=0.5, terminal_cost=np.eye(1))
    controller, x, w = jm.Controller(mpc, CHEAP), np.array([0.3]), np.array([[0.1], [-0.2], [0.3]])
    plant = Doubling()
    run = simulate(controller, plant, x, 3, disturbance=w)
    assert len(plant.calls) == 1, "traced once"
    for t in range(3):
        x = plant.step(x, run.inputs[t]) + w[t]
        np.testing.assert_allclose(run.states[t + 1], x, rtol=1e-5)

    # An integrator is where the reference wants it: x_t = t/4 with u = 1/4 costs nothing.
    run = simulate(
        controller, Cubic(0.0), np.zeros(1), 3, reference=np.arange(3 + 2)[:, None] / 4,
        input_reference=np.full((3 + 1, 1), 0.25),
    )  # fmt: skip
    np.testing.assert_allclose(run.states[:, 0], np.arange(4) / 4, atol=1e-4)
    np.testing.assert_allclose([run.cost, run.stage_cost], 0.0, atol=1e-5)
    assert run.states.dtype == jnp.float32


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps": 0}, "steps"),
        ({"steps": True}, "steps"),
        ({"x0": np.zeros(2)}, "x0"),
        ({"reference": np.zeros((3, 1))}, r"reference: shape \(3, 1\)"),
        ({"input_reference": np.zeros(2)}, "input_reference"),
        ({"disturbance": np.zeros((4, 2))}, "disturbance"),
        ({"previous_input": np.zeros(2)}, "previous_input"),
        ({"plant": object()}, "plant: is an object"),
        ({"plant": problems.joint().system}, "plant: has 2 states and 1 inputs"),
    ],
)
def test_wrong_arguments_are_named(change, message, one_step):
    arguments = {"plant": ONE_STEP.system, "x0": np.zeros(1), "steps": 4} | change
    with pytest.raises(ValueError, match=message):
        simulate(one_step, **arguments)


@pytest.fixture(scope="module")
def one_step():
    return jm.Controller(ONE_STEP)


def test_messages_say_what_to_give(one_step):
    wanted = re.escape("Give (1,) or (5, 1)")
    with pytest.raises(ValueError, match=wanted):
        simulate(one_step, ONE_STEP.system, np.zeros(1), 4, reference=np.zeros(7))


@pytest.mark.long
def test_previous_input_starts_the_loop():
    """Rate limits count from the input before the first sample: |u_0 − 1| ≤ 0.1."""
    mpc = problems.scalar(horizon=2, x_max=50.0, u_max=5.0, input_rate_limit=np.array([0.1]))
    controller = jm.Controller(mpc, CHEAP)
    run = simulate(controller, mpc.system, np.array([-3.0]), 3, previous_input=np.ones(1))
    # min (u_0 − 3)² + u_0² + (u_0 − 0.1)² within the limit: 31/30; then down by the whole limit.
    np.testing.assert_allclose(run.inputs[:, 0], np.array([31, 28, 25]) / 30, atol=1e-3)


@pytest.mark.slow
def test_soft_violation_is_reported():
    """A soft limit at 1: from x0 = 2 the violation is 1 at once, and 2 − 0.5 − 1 a step later."""
    rows = Soft(np.array([[1.0]]), upper=np.array([1.0]), rho=100.0)
    mpc = problems.scalar(horizon=2, x_max=None, u_max=0.5, soft=rows)
    with jax.enable_x64(True):  # in float32 rounding of the penalty is beyond the tolerance
        run = simulate(jm.Controller(mpc, CHEAP), mpc.system, np.array([2.0]), 3)
    np.testing.assert_allclose(run.slack[:, 0], [1.0, 0.5, 0.0], atol=1e-6)
    assert run.feasible_steps == 3


def test_a_run_is_printed_in_one_line():
    zeros = np.zeros(3)
    run = jm.closed_loop.Run(np.zeros((4, 2)), np.zeros((3, 1)), *[zeros] * 6)
    assert repr(run).startswith("Run(states (4, 2), inputs (3, 1), cost (3,)")
    assert "\n" not in repr(run) and "estimates" not in repr(run)
