"""What the kernels bring on a GPU: ADMM's speed, plans of very many states, of long horizons,
TurboMPC's protocol.

    python experiments/kernels.py [--small]

All on the device, float64 but for ADMM's iterates, after compiling; the least of four runs. All
programs compile at once. --small: 64 states each, to try the script.
"""

import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from bench.cases import SAMPLES, weighted_loops, weights_of
from bench.families import family
from bench.roofline import best_seconds

import jaxmpc as jm
from jaxmpc.qp.admm import ScaledProgram
from jaxmpc.qp.admm_kernel import iterate_batch
from jaxmpc.qp.jax_transformations import on_gpu
from jaxmpc.qp.kernel import ROUGH

PLANS = [("joint", 2**20), ("springs4", 2**20), ("springs8", 2**16)]
HORIZONS = (1_000, 8_000)
LOOPS, TOLERANCES, STEPS = (64, 1024, 65_536), (1e-3, 1e-5, 1e-7), 50
REPEATS = 4


@dataclass
class Task:
    """A program to time: its arguments, solves in a call, what to say of the result and seconds."""

    name: str
    program: Callable
    arguments: tuple
    count: int
    say: Callable[[Any, float], str]


def single(tree: Any) -> Any:
    """The tree in float32."""
    cast = lambda v: v.astype(jnp.float32) if jnp.issubdtype(v.dtype, jnp.floating) else v
    return jax.tree.map(cast, tree)


def admm_task(name: str, count: int) -> Task:
    """ADMM's steps for a batch, from zero, in one kernel."""
    mpc, x = family(name, count)
    c = jm.Controller(mpc)

    def scaled(x: Any) -> tuple:
        program = ScaledProgram.of(c.condensed.qp(x), c.factor)
        return program.q, program.bounds

    q, bounds = single(jax.jit(jax.vmap(scaled))(x))
    made, m = single(c.factor), bounds.l.shape[1]
    alpha = jnp.float32(1.9)
    run = jax.jit(lambda q, b, t: iterate_batch(made, alpha, q, b, t, STEPS, ROUGH)[0])
    flops = 2 * m * m * STEPS
    say = lambda _, seconds: f"{flops * count / seconds / 1e12:.1f} TFLOP/s (2 m² a step)"
    return Task(f"admm {name} {count}", run, (q, bounds, jnp.zeros_like(bounds.l)), count, say)


def plan_task(name: str, count: int) -> Task:
    """Plans of feasible states."""
    mpc, x = family(name, count)
    say = lambda plans, _: f"{np.mean(plans.status == jm.Status.SOLVED):.4%} solved"
    plans = jax.jit(jax.vmap(jm.Controller(mpc).plan))
    return Task(f"plans {name} {count}", plans, (jnp.asarray(x),), count, say)


def long_task(horizon: int, count: int) -> Task:
    """Plans stage by stage of a random system of 8 states and 4 inputs with limits on all."""
    rng = np.random.default_rng(0)
    A, B = rng.standard_normal((8, 8)), rng.standard_normal((8, 4))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    states, inputs = (
        jm.Box(-limit * np.ones(n), limit * np.ones(n)) for n, limit in ((8, 3), (4, 0.5))
    )
    mpc = jm.MPC(
        jm.LinearSystem(A, B), np.eye(8), 0.1 * np.eye(4), horizon, states=states, inputs=inputs,
        terminal_cost=np.eye(8),
    )  # fmt: skip
    x = jnp.asarray(rng.uniform(-1, 1, (count, 8)))

    def say(plans: Any, _: float) -> str:
        limits = jnp.max(jnp.abs(plans.inputs))
        return f"{np.mean(plans.status == jm.Status.SOLVED):.4%} solved, inputs up to {limits:.9f}"

    plans = jax.jit(jax.vmap(lambda x: jm.mpc.solve_stagewise(mpc, x)))
    return Task(f"plans of {horizon} stages {count}", plans, (x,), count, say)


def loop_tasks(count: int, gradient: bool) -> list[Task]:
    """TurboMPC's protocol: closed loops of 50 samples from `count` states; with the gradient of
    their cost with respect to the diagonals of Q and R."""
    mpc, x = family("turbompc", count)

    def loops(weights: dict[str, Any], x: Any, eps: Any) -> tuple:
        cost, run = weighted_loops("turbompc", mpc, weights, x, eps)
        return cost, jnp.mean(run.status == jm.Status.SOLVED)

    program = jax.jit(jax.value_and_grad(loops, has_aux=True) if gradient else loops)
    weights, what = weights_of(mpc), "loops, gradient," if gradient else "loops"

    def say(answer: Any, _: float) -> str:
        cost, solved = answer[0] if gradient else answer
        return f"{float(solved):.4%} solved, cost {float(cost):.9g}"

    return [
        Task(f"{what} {count} to {eps:g}", program, (weights, jnp.asarray(x), jnp.asarray(eps)),
             count * SAMPLES, say)
        for eps in TOLERANCES
    ]  # fmt: skip


def run_all(small: bool) -> None:
    """Print a line for each task."""
    size = lambda count: min(count, 64) if small else count
    tasks = [admm_task(name, size(count // 4)) for name, count in PLANS] if on_gpu() else []
    tasks += [plan_task(name, size(count)) for name, count in PLANS]
    tasks += [long_task(40 if small else horizon, 64) for horizon in HORIZONS]
    tasks += [t for grad in (False, True) for count in LOOPS for t in loop_tasks(size(count), grad)]
    compiled: dict[Any, Any] = {}
    with ThreadPoolExecutor() as pool:
        for task in tasks:
            if task.program not in compiled:
                start = lambda task=task: task.program.lower(*task.arguments).compile()
                compiled[task.program] = pool.submit(start)
    # (Not before all are compiled: the compiler tries kernels on the device.)
    for task in tasks:
        try:
            print(timed(task, compiled[task.program].result()), flush=True)
        except jax.errors.JaxRuntimeError as error:  # too large for the device's memory
            print(f"{task.name}: {str(error).splitlines()[0][:90]}", flush=True)


def timed(task: Task, program: Callable) -> str:
    """Return a line about the program's least time."""
    best = best_seconds(lambda: program(*task.arguments), REPEATS)
    what = task.say(program(*task.arguments), best)
    return f"{task.name}: {1e3 * best:.2f} ms, {1e6 * best / task.count:.4f} µs each, {what}"


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    print(jax.__version__, jax.devices())
    run_all("--small" in sys.argv[1:])
