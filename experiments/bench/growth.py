"""Time and memory of a batch of plans against its size, the horizon and the number of states."""

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, Literal

import jax
import numpy as np
from bench.families import LIMITS, half_widths, problem, springs, turbompc
from bench.roofline import free_memory, memory_of

from jaxmpc.mpc.condense import in_float64
from jaxmpc.mpc.controller import Controller
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.status import Status

Axis = Literal["batch", "N", "n"]
# A point that would take longer (s), by the two before it, ends its axis.
LONGEST = 60.0


@dataclass(frozen=True)
class Point:
    """`jax.vmap(controller.plan)` at one size. memory: bytes of arguments, results and temporary
    arrays, as XLA plans them. seconds, solved: None where that does not fit or takes too long."""

    axis: Axis
    value: int
    family: str
    batch: int
    horizon: int
    states: int
    variables: int
    memory: int
    compile_seconds: float
    seconds: float | None
    solved: float | None
    note: str = ""

    def plain(self) -> dict[str, Any]:
        """Return the point as JSON data."""
        return asdict(self)


@dataclass(frozen=True)
class Growth:
    """Which sizes: batches at the problem's own horizon; horizons and numbers of states (masses on
    springs, N = 20) at `beside` states in the batch."""

    family: str = "joint"
    batches: tuple[int, ...] = tuple(2**k for k in range(8, 23, 2))
    horizons: tuple[int, ...] = (10, 20, 40, 80, 160, 320)
    states: tuple[int, ...] = (2, 4, 8, 16, 32, 64)
    beside: int = 256
    rounds: int = 3
    seed: int = 0

    def run(self) -> Iterator[Point]:
        """Yield the points, axis by axis, each axis upwards until memory or time ends it."""
        own = problem(self.family)
        axes: dict[Axis, tuple[tuple[int, ...], Any]] = {
            "batch": (self.batches, lambda v: (self.family, own, v)),
            "N": (self.horizons, lambda v: (self.family, problem(self.family, v), self.beside)),
            "n": (self.states, lambda v: ("springs", springs(v // 2, 20), self.beside)),
        }
        for axis, (values, make) in axes.items():
            expected = 0.0
            last: Point | None = None
            for value in values:
                found = self._point(axis, value, make(value), expected)
                yield found
                if found.seconds is None:
                    break
                if last is not None and last.seconds:
                    expected = found.seconds**2 / last.seconds
                last = found

    def _point(self, axis: Axis, value: int, of: tuple[str, MPC, int], expected: float) -> Point:
        family, mpc, batch = of
        n = mpc.system.n
        controller = Controller(in_float64(mpc))
        program = jax.jit(jax.vmap(lambda c, x: c.plan(x), in_axes=(None, 0)))
        begun = time.perf_counter()
        shape = jax.ShapeDtypeStruct((batch, n), np.float64)
        compiled = program.lower(controller, shape).compile()
        memory = memory_of(compiled)
        variables = controller.condensed.P.shape[0] if controller.condensed else 0
        compile_seconds = time.perf_counter() - begun
        size = (axis, value, family, batch, mpc.horizon, n, variables)
        point = partial(Point, *size, memory, compile_seconds)
        if memory > free_memory():
            return point(None, None, "does not fit into memory")
        if expected > LONGEST:
            return point(None, None, f"would take about {expected:.0f} s")
        x = jax.device_put(self._states(family, mpc, batch))
        times: list[float] = []
        while len(times) < 1 + self.rounds and sum(times) < LONGEST / 2:
            begun = time.perf_counter()
            plans = jax.block_until_ready(compiled(controller, x))
            times.append(time.perf_counter() - begun)
        return point(min(times), float(np.mean(np.asarray(plans.status) == Status.SOLVED)))

    def _states(self, family: str, mpc: MPC, count: int) -> np.ndarray:
        """Return random states (count, n) of the inner fifth of the limits, nearly all feasible."""
        if family in LIMITS:
            return turbompc(LIMITS[family], batch=count, seed=self.seed)[1]
        half = 0.2 * half_widths(mpc)
        return np.random.default_rng(self.seed).uniform(-half, half, (count, len(half)))


def exponents(points: list[Point]) -> dict[str, dict[str, float]]:
    """Return, for each axis, the exponents of time and memory: slopes of the least-squares line
    through the logarithms of the upper half of the points that were measured."""
    found: dict[str, dict[str, float]] = {}
    for axis in dict.fromkeys(point.axis for point in points):
        here = [point for point in points if point.axis == axis]
        for name in ("seconds", "memory"):
            known = [(p.value, getattr(p, name)) for p in here if getattr(p, name)]
            upper = np.log(known[len(known) // 2 :] if len(known) > 3 else known)
            if len(upper) > 1:
                slope = float(np.polyfit(upper[:, 0], upper[:, 1], 1)[0])
                found.setdefault(axis, {})[name] = slope
    return found
