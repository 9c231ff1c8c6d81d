"""The smallest horizon at which a problem is proved recursively feasible."""

from dataclasses import replace

import numpy as np

from jaxmpc.checks import whole
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.mpc.problem import MPC
from jaxmpc.pytrees import record
from jaxmpc.recursion.claims import Claim
from jaxmpc.recursion.proofs import settle_by_regions, settle_claims
from jaxmpc.recursion.time_budget import Budget


@record
class SmallestHorizon:
    """The least horizon at which the law is proved recursively feasible, None where none was found.

    strong: the least at which every feasible first input is proved to stay (None: none). reasons:
    the claim about the law at each horizon looked at, up to max_horizon.
    """

    horizon: int | None
    strong: int | None
    reasons: dict[int, Claim]
    max_horizon: int

    def __str__(self) -> str:
        """Return the smallest horizon with its reason, or that none is proved."""
        if self.horizon is None:
            return f"none up to {self.max_horizon} is proved"
        strong = f"; strong from {self.strong}" if self.strong is not None else ""
        return f"{self.horizon} ({self.reasons[self.horizon].reason}){strong}"

    __repr__ = __str__


def smallest_horizon(
    mpc: MPC,
    max_horizon: int = 20,
    *,
    max_regions: int = 2000,
    seconds: float = 60.0,
    progress: bool = False,
) -> SmallestHorizon:
    """Try horizons 1, 2, … up to `max_horizon` with proofs alone (no samples, no search).

    seconds: time limit, after which larger horizons are left out (some linear programs are
    finished); a horizon takes a second or so with two states, minutes with hundreds of facets or
    thousands of regions. progress: print each horizon on stderr. The horizon of `mpc` itself has
    no influence. The answer is the least horizon with a proof; a smaller one that is neither proved
    nor refuted is in `reasons` with holds None, and one at which the problem is ill-posed (more
    free moves than steps) is left out of it. Raises ValueError for an ill-posed problem.
    """
    mpc.validate()
    max_horizon = whole("max_horizon", max_horizon, 1)
    max_regions = whole("max_regions", max_regions, 0)
    least: int | None = None
    reasons: dict[int, Claim] = {}
    budget = Budget.of(seconds, progress)
    for N in range(1, max_horizon + 1):
        if not budget.affords(0):
            break
        budget.say(f"horizon {N}")
        changed = replace(mpc, horizon=N)
        try:
            problem = FeasibilityProblem.of(changed)
        except ValueError:  # such as more free moves than steps
            continue
        try:
            claims = settle_claims(changed, problem, budget.deadline)
            law = claims.law
            if law.holds is None and least is None and max_regions and np.isfinite(claims.volume):
                law = settle_by_regions(claims, max_regions, budget.deadline).claim
        except ValueError as error:  # too ill-conditioned: the other horizons stay settled
            reasons[N] = Claim(None, f"not settled ({error})")
            continue
        reasons[N] = law
        least = N if law.holds and least is None else least
        if claims.strong.holds:
            return SmallestHorizon(least, N, reasons, max_horizon)
    return SmallestHorizon(least, None, reasons, max_horizon)
