"""Quadratic programs: minimise ½z'Pz + q'z subject to l ≤ Az ≤ u.

QP, solve_qp         a problem, and its solution -> QPSolution (`duals`: -> Duals)
ADMM                 settings of the solver
Status               how a solve ended, with a sentence for each
Bounds               the constraints of a QP on Az: intervals, hard or soft, and balls
feasibility_margin   by how much all limits can be tightened, or must be widened
"""

from jaxmpc.names import suggest_names
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.problem import QP, Bounds, Duals, QPSolution
from jaxmpc.qp.solve import feasibility_margin, solve_qp
from jaxmpc.qp.status import Status

__all__ = [
    "ADMM",
    "QP",
    "Bounds",
    "Duals",
    "QPSolution",
    "Status",
    "feasibility_margin",
    "solve_qp",
]

suggest_names(__name__)
