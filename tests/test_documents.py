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
    """Execute the snippets of a page one after the other; return the names they leave."""
    names: dict[str, object] = {}
    for text in snippets(page):
        if str(page) in INSTEAD:
            text = text.replace(*INSTEAD[str(page)])
        exec(compile(text, str(page), "exec"), names)
    return names


def test_readme(capsys):
    (text,) = snippets("README.md")
    assert len(text.split("import jaxmpc as jm\n\n")[1].splitlines()) <= 10
    assert len((ROOT / "README.md").read_text().splitlines()) <= 150
    fmap = run("README.md")["fmap"]
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


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_page(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    matplotlib.use("agg")
    names = run(page.relative_to(ROOT))
    if page.stem == "robots":
        found = names["run"]
        assert found.estimates.shape == (64, 100, 2) and (found.status == 1).mean() > 0.99
        assert abs(found.states[:, -1]).max() < 0.05
    if page.stem == "tuning":
        assert names["run"].improvement > 0.01 and names["solver"].rho.shape[0] == 4
    if page.stem == "nonlinear":
        assert names["plan"].status == jm.Status.SOLVED
        distance = np.hypot(names["plan"].states[1:, 0] - 1.5, names["plan"].states[1:, 1])
        assert abs(distance.min() - 0.5) < 1e-4
