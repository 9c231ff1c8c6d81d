"""Torque rates of an arm in MJX: limited, weighed, and left free.

Arms start at random configurations and go home. For each controller the table shows the largest
rate of a torque as a share of its limit, from the input before the first (that of rest) on; the
largest violation of limits on positions and velocities; plans solved and plans that give up limits;
the error after the run; and the cost Σ (ξ − r)'Q(ξ − r) + (u − s)'R(u − s). Torques are limited by
the model in all of them.

    python experiments/robots/torque_rates.py --robot arm7 --count 64 --rate 300
"""

import time
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
import tyro

import jaxmpc as jm


@dataclass(frozen=True)
class Settings:
    """count: arms. seconds: of motion. rate: largest change of a torque (N m/s). spread: of the
    starts (rad). weight: of rates, in units of R. sqp: quadratic programs a sample of "SQP"."""

    robot: str = "arm7"
    count: int = 64
    seconds: float = 1.5
    horizon: int = 20
    rate: float = 300.0
    weight: float = 100.0
    spread: float = 0.3
    sqp: int = 10
    seed: int = 0


def run(s: Settings) -> None:
    """Print one line for each controller."""
    robot = jm.load_robot(s.robot)
    x, u = robot.equilibrium()
    nv, step = robot.mujoco.nv, s.rate * robot.dt
    free = jm.robot_mpc(robot, horizon=s.horizon)
    limited = replace(free, input_rate_limit=step)
    weighed = replace(free, input_rate_weight=s.weight * np.asarray(free.R))
    cases: dict[str, tuple[Any, dict[str, Any]]] = {
        "rates free": (free, {}),
        "rates weighed": (weighed, {}),
        "limited, at the state": (limited, {}),
        "limited, trajectory": (limited, {"linearize": "trajectory"}),
        "limited, SQP": (limited, {"linearize": "trajectory", "sqp_steps": s.sqp}),
    }
    rng, steps = np.random.default_rng(s.seed), round(s.seconds / robot.dt)
    home = np.asarray(robot.coordinates(x))
    lower, upper = (0.9 * np.asarray(v)[:nv] for v in robot.state_limits.bounds())
    starts = np.clip(home[:nv] + rng.uniform(-s.spread, s.spread, (s.count, nv)), lower, upper)
    starts = np.array([robot.state(np.append(q, np.zeros(nv))) for q in starts])
    aim = {"reference": home, "input_reference": u, "previous_input": u}
    print(f"{s.robot}: {s.count} arms, {steps} samples of {robot.dt:g} s, at most {s.rate:g} N m/s")
    print(f"{'':24}{'rate/limit':>11}{'violation':>11}{'solved':>9}{'soft':>8}{'error':>10}"
          f"{'cost':>10}{'seconds':>9}")  # fmt: skip
    for name, (mpc, how) in cases.items():
        controller, begin = jm.RobotController(robot, mpc, **how), time.perf_counter()
        r = jm.simulate_many(controller, robot, starts, steps, **aim)
        before = np.broadcast_to(u, (s.count, 1, len(u)))
        rates = np.abs(np.diff(np.concatenate([before, r.inputs], axis=1), axis=1)).max() / step
        error = np.abs(r.states[:, -1, :nv] - np.asarray(x)[:nv]).max()
        solved, cost = (r.status == jm.Status.SOLVED).mean(), r.stage_cost.sum(axis=1).mean()
        print(
            f"{name:24}{rates:11.6f}{r.violation.max():11.2e}{solved:9.2%}{r.fallback.mean():8.2%}"
            f"{error:10.2e}{cost:10.2f}{time.perf_counter() - begin:9.1f}",
            flush=True,
        )


if __name__ == "__main__":
    with jax.enable_x64(True):
        run(tyro.cli(Settings, description=__doc__))
