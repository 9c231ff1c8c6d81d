"""Feet that stand: contact forces in the model of a plan, and their friction cones as its rows.

A foot that stands does not move. With the velocities J v of the points of contact, along the normal
and two tangents of each, and the contact forces λ there, the model is

    M a = τ(q, v, u) + J'λ,        J a + J̇ v = −β J v,

the rigid contact of inelastic feet: what velocity a foot has dies away at the rate β (1/s), that of
the file's own contacts (solref), and none arises. M and τ hold all else: inertia, gravity,
springs, actuators, the integrator's implicit part. The second line gives the forces,

    λ = −(J M⁻¹ J')⁻¹ (J M⁻¹ τ + J̇ v + β J v),

a function of state and input like the force of a servo, so that the inputs of the plan stay those
of the plant. Its other half is that a foot can push but not pull, and slides where it is pushed
sideways too hard: |λ_1| + |λ_2| ≤ μ λ_n, the pyramid that MuJoCo's own cones hold or contain. These
are rows in ξ and u of `robot_mpc` (`friction_cones`), not of the model, in which feet never slip.

The plant keeps its real contacts: springs that sink in, slide, and let go.

Feet that stand in turn (`gaits.py`) are one model too: those that swing have no rows, and no force.
"""

import copy
import functools
import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.linalg import block_diag

from jaxmpc.arrays import as_floats
from jaxmpc.checks import fail, number
from jaxmpc.pytrees import record
from jaxmpc.qp.linalg import matmul, solve
from jaxmpc.robots.configurations import normalised, retract
from jaxmpc.robots.description import RobotDescription
from jaxmpc.robots.force_limits import ForceLimits
from jaxmpc.robots.mujoco_access import acts, equalities, mujoco, names, number_of
from jaxmpc.robots.parameters import require_numbers
from jaxmpc.robots.physics import RK4, Physics, in_force

# Distances of feet from the ground, in their radius, up to which they are looked for, and up to
# which they touch.
_NEAR, _TOUCHING = 2.5, 0.25
# Part of the file's friction that plans count on: what the model leaves out needs the rest.
_FRICTION = 0.8
# Smallest motion of a foot, relative to the largest, that counts as one.
_RANK = 1e-6
# Faces of the friction cone of a foot.
FACES = 5
# Beside fields of mjx.Model: 1 for each foot (k,) that stands, 0 for one that swings.
STANDING = "feet_standing"


@record
class Feet:
    """Points of contact of feet that stand: spheres on the ground that they touch at home.

    names, geoms (k,): the feet, numbers of their geoms. radius (k,). distance (k,): from the ground
    at home, below 0 inside it. frames (k, 3, 3): rows normal (towards the foot) and two tangents.
    held (k, 3): whether there is a force along these; along the last tangent there is none where no
    joint moves the foot, as of a robot in a plane. friction (k,): coefficients of the plan. rate
    (k,): 1/s, by which a foot comes to rest.
    """

    names: tuple[str, ...]
    geoms: np.ndarray
    bodies: np.ndarray
    radius: np.ndarray
    distance: np.ndarray
    frames: np.ndarray
    held: np.ndarray
    friction: np.ndarray
    rate: np.ndarray

    @classmethod
    def touching(
        cls,
        model: "mujoco.MjModel",
        q: np.ndarray,
        feet: tuple[str, ...],
        friction: float | None,
    ) -> "Feet":
        """Return the feet of a model that touch the ground at q (nq,).

        feet: names of geoms. friction: coefficient for plans, None for 80 % of the file's. Raises
        ValueError for geoms that are no spheres or do not touch.
        """
        geoms = np.array([_foot(model, name) for name in feet], np.int32)
        if not acts(model, "contact"):
            cure = "Load it with its contacts: contacts=True, and no flag in the file"
            fail("robot", "has no contacts, and feet stand on the ground by these", cure)
        frames, coefficients, rates, distances = [], [], [], []
        found = _ground_contacts(model, q, geoms)
        for name, geom, (contact, sign) in zip(feet, geoms, found, strict=True):
            radius = model.geom_size[geom, 0]
            if contact is None or contact.dist > _TOUCHING * radius:
                away = "far" if contact is None else f"{contact.dist / radius:.3g} of its radius"
                problem = f"geom {name} is {away} from the ground at home"
                fail("feet", problem, "Give a home= in which the feet touch the ground")
            distances.append(contact.dist)
            if contact.dim == 1 and friction != 0:
                problem = f"geom {name} touches the ground without friction (condim 1)"
                fail("feet", problem, "Write condim 3 in the file, or give friction=0")
            frames.append(np.reshape(contact.frame, (3, 3)) * [[sign], [1], [1]])
            # Of a pair whose tangents differ the smaller one.
            coefficient = _FRICTION * contact.friction[:2].min()
            coefficients.append(coefficient if friction is None else friction)
            rates.append(_rate(model, contact))
        depths = -np.array(distances) / model.geom_size[geoms, 0]
        if max(depths) > _TOUCHING:
            name, by = feet[np.argmax(depths)], max(depths)
            text = f"geom {name} is {by:.2g} of its radius inside the ground at home"
            warnings.warn(f"{text}, which pushes it out: move home up", stacklevel=2)
        return cls(
            names=tuple(feet),
            geoms=geoms,
            bodies=model.geom_bodyid[geoms],
            radius=model.geom_size[geoms, 0],
            distance=np.array(distances),
            frames=np.array(frames),
            held=np.ones((len(feet), 3), bool),
            friction=np.array(coefficients),
            rate=np.array(rates),
        )

    def __len__(self) -> int:
        return len(self.names)

    def require_touching(self, argument: str, model: "mujoco.MjModel", q: np.ndarray) -> None:
        """Raise ValueError where feet are elsewhere than on the ground at q (nq,): forces of
        contact hold them at rest wherever they are."""
        contacts = _ground_contacts(model, q, self.geoms)
        for name, r, home, (contact, _) in zip(
            self.names, self.radius, self.distance, contacts, strict=True
        ):
            by = np.inf if contact is None else (contact.dist - home) / r
            if abs(by) > _TOUCHING:
                where = f"{abs(by):.3g} of its radius {'above' if by > 0 else 'inside'}"
                where = "far from" if contact is None else where
                cure = "Give a configuration in which all feet touch the ground, as home does"
                fail(argument, f"{q}: {name} is {where} the ground", cure)

    def jacobian(self, model: "mujoco.MjModel", data: "mujoco.MjData") -> np.ndarray:
        """Return J (3k, nv) of the velocities of the points of contact, by MuJoCo's C engine at the
        position in `data`."""
        rows, J = [], np.zeros((3, model.nv))
        for geom, body, r, frame in zip(
            self.geoms, self.bodies, self.radius, self.frames, strict=True
        ):
            point = data.geom_xpos[geom] - r * frame[0]
            mujoco.mj_jac(model, data, J, None, point, body)
            rows.append(frame @ J)
        return np.concatenate(rows)

    def in_planes(self, model: "mujoco.MjModel", q: np.ndarray) -> "Feet":
        """Return the feet with their last tangent along what no joint moves them, not held there.
        Raises ValueError where none moves one along its normal, or it moves on a line, at most."""
        data, random = mujoco.MjData(model), np.random.default_rng(0)
        somewhere = []
        for _ in range(4):
            data.qpos[:] = q
            mujoco.mj_integratePos(model, data.qpos, random.normal(size=model.nv), 1.0)
            mujoco.mj_forward(model, data)
            somewhere.append(self.jacobian(model, data).reshape(len(self), 3, -1))
        frames, held = self.frames.copy(), self.held.copy()
        for i, rows in enumerate(np.concatenate(somewhere, axis=2)):
            ways, sizes, _ = np.linalg.svd(rows)
            across = frames[i].T @ ways[:, 2]
            if sizes[2] >= _RANK * sizes[0]:
                continue
            normal = frames[i, 0]
            if abs(normal @ across) > _RANK or sizes[1] < _RANK * sizes[0]:
                along = (np.round(across, 3) + 0.0).tolist()
                problem = f"no joint moves {self.names[i]} along {along}"
                cure = "Give the robot a free base, or joints that move a foot in a plane at least"
                fail("feet", f"{problem}, where contact would push it", cure)
            frames[i], held[i, 2] = [normal, np.cross(across, normal), across], False
        return replace(self, frames=frames, held=held)

    @property
    def cone_names(self) -> tuple[str, ...]:
        """Return the names of the faces of the friction cones, five a foot."""
        rows = (*4 * ("friction cone",), "push")
        return tuple(f"{row} of {name}" for name in self.names for row in rows)

    def cones(self) -> np.ndarray:
        """Return the faces (5k, 3k) of the friction cones, F λ ≤ 0: ±λ_1 ± λ_2 ≤ μ λ_n, and
        0 ≤ λ_n, which follows but where μ is zero, or so small that breaking it costs little."""
        signs = [(1, 1), (1, -1), (-1, 1), (-1, -1)]
        faces = np.zeros((len(self), FACES, len(self), 3))
        for i, mu in enumerate(self.friction):
            faces[i, :, i] = [*((-mu, *pair) for pair in signs), (-1, 0, 0)]
        return faces.reshape(FACES * len(self), 3 * len(self))

    def edges(self) -> np.ndarray:
        """Return the edges R (3k, 4k) of the friction cones, λ = R r with r ≥ 0: (1, ±μ, 0) and
        (1, 0, ±μ), without the last forces where they are not held."""
        edges = [[[1, 1, 1, 1], [mu, -mu, 0, 0], [0, 0, mu, -mu]] for mu in self.friction]
        return self.held.reshape(-1, 1) * block_diag(*edges)


def touching_spheres(model: "mujoco.MjModel", q: np.ndarray) -> tuple[str, ...]:
    """Return the names of the spheres that touch the ground at q (nq,): those that may be feet."""
    spheres = model.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE
    moving = model.body_weldid[model.geom_bodyid] != 0
    geoms = [i for i in np.flatnonzero(spheres & moving) if names(model, "geom")[i]]
    found = zip(geoms, _ground_contacts(model, q, np.array(geoms, int)), strict=True)
    near = lambda i, contact: contact and contact.dist <= _TOUCHING * model.geom_size[i, 0]
    return tuple(names(model, "geom")[i] for i, (contact, _) in found if near(i, contact))


def _foot(model: "mujoco.MjModel", name: str) -> int:
    """Return the number of a foot's geom; raise ValueError for others."""
    geom = number_of(model, "geom", name)
    if geom < 0:
        known = ", ".join(filter(None, names(model, "geom"))) or "none has a name"
        fail("feet", f"no geom is named {name!r}", f"Name one of the geoms: {known}")
    if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_SPHERE:
        fail("feet", f"geom {name} is no sphere", "Feet are points: put spheres where they touch")
    if not model.body_weldid[model.geom_bodyid[geom]]:
        fail("feet", f"geom {name} is part of the world", "Name geoms of the robot")
    return geom


def _ground_contacts(
    model: "mujoco.MjModel", q: np.ndarray, geoms: np.ndarray
) -> list[tuple[Any, float]]:
    """Return `_ground_contact` of each of these geoms at q (nq,), also where they are near."""
    near, data = copy.deepcopy(model), mujoco.MjData(model)
    near.geom_margin[geoms] = _NEAR * model.geom_size[geoms, 0]
    data.qpos[:] = q
    mujoco.mj_forward(near, data)
    return [_ground_contact(model, data, geom) for geom in geoms]


def _ground_contact(model: "mujoco.MjModel", data: "mujoco.MjData", geom: int) -> tuple[Any, float]:
    """Return the deepest contact of a geom with the world, None for none, and the sign of its
    normal towards the geom."""
    found: tuple[Any, float] = None, 1.0
    for contact in data.contact:
        first, second = contact.geom
        other = second if first == geom else first
        if geom in (first, second) and not model.body_weldid[model.geom_bodyid[other]]:
            if found[0] is None or contact.dist < found[0].dist:
                # (A copy, for contacts go with their data.)
                found = copy.copy(contact), 1.0 if second == geom else -1.0
    return found


def _rate(model: "mujoco.MjModel", contact: Any) -> float:
    """Return the rate (1/s) at which a contact's reference acceleration brings a velocity to rest,
    once a physics step at most."""
    most, (first, second) = 1 / model.opt.timestep, contact.solref
    if first <= 0:
        return min(-second / contact.solimp[1], most)
    return min(2 / (contact.solimp[1] * first), most)


class StandingPhysics(Physics):
    """A model without contacts whose feet stand, all or those that the number `STANDING` says; see
    the top of this file."""

    def __init__(self, model: "mujoco.MjModel", feet: Feet) -> None:
        super().__init__(model)
        self.feet = feet
        self.own |= {STANDING: (len(feet),)}

    def _rates(self, numbers: dict[str, Array], q: Array, v: Array, act: Array, u: Array) -> Array:
        return self._standing(numbers, q, v, act, u)[0]

    def of(self, model: "mujoco.MjModel") -> "StandingPhysics":
        """Return the same feet on another model."""
        return StandingPhysics(model, self.feet)

    def contact_forces(self, x: Array, u: Array, numbers: dict[str, Array] | None = None) -> Array:
        """Return the contact forces λ (3k,), normal and two tangential ones of each foot (N), at
        x = (qpos, qvel, act) under u. numbers: as in `step`."""
        numbers = numbers or {}
        require_numbers(self, numbers)
        physics: Any = self.acting(numbers)
        if physics is not self:
            return physics.contact_forces(x, u, numbers)
        x, u = (jnp.asarray(as_floats(v)) for v in (x, u))
        q, v, act = jnp.split(x, [self.model.nq, self.model.nq + self.model.nv])
        return self._standing(in_force(numbers), normalised(self.joints, q), v, act, u)[1]

    def _standing(
        self, numbers: dict[str, Array], q: Array, v: Array, act: Array, u: Array
    ) -> tuple[Array, Array]:
        """Return the accelerations (nv,) and the contact forces (3k,)."""
        model, data = self._forced(numbers, q, v, act, u)
        M = self._dynamics(numbers, q, v)[0] + self._added(model, data, True)
        free = self._accelerations(True, numbers, q, v, act, u)
        velocities = lambda t: matmul(
            self._feet_jacobian(numbers, retract(self.joints, q, t * v)), v
        )
        zero, one = jnp.zeros((), q.dtype), jnp.ones((), q.dtype)
        speeds, drift = jax.jvp(velocities, (zero,), (one,))
        standing = numbers.get(STANDING, np.ones(len(self.feet)))
        rows = jnp.repeat(jnp.asarray(standing, q.dtype), 3) * self.feet.held.ravel()
        J = rows[:, None] * self._feet_jacobian(numbers, q)
        by_forces = solve(M, J.T)
        rate = np.repeat(self.feet.rate, 3).astype(q.dtype)
        lacking = matmul(J, free) + rows * (drift + rate * speeds)
        forces = -solve(matmul(J, by_forces) + jnp.diag(1 - rows), lacking)
        return free + matmul(by_forces, forces), forces

    def _feet_jacobian(self, numbers: dict[str, Array], q: Array) -> Array:
        """Return J (3k, nv) of the velocities of the points of contact."""
        feet, nv = self.feet, self.model.nv
        poses = self._dynamics(numbers, q, jnp.zeros(nv, q.dtype))[2]
        frames = feet.frames.astype(q.dtype)
        points = (
            poses["geom_xpos"][feet.geoms] - feet.radius[:, None].astype(q.dtype) * frames[:, 0]
        )
        arms = points - poses["subtree_com"][self.tree.root[feet.bodies]]
        turns, shifts = poses["cdof"][:, :3], poses["cdof"][:, 3:]
        motions = shifts[None] + jnp.cross(turns[None], arms[:, None])
        motions = motions * self.tree.moves[feet.bodies][:, :, None].astype(q.dtype)
        return jnp.einsum("kij,kvj->kiv", frames, motions, precision="highest").reshape(-1, nv)


def stands(robot: Any) -> bool:
    """Return whether the model of a robot has feet that stand."""
    return isinstance(getattr(robot, "predictor", None), StandingPhysics)


def standing_physics(
    robot: RobotDescription, feet: Sequence[str], friction: float | None
) -> StandingPhysics:
    """Return the model of a robot with these feet standing; see `Robot.standing`."""
    model, q = robot.predictor.model, robot.home[: robot.mujoco.nq]
    if isinstance(feet, str) or not feet:
        fail("feet", f"{feet!r}", "Give the names of geoms, one for each foot")
    if len(set(feet)) != len(feet):
        fail("feet", f"{tuple(feet)} has a name twice", "Name each foot once")
    if friction is not None:
        number("friction", friction, 0.0, "Give a coefficient of at least 0")
    if model.opt.integrator == RK4:
        cure = "Use Euler or implicitfast"
        fail("robot", f"{robot.name} has the integrator RK4, which holds no feet", cure)
    if equalities(model):
        problem = f"{robot.name} has equalities (couplings of joints or bodies) in its file"
        fail("robot", problem, "Models with feet that stand take none yet")
    home = tuple(np.asarray(q, float).tolist())
    return _standing_physics(robot.predictor, robot.mujoco, home, tuple(feet), friction)


@functools.lru_cache(maxsize=16)
def _standing_physics(
    physics: Physics,
    plant: "mujoco.MjModel",
    home: tuple[float, ...],
    feet: tuple[str, ...],
    friction: float | None,
) -> StandingPhysics:
    """Return the model with feet that stand; the same one for the same robot, feet and friction, so
    that programs compiled for it are found again."""
    model = physics.model
    found = Feet.touching(plant, np.array(home), feet, friction).in_planes(model, np.array(home))
    data = mujoco.MjData(model)
    data.qpos[:] = home
    mujoco.mj_forward(model, data)
    J = found.jacobian(model, data)[found.held.ravel()]
    sizes = np.linalg.svd(J, compute_uv=False)
    if len(sizes) < len(J) or sizes[-1] < _RANK * sizes[0]:
        problem = f"{', '.join(found.names)} hold one another: contact forces are not unique"
        fail("feet", problem, "Name one sphere for each leg that moves by itself")
    return StandingPhysics(model, found)


def friction_cones(robot: RobotDescription, x: Any, u: Any) -> ForceLimits | None:
    """Return the friction cones of the feet that stand as rows in ξ and u, None without such feet.

    x (nq + nv + na,), u (m,): where the contact forces are linearised, in float64.
    """
    physics = robot.predictor
    if not isinstance(physics, StandingPhysics):
        return None
    with jax.enable_x64(True):
        xi, u = robot.coordinates(jnp.asarray(x, float)), jnp.asarray(u, float)
        C, D, upper = map(np.asarray, jax.jit(partial(linear_cones, robot, {}))(xi, u))
    labels = physics.feet.cone_names
    units = ("N",) * len(labels)
    return ForceLimits(C, upper=upper, D=D, stages=None, names=labels, units=units)


def linear_cones(
    robot: RobotDescription, numbers: dict[str, Array], xi: Array, u: Array
) -> tuple[Array, Array, Array]:
    """Return C (5k, n), D (5k, m) and the upper sides (5k,) of the friction cones, linearised at ξ
    and u. numbers: as in `Robot.linearize`, with `STANDING`."""
    physics: Any = robot.predictor

    def forces(xi: Array, u: Array) -> tuple[Array, Array]:
        found = physics.contact_forces(robot.state(xi), u, numbers)
        return found, found

    (by_state, by_input), there = jax.jacfwd(forces, argnums=(0, 1), has_aux=True)(xi, u)
    faces = jnp.asarray(physics.feet.cones(), xi.dtype)
    C, D = matmul(faces, by_state), matmul(faces, by_input)
    return C, D, matmul(C, xi) + matmul(D, u) - matmul(faces, there)
