"""What is known of a robot: its two models, limits, names, sizes and coordinates; and a report."""

from collections import Counter
from dataclasses import field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import as_floats, host_array
from jaxmpc.checks import fail, require_finite, require_shape
from jaxmpc.pytrees import record, static
from jaxmpc.qp.linalg import floating_dtype
from jaxmpc.robots.configurations import difference, quaternions, retract, unit_orientations
from jaxmpc.robots.mujoco_access import acts, mjx_module, mujoco, single_joints, word
from jaxmpc.robots.physics import Physics
from jaxmpc.sets.convex_sets import Box


@record
class RobotReport:
    """An account of a loaded robot; `print(robot.report())` shows it as a table.

    read: what the file gave. limits: (coordinate or input, unit, lower, upper, source) for each of
    the n coordinates and m inputs, ±inf where there is none. predictor_ignores: what acts in the
    plant but not in linear models, equilibria and inverse dynamics. left_out: what the file has and
    the plant has not, because MJX lacks it: motions differ from those of the file. cleared: what
    was left out without a change of motion. mended: inertias changed on request.
    """

    name: str
    read: tuple[str, ...]
    limits: tuple[tuple[str, str, float, float, str], ...]
    predictor_ignores: tuple[str, ...]
    left_out: tuple[str, ...]
    cleared: tuple[str, ...]
    mended: tuple[str, ...]

    def __str__(self) -> str:
        lines = [f"robot {self.name}"]
        accounts = {
            "read": self.read,
            "the predictor ignores": self.predictor_ignores,
            "left out of the plant": self.left_out,
            "cleared": self.cleared,
            "mended": self.mended,
        }
        for title, items in accounts.items():
            lines += [f"{title}:", *(f"  {item}" for item in items or ("nothing",))]
        width = max(len(name) for name, *_ in self.limits)
        lines.append(f"{'limits':{width + 2}}{'unit':>8}{'lower':>11}{'upper':>11}  source")
        lines += [
            f"  {name:{width}}{unit:>8}{lower:>11.4g}{upper:>11.4g}  {source}"
            for name, unit, lower, upper, source in self.limits
        ]
        return "\n".join(lines)

    __repr__ = __str__


@record
class RobotDescription:
    """The fields of a `Robot`, which says what they mean."""

    state_limits: Box
    input_limits: Box
    home: Any
    plant: Physics = static()
    predictor: Physics = static()
    anchor: tuple[float, ...] = static()
    substeps: int = static()
    dt: float = static()
    name: str = static(default="")
    state_names: tuple[str, ...] = static(default=())
    state_units: tuple[str, ...] = static(default=())
    input_names: tuple[str, ...] = static(default=())
    input_units: tuple[str, ...] = static(default=())
    numbers: dict[str, Any] = field(default_factory=dict)
    notes: tuple[tuple[str, str], ...] = static(default=())
    file: Any = static(default=None)
    shapes: Any = static(default=None)

    @property
    def time_unit(self) -> str:
        """Return the unit of `dt`: MuJoCo's models are in seconds."""
        return "s"

    @property
    def mujoco(self) -> "mujoco.MjModel":
        """Return the plant as MuJoCo's own model, for rendering and the C engine."""
        return self.plant.model

    def __repr__(self) -> str:
        """Return the name and the sizes, in one line; `report` has the rest."""
        return f"Robot({self.name!r}, n={self.n}, m={self.m}, dt={self.dt:g} s)"

    @property
    def n(self) -> int:
        """Return the number of coordinates ξ, 2 nv + na."""
        return 2 * self.mujoco.nv + self.mujoco.na

    @property
    def m(self) -> int:
        """Return the number of inputs."""
        return self.mujoco.nu

    @property
    def joints(self) -> tuple[int, ...]:
        """Return the mjtJoint of each joint."""
        return self.plant.joints

    @property
    def state_size(self) -> int:
        """Return the length of the state x, nq + nv + na."""
        return self.mujoco.nq + self.mujoco.nv + self.mujoco.na

    def coordinates(self, x: Any) -> Array:
        """Return ξ (n,) of a state x (nq + nv + na,)."""
        x = jnp.asarray(as_floats(x))
        require_shape("x", x, (self.state_size,), "Give (qpos, qvel, act) of one robot")
        if not quaternions(self.joints):
            return x
        nq = self.mujoco.nq
        anchor = jnp.asarray(self.anchor, x.dtype)
        return jnp.concatenate([difference(self.joints, anchor, x[:nq]), x[nq:]])

    def state(self, coordinates: Any) -> Array:
        """Return x (nq + nv + na,) with the coordinates ξ (n,)."""
        xi = jnp.asarray(as_floats(coordinates))
        require_shape("coordinates", xi, (self.n,), "Two numbers a dof; use jax.vmap for many")
        if not quaternions(self.joints):
            return xi
        nv = self.mujoco.nv
        anchor = jnp.asarray(self.anchor, xi.dtype)
        return jnp.concatenate([retract(self.joints, anchor, xi[:nv]), xi[nv:]])

    def checked_arrays(self, x: Any, u: Any) -> tuple[Array, Array]:
        """Return a state and an input as arrays of one dtype; raise ValueError for wrong shapes."""
        size = self.state_size
        problem = "Give (qpos, qvel, act) of one robot; use jax.vmap for many"
        if np.shape(x) == (self.n,) != (size,):
            problem = "That is the size of the coordinates: robot.state(ξ) makes a state of them"
        require_shape("x", x, (size,), problem)
        require_shape("u", u, (self.m,), "One number for each actuator")
        dtype = floating_dtype((x, u))
        return jnp.asarray(x, dtype), jnp.asarray(u, dtype)

    def report(self) -> RobotReport:
        """Return an account of what was read, what is ignored, and where limits come from."""
        notes = lambda key: tuple(text for name, text in self.notes if name == key)
        ends = (self.state_limits.bounds(), self.input_limits.bounds())
        lower, upper = (np.concatenate(end).tolist() for end in zip(*ends, strict=True))
        names = (*self.state_names, *self.input_names)
        units = (*self.state_units, *self.input_units)
        sources = notes("limit") or ("",) * len(names)
        home = tuple(f"home: {text}" for text in notes("home"))
        return RobotReport(
            name=self.name,
            read=_read(self, (*home, *notes("welded"))),
            limits=tuple(zip(names, units, lower, upper, sources, strict=True)),
            predictor_ignores=_ignored(self.mujoco),
            left_out=notes("left out"),
            cleared=notes("cleared"),
            mended=notes("mended"),
        )

    def configurations(self, argument: str, q: Any) -> np.ndarray:
        """Return q (..., nq) in float64 with unit quaternions; raise ValueError for wrong ones."""
        q = host_array(argument, q)
        if q.shape[-1:] != (self.mujoco.nq,):
            fail(argument, f"shape {q.shape}", f"Give (..., {self.mujoco.nq}), as in qpos")
        require_finite(argument, q)
        return unit_orientations(argument, self.joints, q)


def host_coordinates(plant: Any, states: Any) -> np.ndarray:
    """Return the coordinates (..., n) of states (..., nq + nv + na) of a Robot or LinearPlant, in
    float64 NumPy arrays, also inside jit, where these states are known."""
    states = np.asarray(states, float)
    if plant.n == plant.state_size:  # no orientation: the same numbers
        return states
    with jax.enable_x64(True), jax.core.eval_context():
        flat = jax.vmap(plant.coordinates)(states.reshape(-1, states.shape[-1]))
    return np.asarray(flat).reshape(*states.shape[:-1], plant.n)


def _read(robot: RobotDescription, more: tuple[str, ...]) -> tuple[str, ...]:
    """Return what the file gave, and `more`."""
    model, options = robot.mujoco, robot.mujoco.opt
    kinds = Counter(word(mujoco.mjtJoint(int(j))) for j in model.jnt_type)
    joints = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
    integrator, solver = mujoco.mjtIntegrator(options.integrator), mujoco.mjtSolver(options.solver)
    lines = [
        f"{model.nbody - 1} bodies of {model.body_mass.sum():.4g} kg; joints: {joints}; "
        f"{model.nv} degrees of freedom",
        f"{model.nu} actuators; {model.ngeom} shapes, {model.ntendon} tendons",
        f"integrator {word(integrator)}, step {options.timestep:g} s, {robot.substeps} in a "
        f"control period of {robot.dt:g} s",
        f"solver {word(solver)}, {options.iterations} iterations",
        *more,
    ]
    feet = getattr(robot.predictor, "feet", None)
    if feet is not None:
        lines.append(f"feet that stand in linear models: {', '.join(feet.names)}")
    if model.na:
        lines.append(f"{model.na} activation states, behind the velocities in the state")
    if model.nmocap:
        lines.append(f"{model.nmocap} mocap bodies, which stay where they are")
    return tuple(lines)


def _ignored(model: "mujoco.MjModel") -> tuple[str, ...]:
    """Return what acts in the plant and not in the predictor."""
    mjx_module()
    from mujoco.mjx._src import collision_driver

    counts: Counter[str] = Counter()
    if acts(model, "contact"):
        counts["pairs of shapes in contact"] = sum(1 for _ in collision_driver.geom_pairs(model))
    if acts(model, "frictionloss"):
        counts["joints with dry friction"] = np.sum(model.dof_frictionloss > 0)
        counts["tendons with dry friction"] = np.sum(model.tendon_frictionloss > 0)
    if acts(model, "limit"):
        single, limited = single_joints(model), model.jnt_limited
        counts["stops of joints, whose ranges are limits of the MPC"] = np.sum(limited[single])
        counts["stops of ball joints, no limits of the MPC"] = np.sum(limited[~single])
        counts["stops of tendons, no limits of the MPC"] = np.sum(model.tendon_limited)
    limited = (model.actuator_forcelimited, model.jnt_actfrclimited, model.tendon_actfrclimited)
    counts["limits of forces, which are rows of the MPC"] = sum(map(np.sum, limited))
    return tuple(f"{count} {text}" for text, count in counts.items() if count)
