"""The time that a call may take, and what it says on stderr meanwhile."""

import math
import sys
import time
from dataclasses import dataclass
from typing import Any

from jaxmpc.checks import fail

# Seconds of compiling on two busy cores, which depend little on the problem: proofs along rays,
# labels of states, plans in batches, closed loops of a `Controller`.
PROOFS, LABELS, PLANS, LOOPS = 4.0, 12.0, 20.0, 20.0


@dataclass(frozen=True)
class Budget:
    """Until when a call may work, by `time.monotonic`, and whether it says on stderr what it does.

    Stages look at the clock between their steps. What cannot be interrupted (a compile above all)
    is left out from the start where `affords` says that it does not fit.
    """

    begun: float
    deadline: float
    progress: bool

    @classmethod
    def of(cls, seconds: Any, progress: bool = False) -> "Budget":
        """Return the budget of a call that begins now. Raises ValueError unless seconds > 0."""
        if not isinstance(seconds, int | float) or not seconds > 0:
            fail("seconds", f"{seconds!r}", "Give a positive number")
        now = time.monotonic()
        return cls(now, now + seconds, progress)

    @property
    def spent(self) -> float:
        """Return the seconds since the call began."""
        return time.monotonic() - self.begun

    def share(self, fraction: float) -> float:
        """Return when this fraction of the time left will be over."""
        now = time.monotonic()
        return now + fraction * max(self.deadline - now, 0.0)

    def affords(self, seconds: float) -> bool:
        """Return whether so many seconds are left."""
        return self.deadline - time.monotonic() >= seconds

    def sufficient(self, seconds: float) -> int:
        """Return a time limit, in whole seconds, under which so many would be left here: stages
        before take the time that they took, or the share of the limit, three quarters at most."""
        share = min(self.spent / (self.deadline - self.begun), 0.75)
        return math.ceil(max(self.spent + seconds, seconds / (1 - share)))

    @property
    def bar(self) -> bool:
        """Return whether to show a bar: a terminal is there to draw it."""
        return self.progress and sys.stderr.isatty()

    def say(self, stage: str) -> None:
        """Print the stage that begins, after the seconds spent so far."""
        if self.progress:
            print(f"{self.spent:6.1f} s  {stage}", file=sys.stderr, flush=True)
