"""The plot of a map of two states: labels, proved bounds and terminal set."""

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes

from jaxmpc.app.plots.style import (
    FEASIBLE,
    INFEASIBLE,
    UNDECIDED,
    draw_bounds,
    draw_values,
    finish,
    new_axes,
    patch,
)
from jaxmpc.checks import fail
from jaxmpc.feasible.map import FeasibleSetMap
from jaxmpc.feasible.stored import Picture


def plot_feasible_set(
    fmap: FeasibleSetMap, ax: Axes | None = None, picture: Picture | None = None
) -> Axes:
    """Draw a map of two states: labels, proved boundaries and terminal set.

    Samples are coloured by label. The dashed line bounds the inner polytope (the convex hull of
    states with a checked plan), the solid one the outer polytope (the intersection of certified
    half-spaces); the true boundary lies between them. Without `ax` a new figure is made; save it
    with `ax.figure.savefig(path)`. picture: of a stored map, instead of the map's points. Raises
    ValueError for a map not of two states.
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
    handles += draw_bounds(ax, fmap)
    finish(ax, fmap.axis_names, _map_title(fmap), handles)
    return ax


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
