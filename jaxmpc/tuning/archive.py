"""Arrays and JSON data in one file (.npz), there as a whole or not at all."""

import json
import os
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np


def write(path: Path, plain: Any, **arrays: Any) -> None:
    """Write to a side file, then rename: a reader sees the old file or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    for left in path.parent.glob(f".{path.name}.*"):  # by a process that was killed while writing
        left.unlink(missing_ok=True)
    handle, side = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, record=np.array(json.dumps(plain)), **arrays)
        os.replace(side, path)
    except BaseException:
        Path(side).unlink(missing_ok=True)
        raise


def read(path: Path) -> tuple[Any, dict[str, np.ndarray]] | None:
    """What `write` wrote; None where there is nothing, or nothing whole."""
    try:
        with open(path, "rb") as file, np.load(file) as data:
            arrays = {name: data[name] for name in data.files}
        return json.loads(str(arrays.pop("record"))), arrays
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
