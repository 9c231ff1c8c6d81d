"""Robots under MPC: plans against another solver, closed loops against limits and linear ones."""

from dataclasses import replace
from functools import cache

import cvxpy as cp
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_engine import c_affine, c_steps

import jaxmpc as jm
from jaxmpc.closed_loop import LinearFeedback

T, J = 0.01, 0.05
DOUBLE = jm.LinearSystem(np.array([[1, T], [0, 1]]), np.array([[T * T / J], [T / J]]), dt=T)
STATES = jm.Box(np.array([-1.5, -2.0]), np.array([1.5, 2.0]))
TORQUE = jm.Box(np.array([-2.0]), np.array([2.0]))
PLANT = jm.LinearPlant(DOUBLE, STATES, TORQUE)
PRECISE = jm.ADMM(iterations=500, rho=1.0, alpha=1.6, newton_steps=6)
PENALTY = 1e4


pytestmark = pytest.mark.usefixtures("x64_of_module")


def solve_by_clarabel(mpc, A, B, c, xi, reference, input_reference, *, penalty=PENALTY):
    """(optimal value, inputs, states, broken rows) of the plan with soft state limits, by cvxpy.
    A, B, c: one for each step. penalty=None: hard, and None where that is infeasible."""
    N, m = mpc.horizon, mpc.system.m
    x, u = cp.Variable((N + 1, mpc.system.n)), cp.Variable((N, m))
    P, cost, rules = np.asarray(mpc.terminal_cost), 0, [x[0] == xi]
    lower, upper = mpc.states.lower, mpc.states.upper
    slack = cp.Variable((N, mpc.system.n), nonneg=True)
    for k in range(N):
        cost += cp.quad_form(x[k] - reference, mpc.Q) + cp.quad_form(u[k] - input_reference, mpc.R)
        rules += [x[k + 1] == A[k] @ x[k] + B[k] @ u[k] + c[k]]
        rules += [u[k] >= mpc.inputs.lower, u[k] <= mpc.inputs.upper]
        rules += [x[k + 1] <= upper + slack[k], x[k + 1] >= lower - slack[k]]
    cost += cp.quad_form(x[N] - reference, cp.psd_wrap((P + P.T) / 2))
    if penalty is None:
        rules += [slack == 0]
    else:
        cost += penalty * cp.sum(slack)
    problem = cp.Problem(cp.Minimize(cost), rules)
    problem.solve("CLARABEL", tol_gap_abs=1e-10, tol_gap_rel=1e-10, tol_feas=1e-10)
    if problem.status not in ("optimal", "optimal_inaccurate"):
        return None
    return problem.value, u.value, x.value, slack.value


def test_a_controller_prints_what_it_does():
    mpc = jm.robot_mpc(PLANT, np.eye(2), np.eye(1), 4)
    text = repr(jm.RobotController(PLANT, mpc, linearize="set-point"))
    assert "horizon 4, soft state limits, one linear model, at the set-point" in text


# --- the pendulum inside tight limits --------------------------------------------------------

# Gravity takes 9.81 sin 0.5 = 4.7 of the 5 N m at the end of the range.
STARTS = np.array([
    [0.4, 0.0], [-0.45, 0.5], [0.48, -0.9], [0.0, 0.0], [0.2, 0.8], [-0.3, -0.2], [0.35, 0.2],
    [0.45, 0.95], [-0.3, -0.97], [np.nan, 0.0],
])  # fmt: skip


@pytest.fixture(scope="module")
def pendulum():
    return jm.load_robot("pendulum", position=0.5, velocity=1.0)


@cache
def mpc_of(robot):
    Q = np.tile([200.0, 1.0], robot.mujoco.nv).reshape(-1, 2).T.ravel()
    return jm.robot_mpc(robot, Q, np.full(robot.m, 0.01), 20)


def controller_of(robot, mode):
    return jm.RobotController(robot, mpc_of(robot), PRECISE, linearize=mode, rho=PENALTY)


def loops_of(robot, mode, steps=100):
    x, u = robot.equilibrium()
    return jm.simulate_many(
        controller_of(robot, mode), robot, STARTS, steps, reference=x, input_reference=u
    )


@pytest.fixture(scope="module")
def loops(pendulum):
    return loops_of(pendulum, "state")


def assert_loops(robot, run):
    """Set-point reached; limits kept where each plan said so; who broke them said so."""
    good = (run.status == jm.Status.SOLVED).all(axis=1) & ~run.fallback.any(axis=1)
    assert good[:4].all() and not good[7] and not good[9]
    assert np.abs(run.states[:4, -1]).max() < 0.02 and np.abs(run.states[good, -1]).max() < 0.3
    assert run.violation[good].max() <= 1e-6
    assert run.inputs[good].min() >= -5 and run.inputs[good].max() <= 5
    # Limits bind: torque at the bound, speed at what the margin leaves of it.
    assert np.abs(run.inputs[good]).max() == 5
    np.testing.assert_allclose(np.abs(run.states[good][..., 1]).max(), 0.98, atol=5e-3)
    # Whoever breaks a limit at t + 1 said so at t: its plan was soft there, or not solved.
    said = run.fallback | (run.status != jm.Status.SOLVED)
    broken = run.violation[:, 1:] > 1e-6
    assert broken.any() and said[broken].all()
    # NaN in one leaves the others alone.
    assert np.isnan(run.states[9, 1:]).all() and np.isfinite(run.states[:9]).all()
    assert (run.status[9] == jm.Status.NON_FINITE).all()


def assert_records(robot, run):
    """States are the C engine's, violations and costs those of the states."""
    mpc = mpc_of(robot)
    for i in (0, 7):
        for t in (0, 5, 30):
            after = c_steps(robot.mujoco, run.states[i, t], run.inputs[i, t], robot.substeps)
            np.testing.assert_allclose(run.states[i, t + 1], after, atol=1e-9)
    x, u = run.states[:9, :-1], run.inputs[:9]
    stage = np.einsum("btn,nm,btm->bt", x, mpc.Q, x) + np.einsum("btn,nm,btm->bt", u, mpc.R, u)
    np.testing.assert_allclose(run.stage_cost[:9], stage, rtol=1e-9)
    over = np.maximum(np.abs(run.states[:9]) - [0.5, 1.0], 0).max(axis=2)
    np.testing.assert_allclose(run.violation[:9], over, atol=1e-12)


@pytest.mark.slow
def test_limits_are_kept_or_the_plan_says_so(pendulum, loops):
    assert_loops(pendulum, loops)
    assert_records(pendulum, loops)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["set-point", "trajectory"])
def test_limits_are_kept_in_the_other_modes(pendulum, mode):
    assert_loops(pendulum, loops_of(pendulum, mode))


@pytest.mark.slow
def test_plans_are_those_of_another_solver(pendulum, loops):
    """The first input and cost of plans about the measured state and the last input, and whether
    soft rows break, by the C engine's linear model and clarabel."""
    mpc = mpc_of(pendulum)
    kinds = set()
    for i, t in ((0, 0), (1, 0), (2, 0), (4, 0), (6, 0), (7, 0), (8, 0), (0, 1), (1, 7), (7, 1)):
        before = loops.inputs[i, t - 1] if t else np.zeros(1)
        A, B, c = c_affine(pendulum, loops.states[i, t], before, 1)
        A_1, B_1, c_1 = A, B, c
        for _ in range(pendulum.substeps - 1):
            A, B, c = A_1 @ A, A_1 @ B + B_1, A_1 @ c + c_1
        staged = [A] * 20, [B] * 20, [c] * 20
        args = mpc, *staged, loops.states[i, t], np.zeros(2), np.zeros(1)
        value, u, _, slack = solve_by_clarabel(*args)
        assert loops.status[i, t] == jm.Status.SOLVED
        np.testing.assert_allclose(loops.cost[i, t], value, rtol=1e-5)
        np.testing.assert_allclose(loops.inputs[i, t], u[0], atol=1e-3)
        hard = solve_by_clarabel(*args, penalty=None)
        assert loops.fallback[i, t] == (hard is None) == (slack.max() > 1e-6)
        kinds.add(hard is None)
    assert kinds == {True, False}


@pytest.mark.slow
def test_trajectory_mode_linearises_about_the_shifted_plan(pendulum):
    """The second plan, by linear models of the C engine about each step of the first, shifted."""
    controller = controller_of(pendulum, "trajectory")
    zero = {"reference": np.zeros(2), "input_reference": np.zeros(1)}
    call = jax.jit(lambda x, before: controller(x, before, **zero))
    x = STARTS[0]
    start = controller.start(x, np.zeros(1))
    control = call(x, start)
    u, first, _ = control
    x = c_steps(pendulum.mujoco, x, np.asarray(u), pendulum.substeps)
    second = call(x, control).plan
    states = np.concatenate([x[None], first.states[2:]])
    inputs = np.concatenate([first.inputs[1:], first.inputs[-1:]])
    models = []
    for xi, v in zip(states, inputs, strict=True):
        A_1, B_1, c_1 = A, B, c = c_affine(pendulum, np.asarray(xi), np.asarray(v), 1)
        for _ in range(pendulum.substeps - 1):
            A, B, c = A_1 @ A, A_1 @ B + B_1, A_1 @ c + c_1
        models.append((A, B, c))
    value, u, x_plan, _ = solve_by_clarabel(
        controller.mpc, *zip(*models, strict=True), x, np.zeros(2), np.zeros(1)
    )
    assert second.status == jm.Status.SOLVED
    np.testing.assert_allclose(second.cost, value, rtol=1e-6)
    np.testing.assert_allclose(second.states, x_plan, atol=1e-5)
    np.testing.assert_allclose(second.inputs[0], u[0], atol=1e-3)


# --- linear plants: what is known in closed form ---------------------------------------------


@pytest.fixture(scope="module")
def linear_mpc():
    return jm.robot_mpc(PLANT, [50.0, 1.0], [0.1], 20)


LINEAR_STARTS = np.array([[0.5, 0.0], [-1.0, 1.5], [0.2, -0.5], [1.4, 1.0], [0.9, -1.9]])


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["state", "trajectory"])
def test_linear_plant_is_the_linear_loop(mode, linear_mpc):
    """Whatever the linearisation, a linear plant's loop is that of jm.Controller on the softened
    problem."""
    controller = jm.RobotController(PLANT, linear_mpc, PRECISE, linearize=mode)
    run = jm.simulate_many(controller, PLANT, LINEAR_STARTS, 30)
    soft = jm.Controller(jm.soften(linear_mpc, PENALTY), PRECISE)
    want = jm.simulate_many(soft, DOUBLE, LINEAR_STARTS, 30)
    assert (want.status == jm.Status.SOLVED).all() and (run.status == want.status).all()
    np.testing.assert_allclose(run.states, want.states, atol=1e-6)
    np.testing.assert_array_equal(run.fallback, want.fallback)


def test_chunks_and_variations(linear_mpc):
    """Chunks give what one does; variations change the plant alone, loop by loop."""
    gain = jm.lqr(DOUBLE, np.diag([50.0, 1.0]), np.array([[0.1]])).K
    feedback = LinearFeedback(linear_mpc, gain, PLANT)
    B = np.asarray(DOUBLE.B) * np.linspace(0.5, 1.5, 5)[:, None, None]
    whole = jm.simulate_many(feedback, PLANT, LINEAR_STARTS, 40, variations={"B": B})
    parts = jm.simulate_many(feedback, PLANT, LINEAR_STARTS, 40, variations={"B": B}, chunk=2)
    for a, b in zip(*map(jax.tree.leaves, (whole, parts)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)
    assert whole.states.shape == (5, 41, 2) and whole.inputs.shape == (5, 40, 1)
    # By hand: u = clip(K x).
    for i, x in enumerate(LINEAR_STARTS):
        for t in range(40):
            np.testing.assert_allclose(whole.states[i, t], x, rtol=0, atol=1e-12)
            u = np.clip(gain @ x, -2, 2)
            np.testing.assert_allclose(whole.inputs[i, t], u, rtol=0, atol=1e-11)
            x = DOUBLE.A @ x + B[i] @ u
    assert (whole.status == jm.Status.NOT_RUN).all() and not whole.fallback.any()
    assert np.abs(whole.inputs).max() == 2
    # References and offsets, and a NaN start that stays alone.
    starts = np.where(np.arange(5)[:, None] == 2, np.nan, LINEAR_STARTS)
    moved = jm.simulate_many(
        feedback, PLANT, starts, 400, reference=np.array([0.3, 0.0]), input_reference=np.zeros(1)
    )
    keep = [0, 1, 3, 4]
    np.testing.assert_allclose(moved.states[keep, -1], [[0.3, 0]] * 4, atol=1e-3)
    assert np.isnan(moved.states[2]).all() and np.isnan(moved.violation[2]).all()


@pytest.mark.slow
def test_the_lessons_joint_behaves_as_its_linear_model():
    """The robot in MJX under RobotController, in each mode, against jm.Controller on the exact
    linear model: 100 samples with torque and speed at their limits."""
    joint = jm.load_robot("joint")
    mpc = jm.robot_mpc(joint, [50.0, 1.0], [0.1], 20)
    np.testing.assert_allclose(mpc.system.A, DOUBLE.A, atol=1e-12)
    np.testing.assert_allclose(mpc.system.B, DOUBLE.B, atol=1e-12)
    soft = jm.Controller(jm.soften(mpc, PENALTY), PRECISE)
    want = jm.simulate_many(soft, DOUBLE, LINEAR_STARTS, 100)
    assert np.abs(want.inputs).max() > 1.999 and np.abs(want.states[..., 1]).max() > 1.95
    for mode in ("set-point", "state", "trajectory"):
        controller = jm.RobotController(joint, mpc, PRECISE, linearize=mode)
        run = jm.simulate_many(controller, joint, LINEAR_STARTS, 100)
        np.testing.assert_allclose(run.states, want.states, atol=1e-6)
        np.testing.assert_allclose(run.inputs, want.inputs, atol=1e-4)


@pytest.mark.slow
def test_quadrotor_recovers_from_a_tilt():
    """Turned by up to 0.8 rad and moving: hovers after 3 s, thrusts within their limits."""
    robot = jm.load_robot("quadrotor")
    x_ref, u_ref = robot.equilibrium()
    Q = np.array([20.0] * 3 + [2.0] * 3 + [2.0] * 3 + [0.1] * 3)
    mpc = jm.robot_mpc(robot, Q, np.full(4, 10.0), 20)
    controller = jm.RobotController(robot, mpc, PRECISE, linearize="state")
    xi = np.tile(np.asarray(robot.coordinates(x_ref)), (3, 1))
    xi[0, 3] = 0.8
    xi[1, 3:6], xi[1, 6:9] = [0.4, -0.5, 1.0], [0.5, 0.0, -0.5]
    xi[2, 4] = -0.6
    xi[2, 9:12] = [1.0, -2.0, 1.0]
    starts = np.array([robot.state(v) for v in xi])
    run = jm.simulate_many(
        controller, robot, starts, 300, reference=np.asarray(robot.coordinates(x_ref)),
        input_reference=u_ref,
    )  # fmt: skip
    assert run.inputs.min() >= 0 and run.inputs.max() <= 0.1597 and run.inputs.max() > 0.159
    end = np.array([robot.coordinates(x) for x in run.states[:, -1]])
    np.testing.assert_allclose(end, [robot.coordinates(x_ref)] * 3, atol=0.02)
    good = (run.status == jm.Status.SOLVED).all(axis=1) & ~run.fallback.any(axis=1)
    assert good.any() and run.violation[good].max() <= 1e-6


@pytest.mark.slow
def test_variations_of_a_robot_change_the_plant_alone(pendulum):
    """Heavier pendulums: the first input stays that of the nominal one, the motion does not, and
    is the C engine's with that mass."""
    controller = controller_of(pendulum, "set-point")
    mass = np.array([[0, 1.0], [0, 1.2], [0, 0.8]])
    run = jm.simulate_many(
        controller, pendulum, np.tile([0.2, 0.1], (3, 1)), 3, variations={"body_mass": mass}
    )
    np.testing.assert_allclose(run.inputs[:, 0], np.broadcast_to(run.inputs[0, 0], (3, 1)))
    for i in range(3):
        model = mujoco.MjModel.from_xml_path(jm.__path__[0] + "/robots/models/pendulum.xml")
        model.body_mass = mass[i]
        x = run.states[i, 0]
        for t in range(3):
            x = c_steps(model, x, run.inputs[i, t], pendulum.substeps)
            np.testing.assert_allclose(run.states[i, t + 1], x, atol=1e-9)


@pytest.mark.slow
def test_weights_under_vmap(linear_mpc):
    """Controllers built inside vmap, one for each weight: what each gives alone."""
    weights = np.array([0.05, 0.1, 1.0])
    x0 = np.array([0.5, 0.0])

    def cost(R):
        mpc = jm.MPC(
            DOUBLE, np.diag([50.0, 1.0]), R * np.eye(1), 10, states=STATES, inputs=TORQUE,
        )  # fmt: skip
        return jm.simulate(jm.Controller(mpc, PRECISE), DOUBLE, x0, 10).inputs

    found = jax.vmap(cost)(weights)
    for i, R in enumerate(weights):
        np.testing.assert_allclose(found[i], cost(R), atol=1e-6)


# --- bad input -------------------------------------------------------------------------------


def test_bad_problems_and_controllers_are_named(pendulum, linear_mpc):
    two, mpc, Q, R = jm.load_robot("arm2"), linear_mpc, [50.0, 1.0], [0.1]
    solver = jm.ADMM(iterations=10, rho=1.0, alpha=1.6, newton_steps=0)
    make = jm.robot_mpc
    follow = lambda K: jm.simulate(jm.closed_loop.LinearFeedback(mpc, K), PLANT, [0.0, 0.0], 1)
    for call, message in (
        (lambda: make(PLANT, Q, R, margin=1.0), r"margin: 1.0. Give a fraction in \[0, 1\)"),
        (lambda: make(PLANT, Q, R, margin=-0.1), "margin: -0.1"),
        (lambda: make(PLANT, Q, R, margin="a"), "margin: 'a' where real numbers are needed"),
        (
            lambda: jm.RobotController(PLANT, replace(mpc, system=replace(mpc.system, dt=0.5))),
            "mpc: has dt = 0.5, the robot a period of",
        ),
        (lambda: make(PLANT, [1.0, 2.0, 3.0], R), "Q: "),
        (lambda: make(PLANT, Q, [1.0, 1.0]), "R: "),
        (lambda: make(PLANT, [-1.0, 1.0], R), "Q: .*semidefinite"),
        (lambda: make(PLANT, Q, [0.0]), "R: .*definite"),
        (lambda: make(PLANT, Q, R, 0), "horizon: "),
        (lambda: make(PLANT, Q, R, terminal_cost="dare"), "terminal_cost: 'dare'. Give"),
        (lambda: make(PLANT, Q, R, target=[1.6, 0.0]), "target: "),
        (lambda: make(pendulum, Q, R, target=[1.0]), "target: has theta = 1 rad, limits are"),
        (
            lambda: jm.RobotController(pendulum, mpc, solver, linearize="once"),
            "linearize: 'once'. Give one of set-point, state, trajectory",
        ),
        (lambda: jm.RobotController(DOUBLE, mpc, solver), "robot: is a LinearSystem. Give a Robot"),
        (
            lambda: jm.RobotController(two, mpc, solver),
            r"mpc: has \(2, 1\) states and inputs. This robot has \(4, 2\): robot_mpc makes",
        ),
        (lambda: jm.RobotController(pendulum, mpc, solver, rho=-1.0), "rho"),
        (lambda: jm.RobotController(pendulum, mpc, solver, hessian="bfgs"), "hessian: 'bfgs'"),
        (lambda: jm.RobotController(pendulum, mpc, solver, hessian="exact"), "sqp_steps=10"),
        (lambda: jm.RobotController(pendulum, mpc, jm.ADMM(rho=[1.0, 2.0])), "rho: shape"),
        (lambda: follow([1.0, 2.0]), "K: shape .2,. where .1, 2. is needed"),
        (lambda: follow([[np.nan, 2.0]]), "K: holds NaN"),
    ):
        with pytest.raises(ValueError, match=message):
            call()


@pytest.mark.long
def test_a_problem_of_traced_weights_is_that_of_their_values(pendulum):
    """Inside jit too, where the model of the robot is made from what is known."""

    def cost_to_go(scale):
        return jm.robot_mpc(pendulum, scale * jnp.array([4.0, 0.1]), [0.01], 4).terminal_cost

    with jax.enable_x64(True):
        found, slope = jax.jit(lambda s: jax.jvp(cost_to_go, (s,), (1.0,)))(2.0)
        wanted = [cost_to_go(s) for s in (2.0, 2 + 1e-4, 2 - 1e-4)]
    np.testing.assert_allclose(found, wanted[0], rtol=1e-9)
    np.testing.assert_allclose(slope, (wanted[1] - wanted[2]) / 2e-4, rtol=1e-6)


def test_margin_gives_way_to_the_target():
    with pytest.warns(UserWarning, match="margin: coordinate 0: the target lies at the limit"):
        mpc = jm.robot_mpc(PLANT, [50.0, 1.0], [0.1], target=[1.495, 0.0])
    assert mpc.states.upper[0] == 1.495 and mpc.states.lower[0] > -1.5


def test_bad_loops_are_named(pendulum, linear_mpc):
    law = LinearFeedback(linear_mpc, [[-1.0, -1.0]], PLANT)
    x0s = LINEAR_STARTS
    many = jm.simulate_many
    quadrotor = jm.load_robot("quadrotor")
    flying = jm.LinearSystem(np.eye(12), np.ones((12, 4)), dt=0.01)
    coordinates = jm.Controller(jm.MPC(flying, np.eye(12), np.eye(4), 2))  # no RobotController
    for call, message in (
        (lambda: many(law, PLANT, x0s[0], 5), r"x0s: shape \(2,\). Give \(B, 2\)"),
        (lambda: many(law, PLANT, x0s[:0], 5), "x0s: shape .0, 2."),
        (lambda: many(law, PLANT, np.zeros((4, 3)), 5), r"x0s: shape .4, 3.. Give \(B, 2\)"),
        (lambda: many(law, PLANT, x0s, 0), "steps: 0. Give a whole number"),
        (lambda: many(law, PLANT, x0s, 2.5), "steps: 2.5"),
        (lambda: many(law, PLANT, x0s, 5, chunk=0), "chunk: 0. Give a whole number"),
        (lambda: many(law, PLANT, x0s, 5, reference=[1.0]), r"reference: shape \(1,\). Give"),
        (lambda: many(law, PLANT, x0s, 5, input_reference=np.zeros((5, 1))), "input_reference: sh"),
        (
            lambda: many(law, PLANT, x0s, 5, variations={"B": np.zeros((4, 2, 1))}),
            r"variations\['B'\]: shape \(4, 2, 1\). Put 5 in front",
        ),
        (
            lambda: many(law, PLANT, x0s, 5, variations={"mass": np.ones(5)}),
            "mass: is no parameter of",
        ),
        (
            lambda: many(law, DOUBLE, x0s, 5, variations={"B": np.ones((5, 2, 1))}),
            "variations: given for a LinearSystem. Give a Robot",
        ),
        (
            lambda: many(law, pendulum, x0s, 5, variations={"body_mass": np.ones((5, 3))}),
            r"body_mass: shape \(5, 3\) where \(5, 2\) is needed",
        ),
        (lambda: many(law, quadrotor, x0s, 5), "plant: has 13 states and 4 inputs, the controller"),
        (
            lambda: many(coordinates, quadrotor, np.zeros((1, 12)), 5),
            "plant: has 13 states and 4 inputs, the controller 12 and 4. Give them in its coord",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            call()
