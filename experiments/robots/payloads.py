"""Arms with unknown payloads that come to rest at a target: four MPCs side by side.

Each arm begins at rest somewhere about its home and carries a payload that its controller does not
know. "plain" and "offset-free" have one linear model, that of the set-point, and soft limits; the
offset-free one has a Kalman filter beside it, which estimates a disturbance of each joint's torque.
"state" has a linear model at each state, and knows nothing of the payload; "payload" also has an
extended Kalman filter, which estimates it: its models, and the torques of the target, have the
estimate. Printed for each:

    kept        share of arms that keep all position and velocity limits all the time, to 1e-6
    worst       largest violation of a limit (rad or rad/s)
    error       distance of the joints from the target at the end (rad): median, and the largest
    soft        share of plans that give up limits (Run.fallback)
    solved      share of plans with the status SOLVED
    seconds     of computing, compiling included

    python experiments/robots/payloads.py --robot arm2 --loops 256
    python experiments/robots/payloads.py --horizon 10 --seconds 1 --spread 0.1 --drift 0.005
    # The same of 4,096 arms, for a GPU: --loops 4096
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
import tyro

import jaxmpc as jm
from jaxmpc.closed_loop import (
    Disturbance,
    KalmanFilter,
    Noise,
    OffsetFreeController,
    draw_robots,
    randomised,
)

COLUMNS = ("kept", "worst", "error", "largest", "soft", "solved", "seconds")


@dataclass(frozen=True)
class Settings:
    """loops: arms. seconds: of motion. spread: of the starts, in fractions of the way from home to
    the limits. payload: the largest, kg. noise: standard deviation of what is measured, rad and
    rad/s. drift: by how much an estimated torque moves in one time step, in torque limits.
    controllers: which of them run."""

    robot: str = "arm7"
    loops: int = 256
    seconds: float = 2.0
    spread: float = 0.3
    payload: float = 1.0
    noise: float = 1e-4
    drift: float = 0.02
    horizon: int = 20
    chunk: int | None = None
    seed: int = 0
    controllers: tuple[str, ...] = ("offset-free", "plain", "state", "payload")


def run(s: Settings) -> Iterator[tuple[str, dict[str, float]]]:
    """Run both loops from the same starts with the same payloads; yield the numbers of each."""
    robot = jm.load_robot(s.robot)
    mpc = jm.robot_mpc(robot, horizon=s.horizon)
    plain = jm.RobotController(robot, mpc, linearize="set-point")
    nv, torques = robot.n // 2, robot.input_limits.half_widths()
    observer = KalmanFilter(
        mpc.system,
        np.repeat([1e-4, 1e-2], nv),
        s.noise,
        C=np.eye(robot.n),
        disturbance=Disturbance("input", s.drift * torques),
    )
    free = OffsetFreeController(plain, observer, tracked=np.eye(nv, robot.n))
    x, u = robot.set_point()
    given: dict[str, Any] = {
        "reference": np.asarray(robot.coordinates(x)),
        "input_reference": u,
        "noise": Noise(measurement=s.noise, seed=s.seed),
        "variations": randomised(robot, s.loops, seed=s.seed, payload=(0, s.payload)),
        "chunk": s.chunk,
    }
    x0s, _ = draw_robots(robot, s.loops, s.seed, spread=s.spread)
    steps = round(s.seconds / robot.dt)
    load = Disturbance("payload", 1e-3 * s.payload, initial=s.payload)
    spread = np.repeat([1e-5, 1e-3], nv)
    estimator = KalmanFilter(
        robot, spread, s.noise, C=np.eye(robot.n), initial=1e-3, disturbance=load
    )
    states = jm.RobotController(robot, mpc, linearize="state")
    every: tuple[tuple[str, Any, KalmanFilter | None], ...] = (
        ("offset-free", free, None),
        ("plain", plain, None),
        ("state", states, None),
        ("payload", states, estimator),
    )
    for name, controller, beside in every:
        if name not in s.controllers:
            continue
        begin = time.perf_counter()
        runs = jm.simulate_many(controller, robot, x0s, steps, observer=beside, **given)
        seconds = time.perf_counter() - begin
        worst = runs.violation.max(axis=1)
        error = np.abs(runs.states[:, -1, :nv] - x[:nv]).max(axis=1)
        yield (
            name,
            {
                "kept": float(np.mean(worst <= 1e-6)),
                "worst": float(worst.max()),
                "error": float(np.median(error)),
                "largest": float(error.max()),
                "soft": float(runs.fallback.mean()),
                "solved": float(np.mean(runs.status == jm.Status.SOLVED)),
                "seconds": seconds,
            },
        )


def main(settings: Settings) -> None:
    """Print the table."""
    print(f"{'':12}" + "".join(f"{name:>10}" for name in COLUMNS))
    for name, row in run(settings):
        print(f"{name:12}" + "".join(f"{row[key]:10.4g}" for key in COLUMNS), flush=True)


if __name__ == "__main__":
    with jax.enable_x64(True):
        main(tyro.cli(Settings))
