"""Options of the command `jaxmpc info`."""

import dataclasses
from pathlib import Path
from typing import Annotated

from jaxmpc.app.options.shared import POSITIVE, Horizon, ProblemFile, Terminal, at_least, option


@dataclasses.dataclass(frozen=True)
class InfoOptions:
    """What is known of this controller before it runs: an offline test report.

    What it does
      Prints, for a constrained linear MPC:
        Problem                 sizes, and each limit with the steps at which it holds
        Feasible set            proved bounds of its volume (up to three states), sampled labels
        Recursive feasibility   the claims of jaxmpc recursion, proved, refuted or open
        Exact penalty           the L1 weight above which soft limits are kept wherever they can be
        Terminal ingredients    each hypothesis of the theorems on recursive feasibility (1) and
                                stability (3): holds or not, by how much
        Closed loops            nominal runs from feasible states: violations, Lyapunov decrease
      Soft limits count as hard, but for the closed loops.
      Without a file the problem is one robot joint: x = (q, dq), torque u, 20 steps of 0.01 s.
      An option given here wins over the file.

    How to start
      $ jaxmpc info
      $ jaxmpc info --config pendulum.toml --terminal invariant --html pendulum.html

    How long it takes
      Each stage is announced on stderr as it begins, with the seconds spent so far.
        terminal ingredients, recursive feasibility, exact penalty: seconds for two states, minutes
        for four; map of the feasible set: some 15 s of compiling, then seconds; closed loops: 20 s
        of compiling, then seconds.
      --seconds bounds all of these together; start-up takes some 3 s more. Compiling and a linear
      program cannot be interrupted: what compiles is left out, and the report says so, where it
      does not fit.

    How to read the output
      "proved" rests on linear programs or certificates with the tolerance that is named, "refuted"
      on a counterexample; closed loops are simulated, not proved. Nothing is written to disk
      but the page of --html.
      Exit code  0 done, for any answers; 2 error (one line on stderr says which); 130 stopped by
                 Ctrl-C.

    What the TOML file holds
      The sections [system], [limits], [cost], [mpc] of jaxmpc sweep --help, and [reference], the
      set-point of the closed loops: the report says whether it rests inside the limits.
    """

    config: ProblemFile = None
    horizon: Horizon = None
    terminal: Terminal = None
    steps: Annotated[int, option("K", "50"), at_least(2)] = 50
    """Length of the closed loops."""
    loops: Annotated[int, option("K", "128"), at_least(1)] = 128
    """Number of the closed loops."""
    seconds: Annotated[float, option("S", "120"), POSITIVE] = 120.0
    """Time for all of it; claims not settled by then are open."""
    html: Annotated[Path | None, option("FILE", "none")] = None
    """Write the report as a page too, with a picture of a feasible set of two states."""

    keeps = ""
