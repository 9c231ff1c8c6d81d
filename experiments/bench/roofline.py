"""What a program asks of the machine and what the machine can do, measured in the same run.

XLA's cost analysis counts the body of a loop once, however often it runs. Operations are counted
here from the program itself: matrix products, times the length of each loop that has one. Loops
that end when their instances are done count one round, and what is no product counts nothing, so
that the count, and the share of the ceilings that follows from it, is a lower bound.
"""

import time
from collections.abc import Callable
from dataclasses import astuple, dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.checks import available_memory

# What measures the ceilings: order of the matrices (on a CPU; four times that on other devices),
# length of the vectors and number of their sums.
ORDER, LENGTH, SUMS = 2048, 2**25, 10


@dataclass(frozen=True)
class Work:
    """Operations in float32 and float64, and bytes that the products read and write: lower bounds.
    xla_flops, xla_bytes: what `cost_analysis` of the compiled program says, bodies of loops counted
    once; None where it was not asked."""

    flops32: float = 0.0
    flops64: float = 0.0
    bytes: float = 0.0
    xla_flops: float | None = None
    xla_bytes: float | None = None

    @classmethod
    def of(cls, function: Callable[..., Any], *arguments: Any) -> "Work":
        """Return the work of a function of arrays, which is traced."""
        return cls(*map(float, _counted(jax.make_jaxpr(function)(*arguments).jaxpr)))

    def beside(self, compiled: Any) -> "Work":
        """Return this work with what XLA counts in the compiled program."""
        found = compiled.cost_analysis() or {}
        return replace(self, xla_flops=found.get("flops"), xla_bytes=found.get("bytes accessed"))


def _counted(jaxpr: Any) -> np.ndarray:
    """Return flops in float32 and float64, and bytes (3,), of the products of a jaxpr."""
    total = np.zeros(3)
    for equation in jaxpr.eqns:
        parameters = equation.params
        if equation.primitive.name == "dot_general":
            left, out = equation.invars[0].aval, equation.outvars[0].aval
            (contracted, _), _ = parameters["dimension_numbers"]
            flops = 2.0 * out.size * np.prod([left.shape[i] for i in contracted])
            moved = [*equation.invars, *equation.outvars]
            traffic = sum(v.aval.size * v.aval.dtype.itemsize for v in moved)
            total += [0, flops, traffic] if out.dtype.itemsize == 8 else [flops, 0, traffic]
            continue
        inner = [_counted(part) for value in parameters.values() for part in _jaxprs(value)]
        if inner:
            branches = equation.primitive.name == "cond"
            once = np.max(inner, axis=0) if branches else np.sum(inner, axis=0)
            total += once * parameters.get("length", 1)
    return total


def _jaxprs(value: Any) -> list[Any]:
    """Return the jaxprs in a parameter of an equation."""
    parts = value if isinstance(value, tuple | list) else (value,)
    opened = [getattr(part, "jaxpr", part) for part in parts]
    return [part for part in opened if hasattr(part, "eqns")]


@dataclass(frozen=True)
class Ceilings:
    """What the default device reached in this run, in 1e9 a second: operations of matrix products
    in both precisions, and bytes of a sum of two long vectors."""

    gflops32: float
    gflops64: float
    gigabytes: float

    @classmethod
    def measure(cls, rounds: int = 3) -> "Ceilings":
        """Return the best of some rounds, 64-bit mode on."""
        product = jax.jit(lambda A: jnp.matmul(A, A, precision="highest"))
        found, order = [], ORDER if jax.default_backend() == "cpu" else 4 * ORDER
        for dtype in (jnp.float32, jnp.float64):
            A = jnp.ones((order, order), dtype)
            found.append(2.0 * order**3 / best_seconds(partial(product, A), rounds))
        a, b = jnp.ones(LENGTH, jnp.float32), jnp.ones(LENGTH, jnp.float32)
        # Within one program, which does not ask for new memory each time.
        add = jax.jit(lambda a, b: jax.lax.fori_loop(0, SUMS, lambda _, s: 0.5 * s + b, a))
        found.append(3.0 * SUMS * a.nbytes / best_seconds(partial(add, a, b), rounds))
        return cls(*(value / 1e9 for value in found))

    def or_better(self, other: "Ceilings") -> "Ceilings":
        """Return the larger of each: other work on the machine only lowers them."""
        pairs = zip(astuple(self), astuple(other), strict=True)
        return Ceilings(*(max(pair) for pair in pairs))

    def share(self, work: Work, seconds: float) -> tuple[float, str]:
        """Return the time that the work takes at the ceilings over `seconds`, and what bounds it,
        "flops" or "bytes"."""
        flops = work.flops32 / self.gflops32 + work.flops64 / self.gflops64
        moved = work.bytes / self.gigabytes
        bound = "flops" if flops > moved else "bytes"
        return max(flops, moved) / 1e9 / seconds, bound


def best_seconds(call: Callable[[], Any], rounds: int) -> float:
    """Return the least time of some calls after a first one."""
    jax.block_until_ready(call())
    times = []
    for _ in range(rounds):
        begun = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - begun)
    return min(times)


def memory_of(compiled: Any) -> int:
    """Return the bytes that a compiled program needs: arguments, results and temporary arrays."""
    found = compiled.memory_analysis()
    parts = ("argument", "output", "temp")
    return int(sum(getattr(found, f"{part}_size_in_bytes") for part in parts))


def free_memory() -> float:
    """Return the bytes that are free on the default device."""
    device = jax.devices()[0]
    if device.platform == "cpu":
        return available_memory()
    found = device.memory_stats() or {}
    return float(found.get("bytes_limit", np.inf)) - float(found.get("bytes_in_use", 0))
