"""How the work of maps, plans, robots and gradients divides among the devices of one host.

    python experiments/many_devices.py --devices 1 2 4 8 --output results   # GPUs
    python experiments/many_devices.py --what labels --scale 0.001          # CPUs, small

Writes after each measurement what is there so far: a line to `many_devices.json` (what is there
already is kept, and not measured again), the table `many_devices.md` and the plot
`many_devices.png`. On CPUs set XLA_FLAGS=--xla_force_host_platform_device_count=4 for 4 devices.

labels, plans of the lesson's joint: on the devices, whose states are there and whose results stay
there (labels) or go from NumPy and stay (plans); to NumPy, from NumPy. arms: of 7 joints for 1 s,
planned every 10 ms. gradients: of the loss of closed loops with respect to Q and R, as
`tune_weights` has them, NumPy to NumPy. A digest tells whether results have the same bits: of arms
and gradients it may differ between numbers of devices, for each device gathers other groups of its
part.
"""

import hashlib
import json
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from bench.families import family, joint
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter, ScalarFormatter
from user_calls import uniform

import jaxmpc as jm
from jaxmpc.batches import Compiled, chosen_devices, over_devices, placement, to_host
from jaxmpc.feasible.hull_labels import hull_for
from jaxmpc.feasible.pipeline import compiled_hull
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.systems.given_model import as_argument
from jaxmpc.tuning.losses import ClosedLoopLoss
from jaxmpc.tuning.objective import ClosedLoopObjective
from jaxmpc.tuning.parameters import Parameter, raw

# The batches of each kind of work, and the least number of times that one device is asked for, by
# number of devices.
SIZES = {
    "labels": (2**24, 2**26),
    "plans": (2**23,),
    "arms": (16_384, 65_536),
    "gradients": (65_536,),
}
GOALS = {
    "labels, on the devices": {2: 1.9, 4: 3.7, 8: 7.2},
    "plans, on the devices": {2: 1.9, 4: 3.7, 8: 7.2},
    "plans, to NumPy": {2: 1.6, 4: 2.5},
    "arms": {2: 1.8, 4: 3.4, 8: 6.0},
}
FILE = "many_devices.json"
COLUMNS = (
    "what", "count", "devices", "seconds", "times one device", "asked for", "compile (s)",
    "cores busy", "GB/s a device", "peak a device (GB)", "bits",
)  # fmt: skip


@dataclass(frozen=True)
class Settings:
    """devices: numbers of devices to compare. what: kinds of work. scale: of the batches. rounds:
    calls after the first one, of which the fastest counts. output: folder of the results."""

    devices: tuple[int, ...] = (1, 2, 4, 8)
    what: tuple[str, ...] = tuple(SIZES)
    scale: float = 1.0
    rounds: int = 3
    output: Path = Path("many_devices")


# One measured call: () → result.
Call = Callable[[], Any]


def label_calls(count: int, devices: int) -> dict[str, Call]:
    """Return the calls that label so many states."""
    points, chosen = uniform(count), chosen_devices(devices)
    problem = FeasibilityProblem.of(joint())
    with jax.enable_x64(True):
        hull = jax.device_put(hull_for(problem, 1e9), placement(chosen))
        there = jax.device_put(points, placement(chosen, True))
    program = compiled_hull(chosen)

    def on_devices() -> Any:
        with jax.enable_x64(True):
            return program.run(hull, there)[1]

    to_numpy = lambda: jm.map_feasible_set(problem, points, devices=devices).label
    return {"labels, on the devices": on_devices, "labels, to NumPy": to_numpy}


def plan_calls(count: int, devices: int) -> dict[str, Call]:
    """Return the calls that solve for so many states, and that copies their plans."""
    states = np.resize(np.asarray(family("joint", min(count, 2**20))[1]), (count, 2))
    with jax.enable_x64(True):
        controller = jm.Controller(joint())
    solve = lambda to_host: jm.solve_many(controller, states, devices=devices, to_host=to_host)
    kept: list[Any] = []

    def on_devices() -> Any:
        kept[:] = []  # two of these may not fit
        kept[:] = [jax.block_until_ready(solve(False))]
        return kept[0]

    def copied() -> Any:
        return to_host(kept[0])

    def to_numpy() -> Any:
        kept[:] = []
        return solve(True)

    return {
        "plans, on the devices": on_devices,
        "copies of plans": copied,
        "plans, to NumPy": to_numpy,
    }


def arm_calls(count: int, devices: int) -> dict[str, Call]:
    """Return the call that simulates so many arms."""
    robot, chosen = jm.load_robot("arm7"), chosen_devices(devices)
    nv, x_ref, u_ref = robot.mujoco.nv, *robot.equilibrium()
    Q, R = np.r_[np.full(nv, 10.0), np.full(nv, 0.1)], np.full(robot.m, 1e-3)
    mpc = jm.robot_mpc(robot, Q, R, 20)
    solver = jm.ADMM(iterations=0, newton_steps=None)
    controller = jm.RobotController(robot, mpc, solver, linearize="state")
    random = np.random.default_rng(0)
    far = [0.4 * random.normal(size=(count, nv)), 0.3 * random.normal(size=(count, nv))]
    lower, upper = np.asarray(mpc.states.lower), np.asarray(mpc.states.upper)
    room = 0.05 * np.nan_to_num(upper - lower, posinf=0.0)
    starts = np.asarray(robot.coordinates(x_ref)) + np.hstack(far)
    starts = np.clip(starts, lower + room, upper - room)
    x0s = np.asarray(jax.vmap(robot.state)(jnp.asarray(starts, jnp.float32)))
    aims = (
        jnp.asarray(robot.coordinates(jnp.asarray(x_ref)), x0s.dtype),
        jnp.asarray(u_ref, x0s.dtype),
    )
    steps = round(1 / robot.dt)

    def loops(controller: Any, x0s: Any) -> Any:
        aim = dict(reference=aims[0], input_reference=aims[1])
        run = jax.vmap(lambda x: jm.simulate(controller, robot, x, steps, **aim))(x0s)
        return run.states[:, -1], run.status

    program = over_devices(loops, chosen, (False, True))
    controller = jax.device_put(controller, placement(chosen))
    return {"arms": lambda: program(controller, x0s)}


def gradient_calls(count: int, devices: int) -> dict[str, Call]:
    """Return the call of one gradient of so many closed loops."""
    mpc, chosen = joint(), chosen_devices(devices)
    start = {
        "Q": Parameter(np.asarray(mpc.Q), "definite"),
        "R": Parameter(np.asarray(mpc.R), "definite"),
    }
    make = lambda v: replace(mpc, **v)
    states = np.resize(np.asarray(family("joint", min(count, 2**16))[1]), (count, 2))
    loss = ClosedLoopLoss(np.asarray(mpc.Q), np.asarray(mpc.R))
    objective = ClosedLoopObjective(
        lambda v: jm.Controller(make(v), jm.ADMM()), start, as_argument(mpc.system), 20, loss,
        None, None, None,
    )  # fmt: skip
    theta, ones = raw(start), np.ones(count)
    _, slope = objective.gradient(theta, (states, {}), "reverse", chosen)
    return {"gradients": lambda: slope(theta, states, {}, ones)[:2]}


KINDS = {
    "labels": label_calls,
    "plans": plan_calls,
    "arms": arm_calls,
    "gradients": gradient_calls,
}


def digest(tree: Any) -> str:
    """Return a short hash of all bits of a result."""
    found = hashlib.sha256()
    for leaf in jax.tree.leaves(to_host(tree)):
        found.update(np.ascontiguousarray(leaf).view(np.uint8).data)
    return found.hexdigest()[:12]


def size_of(tree: Any) -> int:
    """Return the bytes of all arrays."""
    return sum(leaf.nbytes for leaf in jax.tree.leaves(tree))


def peak_bytes(devices: int) -> int:
    """Return the largest peak of memory in use on one of the devices so far, 0 where none tells."""
    found = [device.memory_stats() or {} for device in jax.local_devices()[:devices]]
    return max(each.get("peak_bytes_in_use", 0) for each in found)


def measured(
    call: Call, name: str, count: int, devices: int, rounds: int, compiled: float
) -> dict[str, Any]:
    """Return a line of the table: what a call takes; compiled: seconds of compiling before it."""
    begun = time.perf_counter()
    result = jax.block_until_ready(call())
    first, compiled = time.perf_counter() - begun, Compiled.seconds - compiled
    size, bits = size_of(result), digest(result) if "copies" not in name else ""
    del result
    times = []
    for _ in range(rounds):
        begun, busy = time.perf_counter(), time.process_time()
        result = jax.block_until_ready(call())
        times.append((time.perf_counter() - begun, time.process_time() - busy))
        del result
    seconds, busy = min(times)
    return {
        "what": name, "count": count, "devices": devices, "seconds": seconds, "first": first,
        "compile": compiled, "cores": busy / seconds, "peak": peak_bytes(devices), "bytes": size,
        "host": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024, "bits": bits,
        "kind": jax.local_devices()[0].device_kind,
    }  # fmt: skip


def table(rows: list[dict[str, Any]]) -> str:
    """Return the table in Markdown."""
    lines = [f"| {' | '.join(COLUMNS)} |", "|" + "---|" * len(COLUMNS)]
    for row in rows:
        one = next((r for r in rows if same_work(r, row) and r["devices"] == 1), None)
        ratio = f"{one['seconds'] / row['seconds']:.2f}" if one else ""
        goal = GOALS.get(row["what"], {}).get(row["devices"], "")
        rate = row["bytes"] / row["seconds"] / row["devices"] / 1e9
        rate = f"{rate:.1f}" if "copies" in row["what"] or "NumPy" in row["what"] else ""
        bits = (
            "" if not one or not row["bits"] else "same" if one["bits"] == row["bits"] else "other"
        )
        cells = [
            row["what"], f"{row['count']:,}", row["devices"], f"{row['seconds']:.4f}", ratio, goal,
            f"{row['compile']:.1f}", f"{row['cores']:.1f}", rate, f"{row['peak'] / 1e9:.1f}", bits,
        ]  # fmt: skip
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines)


def same_work(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Return whether two lines are about the same work on the same kind of device."""
    return all(one[key] == other[key] for key in ("what", "count", "kind"))


def picture(rows: list[dict[str, Any]]) -> Figure:
    """Draw how many times faster than one device several are."""
    figure = Figure(figsize=(5.5, 3.8), layout="constrained")
    ax = figure.subplots()
    colours = [
        "#00486b",
        "#0072b2",
        "#d55e00",
        "#e69f00",
        "#009e73",
        "#56b4e9",
        "#cc79a7",
        "#000000",
    ]
    most = max(row["devices"] for row in rows)
    ax.plot([1, most], [1, most], color="0.7", ls="--", label="in proportion")
    works = [row for row in rows if row["devices"] == 1]
    for one, colour in zip(works, colours * len(works), strict=False):
        mine = sorted(
            (r["devices"], one["seconds"] / r["seconds"]) for r in rows if same_work(r, one)
        )
        ax.plot(
            *np.transpose(mine), color=colour, marker="o", label=f"{one['what']}: {one['count']:,}"
        )
    ax.set(xscale="log", yscale="log", xlabel="devices", ylabel="times as fast as one")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_ticks(sorted({row["devices"] for row in rows} | {1}))
        axis.set_major_formatter(ScalarFormatter())
        axis.set_minor_formatter(NullFormatter())
    ax.legend(fontsize=7, frameon=False)
    ax.set_title(f"{rows[0]['kind']}, one host")
    return figure


def main(s: Settings) -> None:
    """Measure what is asked for, and write it down."""
    s.output.mkdir(parents=True, exist_ok=True)
    file = s.output / FILE
    rows = json.loads(file.read_text()) if file.exists() else []
    there = len(jax.local_devices())
    print(f"JAX {jax.__version__}, {there} x {jax.local_devices()[0].device_kind}", flush=True)
    for what in s.what:
        for size in SIZES[what]:
            count = 64 * max(round(size * s.scale / 64), 1)
            for devices in (d for d in s.devices if d <= there):
                known = [(r["what"], r["count"], r["devices"]) for r in rows]
                if any(name.startswith(what) and rest == [count, devices] for name, *rest in known):
                    continue
                compiled = Compiled.seconds
                for name, call in KINDS[what](count, devices).items():
                    row = measured(call, name, count, devices, s.rounds, compiled)
                    compiled = Compiled.seconds
                    rows.append(row)
                    print(json.dumps(row), flush=True)
                    write(s.output, rows)
    print(table(rows))


def write(folder: Path, rows: list[dict[str, Any]]) -> None:
    """Write the lines, the table and the plot."""
    (folder / FILE).write_text(json.dumps(rows, indent=1))
    (folder / "many_devices.md").write_text(table(rows) + "\n")
    picture(rows).savefig(folder / "many_devices.png", dpi=150)


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
