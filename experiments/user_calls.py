"""What the calls that people make take, from NumPy arrays to NumPy arrays.

    python experiments/user_calls.py [--states 1048576]   # labels and plans of the joint
    python experiments/user_calls.py --first              # the first calls of a process

Several devices: `many_devices.py`. The least of several calls, after one that compiles. "Kept": of
a `FeasibilityProblem` or a `Controller` that was made before; "fresh": of the `MPC` itself. --first
gives CPU seconds, of all threads, which other work on the machine changes less than the time of
day.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from bench.families import family, joint
from bench.roofline import best_seconds

import jaxmpc as jm


def report(name: str, call: Callable[[], Any], states: int) -> float:
    """Print the least time of a call, and return it."""
    seconds = best_seconds(call, 4)
    print(f"{name}: {1e3 * seconds:.1f} ms, {1e9 * seconds / states:.1f} ns a state", flush=True)
    return seconds


def uniform(states: int) -> np.ndarray:
    """Return states of the joint, some of which are infeasible."""
    return np.random.default_rng(0).uniform([-1.6, -2.1], [1.6, 2.1], (states, 2))


def print_calls(states: int) -> None:
    """Print the times of labels and of plans."""
    mpc, x = joint(), uniform(states)
    problem = jm.map_feasible_set(mpc, x).problem
    report("labels, kept", lambda: jm.map_feasible_set(problem, x).label, states)
    report("labels, fresh", lambda: jm.map_feasible_set(mpc, x).label, states)
    feasible = np.asarray(family("joint", states)[1])
    with jax.enable_x64(True):
        controller = jm.Controller(mpc)
    report("plans, kept", lambda: jm.solve_many(controller, feasible), states)
    report("plans, fresh", lambda: jm.solve_many(mpc, feasible), states)
    left = lambda: jax.block_until_ready(jm.solve_many(controller, feasible, to_host=False))
    report("plans, left on the device", left, states)


def print_first_calls() -> None:
    """Print the CPU seconds of the first `solve`, and of the first value and gradient of a loss."""
    mpc = joint()
    begun = time.process_time()
    jm.solve(mpc, [0.5, 0.1])
    print(f"first solve: {time.process_time() - begun:.2f} s of CPU", flush=True)
    n, random = 3, np.random.default_rng(0)
    A, B = np.eye(n) + 0.1 * random.standard_normal((n, n)), random.standard_normal((n, n))
    x0s, shown = random.standard_normal((2, 32, n))

    def loss(A: jax.Array, B: jax.Array) -> jax.Array:
        """Return the distance of first inputs from those shown."""
        own = jm.MPC(jm.LinearSystem(A, B), np.eye(n), np.eye(n), 5,
                     inputs=jm.Box(-np.ones(n), np.ones(n)), terminal_cost=np.eye(n))  # fmt: skip
        first = jax.vmap(lambda x: jm.solve(own, x).inputs[0])(x0s)
        return jnp.mean((first - shown) ** 2)

    begun = time.process_time()
    jax.block_until_ready(jax.jit(jax.value_and_grad(loss, (0, 1)))(A, B))
    print(f"value and gradient: {time.process_time() - begun:.2f} s of CPU", flush=True)


def main() -> None:
    """Print what is asked for."""
    summary, _, text = (__doc__ or "").partition("\n")
    parser = argparse.ArgumentParser(
        description=summary, epilog=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--states", type=int, default=2**20)
    parser.add_argument("--first", action="store_true", help="time first calls")
    given = parser.parse_args()
    print(jax.__version__, jax.local_devices(), flush=True)
    if given.first:
        print_first_calls()
    else:
        print_calls(given.states)


if __name__ == "__main__":
    main()
