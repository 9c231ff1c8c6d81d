"""Options that every command takes: --quiet, --json, --format."""

import dataclasses
import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

import jaxmpc as jm
from jaxmpc.app import cli
from jaxmpc.app.commands import info, init, sweep
from jaxmpc.app.options.shared import Everywhere
from jaxmpc.app.plots import plot_body
from jaxmpc.app.plots.maps import finish, new_axes
from jaxmpc.app.plots.style import FEASIBLE, UNDECIDED, save
from jaxmpc.recursion.proofs import Claim
from jaxmpc.verify.stored_map import Verification
from jaxmpc.workflow.offline_checks import NominalLoops, OfflineReport


def test_quiet_prints_errors_alone(tmp_path, capsys):
    path = str(tmp_path / "problem.toml")
    assert cli.main(["init", "--quiet", "--output", path]) == 0
    assert capsys.readouterr() == ("", "")
    assert cli.main(["init", "--output", path, "--quiet"]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("jaxmpc: error: ") and err.count("\n") == 1


def test_json_is_one_object(tmp_path, capsys):
    path = tmp_path / "problem.toml"
    assert cli.main(["--json", "init", "--output", str(path)]) == 0
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert found["command"] == "init" and found["exit_code"] == 0 and err == ""
    assert found["lines"] == [f"{path}: edit it, then jaxmpc sweep --config {path}"]
    assert found["summary"] is None
    assert cli.main(["init", "--json", "--output", str(path)]) == 2
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert found["exit_code"] == 2 and "exists" in found["error"] and found["error"] in err


def test_json_has_the_summary(tmp_path, capsys, monkeypatch):
    """What a command writes, not what lies there from before."""

    def run(self):
        self.output.mkdir()
        (self.output / "summary.json").write_text('{"counts": {"feasible": 3}}')
        print("  feasible  3")

    monkeypatch.setattr(sweep.Sweep, "run", run)
    assert cli.main(["sweep", "--json", "--output", str(tmp_path / "o")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["summary"] == {"counts": {"feasible": 3}} and found["output"] == str(
        tmp_path / "o"
    )


def summary_of(line, capsys, code=0):
    """What a command prints with --json, which is one object, as its `summary`."""
    assert cli.main(["--json", *line.split()]) == code
    found = json.loads(capsys.readouterr().out)
    assert found["command"] == line.split()[0] and found["exit_code"] == code and found["lines"]
    return found["summary"]


def test_json_of_verify_has_the_fields_of_a_verification(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    counts = summary_of("sweep --grid 8 8 --horizon 6 --output map", capsys)["counts"]
    found = summary_of("verify map", capsys)
    assert found.keys() == {"passed"} | {f.name for f in dataclasses.fields(Verification)}
    assert found["passed"] and found["verified"] == 64 and not found["failures"]
    assert found["labels"].items() <= counts.items()
    (tmp_path / "map" / "summary.json").unlink()
    found = summary_of("verify map", capsys, code=1)
    assert not found["passed"] and "is missing" in found["problems"][0]


def test_json_of_info_has_the_fields_of_a_report(capsys):
    """In the time that is given only the first parts; notes say why the others are None."""
    found = summary_of("info --horizon 3 --seconds 1", capsys)
    names = {field.name for field in dataclasses.fields(OfflineReport)} - {"mpc"}
    assert found.keys() == names | {"name"}
    assert found["feasible_set"] is None and "no time was left" in found["notes"]["feasible_set"]
    assert found["loops"] is None and "loops" in found["notes"]
    checks = {check["name"]: check["holds"] for check in found["terminal"]["checks"]}
    assert checks["R positive definite"] is True and checks["control invariance"] is False
    assert "terminal" not in found["notes"]
    # Sizes: 3 inputs; limits of both states and of the input at 3 steps.
    assert (found["variables"], found["rows"]) == (3, 9)


def test_json_of_export_has_files_and_regions(tmp_path, capsys):
    line = f"export --law explicit --horizon 2 --output {tmp_path}"
    found = summary_of(line, capsys)
    assert found["law"] == "explicit" and found["regions"] >= 3
    assert {Path(path) for path in found["files"]} == set(tmp_path.iterdir())


def test_fields_of_the_report_are_those_of_its_parts():
    """The parts that `jaxmpc info --json` leaves out without time."""
    claim = Claim(False, "why", np.ones(2))
    report = SimpleNamespace(
        volume=(1.0, np.inf), variables=1, rows=2, condition=3.0, notes={"penalty": "time"},
        feasible_set=SimpleNamespace(counts=lambda: {"feasible": 4}), penalty=None, terminal=None,
        recursion=SimpleNamespace(
            claims={"law": claim}, loops=SimpleNamespace(counts=lambda: {"kept": 5}),
            volume=1.0, lost_by_any=np.nan, lost_by_law=0.1,
        ),
        loops=NominalLoops(np.zeros((6, 2)), 7, 5, 0.0, 0.0, 0.25, np.zeros(2), 0.5),
        set_point=SimpleNamespace(x=np.zeros(2), u=np.ones(1), drift=0.0, broken=[]),
    )  # fmt: skip
    found = info.record(report)
    assert found["volume"] == {"inner": 1.0, "outer": None}
    assert found["feasible_set"] == {"counts": {"feasible": 4}} and found["notes"] == {
        "penalty": "time"
    }
    assert found["set_point"] == {"x": [0.0, 0.0], "u": [1.0], "drift": 0.0, "broken": []}
    assert found["recursion"]["claims"] == {
        "law": {"holds": False, "reason": "why", "state": [1.0, 1.0]}
    }
    assert found["recursion"]["lost_by_any"] is None and found["recursion"]["lost_by_law"] == 0.1
    assert (found["loops"]["starts"], found["loops"]["increase"]) == (6, 0.25)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("--json sweep --horizon 3", "sweep --json --horizon 3"),
        ("--format pdf tune weights --updates 3", "tune weights --format pdf --updates 3"),
        ("--help sweep", "sweep --help"),
        ("report sweep --json", "report sweep --json"),
        ("--json", "--json"),
        ("--tyro-write-completion bash sweep", "--tyro-write-completion bash sweep"),
        ("", ""),
    ],
)
def test_options_before_the_command_belong_to_it(given, words):
    assert cli.command_first(given.split()) == words.split()


@pytest.mark.parametrize("words", [["--format", "gif"], ["--format=gif"], ["--format"]])
def test_other_formats_are_refused(words, capsys):
    assert cli.main(["init", *words]) == 2
    assert "Give one of pdf, svg, png" in capsys.readouterr().err


def test_pictures_in_another_format(tmp_path, monkeypatch, capsys):
    """Beside PNG, which stays; with another format the one of before goes."""
    monkeypatch.setitem(matplotlib.rcParams, "savefig.format", "png")
    figure, path, written = Figure(), tmp_path / "map.png", []
    monkeypatch.setattr(init.Init, "run", lambda self: written.append(save(figure, path)))
    figure.add_subplot().plot([0, 1], [0, 1])
    figure.axes[0].set_title("Ж", loc="left")
    for name, others in (("pdf", {".pdf"}), ("svg", {".svg"}), ("png", set())):
        assert cli.main(["init", "--format", name]) == 0
        assert {found.suffix for found in tmp_path.iterdir()} == {".png"} | others
        assert sorted(written[-1]) == sorted(map(str, tmp_path.iterdir()))
        if name == "pdf":
            data = path.with_suffix(".pdf").read_bytes()
            assert data.startswith(b"%PDF") and b"/Type3" not in data and b"CIDFontType2" in data
        matplotlib.rcParams["savefig.format"] = "png"


def test_pictures_for_a_column(tmp_path, monkeypatch):
    """As wide as asked, with all of the legend."""
    for key in ("figure.figsize", "font.size", "savefig.format"):
        monkeypatch.setitem(matplotlib.rcParams, key, matplotlib.rcParams[key])
    path = tmp_path / "map.png"

    def run(self):
        ax = new_axes()
        for words in ("line", "a line of which many words are said", "another of as many words"):
            ax.plot([0, 1], [0, 1], label=words)
        finish(ax, ["a [m]", "b [m]"], f"A title\nslice at {', '.join(values)}", ax.lines[:])
        save(ax.figure, path)
        title, legend = ax._left_title, ax.get_legend()
        first, second = title.get_text().splitlines()[:2]
        assert first == "A title" and second.endswith("[rad] = 0.25,")
        for text in (title, legend):
            box = text.get_window_extent()
            assert 0 <= box.x0 and box.x1 <= ax.figure.bbox.x1 and box.y0 >= 0

    values = [f"q{i} [rad] = 0.25" for i in range(1, 6)]
    monkeypatch.setattr(init.Init, "run", run)
    assert cli.main(["init", "--width", "column", "--format", "pdf"]) == 0
    image = plt.imread(path)
    assert image.shape[1] == 3.5 * 150
    assert np.all(image[:3, :, :3] == 1) and np.all(image[-3:, :, :3] == 1)  # nothing is cut off
    assert b"/MediaBox [ 0 0 252 " in path.with_suffix(".pdf").read_bytes()
    assert cli.main(["init", "--width", "poster"]) == 2


@pytest.mark.slow
def test_three_states_are_a_body_and_its_projections():
    """Of a chain of three integrators; each panel shows the extent of the set."""
    chain = jm.LinearSystem([[1, 1, 0], [0, 1, 1], [0, 0, 1.0]], [0, 0, 1.0])
    box = jm.Box([-3, -2, -1], [3, 2, 1])
    mpc = jm.MPC(chain, np.ones(3), 1.0, horizon=1, states=box, inputs=jm.Box(-1, 1))
    fmap = jm.map_feasible_set(mpc, jm.grid([-3, -2, -1], [3, 2, 1], (3, 3, 3))).refine()
    figure = plot_body(fmap)
    assert len(figure.axes) == 4 and figure.axes[0].name == "3d"
    for ax, (i, j) in zip(figure.axes[1:], ((0, 1), (0, 2), (1, 2)), strict=True):
        line = ax.lines[0].get_xydata()
        np.testing.assert_allclose(line.max(axis=0), np.array([3, 2, 1])[[i, j]], atol=1e-6)
    assert figure.axes[0].collections
    for ax in figure.axes[1:]:  # filled to the outer bound, and on top to the inner one
        assert [area.get_facecolor()[:3] for area in ax.patches] == [
            to_rgb(UNDECIDED), to_rgb(FEASIBLE)
        ]  # fmt: skip
    assert figure.legends[0].get_texts()[1].get_text() == "inner bound (100.0% of it)"
    with pytest.raises(ValueError, match="2 states"):
        plot_body(jm.map_feasible_set(mpc, np.zeros((1, 2)), axes=(0, 1), fixed=np.zeros(3)))


def test_help_names_them(capsys):
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    out = capsys.readouterr().out
    assert all(word in out for word in ("--quiet", "--json", "--format"))


COMPLETE = """
source ./script
for command in "" tune {commands}; do
  COMP_WORDS=(jaxmpc $(echo $command | tr / ' ') --); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
  _tyro_jaxmpc; echo "$command:${{COMPREPLY[*]}}"
done
COMP_WORDS=(jaxmpc tune ""); COMP_CWORD=2; _tyro_jaxmpc; echo "words:${{COMPREPLY[*]}}"
COMP_WORDS=(jaxmpc sweep --terminal ""); COMP_CWORD=3; _tyro_jaxmpc; echo "sets:${{COMPREPLY[*]}}"
"""


@pytest.mark.skipif(
    not (shutil.which("bash") and shutil.which("python3")), reason="its script calls python3"
)
def test_each_option_of_each_command_is_completed(tmp_path):
    """By bash itself, with the script that the page of commands tells to make."""
    main = [sys.executable, "-m", "jaxmpc", "--tyro-write-completion", "bash", "script"]
    subprocess.run(main, cwd=tmp_path, check=True)
    kinds = cli.COMMANDS | {f"tune/{name}": kind for name, kind in cli.TUNERS.items()}
    ask = COMPLETE.format(commands=" ".join(kinds))
    said = subprocess.run(["bash", "-c", ask], cwd=tmp_path, capture_output=True, text=True)
    answers = dict(line.split(":", 1) for line in said.stdout.splitlines())
    for name, kind in kinds.items():
        options = {
            f"--{'' if field.default is not True else 'no-'}{field.name.replace('_', '-')}"
            for part in (kind, Everywhere)
            for field in dataclasses.fields(part)
            if field.name not in ("directory", "folder")
        }
        found = answers[name].split()
        assert options <= set(found), name
        assert all(word.startswith("--") for word in found), name
    assert {"weights", "solver"} <= set(answers["words"].split())
    assert {"invariant", "box", "none", "ellipsoid"} == set(answers["sets"].split())


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_scripts_of_other_shells_name_all_options(shell, capsys):
    with pytest.raises(SystemExit):
        cli.main(["--tyro-print-completion", shell])
    out = capsys.readouterr().out
    names = {field.name for kind in cli.COMMANDS.values() for field in dataclasses.fields(kind)}
    for name in names - {"directory", "folder"}:
        assert f"--{name.replace('_', '-')}" in out
    assert "quantity" not in out
