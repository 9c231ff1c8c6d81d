"""Options of the command `jaxmpc tune solver`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from jaxmpc.app.options.shared import (
    OPEN_FRACTION,
    POSITIVE,
    Horizon,
    Overwrite,
    ProblemFile,
    Resume,
    Terminal,
    at_least,
    option,
)


@dataclasses.dataclass(frozen=True)
class TuneSolverOptions:
    """Tune the penalties of the solver (ADMM), so that fewer steps solve an MPC problem.

    What it does
      ADMM computes each plan by a fixed number of steps. For how many states these suffice depends
      on its penalties rho, one for each limit and stage, and on its over-relaxation alpha. Draws
      initial states, runs the steps, and moves rho and alpha down the gradient of the number of
      digits by which the residuals are too large. Some of the states (--validation) are the
      validation set: the result is the best of all steps on these; where none is better than the
      default (one rho, by the numbers of inputs and rows, alpha = 1.9) the table says so and the
      default is kept.
      ADMM converges to the same plan for every rho: a bad rho costs steps, not correctness.
      Without a file the problem is one robot joint: x = (q, dq), torque u, 20 steps of 0.01 s.

    How to start
      $ jaxmpc tune solver
      $ jaxmpc tune solver --config pendulum.toml --iterations 60 --count 1024 --output tuned/p
      The joint takes less than a minute on two idle CPU cores.

    How to read the table
      solved      validation states whose residuals (primal, dual, gap) are all within 1e-6 after
                  --iterations steps, without Newton steps; with the default and with the result
      residual    median over these states of the largest residual, in parts of its tolerance
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
    groups: Annotated[
        Literal["step", "row"],
        option(
            "{step,row}",
            "step",
            "step: five penalties along the horizon for each limit, linear between them. row: one "
            "for each limit and step of the horizon.",
        ),
    ] = "step"
    updates: Annotated[int, option("K", "200"), at_least(0)] = 200
    """Steps of the optimizer."""
    count: Annotated[int, option("B", "1024"), at_least(16)] = 1024
    """Number of feasible initial states, validation included."""
    batch: Annotated[int, option("B", "32"), at_least(1)] = 32
    """Number of states of each step, drawn again each time."""
    validation: Annotated[float, option("FRACTION", "0.25"), OPEN_FRACTION] = 0.25
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
