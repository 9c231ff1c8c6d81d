"""The command `jaxmpc` in tests: how it is called, and what it prints."""

import shlex

import pytest

from jaxmpc.app import cli


def run(line):
    return cli.main(shlex.split(line))


def help_page(line, capsys, options=""):
    """What a command prints for --help, where each of these options stands."""
    with pytest.raises(SystemExit) as caught:
        run(f"{line} --help")
    assert caught.value.code == 0
    text = capsys.readouterr().out
    for word in options.split():
        assert f"--{word}" in text
    return text


def error_of(line, capsys):
    """The one line on stderr with which a command ends."""
    assert run(line) == 2
    err = capsys.readouterr().err
    assert err.startswith("jaxmpc: error: ") and err.count("\n") == 1
    return err


def rows(out):
    """The table: {name: rest of the line}."""
    lines = (line for line in out.splitlines() if line.startswith("  "))
    return {line[2:16].strip(): line[16:].strip() for line in lines}
