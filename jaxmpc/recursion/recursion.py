"""Recursive feasibility: does a controller that has a plan now have one at the next sample?

Three claims about the feasible set X_N of an MPC problem, each weaker than the one before:

    strong  every first move of a feasible plan leads to a state in X_N,
    law     the optimal first move does,
    weak    some first move of a feasible plan does (X_N ⊆ X_{N+1}, where longer horizons can only
            make these sets smaller; else it asks for a little more).

A claim is proved by Theorem 1 of the lesson (an invariant terminal set), by linear programs over
all pairs of a state and a plan (`reach.py`), or by the critical regions of the law. It is refuted
by a counterexample: a state with a feasible plan, and a half-space that excludes the next state.
Counterexamples are looked for among samples and by gradient ascent (`law.py`).
"""

import time
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from jaxmpc.checks import fail
from jaxmpc.compiled import default_chunk
from jaxmpc.control.sets import Polytope
from jaxmpc.control.terminal import verify_terminal
from jaxmpc.explicit.law import Bound, Law, ascend
from jaxmpc.explicit.regions import critical_regions
from jaxmpc.feasible.map import FeasibleSetMap, grid, map_feasible_set
from jaxmpc.feasible.polytope import (
    DIMENSIONS,
    TOLERANCE,
    Pairs,
    Shadow,
    backward,
    pairs,
    shadow,
    usual,
)
from jaxmpc.feasible.proofs import bounding_box, hard_part
from jaxmpc.feasible.rays import boundary, spread
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.status import Status

# Distance from X_N, relative to its size, from which a state counts as outside: well above the
# residuals of plans. Next states are moved towards the centre by as much before they are judged.
CLEAR = 1e-7
STARTS = 96
# How far a counterexample is pulled towards the centre until its plan is proved.
PULLS = 10.0 ** np.arange(-8, -3)
# `lost_at` of samples that cannot be lost, and of those that were not decided.
NOT_FEASIBLE, UNDECIDED = -1, -2


@dataclass(frozen=True)
class Rung:
    """A claim: holds True (proved), False (refuted) or None (open); and why.

    state (p,): where it is refuted, the state of the counterexample; else None.
    """

    holds: bool | None
    reason: str
    state: np.ndarray | None = None

    def __str__(self) -> str:
        return f"{ {True: 'proved', False: 'refuted', None: 'open'}[self.holds] }: {self.reason}"


@dataclass(frozen=True)
class Counterexample:
    """A feasible state whose optimal first move leads to an infeasible one.

    state x (p,) is feasible by proof: `feasible_inputs` (N, m) keep all rows in a float64 roll-out
    with margins above rounding. inputs (N, m): the optimal plan, to the given residuals.
    next_state: A x + B u_0 + c. The half-space normal'x ≤ offset holds on the whole feasible set,
    by proof, and excludes next_state by `distance` = (normal'x⁺ − offset)/|normal|. found:
    "search", "sample" or "regions". Where input rates are limited, states are (x, u_{−1}).
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
            f"from x = {_point(self.state)} the optimal u = {_point(self.inputs[0])} leads to "
            f"{_point(self.next_state)}, outside the feasible set by {self.distance:.6g}"
        )


@dataclass(frozen=True)
class RecursionReport:
    """What is known about the recursive feasibility of one MPC problem.

    strong, law, weak: `Rung`s. counterexample: the worst to the law that was found, or None.
    feasible_set: X_N (half-spaces valid and vertices reached, to 1e-9 of its size), None where
    facets were not enumerated. volume: of X_N; lost_by_any: of the part from which every first
    move leaves X_N; lost_by_law: of the part from which the optimal one does, from critical
    regions. NaN where not computed.

    states (B, p): the samples. label (B,): 1 proved feasible, −1 proved infeasible, 0 undecided.
    inputs (B, m), next_states (B, p): the optimal first move and where it leads (NaN where
    label ≠ 1). lost_at (B,): first step k ≥ 1 of the closed loop at which the problem is proved
    infeasible; 0: feasible at all `steps`; −1: not proved feasible at the start; −2: undecided,
    from step undecided_at (B,) on (0 elsewhere).
    """

    mpc: MPC
    strong: Rung
    law: Rung
    weak: Rung
    counterexample: Counterexample | None
    feasible_set: Polytope | None
    volume: float
    lost_by_any: float
    lost_by_law: float
    states: np.ndarray
    label: np.ndarray
    inputs: np.ndarray
    next_states: np.ndarray
    lost_at: np.ndarray
    undecided_at: np.ndarray
    steps: int
    seconds: float

    @property
    def S(self) -> bool | None:
        """Whether every feasible first move stays: `strong.holds`."""
        return self.strong.holds

    @property
    def M(self) -> bool | None:
        """Whether the MPC law stays, that is recursive feasibility: `law.holds`."""
        return self.law.holds

    @property
    def W(self) -> bool | None:
        """Whether some feasible first move stays: `weak.holds`."""
        return self.weak.holds

    def counts(self) -> dict[str, int]:
        """How many samples are feasible; of these lost at once, later, kept, undecided."""
        lost = self.lost_at
        return {
            "feasible": int(np.sum(self.label == 1)),
            "lost after one step": int(np.sum(lost == 1)),
            "lost later": int(np.sum(lost > 1)),
            "kept": int(np.sum(lost == 0)),
            "undecided": int(np.sum(lost == UNDECIDED)),
        }

    def __str__(self) -> str:
        """Rungs with reasons, worst counterexample, volumes and counts, one a line."""
        rows = [(name, str(getattr(self, name))) for name in ("strong", "law", "weak")]
        if self.counterexample is not None:
            rows.append(("worst", f"{self.counterexample} (found by {self.counterexample.found})"))
        volumes = ("volume", self.volume), ("lost by any", self.lost_by_any)
        for name, value in (*volumes, ("lost by law", self.lost_by_law)):
            if np.isfinite(value):
                share = "" if name == "volume" else f"  {value / self.volume:.4%}"
                rows.append((name, f"{value:.9g}{share}"))
        counts = self.counts()
        for name, count in counts.items():
            share = "" if name == "feasible" else f"  {count / max(counts['feasible'], 1):8.3%}"
            rows.append((name, f"{count:>10,}{share}"))
        return "\n".join(f"  {name:<20} {value}" for name, value in rows)

    def to_xarray(self) -> Any:
        """The samples as an xarray.Dataset along the dimension `sample`, names attached."""
        import xarray

        data = {
            "state": (("sample", "coordinate"), self.states),
            "label": ("sample", self.label),
            "input": (("sample", "move"), self.inputs),
            "next_state": (("sample", "coordinate"), self.next_states),
            "lost_at": ("sample", self.lost_at),
            "undecided_at": ("sample", self.undecided_at),
        }
        names = {
            "coordinate": list(self.mpc.labels[: self.states.shape[1]]),
            "move": list(self.mpc.system.input_labels),
        }
        return xarray.Dataset(data, coords=names, attrs={"steps": self.steps})


def recursive_feasibility(
    mpc: MPC, x0s: Any = None, *, steps: int = 20, search: bool = True, regions: int = 2000,
    seconds: float = 60.0,
) -> RecursionReport:  # fmt: skip
    """Is `mpc` recursively feasible? Proofs, the worst counterexample, and the states lost.

    x0s: sample states (B, n), or (B, n + m) with the previous input where input rates are
    limited; None: a grid over X_N, random states in more than three dimensions. steps: length of
    the closed loops x⁺ = A x + B u_0(x) + c from each sample. search: look for a counterexample to
    the law by gradient ascent too. regions: critical regions to enumerate at most for a proof of
    the law (0: none). seconds: when these are spent, search and enumeration of facets end, and
    what they have not settled is open.

    Linear programs are believed to 1e-9 of the size of X_N, by bounds from their multipliers. A
    state counts as outside X_N when it is so by more than 1e-7 of that size. In the closed loops
    each next state is moved towards the centre by 1e-7 of its distance (plans ride on limits,
    where residuals decide the side) and then labelled: infeasible by proof means lost.

    Raises ValueError for ill-posed problems and wrong arguments before anything compiles, and
    where x0s is None and X_N is empty, flat or unbounded.

    Sources: the lesson's Theorem 1; Kerrigan & Maciejowski 2001 (CDC) for strong feasibility;
    Löfberg 2012, Automatica 48, for the law; Bemporad et al. 2002 for critical regions.
    """
    begun = time.monotonic()
    mpc.validate()
    _check(steps=(steps, 1), regions=(regions, 0))
    if not isinstance(seconds, int | float) or not seconds > 0:
        fail("seconds", f"{seconds!r}", "Give a positive number")
    deadline = begun + seconds
    if x0s is not None:
        x0s, p = np.asarray(x0s, np.float64), hard_part(mpc).dimension
        if x0s.ndim != 2 or x0s.shape[1] != p or not len(x0s):
            fail("x0s", f"shape {x0s.shape}", f"Give at least one state, (B, {p})")
    ladder = climb(mpc, deadline)
    bound, starts = _bound(ladder)
    if x0s is None:
        if bound is None:
            fail("x0s", f"None, and {ladder.why}", "Give the states to look at, (B, n)")
        x0s = _samples(ladder, starts, bound.center)
    easy = x0s[0] if bound is None else bound.center
    law = Law(mpc, easy, 1024 if len(x0s) <= 16_384 else default_chunk())
    fmap = law_map(law, x0s)
    loops = _closed_loops(law, x0s, fmap.label, steps)

    worst = None
    if bound is not None and ladder.law.holds is not True:
        candidates = _worst_samples(bound, x0s, loops)
        found = ["sample"] * len(candidates)
        if search:
            feasible = x0s[fmap.label == 1]
            near = feasible[_order(bound, loops.next_states[fmap.label == 1])[: STARTS // 4]]
            starts = np.concatenate([ladder.seeds, starts[:STARTS], near])
            tops = ascend(law, bound, starts, deadline)
            candidates, found = np.concatenate([candidates, tops]), found + ["search"] * len(tops)
        worst = _certified(law, bound, candidates, found)
    lost = 0.0 if ladder.law.holds and np.isfinite(ladder.volume) else np.nan
    enumerable = regions and np.isfinite(ladder.volume) and time.monotonic() < deadline
    if enumerable and not ladder.law.holds:
        verdict, lost, beyond = _by_regions(ladder, regions)
        if verdict.holds is False and worst is None:  # the search has missed it
            worst = _certified(law, bound, beyond, ["regions"] * len(beyond))
        if verdict.holds is False:
            verdict = Rung(None, f"{verdict.reason}, which is not certified", verdict.state)
        if ladder.law.holds is None:
            ladder = replace(ladder, law=verdict)
    if worst is not None:
        refuted = Rung(False, str(worst), worst.state)
        strong = ladder.strong if ladder.strong.holds is False else refuted
        weak = ladder.weak
        if weak.holds is None and _no_way_on(ladder.pairs, worst.state):
            reason = f"from x = {_point(worst.state)} every feasible first move leaves X_N"
            weak = Rung(False, reason, worst.state)
        ladder = replace(ladder, law=refuted, strong=strong, weak=weak)
    elif ladder.law.holds is None:
        tried = f"{np.sum(fmap.label == 1):,} samples" + search * f" and {len(starts)} ascents"
        lost_now = np.sum(loops.lost_at == 1)
        what = f"{lost_now:,} lost after one step, but no" if lost_now else "no"
        reason = f"{what} counterexample among {tried}; no proof: {ladder.law.reason}"
        ladder = replace(ladder, law=Rung(None, reason))
    return RecursionReport(
        mpc, ladder.strong, ladder.law, ladder.weak, worst,
        ladder.shadow.polytope if ladder.shadow else None, ladder.volume, ladder.lost, lost,
        x0s, fmap.label, loops.inputs, loops.next_states, loops.lost_at, loops.undecided_at,
        int(steps), time.monotonic() - begun,
    )  # fmt: skip


@dataclass(frozen=True)
class Ladder:
    """The three rungs as far as they can be settled without the law, and X_N.

    shadow: X_N, or None and `why`. volume of X_N, and of the part lost whatever the move; NaN where
    unknown. seeds (S, p): states with a first move that leaves X_N, or without one that stays.
    """

    mpc: MPC
    pairs: Pairs
    shadow: Shadow | None
    why: str
    strong: Rung
    law: Rung
    weak: Rung
    volume: float
    lost: float
    seeds: np.ndarray


def climb(mpc: MPC, deadline: float = np.inf) -> Ladder:
    """Settle the rungs by Theorem 1 and linear programs."""
    all_pairs = pairs(mpc)
    none = np.zeros((0, all_pairs.p))
    before = after = None
    body: Shadow | str = "the terminal set has no facets"
    if all_pairs.exact and all_pairs.p <= DIMENSIONS:
        body = shadow(all_pairs, deadline)
    elif all_pairs.exact:
        sets = backward(mpc, deadline)
        before, body, after = (None, sets, None) if isinstance(sets, str) else sets
    found, why = (None, body) if isinstance(body, str) else (body, "")
    volume = np.nan
    if found is not None and len(found.vertices):
        volume = found.polytope.volume()
    if not np.any(all_pairs.G[:, : all_pairs.p]) and all_pairs.exact:
        strong, leaving = Rung(True, "no limit depends on the state"), none
    else:
        strong, leaving = _theorem(mpc), none
    if strong.holds is None and found is not None:
        strong, leaving = _every_move(mpc, all_pairs, found)
    elif strong.holds is None:
        strong = Rung(None, f"{strong.reason}; {why}")
    if strong.holds:
        follows, lost = Rung(True, "follows from strong"), 0 * volume
        return Ladder(mpc, all_pairs, found, why, strong, follows, follows, volume, lost, none)
    weak, lost, stuck = Rung(None, why), np.nan, none
    if found is not None and before is not None and after is not None:
        weak, stuck = _longer(before, found, after)
    elif found is not None:
        weak, lost, stuck = _some_move(all_pairs, found, deadline)
    law = Rung(None, why or "the critical regions were not looked at")
    if weak.holds is False:
        law = replace(weak, reason=f"{weak.reason}, the optimal one too")
    seeds = np.concatenate([stuck, leaving])
    return Ladder(mpc, all_pairs, found, why, strong, law, weak, volume, lost, seeds)


def _every_move(mpc: MPC, all_pairs: Pairs, body: Shadow) -> tuple[Rung, np.ndarray]:
    """Strong: one LP for each facet of X_N over all pairs; and the states that are led outside."""
    tops = [all_pairs.largest(normal) for normal in body.normals]
    excess = np.array([top[1] for top in tops]) - body.offsets
    beyond = np.array([top[0] for top in tops]) - body.offsets
    i, p = int(np.argmax(beyond)), all_pairs.p
    outside = np.flatnonzero(beyond > CLEAR * body.size)
    points = [v for _, _, v in tops if v is not None]
    if excess.max() <= TOLERANCE * body.size:
        count = f"one LP for each of {len(excess)} facets, largest excess {excess.max():.1e}"
        reason = f"every feasible first move stays ({_set_before(mpc, body)}{count})"
        return Rung(True, reason), np.zeros((0, p))
    if not len(outside) or len(points) < len(tops):
        reason = f"an LP is within {CLEAR:g} of the size of X_N, {excess.max():.1e}"
        return Rung(None, reason), np.zeros((0, p))
    where, after = points[i][:p], all_pairs.M @ points[i] + all_pairs.t
    reason = (
        f"from x = {_point(where)} a feasible first move leads to {_point(after)}, "
        f"{beyond[i]:.6g} beyond a facet of X_N"
    )
    return Rung(False, reason, where), np.array(points)[outside, :p]


def _set_before(mpc: MPC, body: Shadow) -> str:
    """In words, that one step less gives the same set, where it does."""
    if mpc.horizon < 2 or not usual(mpc):
        return ""
    shorter = pairs(replace(mpc, horizon=mpc.horizon - 1))
    ends = [shorter.support(normal) for normal in body.normals]
    if np.any(np.array(ends) > body.offsets + TOLERANCE * body.size):
        return ""
    N = mpc.horizon
    return f"X_{N - 1} = X_{N}; " if _nested(mpc) else f"X_{N - 1} lies in X_{N}; "


def _nested(mpc: MPC) -> bool:
    """True where a longer horizon can only make X_N smaller: the end has state limits at most."""
    return mpc.constrain_initial and (mpc.terminal_set is None or mpc.terminal_set is mpc.states)


def _some_move(all_pairs: Pairs, body: Shadow, deadline: float) -> tuple[Rung, float, np.ndarray]:
    """Weak: X_N against the states that can go on. The volume lost whatever the move, and the
    vertices of X_N lost.
    """
    none = np.zeros((0, all_pairs.p))
    later = shadow(all_pairs.twice(), deadline)
    if isinstance(later, str):
        return Rung(None, f"of the states that can go on, {later}"), np.nan, none
    excess = later.excess(body.vertices)
    i = int(np.argmax(excess))
    lost = max(body.polytope.volume() - later.polytope.volume(), 0.0)
    if excess[i] <= TOLERANCE * body.size:
        what = f"all {len(excess)} vertices of X_N have a first move that stays"
        return Rung(True, f"{what} (largest excess {max(excess[i], 0.0):.1e})"), 0.0, none
    if excess[i] <= CLEAR * body.size:
        reason = f"a vertex is within {CLEAR:g} of the size of X_N, {excess[i]:.1e}"
        return Rung(None, reason), lost, none
    x = body.vertices[i]
    reason = f"from x = {_point(x)} every feasible first move leaves X_N"
    return Rung(False, reason, x), lost, body.vertices[excess > CLEAR * body.size]


def _longer(before: Shadow, body: Shadow, after: Shadow) -> tuple[Rung, np.ndarray]:
    """Weak by half-spaces alone: X_N ⊆ X_{N+1}, and X_N ⊆ X_{N−1}, so that a first move into X_N
    is that of a feasible plan. And the states that are not in X_{N+1}.
    """
    tops = [body.support(normal) for normal in after.normals]
    excess = np.array([top for top, _ in tops]) - after.offsets
    i = int(np.argmax(excess))
    outside = [x for (_, x), e in zip(tops, excess, strict=True) if e > CLEAR * body.size]
    seeds = np.array([x for x in outside if x is not None]).reshape(-1, len(body.center))
    if len(seeds):
        x = seeds[0]
        return Rung(False, f"from x = {_point(x)} every feasible first move leaves X_N", x), seeds
    nested = np.array([body.support(normal)[0] for normal in before.normals]) - before.offsets
    if max(excess[i], nested.max()) <= TOLERANCE * body.size:
        return Rung(True, f"X_N lies in X_N+1 and in X_N-1 ({len(excess)} facets, by LPs)"), seeds
    return Rung(None, "X_N lies in X_N+1, but not in X_N-1: its plans may lead elsewhere"), seeds


def _no_way_on(all_pairs: Pairs, state: np.ndarray) -> bool:
    """True if no feasible first move from `state` stays: it is beyond the states that can go on."""
    later = all_pairs.twice()
    center = later.centre()
    if center is None or not all_pairs.exact:
        return False
    try:
        _, normal, offset = later.ray(center, state - center)
    except ValueError:  # the ray does not end
        return False
    return bool(normal @ state - offset > CLEAR * np.linalg.norm(state - center))


def _theorem(mpc: MPC) -> Rung:
    """Strong by Theorem 1: a plan shifted by one step and ended inside the terminal set is a plan.

    That needs limits on states and inputs alone, at the usual steps, and inputs free at each step.
    Without a terminal set, X takes its place at horizon N − 1. Convexity and compactness, which
    the theorem asks for, are used nowhere in this argument.
    """
    if not usual(mpc) or (mpc.terminal_set is None and mpc.horizon == 1):
        return Rung(None, "Theorem 1 does not cover these limits")
    last = mpc.states if mpc.terminal_set is None else mpc.terminal_set
    if not np.isfinite(bounding_box(last, mpc.system.n)).all():
        return Rung(None, "Theorem 1 is checked for bounded sets alone")
    try:
        report = verify_terminal(
            mpc.system, mpc.Q, mpc.R, mpc.terminal_cost, mpc.terminal_set, mpc.states, mpc.inputs
        )
    except ValueError as error:  # such as a set too long for its width
        return Rung(None, f"Theorem 1 is not checked ({error})")
    needed = [report["terminal set within states"], report["control invariance"]]
    if all(check.holds for check in needed):
        what = "the terminal set" if mpc.terminal_set is not None else "the set of state limits"
        words = f"{what} is within the limits and control invariant"
        return Rung(True, f"Theorem 1: {words}. {needed[1].sentence}")
    missing = next(check for check in needed if not check.holds)
    return Rung(None, f"Theorem 1 does not apply: {missing.name}")


def _by_regions(ladder: Ladder, limit: int) -> tuple[Rung, float, np.ndarray]:
    """The law by its critical regions; the volume it loses; states (K, n) it loses most.

    On a region x⁺ is affine, so its excess over a facet is largest at a vertex.
    """
    body, mpc = ladder.shadow, ladder.mpc
    assert body is not None
    none = np.zeros((0, ladder.pairs.p))
    try:
        if mpc.remembers:
            fail("mpc", "its law depends on the previous input", "They are not enumerated then")
        found = critical_regions(mpc, limit=limit)
    except ValueError as error:
        return Rung(None, f"no critical regions ({error})"), np.nan, none
    A, B = np.asarray(mpc.system.A, float), np.asarray(mpc.system.B, float)
    c = np.zeros(len(A)) if mpc.system.c is None else np.asarray(mpc.system.c, float)
    excess, parts, lost = [-np.inf], [none], 0.0
    for region in found.regions:
        E, e = A + B @ region.K, B @ region.k + c
        beyond = body.excess(region.vertices @ E.T + e)
        excess.extend(beyond)
        parts.append(region.vertices)
        if beyond.max() > CLEAR * body.size:
            H, h = np.asarray(region.polytope.H), np.asarray(region.polytope.h)
            stays = Polytope(
                np.vstack([H, body.normals @ E]), np.append(h, body.offsets - body.normals @ e)
            )
            lost += region.volume - _volume(stays)
    values, states = np.array(excess[1:]), np.concatenate(parts)
    top = values.max(initial=-np.inf)
    if top > CLEAR * body.size:
        worst = np.argsort(-values)[:6]
        rung = Rung(False, f"a critical region leads {top:.6g} beyond a facet of X_N")
        return rung, lost if found.complete else np.nan, states[worst]
    if not found.complete:
        return Rung(None, f"critical regions are incomplete: {found.reason}"), np.nan, none
    if top > TOLERANCE * body.size:
        return Rung(None, f"a region is within {CLEAR:g} of the size of X_N: {top:.1e}"), lost, none
    count = f"{len(found)} critical regions fill X_N"
    return Rung(True, f"{count}, and the images of their vertices are in it"), 0.0, none


def _volume(body: Polytope) -> float:
    try:
        return body.volume()
    except ValueError:  # empty or flat
        return 0.0


@dataclass(frozen=True)
class Loops:
    """What the closed loops gave; fields as in `RecursionReport`."""

    inputs: np.ndarray
    next_states: np.ndarray
    lost_at: np.ndarray
    undecided_at: np.ndarray


def law_map(law: Law, states: np.ndarray) -> FeasibleSetMap:
    """Labels of states (B, p or more columns), in programs of one shape."""
    p = hard_part(law.mpc).dimension
    fmap = map_feasible_set(law.mpc, law.filled(states[:, :p]), chunk=law.chunk)
    kept: dict[str, Any] = {
        name: value[: len(states)]
        for name, value in vars(fmap.labels).items()
        if isinstance(value, np.ndarray)
    }
    points, labels = fmap.points[: len(states)], replace(fmap.labels, **kept)
    return replace(fmap, points=points, labels=labels)


def _closed_loops(law: Law, x0s: np.ndarray, label: np.ndarray, steps: int) -> Loops:
    """Run the closed loop from every feasible sample until it is lost, undecided or over."""
    count, p = x0s.shape
    lost_at = np.where(label == 1, 0, NOT_FEASIBLE)
    undecided_at = np.zeros(count, int)
    first = np.full((count, law.mpc.system.m), np.nan)
    after = np.full((count, p), np.nan)
    center = x0s[label == 1].mean(axis=0) if np.any(label == 1) else np.zeros(p)
    # The previous input travels along where the plan depends on it.
    states = np.pad(x0s, ((0, 0), (0, law.mpc.dimension - p)))
    for k in range(1, steps + 1):
        alive = np.flatnonzero(lost_at == 0)
        if not len(alive):
            break
        plans = law.plans(states[alive])
        u = law.limited(plans.inputs[:, 0])
        x = law.following(states[alive], u)
        if k == 1:
            first[alive], after[alive] = u, x[:, :p]
        x[:, :p] = center + (1 - CLEAR) * (x[:, :p] - center)
        verdict = law_map(law, x).label
        solved = plans.status == Status.SOLVED
        open_ = ~solved | (verdict == 0)
        lost_at[alive[solved & (verdict == -1)]] = k
        lost_at[alive[open_]], undecided_at[alive[open_]] = UNDECIDED, k
        states[alive] = x
    return Loops(first, after, lost_at, undecided_at)


def _bound(ladder: Ladder) -> tuple[Bound | None, np.ndarray]:
    """Half-spaces of X_N and starts (S, p) near its boundary; None and no starts without them."""
    body, p = ladder.shadow, ladder.pairs.p
    random = np.random.default_rng(0)
    if body is not None and len(body.vertices):
        # Vertices, middles of facets, and random points of facets: convex combinations.
        parts = [body.vertices]
        tight = body.offsets - body.vertices @ body.normals.T <= 1e-7 * body.size
        corners = [body.vertices[column] for column in tight.T]
        parts += [part.mean(axis=0, keepdims=True) for part in corners]
        while sum(map(len, parts)) < STARTS:
            parts += [random.dirichlet(np.ones(len(part)), 1) @ part for part in corners]
        return Bound(body.center, body.normals, body.offsets), np.concatenate(parts)
    try:
        rays = boundary(ladder.mpc, np.concatenate([spread(STARTS, p), np.eye(p), -np.eye(p)]))
    except ValueError:  # empty or flat
        return None, np.zeros((0, p))
    valid = np.isfinite(rays.offsets) & np.any(rays.normals != 0, axis=1)
    found = np.all(np.isfinite(rays.points), axis=1)
    if body is not None and found.any():
        return Bound(rays.center, body.normals, body.offsets), rays.points[found]
    if not valid.any() or not found.any():
        return None, np.zeros((0, p))
    length = np.linalg.norm(rays.normals[valid], axis=1)
    half = np.column_stack([rays.normals[valid] / length[:, None], rays.offsets[valid] / length])
    half = half[np.unique(np.round(half, 9), axis=0, return_index=True)[1]]
    return Bound(rays.center, half[:, :p], half[:, p]), rays.points[found]


def _samples(ladder: Ladder, starts: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Middles of a grid's cells on the box of X_N up to 3-D; above, random points on rays."""
    p = ladder.pairs.p
    if ladder.shadow is not None and len(ladder.shadow.vertices) and p <= 3:
        V, count = ladder.shadow.vertices, {1: 1000, 2: 64, 3: 16}[p]
        half = np.ptp(V, axis=0) / (2 * count)
        return grid(V.min(axis=0) + half, V.max(axis=0) - half, (count,) * p)
    random = np.random.default_rng(0)
    ends = starts[random.integers(len(starts), size=4096)] - center
    return center + random.uniform(0, 1, (len(ends), 1)) ** (1 / p) * ends


def _order(bound: Bound, after: np.ndarray) -> np.ndarray:
    """Indices of next states, the farthest outside first; NaN last."""
    return np.argsort(-np.nan_to_num(bound.excess(after), nan=-np.inf))


def _worst_samples(bound: Bound, x0s: np.ndarray, loops: Loops) -> np.ndarray:
    lost = np.flatnonzero(loops.lost_at == 1)
    return x0s[lost[_order(bound, loops.next_states[lost])[:3]]]


def _certified(
    law: Law, bound: Bound | None, candidates: np.ndarray, found: list[str]
) -> Counterexample | None:
    """The candidate (K, p) whose next state is farthest outside, with both ends proved; or None.

    Each candidate is pulled towards the centre by as little as it takes to prove its plan.
    """
    if bound is None or not len(candidates):
        return None
    pulled = bound.center + (1 - PULLS)[:, None, None] * (candidates - bound.center)
    states = pulled.reshape(-1, candidates.shape[1])
    plans = law.plans(states)
    inputs = plans.inputs.copy()
    inputs[:, 0] = law.limited(inputs[:, 0])
    after = law.following(states, inputs[:, 0])
    fmap = law_map(law, np.concatenate([states, after]))
    here, there = np.split(fmap.label, 2)
    good = (here == 1) & (there == -1) & (plans.status == Status.SOLVED)
    outside = np.where(good, bound.excess(after), -np.inf)
    if not np.any(outside > CLEAR * bound.size):
        return None
    best = int(np.argmax(outside))
    normal, offset = _deepest(law.mpc, bound, fmap, after[best])
    distance = float((normal @ after[best] - offset) / np.linalg.norm(normal))
    return Counterexample(
        states[best], inputs[best], after[best], normal, offset, distance,
        fmap.labels.plans[best], float(plans.primal_residual[best]),
        float(plans.dual_residual[best]), found[best % len(candidates)],
    )  # fmt: skip


def _deepest(
    mpc: MPC, bound: Bound, fmap: FeasibleSetMap, x: np.ndarray
) -> tuple[np.ndarray, float]:
    """Of the half-spaces proved by labels, and by rays that end on the side of x, the deepest."""
    normals, offsets = fmap.cuts()
    facet = int(np.argmax(bound.normals @ x - bound.offsets))
    depth = bound.normals[facet] @ x - bound.offsets[facet]
    towards = np.array([x, bound.nearest(x[None])[0], x - depth * bound.normals[facet]])
    rays = boundary(mpc, towards - bound.center, center=bound.center)
    valid = np.isfinite(rays.offsets)
    normals = np.concatenate([normals, rays.normals[valid]])
    offsets = np.concatenate([offsets, rays.offsets[valid]])
    depth = (normals @ x - offsets) / np.linalg.norm(normals, axis=1)
    best = int(np.nanargmax(depth))
    return normals[best], float(offsets[best])


@dataclass(frozen=True)
class SmallestHorizon:
    """The least horizon at which the law is proved recursively feasible, None if none up to limit.

    strong: the least at which every feasible first move is proved to stay (None: none). reasons:
    of the law rung at each horizon looked at.
    """

    horizon: int | None
    strong: int | None
    reasons: dict[int, Rung] = field(default_factory=dict)


def smallest_horizon(
    mpc: MPC, limit: int = 20, *, regions: int = 2000, seconds: float = 60.0
) -> SmallestHorizon:
    """Try horizons 1, 2, … up to `limit` with proofs alone (no samples, no search).

    seconds: when these are spent, larger horizons are left out. The horizon of `mpc` itself plays
    no part. The answer is the least horizon with a proof; a
    smaller one that is neither proved nor refuted is in `reasons` with holds None, and one at
    which the problem is ill-posed (more free moves than steps) is not. Raises ValueError for an
    ill-posed problem.
    """
    mpc.validate()
    _check(limit=(limit, 1), regions=(regions, 0))
    least, reasons = None, {}
    deadline = time.monotonic() + seconds
    for N in range(1, limit + 1):
        if time.monotonic() > deadline:
            break
        problem = replace(mpc, horizon=N)
        try:
            problem.validate()
        except ValueError:  # such as more free moves than steps
            continue
        ladder = climb(problem, deadline)
        law = ladder.law
        if law.holds is None and least is None and regions and np.isfinite(ladder.volume):
            law = _by_regions(ladder, regions)[0]
        reasons[N] = law
        least = N if law.holds and least is None else least
        if ladder.strong.holds:
            return SmallestHorizon(least, N, reasons)
    return SmallestHorizon(least, None, reasons)


def _check(**counts: tuple[Any, int]) -> None:
    for name, (value, least) in counts.items():
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
            fail(name, f"{value!r}", f"Give a whole number, at least {least}")


def _point(x: np.ndarray) -> str:
    return "(" + ", ".join(f"{v:.6g}" for v in np.round(x, 9) + 0.0) + ")"
