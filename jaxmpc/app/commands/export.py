"""The command `jaxmpc export`."""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from jaxmpc.app import config as configs
from jaxmpc.app.commands.options import (
    POSITIVE,
    Horizon,
    Switch,
    Terminal,
    at_least,
    given_options,
    option,
    print_table,
)
from jaxmpc.checks import fail
from jaxmpc.explicit.regions import critical_regions
from jaxmpc.export.c_files import CFiles
from jaxmpc.export.c_law import export_explicit_c
from jaxmpc.export.c_solver import TOLERANCE, check_fixed_steps, export_c
from jaxmpc.export.jax_program import export_jax
from jaxmpc.export.step_search import choose_steps
from jaxmpc.qp.admm import ADMM


@dataclasses.dataclass(frozen=True)
class Export:
    """Write the controller as C code for machines without Python.

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

    def run(self) -> None:
        """Write the code and print the check. Raises ValueError for options and files that make no
        sense."""
        config = configs.load(self.config, given_options(self, "horizon", "terminal"), "info")
        lower, upper = config.state_range()
        if self.law == "steps" and self.plans and not np.isfinite([*lower, *upper]).all():
            fail("limits.x_min", "bounds not every state", "Give --plans 0 for no check")
        mpc, solver = config.build_controlled(), config.build_solver() or ADMM()
        chosen = self.law == "steps" and self.plans and config.solver is None
        if self.iterations is not None:
            solver = dataclasses.replace(solver, iterations=self.iterations)
        dtype: Literal["float32", "float64"] = "float32" if self.single else "float64"
        tolerance = TOLERANCE[dtype] if self.tolerance is None else self.tolerance
        rows: list[tuple[str, str]] = []
        if chosen:  # what is wrong with the files is said before the work
            CFiles.open(self.output, self.name, dtype, tolerance, TOLERANCE, self.overwrite)
            print("choosing steps along closed loops; some 20 s", file=sys.stderr)
            solver = choose_steps(
                mpc,
                lower,
                upper,
                iterations=self.iterations,
                plans=self.plans,
                tolerance=tolerance,
            )
        if self.law == "explicit":
            print("searching regions", file=sys.stderr)
            regions = critical_regions(mpc)
            paths = export_explicit_c(
                regions,
                self.output,
                name=self.name,
                dtype=dtype,
                tolerance=self.tolerance,
                overwrite=self.overwrite,
            )
            rows += [("regions", f"{len(regions)}, which fill the feasible set")]
        elif self.law == "jax":
            path = self.output / f"{self.name}.jax"
            paths = [export_jax(mpc, path, solver, dtype=dtype, overwrite=self.overwrite)]
        else:
            paths = export_c(
                mpc,
                self.output,
                solver,
                name=self.name,
                dtype=dtype,
                tolerance=tolerance,
                overwrite=self.overwrite,
            )
        print(f"{config.name}\n")
        kind = "" if self.law == "jax" else " of text"
        size = lambda path: f"{path.stat().st_size / 1024:.1f} KiB{kind}"
        rows = [(str(path), size(path)) for path in paths] + rows
        if self.law == "steps" and self.plans:
            print("checking closed loops; compiling, some 20 s", file=sys.stderr)
            found = check_fixed_steps(mpc, solver, lower, upper, self.plans, tolerance)
            share = 100 * found.reached / max(found.solvable, 1)
            given = "" if config.solver else ", chosen, as their penalties, for 99 % below"
            if config.solver is None and self.iterations is not None:
                given = ", given; their penalties are chosen for the share below"
            rows += [
                ("ADMM steps a call", f"{solver.iterations}{given}"),
                ("plans of closed loops", f"{found.plans}, {found.solvable} can be solved"),
                ("solved by the C code's steps", f"{share:.1f} % of these, to {tolerance:g}"),
                ("largest error of u where solved", f"{found.input_error:.2g}"),
                ("largest error of u at all of these", f"{found.input_error_any:.2g}"),
            ]
        print_table(rows, max(len(name) for name, _ in rows))
        if self.law == "jax":
            read = f'jax.export.deserialize(open("{paths[0]}", "rb").read())'
            print(f"\nNext, in Python: {read}.call")
        else:
            call = f"cc -std=c99 -O2 {self.name}.c {self.name}_example.c -lm -o example"
            print(f"\nNext: cd {self.output} && {call}")
