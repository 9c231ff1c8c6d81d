"""The plot of a robot map: what the linear model predicts and what the robot does."""

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from jaxmpc.app.plots.style import (
    FEASIBLE,
    INFEASIBLE,
    NOT_SOLVED,
    UNDECIDED,
    Style,
    draw_bounds,
    draw_values,
    finish,
    new_axes,
    patch,
)
from jaxmpc.checks import fail
from jaxmpc.robot_maps.robot_map import RobotMap

BROKEN, UNSURE, BETTER = "#cc4b1c", "#f0a868", "#8ccfae"


def plot_robot_map(rmap: RobotMap, ax: Axes | None = None) -> Axes:
    """Draw a map of two coordinates: what the linear model predicts and what the robot did.

    Blue: predicted, kept. Red: predicted, failed; orange: after a plan that was not solved. Grey:
    not predicted, and the robot fails. Green: not predicted, yet the robot does it. Purple: a plan
    of the robot was not solved, so that its claim is open. Yellow: the linear prediction is
    undecided. Lines as in `plot_feasible_set`: inner and outer bound of the linear feasible set,
    and the terminal set. The circle is the failure deepest in that set, the cross the set-point.
    Without `ax` a new figure is made. Raises ValueError for a map not of two coordinates.
    """
    points = rmap.x0s
    if points.shape[1] != 2:
        fail("rmap", f"maps {points.shape[1]} coordinates", "A plot needs 2: choose `axes`")
    ax = new_axes(9.6) if ax is None else ax
    handles: list[Artist] = []
    shown, colours = np.zeros(len(points), int), {}
    for i, (name, colour, where) in enumerate(_outcomes(rmap)):
        shown[where], colours[i] = i, colour
        if count := np.count_nonzero(where):
            handles.append(patch(name, colour, count))
    draw_values(ax, points, shown, colours)
    linear = rmap.linear
    ax.autoscale(False)
    handles += draw_bounds(ax, linear, "linear feasible set, ")
    cross: Style = {"marker": "+", "ms": 9, "mew": 1.6, "color": "black"}
    marks = [(rmap.set_point[list(linear.axes)], "set-point", cross)]
    worst = rmap.worst()
    if worst is not None:
        name = f"deepest failure,\nfails after {rmap.first_loss[worst] * rmap.robot.dt:.3g} s"
        circle: Style = {"marker": "o", "ms": 6, "mfc": "white", "mec": "black"}
        marks.append((points[worst], name, circle))
    for (x, y), name, style in marks:
        ax.plot(x, y, ls="", zorder=6, **style)
        handles.append(Line2D([], [], ls="", label=name, **style))
    finish(ax, rmap.axis_names, _robot_map_title(rmap), handles)
    return ax


def _outcomes(rmap: RobotMap) -> list[tuple[str, str, np.ndarray]]:
    """Return what can become of a state: words, colour, and which states it is, (B,)."""
    if rmap.claim == "limits":
        words = (
            "predicted, kept: a plan exists,\nthe robot keeps its limits",
            "predicted, failed: a plan exists,\nthe robot leaves its limits",
            "infeasible, and the robot\nleaves its limits",
            "infeasible, yet the robot\nkeeps its limits",
            "linear model undecided:\nno plan and no proof found",
        )
    else:
        words = (
            "predicted, kept: the robot has\na plan at each time step",
            "predicted, failed: the robot's\nplans run out",
            "plans run out on the linear\nmodel, and on the robot",
            "plans run out on the linear\nmodel, not on the robot",
            "linear closed loop undecided",
        )
    predicted, held = rmap.predicted, rmap.held
    unsure = rmap.unsure & (predicted == 1)
    found = [
        (words[0], FEASIBLE, (predicted == 1) & (held == 1)),
        (words[1], BROKEN, (predicted == 1) & (held == -1) & ~unsure),
        ("the same, but after a plan\nthat was not solved", UNSURE, unsure),
        (words[2], INFEASIBLE, (predicted == -1) & (held == -1)),
        (words[3], BETTER, (predicted == -1) & (held == 1)),
        ("a plan of the robot\nwas not solved", NOT_SOLVED, (predicted != 0) & (held == 0)),
        (words[4], UNDECIDED, predicted == 0),
    ]
    assert np.all(sum(where.astype(int) for _, _, where in found) == 1)
    return found


def _robot_map_title(rmap: RobotMap) -> str:
    """Return which robot, how long, and the values of the coordinates that are not mapped."""
    name = rmap.robot.name
    mpc, what = rmap.linear.mpc, "does the robot keep having plans"
    if rmap.claim == "limits":
        what = "is a feasible state safe on the robot"
    steps = f"N = {mpc.horizon} steps of {rmap.robot.dt:g} s"
    first = f"{name}: {what} for {rmap.seconds:g} s?\n{steps}"
    labels = mpc.system.state_labels
    others = [i for i in range(len(labels)) if i not in rmap.linear.axes]
    fixed = rmap.linear.fixed
    if not others or fixed is None:
        return first
    values = [f"{labels[i]} = {fixed[i]:.4g}" for i in others]
    shown = ", ".join(values) if len(values) <= 4 else f"{len(values)} other coordinates as fixed"
    return f"{first}, slice at {shown}"
