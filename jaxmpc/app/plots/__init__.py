"""Plots of results. Each function draws into the given axes and never shows a window."""

from jaxmpc.app.plots.closed_loops import plot_runs
from jaxmpc.app.plots.feasible_set import plot_feasible_set
from jaxmpc.app.plots.recursion import plot_recursion
from jaxmpc.app.plots.robot_map import plot_robot_map

__all__ = ["plot_feasible_set", "plot_recursion", "plot_robot_map", "plot_runs"]
