"""tune_weights: derivatives of closed loops against differences, its guards, its losses."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from problems import symmetric

import jaxmpc as jm
from jaxmpc.closed_loop.simulation import Run
from jaxmpc.tuning import weights
from jaxmpc.tuning.descent import Settings
from jaxmpc.tuning.losses import ClosedLoopLoss
from jaxmpc.tuning.objective import ClosedLoopObjective, operations
from jaxmpc.tuning.parameters import Parameter
from jaxmpc.tuning.weights import tune_weights

SYSTEM = jm.LinearSystem(np.array([[1.0, 0.2], [0.0, 1.0]]), np.array([[0.02], [0.2]]), dt=0.2)
LIMITS = symmetric(1.0, 0.6)
MPC = jm.MPC(
    SYSTEM,
    np.diag([4.0, 0.5]),
    np.array([[0.2]]),
    5,
    states=LIMITS,
    inputs=symmetric(1.0),
    terminal_cost=np.diag([4.0, 0.5]),
    constrain_initial=False,
)
NOISE = jm.closed_loop.Noise(process=0.01, seed=3)
SOLVER = jm.ADMM(iterations=80, newton_steps=0, eps=1e-3)  # compiles fastest
LOSS = ClosedLoopLoss(np.diag([4.0, 0.5]), [0.02], limits=LIMITS, violation=5.0)
PARAMETERS = {"Q": Parameter(MPC.Q / 4, "definite"), "R": Parameter(40 * MPC.R, "diagonal")}


def weighed(v):
    return replace(MPC, Q=v["Q"], R=v["R"])


def starts(count, scale=0.8, seed=0):
    return scale * np.random.default_rng(seed).uniform([-1, -0.6], [1, 0.6], (count, 2))


def tune(x0s=None, make=weighed, parameters=PARAMETERS, **more):
    settings = {"steps": 8, "solver": SOLVER, "updates": 4, "mode": "forward", **more}
    return tune_weights(make, parameters, SYSTEM, starts(16) if x0s is None else x0s, **settings)


@pytest.fixture(scope="module")
def x64():
    with jax.enable_x64(True):
        yield


def regulated(v):
    """The LQR of these weights, which compiles in a moment."""
    return jm.closed_loop.LinearFeedback(weighed(v), jm.lqr(SYSTEM, v["Q"], v["R"]).K)


@pytest.fixture(scope="module", params=["law", pytest.param("plans", marks=pytest.mark.slow)])
def make(request):
    return {"law": regulated, "plans": weighed}[request.param]


@pytest.fixture(scope="module")
def tuned(x64, make):
    return tune(make=make, loss=LOSS, updates=12, batch=8, optimizer=optax.adam(0.2))


@pytest.mark.long
def test_validation_loss_falls_and_is_that_of_the_returned_values(tuned):
    history = tuned.history
    assert tuned.improvement > 0.2 and history.accepted.all()
    best = history.validation.min() / history.validation[0]
    np.testing.assert_allclose(tuned.improvement, 1 - best, rtol=1e-12)
    # The loss of the last four starts, which no step saw, recomputed from outside.
    alone = jax.jit(jax.vmap(lambda x: LOSS(jm.simulate(tuned.result, SYSTEM, x, 8))))
    again = np.mean(alone(starts(16)[-4:]))
    np.testing.assert_allclose(again, history.validation[history.best], rtol=1e-9)
    np.testing.assert_array_equal(tuned.mpc.Q, tuned.values["Q"])
    record = tuned.record()
    np.testing.assert_allclose(record["values_by_step"]["Q"][history.best], tuned.values["Q"])
    laws = isinstance(tuned.result, jm.closed_loop.LinearFeedback)  # without plans
    assert record["numbers"]["unsolved"] == [float(laws)] * 12
    assert record["settings"]["mode"] == "forward"


def test_a_run_prints_what_changed(tuned):
    """Loss and values before and after, without the functions inside; and what never moved."""
    text = repr(tuned)
    assert "best of 12 steps" in text and "Q" in text and " -> " in text and "<" not in text
    still = {**tuned.trace, "rho": np.full(13, 10.0)}
    values = {**tuned.values, "rho": np.array(10.0)}
    run = replace(tuned, values=values, initial=values, trace=still)
    assert run.unmoved == ["rho"] and tuned.unmoved == []
    assert "rho          10. -> 10.  (never moved: not trained, or no derivative)" in repr(run)


def test_losses_that_cannot_be_traced_are_named(x64):
    for more, message in (
        ({"loss": lambda run: float(run.states[-1, 0])}, "loss, make_mpc: cannot be traced by JAX"),
        ({"make": lambda v: replace(MPC, Q=v["W"])}, "parameters: have no 'W', .*Q, R"),
        ({"make": MPC}, "make_mpc: is an MPC. Give a function"),
    ):
        with pytest.raises(ValueError, match=message):
            tune(**more)


@pytest.mark.slow
@pytest.mark.parametrize("make", ["plans"], indirect=True)
def test_reverse_mode_checkpoint_and_forward_mode_agree(tuned, make, tmp_path):
    """The same run by the transposed derivative, cut off and taken up again."""
    path = tmp_path / "run.npz"
    same = {"loss": LOSS, "batch": 8, "optimizer": optax.adam(0.2), "mode": "reverse"}
    same["make"] = make
    tune(updates=2, checkpoint=path, **same)
    again = tune(updates=5, checkpoint=path, **same)
    np.testing.assert_allclose(again.history.loss, tuned.history.loss[:5], rtol=1e-8)
    theta, other = again.history.thetas["Q"], tuned.history.thetas["Q"]
    np.testing.assert_allclose(theta, other[:6], atol=1e-6)
    with pytest.raises(ValueError, match="other settings"):
        tune(updates=5, checkpoint=path, **{**same, "batch": 4})


def test_an_interrupt_gives_the_best_so_far(tuned, make, monkeypatch):
    """Ctrl-C in the sixth of twelve steps: what these gave, for the plan of `tuned`."""
    real = weights.descend

    def descend(theta, gradient, *more):
        def trap(theta, step):
            if step == 5:
                raise KeyboardInterrupt
            return gradient(theta, step)

        return real(theta, trap, *more)

    monkeypatch.setattr(weights, "descend", descend)
    with pytest.raises(KeyboardInterrupt) as stop:
        tune(make=make, loss=LOSS, updates=12, batch=8, optimizer=optax.adam(0.2))
    run = stop.value.run
    np.testing.assert_array_equal(run.history.validation, tuned.history.validation[:6])
    assert run.improved and run.result.mpc.Q.shape == (2, 2)


@pytest.mark.slow
def test_bad_states_are_left_out_and_infeasible_ones_count(x64):
    """NaN in one start, and starts that no plan keeps within the limits."""
    x0s = starts(8)  # as many as in a batch of `tuned`, whose program this is
    x0s[2] = np.nan
    x0s[5:7] = [0.99, 0.6]  # leaves |q| ≤ 1 at the next sample whatever the input
    found = tune(x0s, loss=LOSS, validation=starts(4, seed=1), updates=3)
    assert found.history.accepted.all() and np.isfinite(found.history.gradient_norm).all()
    assert found.history.numbers["excluded"].tolist() == [1.0] * 3
    assert np.all(found.history.numbers["infeasible"] > 0)
    # The gradient is that of the other starts alone.
    rest = tune(np.delete(x0s, 2, 0), loss=LOSS, validation=starts(4, seed=1), updates=1)
    np.testing.assert_allclose(
        found.history.gradient_norm[0], rest.history.gradient_norm[0], rtol=1e-9
    )


@pytest.mark.slow
def test_design_loss_references_and_other_fields(x64):
    """A design loss alone is followed; references and limits are parameters like others."""
    parameters = {
        "tight": Parameter(0.05, "interval", lower=0.0, upper=0.5),
        "goal": Parameter([0.0, 0.0], train=[True, False]),
        "rho": Parameter(20.0, "positive"),
    }

    def make(v):
        states = jm.Box(LIMITS.lower * (1 - v["tight"]), LIMITS.upper * (1 - v["tight"]))
        return jm.soften(replace(MPC, states=states), v["rho"])

    aim = ClosedLoopLoss(np.eye(2), [0.0], reference=np.array([0.3, 0.0]))
    found = tune(
        make=make,
        parameters=parameters,
        loss=aim,
        reference=lambda v: v["goal"],
        design_loss=lambda mpc: 1e-3 * mpc.soft[0].upper[0],
        updates=3,
        optimizer=optax.adam(0.05),
    )
    goal = found.history.thetas["goal"][:, 0]
    assert np.all(np.diff(goal) > 0)  # towards 0.3
    assert found.values["tight"] > 0.05  # narrower limits lower the design loss
    assert found.values["goal"][1] == 0.0


def test_a_loss_of_plans_has_a_gradient_in_a_trace(x64):
    """What `test_validation_loss_falls...` compiles in the slow tests."""
    objective = ClosedLoopObjective(
        lambda v: jm.Controller(weighed(v), SOLVER), PARAMETERS, SYSTEM, 8, LOSS, None, None, None,
        {},
    )  # fmt: skip
    theta = {k: v.raw() for k, v in PARAMETERS.items()}
    total = lambda theta: objective.total(theta, SYSTEM, starts(8), {}, np.ones(8))[0]
    slope = jax.eval_shape(jax.grad(total), theta)
    assert {name: v.shape for name, v in slope.items()} == {"Q": (3,), "R": (1,)}


def test_operations_are_counted_without_compiling():
    """Products, factorizations, scans and branches by their formulas; a gradient by one parameter
    takes about as many forward as in reverse, by many far more."""
    count = lambda f, *v: operations(jax.make_jaxpr(f)(*v))
    A, B = jnp.ones((3, 5)), jnp.ones((5, 7))
    assert count(jnp.dot, A, B) == 2 * 3 * 5 * 7
    assert count(jax.vmap(lambda a: jnp.dot(a, B)), jnp.ones((4, 3, 5))) == 4 * 2 * 3 * 5 * 7
    loop = lambda v: jax.lax.scan(lambda v, _: (jnp.sin(v), None), v, length=10)[0]
    assert count(loop, jnp.ones(6)) == 60
    branch = lambda v: jax.lax.cond(True, lambda v: v, lambda v: jnp.sin(jnp.sin(v)), v)
    assert 12 <= count(branch, jnp.ones(6)) <= 13  # and the choice
    assert count(jax.lax.linalg.cholesky, jnp.eye(8)) >= 8**3
    W, chain = jnp.ones((6, 6)), lambda W, v: jnp.sum(jnp.tanh(W @ jnp.tanh(W @ v)))
    for parameters, least, most in ((1, 0.5, 1.5), (36, 5, 36)):
        at = lambda p: chain(W.at[0, 0].add(p[0]) if len(p) == 1 else p.reshape(6, 6), W[0])
        one = lambda p, d, at=at: jax.jvp(at, (p,), (d,))[1]
        p = jnp.ones(parameters)
        forward = count(lambda p, one=one: jax.vmap(lambda d: one(p, d))(jnp.eye(len(p))), p)
        assert least < forward / count(jax.grad(at), p) < most


class Looping:
    """The same plant, by a loop that reverse mode cannot go through."""

    def step(self, x, u):
        once = lambda carry: (carry[0] + 1, SYSTEM.A @ carry[1] + SYSTEM.B @ u)
        return jax.lax.while_loop(lambda carry: carry[0] < 1, once, (0, x))[1]


@pytest.mark.slow
def test_auto_goes_forward_where_it_must(x64):
    settings = {"steps": 4, "solver": SOLVER, "updates": 1}
    found = tune_weights(weighed, PARAMETERS, Looping(), starts(8), LOSS, **settings)
    assert found.settings["mode"] == "forward" and found.history.accepted.all()
    with pytest.raises(ValueError, match="while_loop"):
        tune_weights(weighed, PARAMETERS, Looping(), starts(8), LOSS, mode="reverse", **settings)


@pytest.mark.slow
def test_derivatives_of_100_random_problems(x64):
    """Every entry of Q, R, the soft penalty and ADMM's rho against central differences, to 1e-4."""
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(100, 2, 2)) * 0.3
    settings = {
        "Q": MPC.Q + noise @ np.swapaxes(noise, 1, 2),
        "R": MPC.R * np.exp(rng.normal(size=(100, 1, 1))),
        "P": MPC.Q * np.exp(rng.normal(size=(100, 1, 1))),
        "rho": 5 * np.exp(rng.normal(size=100)),
    }
    x0s = rng.uniform([-1, -0.7], [1, 0.7], (100, 2))

    def cost(v, x0, solver):
        mpc = replace(weighed(v), terminal_cost=v["P"])
        run = jm.simulate(jm.Controller(jm.soften(mpc, v["rho"]), solver), SYSTEM, x0, 12)
        return LOSS(run)

    def compare(cost, settings, steps=(1e-5, 2e-5)):
        value = jax.jit(jax.vmap(cost))
        found = jax.jit(jax.vmap(jax.grad(cost)))(settings, x0s)
        for name, v in settings.items():
            scale = np.abs(found[name]).reshape(100, -1).max(axis=1)
            for place in np.ndindex(v.shape[1:]):
                errors = []
                for step in steps:  # a plan solved to 1e-11 makes one of them noisy
                    moved = [dict(settings, **{name: v.copy()}) for _ in range(2)]
                    for sign, m in zip((1, -1), moved, strict=True):
                        m[name][(slice(None), *place)] += sign * step
                    change = (value(moved[0], x0s) - value(moved[1], x0s)) / (2 * step)
                    errors.append(np.abs(change - found[name][(slice(None), *place)]))
                error = np.minimum(*errors)
                assert np.all(error <= 1e-4 * scale + 1e-8), (name, place, error.max())

    compare(lambda v, x: cost(v, x, jm.ADMM(iterations=50, newton_steps=20)), settings)
    # ADMM's own penalty, one a row and stage, of a loop that is far from converged.
    rows = len(jm.mpc.row_table(jm.soften(MPC, 1.0)))
    settings = {"rho_admm": np.exp(0.5 * rng.normal(size=(100, 2, rows)))}
    few = lambda v: jm.ADMM(
        iterations=8, newton_steps=0, rho=v["rho_admm"], differentiate="unrolled"
    )
    fixed = {"Q": MPC.Q, "R": MPC.R, "P": MPC.Q, "rho": 5.0}
    compare(lambda v, x: cost(fixed, x, few(v)), settings)


@pytest.mark.slow
@pytest.mark.parametrize("linearize", ["set-point", "state"])
def test_derivatives_through_a_robot(x64, linearize):
    """Every weight and the penalty of a pendulum in MJX, a joint stop in its way, forward and
    reverse, against differences: to 1e-3 (asked), here 1e-5."""
    with pytest.warns(UserWarning, match="wider limits than its file"):
        robot = jm.load_robot("pendulum", velocity=([-1.0], [1.0]), torque=([-60.0], [60.0]))
    x, u = robot.equilibrium()
    goal = {"reference": np.asarray(robot.coordinates(x)), "input_reference": np.asarray(u)}
    mpc = jm.robot_mpc(robot, [4.0, 0.04], [1e-4], horizon=8)
    loss = ClosedLoopLoss(
        np.diag(mpc.Q), np.diag(mpc.R), **goal, limits=robot.state_limits, plant=robot
    )
    rng = np.random.default_rng(0)
    x0s = np.asarray(x) + rng.uniform([-0.5, -1.2], [0.5, 1.2], (8, 2))

    def cost(v):
        problem = replace(mpc, Q=v["Q"], R=v["R"])
        controller = jm.RobotController(
            robot, problem, jm.ADMM(iterations=50, newton_steps=8), linearize, rho=v["rho"]
        )
        loop = lambda x0: loss(jm.simulate(controller, robot, x0, 10, **goal))
        return jnp.mean(jax.vmap(loop)(x0s))

    v = {"Q": jnp.asarray(mpc.Q), "R": jnp.asarray(mpc.R), "rho": jnp.asarray(0.1)}
    value = jax.jit(cost)
    forward, reverse = jax.jit(jax.jacfwd(cost))(v), jax.jit(jax.grad(cost))(v)
    for name in v:
        size = np.abs(forward[name]).max()
        np.testing.assert_allclose(forward[name], reverse[name], atol=1e-8 * size)
        assert size > 0
        for place in np.ndindex(v[name].shape):
            h = 1e-4 * float(np.abs(v[name]).max())
            ends = [value({**v, name: v[name].at[place].add(s * h)}) for s in (1, -1)]
            change = (ends[0] - ends[1]) / (2 * h)
            np.testing.assert_allclose(forward[name][place], change, atol=1e-5 * size)


def run_of(states, inputs):
    """A Run of which a loss reads states and inputs."""
    empty = jnp.zeros(len(inputs))
    return Run(states, inputs, empty, empty, empty, empty, empty, empty)


def test_loss_in_closed_form(x64):
    states = jnp.array([[2.0, 0.0], [1.0, 0.5], [0.4, 0.1], [0.0, 0.0]])
    inputs = jnp.array([[1.0], [2.0], [0.0]])
    aim = {"reference": np.array([1.0, 0.0]), "input_reference": np.array([1.0])}
    found = ClosedLoopLoss([2.0, 4.0], [3.0], **aim, violation=0.0)(run_of(states, inputs))
    np.testing.assert_allclose(found, (2 * (1 + 0 + 0.36) + 4 * 0.26 + 3 * (0 + 1 + 1)) / 3)
    box = jm.Box([-1.0, -np.inf], [1.5, 0.2])
    found = ClosedLoopLoss([0, 0], [0], limits=box, violation=7.0)(run_of(states, inputs))
    np.testing.assert_allclose(found, 7 * (0.5 / 1.25 + 0.3) / 3)
    # Outside a band of 0.45 at samples 1 and, by its speed, not at 2: one sample to settle.
    settle = {"violation": 0.0, "settling": 1.0, "band": [0.45, 0.45], "softness": 1e-3}
    np.testing.assert_allclose(
        ClosedLoopLoss([0, 0], [0], **settle)(run_of(states, inputs)), 1.0, atol=1e-9
    )
    terms = ClosedLoopLoss([2.0, 4.0], [3.0], limits=box, **(settle | {"violation": 7.0}))
    found = terms.terms(run_of(states, inputs))
    expected = [(2 * (4 + 1 + 0.16) + 4 * 0.26) / 3, 3 * 5 / 3, 7 * (0.5 / 1.25 + 0.3) / 3, 1.0]
    np.testing.assert_allclose(list(found.values()), expected, atol=1e-9)
    assert list(found) == ["tracking", "effort", "violation", "settling"]
    late = states.at[3, 0].set(1.0)  # it comes back out: three
    np.testing.assert_allclose(ClosedLoopLoss([0, 0], [0], **settle)(run_of(late, inputs)), 3.0)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"parameters": {"Q": np.eye(2)}}, r"parameters\['Q'\]"),
        ({"x0s": np.zeros(2)}, r"x0s.*\(2,\)"),
        ({"x0s": np.zeros((1, 2))}, "x0s.*1 states"),
        ({"x0s": np.zeros((4, 3))}, "x0"),
        ({"mode": "backward"}, "mode.*'backward'"),
        ({"batch": 0}, "batch"),
        ({"batch": 2.5}, "batch.*2.5"),
        ({"steps": 2.7}, "steps.*2.7"),
        ({"updates": -1}, "updates"),
        ({"optimizer": optax.lbfgs()}, "optimizer"),
        ({"validation": 1.5}, "validation.*1.5"),
        ({"validation": np.zeros((3, 4))}, r"validation.*\(3, 4\)"),
        ({"variations": {"payload": np.zeros(3)}}, "variations"),
        ({"variations": {"payload": np.zeros(16)}}, "variations"),
        ({"make": lambda v: v["Q"]}, "make_mpc.*Return a jm.MPC"),
        ({"loss": lambda run: run.cost}, r"loss.*\(8,\)"),
        ({"loss": lambda run: None}, "loss: returns None. Return one number"),
        ({"loss": "a"}, "loss: is a str. Give a function of a Run"),
        ({"design_loss": "a"}, "design_loss: is a str. Give a function of an MPC"),
        ({"steps": 0}, "steps"),
        ({"starts": [{"S": 1.0}]}, "starts: holds 'S', which is no parameter"),
        ({"starts": [{"Q": 3.0}]}, r"starts\[0\]\['Q'\]: shape \(\)"),
        ({"starts": [{}, {"Q": -np.eye(2)}]}, r"starts\[1\]\['Q'\]: .*definite"),
    ],
)
def test_bad_arguments_before_any_compile(more, message, monkeypatch):
    monkeypatch.setattr("jaxmpc.batches.Compiled.program", None)
    with pytest.raises(ValueError, match=message):
        tune(**more)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"Q": np.ones((2, 3))}, r"Q.*\(2, 3\)"),
        ({"Q": [-1.0, 1.0]}, "Q.*semidefinite"),
        ({"violation": -1.0}, "violation"),
        ({"settling": 1.0}, "band.*None"),
        ({"settling": 1.0, "band": [0.0, 1.0]}, "band"),
        ({"softness": 0.0}, "softness"),
        ({"violation": "a"}, "violation: 'a'|violation: entries|violation: is"),
        ({"limits": [[-1.0], [1.0]]}, "limits: is a list. Give a jm.Box or jm.Polytope"),
        ({"band": np.ones((2, 2))}, r"band: shape \(2, 2\)"),
        ({"Q": np.eye(3)}, r"loss.Q: shape \(3, 3\)"),
        ({"R": [1.0, 1.0]}, r"loss.R: shape \(2, 2\)"),
        (
            {"reference": 1.0},
            r"loss.reference: shape \(\). Give \(2,\), or a row",
        ),
        ({"reference": np.ones(1)}, r"loss.reference: shape \(1,\)"),
        ({"reference": np.ones((4, 1))}, r"loss.reference: shape \(4, 1\)"),
        ({"reference": np.ones((2, 2))}, r"loss.reference: shape \(2, 2\)"),
        ({"input_reference": np.ones((2, 1))}, r"loss.input_reference: shape \(2, 1\)"),
        ({"settling": 1.0, "band": [1.0]}, r"loss.band: shape \(1,\)"),
        ({"limits": jm.Box([-1.0] * 3, [1.0] * 3)}, "loss.limits"),
    ],
)
def test_bad_losses(more, message):
    run = run_of(jnp.zeros((4, 2)), jnp.zeros((3, 1)))
    with pytest.raises(ValueError, match=message):
        ClosedLoopLoss(**{"Q": [1.0, 1.0], "R": [1.0], **more})(run)


def test_a_loss_has_derivatives_with_respect_to_its_weights(x64):
    """The weights of a loss are sums over the run, whatever knows them: here a trace."""
    run = run_of(np.array([[1.0, 2.0], [0.5, -1.0], [0.0, 3.0]]), np.array([[1.0], [-2.0]]))
    limits = jm.Box([-2.0, -2.0], [2.0, 2.0])

    def loss(q, r, violation):
        return ClosedLoopLoss(q, r, limits=limits, violation=violation)(run)

    found = jax.jit(jax.grad(loss, (0, 1, 2)))(jnp.array([1.0, 2.0]), jnp.array([0.1]), 3.0)
    wanted = [(1 + 0.25) / 2, (4 + 1) / 2], [(1 + 4) / 2], 0.5 / 2
    jax.tree.map(np.testing.assert_allclose, found, tuple(map(np.asarray, wanted)))


def test_a_loss_is_of_one_loop():
    run = run_of(jnp.zeros((5, 4, 2)), jnp.zeros((5, 3, 1)))
    with pytest.raises(ValueError, match=r"run: has inputs of shape \(5, 3, 1\). Give one"):
        LOSS(run)
    assert jax.vmap(LOSS)(run).shape == (5,)


@pytest.mark.slow
def test_training_and_validation_have_the_conditions_of_simulate(x64):
    x0s = starts(6)
    conditions = {"delay": 1, "noise": NOISE, "disturbance": np.tile([0.0, 0.01], (8, 1))}
    tuned = tune(x0s, loss=LOSS, conditions=conditions, updates=1, validation=0.5, batch=3)
    at_start = jm.Controller(weighed({k: v.value for k, v in PARAMETERS.items()}), SOLVER)
    run = jm.closed_loop.simulate_many(at_start, SYSTEM, x0s, 8, **conditions)
    losses = np.asarray(jax.vmap(LOSS)(jax.tree.map(jnp.asarray, run)))
    found = {tuned.history.loss[0], tuned.history.validation[0]}
    train, test = Settings(validation=0.5, batch=3).split((np.arange(6), {}))
    wanted = losses[train[0]].mean(), losses[test[0]].mean()
    np.testing.assert_allclose(sorted(found), sorted(wanted), rtol=1e-9)


@pytest.mark.parametrize("kind", ["law", pytest.param("plans", marks=pytest.mark.slow)])
def test_loops_have_the_conditions_of_simulate(x64, kind):
    """A delay, a disturbance and noise: the losses are those of `simulate_many` under the same."""
    x0s, start = starts(6), {k: v.value for k, v in PARAMETERS.items()}
    made = lambda v: jm.Controller(weighed(v), SOLVER)
    if kind == "law":
        made = lambda v: jm.closed_loop.LinearFeedback(MPC, -v["R"] @ v["Q"][:1])
    conditions = {"delay": 1, "noise": NOISE, "disturbance": np.tile([0.0, 0.01], (8, 1))}
    objective = ClosedLoopObjective(
        made, PARAMETERS, SYSTEM, 8, LOSS, None, None, None, conditions
    )  # fmt: skip
    theta = {k: v.raw() for k, v in PARAMETERS.items()}
    found = jax.jit(lambda theta: objective.total(theta, SYSTEM, x0s, {}, np.ones(6))[1])(theta)
    run = jm.closed_loop.simulate_many(made(start), SYSTEM, x0s, 8, **conditions)
    losses = jax.vmap(LOSS)(jax.tree.map(jnp.asarray, run))
    np.testing.assert_allclose(found["losses"], losses, rtol=1e-9)


@pytest.mark.slow
def test_an_observer_is_tuned_through_the_loop(x64):
    """Its derivative is that of differences."""
    noise = jm.closed_loop.Noise(process=0.01, measurement=0.03, seed=3)

    def observer(v):
        return jm.closed_loop.KalmanFilter(SYSTEM, v["process"], 0.03, np.array([[1.0, 0.0]]))

    parameters = {"process": Parameter(0.02, "positive")}
    objective = ClosedLoopObjective(
        lambda v: jm.Controller(MPC, SOLVER), parameters, SYSTEM, 8, LOSS, None, None, None,
        {"observer": observer, "noise": noise},
    )  # fmt: skip
    x0s = starts(4)
    value = lambda theta: objective.total({"process": theta}, SYSTEM, x0s, {}, np.ones(4))[0]
    at, h = parameters["process"].raw(), 1e-5
    value = jax.jit(value)
    wanted = (value(at + h) - value(at - h)) / (2 * h)
    np.testing.assert_allclose(jax.jit(jax.grad(value))(at), wanted, rtol=1e-5)
    assert abs(wanted) > 1e-6


def test_conditions_that_no_loop_has():
    with pytest.raises(ValueError, match="conditions: has 'dely'.*Did you mean delay"):
        tune(conditions={"dely": 1})
    with pytest.raises(ValueError, match="conditions: has 'reference'.*arguments of their own"):
        tune(conditions={"reference": np.zeros(2)})
