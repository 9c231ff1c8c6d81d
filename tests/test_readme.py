"""The README's snippets run as they stand, and say what they promise."""

import re
from pathlib import Path

import numpy as np
import pytest

README = Path(__file__).resolve().parents[1] / "README.md"


def run(*which, instead=()):
    """Execute snippets one after the other; the names they leave."""
    snippets = re.findall(r"```python\n(.*?)```", README.read_text(), flags=re.DOTALL)
    names: dict[str, object] = {}
    for i in which:
        text = snippets[i].replace(*instead) if instead else snippets[i]
        exec(compile(text, str(README), "exec"), names)
    return snippets, names


def test_first_snippet(capsys):
    snippets, names = run(0)
    assert len(snippets[0].split("import jaxmpc as jm\n\n")[1].splitlines()) <= 10
    fmap = names["fmap"]
    low, high = fmap.volume_bounds()
    assert low <= 1489 / 125 <= high and high - low < 1e-6
    assert fmap.counts()["undecided"] == 0
    assert capsys.readouterr().out.startswith("Solved")


@pytest.mark.slow
def test_workflow_snippet(capsys):
    """Theorem 1 holds of the design, and the weight it advises is exact."""
    _, names = run(0, 4)
    text = capsys.readouterr().out
    assert "Theorem 1 (recursive feasibility) applies" in text and "weight given is exact" in text
    assert names["controller"].mpc.soft


@pytest.mark.slow
def test_robot_snippet():
    """With the robot that compiles fastest."""
    _, names = run(1, instead=("arm7", "joint"))
    assert names["run"].states.shape == (64, 101, 2)
    assert names["run"].violation.max() == 0 and not names["run"].fallback.any()
    assert abs(names["run"].states[:, -1]).max() < 1e-2


@pytest.mark.slow
def test_noise_snippet():
    _, names = run(1, 2, instead=("arm7", "joint"))
    found = names["run"]
    assert found.estimates.shape == (64, 100, 2) and (found.status == 1).mean() > 0.99
    assert abs(found.states[:, -1]).max() < 0.05


@pytest.mark.slow
def test_tuning_snippet():
    """The loss on states set apart falls, and the penalties learned solve them."""
    _, names = run(0, 3)
    assert names["run"].improvement > 0.01
    assert names["solver"].rho.shape[0] == 4


def test_nonlinear_snippet(capsys):
    _, names = run(5)
    assert names["plan"].status == names["jm"].Status.SOLVED
    distance = np.hypot(names["plan"].states[1:, 0] - 1.5, names["plan"].states[1:, 1])
    assert abs(distance.min() - 0.5) < 1e-4
    assert "quadratic programs" in capsys.readouterr().out
