"""Gradient descent with guards: answer, steps back, checkpoints. Domains of parameters."""

import dataclasses
import importlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxmpc.files import side_path
from jaxmpc.tuning.descent import Settings, descend
from jaxmpc.tuning.parameters import Parameter, raw, require_parameters, values

TARGET = {"a": np.array([1.0, -2.0]), "b": np.array(3.0)}
START = {"a": np.zeros(2), "b": np.array(0.0)}
DECIDES = {"problem": "bowl"}


def distance(theta):
    return sum(float(np.sum((theta[name] - TARGET[name]) ** 2)) for name in TARGET)


def slope(theta, step):
    noise = np.random.default_rng(step).normal(size=2)  # minibatches differ from step to step
    gradient = {name: 2 * (theta[name] - TARGET[name]) for name in TARGET}
    gradient["a"] = gradient["a"] + 0.1 * noise
    return distance(theta), gradient, {"noise": noise[0]}


def check(theta):
    return distance(theta), {"first": theta["a"][0]}


def bowl(updates=40, gradient=slope, **more):
    decides = more.pop("decides", None)
    settings = Settings(updates, **{"optimizer": optax.adam(0.3), **more})
    return descend(START, gradient, check, optax.sgd(0.0), settings, decides)


def assert_same(one, other):
    np.testing.assert_array_equal(one.thetas["a"], other.thetas["a"])
    np.testing.assert_array_equal(one.validation, other.validation)
    np.testing.assert_array_equal(one.accepted, other.accepted)
    np.testing.assert_array_equal(one.numbers["noise"], other.numbers["noise"])


def test_comes_to_the_minimum_and_keeps_the_best():
    found = bowl(80)
    assert found.validation[found.best] == np.min(found.validation) < 1e-2
    assert distance(found.theta) == found.validation[found.best]
    assert found.steps == 80 and found.validation.shape == (81,) and found.accepted.all()
    np.testing.assert_array_equal(found.validation_numbers["first"], found.thetas["a"][:, 0])
    wild = bowl(5, optimizer=optax.sgd(-1.0))  # uphill: the start is the best of all
    assert wild.best == 0 and distance(wild.theta) == distance(START)


def test_sgd_steps_are_optax_own():
    """Plain gradient descent on the quadratic has a closed form."""
    exact = lambda theta, step: (
        *slope(theta, step)[:1],
        {name: 2 * (theta[name] - TARGET[name]) for name in TARGET},
        {},
    )
    found = bowl(10, exact, optimizer=optax.sgd(0.1))
    np.testing.assert_allclose(found.thetas["b"], 3 * (1 - 0.8 ** np.arange(11)), rtol=1e-12)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_steps_that_are_not_finite_are_taken_back_and_halved(bad):
    calls = []

    def fragile(theta, step):
        calls.append(theta["b"].item())
        loss, gradient, numbers = slope(theta, step)
        if theta["b"] > 1.0 and step < 6:  # a cliff that is gone later
            gradient = {**gradient, "a": np.full(2, bad)}
        return loss, gradient, numbers

    found = bowl(12, fragile, optimizer=optax.sgd(0.4))
    # b: 0 → 2.4, refuse, → 1.2, refuse, → 0.6 and on from there with the step that worked.
    assert found.accepted[:4].tolist() == [True, False, False, True]
    np.testing.assert_allclose(calls[:4], [0.0, 2.4, 1.2, 0.6])
    assert np.isfinite(found.thetas["a"]).all() and found.validation[-1] < 0.1


def test_a_start_without_finite_loss_is_refused():
    with pytest.raises(ValueError, match=r"parameters.*no finite validation loss"):
        descend(START, slope, lambda theta: (np.nan, {}), optax.sgd(0.1), Settings(3))
    with pytest.raises(ValueError, match="updates"):
        bowl(-1)
    with pytest.raises(ValueError, match="optimizer.*gradient alone"):
        bowl(optimizer=optax.lbfgs())
    with pytest.raises(ValueError, match="optimizer: 'adam' is no optimizer. Give one of optax"):
        bowl(optimizer="adam")


class Killed(BaseException):
    """Stands for a signal."""


@pytest.mark.parametrize(
    ("target", "late"),
    [
        ("test_descent.distance", False),
        ("numpy.savez_compressed", False),
        ("os.replace", False),
        ("os.replace", True),
    ],
)
def test_a_killed_run_goes_on_where_it_was(tmp_path, monkeypatch, target, late):
    """Killed three times, within the gradient, while writing, before and after the rename."""
    path = tmp_path / "run.npz"
    whole = bowl(12)
    module = (
        sys.modules[__name__]
        if target.startswith("test")
        else importlib.import_module(target.split(".")[0])
    )
    name = target.split(".")[1]
    real = getattr(module, name)
    for calls in (2, 3, 4):
        left = [calls]

        def trap(*arguments, left=left, **named):
            left[0] -= 1
            if left[0] < 0 and not late:
                raise Killed
            result = real(*arguments, **named)
            if left[0] < 0:
                raise Killed
            return result

        with monkeypatch.context() as m:
            m.setattr(module, name, trap)
            with pytest.raises(Killed):
                bowl(12, checkpoint=path, decides=DECIDES)
    assert_same(bowl(12, checkpoint=path, decides=DECIDES), whole)
    assert [p.name for p in tmp_path.iterdir()] == ["run.npz"]  # no side files left


@pytest.mark.parametrize("where", ["gradient", "validation", "checkpoint"])
def test_an_interrupt_keeps_the_steps_that_are_done(tmp_path, monkeypatch, capsys, where):
    """Ctrl-C in the seventh step, of which validation takes place every fourth time."""
    names = {"gradient": "slope", "validation": "check", "checkpoint": "replace"}
    module = os if where == "checkpoint" else sys.modules[__name__]
    real, left = getattr(module, names[where]), [1 if where == "validation" else 7]

    def trap(*arguments):
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt
        return real(*arguments)

    path = tmp_path / "run.npz"
    settings = Settings(12, optax.adam(0.3), checkpoint=path, progress=True)
    go = lambda: descend(
        START,
        lambda *v: slope(*v),
        lambda *v: check(*v),
        optax.sgd(0.0),
        settings,
        DECIDES,
        4,
        "first",
    )
    monkeypatch.setattr(module, names[where], trap)
    if where == "validation":  # before the first step there is nothing to keep
        with pytest.raises(KeyboardInterrupt):
            go()
        left[0] = 3  # once before the first step, once after four, then after eight
    cut = go()
    monkeypatch.undo()
    done = {"gradient": 6, "validation": 7, "checkpoint": 6}[where]
    assert cut.interrupted and cut.steps == done and cut.validation.shape == (done + 1,)
    measured = np.flatnonzero(np.isfinite(cut.validation))
    assert measured.tolist() == sorted({0, 4, done})
    assert cut.validation[cut.best] == np.nanmin(cut.validation) == distance(cut.theta)
    assert "best on validation" in capsys.readouterr().err
    whole = go()
    assert not whole.interrupted and whole.steps == 12
    np.testing.assert_array_equal(whole.thetas["a"], bowl(12).thetas["a"])
    assert np.flatnonzero(np.isfinite(whole.validation)).tolist() == [0, 4, 8, 12]


def test_checkpoints_that_do_not_fit(tmp_path):
    path = tmp_path / "run.npz"
    bowl(3, checkpoint=path, decides=DECIDES)
    with pytest.raises(ValueError, match="other settings"):
        bowl(3, checkpoint=path, decides={"problem": "other"})
    with pytest.raises(ValueError, match="another optimizer"):
        bowl(3, checkpoint=path, decides=DECIDES, optimizer=optax.sgd(0.1))
    with pytest.raises(ValueError, match="another optimizer"):  # as many numbers, another step
        bowl(3, checkpoint=path, decides=DECIDES, optimizer=optax.adam(0.2))
    with pytest.raises(ValueError, match=r"had the validation loss 14 after 0 steps, now 28"):
        other = lambda theta: (2 * distance(theta), {})
        descend(START, slope, other, optax.adam(0.3), Settings(3, checkpoint=path), DECIDES)
    with pytest.raises(ValueError, match=r"had the validation loss .* after 3 steps, now 0"):
        # The same at the start alone, as a penalty of what the start does not violate.
        other = lambda theta: (distance(theta) * (theta["b"].item() == START["b"]), {})
        descend(START, slope, other, optax.adam(0.3), Settings(3, checkpoint=path), DECIDES)
    # Rounding beside the loss at the start is none of another function.
    other = lambda theta: (distance(theta) + 1e-7 * distance(START), {})
    descend(START, slope, other, optax.adam(0.3), Settings(3, checkpoint=path), DECIDES)
    whole = path.read_bytes()
    for damaged in (b"nothing", whole[: len(whole) // 2], b""):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match="is no checkpoint"):
            bowl(3, checkpoint=path, decides=DECIDES)
    path.unlink()
    side_path(tmp_path / "run.npz").write_bytes(b"by a killed process")
    bowl(1, checkpoint=path, decides=DECIDES)
    assert [p.name for p in tmp_path.iterdir()] == ["run.npz"]


CHILD = """
import sys, time
sys.path.insert(0, {tests!r})
import test_descent as t
slow = lambda theta, step: (time.sleep(0.02), t.slope(theta, step))[1]
t.bowl(200, slow, checkpoint={path!r}, decides=t.DECIDES)
"""


@pytest.mark.slow
def test_sigkill_twenty_times_loses_at_most_a_step(tmp_path):
    """A real process, killed at random moments; what it wrote in between is never behind by more
    than the step in hand, and the end is that of a run left alone."""
    path = tmp_path / "run.npz"
    code = CHILD.format(tests=str(Path(__file__).parent), path=str(path))
    rng, done = np.random.default_rng(0), 0

    def steps():
        with np.load(path) as data:
            return len(data["theta_1_0"]) - 1

    for _ in range(20):
        child = subprocess.Popen([sys.executable, "-c", code])
        while not path.exists() or (child.poll() is None and steps() <= done):
            time.sleep(0.01)  # until it has done a step of its own
        time.sleep(rng.uniform(0, 0.2))
        before = steps()
        child.send_signal(signal.SIGKILL)
        child.wait()
        assert steps() >= before >= done
        done = steps()
    assert_same(bowl(200, checkpoint=path, decides=DECIDES), bowl(200))


@pytest.mark.parametrize(
    "parameter",
    [
        Parameter([1.0, -2.0]),
        Parameter([1.0, 2.0], "positive"),
        Parameter([0.5, 1.5], "interval", lower=0.0, upper=[1.0, 2.0]),
        Parameter([3.0, 0.1], "diagonal"),
        Parameter([[2.0, 0.5], [0.5, 1.0]], "definite"),
    ],
    ids=lambda p: p.domain,
)
def test_parameters_start_at_their_value_and_stay_in_their_domain(parameter):
    with jax.enable_x64(True):
        np.testing.assert_allclose(parameter.at(parameter.raw()), parameter.value, rtol=1e-14)
        rng = np.random.default_rng(0)
        for _ in range(20):
            value = np.asarray(
                parameter.at(parameter.raw() + 2 * rng.normal(size=parameter.raw().shape))
            )
            if parameter.domain in ("diagonal", "definite"):
                assert np.linalg.eigvalsh(value)[0] > 0 and np.array_equal(value, value.T)
            if parameter.domain == "diagonal":
                assert np.array_equal(value, np.diag(np.diag(value)))
            if parameter.domain == "positive":
                assert np.all(value > 0)
            if parameter.domain == "interval":
                assert np.all((value > parameter.lower) & (value < parameter.upper))


def test_the_precision_of_a_program_is_that_of_theta():
    """A value may be asked for in float32 within `jit` and in float64 afterwards."""
    parameter = Parameter(0.02, "interval", lower=0.0, upper=0.5)
    single = jax.jit(lambda theta: parameter.at(theta))(np.float32(parameter.raw()))
    with jax.enable_x64(True):
        double = jax.jit(lambda theta: parameter.at(theta))(parameter.raw())
    assert single.dtype == np.float32 and double.dtype == np.float64
    np.testing.assert_allclose([single, double], 0.02, rtol=1e-6)
    # Whole numbers, as JSON has them, decide no precision.
    np.testing.assert_allclose(parameter.at([0]), parameter.at([0.0]), rtol=1e-6)
    held = Parameter([0.2, 0.9], train=[True, False])
    np.testing.assert_allclose(held.at([1]), [1.0, 0.9], rtol=1e-6)


def test_masks_hold_entries():
    parameters = {
        "Q": Parameter(np.diag([4.0, 9.0]), "definite", train=np.array([[True, False]] * 2)),
        "R": Parameter([[1.0]], "diagonal", train=False),
        "r": Parameter([1.0, 2.0, 3.0], train=[False, True, False]),
    }
    theta = raw(parameters)
    assert {name: v.size for name, v in theta.items()} == {"Q": 2, "R": 0, "r": 1}
    with jax.enable_x64(True):
        moved = values(parameters, {name: v + 1.0 for name, v in theta.items()})
    # L = [2e 0; 1 3]: its last entry stays.
    L = np.array([[2 * np.e, 0], [1, 3]])
    np.testing.assert_allclose(moved["Q"], L @ L.T, rtol=1e-14)
    np.testing.assert_array_equal(moved["R"], [[1.0]])
    np.testing.assert_array_equal(moved["r"], [1, 3, 3])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Parameter(1.0, "log"), r"domain.*'log'"),
        (lambda: Parameter(np.nan), "value"),
        (lambda: Parameter([1.0, 0.0], "positive"), "value.*not positive"),
        (lambda: Parameter([[1.0, 2.0], [2.0, 1.0]], "definite"), "positive definite"),
        (lambda: Parameter([[1.0, 0.5], [0.5, 1.0]], "diagonal"), "value.*not diagonal"),
        (lambda: Parameter(np.ones((2, 3)), "definite"), r"value.*\(2, 3\)"),
        (lambda: Parameter(1.0, "interval"), "lower, upper"),
        (lambda: Parameter(1.0, "interval", lower=0.0, upper=1.0), "inside the interval"),
        (lambda: Parameter(1.0, "interval", lower=0.0, upper=np.inf), "upper.*infinity"),
        (lambda: Parameter(1.0, "interval", lower=[0.0, 0.0], upper=2.0), "lower.*shape"),
        (lambda: Parameter(1.0, lower=0.0, upper=1.0), "interval"),
        (lambda: Parameter([1.0, 2.0], train=[True]), "train"),
        (lambda: require_parameters({}), "parameters"),
        (lambda: require_parameters({"Q": np.eye(2)}), r"parameters\['Q'\].*ndarray"),
        (lambda: require_parameters({"r": Parameter(1.0, train=False)}), "none is trained"),
    ],
)
def test_bad_parameters(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("theta", [-1e6, -100.0, 100.0, 1e6])
def test_parameters_stay_in_their_domains(dtype, theta):
    """However far a step goes: the value can be the start of the next search."""
    with jax.enable_x64(dtype == np.float64):
        for parameter in (
            Parameter(0.5, "interval", lower=0.1, upper=0.7),
            Parameter(0.5, "interval", lower=0.0, upper=1.0),
            Parameter(-0.5, "interval", lower=-1.0, upper=0.0),
            Parameter(0.5, "positive"),
            Parameter(np.diag([0.5, 2.0]), "diagonal"),
            Parameter(np.diag([0.5, 2.0]), "definite"),
        ):
            raw = np.where(np.arange(parameter.raw().size) == 0, theta, parameter.raw())
            value = np.asarray(parameter.at(jnp.asarray(raw, dtype)), np.float64)
            again = dataclasses.replace(parameter, value=value)
            assert np.isfinite(again.raw()).all()
            slope = jax.jacfwd(parameter.at)(jnp.asarray(raw, dtype))
            assert np.isfinite(slope).all()
