"""Random variations of a robot: masses, damping and the like that its controller does not know."""

import zlib
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from scipy.linalg import block_diag

from jaxmpc.checks import fail, nearest, require_kind, require_shape, whole
from jaxmpc.robots.couplings import Couplings
from jaxmpc.robots.description import host_coordinates
from jaxmpc.robots.linear_plant import LinearPlant
from jaxmpc.robots.mujoco_access import names, number_of
from jaxmpc.robots.parameters import require_tool
from jaxmpc.robots.robot import Robot

# Of each quantity, the field of MuJoCo's model that its factor multiplies and whose it is. The
# order decides the random numbers: add at the end.
QUANTITIES = {
    "mass": ("body_mass", "body"),
    "damping": ("dof_damping", "joint"),
    "payload": (None, None),
    "armature": ("dof_armature", "joint"),
    "friction": ("dof_frictionloss", "joint"),
    "gear": ("actuator_gear", "actuator"),
}


def randomised(
    robot: Robot, count: int, *, seed: int = 0, **ranges: tuple[float, float]
) -> dict[str, np.ndarray]:
    """Return the `variations` of `count` random robots for `simulate_many` and `tune_weights`.

    ranges: of uniform distributions, (least, most), by name:
        mass       factor of each body's mass and inertia
        damping, armature, friction   factor of each joint's damping, rotor inertia, dry friction
        gear       factor of each actuator's gear, hence of its force
        payload    kg, a point mass at the site "tool"
        "NAME mass", "NAME damping", ...   the same of one body, joint or actuator; it goes before
                   the range for all of them: `**{"mass": (0.9, 1.1), "link7 mass": (0.5, 2)}`

    Each number of each robot is drawn by itself. Robot i does not depend on `count`, and no
    quantity on which others vary. Raises ValueError for unknown names, ranges that make no sense,
    and factors of what is 0 in the file.
    """
    require_kind("robot", robot, Robot)
    for name, (quantity, places) in _named(robot, ranges).items():
        field = QUANTITIES[quantity][0]
        if field is not None:
            _require_there(robot, name, field, places)
    return plant_numbers(robot, draw_factors(robot, count, seed, ranges))


def draw_robots(
    robot: Robot,
    count: int,
    seed: int = 0,
    *,
    spread: float = 0.5,
    mass: float = 0.0,
    damping: float = 0.0,
    payload: float = 0.0,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Draw starts (count, nq + nv) and the factors by which each plant differs from the model.

    spread: largest fraction of the way from home to the limits; the states nearest to such random
    ones that keep the couplings of the file. mass, damping: factors are from
    1 − this to 1 + this; payload: masses in kg are from 0 to this. The dictionary has those that
    are not zero: "mass" (count, bodies), "damping" (count, nv), "payload" (count,).
    """
    require_kind("robot", robot, Robot)
    whole("seed", seed, 0)
    starts = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(0,)))
    home, below, above = start_room(robot)
    aside = spread * starts.uniform(-1, 1, (count, robot.n))
    with jax.enable_x64(True):
        x0s = np.asarray(jax.vmap(robot.state)(home + np.where(aside > 0, above, below) * aside))
    x0s = Couplings(robot.predictor.model).kept(x0s)
    ranges = {"mass": (1 - mass, 1 + mass), "damping": (1 - damping, 1 + damping)}
    ranges = {name: range_ for name, range_ in ranges.items() if range_[1] > 1}
    if payload:
        ranges["payload"] = (0, payload)
    return x0s, draw_factors(robot, count, seed, ranges)


def draw_factors(
    robot: Robot, count: int, seed: int, ranges: Mapping[str, tuple[float, float]]
) -> dict[str, np.ndarray]:
    """Return the random factors of `randomised`, by quantity: "mass" (count, bodies), "damping"
    (count, nv), "gear" (count, m), ..., and the payloads (count,) in kg."""
    whole("count", count, 1)
    whole("seed", seed, 0)
    found: dict[str, np.ndarray] = {}
    named = _named(robot, ranges)
    for name in sorted(named, key=lambda name: " " in name):  # those of one body after all bodies
        quantity, places = named[name]
        # Streams of their own, so that no draw depends on which others there are.
        stream: tuple[int, ...] = (list(QUANTITIES).index(quantity) + 1,)
        if name != quantity:
            stream += (zlib.crc32(name.encode()),)
        random = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=stream))
        least, most = ranges[name]
        if quantity == "payload":
            found[quantity] = random.uniform(least, most, count)
            continue
        size = len(getattr(robot.mujoco, str(QUANTITIES[quantity][0])))
        factors = found.setdefault(quantity, np.ones((count, size)))
        factors[:, places] = random.uniform(least, most, (count, len(places)))
    return found


def plant_numbers(robot: Robot, factors: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the arguments of `Robot.vary`, with the number of robots in front, for factors of
    `draw_factors`."""
    found = {}
    for quantity, factor in factors.items():
        field = QUANTITIES[quantity][0]
        if field is None:
            found[quantity] = factor
            continue
        value = _number(robot, field)
        if np.shape(factor)[1:] != (len(value),):
            cure = f"Give (B, {len(value)}), one for each entry of {field}, for B robots"
            fail(f"factors[{quantity!r}]", f"shape {np.shape(factor)}", cure)
        _require_there(robot, quantity, field, np.arange(len(value)))
        found[field] = factor.reshape(*factor.shape, *(1,) * (value.ndim - 1)) * value
        if quantity == "mass":
            found["body_inertia"] = factor[..., None] * _number(robot, "body_inertia")
    return found


def _number(robot: Robot, field: str) -> np.ndarray:
    """Return a number of the plant: of the file, unless it was varied."""
    return np.asarray(robot.numbers.get(field, getattr(robot.mujoco, field)))


def _require_there(robot: Robot, name: str, field: str, places: np.ndarray) -> None:
    """Raise ValueError for a factor of numbers that are all zero."""
    if not np.any(_number(robot, field)[places]):
        cure = f"Set {field} in the file, or leave it out"
        fail(name, f"is a factor of {field}, which is 0 in {robot.name}", cure)


def _named(robot: Robot, ranges: Mapping[str, Any]) -> dict[str, tuple[str, np.ndarray]]:
    """Return the quantity and the entries of its field that each name means."""
    found = {}
    for name, range_ in ranges.items():
        require_shape(name, range_, (2,), "Give (least, most)")
        least, most = (float(v) for v in np.asarray(range_))
        *owner, quantity = name.rsplit(" ", 1)
        if quantity not in QUANTITIES or (owner and quantity == "payload"):
            cure = f"{nearest(quantity, QUANTITIES)}Give {', '.join(QUANTITIES)}, or NAME mass, ..."
            fail(name, "is no quantity that varies", cure)
        if not 0 <= least <= most < np.inf or (least == 0 and quantity in ("mass", "gear")):
            cure = f"Give 0 {'<' if quantity in ('mass', 'gear') else '≤'} least ≤ most"
            fail(name, f"({least:g}, {most:g})", cure)
        field, kind = QUANTITIES[quantity]
        size = 0 if field is None else len(getattr(robot.mujoco, field))
        places = np.arange(size)
        if quantity == "payload":
            require_tool(robot.mujoco)
        if owner:
            places = _places(robot, name, owner[0], str(kind))
        found[name] = quantity, places
    return found


def _places(robot: Robot, argument: str, name: str, kind: str) -> np.ndarray:
    """Return where the numbers of one body, joint or actuator are in their fields."""
    number = number_of(robot.mujoco, kind, name)
    if number < 0:
        known = [found for found in names(robot.mujoco, kind) if found not in ("", "world")]
        cure = f"{nearest(name, known)}It has {', '.join(known) or 'none with a name'}"
        fail(argument, f"{robot.name} has no {kind} named {name!r}", cure)
    if kind != "joint":
        return np.array([number])
    return np.flatnonzero(robot.mujoco.dof_jntid == number)


def start_room(robot: Robot | LinearPlant) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the coordinates (n,) of home, moved inside the limits where it is not, and how far
    these are below and above it, 1 where there are none."""
    lower, upper = robot.state_limits.bounds()
    home = np.clip(host_coordinates(robot, robot.home), lower, upper)
    below, above = (np.where(np.isfinite(end), np.abs(end - home), 1.0) for end in (lower, upper))
    return home, below, above


def free_motions(robot: Robot | LinearPlant) -> np.ndarray | None:
    """Return the projector (n, n) of coordinates onto those that keep couplings at home to first
    order; None where there are none."""
    if isinstance(robot, LinearPlant):
        return None
    couplings, nv = Couplings(robot.predictor.model), robot.mujoco.nv
    if not couplings.there:
        return None
    motions = couplings.motions(np.asarray(robot.home[: robot.mujoco.nq], float))
    return np.asarray(block_diag(motions, motions, np.eye(robot.n - 2 * nv)))
