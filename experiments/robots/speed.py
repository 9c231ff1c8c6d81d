"""Thousands of 7-joint arms under MPC by successive linearisation: what takes the time?

    python experiments/robots/speed.py                     # 64 arms, for a CPU
    python experiments/robots/speed.py --count 4096        # for a GPU

Several devices: `experiments/many_devices.py`. Each piece of a control step is timed apart, as a
loop of its own inside one program: physics (the
control period of the plant with its joint limits), the linear models, the data of the plans (with
ADMM steps their Riccati factorisation), the judgement of a plan, ADMM steps if any, the Newton and
interior point steps from a cold start; then the closed loop whole, whose plans start from those of
the sample before. The bare loop is mjx.step on the same model without jaxmpc. Set
OPENBLAS_NUM_THREADS=1 on CPUs: the threads of OpenBLAS make the small triangular solves of MJX 70
times slower on busy cores.
"""

import dataclasses
import time
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import jaxmpc as jm
from jaxmpc.mpc.stagewise.solve import factor_stages, plan_stages


@dataclass(frozen=True)
class Settings:
    robot: str = "arm7"
    count: int = 64
    seconds: float = 1.0
    horizon: int = 20
    iterations: int = 0  # ADMM steps
    newton_steps: int | None = None  # Newton steps at most; None: as many as are needed
    repeats: int = 3
    pieces: bool = True
    loop: bool = True  # also the closed loop, whose compilation takes longest


def timed(function: Any, *args: Any, repeats: int) -> tuple[float, float]:
    """Seconds to compile, and the least to run."""
    start = time.perf_counter()
    program = jax.jit(function).lower(*args).compile()
    compiled = time.perf_counter() - start
    runs = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        jax.block_until_ready(program(*args))
        runs.append(time.perf_counter() - start)
    return compiled, min(runs[1:])


def repeated(body: Any, length: int) -> Any:
    """`length` times body(carry, *rest) -> carry under one scan."""
    return lambda x, *rest: jax.lax.scan(lambda x, _: (body(x, *rest), None), x, length=length)[0]


def run(settings: Settings) -> dict[str, Any]:
    from mujoco import mjx

    s, robot = settings, jm.load_robot(settings.robot)
    steps = round(s.seconds / robot.dt)
    nv, x_ref, u_ref = robot.mujoco.nv, *robot.equilibrium()
    Q, R = np.r_[np.full(nv, 10.0), np.full(nv, 0.1)], np.full(robot.m, 1e-3)
    mpc = jm.robot_mpc(robot, Q, R, s.horizon)
    solver = jm.ADMM(iterations=s.iterations, newton_steps=s.newton_steps)
    controller = jm.RobotController(robot, mpc, solver, linearize="state")
    soft = controller.soft
    rng = np.random.default_rng(0)
    d = np.hstack([0.4 * rng.normal(size=(s.count, nv)), 0.3 * rng.normal(size=(s.count, nv))])
    starts = np.asarray(robot.coordinates(x_ref)) + d
    lower, upper = np.asarray(mpc.states.lower), np.asarray(mpc.states.upper)
    room = 0.05 * np.nan_to_num(upper - lower, posinf=0.0)
    starts = np.clip(starts, lower + room, upper - room)
    x0s = jax.vmap(robot.state)(jnp.asarray(starts, jnp.float32))
    us = jnp.tile(jnp.asarray(u_ref, x0s.dtype), (s.count, 1))
    reference = jnp.asarray(robot.coordinates(jnp.asarray(x_ref)), x0s.dtype)
    inputs = jnp.asarray(u_ref, x0s.dtype)
    model, blank, nq = mjx.put_model(robot.mujoco), mjx.make_data(robot.mujoco), robot.mujoco.nq

    def bare(x: Any, u: Any) -> Any:
        data = mjx.step(model, blank.replace(qpos=x[:nq], qvel=x[nq:], ctrl=u))
        return jnp.concatenate([data.qpos, data.qvel])

    substeps = lambda x, u: repeated(bare, robot.substeps)(x, u)
    linear = jax.vmap(robot.linearize)
    models = jax.jit(linear)(x0s, us)
    own = lambda model: replace(soft, system=model)
    factor = jax.jit(jax.vmap(lambda s: factor_stages(own(s), solver, controller.scale)))
    factors = factor(models)

    def planned(iterations: int, newton_steps: int | None) -> Any:
        chosen = replace(solver, iterations=iterations, newton_steps=newton_steps)
        plan = jax.vmap(
            lambda f, x: plan_stages(f, soft, x, reference, chosen, input_reference=inputs)
        )
        # The next state depends on the plan, so that nothing is computed once for all turns.
        return lambda x, f: x + 1e-9 * plan(f, x).inputs[:, 0].sum(axis=1, keepdims=True)

    touched = lambda x, tree: x + 1e-9 * sum(jnp.sum(v) for v in jax.tree.leaves(tree))
    few = min(steps, 20)
    pieces = {
        "mjx.step alone": (repeated(jax.vmap(substeps), few), x0s, us),
        "physics": (repeated(jax.vmap(robot.step), few), x0s, us),
        "linear models": (
            repeated(lambda x, u: touched(x, dataclasses.astuple(linear(x, u))[:3]), few), x0s, us
        ),
        "factorisation": (
            repeated(lambda x, m: touched(x, jax.tree.map(
                lambda v: v if jnp.issubdtype(v.dtype, jnp.floating) else jnp.zeros(()),
                factor(replace(m, c=m.c + 1e-9 * x))
            )), few), x0s, models,
        ),
        "plan, judged": (repeated(planned(0, 0), few), x0s, factors),
        "plan, ADMM": (repeated(planned(s.iterations, 0), few), x0s, factors),
        "plan, cold": (repeated(planned(s.iterations, s.newton_steps), few), x0s, factors),
    }  # fmt: skip
    if not s.iterations:
        del pieces["plan, ADMM"]
    print(
        f"{jax.devices()[0]}, JAX {jax.__version__}: {s.count} x {robot.name}, {steps} samples of "
        f"{robot.dt * 1e3:g} ms, {robot.substeps} physics steps each, N = {s.horizon}"
    )
    rows: dict[str, Any] = {}
    for name, (function, *args) in pieces.items() if s.pieces else ():
        compiled, seconds = timed(function, *args, repeats=s.repeats)
        rows[name] = {"compile": compiled, "seconds": seconds * steps / few}
        print(f"  {name:22} {rows[name]['seconds']:9.4f} s  compile {compiled:6.1f} s", flush=True)
    if s.pieces:
        physics = s.count * steps * robot.substeps
        table = {name: row["seconds"] for name, row in rows.items()}
        print(
            f"  physics steps a second {physics / table['physics']:,.0f} (mjx.step alone "
            f"{physics / table['mjx.step alone']:,.0f}), linear models a second "
            f"{s.count * steps / table['linear models']:,.0f}"
        )
    if s.loop:
        loop = lambda c, x: jax.vmap(
            lambda x: jm.simulate(c, robot, x, steps, reference=reference, input_reference=inputs)
        )(x)
        start = time.perf_counter()
        program = jax.jit(loop).lower(controller, x0s).compile()
        compiled = time.perf_counter() - start
        walls = []
        for _ in range(s.repeats):
            start = time.perf_counter()
            found = jax.block_until_ready(program(controller, x0s))
            walls.append(time.perf_counter() - start)
        wall, memory = min(walls), program.memory_analysis()
        solved = float(np.mean(np.asarray(found.status) == jm.Status.SOLVED))
        rows["closed loop"] = {"compile": compiled, "seconds": wall, "solved": solved}
        print(
            f"  closed loop            {wall:9.4f} s  compile {compiled:6.1f} s  "
            f"({s.seconds / wall:.2f} times real time for all, {s.count * steps / wall:,.0f} "
            f"solves a second, {solved:.1%} solved, {float(np.mean(found.fallback)):.2%} fallback, "
            f"worst violation {float(np.max(found.violation)):.1e}, "
            f"{memory.temp_size_in_bytes / 1e6:.0f} MB)"
        )
    return rows


if __name__ == "__main__":
    run(tyro.cli(Settings))
