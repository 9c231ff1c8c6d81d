"""The command `jaxmpc`: which command, and what ends it."""

import dataclasses
import shlex
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from typing import Annotated, Any, Union

import tyro

from jaxmpc.commands.info import Info
from jaxmpc.commands.options import report_error
from jaxmpc.commands.recursion import Recursion
from jaxmpc.commands.simulate import Simulate
from jaxmpc.commands.sweep import Sweep, sweep
from jaxmpc.commands.tune import TuneWeights
from jaxmpc.commands.tune_penalties import TunePenalties


@dataclasses.dataclass(frozen=True)
class Tune:
    """Learn what is usually guessed: an MPC's weights, or the penalties of its solver."""

    what: Annotated[
        Annotated[
            TuneWeights,
            tyro.conf.subcommand("weights", description=str(TuneWeights.__doc__).splitlines()[0]),
        ]
        | Annotated[
            TunePenalties,
            tyro.conf.subcommand(
                "penalties", description=str(TunePenalties.__doc__).splitlines()[0]
            ),
        ],
        tyro.conf.arg(name=""),
    ]

    def run(self) -> int:
        """Do it; the result is the exit code."""
        return self.what.run()


TUNERS: dict[str, Any] = {"weights": TuneWeights, "penalties": TunePenalties}
COMMANDS: dict[str, Any] = {
    "sweep": Sweep, "recursion": Recursion, "info": Info, "simulate": Simulate,
    "tune": Tune,
}  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; the result is the exit code (0 done, 2 error, 130 interrupted)."""
    argv = list(sys.argv[1:] if argv is None else argv)
    if argv == ["--version"]:
        print(f"jaxmpc {version('jaxmpc')}")
        return 0
    command = _parse(argv)
    tunes = isinstance(command, Tune | TuneWeights | TunePenalties)
    if not (tunes or isinstance(command, Sweep | Simulate)):
        return _guarded(command.run)
    again = [word for word in argv if word not in ("--overwrite", "--resume")]
    resume = shlex.join(["jaxmpc", *again, "--resume"])
    kept = f"{'steps' if tunes else 'chunks'} that were done are kept. Go on with:\n  {resume}"
    run = (lambda: sweep(command, resume)) if isinstance(command, Sweep) else command.run
    return _guarded(run, kept)


def _parse(argv: Sequence[str]) -> Any:
    """The command with its options. A command's help is a page, `jaxmpc --help` a line for each."""
    if argv[:1] == ["tune"] and argv[1:2] and argv[1] in TUNERS:
        return tyro.cli(TUNERS[argv[1]], prog=f"jaxmpc tune {argv[1]}", args=argv[2:])
    if argv and argv[0] in COMMANDS:
        return tyro.cli(COMMANDS[argv[0]], prog=f"jaxmpc {argv[0]}", args=argv[1:])
    lines = [
        Annotated[kind, tyro.conf.subcommand(name, description=str(kind.__doc__).splitlines()[0])]
        for name, kind in COMMANDS.items()
    ]
    description = "Constrained MPC in batches, with proofs. Also: jaxmpc --version"
    choice: Any = Union[tuple(lines)]  # noqa: UP007
    return tyro.cli(choice, prog="jaxmpc", description=description, args=argv)


def _guarded(run: Callable[[], int], kept: str = "nothing is kept") -> int:
    """Run a command; what the machine or Ctrl-C ends is told in a line."""
    try:
        return run()
    except (OSError, MemoryError) as error:
        return report_error(error)
    except KeyboardInterrupt:
        print(f"\nstopped; {kept}")
        return 130
