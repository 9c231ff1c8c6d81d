"""What a plan begins with and tracks, checked in one place (Aim); Plan, the answer of every solver,
with what it costs, violates and is held by; WarmStart and Control, from which the next one goes on.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import Reals, as_array, host_array, module_of
from jaxmpc.checks import fail, require_finite, require_kind, require_shape
from jaxmpc.mpc.problem import MPC, at_stage, weights_of
from jaxmpc.mpc.rows import Block, Layout, blocks, given_blocks, layout, row_count, row_table, split
from jaxmpc.pytrees import named_pytree, pytree
from jaxmpc.qp.linalg import apply, arrays
from jaxmpc.qp.problem import QPSolution
from jaxmpc.qp.residuals import with_fault
from jaxmpc.qp.status import NO_SOLUTION, Status, WithStatus
from jaxmpc.sets.convex_sets import Box, Ellipsoid


class Aim(NamedTuple):
    """Where one plan begins and what it tracks.

    x0 (n,). states and inputs: references (n,) or (N+1, n), and (m,) or (N, m); None for zero.
    previous_input u_{−1} (m,), None for zero. forecast: what is known to be added to the next
    states, (n,) or (N, n), None for zero; of condensed problems only. Of nonlinear problems and
    their expansions: targets of the tasks, (N+1, p) each, and slopes (N+1, n) and (N, m), the terms
    Σ slope_k·x_k + Σ slope_k·u_k of the cost, None for none.
    """

    x0: Any
    states: Any = None
    inputs: Any = None
    previous_input: Any = None
    forecast: Any = None
    targets: tuple[Array, ...] = ()
    slopes: tuple[Array, Array] | None = None

    def along(self, mpc: MPC) -> "Aim":
        """Return the aim with references and forecast at every step."""
        N, n, m = mpc.horizon, mpc.system.n, mpc.system.m
        each = {"states": (N + 1, n), "inputs": (N, m), "forecast": (N, n)}
        filled: dict[str, Any] = {
            name: jnp.broadcast_to(getattr(self, name), shape)
            for name, shape in each.items()
            if getattr(self, name) is not None
        }
        return self._replace(**filled)


def checked_aim(
    mpc: MPC,
    x0: Reals,
    reference: Reals | None = None,
    input_reference: Reals | None = None,
    previous_input: Reals | None = None,
    forecast: Reals | None = None,
    *,
    steps: int = 1,
    state_size: int | None = None,
    widths: Sequence[int] | None = None,
) -> Aim:
    """Return the arguments of a plan, or of a closed loop of `steps` plans, as arrays.

    A number will do for one state or input. state_size: length of x0, and widths: numbers of
    columns that a reference may have, where these are not n. Raises ValueError that names argument,
    shape and cure.
    """
    shapes = reference_shapes(mpc, steps, widths)
    size = mpc.system.n if state_size is None else state_size

    def checked(name: str, value: Reals | None, shapes: Sequence[tuple[int, ...]]) -> Any:
        return None if value is None else checked_array(name, value, shapes)

    known = checked("forecast", forecast, shapes["forecast"])
    return Aim(
        checked_array("x0", x0, [(size,)]),
        checked("reference", reference, shapes["reference"]),
        checked("input_reference", input_reference, shapes["input_reference"]),
        checked("previous_input", previous_input, [(mpc.system.m,)]),
        known if steps > 1 else _where_steps_do_something(mpc, known),
    )


def _where_steps_do_something(mpc: MPC, forecast: Any) -> Any:
    """Return a forecast; a constant one (n,) of a problem that ends in steps that do and cost
    nothing, as `pad_horizon` adds them, as rows (N, n) that are zero there."""
    A, B, Q = (as_array(v) for v in (mpc.system.A, mpc.system.B, mpc.Q))
    if forecast is None or np.ndim(forecast) > 1 or min(v.ndim for v in (A, B, Q)) < 3:
        return forecast
    xp = module_of(A, B, Q, forecast)
    still = xp.all(A == xp.eye(A.shape[-1], dtype=A.dtype), axis=(1, 2))
    idle = still & ~xp.any(B, axis=(1, 2)) & ~xp.any(Q, axis=(1, 2))
    idle = xp.cumsum(~idle[::-1])[::-1] == 0  # to the end
    return xp.where(idle[:, None], xp.zeros_like(forecast), forecast)


def reference_shapes(
    mpc: MPC, steps: int = 1, widths: Sequence[int] | None = None
) -> dict[str, list[tuple[int, ...]]]:
    """Return the shapes that references of `steps` plans in a row may have; see `checked_aim`."""
    N, m = mpc.horizon, mpc.system.m
    states: list[tuple[int, ...]] = []
    for k in widths or (mpc.system.n,):
        states += [(k,), (N + steps, k)]
    n, last = mpc.system.n, N + steps - 1
    inputs, forecast = [(m,), (last, m)], [(n,), (last, n)]
    return {"reference": states, "input_reference": inputs, "forecast": forecast}


# What plans track, by the names of the arguments of `solve`; none that stand for zero.
References = dict[str, Any]


def constant_references(
    mpc: MPC, reference: Reals | None, input_reference: Reals | None
) -> References:
    """Return references (n,) and (m,) that hold at all time steps as arrays of float64, those that
    are given; ValueError that names argument, shape and cure for others."""
    require_kind("mpc", mpc, MPC)
    sizes = {"reference": mpc.system.n, "input_reference": mpc.system.m}
    given = {"reference": reference, "input_reference": input_reference}
    found = {}
    for name, value in given.items():
        if value is not None:
            if sizes[name] == 1 and isinstance(value, int | float):
                value = [value]
            cure = "Give one number each: where the loops stay"
            require_shape(name, value, (sizes[name],), cure)
            require_finite(name, value)
            found[name] = host_array(name, value)
    return found


def checked_array(name: str, value: Any, shapes: Sequence[tuple[int, ...]]) -> Any:
    """Return a value as an array of real numbers; ValueError unless it has one of the shapes. A
    number will do for (1,)."""
    value = _real_array(name, value)
    if np.shape(value) == () and (1,) in shapes:
        value = value.reshape(1)
    if np.shape(value) not in shapes:
        cure = f"Give {' or '.join(map(str, shapes))}"
        if (np.size(value),) in shapes:
            cure = f"{cure}: {name}.ravel()"
        elif any(np.shape(value)[1:] == shape for shape in shapes):
            cure = f"{cure}; use jax.vmap for many"
        fail(name, f"shape {np.shape(value)}", cure)
    return value


def _real_array(name: str, value: Any) -> Any:
    if type(value) is np.ndarray and value.dtype.kind in "iuf":  # the usual case, and fast
        return value
    value = as_array(value)
    if not isinstance(value, jax.Array):
        return host_array(name, value)
    if jnp.issubdtype(value.dtype, jnp.complexfloating):
        fail(name, f"entries of type {value.dtype} where real numbers are needed", "Use .real")
    return value


@pytree
class Multipliers:
    """Lagrange multipliers of a plan, for the cost without ½: y > 0 where the upper bound of the
    row is active, y < 0 where the lower is.

    states (K, r): of the rows of `states` at the steps where they hold.
    inputs (N, m or rows): of the input limits.
    terminal (r_f,): of the terminal set (for an Ellipsoid {x'Px ≤ level}: of the rows L'x with
    P = LL', n of them).
    outputs, soft, tasks: one array (steps, rows) for each of the problem's.
    rates (N, m): of the limits of input rates.

    dJ*/d(upper bound) = −y where y > 0, dJ*/d(lower bound) = −y where y < 0.
    `active_constraints` lists them by name, step and unit.
    """

    states: Array
    inputs: Array
    terminal: Array
    outputs: tuple[Array, ...] = ()
    rates: Array | None = None
    soft: tuple[Array, ...] = ()
    tasks: tuple[Array, ...] = ()


@pytree
class Plan(WithStatus):
    """Answer of `solve`.

    states (N+1, n): x_0 … x_N. inputs (N, m): u_0 … u_{N−1}.
    cost: J (without ½), with what soft rows and input rates pay.
    slack (N+1, p): violation of the p soft rows, in the order of `mpc.soft`, zero at steps where a
    row does not hold.
    multipliers: of the rows, see `Multipliers`.
    status: `jaxmpc.Status`, that of the QP.
    primal_residual, dual_residual, gap: of the condensed QP, in the units of states and inputs.
    iterations: ADMM steps, of `solve_nonlinear` quadratic programs.

    Unless the status is SOLVED, cost and trajectory are those of the best iterate and mean little:
    from a state without a feasible plan the inputs too may lie outside their limits. The first one
    clipped into them is what `Controller(mpc)(x)` gives.
    A plan serves as warm start.
    feedback (N, m, N, p): of affine policies, what later inputs add to the plan's, which is that of
    the undisturbed plant: u_k = inputs_k + Σ_{j<k} feedback_kj w_j; None for other problems. In
    those with a gain K u_k = inputs_k + K (x_k − states_k).
    """

    states: Array
    inputs: Array
    cost: Array
    slack: Array
    multipliers: Multipliers
    status: Array
    primal_residual: Array
    dual_residual: Array
    gap: Array
    iterations: Array
    feedback: Any = None


@named_pytree
class WarmStart(NamedTuple):
    """Where a solver begins: states (N+1, n), inputs (N, m), multipliers (rows,) in the order of
    `row_table`."""

    states: Array
    inputs: Array
    multipliers: Array

    @classmethod
    def of(cls, start: "Plan | WarmStart", layout: Layout, mpc: MPC) -> "WarmStart":
        """Return a Plan or WarmStart as the latter; ValueError where it is of another problem."""
        require_warm_start(start)
        if isinstance(start, Plan):
            start = cls(start.states, start.inputs, flat_multipliers(layout, start.multipliers))
        N, n, m = mpc.horizon, mpc.system.n, mpc.system.m
        shapes = ((N + 1, n), (N, m), (row_count(layout),))
        for name, value, shape in zip(cls._fields, start, shapes, strict=True):
            if np.shape(value) != shape:
                fail(f"warm_start.{name}", f"shape {np.shape(value)}", f"Needed: {shape}")
        return start

    def shifted(self, layout: Layout, tail: Array, terminal_is_ball: bool = False) -> "WarmStart":
        """Return the warm start one time step later, with `tail` (m,) as its new last input.

        Inputs and multipliers move up by one step; those of the last step are zero. What bounded
        x_N through the terminal set bounds it as a state from now on, where both have the same
        rows; not where it is an ellipsoid (terminal_is_ball), whose rows are no limits.
        """
        y, horizon = self.multipliers, len(self.inputs)
        blocks = list(zip(layout, split(layout, y), strict=True))
        terminal = next((part[0] for (kind, *_), part in blocks if kind == "terminal"), y[:0])
        moved = []
        for (kind, steps, size), part in blocks:
            if kind != "terminal":
                # Stage k takes over from k + 1: from the block itself, else from the terminal set.
                place = {k: j for j, k in enumerate(steps)}
                same = kind == "state" and not terminal_is_ball and terminal.shape[0] == size
                last = terminal if same else jnp.zeros(size, y.dtype)
                source = jnp.concatenate([part, last[None], jnp.zeros((1, size), y.dtype)])
                end = len(steps)
                later = [place.get(k + 1, end if k + 1 == horizon else end + 1) for k in steps]
                part = source[np.array(later, int)]
            moved.append(part.ravel())
        return WarmStart(
            jnp.concatenate([self.states[1:], self.states[-1:]]),
            jnp.concatenate([self.inputs[1:], tail[None]]),
            jnp.concatenate([*moved, y[:0]]),
        )


def require_warm_start(start: Any) -> None:
    """Raise ValueError unless a warm start is a Plan, a WarmStart or None."""
    if start is not None and not isinstance(start, Plan | WarmStart):
        what = f"is a {type(start).__name__}"
        fail("warm_start", what, "Give a Plan or a jm.mpc.WarmStart")


Planned = TypeVar("Planned")


@named_pytree
class Control(NamedTuple, Generic[Planned]):
    """What a controller gives at one time step, from which it goes on at the next.

    u (m,): the input to apply, within its limits. plan: the plan whose first input it is, NaN where
    the state was not finite. memory: what the controller goes on from at the next time step, the
    last finite plan in most, of which the next is warm-started; None for one without plans.
    """

    u: Array
    plan: Planned
    memory: Any


def require_before(before: Any) -> None:
    """Raise ValueError unless `before` is what a controller returned, or None."""
    cure = "Give what the last call returned, or None; a reference has its name: reference=..."
    if before is not None:
        require_kind("before", before, Control, cure=cure)


def anchored(start: WarmStart, x0: Array) -> WarmStart:
    """Return the warm start moved to x0 (n,): its states keep their distances from the first.

    So a plan from a bad reading, far off, is no worse a point of expansion than others. Distances
    that are rounding, beside states that are large, count as none."""
    d = start.states - start.states[0]
    most = jnp.max(jnp.abs(start.states), axis=0)
    noise = 1000 * jnp.finfo(d.dtype).eps * most
    d = jnp.where(jnp.max(jnp.abs(d), axis=0) > noise, d, 0.0)
    return start._replace(states=x0 + d)


def answer(
    mpc: MPC,
    layout: Layout,
    found: QPSolution,
    fault: Array,
    x: Array,
    u: Array,
    aim: Aim,
    feedback: Array | None = None,
    beyond: Array | None = None,
) -> Plan:
    """Return the plan of a QP's solution, states x (N+1, n), inputs u (N, m) and the feedback of
    affine policies: NaN and the status `fault` where the data had one. beyond (copies, rows): by
    how much policies may violate each row, on each of these sides; None: as x and u do."""
    if beyond is None:
        worst = paid = _violations(mpc, x, u)
    else:
        paid = [pair for side in beyond for pair in _of_soft_blocks(mpc, layout, side)]
        worst = _of_soft_blocks(mpc, layout, jnp.max(beyond, axis=0))
    solution = with_fault(replace(found, cost=cost(mpc, x, u, aim, paid)), fault)
    nan = lambda v: jnp.where(fault == Status.NOT_RUN, v, jnp.nan)
    return Plan(
        states=nan(x),
        inputs=nan(u),
        cost=solution.cost,
        slack=nan(_slack(worst, x)),
        multipliers=sorted_multipliers(mpc, layout, solution.y),
        status=solution.status,
        primal_residual=solution.primal_residual,
        dual_residual=solution.dual_residual,
        gap=solution.gap,
        iterations=solution.iterations,
        feedback=None if feedback is None else nan(feedback),
    )


def limited(inputs: Any, u: Array) -> Array:
    """Return u clipped into the input limits of the first stage, if these are a Box: no rounding
    beyond them."""
    if not isinstance(inputs, Box):
        return u
    first = at_stage(inputs, 0)
    return _between(u, first.lower, first.upper)


def rate_ends(mpc: MPC) -> tuple[Any, Any]:
    """Return the least and the largest change of the inputs in the first time step, (m,)."""
    limit: Any = mpc.input_rate_limit
    limit = limit[0] if np.ndim(limit) == 2 else at_stage(limit, 0)
    return (limit.lower, limit.upper) if isinstance(limit, Box) else (jnp.negative(limit), limit)


def within_limits(mpc: MPC, u: Array, before: Array) -> Array:
    """Return u (m,) clipped into the limits of its change from `before` (m,), if it has such, and
    into the input limits."""
    if mpc.rate_limited:
        u = _between(u, *rate_ends(mpc), base=before)
    return limited(mpc.inputs, u)


def _between(u: Array, lower: Any, upper: Any, base: Any = 0) -> Array:
    """Return u clipped between base + lower and base + upper."""
    low, high = (jnp.asarray(v, u.dtype) for v in arrays((lower, upper)))
    return jnp.clip(u, base + low, base + high)


def applied(
    mpc: MPC, layout: Layout, plan: Plan, before: WarmStart | None, last: Array | None = None
) -> Control[Plan]:
    """Return what a controller gives for a plan: its first input (m,) within the limits and, from
    `last` (m,), the input before (None: zero), within those of its rate.

    Where the plan is not finite the input is `last`, if its rate is limited or weighed, else zero,
    and the memory is that of `before` (None: zeros). So a bad reading is forgotten with the next
    time step."""
    finite = jnp.isfinite(plan.cost)  # no state or input is NaN or infinite without it
    u = plan.inputs[0]
    hold = jnp.zeros_like(u)
    if mpc.input_in_state and last is not None:
        hold = limited(mpc.inputs, jnp.where(jnp.isfinite(last), last, 0.0))
    u = within_limits(mpc, jnp.where(finite, u, hold), hold)
    new = WarmStart(plan.states, plan.inputs, flat_multipliers(layout, plan.multipliers))
    old = jax.tree.map(jnp.zeros_like, new) if before is None else before
    memory = jax.tree.map(partial(jnp.where, finite), new, old)
    return Control(u, plan, memory)


def cost(
    mpc: MPC, states: Array, inputs: Array, aim: Aim, violations: list[tuple[Block, Array]]
) -> Array:
    """Return J (without ½) of a trajectory, states (N+1, n) and inputs (N, m), with what input
    rates and these violations of soft blocks add."""
    error = states if aim.states is None else states - aim.states
    effort = inputs if aim.inputs is None else inputs - aim.inputs
    square = lambda v, W: jnp.sum(v * apply(W, v))
    weights = weights_of(mpc, states.dtype)
    J = square(error[:-1], weights.Q) + square(effort, weights.R)
    if mpc.terminal_cost is not None:
        J = J + square(error[-1:], weights.P)
    if mpc.input_rate_weight is not None:
        last = aim.previous_input
        first = jnp.zeros_like(inputs[0]) if last is None else last
        J = J + square(jnp.diff(inputs, axis=0, prepend=first[None]), weights.W)
    for block, e in violations:
        J = J + jnp.sum(e * (block.linear + 0.5 * block.quadratic * e))
    return J


def _slack(violations: list[tuple[Block, Array]], states: Array) -> Array:
    columns = [
        jnp.zeros((len(states), block.size), e.dtype).at[np.array(block.steps, int)].set(e)
        for block, e in violations
    ]
    return jnp.concatenate([jnp.zeros((len(states), 0), states.dtype), *columns], axis=1)


def _violations(mpc: MPC, states: Array, inputs: Array) -> list[tuple[Block, Array]]:
    """Return each soft block with its violations (steps, rows)."""
    if not mpc.soft:
        return []
    found = []
    for block in blocks(mpc, states.dtype):
        if block.linear is not None:
            value = block.values(states, inputs)
            beyond = jnp.maximum(value - block.upper, block.lower - value)
            found.append((block, jnp.maximum(beyond, 0.0)))
    return found


def _of_soft_blocks(mpc: MPC, layout: Layout, beyond: Array) -> list[tuple[Block, Array]]:
    """Return each soft block with its part (steps, rows) of the violations of all rows."""
    parts = zip(given_blocks(mpc, beyond.dtype), split(layout, beyond), strict=True)
    return [(block, e) for block, e in parts if block.linear is not None]


def sorted_multipliers(mpc: MPC, layout: Layout, y: Array) -> Multipliers:
    """Return the multipliers y (rows,) of all rows, sorted by constraint and step."""
    of: dict[str, list[Array]] = {}
    for (kind, _, _), part in zip(layout, split(layout, y), strict=True):
        of.setdefault(kind, []).append(part)

    def first(kind: str, *shape: int) -> Array:
        return of[kind][0] if kind in of else jnp.zeros(shape, y.dtype)

    return Multipliers(
        states=first("state", len(mpc.state_stages), 0),
        inputs=first("input", mpc.horizon, 0),
        terminal=first("terminal", 1, 0)[0],
        outputs=tuple(of.get("output", ())),
        rates=first("rate") if "rate" in of else None,
        soft=tuple(of.get("soft", ())),
        tasks=tuple(of.get("task", ())),
    )


def flat_multipliers(layout: Layout, multipliers: Multipliers) -> Array:
    """Return the multipliers of one plan as one vector (rows,): the inverse of
    `sorted_multipliers`. Raises ValueError where they are those of another problem or of many."""
    y = multipliers
    one = {"state": y.states, "input": y.inputs, "rate": y.rates, "terminal": y.terminal}
    several = {"output": iter(y.outputs), "soft": iter(y.soft), "task": iter(y.tasks)}
    parts = []
    for kind, steps, size in layout:
        part = one[kind] if kind in one else next(several[kind], None)
        shape = (size,) if kind == "terminal" else (len(steps), size)
        given = () if part is None else np.shape(part)
        if part is None or given != shape:
            found = f"has multipliers of shape {given} for {shape} {kind} rows"
            fail("plan", found, "Give one plan of mpc")
        parts.append(jnp.ravel(part))
    return jnp.concatenate(parts) if parts else jnp.zeros(0, jnp.result_type(y.states))


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

    plan: of `mpc`, one instance. tolerance: in cost per unit of a
    row.

    The multiplier of a bound is the sensitivity of the optimal cost:
    dJ*/d(bound) = −multiplier for an upper bound, +multiplier for a lower one. Where rows coincide
    (inputs of one block of a control horizon, states at N beside the terminal set) they share it in
    an arbitrary way: only their sum is a sensitivity, of relaxing all of them. NumPy; not
    traceable.

    Raises ValueError for a plan that there is not, such as an infeasible one: its multipliers
    belong to a proof, and are no sensitivities.
    """
    y = np.asarray(flat_multipliers(layout(mpc), plan.multipliers), np.float64)
    if int(plan.status) in NO_SOLUTION:
        what = f"is {Status(int(plan.status)).name}, so that no limit shapes it"
        at_once = broken_at_start(mpc, np.asarray(plan.states[0]))
        if at_once:
            fail("plan", f"{what}: x0 has {' and '.join(at_once)}", "Start inside, or soften it")
        cure = "Ask jm.solve(jm.soften(mpc, rho=1e3), x0) which limits it breaks"
        fail("plan", what, cure)
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


def broken_at_start(mpc: MPC, x0: np.ndarray) -> list[str]:
    """Return in words each hard limit that a state x0 (n,) does not keep by itself, such as
    "dq = 2.5 rad/s, above 2", the worst of them, relative to the limit, first."""
    found = list[tuple[float, str]]()
    for b in given_blocks(mpc, float):
        if b.kind not in ("state", "output") or b.H is None or b.steps[0] != 0:
            continue
        if b.D is not None and np.any(b.D):
            continue
        H = np.asarray(b.H)[0] if np.ndim(b.H) == 3 else b.H
        low, high = (b.at_steps(side, mpc.horizon + 1, 0.0)[0] for side in (b.lower, b.upper))
        for i, value in enumerate(H @ x0):
            end, side = (high[i], "above") if value > high[i] else (low[i], "below")
            over = max(value - high[i], low[i] - value)
            if over > 1e-9 * max(abs(end), abs(value)):
                text = f"{b.names[i]} = {value:.6g} {b.units[i]}".rstrip()
                found.append((over / max(abs(end), abs(value)), f"{text}, {side} {end:.6g}"))
    return [text for _, text in sorted(found, key=lambda pair: -pair[0])]


def soft_columns(mpc: MPC) -> list[int | None]:
    """Column of `Plan.slack` for each row of the condensed QP, None for hard ones."""
    columns: list[int | None] = []
    first = 0
    for b in given_blocks(mpc, float):
        hard = b.linear is None
        columns += [None if hard else first + j for _ in b.steps for j in range(b.size)]
        first += 0 if hard else b.size
    return columns
