"""The smoothed fraction of feasible states, its derivative, and the growth of feasible sets."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from exact import feasible_polygon
from problems import AREA_JOINT, AREA_JOINT_O_INF, O_INF_JOINT, P_JOINT, joint

import jaxmpc as jm
from jaxmpc.feasible.smooth_fraction import feasible_fraction, membership
from jaxmpc.systems.riccati import cost_of_law
from jaxmpc.tuning.feasible_set import tune_feasible_set
from jaxmpc.tuning.parameters import Parameter

MPC = joint(6)
STATES = np.random.default_rng(0).uniform([-1.5, -2], [1.5, 2], (200, 2))
STATES[:4] = [[np.nan, 0.0], [np.inf, 0.0], [1e300, 1.0], [0.0, 0.0]]


def changed(v) -> jm.MPC:
    """The joint with N = 6: level and P of its terminal ellipsoid, limits tightened, A moved."""
    tight = lambda box, t: jm.Box(box.lower * (1 - t / 2), box.upper * (1 - t))
    P = np.array(P_JOINT) + jnp.array([[v[1], v[2]], [v[2], v[3]]])
    return replace(
        MPC,
        states=tight(MPC.states, v[4]),
        inputs=tight(MPC.inputs, v[5]),
        terminal_set=jm.Ellipsoid(P, v[0]),
        system=replace(MPC.system, A=MPC.system.A + v[6] * np.array([[0.1, 0.02], [-0.01, 0.2]])),
    )


POINT = np.array([300.0, 0, 0, 0, 0.05, 0.1, 0])


@pytest.fixture(scope="module")
def fraction():
    """(fraction, its gradient, membership of each state) by the numbers of `changed`."""

    def both(v):
        values = membership(changed(v), STATES, 0.05)
        return jnp.mean(values), values

    program = jax.jit(jax.value_and_grad(both, has_aux=True))

    def evaluate(v):
        with jax.enable_x64(True):
            (value, each), gradient = program(jnp.asarray(v, float))
        return float(value), np.asarray(gradient), np.asarray(each)

    return evaluate


@pytest.mark.long
def test_gradient_by_central_differences(fraction):
    _, gradient, _ = fraction(POINT)
    for i, step in enumerate([1e-2, 1e-2, 1e-3, 1e-5, 1e-6, 1e-6, 1e-6]):
        move = step * np.eye(7)[i]
        expected = (fraction(POINT + move)[0] - fraction(POINT - move)[0]) / (2 * step)
        np.testing.assert_allclose(gradient[i], expected, rtol=1e-4, err_msg=str(i))


@pytest.mark.long
@jax.enable_x64(True)
def test_second_derivatives_by_central_differences():
    """The minimiser follows the data: as a constant it left Hessians that were off by 14 times."""
    rows = jm.LinearSystem([[1, 0.1], [0.2, 1]], [[0], [0.1]])
    mpc = jm.MPC(rows, [1.0, 1.0], [0.1], 5, states=jm.Box([-2, -2], [2, 2]))
    grid = np.random.default_rng(0).uniform(-2, 2, (40, 2))

    def value(w):
        A = jnp.asarray(rows.A) + 0.1 * w[1]
        most = 0.5 * jnp.exp(w[:1])
        other = replace(mpc, system=replace(rows, A=A), inputs=jm.Box(-most, most))
        return feasible_fraction(other, grid)

    slope, w = jax.jit(jax.grad(value)), jnp.array([0.1, 0.2])
    expected = [(slope(w + v) - slope(w - v)) / 2e-5 for v in 1e-5 * np.eye(2)]
    found = jax.jacfwd(jax.grad(value))(w)
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * np.abs(found).max())


@pytest.mark.long
def test_states_that_are_no_numbers_count_zero_and_spoil_nothing(fraction):
    value, gradient, each = fraction(POINT)
    np.testing.assert_array_equal(each[:4], [0, 0, 0, 1])
    assert np.isfinite(value) and np.isfinite(gradient).all()
    assert np.all((each >= 0) & (each <= 1))
    assert np.isnan(
        fraction([np.nan, *POINT[1:]])[0]
    )  # of the problem itself: descent takes it back


def test_larger_terminal_sets_never_lose_a_state(fraction):
    members = [fraction([level, *POINT[1:]])[2] for level in (1e-3, 30.0, 300.0, 3000.0)]
    assert np.all(np.diff(members, axis=0) >= -1e-9)
    assert np.all(np.diff(np.mean(members, axis=1)) > 0.01)


@pytest.mark.slow
def test_fraction_of_a_fine_grid_is_the_exact_area():
    """As the width goes to 0; the polygons are exact, their areas known in closed form."""
    cells = lambda k: (np.arange(k) + 0.5) / k * 2 - 1
    grid = np.stack(np.meshgrid(1.5 * cells(50), 2 * cells(50), indexing="ij"), -1).reshape(-1, 2)
    terminal = lambda factor: O_INF_JOINT.scale(factor)  # same shapes: compiled once
    for factor, area in ((1.0, AREA_JOINT_O_INF), (1e3, AREA_JOINT)):
        mpc = joint(terminal_set=terminal(factor))
        inside = feasible_polygon(mpc).contains(grid)
        with jax.enable_x64(True):
            wide, narrow = (np.asarray(membership(mpc, grid, w)) for w in (0.05, 1e-5))
        assert np.max(np.abs(narrow - inside)) < 1e-3
        assert np.max(wide[~inside]) <= 0.5
        assert abs(12 * narrow.mean() - area) < 0.02


def test_tightening_and_rows_that_no_input_moves():
    """One free state: x_0 of |x| ≤ 1 alone; its margin is known, and so is the membership."""
    still = jm.MPC(
        jm.LinearSystem([[0.5]], [[0.0]]),
        np.eye(1),
        np.eye(1),
        horizon=2,
        states=jm.Box([-1.0], [1.0]),
        inputs=jm.Box([-1.0], [1.0]),
    )
    x0s = np.array([0.0, 0.9, 0.95, 1.0, -1.1])[:, None]
    with jax.enable_x64(True):
        found = membership(still, x0s, 0.1)
    beyond = np.maximum(np.abs(x0s[:, 0]) - 0.9, 0)  # at k = 1 x is half as large
    np.testing.assert_allclose(found, 1 / (1 + (beyond / 0.1) ** 2), rtol=1e-12)
    soft = replace(still, soft=jm.Soft([[1.0]], upper=[0.1]), input_rate_weight=[1.0])
    with jax.enable_x64(True):  # what has no part in feasibility has none here
        assert float(feasible_fraction(soft, x0s, 0.1)) == float(found.mean())
    for arguments, message in (
        ((still, x0s[:, 0]), "x0s: shape"),
        ((still, x0s, 0.0), "width: 0.0"),
        ((still, x0s, 0.1, np.ones(3)), "scale: shape"),
    ):
        with pytest.raises(ValueError, match=message):
            membership(*arguments[:3], scale=arguments[3] if len(arguments) > 3 else None)


def terminal_law(v) -> jm.MPC:
    """The ellipsoid of the LQR of weights of its own, with the cost that this law has."""
    law = jm.lqr(MPC.system, v["Qt"], MPC.R)
    ellipsoid = jm.sets.invariant_ellipsoid(MPC.system, law.K, law.P, MPC.states, MPC.inputs)
    cost = cost_of_law(MPC.system, law.K, MPC.Q, MPC.R)
    return replace(MPC, terminal_set=ellipsoid, terminal_cost=cost)


@pytest.mark.slow
def test_tuning_grows_the_set_and_the_terminal_set_stays_invariant():
    run = tune_feasible_set(
        terminal_law,
        {"Qt": Parameter(MPC.Q, "diagonal")},
        STATES[3:],
        0.1,
        updates=6,
        optimizer=optax.adam(0.3),
        batch=64,
        validation=0.25,
    )
    history = run.history
    assert history.steps == 6 and history.accepted.all()
    assert history.validation[history.best] < history.validation[0]
    np.testing.assert_allclose(-history.validation, history.validation_numbers["fraction"])
    P, K = np.asarray(run.mpc.terminal_set.P), jm.lqr(MPC.system, run.values["Qt"], MPC.R).K
    closed = MPC.system.A + MPC.system.B @ K
    assert np.linalg.eigvalsh(P - closed.T @ P @ closed)[0] > 0
    axes = np.linspace(-1.5, 1.5, 30), np.linspace(-2, 2, 30)  # no state of a split by chance
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    with jax.enable_x64(True):
        of = lambda Qt: float(feasible_fraction(terminal_law({"Qt": Qt}), grid, 0.1))
        before, after = map(of, (MPC.Q, run.values["Qt"]))
    assert after > 1.8 * before > 0


@pytest.mark.slow
def test_the_tuned_set_is_larger_by_proof():
    """The area that `map_feasible_set` proves; the exact set without terminal set is its limit."""
    run = tune_feasible_set(
        terminal_law,
        {"Qt": Parameter(MPC.Q, "definite")},
        STATES[3:],
        0.05,
        updates=25,
        optimizer=optax.adam(0.3),
    )
    areas = [
        jm.map_feasible_set(mpc, STATES[3:]).refine(1e-3).volume_bounds()
        for mpc in (terminal_law({"Qt": MPC.Q}), run.mpc)
    ]
    assert areas[1][0] > 5 * areas[0][1] and areas[1][0] < AREA_JOINT
