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

# Okabe and Ito's palette: told apart with any colour vision, and in grey by lightness.
_INFEASIBLE, _FEASIBLE, _UNDECIDED = "#dddcd8", "#9fcbe6", "#f0d024"
_OUTER, _INNER, _TERMINAL = "#d55e00", "#00486b", "#006f52"


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
    _draw_labels(ax, points, label)
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


def _draw_labels(ax: Axes, points: np.ndarray, label: np.ndarray) -> None:
    """An image where the points are a grid, else small markers; undecided ones on top."""
    colours = ListedColormap([_INFEASIBLE, _UNDECIDED, _FEASIBLE])
    x, y = (np.unique(column) for column in points.T)
    is_grid = len(x) * len(y) == len(points) and min(len(x), len(y)) > 1
    if is_grid and np.array_equal(points[:, 0], np.repeat(x, len(y))):
        half = np.array([x[-1] - x[0], y[-1] - y[0]]) / (2 * np.array([len(x) - 1, len(y) - 1]))
        extent = (x[0] - half[0], x[-1] + half[0], y[0] - half[1], y[-1] + half[1])
        image = label.reshape(len(x), len(y)).T
        ax.imshow(
            image,
            cmap=colours,
            vmin=-1,
            vmax=1,
            extent=extent,
            origin="lower",
            aspect="auto",
            interpolation="nearest",
        )
        return
    size = float(np.clip(2e4 / len(points), 1.0, 30.0))
    for value, colour in ((-1, _INFEASIBLE), (1, _FEASIBLE), (0, _UNDECIDED)):
        x, y = points[label == value].T
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
    labels = fmap.mpc.system.state_labels
    others = [i for i in range(len(labels)) if i not in fmap.axes]
    what = f"Feasible initial states, horizon N = {fmap.mpc.horizon}"
    if not others:
        return what
    if fmap.fixed is None:
        return f"{what}\nprojection: some value of {', '.join(labels[i] for i in others)}"
    values = ", ".join(f"{labels[i]} = {float(fmap.fixed[i]):g}" for i in others)
    return f"{what}\nslice at {values}"
