"""The command `jaxmpc init`."""

import shlex
from pathlib import Path

from jaxmpc.app.options.init import InitOptions
from jaxmpc.checks import fail

TEMPLATE, FULL = (Path(__file__).parents[1] / name for name in ("template.toml", "full.toml"))


class Init(InitOptions):
    """The command: its options, and `run`."""

    def run(self) -> None:
        """Write the file. Raises ValueError where it exists or cannot be written."""
        path = shlex.quote(str(self.output))  # for commands to copy
        where, text = (
            f"--output {self.output}",
            (FULL if self.full else TEMPLATE).read_text("utf-8"),
        )
        try:
            with self.output.open("w" if self.overwrite else "x", encoding="utf-8") as file:
                file.write(text.replace("FILE", path))
        except FileExistsError:
            fail(where, "exists", "Add --overwrite to replace it, or give another name")
        except OSError as error:
            fail(where, f"{error.strerror}", "Give a file that you can write")
        print(f"{self.output}: edit it, then jaxmpc sweep --config {path}")
