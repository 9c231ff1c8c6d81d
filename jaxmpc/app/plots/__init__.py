"""Plots of results. Each function draws into the given axes and never shows a window.

plot_feasible_set   a map of two states, with its proved bounds
plot_body           a map of three states, as a body and its projections
plot_robot_map      what the linear model predicts and what the robot did
plot_recursion      states that lose feasibility, and the worst counterexample
plot_runs           closed loops over time with their limits
plot_plan           one plan over its horizon with its limits
plot_before_after   the same loops before and after tuning
plot_regions        the explicit law of two parameters: regions, law or value
plot_tuning         losses, gradients and weights of a descent
plot_trade_off      two losses against each other, and the front
plot_maps           feasible sets before and after tuning
plot_solver         penalties of a tuned solver, and residuals
"""

from jaxmpc.app.plots.closed_loops import plot_before_after, plot_runs
from jaxmpc.app.plots.laws import plot_regions
from jaxmpc.app.plots.maps import plot_body, plot_feasible_set, plot_recursion, plot_robot_map
from jaxmpc.app.plots.plans import plot_plan
from jaxmpc.app.plots.tuning import plot_maps, plot_solver, plot_trade_off, plot_tuning

__all__ = [
    "plot_before_after",
    "plot_body",
    "plot_feasible_set",
    "plot_maps",
    "plot_plan",
    "plot_recursion",
    "plot_regions",
    "plot_robot_map",
    "plot_runs",
    "plot_solver",
    "plot_trade_off",
    "plot_tuning",
]
