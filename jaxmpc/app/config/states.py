"""Initial states of the commands sweep and recursion: grids over the state limits."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jaxmpc.app.config.problem import Config
from jaxmpc.app.config.sections import RecursionSection, SweepSection
from jaxmpc.checks import fail
from jaxmpc.feasible.map import grid, mesh


class SweepPoints(NamedTuple):
    """Initial states of a sweep: a grid of mapped states, as `map_feasible_set` takes it."""

    along: tuple[np.ndarray, ...]  # the coordinates along each of the d axes
    axes: tuple[int, ...]  # the d states mapped
    fixed: np.ndarray | None  # (n,) for a slice; None: all states mapped, or a projection

    @property
    def total(self) -> int:
        """Return the number of points B."""
        return math.prod(len(line) for line in self.along)

    @property
    def points(self) -> np.ndarray:
        """Return all points (B, d)."""
        return mesh(self.along)


def sweep_points(config: Config) -> SweepPoints:
    """Return the grid of initial states that [sweep] describes."""
    axes = mapped_axes(config)
    lower, upper = section_ends(config, axes, config.sweep)
    shape = grid_shape(config)
    along = tuple(np.linspace(*ends) for ends in zip(lower, upper, shape, strict=True))
    if config.sweep.fixed is None:
        return SweepPoints(along, axes, None)
    fixed = np.zeros(len(config.system.A))
    fixed[[i for i in range(len(fixed)) if i not in axes]] = config.sweep.fixed
    return SweepPoints(along, axes, fixed)


def grid_shape(config: Config) -> tuple[int, ...]:
    """Return the number of points of a sweep along each mapped axis."""
    d = len(mapped_axes(config))
    # 256 along each of two axes; about as many points in all along more.
    return config.sweep.grid or (min(256, int(65_536.5 ** (1 / d))),) * d


def recursion_states(config: Config) -> np.ndarray | None:
    """Return states (B, n) for `recursive_feasibility`; None for its own choice (n > 3)."""
    shape, axes = recursion_shape(config), range(len(config.system.A))
    return None if shape is None else grid(*section_ends(config, axes, config.recursion), shape)


def recursion_shape(config: Config) -> tuple[int, ...] | None:
    """Return the number of sample states along each axis; None for those that
    `recursive_feasibility` chooses itself (n > 3)."""
    usual = {1: (1001,), 2: (128, 128), 3: (24, 24, 24)}
    return config.recursion.grid or usual.get(len(config.system.A))


def mapped_axes(config: Config) -> tuple[int, ...]:
    """Return the indices of the mapped states, which [sweep] gives by name or index."""
    n, axes = len(config.system.A), config.sweep.axes
    given = tuple(range(min(2, n))) if axes is None else axes
    return axis_indices("sweep.axes", "state", given, config.system.state_names or (), n)


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


def section_ends(
    config: Config, axes: Sequence[int], section: SweepSection | RecursionSection
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the grid of [sweep] or [recursion]; see `grid_ends`."""
    where = "sweep." if isinstance(section, SweepSection) else "recursion."
    limits = lambda: tuple(end[list(axes)] for end in config.state_range())
    return grid_ends(where, section.lower, section.upper, limits)


def grid_ends(
    where: str, lower: Sequence[float] | None, upper: Sequence[float] | None,
    limits: Callable[[], tuple[np.ndarray, ...]],
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
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
        cure = f"Give {where}lower and {where}upper: the limits do not bound the mapped axes"
        fail(f"{where}lower", "no finite range to map", cure)
    if np.any(low >= high):
        what = f"{low.tolist()} not below upper {high.tolist()}"
        fail(f"{where}lower", what, "Lower must be below upper")
    return low, high
