"""RecursionReport: all that is known about the recursive feasibility of one MPC problem."""

from typing import Any

import numpy as np

from jaxmpc.mpc.problem import MPC
from jaxmpc.pytrees import record
from jaxmpc.recursion.claims import Claim, Counterexample
from jaxmpc.recursion.sampled_loops import SampledLoops
from jaxmpc.sets.polytope import Polytope


@record
class RecursionReport:
    """What is known about the recursive feasibility of one MPC problem.

    counterexample: the worst one to the law that was found, or None. feasible_set: X_N (half-spaces
    valid and vertices reached, to 1e-9 of its size), None where facets were not enumerated. volume:
    of X_N; lost_by_any: of the part from which every first input leaves X_N; lost_by_law: of the
    part from which the optimal one does, from critical regions. NaN where not computed. loops: from
    the sample states, none where the law is proved and no states were given, or without time.
    """

    mpc: MPC
    strong: Claim
    law: Claim
    weak: Claim
    counterexample: Counterexample | None
    feasible_set: Polytope | None
    volume: float
    lost_by_any: float
    lost_by_law: float
    loops: SampledLoops
    seconds: float

    @property
    def claims(self) -> dict[str, Claim]:
        """Return the three claims by name, the strongest first."""
        return {"strong": self.strong, "law": self.law, "weak": self.weak}

    def __str__(self) -> str:
        """Return the claims with reasons, the worst counterexample, volumes and counts, one a
        line."""
        rows = [(name, str(claim)) for name, claim in self.claims.items()]
        if self.counterexample is not None:
            rows.append(("worst", f"{self.counterexample} (found by {self.counterexample.found})"))
        if np.isfinite(self.volume):
            rows.append(("volume", f"{self.volume:.9g}"))
        for name, lost in (("lost by any", self.lost_by_any), ("lost by law", self.lost_by_law)):
            if np.isfinite(lost):
                rows.append((name, f"{lost:.9g}  {lost / self.volume:.4%}"))
        counts = self.loops.counts()
        feasible = counts.pop("feasible")
        if len(self.loops.x0s):
            rows.append(("feasible", f"{feasible:>10,}"))
            for name, count in counts.items():
                rows.append((name, f"{count:>10,}  {count / max(feasible, 1):8.3%}"))
        else:
            why = "its law is proved" if self.law.holds else "no time was left for them"
            rows.append(("samples", f"none: {why}"))
        return "\n".join(f"  {name:<20} {value}" for name, value in rows)

    __repr__ = __str__

    def to_xarray(self) -> Any:
        """Return the loops as an xarray.Dataset along the dimension `sample`, names attached."""
        import xarray

        loops, system = self.loops, self.mpc.system
        data = {
            "state": (("sample", "coordinate"), loops.x0s),
            "label": ("sample", loops.label),
            "input": (("sample", "move"), loops.inputs),
            "next_state": (("sample", "coordinate"), loops.next_states),
            "lost_at": ("sample", loops.lost_at),
            "undecided_at": ("sample", loops.undecided_at),
        }
        coordinates = list(self.mpc.labels[: loops.x0s.shape[1]])
        names = {"coordinate": coordinates, "move": list(system.input_labels)}
        return xarray.Dataset(data, coords=names, attrs={"steps": loops.steps})
