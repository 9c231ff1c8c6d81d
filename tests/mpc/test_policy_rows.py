"""Plans under affine policies and tubes, of condensed QPs and stage by stage: against a program
with a row for each sequence of disturbances (DAQP), all sequences in open and in closed loop, and
the labels of maps."""

import itertools
from dataclasses import replace

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


def plans(mpc: jm.MPC, states: np.ndarray, **solver) -> jm.mpc.Plan:
    """One after the other: half of what a batch has to compile."""
    with enable_x64():
        controller = jm.Controller(mpc, jm.ADMM(**solver))
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


def rolled_out(system, plan: jm.mpc.Plan, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return states (K, N+1, n) and inputs (K, N, m) of an affine policy under w (K, N, n)."""
    start, v, M = (np.asarray(part) for part in (plan.states[0], plan.inputs, plan.feedback))
    u = v + np.einsum("kmjp,sjp->skm", M, w)
    x = [np.tile(start, (len(w), 1))]
    for k in range(w.shape[1]):
        x.append(x[-1] @ np.asarray(system.A).T + u[:, k] @ np.asarray(system.B).T + w[:, k])
    return np.stack(x, 1), u


def labelled(mpc: jm.MPC) -> tuple[np.ndarray, np.ndarray]:
    hull = policy_hull(problem_of(mpc))
    ends, center = hull.bounds.points[:8], hull.rays.center
    # From 1 + 1e-5 on one row of some states is violated by 7e-7, which the tolerance allows.
    scales = (0.5, 1 - 1e-5, 1 + 2e-5, 1.1)
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


@pytest.mark.long
@pytest.mark.first(2)
@pytest.mark.parametrize(
    ("policy", "gain"), [("affine", False), ("tube", True), ("affine", True), ("tube", False)]
)
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
    for i in np.flatnonzero(labels == 1):
        one = jax.tree.map(lambda v, i=i: v[i], plan)
        assert worst_rows(mpc, *rolled_out(mpc.system, one, sequences(mpc))) < 2e-6


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


def by_daqp(mpc: jm.MPC, x0: np.ndarray, before: np.ndarray | None = None) -> tuple:
    """Return the inputs (N, m) and the cost of the condensed program, by DAQP: None and ∞ where its
    rows leave nothing."""
    with enable_x64():
        c = jm.Controller(mpc).condensed
        theta = np.append(x0, [] if before is None else before)
        qp = jax.tree.map(np.array, c.qp(jnp.asarray(theta)))
        still, (x, u) = np.zeros(len(qp.q)), c.trajectory(theta, np.zeros(len(qp.q)))
    weights = [np.eye(2)] * mpc.horizon + [np.asarray(mpc.terminal_cost)]
    constant = sum(v @ W @ v for v, W in zip(np.asarray(x), weights, strict=True))
    constant += 0.1 * np.sum(np.asarray(u) ** 2)
    soft = np.zeros(len(qp.u), bool) if qp.soft_linear is None else np.isfinite(qp.soft_linear)
    count = soft.sum()
    P, q, A = qp.P, qp.q, np.hstack([qp.A, np.zeros((len(qp.u), count))])
    above, below = A.copy(), A.copy()
    if count:  # Az ≤ u + e and Az ≥ l − e with e ≥ 0
        pay = np.diag(qp.soft_quadratic[soft])
        P = np.block([[P, np.zeros((len(q), count))], [np.zeros((count, len(q))), pay]])
        q = np.append(q, qp.soft_linear[soft])
        above[soft, len(still) :], below[soft, len(still) :] = -np.eye(count), np.eye(count)
    slack = np.eye(len(q))[len(still) :]
    G, free = np.vstack([above, below, slack]), np.full(len(qp.u), 1e30)
    upper = np.concatenate([np.minimum(qp.u, 1e30), free, np.full(count, 1e30)])
    lower = np.concatenate([-free, np.maximum(qp.l, -1e30), np.zeros(count)])
    P = P + 1e-12 * np.eye(len(q))  # DAQP's programs are definite
    found = daqp.solve(P, q, G, upper, lower, np.zeros(len(upper), np.int32))
    if found[2] <= 0:
        return None, np.inf
    with enable_x64():
        inputs = np.asarray(c.trajectory(theta, found[0][: len(still)])[1])
    return inputs, found[1] + constant


@pytest.mark.long
@pytest.mark.parametrize("policy", ["tube", "affine"])
def test_without_limits_the_nominal_inputs_are_those_of_the_lqr(policy):
    free = replace(robust(policy, terminal_set=None), states=None, inputs=None)
    for x0 in STATES[:2]:
        np.testing.assert_allclose(by_daqp(free, x0)[0][0], LAW.K @ x0, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["tube", "affine"])
def test_without_limits_plans_are_solved(policy):
    free = replace(robust(policy, terminal_set=None), states=None, inputs=None)
    found = plans(free, STATES[:2], differentiate="unrolled")  # the fastest to compile
    assert (found.status == jm.Status.SOLVED).all()
    np.testing.assert_allclose(found.inputs[:, 0], STATES[:2] @ LAW.K.T, atol=1e-7)


@pytest.mark.first(1)
@pytest.mark.parametrize("policy", ["affine", "tube"])
def test_units_play_no_part(policy):
    """The steps of ADMM, in scaled rows, are those of the problem in other units of states, input
    and cost, and with longer rows of the terminal set."""
    mpc = robust(policy)
    S, s, cost = np.diag([1e3, 1.0]), 1e2, 1e4
    back = np.linalg.inv(S)
    scaled = lambda box, by: jm.Box(by * np.asarray(box.lower), by * np.asarray(box.upper))
    of_states = lambda box: scaled(box, np.diag(S))
    last = mpc.terminal_set
    other = replace(
        mpc, system=jm.LinearSystem(S @ A @ back, S @ B / s), Q=cost * back @ back,
        R=0.1 * cost / s**2, terminal_cost=cost * back @ np.asarray(mpc.terminal_cost) @ back,
        states=of_states(X), inputs=scaled(U, s), disturbance=of_states(W),
        terminal_set=jm.Polytope(0.01 * np.asarray(last.H) @ back, 0.01 * np.asarray(last.h)),
    )  # fmt: skip
    with enable_x64():
        factors = [jm.Controller(each).factor for each in (mpc, other)]
        one, two = (f.A @ f.F[0] for f in factors)
        np.testing.assert_allclose(two, one, rtol=1e-5, atol=1e-6)


@pytest.mark.long
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
def test_traced_limits_of_a_tube():
    """Under jit the same plan, and derivatives by differences; the LQR of traced weights is refused
    with what helps."""
    system = jm.LinearSystem([[1, 0.2], [0, 1]], [[0.02], [0.2]])
    gain = jm.lqr(system, np.eye(2), np.eye(1)).K

    def mpc(h, q=1.0, gain=gain):
        return jm.MPC(
            system, q * np.eye(2), np.eye(1), 4, states=jm.Box(-h, h), inputs=jm.Box([-1], [1]),
            disturbance=jm.Box([-0.01] * 2, [0.01] * 2), policy="tube", gain=gain,
        )  # fmt: skip

    with enable_x64():
        x, h, step = np.array([0.4, 0.4]), np.array([0.57, 0.5]), 1e-6
        cost = lambda h: jm.solve(mpc(h), x).cost
        assert jm.solve(mpc(h), x).solved
        np.testing.assert_allclose(jax.jit(cost)(h), cost(h), rtol=1e-9)
        wanted = [(cost(h + step * e) - cost(h - step * e)) / (2 * step) for e in np.eye(2)]
        found = jax.grad(cost)(h)
        assert np.abs(wanted).min() > 1
        np.testing.assert_allclose(found, wanted, rtol=1e-6)
        cost = lambda q: jm.solve(mpc(h, q), x).cost
        wanted = (cost(1.0 + step) - cost(1.0 - step)) / (2 * step)
        for slope in (jax.grad(cost), jax.jit(jax.grad(cost))):
            np.testing.assert_allclose(slope(1.0), wanted, rtol=1e-6)
        with pytest.raises(ValueError, match="traced dynamics.*Give gain=K .None is the LQR"):
            jax.grad(lambda q: jm.solve(mpc(h, q, None), x).cost)(1.0)


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


class Rows:
    """Linear rows over all variables, collected, and the least cost that they allow."""

    def __init__(self, mpc: jm.MPC, x0: np.ndarray, before: np.ndarray, more: int):
        """Variables: `more` of them, then a slack for each soft row and step."""
        self.mpc, self.x0, self.before = mpc, x0, before
        self.soft = mpc.soft if isinstance(mpc.soft, jm.Soft) else None
        self.more = more
        self.total = more + (0 if self.soft is None else mpc.horizon + 1)
        self.G, self.g = [-np.eye(self.total)[more:]], [np.zeros(self.total - more)]

    def ask(self, M: np.ndarray, c: np.ndarray, H: np.ndarray, h: np.ndarray) -> None:
        """Ask H (M z + c) <= h."""
        self.G.append(H @ M)
        self.g.append(h - H @ c)

    def roll(self, u: np.ndarray, u_c: np.ndarray, start: tuple, w: np.ndarray) -> list:
        """Return x_0 … x_N as pairs (matrix, constant) of inputs u (N, V) and u_c (N,)."""
        x = [start]
        for k in range(len(u)):
            M, c = x[-1]
            x.append((A @ M + B @ u[k : k + 1], A @ c + B[:, 0] * u_c[k] + w[k]))
        return x

    def limit(self, x: list, s: np.ndarray, u: np.ndarray, u_c: np.ndarray) -> None:
        """Ask the limits of states x_k + s and inputs, and the soft row."""
        N = self.mpc.horizon
        for k, (M, c) in enumerate(x):
            self.ask(M, c + s, *(self.mpc.states if k < N else self.mpc.terminal_set).half_spaces())
            if self.soft is not None:
                C, e = np.asarray(self.soft.C), np.eye(self.total)[self.more + k]
                for sign, bound in ((1, self.soft.upper), (-1, -np.asarray(self.soft.lower))):
                    self.ask(sign * C @ M - e, sign * C @ (c + s), np.eye(1), np.asarray(bound))
        for sign in (1, -1):
            self.ask(sign * u, sign * u_c, np.eye(N), np.ones(N))

    def rate(self, M: np.ndarray, c: float) -> None:
        """Ask |M z + c| <= the limit of the rate."""
        if self.mpc.input_rate_limit is not None:
            most = np.asarray(self.mpc.input_rate_limit)
            for sign in (1, -1):
                self.ask(sign * M[None], np.array([sign * c]), np.eye(1), most)

    def least(self, u: np.ndarray, u_c: np.ndarray, start: tuple) -> float:
        """Return the least cost of the undisturbed plan, ∞ where the rows leave nothing."""
        N = self.mpc.horizon
        x = self.roll(u, u_c, start, np.zeros((N, 2)))
        weights = [np.eye(2)] * N + [np.asarray(self.mpc.terminal_cost)]
        P, q = 0.2 * u.T @ u, 0.2 * u.T @ u_c
        constant = 0.1 * u_c @ u_c
        for (M, c), Q in zip(x, weights, strict=True):
            P, q, constant = P + 2 * M.T @ Q @ M, q + 2 * M.T @ Q @ c, constant + c @ Q @ c
        if self.soft is not None:
            q[self.more :] += float(self.soft.rho)
            P[self.more :, self.more :] += 2 * float(self.soft.quadratic) * np.eye(N + 1)
        G, h = np.vstack(self.G), np.concatenate(self.g)
        found = daqp.solve(P + 1e-9 * np.eye(self.total), q, G, h, np.full(len(h), -1e30),
                           np.zeros(len(h), np.int32))  # fmt: skip
        return found[1] + constant if found[2] > 0 else np.inf


def least_cost_of_affine(mpc: jm.MPC, x0: np.ndarray, before: np.ndarray) -> float:
    """With the rows of every sequence of vertices."""
    N, moves = mpc.horizon, np.array(mpc.moves)
    entries = [(k, j, q) for k in range(N) for j in range(k) for q in range(2)]
    free = moves.max() + 1
    rows = Rows(mpc, x0, before, free + len(entries))
    start = np.zeros((2, rows.total)), x0

    def inputs(w: np.ndarray) -> np.ndarray:
        u = np.zeros((N, rows.total))
        u[np.arange(N), moves] = 1.0
        for e, (k, j, q) in enumerate(entries):
            u[k, free + e] = w[j, q]
        return u

    for w in sequences(mpc):
        u = inputs(w)
        rows.limit(rows.roll(u, np.zeros(N), start, w), np.zeros(2), u, np.zeros(N))
        for k in range(N):
            rows.rate(u[k] - u[k - 1] if k else u[0], 0.0 if k else -before[0])
    return rows.least(inputs(np.zeros((N, 2))), np.zeros(N), start)


def least_cost_of_tube(mpc: jm.MPC, x0: np.ndarray, before: np.ndarray) -> float:
    """With the rows of every vertex of the section, and for rates of W. Variables (z_0, v)."""
    N, K = mpc.horizon, np.asarray(LAW.K)
    S = jm.sets.minimal_robust_invariant_set(SYSTEM, K, mpc.disturbance).to_zonotope().to_polytope()
    closed, rows = A + B @ K, Rows(mpc, x0, before, 2 + N)
    e_0 = -np.eye(2, rows.total), x0
    rows.ask(*e_0, *S.half_spaces())
    v = np.eye(N, rows.total, 2)
    z = rows.roll(v, np.zeros(N), (np.eye(2, rows.total), np.zeros(2)), np.zeros((N, 2)))
    for s in S.vertices():
        rows.limit(z, s, v, np.full(N, (K @ s)[0]))
        for k in range(1, N):
            for w in mpc.disturbance.vertices():
                rows.rate(v[k] - v[k - 1], (K @ (closed @ s - s + w))[0])
    rows.rate(v[0] + (K @ e_0[0])[0], (K @ x0)[0] - before[0])
    powers = [np.linalg.matrix_power(closed, k) for k in range(N)]
    u = v + np.array([(K @ M @ e_0[0])[0] for M in powers])
    u_c = np.array([(K @ M @ x0)[0] for M in powers])
    return rows.least(u, u_c, (np.zeros((2, rows.total)), x0))


SOFT = jm.Soft([[0.3, 1.0]], lower=[-0.5], upper=[0.5], rho=2.0, quadratic=1.0)
RATES = {"input_rate_limit": [1.1]}
MORE = [
    ("tube", {"soft": SOFT, **RATES}), ("affine", {"soft": SOFT}),
    ("affine", {"control_horizon": 2}), ("affine", RATES),
    ("affine", {"soft": SOFT, "control_horizon": (1, 2), **RATES}), ("tube", {"soft": SOFT}),
    ("tube", RATES),
]  # fmt: skip


def solved(mpc: jm.MPC, x0: np.ndarray, before: np.ndarray) -> tuple:
    """Return the inputs and the cost of the plan, ∞ where there is none."""
    with enable_x64():
        plan = jm.Controller(mpc).plan(x0, previous_input=before)
    return plan.inputs, float(plan.cost) if plan.solved else np.inf


@pytest.mark.long
@pytest.mark.parametrize(
    ("plan", "policy", "fields"),
    [
        (by_daqp, "tube", {"soft": SOFT, **RATES}),
        *(pytest.param(solved, *case, marks=pytest.mark.slow) for case in MORE),
    ],
)
def test_soft_rows_rates_and_blocks(plan, policy, fields):
    """The least cost is that of DAQP with all vertices; a map says where there is a plan."""
    W = jm.Box([-0.1, -0.05], [0.05, 0.1])
    if "control_horizon" in fields:  # which takes symmetric disturbances alone
        W = jm.Box([-0.08, -0.07], [0.08, 0.07])
    mpc = robust(policy, disturbance=W, **fields)
    before, costs = np.array([-0.2]), []
    points = np.vstack([STATES[:4] + [0.1, 0.0], [4.5, 1.8]])
    least = least_cost_of_affine if policy == "affine" else least_cost_of_tube
    for x0 in points:
        found, cost = plan(mpc, x0, before)[1], least(mpc, x0, before)
        assert np.isfinite(found) == np.isfinite(cost)
        if np.isfinite(cost):
            np.testing.assert_allclose(found, cost, rtol=1e-6)
        costs.append(cost)
    assert 3 <= np.isfinite(costs).sum() < len(points)
    if mpc.rate_limited:
        points = np.column_stack([points, np.repeat(before, len(points))])
    labels = jm.map_feasible_set(mpc, points).label
    np.testing.assert_array_equal(labels, np.where(np.isfinite(costs), 1, -1))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"policy": "tube", "control_horizon": 2}, "control_horizon: given with policy 'tube'"),
        ({"disturbance": jm.Polytope([[1.0, 1.0], [-1.0, 0.0], [0.0, -1.0]], [0.1] * 3)},
         "disturbance: is a Polytope, which has no generators, as this policy needs them"),
        ({"policy": "tube", "disturbance": jm.Box([-1.0, -1.0], [1.0, 1.0])},
         "disturbance: takes more than there is of input"),
        ({"policy": "tube", "gain": [[0.0, 0.0]]}, "gain: A . BK has spectral radius"),
        ({"horizon": 2000}, "horizon: needs"),
        ({"disturbance": jm.Box([0.0, 0.0], [0.1, 0.1]), "control_horizon": 2},
         "disturbance: is not symmetric about 0, .* Move its centre w into system.c"),
    ],
)  # fmt: skip
def test_errors(fields, message):
    with pytest.raises(ValueError, match=message):
        jm.solve(robust(**{"policy": "affine", **fields}), [0.0, 0.0])


def test_a_control_horizon_holds_the_plan_of_the_centre():
    """W = [0, 2] as its centre in c and [−1, 1]. The feasible set ends at 1.2722 where the plan is
    held at the centre, by a linear program over all vertices of W × W, and at 1.1780 where it is
    held at w = 0."""
    limits = jm.Box([-1.81], [1.42])
    mpc = jm.MPC(
        jm.LinearSystem([[-1.03]], [[-1.24]], [0.1]), [[1.0]], [[0.1]], 2, states=limits,
        inputs=jm.Box([-0.8], [0.8]), terminal_set=limits, disturbance=jm.Box([-1.0], [1.0]),
        disturbance_matrix=[[0.1]], policy="affine", control_horizon=1,
    )  # fmt: skip
    for x, label in ((1.272, 1), (1.2725, -1)):
        assert jm.map_feasible_set(mpc, [[x]]).label[0] == label
        assert (jm.solve(mpc, [x]).status == jm.Status.SOLVED) == (label == 1)


@pytest.mark.long
def test_policies_stage_by_stage_are_the_best_of_all():
    """Costs are those of the program with all sequences, and the policy keeps all limits under
    them; where that has no policy, none is claimed."""
    mpc, costs = robust("affine"), []
    with enable_x64():
        for x0 in STATES:
            plan, best = jm.mpc.solve_stagewise(mpc, x0), least_cost(mpc, x0)
            costs.append(best)
            if best == np.inf:
                assert plan.status == jm.Status.ITERATION_LIMIT
                continue
            assert plan.solved
            np.testing.assert_allclose(plan.cost, best, rtol=1e-7, atol=1e-8)
            assert worst_rows(mpc, *rolled_out(SYSTEM, plan, sequences(mpc))) < 1e-9
    assert 0 < np.isfinite(costs).sum() < len(costs)


@pytest.mark.slow
@pytest.mark.parametrize(
    "fields",
    [
        {"soft": SOFT},
        RATES,
        {"soft": SOFT, "disturbance": jm.Box([-0.1, -0.1], [0.1, 0.1]), **RATES},
        {"disturbance": jm.sets.Zonotope([0.02, -0.01], [[0.06, 0.02], [-0.03, 0.05]])},
    ],
)
def test_soft_rows_and_rates_stage_by_stage(fields):
    """The least cost is that of DAQP with all vertices."""
    mpc = robust("affine", **{"disturbance": jm.Box([-0.1, -0.05], [0.05, 0.1]), **fields})
    before, costs = np.array([-0.2]), []
    with enable_x64():
        for x0 in np.vstack([STATES[:4] + [0.1, 0.0], [4.5, 1.8]]):
            plan = jm.mpc.solve_stagewise(mpc, x0, previous_input=before)
            costs.append(least_cost_of_affine(mpc, x0, before))
            assert plan.solved == np.isfinite(costs[-1])
            if plan.solved:
                np.testing.assert_allclose(plan.cost, costs[-1], rtol=1e-7)
    assert 3 <= np.isfinite(costs).sum() < len(costs)


@pytest.mark.slow
def test_a_policy_that_is_not_proved_best_keeps_all_limits():
    """After few steps it costs more, and its status tells it from the best one and from none."""
    mpc, x0 = robust("affine"), STATES[1]
    with enable_x64():
        best = least_cost(mpc, x0)
        plan = jm.mpc.solve_stagewise(mpc, x0, solver=jm.ADMM(newton_steps=4))
        none = jm.mpc.solve_stagewise(mpc, [-5.5, 0.0], solver=jm.ADMM(newton_steps=4))
    assert plan.status == jm.Status.INACCURATE
    assert none.status == jm.Status.ITERATION_LIMIT
    assert best + 1e-3 < float(plan.cost) < 2 * best
    assert worst_rows(mpc, *rolled_out(SYSTEM, plan, sequences(mpc))) <= 0
    assert worst_rows(mpc, *rolled_out(SYSTEM, none, sequences(mpc))) > 1e-3


@pytest.mark.slow
def test_long_horizons_stage_by_stage():
    """Two masses and springs over 20 steps, a batch of states and of sizes of W: 1,000 random
    sequences and 1,000 of vertices break no limit; without W the plan is the undisturbed one, and
    no set in another has the lower cost."""
    n, N = 4, 20
    K = 2 * np.eye(2) - np.eye(2, k=1) - np.eye(2, k=-1)
    field = 0.15 * np.block([[np.zeros((2, 2)), np.eye(2)], [-K, -0.1 * np.eye(2)]])
    A = np.linalg.solve(np.eye(n) - field, np.eye(n) + field)
    system = jm.LinearSystem(A, np.array([[0.0], [0.0], [0.3], [0.0]]))
    states, inputs = jm.Box(-2 * np.ones(n), 2 * np.ones(n)), jm.Box([-0.5], [0.5])
    nominal = jm.MPC(system, np.eye(n), 0.01, horizon=N, states=states, inputs=inputs)

    def plan(size, x0):
        W = jm.Box(-size * jnp.ones(n), size * jnp.ones(n))
        return jm.mpc.solve_stagewise(replace(nominal, policy="affine", disturbance=W), x0)

    rng, far = np.random.default_rng(0), np.array([1.6, 0.8, 0.0, 0.0])
    x0s = np.vstack([rng.uniform(-0.7, 0.7, (3, n)), far, far, far])
    sizes = np.array([0.03, 0.03, 0.03, 0.0, 0.015, 0.03])
    with enable_x64():
        plans = jax.jit(jax.vmap(plan))(sizes, x0s)
        least = jax.tree.map(np.asarray, jm.solve(nominal, far))
    assert plans.solved.all()
    costs = np.asarray(plans.cost)[3:]
    np.testing.assert_allclose(costs[0], least.cost, rtol=1e-8)
    np.testing.assert_allclose(plans.inputs[3], least.inputs, atol=1e-6)
    assert np.all(np.diff(costs) > -1e-8)
    inside = rng.uniform(-1, 1, (1000, N, n))
    for i, size in enumerate(sizes):
        one = jax.tree.map(lambda v, i=i: np.asarray(v[i]), plans)
        x, u = rolled_out(system, one, size * np.concatenate([inside, np.sign(inside)]))
        assert np.abs(x[:, :-1]).max() <= 2 + 1e-9 and np.abs(u).max() <= 0.5 + 1e-9


@pytest.mark.long
def test_what_policies_stage_by_stage_do_not_take():
    three = jm.sets.Zonotope([0.0, 0.0], [[0.1, 0.0, 0.1], [0.0, 0.1, 0.1]])
    with pytest.raises(ValueError, match="disturbance: has 3 generators of rank 2"):
        jm.mpc.solve_stagewise(robust("affine", disturbance=three), STATES[0])
    with pytest.raises(ValueError, match="mpc: policy is 'tube'"):
        jm.mpc.solve_stagewise(robust("tube"), STATES[0])
    with pytest.raises(ValueError, match="mpc: of an affine policy is differentiated"):
        jax.grad(lambda x0: jm.mpc.solve_stagewise(robust("affine"), x0).cost)(jnp.zeros(2))
