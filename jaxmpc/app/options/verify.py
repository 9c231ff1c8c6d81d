"""Options of the command `jaxmpc verify`."""

import dataclasses
from typing import Annotated

import tyro

from jaxmpc.app.options.shared import Switch, at_least, option


@dataclasses.dataclass(frozen=True)
class VerifyOptions:
    """Prove every label of a stored map again, from what is stored alone.

    What it does
      Reads the map that jaxmpc sweep left in DIR, or the report of jaxmpc recursion, either with
      --robot or without. Metadata, configuration, data and summary.json are compared with their
      checksums and with each other, and the problem with the one that the configuration gives
      (that of a robot where its file is here). What is damaged is named in one line, and nothing is
      proved where data cannot be read. Else proves each label:
        feasible    the stored plan is rolled out from the state and keeps every limit
        infeasible  a half-space that no feasible state leaves, made anew, excludes the state
      by a roll-out and by weak duality of their own (jaxmpc/verify/exact.py, to be read by
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
    sample: Annotated[int, option("K", "1000"), at_least(0)] = 1000
    """Plans to roll out exactly without --exact, drawn at random."""
    seed: Annotated[int, option("K", "0"), at_least(0)] = 0
    """Seed of that draw."""

    keeps = ""
