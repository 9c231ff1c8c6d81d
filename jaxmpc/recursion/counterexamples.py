"""Counterexamples to the MPC law: a state with a plan whose next state has none, both proved.

Candidates come from closed loops of sampled states, and from an ascent over the regions of the law:
it is piecewise affine in the state, so that a convex function of the next state can be raised by
its gradient, and on a region be maximised exactly by a linear program.
"""

import time
from dataclasses import replace

import numpy as np
from tqdm.std import tqdm

from jaxmpc.explicit.law_at_states import Law
from jaxmpc.feasible.map import FeasibleSetMap, map_points
from jaxmpc.feasible.pipeline import Labels
from jaxmpc.feasible.plan_polytope import CenteredPolytope
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.proofs import first_of_block
from jaxmpc.feasible.rays import BACKOFFS, Rays, ray_directions
from jaxmpc.pytrees import record
from jaxmpc.qp.status import Status
from jaxmpc.recursion.proofs import CLEAR, Claims, in_words
from jaxmpc.recursion.time_budget import Budget
from jaxmpc.sets.lp import maximise

# States near the boundary of X_N from which samples and searches start.
STARTS = 96
# `lost_at` of states that are infeasible from the start, and of those that were not decided.
NOT_FEASIBLE, UNDECIDED = -1, -2
# Gradient ascent: distance kept from the half-spaces (on the boundary only one plan is feasible,
# and solvers converge slowly), and step lengths; relative to the size of the set.
INSET_OF_ASCENT = 1e-6
LENGTHS = 0.3 * 0.5 ** np.arange(16)
# Then the search goes from region to region: with how many states at once, in how many rounds, from
# how many neighbours at what distance.
FOLLOWED, ROUNDS, NEIGHBOURS, NEAR = 6, 10, 4, 1e-4


@record
class Counterexample:
    """A feasible state whose optimal first input leads to an infeasible one.

    state x (p,): feasible by proof. Where input rates are limited, states are (x, u_{−1}).
    feasible_inputs (N, m): these keep all rows from there in a float64 roll-out, with margins above
    rounding. inputs (N, m): the optimal plan, to the given residuals.
    next_state (p,): A x + B u_0 + c. normal (p,), offset: the half-space normal'x ≤ offset holds on
    the whole feasible set, by proof. distance: (normal'x⁺ − offset)/|normal|, by which that
    excludes the next state. found: "search", "sample" or "regions".
    """

    state: np.ndarray
    inputs: np.ndarray
    next_state: np.ndarray
    normal: np.ndarray
    offset: float
    distance: float
    feasible_inputs: np.ndarray
    primal_residual: float
    dual_residual: float
    found: str

    def __str__(self) -> str:
        return (
            f"from x = {in_words(self.state)} the optimal u = {in_words(self.inputs[0])} leads to "
            f"{in_words(self.next_state)}, outside the feasible set by {self.distance:.6g}"
        )


def outer_bound(claims: Claims) -> tuple[CenteredPolytope | None, np.ndarray]:
    """Return half-spaces of X_N and starts (S, p) near its boundary; None and no starts if there
    are none."""
    body, p = claims.feasible_set, claims.problem.dimension
    random = np.random.default_rng(0)
    if body is not None and len(body.vertices):
        # Vertices, middles of facets, and random points of facets: convex combinations.
        parts = [body.vertices]
        tight = body.offsets - body.vertices @ body.normals.T <= 1e-7 * body.depths
        corners = [body.vertices[column] for column in tight.T]
        parts += [part.mean(axis=0, keepdims=True) for part in corners]
        while sum(map(len, parts)) < STARTS:
            parts += [random.dirichlet(np.ones(len(part)), 1) @ part for part in corners]
        return body, np.concatenate(parts)
    try:
        directions = np.concatenate([ray_directions(STARTS, p), np.eye(p), -np.eye(p)])
        rays = Rays.of(claims.problem).cast(directions)
    except ValueError:  # empty or flat
        return None, np.zeros((0, p))
    valid = np.isfinite(rays.offsets) & np.any(rays.normals != 0, axis=1)
    found = np.all(np.isfinite(rays.points), axis=1)
    if body is not None and found.any():
        return replace(body, center=rays.center), rays.points[found]
    if not valid.any() or not found.any():
        return None, np.zeros((0, p))
    length = np.linalg.norm(rays.normals[valid], axis=1)
    half = np.column_stack([rays.normals[valid] / length[:, None], rays.offsets[valid] / length])
    # The same where they agree to 9 digits, in units of like size.
    like = half / (half[:, p:] - half[:, :p] @ rays.center[:, None])
    most = np.abs(like).max(axis=0)
    like = like / np.where(most > 0, most, 1.0)
    half = half[np.unique(np.round(like, 9), axis=0, return_index=True)[1]]
    none = np.zeros((0, p))
    return CenteredPolytope(rays.center, half[:, :p], half[:, p], none), rays.points[found]


def farthest_first(bound: CenteredPolytope, after: np.ndarray) -> np.ndarray:
    """Return the indices of next states, the farthest outside first, NaN last."""
    return np.argsort(-np.nan_to_num(bound.beyond(after), nan=-np.inf))


# --- Closed loops from samples ----------------------------------------------------------


@record
class SampledLoops:
    """Closed loops of `steps` steps from B states x0s (B, p); B = 0 where there are none.

    labels: the labels of x0s with their proofs. inputs (B, m), next_states (B, p): the optimal
    first input and where it leads (NaN where label ≠ 1). lost_at (B,): first step k ≥ 1 of the
    closed loop at which the problem is proved infeasible; 0: feasible at all steps; −1: not proved
    feasible at the start; −2: undecided, from step undecided_at (B,) on (0 elsewhere).
    late_at: the step before which the time was over, None: it was not.
    """

    x0s: np.ndarray
    labels: Labels
    inputs: np.ndarray
    next_states: np.ndarray
    lost_at: np.ndarray
    undecided_at: np.ndarray
    steps: int
    late_at: int | None = None

    @classmethod
    def undecided(cls, problem: FeasibilityProblem, x0s: np.ndarray, steps: int) -> "SampledLoops":
        """Return loops from states (B, p) that there was no time to label."""
        return cls._begun(problem, x0s, Labels.empty(len(x0s), problem), steps)

    @classmethod
    def _begun(
        cls, problem: FeasibilityProblem, x0s: np.ndarray, labels: Labels, steps: int
    ) -> "SampledLoops":
        """Return loops from labelled states before the first step."""
        return cls(
            x0s=x0s,
            labels=labels,
            inputs=np.full((len(x0s), problem.mpc.system.m), np.nan),
            next_states=np.full_like(x0s, np.nan),
            lost_at=np.where(labels.label == 1, 0, NOT_FEASIBLE),
            undecided_at=np.zeros(len(x0s), int),
            steps=steps,
        )

    @property
    def label(self) -> np.ndarray:
        """Return the labels (B,): 1 proved feasible, −1 proved infeasible, 0 undecided."""
        return self.labels.label

    def counts(self) -> dict[str, int]:
        """Return how many states are feasible, and how many of these are lost at once, lost later,
        kept, undecided."""
        lost = self.lost_at
        return {
            "feasible": int(np.sum(self.label == 1)),
            "lost after one step": int(np.sum(lost == 1)),
            "lost later": int(np.sum(lost > 1)),
            "kept": int(np.sum(lost == 0)),
            "undecided": int(np.sum(lost == UNDECIDED)),
        }

    def why_undecided(self) -> str:
        """Return why loops are undecided, "" where none is."""
        at = self.undecided_at[self.lost_at == UNDECIDED]
        late = int(np.sum(at == self.late_at))
        causes = []
        if late:
            causes.append(
                f"{late:,}: the time was over before step {self.late_at}; give more seconds"
            )
        if late < len(at):
            causes.append(f"{len(at) - late:,}: no plan was SOLVED, or the next state has no proof")
        return "; ".join(causes)


def labelled(law: Law, problem: FeasibilityProblem, states: np.ndarray) -> Labels:
    """Return the labels of states (B, p or more columns), in programs of the law's shape."""
    padded = law.filled(states[:, : problem.dimension])
    fmap: FeasibleSetMap = map_points(problem, padded, chunk=law.chunk)
    return fmap.labels.rows(slice(len(states)))


def closed_loops(
    law: Law,
    problem: FeasibilityProblem,
    x0s: np.ndarray,
    labels: Labels,
    steps: int,
    budget: Budget,
) -> SampledLoops:
    """Run the closed loop from every feasible state until it is lost, undecided or over.

    The states that are left when the time is over are undecided.
    """
    loops, p = SampledLoops._begun(problem, x0s, labels, steps), x0s.shape[1]
    lost_at, undecided_at = loops.lost_at, loops.undecided_at
    feasible = labels.label == 1
    center = x0s[feasible].mean(axis=0) if np.any(feasible) else np.zeros(p)
    # The previous input travels along where the plan depends on it.
    states = np.pad(x0s, ((0, 0), (0, law.mpc.dimension - p)))
    for k in tqdm(range(1, steps + 1), unit=" steps", leave=False, disable=not budget.bar):
        alive = np.flatnonzero(lost_at == 0)
        if not len(alive):
            break
        if not budget.affords(0):
            lost_at[alive], undecided_at[alive] = UNDECIDED, k
            return replace(loops, late_at=k)
        plans = law.plans(states[alive])
        u = law.limited(plans.inputs[:, 0])
        x = law.following(states[alive], u)
        if k == 1:
            loops.inputs[alive], loops.next_states[alive] = u, x[:, :p]
        x[:, :p] = center + (1 - CLEAR) * (x[:, :p] - center)
        label = labelled(law, problem, x).label
        solved = plans.status == Status.SOLVED
        undecided = alive[~solved | (label == 0)]
        lost_at[alive[solved & (label == -1)]] = k
        lost_at[undecided], undecided_at[undecided] = UNDECIDED, k
        states[alive] = x
    return loops


def worst_samples(bound: CenteredPolytope, loops: SampledLoops) -> np.ndarray:
    """Return up to three of the samples (B, p) lost after one step, farthest outside."""
    lost = np.flatnonzero(loops.lost_at == 1)
    return loops.x0s[lost[farthest_first(bound, loops.next_states[lost])[:3]]]


# --- Search by gradients and from region to region --------------------------------------


def ascend(law: Law, bound: CenteredPolytope, starts: np.ndarray, deadline: float) -> np.ndarray:
    """Return states (K, p) from which the next state lies farthest outside `bound`, the best first.

    starts (S, p) follow the gradient (A + B ∂u_0/∂x)'a_j of v(x) = max_j (a_j'x⁺(x) − b_j) within
    the half-spaces, in steps of halving length, in coordinates in which the set is about 1 wide;
    a_j and b_j count relative to the facet's distance from the centre. A step is taken if it raises
    v. Then the best go from region to region, each to the maximum of a_j'x⁺ on its region. The
    method is local: that it finds no counterexample does not prove that there is none.
    """
    x = bound.nearest(starts, INSET_OF_ASCENT)
    value, gradient = _value_and_gradient(law, bound, x, deadline)
    for length in LENGTHS:
        if time.monotonic() > deadline:
            break
        trial = bound.nearest(x + length * bound.unit * gradient, INSET_OF_ASCENT)
        better, slope = _value_and_gradient(law, bound, trial, deadline, than=value)
        grown = better > value
        x[grown], value[grown], gradient[grown] = trial[grown], better[grown], slope[grown]
    return _climb_regions(law, bound, x, value, deadline)


def _value_and_gradient(
    law: Law,
    bound: CenteredPolytope,
    x: np.ndarray,
    deadline: float,
    than: np.ndarray | float = -np.inf,
) -> tuple[np.ndarray, np.ndarray]:
    """Return v (S,) at x (S, p), −inf where there is no plan, and its unit gradient in coordinates
    x / bound.unit where v > than, and before the deadline."""
    plans = law.plans(x)
    after = law.following(x, plans.inputs[:, 0])
    beyond = (after @ bound.normals.T - bound.offsets) / bound.depths
    value = np.where(plans.status == Status.SOLVED, beyond.max(axis=1), -np.inf)
    gradient = np.zeros_like(x)
    for i in np.flatnonzero((value > than) & np.isfinite(value)):
        if time.monotonic() > deadline:
            break
        piece = law.piece(x[i], plans.inputs[i])
        if piece is not None:
            slope = bound.unit * (piece.E.T @ bound.normals[np.argmax(beyond[i])])
            gradient[i] = slope / (np.linalg.norm(slope) or 1.0)
    return value, gradient


def _climb_regions(
    law: Law, bound: CenteredPolytope, x: np.ndarray, value: np.ndarray, deadline: float
) -> np.ndarray:
    """Follow the best of x (S, p) to the best vertex of its region, and on from beside it; return
    states (K, p)."""
    random = np.random.default_rng(0)
    order = np.argsort(-value)[:FOLLOWED]
    best, top = x[order], value[order]
    for tried in range(ROUNDS):
        if time.monotonic() > deadline:
            break
        beside = random.standard_normal((NEIGHBOURS, *best.shape)) * NEAR * bound.unit
        around = bound.nearest(np.concatenate([best, *(best + beside)]), INSET_OF_ASCENT)
        peaks, heights = _peaks(law, bound, around, deadline)
        states, values = np.concatenate([best, peaks]), np.append(top, heights)
        chosen: list[int] = []
        for i in np.argsort(-values):
            if all(np.any(np.abs(states[i] - states[j]) > 1e-6 * bound.unit) for j in chosen):
                chosen.append(int(i))
        before, chosen = top.max(initial=-np.inf), chosen[:FOLLOWED]
        best, top = states[chosen], values[chosen]
        if tried > 1 and top.max(initial=-np.inf) <= before + 1e-12:
            break
    return best


def _peaks(
    law: Law, bound: CenteredPolytope, around: np.ndarray, deadline: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the best states (K, p) of the regions of some states (B, p), and how far outside the
    bound their next states lie (K,)."""
    plans = law.plans(around)
    peaks, values = [np.zeros((0, around.shape[1]))], []
    for i in np.flatnonzero(plans.status == Status.SOLVED):
        if time.monotonic() > deadline:
            break
        state, piece = around[i], law.piece(around[i], plans.inputs[i])
        if piece is None:
            continue
        off = bound.normals @ (piece.E @ state + piece.e) - bound.offsets
        facet = int(np.argmax(off / bound.depths))
        up = piece.E.T @ bound.normals[facet]
        R = np.vstack([piece.R, bound.normals])
        peak = maximise(up, R, np.append(piece.r, bound.offsets)).x
        if peak is not None:
            peaks.append(peak[None])
            values.append(float(bound.beyond((piece.E @ peak + piece.e)[None])[0]))
    return np.concatenate(peaks), np.array(values)


# --- Proof of the best candidate --------------------------------------------------------


def certified(
    law: Law,
    problem: FeasibilityProblem,
    bound: CenteredPolytope | None,
    candidates: np.ndarray,
    found: list[str],
) -> Counterexample | None:
    """Return the candidate (K, p) whose next state is farthest outside, with both ends proved; or
    None.

    Each candidate is moved towards the centre by the least amount that lets a plan be proved.
    """
    if bound is None or not len(candidates):
        return None
    rays = Rays.of(problem, bound.center)
    states, feasible, proved = _proved_plans(rays, candidates)
    plans = law.plans(states)
    inputs = plans.inputs.copy()
    inputs[:, 0] = law.limited(inputs[:, 0])
    after = law.following(states, inputs[:, 0])
    good = proved & (plans.status == Status.SOLVED)
    outside = np.where(good, bound.beyond(after), -np.inf)
    for best in np.argsort(-outside)[: len(candidates)]:
        if not outside[best] > CLEAR:
            break
        normal, offset = _deepest(rays, bound, after[best])
        distance = float((normal @ after[best] - offset) / np.linalg.norm(normal))
        if normal @ after[best] - offset > CLEAR * (offset - normal @ bound.center):
            return Counterexample(
                state=states[best],
                inputs=inputs[best],
                next_state=after[best],
                normal=normal,
                offset=offset,
                distance=distance,
                feasible_inputs=feasible[best],
                primal_residual=float(plans.primal_residual[best]),
                dual_residual=float(plans.dual_residual[best]),
                found=found[best // len(BACKOFFS)],
            )
    return None


def _proved_plans(rays: Rays, candidates: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return states (K·S, p) that lead from each candidate (K, p) towards the centre by S small
    steps, inputs (K·S, N, m), and whether they are proved to keep all rows from there.

    State and plan lie between those of the centre and those of where the ray through the candidate
    leaves X_N, or the candidate's own where it never does.
    """
    states, plans, multipliers = [], [], []
    for direction in candidates - rays.center:
        t, w, y = rays.problem.programs.ray(rays.center, direction)
        if not np.isfinite(t):
            try:
                t, w = 1.0, rays.problem.programs.center(rays.center + direction)[1]
            except ValueError:  # no margin there
                t, w = 0.0, rays.w
        reach = (min(t, 1.0) * (1 - BACKOFFS))[:, None]
        states.append(rays.center + reach * direction)
        plans.append(rays.w + reach / max(t, 1e-300) * (w - rays.w))
        multipliers.append(y)
    theta, w = np.array(states), np.array(plans)
    proved = rays.prove(theta, w, np.array(multipliers)).feasible.ravel()
    theta, rows, exact = np.concatenate(states), rays.problem.rows, rays.exact
    inputs = np.einsum("kmz,bz->bkm", rows.Omega, np.concatenate(plans) @ rows.back.T)
    inputs += np.einsum("kmp,bp->bkm", rows.Psi, theta) + rows.psi
    # As the proof takes them.
    inputs = np.clip(inputs, exact.u_lower, exact.u_upper)[:, first_of_block(exact.moves)]
    return theta, inputs, proved


def _deepest(rays: Rays, bound: CenteredPolytope, x: np.ndarray) -> tuple[np.ndarray, float]:
    """Return, of the half-spaces proved by rays that end on the side of x, the one that x violates
    most."""
    facet = int(np.argmax((bound.normals @ x - bound.offsets) / bound.depths))
    depth = bound.normals[facet] @ x - bound.offsets[facet]
    across = bound.normals[facet] * bound.unit**2  # perpendicular in units of like size
    towards = x - depth / (bound.normals[facet] @ across) * across
    cast = rays.cast(np.array([x, bound.nearest(x[None])[0], towards]) - rays.center)
    with np.errstate(invalid="ignore", divide="ignore"):
        depths = (cast.normals @ x - cast.offsets) / (cast.offsets - cast.normals @ rays.center)
    best = int(np.argmax(np.nan_to_num(depths, nan=-np.inf)))
    return cast.normals[best], float(cast.offsets[best])
