"""jaxmpc simulate: files, table and picture say what the states in the store say."""

import base64
import io
import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest
import xarray as xr
from command_line import error_of, help_page, rows
from PIL import Image

import jaxmpc as jm
from jaxmpc.app import cli
from jaxmpc.app.commands import simulate
from jaxmpc.app.plots import plot_runs
from jaxmpc.app.plots.closed_loops import PLANS
from jaxmpc.closed_loop import stored_runs
from jaxmpc.closed_loop.outcome import evaluate_runs
from jaxmpc.closed_loop.variations import draw_robots
from jaxmpc.qp.status import Status
from jaxmpc.robots.film import Film, exceeded_limits, render, save_video
from jaxmpc.robots.load import load_robot

# Models at the set-point compile in half the time.
LINE = (
    "--robot joint --count 6 --chunk 4 --seconds 0.4 --spread 0.9 --horizon 10 --mass 0.2 "
    "--linearize set-point"
)


@pytest.fixture(scope="module")
def joint():
    """One robot for all commands: another would compile again."""
    return jm.load_robot("joint")


@pytest.fixture(scope="module")
def mpc(joint):
    """The problem of `LINE`, from the joint's linear model (compiled nowhere)."""
    system = jm.LinearSystem([[1, 0.01], [0, 1]], [[0.002], [0.2]], dt=0.01)
    plant = jm.LinearPlant(system, joint.state_limits, joint.input_limits)
    return jm.robot_mpc(plant, [1 / 1.5**2, 0.01 / 2**2], [0.01 / 2**2], 10)


@pytest.fixture(autouse=True)
def _prepared(in_empty_folder, monkeypatch, joint):
    given = lambda name: joint if name.endswith("joint") else jm.load_robot(name)
    monkeypatch.setattr(simulate, "load_robot", given)


def run(line):
    return cli.main(["simulate", *shlex.split(line)])


def no_renderer(*args, **kwargs):
    raise mujoco.FatalError("an OpenGL platform library has not been loaded")


@pytest.mark.slow
def test_interrupted_resumed_and_judged(tmp_path, monkeypatch, capsys, mpc):
    """Ctrl-C in the second chunk loses that chunk only; the table is that of the states."""
    real, asked = stored_runs.simulate_many, []

    def default(robot, *, horizon, target, margin):  # no weights, which no option gives
        assert (horizon, target, margin) == (mpc.horizon, None, 0.02)
        return mpc

    def interrupted(*args, **kwargs):
        asked.append(args[2])
        if len(asked) == 2:
            raise KeyboardInterrupt
        return real(*args, **kwargs)

    monkeypatch.setattr(simulate, "robot_mpc", default)
    monkeypatch.setattr(stored_runs, "simulate_many", interrupted)
    assert run(f"{LINE} --output 'my runs'") == 130
    out = capsys.readouterr().out
    assert f"jaxmpc simulate {LINE} --output 'my runs' --resume" in out
    folder = tmp_path / "my runs"
    first = xr.open_zarr(folder / "runs.zarr").load()
    assert np.isfinite(first["states"][:3]).all() and np.isnan(first["states"][3:]).all()
    assert not (folder / "summary.json").exists()

    assert run(f"{LINE} --output 'my runs' --resume --seed 1") == 2
    assert "seed: 0 there, 1 here" in capsys.readouterr().err
    monkeypatch.setattr(mujoco, "Renderer", no_renderer)
    assert run(f"{LINE} --output 'my runs' --resume") == 0
    captured = capsys.readouterr()
    assert len(asked) == 3, "the first chunk ran again"
    assert "no video: MuJoCo finds no renderer" in captured.err and "libegl1" in captured.err
    assert {p.name for p in folder.iterdir()} == {"runs.zarr", "runs.png", "summary.json"}

    data = xr.open_zarr(folder / "runs.zarr").load()
    np.testing.assert_array_equal(data["states"][:3], first["states"][:3])
    x, u = (data[name].values.astype(float) for name in ("states", "inputs"))
    assert x.shape == (6, 41, 2) and u.shape == (6, 40, 1)
    np.testing.assert_allclose(x[:, 0], data["points"], atol=1e-6)
    # The plant's law by hand: J = 0.05 kg m² times the factor of the body, h = 0.01 s.
    factor = data["mass"].values[:, 1]
    assert np.all(np.abs(factor - 1) <= 0.2) and np.ptp(factor) > 0.05
    dq = x[:, :-1, 1] + 0.01 * u[:, :, 0] / (0.05 * factor[:, None])
    np.testing.assert_allclose(x[:, 1:, 1], dq, atol=1e-5)
    np.testing.assert_allclose(x[:, 1:, 0], x[:, :-1, 0] + 0.01 * dq, atol=1e-5)

    # The joint's limits are 1.5 rad, 2 rad/s, 2 N m; the band is 2 % of them.
    kept = (np.abs(x) <= [1.5 + 1.5e-6, 2 + 2e-6]).all(axis=(1, 2)) & (np.abs(u) <= 2 + 2e-6).all(
        axis=(1, 2)
    )
    near = (np.abs(x) <= [0.03, 0.04]).all(axis=2)
    settled = [0.01 * (np.flatnonzero(~row).max(initial=-1) + 1) for row in near]
    settled = np.sort(np.where(near[:, -1], settled, np.inf))
    summary = json.loads((folder / "summary.json").read_text())
    assert 0 < near[:, -1].sum() < 6, "the test should see both"
    assert (summary["success"], summary["limits_kept"]) == ((kept & near[:, -1]).sum(), kept.sum())
    median, last = (None if np.isinf(v) else pytest.approx(v) for v in settled[[3, 5]])
    assert summary["settling"] == {"median": median, "95 %": last}
    solved, fallback = (data["status"] == 1).values, data["fallback"].values
    assert summary["plans_solved"] == solved.sum()
    assert summary["fallback_plans"] == (fallback & solved).sum()
    assert summary["unsolved_plans"] == (~solved).sum()
    assert summary["plans_valid"] == (solved & ~fallback).all(axis=1).sum()
    cost = np.sum((x[:, :-1] ** 2) @ [1 / 1.5**2, 0.01 / 4] + 0.01 / 4 * u[:, :, 0] ** 2, axis=1)
    assert summary["cost"]["median"] == pytest.approx(np.sort(cost)[3], rel=1e-4)
    assert summary["this_run"]["count"] == 3 and summary["config"]["horizon"] == 10
    table = rows(captured.out)
    assert table["success"].startswith(f"{summary['success']}  ")
    assert table["limits kept"].startswith(f"{kept.sum()}  ")
    assert f"of {solved.size}" in table["plans solved"]
    assert table["fallback"].startswith(f"{(fallback & solved).sum()}  ")
    assert table["unsolved"].startswith(f"{(~solved).sum()}  ")
    assert "real time" in table and "MPC solves/s" in table["run"]

    again = run(f"{LINE} --output 'my runs' --resume --video 0")  # nothing is left to do
    assert again == 0 and len(asked) == 3 and "run" not in rows(capsys.readouterr().out)
    same = LINE.replace("--robot joint", "--robot ./joint")  # the same model, asked for otherwise
    assert run(f"{same} --output 'my runs' --resume --video 0") == 0 and len(asked) == 3
    assert run(f"{LINE} --output 'my runs'") == 2
    assert "--overwrite" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        "--robot arm2 --dtype float64 --damping 0.5 --payload 0.5",
        "--robot cartpole --linearize lqr --spread 0.05",
        "--robot pendulum --linearize trajectory",
    ],
)
def test_other_robots_and_laws(tmp_path, capsys, arguments):
    assert run(f"{arguments} --count 3 --seconds 0.1 --output out --video 0") == 0
    table = rows(capsys.readouterr().out)
    data = xr.open_zarr(tmp_path / "out" / "runs.zarr").load()
    assert np.isfinite(data["states"]).all()
    if "lqr" in arguments:
        assert "plans solved" not in table and "control steps/s" in table["run"]
        assert np.all(data["status"] == 0)
    else:
        assert np.mean(data["status"].values == 1) > 0.5 and "fallback" in table
    if "float64" in arguments:
        assert data["states"].dtype == np.float64 and data["damping"].shape == (3, 2)
        assert np.all((data["payload"] >= 0) & (data["payload"] <= 0.5))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--robot arm9", "'arm9' is no file"),
        ("--count -3", "--count: -3"),
        ("--seconds nan", "--seconds"),
        ("--state-weights 1 2 3", "--state-weights: has 3 numbers. joint needs 2"),
        ("--input-weights 1 1", "--input-weights: has 2 numbers. joint needs 1"),
        ("--target 0 1", "--target: has 2 numbers. joint needs 1"),
        ("--mass 1.5", "--mass: 1.5"),
        ("--spread 2", "--spread: 2"),
        ("--resume --overwrite", "Choose one"),
    ],
)
def test_errors_are_one_line_before_any_compile(tmp_path, capsys, monkeypatch, arguments, message):
    monkeypatch.setattr(stored_runs, "simulate_many", lambda *a, **k: pytest.fail("it started"))
    assert message in error_of(f"simulate {arguments}", capsys)
    assert not (tmp_path / "jaxmpc-simulate" / "runs.zarr").exists()


def test_help_is_a_page_a_stranger_can_use(capsys):
    options = """robot count seconds target spread seed linearize horizon state-weights
        input-weights margin rho iterations newton-steps mass damping payload tolerance dtype chunk
        devices video output resume overwrite"""
    text = help_page("simulate", capsys, options)
    assert text.count("(default:") >= 24 and text.count("$ jaxmpc simulate") == 2
    for word in ("success", "limits kept", "runs.png", "robots.gif", "summary.json", "130"):
        assert word in text


def by_hand(states, inputs, **fields):
    """A Run with these states and inputs, all plans solved."""
    count, samples = inputs.shape[:2]
    zeros = np.zeros((count, samples))
    given = {
        "cost": zeros,
        "status": np.ones((count, samples), np.int32),
        "stage_cost": zeros + 1.0,
        "violation": np.zeros((count, samples + 1)),
        "slack": np.zeros((count, samples, 0)),
        "fallback": np.zeros((count, samples), bool),
        **fields,
    }
    return jm.closed_loop.Run(states=states, inputs=inputs, **given)


def test_outcome_and_picture_of_runs_made_by_hand(joint):
    """Four runs to q = 1: good, over a velocity limit, off target, not finite."""
    t = np.linspace(0, 1, 11)
    q, dq = np.minimum(2 * t, 1.0), np.zeros(11)
    x = np.stack([np.stack([q, dq], axis=1)] * 4)
    x[1, 3, 1], x[2, -1, 0], x[3, 5, 0] = -2.00001, 0.5, np.nan
    u = np.zeros((4, 10, 1))
    fallback, status = np.zeros((4, 10), bool), np.ones((4, 10), int)
    fallback[1, 2], status[2, 6:8] = True, Status.ITERATION_LIMIT
    fallback[2, 6] = True  # of a plan that is not solved: says nothing
    run = by_hand(x, u, fallback=fallback, status=status)
    outcome = evaluate_runs(run, joint, np.array([1.0, 0.0]))
    assert list(outcome.kept) == [True, False, True, False]
    assert list(outcome.reached) == [True, True, False, True]
    assert list(outcome.success) == [True, False, False, False]
    assert list(outcome.plans_valid) == [True, False, False, True]
    # q = 0.8 at sample 4, 1 from sample 5 on: 0.05 s.
    np.testing.assert_allclose(outcome.settling, [0.05, 0.05, np.inf, 0.06])
    np.testing.assert_allclose(outcome.cost, 10.0)
    np.testing.assert_allclose(outcome.state_excess[1, 3], [0, 1e-5], atol=1e-12)
    # Within 1e-6 of the limit it counts as kept.
    nearly = by_hand(np.where(x == -2.00001, -2.000001, x), u)
    assert evaluate_runs(nearly, joint, [1.0, 0.0]).kept[1]

    figure = plot_runs(run, joint, reference=np.array([1.0, 0.0]), robots=[0, 1, 2])
    labels = [(ax.get_title(), ax.get_ylabel()) for ax in figure.axes if ax.axison]
    assert labels == [("position", "q [rad]"), ("velocity", "q [rad/s]"), ("input", "tau [N m]")]
    assert figure.get_suptitle() == (
        "joint: 4 closed loops of 0.1 s, 3 shown. Limits kept by 2 of 4\n"
        "40 plans: 37 within all limits, 1 need slack (fallback), 2 not solved"
    )
    colours = {name: colour for name, (colour, _) in PLANS.items()}
    (slack,), (open_,) = (
        [
            line
            for line in figure.axes[0].lines
            if line.get_color() == colours[name] and np.isfinite(line.get_ydata()).any()
        ]
        for name in ("fallback", "unsolved")
    )
    for line, first, last in ((slack, 2, 3), (open_, 6, 8)):
        np.testing.assert_array_equal(
            np.flatnonzero(np.isfinite(line.get_ydata()))[[0, -1]], [first, last]
        )
    (red,) = (line for line in figure.axes[1].lines if len(line.get_xdata()) == 1)
    np.testing.assert_allclose(red.get_xydata(), [[0.03, -2.00001]])
    low, high = figure.axes[1].get_ylim()
    assert low < -2 < 2 < high
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [
        "one robot",
        "beyond the limits",
        "set-point",
        "its plan needs slack (fallback)",
        "its plan was not solved",
        "limit exceeded",
    ]
    feedback = by_hand(x[:1], u[:1], status=np.zeros((1, 10), int))  # a law without plans
    assert "a law without plans" in plot_runs(feedback, joint).get_suptitle()
    with pytest.raises(ValueError, match="robots: .*from 0 to 3"):
        plot_runs(run, joint, robots=[4])


@pytest.mark.slow
def test_runs_with_orientations_and_of_linear_plants(tmp_path):
    """A quadrotor has 13 numbers in its state, 12 coordinates and 4 inputs: 16 panels."""
    robot = jm.load_robot("quadrotor")
    x = np.broadcast_to(robot.home, (3, 13)).copy()
    x[-1, 3:7] = [np.cos(0.1), 0, np.sin(0.1), 0]  # 0.2 rad about y
    run = by_hand(x[None], np.full((1, 2, 4), 0.05))
    outcome = evaluate_runs(run, robot, np.asarray(robot.coordinates(robot.home)))
    np.testing.assert_allclose(outcome.coordinates[0, -1, 3:6], [0, 0.2, 0], atol=1e-9)
    assert outcome.kept[0] and not outcome.reached[0]
    figure = plot_runs(run, robot)
    assert sum(ax.axison for ax in figure.axes) == 16
    figure.savefig(tmp_path / "runs.png")

    system = jm.LinearSystem(np.eye(3), np.ones((3, 2)), dt=0.1, state_names=("a", "b", "c"))
    box = lambda size: jm.Box(-np.ones(size), np.ones(size))
    plant = jm.LinearPlant(system, box(3), box(2))
    run = by_hand(np.zeros((1, 6, 3)), np.zeros((1, 5, 2)))
    run = jax.tree.map(lambda v: v[0], run)  # without a batch axis
    figure = plot_runs(run, plant)
    assert [ax.get_ylabel() for ax in figure.axes if ax.axison] == ["a", "b", "c", "u1", "u2"]


FILM = """
import sys
import numpy as np
from jaxmpc.app.commands.simulate import choose_renderer
choose_renderer()
import jaxmpc as jm
from jaxmpc.closed_loop.outcome import evaluate_runs
from jaxmpc.robots.load import load_robot
from jaxmpc.robots.film import render, save_video
q = np.linspace(0, 1.2, 9)
states = np.zeros((3, 9, 2))
states[0, :, 0], states[1, :, 0] = q, -q
robot, size = jm.load_robot("joint"), dict(every=2, width=160, height=120)
try:
    frames = render(robot, states, labels=False, **size)
except RuntimeError as error:
    print(error, file=sys.stderr)
    sys.exit(3)
states[1, 3, 1] = -2.1  # beyond 2 rad/s
inputs = np.zeros((3, 8, 1))
inputs[2, 5] = 2.1  # beyond 2 N m
words = render(robot, states, inputs=inputs, target=[1.2], numbers=[4, 7, 9], **size)
still = render(robot, states[0], target=[[0.0]] * 8 + [[1.2]], labels=False, **size)
save_video("film.gif", words, 25)
np.savez("frames.npz", frames=frames, words=words, still=still)
"""


@pytest.mark.slow
def test_film_shows_the_motion(tmp_path):
    """Three joints turn left, right and not at all: so do the red tools in their tiles. In a
    process of its own, since MuJoCo chooses its renderer when it is imported."""
    paths = {**os.environ, "PYTHONPATH": str(Path(jm.__file__).parents[1])}
    command = [sys.executable, "-c", FILM]
    done = subprocess.run(command, capture_output=True, text=True, env=paths)
    if done.returncode == 3:
        pytest.skip(done.stderr.splitlines()[-1])
    assert done.returncode == 0, done.stderr
    data = np.load(tmp_path / "frames.npz")
    frames, words = data["frames"], data["words"].astype(int)
    assert frames.shape == (5, 240, 320, 3) and frames.dtype == np.uint8
    assert (frames[:, 125:, 165:] == 255).all(), "no fourth robot"

    def tool(frame):
        """(right, up) of the red pixels, from the middle of a tile."""
        colour = frame.astype(int)
        red = (colour[..., 0] > 1.6 * colour[..., 1]) & (colour[..., 0] > 2.2 * colour[..., 2])
        red &= colour[..., 1] < 1.3 * colour[..., 2]  # not the orange hub
        y, x = np.nonzero(red)
        assert len(x) > 3
        return x.mean() - 80, 60 - y.mean()

    for top, left, sign in ((0, 0, 1), (0, 160, -1), (120, 0, 0)):
        tiles = frames[:, top : top + 120, left : left + 160]
        (x0, y0), (x1, y1) = tool(tiles[0]), tool(tiles[-1])
        assert x0 > 20, "at q = 0 the tool is to the right"
        assert np.sign(round((y1 - y0) / 10)) == sign and (x0 - x1 > 10) == bool(sign)

    # With words: a line above, the legend below, between them the same robots and the target's.
    line, foot = 20, 40
    assert words.shape == (5, 240 + line + foot, 320, 3)
    inner = words[:, line:-foot]
    green = lambda film: ((film[..., 1] > film[..., 0] + 30) & (film[..., 1] > film[..., 2])).sum()
    assert green(frames.astype(int)) == 0, "no target asked for"
    for top, left in ((0, 0), (0, 160), (120, 0)):
        assert green(inner[0, top : top + 120, left : left + 160]) > 50
    moving = data["still"].astype(int)
    there, away = green(moving[0]), green(moving[2])
    assert 0 < there < away and away > 50, "seen around the robot, and moves away at the end"
    red = (inner[..., 0] > 180) & (inner[..., 1:] < 60).all(axis=-1)
    edge = {
        (top, left): red[:, top + 1, left + 30 : left + 130].all(axis=1)
        for top, left in ((0, 0), (0, 160), (120, 0))
    }
    np.testing.assert_array_equal(edge[0, 0], [0, 0, 0, 0, 0])
    np.testing.assert_array_equal(edge[0, 160], [0, 1, 0, 0, 0])  # sample 3, between two frames
    np.testing.assert_array_equal(edge[120, 0], [0, 0, 1, 0, 0])  # sample 5
    dark = (words < 90).all(axis=-1)
    assert dark[:, :line, :60].any(axis=(1, 2)).all(), "the robot's name"
    clock = words[:, :line, 260:]
    assert dark[:, :line, 260:].any(axis=(1, 2)).all() and np.any(clock[0] != clock[1])
    assert np.array_equal(words[0, :line, :200], words[1, :line, :200])
    assert dark[:, -foot:].any(axis=(1, 2)).all(), "the legend"
    with Image.open(tmp_path / "film.gif") as film:
        assert film.n_frames == 5 and film.size == (320, 300) and film.info["duration"] == 40
        film.seek(1)
        assert np.asarray(film.convert("RGB"))[line + 1, 200] == pytest.approx([200, 20, 20], abs=9)


def test_notebooks_play_a_film():
    """The HTML holds a GIF of these frames, whatever else lies in the folder."""
    frames = np.zeros((3, 6, 8, 3), np.uint8)
    frames[1, :, 4:] = [0, 158, 115]
    html = Film(frames, 20)._repr_html_()
    (data,) = re.findall(r'^<img src="data:image/gif;base64,([^"]+)" alt="3 frames">$', html)
    with Image.open(io.BytesIO(base64.b64decode(data))) as film:
        assert film.n_frames == 3 and film.info["duration"] == 50
        film.seek(1)
        np.testing.assert_array_equal(np.asarray(film.convert("RGB")), frames[1])


def test_film_names_the_limit_exceeded_most(joint):
    """From a frame to the next, relative to half the range: 1.5 rad, 2 rad/s, 2 N m."""
    states, inputs = np.zeros((2, 7, 2)), np.zeros((2, 6, 1))
    states[0, 3] = [1.6, 2.2]  # 7 % and 10 %
    states[1, 6, 0], inputs[1, 0] = -1.5 - 1e-7, 2.5
    found = exceeded_limits(joint, states, inputs, 2)
    assert found.tolist() == [["", "q velocity [rad/s]", "", ""], ["tau [N m]", "", "", ""]]
    assert exceeded_limits(joint, states[1:], None, 2).tolist() == [[""] * 4]


def test_film_refuses_what_it_cannot_draw(tmp_path, monkeypatch, joint):
    for states, options, message in (
        (np.zeros((3, 3)), {}, "states: shape"),
        (np.full((3, 2), np.nan), {}, "states: holds NaN"),
        (joint, {}, "states: .* where real numbers are needed"),
        (np.zeros((3, 2)), {"every": 0}, "every: 0"),
        (np.zeros((3, 2)), {"camera": "left"}, "none named 'left'"),
        (np.zeros((3, 2)), {"inputs": np.zeros((3, 1))}, r"inputs: shape \(3, 1\)"),
        (np.zeros((3, 2)), {"target": [0.0, 1.0]}, r"target: shape \(2,\)"),
        (np.zeros((3, 2)), {"target": [np.nan]}, "target: holds NaN"),
        (np.zeros((3, 2)), {"numbers": [1, 2]}, "numbers: 2 of 1 robots"),
    ):
        with pytest.raises(ValueError, match=message):
            render(joint, states, **options)
    monkeypatch.setattr(mujoco, "Renderer", no_renderer)
    with pytest.raises(RuntimeError, match=r"MUJOCO_GL=egl.*MuJoCo says: .*\w$"):
        render(joint, np.zeros((3, 2)))
    frames = np.zeros((2, 4, 4, 3), np.uint8)
    for name, given, message in (
        ("a.avi", frames, "'.avi' is no video"),
        ("a.gif", frames.astype(float), "frames: shape .* float64"),
    ):
        with pytest.raises(ValueError, match=message):
            save_video(tmp_path / name, given, 25)
    with pytest.raises(ValueError, match="fps: 0"):
        Film(frames, 0)
    with pytest.raises(ValueError, match="path: is an ndarray. Give the path first"):
        save_video(frames, "a.gif", 25)
    monkeypatch.setitem(sys.modules, "imageio", None)
    monkeypatch.setitem(sys.modules, "imageio.v3", None)
    with pytest.raises(ValueError, match=r"imageio\[ffmpeg\]"):
        save_video(tmp_path / "a.mp4", frames, 25)


def test_numbers_of_a_robot_do_not_depend_on_how_many_there_are():
    """Nor, then, on how they are split into blocks, or resumed."""
    robot, settings = load_robot("joint"), dict(spread=0.5, mass=0.1, damping=0.2, payload=1.0)
    few, many = (draw_robots(robot, count, 3, **settings) for count in (5, 40))
    np.testing.assert_array_equal(few[0], many[0][:5])
    assert few[1].keys() == many[1].keys() == {"mass", "damping", "payload"}
    for name, value in few[1].items():
        np.testing.assert_array_equal(value, many[1][name][:5])


@pytest.mark.parametrize("dt", [0.001, 0.002, 0.004, 0.01, 0.0125, 0.015, 0.025, 0.03, 0.2])
def test_gifs_last_as_long_as_the_motion(dt, tmp_path):
    """Viewers take frames of less than 20 ms for such of 100."""
    frames = np.arange(40, dtype=np.uint8)[:, None, None, None] * np.full((1, 4, 5, 3), 6, np.uint8)
    save_video(tmp_path / "film.gif", frames, 1 / dt)
    with Image.open(tmp_path / "film.gif") as film:
        times = [(film.seek(k), film.info["duration"])[1] for k in range(film.n_frames)]
    assert min(times) >= 20 and sum(times) == pytest.approx(1000 * 40 * dt, abs=5.1)


def test_gifs_have_no_frames_of_hours(tmp_path):
    with pytest.raises(ValueError, match="fps: 0.001. Give at least 0.0015"):
        save_video(tmp_path / "film.gif", np.zeros((2, 4, 5, 3), np.uint8), 0.001)


UNSEEN = """
import sys
import numpy as np
from jaxmpc.app.commands.simulate import choose_renderer
choose_renderer()
import mujoco
import jaxmpc as jm
FILE = '''<mujoco><visual><global %s/></visual><worldbody><body><joint name="q" type="slide"
axis="1 0 0"/><geom %s size="0.1" rgba="0 1 0 %s" mass="1"/></body></worldbody>
<actuator><motor joint="q" ctrlrange="-1 1"/></actuator></mujoco>'''
t = 0.01 * np.arange(100)
for option, shape, alpha, motion in (
    ("", 'group="3"', 1, t),
    ("", "", 0, t),
    ('orthographic="true" fovy="2"', "", 1, t),
    ("", "", 1, 0.5 * np.sin(2 * np.pi * 20 * t + 1)),  # every fifth sample is the same
    ("", "", 1, np.where(t > 0.955, 90 * (t - 0.955), 0.0)),
):
    robot = jm.load_robot(mujoco.MjModel.from_xml_string(FILE % (option, shape, alpha)))
    states = np.column_stack([motion, 0 * motion])
    try:
        frames = jm.robots.render(robot, states, labels=False, width=80, height=60).astype(int)
    except RuntimeError as error:
        print(error, file=sys.stderr)
        sys.exit(3)
    print(int((frames[..., 1] > frames[..., 0] + 40).sum(axis=(1, 2)).min()))
"""


@pytest.mark.slow
def test_films_show_the_robot_in_every_frame():
    """Shapes for collisions alone, transparent ones, orthographic views, and motions that are fast
    beside the film's frames."""
    paths = {**os.environ, "PYTHONPATH": str(Path(jm.__file__).parents[1])}
    done = subprocess.run([sys.executable, "-c", UNSEEN], capture_output=True, text=True, env=paths)
    if done.returncode == 3:
        pytest.skip(done.stderr.splitlines()[-1])
    assert done.returncode == 0, done.stderr
    least = [int(line) for line in done.stdout.split()]
    assert len(least) == 5 and min(least) >= 5, least
