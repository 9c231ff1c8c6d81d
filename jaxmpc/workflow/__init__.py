"""From limits to a tested controller.

Design: `design` chooses terminal set, terminal cost and penalties, and returns a `Design`;
`named_terminal_set` builds a terminal set from its name.
Test: `offline_report` collects in an `OfflineReport` what is proved, what was only tried, and what
fails; its `NominalLoops` are closed loops that were simulated.
"""

from jaxmpc.workflow.controller_design import TERMINALS, Design, design, named_terminal_set
from jaxmpc.workflow.nominal_loops import NominalLoops
from jaxmpc.workflow.offline_test import OfflineReport, offline_report

__all__ = [
    "TERMINALS",
    "Design",
    "NominalLoops",
    "OfflineReport",
    "design",
    "named_terminal_set",
    "offline_report",
]
