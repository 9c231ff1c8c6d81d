"""The interior point method stage by stage where steps became short or had no interior."""

from dataclasses import replace

import cvxpy as cp
import jax
import numpy as np
import pytest

import jaxmpc as jm


def least_cost(mpc, x0):
    """The optimal value, by Clarabel."""
    system, N = mpc.system, mpc.horizon
    x, u = cp.Variable((N + 1, system.n)), cp.Variable((N, system.m))
    cost, rows = 0.0, [x[0] == x0, cp.abs(u) <= mpc.inputs.upper[None, :]]
    for k in range(N):
        rows.append(x[k + 1] == system.A @ x[k] + system.B @ u[k])
        cost += cp.quad_form(x[k], mpc.Q) + cp.quad_form(u[k], mpc.R)
    [soft] = mpc.soft
    for k in soft.stages:
        violation = cp.pos(soft.C @ x[k] - soft.upper) + cp.pos(soft.lower - soft.C @ x[k])
        cost += cp.sum(cp.multiply(soft.rho, violation))
    problem = cp.Problem(cp.Minimize(cost), rows)
    return problem.solve(solver="CLARABEL", tol_gap_rel=1e-10, tol_feas=1e-10)


@jax.jit
@jax.vmap
def solve(mpc, x0):
    return jm.mpc.solve_stagewise(mpc, x0, solver=jm.ADMM(iterations=0))


COUNT, N, n, m = 64, 20, 4, 2  # of all tests, which share a program
STAGES = (0, 1, *range(3, N))  # of the soft rows


def softened(mpc, rho):
    [rows] = jm.soften(mpc, rho).soft
    return replace(mpc, states=None, soft=(replace(rows, stages=STAGES),))


def stacked(problems):
    return jax.tree.map(lambda *v: np.stack(v), *(jax.tree.map(np.asarray, p) for p in problems))


@pytest.mark.long
def test_plans_from_far_outside_soft_limits_are_solved():
    """States up to 2.5 times beyond soft limits of a small weight, of which most plans once ended
    at the limit of steps; their costs are least."""
    rng, k, count = np.random.default_rng(0), m, 8
    W, G = rng.normal(size=(2, k, k))
    inverse = np.linalg.inv(np.eye(k) + W @ W.T / k)
    A = np.block([[np.zeros((k, k)), np.eye(k)], [-inverse @ (G + G.T) / 2, -0.5 * inverse]])
    system = jm.LinearSystem.from_continuous(A, np.vstack([np.zeros((k, k)), inverse]), 0.05)
    limit = np.repeat([1.0, 0.8], k)
    mpc = jm.MPC(
        system, np.repeat([10.0, 1.0], k), 0.1 * np.ones(k), N, states=jm.Box(-limit, limit),
        inputs=jm.Box(-3 * np.ones(k), 3 * np.ones(k)), prestabilise=False,
    )  # fmt: skip
    soft = softened(mpc, np.full(n, 10.0))
    x0s = rng.uniform(-2.5, 2.5, (count, 2 * k)) * limit
    with jax.enable_x64(True):
        plan = solve(stacked([soft] * COUNT), np.resize(x0s, (COUNT, n)))
    assert np.all(plan.status == jm.Status.SOLVED)
    for x0, cost in zip(x0s, plan.cost[:count], strict=True):
        np.testing.assert_allclose(cost, least_cost(soft, x0), rtol=1e-6)


@pytest.mark.long
def test_soft_rows_without_a_penalty_are_no_rows():
    """A multiplier z with 0 < z < ρ does not exist for ρ = 0: the interior point method had no
    interior. Beside the same problem without such rows."""
    rng = np.random.default_rng(0)
    problems = []
    for _ in range(COUNT):
        system = jm.LinearSystem(0.4 * rng.normal(size=(n, n)), rng.normal(size=(n, m)), dt=0.05)
        rho = rng.choice([0.0, 0.5, 2.0], n)
        box = jm.Box(-np.ones(n), np.ones(n))
        inputs = jm.Box(-0.2 * np.ones(m), 0.3 * np.ones(m))
        mpc = jm.MPC(system, np.eye(n), 0.1 * np.eye(m), N, states=box, inputs=inputs,
                     prestabilise=False)  # fmt: skip
        mpc = softened(mpc, np.ones(n))
        limits = {"lower": -0.2 * np.ones(n), "upper": 0.1 * np.ones(n), "rho": rho}
        soft = replace(mpc.soft[0], C=rng.normal(size=(n, n)), **limits)
        free = np.where(rho > 0, 0.1, np.inf)
        none = replace(soft, lower=np.minimum(-0.2, -free), upper=free)
        problems.append([replace(mpc, soft=(rows,)) for rows in (soft, none)])
    x0s = rng.normal(size=(COUNT, n))
    with jax.enable_x64(True):
        plans, others = (solve(stacked(mpcs), x0s) for mpcs in zip(*problems, strict=True))
    assert np.all(plans.status == jm.Status.SOLVED) and np.all(others.status == jm.Status.SOLVED)
    np.testing.assert_allclose(plans.cost, others.cost, rtol=1e-7)


@pytest.mark.long
def test_plans_that_dose_nothing():
    """u ≥ 0 alone: with A, B, x0 ≥ 0 all states, and all costs, grow with every input."""
    rng, problems, costs = np.random.default_rng(0), [], []
    x0s = rng.uniform(1, 5, (COUNT, n))
    for x in x0s:
        A = rng.uniform(0, 1, (n, n))
        A *= rng.uniform(0.5, 0.95) / np.abs(np.linalg.eigvals(A)).max()
        system = jm.LinearSystem(A, rng.uniform(0, 1, (n, m)), dt=0.05)
        far = jm.Box(np.zeros(n), np.full(n, 100.0))
        doses = jm.Box(np.zeros(m), np.full(m, np.inf))
        mpc = jm.MPC(system, np.eye(n), 0.1 * np.eye(m), N, states=far, inputs=doses,
                     prestabilise=False)  # fmt: skip
        problems.append(softened(mpc, np.ones(n)))
        costs.append(sum(np.sum((np.linalg.matrix_power(A, k) @ x) ** 2) for k in range(N)))
    with jax.enable_x64(True):
        plans = solve(stacked(problems), x0s)
    assert (plans.status == jm.Status.SOLVED).all()
    np.testing.assert_allclose(plans.cost, costs, rtol=1e-8)
    # The last inputs hardly cost anything.
    np.testing.assert_allclose(plans.inputs[:, 0], 0, atol=1e-8)
