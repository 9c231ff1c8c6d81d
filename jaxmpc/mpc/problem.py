"""The constrained MPC problem as a user states it, and the plan that answers it."""

from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from jax import Array

from jaxmpc.checks import concrete, fail, require_shape, require_symmetric_psd
from jaxmpc.control.sets import Box, Polytope
from jaxmpc.control.system import LinearSystem
from jaxmpc.qp.problem import QPSolution


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MPC:
    """Constrained linear-quadratic MPC over the horizon N (the lesson's section 2):

        min  Σ_{k<N} (x_k'Q x_k + u_k'R u_k) + x_N'P x_N          (no ½)
        s.t. x_{k+1} = A x_k + B u_k + c,  x_0 given,
             x_k ∈ states (k = 0..N−1; from 1 if constrain_initial is False),
             u_k ∈ inputs (k = 0..N−1),  x_N ∈ terminal_set.

    system: LinearSystem. Q (n, n) ⪰ 0, R (m, m) ≻ 0, terminal_cost P (n, n) ⪰ 0 or None (no
    terminal cost). states: Box, Polytope or None; inputs: Box or None; terminal_set: Box,
    Polytope or None. prestabilise: gain K (m, n) of the substitution u = Kx + v, which keeps
    long predictions of unstable plants well-conditioned; True: the LQR gain; False: none; None:
    the LQR gain where A has an eigenvalue outside the unit circle. It changes rounding, not
    the problem. Inside `jit` with A as an argument give K itself: None and True read values.
    """

    system: LinearSystem
    Q: Any
    R: Any
    horizon: int = field(metadata={"static": True})
    states: Box | Polytope | None = None
    inputs: Box | None = None
    terminal_cost: Any = None
    terminal_set: Box | Polytope | None = None
    constrain_initial: bool = field(default=True, metadata={"static": True})
    prestabilise: Any = None

    def validate(self) -> None:
        """Raise ValueError that names the field, its value and the cure, before any compile."""
        if not isinstance(self.system, LinearSystem):
            fail("system", f"is a {type(self.system).__name__}", "Give a jm.LinearSystem")
        self.system.validate()
        n, m = self.system.n, self.system.m
        whole = isinstance(self.horizon, int | np.integer) and not isinstance(self.horizon, bool)
        if not whole or self.horizon < 1:
            fail("horizon", f"{self.horizon!r}", "Give a whole number of steps, at least 1")
        require_shape("Q", self.Q, (n, n), "Q weighs the states: one row for each")
        require_shape("R", self.R, (m, m), "R weighs the inputs: one row for each")
        require_symmetric_psd("Q", self.Q)
        require_symmetric_psd("R", self.R, definite=True)
        if self.terminal_cost is not None:
            require_shape("terminal_cost", self.terminal_cost, (n, n), "P weighs the last state")
            require_symmetric_psd("terminal_cost", self.terminal_cost)
        for name, kinds, size in (
            ("states", (Box, Polytope), n),
            ("inputs", (Box,), m),
            ("terminal_set", (Box, Polytope), n),
        ):
            value = getattr(self, name)
            if value is None:
                continue
            if not isinstance(value, kinds):
                wanted = " or ".join(kind.__name__ for kind in kinds)
                fail(name, f"is a {type(value).__name__}", f"Give a {wanted}, or None")
            if concrete(value):
                value.validate(name, size)
        if self.prestabilise is not None and not isinstance(self.prestabilise, bool):
            require_shape("prestabilise", self.prestabilise, (m, n), "A gain K with u = Kx + v")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Multipliers:
    """Lagrange multipliers of a plan, for the cost without ½; y > 0 pushes against the upper
    bound of the row, y < 0 against the lower.

    states (K, r): rows of `states` at the steps where they hold, inputs (N, m), terminal (r_f,).
    dJ*/d(upper bound) = −y where y > 0, dJ*/d(lower bound) = −y where y < 0.
    """

    states: Array
    inputs: Array
    terminal: Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Plan:
    """Answer of `solve`: states (N+1, n), inputs (N, m), cost J (without ½), multipliers, status.

    Unless the status is SOLVED, cost and trajectory are those of the best iterate and mean little.
    The status is that of the QP (`jaxmpc.Status`); residuals are those of the condensed QP in
    the units of states and inputs. `qp` holds the QP's own solution and serves as warm start.
    """

    states: Array
    inputs: Array
    cost: Array
    multipliers: Multipliers
    status: Array
    primal_residual: Array
    dual_residual: Array
    gap: Array
    iterations: Array
    qp: QPSolution
