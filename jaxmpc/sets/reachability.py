"""Sets that x+ = A x + B u + c + w reaches within some steps, or from which it reaches a set."""

from typing import Literal

import numpy as np

from jaxmpc.checks import fail, require_kind, whole
from jaxmpc.sets.convex_sets import LinearSet, Polytope, as_polytope
from jaxmpc.sets.predecessors import one_step
from jaxmpc.systems.system import LinearSystem, host_matrices

DIRECTIONS = ("forward", "backward")


def reachable_sets(
    system: LinearSystem,
    X0: LinearSet,
    inputs: LinearSet | None,
    disturbance: LinearSet | None = None,
    steps: int = 1,
    direction: Literal["forward", "backward"] = "forward",
    *,
    states: LinearSet | None = None,
) -> tuple[LinearSet, ...]:
    """Return the sets X_0, X_1, ..., X_steps that the states run through, forward or backward.

    Forward: X_{k+1} = {A x + B u + c + w : x in X_k, u in inputs, w in disturbance} & states, the
    states that can be reached in k steps. Backward: X_{k+1} = {x in states : there is u in inputs
    with A x + B u + c + w in X_k for all w in disturbance}, the states from which X_0 can be
    reached in exactly k steps whatever the disturbance: the k-step controllable sets, and where
    X_0 is control invariant, the stabilisable sets, of which each holds the one before.

    Arguments:
        system: n states, m inputs; A may be singular, c may be anything.
        X0: the first set: Box, Polytope or Zonotope in R^n; it may be flat, or a point.
        inputs: set in R^m, or None for all of R^m. Box([0], [0]) stands for no input.
        disturbance: set in R^n, or None for w = 0. Backward it must be bounded and hold 0.
        steps: how many sets after X_0, at least 0.
        direction: "forward" or "backward".
        states: set in R^n within which all states but those of X_0 must lie, or None.

    Returns steps + 1 sets. Forward they are Zonotopes, exact in any dimension, where X_0, inputs
    and disturbance are Zonotopes or bounded Boxes and `states` is None; else Polytopes with
    irredundant rows, by sums of vertices. Backward they are Polytopes, by `predecessor`. Once a
    set is empty, so are those after it. NumPy in float64; not traceable.

    Raises ValueError for wrong shapes and empty arguments.

    Source: Kerrigan 2000, thesis, Cambridge, sections 2.3 to 2.5.
    """
    if direction not in DIRECTIONS:
        fail("direction", f"{direction!r}", 'Give "forward" or "backward"')
    require_kind("system", system, LinearSystem)
    count = whole("steps", steps, 0)
    first = _checked("X0", X0, system.n)
    if first is None:
        fail("X0", "is None", "Give a Box, Polytope or Zonotope")
    if direction == "backward":
        return _backward(system, as_polytope("X0", first), inputs, disturbance, count, states)
    return _forward(system, first, inputs, disturbance, count, states)


def _checked(argument: str, value: LinearSet | None, n: int) -> LinearSet | None:
    """Return a set in R^n, checked; None for None."""
    if value is None:
        return None
    if not isinstance(value, LinearSet):
        fail(argument, f"{type(value).__name__} is no Box, Polytope or Zonotope", "Give one")
    value = value.spread(n)
    value.validate(argument, n)
    return value


def _forward(
    system: LinearSystem,
    first: LinearSet,
    inputs: LinearSet | None,
    disturbance: LinearSet | None,
    steps: int,
    states: LinearSet | None,
) -> tuple[LinearSet, ...]:
    system.validate()
    A, B, c = host_matrices(system)
    U, W = _checked("inputs", inputs, system.m), _checked("disturbance", disturbance, system.n)
    X = _checked("states", states, system.n)
    everything = Polytope(np.zeros((0, system.m)), np.zeros(0))
    added = (everything if U is None else U).image(B, c)
    added = added if W is None else added + W
    found, last = [first], first
    for _ in range(steps):
        last = last.image(A) + added
        last = last if X is None else last & X
        last = last.reduce() if isinstance(last, Polytope) else last
        found.append(last)
    return tuple(found)


def _backward(
    system: LinearSystem,
    target: Polytope,
    inputs: LinearSet | None,
    disturbance: LinearSet | None,
    steps: int,
    states: LinearSet | None,
) -> tuple[LinearSet, ...]:
    step = one_step(system, inputs, disturbance)
    X = None if states is None else as_polytope("states", states, step.n)
    found, last = [target], target
    for _ in range(steps):
        last = last if last.is_empty() else step.back(last, X)
        found.append(last)
    return tuple(found)
