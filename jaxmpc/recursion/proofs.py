"""The three claims of recursive feasibility, proved or refuted by theorems and linear programs."""

import time
from dataclasses import replace
from typing import Any

import numpy as np

from jaxmpc.checks import fail
from jaxmpc.explicit.regions import CriticalRegions, critical_regions
from jaxmpc.feasible.plan_polytope import (
    DIMENSIONS,
    TOLERANCE,
    CenteredPolytope,
    PlanPolytope,
    projected,
)
from jaxmpc.feasible.polytope_growth import backward, is_standard_form
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.tightening import feedback_gain
from jaxmpc.pytrees import record
from jaxmpc.sets.convex_sets import Polytope, set_bounds
from jaxmpc.sets.disturbances import disturbance_set, supports
from jaxmpc.sets.geometry import Empty, Flat
from jaxmpc.sets.terminal_hypotheses import verify_terminal
from jaxmpc.systems.system import host_matrices

# Distance from a facet of X_N, relative to the facet's from the centre, from which a state counts
# as outside: well above the residuals of plans. Next states are moved towards the centre by as much
# before they are labelled.
CLEAR = 1e-7
LATE = "the time was over before its linear programs were solved"


@record
class Claim:
    """A claim, whether it holds, and why.

    holds: True (proved, with limits that count as kept up to 1e-9 of the size of the set), False
    (refuted) or None (open). reason: in words.
    state (p,): where it is refuted, the state of the counterexample; else None.
    """

    holds: bool | None
    reason: str
    state: np.ndarray | None = None

    def __str__(self) -> str:
        return f"{ {True: 'proved', False: 'refuted', None: 'open'}[self.holds] }: {self.reason}"


@record
class Claims:
    """The three claims about a problem, as far as they are settled without the law, and X_N.

    feasible_set: X_N, or None and `why`. volume: of X_N; lost: of the part from which every first
    input leaves X_N; NaN where unknown. seeds (S, p): states with a first input that leaves X_N, or
    without one that stays.
    """

    mpc: MPC
    problem: FeasibilityProblem
    feasible_set: CenteredPolytope | None
    why: str
    strong: Claim
    law: Claim
    weak: Claim
    volume: float
    lost: float
    seeds: np.ndarray


def settle_claims(mpc: MPC, problem: FeasibilityProblem, deadline: float = np.inf) -> Claims:
    """Prove or refute the claims about `mpc` by Theorem 1 and linear programs.

    problem: the feasibility problem of `mpc`. deadline: of `time.monotonic`; a claim that is not
    settled by then is open. Theorem 1 and the extent of the polytope of plans, some dozens of
    linear programs, are finished.
    """
    plans = problem.plan_polytope
    none = np.zeros((0, plans.p))
    before = after = None
    body: CenteredPolytope | str = "the terminal set has no facets"
    if plans.exact and plans.p <= DIMENSIONS:
        body = projected(plans, deadline)
    elif plans.exact:
        sets = backward(replace(mpc, soft=(), input_rate_weight=None), deadline)
        before, body, after = (None, sets, None) if isinstance(sets, str) else sets
    found, why = (None, body) if isinstance(body, str) else (body, "")
    disturbed = mpc.disturbance is not None
    volume = np.nan
    if found is not None and len(found.vertices):
        volume = found.polytope.volume()
    if not np.any(plans.G[:, : plans.p]) and plans.exact:
        strong, leaving = Claim(True, "no limit depends on the state"), none
    else:
        strong, leaving = _by_theorem(mpc), none
    if strong.holds is None and found is not None:
        strong, leaving = _every_input(mpc, plans, found, deadline)
    elif strong.holds is None:
        strong = Claim(None, f"{strong.reason}; {why}")
    if strong.holds:
        follows, lost = Claim(True, "follows from strong"), 0 * volume
        return Claims(mpc, problem, found, why, strong, follows, follows, volume, lost, none)
    weak, lost, stuck = Claim(None, why), np.nan, none
    if disturbed:
        weak = Claim(None, "under a disturbance the weak claim is not examined")
    elif found is not None and before is not None and after is not None:
        weak, stuck = _longer(before, found, after, deadline)
    elif found is not None:
        weak, lost, stuck = _some_input(plans, found, deadline)
    law = Claim(None, why or "the critical regions were not looked at")
    if weak.holds is False:
        law = replace(weak, reason=f"{weak.reason}, the optimal one too")
    seeds = np.concatenate([stuck, leaving])
    return Claims(mpc, problem, found, why, strong, law, weak, volume, lost, seeds)


def _every_input(
    mpc: MPC, plans: PlanPolytope, body: CenteredPolytope, deadline: float
) -> tuple[Claim, np.ndarray]:
    """Settle the strong claim by one LP for each facet of X_N; return it and the states led
    outside."""
    tops = [plans.largest_next(normal) for normal in body.normals if time.monotonic() < deadline]
    if len(tops) < len(body.normals):
        return Claim(None, LATE), np.zeros((0, plans.p))
    room = body.offsets - pushed(mpc, body)
    violation = (np.array([top[1] for top in tops]) - room) / body.depths
    beyond = (np.array([top[0] for top in tops]) - room) / body.depths
    i, p = int(np.argmax(beyond)), plans.p
    outside = np.flatnonzero(beyond > CLEAR)
    points = [v for _, _, v in tops if v is not None]
    if violation.max() <= TOLERANCE:
        count = f"one LP for each of {len(tops)} facets, largest violation {violation.max():.1e}"
        reason = f"every feasible first input stays ({_set_before(mpc, body)}{count})"
        return Claim(True, reason), np.zeros((0, p))
    if not len(outside) or len(points) < len(tops):
        reason = f"an LP is within {CLEAR:g} of the size of X_N, {violation.max():.1e}"
        return Claim(None, reason), np.zeros((0, p))
    where, after = points[i][:p], plans.M @ points[i] + plans.t
    by = "" if mpc.disturbance is None else ", and a disturbance from there"
    reason = (
        f"from x = {in_words(where)} a feasible first input leads to {in_words(after)}{by}, "
        f"{beyond[i] * body.depths[i]:.6g} beyond a facet of X_N"
    )
    return Claim(False, reason, where), np.array(points)[outside, :p]


def pushed(mpc: MPC, body: CenteredPolytope) -> np.ndarray:
    """Return how far a disturbance can push a state across each facet (K,), zero without one."""
    n = mpc.system.n
    W = disturbance_set(mpc.disturbance, n, mpc.disturbance_matrix)
    return supports(W, body.normals[:, :n])


def _set_before(mpc: MPC, body: CenteredPolytope) -> str:
    """Return a text saying that one step less gives the same set, empty where it does not."""
    if mpc.horizon < 2 or not is_standard_form(mpc) or mpc.disturbance is not None:
        return ""
    shorter = FeasibilityProblem.of(replace(mpc, horizon=mpc.horizon - 1)).plan_polytope
    ends = [shorter.support(normal)[0] for normal in body.normals]
    if np.any(np.array(ends) > body.offsets + TOLERANCE * body.depths):
        return ""
    N = mpc.horizon
    return f"X_{N - 1} = X_{N}; " if _nested(mpc) else f"X_{N - 1} lies in X_{N}; "


def _nested(mpc: MPC) -> bool:
    """Return whether a longer horizon can only make X_N smaller: the end has state limits at
    most."""
    return mpc.constrain_initial and (mpc.terminal_set is None or mpc.terminal_set is mpc.states)


def _some_input(
    plans: PlanPolytope, body: CenteredPolytope, deadline: float
) -> tuple[Claim, float, np.ndarray]:
    """Settle the weak claim by comparing X_N with the states that can go on; return it, the volume
    lost whatever the input, and the vertices of X_N that are lost.
    """
    none = np.zeros((0, plans.p))
    after = plans.followed()
    if plans.exact and after.program.empty:
        return every_input_leaves(body.center), body.polytope.volume(), body.vertices
    later = projected(after, deadline)
    if isinstance(later, str):
        return Claim(None, f"of the states that can go on, {later}"), np.nan, none
    violation = later.beyond(body.vertices)
    i = int(np.argmax(violation))
    lost = max(body.polytope.volume() - later.polytope.volume(), 0.0)
    if violation[i] <= TOLERANCE:
        what = f"all {len(violation)} vertices of X_N have a first input that stays"
        return Claim(True, f"{what} (largest violation {max(violation[i], 0.0):.1e})"), 0.0, none
    if violation[i] <= CLEAR:
        reason = f"a vertex is within {CLEAR:g} of the size of X_N, {violation[i]:.1e}"
        return Claim(None, reason), lost, none
    return every_input_leaves(body.vertices[i]), lost, body.vertices[violation > CLEAR]


def _longer(
    before: CenteredPolytope, body: CenteredPolytope, after: CenteredPolytope, deadline: float
) -> tuple[Claim, np.ndarray]:
    """Settle the weak claim by half-spaces alone: X_N ⊆ X_{N+1}, and X_N ⊆ X_{N−1}, so that a first
    input into X_N is that of a feasible plan. Return it and the states that are not in X_{N+1}.
    """
    tops = [body.support(normal) for normal in after.normals if time.monotonic() < deadline]
    if len(tops) < len(after.normals):
        return Claim(None, LATE), np.zeros((0, len(body.center)))
    violation = (np.array([top for top, _ in tops]) - after.offsets) / after.depths
    i = int(np.argmax(violation))
    outside = [x for (_, x), e in zip(tops, violation, strict=True) if e > CLEAR]
    seeds = np.array([x for x in outside if x is not None]).reshape(-1, len(body.center))
    if len(seeds):
        return every_input_leaves(seeds[0]), seeds
    nested = np.array([body.support(normal)[0] for normal in before.normals]) - before.offsets
    if max(violation[i], (nested / before.depths).max()) <= TOLERANCE:
        return Claim(True, f"X_N lies in X_N+1 and in X_N-1 ({len(tops)} facets, by LPs)"), seeds
    return Claim(None, "X_N lies in X_N+1, but not in X_N-1: its plans may lead elsewhere"), seeds


def no_input_stays(plans: PlanPolytope, state: np.ndarray) -> bool:
    """Return whether no feasible first input from `state` stays: it lies outside the states that
    can go on."""
    later = plans.followed()
    if not plans.exact:
        return False
    try:
        center = later.center()
        _, normal, offset = later.ray(center, state - center)
    except ValueError:  # flat, or the ray does not end
        return False
    return bool(normal @ state - offset > CLEAR * (offset - normal @ center))


def _by_theorem(mpc: MPC) -> Claim:
    """Settle the strong claim by Theorem 1: a plan shifted by one step and ended inside the
    terminal set is a plan.

    Under disturbances the terminal set must be invariant under the gain of the policy for all of
    them (Chisci, Rossiter & Zappa 2001). It covers limits on states and inputs alone, at the usual
    steps, and inputs free at each step. Without a terminal set, X takes its place at horizon N − 1.
    Convexity and compactness, which the theorem asks for, are used nowhere in this argument.
    """
    if mpc.disturbance is not None and mpc.policy == "tube":
        return Claim(None, "Theorem 1 is not checked for tubes")
    if not is_standard_form(mpc) or (mpc.terminal_set is None and mpc.horizon == 1):
        return Claim(None, "Theorem 1 does not cover these limits")
    last = mpc.states if mpc.terminal_set is None else mpc.terminal_set
    if not np.isfinite(set_bounds(last, mpc.system.n)).all():
        return Claim(None, "Theorem 1 is checked for bounded sets alone")
    K, disturbed = None, mpc.disturbance is not None
    try:
        K = feedback_gain(mpc) if disturbed else None
        costs, sets = (mpc.Q, mpc.R, mpc.terminal_cost), (mpc.terminal_set, mpc.states, mpc.inputs)
        against = mpc.disturbance, mpc.disturbance_matrix
        report = verify_terminal(mpc.system, *costs, *sets, K, *against)
    except ValueError as error:  # such as a set too long for its width
        return Claim(None, f"Theorem 1 is not checked ({error})")
    needed = [report["terminal set within states"], report["control invariance"]]
    if disturbed:  # the plan shifted by one step ends with K, whose answer to w it contains
        needed[1:] = [report["invariance under K"], report["inputs of K admissible"]]
    if all(check.holds for check in needed):
        what = "the terminal set" if mpc.terminal_set is not None else "the set of state limits"
        words = f"{what} is within the limits and control invariant"
        if disturbed:
            words = f"{what} is within the limits, and the gain keeps it for all disturbances"
        return Claim(True, f"Theorem 1: {words}. {needed[1].sentence}")
    missing = next(check for check in needed if not check.holds)
    return Claim(None, f"Theorem 1 does not apply: {missing.name}")


@record
class RegionVerdict:
    """What critical regions say of the law: the claim, the volume that it loses (NaN unless they
    are complete), states (K, n) from which it leads farthest outside X_N, and the regions."""

    claim: Claim
    lost: float
    worst: np.ndarray
    regions: CriticalRegions | None

    @classmethod
    def none(cls, dimension: int, reason: str = "they were not looked at") -> "RegionVerdict":
        """Return what is known without regions."""
        return cls(Claim(None, reason), np.nan, np.zeros((0, dimension)), None)


def settle_by_regions(
    claims: Claims, max_regions: int, deadline: float = np.inf, **references: Any
) -> RegionVerdict:
    """Settle the law claim by at most `max_regions` critical regions, found before the deadline.

    references: `reference` and `input_reference` that the law tracks, None for zero.
    On a region x⁺ is affine and its distance from X_N convex, hence largest at a vertex: where the
    regions are complete, the worst vertex is the worst state of X_N.
    """
    body, mpc = claims.feasible_set, claims.mpc
    assert body is not None
    none = np.zeros((0, claims.problem.dimension))
    try:
        if mpc.input_in_state:
            what = "its law depends on the previous input, and on disturbances"
            fail("mpc", what, "Regions of both are not compared with X_N")
        left = deadline - time.monotonic()
        found = critical_regions(mpc, max_regions=max_regions, seconds=left, **references)
    except ValueError as error:
        return RegionVerdict.none(claims.problem.dimension, f"no critical regions ({error})")
    A, B, c = host_matrices(mpc.system)
    violation, parts, lost = [-np.inf], [none], 0.0
    room = body.offsets - pushed(mpc, body)
    for region in found.regions:
        E, e = A + B @ region.K, B @ region.k + c
        after = (region.vertices @ E.T + e) @ body.normals.T
        beyond = (after - room) / body.depths
        violation.extend(beyond.max(axis=1))
        parts.append(region.vertices)
        # A law often leads a region exactly onto a facet: rounding must not take that for beyond.
        passed = beyond.max(axis=0) > CLEAR
        if found.complete and passed.any():
            H, h = np.asarray(region.polytope.H), np.asarray(region.polytope.h)
            normals, inside = body.normals[passed], (room - body.normals @ e)[passed]
            stays = Polytope(np.vstack([H, normals @ E]), np.append(h, inside))
            lost += region.volume - _volume(stays)
    values, states = np.array(violation[1:]), np.concatenate(parts)
    top, lost = values.max(initial=-np.inf), lost if found.complete else np.nan
    if top > CLEAR:
        worst = states[np.argsort(-values)[:6]]
        words = f"a critical region leads out of X_N, by {top:.6g} of a facet's depth"
        claim = Claim(False, words, worst[0])
        return RegionVerdict(claim, lost, worst, found)
    if not found.complete:
        claim = Claim(None, f"critical regions are incomplete: {found.reason}")
    elif top > TOLERANCE:
        claim = Claim(None, f"a region is within {CLEAR:g} of the size of X_N: {top:.1e}")
    else:
        count = f"{len(found)} critical regions fill X_N"
        claim = Claim(True, f"{count}, and the images of their vertices are in it")
        lost = 0.0
    return RegionVerdict(claim, lost, none, found)


def _volume(body: Polytope) -> float:
    """Return the volume of a polytope, 0 where it is empty or flat, NaN where it is not found."""
    try:
        return body.volume()
    except (Empty, Flat):
        return 0.0
    except ValueError:  # too ill-conditioned
        return np.nan


def every_input_leaves(state: np.ndarray) -> Claim:
    """Return the weak claim, refuted at a state."""
    reason = f"from x = {in_words(state)} every feasible first input leaves X_N"
    return Claim(False, reason, state)


def in_words(x: np.ndarray) -> str:
    """Return a vector as text, such as "(0.5, -1)", rounded to 9 decimals and 6 digits."""
    return "(" + ", ".join(f"{v:.6g}" for v in np.round(x, 9) + 0.0) + ")"
