"""Files of runs that can be killed and resumed: written atomically, with fingerprints.

Each file is written under a temporary name and renamed, so that a reader finds the old one or the
new one. A fingerprint of all that determines a result tells whether a file belongs to a run.
"""

import contextlib
import hashlib
import json
import os
import uuid
import zipfile
from collections.abc import Iterator, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, BinaryIO

import jax
import numpy as np

# Packages whose versions a result depends on.
PACKAGES = ("jaxmpc", "jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy", "scipy", "zarr")


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
    texts = [json.dumps(value) for value in (there, here)]
    if texts[0] == texts[1]:
        return []
    first, second = (text if len(text) < 60 else f"{text[:57]}..." for text in texts)
    return [f"{key}: {first} there, {second} here"]


def versions() -> dict[str, str]:
    """Return the versions of those of `PACKAGES` that are installed."""
    found = {}
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
    """Return the data and arrays that `write_arrays` wrote, or None without a valid file."""
    try:
        with open(path, "rb") as file, np.load(file) as data:
            arrays = {name: data[name] for name in data.files}
        return json.loads(str(arrays.pop("record", "null"))), arrays
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return None


def remove_partial(path: Path) -> None:
    """Remove temporary files of killed processes beside `path`, which must have one writer only."""
    for left in path.parent.glob(f".{path.name}.*"):
        left.unlink(missing_ok=True)


@contextlib.contextmanager
def _replacing(path: Path) -> Iterator[BinaryIO]:
    """Yield a temporary file that replaces `path` once it is written; remove it after an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    side = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        with open(side, "xb") as file:
            yield file
        os.replace(side, path)
    except BaseException:
        side.unlink(missing_ok=True)
        raise
