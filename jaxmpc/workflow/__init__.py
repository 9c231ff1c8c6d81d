"""From limits to a tested controller.

Design: `design` chooses terminal set, terminal cost and penalties, and returns a `Design`.
Test: `offline_report` collects proofs, simulations and failed hypotheses in an `OfflineReport`; its
`NominalLoops` are the closed loops that were simulated.
"""

from jaxmpc.workflow.controller_design import Design, design
from jaxmpc.workflow.nominal_closed_loops import NominalLoops
from jaxmpc.workflow.offline_checks import OfflineReport, offline_report

__all__ = [
    "Design",
    "NominalLoops",
    "OfflineReport",
    "design",
    "offline_report",
]
