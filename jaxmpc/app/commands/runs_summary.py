"""Summary of many closed loops: as JSON data, and as a table."""

import dataclasses
from typing import Any

import jax
import numpy as np

from jaxmpc.app.commands.options import Timing
from jaxmpc.app.commands.robot_runs import RobotRuns
from jaxmpc.closed_loop.outcome import Outcome
from jaxmpc.closed_loop.run import Run
from jaxmpc.files import versions
from jaxmpc.qp.status import Status
from jaxmpc.sets.violations import TOLERANCE


def summarise(runs: RobotRuns, run: Run, outcome: Outcome, timing: Timing) -> dict[str, Any]:
    """Return the numbers of the table, with target, configuration and versions, as JSON data."""
    robot, plans = runs.robot, int(np.size(run.status))
    names = [*robot.state_names, *robot.input_names]
    units = [*robot.state_units, *robot.input_units]
    violations = [outcome.state_excess, outcome.input_excess]
    worst = np.concatenate([np.nanmax(v, axis=(0, 1), initial=0.0) for v in violations])
    widths = [b.half_widths() for b in (robot.state_limits, robot.input_limits)]
    i = int(np.argmax(worst / np.concatenate(widths)))
    finite = lambda v: float(v) if np.isfinite(v) else None
    level = lambda v, q: finite(np.quantile(np.where(np.isnan(v), np.inf, v), q, method="higher"))
    levels = lambda v: {"median": level(v, 0.5), "95 %": level(v, 0.95)}
    count = lambda v: int(np.count_nonzero(v))
    seconds = runs.steps * robot.dt
    simulated = {}
    if timing.count:
        simulated = {
            "solves_per_second": timing.count * runs.steps / timing.run_seconds,
            "robot_seconds_per_second": timing.count * seconds / timing.run_seconds,
            "real_time_factor": seconds / timing.run_seconds,
        }
    mpc = runs.command.linearize != "lqr"
    return {
        "robot": robot.name,
        "robots": len(outcome.kept),
        "samples": runs.steps,
        "control_period": robot.dt,
        "success": count(outcome.success),
        "limits_kept": count(outcome.kept),
        "limits_kept_to": TOLERANCE["float64"],
        "reached": count(outcome.reached),
        "not_finite": count(~np.isfinite(run.states).all(axis=(1, 2))),
        "plans_valid": count(outcome.plans_valid) if mpc else None,
        "plans_valid_and_kept": count(outcome.plans_valid & outcome.kept) if mpc else None,
        "worst_violation": {"of": names[i], "by": float(worst[i]), "unit": units[i]},
        "violations": {
            "states": dict(zip(robot.state_names, worst[: robot.n].tolist(), strict=True)),
            "inputs": dict(zip(robot.input_names, worst[robot.n :].tolist(), strict=True)),
        },
        "plans": plans if mpc else 0,
        "plans_solved": count(run.status == Status.SOLVED),
        "fallback_plans": count((run.status == Status.SOLVED) & run.fallback),
        "unsolved_plans": count(run.status != Status.SOLVED) if mpc else 0,
        "settling": levels(outcome.settling),
        "cost": levels(outcome.cost),
        "this_run": {**dataclasses.asdict(timing), **simulated},
        "target": dict(zip(robot.state_names, runs.reference.tolist(), strict=True)),
        "target_input": dict(zip(robot.input_names, runs.input_reference.tolist(), strict=True)),
        "tolerance": dict(zip(robot.state_names, outcome.band.tolist(), strict=True)),
        "config": runs.kept.attributes["config"],
        "versions": versions(),
        "device": jax.devices()[0].device_kind,
    }  # fmt: skip


def summary_rows(s: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the rows of the table, name and value, from the summary."""
    fraction = lambda key: f"{s[key]:>9,}  {s[key] / s['robots']:8.2%}"
    mpc, worst, this = s["plans"] > 0, s["worst_violation"], s["this_run"]
    after = lambda v: "never" if v is None else f"{v:.4g} s"
    number = lambda v: "not finite" if v is None else f"{v:.4g}"
    middle = lambda key, show: f"median {show(s[key]['median'])}, 95 % up to {show(s[key]['95 %'])}"
    length = f"{s['samples']:,} samples of {s['control_period']:g} s each"
    rows = [
        ("robots", f"{s['robots']:>9,}  {length}"),
        ("success", f"{fraction('success')}  limits kept, and at the target at the end"),
        ("limits kept", f"{fraction('limits_kept')}  to {s['limits_kept_to']:g}, all samples"),
    ]
    if s["not_finite"]:
        rows.append(("not finite", fraction("not_finite")))
    if mpc:
        kept = f"of these {s['plans_valid_and_kept']:,} kept all limits"
        rows.append(("plans valid", f"{fraction('plans_valid')}  {kept}"))
    beyond = f"{worst['by']:.3g} {worst['unit']} beyond a limit of {worst['of']}"
    rows.append(("worst", beyond if worst["by"] else "no limit exceeded"))
    if mpc:
        for key, label, what in (
            ("plans_solved", "plans solved", ""),
            ("fallback_plans", "fallback", "  solved, but with slack in soft limits"),
            ("unsolved_plans", "unsolved", "  say nothing about limits"),
        ):
            part = f"{s[key]:>9,}  {s[key] / s['plans']:8.2%}"
            rows.append((label, f"{part}  of {s['plans']:,}{what}"))
    rows.append(("settling", middle("settling", after)))
    rows.append(("cost", middle("cost", number)))
    rows.append(("compile", f"{this['compile_seconds']:.2f} s"))
    if this["count"]:
        what = "MPC solves" if mpc else "control steps"
        rate = f"{this['solves_per_second']:,.0f} {what}/s"
        rows.append(("run", f"{this['run_seconds']:.2f} s for {this['count']:,} robots, {rate}"))
        rows.append(
            (
                "real time",
                f"{this['robot_seconds_per_second']:,.4g} robot-seconds/s; all "
                f"{this['count']:,} at {this['real_time_factor']:.3g} times real time",
            )
        )
    return rows
