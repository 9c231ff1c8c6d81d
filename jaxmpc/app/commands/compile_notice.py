"""What a command says while it compiles: what, and for how long so far."""

import sys
import threading
import time
from types import TracebackType

from jaxmpc.batches import Compiled


class Compiling:
    """A wait for the compiler, told on stderr inside `with` until so many programs are ready.

    On a terminal one line counts the seconds; elsewhere a line says what compiles, and one that it
    is compiled. programs: 0 where their number is not known.
    """

    def __init__(self, what: str, programs: int = 0) -> None:
        self._what, self._missing = what, programs
        self._ended = threading.Event()
        self._counter: threading.Thread | None = None

    def __enter__(self) -> None:
        Compiled.listeners.append(self._ready)
        self._begun = self._last = time.perf_counter()
        if sys.stderr.isatty():
            self._draw()
            self._counter = threading.Thread(target=self._count, daemon=True)
            self._counter.start()
        else:
            print(f"compiling {self._what}", file=sys.stderr, flush=True)

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        Compiled.listeners.remove(self._ready)
        self.end()

    def end(self) -> None:
        """Say how long it was until the last program was ready, once; nothing where there was
        none, for this process had all of them."""
        if self._ended.is_set():
            return
        self._ended.set()
        if self._counter is not None:
            self._counter.join()
            print(f"\r{'':79}\r", end="", file=sys.stderr, flush=True)
        if self._last > self._begun:
            seconds = self._last - self._begun
            print(f"compiled {self._what} in {seconds:.0f} s", file=sys.stderr, flush=True)

    def _ready(self) -> None:
        """Note that a program is compiled."""
        self._last = time.perf_counter()
        self._missing -= 1
        if not self._missing:
            self.end()

    def _count(self) -> None:
        """Update the line each second until the end."""
        while not self._ended.wait(1.0):
            self._draw()

    def _draw(self) -> None:
        line = f"compiling {self._what}, {time.perf_counter() - self._begun:.0f} s"
        print(f"\r{line:79}", end="", file=sys.stderr, flush=True)
