"""A problem file says what Python can say: rates, outputs, soft rows, blocks, references."""

import dataclasses
import re
import subprocess
import sys
from functools import partial

import jax
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.app import config as configs
from jaxmpc.app.cli import main
from jaxmpc.app.config import problem
from jaxmpc.app.config.problem import sweep_points
from jaxmpc.mpc.condense import condensed_in_float64

TEXT = """
name = "cart"
[system]
A = [[1.0, 0.1], [0.0, 1.0]]
B = [0.005, 0.1]
dt = 0.1
state_names = ["p", "v"]
[limits]
x_min = [-2.0, -1.0]
x_max = [2.0, 1.0]
u_min = -1
u_max = 1.0
input_rate_limit = 0.5
[cost]
Q = [10.0, 1.0]
R = 0.1
P = "none"
input_rate_weight = 0.01
stage_weights = [1.0, 1.0, 2.0, 2.0]
[mpc]
horizon = 4
control_horizon = [1, 1, 2]
constrained_stages = [1, 2, 3, 4]
[[outputs]]
C = [[1.0, 0.5]]
upper = [2.2]
names = ["reach"]
[[outputs]]
C = [[0.0, 1.0]]
D = [[0.1]]
lower = [-0.8]
upper = [0.8]
rho = 50.0
quadratic = 2.0
stages = [0, 1]
[reference]
state = [1.0, 0.0]
input = 0.0
"""


@pytest.fixture
def write(tmp_path):
    """Write TEXT with one replacement, and return the path."""

    def writer(old="", new=""):
        assert old in TEXT
        path = tmp_path / "problem.toml"
        path.write_text(TEXT.replace(old, new, 1))
        return path

    return writer


def test_it_is_the_problem_of_python(write):
    config = configs.load(write())
    made = config.build_mpc()
    said = jm.MPC(
        jm.LinearSystem([[1.0, 0.1], [0, 1.0]], [0.005, 0.1], dt=0.1),
        [10.0, 1.0],
        0.1,
        horizon=4,
        states=jm.Box([-2.0, -1], [2.0, 1]),
        inputs=jm.Box(-1, 1),
        input_rate_limit=0.5,
        input_rate_weight=0.01,
        stage_weights=[1.0, 1, 2, 2],
        control_horizon=(1, 1, 2),
        constrained_stages=(1, 2, 3, 4),
        outputs=jm.Outputs([[1.0, 0.5]], upper=[2.2]),
        soft=jm.Soft([[0.0, 1]], [-0.8], [0.8], 50.0, 2.0, [[0.1]], stages=(0, 1)),
    )
    one, other = map(condensed_in_float64, (made, said))
    for field in dataclasses.fields(one):
        mine, its = (getattr(c, field.name) for c in (one, other))
        jax.tree.map(partial(np.testing.assert_array_equal, err_msg=field.name), mine, its)
    assert config.references()["reference"].tolist() == [1.0, 0.0]
    again = write()
    again.write_text(config.to_toml())
    assert configs.load(again).to_dict() == config.to_dict()


def test_old_results_are_read_as_they_were(write):
    plain = TEXT.partition("[[outputs]]")[0].replace("input_rate_weight = 0.01\n", "")
    plain = plain.replace("input_rate_limit = 0.5\n", "")
    path = write()
    path.write_text(plain.replace("constrained_stages = [1, 2, 3, 4]\n", ""))
    stored = configs.load(path).to_dict()
    assert not {"outputs", "reference"} & set(stored)
    assert "input_rate_limit" not in stored["limits"]
    assert "constrained_stages" not in stored["mpc"]


def test_empty_and_zero_are_not_absent(write):
    """State limits at no stage, and inputs that may not move: other problems than without."""
    path = write("constrained_stages = [1, 2, 3, 4]", "constrained_stages = []")
    stored = configs.load(path).to_dict()
    assert stored["mpc"]["constrained_stages"] == []
    assert configs.from_results(stored).build_mpc().constrained_stages == ()
    path = write("input_rate_limit = 0.5", "input_rate_limit = 0.0")
    stored = configs.load(path).to_dict()
    assert configs.from_results(stored).build_mpc().input_rate_limit == 0.0


@pytest.mark.slow
def test_a_map_with_limited_rates(write, tmp_path):
    """The previous input is a state: by name, zero where nothing is said, or mapped."""
    text = """
name = "integrator"
[system]
A = [[1.0]]
B = [1.0]
dt = 1.0
state_names = ["x"]
input_names = ["u"]
[limits]
x_min = -1
x_max = 1
u_min = -1
u_max = 1
input_rate_limit = 0.5
[cost]
Q = 1
R = 1
[mpc]
horizon = 1
terminal = "box"
[sweep]
grid = [21, 21]
lower = [-1.25, -1.25]
upper = [1.2, 1.2]
"""
    path = tmp_path / "problem.toml"
    path.write_text(text)
    config = configs.load(path)
    assert config.coordinate_names == ("x", "previous u")
    points = sweep_points(config)
    fmap = jm.map_feasible_set(config.build_mpc(), points.points, axes=points.axes)
    x, before = points.points.T
    # u within its limits and its rate, x + u within the limits of x.
    least = np.max([-np.ones(len(x)), before - 0.5, -1 - x], axis=0)
    most = np.min([np.ones(len(x)), before + 0.5, 1 - x], axis=0)
    feasible = (least <= most) & (abs(x) <= 1) & (abs(before) <= 1)
    np.testing.assert_array_equal(np.asarray(fmap.label) == 1, feasible)
    path.write_text(
        text.replace("grid = [21, 21]", 'axes = ["x"]\ngrid = [21]').partition("low")[0]
    )
    alone = sweep_points(configs.load(path))
    assert alone.axes == (0,) and alone.fixed.tolist() == [0, 0]
    # Units of the area, where the previous input is mapped too.
    mpc = config.build_mpc()
    assert mpc.volume_unit() == ""
    units = dataclasses.replace(mpc.system, state_units=("m",), input_units=("N",))
    assert dataclasses.replace(mpc, system=units).volume_unit() == " m·N"
    assert dataclasses.replace(mpc, system=units).volume_unit([0]) == " m"


@pytest.mark.parametrize(
    ("units", "expected"),
    [
        (("rad", "rad/s"), " rad·rad/s"),
        (("mg",) * 4, " mg⁴"),
        (("m/s", "rad", "rad/s", "rad"), " (m/s)·rad²·rad/s"),
        (("m/s", "m/s"), " (m/s)²"),
        (("m", ""), ""),
    ],
)
def test_units_of_volumes_are_read_one_way_alone(units, expected):
    n = len(units)
    system = jm.LinearSystem(np.eye(n), np.ones((n, 1)), state_units=units)
    assert jm.MPC(system, np.eye(n), 1.0, 2).volume_unit() == expected


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("input_rate_limit = 0.5", "input_rate_limit = [0.5, 1.0]", "limits.input_rate_limit: has"),
        ("input_rate_limit = 0.5", "input_rate_limit = -0.5", "limits.input_rate_limit"),
        ("control_horizon = [1, 1, 2]", "control_horizon = [1, 1]", "mpc.control_horizon"),
        ("upper = [2.2]", "upper = [2.2, 1.0]", "outputs.0.upper: has 2"),
        ("upper = [2.2]", "", "outputs.0: has neither"),
        ("upper = [2.2]", "uper = [2.2]", r"unknown key 'uper' in \[outputs\].*upper"),
        ("rho = 50.0", "", "outputs.1.quadratic: given without rho"),
        ("C = [[1.0, 0.5]]", "C = [[1.0]]", "outputs.0.C: has 1 columns"),
        ("stage_weights = [1.0, 1.0, 2.0, 2.0]", "stage_weights = [1.0]", "cost.stage_weights"),
        ("state = [1.0, 0.0]", "state = [1.0]", "reference.state: has 1 entries"),
        ("R = 0.1", "R = true", "cost.R"),
    ],
)
def test_errors_name_the_key(write, old, new, message):
    with pytest.raises(ValueError, match=message):
        configs.load(write(old, new)).build_mpc()


def test_init_full(tmp_path):
    """Every key of every section is there, and the file works as it stands, comments too."""
    path = tmp_path / "all.toml"
    assert main(["init", "--full", "--output", str(path)]) == 0
    text, config = path.read_text(), configs.load(path)
    config.build_mpc()
    kinds = [kind for name, kind in vars(problem).items() if name.endswith("Section")]
    keys = {field.name for kind in kinds for field in dataclasses.fields(kind)}
    robots = {"linearize"}
    missing = {key for key in keys - robots if not re.search(rf"^#? ?{key} = ", text, re.MULTILINE)}
    assert not missing
    rest = text.partition("# [[outputs]]")
    path.write_text(rest[0] + re.sub(r"^# (?=[\[\w]+.*[\]=])", "", rest[1] + rest[2], flags=re.M))
    with pytest.raises(ValueError, match="sweep.fixed"):  # of two, projection stays a comment
        configs.load(path)
    path.write_text(re.sub(r"^(fixed|projection) = .*$", "", path.read_text(), flags=re.M))
    whole = configs.load(path)
    assert len(whole.outputs) == 1 and whole.disturbance and whole.reference and whole.solver
    whole.build_mpc()


@pytest.mark.slow
def test_sweep_of_the_whole_file(write, tmp_path):
    command = [sys.executable, "-m", "jaxmpc"]
    sweep = [*command, "sweep", "--config", str(write()), "--grid", "16", "16"]
    done = subprocess.run([*sweep, "--output", str(tmp_path / "o")], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    check = subprocess.run(
        [*command, "verify", str(tmp_path / "o")], capture_output=True, text=True
    )
    assert check.returncode == 0, check.stderr + check.stdout
