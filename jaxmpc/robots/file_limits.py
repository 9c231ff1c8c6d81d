"""Names, units and limits of coordinates and inputs, as a model file gives them."""

import numpy as np

from jaxmpc.checks import fail
from jaxmpc.robots.mujoco_access import BALL, FREE, HINGE, SLIDE, mujoco, names, number_of
from jaxmpc.sets.box import Box
from jaxmpc.sets.limits import Limit, limit_pair


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
    """Return the unit of an actuator's input: force or torque of a joint's motor, else unknown."""
    if not _is_motor(host, i) or abs(host.actuator_gainprm[i, 0] * host.actuator_gear[i, 0]) != 1:
        return ""
    return "N" if host.jnt_type[host.actuator_trnid[i, 0]] == SLIDE else "N m"


def _is_motor(host: "mujoco.MjModel", i: int) -> bool:
    """Return whether an actuator puts a multiple of its input on one hinge or slide joint."""
    return (
        host.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
        and host.jnt_type[host.actuator_trnid[i, 0]] in (SLIDE, HINGE)
        and host.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
        and host.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_NONE
    )


def input_limits(host: "mujoco.MjModel") -> tuple[Box, list[str]]:
    """Return the box of inputs and the source of each, and drop in `host` the motors' force limits
    that it takes over."""
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
    limits = overridden("position", Box(lower, upper), position, slice(0, nv))
    limits = overridden("velocity", limits, velocity, rates)
    for given, part in ((position, slice(0, nv)), (velocity, rates)):
        sources[part] = sources[part] if given is None else ["argument"] * nv
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
        for ends, end in zip((lower, upper), limit_pair(argument, override), strict=True):
            if np.shape(end) not in ((), (size,)):
                fail(argument, f"{np.size(end)} entries where {size} are needed", "Or one number")
            ends[part] = end
    Box(lower[part], upper[part]).validate(argument)
    return Box(lower, upper)
