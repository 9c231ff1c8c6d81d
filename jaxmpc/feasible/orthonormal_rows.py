"""The condensed constraints in an orthonormal basis, in which candidates for proofs are found.

No label depends on these numbers; proofs use `ExactData`.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.feasible.hard_constraints import absorbed
from jaxmpc.feasible.view import View
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.rows import Block
from jaxmpc.pytrees import pytree, static
from jaxmpc.qp.linalg import matmul
from jaxmpc.qp.problem import Bounds
from jaxmpc.sets.convex_sets import set_bounds
from jaxmpc.sets.lp import power_of_two, scaling


@pytree
class ConstraintRows:
    """Rows of the condensed constraints: lower ≤ (U w)_i + D_i θ ≤ upper, i = 1..R.

    U (R, k) is an orthonormal basis of the range of the normalised rows' matrix in the decision
    variables (inputs, prestabilised or not, and in a projection the free states); back (nz, k) maps
    w to the variables. A zero row, which no variable moves (such as those at k = 0), has
    U = 0: a half-space on θ alone. weight (R,) brings multipliers to the units of the problem's
    rows, and index says where the multiplier of each row of `ExactData` (step by step, then
    terminal rows, then those of the terminal ellipsoid) stands among the R (R where there is
    none). The last `balls` rows are those of the ellipsoid: |v − lower| ≤ radius. Psi, Omega, psi:
    inputs from θ and the variables. zero_rows: indices of those with U = 0, but for a ball's.
    size: of the bounds (`typical_bound`).
    """

    U: np.ndarray
    back: np.ndarray
    D: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    weight: np.ndarray
    index: np.ndarray
    Psi: np.ndarray
    Omega: np.ndarray
    psi: np.ndarray
    zero_rows: np.ndarray
    size: float
    radius: Any
    balls: tuple[int, ...] = static()

    def bounds(self, theta: Array) -> Bounds:
        """Return the bounds that θ leaves for U w."""
        shift = matmul(jnp.asarray(self.D), theta)
        return Bounds(self.lower - shift, self.upper - shift, radius=self.radius, balls=self.balls)


def constraint_rows(
    mpc: MPC, view: View, c: Any, blocks: list[Block], growth: float | None = None
) -> ConstraintRows:
    """Restrict the condensed rows of a problem without soft rows to a view, and normalise them.

    c: the `Condensed` problem, in NumPy; blocks: its `hard_blocks`. growth: leave the basis out (U
    is the matrix itself) and measure rows and inputs of step k in units of growth^k: predictions of
    an unstable plant that is not prestabilised, and their multipliers, are all about 1 in these.
    NumPy in float64; not traceable.
    """
    axes, others = list(view.axes), list(view.others)
    C, D, lower, upper = c.C, c.D[:, axes], c.lower - c.d, c.upper - c.d
    Psi, Omega, psi = c.Psi[:, :, axes], c.Omega, c.psi
    extra = 0
    if view.projects:  # rows of the free states' box come first
        extra = len(others)
        C = np.block([[np.zeros((extra, C.shape[1])), np.eye(extra)], [C, c.D[:, others]]])
        D = np.concatenate([np.zeros((extra, len(axes))), D])
        lower, upper = np.append(view.lower, lower), np.append(view.upper, upper)
        Omega = np.concatenate([Omega, c.Psi[:, :, others]], axis=2)
    elif others:
        rest = np.asarray(view.fixed)[others]
        lower, upper = lower - c.D[:, others] @ rest, upper - c.D[:, others] @ rest
        psi = psi + c.Psi[:, :, others] @ rest

    # Inputs and free states in units of their limits, relative to the first input's: the variables
    # count alike.
    firsts = np.unique(mpc.moves, return_index=True)[1]
    sides = np.abs(set_bounds(mpc.inputs, mpc.system.m)).max(axis=0)
    unit = np.tile(power_of_two(sides), len(firsts))
    if extra:
        free = power_of_two(np.maximum(np.abs(view.lower), np.abs(view.upper)))
        unit = np.append(unit, free)
    unit = unit / unit[0]
    row_unit = np.ones(len(C))
    if growth is not None:
        by_block = [np.repeat(steps, size) for _, steps, size in c.layout]
        row_unit[extra:] = growth ** np.concatenate(by_block)
        unit[: len(unit) - extra] *= np.repeat(growth**firsts, mpc.system.m)
    C = C / row_unit[:, None] * unit

    norm = np.linalg.norm(C, axis=1)
    ends = np.abs([lower, upper])
    ends = np.where(np.isfinite(ends), ends, 0.0).max(axis=0)
    # A row counts as zero if its entries are rounding beside its other terms.
    others_of_row = np.linalg.norm(D * scaling(D, ends)[1], axis=1) + ends
    zero = norm * row_unit <= 1e-13 * others_of_row
    keep = np.flatnonzero(np.isfinite(lower) | np.isfinite(upper))
    size = np.where(zero, np.linalg.norm(D, axis=1), norm * row_unit)
    first = len(size) - sum(c.balls)
    if c.balls:  # one scale for all rows of the ball
        moved = norm[first:].max() > 0
        own = norm * row_unit if moved else np.linalg.norm(D, axis=1)
        size[first:] = own[first:].max()
    size, zero = size[keep], zero[keep]
    weight = 1 / np.where(size > 0, size, 1.0)
    scaled = np.where(zero[:, None], 0.0, (weight * row_unit[keep])[:, None] * C[keep])
    U, singular, Vt = np.linalg.svd(scaled, full_matrices=False)
    rank = int(np.sum(singular > 1e-12 * singular.max(initial=0.0)))
    U, back = np.where(zero[:, None], 0.0, U[:, :rank]), Vt[:rank].T / singular[:rank]
    back = unit[:, None] * back
    if growth is not None:
        U, back = scaled, np.diag(unit)

    place = np.full(len(lower), len(keep))
    place[keep] = np.arange(len(keep))
    index = multiplier_index(mpc, blocks, c.layout, place[extra:], len(keep))
    lower, upper = weight * lower[keep], weight * upper[keep]
    return ConstraintRows(
        U=U,
        back=back,
        D=weight[:, None] * D[keep],
        lower=lower,
        upper=upper,
        weight=weight,
        index=index,
        Psi=Psi,
        Omega=Omega,
        psi=psi,
        zero_rows=np.flatnonzero(zero[: len(keep) - sum(c.balls)]),
        size=typical_bound(lower * row_unit[keep], upper * row_unit[keep]),
        radius=weight[-1:] * c.radius if c.balls else None,
        balls=c.balls,
    )


def typical_bound(lower: np.ndarray, upper: np.ndarray) -> float:
    """Return the size of bounds to which tolerances are relative: the lower quartile of those that
    are finite and not zero, as some may be huge and stand for none; 1 without any."""
    ends = np.abs(np.concatenate([lower, upper]))
    ends = ends[np.isfinite(ends) & (ends > 0)]
    return float(np.quantile(ends, 0.25)) if len(ends) else 1.0


def multiplier_index(
    mpc: MPC, blocks: list[Block], layout: tuple[Any, ...], place: np.ndarray, none: int
) -> np.ndarray:
    """Return `ConstraintRows.index`. place: where each row of the condensed problem stands among
    the R that are kept."""
    N, offset = mpc.horizon, 0
    columns, last, ball = [], [np.zeros(0, int)], np.zeros(0, int)
    for block, (_, steps, size) in zip(blocks, layout, strict=True):
        table = np.full((N + 1, size), none)
        table[list(steps)] = place[offset : offset + len(steps) * size].reshape(-1, size)
        offset += len(steps) * size
        if absorbed(mpc, block):
            continue
        if block.radius is not None:
            ball = table[N]
            continue
        if any(k < N for k in steps):
            columns.append(table[:N])
        if N in steps:
            last.append(table[N])
    by_step = np.concatenate([np.zeros((N, 0), int), *columns], axis=1)
    return np.concatenate([by_step.ravel(), *last, ball])
