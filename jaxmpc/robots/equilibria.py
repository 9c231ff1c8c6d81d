"""Robots at rest: which inputs hold a configuration, and which configuration nearby can be held.

Computed outside JAX in float64 by MuJoCo's C engine, on the predictor: the springs of limits,
contacts and dry friction do not help. What was found is tried on the file.
"""

import copy

import numpy as np
import scipy
from scipy.linalg import block_diag

from jaxmpc.checks import fail
from jaxmpc.pytrees import record
from jaxmpc.robots.configurations import blocks
from jaxmpc.robots.contacts import Feet
from jaxmpc.robots.couplings import Couplings, equality_jacobian, projector
from jaxmpc.robots.description import RobotDescription
from jaxmpc.robots.mujoco_access import flag, mujoco, name_of, single_joints
from jaxmpc.sets.convex_sets import Box

# Forces that count as balanced, relative to `Forces.sizes`: of a pendulum, an angle in radians.
BALANCED = 3e-7
# Of the largest of these sizes: below it rounding of the large forces decides.
_LEAST = 1e-6
# Accelerations (rad/s², m/s²) that count as rest.
AT_REST = 1e-3
# Weights of the distance in the search, one after the other; the last leaves balanced forces.
_WEIGHTS = (1e-2, 1e-4, 1e-6, 1e-9, 1e-12)
_STEP = 1e-6
# Where searches begin, one after the other: shares of the way to home.
_STARTS = (0.0, 0.25, 0.5, 0.75, 1.0)
# Steps of Newton's method for the springs of couplings, and accelerations at which it ends.
_SETTLING, _SETTLED = 10, 1e-9
# Configurations tried, further and further inside the limits, where couplings yield beyond them.
_TRIES = 10


@record
class Rest:
    """A robot at rest in q (nq,) under u (m,) with activation states act (na,).

    drive (m,): what holds it, the input or the activation of each actuator, and lower, upper (m,)
    its limits. missing (nv,): generalised forces that nothing balances. sizes (nv,): of the forces.
    """

    q: np.ndarray
    u: np.ndarray
    act: np.ndarray
    drive: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    missing: np.ndarray
    sizes: np.ndarray

    @property
    def x(self) -> np.ndarray:
        """Return the state (qpos, qvel, act)."""
        return np.concatenate([self.q, np.zeros(len(self.missing)), self.act])

    @property
    def over(self) -> np.ndarray:
        """Return how far the drive is beyond its limits, (m,); 0 inside, and where rounding takes
        it beyond."""
        over = np.maximum(self.lower - self.drive, self.drive - self.upper)
        ends = np.abs([self.lower, self.upper])
        size = np.where(np.isfinite(ends), ends, 0.0).max(axis=0)
        rounding = 1e-9 * size + 1e-12 * np.abs(self.drive).max(initial=0.0)
        return np.where(over > rounding, over, 0.0)

    @property
    def balanced(self) -> bool:
        """Return whether the forces balance, limits aside."""
        return self.lacks <= BALANCED

    @property
    def lacks(self) -> float:
        """Return the largest force that is missing, in sizes."""
        return float(np.max(np.abs(self.missing) / self.sizes, initial=0.0))

    @property
    def held(self) -> bool:
        """Return whether inputs within the limits balance the forces."""
        return self.balanced and not np.any(self.over)


class Forces:
    """Forces at rest as functions of the configuration and of what drives the actuators.

    drive (m,): of an actuator without activation its input; else its activation, which at rest
    equals the input, or of an integrator is any number while the input is zero.
    """

    def __init__(self, robot: RobotDescription) -> None:
        model = robot.predictor.model
        self.couplings = Couplings(model)
        if self.couplings.there:
            model = copy.deepcopy(model)
            model.opt.tolerance, model.opt.iterations = 0.0, 200
        self.model, self.data = model, mujoco.MjData(model)
        self.active = np.flatnonzero(model.actuator_dyntype != mujoco.mjtDyn.mjDYN_NONE)
        self.integrators = model.actuator_dyntype == mujoco.mjtDyn.mjDYN_INTEGRATOR
        lower, upper = robot.input_limits.bounds()
        lower[self.integrators], upper[self.integrators] = -np.inf, np.inf
        bounded = np.flatnonzero(robot.mujoco.actuator_actlimited)
        low, high = robot.mujoco.actuator_actrange[bounded].T
        lower[bounded] = np.maximum(lower[bounded], low)
        upper[bounded] = np.minimum(upper[bounded], high)
        self.lower, self.upper, self.m = lower, upper, robot.m
        self.feet: Feet | None = getattr(robot.predictor, "feet", None)

    def parts(self, drive: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the inputs u (m,) and the activations (na,) of a drive."""
        act = np.zeros(self.model.na)
        act[self.model.actuator_actadr[self.active]] = drive[self.active]
        return np.where(self.integrators, 0.0, drive), act

    def at(self, q: np.ndarray, drive: np.ndarray, v: np.ndarray | float = 0.0) -> np.ndarray:
        """Return the sum (nv,) of all forces, at rest or at the velocity v (nv,), but of those that
        couplings take."""
        self.data.qpos, self.data.qvel = q, v
        self.data.ctrl, act = self.parts(drive)
        if len(act):
            self.data.act = act
        mujoco.mj_forward(self.model, self.data)
        return self.uncoupled(self.data.qfrc_smooth)

    def sizes(self, f: np.ndarray) -> np.ndarray:
        """Return the sizes (nv,) of the forces at the position in `data`: of f (nv,), those there
        without inputs, and of those that gravity has on what each coordinate moves, as far from the
        axis as its radius of gyration.

        So a robot of milligrams is measured as one of tons is, a finger as its arm, and a turn as a
        slide, in any unit of length: g √(inertia · mass) is g · mass of a slide.
        """
        model, inertia = self.model, np.zeros_like(f)
        for i, axis in enumerate(np.eye(len(f))):
            column = np.zeros_like(f)
            mujoco.mj_mulM(model, self.data, column, axis)
            inertia[i] = column[i]
        gravity = float(np.linalg.norm(model.opt.gravity)) or 1.0
        mass = model.body_subtreemass[model.dof_bodyid]
        sizes = np.abs(f) + gravity * np.sqrt(inertia * mass)
        return np.maximum(sizes, _LEAST * np.max(sizes, initial=0.0))

    def widths(self, J: np.ndarray, sizes: np.ndarray) -> np.ndarray:
        """Return the sizes (m,) of drives: half of what their limits leave, and no more than what
        takes a coordinate through its size (nv,). J as in `affine`."""
        needed = np.max(np.abs(J) / sizes[:, None], axis=0, initial=0.0)
        range_ = self.upper - self.lower
        limited = np.where(range_ > 0, 2 / np.where(range_ > 0, range_, 1.0), 0.0)
        return 1 / np.maximum(np.maximum(limited, needed), 1e-300)

    def uncoupled(self, force: np.ndarray) -> np.ndarray:
        """Return the part (nv,) of generalised forces, at the position in `data`, that couplings do
        not balance."""
        if not self.couplings.there:
            return force.copy()
        return projector(equality_jacobian(self.model, self.data)) @ force

    def settled(self, q: np.ndarray, drive: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the configuration next to q in which couplings carry their load, for their springs
        yield a little, and the drive that balances the rest there.

        Newton's method on the accelerations, in the motions that couplings resist and the drive.
        """
        G = self.couplings.rows(q)[1]
        basis = np.vstack([G.T, np.zeros((self.m, len(G)))])
        basis = np.hstack([basis, np.eye(len(basis), self.m, -self.model.nv)])

        def moved(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            motion, change = np.split(basis @ z, [self.model.nv])
            position = q.copy()
            mujoco.mj_integratePos(self.model, position, motion, 1.0)
            return position, drive + change

        def accelerations(z: np.ndarray) -> np.ndarray:
            self.at(*moved(z))
            return self.data.qacc.copy()

        z = np.zeros(basis.shape[1])
        steps = _STEP * np.eye(len(z))
        for _ in range(_SETTLING):
            a = accelerations(z)
            if np.abs(a).max() < _SETTLED:
                break
            slope = [(accelerations(z + e) - accelerations(z - e)) / (2 * _STEP) for e in steps]
            z = z - np.linalg.lstsq(np.array(slope).T, a, rcond=1e-9)[0]
        return moved(z)

    def affine(self, q: np.ndarray, v: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Return J (nv, m) and f (nv,) of the sum of forces J drive + f."""
        f = self.at(q, np.zeros(self.m), v)
        return np.array([self.at(q, e, v) - f for e in np.eye(self.m)]).T.reshape(-1, self.m), f

    def rest(self, q: np.ndarray, drive: np.ndarray, f: np.ndarray) -> Rest:
        """Return the rest at q under a drive; f (nv,), the forces without any."""
        missing = self.at(q, drive)
        sizes = self.sizes(f)
        if self.couplings.there and np.all(np.abs(missing) <= BALANCED * sizes):
            # Where couplings are too soft for Newton's method, the configuration stays as given.
            for place in ((q, drive), self.settled(q, drive)):
                self.at(*place)
                left = self.data.qfrc_smooth + self.data.qfrc_constraint
                if place[0] is q or np.all(np.abs(left) <= BALANCED * sizes):
                    (q, drive), missing = place, left
        return Rest(q, *self.parts(drive), drive, self.lower, self.upper, missing, sizes)


def rest_at(robot: RobotDescription, q: np.ndarray, *, within: bool = False) -> Rest:
    """Return the robot at rest in q (nq,) under the drive that comes nearest to a balance: the
    least one of all inputs, each relative to its size, or one within the limits."""
    forces = Forces(robot)
    if forces.feet is not None:
        return _standing(forces, forces.feet, q)
    q = forces.couplings.met(q)
    J, f = forces.affine(q)
    sizes = forces.sizes(f)
    unit = forces.widths(J, sizes)
    rows, aim = J / sizes[:, None] * unit, -f / sizes
    drive = unit * np.linalg.lstsq(rows, aim, rcond=None)[0]
    if within and np.any((drive < forces.lower) | (drive > forces.upper)):
        wide = np.where(forces.upper > forces.lower, 0.0, 1e-12)
        bounds = forces.lower / unit - wide, forces.upper / unit + wide
        drive = unit * scipy.optimize.lsq_linear(rows, aim, bounds).x
        drive = np.clip(drive, forces.lower, forces.upper)
    return forces.rest(q, drive, f)


# Weights of the inputs, relative to their half-widths or to what the weight asks of them, and of
# normal forces, beside that of tangential forces, all relative to the weight; and of the balance.
_EFFORT, _NORMAL, _BALANCE = 1e-2, 1e-4, 1e6


def _standing(forces: Forces, feet: Feet, q: np.ndarray) -> Rest:
    """Return the robot at rest on its feet in q (nq,): of the contact forces inside the friction
    cones and inputs within the limits that balance the weight, those of the least tangential
    forces, and of these the least inputs; where none do, those that leave the least.

    Least squares with bounds: contact forces are combinations λ = R r, r ≥ 0, of the edges of the
    cones, and the balance has a large weight (Lawson & Hanson, ch. 22)."""
    J, f = forces.affine(q)
    G, R = feet.jacobian(forces.model, forces.data), feet.edges()
    sizes, model = forces.sizes(f), forces.model
    weight = float(np.linalg.norm(model.opt.gravity) * model.body_mass.sum()) or 1.0
    # What a coordinate takes where a foot carries the weight, in the coordinate's own unit.
    most = np.maximum(np.abs(f), weight * np.abs(G).max(axis=0))
    most = np.where(most > 0, most, sizes)
    # In units in which widths, the weight and `most` are 1.
    unit = np.append(forces.widths(J, most), np.full(R.shape[1], weight))
    on_feet = np.sqrt(np.tile([_NORMAL, 1.0, 1.0], len(feet))) * len(feet)
    effort = block_diag(np.sqrt(_EFFORT) * np.eye(forces.m), on_feet[:, None] * R)
    balance = _BALANCE / most
    rows = np.vstack([balance[:, None] * np.hstack([J, G.T @ R]) * unit, effort])
    aim = np.append(-balance * f, np.zeros(len(effort)))
    lower = np.append(forces.lower, np.zeros(R.shape[1]))
    upper = np.append(forces.upper, np.full(R.shape[1], np.inf))
    bounds = lower / unit, upper / unit
    found = scipy.optimize.lsq_linear(rows, aim, bounds, method="bvls", tol=1e-15)
    drive, r = np.split(unit * found.x, [forces.m])
    missing = forces.at(q, drive) + G.T @ (R @ r)
    return Rest(q, *forces.parts(drive), drive, forces.lower, forces.upper, missing, sizes)


# What takes a rest away: the constraints, see `mujoco_access.flag`, or "" for limits of forces; in
# words; and what helps.
CAUSES = (
    (
        "",
        "limits of actuators' forces (forcerange, actuatorfrcrange)",
        "Choose a configuration that needs less force, or widen them in the file",
    ),
    ("contact", "contacts", "Choose a configuration in which nothing touches"),
    ("limit", "stops of joints or tendons", "Choose a configuration inside their ranges"),
)


def require_rest(
    argument: str, robot: RobotDescription, rests: list[Rest], *, touching: bool = False
) -> list[str]:
    """Raise ValueError where the file moves in MuJoCo at what the predictor takes for a rest.

    Names the joint, its acceleration, and what takes the rest away: what the predictor ignores.
    touching: where contacts or stops do, return the sentence instead.
    """
    plant, smooth = robot.mujoco, robot.predictor.model
    file = copy.deepcopy(robot.file or plant)
    # Inputs are not clamped, and of a motor's force limits the box of inputs is in charge.
    file.opt.disableflags |= flag("clampctrl")
    file.actuator_forcelimited[:] = plant.actuator_forcelimited
    file.jnt_actfrclimited[:] = plant.jnt_actfrclimited
    file.actuator_delay[:] = 0  # inputs at rest are old enough
    if hasattr(robot.predictor, "feet"):
        # MuJoCo's contacts are springs, into which a robot sinks first: of limits of forces alone
        # it is asked whether they change what happens, without the ground.
        for kind in ("contact", "limit", "frictionloss"):
            file.opt.disableflags |= flag(kind)
        smooth = _without(file, "")
    limited, single = file.jnt_limited.copy(), single_joints(file)
    at, dof = file.jnt_qposadr[single], file.jnt_dofadr[single]
    low, high = (end[dof] for end in robot.state_limits.bounds())
    for rest in rests:
        # A position beyond its limit is for the controller to refuse, not for the stop.
        inside = (low <= rest.q[at]) & (rest.q[at] <= high)
        file.jnt_limited[single] = limited[single] & inside
        wanted, found = _accelerations(smooth, rest), _accelerations(file, rest)
        if np.all(np.abs(found - wanted) <= AT_REST):
            continue
        i = int(np.argmax(np.nan_to_num(np.abs(found - wanted), nan=np.inf)))
        joint = name_of(file, "joint", file.dof_jntid[i])
        more = (found - wanted)[i]
        problem = f"{rest.q} is no rest: in MuJoCo {joint} accelerates by {more:.3g} a second²"
        for kind, cause, cure in CAUSES:
            without = _accelerations(_without(file, kind), rest)
            if np.all(np.abs(without - wanted) <= AT_REST):
                text = f"{problem}, by {cause}"
                if kind == "limit":
                    text += _acting_stops(file, rest.q)
                if touching and kind in ("contact", "limit"):
                    return [f"{text}; the model is taken there"]
                fail(argument, text, cure)
        fail(argument, problem, "See what robot.report() says is left out or ignored")
    return []


def _acting_stops(model: "mujoco.MjModel", q: np.ndarray) -> str:
    """Return which stops of joints act at q, with their ranges and margins, in words."""
    found = []
    for j in np.flatnonzero(single_joints(model)):
        (low, high), margin = model.jnt_range[j], model.jnt_margin[j]
        at = q[model.jnt_qposadr[j]]
        if model.jnt_limited[j] and min(at - low, high - at) < margin:
            pushes = f" less its margin of {margin:g}" if margin else ""
            found.append(
                f"{name_of(model, 'joint', j)} at {at:.3g}, [{low:.3g}, {high:.3g}]{pushes}"
            )
    return f" ({'; '.join(found)})" if found else ""


def _accelerations(model: "mujoco.MjModel", rest: Rest) -> np.ndarray:
    """Return what a model accelerates by at rest, (nv,)."""
    data = mujoco.MjData(model)
    data.qpos[:], data.ctrl[:], data.act[:] = rest.q, rest.u, rest.act
    mujoco.mj_forward(model, data)
    return data.qacc.copy()


def _without(model: "mujoco.MjModel", kind: str) -> "mujoco.MjModel":
    """Return a copy of the model without a kind of `CAUSES`."""
    model = copy.deepcopy(model)
    if kind:
        model.opt.disableflags |= flag(kind)
    else:
        for limited in ("actuator_forcelimited", "jnt_actfrclimited", "tendon_actfrclimited"):
            getattr(model, limited)[:] = 0
    return model


def settled(robot: RobotDescription) -> tuple[Rest, list[str]]:
    """Return the rest of `Robot.set_point`, and in words each way in which it is not home at
    rest."""
    model, texts, single = robot.mujoco, list[str](), single_joints(robot.mujoco)
    q, at, dof = (
        np.array(robot.home[: model.nq], float),
        model.jnt_qposadr[single],
        model.jnt_dofadr[single],
    )
    inside = np.clip(q[at], *(end[dof] for end in robot.state_limits.bounds()))
    beyond = [robot.state_names[i] for i in dof[inside != q[at]]]
    if beyond:
        texts.append(f"home lies beyond the limits of {', '.join(beyond)}, and is moved to them")
        q[at] = inside
    couplings = Couplings(robot.predictor.model)
    if off := couplings.unmet(couplings.met(q)):
        texts.append(f"couplings of the file cannot all be met near home: {off}")
    (rest, yielding), moved = _inside(robot, q), list[str]()
    if yielding:
        far, those = np.abs(rest.q - q).max(), ", ".join(yielding)
        texts.append(
            f"couplings yield under their load, which would carry {those} beyond the limits; "
            f"home is moved inside, by up to {far:.2g} rad or m"
        )
    if rest.held:
        moved = require_rest("home", robot, [rest], touching=True)
    elif hasattr(robot.predictor, "feet"):
        cure = "Give another home=, more torque, or feet with more friction"
        fail("robot", f"{robot.name} cannot stand at home: {lacking(robot, rest)}", cure)
    elif (near := nearest_rest(robot, q)).held:
        rest, far = near, np.abs(near.q - q).max()
        moved = require_rest("home", robot, [rest], touching=True)
        texts.append(
            "no input within the limits holds home; the nearest configuration that one "
            f"holds is taken, up to {far:.2g} rad or m away"
        )
    else:
        rest = rest_at(robot, q, within=True)
        texts.append(
            f"no input holds home or a configuration near it ({lacking(robot, rest)}); "
            "the model is taken at home, where it does not rest"
        )
    return rest, [*(f"robot {robot.name}: {text}" for text in texts), *moved]


def _inside(robot: RobotDescription, q: np.ndarray) -> tuple[Rest, list[str]]:
    """Return the rest at q (nq,), which lies inside the limits, and the names of the positions that
    couplings carry beyond them there: then the rest is that of a configuration further inside."""
    single = single_joints(robot.mujoco)
    at, dof = robot.mujoco.jnt_qposadr[single], robot.mujoco.jnt_dofadr[single]
    low, high = (end[dof] for end in robot.state_limits.bounds())
    rest, yielding = rest_at(robot, q), list[str]()
    for _ in range(_TRIES):
        back = np.clip(rest.q[at], low, high) - rest.q[at]
        if not rest.held or not np.any(back):
            break
        over = dof[back != 0]
        yielding = yielding or [robot.state_names[i] for i in over]
        # The least motion that keeps the couplings and takes these back, half as far again.
        free = Couplings(robot.predictor.model).motions(q)
        part = np.linalg.lstsq(free[np.ix_(over, over)], 1.5 * back[back != 0], rcond=1e-9)[0]
        q = q.copy()
        mujoco.mj_integratePos(robot.mujoco, q, free[:, over] @ part, 1.0)
        rest = rest_at(robot, q)
    return rest, yielding


def lacking(robot: RobotDescription, rest: Rest) -> str:
    """Return in words what is missing for the robot to rest."""
    if rest.balanced:
        i = int(np.argmax(rest.over))
        return f"{robot.input_names[i]} is {rest.over[i]:.3g} beyond its limit"
    missing = np.abs(rest.missing)
    dof = int(np.argmax(np.where(missing > BALANCED * rest.sizes, missing, 0.0)))
    return f"{missing[dof]:.3g} are missing at {robot.state_names[dof]}"


@record
class Neighbourhood:
    """Rests near a configuration q (nq,), as z = (motion from q (nv,), drive in units (m,)).

    sizes (nv,): of the forces. unit (m,): of the drives.
    """

    forces: Forces
    q: np.ndarray
    sizes: np.ndarray
    unit: np.ndarray

    def position(self, z: np.ndarray) -> np.ndarray:
        """Return the configuration (nq,)."""
        position, nv = self.q.copy(), self.forces.model.nv
        mujoco.mj_integratePos(self.forces.model, position, z[:nv], 1.0)
        return position

    def drive(self, z: np.ndarray) -> np.ndarray:
        """Return the drive (m,)."""
        return self.unit * z[self.forces.model.nv :]

    def balance(self, z: np.ndarray) -> np.ndarray:
        """Return the sum of forces over their sizes, and how far couplings are from being met."""
        force = self.forces.at(self.position(z), self.drive(z)) / self.sizes
        couplings = self.forces.couplings
        return np.append(force, couplings.rows(self.position(z))[0]) if couplings.there else force

    def scales(self, weight: float) -> np.ndarray:
        """Return the roots of the weights of z. Drives weigh next to nothing: of many that hold q,
        a small one."""
        root = np.sqrt(weight)
        return np.append(np.full(self.forces.model.nv, root), np.full(len(self.unit), 1e-3 * root))

    def residual(self, z: np.ndarray, weight: float) -> np.ndarray:
        """Return what is to be small, in the sum of its squares."""
        return np.concatenate([self.balance(z), self.scales(weight) * z])

    def jacobian(self, z: np.ndarray, weight: float) -> np.ndarray:
        """Return the derivative of `residual`, by central differences in the motion."""
        steps = _STEP * np.eye(len(z))[: self.forces.model.nv]
        by_motion = [(self.balance(z + e) - self.balance(z - e)) / (2 * _STEP) for e in steps]
        by_drive = self.forces.affine(self.position(z))[0] * self.unit / self.sizes[:, None]
        unmoved = np.zeros((len(by_motion[0]) - len(by_drive), by_drive.shape[1]))
        top = np.hstack([np.array(by_motion).T, np.vstack([by_drive, unmoved])])
        return np.vstack([top, np.diag(self.scales(weight))])


def nearest_rest(robot: RobotDescription, q: np.ndarray) -> Rest:
    """Return the robot at rest in the configuration nearest to q (nq,) that inputs hold, where the
    search finds one (see `Rest.held`).

    Minimises |forces|² + w |motion|² over motions from q inside the position limits and drives
    inside theirs, for weights w that fall to almost nothing: a local search, whose end is a local
    minimum of the distance, or of forces that nothing balances. Then it begins again, nearer and
    nearer to home. Forces are scaled by their sizes at q, motions by rad or m.
    """
    forces, home = Forces(robot), np.zeros(robot.predictor.model.nv)
    mujoco.mj_differentiatePos(forces.model, home, 1.0, q, robot.home[: len(q)])
    rests = list[Rest]()
    for share in _STARTS:
        rests.append(_searched(robot, forces, q, share * home))
        if rests[-1].held or not home.any():
            break
    return min(rests, key=lambda rest: (not rest.held, rest.lacks))


def _searched(robot: RobotDescription, forces: Forces, q: np.ndarray, motion: np.ndarray) -> Rest:
    """Return where the search of `nearest_rest` ends that begins at a motion (nv,) from q (nq,)."""
    sizes = forces.sizes(forces.affine(q)[1])
    start = q.copy()
    mujoco.mj_integratePos(forces.model, start, motion, 1.0)
    J, f = forces.affine(start)
    drive = np.linalg.lstsq(J, -f, rcond=None)[0]
    half = (forces.upper - forces.lower) / 2
    unit = np.maximum(np.where(half > 0, np.minimum(1.0, half), 1.0), np.abs(drive))
    near = Neighbourhood(forces, q, sizes, unit)
    low, high = _room(forces.model, robot.state_limits, q)
    lower, upper = np.append(low, forces.lower / unit), np.append(high, forces.upper / unit)
    narrow = 1e-9 * (upper - lower < 1e-9)
    lower, upper = lower - narrow, upper + narrow
    width = upper - lower
    inset = 1e-10 * np.where(np.isfinite(width), width, 1.0)
    z = np.clip(np.append(motion, drive / unit), lower + inset, upper - inset)
    tight = {"xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-14, "max_nfev": 50}
    for weight in _WEIGHTS:
        options = {"args": (weight,), "bounds": (lower, upper), **tight}
        found = scipy.optimize.least_squares(near.residual, z, near.jacobian, **options)
        z = np.clip(found.x, lower + inset, upper - inset)
    position = near.position(z)
    J, f = forces.affine(position)
    drive = np.clip(near.drive(z), forces.lower, forces.upper)
    # The search leaves rounding; what it found is the balance of its neighbourhood.
    better = drive - np.linalg.lstsq(J, J @ drive + f, rcond=None)[0]
    drives = (drive, np.clip(better, forces.lower, forces.upper))
    rests = [forces.rest(position, v, f) for v in drives]
    return min(rests, key=lambda rest: rest.lacks)


def _room(model: "mujoco.MjModel", limits: Box, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounds (nv,) of motions from q that keep position limits; ±inf for rotations."""
    low, high = np.full(model.nv, -np.inf), np.full(model.nv, np.inf)
    lower, upper = limits.bounds()
    for place, dofs, turns in blocks(model.jnt_type):
        if not turns:
            low[dofs], high[dofs] = lower[dofs] - q[place], upper[dofs] - q[place]
    return low, high


def inverse_actuation(
    robot: RobotDescription, q: np.ndarray, v: np.ndarray, a: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the inputs u (m,) that give the accelerations a (nv,) at q (nq,), v (nv,), and the
    forces (nv,) that they lack, 0 where it is rounding."""
    forces, inertial = Forces(robot), np.zeros(len(a))
    J, f = forces.affine(q, v)
    mujoco.mj_mulM(forces.model, forces.data, inertial, a)
    needed = forces.uncoupled(inertial) - f
    u = np.linalg.lstsq(J, needed, rcond=None)[0]
    missing = np.abs(J @ u - needed)
    return u, np.where(missing > BALANCED * forces.sizes(needed), missing, 0.0)
