"""From a TOML file and options of the command line to a checked configuration."""

import dataclasses
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import numpy as np
from pydantic import TypeAdapter, ValidationError

from jaxmpc.app.config.problem import (
    ADAPTER,
    ROBOT_ADAPTER,
    SECTION_COMMANDS,
    Config,
    Origin,
    RobotConfig,
    grid_shape,
    mapped_axes,
    recursion_shape,
    section_ends,
)
from jaxmpc.batches import CHUNK
from jaxmpc.checks import counted, fail, nearest, require_memory, require_printable, shown
from jaxmpc.files import text_within
from jaxmpc.mpc.condense import condensed_bytes

# Keys for which a number may stand, and how many entries the list has.
NUMBERS = {
    "limits": {
        **dict.fromkeys(("x_min", "x_max"), "n"),
        **dict.fromkeys(("u_min", "u_max", "input_rate_limit"), "m"),
    },
    "cost": {"Q": "n", "P": "n", "R": "m", "input_rate_weight": "m"},
    "reference": {"state": "n", "input": "m"},
    "disturbance": {"w_min": "p", "w_max": "p"},
}
# A problem of a hundred states takes a tenth of that; what tomllib makes of a byte, up to 10 kB.
MOST_BYTES = 10**6
# Time and memory of tomllib grow as the square of the parts of a dotted key: one of 60 kB took
# 4 GB. Keys, dots and blanks stand between the characters that DOTTED splits at.
MOST_DOTS = 32
QUOTED = re.compile(r'"(?:\\.|[^"\\\n])*"|\'[^\'\n]*\'')
DOTTED = re.compile(r"[^\w\-. \t]+")

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
        config = from_results(merged, command)
    except ValueError as error:
        raise origin.error(str(error)) from None
    object.__setattr__(config, "origin", origin)  # the way to set a field of a frozen dataclass
    return config


def from_results(document: Mapping[str, Any], command: str = "sweep") -> Config:
    """Return the configuration that results hold (`Config.to_dict`), checked as `load` does."""
    config = _validated(ADAPTER, _spread(document), Config)
    check(config, command)
    return config


def _spread(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a file in which numbers stand for lists, and a flat list for the column B of a single
    input or E of a single disturbance, with these lists: as Python takes them."""
    found = {key: dict(part) if isinstance(part, dict) else part for key, part in document.items()}
    system = found.get("system")
    A, B = (system.get(key) if isinstance(system, dict) else None for key in ("A", "B"))
    if not isinstance(system, dict) or not isinstance(A, list | tuple):
        return found
    against = found.get("disturbance")
    if B is not None:
        system["B"] = B = _column(B)
    if isinstance(against, dict) and "E" in against:
        against["E"] = _column(against["E"])
    try:
        sizes = {"n": len(A), "m": len(B[0])}  # type: ignore[index, arg-type]
        E = against.get("E") if isinstance(against, dict) else None
        sizes["p"] = sizes["n"] if E is None else len(E[0])
    except (TypeError, IndexError, KeyError):
        return found
    for section, keys in NUMBERS.items():
        part: Any = found.get(section)
        for key, size in keys.items() if isinstance(part, dict) else ():
            value = part.get(key)
            # A weight stands for itself, a limit for all coordinates.
            if type(value) in (int, float) and (section != "cost" or sizes[size] == 1):
                part[key] = [value] * sizes[size]
    return found


def _column(value: Any) -> Any:
    """Return a flat list as a matrix of one column, anything else as it is."""
    if not isinstance(value, list | tuple) or any(isinstance(row, list | tuple) for row in value):
        return value
    return [[number] for number in value]


def holds_system(path: str | Path) -> bool:
    """Return whether a file holds a linear problem, not the weights of a robot. Raises ValueError
    as `load` does."""
    return "system" in read_toml(path)


def load_robot_config(path: str | Path) -> RobotConfig:
    """Read the TOML file of a robot's weights. Raises ValueError as `load` does."""
    document = read_toml(path)
    if "robot" not in document:
        fail(str(path), "has no section [robot]", "Give what jaxmpc tune weights --robot wrote")
    origin = Origin(str(path))
    try:
        config = _validated(ROBOT_ADAPTER, document, RobotConfig)
    except ValueError as error:
        raise origin.error(str(error)) from None
    object.__setattr__(config, "origin", origin)
    return config


def read_toml(path: str | Path) -> dict[str, Any]:
    """Return what a file holds, with or without a byte-order mark. Raises ValueError where it
    cannot be read, is too large or is no TOML."""
    text = text_within(path, MOST_BYTES, "TOML")
    if any(run.count(".") > MOST_DOTS for run in DOTTED.split(QUOTED.sub("q", text))):
        what = f"holds a key of more than {MOST_DOTS} dots"
        fail(str(path), what, "No key takes more than rows of numbers")
    try:
        return tomllib.loads(text)
    except RecursionError:
        fail(str(path), "is nested too deeply", "No key takes more than rows of numbers")
    except ValueError as error:  # no TOML, or a number of thousands of digits
        cure = "Numbers begin with a digit (0.1), texts stand in quotes"
        if "overwrite" in str(error) or "twice" in str(error):
            cure = "Leave one out of the lines that give one key"
        cure = f"{cure}. The keys: jaxmpc sweep --help"
        fail(str(path), f"is no TOML ({error})", cure)


def _validated(adapter: TypeAdapter, document: Mapping[str, Any], whole: Any) -> Any:
    """Return the configuration of class `whole`. Raises ValueError with the first thing wrong."""
    try:
        return adapter.validate_python(dict(document))
    except ValidationError as error:
        raise ValueError(_error_message(error, whole)) from None


def _error_message(error: ValidationError, whole: Any) -> str:
    """Return the first thing wrong in one line: where, what, and what is allowed there."""
    unknown = "unexpected_keyword_argument"  # first: a misspelt key is also a missing one
    first = min(error.errors(), key=lambda e: e["type"] != unknown)
    place = lambda e: [part for part in e["loc"] if not isinstance(part, int)][:2]
    where = [str(part) for part in place(first)]
    key = ".".join(where)
    if first["type"] == unknown:
        return _unknown_key(where, whole)
    if first["type"] == "missing" and len(where) == 1:
        write = "jaxmpc init writes a file that has all of them"
        return f"section {key} is missing. Add [{key}] with its keys ({write})"
    if first["type"] == "missing":
        none = ", inf where there is none" if where[0] == "limits" else ""
        return f"{key} is missing. Add it{none} (jaxmpc sweep --help lists all keys)"
    if first["type"] == "dataclass_type":
        return f"{key}: is no section. Write [{key}] above its keys"
    if where == ["outputs"] and first["type"] == "tuple_type":
        return "outputs: is no list of sections. Write [[outputs]] above the keys of each"
    same = [e for e in error.errors() if place(e) == where]
    forms = _forms(_annotation(whole, where))
    if forms and all(e["type"] in _OF_TYPES for e in same):
        given = same[0]["input"]
        meant = nearest(given, [f.strip('"') for f in forms]) if isinstance(given, str) else ""
        *others, last = forms
        needed = f"{', '.join(others)} or {last}" if others else last
        if isinstance(given, str) and not meant and re.fullmatch(r"[-+]?[\d.]+(e[-+]?\d+)?", given):
            meant = f"Write {given}, without quotes"
        return f"{key}: {shown(given)} where {needed} is needed. {meant}".rstrip()
    # A value of the right type is wrong for what it is, a list for its first wrong entry.
    same = [e for e in same if e["type"] not in (*_OF_TYPES, "too_short")] or same
    problems = dict.fromkeys(e["msg"].removeprefix("Value error, ") for e in same)
    # TOML and the help say list, Python tuple.
    text = "; or ".join(problems).replace("tuple", "list").replace("Tuple", "List")
    return f"{key}: {text}. Got {shown(same[0]['input'])}"


# Kinds of errors that a value of another type gives, in pydantic's words.
_OF_TYPES = tuple(f"{kind}_type" for kind in "float int bool string tuple".split())
_OF_TYPES = (*_OF_TYPES, "literal_error", "int_from_float", "int_parsing", "float_parsing")
# Types of values in words.
_WORDS = {float: "a number", int: "a whole number", bool: "true or false", str: "a text"}


def _annotation(whole: Any, where: Sequence[str]) -> Any:
    """Return the type of a key, None where there is none."""
    for name in where:
        kinds = [whole, *get_args(whole)]
        known = next((kind for kind in kinds if dataclasses.is_dataclass(kind)), None)
        fields = {} if known is None else {f.name: f.type for f in dataclasses.fields(known)}
        whole = fields.get(name)
    return whole


def _forms(kind: Any) -> list[str]:
    """Return what a value of a type may be, in words; [] where there are none for it."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Literal:
        return [f'"{word}"' for word in parts]
    if origin is Annotated:
        return _forms(parts[0])
    if origin is tuple:
        # [a number] → a list of numbers, [a list of numbers] → a list of rows of numbers.
        rows = [f.replace("a list of", "rows of") for f in _forms(parts[0])]
        many = [f if f.startswith("rows") else f"{f.removeprefix('a ')}s" for f in rows]
        return [f"a list of {' or '.join(many)}"] if many else []
    if origin in (Union, UnionType):
        return [form for part in parts if part is not NoneType for form in _forms(part)]
    return [_WORDS[kind]] if kind in _WORDS else []


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


def check(config: Config, command: str = "sweep") -> None:
    """Raise ValueError where keys that are valid alone do not fit one another."""
    s, limits, target = config.system, config.limits, config.reference
    n, m = len(s.A), len(s.B[0])
    require_printable("name", config.name)
    for key, value, count in (
        ("system.A", s.A[0], n),
        ("system.B", s.B, n),
        ("system.c", s.c, n),
        ("system.state_names", s.state_names, n),
        ("system.state_units", s.state_units, n),
        ("system.input_names", s.input_names, m),
        ("system.input_units", s.input_units, m),
        ("limits.x_min", limits.x_min, n),
        ("limits.x_max", limits.x_max, n),
        ("limits.u_min", limits.u_min, m),
        ("limits.u_max", limits.u_max, m),
        ("cost.Q", config.cost.Q, n),
        ("cost.R", config.cost.R, m),
        ("cost.P", None if isinstance(config.cost.P, str) else config.cost.P, n),
        ("limits.input_rate_limit", limits.input_rate_limit, m),
        ("cost.input_rate_weight", config.cost.input_rate_weight, m),
        ("reference.state", None if target is None else target.state, n),
        ("reference.input", None if target is None else target.input, m),
    ):
        inputs = counted(m, "input")
        what = inputs if count == m != n else f"{counted(n, 'state')}, {inputs}"
        _check_length(key, value, count, f"A, B: {what}")
    _check_order("limits", limits, "x_min", "x_max")
    _check_order("limits", limits, "u_min", "u_max")
    _check_state_limits(config)
    _check_terminal_set(config, n)
    if config.disturbance is not None:
        given = config.disturbance
        _check_order("disturbance", given, "w_min", "w_max")
        p = n if given.E is None else len(given.E[0])
        for key, shape, cure in (
            ("E", (n, p), f"Give ({n}, p), one row a state, one column a disturbance"),
            ("gain", (m, n), f"Give {(m, n)}"),
        ):
            value = getattr(given, key)
            if value is not None and np.shape(value) != shape:
                fail(f"disturbance.{key}", f"shape {np.shape(value)}", cure)
        for key in ("w_min", "w_max"):
            cure = "One for each column of E, without E each state"
            _check_length(f"disturbance.{key}", getattr(given, key), p, cure)
    for i, rows in enumerate(config.outputs):
        where = f"outputs.{i}"
        if rows.lower is None and rows.upper is None:
            fail(where, "has neither lower nor upper", "Give one of them, or both")
        if rows.quadratic is not None and rows.rho is None:
            fail(f"{where}.quadratic", "given without rho", "Soft rows have a weight rho")
        for key in ("lower", "upper", "D", "names", "units"):
            value = getattr(rows, key) or None
            value = None if isinstance(value, float) else value
            _check_length(f"{where}.{key}", value, len(rows.C), "One for each row of C")
        for key, size in (("C", n), ("D", m)):
            value = getattr(rows, key)
            if value is not None and len(value[0]) != size:
                fail(f"{where}.{key}", f"has {len(value[0])} columns", f"Give {size}")
    require_horizon(config, "mpc.horizon", config.mpc.horizon)
    if command == "sweep":
        _check_sweep(config, config.dimension)
    elif command == "recursion":
        _check_recursion(config, config.dimension)


def require_horizon(config: Config, key: str, horizon: int) -> None:
    """Raise ValueError, naming the key, where a horizon is too long for the memory."""
    n, m = len(config.system.A), len(config.system.B[0])
    rows = config.limits.h_x or config.limits.x_min or ()
    needed = condensed_bytes(horizon, n, m, config.mpc.control_horizon, len(rows) + m)
    require_memory(key, needed, "Give fewer steps")


def _check_sweep(config: Config, n: int) -> None:
    """Raise ValueError unless [sweep] fits n states, previous inputs among them; those that are
    neither mapped nor in `fixed` are zero."""
    sweep = config.sweep
    axes = mapped_axes(config)
    d = len(axes)
    states = len([i for i in range(len(config.system.A)) if i not in axes])
    all_states, previous = f"{n} states", n - len(config.system.A)
    if previous:
        all_states += f" ({previous} of them previous inputs, whose rates are limited)"
    for key, count in (("grid", d), ("lower", d), ("upper", d), ("fixed", n - d)):
        value = getattr(sweep, key)
        if value is not None and len(value) != count and (key != "fixed" or len(value) != states):
            cure = f"{all_states}, of which {d} are mapped (sweep.axes)"
            fail(f"sweep.{key}", f"has {len(value)} entries where {count} are needed", cure)
    _check_order("sweep", sweep, "lower", "upper")
    both = sweep.fixed is not None and sweep.projection
    if both or (states and sweep.fixed is None and not sweep.projection):
        cure = f"Give the {n - d} other values in sweep.fixed (a slice) or projection = true"
        what = "fixed and projection exclude each other"
        fail("sweep.fixed", what if both else f"{all_states}, {d} mapped", cure)
    if d == n and sweep.projection:
        fail("sweep.projection", f"true, and all {n} states are mapped", "Name fewer in sweep.axes")
    section_ends(config, mapped_axes(config), sweep)
    # Blocks in work, and a hundred bytes of each other block.
    count = math.prod(grid_shape(config))
    needed = 8 * min(count, CHUNK) * state_bytes(config) + 100 * count / CHUNK
    require_memory("sweep.grid", needed, "Map fewer points")


def _check_recursion(config: Config, n: int) -> None:
    """Raise ValueError unless [recursion] fits a system of n states."""
    recursion = config.recursion
    for key in ("grid", "lower", "upper"):
        _check_length(f"recursion.{key}", getattr(recursion, key), n, "One for each state")
    _check_order("recursion", recursion, "lower", "upper")
    shape = recursion_shape(config)
    if shape is not None:
        section_ends(config, range(n), recursion)
        # The map of the samples, and the states of the loops: x, x⁺, two inputs, lost, undecided.
        each = state_bytes(config, n) + 8 * (3 * n + 2 * len(config.system.B[0]) + 2)
        require_memory("recursion.grid", math.prod(shape) * each, "Look at fewer states")


def state_bytes(config: Config, d: int | None = None) -> int:
    """Return the bytes of a state with its label and proofs in a map of d axes (None: those of
    [sweep]): the point, x_0, the plan, the half-space, label and status."""
    d = len(mapped_axes(config)) if d is None else d
    n, m = config.dimension, len(config.system.B[0])
    return 8 * (2 * d + n + config.mpc.horizon * m + 1) + 2


def _check_state_limits(config: Config) -> None:
    """Raise ValueError unless the state limits are either a box or rows of H_x, and complete."""
    limits = config.limits
    box = limits.x_min is not None or limits.x_max is not None
    polytope = limits.H_x is not None or limits.h_x is not None
    _check_pair("limits", limits, "x_min", "x_max", "Use inf for a side without limit")
    if limits.margin and not box:
        fail("limits.margin", "given without x_min, x_max", "A Box of limits has half-widths")
    _check_pair("limits", limits, "H_x", "h_x", "Give both: H_x x <= h_x")
    if box and polytope:
        fail("limits.H_x", "given beside x_min, x_max", "Write the box as rows of H_x")
    _check_rows("limits.H_x", limits.H_x, limits.h_x, len(config.system.A), "One h_x a row")
    if not (box or polytope) and config.mpc.terminal != "none":
        fail("mpc.terminal", f'"{config.mpc.terminal}" without state limits', "Give x_min, x_max")


def _check_terminal_set(config: Config, n: int) -> None:
    """Raise ValueError unless [mpc] gives at most one terminal set, complete and of size n."""
    mpc = config.mpc
    for rows, ends in (("H_f", "h_f"), ("P_f", "level_f")):
        _check_pair("mpc", mpc, rows, ends, "Give both")
        if getattr(mpc, rows) is not None and mpc.terminal != "none":
            fail(f"mpc.{rows}", f'given beside terminal "{mpc.terminal}"', "Choose one")
    if mpc.H_f is not None and mpc.P_f is not None:
        fail("mpc.P_f", "given beside H_f", "Choose one terminal set")
    _check_rows("mpc.H_f", mpc.H_f, mpc.h_f, n, f"One h_f a row, {n} columns")
    if mpc.P_f is not None and np.shape(mpc.P_f) != (n, n):
        fail("mpc.P_f", f"shape {np.shape(mpc.P_f)}", f"Give ({n}, {n})")


def _check_pair(where: str, section: Any, first: str, second: str, cure: str) -> None:
    """Raise ValueError unless both of two keys are given, or neither."""
    if (getattr(section, first) is None) != (getattr(section, second) is None):
        fail(f"{where}.{first}", f"{first} and {second} go together", cure)


def _check_rows(key: str, H: Any, h: Any, n: int, cure: str) -> None:
    """Raise ValueError unless H, where given, has a row of n entries for each entry of h."""
    if H is not None and np.shape(H) != (len(h), n):
        fail(key, f"shape {np.shape(H)} for {len(h)} rows", cure)


def _check_length(key: str, value: Any, count: int, cure: str) -> None:
    """Raise ValueError unless a list, where given, has so many entries."""
    if value is not None and len(value) != count:
        fail(key, f"has {len(value)} entries where {count} are needed", cure)


def _check_order(where: str, section: Any, low: str, high: str) -> None:
    """Raise ValueError where a lower end lies above its upper end."""
    pairs = zip(getattr(section, low) or (), getattr(section, high) or (), strict=False)
    for i, (a, b) in enumerate(pairs):
        if a > b or (where in SECTION_COMMANDS and a == b):
            low_end, high_end = (repr(v).removesuffix(".0") for v in (a, b))  # all their digits
            what = f"entry {i} is {low_end}, above {high} {high_end}"
            fail(f"{where}.{low}", what, f"Check {low}, {high}")
