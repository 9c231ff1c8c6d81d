"""HTML pages of results: whole, without anything from outside, and one line where there is none."""

import html.parser
import json

import numpy as np
import pytest
from matplotlib.figure import Figure

from jaxmpc.app import cli
from jaxmpc.app.commands import report
from jaxmpc.app.plots.style import save


class Reader(html.parser.HTMLParser):
    """The words of a page and the tags that are open at its end."""

    def __init__(self, text):
        super().__init__()
        self.open, self.words, self.sources = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        if tag not in ("meta", "img"):
            self.open.append(tag)
        self.sources += [value for key, value in attributes if key in ("src", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


def folder(path, name="a <b> & joint"):
    """What a command leaves: results, configuration, a picture."""
    results = {
        "name": name,
        "counts": {"feasible": 12, "undecided": 0},
        "volume": 0.123456789,
        "proved": True,
        "config": {"name": name, "mpc": {"horizon": 20, "terminal": None, "P": [[1, 2], [3, 4]]}},
    }
    (path / "summary.json").write_text(json.dumps(results))
    figure = Figure()
    figure.add_subplot().plot(np.arange(3))
    save(figure, path / "map.png")


def test_page_holds_results_configuration_and_pictures(tmp_path, capsys):
    folder(tmp_path)
    assert cli.main(["report", "--json", str(tmp_path)]) == 0
    files = json.loads(capsys.readouterr().out)["summary"]["files"]
    assert files == [str(tmp_path / "report.html")]
    read = Reader((tmp_path / "report.html").read_text())
    words = " ".join(read.words)
    assert read.open == []
    for word in (
        "a <b> & joint",
        "feasible",
        "12",
        "0.123457",
        "yes",
        "horizon",
        "20",
        "1, 2; 3, 4",
    ):
        assert word in words
    assert len(read.sources) == 1 and read.sources[0].startswith("data:image/png;base64,")


@pytest.mark.parametrize("content", [None, "{", "{}"])
def test_folders_without_results(tmp_path, capsys, content):
    if content is not None:
        (tmp_path / "summary.json").write_text(content)
    code = cli.main(["report", str(tmp_path)])
    if content == "{}":
        assert code == 0
    else:
        error = capsys.readouterr().err
        assert code == 2 and len(error.splitlines()) == 1 and "no page of it" in error


def test_text_and_tables_are_escaped():
    read = Reader(
        report.html_page("t<", [report.text("x < y", "a & b"), report.table("c", {"d<": "<e>"})])
    )
    assert read.open == [] and {"x < y", "a & b", "d<", "<e>"} <= set(read.words)


def test_a_picture_has_the_name_of_its_system(tmp_path):
    figure = Figure()
    figure.add_subplot().plot([0, 1], [0, 1])
    figure.axes[0].set_title("Feasible initial states", loc="left")
    save(figure, tmp_path / "a.png", "joint")
    assert figure.axes[0].get_title(loc="left") == "joint: feasible initial states"
    figure.suptitle("Of all panels")
    save(figure, tmp_path / "a.png", "joint")
    assert figure.get_suptitle() == "joint: of all panels"
    assert figure.axes[0].get_title(loc="left") == "joint: feasible initial states"
