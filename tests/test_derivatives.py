"""First and second derivatives of public functions, against differences.

All numbers that a function takes move at once, each along a random direction of its own, by t. What
it gives is one number F(t) of all its results. F'(t) by reverse and by forward mode, and F''(t),
forward and reverse over reverse and reverse over forward, are compared with differences of F and of
F'. Nothing here knows how the derivatives are made: a part of the data that they take for constant
is found.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.closed_loop import KalmanFilter, LinearFeedback, Noise
from jaxmpc.feasible import feasible_fraction
from jaxmpc.mpc import NonlinearMPC, Task, solve_nonlinear, solve_stagewise
from jaxmpc.qp import feasibility_margin
from jaxmpc.tuning import MPCLayer

TIGHT = jm.ADMM(eps=1e-10)
A, B = [[1, 0.1], [0.2, 1]], [[0.1], [0.6]]
AT, REFERENCE = [1.4, -0.4], [0.3, 0.1]


class Moved:
    """Numbers at t of lines through the given ones; each call has a direction of its own."""

    def __init__(self, t):
        self.t, self.calls = t, 0

    def __call__(self, value, size=0.3):
        self.calls += 1
        v = np.asarray(value, float)
        direction = np.random.default_rng(self.calls).normal(size=v.shape)
        if v.ndim > 1 and v.shape[-1] == v.shape[-2]:
            direction = (direction + np.swapaxes(direction, -1, -2)) / 2
        return jnp.asarray(v) + self.t * size * np.abs(v) * direction


def summed(tree):
    """One number of all floating-point results, which grows slowly with large ones."""
    total = jnp.zeros(())
    for i, leaf in enumerate(jax.tree.leaves(tree)):
        if jnp.issubdtype(jnp.asarray(leaf).dtype, jnp.floating):
            weights = np.random.default_rng(100 + i).normal(size=jnp.shape(leaf))
            total = total + jnp.sum(weights * jnp.arcsinh(leaf))
    return total


def system(m):
    return jm.LinearSystem(m(A), m(B), c=m([0.01, -0.02]), dt=0.1)


def problem(m, **more):
    return jm.MPC(**{
        "system": system(m), "Q": m([[1.0, 0.1], [0.1, 0.5]]), "R": m([[0.1]]), "horizon": 3,
        "states": jm.Box(m([-2.0, -2.0]), m([2.0, 2.0])), "inputs": jm.Box(m([-0.6]), m([0.5])),
        "terminal_cost": m([[2.0, 0.2], [0.2, 1.0]]), **more,
    })  # fmt: skip


def found(plan):
    return plan.states, plan.inputs, plan.cost, plan.slack, plan.multipliers


def run(loop):
    return loop.states, loop.inputs


FIELDS = {
    "plain": lambda m: {},
    "soft": lambda m: {
        "soft": jm.Soft(m([[1.0, 0.2]]), upper=m([0.5]), rho=m(3.0), quadratic=m(1.0))
    },
    "rates": lambda m: {"input_rate_weight": m([[0.3]]), "input_rate_limit": m([0.3])},
    "outputs": lambda m: {
        "outputs": jm.Outputs(m([[1.0, 1.0]]), m([-0.9]), m([0.8]), D=m([[0.4]]))
    },
    "varying": lambda m: {
        "system": jm.LinearSystem(m([A] * 3), m([B] * 3), c=m([[0.01, -0.02]] * 3)),
        "Q": m([np.eye(2)] * 3), "stage_weights": m([1.0, 0.5, 2.0]),
        "inputs": jm.Box(m([[-0.5], [-0.4], [-0.3]]), m([[0.5]] * 3)),
    },
    "polytope": lambda m: {
        "states": jm.Polytope(m([[1.0, 1.0], [-1, 0.5], [0, -1]]), m([1.6, 2.0, 1.0]))
    },
    "prestabilised": lambda m: {"prestabilise": True},
    "moves": lambda m: {"control_horizon": 2},
}  # fmt: skip
ROBUST = {
    policy: lambda m, policy=policy: {
        "disturbance": jm.Box(m([-0.02, -0.01]), m([0.02, 0.03])), "policy": policy,
    }
    for policy in ("tightened", "affine")
}  # fmt: skip


def linear(solve, fields, **options):
    def function(m):
        aim = {"reference": m(REFERENCE), "input_reference": m([0.05])}
        mpc = problem(m, **fields(m))
        if mpc.input_in_state:
            aim["previous_input"] = m([0.1])
        return found(solve(mpc, m(AT), **aim, **options))

    return function


def model(m):
    """A model that is a function of numbers that move."""
    p = m([1.0, 1.0, 1.0])
    return lambda x, u: jnp.stack([
        x[0] + 0.1 * x[1] * p[0],
        x[1] + 0.1 * u[0] * p[1] + 0.1 * jnp.sin(p[2] * x[0]) + 0.02 * u[0] * x[0] ** 2,
    ])  # fmt: skip


def task(m, **limits):
    c = m([0.2, 0.4, 1.0])
    return Task(lambda at: jnp.sum((at.x - c[:2]) ** 2) * c[2] + 0.1 * at.u**2, **limits)


def nonlinear(fields, tasks):
    def function(m):
        mpc = problem(m, **fields(m))
        aim = {"previous_input": m([0.1])} if mpc.input_in_state else {}
        plan = solve_nonlinear(
            NonlinearMPC(mpc, model(m), tasks(m)), m(AT), m(REFERENCE), solver=TIGHT, **aim
        )
        return found(plan)

    return function


def loop(controller, steps=3, plant=system, start=AT, **conditions):
    def function(m):
        given = {name: value(m) for name, value in conditions.items()}
        return run(jm.simulate(controller(m), plant(m), m(start), steps, **given))

    return function


def tracked(m):
    return NonlinearMPC(problem(m), model(m), (task(m, weight=m([[1.0]])),))


def program(m):
    rows, above = m([[1.0, 1.0], [1.0, -1.0], [0.3, 1.0]]), m([0.4, 0.5, 2.0])
    return jm.QP(m([[2.0, 0.3], [0.3, 1.0]]), m([1.0, -2.0]), rows, m([-1.0, -0.5, -2.0]), above)


def learned(m):
    with jax.ensure_compile_time_eval():
        given = problem(lambda v: np.asarray(v, float))
        layer = MPCLayer(given, learn=("Q", "R", "A", "inputs.upper"))
        first = jax.tree.map(np.asarray, layer.init())
    theta = jax.tree.map(lambda v: m(v + 0.1), first)
    return found(layer(theta, m(AT)).plan)


def law(m):
    found = jm.lqr(system(m), m([[1.0, 0.1], [0.1, 0.5]]), m([[0.1]]))
    return found.K, found.P


def fraction(m):
    starts = m([[1.4, -0.4], [1.9, 1.9], [2.1, 0.0], [-1.0, 0.3]])
    return feasible_fraction(problem(m, **FIELDS["outputs"](m)), starts, m(0.2))


def filtered(m):
    noise = Noise(process=m([0.01, 0.01]), measurement=m([0.05]), seed=1)
    observer = KalmanFilter(system(m), m([0.01, 0.02]), m([0.05]), C=m([[1.0, 0.2]]))
    return loop(lambda m: jm.Controller(problem(m)), noise=lambda m: noise,
                observer=lambda m: observer)(m)  # fmt: skip


def loss(m):
    box = jm.Box(m([-1.0, -1.0]), m([1.2, 1.1]))
    terms = jm.ClosedLoopLoss(m([[1.0, 0.1], [0.1, 1.0]]), m([[0.1]]), m(REFERENCE), limits=box,
                              violation=m(3.0), settling=m(2.0), band=m([0.05, 0.1]))  # fmt: skip
    return terms(jm.simulate(jm.Controller(problem(m)), system(m), m(AT), 3))


TASKS = {
    "weight": lambda m: (task(m, weight=m([[1.0]]), target=m([0.1])),),
    "limit": lambda m: (task(m, lower=m([0.5]), upper=m([0.9]), rho=m(0.2)),),
}
CASES = {
    "lqr": law,
    "qp": lambda m: jm.solve_qp(program(m)).z,
    "affine in a loop": loop(
        lambda m: jm.Controller(problem(m, horizon=2, **ROBUST["affine"](m))), 1, start=[0.6, -0.2]
    ),
    "soft": linear(jm.solve, FIELDS["soft"]),
    "soft, stagewise": linear(solve_stagewise, FIELDS["soft"]),
    **{name: linear(jm.solve, fields) for name, fields in FIELDS.items() if name != "soft"},
    **{
        f"{name}, stagewise": linear(solve_stagewise, FIELDS[name])
        for name in ("plain", "rates", "outputs", "varying")
    },
    **{name: linear(jm.solve, fields) for name, fields in ROBUST.items()},
    "unrolled": linear(
        jm.solve, FIELDS["plain"], solver=jm.ADMM(40, newton_steps=0, differentiate="unrolled")
    ),
    **{
        f"nonlinear, {name}": nonlinear(FIELDS[name], lambda m: ())
        for name in ("plain", "soft", "rates")
    },
    **{f"task, {name}": nonlinear(FIELDS["plain"], tasks) for name, tasks in TASKS.items()},
    "loop": loop(lambda m: jm.Controller(problem(m)), reference=lambda m: m(REFERENCE)),
    "loop, delay": loop(
        lambda m: jm.Controller(problem(m, **FIELDS["rates"](m))), delay=lambda m: 1
    ),
    "loop, real-time iteration": loop(
        lambda m: jm.NonlinearController(tracked(m), solver=TIGHT, sqp_steps=1), plant=model
    ),
    "loop, nonlinear": loop(
        lambda m: jm.NonlinearController(tracked(m), solver=TIGHT), 2, plant=model
    ),
    "loop, filter": filtered,
    "loop, feedback": loop(lambda m: LinearFeedback(problem(m), m([[-1.0, -1.5]]))),
    "loss": loss,
    "fraction": fraction,
    "margin": lambda m: feasibility_margin(replace(program(m), q=jnp.zeros(2)))[0],
    "layer": learned,
}


# Up to JAX 0.11 their gradients have no gradient (docs/limits.md).
NO_GRADIENT_TWICE = ("loop", "loop, delay", "loss") if jax.__version_info__ < (0, 12) else ()


@pytest.mark.long
@pytest.mark.parametrize("name", CASES)
@pytest.mark.first(2)
def test_derivatives_of_all_data_at_once(name):
    function = lambda t: summed(CASES[name](Moved(t)))
    along = lambda f: lambda t: jax.jvp(f, (t,), (1.0,))
    value, slope = jax.jit(function), jax.jit(jax.grad(function))

    def difference(f, h=1e-3, t=0.02):
        each = [(float(f(t + s)) - float(f(t - s))) / (2 * s) for s in (h, h / 2)]
        return (4 * each[1] - each[0]) / 3  # without the error of the order h²

    with jax.enable_x64(True):
        forward = float(jax.jit(along(function))(0.02)[1])
        reverse, second = map(float, jax.jit(along(jax.grad(function)))(0.02))
        np.testing.assert_allclose(forward, reverse, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(reverse, difference(value), rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(second, difference(slope), rtol=1e-5, atol=1e-7)
        for backward in (slope, lambda t: along(function)(t)[1]):
            if backward is slope and name in NO_GRADIENT_TWICE:
                with pytest.raises(ValueError, match="Linearization failed to produce"):
                    jax.jit(jax.grad(backward))(0.02)
                continue
            again = jax.jit(jax.grad(backward))(0.02)
            np.testing.assert_allclose(again, second, rtol=1e-7, atol=1e-9)
