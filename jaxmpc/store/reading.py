"""A store as it lies at a path or URL: found, opened, and read without being changed or trusted.

First where a store lies, then the blocks of its grid and the hashes of their data, then `read`.
"""

import hashlib
import itertools
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from jaxmpc.batches import cores, side_by_side, slices
from jaxmpc.checks import fail, in_units, require_memory, shortened, shown
from jaxmpc.files import faithful, fingerprint, text_within
from jaxmpc.grids import mesh
from jaxmpc.pytrees import record

if TYPE_CHECKING:
    import xarray as xr
    import zarr

# Most blocks of a store that is read. Its data are no larger than SMALL_STORE bytes, or so many
# times its files: a sweep's are some 13 times as large, one number throughout is far more.
MOST_BLOCKS, SMALL_STORE, MOST_COMPRESSED = 2**17, 2**28, 1000

# What looks at attributes and axes before data are read, and returns what is wrong with them.
Check: TypeAlias = Callable[[Mapping[str, Any], Mapping[str, np.ndarray]], list[str]]
# Returns the shapes of variables, a sample, that follow from attributes.
Shapes: TypeAlias = Callable[[Mapping[str, Any]], Mapping[str, tuple[int, ...]]]


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


def open_group(path: Path | str, mode: Any) -> "zarr.Group":
    """Open a store; raise ValueError where `path` holds something else."""
    import zarr

    cure = "Choose another output folder" if mode != "r" else "Give what a sweep wrote"
    try:
        group = zarr.open_group(zarr_place(path), mode=mode, use_consolidated=False)
        there = "fingerprint" in group.attrs
    except Exception as error:  # of a file system, or of a parser of garbled metadata
        if isinstance(path, Path) and (path / "zarr.json").is_file():
            fail(str(path), "is damaged: its metadata cannot be read", "Overwrite it")
        text = str(error).splitlines()[0] if str(error) else type(error).__name__
        fail(str(path), f"is no sweep store ({text})", cure)
    if not there:
        fail(str(path), "is a zarr group but no sweep store", cure)
    return group


def blocks_there(path: Path | str, shape: Sequence[int]) -> tuple[int, tuple[int, ...]] | None:
    """Return what the store of a grid of this shape says of its blocks, samples at most and their
    shape; None where there is no such store, or where it cannot be read."""
    try:
        found: Any = open_group(path, "r").attrs
        chunk, block = found["chunk"], found["variables"]["block"]
        fine = type(chunk) is int and all(
            type(size) is int and 0 < size <= count
            for size, count in zip(block, shape, strict=True)
        )
    except (ValueError, LookupError, TypeError):
        return None
    return (chunk, tuple(block)) if fine else None


def zarr_place(path: Path | str) -> Any:
    """Return what zarr opens at a path or URL. Raises ValueError where fsspec cannot open it."""
    import zarr

    if isinstance(path, Path):
        return path
    try:
        return zarr.storage.FsspecStore.from_url(path)
    except (ImportError, ValueError) as error:
        fail(path, f"{error}", "Install fsspec and what it needs for this kind of URL")


def array_of(group: "zarr.Group", name: str) -> "zarr.Array[Any]":
    """Return the variable of this name."""
    import zarr

    array = group[name]
    assert isinstance(array, zarr.Array)
    return array


def text_of(path: Path | str, name: str) -> str:
    """Return the text of a file of metadata below a path or URL; see `text_within`."""
    if isinstance(path, Path):
        return text_within(path / name)
    import fsspec

    with fsspec.open(f"{path}/{name}", "r") as file:
        return str(file.read())


def regions(shape: Sequence[int], block: Sequence[int]) -> list[tuple[slice, ...]]:
    """Return the parts of a grid that blocks of this shape cover, in C order."""
    return list(itertools.product(*map(slices, shape, block)))


def checksum(arrays: Mapping[str, np.ndarray]) -> int:
    """Return a hash of arrays in the order of their names, from 1 to 2⁶⁴ − 1."""
    state = hashlib.blake2b(digest_size=8)
    for name in sorted(arrays):
        value = np.ascontiguousarray(arrays[name])
        text = value.dtype.kind not in "biuf"
        state.update(f"{name}{value.shape}{'' if text else value.dtype.str}".encode())
        state.update(repr(value.tolist()).encode() if text else value.ravel().data)
    return int.from_bytes(state.digest(), "little") or 1


def determining(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return those attributes that the fingerprint covers beside axes and constants."""
    others = ("Conventions", "fingerprint", "versions", "digest")
    return {name: value for name, value in attributes.items() if name not in others}


def store_fingerprint(record: Mapping[str, Any], constants: Mapping[str, np.ndarray]) -> str:
    """Return a hash of all that determines a store."""
    return fingerprint([record, checksum(constants)])


def digest_of(attributes: Mapping[str, Any]) -> str:
    """Return a hash of all attributes: the fingerprint is of those that results depend on."""
    return fingerprint({k: v for k, v in attributes.items() if k != "digest"})


@record
class Stored:
    """A store as it lies on the disk, read without being changed.

    arrays: its variables (samples, ...), bounds and constants. done: how many of its `blocks` were
    done. problems: what is wrong, a line each; none in a sound store. whole: whether all of it was
    read; where it is False the last problem is the reason, and arrays may be missing.
    """

    attributes: dict[str, Any]
    arrays: dict[str, np.ndarray]
    axes: dict[str, np.ndarray]
    blocks: int
    done: int
    problems: list[str] = field(default_factory=list)
    whole: bool = True

    @classmethod
    def damaged(cls, reason: str) -> "Stored":
        """Return a store of which nothing can be used, for a reason."""
        return cls({}, {}, {}, 0, 0, [reason], False)

    @property
    def count(self) -> int:
        """Return the number of samples."""
        if "points" in self.arrays:
            return len(self.arrays["points"])
        return math.prod(map(len, self.axes.values()))

    @property
    def points(self) -> np.ndarray:
        """Return the samples (B, d)."""
        return self.points_at(np.arange(self.count))

    def points_at(self, index: np.ndarray) -> np.ndarray:
        """Return the samples (k, d) of these indices."""
        if "points" in self.arrays:
            return self.arrays["points"][index]
        return mesh(list(self.axes.values()), index)


# Is called with what is known of a store as a whole, the first sample of a block, and its fields.
Visit: TypeAlias = Callable[[Stored, int, Mapping[str, np.ndarray]], None]


def read(
    path: str | Path,
    check: Check = lambda attributes, axes: [],
    shapes: Shapes = lambda attributes: {},
    *,
    keep: Collection[str] | None = None,
    visit: Visit = lambda found, first, arrays: None,
) -> Stored:
    """Read a store and compare it with its checksums; raises ValueError where there is none.

    Metadata come first: nothing is read that is larger than they and the files allow, and nothing
    but axes and constants before the fingerprint is found to be theirs. check: looks at these.
    shapes: of variables, a sample, that follow from the attributes; raises ValueError where these
    make no sense.

    Blocks are read by as many threads as there are cores, each one whole and then no more. keep:
    the fields that stay, None for all. visit: is called by these threads with each block: with what
    is returned in the end but for the problems of blocks, the index of the first sample, and all
    fields, (samples of the block, ...). A block that is not done has the fill value of each field.
    """
    path = location(path)
    if isinstance(path, Path) and (path / "zarr.json").is_file():
        text_of(path, "zarr.json")  # raises for what is too large to be metadata
    group = open_group(path, "r")
    try:
        return _read(path, group, check, shapes, keep, visit)
    except Exception as error:  # of zarr, its codecs, JSON: what damaged bytes may raise
        text = reason(error)
        return Stored.damaged(text if isinstance(error, ValueError) else f"cannot be read ({text})")


def reason(error: Exception) -> str:
    """Return an error as one line, with its kind unless it is one of values with a text."""
    text = " ".join(str(error).split())
    known = isinstance(error, ValueError) and text
    return shortened(text if known else f"{type(error).__name__}: {text}")


def _read(
    path: Path | str,
    group: "zarr.Group",
    check: Check,
    shapes: Shapes,
    keep: Collection[str] | None,
    visit: Visit,
) -> Stored:
    """Read an open store; raises where nothing can be said of its data."""
    found, described = _described(path, shapes, keep)
    names, block = found["variables"], found["variables"]["block"]

    opened: dict[str, zarr.Array[Any]] = {}

    def load(name: str, part: Any = ...) -> np.ndarray:
        try:
            if name not in opened:
                opened[name] = array_of(group, name)
            return np.asarray(opened[name][part])
        except Exception as error:
            fail(name, f"cannot be read ({type(error).__name__})", "Its file is damaged")

    axes = {name: load(name) for name in names["axes"]}
    constants = {name: load(name) for name in names["constants"]}
    if found["fingerprint"] != store_fingerprint(determining(found), {**axes, **constants}):
        what = "configuration, axes or constants are not as they were written"
        fail("zarr.json", what, "Overwrite it")
    if problems := check(found, axes):
        return Stored(found, {}, axes, 0, 0, problems, False)
    shape = tuple(len(axis) for axis in axes.values())
    parts = regions(shape, block)
    marks = _marks(path, group, len(parts))
    kept = {name: load(name) for name in names["fields"] if keep is None or name in keep}
    for k, name in itertools.product(np.flatnonzero(marks == 0), kept):
        kept[name][parts[k]] = opened[name].fill_value  # what a killed run left there is no result
    problems = list[str]()
    own = {*axes, *constants, *names["fields"], "checksum"}
    for name in [name for name in described if name not in own]:  # what `Store.save` wrote
        constants[name] = load(name)
        stored = described[name]["attributes"].get("checksum")
        if stored != str(checksum({name: constants[name]})):
            problems.append(f"{name}: data are not as they were written")

    def flat(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {name: v.reshape(-1, *v.shape[len(shape) :]) for name, v in arrays.items()}

    done = int(np.count_nonzero(marks))
    whole = Stored(found, flat(kept) | constants, axes, len(parts), done, problems)

    def look(k: int) -> list[str]:
        here = {
            name: kept[name][parts[k]] if name in kept else load(name, parts[k])
            for name in names["fields"]
        }
        if not marks[k]:
            here = {name: np.full_like(v, opened[name].fill_value) for name, v in here.items()}
        sound = marks[k] in (0, checksum(here))
        if not sound:
            _require_files(path, here, parts[k], block, f"block {k}")
        first = np.ravel_multi_index([along.start for along in parts[k]], shape)
        visit(whole, int(first), flat(here))
        return [] if sound else [f"block {k}: data are not as they were written"]

    damaged = side_by_side(look, range(len(parts)), cores())
    return replace(whole, problems=[*itertools.chain(*damaged), *problems])


def _described(
    path: Path | str, shapes: Shapes, keep: Collection[str] | None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the attributes of a store and the metadata of each variable. Raises ValueError where
    they do not fit each other, or describe more than the files can hold, or more to keep than the
    memory can; no data are read."""
    root = faithful("zarr.json", text_of(path, "zarr.json"))
    try:
        found, together = root["attributes"], root["consolidated_metadata"]["metadata"]
        names, block = found["variables"], found["variables"]["block"]
        axes, fields = names["axes"], [*names["fields"]]
        own = [*axes, *names["constants"], *fields, "checksum"]
        digest = found.get("digest")
        fine = (
            digest in (None, digest_of(found))
            and all(
                isinstance(name, str) and name and "/" not in name for name in [*own, *together]
            )
            and len(block) == len(axes) > 0
            and all(type(size) is int and size > 0 for size in block)
        )
    except (LookupError, TypeError, AttributeError):
        fine = False
    if not fine:
        fail("zarr.json", "attributes are not as they were written", "Overwrite it")
    for name in dict.fromkeys([*own, *together]):
        try:
            same = faithful(name, text_of(path, f"{name}/zarr.json")) == together.get(name)
        except (OSError, ValueError):
            same = False
        if not same:
            fail(name, "metadata are missing or not as they were written", "Resume or overwrite it")
    sizes = {name: _layout(name, one) for name, one in together.items()}
    grid = tuple(math.prod(sizes[name].shape) for name in axes)
    count = math.prod(-(-n // size) for n, size in zip(grid, block, strict=True))
    if count > MOST_BLOCKS:
        fail("zarr.json", f"describes {count:,} blocks", f"At most {MOST_BLOCKS:,} can be read")
    last = {name: sizes[name].shape[len(grid) :] for name in fields}
    last |= {name: shape for name, shape in shapes(found).items() if name in fields}
    expected = {name: Layout((*grid, *tail), (*block, *tail)) for name, tail in last.items()}
    expected["checksum"] = Layout((count,), (1,))
    for name, layout in expected.items():
        if sizes[name][:2] != layout[:2]:
            what = f"shape {sizes[name].shape} where axes and problem say {layout.shape}"
            fail(name, what, "Overwrite the store")
    needed = sum(math.prod(v.shape) * v.itemsize for v in sizes.values())
    there = needed if isinstance(path, str) else _stored_bytes(path)
    if needed > max(SMALL_STORE, MOST_COMPRESSED * there):
        what = f"describes {in_units(needed)} of data, its files hold {in_units(there)}"
        fail("zarr.json", what, "Overwrite it")
    kept = [name for name in sizes if keep is None or name in keep or name not in fields]
    needed = sum(math.prod(sizes[name].shape) * sizes[name].itemsize for name in kept)
    require_memory("zarr.json", needed, "Read it on a larger machine")
    return found, together


class Layout(NamedTuple):
    """Shape and chunks of a variable, and the bytes of one number."""

    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    itemsize: int = 8


def _layout(name: str, one: Any) -> Layout:
    """Return the layout that the metadata of a variable describe. Raises ValueError unless they are
    such as `Store` writes."""
    try:
        shape, chunks = one["shape"], one["chunk_grid"]["configuration"]["chunk_shape"]
        kind, codecs = one["data_type"], [codec["name"] for codec in one["codecs"]]
        fine = (
            all(type(size) is int and size >= 0 for size in [*shape, *chunks])
            and codecs == ["vlen-utf8" if kind == "string" else "bytes", "zstd", "crc32c"]
            and not one["storage_transformers"]
            and len(shape) == len(chunks)
            and isinstance(one["attributes"], dict)
        )
        size = 64 if kind == "string" else np.dtype(kind).itemsize
    except (LookupError, TypeError):
        fine = False
    if not fine:
        fail(name, "metadata are not such as are written here", "Overwrite the store")
    return Layout(tuple(shape), tuple(chunks), size)


def _marks(path: Path | str, group: "zarr.Group", count: int) -> np.ndarray:
    """Return the checksums of all blocks, 0 of those that are not done."""
    array, marks = array_of(group, "checksum"), np.zeros(count, np.uint64)
    if isinstance(path, str):
        return np.asarray(array[:])
    for file in _finished(path / "checksum" / "c", "*"):
        if not (file.name.isdecimal() and int(file.name) < count):
            fail("checksum", f"holds {shown(file.name)}, which is of no block", "Overwrite it")
        marks[int(file.name)] = array[int(file.name)]
    return marks


def _finished(folder: Path, pattern: str) -> Iterator[Path]:
    """Return files and folders but for those that zarr is writing, or was as its run was killed."""
    return (file for file in folder.glob(pattern) if file.suffix != ".partial")


def _require_files(
    path: Path | str,
    arrays: Mapping[str, np.ndarray],
    part: tuple[slice, ...],
    block: Sequence[int],
    where: str,
) -> None:
    """Raise ValueError where a variable has no file of a block whose data are not as written. One
    whose numbers are all the fill value has none either, which alone is no damage."""
    place = [str(along.start // size) for along, size in zip(part, block, strict=True)]
    for name, value in arrays.items():
        tail = ["0"] * (value.ndim - len(part))
        if isinstance(path, Path) and not path.joinpath(name, "c", *place, *tail).exists():
            fail(where, f"data are not as they were written, {name} has no file", "Resume")


def _stored_bytes(path: Path) -> int:
    """Return the bytes of all files of a store. Raises ValueError where one is no ordinary file,
    such as a pipe, which would be waited for."""
    total = 0
    for file in _finished(path, "**/*"):
        if not file.is_file() and not file.is_dir():
            fail(str(file.relative_to(path)), "is no file", "Overwrite the store")
        total += file.stat().st_size if file.is_file() else 0
    return total


def open_dataset(path: str | Path) -> "xr.Dataset":
    """Return the store as an xarray Dataset (lazy); samples of blocks not done hold the fill
    values. `xarray.open_zarr(path)` does the same."""
    import xarray as xr  # takes longer to import than to read

    open_group(location(path), "r")
    return xr.open_zarr(path)
