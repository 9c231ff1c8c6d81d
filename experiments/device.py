"""Plans and labels of many states on the device, their memory, and how often programs are traced.

    python experiments/device.py                      # 2²⁰ states of the joint; on a GPU
    python experiments/device.py --states 65536       # on a CPU

Times are the best of `rounds` calls after the first, wall time until the result lies on the device
(plans) or on the host (labels). Memory is XLA's own count of temporary arrays. A program counts as
traced where Python functions became a jaxpr and as compiled where XLA made an executable of it.
"""

import functools
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import jax
import numpy as np
import tyro
from mpc_families import family, joint

import jaxmpc as jm

TRACED, COMPILED = "jaxpr_trace_duration", "backend_compile_duration"


@dataclass(frozen=True)
class Settings:
    """states: of the joint; springs8 takes a sixteenth of them. rounds: calls that are timed."""

    states: int = 2**20
    seed: int = 0
    rounds: int = 3


def seconds(call: Callable[[], Any], rounds: int) -> float:
    """Return the least time of `rounds` calls after a first one."""
    times = []
    for _ in range(1 + rounds):
        begin = perf_counter()
        jax.block_until_ready(call())
        times.append(perf_counter() - begin)
    return min(times[1:])


def print_plans(name: str, states: int, s: Settings) -> None:
    """Print the time of `jax.vmap(controller.plan)` for feasible states of a family."""
    mpc, x = family(name, min(states, 65536), s.seed)
    x = jax.device_put(np.tile(x, (states // len(x), 1)))
    controller = jm.Controller(mpc)
    program = jax.jit(jax.vmap(lambda x: controller.plan(x)))
    spent, plans = seconds(lambda: program(x), s.rounds), program(x)
    solved = np.mean(np.asarray(plans.status) == jm.Status.SOLVED)
    print(f"plans   {name:9} {states:8} states {spent * 1e3:8.1f} ms, "
          f"{spent / states * 1e6:.3f} µs each, {solved:.4%} solved", flush=True)  # fmt: skip


def print_labels(s: Settings) -> None:
    """Print the time of `map_feasible_set` with float64 proofs over the box of the joint."""
    x = np.random.default_rng(s.seed).uniform([-1.6, -2.1], [1.6, 2.1], (s.states, 2))
    found = jm.map_feasible_set(joint(), x)
    spent = seconds(lambda: jm.map_feasible_set(joint(), x).label, s.rounds)
    print(f"labels  joint     {s.states:8} states {spent * 1e3:8.1f} ms, on the host; "
          f"{found.counts()}", flush=True)  # fmt: skip


def print_memory(name: str, states: int) -> None:
    """Print the temporary memory of `jax.vmap(solve)`."""
    mpc = family(name, 1, 0)[0]
    x = jax.ShapeDtypeStruct((states, mpc.system.n), np.float64)
    program = jax.jit(jax.vmap(lambda x: jm.solve(mpc, x).inputs)).lower(x).compile()
    size = program.memory_analysis().temp_size_in_bytes
    print(f"memory  {name:9} {states:8} states {size / 1e9:8.2f} GB", flush=True)


def print_programs() -> None:
    """Print what is traced and compiled by first and by later calls."""
    counts: Counter[str] = Counter()
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, *_, **__: counts.update([name.rsplit("/", 1)[-1]])
    )
    mpc = joint()
    x = np.array([[0.5, 0.1], [0.4, 0.2]])
    controller = functools.cache(lambda: jm.Controller(mpc))
    calls: dict[str, Callable[[], Any]] = {
        "first solve": lambda: jm.solve(mpc, x[0]),
        "second solve, other state": lambda: jm.solve(mpc, x[1]),
        "solve, other weights": lambda: jm.solve(joint_with(2.0), x[0]),
        "Controller, first call": lambda: controller()(x[0]),
        "its first call with a carry": lambda: controller()(x[0], controller()(x[1])[1]),
        "ten more": lambda: [controller()(x[0], controller()(x[1])[1]) for _ in range(10)],
        "solve_many, 100 states": lambda: jm.solve_many(mpc, np.tile(x, (50, 1))),
        "solve_many, 100 others": lambda: jm.solve_many(mpc, np.tile(x, (50, 1)) / 2),
    }
    for name, call in calls.items():
        counts.clear()
        jax.block_until_ready(jax.tree.leaves(call()))
        print(f"traced {counts[TRACED]:4}, compiled {counts[COMPILED]:3}: {name}", flush=True)


def joint_with(weight: float) -> jm.MPC:
    """The joint with Q times `weight`."""
    mpc = joint()
    return jm.MPC(
        mpc.system, weight * mpc.Q, mpc.R, mpc.horizon, states=mpc.states, inputs=mpc.inputs,
        terminal_cost=mpc.terminal_cost,
    )  # fmt: skip


def main(s: Settings) -> None:
    """Print all of it."""
    jax.config.update("jax_enable_x64", True)
    print_programs()
    print_memory("joint", 65536)
    print_memory("springs8_30", 3000)
    print_plans("joint", s.states, s)
    print_plans("springs8", max(s.states // 16, 1), s)
    print_labels(s)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
