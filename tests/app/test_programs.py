"""Compiled programs are kept between commands, whole or not at all, and waits are announced."""

import os
import subprocess
import sys
import time
import zlib
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.__main__ import session
from jaxmpc.app import program_cache
from jaxmpc.app.commands import compile_notice
from jaxmpc.app.commands.compile_notice import Compiling
from jaxmpc.app.program_cache import kept_programs
from jaxmpc.batches import Compiled

VARIABLE = "JAX_COMPILATION_CACHE_DIR"


@pytest.fixture(autouse=True)
def _own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_ENABLE_XLA_CACHES", "none")
    monkeypatch.delenv("JAXMPC_CACHE", raising=False)
    monkeypatch.delenv(VARIABLE, raising=False)


def entries():
    """What is kept: {name without the checksum: content}."""
    folder = program_cache.programs_folder()
    return {path.stem: path.read_bytes() for path in folder.glob("*-cache.*")}


def write(name, content):
    """What JAX does."""
    Path(os.environ[VARIABLE], name).write_bytes(content)


def test_entries_are_kept_whole_or_not_at_all():
    with kept_programs(["simulate"]):
        own = Path(os.environ[VARIABLE])
        write("a-cache", b"first")
        write("b-cache", b"second")
        write("notes", b"no entry")
        assert entries() == {}, "nothing half written is seen"
    assert entries() == {"a-cache": b"first", "b-cache": b"second"}
    assert VARIABLE not in os.environ and not own.exists()
    (damaged,) = own.parent.glob("b-cache.*")
    damaged.write_bytes(b"secons")
    with kept_programs(["tune"]):
        assert {path.name for path in Path(os.environ[VARIABLE]).iterdir()} == {"a-cache"}
        write("b-cache", b"second")
    assert entries() == {"a-cache": b"first", "b-cache": b"second"}


def test_processes_do_not_disturb_each_other(monkeypatch):
    with kept_programs(["sweep"]):
        write("a-cache", b"of both")
        one = os.environ.pop(VARIABLE)
        with kept_programs(["sweep"]):
            assert os.environ[VARIABLE] != one and not os.listdir(os.environ[VARIABLE])
            write("a-cache", b"of both")
            write("b-cache", b"of the second")
        monkeypatch.setenv(VARIABLE, one)
        write("c-cache", b"of the first")
    assert entries().keys() == {"a-cache", "b-cache", "c-cache"}
    # A process that was killed leaves its folder, which goes when it is old.
    left = program_cache.programs_folder() / f"{program_cache.RUN}killed"
    left.mkdir()
    with kept_programs(["sweep"]):
        assert left.exists()
    os.utime(left, (0, time.time() - 1.1 * program_cache.LEFT_BEHIND))
    with kept_programs(["sweep"]):
        assert not left.exists()


def test_the_oldest_go_when_there_are_too_many(monkeypatch):
    monkeypatch.setattr(program_cache, "LIMIT", 25)
    for k in range(3):
        with kept_programs(["sweep"]):
            write(f"{k}-cache", b"ten bytes.")
        (path,) = program_cache.programs_folder().glob(f"{k}-cache.*")
        os.utime(path, (0, 1000.0 + k))
    with kept_programs(["sweep"]):
        pass
    assert entries().keys() == {"1-cache", "2-cache"}


@pytest.mark.parametrize("links", [True, False])
def test_file_systems_without_links(monkeypatch, links):
    if not links:
        monkeypatch.setattr(os, "link", lambda *_: (_ for _ in ()).throw(PermissionError()))
    for _ in range(2):
        with kept_programs(["info"]):
            write("a-cache", b"one")
    assert entries() == {"a-cache": b"one"}
    assert len(os.listdir(program_cache.programs_folder())) == 1


def test_switches(tmp_path, monkeypatch):
    """JAXMPC_CACHE=off, the user's own folder, a command that compiles little, no folder at all."""
    with kept_programs(["report"]):
        assert VARIABLE not in os.environ
    monkeypatch.setenv("JAXMPC_CACHE", "off")
    with kept_programs(["simulate"]):
        assert VARIABLE not in os.environ
    monkeypatch.delenv("JAXMPC_CACHE")
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with kept_programs(["simulate"]):
        assert VARIABLE not in os.environ
    monkeypatch.setenv(VARIABLE, str(tmp_path / "mine"))
    with kept_programs(["simulate"]):
        assert os.environ[VARIABLE] == str(tmp_path / "mine")
    assert os.environ[VARIABLE] == str(tmp_path / "mine") and not (tmp_path / "mine").exists()


def test_a_wait_is_told_with_its_seconds(monkeypatch, capsys):
    """A line at the start and one when the last program is ready; a line that counts on a
    terminal; no second line where nothing had to be compiled."""
    clock = [0.0]
    monkeypatch.setattr(compile_notice, "time", SimpleNamespace(perf_counter=lambda: clock[0]))

    def waited(programs, *waits):
        with Compiling("closed loops of joint", programs):
            for k, seconds in enumerate(waits):
                clock[0] += seconds
                Compiled(jax.jit(lambda x: x + 1.0))(np.zeros(k + 1))
            clock[0] += 1000.0  # it runs
        return capsys.readouterr().err

    begun = "compiling closed loops of joint\n"
    assert waited(1, 40.0) == begun + "compiled closed loops of joint in 40 s\n"
    assert waited(0, 7.0, 3.0, 20.0) == begun + "compiled closed loops of joint in 30 s\n"
    assert waited(1) == begun and not Compiled.listeners
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    drawn = waited(1, 40.0)
    first, blank, end = drawn.rsplit("\r", 2)
    assert first.split("\r")[1].rstrip() == "compiling closed loops of joint, 0 s"
    assert not blank.strip() and end == "compiled closed loops of joint in 40 s\n"


PROGRAM = """
import numpy as np
from jaxmpc.app.program_cache import kept_programs
with kept_programs(["simulate"]):
    import jax
    import jax.numpy as jnp
    hits = []
    jax.monitoring.register_event_listener(
        lambda event, **_: hits.append(event) if event.endswith("/cache_hits") else None
    )
    A = jnp.sin(jnp.arange(900.0)).reshape(30, 30)
    step = lambda x, _: (jnp.tanh(A @ x) + 0.1 * x, jnp.exp(x).sum())
    run = jax.jit(lambda x: jax.lax.scan(step, x, length=50))
    x, sums = run(jnp.cos(jnp.arange(30.0)))
    print(len(hits) > 0, np.asarray(x).tobytes().hex(), sums.tolist())
"""


@pytest.mark.slow
def test_results_are_the_same_with_and_without():
    """Cold, kept, two at once, damaged and without: the same bits, and nothing on stderr."""
    paths = {**os.environ, "PYTHONPATH": str(Path(jm.__file__).parents[1])}

    def start(**more):
        command = [sys.executable, "-c", PROGRAM]
        pipes = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        return subprocess.Popen(command, env=paths | more, **pipes)

    def finish(process):
        out, err = process.communicate(timeout=250)
        assert process.returncode == 0 and not err, err
        hit, values = out.split(" ", 1)
        return hit == "True", values

    hit, values = finish(start(JAXMPC_CACHE="off"))
    assert not hit and not program_cache.user_cache().exists()
    assert finish(start()) == (False, values)
    kept = entries()
    assert any(name.startswith("jit__lambda") for name in kept)
    assert [finish(process) for process in [start(), start()]] == [(True, values)] * 2
    assert entries() == kept, "there was nothing to add"
    for path in program_cache.programs_folder().glob("*-cache.*"):
        path.write_bytes(path.read_bytes()[:-100] + bytes(100))
    assert finish(start()) == (False, values)
    assert entries().keys() == kept.keys()
    folder = program_cache.programs_folder()
    for path in list(folder.glob("*-cache.*")):  # with the right checksum, but no program
        (folder / f"{path.stem}.{zlib.crc32(b'nothing'):08x}").write_bytes(b"nothing")
        path.unlink()
    assert finish(start()) == (False, values)


def test_a_command_has_one_thread_of_openblas_unless_another_count_is_given(monkeypatch):
    """And leaves the environment of the process as it was."""
    for given, wanted in ((None, "1"), ("3", "3")):
        monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
        if given:
            monkeypatch.setenv("OPENBLAS_NUM_THREADS", given)
        before = dict(os.environ)
        with session(["info"]):
            assert os.environ["OPENBLAS_NUM_THREADS"] == wanted
        assert dict(os.environ) == before
