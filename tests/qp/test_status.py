"""A status is true whatever the units are, and a bad instance spoils nobody else's derivative."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from padded import solutions

import jaxmpc as jm
from jaxmpc.qp.residuals import Pair

INF = np.inf
PRECISIONS = pytest.mark.parametrize("x64", [False, True], ids=["float32", "float64"])
solve = jax.jit(jax.vmap(jm.solve_qp))
N, M = 6, 12
COUNT = 150  # programs in a batch


def batch(programs, dtype):
    """One QP whose fields have a leading axis."""
    return jm.QP(*(jnp.asarray(np.stack(part), dtype) for part in zip(*programs, strict=True)))


def bounded(rng):
    """Feasible, with N independent rows bounded on both sides: neither empty nor unbounded."""
    factor, A = rng.normal(size=(rng.integers(0, N), N)), rng.normal(size=(M, N))
    value = A @ rng.normal(size=N)
    l, u = value - rng.uniform(0, 1, M), value + rng.uniform(0, 1, M)
    single, above = np.arange(M) >= N, rng.random(M) < 0.5
    l, u = np.where(single & above, -INF, l), np.where(single & ~above, INF, u)
    return factor.T @ factor, rng.normal(size=N), A, l, u


def unbounded(rng):
    """Feasible, and the cost falls along a direction d without curvature that no row stops."""
    d = rng.normal(size=N)
    across = lambda M: M - np.outer(M @ d, d) / (d @ d)
    factor = across(rng.normal(size=(rng.integers(0, N), N)))
    A, count = rng.normal(size=(M, N)), rng.integers(0, M // 3)
    A[:count] = across(A[:count])
    value, slope = A @ rng.normal(size=N), A @ d
    l, u = value - rng.uniform(0.1, 1, M), value + rng.uniform(0.1, 1, M)
    free = np.arange(M) >= count
    l, u = np.where(free & (slope < 0), -INF, l), np.where(free & (slope > 0), INF, u)
    q = rng.normal(size=N)
    return factor.T @ factor, q - d * (q @ d + 1) / (d @ d), A, l, u


def empty(rng):
    """Two of the rows contradict each other."""
    P, q, A, l, u = bounded(rng)
    A[1], l[0], u[0], l[1], u[1] = A[0], 1.0, 2.0, -2.0, -1.0
    return P, q, A, l, u


def rescaled(program, rng, decades):
    """The program in other units: variables and rows multiplied by 10^±decades/2."""
    P, q, A, l, u = program
    unit, row = (10.0 ** rng.uniform(-decades / 2, decades / 2, k) for k in (N, M))
    return P * unit * unit[:, None], q * unit, row[:, None] * A * unit, row * l, row * u


def off_optimal(program, z, y):
    """The largest residual of the conditions of optimality of a program rounded to float32, each
    relative to the sum of its absolute terms."""
    P, q, A, l, u = (np.asarray(np.float32(part), float) for part in program)
    v, size = A @ z, np.abs(A) @ np.abs(z)
    gradient = P @ z + q + A.T @ y
    terms = np.abs(P) @ np.abs(z) + np.abs(q) + np.abs(A).T @ np.abs(y)
    ends = np.where(y > 0, u, np.where(y < 0, l, v))  # a row with a multiplier is at its bound
    apart = np.abs(v - ends) * np.abs(y) / (np.abs(z) @ terms)
    return max(
        np.max(np.maximum(l - v, v - u) / size), np.max(np.abs(gradient) / terms), np.max(apart)
    )


@PRECISIONS
@pytest.mark.parametrize("decades", [12, 0, 4])
@pytest.mark.parametrize("make", [bounded, unbounded, empty])
@pytest.mark.slow
def test_no_false_status_in_any_units(make, decades, x64):
    """What is not decided may stay so; what is said must be true."""
    allowed = {
        bounded: (jm.Status.SOLVED,),
        unbounded: (jm.Status.DUAL_INFEASIBLE,),
        empty: (jm.Status.PRIMAL_INFEASIBLE,),
    }[make]
    if make is empty and decades == 12:  # rows of 1e-6 contradict each other by less than eps
        allowed = (*allowed, jm.Status.SOLVED)
    rng = np.random.default_rng(7)
    with jax.enable_x64(x64):
        qps = [rescaled(make(rng), rng, decades) for _ in range(COUNT)]
        found = solve(batch(qps, float if x64 else np.float32))
    status = np.asarray(found.status)
    if make is unbounded and not x64:
        # Data rounded to float32 have a curvature of 1e-8 along d: some programs have a solution.
        for i in np.flatnonzero(status == jm.Status.SOLVED):
            assert (
                off_optimal(qps[i], *(np.asarray(v[i], float) for v in (found.z, found.y))) < 1e-5
            )
        allowed = (*allowed, jm.Status.SOLVED)
    assert set(status) <= {*allowed, jm.Status.ITERATION_LIMIT, jm.Status.INACCURATE}
    if x64 and decades < 12:
        assert np.mean(np.isin(status, allowed)) >= 0.95


@pytest.mark.long
@pytest.mark.parametrize(("x64", "least"), [(True, (1e-10, 1e-13)), (False, (1e-5, 1e-6, 1e-9))])
@pytest.mark.first(1)
def test_a_small_coefficient_still_bounds(x64, least):
    """min ½ z₂² − z₁ with least·z₁ ≤ 1: the optimum lies at 1/least, it is not at infinity."""
    programs = [
        jm.QP(np.diag([0.0, 1]), np.array([-1.0, 0]), np.array([[small, 0], [1, 1]]),
              np.array([-INF, -1]), np.array([1, INF]))
        for small in least
    ]  # fmt: skip
    status = solutions(programs, dtype=float if x64 else np.float32).status
    undecided = jm.Status.ITERATION_LIMIT, jm.Status.INACCURATE
    assert np.isin(status, [jm.Status.SOLVED, *undecided]).all()


@PRECISIONS
@pytest.mark.slow
def test_negative_curvature_has_a_status(x64):
    """Indefinite but for rounding; whatever stands on the diagonal, and in whatever units."""
    rng = np.random.default_rng(3)
    factor = rng.normal(size=(3, 6))
    singular = factor.T @ factor
    negative = singular - 1e-3 * np.eye(6)
    units = 10.0 ** np.linspace(-3, 3, 6)
    small = np.eye(6)
    small[5, 5] = -3e-7
    crossed = np.zeros((6, 6))
    crossed[0, 1] = crossed[1, 0] = 1.0
    P = [singular, singular * units * units[:, None], np.zeros((6, 6)), np.eye(6), negative,
         negative * units * units[:, None], small, crossed]  # fmt: skip
    box, rows = 1e4 * np.ones(M), np.tile(np.eye(N), (M // N, 1))
    programs = [(p, np.full(N, value), rows, -box, box) for p in P for value in (0.1, 1.0)]
    with jax.enable_x64(x64):
        # As many as in `test_no_false_status_in_any_units`, whose program this is.
        many = [programs[i % len(programs)] for i in range(COUNT)]
        sol = solve(batch(many, float if x64 else np.float32))
    bad = np.asarray(sol.status[: len(programs)]) == jm.Status.NON_CONVEX
    np.testing.assert_array_equal(bad, [False] * 8 + [True] * 8)
    assert np.isnan(sol.z[8:16]).all() and np.isnan(sol.cost[8:16]).all()
    assert "negative eigenvalue" in jm.Status(int(sol.status[8])).sentence


@pytest.mark.slow
def test_an_overflow_has_a_status():
    """Finite numbers whose squares are not: their neighbours are solved."""
    A = np.stack([np.eye(2), 1e30 * np.eye(2)]).astype(np.float32)
    qp = jm.QP(P=jnp.eye(2), q=jnp.ones(2), A=jnp.asarray(A), l=-jnp.ones(2), u=jnp.ones(2))
    axes = jm.QP(P=None, q=None, A=0, l=None, u=None)
    status = jax.jit(jax.vmap(jm.solve_qp, in_axes=(axes,)))(qp).status
    assert status[0] == jm.Status.SOLVED and status[1] != jm.Status.PRIMAL_INFEASIBLE


@PRECISIONS
@pytest.mark.parametrize("mode", [jax.grad, pytest.param(jax.jacfwd, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_a_bad_program_leaves_the_shared_gradient(mode, x64):
    """Of a parameter that an indefinite and a NaN program share with two good ones."""
    kinds = np.stack([np.eye(2), np.diag([1.0, -1.0]), np.full((2, 2), np.nan), 2 * np.eye(2)])

    def loss(t, P):
        one = jnp.ones(2)
        P = P + (t - 1) * jnp.eye(2)
        qp = jm.QP(P=P, q=jnp.array([1.0, -3.0]) * t, A=jnp.eye(2) * t, l=-one, u=one * t)
        sol = jm.solve_qp(qp)
        return jnp.where(sol.status == jm.Status.SOLVED, jnp.sum(sol.z) + sol.cost, 0.0)

    with jax.enable_x64(x64):
        total = lambda t, P: jnp.sum(jax.vmap(loss, in_axes=(None, 0))(t, jnp.asarray(P)))
        gradient = jax.jit(mode(total))
        # The good ones twice: one shape, one program.
        everyone, good = (float(gradient(1.0, P)) for P in (kinds, kinds[[0, 3, 0, 3]]))
    assert np.isfinite(good) and good != 0
    np.testing.assert_allclose(everyone, good / 2, rtol=1e-5)


@pytest.mark.parametrize("stagewise", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_a_bad_plan_leaves_the_shared_gradient(stagewise):
    """Of the dynamics, which a plan with indefinite Q, with NaN in Q and one from NaN share."""
    A, B = jnp.array([[1.0, 0.1], [0.0, 1.0]]), jnp.array([[0.0], [0.1]])
    limit = jm.Box(-np.ones(1), np.ones(1))

    def plan(a, weight, x):
        system = jm.LinearSystem(A * a, B * a)
        mpc = jm.MPC(system, Q=jnp.eye(2) * weight, R=np.eye(1), horizon=5, inputs=limit)
        return jm.mpc.solve_stagewise(mpc, x) if stagewise else jm.solve(mpc, x)

    def loss(a, weights, x):
        plans = jax.vmap(plan, in_axes=(None, 0, 0))(a, weights, x)
        solved = plans.status == jm.Status.SOLVED
        states = jnp.where(solved[:, None, None], plans.states, 0.0)
        return jnp.sum(jnp.where(solved, plans.cost, 0.0)) + jnp.sum(states), plans.status

    weights = np.array([1.0, -500.0, 1.0, np.nan, 2.0, 1.0])
    x = np.array([[1.0, 0], [1, 0], [np.nan, 0], [1, 0], [2, 0], [0.5, 0]])
    gradient = jax.jit(jax.grad(loss, has_aux=True))
    everyone, status = gradient(1.0, weights, x)
    np.testing.assert_array_equal(status, [1, 9, 12, 12, 1, 1])
    twice = np.array([0, 4, 5] * 2)  # one shape, one program
    good, _ = gradient(1.0, weights[twice], x[twice])
    assert np.isfinite(good) and good != 0
    np.testing.assert_allclose(everyone, good / 2, rtol=1e-4)


def test_the_mpc_of_an_indefinite_weight_is_refused_where_it_can_be_read():
    mpc = jm.MPC(jm.LinearSystem(np.eye(1), np.eye(1)), np.eye(1), np.eye(1), 3)
    with pytest.raises(ValueError, match="Q: .*not positive semidefinite"):
        jm.solve(replace(mpc, Q=-np.eye(1)), [0.0])


def test_a_pair_near_the_solution_is_not_lost():
    """Residuals are compared with the size of sums, whose terms, where they cancel, can hide an
    error that is too large (a quadrotor's plan ended so, with a gap of 1.4e-6)."""
    with jax.enable_x64(True):
        eps, none = np.array(1e-6), np.zeros(1)
        part = lambda value, terms: (np.array([value]), np.ones(1), np.array([terms]))
        judge = lambda values, sizes: Pair.of(
            none, none, list(map(part, values, sizes)), eps, 1e-14
        )
        best, other = (
            judge([0.0, 0.0, 1e-12], [1.0, 1.0, 1.0]),
            judge([0.0, 2e-6, 0.0], [1, 1e6, 1]),
        )
        assert best.near and not other.near and other.error > best.error
        assert best.or_better(other).error == best.error


def test_steps_of_admm_that_move_nothing_are_inaccurate():
    """In float32 the rounding of a multiplier of 2^16 is 2^-8: more steps, as ITERATION_LIMIT
    advises, would be in vain."""
    f32 = lambda *v: np.array(v, np.float32)
    none = f32(np.inf, np.inf)
    qp = jm.QP(
        np.eye(2, dtype=np.float32), f32(-1e5 / 3, 0), np.eye(3, 2, dtype=np.float32),
        f32(-1, *-none), f32(1 / 3, *none),
    )  # fmt: skip
    solver = jm.ADMM(iterations=100, newton_steps=0, eps=0.0)
    assert jm.Status(int(jm.solve_qp(qp, solver).status)).name == "INACCURATE"


def test_solutions_say_what_their_status_means():
    q = np.ones((48, 4))
    q[7] = np.nan
    qps = [jm.QP(np.eye(4), v, np.eye(6, 4), -np.ones(6), np.ones(6)) for v in q]
    many = solutions(qps)
    np.testing.assert_array_equal(many.solved, np.arange(48) != 7)
    assert "status=47 SOLVED + 1 NON_FINITE" in repr(many) and len(repr(many)) < 500
    with pytest.raises(ValueError, match="sentence: of 47 SOLVED"):
        _ = many.sentence
    assert jax.tree.map(lambda v: v[7], many).sentence == jm.Status.NON_FINITE.sentence
    one = jax.tree.map(lambda v: v[0], many)
    assert one.solved and one.sentence == jm.Status.SOLVED.sentence
    assert "status=SOLVED" in repr(one)
    with pytest.raises(ValueError, match="sentence: of traced int32"):
        jax.jit(lambda: jm.solve_qp(qps[0]).sentence)()
    assert jax.jit(lambda sol: sol.solved)(one)
