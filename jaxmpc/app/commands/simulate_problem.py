"""`jaxmpc simulate` of a problem file: closed loops of its linear plant, under disturbances."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxmpc.app import config as configs
from jaxmpc.app.commands.compile_notice import Compiling
from jaxmpc.app.options.shared import print_table
from jaxmpc.checks import fail, require_memory
from jaxmpc.closed_loop.disturbances import draw_disturbances, worst_disturbance
from jaxmpc.closed_loop.simulation import Run, simulate
from jaxmpc.files import open_folder, require_new, versions, write_arrays, write_json
from jaxmpc.mpc.controller import Controller
from jaxmpc.mpc.plan import broken_at_start
from jaxmpc.mpc.problem import MPC, Outputs, as_tuple, output_stages
from jaxmpc.qp.admm import DEFAULT
from jaxmpc.qp.status import Status
from jaxmpc.sets.limits import row_violations, rows_kept

FILES = ("summary.json", "runs.npz")
# Samples of a closed loop unless a time is given.
SAMPLES = 100


@dataclasses.dataclass(frozen=True)
class LinearLoops:
    """Closed loops from `count` random states over `seconds`, in the system's unit of time, or of
    SAMPLES samples where that is None: starts are uniform around the target, up to the fraction
    `spread` of the way to the state limits. disturbance: None, or a kind of `simulate_problem`."""

    config: configs.Config
    count: int
    seconds: float | None
    spread: float
    seed: int
    disturbance: str | None

    @property
    def steps(self) -> int:
        """Number of time steps."""
        if self.seconds is None:
            return SAMPLES
        return max(1, round(self.seconds / self.config.system.dt))

    def starts(self) -> np.ndarray:
        """Return the initial states (count, n)."""
        lower, upper = self.config.state_range()
        if not np.isfinite([lower, upper]).all():
            cure = "Bound every state, so that starts can be drawn"
            fail("limits.x_min, x_max", f"{lower} to {upper}", cure)
        ends = self.config.around_target(self.spread)
        return np.random.default_rng(self.seed).uniform(*ends, (self.count, len(lower)))

    def run(self, mpc: MPC, x0s: np.ndarray) -> tuple[Run, np.ndarray]:
        """Return the loops from x0s (count, n) and what is added to their states (count, steps,
        n)."""
        controller = Controller(mpc, self.config.build_solver() or DEFAULT)
        references, shape = self.config.references(), (self.count, self.steps)

        def loop(x0: Any, w: Any) -> Run:
            return simulate(controller, mpc.system, x0, self.steps, disturbance=w, **references)

        loops = jax.jit(jax.vmap(loop))
        if self.disturbance is None:
            w = np.zeros((*shape, mpc.system.n))
        else:
            kind = "inside" if self.disturbance == "inside" else "vertices"
            w = draw_disturbances(mpc, self.steps, self.count, kind=kind, seed=self.seed)
        run = loops(x0s, w)
        planned = np.flatnonzero(np.asarray(run.status)[:, 0] == Status.SOLVED)
        if self.disturbance == "worst" and len(planned):
            w[planned], _ = worst_disturbance(controller, x0s[planned], self.steps, seed=self.seed)
            run = loops(x0s, w)
        return run.on_host(), w


def hard_outputs(mpc: MPC, states: np.ndarray, inputs: np.ndarray) -> list[tuple[Any, np.ndarray]]:
    """Return the hard outputs, each with the points (x, u) (B, T, n + m) of loops at which a plan
    made there, or a step before, holds them; with the states (B, T + 1, n) where u plays no part
    and the last plan holds the last state."""
    points = np.concatenate([states[:, :-1], inputs], axis=-1)
    m, found = inputs.shape[-1], list[tuple[Any, np.ndarray]]()
    for rows in as_tuple("outputs", mpc.outputs, Outputs):
        stages = output_stages(mpc, rows)
        if not stages or min(stages) > 1:
            continue
        C = np.asarray(rows.C)
        D = np.zeros((len(C), m)) if rows.D is None else np.asarray(rows.D)
        lower, upper = (
            np.full(len(C), free) if end is None else np.asarray(end)
            for end, free in ((rows.lower, -np.inf), (rows.upper, np.inf))
        )
        of_states = 1 in stages and not D.any()
        held = (C, lower, upper) if of_states else (np.hstack([C, D]), lower, upper)
        found.append((held, (states if of_states else points)[:, min(stages) :]))
    return found


def simulate_problem(loops: LinearLoops, output: Path, overwrite: bool) -> None:
    """Simulate the closed loops of a problem file, write the files, print the table.

    Disturbances: "vertices" of [disturbance] at random, points "inside" at random, or the "worst"
    that ascent by gradient finds for each start. Raises ValueError for what makes no sense.
    """
    config = loops.config
    require_new([output / name for name in FILES], overwrite)
    mpc = config.build_controlled()
    if mpc.disturbance is None and loops.disturbance is not None:
        fail("--disturbance", f"{loops.disturbance}, and the file has none", "Add [disturbance]")
    each = 8 * (3 * mpc.system.n + mpc.system.m + 4) * loops.steps
    require_memory("--count, --seconds", loops.count * each, "Simulate fewer loops, or less time")
    x0s = loops.starts()
    open_folder(output)
    text = loops.disturbance or "none"
    print(f"{config.name}: {loops.count:,} loops of {loops.steps} steps -> {output}")
    with jax.enable_x64(True), Compiling(f"closed loops of {config.name}", programs=1):
        run, w = loops.run(mpc, x0s)
    states, inputs, status = (np.asarray(v) for v in (run.states, run.inputs, run.status))
    planned = status[:, 0] == Status.SOLVED
    of_states = [(config.state_limits(), states), *hard_outputs(mpc, states, inputs)]
    limits = [*of_states, (mpc.inputs, inputs)]
    kept = np.all([rows_kept(*pair).all(axis=(1, 2)) for pair in limits], axis=0) & planned
    worst = max(float(row_violations(*pair)[planned].max(initial=0.0)) for pair in of_states)
    solved = float((status[planned] == Status.SOLVED).mean()) if planned.any() else float("nan")
    cost = float(np.asarray(run.stage_cost)[planned].sum(axis=1).mean()) if planned.any() else None
    summary = {
        "count": loops.count,
        "steps": loops.steps,
        "disturbance": text,
        "policy": None if mpc.disturbance is None else mpc.policy,
        "planned": int(planned.sum()),
        "kept": int(kept.sum()),
        "worst_violation": worst,
        "plans_solved": solved,
        "mean_cost": cost,
        "config": config.to_dict("simulate"),
        "versions": versions(),
    }
    arrays = {"states": states, "inputs": inputs, "status": status, "disturbances": w}
    write_arrays(output / FILES[1], **arrays)
    write_json(output / FILES[0], summary)
    meaning = {
        "vertices": "random vertices at each step: a sample, no proof",
        "inside": "random points at each step: a sample, no proof",
        "worst": "found by gradient for each start: a local search, no proof",
    }
    broken = [broken_at_start(mpc, x0) for x0 in x0s[~planned]]
    outside = [texts[0] for texts in broken if texts]
    rows = [
        ("disturbance", meaning.get(text, "none")),
        ("with a plan", f"{planned.sum():,} of {loops.count:,} starts; the rest counts no further"),
        *[("- outside", f"{len(outside):,} begin beyond a limit: {text}") for text in outside[:1]],
        ("limits kept", f"{kept.sum():,} of {planned.sum():,} loops"),
        ("worst", f"{worst:.3g} beyond a limit of states or outputs, in its unit"),
        ("plans solved", f"{100 * solved:.2f} %" if planned.any() else "none"),
        ("cost", "none" if cost is None else f"{cost:.6g}, mean of the loops with a plan"),
        ("files", " ".join(str(output / name) for name in FILES)),
    ]
    print_table(rows, 13)
