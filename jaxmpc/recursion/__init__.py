"""Recursive feasibility: does a controller that has a plan now have one at the next time step?

recursive_feasibility    proofs, the worst counterexample, states lost -> RecursionReport
smallest_horizon         the least horizon with a proof -> SmallestHorizon
save_report              both as files, which `jaxmpc verify` proves again
"""

from jaxmpc.recursion.analysis import recursive_feasibility, smallest_horizon
from jaxmpc.recursion.report import save_report

__all__ = [
    "recursive_feasibility",
    "save_report",
    "smallest_horizon",
]
