"""Plans far outside their limits, where Newton steps on the active rows cycle."""

from dataclasses import replace
from functools import cache, partial

import cvxpy as cp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import enable_x64

import jaxmpc as jm
from jaxmpc.mpc import Plan, solve_stagewise
from jaxmpc.mpc.plan import Aim
from jaxmpc.mpc.problem import soften
from jaxmpc.mpc.stagewise.newton_steps import INTERIOR_STEPS, Search
from jaxmpc.mpc.stagewise.solve import row_scale
from jaxmpc.mpc.stagewise.stages import Stages, measured_pair
from jaxmpc.qp.admm import default_rho

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
def test_steps_go_on_beside_a_pair_that_is_nearly_solved():
    """The method begins far off, whatever is known: that what it begins with is as near as 1e-5 is
    no reason to end it."""
    with enable_x64(True):
        x0 = jnp.asarray(instances()[-1][0])
        still = Aim(x0, jnp.zeros((N + 1, n)), jnp.zeros((N, m)), jnp.zeros(m))
        s, eps = Stages.of(MPC).aimed(still), jnp.asarray(1e-6)
        E = row_scale(s)
        fixed = jnp.where(E == 0, s.bounds.penalty_gradient(s.rows(*still[1:3])), 0.0)
        rho = jnp.broadcast_to(default_rho(E, N * m), E.shape)

        def loop(step, most, constants, state):
            if not most:  # no Newton steps before, which would solve it
                return state
            return jax.lax.while_loop(lambda state: state.open, partial(step, constants), state)

        @jax.jit
        def found(u, y):
            begin, yes = measured_pair(eps, s, u, y), jnp.asarray(True)
            return begin, Search(0, INTERIOR_STEPS, loop).from_pair(
                s, E, rho, fixed, eps, begin, yes
            )

        _, cold = found(jnp.zeros((N, m)), jnp.zeros_like(E))
        near, warm = found(cold.z * (1 + 1e-8), cold.y)
        assert cold.measured.within_tolerance and warm.measured.within_tolerance
        assert 1e-6 < near.error < 1e-3


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
