"""Tuning by gradient descent, kept after each step.

tune_weights                         fields of an MPC, through its closed loops -> TuningRun
Parameter                            a quantity that is tuned, and its domain
ClosedLoopLoss                       tracking, effort, violations and settling of a closed loop
tune_feasible_set, feasible_share    states from which all limits can be kept, as an objective
tune_penalties, learn_penalties      ADMM's penalties -> ADMM, Penalties
tune_sweep_penalties                 those of the first pass of a map -> SweepPenalties
Descent                              the record of a descent
"""

from jaxmpc.tuning.descent import Descent
from jaxmpc.tuning.feasibility import feasible_share, tune_feasible_set
from jaxmpc.tuning.losses import ClosedLoopLoss
from jaxmpc.tuning.parameters import Parameter
from jaxmpc.tuning.penalties import Penalties, learn_penalties, tune_penalties
from jaxmpc.tuning.sweep_penalties import SweepPenalties, tune_sweep_penalties
from jaxmpc.tuning.weights import TuningRun, tune_weights

__all__ = [
    "ClosedLoopLoss",
    "Descent",
    "Parameter",
    "Penalties",
    "SweepPenalties",
    "TuningRun",
    "feasible_share",
    "learn_penalties",
    "tune_feasible_set",
    "tune_penalties",
    "tune_sweep_penalties",
    "tune_weights",
]
