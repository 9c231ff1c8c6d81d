"""Checks of a configuration as a whole: keys that are valid alone must fit one another."""

import math
from typing import Any

import numpy as np

from jaxmpc.app.config.problem import SECTION_COMMANDS, Config
from jaxmpc.app.config.states import grid_shape, mapped_axes, recursion_shape, section_ends
from jaxmpc.batches import CHUNK
from jaxmpc.checks import fail, require_memory, require_printable
from jaxmpc.mpc.condense import condensed_bytes


def check(config: Config, command: str = "sweep") -> None:
    """Raise ValueError where keys that are valid alone do not fit one another."""
    s, limits = config.system, config.limits
    n, m = len(s.A), len(s.B[0])
    require_printable("name", config.name)
    for key, value, count in (
        ("system.A", s.A[0], n),
        ("system.B", s.B, n),
        ("system.c", s.c, n),
        ("system.state_names", s.state_names, n),
        ("system.state_units", s.state_units, n),
        ("system.input_names", s.input_names, m),
        ("system.input_units", s.input_units, m),
        ("limits.x_min", limits.x_min, n),
        ("limits.x_max", limits.x_max, n),
        ("limits.u_min", limits.u_min, m),
        ("limits.u_max", limits.u_max, m),
        ("cost.Q", config.cost.Q, n),
        ("cost.R", config.cost.R, m),
        ("cost.P", None if isinstance(config.cost.P, str) else config.cost.P, n),
    ):
        if value is not None and len(value) != count:
            what = f"{m} inputs" if count == m != n else f"{n} states, {m} inputs"
            fail(key, f"has {len(value)} entries where {count} are needed", f"A, B: {what}")
    for low, high in (("x_min", "x_max"), ("u_min", "u_max")):
        _check_order("limits", low, high, getattr(limits, low), getattr(limits, high))
    _check_state_limits(config)
    _check_terminal_set(config, n)
    require_horizon(config, "mpc.horizon", config.mpc.horizon)
    if command == "sweep":
        _check_sweep(config, n)
    elif command == "recursion":
        _check_recursion(config, n)


def require_horizon(config: Config, key: str, horizon: int) -> None:
    """Raise ValueError, naming the key, where a horizon is too long for the memory."""
    n, m = len(config.system.A), len(config.system.B[0])
    rows = config.limits.h_x or config.limits.x_min or ()
    needed = condensed_bytes(horizon, n, m, config.mpc.control_horizon, len(rows) + m)
    require_memory(key, needed, "Give fewer steps")


def _check_sweep(config: Config, n: int) -> None:
    """Raise ValueError unless [sweep] fits a system of n states."""
    sweep = config.sweep
    d = len(mapped_axes(config))
    for key, count in (("grid", d), ("lower", d), ("upper", d), ("fixed", n - d)):
        value = getattr(sweep, key)
        if value is not None and len(value) != count:
            cure = f"{n} states, of which {d} are mapped (sweep.axes)"
            fail(f"sweep.{key}", f"has {len(value)} entries where {count} are needed", cure)
    _check_order("sweep", "lower", "upper", sweep.lower, sweep.upper)
    if d < n and (sweep.fixed is None) != sweep.projection:
        cure = f"Give the {n - d} other values in sweep.fixed (a slice) or projection = true"
        both = "fixed and projection exclude each other"
        fail("sweep.fixed", both if sweep.projection else f"{n} states, {d} mapped", cure)
    if d == n and sweep.projection:
        fail("sweep.projection", f"true, and all {n} states are mapped", "Name fewer in sweep.axes")
    section_ends(config, mapped_axes(config), sweep)
    # Blocks in work, and a hundred bytes of each other block.
    count = math.prod(grid_shape(config))
    needed = 8 * min(count, CHUNK) * state_bytes(config) + 100 * count / CHUNK
    require_memory("sweep.grid", needed, "Map fewer points")


def _check_recursion(config: Config, n: int) -> None:
    """Raise ValueError unless [recursion] fits a system of n states."""
    recursion = config.recursion
    for key in ("grid", "lower", "upper"):
        value = getattr(recursion, key)
        if value is not None and len(value) != n:
            what = f"has {len(value)} entries where {n} are needed"
            fail(f"recursion.{key}", what, "One for each state")
    _check_order("recursion", "lower", "upper", recursion.lower, recursion.upper)
    shape = recursion_shape(config)
    if shape is not None:
        section_ends(config, range(n), recursion)
        # The map of the samples, and the states of the loops: x, x⁺, two inputs, lost, undecided.
        each = state_bytes(config, n) + 8 * (3 * n + 2 * len(config.system.B[0]) + 2)
        require_memory("recursion.grid", math.prod(shape) * each, "Look at fewer states")


def state_bytes(config: Config, d: int | None = None) -> int:
    """Return the bytes of a state with its label and proofs in a map of d axes (None: those of
    [sweep]): the point, x_0, the plan, the half-space, label and status."""
    d = len(mapped_axes(config)) if d is None else d
    n, m = len(config.system.A), len(config.system.B[0])
    return 8 * (2 * d + n + config.mpc.horizon * m + 1) + 2


def _check_state_limits(config: Config) -> None:
    """Raise ValueError unless the state limits are either a box or rows of H_x, and complete."""
    limits = config.limits
    box = limits.x_min is not None or limits.x_max is not None
    polytope = limits.H_x is not None or limits.h_x is not None
    if (limits.x_min is None) != (limits.x_max is None):
        fail("limits.x_min", "x_min and x_max go together", "Use inf for a side without limit")
    if limits.margin and not box:
        fail("limits.margin", "given without x_min, x_max", "A Box of limits has half-widths")
    if (limits.H_x is None) != (limits.h_x is None):
        fail("limits.H_x", "H_x and h_x go together", "Give both: H_x x <= h_x")
    if box and polytope:
        fail("limits.H_x", "given beside x_min, x_max", "Write the box as rows of H_x")
    if limits.H_x is not None and limits.h_x is not None:
        shape = np.shape(limits.H_x)
        if shape != (len(limits.h_x), len(config.system.A)):
            fail("limits.H_x", f"shape {shape} for {len(limits.h_x)} rows", "One h_x a row")
    if not (box or polytope) and config.mpc.terminal != "none":
        fail("mpc.terminal", f'"{config.mpc.terminal}" without state limits', "Give x_min, x_max")


def _check_terminal_set(config: Config, n: int) -> None:
    """Raise ValueError unless [mpc] gives at most one terminal set, complete and of size n."""
    mpc = config.mpc
    for rows, ends in (("H_f", "h_f"), ("P_f", "level_f")):
        if (getattr(mpc, rows) is None) != (getattr(mpc, ends) is None):
            fail(f"mpc.{rows}", f"{rows} and {ends} go together", "Give both")
        if getattr(mpc, rows) is not None and mpc.terminal != "none":
            fail(f"mpc.{rows}", f'given beside terminal "{mpc.terminal}"', "Choose one")
    if mpc.H_f is not None and mpc.P_f is not None:
        fail("mpc.P_f", "given beside H_f", "Choose one terminal set")
    if mpc.H_f is not None and mpc.h_f is not None:
        if np.shape(mpc.H_f) != (len(mpc.h_f), n):
            what = f"shape {np.shape(mpc.H_f)} for {len(mpc.h_f)} rows"
            fail("mpc.H_f", what, f"One h_f a row, {n} columns")
    if mpc.P_f is not None and np.shape(mpc.P_f) != (n, n):
        fail("mpc.P_f", f"shape {np.shape(mpc.P_f)}", f"Give ({n}, {n})")


def _check_order(
    where: str, low: str, high: str, lower: tuple[float, ...] | None, upper: Any
) -> None:
    """Raise ValueError where a lower end lies above its upper end."""
    for i, (a, b) in enumerate(zip(lower or (), upper or (), strict=False)):
        if a > b or (where in SECTION_COMMANDS and a == b):
            fail(
                f"{where}.{low}", f"entry {i} is {a:g}, above {high} {b:g}", f"Check {low}, {high}"
            )
