"""Linear systems x⁺ = A x + B u + c and their linear-quadratic regulator u = K x.

LinearSystem    a system, also from continuous time
lqr             the linear-quadratic regulator -> LQR
"""

from jaxmpc.systems.riccati import lqr
from jaxmpc.systems.system import LinearSystem

__all__ = ["LinearSystem", "lqr"]
