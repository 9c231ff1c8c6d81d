"""Recursive feasibility: does a controller that has a plan now have one at the next sample?

recursive_feasibility    proofs, the worst counterexample, states lost -> RecursionReport
smallest_horizon         the least horizon with a proof -> SmallestHorizon
Claim, Counterexample    what the reports hold
"""

from jaxmpc.recursion.analysis import SmallestHorizon, recursive_feasibility, smallest_horizon
from jaxmpc.recursion.report import Claim, Counterexample, RecursionReport

__all__ = [
    "Claim",
    "Counterexample",
    "RecursionReport",
    "SmallestHorizon",
    "recursive_feasibility",
    "smallest_horizon",
]
