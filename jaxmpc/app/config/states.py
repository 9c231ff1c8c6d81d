"""Initial states of the commands sweep and recursion: grids over the state limits."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxmpc.app.config.problem import Config
from jaxmpc.app.config.sections import RecursionSection, SweepSection
from jaxmpc.grids import axis_indices, grid, grid_ends, mesh


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


def section_ends(
    config: Config, axes: Sequence[int], section: SweepSection | RecursionSection
) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the grid of [sweep] or [recursion]; see `grid_ends`."""
    where = "sweep." if isinstance(section, SweepSection) else "recursion."
    limits = lambda: tuple(end[list(axes)] for end in config.state_range())
    return grid_ends(where, section.lower, section.upper, limits)
