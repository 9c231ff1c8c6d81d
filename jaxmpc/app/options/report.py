"""Options of the command `jaxmpc report`."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro


@dataclasses.dataclass(frozen=True)
class ReportOptions:
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
