"""The command `jaxmpc`: parse the command line, run the subcommand, and report how it ended."""

import importlib
import shlex
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Annotated, Any, Union

import tyro

from jaxmpc.app.commands.options import report_error

# Module and class of each command: only the one that is called is imported.
COMMANDS = {
    "sweep": ("sweep", "Sweep"),
    "recursion": ("recursion", "Recursion"),
    "info": ("info", "Info"),
    "simulate": ("simulate", "Simulate"),
}
DESCRIPTION = "Constrained MPC in batches, with proofs. Also: jaxmpc --version"
TUNERS = {"weights": ("tune", "TuneWeights"), "penalties": ("tune_penalties", "TunePenalties")}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code: 0 done, 2 error, 130 interrupted."""
    argv = list(sys.argv[1:] if argv is None else argv)
    if argv == ["--version"]:
        print(f"jaxmpc {version('jaxmpc')}")
        return 0
    command = parse(argv)
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # as in the background
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return command.run() or 0
    except (ValueError, OSError, MemoryError) as error:
        return report_error(error)
    except KeyboardInterrupt:
        if not command.keeps:
            print("\nstopped; nothing is kept")
            return 130
        again = [word for word in argv if word not in ("--overwrite", "--resume")]
        resume = shlex.join(["jaxmpc", *again, "--resume"])
        print(f"\nstopped; {command.keeps} that were done are kept. Go on with:\n  {resume}")
        return 130


def parse(argv: Sequence[str]) -> Any:
    """Return the command with its options.

    `jaxmpc COMMAND --help` prints a page; `jaxmpc --help` and `jaxmpc tune --help` one line each.
    """
    prog, table, words = "jaxmpc", COMMANDS, list(argv)
    if words[:1] == ["tune"]:
        prog, table, words = "jaxmpc tune", TUNERS, words[1:]
    if words and words[0] in table:
        kind = _class(*table[words[0]])
        return tyro.cli(kind, prog=f"{prog} {words[0]}", args=words[1:])
    described = [_described(name, _class(*where)) for name, where in table.items()]
    if table is COMMANDS:
        described.append(_described("tune", Tune))
    choice: Any = Union[tuple(described)]  # noqa: UP007
    text = Tune.__doc__ if table is TUNERS else DESCRIPTION
    return tyro.cli(choice, prog=prog, description=text, args=words)


@dataclass(frozen=True)
class Tune:
    """Learn what is usually guessed: an MPC's weights, or the penalties of its solver."""


def _class(module: str, name: str) -> Any:
    """Import a command's module and return its class."""
    return getattr(importlib.import_module(f"jaxmpc.app.commands.{module}"), name)


def _described(name: str, kind: Any) -> Any:
    """Return the class as a subcommand that the first line of its docstring describes."""
    return Annotated[kind, tyro.conf.subcommand(name, description=kind.__doc__.splitlines()[0])]
