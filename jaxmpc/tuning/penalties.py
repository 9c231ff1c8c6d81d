"""tune_penalties: ADMM's penalties rho and over-relaxation alpha, learned for one MPC problem.

ADMM with a fixed number of steps is a function of rho and alpha that can be differentiated; what
is minimised is a smooth count of the sampled states that it leaves unsolved,

    mean over states of softplus(2 (e + margin)) / 2,    e = log10 |residuals / tolerances|,

the residuals being those that the status is made of. A state that is solved counts for nothing, a
state far from it for the digits that are missing. (Learning to optimise by unrolling: Gregor,
LeCun 2010; penalties of ADMM for QPs: Ichnowski et al. 2021, by reinforcement; Stellato et al.
2020, §5.2, adapt one number while iterating.) Whatever rho is, the fixed points of the
iteration are the solutions: a bad rho costs steps, it cannot make an answer wrong.
"""

import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from jaxmpc.checks import fail, require_finite, whole
from jaxmpc.compiled import padded
from jaxmpc.mpc.condense import Condensed, condense, in_float64
from jaxmpc.mpc.problem import MPC, Plan
from jaxmpc.qp.admm import ADMM, factor, iterate, read, scaled
from jaxmpc.qp.problem import QP, residual_terms
from jaxmpc.qp.solve import marked, solve_factored, start, unscaled
from jaxmpc.qp.status import Status
from jaxmpc.tuning import archive
from jaxmpc.tuning.descent import Descent, descend, minibatch

# Of the algorithm: what an older one cached is learned anew.
VERSION = 1
# Values of a group along the horizon, between which log rho is interpolated.
KNOTS = 5
# Digits by which the loss wants residuals below their tolerance.
MARGIN = 0.3
# Constant penalties that are tried as a start.
CONSTANTS = np.logspace(-2, 2, 9)
# Fewest states to learn from, validation included.
FEWEST = 8

Blocks = tuple[tuple[str, tuple[int, ...], int], ...]


@dataclass(frozen=True, eq=False)
class Penalties:
    """Learned penalties, and how they came about.

    solver: the ADMM of the problem that they were learned for; the one that was given (with the
    iterations asked for) where learning found nothing better on the validation states.
    log_rho (stages, parameters), alpha: what was learned; groups: what the parameters stand for.
    solved, residual: share SOLVED of the validation states and median of their largest residual,
    with `solver`; solved_before, residual_before: with the solver that was given. infeasible:
    states left out, proved infeasible. history: of the descent; None from a cache.
    """

    solver: ADMM
    log_rho: np.ndarray
    alpha: float
    groups: str
    blocks: Blocks
    horizon: int
    balls: tuple[int, ...]
    solved: float
    residual: float
    solved_before: float
    residual_before: float
    infeasible: int
    history: Descent | None = field(default=None, repr=False)

    @property
    def knots(self) -> int:
        """Values of a group along the horizon."""
        return min(KNOTS, self.horizon + 1)

    @property
    def improved(self) -> bool:
        """Whether `solver` is better than what was given."""
        return better((self.solved, self.residual), (self.solved_before, self.residual_before))

    def for_mpc(self, mpc: MPC, iterations: int | None = None) -> ADMM:
        """The solver for a problem with the same blocks of rows and another horizon.

        groups="step" only: values are interpolated at k/N. iterations: None for those learned
        with; the stages share them. Nothing is promised of the other problem: its status says what
        became of each state. Where nothing was learned, the solver that was given.
        """
        mpc.validate()
        count = self.solver.iterations if iterations is None else iterations
        rho = np.asarray(self.solver.rho)
        if self.improved:
            with jax.enable_x64(True):
                c = condense(in_float64(mpc))
            if self.groups == "row" and c.layout != self.blocks:
                fail("mpc", "has other rows than the problem learned", 'Use groups="step"')
            kinds = lambda blocks: [(kind, size) for kind, _, size in blocks]
            if kinds(c.layout) != kinds(self.blocks) or len(c.balls) != len(self.balls):
                fail("mpc", f"blocks {kinds(c.layout)}", f"Needed: {kinds(self.blocks)}")
            W = spread(self.groups, c.layout, mpc.horizon, c.balls, self.knots)
            if W.shape[1] != self.log_rho.shape[1]:
                fail("mpc", "has blocks of one step, or more where one was", "Learn for it")
            rho = np.exp(self.log_rho @ W.T)
        solver = replace(self.solver, iterations=count, rho=rho)
        solver.validate(rho.shape[-1] if rho.ndim else 1)
        return solver


def spread(
    groups: str, blocks: Blocks, horizon: int, balls: tuple[int, ...] = (), knots: int = KNOTS
) -> np.ndarray:
    """W (rows, parameters): log rho = W θ.

    "row": one parameter a row. "step": for each row of a block `knots` values at k/N in [0, 1],
    linear between them; one value where a block has one step. The rows of a ball share theirs,
    since it stays a ball only so.
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
    rows, parameters = (sum(part.shape[k] for part in columns) for k in (0, 1))
    W, row, column = np.zeros((rows, parameters)), 0, 0
    for part in columns:
        W[row : row + part.shape[0], column : column + part.shape[1]] = part
        row, column = row + part.shape[0], column + part.shape[1]
    return W


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Samples:
    """States that are solved: x (B, p), and warm starts (z (B, nz), y (B, rows)) or None."""

    x: Any
    start: Any = None

    def __len__(self) -> int:
        return len(self.x)

    def take(self, where: Any) -> "Samples":
        """Those of them."""
        return jax.tree.map(lambda v: v[where], self)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Setting:
    """What θ does not change: the problem, W of `spread`, what is tracked, and a solver whose
    iterations, eps and smoothing are used."""

    condensed: Condensed
    W: Any
    reference: Any
    input_reference: Any
    solver: ADMM

    def qp(self, x: Array) -> QP:
        """The program at a state."""
        return self.condensed.qp(x, self.reference, self.input_reference)

    def with_theta(self, theta: Any) -> ADMM:
        """The solver at θ."""
        rho, alpha = jnp.exp(theta["rho"] @ self.W.T), 2 * jax.nn.sigmoid(theta["alpha"])
        return replace(self.solver, rho=rho, alpha=alpha)


def digits(setting: Setting, theta: Any, samples: Samples) -> Array:
    """e (B,): log10 of the norm of all residuals over their tolerances after the steps."""
    solver, c = setting.with_theta(theta), setting.condensed
    made = factor(c.P, c.C, solver, c.balls)
    eps = 1e-6 if solver.eps is None else solver.eps

    def one(sample: Samples) -> Array:
        qp = setting.qp(sample.x)
        q, bounds = scaled(made, qp)
        t = jnp.zeros_like(qp.l)
        if sample.start is not None:
            t = start(made, qp, bounds, sample.start)
        t, _ = iterate(made, q, bounds, t, solver.iterations, solver.alpha)
        z, y = unscaled(qp, made, *read(made, t, q, bounds))
        floor = 100 * jnp.finfo(z.dtype).eps
        # A quarter of the rounding stays, for the sake of the logarithm's slope at 0.
        square: Any = (floor / 4) ** 2
        for value, size in residual_terms(qp, z, y):
            square += jnp.sum((value / (eps + floor * size)) ** 2)
        return 0.5 * jnp.log10(square)

    return jax.vmap(one)(samples)


@jax.jit
def loss(theta: Any, setting: Setting, samples: Samples) -> Array:
    """The number that is minimised; see above."""
    e = digits(setting, theta, samples)
    return jnp.mean(jax.nn.softplus(2 * (e + MARGIN)) / 2)


slope = jax.jit(jax.value_and_grad(loss))


@jax.jit
def judge(rho: Array, alpha: Array, setting: Setting, samples: Samples) -> tuple[Array, Array]:
    """Status and largest residual (B,) by the solver itself; rho (stages, rows)."""
    c = setting.condensed
    solver = replace(setting.solver, rho=rho, alpha=alpha)
    made = factor(c.P, c.C, solver, c.balls)

    def one(sample: Samples) -> tuple[Array, Array]:
        s = marked(*solve_factored(setting.qp(sample.x), made, solver, sample.start))
        worst = jnp.maximum(jnp.maximum(s.primal_residual, s.dual_residual), jnp.abs(s.gap))
        return s.status, worst

    return jax.vmap(one)(samples)


def judged(
    rho: np.ndarray, alpha: Any, setting: Setting, samples: Samples, size: int
) -> tuple[np.ndarray, np.ndarray]:
    """`judge` in pieces of one size, so that it compiles once."""
    found = []
    for i in range(0, len(samples), size):
        piece = samples.take(slice(i, i + size))
        status, worst = judge(
            jnp.asarray(rho), jnp.asarray(alpha, float), setting,
            jax.tree.map(lambda v: padded(v, size), piece),
        )  # fmt: skip
        found.append((np.asarray(status)[: len(piece)], np.asarray(worst)[: len(piece)]))
    status, worst = (np.concatenate(part) for part in zip(*found, strict=True))
    return status, worst


def summary(status: np.ndarray, worst: np.ndarray) -> tuple[float, float]:
    """Share solved and median residual; NaN counts as infinite."""
    median = np.median(np.nan_to_num(worst, nan=np.inf))
    return float(np.mean(status == Status.SOLVED)), float(median)


def better(one: tuple[float, float], other: tuple[float, float]) -> bool:
    """By share solved, then by median residual."""
    return (-one[0], one[1]) < (-other[0], other[1])


def rank(found: tuple[float, float], count: int) -> float:
    """A number that orders as `better` does: states unsolved, plus a share of one in (0, 1) that
    grows with the median residual from 1e-16 to 1e16."""
    unsolved = round((1 - found[0]) * count)
    size = np.log10(np.clip(found[1], 1e-16, 1e16))
    return unsolved + float((size + 17) / 34)


def learn_penalties(
    mpc: MPC, x0s: Any, iterations: int = 100, *, stages: int = 4, groups: str = "step",
    solver: ADMM = ADMM(refine=0), updates: int = 300,  # noqa: B008
    optimizer: optax.GradientTransformation | None = None, batch: int = 128,
    validation: Any = 0.25, warm_start: Any = None, reference: Any = None,
    input_reference: Any = None, seed: int = 0, checkpoint: str | Path | None = None,
    cache: str | Path | None = None, progress: bool = False,
) -> Penalties:  # fmt: skip
    """What `tune_penalties` does, with the record of it, and for other horizons (`for_mpc`)."""
    setting, samples, apart = prepared(
        mpc, x0s, iterations, stages, groups, solver, batch, validation, warm_start, reference,
        input_reference, seed, updates,
    )  # fmt: skip
    if cache is not None and optimizer is not None:
        fail("cache", "given beside an optimiser, which has no fingerprint", "Leave one out")
    plain = {
        "version": VERSION, "iterations": int(iterations), "stages": int(stages), "groups": groups,
        "batch": int(batch), "seed": int(seed),
    }  # fmt: skip
    if optimizer is None:  # they decide its schedule; with another one a run may be made longer
        plain["updates"] = int(updates)
    given = replace(solver, iterations=iterations)
    mark = archive.fingerprint(plain, setting, samples, apart, given.rho, given.alpha)
    path = None if cache is None else Path(cache) / f"{mark}.npz"
    kept = None if path is None else load(path, given, setting.W)
    if kept is not None:
        return warned(kept)
    with jax.enable_x64(True):
        found = learned(
            mpc, setting, samples, apart, given, stages, groups, batch, updates, optimizer, seed,
            checkpoint, {**plain, "fingerprint": mark}, progress,
        )  # fmt: skip
    if path is not None:
        save(path, found)
    return warned(found)


def tune_penalties(
    mpc: MPC, x0s: Any, iterations: int = 100, *, stages: int = 4, groups: str = "step",
    solver: ADMM = ADMM(refine=0), updates: int = 300,  # noqa: B008
    optimizer: optax.GradientTransformation | None = None, batch: int = 128,
    validation: Any = 0.25, warm_start: Any = None, reference: Any = None,
    input_reference: Any = None, seed: int = 0, checkpoint: str | Path | None = None,
    cache: str | Path | None = None, progress: bool = False,
) -> ADMM:  # fmt: skip
    """Learn ADMM's rho and alpha for an MPC problem, so that `iterations` steps solve more states.

    x0s (B, n), or (B, n + m) with the previous inputs where these count: states such as the
    controller will meet; a few hundred to a few thousand. Those proved infeasible are left out.
    warm_start: (z (B, nz), y (B, rows)) or plans of all of them, to learn for warm starts.
    reference, input_reference: to track, as in `solve`, one for all.
    stages: the schedule has so many penalties a row, each for iterations/stages steps.
    groups: "step": rows of a kind share 5 values along the horizon, linear between;
    "row": each row has its own. solver: what it is compared with, and where refine, eps and so on
    come from; both are learned and compared without Newton steps.
    updates: steps of `optimizer` (None: Adam with a cosine schedule), each on a random batch.
    validation: share of x0s set apart, or states (B', n) (cold-started: only without warm_start).
    checkpoint: file to go on from after a kill. cache: folder that keeps results by a fingerprint
    of all of this. Computes in float64.

    Returns `solver` with rho (stages, rows), alpha and iterations, for solve, Controller,
    solve_many and (for a robot's mpc, at set-points) RobotController. It is the best of all
    steps on the validation states by share SOLVED, then by median residual; where none is better
    than `solver`, that is returned and a UserWarning says so. Raises ValueError for bad input,
    before any compile, and for states all proved infeasible.
    """
    return learn_penalties(
        mpc, x0s, iterations, stages=stages, groups=groups, solver=solver, updates=updates,
        optimizer=optimizer, batch=batch, validation=validation, warm_start=warm_start,
        reference=reference, input_reference=input_reference, seed=seed, checkpoint=checkpoint,
        cache=cache, progress=progress,
    ).solver  # fmt: skip


def warned(found: Penalties) -> Penalties:
    """The same; a UserWarning where learning was in vain."""
    if not found.improved:
        warnings.warn(
            "tune_penalties: nothing found is better on the validation states than the solver "
            f"given ({found.solved:.1%} solved); that one is returned", UserWarning, stacklevel=3,
        )  # fmt: skip
    return found


def prepared(
    mpc: MPC, x0s: Any, iterations: int, stages: int, groups: str, solver: ADMM, batch: int,
    validation: Any, warm_start: Any, reference: Any, input_reference: Any, seed: int,
    updates: int,
) -> tuple[Setting, Samples, Samples]:  # fmt: skip
    """The problem, and states for training and validation. ValueError for bad input."""
    mpc.validate()
    for name, count, least in (
        ("iterations", iterations, 1), ("stages", stages, 1), ("batch", batch, 1),
        ("updates", updates, 0), ("seed", seed, 0),
    ):  # fmt: skip
        whole(name, count, least)
    if iterations % stages:
        fail("iterations", f"{iterations} for {stages} stages", "Use a multiple")
    if groups not in ("row", "step"):
        fail("groups", f"{groups!r}", 'Give "row" or "step"')
    with jax.enable_x64(True):
        c = jax.tree.map(np.asarray, condense(in_float64(mpc)))
    rows, n, nz = c.C.shape[0], mpc.system.n, c.P.shape[0]
    if not rows:
        fail("mpc", "has no rows", "Without limits one Newton step solves it; ADMM has no rho")
    replace(solver, iterations=iterations).validate(rows)
    steps, m = mpc.horizon, mpc.system.m
    tracked: list[Any] = []
    for name, value, shape in (
        ("reference", reference, (steps + 1, n)), ("input_reference", input_reference, (steps, m))
    ):  # fmt: skip
        if value is not None:
            if np.shape(value) not in (shape[1:], shape):
                fail(name, f"shape {np.shape(value)}", f"Give {shape[1:]} or {shape}")
            value = np.broadcast_to(np.asarray(value, np.float64), shape)
            require_finite(name, value)
        tracked.append(value)

    def states(name: str, x: Any) -> np.ndarray:
        x = np.asarray(x, np.float64)
        if x.ndim != 2 or x.shape[1] not in (n, mpc.dimension):
            fail(name, f"shape {x.shape}", f"Give states (B, {n})")
        require_finite(name, x)
        return np.pad(x, ((0, 0), (0, mpc.dimension - x.shape[1])))

    x = states("x0s", x0s)
    if len(x) < FEWEST:
        fail("x0s", f"{len(x)} states", f"Give at least {FEWEST}, better some hundred")
    if warm_start is not None:
        warm_start = warm_start.qp if isinstance(warm_start, Plan) else warm_start
        z, y = (warm_start.z, warm_start.y) if hasattr(warm_start, "z") else warm_start
        warm_start = np.asarray(z, np.float64), np.asarray(y, np.float64)
        for part, size in zip(warm_start, (nz, rows), strict=True):
            if part.shape != (len(x), size):
                fail("warm_start", f"shape {part.shape}", f"Needed: {(len(x), size)}")
    samples = Samples(x, warm_start)
    if np.ndim(validation) == 0:
        if not 0 < float(validation) < 1:
            fail("validation", f"{validation}", "Give a share in (0, 1), or states")
        count = max(FEWEST // 4, round(float(validation) * len(x)))
        order = np.random.default_rng(seed).permutation(len(x))
        samples, apart = samples.take(order[count:]), samples.take(order[:count])
        if not len(samples):
            fail("validation", f"{validation} of {len(x)} states", "Leave some to learn from")
    else:
        if warm_start is not None:
            fail("validation", "given as states beside warm starts", "Give a share in (0, 1)")
        apart = Samples(states("validation", validation))
        if not len(apart):
            fail("validation", "no states", "Give some, or a share in (0, 1)")
    W = spread(groups, c.layout, steps, c.balls, min(KNOTS, steps + 1))
    plain = replace(
        solver, iterations=int(iterations), rho=1.0, alpha=1.6, refine=0, differentiate="unrolled"
    )
    return Setting(c, W, tracked[0], tracked[1], plain), samples, apart


def learned(
    mpc: MPC, setting: Setting, samples: Samples, apart: Samples, given: ADMM, stages: int,
    groups: str, batch: int, updates: int, optimizer: Any, seed: int, checkpoint: Any,
    settings: dict[str, Any], progress: bool,
) -> Penalties:  # fmt: skip
    """Start at the best constant, descend, compare."""
    rows, parameters = setting.W.shape
    size = len(apart)

    def measure(rho: Any, alpha: Any, samples: Samples) -> tuple[np.ndarray, np.ndarray]:
        rho = np.atleast_2d(rho)  # one stage counts as many equal ones
        count = stages if len(rho) == 1 else len(rho)
        return judged(np.broadcast_to(rho, (count, rows)), alpha, setting, samples, size)

    # Infeasible states teach nothing. What proves one so, holds whatever rho was.
    tried = []
    known = [np.zeros(len(part), bool) for part in (apart, samples)]
    for rho in CONSTANTS:
        status, worst = measure(rho, 1.6, apart)
        known[0] |= status == Status.PRIMAL_INFEASIBLE
        tried.append((status, worst))
    feasible = ~known[0]
    if not feasible.any():
        fail("validation", "all its states are infeasible", "Give states that can be controlled")
    apart = apart.take(feasible)
    ranks = [rank(summary(status[feasible], worst[feasible]), size) for status, worst in tried]
    constant = CONSTANTS[int(np.argmin(ranks))]
    status, _ = measure(constant, 1.6, samples)
    known[1] = status == Status.PRIMAL_INFEASIBLE
    if known[1].all():
        fail("x0s", "all states are infeasible", "Give states that can be controlled")
    samples = samples.take(~known[1])
    before = summary(*measure(np.asarray(given.rho), given.alpha, apart))

    theta = {
        "rho": np.full((stages, parameters), np.log(constant)),
        "alpha": np.asarray(np.log(0.8 / 0.2)),  # 2 sigmoid = 1.6
    }
    batch = min(batch, len(samples))

    def gradient(theta: Any, step: int) -> tuple[float, Any, dict[str, float]]:
        chosen = minibatch(len(samples), batch, seed, step)
        value, direction = slope(theta, setting, samples.take(chosen))
        return float(value), jax.tree.map(np.asarray, direction), {}

    def values(theta: Any) -> tuple[np.ndarray, float]:
        with np.errstate(over="ignore"):  # inf, which no state is solved with
            return np.exp(theta["rho"] @ setting.W.T), float(2 / (1 + np.exp(-theta["alpha"])))

    def validate(theta: Any) -> tuple[float, dict[str, float]]:
        found = summary(*measure(*values(theta), apart))
        return rank(found, len(apart)), {"solved": found[0], "residual": found[1]}

    if optimizer is None:
        optimizer = optax.adam(optax.cosine_decay_schedule(0.1, max(updates, 1), 0.03), b2=0.99)
    history = descend(
        theta, gradient, validate, optimizer, updates, checkpoint=checkpoint, settings=settings,
        progress=progress,
    )  # fmt: skip
    rho, alpha = values(history.theta)
    after = summary(*measure(rho, alpha, apart))
    solver = replace(given, rho=rho, alpha=alpha)
    if not better(after, before):
        solver, after = given, before
    return Penalties(
        solver, history.theta["rho"], alpha, groups, setting.condensed.layout, mpc.horizon,
        setting.condensed.balls, *after, *before, int(known[0].sum() + known[1].sum()), history,
    )  # fmt: skip


# What a cached file holds beside the arrays.
NUMBERS = ("solved", "residual", "solved_before", "residual_before", "infeasible")


def save(path: Path, found: Penalties) -> None:
    """Keep what was learned."""
    plain = {name: getattr(found, name) for name in (*NUMBERS, "groups", "horizon", "balls")}
    archive.write(
        path, {**plain, "blocks": found.blocks, "alpha": found.alpha}, log_rho=found.log_rho
    )


def load(path: Path, given: ADMM, W: np.ndarray) -> Penalties | None:
    """What `save` wrote; None where there is nothing, or nothing whole."""
    kept = archive.read(path)
    if kept is None:
        return None
    try:
        plain, log_rho = kept[0], np.asarray(kept[1]["log_rho"], float)
        blocks = tuple((kind, tuple(steps), size) for kind, steps, size in plain.pop("blocks"))
        balls = tuple(plain.pop("balls"))
        found = Penalties(given, log_rho, blocks=blocks, balls=balls, **plain)
        solver = replace(given, rho=np.exp(log_rho @ W.T), alpha=found.alpha)
        solver.validate(len(W))
    except (ValueError, KeyError, TypeError):
        return None
    return replace(found, solver=solver) if found.improved else found
