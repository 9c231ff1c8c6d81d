"""Constrained model predictive control for robots: solved by the million, and proved."""

from jaxmpc.control.invariant import maximal_invariant_set as maximal_invariant_set
from jaxmpc.control.riccati import LQR as LQR
from jaxmpc.control.riccati import lqr as lqr
from jaxmpc.control.sets import Box as Box
from jaxmpc.control.sets import Polytope as Polytope
from jaxmpc.control.system import LinearSystem as LinearSystem
from jaxmpc.mpc.problem import MPC as MPC
from jaxmpc.mpc.problem import Plan as Plan
from jaxmpc.mpc.solve import Controller as Controller
from jaxmpc.mpc.solve import solve as solve
from jaxmpc.qp.admm import ADMM as ADMM
from jaxmpc.qp.margin import feasibility_margin as feasibility_margin
from jaxmpc.qp.problem import QP as QP
from jaxmpc.qp.problem import QPSolution as QPSolution
from jaxmpc.qp.solve import solve_qp as solve_qp
from jaxmpc.qp.status import Status as Status
from jaxmpc.sweeps.boundary import Boundary as Boundary
from jaxmpc.sweeps.boundary import boundary as boundary
from jaxmpc.sweeps.feasible_set import FeasibleSetMap as FeasibleSetMap
from jaxmpc.sweeps.feasible_set import grid as grid
from jaxmpc.sweeps.feasible_set import map_feasible_set as map_feasible_set
from jaxmpc.sweeps.plans import Plans as Plans
from jaxmpc.sweeps.plans import solve_many as solve_many
