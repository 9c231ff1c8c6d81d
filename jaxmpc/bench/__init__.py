"""Measurements of jaxmpc beside other solvers, as `jaxmpc bench` makes them.

FAMILIES, family     MPC problems by name, with feasible initial states
problem, box_states  a family's problem alone; random states of its box
RIVALS, Rival        other solvers, each where it is installed
Batch, residuals     QPs that share P and A; primal residual, dual residual and gap of answers
condensed, pair_of   the QPs of an MPC problem on the host, a Condensed; z and y of plans
Case, Row, measure   one comparison, and what it found of each solver
Ceilings, Work       what the machine can do, and what a program asks of it
Growth, Point        time and memory against batch, horizon and number of states
"""

from jaxmpc.bench.cases import Case, Row, condensed, measure, pair_of
from jaxmpc.bench.families import FAMILIES, box_states, family, problem
from jaxmpc.bench.growth import Growth, Point
from jaxmpc.bench.rivals import RIVALS, Batch, Rival, residuals
from jaxmpc.bench.roofline import Ceilings, Work
from jaxmpc.mpc.condense import Condensed

__all__ = [
    "FAMILIES",
    "RIVALS",
    "Batch",
    "Case",
    "Ceilings",
    "Condensed",
    "Growth",
    "Point",
    "Rival",
    "Row",
    "Work",
    "box_states",
    "condensed",
    "family",
    "measure",
    "pair_of",
    "problem",
    "residuals",
]
