"""Controllers for machines without Python: the solver with a fixed number of steps as C99 code.

export_c              write the code of a controller
check_fixed_steps     closed loops under the same law beside precise plans -> ClosedLoopCheck
"""

from jaxmpc.export.c_code import export_c
from jaxmpc.export.check import ClosedLoopCheck, check_fixed_steps

__all__ = ["ClosedLoopCheck", "check_fixed_steps", "export_c"]
