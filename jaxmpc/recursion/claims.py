"""Claims about recursive feasibility, proved, refuted or open, and counterexamples to them."""

import numpy as np

from jaxmpc.pytrees import record

# Distance from a facet of X_N, relative to the facet's from the centre, from which a state counts
# as outside: well above the residuals of plans. Next states are moved towards the centre by as much
# before they are labelled.
CLEAR = 1e-7


@record
class Claim:
    """A claim: holds True (proved), False (refuted) or None (open); and why.

    state (p,): where it is refuted, the state of the counterexample; else None.
    """

    holds: bool | None
    reason: str
    state: np.ndarray | None = None

    def __str__(self) -> str:
        return f"{ {True: 'proved', False: 'refuted', None: 'open'}[self.holds] }: {self.reason}"


@record
class Counterexample:
    """A feasible state whose optimal first input leads to an infeasible one.

    state x (p,) is feasible by proof: `feasible_inputs` (N, m) keep all rows in a float64 roll-out
    with margins above rounding. inputs (N, m): the optimal plan, to the given residuals.
    next_state: A x + B u_0 + c. The half-space normal'x ≤ offset holds on the whole feasible set,
    by proof, and excludes next_state by `distance` = (normal'x⁺ − offset)/|normal|. found:
    "search", "sample" or "regions". Where input rates are limited, states are (x, u_{−1}).
    """

    state: np.ndarray
    inputs: np.ndarray
    next_state: np.ndarray
    normal: np.ndarray
    offset: float
    distance: float
    feasible_inputs: np.ndarray
    primal_residual: float
    dual_residual: float
    found: str

    def __str__(self) -> str:
        return (
            f"from x = {in_words(self.state)} the optimal u = {in_words(self.inputs[0])} leads to "
            f"{in_words(self.next_state)}, outside the feasible set by {self.distance:.6g}"
        )


def in_words(x: np.ndarray) -> str:
    """Return a vector as text, such as "(0.5, -1)", rounded to 9 decimals and 6 digits."""
    return "(" + ", ".join(f"{v:.6g}" for v in np.round(x, 9) + 0.0) + ")"
