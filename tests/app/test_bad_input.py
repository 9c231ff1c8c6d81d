"""Bad files and bad command lines: one line that names what is wrong, and nothing compiles."""

import re
import shlex
import subprocess
import sys

import pytest
from problems import MINIMAL_FILE

from jaxmpc import checks
from jaxmpc.app import cli
from jaxmpc.app.commands import recursion
from jaxmpc.feasible import pipeline
from jaxmpc.robots.load import load_robot

FILE = f'\nname = "case"{MINIMAL_FILE}'

ROBOT = """
[robot]
name = "joint"
[cost]
Q = [1.0, 1.0]
R = [1.0]
"""


@pytest.fixture(scope="module", autouse=True)
def _conversions():
    load_robot("joint")  # reading a model compiles some


@pytest.fixture
def refused(tmp_path, monkeypatch, capsys, compiled):
    """Run a command line that must be refused in one line before anything compiles; return it."""
    monkeypatch.chdir(tmp_path)
    forbidden = lambda *a, **k: pytest.fail("the work started")
    monkeypatch.setattr(pipeline, "label_parts", forbidden)
    monkeypatch.setattr(recursion, "recursive_feasibility", forbidden)

    def run(line):
        compiled.clear()
        assert cli.main(shlex.split(line)) == 2
        out, err = capsys.readouterr()
        assert err.startswith("jaxmpc: error: ") and err.count("\n") == 1 and err.endswith("\n")
        assert not compiled and "Traceback" not in err and len(err) < 500 and not out
        return err

    return run


# What is replaced in FILE, by what, and a part of the answer.
KEYS = [
    # Kinds of values: strings, booleans, numbers, dates, tables in the place of each other.
    ("dt = 1.0", 'dt = "1.0"', "system.dt: '1.0' where a number is needed"),
    ("dt = 1.0", "dt = true", "system.dt: True where a number is needed"),
    ("dt = 1.0", "dt = [1.0]", "system.dt"),
    ("dt = 1.0", "dt = 2020-01-01", "system.dt"),
    ("dt = 1.0", "dt = {a = 1}", "system.dt"),
    ("dt = 1.0", "dt = 0", "system.dt"),
    ("dt = 1.0", "dt = -1.0", "system.dt"),
    ("dt = 1.0", "dt = nan", "system.dt"),
    ("dt = 1.0", "dt = inf", "system.dt"),
    ("dt = 1.0", "dt = 1" + "0" * 400, "system.dt"),
    ("dt = 1.0", "dt = 1" + "0" * 5000, "is no TOML"),
    ("dt = 1.0", "", "system.dt is missing"),
    ("dt = 1.0", "dt = 1.0\ncontinuous = 1", "system.continuous"),
    ("dt = 1.0", 'dt = 1.0\ncontinuous = "yes"', "system.continuous"),
    ("dt = 1.0", 'dt = 1.0\ncontinuous = "true"', "system.continuous"),
    ("dt = 1.0", "dt = 1.0\nc = [1.0]", "system.c: has 1 entries where 2"),
    ("dt = 1.0", 'dt = 1.0\nc = ["0", "0"]', "system.c"),
    ("dt = 1.0", "dt = 1.0\nc = 3", "system.c"),
    ("[[1.0, 1.0], [0.0, 1.0]]", "3", "system.A"),
    ("[[1.0, 1.0], [0.0, 1.0]]", '"A"', "system.A"),
    ("[[1.0, 1.0], [0.0, 1.0]]", "[]", "system.A"),
    ("[[1.0, 1.0], [0.0, 1.0]]", "[[]]", "system.A"),
    ("[[1.0, 1.0], [0.0, 1.0]]", "[1.0, 1.0]", "system.A"),
    ("[[1.0, 1.0], [0.0, 1.0]]", "[[1.0, true], [0.0, 1.0]]", "system.A"),
    ("[[1.0, 1.0], [0.0, 1.0]]", '[[1.0, "1"], [0.0, 1.0]]', "system.A"),
    ("[[1.0, 1.0], [0.0, 1.0]]", "[[1.0, inf], [0.0, 1.0]]", "system.A"),
    ("[[1.0, 1.0], [0.0, 1.0]]", "[[1.0, 1.0], [0.0]]", "system.A: .*rows of one length"),
    ("[[1.0, 1.0], [0.0, 1.0]]", "[[1.0, 1.0]]", "system.A: has 2 entries where 1"),
    ("[[1.0, 1.0], [0.0, 1.0]]", "[[[1.0]]]", "system.A"),
    ("[[1.0, 1.0], [0.0, 1.0]]", "[[1e300, 0.0], [0.0, 1e300]]", "case.toml: "),
    ("[[1.0], [0.5]]", "[[1.0], [true]]", "system.B"),
    ("[[1.0], [0.5]]", "[[1.0]]", "system.B: has 1 entries where 2"),
    ("[[1.0], [0.5]]", "[1.0]", "system.B: has 1 entries where 2"),
    ("[[1.0], [0.5]]", "[[], []]", "system.B"),
    ("[[1.0], [0.5]]", "[[0.0], [0.0]]", "system.B: not stabilizable"),
    ('["p", "v"]', '["p", "p"]', "system.state_names: .* a name twice"),
    ('["p", "v"]', '["p"]', "system.state_names: has 1 entries where 2"),
    ('["p", "v"]', '"pv"', "system.state_names"),
    ('["p", "v"]', "[1, 2]", "system.state_names"),
    ('["p", "v"]', "true", "system.state_names"),
    ('["p", "v"]', '["p", "v"]\nstate_units = ["m"]', "system.state_units: has 1 entries"),
    ('["p", "v"]', '["p", "v"]\ninput_names = ["u", "w"]', "system.input_names"),
    ("x_min = [-5.0, -5.0]", "x_min = [true, -5.0]", "limits.x_min"),
    ("x_min = [-5.0, -5.0]", 'x_min = ["-5", -5.0]', "limits.x_min"),
    (
        "u_min = [-1.0]\nu_max = [1.0]",
        "u_min = [0.30000000000000004]\nu_max = [0.3]",
        "limits.u_min: entry 0 is 0.30000000000000004, above u_max 0.3",
    ),
    ("x_min = [-5.0, -5.0]", "x_min = 6.0", "limits.x_min: entry 0 is 6, above x_max 5"),
    ("x_min = [-5.0, -5.0]", "x_min = [nan, -5.0]", "limits.x_min: is NaN"),
    ("x_min = [-5.0, -5.0]", "x_min = [-5.0]", "limits.x_min: has 1 entries where 2"),
    ("x_min = [-5.0, -5.0]", "x_min = [6.0, -5.0]", "limits.x_min: entry 0 is 6, above x_max 5"),
    ("x_min = [-5.0, -5.0]", "", "x_min and x_max go together"),
    ("x_min = [-5.0, -5.0]", "x_min = [-inf, -5.0]", "sweep.lower: no finite range"),
    ("x_min = [-5.0, -5.0]", "x_min = [inf, -5.0]", "limits.x_min"),
    ("u_min = [-1.0]", "u_min = [2.0]", "limits.u_min: entry 0 is 2, above u_max 1"),
    ("u_min = [-1.0]", "u_min = []", "limits.u_min: has 0 entries"),
    ("u_min = [-1.0]", "u_min = [false]", "limits.u_min"),
    ("u_min = [-1.0]", "", "limits.u_min is missing"),
    ("u_min = [-1.0]", "u_min = [-1.0]\nmargin = 1.0", "limits.margin"),
    ("u_min = [-1.0]", 'u_min = [-1.0]\nmargin = "0.1"', "limits.margin"),
    ("u_min = [-1.0]", "u_min = [-1.0]\nmargin = true", "limits.margin"),
    ("u_min = [-1.0]", "u_min = [-1.0]\nH_x = [[1.0, 0.0]]", "limits.H_x: H_x and h_x go"),
    ("u_min = [-1.0]", "u_min = [-1.0]\nH_x = [[1.0, 0.0]]\nh_x = [1.0]", "beside x_min"),
    ("Q = [1.0, 2.0]", "Q = [1.0, -2.0]", "cost.Q: is not positive semidefinite"),
    ("Q = [1.0, 2.0]", "Q = [[1.0, 2.0], [0.0, 1.0]]", "cost.Q: is triangular, not symmetric"),
    ("Q = [1.0, 2.0]", "Q = [1.0]", "cost.Q: has 1 entries where 2"),
    ("Q = [1.0, 2.0]", "Q = [[1.0, 2.0, 3.0], [0.0, 1.0, 2.0]]", "cost.Q: shape"),
    ("Q = [1.0, 2.0]", 'Q = "big"', "cost.Q"),
    ("Q = [1.0, 2.0]", 'Q = ["1", "2"]', "cost.Q"),
    ("Q = [1.0, 2.0]", "Q = true", "cost.Q"),
    ("Q = [1.0, 2.0]", "Q = [0.0, 0.0]", "cost.Q: not detectable"),
    ("R = [1.0]", "R = [0.0]", "cost.R: is not positive definite"),
    ("R = [1.0]", "R = 0.0", "cost.R: is not positive definite"),
    ("R = [1.0]", "R = [true]", "cost.R"),
    ("R = [1.0]", 'R = [1.0]\nP = "riccati"', 'cost.P: .* where "lqr", "Q", "none", a list'),
    ("R = [1.0]", "R = [1.0]\nP = true", "cost.P"),
    ("R = [1.0]", "R = [1.0]\nP = [1.0]", "cost.P: has 1 entries"),
    ("R = [1.0]", "R = [1.0]\nP = [-1.0, 1.0]", "cost.P: is not positive semidefinite"),
    ("R = [1.0]", "R = [1.0]\nP = [[1.0, 2.0, 3.0], [0.0, 1.0, 2.0]]", "cost.P: shape"),
    ("R = [1.0]", "R = [1.0]\nrho = -1", "cost.rho"),
    ("R = [1.0]", 'R = [1.0]\nrho = "1000"', "cost.rho"),
    ("R = [1.0]", "R = [1.0]\nrho = true", "cost.rho"),
    ("horizon = 3", "horizon = 0", "mpc.horizon"),
    ("horizon = 3", "horizon = -1", "mpc.horizon"),
    ("horizon = 3", "horizon = 3.0", "mpc.horizon"),
    ("horizon = 3", 'horizon = "3"', "mpc.horizon"),
    ("horizon = 3", "horizon = true", "mpc.horizon"),
    ("horizon = 3", "horizon = [3]", "mpc.horizon"),
    ("horizon = 3", "horizon = 1000000", "mpc.horizon: needs .*TB of memory"),
    ("horizon = 3", "horizon = 1" + "0" * 30, "mpc.horizon: .*less than or equal"),
    ("horizon = 3", "", "mpc.horizon is missing"),
    ("horizon = 3", 'horizon = 3\nterminal = "set"', "mpc.terminal"),
    ("horizon = 3", "horizon = 3\nterminal = true", "mpc.terminal"),
    ("horizon = 3", "horizon = 3\nconstrain_initial = 0", "mpc.constrain_initial"),
    ("horizon = 3", 'horizon = 3\nconstrain_initial = "no"', "mpc.constrain_initial"),
    ("horizon = 3", "horizon = 3\ncontrol_horizon = 4", "mpc.control_horizon: 4 moves in 3"),
    ("horizon = 3", "horizon = 3\ncontrol_horizon = 1.5", "mpc.control_horizon"),
    ("horizon = 3", "horizon = 3\nH_f = [[1.0, 0.0]]", "mpc.H_f: H_f and h_f go together"),
    ("horizon = 3", "horizon = 3\nH_f = [[1.0]]\nh_f = [1.0]", "mpc.H_f: shape"),
    (
        "horizon = 3",
        "horizon = 3\nH_f = [[1.0, 0.0], [-1.0, 0.0]]\nh_f = [-1.0, -1.0]",
        "mpc.H_f: is empty",
    ),
    ("horizon = 3", "horizon = 3\nP_f = [[1.0]]\nlevel_f = 1.0", "mpc.P_f: shape"),
    ("horizon = 3", "horizon = 3\nP_f = [[1.0, 0], [0, -1.0]]\nlevel_f = 1.0", "mpc.P_f: is not"),
    ("horizon = 3", "horizon = 3\nP_f = [[1.0, 0], [0, 1.0]]\nlevel_f = 0", "mpc.level_f"),
    ("grid = [3, 4]", "grid = []", "sweep.grid"),
    ("grid = [3, 4]", "grid = [3]", "sweep.grid: has 1 entries where 2"),
    ("grid = [3, 4]", "grid = [3, 1]", "sweep.grid"),
    ("grid = [3, 4]", "grid = [3, 4.0]", "sweep.grid"),
    ("grid = [3, 4]", "grid = [3, true]", "sweep.grid"),
    ("grid = [3, 4]", 'grid = ["3", "4"]', "sweep.grid"),
    ("grid = [3, 4]", "grid = 3", "sweep.grid"),
    ("grid = [3, 4]", "grid = [1000000, 1000000]", "sweep.grid: needs 12.21 GB of memory, 8 GB"),
    ("grid = [3, 4]", "grid = [3, 1" + "0" * 30 + "]", "sweep.grid"),
    ("grid = [3, 4]", "lower = [1.0, 1.0]\nupper = [0.0, 2.0]", "sweep.lower: entry 0 is 1"),
    ("grid = [3, 4]", "lower = [9.0, 9.0]", "sweep.lower.*not below upper"),
    ("grid = [3, 4]", 'lower = ["a", "b"]', "sweep.lower"),
    ("grid = [3, 4]", "lower = [inf, 0.0]", "sweep.lower"),
    ("grid = [3, 4]", "axes = ['w', 'p']", "no state 'w'. States are p, v, 0, 1"),
    ("grid = [3, 4]", "axes = ['p', 0]", "repeats"),
    ("grid = [3, 4]", "axes = [0, 2]", "no state 2"),
    ("grid = [3, 4]", "axes = [true, false]", "sweep.axes"),
    ("grid = [3, 4]", "axes = [0.0, 1.0]", "sweep.axes"),
    ("grid = [3, 4]", "axes = 'p'", "sweep.axes"),
    ("grid = [3, 4]", "axes = []", "sweep.axes"),
    ("grid = [3, 4]", "axes = ['p']\ngrid = [3]", "sweep.fixed: 2 states, 1 mapped"),
    ("grid = [3, 4]", "projection = true", "sweep.projection: true, and all 2 states are mapped"),
    ("grid = [3, 4]", "projection = 1", "sweep.projection"),
    ("grid = [3, 4]", 'projection = "yes"', "sweep.projection"),
    ("grid = [3, 4]", "fixed = [1.0]", "sweep.fixed: has 1 entries where 0"),
    ("grid = [3, 4]", "iterations = 1e12", "sweep.iterations"),
    ("grid = [3, 4]", "iterations = 1000000000000", "sweep.iterations: .*less than or equal"),
    ("grid = [3, 4]", "iterations = 0", "sweep.iterations"),
    ("grid = [3, 4]", "iterations = true", "sweep.iterations"),
    ("grid = [3, 4]", 'dtype = "float16"', "sweep.dtype"),
    ("grid = [3, 4]", "dtype = 32", "sweep.dtype"),
    ("[sweep]", "[solver]\nalpha = 2.0\n[sweep]", "solver.alpha"),
    ("[sweep]", "[solver]\niterations = 1e12\n[sweep]", "solver.iterations"),
    ("[sweep]", "[solver]\nrho = true\n[sweep]", "solver.rho"),
    ("[sweep]", '[solver]\nrho = "1"\n[sweep]', "solver.rho"),
    ("[sweep]", "[solver]\nnewton_steps = -1\n[sweep]", "solver.newton_steps"),
    ("[sweep]", "[recursion]\nsteps = 1e12\n[sweep]", "recursion.steps"),
    ("[sweep]", '[recursion]\nseconds = "60"\n[sweep]', "recursion.seconds"),
    ("[sweep]", "[recursion]\nregions = true\n[sweep]", "recursion.regions"),
    # Names of keys and sections.
    ("horizon = 3", "horizont = 3", r"unknown key 'horizont' in \[mpc\]. Did you mean horizon"),
    ("x_min =", "xmin =", r"unknown key 'xmin' in \[limits\]. Did you mean x_min\?"),
    ("dt = 1.0", "dt = 1.0\nT = 1.0", r"unknown key 'T' in \[system\]. Keys allowed there"),
    ("horizon = 3", "horizon = 3\nx_max = [1]", r"'x_max' in \[mpc\]. It belongs to \[limits\]"),
    ("[cost]", "[costs]", "unknown key 'costs' in the top of the file. Did you mean cost"),
    ("[sweep]", "[Sweep]", "unknown key 'Sweep'"),
    ('name = "case"', "horizon = 3", r"'horizon' in the top.*It belongs to \[mpc\]"),
    ('name = "case"', "name = 3", "name: 3 where a text is needed"),
    ('name = "case"', 'origin = "x"', "unknown key 'origin'"),
    ("[mpc]\nhorizon = 3", "", "mpc is missing"),
    ("[mpc]\nhorizon = 3", "[[mpc]]\nhorizon = 3", "mpc: is no section. Write"),
    ("[sweep]\ngrid = [3, 4]", "[sweep.grid]", "sweep.grid"),
    ('name = "case"', "sweep = 3\nname = 'a'", "is no TOML"),
    # What is no TOML.
    ("[system]", "[system", "is no TOML"),
    ("dt = 1.0", "dt = 1.0\ndt = 2.0", "is no TOML .* Leave one out"),
    ("dt = 1.0", "dt =", "is no TOML"),
    ("dt = 1.0", "dt = 1,0", "is no TOML"),
    ("dt = 1.0", "dt = True", "is no TOML"),
    ("dt = 1.0", "dt = .1", "is no TOML .* Numbers begin with a digit"),
    ("dt = 1.0", "dt: 1.0", "is no TOML"),
    ("[mpc]", "[mpc]\n\0", "is no TOML"),
    ("grid = [3, 4]", "grid = " + "[" * 5000 + "]" * 5000, "case.toml: is nested too deeply"),
    ("[sweep]", "[sweep]\n[" + ".".join("a" * 3000) + "]", "case.toml: "),
]


@pytest.mark.parametrize(("old", "new", "message"), KEYS, ids=range(len(KEYS)))
def test_bad_keys_are_named_with_their_file(old, new, message, refused, tmp_path, monkeypatch):
    monkeypatch.setattr(checks, "available_memory", lambda: 8e9)
    assert old in FILE
    (tmp_path / "case.toml").write_text(FILE.replace(old, new, 1))
    answer = refused("sweep --config case.toml")
    assert answer.startswith("jaxmpc: error: case.toml: ")
    assert re.search(message, answer), answer


# Bytes of a file, and a part of the answer.
BYTES = [
    (b"", "system is missing"),
    (b"\xff\xfe\x00", "is no TOML"),
    (b"\xef\xbb\xbf", "system is missing"),
    (b"{}", "is no TOML"),
    (b"\x80abc", "is no TOML"),
    (b"[system]\nA = [[1]]\n", "is missing"),
]


@pytest.mark.parametrize(("content", "message"), BYTES)
def test_bad_files_are_named(content, message, refused, tmp_path):
    (tmp_path / "case.toml").write_bytes(content)
    answer = refused("sweep --config case.toml")
    assert answer.startswith("jaxmpc: error: case.toml: ") and message in answer


def test_a_byte_order_mark_is_accepted(refused, tmp_path):
    (tmp_path / "case.toml").write_bytes(b"\xef\xbb\xbf" + FILE.encode())
    assert "horizon" in refused("sweep --config case.toml --horizon 0")


LINES = [
    # Commands.
    (
        "",
        "no command given. There are init, sweep, recursion, info, simulate, verify, export, ",
    ),
    ("swep", "no command 'swep'. Did you mean sweep?"),
    ("Sweep", "no command 'Sweep'"),
    ("--horizon 3", "no command '--horizon'"),
    ("--versoin", "no command '--versoin'"),
    ("help", "no command 'help'"),
    ("''", "no command ''"),
    ("tune", "jaxmpc tune: no command given. There are weights, solver"),
    ("tune wights", "no command 'wights'. Did you mean weights?"),
    ("tune --help-me", "no command '--help-me'"),
    ("--tyro-print-completion", "no command '--tyro-print-completion'"),
    ("--tyro-print-completion dash", "Shell should be one"),
    ("--tyro-write-completion bash absent/file", "No such file"),
    ("sweep --tyro-print-completion dash", "Shell should be one"),
    # Options that there are not.
    ("sweep --horizont 3", "--horizont: no such option. Did you mean --horizon?"),
    ("sweep --horizont=3", "--horizont=3: no such option. Did you mean --horizon?"),
    ("sweep --hor 3", "--hor: no such option"),
    ("sweep --no-refin", "--no-refin: no such option. Did you mean --no-refine?"),
    ("sweep --no-resume", "--no-resume: no such option"),
    ("sweep -x", "-x: no such option"),
    ("sweep 5", "5: belongs to no option"),
    ("sweep a.toml", "a.toml: belongs to no option. Write --config a.toml."),
    ("init a.toml", "a.toml: belongs to no option. Write --output a.toml."),
    ("sweep --overwrite yes", "yes: belongs to no option"),
    ("sweep --refine 3", "3: belongs to no option"),
    ("sweep --horizon 3 4", "4: belongs to no option"),
    ("sweep --help-me", "--help-me: no such option"),
    ("sweep sweep", "sweep: belongs to no option"),
    ("sweep -- --horizon", "sweep --help"),
    ("recursion --step 3", "--step: no such option. Did you mean --steps?"),
    ("info --output a", "--output: no such option"),
    ("info --loop 3", "Did you mean --loops?"),
    ("simulate --robots arm2", "Did you mean --robot?"),
    ("simulate --masses 1", "--masses: no such option"),
    ("tune weights --update 3", "Did you mean --updates?"),
    ("tune solver --stage 3", "Did you mean --stages?"),
    # Values that are none.
    ("sweep --horizon", "--horizon: no value. Give a whole number; see jaxmpc sweep --help"),
    ("sweep --horizon x", "--horizon: x. Give a whole number"),
    ("sweep --horizon 1.5", "--horizon: 1.5. Give a whole number"),
    ("sweep --horizon=", "--horizon: no value. Give a whole number"),
    ("sweep --horizon 1e3", "--horizon: 1e3. Give a whole number"),
    ("sweep --horizon True", "--horizon: True. Give a whole number"),
    ("sweep --horizon 0", "command line: --horizon: "),
    ("sweep --horizon -3", "command line: --horizon: "),
    ("sweep --horizon 1000000", "command line: --horizon: needs 64 TB of memory"),
    ("sweep --horizon 1000000000", "command line: --horizon: needs "),
    (f"sweep --horizon 1{'0' * 30}", "command line: --horizon: "),
    (f"sweep --horizon 1{'0' * 5000}", "--horizon: "),
    ("sweep --grid", "command line: --grid: "),
    ("sweep --grid 1.5 2", "--grid: 1.5 2. Give whole numbers"),
    ("sweep --grid 5,6", "--grid: 5,6. Give whole numbers"),
    ("sweep --grid 5x6", "--grid: 5x6. Give whole numbers"),
    ("sweep --grid 5", "command line: --grid: has 1 entries where 2 are needed"),
    ("sweep --grid 5 5 5", "command line: --grid: has 3 entries"),
    ("sweep --grid 1 5", "command line: --grid: "),
    ("sweep --grid -5 5", "command line: --grid: "),
    ("sweep --grid 1000000 1000000", "command line: --grid: needs 12.22 GB of memory, 8 GB are"),
    ("sweep --grid 1000000000 1000000000", "command line: --grid: needs "),
    ("sweep --lower x y", "--lower: x y. Give numbers"),
    ("sweep --lower 1 0 --upper -1 0", "command line: --lower: entry 0 is 1"),
    ("sweep --lower nan 0", "command line: --lower: "),
    ("sweep --lower -inf 0", "command line: --lower: "),
    ("sweep --lower 1", "command line: --lower: has 1 entries"),
    ("sweep --upper 1e400 1", "command line: --upper: "),
    ("sweep --axes q w", "command line: --axes: no state 'w'. States are q, dq"),
    ("sweep --axes", "command line: --axes: "),
    ("sweep --axes q q", "command line: --axes: "),
    ("sweep --axes -1 0", "command line: --axes: no state '-1'"),
    ("sweep --axes q --grid 5", "sweep.fixed: 2 states, 1 mapped"),
    ("sweep --axes q --grid 5 --fixed 0 --projection", "command line: --fixed: fixed and"),
    ("sweep --fixed 1", "command line: --fixed: has 1 entries where 0"),
    ("sweep --fixed a", "--fixed: a. Give numbers"),
    ("sweep --projection", "command line: --projection: true, and all 2 states are mapped"),
    ("sweep --iterations 0", "command line: --iterations: "),
    ("sweep --iterations 1000000000000", "command line: --iterations: "),
    ("sweep --iterations many", "--iterations: many. Give a whole number"),
    ("sweep --dtype float16", "--dtype: float16. Give one of float32, float64"),
    ("sweep --dtype", "--dtype: no value. Give one of float32, float64"),
    ("sweep --terminal set", "--terminal: set. Give one of none, invariant, ellipsoid, box"),
    ("sweep --terminal", "--terminal: no value"),
    ("sweep --seconds 3", "--seconds: given without --robot"),
    ("sweep --seconds three", "--seconds: three. Give a number"),
    ("sweep --config", "--config: no value. Give a path"),
    ("sweep --config absent.toml", "absent.toml: cannot be read"),
    ("sweep --config .", "cannot be read"),
    ("sweep --config ''", "--config: no value. Give a path"),
    ("sweep --output file/below", "--output file/below"),
    ("sweep --output file", "--output file"),
    ("sweep --output /proc/none", "--output /proc/none"),
    ("sweep --resume --overwrite", "Choose one"),
    ("sweep --robot nothing", "model: 'nothing' is no file"),
    ("sweep --robot", "--robot: no value"),
    ("sweep --robot joint --projection", "--projection: given beside --robot joint"),
    ("sweep --robot joint --config a.toml", "--config: given beside --robot joint"),
    ("sweep --robot joint --grid 5", "--grid: has 1 entries where 2"),
    ("sweep --robot joint --grid 30000 30000", "grid: needs 28.8 GB of memory"),
    ("sweep --robot joint --axes w", "no coordinate 'w'"),
    ("sweep --robot joint --seconds -1", "--seconds: -1.0. Give a positive number"),
    ("sweep --robot joint --horizon 0", "--horizon: 0"),
    ("sweep --robot joint --terminal ellipsoid", "--terminal: ellipsoid"),
    ("sweep --robot joint --fixed 1", "--fixed: has 1 entries where 0"),
    ("recursion --horizon 0", "command line: --horizon: "),
    ("recursion --horizon 1000000", "command line: --horizon: needs 64 TB of memory"),
    ("recursion --grid 5", "command line: --grid: has 1 entries where 2"),
    ("recursion --grid 30000 30000", "command line: --grid: needs "),
    ("recursion --lower 1 0 --upper -1 0", "command line: --lower: entry 0"),
    ("recursion --steps 0", "command line: --steps: "),
    ("recursion --steps 1000000000000", "command line: --steps: "),
    ("recursion --steps 2.5", "--steps: 2.5. Give a whole number"),
    ("recursion --regions -1", "command line: --regions: "),
    ("recursion --seconds 0", "--seconds: 0.0. Give a positive number"),
    ("recursion --seconds nan", "--seconds: nan. Give a positive number"),
    ("recursion --seconds inf", "--seconds: inf. Give a positive number"),
    ("recursion --smallest 0", "--smallest: 0"),
    ("export --iterations 0", "--iterations: 0"),
    ("export --plans -1", "--plans: -1"),
    ("export --tolerance 0", "--tolerance: 0.0"),
    ("export --name 1st", "name: '1st'"),
    ("export --horizon 0", "--horizon: "),
    ("export --config nowhere", "nowhere"),
    ("export --output file", "file"),
    ("verify", "jaxmpc verify: no directory given. Name it after the command"),
    ("report", "jaxmpc report: no folder given"),
    ("verify nowhere", "nowhere: holds no labels"),
    ("verify file --sample -1", "--sample: -1"),
    ("verify file --sample 1.5", "--sample: 1.5"),
    ("verify file --exct", "--exct: no such option. Did you mean --exact?"),
    ("verify a b", "b"),
    ("recursion --smallest 1000000", "--smallest: needs "),
    ("recursion --axes q", "--axes: given without --robot"),
    ("recursion --fixed 1", "--fixed: given without --robot"),
    ("recursion --resume", "--resume: given without --robot"),
    ("recursion --output file/below", "--output file/below"),
    ("recursion --robot joint --regions 5", "--regions: given beside --robot joint"),
    ("recursion --robot joint --smallest 5", "--smallest: given beside --robot joint"),
    ("recursion --robot joint --steps 0", "--steps: 0"),
    ("info --horizon 0", "command line: --horizon: "),
    ("info --steps 0", "--steps: 0. Give a whole number, at least 2"),
    ("info --steps 1", "--steps: 1. Give a whole number, at least 2"),
    ("info --steps x", "--steps: x. Give a whole number"),
    ("info --loops 0", "--loops: 0"),
    ("info --html .", "--html .: is a folder. Name a file in it"),
    ("info --html file", "--html file: exists and is no .html file. Name another one"),
    ("info --seconds 0", "--seconds: 0.0"),
    ("info --seconds soon", "--seconds: soon. Give a number"),
    ("info --horizon 1000000", "command line: --horizon: needs "),
    ("info --terminal", "--terminal: no value"),
    ("simulate --robot nothing", "model: 'nothing' is no file"),
    ("simulate --robot file", "file"),
    ("simulate --count 0", "--count: 0"),
    ("simulate --count x", "--count: x. Give a whole number"),
    ("simulate --count 1000000000000", "--count: 1000000000000. Give at most 2147483647"),
    ("simulate --count 2000000000", "--count, --seconds: needs "),
    ("simulate --seconds 0", "--seconds: 0.0. Give a positive number"),
    ("simulate --seconds inf", "--seconds: inf"),
    ("simulate --seconds 1e12", "--count, --seconds: needs "),
    ("simulate --seconds 1e300", "--count, --seconds: needs "),
    ("simulate --target 1 2 3", "--target: has 3 numbers. joint needs 1"),
    ("simulate --target nan", "--target: "),
    ("simulate --target a", "--target: a. Give numbers"),
    ("simulate --state-weights 1", "--state-weights: has 1 numbers"),
    ("simulate --input-weights 1 2", "--input-weights: has 2 numbers"),
    ("simulate --input-weights -1", "--input-weights: -1.0. Give finite positive numbers"),
    ("simulate --state-weights -1 1", "--state-weights: -1.0"),
    ("simulate --horizon 1000000", "--horizon: needs "),
    ("simulate --spread 2", "--spread: 2.0. Give a fraction from 0 to 1"),
    ("simulate --spread nan", "--spread: nan"),
    ("simulate --seed -1", "--seed: -1"),
    ("simulate --seed 1.5", "--seed: 1.5. Give a whole number"),
    ("simulate --linearize here", "--linearize: here. Give one of set-point"),
    ("simulate --horizon 0", "--horizon: 0"),
    ("simulate --horizon 1000000000000", "--horizon: 1000000000000. Give at most"),
    ("simulate --margin 1", "--margin: 1.0"),
    ("simulate --rho 0", "--rho: 0.0"),
    ("simulate --iterations -1", "--iterations: -1"),
    ("simulate --iterations 1000000000000", "--iterations: 1000000000000. Give at most"),
    ("simulate --newton-steps -1", "--newton-steps: -1"),
    ("simulate --mass 1", "--mass: 1.0"),
    ("simulate --damping -0.1", "--damping: -0.1"),
    ("simulate --payload -1", "--payload: -1.0. Give a mass"),
    ("simulate --payload inf", "--payload: inf"),
    ("simulate --tolerance 0", "--tolerance: 0.0"),
    ("simulate --dtype double", "--dtype: double. Give one of float32, float64"),
    ("simulate --chunk 0", "--chunk: 0"),
    ("simulate --devices 99", "--devices: 99 where this process has"),
    ("sweep --devices 0", "--devices: 0. Give a whole number of at least 1"),
    ("sweep --robot joint --devices 0", "--devices: 0. Give a whole number of at least 1"),
    ("simulate --video -1", "--video: -1"),
    ("simulate --config absent.toml", "absent.toml: cannot be read"),
    ("simulate --resume --overwrite", "Choose one"),
    ("tune weights --tune", "--tune: nothing. Name each quantity once"),
    ("tune weights --tune Q S", "--tune: Q S. Give one of Q, R, P, rho, tightening"),
    ("tune weights --tune Q Q", "--tune: Q Q. Name each quantity once"),
    ("tune weights --tune rho", "--tune rho: the problem has no soft limits"),
    ("tune weights --weights round", "--weights: round. Give one of diagonal, full"),
    ("tune weights --updates -1", "--updates: -1"),
    ("tune weights --updates 1000000000000", "--updates: 1000000000000. Give at most"),
    ("tune weights --count 1", "--count: 1"),
    ("tune weights --batch 0", "--batch: 0"),
    ("tune weights --validation 0", "--validation: 0.0"),
    ("tune weights --validation 1", "--validation: 1.0"),
    ("tune weights --steps 0", "--steps: 0"),
    ("tune weights --steps 3 --seconds 1", "--seconds: given beside --steps"),
    ("tune weights --seconds 0", "--seconds: 0.0"),
    ("tune weights --seconds 1e300", "--seconds: 1e+300. Give at most"),
    ("tune weights --count 2000000000", "--count, --steps: needs "),
    ("tune weights --robot joint --count 2000000000", "--count, --steps: needs "),
    ("tune weights --optimizer adem", "--optimizer: 'adem' is no optimizer"),
    ("tune weights --learning-rate 0", "--learning-rate: 0.0"),
    ("tune weights --mode sideways", "--mode: sideways. Give one of auto, forward, reverse"),
    ("tune weights --tracking 1", "--tracking: has 1 numbers"),
    ("tune weights --effort 1 2", "--effort: has 2 numbers"),
    ("tune weights --violation -1", "--violation: -1.0"),
    ("tune weights --settling nan", "--settling: nan"),
    ("tune weights --tolerance 0", "--tolerance: 0.0"),
    ("tune weights --lower 1", "--lower: has 1 numbers"),
    ("tune weights --lower 1 1 --upper 0 0", "--lower: [1.0, 1.0] not below upper"),
    ("tune weights --spread 2", "--spread: 2.0"),
    ("tune weights --margin 1", "--margin: 1.0"),
    ("tune weights --mass 0.1", "--mass: given without --robot"),
    ("tune weights --target 1", "--target: given without --robot"),
    ("tune weights --robot joint --terminal box", "--terminal: given beside --robot joint"),
    ("tune weights --robot joint --target 1 2", "--target: has 2 numbers"),
    ("tune weights --config absent.toml", "absent.toml: cannot be read"),
    ("tune weights --horizon 0", "command line: --horizon: "),
    ("tune weights --horizon 1000000", "command line: --horizon: needs "),
    ("tune solver --iterations 0", "--iterations: 0"),
    ("tune solver --iterations 10 --stages 3", "--iterations: 10 for 3 stages"),
    ("tune solver --iterations 1000000000000", "--iterations: 1000000000000. Give at most"),
    ("tune solver --groups all", "--groups: all. Give one of step, row"),
    ("tune solver --count 3", "--count: 3"),
    ("tune solver --count 2000000000", "--count: needs 32 GB of memory"),
    ("tune solver --learning-rate 0.1", "--learning-rate: given without --optimizer"),
    ("tune solver --optimizer none", "--optimizer: 'none' is no optimizer"),
    ("tune solver --validation 2", "--validation: 2.0"),
    ("tune solver --lower 9 9", "--lower: [9.0, 9.0] not below upper"),
    ("tune solver --resume --overwrite", "Choose one"),
]


@pytest.mark.parametrize(("line", "message"), LINES, ids=[line[:60] for line, _ in LINES])
def test_bad_command_lines_are_answered_in_one_line(line, message, refused, tmp_path, monkeypatch):
    monkeypatch.setattr(checks, "available_memory", lambda: 8e9)
    (tmp_path / "file").touch()
    assert message in refused(line)


ROBOT_KEYS = [
    ('name = "joint"', "name = 3", "robot.name"),
    ('name = "joint"', 'name = "arm2"', "robot.name: 'arm2', asked is 'joint'"),
    ('name = "joint"', 'name = "joint"\nhorizon = true', "robot.horizon"),
    ('name = "joint"', 'name = "joint"\nhorizon = 1000000000000', "robot.horizon"),
    ('name = "joint"', 'name = "joint"\nmargin = "0"', "robot.margin"),
    ('name = "joint"', 'name = "joint"\nlinearise = "state"', "Did you mean linearize?"),
    ("[robot]", "[robots]", "has no section [robot]"),
    ("[cost]", "[costs]", "unknown key 'costs' in the top of the file. Did you mean cost?"),
    ("Q = [1.0, 1.0]", "Q = [true, 1.0]", "cost.Q"),
    ("Q = [1.0, 1.0]", "Q = [1.0]", "cost.Q: has 1 entries. joint needs 2"),
    ("R = [1.0]", 'R = [1.0]\nP = "Q"', "cost.P"),
    ("R = [1.0]", "R = [1.0]\nrho = 0", "cost.rho"),
]


@pytest.mark.parametrize(("old", "new", "message"), ROBOT_KEYS, ids=range(len(ROBOT_KEYS)))
def test_bad_keys_of_a_robots_file_are_named(old, new, message, refused, tmp_path):
    assert old in ROBOT
    (tmp_path / "robot.toml").write_text(ROBOT.replace(old, new, 1))
    answer = refused("simulate --video 0 --config robot.toml")
    assert message in answer and "robot.toml: " in answer


def test_a_full_disk_is_named_before_the_sweep_starts(refused, monkeypatch):
    usage = type("Usage", (), {"free": 1000})
    monkeypatch.setattr(checks.shutil, "disk_usage", lambda path: usage)
    assert "--output jaxmpc-sweep: needs at least 714.3 kB on disk, 1 kB are free" in refused(
        "sweep"
    )


@pytest.mark.long
@pytest.mark.parametrize("line", ["sweep --horizon 1000000000", "sweep --horizont 3"])
@pytest.mark.first(1)
def test_the_installed_command_does_the_same(line, tmp_path):
    command = [sys.executable, "-m", "jaxmpc", *line.split()]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2 and not done.stdout
    assert done.stderr.startswith("jaxmpc: error: ") and done.stderr.count("\n") == 1


def test_memory_is_what_the_system_says():
    assert 1e8 < checks.available_memory() < 1e15
    units = {0: "0 bytes", 999: "999 bytes", 14.4e9: "14.4 GB", 10**40: "1e+28 TB"}
    for count, text in units.items():
        assert checks.in_units(count) == text
