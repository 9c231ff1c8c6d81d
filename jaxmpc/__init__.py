"""Constrained model predictive control for robots: solved in large batches, with proofs.

Problems       LinearSystem, MPC, Box, Polytope, Ellipsoid, Outputs, Soft, joint_limits, design
Plans          solve, solve_many, Controller -> Plan, Status; solve_qp of a QP by ADMM
Nonlinear      mpc.NonlinearMPC, mpc.Task, mpc.solve_nonlinear
Closed loops   load_robot, LinearPlant, robot_mpc, RobotController, simulate, simulate_many
Proofs         map_feasible_set, boundary, feasible_polytope, recursive_feasibility,
               verify_terminal, exact_penalty, offline_report
Sets and laws  lqr, maximal_invariant_set, maximal_control_invariant_set, invariant_ellipsoid
Tuning         tune_weights, tune_solver with Parameter and ClosedLoopLoss

The rest, and the types of all results, are in `qp`, `systems`, `sets`, `mpc`, `feasible`, `verify`,
`recursion`, `explicit`, `export`, `robots`, `robot_maps`, `closed_loop`, `tuning` and `workflow`.
Each name is imported when it is first used, so that the command can answer Ctrl-C before
JAX is loaded.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jaxmpc import (
        closed_loop,
        explicit,
        export,
        feasible,
        mpc,
        qp,
        recursion,
        robot_maps,
        robots,
        sets,
        systems,
        tuning,
        verify,
        workflow,
    )
    from jaxmpc.closed_loop import RobotController, robot_mpc, simulate, simulate_many
    from jaxmpc.explicit import exact_penalty
    from jaxmpc.feasible import boundary, feasible_polytope, grid, map_feasible_set
    from jaxmpc.mpc.controller import Controller, solve
    from jaxmpc.mpc.many import solve_many
    from jaxmpc.mpc.plan import Plan
    from jaxmpc.mpc.problem import MPC, Outputs, Soft
    from jaxmpc.mpc.softening import soften
    from jaxmpc.qp.admm import ADMM
    from jaxmpc.qp.problem import QP
    from jaxmpc.qp.solve import solve_qp
    from jaxmpc.qp.status import Status
    from jaxmpc.recursion import recursive_feasibility
    from jaxmpc.robots.linear_plant import LinearPlant
    from jaxmpc.robots.load import load_robot
    from jaxmpc.sets.box import Box
    from jaxmpc.sets.control_invariant import maximal_control_invariant_set
    from jaxmpc.sets.ellipsoid import Ellipsoid
    from jaxmpc.sets.invariant import invariant_ellipsoid, maximal_invariant_set
    from jaxmpc.sets.limits import joint_limits
    from jaxmpc.sets.polytope import Polytope
    from jaxmpc.sets.terminal_hypotheses import verify_terminal
    from jaxmpc.systems.riccati import lqr
    from jaxmpc.systems.system import LinearSystem
    from jaxmpc.tuning.losses import ClosedLoopLoss
    from jaxmpc.tuning.parameters import Parameter
    from jaxmpc.tuning.solver import tune_solver
    from jaxmpc.tuning.weights import tune_weights
    from jaxmpc.workflow import design, offline_report

# Here and not in the metadata of an installation, which a source tree on the path has none of.
__version__ = "0.1.0"

__all__ = [
    "ADMM",
    "MPC",
    "QP",
    "Box",
    "ClosedLoopLoss",
    "Controller",
    "Ellipsoid",
    "LinearPlant",
    "LinearSystem",
    "Outputs",
    "Parameter",
    "Plan",
    "Polytope",
    "RobotController",
    "Soft",
    "Status",
    "boundary",
    "closed_loop",
    "design",
    "exact_penalty",
    "explicit",
    "export",
    "feasible",
    "feasible_polytope",
    "grid",
    "invariant_ellipsoid",
    "joint_limits",
    "load_robot",
    "lqr",
    "map_feasible_set",
    "maximal_control_invariant_set",
    "maximal_invariant_set",
    "mpc",
    "offline_report",
    "qp",
    "recursion",
    "recursive_feasibility",
    "robot_maps",
    "robot_mpc",
    "robots",
    "sets",
    "simulate",
    "simulate_many",
    "soften",
    "solve",
    "solve_many",
    "solve_qp",
    "systems",
    "tune_solver",
    "tune_weights",
    "tuning",
    "verify",
    "verify_terminal",
    "workflow",
]

# The module of each name that is no module itself.
HOMES = {
    "closed_loop": "RobotController robot_mpc simulate simulate_many",
    "explicit": "exact_penalty",
    "feasible": "boundary feasible_polytope grid map_feasible_set",
    "mpc.controller": "Controller solve",
    "mpc.many": "solve_many",
    "mpc.plan": "Plan",
    "mpc.problem": "MPC Outputs Soft",
    "mpc.softening": "soften",
    "qp.admm": "ADMM",
    "qp.problem": "QP",
    "qp.solve": "solve_qp",
    "qp.status": "Status",
    "recursion": "recursive_feasibility",
    "robots.linear_plant": "LinearPlant",
    "robots.load": "load_robot",
    "sets.box": "Box",
    "sets.control_invariant": "maximal_control_invariant_set",
    "sets.ellipsoid": "Ellipsoid",
    "sets.invariant": "invariant_ellipsoid maximal_invariant_set",
    "sets.limits": "joint_limits",
    "sets.polytope": "Polytope",
    "sets.terminal_hypotheses": "verify_terminal",
    "systems.riccati": "lqr",
    "systems.system": "LinearSystem",
    "tuning.losses": "ClosedLoopLoss",
    "tuning.parameters": "Parameter",
    "tuning.solver": "tune_solver",
    "tuning.weights": "tune_weights",
    "workflow": "design offline_report",
}


def __getattr__(name: str) -> Any:
    """Import a name when it is first used."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = next((home for home, names in HOMES.items() if name in names.split()), None)
    if home is None:
        return import_module(f"{__name__}.{name}")
    globals()[name] = found = getattr(import_module(f"{__name__}.{home}"), name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
