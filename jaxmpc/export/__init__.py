"""Controllers for machines without Python, or without this library.

export_c              the solver with a fixed number of steps as C99 code
export_explicit_c     the explicit law of `critical_regions` as C99 code, with a search tree
export_jax            plans of a batch of any size as a program that needs jax alone
choose_steps          iterations and penalties with which fixed steps solve most plans -> ADMM
check_fixed_steps     closed loops under the law of `export_c` beside precise plans
                      -> ClosedLoopCheck
"""

from jaxmpc.export.c_law import export_explicit_c
from jaxmpc.export.c_solver import ClosedLoopCheck, check_fixed_steps, export_c
from jaxmpc.export.jax_program import export_jax
from jaxmpc.export.step_search import choose_steps
from jaxmpc.names import suggest_names

__all__ = [
    "ClosedLoopCheck",
    "check_fixed_steps",
    "choose_steps",
    "export_c",
    "export_explicit_c",
    "export_jax",
]

suggest_names(__name__)
