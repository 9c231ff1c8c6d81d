"""Options of the command `jaxmpc init`."""

import dataclasses
from pathlib import Path
from typing import Annotated

from jaxmpc.app.options.shared import Switch, option


@dataclasses.dataclass(frozen=True)
class InitOptions:
    """Write a file with comments, in which you describe a system of your own.

    How to start
      $ jaxmpc init
      $ jaxmpc sweep --config problem.toml

    The file holds a small working problem, and what is asked for most as comments; with --full
    every key that there is.
    """

    output: Annotated[Path, option("FILE", "problem.toml")] = Path("problem.toml")
    """The TOML file to write."""
    full: Switch = False
    """Show every key of every section."""
    overwrite: Switch = False
    """Replace the file where there is one."""

    keeps = ""
