"""The command `jaxmpc`: parse the command line, run the subcommand, and report how it ended."""

import ast
import contextlib
import importlib
import io
import json
import os
import re
import shlex
import signal
import sys
import time
import types
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, make_dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro

import jaxmpc
from jaxmpc.app.commands.options import check_values
from jaxmpc.checks import fail, nearest, printable

# Module and class of each command: only the one that is called is imported. The class is a
# dataclass of options, its docstring the help, `run()` the command, and `keeps` says what is there
# of a run that was stopped, which --resume goes on from; "" for nothing (see `commands/init.py`).
COMMANDS = {
    "init": ("init", "Init"),
    "sweep": ("sweep", "Sweep"),
    "recursion": ("recursion", "Recursion"),
    "info": ("info", "Info"),
    "simulate": ("simulate", "Simulate"),
    "verify": ("verify", "Verify"),
    "export": ("export", "Export"),
    "report": ("report", "Report"),
}
DESCRIPTION = """Constrained MPC in batches, with proofs. Also: jaxmpc --version

Every command takes --quiet (errors alone), --json (one JSON object in place of tables),
--format {pdf,svg,png} (pictures in this format beside PNG) and --width {page,column} (of maps, for
papers). docs/how-to/commands.md tells more."""
# How pictures can be, and the files in which commands keep their results as JSON.
CHOICES = {"--format": ("pdf", "svg", "png"), "--width": ("page", "column")}
RECORDS = ("summary.json", "tuning.json", "solver.json")
# What the line of an error begins with.
ERROR = "jaxmpc: error: "
# Options of tyro that write a completion script for a shell, and the words that each needs.
COMPLETIONS = {"--tyro-print-completion": 2, "--tyro-write-completion": 3}
TUNE = "Learn what is usually guessed: an MPC's weights, or the penalties of its solver."
TUNERS = {"weights": ("tune_weights", "TuneWeights"), "solver": ("tune_solver", "TuneSolver")}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code: 0 done, 2 error, 130 interrupted, 141 nobody reads
    its output any more."""
    argv = list(sys.argv[1:] if argv is None else argv)
    everywhere = Everywhere()
    for stream in (sys.stdout, sys.stderr):  # what their encoding lacks becomes "?"
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    if argv == ["--version"]:
        print(f"jaxmpc {jaxmpc.__version__}")
        return 0
    try:
        everywhere, words = options_of_all(argv)
        command = parse(words)
    except BrokenPipeError:
        return without_reader()
    except (ValueError, OSError, AssertionError) as error:  # tyro asserts that it knows a shell
        return report_error(str(error))
    if everywhere.format is not None or everywhere.width == "column":
        import matplotlib

        matplotlib.rcParams["savefig.format"] = everywhere.format or "png"
        if everywhere.width == "column":  # which `jaxmpc.app.plots` reads
            matplotlib.rcParams["figure.figsize"] = (3.5, 3.6)
            matplotlib.rcParams["font.size"] = 8
    if not (everywhere.quiet or everywhere.json):
        with plain_output():
            return run(command, argv)
    said, begun = io.StringIO(), time.time()
    with plain_output(said, OnlyErrors(sys.stderr)):
        code = run(command, argv)
    if everywhere.json:
        print(json.dumps(as_json(command, words, code, said.getvalue(), begun), indent=2))
    return code


@dataclass(frozen=True)
class Everywhere:
    """Options that every command takes.

    quiet: print errors alone. json: print one JSON object in place of tables. format: of pictures,
    beside PNG; None for PNG alone. width: of pictures, "page" or "column".
    """

    quiet: bool = False
    json: bool = False
    format: str | None = None
    width: str = "page"


def options_of_all(argv: Sequence[str]) -> tuple[Everywhere, list[str]]:
    """Return the options that every command takes, and the other words. Raises ValueError for a
    format or a width that there is not."""
    found: dict[str, Any] = {}
    rest, words = list[str](), list(argv)
    while words:
        word = words.pop(0)
        name, equals, value = word.partition("=")
        if word in ("--quiet", "--json"):
            found[word[2:]] = True
        elif name in CHOICES:
            value = value if equals else words.pop(0) if words else "no value"
            if value not in CHOICES[name]:
                fail(name, value, f"Give one of {', '.join(CHOICES[name])}")
            found[name[2:]] = value
        else:
            rest.append(word)
    return Everywhere(**found), rest


def as_json(
    command: Any, words: Sequence[str], code: int, said: str, begun: float
) -> dict[str, Any]:
    """Return what a command came to: its exit code, the lines that it printed, and what it wrote
    as JSON into its folder since `begun`."""
    folder: Any = getattr(command, "output", None)
    summary = None
    for name in RECORDS if folder is not None else ():
        path = Path(folder) / name
        if path.is_file() and path.stat().st_mtime >= begun - 1:
            summary = json.loads(path.read_text(encoding="utf-8"))
    return {
        "command": " ".join(words[: 2 if words[:1] == ["tune"] else 1]),
        "exit_code": code,
        "output": None if folder is None else str(folder),
        "lines": said.splitlines(),
        "summary": summary,
    }


def run(command: Any, argv: Sequence[str]) -> int:
    """Run a parsed command and return its exit code."""
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:  # as in the background
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        check_values(command)
        return command.run() or 0
    except BrokenPipeError:
        return without_reader()
    except (ValueError, OSError, MemoryError, ImportError) as error:
        return report_error(named_options(str(error), command))
    except KeyboardInterrupt:
        if not command.keeps:
            print("\nstopped; nothing is kept")
            return 130
        again = [word for word in argv if word not in ("--overwrite", "--resume")]
        resume = shlex.join(["jaxmpc", *again, "--resume"])
        print(f"\nstopped; {command.keeps} that were done are kept. Go on with:\n  {resume}")
        return 130


def without_reader() -> int:
    """Return the exit code of a command whose output goes to a program that has ended, such as
    `head`: silently, and with nothing left to be written at the end of the process."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 128 + signal.SIGPIPE


def named_options(message: str, command: Any) -> str:
    """Return an error of the library, which begins with its arguments, with their options."""
    names, colon, rest = message.partition(": ")
    if names == str(getattr(command, "output", None)):
        return f"--output {message}"
    known = {field.name for field in fields(command)}
    option_of = lambda word: f"--{word[0].replace('_', '-')}" if word[0] in known else word[0]
    if re.fullmatch(r"\w+(,? \w+)*", names):
        names = re.sub(r"\w+", option_of, names)
    return names + colon + rest


def parse(argv: Sequence[str]) -> Any:
    """Return the command with its options.

    `jaxmpc COMMAND --help` prints a page; `jaxmpc --help` and `jaxmpc tune --help` one line each.
    Raises ValueError for commands, options and values that there are not.
    """
    prog, table, words = "jaxmpc", COMMANDS, list(argv)
    if words[:1] == ["tune"]:
        prog, table, words = "jaxmpc tune", TUNERS, words[1:]
    if words and words[0] in table:
        kind = _class(*table[words[0]])
        return parse_options(kind, f"{prog} {words[0]}", words[1:])
    first = words[0] if words else ""
    if first not in ("-h", "--help") and not 0 < COMPLETIONS.get(first, 0) <= len(words):
        known = [*table, *(["tune"] if table is COMMANDS else [])]
        given = f"no command {first!r}" if words else "no command given"
        fail(prog, given, f"{nearest(first, known)}There are {', '.join(known)}; see {prog} --help")
    # A list of the commands needs none of their options, hence neither JAX nor their modules.
    listed = lambda module, kind: make_dataclass(kind, ())
    options = listed if first in ("-h", "--help") else _class
    described = [
        _described(name, options(*where), first_line(*where)) for name, where in table.items()
    ]
    if table is COMMANDS:
        described.append(_described("tune", make_dataclass("Tune", ()), TUNE))
    choice: Any = Union[tuple(described)]  # noqa: UP007
    text = TUNE if table is TUNERS else DESCRIPTION
    return tyro.cli(choice, prog=prog, description=text, args=words)


def parse_options(kind: Any, prog: str, words: Sequence[str]) -> Any:
    """Return a command of this class with the options in `words`.

    Raises ValueError, which names the option and what it takes, where tyro would print some lines.
    """
    known = {f"--{field.name.replace('_', '-')}": field.name for field in fields(kind)}
    text = io.StringIO()
    try:
        with contextlib.redirect_stderr(text):
            command, rest = tyro.cli(kind, prog=prog, args=words, return_unknown_args=True)
    except SystemExit as stop:
        if not stop.code:
            raise
        found = next((w for w in re.findall(r"--[\w-]+", text.getvalue()) if w in known), None)
        if found is None:
            fail(prog, " ".join(re.sub(r"[^ -~]", " ", text.getvalue()).split()), "")
        wanted = f"Give {described_type(get_type_hints(kind)[known[found]])}"
        fail(found, values_of(found, words), f"{wanted}; see {prog} --help")
    if rest:
        what = "no such option" if rest[0].startswith("-") else "belongs to no option"
        switches = [f"--no-{field.name}" for field in fields(kind) if field.default is True]
        meant = nearest(rest[0].partition("=")[0], [*known, *switches, "--help"])
        fail(rest[0], what, f"{meant}See {prog} --help")
    return command


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


def _class(module: str, name: str) -> Any:
    """Import a command's module and return its class."""
    return getattr(importlib.import_module(f"jaxmpc.app.commands.{module}"), name)


def first_line(module: str, name: str) -> str:
    """Return the first line of the docstring of a command's class, read from its source: to import
    the module would take seconds."""
    source = (Path(__file__).parent / "commands" / f"{module}.py").read_text(encoding="utf-8")
    classes = (node for node in ast.parse(source).body if isinstance(node, ast.ClassDef))
    found = next(node for node in classes if node.name == name)
    return (ast.get_docstring(found) or "").partition("\n")[0]


def _described(name: str, kind: Any, text: str) -> Any:
    """Return the class as a subcommand with this description."""
    return Annotated[kind, tyro.conf.subcommand(name, description=text)]


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
