"""Limits of the forces of actuators, joints and tendons, as rows of the problem of a plan.

MuJoCo cuts a force off at `forcerange` of its actuator, and the sum of the actuators of a joint or
a tendon at `actuatorfrcrange`. A linear model that knows nothing of this promises motions which the
plant cannot follow. Before it is cut off, a force is

    gain u + bias₀ + bias₁ length + bias₂ speed

of the actuator, affine in ξ and u where the length is that of joints or of a fixed tendon, as in
the position and velocity servos of most arms. So each limit is a row lower ≤ C ξ + D u ≤ upper.
Motors, whose force is a multiple of u, have theirs in `Robot.input_limits` (`load.py`).

A limited force needs a distance to stop: at the speed v at least v²/2a with the deceleration a. The
states of a plan have to leave it, or the limits are kept for the horizon and broken after it.

The rows hold when the input is set. Until the next one the unlimited force of a stiff servo grows
as the joint moves on, and the linear model brakes more than the plant; rows at the end or in the
middle of the period would leave out the largest forces that the plant has.
"""

from typing import Any

import jax
import numpy as np

from jaxmpc.arrays import module_of
from jaxmpc.mpc.problem import Outputs
from jaxmpc.pytrees import pytree
from jaxmpc.robots.description import RobotDescription, host_coordinates
from jaxmpc.robots.mujoco_access import SLIDE, moment_arms, mujoco, name_of, single_joints
from jaxmpc.sets.convex_sets import Box

# Step of central differences in ξ and u: of an affine function any step gives the derivative.
STEP = 1e-4
# Derivatives that count as rounding, relative to the largest of their row.
DERIVATIVE_ROUNDING = 1e-9
# Distances, as fractions of a joint's range, between which the parabola of stopping has its chords.
DISTANCES = np.array([0.0, 1 / 64, 1 / 16, 1 / 4, 1.0])


@pytree
class ForceLimits(Outputs):
    """Limits of forces that the plant keeps whatever the input, by cutting the forces off."""


@pytree
class StoppingLimits(Outputs):
    """Rows of states from which limited forces stop joints, see `stopping_limits`."""


def force_limits(robot: RobotDescription, x: Any, u: Any) -> ForceLimits | None:
    """Return the limits of forces that are not limits of inputs, None where there are none.

    x (nq + nv + na,), u (m,): where forces are linearised that are not affine, such as those of
    actuators at sites, and of joints with compensated gravity. The rows are in N or N m, those of
    actuators before their gear. Computed in float64 by MuJoCo's C engine.
    """
    model = robot.mujoco
    actuators = np.flatnonzero(model.actuator_forcelimited)
    joints = np.flatnonzero(model.jnt_actfrclimited & single_joints(model))
    tendons = np.flatnonzero(model.tendon_actfrclimited)
    if not (len(actuators) or len(joints) or len(tendons)):
        return None
    smooth, n = robot.predictor.model, robot.n
    data, on_tendon = mujoco.MjData(smooth), _of_tendons(smooth)[tendons]

    def forces(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        data.qpos, data.qvel, act = np.split(x, [smooth.nq, smooth.nq + smooth.nv])
        data.ctrl = u
        if len(act):
            data.act = act
        mujoco.mj_forward(smooth, data)
        of_joints = data.qfrc_actuator[smooth.jnt_dofadr[joints]]
        of_all = data.actuator_force
        return np.concatenate([of_all[actuators], of_joints, on_tendon @ of_all])

    about = np.concatenate([host_coordinates(robot, x), np.asarray(u, float)])
    points = about + STEP * np.concatenate([np.eye(len(about)), -np.eye(len(about))])
    states = points[:, :n]
    if n != robot.state_size:
        with jax.enable_x64(True):
            states = np.asarray(jax.vmap(robot.state)(states))
    after, before = np.split(np.array(list(map(forces, states, points[:, n:]))), 2)
    slope = (after - before).T / (2 * STEP)
    slope[np.abs(slope) <= DERIVATIVE_ROUNDING * np.abs(slope).max(axis=1, keepdims=True)] = 0.0
    shift = forces(np.asarray(x, float), np.asarray(u, float)) - slope @ about
    ranges = [
        model.actuator_forcerange[actuators],
        model.jnt_actfrcrange[joints],
        model.tendon_actfrcrange[tendons],
    ]
    lower, upper = np.concatenate(ranges).T - shift
    names = [name_of(model, "actuator", i) for i in actuators]
    names += [f"actuators of {name_of(model, 'joint', i)}" for i in joints]
    names += [f"actuators of {name_of(model, 'tendon', i)}" for i in tendons]
    units = [""] * len(actuators)
    units += ["N" if model.jnt_type[i] == SLIDE else "N m" for i in joints]
    units += ["N"] * len(tendons)
    moved = slope.any(axis=1)  # what nothing moves is no limit of a plan
    if not moved.any():
        return None
    text = lambda values: tuple(value for value, yes in zip(values, moved, strict=True) if yes)
    return ForceLimits(
        slope[moved, :n],
        lower[moved],
        upper[moved],
        slope[moved, n:],
        names=text([f"force of {name}" for name in names]),
        units=text(units),
    )


def stopping_limits(robot: RobotDescription, q: Any, positions: Box) -> StoppingLimits | None:
    """Return the rows of states from which limited forces stop each joint within its positions.

    Of a joint at q_i with the speed v > 0, all of whose actuators have limits of their forces,
    v ≤ √(2 a (upper − q_i)), and likewise below. a: what the limits leave at the configuration q
    (nq,) at rest beside gravity and springs, over the joint's own inertia: other joints stand
    still. The parabola, a convex set, is replaced by chords (`DISTANCES`), up to 6 % inside.
    positions: Box of the coordinates (n,), bounded where `state_limits` are. None where there is
    no such joint.
    """
    model, smooth = robot.mujoco, robot.predictor.model
    data = mujoco.MjData(smooth)
    data.qpos[:] = q
    mujoco.mj_forward(smooth, data)
    rest, moved = data.qfrc_passive - data.qfrc_bias, np.zeros(smooth.nv)
    moment = moment_arms(smooth, data)
    ends = np.where(
        model.actuator_forcelimited[:, None], model.actuator_forcerange, [-np.inf, np.inf]
    )
    on_tendon = _of_tendons(smooth).astype(bool)
    for tendon in np.flatnonzero(model.tendon_actfrclimited & on_tendon.any(axis=1)):
        pulls = on_tendon[tendon]
        share = model.tendon_actfrcrange[tendon] / pulls.sum()
        ends[pulls, 0] = np.maximum(ends[pulls, 0], share[0])
        ends[pulls, 1] = np.minimum(ends[pulls, 1], share[1])
    xp = module_of(positions)
    lower, upper = (xp.asarray(side) for side in (positions.lower, positions.upper))
    bounded = np.isfinite(np.subtract(*robot.state_limits.bounds()))
    # Chords of v = √(2 a d) between distances d = D w, w the width of the range: √(w/a) v = √(2 D),
    # so that their slopes are √(a/w) times these.
    speeds = np.sqrt(2 * DISTANCES)
    slopes = np.diff(speeds) / np.diff(DISTANCES)
    rows = list[tuple[Any, Any, str]]()
    for joint in np.flatnonzero(single_joints(model)):
        i = model.jnt_dofadr[joint]
        pulls = moment[:, i] != 0
        if not pulls.any() or not bounded[i]:
            continue
        force = np.sort(moment[pulls, i, None] * ends[pulls], axis=1).sum(axis=0)
        if model.jnt_actfrclimited[joint]:
            force = np.clip(force, *model.jnt_actfrcrange[joint])
        mujoco.mj_mulM(smooth, data, moved, np.eye(smooth.nv)[i])
        slower, faster = (force + rest[i]) / moved[i]
        for sign, end, stop in ((1.0, upper[i], -slower), (-1.0, -lower[i], faster)):
            if not (0 < stop < np.inf):
                continue
            width, name = upper[i] - lower[i], name_of(model, "joint", joint)
            for slope, distance, speed in zip(slopes, DISTANCES, speeds, strict=False):
                # v − speed ≤ slope (end ∓ q − distance), in the unit of the position.
                time = xp.sqrt(width / stop) / slope
                row = sign * (np.eye(robot.n)[i] + time * np.eye(robot.n)[smooth.nv + i])
                rows.append((row, end + width * (speed / slope - distance), f"stopping of {name}"))
    if not rows:
        return None
    C, above, names = zip(*rows, strict=True)
    return StoppingLimits(xp.stack(C), upper=xp.stack(above), names=names)


def _of_tendons(model: "mujoco.MjModel") -> np.ndarray:
    """Return which actuators pull at which tendon, (ntendon, nu) of 0 and 1."""
    pulls = model.actuator_trntype == mujoco.mjtTrn.mjTRN_TENDON
    return (pulls & (model.actuator_trnid[:, 0] == np.arange(model.ntendon)[:, None])).astype(float)
