"""Colours and drawing functions that the plots share. No function shows a window."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from matplotlib import font_manager, rcParams
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text

from jaxmpc.feasible.map import FeasibleSetMap
from jaxmpc.sets.polytope import Polytope

# Okabe and Ito's palette: distinct with any colour vision, and in grey by lightness.
INFEASIBLE, FEASIBLE, UNDECIDED = "#dddcd8", "#9fcbe6", "#f0d024"
OUTER, INNER, TERMINAL = "#d55e00", "#00486b", "#006f52"
# Plans that the solver did not solve: they say nothing about limits.
NOT_SOLVED = "#a05fa8"
EDGE = "#8a8a8a"


# Keyword arguments of Matplotlib.
Style = dict[str, Any]


def new_axes(width: float = 8.4) -> Axes:
    """Return the axes of a new figure, with room for a legend on the right."""
    return Figure(figsize=(width, 4.8), layout="constrained").add_subplot()


def save(figure: Any, path: Path | BinaryIO, name: str = "") -> None:
    """Write a figure, cut to its content. name: of the system, put before the first title.

    Letters that the usual font lacks are drawn with fonts that are installed and have them.
    """
    if name and (title := figure.axes[0].get_title(loc="left")):
        text = f"{name}: {title[0].lower()}{title[1:]}"
        figure.axes[0].set_title(text, loc="left", fontsize=11)
    texts = [t for t in figure.findobj(Text) if not t.get_text().isascii()]
    families = [*rcParams["font.sans-serif"][:1], *_fonts_for("".join(t.get_text() for t in texts))]
    for found in texts:
        found.set_fontfamily(families)
    figure.savefig(path, dpi=150, bbox_inches="tight", pad_inches=0.15)


def _fonts_for(text: str) -> list[str]:
    """Return installed fonts that together have the letters that Matplotlib's own lacks."""
    own = font_manager.get_font(font_manager.findfont(rcParams["font.sans-serif"][0]))
    missing = {ord(letter) for letter in text if letter.isprintable()} - set(own.get_charmap())
    found = []
    for entry in font_manager.fontManager.ttflist if missing else ():
        if entry.weight != 400 or entry.style != "normal":
            continue
        has = missing & set(font_manager.get_font(entry.fname).get_charmap())
        if has:
            missing -= has
            found.append(entry.name)
        if not missing:
            break
    return found


def patch(name: str, colour: str, count: Any = None) -> Patch:
    """Return a legend entry for an area, with the number of samples that it stands for."""
    label = name if count is None else f"{name} ({count:,})"
    return Patch(facecolor=colour, edgecolor=EDGE, linewidth=0.6, label=label)


def legend(ax: Axes, handles: list[Artist]) -> None:
    """Put the legend to the right of the axes."""
    ax.legend(
        handles=handles,
        loc="upper left",
        bbox_to_anchor=(1.02, 1.0),
        frameon=False,
        handlelength=2.4,
    )


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


def finish(ax: Axes, names: Sequence[str], title: str, handles: list[Artist]) -> None:
    """Name the two axes, and set the title and the legend."""
    ax.set_xlabel(names[0])
    ax.set_ylabel(names[1])
    ax.set_title(title, loc="left", fontsize=11)
    legend(ax, handles)


def draw_values(ax: Axes, points: np.ndarray, value: np.ndarray, colours: dict[int, str]) -> None:
    """Colour points (B, 2) by value (B,): an image where they are a grid, else small markers.

    The last of `colours` lies on top.
    """
    x, y = (np.unique(column) for column in points.T)
    is_grid = len(x) * len(y) == len(points) and min(len(x), len(y)) > 1
    if is_grid and np.array_equal(points[:, 0], np.repeat(x, len(y))):
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
    size = float(np.clip(2e4 / len(points), 1.0, 30.0))
    for key, colour in colours.items():
        x, y = points[value == key].T
        ax.scatter(x, y, s=size, color=colour, linewidths=0)
    ax.margins(0.02)


def ring(make: Callable[[], Polytope | None]) -> np.ndarray:
    """Return the vertices of a polygon, the first again at the end; (0, 2) if there is none."""
    try:
        polytope = make()
        corners = np.zeros((0, 2)) if polytope is None else polytope.vertices()
    except ValueError:  # not bounded yet, or without interior: nothing to draw
        return np.zeros((0, 2))
    return np.vstack([corners, corners[:1]])
