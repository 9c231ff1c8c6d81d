"""Status codes of a solve, with a sentence for each, and what results say by them."""

from enum import IntEnum

import numpy as np
from jax import Array

from jaxmpc.checks import concrete, fail
from jaxmpc.pytrees import short_text, short_value


class Status(IntEnum):
    """Outcome of one QP, or label of one state of a map. 1 to 9 are OSQP's numbers; 0 marks
    instances that have not been solved yet. ITERATION_LIMIT: all steps were taken, and more
    might have gained; INACCURATE: steps were left or gained nothing more, and the tolerance is not
    met.

    A status is derived from residuals and certificates that are computed in the units of
    the problem as given, never from the fact that a loop came to its end.
    """

    NOT_RUN = 0
    SOLVED = 1
    INACCURATE = 2
    PRIMAL_INFEASIBLE = 3
    DUAL_INFEASIBLE = 5
    ITERATION_LIMIT = 7
    NON_CONVEX = 9
    NON_FINITE = 12

    @property
    def sentence(self) -> str:
        """What happened and what to try."""
        return _SENTENCES[self]


# Of these there is no point that the numbers beside the status could be close to.
NO_SOLUTION = (
    Status.NOT_RUN,
    Status.PRIMAL_INFEASIBLE,
    Status.DUAL_INFEASIBLE,
    Status.NON_CONVEX,
    Status.NON_FINITE,
)


class WithStatus:
    """A result with the `status` of one instance, or of each instance of a batch."""

    status: Array

    @property
    def solved(self) -> Array:
        """Whether the status is SOLVED: one truth value, or one for each instance of a batch."""
        return self.status == Status.SOLVED

    @property
    def sentence(self) -> str:
        """What happened and what to try. Raises ValueError for a batch and for traced values."""
        if np.ndim(self.status) or not concrete(self.status):
            cure = "Take one: jax.tree.map(lambda v: v[i], result), outside jit and vmap"
            fail("sentence", f"of {status_text(self.status)}", cure)
        return Status(int(self.status)).sentence

    def __repr__(self) -> str:
        """Return a few lines of text, without large arrays: the status first, and a cost only
        where there is a solution."""
        texts = {"status": status_text(self.status)}
        if any(status.name == texts["status"] for status in NO_SOLUTION):
            texts["cost"] = "none"
        return short_text(self, **texts)


def status_text(status: Array) -> str:
    """Return the name of a status, or how many instances of a batch have which."""
    known = {int(code): code.name for code in Status}
    if not isinstance(status, np.ndarray | np.generic | Array) or not concrete(status):
        return short_value(status)
    codes, counts = np.unique(status, return_counts=True)
    names = [known.get(int(code), str(code)) for code in codes]
    if np.ndim(status) == 0:
        return names[0]
    return " + ".join(f"{counts[i]} {names[i]}" for i in np.argsort(-counts, kind="stable"))


_SENTENCES = {
    Status.NOT_RUN: "Not run yet.",
    Status.SOLVED: "Solved: primal residual, dual residual and gap are within tolerance.",
    Status.INACCURATE: (
        "Not solved to the tolerance, and further steps gain nothing: rounding stops them. Compute "
        "in float64; let a long unstable prediction have prestabilise=True; or allow a larger eps."
    ),
    Status.PRIMAL_INFEASIBLE: (
        "No point satisfies the constraints; a Farkas vector proves it. "
        "Relax a limit or soften rows; with a terminal set enlarge that or lengthen the horizon."
    ),
    Status.DUAL_INFEASIBLE: (
        "The cost falls without bound, to working precision, along a feasible ray. "
        "Add a cost or a bound on that ray."
    ),
    Status.ITERATION_LIMIT: (
        "Neither solved nor proved infeasible within all steps; more of them may help. "
        "Raise newton_steps, or iterations where newton_steps is 0."
    ),
    Status.NON_CONVEX: (
        "The Hessian of the cost has a negative eigenvalue beyond rounding. "
        "Make the weights positive semidefinite: check their signs."
    ),
    Status.NON_FINITE: (
        "The data of this instance hold NaN, or l > u (of a limit less what W takes from it, too: "
        "make W smaller), or an infinite weight, or they overflow in their precision: compute in "
        "float64, or give an unstable prediction fewer steps."
    ),
}
