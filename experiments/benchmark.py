"""Speed of jaxmpc on the lesson's joint beside the solvers that robotics uses, in one run.

    python experiments/benchmark.py                    # the whole table, about three minutes
    python experiments/benchmark.py --states 4096 --no-growth

Every contestant gets the same states, a random draw from the box of the state limits widened by
6 % (so that some are infeasible), and the same condensed QP. Compilation and set-up are timed
apart. Residuals are recomputed here, from each contestant's (z, y), in the units of the problem.
Machines are shared and noisy: read the ratios of one run, not its microseconds.
"""

import importlib.metadata
import importlib.util
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro
from mpc_solvers import EMPTY, SOLVED, Call, moreau_batch, osqp_loop

import jaxmpc as jm
from jaxmpc.app.config import load
from jaxmpc.mpc.condense import Condensed, condense, in_float64


@dataclass(frozen=True)
class Settings:
    """states: how many. rounds: each contestant runs so often, the best time counts.
    growth: also the tables over batch and horizon. output: where the JSON goes."""

    states: int = 65_536
    seed: int = 0
    rounds: int = 3
    growth: bool = True
    output: Path = Path("benchmark.json")


@dataclass(frozen=True)
class Row:
    """One line of the table. `agreement`: share of states whose label equals the proved one."""

    name: str
    microseconds: float
    setup_seconds: float
    solved_1e6: float | None
    agreement: float | None


def draw(count: int, seed: int) -> np.ndarray:
    """Random initial states (count, 2)."""
    high = 1.06 * np.array([1.5, 2.0])
    return np.random.default_rng(seed).uniform(-high, high, (count, 2))


def condensed(mpc: jm.MPC) -> Condensed:
    """The parametric QP in float64 on the host."""
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, condense(in_float64(mpc)))


def residuals(c: Condensed, x: np.ndarray, z: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Largest of primal residual, dual residual and gap (B,), recomputed."""
    shift = x @ c.D.T + c.d
    l, u, q, Az = c.lower - shift, c.upper - shift, x @ c.F.T + c.f, z @ c.C.T
    primal = np.abs(Az - np.clip(Az, l, u)).max(axis=1)
    dual = np.abs(z @ c.P + q + y @ c.C).max(axis=1)
    support = np.where(y > 0, y * u, y * l).sum(axis=1)
    gap = np.abs((z * (z @ c.P + q)).sum(axis=1) + support)
    return np.max([primal, dual, gap], axis=0)


def clocked(call: Callable[[], Any]) -> tuple[float, Any]:
    """Seconds of a call, and its result."""
    begun = time.perf_counter()
    found = call()
    return time.perf_counter() - begun, found


def best(rounds: int, call: Callable[[], tuple[float, Any]]) -> tuple[float, Any]:
    """The least seconds of some calls, with that call's result."""
    return min((call() for _ in range(rounds)), key=lambda outcome: outcome[0])


def ours_labels(mpc: jm.MPC, x: np.ndarray, rounds: int, dtype: str) -> tuple[Row, np.ndarray]:
    """Every state proved feasible or infeasible."""

    compiled = []

    def call() -> tuple[float, Any]:
        fmap = jm.map_feasible_set(mpc, x, dtype=dtype)
        compiled.append(fmap.labels.compile_seconds)
        return fmap.labels.run_seconds, fmap

    seconds, fmap = best(rounds, call)
    row = Row(
        f"jaxmpc labels with proofs, {dtype} steps", seconds / len(x) * 1e6,
        compiled[0], None, float(np.mean(fmap.label != 0)),
    )  # fmt: skip
    return row, fmap.label


def ours_plans(mpc: jm.MPC, x: np.ndarray, label: np.ndarray, rounds: int, dtype: str) -> Row:
    """Optimal plans to 1e-6, infeasible states detected on the way."""
    solver = jm.ADMM(iterations=150)
    call = lambda: clocked(lambda: jm.solve_many(mpc, x, solver, dtype=dtype))
    compiled = call()[0]
    seconds, plans = best(rounds, call)
    worst = np.max([plans.primal_residual, plans.dual_residual, plans.gap], axis=0)
    feasible = label == 1
    agree = np.where(feasible, plans.status == 1, plans.status == 3)
    return Row(
        f"jaxmpc plans to 1e-6, {dtype} steps", seconds / len(x) * 1e6, compiled,
        float(np.mean(worst[feasible] <= 1e-6)), float(agree.mean()),
    )  # fmt: skip


def rival(
    name: str, make: Callable[..., Call], c: Condensed, x: np.ndarray, label: np.ndarray,
    rounds: int, cost: bool = True,
) -> Row:  # fmt: skip
    """A solver of `mpc_solvers`, set up once; cost: False asks it for feasibility alone."""
    shift = x @ c.D.T + c.d
    q, l, u = (x @ c.F.T + c.f) * cost, c.lower - shift, c.upper - shift
    setup, call = clocked(lambda: make(replace(c, P=c.P * cost), q, l, u))
    seconds, (z, y, status) = best(rounds, lambda: clocked(call))
    feasible = label == 1
    good = residuals(c, x[feasible], z[feasible], y[feasible]) <= 1e-6 if cost else None
    return Row(
        name, seconds / len(x) * 1e6, setup, None if good is None else float(good.mean()),
        float(np.where(feasible, status == SOLVED, status == EMPTY).mean()),
    )  # fmt: skip


def main_table(settings: Settings) -> list[Row]:
    """All contestants on the joint, N = 20, no terminal set."""
    mpc = load(None).build_mpc()
    x, c = draw(settings.states, settings.seed), condensed(mpc)
    first, label = ours_labels(mpc, x, settings.rounds, "float32")
    rows = [first, ours_labels(mpc, x, settings.rounds, "float64")[0]]
    rows += [ours_plans(mpc, x, label, settings.rounds, t) for t in ("float32", "float64")]
    loop = f"OSQP {importlib.metadata.version('osqp')} loop"
    for what, cost in (("feasibility only, 1e-6", False), ("plans to 1e-6", True)):
        rows.append(rival(f"{loop}, {what}", osqp_loop, c, x, label, 1, cost))
    if importlib.util.find_spec("moreau"):
        batch = f"Moreau {importlib.metadata.version('moreau')} batch, default tolerance"
        rows.append(rival(batch, moreau_batch, c, x, label, settings.rounds))
    return rows


def solve_seconds(mpc: jm.MPC, x: np.ndarray, solver: jm.ADMM) -> float:
    """Return the seconds of one `solve_many`, compilation included where there is any."""
    begun = time.perf_counter()
    jm.solve_many(mpc, x, solver)
    return time.perf_counter() - begun


def growth(settings: Settings) -> dict[str, list[tuple[int, float, float]]]:
    """Microseconds a state, labels and plans, over the batch (N = 20) and over N (65,536)."""
    solver = jm.ADMM(iterations=150)

    def point(mpc: jm.MPC, count: int) -> tuple[float, float]:
        x = draw(count, settings.seed)
        labels, _ = best(2, lambda: (jm.map_feasible_set(mpc, x).labels.run_seconds, None))
        plans, _ = best(3, lambda: (solve_seconds(mpc, x, solver), None))
        return labels / count * 1e6, plans / count * 1e6

    mpc = load(None).build_mpc()
    batches = [2**k for k in range(8, 19, 2)]
    horizons = [10, 20, 40, 80]
    return {
        "batch": [(count, *point(mpc, count)) for count in batches],
        "horizon": [(N, *point(replace(mpc, horizon=N), settings.states)) for N in horizons],
    }


def run(settings: Settings) -> dict[str, Any]:
    """Measure, print and save."""
    rows = main_table(settings)
    reference = next(row.microseconds for row in rows if "plans" in row.name and "OSQP" in row.name)
    share = lambda v: "      -" if v is None else f"{v:7.2%}"
    print(f"{settings.states:,} states of the joint, N = 20, {jax.devices()[0].device_kind}")
    print(f"{'':44} µs/state  vs OSQP  set-up s  ≤1e-6    right label")
    for r in rows:
        print(
            f"{r.name:44} {r.microseconds:8.2f} {reference / r.microseconds:7.1f}× "
            f"{r.setup_seconds:8.2f}  {share(r.solved_1e6)}  {share(r.agreement)}"
        )
    result: dict[str, Any] = {"rows": [asdict(row) for row in rows]}
    if settings.growth:
        result |= growth(settings)
        for name in ("batch", "horizon"):
            print(f"\n{name:>8}  labels µs/state  plans µs/state")
            for size, labels, plans in result[name]:
                print(f"{size:8}  {labels:15.2f}  {plans:14.2f}")
    settings.output.write_text(json.dumps(result, indent=2) + "\n")
    return result


if __name__ == "__main__":
    run(tyro.cli(Settings, description=__doc__))
