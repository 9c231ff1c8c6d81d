"""Recursive feasibility: does a controller that has a plan now have one at the next time step?

Three claims about the feasible set X_N of an MPC problem, each weaker than the one before:

    strong  every first input of a feasible plan leads to a state in X_N,
    law     the optimal first input does,
    weak    some first input of a feasible plan does (X_N ⊆ X_{N+1}, where longer horizons can only
            make these sets smaller; else the claim is slightly stronger).

A claim is proved by an invariant terminal set (Theorem 1 of `verify_terminal`; Rawlings, Mayne &
Diehl 2017, section 2.4), by linear programs over the polytope of all states and plans, or by the
critical regions of the law (`proofs.py`). It is refuted by a counterexample: a state with a
feasible plan, and a half-space that excludes the next state. The worst is at a vertex of a critical
region; without all regions counterexamples are looked for among samples and by gradient ascent
(`counterexamples.py`).
"""

from dataclasses import replace

import numpy as np

from jaxmpc.arrays import Reals, host_array
from jaxmpc.batches import default_chunk
from jaxmpc.checks import fail, require_kind, whole
from jaxmpc.explicit.law_at_states import Law, RegionLaw
from jaxmpc.feasible.plan_polytope import CenteredPolytope
from jaxmpc.feasible.policy_problem import problem_of
from jaxmpc.grids import grid
from jaxmpc.mpc.plan import References, constant_references
from jaxmpc.mpc.problem import HARD, MPC, folded
from jaxmpc.recursion.counterexamples import (
    STARTS,
    Counterexample,
    SampledLoops,
    ascend,
    certified,
    closed_loops,
    farthest_first,
    labelled,
    outer_bound,
    worst_samples,
)
from jaxmpc.recursion.proofs import (
    Claim,
    Claims,
    RegionVerdict,
    every_input_leaves,
    no_input_stays,
    settle_by_regions,
    settle_claims,
)
from jaxmpc.recursion.report import RecursionReport, SmallestHorizon
from jaxmpc.recursion.time_budget import LABELS, PLANS, PROOFS, Budget

# Of data that differ from step to step.
SAME = "recursive feasibility is about the same problem at every time step"
# Where to look for lost states beside a worst vertex: so far towards the centre.
NEAR_THE_WORST = np.array([1e-6, 1e-4, 1e-3, 1e-2])


def recursive_feasibility(
    mpc: MPC,
    x0s: Reals | None = None,
    *,
    reference: Reals | None = None,
    input_reference: Reals | None = None,
    steps: int = 20,
    search: bool = True,
    max_regions: int = 2000,
    seconds: float = 60.0,
    progress: bool = False,
) -> RecursionReport:
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
    states in more than three dimensions. reference (n,), input_reference (m,): what the law tracks
    at all time steps, None for zero; of the claims they change that on the law alone. steps: length
    of the closed loops x⁺ = A x + B u_0(x) + c from each sample. search: where regions are
    incomplete look for a counterexample by gradient ascent too. max_regions: critical regions to
    enumerate at most (0: none). seconds: time limit of the whole call; 1. may take half of it, 2.
    half of what is left. What is not settled by then is open, and samples that are not labelled or
    followed to the end are undecided. Compiling, one step of all closed loops, and a linear program
    cannot be interrupted: a stage that has to compile is left out where less than the seconds above
    are left. progress: print each stage on stderr.

    Optima of linear programs are trusted to 1e-9, by bounds from their multipliers: relative to the
    distance of a facet of X_N from the centre. A state counts as outside X_N when it lies beyond a
    facet by more than 1e-7 of that. In the
    closed loops each next state is moved towards the centre by 1e-7 of its distance, since plans
    lie on limits and residuals decide on which side; then it is labelled, and counts as lost when
    it is proved infeasible.

    Of a robust problem the claims are about every disturbance, x⁺ = A x + B u_0(x) + c + E w: the
    theorem, linear programs and regions prove them or refute the strong one; what is left is open,
    and no samples are followed.

    Raises ValueError for ill-posed problems and wrong arguments before anything compiles, and
    where x0s is None and X_N is empty, flat or unbounded.

    Sources: Rawlings, Mayne & Diehl 2017, section 2.4, for Theorem 1; Kerrigan & Maciejowski 2001
    (CDC) for strong feasibility; Löfberg 2012, Automatica 48, for the law; Bemporad et al. 2002 for
    critical regions.
    """
    budget = Budget.of(seconds, progress)
    references = constant_references(mpc, reference, input_reference)
    return examine(mpc, x0s, steps, search, max_regions, budget, budget.share(0.5), references)


def examine(
    mpc: MPC,
    x0s: Reals | None,
    steps: int,
    search: bool,
    max_regions: int,
    budget: Budget,
    settled: float,
    references: References,
) -> RecursionReport:
    """Return the report of `recursive_feasibility`; settled: when its stage 1 has to end.
    references: what plans track, by argument."""
    require_kind("mpc", mpc, MPC)
    mpc.validate()
    mpc.require_constant(SAME, *HARD)
    mpc = folded(mpc)
    require_kind("search", search, bool, cure="Give True or False")
    problem = problem_of(mpc)
    p = problem.dimension
    steps, max_regions = whole("steps", steps, 1), whole("max_regions", max_regions, 0)
    if x0s is not None and mpc.disturbance is not None:
        cure = "Leave them out, and simulate loops with jm.simulate(..., disturbance=...)"
        fail("x0s", "given for a robust problem, of which no samples are followed", cure)
    given = np.zeros((0, p)) if x0s is None else host_array("x0s", x0s)
    if x0s is not None and (given.ndim != 2 or given.shape[1] != p or not len(given)):
        fail("x0s", f"shape {given.shape}", f"Give at least one state, (B, {p})")
    budget.say("theorem and linear programs")
    claims = settle_claims(mpc, problem, settled)
    lost = 0.0 if claims.law.holds and np.isfinite(claims.volume) else np.nan
    verdict = RegionVerdict.none(p)
    if max_regions and not claims.law.holds and np.isfinite(claims.volume):
        budget.say("critical regions of the law")
        verdict = settle_by_regions(claims, max_regions, budget.share(0.5), **references)
        lost = verdict.lost
        if claims.law.holds is None:
            claims = replace(claims, law=verdict.claim)
    loops = SampledLoops.undecided(problem, given, steps)
    if x0s is None and claims.law.holds:
        return _report(claims, None, lost, loops, budget)
    if mpc.disturbance is not None:
        return _report(_robust(claims, verdict), None, lost, loops, budget)
    if not budget.affords(PROOFS):
        needed = budget.sufficient(PROOFS + LABELS + PLANS)
        budget.say(f"the time is over before a counterexample is proved: give {needed} s")
        return _report(_open(claims, verdict, None), None, lost, loops, budget, needed)

    bound, starts = outer_bound(claims)
    samples = given
    if x0s is None:
        if bound is None:
            fail("x0s", f"None, and {claims.why}", "Give the states to look at, (B, n)")
        samples = _samples(claims, starts, bound.center)
        if len(verdict.worst):
            # A lost part may lie between the points of a grid: look at it, too.
            inwards = NEAR_THE_WORST[:, None, None] * (bound.center - verdict.worst)
            samples = np.concatenate([samples, (verdict.worst + inwards).reshape(-1, p)])
    easy = samples[0] if bound is None else bound.center
    chunk = 1024 if len(samples) <= 16_384 else default_chunk()
    regions, worst = verdict.regions, None
    region_law = None if regions is None else RegionLaw(regions, easy, chunk)
    complete = regions is not None and regions.complete
    law = Law(mpc, easy, chunk, **references) if region_law is None or not complete else region_law
    if region_law is not None and len(verdict.worst):
        budget.say(f"proof of the counterexample; compiles for some {PROOFS:.0f} s")
        by = ["regions"] * len(verdict.worst)
        worst = certified(region_law, problem, bound, verdict.worst, by)
    compiles, ascents, needed = LABELS + (0.0 if complete else PLANS), 0, 0
    if not budget.affords(compiles):
        needed = budget.sufficient(compiles)
        budget.say(f"no samples: they compile for some {compiles:.0f} s, so give {needed} s")
    else:
        what = f"closed loops of {steps} steps from {len(samples):,} samples"
        budget.say(f"{what}; compile for some {compiles:.0f} s")
        labels = labelled(law, problem, samples)
        loops = closed_loops(law, problem, samples, labels, steps, budget)
        if bound is not None and not complete and not claims.law.holds:
            candidates = worst_samples(bound, loops)
            by = ["sample"] * len(candidates)
            if search:
                starts = _search_starts(claims, bound, starts, loops)
                ascents = len(starts)
                budget.say(f"gradient ascent from {ascents} states")
                tops = ascend(law, bound, starts, budget.share(0.8))
                by += ["search"] * len(tops)
                candidates = np.concatenate([candidates, tops])
            budget.say(f"proof of the counterexample; compiles for some {PROOFS:.0f} s")
            other = certified(law, problem, bound, candidates, by)
            if worst is None or (other is not None and other.distance > worst.distance):
                worst = other
    if worst is None:
        return _report(_open(claims, verdict, loops, ascents), None, lost, loops, budget, needed)
    return _report(_refuted(claims, worst), worst, lost, loops, budget, needed)


def _search_starts(
    claims: Claims, bound: CenteredPolytope, starts: np.ndarray, loops: SampledLoops
) -> np.ndarray:
    """Return states (S, p) from which to search: those of a claim refuted already, some near the
    boundary, and samples that lead farthest outside."""
    feasible = loops.label == 1
    far = farthest_first(bound, loops.next_states[feasible])[: STARTS // 4]
    return np.concatenate([claims.seeds, starts[:STARTS], loops.x0s[feasible][far]])


def _refuted(claims: Claims, worst: Counterexample) -> Claims:
    """Return the claims with a certified counterexample to the law."""
    refuted = Claim(False, str(worst), worst.state)
    strong = claims.strong if claims.strong.holds is False else refuted
    weak = claims.weak
    if weak.holds is None and no_input_stays(claims.problem.plan_polytope, worst.state):
        weak = every_input_leaves(worst.state)
    return replace(claims, law=refuted, strong=strong, weak=weak)


def _open(
    claims: Claims, verdict: RegionVerdict, loops: SampledLoops | None, ascents: int = 0
) -> Claims:
    """Return the claims without a certified counterexample: that about the law stays open unless
    some other proof or counterexample settles it, and says what was tried.

    loops: None where the time was over before.
    """
    if claims.law.holds or claims.weak.holds is False:
        return claims
    reason = claims.law.reason
    if verdict.claim.holds is False:
        why = "no time was left for that" if loops is None else "its proof failed"
        reason = f"{verdict.claim.reason}, which is not certified: {why}"
        return replace(claims, law=Claim(None, reason, verdict.claim.state))
    if loops is None or not len(loops.x0s):
        return replace(claims, law=Claim(None, f"no time was left for samples; no proof: {reason}"))
    tried = f"{np.sum(loops.label == 1):,} samples" + (f" and {ascents} ascents" if ascents else "")
    lost = np.sum(loops.lost_at == 1)
    what = f"{lost:,} lost after one step, but no" if lost else "no"
    reason = f"{what} counterexample among {tried}; no proof: {reason}"
    return replace(claims, law=Claim(None, reason))


def _robust(claims: Claims, verdict: RegionVerdict) -> Claims:
    """Return the claims under a disturbance: what no proof settles is open, for no counterexample
    is certified."""
    if verdict.claim.holds is not False:
        return claims
    reason = f"{verdict.claim.reason} under a disturbance, which is not certified"
    return replace(claims, law=Claim(None, reason, verdict.claim.state))


def _report(
    claims: Claims,
    worst: Counterexample | None,
    lost_by_law: float,
    loops: SampledLoops,
    budget: Budget,
    needed: int = 0,
) -> RecursionReport:
    """Return the report of all that was found."""
    body = claims.feasible_set
    return RecursionReport(
        mpc=claims.mpc,
        strong=claims.strong,
        law=claims.law,
        weak=claims.weak,
        counterexample=worst,
        feasible_set=None if body is None else body.polytope,
        volume=claims.volume,
        lost_by_any=claims.lost,
        lost_by_law=lost_by_law,
        loops=loops,
        seconds=budget.spent,
        needed=needed,
    )


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


def smallest_horizon(
    mpc: MPC,
    max_horizon: int = 20,
    *,
    reference: Reals | None = None,
    input_reference: Reals | None = None,
    max_regions: int = 2000,
    seconds: float = 60.0,
    progress: bool = False,
) -> SmallestHorizon:
    """Try horizons 1, 2, … up to `max_horizon` with proofs alone (no samples, no search).

    max_horizon: the largest to try. reference, input_reference: as in `recursive_feasibility`.
    max_regions: critical regions to enumerate at most.
    seconds: time limit, after which larger horizons are left out (some linear programs are
    finished); a horizon takes a second or so with two states, minutes with hundreds of facets or
    thousands of regions. progress: print each horizon on stderr. The horizon of `mpc` itself has
    no influence. The answer is the least horizon with a proof; a smaller one that is neither proved
    nor refuted is in `reasons` with holds None, and one at which the problem is ill-posed (more
    free moves than steps) is left out of it. Raises ValueError for an ill-posed problem.
    """
    require_kind("mpc", mpc, MPC)
    mpc.validate()
    mpc.require_constant(SAME, *HARD)
    mpc = folded(mpc)
    references = constant_references(mpc, reference, input_reference)
    max_horizon = whole("max_horizon", max_horizon, 1)
    max_regions = whole("max_regions", max_regions, 0)
    least: int | None = None
    reasons: dict[int, Claim] = {}
    budget = Budget.of(seconds, progress)
    for N in range(1, max_horizon + 1):
        if not budget.affords(0):
            break
        budget.say(f"horizon {N}")
        changed = replace(mpc, horizon=N)
        try:
            problem = problem_of(changed)
        except ValueError:  # such as more free moves than steps
            continue
        try:
            claims = settle_claims(changed, problem, budget.deadline)
            law = claims.law
            if law.holds is None and least is None and max_regions and np.isfinite(claims.volume):
                law = settle_by_regions(claims, max_regions, budget.deadline, **references).claim
        except ValueError as error:  # too ill-conditioned: the other horizons stay settled
            reasons[N] = Claim(None, f"not settled ({error})")
            continue
        reasons[N] = law
        least = N if law.holds and least is None else least
        if claims.strong.holds:
            return SmallestHorizon(least, N, reasons, max_horizon)
    return SmallestHorizon(least, None, reasons, max_horizon)
