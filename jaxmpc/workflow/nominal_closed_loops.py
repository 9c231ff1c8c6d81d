"""Nominal closed loops from feasible states: violations and decrease of the optimal value."""

import jax
import numpy as np

from jaxmpc.closed_loop.simulation import Run, lyapunov_decrease, simulate
from jaxmpc.mpc.condense import in_float64
from jaxmpc.mpc.controller import Controller
from jaxmpc.mpc.problem import MPC
from jaxmpc.pytrees import record
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.status import Status

# Rounding of optimal values, relative: a Lyapunov increase below that is none.
ROUNDING = 1e-7


@record
class NominalLoops:
    """The results of nominal closed loops from sampled feasible states.

    x0s (B, n). steps: time steps of each loop. feasible: number of loops whose plans were all
    SOLVED; the other fields are of these. violation: the worst of the state limits, in their units.
    slack: the worst violation of soft rows. increase: the largest V(x⁺) − V(x) + x'Qx + u'Ru
    relative to V(x); worst_x0: the start of the loop in which it was met. left: largest |x_T| of a
    loop, relative to the largest of its start, each state in units of its size among the starts.
    """

    x0s: np.ndarray
    steps: int
    feasible: int
    violation: float
    slack: float
    increase: float
    worst_x0: np.ndarray
    left: float

    def __str__(self) -> str:
        lines = [
            f"{self.feasible:,} of {len(self.x0s):,} feasible starts kept every plan solved for "
            f"{self.steps} steps",
            f"worst violation of a hard state limit {self.violation:.3g}, "
            f"of a soft row {self.slack:.3g}",
            f"largest state left, relative to the start: {self.left:.3g}",
        ]
        if self.increase <= ROUNDING and np.isfinite(self.increase):
            what = "Lyapunov decrease V(x+) - V(x) <= -(x'Qx + u'Ru): kept on every step, margin"
            lines.append(f"{what} {-self.increase:.3g} V(x)")
        elif np.isfinite(self.increase):
            at = np.array2string(self.worst_x0, precision=4)
            lines.append(f"Lyapunov decrease fails by {self.increase:.3g} V(x), from {at}")
        return "\n".join(lines)

    __repr__ = __str__


def nominal_loops(mpc: MPC, x0s: np.ndarray, steps: int) -> NominalLoops:
    """Simulate nominal closed loops in float64.

    x0s: states (B, n), or (B, n + m) with the previous input where input rates are limited.
    """
    n = mpc.system.n
    with jax.enable_x64(True):
        controller = Controller(in_float64(mpc), ADMM(newton_steps=30))

        def loop(x0: jax.Array) -> Run:  # x, or (x, u_{−1}) where input rates are limited
            previous = x0[n:] if len(x0) > n else None
            return simulate(controller, mpc.system, x0[:n], steps, previous_input=previous)

        run = jax.jit(jax.vmap(loop))(x0s)
        change = np.asarray(lyapunov_decrease(run))
        run = jax.tree.map(np.asarray, run)
    solved = np.all(run.status == Status.SOLVED, axis=1)
    scale = np.abs(run.cost[:, :-1]) + 1e-12
    relative = np.where(solved[:, None], change / scale, -np.inf)
    worst = np.unravel_index(np.argmax(relative), relative.shape)
    # Largest state of each loop, in units of its size among the starts.
    size = np.abs(x0s[:, :n]).max(axis=0)
    size = np.where(size > 0, size, 1.0)
    first, last = (np.abs(x / size).max(axis=1) for x in (x0s[:, :n], run.states[:, -1]))
    return NominalLoops(
        x0s=x0s,
        steps=steps,
        feasible=int(solved.sum()),
        violation=float(np.max(run.violation[solved], initial=0.0)),
        slack=float(np.max(run.slack[solved], initial=0.0)),
        increase=float(relative[worst]),
        worst_x0=x0s[worst[0]],
        left=float(np.max((last / np.maximum(first, 1e-9))[solved], initial=0.0)),
    )
