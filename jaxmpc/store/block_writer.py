"""Blocks put together from parts, each written while the next one is computed."""

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Self

import numpy as np

from jaxmpc.batches import cores
from jaxmpc.store.writing import Store

# Blocks that are written at a time at most.
WRITERS = 4


class BlockWriter:
    """Puts the parts of blocks together, and writes each whole block in a thread of its own.

    One block is filled and at most `WRITERS` are written at a time, on two cores one; a process
    that is killed loses these. An error of a thread, such as that of a full disk, is raised by a
    later `put`, or at the end of the context. Its end, by an interruption too, waits for the blocks
    that are written; one that is not whole is dropped.
    """

    def __init__(self, store: Store) -> None:
        self.store = store
        self._most = max(1, min(WRITERS, cores() // 2))
        self._threads = ThreadPoolExecutor(self._most, "blocks")
        self._writing: deque[Future[None]] = deque()
        self._block, self._missing = -1, 0
        self._rows: dict[str, np.ndarray] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, error: object, *_: object) -> None:
        self._threads.shutdown()
        if error is None:
            self._wait(0)

    def put(self, block: int, part: slice, **rows: np.ndarray) -> None:
        """Take all variables of a part of a block, (samples of the part, ...). part: its samples,
        counted in C order of the grid (`Store.parts`). The parts of a block come one after the
        other, in any order, and none twice."""
        whole = self.store.rows(block)
        if block != self._block:
            self._block, self._missing, self._rows = block, whole.stop - whole.start, {}
        size = part.stop - part.start
        if size == whole.stop - whole.start:
            self._rows = rows
        else:
            for name, value in rows.items():
                if name not in self._rows:
                    shape = (whole.stop - whole.start, *value.shape[1:])
                    self._rows[name] = np.empty(shape, value.dtype)
                self._rows[name][part.start - whole.start : part.stop - whole.start] = value
        self._missing -= size
        if not self._missing:
            # The first block of a store that replaces another one puts it in its place.
            self._wait(0 if self.store.replaces else self._most - 1)
            self._writing.append(self._threads.submit(self.store.commit, block, **self._rows))
            self._block = -1

    def _wait(self, most: int) -> None:
        """Wait until `most` blocks are still written; raise the error that one ended in."""
        while len(self._writing) > most:
            self._writing.popleft().result()
