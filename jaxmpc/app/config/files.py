"""Reading and writing of TOML files."""

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from jaxmpc.checks import fail


def read_toml(path: str | Path) -> dict[str, Any]:
    """Return what a file holds, with or without a byte-order mark. Raises ValueError where it
    cannot be read or is no TOML."""
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        fail(str(path), f"cannot be read ({error.strerror})", "Give the path of a TOML file")
    except RecursionError:
        fail(str(path), "is nested too deeply", "No key takes more than rows of numbers")
    except ValueError as error:  # no TOML, no UTF-8, or a number of thousands of digits
        fail(str(path), f"is no TOML ({error})", "See the keys with: jaxmpc sweep --help")


def to_toml(document: Mapping[str, Any]) -> str:
    """Return TOML text with each vector, and each row of a matrix, on a line."""
    text = tomli_w.dumps(document)
    line = lambda found: f"[{' '.join(part.strip() for part in found[1].splitlines())}]"
    # What holds a bracket of its own, a matrix or a name with one, stays as it is.
    return re.sub(r"\[\n([^\[\]]+?),?\n *\]", line, text)
