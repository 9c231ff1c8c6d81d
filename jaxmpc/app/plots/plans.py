"""One plan over its steps: states and inputs with their limits."""

from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from jaxmpc.app.plots.closed_loops import BROKEN, RUN, panel_grid, title_and_legend
from jaxmpc.app.plots.style import EDGE, INFEASIBLE, NOT_SOLVED, SET_POINT, Style, patch
from jaxmpc.checks import fail, require_kind
from jaxmpc.mpc.plan import Plan, checked_aim
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.rows import Block, given_blocks
from jaxmpc.qp.linalg import float64_arrays
from jaxmpc.qp.status import Status
from jaxmpc.sets.convex_sets import Box
from jaxmpc.sets.limits import rows_kept


def plot_plan(
    plan: Plan,
    mpc: MPC,
    *,
    reference: Any = None,
    input_reference: Any = None,
    title: str | None = None,
) -> Figure:
    """Draw one plan over the horizon: a panel for each state and input, and for each output, hard
    or soft, of several of these.

    plan: of `jm.solve`, of mpc. Points are the states x_k, lines the inputs u_k, which are held
    for a step. Lines are the limits of single states and inputs, hard and soft, at the steps at
    which they hold, grey beyond them; red: exceeded by more than 1e-6 of the limit, as soft ones
    may be. State and input limits that couple several are not drawn. Purple: the plan is not
    SOLVED.
    reference, input_reference: as `jm.solve` takes them, to draw. title: None: steps, status and
    cost. Time is counted in steps where the system has no dt. Raises ValueError for many plans, or
    one of another problem.
    """
    require_kind("plan", plan, Plan, cure="Give what jm.solve returns")
    require_kind("mpc", mpc, MPC)
    mpc.validate()
    N, system = mpc.horizon, mpc.system
    values = [np.asarray(v, float) for v in (plan.states, plan.inputs)]
    if [v.shape for v in values] != [(N + 1, system.n), (N, system.m)]:
        cure = "Give one plan of mpc; of many: jax.tree.map(lambda v: v[i], plans)"
        fail("plan", f"has states {values[0].shape} and inputs {values[1].shape}", cure)
    aim = checked_aim(mpc, values[0][0], reference, input_reference)
    time = np.arange(N + 1) * (system.dt or 1.0)
    with jax.enable_x64(True):
        rows = given_blocks(float64_arrays(mpc), float)
    outputs, of_outputs, ends = _coupled_outputs(rows, *values)
    values.append(of_outputs)
    limits, exceeded = [*_limits_of_axes(mpc, rows), ends], False
    unit = system.time_unit if system.dt else "steps"
    place = SimpleNamespace(system=system, time_unit=unit, outputs=outputs)
    figure, panels = panel_grid(place, time, 2.9, (1.15, 2.0, 1.0))
    solved = bool(plan.solved)
    colour = RUN if solved else NOT_SOLVED
    for ax, kind, i in panels:
        target = (aim.states, aim.inputs, None)[kind]
        if target is not None:
            target = np.broadcast_to(np.asarray(target, float), values[kind].shape)[:, i]
        low, high = limits[kind][..., i]
        exceeded |= _draw(ax, time, values[kind][:, i], low, high, target, colour)
    handles: list[Any] = [
        Line2D([], [], color=colour, lw=1.0, marker=".", label="state, input held for a step"),
        patch("beyond a limit", INFEASIBLE),
    ]
    if exceeded:
        handles.append(Line2D([], [], color=BROKEN, marker="o", ms=3, ls="", label="exceeded"))
    if reference is not None or input_reference is not None:
        handles.append(Line2D([], [], label="set-point", **SET_POINT))
    if title is None:
        title = f"plan of {N} steps, cost {float(plan.cost):.6g}"
        if not solved:
            title = f"iterate of {N} steps, no plan: {Status(int(plan.status)).name}"
    title_and_legend(figure, title, handles, 2)
    return figure


def _counted(row: np.ndarray) -> np.ndarray:
    """Return which entries of rows (..., n) count: smaller ones are rounding of the largest."""
    return np.abs(row) > 4 * np.finfo(float).eps * np.abs(row).max(axis=-1, keepdims=True)


def _coupled_outputs(
    rows: list[Block], x: np.ndarray, u: np.ndarray
) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Return the labels of the p outputs, hard and soft, of more than one state or input, their
    values (N + 1, p) along the plan, NaN where they do not hold, and their limits (2, N + 1, p)."""
    labels, values, ends = list[str](), [np.zeros((len(x), 0))], [np.zeros((2, len(x), 0))]
    for b in rows:
        if b.kind not in ("output", "soft"):
            continue
        parts = [(M, v) for M, v in ((b.H, x), (b.D, u)) if M is not None]
        every = np.concatenate([M for M, _ in parts], axis=-1)
        every = np.broadcast_to(every, (len(b.steps), *every.shape[-2:]))
        coupled = np.any(_counted(every).sum(axis=2) > 1, axis=0)
        along = np.full((len(x), b.size), np.nan)
        for k, row in zip(b.steps, every, strict=True):
            along[k] = row @ np.concatenate([v[k] for _, v in parts])
        sides = [b.at_steps(b.lower, len(x), -np.inf), b.at_steps(b.upper, len(x), np.inf)]
        named = zip(b.names, b.units, coupled, strict=True)
        labels += [f"{name} [{unit}]" if unit else name for name, unit, shown in named if shown]
        values.append(along[:, coupled])
        ends.append(np.stack(sides)[..., coupled])
    return labels, np.concatenate(values, axis=1), np.concatenate(ends, axis=2)


def _limits_of_axes(mpc: MPC, rows: list[Block]) -> list[np.ndarray]:
    """Return (2, N + 1, n) and (2, N, m): the lower and upper limits of each state and input by
    itself at each step, ±inf for none."""
    N, system = mpc.horizon, mpc.system
    ends = [
        np.stack([np.full(shape, -np.inf), np.full(shape, np.inf)])
        for shape in ((N + 1, system.n), (N, system.m))
    ]
    for b in rows:
        low, high = b.at_steps(b.lower, N + 1, -np.inf), b.at_steps(b.upper, N + 1, np.inf)
        for found, M, other in zip(ends, (b.H, b.D), (b.D, b.H), strict=True):
            if b.rate or b.radius is not None or M is None:
                continue
            every = M if other is None else np.concatenate([M, other], axis=-1)
            every = np.broadcast_to(every, (len(b.steps), *every.shape[-2:]))
            for k, row in zip(b.steps, every, strict=True):
                there = _counted(row)
                own = there[:, : M.shape[-1]]
                alone = (there.sum(axis=1) == 1) & own.any(axis=1)
                axis = np.argmax(own[alone], axis=1)
                sides = np.array([low[k, alone], high[k, alone]]) / row[alone, axis]
                np.maximum.at(found[0, k], axis, sides.min(axis=0))
                np.minimum.at(found[1, k], axis, sides.max(axis=0))
    return ends


def _draw(
    ax: Axes,
    time: np.ndarray,
    values: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    target: np.ndarray | None,
    colour: str,
) -> bool:
    """Draw the values of a state (N + 1,) or of an input (N,) with limits and set-points of each
    step, and return whether a limit is exceeded."""
    held = len(values) < len(time)
    if held:  # to the end of the last step
        values, low, high = (np.append(v, v[-1]) for v in (values, low, high))
        target = None if target is None else np.append(target, target[-1])
    style: Style = {"drawstyle": "steps-post"} if held else {"marker": ".", "ms": 4}
    ax.plot(time, values, color=colour, lw=1.0, zorder=3, **style)
    known = [v[np.isfinite(v)] for v in (values, low, high)]
    every = np.concatenate(known if target is None else [*known, target])
    least, most = (every.min(), every.max()) if len(every) else (0.0, 1.0)
    room = 0.08 * (most - least) or 0.5
    least, most = least - room, most + room
    # A limit of a state is drawn half a step to each side of its time.
    edges = time if held else np.concatenate([time[:1], (time[1:] + time[:-1]) / 2, time[-1:]])
    for end, far in ((low, least), (high, most)):
        ends = np.where(np.isfinite(end), end, np.nan)[: len(edges) - 1]
        ax.stairs(ends, edges, baseline=far, fill=True, color=INFEASIBLE, lw=0, zorder=0)
        ax.stairs(ends, edges, baseline=None, color=EDGE, lw=0.7, zorder=1)
    exceeded = ~rows_kept(Box(low, high), values) & np.isfinite(values)
    ax.plot(time[exceeded], values[exceeded], ".", color=BROKEN, ms=5, zorder=4)
    if target is not None:
        ax.plot(time, target, drawstyle="steps-post" if held else "default", zorder=2, **SET_POINT)
    ax.set_ylim(least, most)
    return bool(exceeded.any())
