"""From a TOML file and options of the command line to a checked configuration."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from pydantic import ValidationError

from jaxmpc.app.config.consistency import check
from jaxmpc.app.config.files import Origin, read_toml
from jaxmpc.app.config.problem import ADAPTER, SECTION_COMMANDS, Config
from jaxmpc.app.config.robot_weights import ROBOT_ADAPTER, RobotConfig
from jaxmpc.checks import fail, nearest, shown

# Inertia 0.05 kg m², period 0.01 s, x = (q, dq), u = τ.
_JOINT: dict[str, Any] = {
    "name": "joint",
    "system": {
        "A": [[1.0, 0.01], [0.0, 1.0]],
        "B": [[0.0], [0.2]],
        "dt": 0.01,
        "state_names": ["q", "dq"],
        "state_units": ["rad", "rad/s"],
        "input_names": ["tau"],
        "input_units": ["N m"],
    },
    "limits": {"x_min": [-1.5, -2.0], "x_max": [1.5, 2.0], "u_min": [-2.0], "u_max": [2.0]},
    "cost": {"Q": [50.0, 1.0], "R": [0.1], "P": "Q"},
    "mpc": {"horizon": 20},
    "sweep": {"grid": [256, 256]},
}


def load(
    path: str | Path | None, overrides: Mapping[str, Any] | None = None, command: str = "sweep"
) -> Config:
    """Read and check the TOML file of a problem; None is the built-in joint.

    `overrides` ("horizon", "grid", ...) replace keys of [mpc] and of the section of the command
    ("sweep" or "recursion"), whose keys are checked against each other.

    Raises ValueError, naming file and key, where the file is absent or unreadable, is no
    TOML, or holds an unknown key or a value that cannot be.
    """
    overrides, options = overrides or {}, set()
    merged = dict(_JOINT if path is None else read_toml(path))
    # A slice and a projection exclude each other: choosing either drops the file's choice.
    # So do the names of a terminal set and the sets themselves.
    dropped = set()
    for rivals in ({"fixed", "projection"}, {"terminal", "H_f", "h_f", "P_f", "level_f"}):
        dropped |= rivals if rivals & set(overrides) else set()
    for name in ("mpc", *({command} & set(SECTION_COMMANDS))):
        known = _keys(Config, name)
        changes = {key: value for key, value in overrides.items() if key in known}
        options |= {f"{name}.{key}" for key in changes}
        if changes and isinstance(merged.get(name, {}), dict):
            kept = {k: v for k, v in merged.get(name, {}).items() if k not in dropped}
            merged[name] = {**kept, **changes}
    origin = Origin("built-in joint" if path is None else str(path), frozenset(options))
    try:
        config = ADAPTER.validate_python(merged)
        check(config, command)
    except ValidationError as error:
        raise origin.error(_error_message(error, Config)) from None
    except ValueError as error:
        raise origin.error(str(error)) from None
    object.__setattr__(config, "origin", origin)  # the way to set a field of a frozen dataclass
    return config


def from_results(document: Mapping[str, Any], command: str = "sweep") -> Config:
    """Return the configuration that results hold (`Config.to_dict`), checked as `load` does."""
    try:
        config = ADAPTER.validate_python(dict(document))
    except ValidationError as error:
        raise ValueError(_error_message(error, Config)) from None
    check(config, command)
    return config


def load_robot_config(path: str | Path) -> RobotConfig:
    """Read the TOML file of a robot's weights. Raises ValueError as `load` does."""
    document = read_toml(path)
    if "robot" not in document:
        fail(str(path), "has no section [robot]", "Give what jaxmpc tune weights --robot wrote")
    try:
        config = ROBOT_ADAPTER.validate_python(document)
    except ValidationError as error:
        raise ValueError(f"{path}: {_error_message(error, RobotConfig)}") from None
    object.__setattr__(config, "origin", Origin(str(path)))
    return config


def _error_message(error: ValidationError, whole: Any) -> str:
    """Return the first thing wrong in one line: where, what, and what is allowed there."""
    unknown = "unexpected_keyword_argument"  # first: a misspelt key is also a missing one
    first = min(error.errors(), key=lambda e: e["type"] != unknown)
    where = [str(part) for part in first["loc"][:2]]
    key = ".".join(where)
    if first["type"] == unknown:
        return _unknown_key(where, whole)
    if first["type"] == "missing":
        return f"{key} is missing. Add it (jaxmpc sweep --help lists all keys)"
    if first["type"] == "dataclass_type":
        return f"{key}: is no section. Write [{key}] above its keys"
    same = [e for e in error.errors() if [str(part) for part in e["loc"][:2]] == where]
    problems = dict.fromkeys(e["msg"].removeprefix("Value error, ") for e in same)
    # TOML and the help say list, Python tuple.
    text = "; or ".join(problems).replace("tuple", "list").replace("Tuple", "List")
    return f"{key}: {text}. Got {shown(first['input'])}"


def _unknown_key(where: list[str], whole: Any) -> str:
    """Return which key is unknown, the key or section that was probably meant, and all keys."""
    key, allowed = where[-1], _keys(whole, *where[:-1])
    place = f"[{where[0]}]" if len(where) == 2 else "the top of the file"
    others = [name for name in _keys(whole) if key in _keys(whole, name)]
    meant = f"It belongs to [{others[0]}]. " if others else nearest(key, allowed)
    return f"unknown key {key!r} in {place}. {meant}Keys allowed there: {', '.join(allowed)}"


def _keys(whole: Any, section: str | None = None) -> list[str]:
    """Return the keys of a section, or those at the top of the file."""
    found: dict[str, Any] = {
        field.name: field.type for field in dataclasses.fields(whole) if field.init
    }
    if section is None:
        return list(found)
    # [solver] may be absent: its type is a union with None.
    kind = next(iter(get_args(found[section])), found[section])
    return [field.name for field in dataclasses.fields(kind)] if kind is not str else []
