"""`jaxmpc export`: each kind of law leaves what its last line tells how to use."""

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
