"""Locks that keep other processes from writing where one writes."""

import os
from collections.abc import Callable
from pathlib import Path

from jaxmpc.checks import fail


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
