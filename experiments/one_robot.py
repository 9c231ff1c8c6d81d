"""One robot at a time: microseconds a sample of a closed loop, each sample warm-started by the one
before, beside the solvers that embedded control uses.

    python experiments/one_robot.py

jaxmpc: `control = controller(x, control)` from plain Python with 64-bit mode on, all that it
does: checks, warm start, plan, status. The others solve the same condensed QPs, of the states that
this loop went through, in the same order; forming q, l and u from the state is not counted. OSQP
starts from its last solution, DAQP and PIQP start cold. Residuals of all are computed here.
"""

import time
from dataclasses import dataclass

import jax
import numpy as np
import tyro
from bench.cases import condensed, moving_rows, pair_of
from bench.families import family
from bench.rivals import RIVALS, Batch, residuals
from bench.roofline import best_seconds

import jaxmpc as jm


@dataclass(frozen=True)
class Settings:
    """loops: closed loops from random feasible states. samples: of each. rounds: the
    best of them counts."""

    families: tuple[str, ...] = ("joint", "springs4", "springs8", "turbompc")
    loops: int = 10
    samples: int = 50
    seed: int = 0
    rounds: int = 3


def drive(controller: jm.Controller, x0s: np.ndarray, samples: int) -> tuple:
    """States (loops·samples, n) and their plans, and the seconds of each call."""
    system = controller.mpc.system
    A, B = np.asarray(system.A), np.asarray(system.B)
    states, plans, seconds = [], [], []
    for x in x0s:
        control = None
        for _ in range(samples):
            begun = time.perf_counter()
            control = controller(x, control)
            u = np.asarray(control.u)
            seconds.append(time.perf_counter() - begun)
            states.append(x)
            plans.append(control.plan)
            x = A @ x + B @ u
    return np.array(states), plans, np.array(seconds)


def measure(name: str, s: Settings) -> None:
    """Print the lines of one family."""
    mpc, x0s = family(name, s.loops, s.seed)
    controller = jm.Controller(mpc)
    drive(controller, x0s, 3)  # compiles
    runs = [drive(controller, x0s, s.samples) for _ in range(s.rounds)]
    warm = np.arange(s.loops * s.samples) % s.samples > 0
    x, plans, _ = runs[0]
    plan = jax.tree.map(lambda *v: np.stack(v), *plans)
    c = condensed(mpc)
    worst = residuals(Batch.of(c, x), *pair_of(c, plan)).max(axis=0)
    ours = min((run[2][warm] for run in runs), key=np.mean) * 1e6
    print(f"{name:10} jaxmpc {ours.mean():8.0f} µs, median {np.median(ours):6.0f}, "
          f"solved {np.mean(worst <= 1e-6):.2%}", flush=True)  # fmt: skip
    qps = Batch.of(moving_rows(c), x)
    for rival in ("osqp", "daqp", "piqp"):
        if RIVALS[rival].installed:
            call = RIVALS[rival].make(qps, 1e-6)
            z, y, _ = call()
            met = np.mean(residuals(qps, z, y).max(axis=0) <= 1e-6)
            spent = best_seconds(call, s.rounds) / len(x) * 1e6
            print(f"{'':10} {rival:6} {spent:8.0f} µs, solved {met:.2%}", flush=True)


def main(s: Settings) -> None:
    """Print all families."""
    jax.config.update("jax_enable_x64", True)
    for name in s.families:
        measure(name, s)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
