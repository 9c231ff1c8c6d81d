"""The outcome of closed loops: limits kept, target reached, settling time, cost; a summary of many
runs."""

from dataclasses import asdict
from typing import Any

import jax
import numpy as np

from jaxmpc.arrays import Reals, host_array
from jaxmpc.checks import fail, require_finite, require_kind, require_shape
from jaxmpc.closed_loop.orientations import host_errors
from jaxmpc.closed_loop.simulation import Run
from jaxmpc.closed_loop.stored_runs import StoredRuns
from jaxmpc.files import versions
from jaxmpc.pytrees import record
from jaxmpc.qp.status import Status
from jaxmpc.robots.description import host_coordinates
from jaxmpc.robots.linear_plant import LinearPlant
from jaxmpc.robots.robot import Robot
from jaxmpc.sets.convex_sets import Box
from jaxmpc.sets.limits import TOLERANCE, row_violations, rows_kept


@record
class Outcome:
    """What B closed loops of T time steps achieved, from their states and inputs, in float64.

    coordinates (B, T+1, n): the states in the coordinates of the limits. state_excess
    (B, T+1, n), input_excess (B, T, m): by how much each limit is violated, in its unit; 0 inside,
    NaN where the run is not finite. band (n,): largest distance that counts as at the target.
    The other fields have one entry for each loop, (B,):
      kept          all limits of states and inputs hold at all times (to `sets.limits.TOLERANCE`)
      reached       the last state is within the band of the target, in every coordinate
      settling      time in s from which on every coordinate stays within the band; inf: never
      cost          sum of the stage costs
      plans_valid   every plan was SOLVED and kept its limits along its horizon (no fallback)
    """

    coordinates: np.ndarray
    state_excess: np.ndarray
    input_excess: np.ndarray
    band: np.ndarray
    kept: np.ndarray
    reached: np.ndarray
    settling: np.ndarray
    cost: np.ndarray
    plans_valid: np.ndarray

    @property
    def success(self) -> np.ndarray:
        """Return whether limits were kept and the target was reached, (B,)."""
        return self.kept & self.reached


def evaluate_runs(
    run: Run, plant: Robot | LinearPlant, reference: Reals, *, tolerance: float = 0.02
) -> Outcome:
    """Evaluate closed loops whose target is rest at `reference`.

    run: from `simulate` or `simulate_many`, with or without a batch axis. plant: the Robot or
    LinearPlant whose limits count, without margin. reference (n,): the set-point, in coordinates.
    tolerance: the band, as a fraction of each coordinate's `Box.half_widths`; a robot's velocity
    without limits has none, since nobody said what is slow. Raises ValueError for other shapes.
    """
    run = run.on_host()
    require_shape("reference", reference, (plant.n,), "The set-point, in coordinates")
    require_finite("reference", reference)
    if not tolerance > 0:
        fail("tolerance", f"{tolerance}", "Give a positive fraction")
    limits = with_limits(plant, run)
    xi, band = limits[0][1], tolerance * np.asarray(plant.state_limits.half_widths())
    if isinstance(plant, Robot):
        lower, upper = plant.state_limits.bounds()
        velocities = np.arange(plant.n) >= plant.mujoco.nv
        band = np.where(velocities & np.isinf(lower) & np.isinf(upper), np.inf, band)
    inside = np.abs(host_errors(plant, xi, host_array("reference", reference))) <= band
    inside = inside.all(axis=2)
    # Time steps before the last stretch inside: T + 1 less its length.
    before = inside.shape[1] - np.cumprod(inside[:, ::-1], axis=1).sum(axis=1)
    state_excess, input_excess = (row_violations(*pair) for pair in limits)
    solved = np.asarray(run.status) == Status.SOLVED
    return Outcome(
        coordinates=xi,
        state_excess=state_excess,
        input_excess=input_excess,
        band=band,
        kept=np.all([rows_kept(*pair).all(axis=(1, 2)) for pair in limits], axis=0),
        reached=inside[:, -1],
        settling=np.where(inside[:, -1], before * plant.dt, np.inf),
        cost=np.asarray(run.stage_cost, float).sum(axis=1),
        plans_valid=(solved & ~np.asarray(run.fallback)).all(axis=1),
    )


def with_limits(plant: Robot | LinearPlant, run: Run) -> list[tuple[Box, np.ndarray]]:
    """Return (limits, values) of the states, as coordinates, and of the inputs of a run, in
    float64 NumPy arrays."""
    return [
        (Box(*plant.state_limits.bounds()), host_coordinates(plant, run.states)),
        (Box(*plant.input_limits.bounds()), np.asarray(run.inputs, float)),
    ]


@record
class RunsSummary:
    """What many runs of a robot come to. data: the numbers, as JSON data; `print` shows the table
    of `rows`. outcome: of each robot."""

    data: dict[str, Any]
    outcome: Outcome

    def __str__(self) -> str:
        return "\n".join(f"  {name:<13} {value}" for name, value in self.rows())

    __repr__ = __str__

    def rows(self) -> list[tuple[str, str]]:
        """Return the rows of the table, name and value."""
        return _outcome_rows(self.data) + _plan_rows(self.data) + _time_rows(self.data)


def summarise_runs(
    runs: StoredRuns | Run,
    robot: Robot,
    reference: Reals,
    input_reference: Reals,
    *,
    tolerance: float = 0.02,
) -> RunsSummary:
    """Return the summary of runs whose target is rest at reference (n,) under input_reference (m,).

    runs: of `simulate_into`, or of `simulate_many`, with a batch axis. tolerance: see
    `evaluate_runs`. With runs of a store the summary has their settings and the time they took.
    """
    require_kind("robot", robot, Robot)
    run = (runs.run if isinstance(runs, StoredRuns) else runs).on_host()
    outcome = evaluate_runs(run, robot, reference, tolerance=tolerance)
    names = robot.state_names
    count = lambda v: int(np.count_nonzero(v))
    solved = run.status == Status.SOLVED
    mpc = bool(np.any(run.status != Status.NOT_RUN))
    data = {
        "robot": robot.name,
        "robots": len(outcome.kept),
        "samples": run.inputs.shape[1],
        "control_period": robot.dt,
        "time_unit": robot.time_unit,
        "success": count(outcome.success),
        "limits_kept": count(outcome.kept),
        "limits_kept_to": TOLERANCE["float64"],
        "reached": count(outcome.reached),
        "not_finite": count(~np.isfinite(run.states).all(axis=(1, 2))),
        "plans_valid": count(outcome.plans_valid) if mpc else None,
        "plans_valid_and_kept": count(outcome.plans_valid & outcome.kept) if mpc else None,
        **_violations(robot, outcome),
        "plans": int(np.size(run.status)) if mpc else 0,
        "plans_solved": count(solved),
        "fallback_plans": count(solved & run.fallback),
        "unsolved_plans": count(~solved) if mpc else 0,
        "settling": _levels(outcome.settling),
        "cost": _levels(outcome.cost),
        "target": _by_name(names, reference),
        "target_input": _by_name(robot.input_names, input_reference),
        "tolerance": _by_name(names, outcome.band),
        "versions": versions(),
        "device": jax.devices()[0].device_kind,
    }
    if isinstance(runs, StoredRuns):
        data |= {"this_run": _speed(runs, robot), "config": runs.settings}
    return RunsSummary(data, outcome)


def _by_name(names: tuple[str, ...], values: Reals) -> dict[str, float]:
    return dict(zip(names, np.asarray(values).tolist(), strict=True))


def _levels(values: np.ndarray) -> dict[str, float | None]:
    """Return the median and the 95 % quantile, None where they are not finite."""
    finite = np.where(np.isnan(values), np.inf, values)
    levels = np.quantile(finite, [0.5, 0.95], method="higher").tolist()
    median, most = (value if np.isfinite(value) else None for value in levels)
    return {"median": median, "95 %": most}


def _violations(robot: Robot, outcome: Outcome) -> dict[str, Any]:
    """Return the largest violation of each coordinate and input, and the one that is the largest
    relative to half the range."""
    excess = (outcome.state_excess, outcome.input_excess)
    states, inputs = (np.nanmax(v, axis=(0, 1), initial=0.0) for v in excess)
    limits = (robot.state_limits, robot.input_limits)
    worst = np.concatenate([states, inputs])
    i = int(np.argmax(worst / np.concatenate([box.half_widths() for box in limits])))
    names = (*robot.state_names, *robot.input_names)
    units = (*robot.state_units, *robot.input_units)
    return {
        "worst_violation": {"of": names[i], "by": float(worst[i]), "unit": units[i]},
        "violations": {
            "states": _by_name(robot.state_names, states),
            "inputs": _by_name(robot.input_names, inputs),
        },
    }


def _speed(runs: StoredRuns, robot: Robot) -> dict[str, float]:
    """Return the work of the call that made the runs, and its speed if there was any."""
    timing, steps = runs.timing, runs.run.inputs.shape[1]
    found = asdict(timing)
    if timing.count:
        rate = timing.count * steps / timing.run_seconds
        found["solves_per_second"] = rate
        if robot.time_unit == "s":
            found["robot_seconds_per_second"] = rate * robot.dt
            found["real_time_factor"] = steps * robot.dt / timing.run_seconds
    return found


def _outcome_rows(s: dict[str, Any]) -> list[tuple[str, str]]:
    length = f"{s['samples']:,} samples of {s['control_period']:g} {s['time_unit']} each"
    rows = [
        ("robots", f"{s['robots']:>9,}  {length}"),
        ("success", f"{_share(s, 'success')}  limits kept, and at the target at the end"),
        ("limits kept", f"{_share(s, 'limits_kept')}  to {s['limits_kept_to']:g}, all samples"),
    ]
    if s["not_finite"]:
        rows.append(("not finite", _share(s, "not_finite")))
    return rows


def _share(s: dict[str, Any], key: str, of: str = "robots") -> str:
    return f"{s[key]:>9,}  {s[key] / s[of]:8.2%}"


def _plan_rows(s: dict[str, Any]) -> list[tuple[str, str]]:
    rows, worst = [], s["worst_violation"]
    if s["plans"]:
        kept = f"of these {s['plans_valid_and_kept']:,} kept all limits"
        rows.append(("plans valid", f"{_share(s, 'plans_valid')}  {kept}"))
    beyond = f"{worst['by']:.3g} {worst['unit']} beyond a limit of {worst['of']}"
    rows.append(("worst", beyond if worst["by"] else "no limit exceeded"))
    if s["plans"]:
        for key, label, what in (
            ("plans_solved", "plans solved", ""),
            ("fallback_plans", "fallback", "  solved, but with slack in soft limits"),
            ("unsolved_plans", "unsolved", "  say nothing about limits"),
        ):
            rows.append((label, f"{_share(s, key, 'plans')}  of {s['plans']:,}{what}"))
    return rows


def _time_rows(s: dict[str, Any]) -> list[tuple[str, str]]:
    rows = [
        ("settling", _middle(s["settling"], "never settle", f" {s['time_unit']}")),
        ("cost", _middle(s["cost"], "not finite", "")),
    ]
    this = s.get("this_run")
    if this:
        rows.append(("compile", f"{this['compile_seconds']:.2f} s"))
    if this and this["count"]:
        what = "MPC solves" if s["plans"] else "control steps"
        robots, rate = f"{this['count']:,}", f"{this['solves_per_second']:,.0f} {what}/s"
        rows.append(("run", f"{this['run_seconds']:.2f} s for {robots} robots, {rate}"))
        if s["time_unit"] == "s":
            speed = f"{this['robot_seconds_per_second']:,.4g} robot-seconds/s"
            factor = f"{this['real_time_factor']:.3g} times real time"
            rows.append(("real time", f"{speed}; all {robots} at {factor}"))
    return rows


def _middle(levels: dict[str, float | None], missing: str, unit: str) -> str:
    """Return the levels in words."""
    median, most = levels["median"], levels["95 %"]
    if median is None:
        return f"more than half {missing}"
    last = f"95 % up to {most:.4g}{unit}" if most is not None else f"more than 5 % {missing}"
    return f"median {median:.4g}{unit}, {last}"
