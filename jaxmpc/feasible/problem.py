"""Which initial states have inputs that keep all hard constraints: this, transcribed once."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from jaxmpc.feasible import constraint_rows, exact_data
from jaxmpc.feasible.constraint_rows import ConstraintRows
from jaxmpc.feasible.exact_data import ExactData
from jaxmpc.feasible.plan_polytope import PlanPolytope
from jaxmpc.feasible.row_programs import RowPrograms
from jaxmpc.feasible.view import View, make_view
from jaxmpc.mpc.condense import Condensed
from jaxmpc.mpc.inequalities import condensed_in_float64
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.rows import Block


@dataclass(frozen=True, eq=False)
class FeasibilityProblem:
    """The hard constraints of an MPC problem, and which initial states points θ (d,) stand for.

    mpc: the problem without soft rows and weights of input rates, which have no part in what is
    feasible. view: all states, a slice or a projection. Everything else follows from these two, on
    the host in float64, and is made once, when it is first asked for.
    """

    mpc: MPC
    view: View

    @classmethod
    def of(cls, mpc: MPC, axes: Any = None, fixed: Any = None) -> "FeasibilityProblem":
        """The feasibility problem of `mpc`; axes, fixed: the view, as in `map_feasible_set`.

        Raises ValueError for an ill-posed problem and for a wrong view.
        """
        mpc.validate()
        hard = replace(mpc, soft=(), input_rate_weight=None)
        return cls(hard, make_view(hard, axes, fixed))

    @property
    def dimension(self) -> int:
        """d, the number of coordinates of θ."""
        return len(self.view.axes)

    @property
    def labels(self) -> tuple[str, ...]:
        """Labels of these coordinates, with units."""
        return tuple(self.mpc.labels[i] for i in self.view.axes)

    @cached_property
    def condensed(self) -> Condensed:
        """The condensed problem, of all states."""
        return condensed_in_float64(self.mpc)

    @cached_property
    def blocks(self) -> list[Block]:
        """The blocks of hard rows, in the order of the condensed rows."""
        return exact_data.hard_blocks(self.mpc)

    @cached_property
    def rows(self) -> ConstraintRows:
        """The condensed rows in θ and an orthonormal basis."""
        return constraint_rows.constraint_rows(self.mpc, self.view, self.condensed, self.blocks)

    @cached_property
    def programs(self) -> RowPrograms:
        """Linear programs over `rows`."""
        return RowPrograms(self.rows)

    @cached_property
    def plan_polytope(self) -> PlanPolytope:
        """The polytope of all states and the decisions that keep all rows, whatever the view."""
        return PlanPolytope.of(self.condensed)

    def exact(self, region: np.ndarray, size: np.ndarray | None = None) -> ExactData:
        """The exact data that proofs work on.

        region (d,): how far |θ| is looked at, of use where linear programs find the feasible set
        empty. size (d,): how large θ typically is, None where it is as large as the set; by this is
        chosen how rounding errors are bounded, not whether they are.
        """
        extent, _ = self.programs.bounding_box
        extent = np.array([-region, region]) if extent is None else extent
        return exact_data.exact_data(self.mpc, self.view, self.blocks, extent, size)
