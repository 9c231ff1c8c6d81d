"""The condensed constraints in an orthonormal basis, and linear programs over them (HiGHS).

Candidates for proofs are found with these: margins, ends of rays, the bounding box, the centre. No
label depends on their numbers; proofs use `ExactData`.
"""

import contextlib
import threading
from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.checks import fail
from jaxmpc.feasible.hard_constraints import View, absorbed, around
from jaxmpc.mpc.problem import MPC, RELAX
from jaxmpc.mpc.rows import Block
from jaxmpc.pytrees import pytree, static
from jaxmpc.qp.linalg import matmul
from jaxmpc.qp.problem import Bounds
from jaxmpc.qp.solve import INFINITE
from jaxmpc.sets.convex_sets import set_bounds
from jaxmpc.sets.lp import FLAT, Optimum, Program, cleaned, power_of_two, scaling

# Tangents of a ball are added to a program up to so often.
TANGENTS = 200
# Gain along `outward` beside that of a margin: far above rounding, far below margins that count.
OUTWARD = 1e-5
# A point counts as in a ball that it exceeds by no more than this, relative to its radius.
IN_BALL = 1e-9


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

    # Limits of 1e20 are none, as solvers of linear programs have it, of rows up to 1,000 long.
    most = 1e-3 * INFINITE * np.linalg.norm(np.hstack([C, D]), axis=1)
    lower = np.where((lower <= -most) & (most > 0), -np.inf, lower)
    upper = np.where((upper >= most) & (most > 0), np.inf, upper)

    # Inputs and free states in units of their limits, relative to the first input's: the variables
    # count alike.
    firsts = np.unique(mpc.moves, return_index=True)[1]
    sides = np.abs(set_bounds(around(mpc.inputs), mpc.system.m)).max(axis=0)
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
    ends = size_of_limits(lower, upper)
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
    # Inputs that move no other row are columns of their own: what else stands there is rounding,
    # which would decide the scaling of linear programs.
    U = cleaned(np.where(zero[:, None], 0.0, U[:, :rank]), 1.0)
    back = Vt[:rank].T / singular[:rank]
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


def size_of_limits(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the size of the farther bound of each row, 0 where it has none. One that is a million
    times farther than the other stands for none."""
    ends = np.abs([lower, upper])
    ends = np.where(np.isfinite(ends), ends, 0.0)
    near, far = ends.min(axis=0), ends.max(axis=0)
    return np.where((near > 0) & (far > 1e6 * near), near, far)


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


class Solved(NamedTuple):
    """The end of a linear program: its maximum (inf: unbounded, −inf: empty), where it is attained
    (None: nowhere), and the multipliers (R,) of the rows."""

    value: float
    x: np.ndarray | None
    y: np.ndarray


class RowPrograms:
    """Linear programs over the rows of a feasibility problem, which may end in a ball.

    The ball |v| ≤ radius is the intersection of its tangent half-spaces n'v ≤ radius, which are
    added until they suffice. They are kept for the next program (Kelley 1960).
    """

    def __init__(self, rows: ConstraintRows) -> None:
        self.rows, k = rows, sum(rows.balls)
        self.normals = np.concatenate([np.eye(k), -np.eye(k)])
        # Equalities that the variables can keep, whatever θ is: they leave no margin. A ball does,
        # though both bounds of its rows are its centre.
        equal = (rows.lower == rows.upper) & (np.linalg.norm(rows.U, axis=1) > 0)
        equal[len(equal) - k :] = False
        both = np.hstack([rows.U, rows.D])
        both = both * scaling(both[equal], np.zeros(equal.sum()))[1]
        both = both / np.maximum(np.linalg.norm(both, axis=1), 1e-300)[:, None]
        variables = both[:, : rows.U.shape[1]]
        # Nor do rows of coordinates that are fixed, maybe on a limit of their own.
        self.equalities = equal & (_rank(variables[equal]) == _rank(both[equal]))
        self.equalities |= ~both.any(axis=1)
        self._last: Program | None = None
        self._alone = threading.Lock()  # the last program is changed and solved as one

    def solve_lp(
        self,
        cost: np.ndarray,
        U: np.ndarray,
        shift: np.ndarray | float = 0.0,
        *,
        least: float = -np.inf,
        most: float = np.inf,
        margin: np.ndarray | None = None,
        pinned: np.ndarray | None = None,
    ) -> Solved:
        """Maximise cost'x over lower ≤ U x + shift ≤ upper and the ball.

        least, most: bounds of the last variable. margin (R,): the last variable times this is kept
        from every bound. pinned: values of the variables before the last, the last of those.
        """
        lower, upper = self.rows.lower - shift, self.rows.upper - shift
        balls, R = sum(self.rows.balls), len(lower)
        flat, reduced = slice(0, R - balls), np.zeros(R) if margin is None else margin
        same = (lower == upper)[flat] & (reduced[flat] == 0)
        up, low = U[flat].copy(), -U[flat]
        up[:, -1] += reduced[flat]
        low[:, -1] += reduced[flat]
        high, has_low = np.isfinite(upper[flat]), np.isfinite(lower[flat]) & ~same
        A = np.concatenate([up[high], low[has_low]])
        b = np.concatenate([upper[flat][high], -lower[flat][has_low]])
        equal = np.append(same[high], np.zeros(has_low.sum(), bool))
        ends = np.array([most, -least])
        last = np.outer([1.0, -1.0], np.eye(len(cost))[-1])[np.isfinite(ends)]
        limits = ends[np.isfinite(ends)]
        radius = float(self.rows.radius[0]) if balls else 0.0
        fixed, part = np.zeros(len(cost)), np.ones(len(cost), bool)
        if pinned is not None and len(pinned):
            fixed[-1 - len(pinned) : -1] = pinned
            part[-1 - len(pinned) : -1] = False
        for _ in range(TANGENTS):
            planes = self.normals @ U[R - balls :]
            planes[:, -1] += reduced[-1] if balls else 0.0
            reach = radius + self.normals @ lower[R - balls :]
            G, g = np.vstack([A, planes, last]), np.concatenate([b, reach, limits])
            mask = np.append(equal, np.zeros(len(g) - len(b), bool))
            top = self._maximise(cost[part], G[:, part], g - G @ fixed, mask)
            if top.x is None or top.y is None:
                return Solved(top.value, None, np.zeros(R))
            x = fixed.copy()
            x[part] = top.x
            if not balls:
                break
            v = U[R - balls :] @ x - lower[R - balls :]
            norm, allowed = np.linalg.norm(v), radius - reduced[-1] * x[-1]
            if norm <= allowed + IN_BALL * radius:
                break
            self.normals = np.concatenate([self.normals, v[None] / norm])
        assert top.y is not None
        y, first, second = np.zeros(R), high.sum(), len(A)
        y[flat][high] += top.y[:first]
        y[flat][has_low] -= top.y[first:second]
        y[R - balls :] = top.y[second : second + len(planes)] @ self.normals[: len(planes)]
        return Solved(float(cost @ x), x, y)

    def _maximise(
        self, cost: np.ndarray, G: np.ndarray, g: np.ndarray, equal: np.ndarray
    ) -> Optimum:
        """Maximise cost'x over G x ≤ g, from the end of the last program where the two differ in
        their last column alone, as those of rays from one point do."""
        with self._alone:
            last = self._last
            if (
                last is not None
                and last.G.shape == G.shape
                and np.array_equal(last.g, g)
                and np.array_equal(last.equal, equal)
                and np.array_equal(last.G[:, :-1], G[:, :-1])
            ):
                last.change_last_column(G[:, -1])
                with contextlib.suppress(ValueError):  # in the units of another last column
                    return last.maximise(cost)
            self._last = Program(G, g, equal)
            return self._last.maximise(cost)

    def support(self, direction: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Return max direction'θ over the feasible set: the optimum (inf: unbounded, −inf: empty),
        w, and the multipliers of the rows."""
        k = self.rows.U.shape[1]
        U = np.hstack([self.rows.U, self.rows.D])
        return self._with_w(self.solve_lp(np.append(np.zeros(k), direction), U))

    def ray(
        self, center: np.ndarray, direction: np.ndarray
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """Return max t ≥ 0 with center + t·direction in the feasible set; results as in
        `support`."""
        rows, k = self.rows, self.rows.U.shape[1]
        length = np.abs(direction).max(initial=0.0) or 1.0  # must not choose among equal ends
        U = np.hstack([rows.U, (rows.D @ (direction / length))[:, None]])
        cost = np.append(np.zeros(k), 1 / length)
        return self._with_w(self.solve_lp(cost, U, rows.D @ center, least=0.0))

    def _with_w(self, found: Solved) -> tuple[float, np.ndarray, np.ndarray]:
        k = self.rows.U.shape[1]
        return found.value, np.zeros(k) if found.x is None else found.x[:k], found.y

    def margin(
        self, theta: np.ndarray, size: np.ndarray, along: np.ndarray | float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return w and the multipliers of the largest s with which all rows at the point θ (d,)
        keep s·size, size (R,) ≥ 0, from their bounds: s < 0 where θ is not feasible.

        Equalities keep no margin, unless nothing feasible is found. along (k,): a gain for moving w
        that way, beside that of s.
        """
        rows, k = self.rows, self.rows.U.shape[1]
        U, cost = np.hstack([rows.U, np.zeros((len(rows.U), 1))]), np.ones(k + 1)
        cost[:k] = along
        most, without = rows.size / size.max(), np.where(self.equalities, 0.0, size)
        for each in [without, size][: 1 + np.any(self.equalities)]:
            found = self.solve_lp(cost, U, rows.D @ theta, most=most, margin=each)
            if found.x is not None:
                return found.x[:k], found.y
        return np.zeros(k), np.zeros(len(rows.U))

    @cached_property
    def bounding_box(self) -> tuple[np.ndarray | None, np.ndarray]:
        """Return bounds (2, d) of every feasible θ, lower and upper, infinite where none is found,
        None where the set is found empty; and the multipliers (2d, R) of the upper and then the
        lower sides.
        """
        d, programs = self.rows.D.shape[1], RowPrograms(self.rows)
        directions = np.concatenate([np.eye(d), -np.eye(d)])

        def end(direction: np.ndarray) -> tuple[float, np.ndarray]:
            try:
                value, _, y = programs.support(direction)
            except ValueError:  # the linear program has no answer that can be checked
                return np.inf, np.zeros(len(self.rows.U))
            return value, y

        # Programs of their own, so that no tangent comes from an earlier question.
        ends, y = zip(*map(end, directions), strict=True)
        return moved_out(ends), np.array(y)

    def center(self, given: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return θ (the one given, or the best) and w with the largest common margin of all rows,
        but for equalities that the variables can keep; margins count in scaled rows.

        Raises ValueError where the set is empty or flat, or does not hold the given θ inside.
        """
        rows = self.rows
        k, d = rows.U.shape[1], rows.D.shape[1]
        both = np.hstack([rows.U, rows.D])
        ends = size_of_limits(rows.lower, rows.upper)
        # Margins in units in which rows and coordinates are about 1.
        size = np.where(self.equalities, 0.0, 1 / scaling(both, ends)[0])
        if rows.balls:
            size[-sum(rows.balls) :] = size[-sum(rows.balls) :].max()
        wide, cost = np.hstack([both, np.zeros((len(both), 1))]), np.eye(k + d + 1)[-1]
        found = self.solve_lp(cost, wide, most=4.0, margin=size, pinned=given)
        t = -np.inf if found.x is None else found.x[-1]
        if found.x is not None and t > FLAT:
            return found.x[k : k + d], found.x[:k]
        if given is not None:
            fail("center", f"{given} is not inside the feasible set", "Give None or another")
        empty, flat = "is empty: no initial state has a plan", "is flat: no initial state keeps"
        what = empty if t < -FLAT else f"{flat} a margin"
        fail("mpc", f"its feasible set {what}", RELAX)


def moved_out(ends: Sequence[float]) -> np.ndarray | None:
    """Return bounds (2, d) from the maxima of θ_i and then of −θ_i (2d,); None for an empty set.

    Each side is moved out by the larger of the coordinate's two finite ends, which outweighs the
    tolerances of the linear programs."""
    if -np.inf in ends:
        return None
    sides = np.reshape(ends, (2, -1))
    margin = np.where(np.isfinite(sides), np.abs(sides), 0.0).max(axis=0) + 1e-300
    return np.array([-sides[1] - margin, sides[0] + margin])


def outward(rows: ConstraintRows, inputs: Any) -> np.ndarray:
    """Return the direction (k,) of w in which inputs with a limit on one side alone move away from
    it, each as fast as the others, times `OUTWARD`; zero where there are none.

    Such a limit takes up what is left of one sign only. With multipliers of the largest margin
    nothing is left but rounding, of either sign; beside a gain along this direction something of
    that sign is, of each such input."""
    moved = np.asarray(rows.Omega @ rows.back)
    lower, upper = set_bounds(around(inputs), moved.shape[1])
    side = np.isinf(upper).astype(float) - np.isinf(lower)
    length = np.linalg.norm(moved, axis=2, keepdims=True)
    return OUTWARD * np.einsum("i,kij->j", side, moved / np.where(length > 0, length, 1.0))


def _rank(M: np.ndarray) -> int:
    """Return the rank of rows of length one."""
    return int(np.linalg.matrix_rank(M, rtol=FLAT)) if len(M) else 0
