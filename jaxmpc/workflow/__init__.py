"""From limits to a tested controller.

design            choose terminal set, terminal cost and penalties -> Design
offline_report    proofs, simulations and failed hypotheses before use -> OfflineReport
                  with NominalLoops
"""

from jaxmpc.names import suggest_names
from jaxmpc.workflow.controller_design import Design, design
from jaxmpc.workflow.offline_checks import NominalLoops, OfflineReport, offline_report

__all__ = [
    "Design",
    "NominalLoops",
    "OfflineReport",
    "design",
    "offline_report",
]

suggest_names(__name__)
