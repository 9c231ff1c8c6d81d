"""The linear problem of a robot map: limits on x_0, and deviations from a set-point."""

from dataclasses import replace
from typing import Any

import numpy as np

from jaxmpc.mpc.problem import MPC, Outputs, as_tuple
from jaxmpc.sets.any_set import translated
from jaxmpc.sets.box import Box
from jaxmpc.systems.system import LinearSystem, host_matrices


def with_initial_limits(mpc: MPC, limits: Box) -> MPC:
    """Return `mpc` with `limits` on x_0 as well, where its own state limits do not hold at k =
    0."""
    lower, upper = np.asarray(limits.lower, float), np.asarray(limits.upper, float)
    bounded = np.isfinite(lower) | np.isfinite(upper)
    if not bounded.any() or (mpc.states is not None and 0 in mpc.state_stages):
        return mpc
    pick = lambda names: tuple(str(v) for v in np.asarray(names)[bounded]) if names else ()
    rows = Outputs(
        np.eye(len(bounded))[bounded], lower[bounded], upper[bounded], stages=(0,),
        names=pick(mpc.system.state_names), units=pick(mpc.system.state_units),
    )  # fmt: skip
    return replace(mpc, outputs=(*as_tuple("outputs", mpc.outputs, Outputs), rows))


def deviations(mpc: MPC, x: Any, u: Any) -> MPC:
    """Return the same problem in z = ξ − x, v = u − u_ref, so that tracking (x, u_ref) becomes
    regulation.

    z⁺ = A z + B v + (A x + B u_ref + c − x); a set H ξ ≤ h is H z ≤ h − H x. Raises ValueError
    for an Ellipsoid as terminal set away from x = 0.
    """
    x, u = np.asarray(x, float), np.asarray(u, float)
    if not x.any() and not u.any():
        return mpc

    system: LinearSystem = mpc.system
    A, B, c = host_matrices(system)
    rows = []
    for each in as_tuple("outputs", mpc.outputs, Outputs):
        D = np.zeros((len(each.lower), system.m)) if each.D is None else np.asarray(each.D)
        by = np.asarray(each.C) @ x + D @ u
        rows.append(replace(each, lower=np.asarray(each.lower) - by, upper=each.upper - by))
    return replace(
        mpc, system=replace(system, c=A @ x + B @ u + c - x), states=translated(mpc.states, -x),
        inputs=translated(mpc.inputs, -u), terminal_set=translated(mpc.terminal_set, -x),
        outputs=tuple(rows),
    )  # fmt: skip
