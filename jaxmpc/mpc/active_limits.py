"""active_constraints: which limits of a plan are active, by name, step and unit."""

from dataclasses import dataclass

import numpy as np

from jaxmpc.mpc.plan import Plan, flat_multipliers
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.rows import blocks, layout, row_table
from jaxmpc.sets.ellipsoid import Ellipsoid


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
        name = (
            self.name if self.name.startswith(self.constraint) else f"{self.constraint} {self.name}"
        )
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
    table = row_table(mpc)
    y = np.asarray(flat_multipliers(layout(mpc), plan.multipliers), np.float64)
    found = []
    last = isinstance(mpc.terminal_set, Ellipsoid)
    slack = np.asarray(plan.slack)
    column = soft_columns(mpc)
    for i, (row, value) in enumerate(zip(table, y, strict=True)):
        if abs(value) > tolerance and not (last and row.kind == "terminal"):
            broken = slack[row.stage, column[i]] if row.soft else 0.0
            found.append(
                ActiveConstraint(
                    row.kind, row.name, row.unit, row.stage, "upper" if value > 0 else "lower",
                    float(abs(value)), float(broken),
                )
            )  # fmt: skip
    if last:
        push = float(np.linalg.norm(np.asarray(plan.multipliers.terminal)))
        if push > tolerance:
            found.append(ActiveConstraint("terminal", "ellipsoid", "", mpc.horizon, "radius", push))
    return tuple(sorted(found, key=lambda constraint: -constraint.multiplier))


def soft_columns(mpc: MPC) -> dict[int, int]:
    """Column of `Plan.slack` for each soft row of the condensed QP."""
    offset, first, columns = 0, 0, {}
    for b in blocks(mpc, float):
        if b.linear is not None:
            for j in range(len(b.steps) * b.size):
                columns[offset + j] = first + j % b.size
            first += b.size
        offset += len(b.steps) * b.size
    return columns
