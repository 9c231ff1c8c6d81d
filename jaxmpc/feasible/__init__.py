"""Feasible sets: from which initial states can all hard constraints be kept?

map_feasible_set     label points: proved feasible, proved infeasible, undecided -> FeasibleSetMap
sweep_into           label a grid into a store, block by block -> StoredMap
boundary             points and facets on the boundary along rays -> Boundary
feasible_polytope    the whole set as a Polytope
feasible_growth      how it grows with the horizon -> Growth
feasible_fraction    the share of states that are feasible, with a derivative
grid                 points of a regular grid
Labels               labels of points with their proofs
Picture              labels on evenly spaced lines of a stored map, to be drawn
"""

from jaxmpc.feasible.fraction import feasible_fraction
from jaxmpc.feasible.labels import Labels
from jaxmpc.feasible.map import FeasibleSetMap, map_feasible_set
from jaxmpc.feasible.polytope import Growth, feasible_growth, feasible_polytope
from jaxmpc.feasible.rays import Boundary, boundary
from jaxmpc.feasible.stored import Picture, StoredMap, sweep_into
from jaxmpc.grids import grid

__all__ = [
    "Boundary",
    "FeasibleSetMap",
    "Growth",
    "Labels",
    "Picture",
    "StoredMap",
    "boundary",
    "feasible_fraction",
    "feasible_growth",
    "feasible_polytope",
    "grid",
    "map_feasible_set",
    "sweep_into",
]
