"""How a command says that it failed."""

import sys

from jaxmpc.checks import printable


def report_error(error: Exception) -> int:
    """Print one line on stderr and return the exit code, 2."""
    print(f"jaxmpc: error: {printable(' '.join(str(error).split()))}", file=sys.stderr)
    return 2
