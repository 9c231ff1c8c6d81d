"""Robots that track under limits, in MJX: MPC against LQR and PD, both clipped.

Two tasks from random starts: hold a set-point, and follow a sinusoid about it whose speed comes
near the limits. Every law knows gravity (the input of the reference by inverse dynamics) and clips
its torques. Printed for each:

    kept        share of loops whose robot keeps all position and velocity limits all the time
    worst       largest violation of a limit (rad or rad/s), median over the loops and the largest
    cost        mean closed-loop cost Σ (ξ − r)'Q(ξ − r) + (u − s)'R(u − s), and of the loops that
                all laws kept
    error       root mean square of the position's error (rad) over the second half
    soft        share of plans that give up limits (Run.fallback)
    solved      share of plans with the status SOLVED
    promised    largest violation at t + 1 after a plan at t that was SOLVED and kept the limits:
                what "no hard limit is exceeded" means; 1e-6 is asked for

    python experiments/robots/tracking.py --robot arm7
"""

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
import tyro

import jaxmpc as jm
from jaxmpc.closed_loop import LinearFeedback, Run
from jaxmpc.robots import Robot

TOLERANCE = 1e-6


@dataclass(frozen=True)
class Settings:
    """loops: robots of each task. seconds: of motion. modes: linearisations of the MPC. spread:
    of the starts, rad and (times 4) rad/s. speed: of the sinusoid, in velocity limits. velocity:
    limits in place of the file's, times theirs. margin: of `robot_mpc`."""

    robot: str = "arm2"
    loops: int = 32
    seconds: float = 1.5
    modes: tuple[str, ...] = ("state", "trajectory")
    horizon: int = 20
    spread: float = 0.4
    speed: float = 0.9
    velocity: float = 0.5
    margin: float = 0.02
    iterations: int = 200
    refine: int = 4
    seed: int = 0


def tasks(s: Settings, robot: Robot, steps: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """References (steps + N, n) and (steps + N − 1, m): the home, and sinusoids about it."""
    nv, length = robot.mujoco.nv, steps + s.horizon
    home = np.asarray(robot.home)[:nv]
    limit = np.asarray(robot.state_limits.upper)[nv:]
    t, period = robot.dt * np.arange(length), 1.5
    amplitude = s.speed * limit * period / (2 * np.pi) / np.linspace(1, 2, nv)
    wave = home + amplitude * np.sin(2 * np.pi * t / period)[:, None] * (-1.0) ** np.arange(nv)
    made = {}
    for name, positions in (("set-point", np.tile(home, (length, 1))), ("sinusoid", wave)):
        states, inputs = robot.trajectory(positions)
        made[name] = states, inputs[:-1]
    return made


def laws(s: Settings, robot: Robot) -> dict[str, Any]:
    """The MPCs and the two feedbacks, with one set of weights."""
    nv = robot.mujoco.nv
    torque = np.asarray(robot.input_limits.upper)
    Q, R = np.repeat([100.0, 1.0], nv), 1.0 / torque**2
    mpc = jm.robot_mpc(robot, Q, R, s.horizon, margin=s.margin)
    solver = jm.ADMM(iterations=s.iterations, refine=s.refine)
    found: dict[str, Any] = {
        f"MPC, {mode}": jm.RobotController(robot, mpc, solver, linearize=mode) for mode in s.modes
    }
    found["LQR, clipped"] = LinearFeedback(mpc, jm.lqr(mpc.system, mpc.Q, mpc.R).K, robot)
    # PD of 20 rad/s and critical damping, with the inertias at home.
    B = np.asarray(mpc.system.B)[nv:] / robot.dt
    gains = 20.0**2 * np.eye(nv), 2 * 20.0 * np.eye(nv)
    found["PD, clipped"] = LinearFeedback(mpc, -np.linalg.solve(B, np.hstack(gains)), robot)
    return found


def loops(law: Any, robot: Robot, starts: np.ndarray, steps: int, task: tuple) -> Run:
    """Closed loops of one law, on the host."""
    if isinstance(law, jm.RobotController):
        return jm.simulate_many(
            law, robot, starts, steps, reference=task[0], input_reference=task[1]
        )
    one = lambda x: jm.simulate(law, robot, x, steps, reference=task[0], input_reference=task[1])
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(one))(starts))


def run(s: Settings) -> None:
    """Drive all laws through both tasks and print the table."""
    limits = jm.load_robot(s.robot).state_limits
    nv = len(np.asarray(limits.upper)) // 2
    speed = s.velocity * np.asarray(limits.upper)[nv:]
    robot = jm.load_robot(s.robot, velocity=(-speed, speed))
    steps, rng = round(s.seconds / robot.dt), np.random.default_rng(s.seed)
    starts = np.tile(np.asarray(robot.home), (s.loops, 1))
    shift = s.spread * rng.uniform(-1, 1, starts.shape)
    shift[:, nv:] *= 4
    low, high = np.asarray(robot.state_limits.lower), np.asarray(robot.state_limits.upper)
    middle, half = (low + high) / 2, 0.9 * (high - low) / 2
    starts = np.clip(starts + shift, middle - half, middle + half)
    every = laws(s, robot)
    print(
        f"{s.robot}: {s.loops} loops of {steps} samples of {robot.dt:g} s, N = {s.horizon}, speed "
        f"limits {np.array2string(high[nv:], precision=3)}, margin {s.margin:g}, {starts.dtype}"
    )
    for task, references in tasks(s, robot, steps).items():
        runs = {name: loops(law, robot, starts, steps, references) for name, law in every.items()}
        kept = {name: (r.violation <= TOLERANCE).all(axis=1) for name, r in runs.items()}
        common = np.logical_and.reduce(list(kept.values()))
        print(
            f"\n{task:14}{'kept':>7}{'worst: median, largest':>24}{'cost':>9}"
            f"{'common (' + str(common.sum()) + ')':>13}{'error':>9}{'soft':>8}{'solved':>8}"
            f"{'promised':>10}{'|u|/max':>9}"
        )
        for name, r in runs.items():
            mpc = isinstance(every[name], jm.RobotController)
            cost, worst = r.stage_cost.sum(axis=1), r.violation.max(axis=1)
            off = (r.states[:, :steps, :nv] - references[0][:steps, :nv])[:, steps // 2 :]
            solved = r.status == jm.Status.SOLVED
            sure = solved & ~r.fallback
            promised = np.where(sure, r.violation[:, 1:], 0.0).max()
            text = f"{promised:10.1e}" if mpc else f"{'':10}"
            shares = f"{r.fallback.mean():8.2%}{solved.mean():8.2%}" if mpc else f"{'':16}"
            both = cost[common].mean() if common.any() else np.nan
            share = np.abs(r.inputs / np.asarray(robot.input_limits.upper)).max()
            print(
                f"{name:14}{kept[name].mean():7.0%}{np.median(worst):12.2e}{worst.max():12.2e}"
                f"{cost.mean():9.1f}{both:13.1f}{np.sqrt((off**2).mean()):9.4f}{shares}{text}"
                f"{share:9.3f}",
                flush=True,
            )
            if mpc:
                fine = promised <= TOLERANCE
                verdict = "kept" if fine else f"BROKEN by up to {promised:.2e}"
                print(f"{'':14}limits of plans that said so: {verdict} ({sure.sum()} plans)")


if __name__ == "__main__":
    with jax.enable_x64(True):
        run(tyro.cli(Settings, description=__doc__))
