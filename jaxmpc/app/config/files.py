"""Reading and writing of TOML files, and where their keys come from."""

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomli_w

from jaxmpc.checks import fail
from jaxmpc.files import text_within

# A problem of a hundred states takes a tenth of that; what tomllib makes of a byte, up to 10 kB.
MOST_BYTES = 10**6
# Time and memory of tomllib grow as the square of the parts of a dotted key: one of 60 kB took
# 4 GB. Keys, dots and blanks stand between the characters that DOTTED splits at.
MOST_DOTS = 32
QUOTED = re.compile(r'"(?:\\.|[^"\\\n])*"|\'[^\'\n]*\'')
DOTTED = re.compile(r"[^\w\-. \t]+")


@dataclass(frozen=True)
class Origin:
    """Where the keys of a configuration come from: a file, and options of the command line (keys
    such as "mpc.horizon")."""

    file: str = ""
    options: frozenset[str] = frozenset()

    def error(self, message: str) -> ValueError:
        """Return the error with the file, or the option, that holds the key it begins with."""
        key, _, rest = message.partition(": ")
        if key in self.options:
            return ValueError(f"command line: --{key.split('.')[-1]}: {rest}")
        return ValueError(f"{self.file}: {message}" if self.file else message)


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
        fail(str(path), f"is no TOML ({error})", "See the keys with: jaxmpc sweep --help")


def to_toml(document: Mapping[str, Any]) -> str:
    """Return TOML text with each vector, and each row of a matrix, on a line."""
    text = tomli_w.dumps(document)
    line = lambda found: f"[{' '.join(part.strip() for part in found[1].splitlines())}]"
    # What holds a bracket of its own, a matrix or a name with one, stays as it is.
    return re.sub(r"\[\n([^\[\]]+?),?\n *\]", line, text)
