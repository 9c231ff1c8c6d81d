"""The command `jaxmpc init`."""

import dataclasses
from pathlib import Path
from typing import Annotated

from jaxmpc.app.commands.options import Switch, option
from jaxmpc.checks import fail

TEMPLATE, FULL = (Path(__file__).parents[1] / name for name in ("template.toml", "full.toml"))


@dataclasses.dataclass(frozen=True)
class Init:
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

    def run(self) -> None:
        """Write the file. Raises ValueError where it exists or cannot be written."""
        where, text = (
            f"--output {self.output}",
            (FULL if self.full else TEMPLATE).read_text("utf-8"),
        )
        try:
            with self.output.open("w" if self.overwrite else "x", encoding="utf-8") as file:
                file.write(text.replace("FILE", str(self.output)))
        except FileExistsError:
            fail(where, "exists", "Add --overwrite to replace it, or give another name")
        except OSError as error:
            fail(where, f"{error.strerror}", "Give a file that you can write")
        print(f"{self.output}: edit it, then jaxmpc sweep --config {self.output}")
