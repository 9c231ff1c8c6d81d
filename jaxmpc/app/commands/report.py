"""The command `jaxmpc report`."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from jaxmpc.app.page import folder_page
from jaxmpc.checks import fail


@dataclasses.dataclass(frozen=True)
class Report:
    """Make one HTML page of a folder of results: tables and pictures in a single file.

    What it does
      Reads the results and the pictures of a folder that sweep, recursion, simulate or tune
      wrote, and writes report.html beside them: results, pictures, configuration and versions. The
      file needs no other and no network. The page of a design is jaxmpc info --html FILE.

    How to start
      $ jaxmpc sweep
      $ jaxmpc report jaxmpc-sweep
    """

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Folder that a command wrote."""

    keeps = ""

    def run(self) -> None:
        """Write the page. Raises ValueError for a folder without a readable summary."""
        path = self.folder / "report.html"
        try:
            path.write_text(folder_page(self.folder), encoding="utf-8")
        except (OSError, ValueError, RecursionError) as error:
            what = getattr(error, "strerror", None) or f"{error}"
            fail(
                str(self.folder), f"no page of it: {what}", "Give the folder of a finished command"
            )
        print(f"{path}: {path.stat().st_size / 1024:.0f} KiB")
