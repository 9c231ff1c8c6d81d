"""Plans under limits of one side, at zero and away from it: solved, or proved infeasible."""

import functools

import jax
import numpy as np
import pytest
from scipy.optimize import linprog

import jaxmpc as jm
from jaxmpc import Status

n, m, N = 2, 2, 4
# Ends of an interval, in units of its quantity.
INF = np.inf
ENDS = [
    (-1.0, 1.5),
    (0.0, 1.2),
    (-0.8, 0.0),
    (0.0, INF),
    (0.5, 1.5),
    (-1.2, INF),
    (-INF, 1.0),
    (-INF, -0.2),
]


def draw(rng):
    """Return a problem with limits of random kinds, in random units, and states to plan from."""
    xs, us = 10.0 ** rng.uniform(-3, 3, n), 10.0 ** rng.uniform(-3, 3, m)
    A = rng.normal(size=(n, n)) if rng.uniform() < 0.5 else rng.uniform(size=(n, n))
    A *= rng.uniform(0.6, 1.1) / np.abs(np.linalg.eigvals(A)).max()
    x, u, y = (np.array([ENDS[k] for k in rng.integers(8, size=2)]).T for _ in range(3))
    C, D = rng.normal(size=(2, n)), rng.normal(size=(2, m))
    mpc = jm.MPC(
        jm.LinearSystem(A * xs[:, None] / xs, rng.normal(size=(n, m)) * xs[:, None] / us, dt=1.0),
        np.diag(1 / xs**2), np.diag(0.1 / us**2), N, terminal_cost=np.diag(1 / xs**2),
        states=jm.Box(*(x * xs)), inputs=jm.Box(*(u * us)), constrain_initial=False,
        outputs=jm.Outputs(C / xs, *y, D=D / us),
    )  # fmt: skip
    least = np.where(np.isfinite(x[0]), x[0], x[1] - 2.5)
    most = np.minimum(x[1], least + 2.5)
    return mpc, xs * (least + (most - least) * rng.uniform(-0.1, 1.1, (32, n)))


def room(mpc, x0):
    """Return the largest t such that some inputs keep all limits by t times their size (HiGHS)."""
    A, B = np.asarray(mpc.system.A), np.asarray(mpc.system.B)
    powers = [np.linalg.matrix_power(A, k) for k in range(N)]
    rows, ends = [], []
    for k in range(N):
        moved = np.hstack([powers[k - 1 - j] @ B if j < k else 0 * B for j in range(N)])
        own = np.hstack([np.eye(m) if j == k else np.zeros((m, m)) for j in range(N)])
        out, free = mpc.outputs, powers[k] @ x0
        parts = [(own, np.zeros(m), mpc.inputs)]
        if k > 0:
            parts += [(moved, free, mpc.states)]
            parts += [(out.C @ moved + out.D @ own, out.C @ free, out)]
        for M, at, set_ in parts:
            size = [max(abs(v) for v in pair if np.isfinite(v)) or 1.0
                    for pair in zip(set_.lower, set_.upper, strict=True)]  # fmt: skip
            for side, bound in ((1, set_.upper), (-1, set_.lower)):
                there = np.isfinite(bound)
                rows.append(side * (M / np.array(size)[:, None])[there])
                ends.append(side * ((bound - at) / size)[there])
    H, h = np.vstack(rows), np.concatenate(ends)
    scale = 1 / np.abs(H).max(axis=0)
    cost, with_t = np.append(np.zeros(N * m), -1.0), np.hstack([H * scale, np.ones((len(h), 1))])
    found = linprog(cost, with_t, h, bounds=[(None, None)] * (N * m) + [(None, 1)])
    return -found.fun


@pytest.mark.long
@pytest.mark.first(6)
@pytest.mark.parametrize("seed", range(40))
def test_each_plan_is_solved_or_proved_infeasible(seed):
    mpc, x0s = draw(np.random.default_rng(seed))
    plans = jm.solve_many(mpc, x0s)
    rooms = np.array([room(mpc, x0) for x0 in x0s])
    clear = np.abs(rooms) > 1e-5
    expected = np.where(rooms > 0, Status.SOLVED, Status.PRIMAL_INFEASIBLE)
    np.testing.assert_array_equal(plans.status[clear], expected[clear])


@pytest.mark.long
@pytest.mark.parametrize(
    "seed", [5, 16, 44, 51, 53, *(pytest.param(k, marks=pytest.mark.slow) for k in range(6, 16))]
)
def test_each_state_is_labelled(seed):
    """Also where no finite box holds the inputs, and multipliers would have to balance exactly."""
    mpc, x0s = draw(np.random.default_rng(seed))
    rooms = np.array([room(mpc, x0) for x0 in x0s])
    clear = np.abs(rooms) > 1e-4
    label = np.asarray(jm.map_feasible_set(mpc, x0s).label)
    np.testing.assert_array_equal(label[clear], np.where(rooms > 0, 1, -1)[clear])


@pytest.mark.long
def test_a_program_without_an_answer_leaves_states_undecided():
    """Neither HiGHS nor its dual ends one of the programs of this map's bounding box."""
    mpc, x0s = draw(np.random.default_rng(28))
    label = np.asarray(jm.map_feasible_set(mpc, x0s).label)
    assert np.count_nonzero(label) >= 24


def positive_systems(count, n, m):
    """Return stable systems whose states stay positive, and whose inputs are doses."""
    rng = np.random.default_rng(n)
    for _ in range(count):
        A = rng.uniform(0, 1, (n, n))
        A *= rng.uniform(0.5, 0.95) / np.abs(np.linalg.eigvals(A)).max()
        yield jm.LinearSystem(A, rng.uniform(0, 1, (n, m)), dt=1.0), rng.uniform(1, 5, (32, n))


@jax.enable_x64(True)
@jax.jit
@functools.partial(jax.vmap, in_axes=(None, 0))
def stagewise(mpc, x0s):
    return jm.mpc.solve_stagewise(mpc, x0s)


# Stage by stage `test_interior_point.py` has some in the fast suite.
CASES = [(jm.solve_many, 2, 2, 1.0, 1.0), (jm.solve_many, 2, 2, 1.0, INF)]
SLOW = [(stagewise, 2, 1, 1.0, 1.0), (jm.solve_many, 4, 2, 1e3, 1.0), (stagewise, 3, 2, 1e-3, 1.0)]
SLOW += [(jm.solve_many, 3, 2, 1.0, INF), (stagewise, 4, 2, 1e3, INF), (stagewise, 2, 1, 1.0, INF)]


@pytest.mark.long
@pytest.mark.parametrize(
    ("solve", "n", "m", "unit", "most"),
    [*CASES, *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW)],
)
def test_plans_that_dose_nothing(solve, n, m, unit, most):
    """With A, B, x0 ≥ 0 every predicted state grows with every input, so does the cost of the
    states, and the best of all inputs u ≥ 0 is none."""
    for system, x0s in positive_systems(3, n, m):
        states, inputs = jm.Box(np.zeros(n), np.full(n, 20 * unit)), jm.Box(0, most * unit)
        # As many rows as those of `draw`, with which they share a program.
        free = jm.Outputs(np.zeros((2, n)), *np.outer([-INF, INF], [1, 1]), D=np.zeros((2, m)))
        limits = {"states": states, "inputs": inputs, "outputs": free, "constrain_initial": False}
        mpc = jm.MPC(system, np.eye(n), 0.1 * np.eye(m), N, terminal_cost=np.eye(n), **limits)
        plans = solve(mpc, unit * x0s)
        assert (plans.status == Status.SOLVED).all()
        assert np.abs(plans.inputs).max() < 1e-9 * unit


@pytest.mark.parametrize("name", ["states", "inputs", "terminal_set"])
@pytest.mark.long
@pytest.mark.first(1)
def test_a_polytope_without_rows_limits_nothing(name):
    size = {"inputs": 1}.get(name, 2)
    everything = jm.Box([-np.inf] * size, [np.inf] * size).to_polytope()
    assert len(everything.h) == 0
    system = jm.LinearSystem([[1, 1], [0, 1]], [0.5, 1.0])
    limits = {"states": jm.Box([-5.0, -2.0], [5.0, 2.0]), "inputs": jm.Box(-1, 1)}
    mpc = jm.MPC(system, np.eye(2), [[0.1]], 2, **{**limits, name: everything})
    plain = jm.MPC(system, np.eye(2), [[0.1]], 2, **{**limits, name: None})
    cost = [jm.solve(problem, [1.0, 0.0]).cost for problem in (mpc, plain)]
    np.testing.assert_allclose(*cost, rtol=1e-6)
    assert jm.soften(mpc, 1e3).horizon == 2
