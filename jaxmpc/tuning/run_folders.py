"""The folder of a tuning run: its record, its checkpoint, and a run that is overwritten."""

import contextlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jaxmpc.checks import fail
from jaxmpc.files import check_results, differences, open_folder, text_within, write_json

CHECKPOINT = "checkpoint.npz"
# Where the files of a run that is overwritten wait.
ASIDE = "overwritten"


@contextlib.contextmanager
def run_folder(
    folder: Path, files: tuple[str, ...], options: dict[str, Any], resume: bool, overwrite: bool
) -> Iterator[Path]:
    """Open the folder of a new run, or of one that is resumed, and give the path of its checkpoint.

    files[0] is the record of the run, a JSON file that holds the options. All files are removed,
    and a new record is written. Those of a run that is overwritten are put aside, and come back
    at the end, whatever ends it, unless the new run has a checkpoint.
    Raises ValueError where the folder holds a run with other options, or any run without `resume`
    or `overwrite`.
    """
    record, checkpoint = folder / files[0], folder / CHECKPOINT
    _settle(folder)
    for path in (record, checkpoint):
        check_results(path, resume, overwrite)
    if resume and record.exists():
        try:
            stored = json.loads(text_within(record))["options"]
        except (ValueError, KeyError, TypeError, RecursionError):
            fail(str(record), "holds no run", "Add --overwrite (overwrite=True) to start again")
        if changes := differences(stored, options):
            cure = "Give the same options, or --overwrite (overwrite=True)"
            fail(str(record), "; ".join(changes), cure)
    open_folder(folder)
    if overwrite:
        (folder / ASIDE).mkdir()
    for name in filter(lambda name: (folder / name).exists(), (*files, CHECKPOINT)):
        if overwrite:
            (folder / name).replace(folder / ASIDE / name)
        elif name != CHECKPOINT:  # which a resumed run reads
            (folder / name).unlink()
    write_json(record, {"options": options, "finished": False})
    try:
        yield checkpoint
    finally:
        _settle(folder)


def _settle(folder: Path) -> None:
    """Remove a run that was overwritten where the new one has a checkpoint, else bring it back."""
    aside = folder / ASIDE
    if not aside.is_dir():
        return
    if not (folder / CHECKPOINT).exists():
        for path in aside.iterdir():
            path.replace(folder / path.name)
    shutil.rmtree(aside)
