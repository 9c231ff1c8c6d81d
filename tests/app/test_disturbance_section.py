"""The section [disturbance] of a problem file."""

import json

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
        ("[disturbance]", '[disturbance]\npolicy = "none"', "disturbance.policy"),
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
