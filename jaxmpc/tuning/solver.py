"""tune_solver: ADMM's penalties rho and over-relaxation alpha, tuned for one MPC problem."""

import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import optax

from jaxmpc.arrays import Reals
from jaxmpc.batches import chosen_devices
from jaxmpc.checks import fail, require_finite, require_kind, whole
from jaxmpc.files import fingerprint
from jaxmpc.mpc.aim import checked_array
from jaxmpc.mpc.condense import Condensed, condensed_in_float64
from jaxmpc.mpc.plan import Plan, WarmStart
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.admm import ADMM, factorise
from jaxmpc.qp.status import Status
from jaxmpc.tuning.descent import descend
from jaxmpc.tuning.result import TuningRun, cached
from jaxmpc.tuning.rho_objective import (
    PenaltyObjective,
    Samples,
    loss_and_gradient,
    score,
    solve_samples,
)
from jaxmpc.tuning.rho_schedule import KNOTS, interpolation
from jaxmpc.tuning.settings import Settings

# Version of the algorithm: results that an older version cached are not used.
VERSION = 3
# Constant penalties that are tried as a start, with this over-relaxation.
CONSTANTS, ALPHA = np.logspace(-2, 2, 9), 1.6
# Fewest states to learn from, validation included, and for validation.
FEWEST, FEWEST_VALIDATION = 8, 2
# Learning rate of log rho at the start: rho may be wrong by decades there. How often the validation
# set is solved, which costs as much as many steps.
RATE, VALIDATIONS = 0.2, 15
SOLVER = ADMM(newton_steps=0)


def tune_solver(
    mpc: MPC,
    x0s: Reals,
    iterations: int = 100,
    *,
    stages: int = 4,
    groups: str = "step",
    solver: ADMM | None = None,
    warm_start: Any = None,
    reference: Reals | None = None,
    input_reference: Reals | None = None,
    cache: str | Path | None = None,
    **settings: Any,
) -> TuningRun:
    """Tune ADMM's rho and alpha for an MPC problem, so that `iterations` steps solve more states.

    x0s (B, n), or (B, n + m) with the previous inputs where these count: states such as the
        controller will meet; a few hundred to a few thousand. Those proved infeasible are left out.
    stages: number of penalties of each row in the schedule, each for iterations/stages steps.
    groups: "step": rows of a kind share 5 values along the horizon, linear between them; "row":
        each row has its own.
    solver: the solver that the result is compared with, and the source of newton_steps, eps, …;
        tuned and compared without Newton steps. None: ADMM(newton_steps=0).
    warm_start: (z (B, nz), y (B, rows)) or plans of all states, to tune for warm starts.
    reference, input_reference: to track, as in `solve`, one for all.
    cache: folder that keeps results by a fingerprint of all of this; not with an optimizer.
    settings: of `Settings`, as updates=100; here updates is 200 and batch 32 unless given.
        optimizer None: Adam with a cosine schedule. The validation set is solved some 15 times, not
        after each step. validation: a fraction of x0s, or states
        (B', n), which are cold-started: only without warm_start. Computes in float64.

    Returns a `TuningRun` whose result, also `run.solver`, is `solver` with rho (stages, rows),
    alpha and iterations, for solve, Controller, solve_many and (for a robot's mpc, at set-points)
    RobotController. It is the best of all steps on the validation set by the fraction solved, then
    by the median residual; where none is better than `solver`, that is the result and a
    UserWarning says so. Numbers in before, after and the history: solved, residual, and
    infeasible, the states left out. `transfer_penalties` takes the result to another horizon.
    Raises ValueError for bad input, before any compile, and for states all proved infeasible;
    on Ctrl-C `Interrupted`, as `tune_weights`.
    """
    chosen = Settings(**{"updates": 200, "batch": 32, **settings})
    chosen.validate()
    solver = SOLVER if solver is None else solver
    references = reference, input_reference
    objective = _objective(mpc, iterations, stages, groups, solver, references)
    train, test = _samples(mpc, objective.condensed, x0s, warm_start, chosen)
    given, c = replace(solver, iterations=iterations), objective.condensed
    if solver.rho is None:
        with jax.enable_x64(True):
            given = replace(given, rho=float(factorise(c.P, c.C, solver, c.balls).rho[0, 0]))
    decides: dict[str, Any] = {
        "version": VERSION,
        "iterations": int(iterations),
        "stages": int(stages),
        "groups": groups,
        "batch": chosen.batch,
        "seed": chosen.seed,
        "knots": _knots(mpc),
        "horizon": mpc.horizon,
        "blocks": [[k, list(s), n] for k, s, n in c.layout],
        "balls": list(c.balls),
    }
    if chosen.optimizer is None:  # its schedule knows their number; with another, a run may grow
        decides["updates"] = chosen.updates
    decides["fingerprint"] = fingerprint(decides, objective, train, test, given.rho, given.alpha)

    def tune() -> TuningRun:
        with jax.enable_x64(True):
            return tune_schedule(objective, train, test, given, stages, chosen, decides)

    run = cached(cache, decides, chosen, partial(_with_values, given), tune)
    if not run.improved:
        warnings.warn(
            "tune_solver: nothing found is better on the validation set than the solver given "
            f"({run.before['solved']:.1%} solved); that one is the result",
            stacklevel=2,
        )
    return run


def tune_schedule(
    objective: PenaltyObjective,
    train: Samples,
    test: Samples,
    given: ADMM,
    stages: int,
    settings: Settings,
    decides: dict[str, Any],
) -> TuningRun:
    """Start at the best constant penalty, descend, and compare with `given`."""
    rows, parameters = objective.W.shape
    chunk, devices = len(test), chosen_devices(settings.devices)

    def measure(rho: Any, alpha: Any, samples: Samples) -> tuple[np.ndarray, np.ndarray]:
        rho = np.atleast_2d(rho)  # one stage counts as many equal ones
        count = stages if len(rho) == 1 else len(rho)
        rho = np.broadcast_to(rho, (count, rows))
        return solve_samples(rho, alpha, objective, samples, chunk, devices)

    # Infeasible states are left out; a proof of infeasibility holds for any rho.
    tried = [measure(rho, ALPHA, test) for rho in CONSTANTS]
    infeasible = np.any([status == Status.PRIMAL_INFEASIBLE for status, _ in tried], axis=0)
    if infeasible.all():
        fail("validation", "all its states are infeasible", "Give states that can be controlled")
    test = test.take(~infeasible)
    scores = [score(status[~infeasible], worst[~infeasible]) for status, worst in tried]
    constant = CONSTANTS[int(np.argmin([found["loss"] for found in scores]))]
    excluded = measure(constant, ALPHA, train)[0] == Status.PRIMAL_INFEASIBLE
    if excluded.all():
        fail("x0s", "all states are infeasible", "Give states that can be controlled")
    train = train.take(~excluded)
    left_out = {"infeasible": float(infeasible.sum() + excluded.sum())}

    theta = {
        "log_rho": np.full((stages, parameters), np.log(constant)),
        "alpha": np.asarray(np.log(ALPHA / (2 - ALPHA))),  # 2 sigmoid(θ) = ALPHA
    }

    program = loss_and_gradient(devices)

    def gradient(theta: Any, step: int) -> tuple[float, Any, dict[str, float]]:
        batch = train.take(settings.minibatch(len(train), step))
        (value, slope), _ = program(theta, objective, batch, np.ones(len(batch)))
        return float(value), slope, {}

    def validate(theta: Any) -> tuple[float, dict[str, float]]:
        found = score(*measure(**_values(theta, objective.W), samples=test))
        return found.pop("loss"), found

    schedule = optax.cosine_decay_schedule(RATE, max(settings.updates, 1), 0.03)
    every = max(settings.updates // VALIDATIONS, 1)
    adam = optax.adam(schedule, b2=0.99)
    history = descend(theta, gradient, validate, adam, settings, decides, every, "solved")
    after = {"loss": history.validation[history.best]} | {
        name: float(v[history.best]) for name, v in history.validation_numbers.items()
    }
    initial = {"rho": np.asarray(given.rho), "alpha": np.asarray(given.alpha)}
    before = score(*measure(**initial, samples=test))
    improved = bool(after["loss"] < before["loss"])
    return TuningRun(
        _values(history.theta, objective.W) if improved else initial,
        initial,
        before | left_out,
        (after if improved else before) | left_out,
        improved,
        decides,
        partial(_with_values, given),
        history,
        _values(history.thetas, objective.W),
    )


def _values(theta: Any, W: np.ndarray) -> dict[str, np.ndarray]:
    """Return rho (stages, rows) and alpha of θ."""
    with np.errstate(over="ignore"):  # inf, with which no state is solved
        return {"rho": np.exp(theta["log_rho"] @ W.T), "alpha": 2 / (1 + np.exp(-theta["alpha"]))}


def _with_values(solver: ADMM, values: Any) -> ADMM:
    """Return the solver with rho and alpha of `values`."""
    return replace(solver, rho=np.asarray(values["rho"]), alpha=float(values["alpha"]))


def _knots(mpc: MPC) -> int:
    """Return the number of knots along the horizon, at most one a step."""
    return min(KNOTS, mpc.horizon + 1)


def _objective(
    mpc: MPC,
    iterations: int,
    stages: int,
    groups: str,
    solver: ADMM,
    references: tuple[Reals | None, Reals | None],
) -> PenaltyObjective:
    """Return the objective; ValueError for bad input."""
    require_kind("mpc", mpc, MPC)
    mpc.validate()
    if whole("iterations", iterations, 1) % whole("stages", stages, 1):
        fail("iterations", f"{iterations} for {stages} stages", "Use a multiple")
    if groups not in ("row", "step"):
        fail("groups", f"{groups!r}", 'Give "row" or "step"')
    c, N = condensed_in_float64(mpc), mpc.horizon
    if not len(c.C):
        fail("mpc", "has no rows", "Without limits one Newton step solves it; ADMM has no rho")
    replace(solver, iterations=iterations).validate(len(c.C))
    tracked: list[np.ndarray | None] = []
    names = ("reference", "input_reference")
    shapes = ((N + 1, mpc.system.n), (N, mpc.system.m))
    for name, value, shape in zip(names, references, shapes, strict=True):
        if value is not None:
            value = np.asarray(checked_array(name, value, [shape[1:], shape]), np.float64)
            require_finite(name, value)
            value = np.broadcast_to(value, shape)
        tracked.append(value)
    W = interpolation(groups, c.layout, N, c.balls, _knots(mpc))
    plain = replace(solver, iterations=int(iterations), rho=1.0, alpha=ALPHA, newton_steps=0)
    unrolled = replace(plain, differentiate="unrolled")
    return PenaltyObjective(c, W, tracked[0], tracked[1], unrolled)


def _samples(
    mpc: MPC, c: Condensed, x0s: Reals, warm_start: Any, settings: Settings
) -> tuple[Samples, Samples]:
    """Return the samples for training and for validation; ValueError for bad input."""
    x = _states(mpc, "x0s", x0s)
    if len(x) < FEWEST:
        fail("x0s", f"{len(x)} states", f"Give at least {FEWEST}, better some hundred")
    if warm_start is not None:
        if isinstance(warm_start, Plan | WarmStart):
            each = jax.vmap(lambda plan: WarmStart.of(plan, c.layout, mpc))(warm_start)
            warm_start = jax.vmap(c.variables)(each.states, each.inputs), each.multipliers
        warm_start = tuple(np.asarray(part, np.float64) for part in warm_start)
        for part, size in zip(warm_start, (len(c.P), len(c.C)), strict=True):
            if part.shape != (len(x), size):
                fail("warm_start", f"shape {part.shape}", f"Needed: {(len(x), size)}")
    samples = Samples(x, warm_start)
    if settings.splits:
        return settings.split(samples, FEWEST_VALIDATION, shuffle=True)
    if warm_start is not None:
        fail("validation", "given as states beside warm starts", "Give a fraction in (0, 1)")
    return samples, Samples(_states(mpc, "validation", settings.validation))


def _states(mpc: MPC, name: str, x0s: Reals) -> np.ndarray:
    """Return states (B, n), or (B, n + m) with the previous inputs, with zeros for these."""
    x = np.asarray(x0s, np.float64)
    if x.ndim != 2 or x.shape[1] not in (mpc.system.n, mpc.dimension) or not len(x):
        fail(name, f"shape {x.shape}", f"Give states (B, {mpc.system.n})")
    require_finite(name, x)
    return np.pad(x, ((0, 0), (0, mpc.dimension - x.shape[1])))
