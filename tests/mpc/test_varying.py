"""Problems whose data differ from step to step: plans beside a quadratic program that is written
down by hand and solved by an active-set method, and derivatives beside differences of its value."""

from dataclasses import replace
from functools import reduce

import daqp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy

import jaxmpc as jm
from jaxmpc.mpc import active_constraints, harden, solve_many, solve_stagewise
from jaxmpc.mpc.condense import condense, prestabilising_gain
from jaxmpc.mpc.first_step import first_step_in
from jaxmpc.mpc.problem import at_stage
from jaxmpc.mpc.steady_state import SteadyStates
from jaxmpc.recursion import recursive_feasibility

n, m, N = 3, 2, 5
X0, BEFORE = np.array([1.0, -0.5, 0.8]), np.array([0.1, 0.2])
EVERY = ("system.A", "system.B", "system.c", "Q", "R", "input_rate_weight", "stage_weights")
LIMITS = ("states.lower", "states.upper", "inputs.upper", "outputs.C", "outputs.D")
LIMITS += ("outputs.upper", "soft.C", "soft.upper", "soft.rho", "soft.quadratic")
LIMITS += ("input_rate_limit",)


pytestmark = pytest.mark.usefixtures("x64_of_module")


def definite(rng, size, count=N):
    M = rng.normal(size=(count, size, size))
    return M @ M.transpose(0, 2, 1) + 0.1 * np.eye(size)


def varying(**more):
    """Return a problem of which everything differs from step to step."""
    rng = np.random.default_rng(1)
    system = jm.LinearSystem(
        np.eye(n) + 0.1 * rng.normal(size=(N, n, n)),
        rng.normal(size=(N, n, m)),
        0.1 * rng.normal(size=(N, n)),
    )
    rows = {"C": rng.normal(size=(N, 1, n)), "D": rng.normal(size=(N, 1, m))}
    given = {
        "system": system, "Q": definite(rng, n), "R": definite(rng, m), "horizon": N,
        "states": jm.Box(-1 - rng.uniform(size=(N, n)), 1 + rng.uniform(size=(N, n))),
        "inputs": jm.Box(np.full(m, -0.4), 0.2 + 0.2 * rng.uniform(size=(N, m))),
        "outputs": jm.Outputs(**rows, upper=1.5 + 0.1 * np.arange(N)[:, None]),
        "soft": jm.Soft(
            rng.normal(size=(N, 1, n)), upper=0.2 + 0.02 * rng.uniform(size=(N, 1)),
            rho=0.3 + 0.1 * rng.uniform(size=(N, 1)), quadratic=rng.uniform(size=(N, 1)),
            stages=tuple(range(1, N + 1)),
        ),
        "input_rate_weight": definite(rng, m),
        "input_rate_limit": 0.3 + 0.1 * rng.uniform(size=(N, m)),
        "terminal_cost": np.eye(n),
        "stage_weights": np.array([1.0, 0.0, 2.0, 1.0, 0.5]),
    }  # fmt: skip
    return jm.MPC(**{**given, **more})


def by_hand(mpc, x0, before):
    """Return the inputs of the plan and its cost: the program in (x_1..x_N, u, slack of soft rows),
    step by step, by another solver."""
    s, Q, R, W = mpc.stage_weights, mpc.Q, mpc.R, mpc.input_rate_weight
    soft, out, limit = mpc.soft, mpc.outputs, mpc.input_rate_limit
    size = N * n + N * m + N
    x = lambda k: slice((k - 1) * n, k * n)
    u = lambda k: slice(N * n + k * m, N * n + (k + 1) * m)
    e = lambda k: slice(N * (n + m) + k - 1, N * (n + m) + k)
    P, q, constant = np.zeros((size, size)), np.zeros(size), s[0] * x0 @ Q[0] @ x0
    A, b, G, h = [], [], [], []

    def rows(kept, parts, *bounds):
        M = np.zeros((len(bounds[0]), size))
        for where, part in parts:
            M[:, where] = part
        kept[0].append(M)
        kept[1].append(bounds[0])

    for k in range(N):
        if k:
            P[x(k), x(k)] += 2 * s[k] * Q[k]
        P[u(k), u(k)] += 2 * (s[k] * R[k] + W[k])
        if k:
            P[u(k - 1), u(k - 1)] += 2 * W[k]
            P[u(k), u(k - 1)] -= 2 * W[k]
            P[u(k - 1), u(k)] -= 2 * W[k]
        else:
            q[u(0)] -= 2 * W[0] @ before
            constant += before @ W[0] @ before
        moved = [(x(k + 1), np.eye(n)), (u(k), -mpc.system.B[k])]
        moved += [(x(k), -mpc.system.A[k])] if k else []
        rows((A, b), moved, mpc.system.c[k] + (0 if k else mpc.system.A[0] @ x0))
        if k:
            rows((G, h), [(x(k), np.eye(n))], mpc.states.upper[k])
            rows((G, h), [(x(k), -np.eye(n))], -mpc.states.lower[k])
        rows((G, h), [(u(k), np.eye(m))], mpc.inputs.upper[k])
        rows((G, h), [(u(k), -np.eye(m))], -mpc.inputs.lower)
        known = 0 if k else out.C[0] @ x0
        parts = [(u(k), out.D[k])] + ([(x(k), out.C[k])] if k else [])
        rows((G, h), parts, out.upper[k] - known)
        last = [(u(k - 1), -np.eye(m))] if k else []
        for sign in (1, -1):
            change = [(where, sign * M) for where, M in [(u(k), np.eye(m)), *last]]
            rows((G, h), change, limit[k] + (0 if k else sign * before))
        rows((G, h), [(x(k + 1), soft.C[k]), (e(k + 1), -np.eye(1))], soft.upper[k])
        rows((G, h), [(e(k + 1), -np.eye(1))], np.zeros(1))
        q[e(k + 1)] += soft.rho[k]
        P[e(k + 1), e(k + 1)] += 2 * soft.quadratic[k]
    P[x(N), x(N)] += 2 * mpc.terminal_cost
    G, h, A, b = np.vstack(G), np.concatenate(h), np.vstack(A), np.concatenate(b)
    # All that keeps the equalities is z + Z w.
    z, Z = np.linalg.lstsq(A, b, rcond=None)[0], scipy.linalg.null_space(A)
    free = np.full(len(h), -1e30)
    found = daqp.solve(
        Z.T @ P @ Z, Z.T @ (P @ z + q), G @ Z, h - G @ z, free, np.zeros(len(h), np.int32)
    )
    assert found[2] == 1
    z = z + Z @ found[0]
    return z[N * n : N * (n + m)].reshape(N, m), z @ P @ z / 2 + q @ z + constant


@pytest.fixture(
    scope="module", params=[pytest.param(jm.solve, marks=pytest.mark.slow), solve_stagewise]
)
def value(request):
    """Return the program mpc → ((a number made of the plan, the plan), its gradient)."""
    weights = np.random.default_rng(5).normal(size=(N, m))

    def loss(mpc):
        plan = request.param(mpc, X0, previous_input=BEFORE)
        return jnp.sum(weights * plan.inputs) + 0.1 * plan.cost, plan

    return jax.jit(jax.value_and_grad(loss, has_aux=True))


@pytest.mark.long
def test_plans_are_those_of_the_program_written_down(value):
    mpc = varying()
    inputs, cost = by_hand(mpc, X0, BEFORE)
    plan = value(mpc)[0][1]
    assert plan.solved
    np.testing.assert_allclose(plan.inputs, inputs, atol=2e-9)
    np.testing.assert_allclose(plan.cost, cost, rtol=1e-9)
    kinds = {c.constraint for c in active_constraints(mpc, plan)}
    assert kinds >= {"input", "rate", "soft"}


def moved(mpc, name, by):
    """Return the problem with the array of this name moved."""
    path = name.split(".")
    part = reduce(getattr, path, mpc) + by
    for depth in reversed(range(len(path))):
        part = replace(reduce(getattr, path[:depth], mpc), **{path[depth]: part})
    return part


@pytest.mark.long
def test_derivatives_are_those_of_differences(value):
    mpc, rng, step = varying(), np.random.default_rng(6), 1e-4
    slope = value(mpc)[1]
    for name in EVERY + LIMITS:
        size = np.shape(reduce(getattr, name.split("."), mpc))
        along = rng.normal(size=size)
        if name in ("Q", "R", "input_rate_weight"):
            along = along + along.transpose(0, 2, 1)
        if name == "stage_weights":  # they are at least 0
            along = np.where(mpc.stage_weights > 0, along, 0.0)
        ends = [float(value(moved(mpc, name, k * step * along))[0][0]) for k in (-2, -1, 1, 2)]
        expected = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * step)
        found = float(np.sum(reduce(getattr, name.split("."), slope) * along))
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-8, err_msg=name)


def test_the_condensed_program_is_the_problem():
    """Its cost and rows, at random inputs, beside a roll-out step by step."""
    mpc, rng = varying(soft=(), prestabilise=False), np.random.default_rng(4)
    c, system = condense(mpc), mpc.system

    def rolled_out(u):
        x, before, J, rows = X0, BEFORE, 0.0, {name: [] for name in ("u", "x", "y", "rate")}
        for k in range(N):
            J += mpc.stage_weights[k] * (x @ mpc.Q[k] @ x + u[k] @ mpc.R[k] @ u[k])
            J += (u[k] - before) @ mpc.input_rate_weight[k] @ (u[k] - before)
            rows["u"] += [u[k]]
            rows["x"] += [x]
            rows["y"] += [mpc.outputs.C[k] @ x + mpc.outputs.D[k] @ u[k]]
            rows["rate"] += [u[k] - before]
            x, before = system.A[k] @ x + system.B[k] @ u[k] + system.c[k], u[k]
        return J + x @ mpc.terminal_cost @ x, np.concatenate([np.ravel(v) for v in rows.values()])

    theta, free = np.append(X0, BEFORE), np.zeros((N, m))
    for u in rng.normal(size=(3, N, m)):
        (J, rows), z = rolled_out(u), u.ravel()
        value = z @ c.P @ z / 2 + (c.F @ theta + c.f) @ z
        np.testing.assert_allclose(value, J - rolled_out(free)[0], rtol=1e-11)
        np.testing.assert_allclose(c.C @ z + c.D @ theta + c.d, rows, atol=1e-12)
    ends = [np.tile(mpc.inputs.lower, N), mpc.states.lower.ravel(), np.full(N, -np.inf)]
    np.testing.assert_array_equal(c.lower, [*np.concatenate(ends), *-mpc.input_rate_limit.ravel()])
    ends = [mpc.inputs.upper, mpc.states.upper, mpc.outputs.upper, mpc.input_rate_limit]
    np.testing.assert_array_equal(c.upper, np.concatenate([np.ravel(v) for v in ends]))


def test_constant_data_with_a_leading_axis_change_nothing():
    one = jm.MPC(
        jm.LinearSystem([[1.2, 0.1], [0, 1.1]], [[0.0], [0.1]], [0.01, 0]), np.eye(2), 0.1, 6,
        jm.Box(-2, 2), jm.Box(-1, 1), terminal_cost=np.eye(2), control_horizon=3,
    )  # fmt: skip
    each = lambda v: np.repeat(np.asarray(v)[None], 6, axis=0)
    system = replace(one.system, A=each(one.system.A), B=each(one.system.B), c=each(one.system.c))
    box = jm.Box(each(one.states.lower), each(one.states.upper))
    same = replace(one, system=system, Q=each(one.Q), R=np.full(6, 0.1), states=box)
    a, b = condense(one), condense(same)
    for name in ("Gamma", "Phi", "phi", "Omega", "P", "F", "f", "C", "D", "d", "lower", "upper"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-12, atol=1e-13)
    # A system that grows has a gain for each of its steps.
    assert np.shape(prestabilising_gain(replace(same, control_horizon=None))) == (6, 1, 2)


ALONE = ("system.A", "system.B", "system.c", "Q", "R", "terminal_cost", "states.upper")


def growing(name, value=None):
    """An unstable problem, and with another value of one of its fields."""
    mpc = jm.MPC(
        jm.LinearSystem([[1.2, 0.1], [0, 1.1]], [[0.0], [0.1]], [0.01, 0]), np.eye(2), [[0.1]], 6,
        jm.Box([-2, -2], [2, 2]), jm.Box([-1], [1]), terminal_cost=np.eye(2),
    )  # fmt: skip
    part, _, field = name.rpartition(".")
    held = getattr(mpc, part) if part else mpc
    if value is None:
        return mpc, np.asarray(getattr(held, field))
    return replace(mpc, **({part: replace(held, **{field: value})} if part else {name: value}))


@pytest.mark.parametrize("name", [name for name in ALONE if name != "terminal_cost"])
def test_one_field_alone_may_differ_from_step_to_step(name):
    """Where it differs by nothing the problem is the same, but for the gain that it has too."""
    one, value = growing(name)
    steps = one.horizon + (name == "states.upper")
    same = growing(name, np.repeat(value[None], steps, axis=0))
    assert np.any(prestabilising_gain(same))
    plain, found = (condense(replace(mpc, prestabilise=False)) for mpc in (one, same))
    for field in ("Gamma", "Phi", "phi", "Omega", "P", "F", "f"):
        wanted = getattr(plain, field)
        np.testing.assert_allclose(getattr(found, field), wanted, rtol=1e-12, atol=1e-13)
    condense(same)


@pytest.mark.long
@pytest.mark.parametrize("name", ALONE)
def test_one_field_alone_may_be_traced(name):
    """The same plan and derivative as of concrete data, of 40 steps of an unstable plant."""
    long = lambda value: replace(growing(name, value), horizon=40)
    if name in ("system.A", "system.B"):  # whose gain is asked for inside a trace
        long = lambda value: replace(growing(name, value), horizon=40, prestabilise=True)
    _, value = growing(name)
    cost, x = lambda value: jm.solve(long(value), x).cost, np.array([0.02, 0.03])
    found, slope = jax.jit(jax.value_and_grad(cost))(value)
    np.testing.assert_allclose(found, cost(value), rtol=1e-8)
    way = np.random.default_rng(0).normal(size=value.shape)
    way = way @ way.T if name in ("Q", "R", "terminal_cost") else way
    apart = (cost(value + 1e-5 * way) - cost(value - 1e-5 * way)) / 2e-5
    np.testing.assert_allclose(np.sum(slope * way), apart, rtol=1e-5, atol=1e-7)


def test_a_gain_for_each_step_changes_rounding_alone():
    mpc = varying(soft=(), outputs=())
    gains = 0.3 * np.random.default_rng(2).normal(size=(N, m, n))
    plain, turned = (condense(replace(mpc, prestabilise=K)) for K in (0 * gains, gains))
    x, u = plain.trajectory(np.append(X0, BEFORE), np.linspace(-1, 1, N * m))
    z = turned.variables(x, u)
    np.testing.assert_allclose(turned.trajectory(np.append(X0, BEFORE), z)[0], x, atol=1e-13)
    np.testing.assert_allclose(turned.trajectory(np.append(X0, BEFORE), z)[1], u, atol=1e-13)


@pytest.mark.slow
def test_controllers_take_what_varies():
    mpc = varying()
    inputs, _ = by_hand(mpc, X0, BEFORE)
    controller = jm.Controller(mpc)
    control = controller(X0, previous_input=BEFORE)
    np.testing.assert_allclose(control.plan.inputs, inputs, atol=2e-9)
    assert np.all(control.u <= mpc.inputs.upper[0])
    np.testing.assert_array_equal(controller.limits.upper, mpc.states.upper[0])


@pytest.mark.slow
def test_batches_and_forecasts_take_what_varies():
    mpc = varying(input_rate_limit=None, input_rate_weight=None)
    plan = jm.solve(mpc, X0)
    many = solve_many(mpc, np.stack([X0, 0.5 * X0]))
    np.testing.assert_allclose(many.inputs[0], plan.inputs, atol=1e-9)
    # A known disturbance is a drift.
    forecast = 0.01 * np.arange(N * n).reshape(N, n)
    moved = replace(mpc, system=replace(mpc.system, c=mpc.system.c + forecast))
    np.testing.assert_allclose(
        jm.solve(mpc, X0, forecast=forecast).inputs, jm.solve(moved, X0).inputs, atol=1e-9
    )
    # A batch of systems, in one program.
    A = np.stack([mpc.system.A, 1.01 * mpc.system.A])
    found = jax.vmap(lambda A: jm.solve(replace(mpc, system=replace(mpc.system, A=A)), X0))(A)
    np.testing.assert_allclose(found.inputs[0], plan.inputs, atol=1e-9)


@pytest.mark.slow
def test_soft_and_hard_limits_that_vary_are_each_others():
    mpc = replace(varying(), soft=())
    soft = jm.soften(mpc, 100.0)
    np.testing.assert_allclose(
        jm.solve(soft, X0, previous_input=BEFORE).inputs,
        jm.solve(mpc, X0, previous_input=BEFORE).inputs, atol=1e-8,
    )  # fmt: skip
    np.testing.assert_allclose(
        jm.solve(harden(soft), X0, previous_input=BEFORE).inputs,
        jm.solve(mpc, X0, previous_input=BEFORE).inputs, atol=1e-8,
    )  # fmt: skip
    rows = jm.Polytope(np.tile(np.eye(n), (N, 1, 1)), mpc.states.upper)
    upper = replace(mpc, states=rows)
    box = replace(mpc, states=jm.Box(np.full(n, -np.inf), mpc.states.upper))
    np.testing.assert_allclose(
        jm.solve(upper, X0, previous_input=BEFORE).inputs,
        jm.solve(box, X0, previous_input=BEFORE).inputs, atol=1e-9,
    )  # fmt: skip
    assert at_stage(rows, 2).h[0] == mpc.states.upper[2, 0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"Q": np.ones((N, n))}, r"Q: shape \(5, 3\).*Q\[:, :, None\] \* np.eye\(3\)"),
        ({"Q": np.ones((4, n, n))}, r"Q: shape \(4, 3, 3\).*5 steps"),
        ({"R": -np.tile(np.eye(m), (N, 1, 1))}, r"R\[0\]: is not positive semidefinite"),
        ({"states": jm.Box(np.zeros((4, n)), np.ones(n))}, r"states.lower: shape \(4, 3\).*5 stag"),
        (
            {"states": jm.Box(np.zeros((N, n)), np.array([[1.0] * n] * 3 + [[-1.0] * n] * 2))},
            "states at k = 3: is empty",
        ),
        ({"input_rate_limit": np.ones((4, m))}, r"input_rate_limit: shape \(4, 2\)"),
        ({"soft": jm.Soft(np.ones((4, 1, n)), upper=[1])}, r"soft\[0\].C: shape \(4, 1, 3\).*6 st"),
        ({"terminal_set": jm.Box(np.zeros((N, n)), np.ones((N, n)))}, "terminal_set.lower: shape"),
        ({"stage_weights": [1, 1, -1, 1, 1]}, "stage_weights: .*at least 0"),
        (
            {"stage_weights": [0, 1, 1, 1, 1], "input_rate_weight": None,
             "system": jm.LinearSystem(np.eye(n), np.zeros((n, m)))},
            "stage_weights: is 0 at k = 0",
        ),
        ({"disturbance": jm.Box(-0.1, 0.1)}, "system.A: differs from step to step, and policies"),
    ],
)  # fmt: skip
def test_wrong_shapes_are_named_before_any_compile(changes, message, compiled):
    compiled.clear()
    with pytest.raises(ValueError, match=message):
        varying(**changes).validate()
    assert not compiled


def test_what_needs_one_problem_says_so():
    mpc = varying(soft=(), input_rate_limit=None, input_rate_weight=None)
    with pytest.raises(ValueError, match=r"system.A: differs from step to step, and recursive"):
        recursive_feasibility(mpc)
    with pytest.raises(ValueError, match=r"A: shape \(5, 3, 3\) is not \(n, n\)"):
        jm.lqr(mpc.system, np.eye(n), np.eye(m))
    with pytest.raises(ValueError, match="system.A: differs from step to step, and a steady"):
        SteadyStates.of(mpc, mpc.system, np.eye(n), np.ones(n))
    with pytest.raises(ValueError, match=r"A: shape \(5, 3, 3\)"):
        first_step_in(mpc, jm.Box(-np.ones(n), np.ones(n)))
    with pytest.raises(ValueError, match="system.A: differs .* closed loops"):
        jm.export.check_fixed_steps(mpc, jm.ADMM(), -np.ones(n), np.ones(n))
