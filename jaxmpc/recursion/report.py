"""All that is known about the recursive feasibility of one MPC problem, in words and as files."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.files import remove_files, sha256, versions, write_arrays, write_results
from jaxmpc.mpc.problem import MPC
from jaxmpc.pytrees import record
from jaxmpc.recursion.counterexamples import Counterexample, SampledLoops
from jaxmpc.recursion.proofs import Claim
from jaxmpc.sets.convex_sets import Polytope

# The files of a report in its folder.
FILES = ("summary.json", "recursion.npz", "recursion.png")
# Where counterexamples are found.
FOUND = {
    "regions": "at a vertex of a critical region",
    "search": "by gradient ascent over the regions",
    "sample": "by a closed loop from a sample",
}


@record
class RecursionReport:
    """What is known about the recursive feasibility of one MPC problem.

    strong: the claim that every feasible first input leads back into X_N. law: that the optimal
    one does. weak: that some one does.
    counterexample: the worst one to the law that was found, or None. feasible_set: X_N (half-spaces
    valid and vertices reached, to 1e-9 of its size), None where facets were not enumerated.
    volume: of X_N, NaN where not computed, as in the next two.
    lost_by_any: volume of the part from which every first input leaves X_N. lost_by_law: of that
    from which the optimal one does, from critical regions.
    loops: from the sample states, none where the law is proved and no states were given, or without
    time. seconds: that the call took. needed: where loops were left out for want of time, the
    seconds with which there are some; else 0.
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
    needed: int = 0

    @property
    def claims(self) -> dict[str, Claim]:
        """Return the three claims by name, the strongest first."""
        return {"strong": self.strong, "law": self.law, "weak": self.weak}

    def __str__(self) -> str:
        """Return the claims with reasons, the worst counterexample, volumes and counts, one a
        line."""
        rows = [(name, str(claim)) for name, claim in self.claims.items()]
        if self.counterexample is not None:
            rows.append(("worst", f"{self.counterexample} ({FOUND[self.counterexample.found]})"))
        if np.isfinite(self.volume):
            rows.append(("volume", f"{self.volume:.9g}{self.mpc.volume_unit()}"))
        parts = ("lost, any input", self.lost_by_any), ("lost, optimal input", self.lost_by_law)
        for name, lost in parts:
            if np.isfinite(lost):
                rows.append((name, f"{lost:.9g}  {lost / self.volume:.4%} of the volume"))
        counts = self.loops.counts()
        feasible = counts.pop("feasible")
        if len(self.loops.x0s):
            rows.append(("samples", f"{len(self.loops.x0s):>10,}  of {self.loops.steps} steps"))
            rows.append(("- feasible", f"{feasible:>10,}"))
            unknown = int(np.sum(self.loops.label == 0))
            if unknown:
                rows.append(("- without a label", f"{unknown:>10,}"))
            for name, count in counts.items():
                why = f" ({self.loops.why_undecided()})" if name == "undecided" and count else ""
                share = f"{count / max(feasible, 1):8.3%} of the feasible{why}"
                rows.append((f"- {name.replace('one', '1')}", f"{count:>10,}  {share}"))
        else:
            rows.append(("samples", f"none: {self._why_no_samples()}"))
        if self.needed:
            what = "or more of recursive feasibility, for closed loops and what they compile"
            rows.append(("seconds needed", f"{self.needed} {what}"))
        return "\n".join(f"  {name:<20} {value}" for name, value in rows)

    __repr__ = __str__

    def _why_no_samples(self) -> str:
        """Return why no loops were simulated."""
        if self.law.holds:
            return "its law is proved"
        if self.mpc.disturbance is not None:
            return "those of a robust problem are not followed; jm.simulate(..., disturbance=) does"
        return "no time was left for them"

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


@record
class SmallestHorizon:
    """The least horizon at which the law is proved recursively feasible, None where none was found.

    horizon: that one. strong: the least at which every feasible first input is proved to stay
    (None: none). reasons: the claim about the law at each horizon looked at. max_horizon: the
    largest of these.
    """

    horizon: int | None
    strong: int | None
    reasons: dict[int, Claim]
    max_horizon: int

    def __str__(self) -> str:
        """Return the smallest horizon with its reason, or that none is proved."""
        if self.horizon is None:
            return f"none up to {self.max_horizon} is proved"
        strong = f"; strong from {self.strong}" if self.strong is not None else ""
        return f"{self.horizon} ({self.reasons[self.horizon].reason}){strong}"

    __repr__ = __str__


def save_report(
    folder: Path, report: RecursionReport, config: dict[str, Any], least: SmallestHorizon | None
) -> None:
    """Write recursion.npz and summary.json, which `jaxmpc verify` proves again, and remove a
    picture of an earlier report.

    report: of `recursive_feasibility`. config: JSON data that the problem is made of, with its
    name. least: the smallest horizon, where it was looked for.
    """
    loops, body, worst = report.loops, report.feasible_set, report.counterexample
    facets = {}
    if body is not None:
        facets = {"facet_normals": np.asarray(body.H), "facet_offsets": np.asarray(body.h)}
    remove_files(folder, *FILES)
    arrays = folder / "recursion.npz"
    # Labels under policies of more than one sequence of inputs are not stored.
    plain = report.mpc.disturbance is None or report.mpc.policy == "tightened"
    problem = {"problem": FeasibilityProblem.of(report.mpc).plain() if plain else None}
    found = {name: getattr(loops, name) for name in ("lost_at", "undecided_at")}
    found |= {"state": loops.x0s, "input": loops.inputs, "next_state": loops.next_states}
    write_arrays(arrays, problem, **facets, **loops.labels.arrays(), **found)
    summary = {
        "name": config["name"],
        "claims": {name: dataclasses.asdict(claim) for name, claim in report.claims.items()},
        "counterexample": None if worst is None else dataclasses.asdict(worst),
        "volume": report.volume,
        "lost_by_any": report.lost_by_any,
        "lost_by_law": report.lost_by_law,
        "counts": loops.counts(),
        "steps": loops.steps,
        "seconds": report.seconds,
        "needed": report.needed,
        "config": config,
        "sha256": sha256(arrays),
        "versions": versions(),
    }
    if least is not None:
        summary["smallest_horizon"] = dataclasses.asdict(least)
    write_results(folder / "summary.json", summary)
