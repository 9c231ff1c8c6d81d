"""A batch of results stored chunk by chunk, so that a killed run loses one chunk at most.

The store is a zarr v3 group, one row a sample, written in whole zarr chunks. A sweep's store has

    points (sample, coordinate), label (sample), status (sample),
    start (sample, state), plan (sample, time, input): x_0 and inputs that prove feasible,
    cut_normal (sample, coordinate), cut_offset (sample): the half-space that proves infeasible
    (offset inf: none that holds on the whole feasible set is known),
    done (chunk); after refinement bound_point (ray, coordinate), bound_normal (facet,
    coordinate), bound_offset (facet): proved boundary points and half-spaces

The group appears under its name by one rename, complete with its attributes. A chunk counts
only once its entry of `done` is set, which happens after all its rows are written; zarr
writes each chunk to a side file and renames it. Fill values (label and status 0, NaN) are
no answers, so that a row not reached is never taken for one. A power cut can lose data: zarr does
not sync to the disk.
"""

import os
import shutil
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import zarr

from jaxmpc.checks import fail
from jaxmpc.runs import differences, fingerprint, versions

if TYPE_CHECKING:
    import xarray as xr


def open_sweep(
    path: str | Path,
    points: np.ndarray,
    shape: tuple[int, int, int],
    config: Mapping[str, Any],
    chunk: int,
) -> zarr.Group:
    """Open the store of a sweep at `path` to write; make it where there is none.

    `points` (B, d) are the samples, `shape` is (n, N, m), the rest as in `open_store`.
    """
    d, (n, *plan_shape) = points.shape[1], shape
    fields: dict[str, Field] = {
        "label": Field((), "int8", 0, ()),
        "status": Field((), "int8", 0, ()),
        "start": Field((n,), "float64", np.nan, ("state",)),
        "plan": Field(tuple(plan_shape), "float64", np.nan, ("time", "input")),
        "cut_normal": Field((d,), "float64", np.nan, ("coordinate",)),
        "cut_offset": Field((), "float64", np.nan, ()),
    }
    return open_store(path, points, fields, config, chunk, shape)


class Field(NamedTuple):
    """A field of each sample: shape, type, value while it is not written, names of its axes."""

    shape: tuple[int, ...]
    dtype: str
    fill: Any
    dimensions: tuple[str, ...]


def open_store(
    path: str | Path,
    points: np.ndarray,
    fields: Mapping[str, Field],
    config: Mapping[str, Any],
    chunk: int,
    shape: tuple[int, ...],
) -> zarr.Group:
    """Open the store at `path` to write; make it where there is none, with these fields.

    `points` (B, d) are the samples, `config` is JSON data that describes the computation,
    `shape` the sizes that fields follow from, `chunk` is the number of rows a commit. Raises
    ValueError where the store was made with another configuration, or where something else lies
    there.
    """
    path = Path(path)
    attributes = {
        "config": dict(config),
        "chunk": chunk,
        "fingerprint": fingerprint([dict(config), shape, chunk], points),
        "versions": versions(),
    }
    if not path.exists():
        _create(path, points, fields, attributes)
    group = _open(path, "r+")
    if group.attrs["fingerprint"] != attributes["fingerprint"]:
        stored: Any = group.attrs["config"]
        changes = differences({**stored, "chunk": group.attrs["chunk"]}, {**config, "chunk": chunk})
        fail(
            str(path),
            f"holds results of another configuration ({'; '.join(changes) or 'other points'})",
            "Resume with that configuration, choose another output, or overwrite",
        )
    return group


def pending(group: zarr.Group) -> list[int]:
    """Return the indices of the chunks that are not committed."""
    return np.flatnonzero(_array(group, "done")[:] == 0).tolist()


def chunk_rows(group: zarr.Group, index: int) -> slice:
    """Return the rows that belong to one chunk; the last may be short."""
    chunk = _chunk(group)
    return slice(index * chunk, min((index + 1) * chunk, _array(group, "points").shape[0]))


def commit(group: zarr.Group, index: int, **rows: np.ndarray) -> None:
    """Write all rows of chunk `index`, then mark it done.

    `rows` has all fields of the store; other processes may commit other chunks at the same time.
    """
    where = chunk_rows(group, index)
    for name, value in rows.items():
        _array(group, name)[where] = value
    _array(group, "done")[index] = 1


def save_bounds(
    group: zarr.Group, points: np.ndarray, normals: np.ndarray, offsets: np.ndarray
) -> None:
    """Write what refinement proved: points (K, d) and half-spaces normals (F, d), offsets (F,)."""
    for name, value, dimensions in (
        ("bound_point", points, ("ray", "coordinate")),
        ("bound_normal", normals, ("facet", "coordinate")),
        ("bound_offset", offsets, ("facet",)),
    ):
        group.create_array(name, data=value, overwrite=True, dimension_names=dimensions)


def open_dataset(path: str | Path) -> "xr.Dataset":
    """Return the store as an xarray Dataset (lazy); rows of chunks not done hold the fill
    values."""
    import xarray as xr  # takes longer to import than to read

    _open(Path(path), "r")
    return xr.open_zarr(path, consolidated=False, mask_and_scale=False)


def remove(path: str | Path) -> None:
    """Delete the store at `path`; ValueError, and nothing deleted, where it is no store."""
    _open(Path(path), "r")
    shutil.rmtree(path)


def _create(
    path: Path, points: np.ndarray, fields: Mapping[str, Field], attributes: dict[str, Any]
) -> None:
    """Create the store under a temporary name, then rename it to `path`."""
    rows, chunk = len(points), attributes["chunk"]
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    group = zarr.open_group(partial, mode="w", zarr_format=3, attributes=attributes)
    samples = Field(points.shape[1:], "float64", np.nan, ("coordinate",))
    for name, (tail, dtype, fill, dimensions) in {"points": samples, **fields}.items():
        group.create_array(
            name,
            shape=(rows, *tail),
            chunks=(chunk, *tail),
            dtype=dtype,
            fill_value=fill,
            dimension_names=("sample", *dimensions),
        )
    # One marker a file: markers that share a zarr chunk are lost when two processes write.
    group.create_array(
        "done",
        shape=(-(-rows // chunk),),
        chunks=(1,),
        dtype="uint8",
        fill_value=0,
        dimension_names=("chunk",),
    )
    _array(group, "points")[:] = points
    try:
        os.rename(partial, path)
    except OSError:  # another process was first: use its store
        shutil.rmtree(partial)
        if not path.exists():
            raise


def _open(path: Path, mode: Any) -> zarr.Group:
    """Open a store; raise ValueError where `path` holds something else."""
    try:
        group = zarr.open_group(path, mode=mode)
    except (OSError, ValueError) as error:  # zarr's own errors derive from these
        fail(str(path), f"is no sweep store ({error})", "Choose another output folder")
    if "fingerprint" not in group.attrs:
        fail(str(path), "is a zarr group but no sweep store", "Choose another output folder")
    return group


def _array(group: zarr.Group, name: str) -> zarr.Array[Any]:
    array = group[name]
    assert isinstance(array, zarr.Array)
    return array


def _chunk(group: zarr.Group) -> int:
    return int(group.attrs["chunk"])  # type: ignore[arg-type]
