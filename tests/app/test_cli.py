"""The command: files and table when all is well, one line and an exit code when not."""

import gc
import io
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr
from command_line import error_of, help_page, run

from jaxmpc.app import cli
from jaxmpc.app import config as configs
from jaxmpc.app.commands import recursion
from jaxmpc.app.commands.verify import contradictions
from jaxmpc.feasible import pipeline, stored
from jaxmpc.feasible.pipeline import Labels
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.files import read_arrays, write_arrays
from jaxmpc.recursion.counterexamples import Counterexample, SampledLoops
from jaxmpc.recursion.proofs import Claim
from jaxmpc.recursion.report import RecursionReport, SmallestHorizon
from jaxmpc.sets.convex_sets import Box
from jaxmpc.store.writing import Lock

pytestmark = pytest.mark.usefixtures("in_empty_folder")


@pytest.fixture
def no_compile(monkeypatch):
    """Fail if the sweep starts: errors must be found before."""
    started = lambda *a, **k: pytest.fail("the sweep started")
    monkeypatch.setattr(pipeline, "label_parts", started)


def test_sweep_writes_files_and_table(tmp_path, capsys):
    assert run("sweep --grid 8 8 --horizon 6") == 0
    out = capsys.readouterr().out
    folder = tmp_path / "jaxmpc-sweep"
    assert {path.name for path in folder.iterdir()} == {"sweep.zarr", "map.png", "summary.json"}
    data = xr.open_zarr(folder / "sweep.zarr")
    assert data["label"].shape == (8, 8) and data["plan"].shape == (8, 8, 6, 1)
    assert data["label"].dims == ("q", "dq") and data["q"].attrs["units"] == "rad"
    summary = json.loads((folder / "summary.json").read_text())
    labels = data["label"].values
    feasible, infeasible = np.count_nonzero(labels == 1), np.count_nonzero(labels == -1)
    assert summary["counts"] == {
        "feasible": feasible,
        "infeasible": infeasible,
        "undecided": 64 - feasible - infeasible,
        "not finite": 0,
        "not run": 0,
    }
    assert summary["config"]["mpc"]["horizon"] == 6
    assert 0 < summary["volume"]["inner"] <= summary["volume"]["outer"] <= 12
    for word in ("feasible", "undecided", "area from", "rad·rad/s", "QPs/s", "map.png"):
        assert word in out
    # States beyond the limits |q| <= 1.5, |dq| <= 2 are never feasible.
    assert np.all(labels[np.abs(data["q"].values) > 1.5] == -1)
    assert np.all(labels[:, np.abs(data["dq"].values) > 2.0] == -1)
    assert run("verify jaxmpc-sweep --exact") == 0
    assert "64 of 64, 64 exactly" in capsys.readouterr().out


def test_damage_is_repaired_by_resume_and_found_by_verify(tmp_path, capsys):
    """Flipped labels are no longer printed as fact, nor a missing chunk as a smaller count."""
    line = "sweep --grid 8 8 --horizon 6"
    assert run(line) == 0
    path = tmp_path / "jaxmpc-sweep" / "sweep.zarr"
    summary = json.loads((path.parent / "summary.json").read_text())
    label = zarr.open_group(path, mode="r+", use_consolidated=False)["label"]
    label[3, 3:8] = -label[3, 3:8]
    assert run("verify jaxmpc-sweep") == 1
    out = capsys.readouterr().out
    assert "NOT VERIFIED" in out and "FAILS: block 0" in out
    assert "FAILS: state 27" in out and "FAILS: state 31" in out
    assert run(f"{line} --resume") == 0
    assert "1 of 1 block that was done is missing or damaged" in capsys.readouterr().err
    shutil.rmtree(path / "plan" / "c")
    assert run(f"{line} --resume") == 0
    again = json.loads((path.parent / "summary.json").read_text())
    assert again["counts"] == summary["counts"]
    assert run("verify jaxmpc-sweep") == 0
    (path / "zarr.json").write_text("{")
    assert run(f"{line} --resume") == 2
    assert "metadata cannot be read. Overwrite it" in capsys.readouterr().err
    assert run(f"{line} --overwrite") == 0


@pytest.mark.slow
def test_file_slice_and_overwrite(tmp_path, capsys):
    (tmp_path / "case.toml").write_text(
        """
        name = "two carts"
        [system]
        A = [[1, 0.1, 0], [0, 1, 0], [0, 0, 0.5]]
        B = [[0], [0.1], [1]]
        dt = 0.1
        state_names = ["p", "v", "w"]
        [limits]
        x_min = [-1, -1, -1]
        x_max = [1, 1, 1]
        u_min = [-1]
        u_max = [1]
        [cost]
        Q = [1, 1, 1]
        R = [1]
        [mpc]
        horizon = 4
        [sweep]
        grid = [6, 6]
        axes = ["p", "v"]
        projection = true
        """
    )
    assert run("sweep --config case.toml --fixed 0.25 --output out --no-refine") == 0
    assert "two carts" in capsys.readouterr().out
    assert run("sweep --config case.toml --fixed 0.5 --output out") == 2
    assert "--overwrite" in capsys.readouterr().err
    assert run("sweep --config case.toml --fixed 0.5 --output out --resume") == 2
    assert "sweep.fixed: [0.25] there, [0.5] here" in capsys.readouterr().err
    command = "sweep --config case.toml --axes 0 --grid 5 --fixed 0 0.5 --output out --overwrite"
    assert run(command) == 0
    out = capsys.readouterr().out
    assert (
        "length from" in out and "none: map.png shows two or three axes, and this map has 1" in out
    )


@pytest.fixture
def interruptible():
    """Shells start what runs in the background with SIGINT ignored, which children inherit."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_keeps_blocks_and_says_how_to_resume(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(stored, "CHUNK", 50)
    real = pipeline.label_parts

    def interrupted(*args, **kwargs):
        for k, chunk in enumerate(real(*args, **kwargs)):
            if k == 1:
                signal.raise_signal(signal.SIGINT)
            yield chunk

    monkeypatch.setattr(pipeline, "label_parts", interrupted)
    assert run("sweep --grid 8 8 --horizon 6 --output 'my maps'") == 130
    out = capsys.readouterr().out
    assert "jaxmpc sweep --grid 8 8 --horizon 6 --output 'my maps' --resume" in out
    assert "blocks that were done are kept" in out
    asked = []

    def counted(mpc, parts, *args, **kwargs):
        asked.append(list(parts))
        return real(mpc, asked[-1], *args, **kwargs)

    monkeypatch.setattr(pipeline, "label_parts", counted)
    resume = "sweep --grid 8 8 --horizon 6 --output 'my maps' --resume"
    assert run(resume) == 0
    data = xr.open_zarr(tmp_path / "my maps" / "sweep.zarr")
    points = np.stack(np.meshgrid(data["q"], data["dq"], indexing="ij"), axis=-1)
    np.testing.assert_array_equal(np.concatenate(asked[0]), points.reshape(-1, 2)[32:])
    assert np.all(data["status"] != 0)
    assert run(resume) == 0 and len(asked) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--horizon 0", "--horizon"),
        ("--grid 1 5", "--grid"),
        ("--grid 5", "command line: --grid: has 1 entries where 2"),
        ("--lower 1 0 --upper -1 0", "--lower: entry 0 is 1"),
        ("--lower nan 0 --upper 1 1", "--lower"),
        ("--axes q w", "no state 'w'. States are q, dq"),
        ("--axes q --grid 5", "sweep.fixed: 2 states, 1 mapped"),
        ("--config absent.toml", "absent.toml: cannot be read"),
        ("--output file/below", "file/below: Not a directory"),
        ("--output ''", "--output: no value. Give a path"),
        ("--output=", "--output: no value. Give a path"),
        ("--grid 5 5 ''", "--grid: no value. Give whole numbers"),
        ("--resume --overwrite", "Choose one"),
    ],
)
@pytest.mark.usefixtures("no_compile")
def test_errors_are_one_line_before_any_compile(tmp_path, capsys, arguments, message):
    (tmp_path / "file").touch()
    assert message in error_of(f"sweep {arguments}", capsys)


@pytest.mark.usefixtures("no_compile")
@pytest.mark.parametrize("arguments", ["", "sweep --grid 1.5 2", "sweep --horizont 3", "swep"])
def test_wrong_usage(arguments, capsys):
    error_of(arguments, capsys)


@pytest.mark.parametrize(
    ("line", "names"),
    [("", "init sweep recursion info simulate tune"), ("tune", "weights solver")],
)
def test_help_has_a_line_for_each_command(line, names, capsys):
    text = help_page(line, capsys)
    for name in names.split():
        assert f"• {name} " in text


def test_help_is_a_page_a_stranger_can_use(capsys):
    options = """config output horizon terminal grid lower upper axes fixed projection iterations
        dtype shard store resume overwrite no-refine"""
    text = help_page("sweep", capsys, options)
    assert text.count("(default:") >= 14
    assert text.count("$ jaxmpc sweep") == 2
    for section in ("[system]", "[limits]", "[cost]", "[mpc]", "[sweep]"):
        assert section in text
    for word in ("feasible", "undecided", "map.png", "summary.json", "sweep.zarr", "130"):
        assert word in text


def canned(mpc, x0s, **settings):
    """A report of the right shapes, without computing anything."""
    n = mpc.system.n
    x0s = np.zeros((7, n)) if x0s is None else x0s
    count = len(x0s)
    worst = Counterexample(
        state=x0s[0],
        inputs=np.ones((mpc.horizon, 1)),
        next_state=x0s[0] + 1.0,
        normal=np.eye(n)[0],
        offset=1.0,
        distance=0.25,
        feasible_inputs=np.ones((mpc.horizon, 1)),
        primal_residual=0.0,
        dual_residual=0.0,
        found="search",
    )
    refuted = Claim(False, "an example", x0s[0])
    labels = Labels.empty(count, FeasibilityProblem.of(mpc))
    return RecursionReport(
        mpc=mpc,
        strong=refuted,
        law=refuted,
        weak=Claim(None, "no facets"),
        counterexample=worst,
        feasible_set=Box(-np.ones(n), np.ones(n)).to_polytope(),
        volume=4.0,
        lost_by_any=np.nan,
        lost_by_law=0.5,
        seconds=1.0,
        loops=SampledLoops(
            x0s=x0s,
            labels=replace(labels, label=np.ones(count, np.int8)),
            inputs=np.zeros((count, 1)),
            next_states=x0s,
            lost_at=np.arange(count) % 3,
            undecided_at=np.zeros(count, int),
            steps=settings["steps"],
        ),
    )


@pytest.fixture
def examined(monkeypatch):
    """Calls of recursive_feasibility, which is replaced."""
    calls = []

    def record(mpc, x0s, **settings):
        calls.append((mpc, x0s, settings))
        return canned(mpc, x0s, **settings)

    monkeypatch.setattr(recursion, "recursive_feasibility", record)
    least = SmallestHorizon(5, 6, {5: Claim(True, "by regions")}, 8)
    monkeypatch.setattr(recursion, "smallest_horizon", lambda *a, **k: least)
    return calls


def test_recursion_writes_files_and_table(tmp_path, capsys, examined):
    line = "recursion --horizon 4 --grid 6 5 --steps 3 --regions 0 --seconds 9 --no-search"
    assert run(f"{line} --smallest 8") == 0
    mpc, x0s, settings = examined[0]
    assert (mpc.horizon, x0s.shape) == (4, (30, 2))
    # Half of the time is for --smallest.
    expected = {"steps": 3, "search": False, "max_regions": 0, "seconds": 4.5, "progress": True}
    assert settings == expected
    np.testing.assert_allclose(x0s[0], [-1.59, -2.12])  # limits and 3 %
    out = capsys.readouterr().out
    for word in (
        "strong",
        "refuted: an example",
        "open: no facets",
        "0.25",
        "lost, optimal input",
        "smallest horizon     5 (by regions); strong from 6",
    ):
        assert word in out
    folder = tmp_path / "jaxmpc-recursion"
    assert {path.name for path in folder.iterdir()} == set(recursion.FILES)
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["claims"]["law"] == {
        "holds": False,
        "reason": "an example",
        "state": x0s[0].tolist(),
    }
    assert summary["counterexample"]["distance"] == 0.25 and summary["lost_by_any"] is None
    assert summary["counts"]["lost after one step"] == 10
    assert summary["config"]["recursion"]["steps"] == 3 and "sweep" not in summary["config"]
    assert summary["smallest_horizon"]["reasons"]["5"]["holds"] is True
    with np.load(folder / "recursion.npz") as data:
        assert data["state"].shape == (30, 2) and data["facet_normals"].shape == (4, 2)
        np.testing.assert_array_equal(data["lost_at"], np.arange(30) % 3)
    assert run(line) == 2
    assert "exists. Overwrite it (overwrite=True, --overwrite)" in capsys.readouterr().err
    assert run(f"{line} --overwrite") == 0


def test_recursion_of_many_states_needs_no_slice(tmp_path, examined, capsys):
    text = """
        [system]
        A = [[1, 0.1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.1], [0, 0, 0, 1]]
        B = [[0, 0], [0.1, 0], [0, 0], [0, 0.1]]
        dt = 0.1
        [limits]
        x_min = [-1, -1, -1, -1]
        x_max = [1, 1, 1, 1]
        u_min = [-1, -1]
        u_max = [1, 1]
        [cost]
        Q = [1, 1, 1, 1]
        R = [1, 1]
        [mpc]
        horizon = 3
        terminal = "invariant"
        [recursion]
        steps = 7
    """
    (tmp_path / "four.toml").write_text(text)
    assert run("recursion --config four.toml --output out") == 0
    assert examined[0][1] is None and examined[0][2]["steps"] == 7
    assert {path.name for path in (tmp_path / "out").iterdir()} == set(recursion.FILES[:2])
    assert run("recursion --config four.toml --output two --grid 2 2 2 2 --steps 5") == 0
    assert examined[1][1].shape == (16, 4) and examined[1][2]["steps"] == 5
    assert run("sweep --config four.toml") == 2  # a sweep must be told what to do with the others
    assert "sweep.fixed" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--horizon 0", "--horizon"),
        ("--grid 5", "command line: --grid: has 1 entries where 2"),
        ("--grid 1 5", "--grid"),
        ("--lower 1 0 --upper -1 0", "--lower: entry 0 is 1"),
        ("--steps 0", "--steps"),
        ("--regions -1", "--regions"),
        ("--seconds 0", "--seconds"),
        ("--smallest 0", "--smallest"),
        ("--config absent.toml", "absent.toml: cannot be read"),
        ("--output file/below", "file/below: Not a directory"),
    ],
)
def test_recursion_errors_are_one_line(tmp_path, capsys, arguments, message, monkeypatch):
    forbidden = lambda *a, **k: pytest.fail("the work started")
    monkeypatch.setattr(recursion, "recursive_feasibility", forbidden)
    (tmp_path / "file").touch()
    assert message in error_of(f"recursion {arguments}", capsys)


def test_recursion_interrupted_and_refused(capsys, monkeypatch):
    def interrupt(*a, **k):
        raise KeyboardInterrupt

    monkeypatch.setattr(recursion, "recursive_feasibility", interrupt)
    assert run("recursion") == 130
    assert "stopped; nothing is kept" in capsys.readouterr().out

    def refuse(*a, **k):
        raise ValueError("x0s: None, and the feasible set is empty or flat. Give the states")

    monkeypatch.setattr(recursion, "recursive_feasibility", refuse)
    assert run("recursion") == 2
    assert "empty or flat" in capsys.readouterr().err


def test_recursion_help_is_a_page_a_stranger_can_use(capsys):
    options = """config output horizon terminal steps grid lower upper regions seconds no-search
        smallest overwrite"""
    text = help_page("recursion", capsys, options)
    assert text.count("(default:") >= 12 and text.count("$ jaxmpc recursion") == 2
    for word in (
        "strong",
        "weak",
        "lost_at",
        "summary.json",
        "recursion.png",
        "130",
        "[recursion]",
    ):
        assert word in text


@pytest.mark.slow
def test_recursion_of_the_joint_for_real(tmp_path, capsys):
    assert run("recursion --horizon 4 --terminal box --grid 32 32 --steps 4 --seconds 200") == 0
    summary = json.loads((tmp_path / "jaxmpc-recursion" / "summary.json").read_text())
    assert [summary["claims"][name]["holds"] for name in ("strong", "law", "weak")] == [False] * 3
    assert abs(summary["counterexample"]["distance"] - 0.0039968) < 1e-6
    assert abs(summary["lost_by_law"] - 0.0016) < 1e-9
    assert "at a vertex of a critical region" in capsys.readouterr().out


@pytest.mark.slow
def test_recursion_of_a_proved_law_draws_no_samples(tmp_path, capsys):
    assert run("recursion --horizon 6 --terminal box --smallest 1") == 0
    text = capsys.readouterr()
    assert "none: its law is proved" in text.out and "none up to 1" in text.out
    for stage in ("0.0 s  theorem and linear programs", "s  horizon 1"):
        assert stage in text.err
    assert (tmp_path / "jaxmpc-recursion" / "recursion.png").stat().st_size > 10_000


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize(
    ("options", "sign", "answer"),
    [
        (["-X", "importtime"], "numpy", "\nstopped before it began\n"),
        ([], "theorem and linear programs", "\nstopped; nothing is kept\n"),
    ],
)
def test_ctrl_c_is_one_line_from_the_first_import_on(options, sign, answer):
    command = [sys.executable, *options, "-m", "jaxmpc", "info"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        for line in process.stderr:
            if sign in line:
                process.send_signal(signal.SIGINT)
                break
        out, err = process.communicate()
    assert (process.returncode, out) == (130, answer)
    assert "Traceback" not in err


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_in_a_callback_is_not_lost(capsys):
    """Python ignores what callbacks of the garbage collector raise, such as JAX's."""
    seen = []

    def callback(*_):
        if not seen:
            seen.append(True)
            signal.raise_signal(signal.SIGINT)

    gc.callbacks.append(callback)
    try:
        with pytest.raises(KeyboardInterrupt), cli.no_interrupt_lost():
            gc.collect()
            for _ in range(500):
                time.sleep(0.01)
    finally:
        gc.callbacks.remove(callback)
    assert seen and not capsys.readouterr().err


def test_init_writes_a_problem_that_every_command_reads(capsys):
    assert run("init") == 0 and "jaxmpc sweep --config problem.toml" in capsys.readouterr().out
    text = Path("problem.toml").read_text()
    assert "jaxmpc sweep --config problem.toml" in text
    assert configs.load(Path("problem.toml")).name == "mass"
    assert run("sweep --config problem.toml --grid 8 8") == 0
    assert "undecided               0 " in capsys.readouterr().out
    assert run("init") == 2 and "exists. Add --overwrite" in capsys.readouterr().err
    assert run("init --overwrite") == 0 and run("init --output no/where.toml") == 2
    # Every option that is a comment can be set, but for those that need other data.
    keys = ("c = ", "rho = ", "control_horizon = ", "[[outputs]]", "C = ", "lower = ", "upper = ")
    for word in (*keys, "input_rate_limit = ", "input_rate_weight = "):
        text = text.replace(f"# {word}", word)
    Path("all.toml").write_text(text)
    found = configs.load(Path("all.toml"))
    assert found.mpc.control_horizon == 5 and found.outputs[0].rho == 100


@pytest.mark.parametrize(
    "line",
    ["sweep --help", "swep", "tune weights --wrong", "--help", "--version", "simulate --count 0"],
)
@pytest.mark.first(3)
def test_help_version_and_wrong_options_do_without_jax(line):
    code = (
        "import sys; from jaxmpc.app import cli\n"
        f"try: cli.main({line.split()})\nexcept SystemExit: pass\n"
        "print(sorted({'jax', 'mujoco', 'zarr', 'xarray', 'matplotlib'} & set(sys.modules)))"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.splitlines()[-1] == "[]"


def test_output_in_an_encoding_that_lacks_characters(monkeypatch):
    """The unit of the area, rad·rad/s, has no place in ASCII: "?" is printed, and nothing fails."""
    out = io.TextIOWrapper(io.BytesIO(), "ascii")
    monkeypatch.setattr(sys, "stdout", out)
    assert run("sweep --grid 8 8 --horizon 6 --output out") == 0
    out.seek(0)
    assert "rad?rad/s (inner bound)" in out.read()


def test_version_and_module_entry():
    command = [sys.executable, "-m", "jaxmpc", "--version"]
    out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert out == f"jaxmpc {version('jaxmpc')}\n"


FAULTS = """
import sys, errno, zarr
from jaxmpc.app import cli
fail_at = int(sys.argv[1])
write, count = zarr.Array.__setitem__, 0

def limited(array, where, value):
    global count
    count += 1
    if count > fail_at:
        raise OSError(errno.ENOSPC, "No space left on device")
    write(array, where, value)

zarr.Array.__setitem__ = limited
sys.exit(cli.main(sys.argv[2:]))
"""


@pytest.mark.slow
def test_a_full_disk_is_one_line_and_resume_goes_on(tmp_path, capsys):
    """While the store is made, and while a block is written."""
    line = "sweep --grid 8 8 --horizon 6 --no-refine"
    for count in (2, 9):
        command = [sys.executable, "-c", FAULTS, str(count), *shlex.split(line), "--overwrite"]
        found = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
        assert found.returncode == 2 and found.stderr.count("\n") <= 2
        assert found.stderr.splitlines()[-1] == (
            "jaxmpc: error: writing: No space left on device. Make room where it is written to, "
            "and go on with --resume"
        )
    assert run(f"{line} --resume") == 0
    assert run("verify jaxmpc-sweep") == 0
    assert [p.name for p in tmp_path.glob("jaxmpc-sweep/.*")] == []


def test_two_processes_on_one_folder(tmp_path, capsys):
    line = "sweep --grid 8 8 --horizon 6 --no-refine"
    first = Lock(tmp_path / "jaxmpc-sweep")
    assert run(line) == 2
    assert "another process writes there" in capsys.readouterr().err
    first.release()
    assert run(line) == 0


@pytest.mark.slow
def test_fifty_kills_at_random_moments(tmp_path):
    """Arrays after resume are those of a run that nobody killed."""
    line = "sweep --grid 130 257 --horizon 4 --no-refine --output"
    command = [sys.executable, "-m", "jaxmpc", *line.split()]
    subprocess.run([*command, "whole"], check=True, cwd=tmp_path, capture_output=True)
    random = np.random.default_rng(0)
    for k in range(50):
        more = ["--resume"] if (tmp_path / "killed" / "sweep.zarr").exists() else []
        if k % 10 == 0:
            shutil.rmtree(tmp_path / "killed", ignore_errors=True)
            more = []
        with subprocess.Popen(
            [*command, "killed", *more],
            cwd=tmp_path,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        ) as process:
            time.sleep(random.uniform(1, 6))
            process.kill()
    more = ["--resume"] if (tmp_path / "killed" / "sweep.zarr").exists() else []
    subprocess.run([*command, "killed", *more], check=True, cwd=tmp_path, capture_output=True)
    whole, killed = (
        xr.open_zarr(tmp_path / name / "sweep.zarr").load() for name in ("whole", "killed")
    )
    xr.testing.assert_identical(whole, killed)


@pytest.mark.slow
def test_verify_a_recursion_report(tmp_path, capsys):
    assert run("recursion --horizon 4 --grid 9 9 --lower -1.5 -2 --upper 1.5 2 --output rec") == 0
    assert run("verify rec") == 0
    out = capsys.readouterr().out
    assert "rec/recursion.npz: verified" in out and "of 81," in out
    summary = json.loads((tmp_path / "rec/summary.json").read_text())
    for key, word in (("next_state", "not A x + B u + c"), ("feasible_inputs", "breaks a limit")):
        wrong = json.loads(json.dumps(summary))
        wrong["counterexample"][key] = (np.array(wrong["counterexample"][key]) * 0.5 + 1.2).tolist()
        (tmp_path / "rec/summary.json").write_text(json.dumps(wrong))
        assert run("verify rec") == 1
        assert word in capsys.readouterr().out
    (tmp_path / "rec/summary.json").write_text(json.dumps(summary))
    record, arrays = read_arrays(tmp_path / "rec/recursion.npz")
    arrays["label"][40] *= -1
    write_arrays(tmp_path / "rec/recursion.npz", record, **arrays)
    assert run("verify rec") == 1
    assert "FAILS: state 40" in capsys.readouterr().out
    (tmp_path / "rec/recursion.npz").write_bytes(b"garbled")
    assert run("verify rec") == 1
    assert "cannot be read" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("terminal", ["none", "invariant"])
def test_results_of_problems_with_outputs_verify(terminal, tmp_path):
    """Limits of outputs are rows of the states to `recursive_feasibility`, in the file they are
    rows of their own: the same problem."""
    text = """
        [system]
        dt = 0.1
        A = [[1.0, 0.1], [0.0, 1.0]]
        B = [[0.005], [0.1]]
        [cost]
        Q = [1.0, 1.0]
        R = [0.1]
        [limits]
        x_min = [-1.0, -1.0]
        x_max = [1.0, 1.0]
        u_min = [-1.0]
        u_max = [1.0]
        [[outputs]]
        C = [[1.0, 0.5]]
        lower = [-0.9]
        upper = [0.8]
        [mpc]
        horizon = 3
    """
    (tmp_path / "a.toml").write_text(f'{textwrap.dedent(text)}terminal = "{terminal}"\n')
    for command in ("recursion", "sweep"):
        words = "--grid 7 7 --lower -1 -1 --upper 1 1"
        assert run(f"{command} --config a.toml {words} --output {command}") == 0
        assert run(f"verify {command}") == 0
    record, _ = read_arrays(tmp_path / "recursion/recursion.npz")
    config = json.loads((tmp_path / "recursion/summary.json").read_text())["config"]
    given = {"problem": record["problem"], "config": config}
    assert contradictions(given, {}) == []
    config["outputs"][0]["upper"] = [0.85]
    (said,) = contradictions(given, {})
    assert re.match(r"problem.rows\[1\].upper\[\d\]: 0.8, the configuration says 0.85", said), said


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize("words", ["sweep --help", "--help", "--version", "init", "init --json"])
def test_a_reader_that_has_ended_ends_a_command_silently(words, unbuffered, tmp_path):
    """As in `jaxmpc sweep --help | head -1`, whether output is written at once or at the end."""
    with subprocess.Popen(
        [sys.executable, "-m", "jaxmpc", *words.split()],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path,
        env=os.environ | {"PYTHONUNBUFFERED": unbuffered},
    ) as process:  # fmt: skip
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()
        error = process.stderr.read()
    assert (process.returncode, error) == (141, "")


def test_closed_streams_are_no_errors(tmp_path):
    """As in `jaxmpc init >&- 2>&-`."""
    command = f"{sys.executable} -m jaxmpc init >&- 2>&-"
    assert subprocess.run(command, shell=True, cwd=tmp_path, check=False).returncode == 0
    assert (tmp_path / "problem.toml").is_file()
