"""Regular grids of states: their points; axes by name, ends by limits."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from jaxmpc.arrays import Reals, host_array
from jaxmpc.checks import fail, require_memory, whole


def grid(lower: Reals, upper: Reals, shape: int | Sequence[int]) -> np.ndarray:
    """Return the points of a regular grid, end points included: (Π shape, d), first coordinate
    slowest. A number among lower, upper (d,) and shape (d,) holds along each axis.

    Raises ValueError for what is no grid, and for one that does not fit into memory.
    """
    given = (host_array("grid lower", lower), host_array("grid upper", upper), np.asarray(shape))
    d = max(np.size(value) for value in given)
    lower, upper, sizes = (v if v.ndim else np.full(d, v) for v in given)
    shape = tuple(whole("grid shape", k, 1) for k in sizes.ravel().tolist())
    if not shape or not lower.shape == upper.shape == (len(shape),):
        fail("grid", f"lower {lower.shape}, upper {upper.shape}, shape {shape}", "Same length each")
    if not (np.all(np.isfinite(lower)) and np.all(np.isfinite(upper)) and np.all(lower <= upper)):
        fail("grid", f"lower {lower}, upper {upper}", "Give finite lower ≤ upper")
    _require_memory(shape)  # before the lines, of which one alone may be too long
    lines = [np.linspace(*ends) for ends in zip(lower, upper, shape, strict=True)]
    return mesh(lines)


def mesh(lines: Sequence[np.ndarray], index: np.ndarray | None = None) -> np.ndarray:
    """Return the points (B, d) of a grid with these d coordinates, the first one slowest; index
    (k,): only these of them, which needs no memory for the others. Raises ValueError for a grid
    that does not fit into memory."""
    if index is None:
        _require_memory([len(line) for line in lines])
        return np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, len(lines))
    place = np.unravel_index(index, [len(line) for line in lines])
    return np.stack([line[i] for line, i in zip(lines, place, strict=True)], axis=-1)


def _require_memory(shape: Sequence[int]) -> None:
    require_memory("grid", 16 * len(shape) * math.prod(shape), "Give fewer points")


def axis_indices(
    where: str, what: str, given: Sequence[int | str], names: Sequence[str], n: int
) -> tuple[int, ...]:
    """Return the indices of axes that are given by name or by index below n.

    where, what: the option and the kind of axis, for the ValueError that is raised for an axis
    which does not exist or is repeated.
    """
    names = list(names)
    known = f"{what.capitalize()}s are {', '.join(map(str, [*names, *range(n)]))}"
    axes = []
    for axis in given:
        i = names.index(str(axis)) if axis in names else int(axis) if f"{axis}".isdecimal() else -1
        if not 0 <= i < n:
            fail(where, f"no {what} {axis!r}", known)
        axes.append(i)
    if not axes or len(set(axes)) != len(axes):
        fail(where, f"{list(given)} repeats a {what} or is empty", known)
    return tuple(axes)


def grid_ends(
    where: str,
    lower: Sequence[float] | None,
    upper: Sequence[float] | None,
    limits: Callable[[], tuple[np.ndarray, ...]],
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of a grid: as given, else the limits widened by 3 % on each side.

    where: what stands before lower and upper in the ValueError that is raised where an end is not
    finite, or lower not below upper.
    """
    ends = limits() if lower is None or upper is None else (lower, upper)
    low, high = (np.asarray(end, float) for end in ends)
    room = 0.03 * np.where(np.isfinite(low) & np.isfinite(high), high - low, 0.0)
    low = np.asarray(low - room if lower is None else lower)
    high = np.asarray(high + room if upper is None else upper)
    if not np.all(np.isfinite([low, high])):
        free = np.flatnonzero(~np.isfinite(low) | ~np.isfinite(high))
        which = ", ".join(map(str, free + 1))
        cure = (
            f"Give {where}lower and {where}upper: no limit bounds coordinate {which} of {low.size}"
        )
        fail(f"{where}lower", "no finite range to map", cure)
    if np.any(low >= high):
        if lower is None and upper is None:
            i = int(np.argmax(low >= high))
            cure = f"Give {where}lower and {where}upper, or map other axes"
            fail(f"{where}lower", f"limits leave coordinate {i + 1} of {low.size} no range", cure)
        what = f"{low.tolist()} not below upper {high.tolist()}"
        fail(f"{where}lower", what, "Lower must be below upper")
    return low, high
