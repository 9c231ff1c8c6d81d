"""Robust problems by tightened rows: against all disturbance sequences, exact fractions and the
nominal problem."""

import itertools
from dataclasses import replace
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import enable_x64

import jaxmpc as jm
from jaxmpc.feasible.hard_constraints import hard_blocks
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.stored import sweep_into
from jaxmpc.mpc.condense import condense
from jaxmpc.mpc.problem import Outputs
from jaxmpc.mpc.tightening import feedback_gain, without_disturbance
from jaxmpc.verify.stored_map import verify_map
from jaxmpc.verify.stored_problem import Constraints

A, B = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])
SYSTEM = jm.LinearSystem(A, B)
X, U = jm.Box([-5.0, -2.0], [5.0, 2.0]), jm.Box([-1.0], [1.0])
FIELDS = {"system": SYSTEM, "Q": np.eye(2), "R": 0.1, "horizon": 3, "states": X, "inputs": U}
E = np.array([[0.3], [1.0]])
SETS = {
    "box": jm.Box([-0.1], [0.2]),
    "polytope": jm.Polytope([[1.0], [-2.0]], [0.2, 0.2]),
    "zonotope": jm.sets.Zonotope([0.05], [[0.1, -0.03]]),
}


def robust(**fields) -> jm.MPC:
    return jm.MPC(**{**FIELDS, "disturbance": jm.Box(-0.15, 0.15), **fields})


def sequences(W, N: int) -> np.ndarray:
    """Return all sequences (K, N, p) of vertices of W."""
    return np.array(list(itertools.product(W.vertices(), repeat=N)))


def followed(mpc: jm.MPC, x0: np.ndarray, v: np.ndarray, w: np.ndarray) -> tuple:
    """Return states (K, N+1, n) and inputs (K, N, m) of the policy under disturbances (K, N, p)."""
    A, B = np.asarray(mpc.system.A), np.asarray(mpc.system.B)
    K, n = np.asarray(feedback_gain(mpc)), mpc.system.n
    push = np.eye(n) if mpc.disturbance_matrix is None else np.asarray(mpc.disturbance_matrix)
    z = x0
    x, states, inputs = np.tile(x0, (len(w), 1)), [], []
    for k in range(mpc.horizon):
        u = v[k] + (x - z) @ K.T
        states.append(x)
        inputs.append(u)
        x, z = x @ A.T + u @ B.T + w[:, k] @ push.T, A @ z + B @ v[k]
    return np.stack([*states, x], 1), np.stack(inputs, 1)


@pytest.mark.parametrize("name", SETS)
def test_rows_lose_what_the_worst_sequence_takes(name):
    """Bounds of states, inputs, rates and outputs lose the largest that any sequence of vertices
    adds to them under u = K e, from exact dynamics; bounds for plans lose no less, for half-spaces
    no more."""
    mpc = jm.MPC(
        **FIELDS, disturbance=SETS[name], disturbance_matrix=E, gain=[[-0.4, -1.1]],
        outputs=Outputs([[1.0, 2.0]], [-9.0], [9.0], D=[[0.5]]), input_rate_limit=1.5,
        terminal_set=jm.Box([-3.0, -2.0], [3.0, 2.0]), prestabilise=False,
    )  # fmt: skip
    w = sequences(mpc.disturbance, mpc.horizon)
    x, u = followed(mpc, np.zeros(2), np.zeros((mpc.horizon, 1)), w)
    u_before = np.concatenate([np.zeros((len(w), 1, 1)), u[:, :-1]], axis=1)
    plain = hard_blocks(without_disturbance(mpc))
    for given, inner, outer in zip(
        plain, hard_blocks(mpc), hard_blocks(mpc, widest=True), strict=True
    ):
        for i, k in enumerate(given.steps):
            state = np.concatenate([x[:, k], u_before[:, min(k, mpc.horizon - 1)]], axis=1)
            value = state @ given.H.T + (u[:, k] @ given.D.T if k < mpc.horizon else 0.0)
            low, high = value.min(axis=0, initial=0.0), value.max(axis=0, initial=0.0)
            for blocks, sign in ((inner, 1), (outer, -1)):
                tight = np.broadcast_to(blocks.upper, (len(given.steps), given.size))[i]
                np.testing.assert_allclose(tight, given.upper - high, rtol=0, atol=3e-9)
                assert np.all(sign * (given.upper - high - tight) >= -1e-15)
                tight = np.broadcast_to(blocks.lower, (len(given.steps), given.size))[i]
                np.testing.assert_allclose(tight, given.lower - low, rtol=0, atol=3e-9)


def test_bounds_enclose_the_exact_ones():
    """With numbers that round, in rational arithmetic: inside for plans, outside for half-spaces,
    within a few roundings of each other."""
    rng = np.random.default_rng(1)
    n, m, N = 3, 2, 6
    system = jm.LinearSystem(rng.normal(size=(n, n)), rng.normal(size=(n, m)))
    mpc = jm.MPC(
        system, np.eye(n), np.eye(m), N, states=jm.Box(-300.0, 300.0), inputs=jm.Box(-90.0, 90.0),
        disturbance=jm.Box(-0.1, 0.07), disturbance_matrix=rng.normal(size=(n, 2)),
    )  # fmt: skip
    exact = lambda v: np.asarray(np.frompyfunc(Fraction, 1, 1)(np.asarray(v, float)), object)
    K, push = exact(feedback_gain(mpc)), exact(mpc.disturbance_matrix)
    closed = exact(system.A) + exact(system.B) @ K
    inner, outer = hard_blocks(mpc), hard_blocks(mpc, widest=True)
    for tight, wide in zip(inner, outer, strict=True):
        t = exact(tight.H) + exact(tight.D) @ K
        taken = np.zeros(tight.size, object)
        h = exact(300.0 if tight.kind == "state" else 90.0)
        for k in range(N):
            upper = h - taken
            for i in range(tight.size):
                assert Fraction(tight.upper[k, i]) <= upper[i] <= Fraction(wide.upper[k, i])
                assert wide.upper[k, i] - tight.upper[k, i] <= 1e-11 * float(h + taken[i])
            along = t @ push
            taken = taken + np.maximum(along * Fraction(0.07), along * Fraction(-0.1)).sum(axis=1)
            t = t @ closed


def test_no_disturbance_is_the_nominal_problem_bit_for_bit():
    """All that plans, labels and proofs are made from."""
    one, two = jm.MPC(**FIELDS), robust(disturbance=jm.Box(0.0, 0.0))
    found = []
    for mpc in (one, two):
        problem = FeasibilityProblem.of(mpc)
        found.append((problem.exact(np.ones(2)), problem.rows, condense(mpc)))
    for a, b in zip(*map(jax.tree.leaves, found), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_no_disturbance_has_the_nominal_answers_bit_for_bit():
    nominal, zero = jm.MPC(**FIELDS), robust(disturbance=jm.Box(0.0, 0.0))
    x = np.array([-3.0, 1.0])
    one, two = jm.solve(nominal, x), jm.solve(zero, x)
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        np.testing.assert_array_equal(a, b)
    points = jm.grid([-5.0, -2.0], [5.0, 2.0], (15, 15))
    one, two = (jm.map_feasible_set(mpc, points).labels.arrays() for mpc in (nominal, zero))
    for name, values in one.items():
        np.testing.assert_array_equal(values, two[name])


@pytest.mark.slow
def test_plans_keep_all_limits_under_every_sequence():
    """And touch one of them: the tightening is no larger than it has to be."""
    last = jm.maximal_invariant_set(
        SYSTEM, jm.lqr(SYSTEM, np.eye(2), 0.1).K, X, U, disturbance=jm.Box([-0.15] * 2, [0.15] * 2)
    )
    mpc = robust(terminal_set=last)
    w = sequences(mpc.disturbance, 3)
    touched = 0
    edges = jm.feasible.boundary(mpc, 8)
    with enable_x64():
        for x0 in edges.points * (1 - 1e-6):
            plan = jm.solve(mpc, x0)
            assert plan.solved
            x, u = followed(mpc, x0, np.asarray(plan.inputs), w)
            beyond = max(np.abs(x[:, :3] / [5.0, 2.0]).max(), np.abs(u).max()) - 1
            ends = (x[:, 3] @ np.asarray(last.H).T - np.asarray(last.h)).max()
            assert max(beyond, ends) <= 1e-6
            touched += max(beyond, ends) >= -1e-6
    assert touched >= 6


@pytest.mark.slow
@pytest.mark.parametrize(
    "W", [jm.Box(-0.2, 0.2), jm.Polytope([[1, 1], [-1, 0], [0, -1]], [0.1] * 3)]
)
def test_plans_stage_by_stage_are_those_of_the_condensed_problem(W):
    mpc = robust(disturbance=W)
    with enable_x64():
        for x0 in ([-3.0, 1.0], [-4.4, 1.6]):
            one, two = jm.solve(mpc, x0), jm.mpc.solve_stagewise(mpc, x0)
            assert one.solved and two.solved
            np.testing.assert_allclose(two.inputs, one.inputs, atol=1e-7)


def test_one_step_is_the_one_step_controllable_set():
    """N = 1: no policy differs from another, and X_1 = X ∩ Pre(terminal set)."""
    last = jm.Box([-2.0, -1.0], [2.0, 1.0])
    mpc = robust(horizon=1, terminal_set=last)
    found = jm.feasible.feasible_polytope(mpc)
    W = jm.Box([-0.15] * 2, [0.15] * 2)
    expected = jm.sets.predecessor(SYSTEM, last, X, U, W)
    assert found.is_subset(expected) and expected.is_subset(found)


def test_sets_are_nested_in_the_size_of_the_disturbance():
    sizes = (0.0, 0.05, 0.1, 0.2)
    found = [
        jm.feasible.feasible_polytope(robust(disturbance=jm.Box(-s, s), horizon=4)) for s in sizes
    ]
    assert all(b.is_subset(a) for a, b in itertools.pairwise(found))
    assert not found[0].is_subset(found[3])


def test_derivatives_of_tightened_bounds():
    """With respect to the gain and the size of W, against central differences."""

    def upper(K, size):
        mpc = robust(gain=K, disturbance=jm.Box(-size * jnp.ones(2), size * jnp.ones(2)))
        return condense(mpc).upper

    with enable_x64():
        K, size, h = np.asarray(jm.lqr(SYSTEM, np.eye(2), 0.1).K), 0.15, 1e-6
        upper = jax.jit(upper)
        of_K, of_size = jax.jit(jax.jacfwd(upper, argnums=(0, 1)))(K, size)
        by_size = (upper(K, size + h) - upper(K, size - h)) / (2 * h)
        np.testing.assert_allclose(of_size, by_size, atol=1e-8)
        for i in range(2):
            step = h * np.eye(2)[[i]]
            by_K = (upper(K + step, size) - upper(K - step, size)) / (2 * h)
            np.testing.assert_allclose(of_K[:, 0, i], by_K, atol=1e-8)


@pytest.mark.slow
def test_derivatives_of_gain_and_size():
    """Of the optimal cost, against central differences."""

    def cost(K, size):
        mpc = robust(gain=K, disturbance=jm.Box(-size * jnp.ones(2), size * jnp.ones(2)))
        return jm.solve(mpc, np.array([-4.4, 1.6])).cost

    with enable_x64():
        K, size = np.asarray(jm.lqr(SYSTEM, np.eye(2), 0.1).K), 0.15
        of_K, of_size = jax.grad(cost, argnums=(0, 1))(K, size)
        h = 1e-5
        by_size = (cost(K, size + h) - cost(K, size - h)) / (2 * h)
        np.testing.assert_allclose(of_size, by_size, rtol=1e-7)
        assert of_size > 0
        for i in range(2):
            step = h * np.eye(2)[[i]]
            by_K = (cost(K + step, size) - cost(K - step, size)) / (2 * h)
            np.testing.assert_allclose(of_K[0, i], by_K, rtol=1e-6, atol=1e-7)


def test_stored_labels_are_verified_in_fractions(tmp_path):
    """The tightening too, from the gain and the set that are stored: other ones do not pass."""
    mpc = robust(
        disturbance=jm.Box([-0.1], [0.2]), disturbance_matrix=E, input_rate_limit=0.8, horizon=4,
        input_rate_weight=[0.1],
    )  # fmt: skip
    lines = [np.linspace(-5, 5, 9), np.linspace(-2, 2, 9), np.linspace(-1, 1, 3)]
    sweep_into(tmp_path / "map.zarr", mpc, lines)
    result = verify_map(tmp_path / "map.zarr", exact=True)
    assert result.passed and result.verified == 243
    plain = FeasibilityProblem.of(mpc).plain()
    inner, outer = Constraints(plain), hard_blocks(mpc)
    assert all(np.all(a <= b) for a, b in zip(inner.upper, inner.widest[1], strict=True))
    other = FeasibilityProblem.of(replace(mpc, gain=[[-0.1, -0.5]])).plain()
    differ = [
        not np.array_equal(a, b) for a, b in zip(inner.upper, Constraints(other).upper, strict=True)
    ]
    assert any(differ) and len(outer)


def test_rates_of_a_robust_problem_of_many_states_name_their_cure():
    system = jm.LinearSystem(0.5 * np.eye(4), np.ones(4))
    mpc = jm.MPC(
        system, np.eye(4), 1.0, 3, states=jm.Box(-np.ones(4), np.ones(4)), inputs=jm.Box(-1, 1),
        input_rate_limit=0.5, disturbance=jm.Box(-0.01, 0.01),
    )  # fmt: skip
    with pytest.raises(ValueError, match="Make u_{k-1} a state and its change the input"):
        jm.feasible_polytope(mpc)


def test_recursive_feasibility_needs_a_robust_terminal_set():
    K, W = jm.lqr(SYSTEM, np.eye(2), 0.1).K, jm.Box([-0.15] * 2, [0.15] * 2)
    good = jm.maximal_invariant_set(SYSTEM, K, X, U, disturbance=W)
    report = jm.recursive_feasibility(robust(terminal_set=good))
    assert report.strong.holds and "all disturbances" in report.strong.reason
    report = jm.recursive_feasibility(robust(horizon=2))
    assert report.strong.holds is False and report.law.holds is None and report.weak.holds is None
    assert "those of a robust problem are not followed" in str(report)  # not: no time was left
    H, h = np.asarray(report.feasible_set.H), np.asarray(report.feasible_set.h)
    x = report.strong.state
    assert np.all(H @ x <= h + 1e-9)
    after = [A @ x + B[:, 0] * u + w for u in (-1.0, 1.0) for w in W.vertices()]
    assert max(np.max(H @ y - h) for y in after) > 1.0
    with pytest.raises(ValueError, match="x0s: given for a robust problem"):
        jm.recursive_feasibility(robust(), x0s=np.zeros((1, 2)))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"disturbance": jm.Ellipsoid(np.eye(2), 1.0)}, "Give a Box, a Polytope or a Zonotope"),
        ({"disturbance": jm.Box([0.1, 0.1], [0.2, 0.2])}, "does not hold the origin"),
        ({"disturbance": jm.Box([-np.inf, 0.0], [0.0, 0.0])}, "is unbounded"),
        ({"disturbance": jm.Box([-1.0] * 3, [1.0] * 3)}, "disturbance"),
        ({"disturbance_matrix": np.ones((3, 1))}, "disturbance_matrix: shape"),
        ({"gain": np.ones((2, 2))}, "gain: shape"),
        ({"policy": "rigid"}, "policy: 'rigid'"),
        ({"disturbance": None, "gain": [[1.0, 1.0]]}, "gain: given without a disturbance"),
        ({"disturbance": None, "policy": "tube"}, "policy: 'tube' without a disturbance. Give"),
        ({"terminal_set": jm.Ellipsoid(np.eye(2), 1.0)}, "no rows to tighten"),
        ({"disturbance": jm.Box(-2.0, 2.0)}, "takes more than there is of input u1: at k = 1"),
        ({"Q": np.zeros((2, 2))}, "gain: is None, and Q and R have no LQR"),
    ],
)
def test_refusals(fields, message):
    with pytest.raises(ValueError, match=message):
        jm.solve(robust(**fields), np.zeros(2))


def test_what_knows_no_disturbance_says_so():
    mpc = robust()
    with pytest.raises(ValueError, match="nonlinear model"):
        jm.mpc.NonlinearMPC(mpc, SYSTEM).validate()
    with pytest.raises(ValueError, match="set-point"):
        jm.RobotController(jm.robots.LinearPlant(SYSTEM, X, U), mpc)
    with pytest.raises(ValueError, match="Polytope inside a trace"):
        W = jm.Polytope(np.vstack([np.eye(2), -np.eye(2)]), np.full(4, 0.1))
        jax.jit(lambda W: jm.solve(robust(disturbance=W), np.zeros(2)).cost)(W)
