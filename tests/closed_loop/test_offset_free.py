"""Offset-free MPC: loads, sensor offsets, other plants and limits, against quadratic programs that
are solved by enumeration, closed forms and differences."""

import itertools
from dataclasses import replace

import daqp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy

import jaxmpc as jm
from jaxmpc.closed_loop import (
    Disturbance,
    KalmanFilter,
    LinearFeedback,
    OffsetFreeController,
    augmented,
)

# Two inputs, two outputs, three states; the second pair of matrices is another plant.
A = np.array([[0.8, 0.1, 0.0], [0.0, 0.7, 0.2], [0.1, 0.0, 0.6]])
B = np.array([[0.3, 0.0], [0.1, 0.2], [0.0, 0.4]])
C = np.array([[1.0, 0.0, 0.0], [0.0, 0.5, 1.0]])
SYSTEM = jm.LinearSystem(A, B, dt=0.1)
OTHER = jm.LinearSystem(
    A + 0.03 * np.array([[1.0, -1.0, 0.5], [0.2, -1.0, 1.0], [0.0, 0.7, -1.0]]), 1.1 * B,
    [0.05, -0.02, 0.04],
)  # fmt: skip
Q = C.T @ C + 1e-3 * np.eye(3)
R = 0.1 * np.eye(2)
MPC = jm.MPC(SYSTEM, Q, R, 6, inputs=jm.Box([-1.0, -1.0], [1.0, 1.0]))
GOAL = np.array([0.5, 0.2, 0.3])
# At rest x = LAG (B u + load), GAIN = LAG B; BOX u ≤ 1 are the limits of the inputs.
LAG = np.linalg.inv(np.eye(3) - A)
GAIN, BOX = LAG @ B, np.vstack([np.eye(2), -np.eye(2)])


pytestmark = pytest.mark.usefixtures("x64_of_module")


def observer(*disturbances, system=SYSTEM, C=C, **fields):
    return KalmanFilter(system, 0.3, 0.1, C=C, disturbance=disturbances, **fields)


@pytest.fixture(scope="module")
def controller():
    return jm.Controller(MPC)


LOADS = {
    "input": Disturbance("input", 1.0),
    "output": Disturbance("output", 1.0),
    "state": Disturbance("state", 1.0, [[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]]),
}


def nearest(E, e, G, g):
    """The w that minimises |E w − e| subject to G w ≤ g, by all active sets."""
    best = np.inf, None
    for count in range(E.shape[1] + 1):
        for rows in itertools.combinations(range(len(g)), count):
            K = np.block([[E.T @ E, G[[*rows]].T], [G[[*rows]], np.zeros((count, count))]])
            w = np.linalg.lstsq(K, np.concatenate([E.T @ e, g[[*rows]]]), rcond=None)[0][
                : E.shape[1]
            ]
            error = np.linalg.norm(E @ w - e)
            if np.all(G @ w <= g + 1e-9) and error < best[0]:
                best = error, w
    return best[1]


@pytest.mark.first(1)
@pytest.mark.parametrize("kind", LOADS)
@pytest.mark.slow
def test_no_error_on_another_plant(kind, controller):
    """Under loads on the states and an offset of the sensors, whatever the model of the
    disturbance; without one an error remains."""
    steps = 250
    offset = np.tile([0.05, -0.1], (steps, 1))
    free = OffsetFreeController(controller, observer(LOADS[kind]))
    run = jm.simulate(free, OTHER, np.zeros(3), steps, reference=GOAL, output_disturbance=offset)
    measured = run.states @ C.T + offset[0]
    assert np.abs(measured[-1] - C @ GOAL).max() < 1e-8
    assert np.all(run.status == jm.Status.SOLVED)
    assert run.disturbances.shape == (steps, 2)
    # Beyond what inputs within their limits can hold: the nearest that they can, of the same model
    # under a load that it does not know.
    load, goal = np.array([0.1, 0.05, -0.1]), np.array([5.0, 0.5, 1.0])
    given = dict(reference=goal, output_disturbance=offset)
    run = jm.simulate(free, replace(OTHER, A=A, B=B, c=load), np.zeros(3), steps, **given)
    u = nearest(C @ GAIN, C @ (goal - LAG @ load) - offset[0], BOX, np.ones(4))
    assert np.isclose(np.abs(u), 1.0).any()
    np.testing.assert_allclose(run.inputs[-1], u, atol=1e-8)


@pytest.mark.slow
def test_a_plain_controller_leaves_an_error(controller):
    run = jm.simulate(controller, OTHER, np.zeros(3), 100, reference=GOAL)
    assert np.abs((run.states[-1] - GOAL) @ C.T).max() > 0.01


@pytest.mark.slow
def test_the_nearest_target_where_limits_are_active():
    """Known model, unknown load: the loop settles at the nearest steady state of the plant itself,
    in units that weigh the outputs differently, with a limit of an input and one of a state."""
    load, goal, units = np.array([0.1, 0.05, -0.1]), np.array([2.5, 0.0, 1.5]), np.array([1.0, 0.2])
    mpc = replace(
        MPC, states=jm.Box([-9.0, -9.0, -9.0], [1.3, 9.0, 9.0]), constrain_initial=False,
        terminal_cost=jm.lqr(SYSTEM, Q, R).P,
    )  # fmt: skip
    exact = observer(LOADS["state"], C=np.eye(3)[[0, 2]])
    exact = replace(exact, disturbance=Disturbance("state", 1.0), C=np.eye(3))
    free = OffsetFreeController(jm.Controller(mpc), exact, C @ np.eye(3), units)
    run = jm.simulate(free, replace(SYSTEM, c=load), np.zeros(3), 200, reference=goal)
    base = LAG @ load
    G, g = np.vstack([BOX, GAIN[:1]]), np.append(np.ones(4), 1.3 - base[0])
    u = nearest(C @ GAIN / units[:, None], C @ (goal - base) / units, G, g)
    assert np.sum(G @ u > g - 1e-9) >= 1 and np.abs(C @ (GAIN @ u + base - goal)).max() > 0.1
    np.testing.assert_allclose(run.inputs[-1], u, atol=1e-8)
    np.testing.assert_allclose(run.states[-1], GAIN @ u + base, atol=1e-8)
    np.testing.assert_allclose(run.disturbances[-1], load, atol=1e-8)
    assert run.violation[-1] < 1e-9


@pytest.mark.slow
def test_targets_at_random():
    """Against enumeration, under disturbances, forecasts and references of many sizes; which
    outputs can be reached exactly is what a linear program would say."""
    mpc = replace(MPC, outputs=jm.Outputs([[1.0, 1.0, 0.0]], upper=[1.2], D=[[0.3, -0.2]]))
    free = OffsetFreeController(jm.Controller(mpc), observer(LOADS["input"]))
    rng, exact = np.random.default_rng(0), 0
    for _ in range(20):
        r, d, e = rng.normal(size=3), 0.3 * rng.normal(size=2), 0.1 * rng.normal(size=3)
        base = LAG @ (B @ d + e)
        row = np.array([[1.0, 1.0, 0.0]])
        G = np.vstack([BOX, row @ GAIN + [[0.3, -0.2]]])
        g = np.append(np.ones(4), 1.2 - row @ base)
        u = nearest(C @ GAIN, C @ (r - base), G, g)
        found = free.target(r, d, e)
        assert found.status == jm.Status.SOLVED
        np.testing.assert_allclose(found.u, u, atol=1e-8)
        np.testing.assert_allclose(found.x, GAIN @ u + base, atol=1e-8)
        exact += np.abs(C @ (found.x - r)).max() < 1e-9
    assert 0 < exact < 20
    rows = free.target(np.stack([r] * 7), d, np.stack([e] * 6))
    assert rows.x.shape == (7, 3) and rows.u.shape == (6, 2)
    np.testing.assert_allclose(rows.x[3], found.x, atol=1e-9)


@pytest.mark.slow
def test_redundant_inputs():
    """Two inputs for one output: exactly there, with an input at its limit too, by least effort."""
    one = observer(Disturbance("output", 1.0), C=C[:1])
    free = OffsetFreeController(jm.Controller(MPC), one)
    for level in (0.3, 0.9 * float(np.abs(C[:1] @ GAIN).sum())):
        found = free.target(np.array([level, 0.0, 0.0]))
        assert found.status == jm.Status.SOLVED
        np.testing.assert_allclose(C[:1] @ found.x, [level], atol=1e-9)
        np.testing.assert_allclose(found.x, A @ found.x + B @ found.u, atol=1e-12)
        assert np.abs(found.u).max() <= 1 + 1e-9
    assert np.abs(found.u).max() > 1 - 1e-5


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_targets_of_redundant_inputs_in_any_units(seed):
    """Three inputs, one tracked output: it is as near as linear programs bring it, with the least
    effort u'Ru that DAQP finds there, whatever the units of states, inputs and distances."""
    rng = np.random.default_rng(seed)
    A, B, C = (
        np.diag([0.9, 0.6]) + 0.1 * rng.normal(size=(2, 2)),
        rng.normal(size=(2, 3)),
        rng.normal(size=2),
    )
    R, most = rng.uniform(0.1, 1, 3), np.append(rng.uniform(0.3, 1, 3), rng.uniform(0.5, 3, 2))
    gain = np.linalg.solve(np.eye(2) - A, B)
    rows = np.vstack([np.eye(3), gain])  # of u and of x at rest
    values = [scipy.optimize.linprog(sign * C @ gain, np.vstack([rows, -rows]), np.tile(most, 2),
                                     bounds=(None, None)).fun for sign in (1, -1)]  # fmt: skip
    for goal in (0.5 * values[0], -0.9 * values[1], -1.5 * values[1]):
        best = np.clip(goal, values[0], -values[1])
        lower, upper = np.append(-most, best - 1e-10), np.append(most, best + 1e-10)
        u = daqp.solve(np.diag(2 * R), np.zeros(3), np.vstack([rows, C @ gain]), upper, lower,
                       np.zeros(6, np.int32))[0]  # fmt: skip
        for size in (0, 3, 20):
            sx, su = (
                2.0 ** rng.integers(-size, size + 1, 2),
                2.0 ** rng.integers(-size, size + 1, 3),
            )
            system = jm.LinearSystem(sx[:, None] * A / sx, sx[:, None] * B / su)
            mpc = jm.MPC(
                system, 1 / sx**2, R / su**2, 4, states=jm.Box(-sx * most[3:], sx * most[3:]),
                inputs=jm.Box(-su * most[:3], su * most[:3]), constrain_initial=False,
            )  # fmt: skip
            seen = KalmanFilter(
                system, 0.1 * sx, 0.1, C=[C / sx], disturbance=Disturbance("output", 0.1)
            )
            free = OffsetFreeController(
                jm.Controller(mpc), seen, units=[10.0 ** rng.integers(-4, 5)]
            )
            found = free.target(sx * C * goal / (C @ C))
            assert found.status == jm.Status.SOLVED
            assert abs(C @ (found.x / sx) - best) < 1e-8
            np.testing.assert_allclose(found.u / su, u, atol=1e-5)


@pytest.mark.slow
def test_no_steady_state_has_its_status():
    """A load beyond the inputs on an unstable model: the plans say so."""
    unstable = jm.LinearSystem([[1.5]], [[1.0]])
    mpc = jm.MPC(
        unstable, [[1.0]], [[1.0]], 3, states=jm.Box([-1.0], [1.0]), inputs=jm.Box([-1], [1])
    )
    filter_ = observer(Disturbance("input", 1.0), system=unstable, C=[[1.0]])
    free = OffsetFreeController(jm.Controller(mpc), filter_)
    assert free([0.1], disturbance=[0.2]).plan.solved
    assert free([0.1], disturbance=[2.0]).plan.status == jm.Status.PRIMAL_INFEASIBLE


@pytest.mark.slow
def test_previews(controller):
    """A load on the inputs that is known ahead never shows at the outputs, nor as an estimate; one
    that is not known does. A reference that is known ahead is met sooner."""
    free, steps = OffsetFreeController(controller, observer(LOADS["input"])), 40
    known = np.zeros((steps + 5, 3))
    known[20:] = B @ [0.2, -0.1]
    loaded = dict(disturbance=known[:steps])
    run = jm.simulate(free, SYSTEM, np.zeros(3), steps, **loaded, forecast=known)
    assert np.abs(run.states @ C.T).max() < 1e-9 and np.abs(run.disturbances).max() < 1e-9
    surprised = jm.simulate(free, SYSTEM, np.zeros(3), steps, **loaded)
    assert np.abs(surprised.states @ C.T).max() > 0.01
    np.testing.assert_allclose(surprised.disturbances[-1], [0.2, -0.1], atol=1e-2)
    step = np.where(np.arange(steps + 6)[:, None] < 20, 0.0, GOAL)
    ahead = jm.simulate(free, OTHER, np.zeros(3), steps, reference=step)
    assert np.all(ahead.status == jm.Status.SOLVED)
    still = jm.simulate(free, OTHER, np.zeros(3), 40, reference=0 * step)
    np.testing.assert_allclose(ahead.states[:14], still.states[:14], atol=1e-9)
    assert np.abs(ahead.states[20] - still.states[20]).max() > 0.01


@pytest.mark.slow
def test_many_loops(controller):
    """Loops under loads of their own, in parts, are those of `simulate`; a delay changes nothing of
    where they settle."""
    free = OffsetFreeController(controller, observer(LOADS["input"]))
    loads = 0.1 * np.random.default_rng(0).normal(size=(3, 3))
    plant = jm.LinearPlant(OTHER, jm.Box([-9.0] * 3, [9.0] * 3), MPC.inputs)
    given = dict(reference=GOAL, delay=1)
    runs = jm.simulate_many(
        free, plant, np.zeros((3, 3)), 250, variations=dict(c=loads), chunk=2, **given
    )
    assert np.abs((runs.states[:, -1] - GOAL) @ C.T).max() < 1e-8
    alone = jm.simulate(free, plant.vary(c=loads[2]), np.zeros(3), 250, **given)
    np.testing.assert_allclose(runs.states[2], alone.states, atol=1e-9)
    np.testing.assert_allclose(runs.disturbances[2], alone.disturbances, atol=1e-9)


@pytest.mark.slow
def test_time_varying_gain_is_the_textbook_recursion(controller):
    """The filter of (x, d) with covariances, by NumPy."""
    load = Disturbance("input", 0.2, initial=0.5)
    filter_ = observer(load, initial=[0.1, 0.2, 0.3], start=[0.1, 0.0, 0.0])
    free = OffsetFreeController(controller, filter_)
    run = jm.simulate(free, OTHER, np.zeros(3), 12, reference=GOAL)
    zero = np.zeros
    M, N = np.block([[A, B], [zero((2, 3)), np.eye(2)]]), np.vstack([B, zero((2, 2))])
    H, W = np.hstack([C, zero((2, 2))]), np.diag([0.09] * 3 + [0.04] * 2)
    z, P = np.array([0.1, 0, 0, 0, 0]), np.diag([0.01, 0.04, 0.09, 0.25, 0.25])
    for t in range(12):
        L = P @ H.T @ np.linalg.inv(H @ P @ H.T + 0.01 * np.eye(2))
        z, P = z + L @ (C @ run.states[t] - H @ z), P - L @ H @ P
        np.testing.assert_allclose(run.estimates[t], z[:3], atol=1e-10)
        np.testing.assert_allclose(run.disturbances[t], z[3:], atol=1e-10)
        z, P = M @ z + N @ run.inputs[t], M @ P @ M.T + W


@pytest.mark.slow
def test_a_robots_own_model_estimates_a_torque():
    """The extended filter of a pendulum that carries a constant torque, from its angle alone."""
    robot, torque = jm.load_robot("pendulum"), 0.3

    class Loaded:
        coordinates, state = staticmethod(robot.coordinates), staticmethod(robot.state)
        state_size, m = robot.state_size, robot.m

        def step(self, x, u):
            return robot.step(x, u + torque)

    mpc = jm.MPC(jm.LinearSystem(np.eye(2), [[0.0], [1.0]]), np.eye(2), [[1.0]], 2)
    law = LinearFeedback(mpc, [[-40.0, -10.0]], robot)
    load = Disturbance("input", 0.05, initial=0.5)
    filter_ = KalmanFilter(robot, 1e-4, 1e-3, initial=0.01, disturbance=load)
    run = jm.simulate(law, Loaded(), robot.equilibrium()[0], 60, observer=filter_)
    np.testing.assert_allclose(run.disturbances[-1], [torque], atol=1e-3)
    np.testing.assert_allclose(run.estimates[-1], run.states[-2], atol=1e-3)


@pytest.mark.slow
def test_derivatives_through_estimator_and_targets():
    """Of a cost of the loop in start, reference, load, weight and the filter's noise: differences;
    an input is at its limit for some steps, and so is the target's."""
    base = observer(LOADS["input"])
    limits = jm.Box([-1.0, -1.0], [0.55, 1.0])

    def cost(theta):
        x0, goal, load, weight, noise = theta[:3], theta[3:6], theta[6:9], theta[9], theta[10]
        mpc = replace(MPC, Q=weight * jnp.asarray(Q), inputs=limits)
        filter_ = replace(base, disturbance=Disturbance("input", noise))
        free = OffsetFreeController(jm.Controller(mpc), filter_)
        run = jm.simulate(free, replace(OTHER, c=load), x0, 12, reference=goal)
        return jnp.sum(run.states**2) + jnp.sum(run.inputs[:, 1] ** 3), run.inputs

    theta = jnp.array([0.3, -0.2, 0.1, 0.9, 0.2, 0.3, 0.05, -0.02, 0.04, 1.5, 0.7])
    value = jax.jit(cost)
    slope, inputs = jax.jit(jax.grad(cost, has_aux=True))(theta)
    at_limit = np.isclose(inputs[:, 0], 0.55)
    assert 0 < at_limit.sum() < 12
    h = 1e-5
    want = [(value(theta + e)[0] - value(theta - e)[0]) / (2 * h) for e in h * np.eye(11)]
    np.testing.assert_allclose(slope, want, rtol=1e-6, atol=1e-6)
    # Of a target at a limit of an input, too.
    free = OffsetFreeController(jm.Controller(replace(MPC, inputs=limits)), base)
    target = jax.jit(lambda d: free.target(jnp.array([2.0, 0.0, 0.5]), d)[:2])
    d = jnp.array([0.1, -0.2])
    assert np.isclose(target(d)[1], [0.55, 1.0]).sum() == 1
    slopes = jax.jacrev(target)(d)
    for i, e in enumerate(h * np.eye(2)):
        for got, after, before in zip(slopes, target(d + e), target(d - e), strict=True):
            np.testing.assert_allclose(got[:, i], (after - before) / (2 * h), atol=1e-6)


@pytest.mark.slow
def test_feasible_sets_with_a_disturbance_as_parameter():
    """x⁺ = x + u + d, |x| ≤ 1, |u| ≤ 0.3, horizon 2: feasible from where |x| ≤ 1 for d within the
    inputs, and from −1 + … for d = 0.5 from where two steps of net +0.2 end at 1 at most."""
    line = jm.LinearSystem([[1.0]], [[1.0]])
    box = jm.Box([-1.0], [1.0])
    mpc = jm.MPC(
        line, [[1.0]], [[1.0]], 2, states=box, inputs=jm.Box([-0.3], [0.3]), terminal_set=box
    )
    more = augmented(mpc, observer(Disturbance("input", 1.0), system=line, C=[[1.0]]))
    x0s = np.linspace(-1.2, 1.2, 25)[:, None]
    for d, most in ((0.2, 1.0), (0.5, 0.6)):
        found = jm.map_feasible_set(more, x0s, axes=[0], fixed=[0.0, d])
        inside = (np.abs(x0s[:, 0]) <= 1 + 1e-9) & (x0s[:, 0] <= most + 1e-9)
        edge = np.isclose(x0s[:, 0], most)
        np.testing.assert_array_equal(found.label[~edge], np.where(inside, 1, -1)[~edge])


def test_augmented_problems_take_traced_weights():
    mpc, filter_ = MPC, observer(Disturbance("input", 1.0))
    wanted = augmented(mpc, filter_)
    for name in ("Q", "terminal_cost"):
        found = jax.jit(lambda v, name=name: augmented(replace(mpc, **{name: v}), filter_))(
            np.eye(mpc.system.n)
        )
        np.testing.assert_array_equal(np.shape(getattr(found, name)), np.shape(wanted.Q))


@pytest.mark.slow
def test_augmented_problem_gives_the_same_plans(controller, tmp_path):
    """With (x, d) as its state and the target as its reference; so exported programs do."""
    mpc = replace(
        MPC, states=jm.Polytope(np.vstack([np.eye(3), -np.eye(3)]), np.ones(6)),
        terminal_set=jm.Box([-1.0] * 3, [1.0] * 3), terminal_cost=np.eye(3),
        soft=jm.Soft([[1.0, 1.0, 0.0]], upper=[0.9]),
        outputs=jm.Outputs(np.eye(3)[:1], upper=[0.8]),
    )  # fmt: skip
    filter_ = observer(LOADS["input"])
    free = OffsetFreeController(jm.Controller(mpc), filter_)
    x, d = np.array([0.3, 0.1, -0.2]), np.array([0.1, -0.2])
    want, target = free(x, None, GOAL, disturbance=d), free.target(GOAL, d)
    more = augmented(mpc, filter_)
    r = np.append(target.x, [0.0, 0.0])
    plan = jm.solve(more, np.append(x, d), r, input_reference=target.u)
    assert plan.solved and want.plan.solved
    np.testing.assert_allclose(plan.inputs, want.plan.inputs, atol=1e-8)
    np.testing.assert_allclose(plan.cost, want.plan.cost, atol=1e-8)
    path = jm.export.export_jax(more, tmp_path / "plans.jax", platforms=("cpu",))
    program = jax.export.deserialize(path.read_bytes())
    found = program.call(np.append(x, d)[None], r[None], np.asarray(target.u)[None])
    np.testing.assert_allclose(found["inputs"][0], want.plan.inputs, atol=1e-8)


def test_what_cannot_be_told_apart_is_named():
    """In any units; where the rank is lost by integrating states, by two disturbances alike, or by
    states that no output shows."""
    joint = jm.LinearSystem([[1.0, 0.1], [0.0, 0.9]], [[0.0], [0.1]], state_names=("q", "dq"))
    first, both = [[1.0, 0.0]], np.eye(2)

    def prepared(load, C, system=joint):
        return KalmanFilter(system, 0.3, 0.1, C=C, disturbance=load).prepared()

    prepared(Disturbance("input", 1.0), first)
    for unit in (1.0, 1e6, 1e-6):
        T = np.diag([1.0, unit])
        scaled = replace(joint, A=np.linalg.inv(T) @ joint.A @ T, B=np.linalg.inv(T) @ joint.B)
        prepared(Disturbance("input", 1.0, [[unit]]), first, scaled)
        message = "outputs do not tell the disturbance of output 1 from q at rest. Let dis"
        with pytest.raises(ValueError, match=message):
            prepared(Disturbance("output", 1.0, [[unit]]), first, scaled)
    alike = Disturbance("input", 1.0, [[1.0, 2.0]])
    with pytest.raises(
        ValueError, match="of input 1, the disturbance of input 1 apart at rest. Lea"
    ):
        prepared(alike, both)
    with pytest.raises(ValueError, match="observer.C: no output shows q at rest. Measure it"):
        prepared(Disturbance("input", 1.0), [[0.0, 1.0]])
    with pytest.raises(ValueError, match="has 2 disturbances, and 1 outputs are measured. Give at"):
        prepared((Disturbance("input", 1.0), Disturbance("output", 1.0)), first)


@pytest.mark.long
def test_bad_arguments_are_named(controller):
    good = observer(LOADS["input"])
    free = OffsetFreeController(controller, good)
    odd = replace(good, disturbance=())
    load = lambda *given, **more: observer(Disturbance(*given, **more)).prepared()
    wide = jm.Box([-9.0] * 3, [9.0] * 3)
    state = jm.RobotController(jm.LinearPlant(SYSTEM, wide, MPC.inputs), MPC)
    drifting = jm.LinearSystem(np.diag([1.0, 0.5]), [[0.0], [1.0]])
    drifting_filter = observer(Disturbance("input", 1.0), system=drifting, C=np.eye(2))
    drifting_mpc = jm.MPC(drifting, np.eye(2), [[1.0]], 3)
    run = lambda c, **given: jm.simulate(c, SYSTEM, np.zeros(3), 4, **given)
    ball = replace(MPC, terminal_set=jm.Ellipsoid(np.eye(3), 1.0))
    for call, message in (
        (lambda: load("force", 1.0), r"observer.disturbance\[0\].kind: 'force'. Give one of input"),
        (lambda: load("payload", 1.0), r"'payload'. Give .* with a Robot as the model also its"),
        (lambda: load("input", 0.0), r"disturbance\[0\].process: leaves a disturbance without"),
        (lambda: load("input", None), r"disturbance\[0\].process: is None"),
        (lambda: load("input", [1.0] * 3), r"disturbance\[0\].process: shape \(3,\)"),
        (lambda: load("output", 1.0, np.eye(3)), r"matrix: shape \(3, 3\). Give \(2, k\), a row"),
        (lambda: load("input", 1.0, [[np.nan], [1.0]]), "matrix: holds NaN"),
        (
            lambda: observer(Disturbance("input", 1.0), initial=1.0).prepared(),
            "initial: is None, and observer.initial is given",
        ),
        (lambda: observer("input").prepared(), "observer.disturbance: is a tuple. Give a closed"),
        (lambda: OffsetFreeController(controller, odd), "observer.disturbance: is empty"),
        (lambda: OffsetFreeController(MPC, good), "controller: is an MPC"),
        (lambda: OffsetFreeController(controller, SYSTEM), "observer: is a LinearSystem"),
        (lambda: OffsetFreeController(state, good), "controller: linearises about the state. Give"),
        (
            lambda: OffsetFreeController(controller, replace(good, model=OTHER)),
            "observer.model: differs from mpc.system",
        ),
        (lambda: OffsetFreeController(controller, drifting_filter), "observer.model: has 2 states"),
        (
            lambda: OffsetFreeController(jm.Controller(drifting_mpc), drifting_filter),
            "mpc.system: no input holds a load on x1, which integrates it. Actuate it",
        ),
        (lambda: OffsetFreeController(controller, good, [1.0, 0.0]), r"tracked: shape \(2,\)"),
        (lambda: OffsetFreeController(controller, good, None, [1.0]), r"units: shape \(1,\)"),
        (lambda: OffsetFreeController(controller, good, None, [1.0, 0.0]), "units: .* Give pos"),
        (
            lambda: OffsetFreeController(controller, good, [[0.0, 0.0]]),
            "tracked: no input moves them",
        ),
        (lambda: free.target(np.zeros(2)), r"reference: shape \(2,\). Give \(3,\) or \(7, 3\)"),
        (lambda: free(np.zeros(3), disturbance=[1.0]), r"disturbance: shape \(1,\). Give \(2,\)"),
        (lambda: run(free, observer=good), "observer: given beside that of the controller"),
        (lambda: run(free, output_disturbance=np.zeros((4, 3))), r"output_disturbance: shape"),
        (lambda: run(controller, forecast=np.zeros((4, 3))), r"forecast: shape \(4, 3\). Give"),
        (
            lambda: run(LinearFeedback(MPC, np.zeros((2, 3))), forecast=np.zeros(3)),
            "forecast: given to a LinearFeedback whose plans take none. Give a Controller",
        ),
        (lambda: augmented(ball, good), "terminal_set: is an Ellipsoid. Use a Polytope"),
        (
            lambda: augmented(replace(MPC, disturbance=jm.Box([-0.01] * 3, [0.01] * 3)), good),
            "mpc.disturbance: is given",
        ),
        (lambda: augmented(drifting_mpc, good), "observer.model: has 3 states and 2 inputs"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=message):
            call()
