"""Gaits: feet that stand in turn under a trunk of constant velocity, and linear models along that.

A foot stands for the part `duty` of each period, still on the ground, and swings for the rest, from
where it left to where it stands next. So relative to the trunk, which moves with the velocity v, it
goes back by v T duty and forward again, in an arc. Inverse kinematics gives the joints, their
differences the velocities, and each control period of a period of the gait has a linear model of
its own, with the contact forces of the feet that stand (`contacts.py`), and friction cones.

The motion is a reference: what a plan stays close to, not what it is bound to. Its linear models
are exact in the inputs, since motions are affine in them.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.checks import fail, number, require_finite, require_kind, require_shape
from jaxmpc.pytrees import pytree, static
from jaxmpc.qp.jax_transformations import compiled_lightly
from jaxmpc.robots.contacts import STANDING, linear_cones
from jaxmpc.robots.description import host_coordinates
from jaxmpc.robots.mujoco_access import FREE, mujoco, single_joints
from jaxmpc.robots.robot import Robot
from jaxmpc.systems.system import LinearSystem

# Control periods of a swing at least: with fewer a foot does not leave the ground.
_SWING = 3
# Newton steps of inverse kinematics at most, and the distance (m) that counts as reached.
_STEPS, _REACHED = 100, 1e-9


class Cones(NamedTuple):
    """Friction cones of feet, C ξ + D u ≤ upper: C (P, 4k, n), D (P, 4k, m), upper (P, 4k), ∞ in
    the rows of feet that swing."""

    C: Any
    D: Any
    upper: Any


@pytree
class Gait:
    """A motion that repeats itself after P control periods, from `gait`.

    robot: with the model of these feet. standing (P, k): whether each foot stands. states (P, n):
    coordinates ξ; advance (n,): by which they differ a period later. inputs (m,): torques of rest.
    system: linear models, A (P, n, n), B (P, n, m), c (P, n), from one control period to the next.
    cones: of the feet that stand.
    """

    robot: Robot
    standing: Any
    states: Any
    advance: Any
    inputs: Any
    system: LinearSystem
    cones: Cones
    names: tuple[str, ...] = static(default=())

    @property
    def period(self) -> int:
        """Number P of control periods."""
        return int(np.shape(self.states)[0])

    def reference(self, count: int, start: Any = 0) -> Any:
        """Return the coordinates (count, n) from the control period `start` on."""
        steps = start + np.arange(count)
        return self.states[steps % self.period] + (steps // self.period)[:, None] * self.advance


def gait(
    robot: Robot,
    feet: Sequence[str],
    velocity: Sequence[float] = (0.5, 0.0),
    *,
    period: float = 0.44,
    duty: float = 0.57,
    offsets: Sequence[float] | None = None,
    lift: float = 0.06,
    friction: float | None = None,
) -> Gait:
    """Return a gait of a legged robot about its home.

    Arguments:
        robot: with a free base, and legs of hinges and slides.
        feet: names of geoms, spheres that touch flat ground at home, one a leg.
        velocity: of the trunk along x and y, m/s.
        period: seconds from one step of a foot to its next.
        duty: part of the period for which a foot stands, in (0, 1).
        offsets: when each foot begins to stand, in parts of the period. None: every other foot
            round the trunk together, 0 and ½: the trot of four feet, the tripod of six.
        lift: height (m) of the arcs.
        friction: coefficient that plans count on, None for 80 % of the file's.

    Raises ValueError for other robots and numbers, and where a foot cannot reach its step.
    """
    require_kind("robot", robot, Robot)
    feet = tuple(feet)
    standing_robot = robot.standing(feet, friction=friction)
    model = robot.mujoco
    _require_level_ground(standing_robot)
    if not model.njnt or model.jnt_type[0] != FREE or not np.all(single_joints(model)[1:]):
        fail("robot", f"{robot.name} has other joints", "Give a free base, then hinges and slides")
    require_shape("velocity", velocity, (2,), "Along x and y, in m/s")
    require_finite("velocity", velocity)
    for name, value in (("period", period), ("lift", lift)):
        number(name, value, np.finfo(float).tiny, "Give a positive number")
    if not 0 < duty < 1:
        fail("duty", f"{duty}", "Give a part of the period in (0, 1)")
    count = round(period / robot.dt)
    if count < 4:
        fail("period", f"{period} s is {count} control periods", "Give at least 4 of them")
    try:
        x_rest, u_rest = standing_robot.equilibrium()
    except ValueError:  # which says what is missing
        cure = "Name all feet that touch the ground, and put home's centre of mass above them"
        fail("feet", f"{', '.join(feet)} do not carry {robot.name} at home", cure)
    places = _places(model, x_rest[: model.nq], feet)
    starts = (
        _alternating(places - places.mean(axis=0))
        if offsets is None
        else np.asarray(offsets, float)
    )
    require_shape("offsets", starts, (len(feet),), "One for each foot")
    require_finite("offsets", starts)

    phases = (np.arange(count)[:, None] / count - starts) % 1.0
    standing = phases < duty - 1e-9
    _require_swings(feet, standing, duty)
    steps = np.append(velocity, 0.0) * count * robot.dt * duty
    away = steps * _along(phases, duty)[:, :, None] + [0, 0, lift] * _arc(phases, duty)[:, :, None]
    q = _joints(robot, x_rest[: model.nq], feet, places + away)
    joints = q[:, 7:]
    speeds = (np.roll(joints, -1, axis=0) - np.roll(joints, 1, axis=0)) / (2 * robot.dt)
    v = np.zeros((count, model.nv))
    v[:, :2], v[:, 6:] = velocity, speeds
    q[:, :2] += np.arange(count)[:, None] * robot.dt * np.asarray(velocity, float)
    rest = np.broadcast_to(x_rest[model.nq + model.nv :], (count, model.na))
    states = host_coordinates(robot, np.hstack([q, v, rest]))
    advance = np.zeros(robot.n)
    advance[:2] = np.asarray(velocity, float) * count * robot.dt

    with jax.enable_x64(True):
        given = (jnp.asarray(v, float) for v in (states, u_rest, standing))
        system, (C, D, upper) = jax.tree.map(np.asarray, _models(standing_robot, *given))
    faces = np.repeat(standing, 4, axis=1)
    return Gait(
        robot=standing_robot,
        standing=standing,
        states=states,
        advance=advance,
        inputs=u_rest,
        system=system,
        cones=Cones(C, D, np.where(faces, upper, np.inf)),
        names=feet,
    )


def _require_level_ground(robot: Robot) -> None:
    """Raise ValueError unless the feet stand on ground whose normal is z."""
    predictor: Any = robot.predictor
    normals = predictor.feet.frames[:, 0]
    tilts = np.abs(normals - [0, 0, 1]).max(axis=1)
    if tilts.max() > 1e-6:
        what = f"stands on ground with the normal {np.round(normals[tilts.argmax()], 4).tolist()}"
        cure = "Turn the world of the file so that z is up: the trunk moves in x and y"
        fail("robot", what, cure)


def _require_swings(feet: Sequence[str], standing: np.ndarray, duty: float) -> None:
    """Raise ValueError unless each foot stands and swings for enough of the control periods (P, k)
    of `standing`."""
    count = len(standing)
    for foot, stands in zip(feet, standing.sum(axis=0), strict=True):
        if stands < 1 or count - stands < _SWING:
            what = f"{duty}: {foot} stands at {stands} of {count} control periods"
            by = "another duty, a longer period or a shorter control_period"
            fail("duty", what, f"Let it stand at 1 of them and swing at {_SWING} at least: {by}")


@compiled_lightly(0)
def _models(robot: Robot, states: Any, u: Any, standing: Any) -> tuple[LinearSystem, tuple]:
    """Return the linear models (P, ...) and the friction cones at states ξ (P, n) of rows of feet
    that stand."""

    def at(xi: Any, stands: Any) -> tuple[LinearSystem, tuple]:
        numbers = {STANDING: stands}
        system = robot.linearize(robot.state(xi), u, exact=True, numbers=numbers)
        return system, linear_cones(robot, numbers, xi, u)

    return jax.vmap(at)(states, standing)


def _alternating(places: np.ndarray) -> np.ndarray:
    """Return 0 and ½ for every other foot round the trunk; places (k, 3) from their middle."""
    order = np.argsort(np.arctan2(places[:, 1], places[:, 0]))
    starts = np.zeros(len(places))
    starts[order[1::2]] = 0.5
    return starts


def _along(phases: np.ndarray, duty: float) -> np.ndarray:
    """Return where feet are relative to the trunk, from ½, where they begin to stand, to −½ and
    back; in the swing as smoothly as five powers allow."""
    swing = np.clip((phases - duty) / (1 - duty), 0.0, 1.0)
    forward = swing**3 * (10 - 15 * swing + 6 * swing**2)
    return np.where(phases < duty, 0.5 - phases / duty, -0.5 + forward)


def _arc(phases: np.ndarray, duty: float) -> np.ndarray:
    """Return the heights of feet as parts of the highest."""
    swing = np.clip((phases - duty) / (1 - duty), 0.0, 1.0)
    return 16 * (swing * (1 - swing)) ** 2


def _places(model: Any, q: np.ndarray, feet: Sequence[str]) -> np.ndarray:
    """Return the positions (k, 3) of feet."""
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    return np.array([data.geom(name).xpos for name in feet])


def _joints(robot: Robot, home: np.ndarray, feet: Sequence[str], goals: np.ndarray) -> np.ndarray:
    """Return configurations (P, nq) with the base at home and the feet at `goals` (P, k, 3), by
    Gauss-Newton steps from the one before."""
    model = robot.mujoco
    data, J = mujoco.MjData(model), np.zeros((3, model.nv))
    geoms = [model.geom(name).id for name in feet]
    lower, upper = (end[6 : model.nv] for end in robot.state_limits.bounds())
    q, found, at_home = home.copy(), [], _places(model, home, feet)
    for goal in goals:
        for _ in range(_STEPS):
            data.qpos[:] = q
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            away, rows = goal - data.geom_xpos[geoms], []
            if np.abs(away).max() < _REACHED:
                break
            for geom in geoms:
                mujoco.mj_jacGeom(model, data, J, None, geom)
                rows.append(J[:, 6:].copy())
            q[7:] += np.linalg.lstsq(np.vstack(rows), away.ravel(), rcond=1e-6)[0]
        missed = np.abs(away).max(axis=1)
        worst = int(np.argmax(missed))
        problem = ""
        if missed[worst] >= _REACHED:
            problem = f"geom {feet[worst]} stays {missed[worst]:.3g} m from its step"
        elif np.any((q[7:] < lower) | (q[7:] > upper)):
            joint = int(np.argmax(np.maximum(lower - q[7:], q[7:] - upper))) + 1
            problem = f"joint {model.joint(joint).name} would pass its limits"
        if problem:
            along, up = np.abs(goal - at_home).max(axis=0)[:2].max(), (goal - at_home)[:, 2].max()
            cure = "Give a smaller velocity, lift, or a shorter period"
            fail("lift" if up > along else "velocity", problem, cure)
        found.append(q.copy())
    return np.array(found)
