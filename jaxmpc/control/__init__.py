"""First floor: linear systems, convex sets, linear-quadratic control, invariant sets.

Conventions, once for the whole floor: x+ = A x + B u + c, and feedback u = K x.
Sets describe themselves in the coordinates (and units) of the system they constrain.
"""

from jaxmpc.control.invariant import maximal_invariant_set
from jaxmpc.control.limits import JointLimits, joint_limits, output_limits
from jaxmpc.control.riccati import LQR, lqr
from jaxmpc.control.sets import Box, Ellipsoid, Polytope
from jaxmpc.control.system import LinearSystem

__all__ = [
    "LQR",
    "Box",
    "Ellipsoid",
    "JointLimits",
    "LinearSystem",
    "Polytope",
    "joint_limits",
    "lqr",
    "maximal_invariant_set",
    "output_limits",
]
