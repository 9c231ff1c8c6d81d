"""MuJoCo and MJX, imported where they are first used, and what a mujoco.MjModel calls its parts."""

import contextlib
import importlib
import io
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import mujoco as mujoco
else:

    class _FirstUse:
        """The module mujoco, imported when something of it is needed: it is an extra."""

        def __getattr__(self, name: str) -> Any:
            return getattr(importlib.import_module("mujoco"), name)

    mujoco = _FirstUse()

# mjtJoint. Joints of one dof are the last two.
FREE, BALL, SLIDE, HINGE = range(4)

# The number of objects of a kind, as a field of the model, where it is not n and the kind.
_COUNTS = {"joint": "njnt", "actuator": "nu", "camera": "ncam", "equality": "neq"}


def mjx_module() -> Any:
    """Import mujoco.mjx without its message on stdout that Warp is not installed, and return it."""
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    return mjx


def names(model: "mujoco.MjModel", kind: str) -> list[str]:
    """Return the names of the bodies, joints, ... of a model, "" where there is none."""
    count, of = getattr(model, _COUNTS.get(kind, f"n{kind}")), _type_of(kind)
    return [mujoco.mj_id2name(model, of, i) or "" for i in range(count)]


def number_of(model: "mujoco.MjModel", kind: str, name: str) -> int:
    """Return the number of the body, joint, ... of this name, −1 where there is none."""
    return mujoco.mj_name2id(model, _type_of(kind), name)


def name_of(model: "mujoco.MjModel", kind: str, i: Any) -> str:
    """Return "joint hip", or "joint of id 2", as MuJoCo counts, where it has no name."""
    return f"{kind} {mujoco.mj_id2name(model, _type_of(kind), int(i)) or f'of id {int(i)}'}"


def _type_of(kind: str) -> Any:
    return getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}")


def word(member: Any) -> str:
    """Return a member of MuJoCo's enumerations as a word: mjJNT_HINGE is "hinge"."""
    return member.name.split("_", 1)[1].lower()


def flag(kind: str) -> int:
    """Return the bit of mjtDisableBit for "contact", "limit", "equality", "frictionloss", ..."""
    return int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{kind.upper()}"))


def acts(model: "mujoco.MjModel", kind: str) -> bool:
    """Return whether constraints of a kind, see `flag`, are switched on."""
    return not model.opt.disableflags & (flag(kind) | flag("constraint"))


def equalities(model: "mujoco.MjModel") -> list[str]:
    """Return the type of each equality that acts: "joint", "weld", ..."""
    acting = model.eq_type[model.eq_active0.astype(bool)] if acts(model, "equality") else ()
    return [word(mujoco.mjtEq(int(kind))) for kind in acting]


def muscular(model: "mujoco.MjModel") -> np.ndarray:
    """Return which actuators (nu,) have the activation of muscles."""
    return model.actuator_dyntype == mujoco.mjtDyn.mjDYN_MUSCLE


def single_joints(model: "mujoco.MjModel") -> np.ndarray:
    """Return which joints (njnt,) have one dof: slides and hinges."""
    return np.isin(model.jnt_type, (SLIDE, HINGE))


def moment_arms(model: "mujoco.MjModel", data: "mujoco.MjData") -> np.ndarray:
    """Return the moments (nu, nv) of the actuators at the position in `data`."""
    moment, d = np.zeros((model.nu, model.nv)), data
    parts = d.actuator_moment, d.moment_rownnz, d.moment_rowadr, d.moment_colind
    mujoco.mju_sparse2dense(moment, *parts)
    return moment


def model_bytes(model: "mujoco.MjModel") -> np.ndarray:
    """Return the model as MuJoCo stores it."""
    buffer = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer
