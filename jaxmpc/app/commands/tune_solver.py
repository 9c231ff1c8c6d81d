"""The command `jaxmpc tune solver`: its options, files and table."""

import dataclasses
import json
import sys
import time
import warnings
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np
import optax

from jaxmpc.app import config as configs
from jaxmpc.app.commands.options import (
    Horizon,
    Switch,
    Terminal,
    check_counts,
    check_positive,
    option,
)
from jaxmpc.app.commands.tuning import (
    CHECKPOINT,
    TUNED,
    check_validation,
    feasible_states,
    open_run,
    optimizer_of,
    overwriting,
    problem_file,
    start_range,
)
from jaxmpc.app.plots.style import save
from jaxmpc.app.plots.tuning import plot_solver
from jaxmpc.app.report import report_error
from jaxmpc.checks import fail, require_memory
from jaxmpc.files import versions, write_json
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.solve import solve
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.status import Status
from jaxmpc.tuning.result import Interrupted, TuningRun
from jaxmpc.tuning.solver import tune_solver

FILES = ("solver.json", TUNED, "solver.png")


@dataclasses.dataclass(frozen=True)
class TuneSolver:
    """Tune the penalties of the solver (ADMM), so that fewer steps solve an MPC problem.

    What it does
      ADMM computes each plan by a fixed number of steps. For how many states these suffice depends
      on its penalties rho, one for each limit and stage, and on its over-relaxation alpha. Draws
      initial states, runs the steps, and moves rho and alpha down the gradient of the number of
      digits by which the residuals are too large. Some of the states (--validation) are the
      validation set: the result is the best of all steps on these; where none is better than the
      default (rho = 1, alpha = 1.6) the table says so and the default is kept.
      ADMM converges to the same plan for every rho: a bad rho costs steps, not correctness.
      Without a file the problem is one robot joint: x = (q, dq), torque u, 20 steps of 0.01 s.

    How to start
      $ jaxmpc tune solver
      $ jaxmpc tune solver --config pendulum.toml --iterations 60 --count 1024 --output tuned/p
      The joint takes less than a minute on two idle CPU cores.

    How to read the table
      solved      validation states whose residuals (primal, dual, gap) are all within 1e-6 after
                  --iterations steps, without Newton steps; with the default and with the result
      residual    median over these states of the largest residual
      infeasible  states drawn within the limits from which no plan keeps the limits, by linear
                  programs; neither counted above nor learned from
      learning    seconds, compiling included
      safeguard   whether the tuned penalties are used or the default is kept

    Files, all in the folder of --output
      tuned.toml      The whole problem with [solver] iterations, rho, alpha, newton_steps = 0, for
                      --config of jaxmpc tune weights; in Python Config.build_solver() makes an
                      ADMM of it for jm.solve, jm.Controller, jm.solve_many.
      solver.json     Options, the numbers of the table, loss of every step, versions.
      solver.png      rho by kind of limit, step of the horizon and stage; distribution of the
                      residuals before and after.
      checkpoint.npz  The state of the run after every step, for --resume.
      Ctrl-C          Stops, and writes all files from the best of the finished steps; --resume
                      goes on from there.
      Exit code       0 done, better or not; 2 error (one line on stderr says which); 130 stopped
                      by Ctrl-C.

    What the TOML file holds
      The sections [system], [limits], [cost], [mpc] of jaxmpc sweep --help. A [solver] in it is
      replaced.
    """

    config: Annotated[Path | None, option("FILE", "the built-in joint")] = None
    """TOML file with the problem."""
    iterations: Annotated[int, option("K", "100")] = 100
    """ADMM steps of each plan."""
    stages: Annotated[int, option("K", "4")] = 4
    """Number of penalties for each row, each used for an equal part of the steps, in turn."""
    groups: Annotated[Literal["step", "row"], option("{step,row}", "step")] = "step"
    """step: five penalties along the horizon for each limit, linear between them.
    row: one for each limit and step of the horizon."""
    updates: Annotated[int, option("K", "200")] = 200
    """Steps of the optimizer."""
    count: Annotated[int, option("B", "1024")] = 1024
    """Number of feasible initial states, validation included."""
    batch: Annotated[int, option("B", "32")] = 32
    """Number of states of each step, drawn again each time."""
    validation: Annotated[float, option("FRACTION", "0.25")] = 0.25
    """Fraction of the initial states in the validation set."""
    optimizer: Annotated[str | None, option("NAME", "adam, its rate falling to 3 %")] = None
    """Optimizer of optax, by name: adam, adamw, sgd, rmsprop, lion, ..."""
    learning_rate: Annotated[float | None, option("X", "0.1")] = None
    """Learning rate, in log rho; needs --optimizer."""
    lower: Annotated[tuple[float, ...] | None, option("X [X ...]", "state limits")] = None
    """Lower ends of the initial states, one number a state."""
    upper: Annotated[tuple[float, ...] | None, option("X [X ...]", "state limits")] = None
    """Upper ends of the initial states."""
    horizon: Horizon = None
    """Prediction horizon, in steps of dt."""
    terminal: Terminal = None
    """Terminal set, as in jaxmpc sweep."""
    seed: Annotated[int, option("K", "0")] = 0
    """Seed of initial states and batches."""
    output: Annotated[Path, option("DIR", "jaxmpc-solver")] = Path("jaxmpc-solver")
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
        begun = time.perf_counter()
        try:
            config, mpc, (lower, upper) = self.prepare()
            states, dropped = feasible_states(
                mpc, config.state_limits(), lower, upper, self.count, self.seed
            )
            kept = max(2, round(self.validation * self.count))
            train, test = states[:-kept], states[-kept:]
            print(
                f"{config.name}: penalties of {self.iterations} ADMM steps from {len(states):,} "
                f"states -> {self.output}", flush=True,
            )  # fmt: skip
            given, learning, stopped = ADMM(newton_steps=0), time.perf_counter(), False
            found = self.learned(mpc, train, test, given)
        except ValueError as error:
            return report_error(error)
        except Interrupted as stop:
            print("\nstopped; writing the best of the steps that were done")
            found, stopped = stop.run, True
        seconds = time.perf_counter() - learning
        given = dataclasses.replace(given, iterations=self.iterations)
        worst = largest_residuals(mpc, test, (given, found.solver))
        self.save(config, found, worst, dropped, seconds)
        print(self.report_text(found, worst.shape[1], dropped, seconds))
        print(f"  {'total':<13} {time.perf_counter() - begun:.1f} s with set-up and files")
        if stopped:
            raise KeyboardInterrupt
        return 0

    def learned(
        self, mpc: MPC, train: np.ndarray, test: np.ndarray, given: ADMM
    ) -> TuningRun:  # fmt: skip
        """Return the run of `tune_solver`."""
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "tune_solver", UserWarning)
            return tune_solver(
                mpc, train, self.iterations, stages=self.stages, groups=self.groups,
                solver=given, updates=self.updates, optimizer=self.stepper(), batch=self.batch,
                validation=test, seed=self.seed, checkpoint=self.output / CHECKPOINT,
                progress=sys.stderr.isatty(),
            )  # fmt: skip

    def prepare(self) -> tuple[configs.Config, MPC, tuple[np.ndarray, np.ndarray]]:
        """Return the problem and the ends of the initial states; open the folder.

        Nothing compiles. Raises ValueError for options that do not fit together.
        """
        check_counts(self, iterations=1, stages=1, updates=0, count=16, batch=1, seed=0)
        check_validation(self)
        check_positive(self, "learning_rate")
        if self.iterations % self.stages:
            fail("--iterations", f"{self.iterations} for {self.stages} stages", "Use a multiple")
        if self.learning_rate is not None and self.optimizer is None:
            fail("--learning-rate", "given without --optimizer", "Name one, such as adam")
        self.stepper(np.zeros(1))
        config = problem_file(self)
        require_memory("--count", 8 * self.count * len(config.system.A), "Tune on fewer states")
        ends = start_range(config, self.lower, self.upper, 1.0)
        mpc = config.build_controlled()
        ignored = ("config", "output", "resume", "overwrite", "updates")
        options = {k: v for k, v in dataclasses.asdict(self).items() if k not in ignored}
        if self.optimizer is None:  # its schedule knows the number of steps
            options["updates"] = self.updates
        options = json.loads(json.dumps({**options, "problem": config.to_dict("tune")}))
        open_run(self.output, FILES, options, self.resume, self.overwrite)
        return config, mpc, ends

    def stepper(self, tried: Any = None) -> optax.GradientTransformation | None:
        """Return the optimizer; None for the default one."""
        if self.optimizer is None:
            return None
        return optimizer_of(self.optimizer, self.learning_rate or 0.1, tried)

    def save(
        self, config: configs.Config, found: TuningRun, worst: np.ndarray, dropped: int,
        seconds: float,
    ) -> None:  # fmt: skip
        """Write the files."""
        rho = np.asarray(found.solver.rho, float)
        solver = configs.SolverSection(
            iterations=found.solver.admm_steps(), newton_steps=0,
            alpha=float(np.asarray(found.solver.alpha)),
            rho=float(rho) if rho.ndim == 0 else tuple(map(tuple, np.atleast_2d(rho).tolist())),
        )  # fmt: skip
        text = dataclasses.replace(config, solver=solver).to_toml()
        (self.output / TUNED).write_text(text)
        h = found.history
        numbers = {
            "improved": found.improved, "before": found.before, "after": found.after,
            "alpha": solver.alpha,
        }  # fmt: skip
        finite = lambda v: [float(x) if np.isfinite(x) else None for x in v]
        document = {
            "name": config.name,
            "options": json.loads((self.output / FILES[0]).read_text())["options"],
            "finished": not (h and h.interrupted), "result": numbers,
            "validation_states": worst.shape[1],
            "states_without_plan": dropped + round(found.after["infeasible"]),
            "learning_seconds": seconds,
            "loss": finite(h.loss) if h else [],
            "gradient_norm": finite(h.gradient_norm) if h else [],
            "accepted": h.accepted.tolist() if h else [],
            "solved": finite(h.validation_numbers["solved"]) if h else [],
            "residual": finite(h.validation_numbers["residual"]) if h else [],
            "versions": versions(),
        }  # fmt: skip
        write_json(self.output / FILES[0], document)
        words = "tuned" if found.improved else "default kept, no step is better"
        title = f"{config.name}: {self.iterations} ADMM steps, {words}"
        figure = plot_solver(found, worst[0], worst[1], 1e-6, title)
        save(figure, self.output / "solver.png")

    def report_text(self, found: TuningRun, count: int, dropped: int, seconds: float) -> str:
        """Return the result as a table of text."""
        row = lambda name, a, b, more="": f"  {name:<13} {a:>12} {b:>12}  {more}".rstrip()
        first, last = found.before, found.after
        percent = lambda numbers: f"{100 * numbers['solved']:.2f} %"
        alpha = float(np.asarray(found.solver.alpha))
        rho = np.asarray(found.solver.rho, float)
        spread = (
            f"{rho.min():.3g}" if rho.min() == rho.max() else f"{rho.min():.3g}-{rho.max():.3g}"
        )
        kept = (
            "passed: the tuned penalties are used"
            if found.improved
            else "no step is better on the validation states: the default is kept"
        )
        out = dropped + round(found.after["infeasible"])
        return "\n".join([
            row("", "default", "as written"),
            row("solved", percent(first), percent(last), f"of {count} states"),
            row("residual", f"{first['residual']:.3g}", f"{last['residual']:.3g}", "median"),
            row("rho", "1", spread), row("alpha", "1.6", f"{alpha:.4g}"),
            f"  {'infeasible':<13} {out:,} states drawn have no plan: left out",
            f"  {'learning':<13} {seconds:.1f} s, compiler included",
            f"  {'safeguard':<13} {kept}",
            f"  {'files':<13} "
            + " ".join(str(self.output / name) for name in (*FILES, CHECKPOINT)),
        ])  # fmt: skip


def largest_residuals(mpc: MPC, states: np.ndarray, solvers: tuple[ADMM, ADMM]) -> np.ndarray:
    """Return the largest residual (2, B) with each solver, of the states that neither proves
    infeasible."""
    shape = np.broadcast_shapes(*(np.shape(solver.rho) for solver in solvers))
    wide = [
        dataclasses.replace(s, rho=np.broadcast_to(np.asarray(s.rho, float), shape))
        for s in solvers
    ]  # one program for both
    with jax.enable_x64(True):
        each = jax.jit(lambda s: jax.vmap(lambda x: solve(mpc, x, solver=s))(states))
        plans = [jax.tree.map(np.asarray, each(solver)) for solver in wide]
    worst = [np.max([p.primal_residual, p.dual_residual, np.abs(p.gap)], axis=0) for p in plans]
    feasible = np.all([p.status != Status.PRIMAL_INFEASIBLE for p in plans], axis=0)
    return np.array(worst)[:, feasible]
