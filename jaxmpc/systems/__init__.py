"""Linear systems x⁺ = A x + B u + c and their linear-quadratic regulator u = K x.

LinearSystem    a system, also from continuous time
lqr             the linear-quadratic regulator -> LQR
"""

from jaxmpc.names import suggest_names
from jaxmpc.systems.riccati import LQR, lqr
from jaxmpc.systems.system import LinearSystem

__all__ = [
    "LQR",
    "LinearSystem",
    "lqr",
]

suggest_names(__name__)
