"""Arrays and JSON data in one file (.npz), written whole or not at all."""

import hashlib
import json
import os
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import jax
import numpy as np


def fingerprint(plain: Any, *data: Any) -> str:
    """Return a hash (32 hexadecimal digits) of JSON data and of pytrees of arrays."""
    leaves, tree = jax.tree.flatten(data)
    state = hashlib.sha256(json.dumps(plain, sort_keys=True).encode() + str(tree).encode())
    for leaf in map(np.asarray, leaves):
        state.update(str((leaf.shape, leaf.dtype)).encode() + np.ascontiguousarray(leaf).tobytes())
    return state.hexdigest()[:32]


def clear(path: Path) -> None:
    """Remove side files that killed processes left; for the only writer of `path`."""
    for left in path.parent.glob(f".{path.name}.*"):
        left.unlink(missing_ok=True)


def write(path: Path, plain: Any, **arrays: Any) -> None:
    """Write to a side file and rename it: a reader finds the old file or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, side = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, record=np.array(json.dumps(plain)), **arrays)
        os.replace(side, path)
    except BaseException:
        Path(side).unlink(missing_ok=True)
        raise


def read(path: Path) -> tuple[Any, dict[str, np.ndarray]] | None:
    """Return (plain, arrays) of a file of `write`; None where it is absent or damaged."""
    try:
        with open(path, "rb") as file, np.load(file) as data:
            arrays = {name: data[name] for name in data.files}
        return json.loads(str(arrays.pop("record"))), arrays
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
