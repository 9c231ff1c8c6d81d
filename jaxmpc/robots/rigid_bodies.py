"""Rigid bodies in a tree: kinematics, inverse dynamics and their derivatives in closed form.

Few operations on whole arrays take the place of MJX's passes from body to body, which for an arm of
seven joints are ten thousand operations. Poses are composed by doubling (each body with its parent,
then with its ancestor two steps up, four, …); velocities, accelerations, forces and composite
inertias are sums over ancestors or descendants, products with constant matrices of zeros and ones.

Spatial vectors (angular part first) are expressed in world axes about a point that does not move,
the centre of mass of the kinematic tree at the time, as in MuJoCo. S_i is the motion of dof i, v, a
velocity and acceleration (gravity as an acceleration of the world upward), I the inertia, all
(items, components, lanes): the last axis holds the robots of a batch, side by side.

Derivatives (after Singh, Russell, Wensing 2022, "Efficient analytical derivatives of rigid-body
dynamics using spatial vector algebra", arXiv 2105.05102; derived here for these coordinates): a
motion of dof j moves what is after it, v → v + S_j×v + ψ_j and a → a + S_j×a + χ_j + ψ_j×v with

    ψ_j = v_B × S_j,   χ_j = a_B × S_j + v_B × ψ_j,   B: before the joint of j,

so that a body's force f = I a + v ×* I v changes by S_j ×* f + I χ_j + C ψ_j, where

    C (ω; l) = (E ω; −2 r × ω),   E = 2 (u·h) 1 − 2 u h' − 2 ŵ Σ,   v = (w; u),

r = m u − h × w the linear momentum, h = m·centre, Σ = ½ tr(J) 1 − J, J the inertia about the point.
The torque S_i·F_i, F_i the sum of f over the bodies after i, does not change by motions of all.
"""

from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.pytrees import record
from jaxmpc.qp.jax_transformations import batched_by
from jaxmpc.robots.mujoco_access import BALL, FREE, SLIDE, number_of
from jaxmpc.robots.parameters import PAYLOAD, TOOL

# What is read of mjx.Model; beside it the payload, a point mass at the site "tool".
FIELDS = (
    *("body_pos", "body_quat", "body_ipos", "body_iquat", "body_mass", "body_inertia"),
    *("jnt_pos", "jnt_axis", "geom_pos", "geom_quat", "site_pos", "site_quat"),
    *("qpos0", "dof_armature"),
)


@record
class Tree:
    """Which body hangs on which, in constants of NumPy.

    A link is a joint, or a body without one. parent (links,): the link before; link 0 is the world,
    its own parent. body, joint (links,): of each link, joint −1 for none. first (links,): whether
    the pose of its body in the parent comes before it. tip (bodies,), link (joints,): the last link
    of each body, the link of each joint. kinds, position (joints,): mjtJoint and its first number
    in q. axis (nv,): which of the axes of `Bodies` dof i turns about or moves along; turns (nv,):
    1 for a rotation, 0 for a shift.
    moves (bodies, nv), before, after (nv, nv): 1 where dof j moves body i; where it comes before
    the joint of dof i; where it moves the axis of dof i. Dofs of a ball joint move one another.
    tool: the site that holds the payload, −1 for none.
    """

    parent: np.ndarray
    body: np.ndarray
    joint: np.ndarray
    first: np.ndarray
    tip: np.ndarray
    link: np.ndarray
    kinds: np.ndarray
    position: np.ndarray
    dof_body: np.ndarray
    dof_joint: np.ndarray
    axis: np.ndarray
    turns: np.ndarray
    moves: np.ndarray
    before: np.ndarray
    after: np.ndarray
    root: np.ndarray
    geom_body: np.ndarray
    site_body: np.ndarray
    below: np.ndarray
    tool: int

    @classmethod
    def of(cls, model: Any) -> "Tree":
        """Return the tree of a mujoco.MjModel."""
        nv, bodies, joints = model.nv, model.nbody, model.njnt
        links, tip, link = [(0, 0, -1)], [0], np.zeros(joints, int)
        for b in range(1, bodies):
            start, count = model.body_jntadr[b], model.body_jntnum[b]
            last = tip[model.body_parentid[b]]
            for j in range(start, start + count) if count else [-1]:
                links.append((last, b, j))
                last = len(links) - 1
                if count:
                    link[j] = last
            tip.append(last)
        parent, body, joint = np.array(links).T
        kinds = np.array(model.jnt_type)
        free = (joint >= 0) & (kinds[joint] == FREE)
        first = (body != body[parent]) & ~free
        moves, below = np.zeros((bodies, nv)), np.eye(bodies)
        for b in range(1, bodies):
            moves[b] = moves[model.body_parentid[b]]
            moves[b, model.dof_bodyid == b] = 1
        for b in range(bodies - 1, 0, -1):
            below[model.body_parentid[b]] += below[b]
        axis, turns, group = [], [], []
        for i, j in enumerate(model.dof_jntid):
            k, b, kind = i - model.jnt_dofadr[j], model.dof_bodyid[i], kinds[j]
            shift = kind == SLIDE or (kind == FREE and k < 3)
            group.append((j, not shift))
            turns.append(not shift)
            # The axes of joints, then those of bodies, then those of the world.
            own = joints + 3 * b + k % 3 if kind in (FREE, BALL) else j
            axis.append(joints + k if kind == FREE and shift else own)
        earlier = np.array([[b < a for b in group] for a in group])
        acts = moves[model.dof_bodyid]
        before = acts * earlier
        numbers = {
            **{"parent": parent, "body": body, "joint": joint, "tip": tip, "link": link},
            **{"kinds": kinds, "position": model.jnt_qposadr, "axis": axis},
            **{"dof_body": model.dof_bodyid, "dof_joint": model.dof_jntid},
            **{"geom_body": model.geom_bodyid, "site_body": model.site_bodyid},
            "root": model.body_rootid,
        }
        masks = {"first": first, "moves": moves, "before": before, "below": below}
        masks |= {"after": acts * (1 - before.T), "turns": np.array(turns, float)}
        whole = {name: np.array(value, np.int32) for name, value in numbers.items()}
        return cls(**whole, **masks, tool=number_of(model, "site", TOOL))

    def carries(self, v: Array) -> Array:
        """Return what the payload adds (1, …) as that of all bodies (bodies, …): zeros but for the
        body that holds it."""
        holds = np.arange(len(self.tip)) == self.site_body[self.tool]
        return holds.astype(v.dtype).reshape(-1, *(1,) * (v.ndim - 1)) * v


class Bodies(NamedTuple):
    """Poses and what moves them: position (bodies, 3), quaternion (bodies, 4), matrix (bodies, 3,
    3), the same of the principal axes of inertia about the centre of mass; centre (bodies, 3) of
    mass of each subtree; S (nv, 6); tool (1, 3), the place of the payload, None without one."""

    position: Array
    quaternion: Array
    matrix: Array
    middle: Array
    principal: Array
    centre: Array
    S: Array
    tool: Array | None


class Motion(NamedTuple):
    """S, ψ (nv, 6), velocities (bodies, 6), those before the joint of each dof (nv, 6)."""

    S: Array
    psi: Array
    velocity: Array
    earlier: Array


class Inertia(NamedTuple):
    """J (n, 3, 3) about the point, h (n, 3), mass (n,)."""

    J: Array
    h: Array
    mass: Array


def unfused(function: Callable) -> Callable:
    """Return the same function; XLA keeps what it returns instead of computing it at each use."""
    keep = jax.lax.optimization_barrier
    return wraps(function)(lambda *args: jax.tree.map(keep, function(*args)))


def cross(a: Array, b: Array) -> Array:
    """Return a × b of vectors (items, 3, lanes)."""
    turn = lambda v: jnp.concatenate([v[:, 1:], v[:, :1]], axis=1)
    return turn(a * turn(b) - turn(a) * b)


@unfused
def product(a: Array, b: Array) -> Array:
    """Return the Hamilton product of quaternions (items, 4, lanes)."""
    (s, u), (t, v) = ((q[:, :1], q[:, 1:]) for q in (a, b))
    real = s * t - jnp.sum(u * v, axis=1, keepdims=True)
    return jnp.concatenate([real, s * v + t * u + cross(u, v)], axis=1)


@unfused
def rotated(q: Array, v: Array) -> Array:
    """Return vectors (items, 3, lanes) turned by unit quaternions."""
    t = 2 * cross(q[:, 1:], v)
    return v + q[:, :1] * t + cross(q[:, 1:], t)


@unfused
def matrix(q: Array) -> Array:
    """Return the rotation matrices (items, 3, 3, lanes) of unit quaternions."""
    w, x, y, z = (q[:, i] for i in range(4))
    rows = [
        w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z,
    ]  # fmt: skip
    return jnp.stack(rows, axis=1).reshape(len(q), 3, 3, q.shape[-1])


@unfused
def total(mask: np.ndarray, v: Array) -> Array:
    """Return the sums of v (items, …) that the rows of `mask` choose."""
    return jnp.tensordot(mask.astype(v.dtype), v, 1, precision="highest")


def _is_zero(v: Any) -> bool:
    return isinstance(v, np.ndarray) and not np.any(v)


def _unit(q: Array) -> Array:
    return q / jnp.sqrt(jnp.sum(q * q, axis=1, keepdims=True))


@unfused
def link_poses(tree: Tree, model: Mapping[str, Any], q: Array) -> tuple[Array, Array]:
    """Return positions (links, 3, lanes) and quaternions (links, 4, lanes) in the world."""
    lanes, kinds = q.shape[-1], np.where(tree.joint < 0, -1, tree.kinds[tree.joint])
    places: list[Any] = []
    moved: list[Any] = []
    turned: list[Any] = []
    for kind in np.unique(kinds):
        at = np.flatnonzero(kinds == kind)
        j = tree.joint[at]
        start = tree.position[j]
        numbers = lambda first, size, start=start: q[start[:, None] + first + np.arange(size)]
        shift = jnp.zeros((len(at), 3, lanes), q.dtype)
        turn = jnp.zeros((len(at), 4, lanes), q.dtype).at[:, 0].set(1)
        if kind == FREE:
            shift, turn = numbers(0, 3), _unit(numbers(3, 4))
        elif kind == SLIDE:
            shift = model["jnt_axis"][j] * (q[start] - model["qpos0"][start])[:, None]
        elif kind >= 0:
            if kind == BALL:
                turn = _unit(numbers(0, 4))
            else:
                half = (q[start] - model["qpos0"][start])[:, None] / 2
                turn = jnp.concatenate([jnp.cos(half), model["jnt_axis"][j] * jnp.sin(half)], 1)
            anchor = model["jnt_pos"][j]
            if not _is_zero(anchor):
                shift = anchor - rotated(turn, anchor)
        places, moved, turned = [*places, at], [*moved, shift], [*turned, turn]
    order = np.argsort(np.concatenate(places))
    p, r = jnp.concatenate(moved)[order], jnp.concatenate(turned)[order]
    # Poses of bodies in their parents, before the first joint.
    given = tree.first[:, None, None]
    offset = model["body_pos"][tree.body] * given
    tilt = model["body_quat"][tree.body] * given
    tilt = tilt + (1 - given) * np.array([1.0, 0, 0, 0], q.dtype)[:, None]
    p, r = offset + rotated(tilt, p), product(tilt, r)
    up = tree.parent
    while np.any(up):
        p, r, up = p[up] + rotated(r[up], p), product(r[up], r), up[up]
    return p, r


@unfused
def bodies(tree: Tree, model: Mapping[str, Any], q: Array) -> Bodies:
    """Return the poses for the configuration q (nq, lanes)."""
    p, r = link_poses(tree, model, q)
    position, quaternion = p[tree.tip], r[tree.tip]
    R, anchor, pivot = matrix(quaternion), p[tree.link], model["jnt_pos"]
    axis = rotated(r[tree.link], model["jnt_axis"])
    if not _is_zero(pivot):
        pivot = pivot * (tree.kinds != FREE)[:, None, None]  # a free joint has none
        anchor = anchor + rotated(r[tree.link], pivot)
    middle = position + rotated(quaternion, model["body_ipos"])
    principal = matrix(product(quaternion, jnp.asarray(model["body_iquat"])))
    mass, tool = jnp.asarray(model["body_mass"])[:, None], None
    weighed = mass * middle
    if PAYLOAD in model:
        carrier = tree.site_body[[tree.tool]]
        tool = position[carrier] + rotated(quaternion[carrier], model["site_pos"][[tree.tool]])
        load = tree.carries(model[PAYLOAD][None, None])
        mass, weighed = mass + load, weighed + load * tool
    below, weight = total(tree.below, weighed), total(tree.below, mass)
    # MuJoCo's smallest mass that counts is 1e-15.
    centre = jnp.where(weight < 1e-15, middle, below / jnp.maximum(weight, 1e-15))
    if np.max(tree.axis) < len(tree.link):
        along = axis[tree.axis]
    else:
        columns = jnp.swapaxes(R, 1, 2).reshape(-1, 3, R.shape[-1])
        along = jnp.concatenate([axis, columns])[tree.axis]
    arm = centre[tree.root[tree.dof_body]] - anchor[tree.dof_joint]
    turns = tree.turns.astype(q.dtype)[:, None, None]
    if np.all(tree.turns):
        S = jnp.concatenate([along, cross(along, arm)], axis=1)
    else:
        shift = turns * cross(along, arm) + (1 - turns) * along
        S = jnp.concatenate([turns * along, shift], axis=1)
    return Bodies(position, quaternion, R, middle, principal, centre, S, tool)


@unfused
def motion_cross(v: Array, s: Array) -> Array:
    """Return v × s of motions (items, 6, lanes)."""
    turned = cross(v[:, :3], s[:, :3])
    return jnp.concatenate([turned, cross(v[:, :3], s[:, 3:]) + cross(v[:, 3:], s[:, :3])], axis=1)


@unfused
def force_cross(v: Array, f: Array) -> Array:
    """Return v ×* f of a motion and a force (items, 6, lanes), torque first."""
    shifted = cross(v[:, :3], f[:, 3:])
    return jnp.concatenate([cross(v[:, :3], f[:, :3]) + cross(v[:, 3:], f[:, 3:]), shifted], axis=1)


@unfused
def momentum(inertia: Inertia, v: Array) -> Array:
    """Return I v (items, 6, lanes), torque first."""
    J, h, mass = inertia
    angular = jnp.sum(J * v[:, None, :3], axis=2) + cross(h, v[:, 3:])
    return jnp.concatenate([angular, mass[:, None] * v[:, 3:] - cross(h, v[:, :3])], axis=1)


@unfused
def inertias(tree: Tree, model: Mapping[str, Any], found: Bodies) -> Inertia:
    """Return the inertia of each body about the centre of mass of its tree."""
    arm, mass = found.middle - found.centre[tree.root], jnp.asarray(model["body_mass"])
    X, moments = found.principal, model["body_inertia"][:, None, :]
    own = jnp.sum((X * moments)[:, :, None] * X[:, None], axis=3)
    J, h, mass = _of_points(mass, arm)
    bare = Inertia(own + J, h, mass)
    if found.tool is None:
        return bare
    apart = found.tool - found.centre[tree.root[tree.site_body[[tree.tool]]]]
    held = _of_points(model[PAYLOAD][None], apart)
    return jax.tree.map(lambda a, b: a + tree.carries(b), bare, held)


def _of_points(mass: Array, arm: Array) -> Inertia:
    """Return the inertia of points (n,) at `arm` (n, 3, lanes) from the centre."""
    identity = np.eye(3, dtype=arm.dtype)[:, :, None]
    squared = jnp.sum(arm * arm, axis=1)[:, None, None]
    J = mass[:, None, None] * (squared * identity - arm[:, :, None] * arm[:, None])
    return Inertia(J, mass[:, None] * arm, mass)


@unfused
def motion(tree: Tree, S: Array, v: Array) -> Motion:
    """Return what moves at the speeds v (nv, lanes)."""
    sums = total(np.concatenate([tree.before, tree.moves]), S * v[:, None])
    earlier, velocity = sums[: len(v)], sums[len(v) :]
    return Motion(S, motion_cross(earlier, S), velocity, earlier)


@unfused
def forces(
    tree: Tree, inertia: Inertia, moving: Motion, gravity: Any, v: Array, a: Array | None
) -> tuple[Array, Array]:
    """Return the forces I a + v ×* I v on the bodies (bodies, 6, lanes), and the accelerations
    before the joint of each dof (nv, 6, lanes)."""
    rates = moving.psi * v[:, None]
    if a is not None:
        rates = rates + moving.S * a[:, None]
    sums = total(np.concatenate([tree.before, tree.moves]), rates)
    falling = jnp.concatenate([jnp.zeros_like(gravity), -gravity])
    earlier, acceleration = sums[: len(v)] + falling, sums[len(v) :] + falling
    inner = force_cross(moving.velocity, momentum(inertia, moving.velocity))
    return momentum(inertia, acceleration) + inner, earlier


def composite(tree: Tree, *values: Array) -> list[Array]:
    """Return the sums over the bodies that each dof moves."""
    return [total(tree.moves.T, v) for v in values]


def dot(a: Array, b: Array) -> Array:
    """Return the products a_i·b_j (n, n, lanes) of a, b (n, components, lanes)."""
    return jnp.sum(a[:, None] * b[None], axis=2)


def _chosen(tree: Tree, upper: Array, lower: Array) -> Array:
    """Return the matrix whose entry i, j is that of `upper` where dof i comes before dof j, that of
    `lower` where dof j moves the axis of dof i, and zero elsewhere."""
    up, down = (mask.astype(upper.dtype)[:, :, None] for mask in (tree.before.T, tree.after))
    return up * upper + down * lower


def inverse_dynamics(tree: Tree, model: Mapping[str, Any], q: Array, v: Array, a: Array) -> Array:
    """Return the forces τ (nv, lanes) that the accelerations a need: M a + bias."""
    found = bodies(tree, model, q)
    inertia, moving = inertias(tree, model, found), motion(tree, found.S, v)
    force, _ = forces(tree, inertia, moving, model["gravity"], v, a)
    (F,) = composite(tree, force)
    return jnp.sum(found.S * F, axis=1) + model["dof_armature"] * a


def dynamics(
    tree: Tree, model: Mapping[str, Any], q: Array, v: Array
) -> tuple[Array, Array, dict[str, Array]]:
    """Return M (nv, nv, lanes), bias (nv, lanes) and fields of mjx.Data by name, for its method
    tree_replace."""
    found = bodies(tree, model, q)
    inertia, moving = inertias(tree, model, found), motion(tree, found.S, v)
    force, _ = forces(tree, inertia, moving, model["gravity"], v, None)
    *of_dofs, F = composite(tree, *inertia, force)
    S, P = found.S, momentum(Inertia(*of_dofs), found.S)
    M = _chosen(tree, dot(S, P), dot(P, S)) + _diagonal(model["dof_armature"])
    fields = {"xpos": found.position, "xquat": found.quaternion, "xmat": found.matrix}
    fields |= {"xipos": found.middle, "ximat": found.principal, "subtree_com": found.centre}
    fields |= {"cdof": S, "cdof_dot": moving.psi, "cvel": moving.velocity}
    fields["_impl.cinert"] = _packed(inertia)
    for kind, body in (("geom", tree.geom_body), ("site", tree.site_body)):
        turn = found.quaternion[body]
        fields[f"{kind}_xpos"] = found.position[body] + rotated(turn, model[f"{kind}_pos"])
        fields[f"{kind}_xmat"] = matrix(product(turn, jnp.asarray(model[f"{kind}_quat"])))
    return M, jnp.sum(S * F, axis=1), fields


def _packed(inertia: Inertia) -> Array:
    """Return inertias (n, 10, lanes) as MuJoCo has them: J_xx, J_yy, J_zz, J_xy, J_xz, J_yz, h and
    the mass."""
    J, h, mass = inertia
    rows, columns = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
    parts = [J[:, rows, columns], h, jnp.broadcast_to(mass[:, None], (len(h), 1, h.shape[-1]))]
    return jnp.concatenate(parts, axis=1)


def _diagonal(v: Any) -> Array:
    """Return diagonal matrices (n, n, lanes) of v (n, lanes)."""
    return v[:, None] * np.eye(len(v), dtype=v.dtype)[:, :, None]


def slopes(
    tree: Tree, model: Mapping[str, Any], q: Array, v: Array, a: Array
) -> tuple[Array, Array, Array]:
    """Return ∂τ/∂q in the tangent space, ∂τ/∂v and M, all (nv, nv, lanes)."""
    found = bodies(tree, model, q)
    inertia, moving = inertias(tree, model, found), motion(tree, found.S, v)
    force, earlier = forces(tree, inertia, moving, model["gravity"], v, a)
    S, psi, velocity, v_B = moving
    chi = motion_cross(earlier, S) + motion_cross(v_B, psi)
    own, rate = tree.after * tree.after.T, 2 * psi  # ψ and the rate of S
    if np.any(own != np.eye(len(own))):
        rate = psi + motion_cross(v_B + total(own, S * v[:, None]), S)
    E, r = _coriolis(inertia, velocity)
    *of_dofs, E, r, F = composite(tree, *inertia, E, r, force)
    carried = Inertia(*of_dofs)
    P = momentum(carried, S)
    N = jnp.sum(E * S[:, :3, None], axis=1) + 2 * cross(r, S[:, 3:])

    def pushed(s: Array) -> Array:
        """Return C s."""
        return jnp.concatenate([jnp.sum(E * s[:, None, :3], 2), -2 * cross(r, s[:, :3])], axis=1)

    def pairs(motions: Array, turns: Array, forces: Array) -> Array:
        below = dot(jnp.concatenate([P, N], 1), jnp.concatenate([motions, turns[:, :3]], 1))
        return _chosen(tree, dot(S, forces), below)

    by_q = pairs(chi, psi, momentum(carried, chi) + pushed(psi) + force_cross(S, F))
    by_v = pairs(rate, S, momentum(carried, rate) + pushed(S))
    M = _chosen(tree, dot(S, P), dot(P, S)) + _diagonal(model["dof_armature"])
    return by_q, by_v, M


@unfused
def _coriolis(inertia: Inertia, velocity: Array) -> tuple[Array, Array]:
    """Return E (bodies, 3, 3, lanes) and r (bodies, 3, lanes) of each body."""
    J, h, _ = inertia
    w, u = velocity[:, :3], velocity[:, 3:]
    identity = np.eye(3, dtype=w.dtype)[:, :, None]
    trace = (J[:, 0, 0] + J[:, 1, 1] + J[:, 2, 2])[:, None, None]
    turned = cross(w[:, :, None], trace / 2 * identity - J)
    along = jnp.sum(u * h, axis=1)[:, None, None] * identity
    return 2 * (along - u[:, :, None] * h[:, None] - turned), momentum(inertia, velocity)[:, 3:]


def side_by_side(function: Callable) -> Callable:
    """Return `function` of arrays (…, lanes) as one of arrays without lanes, whose `jax.vmap` puts
    the batch into the lanes. Its derivatives are those of one lane."""

    def single(*args: Any) -> Any:
        out = function(*jax.tree.map(lambda v: v[..., None], args))
        return jax.tree.map(lambda v: v[..., 0], out)

    def plain(*args: Any) -> Any:  # the batch first, of size 1 where it is shared
        count = max(len(v) for v in jax.tree.leaves(args))
        whole = lambda v: jnp.broadcast_to(v, (count, *v.shape[1:]))
        out = function(*jax.tree.map(lambda v: jnp.moveaxis(whole(v), 0, -1), args))
        first = lambda v: jnp.moveaxis(jnp.broadcast_to(v, (*v.shape[:-1], count)), -1, 0)
        return jax.tree.map(first, out)

    def rule_of_many(size: int, in_batched: tuple, *args: Any) -> Any:
        lengths = jax.tree.map(lambda v, b: v.shape[1 if b else 0], args, in_batched)
        count = max(jax.tree.leaves(lengths))

        def flat(v: Array, batched: bool) -> Array:
            if not batched and len(v) == 1:
                return v
            v = v if batched else jnp.broadcast_to(v, (size, *v.shape))
            v = jnp.broadcast_to(v, (size, count, *v.shape[2:]))
            return v.reshape(size * count, *v.shape[2:])

        out = many(*jax.tree.map(flat, args, in_batched))
        return jax.tree.map(lambda v: v.reshape(size, len(v) // size, *v.shape[1:]), out)

    def rule(size: int, in_batched: tuple, *args: Any) -> Any:
        return many(*jax.tree.map(lambda v, b: v if b else v[None], args, in_batched))

    many, batched = batched_by(rule_of_many, plain), batched_by(rule, single)
    fast = jax.custom_jvp(batched)
    fast.defjvp(lambda primals, tangents: (fast(*primals), jax.jvp(single, primals, tangents)[1]))
    return fast
