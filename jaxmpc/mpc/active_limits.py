"""active_constraints: which limits of a plan are active, by name, step and unit."""

from dataclasses import dataclass

import numpy as np

from jaxmpc.mpc.plan import Plan, flat_multipliers
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.rows import blocks, layout, row_table
from jaxmpc.sets.convex_sets import Ellipsoid


@dataclass(frozen=True)
class ActiveConstraint:
    """One limit that shapes a plan.

    constraint: kind of the row (see `Row`). name, unit: of the quantity that is bounded. stage: its
    k. bound: "upper" or "lower". multiplier > 0: by how much the least cost J (without ½) falls for
    each unit that this one bound is relaxed. For an ellipsoid bound is "radius", the root of its
    level. violation: how far a soft row is broken.
    """

    constraint: str
    name: str
    unit: str
    stage: int
    bound: str
    multiplier: float
    violation: float = 0.0

    def __str__(self) -> str:
        unit = f" per {self.unit}" if self.unit else ""
        broken = f", broken by {self.violation:.3g} {self.unit}".rstrip() if self.violation else ""
        name = self.name
        if not name.startswith(self.constraint):
            name = f"{self.constraint} {name}"
        return f"{name}, {self.bound} at k = {self.stage}: {self.multiplier:.6g}{unit}{broken}"


def active_constraints(
    mpc: MPC, plan: Plan, tolerance: float = 1e-6
) -> tuple[ActiveConstraint, ...]:
    """The limits with a multiplier above `tolerance`, largest first.

    plan: of `mpc`, one instance. The multiplier of a bound is the sensitivity of the optimal cost:
    dJ*/d(bound) = −multiplier for an upper bound, +multiplier for a lower one. Where rows coincide
    (inputs of one block of a control horizon, states at N beside the terminal set) they share it in
    an arbitrary way: only their sum is a sensitivity, of relaxing all of them. NumPy; not
    traceable.
    """
    y = np.asarray(flat_multipliers(layout(mpc), plan.multipliers), np.float64)
    ball = isinstance(mpc.terminal_set, Ellipsoid)
    slack, columns = np.asarray(plan.slack), soft_columns(mpc)
    found = []
    for row, column, value in zip(row_table(mpc), columns, y, strict=True):
        if abs(value) > tolerance and not (ball and row.kind == "terminal"):
            bound, broken = "upper" if value > 0 else "lower", 0.0
            if column is not None:
                broken = float(slack[row.stage, column])
            where = row.kind, row.name, row.unit, row.stage
            found.append(ActiveConstraint(*where, bound, float(abs(value)), broken))
    push = float(np.linalg.norm(np.asarray(plan.multipliers.terminal))) if ball else 0.0
    if push > tolerance:
        found.append(ActiveConstraint("terminal", "ellipsoid", "", mpc.horizon, "radius", push))
    return tuple(sorted(found, key=lambda constraint: -constraint.multiplier))


def soft_columns(mpc: MPC) -> list[int | None]:
    """Column of `Plan.slack` for each row of the condensed QP, None for hard ones."""
    columns: list[int | None] = []
    first = 0
    for b in blocks(mpc, float):
        hard = b.linear is None
        columns += [None if hard else first + j for _ in b.steps for j in range(b.size)]
        first += 0 if hard else b.size
    return columns
