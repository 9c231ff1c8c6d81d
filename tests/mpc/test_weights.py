"""Weights on every route: of one that is not symmetric the symmetric part counts, and R may be
singular where other weights give each input a cost."""

import itertools
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.checks import require_symmetric_psd
from jaxmpc.mpc import NonlinearMPC, Task, solve_nonlinear, solve_stagewise

n, m, N = 2, 2, 4
A, B = np.array([[1.0, 0.3], [-0.1, 0.9]]), np.array([[0.1, 0.0], [0.4, 0.3]])
SYSTEM = jm.LinearSystem(A, B, c=[0.02, -0.01], dt=0.1)
X0, AIM, EFFORT = np.array([1.0, -0.6]), np.array([0.3, 0.1]), np.array([0.1, -0.05])
SOLVER, UNROLLED = jm.ADMM(eps=1e-9), jm.ADMM(200, newton_steps=0, differentiate="unrolled")


pytestmark = pytest.mark.usefixtures("x64_of_module")


def skewed(diagonal, skew):
    """A weight whose symmetric part is the diagonal with `skew` / 4 beside it."""
    return np.diag(diagonal) + skew * np.array([[0.0, 1.0], [-0.5, 0.0]])


WEIGHTS = {
    "Q": skewed([1.0, 0.5], 0.8), "R": skewed([0.2, 0.3], 0.2), "P": skewed([3.0, 2.0], 1.5),
    "W": skewed([0.1, 0.2], 0.15),
}  # fmt: skip


def problem(w, **more):
    return jm.MPC(
        SYSTEM, w["Q"], w["R"], N, states=jm.Box(-2, 2), inputs=jm.Box(-0.8, 0.8),
        terminal_cost=w["P"], **more,
    )  # fmt: skip


def planned(w, **more):
    mpc = problem(w, **more)
    return jm.solve(mpc, X0, AIM, SOLVER, input_reference=EFFORT)


def rates(w):
    return jm.solve(problem(w, input_rate_weight=w["W"]), X0, solver=SOLVER, previous_input=EFFORT)


def controlled(w):
    controller = jm.Controller(problem(w, input_rate_weight=w["W"], control_horizon=2), SOLVER)
    return controller(X0 + 0.1, controller(X0), AIM).plan


def stagewise(w):
    return solve_stagewise(problem(w), X0, AIM, SOLVER, input_reference=EFFORT)


def bent(x, u):
    return jnp.asarray(A) @ x + jnp.asarray(B) @ u + 0.05 * jnp.sin(x)


def nonlinear(w):
    task = Task(lambda point: point.x**2, weight=w["W"], target=np.array([0.2, 0.1]))
    return solve_nonlinear(NonlinearMPC(problem(w), bent, (task,)), X0, AIM)


def robot(w):
    plant = jm.LinearPlant(SYSTEM, jm.Box([-2, -2], [2, 2]), jm.Box([-0.8, -0.8], [0.8, 0.8]))
    mode = jm.RobotController(plant, problem(w), SOLVER, linearize="state")
    return mode(X0, None, AIM).plan


def regulated(w):
    """With the Riccati cost of the weights as terminal cost."""
    P = jm.lqr(SYSTEM, w["Q"], w["R"]).P
    return planned({**w, "P": P}, stage_weights=np.linspace(1, 2, N))


ROUTES = {
    "references": planned, "rates": rates, "controller, blocks": controlled,
    "stagewise": stagewise, "lqr, stage weights": regulated,
    "prestabilised": partial(planned, prestabilise=np.full((m, n), -0.2)),
    "unrolled": lambda w: jm.solve(problem(w), X0, AIM, UNROLLED),
    "nonlinear": nonlinear, "robot": robot,
}  # fmt: skip
symmetrised = partial(jax.tree.map, lambda M: (M + M.T) / 2)


@pytest.mark.first(1)
@pytest.mark.parametrize("name", ROUTES)
@pytest.mark.slow
def test_raw_and_symmetrised_weights_mean_the_same(name):
    """A quadratic form knows the symmetric part alone: plans, costs and derivatives too."""

    @jax.jit
    def program(w):
        plan = lambda w: (lambda p: (p.cost + jnp.sum(p.inputs[0] ** 3), p))(ROUTES[name](w))
        (_, found), gradient = jax.value_and_grad(plan, has_aux=True)(w)
        return found, gradient

    (raw, d_raw), (even, d_even) = program(WEIGHTS), program(symmetrised(WEIGHTS))
    assert raw.status == even.status == jm.Status.SOLVED or name == "unrolled"
    for one, other in zip(
        jax.tree.leaves((raw, d_raw)), jax.tree.leaves((even, d_even)), strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
    for weight, slope in d_raw.items():
        np.testing.assert_allclose(slope, slope.T, rtol=1e-9, atol=1e-12, err_msg=weight)
    assert np.abs(d_raw["Q"]).max() > 1e-3 and np.abs(d_raw["R"]).max() > 1e-4


@pytest.mark.slow
def test_concrete_weights_within_rounding_of_symmetry():
    """What is refused is a visible asymmetry; what is left of it has no effect."""
    tilt = np.array([[0.0, 3e-7], [0.0, 0.0]])
    mpc = problem(symmetrised(WEIGHTS))
    plans = [jm.solve(replace(mpc, Q=mpc.Q + s * tilt), X0, AIM, SOLVER) for s in (1, 0)]
    even = jm.solve(replace(mpc, Q=mpc.Q + (tilt + tilt.T) / 2), X0, AIM, SOLVER)
    np.testing.assert_array_equal(plans[0].inputs, even.inputs)
    assert np.abs(plans[0].inputs - plans[1].inputs).max() > 1e-9
    with pytest.raises(ValueError, match=r"Q: is not symmetric. Use \(Q \+ Q.T\) / 2"):
        jm.solve(replace(mpc, Q=mpc.Q + 1e3 * tilt), X0)


@pytest.mark.parametrize("spread", [0, 10, 50])
def test_units_of_coordinates_decide_nothing_about_definiteness(spread):
    """D M D has the signs of M (Sylvester's law of inertia), and powers of two round nothing."""
    rng = np.random.default_rng(0)
    answers = set()
    for _ in range(100):
        n = int(rng.integers(1, 5))
        root = rng.integers(-2, 3, (int(rng.integers(1, n + 3)), n))
        M = (root.T @ root - int(rng.integers(0, 2)) * np.diag(rng.integers(0, 2, n))).astype(float)
        tilt = np.zeros((n, n))
        tilt[0, -1] = float(rng.integers(0, 2))
        D = 2.0 ** rng.integers(-spread, spread + 1, n)
        # Beside 2^100 a difference may be rounding of 0, and so may all that is not definite.
        for matrix in (M, M + tilt)[: 1 if spread > 10 else 2]:
            signs = np.sign(np.round(np.linalg.eigvalsh((matrix + matrix.T) / 2), 9))
            symmetric = np.array_equal(matrix, matrix.T)
            asked = [(True, np.all(signs > 0)), (False, np.all(signs >= 0))]
            for definite, right in asked[: 1 if spread > 10 else 2]:
                expected = bool(symmetric and right)
                try:
                    require_symmetric_psd("M", D[:, None] * matrix * D, definite=definite)
                    found = True
                except ValueError:
                    found = False
                assert found == expected, (definite, D[:, None] * matrix * D)
                answers.add((definite, expected))
    assert len(answers) == (2 if spread > 10 else 4)


# --- R = 0 -----------------------------------------------------------------------------------


def hessian(mpc):
    """The condensed cost's Hessian by superposition of trajectories, in plain NumPy."""
    A, B = np.asarray(mpc.system.A), np.asarray(mpc.system.B)
    N, (n, m) = mpc.horizon, B.shape
    free = max(mpc.moves) + 1
    roots = []
    root = lambda M: np.linalg.svd(M)[1][:, None] ** 0.5 * np.linalg.svd(M)[2]
    P = np.zeros((n, n)) if mpc.terminal_cost is None else np.asarray(mpc.terminal_cost)
    W = np.zeros(m) if mpc.input_rate_weight is None else np.asarray(mpc.input_rate_weight)
    W = np.diag(W) if W.ndim == 1 else W
    for z in np.eye(free * m):
        u = z.reshape(free, m)[list(mpc.moves)]
        x, terms, before = np.zeros(n), [], np.zeros(m)
        for k in range(N):
            terms += [root(mpc.Q) @ x, root(mpc.R) @ u[k], root(W) @ (u[k] - before)]
            x, before = A @ x + B @ u[k], u[k]
        roots.append(np.concatenate([*terms, root(P) @ x]))
    return np.array(roots) @ np.array(roots).T


R_ZERO = {
    "rates": dict(input_rate_weight=[0.1, 0.1]),
    "rates of one input": dict(input_rate_weight=[0.1, 0.0], terminal_cost=np.eye(2)),
    "states alone": dict(terminal_cost=np.eye(2)),
    "states, no last cost": dict(),
    "blocks": dict(control_horizon=2),
    "blocks, the last alone": dict(control_horizon=(2, 1, 1)),
    "one state": dict(Q=np.diag([1.0, 0.0]), terminal_cost=np.diag([1.0, 0.0])),
    "rates, one state": dict(Q=np.diag([1.0, 0.0]), input_rate_weight=[0.1, 0.1]),
    "R of one input": dict(R=np.diag([0.1, 0.0]), terminal_cost=np.eye(2)),
    "two inputs alike": dict(same=True, terminal_cost=np.eye(2)),
    "two inputs alike, rates": dict(same=True, input_rate_weight=[1e-3, 1e-3]),
    "no cost at all": dict(Q=np.zeros((2, 2))),
}  # fmt: skip


def without_effort(same=False, units=(1.0, 1.0), **fields):
    system = SYSTEM if not same else replace(SYSTEM, B=np.array([[0.1, 0.2], [0.4, 0.8]]))
    fields = {"Q": np.eye(2), "R": np.zeros((2, 2)), **fields}
    for name in ("Q", "terminal_cost"):
        if name in fields:
            fields[name] = fields[name] * units[0]
    if "input_rate_weight" in fields:
        fields["input_rate_weight"] = np.array(fields["input_rate_weight"]) * units[0]
    fields["R"] = fields["R"] * units[0]
    return jm.MPC(system, horizon=N, states=jm.Box(-2, 2), **{"inputs": jm.Box(-0.8, 0.8)} | fields)


@pytest.mark.parametrize("name, unit", list(itertools.product(R_ZERO, (1.0, 1e-9, 1e9))))
def test_singular_R_is_judged_by_the_whole_cost(name, unit):
    """Whether all inputs, or the first alone, are unique, by an eigenvalue computation that shares
    nothing with the check; the unit of the cost plays no part."""
    mpc = without_effort(units=(unit, unit), **R_ZERO[name])
    values, axes = np.linalg.eigh(hessian(mpc))
    free = axes[:, values <= 1e-9 * values[-1]]
    message = "R: is not positive definite, and at k = .*R or in"
    for check, unique in (
        (mpc.require_unique_inputs, not free.size),
        (mpc.validate, np.abs(free[: mpc.system.m]).max(initial=0) < 1e-6),
    ):
        if unique:
            check()
        else:
            with pytest.raises(ValueError, match=message):
                check()


@pytest.mark.slow
def test_tracking_without_an_end_cost():
    """No cost sees the last inputs; the first is unique, the limit of those with some effort."""
    mpc = without_effort(inputs=jm.Box([-0.3, -0.2], [0.3, 0.2]))
    with jax.enable_x64(True):
        plan = jm.solve(mpc, X0)
        near = jm.solve(replace(mpc, R=1e-6 * np.eye(2)), X0)
    assert plan.status == near.status == jm.Status.SOLVED
    np.testing.assert_allclose(plan.inputs[0], near.inputs[0], atol=1e-4)
    assert plan.cost <= near.cost


def test_stages_without_weight_are_the_cause_that_is_named():
    """Not R, which is positive: with three free stages u_0 and u_1 do whatever they like."""
    system = jm.LinearSystem([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]])
    weights = [0.0, 0.0, 0.0, 1.0, 1.0]
    mpc = jm.MPC(system, np.eye(2), 0.1, horizon=5, stage_weights=weights)
    with pytest.raises(
        ValueError, match="stage_weights: is 0 at k = 0, .* Give stage 0 a positive"
    ):
        jm.Controller(mpc)
    jm.Controller(replace(mpc, stage_weights=[1e-3, *weights[1:]]))


@pytest.mark.slow
def test_the_cure_for_a_singular_R_helps():
    mpc = without_effort()
    with pytest.raises(
        ValueError, match=r"k = 3 no other weight gives u1, u2 a cost.* or give a t"
    ):
        solve_stagewise(mpc, X0)
    for cure in (
        {"R": 1e-3 * np.eye(2)},
        {"input_rate_weight": [0.1, 0.1]},
        {"terminal_cost": np.eye(2)},
    ):
        assert jm.solve(replace(mpc, **cure), X0).status == jm.Status.SOLVED
    with pytest.raises(ValueError, match=r"gives u2 a cost"):
        jm.solve(
            without_effort(**R_ZERO["rates of one input"], Q=np.zeros((2, 2)), R=np.diag([1.0, 0])),
            X0,
        )
