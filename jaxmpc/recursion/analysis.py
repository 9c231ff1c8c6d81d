"""Recursive feasibility: does a controller that has a plan now have one at the next sample?

Three claims about the feasible set X_N of an MPC problem, each weaker than the one before:

    strong  every first move of a feasible plan leads to a state in X_N,
    law     the optimal first move does,
    weak    some first move of a feasible plan does (X_N ⊆ X_{N+1}, where longer horizons can only
            make these sets smaller; else the claim is slightly stronger).

A claim is proved by an invariant terminal set (Theorem 1 of `verify_terminal`; Rawlings, Mayne &
Diehl 2017, section 2.4), by linear programs over the polytope of all states and plans, or by the
critical regions of the law (`proofs.py`). It is
refuted by a counterexample: a state with a feasible plan, and a half-space that excludes the next
state. The worst is at a vertex of a critical region; without all regions counterexamples are looked
for among samples and by gradient ascent (`counterexample_search.py`).
"""

from dataclasses import field, replace
from typing import Any

import numpy as np

from jaxmpc.arrays import Reals, host_array
from jaxmpc.batches import default_chunk
from jaxmpc.checks import fail, whole
from jaxmpc.explicit.law import Law, RegionLaw
from jaxmpc.feasible.labels import Labels
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.grids import grid
from jaxmpc.mpc.problem import MPC
from jaxmpc.pytrees import record
from jaxmpc.recursion.counterexample_search import ascend
from jaxmpc.recursion.counterexamples import (
    STARTS,
    certified,
    farthest_first,
    outer_bound,
    worst_samples,
)
from jaxmpc.recursion.proofs import (
    Claims,
    RegionVerdict,
    every_move_leaves,
    no_move_stays,
    settle_by_regions,
    settle_claims,
)
from jaxmpc.recursion.report import NOT_FEASIBLE, Claim, Counterexample, RecursionReport
from jaxmpc.recursion.sampled_loops import LawLoops, closed_loops, map_states
from jaxmpc.recursion.time_budget import LABELS, PLANS, PROOFS, Budget


def recursive_feasibility(
    mpc: MPC, x0s: Reals | None = None, *, steps: int = 20, search: bool = True,
    max_regions: int = 2000, seconds: float = 60.0, progress: bool = False,
) -> RecursionReport:  # fmt: skip
    """Examine whether `mpc` is recursively feasible: proofs, the worst counterexample, the states
    lost.

    What is exact and cheap comes first; what it settles is not sampled:

        1. theorem and linear programs over plans: seconds for up to three states, minutes for
           hundreds of facets,
        2. critical regions of the law, up to four states: seconds for hundreds of regions, minutes
           for thousands. The next state's distance from X_N is convex on each, so that the worst
           of their vertices is the worst state of X_N,
        3. proof of the worst counterexample: some 4 s of compiling,
        4. samples and closed loops from them: another 12 s of compiling,
        5. without complete regions, plans by a solver for 4. (20 s of compiling), and a search.

    x0s: sample states (B, n), or (B, n + m) with the previous input, one within the input limits,
    where input rates are limited; None: none where the law is proved, else a grid over X_N, random
    states in more than three dimensions. steps: length of the closed loops x⁺ = A x + B u_0(x) + c
    from each sample. search: where regions are incomplete look for a counterexample by gradient
    ascent too. max_regions: critical regions to enumerate at most (0: none). seconds: time limit of
    the whole call; 1. may take half of it, 2. half of what is left. What is not settled by then is
    open, and samples that are not labelled or followed to the end are undecided. Compiling, one
    step of all closed loops, and a linear program cannot be interrupted: a stage that has to
    compile is left out where less than the seconds above are left. progress: print each stage on
    stderr.

    Optima of linear programs are trusted to 1e-9, by bounds from their multipliers: relative to the
    distance of a facet of X_N from the centre. A state counts as outside X_N when it lies beyond a
    facet by more than 1e-7 of that. In the
    closed loops each next state is moved towards the centre by 1e-7 of its distance, since plans
    lie on limits and residuals decide on which side; then it is labelled, and counts as lost when
    it is proved infeasible.

    Raises ValueError for ill-posed problems and wrong arguments before anything compiles, and
    where x0s is None and X_N is empty, flat or unbounded.

    Sources: Rawlings, Mayne & Diehl 2017, section 2.4, for Theorem 1; Kerrigan & Maciejowski 2001
    (CDC) for strong feasibility; Löfberg 2012, Automatica 48, for the law; Bemporad et al. 2002 for
    critical regions.
    """
    budget = Budget.of(seconds, progress)
    return examine(mpc, x0s, steps, search, max_regions, budget, budget.share(0.5))


def examine(
    mpc: MPC, x0s: Any, steps: int, search: bool, max_regions: int, budget: Budget, settled: float
) -> RecursionReport:
    """Return the report of `recursive_feasibility`; settled: when its stage 1 has to end."""
    problem = FeasibilityProblem.of(mpc)
    steps, max_regions = whole("steps", steps, 1), whole("max_regions", max_regions, 0)
    if x0s is not None:
        x0s, p = host_array("x0s", x0s), problem.dimension
        if x0s.ndim != 2 or x0s.shape[1] != p or not len(x0s):
            fail("x0s", f"shape {x0s.shape}", f"Give at least one state, (B, {p})")
    budget.say("theorem and linear programs")
    claims = settle_claims(mpc, problem, settled)
    lost = 0.0 if claims.law.holds and np.isfinite(claims.volume) else np.nan
    verdict: RegionVerdict | None = None
    if max_regions and not claims.law.holds and np.isfinite(claims.volume):
        budget.say("critical regions of the law")
        verdict = settle_by_regions(claims, max_regions, budget.share(0.5))
        lost = verdict.lost
        if claims.law.holds is None:
            claims = replace(claims, law=verdict.claim)
    none = np.zeros((0, problem.dimension))
    if x0s is None and claims.law.holds:
        return _report(claims, None, lost, none, _unfollowed(problem, none), steps, budget)
    if not budget.affords(PROOFS):
        budget.say("the time is over before a counterexample is proved")
        x0s = none if x0s is None else x0s
        return _report(
            _open(claims, verdict), None, lost, x0s, _unfollowed(problem, x0s), steps, budget
        )
    bound, starts = outer_bound(claims)
    asked = x0s is not None
    if x0s is None:
        if bound is None:
            fail("x0s", f"None, and {claims.why}", "Give the states to look at, (B, n)")
        x0s = _samples(claims, starts, bound.center)
    easy = x0s[0] if bound is None else bound.center
    chunk = 1024 if len(x0s) <= 16_384 else default_chunk()
    found = None if verdict is None else verdict.regions
    complete = found is not None and found.complete
    law = RegionLaw(found, easy, chunk) if found is not None and complete else Law(mpc, easy, chunk)
    worst = None
    if verdict is not None and found is not None and len(verdict.worst):
        budget.say(f"proof of the counterexample; compiles for some {PROOFS:.0f} s")
        by = ["regions"] * len(verdict.worst)
        worst = certified(RegionLaw(found, easy, chunk), problem, bound, verdict.worst, by)
    compiles, ascents = LABELS + (0.0 if complete else PLANS), 0
    followed = _unfollowed(problem, x0s if asked else none)
    if not budget.affords(compiles):
        budget.say(f"no samples: they compile for some {compiles:.0f} s, which are not left")
        x0s = x0s if asked else none
    else:
        budget.say(
            f"closed loops of {steps} steps from {len(x0s):,} samples; compile for some "
            f"{compiles:.0f} s"
        )
        labels = map_states(law, problem, x0s).labels
        label = labels.label
        loops = closed_loops(law, problem, x0s, label, steps, budget)
        followed = labels, loops
        if bound is not None and not complete and not claims.law.holds:
            candidates = worst_samples(bound, x0s, loops)
            by = ["sample"] * len(candidates)
            if search:
                far = farthest_first(bound, loops.next_states[label == 1])[: STARTS // 4]
                starts = np.concatenate([claims.seeds, starts[:STARTS], x0s[label == 1][far]])
                ascents = len(starts)
                budget.say(f"gradient ascent from {ascents} states")
                tops = ascend(law, bound, starts, budget.share(0.8))
                candidates, by = np.concatenate([candidates, tops]), by + ["search"] * len(tops)
            budget.say(f"proof of the counterexample; compiles for some {PROOFS:.0f} s")
            other = certified(law, problem, bound, candidates, by)
            if worst is None or (other is not None and other.distance > worst.distance):
                worst = other
    if worst is not None:
        refuted = Claim(False, str(worst), worst.state)
        strong = claims.strong if claims.strong.holds is False else refuted
        weak = claims.weak
        if weak.holds is None and no_move_stays(problem.plan_polytope, worst.state):
            weak = every_move_leaves(worst.state)
        claims = replace(claims, law=refuted, strong=strong, weak=weak)
    else:
        claims = _open(claims, verdict, followed, ascents)
    return _report(claims, worst, lost, x0s, followed, steps, budget)


def _open(
    claims: Claims, verdict: RegionVerdict | None, followed: Any = None, ascents: int = 0
) -> Claims:
    """Return the claims without a certified counterexample: that about the law stays open unless
    some other proof or counterexample settles it, and says what was tried.

    followed: labels and closed loops of the samples, None where the time was over before.
    """
    if claims.law.holds or claims.weak.holds is False:
        return claims
    reason = claims.law.reason
    if verdict is not None and verdict.claim.holds is False:
        why = "no time was left for that" if followed is None else "its proof failed"
        reason = f"{verdict.claim.reason}, which is not certified: {why}"
        return replace(claims, law=Claim(None, reason, verdict.claim.state))
    if followed is None or not len(followed[0].label):
        return replace(claims, law=Claim(None, f"no time was left for samples; no proof: {reason}"))
    label, loops = followed[0].label, followed[1]
    tried = f"{np.sum(label == 1):,} samples" + (f" and {ascents} ascents" if ascents else "")
    lost = np.sum(loops.lost_at == 1)
    what = f"{lost:,} lost after one step, but no" if lost else "no"
    return replace(
        claims, law=Claim(None, f"{what} counterexample among {tried}; no proof: {reason}")
    )


def _unfollowed(problem: FeasibilityProblem, x0s: np.ndarray) -> tuple[Labels, LawLoops]:
    """Return labels and closed loops of samples (B, p) that there was no time for: undecided."""
    count = len(x0s)
    nowhere = np.full_like(x0s, np.nan)
    loops = LawLoops(
        np.full((count, problem.mpc.system.m), np.nan), nowhere, np.full(count, NOT_FEASIBLE),
        np.zeros(count, int),
    )  # fmt: skip
    return Labels.empty(count, problem), loops


def _report(
    claims: Claims, worst: Counterexample | None, lost: float, x0s: np.ndarray,
    followed: tuple[Labels, LawLoops], steps: int, budget: Budget,
) -> RecursionReport:  # fmt: skip
    """Return the report of all that was found. followed: labels and closed loops of x0s."""
    body, (labels, loops) = claims.feasible_set, followed
    return RecursionReport(
        claims.mpc, claims.strong, claims.law, claims.weak, worst,
        None if body is None else body.polytope, claims.volume, claims.lost, lost,
        x0s, labels.label, loops.inputs, loops.next_states, loops.lost_at, loops.undecided_at,
        steps, budget.spent, labels,
    )  # fmt: skip


def _samples(claims: Claims, starts: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Return the middles of a grid's cells on the box of X_N up to 3-D; above, random points on
    rays."""
    p = claims.problem.dimension
    if claims.feasible_set is not None and len(claims.feasible_set.vertices) and p <= 3:
        V, count = claims.feasible_set.vertices, {1: 1000, 2: 64, 3: 16}[p]
        half = np.ptp(V, axis=0) / (2 * count)
        return grid(V.min(axis=0) + half, V.max(axis=0) - half, (count,) * p)
    random = np.random.default_rng(0)
    ends = starts[random.integers(len(starts), size=4096)] - center
    return center + random.uniform(0, 1, (len(ends), 1)) ** (1 / p) * ends


@record
class SmallestHorizon:
    """The least horizon at which the law is proved recursively feasible, None where none was found.

    strong: the least at which every feasible first move is proved to stay (None: none). reasons:
    the claim about the law at each horizon looked at.
    """

    horizon: int | None
    strong: int | None
    reasons: dict[int, Claim] = field(default_factory=dict)


def smallest_horizon(
    mpc: MPC,
    max_horizon: int = 20,
    *,
    max_regions: int = 2000,
    seconds: float = 60.0,
    progress: bool = False,
) -> SmallestHorizon:
    """Try horizons 1, 2, … up to `max_horizon` with proofs alone (no samples, no search).

    seconds: time limit, after which larger horizons are left out (some linear programs are
    finished); a horizon takes a second or so with two states, minutes with hundreds of facets or
    thousands of regions. progress: print each horizon on stderr. The horizon of `mpc` itself has
    no influence. The answer is the least horizon with a proof; a smaller one that is neither proved
    nor refuted is in `reasons` with holds None, and one at which the problem is ill-posed (more
    free moves than steps) is left out of it. Raises ValueError for an ill-posed problem.
    """
    mpc.validate()
    max_horizon = whole("max_horizon", max_horizon, 1)
    max_regions = whole("max_regions", max_regions, 0)
    least, reasons = None, {}
    budget = Budget.of(seconds, progress)
    for N in range(1, max_horizon + 1):
        if not budget.affords(0):
            break
        budget.say(f"horizon {N}")
        changed = replace(mpc, horizon=N)
        try:
            problem = FeasibilityProblem.of(changed)
        except ValueError:  # such as more free moves than steps
            continue
        try:
            claims = settle_claims(changed, problem, budget.deadline)
            law = claims.law
            if law.holds is None and least is None and max_regions and np.isfinite(claims.volume):
                law = settle_by_regions(claims, max_regions, budget.deadline).claim
        except ValueError as error:  # too ill-conditioned: the other horizons stay settled
            reasons[N] = Claim(None, f"not settled ({error})")
            continue
        reasons[N] = law
        least = N if law.holds and least is None else least
        if claims.strong.holds:
            return SmallestHorizon(least, N, reasons)
    return SmallestHorizon(least, None, reasons)
