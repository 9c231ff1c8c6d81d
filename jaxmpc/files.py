"""Files of runs that can be killed and resumed: written atomically, with fingerprints.

Each file is written under a temporary name and renamed, so that a reader finds the old one or the
new one. A fingerprint of all that determines a result tells whether a file belongs to a run.
"""

import contextlib
import hashlib
import json
import math
import os
import re
import tempfile
import uuid
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, BinaryIO

import jax
import numpy as np

from jaxmpc.checks import fail, require_memory, shortened
from jaxmpc.version import __version__

# Packages, beside this one, whose versions a result depends on.
PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy", "scipy", "zarr")
# Bytes of a text file that is read, at most; that of a large problem has a tenth of it.
MOST_TEXT = 2**24


def fingerprint(plain: Any, *data: Any) -> str:
    """Return a hash (32 hexadecimal digits) of JSON data and of pytrees of arrays."""
    leaves, tree = jax.tree.flatten(data)
    state = hashlib.sha256(json.dumps(plain, sort_keys=True).encode() + str(tree).encode())
    for leaf in map(np.asarray, leaves):
        state.update(str((leaf.shape, leaf.dtype)).encode() + np.ascontiguousarray(leaf).tobytes())
    return state.hexdigest()[:32]


def differences(there: Any, here: Any, key: str = "") -> list[str]:
    """List where two pieces of JSON data differ, as "mpc.horizon: 20 there, 10 here"."""
    if isinstance(there, Mapping) and isinstance(here, Mapping):
        return [
            line
            for name in dict.fromkeys([*there, *here])
            for line in differences(there.get(name), here.get(name), f"{key}.{name}".lstrip("."))
        ]
    first, second = json.dumps(there), json.dumps(here)
    same = first == second
    return [] if same else [f"{key}: {shortened(first, 60)} there, {shortened(second, 60)} here"]


def versions() -> dict[str, str]:
    """Return the versions of this package and of those of `PACKAGES` that are installed."""
    found = {"jaxmpc": __version__}
    for name in PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with _replacing(path) as file:
        file.write(text.encode())


def write_json(path: Path, document: Any) -> None:
    """Write a JSON file atomically; see `as_json`."""
    write_text(path, json.dumps(as_json(document), indent=2, allow_nan=False) + "\n")


def write_results(path: Path, document: Mapping[str, Any]) -> None:
    """Write a JSON file with a hash of its own, by which damage to it is found."""
    plain = as_json(document)
    write_json(path, {**plain, "digest": fingerprint(plain)})


def read_results(path: Path) -> tuple[dict[str, Any], str]:
    """Return what `write_results` wrote, and what is wrong with it, "" where nothing is.

    Raises ValueError where it cannot be read.
    """
    found = faithful(path.name, text_within(path))
    if not isinstance(found, dict):
        fail(path.name, "holds no results", "Run the command again")
    digest = found.pop("digest", None)
    same = digest == fingerprint(found)
    return found, "" if same else f"{path.name}: is not as it was written"


def sha256(path: Path) -> str:
    """Return the SHA-256 hash of a file, in hexadecimal digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def text_within(path: Path | str, most: int = MOST_TEXT, kind: str = "text") -> str:
    """Return the text of a file of some kind. Raises ValueError where it is longer than that many
    bytes, is no text, or cannot be read."""
    try:
        with open(path, "rb") as file:
            content = file.read(most + 1)
            size = max(os.fstat(file.fileno()).st_size, len(content))
        text = content.decode("utf-8-sig")
    except OSError as error:
        fail(str(path), f"cannot be read ({error.strerror})", "Give a file that you can read")
    except UnicodeDecodeError:
        if size <= most:
            what = f"is no {kind} (its bytes are not UTF-8)"
            fail(str(path), what, "Give another file, or write it again")
    if size > most:
        what = f"{size:,} bytes are more than the {most:,} that are read"
        fail(str(path), what, "Give a smaller file")
    return text


def faithful(name: str, text: str) -> Any:
    """Return JSON data from text that is, but for white space, as Python writes them: a damaged
    digit that rounding hides is damage too. Raises ValueError for other text."""
    try:
        found = json.loads(text)
        bare = lambda v: "".join(v.split())
        same = bare(json.dumps(found)) == bare(text)
    except (ValueError, RecursionError, MemoryError):
        same = False
    if not same:
        fail(name, "is no JSON, or not as it was written", "Write it again")
    return found


def as_json(value: Any) -> Any:
    """Return the value as JSON data: arrays as lists, numbers that are not finite as None."""
    if isinstance(value, Mapping):
        return {str(key): as_json(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(part) for part in value]
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return as_json(np.asarray(value).tolist())
    return None if isinstance(value, float) and not np.isfinite(value) else value


def write_arrays(path: Path, plain: Any = None, **arrays: Any) -> None:
    """Write JSON data and arrays to one compressed file (.npz) atomically."""
    record: dict[str, Any] = {} if plain is None else {"record": np.array(json.dumps(plain))}
    with _replacing(path) as file:
        np.savez_compressed(file, **record, **arrays)


def read_arrays(path: Path) -> tuple[Any, dict[str, np.ndarray]] | None:
    """Return the data and arrays that `write_arrays` wrote, or None without a valid file, or where
    they do not fit into memory."""
    try:
        with zipfile.ZipFile(path) as parts:
            for part in parts.infolist():
                with parts.open(part) as member:
                    _require_size(part, member)
            require_memory(str(path), sum(part.file_size for part in parts.infolist()), "")
        with open(path, "rb") as file, np.load(file) as data:
            arrays = {name: data[name] for name in data.files}
        return json.loads(str(arrays.pop("record", "null"))), arrays
    except Exception:  # what damaged bytes may raise: of zip files, zlib, NumPy, JSON
        return None


def _require_size(part: zipfile.ZipInfo, member: Any) -> None:
    """Raise ValueError where an array claims more bytes than its part of a zip file has: NumPy
    makes room for them before it reads."""
    np.lib.format.read_magic(member)
    shape, _, dtype = np.lib.format.read_array_header_1_0(member)  # type: ignore[no-untyped-call]
    if dtype.hasobject or math.prod(shape) * dtype.itemsize > part.file_size:
        raise ValueError(f"{part.filename}: shape {shape}")


def remove_partial(path: Path) -> None:
    """Remove temporary files of killed processes beside `path`, which must have one writer only."""
    for left in side_paths(path):
        left.unlink(missing_ok=True)


def side_path(path: Path) -> Path:
    """Return a new name beside a path; what lies there is a leftover once its process has ended."""
    return path.with_name(f".{path.name}.{uuid.uuid4().hex}")


def side_paths(path: Path, ending: str = "[0-9a-f]{32}") -> list[Path]:
    """Return what lies under such names, or under names with another ending, a regular expression;
    files of the user, .{name}.backup say, do not count."""
    ours = re.compile(re.escape(f".{path.name}.") + ending)
    return [left for left in path.parent.glob(".*") if ours.fullmatch(left.name)]


@contextlib.contextmanager
def _replacing(path: Path) -> Iterator[BinaryIO]:
    """Yield a temporary file that replaces `path` once it is written; remove it after an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    side = side_path(path)
    try:
        with open(side, "xb") as file:
            yield file
        os.replace(side, path)
    except BaseException:
        side.unlink(missing_ok=True)
        raise


def check_results(
    path: Path | str, resume: bool, overwrite: bool, exists: bool | None = None
) -> None:
    """Raise ValueError where results at `path` exist (None: look) and a run is neither to resume
    nor to overwrite them, or to do both."""
    if resume and overwrite:
        fail("overwrite", "given beside resume (--overwrite, --resume)", "Choose one")
    exists = Path(path).exists() if exists is None else exists
    if exists and not (resume or overwrite):
        cure = "Add --resume (resume=True) to go on, or --overwrite (overwrite=True) to start again"
        fail(str(path), "exists", cure)


def require_new(paths: Sequence[Path], overwrite: bool) -> None:
    """Raise ValueError where one of these files exists, unless it is to be overwritten."""
    for path in paths:
        if path.exists() and not overwrite:
            cure = "Overwrite it (overwrite=True, --overwrite) or give another folder or name"
            fail(str(path), "exists", cure)


def open_folder(path: Path) -> None:
    """Create a folder for results. Raises ValueError where it cannot be written, or lies within a
    store, which is replaced as a whole."""
    try:
        place = path.resolve()
        for folder in (place, *place.parents):
            if (folder / "zarr.json").is_file():
                fail(str(path), f"lies in the store {folder}", "Give a folder outside of it")
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        fail(str(path), f"{error.strerror}", "Give a folder you can write to")


def remove_files(path: Path, *files: str) -> None:
    """Remove files of an earlier run from a folder, where they are."""
    for name in files:
        (path / name).unlink(missing_ok=True)
