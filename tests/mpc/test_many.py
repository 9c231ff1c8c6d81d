"""solve_many: the best plans, which are those of `solve`, for every state, whatever the chunk."""

import jax
import numpy as np
import problems
import pytest

import jaxmpc as jm
from jaxmpc.batches import program_size
from jaxmpc.mpc.many import Batch
from jaxmpc.mpc.plan import Aim

pytestmark = pytest.mark.usefixtures("as_of_many")


@pytest.fixture(scope="module")
def states():
    return jm.grid([-1.6, -2.1], [1.6, 2.1], (20, 20))


@pytest.fixture(scope="module", params=["float32", pytest.param("float64", marks=pytest.mark.slow)])
def plans(request, states):
    # A program of `test_reuse.py`, too.
    return jm.solve_many(problems.joint_o_inf(10), states, dtype=request.param, chunk=64)


@pytest.mark.slow
def test_status_agrees_with_the_proved_labels(plans, states):
    label = jm.map_feasible_set(problems.joint_o_inf(10), states).label
    np.testing.assert_array_equal(plans.status == jm.Status.SOLVED, label == 1)
    np.testing.assert_array_equal(plans.status == jm.Status.PRIMAL_INFEASIBLE, label == -1)


@pytest.mark.slow
def test_residuals_and_limits(plans):
    solved = plans.status == jm.Status.SOLVED
    for residual in (plans.primal_residual, plans.dual_residual, plans.gap):
        assert residual[solved].max() <= 1e-6 + 1e-9
    assert np.abs(plans.inputs[solved]).max() <= 2 + 1e-6


@pytest.mark.long
def test_plans_are_the_best(plans, states):
    """By non-negative least squares."""
    mpc = problems.joint_o_inf(10)
    some = np.flatnonzero(plans.status == jm.Status.SOLVED)[::11]
    assert len(some) >= 10
    for i in some:
        inputs = problems.least_distance(mpc, states[i])
        np.testing.assert_allclose(plans.inputs[i], inputs, atol=1e-5)
        x, cost = states[i], 0.0
        for u in inputs:
            cost += x @ mpc.Q @ x + u @ mpc.R @ u
            x = mpc.system.A @ x + mpc.system.B @ u
        cost += x @ mpc.terminal_cost @ x
        np.testing.assert_allclose(plans.cost[i], cost, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_plans_are_those_of_solve(plans, states):
    mpc = problems.joint_o_inf(10)
    some = np.flatnonzero(plans.status == jm.Status.SOLVED)[::11]
    with jax.enable_x64(True):
        solver = jm.ADMM(iterations=1000, newton_steps=20)
        one = jax.vmap(lambda x: jm.solve(mpc, x, solver=solver))(states[some])
    np.testing.assert_allclose(plans.inputs[some], one.inputs, atol=1e-5)
    np.testing.assert_allclose(plans.cost[some], one.cost, rtol=1e-6, atol=1e-6)


@pytest.mark.long
def test_a_state_with_nan_is_marked_and_changes_nothing_else(states):
    mpc = problems.joint_o_inf(10)
    clean = jm.solve_many(mpc, states[:200], chunk=64)  # the program of `plans`
    spoilt = states[:200].copy()
    spoilt[7] = np.nan
    dirty = jm.solve_many(mpc, spoilt, chunk=64)
    others = np.arange(200) != 7
    assert dirty.status[7] == jm.Status.NON_FINITE
    assert np.isnan(dirty.inputs[7]).all() and np.isnan(dirty.cost[7])
    np.testing.assert_array_equal(clean.inputs[others], dirty.inputs[others])
    np.testing.assert_array_equal(clean.status[others], dirty.status[others])


def test_no_states_and_wrong_shapes():
    mpc = problems.joint_o_inf(10)
    empty = jm.solve_many(mpc, np.zeros((0, 2)))
    assert empty.inputs.shape == (0, 10, 1) and empty.status.shape == (0,)
    with pytest.raises(ValueError, match="x0s"):
        jm.solve_many(mpc, np.zeros(2))
    with pytest.raises(ValueError, match="dtype"):
        jm.solve_many(mpc, np.zeros((1, 2)), dtype="int32")
    with pytest.raises(ValueError, match="chunk"):
        jm.solve_many(mpc, np.zeros((1, 2)), chunk=0)


def test_solved_and_sentence():
    """Of one plan, and of many: one truth value each, and a print of a few lines."""
    mpc = problems.joint_o_inf(10)
    some = np.resize([[0.1, 0.0], [1.6, 2.1], [0.0, 0.0]], (200, 2))
    plans = jm.solve_many(mpc, some, chunk=64)  # the program of `plans`
    np.testing.assert_array_equal(plans.solved, np.resize([True, False, True], 200))
    plan = jax.tree.map(lambda v: v[0], plans)
    assert plan.solved and plan.sentence == jm.Status.SOLVED.sentence
    with pytest.raises(ValueError, match="sentence: of"):
        print(plans.sentence)
    for text in (repr(plan), repr(plans), repr(jm.Controller(mpc)), repr(mpc)):
        assert len(text.splitlines()) < 12 and len(text) < 1000
    seen = []
    jax.eval_shape(lambda x: seen.append(repr(jm.solve(mpc, x))), np.zeros(2))
    assert "traced" in seen[0]


def test_plans_that_stay_on_the_device_are_those_on_the_host(states):
    mpc = problems.joint_o_inf(10)
    for count in (64, 120):  # one chunk, and two of which the last is not full
        some = states[150 : 150 + count]
        host = jm.solve_many(mpc, some, chunk=64)
        there = jm.solve_many(mpc, some, chunk=64, to_host=False)
        assert there.inputs.dtype == np.float64 and isinstance(there.inputs, jax.Array)
        jax.tree.map(np.testing.assert_array_equal, host, there)


def test_any_numbers_of_states_need_few_programs():
    """Compiling one takes seconds, so counts of states are filled up, small ones to at most twice
    as many and others by at most an eighth."""
    counts = np.arange(1, 8193)
    sizes = np.array([program_size(int(count)) for count in counts])
    assert len(set(sizes)) == 5 + 6 * 8 and np.all(sizes >= counts)
    assert np.all(sizes <= np.where(counts < 128, np.maximum(2 * counts, 8), 1.125 * counts))
    with jax.enable_x64(True):
        controller = jm.Controller(problems.joint_o_inf(3))
    made = lambda count, **given: Batch(controller, Aim(None), np.zeros((count, 2)), **given).chunk
    on_host = {"chunk": None, "to_host": True, "devices": None}
    assert len({made(count, **on_host) for count in range(1, 300)}) <= 15
    assert made(7000, **on_host | {"chunk": 100}) == 100
