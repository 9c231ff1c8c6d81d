"""What is known about recursive feasibility: claims, the worst counterexample, states lost."""

from typing import Any

import numpy as np

from jaxmpc.feasible.labels import Labels
from jaxmpc.mpc.problem import MPC
from jaxmpc.pytrees import record
from jaxmpc.sets.polytope import Polytope

# `lost_at` of samples that are infeasible from the start, and of those that were not decided.
NOT_FEASIBLE, UNDECIDED = -1, -2


@record
class Claim:
    """A claim: holds True (proved), False (refuted) or None (open); and why.

    state (p,): where it is refuted, the state of the counterexample; else None.
    """

    holds: bool | None
    reason: str
    state: np.ndarray | None = None

    def __str__(self) -> str:
        return f"{ {True: 'proved', False: 'refuted', None: 'open'}[self.holds] }: {self.reason}"


@record
class Counterexample:
    """A feasible state whose optimal first move leads to an infeasible one.

    state x (p,) is feasible by proof: `feasible_inputs` (N, m) keep all rows in a float64 roll-out
    with margins above rounding. inputs (N, m): the optimal plan, to the given residuals.
    next_state: A x + B u_0 + c. The half-space normal'x ≤ offset holds on the whole feasible set,
    by proof, and excludes next_state by `distance` = (normal'x⁺ − offset)/|normal|. found:
    "search", "sample" or "regions". Where input rates are limited, states are (x, u_{−1}).
    """

    state: np.ndarray
    inputs: np.ndarray
    next_state: np.ndarray
    normal: np.ndarray
    offset: float
    distance: float
    feasible_inputs: np.ndarray
    primal_residual: float
    dual_residual: float
    found: str

    def __str__(self) -> str:
        return (
            f"from x = {in_words(self.state)} the optimal u = {in_words(self.inputs[0])} leads to "
            f"{in_words(self.next_state)}, outside the feasible set by {self.distance:.6g}"
        )


@record
class RecursionReport:
    """What is known about the recursive feasibility of one MPC problem.

    strong, law, weak: `Claim`s. counterexample: the worst one to the law that was found, or None.
    feasible_set: X_N (half-spaces valid and vertices reached, to 1e-9 of its size), None where
    facets were not enumerated. volume: of X_N; lost_by_any: of the part from which every first
    move leaves X_N; lost_by_law: of the part from which the optimal one does, from critical
    regions. NaN where not computed.

    states (B, p): the samples, none where the law is proved and none were given, or without time.
    label (B,): 1 proved feasible, −1 proved infeasible, 0 undecided.
    inputs (B, m), next_states (B, p): the optimal first move and where it leads (NaN where
    label ≠ 1). lost_at (B,): first step k ≥ 1 of the closed loop at which the problem is proved
    infeasible; 0: feasible at all `steps`; −1: not proved feasible at the start; −2: undecided,
    from step undecided_at (B,) on (0 elsewhere). labels: the labels with their proofs.
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
    states: np.ndarray
    label: np.ndarray
    inputs: np.ndarray
    next_states: np.ndarray
    lost_at: np.ndarray
    undecided_at: np.ndarray
    steps: int
    seconds: float
    labels: Labels | None = None

    @property
    def S(self) -> bool | None:
        """Return whether every feasible first move stays: `strong.holds`."""
        return self.strong.holds

    @property
    def M(self) -> bool | None:
        """Return whether the MPC law stays, that is recursive feasibility: `law.holds`."""
        return self.law.holds

    @property
    def W(self) -> bool | None:
        """Return whether some feasible first move stays: `weak.holds`."""
        return self.weak.holds

    def counts(self) -> dict[str, int]:
        """Return how many samples are feasible, and how many of these are lost at once, lost later,
        kept, undecided."""
        lost = self.lost_at
        return {
            "feasible": int(np.sum(self.label == 1)),
            "lost after one step": int(np.sum(lost == 1)),
            "lost later": int(np.sum(lost > 1)),
            "kept": int(np.sum(lost == 0)),
            "undecided": int(np.sum(lost == UNDECIDED)),
        }

    def __str__(self) -> str:
        """Return the claims with reasons, the worst counterexample, volumes and counts, one a
        line."""
        rows = [(name, str(getattr(self, name))) for name in ("strong", "law", "weak")]
        if self.counterexample is not None:
            rows.append(("worst", f"{self.counterexample} (found by {self.counterexample.found})"))
        volumes = ("volume", self.volume), ("lost by any", self.lost_by_any)
        for name, value in (*volumes, ("lost by law", self.lost_by_law)):
            if np.isfinite(value):
                fraction = "" if name == "volume" else f"  {value / self.volume:.4%}"
                rows.append((name, f"{value:.9g}{fraction}"))
        if not len(self.states):
            why = "its law is proved" if self.law.holds else "no time was left for them"
            return lines([*rows, ("samples", f"none: {why}")])
        counts = self.counts()
        for name, count in counts.items():
            fraction = "" if name == "feasible" else f"  {count / max(counts['feasible'], 1):8.3%}"
            rows.append((name, f"{count:>10,}{fraction}"))
        return lines(rows)

    def to_xarray(self) -> Any:
        """Return the samples as an xarray.Dataset along the dimension `sample`, names attached."""
        import xarray

        data = {
            "state": (("sample", "coordinate"), self.states),
            "label": ("sample", self.label),
            "input": (("sample", "move"), self.inputs),
            "next_state": (("sample", "coordinate"), self.next_states),
            "lost_at": ("sample", self.lost_at),
            "undecided_at": ("sample", self.undecided_at),
        }
        names = {
            "coordinate": list(self.mpc.labels[: self.states.shape[1]]),
            "move": list(self.mpc.system.input_labels),
        }
        return xarray.Dataset(data, coords=names, attrs={"steps": self.steps})


def lines(rows: list[tuple[str, str]]) -> str:
    """Return names and values as text, one pair a line."""
    return "\n".join(f"  {name:<20} {value}" for name, value in rows)


def in_words(x: np.ndarray) -> str:
    """Return a vector as text, such as "(0.5, -1)", rounded to 9 decimals and 6 digits."""
    return "(" + ", ".join(f"{v:.6g}" for v in np.round(x, 9) + 0.0) + ")"
