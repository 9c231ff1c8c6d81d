"""An open store, to write: made, locked, repaired and filled block by block."""

import contextlib
import math
import os
import re
import shutil
import sys
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from jaxmpc.checks import entries, fail, whole
from jaxmpc.files import differences, side_path, side_paths, versions
from jaxmpc.store.reading import (
    array_of,
    blocks_there,
    checksum,
    digest_of,
    exists,
    location,
    open_group,
    regions,
    store_fingerprint,
    zarr_place,
)

if TYPE_CHECKING:
    import zarr
    from zarr.abc.codec import BytesBytesCodec as Codec

# Samples and bytes of a block at most, where its size is not given, and blocks of each process.
BLOCK, BLOCK_BYTES, BLOCKS = 2**17, 2**25, 8


class Lock:
    """A lock against other processes that write; the end of the process releases it too.

    Of a folder, or of a file in it that is made for the lock and removed with it: file systems of a
    network have locks of files, not of folders.
    """

    def __init__(
        self, folder: Path, *, shared: bool = False, file: str = "", work: str = "writes there"
    ) -> None:
        """Raise ValueError where another process holds it, unless both share it. Where the system
        or the file system has no such locks (Windows has none), nothing is locked."""
        self._held: int | None = None
        self.file = folder / file if file else None
        folder.mkdir(parents=True, exist_ok=True)
        try:
            import fcntl

            kind = fcntl.LOCK_SH if shared else fcntl.LOCK_EX
            while self._held is None:
                place, flags = (self.file, os.O_RDWR | os.O_CREAT) if self.file else (folder, 0)
                self._held = os.open(place, flags)
                fcntl.flock(self._held, kind | fcntl.LOCK_NB)
                try:
                    there = os.path.samestat(os.fstat(self._held), os.stat(place))
                except FileNotFoundError:
                    there = False
                if not there:  # its last holder removed the file after it was opened here
                    self._close()
        except BlockingIOError:
            self._close()
            cure = "Wait for it, or choose another output"
            fail(str(folder), f"another process {work}", cure)
        except (ImportError, OSError):
            self._close()

    def release(self) -> None:
        """Let others write."""
        if self._held is not None and self.file is not None:
            self.file.unlink(missing_ok=True)
        self._close()

    def _close(self, close: Callable[[int], None] = os.close) -> None:
        if self._held is not None:
            close(self._held)
            self._held = None

    __del__ = _close


class Field(NamedTuple):
    """A variable with a value a sample: its further shape, type, value while it is not written,
    names of its further dimensions, CF attributes."""

    shape: tuple[int, ...]
    dtype: str
    fill: Any
    dimensions: tuple[str, ...]
    attributes: Mapping[str, Any] = {}


class Constant(NamedTuple):
    """A variable that is known from the start, such as a coordinate: its array, dimensions and CF
    attributes."""

    data: np.ndarray
    dimensions: tuple[str, ...]
    attributes: Mapping[str, Any] = {}


class Store:
    """An open store; see the module. One process writes at a time, or one each shard."""

    def __init__(
        self,
        path: str | Path,
        axes: Mapping[str, Constant],
        fields: Mapping[str, Field],
        config: Mapping[str, Any],
        chunk: int | None,
        *,
        part: int = 1,
        constants: Mapping[str, Constant] | None = None,
        attributes: Mapping[str, Any] | None = None,
        shard: tuple[int, int] | None = None,
        overwrite: bool = False,
        begun: Callable[[], None] = lambda: None,
    ) -> None:
        """Open the store at `path`, a folder or a URL, to write; make it where there is none.

        axes: the coordinates of the samples, a grid's axes in their order or one array along
        `sample`. constants: further known variables. config: JSON data that describes the
        computation; attributes: JSON data that follow from it. chunk: samples of a block at most;
        None: blocks as in the store at `path`, or, in a new one, of whole parts of at most `part`
        samples (`default_block`). shard: (i, n), 0 ≤ i < n, to write the blocks k with k mod n = i
        only, beside other processes; None for all. overwrite: put a new store in the place of the
        one at `path`, once it has its first block: until then, and if that never comes, the old one
        stays as it is.
        begun: is called when the store lies at `path`. `damaged` becomes the number of these blocks
        that were done and whose data are not as written; they are to be computed again. Raises
        ValueError where the store was made with another configuration, where another process writes
        (the same shard, or all), or where something else lies there.
        """
        self.path, self.fields, self.damaged = location(path), dict(fields), 0
        self.shard, self._begun = shard, begun
        self._aside: Path | None = None
        self.constants = {**axes, **(constants or {})}
        self.shape = tuple(len(axis.data) for axis in axes.values())
        self.dimensions = tuple(axes)
        cure = "Give i and n of i/n, with i from 0 to n - 1"
        pair = entries("shard", (0, 1) if shard is None else shard, cure)
        if len(pair) != 2 or not whole("shard", pair[0], 0) < whole("shard", pair[1], 0):
            fail("shard", "/".join(map(str, pair)), cure)
        i, n = pair
        chunk, self.block_shape = self._blocks(chunk, part, n, overwrite)
        self.regions = regions(self.shape, self.block_shape)
        self.own = range(i, len(self.regions), n)
        about = {"long_name": "hash of a block; 0: not done"}
        self._described = {**fields, "checksum": Field((), "uint64", 0, ("block",), about)}
        self._locks = list[Lock]()
        variables: dict[str, list] = {
            "axes": list(axes),
            "constants": list(constants or {}),
            "fields": list(fields),
        }
        variables["block"] = list(self.block_shape)
        record = {"config": dict(config), "chunk": chunk, "variables": variables}
        record |= attributes or {}
        data = {name: constant.data for name, constant in self.constants.items()}
        self.attributes: dict[str, Any] = {
            "Conventions": "CF-1.11",
            **record,
            "fingerprint": store_fingerprint(record, data),
            "versions": versions(),
        }
        self.attributes["digest"] = digest_of(self.attributes)
        try:
            if isinstance(self.path, Path):
                self._locks.append(Lock(self.path.parent, shared=shard is not None))
            if shard is not None:
                self._lock_file("{}-of-{}".format(*shard), f"computes shard {shard[0]}/{shard[1]}")
            if overwrite and exists(self.path):
                self._open_aside(require_removable(self.path))
            else:
                self._open()
                begun()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __getstate__(self) -> dict[str, Any]:
        """Return what copies and pickles hold, which are for reading: no locks, and nobody to
        call."""
        return {**vars(self), "_locks": [], "_begun": int, "_aside": None}

    def close(self) -> None:
        """Let other processes write. A new store without a block, that was to replace another, is
        no more."""
        if self._aside is not None:
            shutil.rmtree(self._aside, ignore_errors=True)
        while self._locks:
            self._locks.pop().release()

    def _lock_file(self, name: str, work: str) -> None:
        """Hold the lock of a part of the work; ValueError where another process does it. A store of
        objects has no locks."""
        if isinstance(self.path, Path):
            file = f".{self.path.name}.{name}.lock"
            self._locks.append(Lock(self.path.parent, file=file, work=work))

    def rows(self, block: int) -> slice:
        """Return the samples of a block, counted in C order of the grid."""
        region = self.regions[block]
        first = int(np.ravel_multi_index([part.start for part in region], self.shape))
        return slice(first, first + math.prod(part.stop - part.start for part in region))

    @property
    def size(self) -> int:
        """Return the number of samples of the largest block: programs of this size, which take all
        blocks, give each the same bits in every run."""
        return math.prod(self.block_shape)

    def _blocks(
        self, chunk: int | None, part: int, processes: int, overwrite: bool
    ) -> tuple[int, tuple[int, ...]]:
        """Return the samples of a block at most and its shape; see `__init__`."""
        if chunk is not None:
            return chunk, block_shape(self.shape, chunk)
        there = None if overwrite else blocks_there(self.path, self.shape)
        if there is not None:
            return there
        each = sum(math.prod(v.shape) * np.dtype(v.dtype).itemsize for v in self.fields.values())
        found = default_block(self.shape, part, each, processes)
        return math.prod(found), found

    def part_size(self, most: int) -> int:
        """Return the number of samples of the largest part of a block; see `parts`."""
        return math.prod(block_shape(self.block_shape, most))

    def parts(self, block: int, most: int) -> list[slice]:
        """Return the samples of a block, counted in C order of the grid, in consecutive parts of at
        most so many. Blocks of whole parts (`default_block`) have the same ones as smaller blocks.
        """
        region, shape = self.regions[block], block_shape(self.block_shape, most)
        found = regions([along.stop - along.start for along in region], shape)
        sizes = [math.prod(along.stop - along.start for along in part) for part in found]
        ends = self.rows(block).start + np.cumsum(sizes)
        return [slice(int(end) - size, int(end)) for size, end in zip(sizes, ends, strict=True)]

    def samples(self, block: int) -> np.ndarray:
        """Return the indices of the samples of a block."""
        return np.r_[self.rows(block)]

    def pending(self) -> list[int]:
        """Return the indices of the blocks, of this shard, that are not done."""
        done = self._done()
        return [block for block in self.own if not done[block]]

    def _done(self) -> np.ndarray:
        """Return which blocks are marked as done; those whose marks cannot be read are not."""
        marks = self._array("checksum")
        try:
            return np.asarray(marks[:]) != 0
        except Exception:  # what a codec raises is its own
            return np.array(
                [self._mark(block) not in (0, None) for block in range(len(self.regions))]
            )

    def _mark(self, block: int) -> int | None:
        """Return the stored checksum of a block, 0 where it is not done, None where it cannot be
        read."""
        try:
            return int(np.asarray(self._array("checksum")[block]))
        except Exception:
            return None

    def unfinished(self) -> str:
        """Return why a shard does not conclude the work of all: what is missing, in words; "" where
        nothing is. Then this process alone concludes, until it closes the store, and leftovers of
        killed processes are removed."""
        if self.shard is None:
            return ""
        left = int(np.sum(~self._done()))
        if not left:
            try:
                self._lock_file("end", "concludes")
            except ValueError:
                return "all blocks are done, and another process concludes"
            others = [k for k in range(len(self.regions)) if k not in self.own]
            left = self._check(others)
        if left:
            return f"{left:,} of {len(self.regions):,} blocks are missing, of other shards"
        self._remove_leftovers()
        return ""

    def _enter(self, group: "zarr.Group") -> None:
        """Work on this group from now on."""
        self.group = group
        self._arrays: dict[str, zarr.Array[Any]] = {}

    def _array(self, name: str) -> "zarr.Array[Any]":
        """Return the variable of this name, which stays open: to open one takes zarr longer than to
        write a small block."""
        if name not in self._arrays:
            self._arrays[name] = array_of(self.group, name)
        return self._arrays[name]

    @property
    def replaces(self) -> bool:
        """Return whether the next block that is done puts the store in the place of an old one."""
        return self._aside is not None

    def commit(self, block: int, **rows: np.ndarray) -> None:
        """Write all variables of a block, (samples of the block, ...), then mark it done."""
        region, written = self.regions[block], []
        for name, value in rows.items():
            array = self._array(name)
            here = tuple(part.stop - part.start for part in region)
            value = np.asarray(value, array.dtype).reshape(*here, *array.shape[len(here) :])
            array[region] = value
            written.append((name, value))
        self._array("checksum")[block] = checksum(dict(written))
        if self._aside is not None:
            self._replace(self._aside)

    def read(self, name: str, block: int | None = None) -> np.ndarray:
        """Return a variable (samples, ...), of one block or of all."""
        region = slice(None) if block is None else self.regions[block]
        found = np.asarray(self._array(name)[region])
        return found.reshape(-1, *found.shape[len(self.shape) :])

    def save(self, values: Mapping[str, "Constant"]) -> None:
        """Write further variables, which follow from all blocks, with their checksums."""
        for name, (data, dimensions, attributes) in values.items():
            mark = {"checksum": str(checksum({name: data}))}
            made: dict[str, Any] = {
                "data": data,
                "dimension_names": dimensions,
                "compressors": codecs(),
            }
            attributes = {**attributes, **mark}
            self._arrays.pop(name, None)
            self.group.create_array(name, overwrite=True, attributes=attributes, **made)
        consolidate(self.group)

    def _open(self) -> None:
        """Open the group, made, checked and repaired as needed."""
        if self.shard is None:
            self._remove_leftovers()
        if not exists(self.path):
            if isinstance(self.path, Path):
                self._create(self.path)
            else:
                self._create_objects(self.path)
        self._enter(open_group(self.path, "r+"))
        self._require_configuration()
        self._repair()

    def _open_aside(self, path: Path) -> None:
        """Make a new store beside the one at `path`, and open it."""
        self._remove_leftovers()
        self._aside = aside = side_path(path)
        self._make(aside)
        self._enter(open_group(aside, "r+"))

    def _replace(self, aside: Path) -> None:
        """Put the new store in the place of the old one, and delete that."""
        path = require_removable(self.path)
        old = side_path(path)
        os.rename(path, old)
        os.rename(aside, path)
        self._aside = None
        self._enter(open_group(path, "r+"))
        shutil.rmtree(old, ignore_errors=True)
        self._begun()

    def _make(self, path: Path) -> None:
        """Make the store in a folder of its own."""
        import zarr

        group = zarr.open_group(path, mode="w", zarr_format=3, attributes=self.attributes)
        for name in (*self.constants, *self._described):
            self._create_array(group, name)
        consolidate(group)

    def _create(self, path: Path) -> None:
        """Create the store under a temporary name, then rename it to `path`, unless another process
        was first."""
        if path.is_symlink():
            what = f"is a link to {path.readlink()}, where nothing is"
            fail(str(path), what, "Remove the link, or bring back what it leads to")
        partial = side_path(path)
        self._make(partial)
        try:
            os.rename(partial, path)
        except OSError:
            shutil.rmtree(partial, ignore_errors=True)
            if self.shard is None or not path.exists():
                raise

    def _create_objects(self, url: str) -> None:
        """Create the store in place, attributes last; what another process has made of it stays."""
        import zarr

        group = zarr.open_group(zarr_place(url), mode="a", zarr_format=3)
        maker = {"maker": self.attributes["fingerprint"]}
        if dict(group.attrs) not in ({}, maker) or (not dict(group.attrs) and list(group.keys())):
            fail(url, "is a zarr group but no sweep store", "Choose another output folder")
        group.update_attributes(maker)
        for name in (*self.constants, *self._described):
            with contextlib.suppress(zarr.errors.ContainsArrayError):
                self._create_array(group, name, overwrite=False)
        for name in self.constants:  # once more: whoever made the array may have been killed
            self._write_constant(array_of(group, name), name)
        group.attrs.put(self.attributes)
        consolidate(group)

    def _remove_leftovers(self) -> None:
        """Remove what killed processes have left: stores half made, lock files, chunks half
        written."""
        if not isinstance(self.path, Path):
            return
        for left in side_paths(self.path):
            shutil.rmtree(left, ignore_errors=True)
        for left in side_paths(self.path, r"(end|\d+-of-\d+)\.lock"):
            with contextlib.suppress(ValueError):  # it is held
                Lock(left.parent, file=left.name).release()
        for left in self.path.rglob("*.partial"):
            left.unlink(missing_ok=True)

    def _create_array(self, group: "zarr.Group", name: str, overwrite: bool = True) -> None:
        """Create one variable, without values but for constants."""
        if name in self.constants:
            data, dimensions, attributes = self.constants[name]
            kind = str if data.dtype.kind == "U" else data.dtype
            options: dict[str, Any] = {"shape": data.shape, "dtype": kind}
        else:
            _, _, fill, further, attributes = self._described[name]
            dimensions = (*(() if name == "checksum" else self.dimensions), *further)
            options = {**self._layout(name), "fill_value": fill}
        options |= {"dimension_names": dimensions, "attributes": dict(attributes)}
        made = group.create_array(name, overwrite=overwrite, compressors=codecs(), **options)
        if name in self.constants:
            self._write_constant(made, name)

    def _layout(self, name: str) -> dict[str, Any]:
        """Return shape, chunks and type of a variable that is no constant."""
        # One checksum a file: a kill while one is written leaves the others.
        shape, chunks = (
            ((len(self.regions),), (1,)) if name == "checksum" else (self.shape, self.block_shape)
        )
        tail, dtype, *_ = self._described[name]
        return {"shape": (*shape, *tail), "chunks": (*chunks, *tail), "dtype": np.dtype(dtype)}

    def _write_constant(self, array: "zarr.Array[Any]", name: str) -> None:
        data = self.constants[name].data
        array[...] = data if data.dtype.kind != "U" else data.astype(object)

    def _require_configuration(self) -> None:
        """Raise unless the store was made with the same configuration and samples."""
        there, here = dict(self.group.attrs), self.attributes
        if there["fingerprint"] == here["fingerprint"]:
            return
        stored: Any = there.get("config")
        changes = differences(
            {**(stored if isinstance(stored, Mapping) else {}), "chunk": there.get("chunk")},
            {**here["config"], "chunk": here["chunk"]},
        )
        fail(
            str(self.path),
            f"holds results of another configuration ({'; '.join(changes) or 'other points'})",
            "Resume with that configuration, choose another output, or overwrite",
        )

    def _repair(self) -> None:
        """Make what is missing or damaged new, and mark its blocks as not done.

        Of blocks, a shard looks at its own. It does not make variables new, which are of all.
        """
        renewed = [name for name in (*self.constants, *self._described) if not self._is_sound(name)]
        if renewed and self.shard is not None:
            what = f"{', '.join(renewed)}: missing or damaged"
            fail(str(self.path), what, "Stop all shards, and resume once without --shard")
        for name in renewed:
            self._arrays.pop(name, None)
            del self.group[name]
            self._create_array(self.group, name)
        if renewed:
            consolidate(self.group)
        lost = len(self.regions) if "checksum" in renewed else 0
        self.damaged = self._check(self.own) or lost

    def _check(self, blocks: Iterable[int]) -> int:
        """Mark those of the blocks as not done whose data are not as written; return their
        number."""
        marks, damaged = self._array("checksum"), 0
        for block in blocks:
            mark = self._mark(block)
            if mark != 0 and mark != self._checksum(block):
                marks[block] = 0
                damaged += 1
        return damaged

    def _is_sound(self, name: str) -> bool:
        """Return whether a variable exists as it was created, with its values if it is a
        constant."""
        try:
            array = self._array(name)
            if name in self.constants:
                return bool(np.array_equal(np.asarray(array[...]), self.constants[name].data))
            field = self._described[name]
            same = all(getattr(array, key) == value for key, value in self._layout(name).items())
            nan = field.dtype != "bool"
            return same and bool(np.array_equal(array.fill_value, field.fill, equal_nan=nan))
        except Exception:  # unreadable metadata: zarr raises what its parsers raise
            return False

    def _checksum(self, block: int) -> int:
        """Return the checksum of the data of a block, −1 where they cannot be read."""
        region = self.regions[block]
        try:
            return checksum({k: np.asarray(self._array(k)[region]) for k in self.fields})
        except Exception:
            return -1


def report_damage(store: Store) -> None:
    """Say on stderr how many blocks of a store are computed again because their data are damaged or
    missing."""
    if store.damaged:
        what = "blocks that were done are" if store.damaged > 1 else "block that was done is"
        count = f"{store.damaged:,} of {len(store.regions):,}"
        text = f"{store.path}: {count} {what} missing or damaged, computed again"
        print(text, file=sys.stderr)


def block_shape(shape: Sequence[int], most: int) -> tuple[int, ...]:
    """Return the shape of blocks of at most `most` samples of a grid, of nearly equal size and
    consecutive in C order."""
    found, rest, whole = [], 1, True
    for count in reversed(shape):
        take = min(count, max(most // rest, 1)) if whole else 1
        take = -(-count // -(-count // take))
        whole, rest = whole and take == count, rest * take
        found.append(take)
    return tuple(reversed(found))


def default_block(
    shape: Sequence[int], part: int, sample_bytes: int, processes: int
) -> tuple[int, ...]:
    """Return the shape of blocks whose files are of megabytes and of which a killed run loses
    little, of a grid that is labelled part by part.

    They hold up to `BLOCK` samples and `BLOCK_BYTES` bytes, in whole parts of at most `part`
    samples, so that the parts do not depend on the blocks; and each process gets `BLOCKS` of them
    where there are so many parts.
    """
    found = list(block_shape(shape, part))
    most = math.prod(shape) // (BLOCKS * processes)
    most, whole = min(most, BLOCK, BLOCK_BYTES // sample_bytes), tuple(found)
    for axis in reversed(range(len(shape))):
        fit = max(most // math.prod(found), 1)
        found[axis] = min(fit * whole[axis], shape[axis])
        if found[axis] < shape[axis]:
            break
    return tuple(found)


def codecs() -> "tuple[Codec, ...]":
    """Return the codecs of each chunk; the last one adds a checksum of the file itself."""
    from zarr.codecs import Crc32cCodec, ZstdCodec

    return ZstdCodec(), Crc32cCodec()


def consolidate(group: "zarr.Group") -> None:
    """Write the metadata of all variables to the group, so that readers need one file."""
    import zarr

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # zarr says that its format 3 has no standard for it yet
        zarr.consolidate_metadata(group.store)


# Files of a store: its metadata, and of each array that and the chunks; parts of what was stopped.
OF_STORES = re.compile(r"([^/]+/)?zarr\.json|[^/]+/c(/\d+)*|.*\.partial")


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
    files = (v.relative_to(path).as_posix() for v in path.rglob("*") if not v.is_dir())
    foreign = next((name for name in files if not OF_STORES.fullmatch(name)), None)
    if foreign:
        fail(str(path), f"holds {foreign}, which is of no store", "Choose another output folder")
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
