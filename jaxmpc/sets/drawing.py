"""Sets of two and three dimensions, drawn by matplotlib.

A set is drawn by its vertices, an unbounded one by those of its part within the picture, an
ellipsoid by points of its boundary.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import scipy

from jaxmpc.checks import fail
from jaxmpc.sets.geometry import convex_hull

# Okabe and Ito's palette: distinct with any colour vision.
COLOURS = "#0072b2", "#d55e00", "#006f52", "#e69f00", "#cc79a7", "#56b4e9", "#000000", "#8a8a8a"
_MARGIN = 0.08  # of the picture round bounded sets, as a fraction of their size
_ON = 1e-7  # a corner lies on a row within this fraction of the set's size


def plot(*sets: Any, ax: Any = None, **style: Any) -> Any:
    """Draw sets of two or three dimensions into one picture, and return its axes.

    Arguments:
        sets: Boxes, Polytopes, Zonotopes and Ellipsoids of one dimension, 2 or 3. The first is
            drawn first.
        ax: axes of matplotlib, with projection="3d" for three dimensions; None for new ones.
        style: `color`, `alpha`, `label`, and else what matplotlib's polygons take. A list of
            `color`, `alpha` or `label` gives each set its own.

    An unbounded set is cut off at the border of the picture, without an edge there, and its label
    says so. Flat sets are drawn as lines and points, an empty one not at all. Needs matplotlib.
    """
    import matplotlib.pyplot as plt

    if not sets:
        fail("sets", "is empty", "Give one set or more")
    for one in sets:
        if not hasattr(one, "dimension"):
            fail("sets", f"hold a {type(one).__name__}", "Give Boxes, Polytopes, Ellipsoids, …")
    n = sets[0].dimension
    if n not in (2, 3) or any(s.dimension != n for s in sets):
        dims = ", ".join(str(s.dimension) for s in sets)
        fail("sets", f"have dimensions {dims}", "Draw sets of 2 or of 3; `project` or `slice` them")
    if ax is None:
        kind = {"projection": "3d"} if n == 3 else {}
        _, ax = plt.subplots(layout="constrained", subplot_kw=kind)
    if n == 3 and ax.name != "3d":
        fail("ax", "has two dimensions", "Make it by plt.subplots(subplot_kw={'projection': '3d'})")
    view, used = _view(sets, ax), _colors(ax)
    for i, one in enumerate(sets):
        if not one.is_empty():
            own = {key: _own(value, i, len(sets)) for key, value in style.items()}
            own.setdefault("color", COLOURS[(used + i) % len(COLOURS)])
            _draw(ax, one, view, **own)
    for k, (axis, (low, high)) in enumerate(zip("xyz"[:n], view.T, strict=True)):
        if ax.get_autoscale_on():
            getattr(ax, f"set_{axis}lim")(low, high, auto=None)
        if not getattr(ax, f"get_{axis}label")():
            getattr(ax, f"set_{axis}label")(f"$x_{k + 1}$")
    if ax.get_legend_handles_labels()[1]:
        # Beside the sets where the figure makes room for it.
        room = ax.figure.get_layout_engine() is not None
        ax.legend(**({"loc": "upper left", "bbox_to_anchor": (1.02, 1.0)} if room else {}))
    return ax


def _colors(ax: Any) -> int:
    """Return how many colors the axes show, so that the next set gets another one."""
    from matplotlib.colors import to_hex

    lines = [line.get_color() for line in ax.lines]
    return len({to_hex(color) for color in lines})


def _own(value: Any, i: int, count: int) -> Any:
    return value[i] if isinstance(value, list) and len(value) == count else value


def _view(sets: tuple[Any, ...], ax: Any) -> np.ndarray:
    """Return the corners (2, n) of the picture: the limits of the axes where they are set, else
    round all finite bounds of the sets and what the axes show already."""
    n = sets[0].dimension
    shown = np.sort([getattr(ax, f"get_{axis}lim")() for axis in "xyz"[:n]]).T
    if not ax.get_autoscale_on():
        return shown
    boxes = [np.array(s.bounding_box().bounds()) for s in sets if not s.is_empty()]
    ends = np.array(boxes).reshape(-1, n)
    finite = np.isfinite(ends)
    low = np.where(finite, ends, np.inf).min(axis=0, initial=np.inf)
    high = np.where(finite, ends, -np.inf).max(axis=0, initial=-np.inf)
    low, high = np.where(low <= high, [low, high], [[-1.0] * n, [1.0] * n])
    width = high - low
    if np.any(width == 0):
        width = np.where(width > 0, width, max(width.max(), 1.0))
    # Room beside the only bound that is finite.
    open_ended = np.any(~finite, axis=0) if len(ends) else np.ones(n, bool)
    room = np.where(open_ended, 0.5, _MARGIN) * width
    view = np.array([low - room, high + room])
    if ax.has_data():
        view = np.array([np.minimum(view[0], shown[0]), np.maximum(view[1], shown[1])])
    return view


def _corners(one: Any, view: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return the vertices to draw, and whether they are those of a set cut off by the view."""
    if one.is_bounded():
        return np.asarray(one.vertices()), False
    whole, n = one.to_polytope(), view.shape[1]
    H, h = whole.half_spaces()
    rows = np.vstack([H, np.eye(n), -np.eye(n)])
    offsets = np.concatenate([h, view[1], -view[0]])
    return replace(whole, H=rows, h=offsets, labels=()).vertices(), True


def _draw(
    ax: Any,
    one: Any,
    view: np.ndarray,
    *,
    color: Any,
    alpha: float = 0.3,
    label: Any = None,
    **style: Any,
) -> None:
    plane = view.shape[1] == 2
    if hasattr(one, "vertices"):
        V, cut = _corners(one, view)
    elif plane:
        V, cut = one.boundary(), False
    else:
        center, L = one._ball()
        u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 41), np.linspace(0, np.pi, 21))
        ball = np.array([np.cos(u) * np.sin(v), np.sin(u) * np.sin(v), np.cos(v)])
        surface = center[:, None, None] + np.tensordot(L, ball, 1)
        ax.plot_surface(*surface, color=color, alpha=alpha, label=label, **style)
        return
    label = f"{label} (unbounded)" if cut and label else label
    if len(V) == 0:
        return
    faces = polygons(V) if not plane else [V] if len(V) > 2 else None
    if faces is None:  # a segment or a point
        marker = {"marker": "o", "markersize": 4} if len(V) == 1 else {}
        ax.plot(*V.T, color=color, label=label, **marker)
        return
    width = np.ptp(view, axis=0)
    if not plane:
        from mpl_toolkits.mplot3d.art3d import Poly3DCollection

        sides = [
            (np.abs(face[:, None] - view) <= _ON * width).all(axis=0).any() if cut else False
            for face in faces
        ]
        kept = [face for face, on in zip(faces, sides, strict=True) if not on]
        lines = {"facecolor": color, "edgecolor": color, "linewidth": 0.7}
        ax.add_collection3d(Poly3DCollection(kept, **lines, alpha=alpha, label=label, **style))
        return
    ax.fill(*V.T, facecolor=color, alpha=alpha, edgecolor="none", label=label, **style)
    ring = np.vstack([V, V[:1]])
    if not cut:
        ax.plot(*ring.T, color=color, linewidth=1.2)
        return
    for start, end in zip(ring[:-1], ring[1:], strict=True):
        sides = np.abs(np.array([start, end]) - view[:, None]) <= _ON * width
        if not sides.all(axis=1).any():  # not both ends on one side of the picture
            ax.plot(*np.array([start, end]).T, color=color, linewidth=1.2)


def polygons(V: np.ndarray) -> list[np.ndarray] | None:
    """Return the polygons, corners in order, that bound the hull of points (k, 3); the polygon
    itself if they lie in a plane, None if in a line."""
    center, scale = V.mean(axis=0), np.ptp(V, axis=0)
    S = (V - center) / np.where(scale > 0, scale, 1.0)
    _, widths, axes = np.linalg.svd(S, full_matrices=False)
    flat = len(widths) < 3 or widths[2] <= 1e-9 * widths[0]
    if flat and (len(widths) < 2 or widths[1] <= 1e-9 * widths[0]):
        return None
    if flat:
        return [V[_around(S @ axes[:2].T)]]
    try:
        normals = np.unique(np.round(convex_hull(S)[0].equations, 9), axis=0)
    except scipy.spatial.QhullError:
        return None
    found = []
    for *normal, offset in normals:
        on = np.flatnonzero(np.abs(S @ normal + offset) <= 1e-7)
        _, _, plane = np.linalg.svd(np.array(normal)[None])
        found.append(V[on][_around(S[on] @ plane[1:].T)])
    return found


def _around(P: np.ndarray) -> np.ndarray:
    """Return the order of the corners (k, 2) of a polygon round it."""
    return np.argsort(np.arctan2(*(P - P.mean(axis=0)).T))
