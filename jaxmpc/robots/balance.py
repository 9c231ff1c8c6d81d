"""Robots at rest: which inputs hold a configuration, and which configuration nearby can be held.

Computed outside JAX in float64 by MuJoCo's C engine, on the predictor: the springs of limits,
contacts, equalities and dry friction do not help. What was found is tried on the file.
"""

import copy
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import least_squares, lsq_linear

from jaxmpc.checks import fail
from jaxmpc.pytrees import record
from jaxmpc.robots.supported import name_of

if TYPE_CHECKING:
    import mujoco

    from jaxmpc.robots.robot import Robot

# Forces that count as balanced, relative to 1 + the largest one.
BALANCED = 1e-6
# Accelerations (rad/s², m/s²) that count as rest.
STILL = 1e-3
# Weights of the distance in the search, one after the other; the last leaves balanced forces.
_WEIGHTS = (1e-2, 1e-4, 1e-6, 1e-9, 1e-12)
_STEP = 1e-6


@record
class Rest:
    """A robot at rest in q (nq,) under u (m,) with activation states act (na,).

    drive (m,): what holds it, the input or the activation of each actuator, and lower, upper (m,)
    its limits. missing (nv,): generalised forces that nothing balances. size: 1 + the largest force
    there without inputs.
    """

    q: np.ndarray
    u: np.ndarray
    act: np.ndarray
    drive: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    missing: np.ndarray
    size: float

    @property
    def x(self) -> np.ndarray:
        """Return the state (qpos, qvel, act)."""
        return np.concatenate([self.q, np.zeros(len(self.missing)), self.act])

    @property
    def over(self) -> np.ndarray:
        """Return how far the drive is beyond its limits, (m,); not above 0 inside."""
        return np.maximum(self.lower - self.drive, self.drive - self.upper)

    @property
    def balanced(self) -> bool:
        """Return whether the forces balance, limits aside."""
        return bool(np.all(np.abs(self.missing) <= BALANCED * self.size))

    @property
    def held(self) -> bool:
        """Return whether inputs within the limits balance the forces."""
        return self.balanced and bool(np.all(self.over <= 1e-9))


class Forces:
    """Forces at rest as functions of the configuration and of what drives the actuators.

    drive (m,): of an actuator without activation its input; else its activation, which at rest
    equals the input, or of an integrator is any number while the input is zero.
    """

    def __init__(self, robot: "Robot") -> None:
        import mujoco

        self.model = robot.predictor.model
        self.data = mujoco.MjData(self.model)
        m, model = robot.m, self.model
        self.active = np.flatnonzero(model.actuator_dyntype != mujoco.mjtDyn.mjDYN_NONE)
        self.integrators = model.actuator_dyntype == mujoco.mjtDyn.mjDYN_INTEGRATOR
        lower, upper = (np.array(v, float) for v in (
            robot.input_limits.lower, robot.input_limits.upper,
        ))  # fmt: skip
        lower[self.integrators], upper[self.integrators] = -np.inf, np.inf
        bounded = np.flatnonzero(model.actuator_actlimited)
        low, high = model.actuator_actrange[bounded].T
        lower[bounded] = np.maximum(lower[bounded], low)
        upper[bounded] = np.minimum(upper[bounded], high)
        self.lower, self.upper, self.m = lower, upper, m

    def parts(self, drive: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the inputs u (m,) and the activations (na,) of a drive."""
        act = np.zeros(self.model.na)
        act[self.model.actuator_actadr[self.active]] = drive[self.active]
        return np.where(self.integrators, 0.0, drive), act

    def at(self, q: np.ndarray, drive: np.ndarray) -> np.ndarray:
        """Return the sum (nv,) of all forces at rest."""
        import mujoco

        self.data.qpos, self.data.qvel = q, 0
        self.data.ctrl, act = self.parts(drive)
        if len(act):
            self.data.act = act
        mujoco.mj_forward(self.model, self.data)
        return self.data.qfrc_smooth.copy()

    def affine(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return J (nv, m) and f (nv,) of the sum of forces J drive + f."""
        f = self.at(q, np.zeros(self.m))
        return np.array([self.at(q, e) - f for e in np.eye(self.m)]).T.reshape(-1, self.m), f

    def rest(self, q: np.ndarray, drive: np.ndarray, f: np.ndarray) -> Rest:
        """Return the rest at q under a drive; f (nv,), the forces without any."""
        size, missing = 1 + float(np.abs(f).max()), self.at(q, drive)
        return Rest(q, *self.parts(drive), drive, self.lower, self.upper, missing, size)


def rest_at(robot: "Robot", q: np.ndarray, *, within: bool = False) -> Rest:
    """Return the robot at rest in q (nq,) under the drive that comes nearest to a balance: the
    least one of all inputs, or one within the limits."""
    forces = Forces(robot)
    J, f = forces.affine(q)
    drive = np.linalg.lstsq(J, -f, rcond=None)[0]
    if within and np.any((drive < forces.lower) | (drive > forces.upper)):
        wide = np.where(forces.upper > forces.lower, 0.0, 1e-12)
        drive = lsq_linear(J, -f, (forces.lower - wide, forces.upper + wide)).x
        drive = np.clip(drive, forces.lower, forces.upper)
    return forces.rest(q, drive, f)


def require_rest(
    argument: str, robot: "Robot", rests: list[Rest], *, touching: bool = False
) -> str:
    """Raise ValueError where the file moves in MuJoCo at what the predictor takes for a rest.

    Names the joint, its acceleration, and what takes the rest away: what the predictor ignores.
    touching: where contacts or stops do, return the sentence instead.
    """
    import mujoco

    plant, file = robot.mujoco, copy.deepcopy(robot.file or robot.mujoco)
    # Inputs are not clamped, and of a motor's force limits the box of inputs is in charge.
    file.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
    file.actuator_forcelimited[:] = plant.actuator_forcelimited
    file.jnt_actfrclimited[:] = plant.jnt_actfrclimited
    if hasattr(file, "actuator_delay"):
        file.actuator_delay[:] = 0  # inputs at rest are old enough
    smooth = robot.predictor.model
    data, expected = mujoco.MjData(file), mujoco.MjData(smooth)
    limited = file.jnt_limited.copy()
    straight = np.flatnonzero(np.isin(file.jnt_type, (2, 3)))
    at, dof = file.jnt_qposadr[straight], file.jnt_dofadr[straight]
    low, high = (np.asarray(v)[dof] for v in (robot.state_limits.lower, robot.state_limits.upper))
    for rest in rests:
        # A position beyond its limit is for the controller to refuse, not for the stop.
        inside = (low <= rest.q[at]) & (rest.q[at] <= high)
        file.jnt_limited[straight] = limited[straight] & inside
        wanted = _accelerations(smooth, expected, rest)
        moves = lambda a, wanted=wanted: not np.all(np.abs(a - wanted) <= STILL)
        found = _accelerations(file, data, rest)
        if not moves(found):
            continue
        i = int(np.argmax(np.nan_to_num(np.abs(found - wanted), nan=np.inf)))
        joint = name_of(file, "joint", file.dof_jntid[i])
        problem = f"{rest.q} is no rest: in MuJoCo {joint} accelerates by {found[i]:.3g} a second²"
        for take_out, cause, cure in _CAUSES:
            without = copy.deepcopy(file)
            take_out(without)
            if not moves(_accelerations(without, mujoco.MjData(without), rest)):
                text = f"{problem}, by {cause}"
                if touching and take_out in (_no_contacts, _no_stops):
                    return f"{text}; the model is taken there"
                fail(argument, text, cure)
        fail(argument, problem, "See what robot.report() says is left out or ignored")
    return ""


def _accelerations(model: "mujoco.MjModel", data: "mujoco.MjData", rest: Rest) -> np.ndarray:
    import mujoco

    mujoco.mj_resetData(model, data)
    data.qpos[:], data.ctrl[:], data.act[:] = rest.q, rest.u, rest.act
    mujoco.mj_forward(model, data)
    return data.qacc.copy()


def _no_force_limits(model: "mujoco.MjModel") -> None:
    for limited in (
        model.actuator_forcelimited,
        model.jnt_actfrclimited,
        model.tendon_actfrclimited,
    ):
        limited[:] = 0


def _no_contacts(model: "mujoco.MjModel") -> None:
    model.opt.disableflags |= 16  # mjDSBL_CONTACT


def _no_stops(model: "mujoco.MjModel") -> None:
    model.opt.disableflags |= 8  # mjDSBL_LIMIT


def _no_couplings(model: "mujoco.MjModel") -> None:
    model.opt.disableflags |= 2  # mjDSBL_EQUALITY


# What takes a rest away: how it is taken out, what it is, and what helps.
_CAUSES = (
    (_no_force_limits, "limits of actuators' forces (forcerange, actuatorfrcrange)",
     "Choose a configuration that needs less force, or widen them in the file"),
    (_no_couplings, "couplings (equalities), which linear models lack",
     "Choose a configuration that meets them without their force, or take them out of the file"),
    (_no_contacts, "contacts", "Choose a configuration in which nothing touches"),
    (_no_stops, "stops of joints or tendons", "Choose a configuration inside their ranges"),
)  # fmt: skip


def settled(robot: "Robot") -> tuple[Rest, list[str]]:
    """Return the rest of `Robot.set_point`, and in words each way in which it is not home at
    rest."""
    model, texts = robot.mujoco, []
    nv, of = model.nv, np.isin(model.jnt_type, (2, 3))
    q, at, dof = (
        np.array(robot.home[: model.nq], float),
        model.jnt_qposadr[of],
        model.jnt_dofadr[of],
    )
    lower, upper = (np.asarray(v)[:nv][dof] for v in (
        robot.state_limits.lower, robot.state_limits.upper,
    ))  # fmt: skip
    inside = np.clip(q[at], lower, upper)
    beyond = [robot.state_names[i] for i in dof[inside != q[at]]]
    say = lambda text: texts.append(f"robot {robot.name}: {text}")
    if beyond:
        say(f"home lies beyond the limits of {', '.join(beyond)}, and is moved to them")
        q[at] = inside
    rest = rest_at(robot, q)
    if rest.held:
        moved = require_rest("home", robot, [rest], touching=True)
        return rest, [*texts, *([moved] if moved else [])]
    near = nearest_rest(robot, q)
    if near.held:
        moved = require_rest("home", robot, [near], touching=True)
        texts += [moved] if moved else []
        say("no input within the limits holds home; the nearest configuration that one holds is "
            f"taken, up to {np.abs(near.q - q).max():.2g} rad or m away")  # fmt: skip
        return near, texts
    rest = rest_at(robot, q, within=True)
    say(f"no input holds home or a configuration near it ({lacking(robot, rest)}); the model is "
        "taken at home, where it does not rest")  # fmt: skip
    return rest, texts


def lacking(robot: "Robot", rest: Rest) -> str:
    """Return in words what is missing for the robot to rest."""
    if rest.balanced:
        i = int(np.argmax(rest.over))
        return f"{robot.input_names[i]} is {rest.over[i]:.3g} beyond its limit"
    missing = np.abs(rest.missing)
    dof = int(np.argmax(missing))
    return f"{missing[dof]:.3g} are missing at {robot.state_names[dof]}"


def nearest_rest(robot: "Robot", q: np.ndarray) -> Rest:
    """Return the robot at rest in the configuration nearest to q (nq,) that inputs hold, where the
    search finds one (see `Rest.held`).

    Minimises |forces|² + w |motion|² over motions from q inside the position limits and drives
    inside theirs, for weights w that fall to almost nothing: a local search, whose end is a local
    minimum of the distance. Forces are scaled by the largest one at q, motions by rad or m.
    """
    import mujoco

    forces = Forces(robot)
    model, nv = forces.model, forces.model.nv
    J, f = forces.affine(q)
    size = 1 + float(np.abs(f).max())

    def moved(d: np.ndarray) -> np.ndarray:
        position = q.copy()
        mujoco.mj_integratePos(model, position, d, 1.0)
        return position

    low, high = np.full(nv, -np.inf), np.full(nv, np.inf)
    limits = robot.state_limits
    for kind, at, dof in zip(model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, strict=True):
        count = {0: 3, 1: 0}.get(int(kind), 1)  # free joints move along the world's axes
        here = q[at : at + count]
        low[dof : dof + count] = np.asarray(limits.lower)[dof : dof + count] - here
        high[dof : dof + count] = np.asarray(limits.upper)[dof : dof + count] - here
    lower, upper = np.append(low, forces.lower), np.append(high, forces.upper)
    tight = upper - lower < 1e-9
    lower, upper = lower - 1e-9 * tight, upper + 1e-9 * tight
    inside = lambda z: np.clip(z, lower + _inset(lower, upper), upper - _inset(lower, upper))
    drive = np.linalg.lstsq(J, -f, rcond=None)[0]
    z = inside(np.append(np.zeros(nv), drive))
    width = np.maximum(1.0, np.abs(drive))

    for weight in _WEIGHTS:
        root = np.sqrt(weight)
        # Drives weigh next to nothing: of many that hold q, a small one.
        tiny = 1e-3 * root / width

        def residual(z: np.ndarray, root: float = root, tiny: Any = tiny) -> np.ndarray:
            missing = forces.at(moved(z[:nv]), z[nv:]) / size
            return np.concatenate([missing, root * z[:nv], tiny * z[nv:]])

        def jacobian(z: np.ndarray, root: float = root, tiny: Any = tiny) -> np.ndarray:
            change = [
                (forces.at(moved(z[:nv] + e), z[nv:]) - forces.at(moved(z[:nv] - e), z[nv:]))
                / (2 * _STEP)
                for e in _STEP * np.eye(nv)
            ]
            by_drive, _ = forces.affine(moved(z[:nv]))
            top = np.hstack([np.array(change).T, by_drive]) / size
            return np.vstack([top, np.diag(np.append(np.full(nv, root), tiny))])

        found = least_squares(
            residual, z, jacobian, bounds=(lower, upper), x_scale=np.append(np.ones(nv), width),
            xtol=1e-14, ftol=1e-14, gtol=1e-14, max_nfev=50,
        )  # fmt: skip
        z = inside(found.x)
    position = moved(z[:nv])
    J, f = forces.affine(position)
    drive = np.clip(z[nv:], forces.lower, forces.upper)
    # The search leaves rounding; what it found is the balance of its neighbourhood.
    better = np.clip(
        drive - np.linalg.lstsq(J, J @ drive + f, rcond=None)[0], forces.lower, forces.upper
    )
    rests = [forces.rest(position, v, f) for v in (drive, better)]
    return min(rests, key=lambda rest: float(np.abs(rest.missing).max()))


def _inset(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return how far a start has to be from its bounds."""
    width = upper - lower
    return np.where(np.isfinite(width), 1e-10 * np.where(np.isfinite(width), width, 0), 1e-10)
