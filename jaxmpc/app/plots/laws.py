"""Explicit laws of two parameters, or slices of more: their regions, law and value."""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection

from jaxmpc.app.plots.maps import finish, new_axes
from jaxmpc.app.plots.style import EDGE
from jaxmpc.arrays import Reals, host_array
from jaxmpc.checks import fail, require_finite, require_kind, require_shape
from jaxmpc.explicit.parametric_program import ParametricQP
from jaxmpc.explicit.regions import CriticalRegions
from jaxmpc.sets.convex_sets import Polytope

# Points along each axis at which law and value are drawn.
GRID = 240


def plot_regions(
    regions: CriticalRegions,
    ax: Axes | None = None,
    *,
    show: Literal["regions", "law", "value"] = "regions",
    output: int = 0,
    axes: tuple[int, int] = (0, 1),
    fixed: Reals | None = None,
    limits: Reals | None = None,
) -> Axes:
    """Draw the critical regions of two parameters, with the law or the value on them.

    regions: of `critical_regions`.
    show: "regions" colours each by the number of its active rows, "law" by an output, such as the
    first input, "value" by the least cost. output: the number of that output. axes: the two
    parameters. fixed (p,): values of the others, for a slice; None: zero. limits ((low, high),
    (low, high)): of the picture; None: around the vertices of all regions. Without `ax` a new
    figure is made.

    Raises ValueError for fewer than two parameters and for wrong arguments.
    """
    cure = "Give what jm.explicit.critical_regions(mpc) returns"
    require_kind("regions", regions, CriticalRegions, cure=cure)
    p, names = regions.problem.dimension, regions.problem.labels
    if p < 2 or len(set(axes)) != 2 or not all(0 <= i < p for i in axes):
        fail("axes", f"{axes} of {p} parameters", "Give two different parameters")
    if show not in ("regions", "law", "value"):
        fail("show", f"{show!r}", 'Give "regions", "law" or "value"')
    outputs = len(regions[0].k)
    if not 0 <= output < outputs:
        fail("output", f"{output} of {outputs}", f"Give a number from 0 to {outputs - 1}")
    theta = np.zeros(p) if fixed is None else host_array("fixed", fixed)
    require_shape("fixed", theta, (p,), "One value for each parameter; those at axes are ignored")
    require_finite("fixed", theta)
    frame = default_limits(regions, list(axes)) if limits is None else host_array("limits", limits)
    require_shape("limits", frame, (2, 2), "Give ((low, high), (low, high))")
    ax = new_axes() if ax is None else ax
    parts = [section(region.polytope, list(axes), theta, frame) for region in regions.regions]
    seen = [i for i, part in enumerate(parts) if len(part) > 2]
    polygons = PolyCollection([parts[i] for i in seen], edgecolors=EDGE, linewidths=0.6)
    if show == "regions":
        polygons.set_array(np.array([len(regions[i].rows) for i in seen]))
        polygons.set_cmap("YlGnBu")
        polygons.set_clim(-0.5, max(len(regions[i].rows) for i in range(len(regions))) + 1.5)
        ax.add_collection(polygons)
        title = f"{len(seen)} critical regions, darker where more rows are active"
    else:
        lines = [np.linspace(low, high, GRID) for low, high in frame]
        points = np.tile(theta, (GRID * GRID, 1))
        points[:, list(axes)] = np.stack(np.meshgrid(*lines), axis=-1).reshape(-1, 2)
        values = regions.value(points) if show == "value" else regions.law(points)[:, output]
        image = ax.pcolormesh(*lines, values.reshape(GRID, GRID), cmap="viridis", shading="nearest")
        image.set_rasterized(True)
        what = "Least cost" if show == "value" else name_of_output(regions, output)
        bar = ax.figure.colorbar(image, ax=ax, label=f"{what[0].lower()}{what[1:]}", pad=0.02)
        bar.outline.set_linewidth(0.6)
        polygons.set_facecolor("none")
        ax.add_collection(polygons)
        title = f"{what} on {len(seen)} critical regions"
    ax.set(xlim=frame[0], ylim=frame[1])
    others = [i for i in range(p) if i not in axes]
    if others:
        values_at = ", ".join(f"{names[i]} = {theta[i]:.4g}" for i in others[:4])
        title += f"\nslice at {values_at}"
    finish(ax, [names[i] for i in axes], title, [])
    return ax


def name_of_output(regions: CriticalRegions, output: int) -> str:
    """Return what an output of the law is called."""
    if isinstance(regions.problem, ParametricQP):
        return f"Law {output + 1}"
    return f"First input {regions.problem.system.input_labels[output]}"


def default_limits(regions: CriticalRegions, axes: list[int]) -> np.ndarray:
    """Return limits (2, 2) around the vertices of all regions, of an unbounded set without those on
    the sides of the window."""
    points = np.concatenate([region.vertices for region in regions.regions])[:, axes]
    low, high = points.min(axis=0), points.max(axis=0)
    if regions.window is not None:
        middle = (low + high) / 2
        near = np.abs(points - middle) < (high - low) / 4
        inner = points[near.all(axis=1)]
        if len(inner):
            half = 1.5 * np.ptp(inner, axis=0) / 2
            center = (inner.min(axis=0) + inner.max(axis=0)) / 2
            half = np.where(half > 0, half, (high - low) / 8)
            low, high = center - half, center + half
    room = 0.03 * (high - low)
    return np.column_stack([low - room, high + room])


def section(
    polytope: Polytope, axes: list[int], theta: np.ndarray, frame: np.ndarray
) -> np.ndarray:
    """Return the corners (k, 2) of the section of a polytope along two axes at θ within a frame,
    clipped side by side (Sutherland & Hodgman 1974); fewer than three where it is empty."""
    H, h = polytope.half_spaces()
    rest = np.delete(np.arange(len(theta)), axes)
    h = h - H[:, rest] @ theta[rest]
    corners = np.array([[frame[0, i], frame[1, j]] for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))])
    room = 1e-9 * np.abs(H[:, axes]) @ np.ptp(frame, axis=1)
    for normal, offset in zip(H[:, axes], h + room, strict=True):
        corners = clipped(corners, normal, offset)
    return corners


def clipped(corners: np.ndarray, normal: np.ndarray, offset: float) -> np.ndarray:
    """Return the corners of the part of a polygon (k, 2) with normal'x ≤ offset."""
    room = offset - corners @ normal
    found: list[Sequence[float] | np.ndarray] = []
    for i in range(len(corners)):
        j = (i + 1) % len(corners)
        if room[i] >= 0:
            found.append(corners[i])
        if (room[i] >= 0) != (room[j] >= 0):
            found.append(corners[i] + room[i] / (room[i] - room[j]) * (corners[j] - corners[i]))
    return np.array(found).reshape(-1, 2)
