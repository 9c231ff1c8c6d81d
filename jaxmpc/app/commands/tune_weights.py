"""The command `jaxmpc tune weights`: tune, write the files, print the table."""

import dataclasses
import sys
import time

from jaxmpc.app.commands.compile_notice import Compiling
from jaxmpc.app.commands.tune_shared import TUNED, optimizer_of
from jaxmpc.app.commands.weight_options import WeightOptions
from jaxmpc.app.commands.weight_problem import WeightProblem, problem_of_file, problem_of_robot
from jaxmpc.app.commands.weight_results import WeightResults
from jaxmpc.batches import Compiled
from jaxmpc.files import as_json, check_results
from jaxmpc.tuning.result import Interrupted
from jaxmpc.tuning.run_folders import run_folder

FILES = ("tuning.json", TUNED, "tuning.png", "before_after.png", "maps.png")


@dataclasses.dataclass(frozen=True)
class TuneWeights(WeightOptions):
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

    keeps = "steps"

    def run(self) -> None:
        """Tune, write the files, print the table.

        Raises ValueError for options that do not fit together, before any closed loop compiles.
        """
        begun, compiled = time.perf_counter(), Compiled.seconds
        self.check()
        check_results(self.output / FILES[0], self.resume, self.overwrite)
        optimizer = optimizer_of(self.optimizer, self.learning_rate)
        problem = problem_of_file(self) if self.robot is None else problem_of_robot(self)
        task, options = problem.task, self.record(problem)
        folder = run_folder(self.output, FILES, options, self.resume, self.overwrite)
        with folder as checkpoint, Compiling() as wait:
            loops = f"{len(task.x0s)} closed loops of {task.steps} time steps"
            print(f"{task.name}: {', '.join(self.tune)} from {loops} -> {self.output}", flush=True)
            wait.begin(f"closed loops of {task.name} and their gradient", programs=2)
            stopped = False
            try:
                run = task.tune(
                    optimizer=optimizer,
                    updates=self.updates,
                    batch=self.batch,
                    mode=self.mode,
                    seed=self.seed,
                    checkpoint=checkpoint,
                    progress=sys.stderr.isatty(),
                )
            except Interrupted as stop:
                print("\nstopped; writing the best of the steps that were done")
                run, stopped = stop.run, True
        compiling = Compiled.seconds - compiled
        seconds = {"compile": compiling, "run": time.perf_counter() - begun - compiling}
        found = WeightResults(self.output, problem, run, self.tune, options, self.tolerance)
        found.save(seconds, begun)
        if stopped:
            raise KeyboardInterrupt

    def record(self, problem: WeightProblem) -> dict[str, object]:
        """Return the options that determine the result, as JSON data, without --updates."""
        ignored = ("config", "output", "resume", "overwrite", "updates")
        found = {k: v for k, v in dataclasses.asdict(self).items() if k not in ignored}
        task = problem.task
        return as_json(
            {
                **found,
                "steps": task.steps,
                "dtype": task.dtype,
                "iterations": task.solver.iterations,
                "newton_steps": task.solver.newton_steps,
                **problem.options,
            }
        )
