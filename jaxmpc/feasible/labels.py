"""Labels of points, each with its proof, made by a cascade of stages chunk by chunk."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from jaxmpc.checks import fail
from jaxmpc.compiled import (
    Compiled,
    default_chunk,
    first_rows,
    gather_size,
    padded,
    require_step_type,
)
from jaxmpc.feasible.candidates import ALPHA, StagePenalties, Verdict, admm_stage, newton_stage
from jaxmpc.feasible.constraint_rows import weighted
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.qp.status import Status

# Newton steps between two attempts at a proof, and how often; the decided leave in between.
# What resists all of them gets a longer ADMM run and Newton once more.
NEWTON_STEPS = 8
NEWTON_ROUNDS = 8
LONGER = 20

# The arrays of `Labels`.
ARRAYS = ("label", "status", "starts", "plans", "cut_normals", "cut_offsets")


@dataclass(frozen=True)
class Labels:
    """Labels of b points and their proofs.

    label (b,) int8: 1 proved feasible, −1 proved infeasible, 0 undecided. status (b,) int8:
    `Status` (NOT_RUN, NON_FINITE, or SOLVED / PRIMAL_INFEASIBLE / ITERATION_LIMIT for the three
    labels). starts (b, n), plans (b, N, m): x_0 and inputs that prove 1, else NaN.
    cut_normals (b, d), cut_offsets (b,): the half-space a'x ≤ b, valid on the whole feasible set,
    that proves −1, else NaN. An offset of ∞ says that −1 is proved at the point but that no such
    half-space is known: on sets that extend both ways without end, or very far, along a facet,
    the rounding of its normal outweighs what the point is outside. Seconds spent compiling and
    running.
    """

    label: np.ndarray
    status: np.ndarray
    starts: np.ndarray
    plans: np.ndarray
    cut_normals: np.ndarray
    cut_offsets: np.ndarray
    compile_seconds: float = 0.0
    run_seconds: float = 0.0

    @classmethod
    def empty(cls, count: int, problem: FeasibilityProblem) -> "Labels":
        """Labels of `count` points that have not been run."""
        mpc, d = problem.mpc, problem.dimension
        n, m, horizon = mpc.dimension, mpc.system.m, mpc.horizon
        return cls(
            np.zeros(count, np.int8), np.full(count, Status.NOT_RUN, np.int8),
            np.full((count, n), np.nan), np.full((count, horizon, m), np.nan),
            np.full((count, d), np.nan), np.full(count, np.nan),
        )  # fmt: skip

    def first(self, count: int) -> "Labels":
        """Labels of the first `count` points."""
        return replace(self, **{name: getattr(self, name)[:count] for name in ARRAYS})

    def put(self, where: Any, verdict: Verdict) -> None:
        """Write what was proved at positions `where`; the decided keep their proof for good."""
        label = verdict.label
        self.label[where] = label
        self.status[where] = np.select(
            [label == 1, label == -1],
            [Status.SOLVED, Status.PRIMAL_INFEASIBLE],
            Status.ITERATION_LIMIT,
        )
        feasible, infeasible = label == 1, label == -1
        self.starts[where] = np.where(feasible[:, None], verdict.start, np.nan)
        self.plans[where] = np.where(feasible[:, None, None], verdict.inputs, np.nan)
        self.cut_normals[where] = np.where(infeasible[:, None], verdict.normal, np.nan)
        self.cut_offsets[where] = np.where(infeasible, verdict.offset, np.nan)


def label_chunks(
    problem: FeasibilityProblem, points: Any, *, iterations: int = 50, dtype: Any = "float32",
    chunk: int | None = None, penalties: StagePenalties | None = None,
) -> Iterator[tuple[slice, Labels]]:  # fmt: skip
    """Label points chunk by chunk; yields (slice of the points, Labels). See `map_feasible_set`."""
    d = problem.dimension
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != d:
        fail("x0s", f"shape {points.shape}", f"Give points (B, {d}), one column a mapped state")
    chunk = default_chunk() if chunk is None else chunk
    if iterations < 1 or chunk < 1:
        fail("iterations, chunk", f"{iterations}, {chunk}", "Give counts of at least 1")
    require_step_type(dtype)

    usable = np.all(np.isfinite(points), axis=1)
    rows = problem.rows
    quick, alpha, back = rows, ALPHA, None
    if penalties is not None:
        if np.shape(penalties.weight) != rows.lower.shape:
            shape = np.shape(penalties.weight)
            fail("penalties", f"weights {shape}", f"Learn them for this map: {rows.lower.shape}")
        if not (np.all(np.isfinite(penalties.weight)) and np.all(penalties.weight > 0)):
            fail("penalties", "hold a weight that is not positive", "Learn them again")
        if not 0 < penalties.alpha < 2:
            fail("penalties", f"alpha {penalties.alpha}", "Over-relaxation lies in (0, 2)")
        (quick, back), alpha = weighted(rows, penalties.weight), penalties.alpha
    sizes = np.abs(points[usable]) if usable.any() else np.zeros((1, d))
    exact = problem.exact(sizes.max(axis=0), np.median(sizes, axis=0))
    admm, newton = admm_stage(iterations, np.dtype(dtype)), newton_stage(NEWTON_STEPS)
    longer = admm_stage(LONGER * iterations, np.dtype(np.float64))
    chunk = min(chunk, max(len(points), 1))
    size = gather_size(chunk)

    for start in range(0, len(points), chunk):
        begun, compiled = time.perf_counter(), Compiled.seconds
        here = slice(start, min(start + chunk, len(points)))
        ok = usable[here]
        x = np.where(ok[:, None], points[here], 0.0)
        labels = Labels.empty(len(x), problem)
        with jax.enable_x64(True):
            verdict, w = admm(exact, quick, padded(x, chunk), np.float64(alpha))
            labels.put(ok, jax.tree.map(lambda v, ok=ok: v[: len(ok)][ok], verdict))
            w = w[: len(x)].astype(np.float64)
            w = w if back is None else w @ back.T
            for stage in (*[newton] * NEWTON_ROUNDS, longer, *[newton] * NEWTON_ROUNDS):
                left = np.flatnonzero((labels.label == 0) & ok)
                for i in range(0, len(left), size):
                    batch = left[i : i + size]
                    last = padded(w[batch], size) if stage is newton else np.float64(ALPHA)
                    verdict, better = stage(exact, rows, padded(x[batch], size), last)
                    labels.put(batch, first_rows(verdict, len(batch)))
                    w[batch] = better[: len(batch)]
        labels.status[~ok] = Status.NON_FINITE
        compiled = Compiled.seconds - compiled
        spent = time.perf_counter() - begun - compiled
        yield here, replace(labels, compile_seconds=compiled, run_seconds=spent)


def joined(labels: Labels, here: slice, part: Labels) -> Labels:
    """`labels` with a chunk written in (in place) and its seconds added."""
    for name in ARRAYS:
        getattr(labels, name)[here] = getattr(part, name)
    return replace(
        labels,
        compile_seconds=labels.compile_seconds + part.compile_seconds,
        run_seconds=labels.run_seconds + part.run_seconds,
    )
