"""How much of what nonlinear robots keep is proved, and whether a proof is ever contradicted.

For a pendulum, a cart-pole and an arm of two links: the linear model with the set that holds all it
leaves out, the robust MPC of both, and

proved     share of `count` uniform states of the box from which limits are proved to be kept
kept       share from which the plant in MJX keeps them for `seconds` under the nominal MPC without
           a terminal set (soft where it has no plan), its state limits as they are or 2 % narrower,
           or from which that is proved
of kept    proved states among the kept ones
worst      the most that a limit is exceeded, in half-widths, from `worst` proved states next to the
           boundary of the proved set, by the robust policy on the plant, with u = K x after it.
           States and plans are convex combinations of those at the ends of rays, two by two: what
           proves these proves them

Bounds, plans at the ends of rays and loops, `chunk` at a time, are kept in `out`: a run that was
stopped goes on there.

python experiments/robots/nonlinear_proofs.py --robots pendulum
"""

import dataclasses
import pickle
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import jaxmpc as jm
from jaxmpc.pytrees import record


@record
class Case:
    """Half-widths of the states (n,) about home and of the inputs about the set-point (None: the
    robot's own limits), weight of inputs in parts of Bryson's rule, horizon, cells."""

    states: tuple[float, ...]
    inputs: tuple[float, ...] | None
    effort: float
    horizon: int
    cells: int


CASES = {
    "pendulum": Case((np.pi / 6, 2.0), None, 1.0, 100, 20_000),
    "cartpole": Case((1.0, 0.3, 1.5, 1.5), None, 100.0, 40, 6_000),
    "arm2": Case((0.1, 0.1, 0.6, 0.6), (4.0, 1.5), 10.0, 30, 16_000),
}


@dataclasses.dataclass(frozen=True)
class Settings:
    """robots: which cases. parts: "share", of what is kept, and "worst", the worst cases. count:
    uniform states. worst: proved states next to the boundary. rays: whose ends these are made of.
    seconds: of each loop under the nominal MPC; the robust policy runs as many samples more as its
    horizon."""

    robots: tuple[str, ...] = tuple(CASES)
    parts: tuple[str, ...] = ("share", "worst")
    count: int = 400
    worst: int = 100_000
    rays: int = 500
    chunk: int = 10_000
    seconds: float = 1.0
    seed: int = 0
    out: Path = Path("out")


def main(settings: Settings) -> None:
    """Print one block a robot."""
    for name in settings.robots:
        robot, case = jm.load_robot(name), CASES[name]
        x, u = robot.equilibrium()
        half = np.array(case.states)
        states = jm.Box(x - half, x + half)
        inputs = robot.input_limits
        if case.inputs is not None:
            inputs = jm.Box(u - np.array(case.inputs), u + np.array(case.inputs))
        began = time.process_time()
        enclosure = partial(jm.robots.linear_enclosure, robot, states, inputs, cells=case.cells)
        found = kept_at(settings.out / name / "enclosure.pickle", enclosure)
        took = time.process_time() - began
        print(f"{name}: {found.cells} cells, {took:.0f} s of processor time")
        print(f"  accelerations left out within {found.left_out}, samples {found.found}")
        effort = case.effort * 0.01 / inputs.half_widths() ** 2
        mpc = jm.closed_loop.enclosed_mpc(found, R=effort, horizon=case.horizon)
        if "share" in settings.parts:
            print_share(robot, mpc, found, settings)
        if "worst" in settings.parts:
            began = time.process_time()
            over = policy_excess(robot, mpc, found, settings.out / name, settings)
            took = time.process_time() - began
            print(
                f"  {len(over)} proved states: {np.sum(over > 1e-9)} exceed a limit by more than "
                f"1e-9, {np.sum(over > 1e-6)} by more than 1e-6 half-widths, worst "
                f"{over.max():.2e}; {took:.0f} s of processor time"
            )


def kept_at(path: Path, make: Callable[[], Any]) -> Any:
    """Return what a file holds, or make it and write it there."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(make()))
    return pickle.loads(path.read_bytes())


def print_share(robot: Any, mpc: Any, found: Any, settings: Settings) -> None:
    """Print how many of the states from which limits are kept are proved."""
    rng = np.random.default_rng(settings.seed)
    half = found.states.half_widths()
    x0s = found.x + rng.uniform(-1, 1, (settings.count, robot.n)) * half
    began = time.process_time()
    proved = jm.map_feasible_set(mpc, x0s).label == 1
    nominal = replace(mpc, disturbance=None, gain=None, terminal_set=None)
    possible = jm.map_feasible_set(nominal, x0s).label != -1
    took = time.process_time() - began
    kept = proved.copy()
    for narrower in (0.0, 0.02):
        inner = replace(nominal, states=found.states.tightened(narrower))
        kept[possible] |= simulated(robot, inner, found, x0s[possible], settings.seconds)
    share = np.sum(proved & kept) / np.sum(kept)
    print(
        f"  proved {proved.mean():.3f}, kept {kept.mean():.3f}, of kept {share:.3f}; "
        f"labels {took:.0f} s of processor time"
    )


def simulated(robot: Any, mpc: Any, found: Any, x0s: np.ndarray, seconds: float) -> np.ndarray:
    """Return from which states (B, n) the plant stays in the box under the MPC, (B,)."""
    with jax.enable_x64(True):
        controller = jm.RobotController(robot, mpc, linearize="set-point")
        goal: dict[str, Any] = {"reference": found.x, "input_reference": found.u}
        steps = round(seconds / robot.dt)
        run = jm.simulate_many(controller, robot, x0s, steps, **goal)
    states = np.asarray(run.states)
    inside = (states >= found.states.lower - 1e-6) & (states <= found.states.upper + 1e-6)
    return np.all(inside, axis=(1, 2))


def policy_excess(robot: Any, mpc: Any, found: Any, folder: Path, settings: Settings) -> np.ndarray:
    """Return how far limits are exceeded, in half-widths (worst,), by u = v_k + K (x − z_k) on the
    plant for N samples, then u = u_s + K (x − x_s) for as many more."""

    def at_ends() -> tuple[np.ndarray, ...]:
        rng = np.random.default_rng(settings.seed)
        directions = rng.normal(size=(settings.rays, robot.n)) * found.states.half_widths()
        ends = jm.feasible.boundary(mpc, directions, center=found.x).points
        ends = found.x + (ends - found.x) * (1 - 1e-6)
        proved = jm.map_feasible_set(mpc, ends).label == 1
        with jax.enable_x64(True):
            plans = jm.solve_many(mpc, ends)
        # The label says that there is a plan; the policy needs the plan itself.
        known = proved & (np.asarray(plans.status) == jm.Status.SOLVED)
        print(f"  {settings.rays} ends of rays: {proved.sum()} proved, {known.sum()} with a plan")
        return ends[known], np.asarray(plans.states)[known], np.asarray(plans.inputs)[known]

    ends = kept_at(folder / "ends.pickle", at_ends)
    run = policy_runs(robot, mpc, found)

    def excess(number: int) -> np.ndarray:
        rng = np.random.default_rng([settings.seed, number])
        first, second = rng.integers(0, len(ends[0]), (2, settings.chunk))
        part = rng.uniform(size=settings.chunk) ** 4
        mixed = (
            np.einsum("i,i...->i...", part, v[first])
            + np.einsum("i,i...->i...", 1 - part, v[second])
            for v in ends
        )
        with jax.enable_x64(True):
            return np.asarray(run(*mixed))

    numbers = range(-(-settings.worst // settings.chunk))
    parts = [kept_at(folder / f"{k}.pickle", partial(excess, k)) for k in numbers]
    return np.concatenate(parts)[: settings.worst]


def policy_runs(robot: Any, mpc: Any, found: Any) -> Callable[..., jax.Array]:
    """Return the compiled function of starts (B, n) and plans (B, N+1, n), (B, N, m) that runs the
    policy on the plant and returns the worst excess of each (B,)."""
    N, K = mpc.horizon, np.asarray(mpc.gain)
    boxes = (found.states, found.inputs)

    def excess(values: tuple[jax.Array, ...]) -> jax.Array:
        beyond = [
            jnp.max(jnp.maximum(v - box.upper, box.lower - v) / box.half_widths())
            for v, box in zip(values, boxes, strict=True)
        ]
        return jnp.maximum(*beyond)

    def advance(x: jax.Array, plan: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        z, v = plan
        u = v + K @ (x - z)
        return robot.step(x, u), excess((x, u))

    def one(x: jax.Array, states: jax.Array, inputs: jax.Array) -> jax.Array:
        rest = jnp.tile(found.x, (N + 1, 1)), jnp.tile(found.u, (N + 1, 1))
        plan = jnp.vstack([states[:N], rest[0]]), jnp.vstack([inputs, rest[1]])
        return jnp.max(jax.lax.scan(advance, x, plan)[1])

    return jax.jit(jax.vmap(one))


if __name__ == "__main__":
    main(tyro.cli(Settings))
