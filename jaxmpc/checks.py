"""Input checks of public functions, made before anything compiles.

Inside `jit`, `vmap` or `grad` an array has a shape but no value: shapes are checked there, values
are not (a solver reports bad values of a batch by its status). JAX is imported where it is needed:
the command's help does without it.
"""

import difflib
import math
import os
import re
import shutil
import unicodedata
from collections.abc import Iterable, Mapping, Set
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from jaxmpc.names import public_name

# Counts are 32-bit integers in compiled programs.
MOST_COUNT = 2**31 - 1


def fail(argument: str, problem: str, cure: str) -> NoReturn:
    """Raise a ValueError that names the argument, what is wrong, and what to do."""
    problem = re.sub(r"\bis a (?=[aeioAEIO]|nd|MPC\b|LQR\b|Mj)", "is an ", problem)
    raise ValueError(printable(f"{argument}: {problem}. {cure}"))


# Kinds of characters (Unicode) that steer a terminal or a text and show nothing themselves.
STEERING = ("Cc", "Cf", "Cs", "Zl", "Zp")


def printable(text: str, keep: str = "\n") -> str:
    """Return a text for a terminal: what would steer it is written as an escape, but for the
    characters to keep."""
    if text.isascii() and text.isprintable():
        return text
    steers = lambda c: c not in keep and unicodedata.category(c) in STEERING
    return "".join(ascii(c)[1:-1] if steers(c) else c for c in text)


def require_printable(argument: str, *names: str) -> None:
    """Raise where a name holds characters that steer a terminal."""
    for name in names:
        if printable(name, keep="") != name:
            cure = "Give a name without control characters"
            fail(argument, f"{ascii(name)} holds control characters", cure)


def require_names(
    argument: str, value: object, count: int, cure: str = 'Write it as ("q", "dq")'
) -> None:
    """Raise unless a value is a tuple of strings, `count` of them or none, that are printable."""
    if not isinstance(value, tuple) or not all(isinstance(name, str) for name in value):
        fail(argument, f"{value!r} is not a tuple of strings", cure)
    if len(value) not in (0, count):
        fail(argument, f"{len(value)} entries where {count} are needed", "Give all or none")
    require_printable(argument, *value)


def installing(extra: str) -> str:
    """Return how to install an extra: from the source, as this package is on no index."""
    return f"pip install -e '.[{extra}]' in the folder of jaxmpc's source"


def nearest(word: str, known: Iterable[str]) -> str:
    """Return "Did you mean ...? " with the known word that is most like `word`, "" if none is."""
    found = difflib.get_close_matches(word, [str(name) for name in known], 1, 0.7)
    return f"Did you mean {found[0]}? " if found else ""


def require_kind(argument: str, value: Any, *kinds: type, cure: str = "") -> None:
    """Raise unless `value` is of one of these kinds. cure: what to do; "": give one of them."""
    if not isinstance(value, kinds):
        wanted = " or ".join(public_name(kind.__name__) for kind in kinds)
        fail(argument, f"is a {type(value).__name__}", cure or f"Give a {wanted}")


def require_package(package: str, extra: str) -> None:
    """Raise ImportError, which names the extra to install, where a package is not there."""
    if find_spec(package) is None:
        what = f"{package} is not installed. Install it: {installing(extra)}"
        raise ImportError(what, name=package)


def require_memory(argument: str, needed: float, cure: str) -> None:
    """Raise where `needed` bytes exceed the memory that is available."""
    available = available_memory()
    if needed > available:
        fail(argument, f"needs {in_units(needed)} of memory, {in_units(available)} are free", cure)


def require_disk(argument: str, needed: float, folder: Path, cure: str) -> None:
    """Raise where `needed` bytes exceed the free space of the disk that holds `folder`, which need
    not exist."""
    there = next((path for path in (folder, *folder.absolute().parents) if path.exists()), None)
    free = shutil.disk_usage(there).free if there else np.inf
    if needed > free:
        what = f"needs at least {in_units(needed)} on disk, {in_units(free)} are free"
        fail(argument, what, cure)


def available_memory() -> float:
    """Return the bytes of memory that this process can still get: what the system says, or the
    size of the machine where it does not say, and at most the limit of a container."""
    found = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    try:  # Linux; free pages alone would leave out what caches give back
        lines = Path("/proc/meminfo").read_text().splitlines()
        found = next(1024.0 * int(v.split()[1]) for v in lines if v.startswith("MemAvailable"))
    except (OSError, StopIteration):
        pass
    for limit in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        try:
            found = min(found, float(Path(limit).read_text()))
        except (OSError, ValueError):  # none, or "max"
            continue
    return found


def in_units(count: float) -> str:
    """Return a number of bytes as text, such as "14.4 GB"."""
    units = ("bytes", "kB", "MB", "GB", "TB")
    k = min(int(math.log10(max(count, 1))) // 3, len(units) - 1)
    return f"{count / 1000.0**k:.4g} {units[k]}"


def concrete(*values: Any) -> bool:
    """Return True when no value is being traced, so that all can be read."""
    # (Sets ask this of each of their arrays whenever JAX rebuilds them.)
    others = [v for v in values if not isinstance(v, np.ndarray | np.generic | float | int)]
    if not others:
        return True
    import jax

    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(others))


def require_untraced(
    argument: str, value: Any, cure: str = "Call it outside jit, vmap and grad"
) -> None:
    """Raise where any number in `value` is being traced, for computations outside JAX."""
    if not concrete(value):
        fail(argument, "is traced by JAX, and this computation is not traceable", cure)


def whole(argument: str, value: Any, least: int) -> int:
    """Return the value as an int; raise unless it is a whole number of at least `least`."""
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least:
        fail(argument, f"{value!r}", f"Give a whole number of at least {least}")
    return int(value)


def generator(seed: Any) -> np.random.Generator:
    """Return NumPy's random numbers for a seed; raise unless it is a whole number of at least 0."""
    return np.random.default_rng(whole("seed", seed, 0))


def entries(argument: str, values: Any, cure: str) -> list[Any]:
    """Return the entries of a list, tuple or array; raise for a number, a text, and what has no
    order."""
    ordered = isinstance(values, Iterable) and not isinstance(values, str | Mapping | Set)
    if not ordered or getattr(values, "ndim", 1) == 0:
        fail(argument, f"{shown(values)} is not a list", cure)
    return list(values)


def shown(value: Any) -> str:
    """Return a value as text of one line and less than 60 characters."""
    return shortened(" ".join(repr(value).split()), 60)


def shortened(text: str, most: int = 300) -> str:
    """Return a text, cut where it is not shorter than `most` characters."""
    return text if len(text) < most else f"{text[: most - 4]}..."


def require_real(argument: str, value: Any) -> None:
    """Raise unless a readable `value` is an array, or nested lists, of real numbers."""
    if not concrete(value):
        return
    if _hides(value):
        cure = "Give numbers in their place, by filled(...), or leave these rows out"
        fail(argument, "is a masked array that hides entries", cure)
    try:
        array = value if isinstance(getattr(value, "dtype", None), np.dtype) else np.asarray(value)
    except (TypeError, ValueError):
        fail(argument, f"{shown(value)} is not an array of numbers", "Give rows of equal length")
    if array.dtype.kind not in "biuf" and array.dtype.name != "bfloat16":
        found = shown(value) if np.ndim(array) == 0 else f"entries of type {array.dtype}"
        cure = "Give an array or nested lists of them"
        if type(value).__name__ == "LQR":
            cure = "Its gain is .K, its cost .P"
        if np.ndim(array) and array.dtype.kind in "OSU":
            cure = "Make numbers of them: np.asarray(..., dtype=float)"
        fail(argument, f"{found} where real numbers are needed", cure)


def _hides(value: Any) -> bool:
    """Return whether a masked array of NumPy, or one in nested lists, hides entries."""
    if isinstance(value, list | tuple):
        return any(map(_hides, value))
    return isinstance(value, np.ma.MaskedArray) and bool(np.ma.is_masked(value))


def counted(count: int, what: str) -> str:
    """Return "1 state" or "2 states"."""
    return f"{count:,} {what}{'s' * (count != 1)}"


def number(argument: str, value: Any, least: float, cure: str) -> None:
    """Raise unless a readable `value` is one number of at least `least`."""
    require_real(argument, value)
    if np.ndim(value) or (concrete(value) and not float(np.asarray(value)) >= least):
        fail(argument, f"{value}", cure)


def positive(argument: str, value: Any) -> None:
    """Raise unless a readable `value` is one finite number above 0."""
    cure = "Give a positive number"
    if isinstance(value, bool):
        fail(argument, f"{value}", cure)
    number(argument, value, np.finfo(np.float64).tiny, cure)
    if concrete(value) and np.isinf(value):
        fail(argument, f"{value}", "Give a finite number")


def require_shape(argument: str, value: Any, shape: tuple[int, ...], cure: str) -> None:
    """Raise unless `value` holds real numbers and has exactly this shape."""
    import jax.numpy as jnp

    require_real(argument, value)
    given = np.shape(value if concrete(value) else jnp.asarray(value))  # lists of traced numbers
    if given != shape:
        fail(argument, f"shape {given} where {shape} is needed", cure)


def require_last(argument: str, value: Any, shape: tuple[int, ...], cure: str) -> None:
    """Raise unless the last axes of an array have this shape; axes of batches may stand before."""
    given = tuple(getattr(value, "shape", None) or np.shape(value))
    if given[-len(shape) :] != shape:
        fail(argument, f"shape {given} where {shape} is needed", cure)


def require_finite(argument: str, value: Any) -> None:
    """Raise if a readable `value` holds NaN or infinity, or no real numbers."""
    require_real(argument, value)
    if concrete(value) and not np.all(np.isfinite(value)):
        fail(argument, "holds NaN or infinity", "Give finite numbers")


def require_symmetric_psd(
    argument: str,
    value: Any,
    *,
    definite: bool = False,
    cure: str = "Put a positive weight on every direction",
) -> None:
    """Raise unless a readable square `value` is symmetric and positive (semi)definite."""
    require_finite(argument, value)
    if not concrete(value):
        return
    matrix = np.asarray(value)
    eps = np.finfo(np.result_type(matrix, np.float32)).eps
    matrix = matrix.astype(np.float64)
    # Compared in units of the coordinates in which the diagonal is 1, where what its type rounds
    # off beside the largest entry is left out.
    noise = max(10 * eps * np.abs(matrix).max(initial=0.0), np.finfo(np.float64).tiny)
    raised = matrix + noise * np.eye(len(matrix))
    unit = 1 / np.sqrt(np.maximum(np.abs(np.diag(raised)), noise))
    raised = unit[:, None] * raised * unit
    if np.abs(raised - raised.T).max(initial=0.0) > max(1e-6, 10 * eps):
        for half, rest, k in (("triu", np.tril(matrix, -1), 1), ("tril", np.triu(matrix, 1), -1)):
            if not rest.any():
                whole = f"{argument} + np.{half}({argument}, {k}).T"
                cure = f"For one half of a symmetric matrix use {whole}"
                fail(argument, "is triangular, not symmetric", cure)
        fail(argument, "is not symmetric", f"Use ({argument} + {argument}.T) / 2")
    least = lambda M: np.linalg.eigvalsh(M / 2 + M.T / 2)[0]
    if definite and not is_definite(matrix):
        what = f"is not positive definite (least eigenvalue {least(matrix):.3g})"
        fail(argument, what, cure)
    if least(raised) < -max(1e-7, 10 * eps):
        what = f"is not positive semidefinite (least eigenvalue {least(matrix):.3g})"
        fail(argument, what, "A negative weight makes the problem non-convex: check signs")


def is_definite(matrix: np.ndarray) -> bool:
    """Return whether the symmetric part of a matrix (n, n) is positive definite by more than
    rounding: signs of its eigenvalues are those in units in which its diagonal is 1."""
    diagonal = np.diag(matrix)
    if not np.all(diagonal > 0):
        return False
    unit = 1 / np.sqrt(diagonal)
    scaled = unit[:, None] * (matrix / 2 + matrix.T / 2) * unit
    return bool(np.linalg.eigvalsh(scaled)[0] > 4 * len(scaled) * np.finfo(np.float64).eps)


def require_step_type(dtype: Any) -> None:
    """Raise unless ADMM's iterates may have this type."""
    try:
        known = np.dtype(dtype) in (np.float32, np.float64)
    except TypeError:
        known = False
    if not known:
        fail("dtype", f"{dtype!r}", "Iterate in 'float32' or 'float64'")
