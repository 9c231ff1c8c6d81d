"""Few names at the top, all others in namespaces that list themselves, and no result without."""

import functools
import importlib
import inspect
import re
import subprocess
import sys
import types
import typing
from pathlib import Path

import mujoco
import pytest

import jaxmpc as jm

REFERENCE = Path(jm.__file__).parents[1] / "docs" / "reference"
NAMESPACES = tuple(name for name in jm.__all__ if isinstance(getattr(jm, name), types.ModuleType))
TOP = tuple(name for name in jm.__all__ if name not in NAMESPACES)


def public():
    """Every public object by its name."""
    found = {name: getattr(jm, name) for name in TOP}
    for space in NAMESPACES:
        module = getattr(jm, space)
        found |= {f"{space}.{name}": getattr(module, name) for name in module.__all__}
    return found


def test_few_names_at_the_top():
    """What a user needs every day, and the rooms where the rest is."""
    assert len(jm.__all__) <= 48
    assert sorted(jm.__all__) == sorted(set(jm.__all__))
    folders = {folder.parent.name for folder in Path(jm.__file__).parent.glob("*/__init__.py")}
    assert folders - {"app", "store"} <= set(NAMESPACES)


@pytest.mark.parametrize("name", NAMESPACES)
def test_a_namespace_lists_itself(name):
    """Each name is there, and stands in the table of contents."""
    module = getattr(jm, name)
    for entry in module.__all__:
        assert getattr(module, entry) is not None
        assert entry in module.__doc__, f"{entry} is missing in the docstring of {name}"


def test_what_few_need_is_imported_late():
    """By `import jaxmpc` and all its names, and by the command before it knows what to do."""
    late = {"mujoco", "matplotlib", "zarr", "xarray", "pydantic", "PIL"}
    program = f"""import sys, jaxmpc, jaxmpc.app.cli
all(getattr(jaxmpc, name) for name in jaxmpc.__all__)
sys.exit(', '.join({late} & set(sys.modules)))"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stderr.strip() == ""


def test_without_mujoco(monkeypatch, tmp_path):
    """The rest works, and a robot names what to install, in the command too."""
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ImportError, match=r"mujoco is not installed.*-e '.\[robots\]\'"):
        jm.load_robot("joint")
    program = """import sys
sys.modules["mujoco"] = None
import jaxmpc as jm
all(getattr(jm, name) for name in jm.__all__)
from jaxmpc.app.cli import main
sys.exit(main(["simulate", "--robot", "joint"]))"""
    run = functools.partial(subprocess.run, capture_output=True, text=True, cwd=tmp_path)
    done = run([sys.executable, "-c", program])
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert "pip install -e '.[robots]'" in done.stderr


def test_every_public_object_says_what_it_is():
    for name, found in public().items():
        if not isinstance(found, types.ModuleType):
            assert inspect.getdoc(found), name


def returned(found):
    """The functions, methods and properties whose results a user of `found` can get."""
    if not inspect.isclass(found):
        return [found] if callable(found) else []
    members = [member for name, member in vars(found).items() if not name.startswith("_")]
    wrapped = (staticmethod, classmethod)
    plain = [member.__func__ if isinstance(member, wrapped) else member for member in members]
    gotten = (property, functools.cached_property)
    plain = [getattr(m, "fget", None) or m.func if isinstance(m, gotten) else m for m in plain]
    return [member for member in plain if inspect.isfunction(member)]


def classes(annotation):
    """The classes of jaxmpc in an annotation."""
    if inspect.isclass(annotation) and annotation.__module__.startswith("jaxmpc."):
        return {annotation}
    return set().union(*map(classes, typing.get_args(annotation)))


def documented():
    """The classes that the reference describes: results, which no user constructs."""
    pages = "".join(page.read_text() for page in REFERENCE.glob("*.md"))
    found = [name.rsplit(".", 1) for name in re.findall(r"^::: (\S+)$", pages, re.MULTILINE)]
    described = [getattr(importlib.import_module(home), name) for home, name in found]
    return set(filter(inspect.isclass, described))


def test_every_result_is_described():
    """The types that functions, methods and properties return, by their annotations."""
    known = {found for found in public().values() if inspect.isclass(found)} | documented()
    missing = set()
    for name, found in public().items():
        for function in returned(found):
            hints = typing.get_type_hints(inspect.unwrap(function), localns={"mujoco": mujoco})
            missing |= {(name, kind) for kind in classes(hints.get("return")) - known}
    assert (
        sorted(f"{name} -> {kind.__module__}.{kind.__qualname__}" for name, kind in missing) == []
    )
