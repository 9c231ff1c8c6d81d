"""Does any batched program wait for ever, on a CPU that others keep busy?

    python experiments/stress.py                        # all of it, hours
    python experiments/stress.py --calls 5 --batches 1000 --programs plan "solve_qp"

Each program runs in a process of its own, `calls` times in a row, while `busy` processes spin
beside it. A process that finishes no call for `patience` seconds counts as hung and is killed. The
table, written to `output` as it grows, has a row for each program and batch: calls made, seconds
of the slowest call, and whether it hung. jaxlib 0.10.0 to 0.11.0, the newest for Python 3.11, hangs
where two batched LAPACK calls run at once (`jaxmpc/qp/linalg.py`).
"""

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import jaxmpc as jm

SHORT = jm.ADMM(iterations=5, newton_steps=2)


@dataclass(frozen=True)
class Settings:
    """programs: names from the table below, all by default. batches: instances in a call.
    calls: of each program and batch, after the one that compiles. busy: processes that spin
    beside. patience: seconds without a finished call that count as hung; compiling gets ten
    times as much. only: internal, runs one program in this process."""

    programs: tuple[str, ...] = ()
    batches: tuple[int, ...] = (64, 1000, 16_384)
    calls: int = 60
    busy: int = 2
    patience: float = 60.0
    output: Path = Path("stress.json")
    only: str = ""


def joint(horizon: int = 20) -> jm.MPC:
    """The robot joint with the terminal cost of its LQR, 20 variables and 60 rows."""
    system = jm.LinearSystem(np.array([[1, 0.01], [0, 1]]), np.array([[0], [0.2]]), dt=0.01)
    Q, R = np.diag([50.0, 1.0]), np.array([[0.1]])
    limits = jm.Box(np.array([-1.5, -2.0]), np.array([1.5, 2.0]))
    torque = jm.Box(np.array([-2.0]), np.array([2.0]))
    return jm.MPC(
        system, Q, R, horizon=horizon, states=limits, inputs=torque,
        terminal_cost=jm.lqr(system, Q, R).P, terminal_set=limits,
    )  # fmt: skip


def random_qps(batch: int) -> jm.QP:
    """Programs of 20 variables and 45 rows with matrices of their own."""
    n, m = 20, 45
    rng = np.random.default_rng(0)
    M, A = rng.normal(size=(batch, n, n)), rng.normal(size=(batch, m, n))
    P, q = M @ M.swapaxes(1, 2) + np.eye(n), rng.normal(size=(batch, n))
    one = np.ones((batch, m))
    return jax.tree.map(lambda v: jnp.asarray(v, jnp.float32), jm.QP(P, q, A, -one, one))


def states(batch: int) -> Any:
    """Initial states of the joint."""
    draws = np.random.default_rng(1).uniform([-1.5, -2], [1.5, 2], (batch, 2))
    return jnp.asarray(draws, jnp.float32)


def compiled(function: Callable, *data: Any) -> partial:
    """The call of the vmapped, jitted function on the data."""
    return partial(jax.jit(jax.vmap(function)), *data)


def arm_models(batch: int) -> Callable[[], Any]:
    robot = jm.load_robot("arm2")
    x = jnp.asarray(np.random.default_rng(2).uniform(-1, 1, (batch, 4)), jnp.float32)
    return compiled(lambda x: robot.linearize(x, jnp.zeros(2)), x)


def arm_controller(batch: int) -> Callable[[], Any]:
    robot = jm.load_robot("arm2")
    control = jm.RobotController(robot, jm.robot_mpc(robot, horizon=5), SHORT)
    x = jnp.asarray(np.random.default_rng(2).uniform(-0.5, 0.5, (batch, 4)), jnp.float32)
    return compiled(lambda x: control(x)[0], x)


def stagewise(x: Any, scale: Any) -> Any:
    mpc = joint()
    system = replace(mpc.system, B=mpc.system.B * scale)
    return jm.mpc.solve_stagewise(replace(mpc, system=system), x, solver=SHORT).inputs


def lqr_gain(scale: Any) -> Any:
    rng = np.random.default_rng(3)
    system = jm.LinearSystem(rng.normal(size=(14, 14)) / 4 * scale, rng.normal(size=(14, 3)))
    return jm.lqr(system, np.eye(14), np.eye(3)).K


def simulated(x: Any, scale: Any) -> Any:
    mpc = joint()
    control = jm.Controller(replace(mpc, R=mpc.R * scale), SHORT)
    return jm.simulate(control, mpc.system, x, 3).inputs


def scales(batch: int) -> Any:
    return jnp.linspace(0.9, 1.1, batch)


def gradient(function: Callable) -> Callable:
    """The gradient of the sum of the function's result with respect to its last argument."""

    def found(*args: Any) -> Any:
        return jax.grad(lambda last: jnp.sum(function(*args[:-1], last)))(args[-1])

    return found


def programs() -> dict[str, Callable[[int], Callable[[], Any]]]:
    """What is run: from the batch to a call. Nothing compiles before that."""
    shared = cache(lambda: jm.Controller(joint(), SHORT))

    def plan() -> Callable:
        controller = shared()
        return lambda x: controller.plan(x).inputs

    solve = lambda x, scale: jm.solve(
        replace(joint(), R=joint().R * scale), x, solver=SHORT
    ).inputs  # fmt: skip
    qp = lambda qp: jm.solve_qp(qp, SHORT).z
    scan = lambda plan: (
        lambda x: jax.lax.scan(lambda x, _: (x + 0.01 * plan(x)[0], None), x, length=2)[0]
    )
    both = lambda scale, x: stagewise(x, scale)
    return {
        "plan, defaults": lambda b: compiled(
            lambda x: jm.Controller(joint()).plan(x).inputs, states(b)
        ),
        "plan": lambda b: compiled(plan(), states(b)),
        "plan, nested vmap": lambda b: compiled(jax.vmap(plan()), states(b).reshape(-1, 2, 2)),
        "plan in a scan": lambda b: compiled(scan(plan()), states(b)),
        "plan, gradient": lambda b: compiled(gradient(plan()), states(b)),
        "solve, own weights": lambda b: compiled(solve, states(b), scales(b)),
        "solve, own weights, gradient": lambda b: compiled(gradient(solve), states(b), scales(b)),
        "solve_qp, own matrices": lambda b: compiled(qp, random_qps(b)),
        "solve_qp, own matrices, gradient": lambda b: compiled(gradient(qp), random_qps(b)),
        "simulate": lambda b: compiled(simulated, states(b), scales(b)),
        "simulate, gradient": lambda b: compiled(gradient(simulated), states(b), scales(b)),
        "solve_many": lambda b: lambda: jm.solve_many(joint(), np.asarray(states(b)), SHORT).inputs,
        "simulate_many": lambda b: (
            lambda: jm.simulate_many(shared(), joint().system, np.asarray(states(b)), 3).inputs
        ),  # fmt: skip
        "map_feasible_set": lambda b: (
            lambda: jm.map_feasible_set(joint(), np.asarray(states(b))).label
        ),
        "lqr": lambda b: compiled(lqr_gain, scales(b)),
        "lqr, gradient": lambda b: compiled(gradient(lqr_gain), scales(b)),
        "linear models of arm2": arm_models,
        "RobotController of arm2": arm_controller,
        "solve_stagewise, own systems": lambda b: compiled(both, scales(b), states(b)),
        "solve_stagewise, gradient": lambda b: compiled(gradient(stagewise), states(b), scales(b)),
    }


def repeat(name: str, batch: int, calls: int) -> None:
    """Run one program in this process; a line after each call."""
    call = programs()[name](batch)
    for _ in range(calls + 1):
        start = time.perf_counter()
        jax.block_until_ready(call())
        print(f"{time.perf_counter() - start:.3f}", flush=True)


def watched(s: Settings, name: str, batch: int) -> dict[str, Any]:
    """Run one program in a process that is killed where it stands still."""
    command = [
        sys.executable, __file__, "--only", name, "--batches", str(batch), "--calls", str(s.calls)
    ]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    seconds: list[float] = []
    assert process.stdout is not None and process.stderr is not None
    reader = threading.Thread(target=lambda: seconds.extend(map(float, process.stdout)))
    reader.start()
    made, last, hung = 0, time.monotonic(), False
    while process.poll() is None:
        time.sleep(0.1)
        if len(seconds) > made:
            made, last = len(seconds), time.monotonic()
        if time.monotonic() - last > s.patience * (1 if made else 10):
            hung = True
            process.kill()
            break
    reader.join()
    error = process.stderr.read().strip().splitlines()
    process.wait()
    process.stdout.close()
    process.stderr.close()
    if process.returncode and not hung:
        raise RuntimeError(f"{name}: " + "\n".join(error[-5:]))
    calls = seconds[1:]
    return {
        "program": name, "batch": batch, "calls": len(calls), "hung": hung,
        "median_seconds": float(np.median(calls)) if calls else None,
        "slowest_seconds": max(calls, default=None),
    }  # fmt: skip


def run(s: Settings) -> list[dict[str, Any]]:
    """Run the table beside processes that spin."""
    names = s.programs or tuple(programs())
    if s.only:
        repeat(s.only, s.batches[0], s.calls)
        return []
    spin = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(s.busy)]
    rows = []
    version = ".".join(map(str, sys.version_info[:2]))
    print(f"Python {version}, JAX {jax.__version__}, {os.cpu_count()} cores, {s.busy} busy loops")
    print(f"{'program':34}{'batch':>8}{'calls':>7}{'median s':>10}{'slowest s':>11}  hung")
    try:
        for name in names:
            for batch in s.batches:
                row = watched(s, name, batch)
                rows.append(row)
                number = lambda v: "-" if v is None else f"{v:.3f}"
                print(
                    f"{name:34}{batch:8d}{row['calls']:7d}{number(row['median_seconds']):>10}"
                    f"{number(row['slowest_seconds']):>11}  {'YES' if row['hung'] else 'no'}",
                    flush=True,
                )  # fmt: skip
                s.output.write_text(json.dumps({"python": version, "rows": rows}, indent=2))
    finally:
        for process in spin:
            process.kill()
            process.wait()
    return rows


if __name__ == "__main__":
    run(tyro.cli(Settings, description=__doc__))
