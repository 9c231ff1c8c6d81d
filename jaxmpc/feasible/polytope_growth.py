"""The feasible set X_N as a polytope with all its facets, and how it grows with the horizon."""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from jaxmpc.checks import entries, fail, require_kind, whole
from jaxmpc.feasible.hard_constraints import augmented_dynamics
from jaxmpc.feasible.plan_polytope import (
    DIMENSIONS,
    FACETS,
    IS_EMPTY,
    IS_FLAT,
    CenteredPolytope,
    projected,
)
from jaxmpc.feasible.policy_problem import MORE_ROOM, NO_VOLUME, problem_of
from jaxmpc.mpc.plan import rate_ends
from jaxmpc.mpc.problem import HARD, MPC, RELAX, folded
from jaxmpc.pytrees import record
from jaxmpc.sets.convex_sets import Box, Ellipsoid, Polytope
from jaxmpc.sets.disturbances import disturbance_columns
from jaxmpc.sets.geometry import Empty, unit_rows
from jaxmpc.sets.predecessors import predecessor
from jaxmpc.systems.system import LinearSystem

# Why the facets of problems of many states with limited rates are not found, and what helps.
RATES = (
    "in more than four dimensions its facets are enumerated for limits of states and inputs alone. "
    "Make u_{k-1} a state and its change the input, as in docs/theory/recursive-feasibility.md"
)


def feasible_polytope(mpc: MPC) -> Polytope:
    """Return the feasible set X_N as a polytope, every facet once: {θ : some plan keeps every hard
    row}.

    θ is x, or (x, u_{−1}) where input rates are limited; a previous input u_{−1} is one that could
    be applied, within `mpc.inputs`. Equalities (a terminal point, two equal inputs) may be written
    as opposite rows. Facets come from the duals of linear
    programs and are valid; each vertex was reached by one, to 1e-9 of the set's size. For a map
    with proofs against rounding, slices, projections or an ellipsoidal terminal set use
    `map_feasible_set(...).refine()`; one step at a time, `predecessor`.

    In more than four dimensions X_N is computed by N steps of `predecessor` instead, for limits of
    states and inputs alone; that works if the limits couple few states.

    Raises ValueError where X_N is empty, flat or unbounded, for an ellipsoidal terminal set, and
    where there are too many facets. NumPy in float64; not traceable.
    """
    return _polytope(mpc, _all_facets(mpc))


def _polytope(mpc: MPC, body: CenteredPolytope | str) -> Polytope:
    """Return X_N as found by `_all_facets`; ValueError with the reason why it is not."""
    if not isinstance(body, str):
        return body.polytope
    cure = "Map it with map_feasible_set, which has no such limit"
    if body in (IS_EMPTY, IS_FLAT) and mpc.disturbance is not None and mpc.policy != "tightened":
        body, cure = f"its feasible set {NO_VOLUME}", MORE_ROOM
    elif "empty" in body:
        cure = RELAX
    elif "flat" in body:
        cure = "The regions of jm.explicit.critical_regions(mpc), in fewer dimensions, fill it"
    return fail("mpc", body, cure)


def _all_facets(mpc: MPC) -> CenteredPolytope | str:
    """Return X_N, or the reason why its facets are not found."""
    problem = problem_of(mpc)
    plans = problem.plan_polytope
    if not plans.exact:
        fail("terminal_set", "is an Ellipsoid, so X_N has a curved boundary", "Map it and refine()")
    if plans.p <= DIMENSIONS:
        return projected(plans)
    sets = backward(problem.mpc)
    return sets if isinstance(sets, str) else sets[1]


def any_policy_polytope(mpc: MPC) -> Polytope:
    """Return the states from which some policy keeps all limits under every disturbance: one whose
    inputs may be any function of the states so far.

    By dynamic programming, N steps of `predecessor` from the terminal set (without one, from the
    state limits): exact to rounding, whatever the policy of `mpc` is, whose sets lie inside it. A
    state outside is infeasible for every policy. Where input rates are limited states are
    (x, u_{−1}). Soft rows count as none, as in labels, and inputs are free at each step, also where
    `control_horizon` holds them. Where no policy does it is empty (`is_empty()`). Works as far as
    elimination goes. Raises ValueError for other
    limits than those of states, inputs and their rates at the usual steps, an ellipsoidal terminal
    set, and as `predecessor` does.
    """
    require_kind("mpc", mpc, MPC)
    mpc.validate()
    mpc.require_constant("steps back from the terminal set are all the same", *HARD)
    mpc = folded(mpc)
    if mpc.states is None:
        fail("states", "is None, and the steps back begin with their limits", "Give limits")
    for name, given, usual in (
        ("outputs", bool(mpc.outputs), ()),
        ("constrained_stages", mpc.constrained_stages is not None, None),
        ("constrain_initial", not mpc.constrain_initial, True),
    ):
        if given:
            what = "is given, and the steps back have limits of states, inputs and rates alone"
            if name == "outputs":
                what = "is given with D, or for stages of its own, and the steps back take neither"
            fail(name, what, f"Ask about dataclasses.replace(mpc, {name}={usual})")
    if isinstance(mpc.terminal_set, Ellipsoid):
        fail("terminal_set", "is an Ellipsoid, which has no facets", "Give a Polytope")
    if mpc.rate_limited:
        return _any_policy_of_rates(mpc)
    last: Any = mpc.terminal_set
    body, count = (mpc.states, mpc.horizon - 1) if last is None else (last, mpc.horizon)
    sides = mpc.states, mpc.inputs, mpc.disturbance, mpc.disturbance_matrix
    for _ in range(count):
        body = _step_back(mpc.system, body, *sides)
    return body if isinstance(body, Polytope) else body.to_polytope()


def _any_policy_of_rates(mpc: MPC) -> Polytope:
    """Return the same for states (x, u_{−1}), whose input is the change Δ of u: x⁺ = A x + B u_{−1}
    + B Δ + c + E w, and u_{−1} + Δ is the next u_{−1}."""
    n, m = mpc.system.n, mpc.system.m
    of_x, of_u = np.eye(n, n + m), np.eye(m, n + m, n)
    A, B, c = augmented_dynamics(mpc)  # of the input u = u_{−1} + Δ
    system = LinearSystem(A + B @ of_u, B, c=c)

    def lifted(body: Any, M: np.ndarray) -> Polytope:
        if body is None:
            return Polytope(np.zeros((0, n + m)), np.zeros(0))
        return body.to_polytope().preimage(M)

    limits = lifted(mpc.inputs, of_u)
    states = lifted(mpc.states, of_x).intersect(limits)
    # Without limits of x_N and u_{N−1} no change of the last step is too large.
    body = lifted(mpc.terminal_set, of_x).intersect(limits)
    free = not len(np.asarray(body.h))
    E = None
    if mpc.disturbance is not None:
        E = of_x.T @ disturbance_columns(mpc.disturbance_matrix, n)
    changes = Box(*(np.broadcast_to(np.asarray(v, float), (m,)) for v in rate_ends(mpc)))
    for k in range(mpc.horizon):
        if k == 0 and free:
            body = states
        else:
            body = _step_back(system, body, states, changes, mpc.disturbance, E)
    return body


def _step_back(system: LinearSystem, body: Any, *sides: Any) -> Polytope:
    """Return the predecessor of a set, empty as that may be."""
    try:
        return predecessor(system, body, *sides)
    except Empty:
        return Polytope.empty(system.n)


@record
class Growth:
    """Feasible sets at several horizons.

    horizons (H,): which. volume (H,), facets (H,): of each set, the volume and the number of
    facets, zeros where it is empty or flat. sets: the polytopes, None where there is no volume.
    """

    horizons: np.ndarray
    volume: np.ndarray
    facets: np.ndarray
    sets: tuple[Polytope | None, ...]


def feasible_growth(mpc: MPC, horizons: Sequence[int]) -> Growth:
    """Compute how X_N grows or shrinks with N: `feasible_polytope` at each of `horizons`.

    horizons: whole numbers N ≥ 1, in place of that of `mpc`.

    Raises ValueError where X_N is unbounded, and as `feasible_polytope` does for an ellipsoidal
    terminal set and too many facets, and where steps or blocks of `mpc` fit one horizon only.
    """
    require_kind("mpc", mpc, MPC)
    mpc.require_constant("it has the length of one horizon", *HARD)
    given = entries("horizons", horizons, "Give a list, such as [5, 10, 20]")
    every = [whole("horizons", N, 1) for N in given]
    sets = []
    for changed in (replace(mpc, horizon=N) for N in every):
        found = _all_facets(changed)
        nothing = isinstance(found, str) and found in (IS_EMPTY, IS_FLAT)
        sets.append(None if nothing else _polytope(changed, found))
    return Growth(
        horizons=np.array(every, int),
        volume=np.array([body.volume() if body else 0.0 for body in sets]),
        facets=np.array([len(np.asarray(body.h)) if body else 0 for body in sets]),
        sets=tuple(sets),
    )


def backward(
    mpc: MPC, deadline: float = np.inf
) -> tuple[CenteredPolytope, CenteredPolytope, CenteredPolytope] | str:
    """Return X_{N−1}, X_N and X_{N+1} by X_{k+1} = states ∩ Pre(X_k), or the reason why not.

    Half-spaces without vertices, by elimination (`predecessor`): for problems of many states
    whose limits couple few of them. Only for limits on states and inputs at the standard steps.
    """
    last: Any = mpc.terminal_set
    if mpc.rate_limited:
        return RATES
    if mpc.disturbance is not None:
        return "in more than four dimensions the facets of a robust problem are not enumerated"
    if (
        not is_standard_form(mpc)
        or not mpc.constrain_initial
        or mpc.states is None
        or mpc.horizon < 2
    ):
        return "its facets are enumerated for limits of states and inputs alone"
    if isinstance(last, Ellipsoid):
        return "the terminal set has no facets"
    # Without a terminal set x_0 ∈ X is all that a horizon of 1 asks.
    body, count = (mpc.states, mpc.horizon) if last is None else (last, mpc.horizon + 1)
    found = []
    for k in range(count):
        try:
            body = predecessor(mpc.system, body, mpc.states, mpc.inputs).require_body().reduce()
        except ValueError as error:
            return f"its facets are not found ({error})"
        if time.monotonic() > deadline or np.asarray(body.h).size > FACETS // 4:
            return "its facets are too many to enumerate in the time given"
        if k >= count - 3:
            found.append(body)
    if last is None and mpc.horizon == 2:
        found = [mpc.states.to_polytope() if isinstance(mpc.states, Box) else mpc.states, *found]
    none = np.zeros((0, mpc.system.n))
    one, two, three = (
        CenteredPolytope(part.chebyshev()[0], *unit_rows(part.H, part.h), none)
        for part in found[-3:]
    )
    return one, two, three


def is_standard_form(mpc: MPC) -> bool:
    """Return whether limits are on states and inputs alone, at the standard steps, with inputs free
    at each step."""
    free = not (mpc.outputs or mpc.rate_limited) and mpc.control_horizon is None
    return free and mpc.constrained_stages is None and not mpc.differs(*HARD)
