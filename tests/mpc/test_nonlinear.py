"""Nonlinear MPC by sequential quadratic programming, against other solvers and finite
differences."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from problems import unstable_systems
from scipy.optimize import minimize

import jaxmpc as jm
from jaxmpc.mpc import NonlinearMPC, Task, solve_nonlinear, solve_stagewise
from jaxmpc.mpc.plan import WarmStart

SOLVED = jm.Status.SOLVED
CART, POLE, LENGTH, GRAVITY = 1.0, 0.1, 0.8, 9.81


class Pendulum:
    """A pendulum on a cart, one step of 0.05 s by the classical Runge-Kutta method."""

    def __init__(self, length):
        self.length = length

    def step(self, x, u):
        h = 0.05
        k1 = self.rate(x, u)
        k2 = self.rate(x + h / 2 * k1, u)
        k3 = self.rate(x + h / 2 * k2, u)
        return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + self.rate(x + h * k3, u))

    def rate(self, x, u):
        s, c = jnp.sin(x[1]), jnp.cos(x[1])
        common = CART + POLE - POLE * c**2
        push = -POLE * self.length * s * x[3] ** 2
        return jnp.stack([
            x[2], x[3], (push + POLE * GRAVITY * c * s + u[0]) / common,
            (push * c + u[0] * c + (CART + POLE) * GRAVITY * s) / (self.length * common),
        ])  # fmt: skip


jax.tree_util.register_pytree_node(
    Pendulum, lambda p: ((p.length,), None), lambda _, leaves: Pendulum(*leaves)
)


def swing_up(length=LENGTH, horizon=20):
    """The swing-up of acados' getting-started example."""
    system = jm.LinearSystem(np.eye(4), np.zeros((4, 1)))
    W = np.diag([1e3, 1e3, 1e-2, 1e-2])
    mpc = jm.MPC(system, 0.05 * W, 0.05 * np.eye(1) * 1e-2, horizon, inputs=jm.Box([-80.0], [80.0]),
                 terminal_cost=W)  # fmt: skip
    return NonlinearMPC(mpc, Pendulum(length))


def around(steps=8, **fields):
    """A point that walks in the plane past a disc of radius 1, to (2, 0.3) from (−2, 0)."""
    system = jm.LinearSystem(np.eye(2), np.eye(2))
    mpc = jm.MPC(system, 0.1 * np.eye(2), np.eye(2), steps, inputs=jm.Box([-2.0, -2.0], [2.0, 2.0]),
                 terminal_cost=50 * np.eye(2))  # fmt: skip
    far = Task(squared, lower=1.0, rho=None, name="disc")
    return NonlinearMPC(mpc, bent, (replace(far, **fields),))


# Programs are compiled once for each function.
def squared(at):
    return at.x @ at.x


def bent(x, u):
    return x + u + 0.05 * jnp.sin(x[::-1])


def wavy(size, x, u):
    return x + u + size * jnp.sin(x[::-1])


def mixed(at):
    return jnp.stack([jnp.sin(at.x[0]), at.x[1] * at.u[0]])


def product(at):
    return jnp.stack([at.x[0] * at.x[1], jnp.sin(at.x[1])])


GOAL, START = np.array([2.0, 0.3]), np.array([-2.0, 0.1])


class TestSolution:
    """Plans are those of independent solvers."""

    @pytest.mark.slow
    def test_a_linear_model_needs_one_qp(self, x64):
        rng = np.random.default_rng(0)
        A, B = np.eye(3) + 0.1 * rng.normal(size=(3, 3)), rng.normal(size=(3, 2))
        system = jm.LinearSystem(A, B, 0.1 * rng.normal(size=3))
        states = jm.Box(-np.ones(3), np.ones(3))
        mpc = jm.MPC(system, np.eye(3), np.eye(2), 10, states=states, terminal_cost=np.eye(3),
                     inputs=jm.Box([-0.3, -0.3], [0.3, 0.3]), constrain_initial=False)  # fmt: skip
        soft = jm.soften(mpc, 20.0)
        x0, r = np.array([0.9, -0.5, 0.4]), np.array([0.2, 0.0, 0.1])
        expected = solve_stagewise(soft, x0, r)
        for steps in (1, 20):
            plan = solve_nonlinear(NonlinearMPC(soft, system), x0, r, iterations=steps)
            assert plan.status == SOLVED and plan.iterations <= 2
            np.testing.assert_allclose(plan.inputs, expected.inputs, atol=1e-7)
            np.testing.assert_allclose(plan.cost, expected.cost, rtol=1e-9)
            np.testing.assert_allclose(plan.slack, expected.slack, atol=1e-8)

    @pytest.mark.slow
    @pytest.mark.parametrize("hessian", ["exact", "gauss-newton"])
    def test_swing_up_is_ipopts(self, hessian, x64):
        """IPOPT 3.14 (CasADi 3.8, bounds relaxed by 1e-8) ends at 2242.82813 in 31 iterations."""
        plan = solve_nonlinear(swing_up(), np.array([0, np.pi, 0, 0]), hessian=hessian)
        assert plan.status == SOLVED and plan.iterations < 25
        np.testing.assert_allclose(plan.cost, 2242.82814, rtol=1e-7)
        assert np.abs(plan.inputs).max() == pytest.approx(80.0, abs=1e-9)
        # The plan follows the model.
        x = np.array([0, np.pi, 0, 0])
        for k in range(20):
            x = np.asarray(Pendulum(LENGTH).step(x, plan.inputs[k]))
            np.testing.assert_allclose(plan.states[k + 1], x, atol=1e-6)

    @pytest.mark.slow
    def test_past_an_obstacle_as_slsqp(self, x64):
        problem = around()
        plan = solve_nonlinear(problem, START, GOAL)
        assert plan.status == SOLVED
        model = lambda x, u: x + u + 0.05 * np.sin(x[::-1])

        def states(z):
            x = [START]
            for u in z.reshape(-1, 2):
                x.append(model(x[-1], u))
            return np.array(x)

        def cost(z):
            e = states(z) - GOAL
            return 0.1 * np.sum(e[:-1] ** 2) + np.sum(z**2) + 50 * np.sum(e[-1] ** 2)

        rows = {"type": "ineq", "fun": lambda z: np.sum(states(z)[1:] ** 2, 1) - 1}
        found = minimize(
            cost, np.ravel(plan.inputs) + 1e-3, bounds=[(-2, 2)] * 16, constraints=rows,
            method="SLSQP", options={"ftol": 1e-14, "maxiter": 500},
        )  # fmt: skip
        np.testing.assert_allclose(plan.cost, found.fun, rtol=1e-7)
        np.testing.assert_allclose(np.ravel(plan.inputs), found.x, atol=1e-4)
        distance = np.sum(np.asarray(plan.states) ** 2, 1)[1:]
        assert distance.min() > 1 - 1e-6 and np.sum(distance < 1 + 1e-6) >= 2

    @pytest.mark.slow
    def test_weights_as_matrix_vector_and_number_agree(self, x64):
        costs = []
        for weight in (3.0, [3.0, 3.0], 3.0 * np.eye(2)):
            task = Task(mixed, weight, target=[0.3, 0.1])
            problem = replace(around(), tasks=(task,))
            plan = solve_nonlinear(problem, START, GOAL)
            assert plan.status == SOLVED
            x, u = np.asarray(plan.states), np.vstack([plan.inputs, np.zeros(2)])
            g = np.stack([np.sin(x[:, 0]) - 0.3, x[:, 1] * u[:, 0] - 0.1], 1)[1:]
            e = x - GOAL
            cost = 0.1 * np.sum(e[:-1] ** 2) + np.sum(u**2) + 50 * np.sum(e[-1] ** 2)
            np.testing.assert_allclose(plan.cost, cost + 3 * np.sum(g**2), rtol=1e-9)
            costs.append(plan.cost)
        np.testing.assert_allclose(costs, costs[0], rtol=1e-9)

    @pytest.mark.slow
    def test_a_soft_limit_gives_way_and_says_so(self, x64):
        inside = solve_nonlinear(around(rho=0.5), START, GOAL)
        exact = solve_nonlinear(around(rho=1e3), START, GOAL)
        hard = solve_nonlinear(around(), START, GOAL)
        for plan in (inside, exact, hard):
            assert plan.status == SOLVED
        assert inside.slack.shape == (9, 1) and inside.slack.max() > 0.1
        np.testing.assert_allclose(
            inside.slack[1:, 0], np.maximum(1 - np.sum(inside.states**2, 1)[1:], 0), atol=1e-9
        )
        assert exact.slack.max() < 1e-6 and hard.slack.size == 0
        np.testing.assert_allclose(exact.inputs, hard.inputs, atol=1e-5)
        # Multipliers are those of an exact penalty: below its weight.
        assert np.abs(hard.multipliers.tasks[0]).max() < 1e3
        np.testing.assert_allclose(
            exact.multipliers.tasks[0], hard.multipliers.tasks[0], rtol=1e-4, atol=1e-4
        )

    @pytest.mark.slow
    def test_a_plan_is_its_own_warm_start(self, x64):
        problem = around()
        plan = solve_nonlinear(problem, START, GOAL)
        again = solve_nonlinear(problem, START, GOAL, warm_start=plan)
        assert again.status == SOLVED and again.iterations <= 1
        np.testing.assert_allclose(again.inputs, plan.inputs, atol=1e-6)

    @pytest.mark.slow
    def test_real_time_iterations_come_to_the_solution(self, x64):
        """One QP a call from the last plan, for the same state: the Gauss-Newton method."""
        problem = around()
        plan = None
        for _ in range(60):
            plan = solve_nonlinear(problem, START, GOAL, warm_start=plan, iterations=1)
        assert plan.status == SOLVED
        expected = solve_nonlinear(problem, START, GOAL)
        np.testing.assert_allclose(plan.inputs, expected.inputs, atol=1e-5)


class TestDerivatives:
    """Derivatives of solutions are those of finite differences, with rows active."""

    @pytest.mark.slow
    def test_of_weights_targets_limits_and_the_state(self, x64):
        task = Task(product, name="product")

        def inputs(theta):
            problem = around(lower=theta[3])
            problem = replace(
                problem, tasks=(*problem.tasks, replace(task, weight=theta[0], target=theta[1:3])),
                mpc=replace(problem.mpc, Q=0.1 * jnp.eye(2) * theta[4]),
            )  # fmt: skip
            plan = solve_nonlinear(problem, START + theta[5:], GOAL, jm.ADMM(eps=1e-9))
            return plan.inputs.ravel(), (plan.status, plan.multipliers, plan.iterations)

        theta = jnp.array([0.7, 0.2, -0.1, 1.0, 1.0, 0.0, 0.0])
        J, (status, multipliers, iterations) = jax.jacrev(inputs, has_aux=True)(theta)
        # 90, at half steps, where corrections leave out that rows bend.
        assert status == SOLVED and iterations < 75
        assert np.sum(np.abs(multipliers.tasks[0]) > 1e-3) >= 1  # the disc is touched
        np.testing.assert_allclose(J, jax.jacfwd(inputs, has_aux=True)(theta)[0], atol=1e-12)
        h = 1e-4
        for i in range(len(theta)):
            step = h * np.eye(len(theta))[i]
            difference = (inputs(theta + step)[0] - inputs(theta - step)[0]) / (2 * h)
            np.testing.assert_allclose(J[:, i], difference, atol=1e-5 * (1 + np.abs(J).max()))

    @pytest.mark.slow
    def test_of_second_order(self, x64):
        """Hessians in weights, targets, limits, model and state, where the disc is touched, are
        differences of gradients: with third derivatives of the model, of which the first order
        needs none."""
        task = Task(product, name="product")

        def plan_at(theta):
            problem = around(lower=theta[2])
            tasks = (*problem.tasks, replace(task, weight=theta[0], target=theta[1:2].repeat(2)))
            problem = replace(problem, model=jax.tree_util.Partial(wavy, theta[4]), tasks=tasks)
            return solve_nonlinear(problem, START + theta[3:4], GOAL, jm.ADMM(eps=1e-10))

        theta = jnp.array([0.7, 0.2, 1.0, 0.0, 0.05])
        for part in (
            lambda plan: jnp.sum(jnp.cos(plan.inputs)),
            lambda plan: jnp.sum(plan.states**3),
            lambda plan: plan.cost,
        ):
            slope = jax.jit(jax.grad(lambda theta, part=part: part(plan_at(theta))))
            found = jax.jacfwd(slope)(theta)
            steps = 1e-4 * np.eye(len(theta))
            expected = [(slope(theta + v) - slope(theta - v)) / 2e-4 for v in steps]
            np.testing.assert_allclose(found, found.T, atol=1e-10 * np.abs(found).max())
            np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(found).max())

    @pytest.mark.slow
    def test_of_a_number_of_the_model(self, x64):
        x0 = jnp.array([0, 2.8, 0, 0])

        def solution(length):
            plan = solve_nonlinear(swing_up(length), x0)
            return jnp.append(plan.inputs.ravel(), plan.cost), plan.status

        J, status = jax.jacfwd(solution, has_aux=True)(LENGTH)
        assert status == SOLVED
        h = 1e-5
        difference = (solution(LENGTH + h)[0] - solution(LENGTH - h)[0]) / (2 * h)
        np.testing.assert_allclose(J, difference, rtol=2e-3, atol=2e-3 * np.abs(J[:-1]).max())
        # Envelope theorem: the cost's own derivative is far more accurate.
        np.testing.assert_allclose(J[-1], difference[-1], rtol=1e-5)


@pytest.fixture(scope="module")
def batch():
    with jax.enable_x64(True):
        rng = np.random.default_rng(1)
        starts = rng.uniform([-2, -1], [-1.5, 1], (12, 2))
        starts[3, 0], starts[7, 1] = np.nan, np.inf
        loss = lambda x, r: jnp.sum(solve_nonlinear(around(), x, r).inputs ** 2)
        many = jax.jit(jax.vmap(lambda x, r: solve_nonlinear(around(), x, r), (0, None)))
        gradient = jax.jit(jax.vmap(jax.grad(loss), (0, None)))
        return starts, many(starts, GOAL), gradient(starts, GOAL)


class TestBatches:
    """Each instance of a batch stands alone."""

    @pytest.mark.slow
    def test_a_bad_state_stays_in_its_row(self, batch, x64):
        starts, plans, gradient = batch
        good = np.isfinite(starts).all(axis=1)
        np.testing.assert_array_equal(plans.status[~good], jm.Status.NON_FINITE)
        np.testing.assert_array_equal(plans.status[good], SOLVED)
        assert np.isnan(plans.inputs[~good]).all() and np.isfinite(plans.inputs[good]).all()
        assert np.isfinite(gradient[good]).all()
        np.testing.assert_array_equal(gradient[~good], 0)

    @pytest.mark.slow
    def test_plans_are_those_alone(self, batch, x64):
        starts, plans, _ = batch
        for i in (0, 5, 11):
            alone = solve_nonlinear(around(), starts[i], GOAL)
            np.testing.assert_allclose(plans.inputs[i], alone.inputs, atol=1e-6)

    @pytest.mark.slow
    def test_unsolved_ones_leave_the_shared_gradient_finite(self, x64):
        """One start cannot leave the disc, one is not finite."""
        starts = jnp.array([[-2.0, 0.1], [0.05, 0.0], [jnp.nan, 0.0]])
        slow = jm.Box([-0.6, -0.6], [0.6, 0.6])

        def loss(weight, starts):
            problem = around()
            mpc = replace(problem.mpc, R=weight * jnp.eye(2), inputs=slow)
            plans = jax.vmap(lambda x: solve_nonlinear(replace(problem, mpc=mpc), x, GOAL))(starts)
            return jnp.sum(jnp.where(jnp.isnan(plans.inputs), 0.0, plans.inputs) ** 2), plans.status

        gradient, status = jax.grad(loss, has_aux=True)(1.0, starts)
        expected = [SOLVED, jm.Status.ITERATION_LIMIT, jm.Status.NON_FINITE]
        np.testing.assert_array_equal(status, expected)
        assert np.isfinite(gradient)

    @pytest.mark.slow
    def test_float32(self):
        plan = solve_nonlinear(around(), START.astype(np.float32), GOAL.astype(np.float32))
        with jax.enable_x64(True):
            expected = solve_nonlinear(around(), START, GOAL)
        assert plan.status == SOLVED and plan.inputs.dtype == jnp.float32
        np.testing.assert_allclose(plan.cost, expected.cost, rtol=1e-4)


@pytest.mark.slow
def test_an_impossible_limit_is_not_solved(x64):
    """Hard: the start is inside the disc, and the first step cannot leave it."""
    problem = around()
    slow = replace(problem, mpc=replace(problem.mpc, inputs=jm.Box([-0.1, -0.1], [0.1, 0.1])))
    plan = solve_nonlinear(slow, np.array([0.1, 0.0]), GOAL)
    assert plan.status == jm.Status.ITERATION_LIMIT
    soft = replace(slow, tasks=(replace(slow.tasks[0], rho=1e3),))
    plan = solve_nonlinear(soft, np.array([0.1, 0.0]), GOAL)
    assert plan.slack.max() > 0.5


@pytest.mark.long
def test_whole_steps_near_a_solution(x64):
    """The end of a lever near a point inside its circle: the defect of a whole step, times its
    multiplier, is more than the step gains (Maratos 1978). Without the correction of the states it
    takes 53 to 64 programs. The answer is known: sin(u − 0.5) + 2e-6 u = 0."""
    lever = lambda x, u: jnp.stack([jnp.cos(u[0]), jnp.sin(u[0])])
    system = jm.LinearSystem(np.eye(2), np.zeros((2, 1)))
    mpc = jm.MPC(system, np.zeros((2, 2)), 1e-6 * np.eye(1), 1, terminal_cost=2 * np.eye(2))
    problem, goal = NonlinearMPC(mpc, lever), 0.25 * np.array([np.cos(0.5), np.sin(0.5)])

    def plan(angle):
        x0 = lever(None, angle[None])
        start = WarmStart(jnp.stack([x0, x0]), angle[None, None], jnp.zeros(0))
        return solve_nonlinear(problem, x0, goal, warm_start=start)

    plans = jax.vmap(plan)(jnp.array([0.6, 1.0, 1.9, -0.8]))
    assert (plans.status == SOLVED).all() and (plans.iterations <= 6).all()
    np.testing.assert_allclose(plans.inputs.ravel(), 0.5 - 1e-6, rtol=1e-6)


BAD = {
    "x0": (lambda p: solve_nonlinear(p, np.zeros(3)), r"x0: shape \(3,\)"),
    "reference": (lambda p: solve_nonlinear(p, START, np.zeros(3)), r"reference: shape \(3,\)"),
    "targets": (lambda p: solve_nonlinear(p, START, targets=[]), "targets: 0 for 1 tasks"),
    "iterations": (lambda p: solve_nonlinear(p, START, iterations=0), "iterations: 0"),
    "hessian": (lambda p: solve_nonlinear(p, START, hessian="bfgs"), "hessian: 'bfgs'"),
    "weight": (
        lambda p: solve_nonlinear(replace(p, tasks=(replace(p.tasks[0], weight=-1.0),)), START),
        "disc.weight: is not positive semidefinite",
    ),
    "target": (
        lambda p: solve_nonlinear(
            replace(p, tasks=(replace(p.tasks[0], target=[1, 2, 3]),)), START
        ),
        r"disc.target: shape \(3,\)",
    ),
    "lower": (
        lambda p: solve_nonlinear(replace(p, tasks=(replace(p.tasks[0], upper=0.5),)), START),
        "disc.lower: exceeds upper",
    ),
    "task stages": (
        lambda p: solve_nonlinear(replace(p, tasks=(replace(p.tasks[0], stages=(0, 9)),)), START),
        r"disc.stages: \(0, 9\)",
    ),
    "function": (
        lambda p: solve_nonlinear(
            replace(p, tasks=(replace(p.tasks[0], function=lambda at: jnp.eye(2)),)), START
        ),
        r"disc.function: gives shape \(2, 2\)",
    ),
    "model": (lambda p: solve_nonlinear(replace(p, model=3.0), START), "model: is a float"),
    "next state": (
        lambda p: solve_nonlinear(replace(p, model=lambda x, u: jnp.zeros(3)), START),
        r"model.step\(x, u\): shape \(3,\)",
    ),
    "no state": (
        lambda p: solve_nonlinear(replace(p, model=lambda x, u: None), START),
        r"model.step\(x, u\): gives a NoneType. Give the next state",
    ),
    "no value": (
        lambda p: solve_nonlinear(replace(p, tasks=(Task(lambda at: None, weight=1.0),)), START),
        "task.function: gives a NoneType. Give a vector",
    ),
    "half stages": (
        lambda p: solve_nonlinear(replace(p, tasks=(replace(p.tasks[0], stages=[0.5]),)), START),
        r"disc.stages: \(0.5,\)",
    ),
    "parts": (
        lambda p: solve_nonlinear(replace(p, model=lambda x, u: [x, u[0]]), START),
        r"gives a list of parts \[\(2,\), \(\)\]. Join them: jnp.concatenate",
    ),
    "mask of stages": (
        lambda p: solve_nonlinear(replace(p, tasks=(replace(p.tasks[0], stages=True),)), START),
        r"disc.stages: \(True,\)",
    ),
    "no weight": (
        lambda p: solve_nonlinear(replace(p, tasks=(Task(squared, target=2.0),)), START),
        "task.target: is given without a weight",
    ),
    "numpy": (
        lambda p: solve_nonlinear(replace(p, model=lambda x, u: np.array([x[0], u[0]])), START),
        "model or task: is not written in JAX",
    ),
    "tasks": (lambda p: solve_nonlinear(replace(p, tasks=(3,)), START), "tasks: is a tuple"),
    "problem": (lambda p: solve_nonlinear(p.mpc, START), "problem: is an MPC"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_arguments(name, x64):
    call, text = BAD[name]
    with pytest.raises(ValueError, match=text):
        call(around())


@pytest.mark.long
def test_what_has_one_meaning_is_taken(x64):
    """Models and tasks that give lists and tuples; stages as a number, a range or an array."""
    problem = around(steps=3)
    lists = lambda kind: replace(
        problem,
        model=lambda x, u: kind(problem.model.step(x, u)),
        tasks=(replace(problem.tasks[0], function=lambda at: kind([squared(at)])),),
    )
    inputs = [solve_nonlinear(p, START, iterations=2).inputs for p in (problem, lists(list))]
    np.testing.assert_allclose(*inputs, atol=1e-12)
    lists(tuple).validate()
    for given, stages in (
        (2, (2,)),
        (range(2), (0, 1)),
        (np.arange(1, 3), (1, 2)),
        ([3], (3,)),
        (tuple(np.arange(2)), (0, 1)),
    ):
        assert replace(problem.tasks[0], stages=given).stages == stages


class Distance:
    """The squared distance from a point: a function whose number is data."""

    def __init__(self, center):
        self.center = center

    def __call__(self, at):
        return (at.x - self.center) @ (at.x - self.center)


jax.tree_util.register_pytree_node(
    Distance, lambda d: ((d.center,), None), lambda _, leaves: Distance(*leaves)
)


@pytest.mark.long
def test_functions_may_close_over_what_is_differentiated(x64):
    """A model and a task that are functions of traced numbers, and a task that is a pytree."""
    mpc = replace(around(steps=3).mpc, states=None)

    def cost(p, function):
        model = lambda x, u: bent(x, u) + 0.1 * p[0] * jnp.sin(x)
        task = Task(function(p[1]), weight=1.0, target=0.5)
        return solve_nonlinear(NonlinearMPC(mpc, model, (task,)), START).cost

    written = lambda r: lambda at: (at.x - r) @ (at.x - r)
    p, h = jnp.array([0.7, 0.2]), 1e-5
    found = jax.jit(jax.value_and_grad(lambda p: cost(p, written)))(p)
    other = jax.jit(jax.value_and_grad(lambda p: cost(p, Distance)))(p)
    jax.tree.map(lambda v, w: np.testing.assert_allclose(v, w, rtol=1e-9), found, other)
    value = jax.jit(lambda p: cost(p, Distance))
    slopes = [(value(p + h * e) - value(p - h * e)) / (2 * h) for e in np.eye(2)]
    np.testing.assert_allclose(found[1], slopes, rtol=1e-6)


def tip(at):
    """The end of two links of 0.5 m in the plane."""
    first, second = at.x[0], at.x[0] + at.x[1]
    return 0.5 * jnp.stack([jnp.cos(first) + jnp.cos(second), jnp.sin(first) + jnp.sin(second)])


def two_joints(x, u):
    return jnp.concatenate([x[:2] + 0.05 * x[2:], x[2:] + 0.5 * u])


def growing(x, u):
    """Positive states that grow with every state and every dose, the more slowly the larger."""
    return jnp.tanh(jnp.array([[0.6, 0.2], [0.1, 0.7]]) @ x + jnp.array([0.5, 1.0]) * u[0])


def test_plans_without_a_start_are_traced(x64):
    """From any state, under limits of inputs and tasks; values: the slow tests above."""
    plan = jax.eval_shape(lambda x: solve_nonlinear(around(), x, GOAL), START)
    assert plan.inputs.shape == (8, 2)


@pytest.mark.parametrize("iterations", [1, 20])
@pytest.mark.parametrize("warm", [False, True])
@pytest.mark.parametrize("rates", [False, True])
def test_plans_of_all_kinds_are_traced(x64, iterations, warm, rates):
    """One QP about a warm start of a problem with rates, whose stages have a state of their own,
    was an error of JAX; values: the tests of controllers."""
    problem = around(rho=5.0)
    if rates:
        mpc = replace(problem.mpc, input_rate_limit=0.5, input_rate_weight=[0.1, 0.1])
        problem = replace(problem, mpc=mpc)

    def again(x):
        plan = solve_nonlinear(problem, x, GOAL) if warm else None
        return solve_nonlinear(problem, x, GOAL, warm_start=plan, iterations=iterations)

    assert jax.eval_shape(again, START).inputs.shape == (8, 2)


def unstable(as_function, A, B, x):
    """The first input and the plan of a linear model, as a function or as it is."""
    n, m = B.shape
    limits = {"states": jm.Box(-np.full(n, 5.0), 5.0), "inputs": jm.Box(-np.ones(m), 1.0)}
    system = jm.LinearSystem(A, B)
    mpc = jm.MPC(system, np.eye(n), np.eye(m), 30, **limits, constrain_initial=False)
    mpc = jm.soften(mpc, 10.0)
    if as_function:
        problem = NonlinearMPC(mpc, lambda x, u: A @ x + B @ u)
        plan = solve_nonlinear(problem, x, solver=jm.ADMM(eps=1e-10), iterations=2)
    else:
        plan = solve_stagewise(mpc, x)
    return plan.inputs[0, 0], plan


@pytest.mark.slow
def test_unstable_models_are_solved_as_linear_ones_are(x64):
    """Models that grow 3e3- to 1e12-fold over the horizon; those of 1e6 and more were solved
    nowhere."""
    A, B, x0 = unstable_systems(8)
    planned = jax.value_and_grad(partial(unstable, True), argnums=2, has_aux=True)
    planned = jax.jit(jax.vmap(planned))
    (first, found), slopes = planned(A, B, x0)
    linear = jax.jit(jax.vmap(partial(unstable, False)))(A, B, x0)[1]
    solved = np.asarray(linear.status) == SOLVED
    assert solved.sum() >= 12
    assert np.all(found.status[solved] == SOLVED) and np.all(found.iterations[solved] == 1)
    np.testing.assert_allclose(found.cost[solved], linear.cost[solved], rtol=2e-6)
    # Pieces of these laws may be short: on one side at least the difference is of the same piece.
    for i in range(2):
        moved = [planned(A, B, x0 + h * np.eye(2)[i])[0][0] for h in (1e-5, -1e-5)]
        sides = (moved[0] - first) / 1e-5, (first - moved[1]) / 1e-5
        wrong = np.min(np.abs(np.stack(sides) - slopes[:, i]), axis=0)
        np.testing.assert_allclose(wrong[solved], 0.0, atol=1e-4)


@pytest.mark.long
def test_inputs_are_finite_where_the_model_overflows(x64):
    """Nothing is SOLVED there, but what a controller applies is a number."""
    steep = NonlinearMPC(around().mpc, lambda x, u: 1e200 * x + u)
    for iterations in (1, 5):
        plan = solve_nonlinear(steep, START, iterations=iterations)
        assert plan.status != SOLVED and np.isfinite(plan.inputs).all()


@pytest.mark.slow  # its programs, stage by stage, are those of `test_interior_point.py`
def test_the_best_dose_may_be_none(x64):
    """u ≥ 0 without another limit: all states, and all costs, are least for u = 0."""
    system = jm.LinearSystem(np.eye(2), np.zeros((2, 1)))
    mpc = jm.MPC(system, [1.0, 1.0], 0.1, 4, inputs=jm.Box(0.0, np.inf), terminal_cost=[1.0, 1.0])
    x0s = np.random.default_rng(0).uniform(0.1, 2, (16, 2))
    solve = lambda x: solve_nonlinear(NonlinearMPC(mpc, growing), x)
    plan = jax.jit(jax.vmap(solve))(x0s)
    assert (plan.status == SOLVED).all()
    np.testing.assert_allclose(plan.inputs, 0.0, atol=1e-9)


@pytest.mark.slow
def test_one_qp_a_sample_comes_to_rest_at_a_target_out_of_reach(x64):
    """The arm ends stretched towards the target, 1.5 m away, where full Gauss-Newton steps
    swing from limit to limit."""
    system = jm.LinearSystem(np.eye(4), np.zeros((4, 2)))
    limits, slow = jm.Box([-1.0, -1.0], [1.0, 1.0]), [0, 0, 0.1, 0.1]
    mpc = jm.MPC(
        system, [1e-3, 1e-3, 0.1, 0.1], [1e-2, 1e-2], 15, inputs=limits, terminal_cost=slow
    )
    goal = 1.5 * np.array([np.cos(0.7), np.sin(0.7)])
    problem = NonlinearMPC(mpc, two_joints, (Task(tip, weight=1e3, target=goal),))

    def sample(carried, _):
        x, last = carried
        start = replace(last, states=last.states.at[0].set(x))
        plan = solve_nonlinear(problem, x, warm_start=start, iterations=1)
        return (two_joints(x, plan.inputs[0]), plan), (x, plan.inputs[0], plan.status)

    x0 = jnp.array([0.2, 1.0, 0.0, 0.0])
    first = solve_nonlinear(problem, x0, iterations=1)
    x, u, status = jax.lax.scan(sample, (x0, first), length=120)[1]
    assert (status == SOLVED).all()
    np.testing.assert_allclose(u[-20:], 0.0, atol=1e-6)
    np.testing.assert_allclose(x[-1], [0.7, 0, 0, 0], atol=1e-4)
