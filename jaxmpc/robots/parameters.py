"""Which numbers of a robot's model may differ from those of its file: see `Robot.vary`.

The rows of MJX's constraints and the forces that it computes at all are constants of a compiled
program, taken from the file: dry friction of a joint that has none in the file would be read and do
nothing. Programs for such numbers are those of another model (`acting_fields`).
"""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxmpc.checks import concrete, fail, nearest, require_finite, require_kind, require_shape
from jaxmpc.robots.mujoco_access import mujoco, number_of

if TYPE_CHECKING:
    from jaxmpc.robots.physics import Physics

# A point mass (kg) at the site "tool", beside the fields of mjx.Model.
PAYLOAD, TOOL = "payload", "tool"
# Fields of plants alone. The model that is planned with knows nothing of them: it has no contacts,
# stops, dry friction and limits of forces, and the functions of `tasks.py` have the file's sizes.
OF_PLANTS = (
    *("dof_frictionloss", "dof_solref", "dof_solimp"),
    *("tendon_frictionloss", "tendon_solref_fri", "tendon_solimp_fri"),
    *("jnt_range", "jnt_margin", "jnt_solref", "jnt_solimp", "jnt_actfrcrange"),
    *("tendon_range", "tendon_margin", "tendon_solref_lim", "tendon_solimp_lim"),
    *("geom_size", "geom_friction", "geom_margin", "geom_solmix", "geom_solref", "geom_solimp"),
    *("actuator_forcerange", "tendon_actfrcrange"),
)
# Fields that act as in MuJoCo's C engine.
FIELDS = (
    *("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_pos", "body_quat"),
    *("body_gravcomp", "body_invweight0", "dof_invweight0", "tendon_invweight0"),
    *("dof_damping", "dof_armature", "jnt_stiffness", "qpos_spring", "qpos0", "jnt_pos"),
    *("jnt_axis", "geom_pos", "geom_quat", "site_pos", "site_quat"),
    *("actuator_gear", "actuator_gainprm", "actuator_biasprm", "actuator_dynprm"),
    *("actuator_actrange", "tendon_stiffness", "tendon_damping", "tendon_lengthspring"),
    *("tendon_armature", "eq_data", "eq_solref", "eq_solimp"),
    *OF_PLANTS,
)
# Given in any length, they have length one.
DIRECTIONS = ("body_quat", "body_iquat", "geom_quat", "site_quat", "jnt_axis")
FRICTIONS = ("dof_frictionloss", "tendon_frictionloss")
INERTIAS = ("body_mass", "body_inertia", "dof_armature", "tendon_armature", PAYLOAD)
NONNEGATIVE = (*INERTIAS, *FRICTIONS)
# Fields for whose zeros in the file a program has no force.
ABSENT_AT_ZERO = (*FRICTIONS, "body_gravcomp")
# In place of zero: a row of dry friction whose bound is zero is an equality to MJX, and locks.
NO_FRICTION = 1e-30
# Fields from which `load_robot` makes limits of inputs, in place of limits of the plant's forces.
OF_LIMITS = ("actuator_gear", "actuator_gainprm", "actuator_forcerange", "jnt_actfrcrange")


def require_numbers(
    physics: "Physics", numbers: Mapping[str, Any], batch: tuple[int, ...] = ()
) -> None:
    """Raise ValueError unless a model can have these numbers, with the axes `batch` in front."""
    require_kind("numbers", numbers, Mapping, cure='Give {"body_mass": ..., ...}')
    for key, value in numbers.items():
        if key == PAYLOAD:
            require_tool(physics.model)
        elif key not in (*FIELDS, *physics.own):
            cure = f"{nearest(key, (*FIELDS, PAYLOAD))}Give {', '.join(FIELDS[:2])}, dof_damping, "
            fail(key, "is no number that varies", f"{cure}payload, … (see Robot.vary)")
        if key in OF_PLANTS and not physics.limited:
            what = "varies in plants alone: the model that is planned with has nothing of it"
            fail(key, what, "Give it to Robot.vary")
        shape = physics.own[key] if key in physics.own else np.shape(getattr(physics.mjx, key))
        meaning = "Mass in kg" if key == PAYLOAD else "As in robot.plant.mjx"
        require_shape(key, value, (*batch, *shape), meaning)
        require_finite(key, value)
        if not concrete(value):
            continue
        value = np.asarray(value)
        if key in NONNEGATIVE and np.any(value < 0):
            fail(key, f"holds {value.min():g}", "Give numbers of at least 0")
        if key == "body_inertia":
            _require_triangle(value)
        if key in DIRECTIONS and not np.all(np.any(value != 0, axis=-1)):
            fail(key, "holds a direction of length zero", "Give one of any other length")
        if "solimp" in key and np.any(value[..., 0] > value[..., 1]):
            fail(
                key,
                "has d_0 > d_width, which MJX reads otherwise than MuJoCo",
                "Give d_0 ≤ d_width",
            )


def _require_triangle(moments: np.ndarray) -> None:
    """Raise ValueError for principal moments (..., 3) of which one exceeds the sum of the others:
    no distribution of mass has them (∫ y² + z² ≤ ∫ x² + z² + ∫ x² + y²)."""
    largest, total = moments.max(axis=-1), moments.sum(axis=-1)
    wrong = largest > (total - largest) * (1 + 1e-5)  # of a flat body they are equal
    if np.any(wrong):
        what = f"holds {moments[wrong][0]}, of which one exceeds the sum of the others"
        fail("body_inertia", what, "Give the principal moments of a body, as MuJoCo takes them")


def require_tool(model: "mujoco.MjModel") -> None:
    """Raise ValueError for a model without the site "tool", which holds payloads."""
    if number_of(model, "site", TOOL) < 0:
        cure = 'Add <site name="tool"/> to the body that holds loads'
        fail(PAYLOAD, "the robot has no site named tool", cure)


def acting_fields(
    model: "mujoco.MjModel", limited: Mapping[str, np.ndarray], names: Iterable[str]
) -> dict[str, Any]:
    """Return the fields of a mujoco.MjModel to change so that numbers of these names act in
    programs for it: what the file leaves out becomes tiny. limited: as in `Physics`."""
    names, fields = set(names), dict[str, Any]()
    for name in names.intersection(ABSENT_AT_ZERO):
        value = getattr(model, name)
        if np.any(value == 0) and (name != "body_gravcomp" or not np.any(value)):
            fields[name] = np.maximum(value, NO_FRICTION)
    if "body_gravcomp" in fields:
        fields["flg_gravcomp"] = True
    if names.intersection(OF_LIMITS):
        fields |= {k: v for k, v in limited.items() if not np.array_equal(v, getattr(model, k))}
    return fields
