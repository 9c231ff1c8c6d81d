"""Terminal sets by name."""

import numpy as np

from jaxmpc.checks import fail
from jaxmpc.sets.box import Box
from jaxmpc.sets.ellipsoid import Ellipsoid
from jaxmpc.sets.invariant import invariant_ellipsoid, maximal_invariant_set
from jaxmpc.sets.polytope import Polytope
from jaxmpc.systems.riccati import LQR
from jaxmpc.systems.system import LinearSystem

TERMINAL_SETS = ("none", "box", "invariant", "ellipsoid")


def named_terminal_set(
    name: str,
    system: LinearSystem,
    law: LQR | None,
    states: Box | Polytope | None,
    inputs: Box | Polytope | None,
) -> Box | Polytope | Ellipsoid | None:
    """Return the terminal set of this name for x⁺ = A x + B u within the limits.

    "none": None. "box": the state limits. "invariant": the maximal invariant set of the LQR `law`.
    "ellipsoid": the largest level set of its cost inside the limits. Only the last two need the
    law.

    Raises ValueError for another name, for the last two without any limit, and as
    `maximal_invariant_set` and `invariant_ellipsoid` do.
    """
    if name not in TERMINAL_SETS:
        fail("terminal", f"{name!r}", f"Give a set, or one of {', '.join(TERMINAL_SETS)}")
    if name == "none":
        return None
    if name == "box":
        return states
    if states is None and inputs is None:
        fail("terminal", f"{name!r} without limits", "Give states or inputs, or 'none'")
    assert law is not None
    if name == "ellipsoid":
        return invariant_ellipsoid(system, law.K, law.P, states, inputs)
    free = Box(np.full(system.n, -np.inf), np.full(system.n, np.inf))
    return maximal_invariant_set(system, law.K, free if states is None else states, inputs)
