"""Plots of results. Each function draws into the given axes and never shows a window."""

from jaxmpc.app.plots.closed_loops import plot_runs
from jaxmpc.app.plots.laws import plot_regions
from jaxmpc.app.plots.maps import plot_feasible_set, plot_recursion, plot_robot_map

__all__ = ["plot_feasible_set", "plot_recursion", "plot_regions", "plot_robot_map", "plot_runs"]
