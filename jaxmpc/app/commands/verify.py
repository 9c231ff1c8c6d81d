"""The command `jaxmpc verify`."""

import dataclasses
import time
from typing import Annotated

import tyro

from jaxmpc.app.commands.options import Switch, check_counts, option, print_table
from jaxmpc.feasible.verification import Verification, find_store, verify

# Failures that are printed.
SHOWN = 10


@dataclasses.dataclass(frozen=True)
class Verify:
    """Prove every label of a stored map again, from what is stored alone.

    What it does
      Reads the map that jaxmpc sweep left in DIR, or the report of jaxmpc recursion, either with
      --robot or without, and compares the data with their checksums. Then proves each label:
        feasible    the stored plan is rolled out from the state and keeps every limit
        infeasible  a half-space that no feasible state leaves, made anew, excludes the state
      by a roll-out and by weak duality of their own (jaxmpc/feasible/exact_check.py, to be read by
      a sceptic). Half-spaces are evaluated in exact arithmetic, plans in float64 with a bound on
      its rounding, and exactly where that leaves a doubt and on a sample. Of a recursion report
      the counterexample is proved too, and each state that counts as lost after one step.
      Nothing is written.

    How to start
      $ jaxmpc sweep && jaxmpc verify jaxmpc-sweep
      $ jaxmpc verify maps/a --exact

    How to read the output
      verified      Labels that are proved, and how many of them in exact arithmetic.
      least margin  The least room that a plan leaves to a limit, in the units of that limit. Plans
                    of states near the boundary touch a limit: 0 is no fault.
      Exit code     0 all labels are proved; 1 something fails, with the states where; 2 error.
    """

    directory: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """Folder that holds sweep.zarr, robot_map.zarr or recursion.npz, one of these, or the URL of a
    store."""
    exact: Switch = False
    """Roll out all plans in exact arithmetic."""
    sample: Annotated[int, option("K", "1000")] = 1000
    """Plans to roll out exactly without --exact, drawn at random."""
    seed: Annotated[int, option("K", "0")] = 0
    """Seed of that draw."""

    keeps = ""

    def run(self) -> int:
        """Verify, print the table, return the exit code. Raises ValueError where there is no
        map."""
        check_counts(self, sample=0, seed=0)
        path, begun = find_store(self.directory), time.perf_counter()
        found = verify(
            path, exact=self.exact, sample=self.sample, seed=self.seed, progress=True
        )  # fmt: skip
        decided = found.labels.get("feasible", 0) + found.labels.get("infeasible", 0)
        word = "verified" if decided else "nothing to verify, no state is labelled"
        print(f"{path}: {word if found.passed else 'NOT VERIFIED'}")
        rows = [(name, f"{count:>12,}") for name, count in found.labels.items()]
        rows += [("verified", f"{found.verified:>12,} of {decided:,}, {found.exactly:,} exactly")]
        print_table(
            [*rows, *_extremes(found), ("total", f"{time.perf_counter() - begun:.2f} s")], 12
        )
        for problem in found.problems[:SHOWN]:
            print(f"  FAILS: {problem}")
        for index, reason in list(found.failures.items())[:SHOWN]:
            print(f"  FAILS: state {index} {reason}")
        more = len(found.problems[SHOWN:]) + len(list(found.failures)[SHOWN:])
        if more:
            print(f"  and {more:,} more")
        return 0 if found.passed else 1


def _extremes(found: Verification) -> list[tuple[str, str]]:
    """Return the rows of the least margin and the least excess, where there are any."""
    values = {"least margin": found.margin, "least excess": found.excess}
    return [(name, f"{value:.3g}") for name, value in values.items() if value < float("inf")]
