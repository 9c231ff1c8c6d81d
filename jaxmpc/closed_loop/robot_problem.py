"""robot_mpc: the MPC problem of a robot, from its model and limits."""

import warnings
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from jaxmpc.arrays import Reals, as_weight
from jaxmpc.checks import fail, whole
from jaxmpc.mpc.problem import MPC
from jaxmpc.robots.equilibria import settled
from jaxmpc.robots.linear_plant import LinearPlant
from jaxmpc.robots.robot import Robot
from jaxmpc.sets.box import Box
from jaxmpc.systems.riccati import least_reached, lqr
from jaxmpc.systems.system import LinearSystem


def robot_mpc(
    robot: Robot | LinearPlant,
    Q: Reals | None = None,
    R: Reals | None = None,
    horizon: int = 20,
    *,
    target: Reals | None = None,
    margin: float = 0.02,
    terminal_cost: Reals | str | None = "lqr",
    exact: bool = True,
    **fields: Any,
) -> MPC:
    """Return the MPC of a robot about a set-point, with the limits of its model.

    Arguments:
        Q (n, n) or its diagonal (n,), R (m, m) or (m,): weights in the coordinates ξ. None, with
            the half-widths w of the limits (1 where there are none): 1/w² for the positions and
            0.01/w² for velocities and inputs (Bryson's rule, slow motion and effort forgiven).
        target: configuration (nq,) to linearise about (of a LinearPlant the state), one that the
            actuators can hold. None for `robot.set_point()`: home where they can, else the nearest
            configuration that they can hold, else home, where the model then predicts a fall.
        margin: fraction by which state limits are tightened, of the limit's half-width on each
            side, to allow for errors of the linear model. Less where the target lies in between: a
            warning names the coordinates. Input limits are not tightened.
        terminal_cost: "lqr", the Riccati solution of the model at the target, of the coordinates
            that inputs move where they do not move all (a warning names the others), and none
            where the set-point does not rest: no cost to go is finite there; or P (n, n), None.
        exact: which model, see `Robot.linearize`.
        fields: of `MPC`, in place of the defaults here: state limits at k = 1 … N (no input moves
            x_0), no terminal set.

    Track the target with reference = robot.coordinates(x) and input_reference = u of
    `robot.equilibrium(target)`, or of `robot.set_point()`. Raises ValueError as MPC and
    `equilibrium` do, or where the limits leave out the target.
    """
    if not callable(getattr(robot, "linearize", None)):
        fail("robot", f"is a {type(robot).__name__}", "Give a Robot or a LinearPlant")
    whole("horizon", horizon, 1)
    if not 0 <= margin < 1:
        fail("margin", f"{margin}", "Give a fraction in [0, 1)")
    Q, R = _weights(robot, Q, R)
    rests = True
    if target is None and isinstance(robot, Robot):
        rest, texts = settled(robot)
        x, u, rests = rest.x, rest.u, rest.held
        for text in texts:
            warnings.warn(text, stacklevel=2)
    else:
        x, u = robot.equilibrium(target)
    names = robot.state_names or tuple(f"coordinate {i}" for i in range(robot.n))
    with jax.enable_x64(True):
        point = np.asarray(robot.coordinates(x))
        states = _around(robot.state_limits, margin, point, names)
        system = jax.tree.map(np.asarray, robot.linearize(x, u, exact=exact))
    mpc = MPC(system, Q, R, horizon, states=states, inputs=robot.input_limits)
    mpc.validate()
    if isinstance(terminal_cost, str):
        if terminal_cost != "lqr":
            fail("terminal_cost", f"{terminal_cost!r}", 'Give "lqr", a matrix or None')
        terminal_cost = _terminal_cost(system, np.asarray(Q), R, names) if rests else None
    usual = {"constrained_stages": tuple(range(1, horizon + 1)), "terminal_cost": terminal_cost}
    mpc = replace(mpc, **{**usual, **fields})
    mpc.validate()
    return mpc


def _weights(robot: Robot | LinearPlant, Q: Reals | None, R: Reals | None) -> tuple[Reals, Reals]:
    """Return the weights as matrices, those of Bryson's rule for None."""
    if Q is None:
        positions = robot.mujoco.nv if isinstance(robot, Robot) else robot.n - robot.n // 2
        parts = np.repeat([1.0, 0.01], [positions, robot.n - positions])
        Q = parts / robot.state_limits.half_widths() ** 2
    if R is None:
        R = 0.01 / robot.input_limits.half_widths() ** 2
    return as_weight(Q, robot.n), as_weight(R, robot.m)


def _around(limits: Box, margin: float, point: np.ndarray, names: tuple[str, ...]) -> Box:
    """Return the limits tightened by the margin, by less where that would leave out the point
    (n,)."""
    lower, upper = limits.bounds()
    outside = np.maximum(lower - point, point - upper) - 1e-9 * limits.half_widths()
    if np.any(outside > 0):
        i = int(np.argmax(outside))
        problem = f"has {names[i]} = {point[i]:g}, limits are [{lower[i]:g}, {upper[i]:g}]"
        fail("target", problem, "Choose another target")
    lower, upper = limits.tightened(margin).bounds()
    low, high = np.minimum(lower, point), np.maximum(upper, point)
    less = np.flatnonzero((low < lower) | (high > upper))
    if len(less):
        warnings.warn(
            f"margin: {_listed(less, names)}: the target lies at the limit or less than the margin "
            "from it; the limit is tightened only up to the target",
            stacklevel=3,
        )
    return Box(low, high)


def _terminal_cost(
    system: LinearSystem, Q: np.ndarray, R: Reals, names: tuple[str, ...]
) -> np.ndarray:
    """Return P of the LQR; where inputs do not move all modes that last, P = T P_r T' with P_r of
    the LQR on the subspace that they reach, T (n, r) an orthonormal basis of it.

    The reached part T'x follows T'AT and T'B, driven by the rest as by a disturbance, which P
    leaves out: no input changes that rest.
    """
    A, B = np.asarray(system.A), np.asarray(system.B)
    if least_reached(A, B)[0] > _UNREACHED:
        return np.asarray(lqr(system, Q, R).P)
    T = reached_subspace(A, B)
    unmoved = np.flatnonzero(np.linalg.norm(T, axis=1) < 0.999)
    warnings.warn(
        f"terminal_cost: inputs do not move all of {_listed(unmoved, names)} (no equilibrium there "
        "is stabilizable); it is the LQR's of what they move",
        stacklevel=3,
    )
    reduced = LinearSystem(T.T @ A @ T, T.T @ B)
    return T @ np.asarray(lqr(reduced, T.T @ Q @ T, R).P) @ T.T


# Modes closer than this to unreachable count as such, as in `lqr`.
_UNREACHED = 1e-10


def reached_subspace(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis T (n, r) of what inputs reach, the span of B, AB, A²B, ...

    F = A − I reaches the same, and moves each direction by as much as one time step does.
    Directions that it moves by less than 1e-9 of |F| count as not reached.
    """
    F = A - np.eye(len(A))
    F = F / max(np.linalg.norm(F, 2), np.finfo(np.float64).tiny)
    T, new = np.zeros((len(A), 0)), B / np.linalg.norm(B, 2)
    while new.shape[1] and T.shape[1] < len(A):
        for _ in range(2):  # once more removes what rounding left
            new = new - T @ (T.T @ new)
        directions, sizes, _ = np.linalg.svd(new, full_matrices=False)
        new = directions[:, sizes > 1e-9]
        T, new = np.hstack([T, new]), F @ new
    return T


def _listed(which: np.ndarray, names: tuple[str, ...], most: int = 6) -> str:
    """Return the first names, and how many more there are."""
    found = [names[i] for i in which]
    return ", ".join(found[:most]) + (f" and {len(found) - most} more" if found[most:] else "")


def robot_references(
    robot: Robot | LinearPlant, target: Reals | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return reference (n,) and input_reference (m,) with which a robot rests at the target, as in
    `robot_mpc`, which warns where it cannot."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        state, inputs = robot.set_point(target)
    with jax.enable_x64(True):
        return np.asarray(robot.coordinates(state)), np.asarray(inputs)
