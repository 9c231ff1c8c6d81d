"""Options that every command takes: --quiet, --json, --format."""

import json

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure

import jaxmpc as jm
from jaxmpc.app import cli
from jaxmpc.app.plots import plot_body
from jaxmpc.app.plots.maps import finish, new_axes
from jaxmpc.app.plots.style import save


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
    assert json.loads(out)["exit_code"] == 2 and "exists" in err


def test_json_has_the_summary(tmp_path, capsys, monkeypatch):
    """What a command writes, not what lies there from before."""

    def run(self):
        self.output.mkdir()
        (self.output / "summary.json").write_text('{"counts": {"feasible": 3}}')
        print("  feasible  3")

    verify = cli._class("verify", "Verify")
    command = cli._class("sweep", "Sweep")
    assert not hasattr(verify, "summary")
    monkeypatch.setattr(command, "run", run)
    assert cli.main(["sweep", "--json", "--output", str(tmp_path / "o")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["summary"] == {"counts": {"feasible": 3}} and found["output"] == str(
        tmp_path / "o"
    )


@pytest.mark.parametrize("words", [["--format", "gif"], ["--format=gif"], ["--format"]])
def test_other_formats_are_refused(words, capsys):
    assert cli.main(["init", *words]) == 2
    assert "Give one of pdf, svg, png" in capsys.readouterr().err


def test_pictures_in_another_format(tmp_path, monkeypatch, capsys):
    """Beside PNG, which stays; with another format the one of before goes."""
    monkeypatch.setitem(matplotlib.rcParams, "savefig.format", "png")
    monkeypatch.setattr(cli._class("init", "Init"), "run", lambda self: save(figure, path))
    figure, path = Figure(), tmp_path / "map.png"
    figure.add_subplot().set_title("Ж", loc="left")
    for name, others in (("pdf", {".pdf"}), ("svg", {".svg"}), ("png", set())):
        assert cli.main(["init", "--format", name]) == 0
        assert {found.suffix for found in tmp_path.iterdir()} == {".png"} | others
        if name == "pdf":
            assert path.with_suffix(".pdf").read_bytes().startswith(b"%PDF")
        matplotlib.rcParams["savefig.format"] = "png"


def test_pictures_for_a_column(tmp_path, monkeypatch):
    """As wide as asked, with all of the legend."""
    for key in ("figure.figsize", "font.size", "savefig.format"):
        monkeypatch.setitem(matplotlib.rcParams, key, matplotlib.rcParams[key])
    path = tmp_path / "map.png"

    def run(self):
        ax = new_axes()
        ax.plot([0, 1], [0, 1], label="line")
        finish(ax, ["a [m]", "b [m]"], "A title", ax.lines[:])
        save(ax.figure, path)

    monkeypatch.setattr(cli._class("init", "Init"), "run", run)
    assert cli.main(["init", "--width", "column"]) == 0
    width = plt.imread(path).shape[1] / 150
    assert 3.0 < width < 3.9
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
    with pytest.raises(ValueError, match="2 states"):
        plot_body(jm.map_feasible_set(mpc, np.zeros((1, 2)), axes=(0, 1), fixed=np.zeros(3)))


def test_help_names_them(capsys):
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    out = capsys.readouterr().out
    assert all(word in out for word in ("--quiet", "--json", "--format"))
