"""Enclosures of what linear models of robots leave out, beside exact fractions and the plant."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.robots import intervals
from jaxmpc.robots.intervals import Interval
from jaxmpc.robots.polynomial_degrees import polynomial_degrees
from jaxmpc.robots.taylor_enclosures import TaylorProgram


def boxes(rng, count):
    """Intervals of all sizes about numbers of all sizes."""
    middle = rng.normal(size=count) * 10.0 ** rng.integers(-3, 2, count)
    half = np.abs(rng.normal(size=count)) * 10.0 ** rng.integers(-6, 1, count)
    return Interval(middle - half, middle + half)


def inside(rng, box):
    """Numbers of intervals, exactly."""
    part = Fraction(int(rng.integers(0, 2**20)), 2**20)
    ends = zip(map(Fraction, box.lower), map(Fraction, box.upper), strict=True)
    return [low + part * (high - low) for low, high in ends]


def exact_wave(x, first):
    """Sine (first=1) or cosine (first=0) of a fraction by its series, off by less than 1e-25."""
    total, term, k = Fraction(0), x if first else Fraction(1), first
    while abs(term) > Fraction(1, 10**26) or k < abs(x) + 2:
        total += term
        term = -term * x * x / ((k + 1) * (k + 2))
        term = term.limit_denominator(10**40)
        k += 2
    return total


def test_intervals_hold_exact_results():
    """Of every operation on numbers of the intervals, in rational arithmetic."""
    rng = np.random.default_rng(0)
    a, b = boxes(rng, 300), boxes(rng, 300)
    apart = Interval(np.abs(b.lower) + 1e-3, np.abs(b.lower) + 1e-3 + b.upper - b.lower)
    for _ in range(5):
        x, y, z = inside(rng, a), inside(rng, b), inside(rng, apart)
        results = {
            "add": (intervals.add(a, b), [p + q for p, q in zip(x, y, strict=True)]),
            "subtract": (intervals.subtract(a, b), [p - q for p, q in zip(x, y, strict=True)]),
            "multiply": (intervals.multiply(a, b), [p * q for p, q in zip(x, y, strict=True)]),
            "square": (intervals.square(a), [p * p for p in x]),
            "reciprocal": (intervals.reciprocal(apart), [1 / p for p in z]),
        }
        for name, (found, expected) in results.items():
            ends = zip(
                map(Fraction, found.lower), expected, map(Fraction, found.upper), strict=True
            )
            assert all(low <= value <= high for low, value, high in ends), name
        low, high = map(Fraction, (intervals.total(a, 0).lower, intervals.total(a, 0).upper))
        assert low <= sum(x) <= high
    roots = intervals.root(apart)
    ends = zip(roots.lower, apart.lower, apart.upper, roots.upper, strict=True)
    assert all(
        Fraction(r) ** 2 <= Fraction(p) and Fraction(q) <= Fraction(s) ** 2 for r, p, q, s in ends
    )


def test_sines_and_cosines_hold_exact_values():
    """Beside their series in rational arithmetic, over maxima and minima too, and tightly."""
    rng = np.random.default_rng(1)
    middle, half = rng.uniform(-8, 8, 60), np.repeat([1e-9, 0.1, 2.0], 20)
    box = Interval(middle - half, middle + half)
    for first, wave in enumerate((intervals.cosine, intervals.sine)):
        found = wave(box)
        points = np.linspace(box.lower, box.upper, 2001)
        values = (np.cos, np.sin)[first](points)
        assert np.all(found.upper - values.max(axis=0) < 1e-5)
        assert np.all(values.min(axis=0) - found.lower < 1e-5)
        for _ in range(3):
            for low, x, high in zip(found.lower, inside(rng, box), found.upper, strict=True):
                assert Fraction(low) <= exact_wave(x, first) <= Fraction(high)


def test_taylor_enclosures_hold_derivatives_on_boxes():
    """Those that JAX computes at points of the boxes, of a program with all kinds of operations."""

    def program(x, y):
        A = jnp.stack([jnp.sin(x), x * x[::-1] + 3.0]) @ jnp.array([[1.0, -2.0], [0.5, 0.0]])
        norm = jnp.sqrt(jnp.sum(y**2) + 2.0)
        chosen = jnp.where(jnp.array([True, False]), x / norm, jnp.cos(y))
        chosen = chosen.at[1].set(x[0] * y[1] - 1.0) + jax.lax.integer_pow(x, 0)
        return A @ y, chosen, jnp.maximum(norm, -jnp.inf) ** -3

    rng = np.random.default_rng(2)
    centre = rng.normal(size=(20, 4))
    half = rng.uniform(0, 0.1, (20, 4))
    box = Interval(centre - half, centre + half)
    found = TaylorProgram(program, (2, 2))(box, centre)
    i, j = np.triu_indices(4)
    with jax.enable_x64(True):
        whole = lambda z: program(z[:2], z[2:])
        all_of = jax.jit(
            jax.vmap(lambda z: (whole(z), jax.jacfwd(whole)(z), jax.hessian(whole)(z)))
        )
        for part in rng.uniform(-1, 1, (10, 20, 4)):
            for one, *expected in zip(found, *all_of(centre + part * half), strict=True):
                wide = one.on((0, 1, 2, 3))
                value, slope, bend = map(np.asarray, expected)
                rows = [value[None], np.moveaxis(slope, -1, 0)]
                rows.append(np.moveaxis(bend, (-2, -1), (0, 1))[i, j])
                expected = np.concatenate(rows)
                assert np.all(wide.of.lower[:, :20] <= expected + 1e-12)
                assert np.all(expected - 1e-12 <= wide.of.upper[:, :20])


def test_programs_that_decide_are_refused():
    """An error names what has no bounds."""
    with pytest.raises(ValueError, match="the operation tanh"):
        TaylorProgram(jnp.tanh, (1,))(intervals.point([[0.5]]), np.array([[0.5]]))
    with pytest.raises(ValueError, match="rounds to whole numbers"):
        program = TaylorProgram(lambda x: x.astype(int) + x, (1,))
        program(intervals.point([[0.5]]), np.array([[0.5]]))
    with pytest.raises(ValueError, match="its program compares results"):
        program = TaylorProgram(lambda x: jnp.where(x > 0, x, 2 * x), (1,))
        program(intervals.point([[0.5]]), np.array([[0.5]]))


def test_degrees_of_programs():
    """By hand, entry by entry: v counts once and u twice, q is in any operation."""

    def program(q, v, u):
        A = jnp.array([[1.0, 0.0], [2.0, 3.0]]) * jnp.sin(q)[:, None]
        mixed = jnp.stack([v[0], u[0]])
        chosen = jnp.where(q > 0, q, jnp.exp(q)) * v
        nothing = jnp.tanh(v[:1]), v[:1] / v[1:], jnp.where(v[:1] > 0, q[:1], q[1:])
        limited = jnp.clip(u, -jnp.inf, jnp.inf), jnp.clip(u, -1.0, 1.0)
        whole = v.astype(int).astype(float), jax.lax.integer_pow(v, 0), q.astype(int).astype(float)
        exact = A @ mixed, chosen, v**3 * q, u * u - v[0], v[:1] * jnp.zeros(1), v / (q**2 + 1)
        return jnp.concatenate(exact), jnp.concatenate([*nothing, *limited, *whole])

    exact, others = polynomial_degrees(program, (2, 2, 1), (0, 1, 2))
    np.testing.assert_array_equal(exact, [1, 2, 1, 1, 3, 3, 4, -np.inf, 1, 1])
    np.testing.assert_array_equal(others, [*3 * [np.inf], 2, *3 * [np.inf], 0, 0, 0, 0])


HALF = np.array([np.pi / 6, 2.0])


@pytest.fixture(scope="module")
def pendulum():
    robot = jm.load_robot("pendulum")
    return robot, jm.robots.linear_enclosure(robot, jm.Box(-HALF, HALF), tolerance=0.1)


@pytest.mark.slow
def test_what_a_pendulum_leaves_out(pendulum):
    """9.81 sin θ less a line, by hand: the bounds hold the whole range, and little more."""
    robot, found = pendulum
    slope = float((found.system.A[1, 0]) / found.system.A[0, 0])
    assert 0.08 < slope < 0.1
    # The best line on ±30° leaves 0.0577; the tangent 0.24.
    assert 0.0570 < found.left_out.upper[0] < 1.2 * 0.0577
    np.testing.assert_allclose(found.left_out.lower, -found.left_out.upper, rtol=0.05)
    assert np.all(found.disturbance.lower <= 0) and np.all(found.disturbance.upper >= 0)
    assert found.found.upper[0] <= found.left_out.upper[0]
    at_rest = found.system.A @ found.x + found.system.B @ found.u + found.system.c
    np.testing.assert_allclose(at_rest, found.x, atol=1e-15)


@pytest.mark.slow
def test_the_plant_stays_inside(pendulum):
    """10⁵ control periods of the plant in MJX: none leaves the model plus its disturbance."""
    robot, found = pendulum
    rng = np.random.default_rng(3)
    part = rng.uniform(-1, 1, (100_000, 3))
    part = np.where(rng.uniform(size=part.shape) < 0.5, np.sign(part), part)
    x, u = part[:, :2] * HALF, 5.0 * part[:, 2:]
    after = x @ found.system.A.T + u @ found.system.B.T + found.system.c
    allowed = np.all(np.abs(after) <= HALF, axis=1)
    assert allowed.sum() > 30_000
    with jax.enable_x64(True):
        moved = np.asarray(jax.jit(jax.vmap(robot.step))(x[allowed], u[allowed]))
    w = moved - after[allowed]
    assert np.all(w <= found.disturbance.upper + 1e-13)
    assert np.all(w >= found.disturbance.lower - 1e-13)
    assert w[:, 1].max() > 0.8 * found.disturbance.upper[1]  # and the bounds are no waste


@pytest.mark.slow
def test_proved_states_keep_their_limits_on_the_plant(pendulum):
    """The robust policy, applied to the nonlinear plant from proved states near the boundary, then
    u = K x: it keeps all limits and ends in the terminal set."""
    robot, found = pendulum
    mpc = jm.closed_loop.enclosed_mpc(found, horizon=20)
    directions = np.random.default_rng(4).normal(size=(64, 2))
    ends = jm.feasible.boundary(mpc, directions * HALF)
    x = np.asarray(ends.points) * (1 - 1e-9)
    assert np.all(jm.map_feasible_set(mpc, x).label == 1)
    with jax.enable_x64(True):
        plans = jm.solve_many(mpc, x)
        step = jax.jit(jax.vmap(robot.step))
        K = np.asarray(mpc.gain)
        for k in range(60):
            v = np.asarray(plans.inputs)[:, k] if k < 20 else 0.0
            z = np.asarray(plans.states)[:, k] if k < 20 else 0.0
            u = v + (x - z) @ K.T
            assert np.all(np.abs(x) <= HALF + 1e-9) and np.all(np.abs(u) <= 5 + 1e-6)
            x = np.asarray(step(x, u))
            assert k < 20 or np.all(mpc.terminal_set.contains(x, 1e-6))


SERVOS = {
    "position": ('<position joint="j" kp="20" kv="2" ctrlrange="-1 1"/>', 0.01),
    "velocity": ('<velocity joint="j" kv="2" ctrlrange="-1 1"/>', 0.01),
    "ten steps": ('<position joint="j" kp="5" kv=".3" ctrlrange="-1 1"/>', 0.02),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", SERVOS)
def test_servos_stay_inside(kind):
    """Of stiff ones too, which change the speed by two thirds within a period: their accelerations
    are those at the beginnings of physics steps. The plant is MuJoCo's C engine."""
    servo, period = SERVOS[kind]
    text = BODY.format(joint='damping=".1"', motor=servo, geom=FREE, more="")
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.timestep = period / 10 if kind == "ten steps" else period
    robot = jm.load_robot(model, control_period=period)
    half = np.array([0.3, 1.0])
    found = jm.robots.linear_enclosure(robot, jm.Box(-half, half), tolerance=0.1, cells=2000)
    assert kind == "ten steps" or np.all(found.left_out.upper < 1.3 * found.found.upper)
    rng, data = np.random.default_rng(5), mujoco.MjData(model)
    part = rng.uniform(-1, 1, (4000, 3))
    part = np.where(rng.uniform(size=part.shape) < 0.5, np.sign(part), part)
    x, u = part[:, :2] * half, part[:, 2:]
    after = x @ found.system.A.T + u @ found.system.B.T + found.system.c
    allowed = np.all(np.abs(after) <= half, axis=1)
    assert allowed.sum() > 200
    for state, ctrl, predicted in zip(x[allowed], u[allowed], after[allowed], strict=True):
        data.qpos[:], data.qvel[:], data.ctrl[:] = state[:1], state[1:], ctrl
        mujoco.mj_step(model, data, robot.substeps)
        w = np.concatenate([data.qpos, data.qvel]) - predicted
        assert np.all(w <= found.disturbance.upper + 1e-12)
        assert np.all(w >= found.disturbance.lower - 1e-12)


def refused(robot, match, **given):
    if isinstance(robot, str):
        robot = jm.load_robot(mujoco.MjModel.from_xml_string(robot))
    with pytest.raises(ValueError, match=match):
        jm.robots.linear_enclosure(robot, **given)


BODY = """<mujoco><worldbody><body><joint name="j" axis="0 1 0" {joint}/><geom type="capsule"
fromto="0 0 0 0 0 -.3" size=".02" mass="1" {geom}/></body>{more}</worldbody><actuator>{motor}
</actuator></mujoco>"""
MOTOR = '<motor joint="j" ctrlrange="-5 5"/>'
FREE = 'contype="0" conaffinity="0"'


def test_what_has_no_bounds_is_refused():
    """With the kind and a cure, before anything is computed."""
    make = lambda joint="", motor=MOTOR, geom=FREE, more="": BODY.format(
        joint=joint, motor=motor, geom=geom, more=more
    )
    box = jm.Box(-np.ones(2), np.ones(2))
    refused(make('frictionloss=".1"'), "dry friction", states=box)
    servo = '<position joint="j" kp="10" ctrlrange="-1 1" forcerange="-3 3"/>'
    refused(make(motor=servo), "limits of forces", states=box)
    floor = '<geom type="plane" size="1 1 .1" pos="0 0 -1"/>'
    refused(make(geom="", more=floor), "contacts", states=box)
    plain = jm.load_robot(mujoco.MjModel.from_xml_string(make()))
    refused(plain, "has no bounds")
    refused(plain, "leaves out the set-point", states=jm.Box(np.ones(2), 2 * np.ones(2)))
    refused(plain, "has no width", states=jm.Box(np.array([-1.0, 0]), np.array([1.0, 0])))
    refused(plain, "Give one of fitted, tangent", states=box, model="linear")
    refused(plain, "tolerance", states=box, tolerance=0.0)


@pytest.mark.slow
def test_ends_of_joints_are_kept_away_from():
    """Where the robot can reach a joint's stop within a period, an error says where it comes to."""
    text = BODY.format(joint='range="-1 1" limited="true"', motor=MOTOR, geom=FREE, more="")
    states = jm.Box([-1.0, -2.0], [1.0, 2.0])
    refused(text, "the joint stops at", states=states, tolerance=0.5)


@pytest.mark.slow
def test_forces_of_other_degrees_are_refused():
    """A gain that depends on the speed makes products of speeds and inputs."""
    pump = '<general joint="j" gaintype="affine" gainprm="1 0 .1" ctrlrange="-5 5"/>'
    text = BODY.format(joint="", motor=pump, geom=FREE, more="")
    box = jm.Box(-np.ones(2), np.ones(2))
    refused(text, "not quadratic in speeds and affine in inputs", states=box)
