"""What a type checker says of the public surface: lists are numbers, texts are not."""

import subprocess
import sys

import pytest

PROGRAM = """import jaxmpc as jm

limits = jm.Box([-2.0], [2.0])
mpc = jm.MPC(jm.LinearSystem([[1.0]], [[1.0]]), [[1.0]], [[1.0]], 3, inputs=limits)
plan = jm.solve(mpc, [0.5])
reveal_type(plan)
"""


@pytest.mark.slow
@pytest.mark.parametrize("wrong", ["", 'jm.solve(mpc, "abc")', 'jm.Box("a", 1.0)'])
def test_strict_mypy_outside_the_checkout(tmp_path, wrong):
    (tmp_path / "program.py").write_text(PROGRAM + wrong)
    check = [sys.executable, "-m", "mypy", "--strict", "--follow-imports=silent", "program.py"]
    done = subprocess.run(check, capture_output=True, text=True, cwd=tmp_path)
    assert 'Revealed type is "jaxmpc.mpc.plan.Plan"' in done.stdout
    assert done.returncode == bool(wrong)
    assert done.stdout.count("error:") == bool(wrong)
