"""trade_off: several losses at once, tuned for one ratio of their weights after another.

Each point is the least weighted sum of the losses, from the values of the point before. A minimum
of a sum with positive weights is Pareto optimal: no other has all losses as low and one of them
lower. Of a front that is not convex sums find the convex part (Boyd and Vandenberghe 2004, §4.7.4).
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from jaxmpc.arrays import Reals
from jaxmpc.checks import fail, require_finite, require_real, whole
from jaxmpc.closed_loop.simulation import Run
from jaxmpc.pytrees import record
from jaxmpc.tuning.descent import Settings
from jaxmpc.tuning.losses import TERM, SeveralLosses
from jaxmpc.tuning.parameters import Parameters, moved, raw
from jaxmpc.tuning.result import Interrupted, TuningRun
from jaxmpc.tuning.weights import prepared

# The largest ratio of the weights of two losses, in shares of their values at the start.
RATIO = 10.0


@record
class TradeOff:
    """What several losses come to where they are tuned with K ratios of their weights.

    names: of the L losses. weights (K, L): by which they are summed at each point. losses (K, L):
    means over the validation loops with the values of each point. initial (L,): with those given.
    runs: the K `TuningRun`s, each from the values of the one before; `runs[k].values` and
    `runs[k].result` are those of point k.
    """

    names: tuple[str, ...]
    weights: np.ndarray
    losses: np.ndarray
    initial: np.ndarray
    runs: tuple[TuningRun, ...]

    @property
    def efficient(self) -> np.ndarray:
        """Return which points (K,) are Pareto optimal among all of them and the given values: none
        has all losses at most as high and one lower."""
        others = np.vstack([self.losses, self.initial])
        lower = np.all(others[None] <= self.losses[:, None], axis=2)
        return ~np.any(lower & np.any(others[None] < self.losses[:, None], axis=2), axis=1)

    def __repr__(self) -> str:
        """Return the weights and losses of each point, one a line."""
        row = lambda cells: "  " + "".join(f"{cell:>14}" for cell in cells)
        number = "{:.5g}".format
        lines = ["TradeOff, losses on the validation set:"]
        lines.append(row(["", *(f"weight of {n}"[:13] for n in self.names), *self.names]))
        blank = [""] * len(self.names)
        lines.append(row(["as given", *blank, *map(number, self.initial)]))
        for k, efficient in enumerate(self.efficient):
            cells = map(number, (*self.weights[k], *self.losses[k]))
            lines.append(row([f"point {k}", *cells]) + ("" if efficient else "  dominated"))
        return "\n".join(lines)

    def record(self) -> dict[str, Any]:
        """Return the trade-off as JSON data: the arrays, and the record of each run."""
        return {
            "names": list(self.names),
            "weights": self.weights.tolist(),
            "losses": self.losses.tolist(),
            "initial": self.initial.tolist(),
            "efficient": self.efficient.tolist(),
            "runs": [run.record() for run in self.runs],
        }


def trade_off(
    make_mpc: Callable[[Mapping[str, Any]], Any],
    parameters: Parameters,
    plant: Any,
    x0s: Reals,
    losses: Mapping[str, Callable[[Run], Any]],
    steps: int = 50,
    *,
    weights: int | Reals = 5,
    **options: Any,
) -> TradeOff:
    """Tune for one ratio after another of the weights of several losses.

    losses: name → loss of one run, L ≥ 2 of them. weights (K, L): by which the losses are summed at
    each of K points, in the order in which these are tuned. A number, for two losses: so many
    points, the ratio of the weights from 10:1 to 1:10 evenly in its logarithm, where each loss
    counts in shares of its value at the start. make_mpc, parameters, plant, x0s, steps: as in
    `tune_weights`. options: what else this takes (reference, solver, mode, updates, ...), but for
    loss and starts. `updates` are for each point, which starts from the values of the point before;
    all points share their programs. Checkpoints of the points: NAME.npz, NAME-1.npz, ...

    Raises ValueError for what does not fit together, before any compile but for weights that do not
    follow from the losses at the start; and on Ctrl-C `Interrupted`, whose `run` is the `TradeOff`
    of the points that were begun.
    """
    if not isinstance(losses, Mapping) or len(losses) < 2:
        fail("losses", f"is {losses!r}", 'Give two or more, {"tracking": ..., "effort": ...}')
    for name, function in losses.items():
        if not callable(function):
            fail(f"losses[{name!r}]", f"is a {type(function).__name__}", "Give a function of a Run")
    given = _given_weights(weights, len(losses))
    known = ("reference", "input_reference", "variations", "conditions", "solver", "design_loss")
    fixed = {name: options.pop(name) for name in (*known, "mode") if name in options}
    functions = SeveralLosses(dict(losses))
    settings = Settings.of("trade_off", options)
    loops = prepared(make_mpc, parameters, plant, x0s, functions, steps, settings, **fixed)
    _, start = loops.validate(raw(parameters))
    initial = np.array([start[f"{TERM}{name}"] for name in losses])
    ratios = given if isinstance(given, np.ndarray) else _even_weights(given, initial, losses)
    runs: list[TuningRun] = []
    stopped = False
    try:
        for number, row in enumerate(ratios):
            loops.weigh(row)
            runs.append(loops.run(parameters, number))
            parameters = moved(parameters, runs[-1].values)
    except Interrupted as stop:
        runs.append(stop.run)
        stopped = True
    except KeyboardInterrupt:
        if not runs:
            raise
        stopped = True
    found = np.array([[run.after[f"{TERM}{name}"] for name in losses] for run in runs])
    result = TradeOff(tuple(losses), ratios[: len(runs)], found, initial, tuple(runs))
    if stopped:
        raise Interrupted(result, f"{len(runs)} of {len(ratios)} points")
    return result


def _given_weights(weights: int | Reals, count: int) -> int | np.ndarray:
    """Return weights (K, L), or the number of points, as given."""
    require_real("weights", weights)
    found = np.asarray(weights)
    if found.ndim == 0:
        if count > 2:
            fail("weights", f"{weights} for {count} losses", f"Give weights (K, {count})")
        return whole("weights", weights, 2)
    found = found.astype(np.float64)
    if found.ndim != 2 or found.shape[1] != count or not len(found):
        fail("weights", f"shape {found.shape}", f"Give (K, {count}), one row a point")
    require_finite("weights", found)
    if np.any(found < 0) or not np.all(found.any(axis=1)):
        fail("weights", f"{found.tolist()}", "Give weights >= 0, one of them positive in each row")
    return found


def _even_weights(points: int, initial: np.ndarray, names: Iterable[str]) -> np.ndarray:
    """Return the weights (K, 2) of two losses, whose sum is 1 in shares of the initial losses."""
    for name, value in zip(names, initial, strict=True):
        if not value > 0:
            cure = "Give weights (K, 2): shares of it are none"
            fail(f"losses[{name!r}]", f"is {value:g} with the values given", cure)
    ratio = RATIO ** np.linspace(1, -1, points)
    return np.stack([ratio, np.ones(points)], axis=1) / (1 + ratio)[:, None] / initial
