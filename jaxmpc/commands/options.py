"""What the commands of the command line share."""

import contextlib
import hashlib
import json
import os
import sys
import tempfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from jaxmpc.checks import fail
from jaxmpc.robots.robot import Robot


def option(metavar: str | None, default: str) -> Any:
    """How an option and its default appear in the help."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})")


# Options that several commands have.
Horizon = Annotated[int | None, option("N", "from the file; joint 20")]
Terminal = Annotated[
    Literal["none", "invariant", "ellipsoid", "box"] | None,
    option("{none,invariant,ellipsoid,box}", "from the file, else none"),
]
End = Annotated[
    tuple[float, ...] | None, option("X [X ...]", "state limits, 3 % wider on each side")
]


def open_folder(path: Path) -> None:
    """Make the folder of --output; ValueError where nothing can be written there."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        fail(f"--output {path}", f"{error.strerror}", "Give a folder you can write to")


def report_error(error: Exception) -> int:
    """One line on stderr; the exit code."""
    print(f"jaxmpc: error: {' '.join(str(error).split())}", file=sys.stderr)
    return 2


def versions() -> dict[str, str]:
    """Versions of what a result depends on, as far as they are installed as packages."""
    found = {}
    for name in ("jaxmpc", "jax", "jaxlib", "numpy", "scipy"):
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def write_json(path: Path, document: Any) -> None:
    """Write a file that is there as a whole or not at all."""
    side = path.with_name(f".{path.name}.partial")
    side.write_text(json.dumps(document, indent=2) + "\n")
    os.replace(side, path)


def model_hash(robot: Robot) -> str:
    """Of the compiled model, so that --resume notices another file under the same name."""
    import mujoco

    binary = np.zeros(mujoco.mj_sizeModel(robot.mujoco), np.uint8)
    mujoco.mj_saveModel(robot.mujoco, None, binary)
    return hashlib.sha256(binary.tobytes()).hexdigest()
