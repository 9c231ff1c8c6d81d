"""Plans far outside their limits, where Newton steps on the active rows cycle."""

from dataclasses import replace
from functools import cache

import cvxpy as cp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import enable_x64

import jaxmpc as jm
from jaxmpc.mpc import Plan, solve_stagewise
from jaxmpc.mpc.problem import soften

N, n, m, COUNT = 12, 4, 2, 48
SOLVER = jm.ADMM(iterations=0)


def problem() -> jm.MPC:
    """A chain of two carts on springs with limits on all states, as robots have them."""
    A = np.eye(n) + 0.1 * np.array(
        [[0, 0, 1.0, 0], [0, 0, 0, 1.0], [2.0, 1.0, 0, 0], [1.0, 2.0, 0, -0.5]]
    )
    B = 0.1 * np.array([[0, 0], [0, 0], [1.0, 0.2], [0, 3.0]])
    Q, R = np.diag([1.0, 1.0, 0.01, 0.01]), np.diag([1e-3, 1e-3])
    mpc = jm.MPC(
        jm.LinearSystem(A, B, np.zeros(n)), Q, R, N, states=jm.Box(-np.ones(n), np.ones(n)),
        inputs=jm.Box([-3.0, -2.0], [3.0, 2.0]), terminal_cost=Q,
        constrained_stages=tuple(range(1, N + 1)),
    )  # fmt: skip
    return soften(mpc, 1e4)


@cache
def instances() -> tuple[np.ndarray, ...]:
    """A, B, c of each instance and states up to twice as far as the limits."""
    rng, system = np.random.default_rng(4), problem().system
    vary = lambda M: np.asarray(M) * (1 + 0.1 * rng.normal(size=(COUNT, *np.shape(M))))
    return (
        vary(system.A),
        vary(system.B),
        0.05 * rng.normal(size=(COUNT, n)),
        (rng.uniform(-2, 2, (COUNT, n))),
    )


@cache
def planned(kind: str = "hard", dtype: str = "float64", newton_steps: int | None = None) -> Plan:
    mpc, solver = PROBLEMS[kind], replace(SOLVER, newton_steps=newton_steps)
    with enable_x64(dtype == "float64"):
        data = [jnp.asarray(v, dtype) for v in instances()]
        mpc = jax.tree.map(lambda v: jnp.asarray(v, dtype), mpc)
        system = lambda *data: replace(mpc, system=jm.LinearSystem(*data))
        plan = lambda A, B, c, x: solve_stagewise(system(A, B, c), x, None, solver)
        return jax.tree.map(np.asarray, jax.jit(jax.vmap(plan))(*data))


def least_cost(mpc: jm.MPC, i: int) -> float:
    """The optimal value by Clarabel."""
    A, B, c, x0 = (v[i] for v in instances())
    x, u = cp.Variable((N + 1, n)), cp.Variable((N, m))
    soft = mpc.soft[0]
    rows = x[1:] @ np.asarray(soft.C).T
    over = cp.pos(rows - np.asarray(soft.upper)[None]) + cp.pos(np.asarray(soft.lower)[None] - rows)
    cost = sum(cp.quad_form(x[k], mpc.Q) + cp.quad_form(u[k], mpc.R) for k in range(N))
    cost += cp.quad_form(x[N], mpc.terminal_cost) + float(np.ravel(soft.rho)[0]) * cp.sum(over)
    rules = [x[0] == x0, u <= np.asarray(mpc.inputs.upper)[None]]
    rules += [u >= np.asarray(mpc.inputs.lower)[None]]
    rules += [x[k + 1] == A @ x[k] + B @ u[k] + c for k in range(N)]
    return float(cp.Problem(cp.Minimize(cost), rules).solve(solver=cp.CLARABEL))


MPC = problem()
PROBLEMS = {
    "hard": MPC,
    "quadratic": replace(MPC, soft=tuple(replace(s, rho=0.0, quadratic=1e3) for s in MPC.soft)),
}


@pytest.mark.parametrize("dtype", [pytest.param("float64", marks=pytest.mark.slow), "float32"])
@pytest.mark.slow
def test_every_plan_is_solved_however_far_outside(dtype):
    plan = planned(dtype=dtype)
    assert (plan.status == jm.Status.SOLVED).all()
    assert plan.slack.max() > 0.5 and plan.slack.min() == 0


@pytest.mark.slow
def test_newton_steps_alone_do_not_solve_them():
    plan = planned(newton_steps=20)
    assert (plan.status == jm.Status.SOLVED).mean() < 0.99


@pytest.mark.slow
def test_costs_are_those_of_another_solver():
    plan = planned()
    worst = np.argsort(-plan.slack.max(axis=(1, 2)))[[0, 1, COUNT // 2]]
    for i in worst:
        assert plan.cost[i] == pytest.approx(least_cost(MPC, int(i)), rel=1e-5)


@pytest.mark.slow
def test_penalties_may_be_quadratic_alone():
    assert (planned("quadratic").status == jm.Status.SOLVED).all()


@pytest.mark.slow
def test_states_that_are_not_finite_stay_by_themselves():
    A, B, c, x0 = instances()
    bad = x0.copy()
    bad[3], bad[7, 1] = np.nan, np.inf
    with enable_x64(True):
        plan = jax.jit(jax.vmap(
            lambda A, B, c, x: solve_stagewise(
                replace(MPC, system=jm.LinearSystem(A, B, c)), x, None, SOLVER
            )
        ))(A, B, c, bad)  # fmt: skip
    fine = np.delete(np.arange(COUNT), [3, 7])
    assert (plan.status[np.array([3, 7])] == jm.Status.NON_FINITE).all()
    np.testing.assert_array_equal(plan.inputs[fine], planned().inputs[fine])
