"""Constrained model predictive control for robots: solved by the million, and proved."""

from jaxmpc.closed_loop.linear_feedback import LinearFeedback
from jaxmpc.closed_loop.outcome import Outcome, evaluate_runs
from jaxmpc.closed_loop.robot_controller import RobotController
from jaxmpc.closed_loop.robot_mpc import robot_mpc
from jaxmpc.closed_loop.run import Run, lyapunov_decrease
from jaxmpc.closed_loop.simulate import simulate
from jaxmpc.closed_loop.simulate_many import simulate_many
from jaxmpc.control.equilibrium import equilibrium
from jaxmpc.control.invariant import (
    ControlInvariantSet,
    invariant_ellipsoid,
    maximal_control_invariant_set,
    maximal_invariant_set,
    predecessor,
)
from jaxmpc.control.limits import JointLimits, joint_limits, output_limits
from jaxmpc.control.riccati import LQR, lqr
from jaxmpc.control.sets import Box, Ellipsoid, Polytope
from jaxmpc.control.system import LinearSystem
from jaxmpc.control.terminal import TerminalReport, verify_terminal
from jaxmpc.mpc.problem import MPC, Outputs, Plan, Soft
from jaxmpc.mpc.rows import active_constraints, row_table
from jaxmpc.mpc.soften import harden, soften
from jaxmpc.mpc.solve import Controller, solve
from jaxmpc.mpc.stagewise import solve_stagewise
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.margin import feasibility_margin
from jaxmpc.qp.problem import QP, QPSolution
from jaxmpc.qp.solve import solve_qp
from jaxmpc.qp.status import Status
from jaxmpc.robots.linear import LinearPlant
from jaxmpc.robots.load import load_robot
from jaxmpc.robots.robot import Robot
from jaxmpc.sweeps.boundary import Boundary, boundary
from jaxmpc.sweeps.exact_penalty import ExactPenalty, exact_penalty
from jaxmpc.sweeps.feasible_set import FeasibleSetMap, grid, map_feasible_set
from jaxmpc.sweeps.plans import Plans, solve_many
from jaxmpc.sweeps.reach import feasible_growth, feasible_polytope
from jaxmpc.sweeps.recursion import RecursionReport, recursive_feasibility, smallest_horizon
from jaxmpc.sweeps.regions import CriticalRegions, critical_regions
from jaxmpc.sweeps.robots import RobotMap, map_robot
from jaxmpc.tuning.feasible_fraction import feasible_fraction
from jaxmpc.tuning.feasible_set import tune_feasible_set
from jaxmpc.tuning.losses import ClosedLoopLoss
from jaxmpc.tuning.parameters import Parameter
from jaxmpc.tuning.penalties import tune_penalties
from jaxmpc.tuning.penalty_schedule import transfer_penalties
from jaxmpc.tuning.result import TuningRun
from jaxmpc.tuning.sweep_penalties import tune_sweep_penalties
from jaxmpc.tuning.weights import tune_weights
from jaxmpc.workflow import Design, OfflineReport, design, offline_report

__all__ = [
    "ADMM",
    "LQR",
    "MPC",
    "QP",
    "Boundary",
    "Box",
    "ClosedLoopLoss",
    "ControlInvariantSet",
    "Controller",
    "CriticalRegions",
    "Design",
    "Ellipsoid",
    "ExactPenalty",
    "FeasibleSetMap",
    "JointLimits",
    "LinearFeedback",
    "LinearPlant",
    "LinearSystem",
    "OfflineReport",
    "Outcome",
    "Outputs",
    "Parameter",
    "Plan",
    "Plans",
    "Polytope",
    "QPSolution",
    "RecursionReport",
    "Robot",
    "RobotController",
    "RobotMap",
    "Run",
    "Soft",
    "Status",
    "TerminalReport",
    "TuningRun",
    "active_constraints",
    "boundary",
    "critical_regions",
    "design",
    "equilibrium",
    "evaluate_runs",
    "exact_penalty",
    "feasibility_margin",
    "feasible_fraction",
    "feasible_growth",
    "feasible_polytope",
    "grid",
    "harden",
    "invariant_ellipsoid",
    "joint_limits",
    "load_robot",
    "lqr",
    "lyapunov_decrease",
    "map_feasible_set",
    "map_robot",
    "maximal_control_invariant_set",
    "maximal_invariant_set",
    "offline_report",
    "output_limits",
    "predecessor",
    "recursive_feasibility",
    "robot_mpc",
    "row_table",
    "simulate",
    "simulate_many",
    "smallest_horizon",
    "soften",
    "solve",
    "solve_many",
    "solve_qp",
    "solve_stagewise",
    "transfer_penalties",
    "tune_feasible_set",
    "tune_penalties",
    "tune_sweep_penalties",
    "tune_weights",
    "verify_terminal",
]
