"""The QP solver against programs with known answers, exact certificates and finite differences."""

import re
from dataclasses import replace
from functools import partial

import chex
import exact
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy
from jax import enable_x64
from padded import solution, solutions
from problems import residuals

import jaxmpc as jm
from jaxmpc.mpc.condense import condense
from jaxmpc.qp.admm import factorise
from jaxmpc.qp.problem import Bounds
from jaxmpc.qp.solve import solve_factored

INF = np.inf
FINE = jm.ADMM(iterations=400, newton_steps=30, eps=1e-9)
# Tests of what few steps leave share programs of one shape, `constructed(6, seed)` and `START`.
FEW = jm.ADMM(iterations=10, newton_steps=0)
START = np.zeros(6), np.zeros(15)
solve = jax.jit(jm.solve_qp)


def constructed(n: int, seed: int, curvature: str = "definite"):
    """A QP built from its answer: (qp, z, y), with z and y unique.

    Draw z, one multiplier for each active row, and derive q = −Pz − A'y, l and u. Rows: active
    above, active below, equality, inactive, free, zero: 2n + 3 of them, whatever the
    curvature. With singular or zero P the n active rows fix z alone.
    """
    rng = np.random.default_rng(seed)
    active = n if curvature != "definite" else max(n // 2, 1)
    kinds = rng.permutation(
        ["upper", "lower", "equal"] * (active // 3) + ["upper"] * (active % 3)
        + ["inactive"] * (2 * n - active) + ["free", "zero", "one-sided"]
    )  # fmt: skip
    m = len(kinds)
    A, z, y = rng.standard_normal((m, n)), rng.standard_normal(n), np.zeros(m)
    A[kinds == "zero"] = 0.0
    rank = {"definite": n, "singular": n // 2, "zero": 0}[curvature]
    factor = rng.standard_normal((n, rank))
    P = factor @ factor.T + (0.5 * np.eye(n) if curvature == "definite" else 0.0)
    value, slack = A @ z, rng.uniform(0.2, 2.0, (2, m))
    l, u = value - slack[0], value + slack[1]
    l[np.isin(kinds, ["free", "one-sided"])], u[kinds == "free"] = -INF, INF
    push = rng.uniform(0.1, 3.0, m)
    upper, lower, equal = kinds == "upper", kinds == "lower", kinds == "equal"
    u[upper], y[upper] = value[upper], push[upper]
    l[lower], y[lower] = value[lower], -push[lower]
    l[upper & (rng.uniform(size=m) < 0.5)] = -INF
    l[equal], u[equal] = value[equal], value[equal]
    y[equal] = (push * rng.choice([-1, 1], m))[equal]
    return jm.QP(P=P, q=-P @ z - A.T @ y, A=A, l=l, u=u), z, y


def box(n: int, radius: float = 1.0, **fields) -> jm.QP:
    """min ½|z|² over |z_i| ≤ radius."""
    r = np.full(n, radius)
    return replace(jm.QP(P=np.eye(n), q=np.zeros(n), A=np.eye(n), l=-r, u=r), **fields)


def as32(qp: jm.QP) -> jm.QP:
    return jax.tree.map(np.float32, qp)


class TestKnownAnswers:
    @pytest.mark.parametrize("n", [1, 5, 20, pytest.param(60, marks=pytest.mark.slow)])
    @pytest.mark.slow
    def test_float64(self, x64, n):
        for seed in range(3):
            qp, z, y = constructed(n, seed)
            sol = solve(qp, FINE)
            assert sol.status == jm.Status.SOLVED
            assert sol.z.dtype == jnp.float64
            np.testing.assert_allclose(sol.z, z, atol=1e-8 * (1 + np.abs(z).max()))
            np.testing.assert_allclose(sol.y, y, atol=1e-6)

    @pytest.mark.long
    @pytest.mark.parametrize("n", [8, 1, 5, 20])
    @pytest.mark.first(1)
    def test_singular_hessian(self, x64, n):
        """Half of the directions have no curvature: only the active rows fix them."""
        for seed in range(3):
            qp, z, _ = constructed(n, seed, "singular")
            sol = solution(qp, 1e-7) if n <= 8 else solve(qp, replace(FINE, eps=1e-7))
            assert sol.status == jm.Status.SOLVED
            np.testing.assert_allclose(sol.z, z, atol=1e-5)

    @pytest.mark.long
    @pytest.mark.first(1)
    @pytest.mark.parametrize("n", [8, 1, 5, 20])
    def test_linear_programs(self, x64, n):
        """P = 0: ADMM is slow there; solved and right, or said to be unfinished."""
        for seed in range(3):
            qp, z, _ = constructed(n, seed, "zero")
            sol = solution(qp, 1e-7) if n <= 8 else solve(qp, replace(FINE, eps=1e-7))
            assert sol.status in (jm.Status.SOLVED, jm.Status.ITERATION_LIMIT)
            if sol.status == jm.Status.SOLVED:
                np.testing.assert_allclose(sol.z, z, atol=1e-5)

    @pytest.mark.slow
    def test_linear_program_in_a_box(self, x64):
        q = np.array([1.0, -2.0, 0.5])
        sol = solution(box(3, P=np.zeros((3, 3)), q=q))
        assert sol.status == jm.Status.SOLVED
        np.testing.assert_allclose(sol.z, -np.sign(q), atol=1e-8)
        np.testing.assert_allclose(sol.y, -q, atol=1e-8)

    @pytest.mark.parametrize("n", [pytest.param(2, marks=pytest.mark.slow), 20])
    @pytest.mark.slow
    def test_float32(self, n):
        for seed in range(3):
            qp, z, y = constructed(n, seed)
            sol = solve(as32(qp), jm.ADMM(iterations=400))
            assert sol.status == jm.Status.SOLVED
            assert sol.z.dtype == jnp.float32
            np.testing.assert_allclose(sol.z, z, atol=2e-3)
            np.testing.assert_allclose(sol.y, y, atol=2e-2)

    def test_default_settings_solve_most(self, x64):
        status = solutions([constructed(6, seed)[0] for seed in range(20)]).status
        assert np.mean(status == jm.Status.SOLVED) >= 0.9

    @pytest.mark.slow
    @pytest.mark.parametrize("scale", [1e-6, 1e6])
    def test_units_do_not_matter(self, x64, scale):
        """Rows, cost and variables in other units: same solution."""
        qp, z, _ = constructed(5, 1)
        rows = np.geomspace(1 / scale, scale, len(qp.l))
        other = jm.QP(
            P=qp.P * scale, q=qp.q * scale, A=rows[:, None] * qp.A, l=rows * qp.l, u=rows * qp.u
        )
        sol = solve(other, replace(FINE, eps=1e-3))
        np.testing.assert_allclose(sol.z, z, atol=1e-7)

    @pytest.mark.slow  # plans without limits are such programs: `TestRiccati` of `test_mpc.py`
    def test_no_rows(self, x64):
        P, q = np.diag([1.0, 4.0]), np.array([1.0, -2.0])
        sol = jm.solve_qp(jm.QP(P, q, np.zeros((0, 2)), np.zeros(0), np.zeros(0)))
        assert sol.status == jm.Status.SOLVED
        np.testing.assert_allclose(sol.z, [-1.0, 0.5], atol=1e-9)

    @pytest.mark.slow
    def test_equality_alone(self, x64):
        """KKT system solved by numpy."""
        rng = np.random.default_rng(3)
        P, A = np.diag(rng.uniform(0.5, 2, 6)), rng.standard_normal((3, 6))
        q, b = rng.standard_normal(6), rng.standard_normal(3)
        kkt = np.block([[P, A.T], [A, np.zeros((3, 3))]])
        answer = np.linalg.solve(kkt, np.concatenate([-q, b]))
        sol = jm.solve_qp(jm.QP(P, q, A, b, b), FINE)
        np.testing.assert_allclose(np.concatenate([sol.z, sol.y]), answer, atol=1e-8)

    def test_one_point_is_feasible(self, x64):
        """l = u fixes every variable: never called infeasible, zero data included."""
        for value in (0.0, 1.0, -3.0):
            v = np.full(3, value)
            sol = solution(box(3, l=v, u=v))
            assert sol.status == jm.Status.SOLVED
            np.testing.assert_allclose(sol.z, v, atol=1e-8)

    @pytest.mark.parametrize(
        "solve",
        [
            solution,
            pytest.param(jm.solve_qp, marks=pytest.mark.slow),
            pytest.param(lambda qp: jm.solve_qp(qp, jm.ADMM(0)), marks=pytest.mark.slow),
        ],
    )
    def test_zero_everything(self, x64, solve):
        n, m = 6, 15
        zeros = np.zeros
        sol = solve(jm.QP(zeros((n, n)), zeros(n), zeros((m, n)), zeros(m), zeros(m)))
        assert sol.status == jm.Status.SOLVED
        qp = jm.QP(np.eye(n), zeros(n), np.ones((m, n)), zeros(m), zeros(m))
        assert solve(qp).status != jm.Status.PRIMAL_INFEASIBLE

    def test_duplicate_and_redundant_rows(self, x64):
        qp, z, _ = constructed(2, 2)  # 7 rows, of which some hold nothing
        some = np.argsort(np.isinf(qp.l) & np.isinf(qp.u), stable=True)[:5]
        twice = replace(
            qp, A=np.vstack([qp.A, qp.A, 2 * qp.A[some]]),
            l=np.concatenate([qp.l, qp.l, 2 * qp.l[some]]),
            u=np.concatenate([qp.u, qp.u, 2 * qp.u[some]]),
        )  # fmt: skip
        sol = solution(twice, 1e-9)
        assert sol.status == jm.Status.SOLVED
        np.testing.assert_allclose(sol.z, z, atol=1e-7)

    def test_another_solver(self, x64):
        osqp = pytest.importorskip("osqp")
        sparse = scipy.sparse.csc_matrix
        rng = np.random.default_rng(0)
        n = 8
        M = rng.standard_normal((n, n))
        qp = jm.QP.from_qpsolvers(
            sparse(M @ M.T + np.eye(n)), rng.standard_normal(n),
            G=sparse(rng.standard_normal((9, n))), h=rng.uniform(0.1, 1, 9),
            A=sparse(rng.standard_normal((2, n))), b=rng.uniform(-0.2, 0.2, 2),
            lb=-np.ones(n), ub=np.full(n, 1.5),
        )  # fmt: skip
        other = osqp.OSQP()
        other.setup(
            sparse(qp.P), qp.q, sparse(qp.A), qp.l, qp.u,
            eps_abs=1e-10, eps_rel=1e-10, max_iter=100000, verbose=False,
        )  # fmt: skip
        sol = solution(qp, 1e-9)
        assert sol.status == jm.Status.SOLVED
        np.testing.assert_allclose(sol.z, other.solve(raise_error=True).x, atol=1e-7)


class TestFromQpsolvers:
    def test_rows_and_order(self):
        qp = jm.QP.from_qpsolvers(
            np.eye(2), [0, 1], G=[[1, 2]], h=[3], A=[4, 5], b=6, lb=[-1, -2], ub=None
        )
        np.testing.assert_array_equal(qp.A, [[1, 2], [4, 5], [1, 0], [0, 1]])
        np.testing.assert_array_equal(qp.l, [-INF, 6, -1, -2])
        np.testing.assert_array_equal(qp.u, [3, 6, INF, INF])

    @pytest.mark.slow
    def test_duals(self, x64):
        """Px + q + G'z + A'y + z_box = 0 with signs as in qpsolvers, complementary."""
        rng = np.random.default_rng(3)
        n, G, A = 6, rng.normal(size=(5, 6)), rng.normal(size=(2, 6))
        q, h, b, lb, ub = 3 * rng.normal(size=n), rng.uniform(0.05, 0.1, 5), np.zeros(2), -0.3, 0.2
        lb, ub = np.full(n, lb), np.full(n, ub)
        sol = jm.solve_qp(jm.QP.from_qpsolvers(np.eye(n), q, G, h, A, b, lb, ub))
        z, y, z_box = sol.duals(5, 2)
        x = sol.z
        np.testing.assert_allclose(x + q + G.T @ z + A.T @ y + z_box, 0, atol=1e-9)
        assert np.all(z >= 0) and np.any(z > 1e-3) and np.any(np.abs(z_box) > 1e-3)
        np.testing.assert_allclose(z * (h - G @ x), 0, atol=1e-9)
        side = np.where(z_box > 0, ub - x, x - lb)
        np.testing.assert_allclose(z_box * side, 0, atol=1e-9)
        assert not np.any(jm.solve_qp(jm.QP.from_qpsolvers(np.eye(n), q, G, h)).duals(5, 0).z_box)

    @pytest.mark.slow
    def test_sparse_matrices(self, x64):
        qp = constructed(6, 5)[0]
        sparse = scipy.sparse.csc_matrix
        found = jm.solve_qp(replace(qp, P=sparse(qp.P), A=sparse(qp.A)))
        np.testing.assert_array_equal(found.z, jm.solve_qp(qp).z)

    def test_nothing_but_cost(self, x64):
        qp = jm.QP.from_qpsolvers(2 * np.eye(2), [2, -4])
        assert qp.A.shape == (0, 2)
        np.testing.assert_allclose(solution(qp).z, [-1, 2], atol=1e-9)

    def test_bounds_only_above(self, x64):
        qp = jm.QP.from_qpsolvers(np.eye(2), [-2, -2], ub=[1, 5])
        np.testing.assert_allclose(solution(qp, 1e-9).z, [1, 2], atol=1e-9)


class TestResiduals:
    def test_formulas(self, x64):
        rng = np.random.default_rng(5)
        qp, _, _ = constructed(6, 5)
        z, y = rng.standard_normal(6), rng.standard_normal(len(qp.l))
        y = np.where(np.isinf(qp.u), np.minimum(y, 0), y)
        y = np.where(np.isinf(qp.l), np.maximum(y, 0), y)
        v = qp.A @ z
        primal = max(max(0, lo - x, x - hi) for x, lo, hi in zip(v, qp.l, qp.u, strict=True))
        dual = np.abs(qp.P @ z + qp.q + qp.A.T @ y).max()
        support = sum(
            a * (hi if a > 0 else lo) if a else 0 for a, lo, hi in zip(y, qp.l, qp.u, strict=True)
        )
        gap = abs(z @ qp.P @ z + qp.q @ z + support)
        found = jax.jit(residuals)(qp, z, y)
        np.testing.assert_allclose(found, [primal, dual, gap], rtol=1e-12)

    def test_wrong_sign_at_an_infinite_bound(self, x64):
        qp = box(1, u=np.array([INF]))
        assert residuals(qp, np.zeros(1), np.ones(1))[2] == INF
        assert Bounds(jnp.array([-INF] * 2), jnp.array([INF] * 2)).support(jnp.zeros(2)).sum() == 0

    def test_reported_ones_are_those_of_the_answer(self, x64):
        qp, _, _ = constructed(6, 7)
        sol = jm.solve_qp(qp, FEW, START)
        got = sol.primal_residual, sol.dual_residual, sol.gap
        recomputed = jax.jit(residuals)(qp, sol.z, sol.y)
        np.testing.assert_allclose(got, recomputed, rtol=1e-9, atol=1e-14)

    def test_multiplier_sign(self, x64):
        """min ½(z − 3)² over |z| ≤ 1: y = 2 pushes down from above; mirrored below."""
        for side in (1.0, -1.0):
            sol = solution(box(1, q=np.array([-3 * side])), 1e-9)
            np.testing.assert_allclose([sol.z[0], sol.y[0]], [side, 2 * side], atol=1e-8)


class TestHonestStatus:
    @pytest.mark.parametrize(
        ("iterations", "newton_steps"),
        [(10, 0), (0, 0), (1, 3), (20, 0), (200, 3)]
        + [
            pytest.param(*pair, marks=pytest.mark.slow)
            for pair in ((0, 3), (1, 0), (20, 3), (200, 0))
        ],
    )
    @pytest.mark.parametrize("eps", [1e-2, 1e-6])
    @pytest.mark.first(1)
    def test_solved_means_small_residuals(self, x64, iterations, newton_steps, eps):
        """SOLVED where residuals recomputed by numpy are within eps, relative to what they are
        differences of, and nowhere else."""
        batch = [constructed(6, seed) for seed in range(8)]
        for qp, _, _ in batch:
            settings = jm.ADMM(iterations=iterations, newton_steps=newton_steps, eps=eps)
            sol = jm.solve_qp(qp, settings, None if newton_steps else START)
            z, y = np.asarray(sol.z), np.asarray(sol.y)
            v, support = qp.A @ z, 0.0
            support = float(Bounds(qp.l, qp.u).support(sol.y).sum())
            sums = qp.P @ z, qp.q, qp.A.T @ y
            numbers = z @ qp.P @ z, qp.q @ z, support
            size = sum(map(abs, numbers))
            worst = max(
                np.max(np.abs(v - np.clip(v, qp.l, qp.u)) / (np.abs(v) + 0.01)),
                np.max(np.abs(sum(sums)) / (sum(map(np.abs, sums)) + 0.01)),
                abs(sum(numbers)) / (size + 0.01),
            )
            if sol.status == jm.Status.SOLVED:
                assert worst <= eps * (1 + 1e-6) + 1e-10
            else:
                assert sol.status == jm.Status.ITERATION_LIMIT
                assert worst > 0.01 * eps

    def test_few_iterations_are_a_limit(self, x64):
        sol = jm.solve_qp(constructed(6, 0)[0], FEW, START)
        assert sol.status == jm.Status.ITERATION_LIMIT
        assert sol.iterations == 10
        assert "iterations" in jm.Status(int(sol.status)).sentence

    def test_numbers_of_osqp_and_sentences(self):
        assert [int(s) for s in jm.Status] == [0, 1, 2, 3, 5, 7, 9, 12]
        assert all(s.sentence.endswith(".") for s in jm.Status)

    @pytest.mark.slow
    @pytest.mark.parametrize("n", [1, 3, 20])
    def test_infeasible_with_box(self, x64, n):
        """Oblique rows that miss a box; certificate checked in rationals."""
        for seed in range(5):
            rng = np.random.default_rng(seed)
            a = rng.standard_normal((2, n))
            reach = np.abs(a).sum(axis=1)
            A = np.vstack([np.eye(n), a])
            l = np.concatenate([-np.ones(n), [1.05 * reach[0], -1.0]])
            u = np.concatenate([np.ones(n), [INF, 1.0]])
            M = rng.standard_normal((n, n))
            qp = jm.QP(M @ M.T + 0.1 * np.eye(n), rng.standard_normal(n), A, l, u)
            sol = solve(qp)
            assert sol.status == jm.Status.PRIMAL_INFEASIBLE
            assert exact.proves_empty(A, l, u, sol.certificate)
            np.testing.assert_array_equal(sol.ray, 0)

    @pytest.mark.slow
    def test_infeasible_without_box(self, x64):
        """Integer rows z₁ + z₂ ≥ 2, z₁ + z₂ ≤ 1: the certificate is (−t, t)."""
        A = np.array([[1.0, 1.0], [1.0, 1.0]])
        l, u = np.array([2.0, -INF]), np.array([INF, 1.0])
        sol = solution(jm.QP(np.eye(2), np.ones(2), A, l, u))
        assert sol.status == jm.Status.PRIMAL_INFEASIBLE
        y = np.asarray(sol.certificate)
        np.testing.assert_allclose(A.T @ y, 0, atol=1e-12)
        assert y[0] < 0 < y[1] and u[1] * y[1] + l[0] * y[0] < 0

    @pytest.mark.slow
    def test_infeasible_zero_row(self, x64):
        """0'z ≥ 1 contradicts itself."""
        qp = jm.QP(np.eye(2), np.ones(2), np.zeros((1, 2)), np.ones(1), np.array([INF]))
        sol = solution(qp)
        assert sol.status == jm.Status.PRIMAL_INFEASIBLE
        assert exact.proves_empty(qp.A, qp.l, qp.u, sol.certificate)

    @pytest.mark.slow
    def test_infeasible_float32(self):
        A = np.array([[1, 0], [0, 1], [1, 1]], np.float32)
        l, u = np.array([-1, -1, 2.5], np.float32), np.array([1, 1, INF], np.float32)
        sol = jm.solve_qp(jm.QP(np.eye(2, dtype=np.float32), np.ones(2, np.float32), A, l, u))
        assert sol.status == jm.Status.PRIMAL_INFEASIBLE
        assert exact.proves_empty(A, l, u, np.asarray(sol.certificate))

    @pytest.mark.first(3)
    @pytest.mark.parametrize("gap", [1e-1, 1e-2, 1e-3, -1e-3, -1e-2])
    def test_never_infeasible_when_feasible(self, x64, gap):
        """A corner of the box misses (gap > 0) or meets (gap < 0) an oblique row by |gap|."""
        for seed in range(4):
            rng = np.random.default_rng(seed)
            a = rng.standard_normal((1, 5))
            A = np.vstack([np.eye(5), a])
            l = np.append(-np.ones(5), np.abs(a).sum() + gap)
            u = np.append(np.ones(5), INF)
            sol = solution(jm.QP(np.eye(5), rng.standard_normal(5), A, l, u), 1e-9)
            if gap < 0:
                assert sol.status == jm.Status.SOLVED
            else:
                assert sol.status in (jm.Status.PRIMAL_INFEASIBLE, jm.Status.ITERATION_LIMIT)
                if sol.status == jm.Status.PRIMAL_INFEASIBLE:
                    assert exact.proves_empty(A, l, u, sol.certificate)

    @pytest.mark.parametrize("P", [np.zeros((2, 2)), np.diag([1.0, 0.0])], ids=["P=0", "flat"])
    def test_unbounded(self, x64, P):
        """Cost falls along −z₂, which only a bound from above limits."""
        A, l, u = np.eye(2), np.array([-1, -INF]), np.array([1.0, 3.0])
        qp = jm.QP(P, np.array([0.3, 1.0]), A, l, u)
        sol = solution(qp)
        assert sol.status == jm.Status.DUAL_INFEASIBLE
        d = np.asarray(sol.ray)
        np.testing.assert_allclose(np.abs(d).max(), 1)
        np.testing.assert_allclose(P @ d, 0, atol=1e-7)
        assert qp.q @ d < 0 and d[1] <= 1e-7 and abs(d[0]) <= 1e-7

    def test_unbounded_without_rows(self, x64):
        sol = jm.solve_qp(
            jm.QP(np.zeros((2, 2)), np.ones(2), np.zeros((0, 2)), np.zeros(0), np.zeros(0))
        )
        assert sol.status == jm.Status.DUAL_INFEASIBLE

    @pytest.mark.slow
    def test_slow_descent_is_not_called_unbounded(self, x64):
        """A flat but bounded direction: curvature 1e-6 is not none."""
        qp = jm.QP(np.diag([1.0, 1e-6]), np.array([0.0, 1e-3]), np.eye(2), -INF * np.ones(2),
                   INF * np.ones(2))  # fmt: skip
        sol = solve(qp, FINE)
        assert sol.status != jm.Status.DUAL_INFEASIBLE
        np.testing.assert_allclose(sol.z, [0, -1e3], rtol=1e-6, atol=1e-6)


SHARED = jm.QP(P=None, q=0, A=None, l=0, u=0)  # axes: many q, l and u; one P and A


def each_solved(qp: jm.QP):
    """Solutions of programs that share P and A, each with its own copy."""
    parts = zip(qp.q, qp.l, qp.u, strict=True)
    return solutions([jm.QP(qp.P, q, qp.A, l, u) for q, l, u in parts], dtype=qp.q.dtype)


class TestBatches:
    def spoiled(self):
        """Five good QPs, then one for each way data can be bad."""
        good, _, _ = constructed(6, 11)
        q = np.tile(good.q, (9, 1)) + np.linspace(0, 0.5, 9)[:, None]
        l, u = np.tile(good.l, (9, 1)), np.tile(good.u, (9, 1))
        clean = jm.QP(good.P, q.copy(), good.A, l.copy(), u.copy())
        q[1, 2] = np.nan
        l[3, 0], u[3, 0] = 2.0, 1.0
        u[5, 1] = np.nan
        q[7, 0] = INF
        return clean, jm.QP(good.P, q, good.A, l, u)

    @pytest.mark.parametrize("x32", [False, pytest.param(True, marks=pytest.mark.slow)])
    @pytest.mark.parametrize("shared", [False, pytest.param(True, marks=pytest.mark.slow)])
    def test_bad_neighbours_change_nothing(self, x32, shared):
        """Nor each other where P and A are those of all of them."""
        solve = jax.jit(jax.vmap(jm.solve_qp, (SHARED,))) if shared else each_solved
        with enable_x64(not x32):
            clean, spoiled = self.spoiled()
            if x32:
                clean, spoiled = as32(clean), as32(spoiled)
            expected, got = solve(clean), solve(spoiled)
            bad = np.isin(np.arange(9), [1, 3, 5, 7])
            np.testing.assert_array_equal(np.asarray(got.status)[bad], jm.Status.NON_FINITE)
            assert np.isnan(got.z[bad]).all() and np.isnan(got.primal_residual[bad]).all()
            chex.assert_trees_all_equal(
                jax.tree.map(lambda v: v[~bad], got), jax.tree.map(lambda v: v[~bad], expected)
            )

    @pytest.mark.slow
    def test_batch_agrees_with_single(self, x64):
        clean, _ = self.spoiled()
        batch = jax.jit(jax.vmap(jm.solve_qp, (SHARED,)))(clean)
        for i in range(9):
            one = jm.solve_qp(replace(clean, q=clean.q[i], l=clean.l[i], u=clean.u[i]))
            np.testing.assert_allclose(batch.z[i], one.z, atol=1e-9)
            assert batch.status[i] == one.status

    def test_infinite_bounds_on_the_wrong_side(self, x64):
        """l = +inf or u = −inf: no value is allowed."""
        qp, _ = self.spoiled()
        l, u = qp.l.copy(), qp.u.copy()
        l[0], u[0], l[1], u[1] = INF, INF, -INF, -INF
        l[2, 3], u[2, 3], l[3, 3], u[3, 3] = INF, INF, -INF, -INF
        status = each_solved(replace(qp, l=l, u=u)).status
        assert (status[4:] == jm.Status.SOLVED).all()
        assert jm.Status.SOLVED not in status[:4]

    def cholesky_shapes(self, function, *args) -> list:
        """Shapes of all Cholesky factorizations in the traced program, loops included."""
        shapes = []

        def walk(jaxpr):
            for equation in jaxpr.eqns:
                if "cholesky" in equation.primitive.name:
                    shapes.append(equation.outvars[0].aval.shape)
                for inner in jax.tree.leaves(
                    equation.params, is_leaf=lambda v: hasattr(v, "eqns") or hasattr(v, "jaxpr")
                ):
                    walk(inner.jaxpr if hasattr(inner, "jaxpr") else inner) if hasattr(
                        inner, "eqns"
                    ) or hasattr(inner, "jaxpr") else None

        walk(jax.make_jaxpr(function)(*args).jaxpr)
        return shapes

    def test_one_factorization_for_shared_matrices(self, x64):
        clean, _ = self.spoiled()
        solver = jm.ADMM(newton_steps=0)
        shared = jax.vmap(lambda qp: jm.solve_qp(qp, solver), in_axes=(SHARED,))
        shapes = self.cholesky_shapes(shared, clean)
        assert shapes and all(shape == (6, 6) for shape in shapes)
        # Convexity, whether P is singular, its range, coordinates, and one stage of rho.
        assert len(shapes) == 5
        own = jax.vmap(lambda qp: jm.solve_qp(qp, solver))
        each = replace(clean, P=np.tile(clean.P, (9, 1, 1)), A=np.tile(clean.A, (9, 1, 1)))
        assert set(self.cholesky_shapes(own, each)) == {(9, 6, 6)}

    def test_one_trace(self, x64):
        solve = jax.jit(chex.assert_max_traces(lambda qp: jm.solve_qp(qp).z, n=1))
        for seed in range(3):
            qp, _, _ = constructed(5, seed)
            solve.trace(jm.QP(qp.P, qp.q, qp.A, qp.l, qp.u))


class TestFloat32:
    @pytest.mark.slow
    def test_dual_steps_solve_what_they_solve_in_float64(self):
        """Without a Newton step of the method of multipliers: rounding of the factor to float32
        left residuals above those at which a search on the dual ends."""
        system = jm.LinearSystem(np.array([[1, 0.01], [0, 1]]), np.array([[0.0], [0.2]]))
        limits = jm.Box([-1.5, -2.0], [1.5, 2.0]), jm.Box([-2.0], [2.0])
        c = condense(jm.MPC(system, np.diag([50.0, 1.0]), np.array([[0.1]]), 20, *limits))
        x = jnp.asarray(np.random.default_rng(0).uniform([-1.4, -1.2], [1.4, 1.2], (100, 2)))
        made, solver = factorise(c.P, c.C, jm.ADMM()), jm.ADMM()
        assert x.dtype == c.P.dtype == jnp.float32
        dual = partial(solve_factored, factor=made, solver=solver, whole=False)
        found, _ = jax.jit(jax.vmap(lambda x: dual(c.qp(x))))(x)
        known = jax.jit(jax.vmap(lambda x: jm.solve_qp(c.qp(x))))(x)
        feasible = known.status == jm.Status.SOLVED
        assert feasible.sum() > 80
        assert (found.status == known.status)[feasible].all()

    many = staticmethod(jax.jit(jax.vmap(jm.solve_qp)))

    def solved(self, programs):
        """Solutions of programs of one shape, rounded to float32, in float64 arrays."""
        qp = jax.tree.map(lambda *v: np.stack(v).astype(np.float32), *programs)
        return qp, jax.tree.map(lambda v: np.asarray(v, float), self.many(qp))

    @pytest.mark.long
    def test_rounded_hessian_of_half_rank(self):
        """Rounded, P has curvature of either sign where it had none and where rows lie. Nearly all
        programs have a solution within the tolerance even so; what is found is one to rounding."""
        rng, n, rank, count = np.random.default_rng(3), 16, 8, 40
        programs = []
        for _ in range(count):
            V = np.linalg.qr(rng.standard_normal((n, n)))[0]
            factor = V[:, :rank] @ rng.standard_normal((rank, rank))
            A, z = rng.standard_normal((20, n - rank)) @ V[:, rank:].T, rng.standard_normal(n)
            push, value = (np.arange(20) < 6) * rng.uniform(0.1, 3, 20), A @ z
            u, P = value + (push == 0) * rng.uniform(0.2, 2, 20), factor @ factor.T
            programs.append(jm.QP(P, -P @ z - A.T @ push, A, value - 5.0, u))
        qp, found = self.solved(programs)
        assert np.mean(found.status == jm.Status.SOLVED) >= 0.95
        assert np.isin(found.status, [jm.Status.SOLVED, jm.Status.INACCURATE]).all()
        P, q, A, l, u = (np.asarray(v, float) for v in (qp.P, qp.q, qp.A, qp.l, qp.u))
        times = lambda M, v: (M @ v[..., None])[..., 0]
        z, y, columns = found.z, found.y, A.swapaxes(1, 2)
        beyond = times(A, z) - np.clip(times(A, z), l, u)
        gradient = times(P, z) + q + times(columns, y)
        of_rows = times(abs(A), abs(z)) + np.maximum(abs(l), abs(u))
        terms = times(abs(P), abs(z)) + abs(q) + times(abs(columns), abs(y))
        assert np.all(abs(beyond) <= 1e-5 * of_rows) and np.all(abs(gradient) <= 1e-5 * terms)
        # Of a row that is not met there is no multiplier: with this the conditions are complete.
        slack = np.where(y > 0, u - times(A, z), times(A, z) - l)
        assert np.all(abs(y) * np.maximum(slack, 0) <= 1e-5 * of_rows * (1 + abs(y)))

    @pytest.mark.long
    def test_units_of_a_linear_cost(self):
        """The vertex of a linear program is where it is, whatever the size of its cost beside that
        of its limits: 16 rows meet there, and push."""
        rng, n = np.random.default_rng(4), 16
        programs, vertices = [], []
        for far, near in np.repeat([[1e-4, 1e4], [1e8, 1.0], [1.0, 1e8], [1.0, 1.0]], 10, axis=0):
            A, z = rng.standard_normal((20, n)), far * rng.standard_normal(n)
            push, value = (np.arange(20) < n) * rng.uniform(0.1, 3, 20), A @ z
            u = value + far * (push == 0) * rng.uniform(0.2, 2, 20)
            programs.append(jm.QP(np.zeros((n, n)), -near * A.T @ push, A, value - 9 * far, u))
            vertices.append(np.linalg.solve(*(v[:n] for v in map(np.float32, (A, u)))))
        _, found = self.solved(programs)
        assert (found.status == jm.Status.SOLVED).all()
        off = np.max(abs(found.z - vertices), axis=1) / np.max(abs(np.array(vertices)), axis=1)
        assert np.all(off <= 1e-4)


def badly_scaled(n, rng):
    """A linear program in z ≥ 0 with n sparse rows and one of its solutions."""
    rows = rng.standard_normal((n, n)) * (rng.random((n, n)) < 0.2)
    columns, units = 10 ** rng.uniform(-3, 3, (2, n))
    A = np.vstack([rows, np.eye(n)])
    z = np.where(rng.random(n) < 0.5, 0, rng.uniform(0.5, 2, n))
    equal = rng.random(n) < 0.4
    pushes = rng.random(n) < 0.4
    value = rows @ z
    l = np.where(equal | pushes, value, value - rng.uniform(0.1, 2, n))
    y = np.where(pushes, -rng.uniform(0.1, 3, n), 0.0)
    y = np.concatenate(
        [np.where(equal, rng.standard_normal(n), y), -1.0 * (z == 0) * rng.random(n)]
    )
    l, u = np.append(l, np.zeros(n)), np.append(np.where(equal, value, np.inf), np.full(n, np.inf))
    E = np.concatenate([units, 1 / columns])
    qp = jm.QP(
        np.zeros((n, n)), -columns * (y @ A), E[:, None] * A * columns, E * l, E * u
    )  # fmt: skip
    return qp, z / columns


class TestHardPrograms:
    """Each of these once ended at the iteration limit."""

    @pytest.mark.parametrize("bound", [1e5, 1e10, 1e12, 1e15, 1e20, 1e30])
    def test_linear_program_with_far_bounds(self, x64, bound):
        """max x + 2y, x + y ≤ 1, x and y from 0 to far away: (0, 1)."""
        qp = jm.QP(
            np.zeros((2, 2)), np.array([-1.0, -2.0]), np.vstack([np.ones(2), np.eye(2)]),
            np.array([-bound, 0.0, 0.0]), np.array([1.0, bound, bound]),
        )  # fmt: skip
        found = solution(qp, 1e-8)
        assert found.status == jm.Status.SOLVED
        np.testing.assert_allclose(found.z, [0.0, 1.0], atol=1e-8)

    @pytest.mark.parametrize("s", [1e-3, 1e-5, 1e-7])
    def test_nearly_parallel_rows(self, x64, s):
        """min |z|²/2, x ± s y ≤ −1: both rows push with 1/2 at (−1, 0)."""
        A = np.array([[1.0, s], [1.0, -s]])
        qp = jm.QP(np.eye(2), np.zeros(2), A, np.full(2, -np.inf), -np.ones(2))
        found = solution(qp)
        assert found.status == jm.Status.SOLVED
        np.testing.assert_allclose(found.z, [-1.0, 0.0], atol=1e-7)

    def test_small_curvature_beside_a_large_cost(self, x64):
        """min ½p|z|² + q'z in a box: z = clip(−q/p), y = −q − pz, which is q but for its last
        digits."""
        q = np.array([-1.0, 0.5])
        pairs = [(p, s) for p in 10.0 ** np.arange(-10, 3) for s in 10.0 ** np.arange(-2, 7, 2)]
        found = solutions([replace(box(2), P=p * np.eye(2), q=s * q) for p, s in pairs])
        for (p, size), status, z in zip(pairs, found.status, found.z, strict=True):
            assert status == jm.Status.SOLVED, (p, size)
            np.testing.assert_allclose(z, np.clip(-size * q / p, -1, 1), atol=1e-9)

    @pytest.mark.slow
    def test_badly_scaled_linear_programs(self, x64):
        """Optimal vertices, drawn first; then variables and rows in units from 1e-3 to 1e3. Whether
        the last of them is solved depends on how the compiler rounds."""
        programs, answers = [], []
        for seed in range(30, 40):
            qp, z = badly_scaled(30, np.random.default_rng(seed))
            programs.append(qp)
            answers.append(z)
        found = jax.jit(jax.vmap(jm.solve_qp))(jax.tree.map(lambda *v: np.stack(v), *programs))
        solved = np.asarray(found.status) == jm.Status.SOLVED
        assert solved.sum() >= 9 and np.all(found.status[~solved] == jm.Status.ITERATION_LIMIT)
        cost = np.array([qp.q @ z for qp, z in zip(programs, answers, strict=True)])
        np.testing.assert_allclose(found.cost[solved], cost[solved], rtol=1e-6)

    @pytest.mark.parametrize("condition", [1e3, 1e6])
    @pytest.mark.slow
    def test_ill_conditioned_hessian_with_defaults(self, x64, condition):
        for seed in range(5):
            qp, *_ = constructed(8, seed)
            V = np.linalg.qr(np.random.default_rng(seed).standard_normal((8, 8)))[0]
            P = V * np.geomspace(1 / condition, 1, 8) @ V.T
            found = jm.solve_qp(replace(qp, P=(P + P.T) / 2))
            assert found.status == jm.Status.SOLVED


class TestSettings:
    @pytest.mark.slow
    def test_warm_start_at_the_solution_stays(self, x64):
        for seed in range(5):
            qp, z, y = constructed(8, seed)
            for start in ((z, y), solve(qp, FINE)):
                sol = solve(qp, jm.ADMM(iterations=2, newton_steps=0), warm_start=start)
                assert sol.status == jm.Status.SOLVED
                np.testing.assert_allclose(sol.z, z, atol=1e-6)

    @pytest.mark.slow
    def test_warm_start_helps(self, x64):
        qp, _, _ = constructed(8, 0)
        near = replace(qp, q=qp.q * 1.01)
        few = jm.ADMM(iterations=10, newton_steps=0)
        cold = solve(near, few)
        warm = solve(near, few, warm_start=solve(qp, FINE))
        assert warm.primal_residual + warm.dual_residual < cold.primal_residual + cold.dual_residual

    def test_warm_start_that_is_not_finite_counts_as_none(self, x64):
        qp, (z, y) = constructed(6, 0)[0], START
        none = jm.solve_qp(qp, FEW, START)
        assert np.abs(none.z).max() > 0.1
        for start in ((z + np.nan, y), (z, y + INF), (z + np.nan, y + INF)):
            np.testing.assert_array_equal(jm.solve_qp(qp, FEW, start).z, none.z)

    def test_warm_start_of_wrong_shape(self):
        qp, z, y = constructed(4, 0)
        with pytest.raises(ValueError, match="warm_start y"):
            jm.solve_qp(qp, warm_start=(z, y[:-1]))
        with pytest.raises(ValueError, match="warm_start z"):
            jm.solve_qp(qp, warm_start=(z[:-1], y))

    @pytest.mark.slow
    def test_rho_of_every_shape(self, x64):
        qp, z, _ = constructed(6, 4)
        m = len(qp.l)
        rng = np.random.default_rng(0)
        shapes = [(), (m,), (4, m), (4, 1)]
        for shape in shapes:
            rho = 10 ** rng.uniform(-0.7, 0.7, shape)
            for alpha in (1.0, 1.6):
                sol = solve(qp, jm.ADMM(iterations=2000, rho=rho, alpha=alpha, newton_steps=0))
                assert sol.status == jm.Status.SOLVED, (shape, sol.primal_residual)
                np.testing.assert_allclose(sol.z, z, atol=1e-5)

    @pytest.mark.slow
    def test_schedule_of_equal_stages_is_no_schedule(self, x64):
        qp, _, _ = constructed(6, 4)
        one = jm.solve_qp(qp, jm.ADMM(iterations=60, rho=2.0, newton_steps=0))
        four = jm.solve_qp(qp, jm.ADMM(iterations=60, rho=np.full((4, 1), 2.0), newton_steps=0))
        np.testing.assert_allclose(one.z, four.z, atol=1e-12)

    @pytest.mark.slow
    def test_refine_never_hurts(self, x64):
        for seed in range(10):
            qp, z, _ = constructed(8, seed)
            plain = solve(qp, jm.ADMM(iterations=30, newton_steps=0))
            better = solve(qp, jm.ADMM(iterations=30, newton_steps=30))
            assert np.abs(better.z - z).max() <= np.abs(plain.z - z).max() * (1 + 1e-6) + 1e-9

    @pytest.mark.slow
    def test_vmap_over_rho(self, x64):
        qp, z, _ = constructed(6, 4)
        solve = lambda rho: jm.solve_qp(qp, jm.ADMM(iterations=1000, rho=rho, newton_steps=0)).z
        answers = jax.vmap(solve)(jnp.array([0.3, 1.0, 3.0]))
        np.testing.assert_allclose(answers, np.tile(z, (3, 1)), atol=1e-5)

    @pytest.mark.slow
    def test_integers_are_numbers(self):
        sol = jm.solve_qp(jm.QP([[2, 0], [0, 2]], [-2, -6], [[1, 0], [0, 1]], [0, 0], [2, 2]))
        np.testing.assert_allclose(sol.z, [1, 2], atol=1e-4)


def weighted_sum(qp):
    sol = jm.solve_qp(qp, jm.ADMM(iterations=300, newton_steps=0))
    return jnp.sum(jnp.arange(1.0, sol.z.size + 1) * sol.z)


@jax.jit
@jax.value_and_grad
def along(t, qp, way):
    """The weighted sum at qp + t way, and its derivative in t in reverse mode."""
    return weighted_sum(jax.tree.map(lambda v, d: v + t * d, qp, way))


class TestGradients:
    """Gradients of both kinds against central differences, where the active set does not change."""

    @pytest.mark.slow
    def test_every_field(self, x64):
        qp, _, _ = constructed(4, 3)
        finite = lambda v: np.clip(v, -1e3, 1e3)
        qp = replace(qp, l=finite(qp.l), u=finite(qp.u))
        forward = jax.jit(lambda way: jax.jvp(weighted_sum, (qp,), (way,))[1])
        h = 1e-5
        for field in ("P", "q", "A", "l", "u"):
            direction = np.random.default_rng(0).standard_normal(getattr(qp, field).shape)
            if field == "P":
                direction = direction + direction.T
            if field in "lu":  # keep equalities what they are
                direction = direction * (qp.u - qp.l > 0)
            way = replace(jax.tree.map(np.zeros_like, qp), **{field: direction})
            numeric = (along(h, qp, way)[0] - along(-h, qp, way)[0]) / (2 * h)
            for found in (along(0.0, qp, way)[1], forward(way)):
                np.testing.assert_allclose(found, numeric, rtol=1e-5, atol=1e-7, err_msg=field)

    @pytest.mark.slow
    def test_rho(self, x64):
        """With few steps the answer depends on rho, and its gradient is that of the program."""
        qp, _, _ = constructed(4, 3)
        few = lambda rho: jnp.sum(
            jm.solve_qp(
                qp, jm.ADMM(iterations=7, rho=rho, newton_steps=0, differentiate="unrolled")
            ).z
            ** 2
        )
        h = 1e-6
        np.testing.assert_allclose(
            jax.grad(few)(0.7), (few(0.7 + h) - few(0.7 - h)) / (2 * h), rtol=1e-5
        )

    @pytest.mark.slow
    def test_through_refine(self, x64):
        """Gradients stay finite, and right, with the polish on."""
        qp, _, _ = constructed(4, 3)
        f = lambda q: jm.solve_qp(replace(qp, q=q), jm.ADMM(iterations=300)).z[0]
        gradient, h = jax.grad(f)(jnp.asarray(qp.q)), 1e-5
        numeric = [(f(qp.q + h * e) - f(qp.q - h * e)) / (2 * h) for e in np.eye(4)]
        np.testing.assert_allclose(gradient, numeric, rtol=1e-4, atol=1e-6)

    @pytest.mark.slow
    def test_free_rows_give_no_nan(self, x64):
        """One NaN in the gradient of any field were one in the derivative along all of them."""
        qp, _, _ = constructed(4, 3)  # has free and zero rows
        assert np.isfinite(along(0.0, qp, jax.tree.map(np.ones_like, qp))[1])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (dict(q=np.zeros((2, 1))), "q"),
        (dict(q=3.0), "q"),
        (dict(P=np.eye(3)), "P"),
        (dict(P=np.array([[1.0, 0.5], [0.0, 1.0]])), "symmetric"),
        (dict(P=-np.eye(2)), "positive semidefinite"),
        (dict(P=np.full((2, 2), np.nan)), "P"),
        (dict(q=np.array([np.nan, 0])), "q"),
        (dict(q=np.array([INF, 0])), "q"),
        (dict(A=np.eye(3)), "A"),
        (dict(A=np.ones(2)), "A"),
        (dict(A=np.full((2, 2), np.nan)), "A"),
        (dict(l=np.zeros(3)), "l"),
        (dict(u=np.zeros(1)), "u"),
        (dict(l=np.array([2.0, 0.0])), "row 0 has l = 2.0"),
        (dict(u=np.array([1.0, np.nan])), "row 1"),
    ],
)
def test_bad_data_raise(change, words):
    with pytest.raises(ValueError, match=words):
        jm.solve_qp(replace(box(2), **change))


class TestFixedCount:
    @pytest.mark.slow
    def test_solves_and_proves_as_the_default_does(self, x64):
        qp = constructed(5, 3)[0]
        empty = replace(qp, l=np.where(np.arange(13) == 0, 50.0, qp.l), u=np.full(13, 50.0))
        many = jax.tree.map(lambda *v: np.stack(v), qp, replace(qp, q=-qp.q), empty)
        for q in ({}, {"q": np.full((3, 5), np.nan)}):
            batch = replace(many, **q)
            early, all_of_them = (
                jax.jit(jax.vmap(lambda qp, s=s: jm.solve_qp(qp, s)))(batch)
                for s in (jm.ADMM(), jm.ADMM(newton_steps=30, fixed=True))
            )
            np.testing.assert_array_equal(early.status, all_of_them.status)
            np.testing.assert_allclose(early.z[:2], all_of_them.z[:2], atol=1e-8)

    def test_the_default_takes_150_steps(self, x64):
        """The 1,000 that a badly scaled linear program may need are not for every instance."""
        for solver in (jm.ADMM(fixed=True), jm.ADMM(differentiate="unrolled")):
            assert solver.most_newton_steps() == 150
            program = str(jax.make_jaxpr(lambda qp, s=solver: jm.solve_qp(qp, s).z)(box(2)))
            assert 150 <= max(map(int, re.findall(r" length=(\d+)", program))) <= 300


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (dict(iterations=-1), "iterations"),
        (dict(newton_steps=-1), "newton_steps"),
        (dict(rho=0.0), "rho"),
        (dict(rho=np.array([1.0, -1.0])), "rho"),
        (dict(rho=np.ones(5)), "rho"),
        (dict(rho=np.ones((2, 2, 2))), "rho"),
        (dict(rho=np.nan), "rho"),
        (dict(rho=np.ones((3, 1)), iterations=100), "iterations"),
        (dict(alpha=2.0), "alpha"),
        (dict(alpha=0.0), "alpha"),
    ],
)
def test_bad_settings_raise(settings, words):
    with pytest.raises(ValueError, match=words):
        jm.solve_qp(box(2), jm.ADMM(**settings))


def test_settings_and_programs_are_trees_with_any_leaves():
    """JAX puts None, integers and sentinels where arrays were."""
    for tree in (box(2), jm.ADMM(rho=1.0)):
        leaves, structure = jax.tree.flatten(tree)
        for filler in (None, 0, object()):
            jax.tree.unflatten(structure, [filler] * len(leaves))


class TestOneRowDoesNotExcuseAnother:
    """A tolerance for rounding belongs to the row whose terms are large, not to the rest."""

    @pytest.mark.long
    def test_contradiction_beside_a_large_row(self):
        f32 = lambda v: np.asarray(v, np.float32)
        rows = f32([[1, 0], [1, 0], [0, 1e5]])
        qp = jm.QP(f32(np.eye(2)), f32([0, 0]), rows, f32([1, -np.inf, 1e5]), f32([np.inf, 0, 1e5]))
        # A program of `test_status.py`, too.
        solver = jm.ADMM(iterations=100, newton_steps=0)
        assert jm.solve_qp(qp, solver).status == jm.Status.PRIMAL_INFEASIBLE

    @pytest.mark.slow
    def test_small_remainder_of_a_large_multiplier_proves_nothing(self):
        """-10 ≤ z ≤ 10 and z ≤ -1 is feasible; absorbing 1e-5 in 1000 loses it to rounding."""
        f32 = lambda v: np.asarray(v, np.float32)
        qp = jm.QP(f32([[1]]), f32([0]), f32([[1], [1]]), f32([-10, -np.inf]), f32([10, -1]))
        solver = jm.ADMM(iterations=0, newton_steps=0)
        start = f32([10]), f32([1000, 1e-5])
        assert jm.solve_qp(qp, solver, warm_start=start).status != jm.Status.PRIMAL_INFEASIBLE


class TestTolerances:
    def test_relative(self, x64):
        """One program, whose rough answer is solved to a rough tolerance."""
        qp = constructed(6, 5)[0]
        found = jm.solve_qp(qp, replace(FEW, eps=1e-15), START)
        worst = max(float(found.primal_residual), float(found.dual_residual), float(found.gap))
        assert 1e-12 < worst and found.status == jm.Status.ITERATION_LIMIT
        assert jm.solve_qp(qp, replace(FEW, eps=1.0), START).status == jm.Status.SOLVED

    @pytest.mark.slow
    def test_newton_reaches_rounding(self, x64):
        found = solve(constructed(6, 5)[0], jm.ADMM(eps=0.0))
        assert found.status == jm.Status.SOLVED and found.dual_residual < 1e-12

    @pytest.mark.parametrize("wrong", [{"eps": -1.0}, {"dtype": "int32"}])
    def test_bad_ones_are_refused(self, wrong):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            jm.solve_qp(constructed(6, 5)[0], jm.ADMM(**wrong))


@pytest.mark.slow
def test_plain_python_and_jit_answer_alike(x64):
    """A cost so small that z = 0 is within eps of the optimum, z = -1."""
    qp = jm.QP(np.zeros((1, 1)), np.array([1e-7]), np.eye(1), -np.ones(1), np.ones(1))
    plain, jitted = jm.solve_qp(qp), jax.jit(jm.solve_qp)(qp)
    np.testing.assert_allclose(plain.z, -1, atol=1e-9)
    np.testing.assert_allclose(plain.z, jitted.z)
