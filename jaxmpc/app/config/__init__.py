"""Configuration files: a problem and the settings of commands, as TOML, to and from an MPC.

    name = "joint"

    [system]  A, B, c, dt, continuous, state_names, state_units, input_names, input_units,
             time_unit
    [limits]  x_min, x_max, margin  or  H_x, h_x;  u_min, u_max, input_rate_limit
    [cost]    Q, R, P, rho, input_rate_weight, stage_weights
    [mpc]     horizon, terminal  or  H_f, h_f  or  P_f, level_f;  constrain_initial,
              constrained_stages, control_horizon
    [[outputs]]  C, lower, upper, D, stages, names, units; soft with rho, quadratic
    [reference]  state, input
    [disturbance]  w_min, w_max, E, policy, gain
    [solver]  iterations, rho, alpha, newton_steps
    [sweep]   grid, lower, upper, axes, fixed | projection, iterations, dtype
    [recursion]  steps, grid, lower, upper, regions, seconds

The classes of `problem` document each key. Every error is a ValueError that names the file and the
key (or the option of the command line that set it), and how to correct it. A robot's weights have a
file of their own, with the sections [robot] and [cost].
"""

from jaxmpc.app.config.loading import (
    from_results,
    holds_system,
    load,
    load_robot_config,
    require_horizon,
    state_bytes,
)
from jaxmpc.app.config.problem import (
    Config,
    RobotConfig,
    RobotCostSection,
    RobotSection,
    SolverSection,
    SweepPoints,
    grid_shape,
    recursion_states,
    sweep_points,
)

__all__ = [
    "Config",
    "RobotConfig",
    "RobotCostSection",
    "RobotSection",
    "SolverSection",
    "SweepPoints",
    "from_results",
    "grid_shape",
    "holds_system",
    "load",
    "load_robot_config",
    "recursion_states",
    "require_horizon",
    "state_bytes",
    "sweep_points",
]
