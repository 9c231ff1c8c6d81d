"""Several losses at once, and several starting points: fronts and minima in closed form."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxmpc as jm
from jaxmpc.tuning import Interrupted, Parameter, TradeOff, pareto, trade_off, tune_weights, weights

# A plant that is at its input one time step later, under a law that gives the input reference.
NEXT = jm.LinearSystem(np.zeros((2, 2)), np.eye(2), dt=1.0)
LAW = jm.closed_loop.LinearFeedback(jm.MPC(NEXT, np.eye(2), np.eye(2), 1), np.zeros((2, 2)))
GOAL = {"goal": Parameter([0.8, 0.3])}
STARTS = np.random.default_rng(0).normal(size=(8, 2))
ENDS = {"a": np.array([1.0, 0.0]), "b": np.array([-2.0, 4.0])}


pytestmark = pytest.mark.usefixtures("x64")


def options(**more):
    return {"mode": "forward", "input_reference": lambda v: v["goal"], **more}


def stop_in_third_run(monkeypatch):
    real, calls = weights.descend, []

    def descend(*arguments):
        calls.append(arguments)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return real(*arguments)

    monkeypatch.setattr(weights, "descend", descend)


def distance(end):
    return lambda run: jnp.sum((run.states[-1] - end) ** 2)


@pytest.mark.long
def test_the_front_of_two_distances_is_known(tmp_path, monkeypatch):
    """The least of w |x − a|² + (1 − w) |x − b|² is at w a + (1 − w) b: there the losses are
    (1 − w)² d² and w² d², d = |a − b| = 5; Gauss-Newton steps are exact."""
    losses = {name: distance(end) for name, end in ENDS.items()}
    w = np.array([0.9, 0.5, 0.2])
    given = {"weights": np.stack([w, 1 - w], 1), "updates": 2, "checkpoint": tmp_path / "run.npz"}
    call = lambda: trade_off(
        lambda v: LAW, GOAL, NEXT, STARTS, losses, 2, **options(mode="gauss-newton", **given)
    )
    found = call()
    np.testing.assert_allclose(found.losses, 25 * np.stack([(1 - w) ** 2, w**2], 1), atol=1e-6)
    for share, run in zip(w, found.runs, strict=True):
        wanted = share * ENDS["a"] + (1 - share) * ENDS["b"]
        np.testing.assert_allclose(run.values["goal"], wanted, atol=1e-4)
    np.testing.assert_allclose(found.initial, [0.13, 2.8**2 + 3.7**2], rtol=1e-6)
    assert found.efficient.all() and found.names == ("a", "b")
    assert {p.name for p in tmp_path.iterdir()} == {"run.npz", "run-1.npz", "run-2.npz"}
    assert found.record()["efficient"] == [True] * 3 and "point 2" in repr(found)
    again = call()  # goes on from the checkpoints, which are done
    np.testing.assert_array_equal(again.losses, found.losses)
    stop_in_third_run(monkeypatch)
    with pytest.raises(Interrupted, match="2 of 3 points") as stop:
        call()
    np.testing.assert_array_equal(stop.value.run.losses, found.losses[:2])


@pytest.mark.slow
def test_tracking_against_effort_is_monotone():
    """Weights from 10:1 to 1:10, of losses that are computed here again from the runs."""
    system = jm.LinearSystem(np.array([[1, 0.2], [0, 1]]), np.array([[0.02], [0.2]]), dt=0.2)
    mpc = jm.MPC(system, np.eye(2), np.eye(1), 5, inputs=jm.Box([-1.0], [1.0]))
    make = lambda v: replace(mpc, Q=v["Q"], R=v["R"], terminal_cost=v["Q"])
    parameters = {"Q": Parameter(mpc.Q, "diagonal"), "R": Parameter(mpc.R, "definite")}
    losses = {
        "tracking": lambda run: jnp.sum(run.states[:, 0] ** 2),
        "effort": lambda run: jnp.sum(run.inputs**2),
    }
    found = trade_off(
        make, parameters, system, STARTS, losses, 15, weights=4, updates=12, mode="forward",
        solver=jm.ADMM(iterations=30, newton_steps=0, eps=1e-3), optimizer=optax.adam(0.3),
    )  # fmt: skip
    assert np.all(np.diff(found.losses[:, 0]) > 0) and np.all(np.diff(found.losses[:, 1]) < 0)
    assert found.efficient.all()
    ratio = (found.weights * found.initial)[:, 0] / (found.weights * found.initial)[:, 1]
    np.testing.assert_allclose(ratio, 10.0 ** np.array([1, 1 / 3, -1 / 3, -1]))
    last = jm.simulate_many(found.runs[-1].result, system, STARTS[-2:], 15)
    wanted = np.mean(np.sum(last.states[..., 0] ** 2, 1)), np.mean(np.sum(last.inputs**2, (1, 2)))
    np.testing.assert_allclose(found.losses[-1], wanted, rtol=1e-9)


def test_points_that_others_dominate():
    """Against comparison in pairs; equal points do not dominate each other."""
    losses = np.random.default_rng(0).integers(0, 6, (40, 3)).astype(float)
    found = TradeOff(("a", "b", "c"), np.ones((40, 3)), losses[:39], losses[39], ())
    for k, point in enumerate(losses[:39]):
        dominated = any(all(o <= point) and any(o < point) for o in losses)
        assert found.efficient[k] != dominated
    assert found.efficient.any() and not found.efficient.all()


def well(run):
    """Minima near x = ±1, the one at −1 lower; no loss beyond 3."""
    x = run.states[-1, 0]
    return jnp.where(x < 3, (x**2 - 1) ** 2 + 0.3 * x, jnp.nan)


def start_at(goal, **more):
    parameters = {"goal": Parameter(goal, train=[True, False])}
    more = options(optimizer=optax.sgd(0.05), updates=20, **more)
    return tune_weights(lambda v: LAW, parameters, NEXT, STARTS, well, 2, **more)


@pytest.mark.long
def test_the_best_of_several_starting_points(tmp_path, monkeypatch):
    """The start comes to a minimum that is not the least; the second of the others does, by the
    steps that it takes alone."""
    points = [{"goal": [1.5, 0.0]}, {"goal": [-0.4, 0.0]}, {"goal": [5.0, 0.0]}]
    path = tmp_path / "run.npz"
    found = start_at([0.8, 0.0], starts=points, checkpoint=path)
    alone, first = start_at([-0.4, 0.0]), start_at([0.8, 0.0])
    np.testing.assert_array_equal(found.history.thetas["goal"], alone.history.thetas["goal"])
    least = np.roots([4, 0, -4, 0.3])  # the derivative of the loss
    np.testing.assert_allclose(found.values["goal"][0], least.min(), atol=1e-3)
    assert found.start == 2 and found.improved and np.isnan(found.starts[3])
    np.testing.assert_allclose(found.starts[[0, 2]], [first.after["loss"], alone.after["loss"]])
    assert found.before == first.before and found.initial["goal"][0] == 0.8
    assert "from start 2 of 4" in repr(found) and found.record()["starts"][3] is None

    stop_in_third_run(monkeypatch)
    with pytest.raises(Interrupted, match="2 of 4 starts") as stop:
        start_at([0.8, 0.0], starts=points)
    assert stop.value.run.start == int(np.nanargmin(found.starts[:2]))
    np.testing.assert_allclose(stop.value.run.starts[:2], found.starts[:2])


def test_random_starting_points_are_those_of_the_seed():
    one, other = (start_at([0.8, 0.0], starts=3, seed=seed) for seed in (1, 1))
    np.testing.assert_array_equal(one.starts, other.starts)
    assert len(one.starts) == 3 and len(set(one.starts)) == 3


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"losses": {"a": well}}, "losses: is .*two or more"),
        ({"losses": well}, "losses"),
        ({"losses": {"a": well, "b": lambda run: run.cost}}, r"losses\['b'\]: has shape \(2,\)"),
        ({"weights": 1}, "weights: 1"),
        ({"weights": [[1.0, 2.0, 3.0]]}, r"weights: shape \(1, 3\)"),
        ({"weights": [[1.0, -1.0]]}, "weights"),
        ({"weights": [[0.0, 0.0]]}, "weights"),
        (
            {"weights": 3, "losses": dict.fromkeys("abc", well)},
            r"weights: 3 for 3 losses.*\(K, 3\)",
        ),
        ({"loss": well}, "loss"),
    ],
)
def test_bad_trade_offs_before_any_compile(more, message, monkeypatch):
    monkeypatch.setattr("jaxmpc.batches.Compiled.program", None)
    losses = more.pop("losses", {"a": well, "b": well})
    with pytest.raises((ValueError, TypeError), match=message):
        trade_off(lambda v: LAW, GOAL, NEXT, STARTS, losses, 2, **options(), **more)


@pytest.mark.parametrize(
    ("starts", "message"),
    [
        (0, "starts: 0"),
        (2.5, "starts: 2.5"),
        ([{"gaol": [0.0, 0.0]}], "starts: holds 'gaol'.*goal"),
        ([[0.0, 0.0]], "starts: holds"),
        ([{"goal": [np.nan, 0.0]}], r"starts\[0\]\[.goal.\]: holds NaN"),
    ],
)
def test_bad_starting_points_before_any_compile(starts, message, monkeypatch):
    monkeypatch.setattr("jaxmpc.batches.Compiled.program", None)
    with pytest.raises(ValueError, match=message):
        start_at([0.8, 0.0], starts=starts)


def test_losses_of_zero_have_no_shares():
    with pytest.raises(ValueError, match=r"losses\['zero'\]: is 0 with the values given"):
        pareto._even_weights(3, np.array([1.0, 0.0]), ("one", "zero"))
