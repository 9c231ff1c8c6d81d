"""Maps of two states: a feasible set, a robot map, recursive feasibility."""

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from jaxmpc.app.plots.style import (
    COLUMN,
    FEASIBLE,
    GRID,
    INFEASIBLE,
    INNER,
    NOT_SOLVED,
    OUTER,
    TERMINAL,
    UNDECIDED,
    Style,
    for_column,
    patch,
)
from jaxmpc.checks import fail
from jaxmpc.feasible.map import FeasibleSetMap
from jaxmpc.feasible.stored import Picture
from jaxmpc.recursion.counterexamples import Counterexample
from jaxmpc.recursion.report import RecursionReport
from jaxmpc.robot_maps.robot_map import RobotMap
from jaxmpc.sets.convex_sets import Polytope
from jaxmpc.sets.drawing import plot
from jaxmpc.sets.geometry import convex_hull, hull_volume


def plot_feasible_set(
    fmap: FeasibleSetMap, ax: Axes | None = None, picture: Picture | None = None
) -> Axes:
    """Draw a map of two states: labels, proved boundaries and terminal set.

    Samples are coloured by label. The dashed line bounds the inner polytope (the convex hull of
    states with a checked plan), the solid one the outer polytope (the intersection of certified
    half-spaces); the true boundary lies between them. Cells of a grid end at the bounds, for all
    states within the inner one are feasible, and none beyond the outer one is. Without `ax` a new
    figure is made; save it with `ax.figure.savefig(path)`. picture: of a stored map, instead of the
    map's points. Raises ValueError for a map not of two states.
    """
    points, label, counts = np.asarray(fmap.x0s), np.asarray(fmap.label), None
    if picture is not None:
        points, label, counts = picture
    if points.ndim != 2 or points.shape[1] != 2:
        fail("fmap", f"maps {points.shape[-1]} states", "A plot needs 2: choose `axes`")
    ax = new_axes() if ax is None else ax
    draw_values(ax, points, label, {-1: INFEASIBLE, 1: FEASIBLE, 0: UNDECIDED})
    handles: list[Artist] = [
        patch(name, colour, count)
        for value, name, colour in (
            (1, "feasible", FEASIBLE),
            (-1, "infeasible", INFEASIBLE),
            (0, "undecided", UNDECIDED),
        )
        if (count := counts[name] if counts else np.count_nonzero(label == value))
    ]
    if ax.images:
        ax.fill(*ring(fmap.inner).T, color=FEASIBLE, linewidth=0)
        _paint_beyond(ax, ring(fmap.outer))
    handles += draw_bounds(ax, fmap)
    few = np.flatnonzero(label == 0)
    if len(few) <= 0.02 * len(label):  # on the lines of the bounds, which would hide them
        ax.plot(*points[few].T, "s", color=UNDECIDED, markersize=2, zorder=5)
    finish(ax, fmap.axis_names, _map_title(fmap), handles)
    return ax


def _paint_beyond(ax: Axes, corners: np.ndarray) -> None:
    """Paint what lies beyond a convex polygon (k, 2) as infeasible, to the ends of the axes."""
    if not len(corners):
        return
    ends = np.array([*zip(ax.get_xlim(), ax.get_ylim(), strict=True), *corners])
    (left, low), (right, high) = ends.min(axis=0), ends.max(axis=0)
    frame = [(left, low), (right, low), (right, high), (left, high), (left, low)]
    # A hole winds the other way round than what it is a hole of.
    x, y = corners.T
    clockwise = np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) < 0
    hole = Path(corners if clockwise else corners[::-1], closed=True)
    around = Path.make_compound_path(Path(frame, closed=True), hole)
    ax.add_artist(PathPatch(around, facecolor=INFEASIBLE, linewidth=0))


def plot_body(fmap: FeasibleSetMap) -> Figure:
    """Draw the feasible set of three states: its inner bound as a body in space, and inner and
    outer bound as they are projected onto each pair of states.

    fmap: refined (`FeasibleSetMap.refine`), which brings the bounds together: blue is proved
    feasible, yellow lies between the bounds. Where there is no inner bound
    the body is the outer one. Raises ValueError for a map not of three states, and where neither
    bound is a bounded body.
    """
    names, small = fmap.axis_names, for_column()
    if len(names) != 3:
        fail("fmap", f"maps {len(names)} states", "A body needs 3: choose `axes`")
    inner, outer = _corners(fmap.inner, 3), _corners(fmap.outer, 3)
    if not len(inner) and not len(outer):
        fail("fmap", "has no bounded body to draw", "Refine it, or map a set with an interior")
    figure = Figure(figsize=(COLUMN, 5.6) if small else (9.6, 8.0), layout="constrained")
    grid = figure.add_gridspec(3 if small else 2, 2)
    space = figure.add_subplot(grid[0, :] if small else grid[0, 0], projection="3d")
    body, colour = (fmap.inner(), INNER) if len(inner) else (fmap.outer(), OUTER)
    plot(body, ax=space, color=colour, alpha=0.35)
    for axis, name in zip("xyz", names, strict=True):
        getattr(space, f"set_{axis}label")(name, fontsize=7 if small else 9)
    figure.suptitle(_map_title(fmap), x=0.01, ha="left", fontsize=8 if small else 11)
    share = ""
    if len(inner) and len(outer):
        share = f" ({hull_volume(inner) / hull_volume(outer):.1%} of it)"
    lines: list[tuple[np.ndarray, str, Style]] = [
        (outer, "outer bound", {"color": OUTER, "lw": 2.4}),
        (inner, f"inner bound{share}", {"color": INNER, "lw": 1.4, "ls": (0, (3, 3))}),
    ]
    places = (grid[1, 0], grid[1, 1], grid[2, 0]) if small else (grid[0, 1], grid[1, 0], grid[1, 1])
    for place, (i, j) in zip(places, ((0, 1), (0, 2), (1, 2)), strict=True):
        ax = figure.add_subplot(place)
        for corners, _, style in lines:
            if len(corners):
                shadow = corners[:, [i, j]]
                hull, kept = convex_hull(shadow / np.ptp(shadow, axis=0))
                around = shadow[kept[hull.vertices]]
                ax.fill(*around.T, color=FEASIBLE if corners is inner else UNDECIDED, lw=0)
                ax.plot(*np.vstack([around, around[:1]]).T, solid_joinstyle="round", **style)
        ax.set_xlabel(names[i])
        ax.set_ylabel(names[j])
        ax.set_title("projection", loc="left", fontsize=7 if small else 9)
        ax.grid(**GRID)
    for ax in figure.axes:
        ax.tick_params(labelsize=6 if small else 9)
    handles = [Line2D([], [], label=name, **style) for _, name, style in lines]
    figure.legend(handles=handles, loc="outside lower left", ncols=2, frameon=False)
    return figure


def _corners(make: Callable[[], Polytope | None], d: int) -> np.ndarray:
    """Return the vertices (k, d) of a body; none if there is none, or it is flat or unbounded."""
    try:
        polytope = make()
        return np.zeros((0, d)) if polytope is None else polytope.require_body().vertices()
    except ValueError:
        return np.zeros((0, d))


def _map_title(fmap: FeasibleSetMap) -> str:
    """Return what is shown, and for more than two states how the others are treated."""
    labels = fmap.mpc.labels if fmap.mpc.rate_limited else fmap.mpc.system.state_labels
    others = [i for i in range(len(labels)) if i not in fmap.axes]
    what = f"Feasible initial states, horizon N = {fmap.mpc.horizon}"
    if not others:
        return what
    if fmap.fixed is None:
        return f"{what}\nprojection: some value of {', '.join(labels[i] for i in others)}"
    values = ", ".join(f"{labels[i]} = {float(fmap.fixed[i]):g}" for i in others)
    return f"{what}\nslice at {values}"


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
    handles = draw_outcomes(ax, points, _outcomes(rmap))
    linear = rmap.linear
    ax.autoscale_view()  # before what is drawn next
    ax.autoscale(False)
    handles += draw_bounds(ax, linear, "linear feasible set, ")
    cross: Style = {"marker": "+", "ms": 9, "mew": 1.6, "color": "black"}
    marks = [(rmap.set_point[list(linear.axes)], "set-point", cross)]
    worst = rmap.worst()
    if worst is not None:
        unit = rmap.robot.time_unit
        name = f"deepest failure,\nfails after {rmap.first_loss[worst] * rmap.robot.dt:.3g} {unit}"
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
    unit = rmap.robot.time_unit
    steps = f"N = {mpc.horizon} steps of {rmap.robot.dt:g} {unit}"
    first = f"{name}: {what} for {rmap.seconds:g} {unit}?\n{steps}"
    labels = mpc.system.state_labels
    others = [i for i in range(len(labels)) if i not in rmap.linear.axes]
    fixed = rmap.linear.fixed
    if not others or fixed is None:
        return first
    values = [f"{labels[i]} = {fixed[i]:.4g}" for i in others]
    shown = ", ".join(values) if len(values) <= 4 else f"{len(values)} other coordinates as fixed"
    return f"{first}, slice at {shown}"


# States lost at step 1, 2, 3, 4-5, 6-10, later: from dark to light.
LOST = ("#7a0403", "#b5290a", "#dd5a13", "#f28b30", "#f9b867", "#fbe0ad")


def draw_recursion(report: RecursionReport) -> Figure:
    """Draw `plot_recursion`, and beside it the counterexample enlarged where there is one."""
    panels = 1 if report.counterexample is None else 2
    size, shape = (8.4 if panels == 1 else 13, 5.2), (1, panels)
    if for_column():
        size, shape = (COLUMN, 4.2 * panels), (panels, 1)
    figure = Figure(figsize=size, layout="constrained")
    for k, ax in enumerate(figure.subplots(*shape, squeeze=False).ravel()):
        plot_recursion(report, ax, enlarge=k == 1)
    return figure


def plot_recursion(
    report: RecursionReport, ax: Axes | None = None, *, enlarge: bool = False
) -> Axes:
    """Draw which states of a two-state problem lose feasibility, and the worst counterexample.

    Samples are coloured by the step of the closed loop at which the problem is proved infeasible.
    The line round them is the feasible set X_N. The arrow leads from the counterexample to its
    next state; the dashed line is the half-space that holds on all of X_N and excludes it.

    report: of `recursive_feasibility`.
    enlarge: show the neighbourhood of the counterexample, with X_N filled and without samples.

    X_N is filled also where there are no samples. Without `ax` a new figure is made. Raises
    ValueError for other than two states, for enlarge without a counterexample, and where there is
    neither set, sample nor counterexample.
    """
    if report.loops.x0s.shape[1] != 2:
        fail("report", f"is of {report.loops.x0s.shape[1]} states", "A plot needs 2")
    worst, corners = report.counterexample, ring(lambda: report.feasible_set)
    if worst is None and not len(corners) and not len(report.loops.x0s):
        fail("report", "holds nothing to draw", "Give more seconds, or states to follow")
    if enlarge and worst is None:
        fail("enlarge", "without a counterexample there is nothing to enlarge", "Leave it out")
    ax = new_axes() if ax is None else ax
    handles: list[Artist] = []
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
            shown = corners if len(corners) else np.vstack([ends, report.loops.x0s])
            unit = np.ptp(shown, axis=0)  # of one axis says nothing of the other
            unit = np.where(unit > 0, unit, 1.0)
            apart = np.ptp(ends, axis=0) / unit
            room = 0.6 * unit * np.maximum(apart, 0.15 * np.max(apart))
            (x_low, y_low), (x_high, y_high) = ends.min(axis=0) - room, ends.max(axis=0) + room
            ax.set(xlim=(x_low, x_high), ylim=(y_low, y_high))
        handles += _draw_counterexample(ax, worst)
    title = f"Closed loops of {report.loops.steps} steps, horizon N = {report.mpc.horizon}"
    if not len(report.loops.x0s):
        verdict = {True: "kept for ever", False: "not all kept", None: "not followed"}
        title = f"Feasible states, {verdict[report.law.holds]}, horizon N = {report.mpc.horizon}"
    if enlarge and worst is not None:
        title = f"Worst counterexample: next state outside X_{report.mpc.horizon}"
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
    if 0 < np.count_nonzero(lost > 0) < 0.01 * len(lost):  # too few to be seen as cells
        for _, colour, where in outcomes[3:]:
            x, y = report.loops.x0s[where].T
            ax.scatter(x, y, s=14, color=colour, edgecolors="white", linewidths=0.4, zorder=3)
    return draw_outcomes(ax, report.loops.x0s, outcomes)


def _draw_counterexample(ax: Axes, worst: Counterexample) -> list[Artist]:
    """Draw the arrow x → x⁺ and, across the part of the plane in view, the line a'x = b."""
    (x_low, x_high), (y_low, y_high) = ax.get_xlim(), ax.get_ylim()  # of all that is drawn
    ax.autoscale(False)
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


def new_axes(width: float = 8.4) -> Axes:
    """Return the axes of a new figure, with room for a legend on the right, in a column below."""
    size = (width, 4.8) if not for_column() else (COLUMN, 3.6)
    return Figure(figsize=size, layout="constrained").add_subplot()


def draw_bounds(ax: Axes, fmap: FeasibleSetMap, of: str = "") -> list[Line2D]:
    """Draw terminal set, outer and inner bound of a map of two states; return legend entries."""
    handles = []
    lines: tuple[tuple[Callable[[], Polytope | None], str, Style], ...] = (
        (fmap.terminal_section, "terminal set", {"color": TERMINAL, "lw": 1.8}),
        (fmap.outer, f"{of}outer bound", {"color": OUTER, "lw": 2.4}),
        (fmap.inner, f"{of}inner bound", {"color": INNER, "lw": 1.4, "ls": (0, (3, 3))}),
    )
    for make, name, style in lines:
        corners = ring(make)
        if len(corners):
            ax.plot(*corners.T, solid_joinstyle="round", **style)
            handles.append(Line2D([], [], label=name, **style))
    return handles


# Letters of a legend's words of which two columns fit into a column of a paper.
SHORT = 26


def finish(ax: Axes, names: Sequence[str], title: str, handles: list[Artist]) -> None:
    """Name the two axes, and set the title and, to the right of the axes, the legend; for a column
    below them."""
    ax.set_xlabel(names[0])
    ax.set_ylabel(names[1])
    ax.set_title(title, loc="left", fontsize=8 if for_column() else 11)
    where: Style = {"loc": "upper left", "bbox_to_anchor": (1.02, 1.0)}
    if for_column():
        words = [line for handle in handles for line in str(handle.get_label()).split("\n")]
        columns = 2 if max(map(len, words), default=0) < SHORT else 1
        where = {"loc": "upper left", "bbox_to_anchor": (-0.02, -0.18), "fontsize": 7}
        where |= {"ncols": columns}
    if handles:
        ax.legend(handles=handles, frameon=False, handlelength=2.4, **where)


def draw_outcomes(
    ax: Axes, points: np.ndarray, outcomes: Sequence[tuple[str, str, np.ndarray]]
) -> list[Artist]:
    """Colour points (B, 2) by outcome: words, colour and which points, (B,). Return the legend
    entries of those that there are."""
    which = np.zeros(len(points), int)
    for i, (_, _, where) in enumerate(outcomes):
        which[where] = i
    draw_values(ax, points, which, {i: colour for i, (_, colour, _) in enumerate(outcomes)})
    return [
        patch(name, colour, count)
        for name, colour, where in outcomes
        if (count := np.count_nonzero(where))
    ]


def draw_values(ax: Axes, points: np.ndarray, value: np.ndarray, colours: dict[int, str]) -> None:
    """Colour points (B, 2) by value (B,): an image where they are a grid, else small markers.

    The last of `colours` lies on top.
    """
    x, y = (np.unique(column) for column in points.T)
    is_grid = len(x) * len(y) == len(points) and min(len(x), len(y)) > 1
    # Different points, as many as there are pairs (x, y), are all of these.
    is_grid = is_grid and len(np.unique(points, axis=0)) == len(points)
    even = lambda v: np.allclose(np.diff(v), np.ptp(v) / (len(v) - 1), atol=0)
    if is_grid and even(x) and even(y):
        value = value[np.lexsort(points.T[::-1])]
        half = np.array([x[-1] - x[0], y[-1] - y[0]]) / (2 * np.array([len(x) - 1, len(y) - 1]))
        extent = (x[0] - half[0], x[-1] + half[0], y[0] - half[1], y[-1] + half[1])
        ax.imshow(
            value.reshape(len(x), len(y)).T,
            cmap=ListedColormap([colour for _, colour in sorted(colours.items())]),
            vmin=min(colours),
            vmax=max(colours),
            extent=extent,
            origin="lower",
            aspect="auto",
            interpolation="nearest",
        )
        return
    size = float(np.clip(2e4 / max(len(points), 1), 1.0, 30.0))
    for key, colour in colours.items():
        x, y = points[value == key].T
        ax.scatter(x, y, s=size, color=colour, linewidths=0)
    ax.margins(0.02)


def ring(make: Callable[[], Polytope | None]) -> np.ndarray:
    """Return the vertices of a polygon, the first again at the end; (0, 2) if there is none."""
    corners = _corners(make, 2)
    return np.vstack([corners, corners[:1]])
