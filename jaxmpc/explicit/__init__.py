"""The explicit MPC law: piecewise affine in the state, and what follows from it.

critical_regions     all regions on which the plan is affine -> CriticalRegions of Region
exact_penalty        the least weight on slacks that keeps limits that can be kept -> ExactPenalty
Law                  plans, and the affine law on the region of a given state -> AffinePiece
"""

from jaxmpc.explicit.exact_penalties import exact_penalty
from jaxmpc.explicit.law_at_states import Law
from jaxmpc.explicit.regions import critical_regions

__all__ = [
    "Law",
    "critical_regions",
    "exact_penalty",
]
