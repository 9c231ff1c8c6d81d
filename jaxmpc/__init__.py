"""Constrained model predictive control for robots: solved in large batches, with proofs.

Problems       LinearSystem, MPC, Box, Polytope, Ellipsoid, Outputs, Soft, soften, joint_limits,
               design
Plans          solve, solve_many, Controller with ADMM and Status; solve_qp of a QP
Nonlinear      NonlinearMPC, solve_nonlinear
Closed loops   load_robot, LinearPlant, robot_mpc, RobotController, NonlinearController, simulate,
               simulate_many
Proofs         map_feasible_set of a grid, feasible_polytope, recursive_feasibility
Regulators     lqr, maximal_invariant_set
Tuning         tune_weights with Parameter and ClosedLoopLoss

The rest is in `qp`, `systems`, `sets`, `mpc`, `feasible`, `verify`, `recursion`, `explicit`,
`export`, `robots`, `robot_maps`, `closed_loop`, `tuning` and `workflow`; `docs/reference` describes
the types of all results too.
Each name is imported when it is first used, so that the command can answer Ctrl-C before
JAX is loaded.
"""

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

from jaxmpc.names import imported, raise_absent
from jaxmpc.version import __version__ as __version__

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
    from jaxmpc.closed_loop import (
        NonlinearController,
        RobotController,
        robot_mpc,
        simulate,
        simulate_many,
    )
    from jaxmpc.feasible import feasible_polytope, grid, map_feasible_set
    from jaxmpc.mpc.controller import Controller, solve
    from jaxmpc.mpc.many import solve_many
    from jaxmpc.mpc.problem import MPC, Outputs, Soft, soften
    from jaxmpc.mpc.stagewise.nonlinear import NonlinearMPC
    from jaxmpc.mpc.stagewise.sqp import solve_nonlinear
    from jaxmpc.qp.admm import ADMM
    from jaxmpc.qp.problem import QP
    from jaxmpc.qp.solve import solve_qp
    from jaxmpc.qp.status import Status
    from jaxmpc.recursion import recursive_feasibility
    from jaxmpc.robots.linear_plant import LinearPlant
    from jaxmpc.robots.load import load_robot
    from jaxmpc.sets.convex_sets import Box, Ellipsoid, Polytope
    from jaxmpc.sets.invariant import maximal_invariant_set
    from jaxmpc.sets.limits import joint_limits
    from jaxmpc.systems.riccati import lqr
    from jaxmpc.systems.system import LinearSystem
    from jaxmpc.tuning.losses import ClosedLoopLoss
    from jaxmpc.tuning.parameters import Parameter
    from jaxmpc.tuning.weights import tune_weights
    from jaxmpc.workflow import design

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
    "NonlinearController",
    "NonlinearMPC",
    "Outputs",
    "Parameter",
    "Polytope",
    "RobotController",
    "Soft",
    "Status",
    "closed_loop",
    "design",
    "explicit",
    "export",
    "feasible",
    "feasible_polytope",
    "grid",
    "joint_limits",
    "load_robot",
    "lqr",
    "map_feasible_set",
    "maximal_invariant_set",
    "mpc",
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
    "solve_nonlinear",
    "solve_qp",
    "systems",
    "tune_weights",
    "tuning",
    "verify",
    "workflow",
]

# The module of each name that is no module itself.
HOMES = {
    "closed_loop": "NonlinearController RobotController robot_mpc simulate simulate_many",
    "feasible": "feasible_polytope grid map_feasible_set",
    "mpc.controller": "Controller solve",
    "mpc.many": "solve_many",
    "mpc.problem": "MPC Outputs Soft soften",
    "mpc.stagewise.nonlinear": "NonlinearMPC",
    "mpc.stagewise.sqp": "solve_nonlinear",
    "qp.admm": "ADMM",
    "qp.problem": "QP",
    "qp.solve": "solve_qp",
    "qp.status": "Status",
    "recursion": "recursive_feasibility",
    "robots.linear_plant": "LinearPlant",
    "robots.load": "load_robot",
    "sets.convex_sets": "Box Ellipsoid Polytope",
    "sets.invariant": "maximal_invariant_set",
    "sets.limits": "joint_limits",
    "systems.riccati": "lqr",
    "systems.system": "LinearSystem",
    "tuning.losses": "ClosedLoopLoss",
    "tuning.parameters": "Parameter",
    "tuning.weights": "tune_weights",
    "workflow": "design",
}

if "jax" in sys.modules:
    # It brings Pallas, whose settings are part of what JAX knows programs by: imported only while a
    # user's function is traced it would have that function compiled a second time.
    import_module("jax.extend")


def __getattr__(name: str) -> Any:
    """Import a name when it is first used."""
    if name not in (*__all__, "app"):
        raise_absent(__name__, name)
    home = next((home for home, names in HOMES.items() if name in names.split()), None)
    if home is None:
        return imported(f"{__name__}.{name}")
    globals()[name] = found = getattr(imported(f"{__name__}.{home}"), name)
    return found


def __dir__() -> list[str]:
    return sorted(["__version__", "app", *__all__])
