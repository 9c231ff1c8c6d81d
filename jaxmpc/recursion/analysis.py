"""Recursive feasibility: does a controller that has a plan now have one at the next sample?

Three claims about the feasible set X_N of an MPC problem, each weaker than the one before:

    strong  every first move of a feasible plan leads to a state in X_N,
    law     the optimal first move does,
    weak    some first move of a feasible plan does (X_N ⊆ X_{N+1}, where longer horizons can only
            make these sets smaller; else the claim is slightly stronger).

A claim is proved by an invariant terminal set (Theorem 1 of `verify_terminal`; Rawlings, Mayne &
Diehl 2017, section 2.4), by linear programs over the polytope of all states and plans, or by the
critical regions of the law (`claims.py`). It is
refuted by a counterexample: a state with a feasible plan, and a half-space that excludes the next
state. Counterexamples are looked for among samples and by gradient ascent (`ascent.py`).
"""

import time
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from jaxmpc.checks import fail, whole
from jaxmpc.compiled import default_chunk
from jaxmpc.explicit.law import Law
from jaxmpc.feasible.map import grid
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.mpc.problem import MPC
from jaxmpc.recursion.ascent import ascend
from jaxmpc.recursion.claims import (
    Claims,
    every_move_leaves,
    no_move_stays,
    settle_by_regions,
    settle_claims,
)
from jaxmpc.recursion.counterexample import (
    STARTS,
    certified,
    farthest_first,
    outer_bound,
    worst_samples,
)
from jaxmpc.recursion.loops import closed_loops, map_states
from jaxmpc.recursion.report import Claim, RecursionReport


def recursive_feasibility(
    mpc: MPC, x0s: Any = None, *, steps: int = 20, search: bool = True, regions: int = 2000,
    seconds: float = 60.0,
) -> RecursionReport:  # fmt: skip
    """Examine whether `mpc` is recursively feasible: proofs, the worst counterexample, the states
    lost.

    x0s: sample states (B, n), or (B, n + m) with the previous input where input rates are
    limited; None: a grid over X_N, random states in more than three dimensions. steps: length of
    the closed loops x⁺ = A x + B u_0(x) + c from each sample. search: look for a counterexample to
    the law by gradient ascent too. regions: critical regions to enumerate at most for a proof of
    the law (0: none). seconds: time limit of the search and of the enumeration of facets; what is
    not settled by then is open.

    Optima of linear programs are trusted to 1e-9 of the size of X_N, by bounds from their
    multipliers. A state counts as outside X_N when its distance exceeds 1e-7 of that size. In the
    closed loops each next state is moved towards the centre by 1e-7 of its distance, since plans
    lie on limits and residuals decide on which side; then it is labelled, and counts as lost when
    it is proved infeasible.

    Raises ValueError for ill-posed problems and wrong arguments before anything compiles, and
    where x0s is None and X_N is empty, flat or unbounded.

    Sources: Rawlings, Mayne & Diehl 2017, section 2.4, for Theorem 1; Kerrigan & Maciejowski 2001
    (CDC) for strong feasibility; Löfberg 2012, Automatica 48, for the law; Bemporad et al. 2002 for
    critical regions.
    """
    begun = time.monotonic()
    problem = FeasibilityProblem.of(mpc)
    steps, regions = whole("steps", steps, 1), whole("regions", regions, 0)
    if not isinstance(seconds, int | float) or not seconds > 0:
        fail("seconds", f"{seconds!r}", "Give a positive number")
    deadline = begun + seconds
    if x0s is not None:
        x0s, p = np.asarray(x0s, np.float64), problem.dimension
        if x0s.ndim != 2 or x0s.shape[1] != p or not len(x0s):
            fail("x0s", f"shape {x0s.shape}", f"Give at least one state, (B, {p})")
    claims = settle_claims(mpc, problem, deadline)
    bound, starts = outer_bound(claims)
    if x0s is None:
        if bound is None:
            fail("x0s", f"None, and {claims.why}", "Give the states to look at, (B, n)")
        x0s = _samples(claims, starts, bound.center)
    easy = x0s[0] if bound is None else bound.center
    law = Law(mpc, easy, 1024 if len(x0s) <= 16_384 else default_chunk())
    fmap = map_states(law, problem, x0s)
    loops = closed_loops(law, problem, x0s, fmap.label, steps)

    worst = None
    if bound is not None and claims.law.holds is not True:
        candidates = worst_samples(bound, x0s, loops)
        found = ["sample"] * len(candidates)
        if search:
            feasible = x0s[fmap.label == 1]
            near = feasible[
                farthest_first(bound, loops.next_states[fmap.label == 1])[: STARTS // 4]
            ]
            starts = np.concatenate([claims.seeds, starts[:STARTS], near])
            tops = ascend(law, bound, starts, deadline)
            candidates, found = np.concatenate([candidates, tops]), found + ["search"] * len(tops)
        worst = certified(law, problem, bound, candidates, found)
    lost = 0.0 if claims.law.holds and np.isfinite(claims.volume) else np.nan
    enumerable = regions and np.isfinite(claims.volume) and time.monotonic() < deadline
    if enumerable and not claims.law.holds:
        verdict, lost, beyond = settle_by_regions(claims, regions)
        if verdict.holds is False and worst is None:  # the search did not find it
            worst = certified(law, problem, bound, beyond, ["regions"] * len(beyond))
        if verdict.holds is False:
            verdict = Claim(None, f"{verdict.reason}, which is not certified", verdict.state)
        if claims.law.holds is None:
            claims = replace(claims, law=verdict)
    if worst is not None:
        refuted = Claim(False, str(worst), worst.state)
        strong = claims.strong if claims.strong.holds is False else refuted
        weak = claims.weak
        if weak.holds is None and no_move_stays(problem.plan_polytope, worst.state):
            weak = every_move_leaves(worst.state)
        claims = replace(claims, law=refuted, strong=strong, weak=weak)
    elif claims.law.holds is None:
        tried = f"{np.sum(fmap.label == 1):,} samples" + search * f" and {len(starts)} ascents"
        lost_now = np.sum(loops.lost_at == 1)
        what = f"{lost_now:,} lost after one step, but no" if lost_now else "no"
        reason = f"{what} counterexample among {tried}; no proof: {claims.law.reason}"
        claims = replace(claims, law=Claim(None, reason))
    body = claims.feasible_set
    return RecursionReport(
        mpc, claims.strong, claims.law, claims.weak, worst,
        None if body is None else body.polytope, claims.volume, claims.lost, lost,
        x0s, fmap.label, loops.inputs, loops.next_states, loops.lost_at, loops.undecided_at,
        steps, time.monotonic() - begun,
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


@dataclass(frozen=True)
class SmallestHorizon:
    """The least horizon at which the law is proved recursively feasible, None if none up to limit.

    strong: the least at which every feasible first move is proved to stay (None: none). reasons:
    the claim about the law at each horizon looked at.
    """

    horizon: int | None
    strong: int | None
    reasons: dict[int, Claim] = field(default_factory=dict)


def smallest_horizon(
    mpc: MPC, limit: int = 20, *, regions: int = 2000, seconds: float = 60.0
) -> SmallestHorizon:
    """Try horizons 1, 2, … up to `limit` with proofs alone (no samples, no search).

    seconds: time limit, after which larger horizons are left out. The horizon of `mpc` itself has
    no influence. The answer is the least horizon with a proof; a smaller one that is neither proved
    nor refuted is in `reasons` with holds None, and one at which the problem is ill-posed (more
    free moves than steps) is left out of it. Raises ValueError for an ill-posed problem.
    """
    mpc.validate()
    limit, regions = whole("limit", limit, 1), whole("regions", regions, 0)
    least, reasons = None, {}
    deadline = time.monotonic() + seconds
    for N in range(1, limit + 1):
        if time.monotonic() > deadline:
            break
        changed = replace(mpc, horizon=N)
        try:
            problem = FeasibilityProblem.of(changed)
        except ValueError:  # such as more free moves than steps
            continue
        claims = settle_claims(changed, problem, deadline)
        law = claims.law
        if law.holds is None and least is None and regions and np.isfinite(claims.volume):
            law = settle_by_regions(claims, regions)[0]
        reasons[N] = law
        least = N if law.holds and least is None else least
        if claims.strong.holds:
            return SmallestHorizon(least, N, reasons)
    return SmallestHorizon(least, None, reasons)
