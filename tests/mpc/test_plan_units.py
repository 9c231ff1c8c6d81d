"""A plan, its status and a label do not depend on units: of a row, of a state, of an input.

Rows of limits times s > 0 are the same limits; x' = S x, u' = T u with A' = S A S⁻¹, B' = S B T⁻¹,
Q' = S⁻¹ Q S⁻¹, … is the same problem. All factors are powers of two near 10^±4 and 10^±8, so that
nothing is rounded on the way. What a plan says is judged in NumPy from the problem as stated, in
states and inputs: each equation and limit relative to the absolute terms of its own row, the cost
against Clarabel's. So is what prestabilising changes, which is rounding and no problem.
"""

from dataclasses import replace

import clarabel
import jax
import numpy as np
import pytest
from scipy import linalg, sparse

import jaxmpc as jm

FOUR, EIGHT = 2.0**13, 2.0**27  # near 1e4 and 1e8
HORIZON = 6
INF = np.inf
STATES = np.array([  # inside, at limits, and three beyond what can be steered
    [0.5, 0.2], [-3.0, 0.5], [4.0, -1.9], [1.0, 1.99], [5.0, 0.0], [-4.9, -0.5], [4.5, 1.8],
    [5.1, 0.0], [-2.0, 2.5],
])  # fmt: skip


def limits(H, h, rows):
    """Polytope with rows times `rows`."""
    return jm.Polytope(rows[:, None] * H, rows * h)


def problem(rows=None, S=None, T=None):
    """The double integrator with limits of states (4 rows), inputs (2), an output with the input in
    it (2) and of x_N (4), each row times its number of rows (12,), in the units S (2,), T (1,)."""
    rows = np.ones(12) if rows is None else rows
    S, T = (np.ones(k) if v is None else v for k, v in ((2, S), (1, T)))
    box, pair = np.vstack([np.eye(2), -np.eye(2)]) / S, np.array([[1.0], [-1.0]]) / T
    A, B = np.array([[1.0, 1], [0, 1]]), np.array([[0.5], [1]])
    C, D, side = rows[6:8, None] * np.eye(2) / S, rows[6:8, None] * [[0.0], [0.5]] / T, rows[6:8]
    return jm.MPC(
        jm.LinearSystem(S[:, None] * A / S, S[:, None] * B / T),
        np.diag(1 / S**2), np.diag(0.5 / T**2), HORIZON,
        states=limits(box, np.array([5.0, 2, 5, 2]), rows[:4]),
        inputs=limits(pair, np.ones(2), rows[4:6]),
        outputs=jm.Outputs(C, side * [-INF, -2.2], side * [5.5, 2.2], D),
        terminal_set=limits(box, np.array([1.0, 1, 1, 1]), rows[8:]),
        terminal_cost=np.array([[2.0, 0.5], [0.5, 2.0]]) / S / S[:, None], prestabilise=False,
    )  # fmt: skip


def units(rng, count):
    """(rows, S, T): one row, then all rows, one state, the input, and all of them."""
    yield np.ones(12), np.ones(2), np.ones(1)
    for _ in range(count):
        up = EIGHT ** rng.choice([-1.0, 1.0])
        yield up ** (np.arange(12) == rng.integers(12)), np.ones(2), np.ones(1)
        yield EIGHT ** rng.choice([-1.0, 0.0, 1.0], 12), np.ones(2), np.ones(1)
        yield np.ones(12), up ** np.eye(2)[rng.integers(2)], np.ones(1)
        yield np.ones(12), np.ones(2), np.array([up])
        yield (FOUR ** rng.choice([-1.0, 1.0], k) for k in (12, 2, 1))


class Statement:
    """min Σ x'Qx + u'Ru + x_N'Px_N over w = (x_0, …, x_N, u_0, …): E w = e, lower ≤ G w ≤ upper."""

    def __init__(self, mpc, x0):
        A, B, N = np.asarray(mpc.system.A), np.asarray(mpc.system.B), mpc.horizon
        self.n, m = B.shape
        split = (N + 1) * self.n
        whole = np.eye(split + N * m)
        X, U = whole[:split].reshape(N + 1, self.n, -1), whole[split:].reshape(N, m, -1)
        P = np.zeros_like(A) if mpc.terminal_cost is None else mpc.terminal_cost
        self.H = linalg.block_diag(*[mpc.Q] * N, P, *[mpc.R] * N)
        self.E = np.vstack([X[0], *(X[k + 1] - A @ X[k] - B @ U[k] for k in range(N))])
        self.e = np.append(x0, np.zeros(N * self.n))
        outputs = (mpc.outputs,) if isinstance(mpc.outputs, jm.Outputs) else mpc.outputs
        parts = [(o.C @ X[k] + o.D @ U[k], o.lower, o.upper) for o in outputs for k in range(N)]
        for limit, of in (
            (mpc.states, X[:N]), (mpc.inputs, U), (mpc.terminal_set, X[N:]),
        ):  # fmt: skip
            if limit is not None:
                M, low, high = (np.asarray(v) for v in limit.rows())
                parts.extend((M @ v, low, high) for v in of)
        self.G, self.lower, self.upper = (np.concatenate(v) for v in zip(*parts, strict=True))

    def cost(self, w):
        return w @ self.H @ w

    def violation(self, w):
        """The largest violation of a limit or an equation of the dynamics, relative to the absolute
        terms of its row; of an equation to the largest of its kind along the horizon."""
        value, finite = self.G @ w, lambda v: np.where(np.isfinite(v), np.abs(v), 0.0)
        beyond = np.maximum(np.maximum(self.lower - value, value - self.upper), 0.0)
        terms = np.abs(self.G) @ np.abs(w) + np.maximum(finite(self.lower), finite(self.upper))
        by_state = lambda v: v.reshape(-1, self.n).max(axis=0)
        off = by_state(np.abs(self.E @ w - self.e))
        size = by_state(np.abs(self.E) @ np.abs(w) + np.abs(self.e))
        return max(np.max(beyond / terms), np.max(off / size))

    def best(self):
        """The optimal w: Clarabel's, then the solution of its equations and of the limits that push
        as equations. None where there is none."""
        high, low = np.isfinite(self.upper), np.isfinite(self.lower)
        rows = np.vstack([self.E, self.G[high], -self.G[low]])
        right = np.concatenate([self.e, self.upper[high], -self.lower[low]])
        equal = len(self.e)
        cones = [clarabel.ZeroConeT(equal), clarabel.NonnegativeConeT(len(right) - equal)]
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_gap_abs, settings.tol_gap_rel, settings.tol_feas = 1e-14, 1e-10, 1e-10
        P, q = sparse.csc_matrix(np.triu(2 * self.H)), np.zeros(len(self.H))
        solver = clarabel.DefaultSolver(P, q, sparse.csc_matrix(rows), right, cones, settings)
        answer = solver.solve()
        if str(answer.status) == "PrimalInfeasible":
            return None
        assert str(answer.status) == "Solved"
        push = (np.arange(len(rows)) < equal) | (np.array(answer.z) > np.array(answer.s))
        met, known = rows[push], right[push]
        system = np.block([[2 * self.H, met.T], [met, np.zeros((len(met), len(met)))]])
        answer_w = np.linalg.lstsq(system, np.append(q, known), rcond=1e-14)[0][: len(q)]
        np.testing.assert_allclose(answer_w, answer.x, atol=1e-3 * np.max(np.abs(answer.x)))
        return answer_w


@pytest.fixture(scope="module")
def optima():
    """(statement, optimal w or None) of each of STATES, in the units of the problem as drawn."""
    statements = [Statement(problem(), x0) for x0 in STATES]
    found = [(statement, statement.best()) for statement in statements]
    assert [w is not None for _, w in found] == [True] * 6 + [False] * 3
    return found


def faults_of(plan, mpc, x0, S, T, statement, best, near):
    """What is wrong with a plan for x0, both in the units S, T: sentences."""
    status = jm.Status(int(plan.status))
    if best is None:
        return [] if status == jm.Status.PRIMAL_INFEASIBLE else [status.name]
    if status != jm.Status.SOLVED:
        return [status.name]
    wrong = []
    states, inputs = np.asarray(plan.states, float), np.asarray(plan.inputs, float)
    there = Statement(mpc, x0).violation(np.append(states, inputs))
    w = np.append(states / S, inputs / T)
    off = np.max(np.abs(w - best)) / np.max(np.abs(best))
    optimal = statement.cost(best)
    gaps = [abs(J / optimal - 1) for J in (statement.cost(w), float(plan.cost))]
    for name, value in (("row", there), ("plan", off), ("cost", gaps[0]), ("stated", gaps[1])):
        if not value <= near:
            wrong.append(f"{name} off by {value:.1e}")
    return wrong


def faults(route, count, x64, optima, seed=0):
    """What is wrong in `count` choices of units: a list of (unit, state, sentences)."""
    rng, wrong = np.random.default_rng(seed), []
    near = 1e-6 if x64 else 2e-5
    with jax.enable_x64(x64):
        for k, (rows, S, T) in enumerate(units(rng, count)):
            mpc = problem(rows, S, T)
            plans = route(mpc, STATES * S)
            for i, (plan, pair) in enumerate(zip(plans, optima, strict=True)):
                found = faults_of(plan, mpc, STATES[i] * S, S, T, *pair, near)
                if found:
                    wrong.append((k, i, found))
    return wrong


def solve(mpc, x0s):
    return [jm.solve(mpc, x0) for x0 in x0s]


def solve_many(mpc, x0s):
    plans = jm.solve_many(mpc, x0s)
    return [jax.tree.map(lambda v, i=i: v[i], plans) for i in range(len(x0s))]


def call_controller(mpc, x0s):
    controller = jm.Controller(mpc)
    control, plans = controller.start(x0s[0]), []
    for x0 in x0s:  # each with the last one's plan as a start
        control = controller(x0, control)
        plans.append(control.plan)
    return plans


PRECISIONS = pytest.mark.parametrize("x64", [True, False], ids=["float64", "float32"])


@pytest.mark.slow
@PRECISIONS
def test_plan_in_any_units(x64, optima):
    assert faults(solve, 1, x64, optima) == []


@pytest.mark.slow
@PRECISIONS
@pytest.mark.parametrize("route", [solve, solve_many, call_controller])
def test_many_plans_in_any_units(route, x64, optima):
    assert faults(route, 20, x64, optima, seed=1) == []


def wrong_labels(count, points, seed=0):
    """Labels that differ from the truth, in `count` choices of units: (unit, point, label)."""
    rng = np.random.default_rng(seed)
    x0s = np.vstack([STATES, rng.uniform([-5.5, -2.5], [5.5, 2.5], (points, 2))])
    truth = [1 if Statement(problem(), x0).best() is not None else -1 for x0 in x0s]
    wrong = []
    for k, (rows, S, T) in enumerate(units(rng, count)):
        labels = np.asarray(jm.map_feasible_set(problem(rows, S, T), x0s * S).label)
        wrong += [(k, i, int(labels[i])) for i in np.flatnonzero(labels != truth)]
    return wrong


@pytest.mark.long
@pytest.mark.parametrize(
    ("count", "points"), [(1, 20), pytest.param(10, 100, marks=pytest.mark.slow)]
)
def test_label_in_any_units(count, points):
    assert wrong_labels(count, points) == []


def unstable(seed, n=4):
    """A plant with 0.9 to 1.5 as its largest |eigenvalue|, its inputs within ±1, and states."""
    rng = np.random.default_rng(seed)
    A = np.eye(n) + 0.2 * rng.normal(size=(n, n))
    A *= rng.uniform(0.9, 1.5) / np.max(np.abs(np.linalg.eigvals(A)))
    system = jm.LinearSystem(A, rng.normal(size=(n, 2)))
    mpc = jm.MPC(
        system, np.eye(n), np.eye(2), horizon=30, inputs=jm.Box(-np.ones(2), np.ones(2)),
        terminal_cost=np.eye(n),
    )  # fmt: skip
    return mpc, 5 * rng.normal(size=(2, n))


def excess(mpc, x0, inputs):
    """An upper bound of J(u)/J* − 1 for inputs within ±1 and no other limits; J; and the states of
    the roll-out.

    The bound is that of the dual, J* ≥ D(μ) = min over all u of J + Σ μ'u − |μ|, for the
    multipliers μ ≥ 0 of the inputs that are at a limit where the others are the best ones: μ is −dJ
    by the adjoint equations. Both are LQ problems with linear terms.
    """
    A, B, Q, R = mpc.system.A, mpc.system.B, mpc.Q, mpc.R
    states = rolled(mpc, x0, inputs)
    J = sum(x @ Q @ x + u @ R @ u for x, u in zip(states, inputs, strict=False))
    J += states[-1] @ mpc.terminal_cost @ states[-1]
    held = np.where(np.abs(inputs) > 1 - 1e-6, np.sign(inputs), np.nan)
    best, _ = least(mpc, x0, held, np.zeros_like(inputs))
    at = rolled(mpc, x0, best)
    adjoint, mu = 2 * mpc.terminal_cost @ at[-1], np.zeros_like(best)
    for k in range(len(best))[::-1]:
        push = -(2 * R @ best[k] + B.T @ adjoint)
        mu[k] = np.where(push * held[k] > 0, push, 0.0)
        adjoint = 2 * Q @ at[k] + A.T @ adjoint
    bound = least(mpc, x0, np.full_like(held, np.nan), mu)[1] - np.sum(np.abs(mu))
    return J / bound - 1, J, states


def rolled(mpc, x0, inputs):
    """The states (N+1, n)."""
    states = [x0]
    for u in inputs:
        states.append(mpc.system.A @ states[-1] + mpc.system.B @ u)
    return np.array(states)


def least(mpc, x0, held, mu):
    """The inputs (N, m) that minimise J + Σ μ'u where those of `held` that are not NaN are given,
    and this least value: by the Riccati recursion, x'Sx + 2 s'x + d at each stage."""
    A, B, Q, R = mpc.system.A, mpc.system.B, mpc.Q, mpc.R
    S, s, d, laws = mpc.terminal_cost, np.zeros(len(A)), 0.0, []
    for fixed, linear in zip(held[::-1], mu[::-1], strict=True):
        free = np.isnan(fixed)
        G, K, k = R + B.T @ S @ B, np.zeros(B.T.shape), np.where(free, 0.0, fixed)
        slope = np.column_stack([B.T @ S @ A, G @ k + B.T @ s + linear / 2])[free]
        law = -np.linalg.solve(G[np.ix_(free, free)], slope)
        K[free], k[free] = law[:, :-1], law[:, -1]
        laws.append((K, k))
        d += k @ G @ k + 2 * s @ B @ k + linear @ k
        s = (A + B @ K).T @ (S @ B @ k + s) + K.T @ (R @ k + linear / 2)
        S = Q + K.T @ R @ K + (A + B @ K).T @ S @ (A + B @ K)
    x, inputs = x0, []
    for K, k in laws[::-1]:
        inputs.append(K @ x + k)
        x = A @ x + B @ inputs[-1]
    return np.array(inputs), x0 @ S @ x0 + 2 * s @ x0 + d


def unstable_faults(seeds, n=4):
    """What is wrong with plans of unstable plants, prestabilised and not, that are called SOLVED:
    some are INACCURATE, for states that diverge hide what the inputs do to them."""
    wrong = []
    with jax.enable_x64(True):
        for seed in seeds:
            mpc, x0s = unstable(seed, n)
            for gain in (None, True, False):
                controller = jm.Controller(replace(mpc, prestabilise=gain))
                for plan, x0 in ((controller.plan(x0), x0) for x0 in x0s):
                    status, u = jm.Status(int(plan.status)), np.asarray(plan.inputs)
                    gap, J, states = excess(mpc, x0, np.clip(u, -1, 1))
                    found = {
                        "beyond": np.max(np.abs(u)) - 1, "gap": abs(gap),
                        "states": np.max(np.abs(plan.states - states)) / np.max(np.abs(states)),
                        "cost": abs(float(plan.cost) / J - 1),
                    }  # fmt: skip
                    most = {"cost": 2e-6}  # a square of states
                    found = {k: f"{v:.0e}" for k, v in found.items() if not v <= most.get(k, 1e-6)}
                    right = status == jm.Status.SOLVED and not found
                    if not right and status != jm.Status.INACCURATE:
                        wrong.append((seed, gain, status.name, found))
    return wrong


@pytest.mark.slow
def test_states_that_rest_at_zero():
    """With orthogonal B and equal weights of inputs each state has a move of its own, so that two
    of three states rest, but for rounding, while the first follows its reference."""
    seeds = range(8)
    with jax.enable_x64(True):
        for seed in seeds:
            rng = np.random.default_rng(seed)
            B = np.linalg.qr(rng.standard_normal((3, 3)))[0] * 10.0 ** rng.uniform(-3, 3)
            mpc = jm.MPC(
                jm.LinearSystem(np.diag([1.0, 1.1, 0.9]), B), np.eye(3), np.eye(3), 8,
                states=jm.Box([-2.0] * 3, [2.0] * 3),
            )  # fmt: skip
            aim = np.zeros((9, 3))
            aim[:, 0] = 1.0
            plan = jm.solve(mpc, np.zeros(3), aim)
            assert plan.status == jm.Status.SOLVED, seed
            assert np.abs(plan.states[:, 1:]).max() < 1e-12


@pytest.mark.slow
def test_unstable_plans_prestabilised_or_not():
    """|eigenvalue| of 1.42."""
    assert unstable_faults((0,)) == []


@pytest.mark.slow
def test_many_unstable_plans_prestabilised_or_not():
    assert unstable_faults(range(30)) == []
    assert unstable_faults(range(10), n=8) == []


@pytest.mark.slow
def test_plans_that_rest_at_a_soft_limit():
    """Where the target is the limit and the state next to it, penalties are rounding alone, 1e4
    times that of the states; such plans are those of the hard limit."""
    n, h, rng = 6, 0.01, np.random.default_rng(0)
    pair, zero = np.eye(n), np.zeros((n, n))
    push = np.linalg.inv(0.02 * (pair + 0.3))
    system = jm.LinearSystem(
        np.block([[pair, h * pair], [zero, pair]]), np.vstack([h * h * push, h * push]), dt=h
    )
    weights = np.diag([1.0] * n + [1e-5] * n), 3e-6 * np.eye(n)
    rows, upper = np.hstack([pair, zero]), np.ones(n)
    soft = jm.MPC(system, *weights, 10, soft=jm.mpc.Soft(rows, upper=upper, rho=1e4))
    limits = jm.Outputs(rows, upper=upper, stages=tuple(range(2, 11)))
    hard = jm.MPC(system, *weights, 10, outputs=limits)
    aim = np.append(upper, np.zeros(n))
    with jax.enable_x64(True):
        for _ in range(10):
            below, speed = 10.0 ** rng.uniform(-7, -4), 10.0 ** rng.uniform(-6, -3)
            x0 = aim + np.append(-below * np.abs(rng.normal(size=n)), speed * rng.normal(size=n))
            plan, other = (jm.solve(mpc, x0, reference=aim) for mpc in (soft, hard))
            assert plan.status == other.status == jm.Status.SOLVED
            np.testing.assert_allclose(plan.states, other.states, atol=1e-7)


@pytest.mark.slow
def test_plans_near_a_set_point_are_those_near_zero():
    """A set-point on soft limits, whose inputs carry a load, is a problem without load, moved.
    Near it tracking errors are 1e-12 of states and inputs; the solver is to stop by the former."""
    n, h, rng = 3, 0.01, np.random.default_rng(0)
    M = rng.normal(size=(n, n))
    push = 20 * np.linalg.inv(M @ M.T + 0.1 * np.eye(n))
    A, B = np.eye(2 * n) + h * np.eye(2 * n, k=n), np.vstack([h * h * push, h * push])
    x, u = np.append([1.0, *rng.uniform(-1, 1, 2)], np.zeros(n)), rng.uniform(3, 8, n)
    room = np.array([0.0, 0.0, 1.9, 5, 5, 5])

    def problem(x, u):
        soft = jm.mpc.Soft(np.eye(2 * n), upper=x + room, rho=1e4)
        limits, weights = jm.Box(u - 18.0, u + 4.0), ([100.0] * n + [1.0] * n, [0.01] * n)
        system = jm.LinearSystem(A, B, x - A @ x - B @ u)
        return jm.MPC(system, *weights, 6, inputs=limits, soft=soft)

    with jax.enable_x64(True):
        loaded, free = (jm.Controller(problem(*at)) for at in ((x, u), (0 * x, 0 * u)))
        for off in 10.0 ** np.repeat([-9, -11, -12], 8)[:, None] * rng.normal(size=(24, 2 * n)):
            plan, moved = loaded.plan(x + off, x, None, u), free.plan(off, 0 * x, None, 0 * u)
            assert plan.status == moved.status == jm.Status.SOLVED
            np.testing.assert_allclose(
                plan.inputs - u, moved.inputs, atol=1e-6 * abs(off).max() + 1e-11
            )


@pytest.mark.long
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_unstable_systems_that_differ_from_step_to_step(dtype):
    """Prestabilised, in units up to 2^40 apart: the plan of the inputs themselves."""
    A = np.array([[[1.2, 0.1], [0, 0.9]], [[1.3, 0], [0.2, 0.9]], [[1.1, 0.1], [0, 1.2]]])
    B, Q = np.array([[1.0, 2.0], [0.5, -1.0]]), np.eye(2)
    with jax.enable_x64(dtype == "float64"):
        plans = []
        for k in ([0, 0], [12, 12], [-20, 20], [-20, -20]):
            x = 2.0 ** np.array(k)
            system = jm.LinearSystem(x[:, None] * A / x, x[:, None] * B)
            for prestabilise in (None, False):
                mpc = jm.MPC(
                    system, Q / x / x[:, None], np.eye(2), 3, inputs=jm.Box([-1, -1], [1, 1]),
                    prestabilise=prestabilise,
                )  # fmt: skip
                mpc = jax.tree.map(lambda v: np.asarray(v, dtype), mpc)
                plans.append(jm.solve(mpc, np.asarray(x * [0.7, -0.4], dtype)))
        for plan in plans:
            assert plan.status == jm.Status.SOLVED
            np.testing.assert_allclose(plan.inputs, plans[1].inputs, atol=1e-4)
            np.testing.assert_allclose(plan.cost, plans[1].cost, rtol=1e-4)
