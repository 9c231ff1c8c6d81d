"""What was read from a robot's file, where its limits come from, and what is ignored."""

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jaxmpc.robots.physics import mjx_module

if TYPE_CHECKING:
    from jaxmpc.robots.robot import Robot


@dataclass(frozen=True)
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
        for title, items in (
            ("read", self.read), ("the predictor ignores", self.predictor_ignores),
            ("left out of the plant", self.left_out), ("cleared", self.cleared),
            ("mended", self.mended),
        ):  # fmt: skip
            lines += [f"{title}:", *(f"  {item}" for item in items or ("nothing",))]
        width = max(len(name) for name, *_ in self.limits)
        lines.append(f"{'limits':{width + 2}}{'unit':>8}{'lower':>11}{'upper':>11}  source")
        lines += [
            f"  {name:{width}}{unit:>8}{lower:>11.4g}{upper:>11.4g}  {source}"
            for name, unit, lower, upper, source in self.limits
        ]
        return "\n".join(lines)


def report_of(robot: "Robot") -> RobotReport:
    """Return the account of a robot."""
    notes = lambda key: tuple(text for name, text in robot.notes if name == key)
    states, inputs = robot.state_limits, robot.input_limits
    lower, upper = (
        np.append(np.asarray(a), np.asarray(b)).tolist()
        for a, b in ((states.lower, inputs.lower), (states.upper, inputs.upper))
    )
    names = (*robot.state_names, *robot.input_names)
    units = (*robot.state_units, *robot.input_units)
    sources = notes("limit") or ("",) * len(names)
    return RobotReport(
        robot.name, _read(robot, tuple(f"home: {v}" for v in notes("home")) + notes("welded")),
        tuple(zip(names, units, lower, upper, sources, strict=True)), _ignored(robot),
        notes("left out"), notes("cleared"), notes("mended"),
    )  # fmt: skip


def _read(robot: "Robot", more: tuple[str, ...]) -> tuple[str, ...]:
    """Return what the file gave, and `more`."""
    import mujoco

    model = robot.mujoco
    kinds = Counter(mujoco.mjtJoint(int(j)).name[6:].lower() for j in model.jnt_type)
    joints = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
    lines = [
        f"{model.nbody - 1} bodies of {model.body_mass.sum():.4g} kg; joints: {joints}; "
        f"{model.nv} degrees of freedom",
        f"{model.nu} actuators; {model.ngeom} shapes, {model.ntendon} tendons",
        f"integrator {mujoco.mjtIntegrator(model.opt.integrator).name[6:].lower()}, step "
        f"{model.opt.timestep:g} s, {robot.substeps} in a control period of {robot.dt:g} s",
        f"solver {mujoco.mjtSolver(model.opt.solver).name[6:].lower()}, "
        f"{model.opt.iterations} iterations",
        *more,
    ]
    if model.na:
        lines.append(f"{model.na} activation states, behind the velocities in the state")
    if model.nmocap:
        lines.append(f"{model.nmocap} mocap bodies, which stay where they are")
    return tuple(lines)


def _ignored(robot: "Robot") -> tuple[str, ...]:
    """Return what acts in the plant and not in the predictor."""
    import mujoco

    mjx_module()
    from mujoco.mjx._src import collision_driver

    model, bit = robot.mujoco, mujoco.mjtDisableBit
    counts: dict[str, int] = {}

    def acts(flag: "mujoco.mjtDisableBit") -> bool:
        return not model.opt.disableflags & (int(flag) | int(bit.mjDSBL_CONSTRAINT))

    if acts(bit.mjDSBL_CONTACT):
        counts["pairs of shapes in contact"] = sum(1 for _ in collision_driver.geom_pairs(model))
    if acts(bit.mjDSBL_EQUALITY):
        for kind in model.eq_type[model.eq_active0.astype(bool)]:
            name = f"equalities of type {mujoco.mjtEq(int(kind)).name[5:].lower()}"
            counts[name] = counts.get(name, 0) + 1
    if acts(bit.mjDSBL_FRICTIONLOSS):
        counts["joints with dry friction"] = np.sum(model.dof_frictionloss > 0)
        counts["tendons with dry friction"] = np.sum(model.tendon_frictionloss > 0)
    if acts(bit.mjDSBL_LIMIT):
        single = np.isin(model.jnt_type, (2, 3))
        counts["stops of joints, whose ranges are limits of the MPC"] = np.sum(
            model.jnt_limited[single]
        )
        counts["stops of ball joints, no limits of the MPC"] = np.sum(model.jnt_limited[~single])
        counts["stops of tendons, no limits of the MPC"] = np.sum(model.tendon_limited)
    limited = (model.actuator_forcelimited, model.jnt_actfrclimited, model.tendon_actfrclimited)
    counts["limits of forces that are no limits of inputs"] = sum(map(np.sum, limited))
    return tuple(f"{count} {text}" for text, count in counts.items() if count)
