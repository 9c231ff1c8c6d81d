"""Pictures of what jaxmpc computes. Each draws into the axes given and never shows a window."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from jaxmpc.checks import fail
from jaxmpc.closed_loop.outcome import with_limits
from jaxmpc.closed_loop.run import Run
from jaxmpc.control import violation
from jaxmpc.control.sets import Polytope
from jaxmpc.robots.robot import Robot
from jaxmpc.sweeps.feasible_set import FeasibleSetMap
from jaxmpc.sweeps.recursion import Counterexample, RecursionReport

# Okabe and Ito's palette: told apart with any colour vision, and in grey by lightness.
_INFEASIBLE, _FEASIBLE, _UNDECIDED = "#dddcd8", "#9fcbe6", "#f0d024"
_OUTER, _INNER, _TERMINAL = "#d55e00", "#00486b", "#006f52"
_RUN, _BROKEN = "#0072b2", "#a50f15"
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


def plot_runs(
    run: Run, plant: Any, *, reference: Any = None, input_reference: Any = None,
    robots: Sequence[int] | None = None,
) -> Figure:  # fmt: skip
    """Draw closed loops over time: a panel for each position, velocity and input.

    run: of `simulate` or `simulate_many`, of a Robot or LinearPlant. Limits are lines, what lies
    outside is grey. Orange: samples whose plan breaks soft limits (fallback). Red: limits exceeded
    by more than 1e-6 (of the limit, if that is above 1). reference (n,), input_reference (m,):
    set-points to draw. robots: which of the batch to draw, 24 at most by default; the title
    counts all. Raises ValueError for robots that are not there.
    """
    run = run.on_host()
    inputs, failed = np.asarray(run.inputs), np.asarray(run.fallback)
    count, samples = inputs.shape[:2]
    shown = np.arange(min(count, 24)) if robots is None else np.asarray(robots, int)
    if not len(shown) or np.any((shown < 0) | (shown >= count)):
        fail("robots", f"{robots}", f"Give indices from 0 to {count - 1}")
    pairs = with_limits(plant, run)
    xi, kept = pairs[0][1], [violation.kept(*pair) for pair in pairs]
    columns = _columns(plant)
    rows = max(len(panels) for _, panels in columns)
    size = (2.6 * len(columns) + 0.2, max(1.15 * rows, 2.0) + 1.1)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(rows, len(columns), sharex=True, squeeze=False)
    time = plant.dt * np.arange(samples + 1)
    fallback = failed[shown]
    for column, (title, panels) in zip(grid.T, columns, strict=True):
        for ax in column[len(panels) :]:
            ax.set_axis_off()
        column[0].set_title(title, fontsize=9)
        column[len(panels) - 1].set_xlabel("time [s]", fontsize=8)
        column[len(panels) - 1].tick_params(labelbottom=True)
        for ax, (kind, i, label) in zip(column, panels, strict=False):
            values, limits, target = (
                (inputs, plant.input_limits, input_reference) if kind
                else (xi, plant.state_limits, reference)
            )  # fmt: skip
            target = None if target is None else float(np.asarray(target)[i])
            ends = [float(np.asarray(end)[i]) for end in (limits.lower, limits.upper)]
            broken = ~kept[kind][shown, :, i]
            _draw_lines(ax, time, values[shown, :, i].T, fallback.T, broken.T)
            _draw_limits(ax, ends, target)
            ax.set_ylabel(label, fontsize=8)
            ax.tick_params(labelsize=7)
            ax.set_xlim(0, time[-1])
    figure.align_ylabels()
    whole = kept[0].all(axis=(1, 2)) & kept[1].all(axis=(1, 2))
    figure.suptitle(
        f"{plant.name}: {count:,} closed loop{'s' * (count > 1)} of {time[-1]:g} s, {len(shown):,} "
        f"shown\nlimits kept by {np.count_nonzero(whole):,}; fallback plans: "
        f"{np.count_nonzero(failed):,} of {failed.size:,}",
        fontsize=9, x=0.01, ha="left",
    )  # fmt: skip
    grey: Any = {"facecolor": _INFEASIBLE, "edgecolor": "#8a8a8a", "linewidth": 0.6}
    line = lambda label, **style: Line2D([], [], label=label, **style)
    handles: list[Any] = [
        line("one robot", color=_RUN, lw=0.8),
        Patch(**grey, label="outside limits"),
    ]
    if reference is not None or input_reference is not None:
        handles.append(line("set-point", color=_TERMINAL, lw=1.0, ls=(0, (4, 2))))
    if fallback.any():
        handles.append(line("fallback plan", color=_OUTER, lw=1.2))
    if not all(part[shown].all() for part in kept):
        handles.append(line("limit exceeded", color=_BROKEN, marker="o", ms=3, ls=""))
    figure.legend(
        handles=handles, loc="outside lower left", ncols=len(handles), fontsize=8, frameon=False
    )
    return figure


def _columns(plant: Any) -> list[tuple[str, list[tuple[int, int, str]]]]:
    """Titles of the columns, and (0 state or 1 input, its index, label) of their panels."""
    if not isinstance(plant, Robot):
        system = plant.system
        states = [(0, i, label) for i, label in enumerate(system.state_labels)]
        return [
            ("states", states),
            ("inputs", [(1, i, label) for i, label in enumerate(system.input_labels)]),
        ]
    label = lambda name, unit: (
        f"{name}{' ' if len(name) < 8 else chr(10)}[{unit}]" if unit else name
    )
    half, names, units = plant.n // 2, plant.state_names, plant.state_units
    inputs = zip(plant.input_names, plant.input_units, strict=True)
    return [
        ("position", [(0, i, label(names[i], units[i])) for i in range(half)]),
        ("velocity", [(0, half + i, label(names[i], units[half + i])) for i in range(half)]),
        ("input", [(1, i, label(*both)) for i, both in enumerate(inputs)]),
    ]


def _draw_lines(
    ax: Axes, time: np.ndarray, values: np.ndarray, fallback: np.ndarray, broken: np.ndarray
) -> None:
    """Thin lines (samples, robots); samples in fallback and beyond limits on top of them."""
    held = len(values) < len(time)  # inputs, each held for a period
    if held:
        values, broken = (np.concatenate([v, v[-1:]]) for v in (values, broken))
    style: dict[str, Any] = {"drawstyle": "steps-post"} if held else {}
    alpha = float(np.clip(6 / values.shape[1], 0.35, 0.9))
    ax.plot(time, values, color=_RUN, lw=0.7, alpha=alpha, **style)
    # A sample's part of the line reaches to the next sample.
    part = np.zeros(values.shape, bool)
    part[:-1] |= fallback
    part[1:] |= fallback
    if part.any():
        ax.plot(time, np.where(part, values, np.nan), color=_OUTER, lw=0.8, **style)
    k, robot = np.nonzero(broken)
    ax.plot(time[k], values[k, robot], ".", color=_BROKEN, ms=2, zorder=4)


def _draw_limits(ax: Axes, ends: list[float], target: float | None) -> None:
    """Limits in full view, grey beyond them, and the set-point."""
    low, high = ax.get_ylim()
    finite = [end for end in ends if np.isfinite(end)]
    low, high = min([low, *finite]), max([high, *finite])
    room = 0.08 * (high - low)
    low, high = low - room, high + room
    for end, far in zip(ends, (low, high), strict=True):
        if np.isfinite(end):
            ax.axhspan(min(end, far), max(end, far), color=_INFEASIBLE, lw=0, zorder=0)
            ax.axhline(end, color="#8a8a8a", lw=0.7, zorder=1)
    if target is not None:
        ax.axhline(target, color=_TERMINAL, lw=0.9, ls=(0, (4, 2)), zorder=3)
    ax.set_ylim(low, high)
