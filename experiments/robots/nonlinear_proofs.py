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

python experiments/robots/nonlinear_proofs.py --robots pendulum
"""

import dataclasses
import time
from dataclasses import replace
from typing import Any

import jax
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
    """robots: which cases. count: uniform states. worst: proved states next to the boundary.
    seconds: of each loop under the nominal MPC; the robust policy runs as many samples more as its
    horizon."""

    robots: tuple[str, ...] = tuple(CASES)
    count: int = 400
    worst: int = 100_000
    seconds: float = 1.0
    seed: int = 0


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
        found = jm.robots.linear_enclosure(robot, states, inputs, cells=case.cells)
        took = time.process_time() - began
        print(f"{name}: {found.cells} cells, {took:.0f} s of processor time")
        print(f"  accelerations left out within {found.left_out}, samples {found.found}")
        effort = case.effort * 0.01 / inputs.half_widths() ** 2
        mpc = jm.closed_loop.enclosed_mpc(found, R=effort, horizon=case.horizon)
        rng = np.random.default_rng(settings.seed)
        x0s = x + rng.uniform(-1, 1, (settings.count, robot.n)) * half
        began = time.process_time()
        proved = jm.map_feasible_set(mpc, x0s).label == 1
        nominal = replace(mpc, disturbance=None, gain=None, terminal_set=None)
        possible = jm.map_feasible_set(nominal, x0s).label != -1
        took = time.process_time() - began
        kept = proved.copy()
        for narrower in (0.0, 0.02):
            inner = replace(nominal, states=states.tightened(narrower))
            kept[possible] |= simulated(robot, inner, found, x0s[possible], settings.seconds)
        share = np.sum(proved & kept) / np.sum(kept)
        print(f"  proved {proved.mean():.3f}, kept {kept.mean():.3f}, of kept {share:.3f}; "
              f"labels {took:.0f} s of processor time")  # fmt: skip
        over = policy_excess(robot, mpc, found, settings.worst, rng)
        print(
            f"  {len(over)} proved states: {np.sum(over > 1e-9)} exceed a limit by more than 1e-9, "
            f"{np.sum(over > 1e-6)} by more than 1e-6 half-widths, worst {over.max():.2e}"
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


def policy_excess(
    robot: Any, mpc: Any, found: Any, count: int, rng: np.random.Generator
) -> np.ndarray:
    """Return how far limits are exceeded, in half-widths (count,), by u = v_k + K (x − z_k) on the
    plant for N samples, then u = u_s + K (x − x_s) for as many more."""
    N, K = mpc.horizon, np.asarray(mpc.gain)
    directions = rng.normal(size=(500, robot.n)) * found.states.half_widths()
    ends = jm.feasible.boundary(mpc, directions, center=found.x).points
    ends = found.x + (ends - found.x) * (1 - 1e-6)
    ends = ends[jm.map_feasible_set(mpc, ends).label == 1]
    first, second = rng.integers(0, len(ends), (2, count))
    part = rng.uniform(size=count) ** 4
    mixed = lambda v: (
        np.einsum("i,i...->i...", part, v[first]) + np.einsum("i,i...->i...", 1 - part, v[second])
    )
    widths = found.states.half_widths(), found.inputs.half_widths()
    over = np.zeros(count)
    with jax.enable_x64(True):
        plans = jm.solve_many(mpc, ends)
        x, z, v = (mixed(np.asarray(a)) for a in (ends, plans.states, plans.inputs))
        step = jax.jit(jax.vmap(robot.step))
        for k in range(2 * N + 1):
            at, base = (z[:, k], v[:, k]) if k < N else (found.x, found.u)
            u = base + (x - at) @ K.T
            limits = zip((x, u), (found.states, found.inputs), widths, strict=True)
            for value, box, width in limits:
                beyond = np.maximum(value - box.upper, box.lower - value) / width
                over = np.maximum(over, beyond.max(axis=1))
            x = np.asarray(step(x, u))
    return over


if __name__ == "__main__":
    main(tyro.cli(Settings))
