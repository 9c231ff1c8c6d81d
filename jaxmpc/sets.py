"""Sets of states and inputs, in the coordinates and units of the system that they constrain.

Box, Polytope, Ellipsoid         sets that contain, intersect, support, project
maximal_invariant_set            largest set that a law u = K x keeps within limits
invariant_ellipsoid              largest level set of x'Px that it keeps within limits
maximal_control_invariant_set    largest set that some input keeps -> ControlInvariantSet
predecessor                      states from which some input leads into a set
named_terminal_set               terminal set from its name
verify_terminal                  hypotheses of the stability theorems -> TerminalReport of Check
"""

from jaxmpc.control.invariant import (
    ControlInvariantSet,
    invariant_ellipsoid,
    maximal_control_invariant_set,
    maximal_invariant_set,
    predecessor,
)
from jaxmpc.control.named_terminal import named_terminal_set
from jaxmpc.control.sets import Box, Ellipsoid, Polytope
from jaxmpc.control.terminal import Check, TerminalReport, verify_terminal

__all__ = [
    "Box",
    "Check",
    "ControlInvariantSet",
    "Ellipsoid",
    "Polytope",
    "TerminalReport",
    "invariant_ellipsoid",
    "maximal_control_invariant_set",
    "maximal_invariant_set",
    "named_terminal_set",
    "predecessor",
    "verify_terminal",
]
