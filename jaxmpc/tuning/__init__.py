"""Tuning by gradient descent or by samples, with a checkpoint after each step.

tune_weights                              fields of an MPC, through its closed loops -> TuningRun
                                          with Settings and the steps of a Descent
trade_off                                 several losses at once -> TradeOff
linear_task, robot_task                   what `jaxmpc tune weights` tunes: loops, loss, weights
                                          -> WeightTask, with a loss as weight_loss makes it
weight_parameters, feasible_states        its parameters, and initial states that have a plan
run_folder                                the folder of a run that is resumed or overwritten
MPCLayer                                  an MPC problem in a network, some of its data learned
Parameter                                 a quantity that is tuned, and its domain
ClosedLoopLoss                            tracking, effort, violations and settling
tune_feasible_set                         the share of states from which all limits can be kept
tune_solver, transfer_penalties           penalties of ADMM, also for another horizon
Interrupted                               what all of these raise on Ctrl-C, with the best so far
"""

from jaxmpc.names import suggest_names
from jaxmpc.tuning.descent import Descent, Settings
from jaxmpc.tuning.feasible_set import tune_feasible_set
from jaxmpc.tuning.layer import MPCLayer
from jaxmpc.tuning.losses import ClosedLoopLoss
from jaxmpc.tuning.parameters import Parameter
from jaxmpc.tuning.pareto import TradeOff, trade_off
from jaxmpc.tuning.result import Interrupted, TuningRun, run_folder
from jaxmpc.tuning.solver import transfer_penalties, tune_solver
from jaxmpc.tuning.tasks import (
    WeightTask,
    feasible_states,
    linear_task,
    robot_task,
    weight_loss,
    weight_parameters,
)
from jaxmpc.tuning.weights import tune_weights

__all__ = [
    "ClosedLoopLoss",
    "Descent",
    "Interrupted",
    "MPCLayer",
    "Parameter",
    "Settings",
    "TradeOff",
    "TuningRun",
    "WeightTask",
    "feasible_states",
    "linear_task",
    "robot_task",
    "run_folder",
    "trade_off",
    "transfer_penalties",
    "tune_feasible_set",
    "tune_solver",
    "tune_weights",
    "weight_loss",
    "weight_parameters",
]

suggest_names(__name__)
