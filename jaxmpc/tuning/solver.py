"""tune_solver: ADMM's penalties rho and over-relaxation alpha, tuned for one MPC problem.

ADMM with a fixed number of steps is a function of rho and alpha that can be differentiated; what
is minimised is a smooth count of the sampled states that it leaves unsolved,

    mean over states of softplus(2 (e + margin)) / 2,    e = log10 |residuals / tolerances|,

with the residuals of the plan as stated, by which its status is decided. A solved state counts
almost nothing, another one the number of digits that are missing. (Learning to optimise by
unrolling: Gregor, LeCun 2010; penalties of ADMM for QPs: Ichnowski et al. 2021, by reinforcement;
Stellato et al. 2020, §5.2, adapt one number while iterating.) For every rho the fixed points of the
iteration are the solutions: a bad rho costs steps but cannot make a solution wrong.
"""

import functools
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from scipy.linalg import block_diag

from jaxmpc.arrays import Reals
from jaxmpc.batches import Compiled, Devices, chosen_devices, divisible, each_part, over_devices
from jaxmpc.checks import fail, require_finite, require_kind, require_real, shown, whole
from jaxmpc.files import fingerprint
from jaxmpc.mpc.condense import condensed_in_float64, in_float64
from jaxmpc.mpc.controller import Controller, plan_with, stated_terms, with_solver
from jaxmpc.mpc.plan import Aim, Plan, WarmStart, checked_array
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.rows import Layout
from jaxmpc.pytrees import pytree
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.linalg import rounding
from jaxmpc.qp.solve import solve_factored
from jaxmpc.qp.status import Status
from jaxmpc.tuning.batch_mean import BatchMean
from jaxmpc.tuning.descent import Settings, descend
from jaxmpc.tuning.result import TuningRun, cached

# Version of the algorithm: results that an older version cached are not used.
VERSION = 5
# Constant penalties that are tried as a start, with this over-relaxation.
CONSTANTS, ALPHA = np.logspace(-2, 2, 9), 1.6
# Fewest states to learn from, validation included, and for validation.
LEAST_STATES, LEAST_VALIDATION = 8, 2
# Learning rate of log rho at the start: rho may be wrong by decades there. How often the validation
# set is solved, which costs as much as many steps.
RATE, VALIDATIONS = 0.2, 15
ADMM_ALONE = ADMM(newton_steps=0)
# Digits by which the loss wants residuals below their tolerance.
DIGITS_BELOW = 0.3
# Values of a group along the horizon, between which log rho is interpolated.
KNOTS = 5


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
    by the median residual relative to its tolerance; where none is better than `solver`, that is
    the result and a UserWarning says so. Numbers in before, after and the history: solved (plans
    whose status is SOLVED), residual (this median), and infeasible, the states left out.
    `transfer_penalties` takes the result to another horizon.
    Raises ValueError for bad input, before any compile, and for states all proved infeasible;
    on Ctrl-C `Interrupted`, as `tune_weights`.
    """
    chosen = Settings.of("tune_solver", {"updates": 200, "batch": 32, **settings})
    chosen.validate()
    require_real("x0s", x0s)
    pair = isinstance(warm_start, tuple | list) and len(warm_start) == 2
    if not (pair or warm_start is None or isinstance(warm_start, Plan | WarmStart)):
        cure = "Give a pair (z, y) of arrays, or plans, of all states"
        fail("warm_start", f"{shown(warm_start)} is none of them", cure)
    for part in warm_start if isinstance(warm_start, tuple | list) else ():
        require_real("warm_start", part)
    solver = ADMM_ALONE if solver is None else solver
    references = reference, input_reference
    objective = _objective(mpc, iterations, stages, groups, solver, references)
    train, test = _samples(objective.controller, x0s, warm_start, chosen)
    given = _with_rho(objective, replace(solver, iterations=iterations))
    c = objective.controller.condensed
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
    tracked, penalties = (objective.reference, objective.input_reference), (solver.rho, given.alpha)
    controller = objective.controller
    data = controller.mpc, tracked, controller.solver, train, test, penalties
    decides["fingerprint"] = fingerprint(decides, data)
    decides["given_rho"] = np.asarray(given.rho, float).tolist()

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
    objective: "PenaltyObjective",
    train: "Samples",
    test: "Samples",
    given: ADMM,
    stages: int,
    settings: Settings,
    decides: dict[str, Any],
) -> TuningRun:
    """Start at the best constant penalty, descend, and compare with `given`."""
    rows, parameters = objective.W.shape
    chunk, devices = len(test), chosen_devices(settings.devices)

    def measure(rho: Any, alpha: Any, samples: "Samples") -> tuple[np.ndarray, np.ndarray]:
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
    after = history.measured(history.best)
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
) -> "PenaltyObjective":
    """Return the objective; ValueError for bad input."""
    require_kind("mpc", mpc, MPC)
    require_kind("solver", solver, ADMM)
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
    with jax.enable_x64(True):
        controller = Controller(in_float64(mpc), replace(plain, differentiate="unrolled"))
    return PenaltyObjective(controller, W, tracked[0], tracked[1])


def _with_rho(objective: "PenaltyObjective", solver: ADMM) -> ADMM:
    """Return the solver with a number in place of rho None."""
    if solver.rho is not None:
        return solver
    with jax.enable_x64(True):
        first = with_solver(objective.controller, solver).factor.rho[0, 0]
    return replace(solver, rho=float(first))


def largest_residuals(
    mpc: MPC,
    x0s: Reals,
    solver: ADMM,
    reference: Reals | None = None,
    input_reference: Reals | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the status and the largest residual, in parts of its tolerance, (B,) of plans from the
    states x0s (B, n) by a solver without Newton steps, in float64; at most 1 of SOLVED ones."""
    references = reference, input_reference
    objective = _objective(mpc, solver.admm_steps(), 1, "row", solver, references)
    solver, samples = _with_rho(objective, solver), Samples(_states(mpc, "x0s", x0s))
    rho = np.atleast_2d(np.asarray(solver.rho))
    rho = np.broadcast_to(rho, (len(rho), len(objective.W)))
    with jax.enable_x64(True):
        return solve_samples(rho, solver.alpha, objective, samples, len(samples))


def _samples(
    controller: Controller, x0s: Reals, warm_start: Any, settings: Settings
) -> "tuple[Samples, Samples]":
    """Return the samples for training and for validation; ValueError for bad input."""
    mpc = controller.mpc
    x = _states(mpc, "x0s", x0s)
    if len(x) < LEAST_STATES:
        fail("x0s", f"{len(x)} states", f"Give at least {LEAST_STATES}, better some hundred")
    if warm_start is not None:
        with jax.enable_x64(True):
            warm_start = _warm_starts(controller, x, warm_start)
    samples = Samples(x, warm_start)
    if settings.splits:
        return settings.split(samples, LEAST_VALIDATION, shuffle=True)
    if warm_start is not None:
        fail("validation", "given as states beside warm starts", "Give a fraction in (0, 1)")
    return samples, Samples(_states(mpc, "validation", settings.validation))


def _warm_starts(controller: Controller, x: np.ndarray, given: Any) -> WarmStart:
    """Return warm starts at the states x (B, p) as arrays with B in front."""
    c, mpc = controller.condensed, controller.mpc
    if isinstance(given, Plan | WarmStart):
        each = jax.vmap(lambda plan: WarmStart.of(plan, c.layout, mpc))(given)
    else:
        z, y = (jnp.asarray(part, float) for part in given)
        for part, size in ((z, len(c.P)), (y, len(c.C))):
            if part.shape != (len(x), size):
                fail("warm_start", f"shape {part.shape}", f"Needed: {(len(x), size)}")
        each = WarmStart(*jax.vmap(c.trajectory)(jnp.asarray(x), z), y)
    if len(each.inputs) != len(x):
        fail("warm_start", f"{len(each.inputs)} plans", f"Give one for each of {len(x)} states")
    return jax.tree.map(lambda v: np.asarray(v, np.float64), each)


def _states(mpc: MPC, name: str, x0s: Reals) -> np.ndarray:
    """Return states (B, n), or (B, n + m) with the previous inputs, with zeros for these."""
    require_real(name, x0s)
    x = np.asarray(x0s, np.float64)
    if x.ndim != 2 or x.shape[1] not in (mpc.system.n, mpc.dimension) or not len(x):
        fail(name, f"shape {x.shape}", f"Give states (B, {mpc.system.n})")
    require_finite(name, x)
    return np.pad(x, ((0, 0), (0, mpc.dimension - x.shape[1])))


@pytree
class Samples:
    """States to solve from: x (B, p), and warm starts of all or None."""

    x: Any
    start: Any = None

    def __len__(self) -> int:
        return len(self.x)

    def take(self, where: Any) -> "Samples":
        """Return the samples at these places."""
        return jax.tree.map(lambda v: v[where], self)


@pytree
class PenaltyObjective:
    """The controller and references for which penalties are tuned. W: from `interpolation`."""

    controller: Controller
    W: Any
    reference: Any
    input_reference: Any

    def digits(self, theta: Any, samples: Samples) -> Array:
        """Return e (B,) of the rho and alpha of θ; see `solve`."""
        rho, alpha = jnp.exp(theta["log_rho"] @ self.W.T), 2 * jax.nn.sigmoid(theta["alpha"])
        return self.solve(rho, alpha, samples)[2]

    def solve(self, rho: Array, alpha: Array, samples: Samples) -> tuple[Array, Array, Array]:
        """Return of the plans of the samples the status (B,), the largest of their residuals over
        their tolerances (B,), and e (B,): log10 of the norm of all of these."""
        solver = replace(self.controller.solver, rho=rho, alpha=alpha)
        controller, mpc = with_solver(self.controller, solver), self.controller.mpc
        n, floor = mpc.system.n, rounding(controller.dtype)

        def one(sample: Samples) -> tuple[Array, Array, Array]:
            x, previous = sample.x[:n], sample.x[n:] if mpc.input_in_state else None
            aim = Aim(x, self.reference, self.input_reference, previous)
            plan, found = plan_with(solve_factored, controller, aim, sample.start)
            parts = stated_terms(controller, found.y, plan.states, plan.inputs, aim)
            values, sizes, terms = map(jnp.concatenate, zip(*parts, strict=True))
            allowed = solver.eps * sizes + floor * (sizes + terms)
            shares = values / jnp.where(allowed > 0, allowed, 1.0)
            # A quarter of the rounding stays, for the sake of the logarithm's slope at 0.
            e = 0.5 * jnp.log10((floor / 4) ** 2 + jnp.sum(shares**2))
            return plan.status, jnp.max(jnp.abs(shares)), e

        return jax.vmap(one)(samples)


@functools.cache
def loss_and_gradient(devices: Devices = None) -> BatchMean:
    """Return the program (θ, objective, samples, weights (B,)) → ((loss, gradient), {}): the
    weighted mean of the module's docstring."""

    def loss(theta: Any, objective: PenaltyObjective, samples: Samples, weights: Array) -> Array:
        e = objective.digits(theta, samples)
        return jnp.sum(weights * jax.nn.softplus(2 * (e + DIGITS_BELOW)) / 2) / jnp.sum(weights)

    value_and_slope = jax.value_and_grad(loss)
    return BatchMean(lambda *args: (value_and_slope(*args), {}), devices, (False, False, True))


def solve_samples(
    rho: np.ndarray,
    alpha: Any,
    objective: PenaltyObjective,
    samples: Samples,
    chunk: int,
    devices: Devices = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the status and the largest residual over its tolerance (B,) of the samples by the
    solver.

    rho (stages, rows). chunk: samples at once; one size, so that it compiles once.
    """
    solve = _solve_batches(devices)
    given = jnp.asarray(rho), jnp.asarray(alpha, float), objective

    def program(part: Samples) -> tuple[np.ndarray, np.ndarray]:
        return solve(*given, part)

    found = [part.result for part in each_part(program, samples, divisible(chunk, devices))]
    status, worst = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return status, worst


@functools.cache
def _solve_batches(devices: Devices) -> Compiled:
    return over_devices(_solve_batch, devices, (False, False, False, True))


def _solve_batch(
    rho: Array, alpha: Array, objective: PenaltyObjective, samples: Samples
) -> tuple[Array, Array]:
    """Return status and largest residual over its tolerance (B,) of a batch, in JAX."""
    return objective.solve(rho, alpha, samples)[:2]


def score(status: np.ndarray, worst: np.ndarray) -> dict[str, float]:
    """Return how well samples were solved, as `tune_solver` documents it.

    loss: the states that are not solved, plus a fraction of one that grows with the median
    residual from 1e-16 to 1e16: less is better. solved: fraction SOLVED. residual: median of those
    over their tolerances, `worst`, in which units play no part; NaN counts as infinite.
    """
    median = float(np.median(np.nan_to_num(worst, nan=np.inf)))
    digits = float(np.log10(np.clip(median, 1e-16, 1e16)))
    return {
        "loss": float(np.sum(status != Status.SOLVED)) + (digits + 17) / 34,
        "solved": float(np.mean(status == Status.SOLVED)),
        "residual": median,
    }


def interpolation(
    groups: str, blocks: Layout, horizon: int, balls: tuple[int, ...] = (), knots: int = KNOTS
) -> np.ndarray:
    """Return W (rows, parameters): log rho = W θ.

    groups "row": one parameter a row. "step": for each row of a block `knots` values at k/N in
    [0, 1], linear between them; one value where a block has one step. The rows of a ball have the
    same values, so that it stays a ball; the last len(balls) blocks are balls.
    """
    columns: list[np.ndarray] = []
    for i, (_, steps, size) in enumerate(blocks):
        ball = i >= len(blocks) - len(balls)
        if groups == "row":
            along = np.eye(len(steps))
        elif len(steps) == 1:
            along = np.ones((1, 1))
        else:
            ends, at = np.linspace(0, 1, knots), np.array(steps) / horizon
            along = np.stack([np.interp(at, ends, hat) for hat in np.eye(knots)], axis=1)
        columns.append(np.kron(along, np.ones((size, 1)) if ball else np.eye(size)))
    return block_diag(*columns)


def transfer_penalties(run: TuningRun, mpc: MPC, iterations: int | None = None) -> ADMM:
    """Return the solver that `tune_solver` found, for a problem with another horizon.

    run: of groups="step", unless mpc has the very rows of the problem tuned. Its penalties are
    interpolated at k/N. mpc: a problem with the same blocks of rows. iterations: None for those
    tuned with, divided evenly among the stages. How many states of the other problem it solves is
    not guaranteed; its status tells. Where nothing better was found the given solver is returned.
    Raises ValueError for a problem with other blocks.
    """
    require_kind("run", run, TuningRun)
    require_kind("mpc", mpc, MPC)
    mpc.validate()
    solver, settings = run.solver, run.settings
    rho = np.asarray(solver.rho)
    if run.improved:
        c = condensed_in_float64(mpc)
        blocks = tuple((kind, tuple(steps), size) for kind, steps, size in settings["blocks"])
        if settings["groups"] == "row" and c.layout != blocks:
            fail("mpc", "has other rows than the problem tuned", 'Use groups="step"')
        kinds = lambda blocks: [(kind, size) for kind, _, size in blocks]
        if kinds(c.layout) != kinds(blocks) or len(c.balls) != len(settings["balls"]):
            fail("mpc", f"blocks {kinds(c.layout)}", f"Needed: {kinds(blocks)}")
        if c.layout != blocks:
            shape = lambda blocks, N: interpolation("step", blocks, N, c.balls, settings["knots"])
            old, new = shape(blocks, settings["horizon"]), shape(c.layout, mpc.horizon)
            if old.shape[1] != new.shape[1]:
                fail("mpc", "has blocks of one step, or more where one was", "Tune it anew")
            # A parameter that no row depends on takes the mean of the others.
            mean = np.mean(np.log(rho), axis=1, keepdims=True)
            theta = np.linalg.lstsq(old, (np.log(rho) - mean).T, rcond=None)[0]
            rho = np.exp(mean + theta.T @ new.T)
    count = solver.admm_steps() if iterations is None else iterations
    solver = replace(solver, iterations=count, rho=rho)
    solver.validate(rho.shape[-1] if rho.ndim else 1)
    return solver
