"""The test of an MPC problem before it runs: proofs, simulations, and failed hypotheses."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxmpc.checks import fail, require_kind, whole
from jaxmpc.control.sets import Box
from jaxmpc.control.terminal import TerminalReport, verify_terminal
from jaxmpc.explicit.exact_penalty import ExactPenalty, exact_penalty
from jaxmpc.feasible.map import FeasibleSetMap, grid, map_feasible_set
from jaxmpc.feasible.polytope import is_standard_form
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.rays import boundary
from jaxmpc.mpc.inequalities import condensed_in_float64
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.rows import row_table
from jaxmpc.mpc.soften import harden
from jaxmpc.recursion import RecursionReport, recursive_feasibility
from jaxmpc.workflow.nominal_loops import NominalLoops, nominal_loops


@dataclass(frozen=True)
class OfflineReport:
    """Everything that is known of an MPC problem before it runs; `print` shows it.

    feasible_set: map of initial states with proofs, of the problem with its soft rows hard; volume:
    lower and upper bound of its volume. recursion, penalty, terminal: the reports of
    `recursive_feasibility`, `exact_penalty` and `verify_terminal`; None, with the reason in
    `notes`, where they do not apply. loops: closed loops that were simulated, not proved.
    variables, rows, condition: sizes of the condensed QP and condition number of its Hessian.
    """

    mpc: MPC
    feasible_set: FeasibleSetMap
    volume: tuple[float, float]
    recursion: RecursionReport | None
    penalty: ExactPenalty | None
    terminal: TerminalReport | None
    loops: NominalLoops | None
    variables: int
    rows: int
    condition: float
    notes: dict[str, str]

    def __str__(self) -> str:
        def section(title: str, body: Any, note: str) -> list[str]:
            text = f"not done: {self.notes[note]}" if body is None else str(body)
            return [title, *("  " + line.strip("\n") for line in text.splitlines()), ""]

        mpc, system = self.mpc, self.mpc.system
        found = self.feasible_set.counts()
        known = ", ".join(f"{count:,} {name}" for name, count in found.items() if count)
        low, high = self.volume
        size = f"volume from {low:.9g} to {high:.9g}, " if np.isfinite(high) and high > 0 else ""
        problem = (
            f"{system.n} states, {system.m} inputs, horizon {mpc.horizon}"
            + (f" ({mpc.horizon * system.dt:g} s)" if system.dt else "")
            + f"\n{self.variables} variables, {self.rows} rows, condition of the Hessian "
            f"{self.condition:.3g}\n" + limits_text(mpc)
        )
        lines = section("Problem", problem, "")
        lines += section("Feasible set (limits hard)", f"{size}samples: {known}", "")
        lines += section("Recursive feasibility (limits hard)", self.recursion, "recursion")
        penalty = None if self.penalty is None else self.penalty.sentence
        lines += section("Exact penalty", penalty, "penalty")
        lines += section("Terminal ingredients", self.terminal, "terminal")
        lines += section("Closed loops", self.loops, "loops")
        return "\n".join(lines).rstrip()


def offline_report(
    mpc: MPC, x0s: Any = None, *, K: Any = None, steps: int = 50, loops: int = 128,
    seconds: float = 60.0,
) -> OfflineReport:  # fmt: skip
    """Test an MPC problem before its controller runs, and return one report.

    Covers the feasible set and its volume, recursive feasibility, the exact penalty, every
    hypothesis of the terminal theorems, and `loops` nominal closed loops of `steps` samples from
    feasible states. Soft rows count as hard but for the closed loops.

    Arguments:
        x0s: states (B, n), or (B, n + m) with the previous input where input rates are limited, to
            map, and in more than three dimensions to follow in the recursion test. None: a grid
            over the feasible set, in more than three dimensions random points of its bounding box.
        K: terminal law to verify, (m, n); None: that of the LQR.
        seconds: about how long the search for counterexamples may take.

    Raises ValueError for an ill-posed problem, and where x0s is None and the feasible set is empty,
    flat or unbounded. NumPy; not traceable. Proofs are in float64.
    """
    require_kind("mpc", mpc, MPC)
    mpc.validate()
    for name, value, least in (("steps", steps, 2), ("loops", loops, 1)):
        whole(name, value, least)
    if not seconds > 0:
        fail("seconds", f"{seconds!r}", "Give a positive number")
    hard = harden(mpc)
    notes: dict[str, str] = {}
    d = FeasibilityProblem.of(hard).dimension
    if x0s is None:
        x0s = samples(hard, d)
    fmap = map_feasible_set(hard, x0s)
    fmap = fmap.refine() if d <= 3 else fmap
    inside = fmap.points[fmap.label == 1]

    def attempt(name: str, action: Any) -> Any:
        try:
            return action()
        except ValueError as error:
            notes[name] = str(error)
            return None

    recursion = attempt(
        "recursion",
        lambda: recursive_feasibility(hard, x0s if d > 3 else None, steps=steps, seconds=seconds),
    )
    penalty = attempt("penalty", lambda: exact_penalty(mpc))
    terminal = attempt("terminal", lambda: theorems(hard, K))
    notes["loops"] = "none of the samples is feasible"
    closed = None
    if len(inside):
        pick = np.unique(np.linspace(0, len(inside) - 1, min(loops, len(inside))).astype(int))
        closed = nominal_loops(mpc, inside[pick], steps)
    condensed = condensed_in_float64(mpc)
    return OfflineReport(
        mpc, fmap, fmap.volume_bounds() if d <= 3 else (0.0, np.inf), recursion, penalty, terminal,
        closed, condensed.P.shape[0], condensed.C.shape[0],
        float(np.linalg.cond(np.asarray(condensed.P))), notes,
    )  # fmt: skip


def theorems(mpc: MPC, K: Any = None) -> TerminalReport:
    """Return the `verify_terminal` report of a problem; ValueError where no theorem covers it."""
    if not is_standard_form(mpc) or (mpc.terminal_set is None and mpc.horizon == 1):
        fail("mpc", "is not of the theorems' form", "They cover limits of states and inputs alone, "
             "at the usual steps, inputs free at each")  # fmt: skip
    if mpc.input_rate_weight is not None:
        fail("mpc", "weighs input rates", "The theorems' optimal value depends on x alone")
    if mpc.stage_weights is not None:
        fail("mpc", "weighs its stages", "The theorems' optimal value has one cost for all stages")
    P = np.zeros((mpc.system.n,) * 2) if mpc.terminal_cost is None else mpc.terminal_cost
    return verify_terminal(mpc.system, mpc.Q, mpc.R, P, mpc.terminal_set, mpc.states, mpc.inputs, K)


def samples(mpc: MPC, d: int) -> np.ndarray:
    """Return states (B, d) over the bounding box of the feasible set, 3 % wider on each side."""
    edges = boundary(mpc, np.concatenate([np.eye(d), -np.eye(d)]))
    if not np.isfinite(edges.offsets).all():
        fail("x0s", "is None and the feasible set is unbounded", "Give states to look at, (B, n)")
    corners = edges.points[np.isfinite(edges.points).all(axis=1)]
    lower, upper = corners.min(axis=0), corners.max(axis=0)
    if isinstance(mpc.states, Box) and d == mpc.system.n:
        ends = mpc.states
        wide = np.isfinite(np.asarray(ends.lower)) & np.isfinite(np.asarray(ends.upper))
        lower = np.where(wide, ends.lower, lower)
        upper = np.where(wide, ends.upper, upper)
    margin = 0.03 * (upper - lower)
    if d <= 3:
        return grid(lower - margin, upper + margin, ({1: 256, 2: 48, 3: 14}[d],) * d)
    rng = np.random.default_rng(0)
    centre, reach = edges.center, np.nanmax(np.abs(edges.points - edges.center), axis=0)
    # Uniform samples of the box hardly meet the set in many dimensions: half of them are shrunk.
    shrink = np.where(np.arange(2048) % 2, 1.0, rng.uniform(0, 1, 2048))[:, None]
    return centre + shrink * rng.uniform(-1, 1, (2048, d)) * reach


def limits_text(mpc: MPC) -> str:
    """Return a line for each kind of limit, with the steps at which it holds."""
    found: dict[tuple[str, str, bool], list[int]] = {}
    for row in row_table(mpc):
        unit = f" [{row.unit}]" if row.unit else ""
        found.setdefault((row.kind, row.name + unit, row.soft), []).append(row.step)
    groups: dict[tuple[str, bool, tuple[int, ...]], list[str]] = {}
    for (kind, name, soft), at in found.items():
        names = groups.setdefault((kind, soft, tuple(sorted(set(at)))), [])
        if name not in names:
            names.append(name)
    lines = []
    for (kind, soft, steps), names in groups.items():
        run = steps == tuple(range(steps[0], steps[-1] + 1))
        when = f"k = {steps[0]}" if len(steps) == 1 else f"k = {steps[0]}..{steps[-1]}"
        when = when if run else f"k in {steps}"
        what = "soft limits" if soft else f"hard {kind} limits"
        listed = ", ".join(names) if len(names) <= 8 else f"{len(names)} rows"
        lines.append(f"{what}, {when}: {listed}")
    return "\n".join(lines) or "no limits"
