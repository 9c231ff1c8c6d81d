"""One gradient step of weight tuning: jaxmpc beside mpc.pytorch, cvxpylayers, finite differences.

The lesson's joint, N = 20, `loops` initial states × `samples` closed-loop samples. The loss is
the mean of x'Q₀x + u'R₀u with fixed weights; its gradient is taken with respect to θ, four numbers:
Q = LL', L lower triangular with exp(θ) on its diagonal, R = exp(2θ); the terminal cost is Q. Two
problems, of which the rivals solve those they can:

    box     torque limits only: mpc.pytorch knows no others
    full    limits on angle and speed at k = 1 … N too

"error" is that of the gradient, relative in the 2-norm, to central differences in float64 of
closed loops whose plans are solved to 1e-9. Times in s, of the wall and (cpu) of all processors,
medians, compile and warm-up apart; "ratio": by that of jaxmpc's reverse mode in the first
precision. jaxmpc's gradient is the one that `tune_weights` steps along. Rivals are left out where
they are not installed.

    python experiments/tuning/speed.py
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
import tyro
from rivals import RIVALS, Joint, with_torch

import jaxmpc as jm
from jaxmpc.batches import Compiled
from jaxmpc.systems.given_model import as_argument
from jaxmpc.tuning.losses import ClosedLoopLoss
from jaxmpc.tuning.objective import ClosedLoopObjective
from jaxmpc.tuning.parameters import Parameter, raw

JOINT = Joint()
# Of the reference: at 1e-5 it steps across a change of active rows in one loop of 256, and the
# difference there is no derivative any more.
STEP = 1e-6
START = {
    "Q": Parameter(np.array([[20.0, 1.0], [1.0, 2.0]]), "definite"),
    "R": Parameter(np.array([[0.3]]), "definite"),
}


@dataclass(frozen=True)
class Settings:
    """loops: initial states. samples: of each closed loop. iterations, newton_steps: of ADMM.
    precisions: bits jaxmpc computes in. problems, rivals: which to run. repeats, rival_repeats:
    of a time, of which the median counts."""

    loops: int = 256
    samples: int = 50
    horizon: int = 20
    iterations: int = 50
    newton_steps: int = 8
    precisions: tuple[int, ...] = (32, 64)
    problems: tuple[str, ...] = ("box", "full")
    rivals: tuple[str, ...] = ("mpc.pytorch", "cvxpylayers")
    repeats: int = 5
    rival_repeats: int = 1
    seed: int = 0


def problem(s: Settings, limits: str, solver: jm.ADMM) -> ClosedLoopObjective:
    """The closed loops as a function of θ, as `tune_weights` sees them."""
    j = JOINT
    system = jm.LinearSystem(j.A, j.B, dt=0.01)
    states = jm.Box(-j.x_max, j.x_max) if limits == "full" else None
    mpc = jm.MPC(
        system,
        j.Q,
        j.R,
        s.horizon,
        states=states,
        inputs=jm.Box([-j.u_max], [j.u_max]),
        constrained_stages=tuple(range(1, s.horizon + 1)) if states else None,
    )
    make = lambda v: replace(mpc, Q=v["Q"], R=v["R"], terminal_cost=v["Q"])
    loss = ClosedLoopLoss(j.Q, j.R, violation=0.0)
    return ClosedLoopObjective(
        lambda v: jm.Controller(make(v), solver),
        START,
        as_argument(system),
        s.samples,
        loss,
        None,
        None,
        None,
    )


def central(at: Callable, theta: dict, h: float) -> np.ndarray:
    """Gradient of at(θ) by central differences, entry by entry."""
    slope = []
    for name, entries in theta.items():
        for i in range(len(entries)):
            moved = lambda side, name=name, i=i: {
                **theta,
                name: theta[name] + side * h * (np.arange(len(theta[name])) == i),
            }
            slope.append((float(at(moved(1))[0]) - float(at(moved(-1))[0])) / (2 * h))
    return np.array(slope)


def timed(call: Callable, repeats: int) -> tuple[float, float, Any]:
    """Median wall and processor time of a call, and its result."""
    times, result = [], None
    for _ in range(repeats):
        begun, busy = time.perf_counter(), time.process_time()
        result = jax.block_until_ready(call())
        times.append((time.perf_counter() - begun, time.process_time() - busy))
    wall, cpu = np.median(times, axis=0)
    return wall, cpu, result


def report(s: Settings, limits: str, x0s: np.ndarray) -> None:
    """The table of one problem."""
    theta, ones = raw(START), np.ones(s.loops)
    with jax.enable_x64(True):
        exact = problem(s, limits, jm.ADMM(200, newton_steps=30, eps=1e-9))
        total = Compiled(jax.jit(exact.total))
        at = lambda theta: total(*exact.arguments(theta, x0s, {}, ones))
        unsolved, truth = float(at(theta)[1]["unsolved"].mean()), central(at, theta, STEP)
    print(f"\n{limits}: gradient {truth}, plans unsolved {unsolved:.2%}")
    print(
        f"{'':34}{'compile':>9}{'forward':>9}{'gradient':>10}{'ratio':>8}{'cpu':>9}{'ratio':>8}"
        f"{'error':>10}"
    )
    base: list[float] = []

    def line(name: str, compiling: float, forward: float, wall: float, cpu: float, slope: Any):
        base[:] = base or [wall, cpu]
        error = np.linalg.norm(slope - truth) / np.linalg.norm(truth)
        print(
            f"{name:34}{compiling:9.1f}{forward:9.3f}{wall:10.3f}{wall / base[0]:8.2f}{cpu:9.3f}"
            f"{cpu / base[1]:8.2f}{error:10.1e}",
            flush=True,
        )

    for bits in s.precisions:
        with jax.enable_x64(bits == 64):
            ours = problem(s, limits, jm.ADMM(s.iterations, newton_steps=s.newton_steps))
            begun = time.perf_counter()
            total = Compiled(jax.jit(ours.total))
            at = lambda theta, ours=ours, total=total: total(*ours.arguments(theta, x0s, {}, ones))
            at(theta)
            first = time.perf_counter() - begun
            forward, *_ = timed(lambda at=at: at(theta), s.repeats)
            for mode in ("reverse", "forward"):
                begun = time.perf_counter()
                name, slope = ours.gradient(theta, (x0s, {}), mode)
                call = lambda slope=slope: slope(theta, x0s, {}, ones)
                call()
                compiling = time.perf_counter() - begun
                wall, cpu, (_, found, aux) = timed(call, s.repeats)
                flat = np.concatenate([np.asarray(found[name]) for name in theta])
                line(f"jaxmpc, {name}, float{bits}", compiling, forward, wall, cpu, flat)
            h = 1e-5 if bits == 64 else 1e-2
            wall, cpu, slope = timed(lambda at=at, h=h: central(at, theta, h), s.repeats)
            line(f"differences, float{bits}, h = {h:g}", first, forward, wall, cpu, slope)
            print(f"{'':4}plans unsolved {aux['unsolved'].mean():.2%}")
    for name in s.rivals:
        try:
            law = RIVALS[name](JOINT, s.horizon, s.loops, limits == "full")
        except (ImportError, NotImplementedError) as error:
            print(f"{name}: left out ({error})")
            continue
        begun = time.perf_counter()
        with_torch(JOINT, law, theta, x0s, 1)
        compiling = time.perf_counter() - begun
        call = lambda law=law: with_torch(JOINT, law, theta, x0s, s.samples)
        wall, cpu, (forward, slope) = timed(call, s.rival_repeats)
        line(f"{name}, float64", compiling, forward, wall, cpu, slope)


def run(s: Settings) -> None:
    """Initial states whose plans have solutions all the way, then the tables."""
    draws = np.random.default_rng(s.seed).uniform(-JOINT.x_max, JOINT.x_max, (4 * s.loops, 2))
    with jax.enable_x64(True):
        full = problem(s, "full", jm.ADMM())
        total = Compiled(jax.jit(full.total))
        seen = total(*full.arguments(raw(START), draws, {}, np.ones(len(draws))))[1]
    x0s = draws[np.asarray(seen["unsolved"]) == 0][: s.loops]
    print(f"{s}\n{len(x0s)} loops × {s.samples} samples, N = {s.horizon}; times in s")
    for limits in s.problems:
        report(s, limits, x0s)


if __name__ == "__main__":
    run(tyro.cli(Settings, description=__doc__))
