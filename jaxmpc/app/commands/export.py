"""The command `jaxmpc export`."""

import dataclasses
import shlex
import sys
from pathlib import Path
from typing import Any, Literal

import numpy as np

from jaxmpc.app import config as configs
from jaxmpc.app.commands.outcome import Outcome
from jaxmpc.app.options.export import ExportOptions
from jaxmpc.app.options.shared import (
    given_options,
    print_table,
)
from jaxmpc.checks import fail
from jaxmpc.explicit.regions import CriticalRegions, critical_regions
from jaxmpc.export.c_files import CFiles
from jaxmpc.export.c_law import export_explicit_c
from jaxmpc.export.c_solver import TOLERANCE, ClosedLoopCheck, check_fixed_steps, export_c
from jaxmpc.export.jax_program import export_jax
from jaxmpc.export.step_search import choose_steps
from jaxmpc.files import as_json
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.admm import ADMM


def _regions(config: configs.Config, mpc: MPC) -> CriticalRegions:
    """Return the critical regions of a file's problem. Raises ValueError, naming its keys, where
    there are none to export."""
    try:
        regions = critical_regions(mpc, **config.references())
    except ValueError as error:
        raise config.origin.error(config.renamed(str(error))) from None
    if regions.window is not None:
        what = "leave the feasible set unbounded, and a table of regions ends"
        raise config.origin.error(f"limits.x_min, x_max: {what}. Bound every state")
    if regions.tied:
        key, cure = "mpc.terminal", "Take a terminal set with volume"
        if mpc.terminal_set is None:
            key, cure = "limits.x_min", "Let x_min be below x_max, and rows leave room"
        what = "makes the feasible set flat, and no state that is measured lies in it"
        raise config.origin.error(f"{key}: {what}. {cure}")
    return regions


class Export(ExportOptions):
    """The command: its options, and `run`."""

    def run(self) -> Outcome:
        """Write the code and print the check. Raises ValueError for options and files that make no
        sense."""
        config = configs.load(self.config, given_options(self, "horizon", "terminal"), "info")
        ends, checked = config.state_range(), self.law == "steps" and self.plans > 0
        if checked and not np.isfinite(ends).all():
            fail("limits.x_min", "bounds not every state", "Give --plans 0 for no check")
        mpc, solver = config.build_controlled(), config.build_solver() or ADMM()
        if self.law == "explicit" and self.iterations is not None:
            what = f"{self.iterations} where --law explicit has regions and takes no steps"
            fail("--iterations", what, "Leave it out, or take --law steps")
        if self.iterations is not None:
            solver = dataclasses.replace(solver, iterations=self.iterations)
        tolerance = TOLERANCE[self.dtype] if self.tolerance is None else self.tolerance
        if self.law != "jax":  # what is wrong with the files is said before the work
            CFiles.open(self.output, self.name, self.dtype, tolerance, TOLERANCE, self.overwrite)
        if checked and config.solver is None:
            solver = self.chosen_steps(mpc, ends, tolerance, config.references())
        paths, rows, summary = self.written(config, mpc, solver, tolerance)
        if config.references():
            said = "an argument of the function: what the file says is not in the code"
            if self.law == "explicit":
                said = "that of the file: the function takes none"
            rows.append(("reference", said))
        print(f"{config.name}\n")
        kind = "" if self.law == "jax" else " of text"
        size = lambda path: f"{path.stat().st_size / 1024:.1f} KiB{kind}"
        rows = [(str(path), size(path)) for path in paths] + rows
        summary |= {"files": [str(path) for path in paths]}
        if checked:
            print("checking closed loops; compiling, some 20 s", file=sys.stderr)
            found = check_fixed_steps(
                mpc, solver, *ends, self.plans, tolerance, **config.references()
            )
            summary |= dataclasses.asdict(found)
            rows += self.check_rows(config, found, solver, tolerance)
        print_table(rows, max(len(name) for name, _ in rows))
        if self.law == "jax":
            read = f'jax.export.deserialize(open("{paths[0]}", "rb").read())'
            print(f"\nNext, in Python: {read}.call")
        else:
            call = f"cc -std=c99 -O2 {self.name}.c {self.name}_example.c -lm -o example"
            print(f"\nNext: cd {shlex.quote(str(self.output))} && {call}")
        return Outcome(summary=as_json(summary))

    @property
    def dtype(self) -> Literal["float32", "float64"]:
        """Return the precision of the code."""
        return "float32" if self.single else "float64"

    def chosen_steps(
        self, mpc: MPC, ends: tuple[np.ndarray, np.ndarray], tolerance: float, references: Any
    ) -> ADMM:
        """Return the solver that `choose_steps` finds from states between these ends."""
        what = "penalties" if self.iterations else "steps and penalties"
        print(f"choosing {what} along closed loops; compiling, some 20 s", file=sys.stderr)
        return choose_steps(
            mpc,
            *ends,
            iterations=self.iterations,
            plans=self.plans,
            tolerance=tolerance,
            progress=True,
            **references,
        )

    def written(
        self, config: configs.Config, mpc: MPC, solver: ADMM, tolerance: float
    ) -> tuple[list[Path], list[tuple[str, str]], dict[str, Any]]:
        """Write the files of --law, and return them, rows of the table and what the summary has."""
        summary: dict[str, Any] = {"name": config.name, "law": self.law}
        given: dict[str, Any] = {"dtype": self.dtype, "overwrite": self.overwrite}
        if self.law == "jax":
            path = self.output / f"{self.name}.jax"
            return [export_jax(mpc, path, solver, **given)], [], summary
        given |= {"name": self.name}
        if self.law == "explicit":
            print("searching regions", file=sys.stderr)
            regions = _regions(config, mpc)
            paths = export_explicit_c(regions, self.output, tolerance=self.tolerance, **given)
            rows = [("regions", f"{len(regions)}, which fill the feasible set")]
            return paths, rows, summary | {"regions": len(regions)}
        paths = export_c(mpc, self.output, solver, tolerance=tolerance, **given)
        return paths, [], summary | {"iterations": solver.iterations, "tolerance": tolerance}

    def check_rows(
        self, config: configs.Config, found: ClosedLoopCheck, solver: ADMM, tolerance: float
    ) -> list[tuple[str, str]]:
        """Return the rows of the table on what `check_fixed_steps` found."""
        share = 100 * found.reached / max(found.solvable, 1)
        given = "" if config.solver else ", chosen, as their penalties, for 99 % below"
        if config.solver is None and self.iterations is not None:
            given = ", given; their penalties are chosen for the share below"
        elif config.solver is None and share < 99:
            given = ", chosen, as their penalties; 99 % need more --iterations"
        units = set(config.system.input_units or ())
        unit = f" {units.pop()}" if len(units) == 1 else ""
        return [
            ("ADMM steps a call", f"{solver.iterations}{given}"),
            ("plans of closed loops", f"{found.plans}, {found.solvable} can be solved"),
            ("solved by the C code's steps", f"{share:.1f} % of these, to {tolerance:g}"),
            ("largest error of u where solved", f"{found.input_error:.2g}{unit}"),
            ("largest error of u at all of these", f"{found.input_error_any:.2g}{unit}"),
        ]
