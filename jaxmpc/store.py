"""A batch of results stored block by block, so that a killed run loses one block at most.

The store is a zarr v3 group that opens as a data set, `xarray.open_zarr(path)`. A grid has one
dimension an axis, with its coordinates; other samples lie along `sample`. `Field`s have a value a
sample, `Constant`s are known from the start or follow from all samples (`Store.save`).

A block is a run of consecutive samples, one zarr chunk of each variable. checksum (block) is a hash
of its data, written after them, and 0 before: a block whose data are missing, unreadable or others
than were written counts as not done. Fill values (label and status 0, NaN) are no answers. The
group appears under its name by one rename, complete with its attributes; zarr writes each chunk to
a side file and renames it. A power cut can lose data, which the checksums show: zarr does not sync
to the disk.

Several processes write one store as its shards: block k belongs to shard k mod n. A shared lock of
the folder keeps out whoever would write it alone; each shard has a lock file beside the store. The
first process makes the store, those that lose the race for its name open it. What is not theirs
(leftovers of killed processes, blocks of others) shards leave alone; the one that concludes removes
leftovers.

A URL of fsspec, such as s3://bucket/a.zarr, stands for a store of objects. A chunk is put there
whole or not at all and its block's checksum after it, so that all said of blocks holds; but there
are no locks and no rename. The attributes that make a group a store are written last, and
processes that make the same store at once write the same. That no two processes compute the same
shard is up to the caller there; two that do write the same data.
"""

import contextlib
import hashlib
import itertools
import math
import os
import shutil
import sys
import uuid
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeAlias

import numpy as np
import zarr
from zarr.codecs import Crc32cCodec, ZstdCodec

from jaxmpc.batches import padded
from jaxmpc.checks import fail, in_units, require_memory, shortened, shown
from jaxmpc.files import differences, faithful, fingerprint, text_within, versions
from jaxmpc.grids import mesh
from jaxmpc.pytrees import record

if TYPE_CHECKING:
    import xarray as xr


# Of each chunk; the last one adds a checksum of the file itself.
CODECS = (ZstdCodec(), Crc32cCodec())


# Most blocks of a store that is read. Its data are no larger than SMALL bytes, or so many times its
# files: a sweep's are some 13 times as large, one number throughout is far more.
MOST_BLOCKS, SMALL, MOST_COMPRESSED = 2**17, 2**28, 1000


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
        self, path: str | Path, axes: Mapping[str, Constant], fields: Mapping[str, Field],
        config: Mapping[str, Any], chunk: int, *, constants: Mapping[str, Constant] | None = None,
        attributes: Mapping[str, Any] | None = None, shard: tuple[int, int] | None = None,
        overwrite: bool = False, begun: Callable[[], None] = lambda: None,
    ) -> None:  # fmt: skip
        """Open the store at `path`, a folder or a URL, to write; make it where there is none.

        axes: the coordinates of the samples, a grid's axes in their order or one array along
        `sample`. constants: further known variables. config: JSON data that describes the
        computation; attributes: JSON data that follow from it. chunk: samples of a block at most.
        shard: (i, n), 0 ≤ i < n, to write the blocks k with k mod n = i only, beside other
        processes; None for all. overwrite: put a new store in the place of the one at `path`, once
        it has its first block: until then, and if that never comes, the old one stays as it is.
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
        self.block_shape = block_shape(self.shape, chunk)
        self.regions = regions(self.shape, self.block_shape)
        self.own = range(len(self.regions))[
            slice(None) if shard is None else slice(*shard_of(shard))
        ]
        self._locks = list[_Lock]()
        variables = {
            "axes": list(axes), "constants": list(constants or {}), "fields": list(fields),
            "block": list(self.block_shape),
        }  # fmt: skip
        record = {
            "config": dict(config), "chunk": chunk, "variables": variables, **(attributes or {}),
        }  # fmt: skip
        self.attributes = {
            "Conventions": "CF-1.11",
            **record,
            "fingerprint": _fingerprint(record, {k: v.data for k, v in self.constants.items()}),
            "versions": versions(),
        }
        self.attributes["digest"] = _digest(self.attributes)
        try:
            if isinstance(self.path, Path):
                self._locks.append(_Lock(self.path.parent, shared=shard is not None))
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
            self._locks.append(_Lock(self.path.parent, file=file, work=work))

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

    def samples(self, block: int) -> np.ndarray:
        """Return the indices of the samples of a block."""
        return np.r_[self.rows(block)]

    def pending(self) -> list[int]:
        """Return the indices of the blocks, of this shard, that are not done."""
        done = self._done()
        return [block for block in self.own if not done[block]]

    def _done(self) -> np.ndarray:
        """Return which blocks are marked as done; those whose marks cannot be read are not."""
        marks = _array(self.group, "checksum")
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
            return int(np.asarray(_array(self.group, "checksum")[block]))
        except Exception:
            return None

    def batches(self) -> tuple[list[tuple[int, slice]], np.ndarray]:
        """Return the blocks that are not done with their samples, and the indices (K, size) of
        these samples: the first one of a smaller block fills it up to the size of the largest, so
        that one compiled program takes them all."""
        todo = [(block, self.rows(block)) for block in self.pending()]
        index = [padded(self.samples(block), self.size) for block, _ in todo]
        return todo, np.array(index, int).reshape(len(todo), self.size)

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

    def commit(self, block: int, **rows: np.ndarray) -> None:
        """Write all variables of a block, (samples of the block, ...), then mark it done."""
        region, written = self.regions[block], []
        for name, value in rows.items():
            array = _array(self.group, name)
            here = tuple(part.stop - part.start for part in region)
            value = np.asarray(value, array.dtype).reshape(*here, *array.shape[len(here) :])
            array[region] = value
            written.append((name, value))
        _array(self.group, "checksum")[block] = checksum(dict(written))
        if self._aside is not None:
            self._replace(self._aside)

    def read(self, name: str, block: int | None = None) -> np.ndarray:
        """Return a variable (samples, ...), of one block or of all."""
        region = slice(None) if block is None else self.regions[block]
        found = np.asarray(_array(self.group, name)[region])
        return found.reshape(-1, *found.shape[len(self.shape) :])

    def save(self, values: Mapping[str, "Constant"]) -> None:
        """Write further variables, which follow from all blocks, with their checksums."""
        for name, (data, dimensions, attributes) in values.items():
            mark = {"checksum": str(checksum({name: data}))}
            self.group.create_array(
                name, data=data, overwrite=True, dimension_names=dimensions, compressors=CODECS,
                attributes={**attributes, **mark},
            )  # fmt: skip
        _consolidate(self.group)

    def _open(self) -> None:
        """Open the group, made, checked and repaired as needed."""
        if self.shard is None:
            self._remove_leftovers()
        if not exists(self.path):
            if isinstance(self.path, Path):
                self._create(self.path)
            else:
                self._create_objects(self.path)
        self.group = _open(self.path, "r+")
        self._require_configuration()
        self._repair()

    def _open_aside(self, path: Path) -> None:
        """Make a new store beside the one at `path`, and open it."""
        self._remove_leftovers()
        self._aside = aside = _side(path)
        self._make(aside)
        self.group = _open(aside, "r+")

    def _replace(self, aside: Path) -> None:
        """Put the new store in the place of the old one, and delete that."""
        path = require_removable(self.path)
        old = _side(path)
        os.rename(path, old)
        os.rename(aside, path)
        self._aside, self.group = None, _open(path, "r+")
        shutil.rmtree(old, ignore_errors=True)
        self._begun()

    def _make(self, path: Path) -> None:
        """Make the store in a folder of its own."""
        group = zarr.open_group(path, mode="w", zarr_format=3, attributes=self.attributes)
        for name in self._names():
            self._create_array(group, name)
        _consolidate(group)

    def _create(self, path: Path) -> None:
        """Create the store under a temporary name, then rename it to `path`, unless another process
        was first."""
        partial = _side(path)
        self._make(partial)
        try:
            os.rename(partial, path)
        except OSError:
            shutil.rmtree(partial, ignore_errors=True)
            if self.shard is None or not path.exists():
                raise

    def _create_objects(self, url: str) -> None:
        """Create the store in place, attributes last; what another process has made of it stays."""
        group = zarr.open_group(_place(url), mode="a", zarr_format=3)
        maker = {"maker": self.attributes["fingerprint"]}
        if dict(group.attrs) not in ({}, maker) or (not dict(group.attrs) and list(group.keys())):
            fail(url, "is a zarr group but no sweep store", "Choose another output folder")
        group.update_attributes(maker)
        for name in self._names():
            with contextlib.suppress(zarr.errors.ContainsArrayError):
                self._create_array(group, name, overwrite=False)
        for name in self.constants:  # once more: whoever made the array may have been killed
            self._write_constant(_array(group, name), name)
        group.attrs.put(self.attributes)
        _consolidate(group)

    def _remove_leftovers(self) -> None:
        """Remove what killed processes have left: stores half made, lock files, chunks half
        written."""
        if not isinstance(self.path, Path):
            return
        for left in self.path.parent.glob(f".{self.path.name}.*"):
            if left.is_dir():
                shutil.rmtree(left, ignore_errors=True)
            else:
                with contextlib.suppress(ValueError):  # it is held
                    _Lock(left.parent, file=left.name).release()
        for left in self.path.rglob("*.partial"):
            left.unlink(missing_ok=True)

    def _names(self) -> list[str]:
        return [*self.constants, *self.fields, "checksum"]

    def _create_array(self, group: zarr.Group, name: str, overwrite: bool = True) -> None:
        """Create one variable, without values but for constants."""
        options: dict[str, Any]
        if name in self.constants:
            data, dimensions, attributes = self.constants[name]
            options = dict(shape=data.shape, dtype=str if data.dtype.kind == "U" else data.dtype)
        elif name == "checksum":  # one a file: a kill while one is written leaves the others
            dimensions, attributes = ("block",), {"long_name": "hash of a block; 0: not done"}
            options = dict(shape=(len(self.regions),), chunks=(1,), dtype="uint64", fill_value=0)
        else:
            tail, dtype, fill, further, attributes = self.fields[name]
            dimensions = (*self.dimensions, *further)
            chunks = (*self.block_shape, *tail)
            options = dict(shape=(*self.shape, *tail), chunks=chunks, dtype=dtype, fill_value=fill)
        made = group.create_array(
            name, dimension_names=dimensions, attributes=dict(attributes), overwrite=overwrite,
            compressors=CODECS, **options,
        )  # fmt: skip
        if name in self.constants:
            self._write_constant(made, name)

    def _write_constant(self, array: zarr.Array[Any], name: str) -> None:
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
        renewed = [name for name in self._names() if not self._is_sound(name)]
        if renewed and self.shard is not None:
            what = f"{', '.join(renewed)}: missing or damaged"
            fail(str(self.path), what, "Stop all shards, and resume once without --shard")
        for name in renewed:
            del self.group[name]
            self._create_array(self.group, name)
        if renewed:
            _consolidate(self.group)
        lost = len(self.regions) if "checksum" in renewed else 0
        self.damaged = self._check(self.own) or lost

    def _check(self, blocks: Iterable[int]) -> int:
        """Mark those of the blocks as not done whose data are not as written; return their
        number."""
        marks, damaged = _array(self.group, "checksum"), 0
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
            array = _array(self.group, name)
            if name in self.constants:
                return bool(np.array_equal(np.asarray(array[...]), self.constants[name].data))
            count = len(self.regions)
            field = self.fields.get(name, Field((), "uint64", 0, ()))
            grid, chunks = (
                (self.shape, self.block_shape) if name in self.fields else ((count,), (1,))
            )
            return bool(
                array.shape == (*grid, *field.shape)
                and array.chunks == (*chunks, *field.shape)
                and array.dtype == np.dtype(field.dtype)
                and np.array_equal(array.fill_value, field.fill, equal_nan=field.dtype != "bool")
            )
        except Exception:  # unreadable metadata: zarr raises what its parsers raise
            return False

    def _checksum(self, block: int) -> int:
        """Return the checksum of the data of a block, −1 where they cannot be read."""
        region = self.regions[block]
        try:
            return checksum({k: np.asarray(_array(self.group, k)[region]) for k in self.fields})
        except Exception:
            return -1


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
    def points(self) -> np.ndarray:
        """Return the samples (B, d)."""
        if "points" in self.arrays:
            return self.arrays["points"]
        return mesh(list(self.axes.values()))


# What looks at attributes and axes before data are read, and returns what is wrong with them.
Check: TypeAlias = Callable[[Mapping[str, Any], Mapping[str, np.ndarray]], list[str]]
# Returns the shapes of variables, a sample, that follow from attributes.
Shapes: TypeAlias = Callable[[Mapping[str, Any]], Mapping[str, tuple[int, ...]]]


def read(
    path: str | Path,
    check: Check = lambda attributes, axes: [],
    shapes: Shapes = lambda attributes: {},
) -> Stored:
    """Read a store and compare it with its checksums; raises ValueError where there is none.

    Metadata come first: nothing is read that is larger than they and the files allow, and nothing
    but axes and constants before the fingerprint is found to be theirs. check: looks at these.
    shapes: of variables, a sample, that follow from the attributes; raises ValueError where these
    make no sense.
    """
    path = location(path)
    if isinstance(path, Path) and (path / "zarr.json").is_file():
        text_of(path, "zarr.json")  # raises for what is too large to be metadata
    group = _open(path, "r")
    try:
        return _read(path, group, check, shapes)
    except Exception as error:  # of zarr, its codecs, JSON: what damaged bytes may raise
        text = reason(error)
        return Stored.damaged(text if isinstance(error, ValueError) else f"cannot be read ({text})")


def reason(error: Exception) -> str:
    """Return an error as one line, with its kind unless it is one of values with a text."""
    text = " ".join(str(error).split())
    known = isinstance(error, ValueError) and text
    return shortened(text if known else f"{type(error).__name__}: {text}")


def _read(path: Path | str, group: zarr.Group, check: Check, shapes: Shapes) -> Stored:
    """Read an open store; raises where nothing can be said of its data."""
    found, described = _described(path, shapes)
    names, block = found["variables"], found["variables"]["block"]

    def load(name: str) -> np.ndarray:
        try:
            return np.asarray(_array(group, name)[...])
        except Exception as error:
            fail(name, f"cannot be read ({type(error).__name__})", "Its file is damaged")

    axes = {name: load(name) for name in names["axes"]}
    constants = {name: load(name) for name in names["constants"]}
    if found["fingerprint"] != _fingerprint(_record(found), {**axes, **constants}):
        fail("zarr.json", "configuration, axes or constants are not as they were written",
             "Overwrite it")  # fmt: skip
    if problems := check(found, axes):
        return Stored(found, {}, axes, 0, 0, problems, False)
    shape = tuple(len(axis) for axis in axes.values())
    parts = regions(shape, block)
    marks = _marks(path, group, len(parts))
    arrays = {name: load(name) for name in names["fields"]}
    problems = []
    for k in np.flatnonzero(marks):
        if marks[k] != checksum({name: v[parts[k]] for name, v in arrays.items()}):
            _require_files(path, arrays, parts[k], block, f"block {k}")
            problems.append(f"block {k}: data are not as they were written")
    own = {*axes, *constants, *arrays, "checksum"}
    for name in [name for name in described if name not in own]:  # what `Store.save` wrote
        constants[name] = load(name)
        stored = described[name]["attributes"].get("checksum")
        if stored != str(checksum({name: constants[name]})):
            problems.append(f"{name}: data are not as they were written")
    flat = {k: v.reshape(-1, *v.shape[len(shape) :]) for k, v in arrays.items()} | constants
    return Stored(found, flat, axes, len(parts), int(np.count_nonzero(marks)), problems)


def _record(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return those attributes that the fingerprint covers beside axes and constants."""
    others = ("Conventions", "fingerprint", "versions", "digest")
    return {name: value for name, value in attributes.items() if name not in others}


def _described(path: Path | str, shapes: Shapes) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the attributes of a store and the metadata of each variable. Raises ValueError where
    they do not fit each other, or describe more than the files can hold; no data are read."""
    root = faithful("zarr.json", text_of(path, "zarr.json"))
    try:
        found, together = root["attributes"], root["consolidated_metadata"]["metadata"]
        names, block = found["variables"], found["variables"]["block"]
        axes, fields = names["axes"], [*names["fields"]]
        own = [*axes, *names["constants"], *fields, "checksum"]
        digest = found.get("digest")
        fine = (
            digest in (None, _digest(found))
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
    expected = {
        name: Layout((*grid, *tail), (*block, *tail)) for name, tail in last.items()
    } | {"checksum": Layout((count,), (1,))}  # fmt: skip
    for name, layout in expected.items():
        if sizes[name][:2] != layout[:2]:
            what = f"shape {sizes[name].shape} where axes and problem say {layout.shape}"
            fail(name, what, "Overwrite the store")
    needed = sum(math.prod(v.shape) * v.itemsize for v in sizes.values())
    there = needed if isinstance(path, str) else _stored_bytes(path)
    if needed > max(SMALL, MOST_COMPRESSED * there):
        what = f"describes {in_units(needed)} of data, its files hold {in_units(there)}"
        fail("zarr.json", what, "Overwrite it")
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


def _marks(path: Path | str, group: zarr.Group, count: int) -> np.ndarray:
    """Return the checksums of all blocks, 0 of those that are not done."""
    array, marks = _array(group, "checksum"), np.zeros(count, np.uint64)
    if isinstance(path, str):
        return np.asarray(array[:])
    for file in (path / "checksum" / "c").glob("*"):
        if not (file.name.isdecimal() and int(file.name) < count):
            fail("checksum", f"holds {shown(file.name)}, which is of no block", "Overwrite it")
        marks[int(file.name)] = array[int(file.name)]
    return marks


def _require_files(
    path: Path | str, arrays: Mapping[str, np.ndarray], part: tuple[slice, ...],
    block: Sequence[int], where: str,
) -> None:  # fmt: skip
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
    for file in path.rglob("*"):
        if not file.is_file() and not file.is_dir():
            fail(str(file.relative_to(path)), "is no file", "Overwrite the store")
        total += file.stat().st_size if file.is_file() else 0
    return total


def _digest(attributes: Mapping[str, Any]) -> str:
    """Return a hash of all attributes: the fingerprint is of those that results depend on."""
    return fingerprint({k: v for k, v in attributes.items() if k != "digest"})


def open_dataset(path: str | Path) -> "xr.Dataset":
    """Return the store as an xarray Dataset (lazy); samples of blocks not done hold the fill
    values. `xarray.open_zarr(path)` does the same."""
    import xarray as xr  # takes longer to import than to read

    _open(location(path), "r")
    return xr.open_zarr(path)


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
    lock = _Lock(path.parent)
    try:
        shutil.rmtree(path)
    finally:
        lock.release()


def _side(path: Path) -> Path:
    """Return a new name beside a path; what lies there is a leftover once its process has ended."""
    return path.with_name(f".{path.name}.{uuid.uuid4().hex}")


def checksum(arrays: Mapping[str, np.ndarray]) -> int:
    """Return a hash of arrays in the order of their names, from 1 to 2⁶⁴ − 1."""
    state = hashlib.blake2b(digest_size=8)
    for name in sorted(arrays):
        value = np.ascontiguousarray(arrays[name])
        text = value.dtype.kind not in "biuf"
        data = repr(value.tolist()).encode() if text else value.tobytes()
        state.update(f"{name}{value.shape}{'' if text else value.dtype.str}".encode() + data)
    return int.from_bytes(state.digest(), "little") or 1


def _fingerprint(record: Mapping[str, Any], constants: Mapping[str, np.ndarray]) -> str:
    """Return a hash of all that determines a store."""
    return fingerprint([record, checksum(constants)])


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


def regions(shape: Sequence[int], block: Sequence[int]) -> list[tuple[slice, ...]]:
    """Return the parts of a grid that blocks of this shape cover, in C order."""
    along = [
        [slice(first, min(first + take, count)) for first in range(0, count, take)]
        for count, take in zip(shape, block, strict=True)
    ]
    return list(itertools.product(*along))


def shard_of(shard: tuple[int, int]) -> tuple[int, None, int]:
    """Return the first block of shard (i, n) and the step to the next, as arguments of a slice.

    Raises ValueError unless 0 ≤ i < n."""
    i, n = shard
    if not 0 <= i < n:
        fail("shard", f"{i}/{n}", "Give i/n with i from 0 to n - 1")
    return i, None, n


def location(path: str | Path) -> Path | str:
    """Return the path of a store, or its URL where it is one of objects."""
    text = str(path)
    if text.startswith("file://"):
        return Path(text.removeprefix("file://"))
    return text if "://" in text else Path(path)


def text_of(path: Path | str, name: str) -> str:
    """Return the text of a file of metadata below a path or URL; see `text_within`."""
    if isinstance(path, Path):
        return text_within(path / name)
    import fsspec

    with fsspec.open(f"{path}/{name}", "r") as file:
        return str(file.read())


def exists(path: Path | str) -> bool:
    """Return whether something lies at a path, or a complete store of objects at a URL."""
    if isinstance(path, Path):
        return path.exists()
    try:
        group = zarr.open_group(_place(path), mode="r", use_consolidated=False)
    except FileNotFoundError:
        return False
    return "fingerprint" in group.attrs


def _place(path: Path | str) -> Any:
    """Return what zarr opens at a path or URL. Raises ValueError where fsspec cannot open it."""
    if isinstance(path, Path):
        return path
    try:
        return zarr.storage.FsspecStore.from_url(path)
    except (ImportError, ValueError) as error:
        fail(path, f"{error}", "Install fsspec and what it needs for this kind of URL")


def _open(path: Path | str, mode: Any) -> zarr.Group:
    """Open a store; raise ValueError where `path` holds something else."""
    try:
        group = zarr.open_group(_place(path), mode=mode, use_consolidated=False)
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


def _consolidate(group: zarr.Group) -> None:
    """Write the metadata of all variables to the group, so that readers need one file."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # zarr says that its format 3 has no standard for it yet
        zarr.consolidate_metadata(group.store)


def _array(group: zarr.Group, name: str) -> zarr.Array[Any]:
    array = group[name]
    assert isinstance(array, zarr.Array)
    return array


class _Lock:
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


def report_damage(store: Store) -> None:
    """Say on stderr how many blocks of a store are computed again because their data are damaged or
    missing."""
    if store.damaged:
        what = "blocks that were done are" if store.damaged > 1 else "block that was done is"
        count = f"{store.damaged:,} of {len(store.regions):,}"
        text = f"{store.path}: {count} {what} missing or damaged, computed again"
        print(text, file=sys.stderr)
