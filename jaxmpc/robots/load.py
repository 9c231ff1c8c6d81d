"""load_robot: from a model file to a Robot, its limits read and checked."""

import copy
import hashlib
import warnings
import xml.etree.ElementTree as ElementTree
from collections import Counter
from importlib import resources
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxmpc.arrays import Reals
from jaxmpc.checks import (
    fail,
    require_finite,
    require_package,
    require_printable,
    require_shape,
)
from jaxmpc.robots.engine import model_bytes
from jaxmpc.robots.guard import compared
from jaxmpc.robots.physics import RK4, Physics
from jaxmpc.robots.robot import Robot
from jaxmpc.robots.supported import lacks, translate
from jaxmpc.robots.tangent import unit_orientations
from jaxmpc.robots.urdf import compiled_urdf
from jaxmpc.sets.box import Box
from jaxmpc.sets.limits import Limit, limit_pair
from jaxmpc.systems.system import require_period

if TYPE_CHECKING:
    import mujoco

MODELS = ("joint", "pendulum", "cartpole", "arm2", "arm6", "arm7", "quadrotor")


def load_robot(
    model: "str | Path | mujoco.MjModel", *, position: Limit = None, velocity: Limit = None,
    torque: Limit = None, home: Reals | None = None, control_period: float | None = None,
    timestep: float | None = None, floating_base: bool = False, mend_inertias: bool = False,
) -> Robot:  # fmt: skip
    """Load a robot: a model of ours, an MJCF or URDF file, or a mujoco.MjModel.

    Arguments:
        model: "joint" (one hinge), "pendulum", "cartpole", "arm2", "arm6" (UR5e), "arm7" (Franka
            FER), "quadrotor" (Crazyflie 2), or a path. A URDF gets a motor for each joint
            with its `effort` as limit, its `velocity` limits are read (0 of either: none), and its
            shapes are left out: it must give inertias, has no contacts, needs no mesh files.
        position, velocity, torque: limits in place of the file's, as `joint_limits` takes them:
            (lower, upper), each a number or one a dof (torque: one an actuator), or v for
            |.| ≤ v, inputs in units of ctrl. They bind the controller; the joint stops of the plant
            stay, and its motors apply any input that they are given.
        home: configuration (nq,) in place of the file's.
        control_period: seconds between inputs; a multiple of timestep, the physics step (s).
        floating_base: of a URDF, whether its root link moves freely; else it is welded to the
            world.
        mend_inertias: of a URDF, whether inertias that no body can have (principal moments that are
            not positive or violate a + b ≥ c, moving links without mass) are replaced by near ones,
            which `report` lists. Without it they are refused.

    Defaults where the file lacks `<numeric name="velocity_limit">`, `<numeric name=
    "control_period">` and `<key name="home">`: none, 10 ms (rounded to physics steps), and the
    model's qpos0 moved inside the joint ranges. Input limits are the narrowest of `ctrlrange`,
    and for motors `forcerange` and the joint's `actuatorfrcrange`.

    What MJX lacks is taken out: where that changes no motion in silence (switches of diagnostics,
    sensors), else with a UserWarning (contacts between shapes for which it has no function, noslip
    iterations, powers of damping, armature and delay of actuators, adhesion). Short motions of the
    plant are then compared with those of the file in MuJoCo's C engine, and a UserWarning names the
    joints, actuators and tendons that move otherwise, and couplings, which linear models lack.
    `robot.report()` lists all of it, and what acts in the plant but not in linear models.

    Raises ValueError for files that MuJoCo cannot read, models without actuators or joints, what
    else MJX does not support, and limits that contradict each other; ImportError without MuJoCo.
    """
    require_package("mujoco", "robots")
    import mujoco

    _compare_versions()
    velocities: dict[str, float] = {}
    mended: tuple[str, ...] = ()
    name = "robot"
    for argument, given in (("floating_base", floating_base), ("mend_inertias", mend_inertias)):
        if given and not (isinstance(model, str | Path) and _is_urdf(model)):
            fail(argument, "is for URDF files", "Write it into the MJCF file or the MjModel")
    welded = isinstance(model, str | Path) and _is_urdf(model) and not floating_base
    if isinstance(model, str | Path):
        name = Path(model).stem
        model, velocities, mended = _compiled_model(model, floating_base, mend_inertias)
    elif not isinstance(model, mujoco.MjModel):
        fail("model", f"is a {type(model).__name__}", "Give a name, a path or a mujoco.MjModel")
    host = copy.deepcopy(model)
    if host.nv == 0:
        fail("model", f"{name} has no joints", "A robot has something to move")
    if host.nu == 0:
        fail(
            "model",
            f"{name} has no actuators",
            "Add <actuator><motor joint=.../></actuator>; a URDF file gets motors",
        )
    if host.na and host.opt.integrator == RK4:
        fail("model", f"{name} has {host.na} activation states and the integrator RK4",
             "Use another integrator, or actuators with dyntype none")  # fmt: skip
    if timestep is not None:
        require_period("timestep", timestep)
        host.opt.timestep = timestep
    h = host.opt.timestep
    if control_period is None:
        found = np.atleast_1d(_numeric(host, "control_period", max(1, round(0.01 / h)) * h))
        control_period = float(f"{found[0]:.12g}")
    require_period("control_period", control_period)
    substeps = round(control_period / h)
    if substeps < 1 or abs(substeps * h - control_period) > 1e-9 * control_period:
        fail(
            "control_period", f"{control_period:g} s is no multiple of the physics step {h:g} s",
            "Give whole multiples, or another timestep",
        )  # fmt: skip

    given = copy.deepcopy(host)
    host.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
    cleared = translate(host)
    missing = lacks(host)
    for lack in missing:
        lack.take_out(host)
    inputs, of_inputs = _input_limits(host)
    limits = _overridden("torque", inputs, torque, slice(None))
    smooth = copy.deepcopy(host)
    smooth.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    smooth.actuator_forcelimited[:] = 0
    smooth.jnt_actfrclimited[:] = 0
    names, units = _state_names(host)
    require_printable("model", name, *names)
    states, of_states = _state_limits(host, position, velocity, velocities)
    q, act, source = _home(host)
    if home is not None:
        q, source = _configuration(host, home), "argument"
    start, plant = np.concatenate([q, np.zeros(host.nv), act]), Physics(host)
    idle, without, unlike = compared(given, plant, missing, inputs, start)
    cleared += [f"{text}, without effect" for text in idle]
    texts = [f"moves without {'; '.join(without)} of its file, which MJX lacks"] * bool(without)
    texts += [f"moves otherwise than its file says: {'; '.join(unlike)}"] * bool(unlike)
    coupled = _couplings(host)
    if coupled:
        texts.append(f"has couplings that its linear models lack ({coupled})")
    if texts:
        warnings.warn(f"robot {name} {', and '.join(texts)}", stacklevel=2)
    left_out = [*without, *unlike]
    of_inputs = of_inputs if torque is None else ["argument"] * host.nu
    notes = [
        *(("cleared", text) for text in cleared), *(("left out", text) for text in left_out),
        *(("mended", text) for text in mended), ("home", source),
        *(("limit", text) for text in (*of_states, *of_inputs)),
    ]  # fmt: skip
    if welded:
        notes.append(("welded", "the root link is welded to the world (see floating_base)"))
    return Robot(
        state_limits=states, input_limits=limits, home=start, file=given,
        plant=plant, predictor=Physics(smooth), anchor=_anchor(host, q),
        substeps=substeps, dt=control_period, name=name, state_names=names, state_units=units,
        input_names=tuple(_mujoco_names(host, mujoco.mjtObj.mjOBJ_ACTUATOR, host.nu, "u")),
        input_units=tuple(_input_unit(host, i) for i in range(host.nu)), notes=tuple(notes),
    )  # fmt: skip


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


def _configuration(host: "mujoco.MjModel", home: Any) -> np.ndarray:
    """Return the configuration `home` (nq,), checked, with unit quaternions."""
    require_shape("home", home, (host.nq,), "One configuration, as in qpos")
    require_finite("home", home)
    return unit_orientations("home", host.jnt_type, np.array(home, float))


def _anchor(host: "mujoco.MjModel", home: np.ndarray) -> tuple[float, ...]:
    """Return zeros, with the orientations of the configuration `home`."""
    anchor = np.zeros(host.nq)
    for kind, i in zip(host.jnt_type, host.jnt_qposadr, strict=True):
        if kind in (0, 1):  # free, ball
            i = i + (3 if kind == 0 else 0)
            anchor[i : i + 4] = home[i : i + 4] / np.linalg.norm(home[i : i + 4])
    return tuple(anchor.tolist())


def _compiled_model(
    model: str | Path, floating_base: bool, mend_inertias: bool
) -> tuple["mujoco.MjModel", dict[str, float], tuple[str, ...]]:
    """Return the compiled model, and of a URDF its velocity limits by joint and what was mended."""
    import mujoco

    path = Path(model)
    if str(model) in MODELS:
        path = Path(str(resources.files("jaxmpc.robots"))) / "models" / f"{model}.xml"
    elif not path.is_file():
        fail("model", f"{str(model)!r} is no file", f"Give a path, or one of {', '.join(MODELS)}")
    try:
        if _is_urdf(path):
            return compiled_urdf(
                path.read_text(), floating_base=floating_base, mend_inertias=mend_inertias
            )
        return mujoco.MjModel.from_xml_path(str(path)), {}, ()
    except (ValueError, ElementTree.ParseError) as error:
        text = " ".join(str(error).split())
        fail("model", f"{path} cannot be read: {text.rstrip('.')}", "Mend the file")


def _numeric(host: "mujoco.MjModel", name: str, default: Any) -> Any:
    """Return the custom numbers of this name in the file."""
    import mujoco

    i = mujoco.mj_name2id(host, mujoco.mjtObj.mjOBJ_NUMERIC, name)
    if i < 0:
        return default
    start, size = host.numeric_adr[i], host.numeric_size[i]
    value = host.numeric_data[start : start + size].copy()
    return value[0] if size == 1 else value


def _mujoco_names(host: "mujoco.MjModel", kind: Any, count: int, letter: str) -> list[str]:
    """Return the names of `count` objects of a kind; letter and number where there is none."""
    import mujoco

    return [mujoco.mj_id2name(host, kind, i) or f"{letter}{i + 1}" for i in range(count)]


def _state_names(host: "mujoco.MjModel") -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names and units of the coordinates, positions first."""
    import mujoco

    free, ball, slide, _ = range(4)
    positions: list[tuple[str, str]] = []
    for name, kind in zip(
        _mujoco_names(host, mujoco.mjtObj.mjOBJ_JOINT, host.njnt, "q"), host.jnt_type, strict=True
    ):
        if kind == free:
            positions += [(f"{name} {axis}", "m") for axis in "xyz"]
        if kind in (free, ball):
            positions += [(f"{name} rotation {axis}", "rad") for axis in "xyz"]
        else:
            positions.append((name, "m" if kind == slide else "rad"))
    names = [name for name, _ in positions] + [f"{name} velocity" for name, _ in positions]
    units = [unit for _, unit in positions] + [f"{unit}/s" for _, unit in positions]
    active = np.flatnonzero(host.actuator_actadr >= 0)
    inputs = _mujoco_names(host, mujoco.mjtObj.mjOBJ_ACTUATOR, host.nu, "u")
    names += [f"{inputs[i]} activation" for i in active]
    return tuple(names), (*units, *[""] * len(active))


def _input_unit(host: "mujoco.MjModel", i: int) -> str:
    """Return the unit of an actuator's input: force or torque of a joint's motor, else unknown."""
    if not _is_motor(host, i) or abs(host.actuator_gainprm[i, 0] * host.actuator_gear[i, 0]) != 1:
        return ""
    return "N" if host.jnt_type[host.actuator_trnid[i, 0]] == 2 else "N m"


def _is_motor(host: "mujoco.MjModel", i: int) -> bool:
    """Return whether an actuator puts a multiple of its input on one hinge or slide joint."""
    import mujoco

    return (
        host.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
        and host.jnt_type[host.actuator_trnid[i, 0]] in (2, 3)
        and host.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
        and host.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_NONE
    )


def _couplings(host: "mujoco.MjModel") -> str:
    """Return the equalities that act, such as "2 of type joint", or nothing."""
    import mujoco

    bit = mujoco.mjtDisableBit
    if host.opt.disableflags & (int(bit.mjDSBL_EQUALITY) | int(bit.mjDSBL_CONSTRAINT)):
        return ""
    kinds = Counter(int(kind) for kind in host.eq_type[host.eq_active0.astype(bool)])
    return ", ".join(
        f"{count} of type {mujoco.mjtEq(kind).name[5:].lower()}" for kind, count in kinds.items()
    )


def _input_limits(host: "mujoco.MjModel") -> tuple[Box, list[str]]:
    """Return the box of inputs and the source of each, and drop in `host` the motors' force limits
    that it takes over."""
    import mujoco

    lower, upper = np.full(host.nu, -np.inf), np.full(host.nu, np.inf)
    limited = host.actuator_ctrllimited.astype(bool)
    lower[limited], upper[limited] = host.actuator_ctrlrange[limited].T
    sources = ["ctrlrange" if yes else "" for yes in limited]
    on_joint = host.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    joints = np.where(on_joint, host.actuator_trnid[:, 0], -1)
    for i in range(host.nu):
        gain, gear = host.actuator_gainprm[i, 0], host.actuator_gear[i, 0]
        if not _is_motor(host, i) or gain * gear == 0:
            continue
        alone = np.sum(joints == joints[i]) == 1
        ends = {}
        if host.actuator_forcelimited[i]:
            ends["forcerange"] = host.actuator_forcerange[i] / gain
            host.actuator_forcelimited[i] = 0
        # The limit of a joint bounds what compensates gravity there, too.
        alone = alone and not host.jnt_actgravcomp[joints[i]]
        if host.jnt_actfrclimited[joints[i]] and alone:
            ends["actuatorfrcrange"] = host.jnt_actfrcrange[joints[i]] / (gain * gear)
            host.jnt_actfrclimited[joints[i]] = 0
        for source, end in ends.items():
            if end.min() > lower[i] or end.max() < upper[i]:
                sources[i] = source
            lower[i], upper[i] = max(lower[i], end.min()), min(upper[i], end.max())
    sources = ["none" if not source else f"file, {source}" for source in sources]
    return Box(lower, upper), sources


def _state_limits(
    host: "mujoco.MjModel", position: Limit, velocity: Limit, of_file: dict[str, float]
) -> tuple[Box, list[str]]:
    """Return the limits of the coordinates ξ (joint ranges, velocities and ranges of activations),
    and the source of each."""
    import mujoco

    nv, size = host.nv, 2 * host.nv + host.na
    lower, upper = np.full(size, -np.inf), np.full(size, np.inf)
    sources = ["none"] * size
    names = _mujoco_names(host, mujoco.mjtObj.mjOBJ_JOINT, host.njnt, "q")
    for j in range(host.njnt):
        dof = host.jnt_dofadr[j]
        if host.jnt_limited[j] and host.jnt_type[j] in (2, 3):
            lower[dof], upper[dof] = host.jnt_range[j]
            sources[dof] = "file, range"
        speed = of_file.get(names[j], np.inf)
        lower[nv + dof], upper[nv + dof] = -speed, speed
        if np.isfinite(speed):
            sources[nv + dof] = "file, velocity"
    speeds = np.atleast_1d(_numeric(host, "velocity_limit", np.inf))
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
    limits = _overridden("position", Box(lower, upper), position, slice(0, nv))
    limits = _overridden("velocity", limits, velocity, rates)
    for given, part in ((position, slice(0, nv)), (velocity, rates)):
        sources[part] = sources[part] if given is None else ["argument"] * nv
    slow, fast = np.asarray(limits.lower)[rates], np.asarray(limits.upper)[rates]
    if np.any((slow > 0) | (fast < 0)):
        i = int(np.argmax((slow > 0) | (fast < 0)))
        cure = "Give (lower, upper) with 0 inside, or one number v for |.| ≤ v"
        fail("velocity", f"[{slow[i]:g}, {fast[i]:g}] of dof {i} leaves out rest", cure)
    return limits, sources


def _overridden(argument: str, limits: Box, override: Limit, part: slice) -> Box:
    """Return the box with some of its bounds replaced; raise ValueError where it is empty."""
    lower, upper = np.array(limits.lower), np.array(limits.upper)
    if override is not None:
        size = len(lower[part])
        for ends, end in zip((lower, upper), limit_pair(argument, override), strict=True):
            if np.shape(end) not in ((), (size,)):
                fail(argument, f"{np.size(end)} entries where {size} are needed", "Or one number")
            ends[part] = end
    Box(lower[part], upper[part]).validate(argument)
    return Box(lower, upper)


def _home(host: "mujoco.MjModel") -> tuple[np.ndarray, np.ndarray, str]:
    """Return qpos, act and the source: the key "home", else the first key, else qpos0 moved inside
    the ranges and zeros."""
    import mujoco

    if host.nkey:
        key = max(mujoco.mj_name2id(host, mujoco.mjtObj.mjOBJ_KEY, "home"), 0)
        name = mujoco.mj_id2name(host, mujoco.mjtObj.mjOBJ_KEY, key)
        return host.key_qpos[key].copy(), host.key_act[key].copy(), f"file, key {name or key}"
    q = host.qpos0.copy()
    for j in range(host.njnt):
        if host.jnt_limited[j] and host.jnt_type[j] in (2, 3):
            at = host.jnt_qposadr[j]
            q[at] = np.clip(q[at], *host.jnt_range[j])
    moved = "" if np.array_equal(q, host.qpos0) else ", moved inside the joint ranges"
    return q, np.zeros(host.na), f"file, qpos0{moved}"


def model_hash(robot: Robot) -> str:
    """Return a hash of the compiled model, by which a resumed run notices a change."""
    return hashlib.sha256(model_bytes(robot.mujoco).tobytes()).hexdigest()
