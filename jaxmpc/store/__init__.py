"""A batch of results stored block by block, so that a killed run loses no more than those in hand.

The store is a zarr v3 group that opens as a data set, `xarray.open_zarr(path)`. A grid has one
dimension an axis, with its coordinates; other samples lie along `sample`. `Field`s have a value a
sample, `Constant`s are known from the start or follow from all samples (`Store.save`).

A block is a run of consecutive samples, one zarr chunk of each variable. It may be computed in
several parts: files of megabytes are written at the speed of the disk, programs take fewer samples
at once. checksum (block) is a hash of its data, written after them, and 0 before: a block whose
data are missing, unreadable or others than were written counts as not done. Fill values (label and
status 0, NaN) are no answers. The group appears under its name by one rename, complete with its
attributes; zarr writes each chunk to a side file and renames it. A power cut can lose data, which
the checksums show: zarr does not sync to the disk.

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

Store, Field, Constant  an open store and what it holds, to write block by block
BlockWriter             the same part by part, each block in a thread while the next is computed
read                    what lies there, compared with its checksums -> Stored
open_dataset            the same as an xarray data set
remove                  delete a store, and nothing else
"""

from jaxmpc.store.block_writer import BlockWriter
from jaxmpc.store.reading import Check, Stored, exists, location, open_dataset, read, reason
from jaxmpc.store.writing import Constant, Field, Store, remove, report_damage

__all__ = [
    "BlockWriter",
    "Check",
    "Constant",
    "Field",
    "Store",
    "Stored",
    "exists",
    "location",
    "open_dataset",
    "read",
    "reason",
    "remove",
    "report_damage",
]
