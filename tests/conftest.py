"""Runs before any test module, hence before jax is imported: settings of JAX for tests.

Most of the time of a test goes into compiling programs that run once: 20 ms the smallest, seconds a
QP solver. LLVM's optimisations are off, which halves that, and equal programs compile once a run:
all workers share a cache in a temporary folder. `JAX_DISABLE_MOST_OPTIMIZATIONS=0 pytest` runs the
tests on optimised programs; `JAX_COMPILATION_CACHE_DIR=folder pytest` keeps programs for later.

A CPU bug of old jaxlibs: from 0.7.0 until 0.11.1, XLA's fusion emitters recompute long chains of
small operations again and again (a step of a 7-joint robot is 500 times slower). The flag is
unknown to later versions, which abort on it. These compile every kernel through MLIR, which takes
twice the time: on JAX 0.12.0 a QP solver 3.7 s of CPU time, on 0.10.2 1.6 s, the smallest program
16 and 9 ms. No flag of 0.12 changes that (xla_cpu_opt_preset, xla_cpu_parallel_codegen_split_count,
xla_cpu_emitter_verification_level, xla_disable_hlo_passes=fusion,fusion-wrapper and others were
tried; neither xla_cpu_small_while_loop_byte_threshold, xla_cpu_use_new_xtile_lowering nor the
malloc settings of glibc): only fewer programs do, hence tests of one file share
shapes. The files with most tests run first, so that both workers end within seconds of each other.
And one thread for OpenBLAS, whose threads wait for each other on busy cores. The library itself
never touches the environment.

Traces make many small objects that live on, which Python's collector visits again and again: it
runs more rarely (on Python 3.11, 4 and 7 % less CPU time in two groups of 60 tests).
"""

import functools
import gc
import importlib.util
import os
import re
import tempfile
from importlib.metadata import version
from pathlib import Path

import pytest

gc.set_threshold(100_000, 20, 100)

_jaxlib = tuple(int(part) for part in re.findall(r"\d+", version("jaxlib"))[:3])
if (0, 7, 0) <= _jaxlib < (0, 11, 1):
    _flags = os.environ.get("XLA_FLAGS", "")
    os.environ["XLA_FLAGS"] = f"{_flags} --xla_cpu_use_fusion_emitters=false".strip()
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    # Of the process that starts the workers, which inherit the environment; removed as it ends.
    _programs = tempfile.TemporaryDirectory(prefix="jaxmpc-programs-", ignore_cleanup_errors=True)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _programs.name
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

# Each kernel of a compiled program keeps some memory maps, of which a process may have 65,530 (one
# more, and it ends by SIGSEGV). A module adds up to 30,000, of fast tests up to 3,000.
MAPS = 30_000


def pytest_configure(config):
    # A program that another worker is about to write; this one compiles it then.
    config.addinivalue_line("filterwarnings", "ignore:Error reading persistent compilation cache")


@pytest.hookimpl(tryfirst=True)  # before -m chooses
def pytest_collection_modifyitems(items):
    """Mark the cases of a parametrised test after the first k as slow: `@pytest.mark.first(k)`."""
    seen: dict[str, int] = {}
    for item in items:
        mark = item.get_closest_marker("first")
        if mark is None or item.get_closest_marker("slow"):
            continue
        name = item.nodeid.partition("[")[0]
        seen[name] = seen.get(name, 0) + 1
        if seen[name] > mark.args[0]:
            item.add_marker("slow")


@functools.cache
def _comparison():
    """Return the module that compares steps of robots with the C engine's, and its function."""
    if importlib.util.find_spec("mujoco") is None:
        return None
    from jaxmpc.robots import mjx_gaps

    return mjx_gaps, mjx_gaps._differences


@pytest.hookimpl(tryfirst=True)  # before robots are made that all tests of a module share
def pytest_runtest_setup(item):
    """Load robots without the comparison of their steps with the C engine's, for which a program
    is compiled each time, but where that is what is tested, and in slow tests."""
    if (found := _comparison()) is not None:
        whole = item.get_closest_marker("compared") or item.get_closest_marker("slow")
        found[0]._differences = found[1] if whole else lambda *args: ()
    if item.get_closest_marker("cpu"):
        import jax

        if jax.default_backend() != "cpu":
            pytest.skip("about CPUs")


@pytest.fixture(scope="module", autouse=True)
def _forget_programs():
    """Before the process has too many memory maps. What is needed again comes from the cache."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") < MAPS:
        return
    import jax

    from jaxmpc.batches import Compiled

    for found in gc.get_objects():
        if type(found) is Compiled:
            found.programs.clear()
    jax.clear_caches()
    gc.collect()


@pytest.fixture
def in_empty_folder(tmp_path, monkeypatch):
    """Run commands in an empty folder, for a terminal of 100 columns."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")


@pytest.fixture
def x64():
    """Let JAX compute in float64 during a test."""
    import jax

    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def x64_of_module():
    """The same for the fixtures that all tests of a module share."""
    import jax

    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def compiled():
    """Return a list to which each program that is compiled is added; clear it at will."""
    import jax

    found: list[str] = []

    def note(event, seconds, **about):
        if event == "/jax/core/compile/backend_compile_duration":
            found.append(event)

    jax.monitoring.register_event_duration_secs_listener(note)
    yield found
    jax.monitoring.unregister_event_duration_listener(note)


@pytest.fixture(autouse=True)
def _no_empty_panel(monkeypatch):
    """Every picture that a test saves, also by a command, has something in each panel."""
    from matplotlib.figure import Figure
    from panels import require_no_empty_panel

    save = Figure.savefig

    def checked(self, *args, **options):
        require_no_empty_panel(self)
        return save(self, *args, **options)

    monkeypatch.setattr(Figure, "savefig", checked)
