"""The command `jaxmpc tune weights`: its options and help."""

import dataclasses
import json
import sys
import time
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np
import optax

from jaxmpc.app.commands.compiling import Compiling
from jaxmpc.app.commands.options import (
    Horizon,
    Switch,
    Terminal,
    check_counts,
    check_positive,
    option,
    refuse,
)
from jaxmpc.app.commands.tuning import (
    CHECKPOINT,
    TUNED,
    check_validation,
    open_run,
    optimizer_of,
    overwriting,
)
from jaxmpc.app.commands.tuning_report import save_results
from jaxmpc.app.commands.tuning_task import TuningTask, linear_task, robot_task
from jaxmpc.app.report import report_error
from jaxmpc.batches import Compiled
from jaxmpc.checks import fail
from jaxmpc.files import check_results
from jaxmpc.tuning.result import Interrupted, TuningRun
from jaxmpc.tuning.weights import tune_weights


@dataclasses.dataclass(frozen=True)
class TuneWeights:
    """Tune the weights of an MPC by gradient, through its closed loops.

    What it does
      Draws initial states, simulates the closed loop from each, and moves the weights down the
      gradient of the mean loss: through plant, limits and solver, all samples of all loops. With
      e = x - target, v = u - input of the target and the weights Q, R from BEFORE tuning, the loss
      of a loop is
        mean over samples of e'Q e + v'R v + violation * (sum of violations of state limits)
        + settling * (samples until |e| stays within the tolerance)
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
      loss        mean over the validation loops, before and after, and the change
      violated    validation loops that violate a limit of states or inputs by more than 1e-6 (of
                  the limit, where that is above 1), not counting the tightening
      unsolved    plans whose residuals exceed 1e-6 (float64) or 1e-3 (float32)
      infeasible  those of them that are proved infeasible
      fallback    plans that are solved with slack: soft limits are violated on their horizon
      at target   loops that end within --tolerance of half the range of each state
      then        the weights
      All but the loss is counted in new simulations, those after tuning with tuned.toml as written.

    Files, all in the folder of --output
      tuned.toml        The whole problem with the tuned weights: for --config of jaxmpc sweep,
                        recursion, info, tune; of a robot for jaxmpc simulate --robot NAME --config.
      tuning.json       Options; loss, gradient norm, counts and weights of every step; versions.
      tuning.png        The same as curves. Red crosses: steps rejected because not finite.
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
    updates: Annotated[int, option("K", "100")] = 100
    """Steps of the optimizer."""
    count: Annotated[int, option("B", "64")] = 64
    """Number of initial states, validation included."""
    batch: Annotated[int | None, option("B", "all training loops")] = None
    """Number of loops of each step, drawn again each time."""
    validation: Annotated[float, option("FRACTION", "0.25")] = 0.25
    """Fraction of the initial states in the validation set."""
    steps: Annotated[int | None, option("K", "50; robots: 1 s")] = None
    """Length of the closed loops in samples."""
    seconds: Annotated[float | None, option("S", "none: --steps")] = None
    """Length of the closed loops in seconds."""
    optimizer: Annotated[str, option("NAME", "adam")] = "adam"
    """Optimizer of optax, by name: adam, adamw, sgd, rmsprop, lion, ..."""
    learning_rate: Annotated[float, option("X", "0.05")] = 0.05
    """Learning rate; with adam a weight changes by about this fraction in a step."""
    mode: Annotated[
        Literal["auto", "forward", "reverse"], option("{auto,forward,reverse}", "auto")
    ] = "auto"
    """Differentiation: the time of forward grows with the number of weights, the memory of
    reverse with the length of the loops. auto: the one with fewer operations."""
    tracking: Annotated[tuple[float, ...] | None, option("Q [Q ...]", "Q at the start")] = None
    """Diagonal of the loss's own Q."""
    effort: Annotated[tuple[float, ...] | None, option("R [R ...]", "R at the start")] = None
    """Diagonal of the loss's own R."""
    violation: Annotated[float, option("W", "10")] = 10.0
    """Weight in the loss of violations of state limits, as fractions of half the range."""
    settling: Annotated[float, option("W", "0")] = 0.0
    """Weight in the loss of the time to settle, for each sample."""
    tolerance: Annotated[float, option("FRACTION", "0.02")] = 0.02
    """Distance that counts as at the target, as a fraction of half the range of each state."""
    lower: Annotated[tuple[float, ...] | None, option("X [X ...]", "state limits x --spread")] = (
        None
    )
    """Lower ends of the initial states, one number a state. Not for robots."""
    upper: Annotated[tuple[float, ...] | None, option("X [X ...]", "state limits x --spread")] = (
        None
    )
    """Upper ends. States from which no plan keeps the limits (by linear programs) are replaced."""
    spread: Annotated[float | None, option("FRACTION", "0.9; robots 0.5")] = None
    """Initial states are uniform up to this fraction of the way to the limits."""
    horizon: Horizon = None
    """Prediction horizon, in samples."""
    terminal: Terminal = None
    """Terminal set, as in jaxmpc sweep. Not for robots."""
    margin: Annotated[float | None, option("FRACTION", "from the file; 0.02 if tuned or robot")] = (
        None
    )
    """Tightening of the state limits before tuning, as a fraction of half the range."""
    target: Annotated[tuple[float, ...] | None, option("Q [Q ...]", "home of the model")] = None
    """With --robot: configuration to rest at."""
    linearize: Annotated[
        Literal["set-point", "state", "trajectory"] | None,
        option("{set-point,state,trajectory}", "from the file, else state"),
    ] = None
    """With --robot: where the linear models are taken; see jaxmpc simulate."""
    mass: Annotated[float, option("FRACTION", "0")] = 0.0
    """With --robot: masses and inertias are multiplied by numbers from 1 - FRACTION to
    1 + FRACTION, different in each loop; the MPC keeps the nominal model."""
    damping: Annotated[float, option("FRACTION", "0")] = 0.0
    """With --robot: the same for the damping of each joint."""
    payload: Annotated[float, option("KG", "0")] = 0.0
    """With --robot: mass from 0 to KG at the site "tool"; the MPC keeps the nominal model."""
    iterations: Annotated[int | None, option("K", "[solver], else 50; robots 0")] = None
    """ADMM steps of each plan."""
    newton_steps: Annotated[int | None, option("K", "[solver], else 20; robots as needed")] = None
    """Newton steps after them."""
    dtype: Annotated[
        Literal["float32", "float64"] | None,
        option("{float32,float64}", "float64; robots float32"),
    ] = None
    """Precision of loops and derivatives."""
    seed: Annotated[int, option("K", "0")] = 0
    """Seed of initial states, batches, masses, damping and payloads."""
    output: Annotated[Path, option("DIR", "jaxmpc-weights")] = Path("jaxmpc-weights")
    """Folder for the files; created if absent."""
    resume: Switch = False
    """Resume the run in --output."""
    overwrite: Switch = False
    """Delete the run in --output and start again."""

    keeps = "steps"

    def run(self) -> int:
        """Run the command and return the exit code."""
        with overwriting(self.output):
            return self._run()

    def _run(self) -> int:
        begun, compiled = time.perf_counter(), Compiled.seconds
        try:
            task = self.prepare()
            print(
                f"{task.name}: {', '.join(self.tune)} from {len(task.x0s)} closed loops of "
                f"{task.steps} samples -> {self.output}", flush=True,
            )  # fmt: skip
            run, stopped = self.tuned(task), False
        except ValueError as error:
            return report_error(error)
        except Interrupted as stop:
            print("\nstopped; writing the best of the steps that were done")
            run, stopped = stop.run, True
        compiling = Compiled.seconds - compiled
        seconds = {"compile": compiling, "run": time.perf_counter() - begun - compiling}
        (self.output / TUNED).write_text(task.write(run.values))
        print(save_results(self, task, run, seconds, begun))
        if stopped:
            raise KeyboardInterrupt
        return 0

    def tuned(self, task: TuningTask) -> TuningRun:
        """Return the run of `tune_weights`."""
        with jax.enable_x64(task.dtype == "float64"), Compiling() as wait:
            wait.begin(f"closed loops of {task.name} and their gradient", programs=2)
            return tune_weights(
                task.make, task.parameters, task.plant, task.x0s, task.loss, task.steps,
                reference=task.reference, input_reference=task.input_reference,
                variations=task.variations, validation=float(np.mean(~task.train)),
                solver=task.solver, optimizer=self.stepper(), updates=self.updates,
                batch=self.batch, mode=self.mode, seed=self.seed,
                checkpoint=self.output / CHECKPOINT, progress=sys.stderr.isatty(),
            )  # fmt: skip

    def prepare(self) -> TuningTask:
        """Check the options, build the task and open the folder. No closed loop compiles.

        Raises ValueError for options that do not fit together."""
        self.check()
        check_results(self.output / "tuning.json", self.resume, self.overwrite)
        self.stepper(np.zeros(1))
        task = linear_task(self) if self.robot is None else robot_task(self)
        files = ("tuning.json", TUNED, "tuning.png", "before_after.png", "maps.png")
        open_run(self.output, files, self.options(task), self.resume, self.overwrite)
        return task

    def check(self) -> None:
        """Raise ValueError for options that make no sense."""
        if self.robot is None:
            given = {name: getattr(self, name) for name in
                     ("target", "linearize", "mass", "damping", "payload")}  # fmt: skip
            refuse({k: v or None for k, v in given.items()}, None, "It is of robots")
        else:
            given = {"lower": self.lower, "upper": self.upper, "terminal": self.terminal}
            refuse(given, self.robot, "Starts are drawn by --spread, and no terminal set is used")
        if not self.tune or len(set(self.tune)) != len(self.tune):
            fail("--tune", f"{' '.join(self.tune) or 'nothing'}", "Name each quantity once")
        if self.steps is not None and self.seconds is not None:
            fail("--seconds", "given beside --steps", "Give one of them")
        check_counts(
            self, updates=0, count=2, batch=1, steps=1, iterations=1, newton_steps=0, seed=0
        )
        check_validation(self)
        check_positive(self, "seconds", "learning_rate", "tolerance")
        for name in ("violation", "settling", "payload"):
            if not 0 <= getattr(self, name) < np.inf:
                fail(f"--{name}", f"{getattr(self, name)}", "Give a number, at least 0")
        for name in ("margin", "mass", "damping"):
            if not 0 <= (getattr(self, name) or 0.0) < 1:
                fail(f"--{name}", f"{getattr(self, name)}", "Give a fraction from 0 to below 1")
        if self.spread is not None and not 0 < self.spread <= 1:
            fail("--spread", f"{self.spread}", "Give a fraction above 0 and up to 1")

    def stepper(self, tried: Any = None) -> optax.GradientTransformation:
        """Return the optimizer; raise ValueError unless it can update parameters like `tried`."""
        return optimizer_of(self.optimizer, self.learning_rate, tried)

    def options(self, task: TuningTask) -> dict[str, Any]:
        """Return the options that determine the result, as JSON data, without --updates."""
        ignored = ("config", "output", "resume", "overwrite", "updates")
        found = {k: v for k, v in dataclasses.asdict(self).items() if k not in ignored}
        solver = {"iterations": task.solver.iterations, "newton_steps": task.solver.newton_steps}
        found |= {"steps": task.steps, "dtype": task.dtype, **solver, **task.options}
        return json.loads(json.dumps(found))
