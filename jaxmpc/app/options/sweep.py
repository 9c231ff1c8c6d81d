"""Options of the command `jaxmpc sweep`."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from jaxmpc.app.options.shared import (
    POSITIVE,
    Devices,
    End,
    Horizon,
    Precision,
    Switch,
    Terminal,
    option,
)


@dataclasses.dataclass(frozen=True)
class SweepOptions:
    """From which initial states can this controller keep all its limits? A map, with proofs.

    What it does
      Lays a grid over the initial states of a constrained linear MPC and decides each one:
        feasible    a plan was found and rolled out within all limits
        infeasible  a certificate proves that there is no plan
        undecided   neither
      Then bounds the set of feasible states by polytopes, from inside and from outside.
      Without a file the problem is one robot joint: x = (q, dq), torque u, 20 steps of 0.01 s.
      An option given here wins over the file.

    How to start
      $ jaxmpc sweep
      $ jaxmpc sweep --config pendulum.toml --terminal invariant --grid 512 512 --output maps/a

    How to read the output, all in the folder of --output
      map.png       Blue feasible, grey infeasible, yellow undecided. The true boundary lies
                    between the dashed line (inner) and the solid one (outer). Of three axes
                    a body and its projections; of others there is none.
      summary.json  Counts, bounds of the area, seconds, configuration, versions.
      sweep.zarr    Each state with its label (1 feasible, -1 infeasible, 0 undecided), its plan,
                    and the half-space cut_normal'x <= cut_offset that no feasible state leaves.
                    start holds the x_0 of the plan; bound_* the points and facets of the bounds.
                    Opens with xarray.open_zarr(path): a dimension a mapped state.
      Ctrl-C        Stops; finished blocks are kept: up to 131,072 states each, at least eight in a
                    large sweep. --resume goes on from there, and computes again what is missing or
                    damaged.
      --shard       Several processes write one sweep.zarr, the same bits as one would.
      jaxmpc verify DIR proves every label again, from these files alone.
      Exit code     0 done, 2 error (one line on stderr says which), 130 stopped by Ctrl-C.

    With --robot NAME or FILE: the prediction and the robot
      Such as jaxmpc sweep --robot pendulum --terminal invariant --seconds 2
      The MPC of a robot (joint, pendulum, cartpole, arm2, arm6, arm7, quadrotor, or an MJCF or
      URDF file), linear about its home, weights from its limits. The grid is a slice: the first
      joint's position and velocity unless --axes says otherwise, the rest at home unless --fixed.
      Each state is labelled as above, by the linear model, and by the closed loop of the
      nonlinear robot in MJX: are all its limits kept for --seconds? Costs about 0.3 ms a state
      and time step on one CPU core, after compiling, which is announced. What is compiled is kept
      for the next time, see jaxmpc simulate --help.
      robot_map.png  Blue: predicted, kept. Red: predicted, failed (feasible by the linear model,
                     the robot leaves its limits); orange: the same, but a plan before that was not
                     solved, so that the solver may be to blame. Grey: infeasible, and the robot
                     fails. Green: infeasible, yet the robot keeps its limits. Yellow: the linear
                     model's label is undecided. Circle: of what was predicted and failed, the
                     state deepest in the linear feasible set.
                     Without an invariant terminal set a plan covers its horizon only.
      summary.json   Counts, plans by status, deepest failure, configuration.
      robot_map.npz  x0s, states, predicted, held (1 yes, -1 no, 0 undecided), within_limits,
                     recursive, feasible, depth, worst (most beyond a limit), broken_at, lost_at,
                     unsolved_at.
      robot_map.zarr The state for --resume: a killed run loses the blocks of 256 states
                     that run or are being written.

    What the TOML file holds (n states, m inputs; dt in seconds or in time_unit)
      name = "joint"
      [system]  A, B, dt; optional c, state_names, state_units, input_names, input_units,
                time_unit = "s", continuous = true (A, B, c of dx/dt, the input held over dt)
      [limits]  u_min, u_max, and x_min, x_max (inf allowed) or H_x, h_x (H_x x <= h_x); optional
                input_rate_limit: |u(k) - u(k-1)| <= it; states are then (x, previous u)
      [cost]    Q, R, P = "lqr" | "Q" | "none" | matrix; a flat list is a diagonal; optional rho,
                the L1 weight of soft limits, a number or "exact" (jaxmpc info; sets stay hard),
                input_rate_weight, stage_weights
      [mpc]     horizon; optional terminal, constrain_initial = false (no limits at k = 0),
                constrained_stages, control_horizon (free inputs, the last one is held, or lengths
                of blocks that share an input)
      [[outputs]]  optional, repeated: lower <= C x + D u <= upper; stages, names, units; soft
                with rho, its L1 weight, and quadratic
      [reference]  optional: state and input that closed loops track (jaxmpc tune weights)
      [disturbance]  optional: w_min, w_max; E of x+ = A x + B u + E w, of a time step also
                with continuous = true; policy = "tightened" | "affine" | "tube"; gain of
                u = v + gain (x - z), not of "affine": feasible means that a policy of this kind
                keeps all limits for every such w
      and what jaxmpc tune writes, see its help: [limits] margin, [mpc] H_f, h_f or P_f, level_f,
      [solver]
      [sweep]   all optional: grid, lower, upper, axes, fixed, projection, iterations, dtype
    """

    config: Annotated[Path | None, option("FILE", "the built-in joint")] = None
    """TOML file with the problem and the sweep."""
    robot: Annotated[str | None, option("NAME|FILE", "none, a linear system")] = None
    """Map a robot instead, linear prediction against nonlinear closed loop."""
    seconds: Annotated[float | None, option("S", "2"), POSITIVE] = None
    """With --robot: length of its closed loops."""
    output: Annotated[Path, option("DIR", "jaxmpc-sweep")] = Path("jaxmpc-sweep")
    """Folder for sweep.zarr, map.png and summary.json; made where absent."""
    horizon: Horizon = None
    terminal: Terminal = None
    grid: Annotated[tuple[int, ...] | None, option("K [K ...]", "from the file, else 256 256")] = (
        None
    )
    """Points along each mapped axis, ends included."""
    lower: End = None
    """Lower end of each mapped axis, in the units of the state."""
    upper: End = None
    """Upper end of each mapped axis, in the units of the state."""
    axes: Annotated[tuple[str, ...] | None, option("AXIS [AXIS ...]", "first two states")] = None
    """States to map, by name or index from 0."""
    fixed: Annotated[tuple[float, ...] | None, option("X [X ...]", "from the file")] = None
    """With more states than axes: values of the other states, in their order (a slice)."""
    projection: Annotated[
        bool, tyro.conf.FlagCreatePairsOff, option(None, "from the file, else off")
    ] = False
    """With more states than axes: feasible for some value of the other states."""
    iterations: Annotated[int | None, option("K", "from the file, else 50")] = None
    """Solver steps of the first pass over all states; states left undecided get more."""
    dtype: Annotated[
        Precision | None,
        option("{float32,float64}", "from the file, else float32", kind=Precision),
    ] = None
    """Precision of the solver's steps. Proofs are in float64 always."""
    shard: Annotated[
        str | None,
        option(
            "I/N|auto|auto/N",
            "one process",
            "Compute blocks I, I+N, I+2N, ... (I from 0) beside N-1 other processes, here or on "
            "machines that share --output. auto: I and N of a SLURM job array; auto/N: I is "
            "SLURM_ARRAY_TASK_ID, or JOB_COMPLETION_INDEX of a Kubernetes job. The process that "
            "finishes last writes map.png and summary.json; the others say what is missing.",
        ),
    ] = None
    store: Annotated[
        str | None,
        option(
            "URL",
            "sweep.zarr in --output",
            "Where the data go instead, such as s3://bucket/sweep.zarr (fsspec). There are no "
            "locks there: compute no shard twice at a time.",
        ),
    ] = None
    devices: Devices = None
    resume: Switch = False
    """Resume the sweep in --output; of a shard, its blocks."""
    overwrite: Switch = False
    """Delete the sweep in --output and start again."""
    refine: Annotated[bool, option(None, "on")] = True
    """Move inner and outer bound together to a relative gap of 1e-6 (up to three axes)."""

    keeps = "blocks"
