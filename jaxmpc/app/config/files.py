"""Reading and writing of TOML files."""

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from jaxmpc.checks import fail


def read_toml(path: str | Path) -> dict[str, Any]:
    """Return what a file holds. Raises ValueError where it cannot be read or is no TOML."""
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        fail(str(path), f"cannot be read ({error.strerror})", "Give the path of a TOML file")
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        fail(str(path), f"is no TOML ({error})", "See the keys with: jaxmpc sweep --help")


def to_toml(document: Mapping[str, Any]) -> str:
    """Return TOML text with each vector, and each row of a matrix, on a line."""
    text = tomli_w.dumps(document)
    line = lambda found: f"[{' '.join(part.strip() for part in found[1].splitlines())}]"
    # What holds a bracket of its own, a matrix or a name with one, stays as it is.
    return re.sub(r"\[\n([^\[\]]+?),?\n *\]", line, text)
