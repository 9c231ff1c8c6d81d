"""Feasible sets: from which initial states can all hard constraints be kept?

map_feasible_set     label points: proved feasible, proved infeasible, undecided -> FeasibleSetMap
sweep_into           label a grid into a store, block by block -> StoredMap
boundary             points and facets on the boundary along rays -> Boundary
affine_policies      policies that keep all limits under disturbances -> AffinePolicies
feasible_polytope    the whole set as a Polytope
any_policy_polytope  the states that any policy can keep within limits under disturbances
feasible_growth      how it grows with the horizon -> Growth
sample_feasible_set  states that are uniform on the set, with proofs -> FeasibleSamples
feasible_fraction    the share of states that are feasible, with a derivative
grid                 points of a regular grid
StoredMap            the map that such a store holds, read block by block
"""

from jaxmpc.feasible.boundary_points import boundary
from jaxmpc.feasible.map import map_feasible_set
from jaxmpc.feasible.policy_hull import affine_policies
from jaxmpc.feasible.polytope_growth import (
    any_policy_polytope,
    feasible_growth,
    feasible_polytope,
)
from jaxmpc.feasible.smooth_fraction import feasible_fraction
from jaxmpc.feasible.stored import StoredMap, sweep_into
from jaxmpc.feasible.uniform_samples import sample_feasible_set
from jaxmpc.grids import grid

__all__ = [
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
