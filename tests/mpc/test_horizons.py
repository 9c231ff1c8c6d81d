"""Problems of different horizons in one batch: plans beside those of each problem alone."""

from dataclasses import replace

import jax
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.mpc import pad_horizon, solve_stagewise, stack_horizons
from jaxmpc.mpc.condense import condense

SYSTEM = jm.LinearSystem([[1.1, 0.2], [0.0, 1.05]], [[0.02], [0.2]], [0.0, 0.01])
HORIZONS = (3, 5, 8)
X0 = np.array([[0.5, -0.2], [0.6, 0.1], [-0.7, 0.2]])


pytestmark = pytest.mark.usefixtures("x64_of_module")


def problem(horizon, **fields):
    given = {
        "states": jm.Box([-1.0, -0.5], [0.8, 0.6]), "inputs": jm.Box(-1.0, 1.0),
        "terminal_cost": 3 * np.eye(2), "terminal_set": jm.Box(-0.9, 0.9),
        "input_rate_weight": 0.1, "input_rate_limit": 0.8,
        "soft": jm.Soft([[1.0, 1.0]], upper=[0.3], rho=2.0, quadratic=1.0),
        "outputs": jm.Outputs([[0.0, 1.0]], upper=[0.5], stages=(1, horizon)),
    }  # fmt: skip
    return jm.MPC(SYSTEM, np.diag([1.0, 0.2]), 0.1, horizon, **{**given, **fields})


@pytest.mark.slow
@pytest.mark.parametrize("solve", [jm.solve, solve_stagewise])
def test_a_batch_of_horizons_has_the_plans_of_each_alone(solve):
    problems = [problem(N) for N in HORIZONS]
    plans = jax.vmap(lambda p, x: solve(p, x, previous_input=[0.2]))(stack_horizons(problems), X0)
    assert np.all(plans.solved)
    for i, mpc in enumerate(problems):
        alone = solve(mpc, X0[i], previous_input=[0.2])
        N = mpc.horizon
        np.testing.assert_allclose(plans.inputs[i, :N], alone.inputs, atol=1e-12)
        np.testing.assert_allclose(plans.states[i, : N + 1], alone.states, atol=1e-12)
        np.testing.assert_allclose(plans.inputs[i, N:], 0, atol=1e-12)
        # (Slopes of the cost, of soft rows for one, multiply what inputs are off.)
        np.testing.assert_allclose(plans.cost[i], alone.cost, rtol=1e-10)


@pytest.mark.parametrize("blocks", [None, pytest.param((1, 2), marks=pytest.mark.slow)])
def test_the_padded_program_is_the_same_in_the_moves_of_the_problem(blocks):
    """Hessian, linear terms and rows with a limit, without any solver."""
    mpc = problem(3, control_horizon=blocks)
    a, b = condense(mpc), condense(pad_horizon(mpc, 6))
    nz = a.P.shape[0]
    np.testing.assert_allclose(b.P[:nz, :nz], a.P, atol=1e-13)
    np.testing.assert_array_equal(b.P[:nz, nz:], 0)
    assert np.all(np.linalg.eigvalsh(b.P) > 0)
    np.testing.assert_allclose(b.F[:nz], a.F, atol=1e-13)
    np.testing.assert_array_equal(b.F[nz:], 0)
    np.testing.assert_allclose(b.f[:nz], a.f, atol=1e-13)
    limits = lambda c: np.isfinite(c.lower) | np.isfinite(c.upper)
    rows = lambda c: np.column_stack(
        [c.C[:, :nz], c.D, c.d, np.nan_to_num(c.lower, neginf=-9), np.nan_to_num(c.upper, posinf=9)]
    )[limits(c)]
    np.testing.assert_allclose(rows(b), rows(a), atol=1e-13)
    assert not np.any(b.C[limits(b), nz:])


def test_wrong_problems_are_named():
    with pytest.raises(ValueError, match="horizon: 2. Give a whole number of at least 3"):
        pad_horizon(problem(3), 2)
    other = replace(problem(4), outputs=(), input_rate_weight=None)
    with pytest.raises(ValueError, match=r"problems\[1\]: has other sizes, limits or settings"):
        stack_horizons([problem(3), other])
    with pytest.raises(ValueError, match="problems: is a list without problems"):
        stack_horizons([])
    robust = jm.MPC(SYSTEM, np.eye(2), 1.0, 3, jm.Box(-1, 1), disturbance=jm.Box(-0.1, 0.1))
    with pytest.raises(ValueError, match="mpc.disturbance: given"):
        pad_horizon(robust, 5)


ONE_STEP = {
    "terminal set": {"terminal_set": jm.Box([-0.5, -0.5], [0.5, 0.5])},
    "states that hold at no stage": {},
    "outputs": {"outputs": jm.Outputs(np.eye(2), [-1.0, -1.0], [1.0, 1.0])},
    "soft rows": {"soft": jm.Soft(np.eye(2), [-1.0, -1.0], [1.0, 1.0], rho=10.0)},
    "a rate": {"input_rate_limit": 0.5},
}


@pytest.mark.long
@pytest.mark.first(1)
@pytest.mark.parametrize("name", ONE_STEP)
@pytest.mark.parametrize("solve", [solve_stagewise, jm.solve])
def test_horizons_of_one_step(name, solve):
    """Inputs that nothing but their own weight moves are zero, and a block of rows may be empty."""
    system = jm.LinearSystem([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]], dt=0.1)
    limits = {"states": jm.Box([-1.0, -1.0], [1.0, 1.0]), "inputs": jm.Box(-1, 1)}
    given = {**limits, "constrain_initial": False, **ONE_STEP[name]}
    mpc = jm.MPC(system, np.eye(2), 1.0, 1, **given)
    plan = solve(mpc, np.array([0.3, 0.2]))
    assert plan.status == jm.Status.SOLVED and abs(plan.inputs).max() < 1e-9
    jax.eval_shape(lambda x: jm.solve(mpc, x), np.array([0.3, 0.2]))


SKEWED = jm.LinearSystem([[0.618, -0.889], [-0.048, 0.353]], [[0.654], [1.497]])


@pytest.mark.parametrize("states", [None, jm.Box([-np.inf, -1.0], [1.0, 1.5])])
@pytest.mark.parametrize("policy", ["affine", "tube"])
def test_policies_of_unbounded_sets_have_no_map(policy, states):
    """No ray ends, or no half-space holds on the whole set: one limit leaves a ray's end free."""
    few = {"inputs": jm.Box(-1, 1), "disturbance": jm.Box([0.0, -0.1], [0.0, 0.1])}
    mpc = jm.MPC(SKEWED, np.eye(2), 1.0, 2, states, policy=policy, constrain_initial=False, **few)
    with pytest.raises(ValueError, match="flat or unbounded: no hull of policies"):
        jm.map_feasible_set(mpc, np.zeros((2, 2)))
    plain = replace(mpc, policy="tightened")  # the cure
    assert jm.map_feasible_set(plain, np.zeros((2, 2))).label.tolist() == [1, 1]


@pytest.mark.long
def test_constant_forecasts_are_of_the_steps_of_the_problem():
    """Not of those that are added, also where nothing can be read."""
    mpc = problem(3, outputs=(), soft=())
    x, push = X0[0], np.array([0.03, -0.02])
    alone = jm.solve(mpc, x, forecast=push, previous_input=[0.2])
    padded = pad_horizon(mpc, 5)
    traced = jax.jit(lambda p, w: jm.solve(p, x, forecast=w, previous_input=[0.2]))
    rows = np.vstack([np.tile(push, (3, 1)), np.zeros((2, 2))])
    for plan in (
        jm.solve(padded, x, forecast=push, previous_input=[0.2]),
        traced(padded, push),
        traced(padded, rows),
    ):
        assert plan.solved
        np.testing.assert_allclose(plan.cost, alone.cost, rtol=1e-9)
        np.testing.assert_allclose(plan.inputs[:3], alone.inputs, atol=1e-7)


def test_steps_that_wait_are_no_padding():
    """A step that does nothing between others has a constant forecast; float32 stays float32."""
    A = np.stack([np.eye(2), [[1, 0.2], [0, 1]], np.eye(2), [[1, 0.2], [0, 1]]])
    B = np.array([[0, 0], [0.02, 0.2], [0, 0], [0.02, 0.2]])[:, :, None]
    Q = np.stack([np.zeros((2, 2)), np.eye(2)] * 2)
    mpc = jm.MPC(jm.LinearSystem(A, B), Q, 0.1, 4, terminal_cost=np.eye(2), inputs=jm.Box(-1, 1))
    push = np.array([0.03, -0.02])
    plans = [jm.solve(mpc, [0.5, 0.1], forecast=w) for w in (push, np.tile(push, (4, 1)))]
    np.testing.assert_allclose(plans[0].states, plans[1].states, atol=1e-9)


def test_padding_keeps_the_gain_of_known_dynamics_where_weights_are_traced():
    mpc = jm.MPC(
        jm.LinearSystem([[1.6, 0.3], [0.0, 1.4]], [[0.1], [0.5]]), np.eye(2), np.eye(1), 6,
        jm.Box([-1, -1], [1, 1]), jm.Box([-1], [1]),
    )  # fmt: skip
    known = []

    def padded(Q):
        found = pad_horizon(replace(mpc, Q=Q), 9)
        known.append((found.system.A, found.prestabilise))
        return found

    wanted, found = padded(mpc.Q), jax.jit(padded)(mpc.Q)
    for name in ("Q", "R"):
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name))
    (A, K), (traced_A, traced_K) = known
    np.testing.assert_array_equal(traced_A, A)
    np.testing.assert_array_equal(traced_K, K)
    assert np.any(K)
