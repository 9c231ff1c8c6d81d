"""One comparison: solvers take turns on the same states, and every answer is judged here.

A contestant is prepared (set up, compiled) and called once, which gives the cold time, and is then
called `rounds` times in turn with the others; the best of these counts. No solver's own word
counts: residuals are recomputed from z and y, in float64, against the QPs as they were given.
"""

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from bench.families import LIMITS, box_states, family, problem
from bench.rivals import EMPTY, RIVALS, SOLVED, Batch, Rival, moreau, residuals
from bench.roofline import Ceilings, Work, best_seconds, free_memory, memory_of

from jaxmpc import __version__
from jaxmpc.checks import in_units
from jaxmpc.closed_loop.simulation import simulate
from jaxmpc.feasible.map import map_feasible_set
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.mpc.condense import Condensed, condense, in_float64
from jaxmpc.mpc.controller import Controller
from jaxmpc.mpc.many import solve_many
from jaxmpc.mpc.plan import Plan, flat_multipliers
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.status import Status

What = Literal["labels", "plans", "gradients", "loops"]
# Calls of jaxmpc: both where JAX computes on a CPU; on other devices the first alone is on the
# device from end to end.
OURS = ("jaxmpc vmap", "jaxmpc")
# A rival counts as the best only if it solves that share of its states.
ENOUGH = 0.99
# Relative error of a gradient above which it counts as false.
WRONG_GRADIENT = 1e-3
# A first call that takes longer (s), compiling left out, is not repeated.
PATIENCE = 30.0
# Samples of a closed loop, and visited states that are checked: TurboMPC's protocol.
SAMPLES, CHECKED = 50, 1024


@dataclass(frozen=True)
class Case:
    """What is compared: labels, plans, gradients or closed loops of one problem at one batch size
    and one tolerance. loop: states that a solver without a batch of its own runs over. solvers: the
    names to run, of OURS and RIVALS; those that are not installed are left out."""

    what: What
    family: str
    batch: int
    tolerance: float
    horizon: int | None = None
    solvers: tuple[str, ...] = (*OURS, *RIVALS)
    loop: int = 300
    rounds: int = 3
    seed: int = 0

    @cached_property
    def states(self) -> tuple[MPC, np.ndarray]:
        """Return the problem and its states (batch, n)."""
        if self.what == "labels":  # not drawn by labels, which would compile before the clock runs
            mpc = problem(self.family, self.horizon)
            return mpc, box_states(mpc, self.batch, self.seed)
        return family(self.family, self.batch, self.seed, self.horizon)

    @cached_property
    def condensed(self) -> Condensed:
        """Return the QPs' data without the rows that no input moves."""
        return moving_rows(condensed(self.states[0]))


@dataclass(frozen=True)
class Row:
    """What one comparison found of one solver.

    states: of the batch, those that it ran over; extrapolated: fewer than the batch, so the time of
    the whole batch is an extrapolation. microseconds: a state, best warm call. speedup: time of the
    best rival (the fastest that solves 99 % of its states) over this. solved: share of answers
    within the tolerance, recomputed. false: answers whose status is wrong. cold_seconds: set-up,
    compiling and first call; compile_seconds: XLA's part of it; warm_seconds: best later call.
    ceiling: share of what the machine can do, a lower bound, and `bound`: by what.
    forward_microseconds, gradient_error: of gradients, the value alone, and the relative error
    along one direction against central differences. proofs_microseconds: of labels, with all plans
    and half-spaces on the host, which the call leaves on the device or to be made when used.
    """

    what: str
    family: str
    horizon: int
    variables: int
    rows: int
    batch: int
    tolerance: float
    solver: str
    version: str
    states: int
    extrapolated: bool
    microseconds: float
    solved: float | None
    false: int | None
    cold_seconds: float
    compile_seconds: float
    warm_seconds: float
    speedup: float | None = None
    forward_microseconds: float | None = None
    gradient_error: float | None = None
    proofs_microseconds: float | None = None
    ceiling: float | None = None
    bound: str | None = None
    work: Work | None = None

    def plain(self) -> dict[str, Any]:
        """Return the row as JSON data."""
        return asdict(self)


@dataclass
class Contestant:
    """A solver ready to be timed. prepare: sets it up and returns its call. judge: of an answer,
    the share solved and the number of false statuses (None: not known). per: solves a state.
    extra: figures of the row that are found once, after the first call."""

    name: str
    version: str
    states: int
    prepare: Callable[[], Callable[[], Any]]
    judge: Callable[[Any], tuple[float | None, int | None]]
    per: int = 1
    work: Callable[[], Work | None] = lambda: None
    extra: Callable[[Any], dict[str, Any]] = lambda answer: {}
    call: Callable[[], Any] | None = field(default=None, init=False)


def measure(
    case: Case, ceilings: Ceilings | None = None, note: Callable[[str], None] = lambda line: None
) -> Iterator[list[Row]]:
    """Yield the rows of a case after each call of each solver: those of the solvers called so far.

    64-bit mode must be on. note: is told what is left out, in a line.
    """
    mpc = case.states[0]
    common: dict[str, Any] = dict(
        what=case.what,
        family=case.family,
        horizon=mpc.horizon,
        batch=case.batch,
        tolerance=case.tolerance,
        variables=len(case.condensed.P),
        rows=len(case.condensed.C),
    )
    rows: dict[str, Row] = {}
    running = []
    for each in _contestants(case):
        try:
            with compile_seconds() as compiling:
                begun = time.perf_counter()
                each.call = each.prepare()
                answer = each.call()
                cold = time.perf_counter() - begun
        except Exception as error:  # whatever it is, it is that solver's failure
            text = " ".join(str(error).split())[:100]
            note(f"{each.name} left out of {_title(case)}: {type(error).__name__}: {text}")
            continue
        solved, false = each.judge(answer)
        work, once = each.work(), max(cold - compiling[0], 1e-9)
        rows[each.name] = Row(
            **common,
            solver=each.name,
            version=each.version,
            states=each.states,
            extrapolated=each.states < case.batch,
            microseconds=_each(once, each),
            solved=solved,
            false=false,
            cold_seconds=cold,
            compile_seconds=compiling[0],
            warm_seconds=once,
            work=work,
            **each.extra(answer),
        )
        if once <= PATIENCE:
            running.append(each)
        yield _compared(rows, ceilings)
    best: dict[str, float] = {}
    for _ in range(case.rounds):
        for each in running:
            assert each.call is not None
            begun = time.perf_counter()
            each.call()
            spent = time.perf_counter() - begun
            best[each.name] = least = min(spent, best.get(each.name, np.inf))
            rows[each.name] = replace(
                rows[each.name], warm_seconds=least, microseconds=_each(least, each)
            )
            yield _compared(rows, ceilings)


def _each(seconds: float, of: Contestant) -> float:
    """Return the microseconds a problem."""
    return seconds / (of.states * of.per) * 1e6


def _title(case: Case) -> str:
    return f"{case.what} of {case.family}, batch {case.batch:,}"


def _compared(rows: dict[str, Row], ceilings: Ceilings | None) -> list[Row]:
    """Return the rows with their ratios to the best rival and shares of the ceilings."""
    good = lambda row: (
        (row.solved is None or row.solved >= ENOUGH)
        and (row.gradient_error is None or row.gradient_error <= WRONG_GRADIENT)
    )
    rivals = [row.microseconds for row in rows.values() if row.solver in RIVALS and good(row)]
    found = []
    for row in rows.values():
        if rivals:
            row = replace(row, speedup=min(rivals) / row.microseconds)
        if ceilings and row.work:
            ceiling, bound = ceilings.share(row.work, row.warm_seconds)
            row = replace(row, ceiling=ceiling, bound=bound)
        found.append(row)
    return found


@contextlib.contextmanager
def compile_seconds() -> Iterator[list[float]]:
    """Yield a list whose one entry is the time (s) that XLA has compiled within this context."""
    found, events = [0.0], ("backend_compile_duration", "jaxpr_to_mlir_module_duration")

    def listen(event: str, duration_secs: float, **_: Any) -> None:
        if event.endswith(events):
            found[0] += duration_secs

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        yield found
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)


def condensed(mpc: MPC) -> Condensed:
    """Return the parametric QP in float64 on the host."""
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, condense(in_float64(mpc)))


def moves(c: Condensed) -> np.ndarray:
    """Return which rows (rows,) any input moves; the others limit the given state alone, and some
    solvers refuse them."""
    return np.linalg.norm(np.asarray(c.C), axis=1) > 1e-12


def moving_rows(c: Condensed) -> Condensed:
    """Return the parametric QP without the rows that no input moves."""
    moved, names = moves(c), ("C", "D", "d", "lower", "upper")
    return replace(c, **{name: getattr(c, name)[moved] for name in names})


def pair_of(c: Condensed, plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """Return z (B, nz) and y (B, rows) of plans (B in front) of this parametric QP."""
    with jax.enable_x64(True):
        z = jax.vmap(c.variables)(plan.states, plan.inputs)
        y = jax.vmap(lambda m: flat_multipliers(c.layout, m))(plan.multipliers)
    return np.asarray(z), np.asarray(y)


def judged(qps: Batch, tolerance: float, answers: Any) -> tuple[float, int]:
    """Return the share of answers (z, y, status) within the tolerance, and how many statuses are
    false: SOLVED where the residuals are larger, or infeasible, for all these QPs are feasible."""
    z, y, status = answers
    good = residuals(qps, z, y).max(axis=0) <= tolerance
    false = ((status == SOLVED) & ~good) | (status == EMPTY)
    return float(np.mean(good)), int(false.sum())


def _contestants(case: Case) -> Iterator[Contestant]:
    """Yield the solvers that take part in a case, and are installed."""
    ours, rivals = {
        "labels": (_own_labels, _rival_labels),
        "plans": (_own_plans, _rival_plans),
        "gradients": (_own_gradients, _rival_gradients),
        "loops": (_own_loops, _no_rival),
    }[case.what]
    yield from (found for found in ours(case) if found.name in case.solvers)
    for name, rival in RIVALS.items():
        if name in case.solvers and rival.installed:
            yield from rivals(case, name, rival)


def _no_rival(case: Case, name: str, rival: Rival) -> Iterator[Contestant]:
    """Yield nothing: no rival runs closed loops."""
    yield from ()


def _few(case: Case, rival: Rival) -> int:
    """Return over how many states a rival runs."""
    if rival.loop:
        return min(case.batch, case.loop)
    if rival.in_jax and jax.default_backend() == "cpu":
        return min(case.batch, max(case.loop // 10, 1))
    return case.batch


# Labels


def _own_labels(case: Case) -> Iterator[Contestant]:
    mpc, x = case.states
    c = case.condensed

    def judge(fmap: Any) -> tuple[float, int]:
        labels = fmap.labels
        with np.errstate(invalid="ignore"):
            out = (x * labels.cut_normal).sum(axis=1) > labels.cut_offset
        # ∞ stands for a proof at the point without a half-space.
        out |= np.isposinf(labels.cut_offset)
        inside = labels.label == 1
        z = np.zeros((len(x), len(c.P)))
        if inside.any():
            states = jax.vmap(lambda x, u: rolled_out(mpc, x, u))(x[inside], labels.plan[inside])
            z[inside] = np.asarray(jax.vmap(c.variables)(states, labels.plan[inside]))
        primal = residuals(Batch.of(c, x), z, np.zeros((len(x), len(c.C))))[0]
        kept = inside & (primal <= case.tolerance) & ~_breaks_at_once(case, x)
        good = kept | ((labels.label == -1) & out)
        return float(np.mean(good)), int(np.sum((labels.label != 0) & ~good))

    def prepare() -> Callable[[], Any]:
        kept = FeasibilityProblem.of(mpc, None, None)
        return lambda: map_feasible_set(kept, x)

    def extra(fmap: Any) -> dict[str, Any]:
        def fetched() -> None:
            map_feasible_set(fmap.problem, x).labels.fetch()

        return {"proofs_microseconds": _best_each(fetched, len(x))}

    yield Contestant("jaxmpc", __version__, len(x), prepare, judge, extra=extra)


def rolled_out(mpc: MPC, x: Any, inputs: Any) -> Any:
    """Return the states (N + 1, n) that the inputs (N, m) lead to from x (n,)."""
    system = mpc.system
    A, B = jnp.asarray(system.A), jnp.asarray(system.B)
    c = 0.0 if system.c is None else jnp.asarray(system.c)

    def step(x: Any, u: Any) -> tuple[Any, Any]:
        after = A @ x + B @ u + c
        return after, after

    return jnp.concatenate([jnp.asarray(x)[None], jax.lax.scan(step, jnp.asarray(x), inputs)[1]])


def _breaks_at_once(case: Case, x: np.ndarray) -> np.ndarray:
    """Return which states (B,) break a row that no input moves."""
    c = condensed(case.states[0])
    fixed = ~moves(c)
    value = x @ c.D[fixed].T + c.d[fixed]
    return np.any((value < c.lower[fixed]) | (value > c.upper[fixed]), axis=1)


def _rival_labels(case: Case, name: str, rival: Rival) -> Iterator[Contestant]:
    if rival.in_jax:  # qpax proves no program infeasible, and jaxopt runs to its limit on these
        return
    mpc, x = case.states
    x = x[: _few(case, rival)]
    qps = Batch.of(case.condensed, x).closest()
    breaks = _breaks_at_once(case, x)

    def judge(answers: Any) -> tuple[float, int]:
        z, y, status = answers
        proved = map_feasible_set(mpc, x).label
        met = residuals(qps, z, np.zeros_like(y))[0] <= case.tolerance
        # A state that breaks a limit at once is infeasible whatever the solver says of the rest.
        empty = (status == EMPTY) | breaks
        good = np.where(empty, proved != 1, (status == SOLVED) & met)
        said = (status == SOLVED) | (status == EMPTY)
        return float(np.mean(good)), int(np.sum(said & ~good))

    make = lambda: rival.make(qps, case.tolerance * rival.asked)
    yield Contestant(name, rival.version, len(x), make, judge)


# Plans


def _own_plans(case: Case) -> Iterator[Contestant]:
    mpc, x = case.states
    c = condensed(mpc)
    moved, qps = moves(c), Batch.of(case.condensed, x)

    def judge(plan: Plan) -> tuple[float, int]:
        z, y = pair_of(c, plan)
        return judged(qps, case.tolerance, (z, y[:, moved], np.asarray(plan.status)))

    counted, solver = list[Work](), ADMM(eps=case.tolerance)
    program = jax.jit(jax.vmap(lambda controller, x: controller.plan(x), in_axes=(None, 0)))

    def on_device() -> Callable[[], Plan]:
        controller, there = Controller(in_float64(mpc), solver), jax.device_put(x)
        compiled = fitting(program.lower(controller, there))
        counted.append(Work.of(program, controller, there).beside(compiled))
        return lambda: jax.block_until_ready(compiled(controller, there))

    def work() -> Work:  # of both calls, which run the same program
        if not counted:
            on_device()
        return counted[0]

    release = __version__
    yield Contestant("jaxmpc vmap", release, len(x), on_device, judge, work=work)
    if jax.default_backend() == "cpu":

        def make() -> Callable[[], Plan]:  # set up once, as rivals are
            controller = Controller(in_float64(mpc), solver)
            return lambda: solve_many(controller, x)

        yield Contestant("jaxmpc", release, len(x), make, judge, work=work)


def fitting(lowered: Any) -> Any:
    """Return the compiled program; raise MemoryError where it needs more than is free."""
    compiled = lowered.compile()
    needed, free = memory_of(compiled), free_memory()
    if needed > free:
        raise MemoryError(f"needs {in_units(needed)}, {in_units(free)} are free")
    return compiled


def _rival_plans(case: Case, name: str, rival: Rival) -> Iterator[Contestant]:
    x = case.states[1][: _few(case, rival)]
    qps = Batch.of(case.condensed, x)
    make = lambda: rival.make(qps, case.tolerance * rival.asked)
    yield Contestant(
        name, rival.version, len(x), make, lambda found: judged(qps, case.tolerance, found)
    )


# Gradients of the mean of Σ u'u over all plans with respect to the diagonals of Q and R


def weights_of(mpc: MPC) -> dict[str, Any]:
    """Return the diagonals of Q and R."""
    return {"Q": jnp.diag(jnp.asarray(mpc.Q)), "R": jnp.diag(jnp.asarray(mpc.R))}


def weighted(mpc: MPC, weights: dict[str, Any]) -> MPC:
    """Return the problem with these diagonals; the terminal cost stays."""
    return replace(mpc, Q=jnp.diag(weights["Q"]), R=jnp.diag(weights["R"]))


def _slope(case: Case, count: int) -> tuple[dict[str, np.ndarray], float]:
    """Return a direction of the weights, and the derivative of the loss of the first states along
    it by central differences of plans at 1e-9."""
    mpc, x = case.states
    random, weights = np.random.default_rng(1), jax.tree.map(np.asarray, weights_of(mpc))
    direction = {k: v * random.uniform(0.5, 1.5, v.shape) for k, v in weights.items()}
    loss = {}
    for sign in (1, -1):
        moved = {k: v + sign * 1e-4 * direction[k] for k, v in weights.items()}
        host = jax.tree.map(np.asarray, weighted(mpc, moved))
        plans = solve_many(host, x[:count], ADMM(eps=1e-9))
        loss[sign] = float(np.mean(np.sum(plans.inputs**2, axis=(1, 2))))
    return direction, (loss[1] - loss[-1]) / 2e-4


def _gradient_error(case: Case, count: int, gradient: Any) -> float:
    """Return the relative error of a gradient along one direction."""
    direction, slope = _slope(case, count)
    found = sum(float(np.sum(np.asarray(gradient[k]) * direction[k])) for k in direction)
    return abs(found - slope) / max(abs(slope), 1e-12)


def _best_each(each: Callable[[], Any], states: int) -> float:
    """Return microseconds a state of a call, the best of two after a first."""
    return best_seconds(each, 2) / states * 1e6


def _differentiated(
    case: Case,
    name: str,
    release: str,
    count: int,
    loss: Callable[..., Any],
    judge: Callable[[Any], tuple[float | None, int | None]],
) -> Contestant:
    """Return a contestant whose loss(weights, x) -> (value, more) JAX differentiates."""
    mpc, x = case.states
    weights, there = weights_of(mpc), jnp.asarray(x[:count])
    both = jax.value_and_grad(loss, has_aux=True)

    def prepare() -> Callable[[], Any]:
        compiled = fitting(jax.jit(both).lower(weights, there))
        return lambda: jax.block_until_ready(compiled(weights, there))

    def extra(answer: Any) -> dict[str, Any]:
        forward = jax.jit(loss)
        return {
            "forward_microseconds": _best_each(lambda: forward(weights, there), count),
            "gradient_error": _gradient_error(case, count, answer[1]),
        }

    work = lambda: Work.of(both, weights, there) if name in OURS else None
    return Contestant(name, release, count, prepare, judge, work=work, extra=extra)


def _own_gradients(case: Case) -> Iterator[Contestant]:
    mpc, x = case.states
    c = condensed(mpc)
    moved, qps = moves(c), Batch.of(case.condensed, x)

    def loss(weights: dict[str, Any], x: Any) -> tuple[Any, Plan]:
        controller = Controller(weighted(in_float64(mpc), weights), ADMM(eps=case.tolerance))
        plans = jax.vmap(lambda x: controller.plan(x))(x)
        return jnp.mean(jnp.sum(plans.inputs**2, axis=(1, 2))), plans

    def judge(answer: Any) -> tuple[float, int]:
        plan = answer[0][1]
        z, y = pair_of(c, plan)
        return judged(qps, case.tolerance, (z, y[:, moved], np.asarray(plan.status)))

    yield _differentiated(case, OURS[0], __version__, len(x), loss, judge)


def _rival_gradients(case: Case, name: str, rival: Rival) -> Iterator[Contestant]:
    mpc = case.states[0]
    count, moved = _few(case, rival), moves(condensed(mpc))
    if name == "moreau":
        yield _moreau_gradients(case, rival)
    if rival.primal is None:
        return
    primal = rival.primal(case.tolerance * rival.asked)

    def loss(weights: dict[str, Any], x: Any) -> tuple[Any, None]:
        c = condense(weighted(in_float64(mpc), weights))
        shift = (x @ c.D.T + c.d)[:, moved]
        l, u = c.lower[moved] - shift, c.upper[moved] - shift
        solve = jax.vmap(primal, in_axes=(None, 0, None, 0, 0))
        z = solve(c.P, x @ c.F.T + c.f, c.C[moved], l, u)
        inputs = jax.vmap(c.trajectory)(x, z)[1]
        return jnp.mean(jnp.sum(inputs**2, axis=(1, 2))), None

    yield _differentiated(case, name, rival.version, count, loss, lambda answer: (None, None))


def _moreau_gradients(case: Case, rival: Rival) -> Contestant:
    """Return Moreau's batch and its backward pass, then the chain rule through condensing."""
    mpc, x = case.states
    c, weights = case.condensed, weights_of(mpc)
    qps = Batch.of(c, x)
    row, column = np.nonzero(c.P)  # the order of the CSR values

    @jax.jit
    def chain(weights: dict[str, Any], dP: Any, dF: Any, df: Any) -> Any:
        def cost(w: dict[str, Any]) -> tuple[Any, Any, Any]:
            made = condense(weighted(in_float64(mpc), w))
            return made.P, made.F, made.f

        return jax.vjp(cost, weights)[1]((dP, dF, df))[0]

    def prepare() -> Callable[[], Any]:
        forward = moreau(qps, case.tolerance * rival.asked, gradient=True)
        solver = forward.solver  # type: ignore[attr-defined]

        def call() -> Any:
            answers = forward()
            inputs = x @ c.Psi.transpose(2, 0, 1).reshape(x.shape[1], -1)
            inputs = inputs + answers[0] @ c.Omega.transpose(2, 0, 1).reshape(len(c.P), -1)
            slope = 2 / len(x) * (inputs + c.psi.ravel()) @ c.Omega.reshape(-1, len(c.P))
            found, dP = solver.backward(slope), np.zeros_like(c.P)
            dP[row, column] = np.asarray(found["dP_values"]).reshape(-1, len(row)).sum(axis=0)
            dq = np.asarray(found["dq"])
            gradient = chain(weights, dP, dq.T @ x, dq.sum(axis=0))
            return answers, jax.block_until_ready(gradient)

        call.forward = forward  # type: ignore[attr-defined]
        return call

    def extra(answer: Any) -> dict[str, Any]:
        assert contestant.call is not None
        forward = contestant.call.forward  # type: ignore[attr-defined]
        return {
            "forward_microseconds": _best_each(forward, len(x)),
            "gradient_error": _gradient_error(case, len(x), answer[1]),
        }

    judge = lambda answer: judged(qps, case.tolerance, answer[0])
    contestant = Contestant("moreau", rival.version, len(x), prepare, judge, extra=extra)
    return contestant


# Closed loops: TurboMPC's protocol


def weighted_loops(
    name: str, mpc: MPC, weights: dict[str, Any], x: Any, tolerance: Any
) -> tuple[Any, Any]:
    """Return the cost of `SAMPLES` samples of closed loop from each of the states x (B, n), and the
    runs, of a family under weights, the diagonals of Q and R."""
    moved = weighted(in_float64(mpc), weights)
    if name in LIMITS:  # there the terminal cost is Q
        moved = replace(moved, terminal_cost=moved.Q)
    controller = Controller(moved, ADMM(eps=tolerance))
    run = jax.vmap(lambda x: simulate(controller, mpc.system, x, SAMPLES))(x)
    return jnp.sum(run.states[:, 1:] ** 2) + jnp.sum(run.inputs**2), run


def _own_loops(case: Case) -> Iterator[Contestant]:
    mpc, x = case.states
    weights, there = weights_of(mpc), jnp.asarray(x)

    def loops(weights: dict[str, Any], x: Any) -> tuple[Any, Any]:
        cost, run = weighted_loops(case.family, mpc, weights, x, case.tolerance)
        return cost, (run.states[:, :-1], run.inputs, run.status)

    both = jax.value_and_grad(loops, has_aux=True)

    def prepare() -> Callable[[], Any]:
        compiled = fitting(jax.jit(both).lower(weights, there))
        return lambda: jax.block_until_ready(compiled(weights, there))

    def judge(answer: Any) -> tuple[float, int]:
        """Compare inputs at some of the visited states with those of verified plans."""
        states, inputs, status = (np.asarray(v) for v in answer[0][1])
        states, inputs = states.reshape(-1, x.shape[1]), inputs.reshape(-1, inputs.shape[2])
        some = np.random.default_rng(0).permutation(len(states))[:CHECKED]
        plans, c = solve_many(mpc, states[some], ADMM(eps=1e-9)), condensed(mpc)
        worst = residuals(Batch.of(c, states[some]), *pair_of(c, plans)).max(axis=0)
        apart = np.abs(plans.inputs[:, 0] - inputs[some]).max(axis=1)
        good = (worst <= 1e-6) & (apart <= case.tolerance)
        false = (status.ravel()[some] == Status.SOLVED) & (worst <= 1e-6) & ~good
        return float(np.mean(good)), int(false.sum())

    def extra(answer: Any) -> dict[str, Any]:
        forward = jax.jit(loops)
        spent = _best_each(lambda: forward(weights, there), len(x) * SAMPLES)
        return {"forward_microseconds": spent}

    yield Contestant(
        OURS[0],
        __version__,
        len(x),
        prepare,
        judge,
        per=SAMPLES,
        extra=extra,
        work=lambda: Work.of(both, weights, there),
    )
