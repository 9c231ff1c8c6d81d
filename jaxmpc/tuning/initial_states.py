"""Initial states to tune from: uniform ones that have a plan."""

from collections.abc import Sequence

import numpy as np

from jaxmpc.checks import fail, require_memory
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.mpc.condense import Inequalities
from jaxmpc.mpc.problem import MPC
from jaxmpc.sets.box import Box
from jaxmpc.sets.lp import Program
from jaxmpc.sets.polytope import Polytope

# The most random states that are drawn for each state wanted.
TRIES = 10


def initial_range(
    limits: tuple[np.ndarray, np.ndarray],
    lower: Sequence[float] | None = None,
    upper: Sequence[float] | None = None,
    spread: float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends (n,) of the initial states: as given, else this fraction of the limits (n,)
    about their middle. Raises ValueError where they are not finite, or lower not below upper."""
    low, high = limits
    for name, given in (("lower", lower), ("upper", upper)):
        if given is not None and len(given) != len(low):
            fail(name, f"has {len(given)} numbers", f"The problem has {len(low)} states")
    bounded = np.isfinite(low) & np.isfinite(high)
    low, high = np.where(bounded, low, np.nan), np.where(bounded, high, np.nan)
    middle, half = (high + low) / 2, (high - low) / 2
    low = middle - spread * half if lower is None else np.asarray(lower, float)
    high = middle + spread * half if upper is None else np.asarray(upper, float)
    if not np.all(np.isfinite([low, high])):
        fail("lower, upper", "the state limits do not bound all states", "Give both ends")
    if np.any(low >= high):
        fail("lower", f"{low.tolist()} not below upper {high.tolist()}", "Lower must be below")
    return low, high


def feasible_states(
    mpc: MPC,
    lower: np.ndarray,
    upper: np.ndarray,
    count: int,
    seed: int = 0,
    limits: Box | Polytope | None = None,
) -> tuple[np.ndarray, int]:
    """Return uniform states (count, n) of a range that have a plan, and how many drawn had none.

    Linear programs decide whether a state has a plan, without compiling: all hard rows are linear
    but those of an ellipsoidal terminal set, which are left out. limits: states outside a Polytope
    are not drawn. Raises ValueError where too few have a plan.
    """
    require_memory("count", 8 * count * mpc.system.n, "Tune on fewer states")
    rows = Inequalities.of(FeasibilityProblem.of(mpc).condensed)
    random, without_plan = np.random.default_rng(seed), 0
    found: list[np.ndarray] = []
    for _ in range(TRIES * count):
        x = random.uniform(lower, upper)
        if isinstance(limits, Polytope) and np.any(np.asarray(limits.H) @ x > np.asarray(limits.h)):
            continue
        b = rows.b - rows.D @ np.pad(x, (0, rows.D.shape[1] - len(x)))
        if len(b) and Program(rows.C, b).empty:
            without_plan += 1
            continue
        found.append(x)
        if len(found) == count:
            return np.array(found), without_plan
    cure = "Draw from a smaller region: spread, lower, upper"
    fail("initial states", f"{len(found)} of {TRIES * count} drawn have a plan", cure)
