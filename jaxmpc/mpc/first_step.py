"""The problem whose first step stays in a robust control invariant set: recursively feasible."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from jaxmpc.arrays import Reals
from jaxmpc.checks import fail, require_kind
from jaxmpc.mpc.problem import MPC, Outputs, as_tuple
from jaxmpc.sets.convex_sets import Box, ConvexSet, Polytope, as_polytope
from jaxmpc.sets.disturbances import disturbance_set, supports
from jaxmpc.systems.system import LinearSystem, host_matrices


def first_step_in(
    mpc: MPC,
    invariant: Box | Polytope,
    *,
    systems: Sequence[LinearSystem] = (),
    disturbance: ConvexSet | None = None,
    disturbance_matrix: Reals | None = None,
) -> MPC:
    """Return the problem with one more demand: x_1 lies in a set, whatever plant and disturbance.

    Adds the rows A_i x_0 + B_i u_0 + c_i + E w ∈ invariant for all i and all w in disturbance, on
    the first step alone; the other steps stay nominal. If the set is robust control invariant
    within the state limits (`maximal_control_invariant_set` with the same systems and disturbance)
    every state of it has a plan, and every plan leads back into it: the controller is recursively
    feasible and keeps the limits, without tube or terminal set, from all of it.

    Arguments:
        mpc: a nominal problem, without a terminal set, which could be out of reach.
        invariant: the set that x_1 lies in: Box or Polytope in R^n.
        systems: the vertices (A_i, B_i, c_i) of the hull that the plant stays in; none: mpc.system.
        disturbance: bounded set in R^p that holds the origin, or None for w = 0.
        disturbance_matrix: E (n, p), None for the identity.

    The plan of `mpc.system` must be one that the set allows: a system in the hull. Raises
    ValueError for wrong arguments.
    """
    require_kind("mpc", mpc, MPC)
    mpc.validate()
    if mpc.disturbance is not None:
        cure = "Give it to first_step_in alone: the later steps stay nominal"
        fail("mpc.disturbance", "given beside a set that the first step stays in", cure)
    if mpc.terminal_set is not None:
        fail("mpc.terminal_set", "may be out of reach from the set", "Leave it out")
    if mpc.control_horizon is not None or mpc.rate_limited:
        what = "has inputs that are held or whose rates are limited, which the set knows nothing of"
        fail("mpc", what, "Leave control_horizon and input_rate_limit out")
    n, m = mpc.system.n, mpc.system.m
    H, h = as_polytope("invariant", invariant, n).unit_rows("invariant")
    reach = supports(disturbance_set(disturbance, n, disturbance_matrix), H)
    added: list[Any] = []
    for system in systems or (mpc.system,):
        require_kind("systems", system, LinearSystem)
        system.validate()
        if (system.n, system.m) != (n, m):
            what = f"holds one of {system.n} states and {system.m} inputs"
            fail("systems", what, f"Give systems of {n} and {m}, as mpc has them")
        A, B, c = host_matrices(system)
        names = tuple(f"row {i + 1} of the set after one step" for i in range(len(h)))
        added.append(Outputs(H @ A, None, h - H @ c - reach, D=H @ B, stages=(0,), names=names))
    outputs = as_tuple("outputs", mpc.outputs, Outputs)
    return replace(mpc, outputs=(*outputs, *added))
