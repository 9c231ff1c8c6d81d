"""Exact penalties: closed forms, regions against samples, another solver."""

from dataclasses import replace

import jax
import numpy as np
import osqp
import problems
import pytest
import scipy.sparse as sparse
from scipy.optimize import linprog

import jaxmpc as jm
from jaxmpc.explicit.active_sets import least_distance_form
from jaxmpc.explicit.exact_penalties import exact_penalty
from jaxmpc.explicit.regions import critical_regions
from jaxmpc.mpc.condense import condensed_in_float64
from jaxmpc.mpc.problem import Soft, soften
from jaxmpc.qp.status import Status


def one_step(q, r, u_max, rows=None):
    """min q x_1² + r u², |x_1| ≤ 1 (or the rows), |u| ≤ u_max."""
    return jm.MPC(
        system=jm.LinearSystem(np.eye(1), np.eye(1)), Q=np.zeros((1, 1)), R=r * np.eye(1),
        horizon=1, inputs=problems.symmetric(u_max), terminal_cost=q * np.eye(1),
        terminal_set=problems.symmetric(1.0) if rows is None else rows,
    )  # fmt: skip


def slack_by_osqp(mpc, x0, rho):
    """Σ slack of the softened problem, states and slacks as variables of their own, by OSQP."""
    A, B = mpc.system.A, mpc.system.B
    n, m, N = mpc.system.n, mpc.system.m, mpc.horizon
    sets = [mpc.states] * (N - 1) + [mpc.terminal_set]  # k = 1..N
    sides = []
    for body in sets:
        body = body.to_polytope() if isinstance(body, jm.Box) else body
        sides.append((np.asarray(body.H, float), np.asarray(body.h, float)))
    count = sum(len(h) for _, h in sides)
    P_N = np.zeros((n, n)) if mpc.terminal_cost is None else mpc.terminal_cost
    weights = [mpc.Q] * (N - 1) + [P_N] + [mpc.R] * N
    P = sparse.block_diag([2 * sparse.csc_matrix(w) for w in weights], format="csc")
    P = sparse.block_diag([P, sparse.csc_matrix((count, count))], format="csc")
    q = np.concatenate([np.zeros(N * (n + m)), np.full(count, rho)])
    dynamics = np.zeros((N * n, N * (n + m) + count))
    right = np.zeros(N * n)
    for k in range(N):
        rows = slice(k * n, k * n + n)
        dynamics[rows, k * n : k * n + n] = np.eye(n)
        if k:
            dynamics[rows, (k - 1) * n : k * n] = -A
        else:
            right[:n] = A @ x0
        right[rows] += 0 if mpc.system.c is None else mpc.system.c
        dynamics[rows, N * n + k * m : N * n + k * m + m] = -B
    H = sparse.block_diag([sparse.csc_matrix(H) for H, _ in sides])
    limits = sparse.hstack([H, sparse.csc_matrix((count, N * m)), -sparse.eye(count)])
    bounds = sparse.eye(N * (n + m) + count, format="csr")[N * n :]
    h = np.concatenate([h for _, h in sides])
    low = np.concatenate([np.tile(mpc.inputs.lower, N), np.zeros(count)])
    high = np.concatenate([np.tile(mpc.inputs.upper, N), np.full(count, np.inf)])
    solver = osqp.OSQP()
    solver.setup(
        P, q, sparse.vstack([sparse.csc_matrix(dynamics), limits, bounds], format="csc"),
        np.concatenate([right, np.full(count, -np.inf), low]), np.concatenate([right, h, high]),
        eps_abs=1e-10, eps_rel=1e-10, max_iter=200_000, verbose=False,
    )  # fmt: skip
    answer = solver.solve(raise_error=False)
    assert answer.info.status == "solved"
    return answer.x[-count:].sum()


class TestExactPenalty:
    @pytest.mark.parametrize("method", ["regions", "samples"])
    @pytest.mark.parametrize(("q", "r", "u_max"), [(1, 2, 1), (1, 5, 0.5), (3, 1, 1)])
    def test_one_step(self, method, q, r, u_max):
        """rho_bar = max(0, 2 (r u_max − q)): dJ/dx_1 at x_1 = 1 and u = −u_max."""
        found = exact_penalty(one_step(q, r, u_max), method=method, samples=5)
        assert found.rho_bar == pytest.approx(max(0.0, 2 * (r * u_max - q)), rel=1e-9)
        assert found.exact is (method == "regions")
        if found.rho_bar > 0:
            assert abs(found.at[0]) == pytest.approx(1 + u_max) and found.row.stage == 1
            assert found.advised > found.rho_bar
        else:
            assert found.row is None and found.advised > 0

    @pytest.mark.parametrize("method", ["regions", "samples"])
    def test_lecture(self, method):
        found = exact_penalty(problems.lecture(), method=method, samples=20)
        assert found.rho_bar == pytest.approx(11.25, rel=1e-9)
        np.testing.assert_allclose(np.abs(found.at), [0.25, 0.6], rtol=1e-9)
        assert found.row.stage == 3 and "k = 3" in found.label and "x1" in found.label
        assert ("lower bound" in found.sentence.split(",")[0]) is (method == "samples")

    @pytest.mark.parametrize(
        "mpc",
        [
            pytest.param(problems.drifting(), id="drifting"),
            pytest.param(problems.joint_o_inf(5), id="joint O_inf"),
            pytest.param(problems.pair(), id="pair"),
            pytest.param(problems.duplicated(), id="duplicated"),
            pytest.param(problems.apex(), id="apex"),
        ],
    )
    @pytest.mark.first(1)
    def test_samples_reach_regions(self, mpc):
        exact = exact_penalty(mpc, method="regions")
        corners = np.concatenate([region.vertices for region in exact.regions.regions[:20]])
        found = exact_penalty(mpc, corners, method="samples", samples=40)
        np.testing.assert_array_equal(found.status, Status.SOLVED)
        assert np.all(found.thresholds <= exact.rho_bar * (1 + 1e-9))
        assert exact.exact and not found.exact
        assert found.rho_bar == pytest.approx(exact.rho_bar, rel=1e-3)
        assert found.rho_bar <= exact.rho_bar * (1 + 1e-9)

    def test_touching_rows_without_multipliers(self):
        """A vertex where rows touch that have no part in the balance: what rounding leaves of them
        there, 1e-33, once had no multipliers."""
        p = least_distance_form(problems.pair())
        xi = p.scaled([-0.7914862914862912, -0.30851370851370874, -1.0, -0.0968931727780283])
        found = p.solution(xi)
        assert len(found.touching) > len(found.active)
        for value in p.balance(found.touching, -found.y):
            rounding = (value != 0) & (np.abs(value) < 1e-15)
            assert not rounding.any()

    @pytest.mark.parametrize("mpc", [problems.lecture(), problems.drifting()],
                             ids=["lecture", "drifting"])  # fmt: skip
    def test_slack_starts_below(self, mpc):
        """Another solver, states not eliminated: slack below rho_bar and none above."""
        found = exact_penalty(mpc, method="regions")
        at = found.at * (1 - 1e-7)  # rho_bar is a limit from inside X_N, which holds 0
        assert slack_by_osqp(mpc, at, 0.99 * found.rho_bar) > 1e-5
        assert slack_by_osqp(mpc, at, 1.001 * found.rho_bar) < 1e-8

    def test_lecture_slack(self):
        below, above = (
            slack_by_osqp(problems.lecture(), np.array([-0.25, -0.6]), s * 11.25)
            for s in (0.999, 1.001)
        )
        assert below == pytest.approx(8e-5, rel=0.2) and above < 1e-9

    def test_duplicates_share(self):
        """Rows x ≤ 1 and 2x ≤ 2: λ_1 + 2 λ_2 = 2, so the least greatest one is 2/3."""
        rows = jm.Polytope(np.array([[1.0], [2.0], [-1.0], [-2.0]]), np.array([1.0, 2, 1, 2]))
        for method in ("regions", "samples"):
            found = exact_penalty(one_step(1, 2, 1, rows), [[2.0]], method=method, samples=5)
            assert found.rho_bar == pytest.approx(2 / 3, rel=1e-9)
            assert found.thresholds[0] == pytest.approx(2 / 3, rel=1e-9)
        mpc, at = one_step(1, 2, 1, rows), np.array([1.99])
        assert slack_by_osqp(mpc, at, 0.999 * 2 * 0.99 / 3 - 0.01) > 1e-6
        assert slack_by_osqp(mpc, at, 1.001 * 2 / 3) < 1e-8

    def test_least_multiplier(self):
        """At a vertex of X_N multipliers are unbounded; the threshold is not."""
        mpc, x = problems.lecture(), np.array([-0.25, -0.6])
        assert exact_penalty(mpc, [x]).thresholds[0] == pytest.approx(11.25, rel=1e-9)
        c = condensed_in_float64(mpc)
        C, bound = np.vstack([c.C, -c.C]), np.concatenate([c.upper - c.d, c.d - c.lower])
        slack = bound - np.concatenate([c.D, -c.D]) @ x
        z = critical_regions(mpc).plan(x[None])[0]
        on = (np.abs(slack - C @ z) < 1e-9) & np.any(C != 0, axis=1)
        equations = dict(A_eq=C[on].T, b_eq=-(c.P @ z + c.F @ x + c.f))
        largest = linprog(-np.ones(on.sum()), **equations)
        assert largest.status == 3  # unbounded
        # An LP of its own for the least: state and terminal rows come after the three inputs.
        state = np.flatnonzero(np.tile(np.arange(len(c.C)) >= 3, 2)[on])
        size = on.sum()
        least = linprog(
            np.eye(size + 1)[size], A_eq=np.column_stack([equations["A_eq"], np.zeros(3)]),
            b_eq=equations["b_eq"], b_ub=np.zeros(len(state)),
            A_ub=np.column_stack([np.eye(size)[state], -np.ones(len(state))]),
        )  # fmt: skip
        assert least.fun == pytest.approx(11.25, rel=1e-8)

    def test_states(self):
        """Thresholds state by state, with a status each; none exceeds rho_bar."""
        mpc = problems.lecture()
        x = np.array([[0.0, 0.0], [-0.25, -0.6], [-0.25, -0.6001], [2.0, 0.0], [np.nan, 0.0]])
        found = exact_penalty(mpc, x)
        expected = [Status.SOLVED] * 2 + [Status.PRIMAL_INFEASIBLE] * 2 + [Status.NON_FINITE]
        np.testing.assert_array_equal(found.status, expected)
        np.testing.assert_allclose(found.thresholds, [0, 11.25] + [np.nan] * 3, rtol=1e-9)
        inside = np.random.default_rng(0).dirichlet(np.ones(4), 50) @ np.array(
            [[-0.25, -0.6], [0.95, -1.0], [0.25, 0.6], [-0.95, 1.0]]
        )
        assert np.all(exact_penalty(mpc, inside).thresholds <= 11.25 * (1 + 1e-9))

    def test_soft_rows(self):
        """Softened rows count as the hard ones did; a quadratic term changes nothing."""
        found = exact_penalty(soften(problems.lecture(), rho=12.0, quadratic=5.0))
        assert found.exact and found.rho_bar == pytest.approx(11.25, rel=1e-9)
        assert found.row.soft and found.sufficient is True
        assert exact_penalty(soften(problems.lecture(), rho=11.0)).sufficient is False
        # Only the soft rows count: with the terminal set hard, others need less.
        mpc = problems.lecture()
        box = mpc.states.to_polytope()
        some = replace(mpc, states=None, soft=(Soft(box.H, upper=box.h, stages=(0, 1, 2)),))
        part = exact_penalty(some)
        assert part.exact and part.rho_bar < 11.25 and part.row.stage in (1, 2)

    def test_sufficient(self):
        mpc = problems.lecture()
        assert exact_penalty(mpc, rho=11.25).sufficient is True
        assert exact_penalty(mpc, rho=11.24).sufficient is False
        assert exact_penalty(mpc).sufficient is None
        assert exact_penalty(mpc, rho=12.0, method="samples", samples=5).sufficient is None

    def test_auto_goes_on_past_the_limit(self):
        found = exact_penalty(problems.lecture(), max_regions=3, samples=20)
        assert not found.exact and found.method == "samples" and found.regions is not None
        assert found.rho_bar == pytest.approx(11.25, rel=1e-9)

    @pytest.mark.long
    def test_of_what_is_tracked(self):
        """A target beyond a limit presses plans against it: the threshold of the origin is too
        small there, and slacks appear at states from which the limit can be kept."""
        system = jm.LinearSystem([[1.0, 1], [0, 1]], [[0.5], [1]])
        box = jm.Box([-5, -5], [5, 5])
        mpc = jm.MPC(system, [1.0, 1], 1.0, 3, box, jm.Box(-1, 1))
        r = np.array([20.0, 0])
        origin, there = exact_penalty(mpc), exact_penalty(mpc, reference=r)
        assert there.exact and there.rho_bar > 10 * max(origin.rho_bar, 1)
        x0s = np.random.default_rng(0).uniform(-5, 5, (40, 2))
        plan = lambda mpc: jax.vmap(lambda x: jm.solve(mpc, x, r))(x0s)
        with jax.enable_x64(True):
            hard = plan(mpc)
            apart = [
                np.abs(hard.inputs - plan(jm.soften(mpc, found.advised)).inputs)[hard.solved].max()
                for found in (there, origin)
            ]
        assert apart[0] < 1e-8 and apart[1] > 0.1

    def test_errors(self):
        mpc = problems.lecture()
        for settings, message in [
            ({"method": "milp"}, "method"),
            ({"samples": 0}, "samples"),
            ({"rho": -1.0}, "rho"),
            ({"rho": np.ones(2)}, "rho"),
            ({"x0s": np.zeros(2)}, "x0s"),
            ({"x0s": np.zeros((3, 1))}, "x0s"),
            ({"max_regions": 0}, "max_regions"),
        ]:
            with pytest.raises(ValueError, match=message):
                exact_penalty(mpc, **settings)
        with pytest.raises(ValueError, match="soften"):
            exact_penalty(replace(mpc, states=None, terminal_set=None),
                          within=problems.symmetric(1.0, 1.0))  # fmt: skip

    def test_scaled_rows(self):
        """A row scaled by s has its multiplier divided by s."""
        mpc = problems.lecture()
        box = mpc.states.to_polytope()
        body = jm.Polytope(2 * box.H, 2 * box.h)
        found = exact_penalty(replace(mpc, states=body, terminal_set=body))
        assert found.rho_bar == pytest.approx(11.25 / 2, rel=1e-9)

    def test_program_is_the_condensed_qp(self):
        """M y ≤ v + V ξ is lower ≤ C z + D x + d ≤ upper, row by row."""
        mpc = problems.drifting()
        p, c, random = least_distance_form(mpc), condensed_in_float64(mpc), np.random.default_rng(3)
        xi, z = random.standard_normal(2), random.standard_normal(c.P.shape[0])
        x = p.center + p.size * xi
        y = p.factor.T @ z + p.shift @ np.append(x, 1.0)
        slack = (p.v + p.V @ xi - p.M @ y)[~p.zero_row] * p.length[~p.zero_row]
        s = c.C @ z + c.D @ x + c.d
        expected = np.where(p.side > 0, c.upper[p.row] - s[p.row], s[p.row] - c.lower[p.row])
        np.testing.assert_allclose(slack, expected[~p.zero_row], atol=1e-12)
