"""The command `jaxmpc` in tests: how it is called, and what it prints."""

import shlex

from jaxmpc.app import cli


def run(line):
    return cli.main(shlex.split(line))


def rows(out):
    """The table: {name: rest of the line}."""
    lines = (line for line in out.splitlines() if line.startswith("  "))
    return {line[2:16].strip(): line[16:].strip() for line in lines}
