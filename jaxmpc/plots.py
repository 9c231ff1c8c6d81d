"""Pictures of what jaxmpc computes. Each draws into the axes given and never shows a window."""

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jaxmpc.checks import fail
from jaxmpc.control.sets import Polytope
from jaxmpc.sweeps.feasible_set import FeasibleSetMap
from jaxmpc.sweeps.recursion import Counterexample, RecursionReport

# Okabe and Ito's palette: told apart with any colour vision, and in grey by lightness.
_INFEASIBLE, _FEASIBLE, _UNDECIDED = "#dddcd8", "#9fcbe6", "#f0d024"
_OUTER, _INNER, _TERMINAL = "#d55e00", "#00486b", "#006f52"
# States lost at step 1, 2, 3, 4-5, 6-10, later: from dark to light.
_LOST = ("#7a0403", "#b5290a", "#dd5a13", "#f28b30", "#f9b867", "#fbe0ad")


def plot_feasible_set(fmap: FeasibleSetMap, ax: Axes | None = None) -> Axes:
    """Draw a map of two states: labels, proved boundaries and terminal set.

    `fmap` is a FeasibleSetMap. Samples are coloured by label. The dashed line bounds the
    inner polytope (the convex hull of states with a checked plan), the solid one the outer
    polytope (the intersection of certified half-spaces): the true boundary lies between, and
    where they meet one sees a dashed line on a solid one. Without `ax` a new figure is made;
    save it with `ax.figure.savefig(path)`. Raises ValueError for a map not of two states.
    """
    points, label = np.asarray(fmap.points), np.asarray(fmap.label)
    if points.ndim != 2 or points.shape[1] != 2:
        fail("fmap", f"maps {points.shape[-1]} states", "A picture needs 2: choose `axes`")
    if ax is None:
        ax = Figure(figsize=(8.4, 4.8), layout="constrained").add_subplot()
    _draw_values(ax, points, label, {-1: _INFEASIBLE, 1: _FEASIBLE, 0: _UNDECIDED})
    handles: list[Any] = [
        Patch(facecolor=colour, edgecolor="#8a8a8a", linewidth=0.6, label=f"{name} ({count:,})")
        for value, name, colour in (
            (1, "feasible", _FEASIBLE),
            (-1, "infeasible", _INFEASIBLE),
            (0, "undecided", _UNDECIDED),
        )
        if (count := np.count_nonzero(label == value))
    ]
    lines: tuple[tuple[Any, str, dict[str, Any]], ...] = (
        (fmap.terminal_section, "terminal set", {"color": _TERMINAL, "lw": 1.8}),
        (fmap.outer, "outer bound", {"color": _OUTER, "lw": 2.4}),
        (fmap.inner, "inner bound", {"color": _INNER, "lw": 1.4, "ls": (0, (3, 3))}),
    )
    for make, name, style in lines:
        corners = _ring(make)
        if len(corners):
            ax.plot(*corners.T, solid_joinstyle="round", **style)
            handles.append(Line2D([], [], label=name, **style))
    ax.set_xlabel(fmap.names[0])
    ax.set_ylabel(fmap.names[1])
    ax.set_title(_title(fmap), loc="left", fontsize=11)
    ax.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(1.02, 1.0),
        frameon=False,
        handlelength=2.4,
    )
    return ax


def _draw_values(ax: Axes, points: np.ndarray, value: np.ndarray, colours: dict[int, str]) -> None:
    """An image where the points are a grid, else small markers, the last of `colours` on top."""
    x, y = (np.unique(column) for column in points.T)
    is_grid = len(x) * len(y) == len(points) and min(len(x), len(y)) > 1
    if is_grid and np.array_equal(points[:, 0], np.repeat(x, len(y))):
        half = np.array([x[-1] - x[0], y[-1] - y[0]]) / (2 * np.array([len(x) - 1, len(y) - 1]))
        extent = (x[0] - half[0], x[-1] + half[0], y[0] - half[1], y[-1] + half[1])
        ax.imshow(
            value.reshape(len(x), len(y)).T,
            cmap=ListedColormap([colour for _, colour in sorted(colours.items())]),
            vmin=min(colours), vmax=max(colours), extent=extent, origin="lower", aspect="auto",
            interpolation="nearest",
        )  # fmt: skip
        return
    size = float(np.clip(2e4 / len(points), 1.0, 30.0))
    for key, colour in colours.items():
        x, y = points[value == key].T
        ax.scatter(x, y, s=size, color=colour, linewidths=0)
    ax.margins(0.02)


def _ring(make: Callable[[], Polytope | None]) -> np.ndarray:
    """Vertices of a polygon, counter-clockwise, the first again at the end; none if no polygon."""
    try:
        polytope = make()
        corners = np.zeros((0, 2)) if polytope is None else polytope.vertices()
    except ValueError:  # not bounded yet, or without interior: nothing to draw
        return np.zeros((0, 2))
    return np.vstack([corners, corners[:1]])


def _title(fmap: FeasibleSetMap) -> str:
    """What is shown, and for more than two states how the others are treated."""
    labels = fmap.mpc.labels if fmap.mpc.rate_limited else fmap.mpc.system.state_labels
    others = [i for i in range(len(labels)) if i not in fmap.axes]
    what = f"Feasible initial states, horizon N = {fmap.mpc.horizon}"
    if not others:
        return what
    if fmap.fixed is None:
        return f"{what}\nprojection: some value of {', '.join(labels[i] for i in others)}"
    values = ", ".join(f"{labels[i]} = {float(fmap.fixed[i]):g}" for i in others)
    return f"{what}\nslice at {values}"


def plot_recursion(
    report: RecursionReport, ax: Axes | None = None, *, enlarge: bool = False
) -> Axes:
    """Draw which states of a two-state problem lose feasibility, and the worst counterexample.

    Samples are coloured by the step of the closed loop at which the problem is proved infeasible.
    The line round them is the feasible set X_N. The arrow leads from the counterexample to its
    next state; the dashed line is the half-space that holds on all of X_N and excludes it.
    enlarge: show the neighbourhood of the counterexample, with X_N filled and without samples.
    Without `ax` a new figure is made. Raises ValueError for other than two states, and for
    enlarge without a counterexample.
    """
    if report.states.shape[1] != 2:
        fail("report", f"is of {report.states.shape[1]} states", "A picture needs 2")
    worst = report.counterexample
    if enlarge and worst is None:
        fail("enlarge", "without a counterexample there is nothing to enlarge", "Leave it out")
    if ax is None:
        ax = Figure(figsize=(8.4, 4.8), layout="constrained").add_subplot()
    handles: list[Any] = []
    corners = _ring(lambda: report.feasible_set)
    if enlarge:
        ax.fill(*corners.T, color=_FEASIBLE, zorder=0)
    else:
        handles += _draw_losses(ax, report)
    if len(corners):
        ax.plot(*corners.T, color=_INNER, lw=1.4)
        handles.append(Line2D([], [], color=_INNER, lw=1.4, label=f"X_{report.mpc.horizon}"))
    if worst is not None:
        if enlarge:
            ends = np.array([worst.state, worst.next_state])
            room = 0.6 * np.maximum(np.ptp(ends, axis=0), 0.15 * np.ptp(ends, axis=0).max())
            (x_low, y_low), (x_high, y_high) = ends.min(axis=0) - room, ends.max(axis=0) + room
            ax.set(xlim=(x_low, x_high), ylim=(y_low, y_high))
        handles += _draw_counterexample(ax, worst)
    names = report.mpc.labels
    ax.set_xlabel(names[0])
    ax.set_ylabel(names[1])
    title = f"Closed loops of {report.steps} steps, horizon N = {report.mpc.horizon}"
    if enlarge and worst is not None:
        title = f"Worst counterexample: next state {worst.distance:.4g} outside"
    ax.set_title(title, loc="left", fontsize=11)
    ax.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.02, 1.0), frameon=False)
    return ax


def _draw_losses(ax: Axes, report: RecursionReport) -> list[Any]:
    """Samples by their fate: infeasible, undecided, kept, or lost at some step."""
    lost = report.lost_at
    fates = [
        ("infeasible", _INFEASIBLE, (lost == -1) & (report.label == -1)),
        ("undecided", _UNDECIDED, (lost == -2) | (report.label == 0)),
        (f"kept for {report.steps} steps", _FEASIBLE, lost == 0),
    ]
    ends = (1, 2, 3, 5, 10, np.inf)
    for first, last, colour in zip((1, 2, 3, 4, 6, 11), ends, _LOST, strict=True):
        name = f"{first}" if first == last else f"{first} to {last}"
        name = f"lost at step {name if last < np.inf else f'{first} or later'}"
        fates.append((name, colour, (lost >= first) & (lost <= last)))
    fate = np.zeros(len(lost), int)
    for i, (_, _, where) in enumerate(fates):
        fate[where] = i
    _draw_values(ax, report.states, fate, {i: colour for i, (_, colour, _) in enumerate(fates)})
    return [
        Patch(facecolor=colour, edgecolor="#8a8a8a", linewidth=0.6, label=f"{name} ({count:,})")
        for name, colour, where in fates
        if (count := np.count_nonzero(where))
    ]


def _draw_counterexample(ax: Axes, worst: Counterexample) -> list[Any]:
    """The arrow x → x⁺ and the line a'x = b of the cut, across the part of the plane in view."""
    ax.autoscale(False)
    (x_low, x_high), (y_low, y_high) = ax.get_xlim(), ax.get_ylim()
    a, b = worst.normal, worst.offset
    if abs(a[1]) * (y_high - y_low) > abs(a[0]) * (x_high - x_low):
        x = np.array([x_low, x_high])
        y = (b - a[0] * x) / a[1]
    else:
        y = np.array([y_low, y_high])
        x = (b - a[1] * y) / a[0]
    cut: dict[str, Any] = {"color": _OUTER, "lw": 1.6, "ls": (0, (4, 3))}
    ax.plot(x, y, **cut)
    style: dict[str, Any] = {
        "arrowstyle": "-|>",
        "color": "black",
        "lw": 1.4,
        "shrinkA": 0,
        "shrinkB": 0,
    }
    (x, y), tip = worst.state, worst.next_state
    ax.annotate("", (tip[0], tip[1]), (x, y), arrowprops=style, zorder=5)
    ax.plot(*worst.state, "o", color="black", ms=4, zorder=5)
    ax.plot(*worst.next_state, "o", color="white", mec="black", ms=5, zorder=6, clip_on=False)
    return [
        Line2D([], [], color="black", marker="o", ms=4, ls="", label="counterexample x"),
        Line2D([], [], color="white", marker="o", mec="black", ms=5, ls="", label="next state"),
        Line2D([], [], label="half-space it leaves", **cut),
    ]
