"""tune_sweep_penalties: penalties with which ADMM decides more states of a feasible-set map.

The first stage of `map_feasible_set` (`feasible/candidates.py`) is an ADMM without cost; its
penalties are weights of the rows. The objective is how far its results are from being proofs,

    mean over states of log10(1 + shortfall / FLOOR),

where the shortfall of a feasible state is the largest violation (normalised rows) of the plan that
the stage ends with, and of an infeasible one how far the half-space of its multipliers is from
excluding the state. The states are labelled by the whole cascade of stages; half of each batch are
those that the first stage leaves undecided. Labels rest on proofs with any penalties, which only
change the stage that decides.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from jaxmpc.arrays import Reals
from jaxmpc.batches import (
    Devices,
    chosen_devices,
    default_chunk,
    divisible,
    padded,
    require_step_type,
)
from jaxmpc.checks import fail, whole
from jaxmpc.feasible.candidates import (
    ALPHA,
    StagePenalties,
    compiled_admm,
    cut_of,
    feasibility_steps,
)
from jaxmpc.feasible.constraint_rows import ConstraintRows, weighted
from jaxmpc.feasible.exact_data import ExactData
from jaxmpc.feasible.map import map_points
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.files import fingerprint
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp import linalg
from jaxmpc.qp.precision import matmul
from jaxmpc.qp.projection import Bounds
from jaxmpc.tuning.batch_mean import BatchMean
from jaxmpc.tuning.descent import descend
from jaxmpc.tuning.result import TuningRun, cached
from jaxmpc.tuning.settings import Settings

# Version of the algorithm: results that an older version cached are not used.
VERSION = 2
# In normalised rows; iterates in float32 end near 1e-5.
FLOOR = 1e-4
# Most states of the validation set, and fewest to learn from.
VALIDATION, FEWEST = 2048, 64


def tune_sweep_penalties(
    mpc: MPC, points: Reals, *, axes: Any = None, fixed: Reals | None = None, iterations: int = 50,
    dtype: Any = "float32", chunk: int | None = None, cache: str | Path | None = None,
    **settings: Any,
) -> TuningRun:  # fmt: skip
    """Tune the penalties of the ADMM stage of `map_feasible_set(mpc, points, ...)`.

    points (B, d), axes, fixed, iterations, dtype, chunk: as there; states are drawn from the
    points. cache: folder that keeps the result by a fingerprint of all of this.
    settings: of `Settings`, as updates=50; here batch is 128 and validation half of the points, at
    most 2,048, unless given. optimizer None: Adam with a cosine schedule and clipped gradients.

    Returns a `TuningRun` whose result is the `StagePenalties` for `map_feasible_set`, with equal
    weights where nothing better was found. Numbers in before and after: decided, the fraction of
    the validation set that the stage decides. Raises ValueError for bad input and for fewer than 64
    points that are finite.
    """
    feasibility = FeasibilityProblem.of(mpc, axes, fixed)
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != feasibility.dimension:
        fail("x0s", f"shape {points.shape}", f"Give points (B, {feasibility.dimension})")
    points = points[np.all(np.isfinite(points), axis=1)]
    iterations = whole("iterations", iterations, 2)
    require_step_type(dtype)
    if len(points) < FEWEST:
        fail("x0s", f"{len(points)} finite points", f"Learning needs at least {FEWEST}")
    usual = {"batch": 128, "validation": min(VALIDATION / len(points), 0.5)}
    chosen = Settings(**{**usual, **settings})
    chosen.validate()
    train, test = chosen.split(points, shuffle=True)
    chunk = default_chunk() if chunk is None else chunk
    train = train[:chunk]

    rows, exact = feasibility.rows, feasibility.exact(np.abs(points).max(axis=0))
    stage = Stage(exact, rows, iterations, dtype, chosen_devices(chosen.devices))
    decides = {
        "version": VERSION, "iterations": iterations, "dtype": str(np.dtype(dtype)),
        "batch": chosen.batch, "seed": chosen.seed, "updates": chosen.updates,
    }  # fmt: skip
    decides["fingerprint"] = fingerprint(decides, exact, rows, train, test)

    def tune() -> TuningRun:
        labelled = map_points(
            feasibility, train, iterations=iterations, dtype=dtype, chunk=chunk,
            devices=chosen.devices,
        )  # fmt: skip
        with jax.enable_x64(True):
            return tune_row_weights(stage, train, labelled.label, test, chosen, decides)

    return cached(cache, decides, chosen, _penalties, tune)


@dataclass(frozen=True, eq=False)
class Stage:
    """The ADMM stage of a map: its rows, proofs, iterations, precision and devices."""

    problem: ExactData
    rows: ConstraintRows
    iterations: int
    dtype: Any
    devices: Devices

    def undecided(self, x: np.ndarray, penalties: StagePenalties, chunk: int) -> np.ndarray:
        """Return which states (B,) the stage leaves undecided; chunk: states at once."""
        run = compiled_admm(self.iterations, np.dtype(self.dtype), self.devices)
        chunk = divisible(chunk, self.devices)
        made = weighted(self.rows, penalties.weight)[0]
        parts = [
            run(self.problem, made, padded(part, chunk), np.float64(penalties.alpha))[0].label
            for part in np.split(x, range(chunk, len(x), chunk))
        ]
        return np.concatenate(parts)[: len(x)] == 0

    def free_weights(self) -> np.ndarray:
        """Return W (rows, k): log of the weights = W θ; the rows of a ball share one weight."""
        R, balls = len(self.rows.lower), sum(self.rows.balls)
        W = np.eye(R)
        W[R - balls :, R - balls :] = 1.0
        return W[:, : R - balls + 1] if balls else W


def tune_row_weights(
    stage: Stage, train: np.ndarray, label: np.ndarray, test: np.ndarray, settings: Settings,
    decides: dict[str, Any],
) -> TuningRun:  # fmt: skip
    """Descend from equal weights; return the best on the validation set."""
    W, size = stage.free_weights(), len(test)
    assert settings.batch is not None
    batch = settings.batch

    def at(theta: Any) -> dict[str, np.ndarray]:
        return {"weight": np.exp(theta["weight"] @ W.T), "alpha": 2 / (1 + np.exp(-theta["alpha"]))}

    def validate(theta: Any) -> tuple[float, dict[str, float]]:
        undecided = float(np.mean(stage.undecided(test, _penalties(at(theta)), size)))
        return undecided, {"decided": 1 - undecided}

    theta = {"weight": np.zeros(W.shape[1]), "alpha": np.array(np.log(ALPHA / (2 - ALPHA)))}
    initial = at(theta)
    hard = np.flatnonzero(stage.undecided(train, _penalties(initial), size) & (label != 0))
    known = np.flatnonzero(label)

    program = sweep_loss_and_gradient(stage.iterations, stage.devices)

    def gradient(theta: Any, step: int) -> tuple[float, Any, dict[str, float]]:
        rng = np.random.default_rng((settings.seed, step))
        half = batch // 2
        chosen = np.concatenate([rng.choice(hard, half), rng.choice(known, batch - half)])
        (value, slope), _ = program(
            theta, W, stage.problem, stage.rows, train[chosen], label[chosen], np.ones(batch)
        )
        return float(value), slope, {}

    loss, numbers = validate(theta)
    before = {"loss": loss, **numbers}
    if not loss or not len(hard):  # nothing to gain, or nothing to learn from
        return TuningRun(initial, initial, before, before, False, decides, _penalties)
    schedule = optax.cosine_decay_schedule(0.05, max(settings.updates, 1), 0.03)
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule, b2=0.99))
    history = descend(theta, gradient, validate, optimizer, settings, decides, shown="decided")
    least = float(history.validation[history.best])
    improved = least < loss
    after = {"loss": least, "decided": 1 - least} if improved else before
    return TuningRun(
        at(history.theta) if improved else initial, initial, before, after, improved, decides,
        _penalties, history, at(history.thetas),
    )  # fmt: skip


def _penalties(values: Any) -> StagePenalties:
    """Return the penalties with weight and alpha of `values`."""
    return StagePenalties(np.asarray(values["weight"]), float(values["alpha"]))


def shortfall(
    problem: ExactData, rows: ConstraintRows, theta: Array, label: Array, weight: Array,
    alpha: Array, iterations: int,
) -> Array:  # fmt: skip
    """Return how far the stage's result at θ is from a proof of the label; ≤ 0: it is a proof."""
    U, bounds = jnp.asarray(rows.U), rows.bounds(theta)
    A = weight[:, None] * U
    pseudoinverse = linalg.solve(matmul(A.T, A), A.T)
    onto = lambda v: matmul(pseudoinverse, v)
    P = matmul(A, pseudoinverse)

    def scaled(bound: Array) -> Array:
        finite = jnp.isfinite(bound)
        return jnp.where(finite, weight * jnp.where(finite, bound, 0.0), bound)

    radius = None if rows.radius is None else weight[-1:] * rows.radius
    box = Bounds(scaled(bounds.l), scaled(bounds.u), radius=radius, balls=rows.balls)

    project = lambda t: box.project(t, 1.0)
    t, before = feasibility_steps(
        project, lambda v: matmul(P, v), project(jnp.zeros_like(weight)), alpha, iterations
    )
    e, e_before = t - project(t), before - project(before)
    beyond = jnp.max(jnp.abs(bounds.prox_residual(matmul(U, onto(t - 2 * e)), 1.0)))

    def outside(y: Array) -> Array:
        """Return how far θ is inside the half-space that multipliers give; < 0: it is excluded."""
        a, b, _ = cut_of(problem, rows, weight * y)
        b = jnp.where(jnp.isfinite(b), b, 1.0)
        return (b - jnp.sum(a * theta)) / jnp.sqrt(jnp.sum(a**2) + 1e-20)

    return jnp.where(label > 0, beyond, jnp.minimum(outside(e), outside(e - e_before)))


@cache
def sweep_loss_and_gradient(iterations: int, devices: Devices) -> BatchMean:
    """Return the program (θ, W, problem, rows, x (B, d), label (B,), weights (B,)) → ((loss,
    gradient), {}): the weighted mean of the module's docstring."""

    def loss(
        theta: Any, W: Array, problem: ExactData, rows: ConstraintRows, x: Array, label: Array,
        weights: Array,
    ) -> Array:  # fmt: skip
        weight, alpha = jnp.exp(W @ theta["weight"]), 2 * jax.nn.sigmoid(theta["alpha"])
        missing = jax.vmap(
            lambda x, label: shortfall(problem, rows, x, label, weight, alpha, iterations)
        )(x, label)
        losses = jnp.log10(1 + jnp.maximum(missing, 0.0) / FLOOR)
        return jnp.sum(weights * losses) / jnp.sum(weights)

    value_and_slope = jax.value_and_grad(loss)
    batched = (False, False, False, False, True, True)
    return BatchMean(lambda *args: (value_and_slope(*args), {}), devices, batched)
