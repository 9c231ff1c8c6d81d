"""From limits, weights and a horizon to an MPC problem with terminal set, cost and penalties."""

import dataclasses
import inspect
from dataclasses import replace
from typing import Any

import numpy as np

from jaxmpc.arrays import Reals
from jaxmpc.checks import fail, nearest, require_kind
from jaxmpc.explicit.exact_penalties import ExactPenalty, exact_penalty
from jaxmpc.mpc.controller import Controller
from jaxmpc.mpc.problem import MPC, soften, within_outputs
from jaxmpc.pytrees import record
from jaxmpc.qp.admm import ADMM
from jaxmpc.sets.convex_sets import Box, Ellipsoid, Polytope
from jaxmpc.sets.invariant import OF_A_LAW, named_terminal_set
from jaxmpc.sets.limits import JointLimits
from jaxmpc.systems.riccati import LQR, lqr
from jaxmpc.systems.system import LinearSystem
from jaxmpc.workflow.offline_checks import OfflineReport, offline_report


@record
class Design:
    """The result of `design`.

    mpc: the problem. regulator: the LQR of its terminal cost and set. penalty: the exact penalty
    where soft="exact", else None.
    """

    mpc: MPC
    regulator: LQR
    penalty: ExactPenalty | None

    def __repr__(self) -> str:
        """Return what was designed, in some lines."""
        mpc, last = self.mpc, self.mpc.terminal_set
        ends = "no terminal set" if last is None else f"terminal set {last}"
        lines = [f"Design(horizon {mpc.horizon}, n = {mpc.system.n}, m = {mpc.system.m}", ends]
        lines.append(f"LQR K = {np.array2string(np.asarray(self.regulator.K), precision=6)}")
        lines += [] if self.penalty is None else [f"exact penalty {self.penalty.advised:.6g}"]
        return "\n  ".join(lines) + ")"

    def controller(self, solver: ADMM | None = None) -> Controller:
        """Return the `Controller` of the problem, factored once."""
        return Controller(self.mpc) if solver is None else Controller(self.mpc, solver)

    def test(self, **settings: Any) -> OfflineReport:
        """Return the `offline_report` of the problem, which takes the settings."""
        return offline_report(self.mpc, K=self.regulator.K, **settings)


def design(
    system: LinearSystem,
    Q: Reals,
    R: Reals,
    horizon: int,
    *,
    limits: JointLimits | None = None,
    states: Box | Polytope | None = None,
    inputs: Box | Polytope | None = None,
    terminal: str | Box | Polytope | Ellipsoid = "invariant",
    soft: float | str | None = None,
    **settings: Any,
) -> Design:
    """Make an MPC problem from limits and weights, with terminal set, terminal cost and penalties.

    Arguments:
        limits: those of `joint_limits`; or give states and inputs themselves.
        terminal: a set, or the name of one as in `named_terminal_set`, of whose law the outputs are
            within their limits too.
        soft: None keeps all limits hard; a number is the L1 weight of state and terminal rows;
            "exact" computes the least weight that changes nothing on the feasible set, and adds a
            margin.
        settings: further fields of `MPC`, such as control_horizon or input_rate_limit. The
            terminal cost is that of the LQR unless terminal_cost is among them.

    Raises ValueError for ill-posed data, as `lqr`, `maximal_invariant_set` and `MPC` do.
    """
    known = [f.name for f in dataclasses.fields(MPC) if f.name != "terminal_set"]  # `terminal`
    for word in set(settings) - set(known):
        near = nearest(word, [*inspect.signature(design).parameters, *known])
        raise TypeError(
            f"design: there is no argument {word}. {near}It takes the fields of MPC too"
        )
    if limits is not None:
        if states is not None or inputs is not None:
            fail("limits", "given beside states or inputs", "Choose one way to give the limits")
        cure = "Give what jm.joint_limits returns, or states= and inputs="
        require_kind("limits", limits, JointLimits, cure=cure)
        states, inputs = limits.states, limits.inputs
        if not system.state_names:
            named: dict[str, Any] = limits.names
            system = replace(system, **named)
    regulator = lqr(system, Q, R)
    settings = {"terminal_cost": regulator.P, **settings}
    mpc = MPC(system, Q, R, horizon, states, inputs, **settings)
    mpc.validate()
    last: Any = terminal
    if isinstance(terminal, str):
        against = (settings.get(name) for name in ("disturbance", "disturbance_matrix"))
        gain = settings.get("gain")
        law = regulator if gain is None else LQR(K=gain, P=regulator.P)
        kept = within_outputs(mpc, law.K) if terminal in OF_A_LAW else states
        last = named_terminal_set(terminal, system, law, kept, inputs, *against)
    mpc = replace(mpc, terminal_set=last)
    mpc.validate()
    if soft is None:
        return Design(mpc, regulator, None)
    if not isinstance(soft, str):
        return Design(soften(mpc, soft), regulator, None)
    if soft != "exact":
        fail("soft", f"{soft!r}", 'Give a weight, "exact" or None')
    penalty = exact_penalty(mpc)
    return Design(soften(mpc, penalty.advised), regulator, penalty)
