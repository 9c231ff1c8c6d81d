"""Closed loops: plant and controller together, one time step after the other.

simulate, simulate_many    one closed loop, or many chunk by chunk -> Run
lyapunov_decrease          change of the optimal value along a run
simulate_into              the same of robots into a store, block by block -> StoredRuns
summarise_runs             the numbers and the table of many runs -> RunsSummary
evaluate_runs              limits kept, target reached, settling time and cost -> Outcome
RobotController            an MPC with the linear models of a robot
NonlinearController        an MPC with a nonlinear model of any other plant
GaitController             an MPC of a legged robot along a gait
robot_mpc                  the MPC of a robot, from the limits of its model
enclosed_mpc               the robust MPC whose proofs hold for a nonlinear robot
draw_disturbances          random sequences of the disturbances of a robust problem
worst_disturbance          one that brings a closed loop far beyond its limits, by gradient
LinearFeedback             LQR or PD with clipping, to compare with -> NoPlan in place of a plan
Noise                      random disturbances of the plant and of what is measured
KalmanFilter               estimates of the state from noisy outputs -> Belief
Disturbance                a constant disturbance that a KalmanFilter estimates too
OffsetFreeController       an MPC without steady-state error under such disturbances
augmented                  the MPC problem with such disturbances as states
Environment                a robot with a task, reset and step as pure functions
                           -> EnvironmentState; gymnasium_env.RobotEnv is Gymnasium's form
MPCPolicy                  a controller as a policy of observations
draw_robots                random starts and random factors of masses, damping and payloads
randomised                 random masses, damping, payloads of robots, for `variations`
"""

from jaxmpc.closed_loop.disturbances import draw_disturbances, worst_disturbance
from jaxmpc.closed_loop.environment import Environment, EnvironmentState, MPCPolicy
from jaxmpc.closed_loop.estimation import Belief, Disturbance, KalmanFilter, Noise
from jaxmpc.closed_loop.feedback import LinearFeedback, NoPlan
from jaxmpc.closed_loop.gait_controller import GaitController
from jaxmpc.closed_loop.nonlinear_controller import NonlinearController
from jaxmpc.closed_loop.nonlinear_proofs import enclosed_mpc
from jaxmpc.closed_loop.offset_free import OffsetFreeController, augmented
from jaxmpc.closed_loop.outcome import Outcome, RunsSummary, evaluate_runs, summarise_runs
from jaxmpc.closed_loop.robot_controller import RobotController, robot_mpc
from jaxmpc.closed_loop.simulation import Run, lyapunov_decrease, simulate, simulate_many
from jaxmpc.closed_loop.stored_runs import StoredRuns, simulate_into
from jaxmpc.closed_loop.variations import draw_robots, randomised
from jaxmpc.names import suggest_names

__all__ = [
    "Belief",
    "Disturbance",
    "Environment",
    "EnvironmentState",
    "GaitController",
    "KalmanFilter",
    "LinearFeedback",
    "MPCPolicy",
    "NoPlan",
    "Noise",
    "NonlinearController",
    "OffsetFreeController",
    "Outcome",
    "RobotController",
    "Run",
    "RunsSummary",
    "StoredRuns",
    "augmented",
    "draw_disturbances",
    "draw_robots",
    "enclosed_mpc",
    "evaluate_runs",
    "lyapunov_decrease",
    "randomised",
    "robot_mpc",
    "simulate",
    "simulate_into",
    "simulate_many",
    "summarise_runs",
    "worst_disturbance",
]

suggest_names(__name__)
