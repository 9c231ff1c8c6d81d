"""Disturbances known ahead, in plans: against least squares in NumPy, and stage by stage."""

from dataclasses import replace

import numpy as np
import pytest

import jaxmpc as jm

UNSTABLE = jm.LinearSystem([[1.1, 0.2], [0.0, 0.9]], [[0.1], [0.5]], [0.02, -0.01])
N = 6
RNG = np.random.default_rng(0)
FORECAST, R_X, R_U = RNG.normal(size=(N, 2)), RNG.normal(size=(N + 1, 2)), RNG.normal(size=(N, 1))
X0, U0 = np.array([0.4, -0.3]), np.array([0.2])
PLAIN = jm.MPC(UNSTABLE, np.diag([3.0, 1.0]), [[0.5]], N, terminal_cost=np.diag([9.0, 4.0]))


pytestmark = pytest.mark.usefixtures("x64")


def least_squares(mpc, moves):
    """The inputs of the unconstrained problem: each term of the cost is a square of what NumPy's
    own loop predicts, affine in the free moves."""

    def terms(free):
        u, x, found, last = free[moves][:, None], X0, [], U0
        for k in range(N):
            weight = 2.0 if mpc.stage_weights is not None and k == 2 else 1.0
            found += [np.sqrt(weight * np.array([3.0, 1.0])) * (x - R_X[k])]
            found += [np.sqrt(weight * 0.5) * (u[k] - R_U[k])]
            if mpc.input_rate_weight is not None:
                found += [np.sqrt(0.7) * (u[k] - last)]
            last = u[k]
            x = UNSTABLE.A @ x + UNSTABLE.B @ u[k] + UNSTABLE.c + FORECAST[k]
        return np.concatenate([*found, [3.0, 2.0] * (x - R_X[N])])

    free = max(moves) + 1
    base = terms(np.zeros(free))
    J = np.stack([terms(e) - base for e in np.eye(free)], axis=1)
    return np.linalg.lstsq(J, -base, rcond=None)[0][moves][:, None], base, J


RATED = {"input_rate_weight": [[0.7]], "prestabilise": [[-0.6, -0.9]]}


@pytest.mark.first(1)
@pytest.mark.parametrize(
    "fields",
    [
        RATED,
        {"input_rate_weight": [[0.7]], "control_horizon": (1, 2, 3)},
        {"stage_weights": np.array([1.0, 1.0, 2.0, 1.0, 1.0, 1.0])},
    ],
)
def test_least_squares(fields):
    mpc = replace(PLAIN, **fields)
    moves = [0, 1, 1, 2, 2, 2] if "control_horizon" in fields else list(range(N))
    want, base, J = least_squares(mpc, moves)
    given = dict(input_reference=R_U, forecast=FORECAST)
    if mpc.input_rate_weight is not None:
        given["previous_input"] = U0
    plan = jm.solve(mpc, X0, R_X, **given)
    assert plan.solved
    np.testing.assert_allclose(plan.inputs, want, atol=1e-9)
    residual = base + J @ np.linalg.lstsq(J, -base, rcond=None)[0]
    np.testing.assert_allclose(plan.cost, residual @ residual, rtol=1e-9)


@pytest.mark.slow
def test_limits_are_kept_under_the_forecast():
    """Active limits of states, outputs and inputs; the other transcription has c at each step."""
    mpc = replace(
        PLAIN,
        inputs=jm.Box([-1.0], [1.0]),
        states=jm.Box([-np.inf, -0.5], [np.inf, 0.5]),
        constrain_initial=False,
        outputs=jm.Outputs([[1.0, 1.0]], upper=[2.0], D=[[0.3]]),
    )
    few = 0.2 * FORECAST
    plan = jm.solve(mpc, X0, input_reference=R_U, forecast=few)
    varying = replace(UNSTABLE, c=UNSTABLE.c + few)
    want = jm.mpc.solve_stagewise(replace(mpc, system=varying), X0, input_reference=R_U)
    assert plan.solved and want.solved
    assert len(jm.mpc.active_constraints(mpc, plan)) > 3
    np.testing.assert_allclose(plan.inputs, want.inputs, atol=1e-7)
    np.testing.assert_allclose(plan.states, want.states, atol=1e-7)
    # One constant row is a drift.
    steady = jm.solve(mpc, X0, forecast=[0.03, -0.02])
    drift = replace(mpc, system=replace(UNSTABLE, c=[0.05, -0.03]))
    np.testing.assert_allclose(steady.inputs, jm.solve(drift, X0).inputs, atol=1e-9)


@pytest.mark.long
def test_bad_forecasts():
    with pytest.raises(ValueError, match=r"forecast: shape \(5, 2\). Give \(2,\) or \(6, 2\)"):
        jm.solve(PLAIN, X0, forecast=np.zeros((5, 2)))
    mpc, bad = replace(PLAIN, **RATED), FORECAST + [np.nan, 0.0]  # the program of the plan above
    plan = jm.solve(mpc, X0, R_X, input_reference=R_U, forecast=bad, previous_input=U0)
    assert plan.status == jm.Status.NON_FINITE
