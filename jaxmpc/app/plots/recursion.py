"""The plot of recursive feasibility: states that are lost, and the worst counterexample."""

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxmpc.app.plots.style import (
    FEASIBLE,
    INFEASIBLE,
    INNER,
    OUTER,
    UNDECIDED,
    Style,
    draw_values,
    finish,
    new_axes,
    patch,
    ring,
)
from jaxmpc.checks import fail
from jaxmpc.recursion.claims import Counterexample
from jaxmpc.recursion.report import RecursionReport

# States lost at step 1, 2, 3, 4-5, 6-10, later: from dark to light.
LOST = ("#7a0403", "#b5290a", "#dd5a13", "#f28b30", "#f9b867", "#fbe0ad")


def draw_recursion(report: RecursionReport) -> Figure:
    """Draw `plot_recursion`, and beside it the counterexample enlarged where there is one."""
    panels = 1 if report.counterexample is None else 2
    figure = Figure(figsize=(8.4 if panels == 1 else 13, 5.2), layout="constrained")
    for k, ax in enumerate(figure.subplots(1, panels, squeeze=False)[0]):
        plot_recursion(report, ax, enlarge=k == 1)
    return figure


def plot_recursion(
    report: RecursionReport, ax: Axes | None = None, *, enlarge: bool = False
) -> Axes:
    """Draw which states of a two-state problem lose feasibility, and the worst counterexample.

    Samples are coloured by the step of the closed loop at which the problem is proved infeasible.
    The line round them is the feasible set X_N. The arrow leads from the counterexample to its
    next state; the dashed line is the half-space that holds on all of X_N and excludes it.
    enlarge: show the neighbourhood of the counterexample, with X_N filled and without samples.
    X_N is filled also where there are no samples.
    Without `ax` a new figure is made. Raises ValueError for other than two states, and for
    enlarge without a counterexample.
    """
    if report.loops.x0s.shape[1] != 2:
        fail("report", f"is of {report.loops.x0s.shape[1]} states", "A plot needs 2")
    worst = report.counterexample
    if enlarge and worst is None:
        fail("enlarge", "without a counterexample there is nothing to enlarge", "Leave it out")
    ax = new_axes() if ax is None else ax
    handles: list[Artist] = []
    corners = ring(lambda: report.feasible_set)
    if enlarge or not len(report.loops.x0s):
        ax.fill(*corners.T, color=FEASIBLE, zorder=0)
    else:
        handles += _draw_losses(ax, report)
    if len(corners):
        ax.plot(*corners.T, color=INNER, lw=1.4)
        handles.append(
            Line2D([], [], color=INNER, lw=1.4, label=f"X_{report.mpc.horizon}: states with a plan")
        )
    if worst is not None:
        if enlarge:
            ends = np.array([worst.state, worst.next_state])
            room = 0.6 * np.maximum(np.ptp(ends, axis=0), 0.15 * np.ptp(ends, axis=0).max())
            (x_low, y_low), (x_high, y_high) = ends.min(axis=0) - room, ends.max(axis=0) + room
            ax.set(xlim=(x_low, x_high), ylim=(y_low, y_high))
        handles += _draw_counterexample(ax, worst)
    title = f"Closed loops of {report.loops.steps} steps, horizon N = {report.mpc.horizon}"
    if not len(report.loops.x0s):
        verdict = {True: "kept for ever", False: "not all kept", None: "not followed"}
        title = f"Feasible states, {verdict[report.law.holds]}, horizon N = {report.mpc.horizon}"
    if enlarge and worst is not None:
        title = f"Worst counterexample: next state {worst.distance:.4g} outside"
    finish(ax, report.mpc.labels, title, handles)
    return ax


def _draw_losses(ax: Axes, report: RecursionReport) -> list[Artist]:
    """Draw samples by outcome: infeasible, undecided, kept, or lost at some step."""
    lost = report.loops.lost_at
    outcomes = [
        ("infeasible", INFEASIBLE, (lost == -1) & (report.loops.label == -1)),
        ("undecided", UNDECIDED, (lost == -2) | (report.loops.label == 0)),
        (f"kept for {report.loops.steps} steps", FEASIBLE, lost == 0),
    ]
    ends = (1, 2, 3, 5, 10, np.inf)
    for first, last, colour in zip((1, 2, 3, 4, 6, 11), ends, LOST, strict=True):
        name = f"{first}" if first == last else f"{first} to {last}"
        name = f"lost at step {name if last < np.inf else f'{first} or later'}"
        outcomes.append((name, colour, (lost >= first) & (lost <= last)))
    outcome = np.zeros(len(lost), int)
    for i, (_, _, where) in enumerate(outcomes):
        outcome[where] = i
    colours = {i: colour for i, (_, colour, _) in enumerate(outcomes)}
    draw_values(ax, report.loops.x0s, outcome, colours)
    return [
        patch(name, colour, count)
        for name, colour, where in outcomes
        if (count := np.count_nonzero(where))
    ]


def _draw_counterexample(ax: Axes, worst: Counterexample) -> list[Artist]:
    """Draw the arrow x → x⁺ and, across the part of the plane in view, the line a'x = b."""
    ax.autoscale(False)
    (x_low, x_high), (y_low, y_high) = ax.get_xlim(), ax.get_ylim()
    a, b = worst.normal, worst.offset
    if abs(a[1]) * (y_high - y_low) > abs(a[0]) * (x_high - x_low):
        x = np.array([x_low, x_high])
        y = (b - a[0] * x) / a[1]
    else:
        y = np.array([y_low, y_high])
        x = (b - a[1] * y) / a[0]
    cut: Style = {"color": OUTER, "lw": 1.6, "ls": (0, (4, 3))}
    ax.plot(x, y, **cut)
    style: Style = {"arrowstyle": "-|>", "color": "black", "lw": 1.4, "shrinkA": 0, "shrinkB": 0}
    (x, y), tip = worst.state, worst.next_state
    ax.annotate("", (tip[0], tip[1]), (x, y), arrowprops=style, zorder=5)
    ax.plot(*worst.state, "o", color="black", ms=4, zorder=5)
    ax.plot(*worst.next_state, "o", color="white", mec="black", ms=5, zorder=6, clip_on=False)
    return [
        Line2D([], [], color="black", marker="o", ms=4, ls="", label="counterexample x"),
        Line2D([], [], color="white", marker="o", mec="black", ms=5, ls="", label="next state"),
        Line2D([], [], label="half-space it leaves", **cut),
    ]
