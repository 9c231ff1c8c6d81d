"""Gaits: feet that stand in turn under a trunk of constant velocity, and linear models along that.

A foot stands for the part `duty` of each period, still on the ground, and swings for the rest, from
where it left to where it stands next. The trunk moves along a line or a circle (`TrunkPath`), and
relative to it a foot goes back by v T duty and forward again, in an arc. Inverse kinematics gives
the joints, their differences the velocities, and each control period of a period of the gait has a
linear model of its own, with the contact forces of the feet that stand (`contacts.py`), and
friction cones.

Coordinates are relative to the path: those of a state moved back to where the path begins, so that
the motion repeats itself, wherever it has come to. A linear model goes from those of one control
period to those of the next. The motion is a reference: what a plan stays close to, not what it is
bound to. Its linear models are exact in the inputs but for the turn of the trunk, since motions are
affine in them.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import as_floats
from jaxmpc.checks import concrete, fail, positive, require_finite, require_kind, require_shape
from jaxmpc.pytrees import named_pytree, pytree, static
from jaxmpc.qp.jax_transformations import compiled_lightly, on_host
from jaxmpc.qp.linalg import matmul
from jaxmpc.robots.configurations import product
from jaxmpc.robots.contacts import FACES, STANDING, linear_cones
from jaxmpc.robots.description import host_coordinates
from jaxmpc.robots.mujoco_access import FREE, mujoco, single_joints
from jaxmpc.robots.robot import Robot
from jaxmpc.systems.system import LinearSystem

# Control periods of a swing at least: with fewer a foot does not leave the ground.
_SWING = 3
# Of parts of a period.
_ROUNDING = 1e-9
# Newton steps of inverse kinematics at most, and the distance (m) that counts as reached.
_STEPS, _REACHED = 100, 1e-9


class Cones(NamedTuple):
    """Friction cones of feet, C ξ + D u ≤ upper: C (P, 5k, n), D (P, 5k, m), upper (P, 5k), ∞ in
    the rows of feet that swing."""

    C: Any
    D: Any
    upper: Any


@named_pytree
class TrunkPath(NamedTuple):
    """How the trunk moves in the plane, from `home` (2,) on: with the velocity (2,) along x and y,
    m/s, both of which turn with it at the rate `turn`, rad/s.

    A motion of constant twist: what it does in −t seconds is the inverse of what it does in t."""

    velocity: Any
    turn: Any
    home: Any

    def places(self, places: Any, seconds: Any) -> Array:
        """Return places (..., 2) moved with the trunk for so many seconds (...)."""
        half = self.turn * seconds / 2
        length = seconds * jnp.sinc(half / np.pi)
        moved = self.home + length[..., None] * _rotated(self.velocity, half)
        return moved + _rotated(places - self.home, 2 * half)

    def state(self, x: Array, nq: int, seconds: Any) -> Array:
        """Return the state x = (qpos (nq,), qvel, act) of a robot with a free base moved with the
        trunk for so many seconds."""
        half, speeds = self.turn * seconds / 2, slice(nq, nq + 2)
        zero = jnp.zeros_like(half)
        heading = product(jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)]), x[3:7])
        x = x.at[:2].set(self.places(x[:2], seconds)).at[3:7].set(heading)
        return x.at[speeds].set(_rotated(x[speeds], 2 * half))


def _rotated(vectors: Any, angle: Any) -> Array:
    """Return vectors (..., 2) turned by an angle, rad."""
    x, y, cos, sin = vectors[..., 0], vectors[..., 1], jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


@pytree
class Gait:
    """A motion that repeats itself after P control periods, from `gait`.

    robot: with the model of these feet. path: of the trunk. standing (P, k): whether each foot
    stands. states (P, n): coordinates relative to the path. inputs (m,): torques of rest. system:
    linear models of these coordinates, A (P, n, n), B (P, n, m), c (P, n), from one control period
    to the next. cones: of the feet that stand.
    """

    robot: Robot
    path: TrunkPath
    standing: Any
    states: Any
    inputs: Any
    system: LinearSystem
    cones: Cones
    names: tuple[str, ...] = static(default=())

    @property
    def period(self) -> int:
        """Number P of control periods."""
        return int(np.shape(self.states)[0])

    def reference(self, count: int, start: Any = 0) -> Any:
        """Return the coordinates ξ (count, n) of the motion from the control period `start` on."""
        if not concrete(start, self.states):
            steps = start + jnp.arange(count)
            return jax.vmap(self.in_the_world)(jnp.asarray(self.states)[steps % self.period], steps)
        with jax.enable_x64(True), jax.ensure_compile_time_eval():
            steps = start + np.arange(count)
            states = np.asarray(self.states, float)[steps % self.period]
            return np.asarray(jax.vmap(self.in_the_world)(states, steps))

    def relative(self, x: Array, t: Any) -> Array:
        """Return the coordinates (n,), relative to the path, of a state x (nq + nv + na,) at the
        control period t."""
        return self.robot.coordinates(self._moved(x, t, -1.0))

    def in_the_world(self, relative: Array, t: Any) -> Array:
        """Return the coordinates ξ (n,) that these are at the control period t."""
        return self.robot.coordinates(self._moved(self.robot.state(relative), t))

    def _moved(self, x: Array, t: Any, sign: float = 1.0) -> Array:
        x = jnp.asarray(as_floats(x))
        seconds = sign * self.robot.dt * jnp.asarray(t, x.dtype)
        path = jax.tree.map(lambda v: jnp.asarray(v, x.dtype), self.path)
        return path.state(x, self.robot.mujoco.nq, seconds)


@on_host
def gait(
    robot: Robot,
    feet: Sequence[str],
    velocity: Sequence[float] = (0.5, 0.0),
    *,
    turn: float = 0.0,
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
        velocity: of the trunk along x and y, m/s; these turn with it.
        turn: rate at which the trunk turns about z, rad/s, to the left where it is positive.
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
    require_shape("turn", turn, (), "A number, in rad/s")
    require_finite("turn", turn)
    _require_same_forces(robot, turn)
    for name, value in (("period", period), ("lift", lift)):
        positive(name, value)
    require_shape("duty", duty, (), "One number for all feet")
    if not 0 < duty < 1:
        fail("duty", f"{duty}", "Give a part of the period in (0, 1)")
    count = round(period / robot.dt)
    if count < 4:
        fail("period", f"{period} s is {count} control periods", "Give at least 4 of them")
    try:
        x_rest, u_rest = standing_robot.equilibrium()
    except ValueError as error:
        if "no input balances" not in str(error):
            raise
        cure = "Name all feet that touch the ground, and put home's centre of mass above them"
        fail("feet", f"{', '.join(feet)} do not carry {robot.name} at home", cure)
    places = _places(model, x_rest[: model.nq], feet)
    starts = (
        _alternating(places - places.mean(axis=0), x_rest[3:7])
        if offsets is None
        else np.asarray(offsets, float)
    )
    require_shape("offsets", starts, (len(feet),), "One for each foot")
    require_finite("offsets", starts)

    phases = _phases(count, starts)
    standing = phases < duty - _ROUNDING
    _require_swings(feet, standing, duty)
    path = TrunkPath(np.asarray(velocity, float), np.asarray(turn, float), x_rest[:2])
    goals = np.empty((count, len(feet), 3))
    goals[:, :, :2] = _paths(path, places[:, :2], phases, duty, count * robot.dt * duty)
    goals[:, :, 2] = places[:, 2] + lift * _arc(phases, duty)
    states = _states(robot, x_rest, _joints(robot, x_rest[: model.nq], feet, goals), path)

    with jax.enable_x64(True):
        given = (jnp.asarray(v, float) for v in (states, u_rest, standing))
        system, (C, D, upper) = jax.tree.map(np.asarray, _models(standing_robot, path, *given))
    faces = np.repeat(standing, FACES, axis=1)
    return Gait(
        robot=standing_robot,
        path=path,
        standing=standing,
        states=states,
        inputs=u_rest,
        system=system,
        cones=Cones(C, D, np.where(faces, upper, np.inf)),
        names=feet,
    )


def _phases(count: int, starts: np.ndarray) -> np.ndarray:
    """Return for each of `count` control periods of a period and each foot (k,) which part of the
    period has gone since it began to stand, in [0, 1); -1e-17 is the beginning, not the end."""
    parts = np.arange(count)[:, None] / count - starts
    return np.maximum((parts + _ROUNDING) % 1.0 - _ROUNDING, 0.0)


def _require_level_ground(robot: Robot) -> None:
    """Raise ValueError unless the feet stand on ground whose normal is z, at one height."""
    feet: Any = robot.predictor.feet  # type: ignore[attr-defined]
    normals = feet.frames[:, 0]
    tilts = np.abs(normals - [0, 0, 1]).max(axis=1)
    if tilts.max() > 1e-6:
        what = f"stands on ground with the normal {np.round(normals[tilts.argmax()], 4).tolist()}"
        cure = "Turn the world of the file so that z is up: the trunk moves in x and y"
        fail("robot", what, cure)
    ground = _places(robot.mujoco, robot.home[: robot.mujoco.nq], feet.names)[:, 2]
    ground = ground - feet.radius - feet.distance
    if np.ptp(ground) > 1e-3 * feet.radius.min():
        what = f"stands at the heights {np.round(ground, 4).tolist()} m"
        cure = "Give a home= on flat ground: each foot steps on ground as high as it began on"
        fail("robot", what, cure)


def _require_same_forces(robot: Robot, turn: float) -> None:
    """Raise ValueError where the forces on a trunk that turns depend on its heading: the motion,
    and models along it, then do not repeat themselves."""
    options = robot.mujoco.opt
    for name, acts in (("gravity", options.gravity), ("wind", options.wind)):
        if turn and np.any(acts[:2]):
            what = f"is {turn:g} rad/s, and the file's {name} acts along x or y: {acts.tolist()}"
            cure = "Let turn be 0: models repeat themselves where the heading changes nothing"
            fail("turn", what, cure)


def _require_swings(feet: Sequence[str], standing: np.ndarray, duty: float) -> None:
    """Raise ValueError unless each foot stands and swings for enough of the control periods (P, k)
    of `standing`."""
    count = len(standing)
    for foot, stands in zip(feet, standing.sum(axis=0), strict=True):
        if stands < 1 or count - stands < _SWING:
            what = f"{duty}: {foot} stands at {stands} of {count} control periods"
            by = "another duty, a longer period or a shorter control_period"
            fail("duty", what, f"Let it stand at 1 of them and swing at {_SWING} at least: {by}")


def _states(robot: Robot, x_rest: np.ndarray, q: np.ndarray, path: TrunkPath) -> np.ndarray:
    """Return the coordinates (P, n) of configurations (P, nq) that repeat themselves, with the base
    at home, moving along the path; activations are those of the rest."""
    model, joints = robot.mujoco, q[:, 7:]
    speeds = (np.roll(joints, -1, axis=0) - np.roll(joints, 1, axis=0)) / (2 * robot.dt)
    _require_slow(robot, speeds)
    v = np.zeros((len(q), model.nv))
    v[:, :2], v[:, 6:] = path.velocity, speeds
    # (Angular velocities of a free base are in its own frame.)
    v[:, 3:6] = path.turn * _matrix(x_rest[3:7])[2]
    rest = np.broadcast_to(x_rest[model.nq + model.nv :], (len(q), model.na))
    return host_coordinates(robot, np.hstack([q, v, rest]))


def _require_slow(robot: Robot, speeds: np.ndarray) -> None:
    """Raise ValueError where the speeds (P, nv − 6) of joints pass their limits."""
    first = robot.mujoco.nv + 6
    lower, upper = (end[first : first + speeds.shape[1]] for end in robot.state_limits.bounds())
    over = np.maximum(lower - speeds, speeds - upper).max(axis=0)
    worst = int(np.argmax(over))
    if over[worst] > 0:
        name, most = robot.state_names[first + worst], np.abs(speeds[:, worst]).max()
        problem = f"{name} would be {most:.3g}, its limits are [{lower[worst]:g}, {upper[worst]:g}]"
        fail("velocity", problem, "Give a smaller velocity, turn or lift, or a longer period")


def _matrix(quaternion: np.ndarray) -> np.ndarray:
    """Return the axes of a body with this orientation in the world, as columns."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


@compiled_lightly(0)
def _models(
    robot: Robot, path: TrunkPath, states: Any, u: Any, standing: Any
) -> tuple[LinearSystem, tuple]:
    """Return the linear models (P, ...) and the friction cones at relative coordinates (P, n) of
    rows of feet that stand."""

    def moved_back(xi: Array) -> tuple[Array, Array]:
        back = jnp.asarray(-robot.dt, xi.dtype)
        relative = robot.coordinates(path.state(robot.state(xi), robot.mujoco.nq, back))
        return relative, relative

    def at(xi: Any, stands: Any) -> tuple[LinearSystem, tuple]:
        numbers = {STANDING: stands}
        system = robot.linearize(robot.state(xi), u, exact=True, numbers=numbers)
        A, B, c = (jnp.asarray(v) for v in (system.A, system.B, system.c))
        after = matmul(A, xi) + matmul(B, u) + c
        J, relative = jax.jacfwd(moved_back, has_aux=True)(after)
        A, B = matmul(J, A), matmul(J, B)
        c = relative - matmul(A, xi) - matmul(B, u)
        return replace(system, A=A, B=B, c=c), linear_cones(robot, numbers, xi, u)

    return jax.vmap(at)(states, standing)


def _alternating(places: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """Return 0 and ½ for every other foot round the trunk, whatever its heading; places (k, 3) from
    their middle, quaternion of the trunk."""
    ahead, aside = _matrix(quaternion)[:2, 0]
    angles = np.arctan2(places[:, 1], places[:, 0]) - np.arctan2(aside, ahead)
    order = np.argsort((angles + np.pi) % (2 * np.pi))
    starts = np.zeros(len(places))
    starts[order[1::2]] = 0.5
    return starts


def _paths(
    path: TrunkPath, places: np.ndarray, phases: np.ndarray, duty: float, stance: float
) -> np.ndarray:
    """Return where feet with these places (k, 2) under the trunk at rest are relative to it, in x
    and y (P, k, 2): while they stand the trunk moves on for `stance` seconds."""
    along = _along(phases, duty)
    with jax.enable_x64(True):
        moved = lambda part: np.asarray(path.places(places, jnp.asarray(part * stance)))
        back, front, stands = moved(-0.5), moved(0.5), moved(along)
    swings = back + (0.5 + along)[:, :, None] * (front - back)
    return np.where(phases[:, :, None] < duty, stands, swings)


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
            cure = "Give a smaller velocity, turn or lift, or a shorter period"
            fail("lift" if up > along else "velocity", problem, cure)
        found.append(q.copy())
    return np.array(found)
