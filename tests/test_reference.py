"""The reference says of every class and function how it is called, and of every argument what it
means: docs/docstrings.py, which needs the extra docs."""

import importlib
import inspect
import re
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[1] / "docs"
ENTRIES = [
    entry
    for page in sorted((DOCS / "reference").glob("*.md"))
    for entry in re.findall(r"^::: (\S+)$", page.read_text(), re.MULTILINE)
]


@pytest.fixture(scope="module")
def package():
    """The package as the reference shows it."""
    griffe = pytest.importorskip("griffe")
    sys.path.insert(0, str(DOCS))
    try:
        layout = importlib.import_module("docstrings").Layout()
    finally:
        sys.path.remove(str(DOCS))
    extensions = griffe.load_extensions(layout)
    return griffe.load("jaxmpc", search_paths=[DOCS.parent], extensions=extensions)


def shown(package, entry):
    """The names in the signature of an entry, and those in its table with a meaning."""
    found = package[entry.split(".", 1)[1]]
    names = [p.name.lstrip("*") for p in getattr(found, "parameters", ()) if p.name != "self"]
    table = found.docstring.value.split("\nArguments: ", 1) if found.docstring else []
    rows = re.findall(r"^    (\w+): (?=\S)", table[1], re.MULTILINE) if len(table) > 1 else []
    return names, rows


@pytest.mark.long
def test_signatures_are_those_of_python(package):
    """Names and their order, of all that can be called, by another way to find them."""
    for entry in ENTRIES:
        home, name = entry.rsplit(".", 1)
        real = getattr(importlib.import_module(home), name)
        if not callable(real) or package[entry.split(".", 1)[1]].is_attribute:
            continue
        if inspect.isclass(real) and issubclass(real, int):
            continue  # an enumeration
        names, _ = shown(package, entry)
        assert names == list(inspect.signature(real).parameters), entry


def test_every_argument_has_a_meaning(package):
    missing = []
    for entry in ENTRIES:
        names, rows = shown(package, entry)
        missing += [f"{entry}: {name}" for name in names if name not in rows]
    assert not missing, missing
