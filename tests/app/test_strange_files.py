"""Files and names of strangers: large ones are refused before they are parsed, and no name steers
the terminal."""

import re
import time
import tracemalloc

import numpy as np
import pytest
from problems import MINIMAL_FILE

import jaxmpc as jm
from jaxmpc.app import cli
from jaxmpc.app.config import load, loading
from jaxmpc.checks import installing, printable, require_package
from jaxmpc.files import text_within

STEERING = ("\x1b[2J", "\x07", "a\nb", "a\rb", "\x9b31m", "\u202etxt", "\u2028", "\x7f")


@pytest.mark.parametrize(
    "text",
    [
        ".".join(["a"] * 30_000) + " = 1",
        " . ".join(["'a, b'", '"c\\"= d"'] * 15_000) + " = 1",
        f"[{'.'.join(['a'] * 30_000)}]",
        f"x = {{{'.'.join(['a'] * 30_000)} = 1}}",
        'x = """ " """\n' + ".".join(["a"] * 30_000) + " = 1",
    ],
)
def test_long_keys_are_refused_before_they_are_parsed(tmp_path, text):
    path = tmp_path / "case.toml"
    path.write_text(text)
    tracemalloc.start()
    begun = time.monotonic()
    with pytest.raises(
        ValueError, match=f"case.toml: holds a key of more than {loading.MOST_DOTS}"
    ):
        loading.read_toml(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert time.monotonic() - begun < 5 and peak < 1e8


def test_large_files_are_refused_by_their_size(tmp_path):
    path = tmp_path / "case.toml"
    path.write_text("#" * 1_500_000)
    with pytest.raises(ValueError, match=r"case.toml: 1,500,000 bytes .* 1,000,000"):
        loading.read_toml(path)
    with pytest.raises(ValueError, match="/dev/zero: 101 bytes are more than the 100"):
        text_within("/dev/zero", 100)


def test_dots_in_texts_and_numbers_are_none_of_keys(tmp_path):
    path = tmp_path / "case.toml"
    dots = "A sentence... and more, " * 20
    path.write_text(f'name = "{"a." * 50}"\n# {dots}{MINIMAL_FILE}')
    assert load(path).name == "a." * 50


@pytest.mark.parametrize("name", STEERING)
def test_names_that_steer_a_terminal_are_refused(tmp_path, name):
    A, B = np.eye(2), np.ones((2, 1))
    for field, value in (
        ("state_names", ("q", name)),
        ("state_units", ("m", name)),
        ("input_names", (name,)),
        ("input_units", (name,)),
    ):
        with pytest.raises(ValueError, match=f"{field}: .* control characters"):
            jm.LinearSystem(A, B, **{field: value}).validate()
    with pytest.raises(ValueError, match="labels: .* control characters"):
        jm.Polytope(np.eye(2), np.ones(2), ("a", name)).validate("states")
    quoted = "".join(f"\\u{ord(c):04x}" for c in name)
    path = tmp_path / "case.toml"
    path.write_text(f'name = "{quoted}"{MINIMAL_FILE}')
    with pytest.raises(ValueError, match="case.toml: name: .* control characters"):
        load(path)


def test_ordinary_names_are_kept():
    for name in ("q [rad]", "Ω̇ m/s²", "角度", "N·m"):
        assert printable(name) == name
        jm.LinearSystem(np.eye(1), np.ones((1, 1)), state_names=(name,)).validate()


def test_paths_are_printed_as_escapes(tmp_path, capsys):
    path = tmp_path / "\x1b]0;mine\x07"
    assert cli.main(["sweep", "--config", str(path)]) == 2
    assert cli.main(["init", "--output", str(path)]) == 0
    out, err = capsys.readouterr()
    assert "\\x1b]0;mine\\x07" in out and "\\x1b]0;mine\\x07" in err
    assert not re.search("[\x00-\x08\x0b-\x1f]", out + err)


def test_progress_passes(capsys):
    with cli.plain_output():
        print("\r50 %\t\n\x1b[2J", end="")
    assert capsys.readouterr().out == "\r50 %\t\n\\x1b[2J"


def test_what_is_missing_is_installed_from_the_source():
    assert installing("robots").startswith("pip install -e '.[robots]'")
    with pytest.raises(ImportError, match=re.escape(installing("bench"))):
        require_package("no_such_package", "bench")
