"""Recursive feasibility: does a controller that has a plan now have one at the next time step?

recursive_feasibility    proofs, the worst counterexample, states lost -> RecursionReport
                         of Claim, Counterexample and SampledLoops
smallest_horizon         the least horizon with a proof -> SmallestHorizon
save_report              both as files, which `jaxmpc verify` proves again
"""

from jaxmpc.names import suggest_names
from jaxmpc.recursion.analysis import recursive_feasibility, smallest_horizon
from jaxmpc.recursion.counterexamples import Counterexample, SampledLoops
from jaxmpc.recursion.proofs import Claim
from jaxmpc.recursion.report import RecursionReport, SmallestHorizon, save_report

__all__ = [
    "Claim",
    "Counterexample",
    "RecursionReport",
    "SampledLoops",
    "SmallestHorizon",
    "recursive_feasibility",
    "save_report",
    "smallest_horizon",
]

suggest_names(__name__)
