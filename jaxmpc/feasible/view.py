"""Which initial states a point of a map stands for: all states, a slice, or a projection."""

from collections.abc import Sequence
from typing import Any, TypeAlias

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import Reals
from jaxmpc.checks import fail, require_finite, require_shape
from jaxmpc.mpc.problem import MPC
from jaxmpc.pytrees import pytree, static
from jaxmpc.sets.convex_sets import set_bounds

# Indices or names of states, None for all.
Axes: TypeAlias = Sequence[int | str] | np.ndarray | None


@pytree
class View:
    """Which initial states a point θ (d,) of the map stands for.

    x_0 has θ at `axes` and `fixed` elsewhere (slice), or, where `fixed` is None, anything in the
    box [lower, upper] of the other states (projection: feasible if some value is).
    """

    axes: tuple[int, ...] = static()
    others: tuple[int, ...] = static()
    fixed: Any
    lower: Any
    upper: Any

    @property
    def projects(self) -> bool:
        """Return whether the states that are not mapped are free."""
        return self.fixed is None and bool(self.others)

    def states(self, points: np.ndarray) -> np.ndarray:
        """Return the states (B, n) of points (B, d) of a slice."""
        x = np.zeros(len(self.axes) + len(self.others)) if self.fixed is None else self.fixed
        states = np.tile(x, (len(points), 1))
        states[:, list(self.axes)] = points
        return states

    def initial_state(self, theta: Array, free: Array) -> Array:
        """Return x_0 (n,) of a point θ and values `free` of the other states, clipped into their
        box."""
        n = len(self.axes) + len(self.others)
        x = jnp.zeros(n, theta.dtype) if self.fixed is None else jnp.asarray(self.fixed)
        x = x.at[np.array(self.axes)].set(theta)
        if self.projects:
            x = x.at[np.array(self.others)].set(jnp.clip(free, self.lower, self.upper))
        return x


def make_view(mpc: MPC, axes: Axes = None, fixed: Reals | None = None) -> View:
    """Check and complete the choice of states to map; raise ValueError for a wrong one.

    axes: indices or names of the mapped states, None for all. fixed: values (n,) of all states
    (those at `axes` are ignored) for a slice, None for a projection along the others.
    """
    n = mpc.dimension
    names = list(mpc.system.state_names)
    axes = tuple(range(n)) if axes is None else tuple(axes)
    axes = tuple(names.index(i) if isinstance(i, str) and i in names else i for i in axes)
    if not all(isinstance(i, int | np.integer) for i in axes):
        fail("axes", f"{axes}", f"Give state indices or names ({', '.join(names) or 'none set'})")
    axes = tuple(int(i) for i in axes)
    if not axes or len(set(axes)) != len(axes) or not all(0 <= i < n for i in axes):
        fail("axes", f"{axes}", f"Give different state indices from 0 to {n - 1}")
    others = tuple(i for i in range(n) if i not in axes)
    if fixed is not None and others:
        require_shape("fixed", fixed, (n,), "One value for each state; those at axes are ignored")
        require_finite("fixed", np.asarray(fixed, float)[list(others)])
        fixed = np.asarray(fixed, np.float64)
        return View(axes, others, np.where(np.isin(np.arange(n), others), fixed, 0.0), None, None)
    constrained = others and 0 in mpc.state_stages
    sides = set_bounds(mpc.states if constrained else None, mpc.system.n)
    if n > mpc.system.n:  # a previous input is one that could be applied
        limits = set_bounds(mpc.inputs, mpc.system.m)
        sides = (np.append(sides[0], limits[0]), np.append(sides[1], limits[1]))
    lower, upper = sides
    return View(axes, others, None, lower[list(others)], upper[list(others)])
