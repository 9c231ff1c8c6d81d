"""What MJX lacks, taken out of a model, and whether the plant then moves as its file says.

What MJX lacks is taken out by itself where no motion changes, and named where one does. What it
does not know it passes over in silence. So the steps of the plant are compared with those of
MuJoCo's C engine, along short motions of the file from home, from random states, and from where
half a second of falling leads. Each step starts from the engine's own state: differences do not
pile up, and forces with a memory (delays, filters) show.
"""

import contextlib
import copy
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import jax
import numpy as np

from jaxmpc.checks import fail
from jaxmpc.files import fingerprint
from jaxmpc.pytrees import record
from jaxmpc.qp.linalg import JAXLIB
from jaxmpc.robots.mujoco_access import (
    FREE,
    SLIDE,
    acts,
    flag,
    mjx_module,
    model_bytes,
    mujoco,
    name_of,
    single_joints,
    word,
)
from jaxmpc.robots.physics import Physics
from jaxmpc.sets.convex_sets import Box

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
# MJX does; those of actuators are refused.
_PLUGINS = (("body_plugin", "body"),)


def translate(model: "mujoco.MjModel") -> list[str]:
    """Write in MJX's words, in place, what it would refuse or misread, without a change of motion;
    return what was changed.

    Switched off: the account of the energy and the comparison of forward and inverse dynamics;
    sensors of types that MJX does not know become clocks (a sensor is read by nobody here).
    Newton's method solves the problem of contact forces of the PGS solver, too. MJX takes a switch
    of springs or of dampers as one of all passive forces, and knows no groups of actuators.

    Raises ValueError for what neither this nor a model without it can replace: `_require_known`.
    """
    mjx_module()
    from mujoco.mjx._src import types

    cleared, options = [], model.opt
    for switch in (mujoco.mjtEnableBit.mjENBL_ENERGY, mujoco.mjtEnableBit.mjENBL_FWDINV):
        if options.enableflags & switch:
            options.enableflags &= ~int(switch)
            cleared.append(f"switch {word(switch)}")
    _require_known(model)
    known = {int(kind) for kind in types.SensorType} - {int(mujoco.mjtSensor.mjSENS_CONTACT)}
    strange = ~np.isin(model.sensor_type, list(known))  # of contact sensors MJX knows some
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
        active = idle & (model.actuator_actadr >= 0)  # their activations stay what they are
        model.actuator_dyntype[active] = int(mujoco.mjtDyn.mjDYN_FILTER)
        model.actuator_dynprm[active, 0] = np.inf  # its time constant
        names = ", ".join(name_of(model, "actuator", i) for i in np.flatnonzero(idle))
        cleared.append(f"forces of {names}, whose groups are switched off in the file")
    without = "" if acts(model, "contact") else _leave_out_contacts(model)
    if without:
        cleared.append(f"contacts of {without}, switched off in the file")
    return cleared + _without_frictionless(model)


def _require_known(model: "mujoco.MjModel") -> None:
    """Raise ValueError, naming them, for actuators with several inputs, for types of actuators and
    equalities, integrators and switches that MJX does not know, and for deformable bodies."""
    from mujoco.mjx._src import types

    out = "Take that out of the file"
    replace = "Put motors or position actuators, one input each, in their place"

    def refuse(kind: str, rows: np.ndarray, what: str, cure: str) -> None:
        if len(rows):
            fail("model", f"has {_listed(model, kind, '', rows)}, {what}, which MJX lacks", cure)

    refuse("actuator", np.flatnonzero(model.actuator_plugin >= 0), "of a plugin", replace)
    inputs = getattr(model, "actuator_ctrlnum", np.ones(0))
    refuse("actuator", np.flatnonzero(inputs != 1), "with several inputs", replace)
    adheres = model.actuator_trntype == mujoco.mjtTrn.mjTRN_BODY
    refuse("actuator", np.flatnonzero(adheres), "of adhesion", out)
    for field, known, kinds in (
        ("actuator_trntype", types.TrnType, mujoco.mjtTrn),
        ("actuator_dyntype", types.DynType, mujoco.mjtDyn),
        ("actuator_gaintype", types.GainType, mujoco.mjtGain),
        ("actuator_biastype", types.BiasType, mujoco.mjtBias),
        ("eq_type", types.EqType, mujoco.mjtEq),
    ):
        given = getattr(model, field)
        rows = np.flatnonzero(~np.isin(given, [int(kind) for kind in known]))
        of_type = "".join(f"of the type {word(kinds(int(given[i])))}" for i in rows[:1])
        kind, cure = ("equality", out) if field == "eq_type" else ("actuator", replace)
        refuse(kind, rows, of_type, cure)
    refuse("flex", np.arange(model.nflex), "deformable", out)
    integrator = mujoco.mjtIntegrator(model.opt.integrator)
    if word(integrator) not in ("euler", "rk4", "implicitfast"):
        cure = 'Write integrator="implicitfast"'
        fail("model", f"has the integrator {word(integrator)}, which MJX lacks", cure)
    known = sum(types.EnableBit) | mujoco.mjtEnableBit.mjENBL_SLEEP  # of that see `lacks`
    for bit in range(mujoco.mjtEnableBit.mjNENABLE):
        if model.opt.enableflags & ~known & 1 << bit:
            switch = word(mujoco.mjtEnableBit(1 << bit))
            fail("model", f"has the flag {switch}, which MJX lacks", "Take that out of the file")


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
    if contacts and _frictionless(model):
        text = "elliptic friction cones beside contacts of condim 1: pyramidal ones"
        found.append(Lack(text, _with_pyramids, True))
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


# The least friction that MuJoCo knows (mjMINMU).
_LEAST_FRICTION = 1e-5


def _frictionless(model: "mujoco.MjModel") -> list[tuple[int, int, int]]:
    """Return the possible contacts (geom, geom, pair or −1) of one dimension beside elliptic cones,
    which MJX does not have together."""
    if model.opt.cone != mujoco.mjtCone.mjCONE_ELLIPTIC or not acts(model, "contact"):
        return []
    return [contact for contact in _possible_contacts(model) if _dimension(model, *contact) == 1]


def _possible_contacts(model: "mujoco.MjModel") -> list[tuple[int, int, int]]:
    mjx_module()
    from mujoco.mjx._src import collision_driver

    return [(int(a), int(b), int(pair)) for a, b, pair in collision_driver.geom_pairs(model)]


def mesh_contacts(model: "mujoco.MjModel") -> int:
    """Return how many pairs of meshes can touch."""
    if not acts(model, "contact"):
        return 0
    pairs = [contact[:2] for contact in _possible_contacts(model)]
    meshes = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
    return sum(bool(np.all(meshes[list(pair)])) for pair in pairs)


def _dimension(model: "mujoco.MjModel", first: int, second: int, pair: int) -> int:
    """Return condim of a contact, of an explicit pair its own."""
    if pair >= 0:
        return int(model.pair_dim[pair])
    return int(_of_two(model, model.geom_condim, first, second))


def _of_two(model: "mujoco.MjModel", values: np.ndarray, first: int, second: int) -> Any:
    """Return what a contact of two geoms has: that of higher priority, or the larger."""
    priority = model.geom_priority
    if priority[first] == priority[second]:
        return np.maximum(values[first], values[second])
    return values[first if priority[first] > priority[second] else second]


def _without_frictionless(model: "mujoco.MjModel") -> list[str]:
    """Write contacts without friction beside elliptic cones as MJX knows them; return what was
    changed.

    Where all contacts are such, both kinds of cones mean the same. Else those shapes get the least
    friction, where that of other contacts, the larger of two, stays what it is.
    """
    elliptic = model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    if elliptic and not (acts(model, "contact") and _possible_contacts(model)):
        _with_pyramids(model)  # MJX fails on elliptic cones without contacts
        return ["cone elliptic, pyramidal in its place (nothing can touch)"]
    found = _frictionless(model)
    if not found:
        return []
    if len(found) == len(_possible_contacts(model)):
        _with_pyramids(model)
        return ["cone elliptic, pyramidal in its place (all contacts have condim 1)"]
    changed = copy.deepcopy(model)
    shapes = {geom for first, second, pair in found if pair < 0 for geom in (first, second)}
    smooth = [geom for geom in shapes if model.geom_condim[geom] == 1]
    changed.geom_condim[smooth], changed.geom_friction[smooth] = 3, _LEAST_FRICTION
    pairs = [pair for *_, pair in found if pair >= 0]
    changed.pair_dim[pairs], changed.pair_friction[pairs] = 3, _LEAST_FRICTION
    for contact in _possible_contacts(model):
        if contact in found or contact[2] >= 0:
            continue
        before, after = (_of_two(m, m.geom_friction, *contact[:2]) for m in (model, changed))
        if not np.array_equal(before, after):
            return []
    for field in ("geom_condim", "geom_friction", "pair_dim", "pair_friction"):
        getattr(model, field)[:] = getattr(changed, field)
    return [f"condim 1 of {len(found)} contacts, 3 with a friction of 1e-5 in its place"]


def _with_pyramids(model: "mujoco.MjModel") -> None:
    model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL


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


# What counts as a difference, relative to the largest acceleration of the same dof: without and
# with rows of constraints, whose two solvers stop where further steps gain little.
SMOOTH, IN_CONTACT = 1e-6, 1e-3
# Rounding, relative to the largest acceleration of all dofs.
_ROUNDING = 1e-11
_STEPS, _STARTS = 10, 4
# Half a second, but no more steps than this.
_MOST_STEPS = 250

_known: dict[str, tuple[str, ...]] = {}


@record
class EngineSteps:
    """Steps of the C engine: states before and after (K, nq + nv + na), inputs (K, nu), and whether
    rows of constraints acted (K,)."""

    before: np.ndarray
    inputs: np.ndarray
    after: np.ndarray
    touched: np.ndarray


def compared(
    given: "mujoco.MjModel", plant: Physics, missing: list[Lack], inputs: Box, home: np.ndarray
) -> tuple[list[str], list[str], tuple[str, ...]]:
    """Compare the plant with its file.

    Arguments:
        given: the file, untouched.
        plant: what simulates it, without what MJX lacks.
        missing: what was taken out.
        inputs: the file's limits of inputs.
        home: the state (nq + nv + na,) from which motions start.

    Return in words which of `missing` change no motion of the file, which do, and where the plant
    moves otherwise than the file without them.
    """
    idle = _idle(given, missing, inputs, home)
    without = [lack.text for lack in missing if lack.text not in idle]
    reference = copy.deepcopy(given)
    for lack in missing:
        lack.take_out(reference)
    return idle, without, _differences(reference, plant, inputs, home)


def _idle(given: "mujoco.MjModel", found: list[Lack], inputs: Box, home: np.ndarray) -> list[str]:
    """Return the texts of the lacks without which motions of the file are the same."""
    trials = [lack for lack in found if not lack.acts]
    if not trials:
        return []
    whole = engine_steps(given, inputs, home).after
    idle = []
    for lack in trials:
        model = copy.deepcopy(given)
        lack.take_out(model)
        after = engine_steps(model, inputs, home).after
        if after.shape == whole.shape and np.allclose(after, whole, rtol=0, atol=1e-12):
            idle.append(lack.text)
    return idle


def _differences(
    reference: "mujoco.MjModel", plant: Physics, inputs: Box, home: np.ndarray
) -> tuple[str, ...]:
    """Return in words where steps of the plant are not those of `reference`. Computed once a
    process for equal models."""
    models = (model_bytes(reference), model_bytes(plant.model))
    key = fingerprint([], *models, home, inputs.bounds())
    if key not in _known:
        exact = copy.deepcopy(reference)
        exact.opt.solver = plant.model.opt.solver
        exact.opt.iterations = max(exact.opt.iterations, 100)
        exact.opt.ls_iterations = max(exact.opt.ls_iterations, 50)
        exact.opt.tolerance = min(exact.opt.tolerance, 1e-10)
        seen = engine_steps(exact, inputs, home)
        early = _stops_early(reference, engine_steps(reference, inputs, home), seen)
        unlike = _unlike(exact, plant, seen, bool(early)) if len(seen.before) else ()
        _known[key] = (*early, *unlike)
    return _known[key]


def _stops_early(model: "mujoco.MjModel", own: EngineSteps, seen: EngineSteps) -> tuple[str, ...]:
    """Return in words that the solver of a file stops before it has converged, where its own steps
    are not those `seen` of a solver that has; nothing else where they are."""
    count = min(len(own.before), len(seen.before))
    if not count:
        return ()
    same = np.all(np.abs(own.before[:count] - seen.before[:count]) <= 1e-9, axis=1)
    moved = [(v.after - v.before)[:count, model.nq :][same] for v in (own, seen)]
    off, size = np.abs(moved[0] - moved[1]), np.abs(moved[1]).max(axis=0, initial=0.0)
    if np.all(off <= IN_CONTACT * size + 1e-9 * size.max(initial=0.0)):
        return ()
    solver, most = word(mujoco.mjtSolver(model.opt.solver)), model.opt.iterations
    return (
        f"forces of contacts and limits, which the file's {solver} solver (iterations={most}) "
        "leaves before it has converged (raise iterations and ls_iterations)",
    )


def _unlike(
    model: "mujoco.MjModel", plant: Physics, seen: EngineSteps, explained: bool
) -> tuple[str, ...]:
    nq, h = model.nq, model.opt.timestep
    a, wanted = ((after - seen.before)[:, nq:] / h for after in (_steps(plant, seen), seen.after))
    off = np.abs(np.where(np.isfinite(a), a, np.inf) - wanted)
    worst: dict[str, tuple[float, str, int]] = {}
    for rows, tolerance in ((~seen.touched, SMOOTH), (seen.touched, IN_CONTACT)):
        if not np.any(rows):
            continue
        size = np.abs(wanted[rows]).max(axis=0)
        allowed = tolerance * size + _ROUNDING * (1 + size.max())
        for i in np.flatnonzero(np.any(off[rows] > allowed, axis=0)):
            k = int(np.flatnonzero(rows)[np.argmax(off[rows, i])])
            share, who = off[k, i] / allowed[i] * tolerance, _moved_by(model, i)
            if share > worst.get(who, (0,))[0]:
                text = f"{who} by {a[k, i]:.4g}, in MuJoCo by {wanted[k, i]:.4g} {_unit(model, i)}"
                worst[who] = share, text, k
    ranked = sorted(worst.values(), key=lambda entry: -entry[0])
    if not ranked:
        return ()
    sources = [] if explained else _sources(model, plant, seen, ranked[0][2])
    texts = [*sources, *(text for _, text, _ in ranked[:3])]
    return (*texts, f"{len(ranked) - 3} more") if len(ranked) > 3 else tuple(texts)


def _moved_by(model: "mujoco.MjModel", i: Any) -> str:
    """Return what entry i of (accelerations, rates of activations) belongs to."""
    if i < model.nv:
        return f"{name_of(model, 'joint', model.dof_jntid[i])} accelerates"
    first = model.actuator_actadr
    k = int(np.flatnonzero((first >= 0) & (first <= i - model.nv))[-1])
    return f"{name_of(model, 'actuator', k)} activates"


def _unit(model: "mujoco.MjModel", i: Any) -> str:
    if i >= model.nv:
        return "a second"
    j = model.dof_jntid[i]
    shift = model.jnt_type[j] == FREE and i - model.jnt_dofadr[j] < 3
    return "m/s²" if shift or model.jnt_type[j] == SLIDE else "rad/s²"


def _sources(model: "mujoco.MjModel", plant: Physics, seen: EngineSteps, k: int) -> list[str]:
    """Return the actuators, tendons and contacts that differ before step k."""
    data = mujoco.MjData(model)
    _set(model, data, seen.before[k], seen.inputs[k])
    mujoco.mj_forward(model, data)
    with jax.enable_x64(True):
        ours = jax.jit(plant.data)(seen.before[k], seen.inputs[k])
    texts = []
    for kind, quantity, mine, theirs in (
        ("actuator", "force", ours.actuator_force, data.actuator_force),
        ("tendon", "length", ours.ten_length, data.ten_length),
    ):
        wrong = np.flatnonzero(np.abs(np.asarray(mine) - theirs) > 1e-6 * np.abs(theirs) + 1e-12)
        texts += [
            f"{name_of(model, kind, i)} has the {quantity} {mine[i]:.4g}, in MuJoCo {theirs[i]:.4g}"
            for i in wrong[:3]
        ]
    if plant.rows and not texts:
        mine, theirs = _contacts(ours._impl.contact), _contacts(data.contact)
        unlike = [pair for pair in mine | theirs if not _alike(mine.get(pair), theirs.get(pair))]
        for pair in unlike[:3]:
            a, b = (name_of(model, "geom", geom) for geom in pair)
            texts.append(f"contacts of {a} with {b}, of which MJX finds other points or directions")
    if not texts and not model.opt.disableflags & flag("equality"):
        for i in np.flatnonzero(model.eq_active0 & (model.eq_type < 2))[:3]:  # connect, weld
            what = "pushes otherwise (MJX has no force for the turning of connect and weld)"
            texts.append(f"{name_of(model, 'equality', i)} {what}")
    return texts


def _contacts(found: Any) -> dict[tuple[int, int], np.ndarray]:
    """Return distances and frames of the contacts (count, 10) that exert forces, by geoms."""
    distance, geoms = np.asarray(found.dist), np.asarray(found.geom).reshape(-1, 2)
    near = distance < np.asarray(found.includemargin)
    rows = np.hstack([distance[:, None], np.asarray(found.frame).reshape(-1, 9)])[near]
    pairs = [(min(pair), max(pair)) for pair in geoms[near].tolist()]
    of_pair: dict[tuple[int, int], list] = {pair: [] for pair in pairs}
    for pair, row in zip(pairs, rows.tolist(), strict=True):
        of_pair[pair].append(row)
    return {pair: np.array(sorted(rows)) for pair, rows in of_pair.items()}


def _alike(a: np.ndarray | None, b: np.ndarray | None) -> bool:
    return a is not None and b is not None and a.shape == b.shape and np.allclose(a, b, atol=1e-6)


def _steps(plant: Physics, seen: EngineSteps) -> np.ndarray:
    """Return the states after the steps of the plant.

    Computed on a CPU where JAX has one, compiled in haste: it runs once.
    """
    options: dict[str, Any] = {"xla_backend_optimization_level": 0}
    options["xla_llvm_disable_expensive_passes"] = True
    if (0, 7, 0) <= JAXLIB < (0, 11, 1):
        options["xla_cpu_use_fusion_emitters"] = False
    device = None
    if jax.default_backend() != "cpu":
        try:
            device = jax.local_devices(backend="cpu")[0]
        except RuntimeError:  # JAX_PLATFORMS leaves it out
            options = {}
    run = jax.jit(lambda x, u: jax.lax.map(lambda pair: plant.bare_step(*pair), (x, u)))
    with jax.enable_x64(True), jax.default_device(device):
        compiled = run.lower(seen.before, seen.inputs).compile(compiler_options=options)
        return np.asarray(compiled(seen.before, seen.inputs))


@contextlib.contextmanager
def _unlogged() -> Iterator[None]:
    """Let MuJoCo write no file and no line where a motion blows up, which ends it here."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


@_unlogged()
def engine_steps(model: "mujoco.MjModel", inputs: Box, home: np.ndarray) -> EngineSteps:
    """Return steps of the C engine: the same states and inputs for models of the same sizes."""
    rng, data = np.random.default_rng(0), mujoco.MjData(model)
    lower, upper = inputs.bounds()
    low = np.maximum(lower, np.minimum(-1, upper - 2))
    high = np.minimum(upper, np.maximum(1, lower + 2))
    warning, steps = mujoco.mjtWarning, []
    blown = (warning.mjWARN_BADQPOS, warning.mjWARN_BADQVEL, warning.mjWARN_BADQACC)
    # Where feet only touch at home, rounding decides which: in each engine other ones.
    near, motion = home.copy(), np.random.default_rng(1).normal(scale=1e-6, size=model.nv)
    mujoco.mj_integratePos(model, near[: model.nq], motion, 1.0)
    for start in range(_STARTS + 1):
        mujoco.mj_resetData(model, data)
        x = near if start in (0, _STARTS) else _moved(model, home, rng)
        u = rng.uniform(low, high)
        _set(model, data, x, u)
        if start == _STARTS:
            for _ in range(min(round(0.5 / model.opt.timestep), _MOST_STEPS)):
                mujoco.mj_step(model, data)
        for _ in range(_STEPS):
            data.ctrl[:] = u = rng.uniform(low, high)
            x = _state(data)
            mujoco.mj_step(model, data)
            after = _state(data)
            bad = any(data.warning[int(kind)].number for kind in blown)
            if bad or not np.all(np.isfinite(after)):
                break
            steps.append((x, u, after, data.nefc > 0))
    columns = zip(*steps, strict=True) if steps else [()] * 4
    return EngineSteps(*(np.array(column) for column in columns))


def _moved(model: "mujoco.MjModel", home: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a random state near home, inside the ranges of joints and activations."""
    q = home[: model.nq].copy()
    mujoco.mj_integratePos(model, q, rng.normal(scale=0.3, size=model.nv), 1.0)
    for j in np.flatnonzero(model.jnt_limited & single_joints(model)):
        low, high = model.jnt_range[j]
        q[model.jnt_qposadr[j]] = rng.uniform(0.95 * low + 0.05 * high, 0.05 * low + 0.95 * high)
    act = rng.uniform(0.1, 0.9, size=model.na)
    for k in np.flatnonzero(model.actuator_actlimited & (model.actuator_actadr >= 0)):
        act[model.actuator_actadr[k]] = rng.uniform(*model.actuator_actrange[k])
    return np.concatenate([q, rng.normal(size=model.nv), act])


def _set(model: "mujoco.MjModel", data: "mujoco.MjData", x: np.ndarray, u: np.ndarray) -> None:
    data.qpos[:], data.qvel[:], data.act[:] = np.split(x, [model.nq, model.nq + model.nv])
    data.ctrl[:] = u


def _state(data: "mujoco.MjData") -> np.ndarray:
    return np.concatenate([data.qpos, data.qvel, data.act])
