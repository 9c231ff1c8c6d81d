"""URDF files: read for their inertias, joints and limits; a free base and mended inertias on
request."""

import xml.etree.ElementTree as ElementTree
from typing import NamedTuple

import numpy as np

from jaxmpc.checks import fail
from jaxmpc.robots.mujoco_access import mujoco

# A mended inertia keeps a + b ≥ c with this much room, relative to c: rounding in MuJoCo's own
# eigenvalues must not refuse it again.
_ROOM = 1e-9
# Mass of a moving link that has none, of the robot's: a ball of water of that mass.
_SHARE = 1e-4
_WATER = 1000.0
# Entries of an inertia in a URDF, those of the upper triangle row by row.
_AXES = ("xx", "xy", "xz", "yy", "yz", "zz")


class CompiledURDF(NamedTuple):
    """The compiled model of a URDF, the velocity limit of each joint, and what was mended."""

    model: "mujoco.MjModel"
    velocities: dict[str, float]
    mended: tuple[str, ...]


def compiled_urdf(text: str, *, floating_base: bool, mend_inertias: bool) -> CompiledURDF:
    """Return a URDF, compiled.

    Visual and collision geometry is left out, so that no mesh is looked for. Each hinge and slide
    joint gets a motor, as a URDF cannot have any.
    """
    root = ElementTree.fromstring(text)
    for link in root.iter("link"):
        for kind in ("visual", "collision"):
            for element in link.findall(kind):
                link.remove(element)
        inertial = link.find("inertial")
        # A frame: MuJoCo refuses it, and it weighs nothing.
        if inertial is not None and _mass(link) == 0 and not np.any(_inertia(inertial)):
            link.remove(inertial)
    if floating_base:
        _free(root)
    changes = _mended(root) if mend_inertias else ()  # the freed root link counts as moving
    limits = ((joint.get("name"), joint.find("limit")) for joint in root.iter("joint"))
    velocities = {
        str(name): float(limit.get("velocity", "inf")) or np.inf
        for name, limit in limits
        if limit is not None
    }
    try:
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
        _add_motors(spec)
        return CompiledURDF(spec.compile(), velocities, changes)
    except ValueError as error:
        if "inertia" in str(error) and not mend_inertias:
            problem = " ".join(str(error).split())
            cure = "Mend the file, or load it with mend_inertias=True"
            fail("model", f"has an inertia that no body can have: {problem}", cure)
        raise


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
            continue  # a point mass, which MuJoCo takes
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


def _add_motors(spec: "mujoco.MjSpec") -> None:
    """Add a motor to each hinge and slide joint."""
    single = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    for joint in spec.joints:
        if joint.type in single:
            motor = spec.add_actuator(name=f"{joint.name} torque", target=joint.name)
            motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
            motor.set_to_motor()
