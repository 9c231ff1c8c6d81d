"""From limits to a tested controller: the constraint-handling workflow of the lesson's section 6.

`design` turns limits, weights and a horizon into an MPC problem with its terminal ingredients and
penalties; `offline_report` is the test before it runs: what is proved, what was only tried, what
fails, in one text.
"""

from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from jaxmpc.checks import fail
from jaxmpc.closed_loop.run import lyapunov_decrease
from jaxmpc.closed_loop.simulate import simulate
from jaxmpc.control.invariant import invariant_ellipsoid, maximal_invariant_set
from jaxmpc.control.limits import JointLimits
from jaxmpc.control.riccati import LQR, lqr
from jaxmpc.control.sets import Box, Ellipsoid, Polytope
from jaxmpc.control.system import LinearSystem
from jaxmpc.control.terminal import TerminalReport, verify_terminal
from jaxmpc.mpc.condense import condense, in_float64
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.rows import row_table
from jaxmpc.mpc.soften import harden, soften
from jaxmpc.mpc.solve import Controller
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.status import Status
from jaxmpc.sweeps.boundary import boundary
from jaxmpc.sweeps.exact_penalty import ExactPenalty, exact_penalty
from jaxmpc.sweeps.feasible_set import FeasibleSetMap, grid, map_feasible_set
from jaxmpc.sweeps.proofs import hard_part
from jaxmpc.sweeps.reach import usual
from jaxmpc.sweeps.recursion import RecursionReport, recursive_feasibility

TERMINALS = ("invariant", "ellipsoid", "states", "box", "none")
# Rounding of optimal values, relative: a Lyapunov increase below that is none.
ROUNDING = 1e-7


@dataclass(frozen=True)
class Design:
    """What `design` chose: the problem, the LQR law behind its terminal ingredients, and the exact
    penalty where one was asked for."""

    mpc: MPC
    regulator: LQR
    penalty: ExactPenalty | None

    def controller(self, solver: ADMM = ADMM()) -> Controller:  # noqa: B008
        """The law, factored once."""
        return Controller(self.mpc, solver)

    def test(self, **settings: Any) -> "OfflineReport":
        """`offline_report` of the problem."""
        return offline_report(self.mpc, K=self.regulator.K, **settings)


def design(
    system: LinearSystem, Q: Any, R: Any, horizon: int, *, limits: JointLimits | None = None,
    states: Box | Polytope | None = None, inputs: Box | Polytope | None = None,
    terminal: str | Box | Polytope | Ellipsoid = "invariant", soft: float | str | None = None,
    **settings: Any,
) -> Design:  # fmt: skip
    """An MPC problem from limits and weights, with terminal set, terminal cost and penalties.

    limits: of `joint_limits`; or states and inputs themselves. terminal: "invariant", the maximal
    invariant set of the LQR; "ellipsoid", the largest level set of its cost inside the limits;
    "states" or "box", the state limits; "none"; or a set. The terminal cost is the LQR's unless
    settings hold another. soft: None keeps all limits hard; a number is the L1 weight of state and
    terminal rows; "exact" computes the least weight that changes nothing on the feasible set, and a
    margin.
    settings: further fields of `MPC`, such as control_horizon or input_rate_limit.

    Raises ValueError for ill-posed data, as `lqr`, `maximal_invariant_set` and `MPC` do.
    """
    if limits is not None:
        if states is not None or inputs is not None:
            fail("limits", "given beside states or inputs", "Choose one way to give the limits")
        states, inputs = limits.states, limits.inputs
        if not system.state_names:
            named: dict[str, Any] = limits.names
            system = replace(system, **named)
    regulator = lqr(system, Q, R)
    sets: dict[str, Any] = {
        "none": lambda: None,
        "states": lambda: states,
        "box": lambda: states,
    }
    if isinstance(terminal, str):
        if terminal not in TERMINALS:
            fail("terminal", f"{terminal!r}", f"Give a set, or one of {', '.join(TERMINALS)}")
        if terminal in ("invariant", "ellipsoid") and states is None and inputs is None:
            fail("terminal", f"{terminal!r} without limits", "Give states or inputs, or 'none'")
        K, P = regulator.K, regulator.P
        sets["ellipsoid"] = lambda: invariant_ellipsoid(system, K, P, states, inputs)
        free = Box(np.full(system.n, -np.inf), np.full(system.n, np.inf))
        sets["invariant"] = lambda: maximal_invariant_set(system, K, states or free, inputs)
        terminal_set = sets[terminal]()
    else:
        terminal_set = terminal
    mpc = MPC(
        system=system, Q=Q, R=R, horizon=horizon, states=states, inputs=inputs,
        terminal_set=terminal_set, **{"terminal_cost": regulator.P, **settings},
    )  # fmt: skip
    mpc.validate()
    penalty = None
    if isinstance(soft, str):
        if soft != "exact":
            fail("soft", f"{soft!r}", 'Give a weight, "exact" or None')
        penalty = exact_penalty(mpc)
    if soft is not None:
        mpc = soften(mpc, soft if penalty is None else penalty.advised)
    return Design(mpc, regulator, penalty)


@dataclass(frozen=True)
class ClosedLoops:
    """Nominal closed loops from sampled feasible states.

    starts (B, n). feasible: how many kept every plan SOLVED. violation: the worst of the state
    limits, in their units. increase: the largest V(x⁺) − V(x) + x'Qx + u'Ru relative to V(x), and
    where it was met. left: largest |x_T| of a loop, relative to the largest of its start, each
    state in units of its size among the starts. slack: the worst of soft rows.
    """

    starts: np.ndarray
    steps: int
    feasible: int
    violation: float
    slack: float
    increase: float
    worst_start: np.ndarray
    left: float


@dataclass(frozen=True)
class OfflineReport:
    """What is known of an MPC problem before it runs; `print` it.

    feasible_set: map of initial states with proofs, of the problem with its soft rows hard.
    recursion, penalty, terminal: as their functions give them; None, with the reason in `notes`,
    where they do not apply. loops: closed loops that were simulated, not proved.
    """

    mpc: MPC
    feasible_set: FeasibleSetMap
    volume: tuple[float, float]
    recursion: RecursionReport | None
    penalty: ExactPenalty | None
    terminal: TerminalReport | None
    loops: ClosedLoops | None
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
        lines += section("Closed loops", self.loops and loops_text(self.loops), "loops")
        return "\n".join(lines).rstrip()


def offline_report(
    mpc: MPC, x0s: Any = None, *, K: Any = None, steps: int = 50, loops: int = 128,
    seconds: float = 60.0,
) -> OfflineReport:  # fmt: skip
    """Test an MPC problem offline: the lesson's workflow, last step before the controller.

    The feasible set and its volume, recursive feasibility, the exact penalty, every hypothesis of
    the terminal theorems, and `loops` closed loops of `steps` samples from feasible states. Soft
    rows count as hard but for the closed loops.
    x0s: states (B, n), or (B, n + m) with the previous input where input rates are limited, to map,
    and in more than three dimensions to follow in the recursion test; None: a grid over the
    feasible set, in more than three dimensions random points of its bounding box. K: terminal law
    to verify; None: that of the LQR. seconds: about how long the search for counterexamples may
    take.

    Raises ValueError for an ill-posed problem, and where x0s is None and the feasible set is
    empty, flat or unbounded. Host; proofs in float64.
    """
    mpc.validate()
    for name, value, least in (("steps", steps, 2), ("loops", loops, 1)):
        if not isinstance(value, int | np.integer) or value < least:
            fail(name, f"{value!r}", f"Give a whole number, at least {least}")
    if not seconds > 0:
        fail("seconds", f"{seconds!r}", "Give a positive number")
    hard = harden(mpc)
    notes: dict[str, str] = {}
    d = hard_part(hard).dimension
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
        closed = closed_loops(mpc, inside[pick], steps)
    with jax.enable_x64(True):
        condensed = condense(in_float64(mpc))
    return OfflineReport(
        mpc, fmap, fmap.volume_bounds() if d <= 3 else (0.0, np.inf), recursion, penalty, terminal,
        closed, condensed.P.shape[0], condensed.C.shape[0],
        float(np.linalg.cond(np.asarray(condensed.P))), notes,
    )  # fmt: skip


def theorems(mpc: MPC, K: Any = None) -> TerminalReport:
    """`verify_terminal` of a problem that the theorems cover; ValueError for another."""
    if not usual(mpc) or (mpc.terminal_set is None and mpc.horizon == 1):
        fail("mpc", "is not of the theorems' form", "They cover limits of states and inputs alone, "
             "at the usual steps, inputs free at each")  # fmt: skip
    if mpc.input_rate_weight is not None:
        fail("mpc", "weighs input rates", "The theorems' optimal value depends on x alone")
    if mpc.stage_weights is not None:
        fail("mpc", "weighs its stages", "The theorems' optimal value has one cost for all stages")
    P = np.zeros((mpc.system.n,) * 2) if mpc.terminal_cost is None else mpc.terminal_cost
    return verify_terminal(mpc.system, mpc.Q, mpc.R, P, mpc.terminal_set, mpc.states, mpc.inputs, K)


def samples(mpc: MPC, d: int) -> np.ndarray:
    """States to look at: over the bounding box of the feasible set, 3 % wider on each side."""
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
    # Uniform in the box would hardly meet the set in many dimensions: half of it shrinks.
    shrink = np.where(np.arange(2048) % 2, 1.0, rng.uniform(0, 1, 2048))[:, None]
    return centre + shrink * rng.uniform(-1, 1, (2048, d)) * reach


def closed_loops(mpc: MPC, starts: np.ndarray, steps: int) -> ClosedLoops:
    """Simulate the nominal loop from each start (B, n) or (B, n + m), in float64."""
    with jax.enable_x64(True):
        controller = Controller(in_float64(mpc), ADMM(refine=30))
        n = mpc.system.n

        def loop(start: Any) -> Any:  # from x, or (x, u_{−1}) where input rates are limited
            previous = start[n:] if len(start) > n else None
            return simulate(controller, mpc.system, start[:n], steps, previous_input=previous)

        run = jax.jit(jax.vmap(loop))(starts)
        change = np.asarray(lyapunov_decrease(run))
        run = jax.tree.map(np.asarray, run)
    solved = np.all(run.status == Status.SOLVED, axis=1)
    scale = np.abs(run.cost[:, :-1]) + 1e-12
    relative = np.where(solved[:, None], change / scale, -np.inf)
    worst = np.unravel_index(np.argmax(relative), relative.shape)
    size = np.abs(starts[:, :n]).max(axis=0)
    size = np.where(size > 0, size, 1.0)
    norm = lambda x: np.abs(x / size).max(axis=1)
    left = norm(run.states[:, -1]) / np.maximum(norm(starts[:, :n]), 1e-9)
    kept = lambda v: float(np.max(v[solved], initial=0.0))
    return ClosedLoops(
        starts=starts, steps=steps, feasible=int(solved.sum()), violation=kept(run.violation),
        slack=kept(run.slack), increase=float(relative[worst]), worst_start=starts[worst[0]],
        left=kept(left),
    )  # fmt: skip


def loops_text(c: ClosedLoops) -> str:
    """The closed loops in words."""
    count = len(c.starts)
    lines = [
        f"{c.feasible:,} of {count:,} feasible starts kept every plan solved for {c.steps} steps",
        f"worst violation of a hard state limit {c.violation:.3g}, of a soft row {c.slack:.3g}",
        f"largest state left, relative to the start: {c.left:.3g}",
    ]
    if np.isfinite(c.increase):
        at = np.array2string(c.worst_start, precision=4)
        lines.append(
            f"Lyapunov decrease V(x+) - V(x) <= -(x'Qx + u'Ru): kept on every step, margin "
            f"{-c.increase:.3g} V(x)"
            if c.increase <= ROUNDING
            else f"Lyapunov decrease fails by {c.increase:.3g} V(x), from {at}"
        )
    return "\n".join(lines)


def limits_text(mpc: MPC) -> str:
    """Each constraint with the steps at which it holds."""
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
