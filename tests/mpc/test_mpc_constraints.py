"""Soft rows, outputs, rates, blocked moves, ellipsoids: MPC against programs that keep every
state, input and violation as a variable, written here with numpy and solved by Clarabel or HiGHS.
"""

import functools
import itertools
from dataclasses import replace

import exact
import jax
import numpy as np
import problems
import pytest
import scipy
from jax import enable_x64

import jaxmpc as jm
from jaxmpc.mpc.plan import active_constraints
from jaxmpc.mpc.problem import Outputs, Soft, soften
from jaxmpc.mpc.rows import row_table
from jaxmpc.mpc.steady_state import equilibrium
from jaxmpc.sets.convex_sets import Ellipsoid

ONE, EYE = np.ones(2), np.eye(2)
FINE = jm.ADMM(iterations=300, newton_steps=30, eps=1e-8)


pytestmark = pytest.mark.usefixtures("x64")


class Explicit:
    """The problem in v = (x_0, …, x_N, u_{−1}, u_0, …, u_{N−1}), one row of numbers at a time.

    rows: {(kind, step, name): (h, lower, upper, weights)}, weights = (ρ, quadratic) or None; a
    name that occurs twice at one step gets a number behind it. G v = g: dynamics and blocks.
    """

    def __init__(self, mpc: jm.MPC):
        self.mpc = mpc
        A, B = np.asarray(mpc.system.A, float), np.asarray(mpc.system.B, float)
        (n, m), N = B.shape, mpc.horizon
        self.n, self.m, self.N = n, m, N
        self.size = (N + 1) * n + (N + 1) * m
        self.x = [np.arange(k * n, (k + 1) * n) for k in range(N + 1)]
        self.u = [(N + 1) * n + np.arange((k + 1) * m, (k + 2) * m) for k in range(N)]
        self.before = (N + 1) * n + np.arange(m)
        c = np.zeros(n) if mpc.system.c is None else mpc.system.c
        G, g = [], []
        for k in range(N):
            for i in range(n):
                row = np.zeros(self.size)
                row[self.x[k + 1][i]] += 1
                row[self.x[k]] -= A[i]
                row[self.u[k]] -= B[i]
                G.append(row)
                g.append(c[i])
        self.dynamics = len(G)
        blocks = mpc.control_horizon
        if blocks is not None:
            free = {0, *np.cumsum(blocks)} if isinstance(blocks, tuple) else set(range(blocks))
            for k in range(1, N):
                if k not in free:
                    for i in range(m):
                        row = np.zeros(self.size)
                        row[self.u[k][i]], row[self.u[k - 1][i]] = 1, -1
                        G.append(row)
                        g.append(0.0)
        self.G, self.g = np.array(G), np.array(g)
        self.rows = {}
        self._collect()

    def _add(self, kind, k, names, parts, lower, upper, weights=None):
        """parts: [(places, matrix)]."""
        for i, name in enumerate(names):
            h = np.zeros(self.size)
            for where, M in parts:
                h[where] += np.asarray(M, float)[i]
            key = (kind, k, name)
            if key in self.rows:
                key = (kind, k, f"{name} again")
            weight = None if weights is None else (weights[0][i], weights[1][i])
            self.rows[key] = (h, float(lower[i]), float(upper[i]), weight)

    def _set(self, kind, k, set_, where, names):
        if isinstance(set_, jm.Box):
            eye = np.eye(len(where))
            self._add(kind, k, names, [(where, eye)], set_.lower, set_.upper)
        elif isinstance(set_, jm.Polytope):
            names = set_.labels or [f"{kind} row {i + 1}" for i in range(len(set_.h))]
            below = np.full(len(set_.h), -np.inf)
            self._add(kind, k, names, [(where, set_.H)], below, set_.h)

    def _collect(self):
        mpc, n, m, N = self.mpc, self.n, self.m, self.N
        states = mpc.system.state_names or [f"x{i + 1}" for i in range(n)]
        inputs = mpc.system.input_names or [f"u{i + 1}" for i in range(m)]
        for k in range(N):
            self._set("input", k, mpc.inputs, self.u[k], inputs)
        for k in exact.steps_of(mpc):
            self._set("state", k, mpc.states, self.x[k], states)
        self._set("terminal", N, mpc.terminal_set, self.x[N], states)
        for out in mpc.outputs if isinstance(mpc.outputs, tuple) else (mpc.outputs,):
            names = out.names or [f"output row {i + 1}" for i in range(len(out.C))]
            for k in exact.steps_of(mpc, out):
                parts = [(self.x[k], out.C)] + ([] if out.D is None else [(self.u[k], out.D)])
                self._add("output", k, names, parts, *out.sides)
        limit = mpc.input_rate_limit
        if limit is not None:
            box = isinstance(limit, jm.Box)
            upper = limit.upper if box else np.broadcast_to(limit, m)
            lower = limit.lower if box else -np.broadcast_to(limit, m)
            for k in range(N):
                earlier = self.before if k == 0 else self.u[k - 1]
                parts = [(self.u[k], np.eye(m)), (earlier, -np.eye(m))]
                self._add("rate", k, [f"rate of {name}" for name in inputs], parts, lower, upper)
        for soft in mpc.soft if isinstance(mpc.soft, tuple) else (mpc.soft,):
            p = len(soft.C)
            names = soft.names or [f"soft row {i + 1}" for i in range(p)]
            weights = (np.broadcast_to(soft.rho, p), np.broadcast_to(soft.quadratic, p))
            steps = range(N + (soft.D is None)) if soft.stages is None else soft.stages
            for k in steps:
                parts = [(self.x[k], soft.C)] + ([] if soft.D is None else [(self.u[k], soft.D)])
                self._add("soft", k, names, parts, *soft.sides, weights)

    def keys(self):
        """Row names of the library, made as unique as those here."""
        found, keys = set(), []
        for row in row_table(self.mpc):
            key = (row.kind, row.stage, row.name)
            keys.append((row.kind, row.stage, f"{row.name} again") if key in found else key)
            found.add(key)
        return keys

    def cost(self, reference=None, input_reference=None):
        """(W, w, constant) of v'Wv + w'v + constant."""
        mpc, n, m, N = self.mpc, self.n, self.m, self.N
        r = np.zeros((N + 1, n)) if reference is None else np.broadcast_to(reference, (N + 1, n))
        ur = np.zeros((N, m)) if input_reference is None else input_reference
        ur = np.broadcast_to(ur, (N, m))
        W, w, constant = np.zeros((self.size, self.size)), np.zeros(self.size), 0.0
        terminal = np.zeros((n, n)) if mpc.terminal_cost is None else mpc.terminal_cost
        parts = [(self.x[k], mpc.Q, r[k]) for k in range(N)] + [(self.x[N], terminal, r[N])]
        for where, weight, target in [*parts, *((self.u[k], mpc.R, ur[k]) for k in range(N))]:
            W[np.ix_(where, where)] += weight
            w[where] -= 2 * weight @ target
            constant += target @ weight @ target
        if mpc.input_rate_weight is not None:
            weight = np.asarray(mpc.input_rate_weight, float)
            weight = np.diag(weight) if weight.ndim == 1 else weight
            for k in range(N):
                earlier = self.before if k == 0 else self.u[k - 1]
                difference = np.zeros((m, self.size))
                difference[:, self.u[k]] += np.eye(m)
                difference[:, earlier] -= np.eye(m)
                W += difference.T @ weight @ difference
        return W, w, constant

    def start(self, x0, previous=None):
        """Equality rows that say where the trajectory starts."""
        where = np.concatenate([self.x[0], self.before])
        previous = np.zeros(self.m) if previous is None else previous
        return np.eye(self.size)[where], np.concatenate([x0, previous])

    def solve(
        self, x0, previous=None, reference=None, input_reference=None, relax=None, objective=None
    ):
        """(cost, states, inputs, violations {key: e}, multipliers {key: y}, ball multiplier).

        relax: {(key, "upper" or "lower"): by how much}, (None, "radius") for the ellipsoid.
        objective: v-vector to maximise over the hard rows in place of the cost, x_0 left free.
        Cost is None where there is no solution.
        """
        clarabel, sparse = pytest.importorskip("clarabel"), scipy.sparse.csc_matrix
        relax = relax or {}
        W, w, constant = self.cost(reference, input_reference)
        first, value = self.start(x0, previous)
        if objective is not None:
            W, w, constant = np.zeros_like(W), -objective, 0.0
            first, value = first[self.n :], value[self.n :]
        rows = {key: r for key, r in self.rows.items() if objective is None or r[3] is None}
        soft = [key for key, row in rows.items() if row[3] is not None]
        s = len(soft)
        A, b, what = [], [], []
        for key, (h, lower, upper, weight) in rows.items():
            lower = lower - relax.get((key, "lower"), 0.0)
            upper = upper + relax.get((key, "upper"), 0.0)
            e = np.zeros(s)
            if weight is not None:
                e[soft.index(key)] = -1
            for sign, bound in ((1, upper), (-1, -lower)):
                if np.isfinite(bound):
                    A.append(np.concatenate([sign * h, e]))
                    b.append(bound)
                    what.append((key, sign))
        equal = np.concatenate([self.G, first])
        equal = np.hstack([equal, np.zeros((len(equal), s))])
        G = np.concatenate([equal, np.reshape(A, (-1, self.size + s)),
                            np.hstack([np.zeros((s, self.size)), -np.eye(s)])])  # fmt: skip
        right = np.concatenate([self.g, value, b, np.zeros(s)])
        cones = [clarabel.ZeroConeT(len(equal)), clarabel.NonnegativeConeT(len(b) + s)]
        ball = isinstance(self.mpc.terminal_set, Ellipsoid)
        if ball:
            root = scipy.linalg.sqrtm(np.asarray(self.mpc.terminal_set.P))
            cone = np.zeros((self.n + 1, self.size + s))
            cone[1:, self.x[self.N]] = -root
            radius = np.sqrt(self.mpc.terminal_set.level) + relax.get((None, "radius"), 0.0)
            G = np.concatenate([G, cone])
            right = np.concatenate([right, [radius], np.zeros(self.n)])
            cones.append(clarabel.SecondOrderConeT(self.n + 1))
        pay = np.array([rows[key][3] for key in soft]).reshape(s, 2)
        P = scipy.linalg.block_diag(2 * W, 2 * np.diag(pay[:, 1]))
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-11
        solver = clarabel.DefaultSolver(
            sparse(np.triu(P)), np.concatenate([w, pay[:, 0]]), sparse(G), right, cones, settings
        )
        found = solver.solve()
        if "Infeasible" in str(found.status):
            return None, None, None, {}, {}, 0.0
        assert str(found.status) in ("Solved", "AlmostSolved"), found.status
        v, e = np.array(found.x[: self.size]), found.x[self.size :]
        y = dict.fromkeys(rows, 0.0)
        for (key, sign), push in zip(what, found.z[len(equal) :], strict=False):
            y[key] += sign * push
        return (
            found.obj_val + constant, v[self.x], v[self.u], dict(zip(soft, e, strict=True)), y,
            found.z[len(right) - self.n - 1] if ball else 0.0,
        )  # fmt: skip

    def support(self, direction, previous=None):
        """max direction'x_0 over the feasible set (u_{−1} given)."""
        objective = np.zeros(self.size)
        objective[self.x[0]] = direction
        return -self.solve(np.zeros(self.n), previous, objective=objective)[0]

    def margin(self, fixed):
        """max t such that all hard rows, scaled to length 1, keep t: LP over v. No ellipsoid.

        fixed {place in v: value}; t < 0: infeasible by that much.
        """
        up, b = [], []
        for h, lower, upper, weight in self.rows.values():
            size = np.linalg.norm(h)
            if weight is None:
                up += [np.append(h, size)] * bool(np.isfinite(upper))
                b += [upper] * bool(np.isfinite(upper))
                up += [np.append(-h, size)] * bool(np.isfinite(lower))
                b += [-lower] * bool(np.isfinite(lower))
        equal = np.hstack([self.G, np.zeros((len(self.G), 1))])
        cost = np.zeros(self.size + 1)
        cost[-1] = -1
        bounds = [(fixed[i], fixed[i]) if i in fixed else (None, None) for i in range(self.size)]
        result = scipy.optimize.linprog(
            cost, A_ub=np.array(up), b_ub=b, A_eq=equal, b_eq=self.g, bounds=[*bounds, (None, 10)]
        )
        assert result.status == 0, result.message
        return -result.fun

    def v_of(self, x0, previous, inputs):
        """v of inputs (N, m), rolled out."""
        v = np.zeros(self.size)
        v[self.before] = 0.0 if previous is None else previous
        c = 0.0 if self.mpc.system.c is None else self.mpc.system.c
        x = np.asarray(x0, float)
        for k in range(self.N):
            v[self.x[k]], v[self.u[k]] = x, inputs[k]
            x = self.mpc.system.A @ x + self.mpc.system.B @ inputs[k] + c
        v[self.x[self.N]] = x
        return v


def rated() -> jm.MPC:
    """Rate limits and a full rate weight, outputs with D, an oblique terminal set, drift."""
    return jm.MPC(
        system=jm.LinearSystem(
            np.array([[1.0, 0.4], [-0.1, 0.95]]), np.array([[0.1, 0.3], [0.6, -0.2]]),
            c=np.array([0.02, -0.03]), state_names=("q", "dq"), state_units=("rad", "rad/s"),
            input_names=("torque", "force"), input_units=("N m", "N"),
        ),
        Q=np.array([[3.0, 0.4], [0.4, 1.0]]), R=np.array([[0.3, 0.1], [0.1, 0.2]]), horizon=5,
        states=jm.Box(np.array([-0.5, -0.2]), np.array([0.35, np.inf])),
        inputs=problems.symmetric(0.5, 0.6), terminal_cost=np.array([[4.0, 1.0], [1.0, 3.0]]),
        terminal_set=jm.Polytope(
            np.array([[1.0, 0.5], [-1.0, 0.2], [0.3, 1.0], [0.0, -1.0]]),
            np.array([0.45, 0.5, 0.5, 0.3]), ("right", "left", "top", "bottom"),
        ),
        outputs=(
            Outputs(np.array([[0.5, 1.0]]), np.array([-0.3]), np.array([0.35]),
                    D=np.array([[0.3, -0.4]]), names=("power",), units=("W",)),
            Outputs(np.array([[1.0, -1.0], [1.0, 1.0]]), np.array([-np.inf, -0.9]),
                    np.array([1.1, np.inf]), stages=(2, 5)),
        ),
        input_rate_weight=np.array([[0.5, 0.2], [0.2, 0.4]]),
        input_rate_limit=jm.Box(np.array([-0.3, -0.25]), np.array([0.25, 0.35])),
        soft=Soft(np.array([[1.0, 0.3]]), upper=np.array([0.05]), rho=0.3, quadratic=0.5,
                  D=np.array([[0.2, 0.5]]), stages=(0, 3), names=("reach",), units=("m",)),
    )  # fmt: skip


def blocked() -> jm.MPC:
    """Blocks of moves, a polytope of inputs, limits at some steps, soft rows with and without D."""
    rng = np.random.default_rng(3)
    A = rng.standard_normal((3, 3))
    return jm.MPC(
        system=jm.LinearSystem(
            1.05 * A / np.abs(np.linalg.eigvals(A)).max(), rng.standard_normal((3, 2)) / 2
        ),
        Q=np.diag([2.0, 1.0, 0.5]), R=np.diag([0.2, 0.3]), horizon=6,
        states=problems.symmetric(0.3, 0.4, 0.6),
        inputs=jm.Polytope(
            np.array([[1.0, 1.0], [-1.0, 0.5], [0.2, -1.0], [-1.0, -1.0]]),
            np.array([0.5, 0.6, 0.5, 0.7]), ("sum", "oblique", "floor", "minus sum"),
        ),
        terminal_cost=np.eye(3),
        terminal_set=Ellipsoid(
            np.array([[3.0, 1.0, 0.0], [1.0, 2.0, 0.2], [0.0, 0.2, 1.0]]), 0.15
        ),
        control_horizon=(1, 2, 3), constrained_stages=(2, 3, 6),
        input_rate_weight=np.array([0.1, 0]),
        soft=(
            Soft(np.array([[1.0, 0.0, 0.5], [0.0, -1.0, 0.0]]), upper=np.array([0.2, 0.1]),
                 rho=np.array([0.4, 30.0]), quadratic=np.array([1.0, 0.0]),
                 names=("reach", "height"), units=("m", "m")),
            Soft(np.array([[0.0, 0.0, 1.0]]), upper=np.array([0.15]), rho=0.7,
                 D=np.array([[1.0, 0.0]]), stages=(1, 4)),
        ),
    )  # fmt: skip


def rounded() -> jm.MPC:
    """An ellipsoid at the end of an unstable plant, one-sided outputs, rate limits, a soft row."""
    return jm.MPC(
        system=jm.LinearSystem(
            np.array([[1.2, 0.5], [0.1, 0.9]]), np.array([[0.2, 0.4], [0.8, 0.1]])
        ),
        Q=np.diag([1.0, 2.0]), R=np.diag([0.4, 0.6]), horizon=4,
        inputs=problems.symmetric(0.35, 0.4), terminal_cost=np.array([[2.0, 0.5], [0.5, 1.0]]),
        terminal_set=Ellipsoid(np.array([[3.0, 1.0], [1.0, 2.0]]), 0.3),
        outputs=Outputs(np.array([[-0.6, 0.8]]), np.array([-np.inf]), np.array([0.2]),
                        stages=(1, 2, 4)),
        input_rate_limit=0.5,
        soft=Soft(np.array([[-1.0, 0.0], [0.0, 1.0]]), upper=np.array([0.3, 0.25]), rho=2.0,
                  quadratic=np.array([0.0, 3.0])),
    )  # fmt: skip


PROBLEMS = {"rated": rated, "blocked": blocked, "rounded": rounded}
# Each problem compiles for seconds.
NAMES = ["rated", *(pytest.param(name, marks=pytest.mark.slow) for name in ("blocked", "rounded"))]
ACTIVE = {
    "rated": {"input", "state", "output", "rate", "soft", "terminal"},
    "blocked": {"input", "state", "soft", "terminal"},
    "rounded": {"input", "output", "rate", "soft", "terminal"},
}
COUNT = 14


def instances(mpc):
    """States, previous inputs, references and input references."""
    n, m, N = mpc.system.n, mpc.system.m, mpc.horizon
    rng = np.random.default_rng(11)
    x0 = rng.uniform(-1, 1, (COUNT, n)) * np.linspace(0.2, 1.0, COUNT)[:, None]
    previous = rng.uniform(-0.3, 0.3, (COUNT, m))
    reference = 0.4 * rng.standard_normal((COUNT, N + 1, n))
    effort = 0.2 * rng.standard_normal((COUNT, N, m))
    return x0, previous, reference, effort


@functools.cache
def batch(name):
    """(Explicit, states, previous inputs, references, input references, plans), solved once."""
    mpc = PROBLEMS[name]()
    x0, previous, reference, effort = instances(mpc)
    with enable_x64(True):
        plan = jm.Controller(mpc, FINE).plan
        plans = [
            plan(x, r, None, ur, v)
            for x, v, r, ur in zip(x0, previous, reference, effort, strict=True)
        ]
    plans = jax.tree.map(lambda *v: np.array(v), *plans)
    return Explicit(mpc), x0, previous, reference, effort, plans


def each(name):
    """(Explicit, arguments of `Explicit.solve`, plan) of every solved instance."""
    explicit, x0, previous, reference, effort, plans = batch(name)
    for i in np.flatnonzero(plans.status == jm.Status.SOLVED):
        arguments = (x0[i], previous[i], reference[i], effort[i])
        yield explicit, arguments, jax.tree.map(lambda v, i=i: v[i], plans)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
class TestAnotherSolver:
    def test_row_table(self, name):
        """One entry a row, in the order of the multipliers, with the names of the explicit rows."""
        explicit, *_, plans = batch(name)
        table, keys = row_table(explicit.mpc), explicit.keys()
        assert problems.rows_of(explicit.mpc, plans).shape == (COUNT, len(table))
        flat = [key for key in keys if not key[2].startswith("terminal ellipsoid")]
        assert len(set(flat)) == len(flat) and set(flat) == set(explicit.rows)
        order = ["input", "state", "output", "rate", "soft", "terminal"]
        places = [order.index(row.kind) for row in table]
        assert places == sorted(places)
        for row, key in zip(table, keys, strict=True):
            assert row.soft == (row.kind == "soft")
            if row.kind in ("input", "rate") and explicit.mpc.system.input_units:
                unit = dict(torque="N m", force="N")[row.name.split()[-1]]
                assert row.unit == unit + "/step" * (row.kind == "rate")
            if key in explicit.rows and row.kind == "state":
                assert row.unit == (explicit.mpc.system.state_units or ("",) * 9)[row.index]

    def test_plans(self, name):
        """Status, cost, trajectory and violations."""
        explicit, x0, previous, reference, effort, plans = batch(name)
        solved = 0
        for i in range(COUNT):
            cost, states, inputs, broken, _, _ = explicit.solve(
                x0[i], previous[i], reference[i], effort[i]
            )
            if cost is None:
                assert plans.status[i] == jm.Status.PRIMAL_INFEASIBLE
                continue
            solved += 1
            assert plans.status[i] == jm.Status.SOLVED
            np.testing.assert_allclose(plans.cost[i], cost, rtol=1e-7, atol=1e-7)
            np.testing.assert_allclose(plans.inputs[i], inputs, atol=1e-6)
            np.testing.assert_allclose(plans.states[i], states, atol=1e-6)
            columns = {}  # of Plan.slack, in the order of mpc.soft
            for key in broken:
                columns.setdefault(key[2], len(columns))
            expected = np.zeros((explicit.N + 1, len(columns)))
            for (_, k, label), e in broken.items():
                expected[k, columns[label]] = e
            np.testing.assert_allclose(plans.slack[i], expected, atol=1e-6)
        assert 5 <= solved

    def test_optimality_row_by_row(self, name):
        """Labelled multipliers: signs, complementarity and no gradient left in the free moves."""
        active = set()
        for explicit, (x0, previous, *tracked), plan in each(name):
            W, w, _ = explicit.cost(*tracked)
            v = explicit.v_of(x0, previous, plan.inputs)
            gradient = 2 * W @ v + w
            for key, y in zip(explicit.keys(), problems.rows_of(explicit.mpc, plan), strict=True):
                if key not in explicit.rows:
                    continue
                h, lower, upper, weight = explicit.rows[key]
                gradient = gradient + y * h
                value = h @ v
                if weight is None:
                    assert lower - 1e-7 <= value <= upper + 1e-7
                else:
                    e = max(value - upper, 0.0)
                    assert -1e-7 <= y <= weight[0] + 2 * weight[1] * e + 1e-6
                    if e > 1e-6:
                        assert y == pytest.approx(weight[0] + 2 * weight[1] * e, abs=1e-5)
                if y > 1e-5:
                    assert value >= upper - 1e-6
                if y < -1e-5:
                    assert value <= lower + 1e-6
                if abs(y) > 1e-4:
                    active.add(key[0])
            if isinstance(explicit.mpc.terminal_set, Ellipsoid):
                P, level = explicit.mpc.terminal_set.P, explicit.mpc.terminal_set.level
                push, last = np.linalg.cholesky(P) @ plan.multipliers.terminal, plan.states[-1]
                gradient[explicit.x[-1]] += push
                assert last @ P @ last <= level + 1e-7
                if np.linalg.norm(push) > 1e-5:
                    active.add("terminal")
                    length = np.linalg.norm(push) / np.linalg.norm(P @ last)
                    np.testing.assert_allclose(push, length * P @ last, atol=1e-6)
                    assert last @ P @ last >= level - 1e-6
            # Costates of the dynamics and of the blocks leave nothing in x_1.. and u_0...
            free = np.concatenate([*explicit.x[1:], *explicit.u])
            G = explicit.G[:, free]
            costates = np.linalg.lstsq(G.T, -gradient[free], rcond=None)[0]
            left = gradient[free] + G.T @ costates
            np.testing.assert_allclose(left, 0, atol=1e-6 * (1 + np.abs(gradient).max()))
        assert active >= ACTIVE[name], active

    def test_sensitivity(self, name):
        """dJ*/d(one bound) by central differences of Clarabel's cost, for every active row."""
        seen, checked = set(), 0
        for explicit, arguments, plan in each(name):
            found = active_constraints(explicit.mpc, plan, tolerance=1e-4)
            assert list(found) == sorted(found, key=lambda c: -c.multiplier)
            kinds = {c.constraint for c in found}
            if not found or (kinds <= seen and checked > 20):
                continue
            seen |= kinds
            blocks = explicit.mpc.control_horizon
            y = dict(zip(explicit.keys(), problems.rows_of(explicit.mpc, plan), strict=True))
            for c in found:
                key = (c.constraint, c.stage, c.name)
                names, push = [key], c.multiplier
                if c.bound == "radius":
                    names = [None]
                elif c.constraint == "input" and blocks is not None:
                    # The same row several times: only their sum is determined.
                    ends = np.cumsum(blocks)
                    j = int(np.searchsorted(ends, c.stage, side="right"))
                    names = [("input", k, c.name) for k in range(ends[j] - blocks[j], ends[j])]
                    push = sum(abs(y[k]) for k in names)
                h = 2e-4
                values = [
                    explicit.solve(*arguments, relax={(k, c.bound): s for k in names})[0]
                    for s in (h, -h)
                ]
                if None in values:
                    continue
                slope = (values[1] - values[0]) / (2 * h)
                np.testing.assert_allclose(slope, push, rtol=2e-3, atol=2e-4, err_msg=str(c))
                text = str(c)
                assert f"k = {c.stage}" in text and c.bound in text and c.unit in text
                if c.constraint == "soft":
                    h, _, upper, _ = explicit.rows[key]
                    value = h @ explicit.v_of(*arguments[:2], plan.inputs) - upper
                    assert c.violation == pytest.approx(max(value, 0.0), abs=1e-6)
                checked += 1
        assert checked > 12


class TestActiveConstraints:
    """What needs no plan of its own."""

    @pytest.mark.slow
    def test_a_plan_of_another_problem(self):
        _, *_, plans = batch("rated")
        with pytest.raises(ValueError, match="plan.*Give one plan of mpc"):
            active_constraints(rated(), plans)  # a batch
        with pytest.raises(ValueError, match="plan"):
            active_constraints(blocked(), jax.tree.map(lambda v: v[0], plans))

    @pytest.mark.slow
    def test_multipliers_by_kind(self):
        """The fields of Multipliers are the rows of the table, sorted."""
        for name in ("rated", "blocked"):
            explicit, *_, plans = batch(name)
            table, N = row_table(explicit.mpc), explicit.N
            y = problems.rows_of(explicit.mpc, plans)
            of = lambda kind, table=table, y=y: y[
                :, [i for i, row in enumerate(table) if row.kind == kind]
            ]
            y = plans.multipliers
            flat = lambda parts: np.concatenate([v.reshape(COUNT, -1) for v in parts], axis=1)
            np.testing.assert_array_equal(y.inputs.reshape(COUNT, -1), of("input"))
            np.testing.assert_array_equal(y.states.reshape(COUNT, -1), of("state"))
            np.testing.assert_array_equal(y.terminal, of("terminal"))
            np.testing.assert_array_equal(flat(y.soft), of("soft"))
            assert y.inputs.shape[1] == N
            if name == "rated":
                np.testing.assert_array_equal(flat(y.outputs), of("output"))
                np.testing.assert_array_equal(y.rates.reshape(COUNT, -1), of("rate"))
                assert [v.shape[1:] for v in y.outputs] == [(5, 1), (2, 2)]
            else:
                assert y.states.shape[1:] == (3, 3) and y.rates is None
                assert [v.shape[1:] for v in y.soft] == [(7, 2), (2, 1)]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    ["rated", *(pytest.param(name, marks=pytest.mark.slow) for name in ("blocked", "rounded"))],
)
def test_closed_loop_is_solving_afresh(name):
    """Warm-started samples against Clarabel from the state and the input really applied."""
    explicit, x0, _, reference, effort, plans = batch(name)
    mpc = explicit.mpc
    controller, control, before, samples = jm.Controller(mpc, FINE), None, None, 0
    i = int(np.flatnonzero(plans.status == jm.Status.SOLVED)[1])
    x, r, ur = x0[i], 0.3 * reference[i], 0.3 * effort[i]
    for sample in range(9):
        forced = np.full(explicit.m, 0.05) if sample == 4 else None
        control = controller(
            x, control, r, input_reference=ur,
            previous_input=np.zeros(explicit.m) if sample == 0 else forced,
        )  # fmt: skip
        u, plan, memory = control
        before = before if forced is None else forced
        cost, _, inputs, _, _, _ = explicit.solve(x, before, r, ur)
        if cost is None:
            assert plan.status != jm.Status.SOLVED
            break
        samples += 1
        assert plan.status == jm.Status.SOLVED
        np.testing.assert_allclose(plan.inputs, inputs, atol=1e-6)
        np.testing.assert_allclose(plan.cost, cost, rtol=1e-7, atol=1e-8)
        np.testing.assert_allclose(u, plan.inputs[0], atol=1e-7)
        np.testing.assert_array_equal(memory.inputs, plan.inputs)
        start = controller.shifted(plan)
        jax.tree.map(np.testing.assert_array_equal, start, controller.shifted(memory))
        assert start.inputs.shape == plan.inputs.shape
        assert all(np.isfinite(part).all() for part in start)
        c = 0.0 if mpc.system.c is None else mpc.system.c
        x, before = mpc.system.A @ x + mpc.system.B @ np.asarray(u) + c, np.asarray(u)
    assert samples >= 5


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "rated",
        "rounded",
        "blocked",
    ],
)
def test_shifted_plan_helps(name):
    """Few steps from the shifted plan end closer to the next plan than from nothing."""
    explicit, x0, previous, reference, effort, _ = batch(name)
    mpc = explicit.mpc
    fine, few = jm.Controller(mpc, FINE), jm.Controller(mpc, jm.ADMM(iterations=10, newton_steps=0))
    ratio = []
    for x, v, r, ur in zip(x0, previous, reference, effort, strict=True):
        r, ur = np.tile(r[0], (mpc.horizon + 1, 1)), np.tile(ur[0], (mpc.horizon, 1))
        plan = fine.plan(x, r, None, ur, v)
        u = np.asarray(plan.inputs[0])
        c = 0.0 if mpc.system.c is None else mpc.system.c
        x = mpc.system.A @ x + mpc.system.B @ u + c
        truth = explicit.solve(x, u, r, ur)[2]
        if plan.status != jm.Status.SOLVED or truth is None:
            continue
        error = [
            np.abs(few.plan(x, r, start, ur, u).inputs - truth).max()
            for start in (None, fine.shifted(plan))
        ]
        ratio.append(error[1] / error[0])
    assert len(ratio) >= 4 and np.exp(np.mean(np.log(ratio))) < 0.8, ratio


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rated", "rounded", "blocked"])
def test_solve_many(name):
    """The adaptive driver, previous inputs in the last columns; feasible or not as in truth."""
    mpc = PROBLEMS[name]()
    explicit, x0, previous, *_ = batch(name)
    x = x0 if not mpc.input_in_state else np.concatenate([x0, previous], axis=1)
    found = jm.solve_many(mpc, x, jm.ADMM(eps=1e-8), chunk=16)
    for i in range(COUNT):
        cost, _, inputs, *_ = explicit.solve(x0[i], previous[i] if mpc.input_in_state else None)
        if cost is None:
            assert found.status[i] == jm.Status.PRIMAL_INFEASIBLE
        else:
            assert found.status[i] == jm.Status.SOLVED
            np.testing.assert_allclose(found.cost[i], cost, rtol=1e-7, atol=1e-7)
            np.testing.assert_allclose(found.inputs[i], inputs, atol=1e-6)
    if mpc.input_in_state:
        short = jm.solve_many(mpc, x0[:3], jm.ADMM(eps=1e-8), chunk=16)
        for i in range(3):
            cost = explicit.solve(x0[i])[0]
            assert cost is None or short.cost[i] == pytest.approx(cost, rel=1e-7, abs=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("name", PROBLEMS)
def test_float32(name):
    explicit, x0, previous, reference, effort, plans = batch(name)
    i = int(np.flatnonzero(plans.status == jm.Status.SOLVED)[1])
    with enable_x64(False):
        plan = jm.solve(
            explicit.mpc, x0[i], reference[i], input_reference=effort[i],
            previous_input=previous[i],
        )  # fmt: skip
    assert plan.inputs.dtype == np.float32 and plan.status == jm.Status.SOLVED
    np.testing.assert_allclose(plan.inputs, plans.inputs[i], atol=2e-3)
    np.testing.assert_allclose(plan.slack, plans.slack[i], atol=2e-3)
    np.testing.assert_allclose(plan.cost, plans.cost[i], rtol=1e-3)


@pytest.mark.slow
def test_gradients():
    """dJ*/d(ρ, quadratic, upper) over a batch of states, by differences of Clarabel's cost."""
    soft = Soft(np.array([[1.0, 0.0], [0.0, 1.0]]), upper=np.array([0.25, 0.1]),
                rho=np.array([0.9, 0.5]), quadratic=np.array([0.0, 0.6]),
                D=np.array([[0.0], [0.3]]))  # fmt: skip
    mpc = jm.MPC(
        system=jm.LinearSystem(np.array([[1.0, 0.5], [0.0, 1.0]]), np.array([[0.1], [0.5]])),
        Q=np.eye(2), R=0.1 * np.eye(1), horizon=3, inputs=problems.symmetric(1.0),
        terminal_cost=2 * np.eye(2), soft=soft, input_rate_limit=0.6,
    )  # fmt: skip
    x0 = np.random.default_rng(5).uniform(-0.7, 0.7, (10, 2))

    def cost(weights, x):
        rho, quadratic, upper = weights
        changed = replace(mpc, soft=replace(soft, rho=rho, quadratic=quadratic, upper=upper))
        plan = jm.solve(changed, x, solver=FINE)
        return plan.cost, (plan.status, plan.slack)

    weights = (soft.rho, soft.quadratic, soft.upper)
    (J, (status, slack)), gradients = jax.vmap(
        jax.value_and_grad(cost, has_aux=True), in_axes=(None, 0)
    )(weights, x0)
    assert np.all(status == jm.Status.SOLVED) and np.max(slack) > 0.1
    h, used = 1e-4, 0
    for i in range(len(x0)):
        for j, entry in itertools.product(range(3), range(2)):
            values = []
            for sign in (1, -1, 0):
                changed = [np.array(v) for v in weights]
                changed[j][entry] = max(changed[j][entry] + sign * h, 0.0)
                parts = dict(zip(("rho", "quadratic", "upper"), changed, strict=True))
                values.append(Explicit(replace(mpc, soft=replace(soft, **parts))).solve(x0[i])[0])
            width = 2 * h if weights[j][entry] > 0 else h
            assert J[i] == pytest.approx(values[2], rel=1e-8)
            slope = (values[0] - values[1]) / width
            assert gradients[j][i][entry] == pytest.approx(slope, rel=2e-3, abs=5e-4)
            used += abs(slope) > 1e-2
    assert used > 15


# --- feasible sets -----------------------------------------------------------------------------


def staged() -> jm.MPC:
    """A polytope of two inputs, limits at some steps, outputs with D: exact by elimination."""
    return replace(
        problems.drifting(4), terminal_cost=None, constrained_stages=(1, 3, 4),
        inputs=jm.Polytope(
            np.array([[1.0, 0.5], [-1.0, 1.0], [0.0, -1.0], [-0.5, -1.0], [1.0, 1.0]]),
            np.array([0.4, 0.5, 0.3, 0.35, 0.45]),
        ),
        terminal_set=None,
        outputs=(
            Outputs(np.array([[0.6, -1.0]]), np.array([-0.7]), np.array([0.8]),
                    D=np.array([[0.5, 1.0]]), stages=(0, 2)),
            Outputs(np.array([[1.0, 1.0]]), np.array([-1.2]), np.array([np.inf])),
        ),
        soft=Soft(np.array([[1.0, 0.0]]), upper=np.array([-5.0])),
    )  # fmt: skip


def assert_proofs(mpc, fmap, plans=30, seed=0):
    """Plans in rationals; every cut excludes its point."""
    assert np.isnan(fmap.labels.plan[fmap.label != 1]).all()
    found = np.flatnonzero(fmap.label == 1)
    for i in np.random.default_rng(seed).permutation(found)[:plans]:
        assert exact.keeps_all_rows(mpc, fmap.labels.start[i], fmap.labels.plan[i])
        np.testing.assert_array_equal(fmap.labels.start[i][list(fmap.axes)], fmap.x0s[i])
    for i in np.flatnonzero(fmap.label == -1):
        a, b = (exact.rational(v[i]) for v in (fmap.labels.cut_normal, fmap.labels.cut_offset))
        assert exact.dot(a, exact.rational(fmap.x0s[i])) > b


@pytest.mark.slow
def test_feasible_set_by_elimination():
    mpc = staged()
    polygon = exact.feasible_polygon_by_elimination(mpc)
    corners = np.array([[float(v) for v in p] for p in polygon.vertices])
    low, high = corners.min(axis=0), corners.max(axis=0)
    points = jm.grid(low - 0.2 * (high - low), high + 0.2 * (high - low), (18, 18))
    middle = corners.mean(axis=0)
    near = [middle + (corners - middle) * (1 + s) for s in (1e-3, -1e-3, 1e-6, -1e-6)]
    fmap = jm.map_feasible_set(mpc, np.concatenate([points, *near]), chunk=512).refine(1e-7)
    inside = polygon.contains(fmap.x0s)
    decided = fmap.label != 0
    np.testing.assert_array_equal(fmap.label[decided] == 1, inside[decided])
    assert np.all(polygon.distance(fmap.x0s[~decided]) <= 1e-9)
    assert 30 < inside.sum() < len(inside) - 30
    assert_proofs(mpc, fmap)
    normals, offsets = fmap.cuts()
    for a, b in zip(normals, offsets, strict=True):
        assert polygon.support(a) <= exact.rational(b)
    assert polygon.contains(fmap.bound_point).all()
    lowest, highest = fmap.volume_bounds()
    assert lowest <= polygon.area <= highest and highest - lowest <= 1e-6 * highest


def moving() -> jm.MPC:
    """An ellipsoid at the end, blocked moves, a polytope of inputs and rate limits."""
    return jm.MPC(
        system=jm.LinearSystem(
            np.array([[1.1, 0.3], [-0.2, 0.9]]), np.array([[0.5, 0.1], [0.0, 0.7]]),
            c=np.array([0.02, -0.01]),
        ),
        Q=np.eye(2), R=np.eye(2), horizon=5, states=problems.symmetric(1.0, 0.9),
        inputs=jm.Polytope(
            np.array([[1.0, 0.5], [-1.0, 1.0], [0.0, -1.0], [-0.5, -1.0]]),
            np.array([0.4, 0.5, 0.3, 0.35]),
        ),
        terminal_set=Ellipsoid(np.array([[3.0, 1.0], [1.0, 2.0]]), 0.35),
        control_horizon=(1, 2, 2), input_rate_limit=np.array([0.3, 0.25]),
    )  # fmt: skip


def extremes(explicit, directions, previous):
    """States of the feasible set that are farthest along each direction, by Clarabel."""
    found = []
    for direction in directions:
        objective = np.zeros(explicit.size)
        objective[explicit.x[0]] = direction
        found.append(explicit.solve(np.zeros(2), previous, objective=objective)[1][0])
    return np.array(found)


def circle(count):
    angle = 2 * np.pi * (np.arange(count) + 0.3) / count
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


@pytest.mark.slow
def test_feasible_set_of_rates_blocks_and_ellipsoid():
    """A slice at one previous input: inner ⊂ truth ⊂ outer, labels right close to the boundary."""
    mpc, previous = moving(), np.array([0.15, -0.1])
    explicit = Explicit(mpc)
    directions = circle(60)
    ends = extremes(explicit, directions, previous)
    middle = ends.mean(axis=0)
    shift = np.tile([1e-2, -1e-2, 1e-4, -1e-4, 1e-6, -1e-6], 10)
    near = middle + (ends - middle) * (1 + shift)[:, None]
    points = np.concatenate([near, jm.grid([-1.2, -1.2], [1.2, 1.2], (15, 15))])
    fixed = np.concatenate([[9.0, 9.0], previous])
    fmap = jm.map_feasible_set(mpc, points, axes=(0, 1), fixed=fixed, chunk=512)
    np.testing.assert_array_equal(fmap.label[:60], np.where(shift > 0, -1, 1))
    assert np.sum(fmap.label == 0) == 0
    assert_proofs(mpc, fmap)
    normals, offsets = fmap.cuts()
    # The dual bound of Clarabel is 1e-9 away from its extreme points.
    assert np.all(normals @ ends.T <= offsets[:, None] + 1e-8)
    refined = fmap.refine(1e-4, rounds=8)
    low, high = refined.volume_bounds()
    hull = scipy.spatial.ConvexHull(ends).volume
    assert hull <= high + 1e-9 and high - low <= 2e-3 * high
    reach = np.sum(directions * ends, axis=1)
    inner, outer = refined.inner(), refined.outer()
    assert np.all((inner.vertices() @ directions.T).max(axis=0) <= reach + 1e-8)
    assert np.all((outer.vertices() @ directions.T).max(axis=0) >= reach - 1e-8)
    assert fmap.axis_names == mpc.system.state_labels
    assert Explicit(mpc).n == 2 and fmap.labels.start.shape[1] == 4


@pytest.mark.slow
@pytest.mark.parametrize("view", ["whole", "projection", "slice in (x1, u1)"])
def test_feasible_set_with_previous_input(view):
    """(x, u₋₁) in 4-D, its shadow on x and a slice across both, against one LP a point."""
    mpc = replace(
        moving(), terminal_set=problems.symmetric(0.5, 0.6), inputs=problems.symmetric(0.4, 0.5),
        control_horizon=None, horizon=4,
    )  # fmt: skip
    rng = np.random.default_rng(6)
    explicit = Explicit(mpc)
    for i in range(2):  # a previous input is one that could be applied
        h = np.zeros(explicit.size)
        h[explicit.before[i]] = 1
        limit = mpc.inputs.upper[i]
        explicit.rows["input", -1, f"u{i + 1}"] = (h, -limit, limit, None)
    fixed = None
    if view == "whole":
        axes, points = None, rng.uniform(-1.0, 1.0, (150, 4)) * [1.1, 1.0, 0.8, 0.8]
        places = np.concatenate([explicit.x[0], explicit.before])
    elif view == "projection":
        axes, points = (0, 1), rng.uniform(-1.2, 1.2, (150, 2))
        places = explicit.x[0]
    else:
        axes, points = (0, 2), rng.uniform(-1.0, 1.0, (150, 2))
        fixed = np.array([0.0, 0.3, 0.0, -0.2])
        places = np.array([explicit.x[0][0], explicit.before[0]])
    rest = {} if fixed is None else {explicit.x[0][1]: 0.3, explicit.before[1]: -0.2}
    margin = np.array([
        explicit.margin({**rest, **dict(zip(places, point, strict=True))}) for point in points
    ])  # fmt: skip
    fmap = jm.map_feasible_set(mpc, points, axes=axes, fixed=fixed, chunk=256)
    sure = np.abs(margin) > 1e-7
    np.testing.assert_array_equal(fmap.label[sure], np.where(margin[sure] > 0, 1, -1))
    assert 20 < np.sum(margin > 0) < 140
    assert_proofs(mpc, fmap)
    normals, offsets = fmap.cuts()
    assert np.all(normals @ points[fmap.label == 1].T <= offsets[:, None])
    names = {"whole": 4, "projection": 2, "slice in (x1, u1)": 2}
    assert len(fmap.axis_names) == names[view] and np.sum(sure) > 140


@pytest.mark.slow
@pytest.mark.parametrize("moves", [1, 2, (3, 1, 1)])
def test_feasible_set_of_blocked_moves(moves):
    mpc = replace(moving(), terminal_set=None, input_rate_limit=None, control_horizon=moves)
    explicit = Explicit(mpc)
    points = np.random.default_rng(8).uniform(-1.2, 1.2, (200, 2))
    margin = np.array([
        explicit.margin(dict(zip(explicit.x[0], point, strict=True))) for point in points
    ])  # fmt: skip
    fmap = jm.map_feasible_set(mpc, points, chunk=256)
    sure = np.abs(margin) > 1e-7
    np.testing.assert_array_equal(fmap.label[sure], np.where(margin[sure] > 0, 1, -1))
    assert_proofs(mpc, fmap)
    found = jm.feasible.boundary(mpc, 24)
    for point, t in zip(found.directions, found.outer, strict=True):
        place = dict(zip(explicit.x[0], found.center + t * point, strict=True))
        assert abs(explicit.margin(place)) <= 1e-7
    assert np.all(found.outer - found.inner <= 1e-8)


def test_a_move_that_no_other_row_sees_leaves_the_set_its_inside():
    """The last of blocked moves moves no limited state: beside its own limits stands rounding."""
    mpc = replace(moving(), terminal_set=None, input_rate_limit=None, control_horizon=(3, 1, 1))
    found = jm.feasible.boundary(mpc, 4)
    np.testing.assert_allclose(found.inner, found.outer, rtol=1e-8)


def test_an_ellipsoid_that_is_not_symmetric_in_its_own_units_is_refused():
    """1e-6 beside 1 is no rounding where the coordinates' own entries are 1 and 1e-6."""
    P = np.array([[1.0, 4.9e-7], [-4.9e-7, 1e-6]])
    with pytest.raises(ValueError, match="X_f.P: is not symmetric"):
        Ellipsoid(P, 1.0).validate("X_f")


# --- soften, equilibrium, errors ----------------------------------------------------------------


class TestSoften:
    def test_rows(self):
        """Each finite side of each state, output and terminal row, at the same steps, once."""
        mpc = replace(rated(), input_rate_weight=None)
        hard, soft = Explicit(mpc), Explicit(soften(mpc, 7.0, 0.5))
        kinds = ("state", "output", "terminal")
        expected, found = [], []
        for (kind, k, _), (h, lower, upper, _) in hard.rows.items():
            if kind in kinds:
                expected += [(k, *h, upper)] * bool(np.isfinite(upper))
                expected += [(k, *-h, -lower)] * bool(np.isfinite(lower))
            elif kind == "soft":
                expected.append((k, *h, upper))
        for (kind, k, _), (h, lower, upper, weight) in soft.rows.items():
            assert kind not in kinds
            if kind == "soft":
                assert weight in ((7.0, 0.5), (0.3, 0.5))
                found += [(k, *h, upper)] * bool(np.isfinite(upper))
                found += [(k, *-h, -lower)] * bool(np.isfinite(lower))
        np.testing.assert_allclose(sorted(expected), sorted(found))
        keep = lambda e: {key for key in e.rows if key[0] in ("input", "rate")}
        assert keep(hard) == keep(soft) and keep(hard)
        table = [row for row in row_table(soft.mpc) if row.soft]
        assert {"q", "dq", "right", "power"} <= {row.name for row in table}
        assert {row.unit for row in table if row.name == "q"} == {"rad"}
        assert {row.unit for row in table if row.name == "power"} == {"W"}

    def test_exact_penalty(self):
        """Clarabel: with a dear penalty the softened problem has the hard one's answer."""
        mpc = rated()
        hard, soft = Explicit(mpc), Explicit(soften(mpc, 1e4))
        same = 0
        for arguments in zip(*instances(mpc), strict=True):
            cost, _, inputs, *_ = hard.solve(*arguments)
            softly = soft.solve(*arguments)
            if softly[0] is None:
                assert cost is None
            elif cost is not None:
                np.testing.assert_allclose(softly[2], inputs, atol=1e-5)
                same += 1
            else:
                dear = [e for key, e in softly[3].items() if key[2] != "reach"]
                assert max(dear) > 1e-4
        assert same >= 5

    @pytest.mark.slow
    def test_plans(self):
        """The library's answers of the softened problem, feasible or not."""
        mpc = soften(rated(), 50.0, 2.0)
        explicit, plan = Explicit(mpc), jm.Controller(mpc, FINE).plan
        _, x0, previous, reference, effort, _ = batch("rated")
        broken = 0
        for x, v, r, ur in zip(x0, previous, reference, effort, strict=True):
            cost, _, inputs, violations, *_ = explicit.solve(x, v, r, ur)
            got = plan(x, r, None, ur, v)
            if cost is None:
                assert got.status == jm.Status.PRIMAL_INFEASIBLE
                continue
            assert got.status == jm.Status.SOLVED
            np.testing.assert_allclose(got.cost, cost, rtol=1e-7)
            np.testing.assert_allclose(got.inputs, inputs, atol=1e-6)
            assert np.sum(got.slack) == pytest.approx(sum(violations.values()), abs=1e-5)
            broken += np.sum(got.slack) > 1e-3
        assert broken >= 3


class TestEquilibrium:
    @pytest.mark.parametrize("rounding", [0.1 + 0.2 - 0.3, -1e-17])
    def test_computed_targets_are_those_meant(self, rounding):
        """Rounding in place of 0 in target or c; what is no rounding is refused as before."""
        system = jm.LinearSystem([[1.0, 1], [0, 1]], [[0.5], [1]])
        drifting = replace(system, c=np.array([rounding, -1e-17]))
        for one, target in ((system, [1, rounding]), (drifting, [1.0, 0])):
            x, u = equilibrium(one, target)
            np.testing.assert_allclose([*x, *u], [1, 0, 0], atol=1e-15)
        with pytest.raises(ValueError, match="held by no equilibrium"):
            equilibrium(system, [1, 1e-9])

    def test_random_systems(self):
        """An answer where, and only where, an LP finds one; it holds still, inside the limits. In
        other units of each state, input and output too."""
        found = 0
        for seed in range(200):
            rng = np.random.default_rng(seed)
            n, m = int(rng.integers(1, 6)), int(rng.integers(1, 4))
            p = int(rng.integers(1, min(n, m) + 1))
            A, B, C = (rng.standard_normal(shape) for shape in ((n, n), (n, m), (p, n)))
            drift, target = 0.3 * rng.standard_normal(n), 0.3 * rng.standard_normal(p)
            states = jm.Box(-rng.uniform(0.1, 3, n), rng.uniform(0.1, 3, n))
            inputs = jm.Box(-rng.uniform(0.1, 3, m), rng.uniform(0.1, 3, m))
            if seed % 3 == 0:
                states = None
            M = np.block([[np.eye(n) - A, -B], [C, np.zeros((p, m))]])
            bounds = [(None, None)] * n
            if states is not None:
                bounds = [*zip(states.lower, states.upper, strict=True)]
            bounds += zip(inputs.lower, inputs.upper, strict=True)
            exists = scipy.optimize.linprog(
                np.zeros(n + m), A_eq=M, b_eq=np.concatenate([drift, target]), bounds=bounds
            ).status == 0  # fmt: skip
            found += exists
            units = [np.ones(size) for size in (n, m, p)]
            far = [2.0 ** rng.integers(-40, 41, size) for size in (n, m, p)]
            small = [np.full(n, 2.0**-50), far[1], far[2]]
            for x_unit, u_unit, y_unit in (units, far, small):
                system = jm.LinearSystem(
                    x_unit[:, None] * A / x_unit, x_unit[:, None] * B / u_unit, c=x_unit * drift
                )
                arguments = {
                    "target": y_unit * target,
                    "C": y_unit[:, None] * C / x_unit,
                    "states": states and jm.Box(x_unit * states.lower, x_unit * states.upper),
                    "inputs": jm.Box(u_unit * inputs.lower, u_unit * inputs.upper),
                }
                if not exists:
                    with pytest.raises(ValueError, match="target.*widen the limits"):
                        equilibrium(system, **arguments)
                    continue
                x, u = equilibrium(system, **arguments)
                x, u = x / x_unit, u / u_unit
                size = max(1.0, np.abs([*x, *u]).max())
                np.testing.assert_allclose(A @ x + B @ u + drift, x, rtol=0, atol=1e-8 * size)
                np.testing.assert_allclose(C @ x, target, rtol=0, atol=1e-8 * size)
                assert all(lo <= v <= hi for v, (lo, hi) in
                           zip([*x, *u], bounds, strict=True) if lo is not None)  # fmt: skip
        assert 60 < found < 190

    def test_cost_vanishes_there(self):
        """As references of an MPC the equilibrium has cost zero and stays."""
        mpc = rated()
        x, u = equilibrium(mpc.system, [0.1], C=np.array([[1.0, 0.0]]), inputs=mpc.inputs)
        cost, states, inputs, *_ = Explicit(replace(mpc, soft=())).solve(x, u, x, u)
        assert cost == pytest.approx(0, abs=1e-9)
        np.testing.assert_allclose(states, np.tile(x, (6, 1)), atol=1e-6)
        np.testing.assert_allclose(inputs, np.tile(u, (5, 1)), atol=1e-6)


soft = lambda **k: dict(soft=Soft(**{"C": EYE, "upper": ONE, **k}))
outputs = lambda **k: dict(outputs=Outputs(**{"C": EYE, "lower": -ONE, "upper": ONE, **k}))
# (settings, argument named, cure named)
WRONG = {
    "soft: a number": (dict(soft=3), "soft", "Give a jm.Soft"),
    "soft: a box": (dict(soft=jm.Box(-ONE, ONE)), "soft", "Give a jm.Soft"),
    "soft: a list of numbers": (dict(soft=[3]), "soft", "tuple of them"),
    "second soft": (
        dict(soft=(Soft(EYE, upper=ONE), Soft(EYE, upper=np.ones(3)))),
        r"soft\[1\].upper",
        "bound",
    ),
    "C a vector": (soft(C=ONE), r"soft\[0\].upper", "each row of C"),
    "C of three states": (soft(C=np.eye(3)), r"soft\[0\].C", r"\(p, 2\)"),
    "C of no rows": (soft(C=np.zeros((0, 2)), upper=np.zeros(0)), r"soft\[0\].C", "Give"),
    "C with NaN": (soft(C=EYE * np.nan), r"soft\[0\].C", "finite"),
    "upper too long": (soft(upper=np.ones(3)), r"soft\[0\].upper", "each row of C"),
    "upper NaN": (soft(upper=ONE * np.nan), r"soft\[0\].upper", "inf where there is no limit"),
    "rho negative": (soft(rho=-1.0), r"soft\[0\].rho", "at least 0"),
    "rho infinite": (soft(rho=np.inf), r"soft\[0\].rho", "finite"),
    "rho of three": (soft(rho=np.ones(3)), r"soft\[0\].rho", "one a row"),
    "quadratic negative": (soft(quadratic=[0, -1.0]), r"soft\[0\].quadratic", "at least 0"),
    "quadratic square": (soft(quadratic=EYE), r"soft\[0\].quadratic", "counts the 5 stages"),
    "D": (soft(D=np.ones((2, 3))), r"soft\[0\].D", "One column an input"),
    "D NaN": (soft(D=EYE * np.nan), r"soft\[0\].D", "finite"),
    "stages beyond N": (soft(stages=(0, 5)), r"soft\[0\].stages", "from 0 to 4"),
    "D at N": (soft(D=EYE, stages=(4,)), r"soft\[0\].stages", "from 0 to 3"),
    "stages twice": (soft(stages=(1, 1)), r"soft\[0\].stages", "different"),
    "stages negative": (soft(stages=(-1,)), r"soft\[0\].stages", "from 0"),
    "a mask of rows": (soft(stages=[True, False]), r"soft\[0\].stages", "flatnonzero"),
    "names": (soft(names=("a",)), r"soft\[0\].names", "Give all or none"),
    "units": (soft(units=("a", "b", "c")), r"soft\[0\].units", "Give all or none"),
    "outputs: a number": (dict(outputs=3), "outputs", "Give a jm.Outputs"),
    "outputs: lower > upper": (outputs(lower=2 * ONE), r"outputs\[0\]", "lower <= upper"),
    "outputs: lower too long": (outputs(lower=np.ones(3)), r"outputs\[0\].lower", "each row"),
    "outputs: upper NaN": (outputs(upper=ONE * np.nan), r"outputs\[0\].upper", "inf"),
    "outputs: C": (outputs(C=np.eye(3)), r"outputs\[0\].C", "one column a state"),
    "outputs: D": (outputs(D=ONE), r"outputs\[0\].D", "One column an input"),
    "outputs: D at N": (outputs(D=EYE, stages=(4,)), r"outputs\[0\].stages", "from 0 to 3"),
    "outputs: names": (outputs(names=("a",)), r"outputs\[0\].names", "Give all or none"),
    "stages: a mask": (dict(constrained_stages=(False, True)), "constrained_stages", "mask"),
    "stages: beyond N": (dict(constrained_stages=(5,)), "constrained_stages", "0 to 4"),
    "stages: twice": (dict(constrained_stages=(1, 1)), "constrained_stages", "different"),
    "control_horizon 0": (dict(control_horizon=0), "control_horizon", "Give a number of moves"),
    "control_horizon 5": (dict(control_horizon=5), "control_horizon", "at most 4"),
    "control_horizon 2.0": (dict(control_horizon=2.0), "control_horizon", "Give a number"),
    "control_horizon True": (dict(control_horizon=True), "control_horizon", "Give a number"),
    "control_horizon ()": (dict(control_horizon=()), "control_horizon", "block lengths"),
    "blocks too long": (dict(control_horizon=(2, 3)), "control_horizon", "Make it 4 steps"),
    "a block of 0": (dict(control_horizon=(1, 0, 3)), "control_horizon", "block lengths"),
    "blocks a mask": (dict(control_horizon=[True, 3]), "control_horizon", "block lengths"),
    "blocks and K": (dict(control_horizon=2, prestabilise=np.ones((2, 2))), "prestabilise", "u"),
    "blocks and LQR": (dict(control_horizon=2, prestabilise=True), "prestabilise", "u"),
    "rate weight: a number": (dict(input_rate_weight=1.0), "input_rate_weight", "Give"),
    "rate weight: three": (dict(input_rate_weight=np.ones(3)), "input_rate_weight", "Give"),
    "rate weight < 0": (dict(input_rate_weight=[1.0, -1.0]), "input_rate_weight", "signs"),
    "rate weight, asymmetric": (dict(input_rate_weight=np.array([[1, 2], [0, 1.0]])),
                                "input_rate_weight", "use"),
    "rate limit < 0": (dict(input_rate_limit=-1.0), "input_rate_limit", "limit ≥ 0"),
    "rate limit: three": (dict(input_rate_limit=np.ones(3)), "input_rate_limit", "Box"),
    "rate limit NaN": (dict(input_rate_limit=np.nan), "input_rate_limit", "limit ≥ 0"),
    "rate limit: empty box": (dict(input_rate_limit=jm.Box(ONE, -ONE)), "input_rate_limit",
                              "lower <= upper"),
    "ellipsoid, indefinite": (dict(terminal_set=Ellipsoid(-EYE, 1.0)), "terminal_set.P", "weight"),
    "ellipsoid of three": (dict(terminal_set=Ellipsoid(np.eye(3), 1.0)), "terminal_set", "Bound"),
    "ellipsoid of level 0": (dict(terminal_set=Ellipsoid(EYE, 0.0)), "terminal_set.level", "Give"),
    "inputs in an ellipsoid": (dict(inputs=Ellipsoid(EYE, 1.0)), "inputs", "Box or Polytope"),
    "states in an ellipsoid": (dict(states=Ellipsoid(EYE, 1.0)), "states", "Box or Polytope"),
    "no inputs": (dict(inputs=jm.Polytope(np.array([[1.0, 0], [-1, 0]]), -ONE)), "inputs",
                  "Loosen"),
    "inputs of three": (dict(inputs=jm.Polytope(np.eye(3), np.ones(3))), "inputs", "Bound"),
}  # fmt: skip


def test_numbers_of_steps_may_be_lists_ranges_and_arrays():
    mpc = problems.joint(4)
    cases = (([0, 2], (0, 2)), (range(1, 3), (1, 2)), (np.arange(2), (0, 1)), (3, (3,)))
    for given, stages in cases:
        rows = replace(mpc, constrained_stages=given)
        assert rows.constrained_stages == stages and jm.Outputs(EYE, stages=given).stages == stages
        assert jm.Soft(EYE, stages=given).stages == stages
        rows.validate()
    assert replace(mpc, control_horizon=np.array(4)).control_horizon == 4
    for given in ([1, 3], np.array([1, 3])):
        blocks = replace(mpc, control_horizon=given)
        blocks.validate()
        assert blocks.control_horizon == (1, 3)


@pytest.mark.parametrize("name", WRONG)
def test_wrong_problems_name_the_argument_and_the_cure(name):
    settings, argument, cure = WRONG[name]
    with pytest.raises(ValueError, match=rf"^{argument}: .*\. .*{cure}"):
        jm.solve(replace(problems.drifting(4), **settings), np.zeros(2))


def test_wrong_arguments():
    mpc, system = problems.drifting(4), problems.drifting().system
    terminal_is_ball = replace(mpc, terminal_set=Ellipsoid(EYE, 1.0))
    far = dict(C=EYE, inputs=jm.Box(-ONE, ONE))
    for call, words in (
        (lambda: soften(terminal_is_ball, 10.0), "^terminal_set: .*Polytope inside"),
        (lambda: soften(replace(mpc, horizon=0), 10.0), "^horizon: "),
        (lambda: equilibrium(system, [1.0]), "^target: .*each row of C"),
        (lambda: equilibrium(system, [1.0, np.nan]), "^target: .*finite"),
        (lambda: equilibrium(system, [1.0], C=np.ones((1, 3))), "^C: .*one column a state"),
        (lambda: equilibrium(system, [1.0], C=ONE), r"^C: .*\(p, 2\)"),
        (lambda: equilibrium(system, ONE, states=jm.Polytope(EYE, ONE)), "^states: .*Give a Box"),
        (lambda: equilibrium(system, ONE, inputs=3), "^inputs: .*Give a Box"),
        (lambda: equilibrium(system, ONE, inputs=jm.Box(-np.ones(3), np.ones(3))), "^inputs: "),
        (lambda: equilibrium(system, [9.0, 9.0], **far), "^target: .*closest.*widen the limits"),
    ):
        with pytest.raises(ValueError, match=words):
            call()


def test_wrong_references():
    controller, x = jm.Controller(rated(), FINE), np.zeros(2)
    for settings, words in (
        (dict(reference=np.zeros(3)), r"^reference: .*\(6, 2\)"),
        (dict(input_reference=np.zeros((6, 2))), r"^input_reference: .*\(5, 2\)"),
        (dict(previous_input=np.zeros(3)), r"^previous_input: .*\(2,\)"),
    ):
        with pytest.raises(ValueError, match=words):
            controller(x, **settings)
