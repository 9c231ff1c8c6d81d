"""The Python of the README and of the pages in docs/ runs as it stands, as these promise."""

import re
from pathlib import Path

import matplotlib
import numpy as np
import pytest

import jaxmpc as jm

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    path for path in sorted((ROOT / "docs").rglob("*.md")) if "```python\n" in path.read_text()
]
# In place of a robot that takes a minute to compile.
INSTEAD = {"docs/how-to/robots.md": ("arm7", "joint")}


def snippets(page):
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), flags=re.DOTALL)


def run(page):
    """Execute the snippets of a page one after the other; return a copy of the names after each."""
    names: dict[str, object] = {}
    after = []
    for text in snippets(page):
        if str(page) in INSTEAD:
            text = text.replace(*INSTEAD[str(page)])
        exec(compile(text, str(page), "exec"), names)
        after.append(dict(names))
    return after


def test_readme(capsys):
    (text,) = snippets("README.md")
    assert len(text.split("import jaxmpc as jm\n\n")[1].splitlines()) <= 10
    assert len((ROOT / "README.md").read_text().splitlines()) <= 150
    fmap = run("README.md")[-1]["fmap"]
    low, high = fmap.volume_bounds()
    assert low <= 1489 / 125 <= high and high - low < 1e-6
    assert fmap.counts()["undecided"] == 0
    assert capsys.readouterr().out.startswith("Solved")


def test_links():
    """Links between pages, and to pictures and folders, lead somewhere."""
    for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]:
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
    text = (ROOT / "README.md").read_text()
    for target in re.findall(r"`((?:docs|notebooks|experiments)/[^`\s]*)`", text):
        assert (ROOT / target).exists(), target


def test_architecture_names_every_file_of_a_room():
    page = (ROOT / "docs/architecture.md").read_text()
    for room, text in re.findall(r"^\| `([a-z_/]+)` \| (.*) \|$", page, re.M):
        files = {path.stem for path in (ROOT / "jaxmpc" / room).glob("*.py")} - {"__init__"}
        names = set(re.findall(r"`(\w+)`", text))
        assert files <= names, (room, files - names)
        folders = {path.name for path in (ROOT / "jaxmpc" / room).iterdir()} | {"feasible"}
        assert names <= files | folders, (room, names - files)


def test_names_at_the_top_level():
    """The pages of the reference say which of their names are there, their index all of them."""
    table = re.findall(
        r"^\| \[.*\|([^|]*)\|$", (ROOT / "docs/reference/index.md").read_text(), re.M
    )
    listed = re.findall(r"`(\w+)`", " ".join(table))
    rooms = {path.name for path in (ROOT / "jaxmpc").iterdir() if path.is_dir()}
    assert sorted(listed) == sorted(set(jm.__all__) - rooms)
    for page in sorted((ROOT / "docs/reference").glob("*.md")):
        text = page.read_text().partition("also at the top level")
        if text[1] and page.stem != "index":
            names = re.findall(r"`jm\.([\w.]+)`", text[0])
            assert names and set(names) <= set(jm.__all__), page.name


@pytest.mark.slow
def test_nonlinear(capsys):
    names = run("docs/how-to/nonlinear.md")[0]
    assert names["plan"].status == jm.Status.SOLVED
    distance = np.hypot(names["plan"].states[1:, 0] - 1.5, names["plan"].states[1:, 1])
    assert abs(distance.min() - 0.5) < 1e-4
    assert "quadratic programs" in capsys.readouterr().out


def holds_robots(after, said):
    """With the robot that compiles fastest."""
    first, last = after[0]["run"], after[-1]["run"]
    assert first.states.shape == (64, 101, 2)
    assert first.violation.max() == 0 and not first.fallback.any()
    assert abs(first.states[:, -1]).max() < 1e-2
    assert last.estimates.shape == (64, 100, 2) and (last.status == 1).mean() > 0.99
    assert abs(last.states[:, -1]).max() < 0.05


def holds_tuning(after, said):
    """The loss on states set apart falls, without derivatives too, and the penalties learned solve
    them; the front is monotone, and the longer horizon goes on where the shorter one ended."""
    assert after[1]["run"].improvement > 0.01
    assert after[-1]["solver"].rho.shape[0] == 4
    assert after[3]["rough"].improvement > 0.5
    losses = after[4]["trade"].losses
    assert np.all(np.diff(losses[:, 0]) > 0) and np.all(np.diff(losses[:, 1]) < 0)
    assert len(after[5]["run"].starts) == 3
    assert after[6]["run"].before["loss"] < 0.5 * after[5]["run"].before["loss"]


def holds_learning(after, said):
    """The expert's inputs are found; modules have gradients of both their parts."""
    assert after[1]["value"] < 1e-6
    history = after[5]["history"]  # of weights and the model
    assert history[-1] < 0.5 * history[0] and max(history) < 1.01 * history[0]
    theta, network = after[2]["gradient"].theta, after[2]["gradient"].network
    assert all(np.abs(v).max() > 0 for v in (*theta.values(), network.layers[0].weight))
    assert np.abs(after[3]["gradient"]["theta"].get_value()["Q"]).max() > 0
    assert after[4]["states"].shape == (64, 20, 2)
    assert "'inputs.upper': (5,)" in said and after[7]["plans"].inputs.shape == (3, 5, 1)
    assert after[7]["plans"].solved.all()
    assert after[9]["proof"].kept > 0.99 and after[9]["proof"].broken < 1e-3


def holds_theory(after, said):
    """Theorem 1 holds of the design, and the weight it advises is exact."""
    assert "Theorem 1 (recursive feasibility) applies" in said and "weight given is exact" in said
    assert after[-1]["controller"].mpc.soft


def holds_offset_free(after, said):
    """No error under a load on another plant, nor under one that is known ahead."""
    assert abs(after[0]["run"].states[-1, 0] - 1) < 1e-6
    assert abs(after[1]["run"].states[:, 0]).max() < 1e-5
    assert "'infeasible': 0" not in said


HOLDS = {
    "docs/how-to/learning.md": holds_learning,
    "docs/how-to/offset-free.md": holds_offset_free,
    "docs/how-to/robots.md": holds_robots,
    "docs/how-to/tuning.md": holds_tuning,
    "docs/theory/index.md": holds_theory,
}


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("page", [str(p.relative_to(ROOT)) for p in PAGES])
def test_page(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    matplotlib.use("agg")
    after = run(page)
    HOLDS.get(page, lambda after, said: None)(after, capsys.readouterr().out)
