"""Recursive feasibility: does a controller that has a plan now have one at the next time step?

recursive_feasibility    proofs, the worst counterexample, states lost -> RecursionReport
smallest_horizon         the least horizon with a proof -> SmallestHorizon
Claim, Counterexample    what the reports hold
"""

from jaxmpc.recursion.analysis import recursive_feasibility
from jaxmpc.recursion.claims import Claim, Counterexample
from jaxmpc.recursion.horizons import SmallestHorizon, smallest_horizon
from jaxmpc.recursion.report import RecursionReport

__all__ = [
    "Claim",
    "Counterexample",
    "RecursionReport",
    "SmallestHorizon",
    "recursive_feasibility",
    "smallest_horizon",
]
