"""A TOML file becomes the problem it says, or an error that names file and key."""

import json
import math
import re
from pathlib import Path

import jax
import numpy as np
import pytest
from problems import MINIMAL_FILE
from pydantic import TypeAdapter

from jaxmpc.app.config import Config, load, load_robot_config, sweep_points
from jaxmpc.app.config.loading import from_results
from jaxmpc.sets.convex_sets import Box, Ellipsoid, Polytope

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


UNEVEN = "x_min = [-9.0, -1.0]\nx_max = [1.0, 5.0]"
AIM = "[reference]\nstate = [1.0, 3.0]\n"


@pytest.fixture
def write(tmp_path):
    """Write MINIMAL_FILE with one piece of text replaced (and more appended); give the path."""

    def write_file(old="", new="", more=""):
        assert old in MINIMAL_FILE
        path = tmp_path / "case.toml"
        path.write_text(MINIMAL_FILE.replace(old, new, 1) + more)
        return path

    return write_file


def test_default_is_the_lessons_joint():
    config = load(None)
    mpc, region = config.build_mpc(), sweep_points(config)
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
    config = load(path)
    mpc, region = config.build_mpc(), sweep_points(config)
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


def test_starts_are_around_the_target_not_the_middle_of_the_limits(write):
    """As in deviations from an operating point, where limits lie unevenly about 0."""
    config = load(write("x_min = [-5.0, -5.0]\nx_max = [5.0, 5.0]", UNEVEN))
    np.testing.assert_allclose(config.around_target(0.1), [[-0.9, -0.1], [0.1, 0.5]])
    np.testing.assert_allclose(config.around_target(1.0), config.state_range())
    aimed = load(write("x_min = [-5.0, -5.0]\nx_max = [5.0, 5.0]", UNEVEN, AIM))
    np.testing.assert_allclose(aimed.around_target(0.5), [[-4.0, 1.0], [1.0, 4.0]])


def test_files_with_outputs_have_terminal_sets_within_them(write):
    rows = "[[outputs]]\nC = [[0.0, 1.0]]\nlower = -0.2\nupper = 0.2\n"
    farthest = []
    for more in ("", rows):
        mpc = load(write("horizon", 'terminal = "invariant"\nhorizon', more)).build_mpc()
        farthest.append(float(mpc.terminal_set.support(np.array([[0.0, 1.0]]))[0]))
    assert farthest[0] > 0.3 and farthest[1] == pytest.approx(0.2)


def test_polytope_limits_bound_the_grid(write):
    H = "H_x = [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]\nh_x = [4.0, 2.0, 1.0, 1.0]"
    path = write("x_min = [-5.0, -5.0]\nx_max = [5.0, 5.0]", H)
    config = load(path)
    mpc, region = config.build_mpc(), sweep_points(config)
    assert isinstance(mpc.states, Polytope)
    np.testing.assert_allclose(region.points[0], [-2.18, -1.06])


def test_axes_by_name_index_and_slice(write):
    path = write('state_names = ["p", "v"]', 'state_names = ["p", "v"]')
    sweep = {"axes": ("v",), "grid": (3,), "fixed": (0.5,)}
    region = sweep_points(load(path, sweep))
    assert region.axes == (1,)
    np.testing.assert_array_equal(region.fixed, [0.5, 0.0])
    assert region.points.shape == (3, 1)
    assert sweep_points(load(path, {**sweep, "axes": ("1",)})).axes == (1,)
    projected = sweep_points(load(path, {"axes": (1,), "grid": (3,), "projection": True}))
    assert projected.fixed is None


def test_rows_of_outputs_are_named_by_their_place_in_the_file(write):
    """Hard and soft ones count together there, and apart in an `MPC`."""
    rows = "\n[[outputs]]\nC = [[1.0, 0.0]]\nupper = [1.0]\n"
    bad = rows + "lower = [2.0]\n"
    for text, place in ((rows + "rho = 1.0" + bad, 1), (rows + bad + "rho = 1.0", 1), (bad, 0)):
        with pytest.raises(ValueError, match=rf"outputs\.{place}: is empty"):
            load(write(more=text)).build_mpc()


def test_the_exact_penalty_of_a_file(write):
    """It is that of the file's target; beside soft outputs no weight is known to be exact."""
    exact = ("R = [", 'rho = "exact"\nR = [')
    output = "\n[[outputs]]\nC = [[1.0, 1.0]]\nlower = [-50.0]\nupper = [50.0]\nrho = 5.0\n"
    target = "\n[reference]\nstate = [20.0, 0.0]\n"
    problems = [load(write(*exact, more=more)).build_controlled() for more in ("", target)]
    weights = [np.max(np.asarray(one.soft[-1].rho)) for one in problems]
    assert weights[0] == 1 and weights[1] > 5
    with pytest.raises(ValueError, match=r'toml.*cost\.rho: "exact" beside soft outputs'):
        load(write(*exact, more=output)).build_controlled()


@pytest.mark.parametrize(
    ("old", "new", "changes"),
    [
        ("u_max = [1.0]", "u_max = inf", {"inputs": Box([-1.0], [np.inf])}),
        (
            "[sweep]",
            "[disturbance]\nw_min = -0.1\nw_max = 0.2\nE = [0.0, 1.0]\n[sweep]",
            {"disturbance": Box([-0.1], [0.2]), "disturbance_matrix": [[0.0], [1.0]]},
        ),
        (
            "[sweep]",
            "[disturbance]\nw_min = -0.1\nw_max = 0.2\n[sweep]",
            {"disturbance": Box([-0.1, -0.1], [0.2, 0.2])},
        ),
    ],
)
def test_a_file_takes_what_python_takes(write, tmp_path, old, new, changes):
    config = load(write(old, new))
    mpc, again = config.build_mpc(), tmp_path / "again.toml"
    for name, value in changes.items():
        found = getattr(mpc, name)
        jax.tree.map(
            np.testing.assert_array_equal,
            found,
            np.asarray(value) if isinstance(value, list) else value,
        )
    again.write_text(config.to_toml())
    assert load(again).to_dict() == config.to_dict() == from_results(config.to_dict()).to_dict()


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
        ("R = [1.0]", 'R = [1.0]\nP = "riccati"', 'cost.P: .riccati. where "lqr", .* rows of'),
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
        # The first thing wrong alone, not what else a key of several types could be.
        ("R = [1.0]", "R = [1.0]\nrho = -1", "cost.rho: Input should be greater than or .* 0. Got"),
        ("grid = [3, 4]", "grid = [1, 1]", "sweep.grid: Input should be .* to 2. Got 1"),
        ("[sweep]", "[outputs]\nC = [[1.0, 0.0]]\nupper = [1.0]\n[sweep]", r"Write \[\[outputs"),
    ],
)
def test_bad_input_is_named(write, old, new, message):
    path = write(old, new)
    with pytest.raises(ValueError, match=message) as caught:
        load(path).build_mpc()
    assert "\n" not in str(caught.value)


def test_errors_name_the_file_or_the_option(write):
    path = write("horizon = 3", "horizon = 0")
    with pytest.raises(ValueError, match=re.escape(f"{path}: mpc.horizon")):
        load(path)
    with pytest.raises(ValueError, match="command line: --horizon: .* Got -2"):
        load(path, {"horizon": -2})
    with pytest.raises(ValueError, match="absent.toml: cannot be read"):
        load("absent.toml")


# Numbers that no short decimal stands for.
FULL = """
P = [[7.123456789012345e-3, 0.1], [0.1, 2.718281828459045]]
[solver]
iterations = 8
rho = [[0.1, 0.30000000000000004, 3.0], [1e-300, 2.0, 1.0]]
alpha = 1.3333333333333333
newton_steps = 0
"""


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("", ""),
        ("[-5.0, -5.0]", "[-inf, -5.0]\nmargin = 0.1"),
        ("horizon = 3", "horizon = 3\nH_f = [[1.0, 0.1], [-1.0, 0.3]]\nh_f = [0.1, 0.7]"),
        ("horizon = 3", "horizon = 3\nP_f = [[2.0, 0.1], [0.1, 1.0]]\nlevel_f = 0.3"),
        ("horizon = 3", 'horizon = 3\nterminal = "invariant"\nconstrain_initial = false'),
        ("Q = [1.0, 2.0]", "Q = [[1.0, 0.1], [0.1, 0.3333333333333333]]\nrho = 12.3"),
        ('["p", "v"]', '["p [a]", "v, \\"w\\"  x"]\nstate_units = ["[m]", "]"]'),
    ],
)
@pytest.mark.parametrize("full", [False, True])
def test_written_file_gives_the_same_problem_to_the_last_bit(write, tmp_path, old, new, full):
    more = "lower = [-1.0, -2.0]\nupper = [1.0, 2.0]\n"
    path = write(old, new, more)
    if full:
        cost, rest = path.read_text().split("R = [1.0]")
        matrix, solver = FULL.split("[solver]")
        path.write_text(f"{cost}R = [1.0]{matrix}{rest}[solver]{solver}")
    config = load(path)
    again = tmp_path / "again.toml"
    again.write_text(config.to_toml())
    read = load(again)
    assert read == config
    first, second = (
        jax.tree.flatten((m.build_mpc(), m.build_controlled(), m.build_solver()))
        for m in (config, read)
    )
    assert first[1] == second[1]
    for a, b in zip(first[0], second[0], strict=True):
        np.testing.assert_array_equal(a, b, strict=True)


def test_each_row_of_a_matrix_is_a_line(write):
    text = load(write()).to_toml()
    assert "A = [\n    [1.0, 1.0],\n    [0.0, 1.0],\n]" in text
    assert "Q = [1.0, 2.0]" in text


def test_margin_terminal_set_and_solver_become_what_they_say(write):
    path = write("[5.0, 5.0]", "[15.0, inf]\nmargin = 0.2", "lower = [-1, -1]\nupper = [1, 1]")
    config = load(path, {"terminal": "box"})
    mpc = config.build_mpc()
    # Half of 20 is 10, of which 20 % stay free; where one side is open nothing moves.
    np.testing.assert_allclose([mpc.states.lower, mpc.states.upper], [[-3, -5], [13, np.inf]])
    assert mpc.terminal_set is mpc.states
    np.testing.assert_array_equal(config.state_limits().lower, [-5, -5])
    box = Box(np.array([-1.0]), np.array([3.0])).tightened(0.5)
    np.testing.assert_array_equal([box.lower, box.upper], [[0.0], [2.0]])

    path = write("horizon = 3", "horizon = 3\nP_f = [[2.0, 0.0], [0.0, 1.0]]\nlevel_f = 0.3")
    assert isinstance(load(path).build_mpc().terminal_set, Ellipsoid)
    assert load(path, {"terminal": "none"}).build_mpc().terminal_set is None  # an option wins

    path = write("[sweep]", "[solver]\nrho = [1.0, 2.0]\niterations = 7\n[sweep]")
    solver = load(path).build_solver()
    assert (solver.iterations, solver.alpha, solver.newton_steps) == (7, 1.9, None)
    np.testing.assert_array_equal(solver.rho, [1.0, 2.0])
    assert load(write()).build_solver() is None


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("u_min", "margin = 1.0\nu_min", "limits.margin"),
        ("x_min = [-5.0, -5.0]\nx_max = [5.0, 5.0]", "margin = 0.1", "without x_min, x_max"),
        ("horizon = 3", "horizon = 3\nH_f = [[1.0, 0.0]]", "H_f and h_f go together"),
        ("horizon = 3", "horizon = 3\nH_f = [[1.0]]\nh_f = [1.0]", "2 columns"),
        ("horizon = 3", "horizon = 3\nP_f = [[1.0]]\nlevel_f = 1.0", "mpc.P_f: shape"),
        ("horizon = 3", 'horizon = 3\nterminal = "box"\nh_f = [1.0]\nH_f = [[1.0, 1.0]]', "beside"),
        ("[sweep]", "[solver]\nalpha = 2.0\n[sweep]", "solver.alpha"),
        ("[sweep]", "[solver]\nsteps = 2\n[sweep]", r"unknown key 'steps' in \[solver\].*alpha"),
    ],
)
def test_bad_sections_of_tuning_are_named(write, old, new, message):
    with pytest.raises(ValueError, match=message):
        load(write(old, new)).build_mpc()


ROBOT = """
[robot]
name = "arm"
horizon = 7
linearize = "set-point"
[cost]
Q = [1.0, 2.0]
R = [[0.3333333333333333]]
P = [[1.0, 0.1], [0.1, 1.0]]
"""


class Arm:
    name, n, m = "arm", 2, 1


def test_weights_of_a_robot_round_trip(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(ROBOT)
    config = load_robot_config(path)
    assert (config.robot.margin, config.cost.rho) == (0.02, 1e4)
    path.write_text(config.to_toml())
    assert load_robot_config(path) == config
    weights = config.weights(Arm)
    np.testing.assert_array_equal(weights["Q"], np.diag([1.0, 2.0]))
    np.testing.assert_array_equal(weights["R"], [[1 / 3]])
    np.testing.assert_array_equal(weights["terminal_cost"], [[1, 0.1], [0.1, 1]])
    for old, new, message in (
        ('"arm"', '"leg"', "robot.name: 'leg', asked is 'arm'"),
        ("[1.0, 2.0]", "[1.0]", "cost.Q: has 1 entries. arm needs 2"),
        ("[robot]", "[robots]", r"has no section \[robot\]"),
        ("[cost]", "[costs]", "unknown key 'costs'.*robot, cost"),
        ("horizon = 7", "horizons = 7", "unknown key 'horizons'.*name, horizon, margin"),
        ("[1.0, 2.0]", "[nan, 2.0]", "cost.Q"),
    ):
        path.write_text(ROBOT.replace(old, new, 1))
        with pytest.raises(ValueError, match=message):
            load_robot_config(path).weights(Arm)
