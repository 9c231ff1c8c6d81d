"""The notebooks run from their sources, and what is stored beside these was made from them."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
SOURCES = sorted(FOLDER.glob("[0-9]*.py"))


def test_the_course_is_complete():
    assert [path.stem[:2] for path in SOURCES] == [f"{k:02}" for k in range(11)]


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.stem)
def test_stored_notebook(path):
    """It has the cells of its source, all executed, small, and without an error."""
    stored = path.with_suffix(".ipynb")
    assert stored.stat().st_size < 400_000
    text, cells = path.read_text(), json.loads(stored.read_text())["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert text.count("# %%\n") == len(code) and all(cell["execution_count"] for cell in code)
    # The site has headings in its menus, as text.
    assert not [line for line in text.splitlines() if line.startswith("# #") and "$" in line]
    for cell in code:
        assert "".join(cell["source"]) in text
        assert not [out for out in cell["outputs"] if out["output_type"] == "error"]


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.stem)
def test_asserts_say_which_sentence_no_longer_holds(path):
    nodes = ast.walk(ast.parse(path.read_text()))
    bare = [node.lineno for node in nodes if isinstance(node, ast.Assert) and node.msg is None]
    assert not bare, f"lines without a sentence: {bare}"


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.stem)
def test_source_runs(path, tmp_path):
    made = os.environ | {"MPLBACKEND": "agg"}
    done = subprocess.run(
        [sys.executable, path], cwd=tmp_path, env=made, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
