"""Where public names are: read from the lists `__all__` of the rooms, without importing these."""

import ast
import difflib
import functools
import sys
from importlib import import_module
from pathlib import Path
from threading import RLock
from types import ModuleType
from typing import NoReturn

ROOT = Path(__file__).parent
_importing = RLock()


def imported(module: str) -> ModuleType:
    """Import a module of this package when it is first used, in one thread at a time: modules that
    need each other's would wait for each other in two."""
    with _importing:
        return import_module(module)


@functools.cache
def public_names() -> dict[str, tuple[str, ...]]:
    """Return for each public name the places where it is: "" for the top level, then the rooms."""
    found: dict[str, tuple[str, ...]] = {}
    for file in sorted(ROOT.rglob("__init__.py")):
        place = ".".join(file.parent.relative_to(ROOT).parts)
        if place != "store":  # what is stored, not for users
            for name in _listed(file):
                found[name] = (*found.get(name, ()), place)
    return found


def _listed(file: Path) -> list[str]:
    """Return the list `__all__` of a file."""
    for statement in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(statement, ast.Assign) and ast.unparse(statement.targets[0]) == "__all__":
            return list(ast.literal_eval(statement.value))
    return []


def public_name(name: str) -> str:
    """Return a public name as users write it, such as "jm.Box" or "jm.explicit.Region"; one that is
    not public as it is."""
    places = public_names().get(name)
    return f"jm.{places[0]}.{name}".replace("..", ".") if places else name


def suggest_names(package: str) -> None:
    """Let a package say where a name is that it does not have.

    This is a call, and no `__getattr__` that a type checker sees: to it all names would be there.
    """
    sys.modules[package].__dict__["__getattr__"] = functools.partial(raise_absent, package)


def raise_absent(package: str, name: str) -> NoReturn:
    """Raise AttributeError for a name, and say where else it is, or which one is most like it."""
    known = () if name.startswith("_") else public_names()
    near = [name] if name in known else difflib.get_close_matches(name, known, 1, 0.8)
    hint = f". Did you mean {public_name(near[0])}?" if near else ""
    raise AttributeError(f"module {package!r} has no attribute {name!r}{hint}")
