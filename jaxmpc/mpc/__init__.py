"""Model predictive control of linear systems.

MPC, Outputs, Soft    a problem, with rows of outputs and soft rows
solve, Controller     one plan, or a factored problem: controller(x) -> Control with u and Plan
                      with Multipliers
solve_stagewise       one plan, factored along the horizon
NonlinearMPC, Task    a problem with a nonlinear model, costs and limits on functions of a Point
solve_nonlinear       its plan by sequential quadratic programming
solve_many            one plan for each of many states -> Plan with a batch axis
WarmStart             where a solver begins: states, inputs, multipliers
equilibrium           steady state and input for a reference -> SteadyState
active_constraints    which rows of a plan are active -> ActiveConstraint
row_table             each row of the problem: kind, name, unit, step -> Row
soften, harden        make rows soft or hard
first_step_in         keep a robust control invariant set by its first step -> MPC
pad_horizon           a longer horizon with the same plans -> MPC
stack_horizons        problems of different horizons as one batch for jax.vmap -> MPC
"""

from jaxmpc.mpc.controller import Controller, solve
from jaxmpc.mpc.first_step import first_step_in
from jaxmpc.mpc.horizons import pad_horizon, stack_horizons
from jaxmpc.mpc.many import solve_many
from jaxmpc.mpc.plan import (
    ActiveConstraint,
    Control,
    Multipliers,
    Plan,
    WarmStart,
    active_constraints,
)
from jaxmpc.mpc.problem import MPC, Outputs, Soft, harden, soften
from jaxmpc.mpc.rows import Row, row_table
from jaxmpc.mpc.stagewise.nonlinear import NonlinearMPC, Point, Task
from jaxmpc.mpc.stagewise.solve import solve_stagewise
from jaxmpc.mpc.stagewise.sqp import solve_nonlinear
from jaxmpc.mpc.steady_state import SteadyState, equilibrium
from jaxmpc.names import suggest_names

__all__ = [
    "MPC",
    "ActiveConstraint",
    "Control",
    "Controller",
    "Multipliers",
    "NonlinearMPC",
    "Outputs",
    "Plan",
    "Point",
    "Row",
    "Soft",
    "SteadyState",
    "Task",
    "WarmStart",
    "active_constraints",
    "equilibrium",
    "first_step_in",
    "harden",
    "pad_horizon",
    "row_table",
    "soften",
    "solve",
    "solve_many",
    "solve_nonlinear",
    "solve_stagewise",
    "stack_horizons",
]

suggest_names(__name__)
