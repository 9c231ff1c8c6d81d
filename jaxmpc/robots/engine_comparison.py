"""Whether the plant moves as its file says: steps of both beside each other.

MJX passes over in silence what it does not know. So the steps of the plant are compared with those
of MuJoCo's C engine, along short motions of the file from home, from random states, and from where
half a second of falling leads. Each step starts from the engine's own state: differences do not
pile up, and forces with a memory (delays, filters) show.
"""

import contextlib
import copy
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from jaxmpc.files import fingerprint
from jaxmpc.pytrees import record
from jaxmpc.qp.linalg import JAXLIB
from jaxmpc.robots.mjx_gaps import Lack
from jaxmpc.robots.mujoco_access import (
    FREE,
    SLIDE,
    flag,
    model_bytes,
    mujoco,
    name_of,
    single_joints,
)
from jaxmpc.robots.physics import Physics
from jaxmpc.sets.box import Box

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
        exact.opt.tolerance = min(exact.opt.tolerance, 1e-10)
        seen = engine_steps(exact, inputs, home)
        _known[key] = _unlike(exact, plant, seen) if len(seen.before) else ()
    return _known[key]


def _unlike(model: "mujoco.MjModel", plant: Physics, seen: EngineSteps) -> tuple[str, ...]:
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
    texts = [*_sources(model, plant, seen, ranked[0][2]), *(text for _, text, _ in ranked[:3])]
    return (*texts, f"{len(ranked) - 3} more") if len(ranked) > 3 else tuple(texts)


def _moved_by(model: "mujoco.MjModel", i: Any) -> str:
    """Return what entry i of (accelerations, rates of activations) belongs to."""
    if i < model.nv:
        return f"{name_of(model, 'joint', model.dof_jntid[i])} accelerates"
    k = int(np.flatnonzero(model.actuator_actadr <= i - model.nv)[-1])
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
    for start in range(_STARTS + 1):
        mujoco.mj_resetData(model, data)
        x = home if start in (0, _STARTS) else _moved(model, home, rng)
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
