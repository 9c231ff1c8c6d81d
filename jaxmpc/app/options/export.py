"""Options of the command `jaxmpc export`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from jaxmpc.app.options.shared import POSITIVE, Horizon, Switch, Terminal, at_least, option


@dataclasses.dataclass(frozen=True)
class ExportOptions:
    """Write the controller as C code, or as a stored program of JAX, to run without jaxmpc.

    What it does
      --law steps writes C99 code without dependencies, allocation or branches on data but for the
      projections:
        NAME.h, NAME.c            NAME_reset, NAME_step: state in, input and status out
        NAME_sizes.h, _tables.h   the problem as data
        NAME_example.c            states from stdin, inputs to stdout, time of a call
      Each call takes the same number of ADMM steps, from the plan before. The number, and penalties
      for each kind of row, are chosen such that 99 % of the plans of closed loops are solved; then
      it runs other closed loops under the same law in Python and says how many are.
      --law explicit writes the optimal law as C99 code: its regions and a search tree, nothing to
      solve. For problems without soft rows, with few states and a short horizon.
      --law jax writes NAME.jax, plans of a batch of any size, which needs jax alone to run.

    How to start
      $ jaxmpc export
      $ cd controller && cc -std=c99 -O2 mpc.c mpc_example.c -lm -o example
      $ echo "0.5 0" | ./example
      $ jaxmpc export --config pendulum.toml --iterations 100 --single
      $ jaxmpc export --horizon 6 --law explicit

    How to read the output
      "solved by the C code's steps" is the share of the plans with a solution whose residuals the
      fixed steps bring below the tolerance. A section [solver] of the file, as jaxmpc tune solver
      writes it, is taken as it stands: take more --iterations there if that is too few. States
      without a plan are answered with the best iterate and status 2: see soft limits, cost.rho in
      the file.
      Exit code  0 done; 2 error (one line on stderr says which); 130 stopped by Ctrl-C.
    """

    config: Annotated[Path | None, option("FILE", "the built-in joint")] = None
    """TOML file with the problem."""
    output: Annotated[Path, option("FOLDER", "controller")] = Path("controller")
    """Folder for the code."""
    name: Annotated[str, option("NAME", "mpc")] = "mpc"
    """Begin of all names of files, functions and types."""
    horizon: Horizon = None
    """Prediction horizon, in steps of dt."""
    terminal: Terminal = None
    law: Literal["steps", "explicit", "jax"] = "steps"
    """What to write: ADMM steps in C, the explicit law in C, or a stored program of JAX."""
    iterations: Annotated[int | None, option("K", "from the file, else chosen"), at_least(1)] = None
    """ADMM steps a call, all of them always."""
    single: Switch = False
    """Numbers of type float instead of double."""
    tolerance: Annotated[float | None, option("EPS", "1e-6; with --single 1e-3"), POSITIVE] = None
    """Relative residuals below which the code says "solved"."""
    plans: Annotated[int, option("K", "1000"), at_least(0)] = 1000
    """Plans of the closed loops that check the law; 0 for no check."""
    overwrite: Switch = False
    """Replace the files where there are some."""

    keeps = ""
