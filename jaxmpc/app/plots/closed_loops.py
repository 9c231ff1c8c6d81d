"""Closed loops over time: positions, velocities and inputs with their limits."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from jaxmpc.app.plots.style import (
    AFTER,
    BEFORE,
    EDGE,
    INFEASIBLE,
    NOT_SOLVED,
    OUTER,
    SET_POINT,
    Style,
    patch,
)
from jaxmpc.checks import counted, fail, require_kind
from jaxmpc.closed_loop.outcome import with_limits
from jaxmpc.closed_loop.simulation import Run
from jaxmpc.qp.status import Status
from jaxmpc.robots.description import host_coordinates
from jaxmpc.robots.linear_plant import LinearPlant
from jaxmpc.robots.robot import Robot
from jaxmpc.sets.limits import rows_kept

RUN, BROKEN = "#0072b2", "#a50f15"
# Plans that stand out, by `plan_outcomes`: colour and words.
PLANS = {
    "fallback": (OUTER, "its plan needs slack (fallback)"),
    "unsolved": (NOT_SOLVED, "its plan was not solved"),
}


def plot_runs(
    run: Run,
    plant: Any,
    *,
    reference: Any = None,
    input_reference: Any = None,
    robots: Sequence[int] | None = None,
    title: str | None = None,
) -> Figure:
    """Draw closed loops over time: a panel for each position, velocity and input.

    run: of `simulate` or `simulate_many`, of a Robot or LinearPlant. Limits are lines, what lies
    outside is grey. Orange: the plan was solved and needs slack, hence exceeds soft limits
    somewhere on its horizon (fallback). Purple: the plan was not solved. Red: limits exceeded by
    more than 1e-6 of the limit. Cross: the next value is not finite.
    reference (n,), input_reference (m,): set-points to draw, or over time as `simulate` takes them.
    robots: which of the batch to draw, 24 at most by default. title: None: counts of loops and
    plans, of all of the batch. The figure has another size by its `set_size_inches`. Raises
    ValueError for robots that are not there, and for plants that have no limits.
    """
    require_kind("run", run, Run, cure="Give what simulate or simulate_many returns")
    lacks = "Give jm.LinearPlant(system, states, inputs), which has limits to draw"
    require_kind("plant", plant, Robot, LinearPlant, cure=lacks)
    run = run.on_host()
    inputs, plans = np.asarray(run.inputs), plan_outcomes(run)
    count, samples = inputs.shape[:2]
    shown = _chosen("robots", np.arange(min(count, 24)) if robots is None else robots, count)
    pairs = with_limits(plant, run)
    xi, kept = pairs[0][1], [rows_kept(*pair) for pair in pairs]
    time = plant.dt * np.arange(samples + 1)
    figure, panels = panel_grid(plant, time, 2.6, (1.15, 2.0, 1.1))
    for ax, kind, i in panels:
        broken = ~kept[kind][shown, :, i]
        values = (xi, inputs)[kind][shown, :, i]
        parts = [(colour, plans[name][shown].T) for name, (colour, _) in PLANS.items()]
        _draw_lines(ax, time, values.T, parts, broken.T)
        draw_limits(ax, plant, kind, i, (reference, input_reference)[kind], time)
    whole = kept[0].all(axis=(1, 2)) & kept[1].all(axis=(1, 2))
    loops = f"{counted(count, 'closed loop')} of {time[-1]:g} {plant.time_unit}"
    kept_by = f"{np.count_nonzero(whole):,} of {count:,}"
    counts = (
        f"{plant.name}: {loops}, {len(shown):,} shown. Limits kept by {kept_by}\n"
        f"{_plans_text(plans)}"
    )
    line = lambda label, **style: Line2D([], [], label=label, **style)
    handles: list[Any] = [
        line("one robot" if isinstance(plant, Robot) else "one loop", color=RUN, lw=0.8),
        patch("beyond the limits", INFEASIBLE),
    ]
    if reference is not None or input_reference is not None:
        handles.append(line("set-point", **SET_POINT))
    for name, (colour, words) in PLANS.items():
        if plans[name][shown].any():
            handles.append(line(words, color=colour, lw=1.6))
    if not all(part[shown].all() for part in kept):
        handles.append(line("limit exceeded", color=BROKEN, marker="o", ms=3, ls=""))
    columns = max(1, min(len(handles), int(figure.get_figwidth() / 2.5)))
    title_and_legend(figure, counts if title is None else title, handles, columns)
    return figure


def plot_before_after(
    before: Run,
    after: Run,
    plant: Any,
    *,
    reference: Any = None,
    input_reference: Any = None,
    loops: Sequence[int] | None = None,
    title: str = "",
) -> Figure:
    """Draw the same closed loops before and after tuning: a panel a position, velocity and input.

    before, after: of `simulate_many` from the same starts, of a Robot or LinearPlant, whose limits
    are lines, grey outside. reference (n,), input_reference (m,): set-points to draw, or over time.
    loops: which ones; None: 6 spread over all. Raises ValueError for loops that are not there.
    """
    before, after = before.on_host(), after.on_host()
    count, samples = np.shape(before.inputs)[:2]
    spread = np.unique(np.linspace(0, count - 1, min(count, 6)).astype(int))
    shown = _chosen("loops", spread if loops is None else loops, count)
    time = plant.dt * np.arange(samples + 1)
    values = [
        (host_coordinates(plant, run.states)[shown], np.asarray(run.inputs, float)[shown])
        for run in (before, after)
    ]
    figure, panels = panel_grid(plant, time, 3.4, (1.35, 2.4, 1.0))
    for ax, kind, i in panels:
        # Broad lines below narrow ones, so that both are visible where they coincide.
        for found, colour, width in zip(values, (BEFORE, AFTER), (2.2, 1.0), strict=True):
            lines = found[kind][..., i].T
            lines = np.concatenate([lines, lines[-1:]]) if kind else lines
            style: dict[str, Any] = {"drawstyle": "steps-post"} if kind else {}
            ax.plot(time, lines, color=colour, lw=width, alpha=0.9, **style)
            _mark_ends(ax, time, lines, colour)
        draw_limits(ax, plant, kind, i, (reference, input_reference)[kind], time)
    handles: list[Any] = [
        Line2D([], [], color=BEFORE, lw=2.2, label="before"),
        Line2D([], [], color=AFTER, lw=1.0, label="after"),
        patch("outside limits", INFEASIBLE),
    ]
    if reference is not None or input_reference is not None:
        handles.append(Line2D([], [], label="set-point", **SET_POINT))
    title_and_legend(figure, title, handles, len(handles))
    return figure


def _chosen(name: str, given: Any, count: int) -> np.ndarray:
    """Return which of `count` loops to draw; raise ValueError for some that are not there."""
    shown = np.asarray(given, int)
    if not len(shown) or np.any((shown < 0) | (shown >= count)):
        fail(name, f"{given}", f"Give indices from 0 to {count - 1}")
    return shown


def title_and_legend(figure: Figure, title: str, handles: list[Any], columns: int) -> None:
    """Put the title above all panels, and the legend below them."""
    figure.suptitle(title, fontsize=9, x=0.01, ha="left")
    style: Style = {"loc": "outside lower left", "fontsize": 8, "frameon": False}
    figure.legend(handles=handles, ncols=columns, **style)


def plan_outcomes(run: Run) -> dict[str, np.ndarray]:
    """Return which plans (B, T) were solved within all limits ("kept"), solved with slack in soft
    limits ("fallback"), and not solved ("unsolved"). Laws that do not plan have none of them."""
    status, fallback = np.asarray(run.status), np.asarray(run.fallback, bool)
    solved = status == Status.SOLVED
    return {
        "kept": solved & ~fallback,
        "fallback": solved & fallback,
        "unsolved": ~solved & (status != Status.NOT_RUN),
    }


def _plans_text(plans: dict[str, np.ndarray]) -> str:
    """Return the numbers of plans by outcome, in words."""
    kept, fallback, unsolved = (np.count_nonzero(plans[name]) for name in plans)
    total = kept + fallback + unsolved
    if not total:
        return "a law without plans"
    return (
        f"{total:,} plans: {kept:,} within all limits, {fallback:,} need slack (fallback), "
        f"{unsolved:,} not solved"
    )


def panel_grid(
    plant: Any, time: np.ndarray, width: float, height: tuple[float, float, float]
) -> tuple[Figure, list[tuple[Axes, int, int]]]:
    """Return a figure with a panel for each state and input over time, and its panels.

    A panel is (axes, 0 for a state, 1 for an input, 2 for an output, its index). width: of a
    column, in inches; height: of a row, least of all rows, and of the rest.
    """
    columns = panel_columns(plant)
    rows, (each, least, rest) = max(len(panels) for _, panels in columns), height
    size = (width * len(columns) + 0.2, max(each * rows, least) + rest)
    figure = Figure(figsize=size, layout="constrained")
    found = []
    # Each column fills the height, so that there is no gap below the shorter ones.
    parts = figure.subfigures(1, len(columns), squeeze=False)[0]
    for part, (title, panels) in zip(parts, columns, strict=True):
        column = part.subplots(len(panels), sharex=True, squeeze=False)[:, 0]
        column[0].set_title(title, fontsize=9)
        column[-1].set_xlabel(f"time [{plant.time_unit}]", fontsize=8)
        for ax, (kind, i, label) in zip(column, panels, strict=True):
            ax.set_ylabel(label, fontsize=8)
            ax.tick_params(labelsize=7)
            ax.xaxis.set_major_locator(MaxNLocator(5))
            ax.set_xlim(0, time[-1])
            found.append((ax, kind, i))
        part.align_ylabels()
    return figure, found


def panel_columns(plant: Any) -> list[tuple[str, list[tuple[int, int, str]]]]:
    """Return the titles of the columns, each with its panels.

    A panel is (0 for a state, 1 for an input, 2 for an output; its index; its label).
    """
    if not isinstance(plant, Robot):
        system = plant.system
        titles = "states", "inputs", "outputs"
        labels = system.state_labels, system.input_labels, getattr(plant, "outputs", ())
        return [
            (title, [(kind, i, label) for i, label in enumerate(each)])
            for kind, (title, each) in enumerate(zip(titles, labels, strict=True))
            if each
        ]
    label = lambda name, unit: (
        f"{name}{' ' if len(name) < 8 else chr(10)}[{unit}]" if unit else name
    )
    half, names, units = plant.n // 2, plant.state_names, plant.state_units
    inputs = zip(plant.input_names, plant.input_units, strict=True)
    return [
        ("position", [(0, i, label(names[i], units[i])) for i in range(half)]),
        ("velocity", [(0, half + i, label(names[i], units[half + i])) for i in range(half)]),
        ("input", [(1, i, label(*both)) for i, both in enumerate(inputs)]),
    ]


def _draw_lines(
    ax: Axes,
    time: np.ndarray,
    values: np.ndarray,
    parts: list[tuple[str, np.ndarray]],
    broken: np.ndarray,
) -> None:
    """Draw thin lines (samples, robots), on top parts (colour, plans) and points beyond limits."""
    held = len(values) < len(time)  # inputs, each held for a period
    if held:
        values, broken = (np.concatenate([v, v[-1:]]) for v in (values, broken))
    style: dict[str, Any] = {"drawstyle": "steps-post"} if held else {}
    alpha = float(np.clip(6 / values.shape[1], 0.35, 0.9))
    ax.plot(time, values, color=RUN, lw=0.7, alpha=alpha, **style)
    for colour, plans in parts:
        # A sample's part of the line reaches to the next sample.
        part = np.zeros(values.shape, bool)
        part[:-1] |= plans
        part[1:] |= plans
        if part.any():
            ax.plot(time, np.where(part, values, np.nan), color=colour, lw=0.9, **style)
    _mark_ends(ax, time, values, RUN)
    k, robot = np.nonzero(broken)
    ax.plot(time[k], values[k, robot], ".", color=BROKEN, ms=2, zorder=4)


def _mark_ends(ax: Axes, time: np.ndarray, values: np.ndarray, colour: str) -> None:
    """Mark by a cross where a line of values (samples, loops) ends since the next is not finite."""
    finite = np.isfinite(values)
    if not finite.any():
        style: Style = {"transform": ax.transAxes, "ha": "center", "va": "center", "fontsize": 7}
        ax.text(0.5, 0.5, "not finite", **style)
    k, loop = np.nonzero(finite[:-1] & ~finite[1:])
    ax.plot(time[k], values[k, loop], "x", color=colour, ms=5, zorder=4)


def draw_limits(ax: Axes, plant: Any, kind: int, i: int, reference: Any, time: np.ndarray) -> None:
    """Draw the limits of state (kind 0) or input (1) i, grey beyond them, and the set-point, one or
    one for each of the times (T + 1,) and later."""
    limits = plant.input_limits if kind else plant.state_limits
    ends = [float(np.asarray(end)[i]) for end in (limits.lower, limits.upper)]
    low, high = ax.get_ylim()
    finite = [end for end in ends if np.isfinite(end)]
    low, high = min([low, *finite]), max([high, *finite])
    room = 0.08 * (high - low)
    low, high = low - room, high + room
    for end, far in zip(ends, (low, high), strict=True):
        if np.isfinite(end):
            ax.axhspan(min(end, far), max(end, far), color=INFEASIBLE, lw=0, zorder=0)
            ax.axhline(end, color=EDGE, lw=0.7, zorder=1)
    if np.ndim(reference) == 2:
        targets = np.asarray(reference)[: len(time), i]
        targets = np.append(targets, targets[-1:]) if len(targets) < len(time) else targets
        ax.step(time[: len(targets)], targets, where="post", zorder=3, **SET_POINT)
    elif reference is not None:
        ax.axhline(float(np.asarray(reference)[i]), zorder=3, **SET_POINT)
    ax.set_ylim(low, high)
