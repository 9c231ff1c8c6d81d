"""Feasible sets: from which initial states can all hard constraints be kept?

map_feasible_set     label points: proved feasible, proved infeasible, undecided -> FeasibleSetMap
FeasibilityProblem   the hard constraints of an MPC, and what their points stand for
Labels               labels of points, with what proves them
sweep_into           label a grid into a store, block by block -> StoredMap
boundary             points and facets on the boundary along rays -> Boundary
affine_policies      policies that keep all limits under disturbances -> AffinePolicies
feasible_polytope    the whole set as a Polytope
any_policy_polytope  the states that any policy can keep within limits under disturbances
feasible_growth      how it grows with the horizon -> Growth
sample_feasible_set  states that are uniform on the set, with proofs -> FeasibleSamples
feasible_fraction    the share of states that are feasible, with a derivative
grid                 points of a regular grid
StoredMap            the map that such a store holds, read block by block -> Picture
"""

from jaxmpc.feasible.boundary_points import boundary
from jaxmpc.feasible.map import FeasibleSetMap, map_feasible_set
from jaxmpc.feasible.pipeline import Labels
from jaxmpc.feasible.policy_hull import AffinePolicies, affine_policies
from jaxmpc.feasible.polytope_growth import (
    Growth,
    any_policy_polytope,
    feasible_growth,
    feasible_polytope,
)
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.rays import Boundary
from jaxmpc.feasible.smooth_fraction import feasible_fraction
from jaxmpc.feasible.stored import Picture, StoredMap, sweep_into
from jaxmpc.feasible.uniform_samples import FeasibleSamples, sample_feasible_set
from jaxmpc.grids import grid
from jaxmpc.names import suggest_names

__all__ = [
    "AffinePolicies",
    "Boundary",
    "FeasibilityProblem",
    "FeasibleSamples",
    "FeasibleSetMap",
    "Growth",
    "Labels",
    "Picture",
    "StoredMap",
    "affine_policies",
    "any_policy_polytope",
    "boundary",
    "feasible_fraction",
    "feasible_growth",
    "feasible_polytope",
    "grid",
    "map_feasible_set",
    "sample_feasible_set",
    "sweep_into",
]

suggest_names(__name__)
