"""The command `jaxmpc`: parse the command line, run the subcommand, and report how it ended."""

import _thread
import contextlib
import errno
import importlib
import inspect
import io
import json
import os
import re
import shlex
import signal
import sys
import threading
import time
import types
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import MISSING, fields, make_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro

import jaxmpc
from jaxmpc.app.commands.outcome import RECORDS, Outcome
from jaxmpc.app.options.export import ExportOptions
from jaxmpc.app.options.info import InfoOptions
from jaxmpc.app.options.init import InitOptions
from jaxmpc.app.options.recursion import RecursionOptions
from jaxmpc.app.options.report import ReportOptions
from jaxmpc.app.options.shared import Everywhere, check_values
from jaxmpc.app.options.simulate import SimulateOptions
from jaxmpc.app.options.sweep import SweepOptions
from jaxmpc.app.options.tune_solver import TuneSolverOptions
from jaxmpc.app.options.tune_weights import TuneWeightsOptions
from jaxmpc.app.options.verify import VerifyOptions
from jaxmpc.checks import fail, nearest, printable

# The options of each command, whose docstring is its help. They need no JAX, which the command
# does: it is the class of that name without "Options" in `jaxmpc.app.commands`.
COMMANDS = {
    "init": InitOptions,
    "sweep": SweepOptions,
    "recursion": RecursionOptions,
    "info": InfoOptions,
    "simulate": SimulateOptions,
    "verify": VerifyOptions,
    "export": ExportOptions,
    "report": ReportOptions,
}
TUNERS = {"weights": TuneWeightsOptions, "solver": TuneSolverOptions}
TUNE = "Learn what is usually guessed: an MPC's weights, or the penalties of its solver."
DESCRIPTION = """Constrained MPC in batches, with proofs. Also: jaxmpc --version

Every command takes --quiet (errors alone), --json (one JSON object in place of tables),
--format {pdf,svg,png} (pictures in this format beside PNG) and --width {page,column} (of maps, for
papers). docs/how-to/commands.md tells more."""
# What the line of an error begins with.
ERROR = "jaxmpc: error: "
# Options of tyro that write a completion script for a shell, and the words that each needs.
COMPLETIONS = {"--tyro-print-completion": 2, "--tyro-write-completion": 3}
# What surrounds the work of a command, given its words.
Session = Callable[[Sequence[str]], AbstractContextManager[None]]


def main(
    argv: Sequence[str] | None = None, session: Session = lambda words: contextlib.nullcontext()
) -> int:
    """Run a command and return its exit code: 0 done, 1 not verified, 2 error, 130 interrupted,
    141 nobody reads its output any more.

    session: entered once the options are known to be right, before JAX is imported.
    """
    for name in ("stdout", "stderr"):  # None where the shell has closed it, as by >&-
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))
    for stream in (sys.stdout, sys.stderr):  # what their encoding lacks becomes "?"
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    try:
        try:
            return exit_code(list(sys.argv[1:] if argv is None else argv), session)
        finally:  # what is written at the end of the process cannot be told from an error
            sys.stdout.flush()
    except BrokenPipeError:
        return without_reader()


def exit_code(argv: Sequence[str], session: Session) -> int:
    """Run a command and return its exit code, as `main` does."""
    if argv == ["--version"]:
        print(f"jaxmpc {jaxmpc.__version__}")
        return 0
    words = command_first(argv)
    try:
        everywhere, options = parse(words)
        check_values(options)
    except BrokenPipeError:
        return without_reader()
    # tyro asserts that it knows a shell, and needs a package for some.
    except (ValueError, OSError, AssertionError, ImportError) as error:
        return report_error(str(error))
    if everywhere.format != "png" or everywhere.width == "column":
        import matplotlib

        matplotlib.rcParams["savefig.format"] = everywhere.format
        if everywhere.width == "column":  # which `jaxmpc.app.plots` reads
            matplotlib.rcParams["figure.figsize"] = (3.5, 3.6)
            matplotlib.rcParams["font.size"] = 8
    if not (everywhere.quiet or everywhere.json):
        with plain_output(), session(words):
            return run(options, argv).code
    said, begun = io.StringIO(), time.time()
    with plain_output(said, OnlyErrors(sys.stderr)), session(words):
        outcome = run(options, argv)
    if everywhere.json:
        found = as_json(options, outcome, said.getvalue(), begun)
        name = " ".join(words[: 2 if words[0] == "tune" else 1])
        print(json.dumps({"command": name} | found, indent=2))
    return outcome.code


def command_first(argv: Sequence[str]) -> list[str]:
    """Return the words with the command before options that stand before it, such as those of
    `jaxmpc --json sweep`."""
    if not argv or not argv[0].startswith("-") or argv[0] in COMPLETIONS:
        return list(argv)
    place = next((i for i, word in enumerate(argv) if word in (*COMMANDS, "tune")), 0)
    end = place + 1 + (argv[place] == "tune")
    return [*argv[place:end], *argv[:place], *argv[end:]]


def as_json(options: Any, outcome: Outcome, said: str, begun: float) -> dict[str, Any]:
    """Return what a command came to: its exit code, its error, the lines that it printed, and its
    results, or those that it wrote as JSON into its folder since `begun`."""
    folder: Any = getattr(options, "output", None)
    summary = outcome.summary
    for name in RECORDS if folder is not None and summary is None else ():
        path = Path(folder) / name
        if path.is_file() and path.stat().st_mtime >= begun - 1:
            summary = json.loads(path.read_text(encoding="utf-8"))
    return {
        "exit_code": outcome.code,
        "error": outcome.error,
        "output": None if folder is None else str(folder),
        "lines": said.splitlines(),
        "summary": summary,
    }


def run(options: Any, argv: Sequence[str]) -> Outcome:
    """Run the command of these options, and return what it came to."""
    try:
        command = command_of(options)
        if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # as in the background
            signal.signal(signal.SIGINT, signal.default_int_handler)
        with no_interrupt_lost():
            return command.run() or Outcome()
    except BrokenPipeError:
        return Outcome(without_reader())
    except (ValueError, OSError, MemoryError, ImportError) as error:
        message = str(error)
        if isinstance(error, OSError) and error.strerror:
            full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
            resuming = ", and go on with --resume" if options.keeps else ""
            cure = "Make room where it is written to" + resuming
            cure = cure if full else "Give files and folders that are there and can be written"
            message = f"{error.filename or 'writing'}: {error.strerror}. {cure}"
        message = named_options(message, options)
        return Outcome(report_error(message), error=message)
    except KeyboardInterrupt:
        if not options.keeps:
            print("\nstopped; nothing is kept")
            return Outcome(130)
        again = [word for word in argv if word not in ("--overwrite", "--resume")]
        resume = shlex.join(["jaxmpc", *again, "--resume"])
        print(f"\nstopped; {options.keeps} that were done are kept. Go on with:\n  {resume}")
        return Outcome(130)


@contextlib.contextmanager
def no_interrupt_lost() -> Iterator[None]:
    """Interrupt once more where Ctrl-C fell into a callback, of which Python ignores exceptions:
    JAX has one at each garbage collection."""
    usual = sys.unraisablehook

    def hook(ignored: Any) -> None:
        if issubclass(ignored.exc_type, KeyboardInterrupt):
            # Later: an exception in here would be ignored too.
            threading.Timer(0.01, _thread.interrupt_main).start()
        else:
            usual(ignored)

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = usual


def command_of(options: Any) -> Any:
    """Return the command with these options. Imports its module, and with it JAX."""
    kind = type(options)
    place = kind.__module__.replace("jaxmpc.app.options", "jaxmpc.app.commands")
    found = getattr(importlib.import_module(place), kind.__name__.removesuffix("Options"))
    return found(**vars(options))


def without_reader() -> int:
    """Return the exit code of a command whose output goes to a program that has ended, such as
    `head`: silently, and with nothing left to be written at the end of the process."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 128 + signal.SIGPIPE


def named_options(message: str, options: Any) -> str:
    """Return an error of the library, which begins with its arguments, with their options."""
    names, colon, rest = message.partition(": ")
    if names == str(getattr(options, "output", None)):
        return f"--output {message}"
    known = {field.name for field in fields(options)}
    option_of = lambda word: f"--{word[0].replace('_', '-')}" if word[0] in known else word[0]
    if re.fullmatch(r"\w+(,? \w+)*", names):
        names = re.sub(r"\w+", option_of, names)
    return names + colon + rest


def parse(argv: Sequence[str]) -> tuple[Everywhere, Any]:
    """Return the options that every command takes, and those of the command that is called.

    `jaxmpc COMMAND --help` prints a page; `jaxmpc --help` and `jaxmpc tune --help` one line each.
    Raises ValueError for commands, options and values that there are not.
    """
    prog, words = "jaxmpc", list(argv)
    table: dict[str, Any] = COMMANDS
    if words[:1] == ["tune"]:
        prog, table, words = "jaxmpc tune", TUNERS, words[1:]
    if words and words[0] in table:
        return parse_options(table[words[0]], f"{prog} {words[0]}", words[1:])
    first = words[0] if words else ""
    if first not in ("-h", "--help") and not 0 < COMPLETIONS.get(first, 0) <= len(words):
        known = [*table, *(["tune"] if table is COMMANDS else [])]
        given = f"no command {first!r}" if words else "no command given"
        fail(prog, given, f"{nearest(first, known)}There are {', '.join(known)}; see {prog} --help")
    choices = subcommands(table)
    if table is COMMANDS:
        tuner: Any = Union[subcommands(TUNERS)]  # noqa: UP007
        choices += (described("tune", make_dataclass("Tune", [("quantity", tuner)]), TUNE),)
    choice: Any = Union[choices]  # noqa: UP007
    text = TUNE if table is TUNERS else DESCRIPTION
    plain = tyro.conf.OmitArgPrefixes, tyro.conf.OmitSubcommandPrefixes  # no "quantity:weights"
    tyro.cli(choice, prog=prog, description=text, args=words, config=plain)  # prints, and exits
    raise AssertionError(f"{words} are no command")


def subcommands(table: dict[str, Any]) -> tuple[Any, ...]:
    """Return the commands of a table, each as a subcommand."""
    return tuple(
        described(name, with_common(kind), kind.__doc__ or "") for name, kind in table.items()
    )


def described(name: str, kind: Any, text: str) -> Any:
    """Return the class as a subcommand, with the first line of a text."""
    return Annotated[kind, tyro.conf.subcommand(name, description=text.partition("\n")[0])]


def with_common(kind: Any) -> Any:
    """Return a class of the options of a command, and after them those of `Everywhere`."""
    return make_dataclass(kind.__name__, (), bases=(Everywhere, kind), frozen=True)


def parse_options(kind: Any, prog: str, words: Sequence[str]) -> tuple[Everywhere, Any]:
    """Return the options that every command takes, and those of this class.

    Raises ValueError, which names the option and what it takes, where tyro would print some lines.
    """
    both = with_common(kind)
    known = {f"--{field.name.replace('_', '-')}": field.name for field in fields(both)}
    hints = get_type_hints(both)

    def refuse(option: str, given: str) -> None:
        wanted = f"Give {described_type(hints[known[option]])}"
        fail(option, given, f"{wanted}; see {prog} --help")

    for place, word in enumerate(words):
        if word == "" or word.removesuffix("=") in known and word.endswith("="):
            before = (w.partition("=")[0] for w in reversed(words[: place + 1]))
            option = next((name for name in before if name in known), None)
            if option is not None:
                refuse(option, "no value")
    text = io.StringIO()
    try:
        with contextlib.redirect_stderr(text):
            found, rest = tyro.cli(
                both,
                prog=prog,
                description=inspect.getdoc(kind),
                args=words,
                return_unknown_args=True,
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        name = next((w for w in re.findall(r"--[\w-]+", text.getvalue()) if w in known), None)
        needed = next((field.name for field in fields(kind) if field.default is MISSING), None)
        if name is None and needed is not None:
            fail(prog, f"no {needed} given", f"Name it after the command; see {prog} --help")
        if name is None:
            fail(prog, " ".join(re.sub(r"[^ -~]", " ", text.getvalue()).split()), "")
        refuse(name, values_of(name, words))
    if rest:
        what = "no such option" if rest[0].startswith("-") else "belongs to no option"
        switches = [f"--no-{field.name}" for field in fields(kind) if field.default is True]
        meant = nearest(rest[0].partition("=")[0], [*known, *switches, "--help"])
        if rest[0].endswith(".toml"):
            option = "--config" if "--config" in known else "--output"
            meant = f"Write {option} {rest[0]}. "
        fail(rest[0], what, f"{meant}See {prog} --help")
    common, options = (
        part(**{field.name: getattr(found, field.name) for field in fields(part)})
        for part in (Everywhere, kind)
    )
    return common, options


def values_of(option: str, words: Sequence[str]) -> str:
    """Return the words that follow the last mention of an option, or "no value"."""
    found, taken = list[str](), False
    for word in words:
        name, equals, value = word.partition("=")
        if name.replace("_", "-") == option:
            found, taken = [value] if equals else [], True
        elif word.startswith("--"):
            taken = False
        elif taken:
            found.append(word)
    text = " ".join(found) or "no value"
    return text if len(text) < 60 else f"{text[:57]}..."


def described_type(kind: Any) -> str:
    """Return what an option of this type takes, in words."""
    if get_origin(kind) in (Union, types.UnionType):
        kind = next(part for part in get_args(kind) if part is not type(None))
    if get_origin(kind) is Literal:
        return f"one of {', '.join(map(str, get_args(kind)))}"
    if get_origin(kind) is tuple:
        inner = get_args(kind)[0]
        return {int: "whole numbers", float: "numbers"}.get(inner) or described_type(inner)
    return {int: "a whole number", float: "a number", Path: "a path"}.get(kind, "a text")


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


class OnlyErrors:
    """A stream of which only the lines of `report_error` are seen, no progress."""

    def __init__(self, stream: Any) -> None:
        self._stream, self._line = stream, ""

    def write(self, text: str) -> int:
        """Take a text, and write the lines that it ends, if they are errors."""
        *lines, self._line = (self._line + text).split("\n")
        for line in lines:
            if line.startswith(ERROR):
                self._stream.write(line + "\n")
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextlib.contextmanager
def plain_output(out: Any = None, err: Any = None) -> Iterator[None]:
    """Let all that is printed pass through `Plain`, to these streams in place of the usual ones."""
    out = Plain(sys.stdout if out is None else out)
    err = Plain(sys.stderr if err is None else err)
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        yield


def report_error(message: str) -> int:
    """Print one line on stderr and return the exit code, 2."""
    print(f"{ERROR}{printable(' '.join(message.split()))}", file=sys.stderr)
    return 2
