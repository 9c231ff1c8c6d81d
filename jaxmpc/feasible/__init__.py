"""Feasible sets: from which initial states can all hard constraints be kept?

map_feasible_set     label points: proved feasible, proved infeasible, undecided -> FeasibleSetMap
boundary             points and facets on the boundary along rays -> Boundary
feasible_polytope    the whole set as a Polytope
feasible_growth      how it grows with the horizon -> Growth
grid                 points of a regular grid
Labels               labels of points with their proofs
verify               prove the labels of a stored map again -> Verification
StagePenalties       learned penalties of the first stage of the labels
"""

from jaxmpc.feasible.candidates import StagePenalties
from jaxmpc.feasible.labels import Labels
from jaxmpc.feasible.map import FeasibleSetMap, grid, map_feasible_set
from jaxmpc.feasible.polytope import Growth, feasible_growth, feasible_polytope
from jaxmpc.feasible.rays import Boundary, boundary
from jaxmpc.feasible.verification import Verification, verify

__all__ = [
    "Boundary",
    "FeasibleSetMap",
    "Growth",
    "Labels",
    "StagePenalties",
    "Verification",
    "boundary",
    "feasible_growth",
    "feasible_polytope",
    "grid",
    "map_feasible_set",
    "verify",
]
