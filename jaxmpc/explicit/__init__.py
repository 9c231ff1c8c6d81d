"""The explicit law of an MPC or of any multi-parametric QP, and what follows from it.

critical_regions     all regions on which the optimum is affine -> CriticalRegions of Region
ParametricQP         a QP whose linear cost and limits are affine in parameters
parametric_qp        that of an MPC, with references among its parameters
exact_penalty        the least weight on slacks that keeps limits that can be kept -> ExactPenalty
Law                  plans, and the affine law on the region of a given state -> AffinePiece
"""

from jaxmpc.explicit.exact_penalties import exact_penalty
from jaxmpc.explicit.law_at_states import Law
from jaxmpc.explicit.parametric_program import ParametricQP, parametric_qp
from jaxmpc.explicit.regions import critical_regions

__all__ = [
    "Law",
    "ParametricQP",
    "critical_regions",
    "exact_penalty",
    "parametric_qp",
]
