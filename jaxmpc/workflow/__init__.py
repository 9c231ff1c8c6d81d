"""From limits to a tested controller.

design            choose terminal set, terminal cost and penalties -> Design
offline_report    proofs, simulations and failed hypotheses before use -> OfflineReport
"""

from jaxmpc.workflow.controller_design import design
from jaxmpc.workflow.offline_checks import offline_report

__all__ = [
    "design",
    "offline_report",
]
