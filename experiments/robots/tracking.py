"""Robots that track under limits, in MJX: MPC against LQR and PD, both clipped.

Two tasks from random starts: hold a set-point, and follow a sinusoid about it whose speed comes
near the limits. Every law knows gravity (the input of the reference: by inverse dynamics, or that
of rest where the robot has fewer inputs than joints) and clips its inputs. The MPCs differ in their
models: "set-point", "state" and "trajectory" linearise once a sample, "sqp" solves the nonlinear
problem by up to `sqp` quadratic programs. Masses that the laws do not know (--masses 0.1), noise
and an extended Kalman filter from measured positions (--noise 0.001) can be added. Printed for
each:

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
    python experiments/robots/tracking.py --robot cartpole --horizon 40 --velocity 0.2
    python experiments/robots/tracking.py --robot quadrotor --spread 0.2 --velocity 0.5
"""

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
import tyro

import jaxmpc as jm
from jaxmpc.closed_loop import KalmanFilter, LinearFeedback, Noise, Run, randomised
from jaxmpc.robots.robot import Robot

TOLERANCE = 1e-6


@dataclass(frozen=True)
class Settings:
    """loops: robots of each task. seconds: of motion. modes: linearisations of the MPC. spread:
    of the starts, rad and (times 4) rad/s. speed: of the sinusoid, in velocity limits. velocity:
    limits in place of the file's, times theirs. margin: of `robot_mpc`. sqp: quadratic programs a
    sample at most. hessian: of "sqp". masses: each body's mass is off by up to this share. noise:
    standard deviation of measured positions (rad, m)."""

    robot: str = "arm2"
    loops: int = 32
    seconds: float = 1.5
    modes: tuple[str, ...] = ("set-point", "state", "trajectory", "sqp")
    horizon: int = 20
    spread: float = 0.4
    speed: float = 0.9
    velocity: float = 0.5
    margin: float = 0.02
    sqp: int = 10
    hessian: str = "gauss-newton"
    masses: float = 0.0
    noise: float = 0.0
    seed: int = 0


def tasks(s: Settings, robot: Robot, steps: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """References (steps + N, n) and (steps + N − 1, m): the home, and sinusoids about it."""
    nv, length = robot.mujoco.nv, steps + s.horizon
    x, u = robot.set_point()
    home = np.asarray(robot.coordinates(x))[:nv]
    limit = np.asarray(robot.state_limits.upper)[nv:]
    t, period = robot.dt * np.arange(length), 1.5
    amplitude = s.speed * limit * period / (2 * np.pi) / np.linspace(1, 2, nv)
    moved = np.ones(nv) if robot.m == nv else np.arange(nv) < (3 if nv == 6 else 1)
    angle, signs = 2 * np.pi * t[:, None] / period, moved * (-1.0) ** np.arange(nv)
    wave = home + amplitude * np.sin(angle) * signs
    made = {}
    for name, positions in (("set-point", np.tile(home, (length, 1))), ("sinusoid", wave)):
        if robot.m == nv:
            states, inputs = robot.trajectory(positions)
            made[name] = states, inputs[:-1]
        else:
            states = np.hstack([positions, np.gradient(positions, robot.dt, axis=0)])
            made[name] = states, np.tile(u, (length - 1, 1))
    return made


def laws(s: Settings, robot: Robot) -> dict[str, Any]:
    """The MPCs and the two feedbacks, with one set of weights."""
    nv = robot.mujoco.nv
    half = robot.input_limits.half_widths()
    Q, R = np.repeat([100.0, 1.0], nv), 1.0 / half**2
    mpc = jm.robot_mpc(robot, Q, R, s.horizon, margin=s.margin)
    found: dict[str, Any] = {}
    for mode in s.modes:
        how = {"linearize": mode} if mode != "sqp" else {"linearize": "trajectory"}
        settings = {"sqp_steps": s.sqp, "hessian": s.hessian} if mode == "sqp" else {}
        found[f"MPC, {mode}"] = jm.RobotController(robot, mpc, **how, **settings)
    found["LQR, clipped"] = LinearFeedback(mpc, jm.lqr(mpc.system, mpc.Q, mpc.R).K, robot)
    if robot.m == nv:
        # PD of 20 rad/s and critical damping, with the inertias at home.
        B = np.asarray(mpc.system.B)[nv:] / robot.dt
        gains = 20.0**2 * np.eye(nv), 2 * 20.0 * np.eye(nv)
        found["PD, clipped"] = LinearFeedback(mpc, -np.linalg.solve(B, np.hstack(gains)), robot)
    return found


def loops(s: Settings, law: Any, robot: Robot, starts: np.ndarray, steps: int, task: tuple) -> Run:
    """Closed loops of one law, on the host."""
    given: dict[str, Any] = {}
    if s.masses:
        given["variations"] = randomised(robot, len(starts), mass=(1 - s.masses, 1 + s.masses))
    if s.noise:
        nv = robot.mujoco.nv
        process = np.repeat([1e-6, s.noise / robot.dt / 20], nv)
        given["noise"] = Noise(None, s.noise)
        given["observer"] = KalmanFilter(robot, process, s.noise, initial=1e-3)
    return jm.simulate_many(
        law, robot, starts, steps, reference=task[0], input_reference=task[1], **given
    )


def run(s: Settings) -> None:
    """Drive all laws through both tasks and print the table."""
    limits = jm.load_robot(s.robot).state_limits
    nv = len(np.asarray(limits.upper)) // 2
    speed = s.velocity * np.asarray(limits.upper)[nv:]
    robot = jm.load_robot(s.robot, velocity=(-speed, speed))
    steps, rng = round(s.seconds / robot.dt), np.random.default_rng(s.seed)
    home = np.asarray(robot.coordinates(robot.set_point()[0]))
    shift = s.spread * rng.uniform(-1, 1, (s.loops, len(home)))
    shift[:, nv:] *= 4
    low, high = np.asarray(robot.state_limits.lower), np.asarray(robot.state_limits.upper)
    bounded = np.isfinite(low) & np.isfinite(high)
    low, high = np.where(bounded, low, home - 10.0), np.where(bounded, high, home + 10.0)
    middle, half = (low + high) / 2, 0.9 * (high - low) / 2
    starts = np.clip(home + shift, middle - half, middle + half)
    starts = np.array([robot.state(xi) for xi in starts])
    every = laws(s, robot)
    print(
        f"{s.robot}: {s.loops} loops of {steps} samples of {robot.dt:g} s, N = {s.horizon}, speed "
        f"limits {np.array2string(high[nv:], precision=3)}, margin {s.margin:g}, {starts.dtype}"
    )
    for task, references in tasks(s, robot, steps).items():
        runs = {
            name: loops(s, law, robot, starts, steps, references) for name, law in every.items()
        }
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
            xi = jax.vmap(jax.vmap(robot.coordinates))(r.states[:, :steps])[..., :nv]
            off = (np.asarray(xi) - references[0][:steps, :nv])[:, steps // 2 :]
            solved = r.status == jm.Status.SOLVED
            sure = solved & ~r.fallback
            promised = np.where(sure, r.violation[:, 1:], 0.0).max()
            text = f"{promised:10.1e}" if mpc else f"{'':10}"
            shares = f"{r.fallback.mean():8.2%}{solved.mean():8.2%}" if mpc else f"{'':16}"
            both = cost[common].mean() if common.any() else np.nan
            low, high = (
                np.asarray(v) for v in (robot.input_limits.lower, robot.input_limits.upper)
            )
            share = np.abs((r.inputs - (low + high) / 2) / ((high - low) / 2)).max()
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
