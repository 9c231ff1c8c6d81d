"""The command `jaxmpc`, also as `python -m jaxmpc`: Ctrl-C ends it with one line from the start."""

import contextlib
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from typing import Any


def main() -> int:
    """Run the command and return its exit code."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _stop)  # until the command begins, see `cli.main`
    warnings.formatwarning = lambda message, *_, **__: f"jaxmpc: {message}\n"
    from jaxmpc.app import cli

    return cli.main(session=session)


@contextlib.contextmanager
def session(words: Sequence[str]) -> Iterator[None]:
    """Keep what the command in `words` compiles, and start JAX's device beside the imports of its
    modules; nothing of this for wrong options, which are told at once."""
    from jaxmpc.app.program_cache import KEEPING, defaults, kept_programs

    # By SciPy's OpenBLAS, not imported yet, JAX factors small matrices, for which its threads wait
    # on busy cores far longer than one takes.
    with defaults(OPENBLAS_NUM_THREADS="1"), kept_programs(words):
        if words[0] in KEEPING:
            threading.Thread(target=_start_device).start()
        yield


def _start_device() -> None:
    """Use JAX's device once, which takes a GPU a second, while the command's modules are
    imported."""
    with contextlib.suppress(Exception):  # it is reported where a result is needed
        import jax

        jax.block_until_ready(jax.device_put(0))


def _stop(*_: Any) -> None:
    """End the process at once: an exception would get lost in half-imported modules."""
    os.write(sys.stdout.fileno(), b"\nstopped before it began\n")
    os._exit(130)


if __name__ == "__main__":
    sys.exit(main())
