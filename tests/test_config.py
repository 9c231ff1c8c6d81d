"""A TOML file becomes the problem it says, or an error that names file and key."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter

from jaxmpc.config import Config, load
from jaxmpc.control.sets import Polytope

EXPERIMENTS = Path(__file__).parents[1] / "experiments"

MINIMAL = """
[system]
A = [[1.0, 1.0], [0.0, 1.0]]
B = [[1.0], [0.5]]
dt = 1.0
state_names = ["p", "v"]
[limits]
x_min = [-5.0, -5.0]
x_max = [5.0, 5.0]
u_min = [-1.0]
u_max = [1.0]
[cost]
Q = [1.0, 2.0]
R = [1.0]
[mpc]
horizon = 3
[sweep]
grid = [3, 4]
"""


@pytest.fixture
def write(tmp_path):
    """Write MINIMAL with one piece of text replaced (and more appended); give the path."""

    def write_file(old="", new="", more=""):
        assert old in MINIMAL
        path = tmp_path / "case.toml"
        path.write_text(MINIMAL.replace(old, new, 1) + more)
        return path

    return write_file


def test_default_is_the_lessons_joint():
    mpc, region = Config.default().build()
    np.testing.assert_allclose(mpc.system.A, [[1, 0.01], [0, 1]])
    np.testing.assert_allclose(mpc.system.B, [[0], [0.01 / 0.05]])
    np.testing.assert_array_equal(mpc.Q, np.diag([50.0, 1.0]))
    np.testing.assert_array_equal(mpc.terminal_cost, mpc.Q)
    assert (mpc.horizon, mpc.terminal_set, mpc.constrain_initial) == (20, None, True)
    assert region.points.shape == (256 * 256, 2)
    # The state limits 1.5 and 2, widened by 3 % of their range on each side.
    np.testing.assert_allclose(region.points[0], [-1.59, -2.12])
    np.testing.assert_allclose(region.points[-1], [1.59, 2.12])
    assert (region.axes, region.fixed) == ((0, 1), None)


@pytest.mark.parametrize("path", sorted(EXPERIMENTS.glob("*.toml")), ids=lambda path: path.stem)
def test_experiments_build(path):
    mpc, region = load(path).build()
    assert len(region.points) == 256 * 256
    assert mpc.system.n == 2


def test_pendulum_is_sampled_with_the_input_held():
    # Taylor series of exp(M dt) for M = [[A, B], [0, 0]], summed here without scipy.
    config = load(EXPERIMENTS / "inverted_pendulum.toml")
    M = np.zeros((3, 3))
    M[:2, :2], M[:2, 2:] = config.system.A, config.system.B
    term = total = np.eye(3)
    for k in range(1, 20):
        term = term @ M * 0.02 / k
        total = total + term
    mpc = config.build_mpc()
    np.testing.assert_allclose(mpc.system.A, total[:2, :2], atol=1e-14)
    np.testing.assert_allclose(mpc.system.B, total[:2, 2:], atol=1e-14)
    assert np.abs(np.linalg.eigvals(mpc.system.A)).max() > 1
    assert isinstance(mpc.terminal_set, Polytope)


def test_dictionary_round_trip_with_infinite_limits(write):
    config = load(write("-5.0, -5.0]", "-inf, -5.0]", "lower = [-1.0, -2.0]\nupper = [1.0, 2.0]\n"))
    document = json.loads(json.dumps(config.to_dict(), allow_nan=False))
    assert document["limits"]["x_min"] == ["-Infinity", -5.0]
    assert config.limits.x_min == (-math.inf, -5.0)
    assert TypeAdapter(Config).validate_python(document) == config


def test_overrides_win_over_the_file(write):
    path = write()
    config = load(path, {"horizon": 7, "terminal": "box", "grid": (5, 6)})
    assert (config.mpc.horizon, config.mpc.terminal, config.sweep.grid) == (7, "box", (5, 6))
    mpc = config.build_mpc()
    assert mpc.terminal_set is mpc.states


def test_polytope_limits_bound_the_grid(write):
    H = "H_x = [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]\nh_x = [4.0, 2.0, 1.0, 1.0]"
    path = write("x_min = [-5.0, -5.0]\nx_max = [5.0, 5.0]", H)
    mpc, region = load(path).build()
    assert isinstance(mpc.states, Polytope)
    np.testing.assert_allclose(region.points[0], [-2.18, -1.06])


def test_axes_by_name_index_and_slice(write):
    path = write('state_names = ["p", "v"]', 'state_names = ["p", "v"]')
    sweep = {"axes": ("v",), "grid": (3,), "fixed": (0.5,)}
    _, region = load(path, sweep).build()
    assert region.axes == (1,)
    np.testing.assert_array_equal(region.fixed, [0.5, 0.0])
    assert region.points.shape == (3, 1)
    assert load(path, {**sweep, "axes": ("1",)}).build_points().axes == (1,)
    projected = load(path, {"axes": (1,), "grid": (3,), "projection": True}).build_points()
    assert projected.fixed is None


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("horizon = 3", "horizon = 0", "mpc.horizon"),
        ("horizon = 3", "horizont = 3", r"unknown key 'horizont' in \[mpc\].*horizon, terminal"),
        ("[cost]", "[costs]", r"unknown key 'costs' in the top of the file.*cost"),
        ("dt = 1.0", "", "system.dt is missing"),
        ("dt = 1.0", "dt = nan", "system.dt"),
        ("dt = 1.0", "dt = -1.0", "system.dt"),
        ("[-5.0, -5.0]", "[nan, -5.0]", "limits.x_min: is NaN"),
        ("[-5.0, -5.0]", "[-5.0]", "limits.x_min: has 1 entries where 2"),
        ("[-5.0, -5.0]", "[6.0, -5.0]", "limits.x_min: entry 0 is 6, above x_max 5"),
        ("u_min = [-1.0]", "u_min = [2.0]", "limits.u_min: entry 0 is 2, above u_max 1"),
        ("x_min = [-5.0, -5.0]", "", "x_min and x_max go together"),
        ("[[1.0], [0.5]]", "[[1.0], [0.5, 2.0]]", "system.B: .*rows of one length"),
        ("[[1.0], [0.5]]", "[[1.0]]", "system.B: has 1 entries"),
        ("Q = [1.0, 2.0]", "Q = [1.0, -2.0]", "Q: is not positive semidefinite"),
        ("Q = [1.0, 2.0]", 'Q = "big"', "cost.Q"),
        ("R = [1.0]", 'R = [1.0]\nP = "riccati"', "cost.P.*'lqr'"),
        ("grid = [3, 4]", "grid = []", "sweep.grid"),
        ("grid = [3, 4]", "grid = [3, 1]", "sweep.grid"),
        ("grid = [3, 4]", "grid = [3]", "sweep.grid: has 1 entries where 2"),
        ("grid = [3, 4]", "lower = [1.0, 1.0]\nupper = [0.0, 2.0]", "sweep.lower: entry 0 is 1"),
        ("grid = [3, 4]", "lower = [9.0, 9.0]", "sweep.lower.*not below upper"),
        ("grid = [3, 4]", "axes = ['w', 'p']", "no state 'w'. States are p, v, 0, 1"),
        ("grid = [3, 4]", "axes = ['p', 0]", "repeats"),
        ("grid = [3, 4]", "axes = ['p']\ngrid = [3]", "sweep.fixed: 2 states, 1 mapped"),
        ("[5.0, 5.0]", "[inf, 5.0]", "no finite range"),
        ("[system]", "[system", "is no TOML"),
    ],
)
def test_bad_input_is_named(write, old, new, message):
    path = write(old, new)
    with pytest.raises(ValueError, match=message) as caught:
        load(path).build()
    assert "\n" not in str(caught.value)


def test_errors_name_the_file_or_the_option(write):
    path = write("horizon = 3", "horizon = 0")
    with pytest.raises(ValueError, match=re.escape(f"{path}: mpc.horizon")):
        load(path)
    with pytest.raises(ValueError, match="command line: --horizon: .* Got -2"):
        load(path, {"horizon": -2})
    with pytest.raises(ValueError, match="absent.toml: cannot be read"):
        load("absent.toml")
