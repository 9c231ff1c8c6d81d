"""ADMM stage by stage against the dense solver and a condensed QP built here with numpy."""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import daqp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import enable_x64
from jax.sharding import AxisType, PartitionSpec
from problems import lecture, residuals, rows_of, symmetric, unstable_systems

import jaxmpc as jm
from jaxmpc.mpc.plan import Aim, WarmStart
from jaxmpc.mpc.stagewise import newton_steps, solve, stages
from jaxmpc.mpc.stagewise.solve import factor_stages, plan_stages, solve_stagewise
from jaxmpc.qp import admm

N, n, m = 8, 3, 2
SOLVER = jm.ADMM(iterations=20, newton_steps=5)  # ADMM alone leaves 1e-3


pytestmark = pytest.mark.usefixtures("x64")


@cache
def problem() -> jm.MPC:
    """Every kind of row that there is; soft ones that must give way."""
    rng = np.random.default_rng(1)
    A = np.array([[1.0, 0.3, 0.0], [-0.2, 0.9, 0.2], [0.0, 0.1, 0.8]])
    B, c = np.array([[0.0, 0.1], [0.6, 0.0], [0.0, 0.5]]), np.array([0.02, 0, -0.01])
    system = jm.LinearSystem(A, B, c)
    Q, R = np.diag([2.0, 1.0, 0.5]), np.array([[0.4, 0.1], [0.1, 0.3]])
    H = rng.normal(size=(4, n))
    return jm.MPC(
        system, Q, R, N, states=symmetric(1.0, 0.7, 1.2), inputs=symmetric(0.4, 0.3),
        terminal_cost=jm.lqr(system, Q, R).P,
        terminal_set=jm.Polytope(np.vstack([H, -H]), np.full(8, 0.9)),
        outputs=jm.Outputs(
            [[0.2, 0.5, 0.0], [0.0, 0.3, 0.4]], [-0.3, -0.3], [0.35, np.inf],
            [[1.0, 0.0], [0.5, -1.0]], stages=(0, 2, 5),
        ),
        soft=jm.Soft(
            np.array([[0.0, 1.0, 0.5]]), upper=np.array([-0.5]), rho=0.3, quadratic=2.0,
            stages=(1, 2, 3, 4),
        ),
        prestabilise=False,
    )  # fmt: skip


X0 = np.array([0.7, 0.35, -0.4])


@cache
def varying(drift: bool = True) -> jm.LinearSystem:
    """Another A, B, c at each step."""
    rng, system = np.random.default_rng(2), problem().system
    move = lambda M: np.asarray(M) + 0.05 * rng.normal(size=(N, *np.shape(M)))
    return jm.LinearSystem(*(move(M) for M in (system.A, system.B, system.c)))


def condensed(mpc: jm.MPC, system: jm.LinearSystem, x0: np.ndarray) -> tuple:
    """(QP in the inputs, what x0 and c add to its rows), with numpy and loops."""
    A, B, c = (
        np.broadcast_to(M, (N, *shape))
        for M, shape in zip((system.A, system.B, system.c), ((n, n), (n, m), (n,)), strict=True)
    )
    x, X = [x0], [np.zeros((n, N * m))]  # x_k = x[k] + X[k] z
    U = np.eye(N * m).reshape(N, m, N * m)
    for k in range(N):
        x.append(A[k] @ x[k] + c[k])
        X.append(A[k] @ X[k] + B[k] @ U[k])
    W = [mpc.Q] * N + [mpc.terminal_cost]
    P = 2 * sum(X[k].T @ W[k] @ X[k] for k in range(N + 1)) + 2 * sum(u.T @ mpc.R @ u for u in U)
    q = 2 * sum(X[k].T @ W[k] @ x[k] for k in range(N + 1))
    o, s, last = mpc.outputs, mpc.soft, mpc.terminal_set
    none = np.full(len(last.h), -np.inf)
    blocks = (
        (np.zeros((m, n)), np.eye(m), mpc.inputs.lower, mpc.inputs.upper, range(N)),
        (np.eye(n), np.zeros((n, m)), mpc.states.lower, mpc.states.upper, range(N)),
        (np.array(o.C), np.array(o.D), o.lower, o.upper, o.stages),
        (np.array(s.C), np.zeros((1, m)), [-np.inf], s.upper, s.stages),
        (last.H, np.zeros((len(last.h), m)), none, last.h, (N,)),
    )
    C, shift, lower, upper = [], [], [], []
    for H, D, low, high, steps in blocks:
        for k in steps:
            C.append(H @ X[k] + (D @ U[k] if k < N else 0))
            shift.append(H @ x[k])
            lower.append(low)
            upper.append(high)
    C, shift, lower, upper = map(np.concatenate, (C, shift, lower, upper))
    soft = np.zeros(len(C), bool)
    soft[-len(last.h) - len(s.stages) : -len(last.h)] = True
    qp = jm.QP(
        (P + P.T) / 2, q, C, lower - shift, upper - shift, np.where(soft, s.rho, np.inf),
        np.where(soft, 2 * s.quadratic, 0.0),
    )  # fmt: skip
    return jax.tree.map(jnp.asarray, qp), shift


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["constant", "varying"])
def test_iterates_are_those_of_the_dense_solver(kind):
    mpc = problem()
    system = mpc.system if kind == "constant" else varying()
    qp, shift = condensed(mpc, system, X0)
    count = qp.l.shape[0]
    # Two penalties a row, one after the other.
    rho = np.stack([np.geomspace(0.3, 3, count), np.geomspace(5, 0.5, count)])
    settings = jm.ADMM(iterations=50, rho=rho)
    dense = admm.factorise(qp.P, qp.A, settings)
    factor = factor_stages(replace(mpc, system=system), settings)
    E, E_dense = np.asarray(factor.E), np.asarray(dense.E)
    np.testing.assert_array_equal(E == 0, E_dense == 0)
    np.testing.assert_allclose(E, E_dense, rtol=1e-4)
    # In rows of the problem's own units the penalties are rho E²: make them the same.
    moved = E > 0
    rho = np.where(moved, settings.rho * (E / np.where(moved, E_dense, 1)) ** 2, 1)
    dense = admm.factorise(qp.P, qp.A, replace(settings, rho=rho))
    program = admm.ScaledProgram.of(qp, dense, unit=1.0)
    schedule = admm.splittings(dense, program.q)
    t, _ = admm.iterate(schedule, program.bounds, jnp.zeros(count), 50, settings.alpha)
    aim = Aim(jnp.asarray(X0), jnp.zeros((N + 1, n)), jnp.zeros((N, m)))
    staged = replace(factor.stages, aim=aim)
    bounds = staged.bounds.scaled(factor.E)
    still = stages.predict(staged, jnp.zeros((N, m)))
    first = E * staged.rows(still, jnp.zeros((N, m)))
    schedule, free = solve.stage_splittings(factor, staged)
    t_stages, _ = admm.iterate(schedule, bounds, first, 50, settings.alpha)
    u, _ = solve.read(factor, staged, bounds, t_stages, free)
    expected = np.asarray(t)[moved] / E_dense[moved] + shift[moved]
    np.testing.assert_allclose(np.asarray(t_stages)[moved] / E[moved], expected, atol=1e-9)
    w, y = admm.read(dense, t, program.q, program.bounds)
    np.testing.assert_allclose(u.ravel(), dense.T @ w, atol=1e-9)
    s = bounds.project(t_stages, factor.rho[-1])
    y_stages = E * factor.rho[-1] * (t_stages - s)
    np.testing.assert_allclose(y_stages, np.where(moved, E_dense * y, 0), atol=1e-8)


@pytest.mark.slow
def test_plan_is_that_of_solve():
    """All fields, with references."""
    mpc = problem()
    rng = np.random.default_rng(3)
    aims = rng.normal(size=(N + 1, n)) / 10, rng.normal(size=(N, m)) / 10
    plan = solve_stagewise(mpc, X0, aims[0], SOLVER, input_reference=aims[1])
    exact = jm.solve(mpc, X0, aims[0], jm.ADMM(iterations=400), input_reference=aims[1])
    assert plan.status == exact.status == jm.Status.SOLVED
    assert np.max(exact.slack) > 0.01 and np.sum(np.abs(rows_of(mpc, exact)) > 1e-3) > 5
    for name in ("states", "inputs", "cost", "slack"):
        np.testing.assert_allclose(
            getattr(plan, name), getattr(exact, name), atol=1e-8, err_msg=name
        )
    ours, theirs = jax.tree.leaves(plan.multipliers), jax.tree.leaves(exact.multipliers)
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
    assert max(plan.primal_residual, plan.dual_residual, plan.gap) < 1e-9
    assert jax.tree.structure(plan) == jax.tree.structure(exact)


@pytest.mark.long
def test_rounding_of_weights_is_no_curvature():
    """Weights of zero may be −1e-18, as in `solve`; what is curved downward is found in any
    unit."""
    mpc = problem()
    n = mpc.system.n
    for least, status in ((-1e-18, jm.Status.SOLVED), (-0.1, jm.Status.NON_CONVEX)):
        Q = np.diag([1.0] + [least] * (n - 1))
        plan = jax.jit(lambda Q: solve_stagewise(replace(mpc, Q=Q), np.zeros(n)))(Q)
        assert plan.status == status


@pytest.mark.slow
def test_varying_system():
    """Optimal for the QP built by hand, to rounding after five Newton steps."""
    mpc, system = problem(), varying()
    plan = solve_stagewise(replace(mpc, system=system), X0, solver=SOLVER)
    assert plan.status == jm.Status.SOLVED
    qp, _ = condensed(mpc, system, X0)
    assert max(residuals(qp, plan.inputs.ravel(), rows_of(mpc, plan))) < 1e-9
    assert max(plan.primal_residual, plan.dual_residual, plan.gap) < 1e-9
    # Signs and sizes of the multipliers are admissible: their conjugate is finite.
    assert np.isfinite(qp.bounds.support(rows_of(mpc, plan))).all() and np.max(plan.slack) > 0.01


@pytest.mark.slow
def test_derivative():
    """Backward against differences, in A, x0 and a limit; zero where the data are NaN."""
    mpc, system = problem(), varying()
    batch = jax.tree.map(lambda v: np.stack([v, v]), system)
    batch.A[1, 3, 0, 0] = np.nan
    rng = np.random.default_rng(5)
    dA, dx, dd = (rng.normal(size=shape) for shape in ((N, n, n), n, 1))

    def total(h, system):
        moved = replace(system, A=system.A + h * dA)
        soft = replace(mpc.soft, upper=mpc.soft.upper + h * dd)
        plan = solve_stagewise(replace(mpc, soft=soft, system=moved), X0 + h * dx, solver=SOLVER)
        return jnp.sum(plan.inputs)

    backward = jax.jit(jax.vmap(jax.grad(total), in_axes=(None, 0)))(0.0, batch)
    h = 1e-5
    difference = (total(h, system) - total(-h, system)) / (2 * h)
    np.testing.assert_allclose(backward, [difference, 0], rtol=1e-6)


def dense_jacobian(mpc, x0):
    """The derivative (N, 1, 2) of the plan's inputs in x0: of the linear system of its active rows,
    which DAQP finds."""
    N, A, B, last = mpc.horizon, mpc.system.A, mpc.system.B, mpc.terminal_set
    X = [np.linalg.matrix_power(A, k) for k in range(N + 1)]  # x_k = X[k] x0 + U[k] u
    U = [np.zeros((2, N))]
    for k in range(N):
        U.append(A @ U[k] + B * np.eye(N)[k])
    weights = [mpc.Q] * N + [mpc.terminal_cost]
    P = 2 * (mpc.R[0, 0] * np.eye(N) + sum(u.T @ W @ u for u, W in zip(U, weights, strict=True)))
    F = 2 * sum(u.T @ W @ x for u, W, x in zip(U, weights, X, strict=True))
    sides = np.vstack([np.eye(2), -np.eye(2)])
    bounds = np.concatenate([mpc.states.upper, -mpc.states.lower])
    G = np.vstack([*(sides @ u for u in U[1:N]), np.eye(N), -np.eye(N), last.H @ U[N]])
    D = np.vstack([*(sides @ x for x in X[1:N]), np.zeros((2 * N, 2)), last.H @ X[N]])
    limit = [np.repeat(mpc.inputs.upper, N), np.repeat(-mpc.inputs.lower, N)]
    h = np.concatenate([np.tile(bounds, N - 1), *limit, last.h]) - D @ x0
    found = daqp.solve(P, F @ x0, G, h, np.full(len(h), -1e30), np.zeros(len(h), np.int32))
    assert found[2] == 1
    active = found[3]["lam"] > 1e-8
    rows, count = G[active], active.sum()
    assert count > 0
    K = np.block([[P, rows.T], [rows, np.zeros((count, count))]])
    return np.linalg.solve(K, -np.vstack([F, D[active]]))[:N, None]


@pytest.mark.slow
def test_derivative_in_float32():
    """Against that of the conditions of optimality in float64, where an input costs 10⁻⁴ and active
    rows are nearly parallel: by a Riccati recursion in float32 alone it was off by 0.3."""
    slanted = np.array([[1.0, 1.0], [1.0, 1.02]])
    mpc = jm.MPC(
        jm.LinearSystem([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]]), np.diag([1.0, 0.1]),
        np.array([[1e-4]]), 20, states=symmetric(5.0, 0.5), inputs=symmetric(1.0),
        terminal_cost=np.diag([10.0, 1.0]),
        terminal_set=jm.Polytope(np.vstack([slanted, -slanted]), np.full(4, 0.1)),
    )  # fmt: skip
    states = np.array([[0.47, 0.213], [1.03, 0.277], [0.31, -0.431], [0.57, 0.463]])
    exact = lambda v: np.asarray(np.asarray(v, np.float32), np.float64)
    expected = np.stack([dense_jacobian(jax.tree.map(exact, mpc), exact(x)) for x in states])
    single = jax.tree.map(np.float32, (mpc, states))
    inputs = lambda mpc, x: solve_stagewise(mpc, x).inputs
    found = np.asarray(jax.jit(jax.vmap(jax.jacrev(inputs, argnums=1), (None, 0)))(*single))
    assert found.dtype == np.float32
    scale = np.abs(expected).max(axis=(1, 2, 3), keepdims=True)
    np.testing.assert_allclose(found / scale, expected / scale, atol=1e-4)


@pytest.mark.parametrize(
    ("weights", "message"),
    [([1.0, -1.0, 1.0, 1.0], "stage_weights.*at least 0"), (np.ones(3), r"stage_weights.*\(4,\)")],
)
def test_wrong_stage_weights(weights, message):
    mpc = jm.MPC(jm.LinearSystem(np.eye(2), np.eye(2)), np.eye(2), np.eye(2), 4)
    with pytest.raises(ValueError, match=message):
        replace(mpc, stage_weights=weights).validate()


def test_gradients_after_steps_of_admm_alone_are_traced():
    """With rows of each kind, at some of the stages."""
    cost = lambda x: solve_stagewise(problem(), x, solver=jm.ADMM(5, newton_steps=0)).cost
    assert jax.eval_shape(jax.grad(cost), X0).shape == (n,)


@pytest.mark.slow  # beside limits: `test_varying.py`
def test_stage_weights():
    """Without limits the plan is a least-squares solution, here numpy's; both solvers find it."""
    s, rng = np.array([1.0, 0.5, 2.0, 0.1]), np.random.default_rng(0)
    A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.0], [0.1]])
    r, v, x0 = rng.normal(size=(5, 2)), rng.normal(size=(4, 1)), np.array([1.0, -0.5])
    mpc = jm.MPC(
        jm.LinearSystem(A, B), np.eye(2), np.eye(1), 4, terminal_cost=np.eye(2), stage_weights=s
    )
    free = [np.linalg.matrix_power(A, k) @ x0 for k in range(5)]
    push = np.zeros((5, 2, 4))
    for k in range(1, 5):
        for j in range(k):
            push[k, :, j] = (np.linalg.matrix_power(A, k - 1 - j) @ B)[:, 0]
    root = np.sqrt(np.append(s, 1.0))
    rows = np.concatenate([(root[:, None, None] * push).reshape(10, 4), np.diag(root[:4])])
    aim = np.concatenate([(root[:, None] * (r - free)).ravel(), root[:4] * v[:, 0]])
    exact = np.linalg.lstsq(rows, aim, rcond=None)[0]
    solver = jm.ADMM(iterations=1, newton_steps=0)
    for plan in (
        jm.solve(mpc, x0, r, solver, input_reference=v),
        solve_stagewise(mpc, x0, r, solver, input_reference=v),
    ):
        np.testing.assert_allclose(plan.inputs[:, 0], exact, rtol=1e-9)
        np.testing.assert_allclose(plan.cost, np.sum((rows @ exact - aim) ** 2), rtol=1e-9)


@pytest.mark.slow
def test_fixed_count_of_newton_steps():
    """By default those of the interior point method are the most."""
    early, all_of_them = (
        solve_stagewise(replace(problem(), system=varying()), X0, solver=solver)
        for solver in (SOLVER, replace(SOLVER, fixed=True))
    )
    np.testing.assert_array_equal(early.status, all_of_them.status)
    np.testing.assert_allclose(early.inputs, all_of_them.inputs, atol=1e-9)
    mpc = replace(problem(), system=varying())
    inputs = lambda x0: solve_stagewise(mpc, x0, solver=jm.ADMM(fixed=True)).inputs
    lengths = re.findall(r" length=(\d+)", str(jax.make_jaxpr(inputs)(X0)))
    assert max(map(int, lengths)) == newton_steps.INTERIOR_STEPS


@pytest.mark.slow
def test_residuals_are_those_of_the_qp():
    """Far from the optimum: the residuals of `residuals(qp, z, y)`, from adjoints."""
    mpc, system = problem(), varying()
    qp, _ = condensed(mpc, system, X0)
    plan = solve_stagewise(
        replace(mpc, system=system), X0, solver=jm.ADMM(iterations=2, newton_steps=0)
    )
    assert plan.status == jm.Status.ITERATION_LIMIT
    found = plan.primal_residual, plan.dual_residual, plan.gap
    np.testing.assert_allclose(
        found, residuals(qp, plan.inputs.ravel(), rows_of(mpc, plan)), rtol=1e-9
    )
    assert min(found) > 1e-4


@pytest.mark.parametrize(("off", "within"), [(1e-8, True), (1e-4, False)])
def test_gradient_without_active_rows_is_compared_with_its_terms(off, within):
    """One step x + u, cost 2 u² + 3 (x + u)², no limits: u = −0.6 x, where the gradient is the
    difference of two terms of 2.4 x. An input off by 1e-8 is good to 1e-6; one off by 1e-4 not."""
    system = jm.LinearSystem(np.eye(1), np.eye(1))
    mpc = jm.MPC(system, np.zeros((1, 1)), 2 * np.eye(1), 1, terminal_cost=3 * np.eye(1))
    aim = Aim(jnp.array([0.7]), jnp.zeros((2, 1)), jnp.zeros((1, 1)), jnp.zeros(1))

    @jax.jit
    def measured(u):
        s = stages.Stages.of(mpc).aimed(aim)
        none = jnp.zeros(0)
        found = stages.measured_pair(jnp.asarray(1e-6), s, none, u, none).measured
        return found.dual, found.within_tolerance

    dual, good = measured(np.array([[-0.42 * (1 + off)]]))
    np.testing.assert_allclose(dual, 10 * 0.42 * off, rtol=1e-6)
    assert good == within


@pytest.mark.slow
def test_rows_that_no_input_moves():
    """x_0 outside hard limits: violated, and said; outside soft ones: their slack."""
    mpc = problem()
    far = np.array([1.05, 0.0, 0.0])
    plan = solve_stagewise(mpc, far, solver=SOLVER)
    assert plan.status == jm.Status.ITERATION_LIMIT
    assert plan.primal_residual >= 0.05 - 1e-12
    soft = replace(
        mpc, states=None, outputs=(), terminal_set=None,
        soft=jm.Soft(np.eye(n), upper=np.array([1.0, 0.7, 1.2]), rho=10.0),
    )  # fmt: skip
    plan = solve_stagewise(soft, far, solver=SOLVER)
    assert plan.status == jm.Status.SOLVED and plan.gap < 1e-9
    np.testing.assert_allclose(plan.slack[0], [0.05, 0, 0], atol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("solver", [jm.solve, solve_stagewise])
def test_multipliers_of_rows_that_no_input_moves_have_derivatives(solver):
    """Of x_0 beyond a soft limit: y = ρ + 2 q (x_0 − limit), which no optimality condition says."""

    def multiplier(data):
        x, limit, rho, quadratic = data
        soft = jm.Soft([[1.0, 0.0]], upper=limit[None], rho=rho, quadratic=quadratic)
        system = jm.LinearSystem([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]])
        mpc = jm.MPC(system, [1.0, 1.0], [1.0], 2, inputs=jm.Box(-1, 1), soft=soft)
        return solver(mpc, jnp.stack([x, 0.0])).multipliers.soft[0].ravel()[0]

    with enable_x64(True):
        found = jax.value_and_grad(multiplier)(jnp.array([1.5, 1.0, 3.0, 2.0]))
    np.testing.assert_allclose(found[0], 3 + 2 * 2 * 0.5, rtol=1e-12)
    np.testing.assert_allclose(found[1], [4, -4, 1, 1], rtol=1e-12)


@pytest.mark.slow
def test_what_is_solved_costs_what_the_plan_costs_however_unstable_the_model():
    """A² … A²⁰ grow by 2.8 a step, and with them the parts of a gradient whose sum is zero: a gap
    of 1 % of the cost was small beside them, and the plan called solved."""
    d = np.load(Path(__file__).parent / "unstable_arm.npz")
    mpc = jm.MPC(
        jm.LinearSystem(d["A"], d["B"], c=d["c"], dt=0.01), d["Q"], d["R"], 20,
        states=jm.Box(d["xl"], d["xu"]), inputs=jm.Box(d["ul"], d["uu"]), terminal_cost=d["P"],
        constrained_stages=tuple(range(1, 21)),
    )  # fmt: skip
    with enable_x64(True):
        one, other = (
            solver(jm.soften(mpc, 1e4), d["x0"], reference=d["ref"], input_reference=d["us"])
            for solver in (jm.solve, solve_stagewise)
        )
        soft, aim = jm.soften(mpc, 1e4), {"reference": d["ref"], "input_reference": d["us"]}
        many = solve_stagewise(soft, d["x0"], solver=jm.ADMM(newton_steps=1000), **aim)
        few = jm.solve(soft, d["x0"], solver=jm.ADMM(newton_steps=50), **aim)
    assert one.solved and other.solved and many.solved
    np.testing.assert_allclose([other.cost, many.cost], one.cost, rtol=1e-7)
    np.testing.assert_allclose(other.inputs[0], one.inputs[0], atol=1e-6)
    assert other.gap <= 2e-6 * other.cost
    # Steps that were not allowed would have solved it: not what rounding stops.
    assert few.status == jm.Status.ITERATION_LIMIT


@pytest.mark.slow
def test_unstable_systems_are_solved_where_the_condensed_program_is():
    """Systems that grow 3e3- to 1e12-fold over the horizon in open loop, also in coordinates that
    nearly coincide, where the plan is a difference of large terms."""
    n, N = 2, 30
    A, B, x0 = unstable_systems(16)
    one = jm.MPC(
        jm.LinearSystem(A[0], B[0]), np.eye(n), np.eye(1), N, states=symmetric(5.0, 5.0),
        inputs=symmetric(1.0), constrain_initial=False, prestabilise=True,
    )  # fmt: skip
    one = jm.soften(one, 10.0)
    with enable_x64(True):
        found, dense = (
            jax.vmap(
                lambda A, B, x, solve=solve: solve(replace(one, system=jm.LinearSystem(A, B)), x)
            )(A, B, x0)
            for solve in (solve_stagewise, jm.solve)
        )
    solved = (np.asarray(found.status) == 1), (np.asarray(dense.status) == 1)
    both = solved[0] & solved[1]
    assert both.sum() >= 20 and solved[0].sum() >= solved[1].sum() - 1
    np.testing.assert_allclose(found.cost[both], dense.cost[both], rtol=2e-6)
    # Plans come back as they are: states follow from inputs.
    step = jnp.einsum("bij,bkj->bki", A, found.states[:, :-1]) + found.inputs * B[:, None, :, 0]
    np.testing.assert_allclose(step[both], found.states[both, 1:], rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_a_varying_system_in_the_problem():
    """Numbers and diagonals become matrices and vectors as they do for a constant system."""
    short = dict(horizon=N, inputs=jm.Box(-1, 1), terminal_cost=[1.0] * n)
    mpc = jm.MPC(varying(), [2.0, 1.0, 0.5], [0.4, 0.3], **short)
    assert mpc.Q.shape == (n, n) and mpc.inputs.upper.shape == (m,)
    found = solve_stagewise(mpc, X0)
    same = jm.MPC(problem().system, np.diag([2.0, 1.0, 0.5]), np.diag([0.4, 0.3]), **short)
    expected = solve_stagewise(replace(same, system=varying()), X0)
    np.testing.assert_array_equal(found.inputs, expected.inputs)
    assert found.status == jm.Status.SOLVED


@pytest.mark.slow
def test_warm_start_and_parts():
    mpc = replace(problem(), system=varying())
    plan = solve_stagewise(mpc, X0, solver=SOLVER)
    again = jm.ADMM(iterations=2, newton_steps=0)
    cold = solve_stagewise(mpc, X0, solver=again)
    assert cold.status != jm.Status.SOLVED
    factor = factor_stages(mpc, again)
    y = rows_of(mpc, plan)
    for start in (plan, WarmStart(plan.states, plan.inputs, y)):
        warm = plan_stages(factor, mpc, X0, solver=again, warm_start=start)
        assert warm.status == jm.Status.SOLVED
        np.testing.assert_allclose(warm.inputs, plan.inputs, atol=1e-9)
    with pytest.raises(ValueError, match="warm_start"):
        solve_stagewise(mpc, X0, warm_start=WarmStart(plan.states, plan.inputs, y[1:]))


@pytest.mark.slow
def test_float32_and_bad_elements():
    """Penalties, and with them factors, differ in the batch; NaN stays in its element."""
    mpc, system = problem(), varying()
    exact = solve_stagewise(replace(mpc, system=system), X0, solver=SOLVER)
    batch, x0s = jax.tree.map(lambda v: np.stack([v] * 4), system), np.stack([X0] * 4)
    batch.A[1, 3, 0, 0], x0s[2, 1] = np.nan, np.inf
    with enable_x64(False):
        plans = jax.vmap(
            lambda s, x, rho: solve_stagewise(
                replace(mpc, system=s), x, solver=replace(SOLVER, rho=rho)
            )
        )(batch, x0s, jnp.array([0.5, 1.0, 1.0, 1.0]))
    assert plans.inputs.dtype == jnp.float32
    S, good = jm.Status, np.array([0, 3])
    assert list(plans.status) == [S.SOLVED, S.NON_FINITE, S.NON_FINITE, S.SOLVED]
    found = np.stack([plans.primal_residual, plans.dual_residual, plans.gap])[:, good]
    assert np.max(found) < 1e-5
    np.testing.assert_allclose(plans.inputs[good], [exact.inputs] * 2, atol=1e-5)
    assert np.isnan(plans.inputs[1:3]).all() and np.isnan(plans.states[1:3]).all()


@pytest.mark.long
@pytest.mark.parametrize(
    ("one", "x64"),
    [
        (solve_stagewise, True),
        pytest.param(solve_stagewise, False, marks=pytest.mark.slow),
        pytest.param(jm.solve, False, marks=pytest.mark.slow),
        pytest.param(jm.solve, True, marks=pytest.mark.slow),
    ],
)
def test_a_state_far_off_is_solved_within_limits_or_not(one, x64):
    """Rounding of the steps that lead to a plan, 1e-16 of 1e15, is no excuse for inputs of a
    thousand where the limit is 1; and no state makes the derivatives of others NaN."""
    mpc = jm.MPC(
        jm.LinearSystem([[1, 0.1], [0, 1]], [[0.005], [0.1]]), np.eye(2), np.eye(1), 6,
        inputs=symmetric(1.0), states=None if one is solve_stagewise else symmetric(5.0, 5.0),
    )  # fmt: skip
    with enable_x64(x64):
        dtype = jnp.result_type(float)
        size = np.concatenate([[1.0, 2.0], 10.0 ** np.arange(6, 300 if x64 else 34, 7)])
        x0 = jnp.asarray(size[:, None] * np.array([1.0, -0.3]), dtype)

        def loss(B, x0):
            system = replace(mpc.system, B=B)
            plan = jax.vmap(lambda x: one(replace(mpc, system=system), x))(x0)
            return jnp.sum(plan.inputs[:2] ** 2), plan

        change = jax.jit(jax.value_and_grad(loss, has_aux=True))
        B = jnp.asarray(mpc.system.B, dtype)
        ((_, plan), of_all), (_, of_two) = change(B, x0), change(B, x0.at[2:].set(1.0))
    solved = np.asarray(plan.status) == jm.Status.SOLVED
    assert solved[:2].all()
    assert np.abs(plan.inputs[solved]).max() <= 1 + 1e-5
    np.testing.assert_allclose(of_all, of_two, rtol=1e-9 if x64 else 1e-5)


@pytest.mark.parametrize("steps", [{}, {"newton_steps": 0}, {"iterations": 20}])
@pytest.mark.long
def test_a_prediction_that_overflows_is_no_matter_of_more_steps(steps, x64):
    """As `solve` says of it."""
    mpc = jm.MPC(
        jm.LinearSystem([[1e100]], [1.0]), 1.0, 0.1, 6, jm.Box(-1.0, 1.0), jm.Box(-1.0, 1.0)
    )
    plans = [solve_stagewise(mpc, [0.5], solver=jm.ADMM(**steps)), jm.solve(mpc, [0.5])]
    for plan in plans:
        assert plan.status == jm.Status.NON_FINITE and "overflow" in plan.sentence


@pytest.mark.long
@pytest.mark.parametrize("cost", [0.1, 1e-6])
def test_held_inputs_do_not_move(cost):
    """Where limits hold all inputs of an unstable plant no state moves them, however little they
    cost: a share of 3e-4 of the gain was left."""
    A = np.array([[1, 0.015, 0, 0], [0, 1, 0, 0], [0, 0, 1.01, 0.015], [0, 0, 1.6, 1.01]])
    system = jm.LinearSystem(A, [[0.0004], [0.05], [-0.004], [-0.55]])
    mpc = jm.MPC(
        system, [100.0, 1, 100, 1], cost, 11, inputs=jm.Box(-4, 4), terminal_cost=1e3 * np.ones(4)
    )
    inputs = lambda x: solve_stagewise(mpc, x).inputs
    x0 = jnp.array([0, 0, -2.5, 0.0])
    np.testing.assert_allclose(inputs(x0), -4.0, atol=1e-6)
    gain = np.abs(jm.lqr(system, mpc.Q, mpc.R).K).max()
    assert np.abs(jax.jacobian(inputs)(x0)).max() < 1e-10 * gain


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda mpc, s: (replace(mpc, terminal_set=jm.Ellipsoid(np.eye(n), 1.0)), s), "jm.solve"),
        (lambda mpc, s: (replace(mpc, control_horizon=2), s), "jm.solve"),
        (lambda mpc, s: (mpc, replace(s, A=s.A[:-1])), "A: shape"),
        (lambda mpc, s: (mpc, replace(s, B=s.B[:, :, :, None])), "B"),
        (lambda mpc, s: (mpc, replace(s, c=s.c * np.nan)), "c: holds NaN"),
        (lambda mpc, s: (mpc, s.A), "system"),
        (lambda mpc, s: (replace(mpc, R=-mpc.R), s), "R"),
    ],
)
def test_bad_problems_raise(change, words):
    with pytest.raises(ValueError, match=words):
        mpc, system = change(problem(), varying())
        solve_stagewise(replace(mpc, system=system), X0)


def test_bad_arguments_raise():
    mpc = replace(problem(), system=varying())
    with pytest.raises(ValueError, match="x0"):
        solve_stagewise(mpc, X0[:2])
    with pytest.raises(ValueError, match="reference"):
        solve_stagewise(mpc, X0, np.zeros((N, n)))
    with pytest.raises(ValueError, match="rho"):
        factor_stages(mpc, jm.ADMM(rho=np.ones(3)))


@pytest.mark.parametrize(
    "given, message",
    [
        ({"x0": np.zeros(3)}, r"x0: shape \(3,\)"),
        ({"x0": ["a", 0]}, "x0: "),
        ({"x0": np.zeros(2), "reference": np.zeros(3)}, r"reference: shape \(3,\)"),
        ({"x0": np.zeros(2), "input_reference": np.zeros((2, 1))}, "input_reference: shape"),
        ({"x0": np.zeros(2), "warm_start": 3}, "warm_start: "),
    ],
)
def test_wrong_arguments_are_told_before_the_factorization(monkeypatch, given, message):
    """It compiles for seconds."""
    monkeypatch.setattr("jaxmpc.mpc.stagewise.solve._factor", None)
    with pytest.raises(ValueError, match=message):
        jm.mpc.solve_stagewise(lecture(), **given)


@pytest.mark.long
@pytest.mark.parametrize("limits", [{}, {"inputs": jm.Box(-1, 1)}])
@pytest.mark.parametrize(("fixed", "backend"), [(False, "cpu"), (False, "gpu"), (True, "cpu")])
def test_plans_in_a_shard_map(limits, fixed, backend, monkeypatch):
    """Zeros that stand for rows of states, or for all rows, vary over the mesh as results do; also
    in the groups of a GPU."""
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    system = jm.LinearSystem([[1, 0.1], [0, 1]], [0.005, 0.1])
    mpc = jm.MPC(system, [1.0, 0.5], 0.1, horizon=3, **limits)
    mesh, spec = jax.make_mesh((1,), ("b",), axis_types=(AxisType.Auto,)), PartitionSpec("b")
    plans = jax.vmap(lambda x: solve_stagewise(mpc, x, solver=jm.ADMM(fixed=fixed)).inputs)
    shared = jax.shard_map(plans, mesh=mesh, in_specs=spec, out_specs=spec)
    assert jax.eval_shape(shared, jnp.ones((4, 2))).shape == (4, 3, 1)
