"""Plots of tuning: losses and weights by step, closed loops, maps and penalties."""

from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator

from jaxmpc.app.plots.maps import ring
from jaxmpc.app.plots.style import AFTER, BEFORE, EDGE, GRID
from jaxmpc.feasible.map import FeasibleSetMap
from jaxmpc.sets.drawing import COLOURS
from jaxmpc.tuning.descent import Descent
from jaxmpc.tuning.pareto import TradeOff
from jaxmpc.tuning.result import TuningRun

REJECTED, BEST = "#a50f15", "#006f52"
FRACTIONS = (
    ("unsolved", "plans not solved", "#0072b2", "-"),
    ("infeasible", "plans proved infeasible", "#a50f15", "--"),
    ("fallback", "plans with slack in soft limits (fallback)", "#e69f00", "-"),
    ("violation", "loops beyond the limits", "#006f52", ":"),
)
# Lines of a panel that get a colour and a name each; more are named by the groups they belong to.
NAMED = len(COLOURS)
# Rows of a block.
DASHES: tuple[Any, ...] = ("-", (0, (4, 2)), (0, (1, 1.5)), (0, (5, 1, 1, 1)))


def plot_tuning(
    history: Descent, weights: Mapping[str, Mapping[str, np.ndarray]], title: str = ""
) -> Figure:
    """Draw a `Descent` of weights over its T steps, in a panel each for what there is to show.

    Loss of the steps and of the validation loops, each relative to its first value where that is
    positive, the best of them marked; norm of the gradient; weights relative to the start;
    fractions of the validation plans and loops where something went wrong, if anything did. Red
    crosses: rejected steps.

    history: of a `TuningRun`. weights: group → entry → positive values (T+1,).
    """
    every, steps = np.arange(history.steps + 1), np.arange(history.steps)
    counts = [
        (label, 100 * values, {"color": colour, "ls": dashes, "lw": 1.4})
        for key, label, colour, dashes in FRACTIONS
        if (values := history.validation_numbers.get(key)) is not None
    ]
    panels = ["loss"]
    if np.isfinite(history.gradient_norm).any():
        panels.append("norm")
    if history.steps and any(weights.values()):
        panels.append("weights")
    if any(np.nanmax(values, initial=0.0) > 0 for _, values, _ in counts):
        panels.append("counts")
    rows, columns = {1: (1, 1), 2: (1, 2), 3: (1, 3), 4: (2, 2)}[len(panels)]
    size = (5.5 * max(columns, 1.4), 3.3 * max(rows, 1.2))
    figure = Figure(figsize=size, layout="constrained")
    axes = dict(zip(panels, figure.subplots(rows, columns, squeeze=False).flat, strict=True))
    names = {"norm": "norm of the gradient", "weights": "weight relative to the start"}
    names |= {"loss": _draw_loss(axes["loss"], history)}
    names |= {"counts": "fraction in the validation loops [%]"}
    if "norm" in axes:
        _line(axes["norm"], steps, history.gradient_norm, color=AFTER, lw=1.2)
        _scale(axes["norm"], history.gradient_norm)
    rejected = steps[~history.accepted]
    for name in ("loss", "norm"):
        if len(rejected) and name in axes:
            axes[name].plot(
                rejected,
                np.full(len(rejected), 0.04),
                "x",
                color=REJECTED,
                ms=5,
                ls="",
                transform=axes[name].get_xaxis_transform(),
                label=f"rejected steps ({len(rejected)})",
            )
    if "weights" in axes:
        _draw_weights(axes["weights"], every, weights)
    if "counts" in axes:
        for label, values, style in counts:
            _line(axes["counts"], every, values, label=label, **style)
        highest = max(1.0, *(float(np.nanmax(values)) for _, values, _ in counts))
        top = 1.35 * highest if highest < 75 else 105
        axes["counts"].set_ylim(-0.03 * highest, top)
    for name, ax in axes.items():
        ax.set_xlabel("step")
        ax.set_ylabel(names[name])
        ax.set_xlim(-0.02 * max(1, history.steps), 1.02 * max(1, history.steps))
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        ax.grid(**GRID)
        ax.set_axisbelow(True)
        if name in ("loss", "counts") or (name == "norm" and len(rejected)):
            ax.legend(fontsize=8, frameon=False)
    figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    return figure


def _draw_loss(ax: Axes, history: Descent) -> str:
    """Draw the losses of steps and validation loops, and return what they are."""
    every, steps, best = np.arange(history.steps + 1), np.arange(history.steps), history.best
    loss, validation = history.loss, history.validation
    # Training and validation loops differ, so only relative changes are comparable.
    relative = validation[0] > 0 and len(loss) > 0 and loss[0] > 0
    if relative:
        loss, validation = loss / loss[0], validation / validation[0]
    if len(loss):
        _line(ax, steps, loss, color=EDGE, lw=1, label="training loops of the step")
        _line(ax, every, validation, color=AFTER, lw=1.6, label="validation loops")
    label = f"best: {history.validation[best]:.6g} at step {best}"
    ax.plot(best, validation[best], "o", color=BEST, ms=6, label=label, zorder=4)
    _scale(ax, loss, validation)
    return "loss relative to the start" if relative else "loss"


def _line(ax: Axes, x: np.ndarray, y: np.ndarray, **style: Any) -> None:
    """Draw a line through the finite values, as points where they are few."""
    x, y = x[np.isfinite(y)], y[np.isfinite(y)]
    ax.plot(x, y, marker="." if len(x) < 5 else None, **style)


def _scale(ax: Axes, *columns: np.ndarray) -> None:
    """Use a logarithmic axis where values are positive and range over more than a factor of 5."""
    values = np.concatenate(columns)
    values = values[np.isfinite(values)]
    if len(values) and values.min() > 0 and values.max() > 5 * values.min():
        _logarithmic(ax, values)
    else:
        ax.ticklabel_format(axis="y", useOffset=False)


def _logarithmic(ax: Axes, values: np.ndarray) -> None:
    """Use a logarithmic axis, with ticks at 1, 2, 5 in plain numbers where powers of ten would
    leave too few."""
    ax.set_yscale("log")
    decades = np.log10(values.max() / values.min())
    if decades < 3:
        low, high = values.min(), values.max()
        ax.set_ylim(low / 1.15, high * 1.15)
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.3g}"))
        ax.yaxis.set_minor_locator(LogLocator(subs=(), numticks=2))


def _draw_weights(
    ax: Axes, steps: np.ndarray, weights: Mapping[str, Mapping[str, np.ndarray]]
) -> None:
    """Draw each weight over its start: one colour a line, or one a group where there are many."""
    count = sum(len(entries) for entries in weights.values())
    i, handles, ratios = 0, [], []
    for g, (group, entries) in enumerate(weights.items()):
        for name, values in entries.items():
            colour = COLOURS[(i if count <= NAMED else g) % NAMED]
            ratios.append(values / values[0])
            alpha = 1 if count <= NAMED else 0.6
            # Later lines are thinner and dashed: those that they lie on stay in sight.
            few = count <= NAMED
            dashes, width = (DASHES[i % len(DASHES)], 2.6 - 1.4 * i / count) if few else ("-", 1.3)
            _line(ax, steps, ratios[-1], color=colour, ls=dashes, lw=width, alpha=alpha)
            if few:
                label = f"{group} {name}".strip()
                handles.append(Line2D([], [], color=colour, ls=dashes, lw=width, label=label))
            i += 1
        if count > NAMED:
            colour = COLOURS[g % NAMED]
            label = f"{group} ({len(entries)})" if len(entries) > 1 else group
            handles.append(Line2D([], [], color=colour, label=label))
    ax.axhline(1, color=EDGE, lw=0.7, zorder=0)
    flat = np.concatenate([*ratios, np.ones(1)])
    flat = flat[np.isfinite(flat) & (flat > 0)]
    if flat.max() > 5 * flat.min():
        _logarithmic(ax, flat)
    else:
        low, high = min(flat.min(), 0.98), max(flat.max(), 1.02)
        ax.set_ylim(low - 0.06 * (high - low), high + 0.06 * (high - low))
        ax.ticklabel_format(axis="y", useOffset=False)
    ax.legend(
        handles=handles, fontsize=8, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.02)
    )


def plot_trade_off(trade: TradeOff, ax: Axes | None = None) -> Axes:
    """Draw the first two losses of a trade-off against each other.

    trade: of `trade_off`. ax: axes to draw into; None: new ones. The Pareto optimal points are
    joined by a line, with the ratio of their weights in shares of the losses at the start; points
    that another one dominates are empty, the given values a cross.
    """
    if ax is None:
        ax = Figure(figsize=(5.6, 4.2), layout="constrained").add_subplot()
    (x, y), front = trade.losses[:, :2].T, trade.efficient
    order = np.flatnonzero(front)[np.argsort(x[front])]
    ax.plot(x[order], y[order], "o-", color=AFTER, ms=6, lw=1.2, label="Pareto optimal")
    if not front.all():
        ax.plot(x[~front], y[~front], "o", color=AFTER, mfc="none", ms=6, label="dominated")
    ax.plot(*trade.initial[:2], "x", color=BEFORE, ms=8, mew=2, label="as given")
    shares = trade.weights[:, :2] * trade.initial[:2]
    for k in order if len(order) <= 2 * NAMED else ():
        ax.annotate(
            _ratio(*shares[k]), (x[k], y[k]), (6, 6), textcoords="offset points", fontsize=8
        )
    ax.set_xlabel(f"loss: {trade.names[0]}")
    ax.set_ylabel(f"loss: {trade.names[1]}")
    ax.grid(**GRID)
    ax.set_axisbelow(True)
    ax.margins(0.12)
    ax.legend(fontsize=8, frameon=False)
    title = f"Trade-off, weights {trade.names[0]} : {trade.names[1]}, validation set"
    ax.set_title(title, loc="left", fontsize=10)
    return ax


def _ratio(first: float, second: float) -> str:
    """Return a ratio of weights, with 1 for the smaller one."""
    least = min(first, second)
    if least <= 0:
        return f"{int(first > 0)}:{int(second > 0)}"
    return f"{first / least:.3g}:{second / least:.3g}"


def plot_maps(before: FeasibleSetMap, after: FeasibleSetMap) -> Figure:
    """Draw the proved inner bounds of the feasible sets of two states, before and after.

    before, after: maps of `map_feasible_set(...).refine()`.
    """
    figure = Figure(figsize=(7.6, 4.6), layout="constrained")
    ax = figure.add_subplot()
    for fmap, name, colour, dashes in (
        (before, "before", BEFORE, (0, (4, 2))),
        (after, "after", AFTER, "-"),
    ):
        corners = ring(fmap.inner)
        low, high = fmap.volume_bounds()
        if len(corners):
            label = f"{name}: area {low:.5g} to {high:.5g}"
            ax.plot(*corners.T, color=colour, ls=dashes, lw=1.6, label=label)
        else:
            points = fmap.x0s[fmap.label == 1]
            label = f"{name}: {len(points):,} feasible states, without area"
            ax.plot(*points.T, ".", color=colour, label=label)
    ax.set_xlabel(before.axis_names[0])
    ax.set_ylabel(before.axis_names[1])
    title = f"Feasible initial states, horizon N = {before.mpc.horizon}, inner bounds"
    ax.set_title(title, loc="left", fontsize=11)
    ax.legend(loc="upper left", bbox_to_anchor=(1.02, 1.0), frameon=False)
    return figure


def plot_solver(run: TuningRun, before: np.ndarray, after: np.ndarray, title: str = "") -> Figure:
    """Draw the penalties of `tune_solver` by kind of row and stage, and the residuals.

    run: of `tune_solver`. before, after (B,): largest residual of each validation state, in parts
    of its tolerance, with the solver that was given and with the tuned one. Rows of a kind are
    drawn over the step k of the horizon at which they hold, those of one step by their number.
    """
    blocks = [block for block in run.settings["blocks"] if block[2] and block[1]]
    figure = Figure(figsize=(max(3.0 * (len(blocks) + 1.4), 8.0), 4.4), layout="constrained")
    axes = figure.subplots(
        1, len(blocks) + 1, width_ratios=[*(1.0,) * len(blocks), 1.5], squeeze=False
    )[0]
    rows = sum(len(steps) * size for _, steps, size in blocks)
    rho = np.asarray(run.solver.rho, float)
    rho = np.broadcast_to(rho, (rho.shape[0] if rho.ndim == 2 else 1, rows))
    shades = matplotlib.colormaps["viridis"](np.linspace(0.0, 0.85, len(rho)))
    first = 0
    for ax, (kind, steps, size) in zip(axes, blocks, strict=False):
        block = rho[:, first : first + len(steps) * size].reshape(len(rho), len(steps), size)
        first += len(steps) * size
        for stage, colour in zip(block, shades, strict=True):
            if len(steps) == 1:
                ax.plot(np.arange(1, size + 1), stage[0], "o", ms=4, color=colour)
            for i in range(size if len(steps) > 1 else 0):
                ax.plot(steps, stage[:, i], color=colour, ls=DASHES[i % 4], lw=1.4)
        ax.set_yscale("log")
        ax.set_title(kind if len(steps) > 1 else f"{kind}, k = {steps[0]}", fontsize=10)
        ax.set_xlabel("step k" if len(steps) > 1 else "row")
        ax.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=5))
        ax.grid(**GRID)
    low, high = rho.min() / 1.5, rho.max() * 1.5
    for ax in axes[:-1]:
        _logarithmic(ax, np.array([low, high]))
        ax.set_ylim(min(low, 0.5), max(high, 2.0))
        ax.tick_params(labelleft=bool(ax is axes[0]))
        ax.axhline(run.settings["given_rho"], color=EDGE, lw=0.7, zorder=0)
    axes[0].set_ylabel("penalty rho, scaled rows")
    stages = [
        Line2D([], [], color=colour, label=f"stage {i + 1}") for i, colour in enumerate(shades)
    ]
    widest = max((size for _, steps, size in blocks if len(steps) > 1), default=1)
    stages += [
        Line2D([], [], color=EDGE, ls=dashes, label=f"row {i + 1}")
        for i, dashes in enumerate(DASHES[:widest])
        if widest > 1
    ]
    figure.legend(handles=stages, loc="outside lower left", ncols=8, fontsize=8, frameon=False)
    last, count = axes[-1], max(len(before), 1)
    both = np.concatenate([before, after, [1.0]])
    both = np.maximum(both[np.isfinite(both)], 1e-17)
    left, right = 0.5 * both.min(), 2 * both.max()
    for values, name, colour in ((before, "before", BEFORE), (after, "after", AFTER)):
        # What is not finite stays unsolved, at the right end.
        values = np.sort(values[np.isfinite(values)])
        fraction = 100 * np.arange(1, len(values) + 1) / count
        solved = 100 * np.count_nonzero(values <= 1) / count
        last.step(
            np.concatenate([[left], np.maximum(values, left), [right]]),
            np.concatenate([[0.0], fraction, fraction[-1:] if len(fraction) else [0.0]]),
            where="post",
            color=colour,
            lw=1.6,
            label=f"{name}: {solved:.1f} % solved",
        )
    last.axvline(1.0, color=EDGE, lw=0.9, ls=(0, (4, 2)))
    last.set_xscale("log")
    last.set_ylim(0, 103)
    last.set_xlabel("largest residual / tolerance")
    last.set_ylabel("fraction of validation states [%]")
    last.grid(**GRID)
    last.set_axisbelow(True)
    last.legend(fontsize=8, frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
    figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    return figure
