"""Compiled programs, kept between runs of the command in a folder of the user's cache.

JAX writes them (its persistent compilation cache), but not in one step, reads whatever is there,
and never replaces an entry. So a process works in a folder of its own: it begins with links to the
entries whose content has the checksum in their name, and what it adds is linked back, whole, when
it ends. Killed, concurrent or damaged, no process disturbs another; at worst one compiles again.
The entries of a processor with other features than this one's lie in another folder.

Nothing here imports JAX, which reads these variables of the environment when it is imported.
"""

import contextlib
import hashlib
import os
import platform
import shutil
import tempfile
import time
import warnings
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path

# Commands that keep programs: those that compile for more than some seconds.
KEEPING = ("sweep", "recursion", "simulate", "tune", "info", "verify")
# Bytes that all entries may take; the oldest go first.
LIMIT = 2**28
# Beginning of the name of a process's own folder.
RUN = "jaxmpc-run-"
# Seconds after which the folder of a process counts as left behind.
LEFT_BEHIND = 14 * 86400.0


def user_cache() -> Path:
    """Return this package's folder in the user's cache (XDG base directories)."""
    home = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(home) if Path(home).is_absolute() else Path.home() / ".cache") / "jaxmpc"


def programs_folder() -> Path | None:
    """Return where programs for this processor are kept, or None if JAXMPC_CACHE is "off"."""
    if os.environ.get("JAXMPC_CACHE", "").lower() in ("off", "no", "false", "0"):
        return None
    features = [platform.system(), platform.machine()]
    with contextlib.suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        features += sorted({line for line in lines if line.startswith(("flags", "Features"))})
    digest = hashlib.sha256("\n".join(features).encode()).hexdigest()[:8]
    return user_cache() / "programs" / f"{platform.machine() or 'processor'}-{digest}"


@contextlib.contextmanager
def defaults(**variables: str) -> Iterator[None]:
    """Set those of these variables of the environment that are not set, and take them back."""
    own = {name: value for name, value in variables.items() if name not in os.environ}
    os.environ.update(own)
    try:
        yield
    finally:
        for name in own:
            os.environ.pop(name, None)


@contextlib.contextmanager
def kept_programs(words: Sequence[str]) -> Iterator[None]:
    """Keep the programs that the command in `words` compiles, and use those of earlier runs.

    Sets variables of the environment meanwhile, which JAX reads when it is imported. Does nothing
    where JAXMPC_CACHE is "off", where JAX_COMPILATION_CACHE_DIR is set (JAX then keeps programs
    there), and where the user's cache cannot be written.
    """
    own = None
    if words and words[0] in KEEPING and "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        with contextlib.suppress(OSError, RuntimeError):  # RuntimeError: no home
            folder = programs_folder()
            own = None if folder is None else _begin(folder)
    if own is None:
        yield
        return
    variables = {
        "JAX_COMPILATION_CACHE_DIR": str(own),
        # Small programs too: dozens of them make up seconds.
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        # XLA's own caches on GPUs are not ours to keep whole.
        "JAX_PERSISTENT_CACHE_ENABLE_XLA_CACHES": "none",
    }
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache")
    given = {path.name for path in own.iterdir()}
    try:
        with defaults(**variables):
            yield
    finally:
        with contextlib.suppress(OSError):
            _end(own, given)
        shutil.rmtree(own, ignore_errors=True)


def _begin(folder: Path) -> Path:
    """Make the folder of this process, with links to all entries of `folder` that are whole."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    for left in folder.glob(f"{RUN}*"):
        if _age(left) > LEFT_BEHIND:
            shutil.rmtree(left, ignore_errors=True)
    own = Path(tempfile.mkdtemp(prefix=RUN, dir=folder))
    total = 0
    for path in sorted(folder.glob("*-cache.*"), key=_age):
        with contextlib.suppress(OSError):  # another process removes it
            content, target = path.read_bytes(), own / path.stem
            total += len(content)
            if total > LIMIT or target.exists() or path.suffix != _checksum(content):
                path.unlink()
            else:
                _link(path, target)
    return own


def _age(path: Path) -> float:
    """Return the seconds since the file was written; inf where there is none any more."""
    try:
        return time.time() - path.stat().st_mtime
    except OSError:
        return float("inf")


def _end(own: Path, given: set[str]) -> None:
    """Link what this process has added to the folder above."""
    for path in own.glob("*-cache"):
        if path.name not in given:
            _link(path, own.parent / f"{path.name}{_checksum(path.read_bytes())}")


def _checksum(content: bytes) -> str:
    return f".{zlib.crc32(content):08x}"


def _link(source: Path, target: Path) -> None:
    """Let `target` be the same file, or a copy; it appears there whole, or is there already."""
    try:
        os.link(source, target)
    except FileExistsError:
        pass
    except OSError:  # a file system without links
        side = target.with_name(f".{target.name}.{os.getpid()}")
        shutil.copyfile(source, side)
        os.replace(side, target)
