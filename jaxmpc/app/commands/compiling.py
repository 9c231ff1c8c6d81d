"""What a command says while it compiles: about how long, by an earlier run or by a guess."""

import contextlib
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax

from jaxmpc.app.programs import times_file
from jaxmpc.batches import Compiled
from jaxmpc.files import fingerprint, text_within, versions, write_json
from jaxmpc.robots.load import model_hash
from jaxmpc.robots.robot import Robot

# Seconds of the first compile on free cores: with no degree of freedom, and for each of them.
GUESSES = {
    "loops": (20.0, 6.0),
    "map of limits": (45.0, 8.0),
    "map of recursion": (45.0, 8.0),
    "gradients": (30.0, 30.0),
}


@dataclass
class Compiling:
    """A wait for the compiler that was announced on stderr.

    times: the file with the seconds of earlier runs; None where nothing is kept. key: what is
    compiled. begun, last: when it began and when the last program was ready, by
    `time.perf_counter`. said: when that was last mentioned. finished: nothing more is said.
    """

    times: Path | None
    key: str
    begun: float
    last: float
    said: float
    finished: bool = False

    @classmethod
    def announce(cls, robot: Robot, kind: str, options: dict[str, Any]) -> "Compiling":
        """Say on stderr for how long this command compiles, and begin to measure it.

        kind: of `GUESSES`, for robots that were not compiled here before. options: what determines
        the programs beside the model of the robot, as JSON data.
        """
        times, device = times_file(), jax.devices()[0].device_kind
        key = fingerprint([kind, options, model_hash(robot), versions(), device])
        match _read(times).get(key):
            case [_, float() as last]:
                text = f"about {last:.0f} s, as last time"
            case [float() as first]:  # now its programs are there
                text = f"less than the {first:.0f} s of the first time"
            case _:
                base, each = GUESSES[kind]
                guess = base + each * robot.mujoco.nv
                text = f"about {guess:.0f} s on free cores (a guess by the number of joints)"
        print(f"compiling, {text}", file=sys.stderr, flush=True)
        now = time.perf_counter()
        return cls(times, key, now, now, now)

    @contextlib.contextmanager
    def followed(self, programs: int | None = None) -> Iterator[None]:
        """Say when programs are ready; with `programs` of them, all are."""
        ready = 0

        def listener() -> None:
            nonlocal ready
            ready, self.last = ready + 1, time.perf_counter()
            if ready == programs:
                self.over()
            elif not self.finished and self.last - self.said > 5.0:
                self._say(f"compiling, {ready} program{'s' * (ready > 1)} ready after")
                self.said = self.last

        Compiled.listeners.append(listener)
        try:
            yield
        finally:
            Compiled.listeners.remove(listener)

    def over(self) -> None:
        """Say after how long the last program was ready, once, and keep that for the next time."""
        if self.finished:
            return
        self.finished = True
        if self.last == self.begun:  # this process has all programs from earlier on
            return
        self._say("compiled in")
        if self.times is not None:
            with contextlib.suppress(OSError):
                known = _read(self.times)
                known[self.key] = [*known.get(self.key, [])[:1], self.last - self.begun]
                write_json(self.times, known)

    def _say(self, what: str) -> None:
        print(f"{what} {self.last - self.begun:.0f} s", file=sys.stderr, flush=True)


def _read(path: Path | None) -> dict[str, list[float]]:
    """Return the seconds of earlier runs by key; none where the file is no such file."""
    try:
        found = json.loads(text_within(path)) if path is not None else {}
    except (ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}
