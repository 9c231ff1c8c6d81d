"""robot_mpc: the MPC problem of a robot, from its model and limits."""

from dataclasses import replace
from typing import Any

import jax
import numpy as np

from jaxmpc.checks import fail, whole
from jaxmpc.control.riccati import lqr
from jaxmpc.mpc.problem import MPC
from jaxmpc.robots.linear import LinearPlant
from jaxmpc.robots.robot import Robot


def robot_mpc(
    robot: Robot | LinearPlant, Q: Any = None, R: Any = None, horizon: int = 20, *,
    target: Any = None, margin: float = 0.02, terminal_cost: Any = "lqr", exact: bool = True,
    **fields: Any,
) -> MPC:  # fmt: skip
    """Return the MPC of a robot about a set-point, with the limits of its model.

    Arguments:
        Q (n, n) or its diagonal (n,), R (m, m) or (m,): weights in the coordinates ξ. None, with
            the half-widths w of the limits (1 where there are none): 1/w² for the positions and
            0.01/w² for velocities and inputs (Bryson's rule, slow motion and effort forgiven).
        target: configuration (nq,) to linearise about (of a LinearPlant the state), None for
            `robot.home`. It must be one that the actuators can hold.
        margin: fraction by which state limits are tightened, of the limit's half-width on each
            side, to allow for errors of the linear model. Input limits are not tightened.
        terminal_cost: "lqr", the Riccati solution of the model at the target; or P (n, n), None.
        exact: which model, see `Robot.linearize`.
        fields: of `MPC`, in place of the defaults here: state limits at k = 1 … N (no input moves
            x_0), no terminal set.

    Track the target with reference = robot.coordinates(x) and input_reference = u of
    `robot.equilibrium(target)`. Raises ValueError as MPC and `equilibrium` do, or where the
    tightened limits leave out the target.
    """
    if not callable(getattr(robot, "linearize", None)):
        fail("robot", f"is a {type(robot).__name__}", "Give a Robot or a LinearPlant")
    whole("horizon", horizon, 1)
    if not 0 <= margin < 1:
        fail("margin", f"{margin}", "Give a fraction in [0, 1)")
    if Q is None:
        Q = np.repeat([1.0, 0.01], [robot.n - robot.n // 2, robot.n // 2])
        Q = Q / robot.state_limits.half_widths() ** 2
    R = 0.01 / robot.input_limits.half_widths() ** 2 if R is None else R
    diagonal = lambda W: np.diag(W) if np.ndim(W) == 1 else W
    Q, R = diagonal(Q), diagonal(R)
    x, u = robot.equilibrium(target)
    with jax.enable_x64(True):
        point = np.asarray(robot.coordinates(x))
    states = robot.state_limits.tightened(margin)
    lower, upper = np.asarray(states.lower), np.asarray(states.upper)
    outside = np.maximum(lower - point, point - upper)
    if np.any(outside > 0):
        i = int(np.argmax(outside))
        fail(
            "target", f"has {(robot.state_names or range(len(point)))[i]} = {point[i]:g}, limits "
            f"with margin are [{lower[i]:g}, {upper[i]:g}]", "Choose another target, less margin",
        )  # fmt: skip
    with jax.enable_x64(True):
        system = jax.tree.map(np.asarray, robot.linearize(x, u, exact=exact))
    mpc = MPC(system, Q, R, horizon, states=states, inputs=robot.input_limits)
    mpc.validate()
    mpc = replace(mpc, constrained_steps=tuple(range(1, horizon + 1)))
    if isinstance(terminal_cost, str):
        if terminal_cost != "lqr":
            fail("terminal_cost", f"{terminal_cost!r}", 'Give "lqr", a matrix or None')
        terminal_cost = np.asarray(lqr(system, Q, R).P)
    mpc = replace(mpc, **{"terminal_cost": terminal_cost, **fields})
    mpc.validate()
    return mpc
