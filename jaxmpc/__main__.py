"""The command `jaxmpc`, also as `python -m jaxmpc`: Ctrl-C ends it with one line from the start."""

import os
import signal
import sys
import warnings
from typing import Any


def main() -> int:
    """Run the command and return its exit code."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _stop)  # until the command begins, see `cli.main`
    warnings.formatwarning = lambda message, *_, **__: f"jaxmpc: {message}\n"
    from jaxmpc.app.program_cache import kept_programs

    with kept_programs(sys.argv[1:]):  # before JAX is imported
        from jaxmpc.app import cli

        return cli.main()


def _stop(*_: Any) -> None:
    """End the process at once: an exception would get lost in half-imported modules."""
    os.write(sys.stdout.fileno(), b"\nstopped before it began\n")
    os._exit(130)


if __name__ == "__main__":
    sys.exit(main())
