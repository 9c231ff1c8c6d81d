"""An MPC as a layer: what it returns, its derivatives, and what it refuses."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.optimize import approx_fprime

import jaxmpc as jm

A, B = np.array([[1, 0.1], [0, 1]]), np.array([[0.005], [0.1]])
MPC = jm.MPC(
    jm.LinearSystem(A, B),
    np.array([[2, 0.3], [0.3, 1]]),
    np.eye(1),
    horizon=4,
    states=jm.Box([-1, -1], [1, 1]),
    inputs=jm.Box([-0.5], [0.5]),
    soft=jm.Soft(np.eye(2), [-0.6, -0.6], [0.6, 0.6], rho=0.4),
)


def test_rows_that_soften_made_have_names():
    """A tuple, whose number may be left out where it has one part."""
    one = jm.soften(jm.MPC(jm.LinearSystem([[1.0]], [1.0]), 1.0, 0.1, 3, jm.Box(-1.0, 1.0)), 5.0)
    two = replace(one, soft=(*one.soft, *one.soft))
    for mpc, names in ((one, ("soft.rho", "soft.0.rho")), (two, ("soft.0.rho", "soft.1.rho"))):
        for i, name in enumerate(names):
            layer = jm.tuning.MPCLayer(mpc, learn=(name,))
            theta = {name: layer.init()[name] + 1.0}
            soft = layer.problem(theta).soft
            changed = [np.any(s.rho != one.soft[0].rho) for s in soft]
            assert changed == [k == i or len(soft) == 1 for k in range(len(soft))]
    listed = jm.tuning.MPCLayer(replace(one, soft=list(one.soft)), learn=("soft.rho",))
    assert tuple(listed.parameters) == ("soft.rho",)
    with pytest.raises(ValueError, match="'soft.rho' is no field"):
        jm.tuning.MPCLayer(two, learn=("soft.rho",))
    with pytest.raises(ValueError, match="'soft.2.rho' is no field"):
        jm.tuning.MPCLayer(two, learn=("soft.2.rho",))


NAMES = ("Q", "R", "A", "B", "inputs.upper", "soft.rho")


@pytest.fixture(scope="module")
def layer():
    # Without Newton steps a program compiles several times faster.
    return jm.tuning.MPCLayer(MPC, NAMES, jm.ADMM(iterations=1000, newton_steps=0))


@pytest.mark.slow
def test_at_the_start_it_is_the_problem(layer, x64):
    """And free numbers lead back to what they stand for."""
    theta = layer.init()
    assert set(theta) == set(NAMES)
    for name, value in layer.values(theta).items():
        expected = {"Q": MPC.Q, "R": MPC.R, "A": A, "B": B, "inputs.upper": [0.5]}.get(name, 0.4)
        np.testing.assert_allclose(value, expected, rtol=1e-14, atol=1e-14)
    expected = jm.Controller(MPC).plan([0.5, 0.2]).inputs
    np.testing.assert_allclose(layer(theta, [0.5, 0.2]).plan.inputs, expected, atol=1e-9)


@pytest.fixture(scope="module")
def lesson(layer):
    """(θ, x, what was found before) → gradient in θ of a loss over four states, and what it found.

    A program takes seconds to compile, so one serves the derivatives and the closed loop."""

    @jax.jit
    def lesson(theta, x, before):
        def loss(theta):
            found = jax.vmap(layer, (None, 0, 0))(theta, x, before)
            return jnp.sum(jnp.sin(found.plan.inputs)), found

        (value, found), gradient = jax.value_and_grad(loss, has_aux=True)(theta)
        return value, gradient, found

    return lesson


@pytest.fixture(scope="module")
def start(layer):
    return jax.jit(jax.vmap(layer.start, (None, 0)))


@pytest.mark.long
def test_derivatives_are_those_of_differences(layer, lesson, start, x64):
    """Of a loss over states at which inputs, and soft rows, are at their limits."""
    x = jnp.array([[-0.7, -0.4], [0.85, 0.3], [0.2, 0.1], [0.55, 0.9]])
    theta = layer.init()
    before = start(theta, x)
    _, gradient, _ = lesson(theta, x, before)
    for name in NAMES:
        change = lambda v, name=name: float(lesson(theta | {name: jnp.asarray(v)}, x, before)[0])
        expected = approx_fprime(np.asarray(theta[name]), change, 1e-6)
        scale = max(1.0, np.abs(expected).max())
        np.testing.assert_allclose(gradient[name], expected, atol=2e-5 * scale)


def test_what_is_not_learned_is_fixed():
    layer = jm.tuning.MPCLayer(MPC, {"A": jm.Parameter(A, train=A == 0.1)})
    theta = layer.init()
    assert {name: v.shape for name, v in theta.items()} == {"A": (1,)}
    moved = layer.problem({"A": theta["A"] + 1}).system.A
    np.testing.assert_allclose(moved, [[1, 1.1], [0, 1]])
    assert not jax.tree.leaves(layer) or jax.tree.leaves(layer) == [layer]  # no pytree


@pytest.mark.slow
def test_inputs_without_a_plan_are_within_the_limits():
    """A state far off spoils neither its neighbours nor their gradients."""
    layer = jm.tuning.MPCLayer(MPC)
    x = jnp.array([[0.5, 0.2], [50.0, 3.0], [jnp.nan, 0.0]])

    @jax.jit
    def gradient(theta, x):
        def loss(theta):
            found = jax.vmap(layer, (None, 0))(theta, x)
            return jnp.sum(found.u, where=found.plan.solved[:, None]), found

        (_, found), gradient = jax.value_and_grad(loss, has_aux=True)(theta)
        return gradient, found

    together, found = gradient(layer.init(), x)
    assert found.plan.solved.tolist() == [True, False, False]
    assert (np.abs(found.u) <= 0.5).all()
    alone, _ = gradient(layer.init(), x.at[1:].set(0.0))  # zero inputs, which weights leave zero
    for name, value in together.items():
        np.testing.assert_allclose(value, alone[name], rtol=1e-4, atol=1e-6)


@pytest.mark.slow
@pytest.mark.slow
def test_infeasible_states_have_derivatives_in_the_state_and_not_in_weights(x64):
    """What counts as closest is held fixed: docs/how-to/learning.md gives these numbers."""
    A = [[-0.02, 6.0, 0, -9.81], [-0.002, -0.7, 1.0, 0], [0, -1.5, -0.8, 0], [0, 0, 1.0, 0]]
    system = jm.LinearSystem.from_continuous(A, [0, -0.05, -2.0, 0], dt=0.1)
    most = np.array([10, 0.15, 0.5, 0.3])
    limits = {"states": jm.Box(-most, most), "inputs": jm.Box(-0.3, 0.3)}
    Q = np.diag([0.01, 10, 1, 10])
    layer = jm.tuning.MPCLayer(jm.MPC(system, Q, 1.0, horizon=8, terminal_cost=Q, **limits))

    def value(theta, x):
        return jnp.linspace(1, 2, 8) @ layer(theta, x).plan.inputs[:, 0]

    def slopes(function, at, step):
        sides = [jax.vmap(function)(at + s * step * np.eye(len(at))) for s in (1, -1)]
        return (sides[0] - sides[1]) / (2 * step)

    theta, errors = layer.init(), []
    found = jax.jit(jax.grad(value, (0, 1)))
    states = [
        [4, 0.2, 0.3, 0.25], [4, 0.1, 0.45, 0.29], [9, 0.14, 0.5, 0.2], [-9, -0.14, -0.5, 0.3],
        [3, 0.1, 0.4, 0.3],
    ]  # fmt: skip
    for x in np.array(states):
        assert layer(theta, x).plan.status == jm.Status.PRIMAL_INFEASIBLE
        of_theta, of_x = found(theta, x)
        in_x = slopes(lambda x: value(theta, x), x, 1e-5)
        in_Q = slopes(lambda q, x=x: value(theta | {"Q": q}, x), theta["Q"], 1e-4)
        pairs = (of_x, in_x), (of_theta["Q"], in_Q)
        errors.append([float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs])
    of_state, of_weights = np.array(errors).T
    assert of_state.max() < 5e-4
    assert of_weights.max() > 0.5  # where this fails the derivative is whole: mend the page


def test_the_terminal_weight_follows_what_is_learned(x64):
    """It is the P of `lqr` at every θ, beside differences; and P is a name of the terminal cost."""
    layer = jm.tuning.MPCLayer(MPC, ("Q", "R", "A"), terminal_weight="lqr")
    theta = {name: value + 0.1 for name, value in layer.init().items()}
    made = jax.jit(layer.problem)(theta)
    P = jm.lqr(made.system, made.Q, made.R).P
    np.testing.assert_allclose(made.terminal_cost, P, rtol=1e-12)

    @jax.jit
    @jax.value_and_grad
    def corner(r):
        return layer.problem(theta | {"R": r}).terminal_cost[0, 0]

    expected = approx_fprime(theta["R"], lambda r: corner(r)[0], 1e-6)
    np.testing.assert_allclose(corner(theta["R"])[1], expected, rtol=1e-4)
    for learn, message in (("P", "P is learned itself"), ("terminal_cost", "terminal_cost is")):
        mpc = replace(MPC, terminal_cost=np.eye(2))
        problem = jax.jit(jm.tuning.MPCLayer(mpc, learn).problem)
        assert problem({learn: np.ones(2)}).terminal_cost[0, 1] == 0
        with pytest.raises(ValueError, match=f"terminal_weight: 'lqr', and {message}"):
            jm.tuning.MPCLayer(mpc, learn, terminal_weight="lqr")
    with pytest.raises(ValueError, match='terminal_weight: .Q.. Give "given"'):
        jm.tuning.MPCLayer(MPC, "Q", terminal_weight="Q")


@pytest.mark.long
def test_a_closed_loop_carries_its_plans(layer, lesson, start, x64):
    theta, x = layer.init(), np.array([[0.8, 0.0], [-0.8, 0.0], [0.5, 0.1], [0.7, -0.1]])
    first, before = x, start(theta, x)
    for _ in range(60):
        _, _, before = lesson(theta, x, before)
        assert np.all(before.plan.solved)
        x = x @ A.T + before.u @ B.T
    assert np.all(np.abs(x).max(axis=1) < 0.3 * np.abs(first).max(axis=1))


@pytest.mark.parametrize(
    ("learn", "words"),
    [
        ("q", "'q' is no field"),
        ("c", "'c' is None in the problem"),
        ("terminal_set.level", "'terminal_set' is None in the problem"),
        ("states", "'states' is a Box in the problem"),
        ("horizon", "'horizon' is a constant of the problem"),
        ("constrain_initial", "'constrain_initial' is a constant of the problem"),
        ((), "names nothing"),
        (("P", "terminal_cost"), "names 'terminal_cost' as 'P' already"),
        (("A", "system.A"), "names 'system.A' as 'A' already"),
        ("Q.T", "'Q.T' is no field"),
        ("system.n", "'system.n' is no field"),
        ("outputs.upper", r"'outputs' is \(\) in the problem. Give it, with 'upper'"),
        ({"Q": 1.0}, r"learn\['Q'\]: is a float. Wrap it"),
        ({"R": jm.Parameter([[-1.0]])}, "R: is not positive semidefinite"),
        ({"states.upper": jm.Parameter([-2.0, 1.0])}, "states: is empty"),
        (3, "learn: 3. Give names"),
        ((3,), r"learn: \(3,\). Give names"),
        ({"Q": jm.Parameter(np.eye(3), "definite")}, r"learn\['Q'\]: shape \(3, 3\)"),
        ({"Q": np.eye(2)}, "Wrap it in a jm.Parameter"),
        ({"Q": jm.Parameter(np.eye(2), train=False)}, "none is trained"),
    ],
)
def test_refuses(learn, words):
    with pytest.raises(ValueError, match=words):
        jm.tuning.MPCLayer(MPC, learn)


def test_limits_that_are_not_there_stay_away():
    """Of limits given by name the finite ones are learned."""
    mpc = replace(MPC, states=jm.Box([-1, -np.inf], [1, np.inf]))
    by_name = jm.tuning.MPCLayer(mpc, ("states.upper",))
    start = jm.Parameter([1, np.inf], train=[True, False])
    for layer in (by_name, jm.tuning.MPCLayer(mpc, {"states.upper": start})):
        assert layer.init()["states.upper"].shape == (1,)
        np.testing.assert_array_equal(layer.values({"states.upper": [0.5]})["states.upper"],
                                      [0.5, np.inf])  # fmt: skip
        layer.problem({"states.upper": np.array([0.5])}).validate()
    for wrong in ([1, np.inf], [np.nan, 1]):
        with pytest.raises(ValueError, match="value: (is infinite where it is trained|holds NaN)"):
            jm.Parameter(wrong)
    with pytest.raises(ValueError, match="value: holds NaN or infinity"):
        jm.Parameter([1, np.inf], "positive", train=[True, False])
    with pytest.raises(ValueError, match=r"True, False or a mask of True and False, shape \(2,\)"):
        jm.Parameter([1, np.inf], train=[1, 0])


def test_refuses_other_parameters(layer):
    for wrong in (None, np.zeros(3), jnp.zeros(2)):
        with pytest.raises(
            ValueError, match="theta: is an? .* Give a dict of arrays, as from init()"
        ):
            layer(wrong, np.zeros(2))
    with pytest.raises(ValueError, match="theta: has the names Q"):
        layer({"Q": jnp.zeros(3)}, np.zeros(2))
    theta = layer.init()
    name = next(iter(theta))
    with pytest.raises(ValueError, match="theta: has the names Q"):
        layer.values({"Q": jnp.zeros(3)})
    with pytest.raises(ValueError, match=rf"theta\['{name}'\]: shape \(9,\)"):
        layer.values({**theta, name: jnp.zeros(9)})
    with pytest.raises(ValueError, match=rf"theta\['{name}'\]: shape \(9,\)"):
        jax.jit(layer)({**theta, name: jnp.zeros(9)}, np.zeros(2))
    with pytest.raises(ValueError, match="holds traced arrays"):
        jax.jit(lambda Q: jm.tuning.MPCLayer(jm.MPC(MPC.system, Q, np.eye(1), 3)).init())(np.eye(2))


def varying():
    """Return a problem with weights, dynamics and limits of each step."""
    random = np.random.default_rng(0)
    M = random.normal(size=(4, 2, 2))
    return jm.MPC(
        jm.LinearSystem(A + 0.05 * random.normal(size=(4, 2, 2)), B),
        M @ M.transpose(0, 2, 1) + np.eye(2),
        np.array([1.0, 0.5, 2.0, 1.0]),
        horizon=4,
        states=jm.Box([-1, -1], [1, 1]),
        inputs=jm.Box(-0.5, np.array([[0.5], [0.4], [0.3], [0.2]])),
    )


STEPWISE = ("Q", "R", "A", "inputs.upper")


def test_what_differs_from_step_to_step_stays_in_its_domain(x64):
    mpc = varying()
    layer = jm.tuning.MPCLayer(mpc, STEPWISE)
    theta = layer.init()
    assert {name: v.shape for name, v in theta.items()} == {
        "Q": (12,), "R": (4,), "A": (16,), "inputs.upper": (4,),
    }  # fmt: skip
    found = layer.values(theta)
    for name, value in (("Q", mpc.Q), ("R", mpc.R), ("A", mpc.system.A)):
        np.testing.assert_allclose(found[name], value, rtol=1e-14, atol=1e-14)
    moved = layer.values(jax.tree.map(lambda v: v - 2.0, theta))
    assert np.all(np.linalg.eigvalsh(moved["Q"]) > 0)
    np.testing.assert_allclose(moved["R"], np.exp(-2.0) * mpc.R)
    flat = np.where(np.arange(4)[:, None, None] == 2, 0.0, mpc.Q)
    with pytest.raises(ValueError, match=r"value\[2\]: is not positive definite"):
        jm.Parameter(flat, "definite")


@pytest.mark.slow
def test_weights_and_models_of_each_step_are_learned(x64):
    """From plans of a problem whose steps differ; derivatives beside differences."""
    mpc = varying()
    x = np.random.default_rng(1).uniform(-0.6, 0.6, (32, 2))
    plans = jax.vmap(jm.Controller(mpc).plan)(jnp.asarray(x)).inputs
    one = jm.tuning.MPCLayer(
        jm.MPC(
            jm.LinearSystem(np.tile(A, (4, 1, 1)), B), np.tile(np.eye(2), (4, 1, 1)), np.ones(4), 4,
            mpc.states, mpc.inputs,
        ),
        ("Q", "R", "A"),
    )  # fmt: skip

    @jax.jit
    @jax.value_and_grad
    def loss(theta):
        return jnp.mean((jax.vmap(one, (None, 0))(theta, x).plan.inputs - plans) ** 2)

    theta = one.init()
    value, gradient = loss(theta)
    for name, slope in gradient.items():
        for i in range(0, len(slope), 3):
            step = 1e-5 * np.eye(len(slope))[i]
            ends = [float(loss(theta | {name: theta[name] + s * step})[0]) for s in (1, -1)]
            np.testing.assert_allclose(slope[i], (ends[0] - ends[1]) / 2e-5, rtol=1e-4, atol=1e-8)
    optimizer = optax.adam(0.05)
    state = optimizer.init(theta)
    for _ in range(300):
        now, gradient = loss(theta)
        step, state = optimizer.update(gradient, state)
        theta = optax.apply_updates(theta, step)
    assert now < 1e-3 * value
