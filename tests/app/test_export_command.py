"""`jaxmpc export`: each kind of law leaves what its last line tells how to use."""

import re
import shutil
import subprocess

import pytest

from jaxmpc.app import cli


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
@pytest.mark.parametrize(
    "law",
    ["explicit", pytest.param("steps", marks=pytest.mark.slow)],
)
def test_code_compiles_as_printed(law, tmp_path, capsys):
    folder = tmp_path / "code"
    cli.main(["export", "--horizon", "4", "--law", law, "--output", str(folder)])
    said = capsys.readouterr().out
    assert "regions" in said or "plans of closed loops" in said
    call = said.strip().splitlines()[-1].removeprefix("Next: ")
    subprocess.run(call, shell=True, check=True)
    answer = subprocess.run(
        [folder / "example"], input="1.2 1\n", capture_output=True, text=True, check=True
    )
    u, status, *_ = map(float, answer.stdout.split())
    assert abs(u + 2) < 1e-6 and status in (1, 2)


@pytest.mark.slow
def test_a_program_of_jax(tmp_path, capsys):
    pytest.importorskip("flatbuffers")
    cli.main(["export", "--horizon", "4", "--law", "jax", "--output", str(tmp_path / "new")])
    assert "jax.export.deserialize" in capsys.readouterr().out
    assert (tmp_path / "new" / "mpc.jax").stat().st_size > 10_000


def test_steps_of_a_law_that_takes_none(tmp_path, capsys):
    words = ["export", "--law", "explicit", "--iterations", "9", "--output", str(tmp_path)]
    assert cli.main(words) == 2
    assert "--iterations: 9 where --law explicit has regions" in capsys.readouterr().err


@pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")
def test_the_reference_of_the_file_is_in_the_law(tmp_path, capsys):
    """At its equilibrium nothing moves, and from the origin it is approached."""
    path, folder = tmp_path / "p.toml", tmp_path / "code"
    path.write_text(FILE.replace("[limits]", "[reference]\nstate = [0.5, 0.0]\n[limits]"))
    words = ["export", "--config", str(path), "--law", "explicit", "--output", str(folder)]
    assert not cli.main(words)
    said = capsys.readouterr().out
    assert "that of the file: the function takes none" in said
    subprocess.run(said.strip().splitlines()[-1].removeprefix("Next: "), shell=True, check=True)
    states = "0.5 0\n0 0\n1 0\n"
    answers = subprocess.run(
        [folder / "example"], input=states, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    there, before, beyond = (float(line.split()[0]) for line in answers[:3])
    assert abs(there) < 1e-9 and before > 0.1 and abs(before + beyond) < 1e-9


FILE = """name = "p"
[system]
A = [[1.0, 0.1], [0.0, 1.0]]
B = [[0.005], [0.1]]
dt = 0.1
[limits]
x_min = [-2.0, -1.0]
x_max = [2.0, 1.0]
u_min = [-1.0]
u_max = [1.0]
[cost]
Q = [10.0, 1.0]
R = [0.1]
[mpc]
horizon = 4
"""


@pytest.mark.parametrize(
    "old, new, message",
    [
        ("[-2.0, -1.0]", '["-Infinity", -1.0]', "limits.x_min, x_max: leave .* Bound every state"),
        ("R = [0.1]", "R = [0.1]\nrho = 100.0", "cost.rho: has rows"),
        ("horizon = 4", 'horizon = 4\nterminal = "ellipsoid"', "mpc.terminal: is an ellipsoid"),
    ],
)
def test_what_has_no_regions_names_the_key(old, new, message, tmp_path, capsys):
    """The regions are those of one law of a bounded set."""
    path = tmp_path / "p.toml"
    path.write_text(FILE.replace(old, new))
    words = ["export", "--law", "explicit", "--config", str(path), "--output", str(tmp_path / "e")]
    assert cli.main(words) == 2
    assert re.search("p.toml: " + message, capsys.readouterr().err)
    assert not (tmp_path / "e" / "mpc.c").exists()
