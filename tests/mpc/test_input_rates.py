"""Limits and weights of input rates stage by stage: beside the dense solver, cvxpy and differences,
in nonlinear problems and in closed loops of robots."""

from dataclasses import replace
from functools import cache, partial

import cvxpy as cp
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.mpc import NonlinearMPC, Task, solve_nonlinear, solve_stagewise

N, n, m = 7, 3, 2
PRECISE = jm.ADMM(eps=1e-10)
SOLVED = jm.Status.SOLVED


pytestmark = pytest.mark.usefixtures("x64")


@cache
def problem(seed):
    """A random problem with limits and weights of rates, and where it starts."""
    rng = np.random.default_rng(seed)
    system = jm.LinearSystem(
        np.eye(n) + 0.2 * rng.normal(size=(n, n)),
        rng.normal(size=(n, m)),
        0.05 * rng.normal(size=n),
    )
    root = rng.normal(size=(m, m))
    reach = jm.Soft(np.eye(n), -0.5 * np.ones(n), 0.5 * np.ones(n), 5.0, stages=(1, 3, N))
    bounds = jm.Box([-0.3, -0.2], [0.25, 0.35])
    mpc = jm.MPC(
        system, np.eye(n), 0.1 * np.eye(m), N, inputs=jm.Box(-np.ones(m), np.ones(m)),
        terminal_cost=2 * np.eye(n), soft=reach, prestabilise=False,
        input_rate_weight=root @ root.T, input_rate_limit=bounds,
        stage_weights=rng.uniform(0.5, 2, N), states=jm.Box(-5 * np.ones(n), 5 * np.ones(n)),
    )  # fmt: skip
    aim = rng.normal(size=(N + 1, n)) * 0.3, rng.normal(size=(N, m)) * 0.3
    return mpc, rng.normal(size=n) * 0.5, rng.uniform(-0.5, 0.5, m), *aim


def by_clarabel(mpc, x0, previous, states, inputs):
    """The cost and the inputs, by cvxpy."""
    x, u, e = cp.Variable((N + 1, n)), cp.Variable((N, m)), cp.Variable((3, n), nonneg=True)
    system, rules, s = mpc.system, [x[0] == x0], mpc.stage_weights
    cost = cp.quad_form(x[N] - states[N], mpc.terminal_cost) + 5 * cp.sum(e)
    for k in range(N):
        rules += [x[k + 1] == system.A @ x[k] + system.B @ u[k] + system.c, cp.abs(u[k]) <= 1]
        rate = u[k] - (u[k - 1] if k else previous)
        bounds = mpc.input_rate_limit
        rules += [rate >= bounds.lower, rate <= bounds.upper, cp.abs(x[k]) <= 5]
        cost += s[k] * cp.quad_form(x[k] - states[k], mpc.Q)
        cost += s[k] * cp.quad_form(u[k] - inputs[k], mpc.R)
        cost += cp.quad_form(rate, mpc.input_rate_weight)
    rules += [cp.abs(x[k]) <= 0.5 + e[i] for i, k in enumerate((1, 3, N))]
    found = cp.Problem(cp.Minimize(cost), rules)
    found.solve("CLARABEL", tol_gap_abs=1e-11, tol_gap_rel=1e-11, tol_feas=1e-11)
    return found.value, u.value


@pytest.mark.slow  # rates beside everything else, stage by stage: `test_varying.py`
@pytest.mark.parametrize("seed", range(4))
def test_plans_are_those_of_other_solvers(seed):
    mpc, x0, previous, states, inputs = problem(seed)
    aim = {"input_reference": inputs, "previous_input": previous}
    plan = solve_stagewise(mpc, x0, states, PRECISE, **aim)
    assert plan.status == SOLVED
    at_limit = np.abs(plan.multipliers.rates) > 1e-6
    assert at_limit.any() and not at_limit.all()
    cost, u = by_clarabel(mpc, x0, previous, states, inputs)
    np.testing.assert_allclose(plan.cost, cost, rtol=1e-8)
    np.testing.assert_allclose(plan.inputs, u, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_plans_are_those_of_the_dense_solver(seed):
    mpc, x0, previous, states, inputs = problem(seed)
    aim = {"input_reference": inputs, "previous_input": previous}
    plan = solve_stagewise(mpc, x0, states, PRECISE, **aim)
    dense = jm.solve(mpc, x0, states, PRECISE, **aim)
    assert plan.status == dense.status == SOLVED
    assert jax.tree.structure(plan) == jax.tree.structure(dense)
    for name in ("states", "inputs", "cost", "slack"):
        np.testing.assert_allclose(getattr(plan, name), getattr(dense, name), atol=1e-8)
    for ours, theirs in zip(
        *map(jax.tree.leaves, (plan.multipliers, dense.multipliers)), strict=True
    ):
        np.testing.assert_allclose(ours, theirs, atol=1e-7)


def test_a_shifted_plan_ends_within_its_rate_limits():
    """The optimum of one more step is far from the last input, beyond both kinds of limits."""
    mpc, *_ = problem(0)
    inputs, states = np.tile([0.9, -0.5], (N, 1)), np.full((N + 1, n), 4.0)
    rows = np.zeros(len(jm.mpc.row_table(mpc)))
    shifted = jax.jit(jm.Controller(mpc).shifted)
    tails = [shifted(jm.mpc.WarmStart(sign * states, inputs, rows)).inputs[-1] for sign in (1, -1)]
    ends = np.array([[0.6, 1.0], [-0.7, -0.15]])  # -0.3, +0.25 but 1 at most; -0.2, +0.35
    np.testing.assert_allclose(np.sort(tails, axis=0).T, ends)


@pytest.mark.slow
@pytest.mark.parametrize("without", ["input_rate_limit", "input_rate_weight"])
def test_limits_or_weights_alone(without):
    mpc, x0, previous, states, inputs = problem(1)
    mpc = replace(mpc, **{without: None}, stage_weights=None)
    aim = {"input_reference": inputs, "previous_input": previous}
    plan = solve_stagewise(mpc, x0, states, PRECISE, **aim)
    dense = jm.solve(mpc, x0, states, PRECISE, **aim)
    assert plan.status == dense.status == SOLVED
    np.testing.assert_allclose(plan.inputs, dense.inputs, atol=1e-8)


@pytest.mark.slow
def test_derivatives():
    """In u_{−1}, x0, the weight and the limits, against differences; and under vmap."""
    mpc, x0, previous, states, inputs = problem(2)
    rng = np.random.default_rng(0)
    du, dx, dW, dl = (rng.normal(size=shape) for shape in (m, n, (m, m), m))
    dW = dW + dW.T

    def total(h, x0):
        bounds = mpc.input_rate_limit
        bounds = jm.Box(bounds.lower + h * dl, bounds.upper + h * dl)
        W = mpc.input_rate_weight + h * dW
        moved = replace(mpc, input_rate_weight=W, input_rate_limit=bounds)
        aim = {"input_reference": inputs, "previous_input": previous + h * du}
        plan = solve_stagewise(moved, x0 + h * dx, states, PRECISE, **aim)
        return jnp.sum(plan.inputs**2), plan.status

    starts = np.stack([x0, 0.9 * x0, np.full(n, np.nan)])
    gradient = jax.jit(jax.vmap(jax.grad(total, has_aux=True), (None, 0)))
    backward, status = gradient(0.0, starts)
    np.testing.assert_array_equal(status, [SOLVED, SOLVED, jm.Status.NON_FINITE])
    h = 1e-6
    for slope, start in zip(backward[:2], starts, strict=False):
        difference = (total(h, start)[0] - total(-h, start)[0]) / (2 * h)
        np.testing.assert_allclose(slope, difference, rtol=1e-5)
    assert backward[2] == 0


def bent(x, u):
    return x + 0.2 * jnp.stack([x[1], jnp.sin(x[0]) + u[0]])


def with_input(z, u):
    return jnp.concatenate([bent(z[:2], u), u])


def rate(at):
    return at.u - at.x[2:]


@pytest.mark.slow
def test_nonlinear_problems_are_those_with_the_input_as_a_state():
    """The same problem written by hand: three states, the rate a task."""
    steps, step, W = 12, 0.3, 0.4
    inputs = jm.Box([-2.0], [2.0])
    system = jm.LinearSystem(np.eye(2), np.zeros((2, 1)))
    mpc = jm.MPC(system, np.eye(2), [[0.1]], steps, inputs=inputs, input_rate_limit=step,
                 input_rate_weight=W, terminal_cost=np.eye(2))  # fmt: skip
    x0, before = np.array([1.0, 0.0]), np.array([0.2])
    plan = solve_nonlinear(NonlinearMPC(mpc, bent), x0, previous_input=before, solver=PRECISE)
    larger = jm.LinearSystem(np.eye(3), np.zeros((3, 1)))
    by_hand = jm.MPC(larger, [1.0, 1.0, 0.0], [[0.1]], steps, inputs=inputs,
                     terminal_cost=[1.0, 1.0, 0.0])  # fmt: skip
    every = tuple(range(steps))
    task = Task(rate, weight=W, target=0.0, lower=-step, upper=step, rho=None, stages=every)
    z0 = np.append(x0, before)
    expected = solve_nonlinear(NonlinearMPC(by_hand, with_input, (task,)), z0, solver=PRECISE)
    assert plan.status == expected.status == SOLVED
    np.testing.assert_allclose(plan.inputs, expected.inputs, atol=1e-8)
    np.testing.assert_allclose(plan.states, expected.states[:, :2], atol=1e-8)
    np.testing.assert_allclose(plan.cost, expected.cost, rtol=1e-10)
    rates = np.diff(plan.inputs, axis=0, prepend=before[None])
    assert np.abs(rates).max() <= step + 1e-9
    np.testing.assert_allclose(np.abs(rates[0]), step, atol=1e-9)


T, J = 0.01, 0.05
JOINT = jm.LinearSystem(np.array([[1, T], [0, 1]]), np.array([[T * T / J], [T / J]]), dt=T)


@pytest.mark.slow
@pytest.mark.parametrize("linearize", ["state", "trajectory"])
def test_loops_of_a_linear_plant_are_those_of_the_dense_controller(linearize):
    limits = jm.Box([-1.5, -2.0], [1.5, 2.0]), jm.Box([-2.0], [2.0])
    plant = jm.LinearPlant(JOINT, *limits)
    mpc = jm.robot_mpc(plant, [100.0, 1.0], [0.01], 20, input_rate_limit=0.3, margin=0.0)
    start, goal = (
        np.array([-0.4, 0.0]),
        {"reference": np.array([0.2, 0.0]), "input_reference": [0.1]},
    )
    run = partial(jm.simulate, plant=plant, x0=start, steps=60, **goal)
    fixed = run(jm.RobotController(plant, mpc, PRECISE, linearize="set-point"))
    moved = run(jm.RobotController(plant, mpc, PRECISE, linearize=linearize))
    np.testing.assert_allclose(moved.inputs, fixed.inputs, atol=1e-6)
    # The input before the first is that of rest.
    rates = np.diff(moved.inputs, axis=0, prepend=0.1)
    assert np.abs(rates).max() <= 0.3 + 1e-9 and (np.abs(rates) > 0.3 - 1e-6).sum() > 3


@pytest.mark.slow
@pytest.mark.parametrize("how", [{}, {"linearize": "trajectory"}])
def test_torque_rates_of_an_arm(how):
    """Kept by the inputs that MJX gets, from the torque of rest on."""
    robot = jm.load_robot("arm2")
    x, u = robot.equilibrium()
    step = 400.0 * robot.dt
    mpc = jm.robot_mpc(robot, input_rate_limit=step)
    controller = jm.RobotController(robot, mpc, **how)
    starts = np.asarray(x) + np.array([[0.3, -0.4, 0, 0], [-0.3, 0.2, 0, 0], [0.2, 0.4, 0, 0]])
    goal = {"reference": robot.coordinates(x), "input_reference": u}
    run = jm.simulate_many(controller, robot, starts, 150, **goal)
    before = np.broadcast_to(u, (3, 1, 2))
    rates = np.abs(np.diff(np.concatenate([before, run.inputs], axis=1), axis=1))
    assert rates.max() <= step + 1e-9 and (rates > step - 1e-6).any()
    assert (run.status == SOLVED).all() and np.abs(run.states[:, -1] - x).max() < 1e-3
