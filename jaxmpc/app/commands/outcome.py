"""What a command came to."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

# Files in which commands keep their results as JSON.
RECORDS = ("summary.json", "tuning.json", "solver.json")


@dataclass(frozen=True)
class Outcome:
    """The exit code of a command, and its results as JSON data, for --json; None where it wrote
    them into a file, or has none. error: the message of exit code 2."""

    code: int = 0
    summary: Mapping[str, Any] | None = None
    error: str | None = None
