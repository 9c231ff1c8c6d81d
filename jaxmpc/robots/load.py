"""load_robot: from a model file to a Robot, its limits read and checked."""

import copy
import hashlib
import warnings
import xml.etree.ElementTree as ElementTree
from collections import Counter
from importlib import resources
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxmpc.arrays import Reals
from jaxmpc.checks import fail, require_finite, require_package, require_printable, require_shape
from jaxmpc.robots.configurations import unit_orientations
from jaxmpc.robots.engine_comparison import compared
from jaxmpc.robots.file_limits import (
    coordinate_names,
    input_limits,
    input_unit,
    named,
    numeric,
    overridden,
    state_limits,
)
from jaxmpc.robots.mjx_gaps import lacks, translate
from jaxmpc.robots.mujoco_access import (
    BALL,
    FREE,
    equalities,
    flag,
    model_bytes,
    mujoco,
    names,
    number_of,
    single_joints,
)
from jaxmpc.robots.physics import RK4, Physics
from jaxmpc.robots.robot import Robot
from jaxmpc.robots.urdf import compiled_urdf
from jaxmpc.sets.limits import Limit
from jaxmpc.systems.system import require_period

MODELS = ("joint", "pendulum", "cartpole", "arm2", "arm6", "arm7", "quadrotor")


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
) -> Robot:
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
    _compare_versions()
    file = _opened(model, floating_base, mend_inertias)
    host, name = file.model, file.name
    _require_plant(host, name)
    substeps, period = _periods(host, control_period, timestep)
    given = copy.deepcopy(host)
    host.opt.disableflags |= flag("clampctrl")
    cleared = translate(host)
    missing = lacks(host)
    for lack in missing:
        lack.take_out(host)
    inputs, input_sources = input_limits(host)
    limits = overridden("torque", inputs, torque, slice(None))
    input_sources = input_sources if torque is None else ["argument"] * host.nu
    smooth = copy.deepcopy(host)
    smooth.opt.disableflags |= flag("constraint")
    smooth.actuator_forcelimited[:] = 0
    smooth.jnt_actfrclimited[:] = 0
    labels, units = coordinate_names(host)
    require_printable("model", name, *labels)
    states, sources = state_limits(host, position, velocity, file.velocities)
    q, act, origin = _home(host, home)
    start, plant = np.concatenate([q, np.zeros(host.nv), act]), Physics(host)
    idle, without, unlike = compared(given, plant, missing, inputs, start)
    _warn_of_differences(name, host, without, unlike)
    notes = {
        "cleared": [*cleared, *(f"{text}, without effect" for text in idle)],
        "left out": [*without, *unlike],
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
        plant=plant,
        predictor=Physics(smooth),
        anchor=_anchor(host, q),
        substeps=substeps,
        dt=period,
        name=name,
        state_names=labels,
        state_units=units,
        input_names=tuple(named(host, "actuator", "u")),
        input_units=tuple(input_unit(host, i) for i in range(host.nu)),
        notes=tuple((kind, text) for kind, texts in notes.items() for text in texts),
    )


class _File(NamedTuple):
    """A copy of the compiled model, its name, and of a URDF the velocity limits by joint, what was
    mended, and whether its root link is welded to the world."""

    model: "mujoco.MjModel"
    name: str
    velocities: dict[str, float]
    mended: tuple[str, ...]
    welded: bool


def _opened(
    model: "str | Path | mujoco.MjModel", floating_base: bool, mend_inertias: bool
) -> _File:
    """Return what `load_robot` is given, compiled. Raises ValueError for what cannot be read."""
    urdf = isinstance(model, str | Path) and _is_urdf(model)
    for argument, given in (("floating_base", floating_base), ("mend_inertias", mend_inertias)):
        if given and not urdf:
            fail(argument, "is for URDF files", "Write it into the MJCF file or the MjModel")
    if isinstance(model, mujoco.MjModel):
        return _File(copy.deepcopy(model), "robot", {}, (), False)
    if not isinstance(model, str | Path):
        fail("model", f"is a {type(model).__name__}", "Give a name, a path or a mujoco.MjModel")
    path = Path(model)
    if str(model) in MODELS:
        path = Path(str(resources.files("jaxmpc.robots"))) / "models" / f"{model}.xml"
    elif not path.is_file():
        fail("model", f"{str(model)!r} is no file", f"Give a path, or one of {', '.join(MODELS)}")
    try:
        if not urdf:
            return _File(mujoco.MjModel.from_xml_path(str(path)), path.stem, {}, (), False)
        options = {"floating_base": floating_base, "mend_inertias": mend_inertias}
        compiled = compiled_urdf(path.read_text(), **options)
        return _File(compiled.model, path.stem, *compiled[1:], welded=not floating_base)
    except (ValueError, ElementTree.ParseError) as error:
        text = " ".join(str(error).split())
        fail("model", f"{path} cannot be read: {text.rstrip('.')}", "Mend the file")


def _require_plant(host: "mujoco.MjModel", name: str) -> None:
    """Raise ValueError for a model that is no plant with inputs."""
    if host.nv == 0:
        fail("model", f"{name} has no joints", "A robot has something to move")
    if host.nu == 0:
        cure = "Add <actuator><motor joint=.../></actuator>; a URDF file gets motors"
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


def _warn_of_differences(
    name: str, host: "mujoco.MjModel", without: list[str], unlike: tuple[str, ...]
) -> None:
    """Warn where the plant moves otherwise than its file, or linear models otherwise than it."""
    texts = []
    if without:
        texts.append(f"moves without {'; '.join(without)} of its file, which MJX lacks")
    if unlike:
        texts.append(f"moves otherwise than its file says: {'; '.join(unlike)}")
    kinds = Counter(equalities(host))
    if kinds:
        coupled = ", ".join(f"{count} of type {kind}" for kind, count in kinds.items())
        texts.append(f"has couplings that its linear models lack ({coupled})")
    if texts:
        warnings.warn(f"robot {name} {', and '.join(texts)}", stacklevel=3)


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
    act, key = np.zeros(host.na), max(number_of(host, "key", "home"), 0)
    q, source = host.qpos0.copy(), "file, qpos0"
    if host.nkey:
        q, act = host.key_qpos[key].copy(), host.key_act[key].copy()
        source = f"file, key {names(host, 'key')[key] or key}"
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


def _anchor(host: "mujoco.MjModel", home: np.ndarray) -> tuple[float, ...]:
    """Return zeros, with the orientations of the configuration `home`."""
    anchor = np.zeros(host.nq)
    for kind, i in zip(host.jnt_type, host.jnt_qposadr, strict=True):
        if kind in (FREE, BALL):
            i = i + (3 if kind == FREE else 0)
            anchor[i : i + 4] = home[i : i + 4] / np.linalg.norm(home[i : i + 4])
    return tuple(anchor.tolist())


def model_hash(robot: Robot) -> str:
    """Return a hash of the compiled model, by which a resumed run notices a change."""
    return hashlib.sha256(model_bytes(robot.mujoco).tobytes()).hexdigest()
