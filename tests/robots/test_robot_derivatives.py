"""Derivatives of plants that can touch, every integrator in both precisions, and rewriting."""

import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from c_engine import EPS, by_differences, c_steps, c_transition
from jax.extend.core.primitives import cholesky_p, triangular_solve_p
from jax.scipy.linalg import cho_factor, cho_solve

import jaxmpc as jm
from jaxmpc.qp.linalg import cholesky, solve_general
from jaxmpc.robots.jaxpr_rewriting import rewritten


def pair(first, second, cone="elliptic"):
    """A shape on a slide with dry friction before a fixed one, 0.5 m away: they touch at 0.4 m."""
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco><option timestep="0.005" cone="{cone}" gravity="0 0 0"/>
        <worldbody><geom type="{first}" size=".05 .1 .1" pos=".5 0 0"/>
        <body><joint name="slide" type="slide" axis="1 0 0" frictionloss=".2"/>
        <geom type="{second}" size=".05 .1 .1" mass="1"/></body></worldbody>
        <actuator><motor joint="slide" ctrlrange="-9 9"/></actuator></mujoco>""")
    return jm.load_robot(model)


def swing(integrator, extra=""):
    """A rod on a hinge with a stop."""
    return mujoco.MjModel.from_xml_string(f"""
        <mujoco><option timestep="0.01" integrator="{integrator}"/>
        <worldbody><body><joint name="a" axis="0 1 0" damping=".1" range="-60 60"/>
        <geom type="capsule" size=".02" fromto="0 0 0 .4 0 0" mass="1"/></body></worldbody>
        <actuator><motor joint="a" ctrlrange="-9 9"/></actuator>{extra}</mujoco>""")


def assert_close(found, wanted, tolerance=1e-6):
    """A, B to a share of the largest entry of A."""
    size = np.abs(wanted[0]).max()
    for a, b in zip(found, wanted, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * size)


# --- at rest and at limits -------------------------------------------------------------------

PULLED = """<mujoco><option timestep="{timestep}" gravity="0 0 0"/><worldbody><body>
    <joint name="a" axis="0 1 0" damping=".05"/><geom type="capsule" fromto="0 0 0 0 0 -.3"
    size=".03" contype="0" conaffinity="0"/></body></worldbody><actuator>{actuators}</actuator>
    </mujoco>"""


def inward(model, x, u, substeps, sides):
    """Derivatives (n, ...) of a control period of the C engine, by its differences to one side."""
    point, after = np.concatenate([x, u]), c_steps(model, x, u, substeps)
    rows = []
    for side, e in zip(sides, EPS * np.eye(len(point)), strict=True):
        x_1, u_1 = np.split(point + side * e, [len(x)])
        rows.append((c_steps(model, x_1, u_1, substeps) - after) / (side * EPS))
    return np.split(np.transpose(rows), [len(x)], axis=1)


@pytest.mark.parametrize("timestep", [0.002, 0.01])
@pytest.mark.parametrize("u", [(0.0, 0.0), (1.0, 0.3)])
def test_muscles_at_the_ends_of_their_excitation(x64, timestep, u):
    """MuJoCo clamps it to [0, 1] in every file, and two that rest have 0: linear models are those
    of a muscle that begins to pull."""
    muscle = '<muscle joint="a" gear="{}" lengthrange="-1.5 1.5" force="10"/>'
    text = PULLED.format(timestep=timestep, actuators=muscle.format(1) + muscle.format(-1))
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(text), control_period=0.01)
    for end, wanted in zip(robot.input_limits.bounds(), ([0, 0], [1, 1]), strict=True):
        np.testing.assert_array_equal(end, wanted)
    assert [limit[-1] for limit in robot.report().limits[-2:]] == ["file, muscle"] * 2
    u = np.array(u)
    x = np.array([0.1, 0.2, *(0.2 * u)])
    sides = [1.0, 1.0, 1.0, 1.0, *np.where(u == 1, -1.0, 1.0)]
    A, B = inward(robot.mujoco, x, u, robot.substeps, sides)
    model = robot.linearize(x, u, exact=True)
    # At rest A is that of excitations above the activation, too.
    np.testing.assert_allclose(model.B, B, atol=1e-4 * np.abs(B).max())
    np.testing.assert_allclose(model.A[:, :2], A[:, :2], atol=1e-4 * np.abs(A).max())
    np.testing.assert_allclose(
        model.A @ x + model.B @ u + model.c, c_steps(robot.mujoco, x, u, robot.substeps), atol=1e-9
    )


@pytest.mark.parametrize("at, u", [(0.5, 0.0), (0.5, 0.3), (0.4999, 0.3), (-0.5, -1.0)])
def test_activations_at_the_ends_of_their_range(x64, at, u):
    """Rows of the problem keep it; a clamp besides would take the input away."""
    servo = '<intvelocity joint="a" kp="10" actrange="-.5 .5" ctrlrange="-1 1"/>'
    text = PULLED.format(timestep=0.01, actuators=servo)
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(text))
    x = np.array([0.0, 0.0, at])
    A, B = inward(robot.mujoco, x * [1, 1, 0.5], [0.0], robot.substeps, np.ones(4))
    model = robot.linearize(x, [u], exact=True)
    np.testing.assert_allclose(model.A, A, atol=1e-6)
    np.testing.assert_allclose(model.B, B, atol=1e-6)


@pytest.mark.parametrize("integrator", ["Euler", pytest.param("RK4", marks=pytest.mark.slow)])
@pytest.mark.slow
def test_springs_at_their_rest(integrator):
    """At home no spring pulls, which MJX takes for no stiffness: of orientations, of tendons, and
    of servos of both. Against mjd_transitionFD, and from a state near by."""
    box = '<geom type="box" size=".1 .2 .15" mass="1"/>'
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco><option timestep="0.005" gravity="0 0 0" integrator="{integrator}"/>
        <default><geom contype="0" conaffinity="0"/></default>
        <worldbody><site name="w" pos="0 .1 .5"/>
        <body quat=".9 .1 .3 .2"><joint name="ball" type="ball" stiffness="2"/>{box}
          <body pos=".3 0 0" quat=".8 0 .6 0"><joint name="held" type="ball"/>{box}
            <site name="hand" pos="0 0 .2"/></body></body>
        <body pos="1 0 0"><joint name="free" type="free" stiffness="3"/>{box}
          <site name="mast" quat=".6 0 0 .8"/></body>
        <body pos="0 1 0"><joint name="a" axis="0 1 0"/>{box}
          <body pos=".3 0 0"><joint name="b" axis="0 0 1"/>{box}
            <site name="tip" pos=".2 0 0"/></body>
        </body></worldbody>
        <tendon>
          <fixed stiffness="5"><joint joint="a" coef="1"/><joint joint="b" coef="-.5"/></fixed>
          <spatial stiffness="4" damping=".1"><site site="w"/><site site="tip"/></spatial>
          <fixed name="t"><joint joint="b" coef="2"/></fixed></tendon>
        <actuator><position joint="held" kp="2" gear="1 0 .3"/>
          <position jointinparent="held" kp="1" gear="0 1 0"/>
          <position site="mast" refsite="w" kp="3" gear=".5 0 0 0 1 .2"/>
          <position tendon="t" kp="2"/></actuator></mujoco>""")
    robot = jm.load_robot(model)
    home, u = np.asarray(robot.home, float), np.zeros(robot.m)
    moved = np.random.default_rng(0).uniform(-1e-3, 1e-3, robot.n)
    with jax.enable_x64(True):
        transition = jax.jit(robot.transition)
        for x in (home, np.asarray(robot.state(robot.coordinates(home) + moved))):
            assert_close(transition(x, u), c_transition(robot, x, u))


# --- both precisions -------------------------------------------------------------------------


NARROW_LAST, WIDE_LAST = (True, False), (False, True)


@pytest.mark.parametrize(
    "integrator, order",
    [
        ("RK4", NARROW_LAST),
        ("implicitfast", WIDE_LAST),
        pytest.param("RK4", WIDE_LAST, marks=pytest.mark.slow),
        pytest.param("Euler", NARROW_LAST, marks=pytest.mark.slow),
    ],
)
@pytest.mark.first(1)
@pytest.mark.slow
def test_every_integrator_in_both_precisions(integrator, order):
    """Of one robot, one after the other: JAX remembers how it read MJX's NumPy constants."""
    robot = jm.load_robot(swing(integrator))
    x, u = np.array([0.3, -0.4]), np.array([0.7])
    wanted = c_steps(robot.mujoco, x, u, 1)
    for wide in order * 2:
        with jax.enable_x64(wide):
            after = robot.step(jnp.asarray(x), jnp.asarray(u))
            assert after.dtype == (np.float64 if wide else np.float32)
            np.testing.assert_allclose(after, wanted, rtol=0, atol=1e-12 if wide else 1e-6)


@pytest.mark.slow
def test_float32_states_while_64_bit_mode_is_on():
    """Numbers of MJX are in float64 then; states and models keep the type of what was given."""
    robot = jm.load_robot(swing("Euler"))
    x, u = np.array([0.3, -0.4], np.float32), np.array([0.7], np.float32)
    with jax.enable_x64(True):
        after, found = robot.step(x, u), robot.linearize(x, u)
        wanted = robot.linearize(x.astype(float), u.astype(float))
        assert (after.dtype, found.A.dtype, found.c.dtype) == (np.float32,) * 3
        np.testing.assert_allclose(after, c_steps(robot.mujoco, x, u, 1), rtol=0, atol=1e-6)
        np.testing.assert_allclose(found.A, wanted.A, rtol=0, atol=1e-5)
        # A predictor without rows, whose accelerations have a rule of their own.
        A, B = jm.load_robot("arm2").transition(np.ones(4, np.float32), np.ones(2, np.float32))
        assert (A.dtype, B.dtype) == (np.float32,) * 2


@pytest.mark.slow
def test_rk4_in_a_loop_in_float32():
    """The problem is made in float64, the loop runs in float32: the rod goes to its target."""
    robot = jm.load_robot(swing("RK4"))
    mpc = jm.robot_mpc(robot, horizon=10, target=[0.2])
    x, u = robot.equilibrium([0.2])
    run = jm.simulate(
        jm.RobotController(robot, mpc, linearize="set-point"), robot, np.zeros(2), 150,
        reference=x, input_reference=u,
    )  # fmt: skip
    assert run.states.dtype == np.float32
    np.testing.assert_allclose(run.states[-1], x, rtol=0, atol=2e-3)


@pytest.mark.slow
def test_rk4_moves_orientations():
    """A body that flies and one on a ball joint, 50 steps and A, B, against the C engine."""
    model = mujoco.MjModel.from_xml_string("""
        <mujoco><option timestep="0.01" integrator="RK4"/>
        <worldbody><body><freejoint name="base"/>
        <inertial pos=".01 .02 0" mass="2" diaginertia=".02 .03 .04"/>
        <body pos=".3 0 0"><joint name="ball" type="ball" damping=".1"/>
        <inertial pos=".1 0 .02" mass="1" diaginertia=".002 .01 .01"/></body></body></worldbody>
        <actuator><motor joint="base" gear="0 0 1 .1 0 .2"/><motor joint="ball" gear="1 .5 .2"/>
        </actuator></mujoco>""")
    robot, rng = jm.load_robot(model), np.random.default_rng(0)
    q = rng.normal(size=11)
    q[3:7] /= np.linalg.norm(q[3:7])
    q[7:] /= np.linalg.norm(q[7:])
    x, u = np.concatenate([q, rng.normal(size=9)]), np.array([20.0, 0.3])
    with jax.enable_x64(True):
        found = jax.jit(robot.transition)(x, u)
        assert_close(found, c_transition(robot, x, u))
        step = jax.jit(robot.plant.step)
        ours = theirs = x
        for _ in range(50):
            ours, theirs = step(ours, u), c_steps(robot.mujoco, theirs, u, 1)
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-10)


# --- contacts --------------------------------------------------------------------------------


# At a distance, just before touching, touching.
AT = [np.array([q, 0.1]) for q in (0.1, 0.39, 0.403)]


@pytest.mark.slow
@jax.enable_x64(True)
def test_linear_models_of_turning_bodies_have_derivatives():
    """dA and dB along a path on which a free body turns: both ends of the way whose derivative A is
    move with the state, which left 7 times the derivative."""
    model = mujoco.MjModel.from_xml_string("""
        <mujoco><option timestep="0.01"/><worldbody><body><freejoint/>
        <geom type="box" size=".1 .2 .3" mass="1"/><site name="top" pos="0 0 .3"/>
        </body></worldbody><actuator><motor site="top" gear="1 2 0 0 1 1" ctrlrange="-9 9"/>
        </actuator></mujoco>""")
    robot, u = jm.load_robot(model), np.array([0.5])
    turn = np.array([0.3, 0.4, -0.5, 0.2])

    def matrices(s):
        q = jnp.array([1.0, 0, 0, 0]) + s * turn
        x = jnp.concatenate([s * jnp.ones(3), q / jnp.linalg.norm(q), s * jnp.arange(6) - 1])
        return jnp.concatenate(robot.transition(x, u), axis=1)

    found = jax.jacfwd(matrices)(0.7)
    expected = (matrices(0.7 + 1e-5) - matrices(0.7 - 1e-5)) / 2e-5
    assert np.abs(expected).max() > 0.01
    np.testing.assert_allclose(found, expected, atol=1e-7)


@pytest.mark.slow
def test_derivatives_with_elliptic_contacts():
    """NaN if differentiated through MJX's solver, which friction makes iterate, though nothing
    touches."""
    robot, u = pair("sphere", "sphere"), np.array([2.0])
    with jax.enable_x64(True):
        transition = jax.jit(robot.transition)
        for x in AT:
            wanted = c_transition(robot, x, u)
            assert (np.abs(wanted[0]).max() > 1.5) == (x[0] > 0.4)
            assert_close(transition(x, u), wanted)


@pytest.mark.slow
@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_derivatives_with_descended_distances(cone):
    """MJX finds the distance of capsule and cylinder by descent, through roots of 0. Forward and
    reverse mode, of a physics step and of a control period."""
    robot, u, weights = pair("cylinder", "capsule", cone), np.array([2.0]), np.array([1.0, 0.3])
    with jax.enable_x64(True):
        steps = [jax.jit(robot.plant.step), robot.step]
        slopes = [jax.jit(jax.grad(lambda x, u, f=f: f(x, u) @ weights, (0, 1))) for f in steps]
        transition = jax.jit(robot.transition)
        for x in AT:
            for step, slope in zip(steps, slopes, strict=True):
                wanted = by_differences(robot, step, x, u)
                for a, b in zip(slope(x, u), wanted, strict=True):
                    np.testing.assert_allclose(a, weights @ b, rtol=0, atol=1e-5)
            assert_close(transition(x, u), by_differences(robot, steps[0], x, u))


SUITE = ("finger", "cartpole", "acrobot", "pendulum", "reacher", "point_mass", "ball_in_cup",
         "hopper", "cheetah", "walker")  # fmt: skip


def foreign(name):
    """A robot of dm_control's suite."""
    found = importlib.util.find_spec("dm_control")
    if found is None:
        pytest.skip("dm_control is not installed")
    return jm.load_robot(str(Path(found.origin).parent / "suite" / f"{name}.xml"))


def met(robot, count=400):
    """One state of each kind (free, at a stop, touching, both) met by random motion: (x, u)."""
    m, rng = robot.mujoco, np.random.default_rng(0)
    data, found = mujoco.MjData(m), {}
    low, high = (0.9 * np.asarray(v) for v in (robot.input_limits.lower, robot.input_limits.upper))
    for trial in range(count):
        if trial % 40 == 0:
            mujoco.mj_resetData(m, data)
            ends = np.where(m.jnt_limited[:, None], m.jnt_range, [-1.0, 1.0])
            middle, half = ends.mean(axis=1), 1.05 * (ends[:, 1] - ends[:, 0]) / 2
            data.qpos = rng.uniform(middle - half, middle + half)
            data.qvel = rng.normal(size=m.nv)
        data.ctrl = rng.uniform(low, high)
        mujoco.mj_forward(m, data)
        stops = np.isin(data.efc_type[: data.nefc], (3, 4)).any()
        if data.ncon == 0 or data.contact.dist.min() > -0.02:
            x = np.concatenate([data.qpos, data.qvel])
            found.setdefault((data.ncon > 0, bool(stops)), []).append((x, data.ctrl.copy()))
        mujoco.mj_step(m, data, 5)
    return {kind: states[len(states) // 2] for kind, states in found.items()}


@pytest.mark.slow
@pytest.mark.parametrize("name", SUITE)
def test_foreign_models_against_the_c_engine(name):
    """A, B of mjd_transitionFD, free, at stops and touching. Where MJX finds other contacts than
    the C engine (capsules, a little), by differences of its own step."""
    robot = foreign(name)
    states = met(robot)
    assert (False, False) in states
    if name in ("finger", "ball_in_cup", "hopper", "cheetah", "walker"):
        assert (True, False) in states or (True, True) in states
    with jax.enable_x64(True):
        transition, step = jax.jit(robot.transition), jax.jit(robot.plant.step)
        for (touching, _), (x, u) in states.items():
            found = transition(x, u)
            same = np.abs(step(x, u) - c_steps(robot.mujoco, x, u, 1)).max() < 1e-9
            assert same or touching
            wanted = c_transition(robot, x, u) if same else by_differences(robot, step, x, u)
            assert_close(found, wanted)


@pytest.mark.slow
def test_gradient_of_the_finger():
    """Reverse mode through a control period of elliptic contacts, in float32 and float64."""
    robot = foreign("finger")
    states = met(robot)
    weights = np.linspace(1, 2, robot.state_size)
    end = lambda x, u: robot.step(x, u) @ weights
    slope = jax.jit(jax.grad(end, (0, 1)))
    for x, u in (states[False, False], states[True, False]):
        with jax.enable_x64(True):
            A, B = by_differences(robot, robot.step, x, u)
            exact = slope(jnp.asarray(x), jnp.asarray(u))
        single = slope(jnp.asarray(x, np.float32), jnp.asarray(u, np.float32))
        for a, b, wanted in zip(exact, single, (weights @ A, weights @ B), strict=True):
            size = np.abs(weights @ A).max()
            np.testing.assert_allclose(a, wanted, rtol=0, atol=1e-6 * size)
            np.testing.assert_allclose(b, wanted, rtol=0, atol=1e-3 * size)


# --- rewriting -------------------------------------------------------------------------------


def by_hand(K, **_):
    return cholesky(K)


def substituted(T, B, *, left_side, lower, transpose_a, **_):
    assert left_side
    T = jnp.tril(T) if lower else jnp.triu(T)
    return solve_general(T.T if transpose_a else T, B)


@jax.custom_jvp
def _odd(K, x):
    return cho_solve(cho_factor(K), x)


@_odd.defjvp
def _(primals, tangents):  # seven times the derivative in x, to know it again
    K, x = primals
    return _odd(K, x), 7 * cho_solve(cho_factor(K), tangents[1])


def nested(x, tree):
    """Factorizations in jit, scan, cond, checkpoint and custom_jvp."""
    K, table = tree["K"] + x[0] * jnp.eye(3), np.arange(3.0)
    factored = lambda y: cho_solve(cho_factor(K), y)

    def body(y, t):
        y = jax.lax.cond(t > 0, factored, lambda y: 2 * y, y)
        return jax.checkpoint(factored)(y) + table, jnp.sum(y)

    y, sums = jax.lax.scan(body, jax.jit(factored)(x), jnp.array([1.0, -1.0, 1.0]))
    return {"sums": sums, "ends": [y, _odd(K, y)]}


def looped(x, tree):
    step = lambda c: (c[0] + 1, cho_solve(cho_factor(tree["K"]), c[1]) + x)
    return jax.lax.while_loop(lambda c: c[0] < 3, step, (0, x))[1]


@pytest.mark.parametrize("function", [pytest.param(nested, marks=pytest.mark.slow), looped])
def test_rewritten_functions_are_the_same(function):
    """Values, vmap, forward and reverse mode and both."""
    rules = {cholesky_p: by_hand, triangular_solve_p: substituted}
    other = rewritten(function, rules)
    with jax.enable_x64(True):
        x = jnp.array([0.3, -0.2, 0.7])
        tree = {"K": jnp.array([[3.0, 0.5, 0.1], [0.5, 2.0, 0.2], [0.1, 0.2, 1.5]])}
        batch = jnp.stack([x, 2 * x, -x])
        many = lambda f: jax.vmap(f, in_axes=(0, None))
        total = lambda f: lambda x, t: sum(jnp.sum(jnp.sin(v)) for v in jax.tree.leaves(f(x, t)))
        forward = lambda f: many(jax.jacfwd(f))
        wraps = [(lambda f: f, x), (many, batch), (forward, batch)]
        if function is nested:
            reverse = lambda f: jax.grad(total(f))
            wraps += [(lambda f: many(reverse(f)), batch), (lambda f: jax.jacfwd(reverse(f)), x)]
        for wrap, at in wraps:
            found, wanted = (jax.tree.leaves(jax.jit(wrap(f))(at, tree)) for f in (other, function))
            for a, b in zip(found, wanted, strict=True):
                np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("derivative", [lambda f: f, jax.jacfwd])
def test_rewriting_reaches_everything(derivative):
    """Stand-ins without the primitives: none is left, in the function or in its derivative."""
    rules = {cholesky_p: lambda K, **_: 2 * K, triangular_solve_p: lambda T, B, **_: B * T[0, 0]}
    with jax.enable_x64(True):
        tree = {"K": 2 * jnp.eye(3)}
        for function in (nested, looped):
            made = jax.make_jaxpr(derivative(rewritten(function, rules)))(jnp.ones(3), tree)
            for name in (" = cholesky", " = triangular_solve"):
                assert name in str(jax.make_jaxpr(derivative(function))(jnp.ones(3), tree))
                assert name not in str(made)


def test_rewriting_leaves_the_rest():
    """Without the primitives: the same operations, with the names of parameters and constants."""
    function = lambda x: jax.lax.scan(lambda c, t: (c * t, jnp.sin(c)), x[0], x)
    same = rewritten(function, {cholesky_p: by_hand})
    text = lambda f: str(jax.make_jaxpr(f)(np.ones(3, np.float32)))
    assert text(same) == text(function)


# --- inside shard_map ------------------------------------------------------------------------


@pytest.mark.long
def test_stops_in_a_shard_map():
    """MJX's own solver fails under the default check of what varies over the devices."""
    robot, spec = jm.load_robot(swing("Euler")), jax.sharding.PartitionSpec("b")
    mesh = jax.make_mesh((1,), ("b",), axis_types=(jax.sharding.AxisType.Auto,))
    xs, us = jnp.array([[1.1, 1.0], [0.2, -1.0]]), jnp.array([[9.0], [-9.0]])
    size = lambda x, u: jnp.sum(robot.step(x, u) ** 2)
    steps = jax.vmap(lambda x, u: (robot.step(x, u), jax.grad(size, (0, 1))(x, u)))
    shared = jax.shard_map(steps, mesh=mesh, in_specs=spec, out_specs=spec)
    jax.tree.map(np.testing.assert_array_equal, jax.jit(shared)(xs, us), jax.jit(steps)(xs, us))
