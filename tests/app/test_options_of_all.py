"""Options that every command takes: --quiet, --json, --format."""

import json

import matplotlib
import pytest
from matplotlib.figure import Figure

from jaxmpc.app import cli
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


def test_help_names_them(capsys):
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    out = capsys.readouterr().out
    assert all(word in out for word in ("--quiet", "--json", "--format"))
