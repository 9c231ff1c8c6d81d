"""Plans that follow the laws of solved neighbours: those of the solver, judged by themselves."""

from dataclasses import replace

import jax
import numpy as np
import problems
import pytest

import jaxmpc as jm
from jaxmpc.mpc import many
from jaxmpc.mpc.condense import in_float64
from jaxmpc.mpc.controller import Controller

COUNT = 1024
pytestmark = [pytest.mark.cpu, pytest.mark.usefixtures("as_of_many")]


@pytest.fixture
def few(monkeypatch):
    """Transfer among `COUNT` states, in small programs; returns what was run on how many."""
    monkeypatch.setattr(many, "MANY_STATES", COUNT)
    monkeypatch.setattr(many, "STATES_A_CELL", 16)
    run, log = many.Batch._run, []

    def logged(self, program, arguments, index):
        log.append((len(arguments), len(index)))
        run(self, program, arguments, index)

    monkeypatch.setattr(many.Batch, "_run", logged)
    return log


@pytest.fixture(scope="module")
def mpc():
    return problems.joint_o_inf(10)


@pytest.fixture(scope="module")
def states():
    """Two fifths of these are feasible."""
    return np.random.default_rng(0).uniform([-1.2, -2.1], [1.2, 2.1], (COUNT, 2))


@pytest.fixture(scope="module")
def solved(mpc, states):
    # A program of the tests below, and of `test_many.py`.
    return jm.solve_many(mpc, states, transfer=False, chunk=64)


def same_plans(found, expected, tolerance=1e-6):
    np.testing.assert_array_equal(found.status, expected.status)
    good = expected.status == jm.Status.SOLVED
    for name in ("inputs", "states", "cost"):
        pair = (np.asarray(getattr(v, name))[good] for v in (found, expected))
        np.testing.assert_allclose(*pair, rtol=tolerance, atol=tolerance)
    tolerance = max(tolerance, 1e-5)
    for pair in zip(*(jax.tree.leaves(v.multipliers) for v in (found, expected)), strict=True):
        np.testing.assert_allclose(*(v[good] for v in pair), rtol=tolerance, atol=tolerance)


def kkt_residual(mpc, x, plan):
    """Largest violation and largest entry of the gradient of the Lagrangian in the inputs, with
    the costates summed step by step in NumPy."""
    A, B = np.asarray(mpc.system.A), np.asarray(mpc.system.B)
    N, worst = mpc.horizon, 0.0
    X = np.empty((N + 1, len(x)))
    X[0] = x
    for k in range(N):
        X[k + 1] = A @ X[k] + B @ plan.inputs[k]
    y = np.zeros((N + 1, len(x)))
    y[list(mpc.state_stages)] = plan.multipliers.states
    H = np.asarray(mpc.terminal_set.rows()[0])
    p = 2 * np.asarray(mpc.terminal_cost) @ X[N] + y[N] + H.T @ plan.multipliers.terminal
    for k in reversed(range(N)):
        gradient = 2 * np.asarray(mpc.R) @ plan.inputs[k] + B.T @ p + plan.multipliers.inputs[k]
        worst = max(worst, np.abs(gradient).max())
        p = 2 * np.asarray(mpc.Q) @ X[k] + y[k] + A.T @ p
    limits = np.maximum(np.abs(X) - np.asarray(mpc.states.upper), 0)[list(mpc.state_stages)]
    return max(worst, limits.max(), np.abs(plan.inputs).max() - float(mpc.inputs.upper[0]))


@pytest.mark.slow
def test_plans_are_those_of_the_solver(mpc, states, solved, few):
    found = jm.solve_many(mpc, states)
    same_plans(found, solved)
    assert few[0][1] <= COUNT // 16  # the solved ones first
    infeasible = np.sum(solved.status == jm.Status.PRIMAL_INFEASIBLE)
    assert few[-1][0] == 2 and few[-1][1] <= infeasible + COUNT // 3
    good = np.flatnonzero(found.status == jm.Status.SOLVED)
    for i in good[:: len(good) // 40]:
        plan = jax.tree.map(lambda v, i=i: v[i], found)
        assert kkt_residual(mpc, states[i], plan) <= 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("chunk", [COUNT, 2 * COUNT])
def test_one_chunk_of_all_states(mpc, states, solved, few, chunk):
    same_plans(jm.solve_many(mpc, states, chunk=chunk), solved)


@pytest.mark.slow
def test_most_follow(mpc, states, solved, few):
    """More than half of the feasible states need no solver, in cells of 16 states each."""
    good = states[solved.status == jm.Status.SOLVED]
    many = np.concatenate([good] * 3)[:COUNT]
    jm.solve_many(mpc, many)
    assert few[-1][0] == 2 and few[-1][1] <= COUNT // 2


@pytest.mark.parametrize("tolerance", [1e-3, pytest.param(1e-9, marks=pytest.mark.slow)])
@pytest.mark.slow
def test_own_residuals_decide(mpc, states, few, tolerance):
    """The tolerance is relative: terms of rows are below 10 here, those of the gap the cost's."""
    found = jm.solve_many(mpc, states, jm.ADMM(eps=tolerance))
    good = found.status == jm.Status.SOLVED
    for residual in (found.primal_residual, found.dual_residual):
        assert residual[good].max() <= 10 * tolerance
    assert np.all(found.gap[good] <= tolerance * np.maximum(found.cost[good], 1))


@pytest.mark.long
def test_followed_plans_are_as_precise_as_solved_ones(mpc, states, few):
    """The solver ends far below its tolerance, and so must what follows: a law that is nearly
    right, as beside the border of its region, gives another plan within a loose tolerance."""
    solver = jm.ADMM(eps=1e-2)
    found = jm.solve_many(mpc, states, solver, chunk=64)
    assert few[1][0] == 4  # some followed
    expected = jm.solve_many(mpc, states, solver, transfer=False, chunk=64)
    same_plans(found, expected, 1e-4)  # of eps 1e-2; by the tolerance alone 0.2 were apart


@pytest.mark.slow
def test_a_wrong_law_is_no_plan(mpc, states, solved, few, monkeypatch):
    """Laws of other states: whatever they give, all plans are those of the solver."""
    monkeypatch.setattr(many.Cells, "nearest", lambda self, x: self.law[0])
    many._follow.cache_clear()
    found = jm.solve_many(mpc, states)
    many._follow.cache_clear()
    same_plans(found, solved)


@pytest.mark.slow
def test_states_that_are_not_finite_alike_or_far(mpc, states, solved, few):
    x = states.copy()
    x[::7] = x[0]
    x[3], x[5], x[9] = np.nan, np.inf, 1e9
    found = jm.solve_many(mpc, x)
    assert np.all(found.status[[3, 5]] == jm.Status.NON_FINITE)
    assert found.status[9] != jm.Status.SOLVED
    others = np.setdiff1d(np.flatnonzero(np.arange(COUNT) % 7), [3, 5, 9])
    take = lambda plans: jax.tree.map(lambda v: v[others], plans)
    same_plans(take(found), take(solved))
    alike = found.inputs[::7]
    np.testing.assert_allclose(alike, np.broadcast_to(alike[:1], alike.shape), atol=1e-6)


@pytest.mark.long
def test_all_states_alike(mpc, few):
    found = jm.solve_many(mpc, np.full((COUNT, 2), 0.3), chunk=64)
    assert np.all(found.status == jm.Status.SOLVED)
    np.testing.assert_allclose(found.inputs, found.inputs[:1].repeat(COUNT, 0), atol=1e-7)


@pytest.mark.long
def test_it_is_given_up_where_few_follow(mpc, states, solved, few, monkeypatch):
    monkeypatch.setattr(many, "TRIAL_CHUNKS", 1)
    monkeypatch.setattr(many, "LEAST_FOLLOWED", 1.1)
    same_plans(jm.solve_many(mpc, states, chunk=64), solved)
    assert [arguments for arguments, _ in few] == [2, 4, 2] and few[1][1] == 64


@pytest.mark.slow
def test_on_the_device_and_from_a_controller(mpc, states, solved, few):
    with jax.enable_x64(True):
        controller = Controller(in_float64(mpc))
        found = jm.solve_many(controller, jax.numpy.asarray(states), to_host=False)
    assert all(isinstance(v, jax.Array) for v in jax.tree.leaves(found))
    same_plans(found, solved)
    with pytest.raises(ValueError, match="a controller in float32"):
        jm.solve_many(Controller(mpc), states)


def test_problems_that_do_not_qualify(mpc):
    """Of as many inputs and rows as `mpc`, so that one factorization is compiled."""
    soft = jm.MPC(mpc.system, mpc.Q, mpc.R, 10, inputs=mpc.inputs,
                  soft=jm.Soft(np.ones((3, 2)), upper=np.ones(3), rho=10.0,
                               stages=tuple(range(1, 11))))  # fmt: skip
    wide = jm.MPC(jm.LinearSystem(0.5 * np.eye(5), np.ones((5, 1))), np.eye(5), np.eye(1), 10,
                  inputs=jm.Box(-1, 1),
                  outputs=jm.Outputs(np.ones((3, 5)), upper=np.ones(3)))  # fmt: skip
    with jax.enable_x64(True):
        assert many.transferable(Controller(in_float64(mpc)))
        for other in (soft, wide):
            assert not many.transferable(Controller(in_float64(other)))


@pytest.mark.slow
def test_rates_in_the_state(few):
    """The previous input is a coordinate, and counts in the cost."""
    base = problems.joint(6)
    mpc = jm.MPC(base.system, base.Q, base.R, 6, states=base.states, inputs=base.inputs,
                 input_rate_limit=0.7, input_rate_weight=np.array([[0.3]]))  # fmt: skip
    x = np.random.default_rng(1).uniform([-1, -1.5, -2], [1, 1.5, 2], (COUNT, 3))
    same_plans(jm.solve_many(mpc, x), jm.solve_many(mpc, x, transfer=False))
    assert any(arguments == 4 for arguments, _ in few)


@pytest.mark.long
@pytest.mark.first(1)
@pytest.mark.parametrize("rates", [True, False])
def test_references_of_all_plans(few, rates):
    """Solved and followed plans are those of `solve`, for a target and a trajectory."""
    mpc, random = problems.joint_o_inf(4), np.random.default_rng(0)
    r, s = np.array([0.6, 0.0]), random.uniform(-0.3, 0.3, (4, 1))
    if rates:
        mpc, r = replace(mpc, input_rate_weight=[0.3]), np.linspace(0, 0.9, 10).reshape(5, 2)
    x = random.uniform([-1, -1, -1], [1, 1, 1], (COUNT, 3))[:, : mpc.dimension]
    found = jm.solve_many(mpc, x, reference=r, input_reference=s, chunk=128)
    assert few[1][0] == 4  # some followed
    with jax.enable_x64(True):
        one = lambda x: jm.solve(
            mpc, x[:2], r, input_reference=s, previous_input=x[2:] if rates else None
        )
        some = jax.vmap(one)(x[:128])
    same_plans(jax.tree.map(lambda v: v[:128], found), jax.tree.map(np.asarray, some))
    with pytest.raises(ValueError, match="reference: shape"):
        jm.solve_many(mpc, x, reference=np.zeros(3))


def test_cells():
    """Each state follows a solved one of its cell or of those beside it."""
    x = np.random.default_rng(2).normal(size=(5000, 2))
    with jax.enable_x64(True):
        index, cells = many.choose(x)
        near = np.asarray(jax.jit(jax.vmap(cells.nearest))(x))
    assert len(np.unique(index)) == len(index)
    np.testing.assert_array_equal(np.asarray(cells.states)[: len(index)], x[index])
    distance = np.linalg.norm(x - x[index][near], axis=1)
    assert np.all(near < len(index)) and np.median(distance) < 0.5
    assert np.all(near[index] == np.arange(len(index)))


@pytest.mark.parametrize("order", ["grid", "repeated"])
def test_cells_of_states_in_order(order):
    """Equal distances between the states that are looked at would miss most of these cells."""
    x = jm.grid([-1, -1], [1, 1], (256, 256))
    if order == "repeated":
        x = np.tile(np.random.default_rng(0).permutation(x)[:4096], (16, 1))
    with jax.enable_x64(True):
        index, cells = many.choose(x)
    assert len(index) >= 0.9 * len(cells.law)
