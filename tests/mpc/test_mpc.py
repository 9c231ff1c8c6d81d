"""MPC against theorems and stacked, sparse and Riccati constructions that share no code with it."""

import warnings
from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
import scipy
from jax import enable_x64

import jaxmpc as jm
from jaxmpc.mpc.condense import condense
from jaxmpc.mpc.plan import WarmStart, broken_at_start
from jaxmpc.mpc.policy_rows import tube_section

FINE = jm.ADMM(iterations=400, newton_steps=30, eps=1e-8)
PLAIN = jm.ADMM(iterations=1000, newton_steps=0)  # compiles fastest


pytestmark = pytest.mark.usefixtures("x64")


def free(horizon=8, terminal_cost=None) -> jm.MPC:
    """An unstable plant without any limit."""
    return jm.MPC(
        system=jm.LinearSystem(
            np.array([[1.2, 0.5, 0.0], [0.0, 0.9, 0.3], [0.1, 0.0, 1.0]]),
            np.array([[0.0, 0.2], [1.0, 0.0], [0.0, 0.7]]),
        ),
        Q=np.diag([2.0, 1.0, 0.5]), R=np.array([[1.0, 0.2], [0.2, 2.0]]), horizon=horizon,
        terminal_cost=terminal_cost,
    )  # fmt: skip


class Stacked:
    """The problem with its states kept: v = (x_0, …, x_N, u_0, …, u_{N−1}), dynamics as rows.

    min v'Wv subject to G v = g(x0) and lower ≤ M v ≤ upper, built with numpy and loops.
    """

    def __init__(self, mpc: jm.MPC):
        A, B = np.asarray(mpc.system.A), np.asarray(mpc.system.B)
        n, m = B.shape
        N = mpc.horizon
        c = np.zeros(n) if mpc.system.c is None else mpc.system.c
        size = (N + 1) * n + N * m
        x = [slice(k * n, (k + 1) * n) for k in range(N + 1)]
        u = [slice((N + 1) * n + k * m, (N + 1) * n + (k + 1) * m) for k in range(N)]
        self.W, self.G = np.zeros((size, size)), np.zeros(((N + 1) * n, size))
        self.g = np.zeros((N + 1) * n)
        self.G[x[0], x[0]] = np.eye(n)
        for k in range(N):
            self.W[x[k], x[k]], self.W[u[k], u[k]] = mpc.Q, mpc.R
            rows = x[k + 1]
            self.G[rows, x[k + 1]], self.G[rows, x[k]], self.G[rows, u[k]] = np.eye(n), -A, -B
            self.g[rows] = c
        if mpc.terminal_cost is not None:
            self.W[x[N], x[N]] = mpc.terminal_cost
        M, lower, upper = [np.zeros((0, size))], [[]], [[]]

        def add(set_, where):
            if set_ is None:
                return
            box = isinstance(set_, jm.Box)
            H = np.eye(len(set_.lower)) if box else np.asarray(set_.H)
            row = np.zeros((len(H), size))
            row[:, where] = H
            M.append(row)
            lower.append(set_.lower if box else np.full(len(H), -np.inf))
            upper.append(set_.upper if box else set_.h)

        for k in range(N):
            add(mpc.inputs, u[k])
        for k in range(0 if mpc.constrain_initial else 1, N):
            add(mpc.states, x[k])
        add(mpc.terminal_set, x[N])
        self.M, self.lower, self.upper = map(np.concatenate, (M, lower, upper))
        self.n, self.size, self.states = n, size, (N + 1) * n
        self.shape = (N, m)

    def right(self, x0):
        """g with x_0 in it."""
        g = self.g.copy()
        g[: self.n] = x0
        return g

    def from_inputs(self, x0, inputs):
        """v of an input sequence, by solving the dynamics."""
        u = np.asarray(inputs).reshape(-1)
        x = np.linalg.solve(self.G[:, : self.states], self.right(x0) - self.G[:, self.states :] @ u)
        return np.concatenate([x, u])

    def solve(self, x0, linear=None):
        """(v'Wv + linear'v, v) by OSQP."""
        osqp, sparse = pytest.importorskip("osqp"), scipy.sparse.csc_matrix
        linear = np.zeros(self.size) if linear is None else linear
        g = self.right(x0)
        solver = osqp.OSQP()
        solver.setup(
            sparse(2 * self.W), linear, sparse(np.vstack([self.G, self.M])),
            np.concatenate([g, self.lower]), np.concatenate([g, self.upper]),
            eps_abs=1e-10, eps_rel=1e-10, max_iter=200000, polishing=True, verbose=False,
        )  # fmt: skip
        result = solver.solve(raise_error=True)
        assert result.info.status == "solved"
        return result.x @ self.W @ result.x + linear @ result.x, result.x


CASES = {
    "drifting": problems.drifting,
    "drifting, k from 1": lambda: replace(problems.drifting(), constrain_initial=False),
    "joint": lambda: problems.joint(horizon=6),
    "joint, terminal O_inf": lambda: problems.joint_o_inf(horizon=10),
    "hidden product": lambda: problems.hidden_product(horizon=4),
    "unstable": lambda: problems.unstable(horizon=6),
    "free": free,
}
X0 = {"drifting": [0.2, 0.3], "joint": [0.4, -1.2], "hidden product": [1.48, -0.98, -0.38, 1.0],
      "unstable": [0.6, 0.3], "free": [1.0, -2.0, 0.5]}  # fmt: skip
start = lambda name: np.array(X0[name.split(",")[0]])


class TestCondensing:
    @pytest.mark.parametrize("name", CASES)
    @pytest.mark.parametrize("prestabilise", [False, "gain"])
    def test_entry_by_entry(self, name, prestabilise):
        """P, F, f, C, D, d from the stacked matrices, x = G_x⁻¹ (g − G_u u), one column each."""
        mpc = CASES[name]()
        stacked, n = Stacked(mpc), mpc.system.n
        N, m = stacked.shape
        K = np.zeros((m, n))
        if prestabilise:
            K = np.random.default_rng(0).standard_normal((m, n)) * 0.3
        c = condense(replace(mpc, prestabilise=K if prestabilise else False))

        def unfold(x0, z, drift):
            """v for u_k = K x_k + z_k, step by step."""
            offset = np.zeros(n) if mpc.system.c is None or not drift else mpc.system.c
            xs, us = [x0], []
            for k in range(N):
                us.append(K @ xs[-1] + z.reshape(N, m)[k])
                xs.append(mpc.system.A @ xs[-1] + mpc.system.B @ us[-1] + offset)
            return np.concatenate([*xs, *us])

        zero, rest = np.zeros(n), np.zeros(N * m)
        by_z = np.stack([unfold(zero, e, False) for e in np.eye(N * m)], axis=1)
        by_x = np.stack([unfold(e, rest, False) for e in np.eye(n)], axis=1)
        constant = unfold(zero, rest, True)
        close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12)
        close(c.P, 2 * by_z.T @ stacked.W @ by_z)
        close(c.F, 2 * by_z.T @ stacked.W @ by_x)
        close(c.f, 2 * by_z.T @ stacked.W @ constant)
        close(c.C, stacked.M @ by_z)
        close(c.D, stacked.M @ by_x)
        close(c.d, stacked.M @ constant)
        close(c.lower, stacked.lower)
        close(c.upper, stacked.upper)
        x0, z = start(name), np.linspace(-1, 1, N * m)
        states, inputs = c.trajectory(x0, z)
        close(np.concatenate([np.ravel(states), np.ravel(inputs)]), unfold(x0, z, True))

    def test_no_input_moves_the_rows_at_zero(self):
        c = condense(problems.joint(horizon=3))
        np.testing.assert_array_equal(c.C[3:5], 0)  # after 3 input rows: the state at k = 0


class TestAnotherSolver:
    @pytest.mark.long
    @pytest.mark.parametrize("name", CASES)
    @pytest.mark.first(1)
    def test_states_kept(self, name):
        mpc, x0 = CASES[name](), start(name)
        cost, v = Stacked(mpc).solve(x0)
        aim = np.zeros((mpc.horizon + 1, mpc.system.n))  # the program of `test_tracking`
        plan = jm.solve(mpc, x0, reference=aim, solver=FINE)
        assert plan.status == jm.Status.SOLVED
        got = np.concatenate([np.ravel(plan.states), np.ravel(plan.inputs)])
        np.testing.assert_allclose(got, v, atol=1e-6 * (1 + np.abs(v).max()))
        np.testing.assert_allclose(plan.cost, cost, rtol=1e-6)

    @pytest.mark.parametrize("name", CASES)
    @pytest.mark.first(1)
    def test_optimality(self, name):
        """KKT of the stacked problem: costates recovered by the adjoint leave no gradient in u."""
        mpc, x0 = CASES[name](), start(name)
        aim = np.zeros((mpc.horizon + 1, mpc.system.n))
        stacked, plan = Stacked(mpc), jm.solve(mpc, x0, reference=aim, solver=FINE)
        assert plan.status == jm.Status.SOLVED
        v = stacked.from_inputs(x0, plan.inputs)
        y = plan.multipliers
        y = np.concatenate([np.ravel(y.inputs), np.ravel(y.states), np.ravel(y.terminal)])
        gradient = 2 * stacked.W @ v + stacked.M.T @ y
        costates = np.linalg.solve(stacked.G[:, : stacked.states].T, -gradient[: stacked.states])
        left = gradient[stacked.states :] + stacked.G[:, stacked.states :].T @ costates
        np.testing.assert_allclose(left, 0, atol=1e-6 * (1 + np.abs(gradient).max()))
        value = stacked.M @ v
        assert np.all(value <= stacked.upper + 1e-7) and np.all(value >= stacked.lower - 1e-7)
        slack = np.where(y > 0, stacked.upper - value, value - stacked.lower)
        np.testing.assert_allclose(np.where(np.abs(y) > 1e-6, slack, 0), 0, atol=1e-6)

    @pytest.mark.slow
    def test_limits_bind(self):
        """The cases above are no unconstrained problems in disguise."""
        for name in ("drifting", "joint", "hidden product", "unstable"):
            plan = jm.solve(CASES[name](), start(name), solver=FINE)
            assert max(np.abs(v).max(initial=0) for v in jax.tree.leaves(plan.multipliers)) > 1e-3


class TestRiccati:
    @pytest.mark.long
    @pytest.mark.parametrize("horizon", [7, 1, 2, 5, 20])
    @pytest.mark.first(1)
    def test_unconstrained_is_lqr_at_every_horizon(self, horizon):
        mpc = free(horizon)
        lqr = jm.lqr(mpc.system, mpc.Q, mpc.R)
        x = start("free")
        plan = jm.solve(replace(mpc, terminal_cost=lqr.P), x)
        assert plan.status == jm.Status.SOLVED
        np.testing.assert_allclose(plan.cost, x @ lqr.P @ x, rtol=1e-9)
        for k in range(horizon):
            np.testing.assert_allclose(plan.states[k], x, atol=1e-8)
            np.testing.assert_allclose(plan.inputs[k], lqr.K @ x, atol=1e-8)
            x = mpc.system.A @ x + mpc.system.B @ (lqr.K @ x)

    @pytest.mark.slow
    def test_loose_limits_are_lqr_too(self):
        mpc = free(6)
        lqr = jm.lqr(mpc.system, mpc.Q, mpc.R)
        mpc = replace(
            mpc, terminal_cost=lqr.P, states=problems.symmetric(50, 50, 50),
            inputs=problems.symmetric(20, 20),
        )  # fmt: skip
        plan = jm.solve(mpc, start("free"), solver=FINE)
        np.testing.assert_allclose(plan.inputs[0], lqr.K @ start("free"), atol=1e-7)

    def test_finite_horizon_recursion(self):
        """No terminal cost: the Riccati difference equation from P_N = 0."""
        mpc = free(7, np.zeros((3, 3)))  # the program of the test above
        A, B, P = mpc.system.A, mpc.system.B, np.zeros((3, 3))
        for _ in range(7):
            K = -np.linalg.solve(mpc.R + B.T @ P @ B, B.T @ P @ A)
            P = mpc.Q + A.T @ P @ A + A.T @ P @ B @ K
        x = start("free")
        plan = jm.solve(mpc, x)
        np.testing.assert_allclose(plan.inputs[0], K @ x, atol=1e-8)
        np.testing.assert_allclose(plan.cost, x @ P @ x, rtol=1e-9)

    @pytest.mark.slow
    def test_cost_falls_along_the_closed_loop(self):
        """With O_inf and the DARE's P, J* falls by at least the stage cost (Mayne et al. 2000)."""
        mpc = problems.joint_o_inf(horizon=12)
        controller, x, control = jm.Controller(mpc, FINE), np.array([0.35, -1.0]), None
        step = jax.jit(lambda c, x, before: c(x, before))
        last = np.inf
        for _ in range(15):
            control = step(controller, x, control)
            u, plan, _ = control
            assert plan.status == jm.Status.SOLVED
            assert plan.cost <= last + 1e-7
            last = plan.cost - x @ mpc.Q @ x - u @ mpc.R @ u
            x = mpc.system.A @ x + mpc.system.B @ np.asarray(u)


class TestPrestabilising:
    @pytest.mark.slow
    def test_same_plan(self):
        mpc = problems.unstable(horizon=12)
        x0 = np.array([0.5, 0.4])
        plain, auto, given = (
            jm.solve(replace(mpc, prestabilise=choice), x0, solver=FINE)
            for choice in (False, None, np.array([[-1.5, -0.8]]))
        )
        for plan in (plain, auto, given):
            assert plan.status == jm.Status.SOLVED
            np.testing.assert_allclose(plan.inputs, plain.inputs, atol=1e-6)
            np.testing.assert_allclose(plan.cost, plain.cost, rtol=1e-7)
            np.testing.assert_allclose(plan.multipliers.inputs, plain.multipliers.inputs, atol=1e-4)

    @pytest.mark.slow
    def test_long_horizon(self):
        """2^40 in float32: the plan keeps its limits and meets that of float64."""
        mpc = problems.unstable(horizon=40)
        x0 = np.array([0.4, 0.2])
        fine = jm.solve(mpc, x0, solver=FINE)
        assert fine.status == jm.Status.SOLVED
        with enable_x64(False):
            coarse = jm.solve(mpc, x0)
        assert coarse.inputs.dtype == jnp.float32
        np.testing.assert_allclose(coarse.inputs, fine.inputs, atol=1e-2)


class TestReferences:
    @pytest.mark.parametrize("moving", [True, False], ids=["moving", "constant"])
    @pytest.mark.parametrize("name", ["drifting", "hidden product", "unstable"])
    @pytest.mark.first(1)
    def test_tracking(self, name, moving):
        """Cost Σ (x − r)'Q(x − r) + u'Ru + …, with the states kept, by another solver."""
        mpc, x0 = CASES[name](), start(name)
        stacked, n, N = Stacked(mpc), mpc.system.n, mpc.horizon
        reference = 0.3 * np.random.default_rng(0).standard_normal((N + 1, n) if moving else n)
        r = np.zeros(stacked.size)
        r[: stacked.states] = np.broadcast_to(reference, (N + 1, n)).ravel()
        cost, v = stacked.solve(x0, linear=-2 * stacked.W @ r)
        plan = jm.solve(mpc, x0, reference=reference, solver=FINE)
        assert plan.status == jm.Status.SOLVED
        got = np.concatenate([np.ravel(plan.states), np.ravel(plan.inputs)])
        np.testing.assert_allclose(got, v, atol=1e-5)
        np.testing.assert_allclose(plan.cost, cost + r @ stacked.W @ r, rtol=1e-6)

    @pytest.mark.slow
    def test_zero_reference_is_none(self):
        mpc, x0 = problems.drifting(), start("drifting")
        a, b = jm.solve(mpc, x0), jm.solve(mpc, x0, reference=np.zeros(2))
        np.testing.assert_allclose(a.inputs, b.inputs, atol=1e-12)


class TestMultipliers:
    """dJ*/d(bound) = −y, by central differences."""

    @pytest.mark.slow
    @pytest.mark.parametrize("side", ["upper", "lower"])
    @pytest.mark.parametrize("which", ["inputs", "states", "terminal_set"])
    def test_sensitivity(self, which, side):
        # Strictly active: the inputs at first, dq between, the terminal box at the end.
        mpc = replace(
            problems.joint(horizon=8), states=problems.symmetric(1.5, 1.0),
            terminal_set=jm.Box(np.array([0.0, 0.0]) - 0.25, np.array([0.5, 0.25])),
            terminal_cost=10 * np.array(problems.P_JOINT),
        )  # fmt: skip
        x0 = np.array([0.4, 0.8])
        plan = jm.solve(mpc, x0, solver=FINE)
        assert plan.status == jm.Status.SOLVED
        y = np.asarray(plan.multipliers.terminal if which == "terminal_set" else
                       getattr(plan.multipliers, which))  # fmt: skip
        y = np.atleast_2d(y).sum(axis=0)  # a bound is shared by all steps

        def cost(entry, h):
            set_ = getattr(mpc, which)
            bound = np.array(getattr(set_, side))
            bound[entry] += h
            return jm.solve(
                replace(mpc, **{which: replace(set_, **{side: bound})}), x0, solver=FINE
            ).cost

        each = np.atleast_2d(np.asarray(
            plan.multipliers.terminal if which == "terminal_set"
            else getattr(plan.multipliers, which)
        ))  # fmt: skip
        push = np.maximum(each, 0) if side == "upper" else np.minimum(each, 0)
        for entry in range(len(y)):
            h = 1e-5
            slope = (cost(entry, h) - cost(entry, -h)) / (2 * h)
            np.testing.assert_allclose(slope, -push.sum(axis=0)[entry], rtol=1e-3, atol=1e-3)

    @pytest.mark.slow
    def test_shapes(self):
        mpc = replace(problems.drifting(), constrain_initial=False)
        y = jm.solve(mpc, start("drifting")).multipliers
        assert (y.states.shape, y.inputs.shape, y.terminal.shape) == ((3, 5), (4, 2), (2,))
        y = jm.solve(free(), start("free")).multipliers
        assert (y.states.shape, y.inputs.shape, y.terminal.shape) == ((8, 0), (8, 0), (0,))


class TestIndexSet:
    @pytest.mark.slow
    def test_initial_state_outside(self):
        """x0 beyond its limit is infeasible with k = 0 and may be saved without it."""
        mpc = problems.scalar(terminal=1.0)
        x0 = np.array([1.2])
        assert jm.solve(mpc, x0).status == jm.Status.PRIMAL_INFEASIBLE
        plan = jm.solve(replace(mpc, constrain_initial=False), x0)
        assert plan.status == jm.Status.SOLVED
        assert np.all(np.abs(plan.states[1:]) <= 1 + 1e-6)

    @pytest.mark.slow
    def test_infeasible_far_away(self):
        plan = jm.solve(replace(problems.scalar(terminal=1.0), constrain_initial=False), [3.0])
        assert plan.status == jm.Status.PRIMAL_INFEASIBLE


class TestManyStates:
    @pytest.mark.slow
    def test_vmap(self):
        mpc = problems.lecture()
        x0s = np.random.default_rng(0).uniform(-1, 1, (40, 2))
        plans = jax.vmap(jm.solve, in_axes=(None, 0))(mpc, x0s)
        assert plans.states.shape == (40, 4, 2) and plans.inputs.shape == (40, 3, 1)
        for i in range(0, 40, 8):
            one = jm.solve(mpc, x0s[i])
            assert plans.status[i] == one.status
            if one.status == jm.Status.SOLVED:
                np.testing.assert_allclose(plans.inputs[i], one.inputs, atol=1e-6)
        found = np.asarray(plans.status)
        assert {jm.Status.SOLVED, jm.Status.PRIMAL_INFEASIBLE} <= set(found)

    @pytest.mark.slow
    def test_bad_states_stay_alone(self):
        mpc = problems.lecture()
        x0s = np.random.default_rng(0).uniform(-0.5, 0.5, (6, 2))
        solve = jax.jit(jax.vmap(jm.solve, in_axes=(None, 0)))
        clean = solve(mpc, x0s)
        x0s[2, 1], x0s[4, 0] = np.nan, np.inf
        spoiled = solve(mpc, x0s)
        bad = np.isin(np.arange(6), [2, 4])
        np.testing.assert_array_equal(np.asarray(spoiled.status)[bad], jm.Status.NON_FINITE)
        chex.assert_trees_all_equal(
            jax.tree.map(lambda v: v[~bad], spoiled), jax.tree.map(lambda v: v[~bad], clean)
        )

    @pytest.mark.slow
    def test_batch_of_plants(self):
        """Leaves of the problem may be batched: one MPC for each inertia."""
        mpc = problems.joint(horizon=4)
        gains = np.array([0.1, 0.2, 0.4])
        solve = lambda b: (
            jm.solve(
                replace(mpc, system=jm.LinearSystem(mpc.system.A, jnp.array([[0.0], [1.0]]) * b)),
                np.array([0.3, 0.1]),
            ).inputs
        )
        batch = jax.vmap(solve)(gains)
        for b, inputs in zip(gains, batch, strict=True):
            np.testing.assert_allclose(inputs, solve(b), atol=1e-7)


class TestController:
    @pytest.mark.slow
    def test_warm_start_saves_steps(self):
        mpc = problems.joint_o_inf(horizon=10)
        x = np.array([0.35, -0.5])
        fine = jm.Controller(mpc, FINE)
        few = jm.Controller(mpc, jm.ADMM(iterations=5, newton_steps=0))
        plan = fine.plan(x)
        cold, warm = few.plan(x), few.plan(x, warm_start=plan)
        assert warm.status == jm.Status.SOLVED != cold.status
        y = problems.rows_of(mpc, plan)
        again = few.plan(x, warm_start=WarmStart(plan.states, plan.inputs, y))
        np.testing.assert_array_equal(again.inputs, warm.inputs)
        for bad in ((plan.inputs, y), WarmStart(plan.states, plan.inputs[1:], y)):
            with pytest.raises(ValueError, match="warm_start"):
                few.plan(x, warm_start=bad)

    @pytest.mark.slow
    @pytest.mark.parametrize("prestabilise", [False, True])
    def test_shifted_plan_is_the_solution_one_sample_later(self, prestabilise):
        """With the DARE's terminal cost and inactive limits the optimal plan extends by LQR."""
        mpc = replace(problems.joint(horizon=10), prestabilise=prestabilise)
        x = np.array([0.02, -0.01])
        plan = jm.Controller(mpc, FINE).plan(x)
        x = mpc.system.A @ x + mpc.system.B @ plan.inputs[0]
        controller = jm.Controller(mpc, jm.ADMM(iterations=0, newton_steps=0))
        start, condensed = controller.shifted(plan), controller.condensed
        z = condensed.variables(start.states, start.inputs)
        inputs = condensed.trajectory(x, z)[1]
        np.testing.assert_allclose(inputs, jm.solve(mpc, x, solver=FINE).inputs, atol=1e-7)

    @pytest.mark.slow
    def test_shifted_multipliers_move_up(self):
        mpc = problems.joint(horizon=6)
        controller = jm.Controller(mpc, FINE)
        plan = controller.plan(np.array([-1.4, 1.7]))
        before, after = (
            plan.multipliers,
            controller.multipliers(controller.shifted(plan).multipliers),
        )
        assert np.abs(before.states).max() > 1  # limits are active
        np.testing.assert_array_equal(after.states[:-1], before.states[1:])
        np.testing.assert_array_equal(after.states[-1], before.terminal)
        np.testing.assert_array_equal(after.inputs[:-1], before.inputs[1:])
        np.testing.assert_array_equal(after.inputs[-1], 0)

    @pytest.mark.slow
    def test_same_as_solve_and_under_scan(self):
        mpc = problems.lecture()
        controller = jm.Controller(mpc)
        x0 = np.array([0.3, -0.2])
        first = controller(x0)
        u, plan, _ = first
        np.testing.assert_allclose(plan.inputs, jm.solve(mpc, x0).inputs, atol=1e-12)
        np.testing.assert_array_equal(u, plan.inputs[0])

        def body(state, _):
            x, before = state
            control = controller(x, before)
            after = mpc.system.A @ x + mpc.system.B @ control.u
            return (after, control), (x, control.plan.status)

        _, (xs, status) = jax.jit(lambda s: jax.lax.scan(body, s, length=12))(
            (jnp.asarray(x0), first)
        )
        assert np.all(np.asarray(status) == jm.Status.SOLVED)
        assert np.abs(xs[-1]).max() < 0.2

        # From plain Python the shifted plan is good enough to go without ADMM, and the same comes.
        x = mpc.system.A @ x0 + mpc.system.B @ u
        plan = controller(x, first).plan
        assert plan.status == jm.Status.SOLVED and plan.iterations == 0
        np.testing.assert_allclose(plan.inputs, jm.solve(mpc, x).inputs, atol=1e-6)

    def test_is_a_tree(self):
        controller = jm.Controller(problems.lecture(), PLAIN)
        leaves, structure = jax.tree.flatten(controller)
        again = jax.tree.unflatten(structure, leaves)
        assert type(again) is jm.Controller and jax.tree.structure(again) == structure
        jax.tree.map(np.testing.assert_array_equal, again, controller)
        for filler in (None, 0, object()):
            jax.tree.unflatten(structure, [filler] * len(leaves))


class TestTypes:
    @pytest.mark.slow
    def test_dtype_follows_data(self):
        mpc = problems.lecture()
        assert jm.solve(mpc, np.zeros(2)).inputs.dtype == jnp.float64
        single = jax.tree.map(np.float32, mpc)
        assert jm.solve(single, np.zeros(2, np.float32)).inputs.dtype == jnp.float32

    def test_integers(self):
        system = jm.LinearSystem(np.array([[1, 1], [0, 1]]), np.array([[0], [1]]))
        mpc = jm.MPC(system, np.eye(2, dtype=int), np.eye(1, dtype=int), 3)
        plan = jax.eval_shape(lambda x: jm.solve(mpc, x, solver=PLAIN), np.array([1, 0]))
        assert jnp.issubdtype(plan.inputs.dtype, jnp.floating)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (dict(horizon=0), "horizon"),
        (dict(horizon=-3), "horizon"),
        (dict(horizon=2.5), "horizon"),
        (dict(Q=np.diag([1.0, -1.0])), "Q.*semidefinite"),
        (dict(Q=np.array([[1.0, 0.5], [0.0, 1.0]])), "Q.*symmetric"),
        (dict(Q=np.eye(3)), "Q"),
        (dict(Q=np.full((2, 2), np.nan)), "Q"),
        (dict(Q=np.zeros((2, 2)), R=np.zeros((1, 1)), terminal_cost=None), "R.*definite"),
        (dict(R=-np.eye(1)), "R.*definite"),
        (dict(R=np.eye(2)), "R"),
        (dict(terminal_cost=-np.eye(2)), "terminal_cost"),
        (dict(terminal_cost=np.eye(3)), "terminal_cost"),
        (dict(states=problems.symmetric(1.0)), "states"),
        (dict(states=jm.Box(np.ones(2), -np.ones(2))), "states"),
        (dict(states=jm.Box(np.full(2, np.nan), np.ones(2))), "states"),
        (dict(inputs=jm.Box(np.ones(1), np.zeros(1))), "inputs"),
        (dict(inputs=jm.Box(-np.ones(1), np.full(1, np.nan))), "inputs"),
        (dict(inputs=problems.symmetric(1.0, 1.0)), "inputs"),
        (dict(inputs=np.ones(2)), "inputs.*Polytope"),
        (dict(terminal_set=problems.symmetric(1.0, 1.0, 1.0)), "terminal_set"),
        (dict(terminal_set=jm.Polytope(np.eye(2), np.array([np.nan, 1.0]))), "terminal_set"),
        (dict(states=jm.Polytope(np.array([[1.0, 0.0], [-1.0, 0.0]]), np.array([1.0, -2.0]))),
         "states.*empty"),
        (dict(states=(-1.0, 1.0)), "states"),
        (dict(system=lambda: jm.LinearSystem(np.ones((2, 3)), np.ones((2, 1)))), "A"),
        (dict(system=lambda: jm.LinearSystem(np.eye(2), np.ones((3, 1)))), "B"),
        (dict(system=jm.LinearSystem(np.eye(2) * np.nan, np.ones((2, 1)))), "A"),
        (dict(system=(np.eye(2), np.ones((2, 1)))), "system"),
        (dict(prestabilise=np.ones((2, 2))), "prestabilise"),
    ],
)  # fmt: skip
def test_bad_problems_raise(change, words):
    """Where they are made, or by each function that takes them."""
    for use in (lambda mpc: jm.solve(mpc, np.zeros(2)), jm.Controller,
                lambda mpc: jm.map_feasible_set(mpc, np.zeros((1, 2)))):  # fmt: skip
        with pytest.raises(ValueError, match=words):
            made = {name: value() if callable(value) else value for name, value in change.items()}
            use(replace(problems.lecture(), **made))


@pytest.mark.parametrize("x0", [np.zeros(3), 0.0, np.zeros((2, 1)), np.zeros((5, 2))])
def test_bad_state_raises(x0):
    with pytest.raises(ValueError, match="x0"):
        jm.solve(problems.lecture(), x0)


@pytest.mark.parametrize("reference", [np.zeros(3), np.zeros((3, 2)), 0.0])
def test_bad_reference_raises(reference):
    with pytest.raises(ValueError, match="reference"):
        jm.solve(problems.lecture(), np.zeros(2), reference=reference)


@pytest.mark.long
def test_derivatives_of_a_batch_of_plans_without_limits():
    """u = r/2 is the least of |x − r|² + |u|² + |u − r|² where x⁺ = u: for each of many states."""
    system = jm.LinearSystem(np.zeros((2, 2)), np.eye(2), dt=1.0)
    controller = jm.Controller(jm.MPC(system, np.eye(2), np.eye(2), 1, terminal_cost=np.eye(2)))
    inputs = lambda r: jax.vmap(lambda x: controller(x, reference=r).u)(jnp.ones((3, 2)))
    both = jax.jit(lambda r: [jacobian(inputs)(r) for jacobian in (jax.jacfwd, jax.jacrev)])
    for found in both(jnp.array([1.0, -2.0])):
        np.testing.assert_allclose(found, np.tile(np.eye(2) / 2, (3, 1, 1)), atol=1e-5)


@pytest.mark.parametrize("name", ["Q", "R"])
@pytest.mark.long
def test_traced_weights_leave_the_gain_of_known_dynamics(name):
    """Without it 60 steps of an unstable plant are beyond the solver."""
    system = jm.LinearSystem([[1.6, 0.3], [0.0, 1.4]], [[0.1], [0.5]])
    mpc = jm.MPC(
        system, np.eye(2), np.eye(1), 60, jm.Box([-1, -1], [1, 1]), jm.Box([-1], [1])
    )  # fmt: skip
    with jax.enable_x64(True):
        plan = lambda weight: jm.solve(replace(mpc, **{name: weight}), np.array([0.02, -0.01]))
        found, wanted = jax.jit(plan)(getattr(mpc, name)), plan(getattr(mpc, name))
    assert found.status == wanted.status == jm.Status.SOLVED
    np.testing.assert_allclose(found.cost, wanted.cost, rtol=1e-8)


def test_gradients_of_all_data_are_traced():
    """Of the problem and the state; `TestEveryField` of `test_derivative.py` has values."""
    cost = lambda mpc, x: jm.solve(mpc, x).cost
    mpc = jax.tree.map(np.asarray, problems.lecture())
    gradient = jax.vmap(jax.grad(cost, argnums=(0, 1)), (None, 0))
    of_mpc, of_x = jax.eval_shape(gradient, mpc, np.zeros((4, 2)))
    assert jax.tree.structure(of_mpc) == jax.tree.structure(mpc)
    assert of_mpc.system.A.shape == (4, 2, 2) and of_x.shape == (4, 2)


@pytest.mark.slow
def test_gradients_are_finite_with_half_open_rows():
    """A polytope's rows have no lower bound: its gradients equal those of the same box."""
    box_mpc = problems.joint(5)
    polytope_mpc = replace(
        box_mpc, states=box_mpc.states.to_polytope(), terminal_set=box_mpc.states.to_polytope()
    )
    with jax.enable_x64(True):
        cost = lambda Q, mpc: jm.solve(replace(mpc, Q=Q), np.array([1.2, 1.5])).cost
        gradients = [jax.grad(cost)(np.diag([50.0, 1.0]), m) for m in (box_mpc, polytope_mpc)]
    assert np.isfinite(gradients[1]).all()
    np.testing.assert_allclose(gradients[1], gradients[0], rtol=1e-6)


def test_applied_input_stays_within_its_limits():
    u, plan, _ = jm.Controller(problems.lecture(), PLAIN)(np.array([0.2, 0.6]))
    assert plan.status == jm.Status.SOLVED and -0.25 <= u[0] < -0.249


@pytest.mark.slow
def test_problems_from_lists_and_whole_numbers_are_pytrees_of_float_arrays():
    """They can be differentiated and stacked like those from arrays."""
    lists = jm.MPC(
        jm.LinearSystem(A=[[1, 0.01], [0, 1]], B=[0, 0.2], dt=0.01), Q=[50, 1], R=1, horizon=3,
        states=jm.Box([-1, -2], [1, 2]), inputs=jm.Box(-2, 2),
        soft=jm.Soft([[1, 0]], upper=[1], lower=[-1]), stage_weights=[1, 1, 2],
        terminal_set=jm.Polytope([[1, 0], [-1, 0]], [1, 1]),
    )  # fmt: skip
    leaves = jax.tree.leaves(lists)
    assert all(isinstance(v, float) or v.dtype == float for v in leaves)
    stacked = jax.tree.map(lambda *v: np.stack(v), lists, lists)
    assert stacked.system.A.shape == (2, 2, 2) and stacked.soft.C.shape == (2, 1, 2)
    with jax.enable_x64(True):
        slope = jax.grad(lambda mpc: jm.solve(mpc, np.array([0.5, -1.0])).cost)(lists)
        lower, upper = (
            float(jm.solve(replace(lists, R=np.array([[1 + d]])), np.array([0.5, -1.0])).cost)
            for d in (-1e-4, 1e-4)
        )
    np.testing.assert_allclose(slope.R[0, 0], (upper - lower) / 2e-4, rtol=1e-5)


def test_a_float64_controller_outside_64_bit_mode_is_refused():
    with jax.enable_x64(True):
        controller = jm.Controller(problems.lecture(), PLAIN)
    with jax.enable_x64(False), pytest.raises(ValueError, match="controller: was made in float64"):
        controller(np.zeros(2))
    with jax.enable_x64(True):
        assert controller(np.zeros(2)).u.dtype == np.float64


@pytest.mark.cpu
@pytest.mark.first(2)
@pytest.mark.parametrize("call", [jm.solve, jm.solve_many, jm.Controller])
def test_dense_problems_that_take_long_or_do_not_fit_are_told_before_any_compile(monkeypatch, call):
    """1,200 steps of two states and an input, with limits of all: 1,200 variables, 3,600 rows."""
    monkeypatch.setattr("jaxmpc.mpc.controller._factor", None)
    long = replace(problems.lecture(), horizon=1200, terminal_set=None)
    given = {jm.solve: (np.zeros(2),), jm.solve_many: (np.zeros((3, 2)),)}.get(call, ())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(UserWarning, match=r"horizon: 1,200 .* 3,600 .* s\. .*solve_stagewise"):
            call(long, *given)
    monkeypatch.setattr("jaxmpc.checks.available_memory", lambda: 5e8)
    with pytest.raises(ValueError, match=r"horizon: .* needs 737.3 MB .*solve_stagewise"):
        call(long, *given)


def test_a_tube_with_many_generators_is_told():
    """Of a loop that damps by 0.97 a step hundreds of steps count: S is the sum of A_K^k W."""
    turn = np.array([[np.cos(1.0), np.sin(1.0)], [-np.sin(1.0), np.cos(1.0)]])
    slow = jm.LinearSystem(A=0.97 * turn, B=np.eye(2))
    small = jm.Box([-1e-3, -1e-3], [1e-3, 1e-3])
    mpc = jm.MPC(
        slow, np.eye(2), np.eye(2), horizon=2, inputs=jm.Box([-1, -1], [1, 1]), policy="tube",
        disturbance=small, gain=np.zeros((2, 2)),
    )  # fmt: skip
    with pytest.warns(UserWarning, match=r"policy: .* generators, .*damps faster"):
        section = tube_section(mpc)
    assert section.generators.shape[1] > 300


def test_limits_that_a_state_breaks_before_any_input():
    """By hand: of a plan without a solution, the error about its limits names them, worst first."""
    system = jm.LinearSystem(
        [[1, 0.1], [0, 1]], [0, 0.1], state_names=("q", "dq"), state_units=("rad", "rad/s")
    )
    mpc = jm.MPC(
        system, np.eye(2), np.eye(1), 3, states=jm.Box([-1.5, -2], [1.5, 2]),
        inputs=jm.Box(-1, 1), outputs=jm.Outputs([[1, 1]], upper=[3], names=("sum",)),
    )  # fmt: skip
    assert broken_at_start(mpc, np.array([1.5, 1.5])) == []
    assert broken_at_start(mpc, np.array([1.6, -4])) == [
        "dq = -4 rad/s, below -2", "q = 1.6 rad, above 1.5"
    ]  # fmt: skip
    assert broken_at_start(mpc, np.array([1.5, 1.9])) == ["sum = 3.4, above 3"]
    assert broken_at_start(replace(mpc, constrain_initial=False), np.array([9.0, 9.0])) == []
    # With the rows of `problems.lecture`, whose program this is.
    limited = replace(mpc, outputs=(), terminal_cost=np.eye(2), terminal_set=mpc.states)
    plan = jm.Controller(limited, PLAIN)(np.array([1.6, 0.0])).plan
    assert plan.status == jm.Status.PRIMAL_INFEASIBLE
    with pytest.raises(ValueError, match="x0 has q = 1.6 rad, above 1.5. Start inside"):
        jm.mpc.active_constraints(limited, plan)
