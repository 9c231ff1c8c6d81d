"""Damage to stores."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np


def turned_bits(store: Path, count: int) -> Iterator[Path]:
    """Turn one bit of some file of some variable of a store, data or metadata, `count` times; yield
    the file, and make it whole again."""
    random = np.random.default_rng(0)
    files = [v for v in store.rglob("*") if v.is_file() and v.parent != store]
    for _ in range(count):
        file = files[random.integers(len(files))]
        good = file.read_bytes()
        bad = bytearray(good)
        bad[random.integers(len(bad))] ^= 1 << random.integers(8)
        file.write_bytes(bad)
        yield file
        file.write_bytes(good)
