"""Options of the command `jaxmpc simulate`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from jaxmpc.app.options.shared import (
    FINITE,
    POSITIVE,
    SHARE,
    WHOLE_OR_PART,
    Devices,
    Overwrite,
    Payload,
    Precision,
    Resume,
    RobotDamping,
    RobotMass,
    Values,
    at_least,
    option,
)

Disturbances = Literal["vertices", "inside", "worst"]
Linearizations = Literal["set-point", "state", "trajectory", "lqr"]


@dataclasses.dataclass(frozen=True)
class SimulateOptions:
    """Drive thousands of robots to a target under constrained MPC, and count kept limits.

    What it does
      Puts many copies of a robot at random states, each with its own masses if wanted, and
      drives all of them to a target: physics by MuJoCo MJX, at each time step a linear model and an
      MPC that keeps joint, velocity and torque limits. Then assesses every run by its own
      states and inputs, not by what the MPC planned.
      Limits that a plan cannot keep are violated at the cost --rho (fallback), and counted.

    How to start
      $ jaxmpc simulate
      $ jaxmpc simulate --robot arm7 --count 256 --seconds 1 --mass 0.1 --output runs/a
      It compiles before the first steps, and says for how long so far. What is compiled is kept
      for the next time in ~/.cache/jaxmpc/programs (with JAXMPC_CACHE=off nothing is; with
      JAX_COMPILATION_CACHE_DIR it is there).

    How to read the table
      success        robots that kept all limits and ended at the target: each coordinate within
                     --tolerance of half its range (limits' half-width; 1 where it has none, and
                     any velocity where velocities have none)
      limits kept    robots with all states and inputs within the limits at all time steps, to 1e-6
                     of the limit. The margin is not counted in.
      plans valid    robots all of whose plans were solved without fallback; how many kept limits
      worst          the largest violation relative to half the range, in its own unit
      plans solved   plans whose residuals pass: 1e-6; along trajectories in float32 1e-3
      fallback       solved plans that need slack: soft limits are violated on their horizon
      unsolved       the other plans; of limits they say nothing
      settling       time after which a robot stays within the tolerance for the rest of its run
      cost           sum of (x - x_target)'Q(x - x_target) + (u - u_target)'R(u - u_target)
      run            wall time without compiler, files and plots
      real time      robot-seconds simulated in a second of wall time; the second number is
                     simulated time by wall time for all robots at once: above 1 is real time

    With --config FILE of a linear problem, one with the section [system]
      Such as jaxmpc simulate --config problem.toml --disturbance worst
      Closed loops of its plant and controller, from states around the target, up to the fraction
      --spread of the way to the state limits, under disturbances of its section [disturbance]. It
      counts the starts that have a plan, and of these loops those that kept all limits; neither is
      a proof. A robust problem keeps them all where its terminal set is invariant: jaxmpc recursion
      says so.
      Files: summary.json, and runs.npz with states, inputs, status and disturbances.

    Files, all in the folder of --output
      runs.png       Positions, velocities and inputs of some robots over time, limits in grey.
                     Orange: its plan needs slack (fallback). Purple: its plan was not
                     solved. Red: limits exceeded.
      robots.gif     Some of the robots, in real time, with their numbers in runs.zarr. Green and
                     see-through: the target. Red frame: beyond the limit that it names.
                     By the camera "view" of the model, else by one that sees all that moves.
                     Needs OpenGL: without a display libegl1 libegl-mesa0 libgl1-mesa-dri libgl1
                     (Debian, Ubuntu); without it no video.
      summary.json   The table's numbers, target, worst violation of each coordinate, versions.
      runs.zarr      points (the start), states, inputs, status, cost, fallback, ... of every
                     robot. Opens with xarray.open_zarr(path).
      Ctrl-C         Stops; finished chunks are kept, --resume goes on from there.
      Exit code      0 done, for any outcome; 2 error (one line on stderr says which);
                     130 stopped by Ctrl-C.
    """

    robot: Annotated[str, option("NAME|FILE", "joint")] = "joint"
    """joint, pendulum, cartpole, arm2, arm6, arm7, quadrotor, or an MJCF or URDF file."""
    config: Annotated[
        Path | None,
        option(
            "FILE",
            "none",
            "TOML file of jaxmpc tune weights --robot: [robot] name, horizon, margin, linearize, "
            "[cost] Q, R, P, rho. An option given here wins over the file. Or a problem file.",
        ),
    ] = None
    count: Annotated[int, option("B", "64"), at_least(1)] = 64
    """Number of robots."""
    seconds: Annotated[float | None, option("S", "2; of a problem file 100 samples"), POSITIVE] = (
        None
    )
    """Simulated time of each robot, or in the unit of time of a problem file."""
    disturbance: Annotated[
        Disturbances | None,
        option(
            "{vertices,inside,worst}",
            "none",
            "Of a problem file: random vertices of [disturbance], random points of it, or for each "
            "start the worst sequence that a search by gradient finds.",
            Disturbances,
        ),
    ] = None
    target: Annotated[
        tuple[float, ...] | None, option("Q [Q ...]", "home of the model"), FINITE
    ] = None
    """Configuration to rest at, one number a joint, in rad or m (qpos of MuJoCo)."""
    spread: Annotated[
        float,
        option(
            "FRACTION",
            "0.5",
            "Starts are uniform around home, up to this fraction of the way to the limits, and "
            "where there is no limit up to this number itself, in positions and velocities.",
        ),
        WHOLE_OR_PART,
    ] = 0.5
    seed: Annotated[int, option("K", "0"), at_least(0)] = 0
    """Seed of starts, masses, damping and payloads."""
    linearize: Annotated[
        Linearizations | None,
        option(
            "{set-point,state,trajectory,lqr}",
            "from --config, else state",
            "Linear models: once at the target, at each measured state, along the last plan. lqr: "
            "no MPC but linear feedback, clipped to the input limits, to compare with.",
            Linearizations,
        ),
    ] = None
    horizon: Annotated[int | None, option("N", "from --config, else 20"), at_least(1)] = None
    """Prediction horizon, in control periods."""
    state_weights: Annotated[
        tuple[float, ...] | None,
        option("Q [Q ...]", "from --config, else Bryson's rule, velocities x 0.01"),
        Values(lambda value: 0 <= value < np.inf, "Give finite numbers, at least 0"),
    ] = None
    """Diagonal of Q: positions, then velocities. Bryson's rule: 1/(half the range)^2."""
    input_weights: Annotated[
        tuple[float, ...] | None,
        option("R [R ...]", "from --config, else Bryson's rule x 0.01"),
        Values(lambda value: 0 < value < np.inf, "Give finite positive numbers"),
    ] = None
    """Diagonal of R, one number an actuator."""
    margin: Annotated[float | None, option("FRACTION", "from --config, else 0.02"), SHARE] = None
    """Room that the MPC leaves to state limits, as a fraction of half the range."""
    rho: Annotated[float | None, option("RHO", "from --config, else 1e4"), POSITIVE] = None
    """L1 weight of state limits; too small a weight violates limits that could be kept."""
    iterations: Annotated[int | None, option("K", "0; with set-point 50"), at_least(0)] = None
    """ADMM steps of each plan."""
    newton_steps: Annotated[
        int | None,
        option(
            "K",
            "as many as are needed",
            "Newton steps after them at most. A number bounds the time of a plan and gives up the "
            "interior point method, which solves what Newton steps do not.",
        ),
        at_least(0),
    ] = None
    mass: RobotMass = 0.0
    damping: RobotDamping = 0.0
    payload: Payload = 0.0
    tolerance: Annotated[float, option("FRACTION", "0.02"), POSITIVE] = 0.02
    """How near the target counts as there, as a fraction of half the range."""
    dtype: Annotated[Precision, option("{float32,float64}", "float32")] = "float32"
    """Precision of physics and MPC."""
    chunk: Annotated[
        int | None, option("B", "256 on a CPU, 4096 on others, of each device"), at_least(1)
    ] = None
    """Robots at a time: what is written at once, and lost at most."""
    devices: Devices = None
    video: Annotated[int, option("K", "4"), at_least(0)] = 4
    """Number of robots in the video; 0: none."""
    output: Annotated[Path, option("DIR", "jaxmpc-simulate")] = Path("jaxmpc-simulate")
    """Folder for the files; made where absent."""
    resume: Resume = False
    overwrite: Overwrite = False

    keeps = "chunks"
