"""What a command prints, on a terminal that no name steers, and how it says that it failed."""

import contextlib
import sys
from collections.abc import Iterator
from typing import Any

from jaxmpc.checks import printable


class Plain:
    """A stream of text in which characters that would steer a terminal are written as escapes, but
    for ends of lines, tabs and the carriage returns of progress bars."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write a text, and return its length."""
        self._stream.write(printable(text, keep="\n\r\t"))
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextlib.contextmanager
def plain_output() -> Iterator[None]:
    """Let all that is printed pass through `Plain`."""
    out: Any = Plain(sys.stdout)
    err: Any = Plain(sys.stderr)
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        yield


def report_error(message: str) -> int:
    """Print one line on stderr and return the exit code, 2."""
    print(f"jaxmpc: error: {printable(' '.join(message.split()))}", file=sys.stderr)
    return 2
