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
    assert len(jm.__all__) <= 49
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


@pytest.mark.long
def test_what_few_need_is_imported_late():
    """By `import jaxmpc` and all its names, and by the command before it knows what to do."""
    late = {"mujoco", "matplotlib", "zarr", "xarray", "pydantic", "PIL"}
    program = f"""import sys, jaxmpc, jaxmpc.app.cli
all(getattr(jaxmpc, name) for name in jaxmpc.__all__)
sys.exit(', '.join({late} & set(sys.modules)))"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stderr.strip() == ""


@pytest.mark.long
def test_a_function_that_imports_names_is_compiled_once():
    """The names of a user's jitted function may be used in it first, and imported while it is
    traced: nothing of that may change what JAX knows the function's program by."""
    program = """import jax
import jaxmpc as jm
import numpy as np

@jax.jit
def scaled(A):
    jm.MPC, jm.solve, jm.load_robot, jm.simulate, jm.tune_weights, jm.lqr
    return jm.Box([-1.0], [1.0]).upper * A

scaled(np.eye(1))
scaled(np.eye(1))
assert scaled._cache_size() == 1, scaled._cache_size()"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.long
def test_names_are_first_used_in_many_threads_at_once():
    program = """from concurrent.futures import ThreadPoolExecutor
from threading import Barrier
import jaxmpc as jm
names = [*jm.__all__, "app"]
together = Barrier(len(names))

def use(name):
    together.wait()
    return getattr(jm, name) if name != "app" else jm.app.plots

with ThreadPoolExecutor(len(names)) as pool:
    assert all(pool.map(use, names))"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


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
        if name == "feasible.FeasibilityProblem":
            continue  # its properties are what labelling computes with, no results
        for function in returned(found):
            hints = typing.get_type_hints(inspect.unwrap(function), localns={"mujoco": mujoco})
            missing |= {(name, kind) for kind in classes(hints.get("return")) - known}
    assert (
        sorted(f"{name} -> {kind.__module__}.{kind.__qualname__}" for name, kind in missing) == []
    )


def text_of(page):
    return page.read_text(encoding="utf-8")


PAGES = [Path(jm.__file__).parents[1] / "README.md", *REFERENCE.parent.rglob("*.md")]
NAMED = sorted(
    {name for p in PAGES for name in re.findall(r"\bjm((?:\.[a-zA-Z_]+)+)", p.read_text())}
)


def found(path):
    """What a path of attributes of the library leads to; fields without a default lead to None."""
    here = jm
    for part in path.split("."):
        if inspect.isclass(here) and part in getattr(here, "__dataclass_fields__", ()):
            return None
        here = getattr(here, part)
    return here


@pytest.mark.parametrize("name", NAMED)
def test_what_a_page_names_exists(name):
    """`jm.…` of all pages, but for the placeholder."""
    if name != ".NAME":
        found(name[1:])


def test_entries_of_the_reference_are_where_the_reference_says():
    """In the sub-package of their page, or in a module that is public itself."""
    for page in REFERENCE.glob("*.md"):
        for entry in re.findall(r"^::: jaxmpc\.(\S+)$", page.read_text(), re.MULTILINE):
            *homes, name = entry.split(".")
            if homes[-1] in ("tasks", "gymnasium_env"):  # the second needs gymnasium
                continue
            places = {"grids": "feasible", "app": "app.plots"}
            assert found(f"{places.get(homes[0], homes[0])}.{name}") is not None


def test_top_level_names_of_the_reference():
    """The table lists all of them, and the first lines of the pages no others."""
    rows = [line for line in text_of(REFERENCE / "index.md").splitlines() if line.startswith("| [")]
    named = re.findall(r"`(\w+)`", " ".join(row.split("|")[3] for row in rows))
    assert sorted(named) == sorted(TOP)
    for page in REFERENCE.glob("*.md"):
        also = r"((?:`jm\.[\w.]+`(?:,| and)?\s+)+)(?:is|are)\s+also\s+at"
        for said in re.findall(also, text_of(page)):
            assert set(re.findall(r"`jm\.([\w.]+)`", said)) <= set(TOP), page


@pytest.mark.parametrize(
    "room, name, other",
    [
        ("", "boundary", "jm.feasible.boundary"),
        ("", "Plan", "jm.mpc.Plan"),
        ("", "verify_terminl", "jm.sets.verify_terminal"),
        ("", "plot_runs", "jm.app.plots.plot_runs"),
        ("feasible", "solve", "jm.solve"),
        ("qp", "CriticalRegions", "jm.explicit.CriticalRegions"),
    ],
)
def test_a_name_at_another_place(room, name, other):
    space = getattr(jm, room) if room else jm
    with pytest.raises(AttributeError, match=rf"Did you mean {re.escape(other)}\?$"):
        getattr(space, name)
    assert found(other.removeprefix("jm.")) is not None


def test_a_name_at_no_place():
    for space in (jm, *(getattr(jm, name) for name in NAMESPACES)):
        with pytest.raises(AttributeError, match=r"has no attribute 'xyzzy'$"):
            space.xyzzy  # noqa: B018


def test_a_missing_name_imports_nothing():
    program = """import sys, jaxmpc
print(hasattr(jaxmpc, "boundary"), "jax" in sys.modules)"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout == "False False\n"


def test_dir_lists_public_names_alone():
    assert set(dir(jm)) == {"__version__", "app", *jm.__all__}
    assert jm.app.plots.plot_runs is not None


def test_a_wrong_kind_is_told_a_name_that_exists():
    with pytest.raises(ValueError, match=r"critical_regions\(mpc\)"):
        jm.export.export_explicit_c(jm.MPC(jm.LinearSystem([[1]], [[1]]), 1, 1, 2), "law")


def test_signatures_can_be_read():
    """Arguments that take numbers, arrays or lists show one word for these, as in `help`."""
    for name, found in public().items():
        try:
            text = str(inspect.signature(found))
        except (TypeError, ValueError):  # modules, and what is no callable
            continue
        assert "numpy.bool" not in text, f"{name}{text}"
    assert "x0: jaxmpc.arrays.Reals," in str(inspect.signature(jm.solve))
