"""Stage by stage or condensed: times of MPC of robots that all have other matrices.

    python experiments/stagewise.py

Random arms with masses, stiffness and drift of their own, box limits on angles, speeds and
torques: n = 2 joints, m = joints. "factor" is what a new linearization costs (condensed: condense
and factor), "steps" the ADMM steps and the judgement of the plan, "newton" what the Newton steps
add (stage by stage only). Median over repeats, the functions taking turns; compilation apart.
"difference": the greatest between the inputs of both after these steps.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import jaxmpc as jm
from jaxmpc.mpc.stagewise.solve import factor_stages, plan_stages


@dataclass(frozen=True)
class Settings:
    """robots: of a batch. period: of control, s. iterations: ADMM steps. newton_steps: those
    of the last column. precisions: bits of floating-point numbers."""

    robots: int = 64
    joints: int = 7
    horizon: int = 20
    period: float = 0.05
    iterations: int = 50
    newton_steps: int = 3
    repeats: int = 5
    precisions: tuple[int, ...] = (32, 64)
    seed: int = 0


def arm(rng: np.random.Generator, s: Settings) -> jm.LinearSystem:
    """M q'' + q'/2 + G q = u + drift with random M ⪰ I and G, in rad, rad/s, N m."""
    k, W, G = s.joints, *rng.normal(size=(2, s.joints, s.joints))
    inverse = np.linalg.inv(np.eye(k) + W @ W.T / k)
    A = np.block([[np.zeros((k, k)), np.eye(k)], [-inverse @ (G + G.T) / 2, -0.5 * inverse]])
    drift = np.concatenate([np.zeros(k), 0.3 * rng.normal(size=k)])
    B = np.vstack([np.zeros((k, k)), inverse])
    return jm.LinearSystem.from_continuous(A, B, s.period, drift)


def problem(s: Settings) -> jm.MPC:
    """Limits and weights that all arms share."""
    k, dt = s.joints, s.period
    A = np.block([[np.eye(k), dt * np.eye(k)], [np.zeros((k, k)), np.eye(k)]])
    system = jm.LinearSystem(A, np.vstack([np.zeros((k, k)), dt * np.eye(k)]), np.zeros(2 * k))
    Q, R = np.diag([10.0] * k + [1.0] * k), 0.1 * np.eye(k)
    limit = np.array([1.0] * k + [0.8] * k)
    box = jm.Box(-limit, limit)
    return jm.MPC(
        system, Q, R, s.horizon, states=box, inputs=jm.Box(-3 * np.ones(k), 3 * np.ones(k)),
        terminal_cost=jm.lqr(system, Q, R).P, terminal_set=box, prestabilise=False,
    )  # fmt: skip


def run(s: Settings) -> None:
    """Compile, time in turns, print."""
    rng, mpc = np.random.default_rng(s.seed), problem(s)
    arms = [arm(rng, s) for _ in range(s.robots)]
    limit = np.array([0.8] * s.joints + [0.4] * s.joints)
    x0s = rng.uniform(-limit, limit, (s.robots, 2 * s.joints))
    print(f"{s.robots} arms, {s.joints} joints, N = {s.horizon}, {s.iterations} steps; s")
    print(f"{'':24}{'factor':>9}{'steps':>9}{'newton':>9}{'compiling':>11}{'difference':>12}")
    for bits in s.precisions:
        with jax.enable_x64(bits == 64):
            report(s, mpc, arms, x0s, bits)


def report(s: Settings, mpc: jm.MPC, arms: list, x0s: np.ndarray, bits: int) -> None:
    """Two lines of the table."""
    solver = jm.ADMM(iterations=s.iterations, newton_steps=0)
    polished = replace(solver, newton_steps=s.newton_steps)
    dtype = jnp.float32 if bits == 32 else jnp.float64
    of = lambda name: jnp.asarray([getattr(a, name) for a in arms], dtype)
    systems, x = jm.LinearSystem(of("A"), of("B"), of("c")), jnp.asarray(x0s, dtype)
    condensed = lambda system: jm.Controller(replace(mpc, system=system), solver)
    programs: dict[str, tuple[Callable, Callable]] = {
        "factor": (
            lambda system: factor_stages(replace(mpc, system=system), solver), lambda: (systems,)
        ),
        "steps": (
            lambda f, x: plan_stages(f, mpc, x, solver=solver), lambda: (found["factor"], x)
        ),
        "newton": (
            lambda f, x: plan_stages(f, mpc, x, solver=polished),
            lambda: (found["factor"], x),
        ),
        "condensed factor": (condensed, lambda: (systems,)),
        "condensed steps": (
            lambda c, x: c.plan(x), lambda: (found["condensed factor"], x)
        ),
    }  # fmt: skip
    found: dict = {}
    compiled, compiling = {}, {}
    for name, (function, given) in programs.items():
        before = time.perf_counter()
        compiled[name] = jax.jit(jax.vmap(function)).lower(*given()).compile()
        compiling[name] = time.perf_counter() - before
        found[name] = compiled[name](*given())
    times: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(s.repeats):
        for name, (_, given) in programs.items():
            before = time.perf_counter()
            jax.block_until_ready(compiled[name](*given()))
            times[name].append(time.perf_counter() - before)
    t = {name: float(np.median(v)) for name, v in times.items()}
    apart = jnp.max(jnp.abs(found["steps"].inputs - found["condensed steps"].inputs))
    print(
        f"{f'float{bits} stage by stage':24}{t['factor']:9.4f}{t['steps']:9.4f}"
        f"{t['newton'] - t['steps']:9.4f}"
        f"{sum(compiling[name] for name in ('factor', 'newton')):11.1f}"
    )
    ours, theirs = (
        t["factor"] + t["steps"],
        sum(t[f"condensed {name}"] for name in ("factor", "steps")),
    )
    print(
        f"{f'float{bits} condensed':24}{t['condensed factor']:9.4f}"
        f"{t['condensed steps']:9.4f}{'':9}"
        f"{sum(v for name, v in compiling.items() if 'cond' in name):11.1f}{apart:12.1e}"
    )
    solved = int(jnp.sum(found["newton"].status == jm.Status.SOLVED))
    print(
        f"{'':8}{theirs / ours:.1f} times as fast (factor and steps); "
        f"{solved} SOLVED with {s.newton_steps} Newton steps"
    )


if __name__ == "__main__":
    run(tyro.cli(Settings, description=__doc__))
