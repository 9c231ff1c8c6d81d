"""The linear problem of a robot map: limits on x_0, terminal sets, deviations from a set-point."""

from dataclasses import replace

import jax
import numpy as np

from jaxmpc.arrays import Reals
from jaxmpc.closed_loop.robot_controller import robot_mpc
from jaxmpc.mpc.problem import MPC, Outputs, as_tuple
from jaxmpc.robots.linear_plant import LinearPlant
from jaxmpc.robots.robot import Robot
from jaxmpc.sets.convex_sets import Box, translated
from jaxmpc.sets.invariant import named_terminal_set
from jaxmpc.systems.riccati import lqr
from jaxmpc.systems.system import host_matrices


def home_coordinates(robot: Robot | LinearPlant) -> np.ndarray:
    """Return the coordinates ξ (n,) of `robot.home`, in float64."""
    with jax.enable_x64(True):
        return np.array(robot.coordinates(np.asarray(robot.home)), np.float64)


def mpc_with_terminal(robot: Robot, horizon: int, terminal: str) -> MPC:
    """Return `robot_mpc(robot)` with the terminal set "none", "box" or "invariant" about home."""
    mpc = robot_mpc(robot, horizon=horizon)
    if terminal != "invariant":
        found = named_terminal_set(terminal, mpc.system, None, mpc.states, None)
        return replace(mpc, terminal_set=found)
    x, (_, u) = home_coordinates(robot), robot.equilibrium()
    about = deviations(mpc, x, u)
    # At the set-point c is rounding.
    system = replace(about.system, c=None)
    regulator = lqr(system, mpc.Q, mpc.R)
    found = named_terminal_set(terminal, system, regulator, about.states, about.inputs)
    return replace(mpc, terminal_set=translated(found, x))


def with_initial_limits(mpc: MPC, limits: Box) -> MPC:
    """Return `mpc` with `limits` on x_0 as well, where its own state limits do not hold at k =
    0."""
    lower, upper = np.asarray(limits.lower, float), np.asarray(limits.upper, float)
    bounded = np.isfinite(lower) | np.isfinite(upper)
    if not bounded.any() or (mpc.states is not None and 0 in mpc.state_stages):
        return mpc
    system = mpc.system
    names, units = (
        tuple(str(text) for text in np.asarray(texts)[bounded]) if texts else ()
        for texts in (system.state_names, system.state_units)
    )
    C = np.eye(len(bounded))[bounded]
    rows = Outputs(C, lower[bounded], upper[bounded], stages=(0,), names=names, units=units)
    return replace(mpc, outputs=(*as_tuple("outputs", mpc.outputs, Outputs), rows))


def deviations(mpc: MPC, x: Reals, u: Reals) -> MPC:
    """Return the same problem in z = ξ − x, v = u − u_ref, so that tracking (x, u_ref) becomes
    regulation.

    z⁺ = A z + B v + (A x + B u_ref + c − x); a set H ξ ≤ h is H z ≤ h − H x. Raises ValueError
    for an Ellipsoid as terminal set away from x = 0.
    """
    x, u = np.asarray(x, float), np.asarray(u, float)
    if not x.any() and not u.any():
        return mpc
    A, B, c = host_matrices(mpc.system)
    return replace(
        mpc,
        system=replace(mpc.system, c=A @ x + B @ u + c - x),
        states=translated(mpc.states, -x),
        inputs=translated(mpc.inputs, -u),
        terminal_set=translated(mpc.terminal_set, -x),
        outputs=tuple(_moved(each, x, u) for each in as_tuple("outputs", mpc.outputs, Outputs)),
    )


def _moved(rows: Outputs, x: np.ndarray, u: np.ndarray) -> Outputs:
    """Return limits of outputs as limits of their deviations from those at x (n,), u (m,)."""
    at = np.asarray(rows.C) @ x
    if rows.D is not None:
        at = at + np.asarray(rows.D) @ u
    lower, upper = (np.asarray(side) - at for side in rows.sides)
    return replace(rows, lower=lower, upper=upper)
