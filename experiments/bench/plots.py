"""Plots of `python experiments/bench`: time a state against the batch, and growth."""

from itertools import product
from typing import Any

import numpy as np
from bench.cases import Row
from bench.growth import Point, exponents
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

# jaxmpc in blue and thick, others from Okabe and Ito's palette.
STYLES: dict[str, dict[str, Any]] = {
    "jaxmpc": dict(color="#00486b", marker="o", lw=2.4, zorder=3),
    "jaxmpc vmap": dict(color="#0072b2", marker="s", lw=2.4, ls="--", zorder=3),
    "daqp": dict(color="#d55e00", marker="^"),
    "moreau": dict(color="#009e73", marker="v"),
    "piqp": dict(color="#cc79a7", marker="D"),
    "osqp": dict(color="#e69f00", marker="<"),
    "clarabel": dict(color="#56b4e9", marker=">"),
    "proxqp": dict(color="#8a8a8a", marker="P"),
    "qpax": dict(color="#b8a600", marker="X"),
    "jaxopt": dict(color="#000000", marker="*"),
}
PLAIN: dict[str, Any] = dict(color="#8a8a8a", marker=".")


def plot_bench(rows: list[Row]) -> Figure:
    """Draw microseconds a state against the batch, a panel for each kind and tolerance (down) and
    each family and horizon (across). Open markers: extrapolated from some of the states."""
    kinds = list(dict.fromkeys((row.what, row.tolerance) for row in rows))
    problems = list(dict.fromkeys((row.family, row.horizon) for row in rows))
    size = (3.2 * len(problems) + 1.9, 2.7 * len(kinds) + 0.4)
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(len(kinds), len(problems), squeeze=False, sharex=True, sharey="row")
    for (i, (what, tolerance)), (j, (family, horizon)) in product(
        enumerate(kinds), enumerate(problems)
    ):
        ax = panels[i, j]
        wanted = (what, tolerance, family, horizon)
        here = [r for r in rows if (r.what, r.tolerance, r.family, r.horizon) == wanted]
        ax.set_title(f"{what} to {tolerance:g}: {family}, N = {horizon}", fontsize=9)
        if not here:
            ax.set_axis_off()
            ax.text(0.5, 0.5, "not measured", ha="center", transform=ax.transAxes, color="0.5")
            continue
        for solver in dict.fromkeys(row.solver for row in here):
            mine = sorted((row for row in here if row.solver == solver), key=lambda r: r.batch)
            style = STYLES.get(solver, PLAIN)
            x, y = [row.batch for row in mine], [row.microseconds for row in mine]
            ax.plot(x, y, **{**style, "marker": ""})
            for hollow in (False, True):
                points = [(r.batch, r.microseconds) for r in mine if r.extrapolated == hollow]
                if points:
                    face = "white" if hollow else style["color"]
                    ax.plot(*np.transpose(points), **{**style, "ls": "", "mfc": face}, ms=5)
        ax.set_xscale("log", base=2)
        ax.set_yscale("log")
        ax.grid(True, which="major", color="0.9", lw=0.6)
        ax.set_axisbelow(True)
        ax.tick_params(which="both", labelsize=8, labelbottom=True)
    for ax in panels[:, 0]:
        ax.set_ylabel("µs a state", fontsize=9)
    for ax in panels[-1]:
        ax.set_xlabel("states in the batch", fontsize=9)
    solvers = [name for name in STYLES if any(row.solver == name for row in rows)]
    handles = [Line2D([], [], label=name, ms=5, **STYLES[name]) for name in solvers]
    if any(row.extrapolated for row in rows):
        open_marker: dict[str, Any] = dict(color="0.4", marker="o", mfc="white", ls="")
        handles.append(Line2D([], [], label="extrapolated", ms=5, **open_marker))
    figure.legend(handles=handles, loc="outside right upper", frameon=False, fontsize=8)
    return figure


def plot_growth(points: list[Point]) -> Figure:
    """Draw seconds and bytes against batch, horizon and number of states, with the line through the
    upper half of the points whose slope is the exponent."""
    names = {"batch": "states in the batch", "N": "horizon N", "n": "number of states n"}
    axes = list(dict.fromkeys(point.axis for point in points))
    figure = Figure(figsize=(3.4 * len(axes) + 0.4, 5.4), layout="constrained")
    panels = figure.subplots(2, len(axes), squeeze=False, sharex="col")
    found = exponents(points)
    for j, axis in enumerate(axes):
        for i, (quantity, unit) in enumerate((("seconds", "s"), ("memory", "bytes"))):
            ax = panels[i, j]
            on_axis = [(p.value, getattr(p, quantity)) for p in points if p.axis == axis]
            known = np.array([(size, value) for size, value in on_axis if value], float)
            ax.set_xscale("log", base=2)
            ax.set_yscale("log")
            ax.grid(True, which="major", color="0.9", lw=0.6)
            ax.tick_params(which="both", labelsize=8)
            if len(known):
                ax.plot(*known.T, color="#0072b2", marker="o", ms=5)
            power = found.get(axis, {}).get(quantity)
            if power is not None:
                upper = known[len(known) // 2 :] if len(known) > 3 else known
                level = np.exp(np.mean(np.log(upper[:, 1]) - power * np.log(upper[:, 0])))
                ax.plot(upper[:, 0], level * upper[:, 0] ** power, color="#d55e00", ls="--")
                ax.set_title(f"{quantity} ~ {axis}^{power:.2f}", fontsize=9, color="#d55e00")
            if j == 0:
                ax.set_ylabel(f"{quantity} ({unit})" if quantity == "memory" else "seconds")
            if i == 1:
                here = next(p for p in points if p.axis == axis)
                fixed = "" if axis == "batch" else f" (batch {here.batch:,})"
                ax.set_xlabel(f"{names[axis]}, {here.family}{fixed}", fontsize=9)
    return figure
