"""Robot runs in a store, from Python: what the command `jaxmpc simulate` calls."""

import copy
import dataclasses
import json
from functools import partial

import jax
import numpy as np
import pytest
import xarray as xr

import jaxmpc as jm
from jaxmpc.closed_loop import (
    LinearFeedback,
    draw_robots,
    simulate_into,
    simulate_many,
    stored_runs,
    summarise_runs,
)
from jaxmpc.closed_loop.stored_runs import plain_data
from jaxmpc.closed_loop.variations import plant_numbers
from jaxmpc.mpc import Task
from jaxmpc.robots.physics import Physics

STEPS = 400


@pytest.fixture(scope="module")
def joint():
    return jm.load_robot("joint")


@pytest.fixture(scope="module")
def feedback(joint):
    """A law without plans, which compiles in a moment."""
    system = jm.LinearSystem([[1, 0.01], [0, 1]], [[0.002], [0.2]], dt=0.01)
    plant = jm.LinearPlant(system, joint.state_limits, joint.input_limits)
    return LinearFeedback(jm.robot_mpc(plant, horizon=5), np.array([[-4.0, -2.0]]), joint)


@pytest.mark.long
def test_runs_are_stored_resumed_and_those_of_simulate_many(tmp_path, monkeypatch, joint, feedback):
    """Six robots in blocks of three: the second block is done by the second call."""
    x0s, factors = draw_robots(joint, 6, seed=3, mass=0.2)
    path, options = tmp_path / "runs.zarr", {"factors": factors, "chunk": 4}
    real, asked = stored_runs.simulate_many, []

    def interrupted(*args, **kwargs):
        asked.append(len(args[2]))
        if len(asked) == 2:
            raise KeyboardInterrupt
        return real(*args, **kwargs)

    monkeypatch.setattr(stored_runs, "simulate_many", interrupted)
    with pytest.raises(KeyboardInterrupt):
        simulate_into(path, feedback, joint, x0s, STEPS, **options)
    monkeypatch.setattr(stored_runs, "simulate_many", real)
    with pytest.raises(ValueError, match="exists"):
        simulate_into(path, feedback, joint, x0s, STEPS, **options)
    with pytest.raises(ValueError, match="steps: 400 there, 399 here"):
        simulate_into(path, feedback, joint, x0s, STEPS - 1, resume=True, **options)
    other = LinearFeedback(feedback.mpc, 2 * feedback.K, joint)
    with pytest.raises(ValueError, match="data: "):
        simulate_into(path, other, joint, x0s, STEPS, resume=True, **options)

    heavy = joint.vary(body_mass=2 * joint.file.body_mass)
    slow = jm.load_robot("joint", control_period=0.02)
    for plant in (heavy, slow):
        with pytest.raises(ValueError, match="plant: "):
            simulate_into(path, feedback, plant, x0s, STEPS, resume=True, **options)

    begun = []
    found = simulate_into(
        path, feedback, joint, x0s, STEPS, resume=True, begun=lambda: begun.append(1), **options
    )
    assert found.timing.count == 3 and begun == [1] and "StoredRuns(" in repr(found)
    numbers = plant_numbers(joint, factors)
    run = simulate_many(feedback, joint, x0s, STEPS, variations=numbers, chunk=3)
    np.testing.assert_array_equal(found.run.states, run.states)
    data = xr.open_zarr(path).load()
    np.testing.assert_array_equal(data["states"], run.states)
    np.testing.assert_array_equal(data["points"], x0s)
    np.testing.assert_array_equal(data["mass"], factors["mass"])
    options["factors"] = {name: v[:3] for name, v in factors.items()}
    again = simulate_into(path, feedback, joint, x0s[:3], STEPS, overwrite=True, **options)
    assert again.run.states.shape == (3, STEPS + 1, 2) and again.timing.count == 3


def test_functions_are_told_apart_by_what_they_do(joint, feedback):
    """Tasks and models of controllers: a store of others would be gone on with."""

    def measured(i, scale=1.0, weights=(1.0, 2.0)):
        held = np.array(weights)
        return lambda d: scale * held[i] * d.site_xpos[0, i : i + 1]

    class Tilted:
        def __init__(self, by):
            self.by, self._cache = by, object()

        def value(self, d):
            return self.by * d.xpos[0]

    def of_module(aim):
        """A function of a script in which AIM is this."""
        exec("def value(d):\n    return (lambda v: v - AIM)(d.xpos[0])", names := {"AIM": aim})
        return names["value"]

    def again(n):
        return again(n - 1) if n else 0.0

    alike = [
        lambda: measured(0), lambda: partial(measured(0), 1.0), lambda: jax.jit(measured(0)),
        lambda: Tilted(1.0).value, lambda: of_module(1.0), lambda: again, lambda: {"k": joint},
    ]  # fmt: skip
    for made in alike:
        assert plain_data(made()) == plain_data(made())
    others = [
        measured(0), measured(1), measured(0, 2.0), measured(0, weights=(1.0, 3.0)),
        partial(measured(0), 1.0), partial(measured(0), 2.0), partial(measured(0), d=1.0),
        partial(measured(0), np.ones(2)), partial(measured(0), np.zeros(2)),
        lambda d: d.xpos[0], lambda d: d.xpos[1], lambda d, k=2: d.xpos[k],
        lambda d, k=3: d.xpos[k], lambda d: d.site_xpos[0], lambda d: (lambda k: d.xpos[k])(1),
        lambda d: (lambda k: d.xpos[k])(2), Tilted(1.0).value, Tilted(2.0).value,
        of_module(1.0), of_module(2.0), of_module(np.ones(2)),
    ]  # fmt: skip
    seen = [json.dumps(plain_data(Task(function, weight=1.0))) for function in others]
    seen += [json.dumps(plain_data(held)) for held in ({1, 2}, {1, 3}, range(2), range(3), b"a")]
    assert len(set(seen)) == len(seen)


def test_models_are_told_apart_by_their_numbers(joint, feedback):
    """Those that predict have the names that they had after an edit of their file."""
    heavier = copy.copy(joint.mujoco)
    heavier.body_mass[:] *= 2
    one, other, same = (
        plain_data(jm.RobotController(robot, feedback.mpc, linearize="trajectory"))
        for robot in (joint, dataclasses.replace(joint, predictor=Physics(heavier)), joint)
    )
    assert one == same != other


def test_summary_says_what_the_states_say(joint, feedback):
    """Of runs that no store holds: without settings, and without the time they took."""
    x0s, factors = draw_robots(joint, 5, seed=1, mass=0.2)
    numbers = plant_numbers(joint, factors)
    run = simulate_many(feedback, joint, x0s, STEPS, variations=numbers, chunk=3)
    summary = summarise_runs(run, joint, np.zeros(2), np.zeros(1))
    outcome = jm.closed_loop.evaluate_runs(run, joint, np.zeros(2))
    assert summary.data["success"] == np.count_nonzero(outcome.success)
    assert summary.data["settling"]["median"] == np.sort(outcome.settling)[2]
    assert summary.data["plans"] == 0 and "config" not in summary.data
    names = [name for name, _ in summary.rows()]
    assert names == ["robots", "success", "limits kept", "worst", "settling", "cost"]
    assert str(summary).splitlines()[0].split()[:2] == ["robots", "5"]


def test_wrong_arguments_leave_no_store(tmp_path, joint, feedback):
    for x0s, factors, message in (
        (np.zeros(2), None, r"x0s: shape \(2,\)"),
        (np.zeros((2, 3)), None, r"x0s: shape \(2, 3\)"),
        (
            np.zeros((2, 2)),
            {"friction": np.ones((2, 1))},
            "friction: is a factor of dof_frictionloss, which is 0",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            simulate_into(tmp_path / "runs.zarr", feedback, joint, x0s, 3, factors=factors)
    start = np.zeros((2, 2))
    for steps in (0, 3.7, True, "3", np.nan, None):
        with pytest.raises(ValueError, match=f"steps: {steps!r}. Give a whole number"):
            simulate_into(tmp_path / "runs.zarr", feedback, joint, start, steps)
    with pytest.raises(ValueError, match=r"reference: shape \(3,\)"):
        simulate_into(tmp_path / "runs.zarr", feedback, joint, start, 3, reference=np.zeros(3))
    assert not any(tmp_path.iterdir())
