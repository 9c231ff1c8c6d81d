"""The hard constraints of an MPC problem as float64 arrays: the exact data that proofs rest on.

First a `View`: which initial states a point stands for. Then `ExactData`, and what it is made of.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import Reals, host_array
from jaxmpc.checks import entries, fail, require_finite
from jaxmpc.mpc.problem import MPC, at_stage, differing
from jaxmpc.mpc.rows import Block, given_blocks
from jaxmpc.mpc.tightening import require_room, require_tightened, with_bounds
from jaxmpc.pytrees import named_pytree, pytree, static
from jaxmpc.sets.convex_sets import Box, Ellipsoid, set_bounds
from jaxmpc.sets.lp import power_of_two
from jaxmpc.systems.system import host_matrices

# Indices or names of states, None for all.
Axes: TypeAlias = Sequence[int | str] | np.ndarray | None


@pytree
class View:
    """Which initial states a point θ (d,) of the map stands for.

    x_0 has θ at `axes` and `fixed` elsewhere (slice), or, where `fixed` is None, anything in the
    box [lower, upper] of the other states (projection: feasible if some value is).
    """

    axes: tuple[int, ...] = static()
    others: tuple[int, ...] = static()
    fixed: Any
    lower: Any
    upper: Any

    @property
    def projects(self) -> bool:
        """Return whether the states that are not mapped are free."""
        return self.fixed is None and bool(self.others)

    def states(self, points: np.ndarray) -> np.ndarray:
        """Return the states (B, n) of points (B, d) of a slice."""
        x = np.zeros(len(self.axes) + len(self.others)) if self.fixed is None else self.fixed
        states = np.tile(x, (len(points), 1))
        states[:, list(self.axes)] = points
        return states

    def initial_state(self, theta: Array, free: Array) -> Array:
        """Return x_0 (n,) of a point θ and values `free` of the other states, clipped into their
        box."""
        n = len(self.axes) + len(self.others)
        x = jnp.zeros(n, theta.dtype) if self.fixed is None else jnp.asarray(self.fixed)
        x = x.at[np.array(self.axes)].set(theta)
        if self.projects:
            x = x.at[np.array(self.others)].set(jnp.clip(free, self.lower, self.upper))
        return x


def make_view(mpc: MPC, axes: Axes = None, fixed: Reals | None = None) -> View:
    """Check and complete the choice of states to map; raise ValueError for a wrong one.

    axes: indices or names of the mapped states, None for all. fixed: values of the other states
    (n − d,), in their order, or of all (n,), of which those at `axes` are ignored, for a slice;
    None for a projection along the others.
    """
    n = mpc.dimension
    names = list(mpc.system.state_names)
    cure = f"Give state indices or names ({', '.join(names) or 'none set'})"
    axes = tuple(range(n) if axes is None else entries("axes", axes, cure))
    axes = tuple(names.index(i) if isinstance(i, str) and i in names else i for i in axes)
    if not all(isinstance(i, int | np.integer) for i in axes):
        fail("axes", f"{axes}", cure)
    axes = tuple(int(i) for i in axes)
    if not axes or len(set(axes)) != len(axes) or not all(0 <= i < n for i in axes):
        fail("axes", f"{axes}", f"Give different state indices from 0 to {n - 1}")
    others = tuple(i for i in range(n) if i not in axes)
    if fixed is not None and others:
        given, values = host_array("fixed", fixed), np.zeros(n)
        if given.shape not in ((n,), (len(others),)):
            which = ", ".join(mpc.labels[i] for i in others)
            cure = f"Give a value for each of {which}, ({len(others)},), or of all, ({n},)"
            fail("fixed", f"shape {given.shape}", cure)
        values[list(others)] = given if len(given) < n else given[list(others)]
        require_finite("fixed", values)
        return View(axes, others, values, None, None)
    constrained = others and 0 in mpc.state_stages
    sides = set_bounds(mpc.states if constrained else None, mpc.system.n)
    if n > mpc.system.n:  # a previous input is one that could be applied
        limits = set_bounds(at_stage(mpc.inputs, 0), mpc.system.m)
        sides = (np.append(sides[0], limits[0]), np.append(sides[1], limits[1]))
    lower, upper = sides
    return View(axes, others, None, lower[list(others)], upper[list(others)])


@named_pytree
class Sides(NamedTuple):
    """Bounds of the rows of the stages (N, r) and of the last state (r_N,), see `ExactData`."""

    lower: Any
    upper: Any
    lower_N: Any
    upper_N: Any


@pytree
class ExactData:
    """The hard constraints of an MPC problem as float64 arrays: exact data for proofs.

    x_{k+1} = A x_k + B u_k + c. lower_k ≤ H x_k + D u_k ≤ upper_k for k < N: H (r, n), D (r, m),
    lower and upper (N, r), ±inf at steps where a row does not hold. A, B, c, H and D have a leading
    axis of N where they differ from step to step. lower_N ≤ H_N x_N ≤ upper_N. widest: the same
    four bounds no narrower than they are exactly, for half-spaces, where the others are no wider,
    for plans: of a robust problem they are sums that are rounded; else they are the same arrays. P,
    level: terminal ellipsoid x'Px ≤ level, None without; back (n, rows) leads from multipliers of
    its rows L'x to v. u_lower, u_upper (N, m): a box around the inputs; move_lower, move_upper
    (moves, m): the part of it, at its widest, that limits on the states leave to each free move.
    left (N, n): 1 where errors of the costates p_k, k = 1..N, are passed to the step before (side
    and reach are 0 there), else 0, with |x_k| + side∘x_k ≤ reach on every feasible trajectory.
    side_0, reach_0 (d,): the same for every feasible θ, ∞ where nothing bounds it. equalities: how
    inputs keep equalities, None where there are none, or none that inputs can keep. moves: index of
    the free move that each input equals.
    """

    A: np.ndarray
    B: np.ndarray
    c: np.ndarray
    H: np.ndarray
    D: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    H_N: np.ndarray
    lower_N: np.ndarray
    upper_N: np.ndarray
    widest: "Sides"
    P: Any  # an array, or None
    level: Any
    back: Any
    u_lower: np.ndarray
    u_upper: np.ndarray
    move_lower: np.ndarray
    move_upper: np.ndarray
    left: np.ndarray
    side: np.ndarray
    reach: np.ndarray
    side_0: np.ndarray
    reach_0: np.ndarray
    equalities: "Equalities | None"
    view: View
    moves: tuple[int, ...] = static()

    @property
    def horizon(self) -> int:
        """Return the horizon N."""
        return len(self.moves)

    @property
    def sizes(self) -> tuple[int, int]:
        """Return the numbers of states and of inputs."""
        n, m = np.shape(self.B)[-2:]
        return n, m

    @property
    def stepwise(self) -> tuple[tuple[Any, int], ...]:
        """Return A, B, c, H and D, each with the number of axes that it has at one step."""
        return (self.A, 2), (self.B, 2), (self.c, 1), (self.H, 2), (self.D, 2)

    def at(self, k: int) -> list[Any]:
        """Return A, B, c, H and D at step k."""
        return [v[k] if np.ndim(v) > axes else v for v, axes in self.stepwise]


@pytree
class Equalities:
    """Rows with lower = upper which inputs can keep all at once, and how.

    at (N, r), at_N (r_N,): which of the rows of `ExactData`. inverse (N, m, q): changes of the
    inputs that change the values of these q rows, stage by stage, by given amounts, but for
    rounding. rows (q,): units of the rows. most (N, m): there is an exact change, of no more than
    most·max_i |r_i| / rows_i, for any amounts r.
    """

    at: np.ndarray
    at_N: np.ndarray
    inverse: np.ndarray
    rows: np.ndarray
    most: np.ndarray

    @classmethod
    def of(cls, p: "ExactData") -> "Equalities | None":
        """Return the equalities of a problem; None without any, and where they are not independent
        of each other to 1e-6, so that no bound is known.

        E is the matrix by which the moves v act on the rows, in floats, and |E − exactly| ≤ e. With
        X = E⁺ and η = ‖ |I − E X| + e|X| ‖ < 1 in the maximum norm, exactly E X is invertible, and
        X (E X)⁻¹ r is an exact change, no larger than |X| ‖r‖ / (1 − η).
        """
        if not (np.any(p.lower == p.upper) or np.any(p.lower_N == p.upper_N)):
            return None
        (n, m), N = p.sizes, p.horizon
        moves = np.equal.outer(np.array(p.moves), np.arange(max(p.moves) + 1)).astype(float)
        first = np.unique(p.moves, return_index=True)[1]
        free = np.ravel((p.u_lower < p.u_upper)[first])
        gain, off = np.zeros((n, free.size)), np.zeros((n, free.size))
        unit = 2.0**-52 * (n + m + 4)
        values, errors, at, at_N = [], [], p.lower == p.upper, p.lower_N == p.upper_N
        for k in range(N + 1):
            A, B, _, H, D = p.at(min(k, N - 1))
            H, D, found = (H, D, at[k]) if k < N else (p.H_N, np.zeros((len(at_N), m)), at_N)
            # u_k from all moves.
            u = np.kron(moves[k], np.eye(m)) if k < N else np.zeros((m, free.size))
            value = (H @ gain + D @ u) * free
            size = np.abs(H) @ (off + unit * np.abs(gain)) + unit * np.abs(D) @ u
            # A row that no input moves is kept by itself, or not at all.
            found &= np.any(value != 0, axis=1)
            values.append(value[found])
            errors.append(size[found] * free)
            if k < N:
                off = np.abs(A) @ (off + unit * np.abs(gain)) + unit * np.abs(B) @ u
                gain = A @ gain + B @ u
        E, e = np.concatenate(values), np.concatenate(errors)
        if not len(E):
            return None
        # In units of the inputs' limits, which must not decide what is independent.
        unit_u = np.ravel(power_of_two(largest_magnitude(p.u_lower, p.u_upper)))
        unit_u = unit_u.reshape(N, m)[first].ravel()
        rows = np.linalg.norm(E * unit_u, axis=1)
        E, e = E / rows[:, None], e / rows[:, None]
        X = unit_u[:, None] * np.linalg.pinv(E * unit_u, rcond=1e-10)
        e = e + (len(X) + 2) * 2.0**-52 * np.abs(E)
        eta = (np.abs(np.eye(len(E)) - E @ X) + e @ np.abs(X)).sum(axis=1).max()
        if not eta < 1e-6:
            return None
        most = (1 + 1e-5) * np.abs(X).sum(axis=1).reshape(-1, m)[list(p.moves)]
        inverse = (X / rows).reshape(-1, m, len(E))[list(p.moves)]
        return cls(at, at_N, inverse, rows, most)


def rounding_of_rows(p: ExactData, start: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what rounding can do, to first order and in units of it, to the rows of a roll-out
    from |x_0| ≤ start (n,): rows of the stages (N, r), of the last state (r_N,), and of L'x_N."""
    u = largest_magnitude(p.move_lower, p.move_upper)[list(p.moves)]
    u = np.where(np.isfinite(u), u, 0.0)
    x, error, stages = start, np.zeros_like(start), []
    for k in range(p.horizon):
        A, B, c, H, D = map(np.abs, p.at(k))
        stages.append(H @ (error + x) + D @ u[k])
        bound = A @ x + B @ u[k] + c
        error = A @ error + bound
        x = np.where(p.left[k] == 0, np.minimum(bound, p.reach[k]), bound)
    ball = np.zeros(0) if p.P is None else np.linalg.norm(np.linalg.pinv(p.back), axis=1)
    return np.array(stages), np.abs(p.H_N) @ (error + x), ball * np.linalg.norm(error + x)


def augmented_dynamics(mpc: MPC) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A, B, c of x⁺ = Ax + Bu + c, for (x, u_{−1}) where input rates are limited, each with
    a leading axis where it differs from step to step."""
    m = mpc.system.m
    A, B, c = host_matrices(mpc.system, by_step=True)
    if mpc.rate_limited:
        more = lambda v, axes: np.pad(v, [(0, 0)] * (v.ndim - axes) + [(0, m)] * axes)
        identity = np.broadcast_to(np.eye(m), (*B.shape[:-2], m, m))
        A, B, c = more(A, 2), np.concatenate([B, identity], axis=-2), more(c, 1)
    return A, B, c


def hard_blocks(mpc: MPC, *, widest: bool = False) -> list[Block]:
    """Return the blocks of hard rows as float64 NumPy arrays, those of rates as rows of (x, u_{−1})
    and u. Of a robust problem their bounds are no wider than exactly, or no narrower (`widest`).

    Raises ValueError for a policy that no sequence of inputs stands for, and where the disturbance
    leaves nothing between two bounds."""
    require_tightened(mpc, "a label by one sequence of inputs")
    with jax.enable_x64(True):
        found = [b for b in given_blocks(mpc, np.float64) if b.linear is None]
    if mpc.disturbance is not None:
        found = with_bounds(mpc, found, widest=widest)
        require_room(mpc, found)
    n, m, p = mpc.system.n, mpc.system.m, mpc.dimension
    hard = previous_inputs(mpc)
    for b in found:
        D = np.zeros((b.size, m)) if b.D is None else np.asarray(b.D, np.float64)
        of_states = np.zeros((b.size, n)) if b.H is None else np.asarray(b.H, np.float64)
        H = np.zeros((*of_states.shape[:-1], p))
        H[..., :n] = of_states
        if b.rate:
            H[..., n:] = -D
        lower, upper = np.asarray(b.lower, np.float64), np.asarray(b.upper, np.float64)
        if lower.ndim != upper.ndim:
            lower, upper = np.broadcast_arrays(lower, upper)
        hard.append(replace(b, H=H, D=D, lower=lower, upper=upper))
    return hard


def previous_inputs(mpc: MPC) -> list[Block]:
    """Return the block that asks u_{−1} in the limits of the inputs, where the state holds it: no
    other input can have been applied. None without limits."""
    if not mpc.rate_limited or mpc.inputs is None:
        return []
    n, m = mpc.system.n, mpc.system.m
    inputs = at_stage(mpc.inputs, 0)
    H, lower, upper = (np.asarray(v, np.float64) for v in inputs.rows())
    names = tuple(f"previous input row {i + 1}" for i in range(len(lower)))
    if isinstance(inputs, Box):
        names = tuple(f"previous {label}" for label in mpc.system.input_labels)
    H = np.hstack([np.zeros((len(H), n)), H])
    D = np.zeros((len(H), m))
    return [Block("previous input", H, D, (0,), False, lower, upper, names, ("",) * len(H))]


def absorbed(mpc: MPC, block: Block) -> bool:
    """Return whether a block is the input limits of a box, which the clip and the support function
    account for."""
    return block.kind == "input" and isinstance(mpc.inputs, Box)


def exact_data(
    mpc: MPC,
    view: View,
    blocks: list[Block],
    extent: np.ndarray,
    size: np.ndarray | None = None,
    widest: list[Block] | None = None,
) -> ExactData:
    """Collect the exact data of a problem without soft rows; blocks, widest (None: the same): its
    `hard_blocks`.

    extent (2, d): lower and upper bounds of every feasible θ, on which no label depends; (d,): of
    |θ|. size (d,): typical size of θ (None: that of extent), which selects how rounding errors are
    bounded, not whether they are.
    """
    n, m, N = mpc.system.n, mpc.system.m, mpc.horizon
    A, B, c = augmented_dynamics(mpc)
    each_step = [np.broadcast_to(v, (N, *v.shape[-axes:])) for v, axes in ((A, 2), (B, 2), (c, 1))]
    limits = limits_of_states(mpc)
    u_lower, u_upper = set_bounds(around(mpc.inputs), m)

    extent = np.asarray(extent) if np.ndim(extent) == 2 else np.array([-extent, extent])
    first = limits[0][:, list(view.axes)]
    side_0, reach_0 = one_sided(np.maximum(extent[0], first[0]), np.minimum(extent[1], first[1]))
    grown = start_sizes(view, reach_0 if size is None else size)
    u_size = largest_magnitude(u_lower, u_upper)
    left, sides, reach = np.zeros((3, N, mpc.dimension))
    for k, (A_k, B_k, c_k) in enumerate(zip(*each_step, strict=True)):
        with np.errstate(invalid="ignore"):  # 0·inf below counts as 0
            grown = np.nansum(np.abs(A_k) * grown, axis=1) + np.abs(c_k)
            grown = grown + np.nansum(np.abs(B_k) * u_size, axis=1)
        side, bound = one_sided(*limits[k + 1])
        far = (bound > grown) | np.isinf(bound)
        left[k], sides[k], reach[k] = far, np.where(far, 0.0, side), np.where(far, 0.0, bound)
        grown = np.minimum(grown, bound)
    sizes = np.array([largest_magnitude(*limit[:, :n]) for limit in limits])
    A_x, B_x, c_x = (v[:, :n] for v in each_step)
    implied = input_sizes(A_x[..., :n], B_x, c_x, sizes)
    same_move = [np.equal(mpc.moves, i) for i in range(max(mpc.moves) + 1)]
    implied = np.array([implied[same].min(axis=0) for same in same_move])
    widest = blocks if widest is None else widest
    H, D, lower, upper, H_N, lower_N, upper_N = staged_rows(mpc, blocks)
    _, _, *others = staged_rows(mpc, widest)
    rows = H, D, lower, upper, H_N, lower_N, upper_N, Sides(*others[:2], *others[3:])
    moves = list(mpc.moves)
    each = [part[moves] for part in move_limits(mpc, blocks, (u_lower, u_upper))]
    most = move_limits(mpc, widest, (u_lower, u_upper))
    inputs = *each, np.maximum(most[0], -implied), np.minimum(most[1], implied)
    errors = left, sides, reach, side_0, reach_0
    ball = terminal_ball(mpc)
    parts: tuple[Any, ...] = (A, B, c, *rows, *ball, *inputs, *errors, None, view, mpc.moves)
    data = ExactData(*parts)
    return replace(data, equalities=Equalities.of(data))


def move_limits(
    mpc: MPC, blocks: list[Block], box: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds (moves, m) of each free move: the box (m,) around the inputs, and where these
    are limited by a box what its rows leave at all steps of the move."""
    lower, upper = (np.tile(side, (max(mpc.moves) + 1, 1)) for side in box)
    for b in blocks:
        if absorbed(mpc, b) and np.ndim(b.lower) == 2:
            for k, low, high in zip(b.steps, b.lower, b.upper, strict=True):
                i = mpc.moves[k]
                lower[i], upper[i] = np.maximum(lower[i], low), np.minimum(upper[i], high)
    return lower, upper


def start_sizes(view: View, size: np.ndarray) -> np.ndarray:
    """Return the sizes (n,) of the entries of x_0 for points of this size (d,), 0 for infinite
    ones."""
    others, start = list(view.others), np.zeros(len(view.axes) + len(view.others))
    start[list(view.axes)] = size
    if view.projects:
        start[others] = one_sided(view.lower, view.upper)[1]
    elif others:
        start[others] = np.abs(view.fixed)[others]
    return np.where(np.isfinite(start), start, 0.0)


def staged_rows(mpc: MPC, blocks: list[Block]) -> list[np.ndarray]:
    """Return H, D, lower, upper of the rows of the stages and H_N, lower_N, upper_N of the last
    state, as in `ExactData`."""
    N, p = mpc.horizon, mpc.dimension
    rows = [b for b in blocks if not absorbed(mpc, b) and b.radius is None]
    staged = [b for b in rows if any(k < N for k in b.steps)]
    last = [b for b in rows if N in b.steps]
    lower = [b.at_steps(b.lower, N + 1, -np.inf) for b in staged]
    upper = [b.at_steps(b.upper, N + 1, np.inf) for b in staged]
    lower_N = [b.at_steps(b.lower, N + 1, -np.inf)[N] for b in last]
    upper_N = [b.at_steps(b.upper, N + 1, np.inf)[N] for b in last]
    none = np.zeros((0, p)), np.zeros((0, mpc.system.m)), np.zeros((N, 0)), np.zeros(0)
    return [
        stacked_steps([none[0], *(b.H for b in staged)], [(), *(b.steps for b in staged)], N),
        stacked_steps([none[1], *(b.D for b in staged)], [(), *(b.steps for b in staged)], N),
        np.concatenate([none[2], *(side[:N] for side in lower)], axis=1),
        np.concatenate([none[2], *(side[:N] for side in upper)], axis=1),
        np.concatenate([none[0], *(at_last(b.H, b.steps, N) for b in last)]),
        np.concatenate([none[3], *lower_N]),
        np.concatenate([none[3], *upper_N]),
    ]


def stacked_steps(parts: list[np.ndarray], steps: list[tuple[int, ...]], N: int) -> np.ndarray:
    """Return matrices below each other, (r, n), or (N, r, n) where one of them differs from step to
    step, which is zero at steps k < N where it does not hold."""
    if all(M.ndim == 2 for M in parts):
        return np.concatenate(parts)
    filled = []
    for M, at in zip(parts, steps, strict=True):
        every = np.zeros((N + 1, *M.shape[-2:]))
        every[list(at) if M.ndim == 3 else slice(None)] = M
        filled.append(every[:N])
    return np.concatenate(filled, axis=1)


def at_last(M: np.ndarray, steps: tuple[int, ...], N: int) -> np.ndarray:
    """Return a matrix at step N, which is one of the steps."""
    return M[steps.index(N)] if M.ndim == 3 else M


def terminal_ball(mpc: MPC) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None]:
    """Return P, level and back of `ExactData`, None without a terminal ellipsoid."""
    if not isinstance(mpc.terminal_set, Ellipsoid):
        return None, None, None
    n, p = mpc.system.n, mpc.dimension
    P, back = np.zeros((p, p)), np.zeros((p, n))
    P[:n, :n] = np.asarray(mpc.terminal_set.P, np.float64)
    P = (P + P.T) / 2
    back[:n] = np.linalg.inv(np.linalg.cholesky(P[:n, :n])).T
    return P, np.asarray(mpc.terminal_set.level, np.float64), back


def limits_of_states(mpc: MPC) -> list[np.ndarray]:
    """Return bounds (2, p) of each x_k, k = 0..N, without those that the inputs have on it."""
    n, N = mpc.system.n, mpc.horizon
    states, last = set_bounds(mpc.states, n), set_bounds(mpc.terminal_set, n)
    found = []
    for k in range(N + 1):
        bound = np.repeat([[-np.inf], [np.inf]], mpc.dimension, axis=1)
        for lower, upper in [states] * (k in mpc.state_stages) + [last] * (k == N):
            bound[:, :n] = np.maximum(bound[0, :n], lower), np.minimum(bound[1, :n], upper)
        found.append(bound)
    if mpc.dimension > n:
        found[0][:, n:] = set_bounds(at_stage(mpc.inputs, 0), mpc.system.m)
    return found


def around(limits: Any) -> Any:
    """Return a box around limits at all of their stages; the same where they are those of all."""
    if not differing(limits):
        return limits
    stages = max(len(np.asarray(getattr(limits, name))) for name in differing(limits))
    n = limits.dimension
    ends = np.array([set_bounds(at_stage(limits, j), n) for j in range(stages)])
    return Box(ends[:, 0].min(axis=0), ends[:, 1].max(axis=0))


def input_sizes(A: np.ndarray, B: np.ndarray, c: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Return bounds (N, m) of |u_k| from those of |x_k|, states (N+1, n), by u_k = B⁺(x_{k+1} − A
    x_k − c); A, B and c have a leading axis of N.

    ∞ where there is none, and where B has dependent columns.
    """
    M, (n, m) = np.linalg.pinv(B), B.shape[1:]
    off = np.abs(M @ B - np.eye(m)) + n * 1e-15 * np.abs(M) @ np.abs(B)
    with np.errstate(invalid="ignore"):  # 0·inf below counts as 0
        terms = states[1:] + np.nansum(np.abs(A) * states[:-1, None], axis=2) + np.abs(c)
        bound = np.nansum(np.abs(M) * terms[:, None], axis=2)
    # B⁺B is the unit matrix to 1e-8, and sums are rounded.
    bound = bound + 1e-6 * bound.max(axis=1, keepdims=True)
    return np.where(off.max(axis=(1, 2))[:, None] > 1e-8, np.inf, bound)


def one_sided(lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (s, r) with the least r for which |x| + s x ≤ r on lower ≤ x ≤ upper, s in {0, 1,
    −1}."""
    ways = np.array(
        [largest_magnitude(lower, upper), 2 * np.maximum(upper, 0), 2 * np.maximum(-lower, 0)]
    )
    best = np.argmin(ways, axis=0)
    return np.array([0.0, 1.0, -1.0])[best], ways.min(axis=0)


def largest_magnitude(lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the largest |x| on lower ≤ x ≤ upper."""
    return np.maximum(np.abs(lower), np.abs(upper))
