"""Pages of the site made of notebooks, and formulas: docs/hooks.py, which needs the extra docs."""

import importlib
import re
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[1] / "docs"


@pytest.fixture(scope="module")
def hooks():
    pytest.importorskip("mkdocs")
    pytest.importorskip("latex2mathml")
    sys.path.insert(0, str(DOCS))
    try:
        return importlib.import_module("hooks")
    finally:
        sys.path.remove(str(DOCS))


def test_every_formula_is_understood(hooks):
    """No command of LaTeX is left over in the pages."""
    for page in sorted((DOCS / "theory").glob("*.md")):
        for formula in re.findall(r"```math\n(.*?)```", page.read_text(), re.DOTALL):
            made = hooks._kept(formula, "block").strip()
            text = re.sub(r"<[^>]+>", "", hooks.FORMULAS[made])
            assert "\\" not in text and "&amp;" not in text, page
            assert "\t" not in formula, page  # a command that lost its first letters


def test_a_notebook_as_a_page(hooks):
    """Its title, its code, each picture once, and what it prints as text."""
    path = DOCS.parent / "notebooks" / "00_first_plan.ipynb"
    text, pictures = hooks.page_of(path)
    assert text.startswith("# 0. A first plan\n") and "Download this notebook" in text
    assert len(pictures) == text.count("![Picture") == 2
    assert all(data.startswith(b"\x89PNG") for data in pictures.values())
    assert text.count("```python") > 5 and '<pre class="output">' in text
