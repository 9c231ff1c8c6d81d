"""Blocks of a grid, and hashes of their data and of what describes a store."""

import hashlib
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxmpc.checks import fail
from jaxmpc.files import fingerprint


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


def checksum(arrays: Mapping[str, np.ndarray]) -> int:
    """Return a hash of arrays in the order of their names, from 1 to 2⁶⁴ − 1."""
    state = hashlib.blake2b(digest_size=8)
    for name in sorted(arrays):
        value = np.ascontiguousarray(arrays[name])
        text = value.dtype.kind not in "biuf"
        data = repr(value.tolist()).encode() if text else value.tobytes()
        state.update(f"{name}{value.shape}{'' if text else value.dtype.str}".encode() + data)
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
