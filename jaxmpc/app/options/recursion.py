"""Options of the command `jaxmpc recursion`."""

import dataclasses
from pathlib import Path
from typing import Annotated

from jaxmpc.app.options.shared import (
    POSITIVE,
    End,
    Horizon,
    ProblemFile,
    Switch,
    Terminal,
    at_least,
    option,
)


@dataclasses.dataclass(frozen=True)
class RecursionOptions:
    """Once this controller has a plan, will it always have one? Proof, or counterexample.

    What it does
      An MPC without a suitable terminal set can steer itself into a state from which no input
      keeps its limits. Three claims about the set X_N of states that have a plan over N steps:
        strong  every first input of a plan within the limits leads back into X_N
        law     the optimal first input does (what one wants of the controller)
        weak    some first input does
      Each is proved, refuted by a counterexample, or open, with the reason; strong implies law,
      law implies weak. Where the law is not proved, closed loops from a grid of states show which
      states are lost, and when.
      Without a file the problem is one robot joint: x = (q, dq), torque u, 20 steps of 0.01 s.
      An option given here wins over the file.

    How to start
      $ jaxmpc recursion --horizon 4
      $ jaxmpc recursion --config pendulum.toml --terminal invariant --output checks/a

    How long it takes
      Each stage is announced on stderr as it begins, with the seconds spent so far.
        theorem, linear programs   seconds for up to three states; minutes for hundreds of facets
        critical regions           seconds for hundreds (two states); minutes for thousands (four).
                                   The worst counterexample and the states lost are then exact
        its proof                  some 4 s, most of it compiling
        closed loops               some 12 s of compiling, then seconds
        search                     only without all regions: 20 s of compiling, then a minute
      --seconds bounds all of these together. Compiling, one step of all closed loops and a
      linear program cannot be interrupted: what compiles is left out where it does not fit.
      Start-up and the picture take some 5 s more.

    How to read the output, all in the folder of --output
      recursion.png   Blue: kept for all steps. Dark red to light orange: lost at step 1, 2, ...
                      Grey: infeasible from the start. Arrow: the worst counterexample, from x
                      to the next state, with the half-space (line) that proves it infeasible;
                      the right panel enlarges it. Two states only.
      summary.json    The claims with reasons, the counterexample, areas, counts, configuration.
                      jaxmpc verify DIR proves labels and counterexample again.
      recursion.npz   state, label (1 feasible, -1 infeasible, 0 undecided), input (the optimal
                      first input), next_state, lost_at (step at which the problem is proved
                      infeasible; 0 never, -1 infeasible at the start, -2 undecided), and
                      facet_normals, facet_offsets of X_N. Opens with numpy.load(path).
      Exit code       0 done, for any answer; 2 error (one line on stderr says which); 130
                      stopped by Ctrl-C (nothing is kept).

    With --robot NAME or FILE: the prediction and the robot
      Such as jaxmpc recursion --robot pendulum --horizon 40 --steps 100
      As in jaxmpc sweep --help, with another prediction: the linear closed loop has a plan at each
      of --steps time steps (of the robot's control period). The robot does the same where each
      plan of its own loop is solved without violating a limit. Same files, and robot_map.png.

    What the TOML file holds
      The sections [system], [limits], [cost], [mpc] of jaxmpc sweep --help, and
      [recursion]  all optional: steps, grid, lower, upper, regions, seconds
    """

    config: ProblemFile = None
    robot: Annotated[str | None, option("NAME|FILE", "none, a linear system")] = None
    """Map a robot instead, linear prediction against nonlinear closed loop."""
    output: Annotated[Path, option("DIR", "jaxmpc-recursion")] = Path("jaxmpc-recursion")
    """Folder for the files; made where absent."""
    horizon: Horizon = None
    terminal: Terminal = None
    steps: Annotated[int | None, option("K", "from the file, else 20; robots 100")] = None
    """Length of the closed loops."""
    grid: Annotated[
        tuple[int, ...] | None,
        option(
            "K [K ...]",
            "none where the law is proved, else 64 64 over X_N; above 3 states: random states; "
            "robots 32 32",
        ),
    ] = None
    """Points along each state, ends included, even where the law is proved."""
    lower: End = None
    """Lower end of the grid along each state, in its units."""
    upper: End = None
    """Upper end of the grid along each state, in its units."""
    axes: Annotated[
        tuple[str, ...] | None, option("AXIS [AXIS ...]", "those of the first joint")
    ] = None
    """With --robot: coordinates to map, by name or index from 0."""
    fixed: Annotated[tuple[float, ...] | None, option("X [X ...]", "home")] = None
    """With --robot: values of the other coordinates, in their order."""
    regions: Annotated[int | None, option("K", "from the file, else 2000")] = None
    """Critical regions of the law to enumerate at most; 0: none."""
    seconds: Annotated[float | None, option("S", "from the file, else 60"), POSITIVE] = None
    """Time for all of it; what is not settled by then is open. With --smallest half is for that."""
    search: Annotated[bool, option(None, "on")] = True
    """Without all regions, look for a counterexample by gradient ascent, beside the samples."""
    smallest: Annotated[int | None, option("N", "off"), at_least(1)] = None
    """Look also for the smallest horizon, up to N, that is proved recursively feasible."""
    overwrite: Switch = False
    """Replace the results in --output."""
    resume: Switch = False
    """With --robot: resume the map in --output."""

    @property
    def keeps(self) -> str:
        """Return what is kept of a run that is stopped."""
        return "chunks" if self.robot else ""
