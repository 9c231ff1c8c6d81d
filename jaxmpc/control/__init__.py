"""Linear systems x⁺ = A x + B u + c with feedback u = K x; their sets are in `jaxmpc.sets`.

LinearSystem                 a system, also from continuous time
lqr                          the linear-quadratic regulator -> LQR
equilibrium                  state and input at which a system rests
joint_limits, output_limits  limits of robot joints and of outputs -> JointLimits, Box, Polytope
"""

from jaxmpc.control.equilibrium import equilibrium
from jaxmpc.control.limits import JointLimits, joint_limits, output_limits
from jaxmpc.control.riccati import LQR, lqr
from jaxmpc.control.system import LinearSystem

__all__ = [
    "LQR",
    "JointLimits",
    "LinearSystem",
    "equilibrium",
    "joint_limits",
    "lqr",
    "output_limits",
]
