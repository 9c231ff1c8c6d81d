"""Nominal closed loops from feasible states: violations and decrease of the optimal value."""

from typing import Any

import jax
import numpy as np

from jaxmpc.closed_loop.run import lyapunov_decrease
from jaxmpc.closed_loop.simulation import simulate
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

    starts (B, n). steps: samples of each loop. feasible: number of loops whose plans were all
    SOLVED; the other fields are of these. violation: the worst of the state limits, in their units.
    slack: the worst violation of soft rows. increase: the largest V(x⁺) − V(x) + x'Qx + u'Ru
    relative to V(x); worst_start: the start of the loop in which it was met. left: largest |x_T| of
    a loop, relative to the largest of its start, each state in units of its size among the starts.
    """

    starts: np.ndarray
    steps: int
    feasible: int
    violation: float
    slack: float
    increase: float
    worst_start: np.ndarray
    left: float

    def __str__(self) -> str:
        count = len(self.starts)
        lines = [
            f"{self.feasible:,} of {count:,} feasible starts kept every plan solved for "
            f"{self.steps} steps",
            f"worst violation of a hard state limit {self.violation:.3g}, "
            f"of a soft row {self.slack:.3g}",
            f"largest state left, relative to the start: {self.left:.3g}",
        ]
        if np.isfinite(self.increase):
            at = np.array2string(self.worst_start, precision=4)
            lines.append(
                f"Lyapunov decrease V(x+) - V(x) <= -(x'Qx + u'Ru): kept on every step, margin "
                f"{-self.increase:.3g} V(x)"
                if self.increase <= ROUNDING
                else f"Lyapunov decrease fails by {self.increase:.3g} V(x), from {at}"
            )
        return "\n".join(lines)


def nominal_loops(mpc: MPC, starts: np.ndarray, steps: int) -> NominalLoops:
    """Simulate nominal closed loops in float64.

    starts: states (B, n), or (B, n + m) with the previous input where input rates are limited.
    """
    with jax.enable_x64(True):
        controller = Controller(in_float64(mpc), ADMM(newton_steps=30))
        n = mpc.system.n

        def loop(start: Any) -> Any:  # from x, or (x, u_{−1}) where input rates are limited
            previous = start[n:] if len(start) > n else None
            return simulate(controller, mpc.system, start[:n], steps, previous_input=previous)

        run = jax.jit(jax.vmap(loop))(starts)
        change = np.asarray(lyapunov_decrease(run))
        run = jax.tree.map(np.asarray, run)
    solved = np.all(run.status == Status.SOLVED, axis=1)
    scale = np.abs(run.cost[:, :-1]) + 1e-12
    relative = np.where(solved[:, None], change / scale, -np.inf)
    worst = np.unravel_index(np.argmax(relative), relative.shape)
    size = np.abs(starts[:, :n]).max(axis=0)
    size = np.where(size > 0, size, 1.0)
    norm = lambda x: np.abs(x / size).max(axis=1)
    left = norm(run.states[:, -1]) / np.maximum(norm(starts[:, :n]), 1e-9)
    kept = lambda v: float(np.max(v[solved], initial=0.0))
    return NominalLoops(
        starts=starts, steps=steps, feasible=int(solved.sum()), violation=kept(run.violation),
        slack=kept(run.slack), increase=float(relative[worst]), worst_start=starts[worst[0]],
        left=kept(left),
    )  # fmt: skip
