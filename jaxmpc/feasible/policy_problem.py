"""The feasibility problem under affine policies: which states have one that keeps all rows?

The plant is x⁺ = A x + B u + c + E w. Disturbances are w = center + Γ ω with |ω_i| ≤ 1, the policy
is u_k = v_k + Σ_{j<k} M_kj ω_j (Goulart, Kerrigan & Maciejowski 2006, Automatica 42). With states
eliminated each row is F θ + G v + (D + G M) ω, and it holds for all disturbances if and only if

    F θ + G v + |D + G M|₁ ≤ upper,   F θ + G v − |D + G M|₁ ≥ lower,

convex in (θ, v, M) together. With T ≥ |D + G M|, entry by entry, these are linear rows over
(θ, v, M, T): a `PlanPolytope`, whose projection on θ is the feasible set of the class.

*Tubes*, as in `mpc/policy_rows.py`: the rows of the nominal trajectory z are tightened by the
section S = center + {G ζ : |ζ_i| ≤ 1}, at all steps alike, and z_0 = θ − center − G ζ: linear
rows over (θ, v, ζ), which are one more case of the above, with ζ beside v and no M.

*Proofs* are evaluated on the rows in rational arithmetic (`ExactRows`), whatever found the numbers.
Feasible: the triple (θ, v, M). Infeasible: for multipliers y⁺, y⁻ ≥ 0 of the two sides of the rows
and any Q with |Q| ≤ y⁺ + y⁻, row by row, every feasible triple keeps

    (y⁺ − y⁻)'(F θ + G v) + Σ Q∘(D + G M) ≤ y⁺'upper − y⁻'lower,

and what is left of v and M is at most what the limits of the inputs leave of them.
"""

import functools
import threading
from dataclasses import replace
from fractions import Fraction
from functools import cached_property
from typing import Any, NamedTuple, NoReturn

import numpy as np

from jaxmpc.arrays import Reals, fractions_of
from jaxmpc.checks import fail, require_kind
from jaxmpc.feasible.condensed_rows import moved_out
from jaxmpc.feasible.hard_constraints import Axes, augmented_dynamics, hard_blocks, make_view
from jaxmpc.feasible.plan_polytope import PlanPolytope
from jaxmpc.feasible.problem import FeasibilityProblem, as_box
from jaxmpc.feasible.proofs import Cut
from jaxmpc.mpc.policy_rows import (
    causal_entries,
    require_free_inputs,
    require_generators,
    tube_section,
)
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.tightening import feedback_gain, without_disturbance
from jaxmpc.pytrees import record
from jaxmpc.sets.convex_sets import Box
from jaxmpc.sets.disturbances import disturbance_columns
from jaxmpc.sets.generators import span
from jaxmpc.sets.lp import Program, power_of_two
from jaxmpc.systems.system import host_matrices

# Bits of the numbers whose sums are computed exactly, relative to the largest of an array.
BITS = 48

# Of feasible sets of a class of policies, and what helps.
NO_VOLUME = "is empty or flat: no initial state has a policy of this class with a margin"
MORE_ROOM = "Relax a limit, shrink the disturbance or enlarge the terminal set"


def problem_of(mpc: MPC, axes: Axes = None, fixed: Reals | None = None) -> FeasibilityProblem:
    """Return the feasibility problem of `mpc` for its policy; arguments as in
    `map_feasible_set`."""
    require_kind("mpc", mpc, MPC)
    if mpc.disturbance is None or mpc.policy == "tightened":
        return FeasibilityProblem.of(mpc, axes, fixed)
    return PolicyProblem.of(mpc, axes, fixed)


class PolicyRows(NamedTuple):
    """lower ≤ F θ + G v + (D + J M) ω ≤ upper in exact fractions (arrays of objects): F (R, d), G
    (R, V), J (R, N m), D (R, N g), lower and upper (R,), None where there is no bound. low, high
    (V,): bounds of each v. half (N m,): half the widths of the limits of each input. first: (m, V)
    and (m,), the first input from v. G is J but where a control horizon holds v. Of a tube v is
    (v, ζ), and there is neither ω nor J."""

    F: np.ndarray
    G: np.ndarray
    J: np.ndarray
    D: np.ndarray
    lower: list[Fraction | None]
    upper: list[Fraction | None]
    low: np.ndarray
    high: np.ndarray
    half: np.ndarray
    first: tuple[np.ndarray, np.ndarray]


@record
class PolicyProblem(FeasibilityProblem):
    """A `FeasibilityProblem` under affine policies. What rests on one sequence of inputs, it
    refuses."""

    @classmethod
    def of(cls, mpc: MPC, axes: Axes = None, fixed: Reals | None = None) -> "PolicyProblem":
        """Return the feasibility problem of `mpc`; axes, fixed: a slice, as in `map_feasible_set`.

        Raises ValueError for an ill-posed problem, for a projection, and for what affine policies
        are not computed with: control horizons of tubes, inputs without a bounded box.
        """
        require_kind("mpc", mpc, MPC)
        mpc.validate()
        boxes = {name: as_box(getattr(mpc, name)) for name in ("states", "inputs", "terminal_set")}
        hard = replace(mpc, soft=(), input_rate_weight=None, **boxes)
        require_free_inputs(hard)
        inputs = hard.inputs
        if not isinstance(inputs, Box) or not np.isfinite(inputs.bounds()).all():
            fail("inputs", "are in no bounded Box, which proofs of this policy need", "Give one")
        view = make_view(hard, axes, fixed)
        if view.projects:
            fail("axes", "give a projection, which this policy does not know", "Give fixed too")
        if hard.policy == "affine":
            directions(hard)
        elif hard.rate_limited:
            require_generators(hard.disturbance)
        return cls(hard, view)

    @cached_property
    def fractions(self) -> PolicyRows:
        """Return the rows without any rounding."""
        tube = self.mpc.policy == "tube"
        return (tube_fractions if tube else affine_fractions)(self.mpc, self.view)

    @cached_property
    def exact_rows(self) -> "ExactRows":
        """Return them as integers."""
        return ExactRows(self.fractions)

    @cached_property
    def causal(self) -> np.ndarray:
        """Return which entries (N m, N g) of M answer to earlier disturbances; none of a tube."""
        N, m = self.mpc.horizon, self.mpc.system.m
        if self.mpc.policy == "tube":
            return np.zeros((0, 0), bool)
        return causal_entries(N, m, directions(self.mpc)[1].shape[1])

    @cached_property
    def lifted(self) -> "Lifted":
        """Return the linear rows over (θ, v, M, T)."""
        return Lifted.of(self.fractions, self.causal)

    @cached_property
    def plan_polytope(self) -> PlanPolytope:
        """Return the polytope of all states and affine policies, all states for any view."""
        whole = replace(self, view=make_view(self.mpc)) if self.view.others else self
        lifted, n = whole.lifted, self.mpc.dimension
        A, B, c = augmented_dynamics(self.mpc)
        gain, shift = whole.fractions.first
        M = np.zeros((n, lifted.rows.shape[1]))
        M[:, :n], M[:, n : n + gain.shape[1]] = A, B @ gain
        c = c + B @ shift
        size = np.linalg.norm(lifted.rows, axis=1)
        return PlanPolytope(lifted.rows / size[:, None], lifted.bounds / size, M, c, True)

    @cached_property
    def programs(self) -> Any:
        """Return the linear programs over `lifted`."""
        return PolicyPrograms(self.lifted, self.dimension)

    @cached_property
    def answer_shape(self) -> tuple[int, ...]:
        """Return the shape of what a policy has beside its plan v: (N, m, N, g) of the M of ω, (g,)
        of the ζ of a tube."""
        N, m = self.mpc.horizon, self.mpc.system.m
        if self.mpc.policy == "tube":
            return (self.plan_size - N * m,)
        return N, m, N, self.causal.shape[1] // N

    @property
    def plan_size(self) -> int:
        """Return the number of v, with the ζ of a tube."""
        return self.fractions.G.shape[1]

    def inputs(self, v: np.ndarray) -> np.ndarray:
        """Return the inputs (…, N, m) that v (…, V) stands for."""
        m, moves = self.mpc.system.m, np.array(self.mpc.moves)
        free = v[..., : (moves.max() + 1) * m]
        return free.reshape(*v.shape[:-1], -1, m)[..., moves, :]

    def _refuse(self) -> NoReturn:
        cure = 'Give policy="tightened"; maps, sweeps, boundary and feasible_polytope take it'
        fail("policy", f"{self.mpc.policy!r} has no proofs by one sequence of inputs", cure)

    @property
    def condensed(self) -> Any:
        """Refuse: see `_refuse`."""
        self._refuse()

    rows = weighted_rows = blocks = widest_blocks = condensed

    def exact(self, region: np.ndarray, size: np.ndarray | None = None) -> Any:
        """Refuse: proofs are those of `exact_rows`."""
        self._refuse()


def directions(mpc: MPC) -> tuple[np.ndarray, np.ndarray]:
    """Return `generators` of the disturbances, which are independent. Raises ValueError for sets
    without such a form."""
    require_generators(mpc.disturbance)
    center, gamma = generators(mpc.disturbance)
    if gamma.size and span(np.asarray(gamma, float))[1].shape[1] < gamma.shape[1]:
        what = "has generators that depend on each other, to which no policy can answer one by one"
        fail("disturbance", what, 'Give a Box or independent generators, or policy="tightened"')
    return center, gamma


def generators(W: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return center (p,) and Γ (p, g) of w = center + Γ ω, |ω_i| ≤ 1, in fractions, of a Box or a
    Zonotope."""
    if isinstance(W, Box):
        lower, upper = fractions_of(W.lower), fractions_of(W.upper)
        half = (upper - lower) / 2
        return (lower + upper) / 2, np.diag(half)[:, half > 0]
    return fractions_of(W.center), fractions_of(W.generators)


def affine_fractions(mpc: MPC, view: Any) -> PolicyRows:
    """Return the rows under affine policies, over θ, v and ω, all products of the data exact."""
    n, m, moves = mpc.system.n, mpc.system.m, mpc.moves
    center, gamma = directions(mpc)
    E = fractions_of(disturbance_columns(mpc.disturbance_matrix, n))
    p = condensed_fractions(mpc, view, E @ center, E @ gamma)
    if mpc.control_horizon is None:
        return p
    places = np.kron(np.eye(max(moves) + 1, dtype=int)[list(moves)], np.eye(m, dtype=int))
    begins = np.argmax(places, axis=0)
    first = p.first[0][:, begins], p.first[1]
    return p._replace(G=p.G @ places, low=p.low[begins], high=p.high[begins], first=first)


def tube_fractions(mpc: MPC, view: Any) -> PolicyRows:
    """Return the rows of a tube, over θ and (v, ζ), all products of the data exact.

    With u_{−1} − K (x_0 − z_0) for the previous input of the nominal trajectory its first rate is
    that of the input that is applied."""
    n, m, N = mpc.system.n, mpc.system.m, mpc.horizon
    gain, section = np.asarray(feedback_gain(mpc), float), tube_section(mpc)
    center, sides = fractions_of(section.center), fractions_of(section.generators)
    count, K = sides.shape[1], fractions_of(gain)
    nominal = condensed_fractions(mpc, view, 0 * center, zeros(n, 0))
    # z_0 = θ − center − G ζ: what an initial state adds to each row, without the view.
    whole = condensed_fractions(mpc, make_view(mpc), 0 * center, zeros(n, 0)).F
    found = [(b, k) for b in hard_blocks(without_disturbance(mpc)) for k in b.steps]
    held = np.repeat([b.kind == "previous input" for b, _ in found], [b.size for b, _ in found])
    whole = np.where(held[:, None], np.array(Fraction(0), object), whole)  # u_{−1} is limited
    if mpc.rate_limited:
        whole = whole[:, :n] + whole[:, n:] @ K
    G = np.hstack([nominal.G, -(whole @ sides)])
    shift = whole @ center
    lower: list[Fraction | None] = []
    upper: list[Fraction | None] = []
    taken = [pair for b, k in found for pair in _taken_of_tube(mpc, b, k, K, center, sides)]
    for (down, up), low, high, moved in zip(
        taken, nominal.lower, nominal.upper, shift, strict=True
    ):
        lower.append(None if low is None else low + moved + down)
        upper.append(None if high is None else high + moved - up)
    one = [Fraction(1)] * count
    ones = np.array(one, object)
    limits = np.hstack([zeros(count, N * m), np.diag(ones)]) if count else G[:0]
    first = np.hstack([nominal.first[0], gain @ np.asarray(section.generators, float)])
    return PolicyRows(
        F=np.vstack([nominal.F, zeros(count, nominal.F.shape[1])]),
        G=np.vstack([G, limits + zeros(count, G.shape[1])]),
        J=zeros(len(G) + count, 0),
        D=zeros(len(G) + count, 0),
        lower=[*lower, *(-v for v in one)],
        upper=[*upper, *one],
        low=np.append(nominal.low, -ones),
        high=np.append(nominal.high, ones),
        half=zeros(0),
        first=(first, gain @ np.asarray(section.center, float)),
    )


def _taken_of_tube(
    mpc: MPC, b: Any, k: int, K: np.ndarray, center: np.ndarray, G: np.ndarray
) -> list[tuple[Fraction, Fraction]]:
    """Return what a tube takes from the lower and the upper bound of each row of a block at k."""
    n, N = mpc.system.n, mpc.horizon
    if b.kind == "previous input" or (b.rate and k == 0):
        return [(Fraction(0), Fraction(0))] * b.size
    along = fractions_of(b.H)[:, :n] + (fractions_of(b.D) @ K if k < N else 0)
    middle, half = zeros(b.size), zeros(b.size)
    if b.rate:
        A, B, _ = map(fractions_of, host_matrices(mpc.system))
        mid, gamma = generators(mpc.disturbance)
        push = along @ fractions_of(disturbance_columns(mpc.disturbance_matrix, n))
        middle, half = push @ mid, abs(push @ gamma).sum(axis=1)
        along = along @ (A + B @ K) - along
    middle = middle + along @ center
    half = half + abs(along @ G).sum(axis=1)
    return [(h - c, h + c) for c, h in zip(middle, half, strict=True)]


def zeros(*shape: int) -> np.ndarray:
    """Return an array of zero Fractions."""
    return np.full(shape, Fraction(0), object)


def condensed_fractions(mpc: MPC, view: Any, drift: np.ndarray, push: np.ndarray) -> PolicyRows:
    """Return the rows of x⁺ = A x + B u + c + drift + push ω without any rounding, their bounds as
    given; x stands for (x, u_{−1}) where rates are limited."""
    N, m, g = mpc.horizon, mpc.system.m, push.shape[1]
    n = mpc.dimension
    A, B, c = map(fractions_of, augmented_dynamics(mpc))
    more = n - len(drift)
    c = c + np.append(drift, zeros(more))
    push = np.vstack([push, zeros(more, g)])
    S, base = zeros(n, len(view.axes)), zeros(n)
    for i, axis in enumerate(view.axes):
        S[axis, i] = Fraction(1)
    for axis in view.others:
        base[axis] = Fraction(float(view.fixed[axis]))
    states = [(S, zeros(n, N * m), zeros(n, N * g), base)]
    for k in range(N):
        F, G, D, f = states[-1]
        G, D = A @ G, A @ D
        G[:, k * m : (k + 1) * m] += B
        D[:, k * g : (k + 1) * g] += push
        states.append((A @ F, G, D, A @ f + c))
    F_rows, G_rows, D_rows = [], [], []
    lower: list[Fraction | None] = []
    upper: list[Fraction | None] = []
    for b in hard_blocks(without_disturbance(mpc)):
        H, D_u = fractions_of(b.H), fractions_of(b.D)
        for k in b.steps:
            F, G, D, f = (H @ part for part in states[k])
            if k < N:
                G = G + 0
                G[:, k * m : (k + 1) * m] += D_u
            for i in range(b.size):
                low, high = float(b.lower[i]), float(b.upper[i])
                F_rows.append(F[i])
                G_rows.append(G[i])
                D_rows.append(D[i])
                lower.append(Fraction(low) - f[i] if np.isfinite(low) else None)
                upper.append(Fraction(high) - f[i] if np.isfinite(high) else None)
    F, G, D = (np.array(v, object).reshape(len(lower), -1) for v in (F_rows, G_rows, D_rows))
    box: Any = mpc.inputs
    ends = [np.tile(fractions_of(end), N) for end in (box.lower, box.upper)]
    first = np.eye(m, N * m), np.zeros(m)
    D = D.reshape(len(lower), N * g)
    least, most = ends
    return PolicyRows(F, G, G, D, lower, upper, least, most, (most - least) / 2, first)


class Lifted(NamedTuple):
    """rows (r, d + v + M + T) x ≤ bounds (r,) over x = (θ, v, M, T). Where multipliers of them
    stand: above and below (R,), of the upper and lower bound of each row, −1 for none; entry
    (t, 2): the row and the entry of ω of each T, and of its two rows, plus and minus (t,)."""

    rows: np.ndarray
    bounds: np.ndarray
    above: np.ndarray
    below: np.ndarray
    entry: np.ndarray
    plus: np.ndarray
    minus: np.ndarray
    sizes: tuple[int, int, int]

    @classmethod
    def of(cls, p: PolicyRows, causal: np.ndarray) -> "Lifted":
        """Return the rows in floats."""
        F, G, J, D = (np.asarray(v, float) for v in (p.F, p.G, p.J, p.D))
        R, d, nv, places = len(F), F.shape[1], G.shape[1], np.argwhere(causal)
        at = np.full(causal.shape, -1)
        at[tuple(places.T)] = np.arange(len(places))
        # Entries of a row's answer to ω that are there, or that a policy can make.
        reached = (J != 0).astype(int) @ causal.astype(int) > 0
        entry = np.argwhere((D != 0) | reached)
        first = d + nv + len(places)
        total = first + len(entry)
        answers = np.zeros((len(entry), total))
        for t, (i, q) in enumerate(entry):
            a = np.flatnonzero((J[i] != 0) & causal[:, q])
            answers[t, d + nv + at[a, q]] = J[i, a]
        own = np.zeros((len(entry), total))
        own[:, first:] = np.eye(len(entry))
        ends = np.zeros((R, total))
        ends[entry[:, 0], first + np.arange(len(entry))] = 1.0
        value = np.zeros((R, total))
        value[:, :d], value[:, d : d + nv] = F, G
        has = [np.array([v is not None for v in side]) for side in (p.upper, p.lower)]
        sides = [np.array([0.0 if v is None else float(v) for v in s]) for s in (p.upper, p.lower)]
        shift = D[tuple(entry.T)]
        rows = [(value + ends)[has[0]], (ends - value)[has[1]], answers - own, -answers - own]
        bounds = [sides[0][has[0]], -sides[1][has[1]], -shift, shift]
        starts = np.cumsum([0, *(len(v) for v in bounds)])
        above, below = np.full(R, -1), np.full(R, -1)
        above[has[0]], below[has[1]] = (
            np.arange(s, e) for s, e in zip(starts[:2], starts[1:3], strict=True)
        )
        plus, minus = (np.arange(s, e) for s, e in zip(starts[2:4], starts[3:], strict=True))
        sizes = d, nv, len(places)
        return cls(np.vstack(rows), np.concatenate(bounds), above, below, entry, plus, minus, sizes)

    def policy(self, x: np.ndarray, causal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return v (V,) and M (N m, N g) of a point x."""
        d, nv, count = self.sizes
        M = np.zeros(causal.shape)
        M[causal] = x[d + nv : d + nv + count]
        return x[d : d + nv], M

    def multipliers(self, y: np.ndarray, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return y⁺, y⁻ (R,) and Q (R, width) of a program's multipliers (r,)."""
        y = np.append(np.maximum(y, 0.0), 0.0)
        Q = np.zeros((len(self.above), width))
        Q[tuple(self.entry.T)] = y[self.plus] - y[self.minus]
        return y[self.above], y[self.below], Q


class PolicyPrograms:
    """Linear programs over the lifted rows: rays, supports, the centre."""

    def __init__(self, lifted: Lifted, dimension: int) -> None:
        self.lifted, self.d = lifted, dimension
        self._ray: tuple[bytes, Program] | None = None
        self._alone = threading.Lock()

    @functools.cached_property
    def whole(self) -> Program:
        """Return the program over all of (θ, v, M, T)."""
        return Program(self.lifted.rows, self.lifted.bounds)

    def center(self, given: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return θ (the one given, or one well inside) and x of a policy there with margins.

        Raises ValueError where the set is empty or flat, or does not hold the given θ inside."""
        rows, bounds, d = self.lifted.rows, self.lifted.bounds, self.d
        if given is None:
            program = self.whole
        else:
            program = Program(rows[:, d:], bounds - rows[:, :d] @ given)
        x, t, _ = program.margin()
        if not t > 1e-9:
            if given is not None:
                fail("center", f"{given} is not inside the feasible set", "Give None or another")
            fail("mpc", f"its feasible set {NO_VOLUME}", MORE_ROOM)
        x = x if given is None else np.append(given, x)
        return x[:d], x

    def ray(
        self, center: np.ndarray, direction: np.ndarray
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """Return max t ≥ 0 with center + t·direction in the feasible set, x there, and the
        multipliers of the rows."""
        rows, d = self.lifted.rows, self.d
        length = np.abs(direction).max()
        last = rows[:, :d] @ (direction / length)
        with self._alone:
            if self._ray is None or self._ray[0] != center.tobytes():
                G = np.column_stack([rows[:, d:], last])
                G = np.vstack([G, -np.eye(G.shape[1])[-1]])
                self._ray = (
                    center.tobytes(),
                    Program(G, np.append(self.lifted.bounds - rows[:, :d] @ center, 0.0)),
                )
            program = self._ray[1]
            program.change_last_column(np.append(last, -1.0))
            found = program.maximise(np.eye(program.G.shape[1])[-1] / length)
        if found.x is None or found.y is None:
            return found.value, np.zeros(rows.shape[1]), np.zeros(len(rows))
        theta = center + found.value * direction
        return found.value, np.append(theta, found.x[:-1]), found.y[:-1]

    @functools.cached_property
    def bounding_box(self) -> tuple[np.ndarray | None, np.ndarray]:
        """Return bounds (2, d) of every feasible θ, None where the set is found empty, and the
        multipliers (2d, r) of the upper and then the lower sides; as
        `RowPrograms.bounding_box`."""
        d, ends, y = self.d, [], []
        for row in np.concatenate([np.eye(d), -np.eye(d)]):
            top = self.whole.maximise(np.append(row, np.zeros(self.lifted.rows.shape[1] - d)))
            ends.append(top.value)
            y.append(np.zeros(len(self.lifted.rows)) if top.y is None else top.y)
        return moved_out(ends), np.array(y)


class ExactRows:
    """The rows as integers over 2^e, for proofs without rounding."""

    def __init__(self, p: PolicyRows) -> None:
        bounds = [v for v in (*p.lower, *p.upper) if v is not None]
        every = [*p.F.ravel(), *p.G.ravel(), *p.J.ravel(), *p.D.ravel(), *bounds]
        self.e = max((v.denominator.bit_length() - 1 for v in every), default=0)
        whole = lambda v: np.asarray(np.frompyfunc(lambda f: int(f * 2**self.e), 1, 1)(v), object)
        self.F, self.G, self.J, self.D = whole(p.F), whole(p.G), whole(p.J), whole(p.D)
        self.lower = [None if v is None else int(v * 2**self.e) for v in p.lower]
        self.upper = [None if v is None else int(v * 2**self.e) for v in p.upper]
        self.v_lower, self.v_upper, self.half = p.low, p.high, p.half

    def proves(self, theta: np.ndarray, v: np.ndarray, M: np.ndarray) -> bool:
        """Return whether a triple of floats keeps all rows."""
        at, plan, answer = _integers(theta, v, M)
        top = max(at.e, plan.e, answer.e)  # all over 2^(e + top)
        value = (self.F @ at.values) * (1 << top - at.e)
        value = value + (self.G @ plan.values) * (1 << top - plan.e)
        moved = self.D * (1 << top) + (self.J @ answer.values) * (1 << top - answer.e)
        reach = np.abs(moved).sum(axis=1)
        for i, (low, high) in enumerate(zip(self.lower, self.upper, strict=True)):
            if high is not None and value[i] + reach[i] > high << top:
                return False
            if low is not None and value[i] - reach[i] < low << top:
                return False
        return True

    def cut(self, above: np.ndarray, below: np.ndarray, Q: np.ndarray, causal: np.ndarray) -> Cut:
        """Return the half-space a'θ ≤ b + w'|θ| that multipliers of the rows imply, valid for every
        feasible θ; b = ∞ where they imply none.

        above, below (R,) ≥ 0, Q (R, N g), whose entries count up to above + below."""
        above = np.where([v is None for v in self.upper], 0.0, above)
        below = np.where([v is None for v in self.lower], 0.0, below)
        largest = max(above.max(initial=0.0), below.max(initial=0.0))
        if not (np.isfinite(largest) and largest > 0 and np.all(np.isfinite(Q))):
            return Cut(np.zeros(self.F.shape[1]), np.array(np.inf), np.zeros(self.F.shape[1]))
        unit = 2.0 ** np.ceil(np.log2(largest))
        ints = lambda v: np.array(
            [int(x) for x in np.rint(v / unit * 2.0**BITS).ravel()], object
        ).reshape(v.shape)
        up, down = ints(above), ints(below)
        most = (up + down)[:, None]
        q = np.minimum(np.maximum(ints(Q), -most), most)
        y = up - down
        pairs = *zip(up, self.upper, strict=True), *zip(-down, self.lower, strict=True)
        total = sum(int(u) * h for u, h in pairs if h is not None)
        b = Fraction(int(total - (q * self.D).sum()))
        slope = y @ self.G  # of v, at least its least over the box
        for g, low, high in zip(slope, self.v_lower, self.v_upper, strict=True):
            b -= min(int(g) * low, int(g) * high)
        left = np.abs(self.J.T @ q) * causal
        # Σ |entries of a row of M| ≤ half the width of that input's limits.
        for worst, half in zip(left.max(axis=1, initial=0), self.half, strict=True):
            b += int(worst) * half
        a, scale = y @ self.F, Fraction(1, 2 ** (self.e + BITS))
        normal = np.array([float(Fraction(int(v)) * scale) for v in a])
        off = np.array(
            [
                float(abs(Fraction(int(v)) * scale - Fraction(x)))
                for v, x in zip(a, normal, strict=True)
            ]
        )
        exact = b * scale
        near = float(exact)
        if Fraction(near) < exact:
            near = float(np.nextafter(near, np.inf))
        if not (np.any(normal != 0) or near < 0):
            near = np.inf
        return Cut(normal, np.array(near), np.nextafter(off, np.inf) * (off > 0))


class _Whole(NamedTuple):
    """values / 2^e, integers."""

    values: np.ndarray
    e: int


def rounded(values: np.ndarray) -> np.ndarray:
    """Return values with `BITS` bits below the largest of them: few for exact sums."""
    unit = power_of_two(np.abs(values).max(initial=0.0)) * 2.0 ** (1 - BITS)
    return np.rint(values / unit) * unit


def _integers(*arrays: np.ndarray) -> list[_Whole]:
    """Return floats as integers over a power of two."""
    found = []
    for values in arrays:
        ratios = [float(v).as_integer_ratio() for v in np.ravel(values)]
        e = max((q.bit_length() - 1 for _, q in ratios), default=0)
        whole = [p << e - (q.bit_length() - 1) for p, q in ratios]
        found.append(_Whole(np.array(whole, object).reshape(np.shape(values)), e))
    return found
