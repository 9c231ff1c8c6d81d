"""Options of the command `jaxmpc tune weights`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from jaxmpc.app.options.shared import (
    NOT_NEGATIVE,
    OPEN_FRACTION,
    POSITIVE,
    SHARE,
    Horizon,
    Overwrite,
    Payload,
    Precision,
    Resume,
    RobotDamping,
    RobotMass,
    Terminal,
    Values,
    at_least,
    option,
)

Linearizations = Literal["set-point", "state", "trajectory"]
SPREAD = Values(lambda value: 0 < value <= 1, "Give a fraction above 0 and up to 1")


@dataclasses.dataclass(frozen=True)
class TuneWeightsOptions:
    """Tune the weights of an MPC by gradient, through its closed loops.

    What it does
      Draws initial states, simulates the closed loop from each, and moves the weights down the
      gradient of the mean loss: through plant, limits and solver, all steps of all loops. With
      e = x - target, v = u - input of the target and the weights Q, R from BEFORE tuning, the loss
      of a loop is
        mean over time steps of e'Q e + v'R v + violation * (sum of violations of state limits)
        + settling * (time steps until |e| stays within the tolerance)
      so that the horizon, the limits and what the model leaves out decide what the controller's
      own weights should be. Some of the loops (--validation) are the validation set: the result is
      the step of least loss on these, or the start where no step is better.
      Without a file the problem is one robot joint: x = (q, dq), torque u, 20 steps of 0.01 s.

    How to start
      $ jaxmpc tune weights
      $ jaxmpc tune weights --config pendulum.toml --tune Q R P --updates 50 --output tuned/a
      $ jaxmpc tune weights --robot arm2 --mass 0.2 --payload 0.5 --tune Q R rho tightening
      Before the first step the program compiles: half a minute for one joint, minutes for an arm.
      What is compiled is kept for the next time, see jaxmpc simulate --help.

    What can be tuned (--tune)
      Q, R        weights of states and inputs; diagonal, or --weights full: L L', any positive
                  definite matrix
      P           terminal weight; where it is not tuned it stays what the file says: "lqr" and "Q"
                  follow the tuned Q and R
      rho         L1 weight of soft limits, where the problem has any ([cost] rho; robots always)
      tightening  fraction of their half-width by which state limits are moved inwards; it starts at
                  --margin and is at most 0.5
      An invariant or ellipsoidal terminal set stays the one from before tuning.

    How to read the table
      loss        mean over the validation loops, before and after, and the change; below it its
                  terms, in the new simulations: tracking, effort, violation, time to settle
      violated    validation loops that violate a limit of states or inputs by more than 1e-6 of
                  the limit, not counting the tightening
      unsolved    plans whose residuals exceed 1e-6 (along trajectories in float32 1e-3)
      infeasible  those of them that are proved infeasible
      unproved    the others of them: inaccurate, stopped too early, or data not finite
      fallback    plans that are solved with slack: soft limits are violated on their horizon
      at target   loops that end within --tolerance of half the range of each state
      then        the weights
      All but the loss itself is counted in new simulations, those after tuning with tuned.toml as
      written.

    Files, all in the folder of --output
      tuned.toml        The whole problem with the tuned weights: for --config of jaxmpc sweep,
                        recursion, info, tune; of a robot for jaxmpc simulate --robot NAME --config.
      tuning.json       Options; loss, gradient norm, counts and weights of every step; versions.
      tuning.png        The same as curves, counts where any is above 0. Red crosses: steps
                        rejected because not finite.
      before_after.png  Some validation loops with the weights before and after.
      maps.png          The feasible set before and after; for two states, with tightening tuned.
      checkpoint.npz    The state of the run after every step, for --resume.
      Ctrl-C            Stops, and writes all files from the best of the finished steps; --resume
                        goes on from there. A finished run goes on with --resume and more --updates.
      Exit code         0 done, whether better or not; 2 error (one line on stderr says which); 130
                        stopped by Ctrl-C.

    What the TOML file holds
      The sections [system], [limits], [cost], [mpc] of jaxmpc sweep --help, and, all optional,
      [limits]  margin, the tightening (needs x_min, x_max)
      [mpc]     H_f, h_f (H_f x_N <= h_f) or P_f, level_f (x_N'P_f x_N <= level_f) instead of
                terminal
      [solver]  iterations, rho, alpha, newton_steps; jaxmpc tune solver writes them
      With --robot: the sections that tuned.toml has, [robot] and [cost].
    """

    config: Annotated[Path | None, option("FILE", "the built-in joint")] = None
    """TOML file with the problem; with --robot the weights to start from."""
    robot: Annotated[str | None, option("NAME|FILE", "none: a linear system")] = None
    """joint, pendulum, cartpole, arm2, arm6, arm7, quadrotor, or an MJCF or URDF file."""
    tune: Annotated[
        tuple[Literal["Q", "R", "P", "rho", "tightening"], ...],
        option("{Q,R,P,rho,tightening} [...]", "Q R"),
    ] = ("Q", "R")
    """What is tuned; see above."""
    weights: Annotated[Literal["diagonal", "full"], option("{diagonal,full}", "diagonal")] = (
        "diagonal"
    )
    """Form of Q and R. P is full unless it starts diagonal."""
    updates: Annotated[int, option("K", "100"), at_least(0)] = 100
    """Steps of the optimizer."""
    count: Annotated[int, option("B", "64"), at_least(2)] = 64
    """Number of initial states, validation included."""
    batch: Annotated[int | None, option("B", "all training loops"), at_least(1)] = None
    """Number of loops of each step, drawn again each time."""
    validation: Annotated[float, option("FRACTION", "0.25"), OPEN_FRACTION] = 0.25
    """Fraction of the initial states in the validation set."""
    steps: Annotated[int | None, option("K", "100; robots: 1 s"), at_least(1)] = None
    """Length of the closed loops in time steps."""
    seconds: Annotated[float | None, option("S", "none: --steps"), POSITIVE] = None
    """Length of the closed loops in seconds."""
    optimizer: Annotated[str | None, option("NAME", "adam; gauss-newton none")] = None
    """Optimizer of optax, by name: adam, adamw, sgd, rmsprop, lion, ..."""
    learning_rate: Annotated[float | None, option("X", "0.05"), POSITIVE] = None
    """Learning rate; with adam a weight changes by about this fraction in a step."""
    mode: Annotated[
        Literal["auto", "forward", "reverse", "sampling", "gauss-newton"],
        option(
            "{auto,forward,reverse,sampling,gauss-newton}",
            "auto",
            "Differentiation: the time of forward grows with the number of weights, the memory of "
            "reverse with the length of the loops. auto: the one with fewer operations. sampling: "
            "from simulations alone, for contacts. gauss-newton: steps of its own, few of them.",
        ),
    ] = "auto"
    tracking: Annotated[tuple[float, ...] | None, option("Q [Q ...]", "Q at the start")] = None
    """Diagonal of the loss's own Q."""
    effort: Annotated[tuple[float, ...] | None, option("R [R ...]", "R at the start")] = None
    """Diagonal of the loss's own R."""
    violation: Annotated[float, option("W", "10"), NOT_NEGATIVE] = 10.0
    """Weight in the loss of violations of state limits, as fractions of half the range."""
    settling: Annotated[float | None, option("W", "5; robots 0"), NOT_NEGATIVE] = None
    """Weight in the loss of the time to settle, for each time step."""
    tolerance: Annotated[float, option("FRACTION", "0.02"), POSITIVE] = 0.02
    """Distance that counts as at the target, as a fraction of half the range of each state."""
    lower: Annotated[tuple[float, ...] | None, option("X [X ...]", "state limits x --spread")] = (
        None
    )
    """Lower ends of the initial states, one number a state. Not for robots."""
    upper: Annotated[tuple[float, ...] | None, option("X [X ...]", "state limits x --spread")] = (
        None
    )
    """Upper ends. States from which no plan keeps the limits (by linear programs) are replaced."""
    spread: Annotated[float | None, option("FRACTION", "0.9; robots 0.5"), SPREAD] = None
    """Initial states are uniform up to this fraction of the way from the target to the limits."""
    horizon: Horizon = None
    terminal: Terminal = None
    margin: Annotated[
        float | None, option("FRACTION", "from the file; 0.02 if tuned or robot"), SHARE
    ] = None
    """Tightening of the state limits before tuning, as a fraction of half the range."""
    target: Annotated[tuple[float, ...] | None, option("Q [Q ...]", "home of the model")] = None
    """With --robot: configuration to rest at."""
    linearize: Annotated[
        Linearizations | None,
        option("{set-point,state,trajectory}", "from the file, else state", kind=Linearizations),
    ] = None
    """With --robot: where the linear models are taken; see jaxmpc simulate."""
    mass: RobotMass = 0.0
    damping: RobotDamping = 0.0
    payload: Payload = 0.0
    iterations: Annotated[int | None, option("K", "[solver], else 50; robots 0"), at_least(1)] = (
        None
    )
    """ADMM steps of each plan."""
    newton_steps: Annotated[
        int | None, option("K", "[solver], else 20; robots as needed"), at_least(0)
    ] = None
    """Newton steps after them."""
    dtype: Annotated[
        Precision | None,
        option("{float32,float64}", "float64; robots float32", kind=Precision),
    ] = None
    """Precision of loops and derivatives."""
    seed: Annotated[int, option("K", "0"), at_least(0)] = 0
    """Seed of initial states, batches, masses, damping and payloads."""
    output: Annotated[Path, option("DIR", "jaxmpc-weights")] = Path("jaxmpc-weights")
    """Folder for the files; created if absent."""
    resume: Resume = False
    overwrite: Overwrite = False

    keeps = "steps"
