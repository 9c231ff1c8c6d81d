"""Sets of states and inputs, in the coordinates and units of the system that they constrain.

Box, Polytope, Zonotope, Ellipsoid  sets that contain, intersect, support, project
BasicSet, LinearSet              what all of them can, and what all but ellipsoids can
FullPart                         a flat set in coordinates in which it has volume
Frame                            half-spaces in coordinates of like size about a point inside
maximal_invariant_set            largest set that u = K x keeps within limits -> InvariantSet
invariant_ellipsoid              the same, a level set of x'Px -> InvariantEllipsoid
minimal_robust_invariant_set     least set that u = K x keeps under disturbances, from outside
                                 -> MinimalInvariantSet
maximal_control_invariant_set    largest set that some input keeps -> ControlInvariantSet
predecessor                      states from which some input leads into a set
reachable_sets                   sets that a system runs through, forward or backward
set_difference                   points of a set in none of others -> PolytopeUnion
plot                             pictures of sets in two and three dimensions
joint_limits, output_limits      limits of robot joints and of outputs -> JointLimits, Box, Polytope
named_terminal_set               terminal set from its name
verify_terminal                  hypotheses of the stability theorems -> TerminalReport of Check
"""

from jaxmpc.names import suggest_names
from jaxmpc.sets.control_invariant import ControlInvariantSet, maximal_control_invariant_set
from jaxmpc.sets.convex_sets import Box, Ellipsoid, Polytope, Zonotope
from jaxmpc.sets.drawing import plot
from jaxmpc.sets.geometry import Frame
from jaxmpc.sets.invariant import (
    InvariantEllipsoid,
    InvariantSet,
    invariant_ellipsoid,
    maximal_invariant_set,
    named_terminal_set,
)
from jaxmpc.sets.limits import JointLimits, joint_limits, output_limits
from jaxmpc.sets.linear_sets import FullPart, LinearSet
from jaxmpc.sets.minimal_invariant import MinimalInvariantSet, minimal_robust_invariant_set
from jaxmpc.sets.operations import BasicSet
from jaxmpc.sets.predecessors import predecessor
from jaxmpc.sets.reachability import reachable_sets
from jaxmpc.sets.terminal_hypotheses import Check, TerminalReport, verify_terminal
from jaxmpc.sets.unions import PolytopeUnion, set_difference

__all__ = [
    "BasicSet",
    "Box",
    "Check",
    "ControlInvariantSet",
    "Ellipsoid",
    "Frame",
    "FullPart",
    "InvariantEllipsoid",
    "InvariantSet",
    "JointLimits",
    "LinearSet",
    "MinimalInvariantSet",
    "Polytope",
    "PolytopeUnion",
    "TerminalReport",
    "Zonotope",
    "invariant_ellipsoid",
    "joint_limits",
    "maximal_control_invariant_set",
    "maximal_invariant_set",
    "minimal_robust_invariant_set",
    "named_terminal_set",
    "output_limits",
    "plot",
    "predecessor",
    "reachable_sets",
    "set_difference",
    "verify_terminal",
]

suggest_names(__name__)
