"""Hard limits made soft, and soft ones hard."""

from dataclasses import replace
from functools import reduce

import numpy as np

from jaxmpc.arrays import Reals
from jaxmpc.checks import concrete, fail, require_kind
from jaxmpc.mpc.problem import MPC, Outputs, Soft, as_tuple, output_stages
from jaxmpc.sets.convex_sets import Ellipsoid, Polytope
from jaxmpc.sets.limits import output_limits


def soften(mpc: MPC, rho: Reals, quadratic: Reals = 0.0) -> MPC:
    """The same problem with all state, output and terminal rows soft; inputs and rates stay hard.

    rho, quadratic: weights of every row, as in `Soft`. Rows keep their units: a violation is
    measured as H x − h in the row as given. Raises ValueError for an Ellipsoid as terminal set,
    which has no rows.
    """
    require_kind("mpc", mpc, MPC)
    mpc.validate()
    if isinstance(mpc.terminal_set, Ellipsoid):
        fail("terminal_set", "is an Ellipsoid, which stays hard", "Use a Polytope inside it")
    hard = []
    for kind, limits, stages in (
        ("state", mpc.states, mpc.state_stages),
        ("terminal", mpc.terminal_set, (mpc.horizon,)),
    ):
        if limits is not None:
            C, lower, upper = limits.rows()
            names, units = mpc.system.state_names, mpc.system.state_units
            if isinstance(limits, Polytope):
                names, units = limits.labels, ()
            names = names or _numbered(kind, np.size(lower))
            hard.append(Outputs(C, lower, upper, None, stages, names, units))
    for rows in as_tuple("outputs", mpc.outputs, Outputs):
        names = rows.names or _numbered("output", np.size(rows.sides[0]))
        hard.append(replace(rows, stages=output_stages(mpc, rows), names=names))
    soft = list(as_tuple("soft", mpc.soft, Soft))
    for rows in filter(None, map(_with_limits, hard)):
        below, above = rows.sides
        one_sided = concrete(below) and not np.isfinite(below).any()
        more = (rows.D, rows.stages, rows.names, rows.units)
        soft.append(Soft(rows.C, None if one_sided else below, above, rho, quadratic, *more))
    softened = replace(mpc, states=None, terminal_set=None, outputs=(), soft=tuple(soft))
    softened.validate()
    return softened


def _numbered(kind: str, count: int) -> tuple[str, ...]:
    return tuple(f"{kind} row {i + 1}" for i in range(count))


def _with_limits(rows: Outputs) -> Outputs | None:
    """Return the rows with a finite limit, None where there are none. Limits inside a trace cannot
    be read: all their rows are taken."""
    if not rows.stages or not concrete(rows):
        return rows if rows.stages else None
    lower, upper = rows.sides
    bounded = np.isfinite(lower) | np.isfinite(upper)
    keep = lambda v: np.asarray(v)[bounded]
    text = lambda v: tuple(str(part) for part in keep(v)) if v else ()
    limited = replace(
        rows,
        C=keep(rows.C),
        lower=keep(lower),
        upper=keep(upper),
        D=None if rows.D is None else keep(rows.D),
        names=text(rows.names),
        units=text(rows.units),
    )
    return limited if bounded.any() else None


def harden(mpc: MPC) -> MPC:
    """The same problem with every soft row hard: what a large enough penalty enforces where it can.

    The opposite of `soften`: rows that hold at all steps of the state limits join `states`, rows at
    k = N the terminal set, where these are not sets of another kind; the rest become `outputs`.
    """
    N, every = mpc.horizon, mpc.state_stages
    states, terminal, outputs = [], [], list(as_tuple("outputs", mpc.outputs, Outputs))
    for s in as_tuple("soft", mpc.soft, Soft):
        steps = tuple(range(N + (s.D is None))) if s.stages is None else s.stages
        lower, upper = s.sides
        rows = Polytope(s.C, upper, s.names)
        if s.lower is not None:
            rows = output_limits(s.C, lower, upper, s.names, s.units)
        whole = s.D is None and every and set(every) <= set(steps) <= {*every, N}
        if whole and mpc.states is None:
            states.append(rows)
            steps = tuple(set(steps) - set(every))
        if s.D is None and steps == (N,) and mpc.terminal_set is None:
            terminal.append(rows)
            steps = ()
        if steps:
            outputs.append(Outputs(s.C, lower, upper, s.D, steps, s.names, s.units))
    join = lambda given, found: reduce(Polytope.intersect, found) if found else given
    sets = {"states": join(mpc.states, states), "terminal_set": join(mpc.terminal_set, terminal)}
    return replace(mpc, soft=(), outputs=tuple(outputs), **sets)
