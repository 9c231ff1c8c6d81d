"""Options of several commands: how they appear in the help, which values they take, shared ones."""

import inspect
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

import numpy as np
import tyro

from jaxmpc.checks import MOST_COUNT, fail


def option(metavar: str | None, default: str, text: str | None = None, kind: Any = None) -> Any:
    """Return the tyro annotation that sets how an option and its default appear in the help.

    text: its meaning, where that is not the string below the field, such as of more than one line,
    which shells do not complete. kind: the type of a value that is given, where the field may be
    None.
    """
    hint = f"(default: {default})"
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=hint, help=text, constructor=kind)


@dataclass(frozen=True)
class Values:
    """An annotation: the values that an option takes, each of several; cure: in words."""

    allowed: Callable[[Any], bool]
    cure: str

    def check(self, name: str, value: Any) -> None:
        """Raise ValueError, naming the option, for a value that it does not take."""
        if value is not None and not self.allowed(value):
            fail(name, f"{value}", self.cure)
        if isinstance(value, int) and value > MOST_COUNT:
            fail(name, f"{value}", f"Give at most {MOST_COUNT}")


def at_least(count: int) -> Values:
    """Return the annotation of whole numbers."""
    return Values(lambda value: value >= count, f"Give a whole number, at least {count}")


POSITIVE = Values(lambda value: 0 < value < np.inf, "Give a positive number")
NOT_NEGATIVE = Values(lambda value: 0 <= value < np.inf, "Give a finite number, at least 0")
MASS = Values(lambda value: 0 <= value < np.inf, "Give a mass in kg")
FINITE = Values(np.isfinite, "Give finite numbers")
SHARE = Values(lambda value: 0 <= value < 1, "Give a fraction from 0 to below 1")
OPEN_FRACTION = Values(lambda value: 0 < value < 1, "Give a fraction above 0 and below 1")
WHOLE_OR_PART = Values(lambda value: 0 <= value <= 1, "Give a fraction from 0 to 1")


def check_values(command: Any) -> None:
    """Raise ValueError for an option whose value its annotation excludes, and for a count that is
    too large."""
    hints = get_type_hints(type(command), include_extras=True)
    for field in fields(command):
        given, name = getattr(command, field.name), f"--{field.name.replace('_', '-')}"
        for value in given if isinstance(given, tuple) else (given,):
            for values in getattr(hints[field.name], "__metadata__", ()):
                if isinstance(values, Values):
                    values.check(name, value)


TerminalSet = Literal["none", "invariant", "ellipsoid", "box"]
Precision = Literal["float32", "float64"]
ProblemFile = Annotated[
    Path | None, option("FILE", "the built-in joint", "TOML file with the problem.")
]
Horizon = Annotated[
    int | None, option("N", "from the file; joint 20", "Prediction horizon, in steps of dt.")
]
Terminal = Annotated[
    TerminalSet | None,
    option(
        "{none,invariant,ellipsoid,box}",
        "from the file, else none",
        "Set for the last state: none, largest set or largest ellipsoid that the LQR keeps within "
        "limits, state limits.",
        TerminalSet,
    ),
]
End = Annotated[
    tuple[float, ...] | None, option("X [X ...]", "state limits, 3 % wider on each side")
]
Devices = Annotated[
    int | None,
    option(
        "K", "JAX's default device", "Share the work among the first K devices of this machine."
    ),
]
RobotMass = Annotated[
    float,
    option(
        "FRACTION",
        "0",
        "Each body's mass and inertia times a number from 1 - FRACTION to 1 + FRACTION, different "
        "for each robot. The MPC does not know: it has the model of the file.",
    ),
    SHARE,
]
RobotDamping = Annotated[
    float,
    option(
        "FRACTION",
        "0",
        "Each joint's damping times a number from 1 - FRACTION to 1 + FRACTION.",
    ),
    SHARE,
]
Payload = Annotated[
    float,
    option("KG", "0", 'Mass from 0 to KG at the site "tool" of the model; the MPC does not know.'),
    MASS,
]
Switch = Annotated[bool, tyro.conf.FlagCreatePairsOff, option(None, "off")]
Resume = Annotated[
    bool, tyro.conf.FlagCreatePairsOff, option(None, "off", "Resume the run in --output.")
]
Overwrite = Annotated[
    bool,
    tyro.conf.FlagCreatePairsOff,
    option(None, "off", "Delete the run in --output and start again."),
]


@dataclass(frozen=True)
class Everywhere:
    """Options that every command takes."""

    quiet: Switch = False
    """Print errors alone."""
    json: Switch = False
    """Print one JSON object in place of tables."""
    format: Annotated[Literal["pdf", "svg", "png"], option("{pdf,svg,png}", "png")] = "png"
    """Write pictures in this format too, beside PNG."""
    width: Annotated[Literal["page", "column"], option("{page,column}", "page")] = "page"
    """Draw maps for a page, or 3.5 inches wide for a column of a paper."""


def chosen_shard(text: str, environment: Mapping[str, str]) -> tuple[int, int]:
    """Return (i, n) of --shard "i/n", "auto" or "auto/n".

    auto: of a SLURM job array, the i-th of its n evenly spaced tasks. auto/n: i is the number of
    the task in the array, or in an indexed Kubernetes job. Raises ValueError unless 0 ≤ i < n.
    """
    where, (first, _, second) = f"--shard {text}", text.partition("/")
    slurm = {key: environment.get(f"SLURM_ARRAY_TASK_{key}", "") for key in "ID MIN COUNT".split()}
    step = environment.get("SLURM_ARRAY_TASK_STEP", "1")
    if first == "auto" and second:
        first = slurm["ID"] or environment.get("JOB_COMPLETION_INDEX", "")
        if not first:
            what = "neither SLURM_ARRAY_TASK_ID nor JOB_COMPLETION_INDEX is set"
            fail(where, what, "Give i/n, or start it in a job array or an indexed job")
    elif first == "auto":
        if not all(v.isdecimal() for v in (*slurm.values(), step)):
            what = "SLURM_ARRAY_TASK_ID, _MIN and _COUNT are not set"
            fail(where, what, "Start it in a SLURM job array, or give i/n or auto/n")
        first, second, apart = slurm["ID"], slurm["COUNT"], max(int(step), 1)
        last = int(slurm["MIN"]) + (int(second) - 1) * apart
        if environment.get("SLURM_ARRAY_TASK_MAX", str(last)) != str(last):
            what = "the tasks of the SLURM job array are not evenly spaced"
            fail(where, what, "Give auto/n, with tasks from 0 to n - 1")
        first = str((int(first) - int(slurm["MIN"])) // apart)
    if not (first.isdecimal() and second.isdecimal() and int(first) < int(second)):
        fail(where, f"shard {first or '?'} of {second or '?'}", "Give i/n with i from 0 to n - 1")
    return int(first), int(second)


def given_options(command: Any, *names: str) -> dict[str, Any]:
    """Return those of the named options that are not None."""
    options = {name: getattr(command, name) for name in names}
    return {name: value for name, value in options.items() if value is not None}


def arguments(
    command: Any, *functions: Callable[..., Any], leave: Iterable[str] = ()
) -> dict[str, Any]:
    """Return the options that have the names of arguments of the functions, and are given."""
    known = {name for function in functions for name in inspect.signature(function).parameters}
    here = {field.name for field in fields(command)}
    return given_options(command, *sorted((known & here) - set(leave)))


def require_lengths(command: Any, needs: str, **lengths: int) -> None:
    """Raise ValueError for an option that is given and does not hold so many numbers."""
    for name, length in lengths.items():
        given = getattr(command, name)
        if given is not None and len(given) != length:
            option_name = f"--{name.replace('_', '-')}"
            fail(option_name, f"has {len(given)} numbers", f"{needs} needs {length}")


def refuse(given: dict[str, Any], robot: str | None, needs: str) -> None:
    """Raise ValueError where an option is given that does not go with (or without) --robot."""
    for name, value in given.items():
        if value not in (None, False):
            problem = f"given beside --robot {robot}" if robot else "given without --robot"
            fail(f"--{name}", problem, needs)


def print_table(rows: list[tuple[str, Any]], width: int) -> None:
    """Print names and values, one pair a line."""
    print("\n".join(f"  {name:<{width}} {value}" for name, value in rows))
