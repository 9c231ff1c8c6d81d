"""What is checked of an MPC problem before it runs: proofs, simulations, failed hypotheses."""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import jax
import numpy as np

from jaxmpc.arrays import Reals
from jaxmpc.checks import counted, fail, require_kind, whole
from jaxmpc.closed_loop.simulation import Run, lyapunov_decrease, simulate
from jaxmpc.explicit.exact_penalties import ExactPenalty, exact_penalty
from jaxmpc.feasible.boundary_points import boundary
from jaxmpc.feasible.map import FeasibleSetMap, map_points
from jaxmpc.feasible.policy_problem import problem_of
from jaxmpc.feasible.polytope_growth import is_standard_form
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.grids import grid
from jaxmpc.mpc.condense import in_float64
from jaxmpc.mpc.controller import Controller
from jaxmpc.mpc.plan import References, checked_aim
from jaxmpc.mpc.policy_rows import condensed_plan
from jaxmpc.mpc.problem import HARD, MPC, folded, harden
from jaxmpc.mpc.rows import given_blocks, row_table
from jaxmpc.mpc.tightening import feedback_gain
from jaxmpc.pytrees import record
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.linalg import float64_arrays
from jaxmpc.qp.status import Status
from jaxmpc.recursion.analysis import examine
from jaxmpc.recursion.report import RecursionReport
from jaxmpc.recursion.time_budget import LABELS, LOOPS, PROOFS, Budget
from jaxmpc.sets.convex_sets import Box
from jaxmpc.sets.terminal_hypotheses import TerminalReport, verify_terminal
from jaxmpc.systems.system import host_matrices

T = TypeVar("T")
# Rounding of a set-point, relative: drifts and violations below that are none.
RESTS = 1e-9
# Rounding of optimal values, relative: a Lyapunov increase below that is none.
COST_ROUNDING = 1e-7


@record
class NominalLoops:
    """The results of nominal closed loops from sampled feasible states.

    x0s (B, n). steps: time steps of each loop. feasible: number of loops whose plans were all
    SOLVED; the other fields are of these. violation: the worst of the state limits, in their units.
    slack: the worst violation of soft rows. increase: the largest V(x⁺) − V(x) + x'Qx + u'Ru
    relative to V(x); worst_x0: the start of the loop in which it was met. left: largest distance
    of x_T from the set-point, relative to that of the start of the loop, each state in units of its
    distance among the starts.
    """

    x0s: np.ndarray
    steps: int
    feasible: int
    violation: float
    slack: float
    increase: float
    worst_x0: np.ndarray
    left: float

    def __str__(self) -> str:
        lines = [
            f"{self.feasible:,} of {len(self.x0s):,} feasible starts kept every plan solved for "
            f"{self.steps} steps",
            f"worst violation of a hard state limit {self.violation:.3g}, "
            f"of a soft row {self.slack:.3g}",
            f"largest distance left to the set-point, relative to the start: {self.left:.3g}",
        ]
        if self.increase <= COST_ROUNDING and np.isfinite(self.increase):
            what = "Lyapunov decrease V(x+) - V(x) <= -(x'Qx + u'Ru): kept on every step, margin"
            lines.append(f"{what} {-self.increase:.3g} V(x)")
        elif np.isfinite(self.increase):
            at = np.array2string(self.worst_x0, precision=4)
            lines.append(f"Lyapunov decrease fails by {self.increase:.3g} V(x), from {at}")
        return "\n".join(lines)

    __repr__ = __str__


@record
class SetPoint:
    """Where closed loops are to go: x (n,) under u (m,).

    drift (n,): A x + B u + c − x, zero where u holds x. broken: the limits that x and u do not keep
    for ever, by name, hard ones and soft ones.
    """

    x: np.ndarray
    u: np.ndarray
    drift: np.ndarray
    broken: tuple[str, ...]

    @classmethod
    def of(cls, mpc: MPC, reference: Reals | None, input_reference: Reals | None) -> "SetPoint":
        """Return a set-point with what there is to say of it; None stands for zero."""
        aim = checked_aim(mpc, np.zeros(mpc.system.n), reference, input_reference)
        x, u = (
            np.zeros(size) if v is None else np.asarray(v, float)
            for v, size in ((aim.states, mpc.system.n), (aim.inputs, mpc.system.m))
        )
        if x.ndim == 2 or u.ndim == 2:
            fail("reference", "differs over time", "The report is about one set-point")
        A, B, c = host_matrices(mpc.system)
        drift = A @ x + B @ u + c - x
        size = np.abs(A) @ np.abs(x) + np.abs(B) @ np.abs(u) + np.abs(c) + np.abs(x)
        drift = np.where(np.abs(drift) <= RESTS * size, 0.0, drift)
        found: list[str] = []
        with jax.enable_x64(True):
            limits = given_blocks(float64_arrays(mpc), float)
            still: Any = np.tile(x, (mpc.horizon + 1, 1)), np.tile(u, (mpc.horizon, 1))
            values = [np.asarray(b.values(still[0], still[1] * (not b.rate))) for b in limits]
        for b, value in zip(limits, values, strict=True):
            low, high = b.lower, b.upper
            if b.radius is not None:
                value, low, high = np.sqrt(np.sum(value**2)), -b.radius, b.radius
            end = np.where(value > high, high, low)
            beyond = np.maximum(value - high, low - value)
            over = np.broadcast_to(beyond > RESTS * np.abs(end), (len(b.steps), b.size))
            kind = "soft limit" if b.linear is not None else f"{b.kind} limit"
            broken = np.flatnonzero(over.any(axis=0))
            found += [f"{kind} {b.names[i]}" for i in broken]
        return cls(x, u, drift, tuple(dict.fromkeys(found)))

    def __str__(self) -> str:
        put = lambda v: np.array2string(v, precision=6, separator=", ")
        text = [f"x = {put(self.x)}, u = {put(self.u)}"]
        if np.any(self.drift):
            text.append(f"no equilibrium: x moves by {put(self.drift)} a step")
        for name in self.broken:
            text.append(f"breaks the {name}")
        if not np.any(self.drift) and not self.broken:
            text.append("an equilibrium that keeps all limits")
        text.append("the law, its penalty and closed loops are those that go there; stability is")
        text.append("that of the law whose set-point is the origin")
        return "\n".join(text)


@record
class OfflineReport:
    """Everything that is known of an MPC problem before it runs; `print` shows it.

    feasible_set: map of initial states with proofs, of the problem with its soft rows hard; volume:
    lower and upper bound of its volume. recursion, penalty: the reports of `recursive_feasibility`
    and `exact_penalty`. terminal: that of `verify_terminal`, of the law whose set-point is the
    origin. loops: closed loops to the set-point that were simulated, not proved. None, where
    they do not apply or the time was over. set_point: where the loops go, and what moves away from
    there.
    notes: the reasons for what is None.
    variables, rows, condition: sizes of the condensed QP and condition number of its Hessian, of
    the variables that have a cost.
    """

    mpc: MPC
    feasible_set: FeasibleSetMap | None
    volume: tuple[float, float]
    recursion: RecursionReport | None
    penalty: ExactPenalty | None
    terminal: TerminalReport | None
    loops: NominalLoops | None
    variables: int
    rows: int
    condition: float
    notes: dict[str, str]
    set_point: SetPoint

    def __str__(self) -> str:
        mpc, system = self.mpc, self.mpc.system
        span = f" ({mpc.horizon * system.dt:g} {system.time_unit})" if system.dt else ""
        problem = (
            f"{counted(system.n, 'state')}, {counted(system.m, 'input')}, "
            f"horizon {mpc.horizon}{span}\n"
            f"{counted(self.variables, 'variable')}, {counted(self.rows, 'row')}, "
            f"condition of the Hessian {self.condition:.3g}\n{limits_text(mpc)}"
        )
        if mpc.disturbance is not None:
            problem += f"\nlimits kept for every disturbance, by a policy of kind {mpc.policy!r}"
        samples = None
        if self.feasible_set is not None:
            low, high = self.volume
            bounded = np.isfinite(high) and high > 0
            unit = mpc.volume_unit()
            size = f"volume from {low:.9g} to {high:.9g}{unit}, " if bounded else ""
            counts = self.feasible_set.counts().items()
            known = ", ".join(f"{count:,} {name}" for name, count in counts if count)
            samples = f"{size}samples: {known}"
            if len(mpc.labels) > 3:
                samples += "\nstates of the caller or random ones: not shares of the volume"
        away = self.set_point.x.any() or self.set_point.u.any()
        sections = (
            ("Problem", problem, ""),
            *([("Set-point", self.set_point, "")] if away else []),
            ("Feasible set (limits hard)", samples, "feasible_set"),
            ("Recursive feasibility (limits hard)", self.recursion, "recursion"),
            ("Exact penalty", self.penalty, "penalty"),
            ("Terminal ingredients", self.terminal, "terminal"),
            ("Closed loops", self.loops, "loops"),
        )
        lines = []
        for title, body, note in sections:
            text = f"not done: {self.notes[note]}" if body is None else str(body)
            lines += [title, *("  " + line.strip("\n") for line in text.splitlines()), ""]
        return "\n".join(lines).rstrip()

    __repr__ = __str__


def offline_report(
    mpc: MPC,
    x0s: Reals | None = None,
    *,
    K: Reals | None = None,
    reference: Reals | None = None,
    input_reference: Reals | None = None,
    steps: int = 50,
    loops: int = 128,
    seconds: float = 120.0,
    progress: bool = False,
) -> OfflineReport:
    """Test an MPC problem before its controller runs, and return one report.

    Covers every hypothesis of the terminal theorems, recursive feasibility, the exact penalty, the
    feasible set and its volume, and `loops` nominal closed loops of `steps` time steps from
    feasible states, in this order. Soft rows count as hard but for the closed loops.

    Arguments:
        x0s: states (B, n), or (B, n + m) with the previous input where input rates are limited, to
            map, and in more than three dimensions to follow in the recursion test. None: a grid
            over the feasible set, in more than three dimensions random points of its bounding box;
            those of `recursive_feasibility` for its test.
        reference, input_reference: the set-point of closed loops, (n,) and (m,); None for zero. It
            is shown, with whether it is an equilibrium inside the limits. It moves the optimal
            law; what is said of stability is said of the origin as set-point.
        steps: length of the closed loops. loops: how many of them.
        K: terminal law to verify, (m, n); None: that of the LQR.
        seconds: time limit of the whole call. Linear programs take seconds, thousands of facets or
            critical regions minutes; compiling takes some 15 s for the map and 20 s for the closed
            loops, whatever the problem, which are kept for that where seconds allow. What
            compiles cannot be interrupted, and is left out, with a note, where it does not fit.
            Recursive feasibility may take two thirds of the rest, the exact penalty what is left
            of it; what they do not settle is open.
        progress: print each stage on stderr.

    Of a robust problem sets, claims and theorems are about every disturbance; the closed loops have
    none.

    Raises ValueError for an ill-posed problem, and where x0s is None and the feasible set is empty,
    flat or unbounded. NumPy; not traceable. Proofs are in float64.
    """
    require_kind("mpc", mpc, MPC)
    budget = Budget.of(seconds, progress)
    mpc.validate()
    mpc.require_constant("the report is about the same problem at every time step", *HARD)
    for name, value, least in (("steps", steps, 2), ("loops", loops, 1)):
        whole(name, value, least)
    set_point = SetPoint.of(mpc, reference, input_reference)
    hard = harden(mpc)
    problem = problem_of(hard)
    notes: dict[str, str] = {}

    budget.say("terminal ingredients")
    terminal = _or_note(notes, "terminal", partial(theorems, hard, K))
    # Where map and closed loops can fit, time is kept for their compiles.
    compiles = PROOFS + LABELS + LOOPS
    reserved = compiles if budget.affords(1.5 * compiles) else 0.0
    proofs = replace(budget, deadline=budget.deadline - reserved)
    part = replace(proofs, deadline=proofs.share(2 / 3))
    follow = x0s if problem.dimension > 3 else None
    aims: References = {"reference": set_point.x, "input_reference": set_point.u}
    examined = partial(examine, hard, follow, steps, True, 2000, part, part.share(0.75), aims)
    recursion = _or_note(notes, "recursion", examined)
    budget.say("exact penalty, by critical regions")
    left = proofs.deadline - time.monotonic()
    penalty = _or_note(notes, "penalty", partial(exact_penalty, mpc, seconds=left, **aims))
    fmap = mapped(problem, x0s, budget)
    inside = np.zeros((0, problem.dimension)) if fmap is None else fmap.x0s[fmap.label == 1]
    followed = None
    late = "no time was left: {} takes some {:.0f} s of compiling"
    notes["feasible_set"] = late.format("the map", PROOFS + LABELS)
    if not len(inside):
        notes["loops"] = "none of the samples is feasible" if fmap else "no samples are mapped"
    elif not budget.affords(LOOPS):
        notes["loops"] = late.format("the simulation", LOOPS)
    else:
        budget.say(f"closed loops; compile for some {LOOPS:.0f} s")
        pick = np.unique(np.linspace(0, len(inside) - 1, min(loops, len(inside))).astype(int))
        followed = nominal_loops(mpc, inside[pick], steps, set_point)
    with jax.enable_x64(True):
        condensed = condensed_plan(in_float64(mpc))
    P = np.asarray(condensed.P)
    costly = np.any(P != 0, axis=1)  # what policies do about disturbances has no cost
    return OfflineReport(
        mpc=mpc,
        feasible_set=fmap,
        volume=fmap.volume_bounds() if fmap and problem.dimension <= 3 else (0.0, np.inf),
        recursion=recursion,
        penalty=penalty,
        terminal=terminal,
        loops=followed,
        variables=condensed.P.shape[0],
        rows=condensed.C.shape[0],
        condition=float(np.linalg.cond(P[np.ix_(costly, costly)])),
        notes=notes,
        set_point=set_point,
    )


def _or_note(notes: dict[str, str], name: str, action: Callable[[], T]) -> T | None:
    """Return the result of an action; None, and the reason in notes[name], for a ValueError."""
    try:
        return action()
    except ValueError as error:
        notes[name] = str(error)
        return None


def mapped(problem: FeasibilityProblem, x0s: Reals | None, budget: Budget) -> FeasibleSetMap | None:
    """Return the map of x0s, or of `sample_states`; None where there is no time for it."""
    if not budget.affords(PROOFS + LABELS):
        return None
    budget.say(f"map of the feasible set; compiles for some {PROOFS + LABELS:.0f} s")
    d = problem.dimension
    points = sample_states(problem.mpc, d) if x0s is None else x0s
    fmap = map_points(problem, points, progress=budget.bar, deadline=budget.deadline)
    return fmap.refine(deadline=budget.deadline) if d <= 3 else fmap


def theorems(mpc: MPC, K: Reals | None = None) -> TerminalReport:
    """Return the `verify_terminal` report of a problem; ValueError where no theorem covers it."""
    mpc = folded(mpc)
    if not is_standard_form(mpc) or (mpc.terminal_set is None and mpc.horizon == 1):
        cure = (
            "They cover limits of states and inputs alone, at the usual steps, inputs free at each"
        )
        fail("mpc", "is not of the theorems' form", cure)
    if mpc.input_rate_weight is not None:
        fail("mpc", "weighs input rates", "The theorems' optimal value depends on x alone")
    if mpc.stage_weights is not None:
        fail("mpc", "weighs its stages", "The theorems' optimal value has one cost for all stages")
    P = np.zeros((mpc.system.n,) * 2) if mpc.terminal_cost is None else mpc.terminal_cost
    if mpc.disturbance is not None and K is None:
        K = feedback_gain(mpc)
    sets = mpc.terminal_set, mpc.states, mpc.inputs
    against = mpc.disturbance, mpc.disturbance_matrix
    return verify_terminal(mpc.system, mpc.Q, mpc.R, P, *sets, K, *against)


def sample_states(mpc: MPC, d: int) -> np.ndarray:
    """Return states (B, d) over the bounding box of the feasible set, 3 % wider on each side."""
    edges = boundary(mpc, np.concatenate([np.eye(d), -np.eye(d)]))
    if not np.isfinite(edges.offsets).all():
        fail("x0s", "is None and the feasible set is unbounded", "Give states to look at, (B, n)")
    corners = edges.points[np.isfinite(edges.points).all(axis=1)]
    lower, upper = corners.min(axis=0), corners.max(axis=0)
    if isinstance(mpc.states, Box) and d == mpc.system.n:
        low, high = np.asarray(mpc.states.lower), np.asarray(mpc.states.upper)
        wide = np.isfinite(low) & np.isfinite(high)
        lower, upper = np.where(wide, low, lower), np.where(wide, high, upper)
    margin = 0.03 * (upper - lower)
    if d <= 3:
        return grid(lower - margin, upper + margin, ({1: 256, 2: 48, 3: 14}[d],) * d)
    rng = np.random.default_rng(0)
    center, reach = edges.center, np.nanmax(np.abs(edges.points - edges.center), axis=0)
    # Uniform samples of the box hardly meet the set in many dimensions: half of them are shrunk.
    shrink = np.where(np.arange(2048) % 2, 1.0, rng.uniform(0, 1, 2048))[:, None]
    return center + shrink * rng.uniform(-1, 1, (2048, d)) * reach


def limits_text(mpc: MPC) -> str:
    """Return a line for each kind of limit, with the steps at which it holds."""
    found: dict[tuple[str, str, bool], list[int]] = {}
    for row in row_table(mpc):
        unit = f" [{row.unit}]" if row.unit else ""
        found.setdefault((row.kind, row.name + unit, row.soft), []).append(row.stage)
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


def nominal_loops(mpc: MPC, x0s: np.ndarray, steps: int, set_point: SetPoint) -> NominalLoops:
    """Simulate nominal closed loops to a set-point in float64.

    x0s: states (B, n), or (B, n + m) with the previous input where input rates are limited.
    """
    n = mpc.system.n
    with jax.enable_x64(True):
        # Plans under policies need more: many of their rows only touch.
        few = mpc.disturbance is None or mpc.policy == "tightened"
        controller = Controller(in_float64(mpc), ADMM(newton_steps=30 if few else None))

        def loop(x0: jax.Array) -> Run:  # x, or (x, u_{−1}) where input rates are limited
            previous = x0[n:] if len(x0) > n else None
            return simulate(
                controller,
                mpc.system,
                x0[:n],
                steps,
                reference=set_point.x,
                input_reference=set_point.u,
                previous_input=previous,
            )

        run = jax.jit(jax.vmap(loop))(x0s)
        change = np.asarray(lyapunov_decrease(run))
        run = jax.tree.map(np.asarray, run)
    solved = np.all(run.status == Status.SOLVED, axis=1)
    # Costs next to nothing, beside the largest of all loops, are rounding.
    scale = np.abs(run.cost[:, :-1])
    scale = np.maximum(scale, 1e-12 * scale[solved].max(initial=0.0) + np.finfo(float).tiny)
    relative = np.where(solved[:, None], change / scale, -np.inf)
    worst = np.unravel_index(np.argmax(relative), relative.shape)
    # Largest distance of each loop, in units of those of the starts.
    apart = [x - set_point.x for x in (x0s[:, :n], run.states[:, -1])]
    size = np.abs(apart[0]).max(axis=0)
    size = np.where(size > 0, size, 1.0)
    first, last = (np.abs(x / size).max(axis=1) for x in apart)
    return NominalLoops(
        x0s=x0s,
        steps=steps,
        feasible=int(solved.sum()),
        violation=float(np.max(run.violation[solved], initial=0.0)),
        slack=float(np.max(run.slack[solved], initial=0.0)),
        increase=float(relative[worst]),
        worst_x0=x0s[worst[0]],
        left=float(np.max((last / np.maximum(first, 1e-9))[solved], initial=0.0)),
    )
