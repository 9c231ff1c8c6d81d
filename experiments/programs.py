"""How often programs are traced and compiled, by first calls and by later ones, and the processor
time of each.

    python experiments/programs.py

A program counts as traced where Python functions became a jaxpr and as compiled where XLA made an
executable of it. Times, memory and growth: `python experiments/bench`.
"""

import functools
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from bench.families import joint

import jaxmpc as jm

TRACED, COMPILED = "jaxpr_trace_duration", "backend_compile_duration"


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
        "Controller": lambda: controller().factor,
        "Controller, first call": lambda: controller()(x[0]),
        "its first call after another": lambda: controller()(x[0], controller()(x[1])),
        "ten more": lambda: [controller()(x[0], controller()(x[1])) for _ in range(10)],
        "solve_many, 100 states": lambda: jm.solve_many(mpc, np.tile(x, (50, 1))),
        "solve_many, 100 others": lambda: jm.solve_many(mpc, np.tile(x, (50, 1)) / 2),
    }
    for name, call in calls.items():
        counts.clear()
        begun = time.process_time()
        jax.block_until_ready(jax.tree.leaves(call()))
        seconds = time.process_time() - begun
        what = f"traced {counts[TRACED]:4}, compiled {counts[COMPILED]:3}, {seconds:5.2f} s"
        print(f"{what}: {name}", flush=True)


def joint_with(weight: float) -> jm.MPC:
    """The joint with Q times `weight`."""
    mpc = joint()
    return jm.MPC(
        mpc.system, weight * mpc.Q, mpc.R, mpc.horizon, states=mpc.states, inputs=mpc.inputs,
        terminal_cost=mpc.terminal_cost,
    )  # fmt: skip


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    print_programs()
