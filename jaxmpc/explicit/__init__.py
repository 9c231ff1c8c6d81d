"""The explicit law of an MPC or of any multi-parametric QP, and what follows from it.

critical_regions     all regions on which the optimum is affine -> CriticalRegions of Region
ParametricQP         a QP whose linear cost and limits are affine in parameters
parametric_qp        that of an MPC, with references among its parameters
exact_penalty        the least weight on slacks that keeps limits that can be kept -> ExactPenalty
Law                  plans, and the affine law on the region of a given state -> LawPlans,
                     AffinePiece
prove_network        the share of a set from which a network leads into a set -> NetworkProof
"""

from jaxmpc.explicit.exact_penalties import ExactPenalty, exact_penalty
from jaxmpc.explicit.law_at_states import AffinePiece, Law, LawPlans
from jaxmpc.explicit.network_proof import NetworkProof, prove_network
from jaxmpc.explicit.parametric_program import ParametricQP, parametric_qp
from jaxmpc.explicit.regions import CriticalRegions, Region, critical_regions
from jaxmpc.names import suggest_names

__all__ = [
    "AffinePiece",
    "CriticalRegions",
    "ExactPenalty",
    "Law",
    "LawPlans",
    "NetworkProof",
    "ParametricQP",
    "Region",
    "critical_regions",
    "exact_penalty",
    "parametric_qp",
    "prove_network",
]

suggest_names(__name__)
