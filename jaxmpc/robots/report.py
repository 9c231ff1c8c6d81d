"""What was read from a robot's file, where its limits come from, and what is ignored."""

from collections import Counter

import numpy as np

from jaxmpc.pytrees import record
from jaxmpc.robots.description import RobotDescription
from jaxmpc.robots.mujoco_access import acts, equalities, mjx_module, mujoco, single_joints, word


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


def report_of(robot: RobotDescription) -> RobotReport:
    """Return the account of a robot."""
    notes = lambda key: tuple(text for name, text in robot.notes if name == key)
    ends = (robot.state_limits.bounds(), robot.input_limits.bounds())
    lower, upper = (np.concatenate(end).tolist() for end in zip(*ends, strict=True))
    names = (*robot.state_names, *robot.input_names)
    units = (*robot.state_units, *robot.input_units)
    sources = notes("limit") or ("",) * len(names)
    home = tuple(f"home: {text}" for text in notes("home"))
    return RobotReport(
        name=robot.name,
        read=_read(robot, (*home, *notes("welded"))),
        limits=tuple(zip(names, units, lower, upper, sources, strict=True)),
        predictor_ignores=_ignored(robot.mujoco),
        left_out=notes("left out"),
        cleared=notes("cleared"),
        mended=notes("mended"),
    )


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
    for kind in equalities(model):
        counts[f"equalities of type {kind}"] += 1
    if acts(model, "frictionloss"):
        counts["joints with dry friction"] = np.sum(model.dof_frictionloss > 0)
        counts["tendons with dry friction"] = np.sum(model.tendon_frictionloss > 0)
    if acts(model, "limit"):
        single, limited = single_joints(model), model.jnt_limited
        counts["stops of joints, whose ranges are limits of the MPC"] = np.sum(limited[single])
        counts["stops of ball joints, no limits of the MPC"] = np.sum(limited[~single])
        counts["stops of tendons, no limits of the MPC"] = np.sum(model.tendon_limited)
    limited = (model.actuator_forcelimited, model.jnt_actfrclimited, model.tendon_actfrclimited)
    counts["limits of forces that are no limits of inputs"] = sum(map(np.sum, limited))
    return tuple(f"{count} {text}" for text, count in counts.items() if count)
