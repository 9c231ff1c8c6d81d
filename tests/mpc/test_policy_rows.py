"""Plans under affine policies and tubes: against a program with a row for each sequence of
disturbances (DAQP), all sequences in open and in closed loop, and the labels of maps."""

import itertools

import daqp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import enable_x64
from scipy.optimize import linprog

import jaxmpc as jm
from jaxmpc.feasible.policy_hull import policy_hull
from jaxmpc.feasible.policy_problem import problem_of
from jaxmpc.mpc.policy_rows import condensed_plan
from jaxmpc.mpc.tightening import feedback_gain, without_disturbance

A, B = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])
SYSTEM = jm.LinearSystem(A, B)
X, U = jm.Box([-5.0, -2.0], [5.0, 2.0]), jm.Box([-1.0], [1.0])
W = jm.Box([-0.2, -0.1], [0.1, 0.2])
LAW = jm.lqr(SYSTEM, np.eye(2), 0.1)
STATES = np.array([[-3.0, 1.0], [-4.6, 1.7], [4.4, -1.3], [0.0, 0.0], [-4.9, 1.95], [3.5, 1.0]])


def robust(policy: str, **fields) -> jm.MPC:
    last = jm.maximal_invariant_set(SYSTEM, LAW.K, X, U, disturbance=W)
    given = {"terminal_cost": LAW.P, "terminal_set": last, "disturbance": W, "horizon": 3}
    return jm.MPC(SYSTEM, np.eye(2), 0.1, states=X, inputs=U, policy=policy, **{**given, **fields})


def plans(mpc: jm.MPC, states: np.ndarray) -> jm.mpc.Plan:
    """One after the other: half of what a batch has to compile."""
    with enable_x64():
        controller = jm.Controller(mpc)
        each = [controller.plan(x0) for x0 in states]
        return jax.tree.map(lambda *v: np.stack(v), *each)


def sequences(mpc: jm.MPC) -> np.ndarray:
    """Return all sequences (K, N, p) of vertices."""
    return np.array(list(itertools.product(mpc.disturbance.vertices(), repeat=mpc.horizon)))


def least_cost(mpc: jm.MPC, x0: np.ndarray) -> float:
    """Return the least cost of the undisturbed plan over all affine policies, ∞ where there is
    none: over (v, M), with the rows of every sequence."""
    N, n, p = mpc.horizon, 2, 2
    entries = [(k, j, q) for k in range(N) for j in range(k) for q in range(p)]
    total = N + len(entries)

    def inputs(w: np.ndarray) -> np.ndarray:
        u = np.zeros((N, total))
        u[:, :N] = np.eye(N)
        for e, (k, j, q) in enumerate(entries):
            u[k, N + e] = w[j, q]
        return u

    def states(w: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        gain, x = [np.zeros((n, total))], [x0]
        for k in range(N):
            gain.append(A @ gain[-1] + B @ u[k : k + 1])
            x.append(A @ x[-1] + w[k])
        return np.array(gain), np.array(x)

    rows, bounds = [], []
    for w in sequences(mpc):
        u = inputs(w)
        gain, x = states(w, u)
        for k in range(N + 1):
            H, h = (mpc.states if k < N else mpc.terminal_set).half_spaces()
            rows.append(H @ gain[k])
            bounds.append(h - H @ x[k])
        rows += [u, -u]
        bounds += [np.ones(N), np.ones(N)]
    none = np.zeros((N, p))
    u = inputs(none)
    gain, x = states(none, u)
    weights = [np.eye(2)] * N + [np.asarray(mpc.terminal_cost)]
    P = 2 * (0.1 * u.T @ u + sum(g.T @ W @ g for g, W in zip(gain, weights, strict=True)))
    q = 2 * sum(g.T @ W @ v for g, W, v in zip(gain, weights, x, strict=True))
    constant = sum(v @ W @ v for v, W in zip(x, weights, strict=True))
    G, h = np.vstack(rows), np.concatenate(bounds)
    P = P + 1e-9 * np.eye(total)  # DAQP's programs are definite
    found = daqp.solve(P, q, G, h, np.full(len(h), -1e30), np.zeros(len(h), np.int32))
    return found[1] + constant if found[2] > 0 else np.inf


def worst_rows(mpc: jm.MPC, x: np.ndarray, u: np.ndarray) -> float:
    """Return the largest violation of states (K, N+1, n) and inputs (K, N, m)."""
    last, every = mpc.terminal_set.half_spaces(), mpc.states.half_spaces()
    beyond = [np.max(x[:, :-1] @ every[0].T - every[1]), np.max(x[:, -1] @ last[0].T - last[1])]
    return max(*beyond, float(np.max(np.abs(u))) - 1)


def labelled(mpc: jm.MPC) -> tuple[np.ndarray, np.ndarray]:
    hull = policy_hull(problem_of(mpc))
    ends, center = hull.bounds.points[:8], hull.rays.center
    scales = (0.5, 1 - 1e-5, 1 + 1e-5, 1.1)
    states = np.concatenate([STATES, *(center + t * (ends - center) for t in scales)])
    return states, jm.map_feasible_set(mpc, states).label


def found(policy: str) -> tuple[jm.MPC, np.ndarray, np.ndarray, jm.mpc.Plan]:
    """Return a problem, states (B, 2), those of `STATES` and many near the boundary, the labels of
    its map and its plans."""
    mpc = robust(policy)
    states, labels = labelled(mpc)
    return mpc, states, labels, plans(mpc, states)


def require_labels(labels: np.ndarray, status: np.ndarray) -> None:
    """A plan where the map says that there is one, a proof where it says that there is none."""
    np.testing.assert_array_equal(status == jm.Status.SOLVED, labels == 1)
    np.testing.assert_array_equal(status == jm.Status.PRIMAL_INFEASIBLE, labels == -1)
    assert 0 < np.sum(labels == 1) < len(labels)


@pytest.mark.parametrize("policy", ["affine", "tube"])
@pytest.mark.parametrize("gain", [False, True])
def test_extents_bound_all_solutions(policy, gain):
    """Those that proofs rest on, against the largest entry of a feasible solution (SciPy)."""
    mpc = robust(policy, prestabilise=np.asarray(LAW.K) if gain else False)
    with enable_x64():
        qp = condensed_plan(mpc).qp(jnp.asarray(STATES[0]))
        A, l, u, extent = (np.asarray(v) for v in (qp.A, qp.l, qp.u, qp.extent))
    n = A.shape[1]
    for i, sign in itertools.product(range(n), (1.0, -1.0)):
        cost = np.zeros(n)
        cost[i] = -sign
        G = np.vstack([A[np.isfinite(u)], -A[np.isfinite(l)]])
        h = np.append(u[np.isfinite(u)], -l[np.isfinite(l)])
        most = linprog(cost, G, h, bounds=(None, None))
        assert most.status == 0 and -most.fun <= extent[i] * (1 + 1e-9)
    assert extent.max() < 1e3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("policy", "states"),
    [
        ("tube", [[4.44520886, 1.96529], [-3.71277832, -2.04230099], [4.28589471, 1.85791424]]),
        ("affine", [[4.44520886, 1.96529], [3.95302046, 1.31180867], [4.29126811, 1.11685189]]),
    ],
)
def test_that_there_is_no_plan_is_proved_in_float32(policy, states):
    """They were INACCURATE: no row bounds the variables of policies alone, so that rounding of a
    Farkas vector could be multiplied by anything."""
    even = jm.Box([-0.2, -0.2], [0.2, 0.2])
    last = jm.maximal_invariant_set(SYSTEM, LAW.K, X, U, disturbance=even)
    controller = jm.Controller(robust(policy, disturbance=even, terminal_set=last, horizon=5))
    for x0 in states:
        assert controller.plan(x0).status == jm.Status.PRIMAL_INFEASIBLE
    assert controller.plan([-3.0, 1.0]).solved


@pytest.mark.slow
def test_affine_plans_are_the_best_of_all():
    """Costs are those of a program with all sequences; where that has no policy, the plan is
    proved infeasible; the policy keeps all limits under every sequence."""
    mpc, states, labels, plan = found("affine")
    require_labels(labels, plan.status)
    assert plan.feedback.shape == (len(states), 3, 1, 3, 2)
    for x0, cost, status in zip(STATES, plan.cost, plan.status, strict=False):
        best = least_cost(mpc, x0)
        assert status == (jm.Status.SOLVED if best < np.inf else jm.Status.PRIMAL_INFEASIBLE)
        if best < np.inf:
            np.testing.assert_allclose(cost, best, rtol=1e-6, atol=1e-7)
    w = sequences(mpc)
    for i in np.flatnonzero(labels == 1):
        u = plan.inputs[i] + np.einsum("kmjp,sjp->skm", plan.feedback[i], w)
        x = [np.tile(states[i], (len(w), 1))]
        for k in range(3):
            x.append(x[-1] @ A.T + u[:, k] @ B.T + w[:, k])
        assert worst_rows(mpc, np.stack(x, 1), u) < 2e-6


def least_first_inputs(mpc: jm.MPC, states: np.ndarray) -> np.ndarray:
    """Return the least first input over the rows of the condensed problem, ∞ where they have no
    solution: linear programs of SciPy."""
    with enable_x64():
        c = jax.tree.map(np.asarray, jm.Controller(mpc).condensed)
    least = []
    for x0 in states:
        low, high = (side - c.D @ x0 - c.d for side in (c.lower, c.upper))
        above, below = np.isfinite(high), np.isfinite(low)
        rows = np.vstack([c.C[above], -c.C[below]])
        bounds = np.append(high[above], -low[below])
        found = linprog(np.eye(rows.shape[1])[0], rows, bounds, bounds=(None, None))
        least.append(found.fun if found.status == 0 else np.inf)
    return np.array(least)


def test_rows_of_tubes_have_a_solution_where_the_map_says_so():
    mpc = robust("tube")
    states, labels = labelled(mpc)
    np.testing.assert_array_equal(np.isfinite(least_first_inputs(mpc, states)), labels == 1)
    assert 0 < np.sum(labels == 1) < len(labels)


@pytest.mark.slow
def test_forms_of_one_set_of_disturbances():
    """A box, a zonotope of two generators, and a zonotope through E give the same plans."""
    box = jm.Box([-0.08], [0.18])
    zonotope = jm.sets.Zonotope([0.05], [[0.1, -0.03]])
    along = jm.sets.Zonotope([0.025, 0.05], [[0.065], [0.13]])
    E, last = np.array([[0.5], [1.0]]), jm.Box([-1.0, -1.0], [1.0, 1.0])
    forms = (
        {"disturbance": box, "disturbance_matrix": E},
        {"disturbance": zonotope, "disturbance_matrix": E},
        {"disturbance": along},
    )
    each = [
        least_first_inputs(robust("affine", terminal_set=last, **form), STATES) for form in forms
    ]
    assert 0 < np.isfinite(each[0]).sum() < len(STATES)
    np.testing.assert_allclose(each[1], each[0], atol=1e-8)
    np.testing.assert_allclose(each[2], each[0], atol=1e-8)


@pytest.mark.slow
def test_tubes_keep_all_limits():
    """Under every sequence by u = inputs + K (x − states); the undisturbed plan is one of the
    plant."""
    mpc, states, labels, plan = found("tube")
    require_labels(labels, plan.status)
    K, w = np.asarray(feedback_gain(mpc)), sequences(mpc)
    assert plan.feedback is None
    for i in np.flatnonzero(labels == 1):
        z, v = plan.states[i], plan.inputs[i]
        np.testing.assert_allclose(z[0], states[i], atol=1e-12)
        np.testing.assert_allclose(z[1:], z[:-1] @ A.T + v @ B.T, atol=1e-9)
        x, u = [np.tile(states[i], (len(w), 1))], []
        for k in range(3):
            u.append(v[k] + (x[-1] - z[k]) @ K.T)
            x.append(x[-1] @ A.T + u[-1] @ B.T + w[:, k])
        assert worst_rows(mpc, np.stack(x, 1), np.stack(u, 1)) < 2e-6


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["affine", "tube"])
def test_closed_loops_keep_all_limits(policy):
    """From states at the boundary of the map, under every sequence of vertices over four steps and
    under random ones: all plans solved."""
    mpc = robust(policy)
    hull = policy_hull(problem_of(mpc))
    ends, center = hull.bounds.points, hull.rays.center
    states = center + (1 - 1e-6) * (ends[:: max(len(ends) // 6, 1)] - center)
    vertices = np.array(list(itertools.product(mpc.disturbance.vertices(), repeat=4)))
    inside = jm.closed_loop.draw_disturbances(mpc, 4, 64, kind="inside")
    w = np.concatenate([vertices, inside])
    with enable_x64():
        controller = jm.Controller(mpc)
        loop = lambda x0, w: jm.simulate(controller, SYSTEM, x0, 4, disturbance=w)
        loops = jax.jit(jax.vmap(loop, (None, 0)))
        for x0 in states:
            run = loops(jnp.asarray(x0), jnp.asarray(w))
            assert np.all(run.status == jm.Status.SOLVED)
            assert float(jnp.max(run.violation)) <= 2e-6
            assert float(jnp.max(jnp.abs(run.inputs))) <= 1


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["affine", "tube"])
def test_sizes_of_the_disturbance(policy):
    """Without any the plan is the nominal one; with more it costs no less; derivatives with
    respect to the size are those of differences."""
    x0 = np.array([-4.6, 1.7])
    with enable_x64():
        last = robust(policy).terminal_set

        def cost(size, policy=policy):
            W = jm.Box(-size * jnp.ones(2), size * jnp.ones(2))
            return jm.solve(robust(policy, disturbance=W, terminal_set=last), x0).cost

        costs = [float(cost(size)) for size in (1e-12, 0.05, 0.1, 0.15)]
        nominal = jm.solve(without_disturbance(robust(policy, terminal_set=last)), x0).cost
        np.testing.assert_allclose(costs[0], nominal, rtol=1e-7)
        assert np.all(np.diff(costs) > -1e-9)
        if policy == "affine":  # the section of a tube is no function of JAX
            slope = jax.grad(cost)(0.15)
            np.testing.assert_allclose(
                slope, (cost(0.15 + 1e-5) - cost(0.15 - 1e-5)) / 2e-5, rtol=1e-6
            )
            assert slope > 0.1
        else:
            with pytest.raises(ValueError, match="policy: 'tube' beside traced"):
                jax.grad(cost)(0.15)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"soft": jm.Soft(np.eye(2), upper=[1.0, 1.0])}, "soft: rows given with policy 'affine'"),
        ({"control_horizon": 2}, "control_horizon: given with policy 'affine'"),
        ({"disturbance": jm.Polytope([[1.0, 1.0], [-1.0, 0.0], [0.0, -1.0]], [0.1] * 3)},
         "disturbance: is a Polytope, and affine policies answer to generators"),
        ({"policy": "tube", "disturbance": jm.Box([-1.0, -1.0], [1.0, 1.0])},
         "disturbance: takes more than there is of input"),
        ({"policy": "tube", "gain": [[0.0, 0.0]]}, "K: A . BK has spectral radius"),
        ({"horizon": 2000}, "horizon: needs"),
    ],
)  # fmt: skip
def test_errors(fields, message):
    with pytest.raises(ValueError, match=message):
        jm.solve(robust(**{"policy": "affine", **fields}), [0.0, 0.0])
