"""Penalties of a sweep's first stage, learned: more states are decided before Newton starts.

The first stage (`feasible/candidates.py`) is an ADMM without cost; its penalties are weights of
rows. What is minimised here is how far its answers are from being proofs,

    mean over states of log10(1 + shortfall / FLOOR),

where the shortfall of a feasible state is the largest violation (normalised rows) of the plan that
the rung ends with, and of an infeasible one how far the half-space of its multipliers is from
excluding the state. The states come labelled by the whole cascade; half of each batch are those
that the rung leaves open. Proofs decide labels with any penalties: these only change who decides.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array

from jaxmpc.checks import fail, whole
from jaxmpc.compiled import default_chunk, padded, require_step_type
from jaxmpc.feasible.candidates import ALPHA, StagePenalties, compiled_admm, cut_of
from jaxmpc.feasible.constraint_rows import ConstraintRows, weighted
from jaxmpc.feasible.exact_data import ExactData
from jaxmpc.feasible.map import map_points
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp import linalg
from jaxmpc.qp.precision import matmul
from jaxmpc.qp.projection import Bounds
from jaxmpc.tuning import archive
from jaxmpc.tuning.descent import descend

VERSION = 1
# In normalised rows; iterates in float32 end near 1e-5.
FLOOR = 1e-4
# States apart, and the fewest to learn from.
APART, FEWEST = 2048, 64


@dataclass(frozen=True, eq=False)
class SweepPenalties:
    """penalties: for `map_feasible_set`; None where learning found nothing better. decided,
    decided_before: share of states apart that the first rung decides with and without them.
    """

    penalties: StagePenalties | None
    decided: float
    decided_before: float


def tune_sweep_penalties(
    mpc: MPC, points: Any, *, axes: Any = None, fixed: Any = None, iterations: int = 50,
    dtype: Any = "float32", chunk: int | None = None, updates: int = 100, batch: int = 128,
    seed: int = 0, cache: str | Path | None = None, progress: bool = False,
) -> SweepPenalties:  # fmt: skip
    """Learn penalties of the ADMM stage of `map_feasible_set(mpc, points, ...)`.

    points (B, d), axes, fixed, iterations, dtype, chunk: as there; states are drawn from the
    points. cache: folder that keeps the result by a fingerprint of all of this. Raises ValueError
    for bad input and for fewer than 64 points that are finite.
    """
    feasibility = FeasibilityProblem.of(mpc, axes, fixed)
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != feasibility.dimension:
        fail("x0s", f"shape {points.shape}", f"Give points (B, {feasibility.dimension})")
    points = points[np.all(np.isfinite(points), axis=1)]
    iterations, batch = whole("iterations", iterations, 2), whole("batch", batch, 1)
    updates, seed = whole("updates", updates, 1), whole("seed", seed, 0)
    require_step_type(dtype)
    if len(points) < FEWEST:
        fail("x0s", f"{len(points)} finite points", f"Learning needs at least {FEWEST}")
    chunk = default_chunk() if chunk is None else chunk
    order = np.random.default_rng(seed).permutation(len(points))
    count = min(APART, len(points) // 2)
    apart, samples = points[order[:count]], points[order[count:][:chunk]]

    moving, problem = feasibility.rows, feasibility.exact(np.abs(points).max(axis=0))
    plain = {
        "version": VERSION, "iterations": iterations, "dtype": str(np.dtype(dtype)),
        "updates": updates, "batch": batch, "seed": seed,
    }  # fmt: skip
    mark = archive.fingerprint(plain, problem, moving, samples, apart)
    path = None if cache is None else Path(cache) / f"{mark}.npz"
    kept = None if path is None else load(path, len(moving.lower))
    if kept is not None:
        return kept
    label = map_points(feasibility, samples, chunk=chunk, iterations=iterations, dtype=dtype).label
    with jax.enable_x64(True):
        found = learned(
            problem, moving, samples, label, apart, iterations, dtype, updates, batch, seed,
            progress,
        )  # fmt: skip
    if path is not None:
        save(path, found)
    return found


@dataclass(frozen=True)
class Stage:
    """The ADMM stage with given penalties, on one size of batch."""

    problem: ExactData
    rows: ConstraintRows
    iterations: int
    dtype: Any

    def undecided(self, x: np.ndarray, penalties: StagePenalties, size: int) -> np.ndarray:
        """Which states (B,) it leaves open."""
        run = compiled_admm(self.iterations, np.dtype(self.dtype))
        made = weighted(self.rows, penalties.weight)[0]
        parts = [
            run(self.problem, made, padded(part, size), np.float64(penalties.alpha))[0].label
            for part in np.split(x, range(size, len(x), size))
        ]
        return np.concatenate(parts)[: len(x)] == 0


def learned(
    problem: ExactData, moving: ConstraintRows, samples: np.ndarray, label: np.ndarray,
    apart: np.ndarray, iterations: int, dtype: Any, updates: int, batch: int, seed: int,
    progress: bool,
) -> SweepPenalties:  # fmt: skip
    """Descend from equal weights; the best on the states apart."""
    R, size = len(moving.lower), len(apart)
    stage, plain = Stage(problem, moving, iterations, dtype), StagePenalties(np.ones(R))
    balls = sum(moving.balls)
    W = np.eye(R)
    if balls:  # its rows share one weight
        W[R - balls :, R - balls] = 1.0
        W = W[:, : R - balls + 1]
    share = lambda penalties: float(np.mean(stage.undecided(apart, penalties, size)))
    open_before = share(plain)
    known = np.flatnonzero(label)
    hard = np.flatnonzero(stage.undecided(samples, plain, size) & (label != 0))
    if not open_before or not len(hard):
        return SweepPenalties(None, 1 - open_before, 1 - open_before)

    def gradient(theta: Any, step: int) -> tuple[float, Any, dict[str, float]]:
        rng = np.random.default_rng((seed, step))
        half = batch // 2
        chosen = np.concatenate([rng.choice(hard, half), rng.choice(known, batch - half)])
        value, slope = descent(
            theta, W, problem, moving, samples[chosen], label[chosen], iterations
        )
        return float(value), jax.tree.map(np.asarray, slope), {}

    def at(theta: Any) -> StagePenalties:
        return StagePenalties(np.exp(W @ theta["weight"]), float(2 / (1 + np.exp(-theta["alpha"]))))

    def validate(theta: Any) -> tuple[float, dict[str, float]]:
        value = share(at(theta))
        return value, {"undecided": value}

    theta = {"weight": np.zeros(W.shape[1]), "alpha": np.log(ALPHA / (2 - ALPHA))}
    steps = optax.cosine_decay_schedule(0.05, updates, 0.03)
    optimizer = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(steps, b2=0.99))
    history = descend(theta, gradient, validate, optimizer, updates, progress=progress)
    left = float(np.min(history.validation[history.best]))
    better = at(history.theta) if left < open_before else None
    return SweepPenalties(better, 1 - min(left, open_before), 1 - open_before)


def shortfall(
    problem: ExactData, rows: ConstraintRows, theta: Array, label: Array, weight: Array,
    alpha: Array, iterations: int,
) -> Array:  # fmt: skip
    """How far the stage's answer at θ is from a proof of its label; ≤ 0: none is missing."""
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

    def step(t: Array, _: None = None) -> tuple[Array, None]:
        s = box.project(t, 1.0)
        return t + alpha * (matmul(P, 2 * s - t) - s), None

    before, _ = jax.lax.scan(step, box.project(jnp.zeros_like(weight), 1.0), length=iterations - 1)
    t, _ = step(before)
    excess = lambda t: t - box.project(t, 1.0)
    e, e_before = excess(t), excess(before)
    beyond = jnp.max(jnp.abs(bounds.excess(matmul(U, onto(t - 2 * e)), 1.0)))

    def outside(y: Array) -> Array:
        """Distance of θ from the half-space that multipliers give, beyond which it is excluded."""
        a, b, _ = cut_of(problem, rows, weight * y)
        b = jnp.where(jnp.isfinite(b), b, 1.0)
        return (b - jnp.sum(a * theta)) / jnp.sqrt(jnp.sum(a**2) + 1e-20)

    return jnp.where(label > 0, beyond, jnp.minimum(outside(e), outside(e - e_before)))


def loss(
    theta: Any, W: Array, problem: ExactData, rows: ConstraintRows, x: Array, label: Array,
    iterations: int,
) -> Array:  # fmt: skip
    """The number that is minimised; see above."""
    weight, alpha = jnp.exp(W @ theta["weight"]), 2 * jax.nn.sigmoid(theta["alpha"])
    missing = jax.vmap(
        lambda x, label: shortfall(problem, rows, x, label, weight, alpha, iterations)
    )(x, label)
    return jnp.mean(jnp.log10(1 + jnp.maximum(missing, 0.0) / FLOOR))


descent = jax.jit(jax.value_and_grad(loss), static_argnums=6)


def save(path: Path, found: SweepPenalties) -> None:
    """Keep what was learned."""
    p = found.penalties
    plain = {"decided": found.decided, "decided_before": found.decided_before}
    arrays = {} if p is None else {"weight": p.weight, "alpha": p.alpha}
    archive.write(path, plain, **arrays)


def load(path: Path, count: int) -> SweepPenalties | None:
    """What `save` wrote; None where there is nothing, or nothing whole."""
    kept = archive.read(path)
    if kept is None:
        return None
    try:
        plain, arrays = kept
        found = SweepPenalties(None, **plain)
        if arrays:
            weight, alpha = np.asarray(arrays["weight"], float), float(arrays["alpha"])
            if weight.shape != (count,) or not np.all((weight > 0) & np.isfinite(weight)):
                return None
            found = replace(found, penalties=StagePenalties(weight, alpha))
    except (ValueError, KeyError, TypeError):
        return None
    return found
