"""What MJX lacks, taken out of a model: by itself where no motion changes, named where one does."""

from collections import Counter
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxmpc.checks import fail
from jaxmpc.robots.physics import mjx_module

if TYPE_CHECKING:
    import mujoco

# Bits of MuJoCo's contype and conaffinity.
_BITS = 31


def make_supported(model: "mujoco.MjModel") -> tuple[list[str], list[str]]:
    """Take out of `model`, in place, what MJX lacks; return what changed no motion, and what did.

    No motion changes: the account of the energy and the comparison of forward and inverse dynamics
    (switches), sensors of types that MJX does not know, which become clocks (a sensor is read by
    nobody here), and the PGS solver, whose problem of contact forces Newton's method solves, too.
    Motions change: contacts between shapes for which MJX has no function, and friction without
    slip (noslip), which MJX passes over.

    Raises ValueError where such shapes are in an explicit <pair>, or where the contacts that stay
    cannot be written as bits of contype and conaffinity.
    """
    import mujoco

    mjx_module()
    from mujoco.mjx._src import types

    cleared, changed = [], []
    diagnostics = (mujoco.mjtEnableBit.mjENBL_ENERGY, mujoco.mjtEnableBit.mjENBL_FWDINV)
    for flag in diagnostics:
        if model.opt.enableflags & flag:
            model.opt.enableflags &= ~int(flag)
            cleared.append(f"switch {_name(flag)}")
    strange = ~np.isin(model.sensor_type, [int(kind) for kind in types.SensorType])
    if np.any(strange):
        cleared.append(f"{np.sum(strange)} sensors of types unknown to MJX")
        model.sensor_type[strange] = int(mujoco.mjtSensor.mjSENS_CLOCK)
    if model.opt.solver == mujoco.mjtSolver.mjSOL_PGS:
        model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
        cleared.append("solver PGS, Newton in its place (same problem)")
    if model.opt.noslip_iterations:
        changed.append(f"{model.opt.noslip_iterations} noslip iterations of dry contacts")
        model.opt.noslip_iterations = 0
    left_out = _leave_out_contacts(model)
    if left_out and not model.opt.disableflags & _NO_CONTACTS:
        changed.append(f"contacts of {left_out}")
    elif left_out:
        cleared.append(f"contacts of {left_out}, switched off in the file")
    return cleared, changed


# mjtDisableBit: all constraints, contacts.
_NO_CONTACTS = 1 | 16


def _name(member: Any) -> str:
    return member.name.split("_", 1)[1].lower()


def _leave_out_contacts(model: "mujoco.MjModel") -> str:
    """Switch off contacts between shapes that MJX cannot bring together; return them in words.

    Geoms of one kind (type, contype, conaffinity, margin or none) share one bit of contype, and
    their conaffinity has the bits of the kinds that they may touch: any symmetric relation between
    up to 31 kinds is written so, and MuJoCo's C engine reads the same one.
    """
    import mujoco
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
            sorted(_name(mujoco.mjtGeom(model.geom_type[g])) for g in (first, second))
        )
        if pair >= 0:
            fail("model", f"has a <pair> of contacts of {shapes}, which MJX does not have",
                 "Take that pair out of the file")  # fmt: skip
        missing[shapes] += 1
    if not missing:
        return ""
    features = np.stack([
        model.geom_type, model.geom_contype, model.geom_conaffinity, model.geom_margin > 0,
    ], axis=1).astype(np.int64)  # fmt: skip
    touching = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
    kinds, of = np.unique(features[touching], axis=0, return_inverse=True)
    if len(kinds) > _BITS:
        fail("model", f"has contacts that MJX lacks ({', '.join(missing)}), and {len(kinds)} kinds "
             f"of shapes, more than {_BITS}", "Switch those contacts off in the file")  # fmt: skip
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
