"""What MJX lacks, taken out of a model: by itself where no motion changes, named where one does."""

import copy
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from jaxmpc.checks import fail
from jaxmpc.pytrees import record
from jaxmpc.robots.mujoco_access import acts, flag, mjx_module, mujoco, name_of, word

# Bits of MuJoCo's contype and conaffinity.
_BITS = 31


@record
class Lack:
    """What a model has and MJX has not. text: in words. take_out: removes it from a model, in
    place. acts: whether it is known to change motions, without trying."""

    text: str
    take_out: "Callable[[mujoco.MjModel], Any]"
    acts: bool = False


# Numbers of mjModel that MJX passes over in silence: the field, what it is in MJCF, whose it is,
# and whether it shows only in contact, where a trial of motions proves little.
_DROPPED = (
    ("dof_dampingpoly", "damping (higher powers)", "joint", False),
    ("jnt_stiffnesspoly", "stiffness (higher powers)", "joint", False),
    ("tendon_dampingpoly", "damping (higher powers)", "tendon", False),
    ("tendon_stiffnesspoly", "stiffness (higher powers)", "tendon", False),
    ("actuator_armature", "armature", "actuator", False),
    ("actuator_damping", "damping", "actuator", False),
    ("actuator_dampingpoly", "damping (higher powers)", "actuator", False),
    ("actuator_delay", "delay", "actuator", False),
    ("actuator_actearly", "actearly", "actuator", False),
    ("geom_fluid", "fluidshape", "geom", False),
    ("geom_adhesion", "adhesion", "geom", True),
    ("pair_adhesion", "adhesion", "pair", True),
    ("geom_surfacevel", "surfacevel", "geom", True),
)
# Fields that count plugins, -1 for none, which exert forces. MuJoCo does not run without them, but
# MJX does.
_PLUGINS = (("actuator_plugin", "actuator"), ("body_plugin", "body"))


def translate(model: "mujoco.MjModel") -> list[str]:
    """Write in MJX's words, in place, what it would refuse or misread, without a change of motion;
    return what was changed.

    Switched off: the account of the energy and the comparison of forward and inverse dynamics;
    sensors of types that MJX does not know become clocks (a sensor is read by nobody here).
    Newton's method solves the problem of contact forces of the PGS solver, too. MJX takes a switch
    of springs or of dampers as one of all passive forces, and knows no groups of actuators.

    Raises ValueError for actuators with several inputs.
    """
    mjx_module()
    from mujoco.mjx._src import types

    several = np.flatnonzero(getattr(model, "actuator_ctrlnum", np.ones(0)) != 1)
    if len(several):
        names = ", ".join(name_of(model, "actuator", i) for i in several)
        cure = "Put motors or position actuators, one input each, in their place"
        fail("model", f"has actuators with several inputs ({names}), which MJX lacks", cure)
    cleared, options = [], model.opt
    for switch in (mujoco.mjtEnableBit.mjENBL_ENERGY, mujoco.mjtEnableBit.mjENBL_FWDINV):
        if options.enableflags & switch:
            options.enableflags &= ~int(switch)
            cleared.append(f"switch {word(switch)}")
    strange = ~np.isin(model.sensor_type, [int(kind) for kind in types.SensorType])
    if np.any(strange):
        cleared.append(f"{np.sum(strange)} sensors of types unknown to MJX")
        model.sensor_type[strange] = int(mujoco.mjtSensor.mjSENS_CLOCK)
    if options.solver == mujoco.mjtSolver.mjSOL_PGS:
        options.solver = mujoco.mjtSolver.mjSOL_NEWTON
        cleared.append("solver PGS, Newton in its place (same problem)")
    both = flag("spring") | flag("damper")
    off = options.disableflags & both
    for switch, words, fields in (
        ("spring", "springs", ("jnt_stiffness", "tendon_stiffness")),
        ("damper", "dampers", ("dof_damping", "tendon_damping")),
    ):
        if off & flag(switch):
            for field in fields:
                getattr(model, field)[:] = 0
            cleared.append(f"{words}, switched off in the file")
    if off != both:
        options.disableflags &= ~both
    groups = np.clip(model.actuator_group, 0, 31)
    idle = (options.disableactuator >> groups & 1).astype(bool) & (model.actuator_group >= 0)
    if np.any(idle):
        model.actuator_gaintype[idle] = int(mujoco.mjtGain.mjGAIN_FIXED)
        model.actuator_biastype[idle] = int(mujoco.mjtBias.mjBIAS_NONE)
        model.actuator_gainprm[idle] = model.actuator_biasprm[idle] = 0
        names = ", ".join(name_of(model, "actuator", i) for i in np.flatnonzero(idle))
        cleared.append(f"forces of {names}, whose groups are switched off in the file")
    without = "" if acts(model, "contact") else _leave_out_contacts(model)
    if without:
        cleared.append(f"contacts of {without}, switched off in the file")
    return cleared


def lacks(model: "mujoco.MjModel") -> list[Lack]:
    """Return what of a model MJX cannot simulate although it changes motions.

    Contacts between shapes for which MJX has no function, friction without slip (noslip), and
    numbers that MJX passes over in silence.

    Raises ValueError where such shapes are in an explicit <pair>, or where the contacts that stay
    cannot be written as bits of contype and conaffinity.
    """
    mjx_module()
    found, contacts = list[Lack](), acts(model, "contact")
    if model.opt.noslip_iterations:
        text = f"{model.opt.noslip_iterations} noslip iterations of dry contacts"
        found.append(Lack(text, _without_noslip, True))
    without = _leave_out_contacts(copy.deepcopy(model)) if contacts else ""
    if without:
        found.append(Lack(f"contacts of {without}", _leave_out_contacts, True))
    if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
        found.append(Lack("sleep of bodies at rest", _awake, True))
    for field, words, kind, in_contact in _DROPPED:
        values = getattr(model, field, np.zeros(0))
        rows = np.flatnonzero([np.any(row != 0) for row in values])
        if in_contact and not contacts:
            continue
        if in_contact and kind == "geom":
            rows = rows[[_touches(model, i) for i in rows]]
        if len(rows):
            text = f"{words} of {_listed(model, kind, field, rows)}"
            found.append(Lack(text, partial(_zero, field=field), in_contact))
    for field, kind in _PLUGINS:
        rows = np.flatnonzero(getattr(model, field, np.full(0, -1)) >= 0)
        if len(rows):
            text = f"the plugin of {_listed(model, kind, field, rows)}"
            found.append(Lack(text, lambda model: None, True))
    return found


def _zero(model: "mujoco.MjModel", field: str) -> None:
    """Set an array of the model to zero."""
    getattr(model, field)[:] = 0


def _without_noslip(model: "mujoco.MjModel") -> None:
    model.opt.noslip_iterations = 0


def _awake(model: "mujoco.MjModel") -> None:
    model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)


def _touches(model: "mujoco.MjModel", geom: Any) -> bool:
    """Return whether a shape can come into contact, by its own bits or in a pair."""
    bits = model.geom_contype[geom] | model.geom_conaffinity[geom]
    return bool(bits) or geom in model.pair_geom1 or geom in model.pair_geom2


def _listed(model: "mujoco.MjModel", kind: str, field: str, rows: np.ndarray) -> str:
    """Return the names of rows of a field, such as "joint hip, joint knee"; the first five."""
    if field.startswith("dof_"):
        rows = np.unique(model.dof_jntid[rows])
    more = f" and {len(rows) - 5} more" if len(rows) > 5 else ""
    return ", ".join(name_of(model, kind, i) for i in rows[:5]) + more


def _leave_out_contacts(model: "mujoco.MjModel") -> str:
    """Switch off contacts between shapes that MJX cannot bring together; return them in words.

    Geoms of one kind (type, contype, conaffinity, margin or none) share one bit of contype, and
    their conaffinity has the bits of the kinds that they may touch: any symmetric relation between
    up to 31 kinds is written so, and MuJoCo's C engine reads the same one.
    """
    from mujoco.mjx._src import collision_driver

    rough = (int(mujoco.mjtGeom.mjGEOM_MESH), int(mujoco.mjtGeom.mjGEOM_HFIELD))

    def supported(first: int, second: int, margin: float) -> bool:
        types = sorted(int(model.geom_type[g]) for g in (first, second))
        if not collision_driver.has_collision_fn(*(mujoco.mjtGeom(t) for t in types)):
            return False
        return not (margin and set(types) & set(rough))

    missing: Counter[str] = Counter()
    for first, second, pair in collision_driver.geom_pairs(model):
        margins = model.geom_margin
        margin = margins[first] + margins[second] if pair < 0 else model.pair_margin[pair]
        if supported(first, second, margin):
            continue
        shapes = " with ".join(
            sorted(word(mujoco.mjtGeom(model.geom_type[g])) for g in (first, second))
        )
        if pair >= 0:
            problem = f"has a <pair> of contacts of {shapes}, which MJX does not have"
            fail("model", problem, "Take that pair out of the file")
        missing[shapes] += 1
    if not missing:
        return ""
    margined = model.geom_margin > 0
    kinds_of = (model.geom_type, model.geom_contype, model.geom_conaffinity, margined)
    features = np.stack(kinds_of, axis=1).astype(np.int64)
    touching = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
    kinds, of = np.unique(features[touching], axis=0, return_inverse=True)
    if len(kinds) > _BITS:
        count = f"{len(kinds)} kinds of shapes, more than {_BITS}"
        problem = f"has contacts that MJX lacks ({', '.join(missing)}), and {count}"
        fail("model", problem, "Switch those contacts off in the file")
    examples = [int(touching[np.argmax(of == k)]) for k in range(len(kinds))]
    allowed = np.zeros(len(kinds), np.int64)
    for i, a in enumerate(examples):
        for j, b in enumerate(examples):
            bits = kinds[i, 1] & kinds[j, 2] | kinds[j, 1] & kinds[i, 2]
            if bits and supported(a, b, model.geom_margin[a] + model.geom_margin[b]):
                allowed[i] |= 1 << j
    model.geom_contype[touching] = 1 << of
    model.geom_conaffinity[touching] = allowed[of]
    for name in ("contype", "conaffinity"):  # MuJoCo's first test asks the bodies
        of_bodies = getattr(model, f"body_{name}")
        of_bodies[:] = 0
        np.bitwise_or.at(of_bodies, model.geom_bodyid, getattr(model, f"geom_{name}"))
    return ", ".join(f"{shapes} ({count} pairs)" for shapes, count in missing.items())
