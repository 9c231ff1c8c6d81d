"""jaxmpc tune: files and table say what the runs did; a run that is cut off goes on."""

import json
import shlex
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import problems
import pytest
from command_line import error_of, help_page, rows

import jaxmpc as jm
from jaxmpc.app import cli
from jaxmpc.app.commands import tune_solver, tune_weights
from jaxmpc.app.config import load, load_robot_config
from jaxmpc.qp.admm import ADMM
from jaxmpc.tuning import tasks
from jaxmpc.tuning.descent import Descent
from jaxmpc.tuning.result import Interrupted, TuningRun
from jaxmpc.tuning.tasks import feasible_states

# The built-in joint with a horizon that is too short for its terminal weight.
LINE = (
    "--horizon 3 --count 8 --steps 5 --mode forward --iterations 8 --newton-steps 0 --seed 1 "
    "--tracking 1 0.01 --effort 1e-3"
)


pytestmark = pytest.mark.usefixtures("in_empty_folder")


@pytest.fixture
def given_starts(monkeypatch):
    """Spare the compile of the search for infeasible starts."""

    def uniform(mpc, lower, upper, count, seed, limits):
        return np.random.default_rng(seed).uniform(lower, upper, (count, len(lower))), 3

    for module in (tune_weights, tune_solver):
        monkeypatch.setattr(module, "feasible_states", uniform)


def run(line):
    return cli.main(["tune", *shlex.split(line)])


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
@pytest.mark.parametrize(
    ("command", "module", "record"),
    [("weights", tasks, "tuning.json"), ("solver", tune_solver, tune_solver.FILES[0])],
)
def test_a_run_is_kept_until_the_one_that_overwrites_it_has_a_checkpoint(
    command, module, record, error, tmp_path, monkeypatch, given_starts
):
    folder = tmp_path / "out"
    folder.mkdir()
    old = {record: b"{}", "checkpoint.npz": b"1", "tuned.toml": b"", "notes.txt": b"mine"}
    for file, content in old.items():
        (folder / file).write_bytes(content)
    contents = lambda: {path.name: path.read_bytes() for path in folder.iterdir()}

    def stopped(*_, checkpoint, **__):
        assert not checkpoint.exists()
        if made:
            checkpoint.write_bytes(b"2")
        raise error

    monkeypatch.setattr(module, f"tune_{command}", stopped)
    line = f"{command} --count 16 --updates 1 --output out --overwrite"
    made = False
    assert run(line) != 0 and contents() == old
    made = True
    assert run(line) != 0
    found = contents()
    assert found.pop("checkpoint.npz") == b"2" and found.pop(record) != b"{}"
    assert found == {"notes.txt": b"mine"}


@pytest.mark.slow
def test_weights_cut_off_resumed_and_read_back(tmp_path, monkeypatch, capsys, given_starts):
    """Ctrl-C writes what there is; tuned.toml is the problem that was tuned."""
    real = tasks.tune_weights

    def interrupted(*args, **more):
        found = real(*args, **{**more, "updates": 0})
        raise Interrupted(replace(found, history=replace(found.history, interrupted=True)))

    monkeypatch.setattr(tasks, "tune_weights", interrupted)
    assert run(f"weights {LINE} --updates 2 --output 'my runs'") == 130
    out = capsys.readouterr().out
    assert "steps that were done are kept. Go on with:" in out
    assert f"jaxmpc tune weights {LINE} --updates 2 --output 'my runs' --resume" in out
    folder = tmp_path / "my runs"
    files = {"tuning.json", "checkpoint.npz", "tuned.toml", "tuning.png", "before_after.png"}
    assert {path.name for path in folder.iterdir()} == files
    assert json.loads((folder / "tuning.json").read_text())["finished"] is False
    assert run(f"weights {LINE} --output 'my runs'") == 2
    assert "Add --resume" in capsys.readouterr().err
    assert run(f"weights {LINE} --output 'my runs' --resume --count 9") == 2
    assert "count: 8 there, 9 here" in capsys.readouterr().err

    found = []
    monkeypatch.setattr(
        tasks, "tune_weights", lambda *a, **k: found.append(real(*a, **k)) or found[0]
    )
    assert run(f"weights {LINE} --updates 2 --output 'my runs' --resume") == 0
    table = rows(capsys.readouterr().out)
    record = json.loads((folder / "tuning.json").read_text())
    (made,) = found
    assert made.history.steps == 2 and record["finished"] and len(record["loss"]) == 2
    assert record["settings"]["train"] == 6 and record["settings"]["validation"] == 2
    first, best = record["result"]["validation"]
    assert best == min(record["validation"]) < first == record["validation"][0]
    assert table["loss"].split()[:2] == [f"{first:.6g}", f"{best:.6g}"]
    assert table["loss"].endswith(f"{100 * (best / first - 1):+.2f} %")
    assert "3 initial states" in table["starts"] and table["mode"] == "forward"
    assert table["Q dq"].split()[0] == "1" and "rejected" in table["steps"]
    for name in ("tuning.png", "before_after.png"):
        assert (folder / name).read_bytes()[:4] == b"\x89PNG"

    # The file holds the tuned weights, its P = "Q" follows, and other commands take it.
    config = load(folder / "tuned.toml")
    mpc = config.build_mpc()
    np.testing.assert_array_equal(mpc.Q, made.values["Q"])
    np.testing.assert_array_equal(mpc.R, made.values["R"])
    np.testing.assert_array_equal(mpc.terminal_cost, mpc.Q)
    assert mpc.horizon == 3 and not np.array_equal(mpc.Q, load(None).build_mpc().Q)
    same = replace(made.mpc, Q=mpc.Q, R=mpc.R)
    assert jax.tree.structure(replace(same, prestabilise=None)) == jax.tree.structure(mpc)
    for command in ("sweep", "recursion", "info"):
        taken = load(folder / "tuned.toml", {}, command).build_mpc()
        np.testing.assert_array_equal(taken.Q, mpc.Q)
    # The loops after tuning, counted from outside: |q| <= 1.5, |dq| <= 2.
    with jax.enable_x64(True):
        controller = jm.Controller(mpc, ADMM(iterations=8, newton_steps=0))
        x0s = np.random.default_rng(1).uniform([-1.35, -1.8], [1.35, 1.8], (8, 2))[6:]
        plant = jm.LinearPlant(mpc.system, mpc.states, mpc.inputs, name="joint")
        loops = jm.simulate_many(controller, plant, x0s, 5)  # compiled already
    after = record["result"]["after"]
    assert after["unsolved"] == np.mean(loops.status != 1) and after["loops"] == 2
    beyond = (np.abs(loops.states) > [1.5 + 2e-6, 2 + 2e-6]).any(axis=(1, 2))
    assert after["violated"] == np.mean(beyond)


@pytest.mark.slow
def test_penalties_write_a_solver_that_is_read_back(tmp_path, monkeypatch, capsys, given_starts):
    """With learning itself faked: what was learned is what the file says."""
    rho = np.random.default_rng(0).uniform(0.1, 3, (2, 9))
    asked, made = {}, []

    def learn(mpc, x0s, iterations, **more):
        asked.update(more, count=len(x0s), iterations=iterations)
        solver = ADMM(iterations=iterations, rho=rho, alpha=1.7, newton_steps=0)
        blocks = [["input", [0, 1, 2], 1], ["state", [0, 1, 2], 2]]
        before, after = (
            {"solved": solved, "residual": residual, "infeasible": 2.0}
            for solved, residual in ((0.25, 1e-2), (0.5, 1e-6))
        )
        settings = {"blocks": blocks, "given_rho": 0.6}
        given = {"alpha": 1.9}
        found = TuningRun({}, given, before, after, True, settings, lambda _: solver)
        made.append(found)
        return found

    monkeypatch.setattr(tune_solver, "tune_solver", learn)
    Path("target.toml").write_text(problems.MINIMAL_FILE + "[reference]\nstate = [0.5, 0.0]\n")
    assert run("solver --config target.toml --iterations 4 --count 16 --output aim") == 0
    np.testing.assert_array_equal(asked["reference"], [0.5, 0.0])
    capsys.readouterr()
    line = "solver --horizon 3 --iterations 6 --stages 2 --count 16 --updates 1"
    assert run(f"{line} --output out") == 0
    table = rows(capsys.readouterr().out)
    assert table["solved"].split()[:4] == ["25.00", "%", "50.00", "%"]
    assert "5 states drawn" in table["infeasible"] and "passed" in table["safeguard"]
    assert (asked["count"], asked["iterations"], len(asked["validation"])) == (12, 6, 4)
    assert asked["optimizer"] is None and asked["checkpoint"].name == "checkpoint.npz"
    config = load(tmp_path / "out" / "tuned.toml")
    solver = config.build_solver()
    np.testing.assert_array_equal(solver.rho, rho)
    assert (solver.iterations, solver.alpha, solver.newton_steps) == (6, 1.7, 0)
    assert replace(config, solver=None) == load(None, {"horizon": 3})
    record = json.loads((tmp_path / "out" / "solver.json").read_text())
    assert record["finished"] and record["result"]["after"]["solved"] == 0.5
    assert (tmp_path / "out" / "solver.png").read_bytes()[:4] == b"\x89PNG"

    # Ctrl-C: the same files, from the steps that were done.
    ones = np.ones(1)
    numbers = {"solved": np.array([0.25, 0.5]), "residual": np.array([1e-2, 1e-6])}
    history = Descent({}, 1, {}, ones, ones, ones > 0, np.ones(2), {}, numbers, 1.0, True)

    def stopped(*_, **__):
        raise Interrupted(replace(made[0], history=history))

    monkeypatch.setattr(tune_solver, "tune_solver", stopped)
    assert run(f"{line} --output cut") == 130
    assert "--output cut --resume" in capsys.readouterr().out
    np.testing.assert_array_equal(load(tmp_path / "cut" / "tuned.toml").build_solver().rho, rho)
    record = json.loads((tmp_path / "cut" / "solver.json").read_text())
    assert not record["finished"] and record["solved"] == [0.25, 0.5]

    # Where nothing learned is better the words say so.
    default = replace(made[0], improved=False, build=lambda _: ADMM(6, rho=1.0, newton_steps=0))
    monkeypatch.setattr(tune_solver, "tune_solver", lambda *_, **__: default)
    assert run(f"{line} --output kept") == 0
    table = rows(capsys.readouterr().out)
    assert "the default is kept" in table["safeguard"]


def test_starts_are_feasible_and_others_counted():
    """A mass that cannot stop before the wall: infeasible starts are known exactly."""
    system = jm.LinearSystem([[1, 1], [0, 1]], [[0.5], [1]], dt=1.0)
    box = lambda *v: jm.Box(-np.array(v), np.array(v))
    mpc = jm.MPC(system, np.eye(2), np.eye(1), 4, states=box(1.0, 2.0), inputs=box(0.5))
    x0s, dropped = feasible_states(mpc, -np.ones(2), np.ones(2), 40, 0, mpc.states)
    assert x0s.shape == (40, 2) and 0 < dropped < 60
    # One step ahead |q + dq + u/2| <= 1 with |u| <= 0.5: necessary.
    assert np.all(np.abs(x0s.sum(axis=1)) <= 1.25 + 1e-6)
    with pytest.raises(ValueError, match="initial states: 0 of 40 drawn have a plan"):
        feasible_states(mpc, np.array([0.8, 1.6]), np.array([1.0, 2.0]), 4, 0, mpc.states)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("weights --config absent.toml", "absent.toml: cannot be read"),
        ("weights --horizon 0", "--horizon"),
        ("weights --count 1", "--count: 1"),
        ("weights --steps 5 --seconds 1", "--seconds: given beside --steps"),
        ("weights --tune Q Q", "--tune: Q Q"),
        ("weights --tune rho", "no soft limits"),
        ("weights --tune tightening --terminal invariant", "--tune tightening"),
        ("weights --tune tightening --margin 0.6", "--margin: 0.6"),
        ("weights --optimizer chain", "'chain' is no optimizer"),
        ("weights --mode gauss-newton --learning-rate 0.1", "--mode: gauss-newton with an opt"),
        ("weights --optimizer lbfgs", "'lbfgs' is no optimizer"),
        ("weights --learning-rate 0", "--learning-rate: 0"),
        ("weights --tracking 1", "--tracking: has 1 numbers. The problem needs 2"),
        ("weights --tracking -1 1", "--tracking: -1. Give weights of at least 0"),
        ("weights --lower 1 0 --upper -1 0", "--lower: "),
        ("weights --lower nan 0 --upper 1 1", "lower: holds NaN or infinity"),
        ("weights --mass 0.1", "--mass: given without --robot"),
        ("weights --robot arm9", "'arm9' is no file"),
        ("weights --robot joint --terminal box", "--terminal: given beside --robot joint"),
        ("weights --validation 1", "--validation: 1"),
        ("weights --resume --overwrite", "Choose one"),
        ("solver --iterations 10", "--iterations: 10 for 4 stages"),
        ("solver --count 4", "--count: 4"),
        ("solver --learning-rate 0.1", "without --optimizer"),
        ("solver --optimizer sgd --learning-rate -1", "--learning-rate: -1"),
    ],
)
def test_errors_are_one_line_before_any_run(capsys, monkeypatch, given_starts, arguments, message):
    for module, name in ((tasks, "tune_weights"), (tune_solver, "tune_solver")):
        monkeypatch.setattr(module, name, lambda *a, **k: pytest.fail("it started"))
    assert message in error_of(f"tune {arguments}", capsys)


def test_start_without_positive_weight_is_named(tmp_path, capsys, given_starts):
    text = load(None, {"horizon": 3}).to_toml()
    for old, new, options, message in (
        ("Q = [50.0, 1.0]", "Q = [50.0, 0.0]", "", "Q is not positive definite"),
        ("Q = [50.0, 1.0]", "Q = [[2.0, 1.0], [1.0, 2.0]]", "", "Add --weights full"),
        ('P = "Q"', 'P = "none"', "--tune P", "no terminal weight"),
    ):
        assert old in text
        (tmp_path / "case.toml").write_text(text.replace(old, new))
        assert run(f"weights --config case.toml {options}") == 2
        assert message in capsys.readouterr().err


def test_help_is_a_page_a_stranger_can_use(capsys):
    pages = {
        "weights": """config robot tune weights updates count batch validation steps seconds
            optimizer learning-rate mode tracking effort violation settling tolerance lower upper
            spread horizon terminal margin target linearize mass damping payload iterations
            newton-steps dtype seed output resume overwrite""",
        "solver": """config iterations stages groups updates count batch validation optimizer
            learning-rate lower upper horizon terminal seed output resume overwrite""",
    }
    for name, options in pages.items():
        text = help_page(f"tune {name}", capsys, options)
        assert text.count("(default:") >= len(options.split()) - 1
        for word in ("$ jaxmpc tune", "How to read the table", "tuned.toml", "130", "--resume"):
            assert word in text
    assert "solver" in help_page("tune", capsys)


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        "--tune Q R P rho --mass 0.3 --linearize set-point --mode forward",
        "--tune Q R --payload 0.5 --robot arm2 --linearize state --mode reverse",
    ],
)
def test_robots(tmp_path, capsys, arguments):
    robot = "arm2" if "arm2" in arguments else "joint"
    arguments = arguments if "--robot" in arguments else f"--robot joint {arguments}"
    line = f"{arguments} --seconds 0.1 --count 4 --updates 2 --horizon 5 --output out"
    assert run(f"weights {line}") == 0
    table = rows(capsys.readouterr().out)
    assert "compile" in table and "loss" in table
    config = load_robot_config(tmp_path / "out" / "tuned.toml")
    assert (config.robot.name, config.robot.horizon) == (robot, 5)
    simulate = f"simulate --robot {robot} --config out/tuned.toml --count 2 --seconds 0.1 --video 0"
    assert cli.main(shlex.split(simulate)) == 0
    summary = json.loads((tmp_path / "jaxmpc-simulate" / "summary.json").read_text())
    assert summary["config"]["horizon"] == 5
    np.testing.assert_array_equal(summary["config"]["state_weights"], np.asarray(config.cost.Q))
    assert summary["config"]["linearize"] == config.robot.linearize
    other = "arm2" if robot == "joint" else "joint"
    assert (
        cli.main(shlex.split(f"simulate --robot {other} --config out/tuned.toml --output b")) == 2
    )
    assert "robot.name" in capsys.readouterr().err


@pytest.mark.slow
def test_penalties_of_the_joint(tmp_path, capsys):
    line = "solver --horizon 10 --iterations 20 --count 64 --batch 16 --updates 10"
    assert run(line) == 0
    table = rows(capsys.readouterr().out)
    before, after = (float(table["solved"].split()[i]) for i in (0, 2))
    assert after >= before
    config = load(tmp_path / "jaxmpc-solver" / "tuned.toml")
    jm.Controller(config.build_mpc(), config.build_solver())


@pytest.mark.slow
def test_the_first_example_gains_and_a_loss_of_the_controllers_own_says_so(tmp_path, capsys):
    assert run(f"weights --updates 40 --output {tmp_path / 'a'}") == 0
    capsys.readouterr()
    found = json.loads((tmp_path / "a" / "tuning.json").read_text())["result"]
    first, last = found["validation"]
    assert last < 0.7 * first and found["after"]["at_target"] > found["before"]["at_target"]
    assert run(f"weights --updates 0 --settling 0 --output {tmp_path / 'b'}") == 0
    assert "little can be gained" in capsys.readouterr().out


@pytest.mark.long
def test_the_picture_has_residuals_of_the_default():
    """Whose penalty is None."""
    mpc = problems.joint(5)
    given, other = (
        replace(tune_solver.ADMM_ALONE, iterations=20),
        ADMM(iterations=20, newton_steps=0, rho=0.3),
    )
    states = np.array([[0.1, 0.2], [-0.3, 0.1]])
    worst = tune_solver.residuals_of_feasible(mpc, states, (given, other))
    assert np.all(np.isfinite(worst))
    # In parts of their tolerance, they are at most 1 where the table says solved.
    many = np.random.default_rng(0).uniform(-0.4, 0.4, (40, 2))
    status, parts = jm.tuning.solver.largest_residuals(mpc, many, given)
    np.testing.assert_array_equal(parts <= 1, status == jm.Status.SOLVED)
    assert 0 < np.mean(parts <= 1) < 1
    own = replace(given, rho=float(jm.Controller(mpc, given).factor.rho[0, 0]))
    same = tune_solver.residuals_of_feasible(mpc, states, (own, other))
    np.testing.assert_allclose(same, worst, rtol=1e-3, atol=1e-9)
    aimed = tune_solver.residuals_of_feasible(
        mpc, states, (own, other), reference=np.array([9.0, 0])
    )
    assert np.abs(np.log(aimed / worst)).max() > 0.1
