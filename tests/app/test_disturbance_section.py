"""The section [disturbance] of a problem file."""

import json
import shutil
import subprocess

import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.app import config as configs
from jaxmpc.app.cli import main

TEXT = """
name = "double"
[system]
A = [[1.0, 1.0], [0.0, 1.0]]
B = [[0.5], [1.0]]
dt = 1.0
[limits]
x_min = [-5.0, -2.0]
x_max = [5.0, 2.0]
u_min = [-1.0]
u_max = [1.0]
[cost]
Q = [1.0, 1.0]
R = [0.1]
[mpc]
horizon = 5
terminal = "invariant"
[disturbance]
w_min = [-0.2, -0.2]
w_max = [0.2, 0.2]
"""


def test_it_makes_a_robust_problem_that_is_read_back(tmp_path):
    path = tmp_path / "problem.toml"
    path.write_text(TEXT)
    config = configs.load(path, {})
    mpc = config.build_mpc()
    np.testing.assert_array_equal(np.asarray(mpc.disturbance.upper), [0.2, 0.2])
    # The terminal set is that of the LQR under disturbances: its area is known.
    np.testing.assert_allclose(mpc.terminal_set.volume(), 6.5483, atol=5e-5)
    path.write_text(config.to_toml())
    again = configs.load(path, {})
    assert again.to_dict() == config.to_dict()
    path.write_text(TEXT.partition("[disturbance]")[0])
    nominal = configs.load(path, {})
    assert "disturbance" not in nominal.to_dict() and nominal.build_mpc().disturbance is None


@pytest.mark.parametrize(
    ("line", "other", "message"),
    [
        ("w_min = [-0.2, -0.2]", "w_min = [0.1, 0.1]", "disturbance.w_min, w_max: does not hold"),
        ("w_min = [-0.2, -0.2]", "w_min = [-0.2]", "disturbance.w_min: has 1 entries"),
        ("w_min = [-0.2, -0.2]", "w_min = [0.3, 0.0]", "disturbance.w_min: entry 0 is 0.3"),
        ("[disturbance]", "[disturbance]\ngain = [[1.0]]", "disturbance.gain: shape"),
        ("[disturbance]", "[disturbance]\nE = [[1.0, 0.0]]", "disturbance.E: shape"),
        ("[disturbance]", "[disturbance]\nE = [[1.0, 0, 0]]", r"E: shape \(1, 3\). Give \(2, p\)"),
        ("[disturbance]", '[disturbance]\npolicy = "none"', "disturbance.policy"),
        (
            "u_max = [1.0]",
            "u_max = [1.0]\ninput_rate_limit = 0.3\n[sweep]\nfixed = [1.0, 1.0, 1.0]",
            r"sweep.fixed: has 3.*3 states \(1 of them previous inputs, whose rates are limited\)",
        ),
        ('terminal = "invariant"', 'terminal = "ellipsoid"', "mpc.terminal: is an Ellipsoid"),
    ],
)
def test_errors_name_the_key(tmp_path, line, other, message):
    path = tmp_path / "problem.toml"
    path.write_text(TEXT.replace(line, other))
    with pytest.raises(ValueError, match=message):
        configs.load(path, {}).build_mpc()


def test_recursion_command(tmp_path):
    path = tmp_path / "problem.toml"
    path.write_text(TEXT.replace("[disturbance]", '[disturbance]\npolicy = "affine"'))
    output = tmp_path / "out"
    assert main(["recursion", "--config", str(path), "--output", str(output)]) in (0, None)
    summary = json.loads((output / "summary.json").read_text())
    assert "all disturbances" in json.dumps(summary, ensure_ascii=False)
    assert jm.__version__


LOOPS = "simulate --seconds 4 --count 8 --spread 0.9 --config"


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["tightened", "affine", "tube"])
def test_simulate_command(tmp_path, monkeypatch, policy, capsys):
    """Every loop that has a plan keeps all limits under the worst disturbances that are found; the
    files hold a loop of the plant."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "problem.toml").write_text(
        TEXT.replace("[disturbance]", f'[disturbance]\npolicy = "{policy}"')
    )
    options = "problem.toml --disturbance worst --output out"
    assert main([*LOOPS.split(), *options.split()]) in (0, None)
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    assert summary["policy"] == policy and summary["count"] == 8 and summary["steps"] == 4
    assert 0 < summary["planned"] == summary["kept"] and summary["plans_solved"] == 1
    assert "a local search, no proof" in capsys.readouterr().out
    runs = np.load(tmp_path / "out/runs.npz")
    x, u, w = (runs[name] for name in ("states", "inputs", "disturbances"))
    A, B = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])
    np.testing.assert_allclose(x[:, 1:], x[:, :-1] @ A.T + u @ B.T + w, atol=1e-12)
    moved = runs["status"][:, 0] == jm.Status.SOLVED
    np.testing.assert_array_equal(np.unique(np.abs(w[moved])), [0.2])
    assert moved.sum() == summary["planned"]


@pytest.mark.slow
def test_loops_beyond_a_hard_output_have_not_kept_the_limits(tmp_path, monkeypatch):
    """An input that moves v by 0.1 at most, and two steps ahead: some loops that begin with a
    plan pass |p + 0.3 v| <= 1."""
    monkeypatch.chdir(tmp_path)
    rows = "[[outputs]]\nC = [[1.0, 0.3]]\nlower = [-1.0]\nupper = [1.0]\n"
    short = TEXT.partition("[disturbance]")[0].replace("horizon = 5", "horizon = 2")
    short = short.replace("[[0.5], [1.0]]", "[[0.0], [0.1]]").replace(
        "[1.0, 1.0], [0", "[1.0, 0.1], [0"
    )
    (tmp_path / "problem.toml").write_text(short.replace('"invariant"', '"none"') + rows)
    assert main("simulate --config problem.toml --seconds 3 --output out".split()) in (0, None)
    summary = json.loads((tmp_path / "out/summary.json").read_text())
    runs = np.load(tmp_path / "out/runs.npz")
    begun = runs["status"][:, 0] == jm.Status.SOLVED
    beyond = np.abs(runs["states"][begun] @ [1.0, 0.3]).max(axis=1) - 1
    assert summary["kept"] == (beyond <= 1e-6).sum() < summary["planned"] == begun.sum()
    np.testing.assert_allclose(summary["worst_violation"], beyond.max(), rtol=1e-12)


@pytest.mark.slow
def test_simulate_with_limited_rates(tmp_path, monkeypatch):
    """Loops begin with an input of zero, and no input changes by more than the limit."""
    monkeypatch.chdir(tmp_path)
    limited = TEXT.replace("[cost]", "input_rate_limit = 0.3\n[cost]").replace("0.2", "0.05")
    (tmp_path / "problem.toml").write_text(limited.replace('"invariant"', '"none"'))
    options = "problem.toml --disturbance worst --output out"
    assert main([*LOOPS.split(), *options.split()]) in (0, None)
    runs = np.load(tmp_path / "out/runs.npz")
    changes = np.diff(runs["inputs"], axis=1, prepend=0.0)
    assert runs["inputs"].shape == (8, 4, 1) and 0.25 < np.abs(changes).max() <= 0.3 + 1e-12


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("problem.toml --mass 0.1", "--mass: given beside a problem file"),
        ("plain.toml --disturbance inside", "--disturbance: inside, and the file has none"),
        ("free.toml --disturbance inside", "limits.x_min, x_max"),
        ("problem.toml --horizon 0", "--horizon"),
    ],
)
def test_simulate_refuses(tmp_path, monkeypatch, capsys, options, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "problem.toml").write_text(TEXT)
    (tmp_path / "plain.toml").write_text(TEXT.partition("[disturbance]")[0])
    free = TEXT.replace("[-5.0, -2.0]", "[-inf, -2.0]").replace('"invariant"', '"none"')
    (tmp_path / "free.toml").write_text(free)
    assert main([*LOOPS.split(), *options.split()]) == 2
    assert message in capsys.readouterr().err


def test_a_robot_has_no_disturbance(capsys):
    assert main(["simulate", "--disturbance", "inside"]) == 2
    assert "--disturbance: given for a robot" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["export --law explicit", "tune solver"])
def test_commands_of_tightened_rows_refuse_others(tmp_path, monkeypatch, capsys, command):
    """In one sentence, and before anything compiles."""
    monkeypatch.chdir(tmp_path)
    text = TEXT.replace("[disturbance]", '[disturbance]\npolicy = "tube"')
    (tmp_path / "problem.toml").write_text(text)
    assert main([*command.split(), "--config", "problem.toml"]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert "'tube'" in error and 'Give policy="tightened"' in error
    assert not list(tmp_path.glob("*/*"))


@pytest.mark.parametrize("policy", ["tube", "affine"])
@pytest.mark.first(1)
def test_export_command(tmp_path, monkeypatch, policy):
    """C code of plans under a policy, whose closed loops are not looked at."""
    monkeypatch.chdir(tmp_path)
    text = TEXT.replace("[disturbance]", f'[disturbance]\npolicy = "{policy}"')
    (tmp_path / "problem.toml").write_text(text)
    options = "--config problem.toml --horizon 2 --iterations 2000 --plans 0 --output out"
    assert main(["export", *options.split()]) in (0, None)
    assert "define mpc_WARM 0" in (tmp_path / "out/mpc_sizes.h").read_text()
    if (compiler := shutil.which("cc")) is not None:
        strict = "-std=c99 -Wall -Wextra -Wpedantic -Werror -c out/mpc.c -o mpc.o"
        subprocess.run([compiler, *strict.split()], check=True)


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["affine", "tube"])
def test_sweep_and_verify_commands(tmp_path, monkeypatch, capsys, policy):
    """A sweep by two shards, begun again with another grid; a problem of another configuration is
    found."""
    monkeypatch.chdir(tmp_path)
    text = TEXT.replace("[disturbance]", f'[disturbance]\npolicy = "{policy}"')
    (tmp_path / "problem.toml").write_text(text)
    sweep = "sweep --config problem.toml --output out --grid 20"
    for shard in ("0/2", "1/2"):
        assert main([*sweep.split(), "21", "--shard", shard]) in (0, None)
    for more in ("21 --resume", "22 --overwrite"):
        assert main([*sweep.split(), *more.split()]) in (0, None)
        assert main(["verify", "out"]) == 0
    assert "verified" in capsys.readouterr().out
    counts = json.loads((tmp_path / "out/summary.json").read_text())["counts"]
    assert counts["feasible"] > 250 and counts["infeasible"] > 90


@pytest.mark.parametrize("policy", ["affine", "tube"])
@pytest.mark.first(1)
def test_a_report_about_policies_is_no_damaged_one(tmp_path, monkeypatch, capsys, policy):
    """It keeps no problem of theirs, and says nothing of single states that could be proved."""
    monkeypatch.chdir(tmp_path)
    text = TEXT.replace("[disturbance]", f'[disturbance]\npolicy = "{policy}"')
    (tmp_path / "problem.toml").write_text(text.replace("horizon = 5", "horizon = 2"))
    assert main("recursion --config problem.toml --output out".split()) in (0, None)
    capsys.readouterr()
    assert main(["verify", "out"]) == 0
    assert "nothing to verify, no state is labelled" in capsys.readouterr().out


def test_a_sweep_that_is_refused_leaves_nothing(tmp_path, monkeypatch, capsys):
    """No folder is made before the problem is found to have labels."""
    monkeypatch.chdir(tmp_path)
    large = TEXT.replace("0.2", "3.0").replace('"invariant"', '"none"')
    for policy, message in (("tightened", "limits cross"), ("affine", "empty or flat")):
        text = large.replace("[disturbance]", f'[disturbance]\npolicy = "{policy}"')
        (tmp_path / "problem.toml").write_text(text)
        assert main([*"sweep --config problem.toml --output out".split()]) == 2
        assert message in capsys.readouterr().err
        assert [v.name for v in tmp_path.iterdir()] == ["problem.toml"]
