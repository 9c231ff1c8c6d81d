"""The command `jaxmpc tune solver`: its options, files and table."""

import dataclasses
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from jaxmpc.app import config as configs
from jaxmpc.app.commands.tune_shared import TUNED, best_of_steps, optimizer_of, two_columns
from jaxmpc.app.options.shared import (
    given_options,
    print_table,
)
from jaxmpc.app.options.tune_solver import TuneSolverOptions
from jaxmpc.app.plots.style import save
from jaxmpc.app.plots.tuning import plot_solver
from jaxmpc.checks import fail
from jaxmpc.files import as_json, versions, write_json
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.tightening import require_tightened
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.status import Status
from jaxmpc.tuning.result import CHECKPOINT, TuningRun, run_folder
from jaxmpc.tuning.solver import ADMM_ALONE, largest_residuals, tune_solver
from jaxmpc.tuning.tasks import feasible_states, initial_range

FILES = ("solver.json", TUNED, "solver.png")
DEFAULT_KEPT = "no step is better on the validation states: the default is kept"


class TuneSolver(TuneSolverOptions):
    """The command: its options, and `run`."""

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
                    solver=ADMM_ALONE,
                    optimizer=optimizer,
                    validation=test,
                    checkpoint=checkpoint,
                    progress=sys.stderr.isatty(),
                    **config.references(),
                    **given_options(
                        self, "iterations", "stages", "groups", "updates", "batch", "seed"
                    ),
                )
            )
        seconds = time.perf_counter() - learning
        given = dataclasses.replace(ADMM_ALONE, iterations=self.iterations)
        worst = residuals_of_feasible(mpc, test, (given, run.solver), **config.references())
        infeasible = without_plan + round(run.after["infeasible"])
        save_run(self.output, config, run, options, worst, infeasible, seconds)
        rows = [
            *solver_rows(run, worst.shape[1], infeasible),
            ("learning", f"{seconds:.1f} s, compiler included"),
            ("safeguard", "passed: the tuned penalties are used" if run.improved else DEFAULT_KEPT),
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

    worst (2, B): the largest residual of the validation states, over its tolerance, with the solver
    given and the one found. infeasible: number of states drawn that have no plan. seconds: of
    learning.
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
    save(plot_solver(run, worst[0], worst[1], title), folder / "solver.png")


def solver_rows(run: TuningRun, states: int, infeasible: int) -> list[tuple[str, str]]:
    """Return the rows of the table with the default and the result."""
    first, last, (rho, alpha) = run.before, run.after, penalties(run)
    solved = (f"{100 * numbers['solved']:.2f} %" for numbers in (first, last))
    spread = "-".join(f"{end:.3g}" for end in sorted({rho.min(), rho.max()}))
    residual = (f"{numbers['residual']:.3g}" for numbers in (first, last))
    return [
        ("", two_columns(("default", "as written"))),
        ("solved", two_columns(solved, f"of {states} states")),
        ("residual", two_columns(residual, "median, of its tolerance")),
        ("rho", two_columns((f"{run.settings['given_rho']:.3g}", spread))),
        ("alpha", two_columns((f"{float(run.initial['alpha']):.4g}", f"{alpha:.4g}"))),
        ("infeasible", f"{infeasible:,} states drawn have no plan: left out"),
    ]


def penalties(run: TuningRun) -> tuple[np.ndarray, float]:
    """Return rho and alpha of the solver found."""
    return np.asarray(run.solver.rho, float), float(np.asarray(run.solver.alpha))


def residuals_of_feasible(
    mpc: MPC, states: np.ndarray, solvers: tuple[ADMM, ADMM], **references: Any
) -> np.ndarray:
    """Return the largest residual over its tolerance (2, B) with each solver, of the states that
    neither proves infeasible. references: as in `solve`."""
    found = [largest_residuals(mpc, states, solver, **references) for solver in solvers]
    feasible = np.all([status != Status.PRIMAL_INFEASIBLE for status, _ in found], axis=0)
    return np.array([worst for _, worst in found])[:, feasible]
