"""Options that several commands share, their checks, and helpers to open results and print."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from jaxmpc.checks import MOST_COUNT, fail


def option(metavar: str | None, default: str, text: str | None = None) -> Any:
    """Return the tyro annotation that sets how an option and its default appear in the help.

    text: its meaning, where that takes more than a line; else the string below the field.
    """
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})", help=text)


# Options that several commands have.
Horizon = Annotated[int | None, option("N", "from the file; joint 20")]
Terminal = Annotated[
    Literal["none", "invariant", "ellipsoid", "box"] | None,
    option(
        "{none,invariant,ellipsoid,box}",
        "from the file, else none",
        "Set for the last state: none, largest set or largest ellipsoid that the LQR keeps within "
        "limits, state limits.",
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
Switch = Annotated[bool, tyro.conf.FlagCreatePairsOff, option(None, "off")]


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


def check_counts(command: Any, **least: int) -> None:
    """Raise ValueError for an option that is given and below its least value, or too large for a
    count."""
    for name, lowest in least.items():
        value, given = getattr(command, name), f"--{name.replace('_', '-')}"
        if value is not None and value < lowest:
            fail(given, f"{value}", f"Give a whole number, at least {lowest}")
        if value is not None and value > MOST_COUNT:
            fail(given, f"{value}", f"Give at most {MOST_COUNT}")


def check_positive(command: Any, *names: str) -> None:
    """Raise ValueError for an option that is given and not a positive number."""
    for name in names:
        value = getattr(command, name)
        if value is not None and not 0 < value < np.inf:
            fail(f"--{name.replace('_', '-')}", f"{value}", "Give a positive number")


def refuse(given: dict[str, Any], robot: str | None, needs: str) -> None:
    """Raise ValueError where an option is given that does not go with (or without) --robot."""
    for name, value in given.items():
        if value not in (None, False):
            problem = f"given beside --robot {robot}" if robot else "given without --robot"
            fail(f"--{name}", problem, needs)


def print_table(rows: list[tuple[str, Any]], width: int) -> None:
    """Print names and values, one pair a line."""
    print("\n".join(f"  {name:<{width}} {value}" for name, value in rows))
