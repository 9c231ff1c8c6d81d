"""load_robot: from an MJCF or URDF file to a Robot, its limits and names read and checked."""

import codecs
import copy
import hashlib
import re
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from importlib import resources
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxmpc.arrays import Reals
from jaxmpc.checks import fail, require_finite, require_package, require_printable, require_shape
from jaxmpc.robots.configurations import blocks, unit_orientations
from jaxmpc.robots.mjx_gaps import compared, lacks, mesh_contacts, translate
from jaxmpc.robots.mujoco_access import (
    BALL,
    FREE,
    HINGE,
    SLIDE,
    equalities,
    flag,
    model_bytes,
    moment_arms,
    mujoco,
    muscular,
    names,
    number_of,
    single_joints,
)
from jaxmpc.robots.physics import RK4, Physics
from jaxmpc.robots.robot import Robot
from jaxmpc.robots.urdf_shapes import compiled_shapes, drawable
from jaxmpc.sets.convex_sets import Box
from jaxmpc.sets.limits import Limit, limit_pair, require_one_reading
from jaxmpc.systems.system import require_period

# The source of a limit that is an argument and wider than the file's, which stands after it.
BEYOND = "argument, beyond the file's "
MODELS = ("joint", "pendulum", "cartpole", "arm2", "arm6", "arm7", "quadrotor")
# Pairs of meshes in contact that compile within some twenty seconds.
_MESHES = 4


def load_robot(
    model: "str | Path | mujoco.MjModel",
    *,
    position: Limit = None,
    velocity: Limit = None,
    torque: Limit = None,
    home: Reals | None = None,
    control_period: float | None = None,
    timestep: float | None = None,
    floating_base: bool = False,
    mend_inertias: bool = False,
    motors: bool = False,
    contacts: bool = True,
) -> Robot:
    """Load a robot: a model of ours, an MJCF or URDF file, or a mujoco.MjModel.

    Arguments:
        model: "joint" (one hinge), "pendulum", "cartpole", "arm2", "arm6" (UR5e), "arm7" (Franka
            FER), "quadrotor" (Crazyflie 2), or a path. A URDF gets a motor for each joint that
            mimics no other, with its `effort` as limit, its `velocity` limits are read (0 of
            either, and a range from 0 to 0: none), and its shapes are for pictures alone: it must
            give inertias, has no contacts, needs no mesh files.
        position, velocity, torque: limits in place of the file's, as `joint_limits` takes them:
            (lower, upper), each a number or one a dof (torque: one an actuator), or v for
            |.| ≤ v, inputs in units of ctrl. They bind the controller; the joint stops of the plant
            stay, and its motors apply any input that they are given.
        home: configuration (nq,) in place of the file's.
        control_period: seconds between inputs; a multiple of timestep.
        timestep: the physics step in s, in place of the file's.
        floating_base: of a URDF, whether its root link moves freely; else it is welded to the
            world.
        mend_inertias: of a URDF, whether inertias that no body can have (principal moments that are
            not positive or violate a + b ≥ c, moving links without mass) are replaced by near ones,
            which `report` lists. Without it they are refused.
        motors: of an MJCF file without actuators, whether each hinge and slide joint that follows
            no other gets a motor of gear 1, with the joint's `actuatorfrcrange` as limit.
        contacts: False leaves all contacts out of the plant. MJX needs minutes to compile those
            between meshes, which an arm that touches nothing has for nothing.

    Defaults where the file lacks `<numeric name="velocity_limit">`, `<numeric name=
    "control_period">` and `<key name="home">`: none, 10 ms (rounded to physics steps), and the
    first key of another name, or without any the model's qpos0 moved inside the joint ranges. Input
    limits are the narrowest of `ctrlrange`, and for motors `forcerange` and the joint's
    `actuatorfrcrange`. Other limits of forces, those of servos, become rows in ξ and u of
    `robot_mpc`.

    Shapes of an MJCF file whose meshes are missing are left out, with a UserWarning, where their
    bodies have inertias of their own.

    What MJX lacks is taken out: where that changes no motion in silence (switches of diagnostics,
    sensors), else with a UserWarning (contacts between shapes for which it has no function, noslip
    iterations, powers of damping, armature and delay of actuators, adhesion of geoms). Short
    motions of the plant are then compared with those of the file in MuJoCo's C engine, and a
    UserWarning names the joints, actuators and tendons that move otherwise, or says that the
    file's solver stops before it has converged.
    `robot.report()` lists all of it, and what acts in the plant but not in linear models.

    Raises ValueError for files that MuJoCo cannot read, models without actuators or joints, what
    else MJX does not support, and limits that contradict each other; ImportError without MuJoCo.
    """
    require_package("mujoco", "robots")
    _compare_versions()
    file = _opened(model, floating_base, mend_inertias, motors)
    host, name = file.model, file.name
    _require_plant(host, name)
    substeps, period = _periods(host, control_period, timestep)
    _place_mocap(host)
    if not contacts:
        host.opt.disableflags |= flag("contact")
    given = copy.deepcopy(host)
    host.opt.disableflags |= flag("clampctrl")
    cleared = translate(host)
    missing = lacks(host)
    for lack in missing:
        lack.take_out(host)
    flags = ("actuator_forcelimited", "jnt_actfrclimited")
    limited = {key: getattr(host, key).astype(bool) for key in flags}
    inputs, input_sources = input_limits(host)
    limits = overridden("torque", inputs, torque, slice(None))
    if torque is not None:
        input_sources = _argument_sources(inputs, limits, slice(None))
    labels, units = coordinate_names(host)
    require_printable("model", name, *labels)
    states, sources = state_limits(host, position, velocity, file.velocities)
    q, act, origin = _home(host, home)
    start, plant = np.concatenate([q, np.zeros(host.nv), act]), Physics(host, limited)
    _warn_of_meshes(name, host)
    input_names = tuple(named(host, "actuator", "u"))
    _warn_of_limits(name, [*labels, *input_names], [*sources, *input_sources])
    idle, without, unlike = compared(given, plant, missing, inputs, start)
    off = host.opt.disableflags & flag("actuation")
    lost = (*file.lost, *["the forces of its actuators, which the file switches off"] * bool(off))
    _warn_of_differences(name, without, unlike, lost)
    notes = {
        "cleared": [*cleared, *(f"{text}, without effect" for text in idle)],
        "left out": [*["all contacts"] * (not contacts), *lost, *without, *unlike],
        "mended": file.mended,
        "home": [origin],
        "limit": [*sources, *input_sources],
        "welded": ["the root link is welded to the world (see floating_base)"] * file.welded,
    }
    return Robot(
        state_limits=states,
        input_limits=limits,
        home=start,
        file=given,
        shapes=file.shapes,
        plant=plant,
        predictor=Physics(_smooth(host)),
        anchor=_anchor(host, q),
        substeps=substeps,
        dt=period,
        name=name,
        state_names=labels,
        state_units=units,
        input_names=input_names,
        input_units=tuple(input_unit(host, i) for i in range(host.nu)),
        notes=tuple((kind, text) for kind, texts in notes.items() for text in texts),
    )


class _File(NamedTuple):
    """A copy of the compiled model, its name, of a URDF the velocity limits by joint, what was
    mended, and whether its root link is welded to the world, shapes whose files are missing, and
    the model of its shapes."""

    model: "mujoco.MjModel"
    name: str
    velocities: dict[str, float]
    mended: tuple[str, ...]
    welded: bool
    lost: tuple[str, ...] = ()
    shapes: "mujoco.MjModel | None" = None


def _opened(
    model: "str | Path | mujoco.MjModel", floating_base: bool, mend_inertias: bool, motors: bool
) -> _File:
    """Return what `load_robot` is given, compiled. Raises ValueError for what cannot be read."""
    urdf = isinstance(model, str | Path) and _is_urdf(model)
    for argument, given in (("floating_base", floating_base), ("mend_inertias", mend_inertias)):
        if given and not urdf:
            fail(argument, "is for URDF files", "Write it into the MJCF file or the MjModel")
    if motors and (urdf or isinstance(model, mujoco.MjModel)):
        what = "a URDF, which gets motors anyway" if urdf else "a compiled model"
        fail("motors", f"given with {what}", "Leave it out, or give an MJCF file")
    if isinstance(model, mujoco.MjModel):
        return _File(copy.deepcopy(model), "robot", {}, (), False)
    if not isinstance(model, str | Path):
        fail("model", f"is a {type(model).__name__}", "Give a name, a path or a mujoco.MjModel")
    path = Path(model)
    if str(model) in MODELS:
        path = Path(str(resources.files("jaxmpc.robots"))) / "models" / f"{model}.xml"
    elif not path.is_file():
        fail("model", f"{str(model)!r} is no file", f"Give a path, or one of {', '.join(MODELS)}")
    own = _actuators(path) if motors else 0
    if own:
        fail("motors", f"given, and {path.name} has {own} actuators of its own", "Leave it out")
    try:
        if not urdf:
            host, lost = compiled_mjcf(path, motors)
            return _File(host, path.stem, {}, (), False, lost)
        welded = not floating_base
        root = parsed_urdf(path.read_bytes())
        drawn = drawable(root, path.resolve().parent)
        host, velocities, mended = compiled_urdf(root, floating_base, mend_inertias)
        if floating_base:
            _free(drawn)
        shapes = compiled_shapes(drawn)
        return _File(host, path.stem, velocities, mended, welded, shapes=shapes)
    except (ValueError, ElementTree.ParseError) as error:
        text = " ".join(str(error).split()).rstrip(".")
        problem, cure = f"{path} cannot be read: {text}", "Mend the file"
        if cure in text:  # of an inertia: it has its own cure
            problem, _, cure = problem.rpartition(f". {cure}")
            cure = f"Mend the file{cure}"
        fail("model", problem, cure)


def _actuators(path: Path) -> int:
    """Return the number of actuators of an MJCF file, 0 where it cannot be read."""
    try:
        return len(mujoco.MjSpec.from_file(str(path)).actuators)
    except ValueError:
        return 0


def _require_plant(host: "mujoco.MjModel", name: str) -> None:
    """Raise ValueError for a model that is no plant with inputs."""
    if host.nv == 0:
        fail("model", f"{name} has no joints", "A robot has something to move")
    if host.nu == 0:
        cure = "Load the file with motors=True, or add <actuator><motor joint=.../></actuator>"
        fail("model", f"{name} has no actuators", cure)
    if host.na and host.opt.integrator == RK4:
        problem = f"{name} has {host.na} activation states and the integrator RK4"
        fail("model", problem, "Use another integrator, or actuators with dyntype none")


def _periods(
    host: "mujoco.MjModel", control_period: float | None, timestep: float | None
) -> tuple[int, float]:
    """Return the physics steps of a control period, and the period (s); set the physics step."""
    if timestep is not None:
        require_period("timestep", timestep)
        host.opt.timestep = timestep
    h = host.opt.timestep
    if control_period is None:
        found = np.atleast_1d(numeric(host, "control_period", max(1, round(0.01 / h)) * h))
        control_period = float(f"{found[0]:.12g}")
    require_period("control_period", control_period)
    substeps = round(control_period / h)
    if substeps < 1 or abs(substeps * h - control_period) > 1e-9 * control_period:
        problem = f"{control_period:g} s is no multiple of the physics step {h:g} s"
        fail("control_period", problem, "Give whole multiples, or another timestep")
    return substeps, control_period


def _smooth(host: "mujoco.MjModel") -> "mujoco.MjModel":
    """Return a copy without contacts, stops, friction and limits of forces and activations: a clamp
    takes the derivative away where a plan operates, and rows of the problem keep the limits."""
    found = copy.deepcopy(host)
    for kind in ("contact", "limit", "frictionloss") if equalities(host) else ("constraint",):
        found.opt.disableflags |= flag(kind)
    found.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL  # MJX fails on others without contacts
    found.actuator_forcelimited[:] = 0
    found.jnt_actfrclimited[:] = 0
    found.tendon_actfrclimited[:] = 0
    found.actuator_actlimited[:] = 0
    return found


def _warn_of_limits(name: str, labels: Sequence[str], sources: Sequence[str]) -> None:
    """Warn where arguments let the plant go where its file does not."""
    pairs = zip(labels, sources, strict=True)
    wide = [f"{v} (there {s.removeprefix(BEYOND)})" for v, s in pairs if s.startswith(BEYOND)]
    if wide:
        what = f"has wider limits than its file, by arguments: {', '.join(wide)}"
        plant = "The plant has the stops of the file; inputs are not clamped as MuJoCo clamps them"
        warnings.warn(f"robot {name} {what}. {plant}", stacklevel=3)


def _warn_of_differences(
    name: str, without: list[str], unlike: tuple[str, ...], lost: tuple[str, ...]
) -> None:
    """Warn where the plant moves otherwise than its file, or linear models otherwise than it."""
    texts = [f"lacks {'; '.join(lost)}"] if lost else []
    if without:
        texts.append(f"moves without {'; '.join(without)} of its file, which MJX lacks")
    if unlike:
        texts.append(f"moves otherwise than its file says: {'; '.join(unlike)}")
    if texts:
        warnings.warn(f"robot {name} {', and '.join(texts)}", stacklevel=3)


def _warn_of_meshes(name: str, host: "mujoco.MjModel") -> None:
    """Warn of many contacts between meshes before they are compiled."""
    count = mesh_contacts(host)
    if count > _MESHES:
        warnings.warn(
            f"robot {name} has {count} pairs of meshes that can touch; MJX compiles each for some "
            "seconds. Where they need not touch, load it with contacts=False",
            stacklevel=3,
        )


def _compare_versions() -> None:
    """Warn where MuJoCo and MJX are of different releases: MJX reads what that MuJoCo writes."""
    engine, mjx = version("mujoco"), version("mujoco-mjx")
    if engine.split(".")[:2] != mjx.split(".")[:2]:
        release = ".".join(mjx.split(".")[:2])
        warnings.warn(
            f"mujoco {engine} beside mujoco-mjx {mjx}: nobody tests this pair. "
            f"pip install 'mujoco=={release}.*' 'mujoco-mjx=={release}.*'",
            stacklevel=3,
        )


def _is_urdf(model: str | Path) -> bool:
    """Return whether a path ends in .urdf, or leads to an XML file whose root is <robot>."""
    path = Path(model)
    if path.suffix.lower() == ".urdf" or not path.is_file():
        return path.suffix.lower() == ".urdf"
    try:
        _, root = next(ElementTree.iterparse(path, events=("start",)))
    except (ElementTree.ParseError, StopIteration):
        return False  # which MuJoCo will say better
    return root.tag == "robot"


def _home(host: "mujoco.MjModel", home: Reals | None) -> tuple[np.ndarray, np.ndarray, str]:
    """Return qpos, act and the source: the argument, else the key "home", else the first key, else
    qpos0 moved inside the ranges and zeros. Raises ValueError for a wrong argument."""
    act, key = np.zeros(host.na), _home_key(host)
    q, source = host.qpos0.copy(), "file, qpos0"
    if host.nkey:
        q, act = host.key_qpos[key].copy(), host.key_act[key].copy()
        source = f"file, key {names(host, 'key')[key] or key}"
        if home is None and not np.all(np.isfinite(np.append(q, act))):
            fail(
                "model", f"its {source.removeprefix('file, ')} holds NaN", "Give home=, or mend it"
            )
        source += ", at rest" if np.any(host.key_qvel[key]) else ""
    else:
        ranged = host.jnt_limited.astype(bool) & single_joints(host)
        at = host.jnt_qposadr[ranged]
        q[at] = np.clip(q[at], *host.jnt_range[ranged].T)
        if not np.array_equal(q, host.qpos0):
            source += ", moved inside the joint ranges"
    if home is not None:
        require_shape("home", home, (host.nq,), "One configuration, as in qpos")
        require_finite("home", home)
        q, source = unit_orientations("home", host.jnt_type, np.array(home, float)), "argument"
    return q, act, source


def _home_key(host: "mujoco.MjModel") -> int:
    """Return the number of the key "home", of the first one where no other has that name."""
    return max(number_of(host, "key", "home"), 0)


def _place_mocap(host: "mujoco.MjModel") -> None:
    """Put the bodies that nothing but the user moves ("mocap") where the key for home has them: the
    plant leaves them there."""
    if not host.nkey:
        return
    bodies, key = np.flatnonzero(host.body_mocapid >= 0), _home_key(host)
    order = host.body_mocapid[bodies]
    host.body_pos[bodies] = host.key_mpos[key].reshape(-1, 3)[order]
    host.body_quat[bodies] = host.key_mquat[key].reshape(-1, 4)[order]


def _anchor(host: "mujoco.MjModel", home: np.ndarray) -> tuple[float, ...]:
    """Return zeros, with the orientations of the configuration `home`."""
    anchor = np.zeros(host.nq)
    for place, _, turns in blocks(host.jnt_type):
        if turns:
            anchor[place] = home[place] / np.linalg.norm(home[place])
    return tuple(anchor.tolist())


def model_hash(robot: Robot) -> str:
    """Return a hash of the compiled model, by which a resumed run notices a change."""
    return hashlib.sha256(model_bytes(robot.mujoco).tobytes()).hexdigest()


def numeric(host: "mujoco.MjModel", name: str, default: float) -> np.ndarray | float:
    """Return the custom numbers of this name in the file."""
    i = number_of(host, "numeric", name)
    if i < 0:
        return default
    start, size = host.numeric_adr[i], host.numeric_size[i]
    return host.numeric_data[start : start + size].copy()


def named(host: "mujoco.MjModel", kind: str, letter: str) -> list[str]:
    """Return the names of the joints, actuators, ...; letter and number where there is none."""
    return [name or f"{letter}{i + 1}" for i, name in enumerate(names(host, kind))]


def coordinate_names(host: "mujoco.MjModel") -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names and units of the coordinates, positions first."""
    positions: list[tuple[str, str]] = []
    for name, kind in zip(named(host, "joint", "q"), host.jnt_type, strict=True):
        if kind == FREE:
            positions += [(f"{name} {axis}", "m") for axis in "xyz"]
        if kind in (FREE, BALL):
            positions += [(f"{name} rotation {axis}", "rad") for axis in "xyz"]
        else:
            positions.append((name, "m" if kind == SLIDE else "rad"))
    active = np.flatnonzero(host.actuator_actadr >= 0)
    inputs = named(host, "actuator", "u")
    labelled = [
        *positions,
        *((f"{name} velocity", f"{unit}/s") for name, unit in positions),
        *((f"{inputs[i]} activation", "") for i in active),
    ]
    return tuple(name for name, _ in labelled), tuple(unit for _, unit in labelled)


def input_unit(host: "mujoco.MjModel", i: int) -> str:
    """Return the unit of an input: the force of a joint's motor, the position or velocity of a
    servo of gear 1, else unknown."""
    if not _moves_one_joint(host, i):
        return ""
    gain, gear = host.actuator_gainprm[i, 0], host.actuator_gear[i, 0]
    bias = host.actuator_biasprm[i]
    slides = host.jnt_type[host.actuator_trnid[i, 0]] == SLIDE
    if _is_motor(host, i):
        return ("N" if slides else "N m") if abs(gain * gear) == 1 else ""
    length = "m" if slides else "rad"
    if abs(gear) == 1 and host.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE and not bias[0]:
        if bias[1] == -gain:
            return length
        if not bias[1] and bias[2] == -gain:
            return f"{length}/s"
    return ""


def _moves_one_joint(host: "mujoco.MjModel", i: int) -> bool:
    """Return whether an actuator of fixed gain, without a state, moves one hinge or slide joint."""
    return (
        host.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
        and host.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_NONE
        and host.jnt_type[host.actuator_trnid[i, 0]] in (SLIDE, HINGE)
        and host.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
    )


def _is_motor(host: "mujoco.MjModel", i: int) -> bool:
    """Return whether an actuator puts a multiple of its input on one hinge or slide joint."""
    no_bias = host.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_NONE
    return _moves_one_joint(host, i) and bool(no_bias)


def input_limits(host: "mujoco.MjModel") -> tuple[Box, list[str]]:
    """Return the box of inputs and the source of each, and drop in `host` the motors' force limits
    that it takes over."""
    lower, upper = np.full(host.nu, -np.inf), np.full(host.nu, np.inf)
    limited = host.actuator_ctrllimited.astype(bool)
    lower[limited], upper[limited] = host.actuator_ctrlrange[limited].T
    sources = ["ctrlrange" if yes else "" for yes in limited]
    # MuJoCo clamps the excitation of every muscle to [0, 1].
    for k in np.flatnonzero(muscular(host)):
        if lower[k] < 0 or upper[k] > 1:
            sources[k] = "muscle"
        lower[k], upper[k] = np.clip([lower[k], upper[k]], 0.0, 1.0)
    # Which actuators move a joint, also by tendons and sites, shows where nothing is aligned.
    data, rng = mujoco.MjData(host), np.random.default_rng(0)
    mujoco.mj_integratePos(host, data.qpos, rng.normal(size=host.nv), 1.0)
    mujoco.mj_fwdPosition(host, data)
    counts = np.sum(moment_arms(host, data) != 0, axis=0)
    for i in range(host.nu):
        gain, gear = host.actuator_gainprm[i, 0], host.actuator_gear[i, 0]
        if not _is_motor(host, i) or gain * gear == 0:
            continue
        joint = host.actuator_trnid[i, 0]
        alone = counts[host.jnt_dofadr[joint]] == 1
        ends = {}
        if host.actuator_forcelimited[i]:
            ends["forcerange"] = host.actuator_forcerange[i] / gain
            host.actuator_forcelimited[i] = 0
        # The limit of a joint bounds what compensates gravity there, too.
        alone = alone and not host.jnt_actgravcomp[joint]
        if host.jnt_actfrclimited[joint] and alone:
            ends["actuatorfrcrange"] = host.jnt_actfrcrange[joint] / (gain * gear)
            host.jnt_actfrclimited[joint] = 0
        for source, end in ends.items():
            if end.min() > lower[i] or end.max() < upper[i]:
                sources[i] = source
            lower[i], upper[i] = max(lower[i], end.min()), min(upper[i], end.max())
    sources = ["none" if not source else f"file, {source}" for source in sources]
    return Box(lower, upper), sources


def state_limits(
    host: "mujoco.MjModel", position: Limit, velocity: Limit, of_file: dict[str, float]
) -> tuple[Box, list[str]]:
    """Return the limits of the coordinates ξ (joint ranges, velocities and ranges of activations),
    and the source of each."""
    nv, size = host.nv, 2 * host.nv + host.na
    lower, upper = np.full(size, -np.inf), np.full(size, np.inf)
    sources = ["none"] * size
    names = named(host, "joint", "q")
    for j in range(host.njnt):
        dof = host.jnt_dofadr[j]
        if host.jnt_limited[j] and host.jnt_type[j] in (SLIDE, HINGE):
            lower[dof], upper[dof] = host.jnt_range[j]
            sources[dof] = "file, range"
        speed = of_file.get(names[j], np.inf)
        lower[nv + dof], upper[nv + dof] = -speed, speed
        if np.isfinite(speed):
            sources[nv + dof] = "file, velocity"
    speeds = np.atleast_1d(numeric(host, "velocity_limit", np.inf))
    if speeds.size not in (1, nv):
        fail("velocity_limit", f"{speeds.size} numbers in the file, {nv} dofs", "Give one a dof")
    speeds = np.broadcast_to(speeds, nv)
    rates = slice(nv, 2 * nv)
    for dof in np.flatnonzero(speeds < upper[rates]):
        sources[nv + dof] = "file, velocity_limit"
    lower[rates], upper[rates] = np.maximum(lower[rates], -speeds), np.minimum(upper[rates], speeds)
    for k in np.flatnonzero(host.actuator_actlimited & (host.actuator_actadr >= 0)):
        at = 2 * nv + host.actuator_actadr[k]
        lower[at], upper[at] = host.actuator_actrange[k]
        sources[at] = "file, actrange"
    of_the_file, places = Box(lower, upper), slice(0, nv)
    limits = overridden("position", of_the_file, position, places)
    limits = overridden("velocity", limits, velocity, rates)
    if position is not None:
        sources[places] = _argument_sources(of_the_file, limits, places)
    if velocity is not None:
        sources[rates] = ["argument"] * nv
    slow, fast = np.asarray(limits.lower)[rates], np.asarray(limits.upper)[rates]
    if np.any((slow > 0) | (fast < 0)):
        i = int(np.argmax((slow > 0) | (fast < 0)))
        cure = "Give (lower, upper) with 0 inside, or one number v for |.| ≤ v"
        fail("velocity", f"[{slow[i]:g}, {fast[i]:g}] of dof {i} leaves out rest", cure)
    return limits, sources


def overridden(argument: str, limits: Box, override: Limit, part: slice) -> Box:
    """Return the box with some of its bounds replaced; raise ValueError where it is empty."""
    lower, upper = np.array(limits.lower), np.array(limits.upper)
    if override is not None:
        size = len(lower[part])
        require_one_reading(argument, override, size)
        for ends, end in zip((lower, upper), limit_pair(argument, override), strict=True):
            if np.shape(end) not in ((), (size,)):
                fail(argument, f"{np.size(end)} entries where {size} are needed", "Or one number")
            ends[part] = end
    Box(lower[part], upper[part]).validate(argument)
    return Box(lower, upper)


def _argument_sources(of_the_file: Box, given: Box, part: slice) -> list[str]:
    """Return the sources of limits that are arguments: with the limits of the file where these are
    narrower."""
    ends = (np.asarray(end)[part] for end in (*of_the_file.bounds(), *given.bounds()))
    return [
        f"{BEYOND}[{low:g}, {high:g}]" if a < low or b > high else "argument"
        for low, high, a, b in zip(*ends, strict=True)
    ]


def compiled_mjcf(path: Path, motors: bool = False) -> "tuple[mujoco.MjModel, tuple[str, ...]]":
    """Return an MJCF file, compiled, and what was left out because files are missing; motors:
    whether its joints get some.

    Shapes whose meshes are missing are left out where their bodies have inertias of their own, and
    textures that are missing. Raises ValueError where a body's mass is that of such a shape.
    """
    spec, lost = None, list[str]()
    if motors:
        spec = mujoco.MjSpec.from_file(str(path))
        joint = mujoco.mjtEq.mjEQ_JOINT
        followers = {equality.name1 for equality in spec.equalities if equality.type == joint}
        _add_motors(spec, followers)
    while True:
        try:
            if path.suffix.lower() == ".mjb":
                return mujoco.MjModel.from_binary_path(str(path)), ()
            if spec is None:
                return mujoco.MjModel.from_xml_path(str(path)), ()
            return spec.compile(), tuple(lost)
        except ValueError as error:
            missing = re.search(r"rror opening file '(.*)'", str(error))
            spec = mujoco.MjSpec.from_file(str(path)) if spec is None else spec
            if missing is None or not (text := _without_file(spec, missing[1])):
                raise ValueError("; ".join([*lost, str(error)])) from error
            lost.append(text)


def _without_file(spec: "mujoco.MjSpec", file: str) -> str:
    """Take out of a model what needs a file that is missing; return it in words, "" for nothing."""
    name = Path(file).name
    named = lambda asset: bool(asset.file) and name == Path(asset.file).name
    sides = lambda texture: [Path(side).name for side in texture.cubefiles]
    textures = [texture for texture in spec.textures if named(texture) or name in sides(texture)]
    for texture in textures:
        texture.file, texture.builtin = "", mujoco.mjtBuiltin.mjBUILTIN_FLAT
        texture.cubefiles = [""] * len(texture.cubefiles)
        texture.width = texture.height = 1
    if textures:
        return f"the texture {file}, which is missing"
    if skins := [skin for skin in spec.skins if named(skin)]:
        for skin in skins:
            spec.delete(skin)
        return f"the skin {file}, which is missing"
    meshes = [mesh for mesh in spec.meshes if named(mesh)]
    shapes = [geom for geom in spec.geoms if geom.meshname in {mesh.name for mesh in meshes}]
    by_shapes = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    for shape in shapes:
        body = shape.parent
        if body.name != "world" and shape.mass != 0 and (by_shapes or not body.explicitinertial):
            problem = f"the mesh {file} is missing, whose shape gives body {body.name} its mass"
            raise ValueError(f"{problem}; put the file there, or give the body an <inertial>")
    for part in (*shapes, *meshes):
        spec.delete(part)
    count = "1 shape" if len(shapes) == 1 else f"{len(shapes)} shapes"
    return f"{count} of the mesh {file}, which is missing" if meshes else ""


# A mended inertia keeps a + b ≥ c with this much room, relative to c: rounding in MuJoCo's own
# eigenvalues must not refuse it again.
_ROOM = 1e-9
# Mass of a moving link that has none, of the robot's: a ball of water of that mass.
_SHARE = 1e-4
_WATER = 1000.0
# Entries of an inertia in a URDF, those of the upper triangle row by row.
_AXES = ("xx", "xy", "xz", "yy", "yz", "zz")


def compiled_urdf(
    root: ElementTree.Element, floating_base: bool, mend_inertias: bool
) -> "tuple[mujoco.MjModel, dict[str, float], tuple[str, ...]]":
    """Return a URDF, compiled, the velocity limit of each joint, and what was mended.

    Visual and collision geometry is left out, so that no mesh is looked for. Each hinge and slide
    joint gets a motor, as a URDF cannot have any. Changes `root`.
    """
    for link in root.iter("link"):
        for kind in ("visual", "collision"):
            for element in link.findall(kind):
                link.remove(element)
        inertial = link.find("inertial")
        # A frame: MuJoCo refuses it, and it weighs nothing.
        if inertial is not None and _mass(link) == 0 and not np.any(_inertia(inertial)):
            link.remove(inertial)
    for joint in root.iter("joint"):
        limit = joint.find("limit")
        if joint.get("type") == "continuous" and limit is not None:
            for side in ("lower", "upper"):  # of no meaning there, which MuJoCo would take for one
                limit.attrib.pop(side, None)
    if floating_base:
        _free(root)
    changes = _mended(root) if mend_inertias else ()  # the freed root link counts as moving
    velocities, mimics = _velocities(root), _mimics(root)
    try:
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
        _complete_planar(root, spec)
        _add_motors(spec, mimics)
        return spec.compile(), velocities, changes
    except ValueError as error:
        # Its lines are those of the copy without shapes.
        problem = re.sub(r", line \d+", "", " ".join(str(error).split()))
        if "inertia" in problem and not mend_inertias:
            cure = "Mend the file, or load it with mend_inertias=True"
            fail("model", f"has an inertia that no body can have: {problem}", cure)
        raise ValueError(problem) from error


def _velocities(root: ElementTree.Element) -> dict[str, float]:
    """Return the limits of the velocities of the joints of a URDF, ∞ for 0. Raises ValueError for
    limits that no motion keeps: MuJoCo would drop such a range in silence."""
    found = dict[str, float]()
    for joint in root.iter("joint"):
        if (limit := joint.find("limit")) is None or joint.get("type") == "fixed":
            continue
        name = str(joint.get("name"))
        try:
            numbers = [float(limit.get(key, 0)) for key in ("lower", "upper", "effort", "velocity")]
        except ValueError as error:
            raise ValueError(f"a limit of joint {name} is no number: {error}") from None
        lower, upper, effort, velocity = numbers
        if not (lower < upper or lower == upper == 0):
            raise ValueError(f"joint {name} has the range [{lower:g}, {upper:g}]")
        if not (effort >= 0 and velocity >= 0):
            raise ValueError(f"joint {name} has the effort {effort:g}, the velocity {velocity:g}")
        # MuJoCo makes two slides of these names and a hinge of a planar joint.
        planar = [f"{name}_TX", f"{name}_TY"]
        for part in planar if joint.get("type") == "planar" else [name]:
            found[part] = velocity or np.inf
    return found


def _complete_planar(root: ElementTree.Element, spec: "mujoco.MjSpec") -> None:
    """Give the second slide of each planar joint the limits of the first: MuJoCo gives it none."""
    for joint in root.iter("joint"):
        if joint.get("type") == "planar":
            first, second = (spec.joint(f"{joint.get('name')}_T{axis}") for axis in "XY")
            for field in ("range", "limited", "actfrcrange", "actfrclimited"):
                setattr(second, field, getattr(first, field))


def _mimics(root: ElementTree.Element) -> set[str]:
    """Return the names of the joints of a URDF that mimic another. Raises ValueError where that is
    none that moves: MuJoCo would leave them free."""
    moving = {
        joint.get("name")
        for joint in root.iter("joint")
        if joint.get("type") in ("revolute", "continuous", "prismatic")
    }
    found = set[str]()
    for joint in root.iter("joint"):
        mimic, name = joint.find("mimic"), joint.get("name")
        if mimic is None or name not in moving:
            continue
        if (other := mimic.get("joint")) not in moving - {name}:
            raise ValueError(f"joint {name} mimics {other}, which is no other joint that moves")
        found.add(str(name))
    return found


def parsed_urdf(file: bytes) -> ElementTree.Element:
    """Return the root of a URDF, in the encoding that it declares. Prefixes of other programs
    (drake:acceleration) that the file does not declare, as most readers of URDF allow, are declared
    here."""
    wide = file.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    named = re.match(rb"""[^<]*<\?xml[^>]*encoding\s*=\s*["']([\w.-]+)""", file)
    try:
        text = file.decode("utf-16" if wide else named[1].decode() if named else "utf-8-sig")
    except LookupError as error:
        raise ValueError(str(error)) from error
    text = text.removeprefix("\ufeff")
    used = set(re.findall(r"[\s</]([A-Za-z_][\w.-]*):[A-Za-z_]", text))
    declared = set(re.findall(r"xmlns:([\w.-]+)\s*=", text))
    missing = sorted(used - declared - {"xml", "xmlns"})
    attributes = "".join(f' xmlns:{prefix}="{prefix}"' for prefix in missing)
    return ElementTree.fromstring(re.sub(r"<robot\b", f"<robot{attributes}", text))


def _root_link(root: ElementTree.Element) -> str:
    """Return the name of the link that is no joint's child."""
    children = {child.get("link") for child in root.findall("joint/child")}
    names = [str(link.get("name")) for link in root.findall("link")]
    roots = [name for name in names if name not in children]
    if len(roots) != 1:
        fail("model", f"has {len(roots)} root links", "Give a URDF of one tree")
    return roots[0]


def _free(root: ElementTree.Element) -> None:
    """Put a joint of type floating, which MuJoCo reads as a free joint, before the root link."""
    base = _root_link(root)
    if base == "world":
        problem = "the root link of the file is the world, to which it is mounted"
        fail("floating_base", problem, "Leave the argument out")
    ElementTree.SubElement(root, "link", name="world")
    joint = ElementTree.SubElement(root, "joint", name="base", type="floating")
    ElementTree.SubElement(joint, "parent", link="world")
    ElementTree.SubElement(joint, "child", link=base)


def _mass(link: ElementTree.Element) -> float:
    mass = link.find("inertial/mass")
    return 0.0 if mass is None else float(mass.get("value", "0"))


def _inertia(inertial: ElementTree.Element) -> np.ndarray:
    """Return the inertia (3, 3) about the centre of mass, zeros where there is none."""
    element = inertial.find("inertia")
    if element is None:
        return np.zeros((3, 3))
    inertia = np.zeros((3, 3))
    inertia[np.triu_indices(3)] = [float(element.get(f"i{axes}", "0")) for axes in _AXES]
    return inertia + np.triu(inertia, 1).T


def _ball(mass: float) -> float:
    """Return the inertia of a ball of water of this mass, 2/5 m r²."""
    return 0.4 * mass * (3 * mass / (4 * np.pi * _WATER)) ** (2 / 3)


def _mended(root: ElementTree.Element) -> tuple[str, ...]:
    """Give each link an inertia that a body can have, and return what was changed.

    The principal moments a ≤ b ≤ c of a body are positive and satisfy a + b ≥ c. Moments that are
    not positive, to a millionth, become those of a ball of water of the link's mass; where then
    a + b < c the moments become the nearest ones with a + b = c (all three move by a third of what
    is missing). Fixed links without inertia stay, as MuJoCo takes them for point masses.
    A link that moves without mass, its fixed parts counted in, gets a ball of 1e-4 of the mass of
    the robot.
    """
    changes = []
    total = sum(_mass(link) for link in root.findall("link"))
    ends = [
        (joint.get("type"), parent.get("link"), child.get("link"))
        for joint in root.findall("joint")
        for parent, child in zip(joint.findall("parent"), joint.findall("child"), strict=True)
    ]
    moving = {child for kind, _, child in ends if kind != "fixed"}
    for link in root.findall("link"):
        inertial, mass = link.find("inertial"), _mass(link)
        if inertial is None or not mass > 0:
            continue
        ball = max(_ball(mass), 1e-12)
        given, axes = np.linalg.eigh(_inertia(inertial))
        if not np.any(given) and link.get("name") not in moving:
            _write(inertial, mass, np.zeros((3, 3)))  # a point mass, which MuJoCo takes
            continue
        moments = np.where(given > 1e-6 * ball, given, ball)
        order = np.argsort(moments)
        a, b, c = moments[order]
        if np.any(moments != given) or c > a + b:
            missing = max(0.0, (c - a - b) / 3 + _ROOM * c)
            moments[order] = a + missing, b + missing, c - missing
            _write(inertial, mass, (axes * moments) @ axes.T)
            changes.append(
                f"{link.get('name')}: principal moments {_numbers(given)} to {_numbers(moments)}"
            )
    links = {link.get("name"): link for link in root.findall("link")}

    def weight(name: str | None) -> float:
        if name not in links:  # MuJoCo will say so
            return 1.0
        fixed = (child for kind, parent, child in ends if kind == "fixed" and parent == name)
        return _mass(links[name]) + sum(map(weight, fixed))

    for kind, _, child in ends:
        if kind == "fixed" or weight(child) > 0:
            continue
        link, mass = links[child], _SHARE * total
        for inertial in link.findall("inertial"):
            link.remove(inertial)
        _write(ElementTree.SubElement(link, "inertial"), mass, _ball(mass) * np.eye(3))
        changes.append(f"{child}: no mass to a ball of {mass:.3g} kg")
    return tuple(changes)


def _write(inertial: ElementTree.Element, mass: float, inertia: np.ndarray) -> None:
    for tag in ("mass", "inertia"):
        for element in inertial.findall(tag):
            inertial.remove(element)
    ElementTree.SubElement(inertial, "mass", value=repr(float(mass)))
    moments = zip(_AXES, inertia[np.triu_indices(3)], strict=True)
    values = {f"i{axes}": repr(float(value)) for axes, value in moments}
    ElementTree.SubElement(inertial, "inertia", values)


def _numbers(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{v:.3g}" for v in values) + ")"


def _add_motors(spec: "mujoco.MjSpec", mimics: set[str]) -> None:
    """Add a motor to each hinge and slide joint but those that mimic another."""
    single = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    for joint in spec.joints:
        if joint.type in single and joint.name not in mimics:
            motor = spec.add_actuator(name=f"{joint.name} torque", target=joint.name)
            motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
            motor.set_to_motor()
