"""Where a store lies: a folder or a URL; what is there is opened, or removed, if it is a store."""

import shutil
import uuid
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jaxmpc.checks import fail
from jaxmpc.files import text_within
from jaxmpc.store.lock import Lock

if TYPE_CHECKING:
    import zarr


def location(path: str | Path) -> Path | str:
    """Return the path of a store, or its URL where it is one of objects."""
    text = str(path)
    if text.startswith("file://"):
        return Path(text.removeprefix("file://"))
    return text if "://" in text else Path(path)


def exists(path: Path | str) -> bool:
    """Return whether something lies at a path, or a complete store of objects at a URL."""
    import zarr

    if isinstance(path, Path):
        return path.exists()
    try:
        group = zarr.open_group(zarr_place(path), mode="r", use_consolidated=False)
    except FileNotFoundError:
        return False
    return "fingerprint" in group.attrs


def text_of(path: Path | str, name: str) -> str:
    """Return the text of a file of metadata below a path or URL; see `text_within`."""
    if isinstance(path, Path):
        return text_within(path / name)
    import fsspec

    with fsspec.open(f"{path}/{name}", "r") as file:
        return str(file.read())


def zarr_place(path: Path | str) -> Any:
    """Return what zarr opens at a path or URL. Raises ValueError where fsspec cannot open it."""
    import zarr

    if isinstance(path, Path):
        return path
    try:
        return zarr.storage.FsspecStore.from_url(path)
    except (ImportError, ValueError) as error:
        fail(path, f"{error}", "Install fsspec and what it needs for this kind of URL")


def open_group(path: Path | str, mode: Any) -> "zarr.Group":
    """Open a store; raise ValueError where `path` holds something else."""
    import zarr

    try:
        group = zarr.open_group(zarr_place(path), mode=mode, use_consolidated=False)
        there = "fingerprint" in group.attrs
    except Exception as error:  # of a file system, or of a parser of garbled metadata
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        known = isinstance(path, Path) and (path / "zarr.json").is_file()
        what = (
            "is damaged: its metadata cannot be read" if known else f"is no sweep store ({reason})"
        )
        fail(str(path), what, "Overwrite it" if known else "Choose another output folder")
    if not there:
        fail(str(path), "is a zarr group but no sweep store", "Choose another output folder")
    return group


def consolidate(group: "zarr.Group") -> None:
    """Write the metadata of all variables to the group, so that readers need one file."""
    import zarr

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # zarr says that its format 3 has no standard for it yet
        zarr.consolidate_metadata(group.store)


def array_of(group: "zarr.Group", name: str) -> "zarr.Array[Any]":
    """Return the variable of this name."""
    import zarr

    array = group[name]
    assert isinstance(array, zarr.Array)
    return array


def side_path(path: Path) -> Path:
    """Return a new name beside a path; what lies there is a leftover once its process has ended."""
    return path.with_name(f".{path.name}.{uuid.uuid4().hex}")


def require_removable(path: str | Path) -> Path:
    """Return the path of a store, damaged or not, that may be deleted; ValueError where it is none,
    or a link to one: what others have put elsewhere is not deleted."""
    path = location(path)
    if not isinstance(path, Path):
        fail(path, "is a store of objects", "Delete it with the tools of that store")
    if path.is_symlink():
        what = f"is a link to {path.readlink()}, which is not deleted"
        fail(str(path), what, "Remove the link, or choose another output")
    metadata = [path / "zarr.json", *path.glob("*/zarr.json")]
    if not any(file.is_file() for file in metadata):
        fail(str(path), "is no sweep store", "Choose another output folder")
    foreign = [v.name for v in path.iterdir() if not v.is_dir() and v.name != "zarr.json"]
    if foreign:
        fail(str(path), f"holds {foreign[0]}, which is of no store", "Choose another output folder")
    return path


def remove(path: str | Path) -> None:
    """Delete the store at `path`, damaged or not; ValueError, and nothing deleted, where it is no
    store."""
    path = require_removable(path)
    lock = Lock(path.parent)
    try:
        shutil.rmtree(path)
    finally:
        lock.release()
