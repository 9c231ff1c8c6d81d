"""Whether each panel of a picture shows something."""

import numpy as np


def require_no_empty_panel(figure):
    """Raise AssertionError for a panel in which nothing of what is shown lies.

    Limits and set-points that go across a panel are no content; nor is a line of which no two
    neighbours are finite, unless it has markers.
    """
    for number, ax in enumerate(figure.axes):
        if ax.axison and not any(map(is_seen, [*ax.lines, *ax.collections, *ax.images, *ax.texts])):
            if not any(map(is_area, ax.patches)):
                raise AssertionError(f"panel {number}, {ax.get_ylabel()!r}, is empty")


def is_seen(artist):
    """Return whether a part of the artist lies within its axes."""
    ax = artist.axes
    if not hasattr(artist, "get_xydata"):  # an image, a text, areas, or a body in space
        return artist.get_visible()
    x, y = artist.get_xydata().T
    of_data = artist.get_transform().contains_branch_seperately(ax.transData)
    if of_data != (True, True) or not artist.get_visible():
        return False
    (left, right), (low, high) = sorted(ax.get_xlim()), sorted(ax.get_ylim())
    inside = np.isfinite(x) & np.isfinite(y) & (left <= x) & (x <= right) & (low <= y) & (y <= high)
    if artist.get_marker() not in ("None", None, "", " "):
        return inside.any()
    finite = np.isfinite(x) & np.isfinite(y)
    return bool(np.any(finite[1:] & finite[:-1] & (inside[1:] | inside[:-1])))


def is_area(patch):
    """Return whether a patch lies at coordinates of the data, such as a filled polygon, not a strip
    across the panel."""
    return patch.get_transform().contains_branch_seperately(patch.axes.transData) == (True, True)
