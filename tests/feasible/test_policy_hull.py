"""Affine policies: labels against all vertex sequences, and against a linear program of another
formulation (SciPy) over policies."""

import itertools

import numpy as np
import pytest
from scipy.optimize import linprog

import jaxmpc as jm
from jaxmpc.feasible import (
    affine_policies,
    any_policy_polytope,
    boundary,
    feasible_polytope,
)
from jaxmpc.feasible.policy_hull import policy_hull
from jaxmpc.feasible.policy_problem import problem_of
from jaxmpc.sets import minimal_robust_invariant_set

A, B = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])
SYSTEM = jm.LinearSystem(A, B)
X, U = jm.Box([-5.0, -2.0], [5.0, 2.0]), jm.Box([-1.0], [1.0])
W = jm.Box([-0.2, -0.2], [0.2, 0.2])
K = np.asarray(jm.lqr(SYSTEM, np.eye(2), 0.1).K)


def double(**fields) -> jm.MPC:
    last = jm.maximal_invariant_set(SYSTEM, K, X, U, disturbance=W)
    given = {"system": SYSTEM, "Q": np.eye(2), "R": 0.1, "horizon": 5, "states": X, "inputs": U}
    given |= {"terminal_set": last, "disturbance": W, "policy": "affine"}
    return jm.MPC(**{**given, **fields})


def random_problem(seed: int) -> jm.MPC:
    """Return a small problem of any kind: n ≤ 3, N ≤ 4, one or two disturbances off centre."""
    rng = np.random.default_rng(seed)
    n, m, N, p = rng.integers(1, 4), rng.integers(1, 3), rng.integers(1, 5), rng.integers(1, 3)
    A, B, c = 0.7 * rng.normal(size=(n, n)), rng.normal(size=(n, m)), 0.05 * rng.normal(size=n)
    system = jm.LinearSystem(A, B, c)
    low, high = -rng.uniform(0, 0.25, p), rng.uniform(0.01, 0.25, p)
    return jm.MPC(
        system, np.eye(n), np.eye(m), int(N),
        states=jm.Box(-rng.uniform(1, 2, n), rng.uniform(1, 2, n)),
        inputs=jm.Box(-rng.uniform(0.5, 1, m), rng.uniform(0.5, 1, m)), policy="affine",
        disturbance=jm.Box(low, high), disturbance_matrix=rng.normal(size=(n, p)),
        terminal_set=jm.Box(-np.ones(n), np.ones(n)),
    )  # fmt: skip


def worst_by_sequences(mpc: jm.MPC, x0: np.ndarray, v: np.ndarray, M: np.ndarray) -> float:
    """Return by how much the policy u = v + M ω breaks a limit, over all vertex sequences."""
    N, (n, m) = mpc.horizon, mpc.system.B.shape
    low, high = np.asarray(mpc.disturbance.lower), np.asarray(mpc.disturbance.upper)
    E = np.eye(n) if mpc.disturbance_matrix is None else np.asarray(mpc.disturbance_matrix)
    signs = np.array(list(itertools.product([-1.0, 1.0], repeat=N * len(low))))
    w = (low + high) / 2 + signs.reshape(-1, N, len(low)) * (high - low) / 2
    u = (v + signs @ M.T).reshape(-1, N, m)
    x, worst = np.tile(x0, (len(w), 1)), -np.inf
    c = 0.0 if mpc.system.c is None else np.asarray(mpc.system.c)
    for k in range(N + 1):
        set_ = mpc.states if k < N else mpc.terminal_set
        H, h = set_.half_spaces()
        worst = max(worst, np.max(x @ H.T - h))
        if k < N:
            H, h = mpc.inputs.half_spaces()
            worst = max(worst, np.max(u[:, k] @ H.T - h))
            x = (
                x @ np.asarray(mpc.system.A).T
                + u[:, k] @ np.asarray(mpc.system.B).T
                + c
                + w[:, k] @ E.T
            )
    return worst


def least_violation(mpc: jm.MPC, x0: np.ndarray) -> float:
    """Return the least violation over all affine policies, by a program with a row for each vertex
    sequence and limit: no supports, no duals."""
    N, (n, m) = mpc.horizon, mpc.system.B.shape
    low, high = np.asarray(mpc.disturbance.lower), np.asarray(mpc.disturbance.upper)
    E = np.eye(n) if mpc.disturbance_matrix is None else np.asarray(mpc.disturbance_matrix)
    c = np.zeros(n) if mpc.system.c is None else np.asarray(mpc.system.c)
    p, A, B = len(low), np.asarray(mpc.system.A), np.asarray(mpc.system.B)
    entries = [(k, j) for k in range(N) for j in range(k)]
    total = N * m + len(entries) * m * p
    rows, bounds = [], []
    for w in itertools.product(itertools.product(*zip(low, high, strict=True)), repeat=N):
        gain, x = np.zeros((n, total)), np.array(x0)
        for k in range(N + 1):
            set_ = mpc.states if k < N else mpc.terminal_set
            H, h = set_.half_spaces()
            rows.append(H @ gain)
            bounds.append(h - H @ x)
            if k == N:
                break
            u = np.zeros((m, total))
            u[:, k * m : (k + 1) * m] = np.eye(m)
            for e, (i, j) in enumerate(entries):
                if i == k:
                    at = N * m + e * m * p
                    u[:, at : at + m * p] = np.kron(np.eye(m), np.asarray(w[j]))
            H, h = mpc.inputs.half_spaces()
            rows.append(H @ u)
            bounds.append(h)
            gain, x = A @ gain + B @ u, A @ x + c + E @ np.asarray(w[k])
    G, g = np.vstack(rows), np.concatenate(bounds)
    found = linprog(
        np.eye(total + 1)[-1], np.column_stack([G, -np.ones(len(g))]), g, bounds=(None, None)
    )
    return found.fun if found.status == 0 else -np.inf


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.first(1)
def test_no_label_is_wrong(seed):
    """States labelled feasible keep all limits under every sequence by the policy that is given;
    for those nearest to the boundary that are labelled infeasible, no policy exists."""
    mpc = random_problem(seed)
    problem = problem_of(mpc)
    rng = np.random.default_rng(seed)
    try:
        hull = policy_hull(problem)
    except ValueError as error:
        assert "empty or flat" in str(error)
        assert all(least_violation(mpc, x) > -1e-7 for x in rng.uniform(-1, 1, (5, mpc.system.n)))
        return
    points = rng.uniform(-2, 2, (400, mpc.system.n))
    found = jm.map_feasible_set(problem, points)
    assert found.counts()["undecided"] == 0
    inside = points[found.label == 1][:40]
    for x0, v, M in zip(inside, *hull.policies(inside), strict=True):
        assert worst_by_sequences(mpc, x0, v, M) <= 1e-9
    outside = np.flatnonzero(found.label == -1)
    beyond = np.sum(found.labels.cut_normal * points, axis=1) - found.labels.cut_offset
    size = np.linalg.norm(found.labels.cut_normal, axis=1)
    assert np.all(beyond[outside] > 0)
    for i in outside[np.argsort((beyond / size)[outside])][:4]:
        assert least_violation(mpc, points[i]) > 0


def margin_of_any_policy(mpc: jm.MPC, start: np.ndarray) -> float:
    """Return the largest margin that all rows can keep from `start` (x, and u_{−1} where rates are
    limited), by one linear program (SciPy) with an input for each sequence of past vertices."""
    (n, m), N = mpc.system.B.shape, mpc.horizon
    A, B = np.asarray(mpc.system.A), np.asarray(mpc.system.B)
    E = np.eye(n) if mpc.disturbance_matrix is None else np.asarray(mpc.disturbance_matrix)
    ends = zip(np.asarray(mpc.disturbance.lower), np.asarray(mpc.disturbance.upper), strict=True)
    pushes = [E @ w for w in itertools.product(*ends)]
    count = m * sum(len(pushes) ** k for k in range(N)) + 1
    unit, taken, rows, bounds = np.eye(count), 0, [], []

    def limit(set_, M, c):
        """Ask H (M z + c) + t ≤ h."""
        H, h = (np.asarray(v) for v in (set_.to_polytope().H, set_.to_polytope().h))
        rows.extend(H @ M + unit[-1])
        bounds.extend(h - H @ c)

    still, rates = None, None
    if mpc.rate_limited:
        still = np.zeros((m, count)), start[n:]
        rates = jm.Box(-mpc.input_rate_limit, mpc.input_rate_limit)
    level = [(np.zeros((n, count)), start[:n], still)]
    for _ in range(N):
        later = []
        for M, c, before in level:
            u = unit[taken : taken + m]
            taken += m
            limit(mpc.states, M, c)
            limit(mpc.inputs, u, np.zeros(m))
            if before is not None:
                limit(rates, u - before[0], -before[1])
            after = None if before is None else (u, np.zeros(m))
            later += [(A @ M + B @ u, A @ c + push, after) for push in pushes]
        level = later
    for M, c, _ in level:
        limit(mpc.terminal_set, M, c)
    free = [(None, None)] * (count - 1) + [(None, 1.0)]
    return -linprog(-unit[-1], np.array(rows), np.array(bounds), bounds=free).fun


@pytest.mark.long
@pytest.mark.parametrize("policy", ["tube", "tightened"])
@pytest.mark.parametrize("rates", [np.array([1.1]), None])
@pytest.mark.first(1)
def test_labels_about_any_policy(policy, rates):
    """Against a linear program over trees of inputs; the class has no say in them."""
    smaller = jm.Box([-0.1, -0.1], [0.1, 0.1])
    some = {} if rates is None else {"input_rate_limit": rates, "disturbance": smaller}
    mpc = double(policy=policy, horizon=3, **some)
    d = 2 if rates is None else 3
    points = np.random.default_rng(0).uniform(-1, 1, (60, d)) * [4.5, 2.2, 1.0][:d]
    found = jm.map_feasible_set(mpc, points)
    labels = found.any_policy_labels()
    truth = np.array([margin_of_any_policy(mpc, x) for x in points])
    assert np.all(np.abs(truth) > 1e-6)
    np.testing.assert_array_equal(labels, np.sign(truth))
    lost = found.label == -1
    assert np.sum(lost & (labels == -1)) > 5
    assert rates is not None or np.sum(lost & (labels == 1)) > 0
    assert "any_policy_labels" in found.claim
    without = jm.MPC(SYSTEM, np.eye(2), 0.1, 3, X, U, terminal_set=X)
    nominal = jm.map_feasible_set(without, points[:, :2])
    np.testing.assert_array_equal(nominal.any_policy_labels(), nominal.label)


def test_the_double_integrator_of_the_literature():
    """Area of the exact set by dynamic programming (`predecessor`), by rays, and as a polytope."""
    mpc = double()
    exact = mpc.terminal_set
    for _ in range(5):
        exact = jm.sets.predecessor(SYSTEM, exact, X, U, W)
    np.testing.assert_allclose(exact.volume(), 35.7903, atol=5e-5)
    any_policy = any_policy_polytope(mpc)
    np.testing.assert_allclose(any_policy.volume(), exact.volume(), rtol=1e-12)
    for name, value in (
        ("outputs", jm.mpc.Outputs([[1.0, 1.0]], upper=[5.0], D=[[1.0]])),
        ("constrained_stages", (1, 2)),
        ("constrain_initial", False),
        ("states", None),
    ):
        with pytest.raises(ValueError, match=f"^{name}: is"):
            any_policy_polytope(double(policy="tightened", **{name: value}))
    found = feasible_polytope(mpc)
    assert found.is_subset(exact, 1e-7)
    np.testing.assert_allclose(found.volume(), 35.7903, atol=1e-4)
    hull = policy_hull(problem_of(mpc))
    assert hull.gap < 1e-9
    ends = boundary(mpc, 5)
    assert np.all(ends.inner > 0) and np.all(ends.outer - ends.inner < 1e-9 * ends.outer)
    tightened = feasible_polytope(double(policy="tightened"))
    assert tightened.is_subset(found) and tightened.volume() < 0.979 * found.volume()


def test_all_sequences_of_combined_policies():
    mpc = double()
    problem = problem_of(mpc)
    points = np.random.default_rng(0).uniform([-5, -2], [5, 2], (300, 2))
    found = jm.map_feasible_set(problem, points)
    assert found.claim.startswith("Feasible: an affine policy keeps all limits under every")
    inside = points[found.label == 1][:60]
    v, M = policy_hull(problem).policies(inside)
    assert max(worst_by_sequences(mpc, *each) for each in zip(inside, v, M, strict=True)) <= 1e-11
    plans = found.labels.plan[found.label == 1][:60]
    np.testing.assert_allclose(plans[:, :, 0], v, atol=1e-12)


def test_one_step_and_no_disturbance():
    """N = 1: the one-step controllable set. W = {0}: the nominal set."""
    one = feasible_polytope(double(horizon=1))
    expected = jm.sets.predecessor(SYSTEM, double().terminal_set, X, U, W)
    assert one.is_subset(expected, 1e-8) and expected.is_subset(one, 1e-8)
    zero = feasible_polytope(double(disturbance=jm.Box(0.0, 0.0), horizon=3))
    nominal = feasible_polytope(
        jm.MPC(SYSTEM, np.eye(2), 0.1, 3, X, U, terminal_set=double().terminal_set)
    )
    assert zero.is_subset(nominal, 1e-8) and nominal.is_subset(zero, 1e-8)


def test_slices_and_recursion():
    mpc = double(horizon=3)
    found = jm.map_feasible_set(
        mpc, np.linspace(-1.99, 2.01, 41)[:, None], axes=[1], fixed=[3.0, 0.0]
    )
    whole = feasible_polytope(mpc)
    expected = [bool(whole.contains(np.array([3.0, y]))) for y in found.x0s[:, 0]]
    np.testing.assert_array_equal(found.label == 1, expected)
    report = jm.recursive_feasibility(mpc)
    assert report.strong.holds and "all disturbances" in report.strong.reason


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"policy": "tube", "control_horizon": 2}, "control_horizon: given with policy 'tube'"),
        ({"input_rate_limit": 1.0}, "Give points .B, 3.: states, then previous inputs"),
        ({"inputs": None}, "inputs: are in no bounded Box"),
        ({"gain": K}, "gain: given with affine policies"),
        ({"disturbance": W.to_polytope()}, "has no generators"),
        ({"disturbance": jm.sets.Zonotope([0, 0], np.ones((2, 3)))}, "depend on each other"),
        ({"terminal_set": jm.Box([2.0, -2.0], [5.0, -1.9])}, "is empty or flat"),
    ],
)
def test_refusals(fields, message):
    with pytest.raises(ValueError, match=message):
        jm.map_feasible_set(double(**fields), np.zeros((1, 2)))


def test_a_tiny_side_of_a_disturbance_is_a_direction():
    """That of a Box, in whatever units: generators are independent where their directions are."""
    for W in (
        jm.Box([-0.1, -1e-17], [0.1, 1e-17]),
        jm.sets.Zonotope([0, 0], np.diag([0.1, 1e-17])),
    ):
        assert jm.map_feasible_set(double(disturbance=W), np.zeros((1, 2))).label[0] == 1


def test_what_takes_one_sequence_refuses_affine_policies():
    mpc = double()
    for call in (
        lambda: jm.explicit.critical_regions(mpc),
        lambda: jm.explicit.exact_penalty(mpc),
        lambda: jm.feasible.feasible_fraction(mpc, np.zeros((1, 2))),
    ):
        with pytest.raises(ValueError, match="policy: 'affine'"):
            call()
    with pytest.raises(ValueError, match="give a projection"):
        jm.map_feasible_set(mpc, np.zeros((1, 1)), axes=[0])


def worst_of_tube(mpc: jm.MPC, x0: np.ndarray, plan: np.ndarray) -> float:
    """Return by how much u = v + K (x − z), z_0 = x_0 − center − G ζ, breaks a limit, over all
    vertex sequences."""
    N, m = mpc.horizon, mpc.system.m
    S = minimal_robust_invariant_set(SYSTEM, K, mpc.disturbance).to_zonotope()
    v, zeta = plan[: N * m].reshape(N, m), plan[N * m :]
    assert np.abs(zeta).max() <= 1
    z = x0 - np.asarray(S.center) - np.asarray(S.generators) @ zeta
    w = np.array(list(itertools.product(mpc.disturbance.vertices(), repeat=N)))
    x, worst = np.tile(x0, (len(w), 1)), -np.inf
    for k in range(N + 1):
        H, h = (X if k < N else mpc.terminal_set).half_spaces()
        worst = max(worst, np.max(x @ H.T - h))
        if k < N:
            u = v[k] + (x - z) @ K.T
            worst = max(worst, np.abs(u).max() - 1.0)
            x, z = x @ A.T + u @ B.T + w[:, k], A @ z + B @ v[k]
    return worst


def test_tubes():
    """The set is Z ⊕ S with the nominal set Z of tightened limits, built by other functions; its
    policies keep all limits under every sequence."""
    small = jm.Box([-0.1, -0.1], [0.1, 0.1])
    last = jm.maximal_invariant_set(SYSTEM, K, X, U, disturbance=small)
    mpc = double(policy="tube", gain=K, disturbance=small, terminal_set=last, horizon=4)
    S = minimal_robust_invariant_set(SYSTEM, K, small).to_zonotope()
    less = lambda body, M: body.to_polytope().pontryagin_difference(S.image(M).vertices())
    Z = feasible_polytope(
        jm.MPC(
            SYSTEM,
            np.eye(2),
            0.1,
            4,
            less(X, np.eye(2)),
            less(U, K),
            terminal_set=jm.Polytope(last.H, last.h).pontryagin_difference(S.vertices()),
        )  # fmt: skip
    )
    expected = Z.minkowski_sum(S.vertices())
    found = feasible_polytope(mpc)
    assert found.is_subset(expected, 1e-7) and expected.is_subset(found, 1e-7)
    problem = problem_of(mpc)
    points = np.random.default_rng(0).uniform([-5, -2], [5, 2], (300, 2))
    labels = jm.map_feasible_set(problem, points)
    np.testing.assert_array_equal(labels.label == 1, [bool(expected.contains(x)) for x in points])
    inside = points[labels.label == 1][:30]
    plans, _ = policy_hull(problem).policies(inside)
    each = zip(inside, plans, strict=True)
    assert max(worst_of_tube(mpc, *one) for one in each) <= 1e-9
    assert jm.recursive_feasibility(mpc).strong.holds


def test_policies_in_units_of_the_disturbances():
    """u = plan + feedback w, with W off centre, keeps all limits at every vertex sequence."""
    W = jm.Box([-0.2, -0.1], [0.05, 0.2])
    mpc = double(disturbance=W, horizon=3)
    points = np.random.default_rng(0).uniform([-5, -2], [5, 2], (40, 2))
    labels = jm.map_feasible_set(mpc, points).label
    plan, feedback = affine_policies(mpc, points)
    assert plan.shape == (40, 3, 1) and feedback.shape == (40, 3, 1, 3, 2)
    np.testing.assert_array_equal(np.isfinite(plan).all(axis=(1, 2)), labels == 1)
    assert np.all(feedback[labels == 1][:, 0] == 0) and np.all(
        feedback[labels == 1][:, 2, :, 2] == 0
    )
    w = np.array(list(itertools.product(W.vertices(), repeat=3)))
    H, h = mpc.terminal_set.half_spaces()
    for x0, v, M in zip(points[labels == 1], plan[labels == 1], feedback[labels == 1], strict=True):
        x = np.tile(x0, (len(w), 1))
        for k in range(3):
            assert np.all(np.abs(x) <= [5 + 1e-9, 2 + 1e-9])
            u = v[k] + np.einsum("ajp,bjp->ba", M[k], w)
            assert np.abs(u).max() <= 1 + 1e-9
            x = x @ A.T + u @ B.T + w[:, k]
        assert np.max(x @ H.T - h) <= 1e-9
    with pytest.raises(ValueError, match="has no affine policy"):
        affine_policies(double(policy="tightened"), points)


@pytest.mark.slow
def test_a_tube_whose_disturbance_has_one_direction():
    """The section has dozens of generators, the last of them 1e-12 long: none is a limit."""
    mpc = double(
        policy="tube", gain=None, terminal_set=None, horizon=3,
        disturbance=jm.Box([-0.1], [0.1]), disturbance_matrix=np.array([[0.5], [1.0]]),
    )  # fmt: skip
    points = jm.grid([-1.0, -0.5], [1.0, 0.5], 3)
    plans = jm.solve_many(mpc, points)
    labels = jm.map_feasible_set(mpc, points)
    assert (np.asarray(plans.status) == jm.Status.SOLVED).all()
    assert (labels.label == 1).all()
    assert feasible_polytope(mpc).contains(points).all()
