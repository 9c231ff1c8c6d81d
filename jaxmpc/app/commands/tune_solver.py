"""The command `jaxmpc tune solver`: its options, files and table."""

import dataclasses
import sys
import time
import warnings
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np

from jaxmpc.app import config as configs
from jaxmpc.app.commands.options import (
    PART,
    POSITIVE,
    Horizon,
    Overwrite,
    ProblemFile,
    Resume,
    Terminal,
    at_least,
    given_options,
    option,
    print_table,
)
from jaxmpc.app.commands.tune_shared import TUNED, best_of_steps, optimizer_of, two_columns
from jaxmpc.app.plots.style import save
from jaxmpc.app.plots.tuning import plot_solver
from jaxmpc.checks import fail
from jaxmpc.files import as_json, versions, write_json
from jaxmpc.mpc.controller import solve
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.tightening import require_tightened
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.status import Status
from jaxmpc.tuning.result import CHECKPOINT, TuningRun, run_folder
from jaxmpc.tuning.solver import tune_solver
from jaxmpc.tuning.tasks import feasible_states, initial_range

FILES = ("solver.json", TUNED, "solver.png")
GIVEN = ADMM(newton_steps=0)
KEPT = "no step is better on the validation states: the default is kept"


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

    config: ProblemFile = None
    iterations: Annotated[int, option("K", "100"), at_least(1)] = 100
    """ADMM steps of each plan."""
    stages: Annotated[int, option("K", "4"), at_least(1)] = 4
    """Number of penalties for each row, each used for an equal part of the steps, in turn."""
    groups: Annotated[Literal["step", "row"], option("{step,row}", "step")] = "step"
    """step: five penalties along the horizon for each limit, linear between them.
    row: one for each limit and step of the horizon."""
    updates: Annotated[int, option("K", "200"), at_least(0)] = 200
    """Steps of the optimizer."""
    count: Annotated[int, option("B", "1024"), at_least(16)] = 1024
    """Number of feasible initial states, validation included."""
    batch: Annotated[int, option("B", "32"), at_least(1)] = 32
    """Number of states of each step, drawn again each time."""
    validation: Annotated[float, option("FRACTION", "0.25"), PART] = 0.25
    """Fraction of the initial states in the validation set."""
    optimizer: Annotated[str | None, option("NAME", "adam, its rate falling to 3 %")] = None
    """Optimizer of optax, by name: adam, adamw, sgd, rmsprop, lion, ..."""
    learning_rate: Annotated[float | None, option("X", "0.1"), POSITIVE] = None
    """Learning rate, in log rho; needs --optimizer."""
    lower: Annotated[tuple[float, ...] | None, option("X [X ...]", "state limits")] = None
    """Lower ends of the initial states, one number a state."""
    upper: Annotated[tuple[float, ...] | None, option("X [X ...]", "state limits")] = None
    """Upper ends of the initial states."""
    horizon: Horizon = None
    terminal: Terminal = None
    seed: Annotated[int, option("K", "0"), at_least(0)] = 0
    """Seed of initial states and batches."""
    output: Annotated[Path, option("DIR", "jaxmpc-solver")] = Path("jaxmpc-solver")
    """Folder for the files; created if absent."""
    resume: Resume = False
    overwrite: Overwrite = False

    keeps = "steps"

    def run(self) -> None:
        """Tune, write the files, print the table.

        Raises ValueError for options that do not fit together, before anything compiles.
        """
        begun = time.perf_counter()
        if self.iterations % self.stages:
            fail("--iterations", f"{self.iterations} for {self.stages} stages", "Use a multiple")
        if self.learning_rate is not None and self.optimizer is None:
            fail("--learning-rate", "given without --optimizer", "Name one, such as adam")
        rate = self.learning_rate or 0.1
        optimizer = None if self.optimizer is None else optimizer_of(self.optimizer, rate)
        overrides = given_options(self, "horizon", "terminal")
        config = configs.load(self.config, overrides, "tune")
        limits, mpc = config.state_limits(), config.build_controlled()
        require_tightened(mpc, "penalties of the solver")
        ends = initial_range(config.state_range(), self.lower, self.upper)
        options = self.record(config)
        with (
            run_folder(self.output, FILES, options, self.resume, self.overwrite) as checkpoint,
            warnings.catch_warnings(),
        ):
            warnings.filterwarnings("ignore", "tune_solver", UserWarning)
            x0s, without_plan = feasible_states(mpc, *ends, self.count, self.seed, limits)
            for_validation = max(2, round(self.validation * self.count))
            test = x0s[-for_validation:]
            what = f"penalties of {self.iterations} ADMM steps from {len(x0s):,} states"
            print(f"{config.name}: {what} -> {self.output}", flush=True)
            learning = time.perf_counter()
            run = best_of_steps(
                lambda: tune_solver(
                    mpc,
                    x0s[:-for_validation],
                    solver=GIVEN,
                    optimizer=optimizer,
                    validation=test,
                    checkpoint=checkpoint,
                    progress=sys.stderr.isatty(),
                    **given_options(
                        self, "iterations", "stages", "groups", "updates", "batch", "seed"
                    ),
                )
            )
        seconds = time.perf_counter() - learning
        given = dataclasses.replace(GIVEN, iterations=self.iterations)
        worst = largest_residuals(mpc, test, (given, run.solver))
        infeasible = without_plan + round(run.after["infeasible"])
        save_run(self.output, config, run, options, worst, infeasible, seconds)
        rows = [
            *solver_rows(run, worst.shape[1], infeasible),
            ("learning", f"{seconds:.1f} s, compiler included"),
            ("safeguard", "passed: the tuned penalties are used" if run.improved else KEPT),
            ("files", " ".join(str(self.output / name) for name in (*FILES, CHECKPOINT))),
            ("total", f"{time.perf_counter() - begun:.1f} s with set-up and files"),
        ]
        print_table(rows, 13)
        if run.history and run.history.interrupted:
            raise KeyboardInterrupt

    def record(self, config: configs.Config) -> dict[str, Any]:
        """Return the options that determine the result, as JSON data."""
        ignored = {"config", "output", "resume", "overwrite"}
        if self.optimizer is not None:  # the schedule of the default knows the number of steps
            ignored.add("updates")
        found = {k: v for k, v in dataclasses.asdict(self).items() if k not in ignored}
        return as_json({**found, "problem": config.to_dict("tune")})


def save_run(
    folder: Path,
    config: configs.Config,
    run: TuningRun,
    options: dict[str, Any],
    worst: np.ndarray,
    infeasible: int,
    seconds: float,
) -> None:
    """Write tuned.toml, solver.json and solver.png.

    worst (2, B): the largest residual of the validation states with the solver given and the one
    found. infeasible: number of states drawn that have no plan. seconds: of learning.
    """
    h, rho, alpha = run.history, *penalties(run)
    solver = configs.SolverSection(
        iterations=run.solver.admm_steps(),
        newton_steps=0,
        alpha=alpha,
        rho=float(rho) if rho.ndim == 0 else tuple(map(tuple, np.atleast_2d(rho).tolist())),
    )
    (folder / TUNED).write_text(dataclasses.replace(config, solver=solver).to_toml())
    result = {"improved": run.improved, "before": run.before, "after": run.after}
    document = {
        "name": config.name,
        "options": options,
        "finished": not (h and h.interrupted),
        "result": result | {"alpha": alpha},
        "validation_states": worst.shape[1],
        "states_without_plan": infeasible,
        "learning_seconds": seconds,
        "loss": h.loss if h else [],
        "gradient_norm": h.gradient_norm if h else [],
        "accepted": h.accepted if h else [],
        "solved": h.validation_numbers["solved"] if h else [],
        "residual": h.validation_numbers["residual"] if h else [],
        "versions": versions(),
    }
    write_json(folder / FILES[0], document)
    words = "tuned" if run.improved else "default kept, no step is better"
    title = f"{config.name}: {solver.iterations} ADMM steps, {words}"
    save(plot_solver(run, worst[0], worst[1], 1e-6, title), folder / "solver.png")


def solver_rows(run: TuningRun, states: int, infeasible: int) -> list[tuple[str, str]]:
    """Return the rows of the table with the default and the result."""
    first, last, (rho, alpha) = run.before, run.after, penalties(run)
    solved = (f"{100 * numbers['solved']:.2f} %" for numbers in (first, last))
    spread = "-".join(f"{end:.3g}" for end in sorted({rho.min(), rho.max()}))
    residual = (f"{numbers['residual']:.3g}" for numbers in (first, last))
    return [
        ("", two_columns(("default", "as written"))),
        ("solved", two_columns(solved, f"of {states} states")),
        ("residual", two_columns(residual, "median")),
        ("rho", two_columns(("1", spread))),
        ("alpha", two_columns(("1.6", f"{alpha:.4g}"))),
        ("infeasible", f"{infeasible:,} states drawn have no plan: left out"),
    ]


def penalties(run: TuningRun) -> tuple[np.ndarray, float]:
    """Return rho and alpha of the solver found."""
    return np.asarray(run.solver.rho, float), float(np.asarray(run.solver.alpha))


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
