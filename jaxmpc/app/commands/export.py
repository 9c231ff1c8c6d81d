"""The command `jaxmpc export`."""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from jaxmpc.app import config as configs
from jaxmpc.app.commands.options import (
    Horizon,
    Switch,
    Terminal,
    check_counts,
    check_positive,
    given_options,
    option,
    print_table,
)
from jaxmpc.checks import fail
from jaxmpc.export.c_code import TOLERANCE, export_c
from jaxmpc.export.check import check_fixed_steps
from jaxmpc.qp.admm import ADMM


@dataclasses.dataclass(frozen=True)
class Export:
    """Write the controller as C code for machines without Python.

    What it does
      Writes C99 code without dependencies, allocation or branches on data but for the projections:
        NAME.h, NAME.c            NAME_reset, NAME_step: state in, input and status out
        NAME_sizes.h, _tables.h   the problem as data
        NAME_example.c            states from stdin, inputs to stdout, time of a call
      Each call takes the same number of ADMM steps, from the plan before. Then it runs closed loops
      under the same law in Python and says how many plans those steps solve.

    How to start
      $ jaxmpc export
      $ cd controller && cc -std=c99 -O2 mpc.c mpc_example.c -lm -o example
      $ echo "0.5 0" | ./example
      $ jaxmpc export --config pendulum.toml --iterations 100 --single

    How to read the output
      "solved by the C code's steps" is the share of the plans with a solution whose residuals the
      fixed steps bring below the tolerance: take more --iterations, or penalties learned by
      jaxmpc tune penalties (section [solver] of the file), where that is too few. States without a
      plan are answered with the best iterate and status 2: see soft limits, cost.rho in the file.
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
    iterations: Annotated[int | None, option("K", "from the file, else 50")] = None
    """ADMM steps a call, all of them always."""
    single: Switch = False
    """Numbers of type float instead of double."""
    tolerance: Annotated[float | None, option("EPS", "1e-6; with --single 1e-3")] = None
    """Relative residuals below which the code says "solved"."""
    samples: Annotated[int, option("K", "1000")] = 1000
    """Samples of the closed loops that check the law; 0 for no check."""
    overwrite: Switch = False
    """Replace the files where there are some."""

    keeps = ""

    def run(self) -> None:
        """Write the code and print the check. Raises ValueError for options and files that make no
        sense."""
        check_counts(self, iterations=1, samples=0)
        check_positive(self, "tolerance")
        config = configs.load(self.config, given_options(self, "horizon", "terminal"), "info")
        lower, upper = config.state_range()
        if self.samples and not np.isfinite([*lower, *upper]).all():
            fail("limits.x_min", "bounds not every state", "Give --samples 0 for no check")
        mpc, solver = config.build_controlled(), config.build_solver() or ADMM()
        if self.iterations is not None:
            solver = dataclasses.replace(solver, iterations=self.iterations)
        dtype: Literal["float32", "float64"] = "float32" if self.single else "float64"
        tolerance = TOLERANCE[dtype] if self.tolerance is None else self.tolerance
        paths = export_c(
            mpc, self.output, solver, name=self.name, dtype=dtype, tolerance=tolerance,
            overwrite=self.overwrite,
        )  # fmt: skip
        print(f"{config.name}\n")
        rows = [(str(path), f"{path.stat().st_size / 1024:.1f} KiB of text") for path in paths]
        if self.samples:
            print("checking closed loops; compiling, some 20 s", file=sys.stderr)
            found = check_fixed_steps(mpc, solver, lower, upper, self.samples, tolerance)
            share = 100 * found.reached / max(found.solvable, 1)
            rows += [
                ("closed-loop samples", f"{found.samples}, {found.solvable} have a plan"),
                ("solved by the C code's steps", f"{share:.1f} % of these, to {tolerance:g}"),
                ("largest error of u where solved", f"{found.input_error:.2g}"),
                ("largest error of u at all of these", f"{found.input_error_any:.2g}"),
            ]
        print_table(rows, max(len(name) for name, _ in rows))
        call = f"cc -std=c99 -O2 {self.name}.c {self.name}_example.c -lm -o example"
        print(f"\nNext: cd {self.output} && {call}")
